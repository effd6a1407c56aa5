//! Corners that are followed from frame to frame (Lucas and Kanade 1981, Shi and Tomasi 1994, Bouguet 2001).

use super::grey::{Grey, Pyramid};
use rayon::prelude::*;
use splat4d_train::capture::Rgb8;

/// Pixels between corners that are followed.
pub(crate) const APART: f64 = 8.0;
/// Images are halved until they have no more pixels: 640x360 is used in full, and a film's images at half size.
pub(crate) const PIXELS: usize = 700_000;
/// Sizes of an image: motion of up to `RADIUS · 2^(LEVELS − 1)` pixels is followed.
pub(crate) const LEVELS: usize = 4;
/// Half the side of the window that is followed, pixels.
const RADIUS: usize = 6;
/// Steps of Newton's method at a level, and the one that is small enough, pixels.
const STEPS: usize = 20;
const SMALL_STEP: f64 = 0.01;
/// A corner is tracked forward and backward; it is lost where it returns farther than this from where it was, pixels.
const ROUND_TRIP: f64 = 0.7;
/// The least eigenvalue of a corner's gradient matrix (mean over its window, of values from 0 to 1): a step of a
/// twentieth across the window.
const LEAST_EIGENVALUE: f64 = 2e-5;
/// And relative to the strongest corner's.
const QUALITY: f64 = 0.01;
/// The largest mean absolute difference between a window and where it went, of 1: more, and something else is there.
const LARGEST_CHANGE: f64 = 0.08;

/// The image at the size at which corners are followed, and how many of its own pixels are one of that across.
pub fn small(picture: Rgb8) -> (Rgb8, f64) {
    let (mut out, mut factor) = (picture, 1.0);
    while out.width * out.height > PIXELS {
        let (width, height) = (out.width / 2, out.height / 2);
        let mut data = Vec::with_capacity(3 * width * height);
        for y in 0..height {
            for x in 0..width {
                for c in 0..3 {
                    let at =
                        |dx: usize, dy: usize| u16::from(out.data[3 * ((2 * y + dy) * out.width + 2 * x + dx) + c]);
                    data.push(((at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1) + 2) / 4) as u8);
                }
            }
        }
        out = Rgb8 { width, height, data };
        factor *= 2.0;
    }
    (out, factor)
}

/// A point that was followed: seconds and pixel positions (the first pixel's centre is at (0.5, 0.5)), in the order of
/// time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Track {
    /// Time and position, frame by frame without gaps.
    pub samples: Vec<(f64, [f64; 2])>,
}

impl Track {
    /// Position at a time between its first and last: on the line between two frames.
    #[cfg(test)]
    pub(crate) fn at(&self, time: f64) -> Option<[f64; 2]> {
        let after = self.samples.partition_point(|s| s.0 < time);
        let (t1, b) = *self.samples.get(after)?;
        if t1 == time {
            return Some(b);
        }
        let (t0, a) = *self.samples.get(after.checked_sub(1)?)?;
        let part = (time - t0) / (t1 - t0);
        Some([a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1])])
    }

    /// Position at a time, smoothed by a cubic B-spline over four frames; None within a frame of its ends.
    ///
    /// A line between two noisy positions is less noisy half way than at either end, so that lags would be biased to
    /// half frames (on a real rig half of the pairs were); the weights of a cubic B-spline have nearly the same sum of
    /// squares everywhere (0.50 to 0.46), and blur the motion by the same third of a squared frame.
    pub(crate) fn smooth(&self, time: f64) -> Option<[f64; 2]> {
        let after = self.samples.partition_point(|s| s.0 <= time);
        let first = after.checked_sub(2)?;
        let four = self.samples.get(first..first + 4).or_else(|| {
            // At the very time of the last sample but one, the fourth weight is 0.
            (after + 1 == self.samples.len() && self.samples[after - 1].0 == time).then(|| &self.samples[first..])
        })?;
        let interval = four[2].0 - four[1].0;
        let mut part = (time - four[1].0) / interval;
        let blend = |part: f64| {
            let mut sum = [0.0; 3];
            for ((t, [x, y]), w) in four.iter().zip(b_spline(part)) {
                sum = [sum[0] + w * t, sum[1] + w * x, sum[2] + w * y];
            }
            sum
        };
        // Where frames are not evenly spaced, the blend is of another time.
        if four.len() == 4 {
            part = (part + (time - blend(part)[0]) / interval).clamp(0.0, 1.0);
        }
        let [_, x, y] = blend(part);
        Some([x, y])
    }

    /// The pixels between its positions farthest from each other along an axis: how much it moved at least.
    pub(crate) fn extent(&self) -> f64 {
        let side = |k: usize| {
            let of = self.samples.iter().map(|s| s.1[k]);
            of.clone().fold(f64::NEG_INFINITY, f64::max) - of.fold(f64::INFINITY, f64::min)
        };
        if self.samples.is_empty() { 0.0 } else { side(0).max(side(1)) }
    }
}

