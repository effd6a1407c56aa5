use super::*;
use crate::bake::{Options, Shown, bake, compare};
use crate::device;
use crate::format::scene::{read, write};
use crate::layers::{Evaluation, Layer};
use crate::math::{Rng, Se3, Sim3, quat};
use crate::motion::control::ControlSpec;
use crate::motion::hexplane::{Heads, HexplaneSpec};
use crate::motion::{SpacetimeSpec, Spec, build};
use crate::nn::hexplane::PlaneShape;
use crate::render::RenderConfig;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, LIFE, LifeKind, Params, Rows, SH, Space};

/// A context that has one camera, one mask and one scene; nodes are static.
struct Bench {
    other: Scene<f32>,
    mask: Mask,
    views: Vec<(Camera, Time, Mask)>,
}

impl Bench {
    fn empty() -> Self {
        Self { other: Scene::default(), mask: Mask::default(), views: Vec::new() }
    }
}

impl Context for Bench {
    fn camera(&self, name: &str) -> Result<Camera> {
        if name == "front" { Ok(front()) } else { Err(missing(&format!("camera `{name}`"), "It has: front")) }
    }
    fn mask(&self, _: &str, _: &Camera) -> Result<Mask> {
        Ok(self.mask.clone())
    }
    fn subject(&self) -> Result<Vec<(Camera, Time, Mask)>> {
        Ok(self.views.clone())
    }
    fn scene(&self, _: &str) -> Result<Scene<f32>> {
        Ok(self.other.clone())
    }
    fn follow(
        &self,
        _: &Scene<f32>,
        _: &Selected,
        start: &[[f64; 3]],
        times: &[f64],
        _: usize,
    ) -> Result<Vec<Vec<[f64; 3]>>> {
        Ok(vec![start.to_vec(); times.len()])
    }
}

fn front() -> Camera {
    Camera::with_fov_y(Se3::look_at([0.0, 0.0, -5.0], [0.0; 3], [0.0, -1.0, 0.0]), 0.7, 64, 48)
}

/// `rows` Gaussians of a ball of radius about 1 that move by `spec`.
fn layer(name: &str, spec: &Spec, rows: usize, seed: u64) -> Layer {
    let life = if matches!(spec, Spec::Spacetime(_)) { LifeKind::GaussHalf } else { LifeKind::Infinite };
    let mut params = Params::new(rows, 4, life.columns());
    let rng = Rng::new(seed, "edit", 0);
    for row in 0..rows {
        let x = |k: u64| rng.fork(row as u64).normal(k) as f32;
        params[GEOMETRY].write(row, 0, [0.4 * x(0), 0.4 * x(1), 0.4 * x(2)]);
        params[GEOMETRY].write(row, QUAT, [1.0, 0.3 * x(3), 0.3 * x(4), 0.3 * x(5)]);
        params[GEOMETRY].write(row, LOG_SCALE, [-2.3 + 0.2 * x(6), -2.5, -2.9]);
        params[GEOMETRY].set(row, OPACITY, 1.0 + x(7));
        (0..12)
            .for_each(|k| params[SH].set(row, k, if k < 3 { 0.4 * x(8 + k as u64) } else { 0.08 * x(20 + k as u64) }));
        if life != LifeKind::Infinite {
            params[LIFE].write(row, 0, [0.5 + 0.3 * x(40), -0.6]);
        }
    }
    let motion = build(spec, &mut params).unwrap();
    let own: Vec<_> = params.keys().skip(3).filter(|k| params.info(*k).trainable).collect();
    for key in own {
        for row in 0..params[key].rows() {
            for col in 0..params[key].width() {
                let by = 0.15 * rng.fork(99 + u64::from(key.0)).normal((row * params[key].width() + col) as u64);
                *params[key].get_mut(row, col) += by as f32;
            }
        }
    }
    Layer::new(name, params, motion, life)
}

fn of(layers: Vec<Layer>) -> Scene<f32> {
    Scene { layers, clip: [0.0, 1.0], fps: 20.0, up: [0.0, -1.0, 0.0], ..Scene::default() }
}

fn spacetime() -> Spec {
    Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, detach: true, origin: 0.5, features: None })
}

fn hexplane() -> Spec {
    Spec::Hexplane(HexplaneSpec {
        low: [-2.0; 3],
        high: [2.0; 3],
        planes: PlaneShape { channels: 16, resolution: 4, time_resolution: 5, multires: vec![1, 2] },
        net_width: 8,
        heads: Heads { position: true, scale: true, rotation: true, opacity: true, sh: true },
        ..HexplaneSpec::default()
    })
}

/// One scene a kind of model: in tables, in planes, on nodes.
fn scenes() -> Vec<Scene<f32>> {
    let control = Spec::Control(ControlSpec { clip: [0.0, 1.0], ..ControlSpec::default() });
    [spacetime(), hexplane(), control, Spec::Still].iter().map(|s| of(vec![layer("ball", s, 150, 4)])).collect()
}

fn steps(text: &str) -> Vec<Step> {
    serde_json::from_str(text).unwrap()
}

fn run(text: &str, scene: &Scene<f32>) -> Result<Scene<f32>> {
    Ok(replay(&steps(text), scene.clone(), &Bench::empty(), &mut |_, _| {})?.0)
}

fn draw(scene: &Scene<f32>, t: f64) -> Vec<f32> {
    crate::draw(scene, &front(), Time(t)).unwrap().color.data
}

fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    -10.0 * (sum / a.len() as f64).max(1e-12).log10()
}

fn bytes(scene: &Scene<f32>) -> Vec<u8> {
    let mut out = Vec::new();
    write(scene, &mut out).unwrap();
    out
}

