//! Keys over time: similarities and factors.

use crate::math::se3::{add, scale, sub};
use crate::math::{Sim3, quat};
use serde::{Deserialize, Serialize};

/// Above this cosine two rotations are one, and a slerp divides by nothing.
const ALIKE: f64 = 1.0 - 1e-12;

/// A similarity at a time: y = scale · R(turn) (x − about) + about + shift.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PathKey {
    /// Seconds.
    pub t: f64,
    /// Above zero.
    pub scale: f64,
    /// Rotation, a quaternion wxyz of any length but zero.
    pub turn: [f64; 4],
    /// Scene units.
    pub shift: [f64; 3],
    /// Whether the motion eases in and out.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub ease: bool,
}

impl Default for PathKey {
    fn default() -> Self {
        Self { t: 0.0, scale: 1.0, turn: [1.0, 0.0, 0.0, 0.0], shift: [0.0; 3], ease: false }
    }
}

impl PathKey {
    /// A similarity at a time.
    pub(crate) fn new(t: f64, at: &Sim3) -> Self {
        let turn = quat::from_rotation(&at.rotation);
        Self { t, scale: at.scale, turn, shift: at.translation, ease: false }
    }

    /// The similarity about a point.
    pub(crate) fn similarity(&self, about: [f64; 3]) -> Sim3 {
        let rotation = quat::to_rotation(quat::normalize(self.turn).0);
        let still = Sim3 { scale: self.scale, rotation, translation: [0.0; 3] };
        Sim3 { translation: sub(add(about, self.shift), still.apply(about)), ..still }
    }

    fn is_sound(&self) -> bool {
        let length = self.turn.iter().map(|x| x * x).sum::<f64>();
        let finite = self.shift.iter().chain([&self.t, &self.scale, &length]).all(|x| x.is_finite());
        finite && self.scale > 0.0 && length > 0.0
    }
}

/// A factor of opacity at a time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FadeKey {
    /// Seconds.
    pub t: f64,
    /// 0 to 1.
    pub factor: f64,
    /// Whether the motion eases in and out.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub ease: bool,
}

/// How far something is on its way at the share u of its time: evenly, or slowly at the ends that ease (Hermite's cubic
/// with slope 0 there and 1 elsewhere).
pub(crate) fn eased(u: f64, ease: [bool; 2]) -> f64 {
    if ease == [false; 2] {
        return u;
    }
    let [from, to] = ease.map(|e| if e { 0.0 } else { 1.0 });
    u * (from + u * (3.0 - 2.0 * from - to + u * (from + to - 2.0)))
}

pub(super) fn sound(about: &[f64; 3], keys: &[PathKey]) -> bool {
    about.iter().all(|x| x.is_finite())
        && !keys.is_empty()
        && keys.iter().all(PathKey::is_sound)
        && keys.windows(2).all(|k| k[0].t < k[1].t)
}

pub(super) fn sound_fades(keys: &[FadeKey]) -> bool {
    let good = |k: &FadeKey| k.t.is_finite() && (0.0..=1.0).contains(&k.factor);
    !keys.is_empty() && keys.iter().all(good) && keys.windows(2).all(|k| k[0].t < k[1].t)
}

/// The keys on both sides of t, and how far it is from the one to the other.
pub(super) fn around(count: usize, time: impl Fn(usize) -> f64, t: f64) -> (usize, usize, f64) {
    let after = (0..count).find(|&k| time(k) > t).unwrap_or(count);
    match (after, count) {
        (0, _) => (0, 0, 0.0),
        (a, n) if a == n => (n - 1, n - 1, 0.0),
        (a, _) => (a - 1, a, (t - time(a - 1)) / (time(a) - time(a - 1))),
    }
}

/// The similarity at t: shifts along lines, scales along exponentials, rotations the short way at an even rate.
pub(super) fn at(about: [f64; 3], keys: &[PathKey], t: f64) -> Sim3 {
    let (a, b, u) = around(keys.len(), |k| keys[k].t, t);
    if u == 0.0 {
        return keys[a].similarity(about);
    }
    let (a, b) = (&keys[a], &keys[b]);
    let u = eased(u, [a.ease, b.ease]);
    PathKey {
        t,
        ease: false,
        scale: (a.scale.ln() * (1.0 - u) + b.scale.ln() * u).exp(),
        turn: slerp(quat::normalize(a.turn).0, quat::normalize(b.turn).0, u),
        shift: std::array::from_fn(|k| scale(a.shift, 1.0 - u)[k] + scale(b.shift, u)[k]),
    }
    .similarity(about)
}

pub(super) fn factor(keys: &[FadeKey], t: f64) -> f64 {
    let (a, b, u) = around(keys.len(), |k| keys[k].t, t);
    let u = eased(u, [keys[a].ease, keys[b].ease]);
    keys[a].factor * (1.0 - u) + keys[b].factor * u
}

fn slerp(a: [f64; 4], b: [f64; 4], u: f64) -> [f64; 4] {
    let cos: f64 = (0..4).map(|k| a[k] * b[k]).sum();
    let (cos, sign) = if cos < 0.0 { (-cos, -1.0) } else { (cos, 1.0) };
    if cos > ALIKE {
        return std::array::from_fn(|k| a[k] * (1.0 - u) + sign * b[k] * u);
    }
    let angle = cos.acos();
    let (x, y) = (((1.0 - u) * angle).sin() / angle.sin(), sign * (u * angle).sin() / angle.sin());
    std::array::from_fn(|k| x * a[k] + y * b[k])
}
