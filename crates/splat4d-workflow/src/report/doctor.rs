//! `doctor.html`: problems of a capture, worst first, and every camera's image and measurements.

use super::chart::escape;
use super::{STYLE, pictures, rig_map};
use crate::events::Listener;
use crate::files;
use splat4d::Result;
use splat4d::scene::Camera;
use splat4d_import::doctor::{CameraReport, Finding, Grade, Options, Report, examine};
use splat4d_train::capture::Capture;
use splat4d_train::event::{Event, Progress};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Examines a capture and writes `doctor.html`, whose path is returned, and `doctor.json` into `folder`.
pub fn made(capture: &Capture, folder: &Path, console: &dyn Listener) -> Result<(Report, PathBuf)> {
    let mut listen = |event: &Event| console.event(event);
    let report = examine(capture, &Options::default(), &mut Progress(&mut listen))?;
    console.clear();
    files::make_folder(folder)?;
    let html = folder.join("doctor.html");
    files::write(&html, page(&report, capture).as_bytes())?;
    files::write(&folder.join("doctor.json"), &serde_json::to_vec_pretty(&report).expect("a report is plain data"))?;
    Ok((report, html))
}

/// A finding in sentences.
pub fn sentence(f: &Finding) -> String {
    format!("{}: {} {} {}", word(f.grade), f.what, f.looks, f.remedy)
}

/// The worst grade of a camera's findings.
fn worst(report: &Report, camera: &str) -> Option<Grade> {
    let all = report.findings.iter().flat_map(|f| std::iter::once(f).chain(&f.alike));
    all.filter(|f| f.camera.as_deref() == Some(camera)).map(|f| f.grade).max()
}

/// A number's limits, in words behind it.
fn limits(field: &str, scale: f64, view: Option<&Camera>) -> String {
    let Some(found) = view.and_then(|view| CameraReport::limits(field, view)) else { return String::new() };
    // Two digits that count.
    let [warning, bad] = found.map(|v| format!("{:.1e}", v * scale).parse::<f64>().unwrap_or(v));
    let way = if bad < warning { "below" } else { "above" };
    format!("warning {way} {warning}, bad {way} {bad}")
}

/// The page.
fn page(report: &Report, capture: &Capture) -> String {
    let map = rig_map::svg(capture, &|name| worst(report, name));
    let view_of = |name: &str| {
        let camera = capture.cameras.iter().position(|c| c.name == name)?;
        capture.frames.iter().find(|f| f.camera == camera).map(|f| &f.view)
    };
    let mut body = String::new();
    let _ = writeln!(body, "<header><h1>{}</h1><p>{}</p></header>", escape(&report.capture), escape(&summary(report)));
    for line in about(report) {
        let _ = writeln!(body, "<p>{}</p>", escape(&line));
    }
    body.push_str("<h2>Findings, worst first</h2>\n");
    if report.findings.is_empty() {
        body.push_str("<p>None.</p>\n");
    }
    for f in &report.findings {
        let class = if f.grade == Grade::Note { "note" } else { "warn" };
        let _ = write!(body, "<div class=\"{class}\"><b>{}:</b> {}", title(f.grade), escape(&f.what));
        for (label, text) in
            [("Effect", f.looks), ("Remedy", f.remedy.as_str())].into_iter().filter(|(_, t)| !t.is_empty())
        {
            let _ = write!(body, "<br><b>{label}:</b> {}", escape(text));
        }
        body.push_str("</div>\n");
    }
    if !map.is_empty() {
        let _ = writeln!(
            body,
            "<h2>Map of the cameras</h2>\n<p class=\"note\">From above; grey dots are points of the capture. Lines show where \
             cameras look. Orange: a warning, red: bad.</p>\n<div class=\"panel map\">{map}</div>"
        );
    }
    if !report.leave_out.is_empty() {
        let _ = writeln!(body, "<h2>Leave out</h2>\n<p>{}</p>", escape(&report.leave_out.join(", ")));
    }
    if !report.left.is_empty() {
        body.push_str("<h2>Not checked</h2>\n");
        for left in &report.left {
            let _ = writeln!(body, "<p class=\"note\">{}</p>", escape(left));
        }
    }
    body.push_str(
        "<h2>Cameras</h2>\n<p class=\"note\">Images are medians over time, in which moving subjects are faint. Pixels are \
         those of an image of 1920 pixels.</p>\n<div class=\"grid3\">",
    );
    for camera in &report.cameras {
        let (p, view) = (&camera.picture, view_of(&camera.name));
        let image = pictures::reduced(p).map(|uri| {
            format!(
                "<img style=\"width:100%;border-radius:8px\" alt=\"camera {}\" src=\"{uri}\">",
                escape(&camera.name)
            )
        });
        let _ =
            write!(body, "<div class=\"panel\"><h3>{}</h3>{}<table>", escape(&camera.name), image.unwrap_or_default());
        let mut row = |name: &str, value: Option<String>, limits: String| {
            if let Some(value) = value {
                let _ = write!(
                    body,
                    "<tr><th>{name}</th><td>{}<br><span class=\"note\">{}</span></td></tr>",
                    escape(&value),
                    escape(&limits)
                );
            }
        };
        row("pose error", camera.epipolar.map(|v| format!("{v:.2} px of 1920")), limits("epipolar", 1.0, view));
        row("time offset", camera.offset.map(|[v, s]| format!("{:+.1} ± {:.1} ms", 1e3 * v, 1e3 * s)), String::new());
        row(
            "exposure",
            camera.exposure.map(|e| e.map(|v| format!("{v:+.2}")).join(" ") + " stops"),
            limits("exposure", 1.0, view),
        );
        row("sharpness", camera.sharpness.map(|v| format!("{v:.2} times the others'")), limits("sharpness", 1.0, view));
        row("moved", camera.moved.map(|v| format!("{v:.2} px of 1920")), limits("moved", 1.0, view));
        row("focus, last to first", camera.focus.map(|v| format!("{v:.2} times")), limits("focus", 1.0, view));
        row(
            "first to last row",
            camera.shutter.map(|[v, s]| format!("{:+.1} ± {:.1} ms", 1e3 * v, 1e3 * s)),
            limits("shutter", 1e3, view),
        );
        row(
            "light lost in corners",
            camera.vignetting.map(|[v, s]| format!("{:.1} ± {:.1} %", 100.0 * v, 100.0 * s)),
            String::new(),
        );
        body.push_str("</table></div>\n");
    }
    body.push_str("</div>\n");
    body.push_str(&pairs(report));
    let title = escape(&report.capture);
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\"><title>{title} · splat4d doctor</title>\n<style>\n{STYLE}</style>\
         </head>\n<body><main>\n{body}</main></body></html>\n"
    )
}

