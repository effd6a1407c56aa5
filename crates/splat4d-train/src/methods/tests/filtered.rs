//! The filter in training: gradients through the whole chain, the switch in the middle of a stage, hooks that see the
//! model inside, and a scene without a trace of it at the end.

use super::*;
use crate::loss::transport::{Align, Metric, Transport, TransportConfig};
use crate::maintenance::{At, Once};
use crate::recipe::MotionName;
use splat4d::format::scene;
use splat4d::motion::filtered::{Filtered, FilteredSpec, Fusion, GAINS, Predictor};
use splat4d::scene::Rows;

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

/// The alignment of a filtered scene at its second view, and the gradient.
fn aligned(scene: &Scene<f64>, change: &dyn Fn(&mut TransportConfig)) -> (f64, Grads<f64>) {
    let mut settings = TransportConfig { align: 1.5, ..transport() };
    change(&mut settings);
    let info = StepInfo { iteration: 0, times: vec![Time(0.12)], seed: 0, progress: 0.5 };
    let mut d = vec![Grads::new(&scene.layers[0].params)];
    let value = Align::new(settings, 0).eval(scene, &info, &mut d);
    (value, d.remove(0))
}

#[test]
fn alignment_has_the_gradient_of_differences() {
    let nodes = || {
        let skin = splat4d::motion::skin::SkinSpec { nodes: 4, ..Default::default() };
        Spec::Control(splat4d::motion::control::ControlSpec { skin, clip: [0.0, 0.3], ..Default::default() })
    };
    let cases: [(&str, Spec, Fusion, usize); 4] = [
        ("velocities", inner(), Fusion::Geodesic, 0),
        ("velocities", inner(), Fusion::Literal, 0),
        ("velocities", inner(), Fusion::Geodesic, 2),
        ("node_keys", nodes(), Fusion::Geodesic, 0),
    ];
    for (moving, of, fusion, history) in cases {
        let scene = filtered_scene::<f64>(|s| {
            (s.inner, s.fusion, s.history, s.stop_gradient) = (Box::new(of.clone()), fusion, history, false);
        });
        let (value, d) = aligned(&scene, &|_| {});
        assert!(value > 1e-6, "{moving}: nothing to align, {value}");
        let p = &scene.layers[0].params;
        let mut reached = Vec::new();
        for key in p.keys().collect::<Vec<_>>() {
            for row in 0..p[key].rows().min(5) {
                for column in 0..p[key].width() {
                    let at = |h: f64| {
                        let mut moved = scene.clone();
                        let x = moved.layers[0].params[key].get(row, column);
                        moved.layers[0].params[key].set(row, column, x + h);
                        aligned(&moved, &|_| {}).0
                    };
                    let fd = (at(1e-5) - at(-1e-5)) / 2e-5;
                    let got = if d.touched(key) { d.table(key).get(row, column) } else { 0.0 };
                    let name = &p.info(key).name;
                    assert!((fd - got).abs() < 1e-7 * (1.0 + fd.abs()), "{name}[{row}, {column}]: {got} {fd}");
                    if got != 0.0 {
                        reached.push(name.to_string());
                    }
                }
            }
        }
        for name in ["geometry", moving] {
            assert!(reached.iter().any(|r| r == name), "{name} is not reached: {reached:?}");
        }
        assert_eq!(reached.iter().any(|r| r == GAINS), fusion == Fusion::Geodesic, "{reached:?}");
    }
}

