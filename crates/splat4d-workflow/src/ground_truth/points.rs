//! End-point errors of followed points against known ones, in the world and in images: every true point at the first
//! frame is a query that [`splat4d::flow::query`] follows through the clip.
//!
//! In the world distances are compared with shares of the height of all points together, in images with pixels, as in
//! TAP-Vid (Doersch et al. 2022) but for the images' own size, over the points that are truly seen. Where a capture
//! brings `truth/tracks_visible.npy`, uint8 [cameras, frames, points], that states who is seen, and the rendered
//! visibility is compared with it; else every point in the image counts.

use super::tracks::Truth;
use splat4d::flow::query::{Place, Query, follow, sights};
use splat4d::format::npy::Npy;
use splat4d::layers::Scene;
use splat4d::math::median;
use splat4d::math::se3::{norm, sub};
use splat4d::scene::{Camera, Time};
use splat4d::{Error, Result};
use splat4d_train::capture::Capture;

/// True visibility of the points in each camera.
pub const VISIBLE: &str = "truth/tracks_visible.npy";
/// Pixels within which a point counts as found (TAP-Vid).
pub(crate) const PIXELS: [f64; 5] = [1.0, 2.0, 4.0, 8.0, 16.0];
/// Shares of the points' height within which a point counts as found in the world.
pub(crate) const SHARES: [f64; 5] = [0.01, 0.02, 0.04, 0.08, 0.16];
/// Cameras, at most: the held-out ones, or where there are none the first of training.
const CAMERAS: usize = 4;

/// Accuracy of followed points.
#[derive(Clone, Debug, PartialEq)]
pub struct PointErrors {
    /// Points.
    pub points: usize,
    /// Median distance over points and frames after the first, scene units (the median trajectory error).
    pub median: f64,
    /// Share of all (point, later frame) within 1, 2, 4, 8 and 16 % of the points' height; lost points are not.
    pub within: [f64; 5],
    /// Share of (point, later frame) at which nothing carries the point any more.
    pub lost: f64,
    /// Slope of ln(root mean square distance) over ln(frames since the first): ½ a random walk, 1 a constant bias;
    /// `None`: too few frames, or no error.
    pub slope: Option<f64>,
    /// The same in images.
    pub pictures: Option<PixelErrors>,
}

/// Accuracy of followed points in images.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelErrors {
    /// Cameras used.
    pub cameras: usize,
    /// Median distance of what is truly seen after the first frame, pixels.
    pub median: f64,
    /// Share of it within 1, 2, 4, 8 and 16 pixels; lost points are not.
    pub within: [f64; 5],
    /// Drift as in the world.
    pub slope: Option<f64>,
    /// Share of (camera, point, later frame) whose visibility is right; `None`: the capture does not contain it.
    pub visibility: Option<f64>,
}

impl PixelErrors {
    /// The mean of [`within`](Self::within): δ_avg of TAP-Vid.
    pub fn average(&self) -> f64 {
        self.within.iter().sum::<f64>() / self.within.len() as f64
    }
}

/// The errors of a scene on its capture; `None`: the capture has no true tracks, or fewer than two of its frames have.
///
/// Errors: a file of tracks or of visibility that is damaged, or does not fit.
pub fn point_errors(scene: &Scene<f32>, capture: &Capture) -> Result<Option<PointErrors>> {
    let Some(truth) = Truth::of(capture)? else { return Ok(None) };
    let frames = truth.frames_of(scene, capture.fps);
    if frames.len() < 2 {
        return Ok(None);
    }
    let visible = visibility(capture, &truth)?;
    let times: Vec<f64> = frames.iter().map(|&k| k as f64 / capture.fps).collect();
    let query = |p: usize| Query { time: times[0], place: Place::World(truth.at(frames[0], p)) };
    let queries: Vec<Query> = (0..truth.points).map(query).collect();
    let found = follow(scene, &queries, &times);
    let places = |k: usize| -> Vec<Option<[f64; 3]>> { (0..truth.points).map(|p| found.path(p)[k]).collect() };

    let height = truth.height(frames[0], scene.up).max(f64::MIN_POSITIVE);
    let mut world = Distances::new(SHARES.map(|s| s * height));
    for k in 1..frames.len() {
        for (p, place) in places(k).into_iter().enumerate() {
            world.add(k, place.map(|x| norm(sub(x, truth.at(frames[k], p)))));
        }
    }
    let mut pixels = Distances::new(PIXELS);
    let (mut right, mut asked) = (0usize, 0usize);
    let cameras = viewing_cameras(capture);
    for &(rig, camera) in &cameras {
        for k in 1..frames.len() {
            let seen = sights(scene, camera, Time(times[k]), &places(k));
            for (p, sight) in seen.into_iter().enumerate() {
                let Some((pixel, _)) = camera.project(truth.at(frames[k], p)) else { continue };
                let sides = [camera.width as f64, camera.height as f64];
                let inside = (0..2).all(|c| (0.0..sides[c]).contains(&pixel[c]));
                let truly = visible.as_ref().map_or(inside, |v| v.sees(rig, frames[k], p));
                if visible.is_some() {
                    asked += 1;
                    right += usize::from(truly == sight.is_some_and(|s| s.visible));
                }
                if truly {
                    pixels.add(k, sight.map(|s| (s.pixel[0] - pixel[0]).hypot(s.pixel[1] - pixel[1])));
                }
            }
        }
    }
    let pictures = pixels.median().map(|median| PixelErrors {
        cameras: cameras.len(),
        median,
        within: pixels.within(),
        slope: pixels.slope(),
        visibility: visible.is_some().then(|| right as f64 / asked.max(1) as f64),
    });
    let Some(median) = world.median() else { return Ok(None) };
    let (within, lost, slope) = (world.within(), world.lost(), world.slope());
    Ok(Some(PointErrors { points: truth.points, median, within, lost, slope, pictures }))
}

