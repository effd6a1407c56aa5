//! Features: image positions that can be recognised from other cameras, and their descriptors (Lowe 2004, SIFT).
//!
//! Extrema of differences of Gaussians over place and scale, refined below the pixel; histograms of gradients around
//! them, turned by the main gradient. Square roots of histograms are compared (Arandjelović and Zisserman 2012), as
//! bytes, so that distances are whole numbers.

use super::raster::{blurred, doubled, every_second};
use splat4d::math::mat3::solve;
use splat4d::scene::Planes;
use std::cell::RefCell;
use std::f64::consts::TAU;

/// Numbers of a descriptor: 4 x 4 cells of 8 directions.
pub const NUMBERS: usize = CELLS * CELLS * DIRECTIONS;
const CELLS: usize = 4;
const DIRECTIONS: usize = 8;

/// A place that other cameras may find again.
#[derive(Clone, Debug)]
pub struct Feature {
    /// Pixel position in the image.
    pub pixel: [f64; 2],
    /// Contrast to its surroundings.
    pub contrast: f32,
    /// Its descriptor.
    pub descriptor: [u8; NUMBERS],
}

impl Feature {
    /// Squared distance of the descriptors.
    pub(crate) fn distance(&self, other: &Self) -> u32 {
        /// Numbers at a time: whole registers, in half of the time of one at a time.
        const LANES: usize = 8;
        let mut sum = 0;
        for (a, b) in self.descriptor.chunks_exact(LANES).zip(other.descriptor.chunks_exact(LANES)) {
            for k in 0..LANES {
                let apart = i16::from(a[k]) - i16::from(b[k]);
                sum += i32::from(apart) * i32::from(apart);
            }
        }
        sum as u32
    }
}

/// Scales between two octaves (Lowe 2004).
const INTERVALS: usize = 3;
/// Blur of an octave's first image, pixels (Lowe 2004).
const SIGMA: f64 = 1.6;
/// Blur of a camera's image before anything is done to it, pixels (Lowe 2004).
const CAMERA_BLUR: f64 = 0.5;
/// Least contrast of an extremum where nothing else is reported; Lowe's 0.04 / [`INTERVALS`], halved for images that
/// are dark.
const CONTRAST: f64 = 0.02 / INTERVALS as f64;
/// An extremum along an edge has one curvature this many times the other (Lowe 2004).
const EDGE: f64 = 10.0;
/// Octaves end at images smaller than this, pixels.
const SMALLEST: usize = 16;
/// Pixels from the border within which nothing is searched for.
const BORDER: usize = 5;
/// Times that an extremum may move to the next pixel while it is refined.
const MOVES: usize = 5;
/// Images of fewer pixels are doubled first: their finest detail makes the best features (Lowe 2004).
const DOUBLED_BELOW: usize = 500_000;
/// Features of an image where nothing else is reported, at most: those of highest contrast.
const MOST: usize = 3000;

/// Number of features to find.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Least contrast of an extremum, of an image in [0, 1].
    pub contrast: f64,
    /// At most this many, those of highest contrast.
    pub most: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self { contrast: CONTRAST, most: MOST }
    }
}

/// The features of a grey image at pixels (column, row) that are `wanted`, in the order of falling contrast.
///
/// A place with two main directions is two features, one behind the other, of exactly the same pixel position.
pub fn find(grey: &Planes<f32>, limits: Limits, wanted: &dyn Fn(usize, usize) -> bool) -> Vec<Feature> {
    let double = grey.pixels() < DOUBLED_BELOW;
    // Pixels of the image per pixel of the first octave.
    let mut pixel = if double { 0.5 } else { 1.0 };
    let had = CAMERA_BLUR / pixel;
    let start = if double { doubled(grey) } else { grey.clone() };
    let mut base = blurred(&start, (SIGMA * SIGMA - had * had).sqrt());
    let first = pixel;
    let mut out: Vec<Feature> = Vec::new();
    while base.width.min(base.height) >= SMALLEST {
        let octave = Octave::new(base);
        let mut points = Vec::new();
        for at in octave.extrema(limits.contrast) {
            let Some(point) = octave.refine(at, limits.contrast) else { continue };
            // Coarser octaves keep the first pixel of two, and its place.
            let place = [point.x, point.y].map(|k| k * pixel + 0.5 * first);
            let inside = place[0] >= 0.0 && place[1] >= 0.0;
            let [x, y] = place.map(|k| k as usize);
            if inside && x < grey.width && y < grey.height && wanted(x, y) {
                points.push((point.contrast as f32, place, point));
            }
        }
        // Descriptions take most of the time: only those of points that can be among the `most` are made.
        points.sort_by(|a, b| b.0.total_cmp(&a.0));
        let finer = out.len();
        for (contrast, place, point) in points {
            let before = out[..finer].partition_point(|f| f.contrast >= contrast) + out.len() - finer;
            if before >= limits.most {
                break;
            }
            for angle in octave.angles(&point) {
                let descriptor = octave.describe(&point, angle);
                out.push(Feature { pixel: place, contrast, descriptor });
            }
        }
        out.sort_by(|a, b| b.contrast.total_cmp(&a.contrast));
        out.truncate(limits.most);
        base = every_second(&octave.blurred[INTERVALS]);
        pixel *= 2.0;
    }
    out
}

