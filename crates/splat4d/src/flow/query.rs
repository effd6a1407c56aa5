//! Follows requested points, a pixel of an image or a position in the world, through all times, with their visibility
//! in a camera.
//!
//! A pixel belongs to the Gaussians that it shows: the eight heaviest α_i T_i at about the depth of the one at which
//! half of the pixel's weight is reached (what a translucent edge lets through behind it has another motion), and its
//! point is on the pixel's ray at that depth. A position belongs to the Gaussians nearest to it. Their mean
//! displacement moves the point; where half of them have ended, the nearest living ones replace them, so that points
//! are followed through models with short lifespans, at the price of the drift of an integration.

use super::tracks::Member;
use crate::layers::{Evaluation, Scene};
use crate::math::se3::{norm, sub};
use crate::render::{Importance, Projected, RenderConfig};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{Camera, Rows, Time};
use rayon::prelude::*;

/// Gaussians of a pixel, and those that carry a position: one alone may be a floater.
const HEAVIEST: usize = 8;
const NEAREST: usize = 4;
/// Fainter Gaussians are not taken for a surface.
const LEAST_OPACITY: f64 = 0.5;
/// Depths within this share of each other are of one surface, as in [`lift`](super::lift).
const ONE_SURFACE: f64 = 0.05;
/// A pixel that shows less than this shows nothing; a point before which more than this is left is seen.
const HALF: f64 = 0.5;
/// Standard deviations of the nearest Gaussian (all three axes together) within which it carries a position.
const REACH: f64 = 4.0;

/// Position of a point at the time of its query.
#[derive(Clone, Debug, PartialEq)]
pub enum Place {
    /// There, scene units.
    World([f64; 3]),
    /// The surface at this pixel position.
    Pixel(Box<Camera>, [f64; 2]),
}

/// A point to follow.
#[derive(Clone, Debug, PartialEq)]
pub struct Query {
    /// When it is where it is requested, seconds.
    pub time: f64,
    /// Where.
    pub place: Place,
}

/// Positions of points at some times.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Followed {
    /// Seconds.
    pub times: Vec<f64>,
    /// [queries, 3] at the time of the query; `None`: nothing is there to follow.
    pub starts: Vec<Option<[f64; 3]>>,
    /// [queries, times, 3], scene units; `None` from where on nothing carries the point any more.
    pub points: Vec<Option<[f64; 3]>>,
}

impl Followed {
    /// One query's positions, a time each.
    pub fn path(&self, query: usize) -> &[Option<[f64; 3]>] {
        &self.points[query * self.times.len()..(query + 1) * self.times.len()]
    }
}

/// A camera's view of a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointView {
    /// Pixel position; outside of the image too.
    pub pixel: [f64; 2],
    /// Whether it is in the image with at least half of the light left before it.
    pub visible: bool,
}

