//! The studies on a tiny run and a tiny capture: every cell is measured once, and what is found can be trusted.

#[path = "studies/bench.rs"]
mod bench;
#[allow(dead_code)] // what the command's tests alone need
#[path = "../../crates/splat4d-cli/tests/cli/sample.rs"]
mod sample;

use sample::{Capture, splat4d as studies};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// A run that takes a second.
const TINY: [&str; 6] = [
    "--set=iterations=20",
    "--set=num_pts=120",
    "--set=max_cap=150",
    "--set=sh_degree=1",
    "--set=checkpoint_interval=10",
    "--seed=3",
];

fn str(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn json_of(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn a_study_of_pruning_measures_every_cell_once() {
    let work = tempfile::tempdir().unwrap();
    let run = work.path().join("run");
    studies(&["train", str(&Capture::new(work.path()).write()), "-o", str(&run)]).args(&TINY).run().ok();
    let folder = work.path().join("study");
    // As small as the capture: how long a render takes is not what is tested.
    let order = ["e03", str(&run), "-o", str(&folder), "--quick", "--fine-tune", "4", "--size", "32x24"];
    let study = || studies(&order);
    let lines = study().args(&["--json"]).run().ok();
    let events: Vec<Value> = lines.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    let told = events.iter().filter(|e| e["type"] == "cell").count();

    let file = folder.join("e03.json");
    let found = json_of(&file);
    let cells: BTreeMap<String, Value> = found["runs"][0]["cells"]
        .as_array()
        .unwrap()
        .iter()
        .map(|c| (c["key"].as_str().unwrap().to_owned(), c.clone()))
        .collect();
    assert_eq!(cells.len(), told, "every cell is a line, and none is there twice");
    assert!(!folder.join("work").exists(), "what cells were made from is gone");
    let psnr = |key: &str| cells[key]["side"]["psnr"].as_f64().unwrap();
    let gaussians = |key: &str| cells[key]["side"]["gaussians"].as_u64().unwrap();
    // The source is measured as `train` did, and removed Gaussians are counted.
    let own = json_of(&run.join("results.json"))["ours_20"]["PSNR"].as_f64().unwrap();
    let source = "prune000-steps0-interval0";
    assert!((psnr(source) - own).abs() < 1e-9, "{} and {own}", psnr(source));
    let pruned = |share: usize, rest: &str| format!("prune{share:03}-change-instant-abs-product-flat-rounds1-{rest}");
    for share in [500, 800, 950] {
        let left = gaussians(source) as f64 * (1.0 - share as f64 / 1000.0);
        let key = pruned(share, "steps0-interval0");
        assert!((gaussians(&key) as f64 - left).abs() <= 1.0, "{share}: {} of {left}", gaussians(&key));
    }
    assert!(psnr(&pruned(950, "steps0-interval0")) < psnr(&pruned(500, "steps0-interval0")));
    assert!(psnr("prune000-steps4-interval0") != psnr(source), "fine-tuning does something");
    let alive = |key: &str| cells[key]["side"]["active_mean"].as_f64().unwrap();
    assert!(alive("prune000-steps0-interval20") <= alive(source), "the filter adds nobody");
    assert!(cells.values().all(|c| c["speed"].as_f64().is_some_and(|s| s > 0.0)));

    // Tables and curves for people; a second call measures nothing.
    for name in ["e03.md", "e03-prune.svg", "e03-prune-moving.svg", "e03-interval.svg"] {
        assert!(folder.join(name).is_file(), "{name} is missing");
    }
    let before = std::fs::read(&file).unwrap();
    let said = study().run().ok();
    assert!(said.contains("| 95 % |") && said.contains("4DGS-1K"), "{said}");
    assert_eq!(std::fs::read(&file).unwrap(), before, "finished cells are kept");

    // Half of it is lost: only that half is measured again.
    let mut cut = found.clone();
    cut["runs"][0]["cells"].as_array_mut().unwrap().truncate(told - 2);
    std::fs::write(&file, cut.to_string()).unwrap();
    let lines = study().args(&["--json"]).run().ok();
    assert_eq!(lines.lines().filter(|l| l.contains("\"type\":\"cell\"")).count(), 2);

    let twice = studies(&["e03", str(&run), str(&run), "-o", str(&folder)]).run().refused();
    assert!(twice.contains("name of another run"), "{twice}");
    std::fs::write(&file, "{}").unwrap();
    assert!(study().run().refused().contains("e03.json"));
    let none = studies(&["e03", str(&folder)]).run().refused();
    assert!(none.contains("is not a run"), "{none}");
}

#[test]
fn the_filter_is_studied_part_by_part() {
    let work = tempfile::tempdir().unwrap();
    let capture = Capture::new(work.path()).write();
    let folder = work.path().join("study");
    let study = || {
        // Straight paths have no second difference for the linear regulariser to act on: order 2.
        let small =
            ["num_pts=120", "max_cap=150", "sh_degree=1", "hold_out=camera=1", "motion_order=2"].map(|s| ["--set", s]);
        let order = ["e02", str(&capture), "-o", str(&folder), "--quick", "--motion", "spacetime"];
        studies(&order).args(&["--iterations", "16", "--downscale", "1"]).args(small.as_flattened())
    };
    let lines = study().args(&["--json"]).run().ok();
    let cells = |lines: &str| -> Vec<Value> {
        let all = lines.lines().map(|l| serde_json::from_str::<Value>(l).unwrap());
        all.filter(|e| e["type"] == "cell").map(|e| e["cell"].clone()).collect()
    };
    let found = cells(&lines);
    let keys: Vec<&str> = found.iter().map(|c| c["key"].as_str().unwrap()).collect();
    assert_eq!(keys, ["alone", "filter", "kept", "retuned", "linear", "w2", "both"]);
    let psnr = |i: usize| found[i]["psnr"].as_f64().unwrap();
    assert!((0..keys.len()).all(|i| psnr(i) > 5.0 && found[i]["minutes"].as_f64().unwrap() > 0.0));
    // Every part changes something, and none of them everything.
    assert!((1..keys.len()).all(|i| psnr(i) != psnr(0) && (psnr(i) - psnr(0)).abs() < 3.0), "{found:?}");
    assert!(found[0]["flow"].is_null(), "the capture has no truth of flow");
    assert!(!folder.join("work").exists());
    let page = std::fs::read_to_string(folder.join("e02.md")).unwrap();
    assert!(page.contains("| the motion alone |") && page.contains("| filter and W2 regulariser |"), "{page}");
    assert!(folder.join("e02.svg").is_file());

    // Nothing is measured twice; lost cells are measured again with the same result: seeds are fixed.
    assert!(cells(&study().args(&["--json"]).run().ok()).is_empty());
    let file = folder.join("e02.json");
    let mut cut = json_of(&file);
    cut["cells"].as_array_mut().unwrap().truncate(keys.len() - 1);
    std::fs::write(&file, cut.to_string()).unwrap();
    let again = cells(&study().args(&["--json"]).run().ok());
    assert_eq!(again.len(), 1);
    assert_eq!(again[0]["psnr"], found[keys.len() - 1]["psnr"]);
    std::fs::write(&file, "{}").unwrap();
    assert!(study().run().refused().contains("e02.json"));
    let none = studies(&["e02", str(&folder)]).run().refused();
    assert!(none.contains("study"), "{none}");
}

#[test]
fn the_suite_measures_every_capture_once_and_compares() {
    let work = tempfile::tempdir().unwrap();
    Capture::new(work.path()).write();
    let list = work.path().join("list.toml");
    let text = "[quick]\nsteps = 20\n[full]\nsteps = 30\n[[capture]]\nname = \"square\"\ndata = \"capture\"\n\
        hold_out = \"camera=1\"\n[[capture]]\nname = \"elsewhere\"\ndata = \"elsewhere\"\n\
        [[capture]]\nname = \"whole\"\ndata = \"capture\"\nhold_out = \"none\"\n";
    std::fs::write(&list, text).unwrap();
    let suite = |output: &str, more: &[&str]| {
        let output = work.path().join(output);
        let settings = ["num_pts=120", "max_cap=150", "sh_degree=1", "motion=spacetime"].map(|s| ["--set", s]);
        studies(&["suite", "--data", str(work.path()), "--list", str(&list), "-o", str(&output)])
            .args(settings.as_flattened())
            .args(more)
            .run()
            .ok()
    };
    let said = suite("before", &["--rule"]);
    let results = json_of(&work.path().join("before/results.json"));
    let cells = results["cells"].as_array().unwrap();
    let of = |name: &str, steps: u64| {
        cells.iter().find(|c| c["capture"] == name && c["steps"] == steps).unwrap_or_else(|| panic!("{name} {steps}"))
    };
    assert_eq!(cells.len(), 4, "two captures are there, in two lengths: {said}");
    for steps in [20, 80] {
        let cell = of("square", steps);
        assert!(cell["psnr"].as_f64().unwrap() > 5.0 && cell["psnr_train"].as_f64().unwrap() > 5.0);
        let probes = cell["probes"].as_array().unwrap();
        assert_eq!(probes.first().unwrap()["step"].as_u64().unwrap(), 0);
        assert!(probes.len() >= 20, "{} looks at the training views", probes.len());
        assert!(cell["fall"]["db"].as_f64().unwrap() >= 0.0);
        assert!(of("whole", steps)["refused"].as_str().unwrap().contains("no view"));
    }
    assert!(said.contains("The rule ") && said.contains("| square |"), "{said}");

    // Nothing is measured twice, and the same program and recipe give the same figures.
    let results = std::fs::read(work.path().join("before/results.json")).unwrap();
    suite("before", &["--rule"]);
    assert_eq!(std::fs::read(work.path().join("before/results.json")).unwrap(), results);
    let baseline = work.path().join("before/results.json");
    let again = suite("after", &["--only", "square", "--playback", "--baseline", str(&baseline)]);
    assert!(again.contains("PSNR: +0.00 dB in the mean"), "{again}");
    let cell = &json_of(&work.path().join("after/results.json"))["cells"][0];
    assert!(cell["playback_psnr"].as_f64().unwrap() > 20.0);
    let run = work.path().join("after/runs/square-20");
    assert!(run.join("scene.safetensors").is_file() && !run.join("checkpoints/00000020.safetensors").exists());
    let none = studies(&["suite", "--list", str(&list), "--only", "squares"]).run().refused();
    assert!(none.contains("squares") && none.contains("elsewhere"), "{none}");
}

#[test]
fn help_teaches() {
    let help = studies(&["--help"]).run().ok();
    for study in ["e00", "e01", "e02", "e03", "models", "suite", "make"] {
        assert!(help.contains(study), "{study} is missing");
        let own = studies(&[study, "--help"]).run().ok();
        assert!(
            own.contains("Examples:") && own.contains(&format!("studies {study}")),
            "{study} --help teaches nothing"
        );
    }
    assert!(!help.lines().any(|l| l.trim_start().starts_with("train ")), "what cells are made with is no study");
}

/// docs/best.md is what `studies best` writes, and every figure on it is in its record.
#[test]
fn the_page_of_best_figures_is_written_and_every_figure_has_its_record() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let work = tempfile::tempdir().unwrap();
    let file = work.path().join("best.md");
    studies(&["best", "-o", str(&file)]).run().ok();
    let (page, there) = (std::fs::read_to_string(&file).unwrap(), root.join("docs/best.md"));
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        std::fs::write(&there, &page).unwrap();
    }
    assert_eq!(std::fs::read_to_string(&there).unwrap(), page, "UPDATE_GOLDEN=1 writes the page again");
    let rows: Vec<&str> = page.lines().filter(|l| l.starts_with("| `")).collect();
    assert!(rows.len() > 10);
    for row in rows {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        let record = row.split("../studies/records/").nth(1).unwrap().split(')').next().unwrap();
        let text = std::fs::read_to_string(root.join("studies/records").join(record)).unwrap();
        for figure in &cells[2..5] {
            assert!(text.contains(figure.trim_end_matches('0')), "{record} lacks {figure} of {row}");
        }
    }
}
