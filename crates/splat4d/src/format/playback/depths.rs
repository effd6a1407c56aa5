//! How many bits of a page's codes are used.

use super::page::{FULL8, FULL10, FULL16};
use crate::{Error, Result};

/// Fewest bits of a code: one step to either side of a middle needs two.
pub(crate) const LEAST_DEPTH: u32 = 2;

/// Bits that the writer uses of the codes of docs/format.md, "Page"; what is below them carries nothing, so that
/// deflate removes it. Readers are not affected: ranges are stretched a little, so that the largest code in use is
/// their end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Depths {
    /// Of 16, each axis of the mean.
    pub position: u32,
    /// Of 16, the centre of the lifespan.
    pub center: u32,
    /// Of 8, each scale.
    pub scale: u32,
    /// Of 8; full opacity is there at any depth.
    pub opacity: u32,
    /// Of 10, each of three components of the rotation.
    pub rotation: u32,
    /// Of 10, each axis of the shift.
    pub shift: u32,
    /// Of 10, each axis of the turn.
    pub turn: u32,
    /// Of 8, each channel of the base colour.
    pub color: u32,
    /// Of 8, half-width and softness of the lifespan.
    pub life: u32,
}

impl Default for Depths {
    /// All bits that a page has.
    fn default() -> Self {
        Self {
            position: FULL16,
            center: FULL16,
            scale: FULL8,
            opacity: FULL8,
            rotation: FULL10,
            shift: FULL10,
            turn: FULL10,
            color: FULL8,
            life: FULL8,
        }
    }
}

impl Depths {
    /// Errors: a depth below `LEAST_DEPTH` or above what a page has, by name.
    pub fn check(&self) -> Result<()> {
        let all = [
            ("position", self.position, FULL16),
            ("center", self.center, FULL16),
            ("scale", self.scale, FULL8),
            ("opacity", self.opacity, FULL8),
            ("rotation", self.rotation, FULL10),
            ("shift", self.shift, FULL10),
            ("turn", self.turn, FULL10),
            ("color", self.color, FULL8),
            ("life", self.life, FULL8),
        ];
        match all.iter().find(|(_, bits, full)| !(LEAST_DEPTH..=*full).contains(bits)) {
            Some((name, bits, full)) => {
                Err(Error::input(format!("{bits} bits for `{name}`"))
                    .remedy(format!("Give {LEAST_DEPTH} to {full} bits")))
            }
            None => Ok(()),
        }
    }
}
