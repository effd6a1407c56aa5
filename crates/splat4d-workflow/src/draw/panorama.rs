//! Equirectangular images: the whole sphere around a camera, from pinhole views that overlap.
//!
//! Views lie in bands of equal latitude. Where they overlap they are cross-faded, because a splat's ellipse and the
//! order by depth differ a little from view to view.

use rayon::prelude::*;
use splat4d::math::Se3;
use splat4d::math::se3::{cross, mat_vec};
use splat4d::render::{Image, Shot};
use splat4d::scene::{Camera, Intrinsics, Lens};
use std::f64::consts::{PI, TAU};

/// Angle between the middles of neighbouring views: of 6, 14, 26, 56 and 96 views, 56 are the last that gain 2 dB for a
/// third more time (`studies/records/2026-11-28-film-renders.md`).
const SPACING: f64 = PI / 6.0;
/// A view reaches this share of the spacing beyond the middle between two, and fades over twice as much.
const MARGIN: f64 = 0.1;
/// Pixels of a view per pixel of the image, on each axis, in the view's middle.
const DENSITY: f64 = 1.5;

/// A raster of directions: longitude across, latitude down; the camera looks at its middle.
#[derive(Clone, Debug)]
pub struct Panorama {
    /// Pixels across: twice those down.
    width: usize,
    views: Vec<View>,
    /// What was rendered last, kept for its memory.
    image: Image,
}

/// A pinhole view of it.
#[derive(Clone, Debug)]
struct View {
    /// Rows: the view's axes in those of the camera.
    rotation: [[f64; 3]; 3],
    /// Pixels of each side, and of the focal length.
    side: usize,
    focal: f64,
    /// Tangents at which the view begins to fade, and ends.
    fade: [f64; 2],
    /// What it adds to the image.
    shares: Vec<Share>,
}

/// A view's share in a pixel.
#[derive(Clone, Copy, Debug)]
struct Share {
    /// The pixel, and the view's pixel up and left of the place that it shows.
    pixel: u32,
    source: u32,
    /// How far the place is to the right and down of that.
    offset: [f32; 2],
    /// All weights of a pixel are 1.
    weight: f32,
    /// Length of the ray at z = 1.
    ray: f32,
}

impl Panorama {
    /// Of `width` by `width`/2 pixels.
    pub fn new(width: usize) -> Self {
        Self::spaced(width, SPACING)
    }

    /// With views this far apart: π over a whole number.
    fn spaced(width: usize, spacing: f64) -> Self {
        let fade = [1.0 - 2.0 * MARGIN, 1.0 + 2.0 * MARGIN].map(|k| (0.5 * k * spacing).tan());
        let focal = DENSITY * width as f64 / TAU;
        let side = (2.0 * fade[1] * focal).ceil() as usize + 2;
        let bands = (PI / spacing).round() as usize;
        let mut views = Vec::new();
        for band in 0..=bands {
            let latitude = PI * (band as f64 / bands as f64 - 0.5);
            // A band is widest where it is nearest to the equator.
            let widest = (latitude.abs() - 0.5 * spacing).max(0.0).cos();
            let pole = band == 0 || band == bands;
            let count = if pole { 1 } else { (TAU * widest / spacing - 1e-9).ceil() as usize };
            for i in 0..count {
                let longitude = TAU * i as f64 / count as f64;
                let ((sin_p, cos_p), (sin_l, cos_l)) = (latitude.sin_cos(), longitude.sin_cos());
                let forward = [cos_p * sin_l, -sin_p, cos_p * cos_l];
                let right = [cos_l, 0.0, -sin_l];
                let rotation = [right, cross(forward, right), forward];
                views.push(View { rotation, side, focal, fade, shares: Vec::new() });
            }
        }
        views.par_iter_mut().for_each(|view| view.shares = view.shares_of(width));
        let mut weights = vec![0.0; width * (width / 2)];
        views.iter().flat_map(|v| &v.shares).for_each(|s| weights[s.pixel as usize] += s.weight);
        views.iter_mut().flat_map(|v| &mut v.shares).for_each(|s| s.weight /= weights[s.pixel as usize]);
        Self { width, views, image: Image::default() }
    }

    /// Pixels across and down.
    pub fn size(&self) -> [usize; 2] {
        [self.width, self.width / 2]
    }

