//! [`DeviceEngine`]: steps on a device that keeps the tables, where a stage lets it; all others are the CPU's, with whatever
//! draws.

use super::chain::ImageTerm;
use super::engine::{
    Blame, CpuEngine, Engine, Fault, Rates, StepPlan, Stepped, learn_exposure, noise_rate, noise_stream, rates_of,
};
use crate::Result;
use crate::learner::{Learner, Parts};
use crate::loss::terms::KeptLoss;
use crate::optim::corrections;
use splat4d::layers::{ALPHA_MIN, ALWAYS, Layer};
use splat4d::motion::{Polynomial, Slices};
use splat4d::render::{
    Antialias, Backend, KEPT, KeptLayer, KeptNoise, KeptRule, KeptStep, KeptTable, KeptTies, KeptView, Moves,
    RowWeights, Target,
};
use splat4d::scene::life::LOG_WIDTH;
use splat4d::scene::{GEOMETRY, Key, LIFE, LifeKind, SH, Time};
use std::time::Instant as Clock;

/// Who has the newest numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Newest {
    /// The learner: what a device keeps is stale.
    Learner,
    /// Both have the same.
    Both,
    /// The device: the learner is to be settled before it is looked at.
    Device,
}

/// See the module's documentation.
pub(super) struct DeviceEngine<'a> {
    cpu: CpuEngine<'a>,
    newest: Newest,
    /// Whether the device has failed, or has no room.
    given_up: bool,
    /// Whether it was said that the CPU keeps the tables.
    told: bool,
    /// See [`rates_of`].
    rates: Rates,
    /// Tables that are kept, by layer.
    known: Vec<Known>,
}

impl<'a> DeviceEngine<'a> {
    /// An engine that draws with `backend`, and takes steps with it where it keeps tables.
    pub(super) fn new(backend: Box<dyn Backend<f32> + 'a>) -> Self {
        let (cpu, rates) = (CpuEngine::new(backend), Rates::default());
        Self { cpu, newest: Newest::Learner, given_up: false, told: false, rates, known: Vec::new() }
    }

    /// Tells once why the CPU keeps the tables of a device that could.
    fn tell(&mut self, why: &str, notices: &mut Vec<String>) {
        if !std::mem::replace(&mut self.told, true) {
            notices.push(format!("the CPU keeps the tables and steps: {why}"));
        }
    }

    /// The step with the CPU's engine, on the learner's numbers.
    fn step_on_cpu(
        &mut self,
        learner: &mut Learner,
        plan: &mut StepPlan<'_>,
        notices: Vec<String>,
    ) -> Result<Result<Stepped, Fault>> {
        if let Err(fault) = self.settle(learner) {
            return Ok(Err(fault));
        }
        self.newest = Newest::Learner;
        let stepped = self.cpu.step(learner, plan)?;
        Ok(stepped.map(|s| Stepped { notices: notices.into_iter().chain(s.notices).collect(), ..s }))
    }

    /// Hands the tables over, if what is kept is stale.
    fn keep(&mut self, learner: &Learner, plan: &StepPlan<'_>) -> Result<()> {
        if self.newest != Newest::Learner {
            return Ok(());
        }
        let scene = learner.scene();
        let ties = plan.stage.params.iter().find_map(|loss| loss.ties(scene));
        let of_layer = |(i, known): (usize, &Known)| kept(learner, i, known, ties.as_ref().filter(|_| i == 0));
        let layers: Vec<KeptLayer<'_>> = self.known.iter().enumerate().map(of_layer).collect();
        let resident = self.cpu.backend().resident().expect("only such a device keeps tables");
        resident.keep(&layers, &corrections::<f32>())?;
        self.newest = Newest::Both;
        Ok(())
    }
}

/// What a device knows of a layer: its motion, and its tables in the order of [`KEPT`].
#[derive(Clone, Debug, PartialEq)]
struct Known {
    moves: Moves,
    keys: [Option<Key>; KEPT],
}

