//! Estimates the time of a run: a few steps are timed at the initial and at the largest number of Gaussians, and the
//! densification schedule gives the number in between. `--minutes M` begins with as many iterations as fit by that;
//! [`budget`](super::budget) plans again when the machine turns out to be slower or faster.

use super::clock::Stopwatch;
use super::open::OpenCapture;
use crate::event::{Event, Progress};
use crate::maintenance::{At, Every};
use crate::methods::{Stage, stages};
use crate::recipe::Recipe;
use crate::step::engine::Blame;
use crate::step::trainer::{Fault, Trainer};
use crate::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};

/// Steps that are timed; the first third of them warm caches up and do not count.
const TIMED: usize = 37;
/// See [`TIMED`].
const WARM_UP: f64 = 1.0 / 3.0;
/// Steps that are timed however long they take.
const LEAST: usize = 6;
/// Steps between two densifications of the probe, and at most this many steps until it is at the cap.
const HURRIED: usize = 20;
/// See [`HURRIED`].
const GROWTH_STEPS: usize = 400;
/// Steps of a stage that is not to end while it is timed.
const ENDLESS: usize = 1 << 40;
/// Of the time that probes may take, what is over when the few Gaussians have been timed, and when the cloud has grown.
const PARTS: [f64; 2] = [0.25, 0.65];
/// Bounds of what is sensible.
const ITERATIONS: std::ops::RangeInclusive<usize> = 50..=1_000_000;

/// The duration of a run's steps by what they do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Timing {
    /// In the first stage, and in those after it.
    stages: [Steps; 2],
    /// Seconds until the first scene is made.
    pub(super) scene: f64,
}

/// The duration of a stage's steps: linear in the number of Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Steps {
    /// The two numbers of Gaussians at which it was measured.
    gaussians: [usize; 2],
    /// Seconds a step [half size, full size] at either.
    seconds: [[f64; 2]; 2],
}

impl Steps {
    /// Seconds a step of `stage` takes, `place` steps into its schedule, with this many Gaussians.
    fn at(&self, stage: &Stage, place: usize, count: f64) -> f64 {
        let ([start, end], [few, many]) = (self.gaussians.map(|n| n as f64), self.seconds);
        let size = usize::from(place >= stage.half_size_steps);
        let slope = if end > start { (many[size] - few[size]) / (end - start) } else { 0.0 };
        // A cloud that just grew can be faster than the initial one, whose Gaussians are large: more of them do not make
        // steps cheaper beyond that.
        few[size].min(many[size]).max(few[size] + slope * (count - start))
    }
}

