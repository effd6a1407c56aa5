//! Flow and tracks: the rendered displacement of a pixel equals the truth, to the next frame or to any other.

use super::{Channel, ImageTerm, LossGrads, Needs, SEEN, Shown, View, over_rows};
use crate::loss::terms::StepInfo;
use splat4d::math::Real;
use splat4d::scene::Planes;

/// [`flow()`] of views that have flow, times a weight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Flow(pub f64);

impl<F: Real> ImageTerm<F> for Flow {
    fn needs(&self, view: &View<'_, F>) -> Needs {
        Needs { depth: false, extra: view.flow.map(|_| Channel::Flow).into_iter().collect() }
    }

    fn applies_to(&self, view: &View<'_, F>) -> bool {
        view.flow.is_some()
    }

    fn eval(&mut self, _: &StepInfo, view: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64 {
        let (Some(truth), Some((first, drawn))) = (&view.flow, shown.channel(&Channel::Flow)) else { return 0.0 };
        let mut d_drawn = Planes::new(3, drawn.height, drawn.width);
        let value = flow(&drawn, truth.vectors, self.0, &mut d_drawn);
        d.add_extra(first, &d_drawn);
        value
    }
}

/// [`tracks()`] of views that have tracks, times a weight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tracks(pub f64);

impl<F: Real> ImageTerm<F> for Tracks {
    fn needs(&self, view: &View<'_, F>) -> Needs {
        Needs { depth: false, extra: view.tracks.map(|_| Channel::Tracks).into_iter().collect() }
    }

    fn applies_to(&self, view: &View<'_, F>) -> bool {
        view.tracks.is_some()
    }

    fn eval(&mut self, _: &StepInfo, view: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64 {
        let (Some(truth), Some((first, drawn))) = (&view.tracks, shown.channel(&Channel::Tracks)) else { return 0.0 };
        let mut d_drawn = Planes::new(3, drawn.height, drawn.width);
        let value = tracks(&drawn, truth.vectors, self.0, &mut d_drawn);
        d.add_extra(first, &d_drawn);
        value
    }
}

/// Known flow is that of a whole pixel: of a mean of pixels all must be known.
const KNOWN: f64 = 0.999;

/// Mean over pixels of known flow that show something of ‖F − F*‖₁ over the image's longer side; F = Σ α T f / Σ α T.
///
/// Shapes: `drawn` [3, h, w] holds Σ α T f (2) and Σ α T of the splats that have an f; `d` adds up its gradient.
/// Source: SC-GS (Huang et al. 2024) and GaussianFlow (Gao et al. 2024).
pub(crate) fn flow<F: Real>(drawn: &Planes<F>, truth: &Planes<F>, weight: f64, d: &mut Planes<F>) -> f64 {
    let sign = |e: F| if e > F::ZERO { F::ONE } else { -F::ONE };
    compare(drawn, truth, weight, d, |e| (e[0].abs() + e[1].abs(), e.map(sign)))
}

/// Errors of tracks up to here cost their square, pixels.
const HUBER: f64 = 3.0;

/// Mean over pixels of tracked points that show something of h(‖F − F*‖₂) over the image's longer side, F as in
/// [`flow`] but to the time of the track's other end: r²/(2δ) to δ = 3 pixels, and r − δ/2 beyond (Huber). The surface
/// at the pixel is followed by the weights with which it is blended: the point is where these Gaussians are, and moves
/// with them.
///
/// Shapes: as [`flow`]. Source: Wang et al. 2024 (Shape of Motion), track reprojection, with Huber's penalty.
pub(crate) fn tracks<F: Real>(drawn: &Planes<F>, truth: &Planes<F>, weight: f64, d: &mut Planes<F>) -> f64 {
    let (delta, half) = (F::of(HUBER), F::of(0.5));
    compare(drawn, truth, weight, d, |e| {
        let r = (e[0] * e[0] + e[1] * e[1]).sqrt();
        if r <= delta { (half * r * r / delta, e.map(|e| e / delta)) } else { (r - half * delta, e.map(|e| e / r)) }
    })
}

/// Mean over pixels that are known and show something of a penalty of F − F*, which gives its value and slopes.
fn compare<F: Real>(
    drawn: &Planes<F>,
    truth: &Planes<F>,
    weight: f64,
    d: &mut Planes<F>,
    penalty: impl Fn([F; 2]) -> (F, [F; 2]) + Sync,
) -> f64 {
    let n = drawn.pixels();
    assert!([drawn.data.len(), truth.data.len(), d.data.len()] == [3 * n; 3], "flow has three channels of {n} pixels");
    let shows = |p: usize| drawn.plane(2)[p] >= F::of(SEEN) && truth.plane(2)[p] >= F::of(KNOWN);
    let count = (0..n).filter(|&p| shows(p)).count();
    if count == 0 {
        return 0.0;
    }
    let scale = weight / (count * drawn.width.max(drawn.height)) as f64;
    let factor = F::of(scale);
    let mut g = vec![[F::ZERO; 3]; n];
    let sum = over_rows(&mut g, drawn.width, |y, row| {
        let mut sum = 0.0;
        for (x, g) in row.iter_mut().enumerate() {
            let p = y * drawn.width + x;
            if !shows(p) {
                continue;
            }
            let w = drawn.plane(2)[p];
            let f = [0, 1].map(|k| drawn.plane(k)[p] / w);
            let (value, slopes) = penalty([f[0] - truth.plane(0)[p], f[1] - truth.plane(1)[p]]);
            sum += value.f64();
            for k in 0..2 {
                g[k] = factor * slopes[k] / w;
                g[2] -= factor * slopes[k] * f[k] / w;
            }
        }
        sum
    });
    for k in 0..3 {
        d.plane_mut(k).iter_mut().zip(&g).for_each(|(d, g)| *d += g[k]);
    }
    scale * sum
}

#[cfg(test)]
mod tests {
    use super::super::check;
    use super::*;

