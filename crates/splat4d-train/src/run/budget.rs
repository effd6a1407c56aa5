//! [`Budget`]: the time limit of a run. Before the first step, timed steps determine the length of the run. If the
//! machine becomes slower or faster during training, the remaining steps are planned again.
//!
//! A new plan is one row of `run.replans` and depends on the clock; all else follows from the rows
//! ([`Pace`](crate::step::pace::Pace)), so that a run that repeats or continues with them gives the same bits.

use super::minutes::Timing;
use crate::methods::Stage;
use crate::step::replans::ScheduleChange;
use crate::step::trainer::{Position, Trainer};
use serde::{Deserialize, Serialize};

/// Clock readings in a whole run. A change of speed is detected within one interval and treated as lasting after some:
/// what the last ones miss is less than a tenth of the time ([`tests`] holds it on machines that turn slower and
/// faster).
const READINGS: f64 = 32.0;
/// Of the time, what the end may be off before a run is planned again.
const TOLERANCE: f64 = 0.015;
/// Weight of the measurement since the last reading in the machine's speed: one busy time is not taken for the rest.
const NEWEST: f64 = 0.5;
/// Steps of the schedule that a step may represent, and steps that may represent one of the schedule: with fewer the
/// scene would be taken apart by rates and densifications meant for many.
const MOST: usize = 8;
/// Of the time, what is too late: more than `--minutes` promises.
const LATE: f64 = 1.1;
/// Of the time, the most that timing steps may take before the run.
pub(super) const PROBES: f64 = 0.06;

/// The time that a run may take. It is in run.json, so that a resumed run keeps it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Budget {
    /// From the command's start to its end.
    pub minutes: f64,
    /// Seconds of it that were over before the first step.
    pub before: f64,
    /// The time of the work after the last step, in units of the last steps.
    pub finish: f64,
    /// The duration of steps before the run.
    pub timing: Timing,
}

/// A place in a run, as far as plans depend on it.
#[derive(Clone, Copy)]
pub(super) struct Place<'a> {
    stages: &'a [Stage],
    progress: Position,
    /// Gaussians now, and at most.
    gaussians: [usize; 2],
    /// Remaining planned steps of the run.
    left: usize,
}

impl<'a> Place<'a> {
    pub(super) fn of(trainer: &'a Trainer<'_>) -> Self {
        let progress = trainer.progress;
        Self {
            stages: &trainer.stages,
            progress,
            gaussians: [trainer.scene().len(), trainer.settings.limits.cap],
            left: trainer.iterations().saturating_sub(progress.iteration),
        }
    }

    #[cfg(test)]
    pub(super) fn at(stages: &'a [Stage], progress: Position, left: usize) -> Self {
        Self { stages, progress, gaussians: [0; 2], left }
    }

    /// Seconds of a step here, as they were timed before the run.
    pub(super) fn step_seconds(&self, timing: &Timing) -> f64 {
        timing.step(self.stages, self.progress.stage, self.progress.stage_step, self.gaussians[0])
    }

    /// Whether the step here is at full size.
    pub(super) fn is_full_size(&self) -> bool {
        self.stages.get(self.progress.stage).is_none_or(|s| self.progress.stage_step >= s.half_size_steps)
    }

    /// Remaining steps of the run [at half size, at full size].
    pub(super) fn steps_by_size(&self) -> [f64; 2] {
        let mut left = [0.0; 2];
        for (number, stage) in self.stages.iter().enumerate().skip(self.progress.stage) {
            let from = if number == self.progress.stage { self.progress.stage_step } else { 0 };
            let halves = stage.half_size_steps.min(stage.iterations).saturating_sub(from);
            left[0] += halves as f64;
            left[1] += (stage.iterations.saturating_sub(from) - halves) as f64;
        }
        // One step of the run may represent several of the schedule, or a part of one.
        let all = left[0] + left[1];
        left.map(|n| if all > 0.0 { n * self.left as f64 / all } else { 0.0 })
    }

    /// Steps of the schedule that are left.
    fn schedule_left(&self) -> usize {
        let all: usize = self.stages[self.progress.stage..].iter().map(|s| s.iterations).sum();
        all.saturating_sub(self.progress.stage_step)
    }
}

/// A new plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Replanned {
    /// The row.
    pub row: ScheduleChange,
    /// The seconds at which the command would have ended without it.
    pub end: f64,
    /// The seconds at which it will end with it, where that is too late all the same.
    pub late: Option<f64>,
}

