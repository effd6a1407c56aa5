//! Files go between the formats of other programs, and what is lost is said.

use crate::sample::splat4d;
use splat4d::format::{Dialect, dialect, ply, scene};
use splat4d::layers::{ALWAYS, Head, Layer, Scene};
use splat4d::math::Rng;
use splat4d::motion::spacetime::FeatureSpec;
use splat4d::motion::{SpacetimeSpec, Spec, build};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, LIFE, LifeKind, Params, SH};
use std::path::Path;

/// Gaussians that fly for a second, z up.
fn moving() -> Scene<f32> {
    birds(None)
}

/// The same, or with colours that a network makes.
fn birds(features: Option<FeatureSpec>) -> Scene<f32> {
    let (rows, life) = (40, LifeKind::GaussHalf);
    let mut params = Params::new(rows, 4, life.columns());
    let spec = Spec::Spacetime(SpacetimeSpec { order: 1, rotation: true, detach: false, origin: 0.5, features });
    let motion = build(&spec, &mut params).unwrap();
    let rng = Rng::new(2, "convert", 0);
    for key in params.keys().collect::<Vec<_>>() {
        for row in 0..params[key].rows() {
            for col in 0..params[key].width() {
                let x = 0.4 * rng.fork(u64::from(key.0)).normal((row * 64 + col) as u64) as f32;
                params[key].set(row, col, x);
            }
        }
    }
    for row in 0..rows {
        params[GEOMETRY].write(row, LOG_SCALE, [-2.0, -3.0, -4.0]);
        params[GEOMETRY].set(row, OPACITY, 2.0);
        params[LIFE].set(row, 0, 0.5);
        params[LIFE].set(row, 1, 1.0);
    }
    let layer = Layer { name: "birds".into(), params, motion, life, span: ALWAYS, masks: None };
    let head = if features.is_some() { Head::Features } else { Head::Identity };
    Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 4.0, up: [0.0, 0.0, 1.0], head, ..Scene::default() }
}

fn open(path: &Path) -> Scene<f32> {
    let bytes = std::fs::read(path).unwrap();
    let kind = Dialect::of(&bytes).unwrap_or(Dialect::Splat);
    dialect::open(kind, &bytes).unwrap().scene
}

#[test]
fn a_moving_scene_goes_everywhere() {
    let work = tempfile::tempdir().unwrap();
    let at = |name: &str| work.path().join(name);
    let mut bytes = Vec::new();
    scene::write(&moving(), &mut bytes).unwrap();
    std::fs::write(at("birds.safetensors"), bytes).unwrap();
    let convert = |from: &str, to: &str, more: &[&str]| {
        splat4d(&["convert", from, to, "--json"]).args(more).run_in(work.path()).ok()
    };

    // Moving targets keep the motion, turned to their axes; single moments say which one was taken.
    for (name, dialect) in [("birds.splatv", Dialect::Splatv), ("birds.stg.ply", Dialect::StgPly)] {
        let said = convert("birds.safetensors", name, &[]);
        assert!(said.contains("view dependence"), "{said}");
        let back = open(&at(name));
        assert_eq!((back.len(), back.clip, back.fps, back.up), (40, [0.0, 1.0], 4.0, dialect.up()));
    }
    for name in ["a.ply", "a.compressed.ply", "a.spz", "a.splat"] {
        let said = convert("birds.safetensors", name, &[]);
        assert!(said.contains("one moment") && said.contains("--frames"), "{name}: {said}");
        assert_eq!(open(&at(name)).len(), 40);
    }
    // z up became y down: what was z is now −y, at the moment that was asked for.
    convert("birds.safetensors", "then.ply", &["--time", "0.75", "--sh", "0"]);
    let then = open(&at("then.ply"));
    let (own, was) = (&then.layers[0].params, moving());
    let p = &was.layers[0].params;
    let v = p.find("velocities").unwrap();
    let z = p[GEOMETRY].get(7, 2) + 0.25 * p[v].get(7, 2);
    assert!((own[GEOMETRY].get(7, 1) + z).abs() < 1e-5, "{} {z}", own[GEOMETRY].get(7, 1));
    assert_eq!(own[SH].width(), 3);
    // ... unless told to keep its axes.
    convert("birds.safetensors", "kept.ply", &["--time", "0.5", "--up", "keep"]);
    assert_eq!(open(&at("kept.ply")).layers[0].params[GEOMETRY].read::<3>(7, 0), p[GEOMETRY].read::<3>(7, 0));
    convert("birds.safetensors", "z.spz", &["--time", "0.5", "--up=-z", "--spz-version", "4"]);
    assert!(std::fs::read(at("z.spz")).unwrap().starts_with(b"NGSP\x04"));

    // A file a frame, and back as one moving scene.
    convert("birds.safetensors", "frames/f_%03d.spz", &["--frames"]);
    assert!(at("frames/f_000.spz").is_file() && at("frames/f_004.spz").is_file() && !at("frames/f_005.spz").exists());
    convert("frames", "joined.safetensors", &["--fps", "4"]);
    let joined = scene::read(&std::fs::read(at("joined.safetensors")).unwrap()).unwrap();
    assert_eq!((joined.clip, joined.len(), joined.up), ([0.0, 1.0], 5 * 40, [0.0, 1.0, 0.0]));
    let refused = splat4d(&["convert", "frames", "x.splatv"]).run_in(work.path()).refused();
    assert!(refused.contains("interval") && refused.contains("--frames"), "{refused}");
}

