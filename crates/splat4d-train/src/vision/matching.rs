//! Features of neighbouring cameras, matched along epipolar lines, and the points that they show.

use super::features::{self, Feature, Limits};
use super::triangulate::{PixelObservation, Transfer, angle_at, triangulate};
use super::view::View;
use rayon::prelude::*;
use splat4d::math::se3::{dot, norm, sub};
use splat4d::scene::Camera;

/// A point that several cameras see.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Track {
    /// In the world.
    pub point: [f64; 3],
    /// Numbers of the views that see it, ascending, and where.
    pub seen: Vec<(usize, [f64; 2])>,
    /// Mean distance from where they see it, pixels.
    pub error: f64,
}

/// Neighbours with which a camera is compared, at most.
const NEIGHBOURS: usize = 10;
/// Cameras whose axes are farther apart see other sides of objects, degrees.
const WIDEST: f64 = 70.0;
/// Depths at which two cameras should see the same, of the distance between them: they are then seen at 40 to 3
/// degrees.
const DEPTHS: [f64; 4] = [1.4, 3.0, 8.0, 19.0];
/// Of the probed pixels at the best of these depths, the least that the other camera should hold.
const OVERLAP: f64 = 0.3;
/// Largest distance from an epipolar line and from where a point is seen, pixels.
const OFF: f64 = 1.5;
/// The second best match must be this many times farther away (Lowe 2004: 0.8). Along a line are few, so that
/// this states less than in a whole image: points that only two cameras see must have more.
const RATIO: f64 = 0.8;
const RATIO_OF_TWO: f64 = 0.7;
/// Descriptors farther apart than this have nothing in common: of two bytes' descriptors the squared distance is at
/// most 2 x 512². An eighth of it.
const FAR: u32 = 65_536;
/// Least angle between the outermost rays of a point, degrees.
const NARROW: f64 = 1.5;

/// The points that features of the views show, in the order of their first features.
pub(crate) fn tracks(views: &[View]) -> Vec<Track> {
    let found: Vec<Vec<Feature>> =
        views.par_iter().map(|v| features::find(&v.grey, Limits::default(), &|x, y| v.wants(x, y))).collect();
    let cameras: Vec<&Camera> = views.iter().map(|v| &v.camera).collect();
    let pairs = pairs(&cameras);
    let matches: Vec<Vec<Match>> =
        pairs.par_iter().map(|&[a, b]| matches(views, [a, b], [&found[a], &found[b]])).collect();
    let starts: Vec<usize> = found
        .iter()
        .scan(0, |sum, f| {
            *sum += f.len();
            Some(*sum - f.len())
        })
        .collect();
    let total = found.iter().map(Vec::len).sum();
    let mut best: Vec<(f64, usize, usize)> = Vec::new();
    for (&[a, b], matches) in pairs.iter().zip(&matches) {
        best.extend(matches.iter().map(|m| (m.ratio, starts[a] + m.features[0], starts[b] + m.features[1])));
    }
    best.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let view_of = |feature: usize| starts.partition_point(|s| *s <= feature) - 1;
    let groups = groups(total, &best, &view_of);
    groups
        .par_iter()
        .filter_map(|(group, ratio)| {
            let seen = |&f: &usize| {
                // Views without features start where the next one does.
                let view = view_of(f);
                (view, found[view][f - starts[view]].pixel)
            };
            settle(&cameras, group.iter().map(seen).collect(), *ratio)
        })
        .collect()
}

/// The pairs of cameras that are compared, the lower number first.
pub(crate) fn pairs(cameras: &[&Camera]) -> Vec<[usize; 2]> {
    let centers: Vec<[f64; 3]> = cameras.iter().map(|c| c.center()).collect();
    let spread = centers.iter().map(|&c| norm(sub(c, centers[0]))).fold(0.0, f64::max);
    let mut out: Vec<[usize; 2]> = Vec::new();
    for a in 0..cameras.len() {
        // Cameras that only turn measure nothing: what is left of their distance is rounding.
        let least = (SAME_PLACE * norm(centers[a])).max(SAME_PLACE_OF_RIG * spread);
        let distance = |b: usize| norm(sub(centers[a], centers[b]));
        let mut others: Vec<(f64, usize)> = (0..cameras.len())
            .filter(|&b| b != a && distance(b) > least && overlap(cameras[a], cameras[b]) >= OVERLAP)
            .map(|b| (distance(b), b))
            .collect();
        others.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        // Near ones match best, far ones measure depth best: in steps that grow, because nothing is known of depth.
        let mut rank = 0.0_f64;
        for _ in 0..NEIGHBOURS {
            let Some(&(_, b)) = others.get(rank as usize) else { break };
            out.push([a.min(b), a.max(b)]);
            rank = (rank + 1.0).max(rank * GROWTH);
        }
    }
    out.sort_unstable();
    out.dedup();
    out
}

