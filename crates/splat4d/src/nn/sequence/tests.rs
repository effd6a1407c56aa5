//! Every layer's gradient, and the whole block's, against central differences.

use super::*;
use crate::nn::tests::{check, lanes, random, weighed};

const TICKS: usize = 6;
const WIDTH: usize = 5;

#[test]
fn norms_have_mean_zero_and_variance_one_and_their_gradient() {
    let x = random(WIDTH * TICKS, 1);
    let of = |x: &[Lane<f64>]| {
        let (mut unit, mut inverse) = (x.to_vec(), vec![[0.0; LANES]; TICKS]);
        norm(x, WIDTH, &mut unit, &mut inverse);
        (unit, inverse)
    };
    let (unit, inverse) = of(&x);
    let column: Vec<f64> = (0..WIDTH).map(|row| unit[row * TICKS + 2][7]).collect();
    assert!(column.iter().sum::<f64>().abs() < 1e-12);
    assert!((column.iter().map(|u| u * u).sum::<f64>() / WIDTH as f64 - 1.0).abs() < 1e-3);
    let mut d_x = vec![[0.0; LANES]; x.len()];
    norm_backward(&unit, &inverse, &random(x.len(), 99), &mut d_x);
    check("x", x.as_flattened(), d_x.as_flattened(), |x| weighed(&of(lanes(x)).0, 99));
}

#[test]
fn gelu_and_its_gradient_equal_the_definition() {
    let x = random(40, 2);
    let of = |x: &[Lane<f64>]| {
        let mut out = x.to_vec();
        gelu(x, &mut out);
        out
    };
    let mut d = random(40, 99);
    gelu_backward(&x, &mut d);
    check("x", x.as_flattened(), d.as_flattened(), |x| weighed(&of(lanes(x)), 99));
    let ends = of(&[[9.0; LANES], [-9.0; LANES], [0.0; LANES]]);
    assert!((ends[0][0] - 9.0).abs() < 1e-5 && ends[1][0].abs() < 1e-5 && ends[2][0] == 0.0);
}

#[test]
fn a_blocks_gradient_equals_differences() {
    for ways in [&[Direction::Forward][..], &[Direction::Forward, Direction::Backward]] {
        let mut layout = Layout::default();
        let block = Block::new("b", WIDTH, 3, ways, 0, &mut layout);
        let mut w = vec![0.0; layout.len()];
        block.init(TICKS, Rng::new(3, "block", 0), &mut w);
        let rng = Rng::new(4, "block", 0);
        w.iter_mut().enumerate().for_each(|(i, w)| *w += 0.1 * rng.normal(i as u64));
        let run = |w: &[f64], x: &[Lane<f64>], tape: &mut BlockTape<f64>| {
            let mut out = x.to_vec();
            block.forward(w, &block.scans().discrete(w, &[1.0]), &mut out, tape);
            out
        };
        let (x, mut tape) = (random(WIDTH * TICKS, 5), BlockTape::default());
        run(&w, &x, &mut tape);
        let layers = block.scans().discrete(&w, &[1.0]);
        let mut d_layers: Vec<_> = layers.iter().map(Discrete::none).collect();
        let (mut d_x, mut d_w) = (random(x.len(), 99), vec![0.0; w.len()]);
        block.backward(&w, &layers, &tape, &mut d_x, (&mut d_w, &mut d_layers));
        block.scans().discrete_backward(&w, &[1.0], &d_layers, &mut d_w);
        check("w", &w, &d_w, |w| weighed(&run(w, &x, &mut BlockTape::default()), 99));
        check("x", x.as_flattened(), d_x.as_flattened(), |x| {
            weighed(&run(&w, lanes(x), &mut BlockTape::default()), 99)
        });
    }
}
