//! The work behind `edit`: finds what edits refer to (cameras, masks, other scenes, the capture's images).

use crate::baking::title;
use crate::converting::{self, Conversion};
use crate::events::Listener;
use crate::files::{self, grouped};
use crate::paths::View;
use crate::run_folder::Run;
use crate::sound;
use crate::source::{Source, not_empty};
use serde_json::json;
use splat4d::edit::{Context, Edits, Expr, Mask, Selected, Step, count, mask_fits, replay};
use splat4d::format::playback::Provenance;
use splat4d::layers::Scene;
use splat4d::scene::{Camera, Planes, Time};
use splat4d::{Error, Result};
#[cfg(feature = "dynamics")]
use splat4d_dynamics::{nodes::follow_among, paths::Pose};
use splat4d_train::capture::frames::{Frames, Picture};
use splat4d_train::capture::{Capture, ImageStore, Rgb8};
use splat4d_train::eval::floaters::support;
use splat4d_train::eval::metrics::psnr;
use splat4d_train::output::rfc3339;
use splat4d_train::run::available_memory;
use splat4d_train::run::dataset::Dataset;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

/// Masks of images that are examined for the subject, at most: each costs one pass over the whole scene.
const MOST_MASKS: usize = 120;
/// Held-out images that are compared before and after floaters are removed.
const COMPARED: usize = 40;
/// Above this a mask's pixel is white, of 1.
const WHITE: f32 = 0.5;
/// Weights of red, green and blue in the brightness of a mask in colour (ITU-R BT.709).
const LUMA: [f32; 3] = [0.2126, 0.7152, 0.0722];

/// Times of the clip at which [`EditOptions::count`] counts what is visible.
const MOMENTS: usize = 5;

/// Options of [`edit`].
#[derive(Clone, Debug, Default)]
pub struct EditOptions {
    /// The run or scene: everything that is converted.
    pub scene: PathBuf,
    /// A list of edits, TOML.
    pub list: Option<PathBuf>,
    /// More steps, after those of the list.
    pub steps: Vec<Step>,
    /// The file to write; its extension selects the format. Required unless `count` is given.
    pub output: Option<PathBuf>,
    /// Count this selection over time, and write nothing.
    pub count: Option<String>,
    /// A note for the provenance of a playback file.
    pub note: Option<String>,
    /// Write no provenance.
    pub no_provenance: bool,
    /// Write the list including `steps`.
    pub save: Option<PathBuf>,
}

