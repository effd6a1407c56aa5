//! Compression results, as part of a run's page: before and after side by side, where the bytes are, the images of
//! both, and how it was done. All of it is read from `compress.json`, the file itself and the two runs' images.

use super::chart::{Series, bars, escape, lines, short};
use super::{panels, pictures};
use crate::activity::Activity;
use crate::files::{self, grouped, human_bytes, human_seconds};
use crate::measure::Side;
use crate::playable;
use crate::run_folder::{COMPRESS as FILE, Run};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use splat4d::format::playback::{Index, Kind};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Held-out views of which both images are shown.
pub(crate) const VIEWS: usize = 4;
/// Folder of a compressed run with images of what was removed, named as the held-out views.
pub(crate) const REMOVED: &str = "removed";

/// The content of `compress.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Compressed {
    /// The run that was compressed.
    #[serde(with = "splat4d_train::path_text")]
    pub source: PathBuf,
    /// 0, 1 or 2; `None` where settings were given instead.
    pub level: Option<u8>,
    /// Every setting and its value.
    pub settings: Value,
    /// The source.
    pub before: Side,
    /// The source trained for as many steps more as fine-tuning took, nothing removed: the fair comparison.
    pub unpruned: Option<Side>,
    /// The source as a plain playback file.
    pub plain: Option<Side>,
    /// The file that was written.
    pub after: Side,
    pub stages: Vec<Step>,
    pub guard: Option<Guard>,
    /// Attempts of a search for a size.
    pub tried: Vec<Tried>,
    pub warnings: Vec<String>,
    /// Which Gaussians are active when: of the source, and of the file's scene. `None`: all are, at all times.
    pub activity: [Option<Activity>; 2],
}

/// One stage of the work.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Step {
    pub name: String,
    pub seconds: f64,
    pub steps: usize,
    /// Gaussians at its end.
    pub gaussians: usize,
}

/// The quality that may be lost, and what was.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Guard {
    pub loss_db: f64,
    pub limit_db: f64,
    pub passed: bool,
}

/// One try of a search.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Tried {
    /// Share of the Gaussians removed.
    pub prune: f64,
    pub bytes: u64,
    pub psnr: f64,
}

impl Compressed {
    /// Baseline that the quality and the speed of `after` are compared with.
    pub fn fair(&self) -> &Side {
        self.unpruned.as_ref().unwrap_or(&self.before)
    }

    /// Size ratio of the plain file to this one; `None` if that was not measured.
    fn smaller_than_plain(&self) -> Option<f64> {
        let plain = self.plain.as_ref().filter(|p| p.bytes > 0 && self.after.bytes > 0)?;
        Some(plain.bytes as f64 / self.after.bytes as f64)
    }

    /// Size ratio of 32-bit floats to this file; `None` where there is nothing.
    pub fn smaller(&self) -> Option<f64> {
        (self.after.bytes > 0).then(|| self.before.float_bytes as f64 / self.after.bytes as f64)
    }
}

/// The content of a compressed run's `compress.json`; `None` for other runs and other versions.
pub(super) fn compressed(run: &Run) -> Option<Compressed> {
    if run.compressed.is_null() { None } else { serde_json::from_value(run.compressed.clone()).ok() }
}

/// The result of a compression in a sentence.
pub(super) fn verdict(compressed: &Compressed) -> String {
    let mut out = format!("Compressed to {}", human_bytes(compressed.after.bytes));
    match (compressed.smaller_than_plain(), compressed.smaller()) {
        (Some(x), _) => _ = write!(out, ", {x:.1} times smaller than the plain file"),
        (None, Some(x)) => _ = write!(out, ", {x:.1} times smaller than 32-bit floats"),
        (None, None) => {}
    }
    if let Some((before, after)) = compressed.before.psnr.zip(compressed.after.psnr) {
        let _ = write!(out, ". Held-out views: {after:.2} dB PSNR, {:+.2} dB against the source", after - before);
    }
    out + "."
}

