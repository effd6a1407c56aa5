//! `capture --photos VIEWS FOLDER [--size WxH]`: the drum of the yard as someone photographs it who walks around it three times.

use crate::camera::Camera;
use crate::capture::{bundled_folder, jpeg};
use crate::files::write_file;
use crate::long;
use crate::mesh::Mesh;
use crate::picture::shade;
use crate::raster::rasterize;
use crate::scene::{FPS, Stage};
use crate::truth::{self, Cloud};
use crate::vector::{hash01, sin_cos, v3};
use crate::yard_materials::DRUM;
use anyhow::{Context, Result, bail, ensure};
use rayon::prelude::*;
use serde_json::json;
use std::f64::consts::TAU;
use std::path::Path;

/// `--photos VIEWS FOLDER [--size WxH]`.
pub(crate) fn command(views: &str, folder: &Path, options: &[String]) -> Result<()> {
    /// Every how many photos one is held out.
    const HOLD_EVERY: usize = 8;
    /// Points per photo and their noise, scene units, as structure from motion has them of many near photos: 12,602 of 119
    /// photos of an object, below a pixel.
    const POINTS: usize = 100;
    const NOISE: f64 = 0.001;
    let views: usize = views.parse().with_context(|| format!("invalid number of photos `{views}`"))?;
    ensure!((8..=9999).contains(&views), "give 8 to 9999 photos");
    let [width, height] = match options {
        [] => [912, 912],
        [flag, size] if flag == "--size" => long::size(size)?,
        _ => bail!("--photos takes a number, a folder and --size WxH"),
    };
    let stage = Stage::yard(&bundled_folder().join("characters"))?;
    let frame = stage.with(&Mesh::default(), vec![DRUM]);
    let cameras = walk(views, [width, height]);
    let draw = |(i, camera): (usize, &Camera)| -> Result<_> {
        let seen = rasterize(&frame.mesh, camera);
        let rgb = shade(stage.textures(), &frame, camera, &seen).rgb;
        write_file(&folder.join(photo(i)), &jpeg(&rgb, width, height)?)?;
        // Visibility is large; of the photos that points are taken from, every eighth is enough.
        Ok((i % HOLD_EVERY == 1).then_some((seen, rgb)))
    };
    let seen = cameras.par_iter().enumerate().map(draw).collect::<Result<Vec<_>>>()?;
    let training = cameras.iter().zip(&seen).filter_map(|(camera, s)| s.as_ref().map(|(v, rgb)| (camera, v, &rgb[..])));
    let cloud = Cloud { count: POINTS * views, noise: NOISE };
    let cloud = truth::sparse_cloud(&frame, &training.collect::<Vec<_>>(), cloud);
    write_file(&folder.join("points.ply"), &truth::ply(&cloud))?;
    let entry = |(i, camera): (usize, &Camera)| {
        json!({
            "name": camera.name, "width": width, "height": height, "fx": camera.focal, "fy": camera.focal,
            "cx": 0.5 * width as f64, "cy": 0.5 * height as f64,
            "world_to_camera": camera.matrix(), "images": [photo(i)],
        })
    };
    let capture = json!({
        "version": 1, "name": "drum", "fps": FPS, "up": [0, 1, 0], "points": "points.ply",
        "hold_out": {"every": HOLD_EVERY},
        "cameras": cameras.iter().enumerate().map(entry).collect::<Vec<_>>(),
    });
    write_file(&folder.join("capture.json"), (serde_json::to_string_pretty(&capture)? + "\n").as_bytes())
}

fn photo(i: usize) -> String {
    format!("images/{i:04}.jpg")
}

/// Cameras on a way around the drum, three times with other heights and distances, by hand: neither exactly level nor
/// aimed at its middle.
fn walk(views: usize, [width, height]: [usize; 2]) -> Vec<Camera> {
    let camera = |i: usize| {
        let share = i as f64 / views as f64;
        let lap = (3.0 * share).floor();
        let (sin, cos) = sin_cos(TAU * (3.0 * share - lap));
        let random = |k: i64| hash01(i as i64, 100 + k) - 0.5;
        let distance = [1.9, 1.5, 2.3][lap as usize] + 0.2 * random(0);
        let up = [1.5, 0.7, 2.2][lap as usize] + 0.15 * random(1);
        let target = DRUM + v3(0.15 * random(2), 0.55 + 0.15 * random(3), 0.15 * random(4));
        let position = v3(DRUM.x + distance * sin, up, DRUM.z + distance * cos);
        Camera::look_at(format!("photo{i:04}"), position, target, 1.1 * width.max(height) as f64, width, height)
    };
    (0..views).map(camera).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vector::V3;
    use crate::yard_materials::GLAZE;

    #[test]
    fn photos_show_relief_sky_and_gloss() {
        let stage = Stage::yard(&bundled_folder().join("characters")).unwrap();
        let frame = stage.with(&Mesh::default(), vec![DRUM]);
        let cameras = walk(24, [48, 48]);
        let draw = |camera: &Camera| shade(stage.textures(), &frame, camera, &rasterize(&frame.mesh, camera)).rgb;
        let rgb = draw(&cameras[0]);
        let middle: Vec<u8> =
            (16..32).flat_map(|y| (16..32).map(move |x| (y, x))).map(|(y, x)| rgb[3 * (48 * y + x)]).collect();
        let (low, high) = (middle.iter().min().unwrap(), middle.iter().max().unwrap());
        assert!(high - low > 60, "the drum has relief: {low} to {high}");
        assert!((0..6).all(|i| draw(&cameras[4 * i]).iter().any(|c| *c > 40)), "no photo is dark");
        // The jar's mirror image moves with the camera; a matt surface would not change.
        let jar = v3(3.0, 0.5, 0.7);
        let at = |x: f64| {
            let camera = Camera::look_at("a".into(), v3(x, 1.2, 3.6), jar, 60.0, 9, 9);
            let seen = rasterize(&frame.mesh, &camera);
            let (index, weights, _) = crate::picture::surface(&frame, &camera, &seen, 4, 4).unwrap();
            (frame.mesh.triangles[index as usize].material, weights)
        };
        assert_eq!((at(2.0).0, at(4.0).0), (GLAZE, GLAZE));
        let view = |towards: V3| frame.light.mirrored(jar, v3(0.0, 0.0, 1.0), towards.unit(), 0.06);
        assert_ne!(view(v3(0.0, 0.2, 1.0)), view(v3(0.9, 0.2, 0.3)));
    }
}
