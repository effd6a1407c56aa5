//! The whole import, from videos to a capture folder.
//!
//! Sound is used first because it needs no images. Then frames of the shared time span are stored, motion guesses the
//! offsets that sound leaves open, and offsets and poses are solved in turn until both converge. Results are stored in
//! [`corrections::FILE`], where they can be corrected before the next run.

mod assist;
mod cache;
mod clocks;
mod colmap;
mod fixed;
mod geometry;
mod given;
mod inputs;
mod people;
mod poses;
mod report;
mod soundtrack;
mod spacing;
mod stored;
mod tags;
mod way;
mod world;

pub use assist::Desk;
pub(crate) use inputs::{Input, find};
pub use people::{Detector, Keypoints};
pub use report::{CameraReport, Report};
pub use spacing::Gap;

use crate::board::Board;
use crate::calibration::Video;
use crate::clicks::Clicks;
use crate::corrections::{self, Corrections};
use crate::sfm::known::pixel_unit;
use crate::sfm::learned::{Learned, Matcher};
use crate::sync::graph::{self, Evidence};
use crate::video::{self, Cropping, Selection, Source};
use crate::write::{self, Clip, Format, Pictures, Recording};
use crate::{Error, ErrorKind, Result};
use splat4d_train::event::Progress;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Whether cameras are static.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Rig {
    /// One video is of a moving camera, several are of fixed ones.
    #[default]
    Auto,
    /// Every camera is static.
    Fixed,
    /// Every camera moves.
    Moving,
}

/// Inputs and options of an import.
#[derive(Clone, Debug)]
pub struct Request {
    /// Videos, folders of images, and folders of those.
    pub inputs: Vec<PathBuf>,
    /// The capture's folder.
    pub folder: PathBuf,
    /// Which frames, on the clock of the first camera, and how large.
    pub selection: Selection,
    /// Which parts of images are kept.
    pub crop: Option<Cropping>,
    /// Frames per second of folders of images.
    pub fps: f64,
    /// Whether cameras are static.
    pub rig: Rig,
    /// Whether sound is used.
    pub sound: bool,
    /// Sound that is kept: a camera, a file, or `none`. None: that of the best camera, if `sound`.
    pub track: Option<String>,
    /// How images are stored.
    pub format: Format,
    /// Two cameras and the metres between them.
    pub apart: Option<([String; 2], f64)>,
    /// Tags that are in the images, for lengths and upwards.
    pub board: Option<Board>,
    /// A camera and its height above the floor, metres.
    pub camera_height: Option<(String, f64)>,
    /// A calibration of the cameras, in any of [`crate::calibration`]'s dialects.
    pub calibration: Option<PathBuf>,
    /// Whether the COLMAP program finds lenses and positions.
    pub colmap: bool,
    /// A folder of masks; see `write::masks`.
    pub masks: Option<PathBuf>,
    /// Whether one clock drives all cameras, so that their files' times are taken.
    pub synchronous: bool,
    /// Points that the user clicked (`Desk`), which give poses, focal lengths and time offsets.
    pub points: Option<PathBuf>,
    /// Keypoints of people, which give the same without clicks.
    pub keypoints: Option<Keypoints>,
    /// Matches pairs of cameras, or of frames of a moving one, whose features do not match.
    pub matcher: Option<Arc<dyn Matcher>>,
}

/// Pixels of the shorter side that images get: training on a CPU resolves no more.
pub const SIZE: usize = 1080;
/// Frames per second of folders of images.
pub const FPS: f64 = 30.0;

impl Request {
    /// Makes a capture in `folder` of these videos, or folders of images, with all frames and the usual size.
    pub fn new(inputs: Vec<PathBuf>, folder: PathBuf) -> Self {
        Self {
            inputs,
            folder,
            selection: Selection { size: Some(SIZE), ..Selection::default() },
            crop: None,
            fps: FPS,
            rig: Rig::Auto,
            sound: true,
            track: None,
            format: Format::default(),
            apart: None,
            board: None,
            camera_height: None,
            calibration: None,
            colmap: false,
            masks: None,
            synchronous: false,
            points: None,
            keypoints: None,
            matcher: None,
        }
    }
}

/// Frames of a moving camera that are placed at most: every one is a camera of its own to the solver.
const MOST_WALKING: usize = 150;

