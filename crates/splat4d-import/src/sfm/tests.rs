//! From synthetic features and images to cameras.

use super::learned::{Learned, Matcher, Matches};
use super::lens::Known;
use super::lens::Lens;
use super::mapper::{FOCALS, Mapping, map};
use super::pictures::{CameraView, Feature, FeatureOptions, Pictures, fixed};
use super::tracks::{Pairing, focal_votes, join, links};
use super::{CameraFrame, Options, Solution, solve, solve_sights};
use crate::{ErrorKind, Result};
use splat4d::math::align::apart;
use splat4d::math::{Rng, Se3};
use splat4d::scene::Planes;
use splat4d_train::capture::Rgb8;
use splat4d_train::event::Progress;
use splat4d_train::vision::raster::blurred;

/// What a rig of cameras about a scene truly is.
struct Rig {
    poses: Vec<Se3>,
    lenses: Vec<Lens>,
    taus: Vec<f64>,
    sights: Vec<CameraView>,
}

/// Cameras on an arc around points, seven tenths of which move; every feature off by `noise` pixels, and `wrong` of
/// them look like another one. Focal lengths differ by `spread`.
fn rig(cameras: usize, points: usize, noise: f64, wrong: f64, spread: f64) -> Rig {
    let rng = Rng::new(21, "rig", 0);
    let look = |p: usize, c: usize| {
        // As others see it, but for a little.
        let (kind, here) = (rng.fork(1000 + p as u64), rng.fork((5000 + 100 * p + c) as u64));
        std::array::from_fn(|k| (70.0 * kind.uniform(k as u64) + 10.0 * here.uniform(k as u64)) as u8)
    };
    let mut out = Rig { poses: Vec::new(), lenses: Vec::new(), taus: Vec::new(), sights: Vec::new() };
    for c in 0..cameras {
        let angle = 0.3 * c as f64;
        let eye = [5.0 * angle.sin(), -1.0 + 0.7 * rng.normal(c as u64), -5.0 * angle.cos()];
        let pose = Se3::look_at(eye, [0.0; 3], [0.0, -1.0, 0.0]);
        let lens =
            Lens { focal: 480.0 * (spread * rng.normal(50 + c as u64)).exp(), k1: -0.02, center: [322.0, 179.0] };
        let tau = 0.01 * rng.normal(80 + c as u64);
        let draw = rng.fork(100 + c as u64);
        let mut features = Vec::new();
        for p in 0..points {
            let x: [f64; 3] = std::array::from_fn(|k| 1.1 * rng.normal((1000 + 3 * p + k) as u64));
            let moment = if p < 3 * points / 10 { 0 } else { 1 + p % 4 };
            let moves = f64::from(u8::from(moment > 0));
            let speed: [f64; 3] = std::array::from_fn(|k| moves * rng.normal((9000 + 3 * p + k) as u64));
            let at = |t: f64| lens.project(pose.apply(std::array::from_fn(|k| x[k] + t * speed[k])));
            let (Some(here), Some(ago), Some(after)) = (at(0.0), at(-1e-4), at(1e-4)) else { continue };
            let velocity: [f64; 2] = std::array::from_fn(|k| (after[k] - ago[k]) / 2e-4);
            let pixel = std::array::from_fn(|k| here[k] - tau * velocity[k] + noise * draw.normal((2 * p + k) as u64));
            let inside = (0.0..640.0).contains(&pixel[0]) && (0.0..360.0).contains(&pixel[1]);
            let other = draw.fork(1).uniform(p as u64) < wrong;
            let kind = if other { draw.fork(2).below(p as u64, points) } else { p };
            if inside {
                features.push(Feature { pixel, velocity, moment, descriptor: look(kind, c), color: [p as u8; 3] });
            }
        }
        features.sort_by_key(|f| f.moment);
        out.sights.push(CameraView {
            learned: 0,
            name: format!("camera {c}"),
            size: [640, 360],
            factor: 1.0,
            focal: None,
            exact: false,
            pose: None,
            lens: c,
            frame: 1.0 / 30.0,
            features,
            shown: Vec::new(),
        });
        out.poses.push(pose);
        out.lenses.push(lens);
        out.taus.push(tau);
    }
    out
}

