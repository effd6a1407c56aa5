//! The images in which points are searched: the static background as fixed cameras see it, single times, or the frames
//! of moving cameras.

use super::raster::{blurred, grey};
use crate::Result;
use crate::capture::frames::{Frames, Picture};
use rayon::prelude::*;
use splat4d::math::median_by;
use splat4d::scene::{Camera, Planes};
use std::collections::BTreeMap;

/// Images that are examined together, at most, evenly chosen.
const VIEWS: usize = 64;
/// Images are halved until they have no more pixels than this: finer detail places points no better than Gaussians
/// need.
const PIXELS: usize = 300_000;
/// Times of a fixed camera whose median is the static background.
const MEDIAN_OF: usize = 9;
/// From this many times on a median gives the static background.
const MEDIAN_FROM: usize = 3;
/// A pixel that differs by more than this from the static background (mean of the channels, in [0, 1]) belongs to
/// something that moves: above the noise of ordinary cameras.
const MOVED: f32 = 0.06;
/// Differences are blurred by this many pixels: single ones are noise.
const MOVED_BLUR: f64 = 1.0;

/// An image to search for points in.
pub(crate) struct View {
    /// Its camera; its size is the image's.
    pub camera: Camera,
    /// Colours as bytes, pixel by pixel.
    pub colors: Vec<[u8; 3]>,
    /// The mean of the channels.
    pub grey: Planes<f32>,
    /// Pixels in which points are searched for.
    pub wanted: Vec<bool>,
}

impl View {
    pub(crate) fn new(camera: Camera, color: &Planes<f32>, wanted: Vec<bool>) -> Self {
        let byte = |v: f32| (v * 255.0).round().clamp(0.0, 255.0) as u8;
        let colors = (0..color.pixels()).map(|p| [0, 1, 2].map(|c| byte(color.plane(c)[p]))).collect();
        Self { camera, colors, grey: grey(color), wanted }
    }

    /// Searches only in pixels whose colour differs by more than `limit` (mean of the channels, in [0, 1]) from that in another
    /// image; differences are blurred by `blur` pixels.
    pub(crate) fn keep_unlike(&mut self, other: &[[u8; 3]], limit: f32, blur: f64) {
        let mut off = self.grey.clone();
        for ((v, own), other) in off.data.iter_mut().zip(&self.colors).zip(other) {
            *v = (0..3).map(|c| f32::from(own[c].abs_diff(other[c]))).sum::<f32>() / (3.0 * 255.0);
        }
        let off = blurred(&off, blur);
        self.wanted.iter_mut().zip(&off.data).for_each(|(w, v)| *w &= *v > limit);
    }

    /// Whether points are searched for in a pixel.
    pub(crate) fn wants(&self, x: usize, y: usize) -> bool {
        self.wanted[y * self.camera.width + x]
    }

    /// Its colour in [0, 1] at a pixel position inside the image.
    pub(crate) fn color(&self, [u, v]: [f64; 2]) -> [f32; 3] {
        let x = (u.max(0.0) as usize).min(self.camera.width - 1);
        let y = (v.max(0.0) as usize).min(self.camera.height - 1);
        self.colors[y * self.camera.width + x].map(|c| f32::from(c) / 255.0)
    }

    /// Whether a pixel position is inside the image.
    pub(crate) fn holds(&self, [u, v]: [f64; 2]) -> bool {
        (0.0..self.camera.width as f64).contains(&u) && (0.0..self.camera.height as f64).contains(&v)
    }
}

/// A capture's images, sorted by what can be compared.
pub(crate) enum Rigs {
    /// Cameras that do not move, each with its frames in the order of time.
    Fixed(Vec<Vec<usize>>),
    /// Frames of cameras that move: their common part is static.
    Moving(Vec<usize>),
}

impl Rigs {
    /// Fixed cameras, where there are at least two of them; else some of all frames. Of many some, evenly chosen.
    pub(crate) fn of(frames: &dyn Frames) -> Self {
        match Self::all(frames) {
            Self::Fixed(mut cameras) => {
                Self::Fixed(spread(cameras.len(), VIEWS).map(|k| std::mem::take(&mut cameras[k])).collect())
            }
            moving => moving,
        }
    }

    /// The same with every fixed camera.
    pub(crate) fn all(frames: &dyn Frames) -> Self {
        let mut rigs: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        (0..frames.len()).for_each(|i| rigs.entry(frames.rig(i)).or_default().push(i));
        let still = |rig: &[usize]| {
            rig.iter().all(|&i| frames.camera(i).cam_from_world == frames.camera(rig[0]).cam_from_world)
        };
        let mut fixed: Vec<Vec<usize>> = rigs.into_values().filter(|rig| still(rig)).collect();
        if fixed.len() < 2 {
            return Self::Moving(spread(frames.len(), VIEWS).collect());
        }
        fixed.iter_mut().for_each(|rig| rig.sort_by(|&a, &b| frames.time(a).0.total_cmp(&frames.time(b).0)));
        Self::Fixed(fixed)
    }

