//! The list of the method: rotations, slices, conversions, colours, safeguards.

use super::slice::{Frame, quaternions, rotation4, slice, slice_backward};
use super::sliced::determinant;
use super::*;
use crate::layers::{Layer, LayerTape, to_native4d, to_spacetime};
use crate::math::{quat, sym3};
use crate::motion::{Spacetime, SpacetimeSpec};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{LIFE, LifeKind, Rows, Time};

const SPEC: Native4dSpec =
    Native4dSpec { speed: 1.7, min_life: 1e-4, max_life: 50.0, harmonics: 0, period: 1.0, split_time: true };

fn frame() -> Frame<f64> {
    SPEC.frame()
}

fn draw(i: u64) -> ([f64; 11], [f64; OWN]) {
    let rng = Rng::new(11, "native4d", i);
    let n = |k: u64| rng.normal(k);
    let g = std::array::from_fn(|c| if c < 7 { n(c as u64) } else { 0.5 * n(c as u64) - 0.5 });
    (g, std::array::from_fn(|c| if c < 2 { 0.5 * n(20 + c as u64) } else { n(20 + c as u64) }))
}

fn layer(rows: usize, spec: Native4dSpec) -> Layer<f64> {
    let mut params = Params::<f64>::new(rows, 1, &[]);
    let motion = Native4d::new(spec, &mut params).unwrap();
    for row in 0..rows {
        let (g, own) = draw(row as u64);
        params[GEOMETRY].write(row, 0, g);
        params[motion.own()].write(row, 0, own);
    }
    let (name, motion) = ("a".to_owned(), Arc::new(motion) as Arc<dyn Motion<f64>>);
    Layer::new(name, params, motion, LifeKind::Infinite)
}

fn splats<F: Real>(layer: &Layer<F>, t: f64) -> Table<F> {
    let mut tape = LayerTape::default();
    tape.request(Space::Gaussians, Rows::All, Time(t));
    layer.at(&Cache::default(), &mut tape);
    tape.out().clone()
}

#[test]
fn rotations_are_rotations_and_equal_quaternions_turn_space_alone() {
    for i in 0..200 {
        let rng = Rng::new(1, "quats", i);
        let [l, r] = [0, 1].map(|s| quat::normalize(std::array::from_fn(|k| rng.normal(4 * s + k as u64))).0);
        let m = rotation4(l, r);
        for a in 0..4 {
            for b in 0..4 {
                let dot: f64 = (0..4).map(|k| m[a][k] * m[b][k]).sum();
                assert!((dot - f64::from(u8::from(a == b))).abs() < 1e-14);
            }
        }
        assert!((determinant(&m) - 1.0).abs() < 1e-13);
        let back = quaternions(m);
        let again = rotation4(back[0], back[1]);
        assert!((0..16).all(|k| (m[k / 4][k % 4] - again[k / 4][k % 4]).abs() < 1e-14));
        let (space, three) = (rotation4(l, l), quat::to_rotation(l));
        for a in 0..4 {
            for b in 0..4 {
                let expected = if a < 3 && b < 3 { three[a][b] } else { f64::from(u8::from(a == b)) };
                assert!((space[a][b] - expected).abs() < 1e-14);
            }
        }
        // Opposite turns leave a plane with t in it moving: a velocity.
        let conjugate = [l[0], -l[1], -l[2], -l[3]];
        assert!((0..3).any(|a| rotation4(l, conjugate)[a][3].abs() > 1e-3));
    }
}

