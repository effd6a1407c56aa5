//! Forecasts compared with the later images.

use super::{Forecast, Work};
use crate::deadline::unless_stopped;
use crate::draw::Rgb;
use crate::draw::{Painter, color_rgb};
use crate::events::Listener;
use crate::ground_truth::tracks;
use crate::report::predict::ModelScores;
use crate::video::{Film, have_ffmpeg};
use splat4d::format::npy::Npy;
use splat4d::layers::Scene;
use splat4d::math::se3::{add, norm, scale, sub};
use splat4d::scene::Planes;
use splat4d::{Error, Result};
use splat4d_dynamics::paths::{Moment, carried};
use splat4d_dynamics::score::{skill, win_rate};
use splat4d_train::eval::metrics::{psnr, psnr_region};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// A pixel has changed where a channel differs by more from the last observed image (the metrics' threshold of motion).
const CHANGED: f32 = 0.05;
/// Nodes that carry a true point.
const CARRIERS: usize = 4;
/// dB reported for equal images: 8 bits resolve no more.
const MOST_DB: f64 = 99.0;

/// An image of the future, and the last observed one of the same camera.
struct View {
    frame: usize,
    horizon: usize,
    before: Option<usize>,
}

/// The images that forecasts are compared with.
pub(super) struct Views {
    views: Vec<View>,
    /// True paths of points: \[frames]\[points], from the first observed frame on.
    truth: Option<Vec<Vec<[f64; 3]>>>,
}

/// One comparison.
#[derive(Clone, Copy, Debug)]
pub(super) struct Case {
    horizon: usize,
    psnr: f64,
    moving: Option<f64>,
}

