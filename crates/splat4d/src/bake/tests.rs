//! Baking whole scenes: what is straight stays exact, what is not stays within the tolerance, and every time shows
//! every Gaussian once.

use super::*;
use crate::device;
use crate::format::playback::{Draft, Meta, Primitive, WriteConfig, read, write};
use crate::layers::{ALPHA_MIN, Evaluation, Layer};
use crate::math::{Rng, Se3};
use crate::motion::spacetime::VELOCITIES;
use crate::motion::still::activate;
use crate::motion::{At, Cache, Motion, SpacetimeSpec, Spec, Tape, build, fill_rows};
use crate::render::RenderConfig;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::splats::SPLAT_OPACITY;
use crate::scene::{Color, GEOMETRY, Grads, LIFE, LifeKind, Params, SH, SplatGrads, Table, Time};
use std::sync::Arc;

/// Rounding of f32 parameters against the model's own f32 arithmetic, as a share of the cloud's size.
const ROUNDING: f32 = 2e-5;
const FPS: f64 = 30.0;

/// A cloud of `n` Gaussians about the origin; velocities and the like are normal numbers times `pace`.
fn layer(spec: &Spec, life: LifeKind, n: usize, pace: f32, clip: f64) -> Layer<f32> {
    let mut params = Params::new(n, 4, life.columns());
    let motion = build(spec, &mut params).unwrap();
    for key in params.keys().collect::<Vec<_>>() {
        let table = &mut params[key];
        for row in 0..table.rows() {
            for col in 0..table.width() {
                let noise = Rng::new(7, "bake", u64::from(key.0)).normal((row * 64 + col) as u64) as f32;
                table.set(row, col, pace * noise);
            }
        }
    }
    cloud(&mut params, n);
    if life != LifeKind::Infinite {
        for i in 0..n {
            let rng = Rng::new(8, "life", i as u64);
            params[LIFE].set(i, 0, (rng.uniform(0) * clip) as f32);
            (1..params[LIFE].width()).for_each(|k| params[LIFE].set(i, k, (-1.6 + rng.normal(k as u64)) as f32));
        }
    }
    Layer::new("cloud", params, motion, life)
}

/// Fills geometry and colour.
fn cloud(params: &mut Params<f32>, n: usize) {
    for i in 0..n {
        let rng = Rng::new(9, "cloud", i as u64);
        let geometry = &mut params[GEOMETRY];
        (0..3).for_each(|k| geometry.set(i, k, (0.6 * rng.normal(k as u64)) as f32));
        (0..4).for_each(|k| geometry.set(i, QUAT + k, rng.normal(10 + k as u64) as f32));
        (0..3).for_each(|k| geometry.set(i, LOG_SCALE + k, (-2.6 + 0.5 * rng.normal(20 + k as u64)) as f32));
        geometry.set(i, OPACITY, (1.5 * rng.normal(30)) as f32);
        (0..12).for_each(|k| params[SH].set(i, k, (0.5 * rng.normal(40 + k as u64)) as f32));
    }
}

fn scene(layers: Vec<Layer<f32>>, last: f64) -> Scene<f32> {
    Scene { layers, clip: [0.0, last], fps: FPS, background: [0.3; 3], up: [0.0, 1.0, 0.0], ..Scene::default() }
}

fn spacetime(order: usize, rotation: bool) -> Spec {
    Spec::Spacetime(SpacetimeSpec { order, rotation, detach: false, origin: 0.4, features: None })
}

fn cameras() -> Vec<Camera> {
    let eye = |a: f64| [4.0 * a.cos(), 0.7, 4.0 * a.sin()];
    let pose = |a: f64| Se3::look_at(eye(a), [0.0; 3], [0.0, 1.0, 0.0]);
    [0.3, 2.1, 4.4].map(|a| Camera::with_fov_y(pose(a), 0.8, 96, 72)).to_vec()
}

/// Every camera at every time.
fn shots(times: &[f64]) -> Vec<(f64, Camera)> {
    times.iter().flat_map(|t| cameras().into_iter().map(|camera| (*t, camera))).collect()
}

