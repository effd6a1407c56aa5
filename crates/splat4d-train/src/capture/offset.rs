//! Captures far from the origin of their world, as maps have them: the one place where the offset is subtracted, in f64,
//! from the poses and points of all layouts. Depth maps and tracks are relative to their cameras.

use super::{Capture, RawCapture};
use splat4d::math::Se3;
use splat4d::math::se3::{mat_vec, sub};
use splat4d::scene::offset::offset_of;
use std::sync::Arc;

/// Subtracts the offset that the capture needs from its poses and points, and returns it: zero near the origin, where every
/// bit stays.
pub(super) fn subtract(take: &mut RawCapture) -> [f64; 3] {
    let centers: Vec<[f64; 3]> = take.frames.iter().map(|f| f.source.center()).collect();
    let points = take.points.as_ref().map_or(&[][..], |p| &p.points);
    let offset = offset_of(&centers, points);
    if offset == [0.0; 3] {
        return offset;
    }
    take.frames.iter_mut().for_each(|f| moved(&mut f.source.cam_from_world, offset));
    if let Some(points) = &mut take.points {
        points.subtract(offset);
    }
    take.notes.push(format!(
        "The coordinates are far from the origin, where single precision is coarse: ({}, {}, {}) is subtracted from poses \
         and points. The scene and its files store it as `offset`.",
        offset[0], offset[1], offset[2]
    ));
    offset
}

/// The pose in a world whose origin is at `by` of its present one.
fn moved(pose: &mut Se3, by: [f64; 3]) {
    let turned = mat_vec(&pose.rotation, by);
    *pose = Se3 { translation: std::array::from_fn(|k| pose.translation[k] + turned[k]), ..*pose };
}

/// Why results in world coordinates are poor.
const COARSE: &str = "This run was trained by an earlier version in coordinates far from the origin, where single precision is \
                      coarse. Train it again for a sharper result.";

impl Capture {
    /// A warning where positions are far from the origin and not relative to an offset: those of runs of earlier versions.
    pub fn coarse(&self) -> Option<&'static str> {
        let centers: Vec<[f64; 3]> = self.frames.iter().map(|f| f.view.center()).collect();
        let points = self.points.as_ref().map_or(&[][..], |p| &p.points);
        (self.offset == [0.0; 3] && offset_of(&centers, points) != [0.0; 3]).then_some(COARSE)
    }

    /// Makes positions relative to another offset: that of a scene with which the capture is compared.
    pub fn relocate(&mut self, offset: [f64; 3]) {
        let by = sub(offset, self.offset);
        if by == [0.0; 3] {
            return;
        }
        for frame in &mut self.frames {
            moved(&mut frame.view.cam_from_world, by);
            moved(&mut frame.source.cam_from_world, by);
        }
        if let Some(points) = &mut self.points {
            points.subtract(by);
        }
        self.geometry = self.geometry.as_ref().map(|g| Arc::new(g.relative_to(offset)));
        self.offset = offset;
    }
}
