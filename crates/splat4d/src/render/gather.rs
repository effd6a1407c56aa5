//! The records of a bin: what the blend loop reads of each splat, in depth order, with the tiles and rows of pixels
//! that it can touch.

use super::bin::{BIN, id};
use super::project::{Projected, TAU_MARGIN};
use super::simd::{Kernel, greatest, least};
use crate::math::Real;
use crate::scene::BLOCK;
use std::f64::consts::LOG2_E;
use std::ops::Range;

/// Channels of one pass.
pub const CHANNELS: usize = 3;
/// Pixels across and down a tile: one row is one vector.
pub(super) const TILE: usize = 8;
/// Tiles in a row of a bin.
pub(super) const SIDE: usize = BIN / TILE;
/// Tiles in a bin.
pub(super) const TILES: usize = SIDE * SIDE;
/// Added under the root of a row range, so that rounding never loses a row that a tangent touches.
const CHORD_MARGIN: f64 = 1e-5;

/// One splat as the blend loop reads it: o·g = o·2^min(a dx² + b dx dy + c dy², 0).
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Record<F> {
    /// Centre relative to the bin's corner.
    pub x: F,
    pub y: F,
    /// log₂ e times −½ conic xx, −conic xy, −½ conic yy.
    pub a: F,
    pub b: F,
    pub c: F,
    /// log₂ of o/α_min, of which τ is the multiple: no logarithm is taken here.
    pub log_ratio: F,
    /// Channels to blend.
    pub channels: [F; CHANNELS],
    /// Bit 4·row + column: the tile may be touched.
    pub mask: u16,
    /// Pixel rows of the bin that the ellipse reaches in each column of tiles: first, one past the last.
    pub rows: [[u8; 2]; SIDE],
}

impl<F> Record<F> {
    /// The rows of tile (tx, ty) that it can touch; of use where the tile's bit of the mask is set.
    #[inline(always)]
    pub(crate) fn tile_rows(&self, tx: usize, ty: usize) -> Range<usize> {
        let (top, [first, end]) = (ty * TILE, self.rows[tx % SIDE]);
        usize::from(first).saturating_sub(top)..usize::from(end).saturating_sub(top).min(TILE)
    }
}

/// Gathers the records of one bin.
pub(super) struct Gather<'a, F> {
    pub keys: &'a [u64],
    pub projected: &'a [Projected<F>],
    pub records: &'a mut [Record<F>],
    pub x0: usize,
    pub y0: usize,
    pub width: usize,
    pub height: usize,
}

impl<F: Real> Kernel for Gather<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let at = |v: usize| F::of(v as f64);
        let zero = [F::ZERO; BLOCK];
        let last_row = (self.height - self.y0).min(BIN) as i32;
        // Sixteen splats at once, so that every step is a loop over lanes.
        for (records, keys) in self.records.chunks_mut(BLOCK).zip(self.keys.chunks(BLOCK)) {
            let [mut x, mut y, mut a, mut b, mut c] = [zero; 5];
            let [mut half_x, mut half_y, mut tau] = [zero; 3];
            // Rows are far apart. What is read first is their two ends, so that sixteen of them are on their way from
            // memory at once.
            for (l, key) in keys.iter().enumerate() {
                let p = &self.projected[id(*key)];
                (x[l], tau[l]) = (p.mean2d[0] - at(self.x0), p.tau);
            }
            for (l, key) in keys.iter().enumerate() {
                let p = &self.projected[id(*key)];
                y[l] = p.mean2d[1] - at(self.y0);
                [a[l], b[l], c[l]] = p.conic;
                (half_x[l], half_y[l]) = (p.half[0], p.half[1]);
            }
            // The ellipse is y = slope·dx ± reach·√(1 − (dx/half_x)²), with its lowest point at dx = summit.
            let [mut slope, mut reach, mut inverse, mut summit] = [zero; 4];
            for l in 0..BLOCK {
                slope[l] = -b[l] / c[l];
                reach[l] = (tau[l] / c[l]).sqrt();
                inverse[l] = F::ONE / half_x[l];
                summit[l] = -b[l] / a[l] * half_y[l];
            }
            let (mut mask, mut rows) = ([0i32; BLOCK], [[[0i32; BLOCK]; 2]; SIDE]);
            for k in 0..SIDE {
                let (left, right) = (k * TILE, (k * TILE + TILE).min(self.width - self.x0));
                if right <= left {
                    break;
                }
                let (left, right) = (at(left) + F::HALF, at(right) - F::HALF);
                // 1 − (dx/half_x)² where a branch comes nearest.
                let mut inside = [F::ONE; BLOCK];
                for (side, sign) in [(0, -F::ONE), (1, F::ONE)] {
                    // Each branch is farthest out as near to its summit as the column comes.
                    for l in 0..BLOCK {
                        let dx = least(greatest(sign * summit[l], left - x[l]), right - x[l]);
                        let u = dx * inverse[l];
                        let square = F::ONE + F::of(CHORD_MARGIN) - u * u;
                        inside[l] = least(inside[l], square);
                        let edge = y[l] + slope[l] * dx + sign * reach[l] * greatest(square, F::ZERO).sqrt();
                        // First row whose centre is not above the edge, or one past the last not below it.
                        let row = least(greatest((edge * sign + F::HALF).floor() * sign, F::ZERO), at(BIN));
                        rows[k][side][l] = row.lane_i32().min(last_row);
                    }
                }
                for l in 0..BLOCK {
                    // No row where a branch does not come into the column.
                    let end = if inside[l] >= F::ZERO { rows[k][1][l] } else { 0 };
                    let first = rows[k][0][l];
                    for ty in 0..SIDE {
                        let top = (ty * TILE) as i32;
                        let hit = (first < end) & (first < top + TILE as i32) & (end > top);
                        mask[l] |= i32::from(hit) << (ty * SIDE + k);
                    }
                }
            }
            for (l, record) in records.iter_mut().enumerate() {
                *record = Record {
                    x: x[l],
                    y: y[l],
                    a: F::of(-0.5 * LOG2_E) * a[l],
                    b: F::of(-LOG2_E) * b[l],
                    c: F::of(-0.5 * LOG2_E) * c[l],
                    log_ratio: F::of(0.5 * LOG2_E) * (tau[l] - F::of(TAU_MARGIN)),
                    channels: record.channels,
                    mask: mask[l] as u16,
                    rows: std::array::from_fn(|k| [rows[k][0][l] as u8, rows[k][1][l] as u8]),
                };
            }
        }
    }
}
