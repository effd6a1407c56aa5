//! [`OpenCapture`]: a capture as a recipe specifies, opened for training, and the objects built from it: plan, initial
//! scene, trainer.

use super::dataset::Dataset;
use crate::capture::frames::{Frames, Picture};
use crate::capture::{Capture, CaptureOptions, FlowSource, ImageStore, Lenses, frames, parsed_vignetting};
use crate::event::Event;
use crate::init::{self, Seeds, Source};
use crate::loss::image::terms;
use crate::maintenance::Limits;
use crate::methods::{Method, Stage, TrainContext, auto, stages};
use crate::recipe::{MotionName, Recipe};
use crate::step::emphasis::Emphasis;
use crate::step::loss::TrainLoss;
use crate::step::trainer::{Settings, TrainedOn, Trainer};
use crate::train_state::{Corrections, Exposure, Origin, RefineSettings, Scale};
use crate::{Error, Result};
use splat4d::device::{self, Device};
use splat4d::layers::Scene;
use splat4d::render::{Antialias, RenderConfig, Simd};
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

/// Images whose mean colour represents all of them.
const LOOKED_AT: usize = 16;

/// Extent of cameras in a single place, scene units.
const SINGLE_PLACE: f64 = 1e-6;

/// The options with which a recipe opens its capture.
pub(crate) fn capture_options(recipe: &Recipe) -> Result<CaptureOptions> {
    Ok(CaptureOptions {
        downscale: recipe.capture.downscale,
        hold_out: recipe.capture.hold_out.clone(),
        fps: (recipe.capture.fps > 0.0).then_some(recipe.capture.fps),
        sequence: recipe.capture.sequence,
        background: (!recipe.capture.white_background).then_some([0.0; 3]),
        near: recipe.capture.near,
        images: Some(recipe.capture.images.0.clone()).filter(|name| !name.is_empty()),
        poses: recipe.capture.poses,
        exif: recipe.capture.exif,
        borders: recipe.capture.borders,
        times: recipe.capture.times,
        unregistered: recipe.capture.unregistered,
        max_missing: recipe.capture.max_missing,
        readout: recipe.capture.rolling_shutter.then_some(recipe.capture.readout),
        exposure: recipe.capture.exposure_time,
        subframes: recipe.capture.subframes,
        vignetting: parsed_vignetting(&recipe.capture.vignetting.0)?,
        ..CaptureOptions::default()
    })
}

/// Opens a capture as a recipe specifies: scale, split, and the part of the capture that is used.
pub fn open_capture(path: &Path, recipe: &Recipe) -> Result<Capture> {
    open_frames(path, recipe, Vec::new(), &Lenses::default())
}

/// The same for a part of a long capture: only images with these frame numbers are listed ([`CaptureOptions::frames`]).
/// `lenses`: what another part of it found ([`Capture::lenses`]).
pub fn open_frames(path: &Path, recipe: &Recipe, frames: Vec<Range<usize>>, lenses: &Lenses) -> Result<Capture> {
    open_with(path, recipe, CaptureOptions { frames, lenses: lenses.clone(), ..capture_options(recipe)? })
}

/// The same with options of reading that may differ from the recipe's.
pub(super) fn open_with(path: &Path, recipe: &Recipe, options: CaptureOptions) -> Result<Capture> {
    let mut capture = Capture::open(path, &options)?;
    if recipe.loss.flow == 0.0 {
        // It is not used: it need not be decoded.
        capture.frames.iter_mut().for_each(|f| f.flow = None);
    }
    if recipe.loss.tracks == 0.0 {
        capture.frames.iter_mut().for_each(|f| f.tracks = None);
    }
    if recipe.loss.depth == 0.0 {
        capture.frames.iter_mut().for_each(|f| f.depth = None);
    }
    if recipe.loss.geometry == 0.0 {
        capture.geometry = None;
    }
    if recipe.capture.first_frame > 0 || recipe.capture.max_frames > 0 {
        let last = if recipe.capture.max_frames == 0 {
            usize::MAX
        } else {
            recipe.capture.first_frame.saturating_add(recipe.capture.max_frames)
        };
        let keep = |i: &usize| (recipe.capture.first_frame..last).contains(&capture.frames[*i].index);
        let (train, held) =
            (capture.train.iter().copied().filter(keep).collect(), capture.held.iter().copied().filter(keep).collect());
        let validation = capture.validation.iter().copied().filter(keep).collect();
        (capture.train, capture.held, capture.validation) = (train, held, validation);
        if capture.train.is_empty() {
            return Err(Error::input(format!(
                "no training frame is left of frames {}..{last}",
                recipe.capture.first_frame
            ))
            .remedy("Change first_frame or max_frames"));
        }
    }
    if recipe.capture.observe < 1.0 {
        capture.observe(recipe.capture.observe, recipe.capture.near)?;
    }
    Ok(capture)
}

