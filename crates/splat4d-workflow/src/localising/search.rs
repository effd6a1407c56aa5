//! Localisation: pose and time of an image in a fixed scene.
//!
//! The best of some starts, at some times, are found in small images. Each is then moved to where the scene differs
//! least from the image, by Gauss and Newton's method with damping (Levenberg and Marquardt) and a robust loss, in
//! larger and larger images: there are six unknowns of the pose, one of the time where the scene moves, and one of the
//! focal length where it is requested, so that derivatives are differences of renders. A gain and an offset of each
//! colour are free, since another camera has another exposure. What does not fit the scene much better than one plain
//! colour would is refused ([`Located::sure`]).

use splat4d::Result;
use splat4d::device;
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::cholesky::Cholesky;
use splat4d::render::{Antialias, Backend, Image, RenderConfig, Shot};
use splat4d::scene::{Camera, Planes, Time};
use splat4d_train::train_state::moved;

/// Longer sides of images, small to large, and starts that are still followed in each.
const LEVELS: [(usize, usize); 4] = [(48, 6), (96, 3), (192, 1), (384, 1)];
/// Times of the clip at which a start is tried.
const MOMENTS: usize = 12;
/// Starts that are tried, evenly chosen.
const MOST_STARTS: usize = 128;
/// Steps of Newton's method in images of a size, at most.
const STEPS: usize = 15;
/// Pixels by which what is seen moves when a derivative is taken, and the movement below which no step is made.
const DIFFERENCE: f64 = 0.5;
const SMALL: f64 = 0.01;
/// Damping at first, its factor from step to step, and how often a step is tried again with more of it.
const DAMPING: f64 = 1e-3;
const DAMPED: f64 = 10.0;
const TRIES: usize = 4;
/// Differences of colours (0 to 1) above this count as differences, below as their squares (Charbonnier).
const SOFT: f64 = 0.05;
/// Gains of a colour: two stops to each side.
const GAIN: [f64; 2] = [0.25, 4.0];
/// Alpha from which on a pixel shows something that has a depth.
const SOLID: f32 = 0.5;
/// Numbers that are searched for: pose 6, time, logarithm of the focal length.
const UNKNOWN: usize = 8;
const TIME: usize = 6;
const FOCAL: usize = 7;
/// An image is found where it differs from the scene by at most this share of its difference from one plain colour.
/// Of a
/// scene with 31 dB, held-out images reached 0.10, images of other scenes and mirror images 0.78 and more
/// (docs/refine.md).
pub(super) const SURE: f64 = 1.0 / 3.0;

/// The query.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Query {
    /// Settings of the renderer.
    pub antialias: Antialias,
    /// Whether the focal length is searched for too.
    pub lens: bool,
}

/// Estimated pose and time of an image.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Located {
    /// From where, with the image's size.
    pub camera: Camera,
    /// When; the beginning of the clip where nothing moves.
    pub time: Time,
    /// Mean absolute difference of the image from the scene, colours from 0 to 1, in the largest images examined.
    pub residual: f64,
    /// The same from the plain colour that is its mean: what a scene that has nothing to do with it may reach.
    pub chance: f64,
    /// The residual, a share of what chance may reach.
    pub share: f64,
    /// Whether the scene explains the image.
    pub sure: bool,
    /// The start that led here.
    pub start: usize,
}

/// A residual as a share of what chance may reach; an image of one colour is no evidence.
fn share(residual: f64, chance: f64) -> f64 {
    if chance > 0.0 { residual / chance } else { f64::INFINITY }
}

/// One candidate on its way.
#[derive(Clone)]
struct Candidate {
    camera: Camera,
    time: f64,
    cost: f64,
    start: usize,
}

/// Data of all steps.
struct Search<'a> {
    scene: &'a Scene<f32>,
    backend: Box<dyn Backend>,
    instant: Evaluation<f32>,
    image: Image<f32>,
    lens: bool,
}

