//! How fast what a depth map shows moves: optical flow to the pictures before and after, and the depth at both of its ends.

use super::depth::Map;
use crate::Result;
use crate::capture::frames::{Frames, Picture};
use crate::vision::flow::{Pyramid, dense};
use crate::vision::raster::grey;
use splat4d::flow::lift::lift;
use splat4d::scene::Planes;

/// The four pixels about a place show one surface where their depths differ by less than this share.
const ONE_SURFACE: f64 = 0.05;
/// A velocity is the median, axis by axis, of so many known ones nearest to it: flow errs where patches straddle an edge.
const NEAREST: usize = 9;

/// Velocities of pixels of a picture, scene units a second, axes of the world; zero where no neighbour of the picture
/// tells any. A pixel that flow does not know takes those of the nearest that it does.
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
            median(&near, &sums)
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

/// Where a pixel's point goes by the other map's time; nothing where flow or depth there is not known.
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

fn median(of: &[usize], vectors: &[[f64; 3]]) -> [f64; 3] {
    std::array::from_fn(|k| {
        let mut values: Vec<f64> = of.iter().map(|&i| vectors[i][k]).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    })
}
