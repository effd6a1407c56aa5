//! The filter's rows against Kalman's and against differences, and the filter around models: it forwards all, it calms
//! noise, it lets sudden motion through.

use super::*;
use crate::format::scene::{spec_from_json, spec_to_json};
use crate::math::spd::{Mat3, mix, unpack};
use crate::math::sym3;
use crate::motion::{SpacetimeSpec, build_as as build_model};
use crate::scene::splats::SPLAT_OPACITY;
use crate::scene::{Born, GEOMETRY, LifeKind, SH};

const H: f64 = 1e-6;
const FD: f64 = 1e-6;

fn normal(seed: u64, i: u64, spread: f64) -> Normal {
    let rng = Rng::new(seed, "filtered", 0).fork(i);
    let x: [f64; 10] = std::array::from_fn(|k| rng.normal(k as u64));
    let cov = sym3::from_quat_log_scales(
        [2.0 + x[0], x[1], x[2], x[3]],
        std::array::from_fn(|k| -0.3 * k as f64 + spread * x[4 + k]),
    );
    Normal { mean: std::array::from_fn(|k| spread * x[7 + k]), cov: unpack(cov) }
}

fn ball(mean: [f64; 3], s: f64) -> Normal {
    Normal { mean, cov: crate::math::spd::IDENTITY.map(|row| row.map(|x| x * s * s)) }
}

fn assert_near(a: &Mat3, b: &Mat3, tolerance: f64) {
    for (x, y) in a.iter().flatten().zip(b.iter().flatten()) {
        assert!((x - y).abs() <= tolerance, "{a:?} and {b:?}");
    }
}

#[test]
fn constant_velocity_is_predicted_exactly() {
    let shape = normal(1, 0, 0.3);
    let at = |t: f64| Normal { mean: [t, -2.0 * t, 0.5], ..shape };
    for baseline in [1, 3] {
        for (_, predictor) in Predictor::ALL {
            let p = Prediction::new(predictor, &at(0.4), &at(0.4 - 0.1 * baseline as f64), baseline).point;
            assert!((p.mean[0] - 0.5).abs() < 1e-12 && (p.mean[1] + 1.0).abs() < 1e-12, "{p:?}");
            assert_near(&p.cov, &shape.cov, 1e-12);
        }
    }
    // A ball that grows steadily: standard deviations continue in a straight line along the geodesic, variances do not.
    let grown = |t: f64| ball([0.0; 3], 1.0 + 0.3 * t);
    let truth = grown(2.0);
    let curved = Prediction::new(Predictor::Wasserstein, &grown(1.0), &grown(0.0), 1).point;
    assert_near(&curved.cov, &truth.cov, 1e-12);
    for predictor in [Predictor::Euclidean, Predictor::Hold] {
        let straight = Prediction::new(predictor, &grown(1.0), &grown(0.0), 1).point;
        assert!((straight.cov[0][0] - truth.cov[0][0]).abs() > 0.05, "{predictor:?} cannot know");
    }
}

