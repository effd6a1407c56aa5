use super::*;

fn camera(k: usize) -> Camera {
    let a = k as f64;
    Camera::with_fov_y(Se3::look_at([4.0 * a.cos(), 0.3 * a, 4.0 * a.sin()], [0.0; 3], [0.0, 1.0, 0.0]), 0.7, 16, 16)
}

fn corrections(settings: &RefineSettings, cameras: &[Camera], gauge: bool) -> Corrections {
    let frames: Vec<Origin<'_>> = cameras
        .iter()
        .enumerate()
        .map(|(rig, camera)| Origin { rig, fixed: true, camera, lens: Lens::Pinhole })
        .collect();
    Corrections::new(settings, Scale { extent: 4.0, frame: 0.1 }, &frames, cameras.len(), gauge)
}

fn step(c: &mut Corrections, frames: &[usize], d_cameras: &[[f64; 6]], d: &[f64], progress: f64) {
    c.step(frames, &StepGrads { d_cameras, d_focals: d, d_lenses: &[], d_times: d }, progress, 1.0);
}

fn on() -> RefineSettings {
    RefineSettings { poses: true, focal: true, lens: true, times: true, ..RefineSettings::default() }
}

const TWIST: [f64; 6] = [0.3, -0.2, 0.5, 0.4, -0.6, 0.2];

#[test]
fn twists_move_rigidly_and_have_the_gradient_of_perturbations() {
    let motion = exp(TWIST);
    assert!(motion.orthogonality_error() < 1e-14 && (motion.det() - 1.0).abs() < 1e-14);
    let back = exp(TWIST.map(|x| -x)).after(&motion);
    assert!(norm(back.translation) < 1e-14);
    // A synthetic loss of a pose: d is its gradient to a perturbation from the left, by differences.
    let (x, g) = ([0.3, 1.2, -0.7], [0.5, -1.0, 0.8]);
    let loss = |pose: &Se3| dot(pose.apply(x), g);
    const H: f64 = 1e-6;
    let slope = |f: &dyn Fn([f64; 6]) -> f64| -> [f64; 6] {
        std::array::from_fn(|k| {
            let at = |h: f64| f(std::array::from_fn(|j| if j == k { h } else { 0.0 }));
            (at(H) - at(-H)) / (2.0 * H)
        })
    };
    let d = slope(&|xi| loss(&exp(xi).after(&motion)));
    let expected = slope(&|xi| loss(&exp(std::array::from_fn(|k| TWIST[k] + xi[k]))));
    let found = to_twist(TWIST, d);
    assert!((0..6).all(|k| (found[k] - expected[k]).abs() < 1e-8), "{found:?} {expected:?}");
}

#[test]
fn a_correction_common_to_all_cameras_is_removed() {
    let cameras: Vec<Camera> = (0..6).map(camera).collect();
    let mut c = corrections(&on(), &cameras, true);
    // The world turns, shifts and grows by a little about a point of its own.
    let (turn, shift, growth) = ([2e-4, -1e-4, 3e-4], [1e-4, 2e-4, -1e-4], 3e-4);
    for (row, camera) in cameras.iter().enumerate() {
        let (rotation, center) = (camera.cam_from_world.rotation, camera.center());
        let swing = cross(turn, center);
        let moved: [f64; 3] = std::array::from_fn(|k| swing[k] + shift[k] + growth * center[k]);
        let (p, r) = (mat_vec(&rotation, moved), mat_vec(&rotation, turn));
        c.set(row, [p[0], p[1], p[2], r[0], r[1], r[2]].map(|x| -x as f32), 0.0);
    }
    c.fix_poses();
    for row in 0..cameras.len() {
        assert!(c.twist(row).unwrap().iter().all(|x| x.abs() < 1e-6), "{:?}", c.twist(row));
    }
    c.set(2, [0.0, 0.0, 0.0, 0.01, 0.0, 0.0], 0.0);
    c.fix_poses();
    let once = c.twist(2).unwrap();
    c.fix_poses();
    assert!(once[3] > 0.005 && (0..6).all(|k| (once[k] - c.twist(2).unwrap()[k]).abs() < 1e-6), "done is done");
}

