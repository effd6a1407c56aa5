//! Synthetic samples of every export; their poses round-trip.

use crate::capture::tests::samples::{self, FOCAL, HEIGHT, Sample, WIDTH};
use crate::capture::{Capture, CaptureKind, CaptureOptions, Timing};
use serde_json::json;
use splat4d::math::se3::{mat_mul, mat_vec, norm, sub};
use splat4d::math::{Se3, quat};
use splat4d::scene::Lens;

const COUNT: usize = 5;

fn open(sample: &Sample) -> Capture {
    Capture::open(sample.root(), &CaptureOptions::default()).unwrap()
}

fn refuse(sample: &Sample) -> String {
    Capture::open(sample.root(), &CaptureOptions::default()).unwrap_err().to_string()
}

/// The largest difference of the capture's poses to those that `of` gives, by the number in the image's name.
fn apart(capture: &Capture, of: impl Fn(usize) -> Se3) -> f64 {
    let one = |f: &crate::capture::Frame| {
        let name = f.image.file_stem().unwrap().to_string_lossy().into_owned();
        let digits: String = name.chars().filter(char::is_ascii_digit).collect();
        let (own, known) = (f.source.cam_from_world, of(digits.parse::<usize>().unwrap() % 100));
        let turn = own.rotation.iter().flatten().zip(known.rotation.iter().flatten()).map(|(a, b)| (a - b).abs());
        turn.fold(norm(sub(own.translation, known.translation)), f64::max)
    };
    capture.frames.iter().map(one).fold(0.0, f64::max)
}

/// Camera to world.
fn back(i: usize) -> Se3 {
    samples::pose(i).inverse()
}

/// The same in ARKit's camera axes.
fn arkit(i: usize) -> Se3 {
    let mut p = back(i);
    p.rotation.iter_mut().for_each(|row| (row[1], row[2]) = (-row[1], -row[2]));
    p
}

/// The end of the name of the one image that is declared missing, and is skipped.
fn one_missing(sample: &Sample) -> String {
    let capture = open(sample);
    assert_eq!(capture.frames.len(), COUNT - 1);
    let said = capture.warnings.iter().find_map(|w| w.strip_prefix("1 of 5 images are missing: ")).unwrap();
    let name = said.strip_suffix(". They are skipped.").unwrap();
    name.rsplit(['/', '\\']).next().unwrap().to_owned()
}

fn images(sample: &Sample, name: impl Fn(usize) -> String) {
    (0..COUNT).for_each(|i| sample.rgb(&name(i), i, 0));
}

