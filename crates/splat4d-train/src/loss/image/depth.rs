//! Known depth: the rendered depth of a pixel equals that of the capture's depth map, where the map has it.

use super::{ImageTerm, LossGrads, Needs, SEEN, Shown, View, expected_depth_backward, over_rows};
use crate::capture::DepthKind;
use crate::capture::frames::DepthTruth;
use crate::loss::terms::StepInfo;
use splat4d::math::{Real, median_by};
use splat4d::scene::Planes;

/// [`depth`] of views that have depth, times a weight that falls to [`LAST`] of it by the end: a map that is wrong
/// bends the scene early, and images decide in the end.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Depth(pub f64);

/// Of the weight, what is left of it at the end of a stage (Kerbl et al. 2024 end at 0.01; ground truth deserves more
/// than that).
const LAST: f64 = 0.1;

impl<F: Real> ImageTerm<F> for Depth {
    fn needs(&self, view: &View<'_, F>) -> Needs {
        Needs { depth: view.depth.is_some(), extra: Vec::new() }
    }

    fn applies_to(&self, view: &View<'_, F>) -> bool {
        view.depth.is_some()
    }

    fn eval(&mut self, info: &StepInfo, view: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64 {
        let Some(truth) = view.depth else { return 0.0 };
        let weight = self.0 * LAST.powf(info.progress);
        depth([shown.depth, shown.alpha], truth, weight, [d.depth.add(), d.alpha.add()])
    }
}

/// [`depth`] of views that have measured geometry, with the same weight during the whole run: a scan is right where it
/// has a surface, and errors of it are few and large, which the penalty bounds.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Measured(pub f64);

impl<F: Real> ImageTerm<F> for Measured {
    fn needs(&self, view: &View<'_, F>) -> Needs {
        Needs { depth: view.measured.is_some(), extra: Vec::new() }
    }

    fn applies_to(&self, view: &View<'_, F>) -> bool {
        view.measured.is_some()
    }