/// Follows points to `times`, ascending, forwards and backwards from the time of each query.
///
/// Panics: times that do not rise, or are not finite.
pub fn follow(scene: &Scene<f32>, queries: &[Query], times: &[f64]) -> Followed {
    assert!(times.windows(2).all(|w| w[0] < w[1]), "times rise");
    let mut moments: Vec<f64> = times.iter().copied().chain(queries.iter().map(|q| q.time)).collect();
    moments.sort_by(f64::total_cmp);
    moments.dedup();
    let index = |t: f64| moments.binary_search_by(|m| m.total_cmp(&t)).expect("every time is a moment");
    let begins: Vec<usize> = queries.iter().map(|q| index(q.time)).collect();
    let mut out = Followed {
        times: times.to_vec(),
        starts: vec![None; queries.len()],
        points: vec![None; queries.len() * times.len()],
    };
    let columns: Vec<(usize, usize)> = times.iter().enumerate().map(|(c, &t)| (index(t), c)).collect();
    let column = |k: usize| columns.binary_search_by_key(&k, |c| c.0).ok().map(|i| columns[i].1);
    // Before the first query and behind the last nothing moves in either direction.
    let (first, last) = (begins.iter().min().copied().unwrap_or(0), begins.iter().max().copied().unwrap_or(0));
    let forwards: Vec<usize> = (first..moments.len()).collect();
    let backwards: Vec<usize> = (0..(last + 1).min(moments.len())).rev().collect();
    for order in [forwards, backwards] {
        let mut on_the_way: Vec<Option<Point>> = vec![None; queries.len()];
        let (mut now, mut next) = (ActiveGaussians::default(), ActiveGaussians::default());
        for (step, &k) in order.iter().enumerate() {
            if step == 0 {
                now.evaluate(scene, moments[k]);
            }
            for (q, start) in begin(scene, &now, queries, &begins, k) {
                out.starts[q] = start.as_ref().map(|p| p.at);
                on_the_way[q] = start;
            }
            if let Some(c) = column(k) {
                for (q, point) in on_the_way.iter().enumerate() {
                    if let Some(point) = point {
                        out.points[q * times.len() + c] = Some(point.at);
                    }
                }
            }
            let Some(&to) = order.get(step + 1) else { break };
            next.evaluate(scene, moments[to]);
            on_the_way.par_iter_mut().for_each(|point| {
                if let Some(p) = point
                    && !p.step(&now, &next)
                {
                    *point = None;
                }
            });
            std::mem::swap(&mut now, &mut next);
        }
    }
    out
}

/// Points seen by a camera at one time.
pub fn sights(scene: &Scene<f32>, camera: &Camera, t: Time, points: &[Option<[f64; 3]>]) -> Vec<Option<PointView>> {
    let mut seen = ActiveGaussians::default();
    seen.evaluate(scene, t.0);
    let projected = projected(scene, &seen, camera);
    let sight = |point: &Option<[f64; 3]>| {
        let (pixel, z) = camera.project((*point)?)?;
        let inside = (0.0..camera.width as f64).contains(&pixel[0]) && (0.0..camera.height as f64).contains(&pixel[1]);
        let before = |hit: &&Hit| hit.depth < z * (1.0 - ONE_SURFACE);
        let visible = inside
            && z > camera.near
            && 1.0 - along(&projected, pixel).iter().filter(before).map(|h| h.weight).sum::<f64>() >= HALF;
        Some(PointView { pixel, visible })
    };
    points.par_iter().map(sight).collect()
}

/// The points whose queries are of time k.
fn begin(
    scene: &Scene<f32>,
    now: &ActiveGaussians,
    queries: &[Query],
    begins: &[usize],
    k: usize,
) -> Vec<(usize, Option<Point>)> {
    let mut of_camera: Option<(&Camera, Vec<Projected<f32>>)> = None;
    let mut out = Vec::new();
    for (q, query) in queries.iter().enumerate().filter(|(q, _)| begins[*q] == k) {
        let point = match &query.place {
            Place::World(x) => {
                let carriers = now.around(*x, None);
                (!carriers.is_empty()).then_some(Point { at: *x, carriers })
            }
            Place::Pixel(camera, pixel) => {
                let camera = &**camera;
                if of_camera.as_ref().is_none_or(|(c, _)| *c != camera) {
                    of_camera = Some((camera, projected(scene, now, camera)));
                }
                of_camera.as_ref().and_then(|(_, projected)| of_pixel(now, projected, camera, *pixel))
            }
        };
        out.push((q, point));
    }
    out
}

/// The point that a pixel shows.
fn of_pixel(now: &ActiveGaussians, projected: &[Projected<f32>], camera: &Camera, pixel: [f64; 2]) -> Option<Point> {
    let hits = along(projected, pixel);
    let all: f64 = hits.iter().map(|h| h.weight).sum();
    if all < HALF {
        return None;
    }
    let mut sum = 0.0;
    let middle = hits.iter().find(|h| {
        sum += h.weight;
        sum >= HALF * all
    })?;
    let mut near: Vec<&Hit> =
        hits.iter().filter(|h| (h.depth - middle.depth).abs() <= ONE_SURFACE * middle.depth).collect();
    near.sort_by(|a, b| b.weight.total_cmp(&a.weight).then(a.splat.cmp(&b.splat)));
    near.truncate(HEAVIEST);
    let all: f64 = near.iter().map(|h| h.weight).sum();
    let carriers = near.iter().map(|h| (now.member(h.splat), h.weight / all)).collect();
    Some(Point { at: camera.unproject(pixel, middle.depth), carriers })
}