fn counted(text: &str, scene: &Scene<f32>) -> usize {
    count(&Expr::parse(text).unwrap(), scene, &[], &Bench::empty()).unwrap().0
}

/// One Gaussian that goes from x = −1 at 0 s to x = 1 at 1 s, and one that is at x = 2.
fn walker() -> Scene<f32> {
    let spec = Spec::Spacetime(SpacetimeSpec { order: 1, rotation: false, detach: true, origin: 0.5, features: None });
    let mut params = Params::new(2, 1, &[]);
    let motion = build(&spec, &mut params).unwrap();
    let velocities = params.find(crate::motion::spacetime::VELOCITIES).unwrap();
    for (row, x, v) in [(0, 0.0, 2.0), (1, 2.0, 0.0)] {
        params[GEOMETRY].write(row, 0, [x, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -2.0, -3.0, -3.0, 0.0]);
        params[velocities].write(row, 0, [v, 0.0, 0.0]);
        params[SH].write(row, 0, [row as f32, 0.0, 0.0]);
    }
    of(vec![Layer::new("two", params, motion, LifeKind::Infinite)])
}

#[test]
fn selections_hold_over_time() {
    let s = walker();
    for (text, wanted) in [
        ("all", 2),
        ("box(-2,-1,-1, -0.1,1,1)", 0), // half of the time is not most of it
        ("box(-2,-1,-1, 0.5,1,1)", 1),
        ("ever(box(-2,-1,-1, -0.1,1,1))", 1),
        ("always(box(-2,-1,-1, -0.1,1,1))", 0),
        ("always(box(-2,-1,-1, 2,1,1))", 2),
        ("at(0.1, box(-2,-1,-1, -0.1,1,1))", 1),
        ("at(0.9, box(-2,-1,-1, -0.1,1,1))", 0),
        ("speed(1.9, 2.1)", 1),
        ("speed(0, 1)", 1),
        ("not speed(0, 1) or sphere(2,0,0, 0.1)", 2),
        ("speed(1, 3) and sphere(2,0,0, 0.1)", 0),
        ("opacity(0.4, 0.6)", 2),
        ("size(0.13, 0.14)", 2), // e^-2
        ("size(0.2, 9)", 0),
        ("life(0.9, 1.1)", 2),
        ("color(0.78, 0.5, 0.5, 0.02)", 1), // ½ + Y₀₀
        ("layer(two)", 2),
        ("frustum(front)", 2),
        ("frustum(front, 0, 4)", 0),
        ("frustum(front) and sphere(2,0,0, 0.1)", 1),
        ("grow(sphere(2,0,0, 0.1), 1.1)", 2), // the walker comes within 1 of it at the end
        ("grow(sphere(2,0,0, 0.1), 0.9)", 1),
    ] {
        assert_eq!(counted(text, &s), wanted, "{text}");
    }
    let (all, over_time) =
        count(&Expr::parse("ever(sphere(1,0,0, 0.1))").unwrap(), &s, &[0.0, 0.5], &Bench::empty()).unwrap();
    assert_eq!((all, over_time), (1, vec![1, 1]), "it is there also when the selection does not hold");
}

#[test]
fn features_like_those_of_a_place_are_selected() {
    use crate::scene::features;
    let mut s = of(vec![layer("ball", &Spec::Still, 150, 4), layer("other", &Spec::Still, 60, 5)]);
    let nothing = Bench::empty();
    let expr = Expr::parse("like(0,0,0, 0.9)").unwrap();
    assert!(select(&expr, &s, &nothing).unwrap_err().to_string().contains("has no features"));
    let rows = s.layers[0].params.len();
    let key = features::claim(&mut s.layers[0].params, 2).unwrap();
    // Every third has none, the others one of two kinds of any length.
    for row in 0..rows {
        let kind = if row % 3 == 1 { [1.0 + row as f32, 0.1] } else { [-0.1, 2.0] };
        s.layers[0].params[key].write(row, 0, if row % 3 == 0 { [0.0; 2] } else { kind });
    }
    let place = s.layers[0].params[GEOMETRY].read::<3>(1, 0);
    let [x, y, z] = place;
    let t = s.clip[0];
    let found = select(&Expr::parse(&format!("at({t}, like({x},{y},{z}, 0.9))")).unwrap(), &s, &nothing).unwrap();
    let alive = found[0].iter().enumerate().filter(|(_, chosen)| **chosen).count();
    assert!(alive > 0 && found[0].iter().enumerate().all(|(row, chosen)| !chosen || row % 3 == 1), "{found:?}");
    assert!(found[1..].iter().flatten().all(|chosen| !chosen), "the others have no features");
}

