//! How scenes and files play, side by side: `splat4d_workflow::measure` by hand.

use serde::Serialize;
use splat4d::Result;
use splat4d_cli::console::Console;
use splat4d_workflow::draw::antialias;
use splat4d_workflow::files::{self, grouped, human_bytes};
use splat4d_workflow::measure::{Side, Subject, What, in_turns, measured_views_of};
use splat4d_workflow::source::{Source, not_empty};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A row of the JSON array.
#[derive(Debug, Serialize)]
pub(super) struct Played {
    file: PathBuf,
    threads: usize,
    width: usize,
    height: usize,
    #[serde(flatten)]
    side: Side,
}

/// Measures alternately, with all threads of the current pool.
pub(super) fn measure(files: &[PathBuf], size: [usize; 2], console: &Console) -> Result<Vec<Played>> {
    let sources = files.iter().map(|f| Opened::new(f)).collect::<Result<Vec<_>>>()?;
    // Frame rates compare only where the images do: all are seen from the first one's cameras that has some.
    let first = sources.iter().position(|s| s.source.run.is_some() || s.source.playback.is_some()).unwrap_or(0);
    let measured_views = measured_views_of(&sources[first].source, size)?;
    let subjects: Vec<Subject<'_>> = sources
        .iter()
        .map(|one| Subject {
            what: one.bytes.clone().map_or(What::Scene(&one.source.scene), What::File),
            antialias: antialias(one.smooth()),
        })
        .collect();
    let sides = in_turns(&subjects, &measured_views, &mut |done, total| console.phase("playing", done, total));
    console.clear();
    let rows = sides?.into_iter().zip(files).zip(&sources).map(|((side, file), one)| Played {
        file: file.clone(),
        threads: rayon::current_num_threads(),
        width: size[0],
        height: size[1],
        side: one.source.run.iter().fold(side, |side, run| side.scored_by(run)),
    });
    Ok(rows.collect())
}

/// A source, and its bytes where it is a playback file.
struct Opened {
    source: Source,
    bytes: Option<Arc<[u8]>>,
}

impl Opened {
    fn new(path: &Path) -> Result<Self> {
        let source = Source::open(path)?;
        not_empty(&source.scene, path)?;
        let bytes = match &source.playback {
            Some(_) => Some(files::read(path)?.into()),
            None => None,
        };
        Ok(Self { source, bytes })
    }

    fn smooth(&self) -> bool {
        self.source.run.as_ref().and_then(|r| r.recipe().ok()).is_some_and(|r| r.appearance.antialias)
    }
}

/// An array, a row per line.
pub(super) fn json(rows: &[Played]) -> String {
    let lines: Vec<String> = rows.iter().map(|r| serde_json::to_string(r).expect("rows are plain data")).collect();
    format!("[\n{}\n]", lines.join(",\n"))
}

/// A quantity's name, and how a side prints it.
type Quantity<'a> = (&'a str, &'a dyn Fn(&Side) -> String);

/// A line for each quantity, a column for each file; the head first.
fn cells(rows: &[Played]) -> Vec<Vec<String>> {
    let number = |v: Option<f64>, digits: usize| v.map_or_else(String::new, |v| format!("{v:.digits$}"));
    let quantities: [Quantity<'_>; 13] = [
        ("Gaussians", &|s| grouped(s.gaussians)),
        ("active, mean", &|s| grouped(s.active_mean.round() as usize)),
        ("active, maximum", &|s| grouped(s.active_max)),
        ("bytes", &|s| human_bytes(s.bytes)),
        ("as 32-bit floats", &|s| human_bytes(s.float_bytes)),
        ("Mbit/s", &|s| number(s.mbit_per_s, 1)),
        ("PSNR, dB", &|s| number(s.psnr, 2)),
        ("dynamic regions, dB", &|s| number(s.psnr_dynamic, 2)),
        ("frames/s, end to end", &|s| number(Some(s.fps), 1)),
        ("frames/s, blend alone", &|s| number(Some(s.raster_fps), 1)),
        ("pairs tested, million", &|s| number(Some(1e-6 * s.pairs), 2)),
        ("bytes to first image, ms", &|s| number(Some(s.decode_ms), 1)),
        ("frames/s, ratio to the first", &|s| {
            rows.first().map_or_else(String::new, |r| format!("{:.2}x", s.fps / r.side.fps))
        }),
    ];
    let mut out = vec![vec![rows.first().map_or_else(String::new, |r| format!("{}x{}", r.width, r.height))]];
    out[0].extend(rows.iter().map(|r| r.file.display().to_string()));
    for (name, tell) in quantities {
        let line: Vec<String> = rows.iter().map(|r| tell(&r.side)).collect();
        if line.iter().any(|cell| !cell.is_empty()) {
            out.push(std::iter::once(name.to_owned()).chain(line).collect());
        }
    }
    out
}

/// For people at a terminal.
pub(super) fn table(rows: &[Played]) -> String {
    let cells = cells(rows);
    let width = |c: usize| cells.iter().map(|line| line[c].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..cells[0].len()).map(width).collect();
    let line = |line: &Vec<String>| {
        let cell = |(c, (text, &w)): (usize, (&String, &usize))| {
            if c == 0 { format!("{text:<w$}") } else { format!("{text:>w$}") }
        };
        line.iter().zip(&widths).enumerate().map(cell).collect::<Vec<_>>().join("  ")
    };
    cells.iter().map(line).collect::<Vec<_>>().join("\n")
}

/// For Markdown pages.
pub(super) fn markdown(rows: &[Played]) -> String {
    let mut lines: Vec<String> = cells(rows).iter().map(|line| format!("| {} |", line.join(" | "))).collect();
    lines.insert(1, format!("|---|{}", "---:|".repeat(rows.len())));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_printed_in_three_formats() {
        let row = |name: &str, fps: f64, psnr: Option<f64>| Played {
            file: name.into(),
            threads: 2,
            width: 800,
            height: 600,
            side: Side { gaussians: 150_000, fps, psnr, ..Side::default() },
        };
        let rows = [row("runs/a", 20.0, Some(31.254)), row("a.s4d", 50.0, None)];
        let text = table(&rows);
        assert!(text.starts_with("800x600") && text.contains("150,000") && text.contains("2.50x"), "{text}");
        assert!(text.contains("31.25") && !text.contains("dynamic regions"), "{text}");
        assert!(text.lines().all(|l| l.chars().count() == text.lines().next().unwrap().chars().count()), "{text}");
        let page = markdown(&rows);
        assert!(page.lines().all(|l| l.matches('|').count() == 4), "{page}");
        let back: Vec<serde_json::Value> = serde_json::from_str(&json(&rows)).unwrap();
        assert_eq!((back[1]["file"].as_str(), back[1]["fps"].as_f64()), (Some("a.s4d"), Some(50.0)));
    }
}