/// Finds an image ([3, h, w]) in a scene, from the nearest of some cameras of the image's size. `progress`: candidates
/// that were
/// followed, and all.
///
/// Errors: those of rendering. Panics: no starts; a start of another size than the image's.
pub(super) fn localise(
    scene: &Scene<f32>,
    picture: &Planes<f32>,
    starts: &[Camera],
    query: Query,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Located> {
    assert!(!starts.is_empty(), "localisation has a start camera");
    let fits = |c: &Camera| (c.width, c.height) == (picture.width, picture.height);
    assert!(starts.iter().all(fits), "starts have the image's size");
    let backend = device::cpu(RenderConfig { antialias: query.antialias, ..RenderConfig::default() });
    let (instant, image) = (Evaluation::default(), Image::default());
    let mut search = Search { scene, backend, instant, image, lens: query.lens };
    let mut candidates = search.tried(picture, starts)?;
    let (all, mut done) = (LEVELS.iter().map(|l| l.1).sum(), 0);
    let mut chance = 0.0;
    for &(side, kept) in &LEVELS {
        let (small, times) = shrunk(picture, side);
        candidates.truncate(kept);
        for candidate in &mut candidates {
            search.follow(candidate, &small, times)?;
            done += 1;
            progress(done, all);
        }
        candidates.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        chance = plainness(&small);
    }
    let best = candidates.swap_remove(0);
    let (small, times) = shrunk(picture, LEVELS[LEVELS.len() - 1].0);
    let residual = search.compared(&best, &small, times)?.difference;
    let share = share(residual, chance);
    let (camera, time, start) = (best.camera, Time(best.time), best.start);
    Ok(Located { camera, time, residual, chance, share, sure: share <= SURE, start })
}

impl Search<'_> {
    /// The starts at their best times, in the smallest images; the best starts first.
    fn tried(&mut self, picture: &Planes<f32>, starts: &[Camera]) -> Result<Vec<Candidate>> {
        let [first, last] = self.scene.clip;
        let moment = |k: usize| first + (k as f64 + 0.5) * (last - first) / MOMENTS as f64;
        let moments: Vec<f64> = if last > first { (0..MOMENTS).map(moment).collect() } else { vec![first] };
        let (small, times) = shrunk(picture, LEVELS[0].0);
        let step = starts.len().div_ceil(MOST_STARTS);
        let mut out = Vec::new();
        for (start, camera) in starts.iter().enumerate().step_by(step) {
            let mut best = Candidate { camera: camera.clone(), time: first, cost: f64::INFINITY, start };
            for &time in &moments {
                let mut tried = Candidate { time, ..best.clone() };
                tried.cost = self.compared(&tried, &small, times)?.cost;
                if tried.cost < best.cost {
                    best = tried;
                }
            }
            out.push(best);
        }
        out.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        Ok(out)
    }

    /// Renders a candidate's view, in an image reduced by this factor.
    fn draw(&mut self, candidate: &Candidate, times: usize, depth: bool) -> Result<&Image<f32>> {
        self.scene.at(Time(candidate.time), &mut self.instant);
        let splats = self.scene.splats(&self.instant);
        let camera = candidate.camera.downscaled(times);
        let shot = Shot { depth, ..Shot::new(&splats, &camera, self.scene.background) };
        self.backend.render(&shot, &mut self.image)?;
        Ok(&self.image)
    }

    fn compared(&mut self, candidate: &Candidate, picture: &Planes<f32>, times: usize) -> Result<Compared> {
        Ok(Compared::of(&self.draw(candidate, times, false)?.color, picture))
    }

    /// Moves a candidate to the pose that fits the image.
    fn follow(&mut self, candidate: &mut Candidate, picture: &Planes<f32>, times: usize) -> Result<()> {
        let sizes = self.sizes(candidate, times)?;
        let asked: Vec<usize> = (0..UNKNOWN).filter(|&k| sizes[k] > 0.0).collect();
        let n = asked.len();
        let mut at = self.compared(candidate, picture, times)?;
        candidate.cost = at.cost;
        let mut damping = DAMPING;
        for _ in 0..STEPS {
            let slopes = self.slopes(candidate, times, &asked, &sizes)?;
            let (matrix, right) = at.normal_equations(&slopes);
            let mut better = None;
            for _ in 0..TRIES {
                let mut damped = matrix.clone();
                // Where a number changes nothing, it stays.
                (0..n).for_each(|i| damped[i * n + i] += damping * matrix[i * n + i] + f64::MIN_POSITIVE);
                let Some(factor) = Cholesky::new(n, damped) else { break };
                let solved = factor.solve(right.clone());
                let mut step = [0.0; UNKNOWN];
                asked.iter().zip(&solved).for_each(|(&k, s)| step[k] = s * sizes[k]);
                let mut moved = self.stepped(candidate, &step);
                let there = self.compared(&moved, picture, times)?;
                if there.cost < candidate.cost {
                    moved.cost = there.cost;
                    let far = solved.iter().fold(0.0f64, |m, s| m.max(s.abs())) * DIFFERENCE;
                    better = Some((moved, there, far));
                    damping = (damping / DAMPED).max(f64::EPSILON);
                    break;
                }
                damping *= DAMPED;
            }
            let Some((moved, there, far)) = better else { break };
            (*candidate, at) = (moved, there);
            if far < SMALL {
                break;
            }
        }
        Ok(())
    }

    /// Change of each parameter that moves the image by [`DIFFERENCE`] pixels; 0: the parameter is fixed.
    fn sizes(&mut self, candidate: &Candidate, times: usize) -> Result<[f64; UNKNOWN]> {
        let drawn = self.draw(candidate, times, true)?;
        let solid = |(alpha, depth): (&f32, &f32)| (*alpha > SOLID).then(|| depth / alpha);
        let mut depths: Vec<f32> = drawn.alpha.plane(0).iter().zip(drawn.depth.plane(0)).filter_map(solid).collect();
        let camera = candidate.camera.downscaled(times);
        let angle = DIFFERENCE / camera.intrinsics.fx;
        let middle = depths.len() / 2;
        // A view of nothing searches for a scene as far away as the world's origin.
        let far = if depths.is_empty() {
            camera.center().iter().map(|x| x * x).sum::<f64>().sqrt().max(f64::MIN_POSITIVE)
        } else {
            f64::from(*depths.select_nth_unstable_by(middle, f32::total_cmp).1)
        };
        let half = 0.5 * camera.width.max(camera.height) as f64;
        let frame = if self.scene.clip[1] > self.scene.clip[0] { DIFFERENCE / self.scene.fps } else { 0.0 };
        let focal = if self.lens { DIFFERENCE / half } else { 0.0 };
        Ok([angle * far, angle * far, angle * far, angle, angle, angle, frame, focal])
    }

    /// The candidate after a step.
    fn stepped(&self, candidate: &Candidate, step: &[f64; UNKNOWN]) -> Candidate {
        let mut out = candidate.clone();
        out.camera.cam_from_world = moved(&out.camera.cam_from_world, std::array::from_fn(|k| step[k]));
        out.camera.intrinsics.fx *= step[FOCAL].exp();
        out.camera.intrinsics.fy *= step[FOCAL].exp();
        out.time = (out.time + step[TIME]).clamp(self.scene.clip[0], self.scene.clip[1]);
        out
    }

    /// Central differences of what is seen, for a step of the size of each number.
    fn slopes(
        &mut self,
        candidate: &Candidate,
        times: usize,
        asked: &[usize],
        sizes: &[f64; UNKNOWN],
    ) -> Result<Vec<Vec<f32>>> {
        let mut out = Vec::with_capacity(asked.len());
        for &k in asked {
            let step = |sign: f64| std::array::from_fn(|i| if i == k { sign * sizes[k] } else { 0.0 });
            let [ahead, behind] = [1.0, -1.0].map(|sign| self.stepped(candidate, &step(sign)));
            // At an end of the clip there is one side only.
            let span = if k == TIME { (ahead.time - behind.time) / sizes[k] } else { 2.0 };
            let mut slope = self.draw(&ahead, times, false)?.color.data.clone();
            let other = &self.draw(&behind, times, false)?.color.data;
            slope.iter_mut().zip(other).for_each(|(a, b)| *a = (*a - b) / span as f32);
            out.push(slope);
        }
        Ok(out)
    }
}

