//! Synthetic captures: a small world of textured objects, each hard for one reason, written with exact poses as
//! `capture.json` folders. The same name gives the same bytes on every machine.

mod scenes;
mod world;

pub(crate) use scenes::NAMES;
use scenes::{Scene, Viewer, scene};

use anyhow::Context;
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use rayon::prelude::*;
use serde_json::{Value, json};
use splat4d::Error;
use splat4d::math::Rng;
use splat4d::math::se3::{dot, norm, sub};
use splat4d_workflow::files;
use std::path::Path;
use world::{Pinhole, V3};

/// The generator's version: drawings of another are rendered again.
pub(crate) const VERSION: usize = 2;
/// Codes of depth a world unit, in images of 16 bits: depths to 16 units.
const DEPTH_CODES: f64 = 4096.0;
/// Codes of flow a pixel, and the code of none (KITTI 2012).
const FLOW_CODES: f64 = 64.0;
const FLOW_ZERO: f64 = 32768.0;
/// Seed of the points.
const SEED: u64 = 18;
/// Cosine of the least angle between two rays to a point: COLMAP keeps no point below 1.5°.
const PARALLAX: f64 = 0.999_657;
/// A point counts as seen if the depth at its pixel is smaller by at most this share.
const SEEN: f64 = 0.01;
/// Error of a point along each axis, pixels at its distance, at most: as from good structure from motion.
const NOISE: f64 = 0.5;

/// Renders a synthetic capture into a folder. `capture.json` is written last: where it is, all is.
///
/// Errors: there is none of this name; files that cannot be written.
pub(crate) fn write(name: &str, folder: &Path) -> anyhow::Result<()> {
    let scene = scene(name).ok_or_else(|| unknown(name))?;
    let views: Vec<(usize, usize)> =
        (0..scene.viewers.len()).flat_map(|c| (0..scene.moments).map(move |m| (c, m))).collect();
    for c in 0..scene.viewers.len() {
        files::make_folder(&folder.join(images(c)))?;
    }
    views.par_iter().try_for_each(|&(c, m)| -> anyhow::Result<()> {
        let viewer = &scene.viewers[c];
        let pixels = viewer.at(m).picture(&scene.world, share(m, scene.moments), viewer.gain);
        let [width, height] = viewer.at(m).size.map(|s| s as u32);
        let mut png = Vec::new();
        PngEncoder::new(&mut png).write_image(&pixels, width, height, ExtendedColorType::Rgb8)?;
        Ok(files::write(&folder.join(images(c)).join(format!("{m:04}.png")), &png)?)
    })?;
    if scene.truth {
        write_truth(&scene, folder)?;
    }
    files::write(&folder.join("points.ply"), &ply(&cloud(&scene), scene.units))?;
    let text = serde_json::to_string_pretty(&description(name, &scene)).context("plain data is JSON")?;
    Ok(files::write(&folder.join("capture.json"), (text + "\n").as_bytes())?)
}

/// Depth and flow of the images to train on. Flow is in `truth/`: it is measured with, not listed.
fn write_truth(scene: &Scene, folder: &Path) -> anyhow::Result<()> {
    let training = scene.viewers.iter().enumerate().filter(|(_, v)| !v.held);
    for (c, viewer) in training {
        let [depths, flows] = [depth_maps(c), format!("truth/flow/cam{c:02}")].map(|name| folder.join(name));
        files::make_folder(&depths)?;
        files::make_folder(&flows)?;
        (0..scene.moments).into_par_iter().try_for_each(|m| -> anyhow::Result<()> {
            let (camera, at) = (viewer.at(m), share(m, scene.moments));
            let save = |path: std::path::PathBuf, codes: Vec<u16>, color: ExtendedColorType| -> anyhow::Result<()> {
                let bytes: Vec<u8> = codes.iter().flat_map(|c| c.to_ne_bytes()).collect();
                let [width, height] = camera.size.map(|s| s as u32);
                let mut png = Vec::new();
                PngEncoder::new(&mut png).write_image(&bytes, width, height, color)?;
                Ok(files::write(&path, &png)?)
            };
            let codes = camera.depth(&scene.world, at).iter().map(|z| (z * DEPTH_CODES).round() as u16).collect();
            save(depths.join(format!("{m:04}.png")), codes, ExtendedColorType::L16)?;
            if m + 1 == scene.moments {
                return Ok(());
            }
            let ways = camera.flow(&scene.world, [at, share(m + 1, scene.moments)], viewer.at(m + 1));
            let code = |v: f64| (v * FLOW_CODES + FLOW_ZERO).round() as u16;
            let codes = ways.iter().flat_map(|w| w.map_or([0; 3], |[u, v]| [code(u), code(v), 1])).collect();
            save(flows.join(format!("{m:04}.png")), codes, ExtendedColorType::Rgb16)
        })?;
    }
    Ok(())
}

