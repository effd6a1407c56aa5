//! Flow of scenes whose flow is known exactly, in f64.

use super::*;
use crate::layers::Layer;
use crate::math::Se3;
use crate::motion::{SpacetimeSpec, Spec, build_as};
use crate::render::RenderConfig;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, LIFE, LifeKind, Params};

/// Flow of an exactly known field, pixels: only rounding is left.
const EXACT: f64 = 1e-9;
/// Flow where the field is not constant under a splat, pixels: the camera comes 8 % nearer, so that the field changes
/// by .08 px a pixel, and the centre of the splat that a pixel shows may be a pixel aside.
const UNDER_A_SPLAT: f64 = 0.08;
/// Edge of the test images, pixels.
const SIZE: usize = 40;

fn camera(eye: [f64; 3], target: [f64; 3]) -> Camera {
    Camera::with_fov_y(Se3::look_at(eye, target, [0.0, 1.0, 0.0]), 0.7, SIZE, SIZE)
}

/// A dense opaque wall at z = 0, seen from z = 4, that moves with `velocity` around t = `center`.
fn wall(velocity: [f64; 3], life: LifeKind) -> Scene<f64> {
    let side = 48;
    let rows = side * side;
    let mut p = Params::<f64>::new(rows, 1, life.columns());
    for r in 0..rows {
        let at = |k: usize| (k as f64 / (side - 1) as f64 - 0.5) * 4.8;
        p[GEOMETRY].write(r, 0, [at(r % side), at(r / side), 0.0]);
        p[GEOMETRY].write(r, QUAT, [1.0, 0.0, 0.0, 0.0]);
        p[GEOMETRY].write(r, LOG_SCALE, [-3.0; 3]);
        p[GEOMETRY].set(r, OPACITY, 2.0);
        if life != LifeKind::Infinite {
            p[LIFE].write(r, 0, [0.5, -0.5]);
        }
    }
    let spec = Spec::Spacetime(SpacetimeSpec { order: 1, origin: 0.5, ..SpacetimeSpec::default() });
    let motion = build_as(&spec, &mut p).unwrap();
    let key = p.find("velocities").unwrap();
    (0..rows).for_each(|r| p[key].write(r, 0, velocity));
    let layer = Layer::new("wall", p, motion, life);
    Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 10.0, ..Scene::default() }
}

fn renderer() -> Renderer<f64> {
    Renderer::new(RenderConfig::default())
}

/// The velocity of what each pixel shows, in scene units per second: [3, h, w] world axes.
fn render_velocity(scene: &Scene<f64>, shot: Shot<'_>, renderer: &mut Renderer<f64>) -> Flow<f64> {
    let mut instant = Evaluation::default();
    scene.at(shot.t, &mut instant);
    let extra = velocity_columns(scene, &instant);
    draw(&scene.splats(&instant), shot.camera, scene.background, &extra, renderer)
}

/// Calls `f(x, y, flow)` for every pixel that shows the wall.
fn each_pixel(flow: &Flow<f64>, mut f: impl FnMut(usize, usize, [f64; 2])) {
    let mut count = 0;
    for y in 0..SIZE {
        for x in 0..SIZE {
            if flow.weight.get(0, y, x) > 0.9 {
                count += 1;
                f(x, y, [flow.vectors.get(0, y, x), flow.vectors.get(1, y, x)]);
            }
        }
    }
    assert!(count > SIZE * SIZE / 2, "the wall fills the picture: {count} pixels");
}

#[test]
fn flow_of_a_static_scene_is_zero() {
    let (scene, eye) = (wall([0.0; 3], LifeKind::GaussHalf), camera([0.4, 0.3, 4.0], [0.0; 3]));
    let shot = |t: f64| Shot { t: Time(t), camera: &eye };
    let flow = render_flow(&scene, shot(0.3), shot(0.8), &mut renderer());
    assert!(flow.vectors.data.iter().all(|v| *v == 0.0));
    let velocity = render_velocity(&scene, shot(0.3), &mut renderer());
    assert!(velocity.vectors.data.iter().all(|v| *v == 0.0));
}

#[test]
fn a_moving_camera_over_a_still_wall_is_depth_reprojection() {
    let scene = wall([0.0; 3], LifeKind::Infinite);
    let from = camera([0.0, 0.0, 4.0], [0.0; 3]);
    let reprojected = |flow: &Flow<f64>, to: &Camera, x: usize, y: usize| {
        let p = [x as f64 + 0.5, y as f64 + 0.5];
        let z = flow.image.depth.get(0, y, x) / flow.image.alpha.get(0, y, x);
        let (q, _) = to.project(from.unproject(p, z)).unwrap();
        [q[0] - p[0], q[1] - p[1]]
    };
    // A sideways step of the camera shifts a wall of one depth by the same everywhere: exact.
    let aside = camera([0.2, -0.1, 4.0], [0.2, -0.1, 0.0]);
    let shot = |camera| Shot { t: Time(0.5), camera };
    let flow = render_flow(&scene, shot(&from), shot(&aside), &mut renderer());
    each_pixel(&flow, |x, y, f| {
        let g = reprojected(&flow, &aside, x, y);
        assert!((f[0] - g[0]).abs() < EXACT && (f[1] - g[1]).abs() < EXACT, "{x} {y}: {f:?} {g:?}");
        assert!(f[0].abs() > 1.0, "the camera did move");
    });
    // Nearer, and turned: the field varies under a splat.
    let nearer = camera([0.3, 0.1, 3.7], [0.1, 0.0, 0.0]);
    let flow = render_flow(&scene, shot(&from), shot(&nearer), &mut renderer());
    each_pixel(&flow, |x, y, f| {
        // The wall ends beyond the image's edge by less than the splats there reach.
        let inside = (4..SIZE - 4).contains(&x) && (4..SIZE - 4).contains(&y);
        let g = reprojected(&flow, &nearer, x, y);
        let e = (f[0] - g[0]).abs().max((f[1] - g[1]).abs());
        assert!(!inside || e < UNDER_A_SPLAT, "{x} {y}: {f:?} {g:?}");
    });
}

