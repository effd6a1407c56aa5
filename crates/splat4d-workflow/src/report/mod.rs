//! `report.html`: one page that opens without a server: scores, held-out views with truth and error, curves, scores by
//! camera and time, timings, memory, findings, the recipe and the command that repeats the run. It is made from the run
//! folder's files; missing files are missing in the page.

pub mod chart;
pub mod compare;
pub mod compress;
#[cfg(feature = "import")]
pub mod doctor;
mod measured;
pub(crate) mod pictures;
#[cfg(feature = "dynamics")]
pub mod predict;
mod refined;
#[cfg(feature = "import")]
mod rig_map;

use crate::files::{self, grouped, human_bytes, human_seconds};
use crate::run_folder::{Baseline, Metrics, Run, ViewScore, baselines};
use chart::{Series, bars, escape, lines, short};
pub use refined::refined_in_words;
use serde_json::Value;
use splat4d::Result;
use splat4d_train::path_text::in_command;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::PathBuf;

const STYLE: &str = include_str!("style.css");
/// Held-out views shown; the page stays below 2 MB.
const VIEWS: usize = 8;
/// Curves of single cameras; more would be a tangle.
const CAMERA_CURVES: usize = 5;
/// Bars of single cameras: the weakest are shown.
const CAMERA_BARS: usize = 24;

/// Writes the page and returns its path.
pub fn write(run: &Run) -> Result<PathBuf> {
    let path = run.path.join("report.html");
    files::write(&path, page(run).as_bytes())?;
    Ok(path)
}

fn page(run: &Run) -> String {
    let mut body = String::new();
    header(&mut body, run);
    cards(&mut body, run);
    findings(&mut body, run);
    refined::section(&mut body, run);
    measured::section(&mut body, run);
    compress::section(&mut body, run);
    film(&mut body, run);
    views(&mut body, run);
    curves(&mut body, run);
    scores(&mut body, run);
    lifespans(&mut body, run);
    conditions(&mut body, run);
    costs(&mut body, run);
    again(&mut body, run);
    document(&run.name(), &body)
}

/// A whole page of a body.
pub fn document(title: &str, body: &str) -> String {
    let title = escape(title);
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\"><title>{title} · splat4d</title>\n<style>\n{STYLE}</style></head>\
         \n<body><main>\n{body}</main></body></html>\n"
    )
}

fn header(out: &mut String, run: &Run) {
    let mut words = Vec::new();
    if let Some(motion) = run.recipe_text("run.motion") {
        words.push(format!("motion model {motion}"));
    }
    if let Some(n) = run.iteration() {
        words.push(format!("{} steps", grouped(n)));
    }
    if let Some(seconds) = run.number("seconds") {
        words.push(format!("trained in {} minutes", human_seconds(seconds)));
    }
    let (name, words) = (escape(&run.name()), escape(&words.join(" · ")));
    let _ = writeln!(out, "<header><h1>{name}</h1><p>{words}</p>{}</header>", verdict(run));
}

/// The result in a sentence, and what to do with it.
fn verdict(run: &Run) -> String {
    if let Some(compressed) = compress::compressed(run) {
        let place = escape(&in_command(&run.path));
        return format!(
            "<p class=\"verdict\">{}</p><p>Play it: <code>splat4d view {place}</code>.</p>",
            escape(&compress::verdict(&compressed))
        );
    }
    let Some(psnr) = run.score("PSNR") else { return String::new() };
    let mut out = format!("<p class=\"verdict\">Held-out views: {psnr:.2} dB PSNR");
    if let Some(dynamic) = run.score("PSNR-dynamic") {
        let _ = write!(out, ", dynamic regions {dynamic:.2} dB");
        if let Some((still, what)) = still(run) {
            let (by, word) = ((dynamic - still).abs(), if dynamic < still { "worse" } else { "better" });
            let _ = write!(out, ", {by:.2} dB {word} than {what}");
        }
    }
    out += ".</p><p>";
    let place = escape(&in_command(&run.path));
    if run.number("playback_bytes").is_some() {
        let _ = write!(out, "Play it: <code>splat4d view {place}</code>. ");
    }
    if run.score("PSNR-dynamic").is_some() && run.baseline("PSNR-dynamic").is_none() {
        let _ = write!(out, "Compare with a static scene: <code>splat4d eval {place} --baseline</code>.");
    }
    out + "</p>"
}

/// PSNR of dynamic regions without motion, dB, and of what: a static scene that was trained, else the mean image of each
/// camera, which costs no training.
fn still(run: &Run) -> Option<(f64, &'static str)> {
    let trained = run.baseline("PSNR-dynamic").map(|still| (still, "a static scene"));
    trained.or_else(|| Some((run.score("PSNR-dynamic-still")?, "a static image of each camera")))
}

