//! `compress` on a tiny run: what it leaves, what it states, what it refuses.

use crate::sample::{Capture, splat4d};
use crate::{json_of, str, train};
use serde_json::Value;
use std::path::Path;

#[test]
fn a_run_is_compressed_and_measured_before_and_after() {
    let work = tempfile::tempdir().unwrap();
    let run = work.path().join("run");
    train(&Capture::new(work.path()).write(), &run).ok();
    let dir = work.path().join("small");
    let steps = ["--fine-tune", "8", "--guard", "0", "--size", "32x24"];
    let compress = |extra: &[&str]| splat4d(&["compress", str(&run)]).args(&steps).args(extra);
    let lines = compress(&["-o", str(&dir), "--prune", "0.5", "--unpruned", "--json"]).run().ok();
    let last: Value = serde_json::from_str(lines.lines().last().unwrap()).unwrap();
    assert_eq!(last["type"], "compressed");

    let told = json_of(&dir.join("compress.json"));
    let file = std::fs::read(dir.join("scene.s4d")).unwrap();
    assert_eq!(told["after"]["bytes"].as_u64(), Some(file.len() as u64), "the size told is the file's");
    assert_eq!(last["bytes"].as_u64(), Some(file.len() as u64));
    let table = work.path().join("table.csv");
    splat4d(&["compare", str(&run), str(&dir), "-o", str(&table)]).run().ok();
    let rows = std::fs::read_to_string(&table).unwrap();
    assert!(rows.lines().last().unwrap().contains(&format!(",{},", file.len())), "{rows}");
    let gaussians = |side: &str| told[side]["gaussians"].as_u64().unwrap();
    assert_eq!(gaussians("unpruned"), gaussians("before"));
    assert!(gaussians("after") <= gaussians("before").div_ceil(2), "half is gone");
    assert_eq!(told["settings"]["prune"], 0.5);
    let stages: Vec<&str> = told["stages"].as_array().unwrap().iter().map(|s| s["name"].as_str().unwrap()).collect();
    // Of eight steps none is left for the first round.
    assert_eq!(stages, ["pruned 2/4", "pruned 3/4", "pruned 4/4", "quantised"]);
    let spent: u64 = told["stages"].as_array().unwrap().iter().map(|s| s["steps"].as_u64().unwrap()).sum();
    assert_eq!(spent, 8, "as many steps as were asked for");

    // The scores are those of the file: its scene equals the folder's.
    let scores = json_of(&dir.join("results.json"));
    assert_eq!(scores["ours_8"]["PSNR"], told["after"]["psnr"]);
    let scene = splat4d::format::scene::read(&std::fs::read(dir.join("scene.safetensors")).unwrap()).unwrap();
    let played = splat4d::format::playback::read(&file).unwrap();
    assert_eq!(scene.layers.len(), played.layers.len());
    for (a, b) in scene.layers.iter().zip(&played.layers) {
        assert!(a.params == b.params && a.masks == b.masks && a.span == b.span, "the file is what was learnt");
    }
    assert!(played.layers.iter().all(|l| l.masks.is_some()), "level 2 filters");

    // It is a run like any other; the original is as it was.
    let page = std::fs::read_to_string(dir.join("report.html")).unwrap();
    assert!(page.contains("Compressed") && page.contains("not pruned, same steps"), "the report compares");
    assert!(page.contains("removed Gaussians alone"));
    let removed = image::open(dir.join("removed/00000.png")).unwrap().to_rgb8();
    assert!(removed.pixels().any(|p| p.0 != [0; 3]), "what was removed is drawn");
    assert!(!dir.join("removed-1.safetensors").exists() && !dir.join("removed-4.safetensors").exists());
    splat4d(&["info", str(&dir)]).run().ok();
    splat4d(&["eval", str(&dir)]).run().ok();
    assert_eq!(std::fs::read(dir.join("scene.s4d")).unwrap(), file, "measuring does not bake anew");
    assert_eq!(
        json_of(&dir.join("results.json"))["ours_8"]["PSNR"],
        told["after"]["psnr"],
        "it measures the same again"
    );
    assert!(!run.join("compress.json").exists() && !run.join("unpruned").exists());

    // A finished compression is reported again without a step, and never taken over.
    let again = splat4d(&["compress", "--resume", str(&dir), "--size", "32x24"]).run().ok();
    assert!(again.contains("times smaller"), "{again}");
    assert_eq!(std::fs::read(dir.join("scene.s4d")).unwrap(), file);
    let taken = compress(&["-o", str(&dir)]).run().refused();
    assert!(taken.contains("--resume") && taken.contains("--force"), "{taken}");
    let train = splat4d(&["train", "--resume", str(&dir)]).run().refused();
    assert!(train.contains("splat4d compress"), "{train}");
}

