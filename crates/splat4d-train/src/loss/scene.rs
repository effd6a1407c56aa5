//! Losses on a scene's raw parameters. Each is a mean over the rows that are active in the step, and adds only to them.

use super::image::entropy::binary_entropy;
use super::near::{NEIGHBOURS, Near};
use super::terms::{ParamLoss, ResidentLoss, StepInfo};
use splat4d::layers::Scene;
use splat4d::math::Real;
use splat4d::motion::for_rows;
use splat4d::render::RowWeights;
use splat4d::scene::params::{LOG_SCALE, OPACITY};
use splat4d::scene::{GEOMETRY, Grads, Rows, Space};

/// Adds `f`'s gradient over the active rows of every layer's geometry, weighted `weight`/(active rows); returns the
/// loss.
fn over_active<F: Real>(
    scene: &Scene<F>,
    d: &mut [Grads<F>],
    weight: f64,
    f: impl Fn(usize, [F; 11], usize) -> (f64, [F; 11]) + Sync,
) -> f64 {
    let mut loss = 0.0;
    for (layer, (l, d)) in scene.layers.iter().zip(d).enumerate() {
        let active = d.active(Space::Gaussians).to_vec();
        let count = active.iter().filter(|a| **a).count();
        if count == 0 {
            continue;
        }
        let scale = weight / count as f64;
        let geometry = &l.params[GEOMETRY];
        loss += scale
            * for_rows(d.of([GEOMETRY]), Rows::All, |_, row, [d_geometry]| {
                if !active[row] {
                    return 0.0;
                }
                let (value, d_row) = f(layer, geometry.read::<11>(row, 0), row);
                d_geometry.add(row, 0, d_row.map(|x| x * F::of(scale)));
                value
            });
    }
    loss
}

/// weight · mean opacity (3DGS as MCMC): frees Gaussians for relocation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MeanOpacity {
    /// λ
    pub weight: f64,
}

impl<F: Real> ParamLoss<F> for MeanOpacity {
    fn name(&self) -> &str {
        "opacity_reg"
    }

    fn kept(&self) -> Option<ResidentLoss> {
        Some(ResidentLoss::Rows(RowWeights { opacity: self.weight, ..RowWeights::default() }))
    }

    fn eval(&self, scene: &Scene<F>, _info: &StepInfo, d: &mut [Grads<F>]) -> f64 {
        over_active(scene, d, self.weight, |_, g, _| {
            let o = g[OPACITY].sigmoid();
            let mut d_row = [F::ZERO; 11];
            d_row[OPACITY] = o * (F::ONE - o);
            (o.f64(), d_row)
        })
    }
}

/// weight · mean entropy −o ln o − (1−o) ln(1−o) of opacities, nats: Gaussians are there or not.
///
/// Source: SuGaR (Guédon and Lepetit 2024).
#[derive(Clone, Copy, Debug)]
pub(crate) struct OpacityEntropy {
    /// λ
    pub weight: f64,
}

impl<F: Real> ParamLoss<F> for OpacityEntropy {
    fn name(&self) -> &str {
        "lambda_opacity_entropy"
    }

    fn kept(&self) -> Option<ResidentLoss> {
        Some(ResidentLoss::Rows(RowWeights { entropy: self.weight, ..RowWeights::default() }))
    }

    fn eval(&self, scene: &Scene<F>, _info: &StepInfo, d: &mut [Grads<F>]) -> f64 {
        over_active(scene, d, self.weight, |_, g, _| {
            let (value, slope) = binary_entropy(g[OPACITY].sigmoid());
            let o = g[OPACITY].sigmoid();
            let mut d_row = [F::ZERO; 11];
            d_row[OPACITY] = slope * o * (F::ONE - o);
            (value.f64(), d_row)
        })
    }
}

/// weight · mean scale, scene units (3DGS as MCMC).
#[derive(Clone, Copy, Debug)]
pub(crate) struct MeanScale {
    /// λ
    pub weight: f64,
}

impl<F: Real> ParamLoss<F> for MeanScale {
    fn name(&self) -> &str {
        "scale_reg"
    }

