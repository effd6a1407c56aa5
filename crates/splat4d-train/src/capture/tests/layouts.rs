//! Every layout, from synthetic files to poses, times, splits and pixels.

use super::super::*;
use super::samples::{self, FOCAL, HEIGHT, Sample, WIDTH};
use serde_json::json;
use splat4d::math::se3::{norm, sub};
use splat4d::scene::Lens;
use std::sync::Arc;

/// How exactly a pose must survive its file format.
const POSE_TOLERANCE: f64 = 1e-9;

fn open(sample: &Sample) -> Capture {
    Capture::open(sample.root(), &CaptureOptions::default()).unwrap()
}

fn open_with(sample: &Sample, options: CaptureOptions) -> Capture {
    Capture::open(sample.root(), &options).unwrap()
}

fn assert_pose(frame: &Frame, camera: usize) {
    let (a, b) = (frame.view.cam_from_world, samples::pose(camera));
    let turned = a.rotation.iter().flatten().zip(b.rotation.iter().flatten()).map(|(x, y)| (x - y).abs());
    assert!(turned.fold(0.0, f64::max) < POSE_TOLERANCE, "{} must have pose {camera}", frame.image.display());
    assert!(norm(sub(a.translation, b.translation)) < POSE_TOLERANCE);
    assert_eq!((frame.view.width, frame.view.height, frame.view.lens), (WIDTH, HEIGHT, Lens::Pinhole));
    assert!((frame.view.intrinsics.fy - FOCAL).abs() < 1e-9 && frame.view.intrinsics.cx == 12.0);
}

fn names(capture: &Capture) -> Vec<&str> {
    capture.cameras.iter().map(|c| c.name.as_str()).collect()
}

/// The blue value of a frame's first pixel: which image it is, see `Sample::rgb`.
fn blue(capture: &Arc<Capture>, frame: usize) -> usize {
    let picture = ImageStore::new(Arc::clone(capture), 0).load(frame).unwrap().to_picture();
    (picture.color.get(2, 0, 0) * 255.0).round() as usize
}

#[test]
fn nerfies_and_hypernerf() {
    let sample = samples::nerfies();
    let capture = Arc::new(open_with(&sample, CaptureOptions { fps: Some(10.0), ..CaptureOptions::default() }));
    assert_eq!((capture.kind, capture.fps, names(&capture)), (CaptureKind::Nerfies, 10.0, vec!["camera0"]));
    assert_eq!((capture.frames.len(), &capture.held, &capture.train), (4, &vec![2], &vec![0, 1, 3]));
    for (i, frame) in capture.frames.iter().enumerate() {
        assert_pose(frame, i);
        assert!((frame.time.0 - 0.1 * i as f64).abs() < 1e-12, "frame {i} at {}", frame.time.0);
        // What is undistorted has other pixels.
        if frame.source.lens == Lens::Pinhole {
            assert_eq!(blue(&capture, i), i * 7, "frame {i}");
        }
    }
    assert!(matches!(capture.frames[3].source.lens, Lens::Brown { k, .. } if k[0] == 0.1));
    let points = capture.points.as_ref().unwrap();
    assert_eq!(points.points, [[0.0; 3]], "a point that is no number is left out");
    let say = |sample: &Sample| Capture::open(sample.root(), &CaptureOptions::default()).unwrap_err().to_string();
    sample.edit("dataset.json", |v| v["val_ids"] = json!(["000002", "000009"]));
    let lost = open(&sample);
    let named = |w: &String| w.contains("000009") && w.contains("dataset.json");
    assert!(lost.held == [2] && lost.warnings.iter().any(named), "{:?}", lost.warnings);
    sample.edit("dataset.json", |v| v["val_ids"] = json!([]));
    sample.edit("camera/000001.json", |v| v["skew"] = json!(3.0));
    assert!(say(&sample).contains("000001.json") && say(&sample).contains("skew"), "{}", say(&sample));
    std::fs::remove_file(sample.path("camera/000001.json")).unwrap();
    assert!(say(&sample).contains("000001.json"));
    std::fs::remove_file(sample.path("metadata.json")).unwrap();
    assert!(say(&sample).contains("not a capture"));
}

