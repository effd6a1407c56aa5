//! Values at the edge of what files of Gaussians hold: infinities that mean something, and coordinates that single
//! precision cannot hold.

use super::warnings::Warnings;
use crate::math::median_by;
use crate::scene::params::{LOG_SCALE, OPACITY};
use crate::scene::{GEOMETRY, Params};

/// The logit of an opaque Gaussian (α = 1 − 10⁻⁷, one f32 step below 1), and with a minus sign of an invisible one: the
/// true ones are infinite.
pub(super) const OPAQUE: f32 = 16.0;
/// The logarithm of the thickness of a flat Gaussian: 2·10⁻⁹ scene units, whose square is still a normal f32.
pub(super) const FLAT: f32 = -20.0;

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

    /// Reports it.
    pub(super) fn report(&self, of: usize, warnings: &mut Warnings) {
        warnings.counted(self.opaque, of, "have opacity +infinity: they are opaque");
        warnings.counted(self.invisible, of, "have opacity -infinity: their alpha is 0, they are never visible");
        warnings.counted(self.flat, of, "have a scale of -infinity: they are flat");
    }
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

/// Reports how coarse f32 is at the largest coordinates, where that is visible.
pub(super) fn warn_coarse(params: &Params, warnings: &mut Warnings) {
    let table = &params[GEOMETRY];
    let far = (0..table.rows()).flat_map(|r| table.read::<3>(r, 0)).filter(|x| x.is_finite());
    let far = far.fold(0.0f32, |m, x| m.max(x.abs()));
    let (step, Some(size)) = (f64::from(far.next_up()) - f64::from(far), median_size(params)) else { return };
    if step > VISIBLE * size {
        warnings.add(format!(
            "positions reach {far}, where single precision has steps of {step:.2e}: {:.2} of the size of the median Gaussian. \
             Export them relative to the scene's middle, or in double precision",
            step / size
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::samples::gaussians;

    #[test]
    fn meaningful_infinities_become_finite_and_are_counted() {
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
        mended.report(5, &mut warnings);
        assert_eq!(warnings.lines().len(), 3);
        assert_eq!(Mended::of(&mut p), Mended::default());
    }

    #[test]
    fn coarse_coordinates_are_reported_only_if_visible() {
        let mut p = gaussians(50, 2);
        let mut warnings = Warnings::default();
        warn_coarse(&p, &mut warnings);
        assert!(warnings.lines().is_empty());
        (0..50).for_each(|row| p[GEOMETRY].add(row, 0, [5.4e6]));
        warn_coarse(&p, &mut warnings);
        assert!(warnings.lines()[0].contains("steps of 5.00e-1"), "{warnings:?}");
    }
}
