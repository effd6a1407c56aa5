//! [`Trainer`]: the state of a run and one step of it. Files, progress and clocks are the business of `run`.

use super::chain::{Chain, Losses, Step, StepInfo, StepReport, View};
use super::loss::TrainLoss;
use crate::capture::frames::{FlowTruth, Frames, Picture};
use crate::densify::{self, Change, Densify, Limits, Stats, adc, mcmc, morton_edit};
use crate::loss::terms::Codec;
use crate::methods::{Hook, Stage, Tell};
use crate::optim::{Floor, Moments};
use crate::prune::prune;
use crate::sampler::Timeline;
use crate::{Error, ErrorKind, Result};
use splat4d::layers::Scene;
use splat4d::math::Rng;
use splat4d::render::Backend;
use splat4d::scene::life::LOG_WIDTH;
use splat4d::scene::{Camera, GEOMETRY, Grads, LIFE, SH, Space, Time};
use std::borrow::Cow;
use std::sync::Arc;
use std::time::{Duration, Instant as Clock};

/// Settings that hold for all stages.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Seed of every random choice.
    pub seed: u64,
    /// Cap, extent and dead opacity.
    pub limits: Limits,
    /// Colour behind the scene.
    pub background: [f32; 3],
    /// Highest SH degree.
    pub sh_degree: usize,
    /// adc: steps between opacity resets; 0: never.
    pub opacity_reset_interval: usize,
    /// Rate of the exposure.
    pub exposure_lr: f64,
}

/// How far a run is. All of it is in every checkpoint.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Progress {
    /// Steps taken.
    pub iteration: usize,
    /// Current stage.
    pub stage: usize,
    /// Steps taken in it.
    pub stage_step: usize,
    /// Every rate is multiplied by this; halved after a rollback.
    pub rate_scale: f64,
    /// Rollbacks so far.
    pub strikes: usize,
}

/// What a step did.
#[derive(Clone, Debug, Default)]
pub struct Stepped {
    /// Losses, timings and gradients to times and cameras.
    pub report: StepReport,
    /// L1 of the last view.
    pub l1: f64,
    /// SSIM of the last view.
    pub ssim: f64,
    /// Mean squared error over the step's views.
    pub mse: f64,
    /// Loading pictures.
    pub load: Duration,
    /// Adam.
    pub adam: Duration,
    /// Densification, noise and the rest.
    pub other: Duration,
    /// Gaussians born, moved, removed.
    pub change: Change,
}

/// A number that was not finite: what, where, when.
#[derive(Clone, Debug)]
pub struct Fault(pub String);

/// The state of a run.
pub struct Trainer<'a> {
    /// The scene that learns.
    pub scene: Scene<f32>,
    /// What to do, in order.
    pub stages: Vec<Stage>,
    /// How far.
    pub progress: Progress,
    /// One a layer.
    pub moments: Vec<Moments<f32>>,
    /// What was seen since the last densification.
    pub stats: Stats,
    /// Compares pictures.
    pub loss: TrainLoss,
    /// Settings that hold for all stages.
    pub settings: Settings,
    /// What the stage's codec shows of the scene.
    shown: Scene<f32>,
    /// Whether `shown` is to be copied from the scene anew.
    stale: bool,
    /// Whether the current stage's start is over although it has taken no step.
    entered: bool,
    /// The step whose switches are over.
    switched: Option<usize>,
    frames: Arc<dyn Frames>,
    timeline: Timeline,
    draw: Box<dyn Backend<f32> + 'a>,
    grads: Vec<Grads<f32>>,
    /// Scratch: a rate a column, by layer and table.
    rates: Vec<Vec<Option<Vec<f64>>>>,
    chain: Chain<f32>,
    pictures: Vec<Picture>,
}

