//! The table of cameras against measured geometry, on the page of a run.

use super::chart::escape;
use crate::run_folder::Run;
use serde_json::Value;
use std::fmt::Write;

/// Cameras and how far they are from measured geometry, largest first.
pub(super) fn section(out: &mut String, run: &Run) {
    let mut rows: Vec<&Value> = run.geometry["cameras"].as_array().into_iter().flatten().collect();
    if rows.is_empty() {
        return;
    }
    let number = |row: &Value, key: &str| row[key].as_f64();
    rows.sort_by(|a, b| number(b, "error").unwrap_or(-1.0).total_cmp(&number(a, "error").unwrap_or(-1.0)));
    let percent = |share: Option<f64>| share.map_or_else(|| "–".to_owned(), |s| format!("{:.1} %", 100.0 * s));
    let _ = writeln!(
        out,
        "<h2>Measured geometry</h2>\n<p class=\"note\">Depth of the trained scene against the scan, where it has a surface: in {} of \
         the pixels. The error is the median of |D / D* − 1|, the ratio that of D / D*.</p>\n<table \
         class=\"numbers\"><tr><th>camera</th><th>measured</th><th>error</th><th>ratio</th></tr>",
        percent(number(&run.geometry, "measured"))
    );
    for row in rows.into_iter().take(super::CAMERA_BARS) {
        let _ = writeln!(
            out,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            escape(row["camera"].as_str().unwrap_or_default()),
            percent(number(row, "measured")),
            percent(number(row, "error")),
            number(row, "ratio").map_or_else(|| "–".to_owned(), |r| format!("{r:.3}"))
        );
    }
    out.push_str("</table>\n");
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn cameras_are_listed_by_their_error_and_runs_without_a_scan_have_no_table() {
        let (mut out, mut run) = (String::new(), Run::default());
        section(&mut out, &run);
        assert_eq!(out, "");
        run.geometry = json!({"measured": 0.5, "cameras": [
            {"camera": "a<b", "measured": 0.4, "error": 0.01, "ratio": 1.0},
            {"camera": "c", "measured": 0.0, "error": null, "ratio": null},
            {"camera": "d", "measured": 0.6, "error": 0.2, "ratio": 0.8},
        ]});
        section(&mut out, &run);
        let at = |text: &str| out.find(text).unwrap_or_else(|| panic!("{text}: {out}"));
        assert!(at("<td>d</td>") < at("a&lt;b") && at("a&lt;b") < at("<td>c</td>") && at("20.0 %") < at("1.0 %</td>"));
    }
}
