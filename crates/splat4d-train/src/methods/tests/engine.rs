//! A trainer takes its steps with any engine.

use super::*;
use crate::learner::Learner;
use crate::train::engine::{CpuEngine, Engine, Fault, StepPlan, Stepped};
use crate::upkeep::Every;
use splat4d::render::Antialias;
use std::sync::atomic::{AtomicUsize, Ordering};

/// An engine of a caller's own: counts, and leaves the work to another.
struct Counting {
    inner: CpuEngine<'static>,
    steps: Arc<AtomicUsize>,
}

impl Engine for Counting {
    fn step(&mut self, learner: &mut Learner, plan: &mut StepPlan<'_>) -> Result<Result<Stepped, Fault>> {
        self.steps.fetch_add(1, Ordering::Relaxed);
        self.inner.step(learner, plan)
    }
    fn changed(&mut self, learner: &Learner) {
        self.inner.changed(learner);
    }
    fn antialias(&self) -> Antialias {
        self.inner.antialias()
    }
}

#[test]
fn an_engine_of_ones_own_takes_all_steps_and_makes_the_same_bits() {
    const STEPS: usize = 20;
    let run = |steps: Option<Arc<AtomicUsize>>| {
        let still = build(&Spec::Still, &mut Params::<f32>::new(0, 1, &[])).unwrap();
        let scene = one_layer(cloud(30, LifeKind::Infinite, 3), still, LifeKind::Infinite);
        let mut stage = Stage { groups: groups(&ORDINARY), ..Stage::new("engine", STEPS) };
        for (_, keep) in layers::STRATEGIES {
            keep(&mut stage, Every { first: 5, last: 15, interval: 5 });
        }
        let mut t = trainer(scene, vec![stage], 60);
        if let Some(steps) = steps {
            let inner = CpuEngine::new(Box::new(Renderer::new(RenderConfig::default())));
            t.set_engine(Counting { inner, steps });
        }
        finish_stage(&mut t);
        t.learner.into_scene().layers.remove(0).params
    };
    let steps = Arc::<AtomicUsize>::default();
    assert!(run(Some(steps.clone())) == run(None));
    assert_eq!(steps.load(Ordering::Relaxed), STEPS);
}