/// The reference's matrices: M_l M_r with both axes reversed. Its quaternions have x and z swapped and their signs
/// changed, and, since it turns the conjugate of X, its left one is our right one.
#[test]
fn the_reference_writes_the_same_rotation_with_reversed_axes() {
    let m_l = |[a, b, c, d]: [f64; 4]| [[a, -b, -c, -d], [b, a, -d, c], [c, d, a, -b], [d, -c, b, a]];
    let m_r = |[p, q, r, s]: [f64; 4]| [[p, q, r, s], [-q, p, -s, r], [-r, s, p, -q], [-s, -r, q, p]];
    for i in 0..50 {
        let rng = Rng::new(2, "quats", i);
        let [l, r] = [0, 1].map(|s| quat::normalize(std::array::from_fn(|k| rng.normal(4 * s + k as u64))).0);
        let theirs = |[w, x, y, z]: [f64; 4]| [w, -z, -y, -x];
        let (a, b) = (m_l(theirs(r)), m_r(theirs(l)));
        let ours = rotation4(l, r);
        for i in 0..4 {
            for j in 0..4 {
                let product: f64 = (0..4).map(|k| a[3 - i][k] * b[k][3 - j]).sum();
                assert!((product - ours[i][j]).abs() < 1e-14);
            }
        }
    }
}

/// The four-dimensional Gaussian by its definition: mean and covariance.
fn whole(g: &[f64; 11], own: &[f64; OWN]) -> ([f64; 4], [[f64; 4]; 4]) {
    let l = quat::normalize([g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]]).0;
    let r = quat::normalize([own[2], own[3], own[4], own[5]]).0;
    let m = rotation4(l, r);
    let s = [g[LOG_SCALE].exp(), g[LOG_SCALE + 1].exp(), g[LOG_SCALE + 2].exp(), SPEC.speed * own[1].exp()];
    let cov = std::array::from_fn(|i| std::array::from_fn(|j| (0..4).map(|k| m[i][k] * m[j][k] * s[k] * s[k]).sum()));
    ([g[0], g[1], g[2], SPEC.speed * own[0]], cov)
}

/// xᵀ M⁻¹ x by elimination.
fn square<const N: usize>(mut m: [[f64; N]; N], x: [f64; N]) -> f64 {
    let mut y = x;
    for i in 0..N {
        let pivot = (i..N).max_by(|&a, &b| m[a][i].abs().total_cmp(&m[b][i].abs())).unwrap();
        m.swap(i, pivot);
        y.swap(i, pivot);
        for r in 0..N {
            if r != i {
                let f = m[r][i] / m[i][i];
                (0..N).for_each(|c| m[r][c] -= f * m[i][c]);
                y[r] -= f * y[i];
            }
        }
    }
    (0..N).map(|i| x[i] * y[i] / m[i][i]).sum()
}

#[test]
fn a_slice_is_the_density_over_the_marginal_in_time() {
    for i in 0..60 {
        let (g, own) = draw(i);
        let (mean, cov) = whole(&g, &own);
        let rng = Rng::new(3, "points", i);
        let t = own[0] + 0.4 * rng.normal(9);
        let s = slice(&g, &own, t, &frame());
        let three = [[s[3], s[4], s[5]], [s[4], s[6], s[7]], [s[5], s[7], s[8]]];
        for p in 0..5 {
            let x: [f64; 3] = std::array::from_fn(|k| s[k] + 0.3 * rng.fork(p).normal(k as u64));
            let point = [x[0], x[1], x[2], SPEC.speed * t];
            let joint = square(cov, std::array::from_fn(|k| point[k] - mean[k]));
            let marginal = (point[3] - mean[3]).powi(2) / cov[3][3];
            let conditional = square(three, std::array::from_fn(|k| x[k] - s[k]));
            assert!((joint - marginal - conditional).abs() < 1e-8 * joint.max(1.0), "{joint} {marginal} {conditional}");
            let opacity = g[OPACITY].sigmoid() * (-0.5 * marginal).exp();
            assert!((s[SPLAT_OPACITY] - opacity).abs() < 1e-12);
        }
    }
}