#[test]
fn a_size_is_kept_or_refused_with_the_smallest_that_is_possible() {
    let work = tempfile::tempdir().unwrap();
    let run = work.path().join("run");
    train(&Capture::new(work.path()).write(), &run).ok();
    let compress = |mb: &str, dir: &str| {
        let out = work.path().join(dir);
        splat4d(&["compress", str(&run), "-o", str(&out), "--fine-tune", "4", "--size", "32x24", "--max-mb", mb]).run()
    };
    let least = compress("0.001", "none").refused();
    assert!(least.contains("Give --max-mb at least"), "{least}");
    // The named files suffice.
    let named = least.split("at least ").nth(1).unwrap().trim_end().trim_end_matches('.').to_owned();
    compress(&named, "least").ok();
    let bytes = std::fs::metadata(work.path().join("least/scene.s4d")).unwrap().len();
    assert!(bytes as f64 <= named.parse::<f64>().unwrap() * 1e6, "{bytes} bytes of {named} MB");
}

#[test]
fn invalid_options_are_refused_before_any_work() {
    let work = tempfile::tempdir().unwrap();
    let run = work.path().join("run");
    let capture = Capture::new(work.path()).write();
    train(&capture, &run).ok();
    let refused = |args: &[&str]| splat4d(&["compress"]).args(args).run().refused();
    let run_text = str(&run);
    for (args, says) in [
        (vec![run_text, "--prune", "1.5"], "0.98"),
        (vec![run_text, "--level", "3"], "0..=2"),
        (vec![run_text, "--level", "1", "--prune", "0.5"], "level 2"),
        (vec![run_text, "--set", "prun=0.5"], "`prune`"),
        (vec![run_text, "--set", "temporal=sometimes"], "sometimes"),
        (vec![run_text, "--set", "depths.color=9"], "color"),
        (vec![run_text, "--max-mb=-1"], "megabytes"),
        (vec![run_text, "-o", run_text], "is the run"),
        (vec![str(&capture)], "not a run"),
        (vec!["nowhere"], "no such run"),
        (vec!["--resume", run_text], "no compression"),
    ] {
        let said = refused(&args);
        assert!(said.contains(says), "{args:?}: {said}");
    }
    std::fs::remove_file(run.join("scene.safetensors")).unwrap();
    assert!(refused(&[run_text]).contains("train --resume"));
    assert!(!work.path().join("run-compressed").exists(), "nothing was begun");
}

#[test]
fn a_ladder_that_is_not_kept_is_reported_with_the_command_that_bakes_it() {
    let work = tempfile::tempdir().unwrap();
    let [run, plain, ladder, dir] = ["run", "plain.s4d", "ladder.s4d", "small"].map(|name| work.path().join(name));
    let capture = Capture::new(work.path()).write();
    train(&capture, &run).ok();
    let compress = |scene: &Path, dir: &Path| {
        let quick = ["--level", "1", "--fine-tune", "0", "--no-eval", "-o", str(dir)];
        splat4d(&["compress", str(scene), "--capture", str(&capture)]).args(&quick).run().all()
    };
    splat4d(&["bake", str(&run), "-o", str(&plain)]).run().ok();
    assert!(!compress(&plain, &work.path().join("without")).contains("bitrate ladder"));
    splat4d(&["bake", str(&run), "-o", str(&ladder), "--ladder", "5,50"]).run().ok();
    let said = compress(&ladder, &dir);
    let command =
        said.split("bake it again: splat4d ").nth(1).unwrap_or_else(|| panic!("{said}")).lines().next().unwrap();
    let arguments: Vec<&str> = command.split(' ').collect();
    assert_eq!(arguments[..2], ["bake", str(&dir)]);
    splat4d(&arguments).run().ok();
    let again = splat4d(&["info", arguments[3]]).run().ok();
    assert!(again.contains("rung 1 of"), "{again}");
}
