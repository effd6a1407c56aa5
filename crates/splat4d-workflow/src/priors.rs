//! The work behind `priors`: networks run over the images of a capture, and write depth, flow, masks and tracks into its
//! folder `priors/`, where training finds them. What they wrote is then compared with the points and the images.

mod checks;
mod write;

pub use checks::Row;

use crate::deadline::unless_stopped;
use crate::events::Listener;
use crate::files;
use crate::models::{Form, Kind, Model};
use serde_json::{Map as Object, Value, json};
use splat4d::{Error, Result};
use splat4d_train::capture::{Capture, CaptureOptions, Frame, Rgb8};
use splat4d_train::output::{OutputFolder, write_atomically, written};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use write::Encoded;

/// Folder in the capture.
const FOLDER: &str = "priors";
/// The list of its files, which training reads.
const LIST: &str = "priors.json";

/// What a network is used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// Depth maps.
    Depth,
    /// Optical flow.
    Flow,
    /// Foreground masks.
    Masks,
    /// Point tracks.
    Tracks,
}

impl Part {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Depth, Self::Flow, Self::Masks, Self::Tracks];

    /// Its name, in options, lists and folders.
    pub fn name(self) -> &'static str {
        match self {
            Part::Depth => "depth",
            Part::Flow => "flow",
            Part::Masks => "masks",
            Part::Tracks => "tracks",
        }
    }

    /// What a kind of network is used for; keypoints of people are for `import` alone.
    pub fn of(kind: Kind) -> Option<Self> {
        match kind {
            Kind::Depth | Kind::InverseDepth => Some(Part::Depth),
            Kind::Flow => Some(Part::Flow),
            Kind::Mask => Some(Part::Masks),
            Kind::Matches => Some(Part::Tracks),
            Kind::People => None,
        }
    }
}

/// Options of [`priors`].
#[derive(Clone, Debug, Default)]
pub struct Priors {
    /// The capture.
    pub capture: PathBuf,
    /// Networks by what they are used for.
    pub networks: BTreeMap<Part, PathBuf>,
    /// Names of ready-made descriptions, instead of files next to the networks.
    pub described: BTreeMap<Part, String>,
    /// Whether what another network wrote is replaced.
    pub force: bool,
}

/// Results of [`priors`].
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Made {
    /// The folder.
    pub folder: PathBuf,
    /// A row per kind and camera.
    pub rows: Vec<Row>,
}

impl Made {
    /// For machines.
    pub fn json(&self) -> Value {
        json!({"type": "priors", "folder": self.folder, "rows": self.rows.iter().map(Row::json).collect::<Vec<_>>()})
    }

    /// A table for people.
    pub fn text(&self) -> String {
        checks::table(&self.rows)
    }
}

/// Runs networks over a capture. Files that are there are kept: the same request continues interrupted work.
///
/// Errors: networks that cannot be loaded or are of another kind; files in the folder that splat4d did not write; results of
/// another network, without `force`; `stop` was raised.
///
/// ```no_run
/// use splat4d_workflow::priors::{Part, Priors, priors};
/// use std::sync::atomic::AtomicBool;
///
/// # fn main() -> splat4d::Result<()> {
/// let networks = [(Part::Depth, "depth.onnx".into())].into();
/// let request = Priors { capture: "my-take".into(), networks, ..Priors::default() };
/// let made = priors(&request, &AtomicBool::new(false), &splat4d_workflow::events::ignore)?;
/// println!("{}", made.text());
/// # Ok(())
/// # }
/// ```
pub fn priors(request: &Priors, stop: &AtomicBool, console: &dyn Listener) -> Result<Made> {
    if request.networks.is_empty() {
        return Err(Error::input("no network is given").remedy(
            "Give option `depth`, option `flow`, option `masks` or option `tracks` an .onnx file (docs/networks.md)",
        ));
    }
    let models: BTreeMap<Part, Model> = request
        .networks
        .iter()
        .map(|(&part, path)| Ok((part, load(part, path, request.described.get(&part).map(String::as_str))?)))
        .collect::<Result<_>>()?;
    let root = if request.capture.is_dir() { Some(request.capture.as_path()) } else { request.capture.parent() };
    root.map_or(Ok(()), |root| mend(&root.join(FOLDER)))?;
    let capture = Capture::open(&request.capture, &CaptureOptions::default())?;
    capture.warnings.iter().for_each(|w| console.warn(w));
    models.values().filter_map(Model::warning).for_each(|w| console.warn(&w));
    let folder = capture.root.join(FOLDER);
    console.stop_polled("stopping; the same command continues from there");
    let _owned = OutputFolder::amend(&folder, FOLDER)?;
    let mut rows = Vec::new();
    for (&part, model) in &models {
        let work = Work { part, model, capture: &capture, folder: &folder, stop, console };
        let files = work.all(request.force)?;
        console.clear();
        let mut parts = read_list(&folder)?;
        parts.insert(part.name().into(), list_entry(model, files));
        write_list(&folder, parts)?;
    }
    let capture = Capture::open(&request.capture, &CaptureOptions::default())?;
    for &part in models.keys() {
        rows.extend(checks::check(&capture, part, &folder, stop, console)?);
    }
    console.clear();
    let made = Made { folder, rows };
    made.rows.iter().flat_map(|r| &r.warnings).for_each(|w| console.warn(w));
    Ok(made)
}

