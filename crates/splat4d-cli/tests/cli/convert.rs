//! Conversion between formats of other programs, with reports of lost data.

use crate::sample::{shown, splat4d};
use splat4d::format::{Dialect, ply, scene, splatv};
use splat4d::layers::{Head, Layer, Scene, rotation_between};
use splat4d::math::{Rng, Sim3, quat, sym3};
use splat4d::motion::control::{ControlSpec, Curve, TrajectorySpec};
use splat4d::motion::deform::{DeformSpec, Input};
use splat4d::motion::filtered::FilteredSpec;
use splat4d::motion::hexplane::{Heads, HexplaneSpec};
use splat4d::motion::skin::SkinSpec;
use splat4d::motion::spacetime::FeatureSpec;
use splat4d::motion::ssm::SsmSpec;
use splat4d::motion::tracked::TrackedSpec;
use splat4d::motion::{SpacetimeSpec, Spec, build};
use splat4d::nn::hexplane::PlaneShape;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, LIFE, LifeKind, Params, SH};
use std::path::Path;

/// Gaussians that fly for a second, z up.
pub(crate) fn moving() -> Scene<f32> {
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
    let layer = Layer::new("birds", params, motion, life);
    let head = if features.is_some() { Head::Features } else { Head::Identity };
    Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 4.0, up: [0.0, 0.0, 1.0], head, ..Scene::default() }
}

fn open(path: &Path) -> Scene<f32> {
    let bytes = std::fs::read(path).unwrap();
    let kind = Dialect::of_file(path.to_str().unwrap(), &bytes).unwrap();
    kind.open(&bytes).unwrap().scene
}

#[test]
fn a_dynamic_scene_converts_to_every_format() {
    let work = tempfile::tempdir().unwrap();
    let at = |name: &str| work.path().join(name);
    let mut bytes = Vec::new();
    scene::write(&moving(), &mut bytes).unwrap();
    std::fs::write(at("birds.safetensors"), bytes).unwrap();
    let convert = |from: &str, to: &str, more: &[&str]| {
        splat4d(&["convert", from, to, "--json"]).args(more).run_in(work.path()).ok()
    };

    // Moving targets keep the motion, turned to their axes; single times report the chosen one.
    for (name, dialect) in [("birds.splatv", splatv::DIALECT), ("birds.stg.ply", ply::STG)] {
        let said = convert("birds.safetensors", name, &[]);
        assert!(said.contains("view dependence"), "{said}");
        let back = open(&at(name));
        assert_eq!((back.len(), back.clip, back.fps, back.up), (40, [0.0, 1.0], 4.0, dialect.up));
    }
    for name in ["a.ply", "a.compressed.ply", "a.spz", "a.splat"] {
        let said = convert("birds.safetensors", name, &[]);
        assert!(said.contains("one time") && said.contains("--frames"), "{name}: {said}");
        assert_eq!(open(&at(name)).len(), 40);
    }
    // z up became y down: what was z is now −y, at the requested time.
    convert("birds.safetensors", "then.ply", &["--time", "0.75", "--sh", "0"]);
    let then = open(&at("then.ply"));
    let (own, was) = (&then.layers[0].params, moving());
    let p = &was.layers[0].params;
    let v = p.find("velocities").unwrap();
    let z = p[GEOMETRY].get(7, 2) + 0.25 * p[v].get(7, 2);
    assert!((own[GEOMETRY].get(7, 1) + z).abs() < 1e-5, "{} {z}", own[GEOMETRY].get(7, 1));
    assert_eq!(own[SH].width(), 3);
    // ... by default to keep its axes.
    convert("birds.safetensors", "kept.ply", &["--time", "0.5", "--up", "keep"]);
    assert_eq!(open(&at("kept.ply")).layers[0].params[GEOMETRY].read::<3>(7, 0), p[GEOMETRY].read::<3>(7, 0));
    convert("birds.safetensors", "z.spz", &["--time", "0.5", "--up=-z", "--spz-version", "4"]);
    assert!(std::fs::read(at("z.spz")).unwrap().starts_with(b"NGSP\x04"));

    // A file a frame, and back as one moving scene.
    convert("birds.safetensors", "frames/f_%03d.spz", &["--frames"]);
    assert!(at("frames/f_000.spz").is_file() && at("frames/f_004.spz").is_file() && !at("frames/f_005.spz").exists());
    convert("frames", "joined.safetensors", &["--fps", "4"]);
    let joined = scene::read(&std::fs::read(at("joined.safetensors")).unwrap()).unwrap();
    assert_eq!((joined.clip, joined.len(), joined.up), ([0.0, 1.0], 5 * 40, [0.0, -1.0, 0.0]));
    let refused = splat4d(&["convert", "frames", "x.splatv", "--exact"]).run_in(work.path()).refused();
    assert!(refused.contains("flat top") && refused.contains("--frames"), "{refused}");
}

