//! `capture --videos FOLDER`: the bundled scene as eight people would film it: no common clock, no calibration, each
//! with an exposure of its own, and with sound. Motion JPEG in AVI with 16-bit PCM, which needs no encoder.

use crate::camera::Camera;
use crate::files::write_file;
use crate::picture::shade;
use crate::raster::rasterize;
use crate::scene::{FPS, FRAMES, Stage};
use crate::vector::{V3, sin_cos, v3};
use anyhow::{Context, Result};
use rayon::prelude::*;
use serde_json::json;
use std::path::Path;

const WIDTH: usize = 480;
const HEIGHT: usize = 360;
/// Pixels across an image 480 wide; telephones differ a little.
const FOCAL: [f64; 8] = [372.0, 360.0, 366.0, 380.0, 355.0, 368.0, 374.0, 362.0];
const RADIUS: [f64; 8] = [5.7, 5.9, 5.5, 6.0, 5.8, 5.6, 6.1, 5.7];
const HEIGHTS: [f64; 8] = [1.6, 2.3, 1.9, 2.6, 1.7, 2.4, 1.8, 2.2];
/// Degrees of the arc of the cameras.
const ARC: f64 = 98.0;
const TARGET: V3 = v3(0.0, 0.95, 0.1);
/// Seconds after the first camera's beginning at which each one's video begins: whole frames and parts of them.
const BEGINS: [f64; 8] = [0.0, 0.2134, 0.0871, 0.4302, 0.3117, 0.1490, 0.0266, 0.3689];
/// Stops by which each is brighter, and by which its red is above its blue.
const STOPS: [f64; 8] = [0.0, 0.22, -0.18, 0.1, -0.3, 0.05, 0.3, -0.1];
const WARMTH: [f64; 8] = [0.0, 0.06, -0.08, 0.0, 0.1, -0.04, 0.03, -0.06];
/// Frames that each films.
const TAKEN: usize = 78;
/// The scene's frames in one of the film's: the action is slowed, so that it lasts for as long as all film.
const SPEED: f64 = 1.0 / 3.0;
const JPEG_QUALITY: u8 = 78;

/// Samples of sound a second.
const RATE: u32 = 48_000;
/// Metres of a scene unit, and the speed of sound.
const METRES: f64 = 0.7;
const SOUND: f64 = 343.0;
/// A clap, steps, bounces, the blow: seconds of the film, place, loudness, seconds until it is faint.
const SOUNDS: [(f64, V3, f64, f64); 14] = [
    (0.55, v3(1.15, 1.0, -0.35), 1.0, 0.03),
    (0.62, v3(-1.6, 0.0, -0.9), 0.35, 0.05),
    (0.83, v3(-1.4, 0.0, -0.4), 0.35, 0.05),
    (0.93, v3(2.1, 0.0, 1.25), 0.5, 0.06),
    (1.02, v3(-1.2, 0.0, 0.0), 0.35, 0.05),
    (1.20, v3(1.2, 1.4, -0.6), 0.6, 0.12),
    (1.31, v3(-0.9, 0.0, 0.2), 0.35, 0.05),
    (1.57, v3(-0.5, 0.0, 0.3), 0.3, 0.05),
    (1.74, v3(0.4, 1.0, 0.5), 1.0, 0.04),
    (1.86, v3(1.2, 0.0, 1.9), 0.5, 0.06),
    (2.07, v3(1.4, 1.3, -0.8), 0.5, 0.15),
    (2.29, v3(0.3, 0.8, 0.5), 0.7, 0.05),
    (2.41, v3(1.6, 0.0, -1.0), 0.3, 0.05),
    (2.55, v3(0.0, 0.2, 0.4), 0.6, 0.08),
];
/// Loudness of each microphone's own noise.
const NOISE: f64 = 0.004;

