//! A take in chunks, from the command line: part by part and joined, and what is refused.

use crate::sample::{Capture, Output, splat4d};
use crate::{TINY, json_of, str};
use std::path::{Path, PathBuf};

const CHUNKS: [&str; 4] = ["--chunk-frames=6", "--overlap=2", "--motion=spacetime", "--set=init=random"];

fn take(work: &Path) -> PathBuf {
    let mut sample = Capture::new(work);
    sample.frames = 12;
    sample.write()
}

fn train(capture: &Path, run: &Path, more: &[&str]) -> Output {
    splat4d(&["train", str(capture), "-o", str(run)]).args(&TINY).args(&CHUNKS).args(more).run()
}

#[test]
fn parts_by_number_and_one_command_make_the_same_scene_and_file() {
    let work = tempfile::tempdir().unwrap();
    let (capture, one, parts) = (take(work.path()), work.path().join("one"), work.path().join("parts"));
    let said = splat4d(&["info", str(&capture), "--set=chunks.frames=6", "--set=chunks.overlap=2"]).run().ok();
    assert!(said.contains("2 chunks of at most 7 frames"), "{said}");
    let said = train(&capture, &one, &[]).ok();
    assert!(said.contains("flicker at chunk boundaries"), "{said}");
    assert!(train(&capture, &parts, &["--chunk=0"]).refused().contains("--chunk shared"));
    let film = parts.join("scene.s4d");
    let status = |run: &Path| {
        let said = splat4d(&["status", str(run), "--json"]).run().ok();
        serde_json::from_str::<serde_json::Value>(said.trim()).unwrap()
    };
    let states = |run: &Path| {
        let told = status(run);
        let all = told["parts"].as_array().unwrap().iter().map(|p| p["state"].as_str().unwrap().to_owned());
        all.collect::<Vec<_>>()
    };
    assert_eq!(states(&parts), ["open", "waiting", "waiting"]);
    for (part, then) in [
        ("shared", ["done", "open", "waiting"]),
        ("0", ["done", "done", "open"]),
        ("1", ["done", "done", "done"]),
        ("1", ["done", "done", "done"]),
    ] {
        let said = train(&capture, &parts, &[&format!("--chunk={part}")]).ok();
        assert_eq!(said.lines().last(), Some(&*format!("next: splat4d status {}", parts.display())), "{said}");
        // Its present part plays, and an older reader refuses it by its version.
        let bytes = std::fs::read(&film).unwrap();
        assert_eq!(bytes[8..12], [2, 0, 0, 0], "{part}");
        let told = splat4d(&["info", str(&film), "--json"]).run().ok();
        assert!(told.contains("\"version\":\"2.0\"") || told.contains("2.0"), "{told}");
        splat4d(&["export", str(&film), "-o", str(&work.path().join(format!("{part}.ply"))), "--time=0"]).run().ok();
        assert_eq!(states(&parts), then, "{part}");
        if part == "0" {
            // A worker has the next one.
            let owner = splat4d_train::output::Owner::of(&parts.join("chunks/01"), "train").unwrap();
            let told = status(&parts);
            assert!(told["done"] == 2 && told["total"] == 3 && told["finished"] == false, "{told}");
            assert!(told["parts"][2]["worker"].as_str().unwrap().contains(&std::process::id().to_string()), "{told}");
            assert!(
                told["parts"][1]["iteration"] == told["parts"][1]["iterations"] && told["next"].is_null(),
                "{told}"
            );
            drop(owner);
            let said = splat4d(&["info", str(&parts)]).run().ok();
            assert!(said.contains("unfinished, 2 of 3 parts done") && said.contains("splat4d status"), "{said}");
        }
    }
    assert!(status(&parts)["next"].as_str().unwrap().contains("splat4d join"));
    // Bytes of a process that died while appending.
    let mut broken = std::fs::read(&film).unwrap();
    broken.extend([7; 999]);
    std::fs::write(&film, broken).unwrap();
    splat4d(&["join", str(&parts), "--no-eval"]).run().ok();
    for file in ["scene.safetensors", "scene.s4d", "chunks/01/scene.safetensors"] {
        assert_eq!(std::fs::read(one.join(file)).unwrap(), std::fs::read(parts.join(file)).unwrap(), "{file}");
    }
    let said = splat4d(&["info", str(&parts)]).run().ok();
    assert!(said.contains("finished, 3 parts joined") && !said.contains(" of 20"), "{said}");
    assert!(json_of(&one.join("run.json"))["seams"]["inside"].is_f64());
    assert!(std::fs::read_to_string(one.join("report.html")).unwrap().contains("Flicker at chunk boundaries"));
    // A run like any other: all of it is done, and it is measured and rendered.
    splat4d(&["train", "--resume", str(&one), "--no-eval"]).run().ok();
    splat4d(&["eval", str(&parts)]).run().ok();
    splat4d(&["export", str(&parts.join("chunks/00")), "-o", str(&work.path().join("now.ply")), "--time=0"]).run().ok();
}

#[test]
fn unsupported_chunk_options_are_refused() {
    let work = tempfile::tempdir().unwrap();
    let (capture, run) = (take(work.path()), work.path().join("run"));
    for (more, says) in [
        (&["--chunk=0", "--set=chunks.frames=12"][..], "fits into one chunk"),
        (&["--chunk=7"], "no chunk 7"),
        (&["--chunk=x"], "shared, a number or all"),
        (&["--set=chunks.overlap=5"], "even --overlap"),
    ] {
        let said = train(&capture, &run, more).refused();
        assert!(said.contains(says), "{more:?}: {said}");
    }
    assert!(splat4d(&["join", str(&run)]).run().refused().contains("--chunk shared"));
    assert!(splat4d(&["join", str(&capture)]).run().refused().contains("plan.json"));
}
