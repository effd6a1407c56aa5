//! `refined.json`: corrections of the capture's cameras that a run has learnt. Measurements of the scene apply them.

use super::checkpoint::write_atomically;
use crate::capture::{Capture, Frame};
use crate::step::trainer::Trainer;
use crate::train_state::{EXPOSURE_COLUMNS as COLUMNS, Origin, TrainState, moved, zoomed};
use crate::{Error, Result};
use serde_json::{Value, json};
use splat4d::scene::Time;
use std::path::Path;

/// The file's name in a run.
pub(crate) const FILE: &str = "refined.json";

/// Writes the learnt corrections of cameras, and the exposures of photos, if there are any.
pub(super) fn write(run: &Path, trainer: &Trainer<'_>, capture: &Capture) -> Result<()> {
    let TrainState { corrections, exposure, .. } = &trainer.train_state;
    let photos = exposure.as_ref().filter(|_| capture.of_photos());
    if corrections.is_none() && photos.is_none() {
        return Ok(());
    }
    let name = |i: usize| {
        let frame = &capture.frames[capture.train[i]];
        let camera = &capture.cameras[frame.camera];
        (camera.name.clone(), (!camera.fixed).then_some(frame.index))
    };
    let mut value = match corrections {
        Some(corrections) => corrections.report(&name),
        None => json!({ "poses": false, "focal": false, "lens": false, "times": false, "cameras": [] }),
    };
    if let Some(exposure) = photos {
        let row = |&rig: &usize| (capture.cameras[rig].name.clone(), json!(exposure.response(rig, Time(0.0))));
        value["exposures"] = exposure.trained().iter().map(row).collect::<Value>();
    }
    write_atomically(&run.join(FILE), format!("{value:#}\n").as_bytes())
}

/// Exposures of a capture's frames, in its order, each as a colour matrix without the identity and an offset: photos that a run was
/// trained on have the one that it learnt; others have a share of the mean of their neighbours', because a camera that is carried on meets
/// similar light. Empty: none was learnt.
///
/// Errors: those of [`read`].
pub(crate) fn exposures(capture: &Capture, run: &Path) -> Result<Vec<[f32; COLUMNS]>> {
    let Some(value) = read(run)? else { return Ok(Vec::new()) };
    let Some(rows) = value["exposures"].as_object() else { return Ok(Vec::new()) };
    let learnt = |frame: &Frame| {
        let row: Vec<f32> = rows
            .get(&capture.cameras[frame.camera].name)?
            .as_array()?
            .iter()
            .filter_map(Value::as_f64)
            .map(|x| x as f32)
            .collect();
        row.try_into().ok()
    };
    Ok(complete(&capture.frames.iter().map(learnt).collect::<Vec<_>>()))
}

/// Fills gaps by a share of the mean of the nearest rows before and after. The share is the one with which this predicts the known rows best, each
/// from the others: near 1 where neighbours are alike, 0 where they are not.
fn complete(rows: &[Option<[f32; COLUMNS]>]) -> Vec<[f32; COLUMNS]> {
    let mean = |i: usize| {
        let sides = [rows[..i].iter().rev().flatten().next(), rows[i + 1..].iter().flatten().next()];
        let known = sides.into_iter().flatten();
        let count = known.clone().count().max(1) as f32;
        known.fold([0.0; COLUMNS], |sum, row| std::array::from_fn(|k| sum[k] + row[k] / count))
    };
    let dot = |a: &[f32; COLUMNS], b: &[f32; COLUMNS]| a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum::<f64>();
    let (mut along, mut length) = (0.0, 0.0);
    for (i, row) in rows.iter().enumerate() {
        let Some(row) = row else { continue };
        let predicted = mean(i);
        along += dot(&predicted, row);
        length += dot(&predicted, &predicted);
    }
    let share = (along / length.max(f64::MIN_POSITIVE)).clamp(0.0, 1.0) as f32;
    rows.iter().enumerate().map(|(i, row)| row.unwrap_or_else(|| mean(i).map(|x| share * x))).collect()
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

/// Gives a run that began from another one's scene the corrections of cameras that the other one learnt. Exposures that the run itself has
/// learnt stay.
///
/// Errors: those of [`read`]; the file cannot be written.
pub(crate) fn inherit(run: &Path, from: &Path) -> Result<()> {
    let Some(mut value) = read(from)? else { return Ok(()) };
    if let Some(own) = read(run)?.and_then(|own| own.get("exposures").cloned()) {
        value["exposures"] = own;
    }
    write_atomically(&run.join(FILE), format!("{value:#}\n").as_bytes())
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
    /// Distortion that remains.
    lens: [f64; 2],
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
        lens: match row.get("lens") {
            None => [0.0; 2],
            Some(lens) => [lens[0].as_f64()?, lens[1].as_f64()?],
        },
    })
}