/// Cameras closer than this have the same position: of their distance from the world's origin (digits of the poses),
/// and of the distances in the rig.
const SAME_PLACE: f64 = 1e-9;
const SAME_PLACE_OF_RIG: f64 = 1e-5;
/// How ranks of neighbours grow: 0 to 4 one by one, then 5, 6, 8, 10, 13.
const GROWTH: f64 = 1.25;

/// Share of a camera's image that another one holds too, at the depth where it holds most.
fn overlap(a: &Camera, b: &Camera) -> f64 {
    /// Search radius in pixels.
    const ASKED: usize = 5;
    let baseline = norm(sub(a.center(), b.center()));
    if dot(a.forward(), b.forward()) < WIDEST.to_radians().cos() {
        return 0.0;
    }
    let transfer = Transfer::new(a, b);
    let held = |depth: f64| {
        let inside = |k: &usize| {
            let at = |k: usize, size: usize| (k as f64 + 0.5) / ASKED as f64 * size as f64;
            let pixel = [at(k % ASKED, a.width), at(k / ASKED, a.height)];
            let seen = transfer.at(pixel, 1.0 / (depth * baseline));
            seen.is_some_and(|[u, v]| (0.0..b.width as f64).contains(&u) && (0.0..b.height as f64).contains(&v))
        };
        (0..ASKED * ASKED).filter(inside).count() as f64 / (ASKED * ASKED) as f64
    };
    DEPTHS.into_iter().map(held).fold(0.0, f64::max)
}

/// A match of two features.
struct Match {
    features: [usize; 2],
    /// Distance of the descriptors, of that to the second best.
    ratio: f64,
}

/// Features of two views that are each other's best along the epipolar lines.
fn matches(views: &[View], [a, b]: [usize; 2], [from, to]: [&[Feature]; 2]) -> Vec<Match> {
    let transfer = Transfer::new(&views[a].camera, &views[b].camera);
    let mut back: Vec<(u32, usize)> = vec![(u32::MAX, 0); to.len()];
    let mut forth: Vec<Option<(usize, f64)>> = Vec::with_capacity(from.len());
    for (i, feature) in from.iter().enumerate() {
        let Some(l) = transfer.line(feature.pixel) else {
            forth.push(None);
            continue;
        };
        let [mut first, mut second] = [(u32::MAX, 0), (u32::MAX, 0)];
        for (j, other) in to.iter().enumerate() {
            if (l[0] * other.pixel[0] + l[1] * other.pixel[1] + l[2]).abs() > OFF {
                continue;
            }
            let d = feature.distance(other);
            back[j] = back[j].min((d, i));
            // One point may have two features, of two directions: they are not rivals.
            let place = |k: usize| to[k].pixel;
            let same = |k: usize| (place(k)[0] - other.pixel[0]).hypot(place(k)[1] - other.pixel[1]) < OFF;
            if d < first.0 {
                if first.0 < u32::MAX && !same(first.1) {
                    second = first;
                }
                first = (d, j);
            } else if d < second.0 && !same(first.1) {
                second = (d, j);
            }
        }
        // What is alone on its line must be as good as if something quite unlike was next to it.
        let ratio = (f64::from(first.0) / f64::from(second.0.clamp(1, FAR))).sqrt();
        forth.push((first.0 < FAR && ratio < RATIO).then_some((first.1, ratio)));
    }
    let mutual = |(i, best): (usize, &Option<(usize, f64)>)| {
        let (j, ratio) = (*best)?;
        (back[j].1 == i).then_some(Match { features: [i, j], ratio })
    };
    forth.iter().enumerate().filter_map(mutual).collect()
}

