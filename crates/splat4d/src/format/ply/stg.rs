//! The `.ply` of Spacetime Gaussians (STG, "lite"): moving Gaussians, all f32.
//!
//! x y z, trbf_center, trbf_scale (log of s), nx ny nz, motion_0..8 (units per clip, clip², clip³), f_dc_0..2 (**plain
//! RGB**, not SH coefficients), opacity (logit), scale_0..2 (log), rot_0..3 (wxyz), omega_0..3. The fade is exp(−((t −
//! centre)/s)²), no ½; t runs from 0 to 1, and 1 is one frame behind the last. The full model's f_t_* feed a network
//! that is not in the file. Our files specify clip and frame rate in a comment.
//! Source: oppo-us-research/SpacetimeGaussians (MIT), splaTV's importer.

use super::header::{Element, Header, broken};
use super::{NORMAL_NAMES, rows};
use crate::Error;
use crate::Result;
use crate::format::bytes::SH_C0;
use crate::format::dialect::{Dialect, Opened, WriteOptions, Writer, Y_DOWN};
use crate::format::kinematic::{Clock, Moving, rows as moving_rows, scene};
use crate::format::warnings::Warnings;
use crate::layers::Scene;
use std::io::Write;

/// Moving .ply of Spacetime Gaussians.
pub const STG: Dialect = Dialect {
    name: "Spacetime Gaussians .ply",
    ending: ".stg.ply",
    up: Y_DOWN,
    moves: true,
    mark: Some(is_stg),
    read: |bytes| read_stg(bytes).map(Opened::from),
    writer: Writer::Moving(|scene, options, mut out| write_stg(scene, options, &mut out)),
    world: false,
    fixed_axes: false,
    states_up: false,
};

/// Numbers of a row as [`names`] lists them.
const WIDTH: usize = 32;
/// Offsets of groups in a row.
const TRBF: usize = 3;
const MOTION: usize = 8;
const COLOR: usize = 17;
const OPACITY: usize = 20;
const SCALE: usize = 21;
const ROTATION: usize = 24;
const OMEGA: usize = 28;
/// Comment in our files that gives their clock: `comment splat4d clip FIRST LAST fps N`.
pub(super) const CLOCK: &str = "splat4d clip";

/// The properties of a row, in the order of the file.
fn names() -> [String; WIDTH] {
    std::array::from_fn(|i| match i {
        0..TRBF => ["x", "y", "z"][i].into(),
        TRBF => "trbf_center".into(),
        4 => "trbf_scale".into(),
        5..MOTION => NORMAL_NAMES[i - 5].into(),
        MOTION..COLOR => format!("motion_{}", i - MOTION),
        COLOR..OPACITY => format!("f_dc_{}", i - COLOR),
        OPACITY => "opacity".into(),
        SCALE..ROTATION => format!("scale_{}", i - SCALE),
        ROTATION..OMEGA => format!("rot_{}", i - ROTATION),
        _ => format!("omega_{}", i - OMEGA),
    })
}

/// Whether a .ply file holds Spacetime Gaussians. False for anything unreadable.
pub(crate) fn is_stg(bytes: &[u8]) -> bool {
    let stg = |e: &Element| e.name == "vertex" && e.find("trbf_center").is_some() && e.find("motion_0").is_some();
    Header::read(bytes).is_ok_and(|h| h.elements.iter().any(stg))
}

