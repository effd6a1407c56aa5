//! Helpers of the tests of operations; schedules.

use super::*;
use crate::capture::frames::Picture;
use splat4d::layers::Layer;
use splat4d::motion::{Spec, build};
use splat4d::scene::params::LOG_SCALE;
use splat4d::scene::{Camera, LifeKind, Params};

/// One still layer of random Gaussians of opacity one half.
pub(crate) fn scene(rows: usize) -> Scene<f32> {
    let mut params = Params::new(rows, 1, &[]);
    let motion = build(&Spec::Still, &mut params).unwrap();
    let rng = Rng::new(1, "scene", 0);
    for r in 0..rows {
        let g = &mut params[GEOMETRY];
        for c in 0..7 {
            g.set(r, c, rng.fork(c as u64).normal(r as u64) as f32);
        }
        g.write(r, LOG_SCALE, [-2.0; 3]);
    }
    let layer = Layer::new("a", params, motion, LifeKind::Infinite);
    Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, ..Scene::default() }
}

/// No image: for operations that look at none.
struct Nothing;

impl Frames for Nothing {
    fn len(&self) -> usize {
        0
    }
    fn camera(&self, _: usize) -> &Camera {
        unreachable!("there is no frame")
    }
    fn time(&self, _: usize) -> Time {
        unreachable!("there is no frame")
    }
    fn rig(&self, _: usize) -> usize {
        unreachable!("there is no frame")
    }
    fn name(&self, _: usize) -> String {
        unreachable!("there is no frame")
    }
    fn load(&self, _: usize, _: &mut Picture) -> Result<()> {
        unreachable!("there is no frame")
    }
}

/// A context without images, in which everything learns.
pub(crate) fn context(limits: Limits, seed: u64, iteration: usize) -> Context<'static> {
    let at = At { step: 1, steps: 100 };
    Context { at, iteration, seed, limits, frames: &Nothing, antialias: Antialias::Off, learns: &|_, _| true }
}

/// Steps of a stage of `steps` after which an operation is due.
pub(crate) fn due_steps(operation: &dyn Maintenance, steps: usize) -> Vec<usize> {
    (1..=steps).filter(|&step| operation.due(&At { step, steps })).collect()
}

#[test]
fn schedules_are_due_at_multiples_and_continue_over_the_parts_of_a_stage() {
    let every = Every { first: 20, last: 100, interval: 10 };
    let due = |e: Every, steps: usize| (1..=steps).filter(|&s| e.is_due(s)).collect::<Vec<_>>();
    assert_eq!(due(every, 200), [20, 30, 40, 50, 60, 70, 80, 90, 100]);
    assert_eq!((1..=200).filter(|&s| every.is_last(s)).collect::<Vec<_>>(), [100]);
    assert_eq!(every.part(0, 40), Every { first: 20, last: 40, interval: 10 });
    assert_eq!(every.part(40, 90), Every { first: 1, last: 50, interval: 10 });
    assert!(due(every.part(100, 200), 100).is_empty(), "what is over is over");
    assert!(due(Every::NEVER, 200).is_empty());
}
