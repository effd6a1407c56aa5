//! Losses that training minimises: the image loss and the regularisers, each with its gradient.
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

pub use image::LossValue;
pub use photometric::Photometric;
pub(crate) use transport::TransportSettings;

use crate::settings::settings;

settings! {
    /// Weights of the losses; 0: off.
    pub struct LossSettings {
        /// Share of D-SSIM in the photometric loss.
        dssim: f64 = 0.2 => share();
        /// Additional weight of pixels of fixed cameras that differ from their temporal median (after DyNeRF).
        moving: f64 = 1.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the alpha-mask loss |alpha − mask| if masks cover the whole scene (RGBA captures).
        mask: f64 = 0.0;
        /// Weight of the σ-weighted opacity regulariser (FreeTimeGS).
        opacity_life: f64 = 0.0 => any().when(Is("run.motion", &["spacetime", "native4d"]));
        /// Weight of the velocity smoothness over nearest neighbours, (extents per clip)²; any dynamic model.
        velocity: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of local rigidity over a frame, extents: neighbours keep their offsets (Luiten et al. use 4).
        rigid: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of rotations that agree with the neighbourhood's over a frame (Luiten et al. use 4).
        rot: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of isometry between two times, extents: neighbours keep their distances (Luiten et al. use 2).
        iso: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the as-rigid-as-possible energy between two times, extents² (SC-GS).
        arap: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the relative variance of neighbours' distances over four frames (SC-GS uses 1e-3).
        elastic: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the third difference of positions over four frames (jerk), extents.
        jerk: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the squared acceleration over three frames, extents² (NSFF uses 0.1).
        acceleration: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the displacement over a frame, extents (minimal flow of NSFF, which uses 0.1).
        least_motion: f64 = 0.0 => any().when(IsNot("run.motion", &["still"]));
        /// Weight of the total variation of the image's colours.
        tv: f64 = 0.0;
        /// Weight of the edge-aware total variation of depth, over its mean.
        depth_tv: f64 = 0.0;
        /// Weight of the agreement of depth with the splats' shortest axes (2DGS uses 0.05).
        depth_normal: f64 = 0.0;
        /// Weight of the discrepancy of amplitudes and phases of the spectrum, coarse ones first (FreGS).
        frequency: f64 = 0.0;
        /// Weight of the entropy of the rendered alpha, nats: pixels become scene or background.
        mask_entropy: f64 = 0.0;
        /// Weight of the entropy of opacities, nats: Gaussians become opaque or transparent (SuGaR uses 0.1).
        opacity_entropy: f64 = 0.0;
        /// Weight of the rendered depth against the capture's depth maps (capture.json: `depth`); decays to a tenth by
        /// the end.
        depth: f64 = 0.1;
        /// Weight of the rendered depth against measured geometry (capture.json: `geometry`), the same during the whole
        /// run; 0: a scan only gives initial points.
        geometry: f64 = 0.1;
        /// Weight of the rendered flow against the known one, shares of the image's longer side (capture.json: `flow`).
        flow: f64 = 0.0;
        /// Weight of the rendered displacement of tracked points against their tracks, shares of the image's longer
        /// side (capture.json: `tracks`).
        tracks: f64 = 0.0;
    }
}
