//! A turned world needs no new training: what was learnt of a capture explains the same images of the world turned,
//! shifted and scaled once its layer's frame states so, whatever the model. Models that see no absolute coordinates may
//! also be queried in the turned world itself; the others fail there.

use splat4d::layers::{Layer, Scene};
use splat4d::math::{Se3, Sim3, quat};
use splat4d::motion::ssm::{Equivariance, refresh};
use splat4d::scene::params::QUAT;
use splat4d::scene::{GEOMETRY, Table};
use splat4d_train::capture::ImageStore;
use splat4d_train::eval::run::{EvalOptions, assess};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::{TrainOptions, open_capture, train};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

const SIZE: u32 = 40;
const CAMERAS: usize = 5;
const FRAMES: usize = 6;
/// Decibels that rounding may make.
const ROUNDING: f64 = 0.01;
/// Decibels that are lost at least where a model is queried for motion that it did not learn: its motion goes the wrong
/// way, and what it renders of it in 300 steps is little. An image of a world that was not turned loses more.
const LOST: f64 = 0.25;

/// Where the ball is, in units of the world.
fn ball(frame: usize) -> [f64; 3] {
    let t = frame as f64 / (FRAMES - 1) as f64;
    [1.6 * t - 0.8, 0.5 * (3.0 * t).sin(), 0.3]
}

fn pose(camera: usize) -> Se3 {
    let angle = 0.45 * camera as f64 - 0.9;
    Se3::look_at([3.0 * angle.sin(), 0.4, -3.0 * angle.cos()], [0.0; 3], [0.0, -1.0, 0.0])
}

/// The capture of a ball in a world that `g` turned: images are the same for every `g`.
fn write_capture(folder: &Path, g: &Sim3) {
    let mut cameras = Vec::new();
    for camera in 0..CAMERAS {
        let at = pose(camera);
        std::fs::create_dir_all(folder.join(format!("images/{camera}"))).unwrap();
        for frame in 0..FRAMES {
            let c = at.apply(ball(frame));
            let (u, v, r) = (44.0 * c[0] / c[2] + 20.0, 44.0 * c[1] / c[2] + 20.0, 44.0 * 0.45 / c[2]);
            let color = |x: u32, y: u32| {
                let (dx, dy) = (f64::from(x) + 0.5 - u, f64::from(y) + 0.5 - v);
                image::Rgb(if dx * dx + dy * dy < r * r { [210, (120.0 + 6.0 * dy) as u8, 40] } else { [30, 50, 90] })
            };
            let path = folder.join(format!("images/{camera}/{frame:02}.png"));
            image::RgbImage::from_fn(SIZE, SIZE, color).save(path).unwrap();
        }
        let there = g.pose(&at);
        let row = |k: usize| {
            let [x, y, z] = there.rotation[k];
            [x, y, z, there.translation[k]]
        };
        cameras.push(serde_json::json!({
            "name": format!("cam{camera}"), "width": SIZE, "height": SIZE, "fx": 44, "fy": 44, "cx": 20, "cy": 20,
            "world_to_camera": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            "images": format!("images/{camera}/%02d.png"),
        }));
    }
    let text = serde_json::json!({
        "version": 1, "fps": 10, "cameras": cameras, "up": [0, -1, 0], "hold_out": {"cameras": ["cam2"]},
    });
    std::fs::write(folder.join("capture.json"), text.to_string()).unwrap();
}

fn recipe(motion: &str) -> Recipe {
    let mut recipe = Recipe::default();
    let common = "iterations=300 num_pts=300 max_cap=400 init=random sh_degree=0 checkpoint_interval=1000 control_nodes=24 \
                  ssm_ticks=8 ssm_width=8 ssm_states=4 deform_trunk=small plane_channels=16 plane_resolution=8";
    for assignment in common.split_whitespace().chain(motion.split_whitespace()) {
        recipe.set(assignment).unwrap();
    }
    recipe
}

/// Held-out PSNR of a scene on a capture.
fn psnr(scene: &Scene<f32>, capture: &Path, recipe: &Recipe) -> f64 {
    let capture = Arc::new(open_capture(capture, recipe).unwrap());
    let store = Arc::new(ImageStore::new(capture.clone(), usize::MAX));
    let options = EvalOptions { pictures: false, train_views: 0, ..EvalOptions::default() };
    assess(scene, &capture, &store, 0, &options, &AtomicBool::new(false), &mut |_| {}).unwrap().held("PSNR").unwrap()
}

