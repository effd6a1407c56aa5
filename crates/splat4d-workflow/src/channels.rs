//! Image channels that only renders of this crate have: normals, lifespans, uncertainty and other numbers of Gaussians,
//! each as further channels of the renderer ([`Shot::extra`](splat4d::render::Shot::extra)) with a last column that is 1 where a splat has a value, so
//! that [`divided`](splat4d::flow::divided) gives the mean over what a pixel shows. Labels and features are in
//! [`splat4d::channels`].

use splat4d::layers::{Evaluation, Scene};
use splat4d::math::sym3;
use splat4d::scene::splats::COV;
use splat4d::scene::{Camera, Planes, Table};

/// The least gap between the two smallest variances, as a share of the largest, at which the shortest axis is one.
const LEAST_GAP: f64 = 1e-3;

/// Unit normals, the shortest axes of the splats turned towards the camera, in camera axes (x right, y down, z
/// forward): [splats, 4], x, y, z and 1; zeros where no axis is the shortest.
pub(crate) fn normal_columns(instant: &Evaluation, camera: &Camera) -> Table {
    let rows = instant.tapes().map(|t| t.out().rows()).sum();
    let mut out = Table::new(&[("normal", 3), ("valid", 1)], rows);
    let (center, r) = (camera.center(), &camera.cam_from_world.rotation);
    let mut j = 0;
    for tape in instant.tapes() {
        for row in 0..tape.out().rows() {
            let mean = tape.out().read::<3>(row, 0).map(f64::from);
            let (values, vectors) = sym3::eigen(tape.out().read::<6>(row, COV).map(f64::from));
            if values[1] - values[2] > LEAST_GAP * values[0] {
                let axis: [f64; 3] = std::array::from_fn(|k| vectors[k][2]);
                let towards: f64 = (0..3).map(|k| axis[k] * (center[k] - mean[k])).sum();
                let sign = if towards < 0.0 { -1.0 } else { 1.0 };
                let n: [f64; 3] = std::array::from_fn(|i| sign * (0..3).map(|c| r[i][c] * axis[c]).sum::<f64>());
                out.write(j, 0, [n[0] as f32, n[1] as f32, n[2] as f32, 1.0]);
            }
            j += 1;
        }
    }
    out
}

/// A number per Gaussian, by layer and row, as [splats, 2]: it and 1; zeros where it is not finite.
///
/// Panics: `instant` is not of a scene with this many layers and rows.
pub(crate) fn number_columns(instant: &Evaluation, numbers: &[Vec<f32>]) -> Table {
    let rows = instant.tapes().map(|t| t.out().rows()).sum();
    let mut out = Table::new(&[("number", 1), ("valid", 1)], rows);
    let mut first = 0;
    for (tape, numbers) in instant.tapes().zip(numbers) {
        let own = tape.out().rows();
        for j in 0..own {
            let number = numbers[tape.rows().id(j)];
            if number.is_finite() {
                out.write(first + j, 0, [number, 1.0]);
            }
        }
        first += own;
    }
    out
}

/// Seconds of the clip in which each Gaussian can be seen, by layer and row; 0: never.
pub(crate) fn lifetimes(scene: &Scene<f32>) -> Vec<Vec<f32>> {
    let [first, last] = scene.clip;
    let length = |[from, to]: [f64; 2]| (to.min(last) - from.max(first)).max(0.0) as f32;
    scene.layers.iter().map(|l| l.spans().into_iter().map(length).collect()).collect()
}

/// The depth of every splat and its square: [splats, 3], both and 1. `radial`: the distance from the camera instead of z
/// in camera axes, for images of more than a half-space. Depths are relative to their median, so that the squares of near
/// ones keep their digits.
///
/// [`spread`] makes the uncertainty of an image of them.
pub(crate) fn depth_columns(instant: &Evaluation<f32>, camera: &Camera, radial: bool) -> Table<f32> {
    let mut depths = Vec::new();
    for tape in instant.tapes() {
        for j in 0..tape.out().rows() {
            let [x, y, z] = camera.cam_from_world.apply(tape.out().read::<3>(j, 0).map(f64::from));
            depths.push(if radial { (x * x + y * y + z * z).sqrt() } else { z });
        }
    }
    let mut out = Table::new(&[("depth", 2), ("valid", 1)], depths.len());
    if let Some(last) = depths.len().checked_sub(1) {
        let mut order = depths.clone();
        let middle = *order.select_nth_unstable_by(last / 2, f64::total_cmp).1;
        for (j, depth) in depths.into_iter().enumerate() {
            let depth = depth - middle;
            out.write(j, 0, [depth, depth * depth, 1.0].map(|x| x as f32));
        }
    }
    out
}