/// The error of a name that nothing has.
pub(crate) fn unknown(name: &str) -> Error {
    let names: Vec<&str> = NAMES.iter().map(|n| n.0).collect();
    Error::input(format!("there is no synthetic capture `{name}`")).remedy(format!("Use one of: {}", names.join(", ")))
}

fn images(camera: usize) -> String {
    format!("images/cam{camera:02}")
}

fn depth_maps(camera: usize) -> String {
    format!("depth/cam{camera:02}")
}

/// The share of the capture at a time.
fn share(moment: usize, moments: usize) -> f64 {
    moment as f64 / (moments.max(2) - 1) as f64
}

fn description(name: &str, scene: &Scene) -> Value {
    let matrix = |camera: &Pinhole, wrong: f64| {
        let pose = camera.turned(wrong).cam_from_world;
        let row = |k: usize| {
            let [x, y, z] = pose.rotation[k];
            [x, y, z, pose.translation[k] * scene.units]
        };
        [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
    };
    let camera = |(c, viewer): (usize, &Viewer)| {
        let first = viewer.at(0);
        let poses: Vec<_> = viewer.poses.iter().map(|p| matrix(p, viewer.wrong)).collect();
        let mut entry = json!({
            "name": format!("cam{c:02}"), "width": first.size[0], "height": first.size[1],
            "fx": first.focal, "fy": first.focal,
            "cx": 0.5 * first.size[0] as f64, "cy": 0.5 * first.size[1] as f64,
            "world_to_camera": if poses.len() == 1 { json!(poses[0]) } else { json!(poses) },
            "images": format!("{}/%04d.png", images(c)), "frames": scene.moments,
        });
        if scene.truth && !viewer.held {
            entry["depth"] = json!(format!("{}/%04d.png", depth_maps(c)));
            entry["depth_scale"] = json!(scene.units / DEPTH_CODES);
        }
        entry
    };
    let held: Vec<String> =
        scene.viewers.iter().enumerate().filter(|(_, v)| v.held).map(|(c, _)| format!("cam{c:02}")).collect();
    let mut capture = json!({
        "version": 1, "name": name, "fps": scene.fps, "up": [0, 1, 0], "points": "points.ply",
        "cameras": scene.viewers.iter().enumerate().map(camera).collect::<Vec<_>>(),
    });
    if !held.is_empty() {
        capture["hold_out"] = json!({ "cameras": held });
    }
    capture
}

/// A coloured point, in the world's units.
type Point = (V3, [u8; 3]);

/// A sparse cloud as structure from motion would find it: random pixels of the training images of the first time (of a
/// moving camera: of all times), kept where a second training image sees the point from a different direction.
fn cloud(scene: &Scene) -> Vec<Point> {
    let training = scene.viewers.iter().filter(|v| !v.held);
    let views: Vec<(&Pinhole, usize)> =
        training.flat_map(|v| v.poses.iter().enumerate().map(|(m, pose)| (pose, m))).collect();
    let mut points = Vec::with_capacity(scene.points);
    for draw in 0.. {
        if points.len() == scene.points {
            break;
        }
        let rng = Rng::new(SEED, "points", draw);
        let (camera, moment) = views[rng.below(0, views.len())];
        let place = [rng.uniform(1) * camera.size[0] as f64, rng.uniform(2) * camera.size[1] as f64];
        let (eye, ray) = (camera.center(), camera.ray(place));
        let Some(seen) = scene.world.cast(eye, ray, share(moment, scene.moments)) else { continue };
        let moves = scene.world.things[seen.thing].moves;
        if moves && !scene.moving_points {
            continue;
        }
        let confirms = |&(other, at): &(&Pinhole, usize)| {
            let to = sub(seen.point, other.center());
            let far = norm(to);
            let sight = to.map(|x| x / far);
            let there = || {
                let own = scene.world.cast(other.center(), sight, share(at, scene.moments));
                own.is_some_and(|s| norm(sub(s.point, other.center())) > far * (1.0 - SEEN))
            };
            dot(sight, ray) < PARALLAX && other.project(seen.point).is_some() && there()
        };
        if views.iter().any(confirms) {
            let error = 2.0 * NOISE * norm(sub(seen.point, eye)) / camera.focal;
            let point = std::array::from_fn(|k| seen.point[k] + error * (rng.uniform(3 + k as u64) - 0.5));
            points.push((point, seen.color.map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8)));
        }
    }
    points
}

