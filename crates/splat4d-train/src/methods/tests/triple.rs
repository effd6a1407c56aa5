//! A loss over triples of times, merged with the step's views: one query a distinct (layer, time).

use super::*;
use crate::step::chain::Probe;
use splat4d::layers::LayerTape;
use splat4d::motion::Cache;
use splat4d::scene::Rows;

/// weight · Σ rows ‖μ(t−h) − 2μ(t) + μ(t+h)‖² + opacity of the middle: acceleration, and a column other than the mean.
struct Acceleration {
    times: [f64; 3],
    rows: Option<Vec<u32>>,
}

const WEIGHT: f64 = 0.8;

impl<F: Real> ProbeLoss<F> for Acceleration {
    fn name(&self) -> &str {
        "acceleration"
    }

    fn probes(&self, _: &Scene<F>, _: &StepInfo) -> Vec<Probe> {
        vec![Probe { layer: 0, of: Space::Gaussians, rows: self.rows.clone(), times: self.times.map(Time).to_vec() }]
    }

    fn eval(&self, _: &Scene<F>, _: &[Probe], seen: &[Vec<Table<F>>], d: &mut [Vec<Table<F>>]) -> f64 {
        let mut sum = 0.0;
        for r in 0..seen[0][0].rows() {
            for axis in 0..3 {
                let x = [0, 1, 2].map(|k| seen[0][k].get(r, axis));
                let e = x[0] - F::TWO * x[1] + x[2];
                sum += WEIGHT * (e * e).f64();
                for (k, factor) in [1.0, -2.0, 1.0].into_iter().enumerate() {
                    d[0][k].add(r, axis, [e * F::of(2.0 * WEIGHT * factor)]);
                }
            }
            sum += WEIGHT * seen[0][1].get(r, 9).f64();
            d[0][1].add(r, 9, [F::of(WEIGHT)]);
        }
        sum
    }
}

const TIMES: [f64; 3] = [0.0, 0.1, 0.2];

fn two_layers() -> Scene<f64> {
    let mut p = cloud::<f64>(8, LifeKind::GaussHalf, 21);
    // Rows that no view at 0.1 sees: the probe requests them all the same.
    p[LIFE].write(2, 0, [5.0, -2.0]);
    p[LIFE].write(6, 0, [5.0, -2.0]);
    let spec = Spec::Spacetime(SpacetimeSpec { order: 3, rotation: true, ..SpacetimeSpec::default() });
    let motion = build_as(&spec, &mut p).unwrap();
    for key in p.keys().skip(3).collect::<Vec<_>>() {
        shake(&mut p, key, 0.2, 1);
    }
    let mut scene = one_layer(p, motion, LifeKind::GaussHalf);
    let still = one_layer(
        cloud::<f64>(5, LifeKind::Infinite, 22),
        build_as(&Spec::Still, &mut Params::new(0, 1, &[])).unwrap(),
        LifeKind::Infinite,
    );
    scene.layers.extend(still.layers);
    scene
}

#[test]
fn probes_and_views_share_their_queries() {
    let scene = two_layers();
    // Two views, one at the triple's middle time: layer 0 answers at 0, 0.1, 0.2 and 0.15, layer 1 at 0.1 and 0.15.
    let shots = shots(&[(0, 0.1), (1, 0.15), (2, 0.15)]);
    for rows in [None, Some(vec![0u32, 2, 3, 6])] {
        let probes: Probes = vec![Box::new(Acceleration { times: TIMES, rows: rows.clone() })];
        let (report, _, calls) = step(&scene, &shots, &probes, &mut Renderer::new(smooth()));
        assert_eq!(calls, 6, "one `at` a distinct (layer, time)");
        let (pictures, _, without) = step(&scene, &shots, &Vec::new(), &mut Renderer::new(smooth()));
        assert_eq!(without, 4);
        let direct = direct(&scene, rows.as_deref());
        assert!((report.loss - pictures.loss - direct).abs() < 1e-9, "{} {} {direct}", report.loss, pictures.loss);
        // The step's own loss and its gradient; dL/dt of shared times belongs to both and is not compared.
        let reached = check_gradients(&scene, &shots, &probes);
        assert_reached(&reached[0], &["geometry", "sh", "life", "velocities"]);
        assert_reached(&reached[1], &["geometry", "sh"]);
    }
}

/// The loss from plain queries to the layer.
fn direct(scene: &Scene<f64>, rows: Option<&[u32]>) -> f64 {
    let seen = TIMES.map(|t| {
        let mut tape = LayerTape::default();
        tape.request(Space::Gaussians, rows.map_or(Rows::All, Rows::Some), Time(t));
        scene.layers[0].at(&Cache::default(), &mut tape);
        tape.out().clone()
    });
    let row = |r: usize| {
        let e = |k: usize| seen[0].get(r, k) - 2.0 * seen[1].get(r, k) + seen[2].get(r, k);
        WEIGHT * (e(0).powi(2) + e(1).powi(2) + e(2).powi(2) + seen[1].get(r, 9))
    };
    (0..seen[0].rows()).map(row).sum()
}

#[test]
fn a_triple_trains_with_images() {
    let mut p = cloud::<f32>(70, LifeKind::GaussHalf, 4);
    let spec = Spec::Spacetime(SpacetimeSpec { order: 2, ..SpacetimeSpec::default() });
    let motion = build_as(&spec, &mut p).unwrap();
    let key = p.find("velocities").unwrap();
    shake(&mut p, key, 0.3, 2);
    let stage = Stage {
        sampler: Sampler::Tuple(3),
        groups: groups(&[&ORDINARY[..], &[("velocities", 0.05)]].concat()),
        probes: vec![Box::new(Acceleration { times: TIMES, rows: None })],
        ..Stage::new("triples", 30)
    };
    let mut t = trainer(one_layer(p, motion, LifeKind::GaussHalf), vec![stage], 200);
    assert_falls(&finish_stage(&mut t), 0.7, "triples");
}
