//! `info --doctor`: problems of a capture, on the terminal, as a page and as JSON.

use super::Inspection;
use crate::events::Listener;
use crate::report::doctor::{about, made, sentence, summary};
use serde_json::json;
use splat4d::Result;
use splat4d_import::doctor::Grade;
use splat4d_train::capture::Capture;
use std::fmt::Write;
use std::path::Path;

pub(super) fn of(capture: &Capture, folder: &Path, console: &dyn Listener) -> Result<Inspection> {
    let (report, html) = made(capture, folder, console)?;
    let mut text = format!("{}\n", summary(&report));
    for f in report.findings.iter().filter(|f| f.grade == Grade::Note) {
        let _ = writeln!(text, "{}", sentence(f));
    }
    for line in about(&report) {
        let _ = writeln!(text, "{line}");
    }
    for left in &report.left {
        let _ = writeln!(text, "not checked: {left}");
    }
    if !report.leave_out.is_empty() {
        let _ = writeln!(text, "leave out: {}", report.leave_out.join(", "));
    }
    let _ = writeln!(text, "wrote {} and doctor.json next to it", html.display());
    let troubles = report.findings.iter().filter(|f| f.grade > Grade::Note).map(sentence).collect();
    let mut json = serde_json::to_value(&report).expect("a report is plain data");
    json["type"] = json!("doctor");
    json["page"] = json!(html.to_string_lossy());
    Ok(Inspection { json, text, troubles, listed: Vec::new(), poses_unchecked: false })
}
