//! Motion models from outside the library: a canonical cloud that a model with tables of its own moves, learnt as
//! `deform-mlp` is, and the list of such models by name.

use super::deform::{WARM_UP, WARM_UP_SHARE, canonical};
use super::{Group, Method, Rate, Stage, TrainContext, still};
use crate::{Error, Result};
use splat4d::motion::{MakeMotion, Motion, Phase, Spec, is_registered, register as register_motion};
use splat4d::scene::Params;
use std::collections::BTreeMap;
use std::sync::{Arc, PoisonError, RwLock};

/// A motion model of a caller's own, and how its tables are learnt.
#[derive(Clone)]
pub struct OwnMotion {
    /// Its name in recipes and files.
    pub name: String,
    /// Makes the model, and in the parameters its tables (or claims the loaded ones). Its spec is `Spec::Custom(name)`.
    pub make: MakeMotion,
    /// Column groups of its tables and their rates; what is not named here stays as it was made.
    pub rates: Vec<(String, Rate)>,
    /// Share of the iterations in which only the Gaussians learn, before its tables do. The model should rest then
    /// ([`Motion::with_phase`]).
    pub warmup: f64,
}

static OWN: RwLock<BTreeMap<&'static str, Arc<OwnMotion>>> = RwLock::new(BTreeMap::new());

impl OwnMotion {
    /// Registers the model with training and every reader of scenes, for the rest of the process: `run.motion` may be
    /// its name. A model of that name that was registered before is replaced.
    ///
    /// Errors: a name that is taken or cannot be written; a share outside [0, 1); rates that are not finite.
    pub fn register(self) -> Result<()> {
        if !(0.0..1.0).contains(&self.warmup) {
            return Err(Error::input(format!("invalid warm-up of `{}`: {}", self.name, self.warmup))
                .remedy("Give a share of the iterations, from 0 to below 1"));
        }
        let wrong = |r: &Rate| !(r.start.is_finite() && r.end.is_finite() && r.start >= 0.0 && r.end >= 0.0);
        if let Some((column, rate)) = self.rates.iter().find(|(_, r)| wrong(r)) {
            return Err(Error::input(format!("invalid rate of `{column}`: {} to {}", rate.start, rate.end))
                .remedy("Give rates of 0 or more"));
        }
        register_motion(&self.name, self.make.clone())?;
        let mut own = OWN.write().unwrap_or_else(PoisonError::into_inner);
        // Names need a static lifetime, as those of the library.
        let name = own.get_key_value(self.name.as_str()).map(|(name, _)| *name);
        let name = name.unwrap_or_else(|| String::leak(self.name.clone()));
        own.insert(name, Arc::new(self));
        Ok(())
    }
}

/// The name under which a model from outside is known, if it is.
pub(crate) fn name(name: &str) -> Option<&'static str> {
    OWN.read().unwrap_or_else(PoisonError::into_inner).get_key_value(name).map(|(name, _)| *name)
}

/// The program of a model from outside.
pub(crate) fn program(name: &str) -> Option<Box<dyn Method>> {
    let own = OWN.read().unwrap_or_else(PoisonError::into_inner).get(name).cloned()?;
    assert!(is_registered(name), "a model registered with training is registered with readers");
    Some(Box::new(OwnMethod(own)))
}

struct OwnMethod(Arc<OwnMotion>);

impl OwnMethod {
    fn warmup(&self, plan: &TrainContext) -> usize {
        (self.0.warmup * plan.iterations as f64) as usize
    }

    /// Steps `from .. to` of the recipe's one schedule as a stage of its own.
    fn stage(&self, plan: &TrainContext, from: usize, to: usize) -> Stage {
        let mut stage = still::stage(&self.0.name, plan);
        still::learn_life(&mut stage, plan, self.life(plan));
        canonical(&mut stage);
        stage.part(from, to)
    }
}

impl Method for OwnMethod {
    fn spec(&self, _plan: &TrainContext) -> Spec {
        Spec::Custom(self.0.name.clone())
    }

    fn build(&self, _plan: &TrainContext, params: &mut Params) -> Result<Arc<dyn Motion>> {
        (self.0.make)(params)
    }

    fn check(&self, plan: &TrainContext) -> Result<()> {
        if plan.times < 2 {
            return Err(Error::input("all images of the capture have the same time: there is nothing to move")
                .remedy("Train it with the motion model `still`"));
        }
        Ok(())
    }

    fn one_time(&self, _plan: &TrainContext) -> bool {
        true
    }

    fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
        let (all, warmup) = (plan.iterations, self.warmup(plan));
        let mut stages = Vec::new();
        if warmup > 0 {
            let mut first = self.stage(plan, 0, warmup);
            first.name = format!("{}, still", self.0.name);
            first.phase = Some(Phase { rests: true, levels: None });
            stages.push(first);
        }
        if warmup < all {
            let mut second = self.stage(plan, warmup, all);
            second.phase = Some(Phase { rests: false, levels: None });
            let warm_up = WARM_UP.min(all / WARM_UP_SHARE);
            let learnt = self.0.rates.iter();
            second.groups.extend(learnt.map(|(column, rate)| Group { warm_up, ..Group::new(column, *rate) }));
            stages.push(second);
        }
        stages
    }
}
