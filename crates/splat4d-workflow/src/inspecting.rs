//! The work behind `info`: what a capture, a run or a file contains, and whether it looks healthy.

#[cfg(feature = "import")]
mod doctor;
mod playback;

pub use playback::{Conformance, conformance};

use crate::activity::Activity;
use crate::chunked;
use crate::evaluating;
use crate::events::Listener;
use crate::files::{self, grouped, human_bytes, human_seconds};
use crate::run_folder::{Origin, Run, check_written};
use crate::sound;
use crate::source::{Source, bundle, cloud, read_scene};
use crate::{sequence, status};
use serde_json::{Value, json};
use splat4d::format::sog;
use splat4d::layers::{Head, Scene};
use splat4d::math::sh::degree_of;
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, SH};
use splat4d::text::in_line;
use splat4d::{Error, Result};
#[cfg(feature = "import")]
use splat4d_import::shipped;
use splat4d_train::capture::{self, Aspect, Capture, CaptureKind, Finding, Frame, Reach, Severity, Timing};
use splat4d_train::event::Event;
use splat4d_train::output::{Owner, check_apart};
use splat4d_train::path_text::{in_command, to_text};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::chunks::ChunkEstimate;
use splat4d_train::run::{Stopwatch, memory_estimate, open_capture};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Edges of the opacity histogram.
const OPACITY_EDGES: [f64; 6] = [0.0, 0.005, 0.1, 0.5, 0.9, 1.0];
/// Decades of the scale histogram, as powers of ten of the scene's radius.
const SCALE_EDGES: [f64; 6] = [-8.0, -4.0, -3.0, -2.0, -1.0, 3.0];
/// Share of nearly invisible Gaussians above which a file wastes much of its size.
const MANY_FAINT: f64 = 0.5;
/// A Gaussian larger than the scene's radius is usually a floater or a sky.
const HUGE: f64 = 1.0;
/// Share of huge Gaussians that is not healthy.
const MANY_HUGE: f64 = 0.02;
/// Below this many Gaussians shares carry no information.
const FEW: usize = 100;
/// Layers that are listed; playback files have one per page, and their sections are printed already.
const MANY_LAYERS: usize = 8;
/// Longest bar of a histogram, characters.
const BAR: usize = 32;

/// Remarks of readers about values that cannot be right; all other remarks are notes. Base colours that are all bright
/// may be those of a bright scene.
const DOUBTS: [&str; 9] = [
    "--linear scales",
    "--linear opacities",
    "RGB from 0 to 255",
    "where single precision has steps",
    "more rows than its header states",
    "a network that splat4d does not read",
    "steps of a training rather than frames",
    "rendered as Gaussians, which looks different",
    "the poster is damaged",
];

/// Options of [`inspect`].
#[derive(Clone, Debug, Default)]
pub struct InspectOptions {
    /// Options of reading a capture.
    pub recipe: Recipe,
    /// Check a capture's images and poses too, and write `doctor.html` and `doctor.json` into this folder.
    pub doctor: Option<PathBuf>,
}

/// Content of a capture, a run or a file.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Inspection {
    /// All of it, for programs ([docs/events.md](https://github.com/splat4d/splat4d/blob/main/docs/events.md)).
    pub json: Value,
    /// The same for people, in lines.
    pub text: String,
    /// Reasons why it does not look healthy.
    pub troubles: Vec<String>,
    /// More reasons, which `text` contains already.
    pub listed: Vec<String>,
    /// Whether nothing in a capture determines if its poses are right.
    pub poses_unchecked: bool,
}

impl Inspection {
    /// Whether nothing is wrong with it.
    pub fn is_healthy(&self) -> bool {
        self.troubles.is_empty() && self.listed.is_empty()
    }
}

