//! The contract of motion models: one test a model, all with the same checks (see `check`).

mod check;

use check::{model, starts_still};
use splat4d::motion::tracked::TrackedSpec;
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

#[test]
fn tracked() {
    // One frame only; a frame on a moment that is asked, gaps, a late start and an early end.
    for times in [vec![0.2], vec![0.0, 0.25, 0.5, 1.0], vec![0.3, 0.9, 1.1]] {
        let spec = Spec::Tracked(TrackedSpec { times, foreground: false });
        model(&spec, ROWS, LifeKind::Infinite, &[Space::Gaussians], &[]);
        model(&spec, ROWS, LifeKind::GaussHalf, &[Space::Gaussians], &[]);
        starts_still(&spec, ROWS);
    }
}

// native4d.

// control.

// ssm.

// filtered.
