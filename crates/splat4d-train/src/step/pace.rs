//! [`Pace`]: how fast a run proceeds through its schedule.
//!
//! All that depends on a run's length (rates, densification, resolution, degrees of SH, stages) is stated in steps of
//! its *schedule*, of which there are `run.iterations`. A step of the run is one of the schedule, until the run is
//! planned again: from then on what is left of the schedule is spread evenly over the steps that are left. Where these
//! are fewer, a step passes over several steps of the schedule, and everything that was due at any of them is done
//! once, after it; where they are more, some steps stay where they are. So nothing of the past changes its meaning, a
//! rate continues from where it was, densifications neither get lost nor are repeated, and the same changes of plan
//! give the same bits.

use super::replans::ScheduleChange;

/// How many steps of the schedule are behind a run after this many steps of its own: a pure function of the changes of
/// plan.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Pace {
    /// Steps of the schedule.
    schedule: usize,
    rows: Vec<(ScheduleChange, usize)>,
}

impl Pace {
    /// The pace of a run whose schedule has this many steps.
    pub(crate) fn new(schedule: usize, replans: &[ScheduleChange]) -> Self {
        let mut pace = Self { schedule, rows: Vec::new() };
        for row in replans {
            let left = pace.left_after(row.at);
            // Nothing is left to be planned.
            if left > 0 {
                pace.rows.push((*row, left));
            }
        }
        pace
    }

    /// Steps of the run in all.
    pub(crate) fn total(&self) -> usize {
        self.rows.last().map_or(self.schedule, |(row, _)| row.total)
    }

    /// Steps of the schedule that are left after `taken` steps of the run.
    fn left_after(&self, taken: usize) -> usize {
        let Some((row, left)) = self.rows.iter().rev().find(|(row, _)| row.at <= taken) else {
            return self.schedule.saturating_sub(taken);
        };
        let [steps, over] = [row.total.saturating_sub(taken), row.total - row.at].map(|n| n as u128);
        // Rounded up: the schedule ends with the last step, and not before it.
        (*left as u128 * steps).div_ceil(over) as usize
    }

    /// The changes that were followed in the first `taken` steps.
    pub(crate) fn replans_before(&self, taken: usize) -> Vec<[usize; 2]> {
        self.rows.iter().filter(|(row, _)| row.at < taken).map(|(row, _)| [row.at, row.total]).collect()
    }

    /// Steps of the schedule that are behind the run after `taken` steps.
    pub(crate) fn done_after(&self, taken: usize) -> usize {
        self.schedule - self.left_after(taken)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(at: usize, total: usize) -> ScheduleChange {
        ScheduleChange { at, total }
    }

    #[test]
    fn the_remaining_schedule_is_spread_over_the_remaining_steps() {
        let steady = Pace::new(100, &[]);
        assert!((0..=100).all(|i| steady.done_after(i) == i) && steady.total() == 100);
        // Half as many steps from the 20th on: two at a time.
        let fast = Pace::new(100, &[row(20, 60)]);
        assert_eq!([0, 20, 21, 22, 59, 60].map(|i| fast.done_after(i)), [0, 20, 22, 24, 98, 100]);
        // Twice as many from there, after another twenty: 40 of the schedule are left.
        let slow = Pace::new(100, &[row(20, 60), row(40, 120)]);
        assert_eq!([40, 41, 42, 43, 119, 120].map(|i| slow.done_after(i)), [60, 60, 61, 61, 99, 100]);
        assert_eq!([fast.total(), slow.total()], [60, 120]);
        // A change when no step is left changes nothing.
        assert_eq!(Pace::new(10, &[row(10, 30)]).total(), 10);
    }

    /// The schedule is processed in order, to its end and with the last step only, and in equal parts.
    #[test]
    fn every_replanning_continues_the_schedule() {
        for rows in [vec![row(1, 2)], vec![row(7, 900), row(8, 30)], vec![row(99, 100), row(150, 151)]] {
            let pace = Pace::new(1000, &rows);
            for (k, row) in rows.iter().enumerate() {
                let before = Pace::new(1000, &rows[..k]);
                assert!((0..=row.at).all(|i| before.done_after(i) == pace.done_after(i)), "the past changed");
            }
            let done: Vec<usize> = (0..=pace.total()).map(|i| pace.done_after(i)).collect();
            assert!(done.windows(2).all(|w| w[0] <= w[1]), "{rows:?}");
            assert!(done[pace.total()] == 1000 && done[pace.total() - 1] < 1000, "{rows:?}");
        }
    }
}