/// Weights of the samples −1, 0, 1 and 2 at a fraction between samples 0 and 1.
fn b_spline(u: f64) -> [f64; 4] {
    let v = 1.0 - u;
    let (u2, v2) = (u * u, v * v);
    let inner = |x: f64, x2: f64| (3.0 * x2 * x - 6.0 * x2 + 4.0) / 6.0;
    [v2 * v / 6.0, inner(u, u2), inner(v, v2), u2 * u / 6.0]
}

/// The corners of an image where `wanted` allows, the strongest first, at least `apart` pixels from each other and from
/// `taken` ones.
pub(crate) fn corners(
    picture: &Grey,
    wanted: Option<&[bool]>,
    most: usize,
    apart: f64,
    taken: &[[f64; 2]],
) -> Vec<[f64; 2]> {
    let (width, height) = (picture.width, picture.height);
    let margin = RADIUS + 1;
    if width <= 2 * margin || height <= 2 * margin {
        return Vec::new();
    }
    let strength = eigenvalues(picture);
    let inside = |i: &usize| {
        let (x, y) = (i % width, i / width);
        (margin..width - margin).contains(&x)
            && (margin..height - margin).contains(&y)
            && wanted.is_none_or(|w| w[*i])
            // A local maximum; of equal ones the first.
            && [i - width - 1, i - width, i - width + 1, i - 1].iter().all(|&j| strength[j] < strength[*i])
            && [i + 1, i + width - 1, i + width, i + width + 1].iter().all(|&j| strength[j] <= strength[*i])
    };
    let mut found: Vec<usize> = (0..width * height).filter(inside).collect();
    found.sort_by(|&i, &j| strength[j].total_cmp(&strength[i]).then(i.cmp(&j)));
    let least = found.first().map_or(0.0, |&i| strength[i] * QUALITY).max(LEAST_EIGENVALUE);
    let mut out: Vec<[f64; 2]> = Vec::new();
    for i in found.into_iter().take_while(|&i| strength[i] >= least) {
        let place = [(i % width) as f64 + 0.5, (i / width) as f64 + 0.5];
        let free = |p: &[f64; 2]| (p[0] - place[0]).hypot(p[1] - place[1]) >= apart;
        if out.len() < most && out.iter().all(free) && taken.iter().all(free) {
            out.push(place);
        }
    }
    out
}

/// The smaller eigenvalue of the mean of the gradients' products over a window, for every pixel.
fn eigenvalues(picture: &Grey) -> Vec<f64> {
    /// Half the side of the window that makes a corner, pixels.
    const WINDOW: usize = 2;
    let (width, height) = (picture.width, picture.height);
    let mut products = vec![[0.0f64; 3]; width * height];
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let p = y * width + x;
            let [u, v] = [(p + 1, p - 1), (p + width, p - width)]
                .map(|(a, b)| 0.5 * f64::from(picture.data[a] - picture.data[b]));
            products[p] = [u * u, u * v, v * v];
        }
    }
    let mut out = vec![0.0; width * height];
    let scale = 1.0 / ((2 * WINDOW + 1) * (2 * WINDOW + 1)) as f64;
    for y in WINDOW..height - WINDOW {
        for x in WINDOW..width - WINDOW {
            let mut sum = [0.0; 3];
            for row in y - WINDOW..=y + WINDOW {
                for product in &products[row * width + x - WINDOW..=row * width + x + WINDOW] {
                    (0..3).for_each(|k| sum[k] += product[k]);
                }
            }
            out[y * width + x] = smaller_eigenvalue(sum.map(|s| s * scale));
        }
    }
    out
}

