//! Strips of one and of two rows of pixels against each other: a machine has instructions for one of them.

use super::*;
use crate::math::Rng;

/// Bins that the image's edges cut.
const INSIDE: [usize; 2] = [29, 21];

/// Round and thin splats all over a bin, with the rows that their ellipses reach.
fn records(n: usize) -> Vec<Record<f64>> {
    let rng = Rng::new(3, "strips", 0);
    let record = |i: usize| {
        let r = rng.fork(i as u64);
        let u = |k: u64| r.uniform(k);
        let (a, c) = (-0.1 * u(0) - 1e-3, -0.1 * u(1) - 1e-3);
        let b = 1.9 * (u(4) - 0.5) * (a * c).sqrt();
        let (y, log_ratio) = (32.0 * u(3), 8.0 * u(5));
        // Along dy the exponent is at most (c − b²/4a) dy².
        let half = (log_ratio / (b * b / (4.0 * a) - c)).sqrt();
        let rows = [(y - half - 1.0).clamp(0.0, 32.0) as u8, (y + half + 1.0).clamp(0.0, 32.0) as u8];
        let channels = [u(6), u(7), u(8)];
        let mut record = Record { x: 32.0 * u(2), y, a, b, c, log_ratio, channels, mask: 0, rows: [rows; SIDE] };
        for t in 0..TILES {
            record.mask |= u16::from(!record.tile_rows(t % SIDE, t / SIDE).is_empty()) << t;
        }
        record
    };
    (0..n).map(record).collect()
}

#[test]
fn strips_of_two_rows_are_twice_a_row() {
    let records = records(400);
    let limits = Limits::<f64>::new(&RenderConfig::default());
    let mut tiles = [vec![Tile::default(); TILES], vec![Tile::default(); TILES]];
    let [rows, pairs] = &mut tiles;
    Blend { records: &records, tiles: rows, inside: INSIDE, limits }.run::<false>();
    Blend { records: &records, tiles: pairs, inside: INSIDE, limits }.run_wide::<false>();
    let close = |a: f64, b: f64| (a - b).abs() <= 1e-9 * (1.0 + b.abs());
    let mut stopped = 0;
    for (a, b) in rows.iter().zip(&*pairs) {
        assert!(a.t.iter().zip(&b.t).all(|(a, b)| close(*a, *b)));
        assert!(a.color.as_flattened().iter().zip(b.color.as_flattened()).all(|(a, b)| close(*a, *b)));
        stopped += a.t.iter().filter(|t| **t < 0.0).count();
    }
    let outside = 32 * 32 - INSIDE[0] * INSIDE[1];
    assert!(stopped > outside && stopped < 32 * 32, "some pixels stop, some do not: {stopped}");

    let planes: Vec<Vec<f64>> =
        (0..4u64).map(|p| (0..INSIDE[0] * INSIDE[1]).map(|i| Rng::new(p, "g", 0).normal(i as u64)).collect()).collect();
    let grads =
        PixelGrads { channels: [Some(&planes[0]), Some(&planes[1]), Some(&planes[2])], alpha: Some(&planes[3]) };
    let mut out = [vec![Pair::default(); records.len()], vec![Pair::default(); records.len()]];
    let [a, b] = &mut out;
    let back = |tiles, out| Backward {
        records: &records,
        tiles,
        grads: &grads,
        background: [0.2, 0.4, 0.6],
        corner: [0, 0],
        size: INSIDE,
        limits,
        abs: true,
        out,
    };
    let d_rows = back(&tiles[0], a).run::<false>();
    let d_pairs = back(&tiles[1], b).run_wide::<false>();
    assert!(d_rows.iter().zip(d_pairs).all(|(a, b)| close(*a, b)));
    for (a, b) in a.iter().zip(&*b) {
        assert!(a.0.iter().zip(b.0).all(|(a, b)| close(*a, b)), "{a:?} and {b:?}");
    }
    assert!(a.iter().filter(|p| p.log_alpha() != 0.0).count() > records.len() / 2, "gradients flow");
}

#[test]
fn bit_maps_are_the_transposed_masks() {
    let records = records(57);
    let maps = bit_maps(&records);
    for (t, map) in maps.iter().enumerate() {
        for i in 0..BATCH {
            let touched = records.get(i).is_some_and(|r| r.mask >> t & 1 == 1);
            assert_eq!(map >> i & 1 == 1, touched, "tile {t}, splat {i}");
        }
    }
}
