use super::*;
use crate::scene::LifeKind;

/// Half the step of the central differences.
const H: f64 = 1e-6;

fn params<F: Real>() -> Params<F> {
    Params::new(0, 1, LifeKind::Infinite.columns())
}

fn numbers<F: Real>(n: usize, seed: u64) -> Vec<F> {
    let rng = Rng::new(seed, "numbers", 0);
    (0..n as u64).map(|i| F::of(rng.normal(i))).collect()
}

/// A network whose last map and biases are not zero either.
fn made<F: Real>(shape: MlpShape) -> (Params<F>, Mlp) {
    let mut p = params();
    let mlp = Mlp::new("net", shape, 1.0, Rng::new(3, "mlp", 0), &mut p).unwrap();
    for key in p.keys().skip(3).collect::<Vec<_>>() {
        let shift = numbers::<F>(p[key].rows(), u64::from(key.0));
        p[key].data_mut().iter_mut().zip(shift).for_each(|(x, s)| *x += F::of(0.1) * s);
    }
    (p, mlp)
}

fn value(mlp: &Mlp, p: &Params<f64>, x: &[f64], weights: &[f64]) -> f64 {
    let mut out = vec![0.0; weights.len()];
    mlp.forward(p, x, &mut out);
    out.iter().zip(weights).map(|(a, b)| a * b).sum()
}

const SHAPES: [MlpShape; 5] = [
    MlpShape { inputs: 3, width: 0, layers: 0, skip: None, outputs: 2 },
    MlpShape { inputs: 3, width: 5, layers: 1, skip: None, outputs: 2 },
    MlpShape { inputs: 3, width: 5, layers: 3, skip: Some(1), outputs: 2 },
    MlpShape { inputs: 2, width: 4, layers: 2, skip: Some(1), outputs: 1 },
    MlpShape { inputs: 2, width: 4, layers: 2, skip: Some(0), outputs: 3 },
];

#[test]
fn every_weight_and_input_equals_finite_differences() {
    for shape in SHAPES {
        let (mut p, mlp) = made::<f64>(shape);
        let n = 4;
        let mut x = numbers::<f64>(n * shape.inputs, 1);
        let weights = numbers::<f64>(n * shape.outputs, 2);
        let mut d = Grads::new(&p);
        let mut d_x = vec![9.0; x.len()];
        mlp.backward(&p, Passed::of(&x), &weights, InputGrad::Overwrite(&mut d_x), &mut d);
        let near = |fd: f64, got: f64| (fd - got).abs() < 1e-5 * fd.abs().max(1e-3);
        let mut met = 0;
        for key in p.keys().skip(3).collect::<Vec<_>>() {
            for row in 0..p[key].rows() {
                let old = p[key].get(row, 0);
                p[key].set(row, 0, old + H);
                let up = value(&mlp, &p, &x, &weights);
                p[key].set(row, 0, old - H);
                let down = value(&mlp, &p, &x, &weights);
                p[key].set(row, 0, old);
                let (fd, got) = ((up - down) / (2.0 * H), d.table(key).get(row, 0));
                met += usize::from(fd.abs() > 1e-3);
                assert!(near(fd, got), "{shape:?} {}[{row}]: {fd} {got}", p.info(key).name);
            }
        }
        assert!(2 * met > mlp.weights(), "{shape:?}: {met} of {} weights matter", mlp.weights());
        for i in 0..x.len() {
            let old = x[i];
            x[i] = old + H;
            let up = value(&mlp, &p, &x, &weights);
            x[i] = old - H;
            let down = value(&mlp, &p, &x, &weights);
            x[i] = old;
            let fd = (up - down) / (2.0 * H);
            assert!(near(fd, d_x[i]), "{shape:?} x[{i}]: {fd} {}", d_x[i]);
        }
    }
}

#[test]
fn without_hidden_layers_it_is_one_linear_map_and_a_skip_sees_the_input() {
    let (p, mlp) = made::<f64>(SHAPES[0]);
    let x = [0.5, -1.0, 2.0];
    let mut out = [0.0; 2];
    mlp.forward(&p, &x, &mut out);
    let (w, b) = (&p[mlp.maps[0].weight], &p[mlp.maps[0].bias]);
    for o in 0..2 {
        let sum: f64 = (0..3).map(|i| w.get(3 * o + i, 0) * x[i]).sum::<f64>() + b.get(o, 0);
        assert!((out[o] - sum).abs() < 1e-12);
    }
    // The last map of this one has the inputs [hidden 4, input 2]: with zero hidden layers only the input is left.
    let (mut p, mlp) = made::<f64>(SHAPES[3]);
    for map in &mlp.maps[..2] {
        p[map.weight].fill(0.0);
        p[map.bias].fill(-1.0);
    }
    let mut out = [0.0];
    mlp.forward(&p, &x[..2], &mut out);
    let (w, b) = (&p[mlp.maps[2].weight], &p[mlp.maps[2].bias]);
    assert_eq!(w.rows(), 6);
    assert!((out[0] - (w.get(4, 0) * x[0] + w.get(5, 0) * x[1] + b.get(0, 0))).abs() < 1e-12);
}

