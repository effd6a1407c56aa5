//! One-time change of the scene in the middle of a stage, whose schedules continue: switching on a filter, replacing a
//! model.

use super::{At, Change, Context, Maintenance};
use crate::Result;
use crate::train_state::TrainState;
use splat4d::layers::Scene;

/// A change of the scene before one step of a stage. It must be idempotent: it is repeated where a run is resumed at
/// that very step.
pub(crate) struct Once<C> {
    /// The number of the step, from 0.
    pub at: usize,
    /// The change.
    pub change: C,
}

impl<C: Fn(&mut Scene<f32>) -> Result<()> + Send + Sync> Maintenance for Once<C> {
    fn name(&self) -> &str {
        "once"
    }

    fn due(&self, at: &At) -> bool {
        at.step == self.at && at.step < at.steps
    }

    fn once(&self) -> bool {
        true
    }

    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        train_state.rebuild(c.learns, &self.change)?;
        Ok(Change::default())
    }
}

#[cfg(test)]
mod tests {
    use super::super::Limits;
    use super::super::tests::{context, scene};
    use super::*;

    #[test]
    fn a_single_operation_is_due_once_at_its_step_and_not_after_the_last() {
        let darker = |s: &mut Scene<f32>| {
            s.background = [0.5; 3];
            Ok(())
        };
        let mut once = Once { at: 4, change: darker };
        let due = |at: usize| (0..=10).filter(|&step| Once { at, change: darker }.due(&At { step, steps: 10 })).count();
        assert!(once.due(&At { step: 4, steps: 10 }) && due(4) == 1);
        assert_eq!([due(0), due(10)], [1, 0]);
        let mut train_state = TrainState::new(scene(3));
        let limits = Limits { cap: 3, extent: 1.0, min_opacity: 0.0 };
        once.run(&mut train_state, &context(limits, 0, 0)).unwrap();
        assert_eq!(train_state.scene().background, [0.5; 3]);
    }
}
