//! A pixel head becomes spherical harmonics, for files and programs that know Gaussians only.
//!
//! Minimises Σ over images and pixels of ½|Σ_i w_i Y(d_i) f_i + ½ − C|², w_i = α_i T_i, C the colour that the head makes. The
//! weights of a pixel sum to at most 1, so that the Hessian is at most the block-diagonal matrix with a block
//! M_i = Σ w_i Y Yᵀ per Gaussian (Jensen's inequality). Every pass over the images therefore solves a small
//! system per Gaussian and does not raise the error; Nesterov's extrapolation shortens the way (Beck and Teboulle 2009).

use crate::backward::sh_grads;
use crate::layers::{Evaluation, Head, Scene};
use crate::math::cholesky::Cholesky;
use crate::math::sh::{MAX_COEFFS, basis, coeffs, degree_of};
use crate::math::{Real, se3};
use crate::motion::spacetime::FEATURE_TABLE;
use crate::render::{Antialias, Image, ImageGrads, RenderConfig, RenderGrads, Renderer, Shot};
use crate::scene::head::{HEAD_IN, HEAD_OUT};
use crate::scene::{Camera, Color, Grads, HeadKeys, SH, Splats, Table, Time};
use crate::{Error, Result};

/// Passes over the images (studies/records/2026-11-28-pixel-head.md).
const PASSES: usize = 5;
/// Weight of small coefficients above degree 0, share of a Gaussian's weight in the images: directions that no image shows are
/// then not invented.
const RIDGE: f64 = 0.003;
/// The same of degree 0, so that every system has a solution.
const FLOOR: f64 = 1e-6;

