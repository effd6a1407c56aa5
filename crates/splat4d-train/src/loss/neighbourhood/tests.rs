use super::*;
use splat4d::layers::Layer;
use splat4d::motion::{SpacetimeSpec, Spec, build_as};
use splat4d::scene::splats::SPLAT_COLUMNS;
use splat4d::scene::{LifeKind, Params};

const N: usize = 3000;

const CLIP: [f64; 2] = [0.0, 1.0];

fn made(weights: LossSettings, clip: [f64; 2]) -> Neighbourhood<f64> {
    Neighbourhood::new(weights, 2.0, clip, 10.0)
}

fn scene(life: LifeKind) -> Scene<f64> {
    let mut params = Params::new(N, 1, life.columns());
    let motion = build_as(&Spec::Spacetime(SpacetimeSpec::default()), &mut params).unwrap();
    let rng = Rng::new(4, "neighbourhood", 0);
    for key in params.keys().collect::<Vec<_>>() {
        for r in 0..N {
            for c in 0..params[key].width() {
                params[key].set(r, c, 0.5 * rng.fork(u64::from(key.0)).normal((r * 50 + c) as u64));
            }
        }
    }
    let layer = Layer::new("a", params, motion, life);
    Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 10.0, ..Scene::default() }
}

fn info(iteration: usize) -> StepInfo {
    StepInfo { iteration, times: vec![Time(0.4)], seed: 3, progress: 0.0 }
}

fn all() -> LossSettings {
    LossSettings {
        rigid: 0.3,
        rot: 0.2,
        iso: 0.5,
        arap: 0.7,
        elastic: 0.1,
        velocity: 0.01,
        jerk: 0.4,
        acceleration: 0.2,
        least_motion: 0.3,
        ..LossSettings::default()
    }
}

/// Arbitrary results of a model.
fn answers(probes: &[Probe]) -> Vec<Vec<Table<f64>>> {
    let rng = Rng::new(5, "answers", 0);
    let table = |p: &Probe, t: usize| {
        let rows = p.rows.as_ref().unwrap().len();
        let mut out = Table::new(&SPLAT_COLUMNS, rows);
        for r in 0..rows {
            let own = rng.fork(r as u64);
            let noise = own.fork(t as u64);
            for c in 0..10 {
                out.set(r, c, own.normal(c as u64) + 0.1 * noise.normal(c as u64));
            }
            // Covariances must have a positive trace.
            [3, 6, 8].iter().for_each(|&c| out.set(r, c, 1.0 + out.get(r, c).abs()));
        }
        out
    };
    probes.iter().map(|p| (0..p.times.len()).map(|t| table(p, t)).collect()).collect()
}

fn eval(
    loss: &Neighbourhood<f64>,
    scene: &Scene<f64>,
    seen: &[Vec<Table<f64>>],
    probes: &[Probe],
) -> (f64, Vec<Vec<Table<f64>>>) {
    let mut d: Vec<Vec<Table<f64>>> = seen.iter().map(|t| t.iter().map(Table::zeros_like).collect()).collect();
    let value = loss.eval(scene, probes, seen, &mut d);
    (value, d)
}

#[test]
fn inputs_without_held_parts_have_the_gradient_of_their_value() {
    let scene = scene(LifeKind::Infinite);
    for weights in [
        LossSettings { iso: 0.5, ..LossSettings::default() },
        LossSettings { arap: 0.7, jerk: 0.4, ..LossSettings::default() },
        LossSettings { velocity: 0.02, ..LossSettings::default() },
    ] {
        let loss = made(weights.clone(), CLIP);
        let probes = ProbeLoss::probes(&loss, &scene, &info(0));
        let seen = answers(&probes);
        let (value, d) = eval(&loss, &scene, &seen, &probes);
        assert!(value > 0.0, "{weights:?}");
        let mut felt = 0;
        for t in 0..probes[0].times.len() {
            for (row, col) in [(0, 0), (7, 1), (150, 2), (801, 0)] {
                let at = |h: f64| {
                    let mut seen = seen.clone();
                    *seen[0][t].get_mut(row, col) += h;
                    eval(&loss, &scene, &seen, &probes).0
                };
                let fd = (at(1e-5) - at(-1e-5)) / 2e-5;
                let got = d[0][t].get(row, col);
                felt += usize::from(got != 0.0);
                assert!((fd - got).abs() < 1e-9 + 1e-5 * fd.abs(), "{weights:?} {t} {row} {col}: {fd} {got}");
            }
        }
        assert!(felt >= 8, "{weights:?}");
    }
}

