//! `capture --still`: a character frozen in one pose, seen from a hemisphere of cameras, cut out (RGBA); the same bits
//! every time. It is the static object of docs/benchmarks.md.

use crate::camera::Camera;
use crate::files::{png, write_file};
use crate::glb::Glb;
use crate::light::Light;
use crate::material::KNIGHT;
use crate::mesh::Mesh;
use crate::picture::cut_out;
use crate::raster::rasterize;
use crate::scene::{FPS, Frame, OBJECTS};
use crate::skin::Character;
use crate::strip;
use crate::vector::{Affine, V3, sin_cos, v3};
use anyhow::{Context, Result, bail, ensure};
use image::ExtendedColorType;
use rayon::prelude::*;
use serde_json::json;
use std::path::{Path, PathBuf};

/// Focal length in image widths: 39.6° across, as in the NeRF-synthetic scenes (camera_angle_x = 0.691).
const FOCAL: f64 = 1.3889;
/// The character's bounding sphere fills this share of the image's height.
const FILL: f64 = 0.95;
/// Sines of the lowest and highest elevation: 2° above the floor, and short of the pole, where "up" loses its meaning.
const ELEVATION_SINES: [f64; 2] = [0.035, 0.97];
/// The golden angle, radians: successive views never line up (Vogel 1979).
const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;
/// Every how many views one is kept out of training.
const HOLD_EVERY: usize = 8;
/// Object index of the character, for masks; 0 would be the static set.
const OBJECT: u8 = 1;
/// Bounds of what is sensible.
const SIZES: std::ops::RangeInclusive<usize> = 16..=4096;
/// See [`SIZES`].
const VIEWS: std::ops::RangeInclusive<usize> = 2..=10_000;

/// Settings of the capture that is rendered.
#[derive(Debug, PartialEq)]
struct Wish {
    character: PathBuf,
    folder: PathBuf,
    views: usize,
    size: usize,
    /// Clip and second; `None`: the pose the file rests in.
    pose: Option<(String, f64)>,
    /// Nodes whose meshes are left out.
    drop: Vec<String>,
}

impl Wish {
    /// CHARACTER.glb FOLDER [--views N] [--size PIXELS] [--pose CLIP SECONDS] [--drop NODE...].
    fn parse(arguments: &[String]) -> Result<Wish> {
        let [character, folder, options @ ..] = arguments else { bail!("capture --still takes CHARACTER.glb FOLDER") };
        let mut wish = Wish {
            character: character.into(),
            folder: folder.into(),
            views: 100,
            size: 400,
            pose: None,
            drop: Vec::new(),
        };
        let mut rest = options.iter();
        while let Some(flag) = rest.next() {
            let mut value = || rest.next().with_context(|| format!("{flag} needs a value"));
            match flag.as_str() {
                "--views" => wish.views = whole(value()?, &VIEWS)?,
                "--size" => wish.size = whole(value()?, &SIZES)?,
                "--pose" => {
                    let clip = value()?.clone();
                    let seconds = value()?;
                    let seconds: f64 = seconds.parse().with_context(|| format!("{seconds} is not a time"))?;
                    ensure!(seconds.is_finite(), "the pose's time is not finite");
                    wish.pose = Some((clip, seconds));
                }
                "--drop" => wish.drop = rest.by_ref().cloned().collect(),
                _ => bail!("capture --still does not know {flag}"),
            }
        }
        Ok(wish)
    }
}

fn whole(text: &str, range: &std::ops::RangeInclusive<usize>) -> Result<usize> {
    let n = text.parse().with_context(|| format!("{text} is not a whole number"))?;
    ensure!(range.contains(&n), "{n} is not between {} and {}", range.start(), range.end());
    Ok(n)
}

