//! Position noise: after every step, positions of nearly transparent Gaussians get noise, so that they explore. Source:
//! Kheradmand et al. 2024 (3DGS as MCMC) §3.

use splat4d::layers::{Layer, Scene};
use splat4d::math::{Real, Rng, sym3};
use splat4d::motion::for_rows;
use splat4d::render::ResidentNoise;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, Grads, Rows, Space};

/// Opaque Gaussians get less than a ten-thousandth of the noise: too little for three normal numbers.
const LEAST_GATE: f64 = 1e-4;
/// Extent at which the published weights of 3DGS as MCMC apply unchanged, scene units: that of NeRF's synthetic
/// captures.
pub(crate) const MCMC_EXTENT: f64 = 4.4;
/// Slope of the sigmoid that ends the noise above the dead opacity (Kheradmand et al. 2024).
const NOISE_SLOPE: f64 = 100.0;

/// Noise on the positions of the Gaussians that took part in a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Its strength, times the rate of positions.
    pub strength: f64,
    /// Stages that begin after this many steps, where densification has ended, have none.
    pub until: usize,
}

impl Noise {
    /// Noise of this strength at [`MCMC_EXTENT`], for cameras of another extent.
    pub(crate) fn new(strength: f64, until: usize, extent: f64) -> Self {
        // A shift is covariance times rate, scene units³: only against the extent does it not depend on the unit.
        Self { strength: strength * (MCMC_EXTENT / extent).powi(2), until }
    }

    /// The same as the steps `from..to` of a stage see it.
    #[must_use]
    pub(crate) fn part(self, from: usize, to: usize) -> Option<Self> {
        let until = self.until.min(to).saturating_sub(from);
        (self.until > from).then_some(Self { until, ..self })
    }

    /// The same for a device that keeps a layer's tables; none: there is no noise to add. `rng` is the layer's.
    pub(crate) fn kept(&self, rate: f64, min_opacity: f64, rng: Rng) -> Option<ResidentNoise> {
        let (strength, limit) = (rate * self.strength, limit(min_opacity));
        (strength != 0.0).then_some(ResidentNoise { strength, dead: min_opacity, slope: NOISE_SLOPE, limit, rng })
    }

    /// Shakes the rows that are active in `d`; `rate`: that of a layer's positions, where they learn. `rng` is the
    /// step's.
    pub(crate) fn add(
        &self,
        scene: &mut Scene<f32>,
        d: &[Grads<f32>],
        rate: impl Fn(usize) -> Option<f64>,
        min_opacity: f64,
        rng: Rng,
    ) {
        for (index, (layer, d)) in scene.layers.iter_mut().zip(d).enumerate() {
            let Some(rate) = rate(index) else { continue };
            let active = d.active(Space::Gaussians);
            add_noise(layer, active, rate * self.strength, min_opacity, rng.fork(index as u64));
        }
    }
}

/// The logit of the opacity from which on the gate is below the least one: one comparison decides for most Gaussians.
fn limit(min_opacity: f64) -> f32 {
    let opaque = min_opacity + (1.0 / LEAST_GATE - 1.0).ln() / NOISE_SLOPE;
    if opaque < 1.0 { (opaque / (1.0 - opaque)).ln() as f32 } else { f32::INFINITY }
}

/// Adds the noise to the means of the active rows: Σ·ε·σ(−100(o − o_dead))·`strength`, ε ~ N(0, I).
fn add_noise(layer: &mut Layer<f32>, active: &[bool], strength: f64, min_opacity: f64, rng: Rng) {
    if strength == 0.0 {
        return;
    }
    let [geometry] = layer.params.get_mut([GEOMETRY]);
    let limit = limit(min_opacity);
    for_rows([geometry], Rows::All, |_, row, [geometry]| {
        if !active[row] || geometry.read::<1>(row, OPACITY)[0] > limit {
            return 0.0;
        }
        let g = geometry.read::<11>(row, 0);
        let gate = (-NOISE_SLOPE * (f64::from(g[OPACITY]).sigmoid() - min_opacity)).sigmoid();
        let c = sym3::from_quat_log_scales(
            [g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]],
            [g[LOG_SCALE], g[LOG_SCALE + 1], g[LOG_SCALE + 2]],
        )
        .map(f64::from);
        let e: [f64; 3] = std::array::from_fn(|k| rng.fork(row as u64).normal(k as u64) * gate * strength);
        let shift = [
            c[0] * e[0] + c[1] * e[1] + c[2] * e[2],
            c[1] * e[0] + c[3] * e[1] + c[4] * e[2],
            c[2] * e[0] + c[4] * e[1] + c[5] * e[2],
        ];
        geometry.add(row, 0, shift.map(|x| x as f32));
        0.0
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::maintenance::tests::scene;

    #[test]
    fn noise_spares_opaque_and_inactive_gaussians() {
        let mut s = scene(20);
        (0..20).for_each(|r| s.layers[0].params[GEOMETRY].set(r, OPACITY, if r < 10 { -5.5 } else { 2.0 }));
        let before = s.layers[0].params[GEOMETRY].clone();
        let active: Vec<bool> = (0..20).map(|r| r % 2 == 0).collect();
        add_noise(&mut s.layers[0], &active, 1.0, 0.005, Rng::new(0, "noise", 0));
        for r in 0..20 {
            let moved = s.layers[0].params[GEOMETRY].get(r, 0) != before.get(r, 0);
            assert_eq!(moved, r < 10 && r % 2 == 0, "row {r}");
        }
    }
}
