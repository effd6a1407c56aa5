//! The built binary on small synthetic captures: what users type, what they get, and what is printed.

#[path = "cli/channels.rs"]
mod channels;
#[path = "cli/chunked.rs"]
mod chunked;
#[path = "cli/compress.rs"]
mod compress;
#[path = "cli/convert.rs"]
mod convert;
#[path = "cli/device.rs"]
mod device;
#[path = "cli/edit.rs"]
mod edit;
#[path = "cli/folders.rs"]
mod folders;
#[path = "cli/import.rs"]
mod import;
#[path = "cli/meshes.rs"]
mod meshes;
#[path = "cli/predict.rs"]
mod predict;
#[path = "cli/priors.rs"]
mod priors;
#[path = "cli/sample.rs"]
mod sample;
#[path = "cli/sound.rs"]
mod sound;
#[path = "cli/trained.rs"]
mod trained;

use sample::{Capture, Output, splat4d};
use serde_json::{Value, json};
use splat4d::format::npy::Npy;
use splat4d::format::playback::{Index, Kind};
use splat4d::format::ply;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, LifeKind, Params, SH};
use splat4d_train::recipe::{MotionName, Recipe};
use std::path::{Path, PathBuf};

/// Options of a run that takes a second.
const TINY: [&str; 6] = [
    "--set=iterations=20",
    "--set=num_pts=120",
    "--set=max_cap=150",
    "--set=sh_degree=1",
    "--set=checkpoint_interval=10",
    "--seed=3",
];

fn train(capture: &Path, run: &Path) -> Output {
    splat4d(&["train", str(capture), "-o", str(run)]).args(&TINY).run()
}

