//! `capture --long SECONDS FOLDER`: the hall with both characters for as long as one likes, filmed by twenty cameras.
//! Every part circulates at a pace of its own, so that no two times are alike; one frame is in memory at a time.

use crate::camera::Camera;
use crate::capture::{CAMERAS, HELD_OUT, bundled_folder, jpeg, rig_of};
use crate::files::write_file;
use crate::material::{BALL, KNIGHT, MAGE};
use crate::mesh::Mesh;
use crate::picture::shade;
use crate::raster::{Visibility, rasterize};
use crate::scene::{FPS, Frame, Stage};
use crate::skin::Character;
use crate::truth;
use crate::vector::{Affine, V3, heading, sin_cos, smooth_step, v3};
use anyhow::{Context, Result, ensure};
use rayon::prelude::*;
use serde_json::json;
use std::path::Path;

const WIDTH: usize = 200;
const HEIGHT: usize = 150;
/// Pixels; gives 67° across.
const FOCAL: f64 = 150.0;
/// Most seconds: file names have six digits.
const MAX_SECONDS: f64 = 999_999.0 / FPS;
/// Seconds of one round of: the knight's way across and along, his blows, the mage's way across and along, the ball's
/// circle and its bounces. No two are in a simple ratio.
const ROUNDS: [f64; 7] = [5.3, 4.1, 3.7, 6.7, 8.9, 3.1, 0.62];
const BALL_RADIUS: f64 = 0.34;
/// Height of a bounce, scene units.
const BOUNCE: f64 = 0.67;

/// `--long SECONDS FOLDER`.
pub(crate) fn command(seconds: &str, folder: &Path) -> Result<()> {
    let length: f64 = seconds.parse().with_context(|| format!("invalid seconds `{seconds}`"))?;
    ensure!(length * FPS >= 1.0 && length <= MAX_SECONDS, "give seconds from {:.3} to {MAX_SECONDS:.0}", 1.0 / FPS);
    let frames = (length * FPS).round() as usize;
    let stage = Stage::load(&bundled_folder().join("characters"))?;
    let cameras = rig_of(WIDTH, HEIGHT, FOCAL);
    for t in 0..frames {
        let frame = at(&stage, t as f64 / FPS)?;
        cameras.par_iter().try_for_each(|camera| -> Result<()> {
            let rgb = shade(stage.textures(), &frame, camera, &rasterize(&frame.mesh, camera)).rgb;
            write_file(&folder.join(format!("images/{}/{t:06}.jpg", camera.name)), &jpeg(&rgb, WIDTH, HEIGHT)?)
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
    let training = (0..CAMERAS).filter(|c| !HELD_OUT.contains(c));
    let training: Vec<_> = training.map(|c| (&cameras[c], &seen[c].0, seen[c].1.as_slice())).collect();
    write_file(&folder.join("points.ply"), &truth::ply(&truth::sparse_cloud(&hall, &training)))?;
    let entry = |camera: &Camera| {
        json!({
            "name": camera.name, "width": WIDTH, "height": HEIGHT,
            "fx": camera.focal, "fy": camera.focal, "cx": 0.5 * WIDTH as f64, "cy": 0.5 * HEIGHT as f64,
            "world_to_camera": camera.matrix(), "images": format!("images/{}/%06d.jpg", camera.name),
            "start": 0, "frames": frames,
        })
    };
    let capture = json!({
        "version": 1, "name": "long", "fps": FPS, "up": [0, 1, 0], "points": "points.ply",
        "hold_out": {"cameras": HELD_OUT.map(|c| cameras[c].name.clone())},
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
        command("0.07", folder.path()).unwrap();
        let text = std::fs::read_to_string(folder.path().join("capture.json")).unwrap();
        let capture: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!((capture["cameras"].as_array().unwrap().len(), &capture["cameras"][0]["frames"]), (20, &json!(2)));
        let picture = |t: usize| std::fs::read(folder.path().join(format!("images/cam08/{t:06}.jpg"))).unwrap();
        assert_ne!(picture(0), picture(1), "it moves");
        for bad in ["0", "-1", "NaN", "1e9", "ten"] {
            assert!(command(bad, folder.path()).is_err(), "{bad}");
        }
        for k in 0..400 {
            let p = knight_at(0.37 * f64::from(k));
            assert!(p.x.abs() < 2.0 && p.z.abs() < 1.3, "{:?}", p.array());
        }
    }
}
