//! Tables that stay on a GPU against the CPU's engine: gradients, resumes, faults.

use super::bed::{Bed, bytes, saved, settings};
use super::gpu::{finish, on_gpu, steps_to};
use crate::capture::frames::{Frames, Picture};
use crate::recipe::Recipe;
use crate::step::engine::Blame;
use crate::step::resident::DeviceEngine;
use splat4d::device::{self, Device};
use splat4d::layers::ALPHA_MIN;
use splat4d::render::{
    Abilities, Antialias, Backend, Image, ImageGrads, RenderConfig, RenderGrads, Resident, ResidentCameras,
    ResidentLayer, ResidentNumbers, ResidentStep, ResidentStepped, Shot,
};
use splat4d::scene::{Camera, GEOMETRY, Table, Time};
use splat4d::{Error, ErrorKind, Result};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Recipes that stay on the device throughout: every kind of motion and of lifespan.
const STAYS: [&str; 12] = [
    "motion=still strategy=adc sh_degree=3 sh_degree_interval=1",
    "motion=spacetime strategy=adc exposure=true antialias=true",
    "motion=spacetime strategy=none motion_order=3 rotation_rate=true life=interval sh_degree=2 batch_size=3",
    "motion=spacetime strategy=none motion_order=2 rotation_rate=true life=gauss-one detach=true",
    "motion=spacetime strategy=none motion_order=1 life=infinite batch_size=2",
    "motion=spacetime strategy=none motion_order=0 sh_degree=0",
    "motion=spacetime strategy=mcmc loss.opacity_entropy=0.02",
    "motion=native4d strategy=adc",
    "motion=native4d strategy=none sh_harmonics=2 sh_degree=3 sh_degree_interval=1 batch_size=2",
    "motion=native4d strategy=mcmc sh_harmonics=1 batch_size=2",
    "motion=tracked strategy=adc",
    // Frame 1 from the second step on. Without what ties its poses to those of frame 0, of which they are copies at
    // that step: there these losses are at their kinks, and a GPU's rounding alone decides their direction.
    // `ties_pull_as_on_the_cpu` tests them.
    "motion=tracked strategy=none tracked.first_share=0.001 rigid_neighbours=5 tracked.rigid=0 tracked.rot=0 tracked.iso=0",
];
/// Largest relative difference of a table's gradient, as a vector: a splat at the α cut-off may be rendered by one side
/// only.
const GRADIENT: f64 = 5e-3;
/// Largest relative difference of a statistic's sum: two of the fifty Gaussians of a tracked frame make 4 %.
const STATISTICS: f64 = 5e-2;
/// Steps until which a table's first moments are still its gradients' sums.
const FEW: usize = 2;

/// The first moments of all tables with columns, and how often rows stepped.
fn moments(trainer: &crate::step::trainer::Trainer<'_>) -> Vec<(String, Vec<f64>, Vec<f32>)> {
    let (scene, all) = (trainer.scene(), trainer.train_state.moments());
    let mut out = Vec::new();
    for (layer, moments) in scene.layers.iter().zip(all) {
        for key in layer.params.keys().filter(|&k| layer.params[k].width() > 0) {
            let (table, width) = (moments.table(key), layer.params[key].width());
            let first = table.column_to_rows(0, width).into_iter().map(f64::from).collect();
            out.push((layer.params.column_name(key, 0).to_string(), first, table.column_to_rows(2 * width, 1)));
        }
    }
    out
}

