//! Renders the bundled capture with its poses, masks and ground truth; the same bits every time.

use crate::camera::Camera;
use crate::files::{png, write_file};
use crate::metrics::Motion;
use crate::picture::shade;
use crate::raster::{Visibility, rasterize};
use crate::scene::{FPS, FRAMES, Frame, NAMES, Stage};
use crate::truth;
use crate::vector::{V3, sin_cos, v3};
use anyhow::{Context, Result, ensure};
use image::ExtendedColorType;
use jpeg_encoder::QuantizationTableType;
use rayon::prelude::*;
use serde_json::json;
use std::path::{Path, PathBuf};

const WIDTH: usize = 400;
const HEIGHT: usize = 300;
/// Pixels; gives 67° across.
const FOCAL: f64 = 300.0;
pub(crate) const CAMERAS: usize = 20;
/// The cameras are on an arc of this many degrees about the scene, alternately at two heights.
const ARC_DEGREES: f64 = 170.0;
const ARC_RADIUS: f64 = 5.8;
const ARC_HEIGHTS: [f64; 2] = [1.7, 3.3];
const ARC_TARGET: V3 = v3(0.0, 0.95, 0.1);
/// Cameras kept out of training: two of each height, each between training cameras.
pub(crate) const HELD_OUT: [usize; 4] = [3, 8, 11, 16];
/// Quantisation step 13 at all frequencies: about 20 KB and 40 dB per image, so that 600 of them stay below 13 MB.
/// (Lossless PNG takes 68 KB each.)
const JPEG_QUALITY: u8 = 60;
/// Views with depth and flow.
const TRUTH_CAMERAS: [usize; 4] = [2, 8, 11, 17];
const TRUTH_FRAMES: [usize; 4] = [3, 10, 17, 24];

/// examples/knight of this checkout.
pub(crate) fn bundled_folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/knight")
}

fn rig() -> Vec<Camera> {
    rig_of(CAMERAS, [WIDTH, HEIGHT], FOCAL)
}

/// Cameras on the arc with images of this size; `focal` in pixels.
pub(crate) fn rig_of(count: usize, [width, height]: [usize; 2], focal: f64) -> Vec<Camera> {
    let camera = |i: usize| {
        let degrees = ARC_DEGREES * (i as f64 / (count - 1) as f64 - 0.5);
        let (sin, cos) = sin_cos(degrees * std::f64::consts::PI / 180.0);
        let position = v3(ARC_RADIUS * sin, ARC_HEIGHTS[i % 2], ARC_RADIUS * cos);
        Camera::look_at(format!("cam{i:02}"), position, ARC_TARGET, focal, width, height)
    };
    (0..count).map(camera).collect()
}

/// Data that one image leaves behind for the figures and the ground truth.
struct View {
    rgb: Vec<u8>,
    bytes: [usize; 2],
    tracks_seen: Vec<u8>,
}

/// Renders the capture; `maps`: with depth, flow and labels of every image.
pub(crate) fn write(home: &Path, folder: &Path, maps: bool) -> Result<()> {
    let start = std::time::Instant::now();
    let stage = Stage::load(&home.join("characters"))?;
    let cameras = rig();
    let first = stage.frame(0)?;
    let seen: Vec<Visibility> = cameras.par_iter().map(|camera| rasterize(&first.mesh, camera)).collect();
    let tracked = truth::tracked_vertices(&first, &cameras.iter().zip(&seen).collect::<Vec<_>>());
    drop((first, seen));
    let per_frame = |t: usize| -> Result<(Vec<View>, Vec<V3>)> {
        let frame = stage.frame(t)?;
        let next = (TRUTH_FRAMES.contains(&t) || maps && t + 1 < FRAMES).then(|| stage.frame(t + 1)).transpose()?;
        let points = truth::track_points(&frame.mesh, &tracked);
        let seen: Vec<Visibility> = cameras.par_iter().map(|camera| rasterize(&frame.mesh, camera)).collect();
        let views = (cameras.par_iter().enumerate()).map(|(c, camera)| -> Result<View> {
            let picture = shade(stage.textures(), &frame, camera, &seen[c]);
            let (jpeg, mask) = encode(&picture.rgb, &picture.mask)?;
            write_file(&folder.join(picture_path(camera, t)), &jpeg)?;
            write_file(&folder.join(mask_path(camera, t)), &mask)?;
            if maps {
                truth::write_maps(folder, camera, &seen[c], t, &frame, next.as_ref())?;
            }
            if let (Some(next), true) = (&next, TRUTH_CAMERAS.contains(&c) && TRUTH_FRAMES.contains(&t)) {
                write_truth(folder, camera, &seen[c], t, &frame, next)?;
            }
            let tracks_seen = truth::seen_points(camera, &seen[c], &points);
            Ok(View { rgb: picture.rgb, bytes: [jpeg.len(), mask.len()], tracks_seen })
        });
        let views = views.collect::<Result<Vec<View>>>()?;
        if t == 0 {
            let training = (0..CAMERAS).filter(|c| !HELD_OUT.contains(c));
            let training: Vec<_> = training.map(|c| (&cameras[c], &seen[c], views[c].rgb.as_slice())).collect();
            write_file(&folder.join("points.ply"), &truth::ply(&truth::sparse_cloud(&frame, &training, truth::CLOUD)))?;
        }
        Ok((views, points))
    };
    // One frame after the other bounds the memory; the cameras of a frame keep all threads busy.
    let frames = (0..FRAMES).map(per_frame).collect::<Result<Vec<_>>>()?;
    write_tracks(folder, &frames)?;
    write_file(&folder.join("capture.json"), &description(&cameras, maps)?)?;
    report(&frames);
    println!("drawn in {:.0} s", start.elapsed().as_secs_f64());
    Ok(())
}

