//! A cell of the study: operations on a trained scene, and the points that it consists of.

use splat4d_train::compress::Compression;
use splat4d_train::maintenance::importance::{Combine, Spatial, Temporal};

/// Share of pruned Gaussians where something else is varied, as 4DGS-1K on N3V.
const AT: f64 = 0.8;
/// Frames between key times where something else is varied, as there.
const INTERVAL: usize = 20;
/// Shares at which quality is measured.
const SHARES: [f64; 9] = [0.0, 0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95];
const FEW_SHARES: [f64; 4] = [0.0, 0.5, 0.8, 0.95];
/// Frames between key times; 4DGS-1K tried 10 to 60.
const INTERVALS: [usize; 5] = [2, 5, 10, 20, 60];
const FEW_INTERVALS: [usize; 2] = [5, 20];
/// Rounds in which one share is pruned.
const ROUNDS: [usize; 3] = [1, 2, 4];
const FEW_ROUNDS: [usize; 1] = [1];
/// Assumed cost of fine-tuning in addition to its steps (scoring, evaluation, playing), in steps; for the time
/// that is left.
const OVERHEAD: f64 = 300.0;

/// One treatment of the source.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Cell {
    /// Share of pruned Gaussians, in this many rounds.
    pub prune: f64,
    pub rounds: usize,
    pub score: Score,
    /// Steps of fine-tuning.
    pub steps: usize,
    /// Frames between key times; 0: no filter.
    pub interval: usize,
}

/// How Gaussians are ranked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Score {
    pub spatial: Spatial,
    pub temporal: Temporal,
    pub combine: Combine,
    pub volume: bool,
}

/// Score that `compress` uses by default.
const DEFAULT: Score =
    Score { spatial: Spatial::Change, temporal: Temporal::InstantAbs, combine: Combine::Product, volume: false };

impl Score {
    /// All that are compared, the default first: the spatial variants, the temporal ones, with the volume, the ways to
    /// combine, and 4DGS-1K's own choice.
    pub(crate) fn all() -> Vec<(String, Self)> {
        let mut out = vec![("change, instant abs".to_owned(), DEFAULT)];
        // Those of other systems' pruning can be requested; here they would add a run each.
        let spatial = [Spatial::Share, Spatial::Both].iter();
        out.extend(spatial.map(|s| (format!("{s}, instant abs"), Self { spatial: *s, ..DEFAULT })));
        let temporal = Temporal::ALL.iter().filter(|t| **t != DEFAULT.temporal);
        out.extend(temporal.map(|t| match t {
            Temporal::None => ("change alone".to_owned(), Self { temporal: *t, ..DEFAULT }),
            t => (format!("change, {}", t.name().replace('-', " ")), Self { temporal: *t, ..DEFAULT }),
        }));
        out.push(("change, instant abs, volume".into(), Self { volume: true, ..DEFAULT }));
        let combine = Combine::ALL.iter().filter(|c| **c != DEFAULT.combine);
        let combined = |c: &Combine| format!("change, instant abs, {}", c.name().replace('-', " "));
        out.extend(combine.map(|c| (combined(c), Self { combine: *c, ..DEFAULT })));
        let share = Self { spatial: Spatial::Share, ..DEFAULT };
        out.push(("share alone".into(), Self { temporal: Temporal::None, ..share }));
        out.push(("share, instant abs, volume (4DGS-1K)".into(), Self { volume: true, ..share }));
        out
    }
}

impl Cell {
    /// The unchanged source.
    pub(crate) const fn source() -> Self {
        Self { prune: 0.0, rounds: 1, score: DEFAULT, steps: 0, interval: 0 }
    }

    /// Whether nothing is done at all.
    pub(crate) fn is_source(&self) -> bool {
        self.prune == 0.0 && self.steps == 0 && self.interval == 0
    }

    /// Its name in files: what it depends on. Without pruning neither score nor rounds matter.
    pub(crate) fn key(&self) -> String {
        let mut key = format!("prune{:03.0}", 1000.0 * self.prune);
        if self.prune > 0.0 {
            let Score { spatial, temporal, combine, volume } = self.score;
            key += &format!(
                "-{spatial}-{temporal}-{combine}-{}-rounds{}",
                if volume { "volume" } else { "flat" },
                self.rounds
            );
        }
        key + &format!("-steps{}-interval{}", self.steps, self.interval)
    }

    /// For people who wait.
    pub(crate) fn words(&self) -> String {
        if self.is_source() {
            return "the source".into();
        }
        let mut words = match self.prune {
            0.0 => "not pruned".to_owned(),
            share => format!("{:.0} % pruned by {} and {}", 100.0 * share, self.score.spatial, self.score.temporal),
        };
        if self.interval > 0 {
            words += &format!(", filter every {} frames", self.interval);
        }
        if self.steps > 0 {
            words += &format!(", {} steps", self.steps);
        }
        words
    }

    /// For the compression: floats throughout, so that only what is varied changes anything.
    pub(crate) fn settings(&self) -> Compression {
        Compression {
            prune: self.prune,
            rounds: self.rounds,
            spatial: self.score.spatial.name().into(),
            temporal: self.score.temporal.name().into(),
            combine: self.score.combine.name().into(),
            volume: self.score.volume,
            fine_tune: self.steps,
            mask_interval: self.interval,
            codec: false,
            ..Compression::default()
        }
    }

