//! Points that depth maps show: pixels of training pictures, unprojected. A point through which a picture of another time
//! sees what is farther away belongs to something that moves, and to its moment; all others stand still.

use super::Seeds;
use crate::Result;
use crate::capture::DepthKind;
use crate::capture::frames::{Frames, Picture};
use rayon::prelude::*;
use splat4d::math::Rng;
use splat4d::scene::{Camera, Planes};

/// Pictures that points are taken from and held against, at most, evenly chosen, beside those of keyframes.
const VIEWS: usize = 100;
/// A picture sees through a point if what it shows there is farther away by more than this share: beyond the noise of
/// sensors and the slant of surfaces within a pixel.
const THROUGH: f64 = 0.05;
/// Points a wanted one: what moves is a small part of them.
const CANDIDATES: usize = 4;
/// Of the wanted points, those that may lie on what moves, where that much of it is seen (as of hulls).
const MOVING_SHARE: f64 = 0.3;

/// A picture's map.
struct Map {
    frame: usize,
    camera: Camera,
    time: f64,
    depth: Planes<f32>,
}

impl Map {
    /// Whether it sees something farther away where the point is.
    fn sees_through(&self, point: [f64; 3]) -> bool {
        let Some(([u, v], z)) = self.camera.project(point) else { return false };
        let (w, h) = (self.depth.width as f64, self.depth.height as f64);
        if !(0.0..w).contains(&u) || !(0.0..h).contains(&v) {
            return false;
        }
        f64::from(self.depth.get(0, v as usize, u as usize)) > z * (1.0 + THROUGH)
    }
}

/// About `count` points of metric depth maps; none where there are no such maps. Points on what moves are those of the
/// pictures nearest to `times`, and belong to these.
pub(crate) fn points(frames: &dyn Frames, times: &[f64], count: usize, moving: bool, rng: Rng) -> Result<Seeds> {
    let step = frames.len().div_ceil(VIEWS).max(1);
    let mut chosen: Vec<usize> = (0..frames.len()).step_by(step).collect();
    let near: Vec<Vec<usize>> = times.iter().map(|&t| super::hull::pictures_near(frames, t).1).collect();
    if moving {
        chosen.extend(near.iter().flatten());
        chosen.sort_unstable();
        chosen.dedup();
    }
    let key = |i: usize| moving && near.iter().any(|frames| frames.contains(&i));
    let keys = chosen.iter().filter(|&&i| key(i)).count();
    let (mut maps, mut candidates) = (Vec::new(), Vec::new());
    let mut picture = Picture::default();
    for &i in &chosen {
        frames.load(i, &mut picture)?;
        let Some(depth) = picture.depth.as_ref().filter(|d| d.kind == DepthKind::Metric) else { continue };
        let known: Vec<usize> = (0..depth.values.pixels()).filter(|&p| depth.values.data[p] > 0.0).collect();
        // What moves comes from keyframes alone, so that these are looked at more closely.
        let wanted = CANDIDATES * count / chosen.len() + if key(i) { CANDIDATES * count / keys } else { 0 };
        let rng = rng.fork(i as u64);
        for k in 0..wanted.min(known.len()) {
            let p = known[rng.below(k as u64, known.len())];
            let (x, y) = (p % depth.values.width, p / depth.values.width);
            let at = [x as f64 + 0.5, y as f64 + 0.5];
            let point = frames.camera(i).unproject(at, f64::from(depth.values.data[p]));
            let color = std::array::from_fn(|c| picture.color.get(c, y, x));
            candidates.push((maps.len(), point, color));
        }
        let (camera, time) = (frames.camera(i).clone(), frames.time(i).0);
        maps.push(Map { frame: i, camera, time, depth: depth.values.clone() });
    }
    let moves: Vec<bool> = candidates
        .par_iter()
        .map(|&(map, point, _)| {
            let own: &Map = &maps[map];
            moving && maps.iter().any(|m| m.time != own.time && m.sees_through(point))
        })
        .collect();
    let (mut still, mut alive) = (Seeds::default(), Seeds::default());
    for ((map, point, color), moves) in candidates.into_iter().zip(moves) {
        let map = &maps[map];
        if !moves {
            still.push(point, color, None);
        } else if key(map.frame) {
            alive.push(point, color, Some(map.time));
        }
    }
    alive.truncate_evenly((MOVING_SHARE * count as f64) as usize, rng.fork(u64::MAX));
    still.truncate_evenly(count - alive.len(), rng.fork(u64::MAX - 1));
    still.append(alive);
    Ok(still)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::frames::Depth;
    use crate::step::tests::Made;
    use splat4d::math::se3::{dot, norm, normalize, sub};
    use splat4d::scene::Time;

    /// The made-up ball with its depth, before a wall.
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
    fn what_moves_belongs_to_its_moment_and_all_else_to_all() {
        let deep = Deep(Made::new(4, 3, 24));
        let time = deep.time(1).0;
        let seeds = points(&deep, &[time], 400, true, Rng::new(1, "test", 0)).unwrap();
        let moving: Vec<usize> = (0..seeds.len()).filter(|&i| seeds.times[i].is_some()).collect();
        assert!(seeds.len() > 200 && moving.len() > 20, "{} of {}", moving.len(), seeds.len());
        for &i in &moving {
            assert_eq!(seeds.times[i], Some(time));
            let off = norm(sub(seeds.points[i], deep.0.object_at(time)));
            assert!((off - Made::RADIUS).abs() < 1e-3, "{off}");
        }
        let none = points(&deep.0, &[time], 400, true, Rng::new(1, "test", 0)).unwrap();
        assert!(none.is_empty(), "no maps, no points");
    }
}
