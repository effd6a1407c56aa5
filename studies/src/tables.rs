//! Results of a study, as tables for Markdown pages and as curves.

use crate::cells::{Cell, Grid};
use crate::study::{Findings, FolderContent};
use splat4d_workflow::files::{grouped, human_bytes};
use splat4d_workflow::measure::Side;
use splat4d_workflow::report::chart::{self, Series};
use std::fmt::Write;

/// All tables of one run. Cells that are missing are empty.
pub(crate) fn markdown(findings: &Findings, grid: &Grid) -> String {
    let mut out = format!("## {}\n", findings.name);
    if let Some(source) = findings.of(&Cell::source()) {
        let _ = write!(
            out,
            "\n{} Gaussians, {} as 32-bit floats; fine-tuning takes {} steps. PSNR is that of the held-out views, \
             `moving` is that of dynamic regions. Frames a second are the CPU's, end to end (blending alone), times those of \
             the source, which were measured alternately with them.\n",
            grouped(source.side.gaussians),
            human_bytes(source.side.float_bytes),
            grouped(grid.steps)
        );
    }
    parts(&mut out, findings, grid);
    shares(&mut out, findings, grid);
    scores(&mut out, findings, grid);
    intervals(&mut out, findings, grid);
    rounds(&mut out, findings, grid);
    out
}

fn parts(out: &mut String, findings: &Findings, grid: &Grid) {
    let head = ["scene", "Gaussians", "alive at a frame", "PSNR", "moving", "SSIM", "flicker", "frames/s"];
    let line = |(name, cell): (String, Cell)| {
        let found = findings.of(&cell);
        let side = |f: &dyn Fn(&Side) -> String| found.map_or_else(String::new, |found| f(&found.side));
        vec![
            name,
            side(&|s| grouped(s.gaussians)),
            side(&|s| grouped(s.active_mean.round() as usize)),
            side(&|s| number(s.psnr, 2)),
            side(&|s| number(s.psnr_dynamic, 2)),
            side(&|s| number(s.ssim, 4)),
            side(&|s| number(s.flicker, 3)),
            speed(found),
        ]
    };
    table(out, "What each part does", &head, grid.parts().into_iter().map(line).collect());
}

fn shares(out: &mut String, findings: &Findings, grid: &Grid) {
    let head = [
        "removed",
        "Gaussians",
        "pruned: PSNR",
        "moving",
        "fine-tuned: PSNR",
        "moving",
        "lost, dB",
        "filter, fine-tuned: PSNR",
        "moving",
        "lost, dB",
        "frames/s",
    ];
    // The scene that was trained as many steps without losing anything.
    let fair = findings.of(&grid.share(0.0)[1]).and_then(|f| f.side.psnr);
    let line = |share: &f64| {
        let cells = grid.share(*share);
        let [pruned, tuned, filtered] = [0, 1, 2].map(|i| findings.of(&cells[i]));
        let lost =
            |found: Option<&FolderContent>| number(fair.zip(found.and_then(|f| f.side.psnr)).map(|(a, b)| a - b), 2);
        let gaussians = pruned.map_or_else(String::new, |f| grouped(f.side.gaussians));
        let mut line = vec![format!("{:.0} %", 100.0 * share), gaussians];
        line.extend(both(pruned));
        line.extend(both(tuned));
        line.push(lost(tuned));
        line.extend(both(filtered));
        line.extend([lost(filtered), speed(filtered)]);
        line
    };
    table(out, "Quality against the share removed", &head, grid.shares.iter().map(line).collect());
}

fn scores(out: &mut String, findings: &Findings, grid: &Grid) {
    let head = ["score", "pruned: PSNR", "moving", "fine-tuned: PSNR", "moving"];
    let line = |(name, score): &(String, crate::cells::Score)| {
        let [pruned, tuned] = grid.score(*score);
        let (pruned, tuned) = (both(findings.of(&pruned)), both(findings.of(&tuned)));
        std::iter::once(name.clone()).chain(pruned).chain(tuned).collect()
    };
    table(
        out,
        &format!("Scores, at {:.0} %", 100.0 * grid.round(1).prune),
        &head,
        grid.scores.iter().map(line).collect(),
    );
}

fn intervals(out: &mut String, findings: &Findings, grid: &Grid) {
    let head =
        ["frames between keys", "alive at a frame", "filter: PSNR", "moving", "fine-tuned: PSNR", "moving", "frames/s"];
    let line = |interval: &usize| {
        let cells = grid.interval(*interval);
        let [plain, tuned] = [0, 1].map(|i| findings.of(&cells[i]));
        let alive = plain.map_or_else(String::new, |f| grouped(f.side.active_mean.round() as usize));
        let mut line = vec![interval.to_string(), alive];
        line.extend(both(plain));
        line.extend(both(tuned));
        line.push(speed(tuned.or(plain)));
        line
    };
    let title = format!("Key frames of the filter, at {:.0} %", 100.0 * grid.round(1).prune);
    table(out, &title, &head, grid.intervals.iter().map(line).collect());
}

