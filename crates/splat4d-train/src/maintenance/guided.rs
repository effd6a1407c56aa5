//! Guided sampling: where images are worst and Gaussians are too few, new ones are placed along the rays of the worst
//! patches. It finds what no initial point represented, far backgrounds above all.
//!
//! Source: Li et al. 2024 (STG) §4.2 and its released settings: of the examined views the two worst; patches of 16
//! pixels of which 85 % are among the worst 40 % of the pixels, a border of 10 % left out; every second pixel; depths
//! between 0.7 and 7.5 times the largest seen, with 5 % of jitter; opacity 0.1.

use super::{At, Change, Context, Maintenance, RunOrder, logit};
use crate::Result;
use crate::capture::frames::{Frames, Picture};
use crate::settings::settings;
use crate::train_state::TrainState;
use splat4d::device;
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::Rng;
use splat4d::math::sh::rgb_to_dc;
use splat4d::motion::spacetime::{FEATURE_TABLE, ROTATION_RATES, VELOCITIES};
use splat4d::render::{Antialias, Image, RenderConfig, Shot};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{Born, Camera, GEOMETRY, LIFE, Planes, RowEdit, SH, Space, Time};

/// Views that are examined each time.
const VIEWS: usize = 24;
/// Views in which Gaussians are added.
const WORST_VIEWS: usize = 2;
/// Side of a patch, pixels.
const PATCH: usize = 16;
/// Share of an image's pixels that count as wrong: those with the largest errors.
const WRONG: f64 = 0.4;
/// Share of a patch's pixels that must be wrong.
const WRONG_IN_PATCH: f64 = 0.85;
/// Share of width and height that is left out at every side.
const BORDER: f64 = 0.1;
/// Pixels between two rays.
const STRIDE: usize = 2;
/// Nearest and farthest depth, of the largest that was seen.
const DEPTHS: [f64; 2] = [0.7, 7.5];
/// Depths at which rays are cut, evenly in their logarithm; neighbouring rays take turns.
const SHELLS: usize = 3;
/// Jitter of a depth.
const JITTER: f64 = 0.05;
/// A depth is seen where at least so much of a pixel is covered.
const COVERED: f32 = 0.5;
/// Opacity at the start.
const OPACITY_START: f64 = 0.1;
/// Share of the run at which the last of them are added: they must have time to learn.
const LAST: f64 = 0.75;

settings! {
    /// Settings of guided sampling: new Gaussians along the rays of the worst patches.
    #[derive(Copy)]
    pub struct GuidedSettings
    when (All(&[Is("run.motion", &["spacetime"]), On("guided.from")])) {
        /// Share of the iterations after which Gaussians are added along the rays of the worst image patches (STG); 0:
        /// never.
        from: f64 = 0.0 => share().switch().when(Is("run.motion", &["spacetime"]));
        /// Number of additions, up to the end of densification.
        times: usize = 3;
        /// Largest share of Gaussians that each addition creates.
        share: f64 = 0.03 => share();
    }
}

/// An examined view.
struct ViewError {
    frame: usize,
    error: f64,
    /// Mean absolute error a pixel, [1, h, w].
    errors: Planes<f32>,
    truth: Planes<f32>,
    farthest: f32,
}

/// See the module's documentation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Guided {
    /// How, and when.
    pub settings: GuidedSettings,
}

impl Guided {
    /// With these settings; `None`: never.
    pub(crate) fn of(settings: GuidedSettings) -> Option<Self> {
        (settings.from > 0.0 && settings.times > 0).then_some(Self { settings })
    }
}

impl Maintenance for Guided {
    fn name(&self) -> &str {
        "guided sampling"
    }

    fn order(&self) -> RunOrder {
        RunOrder::Place
    }

    fn due(&self, at: &At) -> bool {
        let Self { settings: s } = self;
        let (first, last) = ((s.from * at.steps as f64) as usize, (LAST * at.steps as f64) as usize);
        if at.step < first.max(1) || at.step > last {
            return false;
        }
        let interval = (last - first).div_ceil(s.times).max(1);
        (at.step - first.max(1)).is_multiple_of(interval)
    }

