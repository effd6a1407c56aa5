//! What the trainer needs of a capture: posed pictures by number. Captures on disk and made-up ones in tests both serve.

use crate::Result;
use splat4d::scene::{Camera, Planes, Time};

/// One picture, loaded.
#[derive(Clone, Debug, Default)]
pub struct Picture {
    /// 3 channels in [0, 1].
    pub color: Planes<f32>,
    /// 1 channel, 1 = foreground.
    pub mask: Option<Planes<f32>>,
    /// 1 channel, 0 = a pixel that the lens never filled and that must not count.
    pub weight: Option<Planes<f32>>,
}

/// The pictures a scene is trained on.
pub trait Frames: Send + Sync {
    /// How many.
    fn len(&self) -> usize;
    /// Whether there is none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// From where frame i was taken.
    fn camera(&self, i: usize) -> &Camera;
    /// When.
    fn time(&self, i: usize) -> Time;
    /// By which camera of the rig.
    fn rig(&self, i: usize) -> usize;
    /// What messages call it.
    fn name(&self, i: usize) -> String;
    /// Whether frames have foreground masks.
    fn has_masks(&self) -> bool {
        false
    }
    /// Reads frame i.
    fn load(&self, i: usize, out: &mut Picture) -> Result<()>;
    /// These will be asked for soon; must not change any result.
    fn prefetch(&self, _frames: &[usize]) {}
}
