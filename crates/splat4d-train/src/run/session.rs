//! [`Session`]: a run while it is driven, from checkpoint to checkpoint. It emits events and never prints.

use super::budget::{Budget, Place, Planner};
use super::checkpoint::{self, Identity, RunState, write_atomically};
use super::clock::Stopwatch;
use super::corrected;
use super::identity::fingerprint;
use super::info::{ELSEWHERE, elsewhere, read_info};
use super::left::StepTimes;
use super::measured;
use super::memory::peak_memory;
use super::metrics::{Metrics, STAGE_NAMES, Totals, psnr};
use super::open::OpenCapture;
use super::priors;
use super::snapshot::Snapshots;
use crate::event::{Event, Progress};
use crate::files;
use crate::loss::image::ImageTerm;
use crate::path_text::to_text;
use crate::recipe::Recipe;
use crate::step::engine::Blame;
use crate::step::trainer::{Fault, Measured, Trainer};
use crate::{Error, ErrorKind, Result};
use serde_json::json;
use splat4d::device::Device;
use splat4d::render::Antialias;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant as Clock};

/// Options of a run in addition to its recipe.
#[derive(Clone, Debug, Default)]
pub struct TrainOptions {
    /// The renderer. It is not part of the recipe: a run may be resumed on another device, with other last bits.
    pub device: Device,
    /// Keep all from the clock's zero to the end of what follows training to so long: iterations are fitted to it, and
    /// fitted again during the run.
    pub minutes: Option<f64>,
    /// The caller's work after training (evaluation, film, baking) takes about as long as this many steps at the end of
    /// training; `minutes` includes it.
    pub finish: f64,
    /// Time steps before the run and report by [`Event::Predicted`] how long it will take. With `minutes` it is
    /// reported anyhow.
    pub predict: bool,
    /// The clock of `minutes`; its zero is when the command began, or these options were made.
    pub clock: Stopwatch,
    /// A loss of the caller's own next to the recipe's. It is no part of the recipe either, but a run that began
    /// with one is
    /// only resumed with one.
    pub own_loss: Option<OwnLoss>,
    /// Emit [`Event::Snapshot`] about so often, and at the end. They never take more than a fortieth of the time, and
    /// do not change the result.
    pub snapshots: Option<Duration>,
}

/// A caller's loss on images: makes its term, once for every run.
#[derive(Clone)]
pub struct OwnLoss(pub Arc<dyn Fn() -> Box<dyn ImageTerm> + Send + Sync>);

impl std::fmt::Debug for OwnLoss {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("OwnLoss")
    }
}

impl TrainOptions {
    /// Gives the trainer the caller's own loss.
    pub(super) fn add_loss(&self, trainer: &mut Trainer<'_>) {
        if let Some(OwnLoss(make)) = &self.own_loss {
            trainer.loss.push_boxed(make());
        }
    }
}

/// End of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// Its folder.
    pub run: PathBuf,
    /// Steps taken.
    pub iteration: usize,
    /// Gaussians at the end.
    pub gaussians: usize,
    /// Seconds of training, resumed ones included.
    pub seconds: f64,
    /// Whether it was stopped before its last step; `resume` continues it.
    pub interrupted: bool,
}

/// Share of the largest number of Gaussians from which on a run is at its cap.
const AT_CAP: f64 = 0.98;
/// PSNR of training views below which a cloud at its cap is too small, dB: a real room of 292 photos ends at 26.5 with
/// 30,000 Gaussians and at 27.4 with 150,000; captures that have enough end above 29
/// (studies/records/2026-11-26-real-size.md).
const UNDER_FITTED: f64 = 28.0;

/// Advice for a run that ends at its cap with blurred training views.
fn under_fitted(gaussians: usize, cap: usize, psnr: f64) -> Option<String> {
    let full = gaussians as f64 >= AT_CAP * cap as f64;
    (full && psnr < UNDER_FITTED).then(|| {
        format!(
            "training views reach only {psnr:.1} dB with all {cap} Gaussians in use: more Gaussians and more steps \
             give more detail (--minutes, --quality best, or --set densify.max_cap={})",
            2 * cap
        )
    })
}