/// Errors: a loss on flow or tracks, and not one training image has any.
pub(super) fn check_flow(capture: &Capture, recipe: &Recipe) -> Result<()> {
    if recipe.loss.tracks > 0.0 && capture.train.iter().all(|&i| capture.frames[i].tracks.is_none()) {
        return Err(Error::input("loss.tracks needs point tracks, and the capture's training cameras have none")
            .remedy("Give cameras `tracks` in capture.json (docs/priors.md), or leave loss.tracks at 0"));
    }
    let own = recipe.capture.flow == FlowSource::Own;
    if recipe.loss.flow == 0.0 || own || capture.train.iter().any(|&i| capture.frames[i].flow.is_some()) {
        return Ok(());
    }
    Err(Error::input("loss.flow needs optical flow, and the capture's training images have none").remedy(
        "Give cameras a `flow` in capture.json (docs/capture-format.md), compute it from the images with --set \
         capture.flow=own, or leave loss.flow at 0",
    ))
}

/// A capture opened for training: what fresh runs, resumes and probes share.
pub(crate) struct OpenCapture {
    pub(crate) capture: Arc<Capture>,
    pub(crate) frames: Arc<Dataset>,
    pub(crate) simd: Simd,
    /// The device of its trainers.
    pub(crate) device: Device,
}

/// The training frames of a capture, with as much memory for images as the recipe grants. Errors: there are none.
pub(crate) fn training_frames(capture: Arc<Capture>, recipe: &Recipe) -> Result<Arc<Dataset>> {
    if capture.train.is_empty() {
        return Err(Error::input("the capture has no training frames").remedy("Hold out fewer views with --hold-out"));
    }
    let store = Arc::new(ImageStore::new(capture.clone(), recipe.run.image_memory as usize));
    Ok(Arc::new(Dataset::new(store, capture.train.clone())))
}

/// The programs' plan for a capture and a recipe. Panics: the capture has no training frames.
pub fn plan(capture: &Capture, recipe: &Recipe) -> TrainContext {
    let mut times: Vec<f64> = capture.train.iter().map(|&i| capture.frames[i].time.0).collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    let clip = [times[0], times[times.len() - 1]];
    let fixed = |i: &&usize| capture.cameras[capture.frames[**i].camera].fixed;
    let mut seen: Vec<f64> = capture.train.iter().filter(fixed).map(|&i| capture.frames[i].time.0).collect();
    seen.sort_by(f64::total_cmp);
    // A fixed camera that is held out contributes nothing to training.
    let mut rigs: Vec<usize> = capture.train.iter().filter(fixed).map(|&i| capture.frames[i].camera).collect();
    rigs.sort_unstable();
    rigs.dedup();
    let of_rigs = capture.train.iter().map(|&i| (capture.frames[i].camera, capture.frames[i].time.0));
    let views = |t: f64| seen.partition_point(|s| *s <= t) - seen.partition_point(|s| *s < t);
    let moments = times.iter().map(|&t| (t, views(t))).collect();
    // Cameras that all have the same position carry no information about the scene's size.
    let (center, radius) = capture.center_and_radius();
    TrainContext {
        extent: if radius > SINGLE_PLACE { radius } else { 1.0 },
        center,
        clip,
        fps: capture.fps,
        times: if rigs.len() > 1 { frames::moments(of_rigs) } else { times.len() },
        fixed_cameras: rigs.len(),
        moments,
        masks: capture.background.is_some() || capture.train.iter().any(|&i| capture.frames[i].mask.is_some()),
        ..recipe.plan()
    }
}

