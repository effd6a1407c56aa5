//! Measured geometry of a capture: a laser scan, LiDAR or a mesh, of all times or of each frame. It gives initial points,
//! and its depth in every training image.
//!
//! Depth is rendered when an image is loaded, at the image's own size, and kept in 16 bits; of a fixed camera and a
//! static scan once. What the scan leaves open is 0: no measurement.

mod depth;
mod e57;
mod las;
mod pcd;
mod placed;
mod read;
mod surface;

use super::json::read_bytes;
use super::{Capture, Frame, PointCloud};
use placed::Placed;
use splat4d::math::median;
use splat4d::math::se3::{norm, sub};
use splat4d::scene::{Camera, Planes};
use splat4d::{Error, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};
use surface::Surface;

/// Initial points that a scan gives: as many as training starts with by default. It adds others where it needs them.
const POINTS: usize = 10_000;
/// Points of which these are thinned, of a mesh.
const SAMPLES: usize = 4 * POINTS;
/// Scans of single frames that give initial points, evenly chosen.
const SCANS: usize = 16;
/// Scans of single frames in memory: a step loads images of few times.
const KEPT: usize = 4;
/// Depths that 16 bits distinguish, next to 0.
const CODES: f64 = 65_534.0;

/// The files of measured geometry.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Scans {
    /// One for all times.
    Static(PathBuf),
    /// By frame number; frames without a file have no measurement.
    Frames(BTreeMap<usize, PathBuf>),
}

/// Measured geometry.
pub struct Geometry {
    files: Scans,
    /// From the file's coordinates to the capture's: rows of a 3x4 matrix, 0 0 0 1 below.
    transform: [[f64; 4]; 4],
    /// Subtracted after that, as from the capture's poses.
    offset: [f64; 3],
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// As read; until depth is needed.
    read: Option<Surface>,
    /// By frame number (0: static), the newest last.
    kept: Vec<(usize, Arc<Placed>)>,
    /// Of a static scan, by fixed camera.
    maps: Vec<(Camera, Option<Arc<DepthMap>>)>,
}

/// Measured depth of an image, [height, width], as codes of its logarithm; 0: no measurement.
pub(super) struct DepthMap {
    width: usize,
    height: usize,
    low: f64,
    step: f64,
    codes: Vec<u16>,
}

impl DepthMap {
    /// `None`: nothing is measured.
    fn new(values: &[f32], camera: &Camera) -> Option<Self> {
        let known = || values.iter().filter(|v| **v > 0.0).map(|v| f64::from(*v).ln());
        let (low, high) = known().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        if low > high {
            return None;
        }
        let step = ((high - low) / (CODES - 1.0)).max(1e-9);
        let code = |v: &f32| if *v > 0.0 { 1 + ((f64::from(*v).ln() - low) / step).round() as u16 } else { 0 };
        Some(Self { width: camera.width, height: camera.height, low, step, codes: values.iter().map(code).collect() })
    }

    /// Bytes in memory.
    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.codes[..])
    }

    /// Writes it as [1, height, width].
    pub(super) fn write_into(&self, out: &mut Planes<f32>) {
        (out.channels, out.height, out.width) = (1, self.height, self.width);
        out.data.clear();
        let value =
            |code: &u16| if *code == 0 { 0.0 } else { (self.low + self.step * f64::from(code - 1)).exp() as f32 };
        out.data.extend(self.codes.iter().map(value));
    }
}

impl PartialEq for DepthMap {
    fn eq(&self, other: &Self) -> bool {
        (self.width, self.height, &self.codes) == (other.width, other.height, &other.codes)
    }
}

impl std::fmt::Debug for Geometry {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Geometry {{ files: {:?}, transform: {:?}, offset: {:?} }}", self.files, self.transform, self.offset)
    }
}