/// Renders the videos and `truth.json`.
pub(crate) fn command(folder: &Path) -> Result<()> {
    let stage = Stage::load(&crate::capture::bundled_folder().join("characters"))?;
    let cameras = rig();
    for (c, camera) in cameras.iter().enumerate() {
        let draw = |n: usize| -> Result<Vec<u8>> {
            let t = (n as f64 + BEGINS[c] * FPS) * SPEED;
            let frame = stage.frame_at(t.min((FRAMES - 1) as f64))?;
            let mut rgb = shade(stage.textures(), &frame, camera, &rasterize(&frame.mesh, camera)).rgb;
            expose(&mut rgb, c);
            let mut jpeg = Vec::new();
            let encoder = jpeg_encoder::Encoder::new(&mut jpeg, JPEG_QUALITY);
            encoder.encode(&rgb, WIDTH as u16, HEIGHT as u16, jpeg_encoder::ColorType::Rgb)?;
            Ok(jpeg)
        };
        let pictures = (0..TAKEN).into_par_iter().map(draw).collect::<Result<Vec<_>>>()?;
        let file = avi(&pictures, &sound(c, camera));
        let path = folder.join(format!("{}.avi", camera.name));
        write_file(&path, &file)?;
        println!("{}: {:.1} MB", path.display(), file.len() as f64 / 1e6);
    }
    let truth = |(c, camera): (usize, &Camera)| {
        json!({"name": camera.name, "begins": BEGINS[c], "stops": STOPS[c], "focal": camera.focal,
            "world_to_camera": camera.matrix()})
    };
    let all = json!({"fps": FPS, "unit_metres": METRES, "cameras": cameras.iter().enumerate().map(truth).collect::<Vec<_>>()});
    write_file(&folder.join("truth.json"), (serde_json::to_string_pretty(&all)? + "\n").as_bytes())
        .context("truth.json")
}

fn rig() -> Vec<Camera> {
    let count = BEGINS.len();
    let camera = |c: usize| {
        let degrees = ARC * (c as f64 / (count - 1) as f64 - 0.5);
        let (sin, cos) = sin_cos(degrees * std::f64::consts::PI / 180.0);
        let position = v3(RADIUS[c] * sin, HEIGHTS[c], RADIUS[c] * cos);
        Camera::look_at(format!("phone-{}", c + 1), position, TARGET, FOCAL[c], WIDTH, HEIGHT)
    };
    (0..count).map(camera).collect()
}

/// Brightens and tints an image: codes are about the 2.2th root of light, and small changes of exposure scale them.
fn expose(rgb: &mut [u8], camera: usize) {
    // 2^(x/2.2) = exp(0.315·x), to second order: exact enough to be a gain, and the same bits everywhere.
    let gain = |stops: f64| 1.0 + 0.315 * stops + 0.5 * (0.315 * stops) * (0.315 * stops);
    let gains = [STOPS[camera] + WARMTH[camera], STOPS[camera], STOPS[camera] - WARMTH[camera]].map(gain);
    for (i, v) in rgb.iter_mut().enumerate() {
        *v = (f64::from(*v) * gains[i % 3] + 0.5).min(255.0) as u8;
    }
}

