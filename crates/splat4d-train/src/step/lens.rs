//! Renders through the lens of a camera whose distortion is learnt: centres of Gaussians move as the lens bends their
//! rays.
//!
//! A ray (x, y, 1) lands where the pinhole ray (x, y) (1 + k1 r² + k2 r⁴) would, r² = x² + y². Covariances stay, which
//! neglects that the lens stretches a Gaussian by up to three times as many percent as it moves it.

use crate::train_state::corner;
use rayon::prelude::*;
use splat4d::math::Real;
use splat4d::math::se3::{cross, mat_vec, transpose};
use splat4d::render::RenderGrads;
use splat4d::scene::{Camera, Lens, Splats, Table};

/// Beyond this many times the squared radius of the farthest corner the shift stays the same share: a polynomial
/// would fold.
const BEYOND: f64 = 1.5;

/// A lens of two coefficients.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bend<'a> {
    camera: &'a Camera,
    k: [f64; 2],
    most: f64,
}

/// A Gaussian's centre in the axes of a camera, and its shift.
struct Ray {
    at: [f64; 3],
    r2: f64,
    /// 1 + k1 r² + k2 r⁴ and its derivative by r².
    scale: [f64; 2],
}

impl<'a> Bend<'a> {
    /// Of a camera that has such a lens.
    pub(crate) fn of(camera: &'a Camera) -> Option<Self> {
        let Lens::Brown { k: [k1, k2, ..], .. } = camera.lens else { return None };
        Some(Self { camera, k: [k1, k2], most: BEYOND * corner(camera) })
    }

    /// A centre before the camera; `None`: it is behind it.
    fn ray(&self, mean: [f64; 3]) -> Option<Ray> {
        let at = self.camera.cam_from_world.apply(mean);
        if at[2] <= self.camera.near {
            return None;
        }
        let r2 = (at[0] * at[0] + at[1] * at[1]) / (at[2] * at[2]);
        let [k1, k2] = self.k;
        let kept = r2.min(self.most);
        let slope = if r2 < self.most { k1 + 2.0 * k2 * r2 } else { 0.0 };
        Some(Ray { at, r2: kept, scale: [1.0 + kept * (k1 + kept * k2), slope] })
    }
}

/// Splats of all layers, moved by a lens.
#[derive(Default)]
pub(crate) struct Bent<F: Real> {
    tables: Vec<Table<F>>,
    /// Centres before the lens.
    means: Vec<Vec<[F; 3]>>,
    rows: Vec<[F; 3]>,
}

impl<F: Real> Bent<F> {
    /// Moves the splats.
    pub(crate) fn bend<'b>(&'b mut self, splats: &mut Splats<'b, F>, bend: &Bend<'_>) {
        self.tables.resize_with(splats.parts.len(), Table::default);
        self.means.resize_with(splats.parts.len(), Vec::new);
        let back = transpose(&bend.camera.cam_from_world.rotation);
        for (part, (table, means)) in splats.parts.iter().zip(self.tables.iter_mut().zip(&mut self.means)) {
            let moved = |j: usize| {
                let mean = part.out.read::<3>(j, 0);
                let Some(ray) = bend.ray(mean.map(Real::f64)) else { return mean };
                let by = ray.scale[0] - 1.0;
                let shift = mat_vec(&back, [by * ray.at[0], by * ray.at[1], 0.0]);
                std::array::from_fn(|k| mean[k] + F::of(shift[k]))
            };
            let count = part.out.rows();
            (0..count).into_par_iter().with_min_len(512).map(moved).collect_into_vec(&mut self.rows);
            table.clone_from(part.out);
            means.clear();
            means.extend((0..count).map(|j| part.out.read::<3>(j, 0)));
            self.rows.iter().enumerate().for_each(|(j, row)| table.write(j, 0, *row));
        }
        splats.parts.iter_mut().zip(&self.tables).for_each(|(part, table)| part.out = table);
    }

    /// The VJP of [`bend`](Self::bend): turns gradients to moved centres and to the pose into those before the
    /// lens, and returns those to its coefficients.
    pub(crate) fn backward(&self, d: &mut RenderGrads<F>, bend: &Bend<'_>) -> [f64; 2] {
        let rotation = bend.camera.cam_from_world.rotation;
        let back = transpose(&rotation);
        let mut d_k = [0.0; 2];
        for (part, means) in d.parts.iter_mut().zip(&self.means) {
            for (j, mean) in means.iter().enumerate() {
                let own = part.out.read::<3>(j, 0);
                if own == [F::ZERO; 3] {
                    continue;
                }
                let Some(ray) = bend.ray(mean.map(Real::f64)) else { continue };
                let (g, [x, y, z]) = (mat_vec(&rotation, own.map(Real::f64)), ray.at);
                let [scale, slope] = ray.scale;
                let along = g[0] * x + g[1] * y;
                d_k[0] += along * ray.r2;
                d_k[1] += along * ray.r2 * ray.r2;
                let d_r2 = along * slope * 2.0 / (z * z);
                let before = [scale * g[0] + d_r2 * x, scale * g[1] + d_r2 * y, g[2] - d_r2 * (x * x + y * y) / z];
                let (turned, counted) = (cross(ray.at, before), cross([scale * x, scale * y, z], g));
                for k in 0..3 {
                    d.camera[k] += before[k] - g[k];
                    d.camera[k + 3] += turned[k] - counted[k];
                }
                part.out.write(j, 0, mat_vec(&back, before).map(F::of));
            }
        }
        d_k
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Distortion;
    use splat4d::math::Se3;
    use splat4d::scene::splats::{Color, Part};

    #[test]
    fn centres_land_where_images_are_undistorted_from() {
        let pose = Se3::look_at([1.0, 0.4, -3.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let plain = Camera::with_fov_y(pose, 0.8, 64, 48);
        let k = [-0.12, 0.04];
        let lens = Lens::Brown { k: [k[0], k[1], 0.0, 0.0, 0.0, 0.0], p: [0.0; 2], s: [0.0; 4] };
        let camera = Camera { lens, ..plain.clone() };
        // One is at the border, one behind the camera.
        let points = [[0.3, -0.2, 0.1], [-1.2, 0.9, 0.4], [2.0, 1.0, -6.0]];
        let mut table = Table::<f64>::new(&[("row", 10)], points.len());
        points.iter().enumerate().for_each(|(j, p)| table.write(j, 0, *p));
        let colors = Table::<f64>::new(&[("color", 3)], points.len());
        let mut bent = Bent::default();
        let mut splats = Splats { parts: vec![Part::new(&table, Color::Direct { table: &colors })], head: None };
        bent.bend(&mut splats, &Bend::of(&camera).unwrap());
        let after = Distortion::after(Lens::Pinhole, k);
        let i = plain.intrinsics;
        for (j, point) in points.iter().enumerate() {
            let found = splats.parts[0].out.read::<3>(j, 0);
            let Some(([u, v], _)) = plain.project(*point) else {
                assert_eq!(found, *point, "what is behind the camera stays");
                continue;
            };
            let [x, y] = after.distort([(u - i.cx) / i.fx, (v - i.cy) / i.fy]).unwrap();
            let ([u, v], _) = plain.project(found).unwrap();
            assert!((u - i.fx * x - i.cx).abs() < 1e-9 && (v - i.fy * y - i.cy).abs() < 1e-9, "point {j}: {u} {v}");
        }
        assert!(Bend::of(&plain).is_none());
    }
}
