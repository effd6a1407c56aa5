//! Converts every kind of lifespan to the envelope of the playback file.

use crate::layers::Layer;
use crate::scene::life::{CENTER, LOG_SOFTNESS, LOG_WIDTH};
use crate::scene::{LIFE, LifeKind, Table};

/// A half-width or softness above this counts as infinite, seconds: three years; intervals that represent infinity have
/// thirty.
const FOR_EVER: f64 = 1e8;
/// A softness below this is an edge, seconds.
const SHARP: f64 = 1e-9;

/// σ(t) = exp(−½(max(0, |t − centre| − half)/softness)²); 1 forever where `half` is infinite.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Envelope {
    /// Seconds.
    pub center: f64,
    /// Half of the seconds at full strength.
    pub half: f64,
    /// Standard deviation of birth and death, seconds.
    pub softness: f64,
}

impl Envelope {
    /// An infinite lifespan, with motion counted from `center`.
    pub(super) fn forever(center: f64) -> Self {
        Self { center, half: f64::INFINITY, softness: 1.0 }
    }

    pub(super) fn is_forever(&self) -> bool {
        self.half == f64::INFINITY
    }

    /// σ at time t.
    pub(super) fn sigma(&self, t: f64) -> f64 {
        let over = ((t - self.center).abs() - self.half).max(0.0) / self.softness;
        (-0.5 * over * over).exp()
    }
}

/// The lifespans of a layer's Gaussians.
pub(super) struct Lives<'a> {
    table: std::borrow::Cow<'a, Table<f32>>,
    kind: LifeKind,
}

impl<'a> Lives<'a> {
    pub(super) fn new(layer: &'a Layer<f32>) -> Self {
        let mut own = Table::new(&[("life", 2)], 0);
        if layer.motion.life(&layer.params, &mut own) {
            return Self { table: std::borrow::Cow::Owned(own), kind: LifeKind::GaussHalf };
        }
        Self { table: std::borrow::Cow::Borrowed(&layer.params[LIFE]), kind: layer.life }
    }

    /// The envelope of row `id`.
    pub(super) fn envelope(&self, id: usize) -> Envelope {
        let own = self.row(id);
        if own.half > FOR_EVER || own.softness > FOR_EVER {
            return Envelope::forever(own.center);
        }
        // Written so that NaN stays NaN, which is then left out.
        Envelope { softness: if own.softness < SHARP { SHARP } else { own.softness }, ..own }
    }

    /// Whether the lifespans have centres.
    pub(super) fn has_centers(&self) -> bool {
        self.table.width() > 0
    }

    fn row(&self, id: usize) -> Envelope {
        let get = |column: usize| f64::from(self.table.get(id, column));
        match self.kind {
            LifeKind::Infinite => Envelope::forever(0.0),
            LifeKind::GaussHalf => Envelope { center: get(CENTER), half: 0.0, softness: get(LOG_WIDTH).exp() },
            // exp(−u²) is exp(−½u²) of a width √2 smaller.
            LifeKind::GaussOne => Envelope {
                center: get(CENTER),
                half: 0.0,
                softness: get(LOG_WIDTH).exp() * std::f64::consts::FRAC_1_SQRT_2,
            },
            LifeKind::Interval => {
                Envelope { center: get(CENTER), half: get(LOG_WIDTH).exp(), softness: get(LOG_SOFTNESS).exp() }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Still;
    use crate::scene::{Params, Time};
    use std::sync::Arc;

    #[test]
    fn every_kind_of_lifespan_keeps_its_shape() {
        let row = [0.3f32, -1.1, -2.3];
        for kind in [LifeKind::Infinite, LifeKind::GaussHalf, LifeKind::GaussOne, LifeKind::Interval] {
            let mut params = Params::new(1, 1, kind.columns());
            let width = params[LIFE].width();
            (0..width).for_each(|k| params[LIFE].set(0, k, row[k]));
            let layer = Layer::new("a", params, Arc::new(Still), kind);
            let envelope = Lives::new(&layer).envelope(0);
            for i in 0..50 {
                let t = -1.0 + 0.05 * f64::from(i);
                let truth = kind.eval(row.map(f64::from), Time(t)).sigma;
                assert!((envelope.sigma(t) - truth).abs() < 1e-7, "{kind:?} at {t}");
            }
        }
    }
}
