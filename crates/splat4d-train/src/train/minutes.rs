//! `--minutes M`: how many iterations fit. A few steps are timed at the initial and at the capped number of Gaussians; the
//! iterations follow from the densification's own schedule, and are saved in the recipe, so that the run repeats.

use super::run::OpenCapture;
use super::trainer::Trainer;
use crate::event::{Event, Progress};
use crate::methods::{Stage, program_of, stages};
use crate::recipe::Recipe;
use crate::upkeep::{At, Every};
use crate::{Error, ErrorKind, Result};
use std::time::Instant as Clock;

/// Steps that warm caches up and are not timed.
const WARM_UP: usize = 12;
/// Steps that are timed.
const TIMED: usize = 25;
/// Steps between two densifications of the probe, and at most so many steps until it stands at the cap.
const HURRIED: usize = 20;
/// See [`HURRIED`].
const GROWTH_STEPS: usize = 400;
/// Steps of a stage that is not to end while it is timed.
const ENDLESS: usize = 1 << 40;
/// Bounds of what is sensible.
const ITERATIONS: std::ops::RangeInclusive<usize> = 50..=1_000_000;

/// The recipe with its iterations fixed so that training takes `minutes`.
pub(super) fn plan(
    opened: &OpenCapture,
    recipe: &Recipe,
    minutes: f64,
    listen: &mut dyn FnMut(&Event),
) -> Result<Recipe> {
    if !(minutes > 0.0 && minutes.is_finite()) {
        return Err(
            Error::input(format!("--minutes cannot be {minutes}")).remedy("Give a positive number, for instance 3")
        );
    }
    let tell = |listen: &mut dyn FnMut(&Event), done| {
        listen(&Event::Phase { name: "timing probes".into(), done, total: 2 });
    };
    tell(listen, 0);
    // A filter would be switched on later than the probes look.
    let plan = opened.plan(&recipe.clone().with(|r| r.filter.start = 0.0));
    let scene = opened.initial_scene(&plan)?;
    let start = scene.len();
    // A probe's rates do not matter, its number of Gaussians does: nothing of it is kept.
    let mut trainer = opened.trainer(&plan, scene)?;
    trainer.check_not_empty()?;
    let few = rates(&mut trainer)?;
    tell(listen, 1);
    // Copies of initial Gaussians would cost far more than trained ones, which are small: the probe grows by the
    // recipe's own strategy, in a hurry.
    let scene = opened.initial_scene(&plan)?;
    let mut trainer = opened.trainer(&plan, scene)?;
    densify(&mut trainer, Every { first: HURRIED, last: usize::MAX, interval: HURRIED });
    trainer.stages.iter_mut().for_each(|s| s.half_size_steps = usize::MAX);
    trainer.stages[0].iterations = ENDLESS;
    for _ in 0..GROWTH_STEPS {
        if trainer.scene().len() >= recipe.densify.max_cap {
            break;
        }
        step(&mut trainer)?;
    }
    densify(&mut trainer, Every::NEVER);
    let gaussians = [start, trainer.scene().len()];
    let many = rates(&mut trainer)?;
    tell(listen, 2);
    let steps = [0, 1].map(|later| Steps { gaussians, seconds: [few[later], many[later]] });
    let seconds = minutes * 60.0;
    let cost = |iterations: usize| -> Result<f64> {
        let r = reset(recipe).with(|r| r.run.iterations = iterations).resolve();
        Ok(cost(&stages(program_of(&r)?.as_ref(), &opened.plan(&r)), r.densify.max_cap, &steps))
    };
    let (mut low, mut high) = (*ITERATIONS.start(), *ITERATIONS.end());
    while low + 1 < high {
        let middle = low.midpoint(high);
        if cost(middle)? <= seconds { low = middle } else { high = middle }
    }
    Ok(reset(recipe).with(|r| r.run.iterations = low))
}

/// Lets all stages densify at other steps.
fn densify(trainer: &mut Trainer<'_>, steps: Every) {
    for stage in &mut trainer.stages {
        stage.upkeep.iter_mut().filter_map(|u| u.densification()).for_each(|s| *s = steps);
    }
}

/// Schedules that followed from another number of iterations are derived anew.
fn reset(recipe: &Recipe) -> Recipe {
    recipe.clone().with(|r| {
        r.appearance.sh_degree_interval = 0;
        r.densify.interval = 0;
        r.densify.from = 0;
        r.densify.until = 0;
        r.run.checkpoint_interval = 0;
    })
}