#[test]
fn gradients_of_the_whole_chain_equal_the_cpus() {
    let bed = Bed::new();
    for line in STAYS {
        let recipe = settings(line);
        let Some(mut trainer) = on_gpu(&bed, &recipe) else { return };
        let mut cpu = bed.start(&recipe);
        for step in 1..=FEW {
            let stepped = trainer.step().unwrap().unwrap();
            let expected = cpu.step().unwrap().unwrap().measured[0];
            assert!(stepped.notices.is_empty(), "{line}: {:?}", stepped.notices);
            // Maintenance may have waited for it already.
            let later = trainer.settle().unwrap();
            let measured = stepped.measured.iter().chain(&later).copied().next().expect("the step is done");
            assert_eq!(measured.iteration, step);
            for (a, b) in [
                (measured.loss, expected.loss),
                (measured.mse, expected.mse),
                (measured.l1, expected.l1),
                (measured.ssim, expected.ssim),
            ] {
                assert!((a - b).abs() < 1e-4 * b.abs(), "{line}, step {step}: {a} {b}");
            }
            let mut worst = 0.0f64;
            for ((name, a, steps), (_, b, expected)) in moments(&trainer).into_iter().zip(moments(&cpu)) {
                let others = steps.iter().zip(&expected).filter(|(a, b)| a != b).count();
                assert!(
                    others <= steps.len() / 200,
                    "{line}: {others} rows of `{name}` stepped another number of times"
                );
                let off: f64 = a.iter().zip(&b).map(|(a, b)| (a - b) * (a - b)).sum();
                let all: f64 = b.iter().map(|b| b * b).sum();
                assert!(all > 0.0 || off == 0.0, "{line}: `{name}` has no gradient");
                let off = if all > 0.0 { (off / all).sqrt() } else { 0.0 };
                assert!(off < GRADIENT, "{line}, step {step}: gradients of `{name}` differ by {off:.1e}");
                worst = worst.max(off);
            }
            println!("{line}, step {step}: {worst:.1e}");
            if let (Some(a), Some(b)) = (&trainer.train_state.exposure, &cpu.train_state.exposure) {
                let first = |e: &crate::train_state::Exposure| e.moments.table(e.key()).column_to_rows(0, 12);
                let (a, b) = (first(a), first(b));
                let off: f64 = a.iter().zip(&b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
                let all: f64 = b.iter().map(|b| f64::from(*b).powi(2)).sum();
                assert!(all > 0.0 && (off / all).sqrt() < GRADIENT, "{line}: cameras differ by {off:.1e} of {all:.1e}");
            }
            let stats = [&trainer, &cpu].map(|t| t.train_state.stats().tables[0].column_to_rows(0, 3));
            let sums = stats.map(|s| s.chunks_exact(3).map(|r| [r[0], r[1], r[2]].map(f64::from)).collect::<Vec<_>>());
            for c in 0..3 {
                let [a, b] = sums.each_ref().map(|s| s.iter().map(|r| r[c]).sum::<f64>());
                // The CPU tests ellipses against bins, the GPU against tiles: a few are rendered by one side only.
                assert!((a - b).abs() <= STATISTICS * b, "{line}: statistics {c}: {a} {b}");
            }
        }
    }
}

#[test]
fn tables_that_stay_repeat_and_resume_bit_for_bit() {
    let bed = Bed::new();
    for line in [
        "motion=spacetime strategy=adc batch_size=2",
        "motion=native4d strategy=mcmc sh_harmonics=1",
        "motion=tracked strategy=mcmc rigid_neighbours=5",
    ] {
        repeats_and_resumes(&bed, &settings(line));
    }
}

fn repeats_and_resumes(bed: &Bed, recipe: &Recipe) {
    let run = || {
        let mut trainer = on_gpu(bed, recipe)?;
        let mut checkpoints = Vec::new();
        while !trainer.is_done() {
            assert!(trainer.step().unwrap().unwrap().notices.is_empty());
            if [7, 18].contains(&trainer.progress.iteration) {
                trainer.settle().unwrap();
                checkpoints.push(saved(&trainer));
            }
        }
        Some((bytes(trainer.scene()), checkpoints))
    };
    let Some((whole, checkpoints)) = run() else { return };
    let [first, second] = &checkpoints[..] else { panic!("two checkpoints") };
    // The same bits again, without reads in between: as many steps as possible are in flight.
    let mut unseen = on_gpu(bed, recipe).expect("there was a GPU");
    let (mse, _) = finish(&mut unseen, "unseen");
    assert!(bytes(unseen.scene()) == whole, "it does not depend on who looks when");
    assert_eq!(mse.len(), unseen.progress.iteration, "every step is told once");
    // From checkpoint to checkpoint, and from the last one to the end.
    let mut resumed = bed.resumed_on(Device::Gpu, recipe, first);
    steps_to(&mut resumed, 18);
    resumed.settle().unwrap();
    assert!(saved(&resumed) == *second, "a resumed run is where the other one was");
    let mut resumed = bed.resumed_on(Device::Gpu, recipe, second);
    finish(&mut resumed, "resumed");
    assert!(bytes(resumed.scene()) == whole, "a resumed run has the bytes of one that was not stopped");
}

/// Frames that count how often they are loaded.
struct Counted(Arc<dyn Frames>, Arc<AtomicUsize>);

impl Frames for Counted {
    fn len(&self) -> usize {
        self.0.len()
    }
    fn camera(&self, i: usize) -> &Camera {
        self.0.camera(i)
    }
    fn time(&self, i: usize) -> Time {
        self.0.time(i)
    }
    fn rig(&self, i: usize) -> usize {
        self.0.rig(i)
    }
    fn name(&self, i: usize) -> String {
        self.0.name(i)
    }
    fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
        self.1.fetch_add(1, Ordering::Relaxed);
        self.0.load(i, out)
    }
}