#[test]
fn own_format() {
    let sample = samples::own();
    let capture = Arc::new(open(&sample));
    assert_eq!((capture.kind, capture.fps, capture.up), (CaptureKind::Own, 10.0, [0.0, 0.0, 1.0]));
    assert_eq!((names(&capture), capture.fixed_cameras()), (vec!["cam00", "cam01", "cam02"], true));
    assert_eq!((capture.frames.len(), capture.held.as_slice()), (6, &[0, 1][..]));
    for (i, frame) in capture.frames.iter().enumerate() {
        assert_eq!((frame.camera, frame.index), (i / 2, i % 2));
        assert!((frame.time.0 - (0.1 * (i % 2) as f64 + 0.01 * (i / 2) as f64)).abs() < 1e-12);
        assert_pose(frame, i / 2);
        assert_eq!(blue(&capture, i), (i / 2) * 40 + (i % 2) * 7);
    }
    assert_eq!(capture.times().len(), 6);
    assert!(capture.time_range().0 == 0.0 && (capture.time_range().1 - 0.12).abs() < 1e-12);
    assert_eq!(capture.points.as_ref().unwrap().colors, [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]);
    let picture = ImageStore::new(capture, 1 << 20).load(2).unwrap().to_picture();
    let mask = picture.mask.unwrap();
    assert_eq!((mask.get(0, 3, 11), mask.get(0, 3, 12), picture.valid), (1.0, 0.0, None));
}

#[test]
fn own_format_with_a_table_of_times() {
    let sample = samples::own();
    sample.edit("capture.json", |v| v["cameras"][1]["times"] = json!([0.25, 0.375]));
    let capture = open(&sample);
    let times: Vec<f64> = capture.frames[..4].iter().map(|f| f.time.0).collect();
    assert_eq!(times, [0.0, 0.1, 0.26, 0.385], "a camera's own times, and its offset");
    for (times, word) in [(json!([0.25]), "1 times"), (json!([0.25, 0.25]), "not later")] {
        sample.edit("capture.json", |v| v["cameras"][1]["times"] = times);
        let error = Capture::open(sample.root(), &CaptureOptions::default()).unwrap_err().to_string();
        assert!(error.contains(word) && error.contains("cam01"), "{error}");
    }
}

#[test]
fn eight_bits_of_any_image() {
    let sample = samples::own();
    let read = Rgb8::read(&sample.path("images/cam01/0006.png")).unwrap();
    assert_eq!((read.width, read.height, read.data.len()), (WIDTH, HEIGHT, WIDTH * HEIGHT * 3));
    assert_eq!(read.data[2], 47, "the blue of camera 1, frame 1");
    assert!(Rgb8::decode(b"no image", &sample.path("x.png")).unwrap_err().to_string().contains("x.png"));
}

#[test]
fn own_format_moving_inverted_opengl_listed() {
    let sample = samples::own();
    sample.edit("capture.json", |v| {
        v["axes"] = json!("opengl");
        v["cameras"] = json!([v["cameras"][0]]);
        let camera = &mut v["cameras"][0];
        camera.as_object_mut().unwrap().remove("world_to_camera");
        camera.as_object_mut().unwrap().remove("masks");
        camera["camera_to_world"] = json!([samples::opengl(4), samples::opengl(5)]);
        camera["images"] = json!(["images/cam00/0006.png", "images/cam00/0005.png"]);
        camera["comment"] = json!("moves");
    });
    let capture = open(&sample);
    assert!(!capture.cameras[0].fixed);
    assert_pose(&capture.frames[0], 4);
    assert_pose(&capture.frames[1], 5);
    assert!(capture.frames[0].image.ends_with("0006.png"));
}

