//! Total variation of images and of depth, against noise.

use super::{ImageTerm, LossGrads, Needs, SEEN, Shown, View, expected_depth_backward, over_rows};
use crate::loss::terms::StepInfo;
use splat4d::math::Real;
use splat4d::scene::Planes;

/// [`total_variation`] of the colours, times a weight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TotalVariation(pub f64);

impl<F: Real> ImageTerm<F> for TotalVariation {
    fn eval(&mut self, _: &StepInfo, _: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64 {
        total_variation(shown.color, self.0, d.color.add())
    }
}

/// [`depth_smoothness`] next to the view's truth, times a weight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DepthSmoothness(pub f64);

impl<F: Real> ImageTerm<F> for DepthSmoothness {
    fn needs(&self, _: &View<'_, F>) -> Needs {
        Needs { depth: true, extra: Vec::new() }
    }

    fn eval(&mut self, _: &StepInfo, view: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64 {
        depth_smoothness(shown.depth, shown.alpha, view.truth, self.0, d.depth.add(), d.alpha.add())
    }
}

/// How fast an edge of the image frees the depth next to it: a difference of a tenth of the colour range counts e⁻¹.
const EDGE: f64 = 10.0;

/// The weight of a pair of neighbouring pixels, by their numbers; 0: they are not compared.
type Pair<'a, F> = dyn Fn(usize, usize) -> F + Sync + 'a;

fn sign<F: Real>(x: F) -> F {
    if x > F::ZERO {
        F::ONE
    } else if x < F::ZERO {
        -F::ONE
    } else {
        F::ZERO
    }
}

/// Σ over pairs of neighbours of weight·|difference|; adds `scale` times the gradient, returns the bare sum.
fn variation<F: Real>(plane: &[F], [width, height]: [usize; 2], pair: &Pair<'_, F>, scale: f64, d: &mut [F]) -> f64 {
    let factor = F::of(scale);
    over_rows(d, width, |y, d| {
        let mut sum = 0.0;
        for (x, d) in d.iter_mut().enumerate() {
            let p = y * width + x;
            let mut add = |q: usize, own: bool| {
                let (w, e) = (pair(p.min(q), p.max(q)), plane[p] - plane[q]);
                if w > F::ZERO {
                    *d += factor * w * sign(e);
                    // A pair's value counts once, at its first pixel.
                    sum += if own { (w * e.abs()).f64() } else { 0.0 };
                }
            };
            if x + 1 < width {
                add(p + 1, true);
            }
            if y + 1 < height {
                add(p + width, true);
            }
            if x > 0 {
                add(p - 1, false);
            }
            if y > 0 {
                add(p - width, false);
            }
        }
        sum
    })
}

/// Mean over pixels and channels of |difference to the right| + |difference below|, in the image's unit.
///
/// Source: Rudin, Osher, Fatemi 1992, anisotropic.
pub(crate) fn total_variation<F: Real>(image: &Planes<F>, weight: f64, d: &mut Planes<F>) -> f64 {
    assert_eq!(image.data.len(), d.data.len(), "a gradient has its image's shape");
    let scale = weight / image.data.len().max(1) as f64;
    let size = [image.width, image.height];
    (0..image.channels).map(|c| variation(image.plane(c), size, &|_, _| F::ONE, scale, d.plane_mut(c))).sum::<f64>()
        * scale
}

/// Mean over pairs of neighbouring pixels that show something of e^(−10 |difference of the truth|)·|difference of expected
/// depth|, over the mean expected depth (held constant): no unit. Depth may break where the truth has an edge.
///
/// `depth` is Σ z α T. Source: Godard et al. 2017, "edge-aware" disparity smoothness, with depth over its mean.
pub(crate) fn depth_smoothness<F: Real>(
    depth: &Planes<F>,
    alpha: &Planes<F>,
    truth: &Planes<F>,
    weight: f64,
    d_depth: &mut Planes<F>,
    d_alpha: &mut Planes<F>,
) -> f64 {
    let n = depth.pixels();
    assert!([alpha.data.len(), truth.pixels(), d_depth.data.len(), d_alpha.data.len()] == [n; 4], "{n} pixels");
    let floor = F::of(SEEN);
    let expected: Vec<F> = depth.data.iter().zip(&alpha.data).map(|(&d, &a)| d / a.max(floor)).collect();
    let seen = |p: usize| alpha.data[p] >= floor;
    let (mut sum, mut count) = (0.0, 0usize);
    for p in (0..n).filter(|&p| seen(p)) {
        sum += expected[p].f64();
        count += 1;
    }
    if count == 0 || sum <= 0.0 {
        return 0.0;
    }
    let scale = weight / sum;
    let channels = truth.channels;
    let pair = |p: usize, q: usize| {
        if !seen(p) || !seen(q) {
            return F::ZERO;
        }
        let edge: F = (0..channels).map(|c| (truth.plane(c)[p] - truth.plane(c)[q]).abs()).sum();
        (-edge * F::of(EDGE / channels.max(1) as f64)).exp()
    };
    let mut d = vec![F::ZERO; n];
    let value = scale * variation(&expected, [depth.width, depth.height], &pair, scale, &mut d);
    expected_depth_backward(&expected, &alpha.data, floor, &d, &mut d_depth.data, &mut d_alpha.data);
    value
}

#[cfg(test)]
mod tests {
    use super::super::check;
    use super::*;