/// An extremum, refined.
struct Point {
    /// Place in the octave's images, the first pixel's centre at 0.
    x: f64,
    y: f64,
    /// The blurred image that it was found in.
    layer: usize,
    /// Its scale in pixels of the octave.
    sigma: f64,
    contrast: f64,
}

/// Pixels of an octave up to which gradients are kept: 16 MB for each blurred image.
const KEPT: usize = 1_000_000;
/// A gradient that was not computed yet.
const UNKNOWN: (f64, f64) = (f64::NAN, 0.0);

/// An image at growing blur, and the differences of neighbours.
struct Octave {
    blurred: Vec<Planes<f32>>,
    differences: Vec<Planes<f32>>,
    /// Gradients of the blurred images, computed on first use.
    gradients: Vec<RefCell<Vec<(f64, f64)>>>,
}

impl Octave {
    fn new(base: Planes<f32>) -> Self {
        let sigma = |k: usize| SIGMA * (k as f64 / INTERVALS as f64).exp2();
        let mut pictures = vec![base];
        for k in 1..INTERVALS + 3 {
            let more = (sigma(k).powi(2) - sigma(k - 1).powi(2)).sqrt();
            pictures.push(blurred(&pictures[k - 1], more));
        }
        let difference = |pair: &[Planes<f32>]| {
            let mut out = pair[1].clone();
            out.data.iter_mut().zip(&pair[0].data).for_each(|(o, v)| *o -= v);
            out
        };
        let differences = pictures.windows(2).map(difference).collect();
        let gradients = pictures.iter().map(|_| RefCell::new(Vec::new())).collect();
        Self { blurred: pictures, differences, gradients }
    }

    fn size(&self) -> (usize, usize) {
        (self.blurred[0].width, self.blurred[0].height)
    }

    /// Pixels (layer, x, y) above or below all 26 around them.
    fn extrema(&self, contrast: f64) -> Vec<[usize; 3]> {
        let (w, h) = self.size();
        let mut out = Vec::new();
        for layer in 1..=INTERVALS {
            for y in BORDER..h.saturating_sub(BORDER) {
                let row = &self.differences[layer].data[y * w..(y + 1) * w];
                for x in BORDER..w.saturating_sub(BORDER) {
                    let value = row[x];
                    if f64::from(value.abs()) < 0.5 * contrast {
                        continue;
                    }
                    let sign = value.signum();
                    // Most pixels are no extremum of their own row.
                    if sign * row[x - 1] > sign * value || sign * row[x + 1] > sign * value {
                        continue;
                    }
                    let tops = |d: &Planes<f32>| {
                        (y - 1..=y + 1).all(|v| {
                            d.data[v * w + x - 1..=v * w + x + 1].iter().all(|other| sign * other <= sign * value)
                        })
                    };
                    if self.differences[layer - 1..=layer + 1].iter().all(tops) {
                        out.push([layer, x, y]);
                    }
                }
            }
        }
        out
    }

