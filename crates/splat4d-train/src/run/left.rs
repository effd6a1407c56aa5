//! The estimate of the time that the remaining steps of a run take. Steps at half size are a fraction of those that
//! follow, and Gaussians grow, so that the mean of the past steps would promise too little.

use super::budget::Place;

/// Seconds of a step at full size for one at half size, until the first is measured: 2.8 and 2.6 on a drawn object, 104
/// photos of 912x912 with 9,400 and 14,000 Gaussians (studies/records/2026-11-28-drawn-at-full-size.md).
const FULL_FOR_HALF: f64 = 2.7;
/// Steps that decide: later ones are of more Gaussians, and single views differ by a factor.
const RECENT: f64 = 200.0;

/// The duration of this session's steps, without what stages do at their start.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct StepTimes {
    /// Seconds of a recent step [at half size, at full size], and how many there were.
    mean: [f64; 2],
    count: [f64; 2],
}

impl StepTimes {
    pub(super) fn add(&mut self, full_size: bool, seconds: f64) {
        let size = usize::from(full_size);
        self.count[size] += 1.0;
        self.mean[size] += (seconds - self.mean[size]) / self.count[size].min(RECENT);
    }

    /// Seconds of the steps that are left.
    pub(super) fn left(&self, place: &Place<'_>) -> f64 {
        let [half, full] = self.mean;
        let full = if self.count[1] > 0.0 { full } else { FULL_FOR_HALF * half };
        let half = if self.count[0] > 0.0 { half } else { full / FULL_FOR_HALF };
        let [halves, fulls] = place.steps_by_size();
        halves * half + fulls * full
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::Stage;
    use crate::step::trainer::Position;

    #[test]
    fn steps_at_full_size_are_expected_before_the_first_and_measured_after() {
        let stages = [
            Stage { half_size_steps: 40, ..Stage::new("still", 100) },
            Stage { half_size_steps: 0, ..Stage::new("all", 50) },
        ];
        let at =
            |stage, stage_step, left| Place::at(&stages, Position { stage, stage_step, ..Position::default() }, left);
        let mut times = StepTimes::default();
        assert_eq!(times.left(&at(0, 0, 150)), 0.0);
        for _ in 0..10 {
            times.add(false, 0.1);
        }
        // 30 at half size, 110 at full size.
        let expected = 30.0 * 0.1 + 110.0 * 0.1 * FULL_FOR_HALF;
        assert!((times.left(&at(0, 10, 140)) - expected).abs() < 1e-9);
        // Half as many steps for the same schedule.
        assert!((times.left(&at(0, 10, 70)) - expected / 2.0).abs() < 1e-9);
        times.add(true, 0.5);
        assert!((times.left(&at(0, 41, 109)) - 109.0 * 0.5).abs() < 1e-9);
        for _ in 0..1000 {
            times.add(true, 0.25);
        }
        assert!((times.left(&at(1, 40, 10)) - 2.5).abs() < 0.1);
        assert_eq!(times.left(&at(1, 50, 0)), 0.0);
    }
}
