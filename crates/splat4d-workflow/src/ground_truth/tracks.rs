//! 3D error of tracks against known ones: rendered captures contain the true paths of points of their surfaces.
//!
//! `truth/tracks.npy` holds float32 [frames, points, 3], world positions. Every point at the first frame is a query, as
//! in benchmarks of point tracking: the few Gaussians nearest to it then carry it on by their mean displacement, and
//! the error is its distance to the truth at all later frames. The error of the nearest Gaussian is reported next to it
//! itself, its distance at the first frame included (the median trajectory error of Luiten et al. 2024). Times at which
//! none of a point's Gaussians is alive are not counted, but the share that is counted is reported.

use splat4d::flow::tracks::{Tracks, nearest};
use splat4d::format::npy::Npy;
use splat4d::layers::Scene;
use splat4d::math::median;
use splat4d::math::se3::{norm, sub};
use splat4d::scene::Time;
use splat4d::{Error, Result};
use splat4d_train::capture::Capture;

/// Path of the truth in a capture.
pub const FILE: &str = "truth/tracks.npy";
/// Gaussians that carry a point: one alone may be a floater.
const CARRIERS: usize = 4;
/// Fainter Gaussians are not taken for a surface.
const LEAST_OPACITY: f64 = 0.5;

/// Seconds by which times of one frame may differ for rounding.
const CLOCK_ERROR: f64 = 1e-4;

/// Accuracy of followed surfaces.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackError {
    /// Points that were followed.
    pub points: usize,
    /// Median over points and frames after the first, scene units.
    pub median: f64,
    /// Their mean, scene units.
    pub mean: f64,
    /// Median distance of the nearest Gaussian itself over points and frames after the first, scene units.
    pub nearest: f64,
    /// The same at the first frame.
    pub first: f64,
    /// Height of all points together along the scene's up direction at the first frame: that of the tallest character.
    pub height: f64,
    /// Share of (point, later frame) at which a Gaussian that carries the point is alive.
    pub followed: f64,
}

impl TrackError {
    /// The median error in percent of a character's height.
    pub fn percent(&self) -> f64 {
        100.0 * self.median / self.height.max(f64::MIN_POSITIVE)
    }
}

/// The error of a scene on its capture; `None` where the capture has no true tracks, or no Gaussian is there to follow.
///
/// Errors: a file of tracks that is damaged.
pub fn track_error(scene: &Scene<f32>, capture: &Capture) -> Result<Option<TrackError>> {
    Ok(Truth::of(capture)?.and_then(|truth| truth.compare(scene, capture.fps)))
}

/// True paths of points.
pub(super) struct Truth {
    pub(super) frames: usize,
    pub(super) points: usize,
    /// [frames, points, 3]
    data: Vec<f32>,
}

impl Truth {
    /// True tracks of a capture; `None`: nothing.
    pub(super) fn of(capture: &Capture) -> Result<Option<Self>> {
        let path = capture.root.join(FILE);
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = splat4d_train::files::read(&path)?;
        Self::read(&bytes).map(Some).map_err(|e| e.at(path.display()))
    }

    fn read(bytes: &[u8]) -> Result<Self> {
        let array = Npy::read(bytes)?;
        match array.shape[..] {
            [frames, points, 3] if frames > 1 && points > 0 => Ok(Self { frames, points, data: array.to_f32() }),
            _ => Err(Error::input(format!("true tracks have shape {:?}, not [frames, points, 3]", array.shape))
                .remedy("Delete the file; it is only used to measure")),
        }
    }

    /// The frames in a scene's clip: a part of the capture has a part of them.
    pub(super) fn frames_of(&self, scene: &Scene<f32>, fps: f64) -> Vec<usize> {
        let [from, to] = [scene.clip[0] - CLOCK_ERROR, scene.clip[1] + CLOCK_ERROR];
        (0..self.frames).filter(|&k| (from..=to).contains(&(k as f64 / fps))).collect()
    }

    /// Height of all points together along a direction at a frame.
    pub(super) fn height(&self, frame: usize, up: [f64; 3]) -> f64 {
        let along = |p: usize| (0..3).map(|k| self.at(frame, p)[k] * up[k]).sum::<f64>();
        let ends =
            (0..self.points).map(along).fold([f64::INFINITY, f64::NEG_INFINITY], |[l, h], x| [l.min(x), h.max(x)]);
        ends[1] - ends[0]
    }

    pub(super) fn at(&self, frame: usize, point: usize) -> [f64; 3] {
        let i = 3 * (frame * self.points + point);
        [0, 1, 2].map(|k| f64::from(self.data[i + k]))
    }

