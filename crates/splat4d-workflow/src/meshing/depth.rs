//! Surfaces that one camera sees: depth, normal and colour of every pixel.
//!
//! The depth of a splat at a pixel is where its density along the pixel's ray is largest. For a flat splat that is its
//! plane, not its centre. To first order it is linear in the pixel, z(u, v) = a + g_u u + g_v v, and so is the blend of
//! splats: the renderer blends a, g_u and g_v as further channels, and the sum is evaluated per pixel afterwards.
//! Source of the linear depth: Zhang et al. 2024 (RaDe-GS), from the maximum of a Gaussian along a ray.

use crate::paths::resized;
use rayon::prelude::*;
use splat4d::math::Se3;
use splat4d::math::se3::{self, add, mat_mul, mat_vec, norm, scale, sub};
use splat4d::render::Image;
use splat4d::scene::splats::COV;
use splat4d::scene::{Camera, Splats, Table};
use std::f64::consts::{PI, TAU};

/// Alpha from which a pixel shows a surface: the median of what its ray passes is opaque.
const SURFACE_ALPHA: f32 = 0.5;
/// Alpha below which a ray passes free space only.
const FREE_ALPHA: f32 = 0.1;
/// Largest slope of a splat's depth over the direction of a ray, in depths: 79° from the camera's axis.
const STEEPEST: f64 = 5.0;
/// Share of the largest variance that is added to all: flat splats have an inverse.
const LEAST_VARIANCE: f64 = 1e-6;
/// Pixels of a voxel at the middle of the scene, so that neighbouring voxels have pixels of their own.
const PIXELS_PER_VOXEL: f64 = 1.5;
/// Most views of a frame.
const MOST_VIEWS: usize = 64;
/// Most pixels of all views of a frame, 12 bytes each.
const MOST_PIXELS: f64 = 16e6;
/// Views around a scene whose cameras are unknown.
const AROUND: usize = 32;
/// Their vertical field of view.
const FOV_Y: f64 = PI / 4.0;
/// Least side of a view, pixels.
const LEAST_SIDE: f64 = 32.0;
/// Most side of a view around a scene, pixels.
const MOST_SIDE: f64 = 1024.0;

/// What a pixel shows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Sample {
    /// z in camera axes; infinite: free space only; NaN: unknown.
    pub(super) depth: f32,
    /// Unit normal towards the camera in camera axes, times 127.
    pub(super) normal: [i8; 3],
    /// sRGB.
    pub(super) color: [u8; 3],
}

/// What a camera sees.
pub(super) struct Map {
    /// Its camera, in the axes of the grid.
    pub(super) camera: Camera,
    /// Row by row.
    pub(super) samples: Vec<Sample>,
}

/// Cameras of the surfaces, in the axes of the grid: those of `cameras` evenly chosen, or some around the box where there
/// are none, no larger than voxels of this size need.
pub(super) fn views(cameras: &[Camera], [low, high]: [[f64; 3]; 2], voxel: f64) -> Vec<Camera> {
    let center = scale(add(low, high), 0.5);
    let radius = 0.5 * norm(sub(high, low));
    let mut out: Vec<Camera> = if cameras.is_empty() {
        let distance = radius / (0.5 * FOV_Y).sin();
        let side = 2.0 * (0.5 * FOV_Y).tan() * distance * PIXELS_PER_VOXEL / voxel;
        let side = side.clamp(LEAST_SIDE, MOST_SIDE) as usize;
        (0..AROUND).map(|i| around(i, center, distance, side)).collect()
    } else {
        let chosen = cameras.iter().step_by(cameras.len().div_ceil(MOST_VIEWS));
        let fitted = |camera: &Camera| {
            let distance = norm(sub(center, camera.center())).max(camera.near);
            let k = (PIXELS_PER_VOXEL * distance / voxel / camera.intrinsics.fy).min(1.0);
            shrunk(camera, k)
        };
        chosen.map(fitted).collect()
    };
    let pixels: f64 = out.iter().map(|c| (c.width * c.height) as f64).sum();
    if pixels > MOST_PIXELS {
        out.iter_mut().for_each(|camera| *camera = shrunk(camera, (MOST_PIXELS / pixels).sqrt()));
    }
    out
}

