//! Adds points between the initial points where a capture has few, on the assumption that surfaces continue between
//! them.
//!
//! Structure from motion finds points where there is texture. Gaussians that have to spread from there over plain walls
//! settle wherever the training cameras cannot see them, as haze in front of views that were not trained on. Here every
//! training camera's image is covered by a lattice; the inverse depth of a lattice pixel is that of the plane through
//! the points seen around it (1/z of a plane is affine in pixels).

use super::Seeds;
use super::sky::{FOREGROUND, Sky, views};
use crate::Result;
use crate::capture::frames::{Frames, Picture};
use rayon::prelude::*;
use splat4d::math::mat3;
use splat4d::scene::Camera;

/// Points that a plane is laid through.
const NEIGHBOURS: usize = 12;
/// Times that points away from the plane lose weight.
const ROUNDS: usize = 4;
/// A point this far from the plane, of its inverse depth, counts half: it belongs to something else.
const OUTLIER: f64 = 0.03;
/// Holds slopes back where points are in a line.
const RIDGE: f64 = 0.05;
/// Points a little outside of the image help at its edges, of its size.
const BORDER: f64 = 0.15;
/// Views that are covered, at most, evenly chosen.
const VIEWS: usize = 100;

/// About `count` points on the surfaces that `known` suggests; none where no camera sees enough of them, and none before
/// the `sky`, where there are no surfaces between points.
pub(crate) fn between(frames: &dyn Frames, known: &[[f64; 3]], count: usize, sky: Option<&Sky>) -> Result<Seeds> {
    let mut out = Seeds::default();
    let views = views(frames, VIEWS);
    if views.is_empty() || known.len() < NEIGHBOURS {
        return Ok(out);
    }
    let pixels: usize = views.iter().map(|&i| frames.camera(i).width * frames.camera(i).height).sum();
    let step = (pixels as f64 / count.max(1) as f64).sqrt().max(1.0);
    let mut picture = Picture::default();
    for i in views {
        let camera = frames.camera(i);
        frames.load(i, &mut picture)?;
        let blocked = |x: usize, y: usize| {
            picture.mask.as_ref().is_some_and(|m| m.get(0, y, x) > FOREGROUND)
                || picture.weight.as_ref().is_some_and(|w| w.get(0, y, x) == 0.0)
        };
        let seen = seen(camera, known, &blocked);
        if seen.len() < NEIGHBOURS {
            continue;
        }
        let (columns, rows) = ((camera.width as f64 / step) as usize, (camera.height as f64 / step) as usize);
        let at = |k: usize| [(k % columns) as f64, (k / columns) as f64].map(|c| (c + 0.5) * step);
        let far = sky.map(|sky| sky.of_camera(camera));
        let depths: Vec<Option<f64>> = (0..columns * rows)
            .into_par_iter()
            .map(|k| {
                let [u, v] = at(k);
                let color = || std::array::from_fn(|c| picture.color.get(c, v as usize, u as usize));
                let left_out = blocked(u as usize, v as usize) || far.as_ref().is_some_and(|far| far([u, v], color()));
                (!left_out).then(|| depth(&seen, [u, v]))
            })
            .collect();
        for (k, z) in depths.into_iter().enumerate() {
            if let Some(z) = z {
                let [u, v] = at(k);
                let color = std::array::from_fn(|c| picture.color.get(c, v as usize, u as usize));
                out.push(camera.unproject([u, v], z), color, None);
            }
        }
    }
    Ok(out)
}

/// A point in an image: pixel and inverse depth.
struct Mark {
    pixel: [f64; 2],
    inverse: f64,
}

/// The known points that a camera sees, but for those behind foreground.
fn seen(camera: &Camera, known: &[[f64; 3]], blocked: &dyn Fn(usize, usize) -> bool) -> Vec<Mark> {
    let (w, h) = (camera.width as f64, camera.height as f64);
    let mark = |&x: &[f64; 3]| {
        let ([u, v], z) = camera.project(x).filter(|(_, z)| *z > camera.near)?;
        let around = |p: f64, size: f64| p > -BORDER * size && p < (1.0 + BORDER) * size;
        let inside = (0.0..w).contains(&u) && (0.0..h).contains(&v);
        let free = !(inside && blocked(u as usize, v as usize));
        (around(u, w) && around(v, h) && free).then_some(Mark { pixel: [u, v], inverse: 1.0 / z })
    };
    known.iter().filter_map(mark).collect()
}