    /// The extremum of the parabola through a pixel and those around it; `None` where it is weak, or on an edge.
    fn refine(&self, [mut layer, mut x, mut y]: [usize; 3], least: f64) -> Option<Point> {
        let (w, h) = self.size();
        for _ in 0..MOVES {
            let at = |l: isize, dx: isize, dy: isize| {
                let p = y.wrapping_add_signed(dy) * w + x.wrapping_add_signed(dx);
                f64::from(self.differences[layer.wrapping_add_signed(l)].data[p])
            };
            let value = at(0, 0, 0);
            let half = |a: f64, b: f64| 0.5 * (a - b);
            let slope =
                [half(at(0, 1, 0), at(0, -1, 0)), half(at(0, 0, 1), at(0, 0, -1)), half(at(1, 0, 0), at(-1, 0, 0))];
            let xx = at(0, 1, 0) + at(0, -1, 0) - 2.0 * value;
            let yy = at(0, 0, 1) + at(0, 0, -1) - 2.0 * value;
            let ss = at(1, 0, 0) + at(-1, 0, 0) - 2.0 * value;
            let xy = 0.25 * (at(0, 1, 1) + at(0, -1, -1) - at(0, -1, 1) - at(0, 1, -1));
            let xs = 0.25 * (at(1, 1, 0) + at(-1, -1, 0) - at(1, -1, 0) - at(-1, 1, 0));
            let ys = 0.25 * (at(1, 0, 1) + at(-1, 0, -1) - at(1, 0, -1) - at(-1, 0, 1));
            let off = solve([[xx, xy, xs], [xy, yy, ys], [xs, ys, ss]], slope.map(|s| -s))?;
            if off.iter().all(|o| o.abs() <= 0.5) {
                let contrast = (value + 0.5 * (0..3).map(|k| slope[k] * off[k]).sum::<f64>()).abs();
                let (trace, det) = (xx + yy, xx * yy - xy * xy);
                let edge = det <= 0.0 || trace * trace * EDGE >= (EDGE + 1.0).powi(2) * det;
                let scale = (layer as f64 + off[2]) / INTERVALS as f64;
                return (contrast >= least && !edge).then(|| Point {
                    x: x as f64 + off[0],
                    y: y as f64 + off[1],
                    layer,
                    sigma: SIGMA * scale.exp2(),
                    contrast,
                });
            }
            let go = |from: usize, by: f64| from.checked_add_signed(by.round().clamp(-4.0, 4.0) as isize);
            (x, y, layer) = (go(x, off[0])?, go(y, off[1])?, go(layer, off[2])?);
            let inside = |k: usize, size: usize| k >= BORDER && k + BORDER < size;
            if !inside(x, w) || !inside(y, h) || !(1..=INTERVALS).contains(&layer) {
                return None;
            }
        }
        None
    }

    /// Length and direction of the gradient at a pixel of a blurred image; nothing at its border. Those of small images are kept:
    /// descriptors of neighbouring points share most of them.
    fn gradient(&self, layer: usize, x: isize, y: isize) -> Option<(f64, f64)> {
        let (w, h) = self.size();
        let inside = x > 0 && y > 0 && x < w as isize - 1 && y < h as isize - 1;
        if w * h > KEPT {
            return self.new_gradient(layer, x, y);
        }
        if !inside {
            return None;
        }
        let mut known = self.gradients[layer].borrow_mut();
        if known.is_empty() {
            known.resize(w * h, UNKNOWN);
        }
        let kept = &mut known[y as usize * w + x as usize];
        if kept.0.is_nan() {
            *kept = self.new_gradient(layer, x, y)?;
        }
        Some(*kept)
    }

    /// [`Self::gradient`], computed.
    fn new_gradient(&self, layer: usize, x: isize, y: isize) -> Option<(f64, f64)> {
        let (w, h) = self.size();
        let inside = x > 0 && y > 0 && x < w as isize - 1 && y < h as isize - 1;
        inside.then(|| {
            let (data, p) = (&self.blurred[layer].data, y as usize * w + x as usize);
            let (dx, dy) = (f64::from(data[p + 1] - data[p - 1]), f64::from(data[p + w] - data[p - w]));
            (dx.hypot(dy), dy.atan2(dx))
        })
    }

