//! Velocities of depth map pixels: optical flow to the images before and after, and the depth at both ends of the flow.

use super::map::Map;
use crate::Result;
use crate::capture::frames::{Frames, Picture};
use crate::vision::flow::{Pyramid, dense};
use crate::vision::raster::grey;
use splat4d::flow::lift::lift;
use splat4d::math::median;
use splat4d::scene::Planes;

/// The four pixels about a position show one surface where their depths differ by less than this share.
const ONE_SURFACE: f64 = 0.05;
/// A velocity is the median, axis by axis, of this many known ones nearest to it: flow errs where patches straddle an
/// edge.
const NEAREST: usize = 9;

/// Velocities of pixels of an image, scene units a second, axes of the world; zero where no neighbour of the image
/// has any. A pixel without flow takes those of the nearest that it does.
pub(super) fn velocities(frames: &dyn Frames, map: &Map, pixels: &[usize]) -> Result<Vec<[f64; 3]>> {
    let mut picture = Picture::default();
    Map::load(frames, map.frame, &mut picture)?;
    let (mut sums, mut counts) = (vec![[0.0; 3]; pixels.len()], vec![0.0; pixels.len()]);
    let own = Pyramid::new(grey(&picture.color));
    let given = picture.flow.take();
    for neighbour in neighbours(frames, map.frame).into_iter().flatten() {
        let Some(to) = Map::load(frames, neighbour, &mut picture)? else { continue };
        if [to.camera.width, to.camera.height] != [map.camera.width, map.camera.height] {
            continue;
        }
        let flow = match &given {
            Some(flow) if flow.to.0 == to.time => flow.vectors.clone(),
            _ => dense(&own, &Pyramid::new(grey(&picture.color))),
        };
        for ((&pixel, sum), count) in pixels.iter().zip(&mut sums).zip(&mut counts) {
            let Some(step) = displacement(map, &to, &flow, pixel) else { continue };
            (0..3).for_each(|k| sum[k] += step[k] / (to.time - map.time));
            *count += 1.0;
        }
    }
    let known: Vec<usize> = (0..pixels.len()).filter(|&i| counts[i] > 0.0).collect();
    known.iter().for_each(|&i| sums[i] = sums[i].map(|s| s / counts[i]));
    let width = map.camera.width;
    let place = |i: usize| [pixels[i] % width, pixels[i] / width];
    Ok((0..pixels.len())
        .map(|i| {
            let apart = |&j: &usize| {
                let (a, b) = (place(i), place(j));
                (a[0].abs_diff(b[0]).pow(2) + a[1].abs_diff(b[1]).pow(2), j)
            };
            let mut near = known.clone();
            if near.len() > NEAREST {
                near.select_nth_unstable_by_key(NEAREST - 1, apart);
                near.truncate(NEAREST);
            }
            median_of(&near, &sums)
        })
        .collect())
}

/// Of the frames of the same camera the last one before and the first one after.
fn neighbours(frames: &dyn Frames, frame: usize) -> [Option<usize>; 2] {
    let time = |i: usize| frames.time(i).0;
    let same = || (0..frames.len()).filter(|&i| frames.rig(i) == frames.rig(frame));
    let before = same().filter(|&i| time(i) < time(frame)).max_by(|&a, &b| time(a).total_cmp(&time(b)));
    let after = same().filter(|&i| time(i) > time(frame)).min_by(|&a, &b| time(a).total_cmp(&time(b)));
    [before, after]
}

/// Position of a pixel's point at the other map's time; none where flow or depth there is not known.
fn displacement(from: &Map, to: &Map, flow: &Planes<f32>, pixel: usize) -> Option<[f64; 3]> {
    let (n, w) = (flow.pixels(), flow.width);
    if flow.data[2 * n + pixel] <= 0.0 {
        return None;
    }
    let vector = [f64::from(flow.data[pixel]), f64::from(flow.data[n + pixel])];
    let at = [(pixel % w) as f64 + 0.5, (pixel / w) as f64 + 0.5];
    let depth = surface(&to.depth, [at[0] + vector[0], at[1] + vector[1]])?;
    Some(lift(&from.camera, &to.camera, at, vector, f64::from(from.depth.data[pixel]), depth))
}

