//! One camera as JSON, so that an image can be compared with any other renderer's.
//!
//! ```json
//! {"fx": 500, "fy": 500, "cx": 320, "cy": 240, "w": 640, "h": 480, "background": [0, 0, 0],
//!  "world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}
//! ```
//! `width` and `height` may represent `w` and `h`. The pose is a row-major 4x4 in OpenCV axes (x right, y down, z
//! forward); pixel centres are at +0.5.

use crate::files::read_text;
use serde_json::Value;
use splat4d::math::Se3;
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, Result};
use splat4d_train::settings::nearest;
use std::path::Path;

const KEYS: [&str; 11] = ["fx", "fy", "cx", "cy", "w", "h", "width", "height", "world_to_camera", "near", "background"];
/// Longest side of an image that is rendered, pixels.
pub const MAX_SIDE: usize = 16_384;
/// Most pixels of an image that is rendered: 8K video twice over; about 4 GiB of working memory.
pub const MAX_PIXELS: usize = 1 << 26;
/// Largest |R Rᵀ − I| that counts as rounding of the file.
const MAX_SHEAR: f64 = 0.01;
/// Largest number of a camera that is accepted: sums of squares and cubes of it still fit 32-bit floats.
const LARGEST: f64 = 1e12;
/// Shortest focal length that is accepted, pixels.
const SHORTEST: f64 = 1e-3;

/// Reads the camera and its background, if it has one.
pub fn read(path: &Path) -> Result<(Camera, Option<[f32; 3]>)> {
    let text = read_text(path)?;
    parse(&text).map_err(|e| e.at(path.display()))
}

pub fn parse(text: &str) -> Result<(Camera, Option<[f32; 3]>)> {
    let value = json(text)?;
    let Some(object) = value.as_object() else {
        return Err(Error::input("the camera is not a JSON object { ... }").remedy(known_keys()));
    };
    for key in object.keys().filter(|k| !KEYS.contains(&k.as_str())) {
        // Notes of other tools do no harm; a misspelt key would silently be left out.
        if let Some(near) = nearest(key, &KEYS).filter(|n| n.len() > 2) {
            return Err(Error::input(format!("unknown key \"{key}\"")).remedy(format!("Did you mean \"{near}\"?")));
        }
    }
    let number = |key: &str| {
        let value = value.get(key).ok_or_else(|| missing(key))?;
        value.as_f64().filter(|x| x.abs() <= LARGEST).ok_or_else(|| {
            Error::input(format!("\"{key}\" is {value}, not a number up to {LARGEST:e}"))
                .remedy("Write a plain number.")
        })
    };
    // capture.json and Python write the whole words.
    let side = |key: &'static str, word: &'static str| {
        let key = match (value.get(key), value.get(word)) {
            (Some(a), Some(b)) if a != b => {
                return Err(Error::input(format!("\"{key}\" is {a} and \"{word}\" is {b}")).remedy("Give one of them."));
            }
            (None, Some(_)) => word,
            _ => key,
        };
        let n = number(key)?;
        if !(1.0..=MAX_SIDE as f64).contains(&n) || n.fract() != 0.0 {
            return Err(Error::input(format!("\"{key}\" is {n}"))
                .remedy(format!("Give a whole number of pixels from 1 to {MAX_SIDE}.")));
        }
        Ok(n as usize)
    };
    let intrinsics = Intrinsics { fx: number("fx")?, fy: number("fy")?, cx: number("cx")?, cy: number("cy")? };
    if intrinsics.fx < SHORTEST || intrinsics.fy < SHORTEST {
        return Err(Error::input(format!("invalid focal length {} x {}", intrinsics.fx, intrinsics.fy))
            .remedy("Give \"fx\" and \"fy\" in pixels, above zero."));
    }
    let (width, height) = (side("w", "width")?, side("h", "height")?);
    if width * height > MAX_PIXELS {
        return Err(Error::input(format!("an image of {width}x{height} is too large"))
            .remedy(format!("At most {MAX_PIXELS} pixels are rendered at once.")));
    }
    let cam_from_world = pose(value.get("world_to_camera").ok_or_else(|| missing("world_to_camera"))?)?;
    let background = match value.get("background").filter(|v| !v.is_null()) {
        None => None,
        Some(v) => {
            let parsed = numbers(v).and_then(|n| <[f64; 3]>::try_from(n).ok()).map(|b| b.map(|x| x as f32));
            Some(parsed.ok_or_else(|| {
                Error::input(format!("\"background\" is {v}")).remedy("Give red, green and blue, 0 to 1, as [r, g, b].")
            })?)
        }
    };
    let near = if value.get("near").is_some() { number("near")? } else { Camera::NEAR };
    if near <= 0.0 {
        return Err(Error::input(format!("\"near\" is {near}")).remedy("Give a distance above zero, in scene units."));
    }
    Ok((Camera { cam_from_world, intrinsics, lens: Lens::Pinhole, width, height, near }, background))
}

/// Parses JSON; the error states what is usually wrong.
pub fn json(text: &str) -> Result<Value> {
    serde_json::from_str(text).map_err(|e| {
        let remedy = if text.contains("NaN") || text.contains("Infinity") {
            "It contains NaN or Infinity, which JSON does not allow: correct that number."
        } else if e.is_eof() {
            "The file looks truncated: write it again."
        } else {
            "Correct the file there."
        };
        Error::input(format!("is not valid JSON: {e}")).remedy(remedy)
    })
}