    fn eval(&mut self, _: &StepInfo, view: &View<'_, F>, shown: &Shown<'_, F>, d: &mut LossGrads<F>) -> f64 {
        let Some(truth) = view.measured else { return 0.0 };
        depth([shown.depth, shown.alpha], truth, self.0, [d.depth.add(), d.alpha.add()])
    }
}

/// Errors below this cost their square: of a logarithm a hundredth of the distance; of standardised depth as much of
/// its spread.
const SOFT: f64 = 0.01;
/// Depth that varies by less than this share of its mean has no shape to compare.
const FLAT: f64 = 1e-6;

/// √(e² + ε²) − ε and its slope (Charbonnier).
fn charbonnier<F: Real>(e: F) -> (F, F) {
    let soft = F::of(SOFT);
    let root = (e * e + soft * soft).sqrt();
    (root - soft, e / root)
}

/// Mean over pixels of known depth that show something of ρ(e), ρ the Charbonnier penalty, D = Σ z α T / A the expected
/// depth. Metric: e = ln D − ln D*. Up to scale and shift: e is the difference of D (or 1/D) and the map, each less its
/// mean and over its standard deviation in these pixels; exactly differentiated, since a scale and a shift that are
/// fitted to the map and then held would reward a rendering without any shape. No unit.
///
/// Shapes: `pictures` Σ z α T and A, [1, h, w]; `d` adds up their gradients.
/// Sources: Ranftl et al. 2020 (MiDaS) for invariance to scale and shift, with moments for medians; Li et al. 2021
/// (NSFF) for its use on moving scenes.
pub(crate) fn depth<F: Real>(
    [depth, alpha]: [&Planes<F>; 2],
    truth: DepthTruth<'_, F>,
    weight: f64,
    [d_depth, d_alpha]: [&mut Planes<F>; 2],
) -> f64 {
    let n = depth.pixels();
    assert!([alpha.data.len(), truth.values.data.len(), d_depth.data.len()] == [n; 3], "depth has {n} pixels");
    let floor = F::of(SEEN);
    let expected: Vec<F> = depth.data.iter().zip(&alpha.data).map(|(&d, &a)| d / a.max(floor)).collect();
    let pixels = compared(&expected, &alpha.data, truth.values);
    if pixels.is_empty() {
        return 0.0;
    }
    let mut d = vec![F::ZERO; n];
    let scale = weight / pixels.len() as f64;
    let value = match truth.kind {
        DepthKind::Metric => {
            let mut counts = vec![false; n];
            pixels.iter().for_each(|&p| counts[p] = true);
            scale
                * over_rows(&mut d, depth.width, |y, d| {
                    let mut sum = 0.0;
                    for (x, d) in d.iter_mut().enumerate() {
                        let p = y * depth.width + x;
                        if counts[p] {
                            let (value, slope) = charbonnier((expected[p] / truth.values.data[p]).ln());
                            sum += value.f64();
                            *d = F::of(scale) * slope / expected[p];
                        }
                    }
                    sum
                })
        }
        kind => {
            let seen = |p: usize| if kind == DepthKind::Inverse { F::ONE / expected[p] } else { expected[p] };
            let Some((drawn, spread)) = standardised(pixels.iter().map(|&p| seen(p)).collect()) else { return 0.0 };
            let Some((known, _)) = standardised(pixels.iter().map(|&p| truth.values.data[p]).collect()) else {
                return 0.0;
            };
            let (mut sum, mut slopes) = (0.0, Vec::with_capacity(pixels.len()));
            for (a, b) in drawn.iter().zip(&known) {
                let (value, slope) = charbonnier(*a - *b);
                sum += value.f64();
                slopes.push(slope);
            }
            // Through the standardisation: g − mean(g) − x mean(g x), over the spread.
            let count = F::of(pixels.len() as f64);
            let mean: F = slopes.iter().copied().sum::<F>() / count;
            let along: F = slopes.iter().zip(&drawn).map(|(g, x)| *g * *x).sum::<F>() / count;
            for ((&p, g), x) in pixels.iter().zip(&slopes).zip(&drawn) {
                let back = F::of(scale) * (*g - mean - *x * along) / spread;
                let e = expected[p];
                d[p] = if kind == DepthKind::Inverse { -back / (e * e) } else { back };
            }
            scale * sum
        }
    };
    expected_depth_backward(&expected, &alpha.data, floor, &d, &mut d_depth.data, &mut d_alpha.data);
    value
}

/// The pixels that show something whose depth is known.
fn compared<F: Real>(expected: &[F], alpha: &[F], truth: &Planes<F>) -> Vec<usize> {
    let counts = |&p: &usize| alpha[p] >= F::of(SEEN) && expected[p] > F::ZERO && truth.data[p] != F::ZERO;
    (0..expected.len()).filter(counts).collect()
}

/// Numbers less their mean and over their standard deviation, and that; `None`: they hardly differ.
fn standardised<F: Real>(mut values: Vec<F>) -> Option<(Vec<F>, F)> {
    let n = values.len() as f64;
    let mean = values.iter().map(|v| v.f64()).sum::<f64>() / n;
    let spread = (values.iter().map(|v| (v.f64() - mean).powi(2)).sum::<f64>() / n).sqrt();
    if spread <= FLAT * mean.abs() || !spread.is_finite() {
        return None;
    }
    values.iter_mut().for_each(|v| *v = (*v - F::of(mean)) / F::of(spread));
    Some((values, F::of(spread)))
}

/// Difference between rendered depth and a depth map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Apart {
    /// Of a metric map: the median of D / D*, and the median of |D / D* − 1|.
    Ratio(f64, f64),
    /// Of others: the correlation of D or 1/D and the map.
    Correlation(f64),
}

/// How far the depth of an image, Σ z α T and A, is from a map; `None`: too little of it is known.
pub(crate) fn apart([depth, alpha]: [&Planes<f32>; 2], truth: DepthTruth<'_>) -> Option<Apart> {
    /// Pixels from which on they are used.
    const ENOUGH: usize = 50;
    let expected: Vec<f32> = depth.data.iter().zip(&alpha.data).map(|(&d, &a)| d / a.max(SEEN as f32)).collect();
    let pixels = compared(&expected, &alpha.data, truth.values);
    if pixels.len() < ENOUGH {
        return None;
    }
    let known = |p: usize| truth.values.data[p];
    if truth.kind == DepthKind::Metric {
        let mut ratios: Vec<f32> = pixels.iter().map(|&p| expected[p] / known(p)).collect();
        let median = |values: &mut [f32]| f64::from(median_by(values, f32::total_cmp).expect("there are enough"));
        let ratio = median(&mut ratios);
        ratios.iter_mut().for_each(|r| *r = (*r - 1.0).abs());
        return Some(Apart::Ratio(ratio, median(&mut ratios)));
    }
    let seen = |p: usize| if truth.kind == DepthKind::Inverse { 1.0 / expected[p] } else { expected[p] };
    let (drawn, _) = standardised(pixels.iter().map(|&p| f64::from(seen(p))).collect())?;
    let (known, _) = standardised(pixels.iter().map(|&p| f64::from(known(p))).collect())?;
    Some(Apart::Correlation(drawn.iter().zip(&known).map(|(a, b)| a * b).sum::<f64>() / pixels.len() as f64))
}