    /// Renders a shot's sphere: `draw` renders a pinhole view. Depth becomes the distance from the camera.
    pub(super) fn render(&mut self, shot: &Shot<'_>, draw: &mut dyn FnMut(&Shot<'_>, &mut Image), out: &mut Image) {
        let [width, height] = self.size();
        let planes = [&mut out.color, &mut out.alpha, &mut out.depth, &mut out.extra];
        let counts = [3, 1, usize::from(shot.depth), shot.extra.map_or(0, |e| e.width())];
        planes.into_iter().zip(counts).for_each(|(planes, count)| planes.reset(count, height, width));
        let mut image = std::mem::take(&mut self.image);
        for view in &self.views {
            let camera = view.camera(shot.camera);
            draw(&Shot { camera: &camera, ..*shot }, &mut image);
            let sums = [&mut out.color, &mut out.alpha, &mut out.depth, &mut out.extra];
            let parts = [&image.color, &image.alpha, &image.depth, &image.extra];
            for (k, (sums, part)) in sums.into_iter().zip(parts).enumerate() {
                let (pixels, plane) = (sums.pixels().max(1), view.side * view.side);
                let planes = sums.data.par_chunks_mut(pixels).zip(part.data.par_chunks(plane));
                planes.for_each(|(sums, plane)| view.add(plane, sums, k == 2));
            }
        }
        self.image = image;
    }

    /// Pixel of a point in camera axes.
    pub fn project(&self, [x, y, z]: [f64; 3]) -> [f64; 2] {
        let [width, height] = self.size().map(|n| n as f64);
        [(x.atan2(z) / TAU + 0.5) * width, (y.atan2(x.hypot(z)) / PI + 0.5) * height]
    }
}

impl View {
    /// The view of a camera.
    fn camera(&self, of: &Camera) -> Camera {
        let turn = Se3 { rotation: self.rotation, translation: [0.0; 3] };
        let middle = 0.5 * self.side as f64;
        Camera {
            cam_from_world: turn.after(&of.cam_from_world),
            intrinsics: Intrinsics { fx: self.focal, fy: self.focal, cx: middle, cy: middle },
            lens: Lens::Pinhole,
            width: self.side,
            height: self.side,
            near: of.near,
        }
    }

    /// What the view adds to an image of this width; weights are not yet those of a mean.
    fn shares_of(&self, width: usize) -> Vec<Share> {
        let height = width / 2;
        let mut out = Vec::new();
        for v in 0..height {
            let (sin, cos) = (((v as f64 + 0.5) / height as f64 - 0.5) * PI).sin_cos();
            for u in 0..width {
                let (sin_l, cos_l) = (((u as f64 + 0.5) / width as f64 - 0.5) * TAU).sin_cos();
                let [x, y, z] = mat_vec(&self.rotation, [cos * sin_l, sin, cos * cos_l]);
                let weight = if z > 0.0 { self.weight(x / z) * self.weight(y / z) } else { 0.0 };
                if weight > 0.0 {
                    let side = self.side as f64;
                    let place = [x / z, y / z].map(|t| (t * self.focal + 0.5 * side - 0.5).clamp(0.0, side - 1.001));
                    let at = place.map(|p| p as usize);
                    out.push(Share {
                        pixel: (v * width + u) as u32,
                        source: (at[1] * self.side + at[0]) as u32,
                        offset: [0, 1].map(|k| (place[k] - at[k] as f64) as f32),
                        weight: weight as f32,
                        ray: (1.0 / z) as f32,
                    });
                }
            }
        }
        out
    }

    /// Adds a plane of the view to one of the image, bilinear. `rays`: times the length of a ray of z = 1.
    fn add(&self, plane: &[f32], sums: &mut [f32], rays: bool) {
        for share in &self.shares {
            let i = share.source as usize;
            let row = |i: usize| plane[i] + (plane[i + 1] - plane[i]) * share.offset[0];
            let value = row(i) + (row(i + self.side) - row(i)) * share.offset[1];
            let weight = if rays { share.weight * share.ray } else { share.weight };
            sums[share.pixel as usize] += weight * value;
        }
    }

