//! All models that continue observed paths, by name, each a baseline for the next.

use crate::actions::Actions;
use crate::ballistic::{DAMPING, ballistic, freeze};
use crate::causal::{CausalNet, CausalSpec};
use crate::graph::{GraphNet, GraphSpec};
use crate::inverse::infer;
use crate::koopman::Koopman;
use crate::learnt::{LEAST_TICKS, Learnt, Network, Training};
use crate::paths::{Moment, Paths};
use crate::{Error, Result};
use splat4d::scene::Params;

/// Rungs of the ladder, lowest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Model {
    /// B0: the last state, constant.
    Freeze,
    /// B1: constant velocity and turn.
    Velocity,
    /// B2: acceleration that fades.
    Acceleration,
    /// B3: the scene's motion model at later times.
    Extrapolate,
    /// M1: linear, with delays, stable by construction.
    Koopman,
    /// M2: a causal state space of every node, equivariant.
    Causal,
    /// M3: accelerations by messages along edges, equivariant.
    Graph,
}

impl Model {
    /// All, lowest first.
    pub const ALL: [Self; 7] =
        [Self::Freeze, Self::Velocity, Self::Acceleration, Self::Extrapolate, Self::Koopman, Self::Causal, Self::Graph];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Freeze => "freeze",
            Self::Velocity => "velocity",
            Self::Acceleration => "acceleration",
            Self::Extrapolate => "extrapolate",
            Self::Koopman => "koopman",
            Self::Causal => "causal",
            Self::Graph => "graph",
        }
    }

    /// The model of a name. Errors: there is none.
    pub fn from_name(name: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|m| m.name() == name).ok_or_else(|| {
            Error::input(format!("there is no model called {name}"))
                .remedy(format!("Choose all, or one of {}", Self::ALL.map(Self::name).join(", ")))
        })
    }

    /// Whether it is trained, so that seeds make an ensemble of it.
    pub fn is_trained(self) -> bool {
        matches!(self, Self::Causal | Self::Graph)
    }
}

/// Data of a world next to its paths, and settings of training networks.
#[derive(Clone, Debug, Default)]
pub struct Settings {
    /// Steps and seed.
    pub training: Training,
    /// Unit vector of gravity, if it is used.
    pub gravity: Option<[f64; 3]>,
    /// Height of a floor, against gravity.
    pub floor: Option<f64>,
}

/// A model that has learnt what it will.
#[derive(Clone, Debug)]
pub enum Fitted {
    /// It learns nothing: B0.
    Freeze,
    /// B1, or with damping B2.
    Ballistic(Option<f64>),
    /// M1.
    Koopman(Box<Linear>),
    /// M2.
    Causal(Box<Learnt<CausalNet>>),
    /// M3.
    Graph(Box<Learnt<GraphNet>>),
}

/// A fitted M1.
#[derive(Clone, Debug)]
pub struct Linear(Koopman);

impl Fitted {
    /// Learns from observed paths and the actions on them. B3 is no model of nodes: see [`crate::nodes::follow`].
    ///
    /// Errors: fewer ticks than anything can be learnt from, actions that end before the paths.
    pub fn fit(model: Model, paths: &Paths, actions: Option<&Actions>, settings: &Settings) -> Result<Self> {
        if paths.len() < LEAST_TICKS {
            return Err(Error::input(format!("{} observed frames are too few to predict from", paths.len()))
                .remedy(format!("Observe {LEAST_TICKS} at least, and several periods of periodic motion")));
        }
        if let Some(actions) = actions {
            actions.check(paths.len(), 1)?;
        }
        Ok(match model {
            Model::Freeze => Self::Freeze,
            Model::Velocity => Self::Ballistic(None),
            Model::Acceleration => Self::Ballistic(Some(DAMPING)),
            Model::Extrapolate => {
                return Err(Error::input("forecasts of a motion model are evaluated on the scene, not on nodes")
                    .remedy("Follow the nodes through the scene"));
            }
            Model::Koopman => Self::Koopman(Box::new(Linear(Koopman::fit(paths)))),
            Model::Causal => {
                Self::Causal(Box::new(Learnt::fit(paths, actions, &settings.training, |scales, acts, seed| {
                    CausalNet::new(
                        CausalSpec { gravity: settings.gravity, actions: acts, ..Default::default() },
                        scales,
                        paths.last(),
                        seed,
                    )
                })?))
            }
            Model::Graph => {
                Self::Graph(Box::new(Learnt::fit(paths, actions, &settings.training, |scales, acts, seed| {
                    let (gravity, floor) = (settings.gravity, settings.floor);
                    GraphNet::new(
                        GraphSpec { gravity, floor, actions: acts, ..Default::default() },
                        scales,
                        paths.last(),
                        seed,
                    )
                })?))
            }
        })
    }

    /// The `horizon` times after the last of `paths`. Row t of the actions acts after tick t.
    pub fn rollout(&self, paths: &Paths, actions: Option<&Actions>, horizon: usize) -> Vec<Moment> {
        match self {
            Self::Freeze => freeze(paths, horizon),
            Self::Ballistic(damping) => ballistic(paths, horizon, *damping),
            Self::Koopman(model) => model.0.rollout(paths, horizon),
            Self::Causal(model) => model.rollout(paths, actions, horizon),
            Self::Graph(model) => model.rollout(paths, actions, horizon),
        }
    }

    /// The actions that led through `paths` after the last `known` row, each constant over `hold` frames, behind the
    /// known ones: row t acts between tick t and the next.
    ///
    /// Errors: the model takes no actions, or was not trained with these columns; `hold` is 0; too few rows are known.
    pub fn infer_actions(&self, paths: &Paths, known: &Actions, hold: usize) -> Result<Actions> {
        match self {
            Self::Causal(model) => infer(model, paths, known, hold),
            Self::Graph(model) => infer(model, paths, known, hold),
            _ => Err(Error::input("this model takes no actions").remedy("Use causal or graph")),
        }
    }

    /// Weights of what was trained.
    pub fn params(&self) -> Option<&Params<f32>> {
        fn of<N: Network>(model: &Learnt<N>) -> Option<&Params<f32>> {
            Some(&model.params)
        }
        match self {
            Self::Causal(model) => of(model),
            Self::Graph(model) => of(model),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests;
