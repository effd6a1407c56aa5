//! A page: up to 65,536 Gaussians of one span of time in 32 bytes each, in blocks of 256 that share ranges.
//! docs/format.md, "Page", has the layout; encoder and decoder stand here side by side.

use super::index::{broken, crc};
use super::{ALPHA_MIN, BLOCK_GAUSSIANS, BLOCK_HEADER, Codec, Entry, Kind, PAGE_WORDS, Primitive};
use crate::math::quat as quaternion;
use crate::{Result, format::quant};
use rayon::prelude::*;

/// Largest code of 8 and 16 bits, and half of 10 bits around a middle of their own.
const LEVELS8: u32 = 255;
const LEVELS16: u32 = 65_535;
const HALF10: u32 = 511;
/// Codes 1 to 254 are half-widths: 253 steps.
const WIDTH_LEVELS: u32 = 253;
/// Code of a half-width that never ends.
const FOR_EVER: u32 = 255;
/// Standard deviations of its tails that a life's reach holds (docs/format.md).
const REACH: f64 = 3.0;
/// Logarithms of a header lie within ± this (docs/format.md), so that squares of what they stand for fit an f32.
pub(super) const MAX_LOG: f64 = 40.0;
/// A scale below this share of the Gaussian's largest is raised to it: 1/1000 of what is seen is never seen, and the
/// block's range of scales would pay for it.
const THINNEST: f64 = 1e-3;
/// Half-widths below this share of the softness are written as zero, for the same reason.
const NO_WIDTH: f64 = 0.02;
/// Shortest softness, seconds: a hundredth of a frame at 100 frames a second.
const SHARPEST: f64 = 1e-4;
/// Share by which a block's life is stretched, so that a reader in f32 does not cull what it would draw.
const SLACK: f64 = 1e-6;

/// Places of a block header (docs/format.md, "Page").
mod at {
    pub const BOX: usize = 0;
    pub const CENTER: usize = 6;
    pub const ALIVE: usize = 8;
    pub const SCALE: usize = 10;
    pub const SHIFT: usize = 12;
    pub const TURN: usize = 13;
    pub const WIDTH: usize = 14;
    pub const SOFTNESS: usize = 16;
    pub const COLOR: usize = 18;
}

/// A decoded page: headers and words as the file's bits have them.
#[derive(Clone, Debug, PartialEq)]
pub struct Page {
    /// It is drawn for from ≤ t < to, seconds.
    pub span: [f64; 2],
    /// One a block of 256 Gaussians.
    pub headers: Vec<[f32; BLOCK_HEADER]>,
    /// One a Gaussian.
    pub words: Vec<[u32; PAGE_WORDS]>,
    /// Place of its palette in the table of sections; none: base colour only.
    pub palette: Option<u32>,
}

/// One Gaussian of a page in numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    /// Mean at `center`, scene units.
    pub mean: [f64; 3],
    /// Middle of its life, seconds.
    pub center: f64,
    /// Seconds for which it is fully there before and after; infinite: for ever.
    pub half_width: f64,
    /// Standard deviation of the tails of its life, seconds.
    pub softness: f64,
    /// Unit rotation wxyz at `center`.
    pub quat: [f64; 4],
    /// Standard deviations, scene units.
    pub scales: [f64; 3],
    /// 0 to 1.
    pub opacity: f64,
    /// Scene units a second.
    pub velocity: [f64; 3],
    /// Radians a second about the world's axes.
    pub turn: [f64; 3],
    /// ½ + Y₀₀·(SH coefficient 0), not clamped.
    pub base_color: [f64; 3],
    /// Entry of the palette.
    pub label: u16,
}

/// Decodes a page from its stored bytes. Errors: they are not the entry's, or do not hold together.
pub fn decode_page(entry: &Entry, stored: &[u8]) -> Result<Page> {
    assert!(entry.kind == Kind::Page, "only a page is decoded as one");
    parse_page(&unpack(entry, stored)?, entry)
}

/// A page from its decoded bytes, of which there are as many as the entry's count asks for.
pub(super) fn parse_page(bytes: &[u8], entry: &Entry) -> Result<Page> {
    let n = entry.count as usize;
    let (head, planes) = bytes.split_at(n.div_ceil(BLOCK_GAUSSIANS) * 4 * BLOCK_HEADER);
    let mut headers = Vec::with_capacity(n.div_ceil(BLOCK_GAUSSIANS));
    for (k, bytes) in head.chunks_exact(4 * BLOCK_HEADER).enumerate() {
        let f: [f32; BLOCK_HEADER] =
            std::array::from_fn(|i| f32::from_le_bytes(std::array::from_fn(|b| bytes[4 * i + b])));
        let is_log = |i: usize| (at::SCALE..at::SHIFT).contains(&i) || (at::WIDTH..at::COLOR).contains(&i);
        let bad = |i: &usize| !f[*i].is_finite() || is_log(*i) && f64::from(f[*i].abs()) > MAX_LOG;
        if let Some(i) = (0..BLOCK_HEADER).find(bad) {
            return Err(broken(format!("number {i} of a block's header is {}", f[i])).at(format!("block {k}")));
        }
        headers.push(f);
    }
    let mut words = vec![[0; PAGE_WORDS]; n];
    for (plane, values) in planes.chunks_exact(n).enumerate() {
        let (word, shift) = (plane / 4, 8 * (plane % 4));
        for (w, &byte) in words.iter_mut().zip(values) {
            w[word] |= u32::from(byte) << shift;
        }
    }
    Ok(Page { span: entry.span, headers, words, palette: entry.palette })
}