#[test]
fn a_scene_with_a_head_renders_and_does_not_convert() {
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
        let pictures = shown(&work.path().join(out));
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
        &["bake", "full.safetensors", "-o", "a.s4d"][..],
        &["convert", "full.safetensors", "a.s4d"],
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
    // Paths do not depend on colours.
    run(&["export", "full.safetensors", "--tracks", "a.csv"]).ok();
}

/// The folder of a run states the cameras that colours are folded for.
#[test]
fn a_run_with_a_head_is_baked_exported_and_converted() {
    let work = tempfile::tempdir().unwrap();
    let capture = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/knight");
    let settings =
        ["features=full", "motion=spacetime", "iterations=12", "downscale=16", "max_frames=2", "max_cap=300"];
    let settings = settings.iter().flat_map(|s| ["--set", s]);
    let run = |args: &[&str]| splat4d(args).run_in(work.path());
    let train: Vec<&str> = ["train", capture, "-o", "run", "--device", "cpu"].into_iter().chain(settings).collect();
    let said = run(&train).ok();
    assert!(
        said.contains("spherical harmonics of degree 3 replace the network") && said.contains("held-out views"),
        "{said}"
    );
    assert!(work.path().join("run/scene.s4d").is_file(), "training ends with a playback file");
    let page = std::fs::read_to_string(work.path().join("run/report.html")).unwrap();
    assert!(page.contains("spherical harmonics in place of the network: "), "the report states the loss");
    for args in [
        &["bake", "run", "-o", "a.s4d"][..],
        &["convert", "run", "a.splatv"],
        &["convert", "run", "frames/f_%d.spz", "--frames"],
        &["export", "run", "-o", "a.ply", "--velocities"],
        &["export", "run", "-o", "a.html", "--html"],
    ] {
        run(args).ok();
    }
    // The scene itself keeps its network.
    run(&["convert", "run", "same.safetensors"]).ok();
    let same = scene::read(&std::fs::read(work.path().join("same.safetensors")).unwrap()).unwrap();
    assert_eq!(same.head, Head::Features);
}

/// A model of every kind whose tables cannot be rotated, in a small box.
fn models_with_frames() -> Vec<Spec> {
    let skin = SkinSpec { nodes: 6, neighbours: 3, hyper: 2, mask: false };
    let planes = PlaneShape { channels: 16, resolution: 4, time_resolution: 5, multires: vec![1, 2] };
    let heads = Heads { position: true, scale: true, rotation: true, opacity: true, sh: true };
    let hexplane = HexplaneSpec { low: [-1.5; 3], high: [1.5; 3], planes, net_width: 8, heads, ..Default::default() };
    let trajectory = TrajectorySpec::Keys { curve: Curve::Cubic, keys: 6 };
    let input = Input::Encoded { x_levels: 2, t_levels: 2, time_net: true };
    let flying =
        Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, detach: false, origin: 0.5, features: None });
    vec![
        Spec::Hexplane(hexplane),
        Spec::Tracked(TrackedSpec { times: vec![0.0, 0.4, 1.0], foreground: false }),
        Spec::Control(ControlSpec { seed: 3, clip: [0.0, 1.0], skin, trajectory }),
        Spec::Ssm(SsmSpec { skin, ticks: 9, width: 6, states: 2, embedding: 3, octaves: 2, ..SsmSpec::default() }),
        Spec::DeformMlp(DeformSpec { seed: 2, clip: [0.0, 1.0], input, width: 9, layers: 2, skip: None, rigid: true }),
        Spec::Filtered(FilteredSpec::around(flying, 0.05, 0.0)),
    ]
}

