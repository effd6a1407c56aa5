//! What a caller may bring to a step from outside the library: an operation of maintenance, and an engine.

use splat4d::Result;
use splat4d::layers::{Layer, Scene};
use splat4d::math::Se3;
use splat4d::motion::Still;
use splat4d::render::{Antialias, RenderConfig, Renderer};
use splat4d::scene::{Camera, LifeKind, Params, Planes, RowEdit, SH, Space, Time};
use splat4d_train::capture::frames::{Frames, Picture};
use splat4d_train::maintenance::{At, Change, Context, Limits, Maintenance};
use splat4d_train::methods::{Group, Rate, Stage};
use splat4d_train::run::checkpoint;
use splat4d_train::step::engine::{CpuEngine, Engine, Fault, StepPlan, Stepped};
use splat4d_train::step::loss::TrainLoss;
use splat4d_train::step::trainer::{Settings, Trainer};
use splat4d_train::train_state::TrainState;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

const SIZE: usize = 24;
const ROWS: usize = 30;
const STEPS: usize = 30;

/// Two cameras that see a grey wall.
struct Wall {
    cameras: [Camera; 2],
}

impl Frames for Wall {
    fn len(&self) -> usize {
        self.cameras.len()
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
    fn load(&self, _: usize, out: &mut Picture) -> Result<()> {
        *out = Picture { color: Planes::new(3, SIZE, SIZE), ..Picture::default() };
        out.color.data.fill(0.4);
        Ok(())
    }
}

/// A row of Gaussians that learn colour and place.
fn trainer(keep: Option<Whiten>) -> Trainer<'static> {
    let mut params = Params::new(ROWS, 1, &[]);
    for row in 0..ROWS {
        let x = row as f32 / ROWS as f32 - 0.5;
        params[splat4d::scene::GEOMETRY].write(
            row,
            0,
            [x, 0.3 * (9.0 * x).sin(), 0.0, 1.0, 0.0, 0.0, 0.0, -3.0, -3.0, -3.0, 0.5],
        );
    }
    let layer = Layer::new("row", params, Arc::new(Still), LifeKind::Infinite);
    let scene = Scene { layers: vec![layer], ..Scene::default() };
    let eye = |x: f64| Se3::look_at([x, 0.0, -2.0], [0.0; 3], [0.0, 1.0, 0.0]);
    let wall = Wall { cameras: [-0.4, 0.4].map(|x| Camera::with_fov_y(eye(x), 0.7, SIZE, SIZE)) };
    let groups = [("means", 1e-3), ("sh", 1e-2)].map(|(column, rate)| Group::new(column, Rate::constant(rate)));
    let mut stage = Stage { groups: groups.into(), ..Stage::new("own", STEPS) };
    if let Some(operation) = keep {
        stage.keep(operation);
    }
    let settings = Settings {
        seed: 0,
        limits: Limits { cap: ROWS, extent: 1.0, min_opacity: 0.005 },
        background: [0.0; 3],
        sh_degree: 0,
        exposure_lr: 0.0,
    };
    let draws = Box::new(Renderer::new(RenderConfig::default()));
    Trainer::new(scene, vec![stage], Arc::new(wall), draws, TrainLoss::photometric(0.2), settings)
}

fn finish(trainer: &mut Trainer<'_>) {
    while !trainer.is_done() {
        trainer.step().unwrap().unwrap_or_else(|fault| panic!("{}", fault.0));
    }
}

fn saved(trainer: &Trainer<'_>) -> Vec<u8> {
    checkpoint::write(trainer, &checkpoint::Identity::default(), &Default::default()).unwrap()
}

/// Counts the steps, and leaves the work to another engine.
struct Counting {
    inner: CpuEngine<'static>,
    steps: Arc<AtomicUsize>,
}

impl Engine for Counting {
    fn step(&mut self, train_state: &mut TrainState, plan: &mut StepPlan<'_>) -> Result<Result<Stepped, Fault>> {
        self.steps.fetch_add(1, Ordering::Relaxed);
        self.inner.step(train_state, plan)
    }
    fn changed(&mut self, train_state: &TrainState) {
        self.inner.changed(train_state);
    }
    fn antialias(&self) -> Antialias {
        self.inner.antialias()
    }
}

#[test]
fn a_custom_engine_runs_all_steps_with_the_same_bits() {
    let steps = Arc::<AtomicUsize>::default();
    let [mut own, mut usual] = [trainer(None), trainer(None)];
    let inner = CpuEngine::new(Box::new(Renderer::new(RenderConfig::default())));
    own.set_engine(Counting { inner, steps: steps.clone() });
    let before = saved(&own);
    finish(&mut own);
    finish(&mut usual);
    assert_eq!(steps.load(Ordering::Relaxed), STEPS);
    assert!(saved(&own) == saved(&usual) && saved(&own) != before);
}

/// Turns the next Gaussian white every seven steps, and remembers which one is next.
struct Whiten {
    next: u32,
}

impl Maintenance for Whiten {
    fn name(&self) -> &str {
        "whiten"
    }
    fn due(&self, at: &At) -> bool {
        at.step.is_multiple_of(7)
    }
    fn run(&mut self, train_state: &mut TrainState, c: &Context<'_>) -> Result<Change> {
        train_state.scene_mut().layers[0].params[SH].write(self.next as usize, 0, [1.5f32; 3]);
        self.next += 1;
        // The last row is removed: rows change together with their moments and statistics.
        let mut edit = RowEdit::identity(Space::Gaussians, train_state.scene().len());
        edit.parent.pop();
        edit.born.pop();
        train_state.apply(0, &edit, &c.rng("whiten"));
        Ok(Change { removed: 1, ..Change::default() })
    }
    fn state(&self) -> Vec<u32> {
        vec![self.next]
    }
    fn restore(&mut self, state: &[u32]) {
        self.next = state.first().copied().unwrap_or(0);
    }
}

/// An operation runs, is in checkpoints, and continues where it was.
#[test]
fn a_custom_operation_runs_and_resumes_bit_for_bit() {
    let start = || trainer(Some(Whiten { next: 0 }));
    let mut whole = start();
    let mut kept = Vec::new();
    while !whole.is_done() {
        whole.step().unwrap().unwrap_or_else(|fault| panic!("{}", fault.0));
        if whole.progress.iteration == 16 {
            kept = saved(&whole);
        }
        if whole.progress.iteration == 14 {
            assert_eq!(whole.scene().layers[0].params[SH].read::<3>(1, 0), [1.5; 3], "the second one's turn");
        }
    }
    let mut again = start();
    checkpoint::read(&kept, &mut again, &checkpoint::Identity::default()).unwrap();
    finish(&mut again);
    assert!(saved(&again) == saved(&whole), "resumed, it ends elsewhere");
    assert_eq!(again.stages[0].maintenance[0].state(), [4]);
}