impl Timing {
    /// Times steps of a recipe on a capture, for about `seconds` in all.
    pub(super) fn measure(
        opened: &OpenCapture,
        recipe: &Recipe,
        clock: &Stopwatch,
        seconds: f64,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Self> {
        let tell = |listen: &mut dyn FnMut(&Event), done| {
            listen(&Event::Phase { name: "timing steps".into(), done, total: 2 });
        };
        tell(listen, 0);
        // A filter would be switched on later than the probes measure. The number of Gaussians may become smaller, and
        // the initial one with it: the fewest are timed, and those that the cap of this recipe brings.
        let least = recipe.clone().with(|r| r.densify.max_cap = 0).initial_count();
        let with = |count: usize| recipe.unresolved().with(|r| (r.filter.start, r.init.count) = (0.0, count));
        let (fewest, recipe) = (with(least), with(recipe.initial_count()));
        let plan = opened.plan(&recipe);
        let mut first = 0.0;
        let mut scene = |recipe: &Recipe| {
            let began = clock.seconds();
            let scene = opened.initial_scene(recipe, &plan);
            first = clock.seconds() - began;
            scene
        };
        let small = scene(&fewest)?;
        let large = if fewest.init.count < recipe.init.count { scene(&recipe)? } else { small.clone() };
        // The scene is not made faster because steps are to be timed.
        let began = clock.seconds();
        let until = |part: f64| began + part * seconds;
        let start = small.len();
        // Copies of initial Gaussians would cost far more than trained ones, which are small: the probe grows by the
        // recipe's own strategy, in a hurry. A probe's rates do not matter, its number of Gaussians does: nothing of it
        // is kept.
        let mut probe = Probe { trainer: opened.trainer(&recipe, &plan, small)?, clock };
        probe.trainer.check_not_empty()?;
        let few = probe.rates(until(PARTS[0]))?;
        tell(listen, 1);
        let mut probe = Probe { trainer: opened.trainer(&recipe, &plan, large)?, clock };
        probe.densify(Every { first: HURRIED, last: usize::MAX, interval: HURRIED });
        probe.trainer.stages.iter_mut().for_each(|s| s.half_size_steps = usize::MAX);
        probe.trainer.stages[0].iterations = ENDLESS;
        for _ in 0..GROWTH_STEPS {
            if probe.trainer.scene().len() >= recipe.densify.max_cap || clock.seconds() > until(PARTS[1]) {
                break;
            }
            probe.step()?;
        }
        probe.densify(Every::NEVER);
        let gaussians = [start, probe.trainer.scene().len()];
        let many = probe.rates(until(1.0))?;
        tell(listen, 2);
        let stages = [0, 1].map(|later| Steps { gaussians, seconds: [few[later], many[later]] });
        Ok(Self { stages, scene: first })
    }

    /// Seconds of one step in a place of the schedule, with this many Gaussians.
    pub(super) fn step(&self, stages: &[Stage], stage: usize, place: usize, count: usize) -> f64 {
        stages.get(stage).map_or(0.0, |s| self.stages[stage.min(1)].at(s, place, count as f64))
    }

    /// Seconds of the schedule from a place on, `count` Gaussians at which grow by the schedule.
    pub(super) fn rest(&self, stages: &[Stage], from: [usize; 2], count: usize, cap: usize) -> f64 {
        let (mut count, mut total) = (count as f64, 0.0);
        for (number, stage) in stages.iter().enumerate().skip(from[0]) {
            let steps = &self.stages[number.min(1)];
            for i in if number == from[0] { from[1] } else { 0 }..stage.iterations {
                total += steps.at(stage, i, count);
                let at = At { step: i + 1, steps: stage.iterations };
                count = stage.maintenance.iter().fold(count, |n, u| u.grown(&at, n, cap as f64));
            }
        }
        total
    }

    /// Seconds of a whole recipe's steps, and of a step at its end.
    pub(super) fn of(&self, opened: &OpenCapture, recipe: &Recipe) -> Result<[f64; 2]> {
        let r = recipe.resolve();
        let stages = stages(r.program()?.as_ref(), &opened.plan(&r));
        let (timed, cap) = (self.stages[0].gaussians[0], r.densify.max_cap);
        let start = if recipe.init.count == 0 { timed.max(r.initial_count()).min(cap) } else { timed };
        Ok([self.rest(&stages, [0, 0], start, cap), self.last(&stages, cap)])
    }

    /// Seconds of a step at the end of the schedule.
    pub(super) fn last(&self, stages: &[Stage], cap: usize) -> f64 {
        self.step(stages, stages.len() - 1, usize::MAX, cap.max(self.stages[0].gaussians[0]))
    }

    /// The recipe with as many iterations as take `seconds`, where what follows takes as long as this many steps at the
    /// end.
    pub(super) fn fit(&self, opened: &OpenCapture, recipe: &Recipe, seconds: f64, finish: f64) -> Result<Recipe> {
        let recipe = recipe.unresolved();
        let cost = |iterations: usize| -> Result<f64> {
            let [steps, last] = self.of(opened, &recipe.clone().with(|r| r.run.iterations = iterations))?;
            Ok(steps + finish * last)
        };
        let (mut low, mut high) = (*ITERATIONS.start(), *ITERATIONS.end());
        while low + 1 < high {
            let middle = low.midpoint(high);
            if cost(middle)? <= seconds { low = middle } else { high = middle }
        }
        Ok(recipe.with(|r| r.run.iterations = low))
    }
}

/// A trainer whose steps are timed.
struct Probe<'a> {
    trainer: Trainer<'a>,
    clock: &'a Stopwatch,
}

