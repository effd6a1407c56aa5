//! Lossless WebP images, decoded no further than their use bears out.

use super::damaged;
use crate::Result;
use image_webp::WebPDecoder;
use std::io::Cursor;

/// Pixels an image may have for each one needed: writers round sides up, some to powers of two.
const SLACK: usize = 4;
/// Pixels that any image may have: a palette of 65,536 entries of 15 coefficients.
const ALWAYS: usize = 1 << 20;

/// Bytes of an image next to its pixels: WebP's chunks, EXIF, colour profiles.
const MOST_CHUNKS: usize = 1 << 20;

/// Longest file of an image of a scene of `count` Gaussians: lossless WebP never takes more than its RGBA pixels.
pub(super) fn most_bytes(count: usize) -> usize {
    4 * ALWAYS.max(SLACK.saturating_mul(count)) + MOST_CHUNKS
}

/// Which pixels an image must hold.
#[derive(Clone, Copy, Debug)]
pub(super) enum Needs {
    /// One per Gaussian.
    Pixels(usize),
    /// Whatever it has: a palette.
    Palette,
}

/// RGBA pixels, row after row.
pub(super) struct Picture {
    pub(super) width: usize,
    pub(super) height: usize,
    pixels: Vec<u8>,
    /// 3 or 4.
    channels: usize,
}

impl Picture {
    /// Decodes an image. Errors: not WebP, lossy, damaged, fewer pixels than needed, or absurdly many.
    pub(super) fn open(bytes: &[u8], needs: Needs) -> Result<Self> {
        let broken = |e| damaged(format!("the image cannot be decoded ({e})"));
        let mut decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(broken)?;
        let (width, height) = decoder.dimensions();
        let (width, height) = (width as usize, height as usize);
        let (least, most) = match needs {
            Needs::Pixels(n) => (n, ALWAYS.max(SLACK * n)),
            Needs::Palette => (1, ALWAYS),
        };
        if !(least..=most).contains(&(width * height)) {
            return Err(damaged(format!("the image has {width}x{height} pixels, but {least} to {most} are expected")));
        }
        if decoder.is_animated() || decoder.is_lossy() {
            return Err(damaged("the image is lossy or animated, so its values are not exact"));
        }
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        decoder.set_memory_limit(16 * most + bytes.len());
        let mut pixels = vec![0; width * height * channels];
        decoder.read_image(&mut pixels).map_err(broken)?;
        Ok(Self { width, height, pixels, channels })
    }

    /// Red, green, blue, alpha of pixel i; alpha is 255 where the image has none.
    #[inline]
    pub(super) fn pixel(&self, i: usize) -> [u8; 4] {
        let p = &self.pixels[i * self.channels..][..self.channels];
        [p[0], p[1], p[2], *p.get(3).unwrap_or(&u8::MAX)]
    }
}
