//! The contract of motion models: one test a model, all with the same checks (see `check`).

mod check;

use check::{model, starts_still};
use splat4d::motion::hexplane::{Heads, HexplaneSpec};
use splat4d::motion::{SpacetimeSpec, Spec};
use splat4d::nn::hexplane::PlaneShape;
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

/// Small planes and networks of every kind of head.
fn hexplane_spec() -> HexplaneSpec {
    HexplaneSpec {
        low: [-1.3, -1.1, -1.2],
        high: [1.4, 1.2, 1.3],
        planes: PlaneShape { channels: 16, resolution: 4, time_resolution: 5, multires: vec![1, 2] },
        net_width: 8,
        heads: Heads { position: true, scale: true, rotation: true, opacity: true, sh: true },
        ..HexplaneSpec::default()
    }
}

#[test]
fn hexplane() {
    let spec = Spec::Hexplane(hexplane_spec());
    model(&spec, ROWS, LifeKind::Infinite, &[Space::Gaussians], &[]);
    starts_still(&spec, ROWS);
    let spec = HexplaneSpec { defor_depth: 2, heads: Heads::default(), unlocked: 2, ..hexplane_spec() };
    model(&Spec::Hexplane(spec), ROWS, LifeKind::GaussHalf, &[Space::Gaussians], &[]);
}

// tracked.

// native4d.

// control.

// ssm.

// filtered.