fn str(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn json_of(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn help_has_examples_and_completions_complete() {
    // No line of settings or of an example is broken where that would hide its meaning.
    let settings = splat4d(&["train", "--help"]).run().ok();
    let (_, settings) = settings.split_once("--help-knobs: all):\n").expect("a list of settings");
    let is_name = |line: &str| line.starts_with("  ") && line.trim().split(' ').next().unwrap().contains('.');
    let mut lines = settings.lines().filter(|line| !line.is_empty());
    assert!(lines.all(|line| line.starts_with("      ") || is_name(line)), "{settings}");
    let render = splat4d(&["render", "--help"]).run().ok();
    let matrix = "     \"world_to_camera\": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}]}\n";
    assert!(render.contains(matrix), "{render}");
    let help = splat4d(&["--help"]).run().ok();
    for verb in [
        "import",
        "priors",
        "train",
        "join",
        "eval",
        "render",
        "localise",
        "bake",
        "view",
        "export",
        "convert",
        "label",
        "info",
        "recipe",
        "completions",
    ] {
        assert!(help.contains(verb), "{verb} is missing");
        let own = splat4d(&[verb, "--help"]).run().ok();
        assert!(own.contains("Examples:") && own.contains(&format!("splat4d {verb}")), "{verb} --help teaches nothing");
    }
    // Common options have their own heading, after the verb's.
    let own = splat4d(&["predict", "--help"]).run().ok();
    let (of_verb, global) = own.split_once("Global options:").expect("a heading");
    assert!(of_verb.contains("--horizon") && !of_verb.contains("--threads") && global.contains("--threads"), "{own}");
    let settings = splat4d(&["train", "--help-knobs"]).run().ok();
    for setting in ["position_lr_init", "densify_until_iter", "lambda_dssim", "densify.max_cap"] {
        assert!(settings.contains(setting), "{setting} is missing");
    }
    // The studies are a program of their own.
    assert!(splat4d(&["lab", "e00"]).run().refused().contains("lab"));
    for shell in ["bash", "zsh", "fish"] {
        assert!(splat4d(&["completions", shell]).run().ok().contains("image-memory"), "{shell}");
    }
    let version = splat4d(&["--version"]).run().ok();
    assert!(version.starts_with("splat4d ") && version.contains("splats4d"), "{version}");
    // The second name is the same program, down to the exit code.
    let second = |arg: &str| std::process::Command::new(env!("CARGO_BIN_EXE_s4d")).arg(arg).output().unwrap();
    assert_eq!(String::from_utf8(second("--version").stdout).unwrap(), version);
    assert_eq!(second("--nothing").status.code(), Some(2));
}

#[test]
fn the_schema_of_events_lists_those_of_the_page() {
    let schema = sample::event_schema();
    let page = include_str!("../../../docs/events.md");
    for name in schema["$defs"].as_object().unwrap().keys() {
        assert!(page.contains(&format!("`{name}`")), "docs/events.md lacks {name}");
    }
    let (lists, _) = page.split_once("## Other commands").expect("the page has this part");
    for name in lists.lines().filter_map(|l| l.strip_prefix("| `")?.split('`').next()).filter(|name| *name != "type") {
        assert!(schema["$defs"].get(name).is_some(), "docs/events.schema.json lacks {name}");
    }
}

#[test]
fn a_recipe_is_printed_with_its_schema() {
    let recipe = splat4d(&["recipe"]).run().ok();
    let read = Recipe::from_toml(&format!("#:schema ./recipe.schema.json\n{recipe}")).unwrap();
    assert_eq!(read, Recipe::default().with(|r| r.run.motion = MotionName::AUTO));
    let schema: Value = serde_json::from_str(&splat4d(&["recipe", "--schema"]).run().ok()).unwrap();
    assert_eq!(schema["properties"]["run"]["properties"]["iterations"]["type"], "integer");
    assert_eq!(schema["properties"]["iterations"]["deprecated"], true, "older names are valid");
}

#[test]
fn images_are_found_in_a_scene_and_cameras_compared_with_their_truth() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    let run = work.path().join("run");
    train(&capture, &run).ok();
    let said = splat4d(&["eval", str(&run), "--truth", str(&capture)]).run().ok();
    assert!(said.contains("ATE 0.00000 units") && said.contains("0.00 ms at most"), "{said}");
    let error = &json_of(&run.join("results.json"))["trajectory"];
    assert!(error["ate"].as_f64().unwrap() < 1e-6 && !error["cameras"].as_array().unwrap().is_empty(), "{error}");
    // An image of the scene itself, from one of its cameras: nothing need move.
    let (picture, camera, found) =
        (work.path().join("a.png"), work.path().join("cam.json"), work.path().join("b.json"));
    let text = std::fs::read_to_string(capture.join("capture.json")).unwrap();
    let stated = serde_json::from_str::<Value>(&text).unwrap()["cameras"][1].clone();
    let one = json!({"fx": stated["fx"], "fy": stated["fy"], "cx": stated["cx"], "cy": stated["cy"], "w": stated["width"],
        "h": stated["height"], "world_to_camera": stated["world_to_camera"]});
    std::fs::write(&camera, one.to_string()).unwrap();
    splat4d(&["render", str(&run), "--camera", str(&camera), "-o", str(&picture)]).run().ok();
    let said = splat4d(&["localise", str(&run), str(&picture), "-o", str(&found)]).run().ok();
    assert!(said.contains("a.png: at (") && said.contains("of that of a plain colour"), "{said}");
    let row = &json_of(&found)[0];
    let number = |v: &Value| v.as_f64().unwrap();
    let pose = &stated["world_to_camera"];
    let center = [0, 1, 2].map(|k| -(0..3).map(|i| number(&pose[i][k]) * number(&pose[i][3])).sum::<f64>());
    let off = (0..3).map(|k| (number(&row["position"][k]) - center[k]).powi(2)).sum::<f64>().sqrt();
    assert!(off < 0.02 && number(&row["share"]) < 0.05, "{off} {row}");
    // Noise is nowhere in it.
    let noise = image::RgbImage::from_fn(32, 24, |x, y| {
        image::Rgb([0, 1, 2].map(|c| ((x * 7919 + y * 104_729 + c * 31) % 251) as u8))
    });
    noise.save(&picture).unwrap();
    let refused = splat4d(&["localise", str(&run), str(&picture)]).run().refused();
    assert!(refused.contains("not found: a.png") && refused.contains("--start"), "{refused}");
    image::RgbImage::new(30, 30).save(&picture).unwrap();
    assert!(splat4d(&["localise", str(&run), str(&picture)]).run().refused().contains("30x30"));
}

#[test]
fn a_capture_is_trained_evaluated_and_exported() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    let run = work.path().join("run");
    let said = train(&capture, &run).ok();
    assert!(said.contains("PSNR") && said.contains("report.html"), "{said}");
    // The scores are the last line but one, the next command is the last.
    let lines: Vec<&str> = said.lines().collect();
    assert_eq!(lines[lines.len() - 1], format!("next: splat4d view {}", run.display()));
    assert!(lines[lines.len() - 2].starts_with("held-out views: PSNR"), "{said}");
    for file in [
        "recipe.toml",
        "run.json",
        "scene.safetensors",
        "scene.s4d",
        "metrics.csv",
        "results.json",
        "per_view.json",
        "cameras.json",
        "report.html",
        "test/ours_20/renders/00000.png",
        "test/ours_20/gt/00003.png",
        "test/ours_20/errors/00003.png",
    ] {
        assert!(run.join(file).is_file(), "{file} is missing");
    }
    assert!(run.join("orbit.mp4").is_file() || run.join("orbit.png").is_file());
    let results = json_of(&run.join("results.json"));
    let psnr = results["ours_20"]["PSNR"].as_f64().unwrap();
    assert!((5.0..60.0).contains(&psnr), "{psnr}");
    assert!(results["ours_20"]["PSNR-dynamic"].is_f64(), "fixed cameras have a dynamic region");
    assert!(results["train"]["ours_20"]["PSNR"].is_f64(), "training views stand apart");
    let views = json_of(&run.join("per_view.json"));
    assert_eq!(views["ours_20"]["camera"]["00000.png"], "cam0");
    let mean = (0..4).map(|i| views["ours_20"]["PSNR"][format!("{i:05}.png")].as_f64().unwrap()).sum::<f64>() / 4.0;
    assert!((mean - psnr).abs() < 1e-9, "the mean of the views is the result");
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    assert!(page.contains("data:image/jpeg") && page.contains(&format!("{psnr:.2}")));

    let again = train(&capture, &run);
    assert!(again.refused().contains("--resume"), "a finished run is never silently replaced");

    // eval, with the still baseline, as machines read it.
    let lines = splat4d(&["eval", str(&run), "--baseline", "--no-film", "--json"]).run().ok();
    let results: Vec<Value> = lines.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    let scores = results.iter().find(|e| e["type"] == "results").unwrap();
    assert!(scores["still"]["PSNR-dynamic"].is_f64() && scores["results"]["PSNR"].as_f64() == Some(psnr));
    assert!(results.iter().any(|e| e["type"] == "written"));
    let cached = splat4d(&["eval", str(&run), "--baseline", "--no-film", "--json"]).run().ok();
    assert!(!cached.contains("\"started\""), "the baseline is trained once");

    // eval of other views; missing splits are refused.
    let lines = splat4d(&["eval", str(&run), "--split", "train", "--json"]).run().ok();
    let lines: Vec<Value> = lines.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    let scores = lines.iter().find(|e| e["type"] == "results").unwrap();
    assert!(scores["conditions"]["split"] == "train" && scores["results"]["PSNR-cc"].is_f64(), "{scores}");
    assert_eq!(
        json_of(&run.join("results.json"))["ours_20"]["PSNR"].as_f64(),
        Some(psnr),
        "the run's own figures stay"
    );
    let refused = |args: &[&str]| splat4d(&[&["eval", str(&run)], args].concat()).run().refused();
    assert!(refused(&["--background", "both"]).contains("no transparent pixels"));
    assert!(refused(&["--split", "val"]).contains("transforms_val.json"));

    // info
    let told: Value = serde_json::from_str(&splat4d(&["info", str(&run), "--json"]).run().ok()).unwrap();
    assert_eq!((&told["finished"], &told["iteration"]), (&json!(true), &json!(20)));
    assert!(told["scene"]["gaussians"].as_u64().unwrap() > 10);
    let told = splat4d(&["info", str(&capture)]).run().ok();
    assert!(told.contains("4 fixed") && told.contains("16 at 4 times") && told.contains("cam0"), "{told}");

    // The next command to type ends every command that has one.
    let last = |args: &[&str], next: &str, path: &Path| {
        let said = splat4d(args).run().ok();
        assert_eq!(said.lines().last(), Some(&*format!("next: splat4d {next} {}", path.display())), "{said}");
    };
    let (file, edited) = (work.path().join("scene.spz"), work.path().join("cut.s4d"));
    last(&["info", str(&run)], "view", &run);
    last(&["eval", str(&run), "--split", "train"], "view", &run);
    last(&["convert", str(&run), str(&file), "--time", "0"], "view", &file);
    last(&["edit", str(&run), "--crop", "all", "-o", str(&edited)], "view", &edited);

    // render
    let frames = work.path().join("frames");
    splat4d(&["render", str(&run), "--path", "test", "-o", str(&frames)]).run().ok();
    assert_eq!(sample::shown(&frames).len(), 4);
    let shown = image::open(frames.join("00002.png")).unwrap().to_rgb8();
    let measured = image::open(run.join("test/ours_20/renders/00002.png")).unwrap().to_rgb8();
    assert_eq!(shown, measured, "render draws what eval measured");
    let film = work.path().join("film.png");
    let keys = work.path().join("keys.json");
    let key = |t: i32, x: f64| json!({"time": t, "position": [x, 0.3, -3.5], "look_at": [0, 0, 0], "scene_time": 0.05});
    std::fs::write(&keys, json!({"fps": 4, "keys": [key(0, -1.0), key(1, 1.0)]}).to_string()).unwrap();
    splat4d(&["render", str(&run), "--path", str(&keys), "--size", "24x18", "--channel", "depth", "-o", str(&film)])
        .run()
        .ok();
    let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(&film).unwrap()));
    let reader = decoder.read_info().unwrap();
    assert_eq!((reader.info().width, reader.info().animation_control().unwrap().num_frames), (24, 4));

    // export
    let ply_file = work.path().join("now.ply");
    splat4d(&["export", str(&run), "-o", str(&ply_file), "--time", "0.05"]).run().ok();
    assert!(ply::read(&std::fs::read(&ply_file).unwrap()).unwrap().0.len() > 10);
    let sequence = work.path().join("plys");
    splat4d(&["export", str(&run), "--sequence", str(&sequence)]).run().ok();
    assert!(sequence.join("frame_00003.ply").is_file() && !sequence.join("frame_00004.ply").exists());
    assert!(splat4d(&["info", str(&ply_file)]).run().ok().contains("3DGS .ply"));
    let (csv, tracks) = (work.path().join("tracks.csv"), work.path().join("tracks.json"));
    splat4d(&["export", str(&run), "--tracks", str(&csv), "--every", "3"]).run().ok();
    let text = std::fs::read_to_string(&csv).unwrap();
    assert!(text.starts_with("layer,gaussian,time,x,y,z\n") && text.contains("\nscene,3,"), "{text:.200}");
    splat4d(&["export", str(&run), "--tracks", str(&tracks), "--near", "0,0,-0.5", "--count", "2"]).run().ok();
    let json: Value = serde_json::from_str(&std::fs::read_to_string(&tracks).unwrap()).unwrap();
    assert_eq!((json["tracks"].as_array().unwrap().len(), json["times"].as_array().unwrap().len()), (2, 4));
    assert!(splat4d(&["export", str(&run), "--tracks", "tracks.txt"]).run().refused().contains(".csv, .json or .npz"));
    assert!(splat4d(&["export", str(&run), "-o", "x.ply", "--fps", "3"]).run().refused().contains("--sequence"));
    assert!(splat4d(&["info", str(&run.join("scene.safetensors"))]).run().ok().contains("spacetime"));
}

