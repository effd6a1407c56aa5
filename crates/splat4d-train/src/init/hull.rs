//! Visual hull: a random point is kept where (almost) every camera that sees it at that time has it in its silhouette:
//! the mask, or where fixed cameras have none, what differs from the static background.

use super::Seeds;
use super::volume::Volume;
use crate::Result;
use crate::capture::frames::{Frames, Picture, half_frame};
use crate::vision::view::{Rigs, View};
use rayon::prelude::*;
use splat4d::math::{Rng, median_by};
use splat4d::scene::Camera;
use std::collections::BTreeMap;

/// Candidates per requested point: the hull is a small part of the box.
const CANDIDATES: usize = 40;
/// Rounds of narrowing the box.
const ROUNDS: u64 = 4;
/// The next round's box is this much larger on every side than what was kept.
const MARGIN: f64 = 0.05;
/// A point may be outside this share of the silhouettes that see it: masks have ragged edges, and moving objects have
/// holes where they resemble the background (0.25 gave more ghosts: 0.3 dB less in static regions).
const MISSES: f64 = 0.05;
const MOVING_MISSES: f64 = 0.15;
/// Points of dynamic regions, of those that are requested: all of them took Gaussians away from the static background
/// (0.4 dB less there, no gain in dynamic ones).
const MOVING_SHARE: f64 = 0.3;
/// Moving regions are dilated by this many pixels, because they hide the edges behind them.
const GROWN: usize = 1;
/// Cameras that must see something move for its hull to be more than a cone: of four the hull was worse than nothing.
const MOVING_CAMERAS: usize = 5;
/// A camera in which more of the image differs (an exposure that was changed, a camera that was pushed) shows no
/// silhouette.
const MOVING_PICTURE: f64 = 0.5;
/// A point must be seen by at least this many images.
const MIN_VIEWS: usize = 2;
/// One moving camera: images of this many times around replace other cameras.
const MONOCULAR_PICTURES: usize = 60;

/// About `count` points over all `times`. For a still scene (`moving` false) masks of the first time represent all.
pub(crate) fn carve(
    frames: &dyn Frames,
    volume: &Volume,
    times: &[f64],
    count: usize,
    moving: bool,
    rng: Rng,
) -> Result<Seeds> {
    let each = count.div_ceil(times.len().max(1));
    let mut out = Seeds::default();
    // A single camera sees one side at a time: all times together carve one hull for every time.
    let monocular = images_near(frames, times[0]).1.len() < MIN_VIEWS;
    for (k, &t) in times.iter().enumerate() {
        let (near, mut pictures) = images_near(frames, t);
        let stamp = (moving && !monocular).then_some(near);
        if monocular {
            pictures = spread(frames);
        }
        let wanted = if monocular { count } else { each };
        let shown = |vote: &mut dyn FnMut(Silhouette<'_>)| {
            let mut picture = Picture::default();
            for &i in &pictures {
                frames.load(i, &mut picture)?;
                let (Some(mask), color) = (&picture.mask, &picture.color) else { continue };
                let color = |p: usize| std::array::from_fn(|c| color.plane(c)[p]);
                vote(Silhouette { camera: frames.camera(i), inside: &|p| mask.data[p] > 0.5, color: &color });
            }
            Ok(())
        };
        let silhouettes = Silhouettes { count: pictures.len(), misses: MISSES, shown: &shown };
        let mut kept = carve_time(&silhouettes, volume, wanted, rng.fork(k as u64))?;
        kept.times.fill(stamp);
        out.append(kept);
        if monocular {
            break;
        }
    }
    Ok(out)
}

/// The distinct time nearest to t and its frames; of cameras whose shutters do not open at once the frame that is
/// nearest to it, if that is less than half a frame.
pub(super) fn images_near(frames: &dyn Frames, t: f64) -> (f64, Vec<usize>) {
    let all = || (0..frames.len()).map(|i| (frames.rig(i), frames.time(i).0));
    let Some(best) = all().map(|(_, time)| time).min_by(|a, b| (a - t).abs().total_cmp(&(b - t).abs())) else {
        return (t, Vec::new());
    };
    let half = half_frame(all());
    let mut near: BTreeMap<usize, (f64, Vec<usize>)> = BTreeMap::new();
    for (i, (rig, time)) in all().enumerate() {
        let apart = (time - best).abs();
        let entry = near.entry(rig).or_insert((f64::INFINITY, Vec::new()));
        if apart < entry.0 {
            *entry = (apart, Vec::new());
        }
        if apart == entry.0 && (apart == 0.0 || apart < half) {
            entry.1.push(i);
        }
    }
    let mut chosen: Vec<usize> = near.into_values().flat_map(|(_, frames)| frames).collect();
    chosen.sort_unstable();
    (best, chosen)
}