#[test]
fn metashape_cameras_round_trip() {
    let sample = Sample::new(&["cameras.xml"]);
    images(&sample, |i| format!("images/IMG_{:04}.png", 7 * i + i));
    // The chunk is elsewhere, turned and twice as large.
    let turn = samples::pose(3).rotation;
    let (scale, shift) = (2.0, [10.0, -3.0, 1.0]);
    let text = |m: &[f64]| m.iter().map(|v| format!("{v:.17e}")).collect::<Vec<_>>().join(" ");
    let camera = |i: usize| {
        let world = back(i);
        let inverse = splat4d::math::se3::transpose(&turn);
        let rotation = mat_mul(&inverse, &world.rotation);
        let center = mat_vec(&inverse, sub(world.translation, shift)).map(|v| v / scale);
        let m: Vec<f64> = (0..4)
            .flat_map(|r| (0..4).map(move |c| (r, c)))
            .map(|(r, c)| {
                if r == 3 {
                    f64::from(u8::from(c == 3))
                } else if c == 3 {
                    center[r]
                } else {
                    rotation[r][c]
                }
            })
            .collect();
        let label = format!("IMG_{:04}", 7 * i + i);
        format!(
            "<camera id=\"{i}\" sensor_id=\"0\" component_id=\"0\" label=\"{label}\"><transform>{}</transform></camera>\n",
            text(&m)
        )
    };
    let cameras: String = (0..COUNT).map(camera).collect();
    let xml = format!(
        "<?xml version=\"1.0\"?>\n<document version=\"2.0.0\"><chunk label=\"a\" enabled=\"true\"><sensors>\
         <sensor id=\"0\" type=\"frame\"><resolution width=\"{WIDTH}\" height=\"{HEIGHT}\"/>\
         <calibration type=\"frame\" class=\"initial\"><f>1</f></calibration>\
         <calibration type=\"frame\" class=\"adjusted\"><f>{FOCAL}</f><cx>0.5</cx><cy>-0.25</cy><b1>1</b1><k1>-0.1</k1>\
         <p1>0.001</p1><p2>0.002</p2></calibration></sensor></sensors><components><component id=\"0\"><transform>\
         <rotation>{}</rotation><translation>{}</translation><scale>{scale}</scale></transform></component></components>\
         <cameras><group id=\"0\">{cameras}</group><camera id=\"9\" sensor_id=\"0\" label=\"IMG_9999\"/></cameras></chunk></document>",
        text(turn.as_flattened()),
        text(&shift)
    );
    sample.write("cameras.xml", xml.as_bytes());
    let capture = open(&sample);
    assert_eq!((capture.kind, capture.frames.len(), capture.timing), (CaptureKind::Metashape, COUNT, Timing::Moment));
    let off = apart(&capture, |number| samples::pose(number / 8));
    assert!(off < 1e-9, "{off}");
    let source = &capture.frames[0].source;
    let k = source.intrinsics;
    assert_eq!((k.fx, k.fy, k.cx, k.cy), (FOCAL + 1.0, FOCAL, 12.5, 7.75));
    assert!(matches!(source.lens, Lens::Brown { k, p: [0.002, 0.001], .. } if k[0] == -0.1));
    assert!(capture.warnings.iter().any(|w| w.contains("1 of 6 images have no pose")), "{:?}", capture.warnings);
    // Any name, given by its path; a lens that is not read states what to do.
    std::fs::rename(sample.path("cameras.xml"), sample.path("export.xml")).unwrap();
    assert_eq!(Capture::open(&sample.path("export.xml"), &CaptureOptions::default()).unwrap().frames.len(), COUNT);
    sample.write("export.xml", xml.replace("<p1>", "<k4>0.1</k4><p1>").as_bytes());
    assert!(refuse(&sample).contains("k4"));
    sample.write("export.xml", xml.replace("type=\"frame\"><res", "type=\"fisheye\"><res").as_bytes());
    assert!(matches!(open(&sample).frames[0].source.lens, Lens::ThinPrismFisheye { p: [0.002, 0.001], .. }));
    std::fs::remove_file(sample.path("images/IMG_0008.png")).unwrap();
    assert_eq!(one_missing(&sample), "IMG_0008");
}

/// Chunks, cameras without poses, and what else a real project may hold.
#[test]
fn the_chunk_with_cameras_is_read_and_none_is_an_error() {
    let sample = Sample::new(&["cameras.xml"]);
    images(&sample, |i| format!("IMG_{i:04}.png"));
    let camera = |i: usize, more: &str, posed: bool| {
        let p = back(i);
        let row =
            |k: usize| format!("{} {} {} {}", p.rotation[k][0], p.rotation[k][1], p.rotation[k][2], p.translation[k]);
        let transform = format!("<transform>{} {} {} 0 0 0 1</transform>", row(0), row(1), row(2));
        let inner = if posed { transform.as_str() } else { "" };
        format!("<camera id=\"{i}\" sensor_id=\"0\" label=\"IMG_{i:04}\" {more}>{inner}</camera>")
    };
    let all = |more: &str, posed: bool| (0..COUNT).map(|i| camera(i, more, posed)).collect::<String>();
    let chunk = |label: &str, cameras: &str, calibration: &str| {
        format!(
            "<chunk label=\"{label}\"><sensors><sensor id=\"0\" type=\"frame\"><resolution width=\"{WIDTH}\" height=\"{HEIGHT}\"/>\
             <calibration class=\"adjusted\">{calibration}</calibration></sensor></sensors><cameras>{cameras}</cameras></chunk>"
        )
    };
    let f = format!("<f>{FOCAL}</f>");
    let put = |chunks: &[String]| {
        sample.write("cameras.xml", format!("<document version=\"2.0.0\">{}</document>", chunks.concat()).as_bytes());
    };
    // An empty chunk is no reason to read nothing, nor to warn.
    put(&[chunk("empty", "", &f), chunk("full", &all("", true), &f)]);
    let capture = open(&sample);
    assert_eq!((capture.frames.len(), capture.warnings.len()), (COUNT, 0));
    assert!(apart(&capture, samples::pose) < 1e-9);
    // Of two with cameras the larger one is read, and both are named.
    put(&[chunk("small", &camera(0, "", true), &f), chunk("large", &all("", true), &f)]);
    let capture = open(&sample);
    let said = capture.warnings.join(" ");
    assert!(
        capture.frames.len() == COUNT && said.contains("large (5 cameras") && said.contains("small (1 cameras"),
        "{said}"
    );
    for (chunks, what) in [
        (chunk("a", &all("enabled=\"false\"", true), &f), "all of its 5 cameras are disabled"),
        (chunk("a", &all("", false), &f), "none of its 5 enabled cameras has a pose"),
        (chunk("a", "", &f), "no cameras"),
        (chunk("a", &all("", true), "<k1>0</k1>"), "no focal length"),
    ] {
        put(&[chunks]);
        let text = refuse(&sample);
        assert!(text.contains(what) && text.contains("cameras.xml"), "{text}");
    }
}

