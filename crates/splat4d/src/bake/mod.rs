//! Bakes a scene of any motion model for playback: kinematic primitives in a tree of time spans.
//!
//! Every Gaussian goes to the deepest node that contains the time in which it is visible. There a linear path, a
//! constant rotation rate, one shape, one colour and its own lifespan are fitted to the model's time samples. If one
//! segment is not enough, the node is split into halves, down to single frames, which copy the model and continue
//! linearly to the next frame (key states). Linear motion is copied and not fitted.
//!
//! [`Cut`] decides where to split: [`bake`] splits every segment that misses by more than a tolerance in pixels.
//! [`Bakery`] measures the curve of segments and image error (`rate.rs`) to meet a budget.
//!
//! The model is sampled in runs of rows, each at all its frames, so that memory does not grow with frames times
//! Gaussians.

mod bakery;
mod compare;
mod fit;
mod head;
mod life;
mod rank;
mod rate;
mod repeat;
mod sample;
mod sampling;
mod shape;
mod straight;
mod tally;
#[cfg(test)]
mod tests;
mod tree;
mod weights;

use crate::Result;
use crate::format::playback::Node;
use crate::layers::Scene;
use crate::scene::Camera;
pub use bakery::{Bakery, Curve, Cut};
#[cfg(test)]
pub(crate) use compare::Moment;
pub use compare::{Likeness, Shown, compare};
pub use head::fold_head;

/// Default of [`Options::tolerance`], pixels: on models that no straight line holds, baked and model then differ by
/// less than 40 dB can show (measured; see the tests), at a fraction of the segments that a tenth of it would need.
pub const TOLERANCE: f64 = 0.25;
/// Default of [`Options::segment`], seconds: what a player fetches for a seek; shorter ones repeat too much.
pub const SEGMENT: f64 = 1.0;
/// Default of [`Options::sample_rate`]: the frame rate of players. Between the frames of a slow capture a network is
/// not linear.
pub const SAMPLE_RATE: f64 = 30.0;
/// Most rounds of [`Options::repeat`].
pub const MAX_REPEAT: usize = 10_000;
/// Default of [`Options::renders`]: more do not improve the result.
pub(crate) const RENDERS: usize =
    if weights::STILL_RENDERS > weights::PATH_RENDERS { weights::STILL_RENDERS } else { weights::PATH_RENDERS };
/// Default of [`Options::samples`]: 30,000 Gaussians at 27 seconds of 30 frames per second.
pub(crate) const SAMPLES: usize = 24_000_000;

/// Options of baking.
#[derive(Clone, Debug)]
pub struct Options {
    /// Largest error that is not split further, pixels.
    pub tolerance: f64,
    /// About how long a segment lasts, seconds.
    pub segment: f64,
    /// Time samples of the model per second, at least; each of the clip's frames is one, as far as `samples` allows.
    pub sample_rate: f64,
    /// Most samples of Gaussians at a time, over all Gaussians whose motion is not straight: bounds the time of baking.
    /// At least the clip's ends are sampled.
    pub samples: usize,
    /// Most renders each, of fixed cameras and of one that moves, that measure how strongly images react to errors:
    /// bounds the time as well.
    pub renders: usize,
    /// The clip is played this many times over.
    pub repeat: usize,
    /// The cameras whose pixels count, at all times. No camera and no path: a 1080p image that the scene fills.
    pub cameras: Vec<Camera>,
    /// Times and poses of a camera that moves: its pixels count at these times. Times rise.
    pub path: Vec<(f64, Camera)>,
    /// Whether renders decide which Gaussians come first in a file, and not their sizes alone.
    pub rank: bool,
    /// Whether what is left when the least important ones are left out is ranked again, for files that are played in
    /// part.
    pub peel: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            tolerance: TOLERANCE,
            segment: SEGMENT,
            sample_rate: SAMPLE_RATE,
            samples: SAMPLES,
            renders: RENDERS,
            repeat: 1,
            cameras: Vec::new(),
            path: Vec::new(),
            rank: true,
            peel: false,
        }
    }
}

/// A baked scene.
#[derive(Clone, Debug)]
pub struct Baked {
    /// Primitives by the span in which they are rendered; spans rise, longer ones first.
    pub nodes: Vec<Node>,
    /// First and last second, all rounds.
    pub clip: [f64; 2],
    /// Highest degree of spherical harmonics that is not zero.
    pub sh_degree: usize,
    /// Statistics of the baking.
    pub report: Report,
}

/// Statistics of a baking.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct Report {
    /// Gaussians of the model.
    pub gaussians: usize,
    /// Those that are visible at no time of the clip, or that are not finite.
    pub unseen: usize,
    /// Those that became more than one primitive.
    pub split: usize,
    /// Primitives in all nodes.
    pub primitives: usize,
    /// Primitives that last one frame: key states.
    pub key_states: usize,
    /// Nodes with primitives.
    pub nodes: usize,
    /// Largest error allowed, pixels. None: segments were chosen by what they cost ([`Cut::Price`]).
    pub tolerance: Option<f64>,
    /// Errors of Gaussians (of each its worst primitive, pixels).
    pub errors: Errors,
}

/// Quantiles and a histogram of errors a Gaussian, pixels.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct Errors {
    /// Half of the Gaussians are better.
    pub median: f64,
    /// Nine tenths are better.
    pub p90: f64,
    /// 99 of 100 are better.
    pub p99: f64,
    /// The worst; above a tolerance only where single frames miss too.
    pub worst: f64,
    /// Upper ends of the histogram's bins, pixels; the last bin has none.
    pub bins: Vec<f64>,
    /// Gaussians in each bin, one more than `bins`.
    pub counts: Vec<usize>,
}

/// Bakes a scene with [`Options::tolerance`]. `progress` is called with the finished and the total number of Gaussians.
///
/// Errors: a scene with a pixel head; options out of range; an invalid clip; a model that would become too many
/// primitives.
pub fn bake(scene: &Scene<f32>, options: &Options, progress: &mut dyn FnMut(usize, usize)) -> Result<Baked> {
    Bakery::new(scene, options)?.bake(Cut::Tolerance(options.tolerance), progress)
}
