//! Exposure: what a camera with a shutter and a lens records of a scene, as the mean of samples over both.
//!
//! The shutter's time is cut into equal parts and the lens into cells of equal area; a sample renders the middle of one
//! of each. Means are taken in linear light.
//!
//! Source: distributed ray tracing (Cook, Porter, Carpenter 1984). Gaussians that are spread along their motion within a
//! part were measured and are not better (`studies/records/2026-11-28-film-renders.md`).

use super::transfer::{add_light, display};
use super::{Painter, Rgb, byte, color_rgb, shoot};
use crate::paths::Shot as Frame;
use splat4d::render::Shot;
use splat4d::scene::{Camera, Planes, Time};
use splat4d_train::encode::{self, Pixels};

/// Angle between the points of a spiral that fills a disc evenly (Vogel 1979): the golden one.
const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;
/// Lens points are taken in steps of about this share of all, so that time and lens are not related.
const STRIDE: f64 = 0.618;

/// How light is gathered.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// How long the shutter is open, in frames; its middle is the frame's time. 0: no motion blur.
    pub shutter: f64,
    /// Diameter of the lens, scene units. 0: a pinhole.
    pub aperture: f64,
    /// Distance of what is sharp: z in camera axes, scene units.
    pub focus: f64,
    /// Images of which the mean is taken.
    pub samples: usize,
}

/// Camera and time at a share of a frame from its middle, −½ to ½.
pub type Course<'c> = &'c dyn Fn(f64) -> Frame;

/// An exposed image in linear light.
#[derive(Clone, Debug, Default)]
pub struct Light {
    /// Red, green, blue: over the background, or times alpha where there is none, [3, h, w].
    pub color: Planes<f32>,
    /// Opacity, [1, h, w].
    pub alpha: Planes<f32>,
}

impl Light {
    /// In 8 bits, over the background.
    pub fn rgb(&self) -> Rgb {
        color_rgb(&display(&self.color, None))
    }

    /// The bytes of a PNG file with alpha, colours not times alpha.
    pub fn png(&self) -> Vec<u8> {
        let (color, alpha) = (color_rgb(&display(&self.color, Some(&self.alpha))), &self.alpha.data);
        let data: Vec<u8> = color.data.chunks(3).zip(alpha).flat_map(|(c, a)| [c[0], c[1], c[2], byte(*a)]).collect();
        encode::png(Pixels::Eight(&data), [color.width, color.height], 4)
    }

    /// sRGB values times alpha.
    pub fn premultiplied(&self) -> Planes<f32> {
        let mut out = display(&self.color, Some(&self.alpha));
        for c in 0..3 {
            out.plane_mut(c).iter_mut().zip(&self.alpha.data).for_each(|(v, a)| *v *= a);
        }
        out
    }
}

impl Painter<'_> {
    /// Exposes an image; `transparent`: without the background.
    pub fn expose(&mut self, course: Course<'_>, exposure: &Exposure, transparent: bool) -> Light {
        let background = if transparent { [0.0; 3] } else { self.background };
        let (mut out, share) = (Light::default(), 1.0 / exposure.samples as f32);
        for i in 0..exposure.samples {
            let middle = ((i as f64 + 0.5) / exposure.samples as f64 - 0.5) * exposure.shutter;
            let frame = course(middle);
            let camera = through(&frame.camera, lens_point(i, exposure), exposure.focus);
            let splats = self.player.at(Time(frame.time)).expect("nothing is read for a scene in memory");
            let shot = Shot::new(&splats, &camera, background);
            shoot(&mut self.backend, self.listener, &mut self.panorama, &shot, &mut self.image);
            let image = &self.image;
            if i == 0 {
                out.color.reset(3, image.color.height, image.color.width);
                out.alpha.reset(1, image.alpha.height, image.alpha.width);
            }
            let alpha = transparent.then_some(&image.alpha.data[..]);
            for c in 0..3 {
                add_light(out.color.plane_mut(c), image.color.plane(c), alpha, share);
            }
            out.alpha.data.iter_mut().zip(&image.alpha.data).for_each(|(sum, a)| *sum += share * a);
        }
        out
    }
}

/// Where sample i looks through the lens, scene units from its centre.
fn lens_point(i: usize, exposure: &Exposure) -> [f64; 2] {
    let n = exposure.samples;
    if exposure.aperture <= 0.0 {
        return [0.0; 2];
    }
    let place = i * stride(n) % n;
    let radius = 0.5 * exposure.aperture * ((place as f64 + 0.5) / n as f64).sqrt();
    let angle = GOLDEN_ANGLE * place as f64;
    [radius * angle.cos(), radius * angle.sin()]
}

/// A step through n places that visits them all.
fn stride(n: usize) -> usize {
    let common = |mut a: usize, mut b: usize| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    (((n as f64 * STRIDE) as usize).max(1)..).find(|&s| common(s, n) == 1).expect("1 + n is among them")
}

/// The camera through another point of the lens: what is `focus` away stays where it is in the image.
fn through(camera: &Camera, [x, y]: [f64; 2], focus: f64) -> Camera {
    let mut out = camera.clone();
    out.cam_from_world.translation[0] -= x;
    out.cam_from_world.translation[1] -= y;
    out.intrinsics.cx += camera.intrinsics.fx * x / focus;
    out.intrinsics.cy += camera.intrinsics.fy * y / focus;
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Se3;

    #[test]
    fn lens_points_fill_the_disc_once() {
        for samples in [1, 2, 7, 8, 16, 33] {
            let exposure = Exposure { shutter: 0.0, aperture: 2.0, focus: 1.0, samples };
            let points: Vec<[f64; 2]> = (0..samples).map(|i| lens_point(i, &exposure)).collect();
            let mut radii: Vec<f64> = points.iter().map(|p| p[0].hypot(p[1])).collect();
            radii.sort_by(f64::total_cmp);
            let even = |(i, r): (usize, &f64)| (r - ((i as f64 + 0.5) / samples as f64).sqrt()).abs() < 1e-12;
            assert!(radii.iter().enumerate().all(even), "{samples}: {radii:?}");
        }
        assert_eq!(lens_point(3, &Exposure { shutter: 1.0, aperture: 0.0, focus: 1.0, samples: 8 }), [0.0; 2]);
    }

    #[test]
    fn the_focal_plane_stays_where_it_is() {
        let pose = Se3::look_at([1.0, 2.0, 5.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let camera = Camera::with_fov_y(pose, 0.8, 40, 30);
        let moved = through(&camera, [0.2, -0.1], 3.0);
        let at = |z: f64| {
            let x = camera.unproject([12.0, 20.0], z);
            moved.project(x).unwrap().0
        };
        assert!((at(3.0)[0] - 12.0).abs() < 1e-9 && (at(3.0)[1] - 20.0).abs() < 1e-9);
        // A circle of confusion: diameter · focal length · |1/focus − 1/z|.
        let blur = 0.2 * camera.intrinsics.fx * (1.0 / 3.0 - 1.0 / 6.0);
        assert!((at(6.0)[0] - 12.0 - blur).abs() < 1e-9);
    }
}