fn rounds(out: &mut String, findings: &Findings, grid: &Grid) {
    if grid.rounds.len() < 2 {
        return;
    }
    let line = |rounds: &usize| {
        let found = findings.of(&grid.round(*rounds));
        std::iter::once(rounds.to_string()).chain(both(found)).collect()
    };
    let title = format!("Rounds of pruning, at {:.0} %, fine-tuned", 100.0 * grid.round(1).prune);
    table(out, &title, &["rounds", "PSNR", "moving"], grid.rounds.iter().map(line).collect());
}

fn both(found: Option<&FolderContent>) -> [String; 2] {
    [found.and_then(|f| f.side.psnr), found.and_then(|f| f.side.psnr_dynamic)].map(|v| number(v, 2))
}

fn speed(found: Option<&FolderContent>) -> String {
    found.map_or_else(String::new, |f| format!("{:.2}x ({:.2}x)", f.speed, f.raster_speed))
}

pub(crate) fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(String::new, |v| format!("{v:.digits$}"))
}

pub(crate) fn table(out: &mut String, title: &str, head: &[&str], lines: Vec<Vec<String>>) {
    let _ = write!(out, "\n### {title}\n\n| {} |\n|---|{}\n", head.join(" | "), "---:|".repeat(head.len() - 1));
    for line in lines {
        let _ = writeln!(out, "| {} |", line.join(" | "));
    }
}

/// Curves: their names behind `e03-` and the SVGs.
pub(crate) fn plots(findings: &Findings, grid: &Grid) -> Vec<(&'static str, String)> {
    type Get = fn(&Side) -> Option<f64>;
    let curve = |name: &str, get: Get, cells: &dyn Fn(usize) -> Vec<(f64, Cell)>, i: usize| {
        let point = |(x, cell): (f64, Cell)| Some((x, get(&findings.of(&cell)?.side)?));
        Series { name: name.into(), points: cells(i).into_iter().filter_map(point).collect() }
    };
    let shares = |i: usize| grid.shares.iter().map(|s| (100.0 * s, grid.share(*s)[i].clone())).collect::<Vec<_>>();
    let by_share = |get: Get| {
        ["pruned", "fine-tuned", "with filter"]
            .iter()
            .enumerate()
            .map(|(i, name)| curve(name, get, &shares, i))
            .collect()
    };
    let keys = |i: usize| grid.intervals.iter().map(|k| (*k as f64, grid.interval(*k)[i].clone())).collect::<Vec<_>>();
    let by_interval: Vec<Series> =
        ["filter", "fine-tuned"].iter().enumerate().map(|(i, name)| curve(name, |s| s.psnr, &keys, i)).collect();
    let all: [(&str, Vec<Series>, &str, &str); 3] = [
        ("prune", by_share(|s| s.psnr), "% removed", "dB"),
        ("prune-moving", by_share(|s| s.psnr_dynamic), "% removed", "dB, dynamic regions"),
        ("interval", by_interval, "frames between keys", "dB"),
    ];
    all.into_iter().filter_map(|(name, series, x, unit)| Some((name, chart::file(&series, x, unit)?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_and_curves_skip_missing_cells() {
        let grid = Grid::full(1000);
        let empty = Findings { name: "knight".into(), ..Findings::default() };
        let page = markdown(&empty, &grid);
        assert!(page.starts_with("## knight") && !page.contains("NaN"), "{page}");
        assert!(plots(&empty, &grid).is_empty());
        let found = |cell: &Cell| FolderContent {
            key: cell.key(),
            side: Side {
                gaussians: (150_000.0 * (1.0 - cell.prune)).round() as usize,
                psnr: Some(32.0 - 4.0 * cell.prune + if cell.steps > 0 { 0.5 } else { 0.0 }),
                psnr_dynamic: Some(27.0),
                ssim: Some(0.95),
                flicker: Some(1.2),
                ..Side::default()
            },
            speed: 1.0 + cell.prune,
            ..FolderContent::default()
        };
        let full = Findings { cells: grid.cells().iter().map(found).collect(), ..empty };
        let page = markdown(&full, &grid);
        for text in
            ["150,000", "| 80 % | 30,000 | 28.80 | 27.00 | 29.30 | 27.00 | 3.20 |", "share alone", "1.80x", "| 4 |"]
        {
            assert!(page.contains(text), "{text} is missing in {page}");
        }
        // Every table is a table: a line has as many cells as its head.
        for part in page.split("\n### ").skip(1) {
            let counts: Vec<usize> =
                part.lines().filter(|l| l.starts_with('|')).map(|l| l.matches('|').count()).collect();
            assert!(counts.len() > 2 && counts.windows(2).all(|w| w[0] == w[1]), "{part}");
        }
        assert!(!page.contains("|  |"), "no cell is empty: {page}");
        let plots = plots(&full, &grid);
        assert_eq!(plots.iter().map(|p| p.0).collect::<Vec<_>>(), ["prune", "prune-moving", "interval"]);
        assert!(plots.iter().all(|(_, svg)| svg.starts_with("<svg ") && !svg.contains("NaN")));
        assert!(plots[0].1.contains("with filter"));
    }
}