/// Share of the cameras that must be placed, and below which that is reported: what people who reconstruct by structure
/// from motion is keyed by.
const PLACED_LEAST: f64 = 0.7;
const PLACED_WARN: f64 = 0.9;
/// Points below which a reconstruction hangs on too little: a chessboard's.
const FEW_POINTS: usize = 50;

/// Pixels of 1920 that what a camera shows may be from where the calibration states: a rig that was pushed or
/// focussed again is off
/// by more, and rigs that people work with by 1 or 2.
const CONTRADICTS: f64 = 5.0;
/// A calibration that more than this part of the judged cameras contradict belongs to another recording.
const CONTRADICTED: f64 = 0.67;
/// The remedy where images of fixed cameras have too few matches.
const BY_HAND: &str = "or match them by a network (--matcher, docs/networks.md), click a few points in all cameras (--assist, docs/assist.md), \
     or give keypoints of people (--keypoints); or ";
/// A camera on its way.
struct Camera {
    name: String,
    source: Box<dyn Source>,
}

/// Makes a capture. `stop` is called between steps and between frames.
///
/// Errors: inputs that cannot be read, cameras that share no time, images that do not show one scene, no space; of kind
/// `Interrupted` if `stop` requested it. What was stored until then is kept, and the same request continues from there.
pub fn import(request: &Request, progress: &mut Progress<'_>, stop: &dyn Fn() -> bool) -> Result<Report> {
    let folder = &request.folder;
    let all = material(request, progress, stop)?;
    let Material { cameras, mut corrections, kept, mut told, clicks, moving, mut given, .. } = all;
    let Material { mut report, cache, heard, mut clock, mut pictures, masks, .. } = all;
    if request.colmap {
        let bare = stored::Stored::new(folder, &pictures, &[], &masks);
        let found = colmap::calibrate(&bare, progress, stop)?;
        // It saw the stored images.
        let seen: Vec<Video<'_>> = pictures.iter().map(|p| Video { name: &p.name, size: p.size }).collect();
        let found = given::Given::of(&found, &seen, "the COLMAP program")?;
        report.guesses.extend(found.notes.iter().cloned());
        given = Some(found);
    }
    let mut known = given::known(given.as_ref(), &corrections, folder, &mut pictures)?;
    let mut clicked = None;
    if request.keypoints.is_some() {
        // Before a network runs for minutes.
        given::without_poses(&known, "keypoints of people", "--keypoints")?;
    }
    let people = match &request.keypoints {
        Some(Keypoints::Given(folder)) => Some(people::given(folder, &cameras, &pictures)?),
        Some(Keypoints::By(detector)) => {
            let images = stored::Stored::new(folder, &pictures, &[], &[]);
            Some(people::detected(&**detector, &images, &cache, progress, stop)?)
        }
        None => None,
    };
    let placed = match (people, &clicks) {
        (Some(people), _) => Some(people::placed(people, &pictures, &mut known, &clock, &kept, &mut report)?),
        (None, Some(clicks)) => Some(assist::placed(clicks, &pictures, &mut known, &clock, &kept, &mut report)?),
        (None, None) => None,
    };
    if let Some(placed) = placed {
        told.iter_mut().zip(&placed.offsets).for_each(|(t, o)| *t = o.or(*t));
        clock = clocks::solve(&cameras, &heard, &told);
        clicked = Some(placed.origin);
    }
    let learned = request.matcher.clone().map(Learned::new);
    let stored = stored::Stored::new(folder, &pictures, &known, &masks).matched_by(learned.as_ref());
    let mut evidence = heard;
    let mut moves = None;
    if pictures.len() > 1 && !moving && clock.offsets.iter().any(Option::is_none) {
        let found = clocks::by_motion(&stored, &clock, &cache, progress, &mut report)?;
        moves = Some(found.moves);
        evidence.extend(found.evidence);
    }
    if stored.posed() && pictures.len() > 1 && told.iter().any(Option::is_none) {
        let rough = clocks::solve(&cameras, &evidence, &told);
        evidence.extend(geometry::by_geometry(&stored, &rough, &cache, progress)?);
    }
    let clock = clocks::solve(&cameras, &evidence, &told);
    report.refused = clocks::refusals(&names_of(&pictures), &evidence, &clock);
    let about = format!("{moving} {told:?} {:?}", clock.offsets);
    let solved = poses::once(&cache, &stored, &about, || {
        if moving {
            poses::walking(&stored, MOST_WALKING, progress, stop)
        } else {
            poses::fixed_cameras(&stored, clock, &told, progress, stop)
        }
    })?;
    if stop() {
        return Err(interrupted());
    }
    let found = Solution {
        cameras: &cameras,
        stored: &stored,
        given,
        clicked,
        solved,
        evidence: &evidence,
        told: &told,
        moves,
    };
    finish(request, found, &mut corrections, report, progress)
}

