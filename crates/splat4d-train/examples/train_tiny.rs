//! Trains a synthetic dynamic scene in seconds, without a file: the renderer makes images of known Gaussians, and a new
//! scene learns to reproduce them.
//!
//! `cargo run --release -p splat4d-train --example train_tiny [OUT.safetensors]`

use splat4d::Result;
use splat4d::layers::{Evaluation, Layer, Scene};
use splat4d::math::sh::rgb_to_dc;
use splat4d::math::{Rng, Se3};
use splat4d::motion::{SpacetimeSpec, Spec, build, spacetime::VELOCITIES};
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{Camera, GEOMETRY, LifeKind, Params, SH, Time};
use splat4d_train::capture::frames::{Frames, Picture};
use splat4d_train::init;
use splat4d_train::maintenance::Limits;
use splat4d_train::methods::TrainContext;
use splat4d_train::recipe::Recipe;
use splat4d_train::step::loss::TrainLoss;
use splat4d_train::step::trainer::{Settings, Trainer};
use std::sync::Arc;

const CAMERAS: usize = 8;
const TIMES: usize = 6;
const FPS: f64 = 10.0;

/// Data of a capture for the trainer; `splat4d_train::capture` reads real ones.
struct Made {
    cameras: Vec<Camera>,
    /// [time][camera]
    pictures: Vec<Picture>,
}

impl Frames for Made {
    fn len(&self) -> usize {
        self.pictures.len()
    }
    fn camera(&self, i: usize) -> &Camera {
        &self.cameras[i % CAMERAS]
    }
    fn time(&self, i: usize) -> Time {
        Time((i / CAMERAS) as f64 / FPS)
    }
    fn rig(&self, i: usize) -> usize {
        i % CAMERAS
    }
    fn name(&self, i: usize) -> String {
        format!("camera {}, frame {}", i % CAMERAS, i / CAMERAS)
    }
    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        out.clone_from(&self.pictures[i]);
        Ok(())
    }
}

/// Forty coloured blobs that fly apart.
fn truth() -> Result<Scene<f32>> {
    let mut params = Params::<f32>::new(40, 1, LifeKind::Infinite.columns());
    let motion = build(&Spec::Spacetime(SpacetimeSpec::default()), &mut params)?;
    let velocities = params.find(VELOCITIES).expect("the model has made its table");
    for i in 0..params.len() {
        let r = Rng::new(5, "blobs", 0).fork(i as u64);
        let place: [f32; 3] = std::array::from_fn(|k| 0.35 * r.normal(k as u64) as f32);
        params[GEOMETRY].write(i, 0, place);
        params[GEOMETRY].write(i, QUAT, [1.0, 0.0, 0.0, 0.0]);
        params[GEOMETRY].write(i, LOG_SCALE, [-2.2; 3]);
        params[GEOMETRY].set(i, OPACITY, 3.0);
        params[SH].write(i, 0, std::array::from_fn::<f32, 3, _>(|k| rgb_to_dc(r.uniform(10 + k as u64) as f32)));
        params[velocities].write(i, 0, place);
    }
    let layer = Layer::new("truth", params, motion, LifeKind::Infinite);
    Ok(Scene { layers: vec![layer], fps: FPS, up: [0.0, 1.0, 0.0], ..Scene::default() })
}

fn main() -> Result<()> {
    let truth = truth()?;
    let camera = |i: usize| {
        let a = std::f64::consts::TAU * i as f64 / CAMERAS as f64;
        let eye = [3.0 * a.cos(), 0.8 * (i % 2) as f64, 3.0 * a.sin()];
        Camera::with_fov_y(Se3::look_at(eye, [0.0; 3], truth.up), 0.8, 64, 64)
    };
    let mut made = Made { cameras: (0..CAMERAS).map(camera).collect(), pictures: Vec::new() };
    let mut renderer = Renderer::new(RenderConfig::default());
    let (mut instant, mut image) = (Evaluation::default(), Image::default());
    for k in 0..TIMES {
        truth.at(Time(k as f64 / FPS), &mut instant);
        for camera in &made.cameras {
            renderer.render(&Shot::new(&truth.splats(&instant), camera, [0.0; 3]), &mut image);
            made.pictures.push(Picture { color: image.color.clone(), ..Picture::default() });
        }
    }

    // The recipe holds every setting; the plan adds the capture's data for the program.
    let mut recipe = Recipe::default();
    for setting in ["iterations=400", "init=random", "num_pts=400", "max_cap=800", "sh_degree=0", "half_size_until=0"] {
        recipe.set(setting)?;
    }
    let plan = TrainContext {
        extent: 3.3,
        center: [0.0; 3],
        clip: [0.0, (TIMES - 1) as f64 / FPS],
        fps: FPS,
        times: TIMES,
        fixed_cameras: CAMERAS,
        moments: (0..TIMES).map(|k| (k as f64 / FPS, CAMERAS)).collect(),
        masks: false,
        ..recipe.plan()
    };
    let program = recipe.program()?;
    let seeds = init::seeds(&plan, &recipe.init, &made, None, true)?;
    let scene = init::scene(&plan, &recipe.init, program.as_ref(), &seeds, [0.0; 3], truth.up)?;
    let mut trainer = Trainer::new(
        scene,
        program.stages(&plan),
        Arc::new(made),
        Box::new(Renderer::new(RenderConfig::default())),
        TrainLoss::photometric(plan.common.loss.dssim),
        Settings {
            seed: 0,
            limits: Limits {
                cap: plan.common.densify.max_cap,
                extent: plan.extent,
                min_opacity: plan.common.densify.min_opacity,
            },
            background: [0.0; 3],
            sh_degree: 0,
            exposure_lr: 0.0,
        },
    );
    let mut mse = 0.0;
    while !trainer.is_done() {
        // The inner error names a number that was not finite; a run on disk would return to its last checkpoint.
        let step = trainer.step()?.map_err(|fault| splat4d::Error::input(fault.0))?;
        for step in &step.measured {
            mse = if mse == 0.0 { step.mse } else { 0.95 * mse + 0.05 * step.mse };
        }
        if trainer.progress.iteration.is_multiple_of(100) {
            let psnr = -10.0 * f64::log10(mse);
            println!("step {}: {psnr:.2} dB, {} Gaussians", trainer.progress.iteration, trainer.scene().len());
        }
    }
    if let Some(path) = std::env::args().nth(1) {
        let mut bytes = Vec::new();
        splat4d::format::scene::write(trainer.scene(), &mut bytes)?;
        std::fs::write(&path, bytes)
            .map_err(|e| splat4d::Error::environment("the scene cannot be written", e).at(&path))?;
    }
    Ok(())
}