/// Renders the given (camera, frame) pairs again and compares them with the files in `folder`.
pub(crate) fn check(folder: &Path, picks: &[(usize, usize)]) -> Result<()> {
    let stage = Stage::load(&folder.join("characters"))?;
    let cameras = rig();
    for &(c, t) in picks {
        let camera = &cameras[c];
        let frame = stage.frame(t)?;
        let picture = shade(stage.textures(), &frame, camera, &rasterize(&frame.mesh, camera));
        let (jpeg, mask) = encode(&picture.rgb, &picture.mask)?;
        for (path, drawn) in [(picture_path(camera, t), jpeg), (mask_path(camera, t), mask)] {
            let path = folder.join(path);
            let stored = std::fs::read(&path).with_context(|| path.display().to_string())?;
            ensure!(stored == drawn, "{} differs from what this code draws; run the capture chore", path.display());
        }
        println!("{} frame {t}: same bytes", camera.name);
    }
    Ok(())
}

fn picture_path(camera: &Camera, t: usize) -> PathBuf {
    Path::new("images").join(&camera.name).join(format!("{t:04}.jpg"))
}

fn mask_path(camera: &Camera, t: usize) -> PathBuf {
    Path::new("masks").join(&camera.name).join(format!("{t:04}.png"))
}

/// The image as JPEG, the mask as PNG.
fn encode(rgb: &[u8], mask: &[u8]) -> Result<(Vec<u8>, Vec<u8>)> {
    Ok((jpeg(rgb, WIDTH, HEIGHT)?, png(mask, WIDTH, HEIGHT, ExtendedColorType::L8)?))
}

/// A JPEG without chroma subsampling.
pub(crate) fn jpeg(rgb: &[u8], width: usize, height: usize) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut out, JPEG_QUALITY);
    encoder.set_sampling_factor(jpeg_encoder::SamplingFactor::F_1_1);
    encoder.set_progressive(true);
    encoder.set_optimized_huffman_tables(true);
    // Equal steps at all frequencies give the smallest squared error per byte, which is what training measures.
    encoder.set_quantization_tables(QuantizationTableType::Flat, QuantizationTableType::Flat);
    encoder.encode(rgb, width as u16, height as u16, jpeg_encoder::ColorType::Rgb)?;
    Ok(out)
}

fn write_truth(folder: &Path, camera: &Camera, seen: &Visibility, t: usize, frame: &Frame, next: &Frame) -> Result<()> {
    let bytes = |codes: Vec<u16>| -> Vec<u8> { codes.iter().flat_map(|c| c.to_ne_bytes()).collect() };
    let file = |kind: &str| folder.join(format!("truth/{kind}/{}_{t:04}.png", camera.name));
    let depth = png(&bytes(truth::depth(camera, seen, frame)), WIDTH, HEIGHT, ExtendedColorType::L16)?;
    write_file(&file("depth"), &depth)?;
    let flow = png(&bytes(truth::flow(camera, seen, frame, next)), WIDTH, HEIGHT, ExtendedColorType::Rgb16)?;
    write_file(&file("flow"), &flow)
}