fn cards(out: &mut String, run: &Run) {
    out.push_str("<div class=\"cards\">");
    let mut card = |class: &str, value: String, unit: &str, name: &str| {
        let _ = write!(
            out,
            "<div class=\"card {class}\"><b>{}<small>{}</small></b><span>{}</span></div>",
            escape(&value),
            escape(unit),
            escape(name)
        );
    };
    if let Some(compressed) = compress::compressed(run) {
        let text = human_bytes(compressed.after.bytes);
        let (value, unit) = text.split_once(' ').unwrap_or((&text, ""));
        card("main", value.into(), unit, "compressed file scene.s4d");
    }
    for (class, key, digits, unit, name) in [
        ("main", "PSNR", 2, "dB", "PSNR, held-out views"),
        ("", "PSNR-aligned", 2, "dB", "PSNR, held-out cameras aligned"),
        ("", "PSNR-cc", 2, "dB", "PSNR, colours corrected per camera"),
        ("main", "PSNR-dynamic", 2, "dB", "PSNR of dynamic regions"),
        ("", "PSNR-foreground", 2, "dB", "PSNR of the foreground"),
        ("", "SSIM", 4, "", "SSIM"),
        ("", "MS-SSIM", 4, "", "MS-SSIM"),
        ("", "LPIPS-vgg", 4, "", "LPIPS (VGG)"),
        ("", "LPIPS-alex", 4, "", "LPIPS (AlexNet)"),
        ("", "LPIPS-squeeze", 4, "", "LPIPS (SqueezeNet)"),
        ("", "LPIPS", 4, "", "LPIPS"),
        ("", "flicker", 3, "/255", "flicker"),
    ] {
        if let Some(value) = run.score(key) {
            card(class, format!("{value:.digits$}"), unit, name);
        }
    }
    if let (Some(ours), Some((still, what))) = (run.score("PSNR-dynamic"), still(run)) {
        card("main", format!("{:+.2}", ours - still), "dB", &format!("dynamic regions, against {what}"));
    }
    if let Some(n) = run.number("gaussians").or(run.metrics.last().map(|m| m.gaussians)) {
        card("", grouped(n as usize), "", "Gaussians");
    }
    if let Some(bytes) = run.number("peak_memory").filter(|b| *b > 0.0) {
        let text = human_bytes(bytes as u64);
        let (value, unit) = text.split_once(' ').unwrap_or((&text, ""));
        card("", value.into(), unit, "peak memory");
    }
    if let Some(seconds) = run.number("seconds") {
        card("", human_seconds(seconds), "min", "training time");
    }
    if let Some(bytes) = run.number("playback_bytes") {
        let text = human_bytes(bytes as u64);
        let (value, unit) = text.split_once(' ').unwrap_or((&text, ""));
        // Of a scene with a pixel network, what spherical harmonics in its place cost.
        let like = match run.number("playback_head_psnr") {
            Some(p) => format!(", spherical harmonics in place of the network: {p:.1} dB"),
            None => run.number("playback_psnr").map(|p| format!(", {p:.1} dB against the model")).unwrap_or_default(),
        };
        card("", value.into(), unit, &format!("playback file scene.s4d{like}"));
    }
    out.push_str("</div>\n");
    if run.results.is_some()
        && !["LPIPS", "LPIPS-vgg", "LPIPS-alex", "LPIPS-squeeze"].iter().any(|k| run.score(k).is_some())
    {
        out.push_str("<p class=\"note\">LPIPS was not computed: give its weights with --lpips-weights.</p>\n");
    }
}

fn findings(out: &mut String, run: &Run) {
    let findings = run.findings();
    if findings.is_empty() {
        return;
    }
    out.push_str("<h2>Findings</h2>\n");
    for finding in findings {
        let _ = writeln!(out, "<div class=\"warn\">{}</div>", escape(&finding));
    }
}

fn film(out: &mut String, run: &Run) {
    if let Some(film) = pictures::film(&run.path) {
        let _ = writeln!(out, "<h2>Orbit film</h2>\n{film}");
    }
}

/// Camera and time of a view, or its file.
fn place(view: &ViewScore) -> String {
    match (&view.camera, view.time) {
        (Some(camera), Some(time)) => format!("camera {camera}, {time:.2} s"),
        (Some(camera), None) => format!("camera {camera}"),
        _ => view.file.clone(),
    }
}