/// Fixed cameras for the comparison, with their numbers: held out, or else of training.
fn viewing_cameras(capture: &Capture) -> Vec<(usize, &Camera)> {
    let of = |frames: &[usize]| {
        let mut out: Vec<(usize, &Camera)> = Vec::new();
        for frame in frames.iter().map(|&i| &capture.frames[i]).filter(|f| capture.cameras[f.camera].fixed) {
            if out.len() < CAMERAS && out.iter().all(|(rig, _)| *rig != frame.camera) {
                out.push((frame.camera, &frame.view));
            }
        }
        out
    };
    let held = of(&capture.held);
    if held.is_empty() { of(&capture.train) } else { held }
}

/// True visibility.
struct Visible {
    frames: usize,
    points: usize,
    /// [cameras, frames, points]
    data: Vec<f32>,
}

impl Visible {
    fn sees(&self, camera: usize, frame: usize, point: usize) -> bool {
        self.data[(camera * self.frames + frame) * self.points + point] != 0.0
    }
}

fn visibility(capture: &Capture, truth: &Truth) -> Result<Option<Visible>> {
    let path = capture.root.join(VISIBLE);
    if !path.is_file() {
        return Ok(None);
    }
    let bytes = splat4d_train::files::read(&path)?;
    let array = Npy::read(&bytes).map_err(|e| e.at(path.display()))?;
    let wanted = [capture.cameras.len(), truth.frames, truth.points];
    if array.shape != wanted {
        return Err(Error::input(format!("visibility has shape {:?}, not {wanted:?}", array.shape))
            .at(path.display())
            .remedy(
                "Save it as uint8 [cameras, frames, points] next to tracks.npy, or delete it: it is only used to \
                 measure",
            ));
    }
    Ok(Some(Visible { frames: truth.frames, points: truth.points, data: array.to_f32() }))
}

/// Distances by frames since the first.
struct Distances {
    limits: [f64; 5],
    all: Vec<(usize, f64)>,
    asked: usize,
}

impl Distances {
    fn new(limits: [f64; 5]) -> Self {
        Self { limits, all: Vec::new(), asked: 0 }
    }

    fn add(&mut self, frames: usize, distance: Option<f64>) {
        self.asked += 1;
        self.all.extend(distance.map(|d| (frames, d)));
    }

    fn median(&self) -> Option<f64> {
        median(&mut self.all.iter().map(|d| d.1).collect::<Vec<_>>())
    }

    fn within(&self) -> [f64; 5] {
        self.limits.map(|l| self.all.iter().filter(|d| d.1 <= l).count() as f64 / self.asked.max(1) as f64)
    }

    fn lost(&self) -> f64 {
        1.0 - self.all.len() as f64 / self.asked.max(1) as f64
    }

    /// Least squares through (ln h, ln RMSE_h).
    fn slope(&self) -> Option<f64> {
        let last = self.all.iter().map(|d| d.0).max()?;
        let mut points: Vec<[f64; 2]> = Vec::new();
        for h in 1..=last {
            let squares: Vec<f64> = self.all.iter().filter(|d| d.0 == h).map(|d| d.1 * d.1).collect();
            let mean = squares.iter().sum::<f64>() / squares.len().max(1) as f64;
            if mean > 0.0 {
                points.push([(h as f64).ln(), 0.5 * mean.ln()]);
            }
        }
        let n = points.len() as f64;
        let mean = |k: usize| points.iter().map(|p| p[k]).sum::<f64>() / n;
        let (x, y) = (mean(0), mean(1));
        let spread: f64 = points.iter().map(|p| (p[0] - x).powi(2)).sum();
        let both: f64 = points.iter().map(|p| (p[0] - x) * (p[1] - y)).sum();
        (points.len() > 2).then_some(both / spread)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    #[test]
    fn a_bias_drifts_evenly_and_a_random_walk_by_its_root() {
        let (mut bias, mut walk) = (Distances::new(PIXELS), Distances::new(PIXELS));
        for point in 0..400u64 {
            let rng = Rng::new(3, "walk", point);
            let mut at = [0.0; 2];
            for h in 1..=64 {
                bias.add(h, Some(0.1 * h as f64));
                (0..2).for_each(|k| at[k] += rng.normal(2 * h as u64 + k as u64));
                walk.add(h, Some(at[0].hypot(at[1])));
            }
        }
        assert!((bias.slope().unwrap() - 1.0).abs() < 1e-9);
        assert!((walk.slope().unwrap() - 0.5).abs() < 0.05, "{:?}", walk.slope());
        bias.add(1, None);
        assert!((bias.lost() - 1.0 / 25_601.0).abs() < 1e-12 && bias.within()[2] < 40.5 / 64.0);
        assert!(Distances::new(PIXELS).slope().is_none() && Distances::new(PIXELS).median().is_none());
    }
}
