//! Edits from lists and options; what is bad leaves the file that was there alone.

use crate::convert::moving;
use crate::sample::{Call, splat4d};
use splat4d::format::{playback, scene};
use std::path::Path;

fn write(path: &Path, title: &str) {
    let (mut bytes, mut made) = (Vec::new(), moving());
    made.layers[0].name = title.into();
    scene::write(&made, &mut bytes).unwrap();
    std::fs::write(path, bytes).unwrap();
}

/// A call that works and states all of this.
fn output_contains(call: Call, words: &[&str]) {
    let told = call.run().all();
    words.iter().for_each(|word| assert!(told.contains(word), "{word} is not in {told}"));
}

#[test]
fn a_list_and_options_make_a_new_file() {
    let work = tempfile::tempdir().unwrap();
    let at = |name: &str| work.path().join(name);
    write(&at("birds.safetensors"), "birds");
    write(&at("other.safetensors"), "others");
    let list = r#"
        version = 1
        scene = "birds"
        [[edit]]
        do = "merge"
        scene = "other.safetensors"
        name = "b"
        to = { shift = [9, 0, 0] }
        [[edit]]
        do = "recolor"
        select = "layer(b/others)"
        exposure = -1
    "#;
    std::fs::write(at("edits.toml"), list).unwrap();
    let of = |words: &[&str]| splat4d(&[&["edit"], words].concat());
    let name = |n: &str| at(n).to_str().unwrap().to_owned();
    let (birds, edits, both) = (name("birds.safetensors"), name("edits.toml"), name("both.safetensors"));
    let (again, file) = (name("again.toml"), name("birds.s4d"));
    of(&[&birds, &edits, "--save", &again, "--delete", "box(5,-99,-99, 99,99,99) and size(0,0)", "-o", &both])
        .run()
        .refused();
    assert!(!at("both.safetensors").exists() && !at("again.toml").exists());
    output_contains(of(&[&birds, &edits, "--save", &again, "-o", &both]), &["80 Gaussians of 40", "2 layers"]);
    let made = scene::read(&std::fs::read(&both).unwrap()).unwrap();
    let names: Vec<&str> = made.layers.iter().map(|l| l.name.as_str()).collect();
    assert_eq!(names, ["birds", "b/others"]);
    // The saved list makes the same bits.
    let first = std::fs::read(&both).unwrap();
    output_contains(of(&[&birds, &again, "-o", &both]), &["80 Gaussians"]);
    assert_eq!(std::fs::read(&both).unwrap(), first);
    output_contains(of(&[&both, "--layer", "b/others", "-o", &name("b.stg.ply")]), &["40 Gaussians of 80"]);
    output_contains(of(&[&birds, "--count", "all"]), &["40 of 40", "0.000 s", "1.000 s"]);
    // Provenance is copied, and removed on request.
    output_contains(of(&[&birds, &edits, "--note", "birds that agreed", "-o", &file]), &["primitives"]);
    output_contains(splat4d(&["info", &file]), &["made with", "merge, recolor", "birds that agreed"]);
    let kept = name("kept.s4d");
    splat4d(&["convert", &file, &kept]).run().ok();
    let told = playback::provenance(&std::fs::read(&kept).unwrap()).unwrap().unwrap();
    assert_eq!((told.edits.len(), told.words.as_deref()), (2, Some("birds that agreed")));
    splat4d(&["convert", &file, &kept, "--no-provenance"]).run().ok();
    assert_eq!(playback::provenance(&std::fs::read(&kept).unwrap()).unwrap(), None);
    // A playback file edited again keeps its content, except for the requested change.
    output_contains(of(&[&file, "--delete", "sphere(9,0,0, 1)", "-o", &kept]), &["delete"]);
    let told = playback::provenance(&std::fs::read(&kept).unwrap()).unwrap().unwrap();
    assert_eq!(told.edits.len(), 3);
}

#[test]
fn mistakes_are_reported_and_the_old_file_stays() {
    let work = tempfile::tempdir().unwrap();
    let at = |name: &str| work.path().join(name).to_str().unwrap().to_owned();
    write(Path::new(&at("birds.safetensors")), "birds");
    let (birds, out, list) = (at("birds.safetensors"), at("out.safetensors"), at("edits.toml"));
    std::fs::write(&out, "what was there").unwrap();
    let tell = |words: &[&str], told: &[&str]| {
        let error = splat4d(&[&["edit", &birds], words, &["-o", &out]].concat()).run().refused();
        told.iter().for_each(|word| assert!(error.contains(word), "{words:?}: {error}"));
        assert_eq!(std::fs::read(&out).unwrap(), b"what was there");
    };
    tell(&["--delete", "sphere(99,0,0, 1)"], &["empty", "edit 1 (delete)"]);
    tell(&["--delete", "bux(1)"], &["bux", "sphere("]);
    tell(&["--layer", "cats"], &["cats", "birds"]);
    tell(&["--crop", "frustum(left)"], &["left", "run folder"]);
    tell(&["--subject"], &["run folder"]);
    tell(&["--floaters", "0.5"], &["run folder"]);
    tell(&["--delete", "all"], &["nothing"]);
    tell(&[], &["nothing to do"]);
    for (text, word) in [
        ("version = 7", "version 7"),
        ("version = 1\nscene = \"cats\"", "cats"),
        ("version = 1\n[[edit]]\ndo = \"delete\"", "select"),
        ("version = 1\n[[edit]]\ndo = \"merge\"\nscene = \"none.ply\"\nname = \"x\"", "none.ply"),
        ("version = 1\n[[edit]]\ndo = \"delete\"\nselect = \"mask(none.png, left)\"", "left"),
        ("[[", "edits.toml"),
    ] {
        std::fs::write(&list, text).unwrap();
        tell(&[&list], &[word]);
    }
    let error = splat4d(&["edit", &birds, "--delete", "all", "-o", &at("out.ksplat")]).run().refused();
    assert!(error.contains("not written"), "{error}");
}
