//! Every built-in motion model and lifespan, through the layer, against f64 finite differences.

use super::*;
use crate::motion::{SpacetimeSpec, Spec, build_as};
use crate::scene::SH;

fn layer(spec: &Spec, life: LifeKind, rows: usize, seed: u64) -> Layer<f64> {
    let rng = Rng::new(seed, "layer", 0);
    let mut params = Params::new(rows, 1, life.columns());
    let motion = build_as(spec, &mut params).unwrap();
    for key in params.keys().collect::<Vec<_>>() {
        let table = &mut params[key];
        for r in 0..rows {
            for c in 0..table.width() {
                table.set(r, c, 0.4 * rng.fork(u64::from(key.0)).normal((r * 64 + c) as u64));
            }
        }
    }
    Layer::new("test", params, motion, life)
}

fn loss(layer: &Layer<f64>, t: f64) -> f64 {
    let mut tape = LayerTape::default();
    tape.request(Space::Gaussians, Rows::Some(&[1, 4, 17]), Time(t));
    layer.at(&Cache::default(), &mut tape);
    (0..3).map(|j| (0..10).map(|c| weight(j, c) * tape.out().get(j, c)).sum::<f64>()).sum()
}

fn weight(j: usize, c: usize) -> f64 {
    0.3 + 0.17 * j as f64 - 0.21 * c as f64 + 0.05 * (c * c) as f64
}

fn specs() -> Vec<(Spec, LifeKind)> {
    let spacetime = |order, rotation, detach| {
        Spec::Spacetime(SpacetimeSpec { order, rotation, detach, origin: 0.15, features: None })
    };
    vec![
        (Spec::Still, LifeKind::Infinite),
        (Spec::Still, LifeKind::Interval),
        (spacetime(0, false, false), LifeKind::GaussHalf),
        (spacetime(1, false, false), LifeKind::GaussHalf),
        (spacetime(3, true, false), LifeKind::GaussOne),
        (spacetime(2, true, false), LifeKind::Interval),
        (spacetime(2, true, false), LifeKind::Infinite),
        (spacetime(3, true, true), LifeKind::GaussOne),
    ]
}

#[test]
fn every_parameter_and_time_against_finite_differences() {
    for (spec, life) in specs() {
        let t = 0.62;
        let base = layer(&spec, life, 20, 3);
        let detached = matches!(spec, Spec::Spacetime(s) if s.detach);
        let mut tape = LayerTape::default();
        tape.request(Space::Gaussians, Rows::Some(&[1, 4, 17]), Time(t));
        base.at(&Cache::default(), &mut tape);
        let mut d_out = tape.out().zeros_like();
        (0..3).for_each(|j| (0..10).for_each(|c| d_out.set(j, c, weight(j, c))));
        let mut d = Grads::new(&base.params);
        let d_out = SplatGrads { out: &d_out, color: None, weights: None };
        let d_time = base.backward(&Cache::default(), &mut tape, &d_out, &mut Cache::default(), &mut d);
        let h = 1e-6;
        let fd_time = (loss(&base, t + h) - loss(&base, t - h)) / (2.0 * h);
        assert!((d_time - fd_time).abs() < 2e-6 * (1.0 + fd_time.abs()), "{spec:?} {life:?} dt {d_time} {fd_time}");
        for key in base.params.keys() {
            // With detached Δ the centre's gradient is, by design, not the derivative: see the next test.
            let skip_center = detached && key == LIFE;
            for row in [0, 1, 4, 17] {
                for col in usize::from(skip_center)..base.params[key].width() {
                    let moved = |by: f64| {
                        let mut l = base.clone();
                        *l.params[key].get_mut(row, col) += by;
                        loss(&l, t)
                    };
                    let fd = (moved(h) - moved(-h)) / (2.0 * h);
                    let got = d.table(key).get(row, col);
                    assert!(
                        (fd - got).abs() < 2e-6 * (1.0 + fd.abs()),
                        "{spec:?} {life:?} {key:?} {row},{col}: {fd} {got}"
                    );
                }
            }
        }
    }
}

#[test]
fn detached_center_learns_from_opacity_alone() {
    let spec = Spec::Spacetime(SpacetimeSpec { order: 3, rotation: true, detach: true, origin: 0.0, features: None });
    let base = layer(&spec, LifeKind::GaussOne, 20, 3);
    let mut tape = LayerTape::default();
    tape.request(Space::Gaussians, Rows::All, Time(0.4));
    base.at(&Cache::default(), &mut tape);
    let mut d_out = tape.out().zeros_like();
    (0..20).for_each(|j| (0..9).for_each(|c| d_out.set(j, c, 1.0)));
    let mut d = Grads::new(&base.params);
    let d_out = SplatGrads { out: &d_out, color: None, weights: None };
    base.backward(&Cache::default(), &mut tape, &d_out, &mut Cache::default(), &mut d);
    assert!((0..20).all(|r| d.table(LIFE).get(r, 0) == 0.0), "without an opacity gradient the centre must rest");
    assert!((0..20).any(|r| d.table(GEOMETRY).get(r, 0) != 0.0));
}