/// Reads what a capture, a run or a scene file contains, and whether it looks healthy.
///
/// Errors: no such file or folder; it cannot be read.
///
/// ```no_run
/// use splat4d_workflow::inspecting::{InspectOptions, inspect};
/// # fn main() -> splat4d::Result<()> {
/// let found = inspect("scene.ply".as_ref(), &InspectOptions::default(), &splat4d_workflow::events::ignore)?;
/// println!("{} Gaussians, healthy: {}", found.json["gaussians"], found.is_healthy());
/// # Ok(())
/// # }
/// ```
pub fn inspect(path: &Path, options: &InspectOptions, console: &dyn Listener) -> Result<Inspection> {
    if !path.exists() {
        return Err(Error::input("there is no such file or folder")
            .at(path.display())
            .remedy("Give a capture, a run or a scene file."));
    }
    let marker = capture::is_metadata(path);
    let sog = path.join(sog::META).is_file() || path.file_name().is_some_and(|name| name == sog::META);
    let levels = path.file_name().is_some_and(|name| name == sog::levels::LEVELS);
    // Numbered files of Gaussians, in a folder or by a pattern, unless a capture's folder holds them.
    let frames = || !capture::is_folder(path) && sequence::frames(path).is_ok();
    let foreign = sog || levels || (path.is_dir() && (bundle::is_scene(path) || frames()));
    let is_capture = !Run::is(path) && !foreign && (path.is_dir() || marker);
    if options.doctor.is_some() && !is_capture {
        return Err(Error::input("the doctor checks captures only")
            .at(path.display())
            .remedy("Give a capture's folder, or leave option `doctor` out."));
    }
    if options.doctor.is_some() && !cfg!(feature = "import") {
        return Err(crate::parts::left_out("the doctor", "import"));
    }
    if Run::is(path) {
        of_run(path)
    } else if is_capture {
        check_written(path)?;
        of_capture(path, options, console)
    } else {
        of_file(path)
    }
}

fn line(out: &mut String, name: &str, value: &str) {
    let _ = writeln!(out, "{name:<16} {}", in_line(value));
}

