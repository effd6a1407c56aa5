//! Depth of a placed surface from a camera: triangles in a depth buffer; discs of a cloud in two passes, of which the
//! first finds what is in front, and the second averages what belongs to it (surface splatting, Zwicker et al. 2001).

use super::placed::{Disc, Placed};
use splat4d::scene::Camera;

/// Nearest depth, of the camera's near plane: Gaussians nearer than that are not rendered.
const NEAR: f64 = 0.5;
/// A disc belongs to the front surface of a pixel if it is behind it by less than this share of the depth, plus its
/// radius: noise of the scan.
const THICK: f32 = 0.01;
/// A pixel counts only if the discs over it are all around it: the mean of their offsets from it is below this share of
/// their radius. Beyond the edge of a surface it is 0.4 and more.
const AROUND: f32 = 0.3;
/// Discs over a pixel at least: a lone point (dust, a reflection) is no surface.
const FEWEST: u16 = 3;
/// A pixel belongs to an edge of depth if its inverse depth differs from the mean of two opposite neighbours by more than
/// this share: on a plane it is that mean, however slanted. There the front is as wide as a disc too much.
const EDGE: f32 = 0.03;
/// A pixel centre on the common side of two triangles belongs to both.
const SEAM: f64 = 1e-9;
/// Largest radius of a disc, pixels: a cloud that is sparser than that has holes there.
const LARGEST: f32 = 48.0;
/// Discs below this radius are enlarged to it, pixels: one between pixel centres would be lost.
const SMALLEST: f32 = 1.0;

/// Depth z along the camera's axis at every pixel centre of a pinhole camera, [height · width]; 0: nothing there.
pub(super) fn render(placed: &Placed, camera: &Camera) -> Vec<f32> {
    match placed {
        Placed::Mesh { points, triangles } => mesh(points, triangles, camera),
        Placed::Discs(discs) => cloud(discs, camera),
    }
}

fn mesh(points: &[[f32; 3]], triangles: &[[u32; 3]], camera: &Camera) -> Vec<f32> {
    let (w, h, near) = (camera.width, camera.height, NEAR * camera.near);
    let seen: Vec<[f64; 3]> = points.iter().map(|p| camera.cam_from_world.apply(p.map(f64::from))).collect();
    // The inverse of depth is affine on the screen; the largest is in front.
    let mut front = vec![0.0f32; w * h];
    for t in triangles {
        let corners = t.map(|i| seen[i as usize]);
        if corners.iter().all(|p| p[2] > near) {
            triangle(corners, camera, &mut front);
        } else if corners.iter().any(|p| p[2] > near) {
            let polygon = clipped(corners, near);
            (1..polygon.len() - 1).for_each(|i| triangle([polygon[0], polygon[i], polygon[i + 1]], camera, &mut front));
        }
    }
    front.iter_mut().for_each(|q| *q = if *q > 0.0 { 1.0 / *q } else { 0.0 });
    front
}

/// The part of a triangle behind the near plane: three or four corners.
fn clipped(corners: [[f64; 3]; 3], near: f64) -> Vec<[f64; 3]> {
    let mut out = Vec::with_capacity(4);
    for i in 0..3 {
        let (a, b) = (corners[i], corners[(i + 1) % 3]);
        if a[2] > near {
            out.push(a);
        }
        if (a[2] > near) != (b[2] > near) {
            let s = (near - a[2]) / (b[2] - a[2]);
            out.push(std::array::from_fn(|k| a[k] + s * (b[k] - a[k])));
        }
    }
    out
}

