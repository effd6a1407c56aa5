//! Checks scenes before all writers: no file stores NaN or infinity.

use super::{Layer, Scene};
use crate::math::Rng;
use crate::scene::{Params, RowEdit, Space};
use crate::{Error, Result};

/// Remedy for numbers that are not finite.
const REMEDY: &str = "The scene is damaged, or an edit made its numbers too large";

impl Params<f32> {
    /// Errors: a number of a table is NaN or infinite; its row and column are named.
    pub(crate) fn check_finite(&self) -> Result<()> {
        let Some((key, row, column)) = self.first_non_finite() else { return Ok(()) };
        let name = self.column_name(key, column);
        let whose = if self.info(key).space == Space::Gaussians { "Gaussian" } else { "row" };
        Err(Error::input(format!("`{name}` of {whose} {row} is NaN or infinite")).remedy(REMEDY))
    }

    /// Whether all numbers of each Gaussian are finite.
    fn finite_rows(&self) -> Vec<bool> {
        let mut finite = vec![true; self.len()];
        for key in self.keys().filter(|k| self.info(*k).space == Space::Gaussians) {
            let table = &self[key];
            for (row, finite) in finite.iter_mut().enumerate().take(table.rows()) {
                *finite &= (0..table.width()).all(|c| table.get(row, c).is_finite());
            }
        }
        finite
    }
}

impl Layer<f32> {
    /// Errors: a number of its tables or of its place in the world and in time is NaN or infinite.
    fn check_finite(&self) -> Result<()> {
        let at = |e: Error| e.at(format!("layer `{}`", self.name));
        self.params.check_finite().map_err(at)?;
        let placed = self.frame.is_sound() && self.cross_fade.iter().all(|s| s.is_finite());
        if placed && self.span.iter().all(|t| !t.is_nan()) {
            return Ok(());
        }
        Err(at(Error::input("its place in the world or in time is NaN or infinite").remedy(REMEDY)))
    }
}

impl Scene<f32> {
    /// Errors: a number of the scene is NaN or infinite; its layer, column and row are named.
    pub(crate) fn check_finite(&self) -> Result<()> {
        let bad = |what: &str| Err(Error::input(format!("the scene's {what} is NaN or infinite")).remedy(REMEDY));
        if !self.clip.iter().all(|t| t.is_finite()) {
            return bad("clip");
        }
        if !self.fps.is_finite() {
            return bad("fps");
        }
        if !self.up.iter().all(|x| x.is_finite()) || !self.background.iter().all(|x| x.is_finite()) {
            return bad("up or background");
        }
        self.layers.iter().try_for_each(Layer::check_finite)
    }

    /// Leaves out Gaussians with a number that is NaN or infinite, and returns how many these were.
    pub fn drop_non_finite(&mut self) -> usize {
        let mut dropped = 0;
        for layer in self.layers.iter_mut().filter(|l| l.params.first_non_finite().is_some()) {
            let finite = layer.params.finite_rows();
            let lost = finite.iter().filter(|f| !**f).count();
            if lost > 0 {
                layer.edit(&RowEdit::prune(Space::Gaussians, finite.into_iter()), &Rng::new(0, "finite", 0));
                dropped += lost;
            }
        }
        dropped
    }
}