fn options(tolerance: f64) -> Options {
    Options { tolerance, cameras: cameras(), ..Options::default() }
}

fn baked(scene: &Scene<f32>, options: &Options) -> Baked {
    bake(scene, options, &mut |_, _| {}).unwrap()
}

fn likeness(scene: &Scene<f32>, baked: &Baked) -> Likeness {
    likeness_after(scene, baked, 0.0)
}

/// This many frames after frames.
fn likeness_after(scene: &Scene<f32>, baked: &Baked, part: f64) -> Likeness {
    let frames = ((scene.clip[1] - scene.clip[0]) * FPS).round() as usize + 1;
    let times: Vec<f64> = (0..frames).step_by(frames.div_ceil(9)).map(|k| (k as f64 + part) / FPS).collect();
    let mut cpu = device::cpu(RenderConfig::default());
    compare(scene, Shown::Nodes(&baked.nodes), &shots(&times), cpu.as_mut(), &mut |_, _| true).unwrap().unwrap()
}

/// (mean, covariance, opacity) of everything that is visible, sorted by its mean.
fn visible(splats: &crate::scene::Splats<'_>) -> Vec<[f32; 10]> {
    let rows = splats.parts.iter().flat_map(|p| (0..p.out.rows()).map(|j| p.out.read::<10>(j, 0)));
    let mut rows: Vec<[f32; 10]> = rows.filter(|r| f64::from(r[SPLAT_OPACITY]) >= 1.001 * ALPHA_MIN).collect();
    rows.sort_by(|a, b| a[..3].partial_cmp(&b[..3]).unwrap());
    rows
}

#[test]
fn a_cross_fade_is_baked_into_opacities() {
    let life = LifeKind::GaussHalf;
    let going = Layer {
        span: [f64::NEG_INFINITY, 1.2],
        cross_fade: [0.0, 0.4],
        ..layer(&spacetime(1, false), life, 60, 0.2, 2.0)
    };
    let coming = Layer { span: [0.8, f64::INFINITY], cross_fade: [0.4, 0.0], ..going.clone() };
    let mut scene = scene(vec![going, coming], 2.0);
    let faded = baked(&scene, &options(0.25));
    let like = likeness(&scene, &faded);
    assert!(like.worst_psnr > 40.0, "{like:?}");
    // Rendered in the middle of it: without the fade the image differs.
    scene.layers.iter_mut().for_each(|l| l.cross_fade = [0.0; 2]);
    assert!(likeness(&scene, &faded).worst_psnr < 35.0);
}

#[test]
fn straight_motion_with_every_kind_of_lifespan_is_exact() {
    for (spec, life) in [
        (Spec::Still, LifeKind::Infinite),
        (spacetime(0, false), LifeKind::Interval),
        (spacetime(1, false), LifeKind::Infinite),
        (spacetime(1, false), LifeKind::GaussHalf),
        (spacetime(1, false), LifeKind::GaussOne),
        (spacetime(1, false), LifeKind::Interval),
    ] {
        let scene = scene(vec![layer(&spec, life, 200, 0.3, 2.4)], 2.4);
        let baked = baked(&scene, &options(0.25));
        assert_eq!(baked.report.errors.worst, 0.0);
        assert_eq!(baked.report.split, 0, "one primitive a Gaussian");
        let (mut instant, mut moment) = (Evaluation::default(), Moment::default());
        // Between frames too, and at both ends.
        for t in [0.0, 0.013, 0.7, 1.0, 1.33333, 2.0, 2.4] {
            scene.at(Time(t), &mut instant);
            moment.fill(&baked.nodes, scene.clip, t);
            let (a, b) = (visible(&scene.splats(&instant)), visible(&moment.splats()));
            assert_eq!(a.len(), b.len(), "{spec:?} {life:?} at {t}");
            assert!(life != LifeKind::Infinite || a.len() > 150, "something must be there to be compared");
            for (a, b) in a.iter().zip(&b) {
                assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < ROUNDING), "{life:?} at {t}: {a:?} {b:?}");
            }
        }
        assert!(likeness(&scene, &baked).worst_psnr > 80.0);
    }
}

