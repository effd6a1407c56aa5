//! A few images, made small: their colours, foregrounds and features.

use super::super::lens::Distortion;
use super::super::picture::{self, Raster, Samples};
use super::super::{Capture, Frame};
use super::alpha::Fringe;
use crate::keypoints::features::{Feature, Limits, find};
use crate::keypoints::raster::grey;
use rayon::prelude::*;
use splat4d::math::Se3;
use splat4d::scene::{Camera, Lens, Planes};

/// Thoroughness of the examination of images.
#[derive(Clone, Copy, Debug)]
pub(super) struct Detail {
    /// Longest side of the small image, pixels.
    pub(super) side: usize,
    /// Features of an image.
    pub(super) features: usize,
}

/// Images for checks of poses.
pub(super) const COARSE: Detail = Detail { side: 320, features: 350 };
/// Images for the search for motion: a mover is a small part of an image.
pub(super) const FINE: Detail = Detail { side: 640, features: 800 };
/// Least contrast of a feature, as structure from motion takes it.
const CONTRAST: f64 = 0.004;
/// Weight of a mask or alpha from which a pixel shows something.
pub(super) const SHOWN: f32 = 0.5;
/// Foreground below this share of an image, or above the other, gives no information on a position.
const FOREGROUND: [f64; 2] = [0.001, 0.6];

/// A feature: its descriptor, and its ray without distortion (x/z, y/z).
pub(super) struct Mark {
    pub(super) feature: Feature,
    pub(super) ray: [f64; 2],
}

/// Foreground of an image by mask or alpha.
pub(super) struct Shown {
    /// [height · width] of the small image, from 0 to 1.
    pub(super) weights: Vec<f32>,
    /// Share of the image.
    pub(super) share: f64,
    /// Share of the pixels along its edge.
    pub(super) of_edge: f64,
    /// Whether a mask states it, not alpha.
    pub(super) of_mask: bool,
}

/// A small image.
pub(super) struct SmallImage {
    /// Its frame of the capture.
    pub(super) frame: usize,
    /// The camera of the image file.
    pub(super) camera: Camera,
    lens: Distortion,
    color: Planes<f32>,
    /// Pixels of the file along one of the small image's.
    factor: usize,
    /// The ray to the middle of its foreground, where it has one.
    pub(super) foreground: Option<[f64; 2]>,
    /// The same of what its mask or alpha hides.
    pub(super) hidden: Option<[f64; 2]>,
    /// How much of it is shown, by its mask or alpha; `None`: it has none.
    pub(super) shown: Option<Shown>,
    /// How half-transparent pixels of the file differ from those next to them.
    pub(super) fringe: Fringe,
    pub(super) marks: Vec<Mark>,
}

/// Reads the images of these frames; those that cannot be read are left out.
pub(super) fn take(capture: &Capture, frames: &[usize], detail: Detail) -> Vec<SmallImage> {
    frames
        .par_iter()
        .filter_map(|&i| SmallImage::read(i, &capture.frames[i], capture.background, detail.side))
        .collect()
}

/// The image of a frame with or without its EXIF orientation.
pub(super) fn one(capture: &Capture, frame: usize, upright: bool) -> Option<SmallImage> {
    SmallImage::read(frame, &Frame { upright, ..capture.frames[frame].clone() }, capture.background, COARSE.side)
}

/// Finds the features of all.
pub(super) fn describe(images: &mut [SmallImage], detail: Detail) {
    describe_each(&mut images.iter_mut().collect::<Vec<_>>(), detail);
}

/// [`describe`] of some.
pub(super) fn describe_each(images: &mut [&mut SmallImage], detail: Detail) {
    images.par_iter_mut().for_each(|look| {
        let limits = Limits { contrast: CONTRAST, most: detail.features };
        let found = find(&grey(&look.color), limits, &|_, _| true);
        let mark = |feature: Feature| Some(Mark { ray: look.ray(feature.pixel)?, feature });
        look.marks = found.into_iter().filter_map(mark).collect();
    });
}

/// Means of boxes of all channels of an image, channel by channel.
fn reduced(raster: &Raster, k: usize) -> Vec<Vec<f32>> {
    match &raster.samples {
        Samples::Eight(samples) => means(samples, raster, k, 255.0),
        Samples::Sixteen(samples) => means(samples, raster, k, 65535.0),
    }
}

fn means<T: Copy + Into<u64>>(samples: &[T], raster: &Raster, k: usize, most: f64) -> Vec<Vec<f32>> {
    let (width, height, full) = (raster.width / k, raster.height / k, most * (k * k) as f64);
    let size = [raster.width, width, height];
    match raster.channels {
        1 => planes(&box_sums::<T, 1>(samples, size, k), full),
        2 => planes(&box_sums::<T, 2>(samples, size, k), full),
        3 => planes(&box_sums::<T, 3>(samples, size, k), full),
        _ => planes(&box_sums::<T, 4>(samples, size, k), full),
    }
}

