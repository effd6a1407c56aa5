//! The page of `compare`: the table, curves of training, and held-out views of all rows next to their truth.

use super::chart::{Series, escape, lines};
use super::{document, pictures};
use crate::comparing::{self, Entry, score_of};
use crate::run_folder::ViewScore;
use std::fmt::Write;

/// Views that are shown: those in which the rows are worst.
const VIEWS: usize = 6;
/// Points of a curve.
const CURVE_POINTS: usize = 80;

/// The page.
pub fn page(entries: &[Entry]) -> String {
    let mut body = String::new();
    let names: Vec<&str> = entries.iter().map(|e| e.name.as_str()).collect();
    let _ = writeln!(body, "<header><h1>Comparison</h1><p>{}</p></header>", escape(&names.join(" · ")));
    for difference in comparing::differences(entries) {
        let _ = writeln!(body, "<div class=\"warn\">{}: their scores cannot be compared.</div>", escape(&difference));
    }
    table(&mut body, entries);
    curves(&mut body, entries);
    views(&mut body, entries);
    document("Comparison", &body)
}

fn table(out: &mut String, entries: &[Entry]) {
    let ((head, rows), best) = (comparing::table_to_read(entries), comparing::best(entries));
    out.push_str("<h2>Held-out views</h2>\n<table><tr>");
    head.iter().for_each(|h| _ = write!(out, "<th{}>{}</th>", alignment(h), escape(&titled(h))));
    out.push_str("</tr>\n");
    for (e, row) in rows.iter().enumerate() {
        out.push_str("<tr>");
        for (name, cell) in head.iter().zip(row) {
            let first = score_of(name).is_some_and(|i| best[i] == Some(e));
            let (open, close) = if first { ("<b>", "</b>") } else { ("", "") };
            let _ = write!(out, "<td{}>{open}{}{close}</td>", alignment(name), escape(cell));
        }
        out.push_str("</tr>\n");
    }
    out.push_str("</table>\n");
    if best.iter().any(Option::is_some) {
        out.push_str(
            "<p class=\"note\">Bold: the best of a column. A difference below the spread of seeds means nothing.</p>\n",
        );
    }
}

/// Numbers are aligned at their last digit, words at their first letter.
fn alignment(column: &str) -> &'static str {
    if comparing::WORDS.contains(&column) { "" } else { " class=\"number\"" }
}

/// A column's title with its unit.
fn titled(column: &str) -> String {
    match column {
        _ if column.starts_with("PSNR") => format!("{column}, dB"),
        "flicker" => "flicker, of 255".to_owned(),
        _ => column.to_owned(),
    }
}

fn curves(out: &mut String, entries: &[Entry]) {
    let of = |x: fn(&crate::run_folder::Metrics) -> f64| -> Vec<Series> {
        let series = |e: &Entry| Series {
            name: e.name.clone(),
            points: smooth(&e.metrics.iter().map(|m| (x(m), m.psnr)).collect::<Vec<_>>()),
        };
        entries.iter().map(series).filter(|s| !s.points.is_empty()).collect()
    };
    let by_step = lines(&of(|m| m.iteration), "step", "dB");
    let by_time = lines(&of(|m| m.seconds / 60.0), "minutes of training", "dB");
    if by_step.is_none() && by_time.is_none() {
        return;
    }
    out.push_str("<h2>PSNR of training views, dB</h2>\n<div class=\"grid2\">");
    for chart in [by_step, by_time].into_iter().flatten() {
        let _ = write!(out, "<div class=\"panel\">{chart}</div>");
    }
    out.push_str("</div>\n");
}

/// Views that all rows have, the worst of each camera first, by their mean PSNR.
fn worst(entries: &[Entry]) -> Vec<ViewScore> {
    let Some(first) = entries.first() else { return Vec::new() };
    let score = |e: &Entry, file: &str| e.views.iter().find(|v| v.file == file).and_then(|v| v.psnr);
    let shared = first.views.iter().filter_map(|v| {
        let scores: Option<Vec<f64>> = entries.iter().map(|e| score(e, &v.file)).collect();
        let mean = scores?.iter().sum::<f64>() / entries.len() as f64;
        Some(ViewScore { psnr: Some(mean), ..v.clone() })
    });
    let shared: Vec<ViewScore> = shared.collect();
    super::worst(&shared, VIEWS).into_iter().map(|i| shared[i].clone()).collect()
}

/// Means of as many points as a chart can resolve: single steps jump from camera to camera.
fn smooth(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let stride = points.len().div_ceil(CURVE_POINTS).max(1);
    let mean = |part: &[(f64, f64)], of: fn(&(f64, f64)) -> f64| part.iter().map(of).sum::<f64>() / part.len() as f64;
    points.chunks(stride).map(|part| (mean(part, |p| p.0), mean(part, |p| p.1))).collect()
}

fn views(out: &mut String, entries: &[Entry]) {
    let mut shown = String::new();
    for view in worst(entries) {
        let file = &view.file;
        let place = |e: &Entry, kind: &str| pictures::inline(&e.pictures.as_ref()?.join(kind).join(file));
        let truth = entries.iter().find_map(|e| place(e, "gt"));
        let renders: Vec<Option<String>> = entries.iter().map(|e| place(e, "renders")).collect();
        if renders.iter().all(Option::is_none) {
            continue;
        }
        let _ = write!(shown, "<div class=\"view compared\">");
        let mut figure = |picture: &Option<String>, caption: &str| {
            let caption = escape(caption);
            let image = picture.as_ref().map(|p| format!("<img alt=\"{caption}\" src=\"{p}\">"));
            let _ = write!(shown, "<figure>{}<figcaption>{caption}</figcaption></figure>", image.unwrap_or_default());
        };
        figure(&truth, &format!("truth, {}", super::place(&view)));
        for (entry, render) in entries.iter().zip(&renders) {
            let score = entry.views.iter().find(|v| v.file == *file).and_then(|v| v.psnr);
            let score = score.map(|p| format!(", {p:.2} dB")).unwrap_or_default();
            figure(render, &format!("{}{score}", entry.name));
        }
        shown.push_str("</div>\n");
    }
    if !shown.is_empty() {
        let _ = write!(out, "<h2>Worst held-out views</h2>\n{shown}");
    }
}
