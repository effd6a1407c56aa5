//! The cross-fade of two layers that show the same: o becomes 1 − (1 − o)^s in the layer that fades in and 1 − (1 −
//! o)^(1−s) in the one that fades out, so that the light that both transmit, (1 − o)^s (1 − o)^(1−s), equals that of
//! one of them. Linear opacities o·s and o·(1 − s) would let a quarter of the background through an opaque surface
//! half-way.
//!
//! It holds where a splat is densest. Around that its alpha is o'g, and two coinciding splats let through (1 − o₁g)(1 −
//! o₂g), which is less than 1 − og by o₁o₂g(1 − g): never more transparent, and broader by at most a quarter of o₁o₂.
//! No pair of opacities does better at every g; only a cut does.

use super::Layer;
use crate::math::Real;
use crate::motion::lanes::{Batch, Work, fill};
use crate::scene::splats::SPLAT_OPACITY;
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, Rows, Table, Time};

/// Smallest transmittance, because its logarithm is needed.
const LEAST: f64 = 1e-12;

impl<F: Real> Layer<F> {
    /// Share s of the layer at a time within its span, and ds/dt.
    pub(super) fn fade_share(&self, t: Time) -> (f64, f64) {
        let ends = [t.0 - self.span[0], self.span[1] - t.0];
        let side = |k: usize| {
            let share = ends[k] / self.cross_fade[k];
            if self.cross_fade[k] > 0.0 && share < 1.0 {
                (share.max(0.0), [1.0, -1.0][k] / self.cross_fade[k])
            } else {
                (1.0, 0.0)
            }
        };
        let ([rise, fall], [d_rise, d_fall]) = ([side(0).0, side(1).0], [side(0).1, side(1).1]);
        (rise * fall, d_rise * fall + rise * d_fall)
    }

    /// Whether it ever cross-fades.
    pub(crate) fn cross_fades(&self) -> bool {
        self.cross_fade != [0.0; 2]
    }
}

/// Fades the opacities of `out` to the share s; `faded`: [splats, 2], the derivatives by opacity and by share.
pub(super) fn forward<F: Real>(share: F, out: &mut Table<F>, faded: &mut Table<F>) {
    if faded.width() == 0 {
        *faded = Table::new(&[("opacity", 1), ("share", 1)], 0);
    }
    faded.resize(out.rows());
    fill(&Forward { share }, [out, faded], Rows::All);
}

struct Forward<F> {
    share: F,
}

impl<F: Real> Work<F, 2> for Forward<F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out, faded]: &mut [TableMut<'_, F>; 2]) -> f64 {
        let [opacity] = batch.lanes(out, SPLAT_OPACITY);
        let (mut next, mut by_opacity, mut by_share) = ([F::ZERO; BLOCK], [F::ZERO; BLOCK], [F::ZERO; BLOCK]);
        for l in 0..BLOCK {
            let log = (F::ONE - opacity[l]).max(F::of(LEAST)).ln();
            let through = (self.share * log).exp();
            next[l] = F::ONE - through;
            by_opacity[l] = self.share * (through * (-log).exp());
            by_share[l] = -through * log;
        }
        batch.write(out, SPLAT_OPACITY, &[next]);
        batch.write(faded, 0, &[by_opacity, by_share]);
        0.0
    }
}

/// The VJP of [`forward`]: `d` becomes `d_out` with the gradient to the opacity before it; returns dL/ds.
pub(super) fn backward<F: Real>(d_out: &Table<F>, faded: &Table<F>, d: &mut Table<F>) -> f64 {
    *d = d_out.zeros_like();
    fill(&Backward { d_out, faded }, [d], Rows::All);
    (0..d_out.rows()).map(|j| (d_out.get(j, SPLAT_OPACITY) * faded.get(j, 1)).f64()).sum()
}

struct Backward<'a, F> {
    d_out: &'a Table<F>,
    faded: &'a Table<F>,
}

impl<F: Real> Work<F, 1> for Backward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [d]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let mut rows: [[F; BLOCK]; SPLAT_OPACITY + 1] = batch.at.read(self.d_out, 0);
        let [by_opacity] = batch.at.read::<F, 1>(self.faded, 0);
        for l in 0..BLOCK {
            rows[SPLAT_OPACITY][l] *= by_opacity[l];
        }
        batch.write(d, 0, &rows);
        0.0
    }
}

#[cfg(test)]
mod tests {
    use crate::layers::{Evaluation, Layer, LayerTape, Scene};
    use crate::math::{Rng, Se3};
    use crate::motion::{Cache, Still};
    use crate::render::{Image, RenderConfig, Shot, oracle};
    use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
    use crate::scene::splats::SPLAT_OPACITY;
    use crate::scene::{Camera, GEOMETRY, Grads, LifeKind, Params, Rows, SH, Space, SplatGrads, Time};
    use std::sync::Arc;

    const SIZE: usize = 12;
    const ROWS: usize = 5;

