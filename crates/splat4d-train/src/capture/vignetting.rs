//! Vignetting: lenses darken images towards their corners.
//!
//! The model `pa` of lensfun: light is 1 + k1 r² + k2 r⁴ + k3 r⁶ of what it is in the middle, r from 0 in
//! the middle of the image to 1 in its corners. Codes are light to the power of 1/2.2.

use super::Frame;
use splat4d::{Error, Result};
use std::collections::BTreeSet;

/// Codes are light to the power of 1 by this, as of motion blur.
const GAMMA: f64 = 2.2;
/// Least light that is corrected, and most: beyond it the coefficients are wrong.
const LIGHT: [f64; 2] = [0.1, 2.0];
/// Radii at which coefficients are checked.
const CHECKED: usize = 64;

/// Coefficients as a file or a setting states them. Errors: a corner that is nearly black, or far brighter than the middle.
pub(super) fn checked(k: [f64; 3]) -> Result<[f64; 3]> {
    let radii = (0..=CHECKED).map(|n| (n as f64 / CHECKED as f64).powi(2));
    if let Some(light) = radii.map(|r2| light(&k, r2)).find(|light| !(LIGHT[0]..=LIGHT[1]).contains(light)) {
        let what = format!("invalid vignetting {k:?}: somewhere light would be {light:.2} of that in the middle");
        return Err(Error::input(what).remedy(
            "Give k1, k2, k3 of light = 1 + k1 r² + k2 r⁴ + k3 r⁶, r = 1 in the corners (lensfun's model \"pa\")",
        ));
    }
    Ok(k)
}

/// Coefficients of a setting, `k1,k2,k3`; `None`: it is empty. Errors: no numbers, more than three, and those of [`checked`].
pub(crate) fn parsed(text: &str) -> Result<Option<[f64; 3]>> {
    let mut k = [0.0; 3];
    let numbers: Vec<&str> = text.split(',').map(str::trim).collect();
    if text.trim().is_empty() {
        return Ok(None);
    }
    let bad = || {
        Error::input(format!("invalid capture.vignetting \"{text}\""))
            .remedy("Give up to three numbers, such as -0.31,0.08,-0.02")
    };
    if numbers.len() > k.len() {
        return Err(bad());
    }
    for (k, number) in k.iter_mut().zip(&numbers) {
        *k = number.parse().map_err(|_| bad())?;
    }
    checked(k).map(Some)
}

/// Light at a squared radius, 1 in the middle.
fn light([k1, k2, k3]: &[f64; 3], r2: f64) -> f64 {
    1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
}

/// Removes vignetting from planes of codes [height, width] of the whole image.
pub(super) fn remove(k: &[f64; 3], planes: &mut [Vec<f32>], width: usize, height: usize) {
    let (w, h) = (width as f64, height as f64);
    let gain = |p: usize| {
        let (x, y) = ((p % width) as f64 + 0.5 - 0.5 * w, (p / width) as f64 + 0.5 - 0.5 * h);
        light(k, 4.0 * (x * x + y * y) / (w * w + h * h)).powf(-1.0 / GAMMA) as f32
    };
    let gains: Vec<f32> = (0..width * height).map(gain).collect();
    planes.iter_mut().for_each(|plane| plane.iter_mut().zip(&gains).for_each(|(v, gain)| *v *= gain));
}

/// What is removed, for the user.
pub(super) fn notes(frames: &[Frame]) -> Option<String> {
    let cameras: BTreeSet<usize> = frames.iter().filter(|f| f.vignetting.is_some()).map(|f| f.camera).collect();
    (!cameras.is_empty())
        .then(|| format!("Cameras whose stated vignetting is removed from their images: {}.", cameras.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_lens_darkened_is_as_before() {
        let lens = parsed("-0.5, 0.2,-0.1").unwrap().unwrap();
        let (width, height) = (40, 30);
        let code = |p: usize| 0.2 + 0.6 * (p % 7) as f64 / 7.0;
        let darkened = |p: usize| {
            let (x, y) = ((p % width) as f64 + 0.5 - 20.0, (p / width) as f64 + 0.5 - 15.0);
            // r = 1 at 25 pixels from the middle.
            let r2 = (x * x + y * y) / 625.0;
            let light = code(p).powf(2.2) * (1.0 - 0.5 * r2 + 0.2 * r2.powi(2) - 0.1 * r2.powi(3));
            light.powf(1.0 / 2.2) as f32
        };
        let mut planes = vec![(0..width * height).map(darkened).collect::<Vec<f32>>(); 3];
        assert!(planes[0][0] < 0.9 * code(0) as f32);
        remove(&lens, &mut planes, width, height);
        for plane in &planes {
            assert!(plane.iter().enumerate().all(|(p, v)| (f64::from(*v) - code(p)).abs() < 1e-6));
        }
    }

    #[test]
    fn impossible_coefficients_are_refused() {
        assert_eq!(parsed(" ").unwrap(), None);
        assert_eq!(parsed("-0.3").unwrap(), Some([-0.3, 0.0, 0.0]));
        for text in ["-0.1,0.2,0.1,0", "dark", "-0.1,", "-4"] {
            assert!(parsed(text).unwrap_err().to_string().contains("invalid"), "{text}");
        }
        for k in [[-0.95, 0.0, 0.0], [3.0, 0.0, 0.0], [f64::NAN, 0.0, 0.0], [-4.0, 4.0, 0.0]] {
            assert!(checked(k).unwrap_err().to_string().contains("invalid vignetting"), "{k:?}");
        }
    }
}