#[test]
fn alignment_is_between_observation_and_state() {
    let scene = filtered_scene::<f64>(|s| (s.gain, s.gate) = (0.5, 0.0));
    let layer = &scene.layers[0];
    let filter = Filtered::of(layer.motion.as_ref()).unwrap();
    let means = |model: &dyn Motion<f64>| {
        let q = splat4d::motion::At { p: &layer.params, of: Space::Gaussians, rows: Rows::All, t: Time(0.12) };
        let (mut cache, mut tape) = (splat4d::motion::Cache::default(), splat4d::motion::Tape::default());
        model.prepare(q.p, &[q], &mut cache);
        model.at(&q, &cache, &mut tape);
        (0..q.len()).map(|r| tape.out.read::<3>(r, 0)).collect::<Vec<_>>()
    };
    let (seen, state) = (means(filter.inner().as_ref()), means(layer.motion.as_ref()));
    let squares = seen.iter().zip(&state).map(|(a, b)| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>());
    let expected = 1.5 * squares.sum::<f64>() / seen.len() as f64;
    let (value, _) = aligned(&scene, &|s| s.metric = Metric::Linear);
    assert!((value - expected).abs() < 1e-12 && value > 0.0, "{value} {expected}");
    // Where nothing is fused there is nothing to align.
    let off = filtered_scene::<f64>(|s| s.fusion = Fusion::Off);
    assert_eq!(aligned(&off, &|_| {}).0, 0.0);
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

pub(super) fn made_plan(recipe: &Recipe) -> TrainContext {
    TrainContext { extent: 1.0, clip: [0.0, 0.3], fps: 20.0, times: 7, fixed_cameras: 3, ..recipe.plan() }
}

#[test]
fn a_filter_wraps_any_program_and_is_removed_exactly() {
    let recipe = |text: &str| {
        let mut r = Recipe::default().with(|r| {
            r.run.iterations = 40;
            r.run.motion = MotionName::of("spacetime");
        });
        text.split_whitespace().for_each(|s| r.set(s).unwrap());
        r
    };
    let off = recipe("");
    let plan = made_plan(&off);
    assert_eq!(off.program().unwrap().spec(&plan), off.program_of("spacetime").unwrap().spec(&plan));
    for keep in [false, true] {
        let recipe = recipe(&format!("filter=geodesic transport=wasserstein filter_keep={keep} filter_start=0.5"));
        let (plan, program) = (made_plan(&recipe), recipe.program().unwrap());
        let Spec::Filtered(spec) = program.spec(&plan) else { panic!("it is wrapped") };
        assert_eq!((spec.fusion, spec.frame, spec.inner.name()), (Fusion::Off, 0.05, "spacetime"));
        let mut stages = program.stages(&plan);
        assert!(stages[0].groups.iter().any(|g| g.column == "velocities") && stages[0].probes.len() == 1);
        stages[0].maintenance.retain(|u| u.once());
        let due = |step: &usize| stages[0].maintenance.iter().any(|u| u.due(&At { step: *step, steps: 40 }));
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
    let early = recipe("filter=geodesic filter_start=0.25 filter.until=0.75");
    let mut early = early.program().unwrap().stages(&made_plan(&early));
    early[0].maintenance.retain(|u| u.once());
    let due = |step: &usize| early[0].maintenance.iter().any(|u| u.due(&At { step: *step, steps: 40 }));
    assert_eq!((0..40).filter(due).collect::<Vec<_>>(), [10, 30]);
    for bad in ["filter.until=0.1", "filter.until=0.5 filter_keep=true"] {
        let recipe = recipe(&format!("filter=geodesic {bad}"));
        let refused = recipe.program().unwrap().check(&made_plan(&recipe)).expect_err(bad).to_string();
        assert!(refused.contains("filter.until"), "{refused}");
    }
    let none = Recipe::default().program_of("filtered").err().expect("it wraps, and moves nothing itself").to_string();
    assert!(none.contains("filter=geodesic"), "{none}");
    for bad in ["filter=kalman", "filter_gain=1", "filter_baseline=0", "filter_history=1000", "transport_every=2"] {
        assert!(Recipe::default().set(bad).is_err(), "{bad}");
    }
}

#[test]
fn hooks_of_the_wrapped_program_get_its_own_model() {
    struct Hooked;
    impl Method for Hooked {
        fn spec(&self, _: &TrainContext) -> Spec {
            inner()
        }
        fn stages(&self, plan: &TrainContext) -> Vec<Stage> {
            let hook = || -> Option<Hook> {
                Some(Box::new(|scene, _| {
                    assert_eq!(scene.layers[0].motion.spec(), inner(), "the filter is taken off");
                    Ok(())
                }))
            };
            let one = || Stage { start: hook(), end: hook(), ..stage(plan.iterations) };
            vec![one(), one()]
        }
    }
    let r = Recipe::default().with(|r| {
        r.run.iterations = 6;
        r.filter.fusion = Fusion::Geodesic;
        r.filter.start = 0.5;
    });
    let plan = made_plan(&r);
    let program = super::super::filtered::wrap(Box::new(Hooked), &r.filter, &r.transport);
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