/// Puts the section into the page of a compressed run; nothing into that of another.
pub(super) fn section(out: &mut String, run: &Run) {
    if run.compressed.is_null() {
        return;
    }
    let Some(compressed) = compressed(run) else {
        let _ = writeln!(out, "<div class=\"warn\">{FILE} was written by another version of splat4d.</div>");
        return;
    };
    let level = compressed.level.map(|l| format!(", level {l}")).unwrap_or_default();
    let _ = writeln!(
        out,
        "<h2>Compressed</h2>\n<p class=\"note\">From {}{level}.</p>",
        escape(&compressed.source.display().to_string())
    );
    guard(out, &compressed);
    sides(out, &compressed);
    panels(
        out,
        "File size by part, and stages",
        [
            ("Bytes of scene.s4d", parts(&playable::of_run(&run.path))),
            ("Stages", stages(&compressed.stages)),
            ("PSNR over size, all trials, dB", tried(&compressed.tried)),
        ],
    );
    activity(out, &compressed);
    both_pictures(out, run, &compressed);
    settings(out, &compressed.settings);
}

fn guard(out: &mut String, compressed: &Compressed) {
    if let Some(Guard { loss_db, limit_db, passed }) = compressed.guard {
        let verdict = if passed { "within" } else { "more than" };
        let class = if passed { "note" } else { "warn" };
        let change = if loss_db < 0.0 { "gained" } else { "lost" };
        let _ = writeln!(
            out,
            "<p class=\"{class}\">{:.2} dB {change} on the training views, {verdict} the limit of {limit_db:.2} dB.</p>",
            loss_db.abs()
        );
    }
    for warning in &compressed.warnings {
        let _ = writeln!(out, "<div class=\"warn\">{}</div>", escape(warning));
    }
}

/// A line of the table: its name, how a side prints it, and how the change is printed.
type Line<'a> = (&'a str, &'a dyn Fn(&Side) -> Option<String>, Option<String>);

fn sides(out: &mut String, compressed: &Compressed) {
    let (fair, after) = (compressed.fair(), &compressed.after);
    let plain = |digits: usize, v: Option<f64>| v.map(|v| format!("{v:.digits$}"));
    let less = |before: f64, after: f64| (after > 0.0 && before > 0.0).then(|| format!("{:.1}x less", before / after));
    let more = |before: f64, after: f64| (before > 0.0).then(|| format!("{:.2}x", after / before));
    let gain = |digits: usize, get: fn(&Side) -> Option<f64>| {
        get(fair).zip(get(after)).map(|(b, a)| format!("{:+.digits$}", a - b))
    };
    let table: [Line<'_>; 15] = [
        ("Gaussians", &|s| Some(grouped(s.gaussians)), less(fair.gaussians as f64, after.gaussians as f64)),
        (
            "active per frame, mean",
            &|s| Some(grouped(s.active_mean.round() as usize)),
            less(fair.active_mean, after.active_mean),
        ),
        (
            "active per frame, maximum",
            &|s| Some(grouped(s.active_max)),
            less(fair.active_max as f64, after.active_max as f64),
        ),
        ("as 32-bit floats", &|s| Some(human_bytes(s.float_bytes)), None),
        (
            "file",
            &|s| Some(human_bytes(s.bytes)),
            compressed
                .smaller_than_plain()
                .map(|x| format!("{x:.1}x less than the plain file"))
                .or_else(|| compressed.smaller().map(|x| format!("{x:.1}x less than the source's 32-bit floats"))),
        ),
        ("Mbit/s", &|s| plain(1, s.mbit_per_s), None),
        ("PSNR, held-out views, dB", &|s| plain(2, s.psnr), gain(2, |s| s.psnr)),
        ("PSNR of dynamic regions, dB", &|s| plain(2, s.psnr_dynamic), gain(2, |s| s.psnr_dynamic)),
        ("PSNR, training views, dB", &|s| plain(2, s.psnr_train), gain(2, |s| s.psnr_train)),
        ("SSIM", &|s| plain(4, s.ssim), gain(4, |s| s.ssim)),
        ("flicker, 1/255", &|s| plain(3, s.flicker), gain(3, |s| s.flicker)),
        ("frames/s, end to end", &|s| plain(1, Some(s.fps)), more(fair.fps, after.fps)),
        ("frames/s, blending alone", &|s| plain(1, Some(s.raster_fps)), more(fair.raster_fps, after.raster_fps)),
        ("pixel-Gaussian pairs, million", &|s| plain(2, Some(1e-6 * s.pairs)), less(fair.pairs, after.pairs)),
        ("bytes to first image, ms", &|s| plain(1, Some(s.decode_ms)), less(fair.decode_ms, after.decode_ms)),
    ];
    let columns: Vec<(&str, &Side)> = [
        ("before", Some(&compressed.before)),
        ("not pruned, same steps", compressed.unpruned.as_ref()),
        ("plain file", compressed.plain.as_ref()),
        ("compressed", Some(after)),
    ]
    .into_iter()
    .filter_map(|(name, side)| Some((name, side?)))
    .collect();
    out.push_str("<div class=\"panel\"><table class=\"numbers\"><tr><th></th>");
    for (name, _) in &columns {
        let _ = write!(out, "<th>{name}</th>");
    }
    out.push_str("<th>change</th></tr>");
    for (name, tell, change) in table {
        let cells: Vec<Option<String>> = columns.iter().map(|(_, side)| tell(side)).collect();
        if cells.iter().all(Option::is_none) {
            continue;
        }
        let _ = write!(out, "<tr><th>{name}</th>");
        for cell in cells.into_iter().chain([change]) {
            let _ = write!(out, "<td>{}</td>", escape(&cell.unwrap_or_default()));
        }
        out.push_str("</tr>");
    }
    let against =
        if compressed.unpruned.is_some() { "the scene trained for the same steps without pruning" } else { "before" };
    let _ = write!(
        out,
        "</table></div>\n<p class=\"note\">The last column compares with {against}. Frames per second: this \
         machine's CPU, same size and cameras, columns measured alternately. End to end includes the active set, \
         motion, rendering and conversion to 8-bit colours.</p>\n"
    );
}

