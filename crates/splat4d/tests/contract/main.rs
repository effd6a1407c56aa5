//! The contract of motion models: one test a model, all with the same checks (see `check`).

mod check;

use check::{model, starts_still};
use splat4d::motion::native4d::Native4dSpec;
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

#[test]
fn native4d() {
    for harmonics in [0, 2] {
        let spec = Native4dSpec { speed: 1.4, harmonics, period: 0.9, ..Native4dSpec::default() };
        model(&Spec::Native4d(spec), ROWS, LifeKind::Infinite, &[Space::Gaussians], &[]);
    }
    let spec = Spec::Native4d(Native4dSpec::default());
    model(&spec, ROWS, LifeKind::GaussHalf, &[Space::Gaussians], &[]);
}

// control.

// ssm.

// filtered.
