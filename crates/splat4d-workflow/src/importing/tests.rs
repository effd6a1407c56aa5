//! Cameras whose images only a network relates.

use super::*;
use crate::events::ignore;
use crate::models::tests::onnx::{Attribute, Graph, IMAGES, of_channel};
use splat4d::math::align::apart;
use splat4d::math::{Rng, Se3};
use splat4d_import::video::Selection;
use splat4d_import::write::Format;

const SIZE: [u32; 2] = [320, 240];
const POINTS: usize = 120;
const CAMERAS: usize = 4;
/// Where the first pixel with positions is: away from the border, at which images are mended.
const FIRST: [i64; 2] = [8, 8];

/// A matcher that reads its key points in the images: 4 times red and a 64th of green, of two rows of pixels.
fn reader() -> Vec<u8> {
    let mut graph = Graph::default();
    graph.input("images", &[None, Some(3), None, None]);
    let weights = graph.floats(&[1, 3, 1, 1], &[4.0, 1.0 / 64.0, 0.0]);
    let columns = [FIRST[0], FIRST[0] + POINTS as i64];
    let rows: Vec<String> = (0..2)
        .map(|row| {
            let starts = graph.ints(&[2], &[FIRST[1] + row, columns[0]]);
            let ends = graph.ints(&[2], &[FIRST[1] + row + 1, columns[1]]);
            let axes = graph.ints(&[2], &[2, 3]);
            let part = graph.node("Slice", &["images", &starts, &ends, &axes], &[]);
            let weighted = graph.node("Mul", &[&part, &weights], &[]);
            let axis = graph.ints(&[1], &[1]);
            // [2, 1, points]
            graph.node("ReduceSum", &[&weighted, &axis], &[Attribute::Int("keepdims", 0)])
        })
        .collect();
    let both = graph.node("Concat", &[&rows[0], &rows[1]], &[Attribute::Int("axis", 1)]);
    graph.named("Transpose", &[&both], "keypoints", &[Attribute::Ints("perm", &[0, 2, 1])]);
    let pairs: Vec<i64> = (0..POINTS as i64).flat_map(|k| [0, k, k]).collect();
    let pairs = graph.ints(&[POINTS, 3], &pairs);
    let scores = graph.floats(&[POINTS], &[1.0; POINTS]);
    graph.named("Identity", &[&pairs], "matches", &[]);
    graph.named("Identity", &[&scores], "mscores", &[]);
    for (output, axes) in [("keypoints", 3), ("matches", 2), ("mscores", 1)] {
        graph.output(output, &vec![None; axes]);
    }
    graph.file()
}

/// Writes grey images of cameras a third of a turn around points, with the points' positions as colours; their poses.
fn films(folder: &Path) -> Vec<Se3> {
    let rng = Rng::new(5, "films", 0);
    let points: Vec<[f64; 3]> =
        (0..POINTS).map(|p| std::array::from_fn(|k| rng.uniform((3 * p + k) as u64) - 0.5)).collect();
    (0..CAMERAS)
        .map(|c| {
            let angle = 0.7 * c as f64;
            let eye = [3.0 * angle.sin(), -0.5 - 0.2 * c as f64, -3.0 * angle.cos()];
            let pose = Se3::look_at(eye, [0.0; 3], [0.0, -1.0, 0.0]);
            let mut image = image::RgbImage::from_pixel(SIZE[0], SIZE[1], image::Rgb([90; 3]));
            for (p, point) in points.iter().enumerate() {
                let x = pose.apply(*point);
                let at = [300.0 * x[0] / x[2] + 160.0, 300.0 * x[1] / x[2] + 120.0];
                assert!((0.0..320.0).contains(&at[0]) && (0.0..240.0).contains(&at[1]), "{at:?}");
                for (row, value) in at.into_iter().enumerate() {
                    // Keypoints of the network have the first pixel's centre at 0.
                    let value = value - 0.5;
                    let color = [(value / 4.0) as u8, (64.0 * (value % 4.0)) as u8, 90];
                    image.put_pixel(FIRST[0] as u32 + p as u32, FIRST[1] as u32 + row as u32, image::Rgb(color));
                }
            }
            let place = folder.join(format!("cam{c}"));
            std::fs::create_dir_all(&place).unwrap();
            (0..3).for_each(|k| image.save(place.join(format!("{k}.png"))).unwrap());
            pose
        })
        .collect()
}

