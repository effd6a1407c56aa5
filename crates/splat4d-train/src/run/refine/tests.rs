//! A scene is pruned, becomes the pages of a file and is tuned: the same bits for any number of threads, after any stop
//! and after a crash; no stage is repeated.

use super::*;
use crate::ErrorKind;
use crate::compress::quantise::{self, Quantised};
use crate::loss::terms::{Codec, ParamLoss, StepInfo};
use crate::methods::{Rate, TrainContext};
use crate::run::tests::{Place, copy_folder, recipe};
use crate::run::{plan, training_frames};
use splat4d::bake::{self, bake};
use splat4d::format::playback::{Depths, Draft, Meta, WriteConfig, read_pages, write};
use splat4d::math::Rng;
use splat4d::scene::{GEOMETRY, Grads, KeyMasks, RowEdit, Space};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Steps of the stage in floats and of the one on a file's numbers.
const FLOATS: usize = 12;
const CODED: usize = 18;

/// A disturbance before step `at`: `f` gets the gradients.
struct Meddle<F> {
    at: usize,
    f: F,
}

impl<F: Fn(&mut [Grads<f32>]) + Send + Sync> ParamLoss<f32> for Meddle<F> {
    fn name(&self) -> &str {
        "meddle"
    }

    fn eval(&self, _: &Scene<f32>, info: &StepInfo, d: &mut [Grads<f32>]) -> f64 {
        if info.iteration + 1 == self.at {
            (self.f)(d);
        }
        0.0
    }
}

/// Where tests work: a scene that was trained a little.
struct Bed {
    place: Place,
    recipe: Recipe,
    plan: TrainContext,
    frames: Arc<Dataset>,
    source: Scene<f32>,
}

/// A run to be.
struct Job {
    refine: Refine,
    codec: Arc<Quantised>,
    /// Stages that have begun.
    begun: Arc<AtomicUsize>,
}

impl Bed {
    fn new() -> Self {
        let place = Place::new();
        let recipe = recipe(&["motion_order=2", "lambda_velocity=0.1"]);
        place.train("source", &recipe).unwrap();
        let source = splat4d::format::scene::read(&place.scene("source")).unwrap();
        let capture = place.open(&recipe);
        let plan = plan(&capture, &recipe);
        let frames = training_frames(capture, &recipe).unwrap();
        Self { place, recipe, plan, frames, source }
    }

    /// Prunes a third, tunes, does something without a step, becomes a file, tunes on.
    fn job(&self, meddle: impl Fn() -> Option<Box<dyn ParamLoss<f32>>>) -> Job {
        let begun = Arc::new(AtomicUsize::new(0));
        let codec = Quantised::new(
            Depths { position: 10, color: 5, opacity: 5, ..Depths::default() },
            quantise::palette_rate(&self.recipe.rates, 0.5),
        )
        .unwrap();
        let base = self.recipe.program().unwrap().stages(&self.plan).remove(0);
        let count = begun.clone();
        let floats = Stage {
            name: "pruned".into(),
            iterations: FLOATS,
            groups: quantise::tuned(base.groups.clone(), 0.5),
            maintenance: Vec::new(),
            noise: None,
            half_size_steps: 0,
            start: Some(Box::new(move |scene, progress| {
                count.fetch_add(1, Ordering::Relaxed);
                progress.phase("pruning", 0, 1);
                for layer in &mut scene.layers {
                    let edit = RowEdit::prune(Space::Gaussians, (0..layer.params.len()).map(|i| i % 3 != 0));
                    layer.edit(&edit, &Rng::new(0, "prune", 0));
                }
                Ok(())
            })),
            ..base
        };
        let nothing = Stage::new("nothing", 0);
        let (count, writer) = (begun.clone(), codec.clone());
        let mut coded = quantise::stage(&self.recipe, &self.plan, CODED, 0.5, codec.clone());
        coded.start = Some(Box::new(move |scene, _| {
            count.fetch_add(1, Ordering::Relaxed);
            let options = bake::Options { tolerance: f64::INFINITY, ..bake::Options::default() };
            let baked = bake(scene, &options, &mut |_, _| {})?;
            let Scene { fps, up, background, .. } = *scene;
            let meta = Meta { clip: baked.clip, fps, up, background, sh_degree: baked.sh_degree, ..Meta::default() };
            let mut bytes = Vec::new();
            let config = WriteConfig { palette: 16, tier: 20, ..WriteConfig::default() };
            write(&Draft { meta, nodes: baked.nodes, poster: None }, &config, &mut bytes)?;
            writer.begin(read_pages(&bytes)?, scene);
            for layer in &mut scene.layers {
                let mut masks = KeyMasks::new(vec![0.0, 0.2], layer.params.len());
                (0..layer.params.len()).filter(|i| i % 7 != 0).for_each(|i| masks.set(i % 2, i));
                layer.masks = Some(Arc::new(masks));
            }
            Ok(())
        }));
        let mut stages = vec![floats, nothing, coded];
        stages.iter_mut().for_each(|s| s.params.extend(meddle()));
        let (frames, recipe) = (self.frames.clone(), self.recipe.clone().with(|r| r.run.checkpoint_interval = 10));
        let (scene, made_by, identity) = (self.source.clone(), "compress".into(), "a third".into());
        Job {
            refine: Refine { made_by, scene, stages, frames, recipe, exposure: None, identity, budget: None },
            codec,
            begun,
        }
    }