/// A rigid `cam_from_world` from a row-major 4x4 (nested, or 16 numbers in a row).
pub fn pose(value: &Value) -> Result<Se3> {
    let wrong = || {
        Error::input("\"world_to_camera\" is not a 4x4 matrix of finite numbers")
            .remedy("Write four rows of four numbers, [[r, r, r, t], ...], the last one 0, 0, 0, 1.")
    };
    let flat = match value.as_array() {
        Some(rows) if rows.len() == 4 && rows.iter().all(|r| numbers(r).is_some_and(|r| r.len() == 4)) => {
            rows.iter().filter_map(numbers).flatten().collect()
        }
        _ => numbers(value).filter(|n| n.len() == 16).ok_or_else(wrong)?,
    };
    let m: [[f64; 4]; 4] = std::array::from_fn(|i| std::array::from_fn(|j| flat[4 * i + j]));
    if m[3].iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(a, b)| (a - b).abs() > 1e-6) {
        return Err(Error::input("the last row of \"world_to_camera\" is not 0 0 0 1")
            .remedy("Write the matrix row by row: a transposed one has its translation there."));
    }
    let pose = Se3::from_rows(&m);
    if pose.det() < 0.0 {
        return Err(Error::input("\"world_to_camera\" is mirrored (its rotation has determinant −1)")
            .remedy("One axis has the wrong sign: the camera's axes are x right, y down, z forward (OpenCV)."));
    }
    let shear = pose.orthogonality_error();
    if shear > MAX_SHEAR {
        return Err(Error::input(format!(
            "invalid \"world_to_camera\": not a rigid motion (its rotation is off by {shear:.3})"
        ))
        .remedy("Remove scale and shear from the matrix and write at least four decimals."));
    }
    Ok(pose)
}

/// A list of numbers that 32-bit floats can compute with.
pub fn numbers(value: &Value) -> Option<Vec<f64>> {
    value.as_array()?.iter().map(|v| v.as_f64().filter(|x| x.abs() <= LARGEST)).collect()
}

fn missing(key: &str) -> Error {
    Error::input(format!("the key \"{key}\" is missing")).remedy(known_keys())
}

fn known_keys() -> String {
    format!("A camera needs the keys {}; \"near\" and \"background\" may be left out.", KEYS.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn good() -> Value {
        json!({"fx": 50, "fy": 60.5, "cx": 16, "cy": 12, "w": 32, "h": 24, "background": [1, 0.5, 0], "note": "mine",
               "world_to_camera": [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]})
    }

    #[test]
    fn a_camera_is_read_nested_or_flat() {
        let (camera, background) = parse(&good().to_string()).unwrap();
        assert_eq!((camera.width, camera.height, background), (32, 24, Some([1.0, 0.5, 0.0])));
        assert_eq!(camera.cam_from_world.translation, [0.5, 0.0, 4.0]);
        let mut flat = good();
        flat["world_to_camera"] = json!([1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1]);
        assert_eq!(parse(&flat.to_string()).unwrap().0, camera);
        let mut words = good();
        let object = words.as_object_mut().unwrap();
        for (key, word) in [("w", "width"), ("h", "height")] {
            let value = object.remove(key).unwrap();
            object.insert(word.into(), value);
        }
        assert_eq!(parse(&words.to_string()).unwrap().0, camera);
        words["w"] = json!(31);
        assert!(parse(&words.to_string()).unwrap_err().to_string().contains("\"width\" is 32"));
        flat["near"] = json!(0.3);
        assert_eq!((camera.near, parse(&flat.to_string()).unwrap().0.near), (Camera::NEAR, 0.3));
    }

    #[test]
    fn every_wrong_camera_gets_its_reason() {
        let change = |key: &str, value: Value| {
            let mut camera = good();
            camera[key] = value;
            camera.to_string()
        };
        let mirrored = json!([[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]);
        let scaled = json!([[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 4], [0, 0, 0, 1]]);
        let transposed = json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 4, 1]]);
        let zero = json!([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]);
        let cases = [
            (change("fx", json!(0)), "focal"),
            (change("fx", json!("wide")), "\"fx\""),
            (change("w", json!(1e9)), "\"w\""),
            (change("h", json!(2.5)), "\"h\""),
            (change("world_to_camera", mirrored), "mirrored"),
            (change("world_to_camera", scaled), "rigid"),
            (change("world_to_camera", transposed), "transposed"),
            (change("world_to_camera", zero), "rigid"),
            (change("world_to_camera", json!([[1, 2], [3, 4]])), "4x4"),
            (change("near", json!(-1)), "\"near\""),
            (change("near", json!(null)), "\"near\""),
            (change("background", json!([1])), "background"),
            (change("fx", json!(1e-320)), "focal length"),
            (change("cx", json!(1e39)), "\"cx\""),
            (good().to_string().replace("0.5]", "-1e308]"), "4x4"),
            (change("backgroud", json!([1, 1, 1])), "\"background\""),
            (good().to_string().replace("0.5", "NaN"), "NaN"),
            (good().to_string()[..40].to_owned(), "truncated"),
            ("[]".into(), "object"),
            (json!({"fx": 1}).to_string(), "missing"),
            (change("w", json!(16384)).replace("\"h\":24", "\"h\":16384"), "too large"),
        ];
        for (text, reason) in cases {
            let message = parse(&text).unwrap_err().to_string();
            assert!(message.contains(reason), "{text}: {message}");
        }
    }
}