/// A render next to the image.
struct Compared {
    /// Render with its colours corrected, less the image.
    residuals: Vec<f32>,
    gains: Vec<f32>,
    cost: f64,
    /// Mean absolute residual.
    difference: f64,
}

impl Compared {
    fn of(drawn: &Planes<f32>, picture: &Planes<f32>) -> Self {
        let (mut residuals, mut gains) = (Vec::with_capacity(picture.data.len()), Vec::new());
        for c in 0..picture.channels {
            let (x, y) = (drawn.plane(c), picture.plane(c));
            let (gain, offset) = response(x, y);
            gains.push(gain);
            residuals.extend(x.iter().zip(y).map(|(x, y)| gain * x + offset - y));
        }
        let n = residuals.len() as f64;
        let cost = residuals.iter().map(|&r| soft(f64::from(r)) - SOFT).sum::<f64>() / n;
        let difference = residuals.iter().map(|&r| f64::from(r.abs())).sum::<f64>() / n;
        Self { residuals, gains, cost, difference }
    }

    /// Of the weighted linear least squares in the unknowns: matrix [n, n] and right side. `slopes`: of the render,
    /// without gains.
    fn normal_equations(&self, slopes: &[Vec<f32>]) -> (Vec<f64>, Vec<f64>) {
        let n = slopes.len();
        let (mut matrix, mut right) = (vec![0.0; n * n], vec![0.0; n]);
        let pixels = self.residuals.len() / self.gains.len();
        let mut row = vec![0.0; n];
        for (p, &r) in self.residuals.iter().enumerate() {
            let (gain, r) = (f64::from(self.gains[p / pixels]), f64::from(r));
            let weight = 1.0 / soft(r);
            row.iter_mut().zip(slopes).for_each(|(v, slope)| *v = gain * f64::from(slope[p]));
            for i in 0..n {
                right[i] -= weight * row[i] * r;
                for j in 0..=i {
                    matrix[i * n + j] += weight * row[i] * row[j];
                }
            }
        }
        (matrix, right)
    }
}

