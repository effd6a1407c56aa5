//! Points on surfaces, by plane sweep: a window of one image is laid at many depths and compared with its neighbours
//! there (normalised cross-correlation; Collins 1996).
//!
//! Not every pixel: the window with the strongest texture of every cell of a lattice, so that points are spread evenly
//! in images and the work follows from how many are needed. The window is tilted at the best depth (floors and walls
//! are rarely seen from in front), and neighbours must find the same depth by themselves.

use super::triangulate::{Transfer, angle_at};
use super::view::{View, spread};
use rayon::prelude::*;
use splat4d::math::se3::{norm, sub};

/// A point found by sweeping.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Swept {
    /// In the world.
    pub point: [f64; 3],
    /// Colour of the pixel where it was searched for, in [0, 1].
    pub color: [f32; 3],
}

/// Half the window: it has 7 x 7 pixels.
const HALF: usize = 3;
const SIDE: usize = 2 * HALF + 1;
const WINDOW: usize = SIDE * SIDE;
/// Neighbours that an image is compared with, at most.
const NEIGHBOURS: usize = 4;
/// A window whose grey values spread less than this (standard deviation, in [0, 1]) is uniform.
const TEXTURE: f32 = 0.012;
/// Least correlation of a window after tilting, and of one that is tilted.
const ALIKE: f32 = 0.8;
const HOPEFUL: f32 = 0.6;
/// 1 - correlation at the best depth must be this much less than anywhere else.
const UNIQUE: f32 = 0.8;
/// Depths this close to the best one, in steps, are the same peak.
const SAME_PEAK: usize = 3;
/// Neighbours that must find the same depth, where there are more of them; of fewer, one.
const CONFIRMED: usize = 2;
/// Steps in inverse depth by which two images may differ on a point.
const AGREE: f64 = 1.5;
/// Least and largest number of depths; between them, each moves the window by a pixel in the neighbour where it moves
/// most.
const DEPTHS: std::ops::RangeInclusive<usize> = 16..=256;
/// Windows tried per requested point: about this few succeed.
const TRIES: f64 = 3.0;
/// Cells of the lattice are not smaller than this, pixels.
const CELL: f64 = 3.0;
/// First tilt that is tried (depth by width), times that it is halved.
const TILT: f64 = 1.0;
const HALVINGS: usize = 4;
/// Rounds of moves before they are halved.
const ROUNDS: usize = 2;
/// Points that a camera must see before they determine the range of depths.
const ENOUGH: usize = 12;
/// Of the points that a camera sees, the share of outliers at either end.
const STRAY: f64 = 0.02;
/// Surfaces may be nearer than the points, by this factor.
const BEYOND: f64 = 1.6;
/// Without points: nearest depth, of the distance to the nearest neighbour.
const UNKNOWN: f64 = 1.0;
/// Steps in inverse depth for what cannot be distinguished from the horizon.
const FAR: f64 = 0.5;
/// The angle between cameras, degrees, at which depth is measured best, and how fast that falls to either side
/// (as Yao et al. 2018 choose views; wider above because rigs have few cameras).
const BEST_ANGLE: f64 = 8.0;
const ANGLE_SPREAD: [f64; 2] = [4.0, 16.0];
/// Angles at which windows cannot be compared, degrees.
const ANGLES: std::ops::RangeInclusive<f64> = 1.0..=45.0;

/// A view, its neighbours, and the depths that are examined.
struct Reference<'a> {
    view: &'a View,
    others: Vec<Other<'a>>,
    /// Inverse depths are multiples of this, from 0 on: the farthest background is at no depth that can be measured.
    step: f64,
    depths: usize,
}

struct Other<'a> {
    number: usize,
    view: &'a View,
    transfer: Transfer,
}

/// A window of an image, of mean 0 and length 1, and its middle pixel.
struct Window {
    values: [f32; WINDOW],
    x: usize,
    y: usize,
}

/// A position in depth: inverse depth, and by how much of itself it changes from pixel to pixel.
#[derive(Clone, Copy)]
struct Patch {
    inverse: f64,
    tilt: [f64; 2],
}

