//! `.splatv`: moving Gaussians as the texture of splaTV's and gsplat.js's players.
//!
//! u32 0x674B, u32 length of a JSON text, the text (a list of chunks; all known files have one of type "splat" with
//! `size`, `texwidth` 4096, `texheight` and `cameras`), then the chunk: 64 bytes per Gaussian. Words: 0–2 position f32,
//! 3–4 quaternion 4×f16 wxyz, 5–6 **linear** scale 3×f16, 7 colour rgb and opacity u8, 8–12 path 9×f16, 13–14
//! quaternion rate 4×f16, 15 centre and width 2×f16. Opacity·exp(−((t − centre)/width)²), **no ½**; t runs from 0 to 1
//! over the clip. No spherical harmonics. We add the key `splat4d` with clip and frame rate, which other programs pass
//! over.
//! Source: antimatter15/splaTV and gsplat.js (MIT), their shaders.

use super::bytes::{Cursor, byte_of_dc, byte_of_logit, dc_of_byte, f32_at, logit_of_byte};
use super::dialect::{Dialect, Opened, WriteOptions, Writer, Y_DOWN};
use super::half::{f16_to_f32, f32_to_f16};
use super::kinematic::{Clock, Moving, rows, scene};
use super::warnings::Warnings;
use crate::layers::Scene;
use crate::scene::Camera;
use crate::{Error, Result};
use serde_json::{Value, json};
use std::io::Write;

/// splaTV's moving .splatv.
pub const DIALECT: Dialect = Dialect {
    name: ".splatv",
    ending: ".splatv",
    up: Y_DOWN,
    moves: true,
    mark: Some(|bytes| bytes.starts_with(&MAGIC)),
    read: |bytes| read(bytes).map(Opened::from),
    writer: Writer::Moving(|scene, options, mut out| write(scene, options, &mut out)),
    world: false,
    fixed_axes: false,
    states_up: false,
};

/// First four bytes.
pub(crate) const MAGIC: [u8; 4] = 0x674Bu32.to_le_bytes();
/// Bytes per Gaussian.
const ROW: usize = 64;
/// Texels a row of the texture, 16 bytes each: the players' shaders compute with 1024 Gaussians a row.
const TEXTURE_WIDTH: usize = 4096;
/// Longest JSON text that is accepted: a thousand cameras take a third of this.
const MOST_JSON: usize = 1 << 20;
/// Smallest linear scale: f16 ends at 6e-8.
const SMALLEST_SCALE: f32 = 6e-8;

/// Writes a moving scene. The options' cameras are offered by the players; without any, the first of [`Scene::clip`] is
/// viewed from afar.
///
/// Errors: the format cannot express the scene's motion or lifespans, and fitting is not allowed; the sink's.
pub fn write(scene: &Scene<f32>, options: &WriteOptions, out: &mut impl Write) -> Result<Warnings> {
    let mut warnings = Warnings::default();
    let span = scene.clip[1] - scene.clip[0];
    let fps = if scene.fps > 0.0 { scene.fps } else { crate::scene::time::DEFAULT_FPS };
    // A single time still needs a clip.
    let clock = Clock { clip: scene.clip, fps, duration: if span > 0.0 { span } else { 1.0 } };
    let rows = rows(scene, clock, ".splatv", options.exact, &mut warnings)?;
    let height = (rows.len() * ROW / 16).div_ceil(TEXTURE_WIDTH).max(1);
    let size = height * TEXTURE_WIDTH * 16;
    let mut texture = Vec::with_capacity(size);
    let (mut colored, mut saturated) = (0, 0);
    for row in &rows {
        let mut outside = [false; 2];
        texture.extend(pack(row, &mut outside));
        colored += usize::from(outside[0]);
        saturated += usize::from(outside[1]);
    }
    texture.resize(size, 0);
    warnings.counted(colored, rows.len(), "had a base colour outside 0 to 1, which was clipped");
    warnings.counted(saturated, rows.len(), "had a path, turn or scale beyond 65504, which was clipped");
    let cameras: Vec<Value> = match &options.cameras[..] {
        [] => vec![camera_json(0, &default_camera(&rows))],
        some => some.iter().enumerate().map(|(i, c)| camera_json(i, c)).collect(),
    };
    let text = json!([{
        "type": "splat", "size": size, "texwidth": TEXTURE_WIDTH, "texheight": height, "cameras": cameras,
        "splat4d": {"clip": clock.clip, "fps": clock.fps, "duration": clock.duration, "gaussians": rows.len()},
    }])
    .to_string();
    let mut file = MAGIC.to_vec();
    file.extend((text.len() as u32).to_le_bytes());
    file.extend(text.as_bytes());
    for bytes in [&file, &texture] {
        out.write_all(bytes).map_err(|e| Error::io("the Gaussians could not be written", e))?;
    }
    Ok(warnings)
}

