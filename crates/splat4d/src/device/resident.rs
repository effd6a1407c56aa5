//! [`ResidentMotion`]: whether a device can keep a layer, and its motion in the device's terms.

use crate::layers::Layer;
use crate::motion::{Polynomial, Slices};
use crate::render::{KEPT, Moves};
use crate::scene::{GEOMETRY, Key, LIFE, LifeKind, SH, Time};

/// A layer that a device can keep: its motion and its tables in the order of [`KEPT`].
#[derive(Clone, Debug, PartialEq)]
pub struct ResidentMotion {
    /// Motion of its rows.
    pub moves: Moves,
    /// Its tables.
    pub keys: [Option<Key>; KEPT],
}

impl ResidentMotion {
    /// The motion for all these times; none: no device supports it.
    pub fn new(layer: &Layer<f32>, times: &[Time]) -> Option<Self> {
        let life = (layer.life != LifeKind::Infinite).then_some(LIFE);
        let known =
            |moves, own: [Option<Key>; 2]| Self { moves, keys: [Some(GEOMETRY), life, own[0], own[1], Some(SH)] };
        let still = Moves::Along { order: 0, rotation: false, detach: false, origin: 0.0 };
        if let Some(polynomial) = layer.motion.polynomial() {
            let Polynomial { order, velocities, rotation_rates, origin, detached } = polynomial;
            let moves = Moves::Along { order, rotation: rotation_rates.is_some(), detach: detached, origin };
            return Some(known(moves, [velocities, rotation_rates]));
        }
        if let Some(Slices { own, speed, floor, ceiling, harmonics, period }) = layer.motion.slices() {
            return Some(known(Moves::Sliced { speed, floor, ceiling, harmonics, period }, [Some(own), None]));
        }
        // Images of several frames, or of a time between two, are the CPU's.
        let page = layer.motion.pose_table(*times.first()?)?;
        let one = times.iter().all(|t| layer.motion.pose_table(*t) == Some(page));
        one.then(|| match page {
            GEOMETRY => known(still, [None; 2]),
            _ => known(Moves::Posed, [Some(page), None]),
        })
    }
}