/// At most `count` points, in the order of views. `known`: points that determine the depths, and which views are
/// neighbours.
pub(crate) fn sweep(views: &[View], known: &[[f64; 3]], count: usize) -> Vec<Swept> {
    let references: Vec<Option<Reference<'_>>> =
        (0..views.len()).into_par_iter().map(|a| Reference::new(views, a, known)).collect();
    let wanted: usize = views.iter().map(|v| v.wanted.iter().filter(|w| **w).count()).sum();
    let cell = (wanted as f64 / (TRIES * count.max(1) as f64)).sqrt().max(CELL);
    let tasks: Vec<(usize, Window)> = (0..views.len())
        .into_par_iter()
        .filter(|&a| references[a].is_some())
        .flat_map_iter(|a| windows(&views[a], cell).into_iter().map(move |w| (a, w)))
        .collect();
    let found: Vec<Swept> = tasks
        .into_par_iter()
        .filter_map(|(a, window)| {
            let reference = references[a].as_ref()?;
            let patch = reference.find(&window)?;
            let pixel = window.pixel();
            let agrees = |other: &Other<'_>| {
                let there = references[other.number].as_ref();
                there.is_some_and(|there| there.confirms(reference, pixel, patch.inverse))
            };
            let needed = if reference.others.len() > CONFIRMED { CONFIRMED } else { 1 };
            if reference.others.iter().filter(|other| agrees(other)).take(needed).count() < needed {
                return None;
            }
            let point = reference.view.camera.unproject(pixel, 1.0 / patch.inverse);
            Some(Swept { point, color: reference.view.color(pixel) })
        })
        .collect();
    // Every n-th of a lattice, row by row, is spread evenly too.
    spread(found.len(), count).map(|k| found[k]).collect()
}

impl Window {
    /// `None` where it reaches over the border or has no texture.
    fn new(view: &View, x: usize, y: usize) -> Option<Self> {
        let (w, h) = (view.grey.width, view.grey.height);
        if x < HALF || y < HALF || x + HALF >= w || y + HALF >= h {
            return None;
        }
        let mut values = [0.0; WINDOW];
        for (row, out) in values.chunks_exact_mut(SIDE).enumerate() {
            let from = (y + row - HALF) * w + x - HALF;
            out.copy_from_slice(&view.grey.data[from..from + SIDE]);
        }
        let length = normalise(&mut values);
        (length > TEXTURE * (WINDOW as f32).sqrt()).then_some(Self { values, x, y })
    }

    fn pixel(&self) -> [f64; 2] {
        [self.x as f64 + 0.5, self.y as f64 + 0.5]
    }
}

/// Takes the mean away and divides by the length, which it returns.
fn normalise(values: &mut [f32; WINDOW]) -> f32 {
    let mean = values.iter().sum::<f32>() / WINDOW as f32;
    values.iter_mut().for_each(|v| *v -= mean);
    let length = values.iter().map(|v| v * v).sum::<f32>().sqrt();
    values.iter_mut().for_each(|v| *v /= length.max(f32::MIN_POSITIVE));
    length
}

/// The window with the strongest texture of every cell of a lattice.
fn windows(view: &View, cell: f64) -> Vec<Window> {
    let (w, h) = (view.grey.width, view.grey.height);
    let (columns, rows) = ((w as f64 / cell) as usize, (h as f64 / cell) as usize);
    let edge = |k: usize| (k as f64 * cell) as usize;
    let strength = |x: usize, y: usize| {
        let at = |x: usize, y: usize| view.grey.data[y * w + x];
        (at(x + 1, y) - at(x - 1, y)).abs() + (at(x, y + 1) - at(x, y - 1)).abs()
    };
    let mut out = Vec::new();
    for row in 0..rows {
        for column in 0..columns {
            let mut best: Option<(f32, usize, usize)> = None;
            for y in edge(row).max(HALF)..edge(row + 1).min(h - HALF) {
                for x in edge(column).max(HALF)..edge(column + 1).min(w - HALF) {
                    let s = strength(x, y);
                    if view.wants(x, y) && best.is_none_or(|b| s > b.0) {
                        best = Some((s, x, y));
                    }
                }
            }
            out.extend(best.and_then(|(_, x, y)| Window::new(view, x, y)));
        }
    }
    out
}

