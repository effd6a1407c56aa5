//! Results of the suite, as a Markdown table.

use super::FolderContent;
use splat4d_workflow::files::grouped;
use std::fmt::Write;

/// The table: a line a cell, then their mean.
pub(crate) fn table(cells: &[FolderContent]) -> String {
    let mut out = String::from(
        "| capture | motion | PSNR | corrected | moving | still | training | fall | Gaussians | steps | seconds | file |\n\
         |---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n",
    );
    for cell in cells {
        let _ = match &cell.refused {
            Some(why) => writeln!(out, "| {} | {} |{}", cell.capture, why.replace('|', "/"), " |".repeat(10)),
            None => writeln!(
                out,
                "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {:.0} | {} |",
                cell.capture,
                cell.motion,
                number(cell.psnr),
                number(cell.psnr_cc),
                number(cell.psnr_dynamic),
                number(cell.psnr_still),
                number(cell.psnr_train),
                cell.fall.map_or_else(String::new, |f| match f.db {
                    db if db < 0.005 => "0".into(),
                    db => format!("{db:.2} at {}", grouped(f.to)),
                }),
                grouped(cell.gaussians),
                grouped(cell.steps),
                cell.seconds,
                number(cell.playback_psnr)
            ),
        };
    }
    let mean = |of: &dyn Fn(&FolderContent) -> Option<f64>| {
        let all: Vec<f64> = cells.iter().filter_map(of).collect();
        number((!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64))
    };
    let seconds: f64 = cells.iter().map(|c| c.seconds).sum();
    let _ = writeln!(
        out,
        "| *mean* | | {} | {} | {} | {} | {} | | | | {seconds:.0} in all | {} |",
        mean(&|c| c.psnr),
        mean(&|c| c.psnr_cc),
        mean(&|c| c.psnr_dynamic),
        mean(&|c| c.psnr_still),
        mean(&|c| c.psnr_train),
        mean(&|c| c.playback_psnr)
    );
    out
}

/// Differences to earlier results: a line for each cell that both have.
pub(crate) fn differences(cells: &[FolderContent], earlier: &[FolderContent]) -> String {
    let mut out = String::from(
        "| capture | steps | PSNR | before | difference | moving | difference | fall | before |\n\
         |---|---:|---:|---:|---:|---:|---:|---:|---:|\n",
    );
    let mut all = Vec::new();
    for cell in cells {
        let Some(old) = earlier.iter().find(|o| o.capture == cell.capture && o.steps == cell.steps) else { continue };
        let change = |new: Option<f64>, old: Option<f64>| new.zip(old).map(|(a, b)| a - b);
        let signed = |d: Option<f64>| d.map_or_else(String::new, |d| format!("{d:+.2}"));
        let total = change(cell.psnr, old.psnr);
        all.extend(total);
        let _ = writeln!(
            out,
            "| {} | {} | {} | {} | {} | {} | {} | {} | {} |",
            cell.capture,
            grouped(cell.steps),
            number(cell.psnr),
            number(old.psnr),
            signed(total),
            number(cell.psnr_dynamic),
            signed(change(cell.psnr_dynamic, old.psnr_dynamic)),
            number(cell.fall.map(|f| f.db)),
            number(old.fall.map(|f| f.db))
        );
    }
    if !all.is_empty() {
        let mean = all.iter().sum::<f64>() / all.len() as f64;
        let worst = all.iter().copied().fold(f64::INFINITY, f64::min);
        let _ = writeln!(out, "\nPSNR: {mean:+.2} dB in the mean, {worst:+.2} dB where it changes for the worst.");
    }
    out
}

fn number(value: Option<f64>) -> String {
    value.map_or_else(String::new, |v| format!("{v:.2}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_has_as_many_cells_as_its_head() {
        let cell = FolderContent { capture: "knight".into(), steps: 10, psnr: Some(30.0), ..FolderContent::default() };
        let refused = FolderContent { refused: Some("no | poses".into()), ..cell.clone() };
        let better = FolderContent { psnr: Some(30.5), ..cell.clone() };
        let pages = [table(&[cell.clone(), refused]), differences(std::slice::from_ref(&better), &[cell])];
        for page in &pages {
            let counts: Vec<usize> =
                page.lines().filter(|l| l.starts_with('|')).map(|l| l.matches('|').count()).collect();
            assert!(counts.len() >= 3 && counts.windows(2).all(|w| w[0] == w[1]), "{page}");
        }
        assert!(pages[1].contains("| +0.50 |") && pages[1].contains("+0.50 dB in the mean"), "{}", pages[1]);
        let other = FolderContent { steps: 40, ..better.clone() };
        assert!(!differences(&[better], &[other]).contains("knight"), "runs of other lengths do not compare");
    }
}
