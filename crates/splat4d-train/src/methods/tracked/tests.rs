use super::*;
use crate::capture::frames::{Frames, Picture};
use crate::event::Progress;
use crate::maintenance::Limits;
use crate::maintenance::Strategy;
use crate::recipe::{MotionName, Recipe};
use crate::step::loss::TrainLoss;
use crate::step::trainer::{Settings, Trainer};
use crate::train_state::Exposure;
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::sh::rgb_to_dc;
use splat4d::math::{Rng, Se3};
use splat4d::motion::build;
use splat4d::render::{Image, RenderConfig, Renderer, Shot};
use splat4d::scene::params::{LOG_SCALE, OPACITY};
use splat4d::scene::{Camera, LifeKind, Params, SH, Table, Time};

/// Frames a second.
const FPS: f64 = 10.0;
/// Radius of the ball.
const RADIUS: f64 = 0.6;

/// Images of a scene, rendered beforehand, camera by camera at every time.
struct Drawn {
    cameras: Vec<Camera>,
    pictures: Vec<Picture>,
}

impl Frames for Drawn {
    fn len(&self) -> usize {
        self.pictures.len()
    }
    fn camera(&self, i: usize) -> &Camera {
        &self.cameras[i % self.cameras.len()]
    }
    fn time(&self, i: usize) -> Time {
        Time((i / self.cameras.len()) as f64 / FPS)
    }
    fn rig(&self, i: usize) -> usize {
        i % self.cameras.len()
    }
    fn name(&self, i: usize) -> String {
        format!("picture {i}")
    }
    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        out.clone_from(&self.pictures[i]);
        Ok(())
    }
}

fn cameras(count: usize, size: usize) -> Vec<Camera> {
    let camera = |i: usize| {
        let a = std::f64::consts::TAU * i as f64 / count as f64;
        let height = if i.is_multiple_of(2) { 1.2 } else { -0.8 };
        let pose = Se3::look_at([3.0 * a.cos(), height, 3.0 * a.sin()], [0.0; 3], [0.0, 1.0, 0.0]);
        Camera::with_fov_y(pose, 0.6, size, size)
    };
    (0..count).map(camera).collect()
}

/// A random pattern of splats on a ball, and as many that are around it.
fn ball(rows: usize, standing: usize) -> Params<f32> {
    let mut p = Params::new(rows + standing, 1, &[]);
    let rng = Rng::new(8, "ball", 0);
    for r in 0..rows + standing {
        let rng = rng.fork(r as u64);
        let direction: [f64; 3] = std::array::from_fn(|k| rng.normal(k as u64));
        let length = direction.iter().map(|x| x * x).sum::<f64>().sqrt();
        let far = if r < rows { RADIUS } else { 1.6 * RADIUS };
        p[GEOMETRY].write(r, 0, direction.map(|x| (x / length * far) as f32));
        p[GEOMETRY].write(r, QUAT, [1.0, 0.0, 0.0, 0.0]);
        let size = if r < rows { 0.09f32 } else { 0.05 };
        p[GEOMETRY].write(r, LOG_SCALE, [size.ln(); 3]);
        p[GEOMETRY].set(r, OPACITY, 3.0);
        let color: [f32; 3] = std::array::from_fn(|k| rng.uniform(10 + k as u64) as f32);
        p[SH].write(r, 0, color.map(rgb_to_dc));
    }
    p
}

fn scene(mut params: Params<f32>, spec: &TrackedSpec) -> Scene<f32> {
    let motion = build(&Spec::Tracked(spec.clone()), &mut params).unwrap();
    let life = LifeKind::Infinite;
    let layer = Layer::new("ball", params, motion, life);
    Scene { layers: vec![layer], clip: [0.0, 1.0], fps: FPS, up: [0.0, 1.0, 0.0], ..Scene::default() }
}

fn first_frame(foreground: bool) -> TrackedSpec {
    TrackedSpec { times: vec![0.0], foreground }
}

/// The true poses: the first `turning` rows turn by `angle` a frame about a slanted axis and drift.
fn truth(params: &Params<f32>, turning: usize, frames: usize, angle: f64) -> Scene<f32> {
    let times = (0..frames).map(|k| k as f64 / FPS).collect();
    let mut s = scene(params.clone(), &TrackedSpec { times, foreground: false });
    for k in 1..frames {
        let (sin, cos) = (0.5 * angle * k as f64).sin_cos();
        let q = [cos, 0.6 * sin, 0.8 * sin, 0.0];
        let r = quat::to_rotation(q);
        let p = &mut s.layers[0].params;
        let key = splat4d::motion::tracked::page_of(p, k).unwrap();
        for row in 0..turning {
            let x = p[GEOMETRY].read::<3>(row, 0).map(f64::from);
            let drift = [0.004 * k as f64, 0.0, -0.002 * k as f64];
            let moved: [f32; 3] =
                std::array::from_fn(|i| ((0..3).map(|j| r[i][j] * x[j]).sum::<f64>() + drift[i]) as f32);
            p[key].write(row, 0, moved);
            p[key].write(row, QUAT, q.map(|x| x as f32));
        }
    }
    s
}