fn spread(frames: &dyn Frames) -> Vec<usize> {
    let step = frames.len().div_ceil(MONOCULAR_PICTURES).max(1);
    (0..frames.len()).step_by(step).collect()
}

/// Points on dynamic regions over all `times`, [`MOVING_SHARE`] of `count`, of fixed cameras without masks; none where
/// cameras move or are few.
pub(crate) fn carve_moving(
    frames: &dyn Frames,
    volume: &Volume,
    times: &[f64],
    count: usize,
    rng: Rng,
) -> Result<Seeds> {
    let rigs = Rigs::of(frames);
    let still = match &rigs {
        Rigs::Fixed(cameras) if cameras.len() >= MOVING_CAMERAS => rigs.still(frames)?,
        _ => return Ok(Seeds::default()),
    };
    let each = (MOVING_SHARE * count as f64 / times.len().max(1) as f64).ceil() as usize;
    let mut out = Seeds::default();
    for (k, &t) in times.iter().enumerate() {
        let Some((views, t)) = rigs.moving(frames, &still, t)? else { break };
        let mut kept = carve_views(views, volume, each, rng.fork(k as u64))?;
        kept.times.fill(Some(t));
        out.append(kept);
    }
    Ok(out)
}

/// About `count` points of what several cameras see in the pixels that they want; none where few of them do.
pub(crate) fn carve_views(mut views: Vec<View>, volume: &Volume, count: usize, rng: Rng) -> Result<Seeds> {
    let share = |v: &View| v.wanted.iter().filter(|w| **w).count() as f64 / v.wanted.len() as f64;
    views.retain(|v| share(v) <= MOVING_PICTURE);
    if views.iter().filter(|v| v.wanted.contains(&true)).count() < MOVING_CAMERAS {
        return Ok(Seeds::default());
    }
    views.par_iter_mut().for_each(|v| v.wanted = grown(&v.wanted, v.camera.width));
    let shown = |vote: &mut dyn FnMut(Silhouette<'_>)| {
        for view in &views {
            let color = |p: usize| view.colors[p].map(|b| f32::from(b) / 255.0);
            vote(Silhouette { camera: &view.camera, inside: &|p| view.wanted[p], color: &color });
        }
        Ok(())
    };
    carve_time(&Silhouettes { count: views.len(), misses: MOVING_MISSES, shown: &shown }, volume, count, rng)
}

/// A mask that is larger by [`GROWN`] pixels to every side.
fn grown(mask: &[bool], width: usize) -> Vec<bool> {
    let height = mask.len() / width;
    let near = |p: usize, of: usize| p.saturating_sub(GROWN)..(p + GROWN + 1).min(of);
    let any = |p: usize| near(p / width, height).any(|y| near(p % width, width).any(|x| mask[y * width + x]));
    (0..mask.len()).map(any).collect()
}

/// One camera's silhouette at a time, by pixels.
struct Silhouette<'a> {
    camera: &'a Camera,
    inside: &'a (dyn Fn(usize) -> bool + Sync),
    color: &'a (dyn Fn(usize) -> [f32; 3] + Sync),
}

/// Adds every camera's silhouette, one after the other.
type Shown<'a> = dyn Fn(&mut dyn FnMut(Silhouette<'_>)) -> Result<()> + 'a;

/// Those of all cameras.
struct Silhouettes<'a> {
    count: usize,
    /// Share of them that a point may be outside of.
    misses: f64,
    shown: &'a Shown<'a>,
}

/// Carves one time in rounds: each searches only the box of the points that the last one kept, so that a small object
/// in a large volume still gets its points.
fn carve_time(silhouettes: &Silhouettes<'_>, volume: &Volume, wanted: usize, rng: Rng) -> Result<Seeds> {
    let mut low = volume.center.map(|c| c - volume.radius);
    let mut high = volume.center.map(|c| c + volume.radius);
    let mut out = Seeds::default();
    for round in 0..ROUNDS {
        let round_rng = rng.fork(round);
        let points: Vec<[f64; 3]> = (0..(wanted * CANDIDATES) as u64)
            .map(|i| std::array::from_fn(|k| low[k] + (high[k] - low[k]) * round_rng.uniform(3 * i + k as u64)))
            .collect();
        let kept = vote(silhouettes, &points)?;
        if kept.is_empty() {
            break;
        }
        for k in 0..3 {
            let side = (high[k] - low[k]) * MARGIN;
            let values = || kept.points.iter().map(|p| p[k]);
            (low[k], high[k]) = (
                low[k].max(values().fold(f64::INFINITY, f64::min) - side),
                high[k].min(values().fold(f64::NEG_INFINITY, f64::max) + side),
            );
        }
        let enough = kept.len() >= wanted;
        out = kept;
        if enough {
            break;
        }
    }
    out.truncate_evenly(wanted, rng.fork(77));
    Ok(out)
}