#[test]
fn a_network_relates_cameras_whose_features_do_not() {
    let place = tempfile::tempdir().unwrap();
    let truth = films(&place.path().join("films"));
    let network = |name: &str, network: &[u8], text: &str| {
        let path = place.path().join(format!("{name}.onnx"));
        std::fs::write(&path, network).unwrap();
        std::fs::write(path.with_extension("toml"), text).unwrap();
        path
    };
    let reader = network(
        "reader",
        &reader(),
        "version = 1\n[input]\nrange = 255\npair = \"batch\"\n[output]\nkind = \"matches\"\n",
    );
    let depth =
        network("depth", &of_channel(0, 1.0, &IMAGES), "version = 1\n[input]\nrange = 1\n[output]\nkind = \"depth\"\n");
    let error = matcher(&depth, None).unwrap_err().to_string();
    assert!(error.contains("computes depth, not matches"), "{error}");
    let request = |name: &str, matcher: Option<Arc<dyn Matcher>>| Request {
        sound: false,
        synchronous: true,
        format: Format::Png,
        selection: Selection { size: None, ..Selection::default() },
        matcher,
        ..Request::new(vec![place.path().join("films")], place.path().join(name))
    };
    let run = |request: &Request| import(request, false, &AtomicBool::new(false), &ignore);
    let error = run(&request("without", None)).unwrap_err().to_string();
    assert!(error.contains("--matcher"), "{error}");
    let with = request("with", Some(matcher(&reader, None).unwrap()));
    let imported = run(&with).unwrap();
    assert!(imported.report.points >= POINTS / 2, "{} points", imported.report.points);
    let opened = open_capture(&with.folder, &Recipe::default()).unwrap();
    let mut poses = vec![None; CAMERAS];
    for frame in &opened.frames {
        poses[frame.camera] = Some(frame.view.cam_from_world);
    }
    let poses: Vec<Se3> = poses.into_iter().map(Option::unwrap).collect();
    let off = apart(&poses, &truth).unwrap();
    assert!(off.iter().all(|a| a.degrees < 0.5 && a.center < 0.02), "{off:?}");
}

/// Keypoints of a person, and frames of a film.
const JOINTS: usize = 17;
const FRAMES: usize = 90;

/// A network that reads the keypoints of one person in the image, as [`reader`] does.
fn person_reader() -> Vec<u8> {
    let mut graph = Graph::default();
    graph.input("image", &[None, Some(3), None, None]);
    let weights = graph.floats(&[1, 3, 1, 1], &[4.0, 1.0 / 64.0, 0.0]);
    let rows: Vec<String> = (0..2)
        .map(|row| {
            let starts = graph.ints(&[2], &[FIRST[1] + row, FIRST[0]]);
            let ends = graph.ints(&[2], &[FIRST[1] + row + 1, FIRST[0] + JOINTS as i64]);
            let axes = graph.ints(&[2], &[2, 3]);
            let part = graph.node("Slice", &["image", &starts, &ends, &axes], &[]);
            let weighted = graph.node("Mul", &[&part, &weights], &[]);
            let axis = graph.ints(&[1], &[1]);
            graph.node("ReduceSum", &[&weighted, &axis], &[Attribute::Int("keepdims", 0)])
        })
        .collect();
    let sure = graph.floats(&[1, 1, JOINTS], &[1.0; JOINTS]);
    let all = graph.node("Concat", &[&rows[0], &rows[1], &sure], &[Attribute::Int("axis", 1)]);
    graph.named("Transpose", &[&all], "people", &[Attribute::Ints("perm", &[0, 2, 1])]);
    graph.output("people", &[None; 3]);
    graph.file()
}