#[test]
fn realityscan_cameras_round_trip() {
    let sample = Sample::new(&["cameras.csv"]);
    images(&sample, |i| format!("DSC{i:05}.png"));
    let mut csv = "\u{feff}#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n".to_owned();
    for i in 0..COUNT {
        // The angles of camera to world: Rz(-heading) Rx(pitch) Ry(roll).
        let p = arkit(i);
        let (r, [x, y, z]) = (p.rotation, p.translation);
        let pitch = r[2][1].asin();
        let heading = r[0][1].atan2(r[1][1]);
        let roll = (-r[2][0]).atan2(r[2][2]);
        let [heading, pitch, roll] = [heading, pitch, roll].map(f64::to_degrees);
        let f = 36.0 * FOCAL / WIDTH as f64;
        csv += &format!(
            "DSC{i:05}.png,{x:.12},{y:.12},{z:.12},{heading:.12},{pitch:.12},{roll:.12},{f:.12},0.75,-0.3,0.01,0,0,0,0,0\n"
        );
    }
    sample.write("cameras.csv", csv.as_bytes());
    let capture = open(&sample);
    assert_eq!((capture.kind, capture.frames.len(), capture.up), (CaptureKind::RealityScan, COUNT, [0.0, 0.0, 1.0]));
    let off = apart(&capture, samples::pose);
    assert!(off < 1e-9, "{off}");
    let k = capture.frames[0].source.intrinsics;
    assert!((k.fx - FOCAL).abs() < 1e-9 && (k.cx - 12.5).abs() < 1e-9 && (k.cy - 7.8).abs() < 1e-9, "{k:?}");
    // A line with their number first, other names of columns, another ending.
    let renamed = csv.replacen("alt", "z", 1).replacen("#name", "#cameras 5\n#Name", 1);
    sample.write("cameras.csv", renamed.as_bytes());
    assert_eq!(apart(&open(&sample), samples::pose), off);
    std::fs::rename(sample.path("cameras.csv"), sample.path("cameras_rs.txt")).unwrap();
    assert_eq!(apart(&open(&sample), samples::pose), off);
    std::fs::remove_file(sample.path("cameras_rs.txt")).unwrap();
    // A column that is missing, none at all, and decimal commas between commas.
    for (text, what) in [
        (csv.replacen("heading", "yaw", 1), "lacks the columns heading"),
        (
            csv.lines().skip(1).map(|l| format!("{l}\n")).collect(),
            "table of images with numbers, without names of columns",
        ),
        (csv.replacen(".0", ",0", 1).replacen("0.", "0,", 5), "as there are columns"),
    ] {
        sample.write("cameras.csv", text.as_bytes());
        let said = refuse(&sample);
        assert!(said.contains(what) && said.contains("cameras.csv"), "{said}");
    }
    // A spreadsheet with decimal commas.
    let other = csv.replace(',', ";").replace('.', ",").replace(",png", ".png");
    sample.write("cameras.csv", other.as_bytes());
    assert_eq!(apart(&open(&sample), samples::pose), off);
    sample.write("cameras.csv", csv.replacen(",0.75,", ",wide,", 1).as_bytes());
    let wrong = refuse(&sample);
    assert!(wrong.contains("line 2") && wrong.contains("px is \"wide\""), "{wrong}");
    sample.write("cameras.csv", csv.as_bytes());
    std::fs::remove_file(sample.path("DSC00000.png")).unwrap();
    assert_eq!(one_missing(&sample), "DSC00000.png");
}