fn write_tracks(folder: &Path, frames: &[(Vec<View>, Vec<V3>)]) -> Result<()> {
    let numbers = frames.iter().flat_map(|(_, points)| points.iter().flat_map(|p| p.array()));
    let bytes: Vec<u8> = numbers.flat_map(|v| (v as f32).to_le_bytes()).collect();
    let tracks = truth::npy("<f4", &[FRAMES, truth::TRACKS, 3], &bytes);
    write_file(&folder.join("truth/tracks.npy"), &tracks)?;
    let seen: Vec<u8> = (0..CAMERAS)
        .flat_map(|c| frames.iter().flat_map(move |(views, _)| views[c].tracks_seen.iter().copied()))
        .collect();
    let seen = truth::npy("|u1", &[CAMERAS, FRAMES, truth::TRACKS], &seen);
    write_file(&folder.join("truth/tracks_visible.npy"), &seen)
}

fn description(cameras: &[Camera], maps: bool) -> Result<Vec<u8>> {
    let entry = |camera: &Camera| {
        let mut entry = json!({
            "name": camera.name, "width": WIDTH, "height": HEIGHT,
            "fx": camera.focal, "fy": camera.focal, "cx": 0.5 * WIDTH as f64, "cy": 0.5 * HEIGHT as f64,
            "world_to_camera": camera.matrix(), "time_offset": 0,
            "images": format!("images/{}/%04d.jpg", camera.name),
            "masks": format!("masks/{}/%04d.png", camera.name),
            "start": 0, "frames": FRAMES,
        });
        if maps {
            truth::list_maps(&mut entry, camera);
        }
        entry
    };
    let mut capture = json!({
        "version": 1, "name": "knight", "fps": FPS, "up": [0, 1, 0],
        "hold_out": {"cameras": HELD_OUT.map(|c| cameras[c].name.clone())},
        "points": "points.ply",
        "cameras": cameras.iter().map(entry).collect::<Vec<_>>(),
    });
    if maps {
        capture["labels"] = json!(NAMES);
    }
    let mut text = serde_json::to_string_pretty(&capture)?;
    text.push('\n');
    Ok(text.into_bytes())
}

fn report(frames: &[(Vec<View>, Vec<V3>)]) {
    println!("camera   dynamic %   temporal mean there, dB");
    let (mut all, mut held_out) = (Motion::default(), Motion::default());
    for c in 0..CAMERAS {
        let pictures: Vec<&[u8]> = frames.iter().map(|(views, _)| views[c].rgb.as_slice()).collect();
        let motion = Motion::of_frames(&pictures);
        all = all.plus(motion);
        let held = HELD_OUT.contains(&c);
        if held {
            held_out = held_out.plus(motion);
        }
        let note = if held { "  (held out)" } else { "" };
        println!("cam{c:02}    {:8.2}   {:8.2}{note}", motion.coverage(), motion.mean_psnr());
    }
    println!("all      {:8.2}   {:8.2}", all.coverage(), all.mean_psnr());
    println!("held out {:8.2}   {:8.2}", held_out.coverage(), held_out.mean_psnr());
    let size = |kind: usize| frames.iter().flat_map(|(v, _)| v).map(|v| v.bytes[kind]).sum::<usize>() as f64 / 1e6;
    println!("images {:.2} MB, masks {:.2} MB", size(0), size(1));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_committed_images_equal_rendered_ones() {
        check(&bundled_folder(), &[(8, 14)]).expect("same bytes");
    }

    #[test]
    fn maps_are_listed_with_the_names_of_their_labels() {
        let cameras = rig();
        let listed = |maps| -> serde_json::Value {
            serde_json::from_slice(&description(&cameras, maps).expect("JSON")).expect("JSON")
        };
        let (with, without) = (listed(true), listed(false));
        assert_eq!(with["labels"].as_array().map(Vec::len), Some(NAMES.len()));
        assert_eq!(with["cameras"][2]["labels"], "labels/cam02/%04d.png");
        assert!(without["labels"].is_null() && without["cameras"][2]["labels"].is_null());
    }

    #[test]
    fn poses_are_rotations_that_put_the_target_in_the_middle() {
        for camera in rig() {
            let [right, down, forward] = camera.axes;
            assert!((right.cross(down) - forward).length() < 1e-12, "{} is not right-handed", camera.name);
            assert!(down.y < 0.0, "{} stands upright", camera.name);
            let (pixel, depth) = camera.project(ARC_TARGET);
            assert!((pixel[0] - 200.0).abs() < 1e-9 && (pixel[1] - 150.0).abs() < 1e-9 && depth > 5.0);
        }
    }
}