/// The quality of a model, by its comparisons and those of freeze and constant velocity.
pub(super) fn scores(name: &str, own: &[Case], baselines: [&Vec<Case>; 2], horizon: usize) -> ModelScores {
    let mean = |of: &dyn Fn(&Case) -> Option<f64>, at: Option<usize>| {
        let all: Vec<f64> = own.iter().filter(|c| at.is_none_or(|h| c.horizon == h)).filter_map(of).collect();
        (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
    };
    let (whole, moving) = (|c: &Case| Some(c.psnr), |c: &Case| c.moving);
    let by = |of: &dyn Fn(&Case) -> Option<f64>| (1..=horizon).map(|h| mean(of, Some(h))).collect();
    let squares = |cases: &[Case]| -> Vec<f64> {
        let any = own.iter().any(|c| c.moving.is_some());
        cases.iter().filter_map(|c| if any { c.moving } else { Some(c.psnr) }).map(square).collect()
    };
    let (mine, total) = (squares(own), |v: &[f64]| v.iter().sum::<f64>());
    let over = baselines.map(|b| squares(b));
    let skills = over.each_ref().map(|b| (!mine.is_empty()).then(|| skill(total(&mine), total(b))));
    let wins = over.each_ref().map(|b| win_rate(&mine, b));
    ModelScores {
        name: name.into(),
        psnr: mean(&whole, None),
        psnr_dynamic: mean(&moving, None),
        psnr_by_horizon: by(&whole),
        psnr_dynamic_by_horizon: by(&moving),
        skill_over_freeze: skills[0],
        skill_over_velocity: skills[1],
        win_over_freeze: wins[0],
        win_over_velocity: wins[1],
        ..ModelScores::default()
    }
}

/// The mean squared error behind a PSNR.
fn square(db: f64) -> f64 {
    10f64.powf(-0.1 * db)
}

impl Views {
    /// Images of the future of cameras that training never saw, where there are such; else of all.
    pub(super) fn new(work: &Work) -> Result<Self> {
        let capture = &work.capture;
        let camera = |i: &usize| capture.frames[*i].camera;
        let trained: BTreeSet<usize> = capture.train.iter().map(camera).collect();
        let fresh = capture.future.iter().any(|i| !trained.contains(&camera(i)));
        let last = |of: usize| {
            let seen = capture.train.iter().chain(&capture.held).copied();
            let same = seen.filter(|&i| capture.cameras[of].fixed && capture.frames[i].camera == of);
            same.max_by(|&a, &b| capture.frames[a].time.0.total_cmp(&capture.frames[b].time.0))
        };
        let mut views = Vec::new();
        for &frame in capture.future.iter().filter(|i| !fresh || !trained.contains(&camera(i))) {
            let time = capture.frames[frame].time.0;
            let horizon = ((time - work.clock.until) * work.clock.fps).round() as usize;
            if (1..=work.horizon).contains(&horizon) {
                views.push(View { frame, horizon, before: last(camera(&frame)) });
            }
        }
        Ok(Self { views, truth: read_tracks(work)? })
    }

    pub(super) fn len(&self) -> usize {
        self.views.len()
    }

    /// Frames of the horizon that there are images of.
    pub(super) fn pictured(&self) -> usize {
        self.views.iter().map(|v| v.horizon).collect::<BTreeSet<_>>().len()
    }

    /// Renders a scene from where images were taken, and compares.
    pub(super) fn cases(&self, work: &Work, scene: &Scene<f32>, stop: &AtomicBool) -> Result<Vec<Case>> {
        let mut painter = Painter::new(scene, scene.background, work.antialias, false);
        let mut out = Vec::new();
        for view in &self.views {
            unless_stopped(stop)?;
            let frame = &work.capture.frames[view.frame];
            painter.draw(&frame.view, frame.time.0);
            let truth = work.store.load(view.frame)?.to_picture();
            let (render, truth) = (&painter.image.color, &truth.color);
            let moving = match view.before {
                Some(before) => {
                    let before = work.store.load(before)?.to_picture().color;
                    psnr_region(render, truth, &changed(truth, &before))
                }
                None => None,
            };
            let psnr = psnr(render, truth).unwrap_or(MOST_DB).min(MOST_DB);
            out.push(Case { horizon: view.horizon, psnr, moving: moving.map(|m| m.min(MOST_DB)) });
        }
        Ok(out)
    }

    /// Mean distance of known points from the truth, by horizon: each is carried by the nodes nearest to it.
    pub(super) fn track_errors(&self, work: &Work, moments: &[Moment]) -> Option<Vec<f64>> {
        let truth = self.truth.as_ref()?;
        let (rest, from) = (work.observed.paths.last(), work.ticks - 1);
        let ties: Vec<Vec<(usize, f64)>> = truth[from].iter().map(|x| carriers(*x, rest)).collect();
        let error = |(h, moment): (usize, &Moment)| {
            let now = truth.get(from + 1 + h)?;
            let one = |(i, tie): (usize, &Vec<(usize, f64)>)| {
                let x = tie
                    .iter()
                    .fold([0.0; 3], |sum, &(k, w)| add(sum, scale(carried(truth[from][i], &rest[k], &moment[k]), w)));
                norm(sub(x, now[i]))
            };
            Some(ties.iter().enumerate().map(one).sum::<f64>() / ties.len().max(1) as f64)
        };
        Some(moments.iter().enumerate().map_while(error).collect())
    }

    /// Films of truth (left) and prediction (right), one per camera of the first two.
    pub(super) fn films(
        &self,
        work: &Work,
        folder: &Path,
        forecast: &Forecast,
        stop: &AtomicBool,
        console: &dyn Listener,
    ) -> Result<Vec<(String, PathBuf)>> {
        const CAMERAS: usize = 2;
        let mut cameras: Vec<usize> = self.views.iter().map(|v| work.capture.frames[v.frame].camera).collect();
        cameras.sort_unstable();
        cameras.dedup();
        let mut out = Vec::new();
        let mut painter = Painter::new(&forecast.scene, forecast.scene.background, work.antialias, false);
        for camera in cameras.into_iter().take(CAMERAS) {
            let mut shots: Vec<&View> =
                self.views.iter().filter(|v| work.capture.frames[v.frame].camera == camera).collect();
            shots.sort_by_key(|v| v.horizon);
            let size = &work.capture.frames[shots[0].frame].view;
            let name = &work.capture.cameras[camera].name;
            let file: String = name.chars().map(|c| if c.is_alphanumeric() { c } else { '-' }).collect();
            let path = folder.join(format!("film-{file}.{}", if have_ffmpeg() { "mp4" } else { "png" }));
            let fps = work.clock.fps.min(30.0);
            let mut film = Film::create(&path, [2 * size.width, size.height], fps, shots.len(), None)?;
            for (i, shot) in shots.iter().enumerate() {
                unless_stopped(stop)?;
                console.phase("filming", i, shots.len());
                let frame = &work.capture.frames[shot.frame];
                painter.draw(&frame.view, frame.time.0);
                let truth = work.store.load(shot.frame)?.to_picture().color;
                film.frame(&side_by_side(&color_rgb(&truth), &color_rgb(&painter.image.color)))?;
            }
            film.finish()?;
            console.clear();
            out.push((name.clone(), path));
        }
        Ok(out)
    }
}

/// Pixels that are not as they were.
fn changed(now: &Planes<f32>, before: &Planes<f32>) -> Vec<bool> {
    let differs = |p: usize| (0..now.channels).any(|c| (now.plane(c)[p] - before.plane(c)[p]).abs() > CHANGED);
    (0..now.pixels()).map(differs).collect()
}

/// Two images of one size side by side.
fn side_by_side(left: &Rgb, right: &Rgb) -> Rgb {
    let rows = left.data.chunks_exact(3 * left.width).zip(right.data.chunks_exact(3 * right.width));
    let data = rows.flat_map(|(l, r)| [l, r].concat()).collect();
    Rgb { width: left.width + right.width, height: left.height, data }
}

/// The nodes nearest to a point, and the weights of each: inverse squared distances.
fn carriers(x: [f64; 3], rest: &Moment) -> Vec<(usize, f64)> {
    let mut order: Vec<(usize, f64)> = rest.iter().enumerate().map(|(k, p)| (k, norm(sub(p.x, x)))).collect();
    order.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
    order.truncate(CARRIERS);
    let weight = |d: f64| 1.0 / (d * d).max(f64::MIN_POSITIVE);
    let all: f64 = order.iter().map(|o| weight(o.1)).sum();
    order.into_iter().map(|(k, d)| (k, weight(d) / all)).collect()
}

/// True paths that the capture brings along, from the first observed frame on. Errors: a file that is damaged.
fn read_tracks(work: &Work) -> Result<Option<Vec<Vec<[f64; 3]>>>> {
    let path = work.capture.root.join(tracks::FILE);
    if !path.is_file() {
        return Ok(None);
    }
    let bytes = crate::files::read(&path)?;
    let array = Npy::read(&bytes).map_err(|e| e.at(path.display()))?;
    let &[frames, points, 3] = array.shape.as_slice() else {
        return Err(Error::input(format!("true tracks have shape {:?}, not [frames, points, 3]", array.shape))
            .at(path.display())
            .remedy("Save them as float32 [frames, points, 3], or remove the file"));
    };
    let first = (work.scene.clip[0] * work.clock.fps).round() as usize;
    let numbers = array.to_f64();
    let at = |t: usize, i: usize| std::array::from_fn(|c| numbers[3 * (t * points + i) + c]);
    let all: Vec<Vec<[f64; 3]>> = (first..frames).map(|t| (0..points).map(|i| at(t, i)).collect()).collect();
    Ok((all.len() >= work.ticks).then_some(all))
}
