//! `run.replans`: changes of a run's length during the run, in order.

use crate::settings::Value;

/// A change of a run's length during the run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ScheduleChange {
    /// Steps that had been taken.
    pub at: usize,
    /// Steps of the run in all, from then on.
    pub total: usize,
}

/// Changes of a run's length, in the order in which they were made.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ScheduleChanges(Vec<ScheduleChange>);

/// The form of the setting, to follow "It must be".
const FORM: &str = "a list of [step, steps in all], steps ascending and below the steps in all, such as [[700, 4200]]";

impl ScheduleChanges {
    /// The changes.
    pub fn rows(&self) -> &[ScheduleChange] {
        &self.0
    }

    /// Adds one. Panics: it is not behind the last, or leaves no step to take.
    pub(crate) fn push(&mut self, row: ScheduleChange) {
        assert!(self.may_follow(row), "a run is planned again at increasing steps, and has a step left then");
        self.0.push(row);
    }

    fn may_follow(&self, row: ScheduleChange) -> bool {
        row.at < row.total && self.0.last().is_none_or(|last| last.at < row.at)
    }
}

impl Value for ScheduleChanges {
    fn to_toml(&self) -> toml::Value {
        toml::Value::Array(self.0.iter().map(|r| vec![r.at, r.total].to_toml()).collect())
    }

    fn from_toml(value: &toml::Value) -> Result<Self, String> {
        let mut out = Self::default();
        for row in value.as_array().ok_or(FORM)? {
            let &[at, total] = Vec::<usize>::from_toml(row).map_err(|_| FORM)?.as_slice() else {
                return Err(FORM.into());
            };
            let row = ScheduleChange { at, total };
            if !out.may_follow(row) {
                return Err(FORM.into());
            }
            out.push(row);
        }
        Ok(out)
    }
}
