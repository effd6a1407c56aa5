//! Lags by how much moves: a guess for other evidence to begin with. Two cameras see the same jump at the same time,
//! but the same step of a runner again and again.

use super::grey::Grey;
use super::{Refusal, fft::correlate, median, parabola};
use splat4d_train::capture::Rgb8;

/// Pixels of the longer side that motion is measured at.
const SIDE: usize = 160;
/// The least change from frame to frame that is motion, of 1: sensors' noise in means of many pixels is below it.
const MOVES: f64 = 0.15 / 255.0;
/// Cameras share at least this part of the shorter take.
const MIN_OVERLAP: f64 = 0.4;
/// And at least this many intervals.
const MIN_INTERVALS: usize = 12;
/// The least correlation that is believed. Of one motion from different sides 0.4 to 0.9 was measured on rendered rigs.
const LEAST: f64 = 0.3;
/// The least standard score: the correlation times the root of the number of intervals compared.
const LEAST_SCORE: f64 = 4.5;
/// From this part of the best correlation on another one is as good.
const AS_GOOD: f64 = 0.7;
/// Intervals around the best lag that belong to it.
const LOBE: usize = 4;

/// How much moved when.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Motion {
    /// Seconds on the camera's clock: the middles between frames.
    times: Vec<f64>,
    /// Mean absolute change of grey a median interval.
    values: Vec<f64>,
    last: Option<(f64, Grey)>,
}

/// A lag that motion suggests.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct MotionLag {
    /// Seconds that the second camera is late.
    pub seconds: f64,
    /// About how far off it may be, seconds: two intervals, as cameras at right angles to each other were.
    pub sigma: f64,
    /// The correlation there, and the best one elsewhere.
    pub correlation: [f64; 2],
}

impl Motion {
    /// Takes the next frame.
    pub(crate) fn push(&mut self, time: f64, picture: &Rgb8) {
        let grey = Grey::of(picture);
        let small = grey.reduced((grey.width.max(grey.height) / SIDE).max(1));
        if let Some((before, last)) = &self.last
            && last.data.len() == small.data.len()
            && time > *before
        {
            let change: f64 = small.data.iter().zip(&last.data).map(|(a, b)| f64::from((a - b).abs())).sum();
            self.times.push(0.5 * (before + time));
            // Where frames are missing, more has changed.
            self.values.push(change / small.data.len() as f64 / (time - before));
        }
        self.last = Some((time, small));
    }

    /// The median interval, seconds.
    fn interval(&self) -> f64 {
        median(&mut self.times.windows(2).map(|w| w[1] - w[0]).collect::<Vec<_>>())
    }

    /// Its changes at even intervals, from its first time on: filtered, and how they change again; zero mean.
    fn changes(&self, interval: f64) -> Vec<f64> {
        let (first, last) = (self.times[0], self.times[self.times.len() - 1]);
        let count = ((last - first) / interval).floor() as usize + 1;
        let mut after = 1;
        let mut even = Vec::with_capacity(count);
        for k in 0..count {
            let t = first + interval * k as f64;
            while after + 1 < self.times.len() && self.times[after] < t {
                after += 1;
            }
            let (t0, t1) = (self.times[after - 1], self.times[after]);
            let part = ((t - t0) / (t1 - t0)).clamp(0.0, 1.0);
            even.push(self.values[after - 1] + part * (self.values[after] - self.values[after - 1]));
        }
        // A doubled frame, or a flash, is a single value.
        let middle = |k: usize| median(&mut [even[k.saturating_sub(1)], even[k], even[(k + 1).min(count - 1)]]);
        let smooth: Vec<f64> = (0..count).map(middle).collect();
        let mut out: Vec<f64> = smooth.windows(2).map(|w| w[1] - w[0]).collect();
        let mean = out.iter().sum::<f64>() / out.len().max(1) as f64;
        out.iter_mut().for_each(|v| *v -= mean);
        out
    }
}

/// How much later b notes what a notes, at most `most` seconds either way, if given.
pub(crate) fn lag(a: &Motion, b: &Motion, most: Option<f64>) -> Result<MotionLag, Refusal> {
    if a.times.len() < MIN_INTERVALS || b.times.len() < MIN_INTERVALS {
        return Err(Refusal::Short("the take"));
    }
    let interval = a.interval().min(b.interval());
    for m in [a, b] {
        let mean = m.values.iter().sum::<f64>() / m.values.len() as f64 * m.interval();
        if mean < MOVES {
            return Err(Refusal::Still);
        }
    }
    let (x, y) = (a.changes(interval), b.changes(interval));
    let shorter = x.len().min(y.len()) as f64;
    let sums = correlate(&x, &y);
    let (n, m) = (x.len() as isize, y.len() as isize);
    // The lag of the first times comes on top of that of the lists.
    let first = b.times[0] - a.times[0];
    let square = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>();
    let at = |i: usize| {
        let shift = i as isize - (n - 1);
        let (begin, end) = ((-shift).max(0), (m - shift).min(n));
        let overlap = (end - begin) as f64;
        let too_far = most.is_some_and(|w| (shift as f64 * interval + first).abs() > w);
        if overlap < (MIN_OVERLAP * shorter).max(MIN_INTERVALS as f64 - 1.0) || too_far {
            return (f64::NEG_INFINITY, 0.0);
        }
        let of_x = square(&x[begin as usize..end as usize]);
        let of_y = square(&y[(begin + shift) as usize..(end + shift) as usize]);
        let power = (of_x * of_y).sqrt();
        (if power > 0.0 { sums[i] / power } else { 0.0 }, overlap)
    };
    let found: Vec<(f64, f64)> = (0..sums.len()).map(at).collect();
    // What overlaps longer counts for more: short overlaps correlate by chance.
    let score = |i: usize| found[i].0 * found[i].1.sqrt();
    let best = (0..found.len()).filter(|&i| found[i].0.is_finite()).max_by(|&i, &j| score(i).total_cmp(&score(j)));
    let Some(best) = best else { return Err(Refusal::Short("the take")) };
    let value = |i: usize| found.get(i).map_or(f64::NEG_INFINITY, |f| f.0);
    let other = (0..found.len())
        .filter(|i| i.abs_diff(best) > LOBE && found[*i].0.is_finite())
        .max_by(|&i, &j| score(i).total_cmp(&score(j)));
    if value(best) < LEAST || score(best) < LEAST_SCORE {
        return Err(Refusal::Unrelated);
    }
    let near = [value(best.wrapping_sub(1)), value(best), value(best + 1)];
    let part = if near.iter().all(|v| v.is_finite()) { parabola(near).0 } else { 0.0 };
    let seconds = |i: usize, part: f64| (i as f64 - (n - 1) as f64 + part) * interval + first;
    if let Some(other) = other.filter(|&o| score(o) > AS_GOOD * score(best)) {
        return Err(Refusal::Repeating([seconds(best, part), seconds(other, 0.0)]));
    }
    let second = other.map_or(0.0, value);
    Ok(MotionLag { seconds: seconds(best, part), sigma: 2.0 * interval, correlation: [value(best), second] })
}
