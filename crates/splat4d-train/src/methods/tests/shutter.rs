//! Rolling shutter and motion blur: renders against rows rendered one by one, gradients against central differences.

use super::*;
use crate::capture::shutter::Shutter;
use crate::step::shutter::{self, Taken};
use splat4d::layers::Evaluation;
use splat4d::render::Shot as Look;

const ROLLING: Shutter = Shutter { readout: 0.06, exposure: 0.0, subframes: 1, twist: [0.0; 6] };
const BLUR: Shutter = Shutter { readout: 0.0, exposure: 0.06, subframes: 3, twist: [0.0; 6] };
/// A camera that turns and moves, per second.
const TWIST: [f64; 6] = [0.6, -0.3, 0.4, 0.2, -0.5, 0.3];

/// Gaussians that move by about a fifth of the image a second.
fn moving() -> Scene<f64> {
    let mut params = cloud::<f64>(9, LifeKind::GaussHalf, 61);
    let motion = build_as(&Spec::Spacetime(SpacetimeSpec::default()), &mut params).unwrap();
    let velocities = params.find("velocities").unwrap();
    shake(&mut params, velocities, 0.5, 3);
    one_layer(params, motion, LifeKind::GaussHalf)
}

fn with(shutter: Shutter, list: &[(usize, f64)]) -> Vec<Shot> {
    shots(list).into_iter().map(|s| Shot { shutter: Some(shutter), ..s }).collect()
}

/// The scene at a time, from a pose: colours.
fn ideal(scene: &Scene<f64>, camera: &Camera, t: f64) -> Planes<f64> {
    let (mut evaluation, mut image) = (Evaluation::default(), Image::default());
    scene.at(Time(t), &mut evaluation);
    let splats = scene.splats(&evaluation);
    Renderer::new(smooth()).render(&Look::new(&splats, camera, scene.background.map(f64::from)), &mut image);
    image.color
}

fn taken(scene: &Scene<f64>, camera: &Camera, t: f64, shutter: &Shutter) -> Planes<f64> {
    let (mut evaluation, mut image) = (Evaluation::default(), Image::default());
    let taken = Taken { camera, t: Time(t), shutter };
    shutter::render(scene, taken, &mut evaluation, &mut Renderer::new(smooth()), &mut image).unwrap();
    image.color
}

fn apart(a: &Planes<f64>, b: &Planes<f64>) -> f64 {
    let sum: f64 = a.data.iter().zip(&b.data).map(|(x, y)| (x - y) * (x - y)).sum();
    (sum / a.data.len() as f64).sqrt()
}

/// From the camera as it has moved.
fn later(camera: &Camera, twist: [f64; 6], seconds: f64) -> Camera {
    let pose = crate::train_state::moved(&camera.cam_from_world, twist.map(|x| x * seconds));
    Camera { cam_from_world: pose, ..camera.clone() }
}

/// Small Gaussians: a large one has one time, and its rows have many.
fn small(mut scene: Scene<f64>) -> Scene<f64> {
    let table = &mut scene.layers[0].params[GEOMETRY];
    for row in 0..table.rows() {
        table.write(row, LOG_SCALE, [-3.0; 3]);
    }
    scene
}

#[test]
fn every_row_shows_its_own_time() {
    let scene = small(moving());
    let camera = Made::new(3, 1, 48).camera(0).clone();
    for twist in [[0.0; 6], TWIST] {
        let shutter = Shutter { twist, ..ROLLING };
        let mut truth = ideal(&scene, &camera, 0.1);
        for y in 0..camera.height {
            let after = shutter.row((y as f64 + 0.5) / camera.height as f64);
            let row = ideal(&scene, &later(&camera, twist, after), 0.1 + after);
            for c in 0..3 {
                let of = y * camera.width..(y + 1) * camera.width;
                truth.plane_mut(c)[of.clone()].copy_from_slice(&row.plane(c)[of]);
            }
        }
        let plain = apart(&ideal(&scene, &camera, 0.1), &truth);
        let rolled = apart(&taken(&scene, &camera, 0.1, &shutter), &truth);
        assert!(rolled < 0.35 * plain, "{twist:?}: {rolled} with the shutter, {plain} without");
        let reversed = Shutter { readout: -shutter.readout, ..shutter };
        assert!(apart(&taken(&scene, &camera, 0.1, &reversed), &truth) > plain, "the direction of the rows counts");
    }
}

