//! The filter in training: gradients through the whole chain, the switch in the middle of a stage, hooks that see the
//! model inside, and a scene without a trace of it at the end.

use super::*;
use crate::loss::transport::{Metric, Transport, TransportConfig};
use crate::recipe::MotionName;
use crate::upkeep::{At, Once};
use splat4d::format::scene;
use splat4d::motion::filtered::{Filtered, FilteredSpec, Fusion, GAINS, Predictor};

fn inner() -> Spec {
    Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, ..SpacetimeSpec::default() })
}

fn filtered_scene<F: Real>(change: impl Fn(&mut FilteredSpec)) -> Scene<F> {
    let mut spec = FilteredSpec { fusion: Fusion::Geodesic, ..FilteredSpec::around(inner(), 0.05, -0.3) };
    change(&mut spec);
    let mut p = cloud::<F>(8, LifeKind::GaussHalf, 9);
    let motion = build_as(&Spec::Filtered(spec), &mut p).unwrap();
    for key in p.keys().skip(3).collect::<Vec<_>>() {
        shake(&mut p, key, 0.2, 1);
    }
    one_layer(p, motion, LifeKind::GaussHalf)
}

fn transport() -> TransportConfig {
    TransportConfig {
        metric: Metric::Wasserstein,
        predictor: Predictor::Wasserstein,
        temporal: 0.5,
        second: 2.0,
        align: 0.0,
        covariance: 10.0,
        extent: 1.0,
        clip: [0.0, 0.3],
        frame: 0.05,
        every: 1.0,
        start: 0.0,
        ramp: 0.0,
    }
}

#[test]
fn the_whole_chain_has_the_gradient_of_differences() {
    let shots = shots(&[(0, 0.03), (1, 0.12), (2, 0.12)]);
    let reached = check_gradients(&filtered_scene::<f64>(|s| s.stop_gradient = false), &shots, &Vec::new());
    assert_reached(&reached[0], &["geometry", "sh", "life", "velocities", "rotation_rates", GAINS]);
    let probes: Probes = vec![Box::new(Transport::new(transport(), 0))];
    let plain = {
        let mut p = cloud::<f64>(8, LifeKind::Infinite, 9);
        let motion = build_as(&inner(), &mut p).unwrap();
        let key = p.find("velocities").unwrap();
        shake(&mut p, key, 0.3, 2);
        one_layer(p, motion, LifeKind::Infinite)
    };
    let reached = check_gradients(&plain, &shots, &probes);
    assert_reached(&reached[0], &["geometry", "velocities"]);
}

fn stage(steps: usize) -> Stage {
    let mut stage = Stage {
        groups: groups(&[&ORDINARY[..], &[("velocities", 0.05), (GAINS, 0.05)]].concat()),
        ..Stage::new("filtered", steps)
    };
    stage.probes.push(Box::new(Transport::new(transport(), 0)));
    stage
}

#[test]
fn it_is_switched_on_in_the_middle_of_a_stage_and_trains() {
    let scene = filtered_scene::<f32>(|s| s.fusion = Fusion::Off);
    let mut stage = stage(30);
    let on = |scene: &mut Scene<f32>| {
        let layer = &mut scene.layers[0];
        let filter = Filtered::of(layer.motion.as_ref()).expect("it is one");
        let spec = FilteredSpec { fusion: Fusion::Geodesic, ..filter.settings().clone() };
        layer.motion = Arc::new(Filtered::around(filter.inner().clone(), spec, &mut layer.params)?);
        Ok(())
    };
    stage.keep(Once { at: 10, change: on });
    let mut t = trainer(scene, vec![stage], 200);
    let gains = t.scene().layers[0].params.find(GAINS).unwrap();
    let start = t.scene().layers[0].params[gains].clone();
    let mut losses = Vec::new();
    for step in 0..30 {
        losses.push(t.step().unwrap().expect("no fault").report.loss);
        assert_eq!(t.scene().layers[0].params[gains] == start, step < 10, "gains learn from step 10 on, not at {step}");
    }
    assert_falls(&losses, 0.8, "filtered");
}

pub(super) fn made_plan(recipe: Recipe) -> Plan {
    Plan { recipe, extent: 1.0, clip: [0.0, 0.3], fps: 20.0, times: 7, fixed_cameras: 3, ..Plan::default() }
}