#[test]
fn zero_delta_is_the_base_pose_and_motion_is_galilean_invariant() {
    let spec = Spec::Spacetime(SpacetimeSpec { order: 3, rotation: true, ..SpacetimeSpec::default() });
    let mut l = layer(&spec, LifeKind::GaussHalf, 20, 5);
    let mut tape = LayerTape::default();
    let center = l.params[LIFE].get(7, 0);
    tape.request(Space::Gaussians, Rows::Some(&[7]), Time(center));
    l.at(&Cache::default(), &mut tape);
    let base = crate::motion::still::activate(l.params[GEOMETRY].read::<11>(7, 0));
    assert!((0..10).all(|c| (tape.out().get(0, c) - base[c]).abs() < 1e-15));
    // Galilean invariance: adding u to every velocity moves everything by u·(t − centre), and changes no shape.
    let before: Vec<f64> = {
        tape.request(Space::Gaussians, Rows::All, Time(0.9));
        l.at(&Cache::default(), &mut tape);
        tape.out().column_to_rows(0, 10)
    };
    let u = [0.3, -0.2, 0.7];
    let key = l.params.find("velocities").unwrap();
    (0..20).for_each(|r| l.params[key].add(r, 0, u));
    l.at(&Cache::default(), &mut tape);
    for r in 0..20 {
        let delta = 0.9 - l.params[LIFE].get(r, 0);
        for c in 0..10 {
            let moved = before[r * 10 + c] + if c < 3 { u[c] * delta } else { 0.0 };
            assert!((tape.out().get(r, c) - moved).abs() < 1e-12);
        }
    }
}

#[test]
fn default_velocity_agrees_with_the_analytic_one() {
    struct Plain(Arc<dyn Motion<f64>>);
    impl Motion<f64> for Plain {
        fn spec(&self) -> Spec {
            Spec::Custom("plain".into())
        }

        fn scratch_bytes(&self, _p: &Params<f64>, _rows: usize) -> u64 {
            0
        }
        fn at(&self, q: &At<'_, f64>, cache: &Cache, tape: &mut Tape<f64>) {
            self.0.at(q, cache, tape);
        }
        fn backward(
            &self,
            _: &At<'_, f64>,
            _: &Cache,
            _: &mut Tape<f64>,
            _: &SplatGrads<'_, f64>,
            _: &mut Cache,
            _: &mut Grads<f64>,
        ) -> f64 {
            unreachable!("only the forward is asked")
        }
    }
    let spec = Spec::Spacetime(SpacetimeSpec { order: 2, ..SpacetimeSpec::default() });
    let l = layer(&spec, LifeKind::GaussHalf, 20, 8);
    let q = At { p: &l.params, of: Space::Gaussians, rows: Rows::All, t: Time(0.3) };
    let (mut a, mut b) = (Table::default(), Table::default());
    l.motion.velocity(&q, &mut a);
    Plain(l.motion.clone()).velocity(&q, &mut b);
    for r in 0..20 {
        // Central differences are exact for polynomials of order 2.
        assert!((0..3).all(|c| (a.get(r, c) - b.get(r, c)).abs() < 1e-10));
    }
}

#[test]
fn active_rows_are_exactly_those_above_the_threshold() {
    for kind in [LifeKind::GaussHalf, LifeKind::GaussOne, LifeKind::Interval] {
        let l = layer(&Spec::Still, kind, 300, 11);
        let mut ids = Vec::new();
        for i in 0..60 {
            let t = Time(-1.5 + 0.05 * i as f64);
            assert!(!l.active(t, &mut ids));
            let brute: Vec<u32> = (0..300)
                .filter(|&r| {
                    let o = l.params[GEOMETRY].get(r, OPACITY).sigmoid();
                    o * kind.eval(life_row(&l.params[LIFE], r), t).sigma >= ALPHA_MIN
                })
                .map(|r| r as u32)
                .collect();
            assert_eq!(ids, brute, "{kind:?}");
        }
    }
}

#[test]
fn infinite_life_equals_still_without_one() {
    let a = layer(&Spec::Still, LifeKind::Infinite, 10, 2);
    let (mut tape, mut ids) = (LayerTape::default(), Vec::new());
    assert!(a.active(Time(5.0), &mut ids));
    tape.request_active(&a, Time(5.0));
    a.at(&Cache::default(), &mut tape);
    let base = crate::motion::still::activate(a.params[GEOMETRY].read::<11>(3, 0));
    assert_eq!(tape.out().read::<10>(3, 0), base);
}

