//! Writers: every file gets its name by one helper, which flushes it to the disk first.

use super::{code, files, is_test, read, report};

/// Calls that create, replace or rename a file.
const CALLS: [&str; 5] = ["fs::write(", "File::create(", "fs::rename(", "File::create_new(", ".create(true)"];

/// Sources that contain one, and why. The helper itself comes first.
const WRITERS: [(&str, &str); 11] = [
    ("crates/splat4d-train/src/output/", "the helper; locks, lists that grow, and files that are moved aside and back"),
    ("crates/splat4d-fuzz/src/", "damaged inputs in temporary folders"),
    ("crates/splat4d-import/src/recording/assist.rs", "renames a list that it keeps"),
    ("crates/splat4d-import/src/recording/colmap.rs", "a log that another program writes"),
    ("crates/splat4d-py/src/scene.rs", "inputs of a workflow in a temporary folder"),
    ("crates/splat4d-workflow/src/files.rs", "at the helper's temporary name"),
    (
        "crates/splat4d-workflow/src/growing.rs",
        "the playback file of a capture that still trains: its header comes last",
    ),
    ("crates/splat4d-workflow/src/sound.rs", "at the helper's temporary name"),
    ("crates/splat4d-workflow/src/video.rs", "at the helper's temporary name, frame by frame"),
    ("studies/src/", "a folder that is renamed when all of it is there; files in temporary folders"),
    ("xtask/src/chaos/", "what the chaos tests break"),
];

#[test]
fn files_are_written_by_one_helper() {
    let sources = [files("crates", "rs"), files("studies/src", "rs"), files("xtask/src", "rs")].concat();
    let calls = |path: &String| code(&read(path)).iter().any(|(_, l)| CALLS.iter().any(|call| l.contains(call)));
    let found: Vec<String> = sources.into_iter().filter(|p| !is_test(p)).filter(calls).collect();
    let listed = |path: &String| WRITERS.iter().any(|(own, _)| path.starts_with(own));
    let unlisted = found.iter().filter(|p| !listed(p)).map(|p| format!("{p} writes a file by itself"));
    report(
        unlisted.collect(),
        "Call splat4d_train::output::write_atomically, or Staged where a program writes the bytes.",
    );
    for (own, _) in WRITERS {
        let used = found.iter().any(|p| p.starts_with(own));
        assert!(used, "WRITERS lists {own}, which writes nothing");
    }
}