#[test]
fn polycam_keyframes_round_trip() {
    let sample = Sample::new(&[]);
    images(&sample, |i| format!("keyframes/images/17000{i:02}.png"));
    let camera = |i: usize| {
        let p = arkit(i);
        let mut v = json!({"fx": FOCAL, "fy": FOCAL + 1.0, "cx": 11.5, "cy": 8.5, "width": WIDTH, "height": HEIGHT,
            "timestamp": 1_700_000 + i, "blur_score": 50.0});
        for r in 0..3 {
            (0..3).for_each(|c| v[format!("t_{r}{c}")] = json!(p.rotation[r][c]));
            v[format!("t_{r}3")] = json!(p.translation[r]);
        }
        v.to_string()
    };
    (0..COUNT).for_each(|i| sample.write(&format!("keyframes/cameras/17000{i:02}.json"), camera(i).as_bytes()));
    let depth = image::ImageBuffer::from_pixel(WIDTH as u32 / 2, HEIGHT as u32 / 2, image::Luma([2500u16]));
    sample.save("keyframes/depth/1700001.png", depth);
    let capture = open(&sample);
    assert_eq!((capture.kind, capture.frames.len(), capture.up), (CaptureKind::Polycam, COUNT, [0.0, 1.0, 0.0]));
    let off = apart(&capture, samples::pose);
    assert!(off < 1e-9, "{off}");
    assert_eq!(capture.frames.iter().filter(|f| f.depth.is_some()).count(), 1);
    assert!(capture.warnings.iter().any(|w| w.contains("corrected")), "{:?}", capture.warnings);
    assert_eq!(capture.timing, Timing::Moment, "names are time stamps");
    // The optimised ones are preferred.
    images(&sample, |i| format!("keyframes/corrected_images/17000{i:02}.png"));
    (0..COUNT).for_each(|i| {
        sample.write(&format!("keyframes/corrected_cameras/17000{i:02}.json"), camera(i + 1).as_bytes());
    });
    assert!(apart(&open(&sample), |i| samples::pose(i + 1)) < 1e-9);
    std::fs::remove_file(sample.path("keyframes/corrected_images/1700002.png")).unwrap();
    assert_eq!(one_missing(&sample), "1700002.jpg");
}

#[test]
fn record3d_recordings_round_trip() {
    let sample = Sample::new(&["metadata.json"]);
    images(&sample, |i| format!("rgb/{i}.png"));
    let pose = |i: usize| {
        let p = arkit(i);
        let [w, x, y, z] = quat::from_rotation(&p.rotation);
        json!([x, y, z, w, p.translation[0], p.translation[1], p.translation[2]])
    };
    let times: Vec<f64> = (0..COUNT).map(|i| 100.0 + 0.05 * i as f64).collect();
    let mut value = json!({"w": WIDTH, "h": HEIGHT, "fps": 20, "K": [FOCAL, 0, 0, 0, FOCAL, 0, 12.5, 7.5, 1],
        "poses": (0..COUNT).map(pose).collect::<Vec<_>>(), "frameTimestamps": times});
    sample.write("metadata.json", value.to_string().as_bytes());
    let capture = open(&sample);
    assert_eq!((capture.kind, capture.timing, capture.cameras.len()), (CaptureKind::Record3d, Timing::Told, 1));
    assert!((capture.frames[4].time.0 - 0.2).abs() < 1e-9 && capture.fps == 20.0);
    assert!(apart(&capture, samples::pose) < 1e-9);
    assert_eq!(capture.frames[0].source.intrinsics.cx, 12.5);
    value["perFrameIntrinsicCoeffs"] = (0..COUNT).map(|i| json!([FOCAL + i as f64, FOCAL, 12, 8])).collect();
    sample.write("metadata.json", value.to_string().as_bytes());
    assert_eq!(open(&sample).frames[3].source.intrinsics.fx, FOCAL + 3.0);
    std::fs::remove_file(sample.path("rgb/4.png")).unwrap();
    assert_eq!(one_missing(&sample), "4.png");
    std::fs::rename(sample.path("rgb/3.png"), sample.path("rgb/three.png")).unwrap();
    assert!(refuse(&sample).contains("5 poses for 4 images"), "names that are no numbers say nothing of poses");
}
