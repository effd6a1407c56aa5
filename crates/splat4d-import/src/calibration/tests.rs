use super::*;
use splat4d::math::se3::mat_vec;
use splat4d::scene::Planes;
use std::fmt::Write;

/// What a calibration is written from and must be read as, to the sixth decimal.
const EXACT: f64 = 1e-6;

/// Two known cameras with a lens, of 1280x720.
fn truth() -> Vec<Calibrated> {
    let lens = Lens::Brown { k: [-0.12, 0.034, 0.0056, 0.0, 0.0, 0.0], p: [0.0007, -0.0008], s: [0.0; 4] };
    let camera = |name: &str, x: f64| Calibrated {
        names: vec![name.into()],
        size: Some([1280, 720]),
        intrinsics: Intrinsics { fx: 901.25, fy: 902.5, cx: 633.125, cy: 366.0 },
        lens,
        pose: Some(Se3::look_at([x, 1.5, -3.25], [0.1, 0.2, 0.3], [0.0, -1.0, 0.0])),
    };
    vec![camera("left", -1.75), camera("right", 2.125)]
}

/// Axis times angle of a rotation.
fn rvec(r: &[[f64; 3]; 3]) -> [f64; 3] {
    let axis = [r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]];
    let sine = 0.5 * norm(axis);
    let angle = sine.atan2(0.5 * (r[0][0] + r[1][1] + r[2][2] - 1.0));
    axis.map(|v| 0.5 * v * angle / sine)
}

fn list(values: &[f64]) -> String {
    values.iter().map(|v| format!("{v:.12}")).collect::<Vec<_>>().join(", ")
}

/// K of OpenCV, row by row.
fn k(c: &Calibrated) -> [f64; 9] {
    let i = &c.intrinsics;
    [i.fx, 0.0, i.cx - 0.5, 0.0, i.fy, i.cy - 0.5, 0.0, 0.0, 1.0]
}

fn terms(c: &Calibrated) -> [f64; 5] {
    let Lens::Brown { k, p, .. } = c.lens else { panic!("the lens is bent") };
    [k[0], k[1], p[0], p[1], k[2]]
}

fn pose_of(c: &Calibrated) -> Se3 {
    c.pose.expect("it is placed")
}

fn same(found: &Calibration, wanted: &[Calibrated]) {
    assert_eq!(found.cameras.len(), wanted.len(), "{found:?}");
    for w in wanted {
        let f = found.cameras.iter().find(|c| c.names[0] == w.names[0]).unwrap_or_else(|| panic!("{found:?}"));
        let near = |a: f64, b: f64, what: &str| assert!((a - b).abs() < EXACT, "{}: {what} {a} {b}", w.names[0]);
        let (i, j) = (&f.intrinsics, &w.intrinsics);
        for (a, b) in [(i.fx, j.fx), (i.fy, j.fy), (i.cx, j.cx), (i.cy, j.cy)] {
            near(a, b, "intrinsics");
        }
        terms(f).iter().zip(terms(w)).for_each(|(a, b)| near(*a, b, "distortion"));
        match (&f.pose, &w.pose) {
            (Some(p), Some(q)) => {
                let numbers = |s: &Se3| s.rotation.iter().flatten().chain(&s.translation).copied().collect::<Vec<_>>();
                numbers(p).iter().zip(numbers(q)).for_each(|(a, b)| near(*a, b, "pose"));
            }
            (None, None) => {}
            other => panic!("{other:?}"),
        }
    }
}

/// The calibration that these files in one folder are.
fn folder(files: &[(&str, String)]) -> Result<Calibration> {
    let dir = tempfile::tempdir().unwrap();
    for (name, text) in files {
        let path = dir.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }
    read(dir.path())
}

fn refused(files: &[(&str, String)], word: &str) {
    let why = folder(files).expect_err(word).to_string();
    assert!(why.contains(word), "{why}\nshould say: {word}");
}

fn yaml_matrix(key: &str, [rows, cols]: [usize; 2], data: &[f64]) -> String {
    let data = list(data).replacen(", ", ",\n       ", 3);
    format!("{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]\n")
}

fn opencv_yaml(c: &Calibrated) -> String {
    let p = pose_of(c);
    format!(
        "%YAML:1.0\n---\ncalibration_time: \"Thu 01 Jan 2026\"\nimage_width: 1280\nimage_height: 720\n{}{}{}{}",
        yaml_matrix("camera_matrix", [3, 3], &k(c)),
        yaml_matrix("distortion_coefficients", [5, 1], &terms(c)),
        yaml_matrix("rotation", [3, 3], p.rotation.as_flattened()),
        yaml_matrix("translation", [3, 1], &p.translation)
    )
}