fn load(part: Part, path: &Path, described: Option<&str>) -> Result<Model> {
    let model = Model::load(path, described)?;
    let kind = model.description().output.kind;
    if Part::of(kind) != Some(part) {
        let kinds = match part {
            Part::Depth => "depth or inverse-depth",
            Part::Flow => "flow",
            Part::Masks => "mask",
            Part::Tracks => "matches",
        };
        return Err(Error::input(format!("expected a network for {kinds}, found {}", kind.name()))
            .at(path.display())
            .remedy(format!(
                "Give another one as option `{}`, or correct output.kind in its description",
                part.name()
            )));
    }
    if part == Part::Tracks && model.description().output.form != Form::Numbered {
        return Err(Error::input("the network finds other positions in every pair of images, which no track connects")
            .at(path.display())
            .remedy(
                "Give one with key points, such as SuperPoint with LightGlue; this one is for `import --matcher`",
            ));
    }
    Ok(model)
}

/// What training needs to know of a network's files.
fn list_entry(model: &Model, files: BTreeMap<String, String>) -> Value {
    let output = &model.description().output;
    let mut entry = Object::new();
    match output.kind {
        Kind::Depth if output.metric => _ = entry.insert("kind".into(), "metric".into()),
        Kind::Depth => _ = entry.insert("kind".into(), "relative".into()),
        Kind::InverseDepth => _ = entry.insert("kind".into(), "inverse".into()),
        _ => {}
    }
    entry.insert("files".into(), json!(files));
    entry.into()
}

/// The list of a folder: its parts by name; empty where there is none. Errors: a damaged list, or one of another version.
fn read_list(folder: &Path) -> Result<Object<String, Value>> {
    let path = folder.join(LIST);
    if !path.is_file() {
        return Ok(Object::new());
    }
    let list: Value = serde_json::from_str(&files::read_text(&path)?).map_err(|e| {
        Error::input(format!("is not valid JSON: {e}"))
            .at(path.display())
            .remedy("Remove it, and run the command again")
    })?;
    match list {
        Value::Object(parts) if parts.get("version") == Some(&json!(1)) => Ok(parts),
        _ => Err(Error::input("expected a list of version 1").at(path.display()).remedy("Use a newer splat4d")),
    }
}

/// Writes the list of a folder. Errors: the disk.
fn write_list(folder: &Path, mut parts: Object<String, Value>) -> Result<()> {
    parts.insert("version".into(), 1.into());
    parts.insert("writer".into(), format!("splat4d {}", env!("CARGO_PKG_VERSION")).into());
    let text = serde_json::to_string_pretty(&Value::Object(parts)).expect("it is plain data");
    files::write(&folder.join(LIST), text.as_bytes())
}

/// Takes parts with files that are missing out of the list: such a capture cannot be opened, and they are computed again.
fn mend(folder: &Path) -> Result<()> {
    let mut parts = read_list(folder)?;
    let whole = |part: &Value| {
        let names = part["files"].as_object().into_iter().flatten();
        names.filter_map(|(_, name)| name.as_str()).all(|name| folder.join(name).is_file())
    };
    let before = parts.len();
    parts.retain(|_, part| whole(part));
    if parts.len() == before || !written(folder).contains(Path::new(LIST)) {
        return Ok(());
    }
    let _owned = OutputFolder::amend(folder, FOLDER)?;
    write_list(folder, parts)
}