/// √(r² + δ²)
fn soft(r: f64) -> f64 {
    (r * r + SOFT * SOFT).sqrt()
}

/// Gain and offset that bring one colour of a render nearest to the image's.
fn response(x: &[f32], y: &[f32]) -> (f32, f32) {
    let n = x.len() as f64;
    let mean = |v: &[f32]| v.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
    let (mx, my) = (mean(x), mean(y));
    let (mut xx, mut xy) = (0.0, 0.0);
    for (x, y) in x.iter().zip(y) {
        let x = f64::from(*x) - mx;
        xx += x * x;
        xy += x * (f64::from(*y) - my);
    }
    let gain = if xx > 0.0 { (xy / xx).clamp(GAIN[0], GAIN[1]) } else { 1.0 };
    (gain as f32, (my - gain * mx) as f32)
}

/// The image halved until its longer side is at most so long, and how many times smaller it is.
fn shrunk(picture: &Planes<f32>, side: usize) -> (Planes<f32>, usize) {
    let (mut out, mut times) = (picture.clone(), 1);
    while out.width.max(out.height) > side && out.width.min(out.height) > 1 {
        out.halve();
        times *= 2;
    }
    (out, times)
}

/// Mean absolute difference of an image from its mean colour.
fn plainness(picture: &Planes<f32>) -> f64 {
    let plain = Planes::new(picture.channels, picture.height, picture.width);
    Compared::of(&plain, picture).difference
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
    fn an_image_is_localised_and_a_foreign_one_refused() {
        let scene = scene();
        let starts: Vec<Camera> = (0..6).map(|k| camera(f64::from(k), 0.3)).collect();
        let (truth, when) = (camera(2.12, 0.55), 0.37);
        let found = localise(&scene, &drawn(&scene, &truth, when), &starts, Query::default(), &mut |_, _| {}).unwrap();
        let off = |c: &Camera| {
            let apart: [f64; 3] = std::array::from_fn(|k| c.center()[k] - truth.center()[k]);
            apart.iter().map(|x| x * x).sum::<f64>().sqrt()
        };
        assert!(off(&starts[2]) > 0.3 && off(&found.camera) < 0.03, "{}", off(&found.camera));
        assert!((found.time.0 - when).abs() < 0.02 && found.sure && found.start == 2, "{found:?}");
        // Its own mirror image is none of the scene's views.
        let mut strange = drawn(&scene, &truth, when);
        for row in strange.data.chunks_mut(SIZE) {
            row.reverse();
        }
        let lost = localise(&scene, &strange, &starts, Query::default(), &mut |_, _| {}).unwrap();
        assert!(!lost.sure, "{lost:?}");
        assert!(share(0.0, 0.0) > SURE, "a picture of one colour tells nothing");
    }
}