impl Known {
    /// As all these times see it; none: no device knows such motion.
    fn new(layer: &Layer<f32>, times: &[Time]) -> Option<Self> {
        let life = (layer.life != LifeKind::Infinite).then_some(LIFE);
        let known =
            |moves, own: [Option<Key>; 2]| Self { moves, keys: [Some(GEOMETRY), life, own[0], own[1], Some(SH)] };
        let still = Moves::Along { order: 0, rotation: false, detach: false, origin: 0.0 };
        if let Some(polynomial) = layer.motion.polynomial() {
            let Polynomial { order, velocities, rotation_rates, origin, detached } = polynomial;
            let moves = Moves::Along { order, rotation: rotation_rates.is_some(), detach: detached, origin };
            return Some(known(moves, [velocities, rotation_rates]));
        }
        if let Some(Slices { own, speed, floor, ceiling, harmonics, period }) = layer.motion.slices() {
            return Some(known(Moves::Sliced { speed, floor, ceiling, harmonics, period }, [Some(own), None]));
        }
        // Pictures of several frames, or of a time between two, are the CPU's.
        let page = layer.motion.pose_table(*times.first()?)?;
        let one = times.iter().all(|t| layer.motion.pose_table(*t) == Some(page));
        one.then(|| match page {
            GEOMETRY => known(still, [None; 2]),
            _ => known(Moves::Posed, [Some(page), None]),
        })
    }
}

/// A layer as a device takes it over.
fn kept<'a>(learner: &'a Learner, index: usize, known: &Known, ties: Option<&'a KeptTies>) -> KeptLayer<'a> {
    let layer = &learner.scene().layers[index];
    let table = |key: Option<Key>| {
        key.map_or(KeptTable::default(), |key| {
            let (params, moments) = (&layer.params[key], learner.moments()[index].table(key));
            KeptTable { width: params.width(), params: params.data(), moments: moments.data() }
        })
    };
    KeptLayer {
        rows: layer.params.len(),
        moves: known.moves,
        life: layer.life,
        tables: known.keys.map(table),
        stats: learner.stats().tables[index].data(),
        ties,
    }
}

/// What a device knows of all layers for a step, or why the step is the CPU's.
fn known(learner: &Learner, plan: &StepPlan<'_>, rates: &Rates) -> std::result::Result<Vec<Known>, String> {
    let (stage, scene) = (&*plan.stage, learner.scene());
    let of_stage = [
        (!stage.probes.is_empty(), "losses look at several times"),
        (stage.codec.is_some(), "scenes are shown as their file will be read"),
        (learner.corrections.is_some(), "cameras learn"),
        (scene.head_keys().is_some(), "a pixel head learns"),
    ];
    if let Some((_, why)) = of_stage.iter().find(|(is, _)| *is) {
        return Err((*why).into());
    }
    let mut all = Vec::new();
    for (layer, rates) in scene.layers.iter().zip(rates) {
        let Some(known) = Known::new(layer, &plan.info.times) else {
            return Err(format!("the GPU does not know the motion of `{}`", layer.name));
        };
        let plain = layer.masks.is_none() && layer.span == ALWAYS && layer.cross_fade == [0.0; 2];
        if !plain || !layer.frame.is_identity() {
            return Err(format!("`{}` is seen for a part of the time, or in axes of its own", layer.name));
        }
        let learns = |key: &Key| rates.get(key.0 as usize).is_some_and(|r| r.iter().flatten().any(|r| *r != 0.0));
        if let Some(key) = layer.params.keys().filter(learns).find(|k| !known.keys.contains(&Some(*k))) {
            return Err(format!("`{}` learns, which the GPU does not know", layer.params.column_name(key, 0)));
        }
        all.push(known);
    }
    // Ties go by the poses of a frame, of Gaussians that are all there.
    let posed = all.iter().zip(&scene.layers).all(|(k, l)| k.moves == Moves::Posed && l.life == LifeKind::Infinite);
    let knows = |kept: Option<KeptLoss>| match kept {
        Some(KeptLoss::Rows(_)) => true,
        Some(KeptLoss::Ties) => posed && all.len() == 1,
        None => false,
    };
    match stage.params.iter().find(|loss| !knows(loss.kept())) {
        Some(loss) => Err(format!("the loss `{}` looks at raw numbers", loss.name())),
        None => Ok(all),
    }
}

