//! The fixed chain of one step: `motion.at → render → loss → render.backward → motion.backward`.
//!
//! Views and the queries of losses over several times are merged: one `prepare`, one `at` and one `backward` for every
//! distinct (layer, space, time), one `finish`.

use super::channels::{Channels, Source};
use super::lens::{Bend, Bent};
use super::shutter::{self, Average, Exposed, Share, Taken};
use crate::Result;
use crate::loss::image::{Channel, LossGrads, Shown};
pub(crate) use crate::loss::image::{ImageTerm, View};
pub(crate) use crate::loss::terms::{ParamLoss, Probe, ProbeLoss, StepInfo};
pub(crate) use crate::train_state::Observation;
use crate::train_state::StepGrads;
use splat4d::backward::sh_grads;
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::Real;
use splat4d::render::{Backend, Image, RenderGrads, Shot, Target};
use splat4d::scene::{Grads, Rows, Space, Splats, Table, Time};
use std::time::{Duration, Instant as Clock};

/// Times of a step's parts.
#[derive(Clone, Copy, Debug, Default)]
pub struct Timings {
    /// `prepare` and `at`.
    pub motion: Duration,
    /// Rendering; of a device that does it all at once also comparing and the renderer's VJP.
    pub render: Duration,
    /// Image, probe and parameter losses with their gradients.
    pub loss: Duration,
    /// The renderer's VJP.
    pub render_backward: Duration,
    /// The motion's VJP and `finish`.
    pub motion_backward: Duration,
}

/// The result of a step.
#[derive(Clone, Debug, Default)]
pub struct StepReport {
    /// All losses together.
    pub loss: f64,
    /// The image loss of every view.
    pub view_losses: Vec<f64>,
    /// dL/dt of every view's time: the same number for views at one time, which share it.
    pub d_times: Vec<f64>,
    /// dL/d pose of every view, left perturbation (ρ, θ).
    pub d_cameras: Vec<[f64; 6]>,
    /// dL/d logarithm of every view's focal lengths.
    pub d_focals: Vec<f64>,
    /// dL/d coefficients of every view's lens; 0 without one.
    pub d_lenses: Vec<[f64; 2]>,
    /// Times of the parts.
    pub timings: Timings,
}

impl StepReport {
    /// The gradients to what cameras learn.
    pub(crate) fn grads(&self) -> StepGrads<'_> {
        StepGrads {
            d_cameras: &self.d_cameras,
            d_focals: &self.d_focals,
            d_lenses: &self.d_lenses,
            d_times: &self.d_times,
        }
    }
}

/// The input of one step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Step<'a, F: Real> {
    /// The scene to render.
    pub scene: &'a Scene<F>,
    /// The views to compare it with.
    pub views: &'a [View<'a, F>],
    /// Stage and step.
    pub info: &'a StepInfo,
    /// Highest degree of spherical harmonics rendered.
    pub sh_degree: usize,
}

/// The losses of a step.
pub(crate) struct Losses<'a, F: Real> {
    /// Compares images.
    pub image: &'a mut dyn ImageTerm<F>,
    /// Losses over several times.
    pub probes: &'a [Box<dyn ProbeLoss<F>>],
    /// Losses on raw parameters.
    pub params: &'a [Box<dyn ParamLoss<F>>],
}

/// The chain's arena: reused from step to step.
#[derive(Default)]
pub(crate) struct Chain<F: Real = f32> {
    evaluation: Evaluation<F>,
    picture: Compared<F>,
    exposed: Exposed<F>,
    bent: Bent<F>,
    /// Number of `Motion::at` calls of the last step, for tests and reports.
    pub at_calls: usize,
}

/// The working state of a step, view after view.
struct Work<'a, F: Real> {
    backend: &'a mut dyn Backend<F>,
    image: &'a mut dyn ImageTerm<F>,
    /// Gradients of the layers.
    d: &'a mut [Grads<F>],
    observe: &'a mut dyn FnMut(Observation<'_, F>),
    report: StepReport,
}

impl<F: Real> Work<'_, F> {
    /// Adds the image loss of one view.
    fn record_loss(&mut self, value: f64) {
        self.report.loss += value;
        self.report.view_losses.push(value);
    }
}

