//! `capture --long SECONDS FOLDER`: the hall with both characters for as long as one likes, filmed by any number of cameras
//! at any size. Every part circulates at a pace of its own, so that no two times are alike; one frame is in memory at a time.

use crate::camera::Camera;
use crate::capture::{self, HELD_OUT, bundled_folder, jpeg, rig_of};
use crate::files::write_file;
use crate::material::{BALL, KNIGHT, MAGE};
use crate::mesh::Mesh;
use crate::picture::shade;
use crate::raster::{Visibility, rasterize};
use crate::scene::{FPS, Frame, Stage};
use crate::skin::Character;
use crate::truth;
use crate::vector::{Affine, V3, heading, sin_cos, smooth_step, v3};
use anyhow::{Context, Result, bail, ensure};
use rayon::prelude::*;
use serde_json::json;
use std::path::Path;

/// Focal length, image widths; gives 67° across.
const FOCAL: f64 = 0.75;
/// Bounds of an image's sides, pixels.
const SIDES: std::ops::RangeInclusive<usize> = 16..=8192;
/// Fewest and most cameras: one of six is held out, and names have two digits.
const CAMERAS: std::ops::RangeInclusive<usize> = 6..=100;
/// Most seconds: file names have six digits.
const MAX_SECONDS: f64 = 999_999.0 / FPS;
/// Seconds of one round of: the knight's way across and along, his blows, the mage's way across and along, the ball's
/// circle and its bounces. No two are in a simple ratio.
const ROUNDS: [f64; 7] = [5.3, 4.1, 3.7, 6.7, 8.9, 3.1, 0.62];
const BALL_RADIUS: f64 = 0.34;
/// Height of a bounce, scene units.
const BOUNCE: f64 = 0.67;

/// What to film.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Wish {
    frames: usize,
    size: [usize; 2],
    cameras: usize,
    yard: bool,
}

impl Wish {
    /// `SECONDS FOLDER [--size WxH] [--cameras N] [--scene hall|yard]`, without the folder.
    fn read(seconds: &str, options: &[String]) -> Result<Self> {
        let length: f64 = seconds.parse().with_context(|| format!("invalid seconds `{seconds}`"))?;
        ensure!(length * FPS >= 1.0 && length <= MAX_SECONDS, "give seconds from {:.3} to {MAX_SECONDS:.0}", 1.0 / FPS);
        let mut wish =
            Self { frames: (length * FPS).round() as usize, size: [200, 150], cameras: capture::CAMERAS, yard: false };
        let mut rest = options.iter();
        while let Some(option) = rest.next() {
            let value = rest.next().with_context(|| format!("{option} needs a value"))?;
            match option.as_str() {
                "--size" => wish.size = size(value)?,
                "--scene" => match value.as_str() {
                    "hall" => wish.yard = false,
                    "yard" => wish.yard = true,
                    _ => bail!("there is no scene {value}: hall and yard are possible"),
                },
                "--cameras" => {
                    wish.cameras = value.parse().with_context(|| format!("invalid number of cameras `{value}`"))?;
                }
                _ => bail!("unknown option {option}: --size WxH, --cameras N and --scene NAME are possible"),
            }
        }
        ensure!(CAMERAS.contains(&wish.cameras), "give {CAMERAS:?} cameras");
        Ok(wish)
    }

    fn held_out(self, camera: usize) -> bool {
        HELD_OUT.contains(&(camera % capture::CAMERAS))
    }
}

/// The sides of `WxH`, pixels.
pub(crate) fn size(text: &str) -> Result<[usize; 2]> {
    let sides = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    let sides = sides.with_context(|| format!("invalid size `{text}`: give it as 1352x1014"))?;
    ensure!(sides.iter().all(|side| SIDES.contains(side)), "give sides of {SIDES:?} pixels");
    Ok(sides)
}

/// `--long SECONDS FOLDER [--size WxH] [--cameras N] [--scene hall|yard]`.
pub(crate) fn command(seconds: &str, folder: &Path, options: &[String]) -> Result<()> {
    let wish = Wish::read(seconds, options)?;
    let (frames, [width, height]) = (wish.frames, wish.size);
    let home = bundled_folder().join("characters");
    let stage = if wish.yard { Stage::yard(&home)? } else { Stage::load(&home)? };
    let cameras = rig_of(wish.cameras, [width, height], FOCAL * width as f64);
    for t in 0..frames {
        let frame = at(&stage, t as f64 / FPS)?;
        cameras.par_iter().try_for_each(|camera| -> Result<()> {
            let rgb = shade(stage.textures(), &frame, camera, &rasterize(&frame.mesh, camera)).rgb;
            write_file(&folder.join(format!("images/{}/{t:06}.jpg", camera.name)), &jpeg(&rgb, width, height)?)
        })?;
    }
    // Points of the static background: of a long take no time's characters are a useful start.
    let hall = stage.with(&Mesh::default(), Vec::new());
    let seen: Vec<(Visibility, Vec<u8>)> = (cameras.par_iter())
        .map(|camera| {
            let seen = rasterize(&hall.mesh, camera);
            let rgb = shade(stage.textures(), &hall, camera, &seen).rgb;
            (seen, rgb)
        })
        .collect();
    let training = (0..wish.cameras).filter(|&c| !wish.held_out(c));
    let training: Vec<_> = training.map(|c| (&cameras[c], &seen[c].0, seen[c].1.as_slice())).collect();
    write_file(&folder.join("points.ply"), &truth::ply(&truth::sparse_cloud(&hall, &training, truth::CLOUD)))?;
    let entry = |camera: &Camera| {
        json!({
            "name": camera.name, "width": width, "height": height,
            "fx": camera.focal, "fy": camera.focal, "cx": 0.5 * width as f64, "cy": 0.5 * height as f64,
            "world_to_camera": camera.matrix(), "images": format!("images/{}/%06d.jpg", camera.name),
            "start": 0, "frames": frames,
        })
    };
    let held = cameras.iter().enumerate().filter(|(c, _)| wish.held_out(*c));
    let capture = json!({
        "version": 1, "name": "long", "fps": FPS, "up": [0, 1, 0], "points": "points.ply",
        "hold_out": {"cameras": held.map(|(_, camera)| &camera.name).collect::<Vec<_>>()},
        "cameras": cameras.iter().map(entry).collect::<Vec<_>>(),
    });
    // Last: a folder without it is not yet a capture.
    write_file(&folder.join("capture.json"), (serde_json::to_string_pretty(&capture)? + "\n").as_bytes())
}