/// The losses on rows of a stage.
fn row_weights(plan: &StepPlan<'_>) -> RowWeights {
    plan.stage.params.iter().fold(RowWeights::default(), |sum, loss| match loss.kept() {
        Some(KeptLoss::Rows(w)) => RowWeights {
            opacity: sum.opacity + w.opacity,
            entropy: sum.entropy + w.entropy,
            scale: sum.scale + w.scale,
        },
        _ => sum,
    })
}

/// The noise on the positions of a layer after a step.
fn noise(plan: &StepPlan<'_>, layer: usize) -> Option<KeptNoise> {
    let rate = noise_rate(plan, layer)?;
    plan.stage.noise?.kept(rate, plan.min_opacity, noise_stream(plan).fork(layer as u64))
}

/// By layer and table, how it learns.
fn rules(learner: &Learner, plan: &StepPlan<'_>, rates: &Rates, known: &[Known]) -> Vec<[Option<KeptRule>; KEPT]> {
    let of_layer = |(index, known): (usize, &Known)| {
        let (layer, rates) = (&learner.scene().layers[index], &rates[index]);
        known.keys.map(|key| {
            let key = key.filter(|&k| layer.params.info(k).trainable && layer.params[k].width() > 0)?;
            let rates = rates.get(key.0 as usize)?.clone().filter(|r| r.iter().any(|r| *r != 0.0))?;
            let floor = plan.stage.min_log_life.filter(|_| key == LIFE).map(|least| (LOG_WIDTH, least));
            Some(KeptRule { rates, floor })
        })
    };
    known.iter().enumerate().map(of_layer).collect()
}

