//! `capture --film FAULTS FOLDER`: the bundled scene as cameras that are not ideal film it, with ground-truth poses. Held-out
//! cameras are ideal, so that scenes of different faults are measured on the same images.
//!
//! Every row is rendered at its own time and light is averaged over the exposure, both in steps of 1/480 s.

use crate::camera::Camera;
use crate::capture::{HELD_OUT, bundled_folder, jpeg, rig_of};
use crate::files::write_file;
use crate::long::size;
use crate::picture::{light, shade};
use crate::raster::{Visibility, rasterize};
use crate::scene::{FPS, Frame, Stage};
use crate::texture::srgb_from_linear;
use crate::truth;
use crate::vector::{V3, sin_cos};
use anyhow::{Context, Result, bail};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

const CAMERAS: usize = 20;
/// Focal length, image widths; gives 67° across.
const FOCAL: f64 = 0.75;
/// Steps of the film in a frame: 1/480 s each.
const STEPS: i64 = 16;
/// Frames that are filmed, of the scene's thirty: the first and the last have light from before and after.
const TAKEN: i64 = 28;
/// Seconds from the first row to the last: a telephone's.
const READOUT: f64 = 0.03;
/// Seconds of exposure, a whole even number of steps.
const EXPOSURE: f64 = 1.0 / 40.0;
/// Automatic exposure: share by which the light changes, rounds in a second, and their difference between channels.
const DRIFT: [f64; 3] = [0.25, 0.6, 0.06];

/// Light at the squared radius r, 1 in the corners: 1 + k1 r + k2 r² + k3 r³, as `vignetting` of `capture.json`. A fast
/// wide-angle lens, wide open.
const VIGNETTING: [f64; 3] = [-0.35, -0.2, 0.1];

/// Which faults cameras have.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Faults {
    rolling: bool,
    blur: bool,
    drift: bool,
    vignetting: bool,
}

impl Faults {
    fn read(text: &str) -> Result<Self> {
        let mut all = Self::default();
        for word in text.split(',') {
            match word {
                "none" => {}
                "rolling" => all.rolling = true,
                "blur" => all.blur = true,
                "drift" => all.drift = true,
                "vignetting" => all.vignetting = true,
                _ => bail!(
                    "unknown fault `{word}`: none, rolling, blur, drift and vignetting are possible, joined by commas"
                ),
            }
        }
        Ok(all)
    }

    /// Steps from the middle of frame 0 to the middle of a row's exposure.
    fn row(self, row: usize, height: usize) -> i64 {
        let share = (row as f64 + 0.5) / height as f64 - 0.5;
        if self.rolling { (share * READOUT * FPS * STEPS as f64).round() as i64 } else { 0 }
    }

    /// Steps of exposure before and after its middle.
    fn reach(self) -> i64 {
        if self.blur { (0.5 * EXPOSURE * FPS * STEPS as f64).round() as i64 } else { 0 }
    }

    /// Share of a row's light that comes from the step `off` after its middle: a box.
    fn weight(self, off: i64) -> f64 {
        match self.reach() {
            0 => f64::from(u8::from(off == 0)),
            reach if off.abs() > reach => 0.0,
            reach => (if off.abs() == reach { 0.5 } else { 1.0 }) / (2 * reach) as f64,
        }
    }

    /// The rows of frame `n` that have light from a step.
    fn rows(self, n: i64, step: i64, height: usize) -> Range<usize> {
        let lit = |&row: &usize| self.weight(step - n * STEPS - self.row(row, height)) > 0.0;
        let first = (0..height).find(lit);
        first.map_or(0..0, |first| first..(0..height).rev().find(lit).map_or(first, |last| last + 1))
    }

    /// Share of light that a pixel of an image of this size receives.
    fn light(self, pixel: usize, [width, height]: [usize; 2]) -> f64 {
        let (w, h) = (width as f64, height as f64);
        let (x, y) = ((pixel % width) as f64 + 0.5 - 0.5 * w, (pixel / width) as f64 + 0.5 - 0.5 * h);
        let r2 = 4.0 * (x * x + y * y) / (w * w + h * h);
        let [k1, k2, k3] = VIGNETTING;
        if self.vignetting { 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)) } else { 1.0 }
    }

    /// Factors of the light of frame `n` of a camera.
    fn gains(self, camera: usize, n: i64) -> [f64; 3] {
        let [most, rounds, apart] = DRIFT;
        std::array::from_fn(|c| {
            let turns = rounds * n as f64 / FPS + 0.3 * camera as f64 + apart * c as f64;
            let sine = sin_cos(2.0 * std::f64::consts::PI * (turns - turns.floor())).0;
            if self.drift { 1.0 + most * sine } else { 1.0 }
        })
    }
}

