use super::super::start::train;
use super::super::tests::{Place, recipe};
use super::super::{TrainOptions, open_run};
use super::*;
use splat4d::layers::FAR_SHELL;
use std::sync::atomic::AtomicBool;

/// The recipe as it is decided, and what listeners hear: decisions, and warnings.
fn decided_of(words: &[&str]) -> (Recipe, Vec<Option<f64>>, Vec<String>) {
    let place = Place::new();
    let recipe = recipe(words);
    let opened = OpenCapture::new(place.open(&recipe), &recipe).unwrap();
    let (mut heard, mut warned) = (Vec::new(), Vec::new());
    let mut listen = |event: &Event| match event {
        Event::Shell { distance, .. } => heard.push(*distance),
        Event::Warning { message } => warned.push(message.clone()),
        _ => {}
    };
    (decided(&opened, recipe, &mut listen).unwrap(), heard, warned)
}

#[test]
fn small_images_and_stated_shells_are_not_examined() {
    for words in [&["init.shell=auto"][..], &["init.shell=off"], &["init.shell=on", "init.shell_distance=20"]] {
        let (decided, heard, warned) = decided_of(&[&["motion=still"], words].concat());
        assert_eq!(decided, recipe(&[&["motion=still"], words].concat()));
        assert!(heard.is_empty() && warned.is_empty(), "{words:?}");
    }
}

#[test]
fn a_requested_shell_gets_a_distance() {
    let (decided, heard, _) = decided_of(&["motion=still", "init.shell=on"]);
    assert_eq!(decided.init.shell, FarShell::On);
    assert!(decided.init.shell_distance > 1.0, "{}", decided.init.shell_distance);
    assert!(matches!(heard[..], [Some(d)] if d > 1.0), "{heard:?}");
}

#[test]
fn runs_that_cannot_have_a_shell_report_why() {
    for (word, why) in [("motion=tracked", "one layer"), ("densify.strategy=mcmc", "mcmc")] {
        let (decided, heard, warned) = decided_of(&["motion=still", word, "init.shell=on", "init.shell_distance=20"]);
        assert_eq!((decided.init.shell, decided.init.shell_at()), (FarShell::Off, None), "{word}");
        assert!(heard.is_empty() && warned.len() == 1 && warned[0].contains(why), "{word}: {warned:?}");
        let (_, heard, warned) = decided_of(&["motion=still", word]);
        assert!(heard.is_empty() && warned.is_empty(), "{word}: nothing was requested");
    }
}

#[test]
fn runs_with_a_shell_resume_bit_for_bit() {
    // Images of a ball before a sky without texture: everything behind the ball is far.
    let place = Place::new();
    let recipe = recipe(&["motion=spacetime", "init.shell=on", "init.shell_distance=30", "split.reach=0.01"]);
    let whole = place.train("whole", &recipe).unwrap();
    assert!(!whole.interrupted);
    let scene = |run: &str| {
        let bytes = std::fs::read(place.run(run).join("scene.safetensors")).unwrap();
        splat4d::format::scene::read(&bytes).unwrap()
    };
    let layers = scene("whole").layers;
    assert_eq!(layers[1].name, FAR_SHELL);
    assert_eq!(open_run(&place.run("whole")).unwrap().0.init.shell_at(), Some(30.0));
    let stop = AtomicBool::new(false);
    let mut listen = |event: &Event| {
        if matches!(event, Event::Checkpoint { iteration: 20, .. }) {
            stop.store(true, std::sync::atomic::Ordering::Relaxed);
        }
    };
    let run = place.run("parts");
    let first = train(place.open(&recipe), recipe.clone(), &run, &TrainOptions::default(), &stop, &mut listen).unwrap();
    assert!(first.interrupted);
    super::super::start::resume(&run, &AtomicBool::new(false), &mut |_| {}).unwrap();
    let bytes = |run: &str| std::fs::read(place.run(run).join("scene.safetensors")).unwrap();
    assert!(bytes("whole") == bytes("parts"), "the same bits after a stop");
}