impl<'a> Reference<'a> {
    /// `None`: no view is its neighbour.
    fn new(views: &'a [View], a: usize, known: &[[f64; 3]]) -> Option<Self> {
        let view = &views[a];
        let sees = |v: &View, x: [f64; 3]| v.camera.project(x).filter(|(pixel, _)| v.holds(*pixel)).map(|(_, z)| z);
        let seen: Vec<([f64; 3], f64)> = known.iter().filter_map(|&x| Some((x, sees(view, x)?))).collect();
        let center = view.camera.center();
        let mut scores: Vec<(f64, usize)> = if seen.len() >= ENOUGH {
            let importance = |b: usize| {
                let other = views[b].camera.center();
                let one = |(x, _): &([f64; 3], f64)| match sees(&views[b], *x) {
                    Some(_) => angle_weight(angle_at(*x, center, other).to_degrees()),
                    None => 0.0,
                };
                seen.iter().map(one).sum::<f64>()
            };
            (0..views.len()).filter(|&b| b != a).map(|b| (importance(b), b)).filter(|s| s.0 > 0.0).collect()
        } else {
            let cameras: Vec<_> = views.iter().map(|v| &v.camera).collect();
            let near = super::matching::pairs(&cameras);
            let partners = near.iter().filter(|p| p.contains(&a)).map(|p| p[0] + p[1] - a);
            partners.map(|b| (-norm(sub(views[b].camera.center(), center)), b)).collect()
        };
        scores.sort_by(|x, y| y.0.total_cmp(&x.0).then(x.1.cmp(&y.1)));
        scores.truncate(NEIGHBOURS);
        let nearest = scores.iter().map(|&(_, b)| norm(sub(views[b].camera.center(), center)));
        let nearest = nearest.fold(f64::INFINITY, f64::min);
        let others: Vec<Other<'a>> = scores
            .into_iter()
            .map(|(_, b)| Other { number: b, view: &views[b], transfer: Transfer::new(&view.camera, &views[b].camera) })
            .collect();
        if others.is_empty() {
            return None;
        }
        let to = if seen.len() >= ENOUGH {
            let mut depths: Vec<f64> = seen.iter().map(|s| s.1).collect();
            depths.sort_by(f64::total_cmp);
            let stray = (STRAY * depths.len() as f64) as usize;
            BEYOND / depths[stray]
        } else {
            1.0 / (UNKNOWN * nearest)
        };
        let moves = others.iter().map(|o| path(view, &o.transfer, to)).fold(0.0, f64::max);
        let depths = (moves.ceil() as usize).clamp(*DEPTHS.start(), *DEPTHS.end());
        Some(Self { view, others, step: to / (depths - 1) as f64, depths })
    }

    fn inverse(&self, k: usize) -> f64 {
        self.step * k as f64
    }

    /// Depth of a window; `None` where neighbours do not agree on it, or as well elsewhere.
    fn find(&self, window: &Window) -> Option<Patch> {
        let flat = |inverse: f64| Patch { inverse, tilt: [0.0; 2] };
        let scores: Vec<f32> = (0..self.depths).map(|k| self.alike(window, flat(self.inverse(k)))).collect();
        let best = (0..self.depths).max_by(|&a, &b| scores[a].total_cmp(&scores[b]).then(b.cmp(&a)))?;
        if scores[best] < HOPEFUL || best + 1 == self.depths {
            return None;
        }
        // Only other peaks are rivals: a broad one is still one.
        let peak = |&k: &usize| {
            let left = k.checked_sub(1).map_or(f32::MIN, |k| scores[k]);
            let right = scores.get(k + 1).copied().unwrap_or(f32::MIN);
            k.abs_diff(best) > SAME_PEAK && scores[k] >= left && scores[k] >= right
        };
        let second = (0..self.depths).filter(peak).map(|k| scores[k]).fold(-1.0, f32::max);
        if 1.0 - scores[best] > UNIQUE * (1.0 - second) {
            return None;
        }
        // On both sides of infinity there is only one.
        let (left, right) = (f64::from(scores[best.abs_diff(1)]), f64::from(scores[best + 1]));
        let bend = left + right - 2.0 * f64::from(scores[best]);
        let off = if bend < 0.0 { (0.5 * (left - right) / bend).clamp(-0.5, 0.5) } else { 0.0 };
        self.tilted(window, flat(self.inverse(best) + off * self.step))
    }

    /// The best tilt and depth around a patch, by steps that are halved.
    fn tilted(&self, window: &Window, start: Patch) -> Option<Patch> {
        /// One step of depth or of a tilt, to either side.
        const MOVES: [[f64; 3]; 6] =
            [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]];
        let focal = self.view.camera.intrinsics.fx;
        let mut best = (start, self.alike(window, start));
        let mut size = 1.0;
        for _ in 0..HALVINGS {
            for _ in 0..ROUNDS {
                let from = best.0;
                for m in MOVES {
                    let tilt = [m[1], m[2]].map(|t| t * size * TILT / focal);
                    let patch = Patch {
                        inverse: (from.inverse + m[0] * size * 0.5 * self.step).max(0.0),
                        tilt: [from.tilt[0] + tilt[0], from.tilt[1] + tilt[1]],
                    };
                    let score = self.alike(window, patch);
                    if score > best.1 {
                        best = (patch, score);
                    }
                }
            }
            size *= 0.5;
        }
        best.0.inverse = best.0.inverse.max(FAR * self.step);
        (best.1 >= ALIKE).then_some(best.0)
    }

    /// Whether this view alone finds the point that `other` has at a pixel and an inverse depth.
    fn confirms(&self, other: &Reference<'_>, pixel: [f64; 2], inverse: f64) -> bool {
        let point = other.view.camera.unproject(pixel, 1.0 / inverse);
        let Some((here, z)) = self.view.camera.project(point).filter(|(p, _)| self.view.holds(*p)) else {
            return false;
        };
        let window = Window::new(self.view, here[0] as usize, here[1] as usize);
        let found = window.and_then(|w| self.find(&w));
        found.is_some_and(|patch| (patch.inverse - 1.0 / z).abs() <= AGREE * self.step)
    }

    /// The mean correlation of the better half of the neighbours: what hides the point from the others does not matter.
    fn alike(&self, window: &Window, patch: Patch) -> f32 {
        let mut scores = [-1.0_f32; NEIGHBOURS];
        let mut count = 0;
        for other in &self.others {
            if let Some(score) = correlation(window, other, patch) {
                scores[count] = score;
                count += 1;
            }
        }
        // One neighbour alone agrees with too much.
        let needed = self.others.len().min(2);
        if count < needed {
            return -1.0;
        }
        scores[..count].sort_by(|a, b| b.total_cmp(a));
        let half = (self.others.len() / 2).max(needed);
        scores[..half.min(count)].iter().sum::<f32>() / half.min(count) as f32
    }
}

