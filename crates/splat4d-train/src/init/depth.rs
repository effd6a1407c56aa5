//! Points that depth maps show: pixels of training images, unprojected. A point through which an image of another time
//! sees what is farther away belongs to something that moves: its lifespan is around its time, and it begins with the
//! velocity that optical flow and the depth at both of its ends determine ([`super::scene_flow`]). All others are
//! static.

use super::map::Map;
use super::{Seeds, scene_flow};
use crate::Result;
use crate::capture::frames::{Frames, Picture};
use rayon::prelude::*;
use splat4d::math::Rng;
use std::f64::consts::TAU;

/// Images that points are taken from and held against, at most, evenly chosen.
const VIEWS: usize = 100;
/// Points per requested one that are static.
const CANDIDATES: usize = 4;
/// Pixels of an image that are tested for motion, at most.
const ASKED: usize = 20_000;
/// As a share of the requested points, those on dynamic regions that are alive at a time: lifespans are as wide as that
/// takes, within bounds in times between times. Shorter ones leave holes between times; over longer ones velocities
/// change.
const ALIVE_SHARE: f64 = 0.15;
const LIFE: [f64; 2] = [0.5, 2.0];

/// A pixel and where it is.
struct Candidate {
    map: usize,
    pixel: usize,
    point: [f64; 3],
    color: [f32; 3],
    /// Whether it may represent what is still.
    still: bool,
}

/// About `count` points of metric depth maps that are static; none where there are no such maps. With `moving`, up to
/// as many again on dynamic regions: few pixels show it, and at every time others. They are taken from every image that
/// is examined.
pub(crate) fn points(frames: &dyn Frames, count: usize, moving: bool, rng: Rng) -> Result<Seeds> {
    let step = frames.len().div_ceil(VIEWS).max(1);
    let chosen: Vec<usize> = (0..frames.len()).step_by(step).collect();
    let still = CANDIDATES * count / chosen.len().max(1);
    let (mut maps, mut candidates) = (Vec::new(), Vec::new());
    let mut picture = Picture::default();
    for &i in &chosen {
        let Some(map) = Map::load(frames, i, &mut picture)? else { continue };
        let known: Vec<usize> = (0..map.depth.pixels()).filter(|&p| map.depth.data[p] > 0.0).collect();
        let asked = if moving { still.max(ASKED) } else { still };
        let order = rng.fork(i as u64).permutation(known.len());
        for (n, &k) in order.iter().take(asked).enumerate() {
            let pixel = known[k as usize];
            let (x, y) = (pixel % map.depth.width, pixel / map.depth.width);
            let point = map.camera.unproject([x as f64 + 0.5, y as f64 + 0.5], f64::from(map.depth.data[pixel]));
            let color = std::array::from_fn(|c| picture.color.get(c, y, x));
            candidates.push(Candidate { map: maps.len(), pixel, point, color, still: n < still });
        }
        maps.push(map);
    }
    let moves = |c: &Candidate| {
        let own: &Map = &maps[c.map];
        moving && maps.iter().any(|m| m.time != own.time && m.sees_through(c.point))
    };
    let moves: Vec<bool> = candidates.par_iter().map(moves).collect();
    let (mut out, mut alive) = (Seeds::default(), Vec::new());
    for (candidate, moves) in candidates.into_iter().zip(moves) {
        if moves {
            alive.push(candidate);
        } else if candidate.still {
            out.push(candidate.point, candidate.color, None);
        }
    }
    let alive = evenly(alive, count, rng.fork(u64::MAX));
    out.truncate_evenly(count, rng.fork(u64::MAX - 1));
    let mut times: Vec<f64> = maps.iter().map(|m| m.time).collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    if let [first, .., last] = times[..] {
        let gap = (last - first) / (times.len() - 1) as f64;
        // The integral of a lifespan exp(−½(t/w)²) is √(2π)w.
        let wanted = ALIVE_SHARE * count as f64 / alive.len().max(1) as f64 * (last - first) / TAU.sqrt();
        out.life = Some(wanted.clamp(LIFE[0] * gap, LIFE[1] * gap));
    }
    for of_map in alive.chunk_by(|a, b| a.map == b.map) {
        let map = &maps[of_map[0].map];
        let pixels: Vec<usize> = of_map.iter().map(|c| c.pixel).collect();
        let velocities = scene_flow::velocities(frames, map, &pixels)?;
        for (c, velocity) in of_map.iter().zip(velocities) {
            out.push(c.point, c.color, Some(map.time));
            *out.velocities.last_mut().expect("just pushed") = velocity;
        }
    }
    Ok(out)
}

