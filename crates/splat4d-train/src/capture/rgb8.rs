//! 8-bit images as decoded from a file, before any processing.

use super::picture::{self, Raster, Samples};
use splat4d::Result;
use std::path::Path;

/// An upright image of 8-bit samples, rows from the top.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Rgb8 {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// width·height·3 samples, red first.
    pub data: Vec<u8>,
}

impl Rgb8 {
    /// Pixels across and down of the image in a file, upright, from its header alone.
    ///
    /// Errors: as [`read`](Self::read).
    pub fn size(path: &Path) -> Result<[usize; 2]> {
        picture::header(path).map(|header| header.upright().into())
    }

    /// The image in a JPEG, PNG or WebP file, upright; 16 bits are rounded to 8, alpha is left out.
    ///
    /// Errors: no such file, a damaged one or one of another kind.
    pub fn read(path: &Path) -> Result<Self> {
        Ok(Self::of(&picture::decode(path, None)?))
    }

    /// The same, and its alpha channel, where it has one: width·height samples.
    pub fn read_alpha(path: &Path) -> Result<(Self, Option<Vec<u8>>)> {
        let raster = picture::decode(path, None)?;
        let byte = |v: f32| (255.0 * v).round() as u8;
        let alpha = raster.alpha().map(|a| (0..raster.width * raster.height).map(|p| byte(raster.get(p, a))).collect());
        Ok((Self::of(&raster), alpha))
    }

    /// The image that the bytes of a JPEG, PNG or WebP file hold, as [`read`](Self::read). Errors name `place`.
    pub fn decode(bytes: &[u8], place: &Path) -> Result<Self> {
        Ok(Self::of(&picture::decode_bytes(bytes, place, None)?))
    }

    fn of(raster: &Raster) -> Self {
        let colors = if raster.channels < 3 { 1 } else { 3 };
        let byte = |i: usize| match &raster.samples {
            Samples::Eight(s) => s[i],
            // 65535 = 257·255.
            Samples::Sixteen(s) => ((u32::from(s[i]) + 128) / 257) as u8,
        };
        let pixel = |p: usize| [0, 1, 2].map(|c| byte(p * raster.channels + c % colors));
        let data = (0..raster.width * raster.height).flat_map(pixel).collect();
        Self { width: raster.width, height: raster.height, data }
    }
}