    fn run(&self, name: &str, job: Refine, stop: &AtomicBool, listen: &mut dyn FnMut(&Event)) -> Result<Refined> {
        refine(job, &self.place.run(name), &TrainOptions::default(), stop, listen)
    }

    /// To the end; gives the bytes of what learnt, of what is seen and of the file's palette.
    fn finish(&self, name: &str, job: Job) -> (Vec<u8>, Vec<u8>, Vec<u8>) {
        let done = self.run(name, job.refine, &AtomicBool::new(false), &mut |_| {}).unwrap();
        assert!(!done.outcome.interrupted && done.outcome.iteration == FLOATS + CODED);
        let pages = job.codec.pages(&done.scene, Meta::default()).unwrap();
        let mut learnt = Vec::new();
        splat4d::format::scene::write(&done.scene, &mut learnt).unwrap();
        (learnt, self.place.scene(name), pages.palette.unwrap().codes)
    }
}

fn no_meddler() -> Option<Box<dyn ParamLoss<f32>>> {
    None
}

#[test]
fn any_number_of_threads_any_stop_and_any_crash_give_the_same_bytes() {
    let bed = Bed::new();
    let job = bed.job(no_meddler);
    let (codec, begun) = (job.codec.clone(), job.begun.clone());
    let whole = bed.finish("whole", job);
    assert_eq!(begun.load(Ordering::Relaxed), 2);
    assert!(whole.0 != whole.1, "what is seen is not what learns");
    let learnt = splat4d::format::scene::read(&whole.0).unwrap();
    let mut seen = Vec::new();
    splat4d::format::scene::write(&codec.whole(&learnt), &mut seen).unwrap();
    assert!(seen == whole.1, "the run's scene is what the file will show");
    assert!(learnt.layers.len() > bed.source.layers.len() && learnt.len() < bed.source.len());
    assert!(learnt.layers.iter().all(|l| l.masks.is_some()));
    let on = |threads: usize| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let [one, three] = [1, 3].map(on);
    // Within both stages, at the end of one, after the first step of the next; on one thread, and on with three.
    for (at, starts) in [(7, 1), (FLOATS, 1), (FLOATS + 1, 0)] {
        let name = format!("stop {at}");
        let stop = Arc::new(AtomicBool::new(false));
        let meddle = || {
            let stop = stop.clone();
            let f = move |_: &mut [Grads<f32>]| stop.store(true, Ordering::Relaxed);
            Some(Box::new(Meddle { at, f }) as Box<dyn ParamLoss<f32>>)
        };
        let stopped = one.install(|| bed.run(&name, bed.job(meddle).refine, &stop, &mut |_| {})).unwrap().outcome;
        assert!(stopped.interrupted && stopped.iteration == at, "{stopped:?}");
        let job = bed.job(no_meddler);
        let begun = job.begun.clone();
        assert!(three.install(|| bed.finish(&name, job)) == whole, "{name}");
        assert_eq!(begun.load(Ordering::Relaxed), if at < FLOATS { 1 } else { starts }, "{name}: nothing begins twice");
    }
    // Crashes: whatever is on disk when a checkpoint was written.
    let mut copies = Vec::new();
    let mut listen = |event: &Event| {
        if let Event::Checkpoint { iteration, .. } = event
            && bed.place.run("crash").join("run.json").exists()
        {
            copies.push(format!("crash {iteration}"));
            copy_folder(&bed.place.run("crash"), &bed.place.run(copies.last().unwrap()));
        }
    };
    bed.run("crash", bed.job(no_meddler).refine, &AtomicBool::new(false), &mut listen).unwrap();
    assert_eq!(copies, ["crash 0", "crash 10", "crash 13", "crash 20", "crash 30"]);
    for name in &copies {
        assert!(bed.finish(name, bed.job(no_meddler)) == whole, "{name}");
    }
}