/// `capture --still CHARACTER.glb FOLDER ...`.
pub(crate) fn command(arguments: &[String]) -> Result<()> {
    let wish = Wish::parse(arguments)?;
    let start = std::time::Instant::now();
    let (frame, texture) = posed(&wish)?;
    let cameras = hemisphere(&frame.mesh, wish.views, wish.size);
    let draw = |(i, camera): (usize, &Camera)| -> Result<usize> {
        let rgba = cut_out([&texture; 2], &frame, camera, &rasterize(&frame.mesh, camera));
        let bytes = png(&rgba, wish.size, wish.size, ExtendedColorType::Rgba8)?;
        write_file(&wish.folder.join(picture_path(i)), &bytes)?;
        Ok(bytes.len())
    };
    let bytes = cameras.par_iter().enumerate().map(draw).collect::<Result<Vec<usize>>>()?;
    write_file(&wish.folder.join("capture.json"), &description(&wish, &cameras)?)?;
    let megabytes = bytes.iter().sum::<usize>() as f64 / 1e6;
    println!("{} views, {megabytes:.1} MB, drawn in {:.0} s", bytes.len(), start.elapsed().as_secs_f64());
    Ok(())
}

/// The character in its pose under its own shadow, with its texture.
fn posed(wish: &Wish) -> Result<(Frame, crate::texture::Texture)> {
    let place = || wish.character.display().to_string();
    let glb = Glb::parse(&std::fs::read(&wish.character).with_context(place)?).with_context(place)?;
    let clips: Vec<String> = wish.pose.iter().map(|(clip, _)| clip.clone()).collect();
    let glb = strip::strip(&glb, &clips, &wish.drop).with_context(place)?;
    let character = Character::load(&glb).with_context(place)?;
    let pose = match &wish.pose {
        Some((clip, seconds)) => character.sample(clip, *seconds)?,
        None => character.rest().clone(),
    };
    let mut mesh = Mesh::default();
    let skinned = character.draw(&pose, &Affine::IDENTITY, KNIGHT, OBJECT, &mut mesh);
    ensure!(!mesh.triangles.is_empty(), "{} has nothing to draw", place());
    let light = Light::new(&mesh, None);
    let frame = Frame { mesh, first_vertex: [None; OBJECTS], skinned: [0..skinned, 0..0], light, feet: Vec::new() };
    Ok((frame, character.texture))
}

/// `views` cameras, spread evenly over the upper hemisphere about the mesh by a golden spiral.
fn hemisphere(mesh: &Mesh, views: usize, size: usize) -> Vec<Camera> {
    let fold = |pick: fn(f64, f64) -> f64, start: f64| {
        mesh.positions.iter().fold([start; 3], |a, p| {
            let p = p.array();
            std::array::from_fn(|k| pick(a[k], p[k]))
        })
    };
    let (low, high) = (fold(f64::min, f64::INFINITY), fold(f64::max, f64::NEG_INFINITY));
    let target = (v3(low[0], low[1], low[2]) + v3(high[0], high[1], high[2])) * 0.5;
    let radius = mesh.positions.iter().map(|p| (*p - target).length()).fold(0.0, f64::max);
    // The sphere's silhouette is on the cone of sin = radius/distance; its tangent is to be FILL/2 image heights.
    let tangent = 0.5 * FILL / FOCAL;
    let distance = radius * (1.0 + tangent * tangent).sqrt() / tangent;
    let camera = |i: usize| {
        let [lowest, highest] = ELEVATION_SINES;
        let height = lowest + (highest - lowest) * (i as f64 + 0.5) / views as f64;
        let across = (1.0 - height * height).sqrt();
        // sin_cos is exact for small angles only: whole turns are taken off first.
        let turns = i as f64 * GOLDEN_ANGLE / std::f64::consts::TAU;
        let (sin, cos) = sin_cos((turns - turns.floor()) * std::f64::consts::TAU);
        let direction = V3 { x: across * sin, y: height, z: across * cos };
        let focal = FOCAL * size as f64;
        Camera::look_at(format!("view{i:03}"), target + direction * distance, target, focal, size, size)
    };
    (0..views).map(camera).collect()
}