fn of_capture(path: &Path, options: &InspectOptions, console: &dyn Listener) -> Result<Inspection> {
    let recipe = &options.recipe;
    #[cfg(feature = "import")]
    if let Some(found) = shipped::contents(path)? {
        return Ok(of_shipped(path, &found));
    }
    // Files next to images are listed even if this recipe does not use them.
    let all = recipe.clone().with(|r| (r.loss.depth, r.loss.flow, r.loss.tracks) = (1.0, 1.0, 1.0));
    let mut capture = open_capture(path, &all)?;
    let priors = priors(&capture);
    for frame in &mut capture.frames {
        frame.depth = frame.depth.take().filter(|_| recipe.loss.depth > 0.0);
        frame.flow = frame.flow.take().filter(|_| recipe.loss.flow > 0.0);
        frame.tracks = frame.tracks.take().filter(|_| recipe.loss.tracks > 0.0);
    }
    if let Some(folder) = &options.doctor {
        check_apart(folder, &Origin::of(&capture).inputs().collect::<Vec<_>>())?;
        // Before the images are read, which takes a while.
        files::make_folder(folder)?;
        #[cfg(feature = "import")]
        return doctor::of(&capture, folder, console);
    }
    let (first, last) = capture.time_range();
    let (times, sizes) = (capture.times(), sizes(&capture));
    let capture = Arc::new(capture);
    let mut listen = |event: &Event| console.event(event);
    let outlook = ChunkEstimate::new(&capture, recipe, None, 0.0, true, &Stopwatch::start(), &mut listen)?;
    console.clear();
    let memory = outlook.as_ref().map_or_else(|| memory_estimate(&capture, recipe), |o| o.memory);
    let checked = capture.check_poses();
    let poses_unchecked = checked.finding.aspect == Some(Aspect::NotChecked);
    let written_as = checked.written_as.map(|p| p.to_string());
    let mut findings = capture.preflight();
    findings.push(checked.finding);
    findings.extend(checked.more);
    let fixed = capture.cameras.iter().filter(|c| c.fixed).count();
    let moving = capture.cameras.len() - fixed;
    let held: Vec<String> = held_cameras(&capture);
    let masks = capture.frames.iter().filter(|f| f.mask.is_some()).count();

    let mut text = String::new();
    let layout = match capture.kind {
        CaptureKind::Own => "capture.json".to_owned(),
        other => format!("{other:?}"),
    };
    line(&mut text, "capture", &format!("{} ({layout})", capture.name));
    line(&mut text, "cameras", &format!("{fixed} fixed, {moving} moving"));
    let plural = if times.len() == 1 { "" } else { "s" };
    let pictures = format!("{} at {} time{plural}", grouped(capture.frames.len()), grouped(times.len()));
    line(&mut text, "images", &pictures);
    let all: Vec<String> = sizes.iter().map(|s| format!("{}x{}", s[0], s[1])).collect();
    line(&mut text, "size", &all.join(", "));
    let span = format!("{first:.3} to {last:.3} s, {} frames per second", capture.fps);
    line(
        &mut text,
        "time",
        &match capture.timing {
            Timing::Moment => "one time: a photo set, no times are given".to_owned(),
            Timing::Numbers => format!("{span}; from the numbers in image names, no times are given"),
            _ => span,
        },
    );
    let mut split = format!("{} to train on, {} held out", grouped(capture.train.len()), grouped(capture.held.len()));
    if !capture.validation.is_empty() {
        let _ = write!(split, ", {} for validation", capture.validation.len());
    }
    if !held.is_empty() && held.len() <= 12 {
        let _ = write!(split, " (cameras {})", held.join(", "));
    }
    line(&mut text, "split", &split);
    line(&mut text, "masks", &format!("{masks} of {}", capture.frames.len()));
    let points = capture.points.as_ref().map_or("none".into(), |p| grouped(p.points.len()));
    line(&mut text, "initial points", &points);
    if !priors.is_empty() {
        line(&mut text, "priors", &priors.join(", "));
    }
    let reach = capture.reach();
    if let Some(reach) = &reach {
        line(&mut text, "valid views", &in_words(reach));
    }
    line(&mut text, "memory", &format!("about {} with the default recipe", human_bytes(memory)));
    if let Some(outlook) = &outlook {
        line(&mut text, "training", &chunked::in_words(outlook));
    }
    let (mut troubles, mut listed) = (Vec::new(), Vec::new());
    match sound::of_capture(path) {
        Ok(Some(sound)) => line(&mut text, "sound", &sound::in_words(&sound)),
        Ok(None) => {}
        Err(e) => troubles.push(format!("Its sound cannot be used: {e}.")),
    }
    let sentence = |f: &Finding| format!("{} {}", f.what, f.remedy).trim_end().to_owned();
    for finding in findings.iter().filter(|f| f.aspect.is_none()) {
        match finding.severity {
            Severity::Warning => troubles.push(sentence(finding)),
            Severity::Note => line(&mut text, "note", &sentence(finding)),
        }
    }
    // One block: content not found, not read, assumed or not checked; warnings first.
    for (name, aspect) in Aspect::ALL {
        let mut of: Vec<&Finding> = findings.iter().filter(|f| f.aspect == Some(aspect)).collect();
        of.sort_by_key(|f| std::cmp::Reverse(f.severity));
        for finding in of {
            let mark = if finding.severity == Severity::Warning { "! " } else { "" };
            line(&mut text, name, &format!("{mark}{}", sentence(finding)));
            if finding.severity == Severity::Warning {
                listed.push(sentence(finding));
            }
        }
    }
    let json = json!({
        "type": "capture", "name": capture.name, "layout": format!("{:?}", capture.kind),
        "fixed_cameras": fixed, "moving_cameras": moving, "pictures": capture.frames.len(), "moments": times.len(),
        "sizes": sizes, "first_second": first, "last_second": last, "fps": capture.fps,
        "timing": format!("{:?}", capture.timing).to_lowercase(),
        "train": capture.train.len(), "held_out": capture.held.len(), "validation": capture.validation.len(),
        "held_out_cameras": held, "masks": masks, "points": capture.points.as_ref().map(|p| p.points.len()),
        "priors": priors, "views_hold": reach.map(|r| json!({"center": r.center, "degrees": r.degrees,
            "distances": r.distances, "held_out_cameras": r.held[0], "held_out_cameras_beyond": r.held[1]})),
        "poses_written_as": written_as, "memory_estimate": memory, "chunks": outlook.as_ref().map(|o| o.plan.len()),
        "training_seconds": outlook.as_ref().and_then(|o| o.seconds),
        "findings": findings.iter().map(|f| json!({"severity": format!("{:?}", f.severity).to_lowercase(),
            "about": f.aspect.map(Aspect::name), "what": f.what, "remedy": f.remedy})).collect::<Vec<_>>(),
    });
    Ok(Inspection { json, text, troubles, listed, poses_unchecked })
}

