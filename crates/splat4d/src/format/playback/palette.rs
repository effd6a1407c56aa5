//! A palette: spherical harmonics above degree 0 that many Gaussians share.

use super::index::{broken, palette_bytes};
use super::page::unpack;
use super::{Entry, Kind};
use crate::Result;
use crate::math::sh;

/// A code represents (code − 128)/127 of its range.
const MIDDLE: i32 = 128;
const HALF: f32 = 127.0;

/// By code: its share of the range.
const SHARES: [f32; 256] = {
    let mut shares = [0.0; 256];
    let mut code = 0;
    while code < 256 {
        shares[code] = (code as i32 - MIDDLE) as f32 / HALF;
        code += 1;
    }
    shares
};

/// A decoded palette.
#[derive(Clone, Debug, PartialEq)]
pub struct Palette {
    /// Degree of its spherical harmonics, 1 to 3.
    pub degree: usize,
    /// Entries.
    pub entries: usize,
    /// Largest magnitude of the coefficients of degree 1, 2 and 3.
    pub ranges: [f32; 3],
    /// 3(K − 1) planes of `entries` codes; plane 3(k − 1) + c is coefficient k of channel c.
    pub codes: Vec<u8>,
}

/// Decodes a palette from its stored bytes. Errors: they are not the entry's, or do not hold together.
pub(crate) fn decode_palette(entry: &Entry, stored: &[u8]) -> Result<Palette> {
    assert!(entry.kind == Kind::Palette, "only a palette is decoded as one");
    let bytes = unpack(entry, stored)?;
    let ranges = std::array::from_fn(|i| f32::from_le_bytes(std::array::from_fn(|b| bytes[4 * i + b])));
    if ranges.iter().any(|r| !r.is_finite()) {
        return Err(broken(format!("the ranges of a palette are {ranges:?}")));
    }
    let (degree, entries) = (usize::from(entry.degree), entry.count as usize);
    Ok(Palette { degree, entries, ranges, codes: bytes[12..].to_vec() })
}

/// Degree of the coefficient behind plane `plane`.
fn degree_of_plane(plane: usize) -> usize {
    (plane / 3 + 1).isqrt()
}

impl Palette {
    /// Quantises entries of `width` = 3(K − 1) coefficients each, entry after entry; within one, coefficient k = 1 … K
    /// − 1 of channel c is number 3(k − 1) + c. Panics: no entry, or a width that no degree has.
    pub fn new(degree: usize, values: &[f32]) -> Self {
        let width = 3 * (sh::coeffs(degree) - 1);
        let entries = values.len() / width;
        assert!(entries > 0 && values.len() == entries * width, "entries of {width} coefficients, {}", values.len());
        let mut ranges = [0.0f32; 3];
        for (i, v) in values.iter().enumerate() {
            let range = &mut ranges[degree_of_plane(i % width) - 1];
            *range = range.max(v.abs());
        }
        let code = |plane: usize, value: f32| {
            let range = ranges[degree_of_plane(plane) - 1];
            let share = if range > 0.0 { value / range } else { 0.0 };
            ((share * HALF).round() as i32 + MIDDLE) as u8
        };
        let planes = (0..width).flat_map(|plane| (0..entries).map(move |e| (plane, e)));
        let codes = planes.map(|(plane, e)| code(plane, values[e * width + plane])).collect();
        Self { degree, entries, ranges, codes }
    }

    /// Coefficients an entry: 3(K − 1).
    pub fn width(&self) -> usize {
        3 * (sh::coeffs(self.degree) - 1)
    }

    /// Coefficient k of channel c of an entry, `plane` = 3(k − 1) + c. Panics: there is none.
    #[inline]
    pub fn value(&self, entry: usize, plane: usize) -> f32 {
        assert!(entry < self.entries, "entry {entry} of a palette of {}", self.entries);
        self.ranges[degree_of_plane(plane) - 1] * SHARES[usize::from(self.codes[plane * self.entries + entry])]
    }

    /// Coefficient `plane` of consecutive entries. Panics: there is no such entry or plane.
    pub(super) fn values(&self, plane: usize, entries: &[u16], mut each: impl FnMut(usize, f32)) {
        let codes = &self.codes[plane * self.entries..(plane + 1) * self.entries];
        let range = self.ranges[degree_of_plane(plane) - 1];
        for (i, entry) in entries.iter().enumerate() {
            each(i, range * SHARES[usize::from(codes[usize::from(*entry)])]);
        }
    }

    /// The decoded bytes.
    pub(super) fn bytes(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(palette_bytes(self.degree, self.entries));
        self.ranges.iter().for_each(|r| out.extend_from_slice(&r.to_le_bytes()));
        out.extend_from_slice(&self.codes);
        out
    }
}