/// Sine and cosine of the angle of round `k`.
fn round(k: usize, seconds: f64) -> (f64, f64) {
    sin_cos(2.0 * std::f64::consts::PI * phase(k, seconds))
}

/// Finished share of round `k`, 0 to 1.
fn phase(k: usize, seconds: f64) -> f64 {
    let rounds = seconds / ROUNDS[k];
    rounds - rounds.floor()
}

fn knight_at(seconds: f64) -> V3 {
    v3(0.9 * round(0, seconds).0 - 0.9, 0.0, 0.8 * round(1, seconds).1 + 0.4)
}

/// The hall at a time.
fn at(stage: &Stage, seconds: f64) -> Result<Frame> {
    let mut moving = Mesh::default();
    let knight = knight_at(seconds);
    let ahead = knight_at(seconds + 1.0 / FPS);
    let run = stage.knight.sample("Running_A", seconds)?;
    let blow = stage.knight.sample("1H_Melee_Attack_Chop", phase(2, seconds) * ROUNDS[2])?;
    // A blow takes the first second of its round; the clips cross-fade at both ends.
    let strike = phase(2, seconds) * ROUNDS[2];
    let pose = Character::blend(&run, &blow, smooth_step(0.0, 0.2, strike) * (1.0 - smooth_step(0.8, 1.0, strike)));
    let way = Affine::standing(knight, heading(ahead.x - knight.x, ahead.z - knight.z));
    stage.knight.draw(&pose, &way, KNIGHT, 1, &mut moving);

    let mage = v3(1.5 + 0.35 * round(3, seconds).0, 0.0, 0.5 * round(4, seconds).1 - 0.6);
    let legs = stage.mage.sample("Walking_Backwards", 0.9 * seconds)?;
    let arms = stage.mage.sample("Spellcast_Long", seconds)?;
    let facing = Affine::standing(mage, heading(knight.x - mage.x, knight.z - mage.z));
    stage.mage.draw(&stage.mage.combine(&legs, &arms, "spine")?, &facing, MAGE, 2, &mut moving);

    let (sin, cos) = round(5, seconds);
    let (ground, rise) = (v3(0.7 + 0.9 * cos, 0.0, 1.9 + 0.5 * sin), phase(6, seconds));
    let ball = ground + v3(0.0, BALL_RADIUS + 4.0 * BOUNCE * rise * (1.0 - rise), 0.0);
    let spin = -2.0 * std::f64::consts::PI * phase(5, seconds);
    moving.ball(&Affine { origin: ball, ..Affine::standing(ball, spin) }, BALL_RADIUS, 24, BALL, 3);
    Ok(stage.with(&moving, vec![knight, mage, ground]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_capture_has_its_frames_and_moving_objects_stay_between_the_cameras() {
        let folder = tempfile::tempdir().unwrap();
        command("0.07", folder.path(), &[]).unwrap();
        let text = std::fs::read_to_string(folder.path().join("capture.json")).unwrap();
        let capture: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!((capture["cameras"].as_array().unwrap().len(), &capture["cameras"][0]["frames"]), (20, &json!(2)));
        let picture = |t: usize| std::fs::read(folder.path().join(format!("images/cam08/{t:06}.jpg"))).unwrap();
        assert_ne!(picture(0), picture(1), "it moves");
        for bad in ["0", "-1", "NaN", "1e9", "ten"] {
            assert!(command(bad, folder.path(), &[]).is_err(), "{bad}");
        }
        let options = |words: &str| words.split_whitespace().map(String::from).collect::<Vec<_>>();
        let wish = Wish::read("2", &options("--size 1352x1014 --cameras 12 --scene yard")).unwrap();
        assert_eq!(wish, Wish { frames: 60, size: [1352, 1014], cameras: 12, yard: true });
        let held: Vec<usize> = (0..20).filter(|&c| wish.held_out(c)).collect();
        assert_eq!(held, HELD_OUT, "as in the bundled capture");
        for bad in ["--size 12", "--size 4x4", "--cameras 2", "--cameras", "--fps 3", "--scene moon"] {
            assert!(Wish::read("2", &options(bad)).is_err(), "{bad}");
        }
        for k in 0..400 {
            let p = knight_at(0.37 * f64::from(k));
            assert!(p.x.abs() < 2.0 && p.z.abs() < 1.3, "{:?}", p.array());
        }
    }
}