/// The decoded bytes of a section. Errors: another number of stored bytes, a wrong checksum, a stream that does not
/// inflate to exactly what the entry says.
pub(super) fn unpack<'a>(entry: &Entry, stored: &'a [u8]) -> Result<std::borrow::Cow<'a, [u8]>> {
    if stored.len() != entry.stored as usize {
        return Err(broken(format!("a section has {} bytes instead of {}", stored.len(), entry.stored)));
    }
    if crc(stored) != entry.crc {
        return Err(broken("the checksum of a section is wrong".into()));
    }
    let wanted = entry.bytes as usize;
    match entry.codec {
        Codec::Raw if stored.len() == wanted => Ok(stored.into()),
        Codec::Deflate => {
            // The entry's check has seen that so few bytes can become so many.
            let mut out = vec![0; wanted];
            let mut inflate = flate2::Decompress::new(false);
            let status = inflate.decompress(stored, &mut out, flate2::FlushDecompress::Finish);
            let whole = matches!(status, Ok(flate2::Status::StreamEnd)) && inflate.total_out() == wanted as u64;
            if whole { Ok(out.into()) } else { Err(broken(format!("a section does not inflate to {wanted} bytes"))) }
        }
        codec => Err(broken(format!("a section stored as {codec:?} does not have {wanted} bytes"))),
    }
}

/// The decoded bytes of a page whose blocks are the given ones, in order: Gaussians with their palette entries.
pub(super) fn encode_page(rows: &[(&Primitive, u16)], span: [f64; 2]) -> Vec<u8> {
    let blocks: Vec<_> = rows.par_chunks(BLOCK_GAUSSIANS).map(|b| encode_block(b, span)).collect();
    let mut out = Vec::with_capacity(super::index::page_bytes(rows.len()));
    blocks.iter().flat_map(|(header, _)| header).for_each(|f| out.extend_from_slice(&f.to_le_bytes()));
    for plane in 0..4 * PAGE_WORDS {
        let (word, shift) = (plane / 4, 8 * (plane % 4));
        out.extend(blocks.iter().flat_map(|(_, words)| words).map(|w| (w[word] >> shift) as u8));
    }
    out
}

/// Smallest f32 range that holds all values; (0, 0) for none.
fn range(values: impl Iterator<Item = f64>) -> [f32; 2] {
    let [low, high] = values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], x| [low.min(x), high.max(x)]);
    if low > high { [0.0; 2] } else { [below(low), above(high)] }
}

fn below(x: f64) -> f32 {
    let f = x as f32;
    if f64::from(f) > x { f.next_down() } else { f }
}

fn above(x: f64) -> f32 {
    let f = x as f32;
    if f64::from(f) < x { f.next_up() } else { f }
}

fn log_range(values: impl Iterator<Item = f64>) -> [f32; 2] {
    range(values.map(|x| x.ln().clamp(-MAX_LOG, MAX_LOG)))
}

/// A Gaussian on its way into a block.
struct Row {
    mean: [f64; 3],
    center: f64,
    /// None: for ever.
    life: Option<[f64; 2]>,
    quat: [f64; 4],
    scales: [f64; 3],
    velocity: [f64; 3],
    turn: [f64; 3],
}

impl Row {
    fn new(p: &Primitive, span: [f64; 2]) -> Self {
        let mut row = Self {
            mean: p.mean,
            center: p.center,
            life: None,
            quat: quaternion::normalize(p.quat.map(f64::from)).0,
            scales: scales(p),
            velocity: p.velocity.map(f64::from),
            turn: p.turn.map(f64::from),
        };
        if lives_through(p, span) {
            // From the middle of the span the reach is shortest. A turn keeps its own centre: normalize(q₀ + ½Δ(0, ω)⊗q₀)
            // is fastest there, and no other centre gives the same motion.
            if row.turn == [0.0; 3] {
                row.move_to(0.5 * (span[0] + span[1]));
            }
        } else {
            let softness = p.softness.max(SHARPEST);
            row.life = Some([if p.half_width < NO_WIDTH * softness { 0.0 } else { p.half_width }, softness]);
        }
        row
    }