/// Reads a moving scene. Where no comment of ours states the clock, one second is assumed.
///
/// Errors: not a PLY file, truncated, or a property is missing.
pub(crate) fn read_stg(bytes: &[u8]) -> Result<(Scene<f32>, Warnings)> {
    let mut warnings = Warnings::default();
    let header = Header::read(bytes)?;
    let Some(vertex) = header.elements.iter().find(|e| e.name == "vertex") else {
        return Err(broken("the file has no element `vertex`"));
    };
    // Normals hold zeros, and some writers leave them out.
    let names = names();
    let columns: Vec<Option<usize>> = names.iter().map(|n| vertex.find(n)).collect();
    let missing: Vec<&str> = (0..WIDTH)
        .filter(|i| columns[*i].is_none() && !NORMAL_NAMES.contains(&names[*i].as_str()))
        .map(|i| names[i].as_str())
        .collect();
    if !missing.is_empty() {
        return Err(Error::input(format!("the Spacetime Gaussians lack the properties {}", missing.join(", ")))
            .remedy("Export the file again with the program that trained it."));
    }
    if vertex.properties.iter().any(|p| p.name.starts_with("f_t_")) {
        warnings.add("the colours come from STG's full model, whose network is not in the file: only its base is read");
    }
    let [rows] = rows::find(&header, bytes, ["vertex"])?;
    let rows = rows.expect("the element was found above");
    let clock = header.comments.iter().find_map(|c| clock(c)).unwrap_or_else(|| Clock::assumed(&mut warnings));
    let mut sound = Vec::with_capacity(rows.len());
    for row in 0..rows.len() {
        let x: [f64; WIDTH] = std::array::from_fn(|i| columns[i].map_or(0.0, |c| rows.get(row, c)));
        if x.iter().all(|x| x.is_finite()) {
            sound.push(unpack(&x));
        }
    }
    warnings.counted(rows.len() - sound.len(), rows.len(), "contain NaN or infinity and were left out");
    Ok((scene(&sound, clock)?, warnings))
}

/// Reads the comment that states the clock.
pub(super) fn clock(comment: &str) -> Option<Clock> {
    let mut words = comment.strip_prefix(CLOCK)?.split_ascii_whitespace();
    let mut number = || words.next()?.parse::<f64>().ok();
    let clip = [number()?, number()?];
    (words.next() == Some("fps")).then_some(())?;
    let fps = words.next()?.parse::<f64>().ok()?;
    Clock::stated(clip, fps, clip[1] - clip[0] + 1.0 / fps)
}

fn unpack(x: &[f64; WIDTH]) -> Moving {
    let f32s = |at: usize| std::array::from_fn(|k| x[at + k] as f32);
    let color: [f32; 3] = f32s(COLOR);
    Moving {
        mean: [x[0], x[1], x[2]],
        quat: std::array::from_fn(|k| x[ROTATION + k]),
        log_scale: f32s(SCALE),
        opacity_logit: x[OPACITY] as f32,
        dc: color.map(|c| (c - 0.5) / SH_C0),
        path: std::array::from_fn(|k| std::array::from_fn(|axis| x[MOTION + 3 * k + axis])),
        turn: std::array::from_fn(|k| x[OMEGA + k]),
        center: x[TRBF],
        width: x[TRBF + 1].clamp(-100.0, 100.0).exp(),
        source: [0; 2],
    }
}

