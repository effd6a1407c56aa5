//! Losses that training minimises: the picture loss and the regularisers, each with its gradient.
//!
//! Every function returns its value and writes or adds its gradient; none keeps state that a result depends on.

pub(crate) mod arap;
pub(crate) mod graph;
pub mod image;
mod kernel;
pub(crate) mod motion;
mod near;
pub(crate) mod neighbourhood;
pub(crate) mod photometric;
pub(crate) mod planes;
pub(crate) mod rigid;
pub(crate) mod scene;
pub mod terms;
pub(crate) mod tracked;
pub(crate) mod transport;

pub use photometric::{LossValue, Photometric};
pub(crate) use transport::TransportSettings;

use crate::settings::settings;

settings! {
    /// Weights of the losses; 0: off.
    pub struct LossSettings {
        /// Share of D-SSIM in the photometric loss.
        dssim: f64 = 0.2 => share();
        /// How much more the pixels of fixed cameras weigh that differ from their temporal median (after DyNeRF).
        moving: f64 = 1.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the alpha-mask loss |alpha − mask| where masks cover the whole scene (RGBA captures).
        mask: f64 = 0.0;
        /// Weight of the σ-weighted opacity regulariser (FreeTimeGS).
        opacity_life: f64 = 0.0 => any().when(Is("run.motion", &["spacetime", "native4d"]));
        /// Weight of the velocity smoothness over nearest neighbours, (extents a clip)²; any model that moves.
        velocity: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of local rigidity over a frame, extents: neighbours keep their offsets (Luiten et al.; they take 4).
        rigid: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the agreement of Gaussians' turns with their neighbourhood's over a frame (Luiten et al.; they
        /// take 4).
        rot: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of isometry between two instants, extents: neighbours keep their distances (Luiten et al.; they take
        /// 2).
        iso: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the as-rigid-as-possible energy between two instants, extents² (SC-GS).
        arap: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the variance of neighbours' distances over four frames, over itself (SC-GS; 1e-3 there).
        elastic: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the third difference of positions over four frames, extents: against jitter.
        jerk: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the square of the acceleration over three frames, extents² (NSFF; 0.1 there).
        acceleration: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the way over a frame, extents: what need not move stays (NSFF's minimal flow; 0.1 there).
        least_motion: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the total variation of the picture's colours.
        tv: f64 = 0.0;
        /// Weight of the edge-aware total variation of depth, over its mean.
        depth_tv: f64 = 0.0;
        /// Weight of the agreement of depth with the splats' shortest axes (2DGS; 0.05 there).
        depth_normal: f64 = 0.0;
        /// Weight of the discrepancy of amplitudes and phases of the spectrum, coarse ones first (FreGS).
        frequency: f64 = 0.0;
        /// Weight of the entropy of the drawn alpha, nats: pixels decide between scene and background.
        mask_entropy: f64 = 0.0;
        /// Weight of the entropy of opacities, nats: Gaussians are there or not (SuGaR; 0.1 there).
        opacity_entropy: f64 = 0.0;
        /// Weight of the drawn depth against the capture's depth maps (capture.json: `depth`); falls to a tenth by the end.
        depth: f64 = 0.1;
        /// Weight of the drawn flow against a known one, shares of the picture's longer side (capture.json: `flow`).
        flow: f64 = 0.0;
        /// Weight of the drawn way of tracked points against their tracks, shares of the picture's longer side (capture.json:
        /// `tracks`).
        tracks: f64 = 0.0;
    }
}