fn xml_matrix(key: &str, [rows, cols]: [usize; 2], data: &[f64]) -> String {
    format!(
        "<{key} type_id=\"opencv-matrix\"><rows>{rows}</rows><cols>{cols}</cols><dt>d</dt><data>\n{}</data></{key}>\n",
        list(data).replace(',', "")
    )
}

fn storage(inside: &str) -> String {
    format!("<?xml version=\"1.0\"?>\n<opencv_storage>\n{inside}</opencv_storage>\n")
}

fn tables(cameras: &[Calibrated], more: &str) -> String {
    let mut out = String::new();
    for (n, c) in cameras.iter().enumerate() {
        let (k, p) = (k(c), pose_of(c));
        let _ = write!(
            out,
            "[cam_{n}]\nname = \"{}\"\nsize = [ 1280.0, 720 ]\nmatrix = [ [ {}], [ {}], [ 0.0, 0.0, 1.0]]\ndistortions = [ {}]\n\
             rotation = [ {}]\ntranslation = [ {}]\n{more}\n",
            c.names[0],
            list(&k[..3]),
            list(&k[3..6]),
            list(&terms(c)),
            list(&rvec(&p.rotation)),
            list(&p.translation)
        );
    }
    out + "[metadata]\nadjusted = false\nerror = 0.0\n"
}

fn easymocap(cameras: &[Calibrated]) -> [String; 2] {
    let names: String = cameras.iter().map(|c| format!("  - \"{}\"\n", c.names[0])).collect();
    let (mut intri, mut extri) =
        (format!("%YAML:1.0\n---\nnames:\n{names}"), format!("%YAML:1.0\n---\nnames:\n{names}"));
    for c in cameras {
        let (name, p) = (&c.names[0], pose_of(c));
        intri += &yaml_matrix(&format!("K_{name}"), [3, 3], &k(c));
        intri += &yaml_matrix(&format!("dist_{name}"), [1, 5], &terms(c));
        extri += &yaml_matrix(&format!("R_{name}"), [3, 1], &rvec(&p.rotation));
        extri += &yaml_matrix(&format!("Rot_{name}"), [3, 3], p.rotation.as_flattened());
        extri += &yaml_matrix(&format!("T_{name}"), [3, 1], &p.translation);
    }
    [intri, extri]
}

fn qualisys(cameras: &[Calibrated]) -> String {
    let mut out = String::from("<?xml version='1.0'?>\n<calibration source=\"x\"><cameras>\n");
    for c in cameras {
        let (p, i, t) = (pose_of(c), &c.intrinsics, terms(c));
        let center = p.inverse().translation;
        let mut r = String::new();
        for (row, sign) in [(0, 1.0), (1, -1.0), (2, -1.0)] {
            for column in 0..3 {
                let _ = write!(r, " r{}{}=\"{:.12}\"", row + 1, column + 1, sign * p.rotation[row][column]);
            }
        }
        let _ = writeln!(
            out,
            "<camera active=\"1\" serial=\"{}\" model=\"none\"><fov_video left=\"0\" top=\"0\" right=\"1279\" bottom=\"719\"/>\
             <transform{r} x=\"{:.9}\" y=\"{:.9}\" z=\"{:.9}\"/><intrinsic focalLengthU=\"{:.9}\" focalLengthV=\"{:.9}\" \
             centerPointU=\"{:.9}\" centerPointV=\"{:.9}\" radialDistortion1=\"{}\" radialDistortion2=\"{}\" \
             radialDistortion3=\"{}\" tangentalDistortion1=\"{}\" tangentalDistortion2=\"{}\"/></camera>",
            c.names[0],
            1e3 * center[0],
            1e3 * center[1],
            1e3 * center[2],
            64.0 * i.fx,
            64.0 * i.fy,
            64.0 * i.cx,
            64.0 * i.cy,
            t[0],
            t[1],
            t[4],
            t[2],
            t[3]
        );
    }
    out + "</cameras></calibration>\n"
}