/// One of the views around a point, spread evenly over the sphere by the golden angle.
fn around(i: usize, center: [f64; 3], distance: f64, side: usize) -> Camera {
    let z = 1.0 - (2.0 * i as f64 + 1.0) / AROUND as f64;
    let turn = TAU * (i as f64 * 0.618_033_988_75).fract();
    let flat = (1.0 - z * z).sqrt();
    let eye = add(center, scale([flat * turn.cos(), flat * turn.sin(), z], distance));
    Camera::with_fov_y(Se3::look_at(eye, center, [0.0, 0.0, 1.0]), FOV_Y, side, side)
}

/// The same view with `k` times as many pixels a side.
fn shrunk(camera: &Camera, k: f64) -> Camera {
    let side = |n: usize| ((n as f64 * k).round().max(LEAST_SIDE) as usize).min(n);
    resized(camera, [side(camera.width), side(camera.height)])
}

/// A camera of the world in the axes of the grid.
pub(super) fn in_grid(camera: &Camera, grid_from_world: &[[f64; 3]; 3]) -> Camera {
    let rotation = mat_mul(&camera.cam_from_world.rotation, &se3::transpose(grid_from_world));
    Camera { cam_from_world: Se3 { rotation, ..camera.cam_from_world }, ..camera.clone() }
}

/// The same back.
pub(super) fn in_world(camera: &Camera, grid_from_world: &[[f64; 3]; 3]) -> Camera {
    in_grid(camera, &se3::transpose(grid_from_world))
}

/// Mean and inverse covariance of every splat.
pub(super) fn inverses(splats: &Splats<'_>) -> Vec<([f64; 3], [f64; 6])> {
    let parts = splats.parts.iter();
    let of = |part: &splat4d::scene::Part<'_>| {
        let row = |row| {
            let mean = part.out.read::<3>(row, 0).map(f64::from);
            (mean, inverse(part.out.read::<6>(row, COV).map(f64::from)))
        };
        (0..part.out.rows()).into_par_iter().map(row).collect::<Vec<_>>()
    };
    parts.flat_map(of).collect()
}

/// Inverse of a symmetric matrix (xx, xy, xz, yy, yz, zz).
fn inverse([a, b, c, d, e, f]: [f64; 6]) -> [f64; 6] {
    let floor = LEAST_VARIANCE * (a + d + f).max(f64::MIN_POSITIVE);
    let (a, d, f) = (a + floor, d + floor, f + floor);
    let minors = [d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b];
    let det = a * minors[0] + b * minors[1] + c * minors[2];
    minors.map(|m| m / det)
}