#[test]
fn kalman_halves_the_variance_of_agreeing_values_and_keeps_certain_ones() {
    let (seen, predicted) = (ball([1.0, 0.0, 0.0], 0.2), ball([0.0; 3], 0.2));
    let merged = Fused::new(Fusion::Literal, &seen, &predicted, 0.3, 1.0, 0.0).point;
    assert!((merged.mean[0] - 0.5).abs() < 1e-9);
    assert_near(&merged.cov, &ball([0.0; 3], 0.2 * 0.5f64.sqrt()).cov, 1e-9);
    // The sign that is wrong elsewhere, Σ + KΣ, would leave more doubt than there was.
    let wrong = mix(1.5, &predicted.cov, 0.0, &predicted.cov);
    assert!(merged.cov[0][0] < predicted.cov[0][0] && wrong[0][0] > predicted.cov[0][0]);
    let vague = ball([9.0, 0.0, 0.0], 1e4);
    let kept = Fused::new(Fusion::Literal, &vague, &predicted, 0.3, 1.0, 0.0).point;
    assert!(kept.mean[0].abs() < 1e-6);
    assert_near(&kept.cov, &predicted.cov, 1e-9);
    // Joseph's form of the same posterior.
    let (a, b) = (normal(3, 0, 0.4), normal(3, 1, 0.4));
    let found = Fused::new(Fusion::Literal, &a, &b, 0.5, 1.0, 0.0).point.cov;
    let k = crate::math::spd::mul(&b.cov, &crate::math::spd::inverse(&mix(1.0, &a.cov, 1.0, &b.cov)));
    let keep = mix(1.0, &crate::math::spd::IDENTITY, -1.0, &k);
    let turned = |m: &Mat3| -> Mat3 { std::array::from_fn(|i| std::array::from_fn(|j| m[j][i])) };
    let product = |p: &Mat3, m: &Mat3| crate::math::spd::mul(&crate::math::spd::mul(p, m), &turned(p));
    assert_near(&found, &mix(1.0, &product(&keep, &b.cov), 1.0, &product(&k, &a.cov)), 1e-9);
}

#[test]
fn geodesic_fusion_returns_its_ends_exactly_and_rejects_jumps() {
    let (seen, predicted) = (normal(4, 0, 0.3), normal(4, 1, 0.3));
    let at = |gain: f64| Fused::new(Fusion::Geodesic, &seen, &predicted, gain, 1.0, 0.0).point;
    assert_near(&at(1.0).cov, &seen.cov, 1e-10);
    assert_near(&at(0.0).cov, &predicted.cov, 1e-10);
    let same = Fused::new(Fusion::Geodesic, &seen, &seen, 0.3, 1.0, 0.0).point;
    assert_eq!(same.cov, seen.cov, "where both agree nothing changes");
    // A jump: the innovation is beyond what chance explains, and the observation counts.
    let far = Normal { mean: predicted.mean.map(|x| x + 40.0), ..seen };
    for fusion in [Fusion::Geodesic, Fusion::Literal] {
        let state = Fused::new(fusion, &far, &predicted, 0.3, 1.0, GATE);
        assert!(state.open == 0.0 && state.point == far, "{fusion:?}");
        assert!(Fused::new(fusion, &far, &predicted, 0.3, 1.0, 0.0).point != far);
    }
}

/// Gradients of a prediction followed by a fusion to all they depend on.
#[test]
fn gradients_of_a_row_equal_differences() {
    let mut faded = 0;
    for seed in 0..12 {
        let w = normal(seed, 9, 1.0);
        for (_, fusion) in Fusion::ALL {
            for (_, predictor) in Predictor::ALL {
                // Straight covariances that need no lift: its floor is a constant to the gradient.
                let mut at = [0, 1, 2].map(|i| normal(seed, i, 0.25));
                if predictor == Predictor::Euclidean {
                    at[2].cov = mix(0.7, &at[1].cov, 0.3, &at[2].cov);
                }
                // Gates from never through half open to nearly closed.
                for gate in [0.0, 0.3, 1.0, GATE] {
                    faded += check_row(at, &w, fusion, predictor, gate);
                }
            }
        }
    }
    assert!(faded > 20, "a half-open gate was met {faded} times");
}

