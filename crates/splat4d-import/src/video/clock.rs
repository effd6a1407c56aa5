//! Findings from the times of a video's frames: its rate, whether it varies, missing and duplicate frames.

use super::Rgb8;

/// An interval above this many medians is one that a frame is missing in.
const DROPPED: f64 = 1.5;
/// An interval below this many medians is one that a frame was put in a second time.
const DOUBLED: f64 = 0.25;
/// Two images whose samples differ by less than this on average (of 255) are one image: codecs repeat a frame without a
/// bit of change, sensors never do.
const SAME_PICTURE: f64 = 0.3;
/// And by less than this part of what most images differ by: where little moves before a fixed camera, compressed
/// images
/// that follow each other may differ as little.
const SAME_PART: f64 = 0.2;
/// Differences that most images have (three quarters of them differ by less): of frames doubled one by one,
/// half
/// differ by nothing.
const MOST: f64 = 0.75;
/// If most images differ by less than this, there is no motion, and no frame counts as doubled.
const STILL: f64 = 0.02;
/// Intervals that differ from the median by more than this part of it vary.
const VARIES: f64 = 0.1;
/// The part of the intervals that must vary, gaps left out, before the rate is reported as variable.
const VARIABLE_FROM: f64 = 0.05;

/// Frames that are missing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gap {
    /// The number of the last frame before them.
    pub after: usize,
    /// How many, to judge by the time.
    pub missing: usize,
}

/// The clock of a source, by its frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Clock {
    /// The median interval, seconds; 0 where there are fewer than two frames.
    pub interval: f64,
    /// Whether intervals differ without frames missing.
    pub variable: bool,
    /// Positions of missing frames.
    pub dropped: Vec<Gap>,
    /// Numbers of frames that show the one before again.
    pub doubled: Vec<usize>,
    /// Whether images are like the one before: nothing moves.
    pub still: bool,
}

impl Clock {
    /// Judges frames by their `times` (seconds, ascending) and by `differences`: for some of them their number and the
    /// `mean_difference` from the one before.
    pub(crate) fn of(times: &[f64], differences: &[(usize, f64)]) -> Self {
        let intervals: Vec<f64> = times.windows(2).map(|w| w[1] - w[0]).collect();
        if intervals.is_empty() {
            return Self::default();
        }
        let mut sorted = intervals.clone();
        sorted.sort_by(f64::total_cmp);
        let interval = sorted[sorted.len() / 2];
        let mut clock = Self { interval, ..Self::default() };
        let mut varying = 0;
        for (k, &step) in intervals.iter().enumerate() {
            if step > DROPPED * interval {
                let missing = ((step / interval).round() as usize).saturating_sub(1).max(1);
                clock.dropped.push(Gap { after: k, missing });
            } else if step < DOUBLED * interval {
                clock.doubled.push(k + 1);
            } else if (step - interval).abs() > VARIES * interval {
                varying += 1;
            }
        }
        clock.variable = varying as f64 > VARIABLE_FROM * intervals.len() as f64;
        let mut sizes: Vec<f64> = differences.iter().map(|d| d.1).collect();
        sizes.sort_by(f64::total_cmp);
        let usual = sizes.get((MOST * sizes.len() as f64) as usize).copied();
        clock.still = usual.is_some_and(|u| u < STILL);
        if let Some(usual) = usual.filter(|_| !clock.still) {
            let same = SAME_PICTURE.min(SAME_PART * usual);
            clock.doubled.extend(differences.iter().filter(|d| d.1 < same).map(|d| d.0));
            clock.doubled.sort_unstable();
            clock.doubled.dedup();
        }
        clock
    }

    /// Frames per second, from the median interval; 0 where there are fewer than two frames.
    pub(crate) fn rate(&self) -> f64 {
        if self.interval > 0.0 { 1.0 / self.interval } else { 0.0 }
    }

    /// How many frames are missing.
    pub(crate) fn missing(&self) -> usize {
        self.dropped.iter().map(|g| g.missing).sum()
    }
}

/// The mean absolute difference of two images' samples, 0 to 255; 255 where their sizes differ.
pub(crate) fn mean_difference(a: &Rgb8, b: &Rgb8) -> f64 {
    if (a.width, a.height) != (b.width, b.height) || a.data.is_empty() {
        return 255.0;
    }
    let sum: u64 = a.data.iter().zip(&b.data).map(|(x, y)| u64::from(x.abs_diff(*y))).sum();
    sum as f64 / a.data.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn times(numbers: &[f64]) -> Vec<f64> {
        numbers.iter().map(|n| n / 30.0).collect()
    }

    #[test]
    fn missing_and_doubled_frames_are_found_by_their_times() {
        let clock = Clock::of(&times(&[0.0, 1.0, 2.0, 5.0, 6.0, 7.0, 7.2, 8.0, 9.0]), &[]);
        assert_eq!(clock.dropped, [Gap { after: 2, missing: 2 }]);
        assert_eq!((clock.doubled.as_slice(), clock.missing()), (&[6][..], 2));
        assert!((clock.rate() - 30.0).abs() < 1e-9);
    }

    #[test]
    fn an_even_clock_has_no_finding() {
        // Times in whole milliseconds, as in Matroska.
        let even: Vec<f64> = (0..90).map(|i| (f64::from(i) / 29.97 * 1000.0).round() / 1000.0).collect();
        let clock = Clock::of(&even, &(1..90).map(|i| (i, 2.0)).collect::<Vec<_>>());
        assert_eq!((clock.variable, clock.still, clock.missing(), clock.doubled.len()), (false, false, 0, 0));
        assert_eq!(Clock::of(&[0.3], &[]), Clock::default());
    }

    #[test]
    fn a_variable_rate_is_not_a_lost_frame() {
        let uneven: Vec<f64> = (0..60).map(|i| (f64::from(i) + 0.2 * f64::from(i % 3)) / 30.0).collect();
        let clock = Clock::of(&uneven, &[]);
        assert!(clock.variable && clock.dropped.is_empty() && clock.doubled.is_empty());
    }

    #[test]
    fn identical_images_are_doubled_frames_unless_nothing_moves() {
        let even = times(&(0..20).map(f64::from).collect::<Vec<_>>());
        let moving: Vec<(usize, f64)> = (1..20).map(|i| (i, if i % 5 == 0 { 0.1 } else { 3.0 })).collect();
        assert_eq!(Clock::of(&even, &moving).doubled, [5, 10, 15]);
        // Every other frame twice; little motion; no motion.
        let other: Vec<(usize, f64)> = (1..20).map(|i| (i, if i % 2 == 0 { 0.01 } else { 0.2 })).collect();
        assert_eq!(Clock::of(&even, &other).doubled, [2, 4, 6, 8, 10, 12, 14, 16, 18]);
        let little: Vec<(usize, f64)> = (1..20).map(|i| (i, 0.1 + 0.005 * i as f64)).collect();
        assert!(Clock::of(&even, &little).doubled.is_empty());
        let still: Vec<(usize, f64)> = (1..20).map(|i| (i, 0.0)).collect();
        let clock = Clock::of(&even, &still);
        assert!(clock.still && clock.doubled.is_empty());
    }

    #[test]
    fn images_differ_by_their_samples() {
        let picture = |v: u8| Rgb8 { width: 2, height: 1, data: vec![v; 6] };
        assert_eq!(mean_difference(&picture(3), &picture(10)), 7.0);
        assert_eq!(mean_difference(&picture(3), &Rgb8::default()), 255.0);
    }
}
