//! A tiny take in three chunks: the same scene in whatever order workers take the parts, and clear words where
//! something is missing.

use super::tie::{Neighbour, Tie};
use super::*;
use crate::loss::image::{ImageTerm, LossGrads, Shown, View};
use crate::loss::terms::StepInfo;
use crate::run::Stopwatch;
use crate::run::tests::{Place, recipe};
use splat4d::format::scene;
use splat4d::layers::Scene;
use splat4d::math::{Rng, Se3};
use splat4d::render::{Image, RenderConfig};
use splat4d::scene::{Camera, GEOMETRY, Planes, SH, Time};

const MOMENTS: usize = 20;

fn of_chunks(changes: &[&str]) -> Recipe {
    recipe(&[&["chunks.frames=8", "chunks.overlap=2", "iterations=24"], changes].concat())
}

fn begin(place: &Place, name: &str, recipe: &Recipe) -> Result<Option<Chunked>> {
    Chunked::begin(&place.open(recipe), recipe, &place.run(name), &mut |_| {})
}

fn read(path: &Path) -> Scene<f32> {
    scene::read(&std::fs::read(path).unwrap()).unwrap()
}

/// The bytes of all parts, and of the whole.
fn files(run: &Chunked) -> Vec<Vec<u8>> {
    run.join().unwrap();
    let parts = (0..run.plan.len()).map(|c| run.folder(Part::Chunk(c)).join(SCENE));
    let all = parts.chain([run.folder(Part::Shared).join(shared::FILE), run.run.join(SCENE)]);
    all.map(|path| std::fs::read(path).unwrap()).collect()
}

#[test]
fn the_scene_does_not_depend_on_workers_order_or_interruptions() {
    let (place, recipe) = (Place::of(MOMENTS), of_chunks(&[]));
    let (options, never) = (TrainOptions::default(), AtomicBool::new(false));
    let one = begin(&place, "one", &recipe).unwrap().unwrap();
    assert_eq!((one.plan.len(), one.parts()[1..].to_vec()), (3, [0, 2, 1].map(Part::Chunk).to_vec()));
    assert!(one.work_all(&options, &never, &mut || Ok(()), &mut |_| {}).unwrap().is_none());
    let other = begin(&place, "other", &recipe).unwrap().unwrap();
    for part in [Part::Shared, Part::Chunk(2), Part::Chunk(0), Part::Chunk(1)] {
        // Stopped in the midst of it, and continued by a process that has only the folder.
        let stop = AtomicBool::new(false);
        let halt = |event: &Event| {
            if matches!(event, Event::Checkpoint { iteration: 10.., .. }) {
                stop.store(true, Ordering::Relaxed);
            }
        };
        let outcome = other.work(part, &options, &stop, &mut |e| halt(e)).unwrap().unwrap();
        assert!(outcome.interrupted && !other.is_done(part), "{part}");
        let next = Chunked::open(&other.run).unwrap();
        assert!(!next.work(part, &options, &never, &mut |_| {}).unwrap().unwrap().interrupted);
        assert_eq!(next.work(part, &options, &never, &mut |_| {}).unwrap(), None, "{part} is done");
    }
    assert_eq!(files(&one), files(&other));

    let whole = read(&one.run.join(SCENE));
    let shared = read(&one.folder(Part::Shared).join(shared::FILE));
    assert_eq!(whole.layers.len(), 3 + shared.layers.len());
    // Neighbours fade into each other, and what a chunk has of the shared layer never learns.
    for (a, b) in whole.layers.iter().zip(&whole.layers[1..3]) {
        let both = a.span[1] - b.span[0];
        assert!(
            (both - 0.2).abs() < 1e-9 && (a.cross_fade[1] - both).abs() < 1e-9 && (b.cross_fade[0] - both).abs() < 1e-9
        );
    }
    let still = shared.layers.first().expect("the ball leaves most of the picture alone");
    for c in 0..3 {
        let chunk = read(&one.folder(Part::Chunk(c)).join(SCENE));
        let own = chunk.layers.iter().find(|l| l.name == shared::LAYER).unwrap();
        assert_eq!((&own.params[GEOMETRY], &own.params[SH]), (&still.params[GEOMETRY], &still.params[SH]), "chunk {c}");
        assert!(chunk.len() <= recipe.densify.max_cap && !chunk.layers[0].params.is_empty());
    }
    let seams = |cuts: usize| one.seams(&mut |done| done < cuts, &mut |_| {}).unwrap();
    assert!(seams(0).is_none() && seams(1).unwrap().cuts == 1, "it ends when there is no time");
    let seams = seams(9).unwrap();
    assert!(seams.cuts == 2 && seams.held_out && seams.across.is_finite() && seams.inside > 0.0, "{seams:?}");
}