/// The images' votes on one point.
#[derive(Clone, Default)]
struct Votes {
    views: usize,
    inside: usize,
    colors: Vec<[f32; 3]>,
}

/// The points that are in (almost) all silhouettes that see them, with their median colour. One image at a time is
/// held.
fn vote(silhouettes: &Silhouettes<'_>, points: &[[f64; 3]]) -> Result<Seeds> {
    let allowed = silhouettes.misses * silhouettes.count as f64;
    let mut votes = vec![Votes::default(); points.len()];
    (silhouettes.shown)(&mut |shown| {
        let Silhouette { camera, inside, color } = shown;
        points.par_iter().zip(&mut votes).for_each(|(x, v)| {
            if (v.views - v.inside) as f64 > allowed {
                return;
            }
            let Some(([px, py], _)) = camera.project(*x) else { return };
            if !(px >= 0.0 && py >= 0.0 && px < camera.width as f64 && py < camera.height as f64) {
                return;
            }
            v.views += 1;
            let pixel = py as usize * camera.width + px as usize;
            if inside(pixel) {
                v.inside += 1;
                v.colors.push(color(pixel));
            } else if (v.views - v.inside) as f64 > allowed {
                v.colors = Vec::new();
            }
        });
    })?;
    let mut out = Seeds::default();
    for (x, v) in points.iter().zip(&mut votes) {
        let misses = (v.views - v.inside) as f64;
        let enough = v.views >= MIN_VIEWS.max(silhouettes.count.div_ceil(2));
        if enough && misses <= allowed && misses <= silhouettes.misses * v.views as f64 {
            out.push(*x, median(&mut v.colors), None);
        }
    }
    Ok(out)
}

fn median(colors: &mut [[f32; 3]]) -> [f32; 3] {
    std::array::from_fn(|c| median_by(colors, |a, b| a[c].total_cmp(&b[c])).expect("a voxel has colours")[c])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::init::volume::common;
    use crate::step::tests::Made;

    #[test]
    fn hull_points_are_inside_the_moving_object() {
        let frames = Made::new(6, 4, 32);
        let times: Vec<f64> = (0..4).map(|k| frames.time_of(k)).collect();
        let seeds = carve(&frames, &common(&frames), &times, 200, true, Rng::new(1, "hull", 0)).unwrap();
        assert!(seeds.len() >= 50, "{}", seeds.len());
        for (x, t) in seeds.points.iter().zip(&seeds.times) {
            let c = frames.object_at(t.unwrap());
            let far = splat4d::math::se3::norm(splat4d::math::se3::sub(*x, c));
            assert!(far < 1.6 * Made::RADIUS, "{x:?} is {far} from the object at {t:?}");
        }
    }

    #[test]
    fn dynamic_regions_are_carved_without_masks_from_enough_fixed_cameras() {
        let frames = Made::new(6, 9, 48);
        let times: Vec<f64> = [1, 4, 7].map(|k| frames.time_of(k)).to_vec();
        let rng = Rng::new(1, "hull", 0);
        let seeds = carve_moving(&frames, &common(&frames), &times, 300, rng).unwrap();
        assert!(seeds.len() >= 50, "{}", seeds.len());
        let mut near = 0;
        for (x, t) in seeds.points.iter().zip(&seeds.times) {
            let t = t.expect("what moves is somewhere at a time");
            assert!(times.contains(&t), "{t}");
            let far = splat4d::math::se3::norm(splat4d::math::se3::sub(*x, frames.object_at(t)));
            near += usize::from(far < 1.6 * Made::RADIUS);
        }
        // One camera of six may miss a point: a few stand where five of them see the ball in front of something else.
        assert!(near * 10 >= 8 * seeds.len(), "{near} of {}", seeds.len());
        let few = Made::new(MOVING_CAMERAS - 1, 9, 48);
        assert!(carve_moving(&few, &common(&few), &times, 300, rng).unwrap().is_empty(), "a cone");
        let short = Made::new(6, 2, 48);
        assert!(
            carve_moving(&short, &common(&short), &times[..1], 300, rng).unwrap().is_empty(),
            "nobody knows what stands"
        );
    }
}
