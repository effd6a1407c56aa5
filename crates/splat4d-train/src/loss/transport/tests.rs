//! Values against the formulas, gradients against differences, and the schedule.

use super::*;
use splat4d::math::{spd, sym3};

const H: f64 = 1e-6;
const FD: f64 = 1e-6;

fn settings() -> TransportConfig {
    TransportConfig {
        metric: Metric::Wasserstein,
        predictor: Predictor::Wasserstein,
        temporal: 0.7,
        second: 1.3,
        align: 0.0,
        covariance: 3.0,
        extent: 2.0,
        clip: [0.0, 1.0],
        frame: 0.1,
        every: 1.0,
        start: 0.0,
        ramp: 0.0,
    }
}

fn normal(seed: u64, i: u64) -> Normal {
    let rng = Rng::new(seed, "transport test", 0).fork(i);
    // Neighbours in time are alike: a straight line through them stays a covariance.
    let base = Rng::new(seed, "transport test", 1);
    let x: [f64; 10] = std::array::from_fn(|k| base.normal(k as u64) + 0.1 * rng.normal(k as u64));
    let cov = sym3::from_quat_log_scales([2.0 + x[0], x[1], x[2], x[3]], [0.2 * x[4], 0.2 * x[5] - 0.4, 0.2 * x[6]]);
    Normal { mean: [x[7], x[8], x[9]], cov: spd::unpack(cov) }
}

#[test]
fn gradients_equal_differences() {
    for metric in [Metric::Linear, Metric::Wasserstein] {
        for (_, predictor) in Predictor::ALL {
            for seed in 0..6 {
                let loss = Transport::new(TransportConfig { metric, predictor, ..settings() }, 0);
                let at = [0, 1, 2].map(|i| normal(seed, i));
                let (_, d) = loss.row([&at[0], &at[1], &at[2]]);
                for i in 0..3 {
                    let grad: [f64; 9] = d[i].gradient();
                    for k in 0..9 {
                        let moved = |h: f64| {
                            let mut x = at;
                            let mut row: [f64; 9] = x[i].splat();
                            row[k] += h;
                            x[i] = Normal::of_splat(row);
                            loss.row([&x[0], &x[1], &x[2]]).0
                        };
                        let fd = (moved(H) - moved(-H)) / (2.0 * H);
                        assert!(
                            (fd - grad[k]).abs() < FD * (1.0 + fd.abs()),
                            "{metric:?} {predictor:?} {i} {k}: {fd} {}",
                            grad[k]
                        );
                    }
                }
            }
        }
    }
}

#[test]
fn uniform_motion_has_no_second_order_loss_and_its_length_as_first_order_loss() {
    let grown = |t: f64| {
        let s = 1.0 + 0.2 * t;
        Normal { mean: [3.0 * t, 0.0, -t], cov: spd::IDENTITY.map(|r| r.map(|x| x * s * s)) }
    };
    let at = [0.0, 1.0, 2.0].map(grown);
    let of = |change: &dyn Fn(&mut TransportConfig)| {
        let mut s = settings();
        change(&mut s);
        Transport::new(s, 0).row([&at[0], &at[1], &at[2]])
    };
    let (second, _) = of(&|s| s.temporal = 0.0);
    assert!(second < 1e-20, "{second}");
    assert!(of(&|s| (s.temporal, s.predictor) = (0.0, Predictor::Hold)).0 > 1e-3, "shapes that grow do not stay");
    // ‖Δμ‖² = 10 a frame, W₂² of the shapes 3·0.2² = 0.12, times 3, over 2².
    let (first, _) = of(&|s| (s.second, s.temporal) = (0.0, 1.0));
    assert!((first - (10.0 + 3.0 * 0.12) / 4.0).abs() < 1e-9, "{first}");
    let (linear, _) = of(&|s| (s.second, s.temporal, s.metric) = (0.0, 1.0, Metric::Linear));
    assert!((linear - 10.0 / 4.0).abs() < 1e-12, "{linear}");
}

#[test]
fn transport_loss_starts_at_its_step_and_samples_a_share_of_the_steps() {
    let loss = Transport::new(TransportConfig { start: 0.2, ramp: 0.1, every: 0.25, ..settings() }, 0);
    assert_eq!(
        [0.0, 0.19, 0.25, 0.3, 0.9].map(|p| (100.0 * loss.settings.factor(p)).round()),
        [0.0, 0.0, 50.0, 100.0, 100.0]
    );
    let info = |iteration, progress, t| StepInfo { iteration, times: vec![Time(t)], seed: 3, progress };
    let met = (0..2000).filter(|&i| loss.times(&info(i, 0.5, 0.5)).is_some()).count();
    assert!((420..580).contains(&met), "{met} of 2000");
    assert!((0..100).all(|i| loss.times(&info(i, 0.1, 0.5)).is_none()));
    let every = Transport::new(settings(), 0);
    let times = |t: f64| every.times(&info(0, 0.5, t)).expect("every step").map(|t| t.0);
    assert_eq!(times(0.37)[1], 0.37, "a view's own time is shared");
    assert_eq!([times(0.0)[0], times(0.0)[1]], [0.0, 0.1], "triples stay in the clip");
    assert!((times(1.0)[2] - 1.0).abs() < 1e-12);
    let short = Transport::new(TransportConfig { clip: [0.0, 0.1], ..settings() }, 0);
    assert!(short.times(&info(0, 0.5, 0.0)).is_none(), "two frames make no triple");
    let idle = Transport::new(TransportConfig { temporal: 0.0, second: 0.0, ..settings() }, 0);
    assert!(idle.times(&info(0, 0.5, 0.5)).is_none());
}
