//! The work behind `import`: videos become a capture, which is checked.

use crate::events::Listener;
use crate::models::{Kind, Model};
use crate::report::doctor;
use serde_json::{Value, json};
use splat4d::{Error, ErrorKind, Result};
use splat4d_import::calibration;
use splat4d_import::corrections;
use splat4d_import::doctor::{Grade, Report as Checked};
use splat4d_import::predicted;
use splat4d_import::recording::{self, CameraReport, Detector, Keypoints, Report, Request};
use splat4d_import::sfm::learned::{Matcher, Matches};
use splat4d_train::capture::Rgb8;
use splat4d_train::event::{Event, Progress};
use splat4d_train::output::{Input, OutputFolder, check_apart, written};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::open_capture;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The file by which a capture is recognised.
const CAPTURE: &str = "capture.json";
/// Files that an import writes into its folder, in addition to its corrections.
const WRITTEN: [&str; 7] = [CAPTURE, "points.ply", "images", "masks", "depth", "import", "sound.m4a"];
/// Files by which a run is recognised.
const RUN: [&str; 2] = ["recipe.toml", "run.json"];
/// Findings of the doctor that the text contains; its page has all.
const MOST: usize = 6;

/// A capture that was imported.
#[derive(Debug)]
#[non_exhaustive]
pub struct Imported {
    /// Results of each camera.
    pub report: Report,
    /// Findings of the doctor and its page, where it was called.
    pub checked: Option<(Checked, PathBuf)>,
}

/// Makes a capture of videos or folders of images: frames, synchronisation, poses, lenses and points. `check`: examines
/// the finished capture too and writes `import/doctor.html`. The same request continues interrupted work.
///
/// Errors: the folder contains a capture of another program; videos that cannot be read; poses that cannot be found;
/// `stop` was raised.
///
/// ```no_run
/// use splat4d_import::recording::Request;
/// use splat4d_workflow::importing::import;
/// use std::sync::atomic::AtomicBool;
///
/// # fn main() -> splat4d::Result<()> {
/// let request = Request::new(vec!["videos".into()], "my-take".into());
/// let imported = import(&request, true, &AtomicBool::new(false), &splat4d_workflow::events::ignore)?;
/// println!("{}", imported.in_words());
/// # Ok(())
/// # }
/// ```
pub fn import(request: &Request, check: bool, stop: &AtomicBool, console: &dyn Listener) -> Result<Imported> {
    let _owned = claimed(request)?;
    let folder = &request.folder;
    console.stop_not_polled("stored results are kept, and the same command continues from there");
    let mut listen = |event: &Event| console.event(event);
    let made = recording::import(request, &mut Progress(&mut listen), &|| stop.load(Ordering::SeqCst));
    console.clear();
    let report = made.map_err(placed)?;
    let checked = if check {
        let capture = open_capture(folder, &Recipe::default())?;
        Some(doctor::made(&capture, &folder.join("import"), console)?)
    } else {
        None
    };
    warnings(&report).iter().for_each(|w| console.warn(w));
    Ok(Imported { report, checked })
}

/// A network of two images as the matcher of a [`Request`] ([docs/networks.md](https://github.com/splat4d/splat4d/blob/main/docs/networks.md)).
/// `described`: the name of a description that the program has, in place of the file next to the network.
///
/// Errors: as of [`Model::load`]; the network does not match images.
pub fn matcher(network: &Path, described: Option<&str>) -> Result<Arc<dyn Matcher>> {
    let remedy = "Give a network that matches two images, such as SuperPoint with LightGlue (docs/networks.md)";
    Ok(Arc::new(Network(loaded(network, described, Kind::Matches, remedy)?)))
}