/// Renders a scene from all cameras; masks are where the first `masks` rows are what is seen.
fn draw(s: &Scene<f32>, cameras: Vec<Camera>, frames: usize, masks: Option<usize>) -> Drawn {
    let mut renderer = Renderer::new(RenderConfig::default());
    let (mut image, mut instant) = (Image::default(), Evaluation::default());
    let mut front = Table::new(&[("front", 1)], s.len());
    (0..masks.unwrap_or(0)).for_each(|r| front.set(r, 0, 1.0));
    let mut pictures = Vec::new();
    for k in 0..frames {
        s.at(Time(k as f64 / FPS), &mut instant);
        for camera in &cameras {
            let splats = s.splats(&instant);
            let shot = Shot { extra: Some(&front), sh_degree: 0, ..Shot::new(&splats, camera, [0.0; 3]) };
            renderer.render(&shot, &mut image);
            let mut mask = image.extra.clone();
            mask.data.iter_mut().for_each(|x| *x = f32::from(u8::from(*x > 0.5)));
            pictures.push(Picture { color: image.color.clone(), mask: masks.map(|_| mask), ..Picture::default() });
        }
    }
    Drawn { cameras, pictures }
}

fn plan(frames: usize, cameras: usize, masks: bool, settings: &[&str]) -> (TrackedMethod, TrainContext) {
    let mut recipe = Recipe::default().with(|r| {
        r.run.motion = MotionName::of("tracked");
        r.appearance.sh_degree = 0;
        r.run.half_size_until = 0.0;
    });
    recipe.densify.strategy = Strategy::None;
    settings.iter().for_each(|k| recipe.set(k).unwrap());
    let plan = TrainContext {
        extent: 3.0,
        center: [0.0; 3],
        clip: [0.0, (frames - 1) as f64 / FPS],
        fps: FPS,
        times: frames,
        fixed_cameras: cameras,
        moments: (0..frames).map(|k| (k as f64 / FPS, cameras)).collect(),
        masks,
        ..recipe.plan()
    };
    (TrackedMethod { tracked: recipe.tracked }, plan)
}

fn trainer(
    s: Scene<f32>,
    (program, plan): &(TrackedMethod, TrainContext),
    frames: Arc<dyn Frames>,
    exposure: Option<Exposure>,
) -> Trainer<'static> {
    let settings = Settings {
        seed: 5,
        limits: Limits { cap: 2000, extent: plan.extent, min_opacity: 0.005 },
        background: [0.0; 3],
        sh_degree: 0,
        exposure_lr: plan.common.appearance.exposure_lr,
    };
    let draw = Box::new(Renderer::new(RenderConfig::default()));
    let loss = TrainLoss::photometric(0.2);
    let mut trainer = Trainer::new(s, program.stages(plan), frames, draw, loss, settings);
    trainer.train_state.exposure = exposure;
    trainer
}

fn run(t: &mut Trainer<'_>) {
    while !t.is_done() {
        t.step().unwrap().expect("no fault");
    }
}

/// Root mean square distance of a frame's positions to the truth.
fn error(s: &Scene<f32>, truth: &Scene<f32>, frame: usize, rows: std::ops::Range<usize>) -> f64 {
    let page = |s: &Scene<f32>| splat4d::motion::tracked::page_of(&s.layers[0].params, frame).unwrap();
    let at = |s: &Scene<f32>, r: usize| s.layers[0].params[page(s)].read::<3>(r, 0);
    let square = |r: usize| {
        let (a, b) = (at(s, r), at(truth, r));
        (0..3).map(|k| f64::from(a[k] - b[k]).powi(2)).sum::<f64>()
    };
    let count = rows.len() as f64;
    (rows.map(square).sum::<f64>() / count).sqrt()
}

