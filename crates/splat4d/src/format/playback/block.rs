//! The encoder of a page: 256 Gaussians, column by column, become a header and words (docs/format.md, "Page").
//!
//! Both sources of Gaussians end here: primitives in floats, and layers that are pages already. What is written as a
//! logarithm arrives as one, so that a layer, which holds logarithms, need not leave them.

use super::page::{FOR_EVER, FULL8, FULL10, FULL16, HALF10, Header, LEVELS8, LEVELS16, MAX_LOG, WIDTH_LEVELS, at};
use super::page::{half_width, lives_through, page_of, rate, reach, scales, seen_widths};
use super::{BLOCK_GAUSSIANS, BLOCK_HEADER, Depths, PAGE_WORDS, Primitive};
use crate::format::quant::{self, coarse_code, coarse_quat_codes, coarse_signed_code};
use crate::math::quat as quaternion;
use crate::simd::{Kernel, Simd, dispatch, greatest, least};
use rayon::prelude::*;

/// Half-widths below this share of the softness are written as zero: what is never seen need not widen a range.
pub(super) const NO_WIDTH: f64 = 0.02;
/// Shortest softness, seconds: a hundredth of a frame at 100 frames a second.
pub(super) const SHARPEST: f64 = 1e-4;
/// Share by which a block's life is stretched, so that a reader in f32 does not cull what it would render.
const SLACK: f64 = 1e-6;

/// One number of every Gaussian of a block.
type Column = [f64; BLOCK_GAUSSIANS];

/// Up to 256 Gaussians on their way into a block.
pub(super) struct Columns {
    /// Number of them.
    pub rows: usize,
    /// At `center`, scene units.
    pub mean: [Column; 3],
    /// Seconds.
    pub center: Column,
    /// Logarithm of the half-width (s): −∞ for zero, +∞ forever.
    pub log_width: Column,
    /// Logarithm of the softness (s).
    pub log_softness: Column,
    /// Unit, wxyz, at `center`.
    pub quat: [Column; 4],
    /// Logarithms of the scales.
    pub log_scales: [Column; 3],
    /// 0 to 1.
    pub opacity: Column,
    /// Scene units per second.
    pub velocity: [Column; 3],
    /// Radians a second about the world's axes.
    pub turn: [Column; 3],
    /// ½ + Y₀₀·(SH coefficient 0).
    pub color: [Column; 3],
    /// Entries of the palette.
    pub label: [u16; BLOCK_GAUSSIANS],
    /// Reach R of every Gaussian, as a reader will see it; the encoder's own.
    reach: Column,
}

/// The words of a block, word by word: word k of Gaussian i is [k][i]; zero behind the last Gaussian.
pub(super) type Words = [[u32; BLOCK_GAUSSIANS]; PAGE_WORDS];

/// Words Gaussian by Gaussian, as in a page. `rows` are at most a block.
#[inline(always)]
pub(super) fn turn_over(words: &Words, rows: &mut [[u32; PAGE_WORDS]]) {
    for (i, row) in rows.iter_mut().enumerate() {
        for k in 0..PAGE_WORDS {
            row[k] = words[k][i];
        }
    }
}

/// Codes in use: multiples of `step` up to `top`.
#[derive(Clone, Copy)]
struct Grid {
    levels: u32,
    step: u32,
    top: u32,
}

impl Grid {
    #[inline(always)]
    fn new(levels: u32, full: u32, bits: u32) -> Self {
        let step = 1 << (full - bits);
        Self { levels, step, top: levels / step * step }
    }

    /// The upper end of a range from `low` on in which `high` has the largest code in use.
    #[inline(always)]
    fn stretch(self, low: f64, high: f64) -> f64 {
        if self.step == 1 { high } else { low + (high - low) * (f64::from(self.levels) / f64::from(self.top)) }
    }

    /// The range of a header that holds the values; (0, 0) for none.
    #[inline(always)]
    fn range(self, [low, high]: [f64; 2]) -> [f32; 2] {
        if low > high { [0.0; 2] } else { [below(low), above(self.stretch(low, high))] }
    }

    /// The same of logarithms that a header may hold.
    #[inline(always)]
    fn log_range(self, [low, high]: [f64; 2]) -> [f32; 2] {
        if low > high { [0.0; 2] } else { [below(low), above(self.stretch(low, high).min(MAX_LOG))] }
    }

    #[inline(always)]
    fn code(self, value: f64, low: f64, high: f64) -> u32 {
        coarse_code(value, low, high, self.levels, self.step)
    }
}

/// The same around a middle.
#[derive(Clone, Copy)]
struct Signed {
    step: u32,
    stretch: f64,
}

