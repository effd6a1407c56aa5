//! Baking, conversion and export as functions: the same files and events as the command's, without a terminal.

use splat4d::ErrorKind;
use splat4d::edit::Step;
use splat4d::format::npy::Npy;
use splat4d::format::ply::write_placed;
use splat4d::scene::params::{LOG_SCALE, QUAT};
use splat4d::scene::{GEOMETRY, Params};
use splat4d_train::recipe::Recipe;
use splat4d_workflow::adopting::OnCapture;
use splat4d_workflow::baking::{self, Baking};
use splat4d_workflow::comparison::compare;
use splat4d_workflow::compressing::{CompressOptions, compress};
use splat4d_workflow::converting::{self, Conversion};
use splat4d_workflow::editing::{EditOptions, edit};
use splat4d_workflow::evaluating::{Measure, evaluate};
use splat4d_workflow::events::{Event, Listener, ignore};
use splat4d_workflow::exporting::{self, Frames, PlyOptions, TrackOptions};
use splat4d_workflow::inspecting::{InspectOptions, inspect};
use splat4d_workflow::labelling::label;
use splat4d_workflow::localising::{LocaliseOptions, localise};
use splat4d_workflow::predicting::{PredictOptions, predict};
use splat4d_workflow::rendering::{RenderOptions, film};
use splat4d_workflow::source::Source;
use splat4d_workflow::training::{self, Finish, TrainingOptions};
use std::cell::RefCell;
use std::path::Path;
use std::sync::atomic::AtomicBool;

const GAUSSIANS: usize = 8;

/// A still scene as a .ply.
fn write_scene(path: &Path) {
    let mut params = Params::<f32>::new(GAUSSIANS, 1, &[]);
    for row in 0..GAUSSIANS {
        params[GEOMETRY].write(row, 0, [0.1 * row as f32, 0.0, 1.0]);
        params[GEOMETRY].write(row, QUAT, [1.0, 0.0, 0.0, 0.0]);
        params[GEOMETRY].write(row, LOG_SCALE, [-3.0; 3]);
    }
    let mut bytes = Vec::new();
    write_placed(&params, ([0.0; 3], false), None, &mut bytes).unwrap();
    std::fs::write(path, bytes).unwrap();
}

#[test]
fn a_scene_is_baked_converted_and_exported_by_functions() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let scene = at("scene.ply");
    write_scene(&scene);
    let (records, written) = (RefCell::new(Vec::new()), RefCell::new(Vec::new()));
    let listen = |event: &Event<'_>| match event {
        Event::Record(value) => records.borrow_mut().push((*value).clone()),
        Event::Written(path) => written.borrow_mut().push(path.to_path_buf()),
        _ => {}
    };
    let listener: &dyn Listener = &listen;

    let baked = baking::bake(&scene, &at("a.s4d"), Some(&at("a.json")), &Baking::default(), listener).unwrap();
    assert_eq!((&baked["type"], &baked["baking"]["gaussians"]), (&"baked".into(), &GAUSSIANS.into()));
    assert_eq!(Source::open(&at("a.s4d")).unwrap().scene.len(), GAUSSIANS);
    converting::run(&Conversion::new(&scene, at("a.spz")), listener).unwrap();
    assert_eq!(Source::open(&at("a.spz")).unwrap().scene.len(), GAUSSIANS);
    exporting::page(&scene, &at("a.html"), None, listener).unwrap();
    assert!(std::fs::read_to_string(at("a.html")).unwrap().contains("<html"));
    let source = Source::open(&scene).unwrap();
    assert_eq!(exporting::moment(&source.scene, 0.0, PlyOptions::default(), &at("now.ply")).unwrap(), GAUSSIANS);

    let kinds: Vec<String> = records.borrow().iter().map(|r: &serde_json::Value| r["type"].to_string()).collect();
    assert_eq!(kinds, ["\"baked\"", "\"converted\""]);
    assert_eq!(*written.borrow(), ["a.s4d", "a.json", "a.spz", "a.html"].map(at));
}