/// Seconds a step [half size, full size] in the first stage and, skipping what is left of it, in the second; a run of one
/// stage has the first twice.
fn rates(trainer: &mut Trainer<'_>) -> Result<[[f64; 2]; 2]> {
    let first = [time(trainer, usize::MAX)?, time(trainer, 0)?];
    if trainer.stages.len() == 1 {
        return Ok([first; 2]);
    }
    trainer.stages[0].iterations = trainer.progress.stage_step + 1;
    step(trainer)?;
    // Stages without a step are passed by.
    trainer.enter(&mut Progress(&mut |_| {}))?;
    if trainer.is_done() {
        return Ok([first; 2]);
    }
    Ok([first, [time(trainer, usize::MAX)?, time(trainer, 0)?]])
}

/// Seconds a step of the current stage, the first `half_size_steps` of it at half size.
fn time(trainer: &mut Trainer<'_>, half_size_steps: usize) -> Result<f64> {
    let stage = &mut trainer.stages[trainer.progress.stage];
    (stage.half_size_steps, stage.iterations) = (half_size_steps, ENDLESS);
    let mut clock = Clock::now();
    for i in 0..WARM_UP + TIMED {
        if i == WARM_UP {
            clock = Clock::now();
        }
        step(trainer)?;
    }
    Ok(clock.elapsed().as_secs_f64() / TIMED as f64)
}

fn step(trainer: &mut Trainer<'_>) -> Result<()> {
    match trainer.step()? {
        Ok(_) => Ok(()),
        Err(fault) => Err(Error::new(ErrorKind::Diverged, format!("the timing probe failed: {}", fault.0))
            .remedy("Look for wrong poses with `splat4d info CAPTURE`")),
    }
}

/// What steps of a stage take: linear in the number of Gaussians.
#[derive(Clone, Copy, Debug)]
struct Steps {
    /// The two numbers of Gaussians at which it was measured.
    gaussians: [usize; 2],
    /// Seconds a step [half size, full size] at either.
    seconds: [[f64; 2]; 2],
}

/// Seconds of all stages, in which the number of Gaussians grows by their schedules; `steps`: of the first stage, and of
/// those after it.
fn cost(stages: &[Stage], cap: usize, steps: &[Steps; 2]) -> f64 {
    let mut count = steps[0].gaussians[0] as f64;
    let mut total = 0.0;
    for (number, stage) in stages.iter().enumerate() {
        let Steps { gaussians, seconds: [few, many] } = &steps[number.min(1)];
        let [start, end] = gaussians.map(|n| n as f64);
        for i in 0..stage.iterations {
            let size = usize::from(i >= stage.half_size_steps);
            let slope = if end > start { (many[size] - few[size]) / (end - start) } else { 0.0 };
            total += few[size] + slope * (count - start);
            let at = At { step: i + 1, steps: stage.iterations };
            for growth in stage.upkeep.iter().map(|u| u.growth(&at)).filter(|g| *g != 1.0) {
                count = (count * growth).min(cap as f64);
            }
        }
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::upkeep;

    #[test]
    fn the_cost_follows_the_growth_and_the_size() {
        let r = Recipe::default()
            .with(|r| {
                r.run.iterations = 1000;
                r.run.half_size_until = 0.0;
                r.densify.max_cap = 2000;
            })
            .resolve();
        let mut stage = Stage { upkeep: upkeep::of(&r), ..Stage::new("all", 1000) };
        let steps = |gaussians, few, many| [Steps { gaussians, seconds: [few, many] }; 2];
        let flat = cost(std::slice::from_ref(&stage), r.densify.max_cap, &steps([1000, 1000], [0.01; 2], [0.01; 2]));
        assert!((flat - 10.0).abs() < 1e-9);
        let grown = cost(std::slice::from_ref(&stage), r.densify.max_cap, &steps([1000, 2000], [0.01; 2], [0.02; 2]));
        assert!(grown > 12.0 && grown < 20.0, "{grown}");
        stage.half_size_steps = 500;
        let halves = [0.0, 0.01];
        let half = cost(std::slice::from_ref(&stage), r.densify.max_cap, &steps([1000, 1000], halves, halves));
        assert!((half - 5.0).abs() < 1e-9);
        // A still warm-up of 100 free steps; then 900 of a network, a third of them at half size.
        let stages = [Stage::new("still", 100), Stage { half_size_steps: 300, ..Stage::new("network", 900) }];
        let mut steps = steps([1000, 1000], [0.0; 2], [0.0; 2]);
        steps[1].seconds = [[0.01, 0.02]; 2];
        assert!((cost(&stages, r.densify.max_cap, &steps) - 15.0).abs() < 1e-9);
    }
}