/// Solves views that are all compared by features.
fn matched(
    who: &[CameraFrame],
    sights: &[CameraView],
    options: &Options,
    progress: &mut Progress<'_>,
) -> Result<Solution> {
    let links = links(sights, Pairing::All, options.mapping.seed, progress);
    solve_sights(who, sights, &links, options, progress)
}

#[test]
fn a_rig_is_found_among_noise_and_outliers_with_focal_lengths_and_clocks() {
    let rig = rig(7, 900, 0.5, 0.3, 0.08);
    let mut silent = |_: &_| {};
    let who: Vec<_> = (0..7).map(|c| (c, None)).collect();
    let options = Options::default();
    let found = matched(&who, &rig.sights, &options, &mut Progress(&mut silent)).unwrap();
    let placed: Vec<_> = found.taken.iter().map(|t| t.placed.clone().unwrap()).collect();
    let poses: Vec<Se3> = placed.iter().map(|p| p.pose).collect();
    let off = apart(&poses, &rig.poses).unwrap();
    assert!(off.iter().all(|a| a.degrees < 0.5 && a.center < 0.01), "{off:?}");
    let clocks: Vec<f64> = placed.iter().zip(&rig.taus).map(|(p, t)| p.tau - t).collect();
    for (k, p) in placed.iter().enumerate() {
        let zoom = p.lens.focal / rig.lenses[k].focal - 1.0;
        assert!(zoom.abs() < 0.02, "{zoom} {k}");
        // A tenth of a frame.
        assert!((clocks[k] - clocks[0]).abs() < 0.0033, "{clocks:?}");
        assert!(p.error < 1.0 && p.sightings > 100);
    }
    assert!(found.points.len() > 400 && found.pairs > 10);
    assert!(found.points.iter().all(|p| p.moment <= 4 && p.seen.len() >= 2));
    let up = [0.0, -1.0, 0.0];
    let turned = splat4d::math::align::similarity(
        &poses.iter().map(|p| p.inverse().translation).collect::<Vec<_>>(),
        &rig.poses.iter().map(|p| p.inverse().translation).collect::<Vec<_>>(),
    );
    let there = splat4d::math::se3::mat_vec(&turned.unwrap().rotation, found.up);
    assert!(splat4d::math::se3::dot(there, up) > 0.9, "{there:?}");
}

/// Cameras whose images are blank, each of a grey of its own: no features.
struct Blank {
    learned: Option<Learned>,
}

/// A matcher that recognises cameras by their grey and has the positions of what they see.
struct Oracle {
    rig: Rig,
    /// Share of matches that are added and wrong.
    wrong: f64,
}

/// What lies between the greys of two cameras.
const GREYS: usize = 20;

impl Pictures for Blank {
    fn cameras(&self) -> usize {
        5
    }
    fn name(&self, camera: usize) -> String {
        format!("camera {camera}")
    }
    fn frames(&self, _: usize) -> usize {
        1
    }
    fn time(&self, _: usize, _: usize) -> f64 {
        0.0
    }
    fn load(&self, camera: usize, _: usize) -> Result<Planes<f32>> {
        let mut image = Planes::new(3, 360, 640);
        image.data.fill((camera * GREYS) as f32 / 255.0);
        Ok(image)
    }
    fn matcher(&self) -> Option<&Learned> {
        self.learned.as_ref()
    }
}

impl Matcher for Oracle {
    fn identity(&self) -> &str {
        "an oracle"
    }
    fn matches(&self, images: [&Rgb8; 2]) -> Result<Matches> {
        let [a, b] = images.map(|i| &self.rig.sights[usize::from(i.data[0]) / GREYS].features);
        // Of 800 points 240 are static, each of a colour of its own.
        let other = |color| b.iter().find(|g| g.moment == 0 && g.color == color);
        let still = a.iter().filter(|f| f.moment == 0);
        let mut out: Matches = still.filter_map(|f| Some([f.pixel, other(f.color)?.pixel])).collect();
        let count = out.len();
        for k in 0..(self.wrong * count as f64) as usize {
            out.push([out[k][0], out[count - 1 - k][1]]);
        }
        Ok(out)
    }
}