#[test]
fn scenes_are_inspected_and_followed_by_functions() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write_scene(&at("scene.ply"));
    let found = inspect(&at("scene.ply"), &InspectOptions::default(), &ignore).unwrap();
    assert_eq!((&found.json["gaussians"], found.is_healthy()), (&GAUSSIANS.into(), true), "{}", found.text);
    let doctor = InspectOptions { doctor: Some(at("doctor")), ..InspectOptions::default() };
    assert!(inspect(&at("scene.ply"), &doctor, &ignore).is_err() && !at("doctor").exists(), "it is not a capture");

    let source = exporting::open(&at("scene.ply"), None).unwrap();
    let frames = Frames { fps: Some(2.0), ..Frames::default() };
    let options = |near| TrackOptions { frames, near, ..TrackOptions::default() };
    let tracked = |near, name: &str| {
        exporting::tracks(&source.scene, &options(near), &at(name), &ignore).unwrap();
        std::fs::read_to_string(at(name)).unwrap()
    };
    let (all, one) = (tracked(None, "all.csv"), tracked(Some(([0.7, 0.0, 1.0], 1)), "one.csv"));
    assert_eq!(all.lines().count() - 1, GAUSSIANS * (one.lines().count() - 1), "{one}");
    let error = exporting::tracks(&source.scene, &options(None), &at("all.txt"), &ignore).unwrap_err().to_string();
    assert!(error.contains("option `tracks` NAME.csv") && !error.contains("--"), "{error}");
    let with_velocities = (PlyOptions { velocities: true, ..PlyOptions::default() }, false);
    let count = exporting::frames(&at("scene.ply"), &source, &at("frames"), &frames, with_velocities, &ignore).unwrap();
    let frame = std::fs::read(at("frames/frame_00000.ply")).unwrap();
    assert!(String::from_utf8_lossy(&frame).contains("property float vz\nend_header"), "velocities are written");
    assert_eq!(Source::open(&at("frames/frame_00000.ply")).unwrap().scene.len(), GAUSSIANS);
    assert!(count > 0 && at("frames/frame_00000.ply").is_file());
    let error = localise(&at("scene.ply"), &[at("a.png")], &LocaliseOptions::default(), &ignore).unwrap_err();
    assert!(error.to_string().contains("option `start`"), "{error}");
}

/// Positions differ from time to time by the velocities that are next to them.
#[test]
fn scene_flow_is_written_with_its_positions() {
    let folder = tempfile::tempdir().unwrap();
    let example = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/knight.s4d"));
    let source = exporting::open(example, None).unwrap();
    let frames = Frames { fps: Some(2000.0), from: Some(0.4), to: Some(0.401) };
    let options = TrackOptions { frames, every: 40, ..TrackOptions::default() };
    let out = folder.path().join("flow.npz");
    exporting::tracks(&source.scene, &options, &out, &ignore).unwrap();
    let bytes = std::fs::read(&out).unwrap();
    let array = |name: &str| Npy::read_member(&bytes, name).unwrap();
    let (times, x, v) = (array("times").to_f64(), array("positions"), array("velocities"));
    assert_eq!((x.shape.clone(), v.shape.clone(), times.len()), (v.shape.clone(), x.shape.clone(), x.shape[0]));
    let (count, x, v) = (3 * x.shape[1], x.to_f64(), v.to_f64());
    let step = times[1] - times[0];
    let (mut fastest, mut off) = (0.0f64, Vec::new());
    for k in 0..count {
        let moved = (x[count + k] - x[k]) / step;
        if moved.is_finite() {
            fastest = fastest.max(v[k].abs());
            off.push((moved - v[k]).abs());
        }
    }
    off.sort_by(f64::total_cmp);
    // Positions are 32-bit floats, so that a difference over half a millisecond is coarse.
    assert!(off.len() > 300 && fastest > 0.5 && off[off.len() * 9 / 10] < 0.02, "{fastest} {off:?}");
    let points = exporting::points(&source, Path::new("asked.csv"), &frames, &out, &ignore).unwrap_err().to_string();
    assert!(points.contains("NAME.csv"), "{points}");
}

