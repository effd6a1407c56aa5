//! [`DeviceEngine`]: steps on a device that keeps the tables, where a stage lets it; all others are the CPU's, with
//! whatever renders.

use super::batch::left_out;
use super::chain::ImageTerm;
use super::engine::{
    Blame, CpuEngine, Engine, Fault, Measured, Rates, StepPlan, Stepped, exposure_rate, noise_rate, noise_stream,
    rates_of,
};
use crate::loss::terms::ResidentLoss;
use crate::optim::{GAUSSIANS, corrections};
use crate::train_state::{Exposure, Parts, TrainState};
use crate::{ErrorKind, Result};
use splat4d::device::ResidentMotion;
use splat4d::layers::{ALPHA_MIN, ALWAYS};
use splat4d::render::{
    Antialias, Backend, KEPT, Moves, Resident, ResidentCameras, ResidentLayer, ResidentNoise, ResidentRule,
    ResidentStep, ResidentStepped, ResidentTable, ResidentTies, ResidentView, RowWeights, Target,
};
use splat4d::scene::life::LOG_WIDTH;
use splat4d::scene::{Key, LIFE, LifeKind};
use std::collections::VecDeque;
use std::time::Instant as Clock;

/// Owner of the newest numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Newest {
    /// The learner: what a device keeps is stale.
    TrainState,
    /// Both have the same.
    Both,
    /// The device: the learner is to be settled before it is examined.
    Device,
}

/// A step that the device is still at.
struct InFlight {
    /// From 1.
    iteration: usize,
    /// Share of D-SSIM in the loss, by view, and the frames.
    dssim: Vec<f64>,
    frames: Vec<usize>,
}

/// See the module's documentation.
pub(crate) struct DeviceEngine<'a> {
    cpu: CpuEngine<'a>,
    newest: Newest,
    /// Whether the device has failed or is out of memory.
    given_up: bool,
    /// Whether it was reported that the CPU keeps the tables.
    reported: bool,
    /// See [`rates_of`].
    rates: Rates,
    /// Tables that are kept, by layer.
    known: Vec<ResidentMotion>,
    under_way: VecDeque<InFlight>,
    /// Measurements of finished steps, not reported yet.
    ready: Vec<Measured>,
    /// Whether the last step was the device's.
    took: bool,
    /// Messages that are not reported yet.
    notices: Vec<String>,
}

impl<'a> DeviceEngine<'a> {
    /// An engine that renders with `backend`, and takes steps with it where it keeps tables.
    pub(crate) fn new(backend: Box<dyn Backend<f32> + 'a>) -> Self {
        let (cpu, rates) = (CpuEngine::new(backend), Rates::default());
        Self {
            cpu,
            newest: Newest::TrainState,
            given_up: false,
            reported: false,
            rates,
            known: Vec::new(),
            under_way: VecDeque::new(),
            ready: Vec::new(),
            took: false,
            notices: Vec::new(),
        }
    }

    /// Reports once why the CPU keeps the tables of a device that could.
    fn report(&mut self, why: &str, notices: &mut Vec<String>) {
        if !std::mem::replace(&mut self.reported, true) {
            notices.push(format!("the CPU keeps the tables and steps: {why}"));
        }
    }

    /// The step with the CPU's engine, on the learner's numbers.
    fn step_on_cpu(
        &mut self,
        train_state: &mut TrainState,
        plan: &mut StepPlan<'_>,
        notices: Vec<String>,
    ) -> Result<Result<Stepped, Fault>> {
        self.took = false;
        if plan.views.iter().any(left_out) {
            self.notices = notices;
            return Ok(Ok(Stepped { needs_images: true, ..Stepped::default() }));
        }
        let before = match self.settle(train_state) {
            Ok(measured) => measured,
            Err(fault) => return Ok(Err(fault)),
        };
        self.newest = Newest::TrainState;
        let stepped = self.cpu.step(train_state, plan)?;
        Ok(stepped.map(|s| Stepped {
            notices: notices.into_iter().chain(s.notices).collect(),
            measured: before.into_iter().chain(s.measured).collect(),
            ..s
        }))
    }

