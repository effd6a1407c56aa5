//! The contract of motion models: one test a model, all with the same checks (see `check`).

mod check;

use check::{model, starts_still};
use splat4d::motion::control::{ControlSpec, Curve, TrajectorySpec};
use splat4d::motion::skin::SkinSpec;
use splat4d::motion::ssm::{Equivariance, Mode, Output, SsmSpec};
use splat4d::motion::{SpacetimeSpec, Spec};
use splat4d::scene::{LifeKind, Space};

/// Gaussians of a made-up layer: more than a block, and no multiple of one.
const ROWS: usize = 21;

#[test]
fn still() {
    model(&Spec::Still, ROWS, LifeKind::Infinite, &[Space::Gaussians], &[]);
    starts_still(&Spec::Still, ROWS);
}

#[test]
fn spacetime() {
    for (order, rotation) in [(1, false), (3, true)] {
        let spec = Spec::Spacetime(SpacetimeSpec { order, rotation, detach: false, origin: 0.5 });
        model(&spec, ROWS, LifeKind::GaussHalf, &[Space::Gaussians], &[]);
        starts_still(&spec, ROWS);
    }
}

// deform-mlp.

// hexplane.

// tracked.

// native4d.

// control.

#[test]
fn control() {
    let skin = SkinSpec { nodes: 7, neighbours: 3, hyper: 2, mask: false };
    let keys = |curve, keys| TrajectorySpec::Keys { curve, keys };
    let trajectories = [
        (keys(Curve::Cubic, 6), false),
        (keys(Curve::Linear, 4), true),
        (keys(Curve::Slerp, 4), false),
        (TrajectorySpec::LowRank { bases: 3, keys: 5 }, true),
        (TrajectorySpec::Network { width: 12, layers: 2, position_levels: 2, time_levels: 2 }, false),
    ];
    for (trajectory, mask) in trajectories {
        let spec =
            Spec::Control(ControlSpec { seed: 3, clip: [0.0, 1.0], skin: SkinSpec { mask, ..skin }, trajectory });
        model(&spec, ROWS, LifeKind::GaussHalf, &[Space::Gaussians, Space::Nodes], &[]);
        starts_still(&spec, ROWS);
    }
}

// ssm.
#[test]
fn ssm() {
    let skin = SkinSpec { nodes: 7, neighbours: 3, hyper: 2, mask: false };
    let small = SsmSpec { skin, ticks: 9, width: 6, states: 2, embedding: 3, octaves: 2, ..SsmSpec::default() };
    let kinds = [
        (Mode::Bidirectional, Output::Absolute, Equivariance::None),
        (Mode::Causal, Output::Twist, Equivariance::None),
        (Mode::Bidirectional, Output::Twist, Equivariance::Frames),
        (Mode::Bidirectional, Output::Absolute, Equivariance::Vector),
    ];
    for (mode, output, equivariance) in kinds {
        let spec = Spec::Ssm(SsmSpec { mode, output, equivariance, ..small.clone() });
        model(&spec, ROWS, LifeKind::Infinite, &[Space::Gaussians, Space::Nodes], &[]);
        starts_still(&spec, ROWS);
    }
}

// filtered.