#[test]
fn the_general_algorithm_bakes_straight_motion_exactly() {
    // The same scene twice: once visible, once behind an opaque model.
    let straight = scene(vec![layer(&spacetime(1, false), LifeKind::GaussHalf, 150, 0.3, 2.4)], 2.4);
    let mut hidden = straight.clone();
    hidden.layers[0].motion = Arc::new(Hidden(straight.layers[0].motion.clone()));
    let (a, b) = (baked(&straight, &options(0.25)), baked(&hidden, &options(0.25)));
    assert_eq!(a.report.primitives, b.report.primitives);
    assert!(b.report.errors.worst < 0.01, "{}", b.report.errors.worst);
    assert!(likeness(&straight, &b).worst_psnr > 65.0, "{:?}", likeness(&straight, &b));
}

#[test]
fn curves_and_turns_are_split_and_stay_within_the_tolerance() {
    for (spec, life) in [
        (spacetime(3, false), LifeKind::Infinite),
        (spacetime(3, true), LifeKind::GaussHalf),
        (spacetime(2, true), LifeKind::Interval),
    ] {
        let scene = scene(vec![layer(&spec, life, 120, 0.4, 1.9)], 1.9);
        let baked = baked(&scene, &options(0.25));
        let report = &baked.report;
        assert!(report.split > 20, "{report:?}");
        assert!(report.errors.worst <= 0.25 || report.key_states > 0, "{report:?}");
        assert!(report.primitives < 30 * 120, "far fewer than a key state a frame: {report:?}");
        let like = likeness(&scene, &baked);
        assert!(like.psnr > 40.0, "{spec:?}: {like:?}, {report:?}");
        let coarse = bake(&scene, &options(4.0), &mut |_, _| {}).unwrap();
        assert!(coarse.report.primitives < report.primitives, "a wider tolerance needs fewer pieces");
        assert!(likeness(&scene, &coarse).psnr < like.psnr);
    }
}

/// What turns too fast for anything but key states is whole between frames as well.
#[test]
fn key_states_turn_on_to_the_next_frame() {
    let scene = scene(vec![layer(&spacetime(1, true), LifeKind::Infinite, 120, 6.0, 0.9)], 0.9);
    let baked = baked(&scene, &options(0.02));
    assert!(baked.report.key_states > 300, "{:?}", baked.report);
    let [on, between] = [0.0, 0.5].map(|part| likeness_after(&scene, &baked, part).psnr);
    assert!(on > 60.0 && between > 53.0, "{on} dB on frames, {between} dB between them");
}

#[test]
fn jumps_become_key_states() {
    let scene = leaps(60, 20.0);
    let baked = baked(&scene, &options(0.25));
    let visible = 60 - baked.report.unseen;
    assert!(baked.report.key_states * 10 > visible * 20 * 9, "{:?}", baked.report);
    assert!(baked.report.errors.worst <= 0.25, "a key state is what the model is: {:?}", baked.report.errors);
    assert!(likeness(&scene, &baked).worst_psnr > 45.0, "{:?}", likeness(&scene, &baked));
}