#[test]
fn a_translating_wall_has_constant_flow_and_velocity() {
    let velocity = [0.6, -0.4, 0.0];
    let eye = camera([0.0, 0.0, 4.0], [0.0; 3]);
    for life in [LifeKind::Infinite, LifeKind::GaussHalf] {
        let scene = wall(velocity, life);
        let shot = |t: f64| Shot { t: Time(t), camera: &eye };
        let (from, to) = (0.4, 0.65);
        // Seen from +z with +y up: x runs right, y runs against the image's.
        let scale = eye.intrinsics.fx / 4.0 * (to - from);
        let truth = [velocity[0] * scale, -velocity[1] * scale];
        let forward = render_flow(&scene, shot(from), shot(to), &mut renderer());
        each_pixel(&forward, |x, y, f| {
            assert!((f[0] - truth[0]).abs() < EXACT && (f[1] - truth[1]).abs() < EXACT, "{x} {y}: {f:?} {truth:?}");
        });
        // A path forwards and back ends at its start.
        let backward = render_flow(&scene, shot(to), shot(from), &mut renderer());
        each_pixel(&backward, |_, _, b| {
            assert!((b[0] + truth[0]).abs() < EXACT && (b[1] + truth[1]).abs() < EXACT);
        });
        let moving = render_velocity(&scene, shot(from), &mut renderer());
        for (i, v) in moving.vectors.data.iter().enumerate() {
            let p = i % (SIZE * SIZE);
            if moving.weight.data[p] > 0.9 {
                assert!((v - velocity[i / (SIZE * SIZE)]).abs() < EXACT);
            }
        }
    }
}

#[test]
fn forward_and_backward_flow_of_a_turning_camera_are_inverse() {
    let scene = wall([0.1, 0.2, 0.0], LifeKind::Infinite);
    let [a, b] = [camera([0.0, 0.0, 4.0], [0.0; 3]), camera([0.15, 0.05, 3.95], [0.02, 0.0, 0.0])];
    let (from, to) = (Shot { t: Time(0.4), camera: &a }, Shot { t: Time(0.6), camera: &b });
    let forward = render_flow(&scene, from, to, &mut renderer());
    let backward = render_flow(&scene, to, from, &mut renderer());
    let mut compared = 0;
    for y in 6..SIZE - 6 {
        for x in 6..SIZE - 6 {
            let f = [0, 1].map(|c| forward.vectors.get(c, y, x));
            let Some(g) = sample(&backward.vectors, x as f64 + f[0], y as f64 + f[1]) else { continue };
            let e = (f[0] + g[0]).hypot(f[1] + g[1]);
            assert!(e < UNDER_A_SPLAT, "{x} {y}: {f:?} {g:?}");
            assert!(e * e < 0.01 * (f[0].powi(2) + f[1].powi(2)) + 0.5, "the usual occlusion test finds none");
            compared += 1;
        }
    }
    assert!(compared > SIZE * SIZE / 3);
}

/// Bilinear, at pixel coordinates whose integers are pixel centres.
fn sample(planes: &Planes<f64>, x: f64, y: f64) -> Option<[f64; 2]> {
    let (i, j) = (x.floor(), y.floor());
    if i < 4.0 || j < 4.0 || i > (SIZE - 6) as f64 || j > (SIZE - 6) as f64 {
        return None;
    }
    let (u, v, i, j) = (x - i, y - j, i as usize, j as usize);
    Some([0, 1].map(|c| {
        let at = |a: usize, b: usize| planes.get(c, j + b, i + a);
        (1.0 - u) * (1.0 - v) * at(0, 0) + u * (1.0 - v) * at(1, 0) + (1.0 - u) * v * at(0, 1) + u * v * at(1, 1)
    }))
}

#[test]
fn velocities_follow_the_order_of_the_splats_through_all_layers() {
    let mut scene = wall([0.5, 0.0, 0.0], LifeKind::GaussHalf);
    // Every third Gaussian of the first layer is dead at that time; a second layer moves otherwise.
    for r in (0..scene.layers[0].params.len()).step_by(3) {
        scene.layers[0].params[LIFE].write(r, 0, [9.0, -3.0]);
    }
    scene.layers.extend(wall([0.0, 0.25, 0.0], LifeKind::Infinite).layers);
    let mut instant = Evaluation::default();
    scene.at(Time(0.4), &mut instant);
    let v = velocities(&scene, &instant);
    let first = instant.tape(0).out().rows();
    assert!(first > 0 && first < scene.layers[0].params.len());
    assert_eq!(v.rows(), scene.splats(&instant).len());
    assert!((0..v.rows()).all(|j| v.read::<3>(j, 0) == if j < first { [0.5, 0.0, 0.0] } else { [0.0, 0.25, 0.0] }));
}

#[test]
fn a_splat_behind_the_second_camera_has_no_vector() {
    let scene = wall([0.0; 3], LifeKind::Infinite);
    let (front, away) = (camera([0.0, 0.0, 4.0], [0.0; 3]), camera([0.0, 0.0, -1.0], [0.0, 0.0, -5.0]));
    let shot = |camera| Shot { t: Time(0.5), camera };
    let flow = render_flow(&scene, shot(&front), shot(&away), &mut renderer());
    assert!(flow.weight.data.iter().all(|w| *w == 0.0) && flow.vectors.data.iter().all(|v| *v == 0.0));
}
