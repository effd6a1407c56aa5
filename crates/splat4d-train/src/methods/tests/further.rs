//! What is drawn beside colours: depth, normals and flow, through the whole chain.

use super::*;
use crate::train::chain::{FlowTruth, Wanted};

/// Random weights on every number of every picture but the colours.
struct Weighted(Wanted);

impl ImageLoss<f64> for Weighted {
    fn wanted(&self) -> Wanted {
        self.0
    }

    fn eval(&mut self, _: &View<'_, f64>, image: &Image<f64>, d: &mut PictureGrads<f64>) -> f64 {
        d.color = Planes::new(3, image.color.height, image.color.width);
        let mut sum = 0.0;
        let mut weigh = |name: &str, d: &mut Planes<f64>, image: &Planes<f64>| {
            let rng = Rng::new(1, name, 0);
            for (i, (d, x)) in d.data.iter_mut().zip(&image.data).enumerate() {
                *d = rng.normal(i as u64);
                sum += *d * x;
            }
        };
        weigh("alpha", &mut d.alpha, &image.alpha);
        weigh("depth", &mut d.depth, &image.depth);
        weigh("extra", &mut d.extra, &image.extra);
        (d.uses_alpha, d.uses_depth, d.uses_extra) = (true, self.0.depth, true);
        sum
    }
}

fn moving(life: LifeKind) -> Scene<f64> {
    let mut params = cloud(24, life, 9);
    let motion = build(&Spec::Spacetime(SpacetimeSpec::default()), &mut params).unwrap();
    let velocities = params.find("velocities").unwrap();
    shake(&mut params, velocities, 0.5, 3);
    one_layer(params, motion, life)
}

fn run(scene: &Scene<f64>, wanted: Wanted, draw: &mut dyn Draw<f64>) -> (f64, Vec<Grads<f64>>) {
    let shots = shots(&[(0, 0.05), (1, 0.1)]);
    // Of two views the second is where the first one's pixels go, the first where the second's do.
    let views: Vec<View<'_, f64>> = (0..2)
        .map(|i| View {
            camera: &shots[i].camera,
            t: Time(shots[i].t),
            background: [0.2, 0.3, 0.6],
            truth: &shots[i].truth,
            mask: None,
            weight: None,
            flow: Some(FlowTruth {
                to: Time(if i == 0 { 0.1 } else { 0.15 }),
                camera: &shots[1 - i].camera,
                vectors: &shots[i].truth,
            }),
            frame: 0,
            rig: 0,
        })
        .collect();
    let info = StepInfo { iteration: 0, times: views.iter().map(|v| v.t).collect(), seed: 0, progress: 0.0 };
    let mut image = Weighted(wanted);
    let mut d: Vec<Grads<f64>> = scene.layers.iter().map(|l| Grads::new(&l.params)).collect();
    let mut losses = Losses { image: &mut image, probes: &[], params: &[] };
    let report = Chain::default().step(scene, &views, &info, draw, &mut losses, &mut d, &mut |_| {});
    (report.loss, d)
}

#[test]
fn depth_normals_and_flow_have_the_gradient_of_their_values() {
    for life in [LifeKind::Infinite, LifeKind::GaussHalf] {
        let scene = moving(life);
        let velocities = scene.layers[0].params.find("velocities").unwrap();
        for wanted in [
            Wanted { depth: true, normals: true, flow: true },
            Wanted { depth: false, normals: false, flow: true },
            Wanted { depth: true, normals: false, flow: false },
        ] {
            let (_, d) = run(&scene, wanted, &mut Renderer::new(smooth()));
            let mut largest = 0.0f64;
            for row in [0, 7, 19] {
                for (key, width) in [(GEOMETRY, 11), (velocities, 3)] {
                    for col in 0..width {
                        let at = |h: f64| {
                            let mut s = scene.clone();
                            *s.layers[0].params[key].get_mut(row, col) += h;
                            run(&s, wanted, &mut Renderer::new(smooth())).0
                        };
                        let fd = (at(H) - at(-H)) / (2.0 * H);
                        let got = d[0].table(key).get(row, col);
                        largest = largest.max(fd.abs());
                        let close = (got - fd).abs() <= 1e-6 + 1e-5 * fd.abs();
                        assert!(close, "{life:?} {wanted:?} {row} {col}: chain {got:e}, differences {fd:e}");
                    }
                }
            }
            assert!(largest > 1.0, "{wanted:?}: {largest}");
        }
    }
}
