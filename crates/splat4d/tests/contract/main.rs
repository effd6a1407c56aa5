//! The contract of motion models: one test a model, all with the same checks (see `check`).

mod check;

use check::{model, starts_still};
use splat4d::motion::filtered::{FilteredSpec, Fusion, Predictor};
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

// ssm.

// filtered.

#[test]
fn filtered() {
    let inner = Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, detach: false, origin: 0.5 });
    let around = FilteredSpec { stop_gradient: false, ..FilteredSpec::around(inner, 0.05, 0.0) };
    for (fusion, predictor, baseline) in [
        (Fusion::Geodesic, Predictor::Wasserstein, 1),
        (Fusion::Geodesic, Predictor::Euclidean, 3),
        (Fusion::Literal, Predictor::Hold, 1),
        (Fusion::Literal, Predictor::Wasserstein, 2),
        (Fusion::Off, Predictor::Wasserstein, 1),
    ] {
        let spec = Spec::Filtered(FilteredSpec { fusion, predictor, baseline, ..around.clone() });
        model(&spec, ROWS, LifeKind::GaussHalf, &[Space::Gaussians], &[]);
        if fusion != Fusion::Literal {
            starts_still(&spec, ROWS);
        }
    }
}