#[test]
fn every_visible_gaussian_is_shown_once_at_every_time() {
    let lives = [LifeKind::Infinite, LifeKind::GaussHalf, LifeKind::Interval];
    for life in lives {
        let scene = scene(vec![layer(&spacetime(3, true), life, 80, 0.5, 2.9)], 2.9);
        let baked = baked(&scene, &Options { segment: 0.5, ..options(0.3) });
        for pair in baked.nodes.windows(2) {
            assert!((pair[0].from, -pair[0].to) < (pair[1].from, -pair[1].to), "nodes are in order, each once");
        }
        // Colours do not change, and so they identify the Gaussian of a primitive.
        let color = |p: &Primitive| p.sh_rest[..9].iter().map(|c| c.to_bits()).collect::<Vec<_>>();
        let own = |id: usize| (3..12).map(|k| scene.layers[0].params[SH].get(id, k).to_bits()).collect::<Vec<_>>();
        let borders = baked.nodes.iter().flat_map(|n| [n.from, n.to.next_down()]);
        let times = (0..88).map(|k| f64::from(k) / 30.0).chain([0.01, 1.2345, 2.9]).chain(borders);
        for t in times.map(|t| t.clamp(0.0, 2.9)) {
            let mut ids = Vec::new();
            if scene.layers[0].active(Time(t), &mut ids) {
                ids = (0..80).filter(|&i| scene.layers[0].spans()[i as usize][0] <= t).collect();
            }
            for id in ids {
                let here = baked.nodes.iter().filter(|n| n.from <= t && t < n.to).flat_map(|n| &n.primitives);
                let count = here.filter(|p| color(p) == own(id as usize)).count();
                assert_eq!(count, 1, "{life:?}: Gaussian {id} at {t}");
            }
        }
    }
}

#[test]
fn any_number_of_threads_bakes_the_same() {
    let layers = || {
        let a = layer(&spacetime(3, true), LifeKind::GaussHalf, 150, 0.4, 1.0);
        vec![a, layer(&spacetime(1, false), LifeKind::Interval, 60, 0.4, 1.0)]
    };
    let scene = scene(layers(), 1.0);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| baked(&scene, &options(0.25)))
    };
    let (one, three) = (with(1), with(3));
    assert_eq!(one.nodes, three.nodes);
    assert_eq!(one.report, three.report);
    let within = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let options = options(0.25);
            let mut bakery = Bakery::new(&scene, &options).unwrap();
            let price = bakery.measure(&mut |_, _| {}).unwrap().unwrap().price_of(400.0);
            bakery.bake(Cut::Price(price), &mut |_, _| {}).unwrap().nodes
        })
    };
    assert_eq!(within(1), within(3));
}

#[test]
fn lifespans_are_stored_at_the_deepest_fitting_level() {
    let mut short = layer(&spacetime(1, false), LifeKind::GaussHalf, 300, 0.1, 7.9);
    for i in 0..300 {
        short.params[LIFE].set(i, 1, 0.05f32.ln());
    }
    let baked = baked(&scene(vec![short], 7.9), &options(0.25));
    let leaf: usize = baked.nodes.iter().filter(|n| n.to - n.from < 1.1).map(|n| n.primitives.len()).sum();
    assert!(leaf * 10 > baked.report.primitives * 6, "{leaf} of {}", baked.report.primitives);
    assert!(baked.nodes.iter().all(|n| n.to - n.from > 0.9), "straight motion needs no node below a segment");
}

#[test]
fn static_gaussians_of_repeated_rounds_are_stored_once() {
    let still = layer(&Spec::Still, LifeKind::Infinite, 50, 0.1, 1.0);
    let moving = layer(&spacetime(1, false), LifeKind::GaussHalf, 70, 0.3, 1.0);
    let one = scene(vec![still, moving], 29.0 / FPS);
    // So strict that only what really is static counts as still.
    let (once, thrice) = (baked(&one, &options(1e-6)), baked(&one, &Options { repeat: 3, ..options(1e-6) }));
    let still = 50;
    let moving = once.report.primitives - still;
    assert!(thrice.report.primitives == still + 3 * moving && moving > 50);
    assert!((thrice.clip[1] - (2.0 + 29.0 / FPS)).abs() < 1e-9);
    // The same frame of every round is the same.
    let mut moment = Moment::default();
    for k in [0, 7, 29] {
        let mut shown = Vec::new();
        for round in 0..3 {
            moment.fill(&thrice.nodes, thrice.clip, f64::from(round) + f64::from(k) / FPS + 1e-9);
            shown.push(visible(&moment.splats()));
        }
        moment.fill(&once.nodes, once.clip, f64::from(k) / FPS + 1e-9);
        let first = visible(&moment.splats());
        assert!(shown.iter().all(|s| s.len() == first.len() && first.len() > 30));
        for (a, b) in shown.iter().flat_map(|s| s.iter().zip(&first)) {
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-3), "{a:?} {b:?}");
        }
    }
}