#[test]
fn a_matcher_relates_images_without_features() {
    let solved = |learned: Option<Learned>, stop: bool| {
        let mut silent = |_: &_| {};
        solve(&Blank { learned }, &Options::default(), &mut Progress(&mut silent), &|| stop)
    };
    let truth = || rig(5, 800, 0.3, 0.0, 0.0);
    let learned = |wrong: f64| Some(Learned::new(std::sync::Arc::new(Oracle { rig: truth(), wrong })));
    assert!(solved(None, false).unwrap_err().to_string().contains("--matcher"));
    assert_eq!(solved(learned(0.0), true).unwrap_err().kind(), ErrorKind::Interrupted);
    for wrong in [0.0, 0.3] {
        let found = solved(learned(wrong), false).unwrap();
        let placed: Vec<_> = found.taken.iter().map(|t| t.placed.clone().unwrap()).collect();
        let off = apart(&placed.iter().map(|p| p.pose).collect::<Vec<_>>(), &truth().poses).unwrap();
        assert!(off.iter().all(|a| a.degrees < 0.5 && a.center < 0.01), "{wrong}: {off:?}");
        assert!(found.points.len() > 150 && found.pairs >= 8, "{wrong}: {} {}", found.points.len(), found.pairs);
    }
}

/// Gives the lenses of a rig, and its poses if they are `placed`; those of `wrong` cameras are turned by 1.5 degrees.
fn tell(rig: &mut Rig, placed: bool, wrong: &[usize]) -> Vec<f64> {
    let turn = super::algebra::rotation([0.0, 1.5f64.to_radians(), 0.0]);
    let mut focals = Vec::new();
    for (k, sight) in rig.sights.iter_mut().enumerate() {
        let camera = rig.lenses[k].camera(rig.poses[k], 640, 360);
        let known = Known { intrinsics: camera.intrinsics, lens: camera.lens, pose: None };
        let straight = known.straight(sight.size, sight.factor);
        sight.features.retain_mut(|f| straight.feature(f));
        let mut pose = rig.poses[k];
        if wrong.contains(&k) {
            pose.rotation = splat4d::math::se3::mat_mul(&turn, &pose.rotation);
            pose.translation = splat4d::math::se3::mat_vec(&turn, pose.translation);
        }
        (sight.focal, sight.exact, sight.pose) = (Some(straight.focal()), true, placed.then_some(pose));
        focals.push(straight.focal());
    }
    focals
}

#[test]
fn cameras_that_are_given_stay_and_clocks_and_points_are_found() {
    let mut silent = |_: &_| {};
    let who: Vec<_> = (0..4).map(|c| (c, None)).collect();
    let mut solved = |wrong: &[usize]| {
        let mut rig = rig(4, 600, 0.3, 0.2, 0.08);
        tell(&mut rig, true, wrong);
        let found = matched(&who, &rig.sights, &Options::default(), &mut Progress(&mut silent)).unwrap();
        (rig, found)
    };
    let (rig, found) = solved(&[]);
    let placed: Vec<_> = found.taken.iter().map(|t| t.placed.clone().unwrap()).collect();
    let clocks: Vec<f64> = placed.iter().zip(&rig.taus).map(|(p, t)| p.tau - t).collect();
    for (k, p) in placed.iter().enumerate() {
        assert_eq!(p.pose, rig.poses[k], "poses stay, and so does the unit");
        assert!((clocks[k] - clocks[0]).abs() < 0.0033, "{clocks:?}");
        assert!(p.error < 1.0 && p.sightings > 80, "{p:?}");
        assert!(found.contradiction[k].is_some_and(|off| off < 1.0), "{:?}", found.contradiction);
    }
    assert!(found.points.len() > 250, "{}", found.points.len());
    // One that is turned contradicts, and not its neighbours.
    let (_, found) = solved(&[2]);
    let off: Vec<f64> = found.contradiction.iter().map(|c| c.unwrap()).collect();
    assert!((0..4).all(|k| if k == 2 { off[k] > 4.0 } else { off[k] < 1.0 }), "{off:?}");
}