/// One network and its capture.
struct Work<'a> {
    part: Part,
    model: &'a Model,
    capture: &'a Capture,
    folder: &'a Path,
    stop: &'a AtomicBool,
    console: &'a dyn Listener,
}

impl Work<'_> {
    /// Runs the network over all images; returns the file of each image (of tracks: of each camera).
    fn all(&self, force: bool) -> Result<BTreeMap<String, String>> {
        self.claim(force)?;
        let mut out = BTreeMap::new();
        let jobs = self.jobs();
        let (mut own, mut broken) = (0, Vec::new());
        for (done, job) in jobs.iter().enumerate() {
            self.console.phase(self.part.name(), done, jobs.len());
            unless_stopped(self.stop)?;
            if job.own {
                own += 1;
                continue;
            }
            let name = format!("{}/{}.{}", self.part.name(), file_name(&job.key), write::ending(self.model));
            if !self.folder.join(&name).is_file() {
                match self.one(job)? {
                    Encoded::File(bytes) => write_atomically(&self.folder.join(&name), &bytes)?,
                    Encoded::Broken(what) => {
                        broken.push(format!("{}: {what}", job.key));
                        continue;
                    }
                }
            }
            out.insert(job.key.clone(), name);
        }
        if own > 0 {
            self.console.detail(&format!("{}: {own} images have their own, which are used", self.part.name()));
        }
        if let Some(first) = broken.first() {
            let what = format!(
                "{}: the network returned nothing usable for {} of {} images, such as {first}; they are left out. Its \
                 description may be wrong (range, mean, std, layout)",
                self.part.name(),
                broken.len(),
                jobs.len()
            );
            self.console.warn(&what);
        }
        Ok(out)
    }

    /// Notes which network the files of the part are of. Errors: another one wrote those that are there; files of others.
    fn claim(&self, force: bool) -> Result<()> {
        let (part, model) = (self.part.name(), self.model);
        let note = self.folder.join(format!("{part}.json"));
        let listed: BTreeSet<PathBuf> = written(self.folder);
        let foreign = |path: &Path| {
            Error::input("splat4d did not write this file")
                .at(path.display())
                .remedy("Move it out of the folder priors")
        };
        for name in [LIST, &format!("{part}.json")] {
            if self.folder.join(name).exists() && !listed.contains(Path::new(name)) {
                return Err(foreign(&self.folder.join(name)));
            }
        }
        let before = note.is_file().then(|| files::read_text(&note)).transpose()?;
        let identity = |text: &String| serde_json::from_str::<Value>(text).ok().map(|v| v["identity"].clone());
        let same = before.as_ref().and_then(identity).is_some_and(|i| i == model.identity());
        let own: Vec<&PathBuf> =
            listed.iter().filter(|f| f.starts_with(part) && self.folder.join(f).is_file()).collect();
        if !same && !force && !own.is_empty() {
            return Err(Error::input(format!("holds {part} of another network, or with another description"))
                .at(self.folder.join(part).display())
                .remedy("Replace it with --force"));
        }
        if let Some(file) = others(&self.folder.join(part), self.folder, &listed) {
            return Err(foreign(&file));
        }
        if (force || !same) && !own.is_empty() {
            // First, so that the capture can be opened at any time.
            let mut parts = read_list(self.folder)?;
            if parts.remove(part).is_some() {
                write_list(self.folder, parts)?;
            }
            for file in own {
                let path = self.folder.join(file);
                std::fs::remove_file(&path).map_err(|e| files::cannot_write(&path, e))?;
            }
        }
        let text = json!({
            "identity": model.identity(), "network": model.path().file_name().map(|n| n.to_string_lossy()),
            "name": model.description().name, "licence": model.description().licence,
        });
        files::write(&note, serde_json::to_string_pretty(&text).expect("it is plain data").as_bytes())
    }

    /// What is to be done, image by image (of tracks: camera by camera), in the capture's order.
    fn jobs(&self) -> Vec<Job<'_>> {
        let ours = |path: &Path| path.starts_with(self.folder);
        let root = &self.capture.root;
        let mut cameras: BTreeMap<usize, BTreeMap<usize, &Frame>> = BTreeMap::new();
        for frame in &self.capture.frames {
            cameras.entry(frame.camera).or_default().insert(frame.index, frame);
        }
        let mut jobs: Vec<Job<'_>> = Vec::new();
        let mut seen: BTreeSet<String> = BTreeSet::new();
        for (camera, frames) in &cameras {
            if self.part == Part::Tracks {
                let own = frames.values().any(|f| f.tracks.as_ref().is_some_and(|t| !ours(&t.path)));
                let key = self.capture.cameras[*camera].name.clone();
                jobs.push(Job { key, frames: frames.values().copied().collect(), own });
                continue;
            }
            for (index, frame) in frames {
                let own = match self.part {
                    Part::Depth => frame.depth.as_ref().is_some_and(|d| !ours(&d.path)),
                    Part::Flow => frame.flow.as_ref().is_some_and(|f| !ours(&f.path)),
                    _ => frame.mask.as_ref().is_some_and(|m| !ours(m)),
                };
                let mut of_job = vec![*frame];
                if self.part == Part::Flow {
                    let Some(next) = frames.get(&(index + 1)) else { continue };
                    of_job.push(next);
                }
                let key = key_of(root, &frame.image);
                // Faces of a panorama share an image.
                if seen.insert(key.clone()) {
                    jobs.push(Job { key, frames: of_job, own });
                }
            }
        }
        jobs
    }

    /// The file of a job.
    fn one(&self, job: &Job<'_>) -> Result<Encoded> {
        match self.part {
            Part::Tracks => {
                let (mut last, mut links) = (self.image(job.frames[0])?, write::Links::default());
                for pair in job.frames.windows(2) {
                    unless_stopped(self.stop)?;
                    let next = self.image(pair[1])?;
                    if pair[1].index == pair[0].index + 1 {
                        links.add([pair[0].index, pair[1].index], &self.model.matches([&last, &next])?);
                    }
                    last = next;
                }
                Ok(links.encoded())
            }
            Part::Flow => {
                let [a, b] = [0, 1].map(|k| self.image(job.frames[k]));
                let (a, b) = (a?, b?);
                let (forth, back) = (self.model.map(&[&a, &b])?, self.model.map(&[&b, &a])?);
                Ok(write::flow(&forth.resized(a.width, a.height), &back.resized(b.width, b.height)))
            }
            part => {
                let image = self.image(job.frames[0])?;
                let map = self.model.map(&[&image])?;
                let output = &self.model.description().output;
                Ok(match (part, output.metric) {
                    (Part::Masks, _) => write::mask(&map.resized(image.width, image.height), output.threshold),
                    (_, metric) => write::depth(&write::sized(&map, [image.width, image.height]), metric),
                })
            }
        }
    }

    /// An image in the pixels of its camera. Errors: it has other pixels.
    fn image(&self, frame: &Frame) -> Result<Rgb8> {
        let image = Rgb8::read(&frame.image)?;
        if (image.width, image.height) == (frame.source.width, frame.source.height) {
            return Ok(image);
        }
        let what = format!(
            "expected an image of {}x{} pixels, found {}x{}",
            frame.source.width, frame.source.height, image.width, image.height
        );
        Err(Error::input(what).at(frame.image.display()).remedy(
            "Networks do not run on panoramas, nor on images whose EXIF orientation is not applied: convert them",
        ))
    }
}

