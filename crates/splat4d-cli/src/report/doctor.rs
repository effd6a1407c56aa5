//! `doctor.html`: what is wrong with a capture, worst first, and every camera's picture and figures.

use super::chart::escape;
use super::{STYLE, pictures};
use image::RgbImage;
use splat4d_import::doctor::{Grade, Report};
use std::fmt::Write;

/// The page.
pub(crate) fn page(report: &Report) -> String {
    let mut body = String::new();
    let _ = writeln!(body, "<header><h1>{}</h1><p>{}</p></header>", escape(&report.capture), escape(&summary(report)));
    body.push_str("<h2>Findings, worst first</h2>\n");
    for f in &report.findings {
        let text = format!("{} {} {}", f.what, f.looks, f.remedy);
        let class = if f.grade == Grade::Note { "note" } else { "warn" };
        let _ = writeln!(body, "<div class=\"{class}\"><b>{}</b> {}</div>", word(f.grade), escape(text.trim()));
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
    body.push_str("<h2>Cameras</h2>\n<div class=\"grid3\">");
    for camera in &report.cameras {
        let p = &camera.picture;
        let picture = RgbImage::from_raw(p.width as u32, p.height as u32, p.data.clone()).filter(|p| p.width() > 0);
        let image = picture.and_then(pictures::reduced).map(|uri| {
            format!(
                "<img style=\"width:100%;border-radius:8px\" alt=\"camera {}\" src=\"{uri}\">",
                escape(&camera.name)
            )
        });
        let _ =
            write!(body, "<div class=\"panel\"><h3>{}</h3>{}<table>", escape(&camera.name), image.unwrap_or_default());
        let mut row = |name: &str, value: Option<String>| {
            if let Some(value) = value {
                let _ = write!(body, "<tr><th>{name}</th><td>{}</td></tr>", escape(&value));
            }
        };
        row("poses", camera.epipolar.map(|v| format!("{v:.2} px of 1920")));
        row("clock", camera.offset.map(|[v, s]| format!("{:+.1} ± {:.1} ms", 1e3 * v, 1e3 * s)));
        row("exposure", camera.exposure.map(|e| e.map(|v| format!("{v:+.2}")).join(" ") + " stops"));
        row("sharpness", camera.sharpness.map(|v| format!("{v:.2} times the others'")));
        row("moved", camera.moved.map(|v| format!("{v:.2} px of 1920")));
        body.push_str("</table></div>\n");
    }
    body.push_str("</div>\n");
    let title = escape(&report.capture);
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\"><title>{title} · splat4d doctor</title>\n<style>\n{STYLE}</style>\
         </head>\n<body><main>\n{body}</main></body></html>\n"
    )
}

/// How bad it is, in a word.
pub(crate) fn word(grade: Grade) -> &'static str {
    match grade {
        Grade::Bad => "bad",
        Grade::Warning => "warning",
        Grade::Note => "note",
    }
}

/// All of it in a sentence.
pub(crate) fn summary(report: &Report) -> String {
    let count = |g: Grade| report.findings.iter().filter(|f| f.grade == g).count();
    let cameras = report.cameras.len();
    format!(
        "{cameras} camera{}: {} bad, {} warnings, {} notes",
        if cameras == 1 { "" } else { "s" },
        count(Grade::Bad),
        count(Grade::Warning),
        count(Grade::Note)
    )
}