#[test]
fn images_that_a_device_keeps_are_loaded_once() {
    let bed = Bed::new();
    let run = |line: &str| {
        let mut trainer = on_gpu(&bed, &settings(line))?;
        let loads = Arc::new(AtomicUsize::new(0));
        trainer.set_frames(Arc::new(Counted(bed.frames(), loads.clone())));
        let (mse, notices) = finish(&mut trainer, line);
        assert!(notices.is_empty(), "{notices:?}");
        Some((bytes(trainer.scene()), mse, loads.load(Ordering::Relaxed)))
    };
    let line = "motion=spacetime strategy=none iterations=120 half_size_until=0.4";
    let Some((kept, mse, few)) = run(line) else { return };
    // One byte: every step sends its image.
    let (sent, other_mse, all) = run(&format!("{line} run.device_images=1")).expect("there was a GPU");
    assert!(kept == sent && mse == other_mse, "it changes no bit");
    // Every frame in both sizes, and again in another stage.
    let frames = bed.frames().len();
    assert!(all == 120 && few >= frames && few <= 4 * frames, "{all} and {few} loads of {frames} frames");
}

#[test]
fn a_device_that_fails_is_followed_by_the_cpu_with_the_images() {
    let bed = Bed::new();
    let recipe = settings("motion=spacetime strategy=none half_size_until=0");
    // The tables are the learner's at its last step, as after maintenance, so that nothing is lost.
    let Some(device) = Failing::new([ALWAYS, 30, ALWAYS]) else { return };
    let mut trainer = bed.start(&recipe);
    trainer.set_engine(DeviceEngine::new(device));
    let mut notices = Vec::new();
    for _ in 0..30 {
        notices.extend(trainer.step().unwrap().unwrap().notices);
    }
    trainer.settle().unwrap();
    notices.extend(finish(&mut trainer, "on the CPU").1);
    assert_eq!(notices, [format!("training continues on the CPU: {GONE}")]);
}

#[test]
fn a_number_that_is_not_finite_is_found_and_named() {
    let bed = Bed::new();
    let recipe = settings("motion=spacetime strategy=none");
    let Some(mut trainer) = on_gpu(&bed, &recipe) else { return };
    trainer.step().unwrap().unwrap();
    trainer.settle().unwrap();
    let before = saved(&trainer);
    trainer.train_state.scene_mut().layers[0].params[GEOMETRY].set(7, 0, f32::NAN);
    let (train_state, progress) = (
        std::mem::replace(&mut trainer.train_state, crate::train_state::TrainState::new(Default::default())),
        trainer.progress,
    );
    trainer.restore(train_state, progress);
    let fault = (0..3).find_map(|_| trainer.step().unwrap().err()).or_else(|| trainer.settle().err());
    let fault = fault.expect("it is found");
    assert!(fault.1 == Blame::Numbers && fault.0.contains("not finite") && fault.0.contains('7'), "{}", fault.0);
    // As after a rollback.
    let mut resumed = bed.resumed_on(Device::Gpu, &recipe, &before);
    resumed.step().unwrap().unwrap();
}

/// Errors of a failing device, and of one without memory.
const GONE: &str = "the driver is gone";
const FULL: &str = "too many for one buffer";
/// As often as it is called.
const ALWAYS: usize = usize::MAX;

/// A device that fails when it has done so much, and does nothing from then on.
pub(crate) struct Failing {
    device: Box<dyn Backend>,
    /// How often it takes tables over, takes steps and hands tables out.
    left: [usize; 3],
    /// Whether it reports that it takes tables over.
    keeps: bool,
    gone: bool,
}

impl Failing {
    /// A GPU of any kind; none where there is none.
    pub(crate) fn new(left: [usize; 3]) -> Option<Box<Self>> {
        let config = RenderConfig { antialias: Antialias::Off, ..RenderConfig::default() };
        let opened = device::open_to_train(Device::Gpu, config);
        if opened.fell_back {
            assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set: {}", opened.why);
            println!("skipped: {}", opened.why);
            return None;
        }
        Some(Box::new(Self { device: opened.backend, left, keeps: true, gone: false }))
    }

    fn here(&mut self) -> Result<&mut Box<dyn Backend>> {
        if self.gone { Err(Error::new(ErrorKind::Unsupported, GONE)) } else { Ok(&mut self.device) }
    }

    /// Its tables, if it does this again.
    fn tables(&mut self, what: usize) -> Result<&mut dyn Resident> {
        let left = self.left[what].checked_sub(1);
        self.gone |= left.is_none();
        self.left[what] = left.unwrap_or(0);
        Ok(self.here()?.resident().expect("a GPU"))
    }
}