/// A capture that is shipped as a video per camera with poses, whose frames are not extracted yet.
#[cfg(feature = "import")]
fn of_shipped(path: &Path, found: &shipped::Contents) -> Inspection {
    let name = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let name = name.file_name().map_or_else(|| "capture".into(), |n| n.to_string_lossy().into_owned());
    let frames: Option<usize> = found.cameras.iter().map(|(_, n)| *n).sum();
    let mut text = String::new();
    line(
        &mut text,
        "capture",
        &format!("{name} (Neural 3D Video as shipped: a video per camera, and poses_bounds.npy)"),
    );
    let names: Vec<&str> = found.cameras.iter().map(|(name, _)| name.as_str()).collect();
    line(&mut text, "cameras", &format!("{} fixed ({})", names.len(), in_short(&names)));
    let sizes: Vec<String> = found.sizes.iter().map(|[w, h]| format!("{w}x{h}")).collect();
    line(&mut text, "size", &sizes.join(", "));
    let rate = found.rate.map_or("unknown".into(), |r| format!("{:.3}", r));
    let seconds = found.seconds.map_or(String::new(), |s| format!("{s:.3} s, "));
    line(&mut text, "time", &format!("{seconds}{rate} frames per second"));
    line(&mut text, "frames", &frames.map_or("the files do not state how many".into(), grouped));
    let [width, height] = found.extracted;
    let extracts = format!(
        "Frames are still in the videos: `splat4d train {}` extracts them to {} ({width}x{height}) and trains.",
        in_command(path),
        path.join("images").display()
    );
    line(&mut text, "note", &extracts);
    let unchecked = "Poses and images: frames are not extracted yet; run info again after that.";
    line(&mut text, Aspect::NotChecked.name(), unchecked);
    let findings =
        found.warnings.iter().map(|what| json!({"severity": "warning", "about": null, "what": what, "remedy": ""}));
    let notes = [
        json!({"severity": "note", "about": null, "what": extracts, "remedy": ""}),
        json!({"severity": "note", "about": Aspect::NotChecked.name(), "what": unchecked, "remedy": ""}),
    ];
    let json = json!({
        "type": "capture", "name": name, "layout": "N3dv", "extracted": false,
        "fixed_cameras": names.len(), "moving_cameras": 0, "pictures": frames, "sizes": found.sizes,
        "moments": found.cameras.iter().filter_map(|(_, n)| *n).max(), "fps": found.rate, "cameras": names,
        "findings": findings.chain(notes).collect::<Vec<_>>(),
    });
    Inspection { json, text, troubles: found.warnings.clone(), listed: Vec::new(), poses_unchecked: true }
}

/// The first and the last name of a list, and those between where there are few.
#[cfg(feature = "import")]
fn in_short(names: &[&str]) -> String {
    /// Names that are listed.
    const LISTED: usize = 6;
    match names {
        [first, .., last] if names.len() > LISTED => format!("{first} to {last}"),
        _ => names.join(", "),
    }
}