#[test]
fn slices_are_covariances_in_single_precision_whatever_the_scales() {
    let spec = Native4dSpec { min_life: 0.01, ..SPEC };
    let frame = spec.frame::<f32>();
    for i in 0..100_000 {
        let rng = Rng::new(4, "psd", i);
        let n = |k: u64| rng.normal(k) as f32;
        let g: [f32; 11] = std::array::from_fn(|c| if c < 7 { n(c as u64) } else { 4.0 * n(c as u64) - 4.0 });
        let own: [f32; OWN] = std::array::from_fn(|c| if c == 1 { 3.0 * n(21) - 1.0 } else { n(20 + c as u64) });
        let s = slice(&g, &own, own[0] + n(40), &frame);
        let cov: [f64; 6] = std::array::from_fn(|k| f64::from(s[COV + k]));
        let values = sym3::eigen(cov).0;
        let trace = cov[0] + cov[3] + cov[5];
        assert!(values[2] >= -1e-6 * trace && s.iter().all(|x| x.is_finite()), "{i}: {cov:?} {values:?}");
    }
}

#[test]
fn gradients_of_every_number_also_under_the_floor_and_over_the_ceiling() {
    for (i, spec) in (0..40)
        .zip([SPEC, Native4dSpec { min_life: 3.0, ..SPEC }, Native4dSpec { max_life: 0.7, ..SPEC }].into_iter().cycle())
    {
        let (g, own) = draw(i);
        let t = own[0] + 0.4;
        let rng = Rng::new(5, "weights", i);
        let w: [f64; 10] = std::array::from_fn(|k| rng.normal(k as u64));
        let value = |g: &[f64; 11], own: &[f64; OWN], t: f64| {
            slice(g, own, t, &spec.frame()).iter().zip(w).map(|(a, b)| a * b).sum::<f64>()
        };
        let (d_g, d_own, d_t) = slice_backward(&g, &own, t, &spec.frame(), &w);
        let h = 1e-6;
        let near = |fd: f64, got: f64, what: &str| {
            assert!((fd - got).abs() < 1e-6 * (1.0 + fd.abs()), "{i} {what}: {fd} {got}");
        };
        near((value(&g, &own, t + h) - value(&g, &own, t - h)) / (2.0 * h), d_t, "t");
        for c in 0..11 {
            let moved = |by: f64| {
                let mut g = g;
                g[c] += by;
                value(&g, &own, t)
            };
            near((moved(h) - moved(-h)) / (2.0 * h), d_g[c], &format!("geometry {c}"));
        }
        for c in 0..OWN {
            let moved = |by: f64| {
                let mut own = own;
                own[c] += by;
                value(&g, &own, t)
            };
            near((moved(h) - moved(-h)) / (2.0 * h), d_own[c], &format!("own {c}"));
        }
    }
}

#[test]
fn conversions_agree_at_thirty_times_both_ways() {
    let native = layer(60, SPEC);
    let kinematic = to_spacetime(&native).unwrap();
    let back = to_native4d(&kinematic, SPEC).unwrap();
    for k in 0..30 {
        let t = -1.5 + 0.1 * f64::from(k);
        let [a, b, c] = [&native, &kinematic, &back].map(|l| splats(l, t));
        for row in 0..60 {
            for col in 0..10 {
                let (x, y, z) = (a.get(row, col), b.get(row, col), c.get(row, col));
                let scale = 1.0 + x.abs();
                assert!((x - y).abs() < 1e-9 * scale, "{t}: row {row} column {col}: {x} {y}");
                assert!((x - z).abs() < 1e-9 * scale, "{t}: row {row} column {col}: {x} {z}");
            }
        }
    }
    // A lifespan of STG's is a shorter one of ours; what has no counterpart is refused.
    let stg = Layer { life: LifeKind::GaussOne, ..kinematic.clone() };
    let same = to_native4d(&stg, SPEC).unwrap();
    let (a, b) = (splats(&stg, 0.3), splats(&same, 0.3));
    assert!((0..60).all(|row| (a.get(row, SPLAT_OPACITY) - b.get(row, SPLAT_OPACITY)).abs() < 1e-10));
    assert!(to_native4d(&Layer { life: LifeKind::Interval, ..kinematic.clone() }, SPEC).is_err());
    let mut curved = kinematic.params.clone();
    let mut p = Params::<f64>::new(60, 1, LifeKind::GaussHalf.columns());
    let motion = Spacetime::new(SpacetimeSpec { order: 2, ..SpacetimeSpec::default() }, &mut p).unwrap();
    curved[LIFE] = p[LIFE].clone();
    assert!(to_native4d(&Layer { params: p, motion: Arc::new(motion), ..kinematic }, SPEC).is_err());
    assert!(to_spacetime(&layer(3, Native4dSpec { harmonics: 1, ..SPEC })).is_err());
}