fn check_row(at: [Normal; 3], w: &Normal, fusion: Fusion, predictor: Predictor, gate: f64) -> usize {
    let (gain, trust, baseline) = (0.4, 0.7, 2);
    let run = |[seen, last, before]: [Normal; 3], gain: f64, trust: f64| {
        let p = Prediction::new(predictor, &last, &before, baseline);
        (p, Fused::new(fusion, &seen, &p.point, gain, trust, gate))
    };
    let value = |at: [Normal; 3], gain: f64, trust: f64| {
        let x = run(at, gain, trust).1.point;
        let means: f64 = (0..3).map(|k| x.mean[k] * w.mean[k]).sum();
        means + crate::math::spd::inner(&x.cov, &w.cov)
    };
    let (p, f) = run(at, gain, trust);
    let g = f.backward(&at[0], w);
    let (last, before) = p.backward(&g.predicted);
    let near = |a: f64, b: f64, what: &str| {
        assert!((a - b).abs() < FD * (1.0 + a.abs()), "{what} of {fusion:?} {predictor:?} gate {gate}: {a} and {b}");
    };
    for (i, d) in [g.seen, last, before].into_iter().enumerate() {
        let d: [f64; 9] = d.gradient();
        for k in 0..9 {
            let moved = |h: f64| {
                let mut x = at;
                let mut row: [f64; 9] = x[i].splat();
                row[k] += h;
                x[i] = Normal::of_splat(row);
                value(x, gain, trust)
            };
            near((moved(H) - moved(-H)) / (2.0 * H), d[k], &format!("state {i} column {k}"));
        }
    }
    near((value(at, gain + H, trust) - value(at, gain - H, trust)) / (2.0 * H), g.gain, "gain");
    near((value(at, gain, trust + H) - value(at, gain, trust - H)) / (2.0 * H), g.trust, "trust");
    usize::from(f.open > 0.0 && f.open < trust)
}

/// Means that a table of frames states, linear in between: tracked balls.
struct Watched {
    frames: Vec<[f64; 3]>,
}

/// Seconds between two of them.
const FRAME: f64 = 0.1;

impl<F: Real> Motion<F> for Watched {
    fn spec(&self) -> Spec {
        Spec::Custom("watched".into())
    }

    fn scratch_bytes(&self, _p: &Params<F>, _rows: usize) -> u64 {
        0
    }

    fn at(&self, q: &At<'_, F>, cache: &Cache, tape: &mut Tape<F>) {
        crate::motion::Still.at(q, cache, tape);
        let x = (q.t.0 / FRAME).clamp(0.0, (self.frames.len() - 1) as f64);
        let (i, s) = (x.floor() as usize, x - x.floor());
        let (a, b) = (self.frames[i], self.frames[(i + 1).min(self.frames.len() - 1)]);
        for j in 0..q.len() {
            tape.out.write(j, 0, std::array::from_fn::<F, 3, _>(|k| F::of((1.0 - s) * a[k] + s * b[k])));
        }
    }

    fn backward(
        &self,
        q: &At<'_, F>,
        cache: &Cache,
        tape: &mut Tape<F>,
        d_out: &SplatGrads<'_, F>,
        d_cache: &mut Cache,
        d: &mut Grads<F>,
    ) -> f64 {
        crate::motion::Still.backward(q, cache, tape, d_out, d_cache, d)
    }
}

