//! `.ftgs.ply` of FreeTimeGsVanilla, version 1: 3DGS with a time, a duration and a velocity each
//! ([`freetime`](crate::format::freetime)).
//!
//! To the properties of a plain file come time, log_duration (clips) and velocity_0..2 (units per clip), all f32;
//! comments state `ftgs_version`, `n_frames`, `use_velocity`. Our files specify clip and frame rate in a further
//! comment.
//! Source: OpsiClear-4DGS/FreeTimeGsVanilla, README and player.

use super::header::{Element, Header};
use super::stg::{CLOCK, clock};
use super::{F_REST_COUNTS, GEOMETRY_NAMES, NORMAL_NAMES, rows};
use crate::format::dialect::{Dialect, Opened, WriteOptions, Writer, Y_DOWN};
use crate::format::freetime::{self, Moves, SHORTEST};
use crate::format::kinematic::{Clock, rows as moving_rows};
use crate::format::warnings::Warnings;
use crate::layers::Scene;
use crate::scene::SH;
use crate::scene::time::DEFAULT_FPS;
use crate::{Error, ErrorKind, Result};
use std::f64::consts::SQRT_2;
use std::io::Write;

/// Moving .ply of FreeTimeGS.
pub(crate) const FTGS: Dialect = Dialect {
    name: "FreeTimeGS .ply",
    ending: ".ftgs.ply",
    up: Y_DOWN,
    moves: true,
    mark: Some(is_ftgs),
    read: read_ftgs,
    writer: Writer::Moving(|scene, options, mut out| write_ftgs(scene, options, &mut out)),
    world: false,
    fixed_axes: false,
    states_up: false,
};

/// Properties in addition to those of a plain file.
const EXTRA: [&str; 5] = ["time", "log_duration", "velocity_0", "velocity_1", "velocity_2"];
/// Curvature (units) and rotation (radians) over a lifespan from which it counts as lost.
const VISIBLE: f64 = 1e-4;
/// Least opacity that players of the format render.
const FLOOR: &str = "opacity_floor 0.0001";

/// Whether a .ply file holds Gaussians of FreeTimeGS. False for anything unreadable.
fn is_ftgs(bytes: &[u8]) -> bool {
    let ftgs = |e: &Element| e.name == "vertex" && EXTRA.iter().all(|name| e.find(name).is_some());
    Header::read(bytes).is_ok_and(|h| h.elements.iter().any(ftgs))
}

fn read_ftgs(bytes: &[u8]) -> Result<Opened> {
    let (params, info) = super::read(bytes)?;
    let header = Header::read(bytes)?;
    let vertex = header.elements.iter().find(|e| e.name == "vertex").expect("it was read");
    let [found] = rows::find(&header, bytes, ["vertex"])?;
    let found = found.expect("the element was read");
    let columns = EXTRA.map(|name| vertex.find(name));
    let [Some(time), Some(duration), Some(vx), Some(vy), Some(vz)] = columns else {
        return Err(Error::input(format!("Gaussians of FreeTimeGS have the properties {}", EXTRA.join(", ")))
            .remedy("Export the file again with the program that trained it."));
    };
    let number = |key: &str| header.comments.iter().find_map(|c| c.strip_prefix(key)?.trim().parse::<usize>().ok());
    let column = |c: usize| (0..found.len()).map(|row| found.get(row, c) as f32).collect::<Vec<f32>>();
    let moves = Moves {
        times: column(time),
        log_durations: column(duration),
        velocities: match number("use_velocity") {
            Some(0) => Vec::new(),
            _ => (0..found.len()).flat_map(|row| [vx, vy, vz].map(|c| found.get(row, c) as f32)).collect(),
        },
    };
    let mut warnings = Warnings::default();
    info.assumed.into_iter().for_each(|sentence| warnings.add(sentence));
    let own = header.comments.iter().find_map(|c| clock(c));
    let seconds = match own {
        Some(own) => span(own.clip),
        None => freetime::duration(number("n_frames"), &mut warnings),
    };
    let mut scene = freetime::scene(&params, &moves, seconds)?;
    if let Some(own) = own {
        let life = crate::scene::LIFE;
        let table = &mut scene.layers[0].params[life];
        (0..table.rows()).for_each(|row| table.add(row, 0, [own.clip[0] as f32]));
        (scene.clip, scene.fps) = (own.clip, own.fps);
    }
    Ok(Opened::from((scene, warnings)))
}