impl<F: Real> Chain<F> {
    /// One step: adds all gradients to `d` (one per layer, cleared by the caller). `observe` is called with every view.
    ///
    /// Errors: those of the backend.
    pub(crate) fn step(
        &mut self,
        step: &Step<'_, F>,
        backend: &mut dyn Backend<F>,
        losses: &mut Losses<'_, F>,
        d: &mut [Grads<F>],
        observe: &mut dyn FnMut(Observation<'_, F>),
    ) -> Result<StepReport> {
        let Step { scene, views, info, .. } = *step;
        let mut work = Work { backend, image: &mut *losses.image, d, observe, report: StepReport::default() };
        let mut clock = Clock::now();
        let probes: Vec<Vec<Probe>> = losses.probes.iter().map(|l| l.probes(scene, info)).collect();
        self.request(step, work.image, &probes);
        self.evaluation.evaluate(&scene.layers);
        self.evaluation.activate(work.d);
        work.report.timings.motion = lap(&mut clock);
        for view in views {
            self.view(step, view, &mut work)?;
        }
        let Work { d, mut report, .. } = work;
        clock = Clock::now();
        for (loss, probes) in losses.probes.iter().zip(&probes).filter(|(_, probes)| !probes.is_empty()) {
            report.loss += self.probe(scene, loss.as_ref(), probes);
        }
        for loss in losses.params {
            report.loss += loss.eval(scene, info, d);
        }
        report.timings.loss += lap(&mut clock);
        self.evaluation.backward(&scene.layers, d);
        report.timings.motion_backward = lap(&mut clock);
        let d_time = |view: &View<'_, F>| -> f64 {
            shutter::times(view.t, view.shutter.as_ref()).map(|t| self.evaluation.d_time(t)).sum()
        };
        report.d_times.extend(views.iter().map(d_time));
        self.at_calls = self.evaluation.len();
        Ok(report)
    }

    /// Collects the queries: views need the rows that are alive, probes add their rows, channels other times.
    fn request(&mut self, step: &Step<'_, F>, image: &dyn ImageTerm<F>, probes: &[Vec<Probe>]) {
        self.evaluation.begin();
        for view in step.views {
            for t in shutter::times(view.t, view.shutter.as_ref()) {
                for (index, layer) in step.scene.layers.iter().enumerate() {
                    self.evaluation.request_active(index, layer, t);
                }
            }
        }
        for probe in probes.iter().flatten() {
            for &t in &probe.times {
                let rows = probe.rows.as_deref().map_or(Rows::All, Rows::Some);
                self.evaluation.request(probe.layer, probe.of, rows, t);
            }
        }
        for view in step.views {
            for t in image.needs(view).extra.iter().filter_map(|channel| channel.other_time(view)) {
                for i in self.queries_at(step.scene, view.t) {
                    self.evaluation.request_again(i, t);
                }
            }
        }
        let exposed: Vec<_> = step.views.iter().filter_map(|view| Some((view.t, view.shutter?))).collect();
        shutter::align(&mut self.evaluation, step.scene.layers.len(), &exposed);
    }

    /// By layer the query for its Gaussians at a time of this step.
    fn queries_at(&self, scene: &Scene<F>, t: Time) -> Vec<usize> {
        let query = |layer| self.evaluation.find(layer, Space::Gaussians, t).expect("every time of a step was queried");
        (0..scene.layers.len()).map(query).collect()
    }

