//! Image channels that only renders of this crate have: normals, lifespans, uncertainty and other numbers of Gaussians,
//! each as further channels of the renderer ([`Shot::extra`]) with a last column that is 1 where a splat has a value, so
//! that [`divided`](splat4d::flow::divided) gives the mean over what a pixel shows. Labels and features are in
//! [`splat4d::channels`].

use splat4d::layers::{Evaluation, Scene};
use splat4d::math::sym3;
use splat4d::render::{Importance, RenderConfig, Shot};
use splat4d::scene::splats::COV;
use splat4d::scene::{Camera, Table, Time};

/// The least gap between the two smallest variances, as a share of the largest, at which the shortest axis is one.
const LEAST_GAP: f64 = 1e-3;
/// Standard deviation of a pixel's error that [`uncertainties`] takes for granted: images of 26 dB.
const PIXEL_NOISE: f64 = 0.05;

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

/// An image that states where Gaussians are.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Witness<'a> {
    /// From where.
    pub camera: &'a Camera,
    /// When.
    pub t: Time,
}

/// The standard deviation of each Gaussian's position that its images leave open, scene units, by layer and row: √(tr
/// (Σ_views H/σ² + I/ρ²)⁻¹ / 3), H the mean's 3x3 block of the Fisher information of an image
/// ([`Sensitivity::fisher`](splat4d::render::Sensitivity::fisher)), σ `PIXEL_NOISE` and ρ `reach`, how far a Gaussian may
/// be from where it is when no image shows it. Each witness represents `share` images. Other Gaussians are taken for
/// known, so that it states too little where several could explain a pixel.
///
/// Source: the Fisher blocks of PUP 3D-GS (Hanson et al. 2025), read as the precision of a Laplace approximation with a
/// Gaussian prior as in Bayes' Rays (Goli et al. 2024).
pub(crate) fn uncertainties(
    scene: &Scene<f32>,
    witnesses: &[Witness<'_>],
    share: f64,
    reach: f64,
    progress: &mut dyn FnMut(usize, usize),
) -> Vec<Vec<f32>> {
    /// Places of xx, xy, xz, yy, yz, zz of the mean in the upper triangle of a 6x6 block.
    const MEAN: [usize; 6] = [0, 1, 2, 6, 7, 11];
    let mut sums: Vec<Vec<[f64; 6]>> = scene.layers.iter().map(|l| vec![[0.0; 6]; l.params.len()]).collect();
    let (mut importance, mut instant) = (Importance::new(RenderConfig::default()), Evaluation::default());
    let mut found = Vec::new();
    for (i, witness) in witnesses.iter().enumerate() {
        progress(i, witnesses.len());
        scene.at(witness.t, &mut instant);
        let splats = scene.splats(&instant);
        importance.sensitivities(&Shot::new(&splats, witness.camera, scene.background), &mut found);
        let mut rest = found.as_slice();
        for (sums, tape) in sums.iter_mut().zip(instant.tapes()) {
            let (own, later) = rest.split_at(tape.out().rows());
            rest = later;
            for (j, one) in own.iter().enumerate() {
                let sum = &mut sums[tape.rows().id(j)];
                (0..6).for_each(|k| sum[k] += one.fisher[MEAN[k]]);
            }
        }
    }
    progress(witnesses.len(), witnesses.len());
    let precision = share / (PIXEL_NOISE * PIXEL_NOISE);
    let deviation = |sum: &[f64; 6]| {
        let (values, _) = sym3::eigen(sum.map(|x| precision * x));
        let variance = |v: f64| 1.0 / (v.max(0.0) + 1.0 / (reach * reach));
        (values.map(variance).iter().sum::<f64>() / 3.0).sqrt() as f32
    };
    sums.iter().map(|layer| layer.iter().map(deviation).collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::flow::divided;
    use splat4d::layers::Layer;
    use splat4d::math::Se3;
    use splat4d::motion::{Spec, build};
    use splat4d::render::{Image, Renderer};
    use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
    use splat4d::scene::{GEOMETRY, LIFE, LifeKind, Params};

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

    #[test]
    fn uncertainty_rises_with_fewer_images() {
        let scene = scene();
        let (front, side) =
            (camera(), Camera { cam_from_world: Se3::look_at([4.0, 0.0, 0.0], [0.0; 3], [0.0, 1.0, 0.0]), ..camera() });
        let of = |views: &[(&Camera, f64)]| {
            let witnesses: Vec<Witness<'_>> = views.iter().map(|&(camera, t)| Witness { camera, t: Time(t) }).collect();
            uncertainties(&scene, &witnesses, 1.0, 10.0, &mut |_, _| {}).remove(0)
        };
        let (none, one, both) = (of(&[]), of(&[(&front, 0.5)]), of(&[(&front, 0.5), (&side, 0.5)]));
        assert!((none[0] - 10.0).abs() < 1e-4 && (none[1] - 10.0).abs() < 1e-4);
        // One image states little of the depth, a second from the side states it.
        assert!(one[0] < none[0] && one[0] > 2.0 * both[0], "{one:?} {both:?}");
        // An image of another time adds no information about short-lived Gaussians.
        let late = of(&[(&front, 0.5), (&side, 0.0)]);
        assert!(late[0] < 0.5 * one[0] && (late[1] / one[1] - 1.0).abs() < 1e-4, "{late:?}");
    }
}
