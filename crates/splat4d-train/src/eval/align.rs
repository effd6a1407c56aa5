//! Alignment of held-out views: only their poses and time offsets are fitted to the fixed scene. Otherwise a scene with
//! refined training cameras would be scored at unrefined held-out poses.

use crate::Result;
use crate::capture::{Capture, ImageStore};
use crate::loss::image::View;
use crate::loss::terms::StepInfo;
use crate::recipe::Recipe;
use crate::run::dataset::Dataset;
use crate::run::{learnable, plan, scale};
use crate::step::chain::{Chain, Losses, Step};
use crate::step::clocks::OffsetImages;
use crate::step::loss::TrainLoss;
use crate::train_state::{Corrections, Origin, RefineSettings, Scale};
use serde_json::Value;
use splat4d::layers::Scene;
use splat4d::render::Backend;
use splat4d::scene::{Grads, Planes};
use std::sync::Arc;

/// Share of D-SSIM in what is made small: none, since plain differences have the wider basin and cost less.
const DSSIM: f64 = 0.0;

/// Searches of a clock before its gradients are followed: far, then near ([`Corrections::search`]).
const SEARCHES: [usize; 2] = [0, usize::MAX];

/// Alignment of held-out views.
#[derive(Clone, Debug)]
pub struct Align {
    settings: RefineSettings,
    scale: Scale,
}

impl Align {
    /// As in a run with this recipe; `None` where it refined nothing.
    pub fn of(capture: &Capture, recipe: &Recipe) -> Option<Self> {
        let learnt = learnable(recipe);
        let wanted = (learnt.poses || learnt.times) && learnt.align_steps > 0 && !capture.train.is_empty();
        // The whole run is of use here: the scene has formed, and does not settle.
        let settings = RefineSettings { lens: false, poses_from: 0.0, times_from: 0.0, until: 1.0, ..learnt };
        wanted.then(|| Self { settings, scale: scale(&plan(capture, recipe)) })
    }

    /// The capture with these frames where the scene shows them best, and by how much they moved. Errors: images that
    /// cannot be read.
    pub(super) fn fit(
        &self,
        scene: &Scene<f32>,
        capture: &Capture,
        store: &Arc<ImageStore>,
        frames: &[usize],
        backend: &mut dyn Backend,
        report_progress: &mut dyn FnMut(usize, usize),
    ) -> Result<(Capture, Value)> {
        let info = |f: usize| &capture.frames[f];
        let fixed = |f: usize| capture.cameras[info(f).camera].fixed;
        let origins: Vec<Origin<'_>> = frames.iter().map(|&f| Origin::of(info(f), fixed(f))).collect();
        let mut found = Corrections::new(&self.settings, self.scale, &origins, capture.cameras.len(), false);
        if self.settings.times {
            let look = Dataset::new(store.clone(), frames.to_vec());
            for round in SEARCHES {
                let antialias = backend.config().antialias;
                let look = OffsetImages { frames: &look, corrections: &found, exposure: None, antialias };
                let shifts = look.shifts(scene, found.search(round))?;
                found.shift(&shifts);
            }
        }
        // Frames that share a pose take turns.
        let mut groups: Vec<(usize, Vec<usize>)> = Vec::new();
        for (place, &f) in frames.iter().enumerate() {
            let shared = groups.iter_mut().find(|(camera, _)| fixed(f) && *camera == info(f).camera);
            match shared {
                Some((_, places)) => places.push(place),
                None => groups.push((info(f).camera, vec![place])),
            }
        }
        let (mut chain, mut loss) = (Chain::default(), TrainLoss::photometric(DSSIM));
        let mut grads: Vec<Grads<f32>> = scene.layers.iter().map(|l| Grads::new(&l.params)).collect();
        let (mut truth, mut valid) = (Planes::default(), Planes::default());
        let steps = self.settings.align_steps;
        for (done, (_, places)) in groups.iter().enumerate() {
            for step in 0..steps {
                // Spread over the capture, so that all of its times are used even in few steps.
                let place = places[step * places.len() / steps.min(places.len()) % places.len()];
                let frame = info(frames[place]);
                let stored = store.load(frames[place])?;
                stored.color_into(&mut truth);
                let weight = stored.valid_into(&mut valid).then_some(&valid);
                let (camera, t) = (found.camera(place, &frame.view), found.time(place, frame.time));
                let view = View {
                    camera: &camera,
                    t,
                    background: scene.background,
                    truth: &truth,
                    mask: None,
                    weight,
                    depth: None,
                    flow: None,
                    measured: None,
                    tracks: None,
                    frame: place,
                    rig: frame.camera,
                    shutter: frame.shutter,
                };
                let progress = step as f64 / steps as f64;
                let now = StepInfo { iteration: step, times: vec![t], seed: 0, progress };
                let mut image = loss.of_step(&mut [], None);
                let mut losses = Losses { image: &mut image, probes: &[], params: &[] };
                let one = Step { scene, views: &[view], info: &now, sh_degree: usize::MAX };
                let report = chain.step(&one, backend, &mut losses, &mut grads, &mut |_| {})?;
                found.step(&[place], &report.grads(), progress, 1.0);
                grads.iter_mut().zip(&scene.layers).for_each(|(d, layer)| d.clear(&layer.params));
            }
            report_progress(done + 1, groups.len());
        }
        let mut aligned = capture.clone();
        for (place, &f) in frames.iter().enumerate() {
            aligned.frames[f].view = found.camera(place, &info(f).view);
            aligned.frames[f].time = found.time(place, info(f).time);
        }
        let name = |place: usize| {
            let frame = info(frames[place]);
            let camera = &capture.cameras[frame.camera];
            (camera.name.clone(), (!camera.fixed).then_some(frame.index))
        };
        let report = found.report(&name);
        Ok((aligned, report))
    }
}