/// A camera as in 3DGS' cameras.json: centre, world-from-camera rotation as rows, focal lengths in pixels.
fn camera_json(id: usize, camera: &Camera) -> Value {
    let r = camera.cam_from_world.rotation;
    let rotation: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| r[j][i]));
    json!({
        "id": id, "img_name": format!("{id:05}"), "width": camera.width, "height": camera.height,
        "position": camera.center(), "rotation": rotation,
        "fx": camera.intrinsics.fx, "fy": camera.intrinsics.fy,
    })
}

/// A view of the whole, from the side of −z, with y down.
fn default_camera(rows: &[Moving]) -> Camera {
    let n = rows.len().max(1) as f64;
    let center: [f64; 3] = std::array::from_fn(|k| rows.iter().map(|m| m.mean[k]).sum::<f64>() / n);
    let spread = rows.iter().map(|m| (0..3).map(|k| (m.mean[k] - center[k]).powi(2)).sum::<f64>()).sum::<f64>();
    let away = 3.0 * (spread / n).sqrt().max(1e-3);
    let eye = [center[0], center[1], center[2] - away];
    Camera::with_fov_y(crate::math::Se3::look_at(eye, center, [0.0, -1.0, 0.0]), 0.9, 1280, 720)
}

fn pack(m: &Moving, outside: &mut [bool; 2]) -> [u8; ROW] {
    // f16 moves the centre by up to 1/4096; the path is relative to the rounded centre.
    let m = m.recentered(f64::from(f16_to_f32(f32_to_f16(m.center as f32))));
    let [colored, saturated] = outside;
    let mut half = |x: f64| {
        *saturated |= x.abs() > 65504.0;
        f32_to_f16(x as f32).to_le_bytes()
    };
    let mut b = [0; ROW];
    let mut put = |at: usize, bytes: &[u8]| b[at..at + bytes.len()].copy_from_slice(bytes);
    for k in 0..3 {
        put(4 * k, &(m.mean[k] as f32).to_le_bytes());
        put(20 + 2 * k, &half(f64::from(m.log_scale[k].exp().max(SMALLEST_SCALE))));
    }
    for k in 0..4 {
        put(12 + 2 * k, &half(m.quat[k]));
        put(52 + 2 * k, &half(m.turn[k]));
    }
    let color = m.dc.map(|dc| byte_of_dc(dc, colored));
    put(28, &[color[0], color[1], color[2], byte_of_logit(m.opacity_logit)]);
    for k in 0..9 {
        put(32 + 2 * k, &half(m.path[k / 3][k % 3]));
    }
    put(60, &half(m.center));
    // A width that f16 would round to zero hides the Gaussian in every player; so it does in the scene.
    put(62, &half(m.width));
    b
}

