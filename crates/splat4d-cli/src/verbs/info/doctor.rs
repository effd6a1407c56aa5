//! `info --doctor`: everything that is wrong with a capture, on the terminal, as a page and as JSON.

use super::Told;
use crate::console::Console;
use crate::files;
use crate::report::doctor::{page, summary, word};
use serde_json::json;
use splat4d_import::doctor::{Grade, Options, examine};
use splat4d_train::capture::Capture;
use splat4d_train::event::{Event, Progress};
use std::fmt::Write;
use std::path::Path;

pub(super) fn of(capture: &Capture, folder: &Path, console: &Console) -> anyhow::Result<Told> {
    let mut listen = |event: &Event| console.event(event);
    let report = examine(capture, &Options::default(), &mut Progress(&mut listen))?;
    console.clear();
    files::make_folder(folder)?;
    let (html, data) = (folder.join("doctor.html"), folder.join("doctor.json"));
    files::write(&html, page(&report).as_bytes())?;
    files::write(&data, &serde_json::to_vec_pretty(&report)?)?;
    let mut text = format!("{}\n", summary(&report));
    for f in report.findings.iter().filter(|f| f.grade == Grade::Note) {
        let _ = writeln!(text, "{:<8} {} {} {}", word(f.grade), f.what, f.looks, f.remedy);
    }
    for left in &report.left {
        let _ = writeln!(text, "not checked: {left}");
    }
    if !report.leave_out.is_empty() {
        let _ = writeln!(text, "leave out: {}", report.leave_out.join(", "));
    }
    let _ = writeln!(text, "wrote {} and {}", html.display(), data.display());
    let told = report.findings.iter().filter(|f| f.grade > Grade::Note);
    let troubles = told.map(|f| format!("{}: {} {} {}", word(f.grade), f.what, f.looks, f.remedy)).collect();
    let mut json = serde_json::to_value(&report)?;
    json["type"] = json!("doctor");
    json["page"] = json!(html);
    Ok(Told { json, text, troubles })
}