#[test]
fn an_exposure_is_the_average_of_its_light() {
    let scene = small(moving());
    let camera = Made::new(3, 1, 48).camera(0).clone();
    for twist in [[0.0; 6], TWIST] {
        let shutter = Shutter { twist, ..BLUR };
        let count = 64;
        let mut truth = Planes::<f64>::new(3, camera.height, camera.width);
        for k in 0..count {
            let after = ((k as f64 + 0.5) / f64::from(count) - 0.5) * shutter.exposure;
            let image = ideal(&scene, &later(&camera, twist, after), 0.1 + after);
            let light = truth.data.iter_mut().zip(&image.data);
            light.for_each(|(sum, code)| *sum += code.powf(2.2) / f64::from(count));
        }
        truth.data.iter_mut().for_each(|light| *light = light.powf(1.0 / 2.2));
        let plain = apart(&ideal(&scene, &camera, 0.1), &truth);
        let errors =
            [1, 3, 7].map(|n| apart(&taken(&scene, &camera, 0.1, &Shutter { subframes: n, ..shutter }), &truth));
        assert!(errors[0] > 0.9 * plain && errors[1] < 0.3 * plain && errors[2] < 0.1 * plain, "{plain}: {errors:?}");
    }
}

#[test]
fn blurred_images_have_the_gradient_of_the_loss() {
    let list = [(0, 0.03), (1, 0.14), (2, 0.14)];
    let reached = check_gradients(&moving(), &with(BLUR, &list), &Vec::new());
    assert_reached(&reached[0], &["geometry", "velocities", "life", "sh"]);
    // Of a camera that moves, Gaussians have the exact gradient.
    let turning = Shutter { twist: TWIST, ..BLUR };
    assert_reached(&check_gradients(&moving(), &with(turning, &list), &Vec::new())[0], &["geometry", "velocities"]);
}

/// The gradient treats rows as fixed: what it neglects is the share of the image that Gaussians cross in the readout.
#[test]
fn rolling_images_have_nearly_the_gradient_of_the_loss() {
    let scene = moving();
    let shots = with(ROLLING, &[(0, 0.03), (1, 0.14)]);
    let (report, d, _) = step(&scene, &shots, &Vec::new(), &mut Renderer::new(smooth()));
    assert_close(report.loss, value(&scene, &shots, &Vec::new()), "the loss");
    let params = &scene.layers[0].params;
    for key in [GEOMETRY, params.find("velocities").unwrap(), LIFE, SH] {
        let (mut off, mut all) = (0.0, 0.0);
        for (row, col) in (0..params[key].rows()).flat_map(|r| (0..params[key].width()).map(move |c| (r, c))) {
            let moved = |by: f64| {
                let mut s = scene.clone();
                *s.layers[0].params[key].get_mut(row, col) += by;
                value(&s, &shots, &Vec::new())
            };
            let fd = (moved(H) - moved(-H)) / (2.0 * H);
            off += (d[0].table(key).get(row, col) - fd).powi(2);
            all += fd * fd;
        }
        let share = (off / all).sqrt();
        assert!(share < 0.03, "{}: {share}", params.info(key).name);
    }
    let later = |by: f64| {
        let shots: Vec<Shot> = shots.iter().map(|s| Shot { t: s.t + by, ..s.clone() }).collect();
        value(&scene, &shots, &Vec::new())
    };
    let (sum, fd) = (report.d_times.iter().sum::<f64>(), (later(H) - later(-H)) / (2.0 * H));
    assert!((sum - fd).abs() < 0.05 * fd.abs(), "dL/dt: {sum}, {fd}");
}
