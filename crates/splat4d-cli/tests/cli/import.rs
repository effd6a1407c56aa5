//! `import` on the bundled capture's images, without any other information.

use crate::sample::splat4d;
use crate::sound::{begins, decoded};
use crate::{json_of, str};
use serde_json::{Value, json};
use splat4d::math::align::apart;
use splat4d_train::capture::{Capture, CaptureOptions};
use std::path::{Path, PathBuf};

/// Neighbouring cameras, and after how many frames each of them begins.
const CAMERAS: [(&str, usize); 6] =
    [("cam06", 0), ("cam07", 2), ("cam08", 1), ("cam09", 3), ("cam10", 0), ("cam11", 2)];
/// Frames that each films.
const FRAMES: usize = 14;
/// Half of the images' shorter side, for tests that do not measure how exactly lenses are found: a quarter of the work.
const SMALL: [&str; 2] = ["--size", "150"];

fn bundled() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/knight")
}

/// Folders of images, cut out of the bundled capture.
fn filmed(to: &Path) {
    filmed_by(&CAMERAS, FRAMES, to);
}

/// The same of some cameras and frames: tests of what follows from clocks and poses take few.
fn filmed_by(cameras: &[(&str, usize)], frames: usize, to: &Path) {
    for (name, begin) in cameras {
        let folder = to.join(name);
        std::fs::create_dir_all(&folder).unwrap();
        for k in 0..frames {
            let from = bundled().join(format!("images/{name}/{:04}.jpg", begin + k));
            std::fs::copy(from, folder.join(format!("{k:04}.jpg"))).unwrap();
        }
    }
}

#[test]
fn images_alone_become_a_capture_with_clocks_and_poses() {
    let dir = tempfile::tempdir().unwrap();
    let (films, take) = (dir.path().join("films"), dir.path().join("take"));
    filmed(&films);
    let told = splat4d(&["import", str(&films), "-o", str(&take)]).run().ok();
    assert!(told.contains("cam09") && told.contains("geometry") && told.contains("doctor: 6 cameras"), "{told}");
    assert!(take.join("import/doctor.html").is_file() && take.join("import/doctor.json").is_file());

    let report = json_of(&take.join("import/report.json"));
    let offset = |k: usize| report["cameras"][k]["offset"].as_f64().unwrap();
    for (k, (name, begin)) in CAMERAS.iter().enumerate() {
        // The same event is at a smaller time on the clock of a camera that began later.
        let off = (offset(k) - offset(0)) * 30.0 - *begin as f64;
        assert!(off.abs() < 0.2, "{name}: {off} frames off");
    }
    let open = |path: &Path| Capture::open(path, &CaptureOptions::default()).unwrap();
    let (found, truth) = (open(&take), open(&bundled()));
    assert_eq!((found.cameras.len(), found.frames.len()), (CAMERAS.len(), CAMERAS.len() * FRAMES));
    let poses = |capture: &Capture| {
        let of = |(name, _): &(&str, usize)| {
            let frame = capture.frames.iter().find(|f| capture.cameras[f.camera].name == *name).unwrap();
            frame.source.cam_from_world
        };
        CAMERAS.iter().map(of).collect::<Vec<_>>()
    };
    for (off, (name, _)) in apart(&poses(&found), &poses(&truth)).unwrap().iter().zip(&CAMERAS) {
        assert!(off.degrees < 3.0 && off.center < 0.05, "{name}: {off:?}");
    }
}

/// Samples of sound a second, and the films' frames per second: slow, so that a second of images is long enough to
/// listen.
const SOUND_RATE: u32 = 16_000;
const SLOW: usize = 10;

/// Whether ffmpeg is there; without it a test is skipped, unless it is required.
pub(crate) fn have_ffmpeg() -> bool {
    let found = std::process::Command::new("ffmpeg").arg("-version").output().is_ok();
    assert!(found || std::env::var_os("REQUIRE_FFMPEG").is_none(), "ffmpeg is missing");
    if !found {
        eprintln!("skipped: no ffmpeg");
    }
    found
}

/// How loud cameras record, of 32767: the second one is loud, the third one so much so that it clips.
const LOUDNESS: [f64; 4] = [8_000.0, 20_000.0, 90_000.0, 20_000.0];

