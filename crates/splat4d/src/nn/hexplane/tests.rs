use super::*;
use crate::scene::Table;

fn shape() -> PlaneShape {
    PlaneShape { channels: 16, resolution: 4, time_resolution: 5, multires: vec![1, 2] }
}

fn planes(shape: PlaneShape) -> (Params<f64>, Planes) {
    let mut p = Params::new(0, 1, &[]);
    let planes = Planes::new(shape, Rng::new(1, "planes", 0), &mut p).unwrap();
    (p, planes)
}

/// Sets every plane: f(plane, position along its axes in [0, 1], channel).
fn set(p: &mut Params<f64>, planes: &Planes, f: impl Fn(usize, [f64; 2], usize) -> f64) {
    for (level, keys) in planes.keys().iter().enumerate() {
        for (plane, &key) in keys.iter().enumerate() {
            let [w, h] = planes.shape().size(level, plane);
            let c = planes.shape().channels;
            for (i, x) in p[key].data_mut().iter_mut().enumerate() {
                let place = [(i / c % w) as f64 / (w - 1) as f64, (i / c / w) as f64 / (h - 1) as f64];
                *x = f(plane, place, i % c);
            }
        }
    }
}

fn random(p: &mut Params<f64>, planes: &Planes) {
    let rng = Rng::new(3, "random planes", 0);
    set(p, planes, |plane, [u, v], c| {
        rng.fork(plane as u64).normal((u * 1000.0) as u64 * 100_000 + (v * 1000.0) as u64 * 100 + c as u64)
    });
}

fn points(n: usize) -> Vec<[f64; 3]> {
    let rng = Rng::new(2, "points", 0);
    (0..n as u64).map(|i| [0, 1, 2].map(|k| 1.2 * rng.uniform(3 * i + k) - 0.1)).collect()
}

fn features(p: &Params<f64>, planes: &Planes, unlocked: usize, x: &[[f64; 3]], t: f64) -> Vec<f64> {
    let mut out = vec![9.0; x.len() * planes.shape().features()];
    planes.forward(p, &planes.lines(p, t), unlocked, x, &mut out);
    out
}

#[test]
fn affine_planes_are_interpolated_exactly_and_clamped_at_the_border() {
    let (mut p, planes) = planes(shape());
    let affine =
        |plane: usize, [u, v]: [f64; 2], c: usize| 1.0 + 0.3 * plane as f64 + 0.5 * u - 0.2 * v + 0.01 * c as f64;
    set(&mut p, &planes, affine);
    for (x, t) in [([0.3, 0.77, 0.5], 0.4), ([0.0, 1.0, 0.123], 1.0), ([-3.0, 0.2, 7.0], -1.0), ([0.5, 0.9, 2.0], 3.0)]
    {
        let got = features(&p, &planes, 2, &[x], t);
        let at = [x[0], x[1], x[2], t].map(|a: f64| a.clamp(0.0, 1.0));
        assert_eq!(got.len(), 32, "levels stand one after the other");
        for (i, got) in got.iter().enumerate() {
            let expected: f64 = (0..6).map(|p| affine(p, AXES[p].map(|a| at[a]), i % 16)).product();
            assert!((got - expected).abs() < 1e-12 * expected.abs(), "{x:?} at {t}, feature {i}: {got} {expected}");
        }
    }
}

#[test]
fn a_query_at_a_grid_point_returns_its_values() {
    let (mut p, planes) = planes(shape());
    random(&mut p, &planes);
    // Places 2, 1, 3 of 4 and time step 2 of 5 are grid points of level 0.
    let (at, step) = ([2usize, 1, 3], 2);
    let got = features(&p, &planes, 2, &[at.map(|i| i as f64 / 3.0)], 0.5);
    for c in 0..16 {
        let expected: f64 = (0..6)
            .map(|plane| {
                let [u, v] = AXES[plane].map(|a| if a == 3 { step } else { at[a] });
                p[planes.keys()[0][plane]].data()[(v * 4 + u) * 16 + c]
            })
            .product();
        assert!((got[c] - expected).abs() < 1e-12, "channel {c}: {} {expected}", got[c]);
    }
}