/// What an import works with: cameras, corrections, and stored images.
struct Material {
    cameras: Vec<Camera>,
    corrections: Corrections,
    /// Whether the user gives an offset.
    kept: Vec<bool>,
    /// Offsets that the user gives, and those of a clicked event.
    told: Vec<Option<f64>>,
    /// Points that the user clicked.
    clicks: Option<Clicks>,
    moving: bool,
    given: Option<given::Given>,
    report: Report,
    cache: cache::Cache,
    heard: Vec<Evidence>,
    clock: graph::Solution,
    pictures: Vec<Pictures>,
    masks: Vec<write::Masks>,
}

fn interrupted() -> Error {
    Error::new(ErrorKind::Interrupted, "stopped").remedy("Run the same command again to continue.")
}

/// Opens the cameras, and stores the images of the time that they share.
fn material(request: &Request, progress: &mut Progress<'_>, stop: &dyn Fn() -> bool) -> Result<Material> {
    request.selection.check()?;
    let folder = &request.folder;
    let mut cameras = open(request)?;
    let names: Vec<String> = cameras.iter().map(|c| c.name.clone()).collect();
    std::fs::create_dir_all(folder)
        .map_err(|e| Error::environment("the folder cannot be created", e).at(folder.display()))?;
    let corrections = Corrections::read(folder, &names)?;
    let mut wanted = corrections.cameras.iter().map(|c| c.wanted);
    cameras.retain(|_| wanted.next().unwrap_or(true));
    let mut told =
        corrections.cameras.iter().filter(|c| c.wanted).map(corrections::Camera::given_offset).collect::<Vec<_>>();
    told.resize(cameras.len(), None);
    if request.synchronous {
        told.iter_mut().for_each(|t| *t = t.or(Some(0.0)));
    }
    let kept: Vec<bool> = told.iter().map(Option::is_some).collect();
    if cameras.is_empty() {
        return Err(Error::input("all cameras are left out").at(folder.join(corrections::FILE).display()));
    }
    let measured =
        request.apart.iter().flat_map(|(pair, _)| pair).chain(request.camera_height.iter().map(|(name, _)| name));
    for name in measured {
        if !cameras.iter().any(|c| c.name == *name) {
            let known: Vec<&str> = cameras.iter().map(|c| c.name.as_str()).collect();
            return Err(Error::input(format!("there is no camera \"{name}\", for which a distance is given"))
                .remedy(format!("Cameras are {}.", known.join(", "))));
        }
    }
    if usize::from(request.apart.is_some())
        + usize::from(request.board.is_some())
        + usize::from(request.camera_height.is_some())
        > 1
    {
        return Err(Error::input("the scale is given in two ways")
            .remedy("Give one of them: the distance of two cameras, tags, or a height."));
    }
    let clicks = match &request.points {
        Some(file) => {
            let here: Vec<&str> = cameras.iter().map(|c| c.name.as_str()).collect();
            let clicks = assist::read(file, request, &names, &here)?;
            told = clicks.offsets(&here, &told);
            Some(clicks)
        }
        None => None,
    };
    let moving = match request.rig {
        Rig::Auto => cameras.len() == 1,
        Rig::Fixed => false,
        Rig::Moving => true,
    };
    let still =
        request.rig == Rig::Auto && moving && fixed::is_fixed(&*cameras[0].source, &request.selection, progress, stop)?;
    if cameras.len() == 1 && (!moving || still) {
        let why = if still { "the background of the images stays in place: " } else { "" };
        return Err(Error::input(format!("{why}one fixed camera gives no depth"))
            .remedy("Give the videos of at least two cameras, or use --rig moving if this camera moved."));
    }
    // It can be corrected even if the calibration does not fit.
    corrections.write(folder)?;
    if request.colmap && (moving || request.calibration.is_some()) {
        let why = if moving { "cameras move" } else { "a calibration is given" };
        return Err(Error::input(format!("COLMAP poses were requested, but {why}")).remedy(
            "Leave --colmap out. A COLMAP reconstruction of a moving camera's frames is a capture as it is: splat4d train FOLDER.",
        ));
    }
    let given = given::Given::read(request, &cameras, moving)?;
    let mut report = Report::default();
    report.guesses.extend(given.iter().flat_map(|g| g.notes.iter().cloned()));
    let cache = cache::Cache::of(folder);
    let heard = if request.sound && cameras.len() > 1 && told.iter().any(Option::is_none) {
        clocks::by_sound(&cameras, &cache, progress, stop)?
    } else {
        Vec::new()
    };
    let clock = clocks::solve(&cameras, &heard, &told);
    let mut selections = clocks::shared(&cameras, &clock, &request.selection, &mut report)?;
    crop(request, &cameras, &mut selections, &mut report, progress, stop)?;
    let clips: Vec<Clip<'_>> = cameras
        .iter()
        .zip(selections)
        .map(|(c, selection)| Clip { name: c.name.clone(), source: &*c.source, selection })
        .collect();
    // A terminal's Ctrl-C ends ffmpeg too, whose video then seems to be damaged.
    let pictures = write::pictures(folder, &clips, request.format, progress, stop)
        .map_err(|e| if stop() && e.kind() != ErrorKind::Interrupted { interrupted() } else { e })?;
    for p in &pictures {
        if p.shots.is_empty() {
            return Err(Error::input("the chosen part contains no frame")
                .at(format!("camera {}", p.name))
                .remedy("Choose another part, or leave the camera out."));
        }
    }
    if stop() {
        return Err(interrupted());
    }
    let begins: Vec<write::Begin> = clips.iter().map(|c| write::Begin { from: c.selection.from }).collect();
    let masks = match &request.masks {
        Some(from) => write::masks(folder, from, &pictures, &begins, progress, stop)?,
        None => Vec::new(),
    };
    Ok(Material {
        cameras,
        corrections,
        kept,
        told,
        clicks,
        moving,
        given,
        report,
        cache,
        heard,
        clock,
        pictures,
        masks,
    })
}