impl<'a> Trainer<'a> {
    /// A run that has not begun. Panics: no frames, no stages.
    pub fn new(
        scene: Scene<f32>,
        stages: Vec<Stage>,
        frames: Arc<dyn Frames>,
        draw: Box<dyn Backend<f32> + 'a>,
        loss: TrainLoss,
        settings: Settings,
    ) -> Self {
        assert!(!stages.is_empty(), "a program has at least one stage");
        let unframed = scene.layers.iter().all(|l| l.frame.is_identity());
        assert!(unframed, "training moves rows in the layers' own axes, which must be the world's");
        let timeline = Timeline::new(frames.as_ref());
        let mut trainer = Self {
            moments: Vec::new(),
            stats: Stats::new(&scene),
            scene,
            stages,
            progress: Progress { rate_scale: 1.0, ..Progress::default() },
            loss,
            settings,
            shown: Scene::default(),
            stale: true,
            entered: false,
            switched: None,
            frames,
            timeline,
            draw,
            grads: Vec::new(),
            rates: Vec::new(),
            chain: Chain::default(),
            pictures: Vec::new(),
        };
        trainer.adapt();
        trainer
    }

    /// Draws with another device from now on.
    #[cfg(test)]
    pub(super) fn set_draw(&mut self, draw: Box<dyn Backend<f32> + 'a>) {
        self.draw = draw;
    }

    /// Looks at other frames, of the same times, from now on.
    #[cfg(test)]
    pub(super) fn set_frames(&mut self, frames: Arc<dyn Frames>) {
        self.frames = frames;
    }

    /// Steps of all stages.
    pub fn iterations(&self) -> usize {
        self.stages.iter().map(|s| s.iterations).sum()
    }

    /// Whether every stage is done.
    pub fn is_done(&self) -> bool {
        self.progress.stage >= self.stages.len()
    }

    /// The stage's name.
    pub fn stage_name(&self) -> &str {
        self.stages.get(self.progress.stage).map_or("done", |s| &s.name)
    }

    /// Runs a hook; what of the moments belongs to layers of other names is forgotten, and losses are told if rows came or
    /// went.
    fn run_hook(&mut self, hook: impl Fn(&Stage) -> Option<&Hook<f32>>, tell: &mut Tell<'_>) -> Result<()> {
        let Some(hook) = hook(&self.stages[self.progress.stage]) else { return Ok(()) };
        let rows = |scene: &Scene<f32>| -> Vec<(String, usize)> {
            scene.layers.iter().map(|l| (l.name.clone(), l.params.len())).collect()
        };
        let before = rows(&self.scene);
        hook(&mut self.scene, tell)?;
        let after = rows(&self.scene);
        for ((moments, old), new) in self.moments.iter_mut().zip(&before).zip(&after) {
            if old.0 != new.0 {
                *moments = Moments::default();
            }
        }
        if before != after {
            self.stages[self.progress.stage].on_edit();
        }
        self.adapt();
        Ok(())
    }

    /// Fits gradients, moments and statistics to a scene that a hook changed; what still fits is kept.
    fn adapt(&mut self) {
        self.stale = true;
        self.moments.resize_with(self.scene.layers.len(), Moments::default);
        self.moments.truncate(self.scene.layers.len());
        let groups = self.stages.get(self.progress.stage).map_or(&[][..], |s| &s.groups);
        for (index, (layer, moments)) in self.scene.layers.iter().zip(&mut self.moments).enumerate() {
            let fresh = Moments::new(&layer.params);
            let old = std::mem::replace(moments, fresh);
            moments.adopt(old);
            moments.forget_pages(&layer.params, |c| groups.iter().any(|g| g.is_of(index) && g.column == c));
        }
        self.fit_grads();
        self.stats.clear(&self.scene);
    }

    /// Rows of the scene were edited: every loss is told, and what is derived of rows is made anew.
    fn edited(&mut self) {
        self.stages[self.progress.stage].on_edit();
        self.stale = true;
        self.fit_grads();
    }

    fn fit_grads(&mut self) {
        self.grads = self.scene.layers.iter().map(|l| Grads::new(&l.params)).collect();
    }

    /// Takes over a checkpoint's state. The scene and all tables must belong together.
    pub fn restore(&mut self, scene: Scene<f32>, moments: Vec<Moments<f32>>, stats: Stats, progress: Progress) {
        (self.scene, self.moments, self.stats, self.progress) = (scene, moments, stats, progress);
        (self.stale, self.entered, self.switched) = (true, false, None);
        self.fit_grads();
    }