/// Where the filter puts the watched ball at its frames.
fn followed(frames: Vec<[f64; 3]>, change: impl Fn(&mut FilteredSpec)) -> Vec<[f64; 3]> {
    let mut p = Params::<f64>::new(1, 1, &[]);
    p[GEOMETRY].write(0, 3, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    let count = frames.len();
    let inner: Arc<dyn Motion<f64>> = Arc::new(Watched { frames });
    let mut spec = FilteredSpec { fusion: Fusion::Geodesic, ..FilteredSpec::around(Spec::Still, FRAME, 0.0) };
    change(&mut spec);
    let filter = Filtered::around(inner, spec, &mut p).unwrap();
    (0..count).map(|i| ask(&filter, &p, i as f64 * FRAME).read::<3>(0, 0)).collect()
}

fn ask<F: Real>(model: &dyn Motion<F>, p: &Params<F>, t: f64) -> Table<F> {
    let q = At { p, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
    let (mut cache, mut tape) = (Cache::default(), Tape::default());
    model.prepare(p, &[q], &mut cache);
    model.at(&q, &cache, &mut tape);
    tape.out
}

fn rmse(a: &[[f64; 3]], b: &[[f64; 3]]) -> f64 {
    let sum: f64 = a.iter().zip(b).flat_map(|(x, y)| (0..3).map(move |k| (x[k] - y[k]).powi(2))).sum();
    (sum / a.len() as f64).sqrt()
}

#[test]
fn noise_around_a_steady_path_is_calmed_and_an_onset_is_not_lagged() {
    const COUNT: usize = 120;
    const NOISE: f64 = 0.05;
    let rng = Rng::new(5, "noise", 0);
    let truth: Vec<[f64; 3]> = (0..COUNT).map(|i| [0.1 * i as f64, -0.05 * i as f64, 1.0]).collect();
    let seen: Vec<[f64; 3]> = truth
        .iter()
        .enumerate()
        .map(|(i, x)| std::array::from_fn(|k| x[k] + NOISE * rng.fork(i as u64).normal(k as u64)))
        .collect();
    let off = followed(seen.clone(), |s| s.fusion = Fusion::Off);
    assert!(rmse(&off, &seen) < 1e-12);
    let raw = rmse(&seen, &truth);
    let calm = followed(seen.clone(), |s| (s.baseline, s.history, s.gain) = (4, 24, 0.4));
    assert!(rmse(&calm, &truth) < 0.7 * raw, "{} of {raw}", rmse(&calm, &truth));
    // As published, from what the model states two frames back: extrapolation doubles the noise, so that less is won.
    let short = followed(seen, |s| s.gain = 5.0 / 6.0);
    assert!(rmse(&short, &truth) < 0.98 * raw, "{} of {raw}", rmse(&short, &truth));

    // At rest, then a sudden motion of many times its size per frame.
    let onset: Vec<[f64; 3]> = (0..40).map(|i| [if i < 20 { 0.0 } else { 9.0 * (i - 19) as f64 }, 0.0, 0.0]).collect();
    let reset = followed(onset.clone(), |s| (s.history, s.gain) = (8, 0.2));
    assert!((0..40).all(|i| reset[i] == onset[i] || (reset[i][0] - onset[i][0]).abs() < 1e-9), "{reset:?}");
    let lags = followed(onset.clone(), |s| (s.history, s.gain, s.gate) = (8, 0.2, 0.0));
    assert!(rmse(&lags, &onset) > 0.5, "without the gate the onset is missed");
}

#[test]
fn results_are_continuous_in_time() {
    let frames: Vec<[f64; 3]> = (0..30).map(|i| [(0.4 * i as f64).sin(), 0.02 * i as f64, 0.0]).collect();
    let mut p = Params::<f64>::new(1, 1, &[]);
    p[GEOMETRY].write(0, 3, [1.0, 0.0, 0.0, 0.0]);
    let inner: Arc<dyn Motion<f64>> = Arc::new(Watched { frames });
    for history in [0, 3] {
        let spec = FilteredSpec {
            fusion: Fusion::Geodesic,
            history,
            gate: 0.05,
            ..FilteredSpec::around(Spec::Still, FRAME, 0.0)
        };
        let filter = Filtered::around(inner.clone(), spec, &mut p).unwrap();
        let mut last = ask(&filter, &p, 0.0).read::<3>(0, 0);
        let step = 1e-3;
        for i in 1..2900 {
            let now = ask(&filter, &p, step * i as f64).read::<3>(0, 0);
            let jump = (0..3).map(|k| (now[k] - last[k]).abs()).fold(0.0, f64::max);
            assert!(jump < 0.05, "at {}: {jump}", step * i as f64);
            last = now;
        }
    }
}

fn spacetime() -> Spec {
    Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, detach: false, origin: 0.5, features: None })
}

fn filled<F: Real>(spec: &Spec, rows: usize) -> (Params<F>, Arc<dyn Motion<F>>) {
    let mut p = Params::<F>::new(rows, 1, LifeKind::GaussHalf.columns());
    let motion = build_model(spec, &mut p).unwrap();
    let rng = Rng::new(8, "filled", 0);
    for key in p.keys().collect::<Vec<_>>() {
        for row in 0..p[key].rows() {
            for col in 0..p[key].width() {
                let x = rng.fork(u64::from(key.0)).normal((row * 64 + col) as u64);
                *p[key].get_mut(row, col) += F::of(0.3 * x);
            }
        }
    }
    (p, motion)
}