impl Geometry {
    /// Of these files; `transform` takes their coordinates to the capture's. Errors: it is not invertible.
    pub(super) fn new(files: Scans, transform: [[f64; 4]; 4]) -> Result<Self> {
        let m = &transform;
        let det = m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
            + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]);
        if !det.is_finite() || det == 0.0 {
            return Err(Error::input("invalid transform: its 3x3 part has the determinant 0")
                .remedy("Give a row-major 4x4 matrix that takes the scan's coordinates to those of the poses"));
        }
        Ok(Self { files, transform, offset: [0.0; 3], state: Mutex::default() })
    }

    /// The same relative to another offset of the capture.
    pub(super) fn relative_to(&self, offset: [f64; 3]) -> Self {
        Self { files: self.files.clone(), transform: self.transform, offset, state: Mutex::default() }
    }

    /// Its files.
    pub(super) fn files(&self) -> Vec<&PathBuf> {
        match &self.files {
            Scans::Static(path) => vec![path],
            Scans::Frames(paths) => paths.values().collect(),
        }
    }

    /// What identifies it: names below `root` and sizes of its files, and its place.
    pub(crate) fn mark(&self, root: &Path) -> String {
        let mut out = format!("{:?}", self.transform);
        for path in self.files() {
            let length = std::fs::metadata(path).map_or(0, |m| m.len());
            out += &format!("{:?} {length};", path.strip_prefix(root).unwrap_or(path));
        }
        out
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Every change of the state is complete before its lock is released.
        self.state.lock().unwrap_or_else(|e| e.into_inner())
    }

    /// Reads a file and takes it to the capture's coordinates. Errors: name the file.
    fn surface(&self, path: &Path) -> Result<Surface> {
        let mut read = read_bytes(path).and_then(|bytes| read::read(&bytes, path).map_err(|e| e.at(path.display())))?;
        let (m, offset) = (&self.transform, self.offset);
        for p in &mut read.points {
            let [x, y, z] = *p;
            *p = std::array::from_fn(|k| m[k][0] * x + m[k][1] * y + m[k][2] * z + m[k][3] - offset[k]);
        }
        Ok(read.thinned())
    }

    /// Initial points, and a sentence on what was read. Points that no training camera has in its image are left out.
    ///
    /// Errors: a file cannot be read; no camera has any point in its image.
    pub(super) fn cloud(&self, capture: &Capture) -> Result<(PointCloud, String)> {
        let views: Vec<&Camera> = capture.places().collect();
        let seen = |p: &[f64; 3]| {
            views.iter().any(|view| {
                let inside = |x: f64, size: usize| (0.0..size as f64).contains(&x);
                view.project(*p).is_some_and(|([u, v], _)| inside(u, view.width) && inside(v, view.height))
            })
        };
        let of = |path: &Path, count: usize| -> Result<(Surface, PointCloud)> {
            let surface = self.surface(path)?;
            let (points, colors) = surface.samples(SAMPLES);
            let mut cloud = PointCloud::default();
            for (i, p) in points.iter().enumerate().filter(|(_, p)| seen(p)) {
                cloud.push(*p, colors.get(i).copied().unwrap_or([0.5; 3]), None);
            }
            if cloud.points.is_empty() {
                return Err(unseen(&surface, &views).at(path.display()));
            }
            Ok((surface, cloud.voxel_downsample(count)))
        };
        let what = |surface: &Surface| match surface.triangles.len() {
            0 => format!("{} points", surface.points.len()),
            n => format!("{n} triangles"),
        };
        match &self.files {
            Scans::Static(path) => {
                let (surface, cloud) = of(path, POINTS)?;
                let note = format!("Measured geometry: {}, {} in use.", path.display(), what(&surface));
                self.lock().read = Some(surface);
                Ok((cloud, note))
            }
            Scans::Frames(paths) => {
                let trained: BTreeSet<usize> = capture.train.iter().map(|&i| capture.frames[i].index).collect();
                let all: Vec<(&usize, &PathBuf)> = paths.iter().filter(|(i, _)| trained.contains(i)).collect();
                let chosen = || all.iter().step_by(all.len().div_ceil(SCANS).max(1));
                let (mut scans, mut colors, mut first) = (Vec::new(), Vec::new(), None);
                for (index, path) in chosen() {
                    let (surface, cloud) = of(path, POINTS / 2)?;
                    let mut frames = capture.train.iter().map(|&i| &capture.frames[i]);
                    let time = frames.find(|f| f.index == **index).map_or(0.0, |f| f.time.0);
                    first.get_or_insert_with(|| what(&surface));
                    scans.push((time, cloud.points));
                    colors.push(cloud.colors);
                }
                let side = spacing(scans.first().map_or(&[][..], |s| &s.1));
                let mut cloud = PointCloud::default();
                for (s, i, time) in surface::apart(&scans, side) {
                    cloud.push(scans[s].1[i], colors[s][i], time);
                }
                let note = format!(
                    "Measured geometry: {} scans of single frames, the first with {}.",
                    paths.len(),
                    first.unwrap_or_default()
                );
                Ok((cloud.voxel_downsample(4 * POINTS), note))
            }
        }
    }

    /// Measured depth of a training image; `None`: there is none. `fixed`: its camera does not move.
    ///
    /// Errors: the scan of its frame cannot be read.
    pub(super) fn depth(&self, frame: &Frame, fixed: bool) -> Result<Option<Arc<DepthMap>>> {
        let (number, path, fixed) = match &self.files {
            Scans::Static(path) => (0, path, fixed),
            Scans::Frames(paths) => match paths.get(&frame.index) {
                Some(path) => (frame.index, path, false),
                None => return Ok(None),
            },
        };
        let same = |camera: &Camera| {
            let (a, b) = (camera, &frame.view);
            (a.width, a.height) == (b.width, b.height)
                && a.cam_from_world == b.cam_from_world
                && a.intrinsics == b.intrinsics
        };
        let placed = {
            let mut state = self.lock();
            if let Some((_, map)) = state.maps.iter().find(|(camera, _)| fixed && same(camera)) {
                return Ok(map.clone());
            }
            match state.kept.iter().find(|(n, _)| *n == number) {
                Some((_, placed)) => placed.clone(),
                None => {
                    let read = match state.read.take() {
                        Some(read) => read,
                        None => self.surface(path)?,
                    };
                    let placed = Arc::new(Placed::new(&read));
                    if state.kept.len() >= KEPT {
                        state.kept.remove(0);
                    }
                    state.kept.push((number, placed.clone()));
                    placed
                }
            }
        };
        let map = DepthMap::new(&depth::render(&placed, &frame.view), &frame.view).map(Arc::new);
        if fixed {
            self.lock().maps.push((frame.view.clone(), map.clone()));
        }
        Ok(map)
    }
}