    /// Runs the hooks that are due before the next step, through stages without steps. [`step`](Self::step) does so by
    /// itself, but tells nobody.
    pub fn enter(&mut self, tell: &mut Tell<'_>) -> Result<()> {
        while let Some(stage) = self.stages.get(self.progress.stage) {
            let (empty, switches) = (stage.iterations == 0, stage.switches.len());
            if self.progress.stage_step == 0 && !self.entered {
                self.run_hook(|s| s.start.as_ref(), tell)?;
                self.set_phase();
                (self.entered, self.stale) = (true, true);
            }
            if !empty {
                let step = self.progress.stage_step;
                if self.switched.replace(step) != Some(step) {
                    for i in 0..switches {
                        self.run_hook(|s| s.switches.get(i).filter(|(due, _)| *due == step).map(|(_, h)| h), tell)?;
                    }
                }
                return Ok(());
            }
            self.leave_stage(tell)?;
        }
        Ok(())
    }

    fn set_phase(&mut self) {
        let Some(phase) = self.stages[self.progress.stage].phase else { return };
        for layer in &mut self.scene.layers {
            if let Some(motion) = layer.motion.with_phase(&phase) {
                layer.motion = motion;
            }
        }
    }

    fn leave_stage(&mut self, tell: &mut Tell<'_>) -> Result<()> {
        self.run_hook(|s| s.end.as_ref(), tell)?;
        self.progress.stage += 1;
        self.progress.stage_step = 0;
        (self.entered, self.switched) = (false, None);
        Ok(())
    }

    /// The codec of the stage that runs, or of the last one when all is done.
    fn codec(&self) -> Option<&Arc<dyn Codec<f32>>> {
        let begun = self.progress.stage_step > 0 || self.entered || self.is_done();
        let stage = self.progress.stage.min(self.stages.len() - 1);
        self.stages[stage].codec.as_ref().filter(|_| begun)
    }

