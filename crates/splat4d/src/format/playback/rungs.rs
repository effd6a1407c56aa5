//! The rungs of a bitrate ladder, as a file states them (docs/format.md, "Ladder").

use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Most rungs that a file may state.
const MOST_RUNGS: usize = 9;

/// A rung of a bitrate ladder: the pages with a tier below `tiers`, and the rate that suffices for them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Rung {
    /// Bits per second; no window of the clip needs more.
    pub rate: f64,
    /// Pages with a lower tier belong to it.
    pub tiers: u16,
    /// Bits per second of the fullest window of the file that was read.
    #[serde(skip)]
    pub most: f64,
    /// Mean of all windows.
    #[serde(skip)]
    pub mean: f64,
}

/// Whether rates and tiers of a file's rungs rise.
pub(super) fn is_ladder(rungs: &[Rung]) -> bool {
    let rising = |pair: &[Rung]| pair[0].rate < pair[1].rate && pair[0].tiers < pair[1].tiers;
    let sound = |r: &Rung| r.rate.is_finite() && r.rate > 0.0 && r.tiers > 0;
    rungs.len() <= MOST_RUNGS && rungs.iter().all(sound) && rungs.windows(2).all(rising)
}

/// Errors: rates that do not rise from above zero, or too many.
pub(super) fn check(rates: &[f64]) -> Result<()> {
    let rungs: Vec<Rung> =
        rates.iter().zip(1..).map(|(&rate, tiers)| Rung { rate, tiers, ..Rung::default() }).collect();
    if is_ladder(&rungs) && rates.len() < MOST_RUNGS {
        return Ok(());
    }
    Err(Error::input(format!("invalid ladder: expected at most {} rising rates", MOST_RUNGS - 1))
        .remedy("Give the rates in Mbit/s, the lowest first, for example 8,20,75"))
}
