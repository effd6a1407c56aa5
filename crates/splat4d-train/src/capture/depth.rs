//! Depth maps on disk: 16-bit grey PNG, `.npy` or OpenEXR; z along the camera's axis in scene units, or known up to a
//! scale and a shift only, as networks predict it from a single image.
//!
//! In memory a map is that of the pinhole view, [height, width], and 0 where nothing is known.

use super::Frame;
use super::depth_field::Field;
use super::exr;
use super::json;
use super::lens::Distortion;
use super::picture::{self, Samples};
use splat4d::format::npy::Npy;
use splat4d::scene::Camera;
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

/// Lengths from here on are no depth: renderers write 10¹⁰ or infinity where nothing is hit.
const NOWHERE: f32 = 1e9;
/// Pixels of a box of which one is made belong to one surface if their values are within this share of the largest: the
/// mean over an edge is the depth of neither side (docs of scene flow: bilinear samples within 5 %).
const ONE_SURFACE: f32 = 0.05;

/// Kinds of depth maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DepthKind {
    /// z along the camera's axis, scene units.
    Metric,
    /// a z + b with a and b of each image's own, a > 0.
    Relative,
    /// a / z + b with a and b of each image's own, a > 0: disparity.
    Inverse,
}

impl DepthKind {
    /// Its names in `capture.json`.
    pub(super) const NAMES: [(&'static str, Self); 3] =
        [("metric", Self::Metric), ("relative", Self::Relative), ("inverse", Self::Inverse)];
}

/// The depth map of a frame: its file, and how it is read.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthFile {
    /// The map.
    pub path: PathBuf,
    /// Scene units a stored number; no matter but for metric ones.
    pub scale: f64,
    /// Its kind.
    pub kind: DepthKind,
    /// How a map that was known up to a scale and a shift became metric.
    pub(crate) fit: Option<DepthFit>,
}

/// Metric depth from a map that is known up to a scale and a shift.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct DepthFit {
    /// Whether `scale`·m + `shift` is an inverse depth.
    pub inverse: bool,
    /// Scene units (or their inverse) per number.
    pub scale: f64,
    /// What 0 would be.
    pub shift: f64,
    /// Relative errors of the map over the image.
    pub field: Field,
    /// Nearest and farthest depths that are believed; others are not known.
    pub range: [f64; 2],
}

impl DepthFit {
    /// The depth that a number means, 0: not known.
    fn depth(&self, number: f64) -> f32 {
        let value = self.scale * number + self.shift;
        let depth = if self.inverse { 1.0 / value } else { value };
        if (self.range[0]..=self.range[1]).contains(&depth) { depth as f32 } else { 0.0 }
    }

    /// Removes the smooth errors from a map of the whole pinhole view.
    fn remove_errors(&self, map: &mut [f32], width: usize, height: usize) {
        if self.field == Field::ZERO {
            return;
        }
        for (p, z) in map.iter_mut().enumerate() {
            let place = [((p % width) as f64 + 0.5) / width as f64, ((p / width) as f64 + 0.5) / height as f64];
            let error = 1.0 + self.field.at(place);
            *z = (f64::from(*z) * if self.inverse { error } else { 1.0 / error }) as f32;
        }
    }
}

/// A frame's depth, [height, width] of its view, 0: not known. Errors: no depth map, of another shape than the image,
/// numbers that are none.
pub(crate) fn read(file: &DepthFile, frame: &Frame, downscale: usize) -> Result<Vec<f32>> {
    let source = &frame.source;
    let map = Map::read(file, source)?;
    check(&map, file)?;
    if (map.width, map.height) != (source.width, source.height) && !picture::is_resized((map.width, map.height), source)
    {
        let what =
            format!("the depth map is {}x{}, its image {}x{}", map.width, map.height, source.width, source.height);
        return Err(Error::input(what)
            .at(file.path.display())
            .remedy("Write it in the image's shape (it may be smaller or larger as a whole)"));
    }
    let mut full = straighten(&map, source, &frame.distortion());
    if let Some(fit) = &file.fit {
        fit.remove_errors(&mut full, source.width, source.height);
    }
    Ok(reduce(&full, source.width, source.height, downscale))
}

/// A map's numbers at some pixels of the image file, in scene units; 0: not known. Errors: as [`read`].
pub(super) fn at(file: &DepthFile, source: &Camera, pixels: &[[f64; 2]]) -> Result<Vec<f32>> {
    let map = Map::read(file, source)?;
    let (x, y) = (map.width as f64 / source.width as f64, map.height as f64 / source.height as f64);
    let place = |[u, v]: &[f64; 2]| {
        let (column, row) = ((u * x) as usize, (v * y) as usize);
        map.values.get(row.min(map.height.saturating_sub(1)) * map.width + column).copied().unwrap_or(0.0)
    };
    Ok(pixels.iter().map(place).collect())
}

/// The mean of k×k boxes that are on one surface; 0 where a box is on several or any of its pixels is not known.
pub(super) fn reduce(map: &[f32], width: usize, height: usize, k: usize) -> Vec<f32> {
    if k == 1 {
        return map.to_vec();
    }
    let mut out = Vec::with_capacity((width / k) * (height / k));
    for y in 0..height / k {
        for x in 0..width / k {
            let pixels = || (0..k * k).map(|i| map[(y * k + i / k) * width + x * k + i % k]);
            let (mut low, mut high, mut sum) = (f32::INFINITY, f32::NEG_INFINITY, 0.0);
            for v in pixels() {
                (low, high, sum) = (low.min(v), high.max(v), sum + v);
            }
            let known = pixels().all(|v| v != 0.0);
            let one = high - low <= ONE_SURFACE * high.abs().max(low.abs());
            out.push(if known && one { sum / (k * k) as f32 } else { 0.0 });
        }
    }
    out
}