/// All that was found.
struct Solution<'a> {
    cameras: &'a [Camera],
    stored: &'a stored::Stored<'a>,
    given: Option<given::Given>,
    /// Floor and unit of clicked points.
    clicked: Option<world::Origin>,
    solved: poses::Solved,
    /// Lags of pairs, and given offsets.
    evidence: &'a [Evidence],
    told: &'a [Option<f64>],
    /// Whether something moves in cameras whose clocks sound leaves open; none: it leaves none open.
    moves: Option<bool>,
}

fn names_of(pictures: &[Pictures]) -> Vec<&str> {
    pictures.iter().map(|p| p.name.as_str()).collect()
}

/// Refuses what would only waste the time of training: most cameras, or frames of a moving one, must have been placed.
fn check(solved: &poses::Solved, pictures: &[Pictures], report: &mut Report) -> Result<()> {
    let (placed, asked) = if solved.moving {
        let known = |s: &poses::SolvedCamera| s.poses.iter().flatten().count();
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
            "{}Place neighbouring cameras at most {} degrees apart, in focus and well lit (docs/filming.md); {}leave \
             these out (use = false in {}) and run the same command again.",
            angles(&report.gaps),
            spacing::FAR,
            if solved.moving { "or " } else { BY_HAND },
            corrections::FILE
        )));
    }
    if share < PLACED_WARN {
        report.guesses.push(format!("Only {placed} of {asked} {what} could be placed; the rest is left out."));
    }
    if solved.points.len() < FEW_POINTS {
        let given = !solved.contradiction.is_empty();
        let what = if given {
            "were found on the given poses: cameras share few points, and training searches for more."
        } else {
            "connect the cameras: check the result."
        };
        report.guesses.push(format!("Only {} points {what}", solved.points.len()));
    }
    Ok(())
}

/// The angles of the placed cameras and what is missing between them, in sentences.
fn angles(gaps: &[Gap]) -> String {
    if gaps.is_empty() {
        return String::new();
    }
    let each: Vec<String> =
        gaps.iter().map(|g| format!("{} and {} {:.0}", g.cameras[0], g.cameras[1], g.degrees)).collect();
    let advice: String = gaps.iter().filter_map(Gap::advice).map(|a| a + " ").collect();
    format!("Degrees between placed neighbours: {}. {advice}", each.join(", "))
}