    #[test]
    fn gradient_equals_finite_differences_and_unknown_pixels_do_not_count() {
        let mut drawn = check::planes("drawn", [3, 5, 8], -2.0, 2.0);
        drawn.plane_mut(2).iter_mut().for_each(|w| *w = 0.7 + 0.1 * *w);
        drawn.plane_mut(2)[7] = 0.3;
        let mut truth = check::planes("truth", [3, 5, 8], -2.0, 2.0);
        truth.plane_mut(2).iter_mut().enumerate().for_each(|(i, v)| *v = f64::from(u8::from(i % 3 > 0)));
        let far = Planes { data: truth.data.iter().map(|x| 5.0 * x).collect(), ..truth.clone() };
        let far = Planes { data: [&far.data[..80], &truth.data[80..]].concat(), ..far };
        for truth in [&truth, &far] {
            let run = |p: &[Planes<f64>], d: &mut [Planes<f64>]| tracks(&p[0], truth, 0.7, &mut d[0]);
            let value = check::gradients(&[drawn.clone()], run, |p| run(p, &mut [Planes::new(3, 5, 8)]));
            assert!(value > 0.005, "near and far errors have slopes of their own");
        }
        let run = |p: &[Planes<f64>], d: &mut [Planes<f64>]| flow(&p[0], &truth, 0.7, &mut d[0]);
        let value = check::gradients(&[drawn.clone()], run, |p| run(p, &mut [Planes::new(3, 5, 8)]));
        assert!(value > 0.01);
        // What is right costs nothing.
        for p in 0..40 {
            let w = drawn.plane(2)[p];
            (0..2).for_each(|k| drawn.plane_mut(k)[p] = w * truth.plane(k)[p]);
        }
        assert!(run(&[drawn], &mut [Planes::new(3, 5, 8)]) < 1e-12);
    }
}