#[test]
fn colours_that_change_are_followed() {
    let mut params = Params::new(40, 4, LifeKind::Infinite.columns());
    cloud(&mut params, 40);
    let layer = Layer::new("lamps", params, Arc::new(Lamps), LifeKind::Infinite);
    let scene = scene(vec![layer], 1.0);
    let baked = baked(&scene, &options(0.25));
    assert!(baked.report.split > 10, "{:?}", baked.report);
    assert_eq!(baked.sh_degree, 0, "a direct colour has no direction");
    let like = likeness(&scene, &baked);
    assert!(like.psnr > 40.0, "{like:?}");
}

#[test]
fn gaussians_of_a_static_scene_have_an_importance() {
    let single = scene(vec![layer(&spacetime(1, false), LifeKind::Infinite, 30, 0.3, 0.0)], 0.0);
    let one = baked(&single, &options(0.25));
    assert!(one.nodes[0].primitives.iter().all(|p| p.importance > 0.0), "without one, tiers are in the order of rows");
}

#[test]
fn odd_scenes_bake_or_are_refused() {
    let empty = scene(Vec::new(), 1.0);
    assert!(baked(&empty, &options(0.25)).nodes.is_empty());
    let single = scene(vec![layer(&spacetime(3, true), LifeKind::GaussHalf, 30, 0.3, 0.0)], 0.0);
    let one = baked(&single, &options(0.25));
    assert!(one.nodes.len() == 1 && one.report.primitives > 10 && one.report.key_states == 0);
    assert!(likeness(&single, &one).psnr > 60.0);
    assert!(bake(&scene(Vec::new(), f64::NAN), &options(0.25), &mut |_, _| {}).is_err());
    assert!(bake(&empty, &options(f64::NAN), &mut |_, _| {}).is_err());
    assert!(bake(&empty, &Options { repeat: 0, ..options(1.0) }, &mut |_, _| {}).is_err());
    assert!(bake(&empty, &Options { segment: -1.0, ..options(1.0) }, &mut |_, _| {}).is_err());
    for spec in [spacetime(1, false), spacetime(3, true)] {
        let mut sick = layer(&spec, LifeKind::GaussHalf, 30, 0.3, 1.0);
        sick.params[GEOMETRY].set(3, 0, f32::NAN);
        sick.params[GEOMETRY].set(4, LOG_SCALE, f32::INFINITY);
        sick.params[GEOMETRY].set(5, OPACITY, f32::NAN);
        sick.params[LIFE].set(6, 0, f32::NAN);
        sick.params[LIFE].set(7, 1, f32::NAN);
        sick.params[SH].set(8, 2, f32::NAN);
        // Not sick, but odd: a lifespan without end, one without length, and a leap out of all numbers.
        sick.params[LIFE].set(9, 1, 300.0);
        sick.params[LIFE].set(10, 1, -300.0);
        let velocities = sick.params.find(VELOCITIES).unwrap();
        sick.params[velocities].set(11, 0, 3e38);
        sick.params[LIFE].set(11, 0, -9.0);
        let well = baked(&scene(vec![sick], 1.0), &options(0.25));
        assert!(well.report.unseen >= 6 && well.report.primitives >= 15, "{:?}", well.report);
        for p in well.nodes.iter().flat_map(|n| &n.primitives) {
            let numbers = p.mean.iter().copied().chain(p.scales.map(f64::from)).chain(p.sh_rest.map(f64::from));
            assert!(numbers.chain([p.center, p.softness, f64::from(p.opacity)]).all(f64::is_finite));
        }
    }
}