/// Files next to the images, as text.
fn priors(capture: &Capture) -> Vec<String> {
    let count = |has: fn(&Frame) -> bool| capture.frames.iter().filter(|f| has(f)).count();
    type Has = fn(&Frame) -> bool;
    let kinds: [(&str, Has); 3] =
        [("depth", |f| f.depth.is_some()), ("flow", |f| f.flow.is_some()), ("tracks", |f| f.tracks.is_some())];
    let counted = kinds.map(|(name, has)| (name, count(has)));
    counted.iter().filter(|(_, n)| *n > 0).map(|(name, n)| format!("{name} of {}", grouped(*n))).collect()
}

fn in_words(reach: &Reach) -> String {
    let [x, y, z] = reach.center;
    let mut out = format!(
        "within about {:.0}° of a training camera, seen from ({x:.2}, {y:.2}, {z:.2}), at distances of {:.2} to \
         {:.2} units",
        reach.degrees, reach.distances[0], reach.distances[1]
    );
    if reach.held[1] > 0 {
        let _ = write!(out, "; {1} of {0} held-out cameras are farther away", reach.held[0], reach.held[1]);
    }
    out
}

fn sizes(capture: &Capture) -> Vec<[usize; 2]> {
    let mut sizes: Vec<[usize; 2]> = capture.frames.iter().map(|f| [f.view.width, f.view.height]).collect();
    sizes.sort_unstable();
    sizes.dedup();
    sizes
}

/// Names of the cameras with held-out frames, where each of them is one of a rig.
fn held_cameras(capture: &Capture) -> Vec<String> {
    let mut ids: Vec<usize> = capture.held.iter().map(|&i| capture.frames[i].camera).collect();
    ids.sort_unstable();
    ids.dedup();
    ids.into_iter().map(|c| capture.cameras[c].name.clone()).collect()
}

fn of_run(path: &Path) -> Result<Inspection> {
    let run = Run::open(path)?;
    let mut text = String::new();
    let mut troubles = Vec::new();
    line(&mut text, "run", &run.name());
    if let Some(capture) = run.capture() {
        line(&mut text, "capture", &capture.display().to_string());
        // On object storage.
        let is_elsewhere = capture.to_str().is_some_and(|text| text.contains("://"));
        if !is_elsewhere && !capture.exists() {
            troubles.push(
                "The capture is not there any more: the run can be rendered, but neither resumed nor measured.".into(),
            );
        }
    }
    let name = in_command(path);
    let owner = Owner::holder(path).map(|who| who.map_or_else(|| "another process".into(), |who| who.to_string()));
    let mut changed: Vec<String> = Vec::new();
    match run.recipe() {
        Ok(recipe) => {
            changed.extend(recipe.choices().iter().map(|(key, value)| format!("{key}={value}")));
            let choices = if changed.is_empty() { "all defaults".to_owned() } else { changed.join(" ") };
            line(&mut text, "recipe", &format!("{}; {choices}", recipe.run.motion));
        }
        // Its owner has just taken the folder.
        Err(_) if run.recipe.is_none() && owner.is_some() => line(&mut text, "recipe", "not written yet"),
        Err(e) => return Err(e),
    }
    let total = run.number("iterations").or_else(|| run.recipe().ok().map(|r| r.run.iterations as f64));
    let status = status::of(path)?;
    let finished = status.finished;
    // Each chunk has the recipe's steps.
    let (done, total) = if status.chunked { (status.steps(), None) } else { (run.iteration().unwrap_or(0), total) };
    let of = total.map(|n| format!(" of {}", grouped(n as usize))).unwrap_or_default();
    line(&mut text, "progress", &format!("{}, step {}{of}", status.progress(), grouped(done)));
    match &owner {
        Some(owner) => line(&mut text, "owner", owner),
        // Each chunk has an owner of its own.
        None if !finished && !status.chunked => line(&mut text, "owner", "none"),
        None => {}
    }
    if !finished {
        troubles.push(match (&owner, status.chunked) {
            (Some(_), _) => format!("It is not finished: splat4d status {name} reports its progress."),
            (None, true) => format!("It is unfinished: splat4d status {name} lists its parts."),
            (None, false) => format!("It is unfinished: splat4d train --resume {name} continues it."),
        });
    }
    if let Some(seconds) = run.number("seconds").or(status.chunked.then(|| status.seconds())) {
        line(&mut text, "time", &human_seconds(seconds));
    }
    let bytes = run.number("peak_memory").map(|b| b as u64).max(status.peak_memory());
    if let Some(bytes) = bytes.filter(|b| *b > 0) {
        line(&mut text, "memory", &format!("{} at most", human_bytes(bytes)));
    }
    if let Some(n) = run.number("rollbacks").filter(|n| *n > 0.0) {
        troubles.push(format!("Training rolled back {n} times because a value was not finite: check the poses."));
    }
    if let Some(results) = run.results.as_ref().and_then(Value::as_object) {
        line(&mut text, "held-out scores", &evaluating::in_words(|key| results.get(key)?.as_f64()));
    } else {
        line(&mut text, "held-out scores", "not measured yet: splat4d eval RUN");
    }
    let mut json = json!({
        "type": "run", "name": run.name(), "capture": run.capture().map(|c| to_text(&c)), "finished": finished, "owner": owner, "iteration": done,
        "iterations": total, "changed_knobs": changed, "info": run.info, "results": run.all_results,
    });
    if let Ok(file) = run.scene_file() {
        let scene = read_scene(&file)?;
        let inner = of_scene(&scene);
        text.push_str(&inner.text);
        troubles.extend(inner.troubles);
        json["scene"] = inner.json;
    }
    Ok(Inspection { json, text, troubles, listed: Vec::new(), poses_unchecked: false })
}

