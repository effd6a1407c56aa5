//! What is learnt of cameras, through a whole step: the gradients that Adam gets against central differences.

use super::*;
use crate::train_state::{Corrections, Origin, RefineSettings, Scale};
use splat4d::scene::Lens;

/// Half the step of the differences, a power of two: of numbers that are kept in f32 it makes exact neighbours.
const NEAR: f32 = 1.0 / 65_536.0;
const CAMERAS: usize = 3;
/// Two times, seconds.
const MOMENTS: [f64; 2] = [0.03, 0.14];

/// Corrections that are not nothing, as they are after some steps.
fn some(stated: &[Shot]) -> Corrections {
    let settings = RefineSettings { poses: true, focal: true, lens: true, times: true, ..RefineSettings::default() };
    let frames: Vec<Origin<'_>> = stated
        .iter()
        .enumerate()
        .map(|(i, s)| Origin { rig: i % CAMERAS, fixed: true, camera: &s.camera, lens: Lens::Pinhole })
        .collect();
    let mut out = Corrections::new(&settings, Scale { extent: 4.0, frame: 0.1 }, &frames, CAMERAS, true);
    for rig in 0..CAMERAS {
        out.set(rig, twist(rig), 0.015_625 * (rig as f32 - 1.0));
        out.set_zoom(rig, zoom(rig));
    }
    out.set_lens(0, SHARES);
    out
}

/// By which the corners of the one lens move: r², r⁴.
const SHARES: [f32; 2] = [0.09375, -0.03125];

fn twist(rig: usize) -> [f32; 6] {
    [0.25, -0.125, 0.1875, 0.0625, -0.09375, 0.125].map(|x| x * (rig as f32 - 0.5))
}

fn zoom(rig: usize) -> f32 {
    0.03125 * (rig as f32 - 1.0)
}

#[test]
fn poses_lenses_and_clocks_of_cameras_have_the_gradient_of_the_loss() {
    let mut params = cloud::<f64>(9, LifeKind::GaussHalf, 61);
    let motion = build_as(&Spec::Spacetime(SpacetimeSpec::default()), &mut params).unwrap();
    let velocities = params.find("velocities").unwrap();
    shake(&mut params, velocities, 0.5, 3);
    let scene = one_layer(params, motion, LifeKind::GaussHalf);
    let list: Vec<(usize, f64)> = MOMENTS.iter().flat_map(|&t| (0..CAMERAS).map(move |c| (c, t))).collect();
    let stated = shots(&list);
    let corrected = |c: &Corrections| -> Vec<Shot> {
        let of = |(i, s): (usize, &Shot)| Shot {
            camera: c.camera(i, &s.camera),
            t: c.time(i, Time(s.t)).0,
            truth: s.truth.clone(),
            shutter: None,
        };
        stated.iter().enumerate().map(of).collect()
    };
    let now = some(&stated);
    let loss = |change: &dyn Fn(&mut Corrections, f32)| {
        let at = |by: f32| {
            let mut c = now.clone();
            change(&mut c, by);
            value(&scene, &corrected(&c), &Vec::new())
        };
        (at(NEAR) - at(-NEAR)) / (2.0 * f64::from(NEAR))
    };
    let (report, ..) = step(&scene, &corrected(&now), &Vec::new(), &mut Renderer::new(smooth()));
    let found = now.gradients(&(0..stated.len()).collect::<Vec<_>>(), &report.grads());
    assert_eq!((found.poses.len(), found.focal.len(), found.times.len()), (CAMERAS, CAMERAS, CAMERAS));
    let offset = |rig: usize| 0.015_625 * (rig as f32 - 1.0);
    for (rig, d) in &found.poses {
        for (k, d) in d.iter().enumerate() {
            let moved = |by: f32| {
                let mut x = twist(*rig);
                x[k] += by;
                x
            };
            let fd = loss(&|c, by| c.set(*rig, moved(by), offset(*rig)));
            assert!(d.abs() > 1e-6, "camera {rig}, number {k} of its pose is told something: {d:e}");
            assert_close(*d, fd, &format!("camera {rig}: dL/d twist {k}"));
        }
    }
    for (rig, [d]) in &found.focal {
        assert_close(*d, loss(&|c, by| c.set_zoom(*rig, zoom(*rig) + by)), &format!("camera {rig}: dL/d focal length"));
        assert!(d.abs() > 1e-6);
    }
    assert_eq!(found.lens.len(), 1, "all cameras have one lens");
    for (k, d) in found.lens[0].1.iter().enumerate() {
        let moved = |by: f32| {
            let mut x = SHARES;
            x[k] += by;
            x
        };
        assert_close(*d, loss(&|c, by| c.set_lens(0, moved(by))), &format!("dL/d coefficient {k} of the lens"));
        assert!(d.abs() > 1e-6);
    }
    for (rig, [d]) in &found.times {
        let fd = loss(&|c, by| c.set(*rig, twist(*rig), offset(*rig) + by));
        assert_close(*d, fd, &format!("camera {rig}: dL/d clock"));
        assert!(d.abs() > 1e-6);
    }
}