#[test]
fn a_file_is_as_good_and_can_be_baked_again() {
    let a = layer(&spacetime(2, true), LifeKind::GaussHalf, 150, 0.4, 1.9);
    let scene = scene(vec![a, layer(&Spec::Still, LifeKind::Infinite, 100, 0.1, 1.9)], 1.9);
    let first = baked(&scene, &options(0.25));
    let file = |baked: &Baked| {
        let meta = Meta { clip: baked.clip, fps: FPS, up: scene.up, sh_degree: baked.sh_degree, ..Meta::default() };
        let draft = Draft { meta, nodes: baked.nodes.clone(), poster: None };
        let mut bytes = Vec::new();
        write(&draft, &WriteConfig::default(), &mut bytes).unwrap();
        read(&bytes).unwrap()
    };
    let like_at = |file: &Scene<f32>, times: &[f64]| {
        let mut cpu = device::cpu(RenderConfig::default());
        compare(&scene, Shown::File(file), &shots(times), cpu.as_mut(), &mut |_, _| true).unwrap().unwrap()
    };
    let times: Vec<f64> = (0..57).step_by(5).map(|k| f64::from(k) / FPS).collect();
    let like = |file: &Scene<f32>| like_at(file, &times);
    let played = file(&first);
    // A held-out view may be before the first training frame or after the last one, where a player shows the clip's
    // ends.
    let beyond = like_at(&played, &[scene.clip[0] - 0.5, scene.clip[1] + 0.5]);
    assert!(beyond.worst_psnr > 38.0, "{beyond:?}");
    assert!(like(&played).psnr > 40.0, "{:?} {:?}", like(&played), likeness(&scene, &first));
    let again = baked(&played, &options(0.25));
    let pages = again.report.primitives as f64 / first.report.primitives as f64;
    assert!((0.9..1.3).contains(&pages), "{:?}\n{:?}", first.report, again.report);
    assert!(like(&file(&again)).psnr > 38.0, "{:?}", like(&file(&again)));
}

/// Segments, and PSNR of the nodes against the model, of a scene cut by a budget of segments.
fn within(scene: &Scene<f32>, options: &Options, segments: f64) -> (usize, f64) {
    let mut bakery = Bakery::new(scene, options).unwrap();
    let curve = bakery.measure(&mut |_, _| {}).unwrap().expect("not all of it is straight");
    let baked = bakery.bake(Cut::Price(curve.price_of(segments)), &mut |_, _| {}).unwrap();
    assert_eq!(baked.report.tolerance, None);
    (baked.report.primitives, likeness(scene, &baked).psnr)
}

fn leaps(n: usize, frames: f64) -> Scene<f32> {
    let mut params = Params::new(n, 4, LifeKind::Infinite.columns());
    cloud(&mut params, n);
    scene(vec![Layer::new("leaps", params, Arc::new(Leaps), LifeKind::Infinite)], (frames - 1.0) / FPS)
}

/// The worst there is: every Gaussian is somewhere else in every frame. A file still has a size.
#[test]
fn a_budget_of_segments_is_kept_whatever_moves() {
    let scene = leaps(60, 20.0);
    let (mut last, mut like) = (0, 0.0);
    for segments in [60.0, 150.0, 400.0, 900.0] {
        let (found, psnr) = within(&scene, &options(0.25), segments);
        assert!((0.75 * segments - 10.0..=1.05 * segments).contains(&(found as f64)), "{found} of {segments}");
        assert!(found >= last && psnr >= like - 0.2, "{psnr} dB of {found} segments, {like} dB of {last}");
        (last, like) = (found, psnr);
    }
    assert!(last > 3 * 60);
    // Fewer than there are Gaussians cannot be.
    assert!(within(&scene, &options(0.25), 1.0).0 <= 60);
}

/// Of a cloud that cameras see from all sides, as many segments are as good as those that a tolerance chooses.
#[test]
fn segments_by_price_are_as_good_as_by_tolerance() {
    let scene = scene(vec![layer(&spacetime(3, true), LifeKind::Infinite, 120, 0.4, 1.9)], 1.9);
    let by_tolerance = baked(&scene, &options(1.0));
    let (segments, psnr) = within(&scene, &options(0.25), by_tolerance.report.primitives as f64);
    assert!(segments as f64 <= 1.05 * by_tolerance.report.primitives as f64);
    assert!(psnr > likeness(&scene, &by_tolerance).psnr - 0.5, "{psnr} dB, {:?}", likeness(&scene, &by_tolerance));
}