fn planes<const C: usize>(sums: &[[u64; C]], full: f64) -> Vec<Vec<f32>> {
    (0..C).map(|c| sums.iter().map(|sum| (sum[c] as f64 / full) as f32).collect()).collect()
}

/// Sums of boxes of an image of `C` channels: whole numbers in one pass, as most of the time of looking at a large image would go
/// here. `size`: width of the image, width and height of the result.
fn box_sums<T: Copy + Into<u64>, const C: usize>(
    samples: &[T],
    [across, width, height]: [usize; 3],
    k: usize,
) -> Vec<[u64; C]> {
    let mut out = vec![[0u64; C]; width * height];
    for y in 0..height * k {
        let row = &samples[y * across * C..][..width * k * C];
        for (sum, part) in out[y / k * width..][..width].iter_mut().zip(row.chunks_exact(k * C)) {
            for pixel in part.chunks_exact(C) {
                for c in 0..C {
                    sum[c] += pixel[c].into();
                }
            }
        }
    }
    out
}

/// Intrinsics that are compared with those as read.
#[derive(Clone, Copy)]
pub(super) struct Trial {
    /// How many times as long focal lengths are, across and down.
    pub(super) times: [f64; 2],
    /// Without the lens's distortion.
    pub(super) straight: bool,
    /// The first radial term of distortion, where the lens has none; 0: as read.
    pub(super) bend: f64,
}

impl Trial {
    /// As they were read.
    pub(super) const AS_READ: Self = Self { times: [1.0; 2], straight: false, bend: 0.0 };
}

impl SmallImage {
    fn read(number: usize, frame: &Frame, background: Option<[f32; 3]>, side: usize) -> Option<Self> {
        let raster = picture::decode_as(&frame.image, Some(&frame.source), frame.upright).ok()?;
        let factor = raster.width.max(raster.height).div_ceil(side).max(1);
        let (width, height) = (raster.width / factor, raster.height / factor);
        if width == 0 || height == 0 {
            return None;
        }
        let mut small = reduced(&raster, factor);
        let alpha = raster.alpha().map(|a| small.swap_remove(a));
        let mut color = Planes::new(3, height, width);
        let under = background.unwrap_or([1.0; 3]);
        for c in 0..3 {
            let plane = &small[if raster.channels < 3 { 0 } else { c }];
            let out = &mut color.data[c * width * height..(c + 1) * width * height];
            for (p, v) in out.iter_mut().enumerate() {
                let a = alpha.as_ref().map_or(1.0, |a| a[p]);
                *v = plane[p] * a + under[c] * (1.0 - a);
            }
        }
        // Masks may be smaller or larger than their images.
        let mask = || {
            let mask = picture::decode_as(frame.mask.as_deref()?, None, frame.upright).ok()?;
            let values = picture::mask_values(&mask, false);
            let at = |p: usize| {
                let (x, y) = ((p % width * 2 + 1) * mask.width, (p / width * 2 + 1) * mask.height);
                values[y / (2 * height) * mask.width + x / (2 * width)]
            };
            Some((0..width * height).map(at).collect::<Vec<f32>>())
        };
        let of_mask = alpha.is_none();
        let weights = alpha.or_else(mask);
        let fringe = Fringe::of(&raster);
        let lens = Distortion::new(frame.source.lens);
        let camera = frame.source.clone();
        let (foreground, hidden, shown) = (None, None, None);
        let mut look =
            Self { frame: number, camera, lens, color, factor, foreground, hidden, shown, fringe, marks: Vec::new() };
        if let Some(weights) = weights {
            look.foreground = look.middle(&weights);
            let rest: Vec<f32> = weights.iter().map(|w| 1.0 - w).collect();
            look.hidden = look.middle(&rest);
            let share = |w: &mut dyn Iterator<Item = f32>| {
                let (sum, count) = w.fold((0.0, 0), |(sum, count), w| (sum + f64::from(w), count + 1));
                sum / f64::from(count.max(1))
            };
            let on_edge = |p: &usize| {
                let (x, y) = (p % width, p / width);
                x == 0 || y == 0 || x + 1 == width || y + 1 == height
            };
            let of_edge = share(&mut (0..width * height).filter(on_edge).map(|p| weights[p]));
            look.shown = Some(Shown { share: share(&mut weights.iter().copied()), of_edge, of_mask, weights });
        }
        Some(look)
    }