/// Reads a file of this name and renders its depth, without a capture around it.
///
/// Errors: those of a geometry file.
#[doc(hidden)]
pub fn check_scan(bytes: &[u8], name: &Path, camera: &Camera) -> Result<()> {
    let placed = Placed::new(&read::read(bytes, name)?.thinned());
    DepthMap::new(&depth::render(&placed, camera), camera);
    Ok(())
}

/// The distance within which points of a thinned cloud are one: twice that of neighbours, the median of some.
fn spacing(points: &[[f64; 3]]) -> f64 {
    const SOME: usize = 200;
    let step = points.len().div_ceil(SOME).max(1);
    let nearest = |p: &[f64; 3]| {
        let others = points.iter().map(|q| norm(sub(*p, *q))).filter(|d| *d > 0.0);
        others.fold(f64::INFINITY, f64::min)
    };
    let mut all: Vec<f64> = points.iter().step_by(step).map(nearest).filter(|d| d.is_finite()).collect();
    2.0 * median(&mut all).unwrap_or(1.0)
}

/// The error of a scan that is in no image: where it is, and where cameras are.
fn unseen(surface: &Surface, views: &[&Camera]) -> Error {
    let range = |points: &mut dyn Iterator<Item = [f64; 3]>| {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        points.for_each(|p| (0..3).for_each(|k| (low[k], high[k]) = (low[k].min(p[k]), high[k].max(p[k]))));
        let text = |p: [f64; 3]| format!("({:.4}, {:.4}, {:.4})", p[0], p[1], p[2]);
        format!("{} to {}", text(low), text(high))
    };
    let (scan, cameras) = (range(&mut surface.points.iter().copied()), range(&mut views.iter().map(|v| v.center())));
    Error::input(format!(
        "no training camera has the measured geometry in its image: it reaches from {scan}, cameras from {cameras}"
    ))
    .remedy(
        "The scan must be in the coordinates and units of the poses: give a \"transform\" from the scan to them \
             (docs/priors.md)",
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Se3;

    #[test]
    fn codes_keep_a_depth_within_a_ten_thousandth() {
        let camera = Camera::with_fov_y(Se3::IDENTITY, 0.8, 4, 2);
        let values = [0.0, 0.01, 1.0, 4.0, 4.0004, 100.0, 9_999.0, 10_000.0];
        let map = DepthMap::new(&values, &camera).unwrap();
        let mut out = Planes::default();
        map.write_into(&mut out);
        assert_eq!((out.width, out.height, out.data[0]), (4, 2, 0.0));
        assert!(out.data.iter().zip(&values).skip(1).all(|(a, b)| (a / b - 1.0).abs() < 2e-4), "{:?}", out.data);
        assert!(DepthMap::new(&[0.0; 8], &camera).is_none());
        let flat = DepthMap::new(&[3.0; 8], &camera).unwrap();
        flat.write_into(&mut out);
        assert!(out.data.iter().all(|z| (z - 3.0).abs() < 1e-6));
    }
}