#[test]
fn with_the_gradient_stopped_only_the_observation_learns() {
    let around = FilteredSpec { fusion: Fusion::Geodesic, ..FilteredSpec::around(spacetime(), 0.05, 0.0) };
    let of = |spec: FilteredSpec| {
        let (p, model) = filled::<f64>(&Spec::Filtered(spec), 9);
        let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(0.62) };
        let (mut cache, mut tape, mut d_cache) = (Cache::default(), Tape::default(), Cache::default());
        model.prepare(&p, &[q], &mut cache);
        model.at(&q, &cache, &mut tape);
        let mut d_out = tape.out.zeros_like();
        for j in 0..9 {
            d_out.write(j, 0, [1.0, 0.0, 0.0]);
        }
        let mut d = Grads::new(&p);
        let d_out = SplatGrads { out: &d_out, color: None, weights: None };
        model.backward(&q, &cache, &mut tape, &d_out, &mut d_cache, &mut d);
        d
    };
    let whole = of(FilteredSpec { stop_gradient: false, ..around.clone() });
    let stopped = of(around.clone());
    let gains = filled::<f64>(&Spec::Filtered(around), 9).0.find(GAINS).unwrap();
    for j in 0..9 {
        // μ = κμₒ + (1−κ)(2μ₁−μ₂): all of it is one to the canonical mean, κ alone where earlier results are constants.
        assert!((whole.table(GEOMETRY).get(j, 0) - 1.0).abs() < 1e-9);
        let kept = stopped.table(GEOMETRY).get(j, 0);
        assert!(kept > 0.2 && kept < 0.9, "{kept}");
        assert_eq!(whole.table(gains).get(j, 0), stopped.table(gains).get(j, 0), "the gain learns in both");
    }
}

/// The recursion of four frames, each fused with what two earlier ones predict, in the model's parameters and in time.
#[test]
fn gradients_run_through_the_history() {
    for fusion in [Fusion::Geodesic, Fusion::Literal] {
        let around = FilteredSpec::around(spacetime(), 0.05, 0.0);
        let spec = FilteredSpec { fusion, history: 3, baseline: 2, gate: 2.0, stop_gradient: false, ..around };
        let (p, model) = filled::<f64>(&Spec::Filtered(spec.clone()), 3);
        let weights = Rng::new(5, "weights", 0);
        let value = |p: &Params<f64>, t: f64| -> f64 {
            let out = ask(model.as_ref(), p, t);
            let of = |j: usize| (0..9).map(move |k| (j, k));
            (0..3).flat_map(of).map(|(j, k)| weights.normal((9 * j + k) as u64) * out.get(j, k)).sum()
        };
        let t = 0.62;
        let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
        let (mut cache, mut tape, mut d_cache) = (Cache::default(), Tape::default(), Cache::default());
        model.prepare(&p, &[q], &mut cache);
        model.at(&q, &cache, &mut tape);
        let mut d_out = tape.out.zeros_like();
        for j in 0..3 {
            d_out.write(j, 0, std::array::from_fn::<f64, 9, _>(|k| weights.normal((9 * j + k) as u64)));
        }
        let mut d = Grads::new(&p);
        let grads = SplatGrads { out: &d_out, color: None, weights: None };
        let d_time = model.backward(&q, &cache, &mut tape, &grads, &mut d_cache, &mut d);
        let near = |found: f64, fd: f64| (found - fd).abs() < 1e-5 * (1.0 + fd.abs());
        let fd = (value(&p, t + H) - value(&p, t - H)) / (2.0 * H);
        assert!(near(d_time, fd), "{fusion:?}, time: {d_time} and {fd}");
        let mut met = 0;
        for key in p.keys().filter(|&k| k != SH) {
            for (row, col) in (0..p[key].rows()).flat_map(|r| (0..p[key].width()).map(move |c| (r, c))) {
                let sides = [H, -H].map(|h| {
                    let mut p = p.clone();
                    *p[key].get_mut(row, col) += h;
                    value(&p, t)
                });
                let (found, fd) = (d.table(key).get(row, col), (sides[0] - sides[1]) / (2.0 * H));
                assert!(near(found, fd), "{fusion:?}, {} {row} {col}: {found} and {fd}", p.info(key).name);
                met += usize::from(fd.abs() > 1e-3);
            }
        }
        assert!(met > 30, "only {met} numbers matter");
        // Where earlier frames are constants, less is learnt from the same image.
        let stopped = FilteredSpec { stop_gradient: true, ..spec };
        let (p, model) = filled::<f64>(&Spec::Filtered(stopped), 3);
        let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
        let (mut cache, mut tape, mut d_cache) = (Cache::default(), Tape::default(), Cache::default());
        model.prepare(&p, &[q], &mut cache);
        model.at(&q, &cache, &mut tape);
        let mut short = Grads::new(&p);
        model.backward(&q, &cache, &mut tape, &grads, &mut d_cache, &mut short);
        assert!((0..3).any(|j| short.table(GEOMETRY).get(j, 0) != d.table(GEOMETRY).get(j, 0)));
    }
}

