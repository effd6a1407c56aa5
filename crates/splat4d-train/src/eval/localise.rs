//! Localisation: from where and when a picture was taken, told by a scene that stays as it is. The nearest of some starts are
//! found in small pictures; each is then aligned by the gradients of the picture to its pose, in larger and larger
//! pictures, in turn with a search of the time. What does not fit the scene much better than one plain colour would is
//! refused ([`Located::is_sure`]).

use super::align::{Follower, Seen};
use crate::Result;
use crate::capture::frames::halve;
use crate::learner::{Corrections, Origin, RefineSettings, Scale};
use crate::step::clocks::{difference, least};
use splat4d::device;
use splat4d::layers::{Evaluation, Scene};
use splat4d::render::{Antialias, Backend, Image, RenderConfig, Shot};
use splat4d::scene::{Camera, Planes, Time};

/// Longer sides of pictures, small to large, and starts that are still followed in each.
const LEVELS: [(usize, usize); 3] = [(48, 4), (96, 2), (192, 1)];
/// Moments of the clip at which a start is tried.
const MOMENTS: usize = 12;
/// Starts that are tried, evenly chosen.
const MOST_STARTS: usize = 128;
/// Rounds a level of time and pose in turn, and steps of the pose in each.
const ROUNDS: (usize, usize) = (2, 40);
/// Rates of rotations (radians) and positions (extents) at the beginning and end of a round, in the smallest pictures; at
/// the next level all are half as large.
const RATES: [f64; 2] = [1e-2, 1e-3];
/// Shifts of the time to each side in a search.
const SIDES: i32 = 4;
/// A picture is found where it differs from the scene by at most this share of its difference from one plain colour.
pub const SURE: f64 = 0.5;

/// Where a picture was taken, as far as the scene tells.
#[derive(Clone, Debug, PartialEq)]
pub struct Located {
    /// From where, with the picture's size.
    pub camera: Camera,
    /// When; the middle of the clip where nothing moves.
    pub time: Time,
    /// Mean absolute difference of the picture from the scene, colours from 0 to 1, in the largest pictures looked at.
    pub residual: f64,
    /// The same from the plain colour that is its median: what a scene that has nothing to do with it may reach.
    pub chance: f64,
    /// The start that led here.
    pub start: usize,
}

impl Located {
    /// The residual, a share of what chance may reach.
    pub fn share(&self) -> f64 {
        if self.chance > 0.0 { self.residual / self.chance } else { f64::INFINITY }
    }

    /// Whether the scene explains the picture.
    pub fn is_sure(&self) -> bool {
        self.share() <= SURE
    }
}

/// One candidate on its way.
#[derive(Clone)]
struct Candidate {
    camera: Camera,
    time: f64,
    cost: f64,
    start: usize,
}

/// What all steps share.
struct Search<'a> {
    scene: &'a Scene<f32>,
    backend: Box<dyn Backend>,
    instant: Evaluation<f32>,
    image: Image<f32>,
    /// Radius of the starts, scene units.
    extent: f64,
}

/// Finds a picture ([3, h, w]) in a scene, from the nearest of some cameras of the picture's size. `told`: rounds done, and all.
///
/// Errors: those of drawing. Panics: no starts; a start of another size than the picture's.
pub fn localise(
    scene: &Scene<f32>,
    picture: &Planes<f32>,
    starts: &[Camera],
    antialias: Antialias,
    told: &mut dyn FnMut(usize, usize),
) -> Result<Located> {
    assert!(!starts.is_empty(), "a picture is looked for from somewhere");
    let fits = |c: &Camera| (c.width, c.height) == (picture.width, picture.height);
    assert!(starts.iter().all(fits), "starts have the picture's size");
    let backend = device::cpu(RenderConfig { antialias, ..RenderConfig::default() });
    let extent = extent(starts);
    let mut search = Search { scene, backend, instant: Evaluation::default(), image: Image::default(), extent };
    let clip = scene.clip[1] - scene.clip[0];
    let mut span = clip / MOMENTS as f64;
    let moments: Vec<f64> = match clip > 0.0 {
        true => (0..MOMENTS).map(|k| scene.clip[0] + (k as f64 + 0.5) * span).collect(),
        false => vec![scene.clip[0]],
    };
    let rounds = LEVELS.len() * ROUNDS.0;
    let mut candidates = search.tried(picture, starts, &moments)?;
    for (level, &(side, kept)) in LEVELS.iter().enumerate() {
        let (small, times) = shrunk(picture, side);
        for candidate in &mut candidates {
            candidate.cost = search.cost(&candidate.camera.downscaled(times), candidate.time, &small)?;
        }
        candidates.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        candidates.truncate(kept);
        for round in 0..ROUNDS.0 {
            for candidate in &mut candidates {
                if clip > 0.0 {
                    search.time(candidate, &small, times, span)?;
                }
                search.pose(candidate, &small, times, 0.5f64.powi(level as i32))?;
                if clip > 0.0 {
                    search.time(candidate, &small, times, 0.5 * span)?;
                }
                candidate.cost = search.cost(&candidate.camera.downscaled(times), candidate.time, &small)?;
            }
            span *= 0.5;
            told(level * ROUNDS.0 + round + 1, rounds);
        }
    }
    candidates.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let best = candidates.swap_remove(0);
    let (large, _) = shrunk(picture, LEVELS[LEVELS.len() - 1].0);
    Ok(Located {
        camera: best.camera,
        time: Time(best.time),
        residual: best.cost,
        chance: plainness(&large),
        start: best.start,
    })
}

