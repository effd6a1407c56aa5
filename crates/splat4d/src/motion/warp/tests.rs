use super::*;
use crate::motion::build_as;
use crate::scene::{Rows, Table};

const ROWS: usize = 19;

/// A warp with random numbers everywhere.
fn subject(local: bool, time_net: bool) -> (Params<f64>, Arc<dyn Motion<f64>>) {
    let spec = WarpSpec {
        clip: [0.0, 2.0],
        nodes: 7,
        neighbours: 3,
        width: 8,
        layers: 4,
        skip: Some(2),
        levels: [2, 3],
        time_net,
        local,
    };
    let mut p = Params::<f64>::new(ROWS, 1, &[]);
    let motion = build_as(&Spec::Warp(spec), &mut p).unwrap();
    let rng = Rng::new(3, "warp", 0);
    for key in p.keys().collect::<Vec<_>>() {
        let links = p.info(key).name == TABLES[1];
        for row in 0..p[key].rows() {
            for col in 0..p[key].width() {
                let x = rng.fork(u64::from(key.0)).normal((row * 16 + col) as u64);
                p[key].set(row, col, if links { ((row + col) % 7) as f64 } else { 0.3 * x });
            }
        }
    }
    (p, motion)
}

fn answer(p: &Params<f64>, motion: &dyn Motion<f64>, t: f64) -> Table<f64> {
    let q = At { p, of: Space::Gaussians, rows: Rows::All, t: Time(t) };
    let (mut cache, mut tape) = (Cache::default(), Tape::default());
    motion.prepare(p, &[q], &mut cache);
    motion.at(&q, &cache, &mut tape);
    tape.out
}

#[test]
fn gradients_of_the_gaussians_agree_with_differences() {
    for (local, time_net) in [(false, true), (true, false)] {
        let (mut p, motion) = subject(local, time_net);
        let t = Time(0.7);
        let weight = |row: usize, col: usize| (1.3 * row as f64 + 0.7 * col as f64).sin();
        let value = |p: &Params<f64>| {
            let out = answer(p, &*motion, t.0);
            (0..ROWS).flat_map(|r| (0..10).map(move |c| (r, c))).map(|(r, c)| weight(r, c) * out.get(r, c)).sum::<f64>()
        };
        let mut d_out = answer(&p, &*motion, t.0).zeros_like();
        (0..ROWS).for_each(|r| (0..10).for_each(|c| d_out.set(r, c, weight(r, c))));
        let q = At { p: &p, of: Space::Gaussians, rows: Rows::All, t };
        let (mut cache, mut d) = (Cache::default(), Grads::new(&p));
        motion.prepare(&p, &[q], &mut cache);
        d.activate(Space::Gaussians, Rows::All);
        let given = SplatGrads { out: &d_out, color: None, weights: None };
        motion.backward(&q, &cache, &mut Tape::default(), &given, &mut Cache::default(), &mut d);
        let got = d.table(GEOMETRY).clone();
        const H: f64 = 1e-6;
        for row in [0, 7, 18] {
            for col in 0..11 {
                let before = p[GEOMETRY].get(row, col);
                let [high, low] = [H, -H].map(|h| {
                    p[GEOMETRY].set(row, col, before + h);
                    value(&p)
                });
                p[GEOMETRY].set(row, col, before);
                let expected = (high - low) / (2.0 * H);
                let apart = (got.get(row, col) - expected).abs();
                assert!(apart < 2e-5 * expected.abs() + 1e-6, "{row} {col}: {} {expected}", got.get(row, col));
            }
        }
    }
}

#[test]
fn gaussians_without_weight_stay_and_times_outside_the_clip_are_its_ends() {
    let (mut p, motion) = subject(true, true);
    assert_ne!(answer(&p, &*motion, 0.2), answer(&p, &*motion, 1.2));
    assert_eq!(answer(&p, &*motion, 2.0), answer(&p, &*motion, 5.0));
    let weights = p.find(TABLES[2]).unwrap();
    p[weights].fill(0.0);
    let (out, t) = (answer(&p, &*motion, 0.4), answer(&p, &crate::motion::Still, 0.4));
    for (row, col) in (0..ROWS).flat_map(|r| (0..10).map(move |c| (r, c))) {
        assert!((out.get(row, col) - t.get(row, col)).abs() < 1e-9, "{row} {col}");
    }
}

#[test]
fn specifications_out_of_range_and_links_to_no_node_are_no_crash() {
    let good = WarpSpec {
        clip: [0.0, 1.0],
        nodes: 2,
        neighbours: 1,
        width: 4,
        layers: 1,
        skip: None,
        levels: [1, 1],
        time_net: false,
        local: false,
    };
    let bad = [
        WarpSpec { clip: [1.0, 0.0], ..good.clone() },
        WarpSpec { nodes: 0, ..good.clone() },
        WarpSpec { nodes: usize::MAX, ..good.clone() },
        WarpSpec { neighbours: 99, ..good.clone() },
        WarpSpec { levels: [99, 1], ..good.clone() },
        WarpSpec { width: 1 << 40, ..good.clone() },
    ];
    for spec in bad {
        assert!(build_as::<f32>(&Spec::Warp(spec.clone()), &mut Params::new(2, 1, &[])).is_err(), "{spec:?}");
    }
    let mut p = Params::<f64>::new(3, 1, &[]);
    let motion = build_as(&Spec::Warp(good), &mut p).unwrap();
    let links = p.find(TABLES[1]).unwrap();
    for (row, link) in [f64::NAN, -1.0, 1e30].into_iter().enumerate() {
        p[links].set(row, 0, link);
    }
    assert_eq!(answer(&p, &*motion, 0.5).rows(), 3);
}