/// Replays edits on a scene and writes the result in the format of the output's extension.
///
/// Errors: a list that cannot be read; nothing to do; a step that fails; an output that cannot be written, in which
/// case the old file stays.
///
/// ```no_run
/// use splat4d::edit::Step;
/// use splat4d_workflow::editing::{EditOptions, edit};
/// use splat4d_workflow::events::ignore;
///
/// # fn main() -> splat4d::Result<()> {
/// edit(
///     &EditOptions {
///         scene: "runs/take".into(),
///         steps: vec![Step::Delete { select: "sphere(0,0,3, 0.5)".into() }],
///         output: Some("take.s4d".into()),
///         ..EditOptions::default()
///     },
///     &ignore,
/// )
/// # }
/// ```
pub fn edit(options: &EditOptions, console: &dyn Listener) -> Result<()> {
    // Unwritable outputs are reported before the work.
    if let Some(output) = &options.output {
        converting::check_output(output)?;
    }
    let list = options.list.as_deref().map(read).transpose()?.unwrap_or_default();
    let edits = with_steps(list, options.steps.iter().cloned());
    let mut source = Source::open(&options.scene)?.finite();
    not_empty(&source.scene, &options.scene)?;
    source.warnings.lines().iter().for_each(|w| console.warn(&format!("{w}.")));
    let listed: Vec<&Path> = options.list.iter().map(PathBuf::as_path).collect();
    let outputs: Vec<&Path> = options.output.iter().chain(&options.save).map(PathBuf::as_path).collect();
    source.keep_all(&options.scene, &outputs, &[])?;
    for file in options.output.iter().chain(&options.save) {
        // A list may be saved with further steps in its own place.
        let others = if options.save.as_ref() == Some(file) { &[] } else { &listed[..] };
        source.keep(&options.scene, file, others)?;
    }
    let title = title(&source, &options.scene);
    edits.check(&title)?;
    if edits.steps.is_empty() && options.count.is_none() {
        return Err(Error::input("nothing to do").remedy("Give a list of edits, or one edit such as option `delete`."));
    }
    let bring = Bring::new(&source, options.list.as_deref(), console)?;
    let before = source.scene.len();
    let (scene, done) = replay(&edits.steps, source.scene.clone(), &bring, &mut |done, all| {
        console.phase("editing", done, all);
    })?;
    console.clear();
    let read = bring.read();
    source.keep_all(&options.scene, &outputs, &read.iter().map(PathBuf::as_path).collect::<Vec<_>>())?;
    for step in &done {
        console.result(&format!("{}: {} Gaussians", step.step, grouped(step.selected)));
    }
    if let Some(text) = &options.count {
        return print_count(text, &scene, &bring, console);
    }
    console.result(&format!(
        "{} Gaussians of {} in {} layers",
        grouped(scene.len()),
        grouped(before),
        scene.layers.len()
    ));
    console.emit(&json!({"type": "edited", "before": before, "gaussians": scene.len(), "layers": scene.layers.len(),
        "steps": done}));
    source.scene = scene;
    if let (Some(own), Some(output)) = (source.sound.take(), &options.output) {
        // Files of other formats have none anyway.
        source.sound = match files::is_playback(output) {
            true => sound::edited(own, &edits.steps, &source.scene, output, console),
            false => Some(own),
        };
    }
    let earlier = source.provenance.take();
    source.provenance = (!options.no_provenance).then(|| provenance(&source, earlier, &edits, options.note.clone()));
    if let Some(path) = &options.save {
        write(path, &Edits { scene: Some(title), ..edits })?;
        console.written(path);
    }
    let output = options.output.as_ref().ok_or_else(|| {
        Error::input("no output was given").remedy("Name the file to write, or a selection to count.")
    })?;
    converting::write(&Conversion::new(&options.scene, output), source, console)
}

/// Reports how many Gaussians a selection holds, and how many of them are visible when.
fn print_count(text: &str, scene: &Scene<f32>, context: &dyn Context, console: &dyn Listener) -> Result<()> {
    let [start, end] = scene.clip;
    let mut times: Vec<f64> = (0..MOMENTS).map(|i| start + (end - start) * i as f64 / (MOMENTS - 1) as f64).collect();
    times.dedup();
    let (all, seen) = count(&Expr::parse(text)?, scene, &times, context)?;
    console.clear();
    console.result(&format!("{text}: {} of {} Gaussians", grouped(all), grouped(scene.len())));
    for (t, n) in times.iter().zip(&seen) {
        console.result(&format!("{t:>9.3} s  {} visible", grouped(*n)));
    }
    console.emit(&json!({"type": "count", "selection": text, "gaussians": all, "of": scene.len(),
        "seen": times.iter().zip(&seen).map(|(t, n)| json!([t, n])).collect::<Vec<_>>()}));
    Ok(())
}

/// Sources of the data that edits name.
pub struct Bring<'a> {
    source: &'a Source,
    /// Names of files are relative to this folder, that of the edits.
    folder: PathBuf,
    views: Vec<View>,
    console: &'a dyn Listener,
    /// Masks and scenes that steps have named.
    read: Mutex<Vec<PathBuf>>,
}

impl<'a> Bring<'a> {
    pub fn new(source: &'a Source, edits: Option<&Path>, console: &'a dyn Listener) -> Result<Self> {
        let folder = edits.and_then(Path::parent).map(Path::to_owned).unwrap_or_default();
        Ok(Self { source, folder, views: source.views()?, console, read: Mutex::default() })
    }