    /// The scene as pictures show it: as it will be read from its file, where the stage has a codec.
    pub fn shown(&self) -> Cow<'_, Scene<f32>> {
        self.codec().map_or(Cow::Borrowed(&self.scene), |c| Cow::Owned(c.whole(&self.scene)))
    }

    /// The frames that step `stage_step` of the current stage will see.
    fn draw_frames(&self, stage_step: usize) -> Vec<usize> {
        let s = &self.stages[self.progress.stage];
        let (seed, stage) = (self.settings.seed, self.progress.stage);
        self.timeline.draw(&s.sampler, s.batch, seed, stage, stage_step, s.iterations)
    }

    /// One step. Inner error: a number was not finite, nothing is to be trusted until a rollback.
    pub fn step(&mut self) -> Result<std::result::Result<Stepped, Fault>> {
        // On a thread of the pool a task costs next to nothing; from outside, each of a step's dozens of parallel loops
        // would put this thread to sleep and wake another one.
        rayon::scope(|_| self.step_in_pool())
    }

    fn step_in_pool(&mut self) -> Result<std::result::Result<Stepped, Fault>> {
        self.enter(&mut |_, _, _| {})?;
        let mut out = Stepped::default();
        if self.is_done() {
            return Ok(Ok(out));
        }
        let clock = Clock::now();
        let seen = self.draw_frames(self.progress.stage_step);
        self.pictures.resize_with(seen.len(), Picture::default);
        for (&i, picture) in seen.iter().zip(&mut self.pictures) {
            self.frames.load(i, picture)?;
        }
        if self.progress.stage_step + 1 < self.stages[self.progress.stage].iterations {
            self.frames.prefetch(&self.draw_frames(self.progress.stage_step + 1));
        }
        out.load = clock.elapsed();
        self.forward_backward(&seen, &mut out)?;
        let clock = Clock::now();
        let bad = self.learn();
        out.adam = clock.elapsed();
        if let Some(fault) = self.fault(&out.report, &bad, &seen) {
            return Ok(Err(fault));
        }
        let clock = Clock::now();
        out.change = self.maintain()?;
        if self.scene.is_empty() {
            return Ok(Err(Fault("not one Gaussian is left: all of them became transparent or huge".into())));
        }
        self.progress.iteration += 1;
        self.progress.stage_step += 1;
        if self.progress.stage_step == self.stages[self.progress.stage].iterations {
            self.leave_stage(&mut |_, _, _| {})?;
        }
        out.other += clock.elapsed();
        Ok(Ok(out))
    }

    fn forward_backward(&mut self, seen: &[usize], out: &mut Stepped) -> Result<()> {
        let stage = &mut self.stages[self.progress.stage];
        let background = self.settings.background;
        let half = self.progress.stage_step < stage.half_size_steps;
        let cameras: Vec<Camera> = seen
            .iter()
            .zip(&mut self.pictures)
            .map(|(&i, picture)| {
                let camera = self.frames.camera(i);
                if half && camera.width > 1 && camera.height > 1 {
                    picture.halve();
                    camera.downscaled(2)
                } else {
                    camera.clone()
                }
            })
            .collect();
        let width = stage.time_noise.width(self.progress.stage_step);
        let shift = match width > 0.0 {
            true => width * Rng::new(self.settings.seed, "time noise", self.progress.iteration as u64).normal(0),
            false => 0.0,
        };
        let views: Vec<View<'_, f32>> = seen
            .iter()
            .zip(&self.pictures)
            .zip(&cameras)
            .map(|((&i, picture), camera)| View {
                camera,
                t: Time(self.frames.time(i).0 + shift),
                background,
                truth: &picture.color,
                mask: picture.mask.as_ref(),
                weight: picture.weight.as_ref(),
                flow: picture.flow.as_ref().map(|f| FlowTruth { to: Time(f.to.0 + shift), ..f.truth() }),
                frame: i,
                rig: self.frames.rig(i),
            })
            .collect();
        let info = StepInfo {
            iteration: self.progress.iteration,
            times: views.iter().map(|v| v.t).collect(),
            seed: self.settings.seed,
            progress: self.progress.stage_step as f64 / stage.iterations as f64,
        };
        let sh_degree = match (stage.sh_from + self.progress.stage_step).checked_div(stage.sh_interval) {
            Some(unlocked) => unlocked.min(self.settings.sh_degree),
            None => self.settings.sh_degree,
        };
        let clock = Clock::now();
        if let Some(codec) = &stage.codec {
            if std::mem::take(&mut self.stale) {
                self.shown = self.scene.clone();
                codec.reset();
            }
            codec.show(&self.scene, &info.times, &mut self.shown);
        }
        out.other += clock.elapsed();
        let scene = if stage.codec.is_some() { &self.shown } else { &self.scene };
        let mut image = self.loss.of_step(&mut stage.pictures);
        let mut losses = Losses { image: &mut image, probes: &stage.probes, params: &stage.params };
        let stats = &mut self.stats;
        let step = Step { scene, views: &views, info: &info, sh_degree };
        out.report =
            self.chain.step(&step, self.draw.as_mut(), &mut losses, &mut self.grads, &mut |o| stats.observe(o))?;
        (out.l1, out.ssim, out.mse) = (self.loss.l1, self.loss.ssim, self.loss.mse());
        Ok(())
    }

    /// Adam on every group of the stage. Returns what was not finite.
    fn learn(&mut self) -> Vec<(usize, splat4d::scene::Key)> {
        let stage = &self.stages[self.progress.stage];
        let progress = self.progress.stage_step as f64 / stage.iterations as f64;
        let mut bad = Vec::new();
        if let Some(codec) = &stage.codec
            && !codec.learn(&mut self.grads, progress, self.progress.rate_scale)
        {
            bad.push((0, SH));
        }
        self.rates.resize_with(self.scene.layers.len(), Vec::new);
        for (index, layer) in self.scene.layers.iter_mut().enumerate() {
            let rates = &mut self.rates[index];
            rates.resize(layer.params.keys().count(), None);
            rates.iter_mut().flatten().for_each(|table| table.fill(0.0));
            let step = self.progress.stage_step;
            for group in stage.groups.iter().filter(|g| g.is_of(index) && g.from <= step) {
                let found = layer.params.keys().find_map(|k| layer.params[k].column(&group.column).map(|c| (k, c)));
                let Some((key, (first, width))) = found else { continue };
                let (from, count) = group.part.unwrap_or((0, width));
                let table = rates[key.0 as usize].get_or_insert_default();
                table.resize(layer.params[key].width(), 0.0);
                let end = (first + from + count).min(first + width);
                table[first + from..end].fill(group.rate.at(progress) * self.progress.rate_scale);
            }
            let floor = stage.min_log_life.filter(|_| layer.params[LIFE].width() > LOG_WIDTH);
            let floor = floor.map(|least| Floor { key: LIFE, column: LOG_WIDTH, least });
            let floors = floor.as_slice();
            let keys = self.moments[index].step(&mut layer.params, &mut self.grads[index], rates, floors);
            bad.extend(keys.into_iter().map(|k| (index, k)));
        }
        if let Some(exposure) = &mut self.loss.exposure {
            match stage.freeze_exposure {
                true => exposure.rest(),
                false => {
                    let _ = exposure.step(self.settings.exposure_lr * self.progress.rate_scale);
                }
            }
        }
        bad
    }

    /// Names the first number that is not finite, if the step was not sound.
    fn fault(&self, report: &StepReport, bad: &[(usize, splat4d::scene::Key)], seen: &[usize]) -> Option<Fault> {
        let views = || seen.iter().map(|&i| self.frames.name(i)).collect::<Vec<_>>().join(", ");
        let (layer, key) = match bad.first() {
            Some(&place) => place,
            None if report.loss.is_finite() => return None,
            None => return Some(Fault(format!("the loss is {} ({})", report.loss, views()))),
        };
        let params = &self.scene.layers[layer].params;
        let (row, col) = self.grads[layer]
            .table(key)
            .first_non_finite()
            .or_else(|| params[key].first_non_finite())
            .unwrap_or((0, 0));
        let column = params.column_name(key, col);
        Some(Fault(format!("`{column}` of Gaussian {row} of layer {layer} is not finite ({})", views())))
    }

    /// Noise, densification, pruning, resets, memory order; clears the gradients.
    fn maintain(&mut self) -> Result<Change> {
        let stage = &self.stages[self.progress.stage];
        let (step, seed) = (self.progress.stage_step + 1, self.settings.seed);
        let address = self.progress.iteration as u64;
        if let Densify::Mcmc(m) = &stage.densify {
            let rate = |layer: usize| {
                let group = stage.groups.iter().find(|g| g.is_of(layer) && g.column == "means")?;
                Some(group.rate.at(self.progress.stage_step as f64 / stage.iterations as f64))
            };
            for (index, layer) in self.scene.layers.iter_mut().enumerate() {
                let Some(rate) = rate(index) else { continue };
                let rng = Rng::new(seed, "noise", address).fork(index as u64);
                let active = self.grads[index].active(Space::Gaussians);
                mcmc::add_noise(layer, active, rate * m.noise_lr, self.settings.limits.min_opacity, rng);
            }
        }
        for (d, layer) in self.grads.iter_mut().zip(&self.scene.layers) {
            d.clear(&layer.params);
        }
        if let Some(adapt) = stage.adapt.as_ref().filter(|a| a.is_due(step)) {
            let rng = Rng::new(seed, "adapt", address);
            adapt.run(&mut self.scene, &mut self.moments, &mut self.stats, step, rng);
            self.edited();
        }
        // Before densification, which begins the statistics anew.
        let placed = self.place(step)?;
        let stage = &self.stages[self.progress.stage];
        let (from, until, every) = stage.densify_steps;
        let mut change = Change::default();
        let due = every > 0 && step >= from && step <= until && step.is_multiple_of(every);
        if due && stage.densify != Densify::None {
            change = stage.densify.run(
                &mut self.scene,
                &mut self.moments,
                &mut self.stats,
                &self.settings.limits,
                seed,
                address,
            );
            // The last densification leaves rows in Morton order for the rest of the run.
            if step + every > until {
                for layer in 0..self.scene.layers.len() {
                    let edit = morton_edit(&self.scene, layer);
                    densify::apply(
                        &mut self.scene,
                        &mut self.moments,
                        &mut self.stats,
                        layer,
                        &edit,
                        &Rng::new(seed, "order", address),
                    );
                }
            }
            self.edited();
        }
        change.removed += self.prune(step)?;
        change.removed += self.uncrowd(step);
        (change.added, change.moved) = (change.added + placed.added, change.moved + placed.moved);
        let stage = &self.stages[self.progress.stage];
        let reset = self.settings.opacity_reset_interval;
        if matches!(stage.densify, Densify::Adc(_)) && reset > 0 && step.is_multiple_of(reset) && step < until {
            adc::reset_opacity(&mut self.scene, &mut self.moments, 2.0 * self.settings.limits.min_opacity);
            self.stale = true;
        }
        Ok(change)
    }

    /// Relocation and guided sampling after so many steps of the stage, where they are due.
    fn place(&mut self, step: usize) -> Result<Change> {
        let stage = &self.stages[self.progress.stage];
        let (seed, address, limits) = (self.settings.seed, self.progress.iteration as u64, &self.settings.limits);
        let mut change = Change::default();
        let (scene, moments, stats) = (&mut self.scene, &mut self.moments, &mut self.stats);
        if let Some(relocate) = stage.relocate.filter(|r| r.is_due(step, stage.iterations)) {
            change = relocate.run(scene, moments, stats, limits, seed, address);
            let (_, until, every) = stage.densify_steps;
            if every == 0 || step >= until {
                stats.clear(scene);
            }
        }
        if let Some(guided) = stage.guided.filter(|g| g.is_due(step, stage.iterations)) {
            let antialias = self.draw.config().antialias;
            let frames = self.frames.as_ref();
            change.added = guided.run(scene, moments, stats, limits, frames, antialias, seed, address)?.added;
        }
        if change != Change::default() {
            self.edited();
        }
        Ok(change)
    }

    /// Pruning after so many steps of the stage, if it is due; returns how many rows went.
    fn prune(&mut self, step: usize) -> Result<usize> {
        let stage = &self.stages[self.progress.stage];
        let Some(periodic) = stage.prune.filter(|p| p.is_due(step, stage.iterations)) else { return Ok(0) };
        let before = self.scene.len();
        let scores = periodic.scores(&self.scene, self.frames.as_ref(), self.draw.config().antialias)?;
        let rng = Rng::new(self.settings.seed, "prune", self.progress.iteration as u64);
        for (layer, edit) in prune(&self.scene, &scores, periodic.ratio).iter().enumerate() {
            densify::apply(&mut self.scene, &mut self.moments, &mut self.stats, layer, edit, &rng);
        }
        self.edited();
        Ok(before - self.scene.len())
    }

    /// Pairs in one place after so many steps of the stage, if that is due; returns how many rows went.
    fn uncrowd(&mut self, step: usize) -> usize {
        let stage = &self.stages[self.progress.stage];
        let Some(rule) = stage.crowding.filter(|c| step.is_multiple_of(c.every) && step < stage.iterations) else {
            return 0;
        };
        let before = self.scene.len();
        let rng = Rng::new(self.settings.seed, "crowding", self.progress.iteration as u64);
        for layer in 0..self.scene.layers.len() {
            if let Some(edit) = rule.edit(&mut self.scene, layer) {
                densify::apply(&mut self.scene, &mut self.moments, &mut self.stats, layer, &edit, &rng);
            }
        }
        if self.scene.len() < before {
            self.edited();
        }
        before - self.scene.len()
    }

    /// Errors if the scene is empty: nothing could be learnt.
    pub fn check_not_empty(&self) -> Result<()> {
        if self.scene.layers.iter().all(|l| l.params[GEOMETRY].rows() == 0) {
            return Err(Error::new(ErrorKind::BadInput, "there is not one Gaussian to start from")
                .remedy("Give points, masks or --set init=random --set num_pts=10000"));
        }
        Ok(())
    }
}