/// Images that make a file.
struct Job<'a> {
    /// Its name in the list.
    key: String,
    frames: Vec<&'a Frame>,
    /// Whether the capture names a file of its own.
    own: bool,
}

/// An image's name in the list, as the capture's reader has it: its path below the folder, with slashes.
fn key_of(root: &Path, image: &Path) -> String {
    image.strip_prefix(root).unwrap_or(image).to_string_lossy().replace('\\', "/")
}

/// A name's file below the folder of its part, without ending: the same path where that is one on every system.
fn file_name(key: &str) -> String {
    let plain = |part: &str| {
        !part.is_empty()
            && !part.starts_with('.')
            && part.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c))
    };
    if key.len() < 120 && key.split('/').all(plain) { key.to_owned() } else { files::fingerprint(key) }
}

/// A file below a folder that is not listed.
fn others(folder: &Path, root: &Path, listed: &BTreeSet<PathBuf>) -> Option<PathBuf> {
    let mut entries: Vec<PathBuf> = std::fs::read_dir(folder).ok()?.flatten().map(|e| e.path()).collect();
    entries.sort();
    entries.into_iter().find_map(|path| {
        let hidden = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
        match path.is_dir() {
            true => others(&path, root, listed),
            false if hidden => None,
            false => path.strip_prefix(root).ok().filter(|p| !listed.contains(*p)).map(|_| path.clone()),
        }
    })
}

#[cfg(all(test, feature = "models"))]
mod tests;
