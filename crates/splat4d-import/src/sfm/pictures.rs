//! Features of cameras: of the static background on the median image, of what moves at times that all share.

use super::learned::Learned;
use super::lens::Known;
use super::overlay::Shown;
use crate::sync::grey::{Grey, Pyramid};
use crate::sync::tracks::{LEVELS, follow};
use crate::{Error, Result};
use rayon::prelude::*;
use splat4d::math::{Se3, median_by};
use splat4d::scene::Planes;
use splat4d_train::event::Progress;
use splat4d_train::vision::features::{self, Limits, NUMBERS};
use splat4d_train::vision::raster::{blurred, grey};

/// Images of cameras, by number.
pub trait Pictures: Sync {
    /// How many cameras.
    fn cameras(&self) -> usize;
    /// A camera's name in messages.
    fn name(&self, camera: usize) -> String;
    /// How many frames a camera has.
    fn frames(&self, camera: usize) -> usize;
    /// When a frame was taken, seconds on the common clock as far as known; ascending.
    fn time(&self, camera: usize, frame: usize) -> f64;
    /// A frame's image: 3 channels in [0, 1]. All frames of a camera are of one size.
    fn load(&self, camera: usize, frame: usize) -> Result<Planes<f32>>;
    /// The focal length in pixels, where it is known roughly (metadata).
    fn focal(&self, _camera: usize) -> Option<f64> {
        None
    }
    /// Cameras of one number share a lens (the same model at the same zoom).
    fn lens(&self, camera: usize) -> usize {
        camera
    }
    /// Its lens, or lens and position, where they are known exactly.
    fn known(&self, _camera: usize) -> Option<Known> {
        None
    }
    /// Mask of a camera's frame: one channel, above one half; all of it where there is none.
    fn mask(&self, _camera: usize, _frame: usize) -> Result<Option<Planes<f32>>> {
        Ok(None)
    }
    /// What matches images whose features do not; usually nothing.
    fn matcher(&self) -> Option<&Learned> {
        None
    }
}

/// A position in an image that others may show too.
#[derive(Clone, Debug)]
pub(crate) struct Feature {
    /// Pixels.
    pub pixel: [f64; 2],
    /// Pixels a second; zero for the static background.
    pub velocity: [f64; 2],
    /// 0: it is static; otherwise which of the shared times it was seen at, from 1. Those of different times are
    /// never the same.
    pub moment: usize,
    /// Its descriptor.
    pub descriptor: [u8; NUMBERS],
    /// sRGB.
    pub color: [u8; 3],
}

/// A camera that is to be placed: all of a fixed one's images, or one frame of a moving one.
#[derive(Clone, Debug)]
pub(crate) struct CameraView {
    /// Its name in messages.
    pub name: String,
    /// Pixels across and down, of the images that features are from.
    pub size: [usize; 2],
    /// Pixels of the files' images for each of those.
    pub factor: f64,
    /// The focal length in pixels, where it is known roughly.
    pub focal: Option<f64>,
    /// Whether the lens is known exactly: then features are where a pinhole camera of this focal length, its principal
    /// point in the middle, sees them.
    pub exact: bool,
    /// Takes world points into the camera's axes, where that is known.
    pub pose: Option<Se3>,
    /// Sights with the same number share a lens.
    pub lens: usize,
    /// How long a frame lasts, seconds.
    pub frame: f64,
    /// In the order of times; those without a descriptor are last.
    pub features: Vec<Feature>,
    /// How many have no descriptor: a matcher found them.
    pub learned: usize,
    /// Source of each time's features, by the time's number; none of a lens that is known, whose features were
    /// straightened.
    pub shown: Vec<Option<Shown>>,
}

/// Source of features.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FeatureOptions {
    /// Times at which features are taken from dynamic regions.
    pub moments: usize,
    /// Least contrast of a feature.
    pub contrast: f64,
    /// Features of the static background, at most, for each camera.
    pub still: usize,
    /// Features of a time, at most, for each camera.
    pub moving: usize,
    /// Images are halved until they have no more pixels.
    pub pixels: usize,
}

impl Default for FeatureOptions {
    fn default() -> Self {
        // Measured on a hall with 31 cameras of 640x360: contrasts of OpenCV's 0.004 to 0.01 (divided by its three
        // layers) and ten times map it. Poses of the bundled capture are 1.3 times as exact with 25 times as with ten.
        Self { moments: 16, contrast: 0.003, still: 4000, moving: 800, pixels: 1_200_000 }
    }
}