#[test]
fn dnerf() {
    let sample = samples::dnerf();
    let capture = Arc::new(open(&sample));
    assert_eq!((capture.kind, names(&capture)), (CaptureKind::DNerf, vec!["moving"]));
    assert_eq!((&capture.train[..], &capture.validation[..], &capture.held[..]), (&[0, 1, 2][..], &[3][..], &[4][..]));
    assert_eq!(capture.split(4), Split::Held);
    // u (N − 1)/30 with N = 3 training frames, in every split.
    let seconds: Vec<f64> = capture.frames.iter().map(|f| f.time.0 * 30.0).collect();
    for (got, want) in seconds.iter().zip([0.0, 1.0, 2.0, 0.5, 1.5]) {
        assert!((got - want).abs() < 1e-12, "{seconds:?}");
    }
    (0..5).for_each(|i| assert_pose(&capture.frames[i], i));
    assert!((capture.frames[0].view.intrinsics.fx - FOCAL).abs() < 1e-9);
    assert_eq!(capture.background, Some([1.0; 3]));
    let picture = ImageStore::new(Arc::clone(&capture), 1 << 20).load(0).unwrap().to_picture();
    let alpha = 128.0 / 255.0;
    let want = 200.0 / 255.0 * alpha + 1.0 - alpha;
    assert!((picture.color.get(0, 0, 0) - want).abs() < 0.25 / 255.0, "compositing must not round to 8 bits");
    assert_eq!(picture.color.get(0, 0, 20), 1.0);
    assert!((picture.mask.unwrap().get(0, 0, 0) - alpha).abs() < 1e-6);
    let told = CaptureOptions { unit_time_seconds: Some(8.0), background: Some([0.0; 3]), ..CaptureOptions::default() };
    let capture = open_with(&sample, told);
    assert_eq!((capture.time_range(), capture.background), ((0.0, 8.0), Some([0.0; 3])));
    let fast = open_with(&sample, CaptureOptions { fps: Some(60.0), ..CaptureOptions::default() });
    assert!((fast.time_range().1 - 2.0 / 60.0).abs() < 1e-12);
}

#[test]
fn panoptic_sports() {
    let sample = samples::panoptic();
    let capture = Arc::new(open(&sample));
    assert_eq!((capture.kind, names(&capture)), (CaptureKind::Panoptic, vec!["1", "2", "3"]));
    let held: Vec<usize> = capture.held.iter().map(|&i| capture.frames[i].camera).collect();
    assert_eq!(held, [1, 1]);
    for (i, frame) in capture.frames.iter().enumerate() {
        assert_pose(frame, frame.camera + 1);
        assert!((frame.time.0 - frame.index as f64 / 30.0).abs() < 1e-12);
        assert_eq!(blue(&capture, i), (frame.camera + 1) * 40 + frame.index * 7);
        assert_eq!(frame.mask.is_some(), frame.camera != 1);
    }
    // Masks of zeros and ones are masks of black and white.
    let mask = ImageStore::new(Arc::clone(&capture), 1 << 20).load(0).unwrap().to_picture().mask.unwrap();
    assert_eq!((mask.get(0, 0, 5), mask.get(0, 0, 6)), (1.0, 0.0));
    assert_eq!(capture.points.as_ref().unwrap().points.len(), 2);
    let other: HoldOut = "camera=3,0".parse().unwrap();
    let capture = open_with(&sample, CaptureOptions { hold_out: Some(other), ..CaptureOptions::default() });
    assert_eq!(capture.held.len(), 4, "3 is a name, 0 a position");
    assert!(capture.train.iter().all(|&i| capture.frames[i].camera == 1));
    // Of several clouds none is guessed.
    sample.write("other.ply", samples::PLY.as_bytes());
    let capture = open(&sample);
    let asks = |w: &String| w.contains("cloud.ply, other.ply") && w.contains('?');
    assert!(capture.points.is_none() && capture.warnings.iter().any(asks), "{:?}", capture.warnings);
}