/// Depth z at a pixel: weighted least squares of 1/z = a + b·(u, v) through the nearest marks, four times, each time
/// trusting less what is off the plane; never beyond the marks' own depths.
fn depth(marks: &[Mark], [u, v]: [f64; 2]) -> f64 {
    let square = |m: &Mark| (m.pixel[0] - u).powi(2) + (m.pixel[1] - v).powi(2);
    let mut order: Vec<(f64, usize)> = marks.iter().enumerate().map(|(i, m)| (square(m), i)).collect();
    let by_distance = |a: &(f64, usize), b: &(f64, usize)| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1));
    order.select_nth_unstable_by(NEIGHBOURS - 1, by_distance);
    order.truncate(NEIGHBOURS);
    order.sort_by(by_distance);
    let scale = (order.iter().map(|o| o.0).sum::<f64>() / NEIGHBOURS as f64).sqrt() + 1.0;
    let rows: Vec<([f64; 3], f64, f64)> = order
        .iter()
        .map(|&(d, i)| {
            let m = &marks[i];
            let row = [1.0, (m.pixel[0] - u) / scale, (m.pixel[1] - v) / scale];
            (row, m.inverse, (-0.5 * d / (scale * scale)).exp())
        })
        .collect();
    let mut trust = [1.0; NEIGHBOURS];
    let mut plane = [0.0; 3];
    for _ in 0..ROUNDS {
        let mut a = [[0.0, 0.0, 0.0], [0.0, RIDGE, 0.0], [0.0, 0.0, RIDGE]];
        let mut b = [0.0; 3];
        for ((row, inverse, weight), trust) in rows.iter().zip(&trust) {
            for r in 0..3 {
                (0..3).for_each(|s| a[r][s] += weight * trust * row[r] * row[s]);
                b[r] += weight * trust * row[r] * inverse;
            }
        }
        plane = mat3::solve(a, b).unwrap_or([rows[0].1, 0.0, 0.0]);
        for ((row, inverse, _), trust) in rows.iter().zip(&mut trust) {
            let off = inverse - (0..3).map(|k| row[k] * plane[k]).sum::<f64>();
            *trust = 1.0 / (1.0 + (off / (OUTLIER * plane[0].abs())).powi(2));
        }
    }
    let (low, high) = rows.iter().fold((f64::INFINITY, 0.0_f64), |(l, h), r| (l.min(r.1), h.max(r.1)));
    1.0 / plane[0].clamp(low, high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::{Rng, Se3};

    fn camera() -> Camera {
        Camera::with_fov_y(Se3::look_at([0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]), 0.8, 64, 48)
    }

    /// Points of the plane z = 0.3 x + 1, and strays among them.
    fn wall(strays: usize) -> Vec<[f64; 3]> {
        let rng = Rng::new(3, "wall", 0);
        let place = |i: u64| [6.0 * rng.uniform(2 * i) - 3.0, 5.0 * rng.uniform(2 * i + 1) - 2.5];
        let on = |i: u64| [place(i)[0], place(i)[1], 0.3 * place(i)[0] + 1.0];
        let off = |i: u64| [place(i)[0], place(i)[1], -1.0];
        (0..200).map(on).chain((1000..1000 + strays as u64).map(off)).collect()
    }

    #[test]
    fn a_plane_is_found_everywhere_on_the_image() {
        for (strays, within) in [(0, 1e-2), (20, 3e-2)] {
            let marks = seen(&camera(), &wall(strays), &|_, _| false);
            let mut errors: Vec<f64> = Vec::new();
            for k in 0..12 * 9 {
                let pixel = [5.0 * (k % 12) as f64 + 4.0, 5.0 * (k / 12) as f64 + 4.0];
                let x = camera().unproject(pixel, depth(&marks, pixel));
                errors.push((x[2] - (0.3 * x[0] + 1.0)).abs());
            }
            errors.sort_by(f64::total_cmp);
            assert!(errors[errors.len() * 9 / 10] < within, "{strays} strays: {:?}", &errors[90..]);
        }
    }

    #[test]
    fn too_few_points_or_a_cloud_behind_the_cameras_give_none() {
        let frames = crate::step::tests::Made::new(6, 2, 8);
        assert!(between(&frames, &[[0.0; 3]; NEIGHBOURS - 1], 100, None).unwrap().is_empty());
        let many = between(&frames, &vec![[0.0, 0.0, 0.0]; NEIGHBOURS], 100, None).unwrap();
        assert!(many.points.iter().all(|x| x.iter().all(|v| v.is_finite())));
        assert!(many.len() <= 110, "{} points", many.len());
    }

    #[test]
    fn depth_of_fixed_cameras_is_read_once() {
        let frames = crate::step::tests::Made::new(6, 2, 8);
        assert_eq!(views(&frames, VIEWS).len(), 6);
    }
}
