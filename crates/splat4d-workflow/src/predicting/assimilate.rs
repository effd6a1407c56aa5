//! The chosen model, corrected by every new frame of the training cameras before it forecasts the next.

use super::score::{Case, Views, scores};
use super::{Forecast, Work};
use crate::deadline::unless_stopped;
use crate::draw::antialias;
use crate::events::Listener;
use crate::report::predict::ModelScores;
use splat4d::render::RenderConfig;
use splat4d::scene::{Camera, Time};
use splat4d::{Error, Result, device};
use splat4d_dynamics::assimilate::Filter;
use splat4d_dynamics::future::predicted;
use splat4d_dynamics::score::node_errors;
use splat4d_train::capture::frames::{Frames, Picture};
use splat4d_train::run::dataset::Dataset;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Forecasts one frame ahead, each from the corrected frame before, and their scores.
///
/// Errors: a model without nodes of its own, no images of training cameras in the future.
pub(super) fn run(
    work: &Work,
    of: &Forecast,
    views: &Views,
    baselines: [&Vec<Case>; 2],
    stop: &AtomicBool,
    console: &dyn Listener,
) -> Result<ModelScores> {
    if of.fitted.is_empty() {
        return Err(Error::input(format!("{} has no nodes that could be corrected", of.model.name()))
            .remedy("Choose another option `model` with option `assimilate`"));
    }
    let mut filter = Filter::new(&work.scene, &work.observed, work.clock);
    let mut paths = work.observed.paths.clone();
    let mut ahead = Vec::new();
    let actions = work.order.actions.as_ref();
    for h in 1..=work.horizon {
        unless_stopped(stop)?;
        console.phase("correcting by each new frame", h, work.horizon);
        let forecast = work.rollout(&of.fitted, &paths, actions, 1).0.swap_remove(0);
        ahead.push(forecast.clone());
        let frames = NewFrame::new(work, h, filter.time());
        if frames.is_empty() {
            break;
        }
        // An ensemble's open-loop variance shows how fast certainty is lost.
        let square = |h: usize, k: usize| of.spread.as_ref().map_or(0.0, |s| s[h][k].powi(2));
        let before = |k: usize| if h > 1 { square(h - 2, k) } else { 0.0 };
        let growth: Vec<f64> = (0..paths.nodes()).map(|k| square(h - 1, k) - before(k)).collect();
        let config = RenderConfig { antialias: antialias(work.antialias), ..RenderConfig::default() };
        let corrected = filter.update(&forecast, &growth, Arc::new(frames), device::cpu(config))?;
        paths.moments.push(corrected);
    }
    console.clear();
    let scene = predicted(&work.scene, &work.observed, &ahead, work.clock)?;
    let cases: Vec<Case> = views.cases(work, &scene, stop)?;
    let mut model_scores = scores(&format!("{}, assimilated", of.model.name()), &cases, baselines, work.horizon);
    model_scores.track_error = views.track_errors(work, &ahead);
    model_scores.node_error = work.oracle()?.map(|oracle| node_errors(&ahead, &work.follow(&oracle)));
    Ok(model_scores)
}

/// The images that training cameras take of one frame of the future, at the time that the filter requests.
struct NewFrame {
    pictures: Dataset,
    time: f64,
}

impl NewFrame {
    fn new(work: &Work, horizon: usize, time: f64) -> Self {
        let capture = &work.capture;
        let trained: BTreeSet<usize> = capture.train.iter().map(|&i| capture.frames[i].camera).collect();
        let frames = capture.future.iter().copied().filter(|&i| {
            let frame = &capture.frames[i];
            let at = ((frame.time.0 - work.clock.until) * work.clock.fps).round();
            trained.contains(&frame.camera) && at == horizon as f64
        });
        Self { pictures: Dataset::new(work.store.clone(), frames.collect()), time }
    }
}

impl Frames for NewFrame {
    fn len(&self) -> usize {
        self.pictures.len()
    }

    fn camera(&self, i: usize) -> &Camera {
        self.pictures.camera(i)
    }

    fn time(&self, _: usize) -> Time {
        Time(self.time)
    }

    fn rig(&self, i: usize) -> usize {
        self.pictures.rig(i)
    }

    fn name(&self, i: usize) -> String {
        self.pictures.name(i)
    }

    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        self.pictures.load(i, out)
    }
}