    /// Takes another time as the centre: exact for the mean, and for a turn as near as that time is.
    fn move_to(&mut self, center: f64) {
        let delta = center - self.center;
        self.center = center;
        (0..3).for_each(|k| self.mean[k] += self.velocity[k] * delta);
        let rate = rate(self.quat, self.turn);
        self.quat = quaternion::normalize(std::array::from_fn(|i| self.quat[i] + delta * rate[i])).0;
    }
}

/// Scales as they are written: positive, and none far below the largest.
fn scales(p: &Primitive) -> [f64; 3] {
    let scales = p.scales.map(f64::from);
    let largest = scales[0].max(scales[1]).max(scales[2]);
    scales.map(|s| s.max(THINNEST * largest).max((-MAX_LOG).exp()))
}

/// Whether a Gaussian is fully there during all of its node, and so may be written as living for ever.
pub(super) fn lives_through(p: &Primitive, span: [f64; 2]) -> bool {
    p.center - p.half_width <= span[0] && span[1] <= p.center + p.half_width
}

/// ½(0, ω)⊗q: the rate at which a quaternion changes that turns at ω about the world's axes.
pub(super) fn rate([w, x, y, z]: [f64; 4], [a, b, c]: [f64; 3]) -> [f64; 4] {
    [-a * x - b * y - c * z, a * w + b * z - c * y, b * w + c * x - a * z, c * w + a * y - b * x].map(|r| 0.5 * r)
}

/// Seconds over which shift and turn are measured (docs/format.md, "Page").
fn reach(life: Option<[f64; 2]>, span: [f64; 2]) -> f64 {
    let length = span[1] - span[0];
    life.map_or(0.5 * length, |[half_width, softness]| (half_width + REACH * softness).min(length))
}

fn encode_block(rows: &[(&Primitive, u16)], span: [f64; 2]) -> ([f32; BLOCK_HEADER], Vec<[u32; PAGE_WORDS]>) {
    let mut moved: Vec<Row> = rows.iter().map(|(p, _)| Row::new(p, span)).collect();
    let mut h = [0.0f32; BLOCK_HEADER];
    let mut words = vec![[0u32; PAGE_WORDS]; rows.len()];
    fn put(h: &mut [f32; BLOCK_HEADER], at: usize, range: [f32; 2], step: usize) {
        (h[at], h[at + step]) = (range[0], range[1]);
    }
    let get = |h: &[f32; BLOCK_HEADER], at: usize, step: usize| (f64::from(h[at]), f64::from(h[at + step]));

    // Life first: mean and rotation are evaluated at the centre that a reader will see, and the reach of the motion
    // follows from the life that a reader will see.
    put(&mut h, at::CENTER, range(moved.iter().map(|r| r.center)), 1);
    let lives = || moved.iter().filter_map(|r| r.life);
    let widths = log_range(lives().map(|l| l[0]).filter(|&w| w > 0.0));
    let softness = log_range(lives().map(|l| l[1]));
    put(&mut h, at::WIDTH, widths, 1);
    put(&mut h, at::SOFTNESS, softness, 1);
    let mut alive = [f64::INFINITY, f64::NEG_INFINITY];
    for ((r, w), (p, label)) in moved.iter_mut().zip(&mut words).zip(rows) {
        let (low, high) = get(&h, at::CENTER, 1);
        let center = quant::linear_code(r.center, low, high, LEVELS16);
        r.move_to(quant::linear(center, low, high, LEVELS16));
        let opacity = quant::linear_code(f64::from(p.opacity), 0.0, 1.0, LEVELS8);
        let mut width = FOR_EVER;
        let mut soft = 0;
        if let Some(life) = &mut r.life {
            let (low, high) = get(&h, at::WIDTH, 1);
            width = if life[0] > 0.0 { 1 + quant::log_code(life[0], low, high, WIDTH_LEVELS) } else { 0 };
            life[0] = half_width(width, low, high);
            let (low, high) = get(&h, at::SOFTNESS, 1);
            soft = quant::log_code(life[1], low, high, LEVELS8);
            life[1] = quant::log(soft, low, high, LEVELS8);
        }
        let level = (f64::from(opacity) / f64::from(LEVELS8) / ALPHA_MIN).ln();
        if level >= -SLACK {
            let [from, to] = r.life.map_or(span, |[width, softness]| {
                let seen = (width + softness * (2.0 * level.max(0.0)).sqrt()) * (1.0 + SLACK) + SLACK;
                [r.center - seen, r.center + seen]
            });
            alive = [alive[0].min(from), alive[1].max(to)];
        }
        w[1] |= center << 16;
        w[2] |= opacity << 24;
        w[6] |= width << 24;
        w[7] = u32::from(*label) | soft << 16;
    }
    // A block of which nothing is ever seen is alive at no more than an instant.
    let alive = if alive[0] <= alive[1] { alive } else { [f64::from(h[at::CENTER]); 2] };
    put(&mut h, at::ALIVE, [below(alive[0] - SLACK * alive[0].abs()), above(alive[1] + SLACK * alive[1].abs())], 1);

    for k in 0..3 {
        put(&mut h, at::BOX + k, range(moved.iter().map(|r| r.mean[k])), 3);
        put(&mut h, at::COLOR + k, range(rows.iter().map(|(p, _)| f64::from(p.base_color[k]))), 3);
    }
    put(&mut h, at::SCALE, log_range(moved.iter().flat_map(|r| r.scales)), 1);
    let most = |of: fn(&Row) -> [f64; 3]| {
        let far = |r: &Row| of(r).map(|x| (x * reach(r.life, span)).abs());
        above(moved.iter().flat_map(far).fold(0.0, f64::max))
    };
    (h[at::SHIFT], h[at::TURN]) = (most(|r| r.velocity), most(|r| r.turn));

    for ((r, w), (p, _)) in moved.iter().zip(&mut words).zip(rows) {
        let along = reach(r.life, span);
        for k in 0..3 {
            let (low, high) = get(&h, at::BOX + k, 3);
            let mean = quant::linear_code(r.mean[k], low, high, LEVELS16);
            w[k / 2] |= mean << (16 * (k % 2));
            let (low, high) = get(&h, at::SCALE, 1);
            w[2] |= quant::log_code(r.scales[k], low, high, LEVELS8) << (8 * k);
            w[4] |= quant::signed_code(r.velocity[k] * along, f64::from(h[at::SHIFT]), HALF10) << (10 * k);
            w[5] |= quant::signed_code(r.turn[k] * along, f64::from(h[at::TURN]), HALF10) << (10 * k);
            let (low, high) = get(&h, at::COLOR + k, 3);
            w[6] |= quant::linear_code(f64::from(p.base_color[k]), low, high, LEVELS8) << (8 * k);
        }
        let (largest, codes) = quant::quat_codes(r.quat, HALF10);
        w[3] = (largest as u32) << 30 | codes[0] << 20 | codes[1] << 10 | codes[2];
    }
    (h, words)
}