#[test]
fn time_planes_of_ones_give_features_independent_of_time() {
    let (mut p, planes) = planes(shape());
    set(
        &mut p,
        &planes,
        |plane, [u, v], c| if TEMPORAL.contains(&plane) { 1.0 } else { 0.5 + u * v + 0.01 * c as f64 },
    );
    let x = points(50);
    let (a, b) = (features(&p, &planes, 2, &x, 0.1), features(&p, &planes, 2, &x, 0.83));
    assert_eq!(a, b);
    let mut d = Grads::new(&p);
    let lines = planes.lines(&p, 0.3);
    let d_t = planes.backward(&p, &lines, 2, &x, &vec![1.0; a.len()], &mut vec![[0.0; 3]; 50], &mut Vec::new(), &mut d);
    assert_eq!(d_t, 0.0);
}

/// The most that neighbouring grid points differ by follows from how far apart the random ones are.
#[test]
fn planes_start_smooth_and_about_one() {
    let (p, planes) = planes(PlaneShape { resolution: 33, time_resolution: 17, ..shape() });
    for (level, keys) in planes.keys().iter().enumerate() {
        for (plane, &key) in keys.iter().enumerate() {
            let ([w, h], c, data) = (planes.shape().size(level, plane), planes.shape().channels, p[key].data());
            let step = |n: usize| (START[1] - START[0]) * (START_POINTS * (level + 1) - 1) as f64 / (n - 1) as f64;
            assert!(data.iter().all(|x| (START[0]..START[1]).contains(x)));
            let beside = |i: usize, by: usize| (data[i + by * c] - data[i]).abs();
            let far = |at: &dyn Fn(usize) -> bool, by: usize| {
                (0..w * h * c).filter(|i| at(i / c)).map(|i| beside(i, by)).fold(0.0, f64::max)
            };
            let (along, above) = (far(&|cell| cell % w + 1 < w, 1), far(&|cell| cell / w + 1 < h, w));
            assert!(along > 0.3 * step(w) && along <= step(w) + 1e-12, "{along} of {}", step(w));
            assert!(above > 0.3 * step(h) && above <= step(h) + 1e-12, "{above} of {}", step(h));
        }
    }
}

/// Central differences of Σ w·f to every table, to x and to t.
#[test]
fn gradients_equal_differences_also_where_factors_are_zero() {
    let (mut p, planes) = planes(shape());
    random(&mut p, &planes);
    // One factor is zero throughout channel 5, two are in channel 6.
    for plane in [0, 4] {
        for x in p[planes.keys()[0][plane]].data_mut().chunks_exact_mut(16) {
            x[6] = 0.0;
            if plane == 0 {
                x[5] = 0.0;
            }
        }
    }
    let (x, t) = (points(300), 0.37);
    let rng = Rng::new(5, "weights", 0);
    let w: Vec<f64> = (0..300 * 32).map(|i| rng.normal(i)).collect();
    let value = |p: &Params<f64>, x: &[[f64; 3]], t: f64| -> f64 {
        features(p, &planes, 2, x, t).iter().zip(&w).map(|(f, w)| f * w).sum()
    };
    let (mut d, mut d_x) = (Grads::new(&p), vec![[0.0; 3]; x.len()]);
    let d_t = planes.backward(&p, &planes.lines(&p, t), 2, &x, &w, &mut d_x, &mut vec![[7.0; LANES]; 5], &mut d);
    let near = |fd: f64, got: f64, what: &str| {
        assert!((fd - got).abs() < 1e-6 * (1.0 + fd.abs()), "{what}: differences {fd}, gradient {got}");
    };
    let h = 1e-6;
    near((value(&p, &x, t + h) - value(&p, &x, t - h)) / (2.0 * h), d_t, "t");
    for j in (0..300).step_by(17) {
        for k in 0..3 {
            let side = |h: f64| {
                let mut x = x.clone();
                x[j][k] += h;
                value(&p, &x, t)
            };
            near((side(h) - side(-h)) / (2.0 * h), d_x[j][k], &format!("point {j}, axis {k}, at {}", x[j][k]));
            assert!((0.0..1.0).contains(&x[j][k]) || d_x[j][k] == 0.0, "a clamped coordinate has no gradient");
        }
    }
    let mut met = [0; 2];
    for (level, keys) in planes.keys().iter().enumerate() {
        for (&key, name) in keys.iter().zip(NAMES) {
            for i in (0..p[key].rows()).step_by(41) {
                let mut side = |h: f64| {
                    let old = p[key].get(i, 0);
                    p[key].set(i, 0, old + h);
                    let value = value(&p, &x, t);
                    p[key].set(i, 0, old);
                    value
                };
                let fd = (side(h) - side(-h)) / (2.0 * h);
                near(fd, d.table(key).get(i, 0), &format!("{level}.{name}[{i}]"));
                met[level] += usize::from(fd != 0.0);
            }
        }
    }
    assert!(met[0] > 20 && met[1] > 20, "{met:?}");
}