    fn compare(&self, scene: &Scene<f32>, fps: f64) -> Option<TrackError> {
        let frames = self.frames_of(scene, fps);
        let times: Vec<f64> = frames.iter().map(|&k| k as f64 / fps).collect();
        if frames.len() < 2 {
            return None;
        }
        let start: Vec<[f64; 3]> = (0..self.points).map(|p| self.at(frames[0], p)).collect();
        let near = nearest(scene, Time(times[0]), &start, CARRIERS, LEAST_OPACITY);
        if near.iter().any(Vec::is_empty) {
            return None;
        }
        let tracks = Tracks::follow(scene, &near.concat(), &times);
        let of = |m| tracks.track(tracks.members.binary_search(m).expect("every carrier is followed"));
        let (mut carried, mut nearest, mut firsts) = (Vec::new(), Vec::new(), Vec::new());
        for (p, carriers) in near.iter().enumerate() {
            let far = |x: [f64; 3], k: usize| norm(sub(x, self.at(frames[k], p)));
            let wide = |x: [f32; 3]| x.map(f64::from);
            for k in 0..frames.len() {
                if let Some(x) = of(&carriers[0])[k] {
                    (if k == 0 { &mut firsts } else { &mut nearest }).push(far(wide(x), k));
                }
                let moved = |m| Some(sub(wide(of(m)[k]?), wide(of(m)[0]?)));
                let moves: Vec<[f64; 3]> = carriers.iter().filter_map(moved).collect();
                if k > 0 && !moves.is_empty() {
                    let mean = |a: usize| moves.iter().map(|m| m[a]).sum::<f64>() / moves.len() as f64;
                    carried.push(far([0, 1, 2].map(|a| start[p][a] + mean(a)), k));
                }
            }
        }
        let asked = self.points * (frames.len() - 1);
        Some(TrackError {
            points: self.points,
            followed: carried.len() as f64 / asked as f64,
            mean: carried.iter().sum::<f64>() / carried.len().max(1) as f64,
            median: median(&mut carried)?,
            nearest: median(&mut nearest)?,
            first: median(&mut firsts)?,
            height: self.height(frames[0], scene.up),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::format::npy::write_f32;
    use splat4d::layers::Layer;
    use splat4d::motion::tracked::{Tracked, TrackedSpec};
    use splat4d::scene::params::OPACITY;
    use splat4d::scene::{GEOMETRY, LifeKind, Params};
    use std::sync::Arc;

    #[test]
    fn points_are_carried_by_the_gaussians_that_were_nearest_at_first() {
        let mut params = Params::new(3, 1, &[]);
        let times = vec![0.0, 0.1, 0.2];
        // The last one is faint and occludes.
        for (r, o) in [(0, 3.0), (1, 3.0), (2, -3.0)] {
            params[GEOMETRY].write(r, 0, [r as f32, 0.0, 0.0, 1.0]);
            params[GEOMETRY].set(r, OPACITY, o);
        }
        let model = Tracked::new(&TrackedSpec { times: times.clone(), foreground: false }, &mut params).unwrap();
        for k in 1..3 {
            (0..2).for_each(|r| params[model.page(k)].set(r, 1, 0.3 * k as f32));
        }
        let motion = Arc::new(model);
        let layer = Layer::new("a", params, motion, LifeKind::Infinite);
        let scene = Scene { layers: vec![layer], clip: [0.0, 0.2], fps: 10.0, up: [1.0, 0.0, 0.0], ..Scene::default() };
        // Two points that rise by 0.5 a frame, 0 and 0.1 next to Gaussians.
        let data: Vec<f32> =
            (0..3).flat_map(|k| [[0.0, 0.5 * k as f32, 0.0], [1.1, 0.5 * k as f32, 0.0]].concat()).collect();
        let mut bytes = Vec::new();
        write_f32(&[3, 2, 3], &data, &mut bytes).unwrap();
        let error = Truth::read(&bytes).unwrap().compare(&scene, 10.0).unwrap();
        assert!((error.height - 1.1).abs() < 1e-6 && error.followed == 1.0 && error.points == 2);
        // Both Gaussians carry each point: 0.3 a frame, where 0.5 is true.
        assert!((error.mean - 0.3).abs() < 1e-6 && (error.median - 0.4).abs() < 1e-6, "{error:?}");
        assert!((error.first - 0.1).abs() < 1e-6 && (error.percent() - 100.0 * 0.4 / 1.1).abs() < 1e-3, "{error:?}");
        assert!((error.nearest - 0.4).abs() < 1e-6, "{error:?}");
        bytes.clear();
        write_f32(&[3, 6], &data, &mut bytes).unwrap();
        assert!(Truth::read(&bytes).is_err());
    }
}