/// Compares what was given with what images show, and refuses what they contradict.
fn agrees(solved: &poses::Solved, pictures: &[Pictures], report: &mut Report) -> Result<()> {
    let (mut told, mut wrong) = (Vec::new(), 0);
    for (k, p) in pictures.iter().enumerate() {
        let Some(off) = solved.contradiction.get(k).copied().flatten() else { continue };
        told.push(off);
        report.cameras[k].calibration = Some(off);
        if off > CONTRADICTS * pixel_unit(p.size) {
            wrong += 1;
            report.cameras[k].warnings.push(format!(
                "its features are {off:.1} px from where the calibration projects them: the camera was moved or \
                 refocused, or the calibration is another camera's"
            ));
        }
    }
    if told.len() < pictures.len() {
        let silent =
            pictures.iter().zip(&solved.contradiction).filter(|(_, c)| c.is_none()).map(|(p, _)| p.name.as_str());
        report.guesses.push(format!(
            "Whether the calibration fits was not checked, for too few features are seen by two cameras: {}.",
            silent.collect::<Vec<_>>().join(", ")
        ));
    }
    if told.len() >= 2 && wrong as f64 > CONTRADICTED * told.len() as f64 {
        told.sort_by(f64::total_cmp);
        return Err(Error::input(format!(
            "the calibration contradicts the images: the features of {wrong} of {} cameras are {:.0} px (median) \
             from where it projects them",
            told.len(),
            told[told.len() / 2]
        ))
        .remedy(
            "Check that it belongs to this recording, that videos have the names of their cameras, and that they \
             were neither cropped nor rotated. Without --calibration, poses are found in the images.",
        ));
    }
    Ok(())
}

/// Removes the travel time of sound from clocks that sound alone determines, or reports why not.
fn subtract_travel_time(
    solved: &mut poses::Solved,
    evidence: &[Evidence],
    told: &[Option<f64>],
    metres: bool,
    pictures: &[Pictures],
    report: &mut Report,
) {
    if solved.moving {
        return;
    }
    if metres {
        let frame = pictures.iter().map(|p| p.clock.interval).fold(0.0, f64::max);
        if let Some(done) = way::corrected(solved, evidence, told, 0.5 * frame) {
            report.guesses.push(format!(
                "The travel time of sound is subtracted from {} time offsets that only sound gives, up to {:.1} ms.",
                done.clocks,
                1e3 * done.most
            ));
        }
    } else if way::hangs_on_sound(solved, told) {
        report.guesses.push(
            "Time offsets from sound alone include the travel time of sound, 2.9 ms a metre. It is not subtracted, because \
             the unit of length is not the metre."
                .into(),
        );
    }
}