#[test]
fn missing_and_foreign_chunks_are_named() {
    let (place, recipe) = (Place::of(MOMENTS), of_chunks(&["iterations=2"]));
    let (options, never) = (TrainOptions::default(), AtomicBool::new(false));
    let run = begin(&place, "run", &recipe).unwrap().unwrap();
    let work = |part| run.work(part, &options, &never, &mut |_| {}).unwrap_err().to_string();
    assert!(work(Part::Chunk(3)).contains("no chunk 3"));
    assert!(work(Part::Chunk(0)).contains("--chunk shared"));
    assert!(run.join().unwrap_err().to_string().contains("--chunk shared"));
    run.work(Part::Shared, &options, &never, &mut |_| {}).unwrap();
    assert!(work(Part::Chunk(1)).contains("--chunk 0, --chunk 2"));
    let owner = Owner::take(&run.folder(Part::Chunk(0)), MADE_BY).unwrap().ok();
    assert!(work(Part::Chunk(0)).contains("in use by"));
    drop(owner);
    run.work_all(&options, &never, &mut || Ok(()), &mut |_| {}).unwrap();
    run.join().unwrap();
    // Another recipe in the same folder; a chunk of another recipe; one of another version.
    let again = |changes: &[&str]| begin(&place, "run", &of_chunks(changes)).map(|_| ()).unwrap_err().to_string();
    assert!(again(&["iterations=3"]).contains("another recipe"));
    let folder = run.folder(Part::Chunk(1));
    for (file, from, to, says) in [
        ("recipe.toml", "seed = 0", "seed = 1", "another recipe"),
        ("run.json", env!("CARGO_PKG_VERSION"), "0.0.0", "another version (0.0.0)"),
    ] {
        let text = std::fs::read_to_string(folder.join(file)).unwrap();
        assert!(text.contains(from), "{file}");
        std::fs::write(folder.join(file), text.replace(from, to)).unwrap();
        let error = run.join().unwrap_err().to_string();
        assert!(error.contains(says), "{error}");
        std::fs::write(folder.join(file), text).unwrap();
    }
    for (changes, says) in [
        (&["features=full"][..], "features=none"),
        (&["refine.poses=true"], "refine"),
        (&["chunks.overlap=3"], "even --overlap"),
        (&["chunks.overlap=4"], "even --overlap"),
    ] {
        let error = begin(&place, "refused", &of_chunks(changes)).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains(says), "{error}");
    }
    std::fs::write(run.run.join(FOLDER).join(PLAN), "{\"cuts\": []}").unwrap();
    assert!(Chunked::open(&run.run).is_err());
}

#[test]
fn short_captures_are_not_cut_and_long_ones_at_rest() {
    let place = Place::of(MOMENTS);
    for recipe in [of_chunks(&["chunks.frames=20"]), of_chunks(&["chunks.frames=0"])] {
        assert!(begin(&place, "whole", &recipe).unwrap().is_none());
        assert!(!place.run("whole").exists());
    }
    let recipe = of_chunks(&["chunks.frames=10"]);
    let capture = place.open(&recipe);
    let even = ChunkPlan::even(&capture, &recipe).unwrap().unwrap();
    assert_eq!((even.cuts.clone(), even.frames(0), even.frames(1), even.shared(0)), (vec![10], 0..11, 9..20, 9..11));
    // The ball is static from frame 10 to 11 only.
    for camera in 0..4 {
        let picture = |k: usize| capture.root.join(format!("images/{camera}/{k:04}.png"));
        std::fs::copy(picture(10), picture(11)).unwrap();
    }
    let open = |frames| open_frames(&capture.root, &recipe, vec![frames], &Lenses::default());
    assert_eq!(even.at_rest(&open, &mut |_| {}).unwrap().cuts, [11]);
}