#[test]
fn a_filter_that_is_off_keeps_every_models_bits() {
    let mut met = Vec::new();
    for inner in models() {
        let (p, plain) = filled::<f64>(&inner, 20);
        let spec = FilteredSpec::around(inner.clone(), 1.0 / 30.0, 0.0);
        let mut held = p.clone();
        let wrapped = Filtered::around(plain.clone(), spec, &mut held).unwrap();
        let name = inner.name().to_owned();
        let ids = [1u32, 4, 7, 19];
        for rows in [Rows::All, Rows::Some(&ids)] {
            let both =
                [(&p, plain.as_ref()), (&held, &wrapped as &dyn Motion<f64>)].map(|(p, model)| whole(p, model, rows));
            assert!(both[0] == both[1], "{name}: wrapping changed an answer or a gradient");
        }
        let (mut a, mut b) = (p.clone(), held.clone());
        let mut edit = RowEdit::identity(Space::Gaussians, 20);
        edit.born[1] = Born::Split;
        edit.push(1, Born::Split);
        for (p, model) in [(&mut a, plain.as_ref()), (&mut b, &wrapped as &dyn Motion<f64>)] {
            p.apply(&edit);
            model.on_edit(p, &edit, &Rng::new(3, "edit", 0));
            model.resize(p, 2, 0.7);
        }
        for key in a.keys() {
            assert_eq!(a[key], b[key], "{name}");
        }
        assert_eq!(b[b.find(GAINS).unwrap()].rows(), 21);
        met.push(name);
    }
    assert!(met.iter().any(|n| n == "spacetime") && met.iter().any(|n| n == "still"), "{met:?}");
}

/// Every model that is there with a specification that needs no capture, as JSON: those that this build does not make
/// yet, or makes from other fields, are left out.
fn models() -> Vec<Spec> {
    let mut all = vec![Spec::Still, spacetime()];
    all.retain(|s| build_model::<f64>(s, &mut Params::new(4, 1, &[])).is_ok());
    all
}

/// Results, colours, gradients and velocities of a step with two queries.
fn whole(p: &Params<f64>, model: &dyn Motion<f64>, rows: Rows<'_>) -> Vec<f64> {
    let q = [0.21, 0.77].map(|t| At { p, of: Space::Gaussians, rows, t: Time(t) });
    let (mut cache, mut d_cache, mut d) = (Cache::default(), Cache::default(), Grads::new(p));
    let mut found = Vec::new();
    model.prepare(p, &q, &mut cache);
    for q in &q {
        let mut tape = Tape::default();
        model.at(q, &cache, &mut tape);
        found.extend((0..q.len()).flat_map(|j| tape.out.read::<10>(j, 0)));
        if let Color::Sh { weights: Some(w), .. } | Color::Direct { table: w } = model.color(q, &tape) {
            found.extend(w.column_to_rows(0, w.width()));
        }
        d.activate(q.of, q.rows);
        let d_out = tape.out.clone();
        let d_out = SplatGrads { out: &d_out, color: None, weights: None };
        found.push(model.backward(q, &cache, &mut tape, &d_out, &mut d_cache, &mut d));
        let mut v = Table::default();
        model.velocity(q, &mut v);
        found.extend(v.column_to_rows(0, 3));
    }
    model.finish(p, &q, &mut cache, &mut d_cache, &mut d);
    for key in p.keys().filter(|&k| p.info(k).name != GAINS) {
        found.extend(d.table(key).column_to_rows(0, p[key].width()));
    }
    let mut own = Table::new(&[("life", 2)], 0);
    found.push(f64::from(u8::from(model.life(p, &mut own))));
    found
}

