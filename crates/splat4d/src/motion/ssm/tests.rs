//! Equivariance and its negative controls, permutations, baked ticks, hostile specs; the fit is in `study`.

mod study;

use super::*;
use crate::math::quat;
use crate::motion::skin::POSE_COLUMNS;

/// Nodes of a synthetic cloud; two blocks, the second not full.
const NODES: usize = 27;
const TIMES: [f64; 4] = [0.0, 0.31, 0.77, 1.0];

fn small(equivariance: Equivariance, output: Output, mode: Mode) -> SsmSpec {
    SsmSpec { ticks: 12, width: 8, states: 3, embedding: 4, equivariance, output, mode, ..SsmSpec::default() }
}

/// A cloud of nodes and its field with random weights; `g` is applied to the nodes alone.
fn field(spec: &SsmSpec, g: &Motion3) -> (Params<f64>, Field) {
    let mut p = Params::<f64>::new(0, 1, &[]);
    let rng = Rng::new(5, "nodes", 0);
    let columns = [("node_means", 3), ("node_log_radii", 1), ("node_logits", 1)];
    let fill = |t: &mut Table<f64>| {
        for row in 0..NODES {
            let x: [f64; 3] = std::array::from_fn(|k| rng.fork(row as u64).normal(k as u64));
            t.write(row, 0, g.point(x));
        }
    };
    let nodes = p.entry("nodes", Space::Nodes, &columns, NODES, fill).unwrap();
    let field = Field::new(spec, nodes, &mut p).unwrap();
    let rng = Rng::new(6, "shake", 0);
    for key in p.keys().collect::<Vec<_>>() {
        if !p.info(key).trainable || key == nodes {
            continue;
        }
        let stream = rng.fork(u64::from(key.0));
        p[key].data_mut().iter_mut().enumerate().for_each(|(i, x)| *x += 0.3 * stream.normal(i as u64));
    }
    (p, field)
}

/// x → Rx + t, R orthogonal.
struct Motion3 {
    r: [[f64; 3]; 3],
    t: [f64; 3],
    mirrors: bool,
}

impl Motion3 {
    fn identity() -> Self {
        Self { r: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], t: [0.0; 3], mirrors: false }
    }

    fn random(i: u64, mirrors: bool) -> Self {
        let rng = Rng::new(i, "motion", 0);
        let r = quat::to_rotation(quat::normalize(std::array::from_fn(|k| rng.normal(k as u64))).0);
        let r = if mirrors { r.map(|row| row.map(|x| -x)) } else { r };
        Self { r, t: std::array::from_fn(|k| 3.0 * rng.normal(10 + k as u64)), mirrors }
    }

    fn vector(&self, v: [f64; 3]) -> [f64; 3] {
        self.r.map(|row| (0..3).map(|k| row[k] * v[k]).sum())
    }

    fn point(&self, x: [f64; 3]) -> [f64; 3] {
        let v = self.vector(x);
        [0, 1, 2].map(|k| v[k] + self.t[k])
    }

    /// The axis of a rotation, g∘R∘g⁻¹: it does not mirror.
    fn axis(&self, v: [f64; 3]) -> [f64; 3] {
        self.vector(v).map(|x| if self.mirrors { -x } else { x })
    }
}

fn poses(p: &Params<f64>, field: &Field) -> Vec<[f64; 7]> {
    let times = TIMES.map(Time);
    let mut cache = Slot::default();
    field.prepare(p, &times, &mut cache);
    let mut out = Table::new(&POSE_COLUMNS, NODES);
    let mut all = Vec::new();
    for t in times {
        Trajectory::poses(field, p, t, &cache, &mut out);
        all.extend((0..NODES).map(|r| out.read::<7>(r, 0)));
    }
    all
}

/// Largest ‖T' − gTg⁻¹‖ over nodes and times, and the largest pose.
fn error(spec: &SsmSpec, rest: &[[f64; 7]], g: &Motion3) -> (f64, f64) {
    let (q, other) = field(spec, g);
    let (mut worst, mut size) = (0.0f64, 0.0f64);
    for (a, b) in rest.iter().zip(poses(&q, &other)) {
        let (shift, axis) = (g.vector([a[0], a[1], a[2]]), g.axis([a[4], a[5], a[6]]));
        let expected = [shift[0], shift[1], shift[2], a[3], axis[0], axis[1], axis[2]];
        (0..7).for_each(|k| worst = worst.max((expected[k] - b[k]).abs()));
        size = a.iter().fold(size, |s, x| s.max(x.abs()));
    }
    (worst, size)
}

/// The result for the scene that was not moved.
fn at_rest(spec: &SsmSpec) -> Vec<[f64; 7]> {
    let (p, of) = field(spec, &Motion3::identity());
    poses(&p, &of)
}

const ABSOLUTE: (Output, Mode) = (Output::Absolute, Mode::Bidirectional);
const TWIST: (Output, Mode) = (Output::Twist, Mode::Causal);

#[test]
fn results_are_equivariant_to_fifty_motions_of_the_scene() {
    for (e, mirrors) in [(Equivariance::Frames, false), (Equivariance::Vector, false), (Equivariance::Vector, true)] {
        for (output, mode) in [ABSOLUTE, TWIST] {
            let spec = small(e, output, mode);
            let rest = at_rest(&spec);
            for i in 0..50 {
                let (worst, size) = error(&spec, &rest, &Motion3::random(i, mirrors));
                assert!(size > 0.05, "something moves: {size}");
                assert!(worst < 1e-5, "{e:?} {output:?}, motion {i}, mirrored {mirrors}: off by {worst}");
            }
        }
    }
}