/// A camera that moves sees each Gaussian for a while: segments go there, and none of it is lost elsewhere.
#[test]
fn segments_concentrate_at_times_that_a_moving_camera_sees() {
    let scene = leaps(80, 30.0);
    let looking = |t: f64| {
        let a = 2.0 * t;
        let eye = [4.0 * a.cos(), 0.7, 4.0 * a.sin()];
        let aside = [2.0 * (a + 1.5).cos(), 0.0, 2.0 * (a + 1.5).sin()];
        (t, Camera::with_fov_y(Se3::look_at(eye, aside, [0.0, 1.0, 0.0]), 0.4, 96, 72))
    };
    let path: Vec<_> = (0..30).map(|k| looking(f64::from(k) / FPS)).collect();
    let like = |options: &Options| {
        let mut bakery = Bakery::new(&scene, options).unwrap();
        let curve = bakery.measure(&mut |_, _| {}).unwrap().unwrap();
        let baked = bakery.bake(Cut::Price(curve.price_of(700.0)), &mut |_, _| {}).unwrap();
        assert!((500..=800).contains(&baked.report.primitives), "{}", baked.report.primitives);
        let mut cpu = device::cpu(RenderConfig::default());
        compare(&scene, Shown::Nodes(&baked.nodes), &path, cpu.as_mut(), &mut |_, _| true).unwrap().unwrap().psnr
    };
    let moving = like(&Options { path: path.clone(), ..Options::default() });
    let anywhere = like(&options(0.25));
    assert!(moving > anywhere + 1.0, "{moving} dB on the path, {anywhere} dB when it is not known");
}

/// Renders that weigh errors take time: there are no more than the options allow.
#[test]
fn renders_for_error_weights_are_bounded_in_number() {
    let scene = leaps(20, 6.0);
    let path: Vec<_> = (0..6).map(|k| (f64::from(k) / FPS, cameras().remove(0))).collect();
    for (renders, taken) in [(0, 0), (2, 4), (4, 7)] {
        let options = Options { renders, path: path.clone(), ..options(0.25) };
        let mut calls = 0;
        let mut bakery = Bakery::new(&scene, &options).unwrap();
        bakery.measure(&mut |done, _| calls += usize::from(done == 0)).unwrap();
        assert_eq!(calls, taken, "{renders} renders each");
    }
}

/// The curve predicts what is baked.
#[test]
fn the_curve_gives_the_segments_needed_for_each_error() {
    let scene = scene(vec![layer(&spacetime(3, true), LifeKind::GaussHalf, 120, 0.4, 1.9)], 1.9);
    let options = options(0.25);
    let mut bakery = Bakery::new(&scene, &options).unwrap();
    let curve = bakery.measure(&mut |_, _| {}).unwrap().unwrap();
    for wanted in [1e-3, 1e-4, 1e-5] {
        let price = curve.price_for(wanted).unwrap();
        let baked = bakery.bake(Cut::Price(price), &mut |_, _| {}).unwrap();
        let [pieces, error] = curve.at(price);
        assert!((0.9..1.1).contains(&(pieces / baked.report.primitives as f64)), "{pieces} {:?}", baked.report);
        // Gaussians do not err independently, and fits minimise another error: some decibels.
        let psnr = likeness(&scene, &baked).psnr;
        assert!((psnr + 10.0 * error.log10()).abs() < 4.0, "{psnr} dB, foretold {}", -10.0 * error.log10());
    }
    assert_eq!(curve.price_for(0.0), None);
    assert!(curve.at(curve.price_of(1e9))[0] >= curve.least());
}

