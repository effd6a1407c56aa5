//! Vector neurons: gradients, and that they turn and mirror with their input.

use super::*;
use crate::math::quat;
use crate::nn::tests::{check, lanes, random, weighed};

const TICKS: usize = 5;

/// An orthogonal matrix; every second one mirrors.
fn orthogonal(i: u64) -> [[f64; 3]; 3] {
    let rng = Rng::new(i, "turn", 0);
    let r = quat::to_rotation(quat::normalize(std::array::from_fn(|k| rng.normal(k as u64))).0);
    if i.is_multiple_of(2) { r } else { r.map(|row| row.map(|x| -x)) }
}

fn turned(r: &[[f64; 3]; 3], x: &[Lane<f64>]) -> Vec<Lane<f64>> {
    let mut out = x.to_vec();
    for c in 0..x.len() / (3 * TICKS) {
        for t in 0..TICKS {
            let v = read(x, c, TICKS, t);
            let w = [0, 1, 2].map(|i| std::array::from_fn(|l| (0..3).map(|k| r[i][k] * v[k][l]).sum()));
            write(&mut out, c, TICKS, t, &w);
        }
    }
    out
}

fn distance(a: &[Lane<f64>], b: &[Lane<f64>]) -> f64 {
    a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[test]
fn vector_relu_is_equivariant_and_its_gradient_is_right() {
    let (q, k) = (random(4 * 3 * TICKS, 1), random(4 * 3 * TICKS, 2));
    let of = |q: &[Lane<f64>], k: &[Lane<f64>]| {
        let mut out = q.to_vec();
        relu(TICKS, q, k, &mut out);
        out
    };
    let out = of(&q, &k);
    assert!(distance(&out, &q) > 0.1, "some vectors lose a part");
    for i in 0..10 {
        let r = orthogonal(i);
        assert!(distance(&of(&turned(&r, &q), &turned(&r, &k)), &turned(&r, &out)) < 1e-12);
    }
    let (mut d_q, mut d_k) = (q.clone(), q.clone());
    relu_backward(TICKS, (&q, &k), &random(q.len(), 9), &mut d_q, &mut d_k);
    check("q", q.as_flattened(), d_q.as_flattened(), |x| weighed(&of(lanes(x), &k), 9));
    check("k", k.as_flattened(), d_k.as_flattened(), |x| weighed(&of(&q, lanes(x)), 9));
}

struct Toy {
    block: VectorBlock,
    w: Vec<f64>,
}

fn toy() -> Toy {
    let mut layout = Layout::default();
    let ways = [Direction::Forward, Direction::Backward];
    let block = VectorBlock::new("b", 4, 3, &ways, 0, &mut layout);
    let mut w = vec![0.0; layout.len()];
    block.init(TICKS, Rng::new(3, "toy", 0), &mut w);
    let rng = Rng::new(4, "toy", 0);
    w.iter_mut().enumerate().for_each(|(i, w)| *w += 0.1 * rng.normal(i as u64));
    Toy { block, w }
}

impl Toy {
    fn run(&self, w: &[f64], x: &[Lane<f64>], tape: &mut VectorTape<f64>) -> Vec<Lane<f64>> {
        let mut out = x.to_vec();
        self.block.forward(w, &self.block.scans().discrete(w, &[1.0]), &mut out, tape);
        out
    }
}

#[test]
fn a_vector_block_is_equivariant_to_rotations_and_reflections() {
    let toy = toy();
    let x = random(4 * 3 * TICKS, 5);
    let out = toy.run(&toy.w, &x, &mut VectorTape::default());
    for i in 0..10 {
        let r = orthogonal(i);
        let other = toy.run(&toy.w, &turned(&r, &x), &mut VectorTape::default());
        assert!(distance(&other, &turned(&r, &out)) < 1e-11);
    }
}

#[test]
fn a_blocks_gradient_equals_differences() {
    let toy = toy();
    let x = random(4 * 3 * TICKS, 6);
    let mut tape = VectorTape::default();
    toy.run(&toy.w, &x, &mut tape);
    let layers = toy.block.scans().discrete(&toy.w, &[1.0]);
    let mut d_layers: Vec<_> =
        layers.iter().map(|_| Discrete::zeros(ssm::Shape { channels: 4, states: 3, copies: 3 }, 1)).collect();
    let (mut d_x, mut d_w) = (random(x.len(), 9), vec![0.0; toy.w.len()]);
    toy.block.backward(&toy.w, &layers, &tape, &mut d_x, (&mut d_w, &mut d_layers));
    toy.block.scans().discrete_backward(&toy.w, &[1.0], &d_layers, &mut d_w);
    let value = |w: &[f64], x: &[Lane<f64>]| weighed(&toy.run(w, x, &mut VectorTape::default()), 9);
    check("w", &toy.w, &d_w, |w| value(w, &x));
    check("x", x.as_flattened(), d_x.as_flattened(), |x| value(&toy.w, lanes(x)));
}