/// Faults at which a run is given up.
pub(super) const MAX_STRIKES: usize = 3;
/// After a rollback rates are multiplied by this.
pub(super) const ROLLBACK_RATE: f64 = 0.5;
/// Weight of the newest step in smoothed numbers.
const SMOOTHING: f64 = 0.05;
/// Seconds between two progress events.
const PROGRESS_SECONDS: f64 = 0.25;
/// Loads the newest intact checkpoint. A damaged newest one is skipped with a warning.
pub(super) fn restore_newest(
    run: &Path,
    trainer: &mut Trainer<'_>,
    identity: &Identity,
) -> Result<(RunState, Option<String>)> {
    let mut first_error = None;
    for path in checkpoint::list(run).iter().rev() {
        let read = files::read(path)
            .and_then(|bytes| checkpoint::read(&bytes, trainer, identity).map_err(|e| e.at(path.display())));
        match read {
            Ok(state) => return Ok((state, first_error.map(|e: Error| e.to_string()))),
            // Another version or capture is not damage: older ones would fail alike.
            Err(e) if e.kind() == ErrorKind::Unsupported => return Err(e),
            Err(e) => first_error = first_error.or(Some(e)),
        }
    }
    Err(first_error.unwrap_or_else(|| {
        Error::input("there is no checkpoint to continue from").at(run.display()).remedy("Train from the start")
    }))
}

fn save_checkpoint(
    run: &Path,
    trainer: &Trainer<'_>,
    identity: &Identity,
    state: &RunState,
    listen: &mut dyn FnMut(&Event),
) -> Result<()> {
    let path = checkpoint::path(run, trainer.progress.iteration);
    write_atomically(&path, &checkpoint::write(trainer, identity, state)?)?;
    // The one before stays, in case this one is damaged on disk.
    let all = checkpoint::list(run);
    for old in all.iter().rev().skip(2) {
        let _ = std::fs::remove_file(old);
    }
    listen(&Event::Checkpoint { iteration: trainer.progress.iteration, path });
    Ok(())
}

/// Takes note of what steps measured, in their order.
fn note(measured: &[Measured], state: &mut RunState, metrics: &mut Metrics) {
    for m in measured {
        let fresh = if m.iteration <= 1 { 1.0 } else { SMOOTHING };
        for (old, new) in state.smooth.iter_mut().zip([m.loss, m.mse]) {
            *old += fresh * (new - *old);
        }
        metrics.measured(m);
    }
}

/// Seconds since the last lap, which begins again.
fn lap(clock: &Stopwatch, last: &mut f64) -> f64 {
    let now = clock.seconds();
    now - std::mem::replace(last, now)
}

/// A run while it is driven.
pub(super) struct Session<'a> {
    pub(super) run: &'a Path,
    pub(super) opened: &'a OpenCapture,
    pub(super) recipe: &'a Recipe,
    pub(super) identity: Identity,
    /// The verb that made it, and that continues it.
    pub(super) made_by: &'a str,
    /// Bytes of memory, estimated.
    pub(super) estimate: u64,
    pub(super) snapshots: Option<Duration>,
    pub(super) clock: Stopwatch,
    /// The time that it is to keep to.
    pub(super) budget: Option<Budget>,
    /// Whether its caller brought a loss along.
    pub(super) own_loss: bool,
    pub(super) stop: &'a AtomicBool,
}