#[test]
fn a_capture_is_trained_and_continued_by_functions() {
    let folder = tempfile::tempdir().unwrap();
    let (run, stop) = (folder.path().join("run"), AtomicBool::new(false));
    let capture = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/knight"));
    let mut recipe = Recipe::default();
    for setting in ["motion=still", "iterations=4", "downscale=16", "max_frames=1", "sh_degree=0", "init.count=200"] {
        recipe.set(setting).unwrap();
    }
    let begun = RefCell::new(Vec::new());
    let listen = |event: &Event<'_>| {
        if let Event::Begun { title, capture, .. } = event {
            begun.borrow_mut().push((title.to_string(), capture.is_some()));
        }
    };
    let options = TrainingOptions { output: Some(run.clone()), finish: Finish::Scene, ..TrainingOptions::default() };
    let stopped = AtomicBool::new(true);
    let trained = training::train(capture, &recipe, &options, &stopped, &listen).unwrap();
    assert!(trained.interrupted && trained.run == run && !run.join("scene.safetensors").exists());
    let trained = training::resume(&run, &options, &stop, &listen).unwrap();
    assert_eq!((trained.iteration, trained.interrupted), (Some(4), false));
    assert!(run.join("scene.safetensors").is_file() && !run.join("report.html").exists());
    assert_eq!(begun.borrow()[0], ("knight".to_owned(), true));
    let error = training::resume(&folder.path().join("none"), &options, &stop, &ignore).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::BadInput, "{error}");
}

#[test]
fn a_compression_uses_the_refined_cameras_of_its_run() {
    let folder = tempfile::tempdir().unwrap();
    let (run, small) = (folder.path().join("run"), folder.path().join("small"));
    let stop = AtomicBool::new(false);
    let capture = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/knight"));
    let mut recipe = Recipe::default();
    let plain = ["motion=still", "iterations=40", "downscale=16", "max_frames=1", "sh_degree=0", "init.count=200"];
    let refined = ["refine.poses=true", "refine.poses_from=0", "refine.position_init=0.05", "refine.align_steps=0"];
    plain.iter().chain(&refined).for_each(|setting| recipe.set(setting).unwrap());
    let options = TrainingOptions { output: Some(run.clone()), ..TrainingOptions::default() };
    training::train(capture, &recipe, &options, &stop, &ignore).unwrap();
    let options = CompressOptions { output: Some(small.clone()), fine_tune: Some(8), ..CompressOptions::default() };
    compress(&run, &CompressOptions { size: [32, 24], ..options }, &stop, &ignore).unwrap();

    let read = |path: &Path| -> serde_json::Value { serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap() };
    let cameras = |of: &Path| read(&of.join("refined.json"))["cameras"].clone();
    let moved = |row: &serde_json::Value| row["twist"].as_array().unwrap().iter().any(|x| x.as_f64() != Some(0.0));
    assert!(cameras(&run).as_array().unwrap().iter().any(moved), "the run moves cameras");
    assert_eq!(cameras(&small), cameras(&run));
    // What the run measured of its scene is what the compression measured of it.
    let before = read(&small.join("compress.json"))["before"]["psnr_train"].as_f64().unwrap();
    let measured = read(&run.join("results.json"))["train"]["ours_40"]["PSNR"].as_f64().unwrap();
    assert!((before - measured).abs() < 1e-6, "{before} dB, {measured} dB");
}

#[test]
fn a_scene_of_another_program_is_compressed_on_its_capture() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (scene, stop) = (at("scene.ply"), AtomicBool::new(false));
    write_scene(&scene);
    let capture = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/knight")).to_owned();
    let on = OnCapture { capture, hold_out: Some("camera=cam02".into()), downscale: Some(16) };
    let options = CompressOptions {
        on: Some(on.clone()),
        output: Some(at("small")),
        prune: Some(0.25),
        fine_tune: Some(8),
        size: [32, 24],
        ..CompressOptions::default()
    };
    let warnings = RefCell::new(Vec::new());
    let listen = |event: &Event<'_>| {
        if let Event::Warning(text) = event {
            warnings.borrow_mut().push(text.to_string());
        }
    };
    compress(&scene, &options, &stop, &listen).unwrap();
    assert!(warnings.borrow().iter().any(|w| w.contains("not those of the capture")), "{:?}", warnings.borrow());
    assert_eq!(Source::open(&at("small/original")).unwrap().scene.len(), GAUSSIANS);
    assert_eq!(Source::open(&at("small/scene.s4d")).unwrap().scene.len(), GAUSSIANS * 3 / 4);
    let read = |name: &str| -> serde_json::Value { serde_json::from_slice(&std::fs::read(at(name)).unwrap()).unwrap() };
    let compared = read("small/compress.json");
    assert!(compared["before"]["psnr_train"].is_f64() && compared["after"]["psnr_train"].is_f64(), "{compared}");
    let held = &read("small/per_view.json")["ours_8"]["camera"];
    assert!(held.as_object().unwrap().values().all(|name| name == "cam02"), "{held}");
    assert!(scene.is_file() && at("small/report.html").is_file());
    // Such a folder is a run, which knows its capture.
    let again = CompressOptions { on: Some(on), output: Some(at("again")), ..CompressOptions::default() };
    let error = compress(&at("small"), &again, &stop, &ignore).unwrap_err().to_string();
    assert!(error.contains("Leave option `capture`") && !at("again").exists(), "{error}");
    let error = compress(&scene, &CompressOptions::default(), &stop, &ignore).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::BadInput, "{error}");
    assert!(error.to_string().contains("option `capture`"), "{error}");
}

