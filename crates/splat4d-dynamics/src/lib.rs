//! Forecasts a reconstructed scene: observe, reconstruct, predict, render, compare, correct.
//!
//! [`nodes::observe`] places some hundred nodes with identity on dynamic regions of a trained scene. A
//! [`models::Model`] learns from their observed paths, and [`Fitted::rollout`](models::Fitted::rollout) continues from
//! the last observed time, with actions if there are any. [`future::predicted`] makes a scene of the result, which
//! bakes, plays and exports like any other. Each model is a baseline for the next, from a frozen scene to a network
//! trained on whole rollouts; `score` measures them.
//!
//! Only the scores use times after the last observed one.
//!
//! # Code map
//!
//! A module imports only modules above it; `xtask/tests/tidy.rs` checks the order.
//!
//! | module | content |
//! |---|---|
//! | `actions.rs`, `paths.rs` | actions, a row of named numbers per frame; poses of nodes at even ticks |
//! | `worlds.rs` | worlds with known physics, for tests and `xtask capture --world` |
//! | `matrix.rs` | dense matrices: products, equations, eigenvectors |
//! | `smooth.rs`, `optimise.rs` | smoothing splines by generalised cross-validation; Adam for the networks |
//! | `ballistic.rs`, `koopman.rs` | baselines that learn nothing; optimised dynamic mode decomposition, stable by construction |
//! | `learnt.rs` | the contract of a network that predicts accelerations, its training over whole rollouts, its forecasts |
//! | `causal.rs`, `graph.rs`, `graph/` | the two networks: equivariant state space, equivariant messages along edges |
//! | `inverse.rs`, `inverse/` | inverse dynamics: actions that led from one state to the next |
//! | `models.rs`, `models/` | the models, by name |
//! | `score.rs` | node errors, skill, win rates, divergence, ensembles and their calibration |
//! | `nodes.rs`, `nodes/` | nodes with identity on dynamic regions, followed through any motion model |
//! | `future.rs` | the predicted scene: layers that begin where the observed ones end |
//! | `assimilate.rs`, `assimilate/` | correction by each new frame |

pub mod actions;
pub mod assimilate;
mod ballistic;
pub mod causal;
pub mod future;
pub mod graph;
mod inverse;
mod koopman;
pub mod learnt;
mod matrix;
pub mod models;
pub mod nodes;
mod optimise;
pub mod paths;
pub mod score;
mod smooth;
pub mod worlds;

pub use splat4d::{Error, ErrorKind, Result};
