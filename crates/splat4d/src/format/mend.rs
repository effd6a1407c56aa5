//! Values at the edge of what files of Gaussians hold: infinities that mean something, and numbers that cannot be the
//! logarithms and logits that a format has.

use super::warnings::Warnings;
use crate::layers::Layer;
use crate::math::se3::{norm, sub};
use crate::math::{median, median_by};
use crate::scene::params::{LOG_SCALE, OPACITY};
use crate::scene::{GEOMETRY, Params};

/// The logit of an opaque Gaussian (α = 1 − 10⁻⁷, one f32 step below 1), and with a minus sign of an invisible one: the
/// true ones are infinite.
const OPAQUE: f32 = 16.0;
/// The logarithm of the thickness of a flat Gaussian: 2·10⁻⁹ scene units, whose square is still a normal f32.
const FLAT: f32 = -20.0;

/// How many Gaussians held an infinity that means something, and were given the nearest finite value.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mended {
    /// Opacity +∞, the logit of 1: opaque.
    pub opaque: usize,
    /// Opacity −∞, the logit of 0: never seen.
    pub invisible: usize,
    /// A scale of −∞, the logarithm of 0: flat.
    pub flat: usize,
}

impl std::ops::AddAssign for Mended {
    fn add_assign(&mut self, other: Self) {
        self.opaque += other.opaque;
        self.invisible += other.invisible;
        self.flat += other.flat;
    }
}

impl Mended {
    /// Clamps such values of `params`.
    pub(super) fn of(params: &mut Params) -> Self {
        let mut out = Self::default();
        let table = &mut params[GEOMETRY];
        for row in 0..table.rows() {
            let opacity = table.get(row, OPACITY);
            if opacity.is_infinite() {
                table.set(row, OPACITY, OPAQUE.copysign(opacity));
                *(if opacity > 0.0 { &mut out.opaque } else { &mut out.invisible }) += 1;
            }
            let flat =
                (LOG_SCALE..LOG_SCALE + 3).filter(|&c| table.get(row, c) == f32::NEG_INFINITY).collect::<Vec<_>>();
            out.flat += usize::from(!flat.is_empty());
            flat.into_iter().for_each(|c| table.set(row, c, FLAT));
        }
        out
    }

    /// Says so.
    pub(super) fn say(&self, of: usize, warnings: &mut Warnings) {
        warnings.counted(self.opaque, of, "have opacity +infinity: they are opaque");
        warnings.counted(self.invisible, of, "have opacity -infinity: their alpha is 0, they are never seen");
        warnings.counted(self.flat, of, "have a scale of -infinity: they are flat");
    }
}

/// Values that a program stored as they are, where the format has logarithms and logits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Linear {
    /// Scales are lengths.
    Scales,
    /// Opacities are alphas from 0 to 1.
    Opacities,
}

impl Linear {
    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Linear::Scales => "scales",
            Linear::Opacities => "opacities",
        }
    }
}

/// Fewer Gaussians are no evidence.
const FEW: usize = 20;
/// Of scenes of logarithms, hardly a Gaussian is as large as the inner half of the scene; of lengths read as logarithms,
/// e^s ≥ 1, most are wherever the scene is not far larger than a unit.
const MOST: f64 = 0.5;
/// In larger scenes: lengths of which the largest (95 %) are this many times the smallest (5 %) ...
const SPREAD: f32 = 10.0;
/// ... while as logarithms they would all be within this factor of one unit. No trained scene has such sizes.
const ONE_SIZE: f32 = std::f32::consts::E;