impl Signed {
    #[inline(always)]
    fn new(bits: u32) -> Self {
        let step = 1 << (FULL10 - bits);
        let top = HALF10 / step * step;
        Self { step, stretch: if step == 1 { 1.0 } else { f64::from(HALF10) / f64::from(top) } }
    }
}

impl Columns {
    #[inline(always)]
    pub(super) fn new(rows: usize) -> Self {
        assert!(rows <= BLOCK_GAUSSIANS, "a block has at most {BLOCK_GAUSSIANS} Gaussians");
        const ZERO: Column = [0.0; BLOCK_GAUSSIANS];
        Self {
            rows,
            mean: [ZERO; 3],
            center: ZERO,
            log_width: ZERO,
            log_softness: ZERO,
            quat: [ZERO; 4],
            log_scales: [ZERO; 3],
            opacity: ZERO,
            velocity: [ZERO; 3],
            turn: [ZERO; 3],
            color: [ZERO; 3],
            label: [0; BLOCK_GAUSSIANS],
            reach: ZERO,
        }
    }

    /// Primitives with their entries of the palette.
    fn of_primitives(rows: &[(&Primitive, u16)], span: [f64; 2]) -> Self {
        let mut c = Self::new(rows.len());
        for (i, (p, label)) in rows.iter().enumerate() {
            let (quat, logs) = (quaternion::normalize(p.quat.map(f64::from)).0, scales(p).map(f64::ln));
            (0..4).for_each(|k| c.quat[k][i] = quat[k]);
            for k in 0..3 {
                c.mean[k][i] = p.mean[k];
                c.log_scales[k][i] = logs[k].clamp(-MAX_LOG, MAX_LOG);
                c.velocity[k][i] = f64::from(p.velocity[k]);
                c.turn[k][i] = f64::from(p.turn[k]);
                c.color[k][i] = f64::from(p.base_color[k]);
            }
            c.center[i] = p.center;
            let softness = p.softness.max(SHARPEST);
            c.log_softness[i] = softness.ln().clamp(-MAX_LOG, MAX_LOG);
            c.log_width[i] = if lives_through(p.center, p.half_width, span) {
                f64::INFINITY
            } else if p.half_width < NO_WIDTH * softness {
                f64::NEG_INFINITY
            } else {
                p.half_width.ln().clamp(-MAX_LOG, MAX_LOG)
            };
            c.opacity[i] = f64::from(p.opacity);
            c.label[i] = *label;
        }
        c
    }

    /// Takes another time as the centre of Gaussian i: exact for the mean, and for a turn as near as that time is.
    #[inline(always)]
    fn move_to(&mut self, i: usize, center: f64) {
        let delta = center - self.center[i];
        self.center[i] = center;
        for k in 0..3 {
            self.mean[k][i] += self.velocity[k][i] * delta;
        }
        let q = [self.quat[0][i], self.quat[1][i], self.quat[2][i], self.quat[3][i]];
        let rate = rate(q, [self.turn[0][i], self.turn[1][i], self.turn[2][i]]);
        let [w, x, y, z] = rate;
        let moved = [q[0] + delta * w, q[1] + delta * x, q[2] + delta * y, q[3] + delta * z];
        let (q, _) = quaternion::normalize(moved);
        for k in 0..4 {
            self.quat[k][i] = q[k];
        }
    }