/// At most `count` of them, evenly chosen, in their order.
fn evenly<T>(all: Vec<T>, count: usize, rng: Rng) -> Vec<T> {
    let mut keep = vec![all.len() <= count; all.len()];
    rng.permutation(all.len()).into_iter().take(count).for_each(|i| keep[i as usize] = true);
    all.into_iter().zip(keep).filter_map(|(one, keep)| keep.then_some(one)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::DepthKind;
    use crate::capture::frames::Depth;
    use crate::methods::TrainContext;
    use crate::recipe::Recipe;
    use crate::step::tests::Made;
    use splat4d::math::se3::{dot, norm, normalize, sub};
    use splat4d::scene::Time;
    use splat4d::scene::{Camera, Planes};

    /// The synthetic ball with its depth, before a wall.
    struct Deep(Made);

    const WALL: f64 = 9.0;

    impl Frames for Deep {
        fn len(&self) -> usize {
            self.0.len()
        }

        fn camera(&self, i: usize) -> &Camera {
            Frames::camera(&self.0, i)
        }

        fn time(&self, i: usize) -> Time {
            self.0.time(i)
        }

        fn rig(&self, i: usize) -> usize {
            self.0.rig(i)
        }

        fn name(&self, i: usize) -> String {
            self.0.name(i)
        }

        fn has_depth(&self) -> bool {
            true
        }

        fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
            self.0.load(i, out)?;
            let camera = Frames::camera(self, i);
            let (eye, center) = (camera.center(), self.0.object_at(self.0.time(i).0));
            let mut values = Planes::new(1, camera.height, camera.width);
            for (p, z) in values.data.iter_mut().enumerate() {
                let at = [(p % camera.width) as f64 + 0.5, (p / camera.width) as f64 + 0.5];
                let ray = normalize(sub(camera.unproject(at, 1.0), eye));
                let along = dot(sub(center, eye), ray);
                let miss = dot(sub(center, eye), sub(center, eye)) - along * along;
                let hit = Made::RADIUS * Made::RADIUS - miss;
                let ahead = camera.cam_from_world.rotation[2];
                *z = if hit > 0.0 { (along - hit.sqrt()) * dot(ray, ahead) } else { WALL } as f32;
            }
            out.depth = Some(Depth { values, kind: DepthKind::Metric });
            Ok(())
        }
    }

    #[test]
    fn depth_points_of_dynamic_regions_get_their_time_and_others_none() {
        let deep = Deep(Made::new(4, 3, 24));
        let seeds = points(&deep, 400, true, Rng::new(1, "test", 0)).unwrap();
        let moving: Vec<usize> = (0..seeds.len()).filter(|&i| seeds.times[i].is_some()).collect();
        assert!(seeds.len() > 200 && moving.len() > 60, "{} of {}", moving.len(), seeds.len());
        for &i in &moving {
            let off = norm(sub(seeds.points[i], deep.0.object_at(seeds.times[i].unwrap())));
            assert!((off - Made::RADIUS).abs() < 1e-3, "{off}");
        }
        for k in 0..3 {
            let of = moving.iter().filter(|&&i| seeds.times[i] == Some(deep.0.time_of(k))).count();
            assert!(of > 10, "{of} at moment {k}");
        }
        let gap = deep.0.time_of(1) - deep.0.time_of(0);
        let life = seeds.life.expect("what moves lives about its moment");
        assert!(life >= 0.5 * gap && life <= 2.0 * gap, "{life}");
        let none = points(&deep.0, 400, true, Rng::new(1, "test", 0)).unwrap();
        assert!(none.is_empty(), "no maps, no points");
        // Gaussians that are alive during the whole clip begin with the moving points of one time.
        let recipe = Recipe::default().with(|r| r.init.count = 400);
        let plan = TrainContext { clip: [deep.0.time_of(0), deep.0.time_of(2)], times: 3, fps: 10.0, ..recipe.plan() };
        let one = super::super::one_time(&plan, &recipe.init, &deep, None).unwrap();
        let off = |i: usize, k: usize| norm(sub(one.points[i], deep.0.object_at(deep.0.time_of(k)))) - Made::RADIUS;
        let near = |i: usize, k: usize| off(i, k).abs() < 1e-3;
        let count = |k: usize| (0..one.len()).filter(|&i| near(i, k)).count();
        assert!(one.times.iter().all(Option::is_none) && one.life.is_none());
        assert!(count(1) > 10 && count(0) + count(2) < count(1) / 2, "{:?}", [count(0), count(1), count(2)]);
    }
}
