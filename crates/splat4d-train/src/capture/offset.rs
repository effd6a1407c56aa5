//! Captures far from the origin of their world, as maps have them: the one place where the offset is subtracted, in f64,
//! from the poses and points of all layouts. Depth maps and tracks are relative to their cameras.

use super::Take;
use splat4d::math::Se3;
use splat4d::math::se3::mat_vec;
use splat4d::scene::offset::offset_of;

/// Subtracts the offset that the take needs from its poses and points, and returns it: zero near the origin, where every
/// bit stays.
pub(super) fn subtract(take: &mut Take) -> [f64; 3] {
    let centers: Vec<[f64; 3]> = take.frames.iter().map(|f| f.source.center()).collect();
    let points = take.points.as_ref().map_or(&[][..], |p| &p.points);
    let offset = offset_of(&centers, points);
    if offset == [0.0; 3] {
        return offset;
    }
    for frame in &mut take.frames {
        let pose = &mut frame.source.cam_from_world;
        let turned = mat_vec(&pose.rotation, offset);
        *pose = Se3 { translation: std::array::from_fn(|k| pose.translation[k] + turned[k]), ..*pose };
    }
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
