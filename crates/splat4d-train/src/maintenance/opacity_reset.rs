//! Opacity reset: every n steps all opacities are lowered, so that superfluous Gaussians stay faint and are pruned.
//! Source: Kerbl et al. 2023 §5.2.

use super::{At, Change, Context, DensifySettings, Every, Maintenance, RunOrder, Strategy, logit};
use crate::Result;
use crate::settings::settings;
use crate::train_state::TrainState;
use splat4d::scene::GEOMETRY;
use splat4d::scene::params::OPACITY;

/// Opacities are lowered to this many times the dead one (Kerbl et al. 2023: 0.01 where 0.005 is dead).
const ABOVE_DEAD: f64 = 2.0;

settings! {
    /// Settings of the opacity reset under adaptive density control.
    #[derive(Copy)]
    pub struct OpacityResetSettings
    when (Is("densify.strategy", &["adc"])) {
        /// Iterations between opacity resets; 0: never (a reset destroys temporal models).
        interval: usize = 0 => any().unit("iterations");
    }
}

/// Lowers opacities while the cloud is densified by gradients.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct OpacityReset {
    /// Interval.
    pub settings: OpacityResetSettings,
    /// When the cloud is densified: nothing is reset at the last time or after it.
    pub densification: Every,
}

impl OpacityReset {
    /// With these settings; `None`: never.
    pub(crate) fn of(settings: OpacityResetSettings, densify: &DensifySettings) -> Option<Self> {
        let some = || Self { settings, densification: densify.steps() };
        (densify.strategy == Strategy::Adc && settings.interval > 0).then(some)
    }
}

impl Maintenance for OpacityReset {
    fn name(&self) -> &str {
        "opacity reset"
    }

    fn order(&self) -> RunOrder {
        RunOrder::Reset
    }

    fn due(&self, at: &At) -> bool {
        at.step.is_multiple_of(self.settings.interval) && at.step < self.densification.last
    }

    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        let ceiling = logit(ABOVE_DEAD * c.limits.min_opacity);
        let learning = train_state.learning();
        let (scene, moments) = train_state.tables_mut();
        for index in learning {
            let (layer, moments) = (&mut scene.layers[index], &mut moments[index]);
            let geometry = &mut layer.params[GEOMETRY];
            let width = geometry.width();
            for row in 0..geometry.rows() {
                let o = geometry.get(row, OPACITY);
                geometry.set(row, OPACITY, o.min(ceiling));
                moments.table_mut(GEOMETRY).set(row, OPACITY, 0.0);
                moments.table_mut(GEOMETRY).set(row, width + OPACITY, 0.0);
            }
        }
        Ok(Change::default())
    }

    fn densification(&mut self) -> Option<&mut Every> {
        Some(&mut self.densification)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Limits;
    use super::super::tests::{context, due_steps, scene};
    use super::*;
    use crate::train_state::Touched;

    fn reset() -> OpacityReset {
        let densification = Every { first: 1, last: 30, interval: 7 };
        OpacityReset { settings: OpacityResetSettings { interval: 10 }, densification }
    }

    #[test]
    fn opacities_above_twice_the_dead_threshold_are_lowered_and_their_moments_cleared() {
        let mut train_state = TrainState::new(scene(20));
        train_state.scene_mut().layers[0].params[GEOMETRY].set(3, OPACITY, -9.0);
        train_state.tables_mut().1[0].table_mut(GEOMETRY).fill(1.0);
        train_state.take_touched();
        let limits = Limits { cap: 20, extent: 1.0, min_opacity: 0.005 };
        reset().run(&mut train_state, &context(limits, 0, 0)).unwrap();
        let (g, m) = (&train_state.scene().layers[0].params[GEOMETRY], train_state.moments()[0].table(GEOMETRY));
        assert_eq!([3, 4].map(|r| g.get(r, OPACITY)), [-9.0, logit(0.01)]);
        assert_eq!([OPACITY, g.width() + OPACITY, 0].map(|c| m.get(4, c)), [0.0, 0.0, 1.0]);
        assert_eq!(train_state.take_touched(), Touched::Values);
    }

    #[test]
    fn opacity_resets_end_with_densification() {
        assert_eq!(due_steps(&reset(), 100), [10, 20]);
    }
}
