//! Gradients through the whole chain of the channels next to colours: depth, normals, flow and a column's sigmoid.

use super::*;
use crate::capture::frames::FlowTruth;
use crate::loss::image::{Channel, Needs};

/// Random weights on every number of every image but the colours.
struct Weighted(Needs);

impl ImageTerm<f64> for Weighted {
    fn needs(&self, _: &View<'_, f64>) -> Needs {
        self.0.clone()
    }

    fn eval(&mut self, _: &StepInfo, _: &View<'_, f64>, shown: &Shown<'_, f64>, d: &mut LossGrads<f64>) -> f64 {
        let mut sum = 0.0;
        let mut weigh = |name: &str, d: &mut Planes<f64>, image: &Planes<f64>| {
            let rng = Rng::new(1, name, 0);
            for (i, (d, x)) in d.data.iter_mut().zip(&image.data).enumerate() {
                *d += rng.normal(i as u64);
                sum += rng.normal(i as u64) * x;
            }
        };
        weigh("alpha", d.alpha.add(), shown.alpha);
        if self.0.depth {
            weigh("depth", d.depth.add(), shown.depth);
        }
        weigh("extra", d.extra.add(), shown.extra);
        sum
    }
}

fn moving(life: LifeKind) -> Scene<f64> {
    let mut params = cloud(24, life, 9);
    let motion = build_as(&Spec::Spacetime(SpacetimeSpec::default()), &mut params).unwrap();
    let velocities = params.find("velocities").unwrap();
    shake(&mut params, velocities, 0.5, 3);
    one_layer(params, motion, life)
}

fn run(scene: &Scene<f64>, needs: &Needs, backend: &mut dyn Backend<f64>) -> (f64, Vec<Grads<f64>>) {
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
            depth: None,
            measured: None,
            flow: Some(FlowTruth {
                to: Time(if i == 0 { 0.1 } else { 0.15 }),
                camera: &shots[1 - i].camera,
                vectors: &shots[i].truth,
            }),
            tracks: Some(FlowTruth { to: Time(0.12), camera: &shots[i].camera, vectors: &shots[i].truth }),
            frame: 0,
            rig: 0,
            shutter: None,
        })
        .collect();
    let info = StepInfo { iteration: 0, times: views.iter().map(|v| v.t).collect(), seed: 0, progress: 0.0 };
    let mut image = Weighted(needs.clone());
    let mut d: Vec<Grads<f64>> = scene.layers.iter().map(|l| Grads::new(&l.params)).collect();
    let mut losses = Losses { image: &mut image, probes: &[], params: &[] };
    let step = Step { scene, views: &views, info: &info, sh_degree: MAX_DEGREE };
    let report = Chain::default().step(&step, backend, &mut losses, &mut d, &mut |_| {}).unwrap();
    (report.loss, d)
}

#[test]
fn depth_normals_and_flow_have_the_gradient_of_their_values() {
    for life in [LifeKind::Infinite, LifeKind::GaussHalf] {
        let scene = moving(life);
        let velocities = scene.layers[0].params.find("velocities").unwrap();
        // Opacity logits represent a learnt column: it is the sigmoid of any.
        let sigmoid = Channel::Sigmoid("opacity_logits".to_owned());
        for needs in [
            Needs { depth: true, extra: vec![Channel::Normals, Channel::Flow, Channel::Tracks, sigmoid] },
            Needs { depth: false, extra: vec![Channel::Flow] },
            Needs { depth: true, extra: vec![] },
        ] {
            let (_, d) = run(&scene, &needs, &mut Renderer::new(smooth()));
            let mut largest = 0.0f64;
            for row in [0, 7, 19] {
                for (key, width) in [(GEOMETRY, 11), (velocities, 3)] {
                    for col in 0..width {
                        let at = |h: f64| {
                            let mut s = scene.clone();
                            *s.layers[0].params[key].get_mut(row, col) += h;
                            run(&s, &needs, &mut Renderer::new(smooth())).0
                        };
                        let fd = (at(H) - at(-H)) / (2.0 * H);
                        let got = d[0].table(key).get(row, col);
                        largest = largest.max(fd.abs());
                        let close = (got - fd).abs() <= 1e-6 + 1e-5 * fd.abs();
                        assert!(close, "{life:?} {needs:?} {row} {col}: chain {got:e}, differences {fd:e}");
                    }
                }
            }
            assert!(largest > 1.0, "{needs:?}: {largest}");
        }
    }
}
