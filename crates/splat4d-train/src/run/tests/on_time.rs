//! Runs that are kept to their time, on a clock of our own.

use super::super::minutes::tests::timing;
use super::*;
use std::sync::atomic::AtomicUsize;

/// Steps that fit by what was timed before the run.
const LONG: usize = 320;
/// Seconds of such a step.
const STEP: f64 = 0.1;

fn long() -> Recipe {
    recipe(&["iterations=320", "densify_until_iter=240", "densification_interval=20", "checkpoint_interval=50"])
}

/// Trains on a machine whose n-th step takes this many times [`STEP`]; returns the seconds that it took.
fn train_slowly(place: &Place, name: &str, slow: fn(usize) -> usize, listen: &mut dyn FnMut(&Event)) -> f64 {
    let ticks = Arc::new(AtomicUsize::new(0));
    let (read, add) = (ticks.clone(), ticks.clone());
    let clock = Stopwatch::of(move || read.load(Ordering::Relaxed) as f64 * STEP);
    let draw = meddled(move |n, _| {
        add.fetch_add(slow(n), Ordering::Relaxed);
    });
    let timing = timing([80, 130], [STEP; 2], [STEP; 2]);
    let budget = Budget { minutes: LONG as f64 * STEP / 60.0, before: 0.0, finish: 0.0, timing };
    let (time, stop) = ((clock, Some(budget)), AtomicBool::new(false));
    place.train_on_time(name, &long(), draw, time, &stop, listen).unwrap();
    ticks.load(Ordering::Relaxed) as f64 * STEP
}

fn saved(place: &Place, name: &str) -> Recipe {
    Recipe::from_toml(&read_text(&place.run(name).join("recipe.toml")).unwrap()).unwrap()
}

#[test]
fn runs_end_on_time_on_changing_machines_with_a_repeatable_plan() {
    let place = Place::new();
    type Machine = fn(usize) -> usize;
    let machines: [(&str, Machine); 2] = [
        ("slower", |n| 1 + usize::from(n > LONG / 2)),
        ("faster", |n| usize::from(n < LONG / 2 || n.is_multiple_of(2))),
    ];
    for (name, slow) in machines {
        let mut plans = 0;
        let end = train_slowly(&place, name, slow, &mut |e| {
            if let Event::Replanned { iteration, iterations, .. } = e {
                plans += 1;
                let rows = saved(&place, name).run.replans.rows().to_vec();
                let row = rows.last().unwrap();
                assert_eq!((rows.len(), row.at, row.total), (plans, *iteration, *iterations), "it is used unwritten");
            }
        });
        let off = end / (LONG as f64 * STEP);
        assert!((0.9..=1.1).contains(&off) && plans > 0, "{name}: {off} of the time, {plans} plans");
        let fixed = saved(&place, name);
        assert_eq!(fixed.run.iterations, LONG, "the schedule is that of the first plan");
        let outcome = place.train("again", &fixed).unwrap();
        assert_eq!(outcome.iteration, fixed.run.replans.rows().last().unwrap().total);
        assert!(place.scene(name) == place.scene("again"), "{name}: its recipe does not repeat it");
        // Stopped before and behind the first plan.
        for at in fixed.run.replans.rows()[..1].iter().flat_map(|r| [r.at - 3, r.at + 3]) {
            let stop = Arc::new(AtomicBool::new(false));
            let flag = stop.clone();
            let draw = meddled(move |n, _| flag.store(n >= at, Ordering::Relaxed));
            let outcome = place.train_with("part", &fixed, draw, &stop, &mut |_| {}).unwrap();
            assert!(outcome.interrupted && outcome.iteration == at);
            assert!(!resume_quietly(&place.run("part")).unwrap().interrupted);
            assert!(place.scene("part") == place.scene(name), "{name}, stopped after {at} steps");
            std::fs::remove_dir_all(place.run("part")).unwrap();
        }
        std::fs::remove_dir_all(place.run("again")).unwrap();
    }
}

#[test]
fn a_resumed_run_keeps_its_time_limit_and_history() {
    let place = Place::new();
    train_slowly(&place, "whole", |n| 1 + usize::from(n > 30), &mut |e| {
        if let Event::Checkpoint { iteration: 100, .. } = e {
            copy_folder(&place.run("whole"), &place.run("then"));
        }
    });
    // The state after a crash: a checkpoint behind the first plan, and later plans.
    let crashed = |name: &str| {
        let run = place.run(name);
        copy_folder(&place.run("then"), &run);
        std::fs::copy(place.run("whole").join("recipe.toml"), run.join("recipe.toml")).unwrap();
        run
    };
    let whole = saved(&place, "whole").run.replans;
    assert!(whole.rows()[0].at < 100, "{whole:?}");
    // A stopped clock triggers no new plan.
    let run = crashed("crashed");
    let options = TrainOptions { clock: Stopwatch::of(|| 0.0), ..TrainOptions::default() };
    resume_with(&run, &options, &AtomicBool::new(false), &mut |_| {}).unwrap();
    assert!(place.scene("crashed") == place.scene("whole") && saved(&place, "crashed").run.replans == whole);
    // On a clock that flies the rest is planned again, behind the plans that are there.
    let run = crashed("late");
    let late = Arc::new(AtomicUsize::new(0));
    let clock = Stopwatch::of(move || late.fetch_add(1, Ordering::Relaxed) as f64 * STEP);
    let options = TrainOptions { clock, ..TrainOptions::default() };
    resume_with(&run, &options, &AtomicBool::new(false), &mut |_| {}).unwrap();
    let now = saved(&place, "late").run.replans;
    assert!(now.rows().len() > whole.rows().len() && now.rows().starts_with(whole.rows()), "{now:?} {whole:?}");
    // The past cannot be planned.
    let path = crashed("other").join("recipe.toml");
    let mut other = saved(&place, "other");
    other.set("run.replans=[[5, 300]]").unwrap();
    std::fs::write(&path, other.to_toml()).unwrap();
    let error = resume_quietly(&place.run("other")).unwrap_err().to_string();
    assert!(error.contains("changes of plan"), "{error}");
}