impl Search<'_> {
    /// The best moments of the starts, in the smallest pictures; the best starts first.
    fn tried(&mut self, picture: &Planes<f32>, starts: &[Camera], moments: &[f64]) -> Result<Vec<Candidate>> {
        let (small, times) = shrunk(picture, LEVELS[0].0);
        let step = starts.len().div_ceil(MOST_STARTS);
        let mut out = Vec::new();
        for (start, camera) in starts.iter().enumerate().step_by(step) {
            let mut best = Candidate { camera: camera.clone(), time: moments[0], cost: f64::INFINITY, start };
            for &time in moments {
                let cost = self.cost(&camera.downscaled(times), time, &small)?;
                if cost < best.cost {
                    (best.time, best.cost) = (time, cost);
                }
            }
            out.push(best);
        }
        out.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        out.truncate(LEVELS[0].1);
        Ok(out)
    }

    /// How far the picture is from the scene, seen from here.
    fn cost(&mut self, camera: &Camera, time: f64, picture: &Planes<f32>) -> Result<f64> {
        self.scene.at(Time(time), &mut self.instant);
        let splats = self.scene.splats(&self.instant);
        self.backend.render(&Shot::new(&splats, camera, self.scene.background), &mut self.image)?;
        Ok(difference(&self.image.color, picture, None))
    }

    /// Searches the time about where it is.
    fn time(&mut self, candidate: &mut Candidate, picture: &Planes<f32>, times: usize, span: f64) -> Result<()> {
        let camera = candidate.camera.downscaled(times);
        let shifts: Vec<f64> = (-SIDES..=SIDES).map(|k| span * f64::from(k) / f64::from(SIDES)).collect();
        let mut costs = Vec::with_capacity(shifts.len());
        let inside = |t: f64| t.clamp(self.scene.clip[0], self.scene.clip[1]);
        let at: Vec<f64> = shifts.iter().map(|s| inside(candidate.time + s)).collect();
        for &t in &at {
            costs.push(self.cost(&camera, t, picture)?);
        }
        candidate.time = (candidate.time + least(&shifts, &costs)).clamp(self.scene.clip[0], self.scene.clip[1]);
        Ok(())
    }

    /// Follows gradients to a better pose, with rates of this share.
    fn pose(&mut self, candidate: &mut Candidate, picture: &Planes<f32>, times: usize, share: f64) -> Result<()> {
        let [first, last] = RATES.map(|r| share * r);
        let settings = RefineSettings {
            poses: true,
            rotation_init: first,
            rotation_final: last,
            position_init: first,
            position_final: last,
            poses_from: 0.0,
            until: 1.0,
            ..RefineSettings::default()
        };
        let camera = candidate.camera.downscaled(times);
        let scale = Scale { extent: self.extent, frame: 1.0 / self.scene.fps };
        let origin = Origin { rig: 0, fixed: true, camera: &camera };
        let mut found = Corrections::new(&settings, scale, &[origin], 1, false);
        let mut follower = Follower::new(self.scene);
        let time = Time(candidate.time);
        let seen = Seen { place: 0, rig: 0, camera: &camera, time, truth: picture, weight: None };
        let before = self.cost(&camera, candidate.time, picture)?;
        for step in 0..ROUNDS.1 {
            follower.step(self.scene, &seen, self.backend.as_mut(), &mut found, [step, ROUNDS.1])?;
        }
        let moved = found.camera(0, &camera);
        // Never to a worse place.
        if self.cost(&moved, candidate.time, picture)? < before {
            candidate.camera.cam_from_world = moved.cam_from_world;
        }
        Ok(())
    }
}

/// The picture halved until its longer side is at most so long, and how many times smaller it is.
fn shrunk(picture: &Planes<f32>, side: usize) -> (Planes<f32>, usize) {
    let (mut out, mut times) = (picture.clone(), 1);
    while out.width.max(out.height) > side && out.width.min(out.height) > 1 {
        halve(&mut out);
        times *= 2;
    }
    (out, times)
}

/// Mean absolute difference of a picture from its median colour.
fn plainness(picture: &Planes<f32>) -> f64 {
    let mut plain = picture.clone();
    for c in 0..picture.channels {
        let mut sorted = picture.plane(c).to_vec();
        sorted.sort_by(f32::total_cmp);
        plain.plane_mut(c).fill(sorted.get(sorted.len() / 2).copied().unwrap_or_default());
    }
    difference(&plain, picture, None)
}

