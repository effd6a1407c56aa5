//! Visibility: which triangle each sample sees, by homogeneous rasterisation with a depth buffer.
//!
//! With the camera-space corners of a triangle as the columns of V, the ray direction d = ((x−cx)/f, (y−cy)/f, 1)
//! through a sample meets the triangle's plane at weights b ∝ e = V⁻¹d; the sample is inside when all eᵢ ≥ 0, and
//! 1/z = Σ eᵢ. So perspective-correct weights, clipping and double-sidedness come from one linear function of (x, y).
//! Source: Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997.

use crate::camera::Camera;
use crate::mesh::Mesh;
use crate::vector::V3;

/// Samples per pixel in each direction. Odd, so that the middle sample is the pixel's centre.
pub(crate) const SUPERSAMPLING: usize = 3;
/// Nothing nearer than this is rendered (scene units).
const NEAR: f64 = 0.05;
/// Marks a sample that sees nothing.
pub(crate) const NOTHING: u32 = u32::MAX;

/// The linear function that gives a triangle's perspective-correct weights at a sample.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Edges {
    /// V⁻¹, rows.
    inverse: [V3; 3],
}

impl Edges {
    /// From camera-space corners; `None` for a triangle seen edge-on.
    pub(crate) fn new(corners: [V3; 3]) -> Option<Edges> {
        let [a, b, c] = corners;
        let rows = [b.cross(c), c.cross(a), a.cross(b)];
        let det = a.dot(rows[0]);
        (det.abs() > 1e-14).then(|| Edges { inverse: rows.map(|r| r * (1.0 / det)) })
    }

    /// e at ray direction `d` (z = 1).
    fn at(&self, d: V3) -> [f64; 3] {
        [self.inverse[0].dot(d), self.inverse[1].dot(d), self.inverse[2].dot(d)]
    }

    /// Weights (sum 1) and depth of the point of the triangle's plane on the ray.
    pub(crate) fn weights(&self, d: V3) -> ([f64; 3], f64) {
        let e = self.at(d);
        let z = 1.0 / (e[0] + e[1] + e[2]);
        (e.map(|v| v * z), z)
    }
}

/// Visible triangle and inverse depth at every sample of one image.
pub(crate) struct Visibility {
    /// Samples across.
    pub width: usize,
    /// Samples down.
    pub height: usize,
    /// Triangle index or [`NOTHING`], row by row.
    pub triangles: Vec<u32>,
    /// 1/z; 0 where nothing is seen.
    pub inverse_depths: Vec<f32>,
}

/// The ray through sample (column, row), z = 1.
pub(crate) fn sample_ray(camera: &Camera, column: usize, row: usize) -> V3 {
    let scale = 1.0 / (SUPERSAMPLING as f64 * camera.focal);
    let half = 0.5 * SUPERSAMPLING as f64;
    V3 {
        x: (column as f64 + 0.5 - half * camera.width as f64) * scale,
        y: (row as f64 + 0.5 - half * camera.height as f64) * scale,
        z: 1.0,
    }
}

/// Camera-space corners of triangle `index`.
pub(crate) fn corners(mesh: &Mesh, camera: &Camera, index: usize) -> [V3; 3] {
    mesh.triangles[index].vertices.map(|v| camera.to_camera_axes(mesh.positions[v as usize]))
}

/// Renders the whole mesh.
pub(crate) fn rasterize(mesh: &Mesh, camera: &Camera) -> Visibility {
    let (width, height) = (camera.width * SUPERSAMPLING, camera.height * SUPERSAMPLING);
    let mut out = Visibility {
        width,
        height,
        triangles: vec![NOTHING; width * height],
        inverse_depths: vec![0.0; width * height],
    };
    let points: Vec<V3> = mesh.positions.iter().map(|p| camera.to_camera_axes(*p)).collect();
    for (index, triangle) in mesh.triangles.iter().enumerate() {
        let corners = triangle.vertices.map(|v| points[v as usize]);
        if corners.iter().all(|c| c.z <= NEAR) {
            continue;
        }
        let Some(edges) = Edges::new(corners) else { continue };
        let Some([x0, x1, y0, y1]) = bounds(corners, camera, width, height) else { continue };
        for row in y0..y1 {
            let d = sample_ray(camera, x0, row);
            let mut e = edges.at(d);
            let step = 1.0 / (SUPERSAMPLING as f64 * camera.focal);
            let steps = edges.inverse.map(|r| r.x * step);
            for column in x0..x1 {
                if e[0] >= 0.0 && e[1] >= 0.0 && e[2] >= 0.0 {
                    let inverse_depth = (e[0] + e[1] + e[2]) as f32;
                    let at = row * width + column;
                    if inverse_depth > out.inverse_depths[at] && inverse_depth < (1.0 / NEAR) as f32 {
                        out.inverse_depths[at] = inverse_depth;
                        out.triangles[at] = index as u32;
                    }
                }
                for i in 0..3 {
                    e[i] += steps[i];
                }
            }
        }
    }
    out
}