fn smaller_eigenvalue([xx, xy, yy]: [f64; 3]) -> f64 {
    0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt()
}

/// Positions of points of image a in image b; None where they are lost: they left, nothing there is like them, or they
/// do not return to the start when tracked backwards.
pub fn follow(a: &Pyramid, b: &Pyramid, points: &[[f64; 2]]) -> Vec<Option<[f64; 2]>> {
    let both = |&p: &[f64; 2]| {
        let there = step(a, b, p)?;
        let back = step(b, a, there)?;
        ((back[0] - p[0]).hypot(back[1] - p[1]) < ROUND_TRIP).then_some(there)
    };
    points.par_iter().map(both).collect()
}

/// Follows a point one way, from coarse to fine.
fn step(a: &Pyramid, b: &Pyramid, point: [f64; 2]) -> Option<[f64; 2]> {
    let top = a.levels.len().min(b.levels.len());
    let mut moved = [0.0; 2];
    for level in (0..top).rev() {
        let scale = 1.0 / (1 << level) as f64;
        moved = at_level(&a.levels[level], &b.levels[level], point.map(|p| p * scale), moved, level == 0)?;
        if level > 0 {
            moved = moved.map(|d| 2.0 * d);
        }
    }
    let out = [point[0] + moved[0], point[1] + moved[1]];
    let (width, height) = (b.levels[0].width as f64, b.levels[0].height as f64);
    ((0.0..width).contains(&out[0]) && (0.0..height).contains(&out[1])).then_some(out)
}

/// The motion of a window at one size, by Newton's method on the squared difference; windows' means are taken off, so
/// that light may change. None: no corner, or at the finest size something else.
fn at_level(a: &Grey, b: &Grey, [x, y]: [f64; 2], mut moved: [f64; 2], finest: bool) -> Option<[f64; 2]> {
    const SIDE: usize = 2 * RADIUS + 1;
    const COUNT: f64 = (SIDE * SIDE) as f64;
    let r = RADIUS as f64;
    let mut window = [0.0f64; SIDE * SIDE];
    let mut slopes = [[0.0f64; 2]; SIDE * SIDE];
    let mut matrix = [0.0; 3];
    for (k, value) in window.iter_mut().enumerate() {
        let (u, v) = (x + (k % SIDE) as f64 - r, y + (k / SIDE) as f64 - r);
        *value = f64::from(a.sample(u, v));
        let slope = [
            0.5 * f64::from(a.sample(u + 1.0, v) - a.sample(u - 1.0, v)),
            0.5 * f64::from(a.sample(u, v + 1.0) - a.sample(u, v - 1.0)),
        ];
        slopes[k] = slope;
        matrix = [matrix[0] + slope[0] * slope[0], matrix[1] + slope[0] * slope[1], matrix[2] + slope[1] * slope[1]];
    }
    let mean = window.iter().sum::<f64>() / COUNT;
    window.iter_mut().for_each(|v| *v -= mean);
    if smaller_eigenvalue(matrix.map(|m| m / COUNT)) < LEAST_EIGENVALUE {
        // Small images may have lost the corner: the next size will find it.
        return if finest { None } else { Some(moved) };
    }
    let determinant = matrix[0] * matrix[2] - matrix[1] * matrix[1];
    let mut there = [0.0f64; SIDE * SIDE];
    for _ in 0..STEPS {
        let mut mean = 0.0;
        for (k, value) in there.iter_mut().enumerate() {
            let (u, v) = (x + (k % SIDE) as f64 - r, y + (k / SIDE) as f64 - r);
            *value = f64::from(b.sample(u + moved[0], v + moved[1]));
            mean += *value / COUNT;
        }
        let mut right = [0.0; 2];
        for k in 0..SIDE * SIDE {
            let off = window[k] - (there[k] - mean);
            right = [right[0] + off * slopes[k][0], right[1] + off * slopes[k][1]];
        }
        let d = [
            (matrix[2] * right[0] - matrix[1] * right[1]) / determinant,
            (matrix[0] * right[1] - matrix[1] * right[0]) / determinant,
        ];
        moved = [moved[0] + d[0], moved[1] + d[1]];
        if d[0].hypot(d[1]) < SMALL_STEP {
            break;
        }
        if !(moved[0].abs() < a.width as f64 && moved[1].abs() < a.height as f64) {
            return None;
        }
    }
    if finest {
        let mean = there.iter().sum::<f64>() / COUNT;
        let change = (0..SIDE * SIDE).map(|k| (window[k] - (there[k] - mean)).abs()).sum::<f64>() / COUNT;
        if change > LARGEST_CHANGE {
            return None;
        }
    }
    Some(moved)
}

