//! Compares two descriptions of the same cameras: whether they agree, and the similarity between their worlds.

use super::rig;
use splat4d::math::se3::{dot, mat_mul, norm, sub, transpose};
use splat4d::math::{Se3, Sim3, mat3};
use splat4d::{Error, Result};
use std::path::Path;

/// Fewest cameras that both must have: three places make a frame.
const LEAST: usize = 3;
/// Root mean square distance of cameras that still agree, of their root mean square spread. Poses that were refined
/// after export differ by tenths of a percent, those of another reconstruction by many.
const PLACE: f64 = 0.01;
/// Root mean square angle between cameras that still agree, radians.
const ANGLE: f64 = 0.02;

/// Spread of cameras in one place, of their distance from the origin: rounding.
const ONE_PLACE: f64 = 1e-9;

/// Common form of an image's path in both descriptions: without its ending and without folders that name no camera.
pub(super) fn key(path: &Path) -> String {
    let plain = path.with_extension("");
    let parts = plain.iter().filter_map(|part| part.to_str()).filter(|part| !rig::is_plain(part));
    parts.collect::<Vec<_>>().join("/")
}

/// The similarity from the second world into the first, the identity where they already agree; `pairs` are one camera's
/// poses in both. Errors: they do not agree, and by how much.
pub(super) fn align(pairs: &[(Se3, Se3)]) -> Result<Sim3> {
    const REMEDY: &str = "Points of the poses' own world can be named by ply_file_path, or by --set init=FILE.";
    if pairs.len() < LEAST {
        let what = format!("it has only {} of the images, by name", pairs.len());
        return Err(Error::input(what).remedy(REMEDY));
    }
    if spread(pairs) <= ONE_PLACE * (1.0 + norm(means(pairs).0)) {
        return Err(Error::input("all cameras have the same position, which gives no scale").remedy(REMEDY));
    }
    let fitted = fit(pairs);
    let choices = [Sim3::default(), fitted];
    let misfit = |s: &Sim3| {
        let (place, angle) = errors(pairs, s);
        (place / spread(pairs), angle)
    };
    let agrees = |s: &&Sim3| {
        let (place, angle) = misfit(s);
        place <= PLACE && angle <= ANGLE
    };
    choices.iter().find(agrees).copied().ok_or_else(|| {
        let (place, angle) = misfit(&fitted);
        let what = format!(
            "its cameras do not agree with the poses: at best they are {:.1} % of the cameras' spread and {:.1}° apart",
            100.0 * place,
            angle.to_degrees()
        );
        Error::input(what).remedy(REMEDY)
    })
}

fn centers(pairs: &[(Se3, Se3)]) -> impl Iterator<Item = ([f64; 3], [f64; 3])> {
    pairs.iter().map(|(a, b)| (a.inverse().translation, b.inverse().translation))
}

fn means(pairs: &[(Se3, Se3)]) -> ([f64; 3], [f64; 3]) {
    let n = pairs.len() as f64;
    let mut out = ([0.0; 3], [0.0; 3]);
    for (a, b) in centers(pairs) {
        (0..3).for_each(|k| {
            out.0[k] += a[k] / n;
            out.1[k] += b[k] / n;
        });
    }
    out
}

/// Root mean square distance of the first world's cameras from their mean.
fn spread(pairs: &[(Se3, Se3)]) -> f64 {
    let mean = means(pairs).0;
    let sum: f64 = centers(pairs).map(|(a, _)| dot(sub(a, mean), sub(a, mean))).sum();
    (sum / pairs.len() as f64).sqrt()
}