#[test]
fn starts_as_the_zero_map_with_hidden_layers_that_keep_their_size() {
    let shape = MlpShape { inputs: 20, width: 64, layers: 6, skip: None, outputs: 3 };
    let mut p = params::<f32>();
    let mlp = Mlp::new("net", shape, 0.0, Rng::new(1, "mlp", 0), &mut p).unwrap();
    let x = numbers::<f32>(100 * 20, 4);
    let (mut out, mut kept) = (vec![1.0; 300], LayerOutputs::default());
    mlp.forward_keeping(&p, &x, &mut out, &mut kept);
    assert!(out.iter().all(|y| *y == 0.0));
    let last = mlp.input(6, &x, &kept.data);
    let power = last.iter().map(|a| f64::from(a * a)).sum::<f64>() / last.len() as f64;
    assert!((0.2..5.0).contains(&power), "the sixth layer's mean square is {power}");
    assert_eq!(mlp.columns().len(), 14);
    assert!(mlp.columns().iter().all(|c| p.find(c).is_some()));
}

#[test]
fn any_number_of_threads_and_kept_activations_give_the_same_bits() {
    let shape = MlpShape { inputs: 7, width: 96, layers: 3, skip: Some(0), outputs: 5 };
    let (p, mlp) = made::<f32>(shape);
    let n = 20 * mlp.chunk_rows() + 77;
    let x = numbers::<f32>(n * 7, 1);
    let d_out = numbers::<f32>(n * 5, 2);
    let run = |threads: usize, keep: bool| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let (mut out, mut d_x, mut d) = (vec![0.0; n * 5], vec![0.0; n * 7], Grads::new(&p));
            let mut kept = LayerOutputs::default();
            if keep {
                mlp.forward_keeping(&p, &x, &mut out, &mut kept);
                assert!(kept.chunks > 0);
                // As if memory had been short.
                kept.chunks -= 3;
            } else {
                mlp.forward(&p, &x, &mut out);
            }
            mlp.backward(&p, Passed::kept(&x, &kept), &d_out, InputGrad::Overwrite(&mut d_x), &mut d);
            (out, d_x, d)
        })
    };
    let one = run(1, false);
    assert!(one == run(3, false) && one == run(4, true));
    // A row's result does not depend on the number of rows.
    let mut alone = vec![0.0; 5];
    mlp.forward(&p, &x[7 * 500..][..7], &mut alone);
    let worst = alone.iter().zip(&one.0[5 * 500..]).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst < 1e-4, "{worst}");
    let none: [f32; 0] = [];
    mlp.forward(&p, &none, &mut []);
    mlp.backward(&p, Passed::of(&none), &none, InputGrad::Overwrite(&mut []), &mut Grads::new(&p));
}

#[test]
fn a_shift_is_an_input_that_all_rows_share() {
    // The same network with the shared input repeated in every row.
    let shape = MlpShape { inputs: 3, width: 6, layers: 2, skip: Some(0), outputs: 2 };
    let (p, mlp) = made::<f64>(shape);
    let x = numbers::<f64>(5 * 3, 1);
    let shifts = [numbers::<f64>(6, 2), Vec::new(), numbers::<f64>(2, 3)];
    let weights = numbers::<f64>(10, 4);
    let value = |shifts: &[Vec<f64>]| {
        let mut out = vec![0.0; 10];
        mlp.forward_shifted(&p, &x, shifts, &mut out, &mut LayerOutputs::default());
        out.iter().zip(&weights).map(|(a, b)| a * b).sum::<f64>()
    };
    let mut d = Grads::new(&p);
    let passed = Passed { shifts: &shifts, ..Passed::of(&x) };
    let d_shifts = mlp.backward(&p, passed, &weights, InputGrad::Skip, &mut d);
    for map in [0, 2] {
        for i in 0..shifts[map].len() {
            let moved = |h: f64| {
                let mut shifts = shifts.clone();
                shifts[map][i] += h;
                value(&shifts)
            };
            let fd = (moved(H) - moved(-H)) / (2.0 * H);
            assert!((fd - d_shifts[map][i]).abs() < 1e-6 * fd.abs().max(1e-2), "{fd} {}", d_shifts[map][i]);
            let bias = d.table(mlp.maps[map].bias).get(i, 0);
            assert!((bias - d_shifts[map][i]).abs() < 1e-12, "the bias has the same gradient");
        }
    }
}

#[test]
fn hostile_shapes_are_refused() {
    let good = MlpShape { inputs: 3, width: 8, layers: 2, skip: None, outputs: 2 };
    for shape in [
        MlpShape { inputs: 0, ..good },
        MlpShape { inputs: usize::MAX, ..good },
        MlpShape { width: 0, ..good },
        MlpShape { width: MAX_WIDTH + 1, ..good },
        MlpShape { layers: usize::MAX, ..good },
        MlpShape { layers: 0, skip: Some(0), ..good },
        MlpShape { skip: Some(2), ..good },
        MlpShape { outputs: 0, ..good },
        MlpShape { width: MAX_WIDTH, layers: MAX_LAYERS, ..good },
    ] {
        assert!(Mlp::new::<f32>("net", shape, 1.0, Rng::new(0, "x", 0), &mut params()).is_err(), "{shape:?}");
    }
    assert!(good.maps().is_ok());
}