impl Session<'_> {
    /// Makes the folder of a run that has not taken a step.
    pub(super) fn begin(&self, trainer: &Trainer<'_>, listen: &mut dyn FnMut(&Event)) -> Result<RunState> {
        self.write_recipe(self.recipe)?;
        let state = RunState::default();
        // Where there is a checkpoint, there is all that continuing needs.
        self.write_info(&Totals::default(), trainer, &state, false)?;
        save_checkpoint(self.run, trainer, &self.identity, &state, listen)?;
        Ok(state)
    }

    fn write_recipe(&self, recipe: &Recipe) -> Result<()> {
        write_atomically(&self.run.join("recipe.toml"), recipe.to_toml().as_bytes())
    }

    /// Loads the newest intact checkpoint, and warns of what was skipped.
    pub(super) fn restore(&self, trainer: &mut Trainer<'_>, listen: &mut dyn FnMut(&Event)) -> Result<RunState> {
        let (state, warning) = restore_newest(self.run, trainer, &self.identity)?;
        if let Some(message) = warning {
            listen(&Event::Warning { message });
        }
        Ok(state)
    }

    /// Steps until all stages are done or a stop is requested.
    pub(super) fn drive(
        &self,
        trainer: &mut Trainer<'_>,
        mut state: RunState,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<Outcome> {
        let iterations = trainer.iterations();
        let first = trainer.progress.iteration;
        listen(&Event::Started {
            run: self.run.to_owned(),
            iteration: first,
            iterations,
            gaussians: trainer.scene().len(),
            memory_estimate: self.estimate,
        });
        self.report_device(trainer, listen);
        let mut metrics = Metrics::open(self.run, first, iterations);
        let mut totals = Totals::default();
        let shown = trainer.scene().without_head("the player");
        if let (Some(_), Err(e)) = (self.snapshots, &shown) {
            listen(&Event::Warning { message: format!("training cannot be watched: {e}") });
        }
        let interval = self.snapshots.filter(|_| shown.is_ok());
        let antialias = if self.recipe.appearance.antialias { Antialias::On } else { Antialias::Off };
        let mut snapshots = interval.map(|interval| Snapshots::new(interval, &self.opened.capture, antialias));
        let (mut clock, mut reported) = (self.clock.seconds(), Clock::now());
        // A run that was continued has a clock that began later than its first command.
        let lead = self.budget.filter(|_| first > 0).map_or(0.0, |b| b.before + state.seconds - clock);
        let mut recipe = self.recipe.clone();
        let mut planner = self.budget.map(|b| Planner::new(b, clock + lead, recipe.run.replans.rows()));
        let (mut steps, mut warned) = (StepTimes::default(), false);
        while !trainer.is_done() && !self.stop.load(Ordering::Relaxed) {
            let from = (trainer.progress.stage, trainer.progress.iteration);
            let between = self.clock.seconds() - clock;
            trainer.enter(&mut Progress(listen))?;
            state.seconds += lap(&self.clock, &mut clock);
            if trainer.is_done() {
                break;
            }
            let entered = from == (0, 0) || from.0 != trainer.progress.stage || trainer.progress.taken == 0;
            let here = Place::of(trainer);
            let (full_size, expected) =
                (here.is_full_size(), self.budget.map_or(0.0, |b| here.step_seconds(&b.timing)));
            let step = match trainer.step()? {
                Ok(step) => step,
                // A step in which a stop was requested, such as by a failed loss, is invalid and does not count.
                Err(_) if self.stop.load(Ordering::Relaxed) => {
                    state = self.restore(trainer, listen)?;
                    metrics.rewind(trainer.progress.iteration);
                    break;
                }
                Err(fault) => {
                    state = self.roll_back(trainer, &fault, listen)?;
                    metrics.rewind(trainer.progress.iteration);
                    continue;
                }
            };
            let seconds = lap(&self.clock, &mut clock);
            steps.add(full_size, seconds);
            state.seconds += seconds;
            if let Some(planner) = &mut planner {
                planner.add(between + seconds, expected);
                if let Some(new) = planner.replan(clock + lead, &Place::of(trainer)) {
                    recipe.run.replans.push(new.row);
                    // The plan on disk equals the one in use.
                    self.write_recipe(&recipe)?;
                    trainer.replan(recipe.run.replans.rows());
                    if let Some(late) = new.late.filter(|_| !warned) {
                        warned = true;
                        let message = format!(
                            "this machine is too slow now for {} minutes: about {:.1} are needed. Give more --minutes, or \
                             use --downscale 2",
                            planner.minutes(),
                            late / 60.0
                        );
                        listen(&Event::Warning { message });
                    }
                    listen(&Event::Replanned {
                        iteration: new.row.at,
                        iterations: trainer.iterations(),
                        seconds: new.end,
                        minutes: planner.minutes(),
                    });
                }
            }
            for message in &step.notices {
                listen(&Event::Warning { message: message.clone() });
            }
            totals.add(&step);
            metrics.push(trainer, &step, &state);
            note(&step.measured, &mut state, &mut metrics);
            // A device's first steps are measured some steps later.
            let known = state.smooth != [0.0; 2];
            if known && reported.elapsed().as_secs_f64() > PROGRESS_SECONDS || trainer.is_done() {
                reported = Clock::now();
                let place = Place::of(trainer);
                let left = planner.as_ref().map_or_else(|| steps.left(&place), |p| p.left(&place));
                listen(&self.progress(trainer, &state, left));
            }
            let i = trainer.progress.iteration;
            // The start of a later stage may have taken long: it must not be repeated.
            let due = i.is_multiple_of(self.recipe.run.checkpoint_interval) || entered && i > 1;
            let looked_at = due || snapshots.as_ref().is_some_and(Snapshots::is_due);
            if looked_at {
                match trainer.settle() {
                    Ok(measured) => note(&measured, &mut state, &mut metrics),
                    Err(fault) => {
                        state = self.roll_back(trainer, &fault, listen)?;
                        metrics.rewind(trainer.progress.iteration);
                        continue;
                    }
                }
            }
            if let Some(event) = snapshots.as_mut().and_then(|s| s.take(trainer)) {
                listen(&event);
            }
            if due && !trainer.is_done() {
                self.save(trainer, &state, &metrics, &totals, false, listen)?;
            }
        }
        match trainer.settle() {
            Ok(measured) => note(&measured, &mut state, &mut metrics),
            Err(fault) => {
                state = self.roll_back(trainer, &fault, listen)?;
                metrics.rewind(trainer.progress.iteration);
            }
        }
        let done = trainer.is_done();
        self.save(trainer, &state, &metrics, &totals, done, listen)?;
        let gaussians = trainer.scene().len();
        let iteration = trainer.progress.iteration;
        if let Some(snapshots) = &mut snapshots {
            listen(&snapshots.now(trainer));
        }
        if done {
            let mut bytes = Vec::new();
            splat4d::format::scene::write(&trainer.shown(), &mut bytes)?;
            write_atomically(&self.run.join("scene.safetensors"), &bytes)?;
            if let Some((event, warning)) = measured::after(self.opened, &trainer.shown(), self.recipe, self.run)? {
                listen(&event);
                warning.into_iter().for_each(|message| listen(&Event::Warning { message }));
            }
            for message in priors::after(self.opened, &trainer.shown(), self.recipe)? {
                listen(&Event::Warning { message });
            }
            let advice = under_fitted(gaussians, self.recipe.densify.max_cap, psnr(state.smooth[1]));
            let (seconds, peak_memory) = (state.seconds, peak_memory());
            listen(&Event::Finished { iteration, seconds, gaussians, peak_memory, advice });
        }
        Ok(Outcome { run: self.run.to_owned(), iteration, gaussians, seconds: state.seconds, interrupted: !done })
    }

    /// Reports the device if it was requested or has changed.
    fn report_device(&self, trainer: &Trainer<'_>, listen: &mut dyn FnMut(&Event)) {
        let device = &trainer.device;
        // Older runs, from before other devices existed, name none.
        let info = read_info(self.run).unwrap_or_default();
        let before = info["device"].as_str().unwrap_or(&trainer.device.name);
        let mut why = device.why.clone();
        if before != device.name {
            why = format!("{why}; before it was {before}, and from here on the last bits may differ");
        } else if self.opened.device == Device::Cpu {
            return;
        }
        listen(&match device.missed && self.opened.device == Device::Gpu {
            true => Event::Warning { message: why },
            false => Event::Device { name: device.name.clone(), why },
        });
    }

    fn progress(&self, trainer: &Trainer<'_>, state: &RunState, seconds_left: f64) -> Event {
        let (iteration, iterations) = (trainer.progress.iteration, trainer.iterations());
        Event::Progress {
            iteration,
            iterations,
            stage: trainer.stage_name().to_owned(),
            loss: state.smooth[0],
            psnr: psnr(state.smooth[1]),
            gaussians: trainer.scene().len(),
            seconds: state.seconds,
            seconds_left,
        }
    }

    fn save(
        &self,
        trainer: &Trainer<'_>,
        state: &RunState,
        metrics: &Metrics,
        totals: &Totals,
        finished: bool,
        listen: &mut dyn FnMut(&Event),
    ) -> Result<()> {
        metrics.write(self.run)?;
        save_checkpoint(self.run, trainer, &self.identity, state, listen)?;
        corrected::write(self.run, trainer, &self.opened.capture)?;
        self.write_info(totals, trainer, state, finished)
    }

    /// run.json: the run's inputs and its state.
    fn write_info(&self, totals: &Totals, trainer: &Trainer<'_>, state: &RunState, finished: bool) -> Result<()> {
        let (capture, recipe) = (&self.opened.capture, self.recipe);
        let steps = totals.steps.max(1) as f64;
        let ms: serde_json::Map<String, serde_json::Value> =
            STAGE_NAMES.iter().zip(totals.seconds).map(|(n, s)| ((*n).to_owned(), json!(s * 1e3 / steps))).collect();
        let root = std::fs::canonicalize(&capture.root).unwrap_or_else(|_| capture.root.clone());
        let info = json!({
            "version": env!("CARGO_PKG_VERSION"),
            "made_by": self.made_by,
            "own_loss": self.own_loss,
            "capture": to_text(&root),
            "capture_name": capture.name,
            "capture_fingerprint": fingerprint(capture),
            ELSEWHERE: elsewhere(capture),
            "motion": recipe.run.motion.as_str(),
            "seed": recipe.run.seed,
            "simd": self.opened.simd.name(),
            "device": trainer.device.name,
            "threads": rayon::current_num_threads(),
            "iteration": trainer.progress.iteration,
            "iterations": trainer.iterations(),
            "gaussians": trainer.scene().len(),
            "seconds": state.seconds,
            "finished": finished,
            "rollbacks": trainer.progress.strikes,
            "peak_memory": peak_memory(),
            "memory_estimate": self.estimate,
            "ms_per_step": ms,
            "warnings": capture.warnings,
            "budget": self.budget,
        });
        let text = serde_json::to_string_pretty(&info).expect("plain data is JSON");
        write_atomically(&self.run.join("run.json"), text.as_bytes())
    }

    /// Back to the last checkpoint with half the rates; the third time the run is given up. A device that failed is not
    /// to blame for the numbers: the rates stay.
    fn roll_back(&self, trainer: &mut Trainer<'_>, fault: &Fault, listen: &mut dyn FnMut(&Event)) -> Result<RunState> {
        let Fault(what, blame, _) = fault;
        let (strike, share) = if *blame == Blame::Device { (0, 1.0) } else { (1, ROLLBACK_RATE) };
        let (failed, strikes, rate) =
            (trainer.progress.iteration + 1, trainer.progress.strikes + strike, trainer.progress.rate_scale);
        if strikes >= MAX_STRIKES {
            return Err(Error::new(
                ErrorKind::Diverged,
                format!("training diverged {strikes} times, last at iteration {failed}: {what}"),
            )
            .remedy(
                "Look for wrong poses with `splat4d info CAPTURE`, or lower rates.position_init and rates.scaling",
            ));
        }
        let (state, _) = restore_newest(self.run, trainer, &self.identity)?;
        trainer.progress.strikes = strikes;
        trainer.progress.rate_scale = rate * share;
        let (to, what) = (trainer.progress.iteration, what.to_owned());
        listen(&match blame {
            Blame::Numbers => Event::RolledBack { iteration: failed, to, what },
            Blame::Device => {
                let message = format!("{what}: training continues on the CPU, from its last checkpoint, of step {to}");
                Event::Warning { message }
            }
        });
        Ok(state)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clouds_that_are_too_small_are_reported() {
        let message = under_fitted(29_900, 30_000, 26.5).expect("at its cap and blurred");
        assert!(message.contains("26.5 dB") && message.contains("densify.max_cap=60000"), "{message}");
        assert_eq!(under_fitted(29_900, 30_000, 31.0), None, "sharp");
        assert_eq!(under_fitted(20_000, 30_000, 26.5), None, "not for want of Gaussians");
    }
}
