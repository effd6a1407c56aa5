//! The scan against its definition, the zero-order hold against exponentials, and every gradient against differences.

use super::*;
use crate::nn::tests::random;

const SHAPE: Shape = Shape { channels: 3, states: 4, copies: 1 };

fn weights_of(shape: Shape, seed: u64) -> Vec<f64> {
    let mut w = vec![0.0; weights(shape)];
    init(shape, 30, Rng::new(seed, "w", 0), &mut w);
    let rng = Rng::new(seed, "shake", 0);
    w.iter_mut().enumerate().for_each(|(i, w)| *w += 0.2 * rng.normal(i as u64));
    w
}

fn states(len: usize, seed: u64) -> Vec<Pair<f64>> {
    random(2 * len, seed).as_chunks().0.to_vec()
}

/// Result of a scan: outputs, last states, marks.
fn scan(of: &Discrete<f64>, way: Direction, u: &[Lane<f64>], first: &[Pair<f64>]) -> (Vec<Lane<f64>>, Vec<Pair<f64>>) {
    let (mut y, mut state) = (vec![[0.0; LANES]; u.len()], first.to_vec());
    of.scan(way, u, &mut y, &mut state, &mut Vec::new());
    (y, state)
}

fn worst(a: &[Lane<f64>], b: &[Lane<f64>]) -> f64 {
    a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[test]
fn the_scan_equals_the_recursion_and_the_convolution() {
    let (ticks, w) = (41, weights_of(SHAPE, 1));
    let of = Discrete::new(SHAPE, &w, &[1.0]);
    let u = random(3 * ticks, 2);
    for way in [Direction::Forward, Direction::Backward] {
        let (y, _) = scan(&of, way, &u, &of.rest());
        for (h, k) in (0..3).map(|h| (h, of.response(h, ticks))) {
            for t in 0..ticks {
                let past = |m: usize| if way == Direction::Forward { t.checked_sub(m) } else { Some(t + m) };
                let expected: f64 =
                    (0..ticks).filter_map(|m| past(m).filter(|&s| s < ticks).map(|s| k[m] * u[h * ticks + s][5])).sum();
                assert!((y[h * ticks + t][5] - expected).abs() < 1e-10, "{way:?} channel {h} tick {t}");
            }
        }
    }
}

#[test]
fn a_held_input_is_integrated_exactly_whatever_the_step() {
    // h' = Λh + Bu with constant u: h(T) = (e^{ΛT} − 1)/Λ·Bu. Any number of ticks must give it.
    let shape = Shape { channels: 1, states: 1, copies: 1 };
    let (a, omega, log_step) = (0.3f64, 1.7f64, -1.2f64);
    let w = [a.ln(), omega, 1.0, 0.0, 1.0, 0.0, 0.0, log_step];
    let span = 6.0 * log_step.exp();
    let turn = [(-a * span).exp() * (omega * span).cos() - 1.0, (-a * span).exp() * (omega * span).sin()];
    let exact = over(turn, [-a, omega]);
    for ticks in [1, 2, 3, 6, 48] {
        let of = Discrete::<f64>::new(shape, &w, &[6.0 / ticks as f64]);
        let (y, last) = scan(&of, Direction::Forward, &vec![[1.0; LANES]; ticks], &of.rest());
        assert!((last[0][0][0] - exact[0]).abs() < 1e-12 && (last[0][1][0] - exact[1]).abs() < 1e-12, "{ticks} ticks");
        assert!((y[ticks - 1][0] - exact[0]).abs() < 1e-12);
    }
    // The series meets the quotient where one takes over from the other.
    for z in [0.999 * SERIES, 1.001 * SERIES] {
        let [power, phi, slope] = Hold { step: 1.0, z: [-0.6 * z, 0.8 * z], free: [true; 3] }.quotients();
        let direct = over([power[0] - 1.0, power[1]], [-0.6 * z, 0.8 * z]);
        assert!((phi[0] - direct[0]).abs() < 1e-13 && (phi[1] - direct[1]).abs() < 1e-13);
        let direct = over([power[0] - phi[0], power[1] - phi[1]], [-0.6 * z, 0.8 * z]);
        assert!((slope[0] - direct[0]).abs() < 1e-12 && (slope[1] - direct[1]).abs() < 1e-12);
    }
}

#[test]
fn every_mode_decays_whatever_its_weights() {
    let shape = Shape { channels: 8, states: 16, copies: 1 };
    for seed in 0..20 {
        let mut w = vec![0.0; weights(shape)];
        let rng = Rng::new(seed, "fuzz", 0);
        w.iter_mut().enumerate().for_each(|(i, w)| *w = 6.0 * rng.normal(i as u64));
        let of = Discrete::<f64>::new(shape, &w, &[1.0]);
        let fine = |a: &Complex<f64>| a[0].hypot(a[1]) < 1.0 && a[0].is_finite();
        assert!(of.decay.iter().all(fine) && of.drive.iter().flatten().all(|b| b.is_finite()), "seed {seed}");
    }
    let of = Discrete::<f64>::new(shape, &weights_of(shape, 3), &[1.0]);
    let k = of.response(0, 4000);
    assert!(k[3900..].iter().all(|y| y.abs() < 1e-3 * k[1].abs().max(1e-3)), "an impulse dies away");
}

#[test]
fn windows_with_carried_states_and_any_chunk_equal_the_whole_scan() {
    let (ticks, cut, of) = (40, 23, Discrete::new(SHAPE, &weights_of(SHAPE, 4), &[1.0]));
    let (u, first) = (random(3 * ticks, 5), states(12, 6));
    let (y, last) = scan(&of, Direction::Forward, &u, &first);
    let part = |from: usize, to: usize| -> Vec<Lane<f64>> {
        (0..3).flat_map(|h| u[h * ticks + from..h * ticks + to].to_vec()).collect()
    };
    let (head, middle) = scan(&of, Direction::Forward, &part(0, cut), &first);
    let (tail, end) = scan(&of, Direction::Forward, &part(cut, ticks), &middle);
    assert_eq!(last, end);
    for h in 0..3 {
        assert_eq!(y[h * ticks..h * ticks + cut], head[h * cut..(h + 1) * cut]);
        assert_eq!(y[h * ticks + cut..(h + 1) * ticks], tail[h * (ticks - cut)..(h + 1) * (ticks - cut)]);
    }
}

#[test]
fn a_forward_scan_does_not_depend_on_the_future() {
    let (ticks, of) = (20, Discrete::new(SHAPE, &weights_of(SHAPE, 7), &[1.0]));
    let u = random(3 * ticks, 8);
    let mut other = u.clone();
    (0..3).for_each(|h| other[h * ticks + 12][0] += 1.0);
    for way in [Direction::Forward, Direction::Backward] {
        let (a, b) = (scan(&of, way, &u, &of.rest()).0, scan(&of, way, &other, &of.rest()).0);
        for h in 0..3 {
            let differs = |t: usize| a[h * ticks + t][0] != b[h * ticks + t][0];
            assert_eq!(!(0..12).any(differs), way == Direction::Forward, "{way:?}");
            assert_eq!(!(13..ticks).any(differs), way == Direction::Backward, "{way:?}");
            assert!(differs(12) && a[h * ticks + 12][1] == b[h * ticks + 12][1], "one lane alone");
        }
    }
}

/// Differences of all weights, of inputs and of first states, for evenly and unevenly spaced ticks.
#[test]
fn the_gradient_equals_differences_everywhere() {
    let ticks = 37;
    let uneven: Vec<f64> = (0..ticks).map(|t| 0.6 + 0.05 * (t % 11) as f64).collect();
    for (shape, gaps) in [(SHAPE, vec![1.0]), (SHAPE, uneven), (Shape { copies: 3, channels: 2, states: 2 }, vec![1.0])]
    {
        for way in [Direction::Forward, Direction::Backward] {
            let w = weights_of(shape, 9);
            let rows = shape.channels * shape.copies;
            let (u, first) = (random(rows * ticks, 10), states(rows * shape.states, 11));
            let (by_y, by_last) = (random(u.len(), 12), states(first.len(), 13));
            let value = |w: &[f64], u: &[Lane<f64>], first: &[Pair<f64>]| -> f64 {
                let (y, last) = scan(&Discrete::new(shape, w, &gaps), way, u, first);
                let last = last.as_flattened().as_flattened().iter().zip(by_last.as_flattened().as_flattened());
                let y = y.as_flattened().iter().zip(by_y.as_flattened());
                y.chain(last).map(|(a, b)| a * b).sum()
            };
            let of = Discrete::new(shape, &w, &gaps);
            let (mut y, mut state, mut marks) = (u.clone(), first.clone(), Vec::new());
            of.scan(way, &u, &mut y, &mut state, &mut marks);
            let (mut d_u, mut d_first) = (vec![[0.0; LANES]; u.len()], by_last.clone());
            let mut d = Discrete::zeros(shape, gaps.len());
            of.scan_backward(way, &u, &marks, &by_y, &mut d_u, &mut d_first, &mut d);
            let mut d_w = vec![0.0; w.len()];
            Discrete::backward(&w, &gaps, &d, &mut d_w);
            let h = 1e-6;
            let near = |fd: f64, got: f64| (fd - got).abs() < 2e-6 * (1.0 + fd.abs());
            for i in 0..w.len() {
                let at = |h: f64| {
                    let mut w = w.clone();
                    w[i] += h;
                    value(&w, &u, &first)
                };
                let fd = (at(h) - at(-h)) / (2.0 * h);
                assert!(near(fd, d_w[i]), "{way:?} weight {i}: {fd} {}", d_w[i]);
            }
            for i in (0..u.len() * LANES).step_by(29) {
                let at = |h: f64| {
                    let mut u = u.clone();
                    u.as_flattened_mut()[i] += h;
                    value(&w, &u, &first)
                };
                let fd = (at(h) - at(-h)) / (2.0 * h);
                assert!(near(fd, d_u.as_flattened()[i]), "{way:?} input {i}: {fd}");
            }
            for i in (0..first.len() * 2 * LANES).step_by(7) {
                let at = |h: f64| {
                    let mut first = first.clone();
                    first.as_flattened_mut().as_flattened_mut()[i] += h;
                    value(&w, &u, &first)
                };
                let fd = (at(h) - at(-h)) / (2.0 * h);
                assert!(near(fd, d_first.as_flattened().as_flattened()[i]), "{way:?} state {i}: {fd}");
            }
        }
    }
}

#[test]
fn uneven_ticks_sample_the_same_response_to_first_order() {
    // A smooth input on even ticks, and on ticks moved by up to a third: y at the same time nearly agrees, and twice as
    // near with half the step.
    let shape = Shape { channels: 1, states: 4, copies: 1 };
    let w = weights_of(shape, 14);
    let error = |ticks: usize| {
        let gap = 40.0 / ticks as f64;
        let moved: Vec<f64> = (0..ticks).map(|t| gap * if t % 2 == 0 { 1.3 } else { 0.7 }).collect();
        let mut at = 0.0;
        let (mut even, mut uneven) = (Vec::new(), Vec::new());
        for (t, m) in moved.iter().enumerate() {
            even.push([(0.2 * gap * (t + 1) as f64).sin(); LANES]);
            at += m;
            uneven.push([(0.2f64 * at).sin(); LANES]);
        }
        let steady = Discrete::<f64>::new(shape, &w, &[gap]);
        let other = Discrete::<f64>::new(shape, &w, &moved);
        let a = scan(&steady, Direction::Forward, &even, &steady.rest()).0;
        let b = scan(&other, Direction::Forward, &uneven, &other.rest()).0;
        // Every second tick is at the same time.
        (1..ticks).step_by(2).map(|t| (a[t][0] - b[t][0]).abs()).fold(0.0, f64::max)
    };
    let (coarse, fine) = (error(80), error(160));
    assert!(fine < 0.02 && fine < 0.65 * coarse, "{coarse} {fine}");
}

#[test]
fn missing_gradients_of_chunks_and_ticks_equal_zero_gradients() {
    // Marks and chunks give the same gradient as one chunk would: a scan shorter than a chunk, and the same as a part
    // of a longer one whose rest has no gradient.
    let of = Discrete::new(SHAPE, &weights_of(SHAPE, 15), &[1.0]);
    let long = 3 * CHUNK + 5;
    let u = random(3 * long, 16);
    let gradient = |ticks: usize| {
        let cut: Vec<Lane<f64>> = (0..3).flat_map(|h| u[h * long..h * long + ticks].to_vec()).collect();
        let mut by_y = vec![[0.0; LANES]; cut.len()];
        (0..3).for_each(|h| by_y[h * ticks..h * ticks + CHUNK - 1].fill([1.0; LANES]));
        let (mut y, mut state, mut marks) = (cut.clone(), of.rest(), Vec::new());
        of.scan(Direction::Forward, &cut, &mut y, &mut state, &mut marks);
        let (mut d_u, mut d) = (vec![[0.0; LANES]; cut.len()], Discrete::zeros(SHAPE, 1));
        of.scan_backward(Direction::Forward, &cut, &marks, &by_y, &mut d_u, &mut of.rest(), &mut d);
        (d, (0..3).flat_map(|h| d_u[h * ticks..h * ticks + CHUNK - 1].to_vec()).collect::<Vec<_>>())
    };
    let (short, whole) = (gradient(CHUNK - 1), gradient(long));
    assert!(worst(&short.1, &whole.1) < 1e-12);
    let near = |a: &[Complex<f64>], b: &[Complex<f64>]| {
        a.iter().flatten().zip(b.iter().flatten()).all(|(a, b)| (a - b).abs() < 1e-10)
    };
    assert!(near(&short.0.decay, &whole.0.decay) && near(&short.0.output, &whole.0.output));
}
