//! Interface between a scene and its renderers: [`Backend`], implemented by the renderer of the CPU, by the oracle and
//! (feature `gpu`) by the renderer of the GPU, so that training, evaluation and the command name none of them directly.

use super::compare::{Comparison, Target};
use super::resident::Resident;
use super::{Image, ImageGrads, RenderConfig, RenderGrads, Renderer};
use crate::math::{Real, sh};
use crate::scene::{Camera, Splats, Table};
use crate::{Error, ErrorKind, Result};

/// Abilities that not every backend has. Colour, alpha and depth over a background are rendered by all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Abilities {
    /// Further channels ([`Shot::extra`]).
    pub extra: bool,
    /// A pixel head ([`Splats::head`]).
    pub head: bool,
    /// The backward pass ([`Backend::vjp`]).
    pub backward: bool,
    /// The comparison with a truth ([`Backend::compare`]).
    pub compare: bool,
}

/// An image to render.
#[derive(Clone, Copy, Debug)]
pub struct Shot<'a, F = f32> {
    /// The scene at one time.
    pub splats: &'a Splats<'a, F>,
    /// A pinhole; its size is the image's.
    pub camera: &'a Camera,
    /// Colour behind the scene.
    pub background: [F; 3],
    /// Further channels to blend, [all splats, C].
    pub extra: Option<&'a Table<F>>,
    /// Highest degree of spherical harmonics rendered, lowered to what a table holds.
    pub sh_degree: usize,
    /// Whether [`Image::depth`] is rendered; on the CPU it takes a further pass over the pixels.
    pub depth: bool,
}

impl<'a, F: Real> Shot<'a, F> {
    /// Colour and alpha, with all spherical harmonics; neither depth nor further channels.
    pub fn new(splats: &'a Splats<'a, F>, camera: &'a Camera, background: [F; 3]) -> Self {
        Self { splats, camera, background, extra: None, sh_degree: sh::MAX_DEGREE, depth: false }
    }

    /// Abilities that rendering it takes.
    pub(crate) fn abilities(&self) -> Abilities {
        Abilities { extra: self.extra.is_some(), head: self.splats.head.is_some(), ..Abilities::default() }
    }
}

/// Whether a scene's tables change between renders.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tables {
    /// Everything is sent to a device for every image.
    Changing,
    /// A layer's own SH table ([`crate::scene::Color::Sh`] with `base`) that is at the same address and has the same
    /// size as in the last render is the same table, and is not sent again: right for a scene that is played, wrong
    /// for one that learns. Everything else of a time is sent all the same.
    Constant,
}

/// Renders splats and takes gradients back; memory is reused from image to image.
pub trait Backend<F: Real = f32>: Send {
    /// Whether it has these abilities. Errors: it lacks one; the message names it and states what can.
    fn can(&self, abilities: &Abilities) -> Result<()>;

    /// Renders into `out`, which is resized to the camera's image. Rows that are NaN, infinite, behind the camera or
    /// transparent are not rendered.
    ///
    /// Errors: what [`can`](Self::can) refuses; an image too large for the device; a driver that failed. `out` means
    /// nothing then. Panics: `extra` has not one row a splat.
    fn render(&mut self, shot: &Shot<'_, F>, out: &mut Image<F>) -> Result<()>;

    /// Renders as [`render`](Self::render) does, but in 8 bits: red, green, blue and alpha of every pixel, clamped and
    /// rounded, which is less to bring back from a device. `false`: it has no such way, and nothing was done.
    ///
    /// Errors: as of `render`.
    fn render_bytes(&mut self, shot: &Shot<'_, F>, out: &mut Vec<[u8; 4]>) -> Result<bool> {
        let _ = (shot, out);
        Ok(false)
    }

    /// VJP of the last [`render`](Self::render), whose shot must be given again.
    ///
    /// `d_sh` has one entry a part: for a part whose colour is the layer's own SH, the gradient is *added* to rows
    /// `rows.id(j)` of that table; `None` skips it. `d` is overwritten, its allocations are reused.
    /// Errors: as of `render`. Panics: shapes are not those of the last render.
    fn vjp(
        &mut self,
        shot: &Shot<'_, F>,
        grads: &ImageGrads<'_, F>,
        d_sh: &mut [Option<&mut Table<F>>],
        d: &mut RenderGrads<F>,
    ) -> Result<()>;

    /// Renders, compares with the truth and takes the gradient of that loss back, without the image ever leaving the
    /// device. Targets, overwritten and added to, as of [`vjp`](Self::vjp). `None`: it cannot, and nothing was done.
    ///
    /// Errors: as of `render`. Panics: the truth has another size than the camera's image.
    fn compare(
        &mut self,
        shot: &Shot<'_, F>,
        target: &Target<'_, F>,
        d_sh: &mut [Option<&mut Table<F>>],
        d: &mut RenderGrads<F>,
    ) -> Result<Option<Comparison>> {
        let _ = (shot, target, d_sh, d);
        Ok(None)
    }

    /// The interface for whole steps on tables that stay on the device; none: unsupported.
    fn resident(&mut self) -> Option<&mut dyn Resident> {
        None
    }

    /// Radius of every splat of the last render with a backward pass: 3σ of the larger axis, pixels; 0: not rendered.
    /// Empty where the backend has no backward pass.
    fn radii(&self) -> &[F];

    /// The limits that it renders with.
    fn config(&self) -> &RenderConfig;

    /// The device, in a word or two.
    fn name(&self) -> &str;

    /// A message for the user since the last call, one line: what is rendered elsewhere, and why.
    fn notice(&mut self) -> Option<String> {
        None
    }
}

/// The refusal of an ability.
pub(crate) fn refusal(who: &str, what: &str) -> Error {
    Error::new(ErrorKind::Unsupported, format!("{who} does not {what}")).remedy("Render on the CPU.")
}

impl<F: Real> Backend<F> for Renderer<F> {
    fn can(&self, abilities: &Abilities) -> Result<()> {
        if abilities.compare { Err(refusal("the renderer of the CPU", "compare images")) } else { Ok(()) }
    }

    fn render(&mut self, shot: &Shot<'_, F>, out: &mut Image<F>) -> Result<()> {
        Renderer::render(self, shot, out);
        Ok(())
    }

    fn vjp(
        &mut self,
        shot: &Shot<'_, F>,
        grads: &ImageGrads<'_, F>,
        d_sh: &mut [Option<&mut Table<F>>],
        d: &mut RenderGrads<F>,
    ) -> Result<()> {
        self.backward(shot, grads, d_sh, d);
        Ok(())
    }

    fn radii(&self) -> &[F] {
        Renderer::radii(self)
    }

    fn config(&self) -> &RenderConfig {
        &self.config
    }

    fn name(&self) -> &str {
        "the CPU"
    }
}