/// A WAV file of a camera's sound that begins after this many seconds: bursts of noise, the same for all.
pub(crate) fn heard(begin: f64, seconds: f64, camera: u64) -> Vec<u8> {
    let noise = |stream: u64, k: u64| {
        let mut z = (stream << 32 | k).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        ((z ^ (z >> 27)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    };
    let rate = f64::from(SOUND_RATE);
    let first = (begin * rate).round() as u64;
    let sample = |k: u64| {
        let own = 0.01 * noise(100 + camera, k);
        let t = (first + k) as f64 / rate;
        // A burst each quarter of a second, at places that do not repeat.
        let burst = (0..16u64).map(|b| {
            let since = t - 0.23 * b as f64 - 0.07 * noise(7, b).abs();
            if (0.0..0.06).contains(&since) { (1.0 - since / 0.06) * noise(8, first + k) } else { 0.0 }
        });
        ((own + burst.sum::<f64>()).clamp(-1.0, 1.0) * LOUDNESS[camera as usize]).clamp(-32_767.0, 32_767.0) as i16
    };
    let data: Vec<u8> = (0..(seconds * rate) as u64).flat_map(|k| sample(k).to_le_bytes()).collect();
    let mut out = b"RIFF".to_vec();
    out.extend((36 + data.len() as u32).to_le_bytes());
    out.extend(b"WAVEfmt ");
    out.extend([16, 0, 0, 0, 1, 0, 1, 0]);
    out.extend(SOUND_RATE.to_le_bytes());
    out.extend((2 * SOUND_RATE).to_le_bytes());
    out.extend([2, 0, 16, 0]);
    out.extend(b"data");
    out.extend((data.len() as u32).to_le_bytes());
    out.extend(data);
    out
}

#[test]
fn videos_with_sound_are_synchronised_by_sound() {
    if !have_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (films, take) = (dir.path().join("films"), dir.path().join("take"));
    std::fs::create_dir_all(&films).unwrap();
    let taken = 20;
    // Geometry does not determine the clocks of three cameras: only sound does.
    let cameras = &CAMERAS[..3];
    for (k, (name, begin)) in cameras.iter().enumerate() {
        let wave = dir.path().join(format!("{name}.wav"));
        let seconds = taken as f64 / SLOW as f64;
        std::fs::write(&wave, heard(*begin as f64 / SLOW as f64, seconds, k as u64)).unwrap();
        let pictures = bundled().join(format!("images/{name}/%04d.jpg"));
        let done = std::process::Command::new("ffmpeg")
            .args(["-v", "error", "-framerate", &SLOW.to_string(), "-start_number", &begin.to_string(), "-i"])
            .arg(&pictures)
            .arg("-i")
            .arg(&wave)
            .args(["-frames:v", &taken.to_string(), "-c:v", "mjpeg", "-q:v", "2", "-c:a", "copy"])
            .arg(films.join(format!("{name}.mov")))
            .output()
            .unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    }
    let import = |more: &[&str]| {
        splat4d(&["import", str(&films), "-o", str(&take), "--no-doctor"]).args(&SMALL).args(more).run()
    };
    let told = import(&[]).ok();
    let report = json_of(&take.join("import/report.json"));
    for (k, (name, begin)) in cameras.iter().enumerate() {
        let camera = &report["cameras"][k];
        let by: Vec<&str> = camera["by"].as_array().unwrap().iter().map(|v| v.as_str().unwrap()).collect();
        assert!(by.contains(&"sound"), "{name}: {by:?}");
        let off = (camera["offset"].as_f64().unwrap() - report["cameras"][0]["offset"].as_f64().unwrap()) * SLOW as f64;
        assert!((off - *begin as f64).abs() < 0.2, "{name}: {off} frames, begun after {begin}");
    }
    // The loudest camera that does not clip is kept, where it belongs on the clock of all: that of the first camera, which
    // began with the world.
    assert!(told.contains("The sound of camera cam07 is kept"), "{told}");
    let zero = report["cameras"][0]["offset"].as_f64().unwrap();
    let kept = || {
        let own = &json_of(&take.join("capture.json"))["sound"];
        let start = own["start"].as_f64().expect("it has sound") - zero;
        (start, begins(&decoded(&take.join(own["file"].as_str().unwrap())), start))
    };
    let aligned = |(start, found): (f64, f64)| assert!((start - found).abs() < 0.01, "{start} s, heard at {found} s");
    aligned(kept());
    Capture::open(&take, &CaptureOptions::default()).unwrap();
    assert!(splat4d(&["info", str(&take)]).run().all().contains("kbit/s"));
    // Others on request: a camera, a recorder that began at another time, none.
    assert!(import(&["--sound", "cam06"]).ok().contains("cam06 is kept, as requested"));
    aligned(kept());
    let recorder = dir.path().join("recorder.wav");
    std::fs::write(&recorder, heard(0.13, 3.0, 3)).unwrap();
    assert!(import(&["--sound", str(&recorder)]).ok().contains("aligned with that of"));
    aligned(kept());
    assert!(import(&["--sound", "cam99"]).refused().contains("cam06, cam07, cam08"));
    import(&["--sound", "none"]).ok();
    assert!(json_of(&take.join("capture.json")).get("sound").is_none() && !take.join("sound.m4a").exists());
}

/// The bundled cameras' numbers, as they are.
fn told() -> Vec<Value> {
    let capture = json_of(&bundled().join("capture.json"));
    let cameras = capture["cameras"].as_array().unwrap();
    CAMERAS.iter().map(|(name, _)| cameras.iter().find(|c| c["name"] == **name).unwrap().clone()).collect()
}

/// A calibration as anipose writes them, of cameras that are called so.
fn toml(cameras: &[Value], names: &[&str]) -> String {
    let one = |(camera, name): (&Value, &&str)| {
        let number = |key: &str| camera[key].as_f64().unwrap();
        let row = |i: usize| camera["world_to_camera"][i].as_array().unwrap().clone();
        let rows: Vec<Value> = (0..3).map(|i| row(i)[..3].into()).collect();
        let (cx, cy) = (number("cx") - 0.5, number("cy") - 0.5);
        format!(
            "[{name}]\nname = \"{name}\"\nsize = [{}, {}]\nmatrix = [[{:?}, 0, {cx:?}], [0, {:?}, {cy:?}], [0, 0, 1]]\n\
             distortions = [0.0, 0.0, 0.0, 0.0]\nrotation = {}\ntranslation = {}\n",
            camera["width"],
            camera["height"],
            number("fx"),
            number("fy"),
            Value::from(rows),
            Value::from((0..3).map(|i| row(i)[3].clone()).collect::<Vec<_>>())
        )
    };
    cameras.iter().zip(names).map(one).collect()
}

#[test]
fn a_calibration_places_cameras_and_clocks_are_found() {
    /// How exactly numbers must come through.
    const EXACT: f64 = 1e-5;
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let films = at("films");
    // Four cameras: geometry needs three pairs to agree.
    let cameras = &CAMERAS[..4];
    filmed_by(cameras, FRAMES, &films);
    let names: Vec<&str> = cameras.iter().map(|c| c.0).collect();
    let told = told()[..4].to_vec();
    std::fs::write(at("calibration.toml"), toml(&told, &names)).unwrap();
    // A mask for each camera: its upper quarter does not count.
    std::fs::create_dir(at("masks")).unwrap();
    for name in &names {
        let mask = image::GrayImage::from_fn(200, 150, |_, y| image::Luma([if y < 37 { 0 } else { 255 }]));
        mask.save(at("masks").join(format!("{name}.png"))).unwrap();
    }
    // The second dialect states the same to the last bit, so that nothing is solved again.
    let (take, masks) = (at("take"), at("masks"));
    for calibration in [at("calibration.toml"), bundled().join("capture.json")] {
        let args = ["import", str(&films), "-o", str(&take), "--calibration", str(&calibration)];
        let args = [&args[..], &SMALL, &["--masks", str(&masks), "--no-doctor"]].concat();
        let said = splat4d(&args).run().ok();
        assert!(said.contains("calibration px") && said.contains("geometry"), "{said}");
        let made = json_of(&take.join("capture.json"));
        for (k, camera) in told.iter().enumerate() {
            let found = &made["cameras"][k];
            for key in ["fx", "fy", "cx", "cy"] {
                let half = 0.5 * camera[key].as_f64().unwrap();
                assert!((found[key].as_f64().unwrap() - half).abs() < EXACT, "{key} {found}");
            }
            for (i, j) in (0..3).flat_map(|i| (0..4).map(move |j| (i, j))) {
                let number = |v: &Value| v["world_to_camera"][i][j].as_f64().unwrap();
                assert!((number(found) - number(camera)).abs() < EXACT, "{found}");
            }
        }
        let report = json_of(&take.join("import/report.json"));
        for (k, (name, begin)) in cameras.iter().enumerate() {
            let row = &report["cameras"][k];
            let offset = |k: usize| report["cameras"][k]["offset"].as_f64().unwrap();
            let off = (offset(k) - offset(0)) * 30.0 - *begin as f64;
            assert!(off.abs() < 0.1, "{name}: {off} frames off");
            assert!(row["calibration"].as_f64().unwrap() < 1.0, "{row}");
        }
        let capture = Capture::open(&take, &CaptureOptions::default()).unwrap();
        assert!(capture.frames.iter().all(|f| f.mask.is_some()));
        assert!(capture.points.is_some_and(|p| p.points.len() > 50));
    }
    // Every camera is another one's.
    let mut turned = names.clone();
    turned.rotate_left(1);
    std::fs::write(at("wrong.toml"), toml(&told, &turned)).unwrap();
    let some: Vec<PathBuf> = names[..3].iter().map(|n| films.join(n)).collect();
    let refused = |file: &Path| {
        let take = at("refused");
        let args: Vec<&str> = some.iter().map(|p| str(p)).collect();
        splat4d(&["import", "-o", str(&take), "--calibration", str(file)]).args(&args).run().refused()
    };
    let why = refused(&at("wrong.toml"));
    assert!(why.contains("contradicts the images"), "{why}");
    let strange: Vec<String> = (0..names.len()).map(|k| format!("strange{}", 3 * k)).collect();
    let strange: Vec<&str> = strange.iter().map(String::as_str).collect();
    std::fs::write(at("strange.toml"), toml(&told, &strange)).unwrap();
    let why = refused(&at("strange.toml"));
    assert!(why.contains("strange3") && why.contains("cam07"), "{why}");
    assert!(refused(&at("missing.toml")).contains("missing.toml"));
}

/// Cameras 45 to 63 degrees apart, which share too few features.
const APART: [(&str, usize); 4] = [("cam00", 1), ("cam07", 0), ("cam12", 3), ("cam19", 2)];

/// Where the bundled cameras show points of the scene, as the page of `--assist` saves it, with a quarter of a pixel of noise.
fn clicked() -> Value {
    let capture = json_of(&bundled().join("capture.json"));
    let all = capture["cameras"].as_array().unwrap();
    let click = |k: usize, (name, _): &(&str, usize), x: [f64; 3]| {
        let camera = all.iter().find(|c| c["name"] == **name).unwrap();
        let number = |key: &str| camera[key].as_f64().unwrap();
        let row = |i: usize| camera["world_to_camera"][i].as_array().unwrap();
        let at =
            |i: usize| (0..3).map(|j| row(i)[j].as_f64().unwrap() * x[j]).sum::<f64>() + row(i)[3].as_f64().unwrap();
        let noise = |a: usize| 0.25 * ((17 * k + 5 * a) as f64).sin();
        let (u, v) = (number("fx") * at(0) / at(2) + number("cx"), number("fy") * at(1) / at(2) + number("cy"));
        json!({"camera": name, "x": u + noise(0), "y": v + noise(1), "time": 0.0})
    };
    // Corners of a room's size around the knight; y is up.
    let places = [
        [-1.0, 0.0, -1.0],
        [1.0, 0.0, -1.0],
        [1.0, 0.0, 1.0],
        [-1.0, 0.0, 1.0],
        [-0.5, 1.5, 0.2],
        [0.6, 2.0, -0.3],
        [0.1, 1.0, 0.7],
        [-0.8, 0.8, -0.6],
        [0.9, 1.2, 0.4],
    ];
    let point = |(k, x): (usize, &[f64; 3])| {
        let clicks: Vec<Value> = APART.iter().enumerate().map(|(c, camera)| click(4 * k + c, camera, *x)).collect();
        json!({"name": format!("p{k}"), "clicks": clicks})
    };
    let points: Vec<Value> = places.iter().enumerate().map(point).collect();
    let sizes: serde_json::Map<String, Value> =
        APART.iter().map(|(n, _)| ((*n).to_owned(), json!([400, 300]))).collect();
    // Frame 4 of the bundled capture.
    let event: serde_json::Map<String, Value> =
        APART.iter().map(|(n, begin)| ((*n).to_owned(), json!((4 - begin) as f64 / 30.0))).collect();
    json!({
        "version": 1, "cameras": sizes, "event": event, "points": points, "floor": ["p0", "p1", "p2", "p3"],
        "length": {"points": ["p0", "p2"], "metres": 8f64.sqrt()},
    })
}

#[test]
fn clicked_points_place_cameras_that_share_no_features() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (films, take, points) = (at("films"), at("take"), at("points.json"));
    filmed_by(&APART, 8, &films);
    std::fs::write(&points, clicked().to_string()).unwrap();
    let alone = splat4d(&["import", str(&films), "-o", str(&at("alone")), "--no-doctor"]).args(&SMALL).run().refused();
    assert!(alone.contains("--assist"), "{alone}");
    let args = ["import", str(&films), "-o", str(&take), "--points", str(&points), "--no-doctor"];
    let said = splat4d(&args).args(&SMALL).run().ok();
    assert!(
        said.contains("9 clicked points") && said.contains("clicked floor") && said.contains("clicked length"),
        "{said}"
    );
    let open = |path: &Path| Capture::open(path, &CaptureOptions::default()).unwrap();
    let (found, truth) = (open(&take), open(&bundled()));
    let poses = |capture: &Capture| {
        let of = |(name, _): &(&str, usize)| {
            let frame = capture.frames.iter().find(|f| capture.cameras[f.camera].name == *name).unwrap();
            frame.view.cam_from_world
        };
        APART.iter().map(of).collect::<Vec<_>>()
    };
    for (off, (name, _)) in apart(&poses(&found), &poses(&truth)).unwrap().iter().zip(APART) {
        assert!(off.degrees < 1.0 && off.center < 0.01, "{name}: {off:?}");
    }
    let report = json_of(&take.join("import/report.json"));
    for (k, (name, begin)) in APART.iter().enumerate() {
        let offset = |k: usize| report["cameras"][k]["offset"].as_f64().unwrap();
        let off = (offset(k) - offset(0)) * 30.0 - (*begin as f64 - APART[0].1 as f64);
        assert!(off.abs() < 1e-3, "{name}: {off} frames off");
    }
    // Metres, and z upwards from the floor.
    let height = poses(&found)[1].inverse().translation[2];
    assert!((height - 3.3).abs() < 0.05, "{height}");

    let refused = |change: &dyn Fn(&mut Value)| {
        let mut all = clicked();
        change(&mut all);
        std::fs::write(&points, all.to_string()).unwrap();
        splat4d(&["import", str(&films), "-o", str(&take), "--points", str(&points)]).args(&SMALL).run().refused()
    };
    let few = refused(&|all| all["points"].as_array_mut().unwrap().truncate(5));
    assert!(few.contains("click 1 more") && few.contains("--assist"), "{few}");
    let shape = refused(&|all| all["cameras"]["cam07"] = json!([400, 400]));
    assert!(shape.contains("400x400") && shape.contains("cam07"), "{shape}");
    let wrong = refused(&|all| all["points"][0]["clicks"][0]["camera"] = json!("cam99"));
    assert!(wrong.contains("cam99") && wrong.contains("cam07"), "{wrong}");
    assert!(splat4d(&["import", str(&films), "-o", str(&take), "--no-open"]).run().refused().contains("--assist"));
}

/// A program that notes how it is called and, as the mapper, copies a model to where it is requested.
#[cfg(unix)]
fn stand_in(folder: &Path, ends: &str) {
    use std::os::unix::fs::PermissionsExt;
    let script = format!(
        "#!/bin/sh\nif [ \"$2\" = --help ]; then echo '  --FeatureExtraction.use_gpu arg (=1)'; exit 0; fi\n\
         echo \"$@\" >> '{0}/calls'\nif [ \"$1\" = mapper ]; then\n\
         while [ \"$1\" != --output_path ]; do shift; done\n\
         /bin/mkdir -p \"$2/0\" && /bin/cp '{0}/model/cameras.txt' '{0}/model/images.txt' \"$2/0\"\nfi\n{ends}\n",
        folder.display()
    );
    let path = folder.join("colmap");
    std::fs::write(&path, script).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
}

#[cfg(unix)]
#[test]
fn colmap_runs_on_request_and_its_model_is_used() {
    use splat4d::math::quat;
    /// Decimals of the model's text, and the unit that it is in.
    const EXACT: f64 = 1e-5;
    const HALF: f64 = 0.5;
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (films, take, program) = (at("films"), at("take"), at("program"));
    // The model states where cameras are, and the user when: few frames are enough.
    filmed_by(&CAMERAS, 4, &films);
    std::fs::create_dir_all(program.join("model")).unwrap();
    let (mut cameras, mut images) = (String::new(), String::new());
    for (k, (camera, (name, _))) in told().iter().zip(&CAMERAS).enumerate() {
        let number = |i: usize, j: usize| camera["world_to_camera"][i][j].as_f64().unwrap();
        let q = quat::from_rotation(&std::array::from_fn(|i| std::array::from_fn(|j| number(i, j))));
        let t = [0, 1, 2].map(|i| HALF * number(i, 3));
        let text = |v: &[f64]| v.iter().map(|v| format!("{v:.12}")).collect::<Vec<_>>().join(" ");
        cameras +=
            &format!("{k} PINHOLE 400 300 {} {} {} {}\n", camera["fx"], camera["fy"], camera["cx"], camera["cy"]);
        images += &format!("{k} {} {} {k} {name}.png\n\n", text(&q), text(&t));
    }
    std::fs::write(program.join("model/cameras.txt"), cameras).unwrap();
    std::fs::write(program.join("model/images.txt"), images).unwrap();
    let folder = str(&program).to_owned();
    let order = ["import", str(&films), "-o", str(&take), "--colmap", "--synchronous", "--no-doctor"];
    let import = |path: &str| splat4d(&order).path(path).run();
    let missing = import("/nonexistent").failed();
    assert!(missing.contains("colmap cannot be started") && missing.contains("leave --colmap out"), "{missing}");
    stand_in(&program, "if [ -z \"$1\" ]; then :; fi; echo 'out of features' >&2; exit 3");
    let failed = import(&folder).refused();
    assert!(failed.contains("feature_extractor") && failed.contains("out of features"), "{failed}");
    std::fs::remove_file(program.join("calls")).unwrap();
    stand_in(&program, "exit 0");
    import(&folder).ok();
    let calls = std::fs::read_to_string(program.join("calls")).unwrap();
    let lines: Vec<&str> = calls.lines().collect();
    assert_eq!(lines.len(), 3, "{calls}");
    for (line, words) in lines.iter().zip([
        ["feature_extractor", "--ImageReader.single_camera_per_image 1", "--FeatureExtraction.use_gpu 0"],
        ["exhaustive_matcher", "--SiftMatching.guided_matching 1", "database.db"],
        ["mapper", "--Mapper.ba_refine_principal_point 0", "--output_path"],
    ]) {
        assert!(words.iter().all(|w| line.contains(w)), "{line}");
    }
    // The world is aligned with walls and floor: relative poses equal those of the model.
    let made = json_of(&take.join("capture.json"));
    let from_first = |cameras: &[Value], k: usize, unit: f64| -> [[f64; 4]; 3] {
        let number = |k: usize, i: usize, j: usize| cameras[k]["world_to_camera"][i][j].as_f64().unwrap();
        std::array::from_fn(|i| {
            let turn: [f64; 3] = std::array::from_fn(|j| (0..3).map(|m| number(k, i, m) * number(0, j, m)).sum());
            let shift = number(k, i, 3) - (0..3).map(|j| turn[j] * number(0, j, 3)).sum::<f64>();
            [turn[0], turn[1], turn[2], unit * shift]
        })
    };
    let (told, made_cameras) = (told(), made["cameras"].as_array().unwrap());
    for k in 1..told.len() {
        let (wanted, found) = (from_first(&told, k, HALF), from_first(made_cameras, k, 1.0));
        let far = wanted.as_flattened().iter().zip(found.as_flattened()).any(|(a, b)| (a - b).abs() >= EXACT);
        assert!(!far, "camera {k}: {found:?} for {wanted:?}");
    }
    // Nothing changed: neither the program nor the solver is at work again.
    let before = std::fs::read(take.join("capture.json")).unwrap();
    let saved = |folder: &Path| std::fs::read_dir(folder.join("import/cache")).unwrap().count();
    let count = saved(&take);
    import(&folder).ok();
    assert_eq!(std::fs::read_to_string(program.join("calls")).unwrap(), calls);
    assert_eq!((std::fs::read(take.join("capture.json")).unwrap(), saved(&take)), (before, count));
}

/// Geometry does not determine the clocks of three cameras, and these are silent: the rest is a guess.
#[test]
fn unconfirmed_time_offsets_are_refused_and_can_be_given() {
    let dir = tempfile::tempdir().unwrap();
    let (films, take) = (dir.path().join("films"), dir.path().join("take"));
    filmed_by(&CAMERAS[1..4], 8, &films);
    let three: Vec<PathBuf> = ["cam07", "cam08", "cam09"].iter().map(|c| films.join(c)).collect();
    let import = |more: &[&str]| {
        let mut all = vec!["import"];
        all.extend(three.iter().map(|p| str(p)));
        all.extend(["-o", str(&take), "--no-doctor"]);
        splat4d(&all).args(&SMALL).args(more).run()
    };
    let refused = import(&[]).refused();
    assert!(
        refused.contains("the time offsets of these cameras are unknown") && refused.contains("cam08"),
        "{refused}"
    );
    assert!(refused.contains("--synchronous") && refused.contains("keep_offset"), "{refused}");
    assert!(!take.join("capture.json").exists());
    assert!(
        take.join("import/report.json").is_file() && take.join("images/cam08").is_dir(),
        "existing results are kept"
    );
    // The times of the files, on the user's word.
    import(&["--synchronous"]).ok();
    let report = json_of(&take.join("import/report.json"));
    assert!((0..3).all(|k| report["cameras"][k]["offset"].as_f64() == Some(0.0)), "{report}");
    // Or given offsets.
    let path = take.join("import.toml");
    let mut text = std::fs::read_to_string(&path).unwrap();
    for (name, offset) in [("cam07", 0.0), ("cam08", -1.0 / 30.0), ("cam09", 1.0 / 30.0)] {
        let (before, own) = text.split_once(&format!("name = \"{name}\"")).unwrap();
        let own = own.replacen("offset = 0.0", &format!("offset = {offset}"), 1);
        let own = own.replacen("keep_offset = false", "keep_offset = true", 1);
        text = format!("{before}name = \"{name}\"{own}");
    }
    std::fs::write(&path, text).unwrap();
    import(&[]).ok();
    let report = json_of(&take.join("import/report.json"));
    assert!((report["cameras"][1]["offset"].as_f64().unwrap() + 1.0 / 30.0).abs() < 1e-9, "{report}");
}

#[test]
fn images_of_one_time_need_no_time_offsets() {
    let dir = tempfile::tempdir().unwrap();
    let (films, take) = (dir.path().join("films"), dir.path().join("take"));
    for (name, _) in CAMERAS {
        std::fs::create_dir_all(films.join(name)).unwrap();
        std::fs::copy(bundled().join(format!("images/{name}/0004.jpg")), films.join(name).join("0004.jpg")).unwrap();
    }
    let told = splat4d(&["import", str(&films), "-o", str(&take), "--no-doctor"]).run().ok();
    assert!(told.contains("have no effect") && !told.contains("are unknown"), "{told}");
    assert_eq!(Capture::open(&take, &CaptureOptions::default()).unwrap().frames.len(), CAMERAS.len());
}

#[test]
fn unsupported_inputs_are_refused_with_a_reason() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let take = at("take");
    let refused =
        |input: &Path, more: &[&str]| splat4d(&["import", str(input), "-o", str(&take)]).args(more).run().refused();
    assert!(refused(&at("nothing.mp4"), &[]).contains("nothing.mp4"));
    std::fs::create_dir(at("empty")).unwrap();
    assert!(refused(&at("empty"), &[]).contains("neither a video nor an image"));
    std::fs::write(at("zero.mp4"), []).unwrap();
    assert!(refused(&at("zero.mp4"), &[]).contains("empty"));
    let films = at("films");
    filmed(&films);
    let one = films.join("cam06");
    assert!(refused(&one, &["--rig", "fixed"]).contains("one fixed camera"));
    let alone = refused(&one, &[]);
    assert!(alone.contains("stays in place") && alone.contains("--rig moving"), "{alone}");
    assert!(refused(&films, &["--from", "3", "--to", "2"]).contains("is empty"));
    assert!(refused(&films, &["--apart", "cam06"]).contains("left,right=2.4"));
    assert!(refused(&films, &["--apart", "cam06,cam99=2"]).contains("cam99"));
    let twice = splat4d(&["import", str(&one), str(&one), "-o", str(&take)]).run().refused();
    assert!(twice.contains("the same as"), "{twice}");
    // A run stays a run.
    std::fs::create_dir(at("run")).unwrap();
    std::fs::write(at("run/recipe.toml"), "").unwrap();
    let run = splat4d(&["import", str(&one), "-o", str(&at("run"))]).run().refused();
    assert!(run.contains("contains a run (recipe.toml)"), "{run}");
    // Two cameras that see nothing in common.
    let far = at("far");
    for name in ["cam00", "cam19"] {
        std::fs::create_dir_all(far.join(name)).unwrap();
        for k in 0..4 {
            let from = bundled().join(format!("images/{name}/{k:04}.jpg"));
            std::fs::copy(from, far.join(name).join(format!("{k:04}.jpg"))).unwrap();
        }
    }
    let alone = refused(&far, &[]);
    assert!(alone.contains("20 degrees"), "{alone}");
    // Given time offsets without a common time.
    let path = take.join("import.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    let mut offsets = ["0.0", "100.0"].iter();
    let told = |line: &str| match line {
        "keep_offset = false" => Some(format!("keep_offset = true\noffset = {}", offsets.next().unwrap())),
        line if line.starts_with("offset = ") => None,
        line => Some(line.to_owned()),
    };
    std::fs::write(&path, text.lines().filter_map(told).collect::<Vec<_>>().join("\n")).unwrap();
    let apart = refused(&far, &[]);
    assert!(apart.contains("nothing at the same time") && apart.contains("cam19 100.0"), "{apart}");
    // Who is left out stays out.
    let (before, own) = text.split_once("name = \"cam19\"").unwrap();
    let own = own.replacen("use = true", "use = false", 1);
    std::fs::write(&path, format!("{before}name = \"cam19\"{own}")).unwrap();
    assert!(refused(&far, &["--rig", "fixed"]).contains("one fixed camera"));
    // A capture that another program wrote stays.
    let own = at("own");
    std::fs::create_dir(&own).unwrap();
    std::fs::write(own.join("capture.json"), "{}").unwrap();
    assert!(
        splat4d(&["import", str(&films), "-o", str(&own)]).run().refused().contains("a capture of another program")
    );
    // So do their images, and a calibration that the capture would contain.
    let own = at("photos");
    std::fs::create_dir_all(own.join("images/cam06")).unwrap();
    std::fs::write(own.join("images/cam06/000000.jpg"), "mine").unwrap();
    let said = splat4d(&["import", str(&films), "-o", str(&own)]).run().refused();
    assert!(said.contains("holds images") && said.contains("no record"), "{said}");
    assert_eq!(std::fs::read(own.join("images/cam06/000000.jpg")).unwrap(), b"mine");
    std::fs::write(take.join("rig.toml"), "x = 1").unwrap();
    let said = refused(&films, &["--calibration", str(&take.join("rig.toml"))]);
    assert!(said.contains("contains the calibration"), "{said}");
}