/// The standard deviation of the depths that each pixel shows, [1, h, w], from the [`divided`](splat4d::flow::divided)
/// means of [`depth_columns`]. A surface is one depth; haze, and surfaces that share a pixel, are several.
pub(crate) fn spread(means: &Planes<f32>) -> Planes<f32> {
    let mut out = Planes::new(1, means.height, means.width);
    for ((out, depth), square) in out.data.iter_mut().zip(means.plane(0)).zip(means.plane(1)) {
        *out = (square - depth * depth).max(0.0).sqrt();
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::flow::divided;
    use splat4d::layers::Layer;
    use splat4d::math::Se3;
    use splat4d::motion::{Spec, build};
    use splat4d::render::{Image, RenderConfig, Renderer, Shot};
    use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
    use splat4d::scene::{GEOMETRY, LIFE, LifeKind, Params, Time};

    fn camera() -> Camera {
        Camera::with_fov_y(Se3::look_at([0.0, 0.0, 4.0], [0.0; 3], [0.0, 1.0, 0.0]), 0.7, 48, 32)
    }

    /// Two discs that face the camera: one to the left of the image, one to the right and farther.
    fn scene() -> Scene<f32> {
        let mut p = Params::new(2, 1, LifeKind::GaussHalf.columns());
        for (r, x) in [(0, -0.6), (1, 0.6)] {
            p[GEOMETRY].write(r, 0, [x, 0.0, -0.5 * r as f32]);
            p[GEOMETRY].write(r, QUAT, [1.0, 0.0, 0.0, 0.0]);
            p[GEOMETRY].write(r, LOG_SCALE, [-1.6, -1.6, -5.0]);
            p[GEOMETRY].set(r, OPACITY, 6.0);
            p[LIFE].write(r, 0, [0.5, if r == 0 { 4.0 } else { -3.0 }]);
        }
        let motion = build(&Spec::Still, &mut p).unwrap();
        let layers = vec![Layer::new("a", p, motion, LifeKind::GaussHalf)];
        Scene { layers, clip: [0.0, 1.0], fps: 10.0, ..Scene::default() }
    }

    /// The channel's value in the middle of both discs.
    fn shown(columns: &Table<f32>) -> [Vec<f32>; 2] {
        let (scene, mut instant, mut image) = (scene(), Evaluation::default(), Image::default());
        scene.at(Time(0.5), &mut instant);
        let splats = scene.splats(&instant);
        let camera = camera();
        let shot = Shot { extra: Some(columns), ..Shot::new(&splats, &camera, [0.0; 3]) };
        Renderer::new(RenderConfig::default()).render(&shot, &mut image);
        let (values, weight) = divided(&image.extra);
        [[-0.6, 0.0, 0.0], [0.6, 0.0, -0.5]].map(|x| {
            let ([u, v], _) = camera.project(x).unwrap();
            assert!(weight.get(0, v as usize, u as usize) > 0.3);
            (0..values.channels).map(|c| values.get(c, v as usize, u as usize)).collect()
        })
    }

    fn instant() -> Evaluation<f32> {
        let mut instant = Evaluation::default();
        scene().at(Time(0.5), &mut instant);
        instant
    }

    #[test]
    fn normals_face_the_camera() {
        for n in shown(&normal_columns(&instant(), &camera())) {
            assert!(n[2] < -0.99 && n[0].abs() < 0.02 && n[1].abs() < 0.02, "{n:?}");
        }
    }

    #[test]
    fn lifespans_are_those_of_visible_surfaces() {
        let [long, short] = shown(&number_columns(&instant(), &lifetimes(&scene())));
        assert!((long[0] - 1.0).abs() < 1e-5 && (0.1..0.5).contains(&short[0]), "{long:?} {short:?}");
    }

    /// What the middle of an image shows of discs on the camera's axis, at these depths and with these opacities.
    fn uncertainty(discs: &[(f32, f32)], radial: bool) -> f32 {
        let camera = Camera::with_fov_y(Se3::look_at([0.0; 3], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]), 0.7, 33, 33);
        let mut p = Params::new(discs.len(), 1, LifeKind::Infinite.columns());
        for (r, &(z, opacity)) in discs.iter().enumerate() {
            p[GEOMETRY].write(r, 0, [0.0, 0.0, z]);
            p[GEOMETRY].write(r, QUAT, [1.0, 0.0, 0.0, 0.0]);
            p[GEOMETRY].write(r, LOG_SCALE, [0.0, 0.0, -5.0]);
            p[GEOMETRY].set(r, OPACITY, (opacity / (1.0 - opacity)).ln());
        }
        let motion = build(&Spec::Still, &mut p).unwrap();
        let scene = Scene { layers: vec![Layer::new("a", p, motion, LifeKind::Infinite)], ..Scene::default() };
        let (mut instant, mut image) = (Evaluation::default(), Image::default());
        scene.at(Time(0.0), &mut instant);
        let columns = depth_columns(&instant, &camera, radial);
        let splats = scene.splats(&instant);
        let shot = Shot { extra: Some(&columns), ..Shot::new(&splats, &camera, [0.0; 3]) };
        Renderer::new(RenderConfig::default()).render(&shot, &mut image);
        spread(&divided(&image.extra).0).get(0, 16, 16)
    }

    #[test]
    fn uncertainty_is_the_spread_of_depths_in_a_pixel() {
        let expected = |discs: &[(f32, f32)]| {
            let (mut light, mut sums) = (1.0, [0.0; 3]);
            for (depth, opacity) in discs {
                let terms = [1.0, *depth, depth * depth].map(|x| light * opacity * x);
                sums.iter_mut().zip(terms).for_each(|(sum, x)| *sum += x);
                light *= 1.0 - opacity;
            }
            (sums[2] / sums[0] - (sums[1] / sums[0]).powi(2)).max(0.0).sqrt()
        };
        for radial in [false, true] {
            assert!(uncertainty(&[(4.0, 0.9)], radial) < 1e-3, "a surface is one depth");
            for discs in [&[(4.0, 0.5), (6.0, 0.9)][..], &[(4.0, 0.9), (6.0, 0.5), (50.0, 0.5)]] {
                let (found, expected) = (uncertainty(discs, radial), expected(discs));
                assert!((found / expected - 1.0).abs() < 1e-3, "{found}, not {expected}");
            }
            // A Gaussian that is far away, and not rendered here, takes no digits from near depths.
            let near = expected(&[(4.0, 0.6), (4.02, 0.9)]);
            let found = uncertainty(&[(4.0, 0.6), (4.02, 0.9), (1000.0, 0.001)], radial);
            assert!((found / near - 1.0).abs() < 0.02, "{found}, not {near}");
        }
    }
}