/// The keypoints of a [`Request`]: a folder of files, or a network (`.onnx`) that finds people, described as of [`matcher`].
///
/// Errors: as of [`Model::load`]; the network finds no people.
pub fn keypoints(path: &Path, described: Option<&str>) -> Result<Keypoints> {
    if !path.extension().is_some_and(|e| e.eq_ignore_ascii_case("onnx")) {
        return Ok(Keypoints::Given(path.to_owned()));
    }
    let remedy = "Give a network that finds keypoints of all people in an image, such as RTMO (docs/networks.md)";
    Ok(Keypoints::By(Arc::new(Network(loaded(path, described, Kind::People, remedy)?))))
}

/// A network of a kind.
fn loaded(network: &Path, described: Option<&str>, kind: Kind, remedy: &str) -> Result<Model> {
    let model = Model::load(network, described)?;
    let found = model.description().output.kind;
    if found != kind {
        return Err(Error::input(format!("the network computes {}, not {}", found.name(), kind.name()))
            .at(network.display())
            .remedy(remedy));
    }
    Ok(model)
}

/// A network that matches images, or finds people in them.
struct Network(Model);

impl Detector for Network {
    fn identity(&self) -> &str {
        self.0.identity()
    }

    fn people(&self, image: &Rgb8) -> Result<Vec<Vec<[f64; 3]>>> {
        let found = self.0.people(image)?.into_iter();
        Ok(found.map(|person| person.into_iter().map(|point| point.map(f64::from)).collect()).collect())
    }
}

impl Matcher for Network {
    fn identity(&self) -> &str {
        self.0.identity()
    }

    fn matches(&self, images: [&Rgb8; 2]) -> Result<Matches> {
        Ok(self.0.matches(images)?.into_iter().map(|both| both.map(|at| at.map(f64::from))).collect())
    }
}

/// Makes a capture of poses, depth and images that a network predicted, in one `.npz` (VGGT, Depth Anything 3); training
/// refines its poses. Returns the result in words.
///
/// Errors: not such a file; the folder contains a capture of another program; no space.
pub fn import_predicted(file: &Path, folder: &Path, console: &dyn Listener) -> Result<String> {
    check_ours(folder)?;
    check_apart(folder, &[Input::new(file, "what is imported,")])?;
    let _owned = OutputFolder::amend(folder, "import")?;
    console.phase("reading the prediction", 0, 0);
    let words = predicted::unpack(file, folder)?;
    console.clear();
    Ok(format!("{}: {words}", folder.display()))
}

/// An error of an import.
pub(crate) fn placed(e: Error) -> Error {
    match e.kind() {
        ErrorKind::Interrupted => e,
        _ => e.at("import"),
    }
}

/// Takes the folder of a request, if it may be written.
pub(crate) fn claimed(request: &Request) -> Result<OutputFolder> {
    let folder = &request.folder;
    check_ours(folder)?;
    let read = request.inputs.iter().chain(&request.masks).map(|v| Input::new(v, "what is imported,"));
    // A capture may be next to the videos, in the folder of their calibration.
    let calibration = request.calibration.iter().map(|c| Input { may_hold: true, ..Input::new(c, "the calibration") });
    check_apart(folder, &read.chain(calibration).collect::<Vec<_>>())?;
    // Before videos are read, which takes a while.
    request.calibration.iter().try_for_each(|c| calibration::read(c).map(drop))?;
    OutputFolder::amend(folder, "import")
}

/// Messages about cameras.
fn warnings(report: &Report) -> Vec<String> {
    let mut out = Vec::new();
    for camera in &report.cameras {
        for warning in &camera.warnings {
            out.push(format!("camera {}: {warning}", camera.name));
        }
        if let Some(trouble) = &camera.trouble {
            out.push(format!("camera {} is left out: {trouble}", camera.name));
        }
    }
    for line in &report.refused {
        out.push(line.clone());
    }
    let guess = |c: &&CameraReport| c.by == ["motion"];
    let guessed: Vec<&str> = report.cameras.iter().filter(guess).map(|c| c.name.as_str()).collect();
    if !guessed.is_empty() {
        out.push(format!(
            "the time offsets of these cameras are guessed from the amount of motion and not confirmed: {} (correct them in {})",
            guessed.join(", "),
            corrections::FILE
        ));
    }
    let silent: Vec<&str> = report.cameras.iter().filter(|c| c.offset.is_none()).map(|c| c.name.as_str()).collect();
    if report.cameras.len() > 1 && !silent.is_empty() && !report.still {
        out.push(format!(
            "the time offsets of these cameras are unknown, those of their files are used: {} (correct them in {})",
            silent.join(", "),
            corrections::FILE
        ));
    }
    out
}

