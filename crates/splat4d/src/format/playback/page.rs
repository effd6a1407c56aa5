//! A page: up to 65,536 Gaussians of one span of time in 32 bytes each, in blocks of 256 that share ranges.
//! docs/format.md, "Page", has the layout; the encoder is in block.rs, the decoder here.

use super::index::{broken, crc};
use super::{ALPHA_MIN, BLOCK_GAUSSIANS, BLOCK_HEADER, Codec, Entry, Kind, PAGE_WORDS, Primitive};
use crate::simd::least;
use crate::{Result, format::quant};
use std::sync::LazyLock;

/// Bits of the codes.
pub(super) const FULL8: u32 = 8;
pub(super) const FULL10: u32 = 10;
pub(super) const FULL16: u32 = 16;
/// Largest code of 8 and 16 bits, and half of 10 bits around a middle of their own.
pub(super) const LEVELS8: u32 = 255;
pub(super) const LEVELS16: u32 = 65_535;
pub(super) const HALF10: u32 = 511;
/// Codes 1 to 254 are half-widths: 253 steps.
pub(super) const WIDTH_LEVELS: u32 = 253;
/// Code of a half-width that never ends.
pub(super) const FOR_EVER: u32 = 255;
/// Standard deviations of its tails that a lifespan's reach holds (docs/format.md).
const REACH: f64 = 3.0;
/// Logarithms of a header are within ± this (docs/format.md), so that squares of what they represent fit an f32.
pub(super) const MAX_LOG: f64 = 40.0;
/// A scale below this share of the Gaussian's largest is raised to it: 1/1000 of a visible size is invisible, and the
/// block's range of scales would pay for it.
pub(super) const THINNEST: f64 = 1e-3;
/// Places of a block header (docs/format.md, "Page").
pub(super) mod at {
    pub(crate) const BOX: usize = 0;
    pub(crate) const CENTER: usize = 6;
    pub(crate) const ALIVE: usize = 8;
    pub(crate) const SCALE: usize = 10;
    pub(crate) const SHIFT: usize = 12;
    pub(crate) const TURN: usize = 13;
    pub(crate) const WIDTH: usize = 14;
    pub(crate) const SOFTNESS: usize = 16;
    pub(crate) const COLOR: usize = 18;
}

/// Header of a block.
pub(super) type Header = [f32; BLOCK_HEADER];

/// A decoded page: headers and words as the file's bits have them.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Page {
    /// It is rendered for from ≤ t < to, seconds.
    pub span: [f64; 2],
    /// One per block of 256 Gaussians.
    pub headers: Vec<[f32; BLOCK_HEADER]>,
    /// One per Gaussian.
    pub words: Vec<[u32; PAGE_WORDS]>,
    /// Place of its palette in the table of sections; none: base colour only.
    pub palette: Option<u32>,
}

/// One Gaussian of a page in numbers.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Record {
    /// Mean at `center`, scene units.
    pub mean: [f64; 3],
    /// Middle of its lifespan, seconds.
    pub center: f64,
    /// Seconds for which it is fully there before and after; infinite: always.
    pub half_width: f64,
    /// Standard deviation of the tails of its lifespan, seconds.
    pub softness: f64,
    /// Unit rotation wxyz at `center`.
    pub quat: [f64; 4],
    /// Standard deviations, scene units.
    pub scales: [f64; 3],
    /// 0 to 1.
    pub opacity: f64,
    /// Scene units per second.
    pub velocity: [f64; 3],
    /// Radians a second about the world's axes.
    pub turn: [f64; 3],
    /// ½ + Y₀₀·(SH coefficient 0), not clamped.
    pub base_color: [f64; 3],
    /// Entry of the palette.
    pub label: u16,
}

/// Decodes a page from its stored bytes. Errors: they are not the entry's, or do not hold together.
pub(crate) fn decode_page(entry: &Entry, stored: &[u8]) -> Result<Page> {
    assert!(entry.kind == Kind::Page, "only a page is decoded as one");
    parse_page(&unpack(entry, stored)?, entry)
}