    /// The file of that name, which is read.
    fn file(&self, name: &str) -> PathBuf {
        let path = self.folder.join(name);
        self.read.lock().unwrap_or_else(PoisonError::into_inner).push(path.clone());
        path
    }

    /// The files that previous steps have named.
    fn read(&self) -> Vec<PathBuf> {
        self.read.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn capture(&self) -> Result<(Arc<Capture>, Dataset, bool)> {
        let Some(run) = &self.source.run else {
            return Err(
                Error::input("a scene file does not contain its training images").remedy("Give the run folder.")
            );
        };
        let (capture, recipe) = run.open_capture()?;
        let capture = Arc::new(capture);
        let memory = usize::try_from(recipe.run.image_memory).unwrap_or(usize::MAX);
        // All frames, so that their numbers are the capture's.
        let store = Arc::new(ImageStore::new(capture.clone(), memory));
        let data = Dataset::new(store, (0..capture.frames.len()).collect());
        Ok((capture, data, recipe.appearance.antialias))
    }
}

impl Context for Bring<'_> {
    fn camera(&self, name: &str) -> Result<Camera> {
        let found = self.views.iter().find(|v| v.name == name);
        found.map(|v| v.camera.clone()).ok_or_else(|| {
            let mut names: Vec<&str> = self.views.iter().map(|v| v.name.as_str()).collect();
            names.dedup();
            names.truncate(12);
            let remedy = if names.is_empty() {
                "Give a run folder, or a .s4d that contains its cameras.".to_owned()
            } else {
                format!("It has: {}.", names.join(", "))
            };
            Error::input(format!("the scene has no camera `{name}`")).remedy(remedy)
        })
    }

    fn mask(&self, name: &str, camera: &Camera) -> Result<Mask> {
        let luma = |rgb: &[u8]| LUMA.iter().zip(rgb).map(|(w, &v)| w * f32::from(v) / 255.0).sum::<f32>();
        let path = self.file(name);
        // The header's size first: a small file may claim gigabytes of pixels.
        mask_fits(Rgb8::size(&path)?, camera, name)?;
        let Rgb8 { width, height, data } = Rgb8::read(&path)?;
        Ok(Mask { width, height, white: data.chunks_exact(3).map(|rgb| luma(rgb) > WHITE).collect() })
    }

    fn subject(&self) -> Result<Vec<(Camera, Time, Mask)>> {
        let (capture, data, _) = self.capture()?;
        if !data.has_masks() {
            return Err(Error::input("the capture has no masks, so its subject is unknown")
                .at(capture.root.display())
                .remedy("Add masks to the capture, or select by position: box, sphere."));
        }
        let step = capture.train.len().div_ceil(MOST_MASKS).max(1);
        let chosen: Vec<usize> = capture.train.iter().copied().step_by(step).collect();
        let (mut out, mut picture) = (Vec::new(), Picture::default());
        for (i, &frame) in chosen.iter().enumerate() {
            data.load(frame, &mut picture)?;
            if let Some(Planes { width, height, data, .. }) = &picture.mask {
                let mask = Mask { width: *width, height: *height, white: data.iter().map(|v| *v > WHITE).collect() };
                let view = &capture.frames[frame];
                out.push((view.view.clone(), view.time, mask));
            }
            self.console.phase("reading masks", i + 1, chosen.len());
        }
        Ok(out)
    }

    fn scene(&self, name: &str) -> Result<Scene<f32>> {
        Ok(Source::open(&self.file(name))?.scene)
    }

    fn memory(&self) -> Option<u64> {
        available_memory()
    }

