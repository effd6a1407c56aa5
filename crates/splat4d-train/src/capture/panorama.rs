//! Equirectangular panoramas (COLMAP's and Nerfstudio's EQUIRECTANGULAR) become six pinhole views each, the faces of a
//! cube. Views are cut out of the panorama when an image is loaded; nothing is written.

use super::{HoldOut, RawCapture, RawFrame, Split, Timing};
use splat4d::math::Se3;
use splat4d::math::se3::{mat_mul, mat_vec};
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, Result};
use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};

/// The faces: a name, and their axes (x right, y down, z forward) as rows in the panorama's.
const FACES: [(&str, [[f64; 3]; 3]); 6] = [
    ("front", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    ("right", [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    ("back", [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]),
    ("left", [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    ("up", [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    ("down", [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
];
/// A face is as many pixels wide as a quarter of the panorama: 90° of its circle.
const FACES_ROUND: usize = 4;
/// Every how many panoramas one is held out (LLFF's habit): its faces together, because they share a place.
const HOLD_EVERY: usize = 8;
/// Relative difference of a panorama's shape from 2:1 that is rounding.
const SHAPE: f64 = 0.01;

/// Intrinsics and lens of a panorama of this size before it is split.
pub(super) fn whole(size: [usize; 2]) -> (Intrinsics, Lens) {
    let [width, height] = size.map(|v| v as f64);
    let turn = FACES[0].1;
    let intrinsics = Intrinsics { fx: width / TAU, fy: height / PI, cx: 0.5 * width, cy: 0.5 * height };
    (intrinsics, Lens::Equirectangular { turn, size })
}

/// Splits the panoramas of a capture; others stay.
pub(super) fn split(take: &mut RawCapture, hold_out: Option<&HoldOut>) -> Result<()> {
    let is_panorama = |f: &RawFrame| matches!(f.source.lens, Lens::Equirectangular { .. });
    let count = take.frames.iter().filter(|f| is_panorama(f)).count();
    if count == 0 {
        return Ok(());
    }
    let frames = std::mem::take(&mut take.frames);
    let names = std::mem::take(&mut take.cameras);
    // Places of one time without a rig: whole panoramas are held out, unless something else is requested.
    let by_place = take.timing == Timing::Moment
        && !take.named
        && hold_out.or(take.hold_out.as_ref()).is_none()
        && count > 1
        && frames.iter().all(|f| f.split == Split::Train);
    let mut cameras: BTreeMap<(usize, Option<usize>), usize> = BTreeMap::new();
    let mut camera = |of: usize, face: Option<usize>| {
        let next = cameras.len();
        *cameras.entry((of, face)).or_insert_with(|| {
            take.cameras.push(face.map_or_else(|| names[of].clone(), |f| format!("{}/{}", names[of], FACES[f].0)));
            next
        })
    };
    for (i, frame) in frames.into_iter().enumerate() {
        let Lens::Equirectangular { size, .. } = frame.source.lens else {
            take.frames.push(RawFrame { camera: camera(frame.camera, None), ..frame });
            continue;
        };
        check(&frame, size)?;
        for (face, (_, turn)) in FACES.iter().enumerate() {
            let mut own = view(&frame, turn, size);
            own.camera = camera(frame.camera, Some(face));
            if by_place && i % HOLD_EVERY == 0 {
                own.split = Split::Held;
            }
            take.frames.push(own);
        }
    }
    take.notes.push(format!(
        "{count} panoramas are split into {} pinhole views each: the faces of a cube, a quarter of the panorama wide.",
        FACES.len()
    ));
    Ok(())
}

fn check(frame: &RawFrame, [width, height]: [usize; 2]) -> Result<()> {
    let place = |e: Error| e.at(frame.image.display());
    if (width as f64 / (2 * height.max(1)) as f64 - 1.0).abs() > SHAPE || width < FACES_ROUND {
        return Err(place(Error::input(format!("a panorama of {width}x{height} is not twice as wide as high")))
            .remedy("Give whole panoramas: 360 degrees across, 180 down."));
    }
    if frame.depth.is_some() || frame.flow.is_some() || frame.labels.is_some() || frame.features.is_some() {
        return Err(place(Error::input("depth, flow, labels and features of panoramas are not read"))
            .remedy("Take them out of the capture, or cut perspective images out of the panoramas first."));
    }
    Ok(())
}

fn view(frame: &RawFrame, turn: &[[f64; 3]; 3], size: [usize; 2]) -> RawFrame {
    let side = size[0] / FACES_ROUND;
    let half = 0.5 * side as f64;
    let pose = &frame.source.cam_from_world;
    let cam_from_world = Se3 { rotation: mat_mul(turn, &pose.rotation), translation: mat_vec(turn, pose.translation) };
    let source = Camera {
        cam_from_world,
        intrinsics: Intrinsics { fx: half, fy: half, cx: half, cy: half },
        lens: Lens::Equirectangular { turn: *turn, size },
        width: side,
        height: side,
        near: frame.source.near,
    };
    let place = (frame.camera, frame.index, frame.time);
    RawFrame { mask: frame.mask.clone(), split: frame.split, ..RawFrame::new(place, source, frame.image.clone()) }
}

/// The camera of the stored image, by its size: of a panorama the whole of it.
pub(super) fn stored(source: &Camera) -> Camera {
    match source.lens {
        Lens::Equirectangular { size: [width, height], .. } => Camera { width, height, ..source.clone() },
        _ => source.clone(),
    }
}

/// Makes the view one of a panorama of this size. False: it is none, or of another shape.
pub(super) fn resize(source: &mut Camera, (width, height): (usize, usize)) -> bool {
    let Lens::Equirectangular { turn, size } = source.lens else { return false };
    if width * size[1] != height * size[0] || width < FACES_ROUND {
        return false;
    }
    let side = width / FACES_ROUND;
    let half = 0.5 * side as f64;
    source.intrinsics = Intrinsics { fx: half, fy: half, cx: half, cy: half };
    source.lens = Lens::Equirectangular { turn, size: [width, height] };
    (source.width, source.height) = (side, side);
    true
}

/// The pixel of the panorama (the centre of the first at 0.5) that the view's ray (x, y, 1) meets.
pub(super) fn pixel(turn: &[[f64; 3]; 3], size: [usize; 2], [x, y]: [f64; 2]) -> [f64; 2] {
    // Rows of `turn` are the view's axes.
    let ray: [f64; 3] = std::array::from_fn(|k| turn[0][k] * x + turn[1][k] * y + turn[2][k]);
    let length = (1.0 + x * x + y * y).sqrt();
    let (longitude, latitude) = (ray[0].atan2(ray[2]), (ray[1] / length).clamp(-1.0, 1.0).asin());
    [size[0] as f64 * (0.5 + longitude / TAU), size[1] as f64 * (0.5 + latitude / PI)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panorama_rays_equal_colmaps() {
        // pycolmap 4.2.1, EQUIRECTANGULAR of 640x320, `img_from_cam`.
        let known = [
            ([0.1, -0.2], [330.152165578, 139.99068492]),
            ([0.7, 0.3], [382.208035909, 184.547359838]),
            ([-1.1, 0.9], [235.1532249, 215.45056679]),
            ([-2.5, -1.2], [198.758061309, 117.29592514]),
        ];
        for (ray, wanted) in known {
            let own = pixel(&FACES[0].1, [640, 320], ray);
            assert!((0..2).all(|k| (own[k] - wanted[k]).abs() < 1e-6), "{ray:?}: {own:?}, not {wanted:?}");
        }
        // Rays of other faces, as one in the panorama's axes: (-1, 0.5, -0.3).
        let wanted = [130.3124547, 205.49399628];
        let mut met = 0;
        for (_, turn) in FACES {
            let ray = mat_vec(&turn, [-1.0, 0.5, -0.3]);
            if ray[2] > 0.0 {
                let own = pixel(&turn, [640, 320], [ray[0] / ray[2], ray[1] / ray[2]]);
                assert!((0..2).all(|k| (own[k] - wanted[k]).abs() < 1e-6), "{own:?}");
                met += 1;
            }
        }
        assert_eq!(met, 3, "three faces of a cube look its way");
        for (name, turn) in FACES {
            let pose = Se3 { rotation: turn, translation: [0.0; 3] };
            assert!(pose.orthogonality_error() < 1e-12 && pose.det() > 0.0, "{name}");
        }
    }
}
