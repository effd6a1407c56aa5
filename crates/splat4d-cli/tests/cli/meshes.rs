//! Meshes of a scene over time.

use crate::sample::{Call, splat4d};
use std::path::{Path, PathBuf};

/// The bundled scene.
fn knight() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/knight.s4d")
}

fn export(out: &Path, options: &[&str]) -> Call {
    splat4d(&["export", "--json", "--voxel", "0.1"]).args(options).args(&["--mesh"]).paths(&[out, &knight()])
}

#[test]
fn a_scene_becomes_one_mesh_or_one_per_frame() {
    let work = tempfile::tempdir().unwrap();
    let at = |name: &str| work.path().join(name);
    let said = export(&at("a.glb"), &["--time", "0.5"]).run().ok();
    assert!(said.contains("\"triangles\":") && std::fs::read(at("a.glb")).unwrap().starts_with(b"glTF"), "{said}");
    let said = export(&at("a.glb"), &[]).run().refused();
    assert!(said.contains("the file exists") && said.contains("--force"), "{said}");
    export(&at("a.glb"), &["--force"]).run().ok();
    export(&at("frames"), &["--from", "0.2", "--to", "0.4", "--fps", "10", "--collision"]).run().ok();
    assert!(at("frames/frame_00002.glb").is_file() && !at("frames/frame_00003.glb").exists());
    let said = export(&at("frames"), &["--from", "0.2", "--to", "0.2"]).run().refused();
    assert!(said.contains("--force"), "{said}");
    for (name, options, word) in [
        ("b.stl", &[][..], "expected the ending glb, obj or ply"),
        ("b.glb", &["--time", "7"], "outside of the scene's clip"),
        ("b.glb", &["--fps", "2"], "one mesh has one time"),
        ("c", &["--time", "0.5"], "the output is a sequence"),
        ("c", &["--from", "9", "--to", "10"], "outside of the scene's clip"),
    ] {
        let said = export(&at(name), options).run().refused();
        assert!(said.contains(word) && !at(name).exists(), "{name}: {said}");
    }
}

#[cfg(target_os = "linux")]
#[test]
fn meshes_have_names_that_are_not_text() {
    use std::os::unix::ffi::OsStrExt;
    let work = tempfile::tempdir().unwrap();
    let out = work.path().join(std::ffi::OsStr::from_bytes(b"m\xff.obj"));
    export(&out, &[]).run().ok();
    assert!(out.is_file());
}
