//! Images in linear light and the sRGB curve, without `powf` (see vector.rs for why).

use crate::vector::{V3, v3};
use anyhow::{Context, Result};
use std::sync::LazyLock;

/// Linear value of each of the 256 sRGB codes (IEC 61966-2-1).
pub(crate) static LINEAR_FROM_SRGB: LazyLock<[f64; 256]> = LazyLock::new(|| {
    std::array::from_fn(|code| {
        let s = code as f64 / 255.0;
        if s <= 0.04045 { s / 12.92 } else { power_2_4((s + 0.055) / 1.055) }
    })
});

/// Linear values at which the rounded sRGB code steps from k to k + 1.
static CODE_STEPS: LazyLock<[f64; 255]> = LazyLock::new(|| {
    std::array::from_fn(|code| {
        let s = (code as f64 + 0.5) / 255.0;
        if s <= 0.04045 { s / 12.92 } else { power_2_4((s + 0.055) / 1.055) }
    })
});

/// The nearest sRGB code of a linear value, clamped to 0..255.
pub(crate) fn srgb_from_linear(linear: f64) -> u8 {
    CODE_STEPS.partition_point(|step| *step < linear) as u8
}

/// A linear colour from sRGB codes.
pub(crate) fn srgb(r: u8, g: u8, b: u8) -> V3 {
    let table = &*LINEAR_FROM_SRGB;
    v3(table[r as usize], table[g as usize], table[b as usize])
}

/// x^2.4 = (x^12)^(1/5) by Newton's iteration from above.
fn power_2_4(x: f64) -> f64 {
    let x2 = x * x;
    let x4 = x2 * x2;
    let target = x4 * x4 * x4;
    let mut root = 1.0;
    for _ in 0..60 {
        let r2 = root * root;
        root = (4.0 * root + target / (r2 * r2)) / 5.0;
    }
    root
}

/// A texture in linear light, rows from the top.
pub(crate) struct Texture {
    width: usize,
    height: usize,
    texels: Vec<V3>,
}

impl Texture {
    /// Decodes an embedded PNG.
    pub(crate) fn from_png(bytes: &[u8]) -> Result<Texture> {
        let picture =
            image::load_from_memory_with_format(bytes, image::ImageFormat::Png).context("embedded texture")?;
        let rgb = picture.to_rgb8();
        let texels = rgb.pixels().map(|p| srgb(p.0[0], p.0[1], p.0[2])).collect();
        Ok(Texture { width: rgb.width() as usize, height: rgb.height() as usize, texels })
    }

    /// Bilinear look-up, repeated outside [0,1)² (the files' sampler: linear, repeat).
    pub(crate) fn sample(&self, uv: [f64; 2]) -> V3 {
        let x = uv[0] * self.width as f64 - 0.5;
        let y = uv[1] * self.height as f64 - 0.5;
        let (fx, fy) = (x - x.floor(), y - y.floor());
        let column = |i: i64| i.rem_euclid(self.width as i64) as usize;
        let row = |i: i64| i.rem_euclid(self.height as i64) as usize * self.width;
        let (x0, x1) = (column(x.floor() as i64), column(x.floor() as i64 + 1));
        let (y0, y1) = (row(y.floor() as i64), row(y.floor() as i64 + 1));
        let top = self.texels[y0 + x0].lerp(self.texels[y0 + x1], fx);
        top.lerp(self.texels[y1 + x0].lerp(self.texels[y1 + x1], fx), fy)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_round_trips_and_matches_the_curve() {
        for code in 0..=255u8 {
            let s = f64::from(code) / 255.0;
            let expect = if s <= 0.04045 { s / 12.92 } else { ((s + 0.055) / 1.055).powf(2.4) };
            assert!((LINEAR_FROM_SRGB[code as usize] - expect).abs() < 1e-13);
            assert_eq!(srgb_from_linear(LINEAR_FROM_SRGB[code as usize]), code);
        }
        assert_eq!((srgb_from_linear(-1.0), srgb_from_linear(7.0)), (0, 255));
    }
}
