//! From videos to a capture: frames, a common clock, poses and points, in one folder that training takes.
//!
//! Sound comes first, for it needs no pictures; then frames of the part that all cameras share are stored; motion guesses the
//! clocks that sound leaves open; clocks and poses are solved in turn until both rest. What was found stands in
//! [`corrections::FILE`], where it can be corrected and the same work run again.

mod clocks;
mod inputs;
mod poses;
mod report;
mod stored;

pub use inputs::find;
pub use report::{CameraReport, Report};

use crate::corrections::{self, Corrections};
use crate::video::{self, Selection, Source};
use crate::write::{self, Clip, Format, Pictures, Take};
use crate::{Error, ErrorKind, Result};
use splat4d_train::event::Progress;
use std::path::{Path, PathBuf};

/// Whether cameras stand still.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Rig {
    /// One video is of a moving camera, several are of fixed ones.
    #[default]
    Auto,
    /// Every camera stands still.
    Fixed,
    /// Every camera moves.
    Moving,
}

/// What is to be imported, and how.
#[derive(Clone, Debug)]
pub struct Request {
    /// Videos, folders of pictures, and folders of those.
    pub inputs: Vec<PathBuf>,
    /// The capture's folder.
    pub folder: PathBuf,
    /// Which frames, on the clock of the first camera, and how large.
    pub selection: Selection,
    /// Frames per second of folders of pictures.
    pub fps: f64,
    /// Whether cameras stand still.
    pub rig: Rig,
    /// Whether sound is used.
    pub sound: bool,
    /// How pictures are stored.
    pub format: Format,
    /// Two cameras and the metres between them.
    pub apart: Option<([String; 2], f64)>,
}

/// Frames of a moving camera that are placed at most: every one is a camera of its own to the solver.
const MOST_WALKING: usize = 150;

/// Share of the cameras that must be placed, and below which that is told: what people who reconstruct by
/// structure from motion go by.
const PLACED_LEAST: f64 = 0.7;
const PLACED_WARN: f64 = 0.9;
/// Points below which a reconstruction hangs on too little: a chessboard's.
const FEW_POINTS: usize = 50;

/// A camera on its way.
struct Camera {
    name: String,
    source: Box<dyn Source>,
}

/// Makes a capture. `stop` is asked between steps and between frames.
///
/// Errors: inputs that cannot be read, cameras that share no time, pictures that do not show one scene, no space; of kind
/// `Interrupted` where `stop` said so. What was stored until then is kept, and the same request goes on from there.
pub fn import(request: &Request, progress: &mut Progress<'_>, stop: &dyn Fn() -> bool) -> Result<Report> {
    request.selection.check()?;
    let folder = &request.folder;
    let mut cameras = open(request)?;
    let names: Vec<String> = cameras.iter().map(|c| c.name.clone()).collect();
    std::fs::create_dir_all(folder).map_err(|e| Error::io("the folder cannot be made", e).at(folder.display()))?;
    let mut corrections = Corrections::read(folder, &names)?;
    let mut wanted = corrections.cameras.iter().map(|c| c.wanted);
    cameras.retain(|_| wanted.next().unwrap_or(true));
    let mut told =
        corrections.cameras.iter().filter(|c| c.wanted).map(corrections::Camera::given_offset).collect::<Vec<_>>();
    told.resize(cameras.len(), None);
    if cameras.is_empty() {
        return Err(Error::input("all cameras are left out").at(folder.join(corrections::FILE).display()));
    }
    if let Some((pair, _)) = &request.apart {
        let unknown = pair.iter().find(|n| !cameras.iter().any(|c| c.name == **n));
        if let Some(name) = unknown {
            let known: Vec<&str> = cameras.iter().map(|c| c.name.as_str()).collect();
            return Err(Error::input(format!("there is no camera \"{name}\" whose distance is told"))
                .remedy(format!("Cameras are {}.", known.join(", "))));
        }
    }
    let moving = match request.rig {
        Rig::Auto => cameras.len() == 1,
        Rig::Fixed => false,
        Rig::Moving => true,
    };
    if cameras.len() == 1 && !moving {
        return Err(Error::input("one camera that stands still shows nothing from two sides")
            .remedy("Give the videos of all cameras, or --rig moving if this one was carried about."));
    }
    let mut report = Report::default();
    let heard =
        if request.sound && cameras.len() > 1 { clocks::by_sound(&cameras, progress, stop)? } else { Vec::new() };
    let clock = clocks::solve(&cameras, &heard, &told);
    let selections = clocks::shared(&cameras, &clock, &request.selection, &mut report)?;
    let clips: Vec<Clip<'_>> = cameras
        .iter()
        .zip(selections)
        .map(|(c, selection)| Clip { name: c.name.clone(), source: &*c.source, selection })
        .collect();
    let pictures = write::pictures(folder, &clips, request.format, progress, stop)?;
    for p in &pictures {
        if p.shots.is_empty() {
            return Err(Error::input("no frame lies in the part that was chosen")
                .at(format!("camera {}", p.name))
                .remedy("Choose another part, or leave the camera out."));
        }
    }
    let stopped = || Error::new(ErrorKind::Interrupted, "stopped").remedy("The same command goes on from there.");
    if stop() {
        return Err(stopped());
    }
    // From here on it can be corrected, even if no pose is found.
    corrections.write(folder)?;
    let stored = stored::Stored::new(folder, &pictures);
    let mut evidence = heard;
    if pictures.len() > 1 && !moving && clock.offsets.iter().any(Option::is_none) {
        evidence.extend(clocks::by_motion(&stored, &clock, progress, &mut report)?);
    }
    let clock = clocks::solve(&cameras, &evidence, &told);
    report.refused = clocks::refusals(&names_of(&pictures), &evidence, &clock);
    let solved = if moving {
        poses::walking(&stored, MOST_WALKING, progress)?
    } else {
        poses::standing(&stored, clock, &told, progress, stop)?
    };
    if stop() {
        return Err(stopped());
    }
    finish(request, &pictures, solved, &mut corrections, report)
}