#[test]
fn a_stopped_run_continues_and_a_foreign_checkpoint_does_not() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    let run = work.path().join("run");
    splat4d(&["train", str(&capture), "-o", str(&run), "--no-eval"]).args(&TINY).run().ok();
    let whole = std::fs::read(run.join("scene.safetensors")).unwrap();
    // Back to the checkpoint of step 10, as if the machine had died.
    std::fs::remove_file(run.join("scene.safetensors")).unwrap();
    std::fs::remove_file(run.join("checkpoints/00000020.safetensors")).unwrap();
    assert!(splat4d(&["info", str(&run)]).run().ok().contains("--resume"));
    splat4d(&["train", "--resume", str(&run), "--no-eval", "--threads", "1"]).run().ok();
    let resumed = std::fs::read(run.join("scene.safetensors")).unwrap();
    assert!(resumed == whole, "the resumed run must be the unbroken one, bit for bit");

    // A checkpoint of another version.
    let bytes = std::fs::read(run.join("checkpoints/00000020.safetensors")).unwrap();
    let text = String::from_utf8_lossy(&bytes[8..600]).into_owned();
    let at = text.find("\\\"version\\\":1").map(|i| i + 8 + "\\\"version\\\":".len());
    // A program that changes metadata on purpose leaves the checksums out.
    let key = b"splat4d-crc32";
    let sealed = bytes.windows(key.len()).position(|w| w == key).expect("checkpoints have checksums");
    let mut foreign = bytes.clone();
    foreign[sealed] = b'S';
    foreign[at.expect("the metadata tells a version")] = b'7';
    for file in std::fs::read_dir(run.join("checkpoints")).unwrap() {
        std::fs::write(file.unwrap().path(), &foreign).unwrap();
    }
    let message = splat4d(&["train", "--resume", str(&run)]).run().refused();
    assert!(message.contains("version 7") && message.contains("checkpoints"), "{message}");

    // The same run on another capture: a camera has moved.
    std::fs::write(run.join("checkpoints/00000020.safetensors"), &bytes).unwrap();
    let mut moved = Capture::new(work.path());
    moved.distance = 3.1;
    moved.write();
    let message = splat4d(&["train", "--resume", str(&run)]).run().refused();
    assert!(message.contains("capture"), "{message}");
}

