//! Foregrounds: right poses of cameras around an object see it at one place in front of them.

use super::look::{Shown, SmallImage};
use splat4d::math::Se3;
use splat4d::math::mat3::nearest_to_lines;
use splat4d::math::se3::{dot, norm, normalize, sub};

/// Images with a foreground that are needed.
const ENOUGH: usize = 4;
/// Angle between the ray to a foreground's middle and the common position, radians: objects move, and are seen from
/// other sides.
const WITHIN: f64 = 0.2;
/// Of the cameras' spread: nearer positions are not in front of a camera.
const CLOSE: f64 = 0.05;
/// Part of the images from which poses are right, and below which another convention may be.
pub(super) const CONVINCES: f64 = 0.7;
const DOUBTFUL: f64 = 0.35;

/// Masks that show at least this share of the pixels along the edges of images hide something inside them.
const EDGE: f64 = 0.9;
/// Part of the images whose hidden part is at one place, from which masks are inverted: foregrounds of good captures
/// are at one place in 70 % and more.
const INVERTED: f64 = 0.8;
/// Angle between a camera's axis and its target, radians: in the middle half of usual fields of view.
const AIMED: f64 = 0.35;
/// Mean difference of two masks below which they are one: they hide a part of the camera, such as its own mount.
const ONE_MASK: f64 = 0.01;

/// Part of the images whose foreground is at the position that is nearest to all; `None`: too few have one.
pub(super) fn measure(images: &[SmallImage], poses: &[Se3]) -> Option<f64> {
    at_one_place(images, poses, |look| look.foreground).map(|(share, _)| share)
}

/// Polarity of masks: white counts.
pub(super) enum Masks {
    /// There are none, or foregrounds are at one place.
    Fine,
    /// The hidden parts are where the cameras point: part of the images, share of what is shown, and of the edges.
    Inverted(f64, f64, f64),
    /// Neither: images with masks that were examined, and the share of what is shown.
    Unsure(usize, f64),
}

/// Whether masks or alpha hide the cameras' target and show its surroundings.
pub(super) fn masks(images: &[SmallImage], poses: &[Se3]) -> Masks {
    let shown: Vec<&Shown> = images.iter().filter_map(|l| l.shown.as_ref()).collect();
    if shown.is_empty() || measure(images, poses).is_some_and(|share| share >= CONVINCES) {
        return Masks::Fine;
    }
    let mean = |of: fn(&Shown) -> f64| shown.iter().map(|s| of(s)).sum::<f64>() / shown.len() as f64;
    let (share, of_edge) = (mean(|s| s.share), mean(|s| s.of_edge));
    let unsure = Masks::Unsure(shown.len(), share);
    let first = &shown[0].weights;
    let differs = |s: &&Shown| {
        let apart = s.weights.iter().zip(first).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>();
        s.weights.len() != first.len() || apart > ONE_MASK * first.len() as f64
    };
    match at_one_place(images, poses, |look| look.hidden) {
        Some((part, aimed)) if part >= INVERTED && aimed <= AIMED && of_edge >= EDGE && shown.iter().any(differs) => {
            Masks::Inverted(part, share, of_edge)
        }
        _ => unsure,
    }
}

/// Part of the images that have `what` at the place that is nearest to all, and the median angle between that place and
/// the cameras' axes, radians; `None`: too few meet it.
fn at_one_place(
    images: &[SmallImage],
    poses: &[Se3],
    what: impl Fn(&SmallImage) -> Option<[f64; 2]>,
) -> Option<(f64, f64)> {
    let mut rays = Vec::new();
    for (look, pose) in images.iter().zip(poses) {
        let Some([x, y]) = what(look) else { continue };
        let back = pose.inverse();
        let center = back.translation;
        let toward = |at: [f64; 3]| normalize(sub(back.apply(at), center));
        rays.push((center, toward([x, y, 1.0]), toward([0.0, 0.0, 1.0])));
    }
    if rays.len() < ENOUGH {
        return None;
    }
    let nowhere = (0.0, f64::INFINITY);
    let Some(place) = nearest_to_lines(rays.iter().map(|(c, d, _)| (*c, *d))) else { return Some(nowhere) };
    let spread = rays.iter().map(|(c, ..)| norm(sub(*c, rays[0].0))).fold(0.0, f64::max);
    if spread <= 0.0 {
        return Some(nowhere);
    }
    let sees = |(c, d, _): &&([f64; 3], [f64; 3], [f64; 3])| {
        let to = sub(place, *c);
        norm(to) > CLOSE * spread && dot(normalize(to), *d) >= WITHIN.cos()
    };
    let aside =
        |(c, _, axis): &([f64; 3], [f64; 3], [f64; 3])| dot(normalize(sub(place, *c)), *axis).clamp(-1.0, 1.0).acos();
    let mut angles: Vec<f64> = rays.iter().map(aside).collect();
    let middle = angles.len() / 2;
    let aimed = *angles.select_nth_unstable_by(middle, f64::total_cmp).1;
    Some((rays.iter().filter(sees).count() as f64 / rays.len() as f64, aimed))
}

/// Whether foregrounds indicate that poses are written in the convention of `m`.
pub(super) fn prefers(m: Option<f64>, stated: Option<f64>) -> bool {
    m.zip(stated).is_some_and(|(m, stated)| m >= CONVINCES && stated <= DOUBTFUL)
}