#[test]
fn the_tie_is_the_mean_difference_to_the_neighbour_where_both_are() {
    let (camera, truth) = (Camera::with_fov_y(Se3::IDENTITY, 0.8, 6, 6), Planes::new(3, 6, 6));
    let scene = Scene { clip: [0.0, 1.0], ..Scene::default() };
    let neighbour = Neighbour { scene, window: [0.4, 0.6], print: String::new() };
    let mut tie = Tie::new(0.5, Arc::new(vec![neighbour]), None, RenderConfig::default());
    let mut image = Image { color: Planes::new(3, 6, 6), ..Image::default() };
    image.color.data.iter_mut().enumerate().for_each(|(i, x)| *x = Rng::new(1, "tie", 0).uniform(i as u64) as f32);
    let mut eval = |t: f64| {
        let view = View {
            camera: &camera,
            t: Time(t),
            // What an empty neighbour shows.
            background: [0.25, 0.5, 0.75],
            truth: &truth,
            mask: None,
            weight: None,
            depth: None,
            flow: None,
            measured: None,
            tracks: None,
            frame: 0,
            rig: 0,
            shutter: None,
        };
        let info = StepInfo { iteration: 0, times: vec![view.t], seed: 0, progress: 0.0 };
        let mut d = LossGrads::default();
        d.begin(&image);
        let value = tie.eval(&info, &view, &Shown::new(&image, &[]), &mut d);
        (value, d.grads().color.data.clone())
    };
    assert_eq!(eval(0.7).0, 0.0, "the neighbour does not see that");
    let (value, d) = eval(0.5);
    let off = |i: usize| f64::from(image.color.data[i]) - [0.25, 0.5, 0.75][i / 36];
    let mean = (0..108).map(|i| off(i).abs()).sum::<f64>() / 108.0;
    assert!((value - 0.5 * mean).abs() < 1e-7, "{value} {mean}");
    assert!((0..108).all(|i| (f64::from(d[i]) - 0.5 / 108.0 * off(i).signum()).abs() < 1e-9));
}

/// A clock on which every reading takes this many seconds: a step that is timed takes one, a step of a run some more.
fn ticking(seconds: f64) -> Stopwatch {
    let ticks = std::sync::atomic::AtomicUsize::new(0);
    Stopwatch::of(move || ticks.fetch_add(1, Ordering::Relaxed) as f64 * seconds)
}

#[test]
fn the_parts_end_on_time_on_a_machine_that_is_slower_than_it_was_timed() {
    let (place, recipe, never) = (Place::of(MOMENTS), of_chunks(&[]), AtomicBool::new(false));
    let minutes = 0.04;
    let replans = |folder: &Path| {
        let text = read_text(&folder.join("recipe.toml")).unwrap();
        Recipe::from_toml(&text).unwrap().run.replans.rows().to_vec()
    };
    // Seconds of all parts, and the run.
    let trained = |name: &str, paced: bool| {
        let clock = ticking(4e-3);
        let capture = place.open(&recipe);
        let outlook =
            ChunkEstimate::new(&capture, &recipe, Some(minutes), 0.0, false, &clock, &mut |_| {}).unwrap().unwrap();
        let begun = Chunked::begin(&capture, &outlook.recipe, &place.run(name), &mut |_| {}).unwrap().unwrap();
        let run = begun.paced(outlook.pacing.filter(|_| paced));
        let options = TrainOptions { clock: clock.clone(), ..TrainOptions::default() };
        // Stopped once, after a chunk was planned again: it continues with the plans that it followed.
        let (stop, mut stopped) = (AtomicBool::new(false), false);
        let first = run.folder(Part::Chunk(0));
        let mut hear = |event: &Event| {
            if let Event::Checkpoint { path, .. } = event
                && !stopped
                && path.starts_with(&first)
                && !replans(&first).is_empty()
            {
                stopped = true;
                stop.store(true, Ordering::Relaxed);
            }
        };
        if let Some(outcome) = run.work_all(&options, &stop, &mut || Ok(()), &mut hear).unwrap() {
            assert!(paced && outcome.interrupted);
            run.work_all(&options, &never, &mut || Ok(()), &mut |_| {}).unwrap();
        }
        (clock.seconds(), run)
    };
    let (late, _) = trained("late", false);
    assert!(late > 1.5 * 60.0 * minutes, "{late} s: the machine is not slow");
    let (seconds, run) = trained("paced", true);
    assert!(seconds <= 60.0 * minutes, "{seconds} s of {}", 60.0 * minutes);
    assert!(!replans(&run.folder(Part::Chunk(1))).is_empty(), "it was planned anew");
    run.join().unwrap();
}

