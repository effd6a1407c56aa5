use super::*;
use crate::math::Rng;
use crate::scene::params::LoadedArray;
use crate::scene::{Rows, Time};

/// A cloud that is tracked for one frame.
fn start(rows: usize) -> (Params<f64>, Tracked) {
    let mut p = Params::new(rows, 1, &[]);
    let rng = Rng::new(3, "tracked", 0);
    for r in 0..rows {
        p[GEOMETRY].write::<11>(r, 0, std::array::from_fn(|c| rng.fork(r as u64).normal(c as u64)));
    }
    let model = Tracked::new(&TrackedSpec { times: vec![0.0], foreground: false }, &mut p).unwrap();
    (p, model)
}

/// A rotation by `angle` about the axis, as a unit quaternion.
fn turn(axis: [f64; 3], angle: f64) -> [f64; 4] {
    let (s, c) = (0.5 * angle).sin_cos();
    [c, s * axis[0], s * axis[1], s * axis[2]]
}

#[test]
fn propagation_reproduces_constant_velocities_exactly() {
    let (mut p, mut model) = start(40);
    let speed = |r: usize| [0.1 * r as f64, -0.2, 0.05];
    // The clock is uneven: what counts is the velocity, not the step.
    let times = [0.1, 0.25, 0.3, 0.6];
    for (k, &t) in times.iter().enumerate() {
        model = model.propagate(&mut p, t, f64::INFINITY).unwrap();
        for r in 0..40 {
            let start = p[GEOMETRY].read::<3>(r, 0);
            let truth: [f64; 3] = std::array::from_fn(|a| start[a] + t * speed(r)[a]);
            let key = model.page(k + 1);
            if k == 0 {
                assert_eq!(p[key].read::<7>(r, 0), p[GEOMETRY].read::<7>(r, 0), "the first step knows no velocity");
                p[key].write(r, 0, truth);
            }
            let got = p[key].read::<3>(r, 0);
            assert!((0..3).all(|a| (got[a] - truth[a]).abs() < 1e-12), "frame {}: {got:?} {truth:?}", k + 1);
        }
    }
    assert_eq!(model.times(), [0.0, 0.1, 0.25, 0.3, 0.6]);
}

#[test]
fn propagation_turns_on_whatever_the_signs_and_scales_of_quaternions() {
    let (mut p, model) = start(2);
    let (axis, angle) = ([0.6, 0.0, 0.8], 0.02);
    let first = [0.3, -0.5, 0.2, 0.79];
    let first = quat::normalize(first).0;
    p[GEOMETRY].write(0, QUAT, first.map(|x| 3.0 * x));
    let model = model.propagate(&mut p, 0.1, 1.0).unwrap();
    let second = quat::product(turn(axis, angle), first);
    p[model.page(1)].write(0, QUAT, second.map(|x| -0.5 * x));
    let model = model.propagate(&mut p, 0.2, 1.0).unwrap();
    let (third, got) = (quat::product(turn(axis, 2.0 * angle), first), p[model.page(2)].read::<4>(0, QUAT));
    let along: f64 = (0..4).map(|k| third[k] * got[k]).sum();
    // The chord overshoots the arc by the cube of the angle.
    assert!((along.abs() - 1.0).abs() < 1e-9, "{along}");
}

#[test]
fn extrapolation_is_bounded_by_the_cap() {
    let (mut p, model) = start(1);
    let model = model.propagate(&mut p, 0.1, 0.5).unwrap();
    let start = p[GEOMETRY].read::<3>(0, 0);
    p[model.page(1)].write(0, 0, [start[0] + 3.0, start[1], start[2] - 4.0]);
    let model = model.propagate(&mut p, 0.2, 0.5).unwrap();
    let got = p[model.page(2)].read::<3>(0, 0);
    let expected = [start[0] + 3.0 + 0.3, start[1], start[2] - 4.0 - 0.4];
    assert!((0..3).all(|k| (got[k] - expected[k]).abs() < 1e-12), "{got:?} {expected:?}");
}

#[test]
fn velocities_are_slopes_within_the_clip_and_zero_outside() {
    let (mut p, model) = start(1);
    let mut model = model;
    for (t, x) in [(1.0, 2.0), (3.0, 10.0)] {
        model = model.propagate(&mut p, t, 1.0).unwrap();
        let x0 = p[GEOMETRY].get(0, 0);
        p[model.page(model.times().len() - 1)].set(0, 0, x0 + x);
    }
    for (t, expected) in [(-1.0, 0.0), (0.0, 2.0), (0.4, 2.0), (1.0, 10.0 / 3.0), (2.0, 4.0), (3.0, 4.0), (4.0, 0.0)] {
        let mut out = Table::default();
        let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
        model.velocity(&q, &mut out);
        assert!((out.get(0, 0) - expected).abs() < 1e-12, "at {t} s: {}", out.get(0, 0));
    }
}

#[test]
fn files_that_lost_pages_or_have_absurd_times_are_refused() {
    let page = |k: u32| {
        PAGE.map(|(name, width)| LoadedArray { name: page_name(name, k), rows: 2, width, data: vec![0.5; 2 * width] })
    };
    let with = |pages: &[u32], times: Vec<f64>| {
        let arrays = pages.iter().flat_map(|&k| page(k)).collect();
        let mut p = Params::<f32>::build(arrays, 2, 1, &[]).unwrap();
        Tracked::new(&TrackedSpec { times, foreground: false }, &mut p)
            .map(|m| (p[m.page(m.times().len() - 1)].get(1, 6), p))
    };
    let (last, p) = with(&[1, 2], vec![0.0, 0.1, 0.2]).unwrap();
    assert!(last == 0.5 && p.unclaimed().is_empty() && p.info(Key(4)).page == Some(2), "pages are claimed");
    assert!(with(&[2], vec![0.0, 0.1, 0.2]).unwrap_err().to_string().contains("1 of 3"));
    for times in [vec![], vec![0.0, 0.0], vec![1.0, 0.0], vec![f64::NAN], vec![0.0, f64::INFINITY]] {
        assert!(with(&[], times).is_err());
    }
    let mut p = Params::<f32>::new(100_000, 1, &[]);
    let times = (0..100_000).map(f64::from).collect();
    assert!(Tracked::new(&TrackedSpec { times, foreground: false }, &mut p).is_err(), "280 GB are not made");
}
