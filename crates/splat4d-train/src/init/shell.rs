//! The far shell: Gaussians on a sphere around the cameras where images show far surroundings ([`Sky`]), a static layer
//! of its own. Formats, players and exports need nothing for it, and its positions learn at a rate in proportion to its
//! distance.

use super::sky::Sky;
use super::{InitSettings, Seeds};
use crate::Result;
use crate::capture::frames::Frames;
use crate::methods::TrainContext;
use crate::settings::choices;
use rayon::prelude::*;
use splat4d::layers::{FAR_SHELL, Layer};
use splat4d::math::se3::dot;
use splat4d::math::sh::rgb_to_dc;
use splat4d::motion::Still;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, LifeKind, Params, SH};
use std::f64::consts::{PI, TAU};
use std::sync::Arc;

/// Directions by which the share of the sphere is measured that cameras see.
const SAMPLES: usize = 4096;
/// Fewest and most Gaussians; density control adds what they lack.
const COUNT: [usize; 2] = [300, 12_000];
/// Most of the largest number of Gaussians that it takes.
const SHARE: f64 = 0.25;
/// Standard deviation, of the distance between neighbours: between three of them alpha is above 0.9.
const WIDTH: f64 = 0.6;
/// Initial opacity: nothing is behind it, and what is faint lets Gaussians in front of it become its substitute.
const OPACITY_START: f64 = 0.9;
/// Cells around the visible surroundings that it covers as well: behind the outlines of what is near.
const BEHIND: f64 = 2.0;

choices! {
    /// Whether a scene has a far shell.
    pub enum FarShell {
        /// If images fit a far distance where they show no near points.
        Auto = "auto",
        /// Yes.
        On = "on",
        /// No.
        Off = "off",
    }
}

impl InitSettings {
    /// The distance of the far shell, extents; `None`: there is none, or whether there is one has not been decided.
    pub(crate) fn shell_at(&self) -> Option<f64> {
        (self.shell == FarShell::On && self.shell_distance > 0.0).then_some(self.shell_distance)
    }
}

/// The surroundings at the plan's distance. Seeds before them are removed: they are matches of what repeats, or of noise.
/// `None`: the plan has no shell.
///
/// Errors: an image cannot be read.
pub(super) fn before(plan: &TrainContext, frames: &dyn Frames, seeds: &mut Seeds) -> Result<Option<Sky>> {
    let Some(distance) = plan.shell else { return Ok(None) };
    let still: Vec<[f64; 3]> =
        (0..seeds.len()).filter(|&i| seeds.times[i].is_none()).map(|i| seeds.points[i]).collect();
    let mut sky = Sky::open(frames, &still, plan.center, plan.extent)?;
    sky.mark(distance * plan.extent);
    seeds.retain(|i, s| !sky.hides(s.points[i]));
    Ok(Some(sky))
}

/// The first Gaussians of the shell.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Shell {
    /// Positions, world.
    pub points: Vec<[f64; 3]>,
    /// Colours in [0, 1].
    pub colors: Vec<[f32; 3]>,
    /// Standard deviation, scene units.
    pub size: f64,
}

/// The k-th of n directions that are evenly spread over the sphere: a Fibonacci lattice (González 2010).
fn direction(k: usize, n: usize) -> [f64; 3] {
    let z = 1.0 - (2 * k + 1) as f64 / n as f64;
    let turn = TAU * (k as f64 * (0.5 * (5f64.sqrt() - 1.0))).fract();
    let r = (1.0 - z * z).sqrt();
    [r * turn.cos(), r * turn.sin(), z]
}

impl Shell {
    /// About as many Gaussians an image pixel as the others have of which there are `count`; at most a quarter of `cap`.
    pub(crate) fn new(sky: &Sky, count: usize, cap: usize) -> Self {
        let count = (sky.share() * count as f64) as usize;
        let most = ((SHARE * cap as f64) as usize).max(1);
        let count = count.clamp(COUNT[0], COUNT[1]).min(most);
        let visible = |n: usize| -> Vec<Option<[f32; 3]>> {
            let look = |k: usize| sky.look(sky.point(direction(k, n)));
            (0..n).into_par_iter().map(|k| Some(look(k)).filter(|l| l.is_sky()).map(|l| l.color)).collect()
        };
        let share = visible(SAMPLES).iter().flatten().count() as f64 / SAMPLES as f64;
        if share == 0.0 {
            return Self::default();
        }
        let n = (count as f64 / share) as usize;
        let found = visible(n);
        let kept: Vec<([f64; 3], [f32; 3])> =
            found.iter().enumerate().filter_map(|(k, c)| c.map(|c| (direction(k, n), c))).collect();
        let spacing = (4.0 * PI / n as f64).sqrt();
        let least = (BEHIND * sky.cell_angle()).max(spacing).cos();
        let color = |k: usize| -> Option<[f32; 3]> {
            if found[k].is_some() {
                return found[k];
            }
            let way = direction(k, n);
            let by = |(d, c): &([f64; 3], [f32; 3])| (dot(*d, way), *c);
            let (near, color) = kept.iter().map(by).max_by(|a, b| a.0.total_cmp(&b.0))?;
            (near >= least && sky.look(sky.point(way)).seen > 0).then_some(color)
        };
        let colors: Vec<Option<[f32; 3]>> = (0..n).into_par_iter().map(color).collect();
        let mut out = Self { size: WIDTH * spacing * sky.radius, ..Self::default() };
        for (k, color) in colors.into_iter().enumerate() {
            let Some(color) = color else { continue };
            out.points.push(sky.point(direction(k, n)));
            out.colors.push(color);
        }
        out
    }

    /// Number of Gaussians.
    pub(crate) fn len(&self) -> usize {
        self.points.len()
    }

    /// The layer.
    pub(super) fn layer(&self, plan: &TrainContext) -> Layer<f32> {
        let degree = plan.common.appearance.sh_degree;
        let mut params = Params::new(self.len(), (degree + 1) * (degree + 1), LifeKind::Infinite.columns());
        let logit = (OPACITY_START / (1.0 - OPACITY_START)).ln() as f32;
        for (i, (point, color)) in self.points.iter().zip(&self.colors).enumerate() {
            let geometry = &mut params[GEOMETRY];
            geometry.write(i, 0, point.map(|x| x as f32));
            geometry.write(i, QUAT, [1.0, 0.0, 0.0, 0.0]);
            geometry.write(i, LOG_SCALE, [self.size.ln() as f32; 3]);
            geometry.set(i, OPACITY, logit);
            params[SH].write(i, 0, color.map(rgb_to_dc));
        }
        Layer::new(FAR_SHELL, params, Arc::new(Still), LifeKind::Infinite)
    }
}

#[cfg(test)]
mod tests;
