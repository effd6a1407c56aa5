//! Estimated against known camera poses: absolute and relative trajectory error, and clocks.

use super::run::merge;
use crate::capture::Capture;
use crate::{Error, Result};
use serde_json::{Value, json};
use splat4d::math::align::{Apart, Trajectory};
use splat4d::math::{Se3, Sim3};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Fewest cameras that determine more than the similarity that is taken away.
const FEWEST: usize = 3;

/// Errors of a capture's cameras against the truth.
#[derive(Clone, Debug, PartialEq)]
pub struct TrajectoryError {
    /// The names of the poses: camera, and the number of the image where the camera moves.
    pub names: Vec<(String, Option<usize>)>,
    /// Their errors, once a similarity is taken away.
    pub poses: Trajectory,
    /// By camera: how much later its clock is than it should be, once the median of all is taken away, seconds.
    pub clocks: Vec<(String, f64)>,
}

impl TrajectoryError {
    /// As plain data. Lengths are in the truth's unit.
    pub fn report(&self) -> Value {
        let Trajectory { by: Sim3 { scale, .. }, radius, ate, rpe, apart } = &self.poses;
        let pose = |((camera, frame), apart): (&(String, Option<usize>), &Apart)| json!({"camera": camera, "frame": frame, "degrees": apart.degrees, "share": apart.center});
        json!({
            "ate": ate, "radius": radius, "scale": scale,
            "rpe-rotation": rpe.map(|r| r[0]), "rpe-translation": rpe.map(|r| r[1]),
            "cameras": self.names.iter().zip(apart).map(pose).collect::<Vec<_>>(),
            "clocks": self.clocks.iter().map(|(c, s)| json!({"camera": c, "seconds": s})).collect::<Vec<_>>(),
        })
    }

    /// Writes it into the `results.json` of a run, under `trajectory`. Errors: the file cannot be written.
    pub fn write(&self, run: &Path) -> Result<()> {
        merge(&run.join("results.json"), json!({ "trajectory": self.report() }))
    }

    /// The median and the largest of the clocks' errors, seconds.
    pub fn clock_errors(&self) -> Option<[f64; 2]> {
        let mut all: Vec<f64> = self.clocks.iter().map(|(_, s)| s.abs()).collect();
        all.sort_by(f64::total_cmp);
        Some([*all.get(all.len() / 2)?, *all.last()?])
    }
}