    fn kept(&self) -> Option<ResidentLoss> {
        Some(ResidentLoss::Rows(RowWeights { scale: self.weight, ..RowWeights::default() }))
    }

    fn eval(&self, scene: &Scene<F>, _info: &StepInfo, d: &mut [Grads<F>]) -> f64 {
        over_active(scene, d, self.weight, |_, g, _| {
            let mut d_row = [F::ZERO; 11];
            let mut sum = F::ZERO;
            for k in LOG_SCALE..LOG_SCALE + 3 {
                d_row[k] = g[k].exp() / F::of(3.0);
                sum += d_row[k];
            }
            (sum.f64(), d_row)
        })
    }
}

/// weight · mean over Gaussians and views of o·stopgrad[σ(t)] (FreeTimeGS §3.4): against opaque long-lived blockers.
/// Only the opacity has a gradient.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LivingOpacity {
    /// λ_reg
    pub weight: f64,
}

impl<F: Real> ParamLoss<F> for LivingOpacity {
    fn name(&self) -> &str {
        "lambda_opacity_life"
    }

    fn eval(&self, scene: &Scene<F>, info: &StepInfo, d: &mut [Grads<F>]) -> f64 {
        let lives: Vec<_> = scene.layers.iter().map(|l| l.lifespans()).collect();
        over_active(scene, d, self.weight, |layer, g, row| {
            let (kind, rows) = &lives[layer];
            let columns = rows[row].map(F::of);
            let sigma: F = info.times.iter().map(|&t| kind.eval(columns, t).sigma).sum();
            let sigma = sigma / F::of(info.times.len().max(1) as f64);
            let o = g[OPACITY].sigmoid();
            let mut d_row = [F::ZERO; 11];
            d_row[OPACITY] = sigma * o * (F::ONE - o);
            ((o * sigma).f64(), d_row)
        })
    }
}

/// weight · mean over active Gaussians i and their neighbours j of ‖v_i − v_j‖² in (extents a clip)².
/// j's gradient is included where j is active too.
pub(crate) struct VelocitySmoothness {
    weight: f64,
    unit: f64,
    neighbours: Near,
}

impl VelocitySmoothness {
    /// `unit` turns scene units per second into extents a clip.
    pub(crate) fn new(weight: f64, unit: f64) -> Self {
        Self { weight, unit, neighbours: Near::default() }
    }
}

impl<F: Real> ParamLoss<F> for VelocitySmoothness {
    fn name(&self) -> &str {
        "lambda_velocity"
    }

