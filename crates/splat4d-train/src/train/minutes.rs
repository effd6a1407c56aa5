//! `--minutes M`: how many iterations fit. A few steps are timed at the initial and at the capped number of Gaussians; the
//! iterations follow from the densification's own schedule, and are saved in the recipe, so that the run repeats.

use super::run::Bench;
use crate::densify::Densify;
use crate::event::Event;
use crate::models::{Stage, program_of, split};
use crate::recipe::Recipe;
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
/// Bounds of what is sensible.
const ITERATIONS: std::ops::RangeInclusive<usize> = 50..=1_000_000;

/// The recipe with its iterations fixed so that training takes `minutes`.
pub(super) fn plan(bench: &Bench, recipe: &Recipe, minutes: f64, listen: &mut dyn FnMut(&Event)) -> Result<Recipe> {
    if !(minutes > 0.0 && minutes.is_finite()) {
        return Err(
            Error::input(format!("--minutes cannot be {minutes}")).remedy("Give a positive number, for instance 3")
        );
    }
    let tell = |listen: &mut dyn FnMut(&Event), done| {
        listen(&Event::Phase { name: "timing probes".into(), done, total: 2 });
    };
    tell(listen, 0);
    let plan = bench.plan(recipe);
    let scene = bench.initial_scene(&plan)?;
    let start = scene.len();
    // A probe's rates do not matter, its number of Gaussians does: nothing of it is kept.
    let mut trainer = bench.trainer(&plan, scene)?;
    trainer.check_not_empty()?;
    let first = [time(&mut trainer, true)?, time(&mut trainer, false)?];
    tell(listen, 1);
    // Copies of initial Gaussians would cost far more than trained ones, which are small: the probe grows by the
    // recipe's own strategy, in a hurry.
    let scene = bench.initial_scene(&plan)?;
    let mut trainer = bench.trainer(&plan, scene)?;
    for stage in &mut trainer.stages {
        stage.densify_steps = (HURRIED, usize::MAX, HURRIED);
        stage.half_size_steps = usize::MAX;
    }
    for _ in 0..GROWTH_STEPS {
        if trainer.is_done() || trainer.scene.len() >= recipe.max_cap {
            break;
        }
        step(&mut trainer)?;
    }
    trainer.stages.iter_mut().for_each(|s| s.densify_steps = (0, 0, 0));
    let end = trainer.scene.len();
    let last = [time(&mut trainer, true)?, time(&mut trainer, false)?];
    // Later stages are timed by the first of them, on the cloud at the cap.
    let later = if trainer.stages.len() > 1 { later(&mut trainer)? } else { 0.0 };
    tell(listen, 2);
    let seconds = minutes * 60.0;
    let cost = |iterations: usize| -> Result<f64> {
        let r = Recipe { iterations, ..reset(recipe) }.resolve();
        let stages = split::stages(program_of(&r)?.as_ref(), &bench.plan(&r));
        let rest: usize = stages[1..].iter().map(|s| s.iterations).sum();
        Ok(schedule_cost(&stages[0], &r, [start, end], first, last) + later * rest as f64)
    };
    let (mut low, mut high) = (*ITERATIONS.start(), *ITERATIONS.end());
    while low + 1 < high {
        let middle = low.midpoint(high);
        if cost(middle)? <= seconds { low = middle } else { high = middle }
    }
    Ok(Recipe { iterations: low, ..reset(recipe) })
}

/// Schedules that followed from another number of iterations are derived anew.
fn reset(recipe: &Recipe) -> Recipe {
    Recipe {
        sh_degree_interval: 0,
        densification_interval: 0,
        densify_from_iter: 0,
        densify_until_iter: 0,
        checkpoint_interval: 0,
        ..recipe.clone()
    }
}

/// Seconds a step, at half or at full size.
fn time(trainer: &mut super::trainer::Trainer<'_>, half: bool) -> Result<f64> {
    for stage in &mut trainer.stages {
        stage.half_size_steps = if half { usize::MAX } else { 0 };
    }
    let mut clock = Clock::now();
    for i in 0..WARM_UP + TIMED {
        if i == WARM_UP {
            clock = Clock::now();
        }
        step(trainer)?;
    }
    Ok(clock.elapsed().as_secs_f64() / TIMED as f64)
}

/// Seconds a step of the second stage: what is left of the first is skipped.
fn later(trainer: &mut super::trainer::Trainer<'_>) -> Result<f64> {
    let now = trainer.progress.stage;
    let Some(stage) = trainer.stages.get_mut(now) else { return Ok(0.0) };
    if now == 0 {
        stage.iterations = trainer.progress.stage_step + 1;
        step(trainer)?;
    }
    let Some(stage) = trainer.stages.get_mut(trainer.progress.stage) else { return Ok(0.0) };
    stage.iterations = stage.iterations.max(trainer.progress.stage_step + WARM_UP + TIMED + 1);
    time(trainer, false)
}

fn step(trainer: &mut super::trainer::Trainer<'_>) -> Result<()> {
    match trainer.step()? {
        Ok(_) => Ok(()),
        Err(fault) => Err(Error::new(ErrorKind::Diverged, format!("the timing probe failed: {}", fault.0))
            .remedy("Look for wrong poses with `splat4d info CAPTURE`")),
    }
}

/// Seconds of a stage that grows: the cost of a step is linear in the number of Gaussians, which grows by the schedule.
/// `first` and `last`: seconds a step [half size, full size] at the two numbers of Gaussians.
fn schedule_cost(stage: &Stage, r: &Recipe, gaussians: [usize; 2], first: [f64; 2], last: [f64; 2]) -> f64 {
    let [start, end] = gaussians.map(|n| n as f64);
    let (from, until, every) = stage.densify_steps;
    let mut count = start;
    let mut total = 0.0;
    for i in 0..stage.iterations {
        let size = usize::from(i >= stage.half_size_steps);
        let slope = if end > start { (last[size] - first[size]) / (end - start) } else { 0.0 };
        total += first[size] + slope * (count - start);
        let step = i + 1;
        let densifies = stage.densify != Densify::None && step >= from && step <= until;
        if densifies && every > 0 && step.is_multiple_of(every) {
            // ADC reaches the cap within a few densifications; MCMC grows by its factor.
            count = (count * if r.strategy == "adc" { ADC_GROWTH } else { r.growth }).min(r.max_cap as f64);
        }
    }
    total
}

/// About how much a densification by gradients adds on real captures, until the cap.
const ADC_GROWTH: f64 = 1.2;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::models::densify_of;

    #[test]
    fn the_cost_follows_the_growth_and_the_size() {
        let r = Recipe { iterations: 1000, half_size_until: 0.0, max_cap: 2000, ..Recipe::default() }.resolve();
        let (densify, densify_steps) = densify_of(&r);
        let mut stage = Stage { densify, densify_steps, ..Stage::new("all", 1000) };
        let flat = schedule_cost(&stage, &r, [1000, 1000], [0.01; 2], [0.01; 2]);
        assert!((flat - 10.0).abs() < 1e-9);
        let grown = schedule_cost(&stage, &r, [1000, 2000], [0.01; 2], [0.02; 2]);
        assert!(grown > 12.0 && grown < 20.0, "{grown}");
        stage.half_size_steps = 500;
        assert!((schedule_cost(&stage, &r, [1000, 1000], [0.0, 0.01], [0.0, 0.01]) - 5.0).abs() < 1e-9);
    }
}