    /// Adds Gaussians to the first layer. Errors: an image cannot be read.
    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        let (rng, scene) = (c.rng("guided"), train_state.scene());
        let room = c.limits.cap.saturating_sub(scene.len());
        let budget = room.min((scene.len() as f64 * self.settings.share) as usize);
        if budget == 0 || scene.layers.first().is_none_or(|l| l.params.is_empty()) {
            return Ok(Change::default());
        }
        let mut points = Vec::new();
        for (k, look) in errors_of_views(scene, c.frames, c.antialias, rng.fork(1))?.iter().enumerate() {
            let most = budget * (k + 1) / WORST_VIEWS;
            rays(look, c.frames, most.saturating_sub(points.len()), rng.fork(2 + k as u64), &mut points);
        }
        if points.is_empty() {
            return Ok(Change::default());
        }
        let rows = scene.layers[0].params.len();
        let mut edit = RowEdit::identity(Space::Gaussians, rows);
        points.iter().for_each(|_| edit.push(0, Born::Clone));
        train_state.apply(0, &edit, &rng);
        let scene = train_state.scene_mut();
        let clip = scene.clip[1] - scene.clip[0] + 1.0 / scene.fps;
        let p = &mut scene.layers[0].params;
        let still = [VELOCITIES, ROTATION_RATES, FEATURE_TABLE].map(|name| p.find(name));
        for (row, point) in (rows..).zip(&points) {
            for key in [SH, LIFE].into_iter().chain(still.into_iter().flatten()) {
                p[key].clear_row(row);
            }
            let geometry = &mut p[GEOMETRY];
            geometry.write(row, 0, point.mean.map(|x| x as f32));
            geometry.write(row, QUAT, [1.0, 0.0, 0.0, 0.0]);
            geometry.write(row, LOG_SCALE, [point.scale.ln() as f32; 3]);
            geometry.set(row, OPACITY, logit(OPACITY_START));
            p[SH].write(row, 0, point.color.map(rgb_to_dc));
            if p[LIFE].width() >= 2 {
                // As long as the clip, around the time of the error.
                p[LIFE].write(row, 0, [point.time.0 as f32, clip.ln() as f32]);
            }
        }
        Ok(Change { added: points.len(), moved: 0, removed: 0 })
    }
}

/// The worst of some views, evenly chosen with a random start.
fn errors_of_views(scene: &Scene<f32>, frames: &dyn Frames, antialias: Antialias, rng: Rng) -> Result<Vec<ViewError>> {
    let mut backend = device::cpu(RenderConfig { antialias, ..RenderConfig::default() });
    let (mut instant, mut image, mut picture) = (Evaluation::default(), Image::default(), Picture::default());
    let mut worst: Vec<ViewError> = Vec::new();
    let count = VIEWS.min(frames.len());
    for k in 0..count {
        let frame = ((k as f64 + rng.uniform(0)) * frames.len() as f64 / count as f64) as usize;
        let frame = frame.min(frames.len() - 1);
        frames.load(frame, &mut picture)?;
        scene.at(frames.time(frame), &mut instant);
        let splats = scene.splats(&instant);
        let shot = Shot { depth: true, ..Shot::new(&splats, frames.camera(frame), scene.background) };
        backend.render(&shot, &mut image)?;
        let (h, w) = (image.color.height, image.color.width);
        let mut errors = Planes::new(1, h, w);
        for (i, error) in errors.data.iter_mut().enumerate() {
            let counts = picture.weight.as_ref().map_or(1.0, |m| m.data[i]);
            let apart = |c: usize| (image.color.data[c * h * w + i] - picture.color.data[c * h * w + i]).abs();
            *error = counts * (apart(0) + apart(1) + apart(2)) / 3.0;
        }
        let error = errors.data.iter().map(|&e| f64::from(e)).sum::<f64>() / (h * w).max(1) as f64;
        let depth = image.expected_depth(COVERED);
        let seen = depth.data.iter().zip(&image.alpha.data).filter(|(_, a)| **a >= COVERED);
        let farthest = seen.map(|(d, _)| *d).fold(0.0, f32::max);
        if farthest > 0.0 {
            worst.push(ViewError { frame, error, errors, truth: picture.color.clone(), farthest });
            worst.sort_by(|a, b| b.error.total_cmp(&a.error).then(a.frame.cmp(&b.frame)));
            worst.truncate(WORST_VIEWS);
        }
    }
    Ok(worst)
}

/// A Gaussian to be.
struct Point {
    mean: [f64; 3],
    color: [f32; 3],
    scale: f64,
    time: Time,
}