    /// Whether a fixed camera has this many times that their median is the static background.
    pub(crate) fn have_medians(&self) -> bool {
        matches!(self, Self::Fixed(rigs) if rigs.iter().any(|rig| rig.len() >= MEDIAN_FROM))
    }

    /// The static background, per camera.
    pub(crate) fn still(&self, frames: &dyn Frames) -> Result<Vec<View>> {
        match self {
            Self::Moving(all) => all.par_iter().map(|&i| single(frames, i)).collect(),
            Self::Fixed(rigs) => rigs.par_iter().map(|rig| median(frames, rig)).collect(),
        }
    }

    /// Differences from `still` in the frames nearest to time t, and their time; nothing where cameras move or times
    /// are few.
    pub(crate) fn moving(&self, frames: &dyn Frames, still: &[View], t: f64) -> Result<Option<(Vec<View>, f64)>> {
        let Self::Fixed(rigs) = self else { return Ok(None) };
        if !self.have_medians() {
            return Ok(None);
        }
        let nearest = |rig: &[usize]| {
            let off = |i: usize| (frames.time(i).0 - t).abs();
            rig.iter().copied().min_by(|&a, &b| off(a).total_cmp(&off(b))).expect("a camera has frames")
        };
        let differing = |(rig, still): (&Vec<usize>, &View)| -> Result<View> {
            let mut view = single(frames, nearest(rig))?;
            view.keep_unlike(&still.colors, MOVED, MOVED_BLUR);
            if rig.len() < MEDIAN_FROM {
                view.wanted.fill(false);
            }
            Ok(view)
        };
        let views = rigs.par_iter().zip(still).map(differing).collect::<Result<Vec<View>>>()?;
        Ok(Some((views, frames.time(nearest(&rigs[0])).0)))
    }
}

/// At most `most` of `count` numbers, evenly chosen.
pub(crate) fn spread(count: usize, most: usize) -> impl Iterator<Item = usize> {
    let kept = count.min(most);
    (0..kept).map(move |k| k * count / kept)
}

/// How often an image is halved to the size that is worked with.
pub(crate) fn halvings(width: usize, height: usize) -> usize {
    (0..).find(|&k| (width >> k) * (height >> k) <= PIXELS).expect("an image can be halved to nothing")
}

/// A frame's image at the size that is worked with, and its camera.
fn load(frames: &dyn Frames, i: usize) -> Result<(Camera, Picture)> {
    let mut picture = Picture::default();
    frames.load(i, &mut picture)?;
    (picture.depth, picture.flow) = (None, None);
    let mut camera = frames.camera(i).clone();
    for _ in 0..halvings(camera.width, camera.height) {
        picture.halve();
        camera = camera.downscaled(2);
    }
    Ok((camera, picture))
}

/// The pixels that the lens filled.
fn filled(picture: &Picture) -> Vec<bool> {
    match &picture.weight {
        Some(weight) => weight.data.iter().map(|w| *w == 1.0).collect(),
        None => vec![true; picture.color.pixels()],
    }
}

fn single(frames: &dyn Frames, i: usize) -> Result<View> {
    let (camera, picture) = load(frames, i)?;
    let wanted = filled(&picture);
    Ok(View::new(camera, &picture.color, wanted))
}

/// The median over some of a fixed camera's frames, channel by channel.
fn median(frames: &dyn Frames, rig: &[usize]) -> Result<View> {
    let most = if rig.len() < MEDIAN_FROM { 1 } else { MEDIAN_OF };
    let (camera, mut first) = load(frames, rig[0])?;
    let mut wanted = filled(&first);
    let mut values: Vec<Vec<f32>> = Vec::new();
    for k in spread(rig.len(), most).skip(1) {
        let (_, picture) = load(frames, rig[k])?;
        wanted.iter_mut().zip(filled(&picture)).for_each(|(w, also)| *w &= also);
        values.push(picture.color.data);
    }
    let mut sorted = Vec::with_capacity(values.len() + 1);
    for (p, value) in first.color.data.iter_mut().enumerate() {
        sorted.clear();
        sorted.push(*value);
        sorted.extend(values.iter().map(|v| v[p]));
        *value = median_by(&mut sorted, f32::total_cmp).expect("the first is there");
    }
    Ok(View::new(camera, &first.color, wanted))
}