/// Whatever a scene moves by, its file in other axes is the same cloud, rotated.
#[test]
fn other_axes_rotate_every_model_as_a_whole() {
    let work = tempfile::tempdir().unwrap();
    for spec in models_with_frames() {
        let (rows, name) = (40, spec.name().to_owned());
        let mut params = Params::new(rows, 4, &[]);
        let rng = Rng::new(4, "axes", 0);
        for row in 0..rows {
            let draw = |k: u64| rng.fork(row as u64).normal(k) as f32;
            params[GEOMETRY].write::<3>(row, 0, std::array::from_fn(|k| 0.5 * draw(k as u64)));
            params[GEOMETRY].write::<4>(row, QUAT, std::array::from_fn(|k| draw(3 + k as u64)));
            params[GEOMETRY].write::<3>(row, LOG_SCALE, std::array::from_fn(|k| -2.0 + 0.5 * draw(7 + k as u64)));
            params[GEOMETRY].set(row, OPACITY, 2.0);
            params[SH].write::<12>(row, 0, std::array::from_fn(|k| 0.3 * draw(10 + k as u64)));
        }
        let motion = build(&spec, &mut params).unwrap();
        // Moved from where training starts, so that everything moves.
        let learnt: Vec<_> = params.keys().skip(3).filter(|&k| params.info(k).trainable).collect();
        for key in learnt {
            let (rows, width) = (params[key].rows(), params[key].width());
            for (row, col) in (0..rows).flat_map(|r| (0..width).map(move |c| (r, c))) {
                let x = rng.fork(100 + u64::from(key.0)).normal((row * 64 + col) as u64) as f32;
                *params[key].get_mut(row, col) += 0.2 * x;
            }
        }
        let layer = Layer::new(name.as_str(), params, motion, LifeKind::Infinite);
        let scene = Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 4.0, up: [0.1, 0.3, 0.9], ..Scene::default() };
        let mut bytes = Vec::new();
        scene::write(&scene, &mut bytes).unwrap();
        std::fs::write(work.path().join("a.safetensors"), bytes).unwrap();
        let convert = |from: &str, to: &str, more: &[&str]| {
            splat4d(&["convert", from, to]).args(more).run_in(work.path()).ok();
        };
        convert("a.safetensors", "kept.ply", &["--time", "0.5", "--up", "keep"]);
        convert("a.safetensors", "default.ply", &["--time", "0.5"]);
        // By way of a scene file, which keeps the model and its frame.
        convert("a.safetensors", "rotated.safetensors", &["--up=-y"]);
        convert("rotated.safetensors", "later.ply", &["--time", "0.5"]);
        let r = rotation_between(scene.up, [0.0, -1.0, 0.0]).unwrap();
        let kept = open(&work.path().join("kept.ply"));
        for other in ["default.ply", "later.ply"] {
            let other = open(&work.path().join(other));
            let (a, b) = (&kept.layers[0].params, &other.layers[0].params);
            let mut rotated = kept.layers[0].clone();
            rotated.frame = Sim3::from_rotation(r);
            rotated.apply_transform();
            let shape = |p: &Params, row: usize| {
                let q = quat::normalize(p[GEOMETRY].read::<4>(row, QUAT).map(f64::from)).0;
                sym3::from_quat_log_scales(q, p[GEOMETRY].read::<3>(row, LOG_SCALE).map(f64::from))
            };
            assert_eq!((a.len(), b.len()), (rows, rows), "{name}");
            for row in 0..rows {
                let (x, y) = (rotated.params[GEOMETRY].read::<3>(row, 0), b[GEOMETRY].read::<3>(row, 0));
                assert!((0..3).all(|k| (x[k] - y[k]).abs() < 1e-5), "{name}, mean {row}: {x:?} {y:?}");
                let (x, y) = (shape(&rotated.params, row), shape(b, row));
                assert!((0..6).all(|k| (x[k] - y[k]).abs() < 1e-4), "{name}, shape {row}: {x:?} {y:?}");
                let (x, y) = (rotated.params[SH].read::<12>(row, 0), b[SH].read::<12>(row, 0));
                assert!((0..12).all(|k| (x[k] - y[k]).abs() < 1e-5), "{name}, colour {row}: {x:?} {y:?}");
            }
        }
    }
}

#[test]
fn plain_files_keep_their_bits_and_impossible_options_are_refused() {
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
    assert!(refused(&["convert", "a.ply", "a.pt"]).contains("not written"));
    assert!(refused(&["convert", "a.ply", "a.obj"]).contains(".splatv"));
    assert!(refused(&["convert", "a.ply", "f_%d.ply"]).contains("--frames"));
    assert!(refused(&["convert", "a.ply", "b.spz", "--frames"]).contains("pattern"));
    std::fs::write(work.path().join("old.ksplat"), b"\0\x01").unwrap();
    assert!(refused(&["convert", "old.ksplat", "b.ply"]).contains("unknown format"));
    std::fs::create_dir(work.path().join("empty")).unwrap();
    assert!(refused(&["convert", "empty", "b.ply"]).contains("numbered"));
}