/// The radius of cameras about their mean; of one alone, its distance from the world's origin, so that steps have a size.
fn extent(cameras: &[Camera]) -> f64 {
    let centers: Vec<[f64; 3]> = cameras.iter().map(Camera::center).collect();
    let n = centers.len() as f64;
    let mean: [f64; 3] = std::array::from_fn(|k| centers.iter().map(|c| c[k]).sum::<f64>() / n);
    let length = |x: [f64; 3]| x.iter().map(|v| v * v).sum::<f64>().sqrt();
    let radius = centers.iter().map(|c| length(std::array::from_fn(|k| c[k] - mean[k]))).fold(0.0, f64::max);
    match radius > 0.0 {
        true => radius,
        false => length(mean).max(f64::MIN_POSITIVE),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::layers::Layer;
    use splat4d::math::{Rng, Se3};
    use splat4d::motion::{SpacetimeSpec, Spec, build};
    use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
    use splat4d::scene::{GEOMETRY, LifeKind, Params, SH};

    const SIZE: usize = 64;

    /// Coloured Gaussians, of which a third move.
    fn scene() -> Scene<f32> {
        let rng = Rng::new(3, "localise", 0);
        let mut p = Params::<f32>::new(60, 1, LifeKind::Infinite.columns());
        for r in 0..60 {
            let rng = rng.fork(r as u64);
            p[GEOMETRY].write(r, 0, [0u64, 1, 2].map(|k| (1.6 * rng.uniform(k) - 0.8) as f32));
            p[GEOMETRY].write(r, QUAT, [1.0, 0.0, 0.0, 0.0]);
            p[GEOMETRY].write(r, LOG_SCALE, [-1.9; 3]);
            p[GEOMETRY].set(r, OPACITY, 2.0);
            p[SH].write(r, 0, [3u64, 4, 5].map(|k| (3.0 * rng.uniform(k) - 1.5) as f32));
        }
        let spec = SpacetimeSpec { order: 1, rotation: false, detach: false, origin: 0.5, features: None };
        let motion = build(&Spec::Spacetime(spec), &mut p).unwrap();
        let velocities = p.keys().find(|&k| p[k].column("velocities").is_some()).unwrap();
        let (first, _) = p[velocities].column("velocities").unwrap();
        for r in (0..60).step_by(3) {
            p[velocities].write(r, first, [1.2, 0.5, -0.8]);
        }
        let layer = Layer::new("scene", p, motion, LifeKind::Infinite);
        Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, ..Scene::default() }
    }

    fn camera(angle: f64, height: f64) -> Camera {
        let eye = [4.0 * angle.cos(), height, 4.0 * angle.sin()];
        Camera::with_fov_y(Se3::look_at(eye, [0.0; 3], [0.0, 1.0, 0.0]), 0.7, SIZE, SIZE)
    }

    fn drawn(scene: &Scene<f32>, camera: &Camera, t: f64) -> Planes<f32> {
        let (mut instant, mut image) = (Evaluation::default(), Image::default());
        scene.at(Time(t), &mut instant);
        let splats = scene.splats(&instant);
        device::cpu(RenderConfig::default()).render(&Shot::new(&splats, camera, [0.0; 3]), &mut image).unwrap();
        image.color
    }

    #[test]
    fn a_picture_is_found_in_space_and_time_and_a_strange_one_is_not() {
        let scene = scene();
        let starts: Vec<Camera> = (0..6).map(|k| camera(f64::from(k), 0.3)).collect();
        let (truth, when) = (camera(2.12, 0.55), 0.37);
        let mut found =
            localise(&scene, &drawn(&scene, &truth, when), &starts, Antialias::Off, &mut |_, _| {}).unwrap();
        let off = |c: &Camera| {
            let apart: [f64; 3] = std::array::from_fn(|k| c.center()[k] - truth.center()[k]);
            apart.iter().map(|x| x * x).sum::<f64>().sqrt()
        };
        println!("{} {:?} {} {}", off(&found.camera), found.time, found.residual, found.chance);
        assert!(off(&starts[2]) > 0.3 && off(&found.camera) < 0.03, "{}", off(&found.camera));
        assert!((found.time.0 - when).abs() < 0.02 && found.is_sure() && found.start == 2, "{found:?}");
        // Its own mirror image is none of the scene's views.
        let mut strange = drawn(&scene, &truth, when);
        for row in strange.data.chunks_mut(SIZE) {
            row.reverse();
        }
        let lost = localise(&scene, &strange, &starts, Antialias::Off, &mut |_, _| {}).unwrap();
        println!("{} {}", lost.residual, lost.chance);
        assert!(!lost.is_sure(), "{lost:?}");
        (found.residual, found.chance) = (0.0, 0.0);
        assert!(!found.is_sure(), "a picture of one colour tells nothing");
    }
}
