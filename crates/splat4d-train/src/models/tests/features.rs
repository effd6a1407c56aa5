//! Features and their head (the full model of Spacetime Gaussians) through the whole chain.

use super::*;
use splat4d::layers::Head;
use splat4d::motion::spacetime::FeatureSpec;
use splat4d::scene::HeadKeys;

/// Gaussians with features, and where `beside` a still layer that has none; nothing is at its start.
fn featured<F: Real>(life: LifeKind, detach: bool, beside: bool) -> Scene<F> {
    let mut p = cloud::<F>(12, life, 31);
    let features = Some(FeatureSpec { seed: 4 });
    let spec = Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, detach, origin: 0.1, features });
    let motion = build(&spec, &mut p).unwrap();
    for key in p.keys().skip(3).collect::<Vec<_>>() {
        let weights = p.info(key).space == Space::Fixed;
        shake(&mut p, key, if weights { 0.6 } else { 0.2 }, 1);
    }
    let mut scene = Scene { head: Head::Features, ..one_layer(p, motion, life) };
    if beside {
        let still = build(&Spec::Still, &mut Params::new(0, 1, &[])).unwrap();
        let plain = one_layer(cloud::<F>(5, LifeKind::Infinite, 22), still, LifeKind::Infinite);
        scene.layers.splice(0..0, plain.layers);
    }
    scene
}

#[test]
fn every_gradient_of_features_and_head_equals_finite_differences() {
    for (life, beside) in [(LifeKind::GaussHalf, false), (LifeKind::Infinite, true)] {
        let scene = featured(life, false, beside);
        let reached = check_gradients(&scene, &shots(&[(0, 0.0), (1, 0.13), (2, 0.13)]), &Vec::new());
        let own = if beside { &reached[1] } else { &reached[0] };
        assert_reached(own, &["geometry", "sh", "velocities", "rotation_rates", "features", "head.in", "head.out"]);
        assert!(beside || own.iter().any(|(n, g)| n == "life" && *g > 1e-7));
        assert!(!beside || reached[0].iter().any(|(n, g)| n == "sh" && *g > 1e-7));
    }
}