    /// Uploads the tables if the device's copy is stale.
    fn keep(&mut self, train_state: &TrainState, plan: &StepPlan<'_>) -> Result<()> {
        if self.newest != Newest::TrainState {
            return Ok(());
        }
        let scene = train_state.scene();
        let ties = plan.stage.params.iter().find_map(|loss| loss.ties(scene));
        let of_layer =
            |(i, known): (usize, &ResidentMotion)| kept(train_state, i, known, ties.as_ref().filter(|_| i == 0));
        let layers: Vec<ResidentLayer<'_>> = self.known.iter().enumerate().map(of_layer).collect();
        let resident = self.cpu.backend().resident().expect("only such a device keeps tables");
        let cameras = train_state.exposure.as_ref().map(|exposure| {
            let (params, moments) = (&exposure.params[exposure.key()], exposure.moments.table(exposure.key()));
            let table = ResidentTable { width: params.width(), params: params.data(), moments: moments.data() };
            ResidentCameras { count: params.rows(), table, held: exposure.trained() }
        });
        resident.keep(&layers, cameras.as_ref(), &corrections::<f32>(GAUSSIANS))?;
        self.newest = Newest::Both;
        Ok(())
    }

    /// Stores the measurements of finished steps. Errors: one is invalid.
    fn take_in(&mut self, train_state: &TrainState, done: Vec<ResidentStepped>) -> std::result::Result<(), Fault> {
        for stepped in done {
            let InFlight { iteration, dssim, frames } =
                self.under_way.pop_front().expect("what is done was begun before");
            let views = dssim.len();
            let mut now = Measured { iteration, loss: stepped.loss, ..Measured::default() };
            for (dssim, c) in dssim.into_iter().zip(&stepped.comparisons) {
                now.loss += (1.0 - dssim) * c.l1 + dssim * (1.0 - c.ssim);
                (now.l1, now.ssim) = (c.l1, c.ssim);
                now.mse += c.mse / views as f64;
            }
            let wrong = match stepped.bad {
                Some([layer, table, row]) => {
                    let params = &train_state.scene().layers[layer].params;
                    let column = self.known[layer].keys[table].map_or("?", |key| params.column_name(key, 0));
                    Some(format!("the table of `{column}` is not finite at Gaussian {row} of layer {layer}"))
                }
                None => (!now.loss.is_finite()).then(|| format!("the loss is {}", now.loss)),
            };
            if let Some(what) = wrong {
                return Err(Fault(format!("{what}, at step {iteration}"), Blame::Numbers, Some(frames)));
            }
            self.ready.push(now);
        }
        Ok(())
    }

    /// The fault of a device that failed with the only numbers, and is not used again.
    fn gone(&mut self, why: &str) -> Fault {
        self.given_up = true;
        self.cpu.leave_device();
        Fault(format!("the GPU that kept the tables failed ({why})"), Blame::Device, None)
    }
}

/// A layer as a device takes it over.
fn kept<'a>(
    train_state: &'a TrainState,
    index: usize,
    known: &ResidentMotion,
    ties: Option<&'a ResidentTies>,
) -> ResidentLayer<'a> {
    let layer = &train_state.scene().layers[index];
    let table = |key: Option<Key>| {
        key.map_or(ResidentTable::default(), |key| {
            let (params, moments) = (&layer.params[key], train_state.moments()[index].table(key));
            ResidentTable { width: params.width(), params: params.data(), moments: moments.data() }
        })
    };
    ResidentLayer {
        rows: layer.params.len(),
        moves: known.moves,
        life: layer.life,
        tables: known.keys.map(table),
        stats: train_state.stats().tables[index].data(),
        ties,
    }
}

/// All layers of a step for a device, or the reason why the CPU takes the step.
fn known(
    train_state: &TrainState,
    plan: &StepPlan<'_>,
    rates: &Rates,
) -> std::result::Result<Vec<ResidentMotion>, String> {
    let (stage, scene) = (&*plan.stage, train_state.scene());
    let of_stage = [
        (!stage.probes.is_empty(), "losses compare several times"),
        (stage.codec.is_some(), "renders use the decoded playback file"),
        (train_state.corrections.is_some(), "cameras are refined"),
        (scene.head_keys().is_some(), "a pixel head is trained"),
        (train_state.exposure.as_ref().is_some_and(Exposure::changes), "exposures change over time"),
        (plan.views.iter().any(|v| v.shutter.is_some()), "images have a rolling shutter or motion blur"),
    ];
    if let Some((_, why)) = of_stage.iter().find(|(is, _)| *is) {
        return Err((*why).into());
    }
    let mut all = Vec::new();
    for (layer, rates) in scene.layers.iter().zip(rates) {
        let Some(known) = ResidentMotion::new(layer, &plan.info.times) else {
            return Err(format!("the GPU does not support the motion model `{}`", layer.motion.spec().name()));
        };
        let plain = layer.masks.is_none() && layer.span == ALWAYS && layer.cross_fade == [0.0; 2];
        if !plain || !layer.frame.is_identity() {
            return Err(format!("layer `{}` has a time span or axes of its own", layer.name));
        }
        let learns = |key: &Key| rates.get(key.0 as usize).is_some_and(|r| r.iter().flatten().any(|r| *r != 0.0));
        if let Some(key) = layer.params.keys().filter(learns).find(|k| !known.keys.contains(&Some(*k))) {
            return Err(format!("the GPU does not train `{}`", layer.params.column_name(key, 0)));
        }
        all.push(known);
    }
    // Ties use the poses of a frame of all Gaussians.
    let posed = all.iter().zip(&scene.layers).all(|(k, l)| k.moves == Moves::Posed && l.life == LifeKind::Infinite);
    let knows = |kept: Option<ResidentLoss>| match kept {
        Some(ResidentLoss::Rows(_)) => true,
        Some(ResidentLoss::Ties) => posed && all.len() == 1,
        None => false,
    };
    match stage.params.iter().find(|loss| !knows(loss.kept())) {
        Some(loss) => Err(format!("the GPU does not support the loss `{}` on raw parameters", loss.name())),
        None => Ok(all),
    }
}

