//! The definition of an image: plain loops in f64, every splat against every pixel, matrices written out.
//!
//! Shares no code with the fast path but the spherical-harmonics constants. For tests and golden images.

use super::backend::{Abilities, Backend, Shot, refusal};
use super::{Antialias, Image, ImageGrads, RenderConfig, RenderGrads};
use crate::Result;
use crate::math::{Real, se3, sh};
use crate::scene::head::{BASE, FEATURES, FURTHER, HIDDEN, INPUTS};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{Camera, Color, HeadWeights, Part, Planes, Table};

/// gsplat's margin for x/z and y/z inside J: 0.3 times the tangent of half the field of view.
const MARGIN: f64 = 0.3;
/// gsplat's least compensation.
const RHO_MIN: f64 = 0.005;

/// A splat ready to blend.
struct Blob {
    mean: [f64; 2],
    inverse: [[f64; 2]; 2],
    opacity: f64,
    depth: f64,
    rgb: [f64; 3],
    further: [f64; FURTHER],
    id: usize,
}

/// Renders a shot exactly as [`super::Renderer`] should, O(splats · pixels), in f64 whatever the input.
///
/// Shapes as in [`super::Renderer::render`]. Panics: `extra` has not one row a splat.
pub fn render<F: Real>(shot: &Shot<'_, F>, config: &RenderConfig) -> Image<f64> {
    let Shot { splats, camera, background, extra, .. } = *shot;
    let background = background.map(F::f64);
    if let Some(extra) = extra {
        assert_eq!(extra.rows(), splats.len(), "further channels need one row a splat");
    }
    let mut blobs = Vec::new();
    let mut id = 0;
    for part in &splats.parts {
        for j in 0..part.out.rows() {
            blobs.extend(blob(part, j, id, shot, config));
            id += 1;
        }
    }
    blobs.sort_by(|a, b| a.depth.total_cmp(&b.depth).then(a.id.cmp(&b.id)));
    let (w, h, c) = (camera.width, camera.height, extra.map_or(0, Table::width));
    let mut out = Image {
        color: Planes::new(3, h, w),
        alpha: Planes::new(1, h, w),
        depth: Planes::new(usize::from(shot.depth), h, w),
        extra: Planes::new(c, h, w),
    };
    for y in 0..h {
        for x in 0..w {
            let at = y * w + x;
            let mut t = 1.0;
            let mut further = [0.0; FURTHER];
            for b in &blobs {
                let d = [b.mean[0] - (x as f64 + 0.5), b.mean[1] - (y as f64 + 0.5)];
                let q: f64 = (0..2).map(|i| (0..2).map(|j| d[i] * b.inverse[i][j] * d[j]).sum::<f64>()).sum();
                let alpha = (b.opacity * (-0.5 * q).min(0.0).exp()).min(config.alpha_max);
                if alpha < config.alpha_min {
                    continue;
                }
                if t * (1.0 - alpha) < config.transmittance_min {
                    break;
                }
                for k in 0..3 {
                    out.color.plane_mut(k)[at] += b.rgb[k] * alpha * t;
                }
                if shot.depth {
                    out.depth.data[at] += b.depth * alpha * t;
                }
                (0..FURTHER).for_each(|k| further[k] += b.further[k] * alpha * t);
                if let Some(extra) = extra {
                    for k in 0..c {
                        out.extra.plane_mut(k)[at] += extra.get(b.id, k).f64() * alpha * t;
                    }
                }
                t *= 1.0 - alpha;
            }
            for k in 0..3 {
                out.color.plane_mut(k)[at] += t * background[k];
            }
            out.alpha.data[at] = 1.0 - t;
            if let Some(head) = &splats.head {
                let color = headed(head, [0, 1, 2].map(|k| out.color.plane(k)[at]), &further, ray(camera, x, y));
                (0..3).for_each(|k| out.color.plane_mut(k)[at] = color[k]);
            }
        }
    }
    out
}

fn blob<F: Real>(part: &Part<'_, F>, j: usize, id: usize, shot: &Shot<'_, F>, config: &RenderConfig) -> Option<Blob> {
    let camera = shot.camera;
    let mean: [f64; 3] = part.out.read::<3>(j, 0).map(F::f64);
    let [xx, xy, xz, yy, yz, zz] = part.out.read::<6>(j, COV).map(F::f64);
    let opacity = part.out.get(j, SPLAT_OPACITY).f64();
    if ![mean[0], mean[1], mean[2], xx, xy, xz, yy, yz, zz, opacity].iter().all(|v| v.is_finite()) {
        return None;
    }
    let pose = &camera.cam_from_world;
    let k = &camera.intrinsics;
    let p = pose.apply(mean);
    if p[2] <= camera.near {
        return None;
    }
    // J, with x/z and y/z held inside the image and its margin.
    let (w, h) = (camera.width as f64, camera.height as f64);
    let (mx, my) = (MARGIN * 0.5 * w / k.fx, MARGIN * 0.5 * h / k.fy);
    let u = (p[0] / p[2]).max(-k.cx / k.fx - mx).min((w - k.cx) / k.fx + mx);
    let v = (p[1] / p[2]).max(-k.cy / k.fy - my).min((h - k.cy) / k.fy + my);
    let j2 = [[k.fx / p[2], 0.0, -k.fx * u / p[2]], [0.0, k.fy / p[2], -k.fy * v / p[2]], [0.0; 3]];
    let m = se3::mat_mul(&j2, &pose.rotation);
    let sigma = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    let s = se3::mat_mul(&se3::mat_mul(&m, &sigma), &se3::transpose(&m));
    let (a, b, c) = (s[0][0] + config.low_pass, s[0][1], s[1][1] + config.low_pass);
    let det = a * c - b * b;
    if det <= 0.0 || a <= 0.0 || c <= 0.0 {
        return None;
    }
    let rho = match config.antialias {
        Antialias::Off => 1.0,
        Antialias::On => ((s[0][0] * s[1][1] - b * b) / det).max(RHO_MIN * RHO_MIN).sqrt(),
    };
    let opacity = opacity * rho;
    if opacity < config.alpha_min {
        return None;
    }
    Some(Blob {
        mean: [k.fx * p[0] / p[2] + k.cx, k.fy * p[1] / p[2] + k.cy],
        inverse: [[c / det, -b / det], [-b / det, a / det]],
        opacity,
        depth: p[2],
        further: further(part, j),
        rgb: color(part, j, direction(part, se3::sub(mean, camera.center())), shot.sh_degree),
        id,
    })
}

