use super::*;
use splat4d::math::Rng;
use splat4d::nn::hexplane::{NAMES, Planes};

const ALL: PlaneWeights = PlaneWeights { smoothness: 0.7, time_smoothness: 1.3, l1_time: 0.4, variation: 0.9 };

fn shape() -> PlaneShape {
    PlaneShape { channels: 16, resolution: 4, time_resolution: 5, multires: vec![1, 2] }
}

fn planes() -> (Params<f64>, Planes) {
    let mut p = Params::new(0, 1, &[]);
    let planes = Planes::new(shape(), Rng::new(1, "planes", 0), &mut p).unwrap();
    (p, planes)
}

/// Sets every plane: f(plane, position along the first axis, along the second, channel).
fn set(p: &mut Params<f64>, planes: &Planes, f: impl Fn(usize, usize, usize, usize) -> f64) {
    for (level, keys) in planes.keys().iter().enumerate() {
        for (plane, &key) in keys.iter().enumerate() {
            let [across, _] = shape().size(level, plane);
            for (i, x) in p[key].data_mut().iter_mut().enumerate() {
                *x = f(plane, i / 16 % across, i / 16 / across, i % 16);
            }
        }
    }
}

fn loss(p: &Params<f64>, weights: PlaneWeights) -> f64 {
    SmoothPlanes::new(shape(), usize::MAX, weights).of_layer(p, 1.0, &mut Grads::new(p))
}

#[test]
fn straight_planes_have_no_smoothness_loss_and_time_planes_of_ones_no_l1() {
    let (mut p, planes) = planes();
    let l1 = PlaneWeights { l1_time: 1.0, ..Default::default() };
    assert!(loss(&p, l1) > 0.1, "time planes start around 1");
    let second = PlaneWeights { smoothness: 1.0, time_smoothness: 1.0, ..Default::default() };
    assert!(loss(&p, second) > 1e-3, "random planes are not straight");
    set(&mut p, &planes, |plane, _, _, _| if NAMES[plane].ends_with('t') { 1.0 } else { 7.0 });
    assert_eq!(loss(&p, l1), 0.0, "nothing depends on time");
    set(&mut p, &planes, |_, u, v, c| 0.25 * u as f64 - 0.5 * v as f64 + c as f64);
    assert!(loss(&p, second) < 1e-25);
    let variation = PlaneWeights { variation: 1.0, ..Default::default() };
    // Every pair across differs by ¼, every pair down by ½: on 3 planes of 2 levels.
    assert!((loss(&p, variation) - 6.0 * (0.0625 + 0.25)).abs() < 1e-12);
    set(&mut p, &planes, |plane, u, v, _| if NAMES[plane].ends_with('t') { 3.0 } else { (u * u + v * v) as f64 });
    assert!((loss(&p, l1) - 2.0 * 6.0).abs() < 1e-12);
    // A parabola's second difference is 2, its square 4, along two axes of 3 planes of 2 levels; time planes are flat.
    assert!((loss(&p, second) - 4.0 * 2.0 * 6.0).abs() < 1e-10);
}

#[test]
fn time_is_smoothed_along_time_alone() {
    let (mut p, planes) = planes();
    let weights = PlaneWeights { time_smoothness: 1.0, ..Default::default() };
    set(&mut p, &planes, |_, u, _, _| (u * u * u) as f64);
    assert!(loss(&p, weights) < 1e-20);
    set(&mut p, &planes, |_, _, v, _| (v * v) as f64);
    assert!((loss(&p, weights) - 4.0 * 6.0).abs() < 1e-10);
}

#[test]
fn gradients_equal_differences_and_locked_levels_rest() {
    let (mut p, planes) = planes();
    let rng = Rng::new(4, "planes", 0);
    set(&mut p, &planes, |plane, u, v, c| rng.fork(plane as u64).normal((u * 1000 + v * 100 + c) as u64));
    for (unlocked, weights) in [(2, ALL), (1, ALL), (2, PlaneWeights { l1_time: 0.0, smoothness: 0.0, ..ALL })] {
        let smooth = SmoothPlanes::new(shape(), unlocked, weights);
        let mut d = Grads::new(&p);
        let value = smooth.of_layer(&p, 3.0, &mut d);
        assert!(value > 0.0);
        for (level, keys) in planes.keys().iter().enumerate() {
            for &key in keys {
                assert_eq!(d.touched(key), level < unlocked);
                for i in (0..p[key].rows()).step_by(37) {
                    let mut side = |h: f64| {
                        let old = p[key].get(i, 0);
                        p[key].set(i, 0, old + h);
                        let value = smooth.of_layer(&p, 1.0, &mut Grads::new(&p));
                        p[key].set(i, 0, old);
                        value
                    };
                    let fd = (side(1e-6) - side(-1e-6)) / 2e-6;
                    // The gradient was requested three times over.
                    let got = d.table(key).get(i, 0) / 3.0;
                    assert!((fd - got).abs() < 1e-8 * (1.0 + fd.abs()), "level {level}, {i}: {fd} {got}");
                }
            }
        }
    }
}