fn of_file(path: &Path) -> Result<Inspection> {
    let source = Source::open(path)?;
    let bytes = path.metadata().map(|m| m.len()).unwrap_or(0);
    let mut text = String::new();
    line(&mut text, "file", &format!("{}, {}", path.display(), human_bytes(bytes)));
    let kind = match source.dialect {
        Some(dialect) => dialect.name,
        None if source.playback.is_some() => "playback file",
        None => "splat4d scene",
    };
    line(&mut text, "kind", kind);
    let of_file = source.playback.as_ref().map(playback::of_index);
    if let Some(of_file) = &of_file {
        text.push_str(&of_file.text);
    }
    if let Some(from) = &source.provenance {
        let edits = (!from.edits.is_empty()).then(|| format!("{}: {}", from.edits.len(), done(&from.edits)));
        let entries = [("made with", Some(&from.made_with)), ("when", from.when.as_ref()), ("edits", edits.as_ref())];
        let rest = [("capture", from.capture.as_ref()), ("in words", from.words.as_ref())];
        entries.into_iter().chain(rest).filter_map(|(k, v)| Some((k, v?))).for_each(|(k, v)| line(&mut text, k, v));
    }
    if let Some(info) = &source.ply {
        if !info.extra_properties.is_empty() {
            line(&mut text, "not read", &info.extra_properties.join(", "));
        }
        for comment in info.comments.iter().take(4) {
            line(&mut text, "comment", comment);
        }
    }
    if let Some(own) = &source.sound {
        line(&mut text, "sound", &sound::in_words(own));
    }
    let (doubts, notes): (Vec<&String>, Vec<&String>) =
        source.warnings.lines().iter().partition(|w| DOUBTS.iter().any(|d| w.contains(d)));
    notes.into_iter().for_each(|w| line(&mut text, "note", w));
    let mut inner = of_scene(&source.scene);
    inner.troubles.extend(doubts.into_iter().map(|w| format!("{w}.")));
    text.push_str(&inner.text);
    let mut json = inner.json;
    json["provenance"] = json!(source.provenance);
    json["dialect"] = json!(source.dialect.map(|d| d.name));
    json["type"] = json!(if source.ply.is_some() { "ply" } else { "scene" });
    json["bytes"] = json!(bytes);
    if let Some(of_file) = of_file {
        json["type"] = json!("playback");
        json["playback"] = of_file.json;
    }
    Ok(Inspection { json, text, troubles: inner.troubles, listed: Vec::new(), poses_unchecked: false })
}

