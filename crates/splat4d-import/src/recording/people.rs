//! The rig that keypoints of people give.

use super::assist::Placed;
use super::given;
use super::report::Report;
use super::world::Origin;
use crate::Result;
use crate::clicks::{self, Frames, calibrate, read_keypoints};
use crate::sfm::known::Straight;
use crate::sfm::lens::Known;
use crate::sync::graph;
use crate::write::Pictures;
use std::path::Path;

/// Finds the rig by keypoints of people in a folder, and puts lenses and poses among the known ones.
///
/// Errors: those of reading; stored images of another shape than the videos; calibrated positions; people who give no
/// rig, or one that may be wrong.
pub(super) fn placed(
    folder: &Path,
    cameras: &[super::Camera],
    pictures: &[Pictures],
    known: &mut [Option<Known>],
    clock: &graph::Solution,
    kept: &[bool],
    report: &mut Report,
) -> Result<Placed> {
    given::without_poses(known, "keypoints of people", "--keypoints")?;
    let names: Vec<&str> = pictures.iter().map(|p| p.name.as_str()).collect();
    let mut frames = read_keypoints(folder, &names)?;
    let mut rig = Vec::with_capacity(names.len());
    for (c, p) in pictures.iter().enumerate() {
        let info = cameras[c].source.info();
        let by = given::factors("people were detected", info.size, p, "Import without --crop.")?;
        let straight = known[c].map(|k| k.straight(p.size, 1.0));
        moved(&mut frames[c], by, straight.as_ref());
        let rate = info.average_rate.or(info.nominal_rate).filter(|rate| *rate > 0.0);
        rig.push(clicks::Camera {
            size: p.size,
            focal: straight.as_ref().map(Straight::focal),
            interval: rate.map_or(p.clock.interval, |rate| 1.0 / rate),
            offset: clock.offsets[c].as_ref().map(|o| o.seconds),
            keep_offset: kept[c],
        });
    }
    let found = calibrate(&names, &rig, &frames).map_err(|e| e.at(folder.display()))?;
    for (c, own) in known.iter_mut().enumerate() {
        let (pose, lens) = found.cameras[c];
        given::place(own, pose, lens, pictures[c].size);
    }
    report.guesses.push(format!(
        "Poses and focal lengths are those of keypoints of {} people: {} positions in images, {:.1} px (of 1920) off at the \
         median; two halves of the keypoints agree within {:.1} degrees.",
        found.people, found.positions, found.error, found.apart
    ));
    let offsets = (0..names.len()).map(|c| (!kept[c]).then_some(found.offsets[c])).collect();
    Ok(Placed { offsets, origin: Origin::Clicked { floor: None, metres: false } })
}

/// Brings keypoints from pixels of the videos to those of the stored images, without distortion where the lens is known.
fn moved(frames: &mut Frames, by: [f64; 2], straight: Option<&Straight>) {
    for point in frames.values_mut().flatten().flatten() {
        let pixel = [point[0] * by[0], point[1] * by[1]];
        match straight.map_or(Some(pixel), |s| s.pixel(pixel)) {
            Some([x, y]) => (point[0], point[1]) = (x, y),
            None => point[2] = 0.0,
        }
    }
}

#[cfg(test)]
mod tests;
