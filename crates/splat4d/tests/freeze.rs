//! A dynamic scene at one time as plain Gaussians.

use splat4d::layers::{Evaluation, Layer, Scene, freeze};
use splat4d::math::Rng;
use splat4d::motion::{SpacetimeSpec, Spec, build};
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::params::LOG_SCALE;
use splat4d::scene::{Camera, GEOMETRY, LifeKind, Params, Time};

/// A cloud that moves and turns.
fn scene() -> Scene<f32> {
    let rng = Rng::new(5, "freeze", 0);
    let life = LifeKind::GaussHalf;
    let mut params = Params::new(60, 4, life.columns());
    let spec = Spec::Spacetime(SpacetimeSpec { order: 1, rotation: true, detach: false, origin: 0.0, features: None });
    let motion = build(&spec, &mut params).unwrap();
    for key in params.keys() {
        let table = &mut params.get_mut([key])[0];
        for row in 0..table.rows() {
            for col in 0..table.width() {
                let noise = rng.normal((row * 64 + col) as u64 + 4096 * u64::from(key.0)) as f32;
                table.set(row, col, 0.5 * noise);
            }
        }
    }
    let geometry = &mut params.get_mut([GEOMETRY])[0];
    for row in 0..60 {
        for k in 0..3 {
            *geometry.get_mut(row, LOG_SCALE + k) -= 2.0;
        }
    }
    let layer = Layer::new("a", params, motion, life);
    Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, ..Scene::default() }
}

#[test]
fn a_frozen_scene_renders_as_the_scene_at_that_time() {
    let scene = scene();
    let pose = splat4d::math::Se3::look_at([0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
    let camera = Camera::with_fov_y(pose, 0.9, 48, 40);
    let draw = |scene: &Scene<f32>, time: f64| {
        let (mut instant, mut image) = (Evaluation::default(), Image::default());
        scene.at(Time(time), &mut instant);
        let mut renderer = Renderer::new(RenderConfig::default());
        renderer.render(&Shot::new(&scene.splats(&instant), &camera, [0.2; 3]), &mut image);
        image.color
    };
    for time in [0.0, 0.37, 1.0] {
        let mut params = freeze(&scene, Time(time)).unwrap();
        let motion = build(&Spec::Still, &mut params).unwrap();
        let still = Layer::new("still", params, motion, LifeKind::Infinite);
        let frozen = Scene { layers: vec![still], ..Scene::default() };
        let (a, b) = (draw(&scene, time), draw(&frozen, 0.0));
        let worst = a.data.iter().zip(&b.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 2e-3, "{time}: {worst}");
        let seen = a.data.iter().filter(|v| (**v - 0.2).abs() > 0.05).count();
        assert!(seen > 200, "the test must look at something: {seen}");
    }
}
