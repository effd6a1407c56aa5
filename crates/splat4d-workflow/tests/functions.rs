//! Baking, conversion and export as functions: the same files and events as the command's, without a terminal.

use splat4d::format::ply::write_placed;
use splat4d::scene::params::{LOG_SCALE, QUAT};
use splat4d::scene::{GEOMETRY, Params};
use splat4d_workflow::baking::{self, Baking};
use splat4d_workflow::converting::{self, Conversion};
use splat4d_workflow::events::{Event, Listener, ignore};
use splat4d_workflow::exporting;
use splat4d_workflow::source::Source;
use std::cell::RefCell;
use std::path::Path;

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
    write_placed(&params, ([0.0; 3], false), &mut bytes).unwrap();
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
    assert_eq!(exporting::moment(&source.scene, 0.0, false, &at("now.ply")).unwrap(), GAUSSIANS);

    let kinds: Vec<String> = records.borrow().iter().map(|r: &serde_json::Value| r["type"].to_string()).collect();
    assert_eq!(kinds, ["\"baked\"", "\"converted\""]);
    assert_eq!(*written.borrow(), ["a.s4d", "a.json", "a.spz", "a.html"].map(at));
}

#[test]
fn what_cannot_be_written_is_an_error() {
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