/// A splat on the ray of a pixel.
struct Hit {
    splat: usize,
    /// α T.
    weight: f64,
    depth: f64,
}

/// All splats of an image before any is blended.
fn projected(scene: &Scene<f32>, seen: &ActiveGaussians, camera: &Camera) -> Vec<Projected<f32>> {
    Importance::new(RenderConfig::default()).project(&scene.splats(&seen.evaluation), camera).to_vec()
}

/// The splats that a pixel position shows, front to back, blended as the renderer does.
fn along(projected: &[Projected<f32>], [x, y]: [f64; 2]) -> Vec<Hit> {
    let config = RenderConfig::default();
    let [least, most] = config.alpha_limits();
    let mut hits = Vec::new();
    for (splat, p) in projected.iter().enumerate().filter(|(_, p)| p.radius > 0.0) {
        let (dx, dy) = (x - f64::from(p.mean2d[0]), y - f64::from(p.mean2d[1]));
        if dx.abs() > f64::from(p.half[0]) || dy.abs() > f64::from(p.half[1]) {
            continue;
        }
        let [a, b, c] = p.conic.map(f64::from);
        let alpha = (f64::from(p.opacity) * (-0.5 * (a * dx * dx + 2.0 * b * dx * dy + c * dy * dy)).exp()).min(most);
        if alpha >= least {
            hits.push(Hit { splat, weight: alpha, depth: f64::from(p.depth) });
        }
    }
    hits.sort_by(|a, b| a.depth.total_cmp(&b.depth).then(a.splat.cmp(&b.splat)));
    let mut left = 1.0;
    let mut shown = 0;
    for hit in &mut hits {
        let alpha = hit.weight;
        if left * (1.0 - alpha) < config.transmittance_min {
            break;
        }
        hit.weight = left * alpha;
        left *= 1.0 - alpha;
        shown += 1;
    }
    hits.truncate(shown);
    hits
}

/// A point on its way.
#[derive(Clone, Debug)]
struct Point {
    at: [f64; 3],
    /// Weights sum up to 1.
    carriers: Vec<(Member, f64)>,
}

impl Point {
    /// Moves with its carriers; false: it has none.
    fn step(&mut self, now: &ActiveGaussians, next: &ActiveGaussians) -> bool {
        let mut moved = self.moved(now, next);
        if moved.is_none() {
            self.carriers = now.around(self.at, Some(next));
            moved = self.moved(now, next);
        }
        let Some(by) = moved else { return false };
        (0..3).for_each(|k| self.at[k] += by[k]);
        self.at.iter().all(|x| x.is_finite())
    }

    /// The mean displacement of the carriers that are alive at both times; `None`: fewer than half of them do.
    fn moved(&self, now: &ActiveGaussians, next: &ActiveGaussians) -> Option<[f64; 3]> {
        let (mut sum, mut all) = ([0.0; 3], 0.0);
        for &(member, weight) in &self.carriers {
            if let (Some(from), Some(to)) = (now.mean(member), next.mean(member)) {
                all += weight;
                (0..3).for_each(|k| sum[k] += weight * (to[k] - from[k]));
            }
        }
        (all >= HALF).then(|| sum.map(|x| x / all))
    }
}

/// The Gaussians alive at one time.
#[derive(Default)]
struct ActiveGaussians {
    evaluation: Evaluation<f32>,
}

impl ActiveGaussians {
    fn evaluate(&mut self, scene: &Scene<f32>, t: f64) {
        scene.at(Time(t), &mut self.evaluation);
    }