    /// Encodes the block: its header, and its words into `words`, which are zero.
    #[inline(always)]
    pub(super) fn encode(&mut self, span: [f64; 2], depths: &Depths, words: &mut Words) -> Header {
        let n = self.rows;
        assert!(n <= BLOCK_GAUSSIANS, "a block has at most {BLOCK_GAUSSIANS} Gaussians");
        let mut h: Header = [0.0; BLOCK_HEADER];
        self.encode_life(span, depths, &mut h, words);

        let grid = Grid::new(LEVELS16, FULL16, depths.position);
        for k in 0..3 {
            let values = &self.mean[k][..n];
            let [low, high] = put(&mut h, at::BOX + k, 3, grid.range(extent(values)));
            for (w, x) in words[k / 2][..n].iter_mut().zip(values) {
                *w |= grid.code(*x, low, high) << (16 * (k % 2));
            }
        }
        let grid = Grid::new(LEVELS8, FULL8, depths.color);
        for k in 0..3 {
            let values = &self.color[k][..n];
            let [low, high] = put(&mut h, at::COLOR + k, 3, grid.range(extent(values)));
            for (w, x) in words[6][..n].iter_mut().zip(values) {
                *w |= grid.code(*x, low, high) << (8 * k);
            }
        }
        let grid = Grid::new(LEVELS8, FULL8, depths.scale);
        let mut all = NOTHING;
        for k in 0..3 {
            let [low, high] = extent(&self.log_scales[k][..n]);
            all = [least(low, all[0]), greatest(high, all[1])];
        }
        let [low, high] = put(&mut h, at::SCALE, 1, grid.log_range(all));
        for k in 0..3 {
            for (w, x) in words[2][..n].iter_mut().zip(&self.log_scales[k][..n]) {
                *w |= grid.code(*x, low, high) << (8 * k);
            }
        }
        for (bits, place, word, columns) in
            [(depths.shift, at::SHIFT, 4, &mut self.velocity), (depths.turn, at::TURN, 5, &mut self.turn)]
        {
            let grid = Signed::new(bits);
            let mut most = 0.0;
            for k in 0..3 {
                for (x, reach) in columns[k][..n].iter_mut().zip(&self.reach[..n]) {
                    *x *= *reach;
                }
                let [low, high] = extent(&columns[k][..n]);
                most = greatest(greatest(-low, high), most);
            }
            h[place] = above(most * grid.stretch);
            let most = f64::from(h[place]);
            for k in 0..3 {
                for (w, x) in words[word][..n].iter_mut().zip(&columns[k][..n]) {
                    *w |= coarse_signed_code(*x, most, HALF10, grid.step) << (10 * k);
                }
            }
        }
        let step = Signed::new(depths.rotation).step;
        for i in 0..n {
            let q = [self.quat[0][i], self.quat[1][i], self.quat[2][i], self.quat[3][i]];
            let (largest, codes) = coarse_quat_codes(q, HALF10, step);
            words[3][i] = (largest as u32) << 30 | codes[0] << 20 | codes[1] << 10 | codes[2];
        }
        for (w, label) in words[7][..n].iter_mut().zip(&self.label[..n]) {
            *w |= u32::from(*label);
        }
        h
    }

    /// Life first: mean and rotation are evaluated at the centre that a reader will see, and the reach of the motion
    /// follows from the lifespan that a reader will see.
    #[inline(always)]
    fn encode_life(&mut self, span: [f64; 2], depths: &Depths, h: &mut Header, words: &mut Words) {
        let n = self.rows;
        // From the middle of the span the reach is shortest. A turn keeps its own centre: normalize(q₀ + ½Δ(0, ω)⊗q₀)
        // is fastest there, and no other centre gives the same motion.
        for i in 0..n {
            let still = self.turn[0][i] == 0.0 && self.turn[1][i] == 0.0 && self.turn[2][i] == 0.0;
            if self.log_width[i] == f64::INFINITY && still {
                self.move_to(i, 0.5 * (span[0] + span[1]));
            }
        }
        let (mut widths, mut softness) = (NOTHING, NOTHING);
        for i in 0..n {
            if self.log_width[i] == f64::INFINITY {
                continue;
            }
            softness = [least(self.log_softness[i], softness[0]), greatest(self.log_softness[i], softness[1])];
            if self.log_width[i] > f64::NEG_INFINITY {
                widths = [least(self.log_width[i], widths[0]), greatest(self.log_width[i], widths[1])];
            }
        }
        let centers = Grid::new(LEVELS16, FULL16, depths.center);
        let width_grid = Grid::new(WIDTH_LEVELS, FULL8, depths.life);
        let soft_grid = Grid::new(LEVELS8, FULL8, depths.life);
        let opacity_step = 1 << (FULL8 - depths.opacity);
        let [first, last] = put(h, at::CENTER, 1, centers.range(extent(&self.center[..n])));
        let [narrow, wide] = put(h, at::WIDTH, 1, width_grid.log_range(widths));
        let [sharp, soft] = put(h, at::SOFTNESS, 1, soft_grid.log_range(softness));
        // By way of their centres' codes all Gaussians move a little.
        for i in 0..n {
            let center = centers.code(self.center[i], first, last);
            words[1][i] |= center << 16;
            self.move_to(i, quant::linear(center, first, last, LEVELS16));
        }
        let tails = seen_widths();
        let mut alive = NOTHING;
        for i in 0..n {
            let opacity = opacity_code(self.opacity[i], opacity_step);
            let (mut width, mut softness, mut life) = (FOR_EVER, 0, None);
            if self.log_width[i] < f64::INFINITY {
                let some = self.log_width[i] > f64::NEG_INFINITY;
                width = if some { 1 + width_grid.code(self.log_width[i], narrow, wide) } else { 0 };
                softness = soft_grid.code(self.log_softness[i], sharp, soft);
                life = Some([half_width(width, narrow, wide), quant::log(softness, sharp, soft, LEVELS8)]);
            }
            self.reach[i] = reach(life, span);
            // A Gaussian that never reaches 1/255 is alive at no time.
            let tail = tails[opacity as usize];
            if tail >= 0.0 {
                let [from, to] = match life {
                    Some([width, softness]) => {
                        let seen = (width + softness * tail) * (1.0 + SLACK) + SLACK;
                        [self.center[i] - seen, self.center[i] + seen]
                    }
                    None => span,
                };
                alive = [least(from, alive[0]), greatest(to, alive[1])];
            }
            words[2][i] |= opacity << 24;
            words[6][i] |= width << 24;
            words[7][i] |= softness << 16;
        }
        // A block of which nothing is ever seen is alive at no more than a time.
        let alive = if alive[0] <= alive[1] { alive } else { [first; 2] };
        h[at::ALIVE] = below(alive[0] - SLACK * alive[0].abs());
        h[at::ALIVE + 1] = above(alive[1] + SLACK * alive[1].abs());
    }
}

