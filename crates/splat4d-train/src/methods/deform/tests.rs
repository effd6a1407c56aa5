use super::*;
use crate::recipe::MotionName;
use crate::recipe::Recipe;

fn plan(settings: &[&str]) -> (DeformMethod, TrainContext) {
    let mut recipe = Recipe::default().with(|r| {
        r.run.motion = MotionName::of("deform-mlp");
        r.run.iterations = 1000;
    });
    settings.iter().for_each(|s| recipe.set(s).unwrap());
    let plan = TrainContext { extent: 2.0, clip: [0.0, 1.0], fps: 20.0, times: 21, fixed_cameras: 0, ..recipe.plan() };
    (DeformMethod { deform: recipe.deform }, plan)
}

fn stages(settings: &[&str]) -> Vec<Stage> {
    let (program, plan) = plan(settings);
    program.stages(&plan)
}

#[test]
fn two_stages_make_one_schedule() {
    let (program, plan) = plan(&["deform_warmup=0.1", "half_size_until=0.3"]);
    let [still, mut moving]: [Stage; 2] = program.stages(&plan).try_into().ok().unwrap();
    assert_eq!((still.iterations, moving.iterations), (100, 900));
    let rate = |s: &Stage, column: &str| s.groups.iter().find(|g| g.column == column).map(|g| g.rate);
    let (a, b) = (rate(&still, "means").unwrap(), rate(&moving, "means").unwrap());
    assert!((a.end - b.start).abs() < 1e-12 && a.start > a.end && b.start > b.end);
    assert_eq!(rate(&still, "deform_trunk.0.weight"), None, "the warm-up does not know the network");
    assert_eq!(rate(&moving, "deform_trunk.0.weight").unwrap().start, program.deform.lr_init);
    let mut whole = still::stage("x", &plan);
    let last = |s: &mut Stage| s.maintenance.iter_mut().find_map(|u| u.densification().map(|e| e.last)).unwrap();
    assert_eq!(last(&mut moving) + 100, last(&mut whole));
    assert_eq!((still.half_size_steps, moving.half_size_steps), (300, 200));
    assert_eq!(stages(&["deform_warmup=0"]).len(), 1);
}

#[test]
fn networks_are_blended_in_while_gaussians_keep_training() {
    let moving = stages(&["deform_trunk=hash"]).remove(1);
    let group = |column: &str| moving.groups.iter().find(|g| g.column == column).unwrap();
    let (network, late) = (group("deform_trunk.0.weight"), group("deform_xyz.7"));
    let share = |g: &Group, step: usize| (1e6 * g.rate_at(step, 0.0) / g.rate.start).round() / 1e6;
    assert_eq!([0, 24, 49, 50].map(|s| share(network, s)), [0.02, 0.5, 1.0, 1.0]);
    assert!(late.from > 0 && share(late, late.from) == 0.02, "each group from its own first step");
    assert_eq!(share(group("means"), 0), 1.0);
    let (program, plan) = plan(&["deform_trunk=hash"]);
    let tuning = super::super::tuning(&program, &plan);
    assert!(tuning.groups.iter().all(|g| share(g, 0) == 1.0), "what is there already needs no warm-up");
}

#[test]
fn smoothing_noise_starts_at_its_share_of_a_frame_and_ends() {
    let noise = stages(&["deform_time_noise=0.1", "deform_warmup=0"])[0].time_noise;
    assert!((noise.width(0) - 0.1 / 20.0).abs() < 1e-15);
    assert!((1..1000).all(|s| noise.width(s) <= noise.width(s - 1)));
    assert_eq!((noise.width(500), noise.width(999)), (0.0, 0.0));
    let off = stages(&[])[1].time_noise;
    assert_eq!(off.width(0), 0.0, "captures with exact poses want none");
}

#[test]
fn fine_levels_of_hash_grids_wait() {
    let groups = stages(&["deform_trunk=hash", "deform_warmup=0", "deform_unlock=0.4"]).remove(0).groups;
    let from = |l: usize| groups.iter().find(|g| g.column == format!("deform_xyz.{l}")).unwrap().from;
    let waits: Vec<usize> = (0..SPACE.levels).map(from).collect();
    assert!(waits.is_sorted() && waits[0] == 0 && waits[3] == 0 && waits[4] > 0 && waits[7] == 400, "{waits:?}");
    assert!(
        groups.iter().any(|g| g.column == "deform_yzt.0") && groups.iter().any(|g| g.column == "deform_trunk.2.bias")
    );
}

#[test]
fn the_network_suits_the_cameras() {
    let (program, mut plan) = plan(&[]);
    let mut hashed = |fixed_cameras: usize, masks: bool| {
        (plan.fixed_cameras, plan.masks) = (fixed_cameras, masks);
        matches!(spec(&plan, &program.deform).input, Input::Hashed { .. })
    };
    assert!(!hashed(0, true) && hashed(0, false) && hashed(4, true) && hashed(4, false));
    let small = DeformSettings { trunk: Trunk::Small, ..program.deform };
    assert!(matches!(spec(&plan, &small).input, Input::Encoded { .. }));
}

#[test]
fn impossible_settings_are_refused_before_training() {
    let check = |(program, plan): (DeformMethod, TrainContext)| program.check(&plan);
    let (program, many) = plan(&[]);
    let single = TrainContext { times: 1, ..many };
    assert!(program.check(&single).unwrap_err().to_string().contains("still"));
    let wide = plan(&["deform_width=100000"]);
    assert!(check(wide).unwrap_err().to_string().contains("deform_width"));
    assert!(check(plan(&["deform_trunk=mlp"])).is_ok());
}