/// Follows corners through a camera's frames; where some are lost, new ones are detected.
pub(crate) struct Tracker {
    most: usize,
    apart: f64,
    last: Option<(f64, Pyramid)>,
    live: Vec<Track>,
    done: Vec<Track>,
}

impl Tracker {
    /// For at most `most` corners at a time, `apart` pixels from each other.
    pub(crate) fn new(most: usize, apart: f64) -> Self {
        Self { most, apart, last: None, live: Vec::new(), done: Vec::new() }
    }

    /// Takes the next frame; new corners only where `wanted` allows.
    pub(crate) fn push(&mut self, time: f64, picture: Grey, wanted: Option<&[bool]>) {
        let pyramid = Pyramid::new(picture, LEVELS);
        if let Some((_, last)) = &self.last {
            let ends: Vec<[f64; 2]> = self.live.iter().map(|t| t.samples[t.samples.len() - 1].1).collect();
            let found = follow(last, &pyramid, &ends);
            for (mut track, place) in std::mem::take(&mut self.live).into_iter().zip(found) {
                match place {
                    Some(place) => {
                        track.samples.push((time, place));
                        self.live.push(track);
                    }
                    None => self.end(track),
                }
            }
        }
        let taken: Vec<[f64; 2]> = self.live.iter().map(|t| t.samples[t.samples.len() - 1].1).collect();
        if taken.len() < self.most {
            let new = corners(&pyramid.levels[0], wanted, self.most - taken.len(), self.apart, &taken);
            self.live.extend(new.into_iter().map(|p| Track { samples: vec![(time, p)] }));
        }
        self.last = Some((time, pyramid));
    }

    fn end(&mut self, track: Track) {
        /// Frames that a corner must last: fewer carry little information about its motion, and mostly noise.
        const SHORTEST: usize = 4;
        if track.samples.len() >= SHORTEST {
            self.done.push(track);
        }
    }

    /// All tracks, those that ended first first.
    pub(crate) fn finish(mut self) -> Vec<Track> {
        std::mem::take(&mut self.live).into_iter().for_each(|t| self.end(t));
        self.done
    }
}