/// A page from its decoded bytes, of which there are as many as the entry's count requests.
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
/// inflate to exactly what the entry states.
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
            // The entry's check has seen that so few bytes can become this many.
            let mut out = vec![0; wanted];
            let mut inflate = flate2::Decompress::new(false);
            let status = inflate.decompress(stored, &mut out, flate2::FlushDecompress::Finish);
            let whole = matches!(status, Ok(flate2::Status::StreamEnd)) && inflate.total_out() == wanted as u64;
            if whole { Ok(out.into()) } else { Err(broken(format!("a section does not inflate to {wanted} bytes"))) }
        }
        codec => Err(broken(format!("a section stored as {codec:?} does not have {wanted} bytes"))),
    }
}

/// The decoded bytes of a page: headers, then byte planes.
pub(super) fn page_of(headers: &[Header], words: &[[u32; PAGE_WORDS]]) -> Vec<u8> {
    let mut out = Vec::with_capacity(super::index::page_bytes(words.len()));
    headers.iter().flatten().for_each(|f| out.extend_from_slice(&f.to_le_bytes()));
    for plane in 0..4 * PAGE_WORDS {
        let (word, shift) = (plane / 4, 8 * (plane % 4));
        out.extend(words.iter().map(|w| (w[word] >> shift) as u8));
    }
    out
}

/// Scales as written: positive, and none far below the largest.
pub(super) fn scales(p: &Primitive) -> [f64; 3] {
    let scales = p.scales.map(f64::from);
    let largest = scales[0].max(scales[1]).max(scales[2]);
    scales.map(|s| s.max(THINNEST * largest).max((-MAX_LOG).exp()))
}

/// Whether a Gaussian is fully there during all of its node, and so may be written as with infinite lifespans.
#[inline(always)]
pub(super) fn lives_through(center: f64, half_width: f64, span: [f64; 2]) -> bool {
    center - half_width <= span[0] && span[1] <= center + half_width
}

/// ½(0, ω)⊗q: the rate at which a quaternion changes that turns at ω about the world's axes.
#[inline(always)]
pub(super) fn rate([w, x, y, z]: [f64; 4], [a, b, c]: [f64; 3]) -> [f64; 4] {
    [-a * x - b * y - c * z, a * w + b * z - c * y, b * w + c * x - a * z, c * w + a * y - b * x].map(|r| 0.5 * r)
}

/// Seconds over which shift and turn are measured (docs/format.md, "Page").
#[inline(always)]
pub(super) fn reach(life: Option<[f64; 2]>, span: [f64; 2]) -> f64 {
    let length = span[1] - span[0];
    match life {
        Some([half_width, softness]) => least(half_width + REACH * softness, length),
        None => 0.5 * length,
    }
}

/// By code of the opacity o: how many standard deviations of its tails beyond its half-width a Gaussian is seen, which
/// is √(2 ln(255·o)); −1 where it is never seen.
#[inline(always)]
pub(super) fn seen_widths() -> &'static [f64; 1 << FULL8] {
    static WIDTHS: LazyLock<[f64; 1 << FULL8]> = LazyLock::new(|| {
        std::array::from_fn(|code| {
            let level = (code as f64 / f64::from(LEVELS8) / ALPHA_MIN).ln();
            // 1/255 itself is seen, whatever the logarithm rounds to.
            if level >= -1e-6 { (2.0 * level.max(0.0)).sqrt() } else { -1.0 }
        })
    });
    &WIDTHS
}

#[inline(always)]
pub(super) fn half_width(code: u32, low: f64, high: f64) -> f64 {
    match code {
        0 => 0.0,
        FOR_EVER => f64::INFINITY,
        _ => quant::log(code - 1, low, high, WIDTH_LEVELS),
    }
}

impl Page {
    /// Gaussians.
    pub(crate) fn len(&self) -> usize {
        self.words.len()
    }

    /// Gaussian i in numbers. Panics: there are fewer.
    pub(crate) fn record(&self, i: usize) -> Record {
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