/// Findings of pairs of cameras, folded.
fn pairs(report: &Report) -> String {
    if report.pairs.is_empty() {
        return String::new();
    }
    let number = |v: f64, digits: usize| if v.is_finite() { format!("{v:+.digits$}") } else { "–".to_owned() };
    let mut out = format!(
        "<details><summary>{} with common features, worst poses \
         first</summary>\n<table><tr><th>cameras</th><th>features</th><th>pose error, px at 1920</th><th>brightness \
         of the second, stops (red green blue)</th><th>sharpness ratio</th></tr>\n",
        counted(report.pairs.len(), "pair") + " of images"
    );
    for p in &report.pairs {
        let _ = writeln!(
            out,
            "<tr><td>{} – {}</td><td>{}</td><td>{:.2}</td><td>{}</td><td>{:.2}</td></tr>",
            escape(&p.cameras[0]),
            escape(&p.cameras[1]),
            p.matches,
            p.epipolar,
            p.gain.map(|g| number(g, 2)).join(" "),
            p.sharper
        );
    }
    out + "</table></details>\n"
}

/// Severity, in a word.
pub fn word(grade: Grade) -> &'static str {
    match grade {
        Grade::Bad => "bad",
        Grade::Warning => "warning",
        Grade::Note => "note",
    }
}

/// A grade as the beginning of a paragraph.
fn title(grade: Grade) -> &'static str {
    match grade {
        Grade::Bad => "Bad",
        Grade::Warning => "Warning",
        Grade::Note => "Note",
    }
}

/// Further facts of the capture, in sentences.
pub fn about(report: &Report) -> Vec<String> {
    let mut out = Vec::new();
    if let Some(share) = report.seen_by_three {
        out.push(format!("Three cameras see {:.0} % of the space in which something moves.", 100.0 * share));
    }
    if let Some(training) = &report.training {
        out.push(format!(
            "Training uses the motion model {} and needs about {} of memory.",
            training.motion,
            files::human_bytes(training.memory)
        ));
    }
    out
}

/// All of it in a sentence.
pub fn summary(report: &Report) -> String {
    let count = |g: Grade| report.findings.iter().filter(|f| f.grade == g).count();
    format!(
        "{}: {} bad, {}, {}",
        counted(report.cameras.len(), "camera"),
        count(Grade::Bad),
        counted(count(Grade::Warning), "warning"),
        counted(count(Grade::Note), "note")
    )
}

/// `1 camera`, `2 cameras`.
fn counted(n: usize, noun: &str) -> String {
    format!("{n} {noun}{}", if n == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_of_a_kind_has_no_plural() {
        assert_eq!(
            [counted(0, "warning"), counted(1, "pair"), counted(2, "note")],
            ["0 warnings", "1 pair", "2 notes"]
        );
    }
}
