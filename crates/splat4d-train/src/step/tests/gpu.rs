//! Training with a GPU that renders, against the CPU alone; on any driver, that of a CPU too. Without one each test
//! prints "skipped"; with REQUIRE_GPU=1 that is a failure.

use super::bed::{Bed, bytes, saved, settings};
use crate::recipe::Recipe;
use crate::step::trainer::Trainer;
use splat4d::device::Device;

/// A short recipe of every motion model, and how far its last steps may be off: roundings grow, and where Gaussians are
/// born and die they decide who.
const MODELS: [(&str, f64); 10] = [
    ("motion=still strategy=none sh_degree=2 sh_degree_interval=7", 0.02),
    ("motion=spacetime strategy=none motion_order=2 rotation_rate=true life=interval lambda_velocity=0.1", 0.02),
    ("motion=spacetime strategy=adc exposure=true antialias=true", 0.15),
    ("motion=native4d sh_harmonics=1 strategy=mcmc", 0.15),
    ("motion=tracked rigid_neighbours=5", 0.02),
    ("motion=control strategy=none control_nodes=10", 0.02),
    ("motion=ssm strategy=none control_nodes=10 ssm_width=8 ssm_states=4 ssm_warm_up=0.1", 0.02),
    ("motion=hexplane strategy=none coarse_iterations=10 plane_channels=16 plane_resolution=6 net_width=16", 0.02),
    ("motion=deform-mlp strategy=none deform_width=16", 0.02),
    ("motion=spacetime strategy=none filter=geodesic", 0.02),
];
/// Steps in which curves are the same but for roundings, and their largest relative difference: Adam's first steps are
/// whole ones even where a gradient is nothing but roundings.
const FIRST: (usize, f64) = (5, 2e-3);
/// Steps at the end whose mean is compared.
const LAST: usize = 8;

pub(super) fn on_gpu(bed: &Bed, recipe: &Recipe) -> Option<Trainer<'static>> {
    let trainer = bed.start_on(Device::Gpu, recipe);
    if trainer.device.missed {
        assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set: {}", trainer.device.why);
        println!("skipped: {}", trainer.device.why);
        return None;
    }
    assert!(trainer.device.why.starts_with("training on ") && trainer.device.name != "the CPU");
    Some(trainer)
}

/// Whether a line states only that not all of a step is the device's.
fn is_of_tables(notice: &str) -> bool {
    notice.contains("the CPU keeps the tables")
}

/// Mean squared errors of all steps that are left, and what was reported.
pub(super) fn finish(trainer: &mut Trainer<'_>, what: &str) -> (Vec<f64>, Vec<String>) {
    let (mut mse, mut notices) = (Vec::new(), Vec::new());
    while !trainer.is_done() {
        let step = trainer.step().unwrap().unwrap_or_else(|fault| panic!("{what}: {}", fault.0));
        mse.extend(step.measured.iter().map(|m| m.mse));
        notices.extend(step.notices);
    }
    (mse, notices)
}

/// Steps until this many are done.
pub(super) fn steps_to(trainer: &mut Trainer<'_>, iteration: usize) {
    while trainer.progress.iteration < iteration {
        trainer.step().unwrap().unwrap_or_else(|fault| panic!("step {iteration}: {}", fault.0));
    }
}

#[test]
fn every_model_learns_as_on_the_cpu() {
    let bed = Bed::new();
    let mut troubles = Vec::new();
    for (line, most) in MODELS {
        let recipe = settings(line);
        let Some(mut trainer) = on_gpu(&bed, &recipe) else { return };
        let mut cpu = bed.start(&recipe);
        let ((mse, notices), (expected, _)) = (finish(&mut trainer, line), finish(&mut cpu, line));
        // These stay on the device whole; of the others neighbours, networks and the filter need something else.
        let whole = ["motion=still", "motion=native4d", "motion=tracked"];
        let stays = whole.iter().any(|m| line.starts_with(m)) || line.contains("strategy=adc");
        assert!(notices.len() == usize::from(!stays) && notices.iter().all(|n| is_of_tables(n)), "{line}: {notices:?}");
        let off = |a: f64, b: f64| (a / b - 1.0).abs();
        let first = mse.iter().zip(&expected).take(FIRST.0).map(|(a, b)| off(*a, *b)).fold(0.0, f64::max);
        let mean = |v: &[f64]| v[v.len() - LAST..].iter().sum::<f64>();
        let last = off(mean(&mse), mean(&expected));
        let (rows, others) = (trainer.scene().len(), cpu.scene().len());
        let said =
            format!("{line}: {first:.1e} in the first steps, {last:.1e} in the last, {rows} and {others} Gaussians");
        println!("{said}");
        if first > FIRST.1 || last > most || off(rows as f64, others as f64) > most {
            troubles.push(said);
        }
    }
    assert!(troubles.is_empty(), "these are not as on the CPU:\n{}", troubles.join("\n"));
}

#[test]
fn a_run_on_a_gpu_repeats_and_resumes_bit_for_bit() {
    let bed = Bed::new();
    let recipe = settings("motion=spacetime strategy=mcmc refine.poses=true batch_size=2");
    let Some(mut trainer) = on_gpu(&bed, &recipe) else { return };
    let mut checkpoints = Vec::new();
    while !trainer.is_done() {
        trainer.step().unwrap().unwrap();
        if [7, 18].contains(&trainer.progress.iteration) {
            checkpoints.push(saved(&trainer));
        }
    }
    let [first, second] = &checkpoints[..] else { panic!("two checkpoints") };
    let mut resumed = bed.resumed_on(Device::Gpu, &recipe, first);
    steps_to(&mut resumed, 18);
    assert!(saved(&resumed) == *second, "a resumed run is where the other one was");
    let mut resumed = bed.resumed_on(Device::Gpu, &recipe, second);
    finish(&mut resumed, "resumed");
    assert!(
        bytes(resumed.scene()) == bytes(trainer.scene()),
        "a resumed run has the bytes of one that was not stopped"
    );
    // The CPU continues too, with other last bits.
    let mut elsewhere = bed.resumed(&recipe, first);
    finish(&mut elsewhere, "elsewhere");
    assert!(elsewhere.scene().len().abs_diff(trainer.scene().len()) < 10);
}

#[test]
fn unsupported_channels_render_on_the_cpu_and_are_reported_once() {
    let bed = Bed::new();
    let recipe = settings("motion=spacetime features=full iterations=6");
    let Some(mut trainer) = on_gpu(&bed, &recipe) else { return };
    let mut cpu = bed.start(&recipe);
    let (mse, notices) = finish(&mut trainer, "a pixel head");
    let of_head: Vec<_> = notices.iter().filter(|n| !is_of_tables(n)).collect();
    assert!(of_head.len() == 1 && of_head[0].contains("pixel head"), "{notices:?}");
    assert!(mse == finish(&mut cpu, "a pixel head").0 && bytes(trainer.scene()) == bytes(cpu.scene()));
}

#[test]
fn further_loss_terms_run_on_the_cpu_and_are_reported_once() {
    let bed = Bed::new();
    let recipe = settings("motion=spacetime strategy=none loss.tv=0.1 iterations=8");
    let Some(mut trainer) = on_gpu(&bed, &recipe) else { return };
    let mut cpu = bed.start(&recipe);
    let (mse, notices) = finish(&mut trainer, "total variation");
    assert!(notices.len() == 1 && notices[0].contains("the CPU compares images"), "{notices:?}");
    let expected = finish(&mut cpu, "total variation").0;
    assert!((mse[0] / expected[0] - 1.0).abs() < FIRST.1, "{mse:?} {expected:?}");
}