fn transforms(cameras: &[Calibrated]) -> String {
    let frame = |c: &Calibrated| {
        let (i, t, w) = (&c.intrinsics, terms(c), pose_of(c).inverse());
        let row = |r: usize| [w.rotation[r][0], -w.rotation[r][1], -w.rotation[r][2], w.translation[r]];
        serde_json::json!({
            "file_path": format!("images/{}.jpg", c.names[0]),
            "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            "fl_x": i.fx, "fl_y": i.fy, "cx": i.cx, "cy": i.cy, "w": 1280, "h": 720,
            "k1": t[0], "k2": t[1], "k3": t[4], "p1": t[2], "p2": t[3],
        })
    };
    serde_json::json!({"frames": cameras.iter().map(frame).collect::<Vec<_>>()}).to_string()
}

fn own(cameras: &[Calibrated]) -> String {
    let camera = |c: &Calibrated| {
        let (i, p) = (&c.intrinsics, pose_of(c));
        let Lens::Brown { k, p: tangential, s } = c.lens else { panic!("the lens is bent") };
        let row = |r: usize| [p.rotation[r][0], p.rotation[r][1], p.rotation[r][2], p.translation[r]];
        serde_json::json!({
            "name": c.names[0], "width": 1280, "height": 720, "fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy,
            "distortion": {"model": "opencv", "k": k, "p": tangential, "s": s},
            "world_to_camera": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
        })
    };
    serde_json::json!({"version": 1, "cameras": cameras.iter().map(camera).collect::<Vec<_>>()}).to_string()
}

fn colmap_text(cameras: &[Calibrated]) -> [String; 2] {
    let (mut first, mut second) = (String::from("# cameras\n"), String::from("# images\n"));
    for (n, c) in cameras.iter().enumerate() {
        let (i, t, p) = (&c.intrinsics, terms(c), pose_of(c));
        let v = rvec(&p.rotation);
        let half = 0.5 * norm(v);
        let q = [half.cos(), v[0], v[1], v[2]];
        let q = [
            q[0],
            q[1] * half.sin() / (2.0 * half),
            q[2] * half.sin() / (2.0 * half),
            q[3] * half.sin() / (2.0 * half),
        ];
        let numbers = |v: &[f64]| v.iter().map(|v| format!("{v:.12}")).collect::<Vec<_>>().join(" ");
        let _ = writeln!(
            first,
            "{} FULL_OPENCV 1280 720 {} {} 0 0 0",
            n + 1,
            numbers(&[i.fx, i.fy, i.cx, i.cy, t[0], t[1], t[2], t[3]]),
            numbers(&[t[4]])
        );
        let _ =
            writeln!(second, "{} {} {} {} {}.png\n", n + 1, numbers(&q), numbers(&p.translation), n + 1, c.names[0]);
    }
    [first, second]
}

fn colmap_binary(cameras: &[Calibrated]) -> [Vec<u8>; 2] {
    let count = (cameras.len() as u64).to_le_bytes().to_vec();
    let (mut first, mut second) = (count.clone(), count);
    let put = |to: &mut Vec<u8>, values: &[f64]| values.iter().for_each(|v| to.extend(v.to_le_bytes()));
    for (n, c) in cameras.iter().enumerate() {
        let (i, t, p) = (&c.intrinsics, terms(c), pose_of(c));
        let id = n as u32 + 1;
        // FULL_OPENCV is number 6.
        first.extend(id.to_le_bytes());
        first.extend(6u32.to_le_bytes());
        first.extend(1280u64.to_le_bytes());
        first.extend(720u64.to_le_bytes());
        put(&mut first, &[i.fx, i.fy, i.cx, i.cy, t[0], t[1], t[2], t[3], t[4], 0.0, 0.0, 0.0]);
        let v = rvec(&p.rotation);
        let half = 0.5 * norm(v);
        let part = half.sin() / (2.0 * half);
        second.extend(id.to_le_bytes());
        put(&mut second, &[half.cos(), v[0] * part, v[1] * part, v[2] * part]);
        put(&mut second, &p.translation);
        second.extend(id.to_le_bytes());
        second.extend(format!("{}.png\0", c.names[0]).bytes());
        second.extend(0u64.to_le_bytes());
    }
    [first, second]
}

