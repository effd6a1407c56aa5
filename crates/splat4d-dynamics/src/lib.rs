//! Predicts how a reconstructed scene goes on: observe, reconstruct, predict, render, compare, correct.
//!
//! [`nodes::observe`] finds some hundred nodes with identity on whatever moves in a trained scene; a [`models::Model`] of the
//! ladder learns from their observed paths, and [`Fitted::rollout`](models::Fitted::rollout) goes on from the last
//! observed moment, with actions where there are any; [`future::predicted`] makes a scene of it, which bakes, plays and
//! exports like any other. Every rung is a baseline for the next, from a scene that freezes to a network that was trained
//! over whole rollouts; `score` tells how much each is worth.
//!
//! Nothing here sees a time after the last observed one, but for the scores.
//!
//! # Code map
//!
//! A module imports only modules above it; `xtask/tests/tidy.rs` checks the order.
//!
//! | module | content |
//! |---|---|
//! | `actions.rs`, `paths.rs` | actions, a row of named numbers per frame; poses of nodes at even ticks |
//! | `worlds.rs` | worlds with known physics, for tests and `xtask capture --world` |
//! | `smooth.rs`, `optimise.rs` | smoothing splines by generalised cross-validation; Adam for the networks |
//! | `ballistic.rs`, `koopman.rs` | baselines that learn nothing; optimised dynamic mode decomposition, stable by construction |
//! | `learnt.rs` | the contract of a network that predicts accelerations, its training over whole rollouts, its forecasts |
//! | `causal.rs`, `graph.rs`, `graph/` | the two networks: equivariant state space, equivariant messages along edges |
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
mod koopman;
pub mod learnt;
pub mod models;
pub mod nodes;
mod optimise;
pub mod paths;
pub mod score;
mod smooth;
pub mod worlds;

pub use splat4d::{Error, ErrorKind, Result};