#[test]
fn labels_are_selected_kept_and_merged() {
    use crate::scene::labels;
    let labelled = |names: [&str; 2], of: [Option<usize>; 2]| {
        let mut s = walker();
        labels::state(&mut s.layers[0].params, 2, &of);
        s.labels = names.map(str::to_owned).to_vec();
        s
    };
    let s = labelled(["floor", "left hand"], [Some(1), None]);
    for (text, wanted) in [("label('left hand')", 1), ("not label(floor)", 2), ("label(floor)", 0)] {
        assert_eq!(counted(text, &s), wanted, "{text}");
    }
    let error = count(&Expr::parse("label(foot)").unwrap(), &s, &[], &Bench::empty()).unwrap_err().to_string();
    assert!(error.contains("`foot`") && error.contains("floor, left hand"), "{error}");
    // Numbers are a scene's own: the same name is one label.
    let other = labelled(["left hand", "ball"], [Some(0), Some(1)]);
    let bench = Bench { other, ..Bench::empty() };
    let both = replay(&steps(r#"[{"do": "merge", "scene": "b", "name": "b"}]"#), s, &bench, &mut |_, _| {}).unwrap().0;
    assert_eq!(both.labels, ["floor", "left hand", "ball"]);
    let of = |layer: usize| labels::of(&both.layers[layer].params);
    assert_eq!((of(0), of(1)), (vec![Some(1), None], vec![Some(1), Some(2)]));
    assert_eq!(counted("label('left hand')", &both), 2);
}

#[test]
fn a_mask_selects_gaussians_visible_to_its_camera() {
    let s = walker();
    // The left half of the image is white: x < 0 of the camera, which sees the world mirrored in no axis.
    let white = (0..48 * 64).map(|i| i % 64 < 32).collect::<Vec<_>>();
    let side = front().project([-0.5, 0.0, 0.0]).unwrap().0[0] < 32.0;
    let mask = Mask { width: 64, height: 48, white };
    let bench = Bench { views: vec![(front(), Time(0.1), mask.clone()); 2], mask, ..Bench::empty() };
    let of = |text: &str| select(&Expr::parse(text).unwrap(), &s, &bench).map(|s| s[0].clone());
    let early = of("at(0.1, mask(m.png, front))").unwrap();
    let late = of("at(0.9, mask(m.png, front))").unwrap();
    assert_eq!((early, late), (vec![side, false], vec![!side, false]));
    assert_eq!(of("subject").unwrap(), vec![side, false]);
    let small = Bench { mask: Mask { width: 2, height: 2, white: vec![true; 4] }, ..Bench::empty() };
    let error = select(&Expr::parse("mask(m.png, front)").unwrap(), &s, &small).unwrap_err().to_string();
    assert!(error.contains("2 x 2") && error.contains("64 x 48"), "{error}");
}

#[test]
fn undo_restores_the_scene_exactly() {
    for s in scenes() {
        let before = bytes(&s);
        let gone = run(r#"[{"do": "delete", "select": "sphere(0,0,0, 0.5)"}]"#, &s).unwrap();
        assert!(gone.len() < s.len() && !gone.is_empty());
        let kept = run(r#"[{"do": "crop", "select": "sphere(0,0,0, 0.5)"}]"#, &s).unwrap();
        assert_eq!(gone.len() + kept.len(), s.len());
        // Undo is leaving the step out: the same bits.
        assert_eq!(bytes(&run("[]", &s).unwrap()), before);
    }
}

#[test]
fn an_edit_and_its_inverse_cancel() {
    let turn = r#""turn": [0.3, 1, -0.2, 70], "scale": 1.25"#;
    let back = r#""turn": [0.3, 1, -0.2, -70], "scale": 0.8"#;
    let text = format!(
        r#"[{{"do": "move", "select": "all", "to": {{"shift": [0.5, -0.2, 1], "about": [0.1, 0, 0], {turn}}}}},
            {{"do": "move", "select": "all", "to": {{"shift": [-0.5, 0.2, -1], "about": [0.6, -0.2, 1], {back}}}}}]"#
    );
    for s in scenes() {
        let again = run(&text, &s).unwrap();
        for t in [0.0, 0.4, 0.9] {
            let [mut a, mut b] = [Evaluation::default(), Evaluation::default()];
            s.at(Time(t), &mut a);
            again.at(Time(t), &mut b);
            for (a, b) in a.tapes().zip(b.tapes()) {
                for (j, k) in (0..a.out().rows()).flat_map(|j| (0..3).map(move |k| (j, k))) {
                    let (a, b) = (a.out().get(j, k), b.out().get(j, k));
                    assert!((a - b).abs() < 1e-6, "{}: {a} {b}", s.layers[0].motion.spec().name());
                }
            }
            assert!(psnr(&draw(&s, t), &draw(&again, t)) > 70.0);
        }
    }
}

#[test]
fn a_hidden_part_is_invisible_during_its_time_range() {
    for s in scenes() {
        let hidden = run(r#"[{"do": "hide", "select": "box(-9,-9,-9, 0,9,9)", "from": 0.3, "to": 0.6}]"#, &s).unwrap();
        let gone = run(r#"[{"do": "delete", "select": "box(-9,-9,-9, 0,9,9)"}]"#, &s).unwrap();
        for t in [0.1, 0.6, 0.9] {
            assert!(psnr(&draw(&hidden, t), &draw(&s, t)) > 90.0, "at {t}");
        }
        for t in [0.3, 0.5] {
            assert!(psnr(&draw(&hidden, t), &draw(&gone, t)) > 90.0, "at {t}");
            let like = psnr(&draw(&hidden, t), &draw(&s, t));
            assert!(like < 40.0, "the test must see something at {t}: {like} dB");
        }
    }
}

#[test]
fn colours_and_opacity_change_as_specified() {
    for s in scenes() {
        let name = s.layers[0].motion.spec().name().to_owned();
        // The renderer cuts colours at zero, which commutes with a factor.
        let half = run(r#"[{"do": "recolor", "select": "all", "exposure": -1}]"#, &s).unwrap();
        let tinted = run(r#"[{"do": "recolor", "select": "all", "tint": [1, 0.25, 0]}]"#, &s).unwrap();
        let a = draw(&s, 0.4);
        let expected: Vec<f32> = a.iter().map(|x| 0.5 * x).collect();
        assert!(psnr(&draw(&half, 0.4), &expected) > 70.0, "{name}");
        let plane = a.len() / 3;
        let expected: Vec<f32> = a.iter().enumerate().map(|(i, x)| x * [1.0, 0.25, 0.0][i / plane]).collect();
        assert!(psnr(&draw(&tinted, 0.4), &expected) > 70.0, "{name}");
        let grey = run(r#"[{"do": "recolor", "select": "all", "saturation": 0}]"#, &s).unwrap();
        let g = draw(&grey, 0.4);
        assert!((0..plane).all(|i| (g[i] - g[plane + i]).abs() < 1e-3 && (g[i] - g[2 * plane + i]).abs() < 1e-3));
        // A factor of opacity is one, whether it is written into tables or over time.
        let keys = r#"[{"do": "opacity", "select": "all", "keys": [{"t": 0, "factor": 0}, {"t": 0.8, "factor": 1}]}]"#;
        let fixed = run(r#"[{"do": "opacity", "select": "all", "factor": 0.5}]"#, &s).unwrap();
        let fading = run(keys, &s).unwrap();
        assert!(psnr(&draw(&fading, 0.4), &draw(&fixed, 0.4)) > 70.0, "{name}");
        assert!(draw(&fading, 0.0).iter().all(|x| x.abs() < 0.02), "{name}");
        assert!(psnr(&draw(&fading, 0.9), &draw(&s, 0.9)) > 90.0, "{name}");
    }
}

#[test]
fn keys_move_over_time() {
    let keys = r#""keys": [{"t": 0.2, "shift": [0, 0, 0]}, {"t": 0.8, "shift": [0.6, 0, 0], "turn": [0, 0, 1, 60]}]"#;
    for s in scenes() {
        let text = format!(r#"[{{"do": "move", "select": "all", "about": [0.1, 0.2, 0], {keys}}}]"#);
        let moved = run(&text, &s).unwrap();
        let at = |shift: &str, degrees: f64| {
            let to = format!(r#"{{"shift": {shift}, "about": [0.1, 0.2, 0], "turn": [0, 0, 1, {degrees}]}}"#);
            run(&format!(r#"[{{"do": "move", "select": "all", "to": {to}}}]"#), &s).unwrap()
        };
        assert!(psnr(&draw(&moved, 0.1), &draw(&s, 0.1)) > 90.0);
        assert!(psnr(&draw(&moved, 0.5), &draw(&at("[0.3, 0, 0]", 30.0), 0.5)) > 60.0);
        assert!(psnr(&draw(&moved, 0.9), &draw(&at("[0.6, 0, 0]", 60.0), 0.9)) > 60.0);
        // A single key holds at all times, and a removed time range has it.
        let one = run(r#"[{"do": "move", "select": "all", "keys": [{"t": 0, "shift": [0.3, 0, 0]}]}]"#, &s).unwrap();
        let frozen = crate::layers::moment(&one, Time(0.4)).unwrap();
        let still = Layer::new("now", frozen, std::sync::Arc::new(crate::motion::Still), LifeKind::Infinite);
        assert!(psnr(&draw(&of(vec![still]), 0.0), &draw(&one, 0.4)) > 50.0);
    }
}

#[test]
fn retiming_works_on_every_model() {
    for s in scenes() {
        let slow = run(r#"[{"do": "retime", "rate": 0.5, "from": 0.2, "to": 0.6}]"#, &s).unwrap();
        assert!((slow.clip[1] - 1.4).abs() < 1e-12);
        for (t, was) in [(0.1, 0.1), (0.3, 0.25), (0.9, 0.55), (1.2, 0.8)] {
            let like = psnr(&draw(&slow, t), &draw(&s, was));
            assert!(like > 60.0, "{} at {t}: {like}", s.layers[0].motion.spec().name());
        }
        let backwards = run(r#"[{"do": "retime", "rate": -1}]"#, &s).unwrap();
        assert_eq!(backwards.clip, s.clip);
        assert!(psnr(&draw(&backwards, 0.3), &draw(&s, 0.7)) > 60.0);
        // Twice backwards after a path and a fade: both go along.
        let keyed = r#"{"do": "move", "select": "all", "keys": [{"t": 0, "shift": [0, 0, 0]}, {"t": 1, "shift": [0.5, 0, 0]}]}"#;
        let once = run(&format!("[{keyed}]"), &s).unwrap();
        let turned = run(&format!(r#"[{keyed}, {{"do": "retime", "rate": -1}}]"#), &s).unwrap();
        assert!(psnr(&draw(&turned, 0.3), &draw(&once, 0.7)) > 60.0);
        let cut = run(r#"[{"do": "cut", "from": 0.25, "to": 0.5}]"#, &s).unwrap();
        assert_eq!(cut.clip, [0.25, 0.5]);
        assert!(psnr(&draw(&cut, 0.3), &draw(&s, 0.3)) > 90.0 && psnr(&draw(&cut, 0.5), &draw(&s, 0.5)) > 90.0);
    }
}

#[test]
fn merged_scenes_render_as_each_alone() {
    for s in scenes() {
        let other = of(vec![layer("ball", &spacetime(), 150, 7)]);
        let bench = Bench { other: other.clone(), ..Bench::empty() };
        let step = r#"[{"do": "merge", "scene": "b", "name": "b", "at": 0.25, "to": {"shift": [40, 0, 0]}}]"#;
        let both = replay(&steps(step), s.clone(), &bench, &mut |_, _| {}).unwrap().0;
        assert_eq!((both.clip, both.len()), ([0.0, 1.25], s.len() + other.len()));
        assert_eq!(both.layers.last().unwrap().name, "b/ball");
        let there = Camera {
            cam_from_world: Sim3 {
                scale: 1.0,
                rotation: quat::to_rotation([1.0, 0.0, 0.0, 0.0]),
                translation: [40.0, 0.0, 0.0],
            }
            .pose(&front().cam_from_world),
            ..front()
        };
        for t in [0.25, 0.7, 1.0] {
            assert!(psnr(&draw(&both, t), &draw(&s, t)) > 90.0);
            let seen = crate::draw(&both, &there, Time(t)).unwrap().color.data;
            let like = psnr(&seen, &draw(&other, t - 0.25));
            assert!(like >= 50.0, "{like} dB at {t}");
        }
        assert!(crate::draw(&both, &there, Time(0.1)).unwrap().color.data.iter().all(|x| *x < 0.01), "not there yet");
    }
}

#[test]
fn copies_and_parts_are_layers() {
    for s in scenes() {
        let text = r#"[{"do": "split", "select": "sphere(0,0,0, 0.5)", "name": "core"},
                       {"do": "duplicate", "select": "layer(core)", "name": "copy"},
                       {"do": "move", "select": "layer(copy)", "to": {"shift": [40, 0, 0]}}]"#;
        let split = run(text, &s).unwrap();
        let names: Vec<&str> = split.layers.iter().map(|l| l.name.as_str()).collect();
        assert_eq!(names, ["ball", "core", "copy"]);
        assert_eq!(split.layers[0].params.len() + split.layers[1].params.len(), s.len());
        assert_eq!(split.layers[1].params.len(), split.layers[2].params.len());
        assert!(psnr(&draw(&split, 0.4), &draw(&s, 0.4)) > 90.0);
    }
}

/// An upright rod, and a second one next to it that stays untouched.
fn rods() -> Scene<f32> {
    let mut params = Params::new(1200, 1, &[]);
    for i in 0..1200 {
        let r = Rng::new(3, "rods", 0).fork(i as u64);
        let x = if i % 2 == 0 { 0.0 } else { 1.5 };
        let place = [x + 0.05 * r.normal(0), 0.05 * r.normal(1), 2.0 * r.uniform(2) - 1.0];
        params[GEOMETRY].write(i, 0, place.map(|x| x as f32));
        params[GEOMETRY].write(i, QUAT, [1.0, 0.0, 0.0, 0.0, -3.5, -3.5, -3.5, 2.0]);
    }
    of(vec![Layer::new("rods", params, std::sync::Arc::new(crate::motion::Still), LifeKind::Infinite)])
}

#[test]
fn a_drag_moves_the_selection_alone() {
    let s = rods();
    let step = r#"[{"do": "drag", "select": "all", "at": 0.0, "nodes": 60, "pins": [[0, 0, -1, 0.7]],
        "handles": [{"place": [0, 0, 1], "radius": 0.2, "keys": [{"t": 0.0, "by": [0, 0, 0]}, {"t": 0.5, "by": [0, 0.6, 0]}]}]}]"#;
    let bent = run(step, &s).unwrap();
    let at = |scene: &Scene<f32>, t: f64| {
        let mut e = Evaluation::default();
        scene.at(Time(t), &mut e);
        let out = e.tape(0).out().clone();
        (0..out.rows()).map(|j| out.read::<3>(j, 0)).collect::<Vec<_>>()
    };
    let (rest, start, half, end) = (at(&s, 0.0), at(&bent, 0.0), at(&bent, 0.25), at(&bent, 0.9));
    for i in 0..1200 {
        let moved = |to: &[[f32; 3]]| (0..3).map(|k| (to[i][k] - rest[i][k]).powi(2)).sum::<f32>().sqrt();
        assert!(moved(&start) < 1e-5, "the drag begins with nothing");
        if i % 2 == 1 {
            assert!(moved(&end) < 1e-5, "the other rod stays: {}", moved(&end));
        } else if rest[i][2] < -0.6 {
            assert!(moved(&end) < 0.06, "what is pinned stays: {}", moved(&end));
        } else if rest[i][2] > 0.95 {
            assert!((end[i][1] - rest[i][1] - 0.6).abs() < 0.1, "the top follows: {}", end[i][1] - rest[i][1]);
            assert!((half[i][1] - rest[i][1] - 0.3).abs() < 0.1, "half way at half time");
        }
    }
    // It is in the file.
    let again = read(&bytes(&bent)).unwrap();
    assert_eq!(at(&again, 0.9), end);
    // Dragged again: a second track on the first.
    let twice =
        run(&step.replace(r#"[{"do"#, r#"[{"do": "opacity", "select": "all", "factor": 1.0}, {"do"#), &bent).unwrap();
    assert!(read(&bytes(&twice)).is_ok());
}

#[test]
fn edited_scenes_are_files_and_bake() {
    let step = r#"[{"do": "move", "select": "box(-9,-9,-9, 0,9,9)", "keys": [{"t": 0.1, "shift": [0, 0, 0]}, {"t": 0.9, "shift": [-0.4, 0.2, 0], "turn": [0, 1, 0, 40]}]},
        {"do": "recolor", "select": "all", "exposure": 0.3, "curve": [[0, 0], [0.5, 0.4], [1, 1]]},
        {"do": "retime", "rate": 0.8},
        {"do": "hide", "select": "box(0,-9,-9, 9,9,9)", "from": 0.412, "to": 0.633},
        {"do": "retime", "rate": 0.7, "from": 0.21, "to": 0.77}]"#;
    for s in scenes() {
        let name = s.layers[0].motion.spec().name().to_owned();
        let edited = run(step, &s).unwrap();
        let again = read(&bytes(&edited)).unwrap();
        assert_eq!(bytes(&again), bytes(&edited), "{name}");
        for t in [0.2, 0.5, 1.1] {
            assert_eq!(draw(&again, t), draw(&edited, t), "{name} at {t}");
        }
        let options = Options { cameras: vec![front()], tolerance: 0.1, ..Options::default() };
        let baked = bake(&edited, &options, &mut |_, _| {}).unwrap();
        let mut cpu = device::cpu(RenderConfig::default());
        let shots = [0.05, 0.3, 0.7, 1.0].map(|t| (t, front()));
        let like = compare(&edited, Shown::Nodes(&baked.nodes), &shots, cpu.as_mut(), &mut |_, _| true).unwrap();
        let psnr = like.expect("pictures were compared").psnr;
        assert!(psnr >= 45.0, "{name}: {psnr} dB");
    }
}

#[test]
fn impossible_edits_give_a_reason() {
    let s = walker();
    for (step, word) in [
        (r#"{"do": "delete", "select": "sphere(9,9,9, 0.1)"}"#, "empty"),
        (r#"{"do": "delete", "select": "layer(nobody)"}"#, "two"),
        (r#"{"do": "delete", "select": "all"}"#, "nothing"),
        (r#"{"do": "delete", "select": "frustum(back)"}"#, "front"),
        (r#"{"do": "delete", "select": "at(7, all)"}"#, "clip"),
        (r#"{"do": "hide", "select": "all", "from": 1, "to": 0}"#, "time range"),
        (r#"{"do": "opacity", "select": "all", "factor": 2}"#, "factor"),
        (r#"{"do": "opacity", "select": "all"}"#, "keys"),
        (r#"{"do": "move", "select": "all"}"#, "to"),
        (r#"{"do": "move", "select": "all", "to": {"scale": 0}}"#, "scale"),
        (r#"{"do": "move", "select": "all", "to": {"turn": [0, 0, 0, 9]}}"#, "axis"),
        (r#"{"do": "recolor", "select": "all", "curve": [[1, 0], [0, 1]]}"#, "curve"),
        (r#"{"do": "cut", "from": 5, "to": 6}"#, "clip"),
        (r#"{"do": "retime", "rate": 0}"#, "rate"),
        (r#"{"do": "drag", "select": "all", "at": 0.5, "handles": []}"#, "handles"),
        (r#"{"do": "floaters", "strength": 0.5}"#, "training view"),
        (r#"{"do": "floaters", "strength": 5}"#, "strength"),
    ] {
        let error = run(&format!("[{step}]"), &s).unwrap_err().to_string();
        assert!(error.contains(word), "{step}: {error}");
        assert!(error.contains("edit 1 (") || word == "nothing", "{error}");
    }
    assert!(serde_json::from_str::<Step>(r#"{"do": "delete", "select": "all", "radius": 1}"#).is_err());
    let edits = Edits { scene: Some("knight".into()), ..Edits::default() };
    assert!(edits.check("cat").unwrap_err().to_string().contains("knight"));
    assert!(edits.check("knight").is_ok() && Edits { version: 9, ..edits }.check("knight").is_err());
}

/// A ball before a wall, seen with masks from four sides: alone it has no halo on any colour.
#[test]
fn a_subject_alone_has_no_halo() {
    let mut ball = layer("all", &Spec::Still, 400, 5);
    let n = ball.params.len();
    for row in 0..n {
        let r = Rng::new(6, "halo", 0).fork(row as u64);
        let unit = crate::math::se3::normalize([r.normal(0), r.normal(1), r.normal(2)]);
        let wall = row % 2 == 1;
        let place =
            if wall { [3.0 * r.uniform(3) - 1.5, 3.0 * r.uniform(4) - 1.5, 2.5] } else { unit.map(|x| 0.5 * x) };
        ball.params[GEOMETRY].write(row, 0, place.map(|x| x as f32));
        ball.params[GEOMETRY].write(row, LOG_SCALE, [-2.6, -2.6, -2.6, 3.0]);
        (0..12).for_each(|k| ball.params[SH].set(row, k, 0.0));
        ball.params[SH].write(row, 0, if wall { [1.5, 1.5, -1.5] } else { [1.0, -1.0, -1.0] });
    }
    let s = of(vec![ball]);
    let truth = Scene {
        layers: vec![{
            let mut l = s.layers[0].clone();
            l.edit(&crate::scene::RowEdit::prune(Space::Gaussians, (0..n).map(|i| i % 2 == 0)), &Rng::new(0, "x", 0));
            l
        }],
        ..s.clone()
    };
    let side = |x: f64| Camera::with_fov_y(Se3::look_at([x, 0.3, -4.0], [0.0; 3], [0.0, -1.0, 0.0]), 0.7, 96, 96);
    let views = [-3.0, -1.0, 1.0, 3.0].map(|x| {
        let camera = side(x);
        let alpha = crate::draw(&truth, &camera, Time(0.0)).unwrap().alpha;
        let mask = Mask { width: 96, height: 96, white: alpha.data.iter().map(|a| *a > 0.5).collect() };
        (camera, Time(0.0), mask)
    });
    let bench = Bench { views: views.to_vec(), ..Bench::empty() };
    let alone =
        replay(&steps(r#"[{"do": "crop", "select": "subject"}]"#), s.clone(), &bench, &mut |_, _| {}).unwrap().0;
    let rest =
        replay(&steps(r#"[{"do": "crop", "select": "not subject"}]"#), s.clone(), &bench, &mut |_, _| {}).unwrap().0;
    assert_eq!(alone.len() + rest.len(), s.len());
    for background in [[1.0; 3], [0.0; 3], [0.0, 1.0, 0.0]] {
        let on =
            |scene: &Scene<f32>| crate::draw(&Scene { background, ..scene.clone() }, &side(0.4), Time(0.0)).unwrap();
        let (a, b) = (on(&alone), on(&truth));
        let like = psnr(&a.color.data, &b.color.data);
        assert!(like > 35.0, "{like} dB on {background:?}");
        // Where the subject is not, nothing is left.
        let outside = b.alpha.data.iter().zip(&a.alpha.data).filter(|(truth, _)| **truth < 0.01);
        assert!(outside.clone().count() > 3000 && outside.clone().all(|(_, alone)| *alone < 0.02), "a halo");
    }
}

#[test]
fn a_lasso_selects_behind_its_outline() {
    let scene = &scenes()[3];
    let camera = front();
    let world = camera.cam_from_world.inverse();
    let turn = quat::from_rotation(&world.rotation).map(|x| x.to_string()).join(",");
    let eye = world.translation.map(|x| x.to_string()).join(",");
    let half = |range: &str| format!("lasso({eye}, {turn}, {range}, 0,-1, 1,-1, 1,1, 0,1)");
    let found = |text: &str| select(&Expr::parse(text).unwrap(), scene, &Bench::empty()).unwrap().remove(0);
    let (all, near) = (found(&half("0,100")), found(&half("0,5")));
    for (row, x) in scene.layers[0].means().enumerate() {
        let p = camera.cam_from_world.apply(x);
        assert_eq!(all[row], p[0] > 0.0, "row {row}");
        assert_eq!(near[row], p[0] > 0.0 && p[2] <= 5.0, "row {row}");
    }
    assert!(near.contains(&true) && near != all);
}

#[test]
fn visible_selects_up_to_the_depth_of_each_cell() {
    let scene = &scenes()[3];
    let camera = front();
    let world = camera.cam_from_world.inverse();
    let turn = quat::from_rotation(&world.rotation).map(|x| x.to_string()).join(",");
    let eye = world.translation.map(|x| x.to_string()).join(",");
    // Left of the middle nothing, right of it up to a depth of 5.
    let text = format!("visible({eye}, {turn}, -1,-1, 1,1, 2, 0,5)");
    let found = select(&Expr::parse(&text).unwrap(), scene, &Bench::empty()).unwrap().remove(0);
    for (row, x) in scene.layers[0].means().enumerate() {
        let p = camera.cam_from_world.apply(x);
        assert_eq!(found[row], p[0] >= 0.0 && p[2] <= 5.0, "row {row}");
    }
    assert!(found.contains(&true) && found.contains(&false));
}

#[test]
fn eased_keys_start_and_end_slowly_at_the_same_values() {
    let scene = &scenes()[3];
    let path = |ease: bool, t: f64| {
        let keys = format!(
            r#"[{{"do":"move","select":"all","keys":[{{"t":0,"ease":{ease}}},{{"t":1,"shift":[0,0,1],"ease":{ease}}}]}}]"#
        );
        let moved = run(&keys, scene).unwrap();
        let mut seen = Evaluation::default();
        moved.at(Time(t), &mut seen);
        f64::from(seen.tape(0).out().get(0, 2)) - scene.layers[0].means().next().unwrap()[2]
    };
    for (t, way) in [(0.0, 0.0), (0.5, 0.5), (1.0, 1.0)] {
        assert!((path(true, t) - way).abs() < 1e-6 && (path(false, t) - way).abs() < 1e-6, "{t}");
    }
    assert!((path(true, 0.1) - 0.028).abs() < 1e-6 && (path(false, 0.1) - 0.1).abs() < 1e-6);
}

#[test]
fn dragged_nodes_move_their_gaussians() {
    let scene = &scenes()[2];
    let all: Selected = vec![vec![true; 150]];
    let own = Evaluation::of_layer(&scene.layers[0], Space::Nodes, Rows::All, Time(0.5));
    let mut dragging = Dragging::new(scene, &all, [0.5, 0.5], 0, &Bench::empty()).unwrap();
    assert_eq!(dragging.nodes().len(), scene.layers[0].params.rows_of(Space::Nodes));
    assert_eq!(dragging.nodes()[1], own.tape(0).out().read::<3>(1, 0).map(f64::from));
    let handle = DragHandle {
        place: dragging.nodes()[0],
        radius: 0.0,
        keys: vec![DragKey { t: 0.5, by: [0.5; 3], ease: false }],
    };
    dragging.pull(&[(handle.clone(), [0.5; 3])], &[]).unwrap();
    let step =
        |nodes| Step::Drag { select: "all".into(), at: 0.5, nodes, handles: vec![handle.clone()], pins: Vec::new() };
    let (bent, _) = replay(&[step(0)], scene.clone(), &Bench::empty(), &mut |_, _| {}).unwrap();
    let same = psnr(&draw(&bent, 0.5), &draw(dragging.scene(), 0.0));
    assert!(same > 50.0, "{same} dB");
    let error = replay(&[step(0)], scenes()[0].clone(), &Bench::empty(), &mut |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("no control nodes") && error.contains("512"), "{error}");
}

#[test]
fn the_preview_of_a_drag_equals_its_step() {
    for scene in scenes() {
        let bench = Bench::empty();
        let all: Selected = scene.layers.iter().map(|l| vec![true; l.params.len()]).collect();
        for now in [0.5, 0.75] {
            let mut dragging = Dragging::new(&scene, &all, [0.5, now], 24, &bench).unwrap();
            let place = dragging.places()[3];
            let handle =
                DragHandle { place, radius: 0.1, keys: vec![DragKey { t: 0.5, by: [0.4, 0.1, 0.0], ease: false }] };
            let pins = [[0.0, 0.0, 0.0, 0.2]];
            let nodes = dragging.pull(&[(handle.clone(), [0.4, 0.1, 0.0])], &pins).unwrap();
            assert!((nodes[3][0] - dragging.nodes()[3][0] - 0.4).abs() < 1e-9);
            let step =
                Step::Drag { select: "all".into(), at: 0.5, nodes: 24, handles: vec![handle], pins: pins.to_vec() };
            let (bent, _) = replay(&[step], scene.clone(), &bench, &mut |_, _| {}).unwrap();
            let same = psnr(&draw(&bent, now), &draw(dragging.scene(), 0.0));
            // Elsewhere in time other positions decide which Gaussian follows which node.
            assert!(same > if now == 0.5 { 50.0 } else { 36.0 }, "{same} dB at {now}");
            assert!(psnr(&draw(&scene, now), &draw(dragging.scene(), 0.0)) < 35.0, "something was bent");
            dragging.pull(&[], &[]).unwrap();
            assert!(psnr(&draw(&scene, now), &draw(dragging.scene(), 0.0)) > 50.0, "let go, it is as it was");
        }
    }
}

/// What a step would multiply beyond memory, or stretch beyond use, is refused before it is made.
#[test]
fn edits_beyond_memory_or_time_are_refused_before_they_run() {
    struct Small(Bench);
    impl Context for Small {
        fn memory(&self) -> Option<u64> {
            Some(1 << 20)
        }
        fn follow(
            &self,
            scene: &Scene<f32>,
            among: &Selected,
            start: &[[f64; 3]],
            times: &[f64],
            first: usize,
        ) -> Result<Vec<Vec<[f64; 3]>>> {
            self.0.follow(scene, among, start, times, first)
        }
    }
    let small = Small(Bench::empty());
    let scene = walker();
    let refused = |text: &str, context: &dyn Context| {
        replay(&steps(text), scene.clone(), context, &mut |_, _| {}).map(|_| ()).expect_err(text)
    };
    let double = r#"{"do": "duplicate", "select": "all", "name": "copy"}"#;
    let many = format!("[{}]", [double; 60].join(","));
    // In advance: no step is taken.
    let mut taken = 0;
    replay(&steps(&many), scene.clone(), &small, &mut |_, _| taken += 1).map(|_| ()).unwrap_err();
    assert_eq!(taken, 0);
    let error = refused(&many, &small);
    let text = error.to_string();
    assert!(error.kind() == ErrorKind::Memory && text.contains("duplicate") && text.contains("Gaussians"), "{text}");
    assert!(text.contains("0.0 GiB of memory are available"), "{text}");
    let bench = Bench::empty();
    for rate in ["1e-9", "-1e-9", "1e-300"] {
        let text = refused(&format!(r#"[{{"do": "retime", "rate": {rate}}}]"#), &bench).to_string();
        assert!(text.contains("edit 1 (retime)") && text.contains("frames"), "{text}");
    }
    let bench = Bench { other: of(vec![layer("b", &Spec::Still, 5, 1)]), ..Bench::empty() };
    let text = refused(r#"[{"do": "merge", "scene": "b", "name": "b", "at": 1e12}]"#, &bench).to_string();
    assert!(text.contains("edit 1 (merge)") && text.contains("frames"), "{text}");
}

#[test]
fn an_overflow_is_refused_and_names_its_step() {
    let hide = r#"{"do": "opacity", "select": "all", "factor": 0.9}"#;
    for step in [
        r#"{"do": "move", "select": "all", "to": {"shift": [1e39, 0, 0]}}"#,
        r#"{"do": "move", "select": "all", "to": {"scale": 1e39}}"#,
        r#"{"do": "move", "select": "all", "to": {"scale": 1e-60, "about": [1e30, 0, 0]}}"#,
        r#"{"do": "move", "select": "all", "keys": [{"t": 0, "shift": [0, 0, 0]}, {"t": 1, "shift": [0, 1e39, 0]}]}"#,
        r#"{"do": "move", "select": "all", "keys": [{"t": 0, "scale": 1e39}, {"t": 1, "scale": 1}]}"#,
        r#"{"do": "recolor", "select": "all", "exposure": 200}"#,
        r#"{"do": "recolor", "select": "all", "tint": [1e200, 1, 1]}"#,
    ] {
        for scene in scenes() {
            let text = format!("[{hide}, {step}]");
            let error = match run(&text, &scene) {
                // Values that do not overflow are not NaN either.
                Ok(edited) => {
                    let written = write(&edited, &mut Vec::new());
                    assert!(written.is_ok(), "{step}: {written:?}");
                    assert!(draw(&edited, 1.0).iter().all(|x| x.is_finite()), "{step}");
                    continue;
                }
                Err(error) => error.to_string(),
            };
            assert!(error.contains("edit 2 ("), "{step}: {error}");
        }
    }
    let refused = run(r#"[{"do": "move", "select": "all", "to": {"shift": [1e39, 0, 0]}}]"#, &scenes()[0]).unwrap_err();
    assert!(refused.to_string().contains("too large"), "{refused}");
    // Changes over time, one on another, can be read again.
    let pan =
        r#"{"do": "move", "select": "all", "keys": [{"t": 0, "shift": [0, 0, 0]}, {"t": 1, "shift": [0, 0.1, 0]}]}"#;
    let many = |n: usize| run(&format!("[{}]", vec![pan; n].join(",")), &scenes()[0]);
    assert_eq!(read(&bytes(&many(20).unwrap())).unwrap().len(), 150);
    let error = many(100).unwrap_err().to_string();
    assert!(error.contains("one on another"), "{error}");
}
