//! A tiny capture: four cameras on an arc film a bright square that crosses a grey wall.

use crate::files::{png, write_file};
use anyhow::Result;
use image::ExtendedColorType;
use serde_json::{Value, json};
use std::path::Path;

const CAMERAS: usize = 4;
/// Pixels: the least that `import` takes.
const SIZE: [usize; 2] = [48, 36];
const FOCAL: f64 = 45.0;
const DISTANCE: f64 = 3.0;
/// Angle between neighbouring cameras, radians.
const APART: f64 = 0.35;

/// Writes it, of this many frames per camera, with masks of labels.
pub(super) fn write(folder: &Path, frames: usize) -> Result<()> {
    let cameras: Vec<Value> = (0..CAMERAS).map(|c| camera(folder, c, frames)).collect::<Result<_>>()?;
    let labels = json!(["wall", "square"]);
    let text = json!({"version": 1, "fps": 30, "labels": labels, "cameras": cameras}).to_string();
    write_file(&folder.join("capture.json"), text.as_bytes())
}

fn camera(folder: &Path, number: usize, frames: usize) -> Result<Value> {
    let angle = APART * (number as f64 - 1.5);
    let (sin, cos) = angle.sin_cos();
    // It is at (d sin, 0, -d cos), and points at the origin; y points down.
    let rotation = [[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]];
    for frame in 0..frames {
        let (mut color, mut label) = (Vec::new(), Vec::new());
        for pixel in 0..SIZE[0] * SIZE[1] {
            let at = |k: usize, n: usize| (n as f64 + 0.5 - 0.5 * SIZE[k] as f64) / FOCAL;
            let ray = [at(0, pixel % SIZE[0]), at(1, pixel / SIZE[0]), 1.0];
            let eye = [DISTANCE * -sin, 0.0, -DISTANCE * cos];
            let along: [f64; 3] = std::array::from_fn(|k| (0..3).map(|i| rotation[i][k] * ray[i]).sum());
            let hit = |z: f64| {
                let s = (z - eye[2]) / along[2];
                [eye[0] + s * along[0], eye[1] + s * along[1]]
            };
            let middle = -0.6 + 1.2 * frame as f64 / (frames - 1).max(1) as f64;
            let (square, wall) = (hit(0.0), hit(1.0));
            let on = (square[0] - middle).abs() < 0.3 && square[1].abs() < 0.3;
            let shade = (120.0 + 50.0 * (3.0 * wall[0]).sin() * (3.0 * wall[1]).cos()) as u8;
            color.extend(if on { [230, 120, 40] } else { [shade, shade, shade / 2] });
            label.push(u8::from(on));
        }
        let save = |kind: &str, data: &[u8], depth| {
            let path = folder.join(format!("{kind}/cam{number}/{frame:04}.png"));
            write_file(&path, &png(data, SIZE[0], SIZE[1], depth)?)
        };
        save("images", &color, ExtendedColorType::Rgb8)?;
        save("labels", &label, ExtendedColorType::L8)?;
    }
    let row = |i: usize| [rotation[i][0], rotation[i][1], rotation[i][2], if i == 2 { DISTANCE } else { 0.0 }];
    Ok(json!({
        "name": format!("cam{number}"), "width": SIZE[0], "height": SIZE[1], "fx": FOCAL, "fy": FOCAL, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2,
        "world_to_camera": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
        "images": format!("images/cam{number}/%04d.png"), "labels": format!("labels/cam{number}/%04d.png"),
        "frames": frames,
    }))
}
