//! Floaters: Gaussians in front of few cameras. They are recognised by the effect of their removal on every image.
//!
//! With L = Σ over pixels and channels of (I − T)² between render I and truth T, and r_i the part of the render that is
//! lost without Gaussian i, removing it alone changes L by
//!
//! > Δ_i = Σ (I − r_i − T)² − Σ (I − T)² = Σ r_i² − 2 Σ r_i (I − T) = removal_i − o_i ∂L/∂o_i,
//!
//! because r_i is linear in the opacity o_i: two numbers from the renderer. A training camera *supports* a Gaussian
//! that it would miss. A floater is seen, supported by a small share of the cameras that see it, not missed by held-out
//! cameras, and all images together are better without it. That much holds for some Gaussians of every scene, whose
//! images are never quite right, so that it must also matter to a camera. What removing the Gaussian gains there is −Δ;
//! the gain from removing the best amount of it, if there were more, is
//!
//! > max_a Σ (I − T)² − Σ (I − T − a r)² = (Σ r (I − T))² / Σ r² = (Σ r² − Δ)² / (4 Σ r²),
//!
//! which is large for all Gaussians of a veil, also those that others hide. The geometric mean of both, as a share of
//! the squared error of the median camera, distinguishes veils from the rest.

use crate::capture::frames::{Frames, Picture};
use splat4d::edit::Selected;
use splat4d::layers::{Evaluation, Scene};
use splat4d::render::{Antialias, Image, ImageGrads, Importance, RenderConfig, RenderGrads, Renderer, Shot};
use splat4d::scene::splats::SPLAT_OPACITY;
use splat4d::scene::{Planes, Table};
use splat4d::{Error, Result};
use std::collections::BTreeMap;

/// Images of a camera that are examined, at most.
const PICTURES: usize = 4;
/// Images that are examined, at most: minutes, not hours.
const MOST: usize = 400;
/// A camera sees a Gaussian whose removal changes its images by this, colours of 0 to 1 squared and summed over
/// pixels and
/// channels: a pixel by 4 %. Less is lost in what any image differs from any scene.
const SEEN: f64 = 0.005;
/// A camera misses a Gaussian whose removal makes its images worse by this share of what the removal changes: less is
/// chance.
const MISSED: f64 = 0.2;
/// Largest share of the cameras that see a Gaussian which may support it, at strength 1.
const SHARE: f64 = 0.5;
/// Least share of the median camera's squared error that a floater matters to a camera, at strength 1; at others it is
/// this by the strength. Measured on two captures with veils (docs/edit.md): at 0.01 more than 95 of 100 of the veil
/// are found, and of the rest less than 3 in a thousand; at 0.005 four times as many of the rest.
const MATTERS: f64 = 0.005;

/// Evidence of the images about one Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Support {
    /// Training cameras whose images it changes.
    pub seen: u32,
    /// Training cameras that would miss it.
    pub missed: u32,
    /// Its largest effect on any training camera that sees it, in squared error; zero where no camera is better without
    /// it.
    pub matters: f64,
    /// Σ Δ over held-out images; below zero they are better without it.
    pub held: f64,
    /// Σ Δ over all images.
    pub delta: f64,
    /// Σ r² over all images.
    pub change: f64,
}

impl Support {
    /// Whether it is a floater at a strength from 0 (nothing is) to 1. What alone makes an image wrong has Δ = −Σ r².
    /// `error`: the squared error of the median camera.
    pub(crate) fn floats(&self, strength: f64, error: f64) -> bool {
        let matters = self.matters * strength >= MATTERS * error;
        let unmissed = f64::from(self.missed) <= SHARE * strength * f64::from(self.seen);
        let better = self.held <= 0.0 && self.delta <= (strength - 1.0) * self.change;
        strength > 0.0 && self.seen > 0 && unmissed && better && matters
    }
}

/// Evidence of the images about a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Judged {
    /// By layer and Gaussian.
    pub(crate) support: Vec<Vec<Support>>,
    /// Σ (I − T)² over the images of the median training camera.
    pub error: f64,
}