/// Keeps a run to its time.
#[derive(Clone, Debug)]
pub(super) struct Planner {
    budget: Budget,
    /// Seconds between two readings.
    interval: f64,
    /// Seconds since the command's start at the last reading.
    last_check: f64,
    /// Seconds of steps since then: taken, and as they were timed before the run.
    taken: [f64; 2],
    /// The machine's slowness: seconds for one as timed before the run.
    slowness: Option<f64>,
    /// The step of the last plan: before it nothing is planned again.
    last: usize,
}

impl Planner {
    /// Begins at this many seconds of the command, behind these plans.
    pub(super) fn new(budget: Budget, now: f64, replans: &[ScheduleChange]) -> Self {
        let last = replans.last().map_or(0, |row| row.at);
        // A part that begins late in a command is examined as often as one that begins at once.
        let interval = (60.0 * budget.minutes - now).max(0.0) / READINGS;
        Self { budget, interval, last_check: now, taken: [0.0; 2], slowness: None, last }
    }

    /// The time that the run is kept to.
    pub(super) fn minutes(&self) -> f64 {
        self.budget.minutes
    }

    /// Seconds of the steps that are left, at the speed of the machine as far as it is known.
    pub(super) fn left(&self, place: &Place<'_>) -> f64 {
        let [taken, expected] = self.taken;
        let so_far = if expected > 0.0 { taken / expected } else { 1.0 };
        self.mean_step(place, self.slowness.unwrap_or(so_far)) * place.left as f64
    }

    /// Seconds of one step of the run for one of the remaining schedule; with fewer steps each still takes as long.
    fn mean_step(&self, place: &Place<'_>, slowness: f64) -> f64 {
        let ([count, cap], from) = (place.gaussians, [place.progress.stage, place.progress.stage_step]);
        slowness * self.budget.timing.rest(place.stages, from, count, cap) / place.schedule_left().max(1) as f64
    }

    /// Remembers a step: the seconds that it and what belongs to it took, and those that were expected where it was
    /// taken.
    pub(super) fn add(&mut self, seconds: f64, expected: f64) {
        self.taken[0] += seconds;
        self.taken[1] += expected;
    }