/// A map as stored, in scene units where it is metric.
struct Map {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Map {
    /// `source` is the image's camera: a file that claims to be far larger is refused before it is decoded.
    fn read(file: &DepthFile, source: &Camera) -> Result<Self> {
        let path = &file.path;
        let mut map = match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
            Some("npy") => Self::npy(path)?,
            Some("exr") => {
                let sane = |size| picture::check_not_larger("depth map", size, source);
                let read = exr::read(&json::read_bytes(path)?, sane).map_err(|e| e.at(path.display()));
                let (width, height, values) = read?;
                Self { width, height, values }
            }
            _ => Self::picture(file, source)?,
        };
        let known = |v: f32| match file.fit {
            _ if v >= NOWHERE => 0.0,
            Some(_) if v == 0.0 || v.is_nan() => v,
            Some(fit) => fit.depth(f64::from(v) * file.scale),
            None => (f64::from(v) * file.scale) as f32,
        };
        map.values.iter_mut().for_each(|v| *v = known(*v));
        Ok(map)
    }

    fn npy(path: &Path) -> Result<Self> {
        let array = Npy::read(&json::read_bytes(path)?).map_err(|e| e.at(path.display()))?;
        let (height, width) = match array.shape[..] {
            [h, w] | [h, w, 1] | [1, h, w] => (h, w),
            _ => {
                return Err(Error::input(format!("a depth map is [height, width], this array is {:?}", array.shape))
                    .at(path.display())
                    .remedy("Save one map a file: numpy.save(path, depth.astype('f4'))"));
            }
        };
        Ok(Self { width, height, values: array.to_f32() })
    }

    fn picture(file: &DepthFile, source: &Camera) -> Result<Self> {
        let header = picture::header(&file.path)?;
        let sane = picture::check_not_larger("depth map", header.upright(), source);
        sane.map_err(|e| e.at(file.path.display()))?;
        let raster = picture::decode(&file.path, None)?;
        let bad = |what: String| {
            Err(Error::input(what)
                .at(file.path.display())
                .remedy("Write one channel of 16 bits (or .npy or .exr), 0 where nothing is known"))
        };
        if raster.channels != 1 {
            return bad(format!("the depth map has {} channels, not 1", raster.channels));
        }
        let values = match raster.samples {
            Samples::Sixteen(v) => v.into_iter().map(f32::from).collect(),
            // Networks' depth is often stored so; 255 steps are too few for lengths.
            Samples::Eight(v) if file.kind != DepthKind::Metric || file.fit.is_some() => {
                v.into_iter().map(f32::from).collect()
            }
            Samples::Eight(_) => return bad("the depth map has 8 bits, not 16".into()),
        };
        Ok(Self { width: raster.width, height: raster.height, values })
    }
}

/// Errors: numbers that are none; lengths below zero; nothing known at all.
fn check(map: &Map, file: &DepthFile) -> Result<()> {
    let wrong = |v: &f32| !v.is_finite() || file.kind == DepthKind::Metric && *v < 0.0;
    let count = map.values.iter().filter(|v| wrong(v)).count();
    if let Some(p) = map.values.iter().position(wrong) {
        let what = format!(
            "the depth at pixel ({}, {}) is {} (so are {count} of {} pixels)",
            p % map.width.max(1),
            p / map.width.max(1),
            map.values[p],
            map.values.len()
        );
        return Err(Error::input(what).at(file.path.display()).remedy("Write 0 where depth is not known"));
    }
    if map.values.iter().all(|v| *v == 0.0) {
        return Err(Error::input("the depth map is empty: all of its pixels are 0")
            .at(file.path.display())
            .remedy("Leave the map out of the capture, or write it again"));
    }
    Ok(())
}

/// At the size of the image's pinhole view, each pixel as the nearest one of the map: means across an edge are
/// of neither side.
/// Undistortion keeps rays, and so z.
fn straighten(map: &Map, camera: &Camera, lens: &Distortion) -> Vec<f32> {
    let k = &camera.intrinsics;
    if lens.is_pinhole() && (map.width, map.height) == (camera.width, camera.height) {
        return map.values.clone();
    }
    let scale = [map.width as f64 / camera.width as f64, map.height as f64 / camera.height as f64];
    let pixel = |p: usize| {
        let (x, y) = ((p % camera.width) as f64 + 0.5, (p / camera.width) as f64 + 0.5);
        let [u, v] = lens.distort([(x - k.cx) / k.fx, (y - k.cy) / k.fy])?;
        let seen = [(k.fx * u + k.cx) * scale[0], (k.fy * v + k.cy) * scale[1]];
        let inside = (0.0..map.width as f64).contains(&seen[0]) && (0.0..map.height as f64).contains(&seen[1]);
        inside.then(|| map.values[seen[1] as usize * map.width + seen[0] as usize])
    };
    (0..camera.width * camera.height).map(|p| pixel(p).unwrap_or(0.0)).collect()
}