    /// 1 inside, 0 outside, smooth between.
    fn weight(&self, tangent: f64) -> f64 {
        let [begins, ends] = self.fade;
        let u = ((ends - tangent.abs()) / (ends - begins)).clamp(0.0, 1.0);
        u * u * (3.0 - 2.0 * u)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::Source;
    use splat4d::device;
    use splat4d::play::Player;
    use splat4d::render::RenderConfig;
    use splat4d::scene::Time;
    use std::path::Path;

    /// The bundled scene's sphere from its middle, turned about the vertical axis by `turn` radians.
    fn sphere(panorama: &mut Panorama, turn: f64) -> Image {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let scene = Source::open(&root.join("examples/knight.s4d")).unwrap().scene;
        let mut player = Player::of_scene(&scene);
        let splats = player.at(Time(0.3)).unwrap();
        let eye = [0.4, 2.2, 1.6];
        let target = [eye[0] + turn.sin(), eye[1], eye[2] - turn.cos()];
        let pose = Se3::look_at(eye, target, [0.0, 1.0, 0.0]);
        let [w, h] = panorama.size();
        let camera = Camera::with_fov_y(pose, 1.0, w, h);
        let mut backend = device::cpu(RenderConfig::default());
        let shot = Shot { depth: true, ..Shot::new(&splats, &camera, scene.background) };
        let mut out = Image::default();
        panorama.render(&shot, &mut |shot, out| backend.render(shot, out).unwrap(), &mut out);
        out
    }

    fn psnr(a: &[f32], b: &[f32]) -> f64 {
        let square = |(a, b): (&f32, &f32)| f64::from(a.clamp(0.0, 1.0) - b.clamp(0.0, 1.0)).powi(2);
        -10.0 * (a.iter().zip(b).map(square).sum::<f64>() / a.len() as f64).log10()
    }

    #[test]
    fn a_turn_shifts_the_sphere_across_all_seams() {
        // 15 degrees: half of what is between two views.
        let mut panorama = Panorama::new(192);
        let (still, turned) = (sphere(&mut panorama, 0.0), sphere(&mut panorama, TAU / 24.0));
        let [w, h] = panorama.size();
        let row = |row: &[f32]| [&row[8..], &row[..8]].concat();
        let shifted: Vec<f32> = still.color.data.chunks(w).flat_map(row).collect();
        let likeness = psnr(&shifted, &turned.color.data);
        assert!(likeness > 39.0, "{likeness}");
        assert!(psnr(&still.color.data, &turned.color.data) < 30.0, "the scene differs from direction to direction");
        // Across the seam of longitude columns differ as little as elsewhere.
        let step = |a: usize, b: usize| -> f32 {
            let column = |y: usize| (still.color.get(0, y, a) - still.color.get(0, y, b)).abs();
            (0..h).map(column).sum::<f32>() / h as f32
        };
        let inside = (1..w).map(|x| step(x - 1, x)).fold(0.0, f32::max);
        assert!(step(w - 1, 0) <= inside, "{} {inside}", step(w - 1, 0));
        let finite = |planes: &splat4d::scene::Planes| planes.data.iter().all(|v| v.is_finite());
        assert!(finite(&still.color) && finite(&still.depth), "every direction is seen by a view");
    }

    #[test]
    fn a_point_is_where_it_is_projected_to() {
        let mut params = splat4d::scene::Params::<f32>::new(1, 1, &[]);
        let (x, pose) = ([-2.0, 1.5, -0.5], Se3::IDENTITY);
        params[splat4d::scene::GEOMETRY].write(0, 0, x);
        params[splat4d::scene::GEOMETRY].write(0, splat4d::scene::params::QUAT, [1.0, 0.0, 0.0, 0.0]);
        params[splat4d::scene::GEOMETRY].write(0, splat4d::scene::params::LOG_SCALE, [-3.5; 3]);
        params[splat4d::scene::GEOMETRY].set(0, splat4d::scene::params::OPACITY, 6.0);
        let motion = splat4d::motion::build(&splat4d::motion::Spec::Still, &mut params).unwrap();
        let layer = splat4d::layers::Layer::new("a", params, motion, splat4d::scene::LifeKind::Infinite);
        let scene = splat4d::layers::Scene { layers: vec![layer], ..Default::default() };
        let mut player = Player::of_scene(&scene);
        let splats = player.at(Time(0.0)).unwrap();
        let mut panorama = Panorama::new(256);
        let camera = Camera::with_fov_y(pose, 1.0, 256, 128);
        let mut backend = device::cpu(RenderConfig::default());
        let shot = Shot { depth: true, ..Shot::new(&splats, &camera, [0.0; 3]) };
        let mut image = Image::default();
        panorama.render(&shot, &mut |shot, out| backend.render(shot, out).unwrap(), &mut image);
        let (mut sum, mut at) = (0.0, [0.0; 2]);
        for (p, a) in image.alpha.data.iter().enumerate() {
            let a = f64::from(*a);
            let middle = [(p % 256) as f64 + 0.5, (p / 256) as f64 + 0.5];
            (sum, at) = (sum + a, [at[0] + a * middle[0], at[1] + a * middle[1]]);
        }
        let expected = panorama.project(x.map(f64::from));
        assert!((0..2).all(|k| (at[k] / sum - expected[k]).abs() < 0.1), "{at:?} {sum} {expected:?}");
        let pixel = expected[1] as usize * 256 + expected[0] as usize;
        let distance = image.depth.data[pixel] / image.alpha.data[pixel];
        assert!((f64::from(distance) - 6.5f64.sqrt()).abs() < 0.02, "{distance}");
    }
}