    /// The ray to the middle of a foreground; `None`: it is nearly nothing, or nearly everything.
    fn middle(&self, weights: &[f32]) -> Option<[f64; 2]> {
        let (width, most) = (self.color.width, weights.iter().copied().fold(0.0f32, f32::max));
        let (mut sum, mut at) = (0.0, [0.0; 2]);
        for (p, w) in weights.iter().enumerate() {
            let w = f64::from(w / most.max(f32::MIN_POSITIVE));
            sum += w;
            at[0] += w * ((p % width) as f64 + 0.5);
            at[1] += w * ((p / width) as f64 + 0.5);
        }
        let share = sum / weights.len() as f64;
        (FOREGROUND[0]..=FOREGROUND[1]).contains(&share).then(|| self.ray(at.map(|v| v / sum)))?
    }

    /// The ray (x/z, y/z) of a pixel of the small image.
    fn ray(&self, [u, v]: [f64; 2]) -> Option<[f64; 2]> {
        let (k, f) = (&self.camera.intrinsics, self.factor as f64);
        self.lens.undistort([(u * f - k.cx) / k.fx, (v * f - k.cy) / k.fy])
    }

    /// Pixels of the small image across and down.
    pub(super) fn size(&self) -> (usize, usize) {
        (self.color.width, self.color.height)
    }

    /// Pixels of the file along one of the small image's.
    pub(super) fn factor(&self) -> usize {
        self.factor
    }

    /// Strength of the edges at every pixel of the small image: differences of neighbours, of all channels; 0 at its border.
    pub(super) fn edges(&self) -> Vec<f32> {
        let (width, height) = self.size();
        let mut out = vec![0.0f32; width * height];
        for c in 0..3 {
            let plane = self.color.plane(c);
            for y in 1..height.saturating_sub(1) {
                for x in 1..width.saturating_sub(1) {
                    let p = y * width + x;
                    out[p] += (plane[p + 1] - plane[p - 1]).abs() + (plane[p + width] - plane[p - width]).abs();
                }
            }
        }
        out
    }

    /// Focal length of the small image, pixels.
    pub(super) fn focal(&self) -> f64 {
        self.camera.intrinsics.fx / self.factor as f64
    }

    /// The camera of its file, and its lens, if intrinsics were others.
    pub(super) fn tried(&self, trial: Trial) -> (Camera, Distortion) {
        let mut camera = self.camera.clone();
        camera.intrinsics.fx *= trial.times[0];
        camera.intrinsics.fy *= trial.times[1];
        let lens = match trial {
            Trial { straight: true, .. } => Distortion::new(Lens::Pinhole),
            Trial { bend, .. } if bend != 0.0 && !self.is_distorted() => bent(bend),
            _ => self.lens,
        };
        (camera, lens)
    }

    /// Whether its lens distorts.
    pub(super) fn is_distorted(&self) -> bool {
        self.camera.lens != Lens::Pinhole
    }

    /// The colour at which a point of the world is seen from `pose` by this camera and lens of the file; `None`:
    /// outside, or hidden by its mask or alpha.
    pub(super) fn color_of(
        &self,
        (camera, lens): &(Camera, Distortion),
        pose: &Se3,
        point: [f64; 3],
    ) -> Option<[f32; 3]> {
        self.color_at(pixel_of(camera, lens, pose, point)?)
    }

    /// The colour at a pixel of the file; `None`: outside, or hidden by its mask or alpha.
    pub(super) fn color_at(&self, [u, v]: [f64; 2]) -> Option<[f32; 3]> {
        let (x, y) = (u as usize / self.factor, v as usize / self.factor);
        let inside = x < self.color.width && y < self.color.height;
        // Points of what was cut out have the colours of another image.
        let shown = |s: &Shown| s.weights[y * self.color.width + x] >= SHOWN;
        (inside && self.shown.as_ref().is_none_or(shown)).then(|| std::array::from_fn(|c| self.color.get(c, y, x)))
    }
}

/// A lens whose only distortion is the first radial term.
pub(super) fn bent(k1: f64) -> Distortion {
    Distortion::new(Lens::Brown { k: [k1, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2], s: [0.0; 4] })
}

/// Position of a point in the image file; `None`: behind the camera or outside.
pub(super) fn pixel_of(camera: &Camera, lens: &Distortion, pose: &Se3, point: [f64; 3]) -> Option<[f64; 2]> {
    let [x, y, z] = pose.apply(point);
    if z <= 0.0 {
        return None;
    }
    let k = &camera.intrinsics;
    let [x, y] = lens.distort([x / z, y / z])?;
    let at = [k.fx * x + k.cx, k.fy * y + k.cy];
    let inside = (0.0..camera.width as f64).contains(&at[0]) && (0.0..camera.height as f64).contains(&at[1]);
    inside.then_some(at)
}
