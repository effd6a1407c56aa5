//! A sequential model: the state at t is computed by a scan over all times, so that its parameters are reached only
//! through `prepare` and `finish`.

use super::*;
use splat4d::motion::still::{activate, activate_backward};
use splat4d::motion::{At, Cache, Tape};
use splat4d::scene::SplatGrads;

/// Steps of the recurrence.
const STEPS: usize = 4;
/// Seconds a step.
const STEP_SECONDS: f64 = 0.06;

/// x_{k+1} = a·x_k + u_k, x_0 = 0, by Gaussian and axis; the mean at t is μ + x(t), linear between the steps.
#[derive(Clone, Copy)]
pub(super) struct Recurrence {
    controls: Key,
    decay: Key,
}

/// States x_0 … x_STEPS of all Gaussians, [N, 3·(STEPS + 1)]; also their gradient.
#[derive(Default)]
struct States<F>(Table<F>);

impl Recurrence {
    pub(super) fn new<F: Real>(p: &mut Params<F>) -> Self {
        let rows = p.len();
        let controls = p.entry("controls", Space::Gaussians, &[("controls", 3 * STEPS)], rows, |_| {}).unwrap();
        let start = |t: &mut Table<F>| (0..rows).for_each(|r| t.set(r, 0, F::of(0.9)));
        let decay = p.entry("decay", Space::Gaussians, &[("decay", 1)], rows, start).unwrap();
        Self { controls, decay }
    }

    /// The step before t, the share of the next, and whether t is inside the scan.
    fn place(t: Time) -> (usize, f64, bool) {
        let u = t.0 / STEP_SECONDS;
        let inside = u > 0.0 && u < STEPS as f64;
        let u = u.clamp(0.0, STEPS as f64);
        let low = (u.floor() as usize).min(STEPS - 1);
        (low, u - low as f64, inside)
    }
}

impl<F: Real> Motion<F> for Recurrence {
    fn spec(&self) -> Spec {
        Spec::Custom("recurrence".into())
    }

    fn scratch_bytes(&self, _p: &Params<F>, _rows: usize) -> u64 {
        0
    }

    fn prepare(&self, p: &Params<F>, _: &[At<'_, F>], cache: &mut Cache) {
        let states = &mut cache.get_or_default::<States<F>>().0;
        *states = Table::new(&[("states", 3 * (STEPS + 1))], p.len());
        for r in 0..p.len() {
            let a = p[self.decay].get(r, 0);
            for k in 0..STEPS {
                let (x, u) = (states.read::<3>(r, 3 * k), p[self.controls].read::<3>(r, 3 * k));
                states.write(r, 3 * k + 3, std::array::from_fn::<F, 3, _>(|i| a * x[i] + u[i]));
            }
        }
    }

    fn at(&self, q: &At<'_, F>, cache: &Cache, tape: &mut Tape<F>) {
        let states = &cache.get::<States<F>>().expect("prepare came first").0;
        tape.start(q.len());
        let (low, share, _) = Self::place(q.t);
        for j in 0..q.len() {
            let id = q.rows.id(j);
            let mut row = activate(q.p[GEOMETRY].read::<11>(id, 0));
            let (a, b) = (states.read::<3>(id, 3 * low), states.read::<3>(id, 3 * low + 3));
            (0..3).for_each(|k| row[k] += a[k] + F::of(share) * (b[k] - a[k]));
            tape.out.write(j, 0, row);
        }
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        cache: &Cache,
        _: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        let states = &cache.get::<States<F>>().expect("prepare came first").0;
        let d_states = &mut d_cache.get_or_default::<States<F>>().0;
        if d_states.width() == 0 {
            *d_states = states.zeros_like();
        }
        let (low, share, inside) = Self::place(q.t);
        let slope = if inside { 1.0 / STEP_SECONDS } else { 0.0 };
        let [d_geometry] = d.of([GEOMETRY]);
        let mut d_time = 0.0;
        for j in 0..q.len() {
            let id = q.rows.id(j);
            let g = d_out.out.read::<10>(j, 0);
            d_geometry.add(id, 0, activate_backward(q.p[GEOMETRY].read::<11>(id, 0), g));
            let (a, b) = (states.read::<3>(id, 3 * low), states.read::<3>(id, 3 * low + 3));
            d_states.add(id, 3 * low, [0, 1, 2].map(|k| g[k] * F::of(1.0 - share)));
            d_states.add(id, 3 * low + 3, [0, 1, 2].map(|k| g[k] * F::of(share)));
            d_time += slope * (0..3).map(|k| (g[k] * (b[k] - a[k])).f64()).sum::<f64>();
        }
        d_time
    }

    fn finish(&self, p: &Params<F>, _: &[At<'_, F>], cache: &mut Cache, d_cache: &mut Cache, d: &mut Grads<F>) {
        let (Some(states), Some(d_states)) = (cache.get::<States<F>>(), d_cache.get::<States<F>>()) else { return };
        let [d_controls, d_decay] = d.of([self.controls, self.decay]);
        for r in 0..p.len() {
            let a = p[self.decay].get(r, 0);
            let mut adjoint = [F::ZERO; 3];
            for k in (0..STEPS).rev() {
                let (x, own) = (states.0.read::<3>(r, 3 * k), d_states.0.read::<3>(r, 3 * k + 3));
                adjoint = std::array::from_fn(|i| own[i] + a * adjoint[i]);
                d_controls.add(r, 3 * k, adjoint);
                d_decay.add(r, 0, [(0..3).map(|i| adjoint[i] * x[i]).sum::<F>()]);
            }
        }
    }
}

pub(super) fn scan_scene<F: Real>(rows: usize) -> Scene<F> {
    let mut p = cloud::<F>(rows, LifeKind::GaussHalf, 7);
    let model = Recurrence::new(&mut p);
    shake(&mut p, model.controls, 0.06, 1);
    shake(&mut p, model.decay, 0.05, 2);
    one_layer(p, Arc::new(model), LifeKind::GaussHalf)
}

#[test]
fn the_gradient_of_a_scan_reaches_its_parameters() {
    let reached = check_gradients(&scan_scene(9), &shots(&[(0, 0.05), (1, 0.2), (2, 0.2)]), &Vec::new());
    assert_reached(&reached[0], &["geometry", "sh", "life", "controls", "decay"]);
}

#[test]
fn a_sequential_model_learns() {
    let stage = Stage {
        sampler: Sampler::Uniform,
        batch: 12,
        groups: groups(&[&ORDINARY[..], &[("controls", 0.01), ("decay", 0.01)]].concat()),
        ..Stage::new("scan", 25)
    };
    let mut t = trainer(scan_scene(80), vec![stage], 200);
    let before = t.scene().layers[0].params.clone();
    assert_falls(&finish_stage(&mut t), 0.85, "scan");
    for name in ["controls", "decay"] {
        let key = before.find(name).unwrap();
        assert_ne!(before[key], t.scene().layers[0].params[key], "`{name}` learns");
    }
}