#[test]
fn nerfstudio() {
    let sample = samples::nerfstudio();
    let capture = Arc::new(open(&sample));
    assert_eq!((capture.kind, names(&capture)), (CaptureKind::Nerfstudio, vec!["cam0", "cam1"]));
    assert_eq!((capture.held.as_slice(), capture.fixed_cameras()), (&[0, 1][..], true));
    for (i, frame) in capture.frames.iter().enumerate() {
        assert_pose(frame, i / 2);
        assert!((frame.time.0 - (i % 2) as f64 / 30.0).abs() < 1e-12, "two instants are one frame apart");
    }
    assert_eq!(capture.frames[2].view.intrinsics.fx, FOCAL + 1.0);
    assert!(matches!(capture.frames[2].source.lens, Lens::Brown { k, .. } if k[0] == -0.3));
    let store = ImageStore::new(Arc::clone(&capture), 1 << 20);
    assert!(store.load(0).unwrap().to_picture().mask.is_some());
    assert!(store.load(1).unwrap().to_picture().mask.is_none());
    // The corner ray of the pinhole image is inside the barrel-distorted one, so all pixels are valid, and the
    // corner shows what was nearer the middle.
    let picture = store.load(2).unwrap().to_picture();
    assert!(picture.valid.is_none() && picture.color.get(0, 0, 0) > 0.02, "{}", picture.color.get(0, 0, 0));
    assert!((picture.color.get(0, 8, 12) - 120.0 / 255.0).abs() < 0.01, "the middle stays");
    sample.edit("transforms.json", |v| {
        v["test_filenames"] = json!(["images/cam1/0001.png"]);
        v["frames"]
            .as_array_mut()
            .unwrap()
            .iter_mut()
            .for_each(|f| f["time"] = json!(f["time"].as_f64().unwrap() * 2.5));
    });
    let capture = open(&sample);
    assert_eq!((capture.held.as_slice(), capture.time_range().1), (&[3][..], 2.5));
}

#[test]
fn colmap_binary_and_text_agree() {
    let (bin, txt) = (samples::colmap_bin(), samples::colmap_txt());
    let (a, b) = (Arc::new(open(&bin)), open(&txt));
    assert_eq!((a.kind, names(&a), a.frames.len()), (CaptureKind::Colmap, vec!["cam0", "cam1", "cam2"], 6));
    assert_eq!(a.held, [0, 1]);
    for (i, (f, g)) in a.frames.iter().zip(&b.frames).enumerate() {
        assert_pose(f, i / 2);
        assert_pose(g, i / 2);
        assert_eq!((f.index, f.source.lens), (i % 2, g.source.lens), "siblings share the pose and the lens");
        assert_eq!(blue(&a, i), if i < 4 { (i / 2) * 40 + (i % 2) * 7 } else { blue(&a, i) });
    }
    assert!(matches!(a.frames[5].source.lens, Lens::Brown { p, .. } if p == [1e-3, -1e-3]));
    assert_eq!(a.points, b.points);
    assert_eq!(a.points.as_ref().unwrap().points, [[0.1, 0.2, 0.3]]);
    assert!(a.warnings.iter().any(|w| w.contains("2.50 px")), "{:?}", a.warnings);
    let fast = open_with(&bin, CaptureOptions { fps: Some(120.0), ..CaptureOptions::default() });
    assert!((fast.time_range().1 - 1.0 / 120.0).abs() < 1e-12);
}

#[test]
fn colmap_siblings_by_prefix() {
    let sample = samples::colmap_txt();
    let mut text = std::fs::read_to_string(sample.path("sparse/0/images.txt")).unwrap();
    for c in 0..3 {
        for t in 0..2 {
            let flat = sample.path(&format!("images/cam{c}_frame{t:04}.png"));
            std::fs::rename(sample.path(&format!("images/cam{c}/{t:04}.png")), flat).unwrap();
        }
        sample.mask(&format!("masks/cam{c}_frame0001.png.png"), |_, _| 255);
        text = text.replace(&format!("cam{c}/0000.png"), &format!("cam{c}_frame0000.png"));
    }
    sample.write("sparse/0/images.txt", text.as_bytes());
    let capture = open(&sample);
    assert_eq!((names(&capture), capture.frames.len()), (vec!["cam0", "cam1", "cam2"], 6));
    for (i, frame) in capture.frames.iter().enumerate() {
        assert_pose(frame, i / 2);
        assert_eq!((frame.index, frame.mask.is_some()), (i % 2, i % 2 == 1));
    }
}