#[test]
fn opencv_and_openpose_files_of_each_camera_are_read() {
    let truth = truth();
    let yaml: Vec<(&str, String)> =
        truth.iter().zip(["left.yml", "right_calib.yaml"]).map(|(c, f)| (f, opencv_yaml(c))).collect();
    let found = folder(&yaml).unwrap();
    same(&found, &truth);
    assert_eq!((found.cameras[0].size, found.unit, found.posed()), (Some([1280, 720]), Unit::Unstated, true));
    let xml = |c: &Calibrated| {
        let p = pose_of(c);
        storage(&format!(
            "<imageWidth>1280</imageWidth><imageHeight>720</imageHeight>{}{}{}{}",
            xml_matrix("cameraMatrix", [3, 3], &k(c)),
            xml_matrix("distCoeffs", [1, 5], &terms(c)),
            xml_matrix("rvec", [3, 1], &rvec(&p.rotation)),
            xml_matrix("tvec", [3, 1], &p.translation)
        ))
    };
    same(
        &folder(&[("left.xml", xml(&truth[0])), ("right.xml", xml(&truth[1])), ("notes.md", "hello".into())]).unwrap(),
        &truth,
    );
    // OpenPose: [R | t] under the camera matrix' name, eight terms.
    let openpose = |c: &Calibrated| {
        let (p, t) = (pose_of(c), terms(c));
        let rows: Vec<f64> = (0..3).flat_map(|r| [p.rotation[r].to_vec(), vec![p.translation[r]]].concat()).collect();
        storage(&format!(
            "{}{}{}",
            xml_matrix("CameraMatrix", [3, 4], &rows),
            xml_matrix("Intrinsics", [3, 3], &k(c)),
            xml_matrix("Distortion", [8, 1], &[t[0], t[1], t[2], t[3], t[4], 0.0, 0.0, 0.0])
        ))
    };
    let found = folder(&[("left.xml", openpose(&truth[0])), ("right.xml", openpose(&truth[1]))]).unwrap();
    same(&found, &truth);
    assert_eq!(found.cameras[0].size, None);
    // JSON, a key for each camera.
    let json = |c: &Calibrated| {
        let (k, p) = (k(c), pose_of(c));
        serde_json::json!({"K": [k[..3], k[3..6], k[6..]], "dist": terms(c), "R": p.rotation, "t": p.translation.map(|v| [v])})
    };
    let both = serde_json::json!({"left": json(&truth[0]), "right": json(&truth[1])}).to_string();
    same(&folder(&[("calibration.json", both)]).unwrap(), &truth);
    // A lens and no position.
    let alone: Vec<(&str, String)> =
        yaml.iter().map(|(f, t)| (*f, t.split("rotation:").next().unwrap().to_owned())).collect();
    let bare: Vec<Calibrated> = truth.iter().map(|c| Calibrated { pose: None, ..c.clone() }).collect();
    same(&folder(&alone).unwrap(), &bare);
    refused(&[yaml[0].clone(), alone[1].clone()], "have no position");
}

#[test]
fn bad_opencv_files_are_explained() {
    let c = &truth()[0];
    let good = opencv_yaml(c);
    let with = |from: &str, to: &str| {
        assert!(good.contains(from), "{good}");
        vec![("left.yml", good.replacen(from, to, 1))]
    };
    refused(&with("camera_matrix", "kamera"), "camera matrix is missing");
    refused(&with("901.250000000000", ".Nan"), "NaN");
    refused(&with("901.250000000000", "-901.25"), "focal length");
    refused(&with("rows: 3", "rows: 4"), "stated number of values");
    refused(&with("image_width: 1280", "image_width: 0"), "image size");
    refused(&with("rows: 5", "rows: 6"), "distortion_coefficients");
    let six = good.replacen("rows: 5", "rows: 6", 1).replacen(&list(&[c.intrinsics.fx])[..4], "901.", 1);
    let six = six.replacen("0.005600000000 ]", "0.0056, 0.1 ]", 1);
    refused(&[("left.yml", six)], "6 distortion terms");
    refused(&with("calibration_time", "distortion_model: double_sphere\ncalibration_time"), "double_sphere");
    refused(&[("left.yml", good.clone()), ("left.yaml", good.clone())], "twice");
    refused(&[("a.txt", "nothing here".into())], "no calibration");
    refused(&[("left.xml", "<opencv_storage><a>".into())], "XML");
    refused(&[], "no calibration");
    refused(
        &[("left.yml", good.replacen("image_width: 1280", "a: &a [1, 2]\nb: [*a, *a]\nimage_width: 1280", 1))],
        "anchors",
    );
    let mirrored = pose_of(c).rotation.map(|row| [-row[0], row[1], row[2]]);
    let text = good.replace(
        &yaml_matrix("rotation", [3, 3], pose_of(c).rotation.as_flattened()),
        &yaml_matrix("rotation", [3, 3], mirrored.as_flattened()),
    );
    refused(&[("left.yml", text)], "mirrored");
}