#[test]
fn a_plain_file_renders_as_computed_by_hand() {
    let work = tempfile::tempdir().unwrap();
    let file = work.path().join("one.ply");
    // One round Gaussian on the axis at z = 4, deviation 0.5, opacity 0.6, colour (1, 0.5, 0).
    let (z, scale, opacity, color) = (4.0f64, 0.5f64, 0.6f64, [1.0f64, 0.5, 0.0]);
    let mut params = Params::new(1, 1, LifeKind::Infinite.columns());
    let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
    geometry.write(0, 0, [0.0, 0.0, z as f32]);
    geometry.write(0, QUAT, [1.0, 0.0, 0.0, 0.0]);
    geometry.write(0, LOG_SCALE, [scale.ln() as f32; 3]);
    geometry.set(0, OPACITY, (opacity / (1.0 - opacity)).ln() as f32);
    sh.write(0, 0, color.map(|c| ((c - 0.5) / 0.282_094_791_773_878_14) as f32));
    let mut bytes = Vec::new();
    ply::write(&params, &mut bytes).unwrap();
    std::fs::write(&file, bytes).unwrap();
    let (w, h, f, cx, cy, background) = (31usize, 20usize, 24.0, 15.5, 10.0, [0.1, 0.2, 0.3]);
    let camera = json!({"fx": f, "fy": f, "cx": cx, "cy": cy, "w": w, "h": h, "background": background,
        "world_to_camera": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]});
    let camera_file = work.path().join("cam.json");
    std::fs::write(&camera_file, camera.to_string()).unwrap();
    let (png, raw) = (work.path().join("out.png"), work.path().join("view"));
    splat4d(&["render", str(&file), "--camera", str(&camera_file), "-o", str(&png), "--raw", str(&raw)]).run().ok();

    let read = |name: &str| Npy::read(&std::fs::read(work.path().join(name)).unwrap()).unwrap();
    let (color_map, alpha_map, depth_map) = (read("view.npy"), read("view.alpha.npy"), read("view.depth.npy"));
    assert_eq!((&color_map.shape, &alpha_map.shape, &depth_map.shape), (&vec![h, w, 3], &vec![h, w], &vec![h, w]));
    let (rgb, alpha, depth) = (color_map.to_f64(), alpha_map.to_f64(), depth_map.to_f64());
    // Screen variance (f·s/z)² + 0.3 px²; on the axis the projection has no shear.
    let variance = (f * scale / z).powi(2) + 0.3;
    let picture = image::open(&png).unwrap().to_rgb8();
    for y in 0..h {
        for x in 0..w {
            let (dx, dy) = (x as f64 + 0.5 - cx, y as f64 + 0.5 - cy);
            let a = opacity * (-(dx * dx + dy * dy) / (2.0 * variance)).exp();
            let a = if a < 1.0 / 255.0 { 0.0 } else { a };
            let i = y * w + x;
            // At the cut-off one side or the other is right.
            let tolerance = if (a - 1.0 / 255.0).abs() < 1e-4 || a == 0.0 { 5e-3 } else { 2e-5 };
            assert!((alpha[i] - a).abs() < tolerance, "alpha at {x} {y}: {} for {a}", alpha[i]);
            assert!((depth[i] - z * a).abs() < 4.0 * tolerance);
            for c in 0..3 {
                let value = color[c] * a + background[c] * (1.0 - a);
                assert!((rgb[3 * i + c] - value).abs() < tolerance, "colour {c} at {x} {y}");
                let byte = (rgb[3 * i + c].clamp(0.0, 1.0) * 255.0).round() as u8;
                assert_eq!(picture.get_pixel(x as u32, y as u32).0[c], byte);
            }
        }
    }
    let info: Value = serde_json::from_str(&splat4d(&["info", str(&file), "--json"]).run().ok()).unwrap();
    assert_eq!(
        (&info["gaussians"], &info["healthy"], &info["layers"][0]["sh_degree"]),
        (&json!(1), &json!(true), &json!(0))
    );

    // The same file with wrong cameras and places.
    for (key, value, reason) in [
        ("fx", json!(0), "focal"),
        ("world_to_camera", json!([[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "mirrored"),
        ("w", json!(1e7), "\"w\""),
        ("cx", Value::Null, "\"cx\""),
    ] {
        let mut wrong = camera.clone();
        wrong[key] = value;
        std::fs::write(&camera_file, wrong.to_string()).unwrap();
        let message = splat4d(&["render", str(&file), "--camera", str(&camera_file), "-o", str(&png)]).run().refused();
        assert!(message.contains(reason) && message.contains("cam.json"), "{message}");
    }
}

/// A file with one Gaussian.
fn one_gaussian(folder: &Path) -> PathBuf {
    let mut params = Params::new(1, 1, LifeKind::Infinite.columns());
    params.get_mut([GEOMETRY])[0].write(0, QUAT, [1.0, 0.0, 0.0, 0.0]);
    let mut bytes = Vec::new();
    ply::write(&params, &mut bytes).unwrap();
    let file = folder.join("one <b>.ply");
    std::fs::write(&file, bytes).unwrap();
    file
}

#[test]
fn a_page_embeds_or_links_its_scene() {
    let work = tempfile::tempdir().unwrap();
    let (file, page) = (one_gaussian(work.path()), work.path().join("page.html"));
    splat4d(&["export", str(&file), "--html", "-o", str(&page)]).run().ok();
    let html = std::fs::read_to_string(&page).unwrap();
    assert!(html.contains("<title>one &lt;b&gt;</title>") && html.contains("id=\"splat4d-scene\""));
    // The scene's magic in base64: the player gets a playback file.
    assert!(html.contains("\niVM0RA0KGgo"));
    let linked = work.path().join("a b.s4d");
    splat4d(&["export", str(&file), "--html", "-o", str(&page), "--link", str(&linked)]).run().ok();
    let html = std::fs::read_to_string(&page).unwrap();
    assert!(html.contains("./a%20b.s4d") && !html.contains("id=\"splat4d-scene\">"));
    assert!(std::fs::read(&linked).unwrap().starts_with(b"\x89S4D"));
    // A playback file is used unchanged.
    let again = work.path().join("again.s4d");
    splat4d(&["export", str(&linked), "--html", "-o", str(&page), "--link", str(&again)]).run().ok();
    assert_eq!(std::fs::read(&linked).unwrap(), std::fs::read(&again).unwrap());
    let elsewhere = tempfile::tempdir().unwrap();
    let above = elsewhere.path().join("x.s4d");
    let refused = splat4d(&["export", str(&file), "--html", "-o", str(&page), "--link", str(&above)]).run().refused();
    assert!(refused.contains("--link"), "{refused}");
}

/// Body of the response of a server at `url`.
fn get(url: &str, path: &str) -> Vec<u8> {
    use std::io::{Read, Write};
    // What follows # stays in the browser: the page's token.
    let address = url.split('#').next().unwrap().strip_prefix("http://").unwrap().trim_end_matches('/');
    let mut stream = std::net::TcpStream::connect(address).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nhost: {address}\r\nconnection: close\r\n\r\n").unwrap();
    let mut reply = Vec::new();
    stream.read_to_end(&mut reply).unwrap();
    let end = reply.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
    reply.split_off(end + 4)
}

/// Starts the command and reads on to the line that names its server.
fn serve(args: &[&str]) -> (std::process::Child, impl Iterator<Item = String> + use<>, String) {
    use std::io::{BufRead, BufReader};
    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_splat4d"))
        .args(args)
        .args(["--no-open", "--port", "0", "--json"])
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map(Result::unwrap);
    let told = lines.find(|l| l.contains("\"serving\"")).expect("it says where it serves");
    let url = serde_json::from_str::<Value>(&told).unwrap()["url"].as_str().unwrap().to_owned();
    (child, lines, url)
}

#[test]
#[cfg(unix)]
fn a_scene_is_served_until_an_interrupt() {
    let work = tempfile::tempdir().unwrap();
    let (mut child, _lines, url) = serve(&["view", str(&one_gaussian(work.path()))]);
    assert!(get(&url, "/scene.s4d").starts_with(b"\x89S4D"));
    let config: Value = serde_json::from_slice(&get(&url, "/config.json")).unwrap();
    assert_eq!((&config["title"], &config["live"]), (&json!("one <b>"), &json!(false)));
    assert!(get(&url, "/").starts_with(b"<!doctype html>"));
    std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(child.wait().unwrap().success());
    let none = splat4d(&["view", str(&work.path().join("none.ply")), "--no-open"]).run().refused();
    assert!(none.contains("none.ply"), "{none}");
}

#[test]
fn training_runs_with_and_without_a_live_server() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    let run = |name: &str| work.path().join(name);
    let watched = run("watched");
    let (mut child, lines, url) =
        serve(&[&["train", str(&capture), "-o", str(&watched), "--view", "--no-eval"], &TINY[..]].concat());
    let config: Value = serde_json::from_slice(&get(&url, "/config.json")).unwrap();
    assert_eq!(config["live"], json!(true));
    let said: Vec<String> = lines.collect();
    assert!(child.wait().unwrap().success() && said.iter().any(|l| l.contains("\"snapshot\"")), "{said:?}");

    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let answer = splat4d(&["train", str(&capture), "-o", str(&run("unseen")), "--no-eval"]).args(&TINY);
    let said = answer.args(&["--view", "--no-open", "--json", "--port", &port]).run().ok();
    assert!(said.contains("continues without the page") && run("unseen").join("scene.safetensors").is_file(), "{said}");
    let scene = |name: &str| std::fs::read(run(name).join("scene.safetensors")).unwrap();
    assert!(scene("watched") == scene("unseen"), "being watched must not change a bit");
}

#[test]
fn options_are_checked_before_any_work() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    let capture = str(&capture);
    let run = work.path().join("run");
    let recipe = work.path().join("mine.toml");
    std::fs::write(&recipe, "iteratons = 3\n").unwrap();
    let empty = work.path().join("empty.toml");
    std::fs::write(&empty, "").unwrap();
    let damaged = work.path().join("damaged.ply");
    std::fs::write(
        &damaged,
        "ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n",
    )
    .unwrap();
    let cases: &[(&[&str], &str)] = &[
        (&["train", capture, "--port", "80"], "--view"),
        (&["train", capture, "--set", "iterations=many"], "integer"),
        (&["train", capture, "--set", "densify_untl_iter=3"], "`densify_until_iter`"),
        (&["train", capture, "--recipe", str(&recipe)], "`iterations`"),
        (&["train", capture, "--recipe", str(&empty)], "is empty"),
        (&["train", capture, "--motion", "spacetim"], "`spacetime`"),
        (&["train", capture, "--hold-out", "camera=9"], "9"),
        (&["train", capture, "--hold-out", "cams=1"], "every=N"),
        (&["train", capture, "--downscale", "100"], "100"),
        (&["train", capture, "--minutes", "0"], "minutes"),
        (&["train", capture, "--quality", "good"], "draft, standard, best"),
        (&["train", capture, "--set", "run.replans=[[9,3]]"], "replans"),
        (&["train", capture, "--image-memory", "much"], "512MiB"),
        (&["train", capture, "--lpips-weights", "/nowhere.safetensors"], "/nowhere.safetensors"),
        (&["train", "/nowhere"], "/nowhere"),
        (&["train"], "CAPTURE"),
        (&["trian", capture], "train"),
        (&["train", "--resume", "/nowhere"], "/nowhere"),
        (&["train", "--resume", capture], "run"),
        (&["eval", "/nowhere"], "/nowhere"),
        (&["eval", capture], "not a run"),
        (&["info", "/nowhere"], "/nowhere"),
        (&["info", str(&damaged)], "damaged.ply"),
        (&["export", str(&damaged), "-o", "out.ply"], "damaged.ply"),
        (&["render", str(&damaged), "-o", "film.gif"], ".gif"),
        (&["render", str(&damaged), "--path", "spiral"], "orbit"),
        (&["render", str(&damaged), "--size", "0x4"], "pixels"),
    ];
    for (args, reason) in cases {
        let message = splat4d(args).run_in(work.path()).refused();
        assert!(message.contains(reason), "{args:?}: {message}");
    }
    assert!(!run.exists() && !work.path().join("runs").exists(), "nothing half-written stays");
}