/// Names of edits, one after the other.
fn done(edits: &[Value]) -> String {
    edits.iter().map(|e| e["do"].as_str().unwrap_or("?")).collect::<Vec<_>>().join(", ")
}

/// Gaussians, degree, bounds, histograms and damage.
fn of_scene(scene: &Scene<f32>) -> Inspection {
    let (center, radius) = cloud(scene);
    let mut opacity = [0usize; OPACITY_EDGES.len() - 1];
    let mut scales = [0usize; SCALE_EDGES.len() - 1];
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    let (mut damaged, mut zero_quats, mut huge) = (0usize, 0usize, 0usize);
    let mut layers = Vec::new();
    for layer in &scene.layers {
        let table = &layer.params[GEOMETRY];
        let degree = degree_of(layer.params[SH].width() / 3).unwrap_or(0);
        layers.push((
            layer.name.clone(),
            layer.motion.spec().name().to_owned(),
            layer.life.name(),
            table.rows(),
            degree,
        ));
        let rows: Vec<usize> = (0..table.rows()).collect();
        let bad = |row: &usize| {
            layer.params.keys().any(|key| {
                let t = &layer.params[key];
                t.rows() == table.rows() && (0..t.width()).any(|c| !t.get(*row, c).is_finite())
            })
        };
        for row in rows {
            if bad(&row) {
                damaged += 1;
                continue;
            }
            let mean = layer.frame.apply(table.read::<3>(row, 0).map(f64::from));
            (0..3).for_each(|k| (low[k], high[k]) = (low[k].min(mean[k]), high[k].max(mean[k])));
            zero_quats += usize::from(table.read::<4>(row, QUAT).iter().all(|q| *q == 0.0));
            let o = 1.0 / (1.0 + (-f64::from(table.get(row, OPACITY))).exp());
            opacity[bucket(&OPACITY_EDGES, o)] += 1;
            let largest = table.read::<3>(row, LOG_SCALE).into_iter().map(f64::from).fold(f64::NEG_INFINITY, f64::max);
            let largest = largest + layer.frame.scale.ln();
            let decades = (largest - radius.ln()) / std::f64::consts::LN_10;
            scales[bucket(&SCALE_EDGES, decades)] += 1;
            huge += usize::from(largest.exp() > HUGE * radius);
        }
    }
    let n = scene.len();
    let sound = (n - damaged).max(1) as f64;
    let mut troubles = Vec::new();
    if n == 0 {
        troubles.push("It contains no Gaussians.".into());
    }
    if damaged > 0 {
        troubles.push(format!(
            "{} Gaussians contain NaN or infinity: they are not rendered. Train or export again.",
            grouped(damaged)
        ));
    }
    if zero_quats > 0 {
        troubles
            .push(format!("{} Gaussians have a zero rotation: they are not rendered correctly.", grouped(zero_quats)));
    }
    if opacity[0] as f64 > MANY_FAINT * sound && n >= FEW {
        troubles.push(format!(
            "{} of {} Gaussians are too transparent to be visible.",
            grouped(opacity[0]),
            grouped(n)
        ));
    }
    if huge as f64 > MANY_HUGE * sound && n >= FEW {
        troubles.push(format!("{} Gaussians are larger than the whole scene: floaters, or a sky.", grouped(huge)));
    }
    let mut text = String::new();
    line(&mut text, "Gaussians", &grouped(n));
    for (name, motion, life, rows, degree) in layers.iter().filter(|_| layers.len() <= MANY_LAYERS) {
        line(&mut text, "layer", &format!("{name}: {} by {motion}, life {life}, SH degree {degree}", grouped(*rows)));
    }
    if scene.head != Head::Identity {
        line(
            &mut text,
            "colours",
            "by a small network per pixel (features = full); playback files and exports have spherical harmonics instead",
        );
    }
    if scene.clip[1] > scene.clip[0] {
        line(
            &mut text,
            "clip",
            &format!("{:.3} to {:.3} s, {} frames per second", scene.clip[0], scene.clip[1], scene.fps),
        );
    }
    if scene.offset != [0.0; 3] {
        let [x, y, z] = scene.offset;
        line(&mut text, "offset", &format!("{x} {y} {z}: add it to positions to get world coordinates"));
    }
    let activity = Activity::of(scene);
    if let Some(activity) = &activity {
        line(&mut text, "active", &activity.sentence());
    }
    let finite = low[0] <= high[0];
    if finite {
        let corner = |c: [f64; 3]| format!("{:.3} {:.3} {:.3}", c[0], c[1], c[2]);
        line(&mut text, "bounds", &format!("{} to {}", corner(low), corner(high)));
        line(&mut text, "middle", &format!("{}; nine tenths within {radius:.3}", corner(center)));
        let name = |w: &[f64]| format!("{} to {}", w[0], w[1]);
        histogram(&mut text, "opacity", &OPACITY_EDGES, &opacity, name);
        histogram(&mut text, "largest scale", &SCALE_EDGES, &scales, |w| format!("below 1e{} radii", w[1]));
    }
    line(&mut text, "damaged rows", &grouped(damaged));
    let json = json!({
        "type": "scene", "gaussians": n, "damaged_rows": damaged, "zero_rotations": zero_quats,
        "layers": layers.iter().map(|l| json!({"name": l.0, "motion": l.1, "life": l.2, "gaussians": l.3,
            "sh_degree": l.4})).collect::<Vec<_>>(),
        "offset": scene.offset, "head": scene.head.name(), "clip": scene.clip, "fps": scene.fps, "bounds": finite.then_some([low, high]),
        "middle": center, "radius": radius, "opacity_histogram": {"edges": OPACITY_EDGES, "counts": opacity},
        "scale_histogram": {"edges_log10_radii": SCALE_EDGES, "counts": scales},
        "activity": activity,
    });
    Inspection { json, text, troubles, listed: Vec::new(), poses_unchecked: false }
}