#[test]
fn tables_of_pose2sim_and_anipose_are_read() {
    let truth = truth();
    let found = folder(&[("Calib_scene.toml", tables(&truth, "fisheye = false"))]).unwrap();
    same(&found, &truth);
    assert_eq!(found.cameras[1].names, ["right", "cam_1"]);
    // A fisheye has four terms.
    let good = tables(&truth, "fisheye = true");
    let four =
        good.replace(&format!("distortions = [ {}]", list(&terms(&truth[0]))), "distortions = [ 0.1, 0.2, 0.3, 0.4]");
    let found = folder(&[("a.toml", four)]).unwrap();
    assert_eq!(found.cameras[0].lens, Lens::Fisheye { k: [0.1, 0.2, 0.3, 0.4] });
    refused(&[("a.toml", good)], "a fisheye with 5");
    let good = tables(&truth, "");
    refused(&[("a.toml", good.replacen("matrix", "nomatrix", 1))], "camera left: its camera matrix is missing");
    refused(&[("a.toml", good.replacen("901.250000000000", "nan", 1))], "NaN");
    refused(&[("a.toml", good.replace("\"right\"", "\"left\""))], "twice");
    refused(&[("a.toml", good.replacen("size = [ 1280.0, 720 ]", "size = [ 1280.0 ]", 1))], "image size");
    refused(&[("a.toml", good.replacen("distortions = [", "distortions = [ 1.0, 2.0,", 1))], "7 distortion terms");
    refused(&[("a.toml", good.replacen("[cam_1]", "[cam_1", 1))], "TOML");
    // Caliscope names cameras by number, their videos port_N.
    let ports = good.replace("name = \"left\"", "port = 3").replace("name = \"right\"", "port = 7");
    let found = folder(&[("config.toml", ports)]).unwrap();
    assert!(found.cameras[1].names.contains(&"port_7".to_owned()), "{found:?}");
}

#[test]
fn easymocap_files_are_joined() {
    let truth = truth();
    let [intri, extri] = easymocap(&truth);
    same(&folder(&[("intri.yml", intri.clone()), ("extri.yml", extri.clone())]).unwrap(), &truth);
    let bare: Vec<Calibrated> = truth.iter().map(|c| Calibrated { pose: None, ..c.clone() }).collect();
    same(&folder(&[("intri.yml", intri.clone())]).unwrap(), &bare);
    refused(&[("extri.yml", extri.clone())], "camera matrix is missing");
    refused(&[("intri.yml", intri.replace("K_right", "K_write"))], "K_right is missing");
    refused(&[("intri.yml", intri.replacen("901.250000000000", ".Nan", 1))], "NaN");
    refused(&[("intri.yml", intri.replacen("  - \"right\"", "  - \"left\"", 1))], "twice");
    refused(
        &[("intri.yml", intri), ("extri.yml", extri.replacen("rows: 3\n   cols: 1", "rows: 2\n   cols: 1", 1))],
        "R_left",
    );
}

#[test]
fn qualisys_files_are_read_in_metres() {
    let truth = truth();
    let good = qualisys(&truth);
    let found = folder(&[("a.qca.txt", good.clone())]).unwrap();
    same(&found, &truth);
    assert_eq!((found.unit, found.cameras[0].size), (Unit::Metre, Some([1280, 720])));
    assert!(found.about_lengths().contains("metres"), "{}", found.about_lengths());
    refused(&[("a.xml", good.replacen("<intrinsic", "<intrinsics", 1))], "<intrinsic> is missing");
    refused(&[("a.xml", good.replacen("focalLengthU=\"", "focalLengthU=\"nan", 1))], "focalLengthU");
    refused(&[("a.xml", good.replace("right\"", "left\""))], "twice");
    refused(&[("a.xml", good.replacen("right=\"1279\"", "right=\"-5\"", 1))], "image size");
    let off = folder(&[("a.xml", good.replacen("active=\"1\"", "active=\"0\"", 1))]).unwrap();
    assert_eq!((off.cameras.len(), off.notes.len()), (1, 1));
}