#[test]
fn unwritable_outputs_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let scene = at("scene.ply");
    write_scene(&scene);
    let bake = |out: &str| baking::bake(&scene, &at(out), None, &Baking::default(), &ignore);
    assert!(bake("a.ply").unwrap_err().to_string().contains(".s4d"));
    let convert = |out: &str| converting::run(&Conversion::new(&scene, at(out)), &ignore);
    assert!(convert("a.nothing").unwrap_err().to_string().contains("ending"));
    assert!(convert("scene.ply").is_err(), "the input stays");
}

#[test]
fn a_scene_is_edited_and_filmed_and_scores_are_compared() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let scene = at("scene.ply");
    write_scene(&scene);
    let records = RefCell::new(Vec::new());
    let listen = |event: &Event<'_>| {
        if let Event::Record(value) = event {
            records.borrow_mut().push((*value).clone());
        }
    };
    // The three Gaussians at x = 0, 0.1 and 0.2.
    let steps = vec![Step::Delete { select: "box(-0.05,-1,0, 0.25,1,2)".into() }];
    let options =
        EditOptions { scene: scene.clone(), output: Some(at("a.safetensors")), steps, ..EditOptions::default() };
    edit(&options, &listen).unwrap();
    assert_eq!(Source::open(&at("a.safetensors")).unwrap().scene.len(), GAUSSIANS - 3);
    let options =
        RenderOptions { output: Some(at("film")), size: Some([16, 12]), fps: Some(1.0), ..RenderOptions::default() };
    film(&scene, &options, &listen).unwrap();
    assert!(at("film/00000.png").is_file());
    for (name, psnr) in [("one", 30.25), ("two", 31.5)] {
        std::fs::create_dir(at(name)).unwrap();
        std::fs::write(at(name).join("results.json"), format!("{{\"ours_10\": {{\"PSNR\": {psnr}}}}}")).unwrap();
    }
    compare(&[at("one"), at("two")], &[at("table.csv")], &listen).unwrap();
    let table = std::fs::read_to_string(at("table.csv")).unwrap();
    assert!(table.contains("30.25") && table.contains("31.50"), "{table}");
    let records = records.borrow();
    let of = |kind: &str| records.iter().find(|r: &&serde_json::Value| r["type"] == kind).unwrap();
    assert_eq!((&of("edited")["before"], &of("edited")["gaussians"]), (&GAUSSIANS.into(), &(GAUSSIANS - 3).into()));
    assert_eq!(of("compared")["runs"][1]["scores"]["PSNR"], 31.5);
}

#[test]
fn workflows_of_runs_refuse_other_folders() {
    let folder = tempfile::tempdir().unwrap();
    let (run, stop) = (folder.path(), AtomicBool::new(false));
    let errors = [
        evaluate(run, &Measure::default(), &stop, &ignore).err(),
        compress(run, &CompressOptions::default(), &stop, &ignore).err(),
        label(run, None, None, &stop, &ignore).err(),
        predict(PredictOptions::new(run), &stop, &ignore).err(),
    ];
    for error in errors {
        let error = error.expect("an empty folder is no run");
        assert_eq!(error.kind(), ErrorKind::BadInput, "{error}");
    }
    assert_eq!(std::fs::read_dir(run).unwrap().count(), 0, "nothing is left behind");
}