#[test]
fn a_turning_ball_is_tracked_only_with_ties() {
    const FRAMES: usize = 20;
    let params = ball(260, 0);
    let world = truth(&params, 260, FRAMES, 3f64.to_radians());
    let frames: Arc<dyn Frames> = Arc::new(draw(&world, cameras(8, 40), FRAMES, None));
    let track = |settings: &[&str]| {
        let steps = ["iterations=476", "first_share=0.002", "track_lr_init=1e-3", "track_lr_final=3e-4"];
        let plan = plan(FRAMES, 8, false, &[&steps, settings].concat());
        let mut t = trainer(scene(params.clone(), &first_frame(false)), &plan, frames.clone(), None);
        // Frame 0 is known: what is measured is the tracking.
        t.stages[0].groups.clear();
        run(&mut t);
        error(t.scene(), &world, FRAMES - 1, 0..260) / (2.0 * RADIUS)
    };
    let tied = track(&[]);
    let free = track(&["rigid=0", "rot=0", "iso=0"]);
    assert!(tied < 0.01, "after 57 degrees the ball is off by {:.2} % of its diameter", 100.0 * tied);
    assert!(free > 2.0 * tied, "ties are worth something: {free} without, {tied} with");
}

#[test]
fn uniform_motion_is_extrapolated_without_steps() {
    let params = ball(50, 0);
    let world = truth(&params, 50, 6, 0.0);
    let (program, plan) = plan(6, 4, false, &["iterations=1", "first_share=0"]);
    let mut stages = program.stages(&plan);
    let mut s = scene(params, &first_frame(false));
    for (k, stage) in stages.iter_mut().enumerate().skip(1) {
        stage.start.take().unwrap()(&mut s, &mut Progress(&mut |_| {})).unwrap();
        let page = |s: &Scene<f32>| splat4d::motion::tracked::page_of(&s.layers[0].params, k).unwrap();
        if k == 1 {
            // The first step is to be seen; all others follow.
            let (from, to) = (page(&world), page(&s));
            s.layers[0].params[to] = world.layers[0].params[from].clone();
        }
        assert!(error(&s, &world, k, 0..50) < 1e-6, "frame {k}");
    }
}

#[test]
fn parts_that_masks_call_static_stay() {
    let params = ball(200, 60);
    let world = truth(&params, 200, 3, 0.05);
    let frames: Arc<dyn Frames> = Arc::new(draw(&world, cameras(8, 32), 3, Some(200)));
    let settings = ["iterations=200", "first_share=0.5", "position_lr_init=1e-6", "position_lr_final=1e-6"];
    let plan = plan(3, 8, true, &settings);
    let mut t = trainer(scene(params, &first_frame(true)), &plan, frames, None);
    while t.progress.stage == 0 {
        t.step().unwrap().expect("no fault");
    }
    let p = &t.scene().layers[0].params;
    let logits = &p[p.find(FOREGROUND).unwrap()];
    let right = (0..260).filter(|&r| (logits.get(r, 0) > 0.0) == (r < 200)).count();
    assert!(right >= 250, "{right} of 260 Gaussians are on their side");
    run(&mut t);
    let p = &t.scene().layers[0].params;
    let logits = &p[p.find(FOREGROUND).unwrap()];
    let page = splat4d::motion::tracked::page_of(p, 2).unwrap();
    let mut moved: Vec<f32> = (0..260)
        .filter(|&r| logits.get(r, 0) <= 0.0)
        .map(|r| (0..3).map(|k| (p[page].get(r, k) - p[GEOMETRY].get(r, k)).abs()).fold(0.0, f32::max))
        .collect();
    moved.sort_by(f32::total_cmp);
    assert!(moved[moved.len() * 9 / 10] < 1e-3 * 3.0, "the background moved by {:?}", moved.last());
}

#[test]
fn only_the_newest_page_learns_and_memory_does_not_grow() {
    let params = ball(120, 0);
    let world = truth(&params, 120, 6, 0.03);
    let frames: Arc<dyn Frames> = Arc::new(draw(&world, cameras(4, 16), 6, None));
    let plan = plan(6, 4, false, &["iterations=60", "first_share=0.2"]);
    let mut t = trainer(scene(params, &first_frame(false)), &plan, frames, None);
    let mut sizes = Vec::new();
    while t.progress.stage < 1 {
        t.step().unwrap().expect("no fault");
    }
    for stage in 1..6 {
        let before = t.scene().layers[0].params.clone();
        while t.progress.stage == stage && !t.is_done() {
            t.step().unwrap().expect("no fault");
            if t.progress.stage_step == 3 {
                sizes.push(t.train_state.moments()[0].bytes());
            }
        }
        let after = &t.scene().layers[0].params;
        for key in before.keys().filter(|&k| k != GEOMETRY || stage > 1) {
            assert_eq!(before[key], after[key], "`{}` rests while frame {stage} learns", after.info(key).name);
        }
        assert!(splat4d::motion::tracked::page_of(after, stage).is_some());
    }
    assert_eq!(sizes.len(), 5);
    assert!(sizes.iter().all(|&s| s == sizes[0]), "moments of frames: {sizes:?} bytes");
}