impl Probe<'_> {
    /// Lets all stages densify at other steps.
    fn densify(&mut self, steps: Every) {
        for stage in &mut self.trainer.stages {
            stage.maintenance.iter_mut().filter_map(|u| u.densification()).for_each(|s| *s = steps);
        }
    }

    /// Seconds a step [half size, full size] in the first stage and, skipping what is left of it, in the second; a run
    /// of one stage has the first twice. It ends by `until`, if only a few steps.
    fn rates(&mut self, until: f64) -> Result<[[f64; 2]; 2]> {
        let sizes = [usize::MAX, 0];
        let all = sizes.len() * self.trainer.stages.len().min(2);
        let now = self.clock.seconds();
        let share = |k: usize| now + (until - now).max(0.0) * (k + 1) as f64 / all as f64;
        let first = [self.time(sizes[0], share(0))?, self.time(sizes[1], share(1))?];
        if self.trainer.stages.len() == 1 {
            return Ok([first; 2]);
        }
        self.trainer.stages[0].iterations = self.trainer.progress.stage_step + 1;
        self.step()?;
        // Stages without a step are passed by.
        self.trainer.enter(&mut Progress(&mut |_| {}))?;
        if self.trainer.is_done() {
            return Ok([first; 2]);
        }
        Ok([first, [self.time(sizes[0], share(2))?, self.time(sizes[1], share(3))?]])
    }

    /// Seconds a step of the current stage, the first `half_size_steps` of it at half size.
    fn time(&mut self, half_size_steps: usize, until: f64) -> Result<f64> {
        let stage = &mut self.trainer.stages[self.trainer.progress.stage];
        (stage.half_size_steps, stage.iterations) = (half_size_steps, ENDLESS);
        let mut times = vec![self.clock.seconds()];
        while times.len() <= TIMED {
            self.step()?;
            let now = self.clock.seconds();
            times.push(now);
            if times.len() > LEAST && now > until {
                break;
            }
        }
        let (warm, last) = ((times.len() as f64 * WARM_UP) as usize, times.len() - 1);
        Ok((times[last] - times[warm]) / (last - warm) as f64)
    }

    fn step(&mut self) -> Result<()> {
        // A device is not to be still at it when the clock is examined.
        match self.trainer.step()?.and_then(|_| self.trainer.catch_up()) {
            Ok(_) => Ok(()),
            // The run that follows searches for itself whether there is one.
            Err(Fault(_, Blame::Device, _)) => {
                self.trainer.go_on();
                self.step()
            }
            Err(fault) => Err(Error::new(ErrorKind::Diverged, format!("the timing probe failed: {}", fault.0))
                .remedy("Look for wrong poses with `splat4d info CAPTURE`")),
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Of steps that take so long [half size, full size] with either number of Gaussians, in every stage.
    pub(crate) fn timing(gaussians: [usize; 2], few: [f64; 2], many: [f64; 2]) -> Timing {
        Timing { stages: [Steps { gaussians, seconds: [few, many] }; 2], scene: 0.0 }
    }

    #[test]
    #[cfg(feature = "gpu")]
    fn a_device_that_is_lost_does_not_end_the_timing() {
        use crate::run::tests::{Place, recipe};
        let Some(device) = crate::step::tests::resident::Failing::new([usize::MAX, 3, usize::MAX]) else { return };
        let (place, recipe) = (Place::new(), recipe(&["motion=spacetime"]).resolve());
        let opened = OpenCapture::new(place.open(&recipe), &recipe).unwrap();
        let plan = opened.plan(&recipe);
        let mut trainer = opened.trainer(&recipe, &plan, opened.initial_scene(&recipe, &plan).unwrap()).unwrap();
        trainer.set_engine(crate::step::resident::DeviceEngine::new(device));
        let mut probe = Probe { trainer, clock: &Stopwatch::start() };
        for step in 1..8 {
            probe.step().unwrap();
            assert!(probe.trainer.progress.iteration >= step);
        }
        assert!(probe.trainer.settle().is_ok(), "the CPU has all there is");
    }

    /// Steps are timed with the fewest initial Gaussians; the run begins with those that its cap brings.
    #[test]
    fn the_cost_begins_with_the_initial_gaussians_of_the_cap() {
        use crate::run::tests::{Place, recipe};
        let place = Place::new();
        let cost = |count: &str| {
            let r = recipe(&["motion=still", "densify.max_cap=90000", "half_size_until=0", "iterations=100", count]);
            let opened = OpenCapture::new(place.open(&r), &r).unwrap();
            timing([1000, 91_000], [0.01; 2], [0.1; 2]).of(&opened, &r).unwrap()[0]
        };
        let (stated, chosen) = (cost("init.count=1000"), cost("init.count=0"));
        // Nothing grows in the first steps: ten milliseconds each, or, with 30,000 Gaussians, 39.
        assert!(stated < 10.0 && chosen > stated + 5.0 * 0.029, "{stated} {chosen}");
    }

    /// A few initial Gaussians are large, and those that they become after a few steps are faster: from the two alone, a
    /// hundred thousand would cost nothing.
    #[test]
    fn both_numbers_of_initial_gaussians_are_timed_and_more_never_cost_less() {
        use crate::run::tests::{Place, recipe};
        let place = Place::new();
        let r = recipe(&["motion=still", "densify.max_cap=90000", "init.count=0"]);
        let opened = OpenCapture::new(place.open(&r), &r).unwrap();
        let timing = Timing::measure(&opened, &r, &Stopwatch::start(), 0.1, &mut |_| {}).unwrap();
        let [few, many] = timing.stages[0].gaussians;
        let least = r.clone().with(|r| r.densify.max_cap = 0).initial_count();
        assert!(few <= least && many > 2 * least, "{few}, {many} of {least} and {}", r.initial_count());
        let turned = self::timing([9400, 14_000], [0.06, 0.18], [0.05, 0.10]);
        let stages = [Stage::new("all", 100)];
        assert_eq!([14_000, 226_000].map(|n| turned.step(&stages, 0, 0, n)), [0.10; 2]);
    }

    #[test]
    fn the_cost_follows_the_growth_and_the_size() {
        let r = Recipe::default()
            .with(|r| {
                r.run.iterations = 1000;
                r.run.half_size_until = 0.0;
                r.densify.max_cap = 2000;
            })
            .resolve();
        let mut stage = Stage { maintenance: r.plan().common.maintenance(), ..Stage::new("all", 1000) };
        let cost = |stages: &[Stage], t: Timing| t.rest(stages, [0, 0], 1000, r.densify.max_cap);
        let flat = cost(std::slice::from_ref(&stage), timing([1000, 1000], [0.01; 2], [0.01; 2]));
        assert!((flat - 10.0).abs() < 1e-9);
        let grown = timing([1000, 2000], [0.01; 2], [0.02; 2]);
        let all = cost(std::slice::from_ref(&stage), grown);
        assert!(all > 12.0 && all < 20.0, "{all}");
        // The rest of it, with as many Gaussians as are there.
        let rest = |place, count| grown.rest(std::slice::from_ref(&stage), [0, place], count, 2000);
        assert!((rest(900, 2000) - 2.0).abs() < 1e-9 && (rest(900, 1000) - 1.0).abs() < 1e-9 && rest(1000, 1) == 0.0);
        stage.half_size_steps = 500;
        let halves = [0.0, 0.01];
        let half = cost(std::slice::from_ref(&stage), timing([1000, 1000], halves, halves));
        assert!((half - 5.0).abs() < 1e-9);
        // A still warm-up of 100 free steps; then 900 of a network, a third of them at half size.
        let stages = [Stage::new("still", 100), Stage { half_size_steps: 300, ..Stage::new("network", 900) }];
        let mut t = timing([1000, 1000], [0.0; 2], [0.0; 2]);
        t.stages[1].seconds = [[0.01, 0.02]; 2];
        assert!((cost(&stages, t) - 15.0).abs() < 1e-9);
    }
}