/// Seconds from the file's 0 to its 1.
fn span(clip: [f64; 2]) -> f64 {
    if clip[1] > clip[0] { clip[1] - clip[0] } else { 1.0 }
}

/// Writes a moving scene. Errors: the format cannot express its motion, and fitting is not allowed; the sink's.
fn write_ftgs(scene: &Scene<f32>, options: &WriteOptions, out: &mut impl Write) -> Result<Warnings> {
    let mut warnings = Warnings::default();
    let fps = if scene.fps > 0.0 { scene.fps } else { DEFAULT_FPS };
    let clip = scene.clip;
    let clock = Clock { clip, fps, duration: span(clip) };
    let rows = moving_rows(scene, clock, "FTGS", options.exact, &mut warnings)?;
    // This format has spherical harmonics.
    warnings.drop("view dependence");
    let lives = |m: &crate::format::kinematic::Moving| (m.width / SQRT_2).clamp(SHORTEST, 1.0);
    let length = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let curved =
        rows.iter().filter(|m| length(m.path[1]) * lives(m).powi(2) + length(m.path[2]) * lives(m).powi(3) > VISIBLE);
    let turning = rows.iter().filter(|m| 2.0 * m.turn.iter().map(|x| x * x).sum::<f64>().sqrt() * lives(m) > VISIBLE);
    let brief = rows.iter().filter(|m| m.width / SQRT_2 < SHORTEST);
    let [curved, turning, brief] = [curved.count(), turning.count(), brief.count()];
    if options.exact && curved + turning + brief > 0 {
        let what = format!(
            "FTGS stores linear paths, one rotation, and lifespans of at least 0.02 clips: {curved} paths curve, \
            {turning} rotate, {brief} are shorter"
        );
        return Err(Error::new(ErrorKind::Unsupported, what).remedy("Leave --exact out to fit them, or write .s4d."));
    }
    warnings.counted(curved, rows.len(), "have curved paths: the tangents at the middle of their lifespans are stored");
    warnings.counted(turning, rows.len(), "rotate: the rotation at the middle of their lifespans is stored");
    warnings.counted(brief, rows.len(), "have lifespans below 0.02 of the clip, the shortest that players support");
    let absorbed: Vec<_> = scene.layers.iter().map(|layer| layer.with_frame_absorbed()).collect();
    let width = scene.layers.iter().map(|l| l.params[SH].width()).max().unwrap_or(3);
    let rest = F_REST_COUNTS.into_iter().find(|n| n + 3 >= width).unwrap_or(0);
    let frames = (span(clip) * fps).round() as usize + 1;
    let mut text = format!(
        "ply\nformat binary_little_endian 1.0\ncomment ftgs_version 1\ncomment time_units normalized\n\
         comment sh_degree {}\ncomment use_velocity 1\ncomment min_duration {SHORTEST}\ncomment {FLOOR}\n\
         comment n_frames {frames}\ncomment {CLOCK} {} {} fps {fps}\nelement vertex {}\n",
        (rest / 3 + 1).isqrt() - 1,
        clip[0],
        clip[1],
        rows.len()
    );
    let names = GEOMETRY_NAMES[..3].iter().chain(&NORMAL_NAMES).map(|n| (*n).to_owned());
    let names = names.chain((0..3).map(|i| format!("f_dc_{i}"))).chain((0..rest).map(|i| format!("f_rest_{i}")));
    let names = names.chain(["opacity".to_owned()]).chain((0..3).map(|i| format!("scale_{i}")));
    let names = names.chain((0..4).map(|i| format!("rot_{i}"))).chain(EXTRA.map(str::to_owned));
    names.for_each(|name| text.push_str(&format!("property float {name}\n")));
    text.push_str("end_header\n");
    let mut bytes = text.into_bytes();
    for m in &rows {
        let mut put = |x: f32| bytes.extend(x.to_le_bytes());
        m.mean.iter().for_each(|x| put(*x as f32));
        NORMAL_NAMES.iter().for_each(|_| put(0.0));
        m.dc.iter().for_each(|x| put(*x));
        let sh = &absorbed[m.source[0]].params[SH];
        for c in 0..3 {
            for k in 1..=rest / 3 {
                put(if 3 * k < sh.width() { sh.get(m.source[1], 3 * k + c) } else { 0.0 });
            }
        }
        put(m.opacity_logit);
        m.log_scale.iter().for_each(|x| put(*x));
        m.quat.iter().for_each(|x| put(*x as f32));
        put(m.center as f32);
        put((m.width / SQRT_2).max(SHORTEST).ln() as f32);
        m.path[0].iter().for_each(|x| put(*x as f32));
    }
    out.write_all(&bytes).map_err(|e| Error::io("the Gaussians could not be written", e))?;
    Ok(warnings)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::kinematic::tests::{apart, moving};
    use crate::format::ply;
    use crate::scene::{LifeKind, Params};

    fn written(scene: &Scene<f32>, exact: bool) -> Result<(Vec<u8>, Warnings)> {
        let mut file = Vec::new();
        let warnings = write_ftgs(scene, &WriteOptions { exact, ..WriteOptions::default() }, &mut file)?;
        Ok((file, warnings))
    }

    #[test]
    fn straight_paths_round_trip_exactly() {
        for life in [LifeKind::GaussHalf, LifeKind::GaussOne] {
            let mut scene = moving(200, life, 1, false);
            let sh = crate::format::samples::gaussians(200, 9)[SH].clone();
            scene.layers[0].params[SH] = sh;
            let (file, warnings) = written(&scene, true).unwrap();
            assert!(is_ftgs(&file) && warnings.lines().is_empty(), "{warnings:?}");
            assert_eq!(Dialect::of(&file), Some(FTGS));
            let back = FTGS.open(&file).unwrap();
            assert!(back.warnings.lines().is_empty(), "{:?}", back.warnings);
            assert_eq!((back.scene.clip, back.scene.fps), (scene.clip, scene.fps));
            let [mean, cov, opacity] = apart(&scene, &back.scene);
            assert!(mean < 1e-4 && cov < 1e-4 && opacity < 1e-5, "{life:?}: {mean} {cov} {opacity}");
            assert_eq!(back.scene.layers[0].params[SH].width(), 27);
            assert_eq!(back.scene.layers[0].params[SH].get(3, 20), scene.layers[0].params[SH].get(3, 20));
        }
    }

    #[test]
    fn unsupported_features_are_fitted_or_refused() {
        let scene = moving(50, LifeKind::GaussHalf, 3, true);
        let said = written(&scene, true).unwrap_err().to_string();
        assert!(said.contains("paths curve") && said.contains("rotate"), "{said}");
        let (_, warnings) = written(&scene, false).unwrap();
        let said = warnings.lines().join("\n");
        assert!(said.contains("curved paths") && said.contains("rotate"), "{said}");
    }

    #[test]
    fn files_of_the_trainer_are_read() {
        let p: Params = crate::format::samples::gaussians(4, 4);
        let mut plain = Vec::new();
        ply::write(&p, &mut plain).unwrap();
        let end = plain.windows(11).position(|w| w == b"end_header\n").unwrap();
        let head = String::from_utf8(plain[..end].to_vec()).unwrap();
        let head =
            head.replace("element", "comment ftgs_version 1\ncomment n_frames 31\ncomment use_velocity 1\nelement");
        let extra: String = EXTRA.iter().map(|n| format!("property float {n}\n")).collect();
        let mut file = format!("{head}{extra}end_header\n").into_bytes();
        for row in plain[end + 11..].chunks_exact((plain.len() - end - 11) / 4) {
            file.extend(row);
            [0.5f32, 0.0, 3.0, 0.0, 0.0].iter().for_each(|x| file.extend(x.to_le_bytes()));
        }
        let opened = FTGS.open(&file).unwrap();
        assert_eq!(opened.scene.clip, [0.0, 1.0]);
        assert!(opened.warnings.lines()[0].contains("31 frames"), "{:?}", opened.warnings);
        let now = crate::layers::freeze(&opened.scene, crate::scene::Time(0.75)).unwrap();
        let (a, b) = (p[crate::scene::GEOMETRY].get(2, 0), now[crate::scene::GEOMETRY].get(2, 0));
        assert!((b - a - 0.75).abs() < 1e-5, "{a} {b}");
    }
}