/// Sample columns and rows a triangle may touch (the whole image when it crosses the near plane).
fn bounds(corners: [V3; 3], camera: &Camera, width: usize, height: usize) -> Option<[usize; 4]> {
    if corners.iter().any(|c| c.z <= NEAR) {
        return Some([0, width, 0, height]);
    }
    let s = SUPERSAMPLING as f64 * camera.focal;
    let range = |values: [f64; 3], size: usize| {
        let low = values.iter().copied().fold(f64::INFINITY, f64::min) + 0.5 * size as f64;
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max) + 0.5 * size as f64;
        ((low - 1.0).clamp(0.0, size as f64) as usize, (high + 1.0).clamp(0.0, size as f64) as usize)
    };
    let (x0, x1) = range(corners.map(|c| s * c.x / c.z), width);
    let (y0, y1) = range(corners.map(|c| s * c.y / c.z), height);
    (x0 < x1 && y0 < y1).then_some([x0, x1, y0, y1])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vector::v3;

    fn camera() -> Camera {
        Camera::look_at("test".into(), v3(0.0, 0.0, 4.0), v3(0.0, 0.0, 0.0), 40.0, 32, 24)
    }

    #[test]
    fn weights_are_perspective_correct() {
        let corners = [v3(-1.0, -1.0, 2.0), v3(1.5, -0.5, 7.0), v3(0.0, 1.0, 3.0)];
        let edges = Edges::new(corners).expect("not edge-on");
        let (weights, z) = edges.weights(v3(-0.02, 0.05, 1.0));
        let point = corners[0] * weights[0] + corners[1] * weights[1] + corners[2] * weights[2];
        assert!((point - v3(-0.02, 0.05, 1.0) * z).length() < 1e-12, "the weighted corners lie on the ray");
        assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        // Interpolation linear on the screen would give another depth: the test must distinguish the two.
        let screen = |c: V3| (c.x / c.z, c.y / c.z);
        let [(ax, ay), (bx, by), (cx, cy)] = corners.map(screen);
        let det = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay);
        let wb = ((-0.02 - ax) * (cy - ay) - (cx - ax) * (0.05 - ay)) / det;
        let wc = ((bx - ax) * (0.05 - ay) - (-0.02 - ax) * (by - ay)) / det;
        let affine = corners[0].z * (1.0 - wb - wc) + corners[1].z * wb + corners[2].z * wc;
        assert!((affine - z).abs() > 0.1);
    }

    #[test]
    fn the_nearer_quad_wins_and_a_floor_through_the_camera_is_clipped() {
        let mut mesh = Mesh::default();
        mesh.quad(v3(-1.0, -1.0, 0.0), v3(2.0, 0.0, 0.0), v3(0.0, 2.0, 0.0), [0.0; 2], 0, 1);
        mesh.quad(v3(-9.0, -9.0, -2.0), v3(18.0, 0.0, 0.0), v3(0.0, 18.0, 0.0), [0.0; 2], 0, 2);
        // From far behind the camera to far in front of it.
        mesh.quad(v3(-50.0, -1.5, 50.0), v3(100.0, 0.0, 0.0), v3(0.0, 0.0, -100.0), [0.0; 2], 0, 3);
        let seen = rasterize(&mesh, &camera());
        let object = |column: usize, row: usize| {
            let index = seen.triangles[row * seen.width + column];
            if index == NOTHING { 0 } else { mesh.triangles[index as usize].object }
        };
        assert_eq!(object(48, 36), 1, "the near quad covers the middle");
        assert_eq!(object(3, 3), 2, "the far quad covers the corner");
        assert_eq!(object(48, 71), 3, "the floor reaches the lower edge");
        assert!(seen.triangles.iter().all(|t| *t != NOTHING), "no sample is empty");
        let middle = seen.inverse_depths[36 * seen.width + 48];
        assert!((middle - 0.25).abs() < 1e-6, "the near quad lies at depth 4, found 1/{}", 1.0 / middle);
    }
}