#[test]
fn conversions_agree_in_single_precision_for_thin_long_lived_fast_gaussians() {
    let mut p = Params::<f32>::new(40, 1, LifeKind::GaussHalf.columns());
    let motion = Spacetime::new(SpacetimeSpec::default(), &mut p).unwrap();
    for row in 0..40 {
        let rng = Rng::new(6, "thin", row as u64);
        let n = |k: u64| rng.normal(k) as f32;
        p[GEOMETRY].write::<11>(row, 0, std::array::from_fn(|c| n(c as u64)));
        p[GEOMETRY].write(row, LOG_SCALE, [-4.0 + n(20), -6.0 + n(21), -7.0]);
        p[motion.velocities()].write(row, 0, [2.0 * n(22), n(23), n(24)]);
        p[LIFE].write(row, 0, [n(25), n(26) + 0.5]);
    }
    let life = LifeKind::GaussHalf;
    let a = Layer::new("a", p, Arc::new(motion), life);
    let b = to_native4d(&a, Native4dSpec { max_life: 100.0, ..SPEC }).unwrap();
    for t in [-1.0, 0.0, 0.7, 2.0] {
        let (x, y) = (splats(&a, t), splats(&b, t));
        for row in 0..40 {
            let trace = x.get(row, 3) + x.get(row, 6) + x.get(row, 8);
            for c in 0..10 {
                let scale = if (3..9).contains(&c) { 1e-4 * trace } else { 2e-5 };
                assert!((x.get(row, c) - y.get(row, c)).abs() < scale, "{t}: row {row} column {c}");
            }
        }
    }
}

#[test]
fn without_tilt_gaussians_are_static_and_velocity_is_the_slope_of_the_mean() {
    let mut l = layer(20, SPEC);
    let own = l.params.find(TABLE).unwrap();
    let h = 1e-5;
    let (a, b) = (splats(&l, 0.3 + h), splats(&l, 0.3 - h));
    let q = At { p: &l.params, of: Space::Gaussians, rows: Rows::All, t: Time(0.3) };
    let mut v = Table::default();
    l.motion.velocity(&q, &mut v);
    for row in 0..20 {
        for k in 0..3 {
            let slope = (a.get(row, k) - b.get(row, k)) / (2.0 * h);
            assert!((slope - v.get(row, k)).abs() < 1e-8 * (1.0 + slope.abs()));
        }
    }
    for row in 0..20 {
        let q = l.params[GEOMETRY].read::<4>(row, QUAT);
        l.params[own].write(row, RIGHT, q);
    }
    let (a, b) = (splats(&l, 0.0), splats(&l, 1.3));
    assert!((0..20).all(|row| (0..9).all(|c| (a.get(row, c) - b.get(row, c)).abs() < 1e-12)));
}