    /// Renders one view, compares it, and takes the gradient back to its splats.
    fn view(&mut self, step: &Step<'_, F>, view: &View<'_, F>, work: &mut Work<'_, F>) -> Result<()> {
        let mut clock = Clock::now();
        let scene = step.scene;
        let asked = self.queries_at(scene, view.t);
        let source = Source { scene, view, asked: &asked };
        let needs = work.image.needs(view);
        let channels = Channels::new(&needs.extra, source, &self.evaluation);
        let (taken, layers, bend) = (Taken::of(view), scene.layers.len(), Bend::of(view.camera));
        let n = view.shutter.map_or(1, |shutter| shutter.subframes);
        let look =
            Look { view, sh_degree: step.sh_degree, depth: needs.depth, extra: channels.as_ref().map(|c| &c.table) };
        let target = if n == 1 && channels.is_none() && !needs.depth { work.image.target(view) } else { None };
        let mut compared = false;
        for k in 0..n {
            if let Some(taken) = taken {
                self.exposed.expose(&self.evaluation, layers, taken, k);
            }
            let mut splats = self.exposed.shown(&self.evaluation, scene, view.t, taken.is_some());
            if let Some(bend) = &bend {
                self.bent.bend(&mut splats, bend);
            }
            let shot = look.shot(&splats);
            compared = match &target {
                Some(target) => self.picture.compare_there(view, &shot, target, work)?,
                None => false,
            };
            if !compared {
                self.picture.render(&shot, [k, n], work)?;
            }
        }
        if !compared {
            work.report.timings.render += lap(&mut clock);
            self.picture.compare(step.info, view, channels.as_ref().map_or(&[], |c| &c.places), work);
            work.report.timings.loss += lap(&mut clock);
        }
        let (mut camera, mut focal, mut lens) = ([0.0; 6], 0.0, [0.0; 2]);
        for k in (0..n).rev() {
            // The backend still has the last subframe.
            let again = k + 1 < n;
            if let Some(taken) = taken.filter(|_| again) {
                self.exposed.expose(&self.evaluation, layers, taken, k);
            }
            let mut splats = self.exposed.shown(&self.evaluation, scene, view.t, taken.is_some());
            if let Some(bend) = &bend {
                self.bent.bend(&mut splats, bend);
            }
            let shot = look.shot(&splats);
            if again {
                work.backend.render(&shot, &mut self.picture.part)?;
            }
            if !compared {
                self.picture.backward(&shot, n, work)?;
            }
            work.report.timings.render += if compared { lap(&mut clock) } else { Duration::ZERO };
            drop(splats);
            if let Some(bend) = &bend {
                let d_k = self.bent.backward(&mut self.picture.d_splats, bend);
                (0..2).for_each(|i| lens[i] += d_k[i]);
            }
            (0..6).for_each(|i| camera[i] += self.picture.d_splats.camera[i]);
            focal += self.picture.d_splats.focal;
            if n > 1 {
                self.picture.tally(again, work.backend.radii());
            } else {
                self.picture.report_visibility(&self.evaluation, &asked, work);
            }
            let d_splats = &mut self.picture.d_splats;
            match taken {
                None => d_splats.add_to(scene, view.t, &mut self.evaluation, work.d),
                Some(taken) => self.exposed.backward(d_splats, scene, taken, &mut self.evaluation, work.d),
            }
            if let (Some(channels), Some(d_table)) = (&channels, self.picture.d_channels()) {
                channels.backward(d_table, source, &mut self.evaluation, work.d);
            }
        }
        if n > 1 {
            self.picture.report_visibility(&self.evaluation, &asked, work);
        }
        work.report.d_cameras.push(camera);
        work.report.d_focals.push(focal);
        work.report.d_lenses.push(lens);
        work.report.timings.render_backward += lap(&mut clock);
        Ok(())
    }

    /// Shows a loss the rows it requested and scatters its gradient back.
    fn probe(&mut self, scene: &Scene<F>, loss: &dyn ProbeLoss<F>, probes: &[Probe]) -> f64 {
        let mut places = Vec::new();
        let mut seen = Vec::new();
        for probe in probes {
            let mut tables = Vec::new();
            let mut place = Vec::new();
            for &t in &probe.times {
                let i = self.evaluation.find(probe.layer, probe.of, t).expect("every probe's time was queried");
                let tape = self.evaluation.tape(i);
                let index: Vec<u32> = match (tape.rows(), &probe.rows) {
                    (_, None) => (0..tape.out().rows() as u32).collect(),
                    (Rows::All, Some(rows)) => rows.clone(),
                    (Rows::Some(ids), Some(rows)) => rows
                        .iter()
                        .map(|r| ids.binary_search(r).expect("the requested rows contain the probe's rows") as u32)
                        .collect(),
                };
                tables.push(tape.out().gather(&index));
                place.push((i, index));
            }
            seen.push(tables);
            places.push(place);
        }
        let mut d: Vec<Vec<Table<F>>> = seen.iter().map(|t| t.iter().map(Table::zeros_like).collect()).collect();
        let value = loss.eval(scene, probes, &seen, &mut d);
        for (place, tables) in places.iter().zip(&d) {
            for ((i, index), table) in place.iter().zip(tables) {
                let d_out = self.evaluation.d_out(*i);
                for (j, &row) in index.iter().enumerate() {
                    d_out.add(row as usize, 0, table.read::<10>(j, 0));
                }
            }
        }
        value
    }
}

/// What is rendered of a view.
struct Look<'a, F: Real> {
    view: &'a View<'a, F>,
    sh_degree: usize,
    depth: bool,
    extra: Option<&'a Table<F>>,
}

