//! `bench` measures what is there, skips what is not, and states so; its JSON is one array.

use crate::sample::splat4d;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The trained scene that comes with the repository.
fn knight() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/knight.s4d");
    path.to_str().unwrap().to_owned()
}

/// A name at which nothing is.
fn nothing(folder: &Path) -> String {
    folder.join("nothing").to_str().unwrap().to_owned()
}

#[test]
fn json_is_an_array_of_rows_and_compares_with_an_earlier_one() {
    let work = tempfile::tempdir().unwrap();
    let (earlier, saved) = (work.path().join("earlier.json"), work.path().join("saved.json"));
    let simd = format!("{:?}", splat4d::render::Simd::detect()).to_lowercase();
    let old = json!([{"scene": "T", "stage": "step", "threads": 1, "simd": simd, "ms": 2.0, "ceiling_share": null}]);
    std::fs::write(&earlier, old.to_string()).unwrap();
    let answer = splat4d(&["bench", "--scene", "T", "--threads", "1", "--rounds", "1", "--json"])
        .args(&["--file", &knight(), "--against", earlier.to_str().unwrap(), "--save", saved.to_str().unwrap()])
        .run();
    let text = answer.ok();
    let rows: Vec<Value> = serde_json::from_str(&text).expect("stdout is one JSON array");
    let mut stages = BTreeSet::new();
    for row in &rows {
        assert_eq!((&row["scene"], &row["threads"], &row["simd"]), (&json!("T"), &json!(1), &json!(simd)));
        assert!(row["ms"].as_f64().unwrap() > 0.0, "{row}");
        let share = row["ceiling_share"].as_f64();
        assert!(share.is_some_and(|s| s > 0.0) || row["stage"] == "who is alive", "{row}");
        stages.insert(row["stage"].as_str().unwrap().to_owned());
    }
    for stage in [
        "motion",
        "project",
        "shade",
        "bin",
        "blend",
        "forward",
        "forward+backward",
        "blend backward",
        "splats backward",
        "loss",
        "motion backward",
        "adam",
        "step",
    ] {
        assert!(stages.contains(stage), "{stage} is missing of {stages:?}");
    }
    let of = |stage: &str| rows.iter().find(|r| r["stage"] == stage).unwrap();
    let (blend, step) = (of("blend"), of("step"));
    let (tested, seen) = (blend["tested_pairs"].as_u64().unwrap(), blend["contributing_pairs"].as_u64().unwrap());
    assert!(seen > 1_000_000 && seen < tested && tested < 100_000_000, "{blend}");
    assert!(blend["ceiling_share"].as_f64().unwrap() < 1.5, "{blend}");
    let ms = |stage: &str| of(stage)["ms"].as_f64().unwrap();
    assert!(ms("forward") < ms("forward+backward") && ms("blend") < ms("forward"), "{text}");
    assert!((step["against"].as_f64().unwrap() - ms("step") / 2.0).abs() < 1e-9, "{step}");
    assert!(blend.get("against").is_none(), "only twins are compared");
    assert_eq!(
        serde_json::from_str::<Vec<Value>>(&std::fs::read_to_string(&saved).unwrap()).unwrap().len(),
        rows.len()
    );
}

#[test]
fn scenes_that_are_not_there_are_skipped() {
    let work = tempfile::tempdir().unwrap();
    let absent = nothing(work.path());
    let answer = splat4d(&["bench", "--json", "--playbot", &absent, "--file", &absent]).run();
    assert_eq!(answer.ok().trim(), "[]", "no scene, no row");
    let told = splat4d(&["bench", "--playbot", &absent, "--file", &absent]).run().told();
    for scene in ["S", "T", "U"] {
        assert!(told.contains(&format!("scene {scene} is skipped")) && told.contains(&absent), "{told}");
    }
    let grown = splat4d(&["bench", "--growth", "pixels", "--file", &absent]).run().told();
    assert!(grown.contains("skipped") && grown.contains("--file"), "{grown}");
}

#[test]
fn invalid_measurements_are_refused_at_once() {
    let work = tempfile::tempdir().unwrap();
    let file = |name: &str, bytes: &[u8]| -> PathBuf {
        let path = work.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    };
    let broken = file("broken.json", b"[{\"scene\": \"T\"");
    let other = file("other.json", b"{\"type\": \"results\"}");
    let scene = file("scene.s4d", b"SPL4D but no more");
    let folder = work.path().join("empty");
    std::fs::create_dir(&folder).unwrap();
    let text = |path: &Path| path.to_str().unwrap().to_owned();
    for (args, word) in [
        (vec!["--scene", "X"], "[possible values: S, T, U, A, B, C]"),
        (vec!["--device", "tpu"], "[possible values: cpu, gpu]"),
        (vec!["--device", "gpu", "--growth", "pixels"], "cannot be used with"),
        (vec!["--simd", "mmx"], "[possible values: scalar, avx2, avx512]"),
        (vec!["--rounds", "0"], "1 to 1000"),
        (vec!["--growth", "time"], "possible values"),
        (vec!["--growth", "pixels", "--scene", "T"], "cannot be used with"),
        (vec!["--plots", "x"], "--growth"),
        (vec!["--against", &nothing(work.path())], "cannot be read"),
        (vec!["--against", &text(&broken)], "bench --save"),
        (vec!["--against", &text(&other)], "bench --save"),
        (vec!["--scene", "T", "--file", &text(&scene)], "scene.s4d"),
        (vec!["--scene", "S", "--playbot", &text(&folder)], "empty"),
    ] {
        let told = splat4d(&["bench"]).args(&args).run().refused();
        assert!(told.contains(word), "{args:?}: {told}");
    }
}