impl Judged {
    /// The Gaussians that float at a strength.
    pub fn floaters(&self, strength: f64) -> Selected {
        self.support.iter().map(|layer| layer.iter().map(|s| s.floats(strength, self.error)).collect()).collect()
    }
}

/// Of every Gaussian what the images show about it: those of `train`, which is a list of numbers of `frames`, and those
/// that were held out. `progress`: images done, and all.
///
/// Errors: an image that cannot be read; no held-out images; a scene with a pixel head.
pub fn support(
    scene: &Scene<f32>,
    frames: &dyn Frames,
    train: &[usize],
    held: &[usize],
    antialias: bool,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Judged> {
    scene.without_head("the search for floaters")?;
    if held.is_empty() {
        return Err(Error::input("no view was held out, which is needed to find floaters")
            .remedy("Train with held-out views, or delete by a selection"));
    }
    let mut judge = Judge::new(scene, antialias);
    let mut out: Vec<Vec<Support>> = scene.layers.iter().map(|l| vec![Support::default(); l.params.len()]).collect();
    let (train, held) = (by_camera(frames, train), by_camera(frames, held));
    let total = train.iter().chain(&held).map(Vec::len).sum();
    let (mut done, mut errors) = (0, Vec::new());
    for (own, is_held) in train.iter().map(|f| (f, false)).chain(held.iter().map(|f| (f, true))) {
        // A camera is one voice: its images are summed.
        let mut sums: Vec<Vec<[f64; 2]>> = out.iter().map(|l| vec![[0.0; 2]; l.len()]).collect();
        let mut error = 0.0;
        for &frame in own {
            error += judge.add(frames, frame, &mut sums)?;
            done += 1;
            progress(done, total);
        }
        if !is_held {
            errors.push(error);
        }
        for (out, [delta, change]) in out.iter_mut().flatten().zip(sums.into_iter().flatten()) {
            (out.delta, out.change) = (out.delta + delta, out.change + change);
            if is_held {
                out.held += delta;
            } else if change > SEEN {
                out.seen += 1;
                out.missed += u32::from(delta > MISSED * change);
                let best = 0.25 * (change - delta).powi(2) / change;
                out.matters = out.matters.max((-delta).max(0.0).sqrt() * best.sqrt());
            }
        }
    }
    errors.sort_by(f64::total_cmp);
    Ok(Judged { support: out, error: errors.get(errors.len() / 2).copied().unwrap_or(0.0) })
}

/// Images of every camera, spread over its time, within the bounds.
fn by_camera(frames: &dyn Frames, among: &[usize]) -> Vec<Vec<usize>> {
    let mut cameras: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    among.iter().for_each(|&f| cameras.entry(frames.rig(f)).or_default().push(f));
    // A camera that moves is another one in every image.
    if cameras.len() == 1 {
        let step = among.len().div_ceil(MOST / 2).max(1);
        return among.iter().step_by(step).map(|&f| vec![f]).collect();
    }
    let most = (MOST / cameras.len().max(1)).clamp(1, PICTURES);
    let spread = |own: Vec<usize>| {
        let step = own.len().div_ceil(most).max(1);
        own.into_iter().skip(step / 2).step_by(step).collect()
    };
    cameras.into_values().map(spread).filter(|own: &Vec<usize>| !own.is_empty()).collect()
}

struct Judge<'a> {
    scene: &'a Scene<f32>,
    renderer: Renderer<f32>,
    importance: Importance,
    instant: Evaluation<f32>,
    image: Image<f32>,
    grads: RenderGrads<f32>,
    removals: Vec<f32>,
    picture: Picture,
}

impl<'a> Judge<'a> {
    fn new(scene: &'a Scene<f32>, antialias: bool) -> Self {
        let antialias = if antialias { Antialias::On } else { Antialias::Off };
        let config = RenderConfig { antialias, ..RenderConfig::default() };
        Self {
            scene,
            renderer: Renderer::new(config),
            importance: Importance::new(config),
            instant: Evaluation::default(),
            image: Image::default(),
            grads: RenderGrads::default(),
            removals: Vec::new(),
            picture: Picture::default(),
        }
    }