/// Moves the capture's cameras and clocks to where the run has learnt that they are: those of training, and held-out
/// images of the same cameras as far as they share them. Cameras that state the same lens as a training camera have
/// its distortion.
///
/// Errors: those of [`read`].
pub fn apply(capture: &mut Capture, run: &Path) -> Result<()> {
    let Some(value) = read(run)? else { return Ok(()) };
    let rows: Vec<_> = value["cameras"].as_array().into_iter().flatten().filter_map(correction).collect();
    let mut lenses: Vec<(usize, [f64; 2])> = Vec::new();
    for (i, frame) in capture.frames.iter().enumerate() {
        let row = rows.iter().find(|row| row.camera == capture.cameras[frame.camera].name);
        let known = |&(other, _): &(usize, _)| Origin::of(frame, true).alike(&Origin::of(&capture.frames[other], true));
        if let Some(row) = row.filter(|row| row.lens != [0.0; 2] && !lenses.iter().any(known)) {
            lenses.push((i, row.lens));
        }
    }
    let residuals: Vec<[f64; 2]> = (capture.frames.iter())
        .map(|frame| {
            let of = |(other, _): &&(usize, [f64; 2])| {
                Origin::of(frame, true).alike(&Origin::of(&capture.frames[*other], true))
            };
            lenses.iter().find(of).map_or([0.0; 2], |(_, lens)| *lens)
        })
        .collect();
    for (frame, residual) in capture.frames.iter_mut().zip(residuals) {
        frame.residual = residual;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::open::OpenCapture;
    use crate::run::plan;
    use crate::run::tests::{Place, recipe};
    use splat4d::scene::Lens;
    use std::sync::Arc;

    /// The lens of the training cameras is that of a held-out one that states the same, and not of one that states another.
    #[test]
    fn a_learnt_lens_is_that_of_all_cameras_that_state_it() {
        let place = Place::new();
        let recipe = recipe(&["hold_out=camera=1", "max_frames=1", "refine.lens=true"]);
        let mut capture = Capture::clone(&place.open(&recipe));
        let opened = OpenCapture::new(Arc::new(capture.clone()), &recipe).unwrap();
        let scene = opened.initial_scene(&recipe, &plan(&capture, &recipe)).unwrap();
        let mut trainer = opened.trainer(&recipe, &plan(&capture, &recipe), scene).unwrap();
        trainer.train_state.corrections.as_mut().unwrap().set_lens(0, [0.02, -0.01]);
        let folder = place.run("lens");
        std::fs::create_dir_all(&folder).unwrap();
        write(&folder, &trainer, &capture).unwrap();
        let held = capture.held[0];
        let r2 = crate::train_state::corner(&capture.frames[0].view);
        for other in [false, true] {
            if other {
                capture.frames[held].source.lens =
                    Lens::Brown { k: [0.1, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2], s: [0.0; 4] };
            }
            apply(&mut capture, &folder).unwrap();
            for (i, frame) in capture.frames.iter().enumerate() {
                let [a, b] = if other && i == held { [0.0; 2] } else { [0.02 / r2, -0.01 / (r2 * r2)] };
                let [k1, k2] = frame.residual;
                assert!((k1 - a).abs() < 1e-6 && (k2 - b).abs() < 1e-6, "frame {i}: {:?}", frame.residual);
            }
        }
    }

    /// Twelve photos in a row, of which the exposure changes slowly: the third and the last were held out.
    #[test]
    fn held_out_photos_have_their_neighbours_exposure() {
        let of = |i: usize| std::array::from_fn(|k| (0.4 * i as f32).sin() * (k + 1) as f32 * 0.01);
        let learnt: Vec<_> = (0..12).map(|i| (i % 9 != 2).then(|| of(i))).collect();
        let all = complete(&learnt);
        for (i, row) in all.iter().enumerate() {
            // The last one has a neighbour on one side only.
            let near = if learnt[i].is_some() {
                0.0
            } else if i == 2 {
                0.02
            } else {
                0.04
            };
            for (k, (got, truth)) in row.iter().zip(of(i)).enumerate() {
                assert!((got - truth).abs() <= near, "photo {i}, column {k}: {got}, {truth}");
            }
        }
        assert!(all[2][11] / of(2)[11] > 0.8, "{:?}", all[2]);
    }

    #[test]
    fn neighbours_that_are_not_alike_predict_nothing() {
        let learnt: Vec<_> =
            (0..12).map(|i| (i % 5 != 2).then_some([if i % 2 == 0 { 0.1 } else { -0.1 }; COLUMNS])).collect();
        let all = complete(&learnt);
        assert_eq!(all[2], [0.0; COLUMNS]);
        assert_eq!(complete(&[None, None]), vec![[0.0; COLUMNS]; 2], "nothing was learnt");
    }
}