/// A binary little-endian .ply file.
fn ply(points: &[Point], units: f64) -> Vec<u8> {
    let mut out = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty double x\nproperty double y\n\
         property double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        points.len()
    )
    .into_bytes();
    for (point, color) in points {
        point.iter().for_each(|x| out.extend((x * units).to_le_bytes()));
        out.extend(color);
    }
    out
}

/// `studies make`: one of the synthetic captures.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Its name
    #[arg(value_name = "NAME", value_parser = NAMES.map(|n| n.0))]
    name: String,
    /// Where it is written
    #[arg(value_name = "FOLDER")]
    folder: std::path::PathBuf,
}

const EXAMPLES: &str = "\
Examples:
  studies make one-wall runs/one-wall      then: splat4d train runs/one-wall

Every capture is the same bytes on every machine. What is hard about each is in docs/suite.md.";

pub(crate) fn run(args: &Args, console: &splat4d_cli::console::Console) -> anyhow::Result<()> {
    write(&args.name, &args.folder)?;
    console.written(&args.folder.join("capture.json"));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d_train::capture::{Capture, CaptureOptions};

    #[test]
    fn captures_open_and_have_the_views_they_claim() {
        for (name, [cameras, pictures, held]) in [("one-wall", [12, 12, 2]), ("hand-held-12", [2, 24, 12])] {
            let folder = tempfile::tempdir().unwrap();
            write(name, folder.path()).unwrap();
            let capture = Capture::open(folder.path(), &CaptureOptions::default()).unwrap();
            let found = [capture.cameras.len(), capture.frames.len(), capture.held.len()];
            assert_eq!(found, [cameras, pictures, held], "{name}");
            assert!(capture.warnings.is_empty(), "{name}: {:?}", capture.warnings);
            assert!(capture.held.iter().all(|&i| capture.cameras[capture.frames[i].camera].fixed), "{name}");
        }
        assert!(write("two-walls", Path::new("nowhere")).unwrap_err().to_string().contains("one-wall"));
    }

    /// Content of every capture, without rendering it whole: a small image, the points and the description.
    fn print_of(name: &str) -> String {
        let scene = scene(name).unwrap();
        let (viewer, moment) = (&scene.viewers[scene.viewers.len() - 1], scene.moments / 2);
        let own = viewer.at(moment);
        let small = Pinhole { focal: own.focal / 8.0, size: own.size.map(|s| s / 8), ..*own };
        let picture = small.picture(&scene.world, share(moment, scene.moments), viewer.gain);
        let text = description(name, &scene).to_string();
        files::fingerprint([picture, ply(&cloud(&scene), scene.units), text.into_bytes()].concat())
    }

    #[test]
    fn the_same_bytes_on_every_machine() {
        let all: Vec<String> = NAMES.iter().map(|(name, _)| format!("{name} {}", print_of(name))).collect();
        // A change of what is rendered must also change `VERSION`, so that old drawings are not taken for new ones.
        assert_eq!((VERSION, all.join("\n")), (2, PRINTS.trim().to_owned()));
    }

    /// Fingerprints of generator 2.
    const PRINTS: &str = "
far-background deebced9dfeb6476
one-wall 3c89f7f931ce9c1a
tiny-units a5dc7b40e90d3936
huge-units e4393bcd72acf284
four-cameras b0c9f77278966b36
sixty-cameras 45930a32964d536d
exposure 4edd42ad01c5aa3d
wrong-pose a0e1b117bce0f933
enters 2d82685c499b5684
hand-held-12 347924cf4e2fc032
hand-held-60 36359dac295000bb
walk-60 d04f76c1a4540cdd
walk-300 32230e76cd1ad421
";

    #[test]
    fn a_point_has_its_texture_s_colour_in_every_camera_that_sees_it() {
        let scene = scene("hand-held-12").unwrap();
        let (path, fixed) = (&scene.viewers[0], &scene.viewers[1]);
        let (mut compared, mut off) = (0, 0.0);
        for moment in [0, 5, 11] {
            let at = share(moment, scene.moments);
            let pictures = [path, fixed].map(|v| v.at(moment).picture(&scene.world, at, 1.0));
            for draw in 0..200 {
                let rng = Rng::new(1, "test", draw);
                let place = [rng.uniform(0) * 160.0, rng.uniform(1) * 120.0];
                let seen = scene.world.cast(path.at(moment).center(), path.at(moment).ray(place), at).unwrap();
                let Some([x, y]) = fixed.at(moment).project(seen.point) else { continue };
                let eye = fixed.at(moment).center();
                let to = sub(seen.point, eye);
                let sight = to.map(|v| v / norm(to));
                let there = scene.world.cast(eye, sight, at).unwrap();
                if norm(sub(there.point, seen.point)) > 1e-6 {
                    continue; // something is before it
                }
                let pixel = |picture: &[u8], [x, y]: [f64; 2]| -> V3 {
                    std::array::from_fn(|k| f64::from(picture[3 * (y as usize * 160 + x as usize) + k]) / 255.0)
                };
                for pixel in [pixel(&pictures[0], place), pixel(&pictures[1], [x, y])] {
                    off += norm(sub(pixel, seen.color));
                    compared += 1;
                }
            }
        }
        // A pixel is the mean over its own square, which matters at the textures' edges. The colours of positions that
        // have nothing to do with each other differ by 0.3.
        let mean = off / f64::from(compared);
        assert!(mean < 0.04, "{mean}");
        assert!(compared > 200, "{compared} places are seen by both");
    }

    #[test]
    fn every_capture_is_hard_for_the_reason_it_is_named_for() {
        let of = |name: &str| scene(name).unwrap();
        let training = |s: &Scene| s.viewers.iter().filter(|v| !v.held).count();
        assert_eq!(["four-cameras", "sixty-cameras"].map(|n| training(&of(n))), [4, 56]);
        assert_eq!(["hand-held-12", "hand-held-60"].map(|n| of(n).viewers[0].poses.len()), [12, 60]);
        let gains: f64 = of("exposure").viewers.iter().map(|v| v.gain).product();
        assert!((gains - 1.0).abs() < 1e-12);
        let wrong = of("wrong-pose");
        let turned: Vec<&Viewer> = wrong.viewers.iter().filter(|v| v.wrong != 0.0).collect();
        let [camera] = turned[..] else { panic!("one camera is turned") };
        let (own, stated) = (camera.at(0), camera.at(0).turned(camera.wrong));
        let angle = dot(own.cam_from_world.rotation[2], stated.cam_from_world.rotation[2]).acos().to_degrees();
        assert!((angle - 3.0).abs() < 1e-9 && norm(sub(own.center(), stated.center())) < 1e-12);
        assert!(stated.cam_from_world.orthogonality_error() < 1e-12 && !camera.held);
        // The entering object is in no image of the first half, and in all of the last.
        let enters = of("enters");
        let number = enters.world.things.len() - 1;
        let shown = |viewer: &Viewer, moment: usize| {
            let at = share(moment, enters.moments);
            let camera = viewer.at(moment);
            let sees = |x: usize, y: usize| {
                let seen = enters.world.cast(camera.center(), camera.ray([x as f64, y as f64]), at);
                seen.is_some_and(|s| s.thing == number)
            };
            (0..160).step_by(4).any(|x| (0..120).step_by(4).any(|y| sees(x, y)))
        };
        assert!(enters.viewers.iter().all(|v| (0..5).all(|m| !shown(v, m)) && shown(v, 9)));
        // Tiny and huge are one room.
        let places = |name: &str, units: f64| {
            let all = description("", &of(name));
            let rows = all["cameras"][3]["world_to_camera"].clone();
            [0, 1, 2].map(|k| rows[k][3].as_f64().unwrap() / units)
        };
        let (tiny, huge) = (places("tiny-units", 1e-3), places("huge-units", 1e3));
        assert!((0..3).all(|k| (tiny[k] - huge[k]).abs() < 1e-9));
        assert!(cloud(&of("hand-held-12")).len() == 500);
    }
}