/// `FAULTS FOLDER [--size WxH]`.
pub(crate) fn command(faults: &str, folder: &Path, options: &[String]) -> Result<()> {
    let faults = Faults::read(faults)?;
    let [width, height] = match options {
        [] => [200, 150],
        [flag, value] if flag == "--size" => size(value)?,
        _ => bail!("the only option is --size WxH"),
    };
    let stage = Stage::load(&bundled_folder().join("characters"))?;
    let cameras = rig_of(CAMERAS, [width, height], FOCAL * width as f64);
    let of_camera = |c: usize| if HELD_OUT.contains(&c) { Faults::default() } else { faults };
    // By camera and frame: light of all pixels so far.
    let mut open: Vec<BTreeMap<i64, Vec<V3>>> = vec![BTreeMap::new(); CAMERAS];
    let early = faults.reach() - faults.row(0, height);
    for step in -early..=(TAKEN - 1) * STEPS + early {
        let lit = |c: usize, n: i64| of_camera(c).rows(n, step, height);
        if (0..CAMERAS).all(|c| (0..TAKEN).all(|n| lit(c, n).is_empty())) {
            continue;
        }
        let frame = stage.frame_at(1.0 + step as f64 / STEPS as f64)?;
        open.par_iter_mut().enumerate().try_for_each(|(c, open)| -> Result<()> {
            let (camera, faults) = (&cameras[c], of_camera(c));
            let frames: Vec<(i64, Range<usize>)> =
                (0..TAKEN).map(|n| (n, lit(c, n))).filter(|(_, rows)| !rows.is_empty()).collect();
            if frames.is_empty() {
                return Ok(());
            }
            let seen = rasterize(&frame.mesh, camera);
            for (n, rows) in frames {
                let image = open.entry(n).or_insert_with(|| vec![V3::default(); width * height]);
                let first = rows.start;
                for (k, color) in light(stage.textures(), &frame, camera, &seen, rows).into_iter().enumerate() {
                    let (row, pixel) = (first + k / width, first * width + k);
                    let weight = faults.weight(step - n * STEPS - faults.row(row, height));
                    image[pixel] = image[pixel] + color * weight;
                }
            }
            // Frames whose last light this was.
            let last = faults.reach() + faults.row(height - 1, height);
            while let Some(n) = open.first_key_value().map(|(n, _)| *n).filter(|n| n * STEPS + last <= step) {
                let gains = faults.gains(c, n);
                let image = open.remove(&n).context("the frame was there")?;
                let code = |(pixel, color): (usize, &V3)| {
                    let light = faults.light(pixel, [width, height]);
                    std::array::from_fn::<u8, 3, _>(|k| srgb_from_linear(color.array()[k] * gains[k] * light))
                };
                let rgb: Vec<u8> = image.iter().enumerate().flat_map(code).collect();
                write_file(&folder.join(format!("images/{}/{n:04}.jpg", camera.name)), &jpeg(&rgb, width, height)?)?;
            }
            Ok(())
        })?;
    }
    write_points(&stage, &stage.frame_at(1.0)?, &cameras, folder)?;
    let entry = |(c, camera): (usize, &Camera)| entry(camera, of_camera(c));
    let capture = json!({
        "version": 1, "name": "film", "fps": FPS, "frames": TAKEN, "up": [0, 1, 0], "points": "points.ply",
        "hold_out": {"cameras": HELD_OUT.map(|c| cameras[c].name.clone())},
        "cameras": cameras.iter().enumerate().map(entry).collect::<Vec<_>>(),
    });
    // Last: a folder without it is not yet a capture.
    write_file(&folder.join("capture.json"), (serde_json::to_string_pretty(&capture)? + "\n").as_bytes())
}

fn entry(camera: &Camera, faults: Faults) -> Value {
    let mut entry = json!({
        "name": camera.name, "width": camera.width, "height": camera.height,
        "fx": camera.focal, "fy": camera.focal,
        "cx": 0.5 * camera.width as f64, "cy": 0.5 * camera.height as f64,
        "world_to_camera": camera.matrix(), "images": format!("images/{}/%04d.jpg", camera.name),
    });
    if faults.rolling {
        entry["readout"] = json!(READOUT);
    }
    if faults.blur {
        entry["exposure_time"] = json!(EXPOSURE);
    }
    if faults.vignetting {
        entry["vignetting"] = json!(VIGNETTING);
    }
    entry
}

fn write_points(stage: &Stage, frame: &Frame, cameras: &[Camera], folder: &Path) -> Result<()> {
    let training: Vec<&Camera> =
        cameras.iter().enumerate().filter(|(c, _)| !HELD_OUT.contains(c)).map(|(_, camera)| camera).collect();
    let look = |camera: &&Camera| -> (Visibility, Vec<u8>) {
        let seen = rasterize(&frame.mesh, camera);
        let rgb = shade(stage.textures(), frame, camera, &seen).rgb;
        (seen, rgb)
    };
    let seen: Vec<_> = training.par_iter().map(look).collect();
    let training: Vec<_> = training.iter().zip(&seen).map(|(c, (seen, rgb))| (*c, seen, rgb.as_slice())).collect();
    write_file(&folder.join("points.ply"), &truth::ply(&truth::sparse_cloud(frame, &training, truth::CLOUD)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_has_all_its_light_at_its_own_time() {
        for text in ["none", "rolling", "blur", "rolling,blur,drift"] {
            let faults = Faults::read(text).unwrap();
            let height = 150;
            for row in [0, 60, 149] {
                let steps = -40..40;
                let middle = faults.row(row, height);
                let all: f64 = steps.clone().map(|s| faults.weight(s - middle)).sum();
                assert!((all - 1.0).abs() < 1e-12, "{text}: {all}");
                let lit = steps.filter(|&s| faults.rows(0, s, height).contains(&row)).count() as i64;
                assert_eq!(lit, 2 * faults.reach() + 1, "{text}, row {row}");
            }
        }
        let lens = Faults::read("vignetting").unwrap();
        let corner = lens.light(0, [200, 150]);
        assert!(corner < 0.57 && lens.light(75 * 200 + 100, [200, 150]) > 0.999, "{corner}");
        assert_eq!(Faults::default().light(0, [200, 150]), 1.0);
        assert_eq!(Faults::read("rolling").unwrap().row(149, 150), 7, "half of 30 ms in steps of 1/480 s");
        assert!(Faults::read("rain").unwrap_err().to_string().contains("rolling"));
    }
}
