//! Alpha that is premultiplied: colours of half-transparent pixels are as much darker than opaque ones next to them as their alpha is
//! smaller. Training reads straight alpha, and takes the product for the colour.

use super::super::account::Severity;
use super::super::picture::Raster;
use super::super::preflight::Finding;
use super::Aspect;

/// Alpha between which a pixel is half transparent, and from which it is opaque.
const PARTIAL: [f32; 2] = [0.1, 0.9];
const OPAQUE: f32 = 0.98;
/// Half-transparent pixels with an opaque one next to them that are compared at least.
const ENOUGH: usize = 200;
/// Difference as premultiplied alpha of that as straight alpha at most, where alpha is premultiplied. Renders of three captures: 2.8
/// to 17 as they are, 0.03 to 0.18 multiplied (studies/records/2026-11-28-silent-inputs.md).
const MULTIPLIED: f64 = 0.4;
/// Steps to the pixels that are compared with, columns and rows: the nearest first.
const AROUND: [[isize; 2]; 8] = [[1, 0], [-1, 0], [0, 1], [0, -1], [2, 0], [-2, 0], [0, 2], [0, -2]];

/// Differences of half-transparent pixels from opaque ones next to them.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Fringe {
    pixels: usize,
    /// Of colours as they are, and of those divided by alpha.
    straight: f64,
    multiplied: f64,
}

impl Fringe {
    /// Compares the pixels of an image; nothing without alpha.
    pub(super) fn of(raster: &Raster) -> Self {
        let mut out = Self::default();
        let Some(alpha) = raster.alpha() else { return out };
        let (width, height) = (raster.width as isize, raster.height as isize);
        for p in 0..raster.width * raster.height {
            let a = raster.get(p, alpha);
            if a <= PARTIAL[0] || a >= PARTIAL[1] {
                continue;
            }
            let (x, y) = (p as isize % width, p as isize / width);
            let opaque = |[dx, dy]: &[isize; 2]| {
                let (x, y) = (x + dx, y + dy);
                let inside = (0..width).contains(&x) && (0..height).contains(&y);
                let next = (y * width + x) as usize;
                (inside && raster.get(next, alpha) >= OPAQUE).then_some(next)
            };
            let Some(next) = AROUND.iter().find_map(opaque) else { continue };
            for c in 0..alpha {
                let (own, other) = (raster.get(p, c), raster.get(next, c));
                out.straight += f64::from((own - other).abs());
                out.multiplied += f64::from((own - a * other).abs());
            }
            out.pixels += 1;
        }
        out
    }
}

/// A warning where alpha is premultiplied.
pub(super) fn check(images: impl Iterator<Item = Fringe>) -> Option<Finding> {
    let sum = images.fold(Fringe::default(), |a, b| Fringe {
        pixels: a.pixels + b.pixels,
        straight: a.straight + b.straight,
        multiplied: a.multiplied + b.multiplied,
    });
    (sum.pixels >= ENOUGH && sum.multiplied <= MULTIPLIED * sum.straight).then(|| Finding {
        severity: Severity::Warning,
        aspect: Some(Aspect::Assumed),
        what: format!(
            "Alpha is probably premultiplied, and is read as straight alpha: {} half-transparent pixels differ from opaque ones next to \
             them by {:.2} of their brightness times alpha, and by {:.2} of their brightness.",
            sum.pixels,
            sum.multiplied / sum.pixels as f64,
            sum.straight / sum.pixels as f64
        ),
        remedy: "Export straight alpha (colour divided by alpha): edges become too dark otherwise.".into(),
    })
}