fn views(out: &mut String, run: &Run) {
    let Some(folder) = run.pictures() else { return };
    let mut shown = String::new();
    let place_of = |kind: &str, file: &str| Some(folder.strip_prefix(&run.path).ok()?.join(kind).join(file));
    for i in worst(&run.views, VIEWS) {
        let view = &run.views[i];
        let pictures: Vec<Option<String>> = ["gt", "renders", "errors"]
            .iter()
            .map(|kind| pictures::inline(&folder.join(kind).join(&view.file)))
            .collect();
        if pictures.iter().all(Option::is_none) {
            continue;
        }
        shown.push_str("<div class=\"view\">");
        let place = place(view);
        let score = view.psnr.map(|p| format!("render, {p:.2} dB")).unwrap_or_else(|| "render".into());
        let captions = [("gt", format!("truth, {place}")), ("renders", score), ("errors", "error".into())];
        for (picture, (kind, caption)) in pictures.iter().zip(captions) {
            let image = picture.as_ref().map(|p| format!("<img alt=\"{}\" src=\"{p}\">", escape(&caption)));
            // The file itself, as long as the page is in its run.
            let image = image.zip(place_of(kind, &view.file)).map(|(image, place)| {
                format!("<a href=\"{}\">{image}</a>", escape(&place.to_string_lossy().replace('\\', "/")))
            });
            let _ = write!(
                shown,
                "<figure>{}<figcaption>{}</figcaption></figure>",
                image.unwrap_or_default(),
                escape(&caption)
            );
        }
        shown.push_str("</div>\n");
    }
    if !shown.is_empty() {
        let _ = write!(
            out,
            "<h2>Held-out views, the worst of each camera first</h2>\n<div class=\"views\">{shown}</div>\n<p class=\"note\">Error: mean difference \
             of the channels, from 0 (dark) to a quarter of full scale or more (bright).</p>\n"
        );
    }
}

fn curves(out: &mut String, run: &Run) {
    let series = |name: &str, f: fn(&Metrics) -> f64| {
        let points = run.metrics.iter().map(|m| (m.iteration, f(m))).collect();
        [Series { name: name.into(), points }]
    };
    let charts = [
        ("PSNR of the training views, dB", lines(&series("", |m| m.psnr), "step", "dB")),
        ("Loss", lines(&series("", |m| m.loss), "step", "loss")),
        ("Gaussians", lines(&series("", |m| m.gaussians), "step", "Gaussians")),
    ];
    panels(out, "Training curves", charts);
}

/// Views to show: the worst of each camera, worst first, then the next worst of each.
fn worst(views: &[ViewScore], count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..views.len()).collect();
    order.sort_by(|&a, &b| {
        let score = |i: usize| views[i].psnr.unwrap_or(f64::INFINITY);
        score(a).total_cmp(&score(b))
    });
    let mut seen: BTreeMap<Option<&str>, usize> = BTreeMap::new();
    let mut ranked: Vec<(usize, usize)> = order
        .into_iter()
        .map(|i| {
            let rank = seen.entry(views[i].camera.as_deref()).or_default();
            *rank += 1;
            (*rank, i)
        })
        .collect();
    ranked.sort_by_key(|r| r.0);
    ranked.into_iter().take(count).map(|r| r.1).collect()
}