#[test]
fn bad_captures_are_refused_with_name_and_remedy() {
    let work = tempfile::tempdir().unwrap();
    let spoil = |name: &str, change: &dyn Fn(&mut Capture)| {
        let folder = work.path().join(name);
        std::fs::create_dir(&folder).unwrap();
        let mut capture = Capture::new(&folder);
        change(&mut capture);
        let path = capture.write();
        let run = folder.join("run");
        (path, run)
    };
    type Change<'a> = (&'a str, &'a dyn Fn(&mut Capture), &'a str);
    let cases: &[Change<'_>] = &[
        ("truncated", &|c| c.truncated = Some((2, 1)), "0001.png"),
        ("size", &|c| c.pictures = [40, 32], "40x32"),
        ("focal", &|c| c.focal = 0.0, "focal"),
        ("mirrored", &|c| c.mirrored = true, "mirrored"),
        ("twins", &|c| c.twins = true, "pose"),
        ("json", &|c| c.cut_json = true, "capture.json"),
        ("masked", &|c| c.black_masks = true, "mask"),
    ];
    for (name, change, reason) in cases {
        let (path, run) = spoil(name, *change);
        let message = train(&path, &run).refused();
        assert!(message.contains(reason), "{name}: {message}");
        assert!(
            !run.join("scene.safetensors").exists() && !run.join("recipe.toml").exists(),
            "{name} left a half-written run"
        );
    }
}