/// The rotation that all cameras' axes agree on, then scale and translation of their places: axes are more reliable
/// than positions where cameras are in a row.
fn fit(pairs: &[(Se3, Se3)]) -> Sim3 {
    let mut cov = [[0.0; 3]; 3];
    for (a, b) in pairs {
        let turn = mat_mul(&transpose(&a.rotation), &b.rotation);
        (0..3).for_each(|i| (0..3).for_each(|j| cov[i][j] += turn[i][j]));
    }
    let turned = Sim3::from_rotation(mat3::procrustes(cov));
    let (mean_a, mean_b) = means(pairs);
    let (mut along, mut own) = (0.0, 0.0);
    for (a, b) in centers(pairs) {
        let b = turned.apply(sub(b, mean_b));
        along += dot(sub(a, mean_a), b);
        own += dot(b, b);
    }
    let scale = if along > 0.0 && own > 0.0 { along / own } else { 1.0 };
    let scaled = Sim3 { scale, ..turned };
    Sim3 { translation: sub(mean_a, scaled.apply(mean_b)), ..scaled }
}

/// Root mean square distance (the first world's unit) and angle (radians) that are left.
fn errors(pairs: &[(Se3, Se3)], s: &Sim3) -> (f64, f64) {
    let n = pairs.len() as f64;
    let far: f64 = centers(pairs).map(|(a, b)| norm(sub(a, s.apply(b))).powi(2)).sum();
    let turned: f64 = pairs
        .iter()
        .map(|(a, b)| {
            let left = mat_mul(&a.rotation, &mat_mul(&s.rotation, &transpose(&b.rotation)));
            let trace = left[0][0] + left[1][1] + left[2][2];
            (0.5 * (trace - 1.0)).clamp(-1.0, 1.0).acos().powi(2)
        })
        .sum();
    ((far / n).sqrt(), (turned / n).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cameras() -> Vec<Se3> {
        let eye = |i: usize| [3.0 * (i as f64).cos(), 3.0 * (i as f64).sin(), 1.0 + 0.3 * i as f64];
        (0..6).map(|i| Se3::look_at(eye(i), [0.0; 3], [0.0, 0.0, 1.0])).collect()
    }

    /// The camera in a world that `s` brings into this one.
    fn seen_from(camera: &Se3, s: &Sim3) -> Se3 {
        let rotation = mat_mul(&camera.rotation, &s.rotation);
        let back = Sim3 { scale: 1.0, rotation: transpose(&s.rotation), translation: [0.0; 3] };
        let center = back.apply(sub(camera.inverse().translation, s.translation)).map(|v| v / s.scale);
        let world_from_cam = Se3 { rotation: transpose(&rotation), translation: center };
        world_from_cam.inverse()
    }

    #[test]
    fn another_world_is_found_and_strangers_are_refused() {
        let s = Sim3 {
            scale: 0.2,
            rotation: Se3::look_at([1.0, 2.0, 0.5], [0.0; 3], [0.3, 0.0, 1.0]).rotation,
            translation: [4.0, -1.0, 2.0],
        };
        let pairs: Vec<(Se3, Se3)> = cameras().iter().map(|c| (*c, seen_from(c, &s))).collect();
        let found = align(&pairs).unwrap();
        let apart = norm(sub(found.apply([1.0, 2.0, 3.0]), s.apply([1.0, 2.0, 3.0])));
        assert!(apart < 1e-9 && (found.scale - s.scale).abs() < 1e-9, "{found:?}");
        let same: Vec<(Se3, Se3)> = cameras().iter().map(|c| (*c, *c)).collect();
        assert!(align(&same).unwrap().is_identity());
        let mixed: Vec<(Se3, Se3)> = cameras().into_iter().zip(cameras().into_iter().rev()).collect();
        assert!(align(&mixed).unwrap_err().to_string().contains("do not agree"));
        assert!(align(&same[..2]).unwrap_err().to_string().contains("only 2"));
        let still = [(cameras()[0], cameras()[1]); 3];
        assert!(align(&still).unwrap_err().to_string().contains("same position"));
    }

    #[test]
    fn names_are_compared_without_plain_folders_and_endings() {
        assert_eq!(key(Path::new("images/cam0/0001.png")), "cam0/0001");
        assert_eq!(key(Path::new("cam0/0001.jpg")), "cam0/0001");
    }
}