/// Writes a moving scene. Errors: the format cannot express its motion or lifespans, and fitting is not allowed; the
/// sink's.
pub fn write_stg(scene: &Scene<f32>, options: &WriteOptions, out: &mut impl Write) -> Result<Warnings> {
    let mut warnings = Warnings::default();
    let fps = if scene.fps > 0.0 { scene.fps } else { crate::scene::time::DEFAULT_FPS };
    let clip = scene.clip;
    let clock = Clock { clip, fps, duration: (clip[1] - clip[0]).max(0.0) + 1.0 / fps };
    let rows = moving_rows(scene, clock, "STG's .ply", options.exact, &mut warnings)?;
    let mut text = format!(
        "ply\nformat binary_little_endian 1.0\ncomment {CLOCK} {} {} fps {fps}\nelement vertex {}\n",
        clip[0],
        clip[1],
        rows.len()
    );
    names().iter().for_each(|name| text.push_str(&format!("property float {name}\n")));
    text.push_str("end_header\n");
    let mut bytes = text.into_bytes();
    for m in &rows {
        let mut x = [0.0; WIDTH];
        let mut put = |at: usize, numbers: &[f64]| x[at..at + numbers.len()].copy_from_slice(numbers);
        put(0, &m.mean);
        put(TRBF, &[m.center, m.width.ln()]);
        put(MOTION, m.path.as_flattened());
        put(COLOR, &m.dc.map(|dc| f64::from(0.5 + SH_C0 * dc)));
        put(OPACITY, &[f64::from(m.opacity_logit)]);
        put(SCALE, &m.log_scale.map(f64::from));
        put(ROTATION, &m.quat);
        put(OMEGA, &m.turn);
        x.iter().for_each(|x| bytes.extend((*x as f32).to_le_bytes()));
    }
    out.write_all(&bytes).map_err(|e| Error::io("the Gaussians could not be written", e))?;
    Ok(warnings)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::kinematic::tests::{apart, moving};
    use crate::format::mutate::mutants;
    use crate::layers::Evaluation;
    use crate::scene::{LifeKind, Time};

    #[test]
    fn a_dynamic_scene_round_trips_in_f32() {
        for life in [LifeKind::Infinite, LifeKind::GaussHalf, LifeKind::GaussOne] {
            let scene = moving(300, life, 3, true);
            let mut file = Vec::new();
            write_stg(&scene, &WriteOptions::default(), &mut file).unwrap();
            assert!(is_stg(&file));
            let (back, warnings) = read_stg(&file).unwrap();
            assert_eq!((back.len(), back.clip, back.fps), (300, scene.clip, scene.fps));
            assert!(warnings.lines().is_empty(), "{warnings:?}");
            let [mean, cov, opacity] = apart(&scene, &back);
            assert!(mean < 1e-4 && cov < 1e-4 && opacity < 1e-5, "{life:?}: {mean} {cov} {opacity}");
        }
    }

    /// A text file with the names of the paper's code, without normals.
    #[test]
    fn a_foreign_file_is_read() {
        let names = names();
        let there: Vec<&String> = names.iter().filter(|n| !NORMAL_NAMES.contains(&n.as_str())).collect();
        let mut text = String::from("ply\nformat ascii 1.0\nelement vertex 1\n");
        there.iter().rev().for_each(|n| text.push_str(&format!("property float {n}\n")));
        text.push_str("property float f_t_0\nend_header\n");
        for name in there.iter().rev() {
            let value = match name.as_str() {
                "trbf_center" => "0.5",
                "trbf_scale" => "-0.6931472", // s = 0.5
                "x" | "rot_0" | "f_dc_1" => "1",
                "motion_0" | "motion_3" => "4",
                _ => "0",
            };
            text.push_str(&format!("{value} "));
        }
        text.push_str("9\n");
        assert!(is_stg(text.as_bytes()));
        let (scene, warnings) = read_stg(text.as_bytes()).unwrap();
        let said = warnings.lines().join("\n");
        assert!(said.contains("one second") && said.contains("network"), "{said}");
        let mut instant = Evaluation::default();
        scene.at(Time(0.75), &mut instant);
        let row = instant.tape(0).out().read::<10>(0, 0);
        // x = 1 + 4Δ + 4Δ² at Δ = ¼; opacity ½·exp(−(¼/½)²).
        assert!((row[0] - 2.25).abs() < 1e-5 && (row[9] - 0.5 * (-0.25f32).exp()).abs() < 1e-6, "{row:?}");
        let dc = scene.layers[0].params[crate::scene::SH].read::<3>(0, 0);
        assert!((0.5 + SH_C0 * dc[1] - 1.0).abs() < 1e-6 && (0.5 + SH_C0 * dc[0]).abs() < 1e-6, "plain RGB: {dc:?}");
    }

    #[test]
    fn damaged_files_never_panic() {
        let mut file = Vec::new();
        write_stg(&moving(10, LifeKind::GaussOne, 3, true), &WriteOptions::default(), &mut file).unwrap();
        for mutant in mutants(&file, 1500, "stg") {
            let _ = is_stg(&mutant);
            if let Ok((scene, _)) = read_stg(&mutant) {
                scene.at(Time(0.1), &mut Evaluation::default());
            }
        }
        let message = read_stg(&file[..file.len() - 1]).unwrap_err().to_string();
        assert!(message.contains("ends") || message.contains("bytes"), "{message}");
    }
}
