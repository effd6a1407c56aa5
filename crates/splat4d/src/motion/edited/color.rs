//! Maps of colours, as they act on spherical harmonics.

use crate::math::Real;
use crate::math::sh::{dc_to_rgb, rgb_to_dc};
use serde::{Deserialize, Serialize};

/// c ↦ curve(M c + o), channel by channel in the curve; colours are 0 to 1.
///
/// On spherical harmonics the base colour is mapped by it, and all that varies with direction by its slope there: exact
/// where there is no curve.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ColorMap {
    /// Rows of M, red, green and blue.
    pub matrix: [[f64; 3]; 3],
    /// o
    pub offset: [f64; 3],
    /// Corners [in, out] of a broken line, `in` rising; beyond the first and the last it continues as it did. Fewer
    /// than two: no curve.
    pub curve: Vec<[f64; 2]>,
}

impl Default for ColorMap {
    fn default() -> Self {
        let matrix = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
        Self { matrix, offset: [0.0; 3], curve: Vec::new() }
    }
}

impl ColorMap {
    pub(crate) fn is_sound(&self) -> bool {
        let numbers = self.matrix.as_flattened().iter().chain(&self.offset).chain(self.curve.as_flattened());
        numbers.into_iter().all(|x| x.is_finite()) && self.curve.windows(2).all(|k| k[0][0] < k[1][0])
    }

    /// The curve and its slope.
    fn bend(&self, x: f64) -> (f64, f64) {
        let n = self.curve.len();
        if n < 2 {
            return (x, 1.0);
        }
        let i = self.curve.iter().position(|k| k[0] > x).unwrap_or(n).clamp(1, n - 1);
        let ([x0, y0], [x1, y1]) = (self.curve[i - 1], self.curve[i]);
        let slope = (y1 - y0) / (x1 - x0);
        (y0 + slope * (x - x0), slope)
    }

    fn linear(&self, v: [f64; 3]) -> [f64; 3] {
        self.matrix.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
    }

    /// The map of a colour, and the curve's slopes there.
    fn colored(&self, rgb: [f64; 3]) -> ([f64; 3], [f64; 3]) {
        let mixed = self.linear(rgb);
        let bent: [(f64, f64); 3] = std::array::from_fn(|c| self.bend(mixed[c] + self.offset[c]));
        (bent.map(|b| b.0), bent.map(|b| b.1))
    }

    /// Colours, three channels; further ones are not changed.
    pub(super) fn colors<F: Real>(&self, row: &mut [F]) {
        let rgb = self.colored(std::array::from_fn(|c| row[c].f64())).0;
        (0..3).for_each(|c| row[c] = F::of(rgb[c]));
    }

    pub(super) fn colors_back<F: Real>(&self, seen: &[F], d: &mut [F]) {
        let slopes = self.colored(std::array::from_fn(|c| seen[c].f64())).1;
        self.back(slopes, d, 0);
    }

    /// Coefficient k of channel c at 3k + c.
    pub(crate) fn harmonics<F: Real>(&self, row: &mut [F]) {
        let base: [f64; 3] = std::array::from_fn(|c| dc_to_rgb(row[c].f64()));
        let (rgb, slopes) = self.colored(base);
        (0..3).for_each(|c| row[c] = F::of(rgb_to_dc(rgb[c])));
        for k in 1..row.len() / 3 {
            let turned = self.linear(std::array::from_fn(|c| row[3 * k + c].f64()));
            (0..3).for_each(|c| row[3 * k + c] = F::of(slopes[c] * turned[c]));
        }
    }

    /// dL/d coefficients in place of dL/d mapped ones.
    pub(super) fn harmonics_back<F: Real>(&self, seen: &[F], d: &mut [F]) {
        let slopes = self.colored(std::array::from_fn(|c| dc_to_rgb(seen[c].f64()))).1;
        (0..d.len() / 3).for_each(|k| self.back(slopes, d, 3 * k));
    }

    fn back<F: Real>(&self, slopes: [f64; 3], d: &mut [F], first: usize) {
        let g: [f64; 3] = std::array::from_fn(|c| slopes[c] * d[first + c].f64());
        (0..3).for_each(|c| d[first + c] = F::of((0..3).map(|i| self.matrix[i][c] * g[i]).sum()));
    }
}