/// Correlation of a window with the neighbour's pixels that a patch takes it to; `None` outside of that image.
fn correlation(window: &Window, other: &Other<'_>, patch: Patch) -> Option<f32> {
    let Transfer { turn, shift } = &other.transfer;
    let [u, v] = window.pixel();
    let rho = patch.inverse;
    // The plane's homography around the window's middle, as its linear part: over so few pixels it bends little.
    let middle: [f64; 3] = std::array::from_fn(|k| turn[k][0] * u + turn[k][1] * v + turn[k][2] + shift[k] * rho);
    let scale = 1.0 / middle[2];
    if !(scale.is_finite() && middle[2] > 0.0) {
        return None;
    }
    let place = [middle[0] * scale, middle[1] * scale];
    let slope = |axis: usize| -> [f32; 2] {
        let d: [f64; 3] = std::array::from_fn(|k| turn[k][axis] + shift[k] * rho * patch.tilt[axis]);
        [0, 1].map(|k| ((d[k] - place[k] * d[2]) * scale) as f32)
    };
    let (across, down) = (slope(0), slope(1));
    let place = place.map(|k| k as f32 - 0.5);
    let grey = &other.view.grey;
    let (right, below) = (grey.width as f32 - 1.0, grey.height as f32 - 1.0);
    let far = HALF as f32;
    let reach = [0, 1].map(|k| far * (across[k].abs() + down[k].abs()));
    let inside = |k: usize, end: f32| place[k] >= reach[k] && place[k] + reach[k] < end;
    if !inside(0, right) || !inside(1, below) {
        return None;
    }
    let mut values = [0.0; WINDOW];
    for (row, out) in values.chunks_exact_mut(SIDE).enumerate() {
        let dy = row as f32 - far;
        for (column, out) in out.iter_mut().enumerate() {
            let dx = column as f32 - far;
            // Rounding may lead a hair over the border.
            let x = (place[0] + dx * across[0] + dy * down[0]).max(0.0);
            let y = (place[1] + dx * across[1] + dy * down[1]).max(0.0);
            let (left, top) = ((x as usize).min(grey.width - 2), (y as usize).min(grey.height - 2));
            let (fx, fy) = (x - left as f32, y - top as f32);
            let p = top * grey.width + left;
            let (a, b) = (&grey.data[p..p + 2], &grey.data[p + grey.width..p + grey.width + 2]);
            let upper = a[0] + fx * (a[1] - a[0]);
            let lower = b[0] + fx * (b[1] - b[0]);
            *out = upper + fy * (lower - upper);
        }
    }
    let length = normalise(&mut values);
    if length < 0.5 * TEXTURE * (WINDOW as f32).sqrt() {
        return Some(0.0);
    }
    Some(window.values.iter().zip(&values).map(|(a, b)| a * b).sum())
}

/// The weight of a neighbour at this angle for measuring depth.
fn angle_weight(degrees: f64) -> f64 {
    if !ANGLES.contains(&degrees) {
        return 0.0;
    }
    let spread = ANGLE_SPREAD[usize::from(degrees > BEST_ANGLE)];
    (-0.5 * ((degrees - BEST_ANGLE) / spread).powi(2)).exp()
}

/// Pixels that the middle of an image moves over in a neighbour between infinity and an inverse depth.
fn path(view: &View, transfer: &Transfer, to: f64) -> f64 {
    /// Segments of the path: it is nearly straight, at a varying speed.
    const PIECES: usize = 8;
    let middle = [0.5 * view.camera.width as f64, 0.5 * view.camera.height as f64];
    let places: Vec<[f64; 2]> =
        (0..=PIECES).filter_map(|k| transfer.at(middle, to * k as f64 / PIECES as f64)).collect();
    places.windows(2).map(|p| (p[1][0] - p[0][0]).hypot(p[1][1] - p[0][1])).sum()
}