#[test]
fn a_layer_is_visible_in_its_span_only() {
    let mut a = layer(&Spec::Still, LifeKind::Infinite, 5, 1);
    let mut b = layer(&Spec::Still, LifeKind::GaussHalf, 20, 2);
    let whole = b.spans();
    a.span = [0.25, 0.5];
    b.span = [0.25, 0.5];
    let mut ids = Vec::new();
    for t in [0.24, 0.5, 3.0] {
        assert!(!a.active(Time(t), &mut ids) && ids.is_empty(), "nothing at {t}");
        assert!(!b.active(Time(t), &mut ids) && ids.is_empty(), "nothing at {t}");
    }
    assert!(a.active(Time(0.25), &mut ids), "all rows from the first moment on");
    assert_eq!(a.spans(), vec![[0.25, 0.5f64.next_down()]; 5]);
    for (cut, [from, to]) in b.spans().into_iter().zip(whole) {
        let overlap = from <= to && from < 0.5 && to >= 0.25;
        assert_eq!(cut, if overlap { [from.max(0.25), to.min(0.5f64.next_down())] } else { [1.0, 0.0] });
    }
    // A scene's splats at a time outside are those of the other layers.
    let scene = Scene { layers: vec![a, layer(&Spec::Still, LifeKind::Infinite, 3, 4)], ..Scene::default() };
    let mut instant = Evaluation::default();
    scene.at(Time(0.6), &mut instant);
    assert_eq!(scene.splats(&instant).len(), 3);
    scene.at(Time(0.3), &mut instant);
    assert_eq!(scene.splats(&instant).len(), 8);
}

/// A layer whose Gaussians move, turn and have their own lifespans, in a frame of its own.
fn turning() -> Scene<f32> {
    let mut params = Params::<f32>::new(40, 4, LifeKind::GaussHalf.columns());
    let spec = SpacetimeSpec { order: 1, rotation: true, detach: false, origin: 0.5, features: None };
    let motion = crate::motion::build(&Spec::Spacetime(spec), &mut params).unwrap();
    let keys: Vec<_> = params.keys().collect();
    for key in keys {
        let (rows, width) = (params[key].rows(), params[key].width());
        for i in 0..rows * width {
            params[key].set(
                i / width,
                i % width,
                0.4 * Rng::new(5, "turning", u64::from(key.0)).normal(i as u64) as f32,
            );
        }
    }
    for row in 0..40 {
        params[GEOMETRY].set(row, OPACITY, 2.0);
        params[LIFE].write(row, 0, [0.5, 0.5]);
    }
    let mut layer = Layer::new("turning", params, motion, LifeKind::GaussHalf);
    layer.frame = Sim3 { scale: 1.5, rotation: crate::math::quat::to_rotation([0.8, 0.6, 0.0, 0.0]), ..Sim3::IDENTITY };
    Scene { layers: vec![layer], ..Scene::default() }
}

#[test]
fn plain_gaussians_equal_the_rendered_ones_and_keep_their_scales() {
    use crate::math::sym3::from_quat_log_scales;
    let (scene, t) = (turning(), Time(0.9));
    let mut seen = Evaluation::default();
    scene.at(t, &mut seen);
    let all = Gaussians::of(&scene, &seen);
    let (frozen, (sh, k)) = (freeze(&scene, t).unwrap(), Gaussians::sh(&scene, &seen));
    assert_eq!((all.means.len(), k, sh.len()), (40, 4, 40 * 12));
    for (j, ((mean, q), scales)) in all.means.iter().zip(&all.quats).zip(&all.scales).enumerate() {
        let out = seen.tape(0).out();
        assert_eq!(*mean, out.read::<3>(j, 0));
        let cov = from_quat_log_scales(q.map(f64::from), scales.map(|s| f64::from(s).ln()));
        let trace = cov[0] + cov[3] + cov[5];
        let drawn = out.read::<6>(j, crate::scene::splats::COV);
        assert!(cov.iter().zip(drawn).all(|(a, b)| (a - f64::from(b)).abs() < 1e-4 * trace), "{j}: {cov:?} {drawn:?}");
        // In the order of the learnt ones: they were turned, not taken apart.
        let learnt = scene.layers[0].params[GEOMETRY].read::<3>(j, crate::scene::params::LOG_SCALE);
        assert!(learnt.iter().zip(scales).all(|(l, s)| (l.exp() * 1.5 - s).abs() < 1e-5 * s), "{j}");
        let logit = frozen[GEOMETRY].get(j, OPACITY);
        assert!((all.opacities[j] - 1.0 / (1.0 + (-logit).exp())).abs() < 1e-5);
        assert_eq!(frozen[SH].read::<12>(j, 0), sh[12 * j..12 * j + 12]);
    }
}