#[test]
fn non_equivariant_networks_are_detected() {
    // The same test must fail for a network with positions as inputs, and for frames where the scene is mirrored.
    for (e, mirrors) in [(Equivariance::None, false), (Equivariance::None, true), (Equivariance::Frames, true)] {
        let spec = small(e, Output::Absolute, Mode::Bidirectional);
        let rest = at_rest(&spec);
        let failed = (0..50).filter(|&i| error(&spec, &rest, &Motion3::random(i, mirrors)).0 > 1e-2).count();
        assert!(failed >= 45, "{e:?} mirrored {mirrors}: only {failed} of 50 motions were found out");
    }
}

#[test]
fn nodes_in_another_order_give_the_same_poses_in_that_order() {
    for e in [Equivariance::None, Equivariance::Frames, Equivariance::Vector] {
        let spec = small(e, Output::Absolute, Mode::Bidirectional);
        let (mut p, of) = field(&spec, &Motion3::identity());
        let before = poses(&p, &of);
        let mut edit = RowEdit::identity(Space::Nodes, NODES);
        edit.parent.reverse();
        p.apply(&edit);
        of.on_edit(&mut p, &edit);
        for (t, after) in poses(&p, &of).chunks(NODES).enumerate() {
            for (row, a) in after.iter().enumerate() {
                let b = before[t * NODES + NODES - 1 - row];
                assert!((0..7).all(|k| (a[k] - b[k]).abs() < 1e-9), "{e:?} row {row}: {a:?} {b:?}");
            }
        }
    }
}

#[test]
fn a_forecast_does_not_depend_on_the_ticks_after_it() {
    let spec = small(Equivariance::None, Output::Twist, Mode::Causal);
    let (p, of) = field(&spec, &Motion3::identity());
    let (short, long) = (of.scan(&p, 7), of.scan(&p, 24));
    for node in 0..NODES {
        let width = of.tick_width();
        let (a, b) = (&short.out[node * 7 * width..][..7 * width], &long.out[node * 24 * width..][..7 * width]);
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12), "node {node}");
    }
    let spec = SsmSpec { mode: Mode::Bidirectional, ..spec };
    let (_, of) = field(&spec, &Motion3::identity());
    assert_eq!(of.needed(&[Time(0.1)]), spec.ticks, "a reconstruction sees all of the clip");
}

/// Rounded to the eleven bits of half precision; its range is not left here.
fn half(x: f64) -> f64 {
    f64::from(f32::from_bits(((x as f32).to_bits() + 0x1000) & !0x1fff))
}

#[test]
fn baked_ticks_in_half_precision_give_nearly_the_same_poses() {
    let spec = small(Equivariance::None, Output::Absolute, Mode::Bidirectional);
    let (p, of) = field(&spec, &Motion3::identity());
    let scan = of.scan(&p, spec.ticks);
    let baked: Vec<f64> = scan.out.iter().map(|x| half(*x)).collect();
    let (width, knots) = (of.tick_width(), of.knots::<f64>(Time(0.43)));
    for node in 0..NODES {
        let own = node * spec.ticks * width..(node + 1) * spec.ticks * width;
        let (a, b) = (pose::at(&scan.out[own.clone()], width, &knots).0, pose::at(&baked[own], width, &knots).0);
        // Half precision has 11 bits; four ticks with weights of at most 1.25 in all.
        let size = a.iter().fold(1.0f64, |s, x| s.max(x.abs()));
        assert!((0..7).all(|k| (a[k] - b[k]).abs() < 1.5e-3 * size), "{a:?} {b:?}");
    }
}

#[test]
fn rotation_vectors_and_their_gradient() {
    let rng = Rng::new(3, "theta", 0);
    for i in 0..40u64 {
        // From tiny angles, where the series counts, to several turns.
        let size = 10f64.powf(-4.0 + 5.0 * i as f64 / 39.0);
        let theta: [f64; 3] = std::array::from_fn(|k| size * rng.fork(i).normal(k as u64));
        let q = pose::exp(theta);
        assert!((q.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-12);
        let d: [f64; 4] = std::array::from_fn(|k| rng.fork(i).normal(10 + k as u64));
        let got = pose::exp_backward(theta, d);
        for k in 0..3 {
            let at = |h: f64| {
                let mut x = theta;
                x[k] += h;
                pose::exp(x).iter().zip(d).map(|(a, b)| a * b).sum::<f64>()
            };
            let fd = (at(1e-6) - at(-1e-6)) / 2e-6;
            assert!((fd - got[k]).abs() < 1e-8 * (1.0 + fd.abs()), "{theta:?}: {fd} {}", got[k]);
        }
    }
}

#[test]
fn hostile_specs_are_refused() {
    let good = SsmSpec::default();
    let bad = [
        SsmSpec { ticks: 1, ..good.clone() },
        SsmSpec { ticks: usize::MAX, ..good.clone() },
        SsmSpec { width: 0, ..good.clone() },
        SsmSpec { states: 1 << 40, ..good.clone() },
        SsmSpec { blocks: 9, ..good.clone() },
        SsmSpec { clip: [1.0, 1.0], ..good.clone() },
        SsmSpec { clip: [0.0, f64::NAN], ..good.clone() },
        SsmSpec { extent: f64::INFINITY, ..good.clone() },
        SsmSpec { skin: SkinSpec { neighbours: 0, ..good.skin }, ..good.clone() },
    ];
    for spec in bad {
        assert!(spec.build::<f32>(&mut Params::new(30, 1, &[])).is_err(), "{spec:?}");
    }
    assert!(good.build::<f32>(&mut Params::new(0, 1, &[])).is_ok(), "a layer without Gaussians is a layer");
}