fn scores(out: &mut String, run: &Run) {
    let mut cameras: Vec<(String, Vec<&ViewScore>)> = Vec::new();
    for view in run.views.iter().filter(|v| v.psnr.is_some()) {
        let Some(name) = &view.camera else { continue };
        match cameras.iter_mut().find(|c| c.0 == *name) {
            Some(camera) => camera.1.push(view),
            None => cameras.push((name.clone(), vec![view])),
        }
    }
    let mean = |views: &[&ViewScore]| views.iter().filter_map(|v| v.psnr).sum::<f64>() / views.len().max(1) as f64;
    // What its colours cost a camera is next to its score.
    let label = |views: &[&ViewScore]| {
        let all: Vec<f64> = views.iter().filter_map(|v| v.corrected).collect();
        let corrected = all.iter().sum::<f64>() / all.len() as f64;
        let baselines = if all.is_empty() { String::new() } else { format!(" ({corrected:.2})") };
        format!("{:.2} dB{baselines}", mean(views))
    };
    let mut rows: Vec<(String, f64, String)> =
        cameras.iter().map(|(name, views)| (name.clone(), mean(views), label(views))).collect();
    let corrected = run.views.iter().any(|v| v.corrected.is_some());
    let all = rows.len();
    if all > CAMERA_BARS {
        rows.sort_by(|a, b| a.1.total_cmp(&b.1));
        rows.truncate(CAMERA_BARS);
    }
    let lowest = rows.iter().map(|r| r.1).fold(f64::INFINITY, f64::min);
    let title = if all > CAMERA_BARS { "PSNR by camera, lowest first" } else { "PSNR by camera" };
    let by_camera = bars(&rows, (lowest - 5.0).max(0.0), title);

    let mut times: Vec<f64> = run.views.iter().filter_map(|v| v.time).collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    let at = |time: f64| -> Vec<&ViewScore> {
        run.views.iter().filter(|v| v.time == Some(time) && v.psnr.is_some()).collect()
    };
    let all_cameras = times.iter().map(|t| (*t, mean(&at(*t)))).collect();
    let mut series = vec![Series { name: "all".into(), points: all_cameras }];
    if cameras.len() > 1 {
        series.extend(cameras.iter().take(CAMERA_CURVES).map(|(name, views)| {
            let mut points: Vec<(f64, f64)> = views.iter().filter_map(|v| v.time.zip(v.psnr)).collect();
            points.sort_by(|a, b| a.0.total_cmp(&b.0));
            Series { name: name.clone(), points }
        }));
        // A moving camera gives one point a camera; curves need more.
        series.retain(|s| s.points.len() > 1 || s.name == "all");
    }
    let by_time = if times.len() > 1 { lines(&series, "seconds", "dB") } else { None };
    panels(out, "Quality by camera and time", [(title, by_camera), ("PSNR by time, dB", by_time)]);
    if corrected {
        out.push_str(
            "<p class=\"note\">In brackets: after the best affine colour matrix for all held-out views of the \
             camera. The remaining error is not caused by white balance.</p>\n",
        );
    }
}

/// Histogram of lifespans.
fn lifespans(out: &mut String, run: &Run) {
    let counts = run.info.get("lives").and_then(crate::camera_file::numbers).unwrap_or_default();
    let all: f64 = counts.iter().sum();
    let share = |bin: usize| {
        format!(
            "{:.0} to {:.0} %",
            100.0 * bin as f64 / counts.len() as f64,
            100.0 * (bin + 1) as f64 / counts.len() as f64
        )
    };
    let row = |(bin, n): (usize, &f64)| (share(bin), 100.0 * n / all, format!("{:.1} %", 100.0 * n / all));
    let rows: Vec<(String, f64, String)> = counts.iter().enumerate().map(row).collect();
    // A scene of permanent Gaussians has nothing to show.
    if counts.iter().filter(|n| **n > 0.0).count() > 1 {
        let chart = bars(&rows, 0.0, "Gaussians by the share of the clip in which they are visible");
        panels(
            out,
            "Lifespan of Gaussians",
            [("Share of all Gaussians, by the part of the clip in which they are visible", chart)],
        );
    }
}

/// Conditions of the figures, and further measurements: other views, another background.
fn conditions(out: &mut String, run: &Run) {
    let own = run.results.as_ref().map(|scores| Baseline { name: "", step: run.iteration().unwrap_or(0), scores });
    let mut rows = String::new();
    for entry in own.into_iter().chain(baselines(&run.all_results)) {
        // Runs of older versions do not contain it.
        let Some(conditions) = entry.scores.get("conditions") else { continue };
        let text = |key: &str| conditions.get(key).and_then(Value::as_str).unwrap_or_default().to_owned();
        let score = |key: &str, digits: usize| {
            entry.scores.get(key).and_then(Value::as_f64).map(|x| format!("{x:.digits$}")).unwrap_or_default()
        };
        let cells = [
            text("split"),
            background(&conditions["background"]),
            grouped(entry.step),
            score("PSNR", 2),
            score("PSNR-cc", 2),
            score("SSIM", 4),
            text("simd"),
            text("device"),
        ];
        rows += &format!("<tr>{}</tr>", cells.map(|c| format!("<td>{}</td>", escape(&c))).concat());
    }
    if !rows.is_empty() {
        let head = ["views", "background", "step", "PSNR, dB", "corrected, dB", "SSIM", "instructions", "device"];
        let head = head.map(|h| format!("<th>{h}</th>")).concat();
        let _ = write!(out, "<h2>Measurements</h2>\n<table><tr>{head}</tr>{rows}</table>\n");
    }
}

/// A background's name.
fn background(value: &Value) -> String {
    match crate::camera_file::numbers(value).as_deref() {
        Some([r, g, b]) if r == g && g == b && *r == 1.0 => "white".into(),
        Some([r, g, b]) if r == g && g == b && *r == 0.0 => "black".into(),
        Some(color) => color.iter().map(|c| format!("{c:.2}")).collect::<Vec<_>>().join(" "),
        None => "none".into(),
    }
}