fn half_width(code: u32, low: f64, high: f64) -> f64 {
    match code {
        0 => 0.0,
        FOR_EVER => f64::INFINITY,
        _ => quant::log(code - 1, low, high, WIDTH_LEVELS),
    }
}

impl Page {
    /// Gaussians.
    pub fn len(&self) -> usize {
        self.words.len()
    }

    /// Whether it has none; no page of a file has.
    pub fn is_empty(&self) -> bool {
        self.words.is_empty()
    }

    /// Gaussian i in numbers. Panics: there are fewer.
    pub fn record(&self, i: usize) -> Record {
        let (h, w) = (&self.headers[i / BLOCK_GAUSSIANS], &self.words[i]);
        let bits = |word: usize, first: u32, count: u32| w[word] >> first & ((1 << count) - 1);
        let line = |at: usize, step: usize, code: u32, levels: u32| {
            quant::linear(code, f64::from(h[at]), f64::from(h[at + step]), levels)
        };
        let half_width = half_width(bits(6, 24, 8), f64::from(h[at::WIDTH]), f64::from(h[at::WIDTH + 1]));
        let softness = line(at::SOFTNESS, 1, bits(7, 16, 8), LEVELS8).exp();
        let reach = reach(half_width.is_finite().then_some([half_width, softness]), self.span);
        let motion = |word: usize, at: usize| {
            std::array::from_fn(|k| quant::signed(bits(word, 10 * k as u32, 10), f64::from(h[at]), HALF10) / reach)
        };
        Record {
            mean: std::array::from_fn(|k| line(at::BOX + k, 3, bits(k / 2, 16 * (k as u32 % 2), 16), LEVELS16)),
            center: line(at::CENTER, 1, bits(1, 16, 16), LEVELS16),
            half_width,
            softness,
            quat: quant::quat(bits(3, 30, 2) as usize, [20, 10, 0].map(|first| bits(3, first, 10)), HALF10),
            scales: std::array::from_fn(|k| line(at::SCALE, 1, bits(2, 8 * k as u32, 8), LEVELS8).exp()),
            opacity: f64::from(bits(2, 24, 8)) / f64::from(LEVELS8),
            velocity: motion(4, at::SHIFT),
            turn: motion(5, at::TURN),
            base_color: std::array::from_fn(|k| line(at::COLOR + k, 3, bits(6, 8 * k as u32, 8), LEVELS8)),
            label: bits(7, 0, 16) as u16,
        }
    }
}