/// Compares the training cameras of a capture, as they were found, with those of the same names in another, which
/// contains. Fixed cameras have one pose, of moving ones every image has its own. Neighbours for the relative error are
/// images of one moving camera, and fixed cameras in the capture's order.
///
/// Errors: fewer than three cameras have a ground truth, or differ in position.
pub fn trajectory_error(found: &Capture, truth: &Capture) -> Result<TrajectoryError> {
    let mut known: BTreeMap<(&str, usize), usize> = BTreeMap::new();
    for (i, frame) in truth.frames.iter().enumerate() {
        known.insert((truth.cameras[frame.camera].name.as_str(), frame.index), i);
    }
    let mut names: Vec<(String, Option<usize>)> = Vec::new();
    let (mut poses, mut truths): (Vec<Se3>, Vec<Se3>) = (Vec::new(), Vec::new());
    let (mut rigs, mut pairs, mut seen) = (Vec::new(), Vec::new(), BTreeSet::new());
    let mut late: Vec<(usize, Vec<f64>)> = Vec::new();
    for &i in &found.train {
        let frame = &found.frames[i];
        let camera = &found.cameras[frame.camera];
        let Some(&true_frame) = known.get(&(camera.name.as_str(), frame.index)) else { continue };
        let true_frame = &truth.frames[true_frame];
        let by = frame.time.0 - true_frame.time.0;
        match late.iter_mut().find(|(rig, _)| *rig == frame.camera) {
            Some((_, all)) => all.push(by),
            None => late.push((frame.camera, vec![by])),
        }
        if camera.fixed && !seen.insert(frame.camera) {
            continue;
        }
        names.push((camera.name.clone(), (!camera.fixed).then_some(frame.index)));
        poses.push(frame.view.cam_from_world);
        truths.push(true_frame.view.cam_from_world);
        rigs.push((camera.fixed, frame.camera, frame.time.0));
    }
    // Images of one camera in time; fixed cameras one after the other.
    let mut order: Vec<usize> = (0..names.len()).collect();
    order.sort_by(|&a, &b| (rigs[a].0, rigs[a].1).cmp(&(rigs[b].0, rigs[b].1)).then(rigs[a].2.total_cmp(&rigs[b].2)));
    for w in order.windows(2) {
        let (a, b) = (rigs[w[0]], rigs[w[1]]);
        if a.0 && b.0 || !a.0 && !b.0 && a.1 == b.1 {
            pairs.push([w[0], w[1]]);
        }
    }
    let few = || {
        Error::input(format!(
            "{} of the run's cameras have a truth; {FEWEST} at different positions are needed",
            names.len()
        ))
        .at(truth.root.display())
        .remedy("Give the capture whose cameras have the same names and images as those that were trained on")
    };
    if names.len() < FEWEST {
        return Err(few());
    }
    let poses = Trajectory::of(&poses, &truths, &pairs).ok_or_else(few)?;
    let middle = |all: &mut Vec<f64>| {
        all.sort_by(f64::total_cmp);
        0.5 * (all[(all.len() - 1) / 2] + all[all.len() / 2])
    };
    let mut clocks: Vec<(String, f64)> =
        late.iter_mut().map(|(rig, all)| (found.cameras[*rig].name.clone(), middle(all))).collect();
    let median = middle(&mut clocks.iter().map(|c| c.1).collect());
    clocks.iter_mut().for_each(|c| c.1 -= median);
    Ok(TrajectoryError { names, poses, clocks })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::tests::{Place, recipe};
    use splat4d::scene::Time;

    #[test]
    fn camera_errors_equal_the_applied_disturbance() {
        let place = Place::new();
        let truth = place.open(&recipe(&["hold_out=none"]));
        let mut found = Capture::clone(&truth);
        // Another world, in which one camera looks elsewhere and its clock is late.
        let world = Sim3 { scale: 0.5, translation: [1.0, 2.0, 3.0], ..Sim3::default() };
        let (angle, late) = (0.03f64, 0.25);
        let turn = [[1.0, 0.0, 0.0], [0.0, angle.cos(), -angle.sin()], [0.0, angle.sin(), angle.cos()]];
        for frame in &mut found.frames {
            let mut pose = world.pose(&frame.view.cam_from_world);
            frame.time = Time(frame.time.0 + 7.0);
            if frame.camera == 1 {
                pose = Se3 { rotation: turn, translation: [0.0; 3] }.after(&pose);
                frame.time = Time(frame.time.0 + late);
            }
            frame.view.cam_from_world = pose;
        }
        let e = trajectory_error(&found, &truth).unwrap();
        assert!((e.poses.by.scale - 2.0).abs() < 1e-9 && e.poses.ate < 1e-9, "{e:?}");
        assert!((e.poses.apart[1].degrees - angle.to_degrees()).abs() < 1e-6 && e.poses.apart[0].degrees < 1e-6);
        // Three pairs of four fixed cameras, two of which the camera is in.
        let rpe = e.poses.rpe.unwrap();
        assert!((rpe[0] - angle.to_degrees() * (2.0f64 / 3.0).sqrt()).abs() < 1e-6, "{rpe:?}");
        // It turns about the first axis of its own: the step to it ends off by a chord, no step from it does.
        let pose = |i: usize| &truth.frames.iter().find(|f| f.camera == i).unwrap().view;
        let [_, y, z] = pose(1).cam_from_world.apply(pose(0).center());
        let chord = 2.0 * (0.5 * angle).sin() * y.hypot(z);
        assert!(chord > 1e-3 && (rpe[1] - chord / 3.0f64.sqrt()).abs() < 1e-9, "{rpe:?}");
        assert!((e.clocks[1].1 - late).abs() < 1e-9 && e.clocks[0].1.abs() < 1e-9, "{:?}", e.clocks);
        assert_eq!(e.clock_errors().map(|c| (c[0] < 1e-9, (c[1] - late).abs() < 1e-9)), Some((true, true)));
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("results.json"), r#"{"ours_7": {"PSNR": 30.0}}"#).unwrap();
        e.write(folder.path()).unwrap();
        let text = std::fs::read_to_string(folder.path().join("results.json")).unwrap();
        let all: Value = serde_json::from_str(&text).unwrap();
        assert!(all["ours_7"]["PSNR"] == 30.0 && all["trajectory"]["cameras"][1]["camera"] == "cam1", "{all}");
        let mut strangers = Capture::clone(&truth);
        strangers.cameras.iter_mut().for_each(|c| c.name.push('x'));
        assert!(trajectory_error(&found, &strangers).is_err_and(|e| e.to_string().contains("0 of the run's cameras")));
    }
}
