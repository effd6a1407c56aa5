//! Foregrounds: right poses of cameras around an object see it at one place in front of them.

use super::look::Look;
use splat4d::math::Se3;
use splat4d::math::mat3::solve;
use splat4d::math::se3::{dot, norm, normalize, sub};

/// Images with a foreground that are needed.
const ENOUGH: usize = 4;
/// Angle between the ray to a foreground's middle and the common place, radians: things move, and are seen from other sides.
const WITHIN: f64 = 0.2;
/// Of the cameras' spread: what is nearer is no place in front of a camera.
const CLOSE: f64 = 0.05;
/// Part of the images from which poses are right, and below which another convention may be.
pub(super) const CONVINCES: f64 = 0.7;
const DOUBTFUL: f64 = 0.35;

/// Part of the images whose foreground is at the place that is nearest to all; `None`: too few have one.
pub(super) fn measure(looks: &[Look], poses: &[Se3]) -> Option<f64> {
    let mut rays = Vec::new();
    for (look, pose) in looks.iter().zip(poses) {
        let Some([x, y]) = look.foreground else { continue };
        let back = pose.inverse();
        let center = back.translation;
        rays.push((center, normalize(sub(back.apply([x, y, 1.0]), center))));
    }
    if rays.len() < ENOUGH {
        return None;
    }
    let (mut matrix, mut right) = ([[0.0; 3]; 3], [0.0; 3]);
    for (c, d) in &rays {
        for i in 0..3 {
            for j in 0..3 {
                let m = f64::from(u8::from(i == j)) - d[i] * d[j];
                matrix[i][j] += m;
                right[i] += m * c[j];
            }
        }
    }
    let Some(place) = solve(matrix, right) else { return Some(0.0) };
    let spread = rays.iter().map(|(c, _)| norm(sub(*c, rays[0].0))).fold(0.0, f64::max);
    let sees = |(c, d): &&([f64; 3], [f64; 3])| {
        let to = sub(place, *c);
        norm(to) > CLOSE * spread && dot(normalize(to), *d) >= WITHIN.cos()
    };
    Some(if spread > 0.0 { rays.iter().filter(sees).count() as f64 / rays.len() as f64 } else { 0.0 })
}

/// Whether foregrounds say that poses are written in the convention of `m`.
pub(super) fn prefers(m: Option<f64>, stated: Option<f64>) -> bool {
    m.zip(stated).is_some_and(|(m, stated)| m >= CONVINCES && stated <= DOUBTFUL)
}