#[test]
fn the_reported_lifespan_equals_the_rendered_one_and_integrates_to_the_marginal() {
    let l = layer(30, SPEC);
    let mut life = Table::new(&[("life", 2)], 0);
    assert!(l.motion.life(&l.params, &mut life));
    for row in 0..30 {
        let (g, own) = draw(row as u64);
        let variance = whole(&g, &own).1[3][3];
        let [center, log_width] = life.read::<2>(row, 0);
        assert!((center - own[0]).abs() < 1e-15 && (log_width.exp() - variance.sqrt() / SPEC.speed).abs() < 1e-12);
        let width = log_width.exp();
        let step = width / 50.0;
        let sum: f64 =
            (-400..=400).map(|k| slice(&g, &own, center + step * f64::from(k), &frame())[SPLAT_OPACITY] * step).sum();
        let expected = g[OPACITY].sigmoid() * (TAU * variance).sqrt() / SPEC.speed;
        assert!((sum / expected - 1.0).abs() < 1e-9, "{sum} {expected}");
    }
    // A Gaussian left out of the active set is fainter than what is rendered.
    let mut ids = Vec::new();
    l.active(Time(2.5), &mut ids);
    let out = splats(&l, 2.5);
    for row in 0..30u32 {
        let faint = out.get(row as usize, SPLAT_OPACITY) < crate::layers::ALPHA_MIN;
        assert_eq!(ids.contains(&row), !faint, "row {row}");
    }
}

#[test]
fn a_moving_frame_adds_its_velocity_and_results_do_not_depend_on_clock_speed() {
    let l = layer(20, SPEC);
    let own = l.params.find(TABLE).unwrap();
    let push = [0.4, -0.3, 0.9];
    let (mut moved, mut slow) = (l.clone(), l.clone());
    let slow_spec = Native4dSpec { speed: SPEC.speed / 2.0, min_life: 2.0 * SPEC.min_life, max_life: 100.0, ..SPEC };
    slow.motion = Arc::new(Native4d { spec: slow_spec, own });
    for row in 0..20 {
        let mut g = Sliced::of(&SPEC, &l.params, own, row);
        (0..3).for_each(|k| g.velocity[k] += push[k]);
        g.write(&SPEC, &mut moved.params, own, row);
        let [time, log] = l.params[own].read::<2>(row, 0);
        slow.params[own].write(row, 0, [2.0 * time, log + 2f64.ln()]);
    }
    for t in [-0.4, 0.2, 1.1] {
        let (a, b, c) = (splats(&l, t), splats(&moved, t), splats(&slow, 2.0 * t));
        for row in 0..20 {
            let delta = t - l.params[own].get(row, 0);
            for col in 0..10 {
                let expected = a.get(row, col) + if col < 3 { push[col] * delta } else { 0.0 };
                assert!((b.get(row, col) - expected).abs() < 1e-9 * (1.0 + expected.abs()));
                assert!((c.get(row, col) - a.get(row, col)).abs() < 1e-12 * (1.0 + expected.abs()));
            }
        }
    }
}

#[test]
fn colours_in_time_have_their_period_are_even_and_join_the_table() {
    let spec = Native4dSpec { harmonics: 2, period: 0.8, ..SPEC };
    let mut l = layer(20, spec);
    assert_eq!(l.params[SH].width(), 9, "three blocks of one coefficient");
    let own = l.params.find(TABLE).unwrap();
    let weights = |l: &Layer<f64>, t: f64| {
        let mut tape = LayerTape::default();
        tape.request(Space::Gaussians, Rows::All, Time(t));
        l.at(&Cache::default(), &mut tape);
        match l.part(&tape).color {
            Color::Sh { weights: Some(w), base: true, .. } => w.clone(),
            _ => panic!("the colours of this model have weights"),
        }
    };
    let mean = l.params[own].get(3, 0);
    let (a, b) = (weights(&l, mean + 0.13), weights(&l, mean - 0.13 + spec.period));
    assert!((0..3).all(|c| (a.get(3, c) - b.get(3, c)).abs() < 1e-12) && a.get(3, 0) == 1.0);
    assert!((a.get(3, 1) - (TAU / 0.8 * 0.13).cos()).abs() < 1e-12);
    // A file's wide table is claimed unchanged; one of no whole number of blocks is refused.
    l.params[SH].set(2, 8, 0.5);
    let table = l.params[SH].clone();
    widen(&mut l.params, 3).unwrap();
    assert_eq!(l.params[SH], table);
    assert!(widen(&mut l.params, 2).is_err());
    for broken in [
        Native4dSpec { harmonics: 3, ..SPEC },
        Native4dSpec { speed: 0.0, ..SPEC },
        Native4dSpec { min_life: 60.0, ..SPEC },
        Native4dSpec { period: f64::NAN, ..SPEC },
    ] {
        assert!(Native4d::new(broken, &mut Params::<f64>::new(2, 1, &[])).is_err(), "{broken:?}");
    }
}

