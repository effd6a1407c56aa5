//! Shutters that are not ideal: rows that are read one after the other, exposures during which something moves, and
//! the motion of the camera meanwhile.

use super::{Frame, Rig};
use splat4d::math::Se3;
use splat4d::math::se3::{cross, norm};
use splat4d::{Error, Result};
use std::collections::BTreeSet;

/// Longest readout and exposure that is accepted, seconds. Larger numbers are probably milliseconds.
const LONGEST: f64 = 2.0;
/// Neighbouring images of a moving camera give its velocity if they are at most this many seconds away.
const NEAR: f64 = 0.25;

/// How an image is exposed. Its time is that of the middle row, at the middle of its exposure.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shutter {
    /// Seconds from the first row to the last; negative: the last row is the first one read.
    pub readout: f64,
    /// Seconds during which each row collects light; 0: the render is not averaged.
    pub exposure: f64,
    /// Renders that are averaged over the exposure, at least 1.
    pub subframes: usize,
    /// The camera's motion (ρ, θ) per second: τ seconds later its pose is exp(τ·twist)·`cam_from_world`.
    pub twist: [f64; 6],
}

impl Shutter {
    /// Of these stated times; `None`: it is ideal.
    pub(super) fn new(readout: f64, exposure: f64, subframes: usize) -> Option<Self> {
        let exposure = if subframes > 1 { exposure } else { 0.0 };
        let subframes = if exposure > 0.0 { subframes } else { 1 };
        (readout != 0.0 || exposure > 0.0).then_some(Self { readout, exposure, subframes, twist: [0.0; 6] })
    }

    /// Half of the time from the first light of an image to its last, seconds.
    pub(crate) fn half(&self) -> f64 {
        0.5 * (self.readout.abs() + self.exposure)
    }

    /// The middle of every subframe, seconds from the middle of the exposure.
    pub(crate) fn subframe(&self, k: usize) -> f64 {
        ((k as f64 + 0.5) / self.subframes as f64 - 0.5) * self.exposure
    }

    /// When a row is read, seconds from the middle row; `share`: its place, from 0 (top) to 1.
    pub(crate) fn row(&self, share: f64) -> f64 {
        (share.clamp(0.0, 1.0) - 0.5) * self.readout
    }
}

/// A readout or exposure time as a file or a setting states it. Errors: not seconds.
pub(super) fn checked(what: &str, seconds: f64) -> Result<f64> {
    if seconds.abs() <= LONGEST && (what == "readout" || seconds >= 0.0) {
        return Ok(seconds);
    }
    Err(Error::input(format!("invalid {what}: {seconds} s"))
        .remedy("Give it in seconds, for instance 0.02 for 20 milliseconds."))
}

/// Gives moving cameras with a shutter their velocity: between the images before and after, or, at the ends, from one
/// of them.
pub(super) fn find_motion(frames: &mut [Frame], cameras: &[Rig]) {
    let mut order: Vec<usize> =
        (0..frames.len()).filter(|&i| frames[i].shutter.is_some() && !cameras[frames[i].camera].fixed).collect();
    order.sort_by(|&a, &b| {
        let key = |i: usize| (frames[i].camera, frames[i].time.0);
        key(a).0.cmp(&key(b).0).then(key(a).1.total_cmp(&key(b).1))
    });
    for (k, &i) in order.iter().enumerate() {
        let near = |j: Option<&usize>| {
            let (own, j) = (&frames[i], *j?);
            let other = &frames[j];
            (other.camera == own.camera && (other.time.0 - own.time.0).abs() <= NEAR).then_some(j)
        };
        let before = near(k.checked_sub(1).and_then(|k| order.get(k))).unwrap_or(i);
        let after = near(order.get(k + 1)).unwrap_or(i);
        let seconds = frames[after].time.0 - frames[before].time.0;
        if seconds > 0.0 {
            let change = frames[after].view.cam_from_world.after(&frames[before].view.cam_from_world.inverse());
            let twist = logarithm(&change).map(|x| x / seconds);
            frames[i].shutter.iter_mut().for_each(|shutter| shutter.twist = twist);
        }
    }
}

/// What is modelled of the cameras, for the user.
pub(super) fn notes(frames: &[Frame]) -> Vec<String> {
    let count = |has: &dyn Fn(&Shutter) -> bool| {
        let cameras = frames.iter().filter(|f| f.shutter.as_ref().is_some_and(has)).map(|f| f.camera);
        cameras.collect::<BTreeSet<usize>>().len()
    };
    let (rolling, blurred) = (count(&|s| s.readout != 0.0), count(&|s| s.subframes > 1));
    let subframes = frames.iter().filter_map(|f| Some(f.shutter?.subframes)).max().unwrap_or(1);
    let mut out = Vec::new();
    if rolling > 0 {
        out.push(format!("Cameras with a rolling shutter, whose rows have their own times: {rolling}."));
    }
    if blurred > 0 {
        out.push(format!("Cameras with motion blur, whose images are averages of {subframes} renders: {blurred}."));
    }
    out
}

/// The twist (ρ, θ) of a small rigid motion. The inverse of the left Jacobian is taken to second order: exact enough
/// for the motion between two images of a film.
fn logarithm(motion: &Se3) -> [f64; 6] {
    let r = &motion.rotation;
    let axis = [r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]].map(|x| 0.5 * x);
    let sine = norm(axis);
    let angle = sine.atan2(0.5 * (r[0][0] + r[1][1] + r[2][2] - 1.0));
    let theta = axis.map(|x| if sine > 1e-12 { x * angle / sine } else { x });
    let t = motion.translation;
    let (once, twice) = (cross(theta, t), cross(theta, cross(theta, t)));
    let rho: [f64; 3] = std::array::from_fn(|k| t[k] - 0.5 * once[k] + twice[k] / 12.0);
    [rho[0], rho[1], rho[2], theta[0], theta[1], theta[2]]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_and_subframes_are_centred_on_the_images_time() {
        let shutter = Shutter::new(0.03, 0.02, 4).unwrap();
        assert_eq!([shutter.row(0.0), shutter.row(0.5), shutter.row(7.0)], [-0.015, 0.0, 0.015]);
        let all: Vec<f64> = (0..4).map(|k| shutter.subframe(k)).collect();
        assert!(all.iter().sum::<f64>().abs() < 1e-15 && (all[0] + 0.0075).abs() < 1e-15, "{all:?}");
        assert_eq!(Shutter::new(0.0, 0.02, 1), None, "one subframe does not blur");
        assert_eq!(Shutter::new(-0.01, 0.02, 1).unwrap().half(), 0.005);
    }

    #[test]
    fn milliseconds_are_refused() {
        assert!(checked("readout", 30.0).unwrap_err().to_string().contains("30 s"));
        assert!(checked("exposure_time", -0.01).is_err() && checked("readout", -0.01).is_ok());
    }

    #[test]
    fn the_logarithm_is_the_motions_twist() {
        // About z by 0.1, after which the origin has moved by the integral of the velocity.
        let (a, v) = (0.1f64, [0.3, -0.2, 0.5]);
        let (sin, cos) = (a.sin(), a.cos());
        let rotation = [[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]];
        let translation = [(sin * v[0] - (1.0 - cos) * v[1]) / a, ((1.0 - cos) * v[0] + sin * v[1]) / a, v[2]];
        let twist = logarithm(&Se3 { rotation, translation });
        let expected = [v[0], v[1], v[2], 0.0, 0.0, a];
        assert!(twist.iter().zip(expected).all(|(x, y)| (x - y).abs() < 1e-6), "{twist:?}");
    }
}