/// Bytes by kind of section, from the file's own index.
fn parts(file: &Path) -> Option<String> {
    let bytes = files::read(file).ok()?;
    let index = Index::parse(&bytes, Some(bytes.len() as u64)).ok()?;
    let mut by_kind: BTreeMap<Kind, u64> = BTreeMap::new();
    for entry in &index.sections {
        *by_kind.entry(entry.kind).or_default() += u64::from(entry.stored);
    }
    let rest = bytes.len() as u64 - by_kind.values().sum::<u64>().min(bytes.len() as u64);
    let name = |kind: Kind| match kind.name().as_str() {
        "PAGE" => "Gaussians".to_owned(),
        "MASK" => "key-frame masks".into(),
        "POST" => "poster".into(),
        _ if kind == Kind::Palette => "palette".into(),
        other => format!("section {other}"),
    };
    let rows: Vec<(String, f64, String)> = by_kind
        .into_iter()
        .map(|(kind, n)| (name(kind), n))
        .chain([("index".to_owned(), rest)])
        .map(|(name, n)| (name, n as f64, human_bytes(n)))
        .collect();
    bars(&rows, 0.0, "bytes by part")
}

fn stages(steps: &[Step]) -> Option<String> {
    let first = steps.first()?;
    let mut table = String::from(
        "<table class=\"numbers\"><tr><th>stage</th><th>steps</th><th>Gaussians</th><th>minutes</th></tr>",
    );
    for step in steps {
        let (name, minutes) = (escape(&step.name), human_seconds(step.seconds));
        let (taken, left) = (grouped(step.steps), grouped(step.gaussians));
        let _ = write!(table, "<tr><th>{name}</th><td>{taken}</td><td>{left}</td><td>{minutes}</td></tr>");
    }
    if steps.len() > 1 {
        let all = |f: fn(&Step) -> f64| steps.iter().map(f).sum::<f64>();
        let (taken, minutes) = (grouped(all(|s| s.steps as f64) as usize), human_seconds(all(|s| s.seconds)));
        let _ = write!(table, "<tr><th>together</th><td>{taken}</td><td></td><td>{minutes}</td></tr>");
    }
    (first.steps > 0 || first.seconds > 0.0 || steps.len() > 1).then(|| table + "</table>")
}