impl<'a, F: Real> Look<'a, F> {
    fn shot(&self, splats: &'a Splats<'a, F>) -> Shot<'a, F> {
        let Look { view, sh_degree, depth, extra } = *self;
        Shot { extra, sh_degree, depth, ..Shot::new(splats, view.camera, view.background) }
    }
}

/// An image, and the gradients to it and to its splats.
#[derive(Default)]
struct Compared<F> {
    image: Image<F>,
    d_image: LossGrads<F>,
    d_splats: RenderGrads<F>,
    /// A subframe, where the image is an average of several.
    part: Image<F>,
    average: Average<F>,
    share: Share<F>,
    /// By splat, over all subframes: sums of [`RenderGrads::mean2d`], and largest radii. Empty: there is one.
    mean2d: Vec<F>,
    radii: Vec<F>,
}

impl<F: Real> Compared<F> {
    /// Renders subframe k of n.
    fn render(&mut self, shot: &Shot<'_, F>, [k, n]: [usize; 2], work: &mut Work<'_, F>) -> Result<()> {
        if n == 1 {
            return work.backend.render(shot, &mut self.image);
        }
        work.backend.render(shot, &mut self.part)?;
        self.average.add(&mut self.image, &self.part, [k, n]);
        Ok(())
    }

    /// Adds what a subframe saw of every splat; `again`: not the first one.
    fn tally(&mut self, again: bool, radii: &[F]) {
        if !again {
            self.mean2d.clone_from(&self.d_splats.mean2d);
            self.radii.clear();
            self.radii.extend_from_slice(radii);
            return;
        }
        self.mean2d.iter_mut().zip(&self.d_splats.mean2d).for_each(|(sum, x)| *sum += *x);
        self.radii.iter_mut().zip(radii).for_each(|(most, x)| *most = most.max(*x));
    }

    /// The image loss and its gradient.
    fn compare(&mut self, info: &StepInfo, view: &View<'_, F>, drawn: &[(Channel, usize)], work: &mut Work<'_, F>) {
        self.d_image.begin(&self.image);
        let value = work.image.eval(info, view, &Shown::new(&self.image, drawn), &mut self.d_image);
        work.record_loss(value);
    }

    /// Rendering, the image loss and the backend's VJP, all on its device. Returns whether it could.
    fn compare_there(
        &mut self,
        view: &View<'_, F>,
        shot: &Shot<'_, F>,
        target: &Target<'_, F>,
        work: &mut Work<'_, F>,
    ) -> Result<bool> {
        let mut d_sh = sh_grads(shot.splats, work.d);
        let Some(comparison) = work.backend.compare(shot, target, &mut d_sh, &mut self.d_splats)? else {
            return Ok(false);
        };
        let value = work.image.compared(view, &comparison);
        work.record_loss(value);
        Ok(true)
    }

    /// The backend's VJP of one of n subframes.
    fn backward(&mut self, shot: &Shot<'_, F>, n: usize, work: &mut Work<'_, F>) -> Result<()> {
        let mut d_sh = sh_grads(shot.splats, work.d);
        let grads = self.d_image.grads();
        if n == 1 {
            return work.backend.vjp(shot, &grads, &mut d_sh, &mut self.d_splats);
        }
        self.share.take(&grads, &self.part, &self.image, n);
        work.backend.vjp(shot, &self.share.grads(), &mut d_sh, &mut self.d_splats)
    }

    /// Passes to the observer what the view saw of every layer.
    fn report_visibility(&mut self, evaluation: &Evaluation<F>, asked: &[usize], work: &mut Work<'_, F>) {
        let several = !self.radii.is_empty();
        let mut first = 0;
        for (layer, &i) in asked.iter().enumerate() {
            let tape = evaluation.tape(i);
            let splats = first..first + tape.out().rows();
            first = splats.end;
            let (mean2d, radii) = match several {
                true => (&self.mean2d[..], &self.radii[..]),
                false => (&self.d_splats.mean2d[..], work.backend.radii()),
            };
            let (mean2d, radii) = (&mean2d[splats.clone()], &radii[splats]);
            (work.observe)(Observation { layer, rows: tape.rows(), mean2d, radii });
        }
        self.radii.clear();
    }

    /// The gradient to the further channels, if a term has examined them.
    fn d_channels(&self) -> Option<&Table<F>> {
        self.d_splats.extra.as_ref().filter(|_| self.d_image.extra.get().is_some())
    }
}

/// The time since the last lap.
fn lap(clock: &mut Clock) -> Duration {
    let now = Clock::now();
    now - std::mem::replace(clock, now)
}