#[test]
fn colmap_of_one_moving_camera() {
    let sample = samples::colmap_txt();
    let text = std::fs::read_to_string(sample.path("sparse/0/images.txt")).unwrap();
    let mut text = text;
    for c in 0..3 {
        std::fs::copy(
            sample.path(&format!("images/cam{c}/0000.png")),
            sample.path(&format!("images/frame_{}.png", c + 7)),
        )
        .unwrap();
        text = text.replace(&format!("cam{c}/0000.png"), &format!("frame_{}.png", c + 7));
    }
    sample.write("sparse/0/images.txt", text.as_bytes());
    let capture = open(&sample);
    assert_eq!((names(&capture), capture.fixed_cameras()), (vec!["moving"], false));
    assert_eq!((capture.frames.len(), capture.held.as_slice()), (3, &[0][..]));
    assert!((capture.frames[2].time.0 - 2.0 / 30.0).abs() < 1e-12);
}

#[test]
fn n3dv() {
    let sample = samples::n3dv();
    let capture = Arc::new(open(&sample));
    assert_eq!((capture.kind, names(&capture)), (CaptureKind::N3dv, vec!["cam00", "cam01"]));
    assert_eq!((capture.frames.len(), capture.held.as_slice()), (6, &[0, 1, 2][..]));
    for (i, frame) in capture.frames.iter().enumerate() {
        assert_pose(frame, i / 3);
        assert_eq!(blue(&capture, i), (i / 3) * 40 + (i % 3) * 7);
    }
}

#[test]
fn hold_out_rules() {
    let sample = samples::own();
    let held = |text: &str| {
        let options = CaptureOptions { hold_out: Some(text.parse().unwrap()), ..CaptureOptions::default() };
        open_with(&sample, options).held
    };
    assert_eq!(held("every=3"), [0, 3]);
    assert_eq!(held("none"), [0usize; 0]);
    assert_eq!(held("camera=cam02"), [4, 5]);
    let single = samples::dnerf();
    std::fs::remove_file(single.path("transforms_test.json")).unwrap();
    assert_eq!(open(&single).held, [0], "without a convention or a rig every 8th picture is held out");
}

#[test]
fn camera_extent() {
    let capture =
        open_with(&samples::own(), CaptureOptions { hold_out: Some(HoldOut::None), ..CaptureOptions::default() });
    let centers: Vec<[f64; 3]> = (0..3).map(|i| samples::pose(i).center_of()).collect();
    let mean: [f64; 3] = std::array::from_fn(|k| centers.iter().map(|c| c[k]).sum::<f64>() / 3.0);
    let far = centers.iter().map(|c| norm(sub(*c, mean))).fold(0.0, f64::max);
    let (center, radius) = capture.center_and_radius();
    assert!(norm(sub(center, mean)) < 1e-9 && (radius - 1.1 * far).abs() < 1e-9);
}

#[test]
fn a_part_of_a_capture_equals_that_part_of_the_whole() {
    let part = 1..2;
    for (sample, hold_out) in [
        (samples::own(), None),
        (samples::own(), Some("camera=cam02")),
        (samples::own(), Some("every=3")),
        (samples::dnerf(), None),
    ] {
        let options = || CaptureOptions { hold_out: hold_out.map(|t| t.parse().unwrap()), ..CaptureOptions::default() };
        let whole = open_with(&sample, options());
        let some = open_with(&sample, CaptureOptions { frames: vec![part.clone()], ..options() });
        assert_eq!(whole.take, some.take);
        assert_eq!((whole.take.pictures, whole.cameras.clone()), (whole.frames.len(), some.cameras.clone()));
        let named = |c: &Capture, of: &[usize]| {
            let frames = of.iter().map(|&i| &c.frames[i]).filter(|f| part.contains(&f.index));
            frames.map(|f| format!("{f:?}")).collect::<Vec<_>>()
        };
        for split in [|c: &Capture| c.train.clone(), |c: &Capture| c.held.clone()] {
            assert_eq!(named(&whole, &split(&whole)), named(&some, &split(&some)), "{hold_out:?}");
            assert!(split(&some).iter().all(|&i| part.contains(&some.frames[i].index)));
        }
    }
    // Of fixed cameras that are held out as a whole no more is listed than is requested.
    let own = open_with(&samples::own(), CaptureOptions { frames: vec![part], ..CaptureOptions::default() });
    assert_eq!((own.frames.len(), own.take.pictures, own.take.frames), (3, 6, 0..2));
}