/// A number from −1 to 1 that depends on two numbers alone (SplitMix64, Steele et al. 2014).
fn noise(stream: u64, k: u64) -> f64 {
    let mut z = (stream << 40).wrapping_add(k).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

/// A camera's sound: every sound after its travel time, fainter with distance.
fn sound(camera: usize, view: &Camera) -> Vec<i16> {
    let length = (TAKEN as f64 / FPS * f64::from(RATE)) as usize;
    let mut out: Vec<f64> = (0..length as u64).map(|k| NOISE * noise(1000 + camera as u64, k)).collect();
    for (event, &(seconds, place, loud, lasts)) in SOUNDS.iter().enumerate() {
        let metres = METRES * (place - view.position).length();
        let first = (seconds - BEGINS[camera] + metres / SOUND) * f64::from(RATE);
        let decay = 1.0 - 4.0 / (lasts * f64::from(RATE));
        let mut level = loud / metres.max(1.0);
        let mut smooth = 0.0;
        for k in 0..(2.0 * lasts * f64::from(RATE)) as u64 {
            // Noise through a low pass: fur on the edge would be lost by what is between samples.
            smooth += 0.4 * (noise(event as u64, k) - smooth);
            let at = first + k as f64;
            let (whole, part) = (at.floor(), at - at.floor());
            for (sample, weight) in [(whole, 1.0 - part), (whole + 1.0, part)] {
                if sample >= 0.0 && (sample as usize) < length {
                    out[sample as usize] += weight * level * smooth;
                }
            }
            level *= decay;
        }
    }
    out.into_iter().map(|v| (v.clamp(-1.0, 1.0) * 32_000.0) as i16).collect()
}

fn chunk(name: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let mut out = name.to_vec();
    out.extend((data.len() as u32).to_le_bytes());
    out.extend(data);
    if data.len() % 2 == 1 {
        out.push(0);
    }
    out
}

fn words(values: &[u32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// RIFF AVI 1.0: a stream of JPEGs and one of PCM, a frame's sound behind the frame.
fn avi(pictures: &[Vec<u8>], sound: &[i16]) -> Vec<u8> {
    const HAS_INDEX: u32 = 0x10;
    const KEY_FRAME: u32 = 0x10;
    let (width, height, count) = (WIDTH as u32, HEIGHT as u32, pictures.len() as u32);
    let rate = FPS as u32;
    let largest = pictures.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let main = words(&[1_000_000 / rate, 0, 0, HAS_INDEX, count, 0, 2, largest, width, height, 0, 0, 0, 0]);
    let header = |kind: &[u8; 4], codec: &[u8; 4], values: [u32; 10]| {
        let mut out = kind.to_vec();
        out.extend(codec);
        out.extend(words(&values));
        // The rectangle, four numbers of 16 bits.
        out.extend([0, 0, 0, 0]);
        out.extend((width as u16).to_le_bytes());
        out.extend((height as u16).to_le_bytes());
        chunk(b"strh", &out)
    };
    // Flags, priority, initial frames, scale, rate, start, length, buffer, quality, bytes per sample.
    let film = header(b"vids", b"MJPG", [0, 0, 0, 1, rate, 0, count, largest, u32::MAX, 0]);
    let mut bitmap = words(&[40, width, height]);
    bitmap.extend([1, 0, 24, 0]);
    bitmap.extend(b"MJPG");
    bitmap.extend(words(&[width * height * 3, 0, 0, 0, 0]));
    let heard = header(b"auds", &[0; 4], [0, 0, 0, 1, RATE, 0, sound.len() as u32, 2 * RATE / rate, u32::MAX, 2]);
    let mut wave: Vec<u8> = [1u16, 1].iter().flat_map(|v| v.to_le_bytes()).collect();
    wave.extend(words(&[RATE, 2 * RATE]));
    wave.extend([2, 0, 16, 0]);
    let list = |name: &[u8; 4], parts: &[Vec<u8>]| chunk(b"LIST", &[name.to_vec(), parts.concat()].concat());
    let film = list(b"strl", &[film, chunk(b"strf", &bitmap)]);
    let heard = list(b"strl", &[heard, chunk(b"strf", &wave)]);
    let headers = list(b"hdrl", &[chunk(b"avih", &main), film, heard]);
    let (mut movie, mut index) = (b"movi".to_vec(), Vec::new());
    let mut put = |name: &[u8; 4], data: &[u8]| {
        index.extend(name);
        index.extend(words(&[KEY_FRAME, movie.len() as u32, data.len() as u32]));
        movie.extend(chunk(name, data));
    };
    for (n, jpeg) in pictures.iter().enumerate() {
        put(b"00dc", jpeg);
        let part = |n: usize| n * sound.len() / pictures.len();
        let bytes: Vec<u8> = sound[part(n)..part(n + 1)].iter().flat_map(|v| v.to_le_bytes()).collect();
        put(b"01wb", &bytes);
    }
    chunk(b"RIFF", &[b"AVI ".to_vec(), headers, chunk(b"LIST", &movie), chunk(b"idx1", &index)].concat())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clap_arrives_after_its_travel_time() {
        let rig = rig();
        let heard = |c: usize| {
            let samples = sound(c, &rig[c]);
            let first = samples.iter().position(|v| v.unsigned_abs() > 400).unwrap();
            first as f64 / f64::from(RATE) + BEGINS[c]
        };
        for (c, view) in rig.iter().enumerate() {
            let (seconds, place, ..) = SOUNDS[0];
            let due = seconds + METRES * (place - view.position).length() / SOUND;
            assert!((heard(c) - due).abs() < 1e-3, "{}: {} s, due at {due} s", view.name, heard(c));
        }
    }

    #[test]
    fn the_file_header_has_its_length() {
        let file = avi(&[vec![1, 2, 3], vec![4]], &[5, 6, 7, 8]);
        let length = u32::from_le_bytes([file[4], file[5], file[6], file[7]]) as usize;
        assert_eq!((&file[..4], length), (&b"RIFF"[..], file.len() - 8));
    }
}
