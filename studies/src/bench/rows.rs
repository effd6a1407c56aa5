//! Measurements: rows, and the three forms in which they are printed.

use serde::{Deserialize, Serialize};
use splat4d::{Error, Result};
use splat4d_workflow::files::{self, grouped, human_bytes};
use std::fmt::Write;
use std::path::Path;

/// One measurement. Its JSON is the verb's interface; further fields appear where they mean something.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Row {
    /// A letter, or what grew.
    pub scene: String,
    pub stage: String,
    pub threads: usize,
    /// scalar, avx2 or avx512; gpu.
    pub simd: String,
    /// Mean over the scene's views of the best of several rounds.
    pub ms: f64,
    /// The lower bound, the least time that its compulsory work takes at the rates of this machine, as a share of `ms`.
    pub ceiling_share: Option<f64>,
    /// Pairs of pixel and Gaussian that the blend loop evaluated, mean over the views.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tested_pairs: Option<u64>,
    /// Of these: with α ≥ 1/255 before the pixel stopped.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub contributing_pairs: Option<u64>,
    /// Compulsory bytes over the time, 10⁹ a second; for stages that only move memory.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gb_per_s: Option<f64>,
    /// Part of a training step that is neither the renderer's forward nor its backward.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub outside_share: Option<f64>,
    /// Most memory that the process held while this was measured, bytes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_memory: Option<u64>,
    /// Value of the quantity that was varied: Gaussians, pixels or frames.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub x: Option<f64>,
    /// Bytes, for rows about memory.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bytes: Option<u64>,
    /// The GPU and its driver, where one was measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub device: Option<String>,
    /// Constants of its kernels that were not at their defaults.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tuning: Option<String>,
    /// This time over that of the earlier result, or of a sweep over that at the defaults; above 1 is slower.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub against: Option<f64>,
}

impl Row {
    /// Whether two rows measure the same quantity.
    fn twin(&self, other: &Self) -> bool {
        let key = |r: &Self| (r.threads, r.x.map(f64::to_bits), r.tuning.clone());
        self.scene == other.scene && self.stage == other.stage && self.simd == other.simd && key(self) == key(other)
    }
}

/// An array, a row per line.
pub(super) fn json(rows: &[Row]) -> String {
    let lines: Vec<String> =
        rows.iter().map(|r| serde_json::to_string(r).expect("a row is plain data with names")).collect();
    if lines.is_empty() { "[]".into() } else { format!("[\n{}\n]", lines.join(",\n")) }
}

/// Reads what [`json`] wrote.
pub(super) fn read(path: &Path) -> Result<Vec<Row>> {
    let text = files::read_text(path)?;
    let broken = |what: String| {
        Error::input(format!("invalid result of `studies bench`: {what}"))
            .at(path.display())
            .remedy("Make one with `studies bench --save FILE`.")
    };
    let rows: Vec<Row> = serde_json::from_str(&text).map_err(|e| broken(e.to_string()))?;
    match rows.iter().position(|r| !(r.ms.is_finite() && r.ms >= 0.0)) {
        Some(i) => Err(broken(format!("row {i} has a time of {} ms", rows[i].ms))),
        None => Ok(rows),
    }
}

/// Fills in each row's ratio to the earlier result; returns how many rows have one.
pub(super) fn compare(rows: &mut [Row], earlier: &[Row]) -> usize {
    let mut found = 0;
    for row in rows {
        let Some(old) = earlier.iter().find(|old| old.twin(row) && old.ms > 0.0) else { continue };
        row.against = Some(row.ms / old.ms);
        found += 1;
    }
    found
}

/// A table cell a string; first the head.
fn cells(rows: &[Row]) -> Vec<Vec<String>> {
    if rows.iter().any(|r| r.x.is_some()) { grown_cells(rows) } else { stage_cells(rows) }
}

/// Each value once, in order of appearance.
fn distinct<T: PartialEq>(values: impl Iterator<Item = T>) -> Vec<T> {
    let mut out = Vec::new();
    for value in values {
        if !out.contains(&value) {
            out.push(value);
        }
    }
    out
}