#[test]
fn transforms_captures_and_colmap_are_read_without_images() {
    let truth = truth();
    let good = transforms(&truth);
    same(&folder(&[("transforms.json", good.clone())]).unwrap(), &truth);
    refused(
        &[("t.json", good.replace("\"k1\":-0.12", "\"k1\":-0.12,\"camera_model\":\"EQUIRECTANGULAR\""))],
        "EQUIRECTANGULAR",
    );
    refused(&[("t.json", good.replace("\"fl_x\":901.25,", ""))], "fl_x");
    refused(&[("t.json", good.replace("1280", "NaN"))], "JSON");
    let good = own(&truth);
    same(&folder(&[("other.json", good.clone())]).unwrap(), &truth);
    refused(&[("other.json", good.replacen("\"fx\"", "\"gx\"", 1))], "fx is missing");
    refused(&[("other.json", good.replace("\"right\"", "\"left\""))], "twice");
    refused(&[("other.json", good.replacen("\"opencv\"", "\"ftheta\"", 1))], "ftheta");
    let [first, second] = colmap_text(&truth);
    let text = [("sparse/0/cameras.txt", first.clone()), ("sparse/0/images.txt", second.clone())];
    let found = folder(&text).unwrap();
    same(&found, &truth);
    assert_eq!(found.dialects, ["COLMAP"]);
    refused(&[("cameras.txt", first.replace("FULL_OPENCV", "SPLINED")), ("images.txt", second.clone())], "SPLINED");
    refused(&[("cameras.txt", first), ("images.txt", second.replace("right.png", "left.png"))], "several positions");
    let dir = tempfile::tempdir().unwrap();
    let [first, second] = colmap_binary(&truth);
    std::fs::write(dir.path().join("cameras.bin"), &first).unwrap();
    std::fs::write(dir.path().join("images.bin"), &second).unwrap();
    same(&read(dir.path()).unwrap(), &truth);
    std::fs::write(dir.path().join("images.bin"), &second[..40]).unwrap();
    assert!(read(dir.path()).unwrap_err().to_string().contains("truncated"));
}

#[test]
fn truncated_and_mutated_calibrations_never_panic() {
    let truth = truth();
    let texts = [
        opencv_yaml(&truth[0]),
        tables(&truth, ""),
        easymocap(&truth)[0].clone(),
        qualisys(&truth),
        transforms(&truth),
        own(&truth),
        format!("{}1{}", "[".repeat(100_000), "]".repeat(100_000)),
        format!("{}x", "- ".repeat(50_000)),
        format!("{}{}", "<a>".repeat(5_000), "</a>".repeat(5_000)),
        "a: &a [1]\nb: *a\n".into(),
    ];
    let mut whole = 0;
    for text in &texts {
        let step = (text.len() / 60).max(1);
        for cut in (0..=text.len()).step_by(step).chain([text.len()]) {
            let Some(part) = text.get(..cut) else { continue };
            whole += usize::from(Tree::parse(part).is_ok());
            if text.len() < 10_000 {
                // Whatever it is, it is read or explained.
                drop(folder(&[("a.any", part.to_owned())]));
            }
        }
    }
    assert!(whole > 5, "{whole}");
}

fn called(names: &[&str]) -> Calibration {
    let camera = |name: &&str| Calibrated { names: vec![name.to_string()], ..truth()[0].clone() };
    Calibration { cameras: names.iter().map(camera).collect(), ..Calibration::default() }
}

#[test]
fn videos_are_matched_by_name_and_never_by_order() {
    let size = [1280, 720];
    let assign = |cameras: &[&str], videos: &[&str]| {
        let videos: Vec<Video<'_>> = videos.iter().map(|name| Video { name, size }).collect();
        assign(&called(cameras), &videos)
    };
    assert_eq!(
        assign(&["a", "b", "c"], &["B", "a"]).unwrap(),
        (vec![1, 0], vec!["Cameras of the calibration without a video: c.".into()])
    );
    let (found, notes) = assign(&["26580", "26581"], &["take_Miqus_2_26581", "take_Miqus_1_26580"]).unwrap();
    assert_eq!(found, [1, 0]);
    assert!(notes[0].contains("take_Miqus_2_26581 is 26581"), "{notes:?}");
    let (found, notes) = assign(&["0", "1", "2"], &["GX02", "GX01", "GX03"]).unwrap();
    assert_eq!(found, [1, 0, 2]);
    assert!(notes.len() == 1 && notes[0].contains("GX02 is 1"), "{notes:?}");
    let no = assign(&["left", "right"], &["one", "two"]).unwrap_err().to_string();
    assert!(["left, right", "one, two", "not guessed"].iter().all(|w| no.contains(w)), "{no}");
    for (cameras, videos) in [
        // Other numbers, numbers that are not all there are, one of three, two for one.
        (&["cam_0", "cam_1"][..], &["GX0012", "GX0019"][..]),
        (&["0", "1", "2"], &["GX0", "GX1"]),
        (&["left", "right"], &["left", "middle"]),
        (&["left", "left2"], &["x_left_a", "y_left_b"]),
    ] {
        assert!(assign(cameras, videos).is_err(), "{cameras:?} {videos:?}");
    }
}