/// The losses on rows of a stage.
fn row_weights(plan: &StepPlan<'_>) -> RowWeights {
    plan.stage.params.iter().fold(RowWeights::default(), |sum, loss| match loss.kept() {
        Some(ResidentLoss::Rows(w)) => RowWeights {
            opacity: sum.opacity + w.opacity,
            entropy: sum.entropy + w.entropy,
            scale: sum.scale + w.scale,
        },
        _ => sum,
    })
}

/// The noise on the positions of a layer after a step.
fn noise(plan: &StepPlan<'_>, layer: usize) -> Option<ResidentNoise> {
    let rate = noise_rate(plan, layer)?;
    plan.stage.noise?.kept(rate, plan.min_opacity, noise_stream(plan).fork(layer as u64))
}

/// By layer and table, how it learns.
fn rules(
    train_state: &TrainState,
    plan: &StepPlan<'_>,
    rates: &Rates,
    known: &[ResidentMotion],
) -> Vec<[Option<ResidentRule>; KEPT]> {
    let of_layer = |(index, known): (usize, &ResidentMotion)| {
        let (layer, rates) = (&train_state.scene().layers[index], &rates[index]);
        known.keys.map(|key| {
            let key = key.filter(|&k| layer.params.info(k).trainable && layer.params[k].width() > 0)?;
            let rates = rates.get(key.0 as usize)?.clone().filter(|r| r.iter().any(|r| *r != 0.0))?;
            let floor = plan.stage.min_log_life.filter(|_| key == LIFE).map(|least| (LOG_WIDTH, least));
            Some(ResidentRule { rates, floor })
        })
    };
    known.iter().enumerate().map(of_layer).collect()
}

