//! Corrections of poses, focal lengths and time offsets by training: in one line, and as a section of the report.

use super::chart::escape;
use crate::run_folder::Run;
use serde_json::Value;
use splat4d_train::run::corrected;
use std::fmt::Write;

/// Corrections of cameras, in one line; `None`: no camera was refined.
pub fn refined_in_words(refined: &Value) -> Option<String> {
    let rows = refined["cameras"].as_array()?;
    let number = |row: &Value, key: &str| row[key].as_f64().unwrap_or(0.0).abs();
    let sorted = |key: &str| {
        let mut rows: Vec<&Value> = rows.iter().collect();
        rows.sort_by(|a, b| number(b, key).total_cmp(&number(a, key)));
        rows
    };
    let mut words = Vec::new();
    if refined["poses"] == true {
        let (turned, shifted) = (sorted("degrees"), sorted("share"));
        let (worst, far) = (turned.first()?, shifted.first()?);
        words.push(format!(
            "cameras rotated by {:.2}° (median), at most {:.2}° ({}); moved by {:.2} % of the rig's radius (median), \
             at most {:.2} % ({})",
            number(turned[turned.len() / 2], "degrees"),
            number(worst, "degrees"),
            worst["camera"].as_str()?,
            100.0 * number(shifted[shifted.len() / 2], "share"),
            100.0 * number(far, "share"),
            far["camera"].as_str()?,
        ));
    }
    if refined["focal"] == true {
        let by_focal = sorted("focal");
        let worst = by_focal.first()?;
        words.push(format!(
            "focal lengths changed by {:.2} % (median), at most {:.2} % ({})",
            100.0 * number(by_focal[by_focal.len() / 2], "focal"),
            100.0 * number(worst, "focal"),
            worst["camera"].as_str()?,
        ));
    }
    if refined["lens"] == true {
        let mut lenses: Vec<[f64; 2]> =
            rows.iter().map(|row| [0, 1].map(|k| row["lens"][k].as_f64().unwrap_or(0.0))).collect();
        lenses.sort_by(|a, b| a[0].total_cmp(&b[0]));
        lenses.dedup();
        let text = |k: &[f64; 2]| format!("{:+.4}, {:+.4}", k[0], k[1]);
        let (first, last) = (lenses.first()?, lenses.last()?);
        words.push(match lenses.len() {
            1 => format!("distortion k1, k2 changed by {}", text(first)),
            n => format!("distortion k1, k2 of {n} lenses changed by {} to {}", text(first), text(last)),
        });
    }
    if refined["times"] == true {
        let by_time = sorted("offset");
        let worst = by_time.first()?;
        words.push(format!(
            "time offsets changed by {:.1} ms (median), at most {:.1} ms ({})",
            1e3 * number(by_time[by_time.len() / 2], "offset"),
            1e3 * number(worst, "offset"),
            worst["camera"].as_str()?,
        ));
    }
    (!words.is_empty()).then(|| format!("refined: {}", words.join("; ")))
}

/// Corrections of cameras, largest first.
pub(super) fn section(out: &mut String, run: &Run) {
    // A damaged file was reported when the run was measured.
    let Some(refined) = corrected::read(&run.path).ok().flatten() else { return };
    let Some(words) = refined_in_words(&refined) else { return };
    let number = |row: &Value, key: &str| row[key].as_f64().unwrap_or(0.0);
    let mut rows: Vec<&Value> = refined["cameras"].as_array().into_iter().flatten().collect();
    let far = |row: &Value| number(row, "degrees").to_radians() + number(row, "share") + number(row, "frames").abs();
    rows.sort_by(|a, b| far(b).total_cmp(&far(a)));
    let _ = writeln!(
        out,
        "<h2>Refined cameras</h2>\n<p class=\"note\">{}</p>\n<table class=\"numbers\"><tr><th>camera</th><th>rotated, °</th><th>moved, \
         % of the radius</th><th>focal length, %</th><th>time offset, ms</th></tr>",
        escape(&words)
    );
    for row in rows.into_iter().take(super::CAMERA_BARS) {
        let name = row["camera"].as_str().unwrap_or_default();
        let name = row["frame"].as_u64().map_or_else(|| name.to_owned(), |frame| format!("{name}, frame {frame}"));
        let _ = writeln!(
            out,
            "<tr><td>{}</td><td>{:.3}</td><td>{:.3}</td><td>{:.3}</td><td>{:.2}</td></tr>",
            escape(&name),
            number(row, "degrees"),
            100.0 * number(row, "share"),
            100.0 * number(row, "focal"),
            1e3 * number(row, "offset")
        );
    }
    out.push_str("</table>\n");
}