/// A line for each quantity and size, with its stages side by side; a line for each place where memory is.
fn grown_cells(rows: &[Row]) -> Vec<Vec<String>> {
    let stages = distinct(rows.iter().filter(|r| r.bytes.is_none()).map(|r| r.stage.as_str()));
    let memory = rows.iter().any(|r| r.bytes.is_some());
    let mut head = vec!["what".to_owned(), "with".into()];
    head.extend(stages.iter().map(|s| format!("{s}, ms")));
    if memory {
        head.push("memory".into());
    }
    let mut out = vec![head];
    let count = |r: &Row| r.x.map_or_else(String::new, |x| grouped(x as usize));
    for row in rows.iter().filter(|r| r.bytes.is_some()) {
        let mut line = vec![format!("{}: {}", row.scene, row.stage), count(row)];
        let step = |s: &&str| if *s == "step" && row.ms > 0.0 { milliseconds(row.ms) } else { String::new() };
        line.extend(stages.iter().map(step));
        line.push(row.bytes.map_or_else(String::new, human_bytes));
        out.push(line);
    }
    let place = |r: &Row| (r.scene.clone(), r.x.map(f64::to_bits), r.simd.clone());
    for at in distinct(rows.iter().filter(|r| r.bytes.is_none()).map(place)) {
        let here: Vec<&Row> = rows.iter().filter(|r| r.bytes.is_none() && place(r) == at).collect();
        let mut line = vec![at.0, count(here[0])];
        let of = |stage: &&str| here.iter().find(|r| r.stage == *stage);
        line.extend(stages.iter().map(|s| of(s).map_or_else(String::new, |r| milliseconds(r.ms))));
        line.extend(memory.then(String::new));
        out.push(line);
    }
    out
}

/// A line for each scene and stage, with its threads side by side.
fn stage_cells(rows: &[Row]) -> Vec<Vec<String>> {
    let mut threads = distinct(rows.iter().map(|r| r.threads));
    threads.sort_unstable();
    let compared = rows.iter().any(|r| r.against.is_some());
    let levels = distinct(rows.iter().map(|r| r.simd.as_str())).len() > 1;
    let mut head = vec!["scene".to_owned(), "stage".into()];
    head.extend(threads.iter().map(|n| format!("ms, {n} thread{}", if *n == 1 { "" } else { "s" })));
    if threads.len() > 1 {
        head.push("gain".into());
    }
    head.push("lower bound, ms".into());
    if compared {
        head.push("to earlier".into());
    }
    head.push("remarks".into());
    let mut out = vec![head];
    let place = |r: &Row| (r.scene.clone(), r.stage.clone(), r.simd.clone(), r.tuning.clone());
    for at in distinct(rows.iter().map(place)) {
        let of = |n: usize| rows.iter().find(|r| r.threads == n && place(r) == at);
        let all: Vec<Option<&Row>> = threads.iter().map(|n| of(*n)).collect();
        let here: Vec<&Row> = all.iter().flatten().copied().collect();
        let scene = if levels { format!("{} {}", at.0, at.2) } else { at.0.clone() };
        let scene = at.3.as_ref().map_or(scene.clone(), |tuning| format!("{scene} {tuning}"));
        let mut line = vec![scene, at.1.clone()];
        line.extend(all.iter().map(|r| r.map_or_else(String::new, |r| milliseconds(r.ms))));
        if threads.len() > 1 {
            let gain = all[0].zip(all[all.len() - 1]).filter(|(_, many)| many.ms > 0.0);
            line.push(gain.map_or_else(String::new, |(one, many)| format!("{:.2}x", one.ms / many.ms)));
        }
        let joined =
            |f: &dyn Fn(&Row) -> Option<String>| here.iter().filter_map(|r| f(r)).collect::<Vec<_>>().join(", ");
        let bound = |share: f64, ms: f64| format!("{} ({:.0} %)", milliseconds(share * ms), 100.0 * share);
        line.push(joined(&|r| r.ceiling_share.map(|share| bound(share, r.ms))));
        if compared {
            line.push(joined(&|r| r.against.map(|a| format!("{a:.2}"))));
        }
        line.push(here.last().map_or_else(String::new, |r| remarks(r)));
        out.push(line);
    }
    out
}

fn milliseconds(ms: f64) -> String {
    if ms < 1.0 { format!("{ms:.3}") } else { format!("{ms:.2}") }
}

fn remarks(row: &Row) -> String {
    let mut said = Vec::new();
    if let (Some(tested), Some(seen)) = (row.tested_pairs, row.contributing_pairs) {
        let share = 100.0 * seen as f64 / (tested as f64).max(1.0);
        said.push(format!(
            "{:.2} M pairs tested, {:.2} M contribute ({share:.0} %)",
            tested as f64 * 1e-6,
            seen as f64 * 1e-6
        ));
    }
    if let (Some(tested), None) = (row.tested_pairs, row.contributing_pairs) {
        said.push(format!("{:.2} M pairs of pixel and Gaussian at most", tested as f64 * 1e-6));
    }
    if let Some(rate) = row.gb_per_s {
        said.push(format!("{rate:.1} GB/s"));
    }
    if let Some(share) = row.outside_share {
        said.push(format!("{:.0} % outside the renderer", 100.0 * share));
    }
    if let Some(bytes) = row.peak_memory.filter(|b| *b > 0) {
        said.push(format!("at most {}", human_bytes(bytes)));
    }
    said.join(", ")
}

