//! Rotates a whole scene, and lowers its SH degree: for conversion between programs' axes.

use super::Scene;
use crate::math::{Sim3, quat, se3, sh};
use crate::scene::head::{FURTHER, HIDDEN, INPUTS};
use crate::scene::{HeadKeys, Params, SH, Table};

/// Vectors shorter than this name no direction.
const NO_DIRECTION: f64 = 1e-6;
/// 1 + cos of the angle below which two directions count as opposite: the short way round is then not defined.
const OPPOSITE: f64 = 1e-9;
/// Beyond this cosine to x, x has no good part across.
const ALONG_X: f64 = 0.9;

/// The rotation (rows) that takes direction `from` to `to` the short way. Opposite directions: half a turn about x, which
/// is what programs with y up and y down do to each other's files; along x, about z.
///
/// `None`: one of them is not a direction.
pub fn rotation_between(from: [f64; 3], to: [f64; 3]) -> Option<[[f64; 3]; 3]> {
    if [from, to].iter().any(|v| !(se3::norm(*v) > NO_DIRECTION && se3::norm(*v).is_finite())) {
        return None;
    }
    let (a, b) = (se3::normalize(from), se3::normalize(to));
    let w = 1.0 + a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    if w < OPPOSITE {
        // Half a turn about the part of x that is across: 2nnᵀ − 1. The zeros of an axis stay zeros.
        let k = if a[0].abs() > ALONG_X { 2 } else { 0 };
        let across = se3::normalize(std::array::from_fn(|i| f64::from(u8::from(i == k)) - a[k] * a[i]));
        return Some(std::array::from_fn(|i| {
            std::array::from_fn(|j| 2.0 * across[i] * across[j] - f64::from(u8::from(i == j)))
        }));
    }
    let q = [w, a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    Some(quat::to_rotation(quat::normalize(q).0))
}

impl Scene<f32> {
    /// Rotates everything by `r` (rows): the layers' frames, into the tables of models that can take them in
    /// ([`Layer::apply_transform`](super::Layer::apply_transform)), the rays that a head sees, `up` and `offset`.
    pub fn rotate(&mut self, r: &[[f64; 3]; 3]) {
        for layer in &mut self.layers {
            layer.frame = Sim3::from_rotation(*r).after(&layer.frame);
            layer.apply_transform();
        }
        if let Some((layer, keys)) = self.head_keys() {
            rotate_head(&mut self.layers[layer].params, keys, r);
        }
        self.up = se3::mat_vec(r, self.up);
        self.offset = se3::mat_vec(r, self.offset);
    }

    /// Leaves out spherical harmonics above `degree` (0-3). Returns the highest degree that any layer had.
    pub fn limit_sh(&mut self, degree: usize) -> usize {
        let mut highest = 0;
        for layer in &mut self.layers {
            let old = &layer.params[SH];
            let had = sh::degree_of(old.width() / 3).unwrap_or(0);
            highest = highest.max(had);
            if had > degree {
                let mut new = Table::new(&[("sh", 3 * sh::coeffs(degree))], old.rows());
                for row in 0..old.rows() {
                    for col in 0..new.width() {
                        new.set(row, col, old.get(row, col));
                    }
                }
                layer.params[SH] = new;
            }
        }
        highest
    }
}

/// The network sees rays in world axes: W₁x is to be the same for rotated rays, so that the rows of its columns for origin
/// and direction rotate as the rays do.
fn rotate_head(params: &mut Params, keys: HeadKeys, r: &[[f64; 3]; 3]) {
    let table = &mut params[keys.first];
    for row in (0..HIDDEN).map(|h| h * INPUTS) {
        for first in [row + FURTHER, row + FURTHER + 3] {
            let rotated = se3::mat_vec(r, std::array::from_fn(|k| f64::from(table.get(first + k, 0))));
            (0..3).for_each(|k| table.set(first + k, 0, rotated[k] as f32));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::{Evaluation, Head, Layer};
    use crate::math::{Rng, Se3};
    use crate::motion::spacetime::FeatureSpec;
    use crate::motion::{SpacetimeSpec, Spec, build};
    use crate::render::{Image, RenderConfig, Renderer, Shot};
    use crate::scene::params::LOG_SCALE;
    use crate::scene::{Camera, GEOMETRY, LifeKind, Time};

    fn moving(features: Option<FeatureSpec>) -> Scene<f32> {
        let spec = Spec::Spacetime(SpacetimeSpec { order: 3, rotation: true, detach: true, origin: 0.0, features });
        let mut params = Params::new(40, 16, LifeKind::GaussOne.columns());
        let motion = build(&spec, &mut params).unwrap();
        let rng = Rng::new(3, "turn", 0);
        for key in params.keys().collect::<Vec<_>>() {
            let table = &mut params[key];
            for row in 0..table.rows() {
                for col in 0..table.width() {
                    table.set(row, col, 0.5 * rng.fork(u64::from(key.0)).normal((row * 64 + col) as u64) as f32);
                }
            }
        }
        for row in 0..40 {
            for k in 0..3 {
                *params[GEOMETRY].get_mut(row, LOG_SCALE + k) -= 2.0;
            }
        }
        let layer = Layer::new("a", params, motion, LifeKind::GaussOne);
        let head = if features.is_some() { Head::Features } else { Head::Identity };
        Scene { layers: vec![layer], clip: [0.0, 1.0], fps: 30.0, up: [0.0, 1.0, 0.0], head, ..Scene::default() }
    }

    fn draw(scene: &Scene<f32>, pose: Se3, time: f64) -> Vec<f32> {
        let camera = Camera::with_fov_y(pose, 0.9, 48, 40);
        let (mut instant, mut image) = (Evaluation::default(), Image::default());
        scene.at(Time(time), &mut instant);
        Renderer::new(RenderConfig::default())
            .render(&Shot::new(&scene.splats(&instant), &camera, [0.2; 3]), &mut image);
        image.color.data
    }

    #[test]
    fn a_turned_scene_seen_by_a_turned_camera_is_the_same_image() {
        the_same_picture(&moving(None));
        let featured = moving(Some(FeatureSpec { seed: 3 }));
        the_same_picture(&featured);
        let plain = Scene { head: Head::Identity, ..featured.clone() };
        let pose = Se3::look_at([0.5, 0.4, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let pairs = draw(&featured, pose, 0.3).into_iter().zip(draw(&plain, pose, 0.3));
        assert!(pairs.filter(|(a, b)| (a - b).abs() > 0.05).count() > 200, "the head must matter");
    }

    fn the_same_picture(scene: &Scene<f32>) {
        let r = quat::to_rotation(quat::normalize([0.4, -0.3, 0.8, 0.2]).0);
        let mut turned = scene.clone();
        turned.rotate(&r);
        let pose = Se3::look_at([0.5, 0.4, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let rotation = std::array::from_fn(|i| {
            std::array::from_fn(|j| (0..3).map(|k| pose.rotation[i][k] * r[j][k]).sum::<f64>())
        });
        let turned_pose = Se3 { rotation, translation: pose.translation };
        for time in [0.0, 0.3, 0.9] {
            let (a, b) = (draw(scene, pose, time), draw(&turned, turned_pose, time));
            let worst = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 1e-3, "{time}: {worst}");
            assert!(a.iter().filter(|v| (**v - 0.2).abs() > 0.05).count() > 200, "the test must look at something");
        }
        let kept = draw(&turned, pose, 0.3);
        let other = draw(scene, pose, 0.3);
        assert!(kept.iter().zip(&other).any(|(a, b)| (a - b).abs() > 0.1), "a rotation must be visible");
    }

    #[test]
    fn the_rotation_between_two_directions_is_exact() {
        let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.1, -0.9, 0.2]];
        for from in axes.into_iter().chain(axes.map(|a| a.map(|x| -x))) {
            for to in axes {
                let r = rotation_between(from, to).unwrap();
                let pose = Se3 { rotation: r, translation: [0.0; 3] };
                assert!(pose.orthogonality_error() < 1e-12 && (pose.det() - 1.0).abs() < 1e-12);
                let (a, b) = (se3::normalize(from), se3::normalize(to));
                assert!((0..3).all(|k| ((0..3).map(|l| r[k][l] * a[l]).sum::<f64>() - b[k]).abs() < 1e-9));
            }
        }
        // y down to y up is (x, -y, -z): the change between the axes of .ply and .spz.
        let r = rotation_between([0.0, -1.0, 0.0], [0.0, 1.0, 0.0]).unwrap();
        assert_eq!(r, [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]);
        assert!(rotation_between([0.0; 3], [0.0, 1.0, 0.0]).is_none());
        assert!(rotation_between([f64::NAN; 3], [0.0, 1.0, 0.0]).is_none());
    }

    #[test]
    fn lower_degrees_keep_the_first_coefficients() {
        let mut scene = moving(None);
        let before = scene.layers[0].params[SH].read::<12>(7, 0);
        assert_eq!(scene.limit_sh(1), 3);
        let table = &scene.layers[0].params[SH];
        assert_eq!((table.width(), table.read::<12>(7, 0)), (12, before));
        assert_eq!(scene.limit_sh(2), 1, "a lower degree is not raised");
    }
}
