//! Computer vision on posed images: points for captures without any, and the scale that follows from points.
//!
//! Everything is measured in pixels, angles and ratios: scenes may be in millimetres or kilometres.

pub mod flow;
mod matching;
#[cfg_attr(not(test), expect(dead_code, reason = "sizes to prune and near distances are to be measured by it"))]
pub(crate) mod scale;
mod sweep;
pub mod triangulate;
pub(crate) mod view;

pub use crate::keypoints::{features, raster};

use crate::Result;
use crate::capture::frames::Frames;
use crate::event::Progress;
use matching::Track;
use view::{Rigs, View, spread};

#[cfg(test)]
mod tests;

/// A coloured point, and when it was there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Point {
    /// In the world.
    pub place: [f64; 3],
    /// sRGB in [0, 1].
    pub color: [f32; 3],
    /// Seconds; `None`: during the whole clip.
    pub time: Option<f64>,
}

/// The share of the points that is kept for what moves, where something does.
const MOVING_SHARE: f64 = 0.3;

/// At most `count` points on the static background, and [`MOVING_SHARE`] more on what moves at these times.
pub(crate) fn points(
    frames: &dyn Frames,
    moments: &[f64],
    count: usize,
    progress: &mut Progress<'_>,
) -> Result<Vec<Point>> {
    let parts = 3 + moments.len();
    let mut tell = |done| progress.phase("points from images", done, parts);
    tell(0);
    let rigs = Rigs::of(frames);
    let still = rigs.still(frames)?;
    tell(1);
    let tracks = matching::tracks(&still);
    let known: Vec<[f64; 3]> = tracks.iter().map(|t| t.point).collect();
    tell(2);
    let mut out = on_surfaces(&still, &tracks, &known, count, None);
    tell(3);
    let each = (MOVING_SHARE * count as f64 / moments.len().max(1) as f64) as usize;
    for (k, &t) in moments.iter().enumerate() {
        if let Some((moving, t)) = rigs.moving(frames, &still, t)? {
            out.append(&mut on_surfaces(&moving, &matching::tracks(&moving), &known, each, Some(t)));
        }
        tell(4 + k);
    }
    Ok(out)
}

/// At most `count` points in the requested pixels of the views: up to half of them tracks, the rest by plane sweep in
/// the depths of `known` points.
fn on_surfaces(views: &[View], tracks: &[Track], known: &[[f64; 3]], count: usize, time: Option<f64>) -> Vec<Point> {
    let of_track = |t: &Track| {
        // As in its first view.
        let (view, pixel) = t.seen[0];
        Point { place: t.point, color: views[view].color(pixel), time }
    };
    let mut out: Vec<Point> = spread(tracks.len(), count / 2).map(|k| of_track(&tracks[k])).collect();
    let swept = sweep::sweep(views, known, count - out.len());
    out.extend(swept.into_iter().map(|s| Point { place: s.point, color: s.color, time }));
    out
}