#[test]
fn lenses_that_are_given_stay_while_poses_are_found() {
    let mut silent = |_: &_| {};
    let mut rig = rig(5, 500, 0.3, 0.1, 0.08);
    let focals = tell(&mut rig, false, &[]);
    let who: Vec<_> = (0..5).map(|c| (c, None)).collect();
    let found = matched(&who, &rig.sights, &Options::default(), &mut Progress(&mut silent)).unwrap();
    let placed: Vec<_> = found.taken.iter().map(|t| t.placed.clone().unwrap()).collect();
    for (p, focal) in placed.iter().zip(&focals) {
        assert_eq!((p.lens.focal, p.lens.k1, p.lens.center), (*focal, 0.0, [320.0, 180.0]));
    }
    let poses: Vec<Se3> = placed.iter().map(|p| p.pose).collect();
    let off = apart(&poses, &rig.poses).unwrap();
    assert!(off.iter().all(|a| a.degrees < 0.3 && a.center < 0.01), "{off:?}");
}

#[test]
fn equal_lenses_share_parameters_and_others_do_not() {
    for (spread, within) in [(0.0, 0.003), (0.02, 0.01)] {
        let rig = rig(7, 600, 0.3, 0.2, spread);
        let mut silent = |_: &_| {};
        let who: Vec<_> = (0..7).map(|c| (c, None)).collect();
        let found = matched(&who, &rig.sights, &Options::default(), &mut Progress(&mut silent)).unwrap();
        let zooms: Vec<f64> = (found.taken.iter().zip(&rig.lenses))
            .map(|(t, lens)| (t.placed.as_ref().unwrap().lens.focal / lens.focal).ln())
            .collect();
        // The common part is determined by the scene's depth alone.
        let mean = zooms.iter().sum::<f64>() / zooms.len() as f64;
        assert!(zooms.iter().all(|z| (z - mean).abs() < within), "differing by {spread}: {zooms:?}");
    }
}

#[test]
fn a_camera_of_another_scene_is_left_out_with_a_reason() {
    let mut rig = rig(4, 260, 0.3, 0.1, 0.08);
    let rng = Rng::new(5, "elsewhere", 0);
    for (k, f) in rig.sights[2].features.iter_mut().enumerate() {
        f.descriptor = std::array::from_fn(|i| (80.0 * rng.fork(k as u64).uniform(i as u64)) as u8);
    }
    let mut silent = |_: &_| {};
    let progress = &mut Progress(&mut silent);
    let links = links(&rig.sights, Pairing::All, 0, progress);
    let tracks = join(&rig.sights, &links);
    let focals = focal_votes(&rig.sights, &links, &FOCALS);
    let how = Mapping { starts: 1, ..Mapping::default() };
    let mapped = map(&rig.sights, &tracks, &links, &focals, &how, progress).unwrap();
    let placed: Vec<bool> = mapped.cameras.iter().map(Result::is_ok).collect();
    assert_eq!(placed, [true, true, false, true]);
    let again = map(&rig.sights, &tracks, &links, &focals, &how, progress).unwrap();
    let poses = |m: &super::mapper::Mapped| m.cameras.iter().flatten().map(|c| c.pose).collect::<Vec<_>>();
    assert_eq!(poses(&mapped), poses(&again), "the same bits");
}

#[test]
fn an_unsynchronised_camera_is_recognised_by_moving_features() {
    let mut rig = rig(5, 700, 0.3, 0.1, 0.0);
    let who: Vec<_> = (0..5).map(|c| (c, None)).collect();
    let strays = |rig: &Rig| {
        let mut silent = |_: &_| {};
        let progress = &mut Progress(&mut silent);
        matched(&who, &rig.sights, &Options::default(), progress).unwrap().stray
    };
    assert_eq!(strays(&rig), [false; 5]);
    // Positions of all people half a second before; walls stay.
    let rng = Rng::new(6, "before", 0);
    for (k, f) in rig.sights[2].features.iter_mut().enumerate().filter(|(_, f)| f.moment > 0) {
        f.pixel = std::array::from_fn(|a| f.pixel[a] + 40.0 * rng.normal((2 * k + a) as u64));
    }
    assert_eq!(strays(&rig), [false, false, true, false, false]);
}