#[test]
fn a_recipe_wraps_any_program_and_leaves_no_trace() {
    let recipe = |text: &str| {
        let mut r = Recipe::default().with(|r| {
            r.run.iterations = 40;
            r.run.motion = MotionName::of("spacetime");
        });
        text.split_whitespace().for_each(|s| r.set(s).unwrap());
        r.resolve()
    };
    let plan = made_plan;
    let off = plan(recipe(""));
    assert_eq!(program_of(&off.recipe).unwrap().spec(&off), program("spacetime").unwrap().spec(&off));
    for keep in [false, true] {
        let plan = plan(recipe(&format!("filter=geodesic transport=wasserstein filter_keep={keep} filter_start=0.5")));
        let program = program_of(&plan.recipe).unwrap();
        let Spec::Filtered(spec) = program.spec(&plan) else { panic!("it is wrapped") };
        assert_eq!((spec.fusion, spec.frame, spec.inner.name()), (Fusion::Off, 0.05, "spacetime"));
        let mut stages = program.stages(&plan);
        assert!(stages[0].groups.iter().any(|g| g.column == "velocities") && stages[0].probes.len() == 1);
        stages[0].upkeep.retain(|u| u.once());
        let due = |step: &usize| stages[0].upkeep.iter().any(|u| u.due(&At { step: *step, steps: 40 }));
        assert_eq!((0..40).filter(due).collect::<Vec<_>>(), [20]);
        let mut p = cloud::<f32>(40, LifeKind::GaussHalf, 4);
        let motion = build_as(&Spec::Filtered(spec), &mut p).unwrap();
        let mut t = trainer(one_layer(p, motion, LifeKind::GaussHalf), stages, 200);
        for step in 0..40 {
            t.step().unwrap().expect("no fault");
            let on = Filtered::of(t.scene().layers[0].motion.as_ref()).map(|f| f.settings().fusion);
            // What is done before step 20 is done at the end of the step before.
            let expected = match step {
                0..19 => Some(Fusion::Off),
                39 if !keep => None,
                _ => Some(Fusion::Geodesic),
            };
            assert_eq!(on, expected, "after step {step}");
        }
        let layer = &t.scene().layers[0];
        assert_eq!(layer.params.find(GAINS).is_some(), keep);
        let mut bytes = Vec::new();
        scene::write(t.scene(), &mut bytes).unwrap();
        let back = scene::read(&bytes).expect("no array is left over");
        assert_eq!(back.layers[0].motion.spec(), layer.motion.spec());
        assert_eq!(back.layers[0].params[GEOMETRY], layer.params[GEOMETRY]);
        let moved = layer.params.find("velocities").unwrap();
        assert!(layer.params[moved].data().iter().any(|x| *x != 0.0), "what was learnt stays");
    }
    let plan = plan(recipe("filter=geodesic filter_start=0.25 filter.until=0.75"));
    let mut early = program_of(&plan.recipe).unwrap().stages(&plan);
    early[0].upkeep.retain(|u| u.once());
    let due = |step: &usize| early[0].upkeep.iter().any(|u| u.due(&At { step: *step, steps: 40 }));
    assert_eq!((0..40).filter(due).collect::<Vec<_>>(), [10, 30]);
    for bad in ["filter.until=0.1", "filter.until=0.5 filter_keep=true"] {
        let plan = made_plan(recipe(&format!("filter=geodesic {bad}")));
        let refused = program_of(&plan.recipe).unwrap().check(&plan).expect_err(bad).to_string();
        assert!(refused.contains("filter.until"), "{refused}");
    }
    let none = program("filtered").err().expect("it wraps, and moves nothing itself").to_string();
    assert!(none.contains("filter=geodesic"), "{none}");
    for bad in ["filter=kalman", "filter_gain=1", "filter_baseline=0", "filter_history=1000", "transport_every=2"] {
        assert!(Recipe::default().set(bad).is_err(), "{bad}");
    }
}

#[test]
fn hooks_of_the_program_inside_see_its_own_model() {
    struct Hooked;
    impl Program for Hooked {
        fn spec(&self, _: &Plan) -> Spec {
            inner()
        }
        fn stages(&self, plan: &Plan) -> Vec<Stage> {
            let hook = || -> Option<Hook> {
                Some(Box::new(|scene, _| {
                    assert_eq!(scene.layers[0].motion.spec(), inner(), "the filter is taken off");
                    Ok(())
                }))
            };
            let one = || Stage { start: hook(), end: hook(), ..stage(plan.recipe.run.iterations) };
            vec![one(), one()]
        }
    }
    let r = Recipe::default().with(|r| {
        r.run.iterations = 6;
        r.filter.fusion = Fusion::Geodesic;
        r.filter.start = 0.5;
    });
    let plan = made_plan(r.resolve());
    let program = super::super::filtered::wrap(Box::new(Hooked), &plan.recipe);
    let mut p = cloud::<f32>(20, LifeKind::Infinite, 4);
    let motion = build_as(&program.spec(&plan), &mut p).unwrap();
    let mut t = trainer(one_layer(p, motion, LifeKind::Infinite), program.stages(&plan), 200);
    let mut on = Vec::new();
    while !t.is_done() {
        t.step().unwrap().expect("no fault");
        on.push(Filtered::of(t.scene().layers[0].motion.as_ref()).is_some_and(|f| f.settings().fusion != Fusion::Off));
    }
    // Half of two stages of six: switched on at the second's start, after its hook; off at the very end.
    assert_eq!(on, [vec![false; 6], vec![true; 5], vec![false]].concat());
}