#[test]
fn corrections_respect_start_end_and_limits() {
    let cameras: Vec<Camera> = (0..3).map(camera).collect();
    let mut c = corrections(&RefineSettings { time_init: 10.0, ..on() }, &cameras, true);
    let d = [[1.0, 0.0, 0.0, 0.0, 0.5, 0.0]];
    let before: Vec<_> = c.tables().map(|(_, t)| t.clone()).collect();
    step(&mut c, &[1], &d, &[1.0], 0.05);
    step(&mut c, &[1], &d, &[1.0], 0.9);
    step(&mut c, &[1], &[[f64::NAN; 6]], &[f64::NAN], 0.7);
    assert!(c.tables().zip(&before).all(|((_, t), old)| t == old), "too early, too late, not finite");
    // Rates are largest when they begin, of clocks after the last search: there a step goes beyond the limit.
    step(&mut c, &[1, 0], &[d[0], d[0]], &[1.0, -1.0], SEARCHED);
    let times: Vec<f64> = (0..3).map(|i| c.time(i, Time(0.0)).0).collect();
    let limit = 0.1 * c.settings.time_limit;
    assert!((times[0] - limit).abs() < 1e-6 && (times[1] + limit).abs() < 1e-6 && times[2].abs() < 1e-6, "{times:?}");
    let longer = |i: usize| c.camera(i, &cameras[i]).intrinsics.fx / cameras[i].intrinsics.fx - 1.0;
    assert!(longer(0) > 0.0 && (longer(1) + longer(0)).abs() < 1e-9 && longer(2) == 0.0, "{} {}", longer(0), longer(1));
    let moved = |i: usize| c.camera(i, &cameras[i]).cam_from_world != cameras[i].cam_from_world;
    assert!([0, 1, 2].into_iter().all(moved), "the mean stays, so the others give way");
}

#[test]
fn searches_are_spread_over_the_run_and_keep_the_median_of_all_clocks() {
    let cameras: Vec<Camera> = (0..5).map(camera).collect();
    let mut c = corrections(&on(), &cameras, true);
    const STEPS: usize = 1000;
    let due = |k: usize| c.search_due(k as f64 / STEPS as f64, (k + 1) as f64 / STEPS as f64);
    let found: Vec<(usize, SearchDue)> = (0..STEPS).filter_map(|k| Some((k, due(k)?))).collect();
    assert_eq!(found.iter().map(|(_, d)| d.round).collect::<Vec<_>>(), (0..c.settings.searches).collect::<Vec<_>>());
    assert!(found[0].0 == 100 && found.iter().all(|(k, _)| *k < 500), "{found:?}");
    assert!((found[0].1.reach - 0.4).abs() < 1e-12 && found.last().unwrap().1.reach < 0.2, "far first: {found:?}");
    // Replanning may skip search positions: one search is made, and none is repeated.
    assert_eq!(c.search_due(0.05, 0.44).map(|d| d.round), Some(6));
    assert_eq!(c.search_due(0.25, 0.25), None);
    // Four clocks that are right by themselves and one that is not.
    c.shift(&[(0, 0.1), (1, 0.1), (2, 0.35), (3, 0.1), (4, 0.12)]);
    let times: Vec<f64> = (0..5).map(|i| c.time(i, Time(0.0)).0).collect();
    let close = |i: usize, t: f64| (times[i] - t).abs() < 1e-5;
    assert!(close(0, 0.0) && close(1, 0.0) && close(2, 0.25) && close(4, 0.02), "{times:?}");
    let still = corrections(&RefineSettings { times: false, ..on() }, &cameras, true);
    assert_eq!(still.search_due(0.0, 1.0), None, "nobody asked for it");
}

#[test]
fn frames_of_a_fixed_camera_share_a_pose_and_those_of_a_moving_one_do_not() {
    let all: Vec<Camera> = (0..4).map(camera).collect();
    let frame = |rig, fixed, k: usize| Origin { rig, fixed, camera: &all[k], lens: Lens::Pinhole };
    let frames = [frame(0, true, 0), frame(1, false, 1), frame(0, true, 0), frame(1, false, 2)];
    let c = Corrections::new(&on(), Scale { extent: 4.0, frame: 0.1 }, &frames, 2, true);
    assert_eq!((c.rows.clone(), c.origins.len()), (vec![0, 1, 0, 2], 3));
    let alone = corrections(&on(), &all[..1], true);
    assert_eq!(alone.tables().count(), 2, "a single camera is its own mean, but has a lens");
    assert_eq!(corrections(&on(), &all[..1], false).tables().count(), 4, "but not where the scene stays");
}
