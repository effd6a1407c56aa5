//! A page as a layer of a scene, so that everything that draws scenes draws playback files.

use super::index::broken;
use super::page::rate;
use super::{Page, Palette};
use crate::Result;
use crate::layers::Layer;
use crate::math::sh;
use crate::motion::{Spacetime, SpacetimeSpec};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, LIFE, LifeKind, Params, SH};
use std::sync::Arc;

/// Half-width of Gaussians that live for ever, seconds: thirty years, in whose middle f32 is exact.
const FOR_EVER: f64 = 1e9;
/// Half-width zero as a logarithm can say it, seconds: less than any frame notices.
const INSTANT: f64 = 1e-9;
/// Opacities 0 and 255 are this far from 0 and 1, where logits are infinite: invisible, and above the renderer's ceiling.
const OPACITY_MARGIN: f64 = 1e-4;
/// Largest velocity and rate that a layer holds: far beyond any scene, and finite in f32 when times are multiplied.
const FASTEST: f64 = 1e15;

impl Page {
    /// The page as a layer that is seen during its span; coefficients come from its palette, where it has one.
    ///
    /// Errors: a Gaussian's label is not in the palette. Panics: the page has a palette and none is given.
    pub fn layer(&self, palette: Option<&Palette>) -> Result<Layer<f32>> {
        let palette = palette.filter(|_| self.palette.is_some());
        assert!(palette.is_some() || self.palette.is_none(), "a page with a palette needs it");
        let life = LifeKind::Interval;
        let mut params = Params::new(self.len(), palette.map_or(1, |p| sh::coeffs(p.degree)), life.columns());
        let spec =
            SpacetimeSpec { order: 1, rotation: true, detach: false, origin: 0.5 * (self.span[0] + self.span[1]) };
        let motion = Spacetime::new(spec, &mut params)?;
        let tables = params.get_mut([GEOMETRY, SH, LIFE, motion.velocities(), motion.rates()]);
        let [geometry, colors, lives, velocities, rates] = tables;
        for i in 0..self.words.len() {
            let r = self.record(i);
            let turn = r.turn.map(|w| w.clamp(-FASTEST, FASTEST));
            let logit = |o: f64| (o / (1.0 - o)).ln();
            geometry.write(i, 0, r.mean.map(|x| x as f32));
            geometry.write(i, QUAT, r.quat.map(|x| x as f32));
            geometry.write(i, LOG_SCALE, r.scales.map(|s| s.ln() as f32));
            geometry.set(i, OPACITY, logit(r.opacity.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN)) as f32);
            colors.write(i, 0, r.base_color.map(|c| sh::rgb_to_dc(c) as f32));
            let width = r.half_width.clamp(INSTANT, FOR_EVER).ln();
            lives.write(i, 0, [r.center, width, r.softness.ln()].map(|x| x as f32));
            velocities.write(i, 0, r.velocity.map(|v| v.clamp(-FASTEST, FASTEST) as f32));
            rates.write(i, 0, rate(r.quat, turn).map(|x| x as f32));
            let Some(palette) = palette else { continue };
            let entry = usize::from(r.label);
            if entry >= palette.entries {
                let what = format!("Gaussian {i} has entry {entry} of a palette of {}", palette.entries);
                return Err(broken(what));
            }
            for plane in 0..palette.width() {
                colors.set(i, 3 + plane, palette.value(entry, plane));
            }
        }
        Ok(Layer { name: "page".into(), params, motion: Arc::new(motion), life, span: self.span, masks: None })
    }
}