    fn floaters(&self, scene: &Scene<f32>, strength: f64) -> Result<Selected> {
        let found = self.propose(scene, strength)?;
        let Proposal { selected, pictures, before, after } = found;
        self.console.clear();
        let count = selected.iter().flatten().filter(|f| **f).count();
        self.console.result(&format!(
            "floaters: {} of {} Gaussians; {pictures} held-out images: {before:.2} dB with them, {after:.2} dB without",
            grouped(count),
            grouped(scene.len())
        ));
        self.console.emit(&json!({"type": "floaters", "found": count, "strength": strength,
            "pictures": pictures, "psnr_before": before, "psnr_after": after}));
        Ok(selected)
    }

    #[cfg(not(feature = "dynamics"))]
    fn follow(&self, _: &Scene<f32>, _: &Selected, _: &[[f64; 3]], _: &[f64], _: usize) -> Result<Vec<Vec<[f64; 3]>>> {
        Err(crate::parts::left_out("following what moves", "dynamics"))
    }

    #[cfg(feature = "dynamics")]
    fn follow(
        &self,
        scene: &Scene<f32>,
        among: &Selected,
        start: &[[f64; 3]],
        times: &[f64],
        first: usize,
    ) -> Result<Vec<Vec<[f64; 3]>>> {
        self.console.phase("following nodes", 0, 0);
        let start = start.iter().map(|x| Pose::at(*x)).collect();
        let among: Vec<bool> = among.iter().flatten().copied().collect();
        let back: Vec<f64> = times[..=first].iter().rev().copied().collect();
        let mut moments = follow_among(scene, &start, &back, &among);
        moments.reverse();
        moments.extend(follow_among(scene, &start, &times[first..], &among).into_iter().skip(1));
        self.console.clear();
        Ok(moments.into_iter().map(|moment| moment.into_iter().map(|pose| pose.x).collect()).collect())
    }
}

/// Gaussians that float, and what held-out images show about them.
pub struct Proposal {
    pub selected: Selected,
    /// Images that were compared, and their mean PSNR with and without the floaters, dB.
    pub pictures: usize,
    pub before: f64,
    pub after: f64,
}

impl Bring<'_> {
    /// Searches for floaters.
    ///
    /// Errors: no run with its capture, no held-out views, a strength that is not from 0 to 1.
    pub fn propose(&self, scene: &Scene<f32>, strength: f64) -> Result<Proposal> {
        if !(0.0..=1.0).contains(&strength) {
            return Err(Error::input(format!("invalid strength {strength}")).remedy("Give 0 to 1"));
        }
        let (capture, data, antialias) = self.capture()?;
        let measured = support(scene, &data, &capture.train, &capture.held, antialias, &mut |done, total| {
            self.console.phase("searching for floaters", done, total);
        })?;
        let found = measured.floaters(strength);
        let mut without = scene.clone();
        for (layer, found) in without.layers.iter_mut().zip(&found) {
            let keep = found.iter().map(|f| !f);
            let edit = splat4d::scene::RowEdit::prune(splat4d::scene::Space::Gaussians, keep);
            layer.edit(&edit, &splat4d::math::Rng::new(0, "floaters", 0));
        }
        let step = capture.held.len().div_ceil(COMPARED).max(1);
        let held: Vec<usize> = capture.held.iter().copied().step_by(step).collect();
        let [before, after] = [mean_psnr(scene, &data, &held)?, mean_psnr(&without, &data, &held)?];
        Ok(Proposal { selected: found, pictures: held.len(), before, after })
    }
}

/// The mean PSNR of some images, dB.
fn mean_psnr(scene: &Scene<f32>, data: &Dataset, frames: &[usize]) -> Result<f64> {
    let (mut picture, mut sum) = (Picture::default(), 0.0);
    for &frame in frames {
        data.load(frame, &mut picture)?;
        let seen = splat4d::draw(scene, data.camera(frame), data.time(frame))?.color;
        sum += psnr(&seen, &picture.color).unwrap_or(0.0);
    }
    Ok(sum / frames.len().max(1) as f64)
}