    /// Cost of the cell, in steps of training.
    pub(crate) fn cost(&self) -> f64 {
        OVERHEAD + self.steps as f64
    }
}

/// Parameters that the study varies.
#[derive(Clone, Debug)]
pub(crate) struct Grid {
    pub shares: Vec<f64>,
    pub intervals: Vec<usize>,
    pub rounds: Vec<usize>,
    pub scores: Vec<(String, Score)>,
    /// Steps of fine-tuning, where there is any.
    pub steps: usize,
    /// Whether scores, intervals and rounds are fine-tuned too.
    pub tune_all: bool,
}

impl Grid {
    pub(crate) fn full(steps: usize) -> Self {
        Self {
            shares: SHARES.to_vec(),
            intervals: INTERVALS.to_vec(),
            rounds: ROUNDS.to_vec(),
            scores: Score::all(),
            steps,
            tune_all: true,
        }
    }

    /// A glance: fewer points, and fine-tuning only of the main ones.
    pub(crate) fn quick(steps: usize) -> Self {
        Self {
            shares: FEW_SHARES.to_vec(),
            intervals: FEW_INTERVALS.to_vec(),
            rounds: FEW_ROUNDS.to_vec(),
            tune_all: false,
            ..Self::full(steps)
        }
    }

    /// Pruned to a share: [not tuned, tuned, tuned with the filter on].
    pub(crate) fn share(&self, prune: f64) -> [Cell; 3] {
        let cell = |steps, interval| Cell { prune, steps, interval, ..Cell::source() };
        [cell(0, 0), cell(self.steps, 0), cell(self.steps, INTERVAL)]
    }

    /// Ablation of the parts, at one share: name and cell.
    pub(crate) fn parts(&self) -> Vec<(String, Cell)> {
        let cell = |prune, interval, steps| Cell { prune, interval, steps, ..Cell::source() };
        let pruned = format!("pruned by {:.0} %", 100.0 * AT);
        vec![
            ("source".into(), cell(0.0, 0, 0)),
            ("trained on, nothing removed".into(), cell(0.0, 0, self.steps)),
            ("filter".into(), cell(0.0, INTERVAL, 0)),
            ("filter, fine-tuned".into(), cell(0.0, INTERVAL, self.steps)),
            (pruned.clone(), cell(AT, 0, 0)),
            (format!("{pruned}, fine-tuned"), cell(AT, 0, self.steps)),
            (format!("{pruned}, filter"), cell(AT, INTERVAL, 0)),
            (format!("{pruned}, filter, fine-tuned"), cell(AT, INTERVAL, self.steps)),
        ]
    }

    /// [not tuned, tuned] of a score.
    pub(crate) fn score(&self, score: Score) -> [Cell; 2] {
        [0, self.steps].map(|steps| Cell { prune: AT, score, steps, ..Cell::source() })
    }

    /// [not tuned, tuned] of an interval.
    pub(crate) fn interval(&self, interval: usize) -> [Cell; 2] {
        [0, self.steps].map(|steps| Cell { prune: AT, interval, steps, ..Cell::source() })
    }

    /// Tuned, in this many rounds.
    pub(crate) fn round(&self, rounds: usize) -> Cell {
        Cell { prune: AT, rounds, steps: self.steps, ..Cell::source() }
    }

    /// Every cell once: the source first, then what the main tables need.
    pub(crate) fn cells(&self) -> Vec<Cell> {
        let mut all = vec![Cell::source()];
        all.extend(self.parts().into_iter().map(|(_, cell)| cell));
        all.extend(self.shares.iter().flat_map(|s| self.share(*s)));
        let few = if self.tune_all { 2 } else { 1 };
        all.extend(self.scores.iter().flat_map(|(_, s)| self.score(*s).into_iter().take(few)));
        all.extend(self.intervals.iter().flat_map(|i| self.interval(*i).into_iter().take(few)));
        if self.tune_all {
            all.extend(self.rounds.iter().map(|r| self.round(*r)));
        }
        let mut seen = std::collections::BTreeSet::new();
        all.retain(|c| seen.insert(c.key()));
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_exists_once_and_is_distinct() {
        let grid = Grid::full(1000);
        let cells = grid.cells();
        assert!(cells[0].is_source() && cells[1..].iter().all(|c| !c.is_source()));
        for (i, a) in cells.iter().enumerate() {
            assert!(a.settings().check().is_ok(), "{a:?}");
            assert!(a.key().chars().all(|c| c.is_ascii_alphanumeric() || c == '-'), "{}", a.key());
            assert!(cells[..i].iter().all(|b| b.key() != a.key() && b != a));
        }
        let keys: Vec<String> = cells.iter().map(Cell::key).collect();
        let needed =
            grid.shares.iter().flat_map(|s| grid.share(*s)).chain(grid.scores.iter().flat_map(|s| grid.score(s.1)));
        assert!(needed.into_iter().all(|c| keys.contains(&c.key())));
        assert_eq!(grid.scores[0].1, DEFAULT);
        assert!(Grid::quick(10).cells().len() < cells.len() / 2);
    }

    #[test]
    fn without_pruning_the_score_makes_no_cell_of_its_own() {
        let plain = Cell { steps: 5, ..Cell::source() };
        let other = Cell { score: Score { volume: true, ..DEFAULT }, rounds: 3, ..plain.clone() };
        assert_eq!(plain.key(), other.key());
    }
}