/// What the values of a layer suggest is stored as it is. Evidence, not proof: nothing is converted.
pub(super) fn doubts(params: &Params) -> Vec<(Linear, String)> {
    let (table, n) = (&params[GEOMETRY], params.len());
    let mut out = Vec::new();
    if n < FEW {
        return out;
    }
    let rows: Vec<usize> = (0..n).filter(|&r| table.read::<11>(r, 0).iter().all(|x| x.is_finite())).collect();
    if rows.len() < FEW {
        return out;
    }
    let radius = radius(params, &rows);
    let largest = |r: usize| table.read::<3>(r, LOG_SCALE).into_iter().fold(f32::NEG_INFINITY, f32::max);
    let positive = rows.iter().all(|&r| table.read::<3>(r, LOG_SCALE).iter().all(|s| *s >= 0.0));
    let huge = rows.iter().filter(|&&r| f64::from(largest(r)).exp() > radius).count();
    let fitting = rows.iter().filter(|&&r| f64::from(largest(r)) < radius).count();
    let share = |count: usize| count as f64 / rows.len() as f64;
    let mut sizes: Vec<f32> = rows.iter().flat_map(|&r| table.read::<3>(r, LOG_SCALE)).collect();
    sizes.sort_by(f32::total_cmp);
    let [low, high] = [sizes[sizes.len() / 20], sizes[sizes.len() - 1 - sizes.len() / 20]];
    let one_size = high.exp() < ONE_SIZE && high > SPREAD * low;
    if positive && share(fitting) > MOST && (share(huge) > MOST || one_size) {
        let what = format!(
            "scales are all above zero: as logarithms, {huge} of {} Gaussians would be larger than the scene and none smaller \
             than a unit. They look like lengths",
            rows.len()
        );
        out.push((Linear::Scales, what));
    }
    let opacity = |&r: &usize| table.get(r, OPACITY);
    let (low, high) =
        rows.iter().map(opacity).fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), o| (l.min(o), h.max(o)));
    // Logits of trained scenes spread far to both sides of zero; a single value may be anything.
    if low >= 0.0 && high <= 1.0 && low < high {
        let what = format!("opacities lie between {low:.3} and {high:.3}: they look like alphas, not logits");
        out.push((Linear::Opacities, what));
    }
    out
}

/// The median distance of the means from their median.
fn radius(params: &Params, rows: &[usize]) -> f64 {
    let table = &params[GEOMETRY];
    let means: Vec<[f64; 3]> = rows.iter().map(|&r| table.read::<3>(r, 0).map(f64::from)).collect();
    let of = |mut values: Vec<f64>| median(&mut values).expect("there are rows");
    let middle = std::array::from_fn(|k| of(means.iter().map(|m| m[k]).collect()));
    of(means.iter().map(|m| norm(sub(*m, middle))).collect())
}

/// Reads values that are stored as they are: lengths become logarithms, alphas logits. Says what was out of range.
pub fn from_linear(layer: &mut Layer<f32>, what: Linear) -> Warnings {
    let mut warnings = Warnings::default();
    let (table, mut outside) = (&mut layer.params[GEOMETRY], 0);
    let rows = table.rows();
    for row in 0..rows {
        match what {
            Linear::Scales => {
                let lengths = table.read::<3>(row, LOG_SCALE);
                outside += usize::from(lengths.iter().any(|s| *s < 0.0));
                table.write(row, LOG_SCALE, lengths.map(|s| s.max(0.0).ln().max(FLAT)));
            }
            Linear::Opacities => {
                let alpha = table.get(row, OPACITY);
                outside += usize::from(!(0.0..=1.0).contains(&alpha));
                let alpha = alpha.clamp(0.0, 1.0);
                table.set(row, OPACITY, (alpha / (1.0 - alpha)).ln().clamp(-OPAQUE, OPAQUE));
            }
        }
    }
    let range = match what {
        Linear::Scales => "have a scale below 0, which is read as 0",
        Linear::Opacities => "have an opacity outside 0 to 1, which is clamped",
    };
    warnings.counted(outside, rows, range);
    warnings
}

/// Share of the median Gaussian's size above which an error of positions causes a warning: a tenth of σ is invisible.
pub(super) const VISIBLE: f64 = 0.1;

/// The size (largest σ) of the median Gaussian; none where there is none that is finite.
pub(super) fn median_size(params: &Params) -> Option<f64> {
    let table = &params[GEOMETRY];
    let largest = |row: usize| table.read::<3>(row, LOG_SCALE).into_iter().fold(f32::NEG_INFINITY, f32::max);
    let mut sizes: Vec<f32> = (0..table.rows()).map(largest).filter(|s| s.is_finite()).collect();
    median_by(&mut sizes, f32::total_cmp).map(|size| f64::from(size).exp())
}