#[test]
fn unwritable_places_are_refused() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    let file = work.path().join("file");
    std::fs::write(&file, "mine").unwrap();
    let message = train(&capture, &file.join("run")).failed();
    assert!(message.contains("run") && message.contains("-o"), "{message}");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "mine");
    let mine = work.path().join("mine");
    std::fs::create_dir(&mine).unwrap();
    std::fs::write(mine.join("thesis.txt"), "words").unwrap();
    assert!(train(&capture, &mine).refused().contains("not empty"));
    assert!(train(&capture, Path::new("/proc/nobody/run")).failed().contains("/proc/nobody"));

    if Path::new("/dev/full").exists() {
        let run = work.path().join("run");
        splat4d(&["train", str(&capture), "-o", str(&run), "--no-eval"]).args(&TINY).run().ok();
        for args in [
            &["export", str(&run), "-o", "/dev/full"][..],
            &["render", str(&run), "--path", "orbit", "--fps", "1", "-o", "/dev/full/film.png"],
        ] {
            let message = splat4d(args).run().failed();
            assert!(message.contains("/dev/full"), "{message}");
        }
        let link = work.path().join("full.ply");
        std::os::unix::fs::symlink("/dev/full", &link).unwrap();
        let message = splat4d(&["export", str(&run), "-o", str(&link)]).run().failed();
        assert!(message.contains("disk") && message.contains("full.ply"), "{message}");
        let shell = format!("{} info {} > /dev/full", env!("CARGO_BIN_EXE_splat4d"), str(&run));
        let status = std::process::Command::new("sh").args(["-c", &shell]).status().unwrap();
        assert_eq!(status.code(), Some(1), "a full disk behind standard output is an error");
    }
}

