use super::*;

const SHAPE: HashShape = HashShape { levels: 4, features: 2, log2_size: 6, base: 2, finest: 20 };

fn made<F: Real>(shape: HashShape, axes: &[usize], stride: usize) -> (Params<F>, HashGrid) {
    let mut p = Params::<F>::new(0, 1, &[]);
    let grid = HashGrid::new("grid", shape, axes, stride, Rng::new(5, "hash", 0), &mut p).unwrap();
    for &key in &grid.keys {
        let rng = Rng::new(u64::from(key.0), "entries", 0);
        p[key].data_mut().iter_mut().enumerate().for_each(|(i, x)| *x = F::of(rng.normal(i as u64)));
    }
    (p, grid)
}

fn points<F: Real>(n: usize, stride: usize) -> Vec<F> {
    (0..(n * stride) as u64).map(|i| F::of(0.02 + 0.96 * Rng::new(9, "points", 0).uniform(i))).collect()
}

#[test]
fn coarse_levels_are_dense_and_fine_ones_hashed() {
    let (_, grid) = made::<f32>(SHAPE, &[0, 1, 2], 3);
    let dense: Vec<bool> = grid.levels.iter().map(|l| l.dense).collect();
    assert_eq!(dense, [true, false, false, false]);
    let cells: Vec<usize> = grid.levels.iter().map(|l| l.cells).collect();
    assert_eq!((cells[0], cells[3]), (2, 20));
    assert_eq!(grid.levels[0].entries, 27);
    assert!(grid.columns().len() == 4 && grid.levels[3].entries == 64);
}

#[test]
fn weights_sum_to_one_and_dense_levels_reproduce_linear_functions() {
    let shape = HashShape { levels: 3, features: 1, log2_size: 14, base: 4, finest: 16 };
    let (mut p, grid) = made::<f64>(shape, &[0, 1, 2], 3);
    assert!(grid.levels.iter().all(|l| l.dense));
    let linear = |x: [f64; 3]| 0.7 + 2.0 * x[0] - 1.5 * x[1] + 0.3 * x[2];
    for (level, &key) in grid.levels.iter().zip(&grid.keys) {
        let side = level.cells + 1;
        for i in 0..side.pow(3) {
            let c = [i % side, i / side % side, i / side / side];
            p[key].set(i, 0, linear(c.map(|c| (c as f64 - 0.5) / (level.cells - 1) as f64)));
        }
    }
    let x = points::<f64>(50, 3);
    let mut out = vec![0.0; 150];
    grid.forward(&p, &x, &mut out, 0, 3);
    for (x, out) in x.chunks_exact(3).zip(out.chunks_exact(3)) {
        for y in out {
            assert!((y - linear([x[0], x[1], x[2]])).abs() < 1e-12);
        }
        let cell = grid.levels[1].cell::<f64, 3>(&[0, 1, 2], x);
        assert!(((0..8).map(|c| cell.weight(c)).sum::<f64>() - 1.0).abs() < 1e-14);
    }
}

#[test]
fn entries_and_points_equal_finite_differences() {
    for (axes, stride) in [(&[1, 3][..], 4), (&[0, 2, 3][..], 4), (&[0, 1, 2, 3][..], 4)] {
        let (mut p, grid) = made::<f64>(SHAPE, axes, stride);
        let mut x = points::<f64>(6, stride);
        // Outside the box nothing depends on the coordinate.
        (x[axes[0]], x[4 + axes[1]]) = (-0.3, 1.2);
        let (first, width) = (1, 10);
        let weights: Vec<f64> = (0..6 * width).map(|i| (0.37 * i as f64).sin()).collect();
        let value = |p: &Params<f64>, x: &[f64]| {
            let mut out = vec![0.0; 6 * width];
            grid.forward(p, x, &mut out, first, width);
            out.iter().zip(&weights).map(|(a, b)| a * b).sum::<f64>()
        };
        let (mut d, mut d_x) = (Grads::new(&p), vec![0.0; x.len()]);
        grid.backward(&p, &x, (&weights, first, width), Some(&mut d_x), &mut d);
        let near = |fd: f64, got: f64| (fd - got).abs() < 1e-6 * fd.abs().max(1.0);
        let h = 1e-6;
        for key in grid.keys.clone() {
            for row in 0..p[key].rows() {
                let old = p[key].get(row, 0);
                p[key].set(row, 0, old + h);
                let up = value(&p, &x);
                p[key].set(row, 0, old - h);
                let fd = (up - value(&p, &x)) / (2.0 * h);
                p[key].set(row, 0, old);
                assert!(near(fd, d.table(key).get(row, 0)), "{fd} {}", d.table(key).get(row, 0));
            }
        }
        for i in 0..x.len() {
            let old = x[i];
            x[i] = old + h;
            let up = value(&p, &x);
            x[i] = old - h;
            let fd = (up - value(&p, &x)) / (2.0 * h);
            x[i] = old;
            assert!(near(fd, d_x[i]), "{axes:?} x[{i}] = {old}: {fd} {}", d_x[i]);
        }
        assert_eq!((d_x[axes[0]], d_x[4 + axes[1]]), (0.0, 0.0));
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let (p, grid) = made::<f32>(SHAPE, &[0, 1, 2], 3);
    let x = points::<f32>(5000, 3);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let (mut out, mut d, mut d_x) = (vec![0.0; 5000 * 8], Grads::new(&p), vec![0.0; x.len()]);
            grid.forward(&p, &x, &mut out, 0, 8);
            grid.backward(&p, &x, (&out, 0, 8), Some(&mut d_x), &mut d);
            (out, d_x, d)
        })
    };
    assert!(run(1) == run(4));
}

#[test]
fn hostile_sizes_are_refused() {
    for shape in [
        HashShape { levels: 0, ..SHAPE },
        HashShape { levels: usize::MAX, ..SHAPE },
        HashShape { features: 0, ..SHAPE },
        HashShape { log2_size: 60, ..SHAPE },
        HashShape { base: 1, ..SHAPE },
        HashShape { base: 30, ..SHAPE },
        HashShape { finest: usize::MAX, ..SHAPE },
        HashShape { levels: 24, features: 8, log2_size: 22, base: 300, finest: 60_000 },
    ] {
        let mut p = Params::<f32>::new(0, 1, &[]);
        assert!(HashGrid::new("g", shape, &[0, 1, 2], 3, Rng::new(0, "x", 0), &mut p).is_err(), "{shape:?}");
    }
}