/// Depth of every splat as a linear function of the pixel's distance from the principal point: [splats, 3], a, g_u, g_v;
/// with `centers` [splats, 4], also the depth of its centre. `camera` is in the world.
pub(super) fn columns(inverses: &[([f64; 3], [f64; 6])], camera: &Camera, centers: bool) -> Table<f32> {
    let (center, pose, k) = (camera.center(), &camera.cam_from_world, &camera.intrinsics);
    let row = |(mean, p): &([f64; 3], [f64; 6])| -> [f32; 4] {
        let m = pose.apply(*mean);
        if m[2].is_nan() || m[2] <= camera.near {
            return [0.0; 4];
        }
        // Along a ray of direction d (z = 1) the density is largest at t = dᵀPm / dᵀPd.
        let v = sub(*mean, center);
        let pv = [
            p[0] * v[0] + p[1] * v[1] + p[2] * v[2],
            p[1] * v[0] + p[3] * v[1] + p[4] * v[2],
            p[2] * v[0] + p[4] * v[1] + p[5] * v[2],
        ];
        let s: f64 = (0..3).map(|i| v[i] * pv[i]).sum();
        let n = mat_vec(&pose.rotation, pv);
        let slope = |i: usize| {
            let slope = -m[2] * m[2] * n[i] / s;
            if slope.is_finite() { slope.clamp(-STEEPEST * m[2], STEEPEST * m[2]) } else { 0.0 }
        };
        let (x, y) = (slope(0), slope(1));
        [(m[2] - (x * m[0] + y * m[1]) / m[2]) as f32, (x / k.fx) as f32, (y / k.fy) as f32, m[2] as f32]
    };
    let rows: Vec<[f32; 4]> = inverses.par_iter().map(row).collect();
    let width = if centers { 4 } else { 3 };
    let mut out = Table::new(&[("plane", width)], rows.len());
    for (i, values) in rows.iter().enumerate() {
        values[..width].iter().enumerate().for_each(|(column, value)| out.set(i, column, *value));
    }
    out
}

/// What the image rendered with these columns shows. Pixels that disagree by more than `jump` with their neighbours on both sides blend
/// what is in front with what is behind, and are unknown.
pub(super) fn map(image: &Image, camera: Camera, jump: f64) -> Map {
    let (width, height, k) = (camera.width, camera.height, camera.intrinsics);
    let (extra, alpha) = (&image.extra, &image.alpha.data);
    // Depth and its slopes by the pixel.
    let plane = |x: usize, y: usize| -> Option<[f64; 3]> {
        let p = y * width + x;
        let a = alpha[p];
        let [z, u, v] = [0, 1, 2].map(|c| f64::from(extra.plane(c)[p] / a));
        let depth = match extra.channels {
            3 => z + u * (x as f64 + 0.5 - k.cx) + v * (y as f64 + 0.5 - k.cy),
            _ => f64::from(extra.plane(3)[p] / a),
        };
        (a >= SURFACE_ALPHA && depth > camera.near && depth.is_finite()).then_some([depth, u, v])
    };
    let differs = |[depth, u, v]: [f64; 3], [x, y]: [usize; 2], [dx, dy]: [isize; 2]| {
        let (Some(nx), Some(ny)) = (x.checked_add_signed(dx), y.checked_add_signed(dy)) else { return false };
        if nx >= width || ny >= height {
            return false;
        }
        let expected = depth + u * dx as f64 + v * dy as f64;
        plane(nx, ny).is_none_or(|[other, ..]| (other - expected).abs() > jump)
    };
    let sample = |p: usize| {
        let (x, y) = (p % width, p / width);
        let unknown = Sample { depth: f32::NAN, normal: [0; 3], color: [0; 3] };
        if alpha[p] < FREE_ALPHA {
            return Sample { depth: f32::INFINITY, ..unknown };
        }
        let Some(at) = plane(x, y) else { return unknown };
        let both = |d: [[isize; 2]; 2]| d.into_iter().all(|d| differs(at, [x, y], d));
        if both([[-1, 0], [1, 0]]) || both([[0, -1], [0, 1]]) {
            return unknown;
        }
        let [depth, u, v] = at;
        let (sx, sy) = (u * k.fx, v * k.fy);
        let (dx, dy) = ((x as f64 + 0.5 - k.cx) / k.fx, (y as f64 + 0.5 - k.cy) / k.fy);
        let n = se3::normalize([sx, sy, -(depth + dx * sx + dy * sy)]);
        let byte = |c: usize| (image.color.plane(c)[p] / alpha[p] * 255.0).round().clamp(0.0, 255.0) as u8;
        Sample { depth: depth as f32, normal: n.map(|x| (127.0 * x).round() as i8), color: [byte(0), byte(1), byte(2)] }
    };
    let samples = (0..width * height).into_par_iter().map(sample).collect();
    Map { camera, samples }
}