    /// The Gaussian behind a splat.
    fn member(&self, mut splat: usize) -> Member {
        for (layer, tape) in self.evaluation.tapes().enumerate() {
            if splat < tape.out().rows() {
                return Member { layer, row: tape.rows().id(splat) as u32 };
            }
            splat -= tape.out().rows();
        }
        unreachable!("splats are those of the tapes")
    }

    /// Position of a Gaussian; `None`: it is not alive.
    fn mean(&self, member: Member) -> Option<[f64; 3]> {
        let tape = self.evaluation.tape(member.layer);
        let j = match tape.rows() {
            Rows::All => member.row as usize,
            Rows::Some(ids) => ids.binary_search(&member.row).ok()?,
        };
        Some(tape.out().read::<3>(j, 0).map(f64::from)).filter(|x| x.iter().all(|x| x.is_finite()))
    }

    /// The Gaussians that carry the point at x, with equal weights; only those alive at `next` if it is given. None
    /// where the nearest is too far away to belong to it.
    fn around(&self, x: [f64; 3], next: Option<&ActiveGaussians>) -> Vec<(Member, f64)> {
        let mut best: Vec<(f64, f64, Member)> = Vec::with_capacity(NEAREST + 1);
        for (layer, tape) in self.evaluation.tapes().enumerate() {
            for j in 0..tape.out().rows() {
                let row = tape.out().read::<10>(j, 0).map(f64::from);
                let far = norm(sub([row[0], row[1], row[2]], x));
                let full = best.len() == NEAREST;
                if !far.is_finite() || row[SPLAT_OPACITY] < LEAST_OPACITY || full && far >= best[NEAREST - 1].0 {
                    continue;
                }
                let member = Member { layer, row: tape.rows().id(j) as u32 };
                if next.is_some_and(|n| n.mean(member).is_none()) {
                    continue;
                }
                let size = (row[COV] + row[COV + 3] + row[COV + 5]).sqrt();
                let place = best.partition_point(|b| b.0 <= far);
                best.insert(place, (far, size, member));
                best.truncate(NEAREST);
            }
        }
        if best.first().is_none_or(|(far, size, _)| *far > REACH * size) {
            return Vec::new();
        }
        let weight = 1.0 / best.len() as f64;
        best.into_iter().map(|b| (b.2, weight)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::Layer;
    use crate::math::Se3;
    use crate::motion::{SpacetimeSpec, Spec, build};
    use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
    use crate::scene::{GEOMETRY, LIFE, LifeKind, Params};

    /// A wall of 24x24 discs at depth z, `wide` across, that moves; of every position a chain of Gaussians of `life`
    /// seconds.
    fn wall(z: f64, wide: f64, velocity: [f64; 3], life: Option<f64>) -> Layer<f32> {
        const SIDE: usize = 24;
        let births: Vec<f64> = life.map_or(vec![0.5], |l| (0..=(1.0 / l) as usize).map(|i| i as f64 * l).collect());
        let kind = if life.is_some() { LifeKind::GaussHalf } else { LifeKind::Infinite };
        let mut p = Params::new(SIDE * SIDE * births.len(), 1, kind.columns());
        let spec = Spec::Spacetime(SpacetimeSpec { order: 1, origin: 0.5, ..SpacetimeSpec::default() });
        let motion = build(&spec, &mut p).unwrap();
        let key = p.find("velocities").unwrap();
        for (b, &birth) in births.iter().enumerate() {
            for i in 0..SIDE * SIDE {
                let r = b * SIDE * SIDE + i;
                let at = |k: usize| (k as f64 / (SIDE - 1) as f64 - 0.5) * wide;
                // A Gaussian alive around its birth is at the wall's position then.
                let x = [at(i % SIDE), at(i / SIDE), z];
                let x: [f64; 3] = std::array::from_fn(|k| x[k] + velocity[k] * (birth - 0.5));
                p[GEOMETRY].write(r, 0, x.map(|x| x as f32));
                p[GEOMETRY].write(r, QUAT, [1.0, 0.0, 0.0, 0.0]);
                let size = (1.2 * wide / SIDE as f64).ln() as f32;
                p[GEOMETRY].write(r, LOG_SCALE, [size, size, -6.0]);
                p[GEOMETRY].set(r, OPACITY, 4.0);
                p[key].write(r, 0, velocity.map(|x| x as f32));
                if let Some(life) = life {
                    p[LIFE].write(r, 0, [birth as f32, (0.5 * life).ln() as f32]);
                }
            }
        }
        Layer::new("wall", p, motion, kind)
    }

    fn scene(layers: Vec<Layer<f32>>) -> Scene<f32> {
        Scene { layers, clip: [0.0, 1.0], fps: 10.0, ..Scene::default() }
    }

    fn camera() -> Camera {
        Camera::with_fov_y(Se3::look_at([0.0, 0.0, 4.0], [0.0; 3], [0.0, 1.0, 0.0]), 0.7, 60, 60)
    }

    fn times() -> Vec<f64> {
        (0..=10).map(|i| 0.1 * f64::from(i)).collect()
    }

    #[test]
    fn a_pixel_follows_its_wall_forwards_and_backwards() {
        let v = [0.4, -0.2, 0.1];
        let s = scene(vec![wall(0.0, 3.0, v, None)]);
        let query = Query { time: 0.5, place: Place::Pixel(Box::new(camera()), [33.0, 25.5]) };
        let found = follow(&s, &[query], &times());
        let start = found.starts[0].unwrap();
        assert!(norm(sub(start, camera().unproject([33.0, 25.5], 4.0))) < 1e-3, "{start:?}");
        for (t, x) in found.times.iter().zip(found.path(0)) {
            let truth: [f64; 3] = std::array::from_fn(|k| start[k] + v[k] * (t - 0.5));
            assert!(norm(sub(x.unwrap(), truth)) < 1e-5, "{t}: {x:?} {truth:?}");
        }
    }

    #[test]
    fn short_lived_gaussians_hand_a_path_over_to_others() {
        let v = [0.4, 0.0, 0.0];
        let s = scene(vec![wall(0.0, 3.0, v, Some(0.1))]);
        let query = Query { time: 0.0, place: Place::World([0.1, 0.2, 0.0]) };
        let found = follow(&s, &[query], &times());
        for (t, x) in found.times.iter().zip(found.path(0)) {
            let x = x.expect("somebody carries it on");
            assert!(norm(sub(x, [0.1 + 0.4 * t, 0.2, 0.0])) < 1e-4, "{t}: {x:?}");
        }
        // None of the first ones is alive at the end.
        assert!(s.layers[0].spans().iter().all(|[from, to]| *from > 0.0 || *to < 1.0));
    }

    #[test]
    fn occluded_points_are_marked_and_empty_pixels_not_followed() {
        // A small screen before a wall moves from left to right.
        let s = scene(vec![wall(0.0, 6.0, [0.0; 3], None), wall(1.0, 0.6, [2.0, 0.0, 0.0], None)]);
        let seen = |t: f64, x: [f64; 3]| sights(&s, &camera(), Time(t), &[Some(x)])[0].unwrap();
        assert!(seen(0.0, [0.0; 3]).visible && !seen(0.5, [0.0; 3]).visible && seen(1.0, [0.0; 3]).visible);
        assert!(!seen(0.0, [5.0, 0.0, 0.0]).visible, "it is not in the picture");
        assert!(sights(&s, &camera(), Time(0.0), &[None, Some([0.0, 0.0, 9.0])]).iter().all(Option::is_none));
        let lone = scene(vec![wall(0.0, 0.6, [0.0; 3], None)]);
        let queries = [
            Query { time: 0.0, place: Place::Pixel(Box::new(camera()), [2.0, 2.0]) },
            Query { time: 0.0, place: Place::World([0.0, 0.0, 2.0]) },
        ];
        let found = follow(&lone, &queries, &times());
        assert!(found.starts == [None, None] && found.points.iter().all(Option::is_none));
    }
}