/// Where a joint of someone who walks in a circle and swings the limbs is.
fn joint(k: usize, t: f64) -> [f64; 3] {
    let (side, height) = ([-1.0, 0.0, 1.0][k % 3], 0.15 + 0.1 * k as f64);
    let angle = 0.9 * t + 0.3 * side * (4.0 * t + k as f64).sin();
    let far = 0.8 + 0.2 * side;
    [far * angle.cos(), far * angle.sin(), height + 0.03 * (8.0 * t + k as f64).sin()]
}

/// Films of four cameras at right angles; their poses.
fn films_of_a_person(folder: &Path) -> Vec<Se3> {
    (0..CAMERAS)
        .map(|c| {
            let angle = std::f64::consts::FRAC_PI_2 * c as f64 + 0.1 * (c as f64).sin();
            let eye = [4.0 * angle.cos(), (4.0 + 0.2 * c as f64) * angle.sin(), 1.4 + 0.2 * c as f64];
            let pose = Se3::look_at(eye, [0.0, 0.0, 0.9], [0.0, 0.0, 1.0]);
            let place = folder.join(format!("cam{c}"));
            std::fs::create_dir_all(&place).unwrap();
            for frame in 0..FRAMES {
                let mut image = image::RgbImage::from_pixel(SIZE[0], SIZE[1], image::Rgb([90; 3]));
                for k in 0..JOINTS {
                    let x = pose.apply(joint(k, frame as f64 / 30.0));
                    let at = [233.0 * x[0] / x[2] + 160.0, 233.0 * x[1] / x[2] + 120.0];
                    for (row, value) in at.into_iter().enumerate() {
                        let value = value - 0.5;
                        let color = [(value / 4.0) as u8, (64.0 * (value % 4.0)) as u8, 90];
                        image.put_pixel(
                            (FIRST[0] as usize + k) as u32,
                            FIRST[1] as u32 + row as u32,
                            image::Rgb(color),
                        );
                    }
                }
                image.save(place.join(format!("{frame:03}.png"))).unwrap();
            }
            pose
        })
        .collect()
}

#[test]
fn a_network_that_finds_people_calibrates_cameras_at_right_angles() {
    let place = tempfile::tempdir().unwrap();
    let truth = films_of_a_person(&place.path().join("films"));
    let network = place.path().join("people.onnx");
    std::fs::write(&network, person_reader()).unwrap();
    let text = "version = 1\n[input]\nrange = 255\n[output]\nkind = \"people\"\n";
    std::fs::write(network.with_extension("toml"), text).unwrap();
    assert!(matcher(&network, None).unwrap_err().to_string().contains("computes people, not matches"));
    let request = Request {
        sound: false,
        synchronous: true,
        format: Format::Png,
        selection: Selection { size: None, ..Selection::default() },
        keypoints: Some(keypoints(&network, None).unwrap()),
        ..Request::new(vec![place.path().join("films")], place.path().join("take"))
    };
    let imported = import(&request, false, &AtomicBool::new(false), &ignore).unwrap();
    assert!(
        imported.report.guesses.iter().any(|g| g.contains("keypoints of 1 people")),
        "{:?}",
        imported.report.guesses
    );
    let opened = open_capture(&request.folder, &Recipe::default()).unwrap();
    let pose = |c: usize| opened.frames.iter().find(|f| f.camera == c).unwrap().view.cam_from_world;
    let off = apart(&(0..CAMERAS).map(pose).collect::<Vec<_>>(), &truth).unwrap();
    assert!(off.iter().all(|a| a.degrees < 1.0 && a.center < 0.02), "{off:?}");
    let folder = keypoints(&place.path().join("detections"), None).unwrap();
    assert!(matches!(folder, Keypoints::Given(_)), "{folder:?}");
}