#[test]
fn a_default_folder_in_use_gets_a_number() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    for folder in ["runs/capture", "runs/capture-2"] {
        let answer = splat4d(&["train", "-s", str(&capture), "--iterations", "3", "--no-eval"])
            .args(&TINY[1..])
            .run_in(work.path());
        let said = answer.ok();
        assert!(said.contains(folder), "{said}");
        assert!(work.path().join(folder).join("scene.safetensors").is_file());
    }
    let quiet = splat4d(&["export", "runs/capture", "-o", "now.ply", "-q"]).run_in(work.path());
    assert_eq!(quiet.ok(), "");
}

#[test]
#[cfg(unix)]
fn an_interrupt_saves_and_prints_how_to_continue() {
    use std::io::{BufRead, BufReader, Read};
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    let run = work.path().join("run");
    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_splat4d"))
        .args(["train", str(&capture), "-o", str(&run), "--json"])
        .args(TINY)
        .arg("--set=iterations=1000000")
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    lines.find(|l| l.as_ref().unwrap().contains("\"progress\"")).unwrap().unwrap();
    let sent = std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    let last: Value = serde_json::from_str(&lines.last().unwrap().unwrap()).unwrap();
    assert_eq!((&last["type"], &last["code"]), (&json!("error"), &json!(1)));
    let mut stderr = String::new();
    child.stderr.take().unwrap().read_to_string(&mut stderr).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(1));
    assert!(stderr.contains(&format!("--resume {}", run.display())), "{stderr}");
    assert!(std::fs::read_dir(run.join("checkpoints")).unwrap().count() > 0);
    assert!(!run.join("scene.safetensors").exists());
}

