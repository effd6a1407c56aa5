//! Visual hull: a random point is kept where (almost) every camera that sees it at that moment has it in its mask.

use super::Seeds;
use super::volume::{Volume, point};
use crate::Result;
use crate::train::frames::{Frames, Picture};
use rayon::prelude::*;
use splat4d::math::Rng;

/// Candidates a wanted point: the hull is a small part of the box.
const CANDIDATES: usize = 60;
/// A point may be outside this share of the masks that see it (masks have ragged edges).
const MISSES: f64 = 0.05;
/// A point must be seen by at least so many pictures.
const MIN_VIEWS: usize = 2;
/// One moving camera: pictures of so many moments around stand in for other cameras.
const MONOCULAR_PICTURES: usize = 60;

struct Seen {
    votes: Vec<(u16, u16)>,
    colors: Vec<Vec<[f32; 3]>>,
}

/// About `count` points over all `times`. For a still scene (`moving` false) masks of the first time stand for all.
pub fn carve(
    frames: &dyn Frames,
    volume: &Volume,
    times: &[f64],
    count: usize,
    moving: bool,
    rng: Rng,
) -> Result<Seeds> {
    let each = count.div_ceil(times.len().max(1));
    let mut out = Seeds::default();
    // A single camera sees one side at a time: all moments together carve one hull, good for every moment.
    let monocular = pictures_near(frames, times[0]).len() < MIN_VIEWS;
    for (k, &t) in times.iter().enumerate() {
        let pictures = if monocular { spread(frames) } else { pictures_near(frames, t) };
        let stamp = (moving && !monocular).then(|| frames.time(pictures[0]).0);
        let wanted = if monocular { count } else { each };
        let mut kept = carve_moment(frames, &pictures, volume, wanted, rng.fork(k as u64))?;
        kept.times.fill(stamp);
        out.append(kept);
        if monocular {
            break;
        }
    }
    Ok(out)
}

/// The frames at the distinct time nearest to t.
fn pictures_near(frames: &dyn Frames, t: f64) -> Vec<usize> {
    let Some(best) = (0..frames.len()).map(|i| frames.time(i).0).min_by(|a, b| (a - t).abs().total_cmp(&(b - t).abs()))
    else {
        return Vec::new();
    };
    (0..frames.len()).filter(|&i| frames.time(i).0 == best).collect()
}

fn spread(frames: &dyn Frames) -> Vec<usize> {
    let step = frames.len().div_ceil(MONOCULAR_PICTURES).max(1);
    (0..frames.len()).step_by(step).collect()
}

fn carve_moment(frames: &dyn Frames, pictures: &[usize], volume: &Volume, wanted: usize, rng: Rng) -> Result<Seeds> {
    let total = wanted * CANDIDATES;
    let points: Vec<[f64; 3]> = (0..total as u64).map(|i| point(volume, rng, i)).collect();
    let mut seen = Seen { votes: vec![(0, 0); total], colors: vec![Vec::new(); total] };
    let mut picture = Picture::default();
    for &i in pictures {
        frames.load(i, &mut picture)?;
        let Some(mask) = &picture.mask else { continue };
        let camera = frames.camera(i);
        points.par_iter().zip(&mut seen.votes).zip(&mut seen.colors).for_each(|((x, (views, inside)), colors)| {
            // Out of the race already: save the work.
            if f64::from(*views - *inside) > MISSES * pictures.len() as f64 {
                return;
            }
            let Some(([u, v], _)) = camera.project(*x) else { return };
            if !(u >= 0.0 && v >= 0.0 && u < mask.width as f64 && v < mask.height as f64) {
                return;
            }
            *views += 1;
            let (px, py) = (u as usize, v as usize);
            if mask.get(0, py, px) > 0.5 {
                *inside += 1;
                colors.push(std::array::from_fn(|c| picture.color.get(c, py, px)));
            }
        });
    }
    let mut out = Seeds::default();
    for (i, x) in points.iter().enumerate() {
        let (views, inside) = seen.votes[i];
        let enough = usize::from(views) >= MIN_VIEWS.max(pictures.len() / 4);
        if enough && f64::from(views - inside) <= MISSES * f64::from(views) {
            out.push(*x, median(&mut seen.colors[i]), None);
        }
    }
    out.truncate_evenly(wanted, rng.fork(77));
    Ok(out)
}

fn median(colors: &mut [[f32; 3]]) -> [f32; 3] {
    std::array::from_fn(|c| {
        colors.sort_by(|a, b| a[c].total_cmp(&b[c]));
        colors[colors.len() / 2][c]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::init::volume::common;
    use crate::train::tests::Made;

    #[test]
    fn hull_points_lie_in_the_object_that_moves() {
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
}