/// Frames whose median is the static background.
const MEDIAN_OF: usize = 15;
/// From this many frames on a median gives the static background.
const MEDIAN_FROM: usize = 3;
/// A pixel that differs by more than this from the static background (mean of the channels, in [0, 1]) belongs to
/// something that moves: above the noise of ordinary cameras.
const MOVED: f32 = 0.06;
/// Differences are blurred by this many pixels: single ones are noise.
const MOVED_BLUR: f64 = 1.0;
/// A frame farther from a time than this many frames does not show it.
const TOO_FAR: f64 = 1.0;
/// Features that move more slowly than this are static as far as clocks are concerned, pixels a frame.
const FASTEST: f64 = 40.0;

/// An image at the size that is worked with, and how many of the file's pixels are one of its.
pub(super) fn load(pictures: &dyn Pictures, camera: usize, frame: usize, most: usize) -> Result<(Planes<f32>, f64)> {
    let mut picture = pictures.load(camera, frame)?;
    if picture.channels != 3 || picture.width.min(picture.height) < 32 {
        let what = format!("an image of {}x{} with {} channels", picture.width, picture.height, picture.channels);
        return Err(Error::input(what).at(pictures.name(camera)).remedy("Give colour images of 32x32 and more."));
    }
    let mut factor = 1.0;
    while picture.pixels() > most {
        picture.halve();
        factor *= 2.0;
    }
    Ok((picture, factor))
}

/// `count` numbers evenly among `of`, or all.
fn spread(of: usize, count: usize) -> Vec<usize> {
    let kept = of.min(count);
    (0..kept).map(|k| (2 * k + 1) * of / (2 * kept)).collect()
}

pub(super) fn bytes(picture: &Planes<f32>) -> Vec<u8> {
    picture.data.iter().map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8).collect()
}

/// Mask of an image.
pub(super) struct Mask {
    mask: Planes<f32>,
    size: [usize; 2],
}

impl Mask {
    pub(super) fn counts(&self, x: usize, y: usize) -> bool {
        let [w, h] = self.size;
        self.mask.get(0, y * self.mask.height / h, x * self.mask.width / w) > 0.5
    }
}

/// The mask for an image at the size that is worked with.
pub(super) fn mask(pictures: &dyn Pictures, camera: usize, frame: usize, size: [usize; 2]) -> Result<Option<Mask>> {
    Ok(pictures.mask(camera, frame)?.map(|mask| Mask { mask, size }))
}

/// The static background: the median over some frames, channel by channel.
pub(super) fn median(pictures: &dyn Pictures, camera: usize, most: usize) -> Result<(Planes<f32>, f64)> {
    let frames = spread(pictures.frames(camera), MEDIAN_OF);
    let (mut out, factor) = load(pictures, camera, frames[0], most)?;
    if frames.len() < MEDIAN_FROM {
        return Ok((out, factor));
    }
    let mut all = vec![bytes(&out)];
    for &frame in &frames[1..] {
        let (next, _) = load(pictures, camera, frame, most)?;
        if (next.width, next.height) != (out.width, out.height) {
            let what =
                format!("frame {frame} is of {}x{}, others of {}x{}", next.width, next.height, out.width, out.height);
            return Err(Error::input(what).at(pictures.name(camera)).remedy("Give frames of one size."));
        }
        all.push(bytes(&next));
    }
    let mut values = vec![0u8; all.len()];
    for (p, v) in out.data.iter_mut().enumerate() {
        values.iter_mut().zip(&all).for_each(|(v, picture)| *v = picture[p]);
        *v = f32::from(median_by(&mut values, u8::cmp).expect("there are images")) / 255.0;
    }
    Ok((out, factor))
}

fn color_at(picture: &Planes<f32>, [u, v]: [f64; 2]) -> [u8; 3] {
    let x = (u.max(0.0) as usize).min(picture.width - 1);
    let y = (v.max(0.0) as usize).min(picture.height - 1);
    [0, 1, 2].map(|c| (picture.get(c, y, x) * 255.0).round().clamp(0.0, 255.0) as u8)
}