    /// Gaussians behind one another, as large as `log_scale` states.
    fn layer(log_scale: f64) -> Layer<f64> {
        let mut params = Params::new(ROWS, 1, LifeKind::Infinite.columns());
        for i in 0..ROWS {
            let rng = Rng::new(3, "fade", i as u64);
            let g = &mut params[GEOMETRY];
            g.write(i, 0, [0.1 * rng.normal(0), 0.1 * rng.normal(1), 2.0 + i as f64]);
            g.write(i, QUAT, [1.0, 0.0, 0.0, 0.0]);
            g.write(i, LOG_SCALE, [log_scale, log_scale, -4.0]);
            g.set(i, OPACITY, 1.5 + rng.normal(2));
            (0..3).for_each(|k| params[SH].set(i, k, rng.normal(3 + k as u64)));
        }
        Layer::new("a", params, Arc::new(Still), LifeKind::Infinite)
    }

    /// Two layers of which the first fades out while the other fades in, from 1 to 2 seconds.
    fn pair(log_scale: f64) -> Scene<f64> {
        let going = Layer { span: [0.0, 2.0], cross_fade: [0.0, 1.0], ..layer(log_scale) };
        let coming = Layer { span: [1.0, 3.0], cross_fade: [1.0, 0.0], ..layer(log_scale) };
        Scene { layers: vec![going, coming], clip: [0.0, 3.0], ..Scene::default() }
    }

    fn drawn(scene: &Scene<f64>, t: f64) -> Image<f64> {
        let mut seen = Evaluation::default();
        scene.at(Time(t), &mut seen);
        let (splats, camera) = (scene.splats(&seen), Camera::with_fov_y(Se3::IDENTITY, 0.9, SIZE, SIZE));
        // Without the blend's shortcuts, which cut at other positions where a splat is in two parts.
        let config = RenderConfig { alpha_min: 0.0, transmittance_min: 0.0, ..RenderConfig::default() };
        oracle::render(&Shot::new(&splats, &camera, [0.2, 0.5, 0.7]), &config)
    }

    fn apart(a: &Image<f64>, b: &Image<f64>) -> f64 {
        a.color.data.iter().zip(&b.color.data).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    #[test]
    fn cross_faded_equal_layers_render_equally() {
        // So large that every pixel sees a splat's centre.
        let wide = pair(12.0);
        let one = drawn(&wide, 0.5);
        for k in 0..=20 {
            let t = 1.0 + 0.05 * f64::from(k);
            let off = apart(&drawn(&wide, t), &one);
            assert!(off < 1e-6, "at {t} s: {off}");
        }
        let mut naive = pair(12.0);
        for layer in &mut naive.layers {
            (layer.span, layer.cross_fade) = ([0.0, 3.0], [0.0; 2]);
            let g = &mut layer.params[GEOMETRY];
            for i in 0..ROWS {
                let half = 0.5 / (1.0 + (-g.get(i, OPACITY)).exp());
                g.set(i, OPACITY, (half / (1.0 - half)).ln());
            }
        }
        assert!(apart(&drawn(&naive, 1.5), &one) > 0.05, "half of each is less than one");
    }

    #[test]
    fn around_their_centres_coinciding_splats_are_never_more_transparent() {
        let scene = pair(-2.0);
        let one = drawn(&scene, 0.5);
        let half = drawn(&scene, 1.5);
        let mut broader = 0.0f64;
        for (one, half) in one.alpha.data.iter().zip(&half.alpha.data) {
            assert!(half - one > -1e-9 && half - one < 0.25, "{one} {half}");
            broader = broader.max(half - one);
        }
        assert!(broader > 1e-3, "the bound is not idle");
    }

    #[test]
    fn opacity_and_time_have_the_gradient_of_the_value() {
        let layer = pair(-1.0).layers.swap_remove(1);
        for t in [1.3, 1.9, 2.5] {
            let value = |layer: &Layer<f64>, t: f64| {
                let mut tape = LayerTape::default();
                tape.request(Space::Gaussians, Rows::All, Time(t));
                layer.at(&Cache::default(), &mut tape);
                (0..ROWS).map(|j| (1.0 + j as f64) * tape.out().get(j, SPLAT_OPACITY)).sum::<f64>()
            };
            let mut tape = LayerTape::default();
            tape.request(Space::Gaussians, Rows::All, Time(t));
            layer.at(&Cache::default(), &mut tape);
            let mut d_out = tape.out().zeros_like();
            (0..ROWS).for_each(|j| d_out.set(j, SPLAT_OPACITY, 1.0 + j as f64));
            let mut d = Grads::new(&layer.params);
            let d_out = SplatGrads { out: &d_out, color: None, weights: None };
            let d_time = layer.backward(&Cache::default(), &mut tape, &d_out, &mut Cache::default(), &mut d);
            let h = 1e-6;
            let fd = (value(&layer, t + h) - value(&layer, t - h)) / (2.0 * h);
            assert!((d_time - fd).abs() < 1e-7 * (1.0 + fd.abs()), "dt at {t}: {d_time} {fd}");
            for row in 0..ROWS {
                let at = |by: f64| {
                    let mut moved = layer.clone();
                    *moved.params[GEOMETRY].get_mut(row, OPACITY) += by;
                    value(&moved, t)
                };
                let (fd, got) = ((at(h) - at(-h)) / (2.0 * h), d.table(GEOMETRY).get(row, OPACITY));
                assert!((fd - got).abs() < 1e-7 * (1.0 + fd.abs()), "row {row} at {t}: {got} {fd}");
            }
        }
    }
}