/// Reads a moving scene. Without our own key, one second is assumed for the clip.
///
/// Errors: another magic number; JSON that does not state where the Gaussians are; truncated.
pub(crate) fn read(bytes: &[u8]) -> Result<(Scene<f32>, Warnings)> {
    let mut warnings = Warnings::default();
    let mut c = Cursor::new(bytes, ".splatv file");
    if c.take(4)? != MAGIC {
        return Err(Error::input("this is not a .splatv file: its first bytes are not 4B 67 00 00")
            .remedy("Give a file that splaTV or splat4d wrote."));
    }
    let length = c.u32()? as usize;
    if length > MOST_JSON {
        return Err(damaged(format!("its description claims {length} bytes")));
    }
    let text: Value =
        serde_json::from_slice(c.take(length)?).map_err(|e| damaged(format!("its description is not JSON: {e}")))?;
    let chunks = text.as_array().ok_or_else(|| damaged("its description is not a list"))?;
    for chunk in chunks {
        let size = chunk["size"].as_u64().and_then(|n| usize::try_from(n).ok());
        let size = size.ok_or_else(|| damaged("a chunk has no size"))?;
        let body = c.take(size)?;
        if chunk["type"] == "splat" {
            return splats(chunk, body, warnings);
        }
        warnings.add(format!("a chunk of type {} is not read", chunk["type"]));
    }
    Err(damaged("it has no chunk of type \"splat\""))
}

fn splats(chunk: &Value, body: &[u8], mut warnings: Warnings) -> Result<(Scene<f32>, Warnings)> {
    let own = &chunk["splat4d"];
    let number = |v: &Value| v.as_f64().unwrap_or(f64::NAN);
    let clip = [number(&own["clip"][0]), number(&own["clip"][1])];
    let clock = Clock::stated(clip, number(&own["fps"]), number(&own["duration"]));
    let clock = clock.unwrap_or_else(|| Clock::assumed(&mut warnings));
    // The last row of the texture is filled up with zeros.
    let count = body.chunks_exact(ROW).rposition(|row| row.iter().any(|&b| b != 0)).map_or(0, |i| i + 1);
    let rows: Vec<Moving> = body.chunks_exact(ROW).take(count).map(unpack).collect();
    let damaged = rows.iter().filter(|m| !is_finite(m)).count();
    warnings.counted(damaged, rows.len(), "contain NaN or infinity and were left out");
    let sound: Vec<Moving> = rows.into_iter().filter(is_finite).collect();
    Ok((scene(&sound, clock)?, warnings))
}

fn is_finite(m: &Moving) -> bool {
    let wide = m.mean.iter().chain(&m.quat).chain(m.path.as_flattened()).chain(&m.turn);
    wide.chain([&m.center, &m.width]).all(|x| x.is_finite()) && m.log_scale.iter().all(|x| x.is_finite())
}

fn unpack(b: &[u8]) -> Moving {
    let half = |at: usize| f64::from(f16_to_f32(u16::from_le_bytes([b[at], b[at + 1]])));
    Moving {
        mean: std::array::from_fn(|k| f64::from(f32_at(b, k))),
        quat: std::array::from_fn(|k| half(12 + 2 * k)),
        log_scale: std::array::from_fn(|k| (half(20 + 2 * k) as f32).max(SMALLEST_SCALE).ln()),
        opacity_logit: logit_of_byte(b[31]),
        dc: std::array::from_fn(|k| dc_of_byte(b[28 + k])),
        path: std::array::from_fn(|k| std::array::from_fn(|axis| half(32 + 6 * k + 2 * axis))),
        turn: std::array::from_fn(|k| half(52 + 2 * k)),
        center: half(60),
        width: half(62),
        source: [0; 2],
    }
}