/// A patch that moves over a wall, eight pixels a frame.
struct Walk {
    wall: Planes<f32>,
    patch: Planes<f32>,
    cameras: usize,
    known: Option<Known>,
}

const FRAMES: usize = 12;

impl Pictures for Walk {
    fn cameras(&self) -> usize {
        self.cameras
    }

    fn name(&self, camera: usize) -> String {
        format!("camera {camera}")
    }

    fn frames(&self, _: usize) -> usize {
        FRAMES
    }

    fn time(&self, _: usize, frame: usize) -> f64 {
        frame as f64 / 30.0
    }

    fn known(&self, _: usize) -> Option<Known> {
        self.known
    }

    fn load(&self, _: usize, frame: usize) -> Result<Planes<f32>> {
        let mut out = self.wall.clone();
        for c in 0..3 {
            for y in 0..self.patch.height {
                for x in 0..self.patch.width {
                    let at = (c * out.height + y + 30) * out.width + x + 20 + 8 * frame;
                    out.data[at] = self.patch.get(0, y, x);
                }
            }
        }
        Ok(out)
    }
}

fn noise(seed: u64, height: usize, width: usize) -> Planes<f32> {
    let rng = Rng::new(seed, "noise", 0);
    let mut out = Planes::<f32>::new(1, height, width);
    out.data.iter_mut().enumerate().for_each(|(k, v)| *v = rng.uniform(k as u64) as f32);
    let mut out = blurred(&out, 2.0);
    out.data.iter_mut().for_each(|v| *v = (0.5 + 4.0 * (*v - 0.5)).clamp(0.0, 1.0));
    out
}

fn walk(cameras: usize) -> Walk {
    let wall = noise(1, 120, 240);
    let mut colored = Planes::new(3, 120, 240);
    (0..3).for_each(|c| colored.plane_mut(c).copy_from_slice(&wall.data));
    Walk { wall: colored, patch: noise(2, 60, 60), cameras, known: None }
}

#[test]
fn moving_features_have_times_and_velocities() {
    let mut silent = |_: &_| {};
    let look = FeatureOptions { moments: 3, ..FeatureOptions::default() };
    let sights = fixed(&walk(1), &look, &mut Progress(&mut silent)).unwrap();
    let features = &sights[0].features;
    assert!(features.is_sorted_by_key(|f| f.moment));
    let still = features.iter().filter(|f| f.moment == 0).count();
    let moving: Vec<&Feature> = features.iter().filter(|f| f.moment > 0).collect();
    assert!(still > 40 && moving.len() > 20, "{still} {}", moving.len());
    let near = |f: &Feature, speed: f64| (f.velocity[0] - speed).hypot(f.velocity[1]) < 8.0;
    let share = |speed: f64| moving.iter().filter(|f| near(f, speed)).count() as f64 / moving.len() as f64;
    // The rest is on the patch's border, where windows hold some of the wall.
    assert!(share(240.0) > 0.65, "{}", share(240.0));
    assert_eq!(sights[0].shown.iter().filter(|w| w.is_some()).count(), 4);
}

#[test]
fn images_of_straightened_features_are_not_laid_over_each_other() {
    let mut silent = |_: &_| {};
    let camera = Lens { k1: -0.2, ..Lens::plain(200.0, 240, 120) }.camera(Se3::IDENTITY, 240, 120);
    let known = Known { intrinsics: camera.intrinsics, lens: camera.lens, pose: None };
    let bent = Walk { known: Some(known), ..walk(1) };
    let sights =
        fixed(&bent, &FeatureOptions { moments: 3, ..FeatureOptions::default() }, &mut Progress(&mut silent)).unwrap();
    assert!(sights[0].exact && sights[0].shown.is_empty() && !sights[0].features.is_empty());
}

#[test]
fn cameras_that_share_nothing_are_refused() {
    let mut silent = |_: &_| {};
    let error = solve(&walk(1), &Options::default(), &mut Progress(&mut silent), &|| false).unwrap_err();
    assert!(error.to_string().contains("show the same"), "{error}");
}
