//! `refined.json`: corrections of the capture's cameras that a run has learnt. Measurements of the scene apply them.

use super::checkpoint::write_atomically;
use crate::capture::Capture;
use crate::step::trainer::Trainer;
use crate::train_state::{moved, zoomed};
use crate::{Error, Result};
use serde_json::Value;
use splat4d::scene::Time;
use std::path::Path;

/// The file's name in a run.
pub(crate) const FILE: &str = "refined.json";

/// Writes the learnt corrections of cameras, if there are any.
pub(super) fn write(run: &Path, trainer: &Trainer<'_>, capture: &Capture) -> Result<()> {
    let Some(corrections) = &trainer.train_state.corrections else { return Ok(()) };
    let name = |i: usize| {
        let frame = &capture.frames[capture.train[i]];
        let camera = &capture.cameras[frame.camera];
        (camera.name.clone(), (!camera.fixed).then_some(frame.index))
    };
    let text = format!("{:#}\n", corrections.report(&name));
    write_atomically(&run.join(FILE), text.as_bytes())
}

/// Learnt corrections of a run's cameras; `None`: it did not learn any. Errors: damage.
pub fn read(run: &Path) -> Result<Option<Value>> {
    let path = run.join(FILE);
    if !path.is_file() {
        return Ok(None);
    }
    let text = crate::files::read_text(&path)?;
    let damage = |what: String| {
        Error::input(what)
            .at(path.display())
            .remedy("Continue the run with `train --resume`, which writes it again, or delete it to measure without it")
    };
    let value: Value = serde_json::from_str(&text).map_err(|e| damage(format!("it is not JSON: {e}")))?;
    let sound = value["cameras"].as_array().is_some_and(|rows| rows.iter().all(|row| correction(row).is_some()));
    if sound { Ok(Some(value)) } else { Err(damage("invalid list of corrections of cameras".into())) }
}

/// A row of the list.
struct Correction<'a> {
    camera: &'a str,
    /// Number of its image, of a camera that moves.
    picture: Option<u64>,
    twist: [f64; 6],
    seconds: f64,
    /// Share by which the focal length is longer.
    zoom: f64,
}

fn correction(row: &Value) -> Option<Correction<'_>> {
    let twist: Vec<f64> = row["twist"].as_array()?.iter().filter_map(Value::as_f64).collect();
    Some(Correction {
        camera: row["camera"].as_str()?,
        picture: row["frame"].as_u64(),
        twist: twist.try_into().ok()?,
        seconds: row["offset"].as_f64()?,
        // Runs of older versions have none.
        zoom: row.get("focal").map_or(Some(0.0), Value::as_f64)?,
    })
}

/// Moves the capture's cameras and clocks to where the run has learnt that they are: those of training, and held-out
/// images
/// of the same cameras as far as they share them.
///
/// Errors: those of [`read`].
pub fn apply(capture: &mut Capture, run: &Path) -> Result<()> {
    let Some(value) = read(run)? else { return Ok(()) };
    let rows: Vec<_> = value["cameras"].as_array().into_iter().flatten().filter_map(correction).collect();
    for frame in &mut capture.frames {
        let camera = &capture.cameras[frame.camera].name;
        let mut of_camera = rows.iter().filter(|row| row.camera == camera);
        if let Some(row) = of_camera.clone().find(|row| row.picture.is_none_or(|index| index == frame.index as u64)) {
            frame.view.cam_from_world = moved(&frame.view.cam_from_world, row.twist);
        }
        if let Some(row) = of_camera.next() {
            frame.time = Time(frame.time.0 + row.seconds);
            frame.view.intrinsics = zoomed(&frame.view.intrinsics, row.zoom);
        }
    }
    Ok(())
}