/// Adds at most `most` points along the rays of a view's worst patches, the worst first.
fn rays(look: &ViewError, frames: &dyn Frames, most: usize, rng: Rng, points: &mut Vec<Point>) {
    let camera: &Camera = frames.camera(look.frame);
    let (h, w) = (look.errors.height, look.errors.width);
    let mut sorted = look.errors.data.clone();
    sorted.sort_by(f32::total_cmp);
    let limit = sorted[((1.0 - WRONG) * (sorted.len() - 1) as f64) as usize];
    let (left, top) = ((BORDER * w as f64) as usize, (BORDER * h as f64) as usize);
    let mut patches = Vec::new();
    for y in (top..h.saturating_sub(top + PATCH - 1)).step_by(PATCH) {
        for x in (left..w.saturating_sub(left + PATCH - 1)).step_by(PATCH) {
            let pixels = (0..PATCH * PATCH).map(|i| look.errors.data[(y + i / PATCH) * w + x + i % PATCH]);
            let (mut wrong, mut sum) = (0, 0.0);
            for e in pixels {
                wrong += usize::from(e > limit);
                sum += f64::from(e);
            }
            if wrong as f64 >= WRONG_IN_PATCH * (PATCH * PATCH) as f64 {
                patches.push((sum, x, y));
            }
        }
    }
    patches.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.2, a.1).cmp(&(b.2, b.1))));
    let pixels = patches.iter().flat_map(|&(_, x, y)| {
        let side = PATCH / STRIDE;
        (0..side * side).map(move |i| (x + i % side * STRIDE, y + i / side * STRIDE))
    });
    for (i, (x, y)) in pixels.take(most).enumerate() {
        let shell = (i % SHELLS) as f64 / (SHELLS - 1) as f64;
        let jitter = 1.0 + JITTER * (2.0 * rng.uniform(i as u64) - 1.0);
        let z = f64::from(look.farthest) * DEPTHS[0] * (DEPTHS[1] / DEPTHS[0]).powf(shell) * jitter;
        points.push(Point {
            mean: camera.unproject([x as f64 + 0.5, y as f64 + 0.5], z),
            color: std::array::from_fn(|c| look.truth.data[(c * h + y) * w + x]),
            // As far apart as the rays.
            scale: STRIDE as f64 * z / camera.intrinsics.fx,
            time: frames.time(look.frame),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::Limits;
    use super::super::tests::{context, due_steps, scene};
    use super::*;
    use crate::step::tests::Made;

    #[test]
    fn gaussians_are_added_along_rays_of_large_error_under_the_cap() {
        let frames = Made::new(6, 2, 128);
        let run = |cap: usize| {
            let mut s = scene(200);
            // All in the middle: what is wrong is the sky around them.
            for row in 0..200 {
                let mean = s.layers[0].params[GEOMETRY].read::<3>(row, 0);
                s.layers[0].params[GEOMETRY].write(row, 0, mean.map(|x| 0.3 * x));
            }
            let mut train_state = TrainState::new(s);
            let mut guided = Guided { settings: GuidedSettings { from: 0.2, times: 2, share: 0.5 } };
            let limits = Limits { cap, extent: 4.0, min_opacity: 0.005 };
            let c = Context { frames: &frames, ..context(limits, 3, 9) };
            let change = guided.run(&mut train_state, &c).unwrap();
            let rows = [train_state.scene().len(), train_state.moments()[0].table(GEOMETRY).rows()];
            assert_eq!(rows, [200 + change.added; 2]);
            train_state.into_scene()
        };
        let s = run(1000);
        assert!(s.len() > 210, "{} Gaussians", s.len());
        let g = &s.layers[0].params[GEOMETRY];
        for row in 200..s.len() {
            let mean = g.read::<3>(row, 0).map(f64::from);
            // Somewhere it is at the middle of a pixel of a frame, in that pixel's colour.
            let dc = s.layers[0].params[SH].read::<3>(row, 0);
            let found = (0..12).any(|i| {
                let Some(([u, v], _)) = frames.camera(i).project(mean) else { return false };
                let mut picture = Picture::default();
                frames.load(i, &mut picture).unwrap();
                let (x, y) = (u - 0.5, v - 0.5);
                let inside = |a: f64| (a - a.round()).abs() < 1e-3 && (0.0..128.0).contains(&a.round());
                inside(x) && inside(y) && {
                    let at = |c: usize| picture.color.data[(c * 128 + y.round() as usize) * 128 + x.round() as usize];
                    dc == [at(0), at(1), at(2)].map(rgb_to_dc)
                }
            });
            assert!(found, "row {row}");
            assert!((g.get(row, OPACITY) - logit(0.1)).abs() < 1e-6);
        }
        assert_eq!(run(205).len(), 205);
        assert_eq!(run(1000).layers[0].params[GEOMETRY].data(), s.layers[0].params[GEOMETRY].data());
    }

    #[test]
    fn guided_sampling_is_due_at_its_interval() {
        let guided = Guided { settings: GuidedSettings { from: 0.25, times: 3, share: 0.1 } };
        assert_eq!(due_steps(&guided, 400), [100, 167, 234]);
    }
}