/// The scene without its head, its colours as spherical harmonics of at least `degree` that look alike from these cameras at
/// these times (seconds). Colours that change with time keep their mean. A scene without a head is returned unchanged.
///
/// `progress` gets the finished and the total number of renders. Errors: no image; a model around the features that cannot
/// be without them.
pub fn fold_head(
    scene: &Scene<f32>,
    shots: &[(f64, Camera)],
    degree: usize,
    antialias: Antialias,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Scene<f32>> {
    if scene.head == Head::Identity {
        return Ok(scene.clone());
    }
    if shots.is_empty() {
        return Err(Error::input("no camera to see the scene from").remedy("Give the folder of its run"));
    }
    let mut plain = without_features(scene, degree)?;
    let mut renderer = Renderer::<f32>::new(RenderConfig { antialias, ..RenderConfig::default() });
    let (mut with_head, mut own) = (Evaluation::default(), Evaluation::default());
    let (mut truth, mut image, mut pixels) = (Image::default(), Image::default(), RenderGrads::default());
    let mut truths: Vec<Vec<f32>> = Vec::with_capacity(shots.len());
    let mut fits: Vec<Fit> = plain.layers.iter().map(|l| Fit::new(&l.params[SH])).collect();
    let mut shares = Vec::new();
    for pass in 0..PASSES {
        let mut d: Vec<Grads<f32>> = plain.layers.iter().map(|l| Grads::new(&l.params)).collect();
        for (i, (time, camera)) in shots.iter().enumerate() {
            progress(pass * shots.len() + i, PASSES * shots.len());
            if pass == 0 {
                scene.at(Time(*time), &mut with_head);
                renderer.render(&Shot::new(&scene.splats(&with_head), camera, scene.background), &mut truth);
                truths.push(truth.color.data.iter().map(|t| t.clamp(0.0, 1.0)).collect());
            }
            plain.at(Time(*time), &mut own);
            let splats = plain.splats(&own);
            let shot = Shot::new(&splats, camera, plain.background);
            renderer.render(&shot, &mut image);
            if pass == 0 {
                renderer.last_contributions(&mut shares);
                add_normals(&mut fits, &splats, camera, &shares);
            }
            image.color.data.iter_mut().zip(&truths[i]).for_each(|(x, t)| *x -= t);
            let grads = ImageGrads { color: &image.color, alpha: None, depth: None, extra: None };
            renderer.backward(&shot, &grads, &mut sh_grads(&splats, &mut d), &mut pixels);
        }
        for ((layer, fit), d) in plain.layers.iter_mut().zip(&mut fits).zip(&d) {
            fit.step(&mut layer.params[SH], d.table(SH), pass + 1 == PASSES);
        }
    }
    Ok(plain)
}

/// The scene with base colours alone, in tables of at least this degree.
fn without_features(scene: &Scene<f32>, degree: usize) -> Result<Scene<f32>> {
    let mut out = Scene { head: Head::Identity, ..scene.clone() };
    for layer in &mut out.layers {
        if let Some(motion) = layer.motion.without_features() {
            layer.params = layer.params.without(&[FEATURE_TABLE, HEAD_IN, HEAD_OUT]);
            layer.motion = motion;
        }
        if HeadKeys::of(&layer.params).is_some() {
            scene.without_head("spherical harmonics")?;
        }
        let old = &layer.params[SH];
        if degree_of(old.width() / 3).is_some_and(|had| had < degree) {
            let mut new = Table::new(&[("sh", 3 * coeffs(degree))], old.rows());
            for row in 0..old.rows() {
                (0..old.width()).for_each(|col| new.set(row, col, old.get(row, col)));
            }
            layer.params[SH] = new;
        }
    }
    Ok(out)
}

/// The least-squares problem of one layer.
struct Fit {
    /// Coefficients K of a channel.
    count: usize,
    /// Lower triangles of M, [N, K(K + 1)/2].
    normals: Vec<f32>,
    /// Σ w of every Gaussian.
    weights: Vec<f64>,
    /// The coefficients at the start, and before the last extrapolation.
    start: Table<f32>,
    reached: Table<f32>,
    /// Nesterov's t.
    pace: f64,
}

impl Fit {
    fn new(table: &Table<f32>) -> Self {
        let (count, rows) = (table.width() / 3, table.rows());
        Self {
            count,
            normals: vec![0.0; rows * count * (count + 1) / 2],
            weights: vec![0.0; rows],
            start: table.clone(),
            reached: table.clone(),
            pace: 1.0,
        }
    }

    /// Adds w Y Yᵀ of a Gaussian seen along a direction.
    fn add(&mut self, row: usize, weight: f32, direction: [f32; 3]) {
        let y: [f32; MAX_COEFFS] = basis(direction);
        let size = self.count * (self.count + 1) / 2;
        let own = &mut self.normals[row * size..(row + 1) * size];
        let pairs = (0..self.count).flat_map(|i| (0..=i).map(move |j| (i, j)));
        own.iter_mut().zip(pairs).for_each(|(n, (i, j))| *n += weight * y[i] * y[j]);
        self.weights[row] += f64::from(weight);
    }

    /// One step of every Gaussian from the gradient `d` at `table`, which gets the next point to look at; at the end the
    /// point that was reached.
    fn step(&mut self, table: &mut Table<f32>, d: &Table<f32>, last: bool) {
        let (k, size) = (self.count, self.count * (self.count + 1) / 2);
        let pace = 0.5 * (1.0 + (1.0 + 4.0 * self.pace * self.pace).sqrt());
        let onward = if last { 0.0 } else { (self.pace - 1.0) / pace };
        self.pace = pace;
        for row in (0..table.rows()).filter(|row| self.weights[*row] > 0.0) {
            let pull = |i: usize| self.weights[row] * if i == 0 { FLOOR } else { RIDGE };
            let mut matrix = vec![0.0; k * k];
            let mut packed = self.normals[row * size..(row + 1) * size].iter();
            for i in 0..k {
                (0..=i).zip(&mut packed).for_each(|(j, n)| matrix[i * k + j] = f64::from(*n));
                matrix[i * k + i] += pull(i);
            }
            let Some(factor) = Cholesky::new(k, matrix) else { continue };
            for channel in 0..3 {
                let at = |i: usize| 3 * i + channel;
                let off = |i: usize| f64::from(table.get(row, at(i)) - self.start.get(row, at(i)));
                let slope = (0..k).map(|i| f64::from(d.get(row, at(i))) + pull(i) * off(i)).collect();
                for (i, by) in factor.solve(slope).into_iter().enumerate() {
                    let next = f64::from(table.get(row, at(i))) - by;
                    let before = f64::from(self.reached.get(row, at(i)));
                    self.reached.set(row, at(i), next as f32);
                    table.set(row, at(i), (next + onward * (next - before)) as f32);
                }
            }
        }
    }
}

/// Adds what an image shows of every Gaussian to its system: `shares` are Σ α T of all splats in order.
fn add_normals(fits: &mut [Fit], splats: &Splats<'_>, camera: &Camera, shares: &[f32]) {
    let center = camera.center();
    let mut first = 0;
    for (fit, part) in fits.iter_mut().zip(&splats.parts) {
        let (rows, count) = match part.color {
            Color::Sh { rows, base: true, .. } => (Some(rows), part.out.rows()),
            _ => (None, part.out.rows()),
        };
        for j in 0..if rows.is_some() { count } else { 0 } {
            let share = shares[first + j];
            if let (Some(rows), true) = (rows, share > 0.0) {
                let to = part.out.read::<3>(j, 0).map(Real::f64);
                let direction = se3::normalize(se3::sub(to, center)).map(|x| x as f32);
                let direction = match part.layer_from_world {
                    Some(r) => r.map(|r| (0..3).map(|i| r[i] * direction[i]).sum()),
                    None => direction,
                };
                fit.add(rows.id(j), share, direction);
            }
        }
        first += count;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bake::{Shown, compare};
    use crate::device;
    use crate::layers::Layer;
    use crate::math::{Rng, Se3};
    use crate::motion::spacetime::FeatureSpec;
    use crate::motion::{SpacetimeSpec, Spec, build};
    use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
    use crate::scene::{GEOMETRY, LifeKind, Params};

    /// A ball of Gaussians whose head reddens what is seen along x.
    fn headed() -> Scene<f32> {
        let features = Some(FeatureSpec { seed: 3 });
        let spec = Spec::Spacetime(SpacetimeSpec { features, ..SpacetimeSpec::default() });
        let mut params = Params::new(300, 1, LifeKind::GaussHalf.columns());
        let motion = build(&spec, &mut params).unwrap();
        let features = params.find(FEATURE_TABLE).unwrap();
        for row in 0..300 {
            let rng = Rng::new(8, "head", row as u64);
            let mean = se3::normalize(std::array::from_fn(|k| rng.normal(k as u64)));
            (0..3).for_each(|k| params[GEOMETRY].set(row, k, mean[k] as f32));
            params[GEOMETRY].set(row, QUAT, 1.0);
            (0..3).for_each(|k| params[GEOMETRY].set(row, LOG_SCALE + k, -1.7));
            params[GEOMETRY].set(row, OPACITY, 2.0);
            (0..3).for_each(|k| params[SH].set(row, k, 0.5 * rng.normal(9 + k as u64) as f32));
            (0..3).for_each(|k| params[features].set(row, k, rng.normal(20 + k as u64) as f32));
            params[crate::scene::LIFE].set(row, 0, 0.5);
            params[crate::scene::LIFE].set(row, 1, 0.5);
        }
        let keys = HeadKeys::of(&params).unwrap();
        (0..18).for_each(|i| params[keys.second].set(i, 0, 0.8 * Rng::new(4, "out", 0).normal(i as u64) as f32));
        let layer = Layer::new("a", params, motion, LifeKind::GaussHalf);
        Scene {
            layers: vec![layer],
            clip: [0.0, 1.0],
            fps: 30.0,
            up: [0.0, 1.0, 0.0],
            head: Head::Features,
            ..Scene::default()
        }
    }

    fn around(from: f64, count: usize) -> Vec<(f64, Camera)> {
        let shot = |i: usize| {
            let angle = from + i as f64 / count as f64 * std::f64::consts::TAU;
            let at = [4.0 * angle.cos(), 1.5 * (2.0 * angle).sin(), 4.0 * angle.sin()];
            let pose = Se3::look_at(at, [0.0; 3], [0.0, 1.0, 0.0]);
            (i as f64 / count as f64, Camera::with_fov_y(pose, 0.7, 64, 64))
        };
        (0..count).map(shot).collect()
    }

    #[test]
    fn a_head_folded_into_spherical_harmonics_looks_alike_from_other_cameras() {
        let scene = headed();
        let psnr = |file: &Scene<f32>, shots: &[(f64, Camera)]| {
            let mut cpu = device::cpu(RenderConfig::default());
            compare(&scene, Shown::File(file), shots, cpu.as_mut(), &mut |_, _| true).unwrap().unwrap().psnr
        };
        let base = without_features(&scene, 3).unwrap();
        let folded = fold_head(&scene, &around(0.0, 24), 3, Antialias::Off, &mut |_, _| {}).unwrap();
        assert!(folded.head == Head::Identity && folded.head_keys().is_none());
        assert!(folded.without_head("a file").is_ok() && folded.layers[0].params[SH].width() == 48);
        let before = psnr(&base, &around(0.1, 9));
        let [seen, other] = [around(0.0, 24), around(0.1, 9)].map(|shots| psnr(&folded, &shots));
        assert!(other > before + 8.0 && other > 30.0, "{before:.2} dB before, {seen:.2} and {other:.2} dB after");
        // One degree is less alike, and nothing that has no head changes.
        let low = fold_head(&scene, &around(0.0, 24), 0, Antialias::Off, &mut |_, _| {}).unwrap();
        assert!(psnr(&low, &around(0.0, 24)) < seen, "degree 3 must be more alike than degree 0");
        let same = fold_head(&folded, &[], 3, Antialias::Off, &mut |_, _| {}).unwrap();
        assert!(same.layers[0].params == folded.layers[0].params);
        assert!(fold_head(&scene, &[], 3, Antialias::Off, &mut |_, _| {}).is_err());
    }
}
