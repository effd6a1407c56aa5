//! The tie of a chunk to a finished neighbour: a loss on the difference of their renders in the overlap.

use super::shared::read_file;
use crate::Result;
use crate::loss::image::{ImageTerm, LossGrads, Shown, View};
use crate::loss::terms::StepInfo;
use crate::run::identity::file_print;
use crate::train_state::Exposure;
use splat4d::device;
use splat4d::format::scene;
use splat4d::layers::{Evaluation, Scene};
use splat4d::render::{Backend, Image, RenderConfig, Shot};
use std::path::Path;
use std::sync::Arc;

/// A finished neighbour. Nothing of it learns.
pub(super) struct Neighbour {
    pub scene: Scene<f32>,
    /// First and last second that both see.
    pub window: [f64; 2],
    /// Fingerprint of its file.
    pub print: String,
}

impl Neighbour {
    pub(super) fn read(path: &Path, window: [f64; 2]) -> Result<Self> {
        let bytes = read_file(path)?;
        let scene = scene::read(&bytes).map_err(|e| e.at(path.display()))?;
        Ok(Self { scene, window, print: file_print(&bytes) })
    }
}

/// λ‖I − I'‖₁, the mean over pixels and channels of the difference to the neighbour's image I', as the camera
/// exposes both.
/// Source: render-space consistency of overlapping chunks; the neighbour has no gradient.
pub(super) struct Tie {
    weight: f64,
    neighbours: Arc<Vec<Neighbour>>,
    exposure: Option<Arc<Exposure>>,
    backend: Box<dyn Backend<f32>>,
    seen: Evaluation,
    image: Image<f32>,
}

impl Tie {
    pub(super) fn new(
        weight: f64,
        neighbours: Arc<Vec<Neighbour>>,
        exposure: Option<Arc<Exposure>>,
        config: RenderConfig,
    ) -> Self {
        let (backend, seen, image) = (device::cpu(config), Evaluation::default(), Image::default());
        Self { weight, neighbours, exposure, backend, seen, image }
    }
}

impl ImageTerm for Tie {
    fn eval(&mut self, _: &StepInfo, view: &View<'_>, shown: &Shown<'_>, d: &mut LossGrads) -> f64 {
        let within = |n: &&Neighbour| n.window[0] <= view.t.0 && view.t.0 <= n.window[1];
        let Some(Neighbour { scene, .. }) = self.neighbours.iter().find(within) else { return 0.0 };
        scene.at(view.t, &mut self.seen);
        let splats = scene.splats(&self.seen);
        let shot = Shot::new(&splats, view.camera, view.background);
        self.backend.render(&shot, &mut self.image).expect("the CPU renders every scene");
        if let Some(exposure) = &self.exposure {
            exposure.respond(view.rig, view.t, &mut self.image.color);
        }
        let pixels = shown.color.pixels();
        let unit = self.weight / shown.color.data.len() as f64;
        let mut sum = 0.0;
        let numbers = d.color.add().data.iter_mut().zip(shown.color.data.iter().zip(&self.image.color.data));
        for (i, (d, (own, theirs))) in numbers.enumerate() {
            // Pixels that the lens never filled carry no information.
            let counts = view.weight.map_or(1.0, |w| w.data[i % pixels]);
            let off = (own - theirs) * counts;
            sum += f64::from(off.abs());
            *d += unit as f32 * counts * if off == 0.0 { 0.0 } else { off.signum() };
        }
        unit * sum
    }
}
