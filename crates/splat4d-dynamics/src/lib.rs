//! Predicts how a reconstructed scene goes on: observe, reconstruct, predict, render, compare, correct.
//!
//! [`nodes::observe`] finds some hundred nodes with identity on whatever moves in a trained scene; a [`models::Model`] of the
//! ladder learns from their observed paths, and [`Fitted::rollout`](models::Fitted::rollout) goes on from the last
//! observed moment, with actions where there are any; [`future::predicted`] makes a scene of it, which bakes, plays and
//! exports like any other. Every rung is a baseline for the next, from a scene that freezes to a network that was trained
//! over whole rollouts; `score` tells how much each is worth.
//!
//! Nothing here sees a time after the last observed one, but for the scores.

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