/// Gives every selection the part of images that is kept.
fn crop(
    request: &Request,
    cameras: &[Camera],
    selections: &mut [Selection],
    report: &mut Report,
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<()> {
    let Some(cropping) = request.crop else { return Ok(()) };
    for (k, (camera, selection)) in cameras.iter().zip(selections).enumerate() {
        if stop() {
            return Err(interrupted());
        }
        selection.crop = match cropping {
            Cropping::At(crop) => Some(crop),
            Cropping::Auto => {
                progress.phase("searching for black bars", k, cameras.len());
                let found = video::without_bars(&*camera.source, selection);
                found.map_err(|e| e.at(format!("camera {}", camera.name)))?
            }
        };
        if let Some(c) = selection.crop {
            let [w, h] = camera.source.info().size;
            report.guesses.push(format!(
                "Camera {}: {}x{} pixels of {w}x{h} are kept, from column {} and row {} on.",
                camera.name, c.width, c.height, c.x, c.y
            ));
        }
    }
    Ok(())
}

/// Opens all inputs; without duplicates.
fn open(request: &Request) -> Result<Vec<Camera>> {
    let inputs = find(&request.inputs)?;
    let mut sources = Vec::with_capacity(inputs.len());
    let mut prints: Vec<(String, &Path)> = Vec::with_capacity(inputs.len());
    for input in &inputs {
        let path = &input.files[0];
        let source = video::open_all(&input.files, request.fps)?;
        let print = source.fingerprint()?;
        if let Some((_, other)) = prints.iter().find(|(p, _)| *p == print) {
            return Err(Error::input(format!("it is the same as {}", other.display()))
                .at(path.display())
                .remedy("Give every camera once."));
        }
        prints.push((print, path));
        sources.push(source);
    }
    let named = |(s, i): (&dyn Source, &Input)| i.name.clone().unwrap_or_else(|| s.info().name.clone());
    let wanted: Vec<String> = sources.iter().map(|s| &**s).zip(&inputs).map(named).collect();
    let wanted: Vec<&str> = wanted.iter().map(String::as_str).collect();
    let names = write::camera_names(&wanted);
    Ok(names.into_iter().zip(sources).map(|(name, source)| Camera { name, source }).collect())
}

/// Writes points, capture, corrections and report.
fn finish(
    request: &Request,
    found: Solution<'_>,
    corrections: &mut Corrections,
    mut report: Report,
    progress: &mut Progress<'_>,
) -> Result<Report> {
    let folder = &request.folder;
    let Solution { cameras, stored, given, clicked, mut solved, evidence, told, moves } = found;
    let pictures = stored.pictures;
    let posed = given.as_ref().is_some_and(|g| g.posed);
    // COLMAP's own axes and unit are those of some camera.
    let origin = match &given {
        _ if clicked.is_some() => clicked.expect("it is there"),
        Some(g) if g.posed && !request.colmap => world::Origin::Calibrated { metres: g.metres },
        _ => world::Origin::Free,
    };
    if let Some(points) = given.and_then(|g| g.points).filter(|_| solved.points.len() < FEW_POINTS) {
        solved.take_points(&points);
        report.guesses.push("Points are the calibration's: too few were found in these images.".into());
    }
    // Unplaced cameras are reported before unmeasured ones.
    let metres = match world::settle(request, stored, origin, &mut solved, &mut report, progress) {
        Ok(metres) => metres,
        Err(e) => {
            check(&solved, pictures, &mut report)?;
            return Err(e);
        }
    };
    subtract_travel_time(&mut solved, evidence, told, metres, pictures, &mut report);
    let mut placed = Vec::new();
    for (k, (camera, p)) in solved.cameras.iter().zip(pictures).enumerate() {
        let row = CameraReport::of(p, camera, solved.offsets.get(k).and_then(Option::as_ref));
        report.cameras.push(row);
        if solved.stray.get(k) == Some(&true) {
            report.cameras[k].warnings.push(
                "its motion fits the other cameras much less than theirs fits each other: it shows another time (give its \
                 offset), another recording, or a view from too far aside; its time offset is not used"
                    .into(),
            );
        }
        if let Ok(stand) = camera {
            placed.push(stand.written(p, solved.offset(k), stored.masks.get(k).cloned()));
            if let Some(own) = corrections.cameras.iter_mut().find(|c| c.name == p.name) {
                if let Some(offset) = solved.offsets.get(k).and_then(Option::as_ref) {
                    own.found_offset(offset);
                }
                let last = placed.last().expect("it was just put there");
                own.found_lens(&last.intrinsics, &last.lens);
            }
        }
    }
    if !solved.moving {
        report.gaps = spacing::gaps(&solved, &names_of(pictures));
        report.guesses.extend(report.gaps.iter().filter_map(Gap::advice));
    }
    corrections.write(folder)?;
    let contradicted = posed.then(|| agrees(&solved, pictures, &mut report)).transpose();
    report.write(folder)?;
    contradicted?;
    check(&solved, pictures, &mut report)?;
    match moves {
        Some(true) => clocks::check(&names_of(pictures), &solved, told, &report.motion)?,
        Some(false) => {
            report.still = true;
            report.guesses.push("Nothing moves: time offsets are those of the files and have no effect.".into());
        }
        None => {}
    }
    let mut points = None;
    if !solved.points.is_empty() {
        let file = PathBuf::from("points.ply");
        let bytes = solved.cloud().to_ply("comment points of import");
        splat4d_train::run::checkpoint::write_atomically(&folder.join(&file), &bytes)?;
        points = Some(file);
    }
    let sound = soundtrack::keep(request, cameras, &solved, &placed, &mut report.guesses, progress)?;
    let take = Recording { name: None, up: Some(solved.up), points, sound, ..Recording::default() };
    report.capture = write::capture(folder, &take, &placed)?;
    report.points = solved.points.len();
    report.write(folder)?;
    Ok(report)
}
