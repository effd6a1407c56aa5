//! The contract of motion models: one test a model, all with the same checks (see `check`).

mod check;
mod frame;

use check::{model, starts_still};
use splat4d::motion::control::{ControlSpec, Curve, TrajectorySpec};
use splat4d::motion::deform::{DeformSpec, Input};
use splat4d::motion::edited::{Change, ColorMap, DragSpec, EditedSpec, FadeKey, PathKey};
use splat4d::motion::filtered::{FilteredSpec, Fusion, Predictor};
use splat4d::motion::hexplane::{Heads, HexplaneSpec};
use splat4d::motion::native4d::Native4dSpec;
use splat4d::motion::skin::SkinSpec;
use splat4d::motion::spacetime::FeatureSpec;
use splat4d::motion::ssm::{Equivariance, Mode, Output, SsmSpec};
use splat4d::motion::tracked::TrackedSpec;
use splat4d::motion::{SpacetimeSpec, Spec};
use splat4d::nn::HashShape;
use splat4d::nn::hexplane::PlaneShape;
use splat4d::scene::{LifeKind, Space};

/// Gaussians of a synthetic layer: more than a block, and no multiple of one.
const ROWS: usize = 21;

#[test]
fn still() {
    model(&Spec::Still, ROWS, LifeKind::Infinite, &[Space::Gaussians], &[]);
    starts_still(&Spec::Still, ROWS);
}

#[test]
fn spacetime() {
    for (order, rotation) in [(1, false), (3, true)] {
        let spec = Spec::Spacetime(SpacetimeSpec { order, rotation, detach: false, origin: 0.5, features: None });
        model(&spec, ROWS, LifeKind::GaussHalf, &[Space::Gaussians], &[]);
        starts_still(&spec, ROWS);
    }
}

#[test]
fn spacetime_with_features() {
    let features = Some(FeatureSpec { seed: 1 });
    let spec = Spec::Spacetime(SpacetimeSpec { order: 1, rotation: false, detach: false, origin: 0.5, features });
    // The head is evaluated by the renderer.
    for life in [LifeKind::GaussHalf, LifeKind::Infinite] {
        model(&spec, ROWS, life, &[Space::Gaussians], &["head.in", "head.out"]);
    }
    starts_still(&spec, ROWS);
}

// deform-mlp.

#[test]
fn deform_mlp() {
    let grid = |levels, finest| HashShape { levels, features: 2, log2_size: 7, base: 2, finest };
    for (input, layers, rigid) in [
        (Input::Encoded { x_levels: 2, t_levels: 2, time_net: true }, 3, false),
        (Input::Encoded { x_levels: 2, t_levels: 2, time_net: false }, 1, true),
        (Input::Hashed { space: grid(3, 9), time: grid(2, 5) }, 2, false),
        (Input::Hashed { space: grid(2, 6), time: grid(2, 5) }, 0, true),
    ] {
        let skip = (layers > 2).then_some(1);
        let spec = DeformSpec { seed: 2, clip: [0.0, 1.0], input, width: 9, layers, skip, rigid };
        let spec = Spec::DeformMlp(spec);
        // The network's input is detached from the means.
        model(&spec, ROWS, LifeKind::Infinite, &[Space::Gaussians], &["means"]);
        model(&spec, ROWS, LifeKind::GaussHalf, &[Space::Gaussians], &["means"]);
        starts_still(&spec, ROWS);
    }
}

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
    let spec = HexplaneSpec { defor_depth: 2, heads: Heads::default(), unlocked: Some(2), ..hexplane_spec() };
    model(&Spec::Hexplane(spec), ROWS, LifeKind::GaussHalf, &[Space::Gaussians], &[]);
}

// tracked.

#[test]
fn tracked() {
    // One frame only; a frame at a queried time, gaps, a late start and an early end.
    for times in [vec![0.2], vec![0.0, 0.25, 0.5, 1.0], vec![0.3, 0.9, 1.1]] {
        let spec = Spec::Tracked(TrackedSpec { times, foreground: false });
        model(&spec, ROWS, LifeKind::Infinite, &[Space::Gaussians], &[]);
        model(&spec, ROWS, LifeKind::GaussHalf, &[Space::Gaussians], &[]);
        starts_still(&spec, ROWS);
    }
}

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

#[test]
fn filtered() {
    let inner = Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, detach: false, origin: 0.5, features: None });
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

// edited.

#[test]
fn edited() {
    let key = |t, scale, turn, shift| PathKey { t, scale, turn, shift, ease: t > 0.0 };
    let keys = vec![
        key(-0.37, 1.0, [1.0, 0.2, 0.0, 0.1], [0.0, 0.1, 0.0]),
        key(0.513, 1.3, [0.7, -0.4, 0.3, 0.2], [0.3, 0.1, -0.2]),
        key(1.71, 0.8, [-0.6, 0.4, 0.1, -0.2], [-0.1, 0.2, 0.4]),
    ];
    let matrix = [[0.8, 0.1, 0.05], [0.02, 1.1, -0.1], [0.1, 0.0, 0.9]];
    let curve = vec![[0.0, 0.05], [0.513, 0.6], [1.0, 0.9]];
    let fades = [(-0.2, 0.9), (0.63, 0.4), (1.4, 1.0)].map(|(t, factor)| FadeKey { t, factor, ease: t > 1.0 });
    let changes = [
        Change::Clock { rate: -0.7, offset: 0.9 },
        Change::Path { about: [0.1, -0.2, 0.3], keys },
        Change::Color { map: ColorMap { matrix, offset: [0.1, 0.0, -0.1], curve } },
        Change::Fade { keys: fades.to_vec() },
        Change::Drag(DragSpec { index: 0, nodes: 3, neighbours: 2, times: vec![0.0, 0.4] }),
    ];
    let harmonics = Native4dSpec { speed: 1.4, harmonics: 2, period: 0.9, ..Native4dSpec::default() };
    let skin = SkinSpec { nodes: 7, neighbours: 3, hyper: 2, mask: false };
    let control = ControlSpec { seed: 3, clip: [0.0, 1.0], skin, ..ControlSpec::default() };
    for change in changes {
        let around = |inner| Spec::Edited(EditedSpec { inner: Box::new(inner), change: change.clone() });
        model(&around(Spec::Hexplane(hexplane_spec())), ROWS, LifeKind::Infinite, &[Space::Gaussians], &[]);
        model(&around(Spec::Native4d(harmonics)), ROWS, LifeKind::Infinite, &[Space::Gaussians], &[]);
        model(
            &around(Spec::Control(control.clone())),
            ROWS,
            LifeKind::GaussHalf,
            &[Space::Gaussians, Space::Nodes],
            &[],
        );
        if !matches!(change, Change::Clock { .. }) {
            let spec = SpacetimeSpec { order: 2, rotation: true, detach: false, origin: 0.5, features: None };
            model(&around(Spec::Spacetime(spec)), ROWS, LifeKind::GaussHalf, &[Space::Gaussians], &[]);
        }
    }
}