fn names_of(pictures: &[Pictures]) -> Vec<&str> {
    pictures.iter().map(|p| p.name.as_str()).collect()
}

/// Refuses what would only waste the time of training: most cameras, or frames of a moving one, must have been placed.
fn check(solved: &poses::Solved, pictures: &[Pictures], report: &mut Report) -> Result<()> {
    let (placed, asked) = if solved.moving {
        let known = |s: &poses::Stand| s.poses.iter().flatten().count();
        let asked: usize = pictures.iter().map(|p| p.shots.len()).sum();
        (solved.cameras.iter().flatten().map(known).sum(), asked.min(MOST_WALKING))
    } else {
        (solved.cameras.iter().flatten().count(), solved.cameras.len())
    };
    let what = if solved.moving { "frames" } else { "cameras" };
    let share = placed as f64 / asked as f64;
    if placed < 2 || share < PLACED_LEAST {
        let reasons: Vec<String> = solved
            .cameras
            .iter()
            .zip(pictures)
            .filter_map(|(c, p)| c.as_ref().err().map(|why| format!("{}: {why}", p.name)))
            .collect();
        let reasons = if reasons.is_empty() { String::new() } else { format!(" ({})", reasons.join("; ")) };
        return Err(Error::input(format!("only {placed} of {asked} {what} could be placed{reasons}")).remedy(format!(
            "Film one scene from neighbouring places (at most 30 degrees apart), in focus and in light; or leave those out \
             (use = false in {}) and run the same command again.",
            corrections::FILE
        )));
    }
    if share < PLACED_WARN {
        report.guesses.push(format!("Only {placed} of {asked} {what} could be placed; the rest is left out."));
    }
    if solved.points.len() < FEW_POINTS {
        report.guesses.push(format!(
            "Only {} points hold the cameras together: look at the result before you trust it.",
            solved.points.len()
        ));
    }
    Ok(())
}

/// Opens all inputs; no file twice.
fn open(request: &Request) -> Result<Vec<Camera>> {
    let paths = find(&request.inputs)?;
    let mut sources = Vec::with_capacity(paths.len());
    let mut prints: Vec<(String, &Path)> = Vec::with_capacity(paths.len());
    for path in &paths {
        let source = video::open(path, request.fps)?;
        let print = source.fingerprint()?;
        if let Some((_, other)) = prints.iter().find(|(p, _)| *p == print) {
            return Err(Error::input(format!("it is the same as {}", other.display()))
                .at(path.display())
                .remedy("Give every camera once."));
        }
        prints.push((print, path));
        sources.push(source);
    }
    let wanted: Vec<&str> = sources.iter().map(|s| s.info().name.as_str()).collect();
    let names = write::camera_names(&wanted);
    Ok(names.into_iter().zip(sources).map(|(name, source)| Camera { name, source }).collect())
}

/// Writes points, capture, corrections and report.
fn finish(
    request: &Request,
    pictures: &[Pictures],
    mut solved: poses::Solved,
    corrections: &mut Corrections,
    mut report: Report,
) -> Result<Report> {
    let folder = &request.folder;
    match &request.apart {
        Some((pair, metres)) => solved.scale_to(pictures, pair, *metres)?,
        None => report.guesses.push(
            "The unit of length is the median distance of the cameras from what they see: tell two cameras' distance \
             (--apart A,B=METRES) for metres."
                .into(),
        ),
    }
    report.guesses.push("Upwards is what most cameras hold upwards.".into());
    let mut placed = Vec::new();
    for (k, (camera, p)) in solved.cameras.iter().zip(pictures).enumerate() {
        let row = CameraReport::of(p, camera, solved.offsets.get(k).and_then(Option::as_ref));
        report.cameras.push(row);
        if let Ok(stand) = camera {
            placed.push(stand.written(p, solved.offset(k)));
            if let Some(own) = corrections.cameras.iter_mut().find(|c| c.name == p.name) {
                if let Some(offset) = solved.offsets.get(k).and_then(Option::as_ref) {
                    own.found_offset(offset);
                }
                let last = placed.last().expect("it was just put there");
                own.found_lens(&last.intrinsics, &last.lens);
            }
        }
    }
    corrections.write(folder)?;
    report.write(folder)?;
    check(&solved, pictures, &mut report)?;
    let points = PathBuf::from("points.ply");
    splat4d_train::run::checkpoint::write_atomically(
        &folder.join(&points),
        &solved.cloud().to_ply("comment points of import"),
    )?;
    let take = Take { name: None, up: Some(solved.up), points: Some(points), ..Take::default() };
    report.capture = write::capture(folder, &take, &placed)?;
    report.points = solved.points.len();
    report.write(folder)?;
    Ok(report)
}