#[test]
fn straight_scenes_get_one_segment_at_every_tolerance() {
    let scene = scene(vec![layer(&spacetime(1, false), LifeKind::Interval, 50, 0.3, 1.0)], 1.0);
    let options = options(0.25);
    let mut bakery = Bakery::new(&scene, &options).unwrap();
    assert!(bakery.measure(&mut |_, _| {}).unwrap().is_none());
}

/// What takes too long to sample is sampled less often.
#[test]
fn time_samples_are_bounded() {
    let scene = leaps(60, 40.0);
    let few = Options { samples: 60 * 5, ..options(0.25) };
    let (segments, _) = within(&scene, &few, 1e6);
    assert!(segments <= 60 * 5, "{segments}");
}

/// Another model, unrecognisable.
struct Hidden(Arc<dyn Motion<f32>>);

impl Motion<f32> for Hidden {
    fn spec(&self) -> Spec {
        Spec::Custom("hidden".into())
    }

    fn scratch_bytes(&self, _p: &Params<f32>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, f32>, cache: &Cache, tape: &mut Tape<f32>) {
        self.0.at(q, cache, tape);
    }

    fn backward(
        &self,
        q: &At<'_, f32>,
        cache: &Cache,
        tape: &mut Tape<f32>,
        d_out: &SplatGrads<'_, f32>,
        d_cache: &mut Cache,
        d: &mut Grads<f32>,
    ) -> f64 {
        self.0.backward(q, cache, tape, d_out, d_cache, d)
    }
}

/// Every frame every Gaussian is somewhere else.
struct Leaps;

impl Motion<f32> for Leaps {
    fn spec(&self) -> Spec {
        Spec::Custom("leaps".into())
    }

    fn scratch_bytes(&self, _p: &Params<f32>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, f32>, _cache: &Cache, tape: &mut Tape<f32>) {
        tape.start(q.len());
        let frame = (q.t.0 * FPS).round() as u64;
        fill_rows(&mut tape.out, q.rows, |id| {
            let rng = Rng::new(4, "leap", id as u64 * 1000 + frame);
            let mut row = q.p[GEOMETRY].read::<11>(id, 0);
            (0..3).for_each(|k| row[k] += rng.normal(k as u64) as f32);
            (0..4).for_each(|k| row[QUAT + k] += rng.normal(9 + k as u64) as f32);
            activate(row)
        });
    }

    fn backward(
        &self,
        _q: &At<'_, f32>,
        _cache: &Cache,
        _tape: &mut Tape<f32>,
        _d_out: &SplatGrads<'_, f32>,
        _d_cache: &mut Cache,
        _d: &mut Grads<f32>,
    ) -> f64 {
        0.0
    }
}

/// Nothing moves, but colours swell and fade.
struct Lamps;

impl Motion<f32> for Lamps {
    fn spec(&self) -> Spec {
        Spec::Custom("lamps".into())
    }

    fn scratch_bytes(&self, _p: &Params<f32>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, f32>, _cache: &Cache, tape: &mut Tape<f32>) {
        tape.start(q.len());
        fill_rows(&mut tape.out, q.rows, |id| activate(q.p[GEOMETRY].read::<11>(id, 0)));
        let colors: &mut Colors = tape.own.get_or_default();
        colors.0 = Table::new(&[("rgb", 3)], q.len());
        fill_rows(&mut colors.0, q.rows, |id| {
            let phase = 3.0 * q.t.0 as f32 + id as f32;
            [0.5 + 0.4 * phase.sin(), 0.5, 0.5 + 0.4 * phase.cos()]
        });
    }

    fn color<'a>(&self, _q: &At<'a, f32>, tape: &'a Tape<f32>) -> Color<'a, f32> {
        Color::Direct { table: &tape.own.get::<Colors>().expect("`at` came first").0 }
    }

    fn backward(
        &self,
        _q: &At<'_, f32>,
        _cache: &Cache,
        _tape: &mut Tape<f32>,
        _d_out: &SplatGrads<'_, f32>,
        _d_cache: &mut Cache,
        _d: &mut Grads<f32>,
    ) -> f64 {
        0.0
    }
}

#[derive(Default)]
struct Colors(Table<f32>);
