//! The settings of captures that are still being filmed.

use crate::settings::settings;

settings! {
    /// Captures that grow while they are trained (`train --follow`).
    #[derive(Copy)]
    pub struct FollowSettings {
        /// Seconds without a complete frame after which the capture counts as finished.
        timeout: f64 = 60.0 => positive().unit("seconds");
        /// Training steps of the first frame.
        first_steps: usize = 3000 => at_least(1).unit("iterations");
        /// Training steps of every later frame.
        frame_steps: usize = 300 => at_least(1).unit("iterations");
        /// A tile of an image disagrees with the scene where its mean absolute error rises by more than this (colours
        /// from 0 to 1).
        changed: f64 = 0.008 => positive();
        /// Share of what images show of a Gaussian that must lie in such tiles before the Gaussian learns.
        share: f64 = 0.3 => share();
        /// Learning rates of later frames, of those of the first one.
        rates: f64 = 0.5 => positive();
        /// Largest share of Gaussians that a frame adds.
        growth: f64 = 0.02;
        /// Frames that the playback file grows by at a time. Static Gaussians are repeated as often.
        segment: usize = 15 => at_least(1).unit("frames");
    }
}
