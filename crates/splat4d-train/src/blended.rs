//! Values of Gaussians, blended as in the training images, and the backward pass: for values that are learnt while
//! shapes, positions and colours stay fixed ([`labels`](crate::labels), [`features`](crate::features)).

use crate::capture::Capture;
use splat4d::layers::{Evaluation, Scene};
use splat4d::render::{Image, ImageGrads, RenderConfig, RenderGrads, Renderer, Shot};
use splat4d::scene::{Planes, Table};

/// A pixel that shows less than this teaches nothing, and is not measured.
pub(crate) const SEEN: f32 = 0.5;

/// Memory of an image after the other.
pub(crate) struct Blended {
    renderer: Renderer<f32>,
    instant: Evaluation<f32>,
    columns: Table<f32>,
    /// The last image; its further channels are the blended numbers.
    pub image: Image<f32>,
    grads: RenderGrads<f32>,
}

impl Default for Blended {
    fn default() -> Self {
        Self {
            renderer: Renderer::new(RenderConfig::default()),
            instant: Evaluation::default(),
            columns: Table::default(),
            image: Image::default(),
            grads: RenderGrads::default(),
        }
    }
}

impl Blended {
    /// Renders a frame's view with `columns` of what is alive then, the last of which is 1 where a splat has numbers.
    pub(crate) fn draw(
        &mut self,
        scene: &Scene<f32>,
        capture: &Capture,
        frame: usize,
        columns: impl FnOnce(&Evaluation<f32>) -> Table<f32>,
    ) {
        let frame = &capture.frames[frame];
        scene.at(frame.time, &mut self.instant);
        self.columns = columns(&self.instant);
        let splats = scene.splats(&self.instant);
        let shot = Shot { extra: Some(&self.columns), ..Shot::new(&splats, &frame.view, scene.background) };
        self.renderer.render(&shot, &mut self.image);
    }

    /// The VJP of [`draw`](Self::draw): `give` is called for every splat with its layer and row, its number, the
    /// gradients to all columns and the columns.
    pub(crate) fn back(
        &mut self,
        scene: &Scene<f32>,
        capture: &Capture,
        frame: usize,
        d_extra: &Planes<f32>,
        mut give: impl FnMut([usize; 2], usize, &Table<f32>, &Table<f32>),
    ) {
        let frame = &capture.frames[frame];
        let splats = scene.splats(&self.instant);
        let shot = Shot { extra: Some(&self.columns), ..Shot::new(&splats, &frame.view, scene.background) };
        let d_color = Planes::new(3, d_extra.height, d_extra.width);
        let grads = ImageGrads { color: &d_color, alpha: None, depth: None, extra: Some(d_extra) };
        let mut no_sh: Vec<Option<&mut Table<f32>>> = splats.parts.iter().map(|_| None).collect();
        self.renderer.backward(&shot, &grads, &mut no_sh, &mut self.grads);
        let d = self.grads.extra.as_ref().expect("the channels were rendered");
        let mut first = 0;
        for (layer, tape) in self.instant.tapes().enumerate() {
            let rows = tape.out().rows();
            (0..rows).for_each(|j| give([layer, tape.rows().id(j)], first + j, d, &self.columns));
            first += rows;
        }
    }
}
