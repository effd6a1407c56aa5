//! The rendering device in the run's files: recorded, and reported where a run continues on another one.

use super::*;
use splat4d::device::Device;

#[test]
fn a_run_reports_its_device_and_where_it_resumes() {
    let place = Place::new();
    let recipe = recipe(&["iterations=20"]);
    let stop = AtomicBool::new(false);
    let mut told = Vec::new();
    let mut listen = |event: &Event| match event {
        Event::Device { why, .. } | Event::Warning { message: why } => told.push(why.clone()),
        Event::Checkpoint { iteration: 10, .. } => stop.store(true, Ordering::Relaxed),
        _ => {}
    };
    let options = TrainOptions { device: Device::Gpu, ..TrainOptions::default() };
    let run = place.run("device");
    train(place.open(&recipe), recipe.clone(), &run, &options, &stop, &mut listen).unwrap();
    let info = || serde_json::from_str::<Value>(&read_text(&run.join("run.json")).unwrap()).unwrap();
    let device = info()["device"].as_str().unwrap().to_owned();
    // Where there is no GPU, that is reported, and the CPU trains.
    let missed = device == "the CPU";
    assert!(told.len() == 1 && told[0].starts_with("training on ") && told[0].contains(&device), "{told:?}");
    assert!(missed == told[0].starts_with("training on the CPU: "), "{told:?}");
    told = Vec::new();
    let mut listen = |event: &Event| {
        if let Event::Device { why, .. } = event {
            told.push(why.clone());
        }
    };
    resume_with(&run, &TrainOptions::default(), &AtomicBool::new(false), &mut listen).unwrap();
    assert_eq!(info()["device"], "the CPU");
    assert_eq!(info()["finished"], true);
    assert_eq!(told.len(), usize::from(!missed), "{told:?}");
    assert!(missed || told[0].contains(&format!("before it was {device}")), "{told:?}");
    // A run on the CPU, as all were, states nothing.
    let mut silent = |event: &Event| assert!(!matches!(event, Event::Device { .. }));
    let (run, options) = (place.run("cpu"), TrainOptions::default());
    train(place.open(&recipe), recipe.clone(), &run, &options, &AtomicBool::new(false), &mut silent).unwrap();
    // Nor does one that `auto` continues: it stays on the CPU.
    let (run, stop) = (place.run("auto"), AtomicBool::new(false));
    let mut halfway = |event: &Event| {
        if let Event::Checkpoint { iteration: 10, .. } = event {
            stop.store(true, Ordering::Relaxed);
        }
    };
    train(place.open(&recipe), recipe, &run, &options, &stop, &mut halfway).unwrap();
    let options = TrainOptions { device: Device::Auto, ..TrainOptions::default() };
    resume_with(&run, &options, &AtomicBool::new(false), &mut silent).unwrap();
    assert!(place.scene("auto") == place.scene("cpu"));
}

#[test]
#[cfg(feature = "gpu")]
fn a_gpu_that_is_lost_costs_a_run_one_line_and_no_step() {
    let place = Place::new();
    let recipe = recipe(&["motion=spacetime", "antialias=false"]);
    // It fails at its eighteenth step, or when its tables are read between the first checkpoint and the second.
    for (name, left) in [("step", [usize::MAX, 17, usize::MAX]), ("fetch", [usize::MAX, usize::MAX, 3])] {
        let Some(draw) = crate::step::tests::resident::Failing::new(left) else { return };
        let (mut warnings, mut rolled) = (Vec::new(), 0);
        let mut listen = |event: &Event| match event {
            Event::Warning { message } => warnings.push(message.clone()),
            Event::RolledBack { .. } => rolled += 1,
            _ => {}
        };
        let outcome = place.train_with(name, &recipe, draw, &AtomicBool::new(false), &mut listen).unwrap();
        assert!(!outcome.interrupted && outcome.iteration == STEPS);
        let line = "the GPU that kept the tables failed (the driver is gone): training continues on the CPU, from its last \
                    checkpoint, of step 10";
        assert!(warnings == [line] && rolled == 0, "{name}: {warnings:?}");
        let info: Value = serde_json::from_str(&read_text(&place.run(name).join("run.json")).unwrap()).unwrap();
        assert!(info["rollbacks"] == 0 && info["finished"] == true, "{info}");
        let steps: Vec<String> =
            place.metrics(name)[1..].iter().map(|l| l.split(',').next().unwrap().to_owned()).collect();
        assert!(steps.windows(2).all(|w| w[0].parse::<usize>().unwrap() < w[1].parse().unwrap()), "{name}: {steps:?}");
    }
    // As a run that was stopped at that checkpoint, and resumed on the CPU.
    let stop = AtomicBool::new(false);
    let mut listen = |event: &Event| {
        if let Event::Checkpoint { iteration: 10, .. } = event {
            stop.store(true, Ordering::Relaxed);
        }
    };
    let options = TrainOptions { device: Device::Gpu, ..TrainOptions::default() };
    let outcome =
        train(place.open(&recipe), recipe.clone(), &place.run("stopped"), &options, &stop, &mut listen).unwrap();
    assert!(outcome.interrupted && outcome.iteration == 10);
    resume_with(&place.run("stopped"), &TrainOptions::default(), &AtomicBool::new(false), &mut |_| {}).unwrap();
    for name in ["step", "fetch"] {
        assert!(place.scene(name) == place.scene("stopped"), "{name}: what was trained before is there");
    }
}