    /// Adds Δ and Σ r² of one image to `sums`, by layer and row. Returns Σ (I − T)².
    fn add(&mut self, frames: &dyn Frames, frame: usize, sums: &mut [Vec<[f64; 2]>]) -> Result<f64> {
        frames.load(frame, &mut self.picture)?;
        let truth = &self.picture;
        self.scene.at(frames.time(frame), &mut self.instant);
        let splats = self.scene.splats(&self.instant);
        let shot = Shot::new(&splats, frames.camera(frame), self.scene.background);
        self.importance.removals(&shot, &mut self.removals);
        self.renderer.render(&shot, &mut self.image);
        // ∂L/∂I = 2 (I − T), nothing where the lens left no image.
        let mut d_color = Planes { data: vec![0.0; truth.color.data.len()], ..truth.color.clone() };
        let valid = |pixel: usize| truth.weight.as_ref().map_or(1.0, |v| v.data[pixel]);
        let pixels = d_color.pixels();
        for (i, d) in d_color.data.iter_mut().enumerate() {
            *d = 2.0 * valid(i % pixels) * (self.image.color.data[i] - truth.color.data[i]);
        }
        let error: f64 = d_color.data.iter().map(|d| f64::from(0.5 * d).powi(2)).sum();
        let grads = ImageGrads { color: &d_color, alpha: None, depth: None, extra: None };
        let mut none: Vec<Option<&mut Table<f32>>> = splats.parts.iter().map(|_| None).collect();
        self.renderer.backward(&shot, &grads, &mut none, &mut self.grads);
        let mut first = 0;
        for ((tape, sums), grads) in self.instant.tapes().zip(sums).zip(&self.grads.parts) {
            for j in 0..tape.out().rows() {
                let change = f64::from(self.removals[first + j]);
                let slope = f64::from(tape.out().get(j, SPLAT_OPACITY)) * f64::from(grads.out.get(j, SPLAT_OPACITY));
                let sum = &mut sums[tape.rows().id(j)];
                *sum = [sum[0] + change - slope, sum[1] + change];
            }
            first += tape.out().rows();
        }
        Ok(error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::layers::Layer;
    use splat4d::math::{Rng, Se3, se3};
    use splat4d::motion::Still;
    use splat4d::scene::params::{LOG_SCALE, QUAT};
    use splat4d::scene::{Camera, GEOMETRY, LifeKind, Params, SH, Time};
    use std::sync::Arc;

    /// Gaussians of the scene, and of the veil behind them in the table.
    const BODY: usize = 1500;
    const VEIL: usize = 300;

    struct Rig {
        cameras: Vec<Camera>,
        pictures: Vec<Planes<f32>>,
    }

    impl Frames for Rig {
        fn len(&self) -> usize {
            self.cameras.len()
        }
        fn camera(&self, i: usize) -> &Camera {
            &self.cameras[i]
        }
        fn time(&self, _: usize) -> Time {
            Time(0.0)
        }
        fn rig(&self, i: usize) -> usize {
            i
        }
        fn name(&self, i: usize) -> String {
            i.to_string()
        }
        fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
            out.color.clone_from(&self.pictures[i]);
            Ok(())
        }
    }

    fn camera(i: usize) -> Camera {
        let angle = std::f64::consts::TAU * i as f64 / 12.0;
        let eye = [4.0 * angle.cos(), 4.0 * angle.sin(), 1.0 + (i % 3) as f64 * 0.5];
        Camera::with_fov_y(Se3::look_at(eye, [0.0; 3], [0.0, 0.0, 1.0]), 0.7, 72, 54)
    }

    /// A ball of many colours, and before the first two cameras a veil.
    fn scene(veil: bool) -> Scene<f32> {
        let n = if veil { BODY + VEIL } else { BODY };
        let mut p = Params::new(n, 1, LifeKind::Infinite.columns());
        for row in 0..n {
            let r = Rng::new(5, "veil", 0).fork(row as u64);
            let unit = se3::normalize([r.normal(0), r.normal(1), r.normal(2)]);
            let (place, color): ([f64; 3], [f64; 3]) = if row < BODY {
                let color = std::array::from_fn(|c| (3.0 * unit[c]).sin());
                (unit.map(|x| 0.9 * x), color)
            } else {
                let eye = camera(row % 2).center();
                let near = se3::scale(eye, 0.75);
                (std::array::from_fn(|k| near[k] + 0.1 * r.normal(20 + k as u64)), [0.8; 3])
            };
            p[GEOMETRY].write(row, 0, place.map(|x| x as f32));
            p[GEOMETRY].write(row, QUAT, [1.0, 0.0, 0.0, 0.0]);
            let size = if row < BODY { -2.7 } else { -4.0 };
            p[GEOMETRY].write(row, LOG_SCALE, [size, size, size, if row < BODY { 2.0 } else { -0.5 }]);
            p[SH].write(row, 0, color.map(|x| x as f32));
        }
        let layer = Layer::new("all", p, Arc::new(Still), LifeKind::Infinite);
        Scene { layers: vec![layer], up: [0.0, 0.0, 1.0], ..Scene::default() }
    }

    fn rig() -> Rig {
        let cameras: Vec<Camera> = (0..12).map(camera).collect();
        let truth = scene(false);
        // What no Gaussian shows: images are never quite the scene.
        let noisy = |(i, camera): (usize, &Camera)| {
            let mut picture = splat4d::draw(&truth, camera, Time(0.0)).unwrap().color;
            let noise = Rng::new(8, "noise", i as u64);
            picture.data.iter_mut().enumerate().for_each(|(k, x)| *x += 0.03 * noise.normal(k as u64) as f32);
            picture
        };
        let pictures = cameras.iter().enumerate().map(noisy).collect();
        Rig { cameras, pictures }
    }

    #[test]
    fn the_predicted_error_of_a_removal_is_the_measured_one() {
        let (rig, s) = (rig(), scene(true));
        let mut judge = Judge::new(&s, false);
        let mut sums = vec![vec![[0.0; 2]; s.len()]];
        judge.add(&rig, 0, &mut sums).unwrap();
        let error = |s: &Scene<f32>| -> f64 {
            let seen = splat4d::draw(s, &rig.cameras[0], Time(0.0)).unwrap().color;
            seen.data.iter().zip(&rig.pictures[0].data).map(|(a, b)| f64::from(a - b).powi(2)).sum()
        };
        let whole = error(&s);
        let mut tried = 0;
        for row in (0..s.len()).filter(|&i| sums[0][i][1] > 0.02).step_by(9) {
            let mut without = s.clone();
            let keep = (0..s.len()).map(|i| i != row);
            let edit = splat4d::scene::RowEdit::prune(splat4d::scene::Space::Gaussians, keep);
            without.layers[0].edit(&edit, &Rng::new(0, "x", 0));
            let (predicted, is) = (sums[0][row][0], error(&without) - whole);
            assert!((predicted - is).abs() < 0.03 * sums[0][row][1] + 0.02, "row {row}: {predicted}, is {is}");
            tried += 1;
        }
        assert!(tried > 5, "{tried} Gaussians were tried");
    }

    #[test]
    fn zero_strength_finds_no_floaters_and_held_out_views_are_required() {
        let (rig, s) = (rig(), scene(true));
        // Camera 5 and 11 are held out; 0 and 1 have the veil.
        let train: Vec<usize> = (0..12).filter(|i| i % 6 != 5).collect();
        let measured = support(&s, &rig, &train, &[5, 11], false, &mut |_, _| {}).unwrap();
        assert!(measured.support[0].iter().any(|s| s.seen > 0), "something is seen");
        assert!(measured.floaters(0.0)[0].iter().all(|f| !f), "nothing is found at no strength");
        // The rest is the truth: of it hardly anything may go.
        let found = measured.floaters(0.5).remove(0);
        let count = |rows: std::ops::Range<usize>| found[rows].iter().filter(|f| **f).count();
        let (veil, rest) = (count(BODY..BODY + VEIL), count(0..BODY));
        // In so dense a veil of one colour each hides that the others are wrong.
        assert!(veil * 4 >= VEIL && rest * 100 <= BODY, "{veil} of the veil, {rest} of the rest");
        assert!(support(&s, &rig, &train, &[], false, &mut |_, _| {}).is_err());
    }
}