#[test]
fn swapped_axes_of_points_and_planes_are_swapped_features() {
    let (mut p, planes) = planes(shape());
    let f = |plane: usize, [u, v]: [f64; 2], c: usize| ((plane + 2) as f64 * (3.0 * u + 7.0 * v * u) + c as f64).sin();
    set(&mut p, &planes, f);
    let x = points(40);
    let before = features(&p, &planes, 2, &x, 0.6);
    // x and y change positions: xy is transposed, xz and yz, xt and yt are exchanged.
    set(&mut p, &planes, |plane, [u, v], c| match plane {
        0 => f(0, [v, u], c),
        1 => f(3, [u, v], c),
        3 => f(1, [u, v], c),
        2 => f(4, [u, v], c),
        4 => f(2, [u, v], c),
        _ => f(5, [u, v], c),
    });
    let swapped: Vec<[f64; 3]> = x.iter().map(|[a, b, c]| [*b, *a, *c]).collect();
    let after = features(&p, &planes, 2, &swapped, 0.6);
    assert!(before.iter().zip(&after).all(|(a, b)| (a - b).abs() < 1e-12));
}

#[test]
fn locked_levels_output_zero_and_get_no_gradient() {
    let (mut p, planes) = planes(shape());
    random(&mut p, &planes);
    let x = points(200);
    let (one, two) = (features(&p, &planes, 1, &x, 0.4), features(&p, &planes, 2, &x, 0.4));
    for (one, two) in one.chunks(32).zip(two.chunks(32)) {
        assert_eq!(one[..16], two[..16]);
        assert!(one[16..].iter().all(|f| *f == 0.0));
    }
    let mut d = Grads::new(&p);
    planes.backward(&p, &planes.lines(&p, 0.4), 1, &x, &one, &mut vec![[0.0; 3]; 200], &mut Vec::new(), &mut d);
    assert!((0..6).all(|k| d.touched(planes.keys()[0][k]) && !d.touched(planes.keys()[1][k])));
}

#[test]
fn sizes_follow_the_formula_and_absurd_ones_are_refused() {
    let dnerf = PlaneShape { channels: 32, resolution: 64, time_resolution: 75, multires: vec![1, 2] };
    assert_eq!(dnerf.numbers(), 3 * 32 * 64 * 64 * (1 + 4) + 3 * 32 * 64 * 75 * (1 + 2));
    let (p, planes) = planes(shape());
    let stored: usize = planes.keys().as_flattened().iter().map(|&k| p[k].rows()).sum();
    assert_eq!(stored, shape().numbers());
    assert_eq!(shape().features(), 32);
    for bad in [
        PlaneShape { channels: 24, ..shape() },
        PlaneShape { channels: 0, ..shape() },
        PlaneShape { resolution: usize::MAX, ..shape() },
        PlaneShape { resolution: 1, ..shape() },
        PlaneShape { time_resolution: 0, ..shape() },
        PlaneShape { multires: vec![], ..shape() },
        PlaneShape { multires: vec![0], ..shape() },
        PlaneShape { multires: vec![1; 9], ..shape() },
        PlaneShape { channels: 128, resolution: 4096, ..shape() },
    ] {
        let mut p = Params::<f32>::new(0, 1, &[]);
        assert!(Planes::new(bad.clone(), Rng::new(0, "bad", 0), &mut p).is_err(), "{bad:?}");
    }
}

/// More points than wait to be scattered at a time, in f32.
#[test]
fn bits_do_not_depend_on_the_number_of_threads() {
    let (p, planes) = planes(shape());
    let p: Params<f32> = p.cast();
    let n = PARTS * PART_ROWS + PART_ROWS + 5;
    let x: Vec<[f32; 3]> = points(n).iter().map(|x| x.map(|x| x as f32)).collect();
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let lines = planes.lines(&p, 0.3f32);
            let mut out = vec![0.0f32; n * 32];
            planes.forward(&p, &lines, 2, &x, &mut out);
            let (mut d, mut d_x) = (Grads::new(&p), vec![[0.0f32; 3]; n]);
            let d_t = planes.backward(&p, &lines, 2, &x, &out, &mut d_x, &mut Vec::new(), &mut d);
            let tables: Vec<Table<f32>> = planes.keys().as_flattened().iter().map(|&k| d.table(k).clone()).collect();
            (out, d_x, d_t, tables)
        })
    };
    assert!(run(1) == run(5));
}
