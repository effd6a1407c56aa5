//! Structure from motion: poses, lenses, time offsets and points of images without any.
//!
//! A fixed camera is one image: the features of its median background, and the features of moving objects at some
//! shared times. Moving objects are evidence where walls are ambiguous. Each of their features has a velocity, so time
//! offsets are found together with poses (`adjust`). Each frame of a moving camera is an image.

pub mod adjust;
pub(crate) mod algebra;
pub mod align;
pub mod known;
pub mod learned;
pub mod lens;
mod linking;
pub mod mapper;
mod overlay;
pub mod pictures;
pub mod resection;
mod sample;
pub(crate) mod tracks;
pub mod two_view;

use crate::{Error, Result};
use lens::Lens;
use mapper::Mapping;
use pictures::{CameraView, FeatureOptions, Pictures};
use splat4d::math::Se3;
use splat4d::math::se3::{norm, sub};
use splat4d_train::event::Progress;
use tracks::{Link, Pairing};

/// A camera, and the frame of a moving one.
type CameraFrame = (usize, Option<usize>);

/// How poses are found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Options {
    /// Source of features.
    pub look: FeatureOptions,
    /// How cameras are placed.
    pub mapping: Mapping,
    /// Whether cameras move: then every frame is placed on its own, at most this many of them.
    pub walking: Option<usize>,
}

/// Pose of an image: a fixed camera's, or one frame's of a moving one.
#[derive(Clone, Debug)]
pub struct Taken {
    /// The camera.
    pub camera: usize,
    /// The frame of a moving camera.
    pub frame: Option<usize>,
    /// Its name in messages.
    pub name: String,
    /// Its pose, or the reason for none.
    pub placed: Result<Placed, String>,
}

/// Pose of a camera.
#[derive(Clone, Copy, Debug)]
pub struct Placed {
    /// Takes world points into the camera's axes.
    pub pose: Se3,
    /// In pixels of the files' images; of cameras whose lens was known without distortion, which took it away.
    pub lens: Lens,
    /// Pixels across and down of the files' images (of those that were halved: a little less).
    pub size: [usize; 2],
    /// How far its clock is ahead, seconds: to be taken from its times. Only differences between cameras mean anything.
    pub tau: f64,
    /// Points that it sees consistently.
    pub sightings: usize,
    /// Their median distance from where they are seen, pixels of the files' images.
    pub error: f64,
}

/// A point that cameras agreed on.
#[derive(Clone, Debug)]
pub struct Point {
    /// In the world.
    pub place: [f64; 3],
    /// sRGB.
    pub color: [u8; 3],
    /// 0: it is static; otherwise the time it was seen at.
    pub moment: usize,
    /// Images that see it, by their place in [`Solution::taken`].
    pub seen: Vec<usize>,
    /// Mean distance from where it is seen, pixels of the images that were worked with.
    pub error: f64,
}

/// Poses, lenses, clocks and points.
#[derive(Clone, Debug)]
pub struct Solution {
    /// One for each camera, or for each frame that was chosen of moving ones.
    pub taken: Vec<Taken>,
    /// Their points.
    pub points: Vec<Point>,
    /// Upwards in the world, guessed: what most cameras hold upwards (unit).
    pub up: [f64; 3],
    /// Pairs of images that were found to show one scene.
    pub pairs: usize,
    /// For each camera with a known pose, the deviation from it: epipolar distance of matches that were found without
    /// it, at the median, pixels of the files' images. None: too few matches.
    pub contradiction: Vec<Option<f64>>,
    /// Of each of [`Solution::taken`], the points that move by which its clock was found.
    pub moving: Vec<usize>,
    /// Of each of them, whether motion in it contradicts the others: it shows another time, or another recording.
    pub stray: Vec<bool>,
}

