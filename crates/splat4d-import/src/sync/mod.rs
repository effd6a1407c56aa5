//! Synchronisation of cameras by sound, motion and geometry.
//!
//! Every camera's frames have timestamps on its own clock; the result is one [`graph::Offset`] per camera to add to
//! them. Evidence is pairwise: a *lag* of cameras a and b is the difference of their timestamps of one event, `t_b −
//! t_a`, so that `lag = offset_a − offset_b`. [`sound`] and [`epipolar`] measure lags, [`motion`] guesses them, and
//! [`graph`] computes offsets and drops lags that contradict the rest. Undetermined offsets are refused with a
//! `Refusal` and never averaged in.

pub mod epipolar;
mod fft;
pub mod graph;
pub mod grey;
pub mod motion;
pub mod sound;
pub mod tracks;

use std::fmt;

/// Why there is no lag.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub(crate) enum Refusal {
    /// Too little in common to compare, seconds or samples of it as a word.
    Short(&'static str),
    /// Nothing is heard.
    Silent,
    /// Nothing moves.
    Still,
    /// Nothing agrees better at one lag than at others: other recordings, or nothing in common.
    Unrelated,
    /// Several lags agree alike: what moves or sounds repeats itself. The two best, seconds.
    Repeating([f64; 2]),
    /// Inliers leave the lag open by this many seconds: motion along the epipolar lines.
    Vague(f64),
    /// The evidence grows or shrinks in time, by this many seconds a second: a wrong frame rate in a file.
    Drifting(f64),
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Short(what) => write!(f, "there is too little of {what}"),
            Self::Silent => write!(f, "nothing is heard"),
            Self::Still => write!(f, "nothing moves"),
            Self::Unrelated => write!(f, "nothing agrees: these may be different recordings"),
            Self::Repeating([a, b]) => write!(f, "it repeats itself: {a:.3} s and {b:.3} s fit alike"),
            Self::Vague(s) => write!(f, "what moves leaves it open by {s:.3} s"),
            Self::Drifting(r) => {
                write!(f, "it changes by {:.1} ms a second: a frame rate may be wrong in a file", r * 1e3)
            }
        }
    }
}

/// The middle value; half of the values may be anything. NaN of none.
pub(crate) fn median(values: &mut [f64]) -> f64 {
    splat4d::math::median(values).unwrap_or(f64::NAN)
}

/// Ratio of the standard deviation to the median absolute deviation of a normal distribution.
pub(crate) const NORMAL_MAD: f64 = 1.4826;

/// Extremum of a parabola through three values, one step apart: −½ to ½ steps from the middle one, and the value there.
fn parabola([left, middle, right]: [f64; 3]) -> (f64, f64) {
    let bend = left - 2.0 * middle + right;
    if bend.abs() < f64::MIN_POSITIVE {
        return (0.0, middle);
    }
    let at = (0.5 * (left - right) / bend).clamp(-0.5, 0.5);
    (at, middle - 0.25 * (left - right) * at)
}

#[cfg(test)]
mod drawn;
#[cfg(test)]
mod tests;