/// Joins matched features, best matches first, so that no group has two features of one view; with each group the best
/// ratio of its matches. Groups and their features ascend.
fn groups(total: usize, matches: &[(f64, usize, usize)], view_of: &dyn Fn(usize) -> usize) -> Vec<(Vec<usize>, f64)> {
    let mut group_of: Vec<usize> = (0..total).collect();
    let mut members: Vec<Vec<usize>> = (0..total).map(|f| vec![f]).collect();
    let mut ratios = vec![f64::INFINITY; total];
    for &(ratio, a, b) in matches {
        let (a, b) = (group_of[a], group_of[b]);
        let shared = || members[a].iter().any(|&f| members[b].iter().any(|&g| view_of(f) == view_of(g)));
        if a == b || shared() {
            continue;
        }
        let (low, high) = (a.min(b), a.max(b));
        let moved = std::mem::take(&mut members[high]);
        moved.iter().for_each(|&f| group_of[f] = low);
        members[low].extend(moved);
        ratios[low] = ratios[low].min(ratios[high]).min(ratio);
    }
    let mut out: Vec<(Vec<usize>, f64)> = members.into_iter().zip(ratios).filter(|(m, _)| m.len() > 1).collect();
    out.iter_mut().for_each(|(m, _)| m.sort_unstable());
    out
}

/// The point of a group of features: the one that fits worst is left out until all fit.
fn settle(cameras: &[&Camera], mut seen: Vec<(usize, [f64; 2])>, ratio: f64) -> Option<Track> {
    while seen.len() >= 2 {
        let sights: Vec<PixelObservation<'_>> =
            seen.iter().map(|&(view, pixel)| PixelObservation { camera: cameras[view], pixel }).collect();
        let Some(point) = triangulate(&sights) else {
            // Two rays that do not meet are no point; among more, one may spoil the others.
            seen.pop();
            continue;
        };
        let errors: Vec<f64> = sights.iter().map(|s| s.error(point)).collect();
        let worst = (0..errors.len()).max_by(|&a, &b| errors[a].total_cmp(&errors[b])).expect("there are two");
        if errors[worst] > OFF {
            seen.remove(worst);
            continue;
        }
        if seen.len() == 2 && ratio > RATIO_OF_TWO {
            return None;
        }
        let centers: Vec<[f64; 3]> = sights.iter().map(|s| s.camera.center()).collect();
        let widest = (0..centers.len())
            .flat_map(|i| (0..i).map(move |j| (i, j)))
            .map(|(i, j)| angle_at(point, centers[i], centers[j]))
            .fold(0.0, f64::max);
        let error = errors.iter().sum::<f64>() / errors.len() as f64;
        return (widest >= NARROW.to_radians()).then_some(Track { point, seen, error });
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Se3;

    #[test]
    fn cameras_that_only_turn_are_no_pairs() {
        let camera = |x: f64, to: f64| {
            let pose = Se3::look_at([1.0 + x, 2.0, 3.0], [1.0 + x + to, 2.0, 9.0], [0.0, -1.0, 0.0]);
            Camera::with_fov_y(pose, 0.8, 64, 48)
        };
        let turning: Vec<Camera> = (0..5).map(|i| camera(0.0, 0.3 * f64::from(i))).collect();
        assert!(pairs(&turning.iter().collect::<Vec<_>>()).is_empty());
        let walking: Vec<Camera> = (0..3).map(|i| camera(0.3 * f64::from(i), 0.0)).collect();
        assert_eq!(pairs(&walking.iter().collect::<Vec<_>>()), [[0, 1], [0, 2], [1, 2]]);
        let back_to_back = [camera(0.0, 0.0), {
            let pose = Se3::look_at([1.5, 2.0, 3.0], [1.5, 2.0, -3.0], [0.0, -1.0, 0.0]);
            Camera::with_fov_y(pose, 0.8, 64, 48)
        }];
        assert!(pairs(&back_to_back.iter().collect::<Vec<_>>()).is_empty());
    }
}