#[test]
fn a_playback_file_is_described_exported_and_refused_when_damaged() {
    let work = tempfile::tempdir().unwrap();
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../splat4d/tests/data/tiny.s4d");
    let told: Value = serde_json::from_str(&splat4d(&["info", "--json", str(&file)]).run().ok()).unwrap();
    assert_eq!((&told["type"], &told["gaussians"]), (&json!("playback"), &json!(2)));
    let moments = told["playback"]["moments"].as_array().unwrap();
    let alive: Vec<u64> = moments.iter().map(|m| m["gaussians"].as_u64().unwrap()).collect();
    assert_eq!(alive, [2, 2, 2, 1, 1], "one lives in the first half only");
    let text = splat4d(&["info", str(&file)]).run().ok();
    assert!(text.contains("playback file") && text.contains("PALT") && text.contains("Mbit/s"), "{text}");

    let out = work.path().join("now.ply");
    splat4d(&["export", str(&file), "-o", str(&out), "--time", "0.3"]).run().ok();
    let (params, _) = ply::read(&std::fs::read(&out).unwrap()).unwrap();
    // It moves at 2 units per second and was at x = 1 at 0.25 s.
    assert_eq!(params.len(), 2);
    assert!((params[GEOMETRY].get(1, 0) - 1.1).abs() < 1e-3, "{}", params[GEOMETRY].get(1, 0));

    // Files for a program are those of `convert`.
    let [exported, converted] = ["exported", "converted"].map(|name| work.path().join(name));
    splat4d(&["export", str(&file), "--sequence", str(&exported), "--for", "nuke", "--fps", "4"]).run().ok();
    splat4d(&["convert", str(&file), str(&converted), "--frames", "--for", "nuke", "--fps", "4"]).run().ok();
    let read = |folder: &Path| std::fs::read(folder.join("frame.0001.ply")).unwrap();
    assert_eq!(read(&exported), read(&converted));
    let one = work.path().join("one.ply");
    splat4d(&["export", str(&file), "-o", str(&one), "--time", "0.3", "--for", "unreal"]).run().ok();
    let (params, _) = ply::read(&std::fs::read(&one).unwrap()).unwrap();
    assert_eq!(params.len(), 2);
    let page = work.path().join("page.html");
    splat4d(&["export", str(&file), "-o", str(&page), "--for", "unity"]).run().refused();

    let mut bytes = std::fs::read(&file).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    let spoilt = work.path().join("spoilt.s4d");
    std::fs::write(&spoilt, &bytes).unwrap();
    let told = splat4d(&["info", str(&spoilt)]).run().refused();
    assert!(told.contains("checksum") && told.contains("spoilt.s4d"), "{told}");
    let page = work.path().join("page.html");
    let told = splat4d(&["export", str(&spoilt), "-o", str(&page)]).run().refused();
    assert!(told.contains("checksum") && !page.exists(), "{told}");

    // No command needs the poster; what is wrong with it is reported.
    let knight = std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/knight.s4d")).unwrap();
    let index = Index::parse(&knight, Some(knight.len() as u64)).unwrap();
    let poster = index.sections.iter().find(|e| e.kind == Kind::Poster).expect("it has a poster");
    let mut bytes = knight.clone();
    bytes[poster.offset as usize + 100] ^= 4;
    std::fs::write(&spoilt, &bytes).unwrap();
    let told = splat4d(&["info", str(&spoilt)]).run().ok();
    assert!(told.contains("poster is damaged") && !told.contains("looks healthy"), "{told}");
    let told = splat4d(&["info", "--strict", str(&spoilt)]).run().listed();
    assert!(told.contains("checksum of the poster"), "{told}");

    // What a file is called is shown, and no terminal obeys it.
    #[cfg(unix)]
    {
        let odd = work.path().join("a\u{1b}]0;b\u{7}\u{9b}2J.s4d");
        std::fs::copy(&file, &odd).unwrap();
        let gone = odd.with_extension("gone");
        for said in [
            splat4d(&["info", str(&odd)]).run().all(),
            splat4d(&["info", "--json", str(&odd)]).run().all(),
            splat4d(&["info", str(&gone)]).run().refused(),
            splat4d(&["info", str(&odd), str(&gone)]).run().refused(),
        ] {
            assert!(!said.contains(['\u{1b}', '\u{7}', '\u{9b}']), "{said:?}");
        }
        let refused = splat4d(&["info", "/dev/zero"]).run().refused();
        assert!(refused.contains("regular file"), "{refused}");
    }

    // The extension of versions before 0.1, which another program uses for a format of its own.
    let old = work.path().join("old.splat4d");
    std::fs::copy(&file, &old).unwrap();
    assert!(splat4d(&["info", str(&old)]).run().ok().contains("playback file"));
    std::fs::write(&old, b"SP4D\x01\0\0\0\x0c\x02\0\0{\"n\":40}").unwrap();
    let told = splat4d(&["info", str(&old)]).run().refused();
    assert!(told.contains("splats4D") && told.contains("damaged"), "{told}");
}

#[test]
fn a_run_is_baked_and_the_file_is_as_good() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    let run = work.path().join("run");
    let said = splat4d(&["train", str(&capture), "-o", str(&run), "--no-eval"]).args(&TINY).run().ok();
    assert!(said.contains("scene.s4d") && said.contains("against its model"), "{said}");
    let (out, report) = (work.path().join("out.s4d"), work.path().join("report.json"));
    let said =
        splat4d(&["bake", str(&run), "-o", str(&out), "--report", str(&report), "--repeat", "3", "--json"]).run().ok();
    assert!(said.lines().any(|l| l.contains("\"type\":\"baked\"")), "{said}");
    let told = json_of(&report);
    assert!(told["likeness"]["psnr"].as_f64().unwrap() > 40.0, "{told}");
    assert!(told["baking"]["gaussians"].as_u64().unwrap() > 50 && told["clip"][1].as_f64().unwrap() > 0.3, "{told}");
    assert_eq!(told["bytes"].as_u64().unwrap(), std::fs::metadata(&out).unwrap().len());
    let played = splat4d::format::playback::read(&std::fs::read(&out).unwrap()).unwrap();
    assert_eq!(played.len() as u64, told["baking"]["primitives"].as_u64().unwrap());
    for (args, reason) in [
        (vec!["-o", "x.ply"], ".s4d"),
        (vec!["-o", str(&out), "--tolerance", "0"], "tolerance"),
        (vec!["-o", str(&out), "--repeat", "0"], "repeat"),
        (vec!["-o", str(&out), "--segment", "nan"], "segments"),
    ] {
        let message = splat4d(&["bake", str(&run)]).args(&args).run().refused();
        assert!(message.contains(reason), "{args:?}: {message}");
    }
}