/// The mean colour of some images, evenly chosen; of what lenses filled.
fn mean_color(frames: &dyn Frames) -> Result<[f32; 3]> {
    let mut picture = Picture::default();
    let (mut sums, mut pixels) = ([0.0f64; 3], 0.0f64);
    let looks = frames.len().min(LOOKED_AT);
    for k in 0..looks {
        frames.load(k * frames.len() / looks, &mut picture)?;
        let filled = |p: usize| picture.weight.as_ref().is_none_or(|w| w.data[p] > 0.0);
        for p in (0..picture.color.pixels()).filter(|p| filled(*p)) {
            pixels += 1.0;
            (0..3).for_each(|c| sums[c] += f64::from(picture.color.plane(c)[p]));
        }
    }
    Ok(sums.map(|s| (s / pixels.max(1.0)) as f32))
}

/// Corrections of cameras that a recipe enables. Clocks carry no information where nothing moves, and nothing can be
/// queried between the frames of a model that is learnt frame by frame.
pub(crate) fn learnable(recipe: &Recipe) -> RefineSettings {
    let timed = !["still", "tracked"].contains(&recipe.run.motion.as_str());
    RefineSettings { times: recipe.refine.times && timed, ..recipe.refine.clone() }
}

/// The scale of a plan's capture.
pub(crate) fn scale(plan: &TrainContext) -> Scale {
    Scale { extent: plan.extent, frame: if plan.fps > 0.0 { 1.0 / plan.fps } else { 1.0 } }
}

impl OpenCapture {
    pub(crate) fn new(capture: Arc<Capture>, recipe: &Recipe) -> Result<Self> {
        Ok(Self::with(training_frames(capture, recipe)?))
    }

    /// With frames that are shared.
    pub(crate) fn with(frames: Arc<Dataset>) -> Self {
        Self { capture: frames.capture().clone(), frames, simd: Simd::detect(), device: Device::Cpu }
    }

    /// The same, rendered by another device.
    pub(crate) fn on(self, device: Device) -> Self {
        Self { device, ..self }
    }

    pub(crate) fn plan(&self, recipe: &Recipe) -> TrainContext {
        plan(&self.capture, recipe)
    }

    /// The recipe with a motion model that suits the capture.
    pub(super) fn choose(&self, recipe: Recipe, listen: &mut dyn FnMut(&Event)) -> Result<Recipe> {
        let (recipe, choice) = self.chosen(recipe, listen)?;
        listen(&Event::Chosen { motion: choice.motion.into(), why: choice.why });
        Ok(recipe)
    }

    /// The recipe with a motion model that suits the capture, and why it is that one.
    pub(super) fn chosen(&self, recipe: Recipe, listen: &mut dyn FnMut(&Event)) -> Result<(Recipe, auto::Choice)> {
        listen(&Event::Phase { name: "examining the capture".into(), done: 0, total: 0 });
        let choice = auto::choose(&self.plan(&recipe), recipe.programs(), self.frames.as_ref())?;
        Ok((recipe.with(|r| r.run.motion = MotionName::of(choice.motion)), choice))
    }

    /// The background: that of cut-out images or, for full frames, their mean colour, which is the best estimate for
    /// pixels that no training camera sees. Errors: an image cannot be read.
    pub(super) fn background(&self) -> Result<[f32; 3]> {
        match self.capture.background {
            Some(own) => Ok(own),
            None => mean_color(self.frames.as_ref()),
        }
    }

    pub(crate) fn initial_scene(&self, recipe: &Recipe, plan: &TrainContext) -> Result<Scene<f32>> {
        let seeds = self.seeds(recipe, plan)?;
        self.scene(recipe, plan, recipe.program()?.as_ref(), &seeds, self.background()?)
    }

    /// The capture's scene with Gaussians at these seeds.
    pub(super) fn scene(
        &self,
        recipe: &Recipe,
        plan: &TrainContext,
        program: &dyn Method,
        seeds: &Seeds,
        background: [f32; 3],
    ) -> Result<Scene<f32>> {
        let scene = init::scene(plan, &recipe.init, program, seeds, background, self.capture.up)?;
        Ok(Scene { offset: self.capture.offset, ..scene })
    }

