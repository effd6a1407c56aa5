//! The device that draws in the run's files: recorded, and told where a run goes on elsewhere.

use super::*;
use splat4d::device::Device;

#[test]
fn a_run_says_on_what_it_trains_and_where_it_goes_on() {
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
    // Where there is no GPU, that is said, and the CPU trains.
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
    // A run on the CPU, as all were, says nothing.
    let mut silent = |event: &Event| assert!(!matches!(event, Event::Device { .. }));
    let (run, options) = (place.run("cpu"), TrainOptions::default());
    train(place.open(&recipe), recipe, &run, &options, &AtomicBool::new(false), &mut silent).unwrap();
}