/// The scene with `g` in its tables of Gaussians and nodes, and nowhere else.
fn moved(scene: &Scene<f32>, g: &Sim3) -> Scene<f32> {
    let mut out = scene.clone();
    let Layer { params, .. } = &mut out.layers[0];
    let q = quat::from_rotation(&g.rotation).map(|x| x as f32);
    let shift = |table: &mut Table<f32>| {
        for row in 0..table.rows() {
            table.write(row, 0, g.apply(table.read::<3>(row, 0).map(f64::from)).map(|x| x as f32));
        }
    };
    shift(&mut params[GEOMETRY]);
    for row in 0..params.len() {
        let turned = quat::product(q, params[GEOMETRY].read::<4>(row, QUAT));
        params[GEOMETRY].write(row, QUAT, turned);
    }
    if let Some(nodes) = params.find("nodes") {
        shift(&mut params[nodes]);
    }
    out
}

#[test]
fn a_turned_world_needs_no_new_training() {
    let folder = tempfile::tempdir().unwrap();
    let rotation = quat::to_rotation(quat::normalize([0.4, -0.7, 0.5, 0.2]).0);
    let still = Sim3::from_rotation([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    let turn = Sim3 { scale: 1.0, rotation, translation: [0.7, -1.1, 0.4] };
    let grown = Sim3 { scale: 2.5, ..turn };
    let [here, there, larger] = ["here", "there", "larger"].map(|name| folder.path().join(name));
    for (path, g) in [(&here, still), (&there, turn), (&larger, grown)] {
        write_capture(path, &g);
    }
    let models = [
        ("motion=ssm ssm_equivariance=frames", Some(Equivariance::Frames)),
        ("motion=ssm ssm_equivariance=vector", Some(Equivariance::Vector)),
        ("motion=ssm", Some(Equivariance::None)),
        ("motion=control control_trajectory=network control_width=16 control_layers=2", None),
        ("motion=deform-mlp", None),
        ("motion=hexplane", None),
    ];
    for (i, (motion, context)) in models.into_iter().enumerate() {
        let (recipe, run) = (recipe(motion), folder.path().join(i.to_string()));
        let capture = Arc::new(open_capture(&here, &recipe).unwrap());
        train(capture, recipe.clone(), &run, &TrainOptions::default(), &AtomicBool::new(false), &mut |_| {}).unwrap();
        let scene = splat4d::format::scene::read(&std::fs::read(run.join("scene.safetensors")).unwrap()).unwrap();
        let before = psnr(&scene, &here, &recipe);
        // Turned, shifted and scaled by the frame: the same images, and by no frame another place.
        let mut framed = scene.clone();
        framed.layers[0].frame = grown;
        let after = psnr(&framed, &larger, &recipe);
        println!("{motion}: {before:.3} dB, by its frame in the turned world {after:.3}");
        assert!((after - before).abs() < ROUNDING, "{motion}: {before} and {after} dB");
        assert!(psnr(&scene, &larger, &recipe) < before - LOST, "{motion}: nothing was turned");
        // Gaussians and nodes are in the turned world, and the model is queried there. The nodes' context is computed
        // again, as wherever nodes are moved: also in the world that was not turned, since nodes learn.
        let ask = |g: &Sim3, capture: &Path| {
            let mut asked = moved(&scene, g);
            if let Some(e) = context {
                refresh(e, &mut asked.layers[0].params);
            }
            psnr(&asked, capture, &recipe)
        };
        let (rest, inside) = (ask(&still, &here), ask(&turn, &there));
        println!("    asked at rest {rest:.3}, in the turned world {inside:.3}");
        match context {
            Some(Equivariance::Frames | Equivariance::Vector) => {
                assert!((inside - rest).abs() < ROUNDING, "{motion}: {rest} and {inside} dB");
            }
            _ => assert!(inside < rest - LOST, "{motion}: {rest} and {inside} dB, and it sees where it is"),
        }
    }
}
