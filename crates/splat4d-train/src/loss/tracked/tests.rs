use super::*;
use splat4d::math::{Rng, quat};
use splat4d::motion::tracked::{Tracked, TrackedSpec};
use splat4d::scene::{LifeKind, Params, Rows, Time};

/// Half the step of the central differences, and the largest difference to them.
const H: f64 = 1e-6;
const TOLERANCE: f64 = 2e-7;

fn ties(weights: Weights) -> Ties {
    Ties { neighbours: 5, weigh: Weigh::Median(1.0), weights, floor: -0.2, unit: 2.0 }
}

const ALL: Weights = Weights { rigid: 4.0, rot: 4.0, iso: 2.0, bg: 20.0, soft_col: 0.5, floor: 2.0 };

/// Three frames of random poses; the last third of the Gaussians is background.
fn scene(rows: usize) -> Scene<f64> {
    let mut p = Params::new(rows, 1, &[]);
    let spec = TrackedSpec { times: vec![0.0, 0.1, 0.2], foreground: true };
    let rng = Rng::new(6, "tied", 0);
    for r in 0..rows {
        let rng = rng.fork(r as u64);
        p[GEOMETRY].write::<11>(r, 0, std::array::from_fn(|c| 0.5 * rng.normal(c as u64)));
        p[SH].write::<3>(r, 0, std::array::from_fn(|c| rng.normal(20 + c as u64)));
    }
    let model = Tracked::new(&spec, &mut p).unwrap();
    for r in 0..rows {
        for frame in 1..3 {
            let shake: [f64; POSE] = std::array::from_fn(|c| 0.1 * rng.fork(500 + frame).normal((r * 7 + c) as u64));
            p[model.page(frame as usize)].add(r, 0, shake);
        }
        let key = p.find(FOREGROUND).unwrap();
        p[key].set(r, 0, if r < 2 * rows / 3 { 1.0 } else { -1.0 });
    }
    let layer = Layer::new("a", p, Arc::new(model), LifeKind::Infinite);
    Scene { layers: vec![layer], clip: [0.0, 0.2], fps: 10.0, up: [0.0, 0.6, 0.8], ..Scene::default() }
}

fn eval(loss: &Tied<f64>, scene: &Scene<f64>) -> (f64, Grads<f64>) {
    let info = StepInfo { iteration: 0, times: vec![Time(0.2)], seed: 0, progress: 0.0 };
    let mut d = vec![Grads::new(&scene.layers[0].params)];
    d[0].activate(Space::Gaussians, Rows::All);
    let value = loss.eval(scene, &info, &mut d);
    (value, d.pop().unwrap())
}

#[test]
fn gradients_equal_finite_differences_and_reach_the_newest_page_alone() {
    let mut s = scene(30);
    for weights in [
        Weights { rigid: 4.0, ..Weights::default() },
        Weights { bg: 20.0, ..Weights::default() },
        Weights { floor: 2.0, ..Weights::default() },
        ALL,
    ] {
        let tracking = Tracking::new(ties(weights));
        let loss = tracking.frame(2);
        let (value, d) = eval(&loss, &s);
        assert!(value > 0.0);
        let params = &s.layers[0].params;
        let (page, before) = (page_of(params, 2).unwrap(), page_of(params, 1).unwrap());
        assert!(!d.touched(GEOMETRY) && !d.touched(before), "what was tracked before stays");
        // The colours that the frame began with are those of the first evaluation.
        if weights == ALL {
            (0..30).for_each(|r| *s.layers[0].params[SH].get_mut(r, 1) += 0.3);
        }
        let (_, d) = eval(&loss, &s);
        let mut met = 0;
        for (key, width) in [(page, POSE), (SH, 3)] {
            for (row, col) in (0..30).step_by(3).flat_map(|r| (0..width).map(move |c| (r, c))) {
                let mut at = |by: f64| {
                    *s.layers[0].params[key].get_mut(row, col) += by;
                    let value = eval(&loss, &s).0;
                    *s.layers[0].params[key].get_mut(row, col) -= by;
                    value
                };
                let fd = (at(H) - at(-H)) / (2.0 * H);
                // Colours that did not change sit on a kink.
                let got = d.table(key).get(row, col);
                if key == SH && col != 1 {
                    continue;
                }
                met += usize::from(fd.abs() > 1e-6);
                assert!((fd - got).abs() < TOLERANCE, "{weights:?} {row},{col}: {fd} {got}");
            }
        }
        // The floor holds one coordinate of those that are below it.
        assert!(met >= 1, "{weights:?} has no gradient");
    }
}

