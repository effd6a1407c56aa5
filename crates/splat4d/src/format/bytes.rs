//! Helpers of the dialects: a careful cursor over bytes, opacities and colours in bytes, and rows that can be written.

use super::warnings::Warnings;
use crate::scene::{GEOMETRY, LIFE, Params, SH};
use crate::{Error, Result};

/// SH basis function of degree 0, 1/(2√π): colour = ½ + C0·f_dc.
pub(super) const SH_C0: f32 = crate::math::sh::C0 as f32;

/// Reads numbers from the front of bytes; the end is an error, not a panic.
pub(super) struct Cursor<'a> {
    rest: &'a [u8],
    what: &'static str,
}

impl<'a> Cursor<'a> {
    /// `what` names the format in errors.
    pub(super) fn new(bytes: &'a [u8], what: &'static str) -> Self {
        Self { rest: bytes, what }
    }

    /// The next `count` bytes.
    pub(super) fn take(&mut self, count: usize) -> Result<&'a [u8]> {
        let Some((head, tail)) = self.rest.split_at_checked(count) else {
            let what = format!("the {} ends in the middle: {count} more bytes should follow", self.what);
            return Err(Error::input(what).remedy("The file is cut short or damaged; copy or export it again."));
        };
        self.rest = tail;
        Ok(head)
    }

    /// Bytes that follow.
    pub(super) fn left(&self) -> usize {
        self.rest.len()
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        Ok(*self.take(N)?.first_chunk().expect("that many bytes were taken"))
    }

    pub(super) fn u8(&mut self) -> Result<u8> {
        Ok(self.array::<1>()?[0])
    }

    pub(super) fn u16(&mut self) -> Result<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self) -> Result<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub(super) fn u64(&mut self) -> Result<u64> {
        self.array().map(u64::from_le_bytes)
    }
}

/// f32 number `i` of little-endian bytes that contain it.
#[inline]
pub(super) fn f32_at(bytes: &[u8], i: usize) -> f32 {
    f32::from_le_bytes(*bytes[4 * i..].first_chunk().expect("the row holds this number"))
}

/// Rounds to the nearest of 0..=255; `clipped` counts values that lie more than half a step outside.
#[inline]
pub(super) fn to_byte(x: f32, clipped: &mut bool) -> u8 {
    *clipped |= !(-0.5..=255.5).contains(&x);
    x.round() as u8
}

/// A scale of its logarithm; one that f32 cannot hold becomes the largest, so that no file has infinity in it.
#[inline]
pub(super) fn scale_of_log(log: f32) -> f32 {
    log.exp().min(f32::MAX)
}

/// The logit of an opacity of `byte`/255. The ends represent half an interval, whose middle is taken: their own logits
/// are infinite.
#[inline]
pub(super) fn logit_of_byte(byte: u8) -> f32 {
    let a = f32::from(byte).clamp(0.25, 254.75) / 255.0;
    (a / (1.0 - a)).ln()
}

/// An opacity as a byte.
#[inline]
pub(super) fn byte_of_logit(logit: f32) -> u8 {
    (255.0 / (1.0 + (-logit).exp())).round() as u8
}

/// A base colour (degree-0 coefficient) as a byte of [0, 1].
#[inline]
pub(super) fn byte_of_dc(dc: f32, clipped: &mut bool) -> u8 {
    to_byte((0.5 + SH_C0 * dc) * 255.0, clipped)
}

/// The base colour of a byte of [0, 1].
#[inline]
pub(super) fn dc_of_byte(byte: u8) -> f32 {
    (f32::from(byte) / 255.0 - 0.5) / SH_C0
}

/// Rows without NaN or infinity in geometry, colour and lifespan: one such number would spoil a whole block of a
/// quantised file. Returns how many were left out.
pub(super) fn sound_rows(params: &Params, warnings: &mut Warnings) -> Vec<usize> {
    let finite = |row: usize| {
        [GEOMETRY, SH, LIFE].into_iter().all(|key| {
            let table = &params[key];
            (0..table.width()).all(|col| table.get(row, col).is_finite())
        })
    };
    let rows: Vec<usize> = (0..params.len()).filter(|&row| finite(row)).collect();
    let lost = params.len() - rows.len();
    warnings.counted(lost, params.len(), "held NaN or infinity and were left out");
    rows
}