    fn eval(&self, scene: &Scene<F>, info: &StepInfo, d: &mut [Grads<F>]) -> f64 {
        let mut loss = 0.0;
        for (layer, (l, d)) in scene.layers.iter().zip(d).enumerate() {
            let Some(key) = l.params.find(splat4d::motion::spacetime::VELOCITIES) else { continue };
            let n = l.params.len();
            if l.params[key].width() < 3 || n <= NEIGHBOURS {
                continue;
            }
            let active = d.active(Space::Gaussians).to_vec();
            let count = active.iter().filter(|a| **a).count().max(1);
            let scale = self.weight * self.unit * self.unit / (count * NEIGHBOURS) as f64;
            let velocities = &l.params[key];
            let [d_v] = d.of([key]);
            self.neighbours.with(layer, &l.params[GEOMETRY], info.iteration, |near| {
                for i in (0..n).filter(|&i| active[i]) {
                    let v = velocities.read::<3>(i, 0);
                    for &j in &near[i * NEIGHBOURS..(i + 1) * NEIGHBOURS] {
                        let j = j as usize;
                        let u = velocities.read::<3>(j, 0);
                        let e: [F; 3] = std::array::from_fn(|k| v[k] - u[k]);
                        loss += scale * (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]).f64();
                        let g = e.map(|x| x * F::of(2.0 * scale));
                        d_v.add(i, 0, g);
                        if active[j] {
                            d_v.add(j, 0, g.map(|x| -x));
                        }
                    }
                }
            });
        }
        loss
    }

    fn on_edit(&self) {
        self.neighbours.forget();
    }

    fn state(&self) -> Vec<u32> {
        self.neighbours.state()
    }

    fn restore(&self, state: &[u32]) {
        self.neighbours.restore(state);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::layers::Layer;
    use splat4d::math::Rng;
    use splat4d::motion::{SpacetimeSpec, Spec, build_as};
    use splat4d::scene::{Key, LIFE, LifeKind, Params, Time};

    fn scene() -> Scene<f64> {
        let mut params = Params::new(40, 1, LifeKind::GaussHalf.columns());
        let motion = build_as(&Spec::Spacetime(SpacetimeSpec::default()), &mut params).unwrap();
        let rng = Rng::new(4, "losses", 0);
        for key in params.keys().collect::<Vec<_>>() {
            for r in 0..40 {
                for c in 0..params[key].width() {
                    params[key].set(r, c, 0.5 * rng.fork(u64::from(key.0)).normal((r * 50 + c) as u64));
                }
            }
        }
        let layer = Layer::new("a", params, motion, LifeKind::GaussHalf);
        Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, ..Scene::default() }
    }

    fn info() -> StepInfo {
        StepInfo { iteration: 0, times: vec![Time(0.2), Time(0.7)], seed: 0, progress: 0.0 }
    }

    fn eval(loss: &dyn ParamLoss<f64>, scene: &Scene<f64>) -> (f64, Grads<f64>) {
        let mut d = Grads::new(&scene.layers[0].params);
        d.activate(Space::Gaussians, Rows::Some(&[0, 3, 5, 17, 33]));
        let mut d = vec![d];
        let value = loss.eval(scene, &info(), &mut d);
        (value, d.pop().unwrap())
    }

    #[test]
    fn gradients_equal_finite_differences_and_touch_active_rows_only() {
        let base = scene();
        let velocities = base.layers[0].params.find("velocities").unwrap();
        let losses: Vec<(Box<dyn ParamLoss<f64>>, Key)> = vec![
            (Box::new(MeanOpacity { weight: 0.7 }), GEOMETRY),
            (Box::new(MeanScale { weight: 0.7 }), GEOMETRY),
            (Box::new(OpacityEntropy { weight: 0.7 }), GEOMETRY),
            (Box::new(LivingOpacity { weight: 0.7 }), GEOMETRY),
            (Box::new(VelocitySmoothness::new(0.7, 2.0)), velocities),
        ];
        for (loss, key) in &losses {
            let (_, d) = eval(loss.as_ref(), &base);
            for row in [0, 3, 17] {
                for col in 0..base.layers[0].params[*key].width() {
                    let at = |by: f64| {
                        let mut s = base.clone();
                        *s.layers[0].params[*key].get_mut(row, col) += by;
                        eval(loss.as_ref(), &s).0
                    };
                    let fd = (at(1e-6) - at(-1e-6)) / 2e-6;
                    let got = d.table(*key).get(row, col);
                    assert!((fd - got).abs() < 1e-8, "{} {row},{col}: {fd} {got}", loss.name());
                }
            }
            assert!(
                (0..base.layers[0].params[*key].width()).all(|c| d.table(*key).get(4, c) == 0.0),
                "{}",
                loss.name()
            );
        }
    }

    #[test]
    fn the_lifespan_regulariser_gives_lifespans_no_gradient() {
        let (_, d) = eval(&LivingOpacity { weight: 1.0 }, &scene());
        assert!(!d.touched(LIFE));
    }

    #[test]
    fn neighbours_survive_a_checkpoint() {
        let loss = VelocitySmoothness::new(1.0, 1.0);
        let first = eval(&loss, &scene()).0;
        let state = ParamLoss::<f64>::state(&loss);
        let other = VelocitySmoothness::new(1.0, 1.0);
        ParamLoss::<f64>::restore(&other, &state);
        assert_eq!(ParamLoss::<f64>::state(&other), state);
        assert_eq!(eval(&other, &scene()).0, first);
    }
}