impl Backend for Failing {
    fn can(&self, wanted: &Abilities) -> Result<()> {
        self.device.can(wanted)
    }
    fn render(&mut self, shot: &Shot<'_>, out: &mut Image) -> Result<()> {
        self.here()?.render(shot, out)
    }
    fn vjp(
        &mut self,
        shot: &Shot<'_>,
        grads: &ImageGrads<'_>,
        d_sh: &mut [Option<&mut Table>],
        d: &mut RenderGrads,
    ) -> Result<()> {
        self.here()?.vjp(shot, grads, d_sh, d)
    }
    fn resident(&mut self) -> Option<&mut dyn Resident> {
        if self.keeps { Some(self) } else { None }
    }
    fn radii(&self) -> &[f32] {
        self.device.radii()
    }
    fn config(&self) -> &RenderConfig {
        self.device.config()
    }
    fn name(&self) -> &str {
        "failing"
    }
}

impl Resident for Failing {
    fn keep(
        &mut self,
        layers: &[ResidentLayer<'_>],
        cameras: Option<&ResidentCameras<'_>>,
        corrections: &[[f32; 2]],
    ) -> Result<()> {
        // Too little memory is not a failure.
        self.left[0] = self.left[0].checked_sub(1).ok_or_else(|| Error::new(ErrorKind::Unsupported, FULL))?;
        self.here()?.resident().expect("a GPU").keep(layers, cameras, corrections)
    }
    fn step(&mut self, step: &ResidentStep<'_>) -> Result<Option<Vec<ResidentStepped>>> {
        assert_eq!(step.alpha_min, ALPHA_MIN);
        self.tables(1)?.step(step)
    }
    fn holds(&mut self, picture: usize, size: [usize; 2], weighted: bool) -> bool {
        self.device.resident().is_some_and(|resident| resident.holds(picture, size, weighted))
    }
    fn finish(&mut self) -> Result<Vec<ResidentStepped>> {
        self.here()?.resident().expect("a GPU").finish()
    }
    fn fetch(&mut self, layer: usize) -> Result<ResidentNumbers> {
        self.tables(2)?.fetch(layer)
    }
    fn fetch_cameras(&mut self) -> Result<[Vec<f32>; 2]> {
        self.here()?.resident().expect("a GPU").fetch_cameras()
    }
}

#[test]
fn a_failing_device_loses_only_steps_since_the_last_settle() {
    let bed = Bed::new();
    let recipe = settings("motion=spacetime strategy=none");
    let start = saved(&bed.start(&recipe));
    let mut on_cpu = bed.start(&recipe);
    finish(&mut on_cpu, "on the CPU");
    let expected = bytes(on_cpu.scene());
    for left in [[ALWAYS, 0, 9], [ALWAYS, 3, 9], [ALWAYS, 9, 0]] {
        let Some(device) = Failing::new(left) else { return };
        let mut trainer = bed.start(&recipe);
        trainer.set_engine(DeviceEngine::new(device));
        let mut notices = Vec::new();
        for _ in 0..3 {
            notices.extend(trainer.step().unwrap().unwrap().notices);
        }
        if left[1] == 0 {
            // The learner had everything: the CPU has taken the same step, and all that follow.
            notices.extend(finish(&mut trainer, "on the CPU").1);
            assert_eq!(notices, [format!("training continues on the CPU: {GONE}")]);
            assert!(bytes(trainer.scene()) == expected);
            continue;
        }
        assert!(notices.is_empty());
        let fault = match left[2] {
            0 => trainer.settle().expect_err("it is gone"),
            _ => trainer.step().unwrap().expect_err("it is gone"),
        };
        assert!(fault.1 == Blame::Device && fault.0.contains(GONE), "{}", fault.0);
        // The run then returns to a checkpoint and continues on the CPU.
        crate::run::checkpoint::read(&start, &mut trainer, &Default::default()).unwrap();
        let (_, notices) = finish(&mut trainer, "on the CPU");
        assert!(notices.is_empty() && bytes(trainer.scene()) == expected, "{notices:?}");
    }
}

#[test]
fn a_device_without_memory_for_tables_still_renders() {
    let bed = Bed::new();
    for line in ["motion=tracked strategy=none rigid_neighbours=5", "motion=spacetime strategy=adc"] {
        let recipe = settings(line);
        let run = |keeps: bool| {
            let mut device = Failing::new([0; 3])?;
            device.keeps = keeps;
            let mut trainer = bed.start(&recipe);
            trainer.set_engine(DeviceEngine::new(device));
            let (mse, notices) = finish(&mut trainer, line);
            Some((bytes(trainer.scene()), mse, notices))
        };
        let Some((scene, mse, notices)) = run(false) else { return };
        assert!(notices.is_empty(), "{notices:?}");
        let told = vec![format!("the CPU keeps the tables and steps: {FULL}")];
        assert!(run(true) == Some((scene.clone(), mse, told)), "{line}: the same, and one line");
        let mut on_cpu = bed.start(&recipe);
        finish(&mut on_cpu, line);
        assert!(bytes(on_cpu.scene()) != scene, "{line}: the GPU has drawn");
    }
}