#[test]
fn a_plan_stays_within_memory_and_minutes() {
    let place = Place::of(MOMENTS);
    let outlook = |changes: &[&str], minutes: Option<f64>| {
        let recipe = of_chunks(changes);
        ChunkEstimate::new(&place.open(&recipe), &recipe, minutes, 0.0, false, &ticking(1e-3), &mut |_| {})
    };
    let free = outlook(&["max_cap=20000"], None).unwrap().unwrap();
    let limit = free.memory - (4 << 20);
    let set = format!("memory_limit={limit}");
    let tight = outlook(&["max_cap=20000", &set], None).unwrap().unwrap();
    assert!(tight.memory <= limit && tight.recipe.densify.max_cap < free.recipe.densify.max_cap);
    assert!(tight.plan.len() >= free.plan.len() && tight.recipe.chunks.frames >= 3 * 2);
    assert!(outlook(&["memory_limit=1000000"], None).unwrap_err().to_string().contains("more memory"));
    // Of two times, the longer one gets more steps, and all parts together take no more than it.
    let steps = [0.02, 0.2].map(|m| outlook(&[], Some(m)).unwrap().unwrap());
    assert!(steps[0].recipe.run.iterations < steps[1].recipe.run.iterations);
    assert!(steps[1].seconds.unwrap() <= 60.0 * 0.2);
    // What follows training takes its steps from it.
    let recipe = of_chunks(&[]);
    let finish =
        ChunkEstimate::new(&place.open(&recipe), &recipe, Some(0.2), 2000.0, false, &ticking(1e-3), &mut |_| {});
    assert!(finish.unwrap().unwrap().recipe.run.iterations < steps[1].recipe.run.iterations);
    assert!(outlook(&["chunks.frames=20"], None).unwrap().is_none(), "it is learnt at once");
}

#[test]
fn every_motion_model_trains_in_two_chunks() {
    let place = Place::of(12);
    for motion in ["spacetime", "deform-mlp", "hexplane", "tracked", "native4d", "control", "ssm"] {
        let recipe = recipe(&["chunks.frames=6", "chunks.overlap=2", "iterations=8", &format!("motion={motion}")]);
        let run = begin(&place, motion, &recipe).unwrap().unwrap();
        let never = AtomicBool::new(false);
        run.work_all(&TrainOptions::default(), &never, &mut || Ok(()), &mut |_| {}).unwrap();
        run.join().unwrap();
        let whole = read(&run.run.join(SCENE));
        assert_eq!(run.plan.len(), 2, "{motion}");
        let own = whole.layers.iter().filter(|l| l.name != shared::LAYER);
        assert!(own.clone().count() == 2 && own.clone().all(|l| l.motion.spec().name() == motion), "{motion}");
        // Every time is seen, those that both show too.
        for t in [0.0, 0.55, 1.1] {
            let mut seen = splat4d::layers::Evaluation::default();
            whole.at(Time(t), &mut seen);
            assert!(!whole.splats(&seen).is_empty(), "{motion} at {t}");
        }
    }
}