trait Center {
    fn center_of(&self) -> [f64; 3];
}

impl Center for splat4d::math::Se3 {
    fn center_of(&self) -> [f64; 3] {
        self.inverse().translation
    }
}

#[test]
fn preflight_warns_of_few_cameras() {
    let mut capture = open(&samples::own());
    assert!(
        capture.preflight().iter().any(|f| f.severity == Severity::Warning && f.what.contains("extrapolated views"))
    );
    let uneven = |capture: &Capture| capture.preflight().iter().any(|f| f.what.contains("unevenly spaced"));
    assert!(uneven(&capture), "offsets of 10 ms in a 100 ms grid");
    for frame in &mut capture.frames {
        let tick = (frame.time.0 / 0.1).round() * 0.1;
        frame.time.0 = tick + (frame.time.0 - tick) / 5.0;
    }
    assert!(!uneven(&capture), "offsets of 2 ms, as they are measured of cameras that run together");
}

#[test]
fn near_is_a_share_of_the_extent_and_never_hides_points() {
    let sample = samples::own();
    let near = |share: f64| {
        let capture = open_with(&sample, CaptureOptions { near: share, ..CaptureOptions::default() });
        assert!(capture.frames.iter().all(|f| f.view.near == capture.frames[0].view.near), "held-out views, too");
        (capture.frames[0].view.near, capture)
    };
    let (little, capture) = near(0.05);
    let radius = capture.center_and_radius().1;
    assert!((little - 0.05 * radius).abs() < 1e-12, "{little} of {radius}");
    let close = capture.frames[capture.train[0]].view.unproject([12.0, 8.0], 0.6);
    let ply = std::fs::read_to_string(sample.path("points.ply")).unwrap();
    let moved = ply.replace("0 0 0.3 255", &format!("{} {} {} 255", close[0], close[1], close[2]));
    sample.write("points.ply", moved.as_bytes());
    assert!((near(0.9).0 - 0.3).abs() < 1e-6, "half way to the nearest point, not {}", near(0.9).0);
    sample.edit("capture.json", |value| drop(value.as_object_mut().unwrap().remove("points")));
    assert!((near(0.2).0 - 0.05 * radius).abs() < 1e-12, "a quarter where no points say how near things come");
    assert!(near(0.0).0 > 0.0, "the projection divides by z");
    for share in [-0.1, 1.0, f64::NAN] {
        let error = Capture::open(sample.root(), &CaptureOptions { near: share, ..CaptureOptions::default() });
        assert!(error.unwrap_err().to_string().contains("near is"));
    }
}

