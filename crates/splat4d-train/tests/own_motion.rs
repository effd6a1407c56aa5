//! A motion model from outside the library trains and plays: the one of `splat4d`'s example `own_motion`, with a
//! program of its own. Its mathematics and this file are the only places that depend on it.

use splat4d::Result;
use splat4d::bake::{Options, bake};
use splat4d::format::playback::{self, Draft, Meta, WriteConfig};
use splat4d::layers::Evaluation;
use splat4d::math::Se3;
use splat4d::motion::{Motion, Spec};
use splat4d::play::Player;
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::{Camera, Params, Splats, Time};
use splat4d_train::capture::frames::{Frames, Picture};
use splat4d_train::init::{self, Seeds};
use splat4d_train::maintenance::Limits;
use splat4d_train::methods::{Group, Method, Rate, Stage, TrainContext, still};
use splat4d_train::recipe::Recipe;
use splat4d_train::step::loss::TrainLoss;
use splat4d_train::step::trainer::{Settings, Trainer};
use std::sync::Arc;

#[allow(dead_code)] // its own `main` and what that checks
#[path = "../../splat4d/examples/own_motion.rs"]
mod own_motion;

use own_motion::Sway;

const CAMERAS: usize = 4;
/// A swing takes two seconds; five images are of its first half.
const TIMES: usize = 5;
const FPS: f64 = 5.0;
const SIZE: usize = 40;
const STEPS: usize = 120;

/// How the model is learnt: as a still scene, and its amplitudes.
struct SwayMethod;

impl Method for SwayMethod {
    fn spec(&self, _plan: &TrainContext) -> Spec {
        Spec::Custom("sway".into())
    }

    fn build(&self, _plan: &TrainContext, params: &mut Params) -> Result<Arc<dyn Motion>> {
        Ok(Arc::new(Sway::new(2.0, params)?))
    }

    fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
        let mut stage = still::stage("sway", plan);
        stage.groups.push(Group::new("amplitudes", Rate::constant(5e-3 * plan.extent)));
        vec![stage]
    }
}

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
        format!("picture {i}")
    }
    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        out.clone_from(&self.pictures[i]);
        Ok(())
    }
}

fn draw(splats: &Splats<'_>, camera: &Camera) -> Image {
    let mut image = Image::default();
    Renderer::new(RenderConfig::default()).render(&Shot::new(splats, camera, [1.0; 3]), &mut image);
    image
}

fn psnr(a: &Image, b: &Picture) -> f64 {
    let squares: f64 = a.color.data.iter().zip(&b.color.data).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    -10.0 * (squares / a.color.data.len() as f64).log10()
}

#[test]
fn a_model_from_outside_trains_and_its_file_plays() {
    let truth = own_motion::scene().unwrap();
    let camera = |i: usize| {
        let a = std::f64::consts::TAU * i as f64 / CAMERAS as f64;
        let pose = Se3::look_at([4.0 * a.sin(), 1.0, -4.0 * a.cos()], [0.0, 0.5, 0.0], truth.up);
        Camera::with_fov_y(pose, 0.7, SIZE, SIZE)
    };
    let cameras: Vec<Camera> = (0..CAMERAS).map(camera).collect();
    let mut instant = Evaluation::default();
    let mut pictures = Vec::new();
    for k in 0..TIMES {
        truth.at(Time(k as f64 / FPS), &mut instant);
        let splats = truth.splats(&instant);
        pictures.extend(cameras.iter().map(|c| Picture { color: draw(&splats, c).color, ..Picture::default() }));
    }
    let made = Arc::new(Made { cameras, pictures });

    let mut recipe = Recipe::default();
    for setting in [&format!("iterations={STEPS}"), "strategy=none", "sh_degree=0", "half_size_until=0", "batch_size=2"]
    {
        recipe.set(setting).unwrap();
    }
    let plan = TrainContext {
        extent: 4.4,
        clip: [0.0, (TIMES - 1) as f64 / FPS],
        fps: FPS,
        times: TIMES,
        fixed_cameras: CAMERAS,
        ..recipe.plan()
    };
    // The grass at rest, grey.
    let mut seeds = Seeds::default();
    let rest = &truth.layers[0].params;
    for row in 0..rest.len() {
        let place = rest[splat4d::scene::GEOMETRY].read::<3>(row, 0).map(f64::from);
        seeds.push(place, [0.5; 3], None);
    }
    let scene = init::scene(&plan, &recipe.init, &SwayMethod, &seeds, [1.0; 3], truth.up).unwrap();
    assert!(scene.layers[0].motion.capabilities().moves, "a model that says nothing may do anything");
    let mut trainer = Trainer::new(
        scene,
        SwayMethod.stages(&plan),
        made.clone(),
        Box::new(Renderer::new(RenderConfig::default())),
        TrainLoss::photometric(plan.common.loss.dssim),
        Settings {
            seed: 0,
            limits: Limits { cap: 1000, extent: plan.extent, min_opacity: 0.005 },
            background: [1.0; 3],
            sh_degree: 0,
            exposure_lr: 0.0,
        },
    );
    // What is shown half a swing from rest, where objects are farthest from their start.
    let last = CAMERAS * (TIMES / 2);
    let shown = |trainer: &Trainer<'_>| {
        let mut instant = Evaluation::default();
        trainer.scene().at(made.time(last), &mut instant);
        draw(&trainer.scene().splats(&instant), made.camera(last))
    };
    let before = psnr(&shown(&trainer), &made.pictures[last]);
    while !trainer.is_done() {
        trainer.step().unwrap().unwrap_or_else(|fault| panic!("{}", fault.0));
    }
    let learnt = shown(&trainer);
    let after = psnr(&learnt, &made.pictures[last]);
    assert!(after > before + 3.0, "{before:.1} dB before, {after:.1} after");
    let p = &trainer.scene().layers[0].params;
    let amplitudes = &p[p.find("amplitudes").expect("the model has made its table")];
    assert!((0..p.len()).any(|row| amplitudes.get(row, 0).abs() > 0.05), "something sways");

    let baked = bake(trainer.scene(), &Options::default(), &mut |_, _| {}).unwrap();
    let meta = Meta { clip: baked.clip, fps: FPS, up: truth.up, sh_degree: baked.sh_degree, ..Meta::default() };
    let mut file = Vec::new();
    playback::write(&Draft { meta, nodes: baked.nodes, poster: None }, &WriteConfig::default(), &mut file).unwrap();
    let length = file.len() as u64;
    let mut player = Player::open(Box::new(&*file.leak()), length, 1 << 20).unwrap();
    let played = draw(&player.at(made.time(last)).unwrap(), made.camera(last));
    let like = psnr(&played, &Picture { color: learnt.color, ..Picture::default() });
    assert!(like > 30.0, "the file plays what was learnt: {like:.1} dB");
}