impl Engine for DeviceEngine<'_> {
    fn step(&mut self, train_state: &mut TrainState, plan: &mut StepPlan<'_>) -> Result<Result<Stepped, Fault>> {
        let mut notices = std::mem::take(&mut self.notices);
        if self.given_up || self.cpu.backend().resident().is_none() {
            return self.step_on_cpu(train_state, plan, notices);
        }
        rates_of(train_state.scene(), plan, &mut self.rates);
        let known = known(train_state, plan, &self.rates);
        let targets: Option<Vec<Target<'_>>> = {
            let exposure = train_state.parts_mut().exposure;
            let image = plan.loss.of_step(&mut plan.stage.pictures, exposure);
            plan.views.iter().map(|view| image.target(view)).collect()
        };
        let (known, targets) = match (known, targets) {
            (Ok(known), Some(targets)) => (known, targets),
            (known, _) => {
                // Losses on images are reported by the CPU's engine.
                if let Err(why) = known {
                    self.report(&why, &mut notices);
                }
                return self.step_on_cpu(train_state, plan, notices);
            }
        };
        if known != self.known {
            match self.settle(train_state) {
                Ok(measured) => self.ready = measured,
                Err(fault) => return Ok(Err(fault)),
            }
            (self.newest, self.known) = (Newest::TrainState, known);
        }
        let clock = Clock::now();
        if let Err(error) = self.keep(train_state, plan) {
            // It may well continue rendering.
            self.given_up = true;
            self.report(&error.cause(), &mut notices);
            return self.step_on_cpu(train_state, plan, notices);
        }
        let views: Vec<ResidentView<'_>> = plan
            .views
            .iter()
            .zip(targets)
            .map(|(v, target)| ResidentView { camera: v.camera, t: v.t, background: v.background, target, rig: v.rig })
            .collect();
        let rules = rules(train_state, plan, &self.rates, &self.known);
        let noise: Vec<_> = (0..rules.len()).map(|layer| noise(plan, layer)).collect();
        let step = ResidentStep {
            views: &views,
            sh_degree: plan.sh_degree,
            alpha_min: ALPHA_MIN,
            rules: &rules,
            rows: row_weights(plan),
            noise: &noise,
            cameras: exposure_rate(plan),
        };
        let resident = self.cpu.backend().resident().expect("it was there before");
        let done = match resident.step(&step) {
            Ok(Some(done)) => done,
            // An image too large for one buffer: the CPU's engine renders it in several.
            Ok(None) => return self.step_on_cpu(train_state, plan, notices),
            Err(error) => {
                if self.newest != Newest::Both {
                    return Ok(Err(self.gone(&error.cause())));
                }
                // Nothing is lost: the learner is as it was before this step.
                self.given_up = true;
                self.newest = Newest::TrainState;
                if error.kind() == ErrorKind::Memory {
                    // Rendering needs less of it.
                    self.report(&error.cause(), &mut notices);
                } else {
                    self.cpu.leave_device();
                    notices.push(format!("training continues on the CPU: {}", error.cause()));
                }
                return self.step_on_cpu(train_state, plan, notices);
            }
        };
        (self.newest, self.took) = (Newest::Device, true);
        self.under_way.push_back(InFlight {
            iteration: plan.info.iteration + 1,
            dssim: views.iter().map(|v| v.target.dssim).collect(),
            frames: plan.views.iter().map(|v| v.frame).collect(),
        });
        if let Err(fault) = self.take_in(train_state, done) {
            return Ok(Err(fault));
        }
        let measured = std::mem::take(&mut self.ready);
        let mut out = Stepped { notices, measured, ..Stepped::default() };
        out.report.timings.render = clock.elapsed();
        Ok(Ok(out))
    }

    fn changed(&mut self, train_state: &TrainState) {
        self.newest = Newest::TrainState;
        self.under_way.clear();
        self.ready.clear();
        self.cpu.changed(train_state);
    }

    fn catch_up(&mut self, train_state: &TrainState) -> std::result::Result<Vec<Measured>, Fault> {
        if !self.under_way.is_empty() {
            match self.cpu.backend().resident().map(|resident| resident.finish()) {
                Some(Ok(done)) => self.take_in(train_state, done)?,
                Some(Err(error)) => return Err(self.gone(&error.cause())),
                None => return Err(self.gone("it is no longer there")),
            }
        }
        Ok(std::mem::take(&mut self.ready))
    }

    fn settle(&mut self, train_state: &mut TrainState) -> std::result::Result<Vec<Measured>, Fault> {
        let measured = self.catch_up(train_state)?;
        if self.newest != Newest::Device {
            return Ok(measured);
        }
        let Parts { scene, moments, stats, exposure } = train_state.parts_mut();
        let fetched = match self.cpu.backend().resident() {
            None => Err("it is no longer there".to_owned()),
            Some(resident) => {
                let layers: Result<Vec<_>> = (0..scene.layers.len()).map(|layer| resident.fetch(layer)).collect();
                let all = layers.and_then(|layers| Ok((layers, resident.fetch_cameras()?)));
                all.map_err(|error| error.cause())
            }
        };
        let (layers, cameras) = match fetched {
            Ok(fetched) => fetched,
            Err(why) => return Err(self.gone(&why)),
        };
        for (index, (layer, numbers)) in scene.layers.iter_mut().zip(layers).enumerate() {
            for (table, key) in self.known[index].keys.into_iter().enumerate() {
                let Some(key) = key.filter(|&k| layer.params[k].width() > 0) else { continue };
                let [params] = layer.params.get_mut([key]);
                params.data_mut().copy_from_slice(&numbers.params[table]);
                moments[index].table_mut(key).data_mut().copy_from_slice(&numbers.moments[table]);
            }
            stats.tables[index].data_mut().copy_from_slice(&numbers.stats);
        }
        if let Some(exposure) = exposure {
            exposure.take_over(&cameras);
        }
        // The reader may change something, statistics too.
        self.newest = Newest::TrainState;
        Ok(measured)
    }

    fn holds(&mut self, frame: usize, size: [usize; 2], weighted: bool) -> bool {
        let keeps = |resident: &mut dyn Resident| resident.holds(frame, size, weighted);
        self.took && !self.given_up && self.cpu.backend().resident().is_some_and(keeps)
    }

    fn stages(&mut self) -> Vec<(&'static str, f64)> {
        self.cpu.backend().resident().map_or_else(Vec::new, |resident| resident.stages())
    }

    fn antialias(&self) -> Antialias {
        self.cpu.antialias()
    }
}