/// Says how coarse f32 is at the largest coordinates, where that shows.
pub(super) fn say_coarse(params: &Params, warnings: &mut Warnings) {
    let table = &params[GEOMETRY];
    let far = (0..table.rows()).flat_map(|r| table.read::<3>(r, 0)).filter(|x| x.is_finite());
    let far = far.fold(0.0f32, |m, x| m.max(x.abs()));
    let (step, Some(size)) = (f64::from(far.next_up()) - f64::from(far), median_size(params)) else { return };
    if step > VISIBLE * size {
        warnings.say(format!(
            "positions reach {far}, where single precision has steps of {step:.2e}: {:.2} of the size of the median Gaussian. \
             Export them relative to the scene's middle, or in double precision",
            step / size
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::dialect::still;
    use crate::format::samples::gaussians;

    #[test]
    fn infinities_that_mean_something_become_finite_and_are_counted() {
        let mut p = gaussians(5, 3);
        p[GEOMETRY].set(0, OPACITY, f32::INFINITY);
        p[GEOMETRY].set(1, OPACITY, f32::NEG_INFINITY);
        p[GEOMETRY].set(2, LOG_SCALE + 1, f32::NEG_INFINITY);
        p[GEOMETRY].set(3, LOG_SCALE, f32::INFINITY);
        let mended = Mended::of(&mut p);
        assert_eq!(mended, Mended { opaque: 1, invisible: 1, flat: 1 });
        let g = &p[GEOMETRY];
        assert_eq!((g.get(0, OPACITY), g.get(1, OPACITY), g.get(2, LOG_SCALE + 1)), (OPAQUE, -OPAQUE, FLAT));
        assert!(g.get(3, LOG_SCALE).is_infinite(), "an infinite size is damage");
        let mut warnings = Warnings::default();
        mended.say(5, &mut warnings);
        assert_eq!(warnings.lines().len(), 3);
        assert_eq!(Mended::of(&mut p), Mended::default());
    }

    #[test]
    fn lengths_and_alphas_are_doubted_and_read_on_request() {
        let logs = gaussians(200, 8);
        assert!(doubts(&logs).is_empty(), "{:?}", doubts(&logs));
        let mut linear = logs.clone();
        for row in 0..200 {
            let scale = logs[GEOMETRY].read::<3>(row, LOG_SCALE).map(f32::exp);
            linear[GEOMETRY].write(row, LOG_SCALE, scale);
            let alpha = 1.0 / (1.0 + (-logs[GEOMETRY].get(row, OPACITY)).exp());
            linear[GEOMETRY].set(row, OPACITY, alpha);
        }
        let found: Vec<Linear> = doubts(&linear).into_iter().map(|d| d.0).collect();
        assert_eq!(found, [Linear::Scales, Linear::Opacities]);
        let mut layer = still(linear).layers.remove(0);
        for what in found {
            assert!(from_linear(&mut layer, what).lines().is_empty());
        }
        for row in 0..200 {
            let (a, b) = (logs[GEOMETRY].read::<11>(row, 0), layer.params[GEOMETRY].read::<11>(row, 0));
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 2e-3 * (1.0 + a.abs())), "{a:?} {b:?}");
        }
        assert!(doubts(&layer.params).is_empty());
        layer.params[GEOMETRY].set(0, OPACITY, 1.5);
        assert!(from_linear(&mut layer, Linear::Opacities).lines()[0].contains("outside 0 to 1"));
    }

    #[test]
    fn coarse_coordinates_are_reported_only_where_they_show() {
        let mut p = gaussians(50, 2);
        let mut warnings = Warnings::default();
        say_coarse(&p, &mut warnings);
        assert!(warnings.lines().is_empty());
        (0..50).for_each(|row| p[GEOMETRY].add(row, 0, [5.4e6]));
        say_coarse(&p, &mut warnings);
        assert!(warnings.lines()[0].contains("steps of 5.00e-1"), "{warnings:?}");
    }
}