#[test]
fn intrinsics_follow_the_size_and_other_shapes_are_refused() {
    let camera = &truth()[0];
    let whole = |camera: &Calibrated, video, stored| fitted(camera, video, stored, [0.0; 4]).map(|f| f.0);
    let half = whole(camera, [2560, 1440], [640, 360]).unwrap();
    assert_eq!((half.intrinsics.fx, half.intrinsics.cy, half.size), (901.25 / 2.0, 183.0, Some([640, 360])));
    assert!(whole(camera, [854, 480], [854, 480]).is_ok(), "sides are rounded");
    let wide = whole(camera, [1920, 1200], [1920, 1200]).unwrap_err().to_string();
    assert!(wide.contains("1920x1200") && wide.contains("1280x720") && wide.contains("no black bars"), "{wide}");
    assert!(shape(camera, [720, 1280]).unwrap_err().to_string().contains("turned"));
    assert!(shape(camera, [1280, 200]).is_err(), "nobody's bars are so wide");
    let bare = Calibrated { size: None, ..camera.clone() };
    assert_eq!(whole(&bare, [1280, 720], [1280, 720]).unwrap().intrinsics, camera.intrinsics);
    assert!(whole(&bare, [640, 360], [640, 360]).unwrap_err().to_string().contains("principal point"));
    // A point is seen at the same position of the image.
    let x = mat_vec(&pose_of(camera).rotation, [0.3, 0.2, 0.1]);
    let z = x[2] + pose_of(camera).translation[2];
    let at = |c: &Calibrated| c.intrinsics.fx * x[0] / z + c.intrinsics.cx;
    assert!((at(&half) * 2.0 - at(camera)).abs() < 1e-9);
}

#[test]
fn bars_and_padding_are_undone() {
    let camera = &truth()[0];
    let k = camera.intrinsics;
    // 1280x720 made to fit 1080 wide (607.5 high), in the middle of 640 pixels; stored at half the size.
    assert_eq!(shape(camera, [1080, 640]).unwrap(), Shape::Boxed([0.0, 640.0 - 607.5]));
    let (boxed, note) = fitted(camera, [1080, 640], [540, 320], [0.0, 8.0, 0.0, 8.0]).unwrap();
    let scale = 540.0 / 1280.0;
    assert!((boxed.intrinsics.fx - k.fx * scale).abs() < 1e-9 && (boxed.intrinsics.fy - k.fy * scale).abs() < 1e-9);
    assert!((boxed.intrinsics.cy - (k.cy * scale + 8.125)).abs() < 1e-9, "{:?}", boxed.intrinsics);
    assert!(note.expect("it is not plain").contains("black bars"));
    assert!(fitted(camera, [1080, 640], [540, 320], [0.0, 20.0, 0.0, 20.0]).is_err(), "of other bars");
    // A codec's padding, which some programs leave in.
    let (padded, note) = fitted(camera, [1280, 712], [1280, 712], [0.0; 4]).unwrap();
    assert_eq!(padded.intrinsics, k);
    assert!(note.expect("it is not plain").contains("multiples of 16"));
    // Images with bars, one of which is dark where the other is not.
    let picture = |dark: usize| {
        let mut p = Planes::new(1, 40, 60);
        for (i, v) in p.data.iter_mut().enumerate() {
            let (x, y) = (i % 60, i / 60);
            *v = if !(5..36).contains(&y) {
                0.03
            } else if x < dark {
                0.05
            } else {
                0.5
            };
        }
        p
    };
    assert_eq!(bars(&[picture(12), picture(0)]), [0.0, 5.0, 0.0, 4.0]);
    assert_eq!(bars(&[]), [0.0; 4]);
}
