//! An image loss of your own. Pixels have labels of another program; a term compares them with a learned column of the
//! Gaussians, so that after training every Gaussian has a label.
//!
//! `cargo run --release -p splat4d-train --example own_loss`

use splat4d::Result;
use splat4d::layers::{Evaluation, Layer, Scene};
use splat4d::math::{Rng, Se3};
use splat4d::motion::{Spec, build};
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{Camera, GEOMETRY, LifeKind, Params, Planes, SH, Space, Table, Time};
use splat4d_train::capture::frames::{Frames, Picture};
use splat4d_train::loss::image::{Channel, ImageTerm, LossGrads, Needs, Shown, View};
use splat4d_train::loss::terms::StepInfo;
use splat4d_train::maintenance::Limits;
use splat4d_train::methods::{Group, Rate, Stage};
use splat4d_train::step::loss::TrainLoss;
use splat4d_train::step::trainer::{Settings, Trainer};
use std::sync::Arc;

/// The column of a logit a Gaussian: does it belong to the ball on the right?
const LABEL: &str = "right_ball";
const CAMERAS: usize = 6;
const GAUSSIANS: usize = 60;

/// Mean squared difference between rendered labels and those of the pixels.
struct Labels {
    /// By frame.
    truth: Vec<Planes<f32>>,
}

impl ImageTerm for Labels {
    fn needs(&self, _: &View<'_>) -> Needs {
        Needs { depth: false, extra: vec![Channel::Sigmoid(LABEL.into())] }
    }

    fn eval(&mut self, _: &StepInfo, view: &View<'_>, shown: &Shown<'_>, d: &mut LossGrads) -> f64 {
        let (first, drawn) = shown.channel(&Channel::Sigmoid(LABEL.into())).expect("the scene has the column");
        let truth = &self.truth[view.frame];
        let count = drawn.pixels() as f32;
        let (mut value, mut d_drawn) = (0.0, drawn.clone());
        for (d, truth) in d_drawn.data.iter_mut().zip(&truth.data) {
            let error = *d - truth;
            value += f64::from(error * error / count);
            *d = 2.0 * error / count;
        }
        d.add_extra(first, &d_drawn);
        value
    }
}

/// Two grey balls that colours do not separate.
fn balls() -> Result<Scene<f32>> {
    let mut params = Params::<f32>::new(GAUSSIANS, 1, LifeKind::Infinite.columns());
    let motion = build(&Spec::Still, &mut params)?;
    for i in 0..GAUSSIANS {
        let random = Rng::new(7, "balls", i as u64);
        let mut place: [f32; 3] = std::array::from_fn(|k| 0.2 * random.normal(k as u64) as f32);
        place[0] += if is_right(i) { 0.6 } else { -0.6 };
        params[GEOMETRY].write(i, 0, place);
        params[GEOMETRY].write(i, QUAT, [1.0, 0.0, 0.0, 0.0]);
        params[GEOMETRY].write(i, LOG_SCALE, [-2.2; 3]);
        params[GEOMETRY].set(i, OPACITY, 2.0);
        params[SH].write(i, 0, [0.3; 3]);
    }
    let layer = Layer::new("balls", params, motion, LifeKind::Infinite);
    Ok(Scene { layers: vec![layer], fps: 1.0, up: [0.0, 1.0, 0.0], ..Scene::default() })
}

fn is_right(gaussian: usize) -> bool {
    gaussian % 2 == 1
}

/// Images of a still scene.
struct Pictures {
    cameras: Vec<Camera>,
    colors: Vec<Planes<f32>>,
}

impl Frames for Pictures {
    fn len(&self) -> usize {
        self.colors.len()
    }
    fn camera(&self, i: usize) -> &Camera {
        &self.cameras[i]
    }
    fn time(&self, _: usize) -> Time {
        Time(0.0)
    }
    fn rig(&self, i: usize) -> usize {
        i
    }
    fn name(&self, i: usize) -> String {
        format!("camera {i}")
    }
    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        out.color.clone_from(&self.colors[i]);
        Ok(())
    }
}

fn main() -> Result<()> {
    // What a capture and a program that labels pixels would give: images, and a number from 0 to 1 a pixel.
    let mut scene = balls()?;
    let camera = |i: usize| {
        let angle = std::f64::consts::TAU * i as f64 / CAMERAS as f64;
        let eye = [3.0 * angle.cos(), 1.0, 3.0 * angle.sin()];
        Camera::with_fov_y(Se3::look_at(eye, [0.0; 3], [0.0, 1.0, 0.0]), 0.8, 48, 48)
    };
    let mut pictures = Pictures { cameras: (0..CAMERAS).map(camera).collect(), colors: Vec::new() };
    let mut labels = Table::new(&[("label", 1)], GAUSSIANS);
    (0..GAUSSIANS).for_each(|i| labels.set(i, 0, f32::from(u8::from(is_right(i)))));
    let mut term = Labels { truth: Vec::new() };
    let mut renderer = Renderer::new(RenderConfig::default());
    let (mut evaluation, mut image) = (Evaluation::default(), Image::default());
    scene.at(Time(0.0), &mut evaluation);
    for camera in &pictures.cameras {
        renderer.render(
            &Shot { extra: Some(&labels), ..Shot::new(&scene.splats(&evaluation), camera, [0.0; 3]) },
            &mut image,
        );
        pictures.colors.push(image.color.clone());
        term.truth.push(image.extra.clone());
    }

    // The column that learns: one logit a Gaussian, undecided.
    scene.layers[0].params.entry(LABEL, Space::Gaussians, &[(LABEL, 1)], GAUSSIANS, |_| {})?;
    let groups = vec![Group::new(LABEL, Rate::constant(0.1))];
    let stage = Stage { groups, ..Stage::new("labels", 150) };
    let mut loss = TrainLoss::photometric(0.2);
    loss.push(term);
    let settings = Settings {
        seed: 0,
        limits: Limits { cap: GAUSSIANS, extent: 3.3, min_opacity: 0.005 },
        background: [0.0; 3],
        sh_degree: 0,
        exposure_lr: 0.0,
    };
    let mut trainer = Trainer::new(scene, vec![stage], Arc::new(pictures), Box::new(renderer), loss, settings);
    while !trainer.is_done() {
        trainer.step()?.map_err(|fault| splat4d::Error::input(fault.0))?;
    }
    let params = &trainer.scene().layers[0].params;
    let learnt = &params[params.find(LABEL).expect("the column was added above")];
    let right = (0..GAUSSIANS).filter(|&i| (learnt.get(i, 0) > 0.0) == is_right(i)).count();
    println!("{right} of {GAUSSIANS} Gaussians know which ball they belong to");
    assert!(right * 10 >= GAUSSIANS * 9, "labels of pixels should have reached the Gaussians");
    Ok(())
}