fn costs(out: &mut String, run: &Run) {
    let mut rows: Vec<(String, f64, String)> = Vec::new();
    for (i, name) in run.stages.iter().enumerate() {
        let values: Vec<f64> =
            run.metrics.iter().filter_map(|m| m.stages.get(i).copied()).filter(|v| v.is_finite()).collect();
        if !values.is_empty() {
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            rows.push((name.replace('_', " "), mean, format!("{} ms", short(mean))));
        }
    }
    let total: f64 = rows.iter().map(|r| r.1).sum();
    let mut table = String::new();
    let mut row = |name: &str, value: String| {
        let _ = write!(table, "<tr><th>{}</th><td>{}</td></tr>", escape(name), escape(&value));
    };
    if total > 0.0 {
        row("Time per step", format!("{} ms on average", short(total)));
    }
    for (key, name) in [("evaluation_seconds", "Evaluation"), ("orbit_seconds", "Orbit film")] {
        if let Some(seconds) = run.number(key) {
            row(name, format!("{seconds:.1} s"));
        }
    }
    for (key, name) in [("memory_estimate", "Memory, estimated"), ("peak_memory", "Peak memory")] {
        if let Some(bytes) = run.number(key).filter(|b| *b > 0.0) {
            row(name, human_bytes(bytes as u64));
        }
    }
    if let Some(seams) = run.info.get("seams").filter(|s| s.is_object()) {
        let flicker = |key: &str| seams.get(key).and_then(Value::as_f64).unwrap_or(f64::NAN);
        let words = format!("{}/255, within chunks {}/255", short(flicker("across")), short(flicker("inside")));
        row("Flicker at chunk boundaries", words);
    }
    let table = (!table.is_empty()).then(|| format!("<table>{table}</table>"));
    panels(out, "Totals", [("Training step by stage", bars(&rows, 0.0, "time by stage")), ("Totals", table)]);
}

fn again(out: &mut String, run: &Run) {
    let mut lines = String::new();
    if let Some(compressed) = compress::compressed(run) {
        let level = compressed.level.map(|l| format!(" --level {l}")).unwrap_or_default();
        let _ = writeln!(lines, "splat4d compress {}{level} -o NEW_RUN", in_command(&compressed.source));
        lines += "# all settings: compress.toml\n";
    } else if let Some(capture) = run.capture() {
        let _ = writeln!(
            lines,
            "splat4d train {} --recipe {} -o NEW_RUN",
            in_command(&capture),
            in_command(&run.path.join("recipe.toml"))
        );
    }
    for (key, name) in [
        ("version", "splat4d"),
        ("simd", "instructions"),
        ("threads", "threads"),
        ("capture_fingerprint", "capture fingerprint"),
    ] {
        match run.info.get(key) {
            Some(Value::String(s)) => {
                let _ = writeln!(lines, "# {name}: {s}");
            }
            Some(Value::Number(n)) => {
                let _ = writeln!(lines, "# {name}: {n}");
            }
            _ => {}
        }
    }
    if let Some(seed) = run.recipe_text("run.seed") {
        let _ = writeln!(lines, "# seed: {seed}");
    }
    if !lines.is_empty() {
        let _ = write!(
            out,
            "<h2>Reproduce</h2>\n<pre>{}</pre>\n<p class=\"note\">The same recipe gives the same bits with any \
             number of threads on processors with the same SIMD level.</p>\n",
            escape(&lines)
        );
    }
    if let Some(recipe) = &run.recipe {
        let _ = write!(
            out,
            "<h2>Recipe</h2>\n<details><summary>all settings</summary><pre>{}</pre></details>\n",
            escape(recipe)
        );
    }
}

fn panels<const N: usize>(out: &mut String, title: &str, charts: [(&str, Option<String>); N]) {
    let shown: String = charts
        .iter()
        .filter_map(|(name, chart)| {
            Some(format!("<div class=\"panel\"><h3>{}</h3>{}</div>", escape(name), chart.as_ref()?))
        })
        .collect();
    if !shown.is_empty() {
        // Two columns, also for a single chart: charts of one width have letters of one size.
        let blank = if shown.matches("class=\"panel\"").count() == 1 { "<div></div>" } else { "" };
        let _ = write!(out, "<h2>{}</h2>\n<div class=\"grid2\">{shown}{blank}</div>\n", escape(title));
    }
}

#[cfg(test)]
mod tests;