    /// Source of the first Gaussians of a plan.
    pub(super) fn seeds(&self, recipe: &Recipe, plan: &TrainContext) -> Result<Seeds> {
        let program = recipe.program()?;
        let moving = program.capabilities(plan).moves && plan.times > 1;
        let points = if let Source::File(path) = &recipe.init.source {
            let mut cloud = crate::capture::read_points(path)?;
            cloud.subtract(self.capture.offset);
            Some(Seeds::of(&cloud))
        } else {
            self.capture.points.as_ref().map(Seeds::of)
        };
        let mut points = points;
        if let (Some(points), true) = (&mut points, self.capture.geometry.is_some()) {
            init::scan::colour(self.frames.as_ref(), points)?;
        }
        let (first, frames) = (program.first(plan), self.frames.as_ref());
        match moving && program.one_time(plan) {
            true => init::one_time(&first, &recipe.initial(), frames, points),
            false => init::seeds(&first, &recipe.initial(), frames, points, moving),
        }
    }

    /// Corrections of cameras to learn, if enabled in the recipe.
    fn corrections(&self, recipe: &Recipe, plan: &TrainContext) -> Option<Corrections> {
        let settings = learnable(recipe);
        if !settings.any() {
            return None;
        }
        let origin = |&i: &usize| {
            let frame = &self.capture.frames[i];
            Origin::of(frame, self.capture.cameras[frame.camera].fixed)
        };
        let frames: Vec<Origin<'_>> = self.capture.train.iter().map(origin).collect();
        Some(Corrections::new(&settings, scale(plan), &frames, self.capture.cameras.len(), true))
    }

    pub(crate) fn trainer(&self, recipe: &Recipe, plan: &TrainContext, scene: Scene<f32>) -> Result<Trainer<'static>> {
        let program = recipe.program()?;
        let mut trainer = self.trainer_of(plan, scene, stages(program.as_ref(), plan));
        trainer.replan(recipe.run.replans.rows());
        trainer.train_state.corrections = self.corrections(recipe, plan);
        // What a still scene cannot show must not render it away from what it can.
        let strength = if program.capabilities(plan).moves { plan.common.loss.moving } else { 0.0 };
        trainer.emphasise(Emphasis::new(self.frames.as_ref(), strength)?);
        Ok(trainer)
    }

    /// A trainer with stages that no program made. Cameras stay where the capture has them.
    pub(crate) fn trainer_of(&self, plan: &TrainContext, scene: Scene<f32>, stages: Vec<Stage>) -> Trainer<'static> {
        let c = &plan.common;
        let config = RenderConfig {
            antialias: if c.appearance.antialias { Antialias::On } else { Antialias::Off },
            simd: self.simd,
            device_images: plan.device_images,
            ..RenderConfig::default()
        };
        let mut trained: Vec<usize> = self.capture.train.iter().map(|&i| self.capture.frames[i].camera).collect();
        trained.sort_unstable();
        // Cameras of a rig differ in colour, and one image of each shows it. Photos of one camera differ in exposure.
        let pictures = if self.capture.named || c.appearance.exposure_single { 1 } else { 2 };
        let trained: Vec<usize> =
            trained.chunk_by(|a, b| a == b).filter(|c| c.len() >= pictures).map(|c| c[0]).collect();
        // A single camera's matrix is its own mean, which stays the identity.
        let knots = if self.capture.of_photos() { 1 } else { c.appearance.exposure_knots };
        let cameras = self.capture.cameras.len();
        let exposure = (c.appearance.exposure && trained.len() > 1)
            .then(|| Exposure::over_time(cameras, &trained, knots, self.capture.time_range()));
        let settings = Settings {
            seed: plan.seed,
            limits: Limits { cap: c.densify.max_cap, extent: plan.extent, min_opacity: c.densify.min_opacity },
            background: scene.background,
            sh_degree: c.appearance.sh_degree,
            exposure_lr: c.appearance.exposure_lr,
        };
        let loss = TrainLoss::new(terms(&c.loss));
        let drawing = device::open_to_train(self.device, config);
        let mut trainer = Trainer::new(scene, stages, self.frames.clone(), drawing.backend, loss, settings);
        trainer.device = TrainedOn { name: drawing.name, why: drawing.why, missed: drawing.fell_back };
        trainer.train_state.exposure = exposure;
        trainer
    }
}