fn picture_path(view: usize) -> PathBuf {
    Path::new("images").join(format!("{view:03}.png"))
}

fn description(wish: &Wish, cameras: &[Camera]) -> Result<Vec<u8>> {
    let entry = |(i, camera): (usize, &Camera)| {
        json!({
            "name": camera.name, "width": camera.width, "height": camera.height,
            "fx": camera.focal, "fy": camera.focal,
            "cx": 0.5 * camera.width as f64, "cy": 0.5 * camera.height as f64,
            "world_to_camera": camera.matrix(), "images": [picture_path(i)],
        })
    };
    let name = wish.character.file_stem().map_or_else(|| "still".into(), |n| n.to_string_lossy().to_lowercase());
    let capture = json!({
        "version": 1, "name": name, "fps": FPS, "up": [0, 1, 0], "background": [1, 1, 1],
        "hold_out": {"every": HOLD_EVERY},
        "cameras": cameras.iter().enumerate().map(entry).collect::<Vec<_>>(),
    });
    let mut text = serde_json::to_string_pretty(&capture)?;
    text.push('\n');
    Ok(text.into_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wish(text: &str) -> Result<Wish> {
        Wish::parse(&text.split(' ').map(str::to_owned).collect::<Vec<_>>())
    }

    fn mage() -> String {
        concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/knight/characters/Mage.glb").to_owned()
    }

    #[test]
    fn options_are_read_and_wrong_ones_refused() {
        let w = wish("a.glb out --size 800 --pose Idle 0.5 --views 40 --drop Staff Book").expect("reads");
        assert_eq!((w.size, w.views, w.pose), (800, 40, Some(("Idle".to_owned(), 0.5))));
        assert_eq!(w.drop, ["Staff", "Book"]);
        for wrong in ["a.glb", "a.glb out --size", "a.glb out --size 3", "a.glb out --pose Idle now", "a.glb out --big"]
        {
            assert!(wish(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_whole_character_is_in_every_image_and_cut_out() {
        let wish = wish(&format!("{} out --size 48 --views 12 --pose Spellcast_Long 1", mage())).expect("reads");
        let (frame, texture) = posed(&wish).expect("the character loads");
        let cameras = hemisphere(&frame.mesh, wish.views, wish.size);
        assert!(cameras.iter().all(|c| c.position.y > 0.0) && cameras[11].position.y > cameras[0].position.y);
        for camera in &cameras {
            for p in &frame.mesh.positions {
                let ([x, y], _) = camera.project(*p);
                assert!((0.0..48.0).contains(&x) && (0.0..48.0).contains(&y), "{} misses a vertex", camera.name);
            }
        }
        let rgba = cut_out([&texture; 2], &frame, &cameras[5], &rasterize(&frame.mesh, &cameras[5]));
        let alpha = |x: usize, y: usize| rgba[4 * (48 * y + x) + 3];
        assert_eq!((alpha(0, 0), alpha(24, 24)), (0, 255), "nothing in the corner, the mage in the middle");
        let part = rgba.chunks(4).filter(|p| p[3] > 0 && p[3] < 255).count();
        assert!(part > 20, "{part} pixels of the silhouette are partly covered");
    }

    #[test]
    fn the_description_is_a_capture_of_still_images() {
        let wish = wish(&format!("{} out --views 9 --size 32", mage())).expect("reads");
        let (frame, _) = posed(&wish).expect("the character loads");
        let text = description(&wish, &hemisphere(&frame.mesh, 9, 32)).expect("plain data");
        let read: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
        assert_eq!(read["cameras"].as_array().map(Vec::len), Some(9));
        assert_eq!((&read["name"], &read["hold_out"]["every"]), (&json!("mage"), &json!(8)));
        assert_eq!(read["cameras"][8]["images"][0], "images/008.png");
    }
}