#[test]
fn exposures_are_learnt_on_frame_0_and_kept() {
    let params = ball(200, 0);
    let world = truth(&params, 200, 2, 0.0);
    let mut frames = draw(&world, cameras(4, 32), 2, None);
    // Gains and offsets whose mean is the identity.
    let known = [[0.1f32, 0.02], [-0.1, -0.02], [0.05, -0.01], [-0.05, 0.01]];
    for (i, picture) in frames.pictures.iter_mut().enumerate() {
        let [m, c] = known[i % 4];
        picture.color.data.iter_mut().for_each(|x| *x = *x * (1.0 + m) + c);
    }
    let settings = ["iterations=1200", "first_share=0.95", "exposure=true", "exposure_lr=1e-3"];
    let plan = plan(2, 4, false, &settings);
    let exposure = Exposure::new(4, vec![0, 1, 2, 3]);
    let mut t = trainer(scene(params, &first_frame(false)), &plan, Arc::new(frames), Some(exposure));
    t.stages[0].groups.clear();
    let learnt = |t: &Trainer<'_>| {
        let e = t.train_state.exposure.as_ref().unwrap();
        (0..4).map(|c| e.params[e.key()].read::<12>(c, 0)).collect::<Vec<_>>()
    };
    while t.progress.stage == 0 {
        // Adam's steps do not shrink by themselves.
        t.settings.exposure_lr = [1e-3, 1e-3, 1e-4, 1e-4, 1e-5][t.progress.stage_step / 240];
        t.step().unwrap().expect("no fault");
    }
    let first = learnt(&t);
    for (row, [m, c]) in first.iter().zip(known) {
        // The matrix without the identity, row by row, then the offsets.
        let truth = [m, 0.0, 0.0, 0.0, m, 0.0, 0.0, 0.0, m, c, c, c];
        for (got, truth) in row.iter().zip(truth) {
            assert!((got - truth).abs() < 1e-3, "{row:?}, true {m} {c}");
        }
    }
    run(&mut t);
    assert_eq!(learnt(&t), first, "after frame 0 exposures are known");
}

#[test]
fn tuning_uses_every_frame_and_changes_every_page() {
    let (program, plan) = plan(5, 4, false, &["static_split=0.01", "crowding=merge"]);
    let stage = super::super::tuning(&program, &plan);
    assert_eq!(stage.sampler, Sampler::Uniform);
    let learns = |column: &str| stage.groups.iter().any(|g| g.column == column && g.rate.start > 0.0);
    for k in 1..5 {
        assert!(learns(&page_name("means", k)) && learns(&page_name("quats", k)), "page {k} rests");
    }
    assert!(learns("means") && learns("sh") && !learns(FOREGROUND));
    assert!(stage.start.is_none() && stage.end.is_none() && stage.maintenance.is_empty());
}

#[test]
fn captures_that_cannot_be_tracked_are_refused_with_those_that_can() {
    let (program, good) = plan(5, 4, false, &[]);
    assert!(program.check(&good).is_ok());
    let mut moving = good.clone();
    moving.moments.iter_mut().for_each(|m| m.1 = 0);
    let mut staggered = good.clone();
    staggered.moments[3].1 = 2;
    for bad in [moving, staggered] {
        let text = program.check(&bad).unwrap_err().to_string();
        assert!(text.contains("3 fixed, synchronised cameras") && text.contains("spacetime, deform-mlp"), "{text}");
    }
    let with = |setting: &str| {
        let (program, plan) = plan(5, 4, false, &[setting]);
        program.check(&plan)
    };
    assert!(with("floor_height=-0.3").is_ok());
    assert!(Recipe::default().set("floor_height=low").unwrap_err().to_string().contains("floor_height"));
    assert!(with("prune_interval=100").is_err());
}

#[test]
fn steps_are_shared_out_and_every_frame_has_its_stage() {
    for (frames, iterations) in [(1, 100), (2, 100), (30, 1000), (30, 7)] {
        let (program, plan) = plan(frames, 4, false, &[&format!("iterations={iterations}")]);
        let stages = program.stages(&plan);
        assert_eq!(stages.len(), frames);
        assert_eq!(stages.iter().map(|s| s.iterations).sum::<usize>(), iterations);
        let later: Vec<usize> = stages[1..].iter().map(|s| s.iterations).collect();
        let (low, high) = (later.iter().min().copied(), later.iter().max().copied());
        assert!(high.unwrap_or(0) - low.unwrap_or(0) <= 1, "{later:?}");
        assert!(stages[1..].iter().all(|s| s.maintenance.is_empty() && s.params.len() == 1));
    }
}