    /// The main directions of the gradients around a point: the highest peak of their histogram, and one nearly as
    /// high.
    fn angles(&self, point: &Point) -> Vec<f64> {
        /// Bins of the histogram, spread of the weights over the point's own σ, and what is nearly as high (Lowe 2004).
        const BINS: usize = 36;
        const SPREAD: f64 = 1.5;
        const NEARLY: f64 = 0.8;
        const PEAKS: usize = 2;
        let spread = SPREAD * point.sigma;
        let reach = (3.0 * spread).round() as isize;
        let (cx, cy) = (point.x.round() as isize, point.y.round() as isize);
        let mut raw = [0.0; BINS];
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let Some((length, angle)) = self.gradient(point.layer, cx + dx, cy + dy) else { continue };
                let weight = (-((dx * dx + dy * dy) as f64) / (2.0 * spread * spread)).exp();
                let bin = (angle / TAU * BINS as f64).round().rem_euclid(BINS as f64) as usize % BINS;
                raw[bin] += weight * length;
            }
        }
        let at = |k: usize, by: usize| raw[(k + BINS + by - 2) % BINS];
        let smooth: [f64; BINS] =
            std::array::from_fn(|k| (at(k, 0) + 4.0 * at(k, 1) + 6.0 * at(k, 2) + 4.0 * at(k, 3) + at(k, 4)) / 16.0);
        let top = smooth.iter().copied().fold(0.0, f64::max);
        let sides = |k: usize| [smooth[(k + BINS - 1) % BINS], smooth[(k + 1) % BINS]];
        let mut peaks: Vec<usize> = (0..BINS)
            .filter(|&k| smooth[k] > 0.0 && smooth[k] >= NEARLY * top && sides(k).iter().all(|s| *s < smooth[k]))
            .collect();
        peaks.sort_by(|&a, &b| smooth[b].total_cmp(&smooth[a]).then(a.cmp(&b)));
        peaks.truncate(PEAKS);
        let exact = |k: usize| {
            let [left, right] = sides(k);
            k as f64 + 0.5 * (left - right) / (left + right - 2.0 * smooth[k])
        };
        peaks.into_iter().map(|k| exact(k) / BINS as f64 * TAU).collect()
    }

    /// Histograms of gradients in cells around a point, turned by `angle`.
    fn describe(&self, point: &Point, angle: f64) -> [u8; NUMBERS] {
        /// Width of a cell, of the point's σ, and no number above this share of the whole (Lowe 2004).
        const CELL: f64 = 3.0;
        const CEILING: f64 = 0.2;
        /// Bytes that the square root of a share of one is made of: no share is near one.
        const BYTES: f64 = 512.0;
        let width = CELL * point.sigma;
        let (sin, cos) = (angle.sin() / width, angle.cos() / width);
        let half = CELLS as f64 / 2.0;
        let reach = (width * std::f64::consts::SQRT_2 * (half + 0.5)).round() as isize;
        let (cx, cy) = (point.x.round() as isize, point.y.round() as isize);
        let mut sums = [0.0; NUMBERS];
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let (px, py) = ((cx + dx) as f64 - point.x, (cy + dy) as f64 - point.y);
                let (u, v) = (cos * px + sin * py, cos * py - sin * px);
                let [column, row] = [u, v].map(|k| k + half - 0.5);
                let inside = |k: f64| k > -1.0 && k < CELLS as f64;
                if !inside(column) || !inside(row) {
                    continue;
                }
                let Some((length, direction)) = self.gradient(point.layer, cx + dx, cy + dy) else { continue };
                let weight = length * (-(u * u + v * v) / (2.0 * half * half)).exp();
                let bin = ((direction - angle) / TAU).rem_euclid(1.0) * DIRECTIONS as f64;
                // Each gradient is shared among the two nearest rows, columns and directions.
                for (r, by_row) in shares(row) {
                    for (c, by_column) in shares(column) {
                        for (d, by_bin) in shares(bin) {
                            let cell = |k: isize| (0..CELLS as isize).contains(&k);
                            if cell(r) && cell(c) {
                                let d = d.rem_euclid(DIRECTIONS as isize) as usize;
                                sums[(r as usize * CELLS + c as usize) * DIRECTIONS + d] +=
                                    weight * by_row * by_column * by_bin;
                            }
                        }
                    }
                }
            }
        }
        let length = sums.iter().map(|s| s * s).sum::<f64>().sqrt().max(f64::MIN_POSITIVE);
        sums.iter_mut().for_each(|s| *s = s.min(CEILING * length));
        let whole = sums.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        sums.map(|s| (BYTES * (s / whole).sqrt()).min(255.0) as u8)
    }
}

/// The two whole numbers around `k`, and how much of it belongs to each.
fn shares(k: f64) -> [(isize, f64); 2] {
    let low = k.floor();
    [(low as isize, 1.0 - (k - low)), (low as isize + 1, k - low)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    #[test]
    fn gradients_that_are_kept_are_those_computed() {
        let mut base = Planes::<f32>::new(1, 30, 40);
        let rng = Rng::new(2, "noise", 0);
        base.data.iter_mut().enumerate().for_each(|(i, v)| *v = rng.uniform(i as u64) as f32);
        let octave = Octave::new(base);
        for _ in 0..2 {
            for (layer, y, x) in
                (1..=INTERVALS).flat_map(|l| (-1..31).flat_map(move |y| (-1..41).map(move |x| (l, y, x))))
            {
                assert_eq!(octave.gradient(layer, x, y), octave.new_gradient(layer, x, y), "{layer} {x} {y}");
            }
        }
    }

    #[test]
    fn a_limit_drops_the_weakest_features_and_keeps_the_others() {
        let mut grey = Planes::<f32>::new(1, 60, 80);
        let rng = Rng::new(1, "noise", 0);
        grey.data.iter_mut().enumerate().for_each(|(i, v)| *v = rng.uniform(i as u64) as f32);
        let grey = blurred(&grey, 1.5);
        let of = |most: usize| {
            let found = find(&grey, Limits { contrast: 0.002, most }, &|_, _| true);
            found.into_iter().map(|f| (f.pixel, f.contrast, f.descriptor)).collect::<Vec<_>>()
        };
        let all = of(usize::MAX);
        assert!(all.len() > 100, "{}", all.len());
        for most in [1, 7, 50, all.len() - 1] {
            assert!(of(most) == all[..most], "{most}");
        }
    }
}
