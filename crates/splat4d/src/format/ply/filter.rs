//! The 3D smoothing filter of Mip-Splatting, which limits how fine a Gaussian may be for the cameras that saw it.
//!
//! Files of a training store unfiltered Gaussians and the filter's size σ in a column of its own; renderers use scales
//! √(s² + σ²) and alphas α·√(|Σ| / |Σ + σ²I|). Source: Yu et al. 2024, Mip-Splatting, equation 9.

use crate::format::mend::OPAQUE;
use crate::scene::params::{LOG_SCALE, OPACITY};
use crate::scene::table::Table;

/// Applies the filter to all rows; `size` is σ in scene units. Rows that hold NaN or infinity, or no filter, stay.
pub(super) fn apply(geometry: &mut Table, size: impl Fn(usize) -> f64) {
    for row in 0..geometry.rows() {
        let filter = size(row);
        let logs = geometry.read::<3>(row, LOG_SCALE).map(f64::from);
        let logit = f64::from(geometry.get(row, OPACITY));
        if !(filter.is_finite() && filter > 0.0 && logit.is_finite() && logs.iter().all(|s| s.is_finite())) {
            continue;
        }
        let wider = logs.map(|s| 0.5 * ((2.0 * s).exp() + filter * filter).ln());
        let share: f64 = (0..3).map(|k| logs[k] - wider[k]).sum::<f64>().exp();
        let alpha = share / (1.0 + (-logit).exp());
        let opaque = f64::from(OPAQUE);
        geometry.write(row, LOG_SCALE, wider.map(|s| s as f32));
        geometry.set(row, OPACITY, (alpha / (1.0 - alpha)).ln().clamp(-opaque, opaque) as f32);
    }
}