#[cfg(test)]
mod tests {
    use super::super::check;
    use super::*;

    const KINDS: [DepthKind; 3] = [DepthKind::Metric, DepthKind::Relative, DepthKind::Inverse];

    fn pictures() -> [Planes<f64>; 2] {
        let mut alpha = check::planes("alpha", [1, 5, 8], 0.6, 1.0);
        alpha.data[7] = 0.3;
        let mut depth = check::planes("depth", [1, 5, 8], 1.0, 3.0);
        depth.data.iter_mut().zip(&alpha.data).for_each(|(d, a)| *d *= a);
        [depth, alpha]
    }

    fn cost(pictures: &[Planes<f64>], truth: &Planes<f64>, kind: DepthKind, d: &mut [Planes<f64>]) -> f64 {
        let [a, b] = d else { panic!("two inputs") };
        depth([&pictures[0], &pictures[1]], DepthTruth { values: truth, kind }, 0.7, [a, b])
    }

    fn zeros() -> [Planes<f64>; 2] {
        [Planes::new(1, 5, 8), Planes::new(1, 5, 8)]
    }

    #[test]
    fn gradients_equal_finite_differences_and_unknown_pixels_do_not_count() {
        let mut truth = check::planes("truth", [1, 5, 8], 1.0, 3.0);
        truth.data.iter_mut().enumerate().filter(|(i, _)| i % 5 == 0).for_each(|(_, v)| *v = 0.0);
        for kind in KINDS {
            let run = |p: &[Planes<f64>], d: &mut [Planes<f64>]| cost(p, &truth, kind, d);
            let value = check::gradients(&pictures(), run, |p| run(p, &mut zeros()));
            assert!(value > 0.05, "{kind:?}");
            let mut d = zeros();
            run(&pictures(), &mut d);
            assert!(d.iter().all(|d| d.data[5] == 0.0 && d.data[7] == 0.0), "not known, and haze");
        }
    }

    #[test]
    fn correct_depth_up_to_scale_and_shift_has_no_loss() {
        let p = pictures();
        let expected: Vec<f64> = p[0].data.iter().zip(&p[1].data).map(|(d, a)| d / a).collect();
        let map = |f: &dyn Fn(f64) -> f64| Planes { data: expected.iter().map(|z| f(*z)).collect(), ..p[0].clone() };
        let of = |truth: Planes<f64>, kind| cost(&p, &truth, kind, &mut zeros());
        let (m, r, i) = (DepthKind::Metric, DepthKind::Relative, DepthKind::Inverse);
        assert!(of(map(&|z| z), m) < 1e-12 && of(map(&|z| 2.0 * z), m) > 0.4);
        assert!(of(map(&|z| 3.0 * z - 7.0), r) < 1e-9 && of(map(&|z| 40.0 / z + 3.0), i) < 1e-9);
        // Upside down, and of the other kind.
        assert!(of(map(&|z| -z), r) > 0.5 && of(map(&|z| 1.0 / z), r) > 0.5 && of(map(&|z| z), i) > 0.5);
        // A flat map states nothing.
        assert_eq!(of(map(&|_| 2.0), r), 0.0);
    }

    #[test]
    fn maps_of_another_unit_or_upside_down_are_recognised() {
        let like = |data: Vec<f32>| Planes { channels: 1, height: 10, width: 10, data };
        let z: Vec<f32> = (0..100).map(|i| 2.0 + 0.01 * i as f32).collect();
        let (depth, alpha) = (like(z.clone()), like(vec![1.0; 100]));
        let of = |data: Vec<f32>, kind| apart([&depth, &alpha], DepthTruth { values: &like(data), kind });
        let Some(Apart::Ratio(ratio, off)) = of(z.iter().map(|z| 1000.0 * z).collect(), DepthKind::Metric) else {
            panic!("a metric map")
        };
        assert!((ratio - 1e-3).abs() < 1e-5 && off > 0.99);
        let Some(Apart::Correlation(r)) = of(z.clone(), DepthKind::Inverse) else { panic!("a relative map") };
        assert!(r < -0.9);
        assert_eq!(of(vec![0.0; 100], DepthKind::Metric), None);
    }
}