fn damaged(what: impl std::fmt::Display) -> Error {
    Error::input(format!("this .splatv file is damaged: {what}")).remedy("Copy or export it again.")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::kinematic::tests::{apart, moving};
    use crate::format::mutate::mutants;
    use crate::layers::Evaluation;
    use crate::scene::{LIFE, LifeKind, Time};

    /// One Gaussian at (1, 2, 3), moving by x = 1 + 2u, turned by nothing, with half its lifespan at 0.5 and s = 0.25.
    fn by_hand() -> Vec<u8> {
        let text = br#"[{"type":"splat","size":128,"texwidth":4,"texheight":2,"cameras":[]}]"#;
        let mut file = vec![0x4B, 0x67, 0, 0];
        file.extend((text.len() as u32).to_le_bytes());
        file.extend(text);
        [1.0f32, 2.0, 3.0].iter().for_each(|x| file.extend(x.to_le_bytes()));
        // f16: 1 is 0x3C00, 0.5 0x3800, 0.25 0x3400, 2 0x4000.
        for half in [0x3C00u16, 0, 0, 0, 0x3800, 0x3800, 0x4000, 0] {
            file.extend(half.to_le_bytes());
        }
        file.truncate(file.len() - 2);
        // Word 6's upper half is unused; then the colour.
        file.extend([0, 0, 255, 0, 51, 204]);
        for half in [0x4000u16, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x3800, 0x3400] {
            file.extend(half.to_le_bytes());
        }
        file.resize(8 + text.len() + 128, 0);
        file
    }

    #[test]
    fn bytes_of_the_shader_are_read() {
        let (scene, warnings) = read(&by_hand()).unwrap();
        assert_eq!((scene.len(), scene.clip), (1, [0.0, 1.0]));
        assert!(warnings.lines()[0].contains("one second"));
        let mut instant = Evaluation::default();
        // u = 0.75: Δ = 0.25, the fade exp(−1).
        scene.at(Time(0.75), &mut instant);
        let out = instant.tape(0).out();
        let row = out.read::<10>(0, 0);
        assert!((row[0] - 1.5).abs() < 1e-6 && row[1..3] == [2.0, 3.0], "{row:?}");
        assert!((row[3] - 0.25).abs() < 1e-6 && (row[8] - 4.0).abs() < 1e-5, "{row:?}");
        assert!((row[9] - 0.8 * (-1.0f32).exp()).abs() < 1e-6, "{row:?}");
    }

    #[test]
    fn a_dynamic_scene_round_trips_within_f16() {
        for life in [LifeKind::Infinite, LifeKind::GaussHalf, LifeKind::GaussOne] {
            let scene = moving(1500, life, 3, true);
            let mut file = Vec::new();
            write(&scene, &WriteOptions::default(), &mut file).unwrap();
            let (back, warnings) = read(&file).unwrap();
            assert_eq!((back.len(), back.clip, back.fps), (1500, scene.clip, scene.fps));
            assert!(warnings.lines().is_empty(), "{warnings:?}");
            let [mean, cov, opacity] = apart(&scene, &back);
            // 2^-11 of paths of some 100 units (cubes of 3 s), of sizes up to 3, and of a lifespan's slope.
            assert!(mean < 0.05 && cov < 0.01 && opacity < 0.004, "{life:?}: {mean} {cov} {opacity}");
        }
    }

    #[test]
    fn the_half_in_the_fade_is_converted() {
        let scene = moving(1, LifeKind::GaussHalf, 0, false);
        let mut file = Vec::new();
        write(&scene, &WriteOptions::default(), &mut file).unwrap();
        let (back, _) = read(&file).unwrap();
        let [ours, theirs] = [&scene, &back].map(|s| f64::from(s.layers[0].params[LIFE].get(0, 1)).exp());
        assert!((theirs / ours - std::f64::consts::SQRT_2).abs() < 1e-3, "{ours} {theirs}");
    }

    #[test]
    fn the_layout_is_the_players() {
        let mut file = Vec::new();
        write(&moving(1025, LifeKind::Infinite, 1, false), &WriteOptions::default(), &mut file).unwrap();
        let length = u32::from_le_bytes(file[4..8].try_into().unwrap()) as usize;
        let text: Value = serde_json::from_slice(&file[8..8 + length]).unwrap();
        assert_eq!((&text[0]["texwidth"], &text[0]["texheight"]), (&json!(4096), &json!(2)));
        assert_eq!(file.len() - 8 - length, 2 * 4096 * 16);
        assert!(text[0]["cameras"][0]["fx"].as_f64().unwrap() > 100.0, "splaTV reads the first camera's fx");
    }

    #[test]
    fn damaged_files_never_panic() {
        let mut file = Vec::new();
        write(&moving(40, LifeKind::GaussOne, 3, true), &WriteOptions::default(), &mut file).unwrap();
        file.truncate(4096);
        let hand = by_hand();
        for mutant in mutants(&file, 300, "splatv").chain(mutants(&hand, 1000, "splatv hand")) {
            if let Ok((scene, _)) = read(&mutant) {
                scene.at(Time(0.1), &mut Evaluation::default());
            }
        }
        for cut in 0..hand.len() {
            assert!(read(&hand[..cut]).is_err());
        }
    }
}