impl Imported {
    /// All of it, for programs.
    pub fn json(&self) -> Value {
        json!({"type": "imported", "report": self.report, "doctor": self.checked.as_ref().map(|c| &c.0)})
    }

    /// The same for people: a line per camera, and findings of the doctor.
    pub fn in_words(&self) -> String {
        let report = &self.report;
        let mut text = String::from(
            "camera              frames  offset ms     ±  by                     points   error px  focal px",
        );
        let given = report.cameras.iter().any(|c| c.calibration.is_some());
        text += if given { "  calibration px\n" } else { "\n" };
        for camera in &report.cameras {
            let off = camera.calibration.map_or_else(|| "-".to_owned(), |v| format!("{v:.2}"));
            let _ = writeln!(text, "{}{}", row(camera), if given { format!("{off:>16}") } else { String::new() });
        }
        if !report.gaps.is_empty() {
            let each = report.gaps.iter().map(|g| format!("{}-{} {:.0}", g.cameras[0], g.cameras[1], g.degrees));
            let _ = writeln!(text, "degrees between neighbours: {}", each.collect::<Vec<_>>().join(", "));
        }
        for guess in &report.guesses {
            let _ = writeln!(text, "{guess}");
        }
        let _ = write!(text, "{} points; wrote {}", report.points, report.capture.display());
        if let Some((findings, page)) = &self.checked {
            let _ = write!(text, "\ndoctor: {}; wrote {}", doctor::summary(findings), page.display());
            for f in findings.findings.iter().filter(|f| f.grade > Grade::Note).take(MOST) {
                let _ = write!(text, "\n! {}", doctor::sentence(f));
            }
            if !findings.leave_out.is_empty() {
                let _ = write!(text, "\nleave out: {}", findings.leave_out.join(", "));
            }
        }
        text
    }
}

/// Refuses a folder that holds what an import writes, but no import: images, masks or points of other origin are never
/// replaced.
fn check_ours(folder: &Path) -> Result<()> {
    if let Some(name) = RUN.iter().find(|name| folder.join(name).is_file()) {
        return Err(Error::input(format!("the folder contains a run ({name})"))
            .at(folder.display())
            .remedy("Give another folder with option `output`."));
    }
    if folder.join(corrections::FILE).is_file() {
        return Ok(());
    }
    let listed = written(folder);
    let foreign = |name: &&&str| folder.join(name).exists() && !listed.iter().any(|file| file.starts_with(name));
    let Some(name) = WRITTEN.iter().find(foreign) else { return Ok(()) };
    let what = match *name {
        CAPTURE => "the folder contains a capture of another program".to_owned(),
        name => format!("holds {name}, and there is no record that splat4d wrote it"),
    };
    Err(Error::input(what).at(folder.display()).remedy("Give another folder with option `output`."))
}

fn row(camera: &CameraReport) -> String {
    let number = |v: Option<f64>, scale: f64, digits: usize| {
        v.map_or_else(|| "-".to_owned(), |v| format!("{:.digits$}", v * scale))
    };
    format!(
        "{:<20}{:>6}{:>11}{:>6}  {:<22}{:>7}{:>11}{:>10}",
        camera.name,
        camera.frames,
        number(camera.offset, 1e3, 1),
        number(camera.sigma, 1e3, 1),
        if camera.by.is_empty() { "its file".to_owned() } else { camera.by.join(", ") },
        camera.sightings,
        number(camera.error, 1.0, 2),
        number(camera.focal, 1.0, 0),
    )
}

#[cfg(all(test, feature = "models"))]
mod tests;