impl Engine for DeviceEngine<'_> {
    fn step(&mut self, learner: &mut Learner, plan: &mut StepPlan<'_>) -> Result<Result<Stepped, Fault>> {
        let mut notices = Vec::new();
        if self.given_up || self.cpu.backend().resident().is_none() {
            return self.step_on_cpu(learner, plan, notices);
        }
        rates_of(learner.scene(), plan, &mut self.rates);
        let known = known(learner, plan, &self.rates);
        let targets: Option<Vec<Target<'_>>> = {
            let exposure = learner.parts_mut().exposure;
            let image = plan.loss.of_step(&mut plan.stage.pictures, exposure);
            plan.views.iter().map(|view| image.target(view)).collect()
        };
        let (known, targets) = match (known, targets) {
            (Ok(known), Some(targets)) => (known, targets),
            (known, _) => {
                // Of losses on pictures the CPU's engine tells.
                if let Err(why) = known {
                    self.tell(&why, &mut notices);
                }
                return self.step_on_cpu(learner, plan, notices);
            }
        };
        if known != self.known {
            if let Err(fault) = self.settle(learner) {
                return Ok(Err(fault));
            }
            (self.newest, self.known) = (Newest::Learner, known);
        }
        let clock = Clock::now();
        if let Err(error) = self.keep(learner, plan) {
            self.given_up = true;
            self.tell(&error.to_string(), &mut notices);
            return self.step_on_cpu(learner, plan, notices);
        }
        let views: Vec<KeptView<'_>> = plan
            .views
            .iter()
            .zip(targets)
            .map(|(v, target)| KeptView { camera: v.camera, t: v.t, background: v.background, target })
            .collect();
        let rules = rules(learner, plan, &self.rates, &self.known);
        let noise: Vec<_> = (0..rules.len()).map(|layer| noise(plan, layer)).collect();
        let step = KeptStep {
            views: &views,
            sh_degree: plan.sh_degree,
            alpha_min: ALPHA_MIN,
            rules: &rules,
            rows: row_weights(plan),
            noise: &noise,
        };
        let resident = self.cpu.backend().resident().expect("it was there before");
        let stepped = match resident.step(&step) {
            Ok(Some(stepped)) => stepped,
            // A picture too large for one piece: the CPU's engine draws it in several.
            Ok(None) => return self.step_on_cpu(learner, plan, notices),
            Err(error) => {
                self.given_up = true;
                if self.newest == Newest::Both {
                    // Nothing is lost: the learner is as it was before this step.
                    self.newest = Newest::Learner;
                    self.tell(&error.to_string(), &mut notices);
                    return self.step_on_cpu(learner, plan, notices);
                }
                return Ok(Err(gone(&error)));
            }
        };
        self.newest = Newest::Device;
        let stages = self.cpu.backend().resident().map_or_else(Vec::new, |resident| resident.stages());
        let mut out = Stepped { notices, stages, ..Stepped::default() };
        let Parts { scene, exposure, .. } = learner.parts_mut();
        let mut image = plan.loss.of_step(&mut plan.stage.pictures, exposure);
        for (view, comparison) in plan.views.iter().zip(&stepped.comparisons) {
            let value = image.compared(view, comparison);
            out.report.loss += value;
            out.report.view_losses.push(value);
        }
        out.report.loss += stepped.loss;
        (out.l1, out.ssim, out.mse) = (plan.loss.l1, plan.loss.ssim, plan.loss.mse());
        out.report.timings.render = clock.elapsed();
        if let Some([layer, table, row]) = stepped.bad {
            let params = &scene.layers[layer].params;
            let column = self.known[layer].keys[table].map_or("?", |key| params.column_name(key, 0));
            let what = format!("the table of `{column}` is not finite at Gaussian {row} of layer {layer}");
            return Ok(Err(Fault(what, Blame::Numbers)));
        }
        if !out.report.loss.is_finite() {
            return Ok(Err(Fault(format!("the loss is {}", out.report.loss), Blame::Numbers)));
        }
        learn_exposure(learner, plan);
        Ok(Ok(out))
    }

    fn changed(&mut self, learner: &Learner) {
        self.newest = Newest::Learner;
        self.cpu.changed(learner);
    }

    fn settle(&mut self, learner: &mut Learner) -> Result<(), Fault> {
        if self.newest != Newest::Device {
            return Ok(());
        }
        let Parts { scene, moments, stats, .. } = learner.parts_mut();
        for (index, layer) in scene.layers.iter_mut().enumerate() {
            let fetched = self.cpu.backend().resident().map(|resident| resident.fetch(index));
            let numbers = match fetched {
                Some(Ok(numbers)) => numbers,
                Some(Err(error)) => {
                    self.given_up = true;
                    return Err(gone(&error));
                }
                None => return Err(Fault("the GPU that kept the tables is gone".into(), Blame::Device)),
            };
            for (table, key) in self.known[index].keys.into_iter().enumerate() {
                let Some(key) = key.filter(|&k| layer.params[k].width() > 0) else { continue };
                let [params] = layer.params.get_mut([key]);
                params.data_mut().copy_from_slice(&numbers.params[table]);
                moments[index].table_mut(key).data_mut().copy_from_slice(&numbers.moments[table]);
            }
            stats.tables[index].data_mut().copy_from_slice(&numbers.stats);
        }
        // Whoever looks may change something, statistics too.
        self.newest = Newest::Learner;
        Ok(())
    }

    fn antialias(&self) -> Antialias {
        self.cpu.antialias()
    }
}

/// The fault of a device that failed with the only numbers.
fn gone(error: &crate::Error) -> Fault {
    Fault(format!("the GPU that kept the tables failed, and training goes on on the CPU: {error}"), Blame::Device)
}