/// Nearest multiple of `step`, but full opacity stays: what is opaque must hide what is behind it.
#[inline(always)]
fn opacity_code(opacity: f64, step: u32) -> u32 {
    let steps = (opacity * f64::from(LEVELS8) * (1.0 / f64::from(step))).round().clamp(0.0, f64::from(LEVELS8));
    (steps as u32 * step).min(LEVELS8)
}

/// The extent of no values.
const NOTHING: [f64; 2] = [f64::INFINITY, f64::NEG_INFINITY];

/// Values side by side: a running minimum of one would wait for itself.
const LANES: usize = 8;

/// Least and greatest value; the order of folding changes nothing.
#[inline(always)]
fn extent(values: &[f64]) -> [f64; 2] {
    let (mut low, mut high) = ([NOTHING[0]; LANES], [NOTHING[1]; LANES]);
    let whole = values.len() / LANES * LANES;
    for group in values[..whole].chunks_exact(LANES) {
        for l in 0..LANES {
            low[l] = least(group[l], low[l]);
            high[l] = greatest(group[l], high[l]);
        }
    }
    let mut all = NOTHING;
    for l in 0..LANES {
        all = [least(low[l], all[0]), greatest(high[l], all[1])];
    }
    for x in &values[whole..] {
        all = [least(*x, all[0]), greatest(*x, all[1])];
    }
    all
}

/// Writes a range into a header, and gives it as a reader will see it.
#[inline(always)]
fn put(h: &mut Header, at: usize, step: usize, [low, high]: [f32; 2]) -> [f64; 2] {
    (h[at], h[at + step]) = (low, high);
    [f64::from(low), f64::from(high)]
}

#[inline(always)]
fn below(x: f64) -> f32 {
    let f = x as f32;
    if f64::from(f) > x { f.next_down() } else { f }
}

#[inline(always)]
fn above(x: f64) -> f32 {
    let f = x as f32;
    if f64::from(f) < x { f.next_up() } else { f }
}

/// Primitives as a block.
struct OfPrimitives<'a> {
    rows: &'a [(&'a Primitive, u16)],
    span: [f64; 2],
    depths: &'a Depths,
    words: &'a mut [[u32; PAGE_WORDS]],
}

impl Kernel for OfPrimitives<'_> {
    type Out = Header;

    #[inline(always)]
    fn run<const FMA: bool>(self) -> Header {
        let mut words = [[0; BLOCK_GAUSSIANS]; PAGE_WORDS];
        let header = Columns::of_primitives(self.rows, self.span).encode(self.span, self.depths, &mut words);
        turn_over(&words, self.words);
        header
    }
}

/// The decoded bytes of a page whose blocks are the given ones, in order: Gaussians with their palette entries.
pub(super) fn encode_page(rows: &[(&Primitive, u16)], span: [f64; 2], depths: &Depths) -> Vec<u8> {
    let mut words = vec![[0; PAGE_WORDS]; rows.len()];
    let blocks = rows.par_chunks(BLOCK_GAUSSIANS).zip(words.par_chunks_mut(BLOCK_GAUSSIANS));
    let headers: Vec<Header> = blocks.map(|(rows, words)| encode_block(rows, span, depths, words)).collect();
    page_of(&headers, &words)
}

/// A block of primitives with their entries of the palette: its header, and a Gaussian's words into each of `words`.
fn encode_block(
    rows: &[(&Primitive, u16)],
    span: [f64; 2],
    depths: &Depths,
    words: &mut [[u32; PAGE_WORDS]],
) -> Header {
    dispatch(Simd::detect(), OfPrimitives { rows, span, depths, words })
}