#[test]
fn stated_vignetting_is_removed_from_images() {
    let sample = samples::own();
    let load = |capture: Capture| {
        let (first, other) = (0, capture.frames.iter().position(|f| f.camera == 1).unwrap());
        let store = ImageStore::new(Arc::new(capture), 0);
        [first, other].map(|frame| store.load(frame).unwrap().to_picture().color)
    };
    let before = load(open(&sample));
    sample.edit("capture.json", |v| v["cameras"][0]["vignetting"] = json!([-0.3, 0.1]));
    let capture = open(&sample);
    assert!(capture.notes.iter().any(|note| note.contains("vignetting is removed") && note.ends_with(": 1.")));
    let after = load(capture);
    assert_eq!(after[1], before[1], "the other camera has none");
    let (width, height) = (after[0].width, after[0].height);
    let half = (0.5 * width as f64).hypot(0.5 * height as f64);
    let mut brighter = 0;
    for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
        let r2 = ((x as f64 + 0.5 - 0.5 * width as f64).hypot(y as f64 + 0.5 - 0.5 * height as f64) / half).powi(2);
        let gain = (1.0 - 0.3 * r2 + 0.1 * r2 * r2).powf(-1.0 / 2.2);
        let [old, new] = [&before[0], &after[0]].map(|image| f64::from(image.get(0, y, x)));
        assert!((new - (gain * old).min(1.0)).abs() < 1e-4, "({x}, {y}): {new} of {old}");
        brighter += usize::from(new > old + 0.01);
    }
    assert!(brighter > 10, "{brighter} of {width}x{height}");
    // A setting applies to cameras that state none.
    sample.edit("capture.json", |v| v["cameras"][1]["vignetting"] = json!([0.0]));
    let all = |vignetting| open_with(&sample, CaptureOptions { vignetting, ..CaptureOptions::default() });
    assert_eq!(load(all(Some([-0.2, 0.0, 0.0]))), after, "both cameras state theirs");
    sample.edit("capture.json", |v| v["cameras"][0].as_object_mut().unwrap().retain(|key, _| key != "vignetting"));
    assert_eq!(load(all(Some([-0.3, 0.1, 0.0]))), after);
    for wrong in [json!([-0.95]), json!([0.1, 0.1, 0.1, 0.1]), json!("strong")] {
        sample.edit("capture.json", |v| v["cameras"][0]["vignetting"] = wrong.clone());
        let refused = Capture::open(sample.root(), &CaptureOptions::default()).unwrap_err().to_string();
        assert!(refused.contains("vignetting"), "{refused}");
    }
}

#[test]
fn shutters_of_cameras_are_read_and_moving_cameras_have_their_velocity() {
    let sample = samples::own();
    sample.edit("capture.json", |v| {
        v["cameras"][0]["readout"] = json!(0.02);
        v["cameras"][0]["exposure_time"] = json!(0.01);
        v["cameras"][1]["readout"] = json!(0.0);
    });
    let of = |capture: &Capture, camera: usize| {
        let shutter = capture.frames.iter().find(|f| f.camera == camera).unwrap().shutter;
        shutter.map(|s| (s.readout, s.exposure, s.subframes))
    };
    let capture = open(&sample);
    assert_eq!([0, 1].map(|c| of(&capture, c)), [Some((0.02, 0.0, 1)), None]);
    assert!(capture.notes.iter().any(|note| note.contains("rolling shutter") && note.ends_with(": 1.")));
    let options = CaptureOptions { readout: Some(-0.01), subframes: 3, ..CaptureOptions::default() };
    let capture = open_with(&sample, options.clone());
    assert_eq!([0, 1].map(|c| of(&capture, c)), [Some((0.02, 0.01, 3)), None], "a stated 0 has priority");
    let capture = open_with(&sample, CaptureOptions { readout: None, ..options });
    assert_eq!(of(&capture, 0), Some((0.0, 0.01, 3)));
    sample.edit("capture.json", |v| v["cameras"][0]["readout"] = json!(20));
    let refused = Capture::open(sample.root(), &CaptureOptions::default()).unwrap_err().to_string();
    assert!(refused.contains("readout") && refused.contains("0.02"), "{refused}");
    // A camera that moves by a tenth along its x axis per frame.
    sample.edit("capture.json", |v| {
        let first = v["cameras"][0]["world_to_camera"].clone();
        let count = v["cameras"][0]["frames"].as_u64().or(v["frames"].as_u64()).unwrap_or(2);
        let moved = |i: u64| {
            let mut pose = first.clone();
            pose[0][3] = json!(first[0][3].as_f64().unwrap() + 0.1 * i as f64);
            pose
        };
        v["cameras"][0]["world_to_camera"] = (0..count).map(moved).collect();
        v["cameras"][0]["readout"] = json!(0.02);
    });
    let capture = open(&sample);
    for frame in capture.frames.iter().filter(|f| f.camera == 0) {
        let twist = frame.shutter.unwrap().twist;
        assert!((twist[0] - 0.1 * capture.fps).abs() < 1e-9 && twist[1..].iter().all(|x| x.abs() < 1e-9), "{twist:?}");
    }
}