#[test]
fn rigid_motion_has_no_loss_in_any_unit() {
    let mut s = scene(30);
    let weights = Weights { bg: 0.0, floor: 0.0, soft_col: 0.0, ..ALL };
    let turn = quat::normalize([0.9, 0.3, -0.2, 0.1]).0;
    let r = quat::to_rotation(turn);
    let (first, page) = (page_of(&s.layers[0].params, 1).unwrap(), page_of(&s.layers[0].params, 2).unwrap());
    for row in 0..30 {
        let pose = s.layers[0].params[GEOMETRY].read::<POSE>(row, 0);
        s.layers[0].params[first].write(row, 0, pose);
        let (q, x) = ([pose[3], pose[4], pose[5], pose[6]], [pose[0], pose[1], pose[2]]);
        let turned = quat::product(turn, q);
        let moved: [f64; 3] = std::array::from_fn(|i| (0..3).map(|k| r[i][k] * x[k]).sum::<f64>() + 0.4);
        s.layers[0].params[page].write(row, 0, moved);
        // Any scale, either sign.
        s.layers[0].params[page].write(row, QUAT, turned.map(|x| -1.7 * x));
    }
    assert!(eval(&Tracking::new(ties(weights)).frame(2), &s).0 < 1e-8);
    // A stretch is seen; in units a hundred times as small it is the same loss.
    (0..30).for_each(|row| *s.layers[0].params[page].get_mut(row, 0) *= 1.1);
    let value = eval(&Tracking::new(ties(weights)).frame(2), &s).0;
    for key in [GEOMETRY, first, page] {
        (0..30).for_each(|row| (0..3).for_each(|c| *s.layers[0].params[key].get_mut(row, c) *= 100.0));
    }
    let scaled = Ties { unit: 200.0, ..ties(weights) };
    let other = eval(&Tracking::new(scaled).frame(2), &s).0;
    assert!(value > 1e-3 && (value - other).abs() < 1e-6 * value, "{value} {other}");
}

#[test]
fn a_checkpoint_holds_the_colours_that_the_frame_began_with() {
    let mut s = scene(30);
    let (a, b) = (Tracking::new(ties(ALL)), Tracking::new(ties(ALL)));
    let round = |s: &mut Scene<f64>, by: f32| {
        (0..30).for_each(|r| s.layers[0].params[SH].set(r, 0, f64::from(0.25 + by + r as f32)));
    };
    // What a file holds in f32 is held exactly.
    (0..30).for_each(|r| (1..3).for_each(|c| s.layers[0].params[SH].set(r, c, 0.5)));
    round(&mut s, 0.0);
    eval(&a.frame(2), &s);
    assert!(ParamLoss::<f64>::state(&a.frame(1)).is_empty(), "only the newest frame has a memory");
    let state = ParamLoss::<f64>::state(&a.frame(2));
    assert_eq!(state.len(), 90);
    for frame in 1..4 {
        ParamLoss::<f64>::restore(&b.frame(frame), if frame == 2 { &state } else { &[] });
    }
    round(&mut s, 0.5);
    assert_eq!(eval(&a.frame(2), &s).0, eval(&b.frame(2), &s).0);
    ParamLoss::<f64>::restore(&b.frame(2), &[]);
    assert!(eval(&b.frame(2), &s).0 < eval(&a.frame(2), &s).0, "without a memory the frame begins now");
}

#[test]
fn only_masked_foreground_is_tied_and_the_background_held() {
    let s = scene(30);
    let frame0 = Tracking::new(ties(ALL)).frame0(&s.layers[0]);
    assert_eq!((frame0.foreground.len(), frame0.background.len()), (20, 10));
    let page = page_of(&s.layers[0].params, 2).unwrap();
    let ties_only = Weights { bg: 0.0, soft_col: 0.0, floor: 0.0, ..ALL };
    let (_, d) = eval(&Tracking::new(ties(ties_only)).frame(2), &s);
    assert!((20..30).all(|r| d.table(page).read::<POSE>(r, 0) == [0.0; POSE]));
    let held = Weights { bg: 20.0, ..Weights::default() };
    let (_, d) = eval(&Tracking::new(ties(held)).frame(2), &s);
    assert!((0..20).all(|r| d.table(page).read::<POSE>(r, 0) == [0.0; POSE]));
    assert!((20..30).all(|r| d.table(page).get(r, 0).abs() == 1.0), "20 of 10 rows in units of 2");
}