/// The pixels of an image that differ from the `still` one by more than noise: where something moves.
pub(crate) fn moving(picture: &Grey, still: &Grey) -> Vec<bool> {
    /// Differences above this, of 1, are no noise of ordinary cameras.
    const MOVED: f32 = 0.05;
    picture.data.iter().zip(&still.data).map(|(a, b)| (a - b).abs() > MOVED).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    /// A texture of random spots, moved.
    fn picture(shift: [f64; 2], light: f32) -> Grey {
        let (width, height) = (96, 80);
        let mut data = vec![0.5; width * height];
        for k in 0..220 {
            let rng = Rng::new(4, "spots", k);
            let (u, v) = (136.0 * rng.uniform(0) - 20.0 + shift[0], 120.0 * rng.uniform(1) - 20.0 + shift[1]);
            let (size, height) = (2.0 + 2.0 * rng.uniform(2), 0.3 * (rng.uniform(3) - 0.5));
            for (i, value) in data.iter_mut().enumerate() {
                let (x, y) = ((i % width) as f64 - u, (i / width) as f64 - v);
                *value += (height * (-0.5 * (x * x + y * y) / (size * size)).exp()) as f32;
            }
        }
        data.iter_mut().for_each(|v| *v *= light);
        Grey { width, height, data }
    }

    #[test]
    fn corners_are_tracked_to_sub_pixel_accuracy() {
        let still = picture([0.0; 2], 1.0);
        let found = corners(&still, None, 40, 6.0, &[]);
        assert!(found.len() >= 15, "{}", found.len());
        for (shift, light) in [([0.4, -0.3], 1.0), ([3.7, 2.2], 1.0), ([-11.3, 7.6], 1.05)] {
            let [a, b] = [still.clone(), picture(shift, light)].map(|p| Pyramid::new(p, LEVELS));
            let moved = follow(&a, &b, &found);
            let inside =
                |p: &[f64; 2]| (16.0..80.0).contains(&(p[0] + shift[0])) && (16.0..64.0).contains(&(p[1] + shift[1]));
            let both: Vec<_> = found.iter().zip(&moved).filter(|(p, _)| inside(p)).collect();
            let kept: Vec<_> = both.iter().filter_map(|(p, m)| m.map(|m| (p, m))).collect();
            // Some cannot be distinguished from their neighbours in small images when they move far.
            assert!(kept.len() * 2 >= both.len(), "{shift:?}: {} of {}", kept.len(), both.len());
            for (p, m) in kept {
                let off = (m[0] - p[0] - shift[0]).hypot(m[1] - p[1] - shift[1]);
                assert!(off < 0.1, "{shift:?}: {off} at {p:?}");
            }
        }
    }

    #[test]
    fn corners_are_in_the_requested_region_and_apart() {
        let still = picture([0.0; 2], 1.0);
        let left: Vec<bool> = (0..still.data.len()).map(|i| i % still.width < 48).collect();
        let found = corners(&still, Some(&left), 100, 9.0, &[[20.0, 20.0]]);
        assert!(!found.is_empty() && found.iter().all(|p| p[0] < 48.5));
        for (i, p) in found.iter().enumerate() {
            assert!(found[..i].iter().chain(&[[20.0, 20.0]]).all(|q| (p[0] - q[0]).hypot(p[1] - q[1]) >= 9.0));
        }
        let flat = Grey { data: vec![0.5; still.data.len()], ..still.clone() };
        assert!(corners(&flat, None, 100, 5.0, &[]).is_empty());
    }

    #[test]
    fn vanished_corners_are_lost() {
        let still = picture([0.0; 2], 1.0);
        let found = corners(&still, None, 20, 8.0, &[]);
        let mut other = still.clone();
        other.data.iter_mut().enumerate().for_each(|(i, v)| *v = 0.5 + 0.3 * ((i * i) as f32 * 0.013).sin());
        let [a, b] = [still, other].map(|p| Pyramid::new(p, LEVELS));
        let kept = follow(&a, &b, &found).iter().flatten().count();
        assert!(kept * 4 <= found.len(), "{kept} of {}", found.len());
    }

    #[test]
    fn tracks_persist_and_interpolate_between_frames() {
        let mut tracker = Tracker::new(30, 6.0);
        for k in 0..6 {
            let t = f64::from(k);
            tracker.push(0.1 * t, picture([1.5 * t, -0.8 * t], 1.0), None);
        }
        let tracks = tracker.finish();
        assert!(tracks.len() >= 10);
        let long = tracks.iter().find(|t| t.samples.len() == 6).unwrap();
        let (a, b) = (long.samples[2].1, long.at(0.25).unwrap());
        assert!((b[0] - a[0] - 0.75).abs() < 0.1 && (b[1] - a[1] + 0.4).abs() < 0.1);
        let smooth = long.smooth(0.25).unwrap();
        assert!((smooth[0] - b[0]).hypot(smooth[1] - b[1]) < 0.05, "even motion is not bent");
        assert!(long.smooth(0.1).is_some() && long.smooth(0.4).is_some());
        assert_eq!((long.smooth(0.05), long.smooth(0.45)), (None, None));
        assert_eq!((long.at(-0.1), long.at(0.6)), (None, None));
        assert!((long.extent() - 7.5).abs() < 0.3);
    }
}