/// Finds where images were taken from.
///
/// The world's unit is the median distance of the cameras from the points; its axes are those of the camera that was
/// placed first. Scale and the vertical need other sources. If all poses are known, so are unit and axes: then only
/// points and clocks are found.
///
/// `stop` is called between pairs that a matcher works on.
///
/// Errors: images that cannot be read; no two that show one scene; those of a matcher; `stop` requested it.
pub fn solve(
    pictures: &dyn Pictures,
    options: &Options,
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<Solution> {
    let (who, mut sights, pairing): (Vec<CameraFrame>, Vec<CameraView>, Pairing) = match options.walking {
        None => {
            let sights = pictures::fixed(pictures, &options.look, progress)?;
            ((0..sights.len()).map(|c| (c, None)).collect(), sights, Pairing::All)
        }
        Some(most) => {
            let all = pictures::walking(pictures, &options.look, most, progress)?;
            let pairing = if all.len() <= ALL_UP_TO { Pairing::All } else { WALK };
            let who = all.iter().map(|(c, k, _)| (*c, Some(*k))).collect();
            (who, all.into_iter().map(|(_, _, s)| s).collect(), pairing)
        }
    };
    let mut links = tracks::links(&sights, pairing, options.mapping.seed, progress);
    if let Some(matcher) = pictures.matcher() {
        let views = linking::Views { pictures, who: &who, pixels: options.look.pixels, seed: options.mapping.seed };
        linking::link(matcher, &views, &mut sights, pairing, &mut links, progress, stop)?;
    }
    solve_sights(&who, &sights, &links, options, progress)
}

/// This many frames are all compared with each other.
const ALL_UP_TO: usize = 50;
/// Of more, neighbours and loops.
const WALK: Pairing = Pairing::Sequence { near: 10, every: 6 };

fn solve_sights(
    who: &[CameraFrame],
    sights: &[CameraView],
    links: &[Link],
    options: &Options,
    progress: &mut Progress<'_>,
) -> Result<Solution> {
    if sights.iter().all(|s| s.pose.is_some()) {
        let mapped = known::about(sights, links, &options.mapping, progress);
        return Ok(solution(who, sights, mapped, links.len(), 1.0));
    }
    let alone = || {
        Error::input("no two of these images show the same scene").remedy(
            "Film one scene with neighbouring cameras at most 20 degrees apart, in focus and well lit \
             (docs/filming.md); or match them by a network (--matcher, docs/networks.md), or click a few points in all cameras \
             (--assist, docs/assist.md).",
        )
    };
    if links.is_empty() {
        return Err(alone());
    }
    let joined = tracks::join(sights, links);
    let focals = tracks::focal_votes(sights, links, &mapper::FOCALS);
    let mapped = mapper::map(sights, &joined, links, &focals, &options.mapping, progress).ok_or_else(alone)?;
    Ok(in_units(who, sights, mapped, links.len()))
}

/// The solution whose unit is the median distance of cameras from what they see.
fn in_units(who: &[CameraFrame], sights: &[CameraView], mapped: mapper::Mapped, pairs: usize) -> Solution {
    let mut distances = vec![Vec::new(); sights.len()];
    for p in &mapped.points {
        for &s in &p.seen {
            if let Ok(camera) = &mapped.cameras[s] {
                distances[s].push(norm(sub(p.place, camera.pose.inverse().translation)));
            }
        }
    }
    let scale = 1.0 / align::median_distance(&mut distances).unwrap_or(1.0);
    solution(who, sights, mapped, pairs, scale)
}

/// The solution in a unit of this many of the map's.
fn solution(who: &[CameraFrame], sights: &[CameraView], mapped: mapper::Mapped, pairs: usize, scale: f64) -> Solution {
    let placed = |(camera, sight): (&Result<mapper::PlacedCamera, String>, &CameraView)| {
        camera.as_ref().map_err(Clone::clone).map(|c| Placed {
            pose: Se3 { rotation: c.pose.rotation, translation: c.pose.translation.map(|t| t * scale) },
            lens: c.lens.scaled(sight.factor),
            size: sight.size.map(|v| (v as f64 * sight.factor) as usize),
            tau: c.tau,
            sightings: c.sightings,
            error: c.error * sight.factor,
        })
    };
    let taken: Vec<Taken> = mapped
        .cameras
        .iter()
        .zip(sights)
        .zip(who)
        .map(|(c, &(camera, frame))| Taken { camera, frame, name: c.1.name.clone(), placed: placed(c) })
        .collect();
    let point = |p: mapper::MapPoint| Point {
        place: p.place.map(|v| v * scale),
        color: p.color,
        moment: p.moment,
        seen: p.seen,
        error: p.error,
    };
    let poses: Vec<Se3> = taken.iter().filter_map(|t| t.placed.as_ref().ok().map(|p| p.pose)).collect();
    Solution {
        up: align::up_of(&poses),
        points: mapped.points.into_iter().map(point).collect(),
        taken,
        pairs,
        contradiction: mapped.contradiction,
        moving: mapped.moving,
        stray: mapped.stray,
    }
}

#[cfg(test)]
mod tests;