    #[test]
    fn gradients_equal_finite_differences() {
        let image = check::planes("image", [3, 5, 8], 0.0, 1.0);
        let run = |p: &[Planes<f64>], d: &mut [Planes<f64>]| total_variation(&p[0], 0.7, &mut d[0]);
        check::gradients(std::slice::from_ref(&image), run, |p| run(p, &mut [Planes::new(3, 5, 8)]));
        let inputs = [check::planes("depth", [1, 5, 8], 1.0, 4.0), check::planes("alpha", [1, 5, 8], 0.3, 1.0)];
        let run = |p: &[Planes<f64>], d: &mut [Planes<f64>]| {
            let [d_depth, d_alpha] = d else { panic!("two inputs") };
            depth_smoothness(&p[0], &p[1], &image, 0.7, d_depth, d_alpha)
        };
        // The mean depth is held: the value is put back to the base's.
        let mean = |p: &[Planes<f64>]| {
            let seen = p[0].data.iter().zip(&p[1].data).filter(|(_, a)| **a >= SEEN);
            seen.map(|(d, a)| d / a).sum::<f64>()
        };
        let base = mean(&inputs);
        let zeros = || [Planes::new(1, 5, 8), Planes::new(1, 5, 8)];
        check::gradients(&inputs, run, |p| run(p, &mut zeros()) * mean(p) / base);
    }

    #[test]
    fn constant_images_have_no_loss_and_image_edges_allow_depth_edges() {
        let step = |at: usize| {
            let mut p = Planes::new(1, 6, 6);
            (0..36).for_each(|i| p.data[i] = if i % 6 < at { 1.0 } else { 2.0 });
            p
        };
        let alpha = Planes { channels: 1, height: 6, width: 6, data: vec![1.0f64; 36] };
        let cost = |depth: &Planes<f64>, truth: &Planes<f64>| {
            depth_smoothness(depth, &alpha, truth, 1.0, &mut Planes::new(1, 6, 6), &mut Planes::new(1, 6, 6))
        };
        assert_eq!(cost(&step(0), &step(3)), 0.0);
        assert!(cost(&step(3), &step(3)) < 1e-3 * cost(&step(3), &step(0)));
        // Whatever the unit of depth.
        let mut far = step(3);
        far.data.iter_mut().for_each(|d| *d *= 1000.0);
        assert!((cost(&far, &step(0)) - cost(&step(3), &step(0))).abs() < 1e-12);
        assert_eq!(total_variation(&step(3), 1.0, &mut Planes::new(1, 6, 6)), 6.0 / 36.0);
    }
}