#[test]
fn splits_keep_the_distribution_and_resizing_keeps_velocity_and_lifespan() {
    let rows = 4000;
    let mut params = Params::<f64>::new(rows, 1, &[]);
    let motion = Native4d::new(SPEC, &mut params).unwrap();
    let (g, own) = draw(3);
    for row in 0..rows {
        params[GEOMETRY].write(row, 0, g);
        params[motion.own()].write(row, 0, own);
    }
    let before = Sliced::of(&SPEC, &params, motion.own(), 0);
    Motion::<f64>::resize(&motion, &mut params, 0, 0.5);
    let small = Sliced::of(&SPEC, &params, motion.own(), 0);
    assert!((0..6).all(|k| (small.cov[k] - 0.25 * before.cov[k]).abs() < 1e-10));
    assert!((0..3).all(|k| (small.velocity[k] - before.velocity[k]).abs() < 1e-10));
    assert!((small.width - before.width).abs() < 1e-10);
    let mut edit = RowEdit::identity(Space::Gaussians, rows);
    edit.born[1..].fill(Born::Split);
    motion.on_edit(&mut params, &edit, &Rng::new(8, "split", 0));
    let parts: Vec<Sliced> = (1..rows).map(|row| Sliced::of(&SPEC, &params, motion.own(), row)).collect();
    let n = parts.len() as f64;
    let mean = parts.iter().map(|s| s.time).sum::<f64>() / n;
    let spread = (parts.iter().map(|s| (s.time - mean).powi(2)).sum::<f64>() / n).sqrt();
    assert!((mean - own[0]).abs() < 0.1 * before.width && (spread / before.width - 1.0).abs() < 0.05);
    for s in &parts {
        assert!((s.width * SPLIT_SHRINK / before.width - 1.0).abs() < 1e-9);
        // Each part is on the parent's path.
        for k in 0..3 {
            let on = before.mean[k] + before.velocity[k] * (s.time - before.time);
            assert!((s.mean[k] - on).abs() < 1e-9 * (1.0 + on.abs()));
        }
    }
}

#[test]
fn far_from_its_lifespan_everything_is_finite() {
    let l = layer(20, SPEC);
    let single = Layer::new(
        "b",
        l.params.cast::<f32>(),
        Arc::new(Native4d { spec: SPEC, own: l.params.find(TABLE).unwrap() }),
        LifeKind::Infinite,
    );
    let single: Layer<f32> = single;
    for t in [-1e30, -1e4, 1e4, 1e30] {
        let mut tape = LayerTape::default();
        tape.request(Space::Gaussians, Rows::All, Time(t));
        single.at(&Cache::default(), &mut tape);
        assert!(tape.out().first_non_finite().is_none(), "{t}");
        let mut d_out = tape.out().zeros_like();
        (0..20).for_each(|row| d_out.set(row, SPLAT_OPACITY, 1.0));
        let mut d = Grads::new(&single.params);
        let d_out = SplatGrads { out: &d_out, color: None, weights: None };
        single.backward(&Cache::default(), &mut tape, &d_out, &mut Cache::default(), &mut d);
        assert!(single.params.keys().all(|k| d.table(k).first_non_finite().is_none()), "{t}");
    }
}