/// The unit vector along `v` in the axes of the part's SH.
fn direction<F: Real>(part: &Part<'_, F>, v: [f64; 3]) -> [f64; 3] {
    let unit = se3::normalize(v);
    part.layer_from_world.map_or(unit, |r| se3::mat_vec(&r.map(|row| row.map(F::f64)), unit))
}

fn color<F: Real>(part: &Part<'_, F>, j: usize, direction: [f64; 3], degree: usize) -> [f64; 3] {
    match part.color {
        Color::Direct { table } => std::array::from_fn(|c| if c < table.width() { table.get(j, c).f64() } else { 0.0 }),
        Color::Sh { table, rows, weights, .. } => {
            let blocks = weights.map_or(1, Table::width);
            let width = table.width() / blocks;
            let used = sh::degree_of(width / 3).map_or(0, |d| sh::coeffs(d.min(degree)));
            let mut f = vec![[0.0; 3]; used];
            for b in 0..blocks {
                let weight = weights.map_or(1.0, |w| w.get(j, b).f64());
                for (k, f) in f.iter_mut().enumerate() {
                    for (c, f) in f.iter_mut().enumerate() {
                        *f += weight * table.get(rows.id(j), b * width + 3 * k + c).f64();
                    }
                }
            }
            sh::evaluate(&f, direction)
        }
    }
}

/// Channels of a splat that a head reads in addition to its colour.
fn further<F: Real>(part: &Part<'_, F>, j: usize) -> [f64; FURTHER] {
    match part.color {
        Color::Direct { table } if table.width() == FEATURES => table.read::<FURTHER>(j, BASE).map(F::f64),
        _ => [0.0; FURTHER],
    }
}

/// Origin, squashed into the unit ball, and unit direction of a pixel's ray.
fn ray(camera: &Camera, x: usize, y: usize) -> [f64; 6] {
    let eye = camera.center();
    let [a, b, c] = eye.map(|e| e / (1.0 + se3::norm(eye)));
    let [p, q, r] = se3::normalize(se3::sub(camera.unproject([x as f64 + 0.5, y as f64 + 0.5], 1.0), eye));
    [a, b, c, p, q, r]
}

/// σ(logit b + W₂ relu(W₁x)), the logit as far from 0 and 1 as 8 bits resolve, and its tangents beyond.
fn headed<F: Real>(head: &HeadWeights<'_, F>, base: [f64; 3], further: &[f64; FURTHER], ray: [f64; 6]) -> [f64; 3] {
    let x: Vec<f64> = further.iter().copied().chain(ray).collect();
    let row = |h: usize| (0..INPUTS).map(|i| head.first[h * INPUTS + i].f64() * x[i]).sum::<f64>().max(0.0);
    let hidden: Vec<f64> = (0..HIDDEN).map(row).collect();
    std::array::from_fn(|c| {
        let z: f64 = (0..HIDDEN).map(|h| head.second[c * HIDDEN + h].f64() * hidden[h]).sum();
        let near = base[c].clamp(1.0 / 255.0, 254.0 / 255.0);
        let logit = (near / (1.0 - near)).ln() + (base[c] - near) / (near * (1.0 - near));
        1.0 / (1.0 + (-(logit + z)).exp())
    })
}

/// [`render`] as a backend: forward only.
#[derive(Clone, Copy, Debug, Default)]
pub struct Oracle {
    /// Limits of the blend.
    pub config: RenderConfig,
}

impl Backend<f64> for Oracle {
    fn can(&self, abilities: &Abilities) -> Result<()> {
        if abilities.backward || abilities.compare { Err(refusal("the oracle", "take gradients back")) } else { Ok(()) }
    }

    fn render(&mut self, shot: &Shot<'_, f64>, out: &mut Image<f64>) -> Result<()> {
        *out = render(shot, &self.config);
        Ok(())
    }

    fn vjp(
        &mut self,
        _: &Shot<'_, f64>,
        _: &ImageGrads<'_, f64>,
        _: &mut [Option<&mut Table<f64>>],
        _: &mut RenderGrads<f64>,
    ) -> Result<()> {
        self.can(&Abilities { backward: true, ..Abilities::default() })
    }

    fn radii(&self) -> &[f64] {
        &[]
    }

    fn config(&self) -> &RenderConfig {
        &self.config
    }

    fn name(&self) -> &str {
        "the oracle"
    }
}