#[test]
fn a_step_samples_few_other_and_only_active_rows() {
    let scene = scene(LifeKind::GaussHalf);
    let loss = made(all(), CLIP);
    let rows = |iteration: usize| {
        let probes = ProbeLoss::probes(&loss, &scene, &info(iteration));
        assert_eq!((probes.len(), probes[0].times.len()), (1, 5));
        probes[0].rows.clone().unwrap()
    };
    let (a, b) = (rows(0), rows(1));
    assert!(a.len() <= CENTRES * (NEIGHBOURS + 1) && a != b && a == rows(0));
    assert!(a.is_sorted_by(|x, y| x < y));
    let mut alive = Vec::new();
    assert!(!scene.layers[0].active(Time(0.4), &mut alive) && alive.len() < N);
    assert!(a.iter().all(|r| alive.binary_search(r).is_ok()));
}

#[test]
fn neighbours_survive_a_checkpoint_and_are_forgotten_after_an_edit() {
    let mut scene = scene(LifeKind::Infinite);
    let loss = made(all(), CLIP);
    let look = |loss: &Neighbourhood<f64>, scene: &Scene<f64>| {
        let probes = ProbeLoss::probes(loss, scene, &info(7));
        let seen = answers(&probes);
        let (value, d) = eval(loss, scene, &seen, &probes);
        (value, d, probes[0].rows.clone())
    };
    look(&loss, &scene);
    let state = ProbeLoss::<f64>::state(&loss);
    // Gaussians drift; the neighbours are those of the search until the next.
    for r in 0..N {
        let x = scene.layers[0].params[GEOMETRY].get(r, 0);
        scene.layers[0].params[GEOMETRY].set(r, 0, -0.3 * x * x);
    }
    let truth = look(&loss, &scene);
    let other = made(all(), CLIP);
    ProbeLoss::<f64>::restore(&other, &state);
    assert!(look(&other, &scene) == truth);
    ProbeLoss::<f64>::on_edit(&loss);
    assert!(look(&loss, &scene) != truth);
    assert!(look(&made(all(), CLIP), &scene) != truth);
    // A state that cannot be is as none.
    for bad in [vec![0, 5, 1], vec![0, 8, 1, 2, 3, 4, 5, 6, 7, 8]] {
        ProbeLoss::<f64>::restore(&other, &bad);
        assert!(look(&other, &scene).0.is_finite());
    }
}

#[test]
fn still_layers_short_clips_and_lonely_gaussians_are_left_alone() {
    let loss = made(all(), [0.0; 2]);
    assert!(ProbeLoss::probes(&loss, &scene(LifeKind::Infinite), &info(0)).is_empty());
    let loss = made(all(), CLIP);
    let mut still = scene(LifeKind::Infinite);
    still.layers[0].motion = build_as(&Spec::Still, &mut still.layers[0].params).unwrap();
    assert!(ProbeLoss::probes(&loss, &still, &info(0)).is_empty());
    let mut few = scene(LifeKind::Infinite);
    few.layers[0].params.apply(&splat4d::scene::RowEdit::prune(Space::Gaussians, (0..N).map(|r| r < 5)));
    assert!(ProbeLoss::probes(&loss, &few, &info(0)).is_empty());
}