fn found(picture: &Planes<f32>, limits: Limits, wanted: &dyn Fn(usize, usize) -> bool, moment: usize) -> Vec<Feature> {
    let feature = |f: features::Feature| Feature {
        pixel: f.pixel,
        velocity: [0.0; 2],
        moment,
        descriptor: f.descriptor,
        color: color_at(picture, f.pixel),
    };
    features::find(&grey(picture), limits, wanted).into_iter().map(feature).collect()
}

/// Seconds between neighbouring frames, at the median.
fn frame_length(pictures: &dyn Pictures, camera: usize) -> f64 {
    let n = pictures.frames(camera);
    let mut steps: Vec<f64> = (1..n).map(|k| pictures.time(camera, k) - pictures.time(camera, k - 1)).collect();
    if steps.is_empty() {
        return 0.0;
    }
    let middle = steps.len() / 2;
    *steps.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Cameras that do not move, one sight each.
///
/// Errors: a camera without frames, images that cannot be read or change their size.
pub(crate) fn fixed(
    pictures: &dyn Pictures,
    look: &FeatureOptions,
    progress: &mut Progress<'_>,
) -> Result<Vec<CameraView>> {
    let count = pictures.cameras();
    for camera in 0..count {
        if pictures.frames(camera) == 0 {
            return Err(Error::input("a camera without frames").at(pictures.name(camera)).remedy("Leave it out."));
        }
    }
    let still = |c: usize| pictures.frames(c) < MEDIAN_FROM;
    let ends = |c: usize| (pictures.time(c, 0), pictures.time(c, pictures.frames(c) - 1));
    // What all cameras share; where they share nothing, what most of them see.
    let first = (0..count).filter(|&c| !still(c)).map(|c| ends(c).0).fold(f64::NEG_INFINITY, f64::max);
    let last = (0..count).filter(|&c| !still(c)).map(|c| ends(c).1).fold(f64::INFINITY, f64::min);
    let clock = (0..count).find(|&c| !still(c)).filter(|_| first < last);
    let moments: Vec<f64> = if let Some(clock) = clock {
        let step = (last - first) / look.moments as f64;
        // Each at a frame of one camera: where clocks agree no feature is brought to another time by its own velocity,
        // whose noise it would take along.
        let frames: Vec<f64> = (0..pictures.frames(clock)).map(|k| pictures.time(clock, k)).collect();
        let near = |t: f64| frames.iter().copied().min_by(|a, b| (a - t).abs().total_cmp(&(b - t).abs()));
        let mut all: Vec<f64> = (0..look.moments).filter_map(|k| near(first + (k as f64 + 0.5) * step)).collect();
        all.dedup();
        all
    } else {
        Vec::new()
    };
    let mut out = Vec::with_capacity(count);
    // A few at a time, so that progress is shown and few images are in memory.
    const TOGETHER: usize = 4;
    for part in (0..count).collect::<Vec<_>>().chunks(TOGETHER) {
        progress.phase("features", part[0], count);
        let sights: Result<Vec<CameraView>> = part.par_iter().map(|&c| sight(pictures, c, look, &moments)).collect();
        out.extend(sights?);
    }
    Ok(out)
}

fn sight(pictures: &dyn Pictures, camera: usize, look: &FeatureOptions, moments: &[f64]) -> Result<CameraView> {
    let (background, factor) = median(pictures, camera, look.pixels)?;
    let limits = |most: usize| Limits { contrast: look.contrast, most };
    // The static background counts where the middle frame does.
    let counts = mask(pictures, camera, pictures.frames(camera) / 2, [background.width, background.height])?;
    let mut features =
        found(&background, limits(look.still), &|x, y| counts.as_ref().is_none_or(|m| m.counts(x, y)), 0);
    let frame = frame_length(pictures, camera);
    let mut shown = vec![Some(Shown::new(&grey(&background), [0, 0], 0.0))];
    if pictures.frames(camera) >= MEDIAN_FROM {
        for (m, &t) in moments.iter().enumerate() {
            let off = |k: usize| (pictures.time(camera, k) - t).abs();
            let nearest =
                (0..pictures.frames(camera)).min_by(|&a, &b| off(a).total_cmp(&off(b))).expect("there are some");
            let mut window = None;
            if off(nearest) <= TOO_FAR * frame {
                let (found, from) = moving(pictures, camera, nearest, &background, look, m + 1, t)?;
                features.extend(found);
                window = from;
            }
            shown.push(window);
        }
    }
    let size = [background.width, background.height];
    Ok(CameraView { name: pictures.name(camera), features, shown, frame, ..empty(pictures, camera, size, factor) }
        .straightened(pictures, camera))
}

/// A camera of which nothing was seen yet.
fn empty(pictures: &dyn Pictures, camera: usize, size: [usize; 2], factor: f64) -> CameraView {
    CameraView {
        name: String::new(),
        size,
        factor,
        focal: pictures.focal(camera).map(|f| f / factor),
        exact: false,
        pose: None,
        lens: pictures.lens(camera),
        frame: 0.0,
        features: Vec::new(),
        learned: 0,
        shown: Vec::new(),
    }
}

impl CameraView {
    /// The features that have descriptors.
    pub(crate) fn described(&self) -> &[Feature] {
        &self.features[..self.features.len() - self.learned]
    }

    /// Takes away the distortion of a lens that is known.
    fn straightened(mut self, pictures: &dyn Pictures, camera: usize) -> Self {
        let Some(known) = pictures.known(camera) else { return self };
        let straight = known.straight(self.size, self.factor);
        self.features.retain_mut(|f| straight.feature(f));
        // Images are as the lens bent them: positions of straightened features are not theirs.
        Self { focal: Some(straight.focal()), exact: true, pose: known.pose, shown: Vec::new(), ..self }
    }
}

/// Part of an image.
struct Window {
    x: usize,
    y: usize,
    width: usize,
    height: usize,
}

impl Window {
    /// Box around all requested pixels, with a margin for features and velocities; `None`: there are none.
    fn around(width: usize, height: usize, wanted: &dyn Fn(usize, usize) -> bool) -> Option<Self> {
        /// Descriptors of ordinary features and motion of a frame reach no farther, pixels.
        const MARGIN: usize = 48;
        let rows = |y: &usize| (0..width).any(|x| wanted(x, *y));
        let columns = |x: &usize| (0..height).any(|y| wanted(*x, y));
        let (top, bottom) = ((0..height).find(rows)?, (0..height).rfind(rows)?);
        let (left, right) = ((0..width).find(columns)?, (0..width).rfind(columns)?);
        let low = |k: usize| k.saturating_sub(MARGIN);
        let high = |k: usize, size: usize| (k + 1 + MARGIN).min(size);
        let (x, y) = (low(left), low(top));
        Some(Self { x, y, width: high(right, width) - x, height: high(bottom, height) - y })
    }

    fn cut(&self, from: &Planes<f32>) -> Planes<f32> {
        let mut out = Planes::new(from.channels, self.height, self.width);
        for c in 0..from.channels {
            for y in 0..self.height {
                let at = (c * from.height + y + self.y) * from.width + self.x;
                let to = (c * self.height + y) * self.width;
                out.data[to..to + self.width].copy_from_slice(&from.data[at..at + self.width]);
            }
        }
        out
    }
}

/// Features of what moves in a frame, each with its velocity; brought to the shared time, which may be next to the
/// frame's. And their sources.
fn moving(
    pictures: &dyn Pictures,
    camera: usize,
    frame: usize,
    background: &Planes<f32>,
    look: &FeatureOptions,
    moment: usize,
    t: f64,
) -> Result<(Vec<Feature>, Option<Shown>)> {
    let (picture, _) = load(pictures, camera, frame, look.pixels)?;
    let mut off = Planes::new(1, picture.height, picture.width);
    for (p, v) in off.data.iter_mut().enumerate() {
        *v = (0..3).map(|c| (picture.plane(c)[p] - background.plane(c)[p]).abs()).sum::<f32>() / 3.0;
    }
    let off = blurred(&off, MOVED_BLUR);
    let counts = mask(pictures, camera, frame, [picture.width, picture.height])?;
    let wanted = |x: usize, y: usize| off.get(0, y, x) > MOVED && counts.as_ref().is_none_or(|m| m.counts(x, y));
    let Some(window) = Window::around(picture.width, picture.height, &wanted) else { return Ok((Vec::new(), None)) };
    let limits = Limits { contrast: look.contrast, most: look.moving };
    let inner = window.cut(&picture);
    let features = found(&inner, limits, &|x, y| wanted(x + window.x, y + window.y), moment);
    let sizes = |g: Planes<f32>| Pyramid::new(Grey { width: g.width, height: g.height, data: g.data }, LEVELS);
    let (now, time_now) = (grey(&inner), pictures.time(camera, frame));
    let shown = Shown::new(&now, [window.x, window.y], t - time_now);
    let now = sizes(now);
    let places: Vec<[f64; 2]> = features.iter().map(|f| f.pixel).collect();
    // Where features are in another frame, and when that is.
    let beside = |k: usize| -> Result<(Vec<Option<[f64; 2]>>, f64)> {
        let (picture, _) = load(pictures, camera, k, look.pixels)?;
        Ok((follow(&now, &sizes(grey(&window.cut(&picture))), &places), pictures.time(camera, k)))
    };
    let ago = if frame > 0 { Some(beside(frame - 1)?) } else { None };
    let after = if frame + 1 < pictures.frames(camera) { Some(beside(frame + 1)?) } else { None };
    let length = frame_length(pictures, camera);
    let with_velocity = |(k, mut f): (usize, Feature)| {
        let at = |other: &Option<(Vec<Option<[f64; 2]>>, f64)>| {
            let (places, time) = other.as_ref()?;
            Some((places[k]?, *time))
        };
        let here = (f.pixel, time_now);
        let (from, to) = match (at(&ago), at(&after)) {
            (Some(a), Some(b)) => (a, b),
            (Some(a), None) => (a, here),
            (None, Some(b)) => (here, b),
            (None, None) => return None,
        };
        let time = to.1 - from.1;
        if time <= 0.0 {
            return None;
        }
        f.velocity = std::array::from_fn(|k| (to.0[k] - from.0[k]) / time);
        let corner = [window.x as f64, window.y as f64];
        f.pixel = std::array::from_fn(|k| corner[k] + f.pixel[k] + f.velocity[k] * (t - time_now));
        (f.velocity[0].hypot(f.velocity[1]) * length < FASTEST).then_some(f)
    };
    Ok((features.into_iter().enumerate().filter_map(with_velocity).collect(), Some(shown)))
}

/// Frames of moving cameras, one sight each: at most `most`, evenly chosen. Motion in them contradicts the static
/// background and is left out where images are compared.
///
/// Errors: as `fixed`.
pub(crate) fn walking(
    pictures: &dyn Pictures,
    look: &FeatureOptions,
    most: usize,
    progress: &mut Progress<'_>,
) -> Result<Vec<(usize, usize, CameraView)>> {
    let total: usize = (0..pictures.cameras()).map(|c| pictures.frames(c)).sum();
    if total == 0 {
        return Err(Error::input("there are no images"));
    }
    let all: Vec<(usize, usize)> =
        (0..pictures.cameras()).flat_map(|c| (0..pictures.frames(c)).map(move |k| (c, k))).collect();
    let chosen: Vec<(usize, usize)> = spread(total, most).into_iter().map(|k| all[k]).collect();
    let mut out = Vec::with_capacity(chosen.len());
    const TOGETHER: usize = 8;
    for part in chosen.chunks(TOGETHER) {
        progress.phase("features", out.len(), chosen.len());
        let sights: Result<Vec<CameraView>> = part
            .par_iter()
            .map(|&(camera, frame)| {
                let (picture, factor) = load(pictures, camera, frame, look.pixels)?;
                let limits = Limits { contrast: look.contrast, most: look.still };
                let counts = mask(pictures, camera, frame, [picture.width, picture.height])?;
                let sight = CameraView {
                    name: format!("{}, frame {frame}", pictures.name(camera)),
                    frame: frame_length(pictures, camera),
                    features: found(&picture, limits, &|x, y| counts.as_ref().is_none_or(|m| m.counts(x, y)), 0),
                    shown: vec![Some(Shown::new(&grey(&picture), [0, 0], 0.0))],
                    ..empty(pictures, camera, [picture.width, picture.height], factor)
                };
                let sight = sight.straightened(pictures, camera);
                // One frame's position is not the camera's.
                Ok(CameraView { pose: None, ..sight })
            })
            .collect();
        out.extend(part.iter().zip(sights?).map(|(&(camera, frame), s)| (camera, frame, s)));
    }
    Ok(out)
}