#[test]
fn a_scene_with_a_head_is_drawn_and_nothing_else_is_made_of_it() {
    let work = tempfile::tempdir().unwrap();
    let write = |name: &str, scene: &Scene<f32>| {
        let mut bytes = Vec::new();
        scene::write(scene, &mut bytes).unwrap();
        std::fs::write(work.path().join(name), bytes).unwrap();
    };
    let full = birds(Some(FeatureSpec { seed: 3 }));
    write("full.safetensors", &full);
    write("plain.safetensors", &Scene { head: Head::Identity, layers: moving().layers, ..full });
    let run = |args: &[&str]| splat4d(args).run_in(work.path());
    assert!(run(&["info", "full.safetensors"]).ok().contains("features = full"));
    let draw = |name: &str, out: &str, device: &str| {
        let scene = format!("{name}.safetensors");
        let said = run(&["render", &scene, "-o", out, "--size", "40x30", "--fps", "4", "--device", device]).told();
        let mut pictures: Vec<_> =
            std::fs::read_dir(work.path().join(out)).unwrap().map(|e| e.unwrap().path()).collect();
        pictures.sort();
        (said, pictures.into_iter().map(|p| std::fs::read(p).unwrap()).collect::<Vec<_>>())
    };
    let (_, drawn) = draw("full", "cpu", "cpu");
    assert!(drawn.len() >= 4 && drawn != draw("plain", "plain", "cpu").1, "the head must matter");
    let (said, again) = draw("full", "gpu", "gpu");
    assert!(again == drawn && said.contains("on the CPU"), "{said}");
    // A turned copy keeps its head.
    run(&["convert", "full.safetensors", "turned.safetensors", "--up", "y"]).ok();
    let turned = scene::read(&std::fs::read(work.path().join("turned.safetensors")).unwrap()).unwrap();
    let near = turned.up.iter().zip([0.0, 1.0, 0.0]).all(|(a, b)| (a - b).abs() < 1e-12);
    assert!(turned.head == Head::Features && near, "{:?}", turned.up);
    for args in [
        &["bake", "full.safetensors", "-o", "a.splat4d"][..],
        &["convert", "full.safetensors", "a.splat4d"],
        &["convert", "full.safetensors", "a.splatv"],
        &["convert", "full.safetensors", "a.stg.ply"],
        &["convert", "full.safetensors", "a.ply"],
        &["convert", "full.safetensors", "f_%d.spz", "--frames"],
        &["export", "full.safetensors", "-o", "a.ply"],
        &["export", "full.safetensors", "-o", "a.html", "--html"],
    ] {
        let refused = run(args).refused();
        assert!(refused.contains("features=none"), "{args:?}: {refused}");
    }
    // Where Gaussians go has nothing to do with colours.
    run(&["export", "full.safetensors", "--tracks", "a.csv"]).ok();
}

#[test]
fn plain_files_keep_their_bits_and_orders_that_cannot_be_are_refused() {
    let work = tempfile::tempdir().unwrap();
    let mut params = Params::new(3, 16, &[]);
    for row in 0..3 {
        params[GEOMETRY].write(row, QUAT, [1.5, 0.1, row as f32, -0.3]);
        params[SH].set(row, 40, 0.7);
    }
    let mut bytes = Vec::new();
    ply::write(&params, &mut bytes).unwrap();
    std::fs::write(work.path().join("a.ply"), &bytes).unwrap();
    splat4d(&["convert", "a.ply", "b.ply"]).run_in(work.path()).ok();
    assert_eq!(std::fs::read(work.path().join("b.ply")).unwrap(), bytes);
    // Half a turn and back, through .spz' axes.
    splat4d(&["convert", "a.ply", "up.ply", "--up", "y"]).run_in(work.path()).ok();
    let turned = open(&work.path().join("up.ply"));
    assert_ne!(turned.layers[0].params, params);

    let refused = |args: &[&str]| splat4d(args).run_in(work.path()).refused();
    assert!(refused(&["convert", "a.ply", "a.sog"]).contains("not written"));
    assert!(refused(&["convert", "a.ply", "a.obj"]).contains(".splatv"));
    assert!(refused(&["convert", "a.ply", "f_%d.ply"]).contains("--frames"));
    assert!(refused(&["convert", "a.ply", "b.spz", "--frames"]).contains("pattern"));
    std::fs::write(work.path().join("old.ksplat"), b"\0\x01").unwrap();
    assert!(refused(&["convert", "old.ksplat", "b.ply"]).contains("splat-transform"));
    std::fs::create_dir(work.path().join("empty")).unwrap();
    assert!(refused(&["convert", "empty", "b.ply"]).contains("numbered"));
}