fn triangle(corners: [[f64; 3]; 3], camera: &Camera, front: &mut [f32]) {
    let k = &camera.intrinsics;
    let at = corners.map(|p| [k.fx * p[0] / p[2] + k.cx, k.fy * p[1] / p[2] + k.cy]);
    let span = |axis: usize, size: usize| {
        let values = at.map(|p| p[axis]);
        let (low, high) = (
            values.iter().copied().fold(f64::INFINITY, f64::min),
            values.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        );
        // Pixel centres within.
        ((low - 0.5).ceil().max(0.0) as usize, ((high - 0.5).floor() + 1.0).clamp(0.0, size as f64) as usize)
    };
    let ((x0, x1), (y0, y1)) = (span(0, camera.width), span(1, camera.height));
    let edge = |a: [f64; 2], b: [f64; 2], p: [f64; 2]| (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
    let whole = edge(at[0], at[1], at[2]);
    if whole == 0.0 || !whole.is_finite() {
        return;
    }
    for y in y0..y1 {
        for x in x0..x1 {
            let p = [x as f64 + 0.5, y as f64 + 0.5];
            let shares = [edge(at[1], at[2], p), edge(at[2], at[0], p), edge(at[0], at[1], p)].map(|e| e / whole);
            if shares.iter().all(|s| *s >= -SEAM) {
                let inverse = (0..3).map(|i| shares[i] / corners[i][2]).sum::<f64>() as f32;
                let slot = &mut front[y * camera.width + x];
                *slot = slot.max(inverse);
            }
        }
    }
}

/// A disc from a camera.
struct SeenDisc {
    center: [f32; 3],
    normal: [f32; 3],
    radius: f32,
}

impl SeenDisc {
    /// In the camera's axes; `None`: behind the near plane.
    fn new(disc: &Disc, camera: &Camera) -> Option<Self> {
        let center = camera.cam_from_world.apply(disc.center.map(f64::from)).map(|v| v as f32);
        if center[2] <= (NEAR * camera.near) as f32 {
            return None;
        }
        let r = &camera.cam_from_world.rotation;
        let turned = |row: usize| (0..3).map(|k| r[row][k] as f32 * disc.normal[k]).sum::<f32>();
        let normal: [f32; 3] = [turned(0), turned(1), turned(2)];
        // Without a surface it faces the camera.
        let normal = if normal == [0.0; 3] { [0.0, 0.0, 1.0] } else { normal };
        let pixel = center[2] / camera.intrinsics.fx.max(camera.intrinsics.fy) as f32;
        Some(Self { center, normal, radius: disc.radius.clamp(SMALLEST * pixel, LARGEST * pixel) })
    }

    /// Calls `f(pixel, depth, offset)` for every pixel centre whose ray meets the disc: depth there, and from its centre
    /// to there over its radius, across the view.
    fn pixels(&self, camera: &Camera, mut f: impl FnMut(usize, f32, [f32; 2])) {
        let k = &camera.intrinsics;
        let ([fx, fy], [cx, cy]) = ([k.fx, k.fy].map(|v| v as f32), [k.cx, k.cy].map(|v| v as f32));
        let [x, y, z] = self.center;
        // A ball around it is at most this wide; nearer than its centre it looks larger.
        let reach = self.radius / (z - self.radius).max(0.5 * z);
        let span = |at: f32, reach: f32, size: usize| {
            let low = (at - reach - 0.5).ceil().max(0.0);
            (low as usize, (at + reach + 0.5).floor().clamp(0.0, size as f32) as usize)
        };
        let (u, v) = (fx * x / z + cx, fy * y / z + cy);
        let stretch = |t: f32| 1.0 + t.abs();
        let (x0, x1) = span(u, fx * reach * stretch(x / z), camera.width);
        let (y0, y1) = span(v, fy * reach * stretch(y / z), camera.height);
        let n = self.normal;
        let along = n[0] * x + n[1] * y + n[2] * z;
        for py in y0..y1 {
            for px in x0..x1 {
                let ray = [(px as f32 + 0.5 - cx) / fx, (py as f32 + 0.5 - cy) / fy];
                let slope = n[0] * ray[0] + n[1] * ray[1] + n[2];
                let depth = along / slope;
                if !depth.is_finite() || depth <= 0.0 {
                    continue;
                }
                let off = [depth * ray[0] - x, depth * ray[1] - y, depth - z];
                if off.iter().map(|v| v * v).sum::<f32>() <= self.radius * self.radius {
                    f(py * camera.width + px, depth, [off[0] / self.radius, off[1] / self.radius]);
                }
            }
        }
    }
}

/// Sums over the discs of a pixel's front surface.
#[derive(Clone, Copy, Default)]
struct Blend {
    weight: f32,
    inverse: f32,
    offset: [f32; 2],
    count: u16,
}

fn cloud(discs: &[Disc], camera: &Camera) -> Vec<f32> {
    let (w, h) = (camera.width, camera.height);
    let mut front = vec![f32::INFINITY; w * h];
    let seen = || discs.iter().filter_map(|d| SeenDisc::new(d, camera));
    for disc in seen() {
        disc.pixels(camera, |p, depth, _| front[p] = front[p].min(depth));
    }
    let mut blends = vec![Blend::default(); w * h];
    for disc in seen() {
        disc.pixels(camera, |p, depth, offset| {
            if depth <= front[p] * (1.0 + THICK) + disc.radius {
                let weight = 1.01 - (offset[0] * offset[0] + offset[1] * offset[1]).min(1.0);
                let b = &mut blends[p];
                b.weight += weight;
                b.inverse += weight / depth;
                (0..2).for_each(|k| b.offset[k] += weight * offset[k]);
                b.count = b.count.saturating_add(1);
            }
        });
    }
    let value = |b: &Blend| {
        let around = b.offset.iter().map(|o| (o / b.weight).powi(2)).sum::<f32>() <= AROUND * AROUND;
        if b.count >= FEWEST && around { b.weight / b.inverse } else { 0.0 }
    };
    let depth: Vec<f32> = blends.iter().map(value).collect();
    without_edges(&depth, w)
}

/// Without pixels at edges of depth: a disc reaches over the edge of its surface.
fn without_edges(depth: &[f32], width: usize) -> Vec<f32> {
    let height = depth.len() / width.max(1);
    let pixel = |p: usize| {
        let (x, y, own) = (p % width, p / width, depth[p]);
        let bent = |before: usize, after: usize| {
            let [a, b] = [before, after].map(|q| depth[q]);
            a > 0.0 && b > 0.0 && (0.5 * own * (1.0 / a + 1.0 / b) - 1.0).abs() > EDGE
        };
        let inside = |at: usize, size: usize| at > 0 && at + 1 < size;
        let edge = inside(x, width) && bent(p - 1, p + 1) || inside(y, height) && bent(p - width, p + width);
        if own > 0.0 && edge { 0.0 } else { own }
    };
    (0..depth.len()).map(pixel).collect()
}

#[cfg(test)]
mod tests {
    use super::super::surface::Surface;
    use super::*;
    use splat4d::math::{Rng, Se3};

    const SIZE: [usize; 2] = [60, 40];

    fn camera() -> Camera {
        Camera::with_fov_y(Se3::IDENTITY, 0.8, SIZE[0], SIZE[1])
    }

    /// A wall z = depth + slope x, |x|, |y| < half, of points at random with noise along z.
    fn wall(depth: f64, slope: f64, half: f64, count: u64, noise: f64) -> Vec<[f64; 3]> {
        let rng = Rng::new(4, "wall", depth.to_bits());
        (0..count)
            .map(|i| {
                let [x, y] = [0, 1].map(|k| half * (2.0 * rng.uniform(3 * i + k) - 1.0));
                [x, y, depth + slope * x + noise * rng.normal(3 * i + 2)]
            })
            .collect()
    }

    fn render_points(points: Vec<[f64; 3]>) -> Vec<f32> {
        render(&Placed::new(&Surface { points, ..Surface::default() }), &camera())
    }

    /// Depth of the wall at a pixel.
    fn truth(p: usize, depth: f64, slope: f64) -> f64 {
        let k = camera().intrinsics;
        depth / (1.0 - slope * ((p % SIZE[0]) as f64 + 0.5 - k.cx) / k.fx)
    }

    /// Share of known pixels, and the median and largest relative error of them.
    fn errors(map: &[f32], depth: f64, slope: f64) -> [f64; 3] {
        let off = |(p, z): (usize, &f32)| (*z > 0.0).then(|| (f64::from(*z) / truth(p, depth, slope) - 1.0).abs());
        let mut off: Vec<f64> = map.iter().enumerate().filter_map(off).collect();
        off.sort_by(f64::total_cmp);
        [off.len() as f64 / map.len() as f64, off[off.len() / 2], off[off.len() - 1]]
    }

    #[test]
    fn points_behind_a_sparse_wall_do_not_shine_through() {
        // About 300 points of the front wall are in the image, 8 pixels a point; the wall behind is ten times as dense.
        let points = [wall(4.0, 0.0, 3.0, 700, 0.0), wall(5.0, 0.0, 4.0, 12_000, 0.0)].concat();
        let [share, _, worst] = errors(&render_points(points), 4.0, 0.0);
        assert!(share > 0.85 && worst < 1e-3, "{share} {worst}");
    }

    #[test]
    fn slanted_surfaces_and_noise_keep_the_depth() {
        let [share, median, worst] = errors(&render_points(wall(4.0, 1.2, 6.0, 20_000, 0.0)), 4.0, 1.2);
        assert!(share > 0.6 && median < 1e-4 && worst < 2e-3, "{share} {median} {worst}");
        let [share, median, worst] = errors(&render_points(wall(4.0, 0.3, 3.0, 20_000, 0.005)), 4.0, 0.3);
        assert!(share > 0.9 && median < 1e-3 && worst < 6e-3, "{share} {median} {worst}");
    }

    #[test]
    fn holes_edges_and_lone_points_are_no_measurement() {
        let k = camera().intrinsics;
        let inside = |p: usize, half: f64| {
            let [x, y] =
                [(p % SIZE[0], k.cx, k.fx), (p / SIZE[0], k.cy, k.fy)].map(|(i, c, f)| 4.0 * (i as f64 + 0.5 - c) / f);
            x.abs() < half && y.abs() < half
        };
        // A square in front of nothing, with a hole in its middle, and a lone point before it.
        let square = wall(4.0, 0.0, 1.2, 9_000, 0.0).into_iter().filter(|p| p[0].abs() > 0.5 || p[1].abs() > 0.5);
        let map = render_points(square.chain([[0.8, 0.0, 2.0]]).collect());
        let spread = 0.04;
        for (p, z) in map.iter().enumerate() {
            let (solid, out) = (
                inside(p, 1.2 - 2.0 * spread) && !inside(p, 0.5 + 2.0 * spread),
                !inside(p, 1.2 + spread) || inside(p, 0.5 - spread),
            );
            assert!(!out || *z == 0.0, "pixel {p}: {z}");
            // The lone point hides a few pixels.
            assert!(!solid || *z == 0.0 || (z - 4.0).abs() < 1e-3, "pixel {p}: {z}");
        }
        let known = map.iter().filter(|z| **z > 0.0).count();
        let all = (0..map.len()).filter(|&p| inside(p, 1.2) && !inside(p, 0.5)).count();
        assert!(known as f64 > 0.8 * all as f64, "{known} of {all}");
    }

    #[test]
    fn a_mesh_has_the_exact_depth_of_its_triangles_also_across_the_near_plane() {
        // Two triangles that reach behind the camera, and a square in front of a part of them.
        let (a, b) = (0.5, 3.0);
        let floor = [[-9.0, a, -5.0], [9.0, a, -5.0], [9.0, a, 40.0], [-9.0, a, 40.0]];
        let square = [[-0.3, -0.3, b], [0.3, -0.3, b], [0.3, 0.3, b], [-0.3, 0.3, b]];
        let points: Vec<[f64; 3]> = floor.into_iter().chain(square).collect();
        let triangles = vec![[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]];
        let map = render(&Placed::new(&Surface { points, triangles, ..Surface::default() }), &camera());
        let k = camera().intrinsics;
        for (p, z) in map.iter().enumerate() {
            let ray = [((p % SIZE[0]) as f64 + 0.5 - k.cx) / k.fx, ((p / SIZE[0]) as f64 + 0.5 - k.cy) / k.fy];
            let floor = Some(a / ray[1]).filter(|z| (0.0..40.0).contains(z) && (ray[0] * z).abs() < 9.0);
            let square = (ray[0].abs() < 0.1 && ray[1].abs() < 0.1).then_some(b);
            let truth = square.into_iter().chain(floor).fold(f64::INFINITY, f64::min);
            let expected = if truth.is_finite() { truth } else { 0.0 };
            assert!((f64::from(*z) - expected).abs() < 1e-4 * expected.max(1.0), "pixel {p}: {z} {expected}");
        }
    }
}
