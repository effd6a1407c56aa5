//! The stages of `hexplane`: what learns in which, and that they are one run.

use super::*;
use crate::maintenance::Strategy;
use crate::methods::hexplane::HexplaneMethod;
use crate::recipe::MotionName;
use crate::recipe::Recipe;
use splat4d::nn::hexplane::PlaneShape;
use std::ops::Range;

fn plan() -> (HexplaneMethod, TrainContext) {
    let recipe = Recipe::default().with(|r| {
        r.run.motion = MotionName::of("hexplane");
        r.run.iterations = 150;
        r.hexplane.coarse_iterations = 40;
        r.hexplane.unlock_interval = 50;
        r.hexplane.plane_channels = 16;
        r.hexplane.plane_resolution = 6;
        r.hexplane.time_resolution = 3;
        r.hexplane.net_width = 16;
        r.densify.strategy = Strategy::None;
        r.run.half_size_until = 0.0;
        r.rates.position_init = 5e-3;
    });
    let plan = TrainContext { extent: 4.0, clip: [0.0, 0.2], fps: 10.0, times: 3, fixed_cameras: 4, ..recipe.plan() };
    (HexplaneMethod { hexplane: recipe.hexplane }, plan)
}

fn start((program, plan): &(HexplaneMethod, TrainContext)) -> Trainer<'static> {
    let mut p = cloud::<f32>(60, LifeKind::Infinite, 3);
    let motion = build_as(&program.spec(plan), &mut p).unwrap();
    trainer(one_layer(p, motion, LifeKind::Infinite), program.stages(plan), 60)
}

/// Numbers of the planes of some levels, or of the networks.
fn numbers(t: &Trainer<'_>, levels: Range<usize>, networks: bool) -> Vec<f32> {
    let p = &t.scene().layers[0].params;
    let planes: Vec<String> = levels.flat_map(|l| (0..6).map(move |k| PlaneShape::name(l, k))).collect();
    let wanted = |name: &str| {
        let plane = name.as_bytes().get(9).is_some_and(u8::is_ascii_digit);
        if networks { name.starts_with("hexplane.") && !plane } else { planes.iter().any(|n| n == name) }
    };
    p.keys().filter(|&k| wanted(&p.info(k).name)).flat_map(|k| p[k].data().to_vec()).collect()
}

fn spec(t: &Trainer<'_>) -> splat4d::motion::hexplane::HexplaneSpec {
    match t.scene().layers[0].motion.spec() {
        Spec::Hexplane(spec) => spec,
        other => panic!("a hexplane layer became {}", other.name()),
    }
}

#[test]
fn each_stage_learns_its_part_and_together_they_follow_the_ball() {
    let plan = plan();
    let mut t = start(&plan);
    assert_eq!(t.iterations(), 150);
    let (planes, networks) = (numbers(&t, 0..2, false), numbers(&t, 0..0, true));
    assert!(planes.len() > 10_000 && networks.len() > 1000);
    let coarse = finish_stage(&mut t);
    assert_eq!(coarse.len(), 40);
    assert_falls(&coarse, 0.8, "the coarse stage");
    assert!(spec(&t).coarse);
    assert_eq!((numbers(&t, 0..2, false), numbers(&t, 0..0, true)), (planes.clone(), networks.clone()));
    let (high, at_rest) = (numbers(&t, 1..2, false), coarse[30..].iter().sum::<f64>() / 10.0);
    finish_stage(&mut t);
    let s = spec(&t);
    assert!(!s.coarse && s.unlocked == Some(1));
    let p = &t.scene().layers[0].params;
    let inside = |row: usize| {
        let x = p[GEOMETRY].read::<3>(row, 0).map(f64::from);
        (0..3).all(|k| s.low[k] <= x[k] && x[k] <= s.high[k])
    };
    assert!((0..60).filter(|&row| inside(row)).count() > 55, "the box is the cloud's: {s:?}");
    assert_ne!(numbers(&t, 0..1, false), planes[..planes.len() - high.len()]);
    assert_ne!(numbers(&t, 0..0, true), networks);
    assert_eq!(numbers(&t, 1..2, false), high, "a locked level rests, regularisers or not");
    let last = finish_stage(&mut t);
    assert_eq!((spec(&t).unlocked, spec(&t).low), (None, s.low), "the box stays");
    assert_ne!(numbers(&t, 1..2, false), high);
    let moving = last[last.len() - 10..].iter().sum::<f64>() / 10.0;
    assert!(moving < 0.8 * at_rest, "at rest {at_rest}, moving {moving}");
}

#[test]
fn rates_and_densification_continue_over_the_stages() {
    let (mut program, mut plan) = plan();
    plan.common.densify.strategy = Strategy::Adc;
    (plan.common.densify.from, plan.common.densify.until) = (20, 100);
    let stages = program.stages(&plan);
    assert_eq!(stages.iter().map(|s| s.iterations).collect::<Vec<_>>(), [40, 50, 60]);
    let rate = |stage: usize, column: &str| stages[stage].groups.iter().find(|g| g.column == column).map(|g| g.rate);
    for (a, b) in [(0, 1), (1, 2)] {
        let (end, start) = (rate(a, "means").unwrap().end, rate(b, "means").unwrap().start);
        assert!((end - start).abs() < 1e-12, "positions jump from {end} to {start}");
    }
    assert!(rate(0, "hexplane.0.xy").is_none() && rate(0, "hexplane.trunk.0.weight").is_none());
    let ends = |column: &str, rate_: f64| (rate(2, column).unwrap().end / rate_ - 1.0).abs() < 1e-9;
    assert!(ends("hexplane.1.zt", program.hexplane.grid_lr_final));
    assert!(ends("hexplane.position.1.bias", program.hexplane.deformation_lr_final));
    let mut stages = stages;
    let steps = stages.iter_mut().map(|s| s.maintenance.iter_mut().find_map(|u| u.densification().copied()).unwrap());
    assert_eq!(steps.map(|e| (e.first, e.last)).collect::<Vec<_>>(), [(20, 40), (1, 50), (1, 10)]);
    program.hexplane.unlock_interval = 0;
    assert_eq!(program.stages(&plan).iter().map(|s| s.iterations).collect::<Vec<_>>(), [40, 110]);
}