    /// The new plan, where one is due: the end is off, and there is something left to plan.
    pub(super) fn replan(&mut self, now: f64, place: &Place<'_>) -> Option<Replanned> {
        let all = 60.0 * self.budget.minutes;
        let at = place.progress.iteration;
        if now - self.last_check < self.interval || at <= self.last || self.taken[1] <= 0.0 {
            return None;
        }
        let measured = self.taken[0] / self.taken[1];
        let slowness = self.slowness.map_or(measured, |old| old + NEWEST * (measured - old));
        (self.last_check, self.taken, self.slowness) = (now, [0.0; 2], Some(slowness));
        let schedule = place.schedule_left();
        if schedule == 0 {
            return None;
        }
        let step = self.mean_step(place, slowness);
        let finish = slowness * self.budget.finish * self.budget.timing.last(place.stages, place.gaussians[1]);
        let end = now + step * place.left as f64 + finish;
        if step <= 0.0 || (end - all).abs() <= TOLERANCE * all {
            return None;
        }
        let fit = ((all - now - finish) / step).max(0.0) as usize;
        let steps = fit.clamp(schedule.div_ceil(MOST), schedule * MOST).max(1);
        if steps == place.left {
            return None;
        }
        self.last = at;
        let then = now + step * steps as f64 + finish;
        Some(Replanned {
            row: ScheduleChange { at, total: at + steps },
            end,
            late: Some(then).filter(|t| *t > LATE * all),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::minutes::tests::timing;
    use super::*;
    use crate::maintenance;
    use crate::recipe::Recipe;
    use crate::step::pace::Pace;
    use splat4d::math::Rng;

    /// Steps, Gaussians and seconds of a synthetic machine.
    const STEPS: usize = 6000;
    const START: usize = 5000;
    const CAP: usize = 30_000;
    /// Time of what follows the last step, in steps.
    const FINISH: f64 = 200.0;

    /// A run on a machine with a clock of its own: seconds in all, and the plans.
    fn drive(slow: &dyn Fn(f64, usize) -> f64) -> (f64, f64, Vec<ScheduleChange>) {
        let r = Recipe::default()
            .with(|r| {
                r.run.iterations = STEPS;
                r.densify.max_cap = CAP;
            })
            .resolve();
        let half_size_steps = STEPS * 2 / 5;
        let stages =
            [Stage { maintenance: r.plan().common.maintenance(), half_size_steps, ..Stage::new("all", STEPS) }];
        let timing = timing([START, CAP], [0.004, 0.012], [0.009, 0.025]);
        // The plan is what fits.
        let planned = timing.rest(&stages, [0, 0], START, CAP) + FINISH * timing.last(&stages, CAP);
        let budget = Budget { minutes: planned / 60.0, before: 0.0, finish: FINISH, timing };
        let (mut planner, mut rows) = (Planner::new(budget, 0.0, &[]), Vec::new());
        let (mut now, mut taken, mut count) = (0.0, 0, START as f64);
        loop {
            let pace = Pace::new(STEPS, &rows);
            if taken >= pace.total() {
                break;
            }
            let place = pace.done_after(taken);
            let expected = timing.step(&stages, 0, place, count as usize);
            let seconds = expected * slow(now / planned, taken);
            now += seconds;
            planner.add(seconds, expected);
            taken += 1;
            let passed = pace.done_after(taken);
            for step in place + 1..=passed {
                let at = maintenance::At { step, steps: STEPS };
                count = stages[0].maintenance.iter().fold(count, |n, u| u.grown(&at, n, CAP as f64));
            }
            let progress = Position {
                iteration: taken,
                stage: usize::from(passed == STEPS),
                stage_step: passed,
                ..Position::default()
            };
            if passed == STEPS {
                continue;
            }
            let left = pace.total() - taken;
            let place = Place { stages: &stages, progress, gaussians: [count as usize, CAP], left };
            if let Some(new) = planner.replan(now, &place) {
                assert_eq!(new.row.at, taken);
                rows.push(new.row);
            }
        }
        now += FINISH * timing.last(&stages, CAP) * slow(now / planned, taken);
        (now / planned, planned, rows)
    }

    #[test]
    fn constant_speed_keeps_the_plan() {
        let (end, _, rows) = drive(&|_, _| 1.0);
        // A run has whole Gaussians, a plan while they grow a fraction of one more.
        assert!(rows.is_empty() && (end - 1.0).abs() < 1e-4, "{end} {rows:?}");
    }

    #[test]
    fn runs_end_on_time_when_the_machine_changes_speed() {
        let jitter = |i: usize| (0.5 * Rng::new(3, "jitter", i as u64).normal(0)).exp();
        type Machine<'a> = &'a dyn Fn(f64, usize) -> f64;
        let machines: [(&str, Machine<'_>); 9] = [
            ("slower from the start", &|_, _| 2.0),
            ("faster from the start", &|_, _| 0.5),
            ("slower in mid-run", &|t, _| if t < 0.5 { 1.0 } else { 2.0 }),
            ("faster in mid-run", &|t, _| if t < 0.5 { 1.0 } else { 0.5 }),
            ("slower near the end", &|t, _| if t < 0.85 { 1.0 } else { 2.0 }),
            ("busy for a while", &|t, _| if (0.3..0.6).contains(&t) { 3.0 } else { 1.0 }),
            ("now and then busy", &|t, _| if ((t * 9.0) as usize).is_multiple_of(2) { 1.0 } else { 2.0 }),
            ("jitter", &|_, i| jitter(i)),
            ("slower by and by, with jitter", &|t, i| (1.0 + t) * jitter(i)),
        ];
        for (name, slow) in machines {
            let (end, planned, rows) = drive(slow);
            assert!((0.9..=1.1).contains(&end), "{name}: {end:.3} of {planned:.0} s, {rows:?}");
            assert!(rows.len() <= READINGS as usize, "{name}: {} plans", rows.len());
        }
    }

    /// A run that cannot be kept to its time is not taken to pieces for it.
    #[test]
    fn a_step_replaces_at_most_a_few_scheduled_steps() {
        let (end, _, rows) = drive(&|t, _| if t < 0.3 { 1.0 } else { 100.0 });
        let total = rows.last().unwrap().total;
        assert!(end > 1.1 && total > STEPS / MOST / 2, "{end} {total}");
        for pair in rows.windows(2) {
            assert!(pair[0].at < pair[1].at && pair[1].at < pair[1].total);
        }
    }
}