fn tried(tried: &[Tried]) -> Option<String> {
    let mut points: Vec<(f64, f64)> = tried.iter().map(|t| (t.bytes as f64 / (1 << 20) as f64, t.psnr)).collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let curve = lines(&[Series { name: String::new(), points }], "MiB", "dB")?;
    let trials: Vec<String> = tried
        .iter()
        .map(|t| format!("{} % pruned: {}, {:.2} dB", short(100.0 * t.prune), human_bytes(t.bytes), t.psnr))
        .collect();
    Some(format!("{curve}<p class=\"note\">{}</p>", escape(&trials.join(" · "))))
}

/// What active sets save: what rests in each frame, and what frames have in common.
fn activity(out: &mut String, compressed: &Compressed) {
    let curves = |points: &dyn Fn(&Activity) -> Vec<(f64, f64)>, x: &str| {
        let sides = ["before", "compressed"].into_iter().zip(&compressed.activity);
        let series: Vec<Series> =
            sides.filter_map(|(name, of)| Some(Series { name: name.into(), points: points(of.as_ref()?) })).collect();
        lines(&series, x, "%")
    };
    let percent = |share: f64| 100.0 * share;
    panels(
        out,
        "Gaussians over time",
        [
            (
                "Inactive Gaussians by frame, %",
                curves(&|a| a.times.iter().copied().zip(a.inactive.iter().map(|s| percent(*s))).collect(), "s"),
            ),
            (
                "What active sets of two frames share, % (intersection over union), by the time between them",
                curves(&|a| a.overlap.iter().map(|[d, share]| (*d, percent(*share))).collect(), "s"),
            ),
        ],
    );
}

/// Held-out views as the source shows them, as the file does, and where they differ.
fn both_pictures(out: &mut String, run: &Run, compressed: &Compressed) {
    let Some((before, after)) = Run::open(&compressed.source).ok().and_then(|r| r.pictures()).zip(run.pictures())
    else {
        return;
    };
    let mut shown = String::new();
    for i in pictures::spread(run.views.len(), VIEWS) {
        let file = &run.views[i].file;
        let [a, b] = [&before, &after].map(|folder| folder.join("renders").join(file));
        let Some(difference) = pictures::difference(&a, &b) else { continue };
        let removed = pictures::inline(&run.path.join(REMOVED).join(file));
        let all = [pictures::inline(&a), pictures::inline(&b), Some(difference), removed];
        shown.push_str(if all[3].is_some() { "<div class=\"view four\">" } else { "<div class=\"view\">" });
        for (picture, caption) in all.iter().zip(["before", "compressed", "difference", "removed Gaussians alone"]) {
            let Some(picture) = picture else { continue };
            let _ = write!(
                shown,
                "<figure><img alt=\"{caption}\" src=\"{picture}\"><figcaption>{caption}</figcaption></figure>"
            );
        }
        shown.push_str("</div>\n");
    }
    if !shown.is_empty() {
        let _ = write!(
            out,
            "<h2>Before and after</h2>\n<div class=\"views\">{shown}</div>\n<p class=\"note\">Difference: mean of \
             the channels, from 0 (dark) to {} of full scale or more (bright). Removed Gaussians: on black, as they were \
             when they were removed.</p>\n",
            pictures::DIFFERENCE_WORDS
        );
    }
}

fn settings(out: &mut String, settings: &Value) {
    let Some(map) = settings.as_object().filter(|m| !m.is_empty()) else { return };
    let text: String = map.iter().map(|(setting, value)| format!("{setting} = {value}\n")).collect();
    let _ = writeln!(
        out,
        "<details><summary>all settings of the compression</summary><pre>{}</pre></details>",
        escape(&text)
    );
}

#[cfg(test)]
mod tests;