#[test]
fn a_filter_forwards_colour_life_and_size_while_it_fuses() {
    let around = FilteredSpec { fusion: Fusion::Geodesic, ..FilteredSpec::around(spacetime(), 0.05, 0.0) };
    let (p, model) = filled::<f64>(&Spec::Filtered(around), 12);
    let out = ask(model.as_ref(), &p, 0.7);
    let (same, inner) = filled::<f64>(&spacetime(), 12);
    let plain = ask(inner.as_ref(), &same, 0.7);
    for j in 0..12 {
        assert_eq!(out.get(j, SPLAT_OPACITY), plain.get(j, SPLAT_OPACITY));
        assert!(out.read::<3>(j, 0) != plain.read::<3>(j, 0), "something is filtered");
    }
    let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(0.7) };
    let (mut cache, mut tape) = (Cache::default(), Tape::default());
    model.prepare(&p, &[q], &mut cache);
    model.at(&q, &cache, &mut tape);
    assert!(matches!(model.color(&q, &tape), Color::Sh { base: true, table, .. } if std::ptr::eq(table, &p[SH])));
    // The velocity is that of what is seen.
    let mut v = Table::default();
    model.velocity(&q, &mut v);
    let h = crate::motion::VELOCITY_STEP;
    let sides = [0.7 - h, 0.7 + h].map(|t| ask(model.as_ref(), &p, t));
    let fd = (sides[1].get(3, 0) - sides[0].get(3, 0)) / (2.0 * h);
    assert!((v.get(3, 0) - fd).abs() < 1e-12);
}

#[test]
fn hostile_filters_are_refused() {
    let sound = FilteredSpec::around(Spec::Still, 0.04, 0.0);
    let refused = |spec: FilteredSpec| build_model::<f32>(&Spec::Filtered(spec), &mut Params::new(3, 1, &[])).is_err();
    assert!(!refused(sound.clone()));
    let change = |f: &dyn Fn(&mut FilteredSpec)| {
        let mut s = sound.clone();
        f(&mut s);
        refused(s)
    };
    assert!(change(&|s| *s.inner = Spec::Filtered(sound.clone())), "a filter in a filter");
    assert!(change(&|s| *s.inner = Spec::Custom("mine".into())));
    for x in [0.0, 1.0, f64::NAN, -1.0] {
        assert!(change(&|s| s.gain = x));
    }
    for x in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(change(&|s| s.frame = x));
    }
    assert!(change(&|s| s.start = f64::NAN) && change(&|s| s.gate = -1.0) && change(&|s| s.gate = f64::NAN));
    assert!(change(&|s| s.baseline = 0) && change(&|s| s.baseline = usize::MAX));
    assert!(change(&|s| s.history = usize::MAX));
    // Files: what is written is read; depth is bounded before anything is made.
    let spec = Spec::Filtered(sound.clone());
    assert_eq!(spec_from_json(&spec_to_json(&spec)).unwrap(), spec);
    let mut deep = spec_to_json(&spec);
    for _ in 0..40 {
        let mut outer = spec_to_json(&spec);
        outer["inner"] = deep;
        deep = outer;
    }
    let deep = spec_from_json(&deep).unwrap();
    assert!(build_model::<f32>(&deep, &mut Params::new(3, 1, &[])).is_err());
}
