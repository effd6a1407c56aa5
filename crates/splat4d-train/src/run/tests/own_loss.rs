//! Losses that callers bring along: they count, they may fail within a step, and a run continues only with them.

use super::*;
use crate::loss::image::{ImageTerm, LossGrads, Needs, Shown, View};
use crate::loss::terms::StepInfo;
use crate::run::OwnLoss;

const STEPS: &str = "iterations=20";
/// The step within which the loss fails, after a checkpoint at half the steps.
const FAILS: usize = 14;

/// Pulls images towards black, and fails once.
struct Darker {
    fails: Option<Arc<AtomicBool>>,
}

impl ImageTerm for Darker {
    fn needs(&self, _: &View<'_>) -> Needs {
        Needs::default()
    }

    fn eval(&mut self, info: &StepInfo, _: &View<'_>, shown: &Shown<'_>, d: &mut LossGrads) -> f64 {
        if let Some(stop) = self.fails.as_ref().filter(|_| info.iteration == FAILS) {
            stop.store(true, Ordering::Relaxed);
            return f64::NAN;
        }
        let weight = 1.0 / shown.color.data.len() as f32;
        d.color.add().data.iter_mut().for_each(|d| *d += weight);
        shown.color.data.iter().map(|x| f64::from(x * weight)).sum()
    }
}

fn darker(fails: Option<&Arc<AtomicBool>>) -> TrainOptions {
    let fails = fails.cloned();
    let make = move || -> Box<dyn ImageTerm> { Box::new(Darker { fails: fails.clone() }) };
    TrainOptions { own_loss: Some(OwnLoss(Arc::new(make))), ..TrainOptions::default() }
}

#[test]
fn a_custom_loss_is_applied_and_an_interrupted_run_resumes_bit_for_bit() {
    let place = Place::new();
    let recipe = recipe(&[STEPS, "checkpoint_interval=10"]);
    let never = AtomicBool::new(false);
    let run = |name: &str, options: &TrainOptions, stop: &AtomicBool| {
        train(place.open(&recipe), recipe.clone(), &place.run(name), options, stop, &mut |_| {}).unwrap()
    };
    run("plain", &TrainOptions::default(), &never);
    run("whole", &darker(None), &never);
    assert!(place.scene("plain") != place.scene("whole"), "the loss has an effect");
    let stop = Arc::new(AtomicBool::new(false));
    let outcome = run("failed", &darker(Some(&stop)), &stop);
    assert!(outcome.interrupted && outcome.iteration == 10, "it is as its checkpoint was: {outcome:?}");
    let refused = resume_quietly(&place.run("failed")).unwrap_err().to_string();
    assert!(refused.contains("a loss of its own program"), "{refused}");
    resume_with(&place.run("failed"), &darker(None), &never, &mut |_| {}).unwrap();
    assert!(place.scene("failed") == place.scene("whole"), "bit by bit");
    assert!(resume_with(&place.run("plain"), &darker(None), &never, &mut |_| {}).is_err());
}