fn bucket(edges: &[f64], value: f64) -> usize {
    edges[1..edges.len() - 1].iter().take_while(|e| value >= **e).count()
}

fn histogram(out: &mut String, name: &str, edges: &[f64], counts: &[usize], label: impl Fn(&[f64]) -> String) {
    let most = counts.iter().copied().max().unwrap_or(0).max(1);
    for (i, count) in counts.iter().enumerate() {
        let bar = "#".repeat((count * BAR).div_ceil(most));
        let first = if i == 0 { name } else { "" };
        let _ = writeln!(out, "{first:<16} {:<18} {:>10} {bar}", label(&edges[i..i + 2]), grouped(*count));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_of_a_run_are_in_the_order_of_their_use() {
        let run = tempfile::tempdir().unwrap();
        std::fs::write(run.path().join("recipe.toml"), Recipe::default().to_toml()).unwrap();
        let scores = json!({
            "D-SSIM": 0.1, "LPIPS-alex": 0.2, "PSNR": 25.125, "PSNR-dynamic": 20.5, "SSIM": 0.9, "flicker": 0.25,
        });
        std::fs::write(run.path().join("results.json"), json!({"ours_20": scores}).to_string()).unwrap();
        let text = inspect(run.path(), &InspectOptions::default(), &crate::events::ignore).unwrap().text;
        let line = text.lines().find_map(|l| l.strip_prefix("held-out scores  ")).unwrap();
        let words = "PSNR 25.12 dB, dynamic regions 20.50 dB, SSIM 0.9000, LPIPS (AlexNet) 0.2000, flicker 0.250/255";
        assert_eq!(line, words);
    }
}
