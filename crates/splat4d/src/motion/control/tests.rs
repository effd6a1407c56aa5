use super::*;
use crate::scene::Time;

#[test]
fn cubic_curves_are_smooth_and_reproduce_straight_lines() {
    let line = Timeline::new(Curve::Cubic, 9, [2.0, 5.0]).unwrap();
    // Keys of a straight line extend it by one segment before and after the clip.
    let rate = 6.0 / 3.0;
    let at = |t: f64, keys: &dyn Fn(usize) -> f64| {
        let (first, w, slopes) = line.weights(Time(t));
        assert!((w.iter().sum::<f64>() - 1.0).abs() < 1e-12 && slopes.iter().sum::<f64>().abs() < 1e-9);
        let sum = |w: [f64; 4]| w.iter().enumerate().map(|(j, w)| w * keys(first + j)).sum::<f64>();
        (sum(w), sum(slopes))
    };
    for i in 1..60 {
        let t = 2.0 + 0.05 * f64::from(i);
        let (x, v) = at(t, &|key| (key as f64 - 1.0) / rate + 2.0);
        assert!((x - t).abs() < 1e-12 && (v - 1.0).abs() < 1e-9, "at {t}: {x}, slope {v}");
    }
    // Second differences of a curve through wild keys do not jump at knots (C²); third ones do.
    let wild = |key: usize| ((key * key * 7) % 5) as f64;
    let h = 1e-4;
    let second = |t: f64| (at(t + h, &wild).0 - 2.0 * at(t, &wild).0 + at(t - h, &wild).0) / (h * h);
    let (mut largest, mut third) = (0.0f64, 0.0f64);
    for knot in 1..6 {
        let t = 2.0 + f64::from(knot) / rate;
        largest = largest.max((second(t + 2.0 * h) - second(t - 2.0 * h)).abs());
        let slope = |t: f64| (second(t + 0.05) - second(t)) / 0.05;
        third = third.max((slope(t + 0.01) - slope(t - 0.06)).abs());
    }
    assert!(largest < 0.1 && third > 1.0, "curvature jumps by {largest}, its slope by {third}");
    // Outside the clip everything rests.
    assert_eq!(at(1.0, &wild), (at(2.0, &wild).0, 0.0));
    assert_eq!(at(99.0, &wild), (at(5.0, &wild).0, 0.0));
}

#[test]
fn wrong_specs_are_refused() {
    let trajectories = [
        TrajectorySpec::Keys { curve: Curve::Cubic, keys: 3 },
        TrajectorySpec::Keys { curve: Curve::Slerp, keys: usize::MAX },
        TrajectorySpec::LowRank { bases: 0, keys: 8 },
        TrajectorySpec::LowRank { bases: usize::MAX, keys: 8 },
        TrajectorySpec::Network { width: 0, layers: 2, position_levels: 2, time_levels: 2 },
        TrajectorySpec::Network { width: 8, layers: 2, position_levels: 99, time_levels: 2 },
    ];
    for trajectory in trajectories {
        let spec = ControlSpec { trajectory, ..ControlSpec::default() };
        assert!(spec.build(&mut Params::<f32>::new(8, 1, &[])).is_err(), "{trajectory:?}");
    }
    for clip in [[1.0, 0.0], [f64::NAN, 1.0], [0.0, f64::INFINITY]] {
        let spec = ControlSpec { clip, ..ControlSpec::default() };
        assert!(spec.build(&mut Params::<f32>::new(8, 1, &[])).is_err(), "{clip:?}");
    }
}