/// Reads a list of edits.
pub fn read(path: &Path) -> Result<Edits> {
    toml::from_str(&files::read_text(path)?).map_err(|e| {
        let line = e.span().map_or(String::new(), |s| format!(" (byte {})", s.start));
        Error::input(format!("invalid list of edits{line}: {}", e.message()))
            .at(path.display())
            .remedy("docs/edit.md lists all steps.")
    })
}

/// Writes a list of edits.
pub fn write(path: &Path, edits: &Edits) -> Result<()> {
    let text = toml::to_string_pretty(edits).map_err(|e| Error::input(format!("cannot be written as TOML: {e}")))?;
    files::write(path, text.as_bytes())
}

/// The steps of options, behind those of a file.
pub fn with_steps(mut edits: Edits, steps: impl IntoIterator<Item = Step>) -> Edits {
    edits.steps.extend(steps);
    edits
}

/// Provenance of an edited scene: that of its file, with these edits appended and another text if there are some.
pub fn provenance(source: &Source, earlier: Option<Provenance>, edits: &Edits, words: Option<String>) -> Provenance {
    let earlier = earlier.unwrap_or_default();
    let print = |run: &Run| run.info.get("capture_fingerprint")?.as_str().map(str::to_owned);
    let capture = source.run.as_ref().and_then(print);
    let steps = edits.steps.iter().map(|s| serde_json::to_value(s).expect("steps are plain data"));
    Provenance {
        made_with: concat!("splat4d ", env!("CARGO_PKG_VERSION")).into(),
        when: Some(rfc3339(SystemTime::now())),
        capture: capture.or(earlier.capture),
        edits: earlier.edits.into_iter().chain(steps).collect(),
        words: words.or(earlier.words),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::events::ignore;
    use splat4d::math::Se3;

    #[test]
    fn edits_round_trip_as_toml() {
        let text = r#"
            version = 1
            scene = "knight"

            [[edit]]
            do = "delete"
            select = "box(-1,-1,0, 1,1,2) and not layer('hair')"

            [[edit]]
            do = "move"
            select = "all"
            keys = [{ t = 0.0, shift = [0, 0, 0] }, { t = 1.0, shift = [0, 0, 1.5], turn = [0, 0, 1, 90] }]

            [[edit]]
            do = "drag"
            select = "layer(dancer)"
            at = 0.5
            pins = [[0, 0, 0, 0.3]]
            handles = [{ place = [0, 0, 1], keys = [{ t = 0.5, by = [0, 0, 0] }, { t = 1.0, by = [0, 0.2, 0] }] }]
        "#;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("edits.toml");
        std::fs::write(&path, text).unwrap();
        let edits = read(&path).unwrap();
        assert_eq!(edits.steps.len(), 3);
        write(&path, &edits).unwrap();
        assert_eq!(read(&path).unwrap(), edits);
        std::fs::write(&path, "version = 1\n[[edit]]\ndo = \"explode\"\n").unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains("edits.toml") && error.contains("explode"), "{error}");
    }

    #[test]
    fn a_mask_of_another_size_is_refused_by_its_header() {
        let folder = tempfile::tempdir().unwrap();
        // A header that claims 400 million pixels, and nothing behind it.
        let mut bytes = Vec::new();
        drop(png::Encoder::new(&mut bytes, 20_000, 20_000).write_header().unwrap());
        // An empty chunk of pixels, with its checksum, in place of the end.
        bytes.truncate(bytes.len() - 12);
        bytes.extend(b"\0\0\0\0IDAT\x35\xaf\x06\x1e");
        std::fs::write(folder.path().join("m.png"), bytes).unwrap();
        let source = Source::own(Scene::default());
        let edits = folder.path().join("edits.toml");
        let bring = Bring::new(&source, Some(&edits), &ignore).unwrap();
        let camera = Camera::with_fov_y(Se3::IDENTITY, 0.8, 40, 30);
        let error = bring.mask("m.png", &camera).unwrap_err().to_string();
        assert!(error.contains("20000 x 20000") && error.contains("40 x 30"), "{error}");
        assert!(bring.mask("none.png", &camera).is_err());
    }
}
