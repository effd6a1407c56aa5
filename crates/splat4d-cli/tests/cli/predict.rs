//! `predict` on a tiny run that did not see the end of its take: what it leaves, what it states, what it refuses.

use crate::sample::{Capture, Output, splat4d};
use crate::{TINY, json_of, str};
use splat4d::format::{playback, scene};
use std::path::{Path, PathBuf};

/// Frames of the capture, of which seven are seen with [`SHARE`].
const FRAMES: usize = 10;
const SHARE: &str = "0.75";

/// A capture and a run on a share of it. Twenty steps learn no motion, so the learnt scene is made to drift.
fn seen(work: &Path, share: &str) -> (PathBuf, PathBuf) {
    let mut sample = Capture::new(work);
    sample.frames = FRAMES;
    let (capture, run) = (sample.write(), work.join("run"));
    let args = ["train", str(&capture), "-o", str(&run), "--observe", share, "--motion", "spacetime", "--no-eval"];
    splat4d(&args).args(&TINY).args(&["--set=life=infinite"]).run().ok();
    let file = run.join("scene.safetensors");
    let mut learnt = scene::read(&std::fs::read(&file).unwrap()).unwrap();
    let params = &mut learnt.layers[0].params;
    let key = params.find("velocities").unwrap();
    (0..params.len()).filter(|r| r % 2 == 0).for_each(|r| params[key].set(r, 0, 3.0));
    let mut bytes = Vec::new();
    scene::write(&learnt, &mut bytes).unwrap();
    std::fs::write(&file, bytes).unwrap();
    (capture, run)
}

fn predict(run: &Path, args: &[&str]) -> Output {
    splat4d(&["predict", str(run), "--steps", "3", "--nodes", "4"]).args(args).run()
}

#[test]
fn a_run_is_forecast_and_compared_with_later_frames() {
    let work = tempfile::tempdir().unwrap();
    let (_, run) = seen(work.path(), SHARE);
    let actions = work.path().join("actions.csv");
    std::fs::write(&actions, "push.x,push.y,push.z\n".to_owned() + &"0.1,0,0\n".repeat(FRAMES)).unwrap();
    predict(&run, &["--seeds", "2", "--actions", str(&actions), "--assimilate"]).ok();
    let folder = run.join("predict");
    let told = json_of(&folder.join("predict.json"));
    let names: Vec<&str> = told["models"].as_array().unwrap().iter().map(|m| m["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["freeze", "velocity", "acceleration", "extrapolate", "koopman", "causal", "graph"]);
    assert_eq!((told["observed_frames"].as_u64(), told["horizon"].as_u64()), (Some(7), Some(3)));
    assert_eq!((told["pictured"].as_u64(), told["views"].as_u64()), (Some(3), Some(3)), "one camera was held out");
    let freeze = &told["models"][0];
    assert_eq!((freeze["skill_over_freeze"].as_f64(), freeze["win_over_freeze"].as_f64()), (Some(0.0), Some(0.5)));
    assert!(told["models"].as_array().unwrap().iter().all(|m| m["psnr"].as_f64().unwrap() > 5.0));
    assert!(told["assimilated"]["psnr"].as_f64().unwrap() > 5.0);
    let page = std::fs::read_to_string(folder.join("report.html")).unwrap();
    assert!(page.contains("skill over freeze") && page.contains("koopman"));
    let dynamics = std::fs::read(folder.join("dynamics.safetensors")).unwrap();
    let dynamics = splat4d::format::safetensors::SafeTensors::read(&dynamics).unwrap();
    assert_eq!(dynamics.tensor("observed.positions").unwrap().shape(), [7, 4, 3]);
    assert_eq!(dynamics.tensor("graph.rotations").unwrap().shape(), [3, 4, 4]);
    assert!(dynamics.tensor("causal.1.drive").is_ok(), "both members are kept");
    // It is a scene like any other: it plays, marked, and exports.
    let bytes = std::fs::read(folder.join("scene.s4d")).unwrap();
    let meta = playback::Index::parse(&bytes, Some(bytes.len() as u64)).unwrap().meta;
    let at = |frame: f64| frame / 30.0;
    assert!((meta.predicted.unwrap() - at(6.5)).abs() < 1e-9 && (meta.clip[1] - at(9.0)).abs() < 1e-9, "{meta:?}");
    let ply = work.path().join("later.ply");
    let scene = folder.join("scene.safetensors");
    splat4d(&["export", str(&scene), "-o", str(&ply), "--time", "0.3"]).run().ok();
    assert!(ply.is_file());
}

#[test]
fn unpredictable_runs_are_refused_with_a_remedy() {
    let work = tempfile::tempdir().unwrap();
    let (capture, run) = seen(work.path(), SHARE);
    let actions = |text: &str| {
        let path = work.path().join("actions.csv");
        std::fs::write(&path, text).unwrap();
        predict(&run, &["--model", "velocity", "--actions", str(&path)]).refused()
    };
    assert!(actions(&("grip\n".to_owned() + &"1\n".repeat(4))).contains("need 9"), "the horizon wants more rows");
    assert!(actions("push.x,push.z\n1,2\n").contains("push.x"));
    assert!(actions("grip\n1,2\n").contains("line 2"));
    assert!(predict(&run, &["--model", "oracle"]).refused().contains("koopman"));
    assert!(predict(&run, &["--oracle", str(&run)]).refused().contains("trained on more of it"));
    for flags in [["--horizon", "0"], ["--nodes", "999"], ["--seeds", "0"]] {
        predict(&run, &flags).refused();
    }
    // No frames to hold back, too few observed frames, no motion.
    let whole = work.path().join("whole");
    splat4d(&["train", str(&capture), "-o", str(&whole), "--no-eval"]).args(&TINY).run().ok();
    assert!(predict(&whole, &[]).refused().contains("--observe"));
    let few = tempfile::tempdir().unwrap();
    assert!(predict(&seen(few.path(), "0.3").1, &[]).refused().contains("too few"));
    let still = work.path().join("still");
    let args = ["train", str(&capture), "-o", str(&still), "--observe", SHARE, "--motion", "still", "--no-eval"];
    splat4d(&args).args(&TINY).run().ok();
    assert!(predict(&still, &[]).refused().contains("nothing moves"));
}