/// For people at a terminal.
pub(super) fn table(rows: &[Row]) -> String {
    let cells = cells(rows);
    let columns = cells[0].len();
    let width = |c: usize| cells.iter().map(|line| line[c].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut out = String::new();
    for (i, line) in cells.iter().enumerate() {
        if i > 0 && line[0] != cells[i - 1][0] && i > 1 {
            out.push('\n');
        }
        let mut text = String::new();
        for (c, cell) in line.iter().enumerate() {
            let w = widths[c];
            // Names and remarks are left-aligned, numbers right-aligned.
            let _ = if c < 2 || c + 1 == columns { write!(text, "{cell:<w$}  ") } else { write!(text, "{cell:>w$}  ") };
        }
        let _ = writeln!(out, "{}", text.trim_end());
    }
    out
}

/// For docs/benchmarks.md.
pub(super) fn markdown(rows: &[Row]) -> String {
    let mut out = String::new();
    for (i, line) in cells(rows).iter().enumerate() {
        let _ = writeln!(out, "| {} |", line.join(" | "));
        if i == 0 {
            let _ = writeln!(out, "|{}", "---|".repeat(line.len()));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(stage: &str, threads: usize, ms: f64) -> Row {
        Row { scene: "T".into(), stage: stage.into(), threads, simd: "avx2".into(), ms, ..Row::default() }
    }

    #[test]
    fn json_is_an_array_that_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("rows.json");
        let rows =
            [Row { ceiling_share: Some(0.5), tested_pairs: Some(7), ..row("blend", 1, 2.5) }, row("step", 2, 9.0)];
        std::fs::write(&file, json(&rows)).unwrap();
        assert_eq!(read(&file).unwrap(), rows);
        let plain: Vec<serde_json::Value> = serde_json::from_str(&json(&rows)).unwrap();
        let keys: Vec<&String> = plain[1].as_object().unwrap().keys().collect();
        assert_eq!(keys, ["ceiling_share", "ms", "scene", "simd", "stage", "threads"], "nothing that has no meaning");
        assert_eq!(json(&[]), "[]");
        for broken in ["", "{", "{}", "[{\"scene\": 1}]", "[1]"] {
            std::fs::write(&file, broken).unwrap();
            assert!(read(&file).unwrap_err().to_string().contains("bench --save"), "{broken}");
        }
        std::fs::write(&file, json(&[row("x", 1, -1.0)])).unwrap();
        assert!(read(&file).is_err(), "a time cannot be negative");
    }

    #[test]
    fn rows_are_compared_with_their_twins_only() {
        let mut rows = [row("blend", 1, 2.0), row("blend", 2, 1.0), row("step", 1, 5.0)];
        let earlier = [row("blend", 1, 4.0), Row { simd: "scalar".into(), ..row("blend", 2, 9.0) }];
        assert_eq!(compare(&mut rows, &earlier), 1);
        assert_eq!(rows.map(|r| r.against), [Some(0.5), None, None]);
    }

    #[test]
    fn the_table_has_one_line_per_stage_with_the_gain_of_the_second_core() {
        let rows = [row("blend", 1, 2.0), row("step", 1, 5.0), row("blend", 2, 1.0), row("step", 2, 4.0)];
        let text = table(&rows);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 3, "{text}");
        assert!(lines[1].contains("blend") && lines[1].contains("2.00x"), "{text}");
        let bound = Row { ceiling_share: Some(0.25), ..row("blend", 1, 2.0) };
        let page = markdown(&[bound]);
        assert!(page.contains("| lower bound, ms |") && page.contains("| 2.00 | 0.500 (25 %) |"), "{page}");
        assert!(lines[2].contains("step") && lines[2].contains("1.25x"), "{text}");
        let page = markdown(&rows);
        assert!(page.lines().all(|l| l.starts_with('|') && l.ends_with('|')), "{page}");
        assert!(table(&[]).lines().count() == 1);
        let levels = [row("blend", 1, 2.0), Row { simd: "scalar".into(), ..row("blend", 1, 6.0) }];
        let text = table(&levels);
        assert!(text.contains("T avx2") && text.contains("T scalar"), "{text}");
    }

    #[test]
    fn growth_tables_have_one_line_per_size_and_memory_one_per_allocation() {
        let grown = |stage: &str, x: f64, ms: f64| Row { scene: "pixels".into(), x: Some(x), ..row(stage, 2, ms) };
        let place = Row { scene: "memory".into(), bytes: Some(3 << 20), ..grown("parameters", 1e6, 0.0) };
        let rows = [place, grown("step", 1e4, 5.0), grown("rest", 1e4, 2.0), grown("step", 4e4, 9.0)];
        let page = markdown(&rows);
        let lines: Vec<&str> = page.lines().collect();
        assert_eq!(lines[0], "| what | with | step, ms | rest, ms | memory |");
        assert_eq!(lines[2], "| memory: parameters | 1,000,000 |  |  | 3.0 MiB |");
        assert_eq!(lines[3..], ["| pixels | 10,000 | 5.00 | 2.00 |  |", "| pixels | 40,000 | 9.00 |  |  |"]);
    }
}