/// Depth between four pixels, where they are known and show one surface.
fn surface(depth: &Planes<f32>, at: [f64; 2]) -> Option<f64> {
    let [x, y] = at.map(|p| p - 0.5);
    if x < 0.0 || y < 0.0 || x >= (depth.width - 1) as f64 || y >= (depth.height - 1) as f64 {
        return None;
    }
    let (left, top) = (x as usize, y as usize);
    let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| f64::from(depth.get(0, top + j, left + i)));
    let (least, most) = (four.iter().copied().fold(f64::INFINITY, f64::min), four.iter().copied().fold(0.0, f64::max));
    if least <= 0.0 || most > least * (1.0 + ONE_SURFACE) {
        return None;
    }
    let (u, v) = (x - left as f64, y - top as f64);
    Some((1.0 - v) * ((1.0 - u) * four[0] + u * four[1]) + v * ((1.0 - u) * four[2] + u * four[3]))
}

fn median_of(of: &[usize], vectors: &[[f64; 3]]) -> [f64; 3] {
    std::array::from_fn(|k| {
        let mut values: Vec<f64> = of.iter().map(|&i| vectors[i][k]).collect();
        median(&mut values).unwrap_or(0.0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::DepthKind;
    use crate::capture::frames::{Depth, Flow};
    use splat4d::math::{Rng, Se3};
    use splat4d::scene::{Camera, Time};

    /// A textured wall that goes sideways and towards a camera that goes sideways too.
    struct Wall {
        cameras: Vec<Camera>,
        blobs: Vec<[f64; 3]>,
        /// Whether images bring flow, and then this much of it, of the true one.
        brings: Option<f32>,
    }

    const FRAME: f64 = 0.1;
    const VELOCITY: [f64; 3] = [0.5, -0.2, -0.6];

    impl Wall {
        fn new(brings: Option<f32>) -> Self {
            let camera = |i: usize| {
                let x = 0.1 * i as f64;
                let pose = Se3::look_at([x, 0.0, -4.0], [x, 0.0, 0.0], [0.0, -1.0, 0.0]);
                Camera::with_fov_y(pose, 0.9, 96, 72)
            };
            let rng = Rng::new(3, "blobs", 0);
            let blob = |i: u64| {
                let [x, y, s] = [0, 1, 2].map(|k| rng.uniform(3 * i + k));
                [8.0 * x - 4.0, 6.0 * y - 3.0, 0.1 + 0.2 * s]
            };
            Self { cameras: (0..3).map(camera).collect(), blobs: (0..160).map(blob).collect(), brings }
        }

        /// Intersection of a pixel's ray with the wall in frame i.
        fn hit(&self, i: usize, x: usize, y: usize) -> ([f64; 3], f64) {
            let (camera, at) = (&self.cameras[i], [x as f64 + 0.5, y as f64 + 0.5]);
            let z = VELOCITY[2] * FRAME * i as f64;
            let depth = (z - camera.center()[2]) / camera.cam_from_world.rotation[2][2];
            (camera.unproject(at, depth), depth)
        }
    }

    impl Frames for Wall {
        fn len(&self) -> usize {
            self.cameras.len()
        }
        fn camera(&self, i: usize) -> &Camera {
            &self.cameras[i]
        }
        fn time(&self, i: usize) -> Time {
            Time(FRAME * i as f64)
        }
        fn rig(&self, _: usize) -> usize {
            0
        }
        fn name(&self, i: usize) -> String {
            i.to_string()
        }
        fn load(&self, i: usize, out: &mut Picture) -> Result<()> {
            let camera = &self.cameras[i];
            let (w, h) = (camera.width, camera.height);
            (out.color, out.flow) = (Planes::new(3, h, w), None);
            let mut values = Planes::new(1, h, w);
            let mut vectors = Planes::new(3, h, w);
            for p in 0..w * h {
                let (point, depth) = self.hit(i, p % w, p / w);
                let own = [0, 1].map(|k| point[k] - VELOCITY[k] * self.time(i).0);
                let light = |b: &[f64; 3]| (-((own[0] - b[0]).powi(2) + (own[1] - b[1]).powi(2)) / (b[2] * b[2])).exp();
                let grey = self.blobs.iter().map(light).sum::<f64>();
                (0..3).for_each(|c| out.color.plane_mut(c)[p] = (0.4 * grey) as f32);
                values.data[p] = depth as f32;
                if let (Some(share), Some(next)) = (self.brings, self.cameras.get(i + 1)) {
                    let ([u, v], _) = next.project(std::array::from_fn(|k| point[k] + VELOCITY[k] * FRAME)).unwrap();
                    let at = [(p % w) as f64 + 0.5, (p / w) as f64 + 0.5];
                    [u - at[0], v - at[1]]
                        .iter()
                        .enumerate()
                        .for_each(|(c, f)| vectors.plane_mut(c)[p] = share * *f as f32);
                    vectors.plane_mut(2)[p] = 1.0;
                }
            }
            out.depth = Some(Depth { values, kind: DepthKind::Metric });
            if let (Some(_), Some(next)) = (self.brings, self.cameras.get(i + 1)) {
                out.flow = Some(Flow { to: self.time(i + 1), camera: next.clone(), vectors });
            }
            Ok(())
        }
    }

    /// Velocities of every seventh pixel of a frame, without the image's edges.
    fn of(wall: &Wall, frame: usize) -> Vec<[f64; 3]> {
        let map = Map::load(wall, frame, &mut Picture::default()).unwrap().unwrap();
        let (w, h) = (map.camera.width, map.camera.height);
        let inner = |p: &usize| (12..w - 12).contains(&(p % w)) && (12..h - 12).contains(&(p / w));
        let pixels: Vec<usize> = (0..w * h).step_by(7).filter(inner).collect();
        velocities(wall, &map, &pixels).unwrap()
    }

    #[test]
    fn flow_and_depth_at_both_ends_give_velocity() {
        let far = |of: &[[f64; 3]]| -> f64 {
            let off = |v: &[f64; 3]| (0..3).map(|k| (v[k] - VELOCITY[k]).powi(2)).sum::<f64>().sqrt();
            let mut all: Vec<f64> = of.iter().map(off).collect();
            all.sort_by(f64::total_cmp);
            all[all.len() * 9 / 10]
        };
        // Nine of ten within 5 % of 0.8: our own flow, forth alone, both ways, back alone.
        for frame in 0..3 {
            let found = far(&of(&Wall::new(None), frame));
            assert!(found < 0.04, "frame {frame}: {found}");
        }
        assert!(far(&of(&Wall::new(Some(1.0)), 0)) < 1e-3, "flow that the capture brings is taken");
        assert!(far(&of(&Wall::new(Some(0.0)), 0)) > 0.3, "and believed");
    }

    #[test]
    fn an_image_without_neighbours_gives_no_evidence() {
        let mut wall = Wall::new(None);
        wall.cameras.truncate(1);
        assert!(of(&wall, 0).iter().all(|v| *v == [0.0; 3]));
    }

    #[test]
    fn depth_is_read_between_pixels_of_one_surface_alone() {
        let map = |data: [f32; 4]| Planes::from_interleaved(1, 2, 2, &data);
        assert_eq!(surface(&map([4.0, 4.1, 4.0, 4.1]), [1.0, 1.0]), Some(f64::from(4.1f32) * 0.5 + 2.0));
        assert_eq!(surface(&map([4.0, 9.0, 4.0, 9.0]), [1.0, 1.0]), None, "an edge");
        assert_eq!(surface(&map([4.0, 0.0, 4.0, 4.0]), [1.0, 1.0]), None, "not known");
        assert_eq!(surface(&map([4.0; 4]), [0.2, 1.0]), None, "outside");
    }
}
