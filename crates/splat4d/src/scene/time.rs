//! Time is seconds on the scene clock; models may normalise inside, files never do.

/// Seconds on the scene clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, PartialOrd)]
pub struct Time(pub f64);

/// Frames per second of captures that state none, and the rate at which D-NeRF's u in `[0,1]` is laid out.
pub const DEFAULT_FPS: f64 = 30.0;