#[test]
fn a_fault_behind_a_codec_rolls_back() {
    let bed = Bed::new();
    let once = Arc::new(AtomicBool::new(false));
    let meddle = || {
        let once = once.clone();
        let f = move |d: &mut [Grads<f32>]| {
            let row = d[0].active(Space::Gaussians).iter().position(|a| *a);
            if let Some(row) = row.filter(|_| !once.swap(true, Ordering::Relaxed)) {
                d[0].of([GEOMETRY])[0].set(row, 0, f32::NAN);
            }
        };
        Some(Box::new(Meddle { at: 17, f }) as Box<dyn ParamLoss<f32>>)
    };
    let job = bed.job(meddle);
    let mut rolled = Vec::new();
    let mut phases = Vec::new();
    let mut listen = |event: &Event| match event {
        Event::RolledBack { iteration, to, .. } => rolled.push((*iteration, *to)),
        Event::Phase { name, .. } => phases.push(name.clone()),
        _ => {}
    };
    let done = bed.run("fault", job.refine, &AtomicBool::new(false), &mut listen).unwrap();
    assert_eq!((rolled, phases), (vec![(17, 13)], vec!["pruning".to_owned()]));
    assert_eq!(done.outcome.iteration, FLOATS + CODED);
    assert!(done.scene.layers.iter().all(|l| l.params.first_non_finite().is_none()));
    assert_eq!(job.begun.load(Ordering::Relaxed), 2, "the file was not made anew");
}

#[test]
fn only_the_same_run_is_continued() {
    let bed = Bed::new();
    let stop = AtomicBool::new(true);
    bed.run("run", bed.job(no_meddler).refine, &stop, &mut |_| {}).unwrap();
    let refused = |change: &dyn Fn(&mut Refine)| {
        let mut job = bed.job(no_meddler).refine;
        change(&mut job);
        bed.run("run", job, &stop, &mut |_| {}).unwrap_err()
    };
    let error = refused(&|job| job.identity = "a half".into()).to_string();
    assert!(error.contains("another recipe"), "{error}");
    let error = refused(&|job| job.recipe.loss.dssim = 0.3).to_string();
    assert!(error.contains("another recipe"), "{error}");
    assert_eq!(refused(&|job| job.stages.clear()).kind(), ErrorKind::BadInput);
    let error = crate::run::resume(&bed.place.run("run"), &stop, &mut |_| {}).unwrap_err().to_string();
    assert!(error.contains("splat4d compress"), "{error}");
    // A training run is not continued as a refinement.
    let error = bed.run("source", bed.job(no_meddler).refine, &stop, &mut |_| {}).unwrap_err().to_string();
    assert!(error.contains("another recipe"), "{error}");
}

#[test]
fn stages_without_steps_and_codecs_without_tuning() {
    let bed = Bed::new();
    let mut job = bed.job(no_meddler);
    job.refine.stages.iter_mut().for_each(|s| s.iterations = 0);
    let done = bed.run("none", job.refine, &AtomicBool::new(false), &mut |_| {}).unwrap();
    assert!(!done.outcome.interrupted && done.outcome.iteration == 0);
    let seen = splat4d::format::scene::read(&bed.place.scene("none")).unwrap();
    let whole = job.codec.whole(&done.scene);
    assert!(seen.layers.iter().zip(&whole.layers).all(|(a, b)| a.params == b.params));
    assert!(job.codec.pages(&done.scene, Meta::default()).is_ok());
    // A second call repeats nothing.
    let mut job = bed.job(no_meddler);
    job.refine.stages.iter_mut().for_each(|s| s.iterations = 0);
    let again = bed.run("none", job.refine, &AtomicBool::new(false), &mut |_| {}).unwrap();
    assert_eq!(job.begun.load(Ordering::Relaxed), 0);
    assert!(again.scene.layers.iter().zip(&done.scene.layers).all(|(a, b)| a.params == b.params));
    // A rate is a rate, and one that falls.
    let rate: Rate = quantise::palette_rate(&bed.recipe.rates, 1.0);
    assert!(rate.at(0.0) > rate.at(0.9) && rate.at(0.9) > 0.0);
}
