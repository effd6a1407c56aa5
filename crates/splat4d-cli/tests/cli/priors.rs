//! Networks from the command line: their descriptions, and what is refused.

use crate::sample::splat4d;
use crate::str;

#[test]
fn descriptions_are_listed_and_printed() {
    let list = splat4d(&["priors", "--describe"]).run().ok();
    for words in [
        "depth-anything-v2: inverse-depth",
        "raft: flow",
        "pphumanseg: mask",
        "https://",
        "MIT",
        "not for commercial use",
    ] {
        assert!(list.contains(words), "{words}: {list}");
    }
    let text = splat4d(&["priors", "--describe", "midas-v2"]).run().ok();
    assert!(text.contains("version = 1") && text.contains("size = [384, 384]"), "{text}");
    assert!(splat4d(&["priors", "--describe", "midas"]).run().refused().contains("expected depth-anything-v2"));
}

#[test]
fn networks_that_cannot_be_used_are_refused_before_the_capture_is_opened() {
    let folder = tempfile::tempdir().unwrap();
    let network = folder.path().join("net.onnx");
    let run = |words: &[&str]| splat4d(&[&["priors", str(folder.path())][..], words].concat()).run().refused();
    assert!(run(&[]).contains("no network is given"));
    assert!(run(&["--depth", str(&network), "--described", "midas-v2"]).contains("net.onnx"));
    std::fs::write(&network, b"no network").unwrap();
    assert!(run(&["--depth", str(&network)]).contains("expected a description"));
    let text = run(&["--depth", str(&network), "--described", "midas-v2"]);
    assert!(text.contains("net.onnx") && (text.contains("cannot be loaded") || text.contains("left out")), "{text}");
}
