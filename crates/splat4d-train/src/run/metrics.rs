//! metrics.csv and the times of a step's parts.

use super::checkpoint::{RunState, write_atomically};
use crate::Result;
use crate::step::trainer::{Measured, Stepped, Trainer};
use std::path::Path;

/// Rows of metrics.csv in a whole run, about.
const METRIC_ROWS: usize = 600;

/// Seconds by stage of the chain, over the whole session.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Totals {
    pub(super) seconds: [f64; 8],
    pub(super) steps: usize,
}

/// Names of the columns that [`Totals`] holds.
pub(super) const STAGE_NAMES: [&str; 8] =
    ["motion", "render", "loss", "render_backward", "motion_backward", "adam", "load", "other"];

impl Totals {
    fn of(s: &Stepped) -> [f64; 8] {
        let t = &s.report.timings;
        [t.motion, t.render, t.loss, t.render_backward, t.motion_backward, s.adam, s.load, s.other]
            .map(|d| d.as_secs_f64())
    }

    pub(super) fn add(&mut self, s: &Stepped) {
        self.steps += 1;
        for (sum, x) in self.seconds.iter_mut().zip(Self::of(s)) {
            *sum += x;
        }
    }
}

/// A row of metrics.csv: the planned values of a step at its start, and all once it was measured.
struct Row {
    iteration: usize,
    begun: Option<[Vec<String>; 2]>,
    cells: Vec<String>,
}

/// metrics.csv: kept in memory, written whole at every checkpoint, so that it never runs ahead of one.
pub(super) struct Metrics {
    rows: Vec<Row>,
    every: usize,
}

impl Metrics {
    const HEADER: [&'static str; 8] = ["iteration", "stage", "loss", "l1", "ssim", "psnr", "gaussians", "seconds"];

    pub(super) fn open(run: &Path, iteration: usize, iterations: usize) -> Self {
        let text = crate::files::read_text(&run.join("metrics.csv")).unwrap_or_default();
        Self { rows: rows(&text, iteration), every: (iterations / METRIC_ROWS).max(1) }
    }

    /// After a step; its measurements may arrive later.
    pub(super) fn push(&mut self, trainer: &Trainer<'_>, s: &Stepped, state: &RunState) {
        let i = trainer.progress.iteration;
        if !i.is_multiple_of(self.every) && !trainer.is_done() {
            return;
        }
        let ms = Totals::of(s).map(|t| format!("{:.3}", t * 1e3));
        let after = [trainer.scene().len().to_string(), format!("{:.2}", state.seconds)].into_iter().chain(ms);
        let begun = [vec![i.to_string(), trainer.stage_name().to_owned()], after.collect()];
        self.rows.push(Row { iteration: i, begun: Some(begun), cells: Vec::new() });
    }

    /// Measurements of a step.
    pub(super) fn measured(&mut self, m: &Measured) {
        if let Some(row) = self.rows.iter_mut().rev().find(|row| row.iteration == m.iteration)
            && let Some([before, after]) = row.begun.take()
        {
            let scores = [m.loss, m.l1, m.ssim].map(|x| format!("{x:.6}"));
            row.cells = before.into_iter().chain(scores).chain([format!("{:.4}", psnr(m.mse))]).chain(after).collect();
        }
    }

    /// Forgets the rows after an iteration.
    pub(super) fn rewind(&mut self, iteration: usize) {
        self.rows.retain(|row| row.iteration <= iteration);
    }

    pub(super) fn write(&self, run: &Path) -> Result<()> {
        let times = STAGE_NAMES.iter().map(|name| format!("{name}_ms"));
        let header: Vec<String> = Self::HEADER.iter().map(|&name| name.to_owned()).chain(times).collect();
        let measured = self.rows.iter().map(|row| &row.cells).filter(|cells| !cells.is_empty());
        write_atomically(&run.join("metrics.csv"), &table(std::iter::once(&header).chain(measured)))
    }
}

/// Rows as CSV (RFC 4180, lines end in a line feed).
fn table<'a>(rows: impl Iterator<Item = &'a Vec<String>>) -> Vec<u8> {
    let mut out = csv::WriterBuilder::new().flexible(true).from_writer(Vec::new());
    rows.for_each(|row| out.write_record(row).expect("memory takes every row"));
    out.into_inner().expect("memory takes every row")
}

/// The rows of a table up to an iteration.
fn rows(text: &str, iteration: usize) -> Vec<Row> {
    let records = csv::ReaderBuilder::new().flexible(true).from_reader(text.as_bytes()).into_records();
    let row = |record: csv::StringRecord| {
        let iteration = record.get(0)?.parse().ok()?;
        Some(Row { iteration, begun: None, cells: record.iter().map(str::to_owned).collect() })
    };
    records.filter_map(|record| row(record.ok()?)).filter(|row| row.iteration <= iteration).collect()
}

pub(super) fn psnr(mse: f64) -> f64 {
    -10.0 * mse.max(1e-10).log10()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_with_a_comma_stays_one_cell() {
        let row = |cells: &[&str]| cells.iter().map(|&c| c.to_owned()).collect::<Vec<_>>();
        let written =
            [row(&["iteration", "stage", "loss"]), row(&["1", "deform-mlp, still", "0.5"]), row(&["2", "a\"b", "0.4"])];
        let text = String::from_utf8(table(written.iter())).unwrap();
        assert_eq!(text, "iteration,stage,loss\n1,\"deform-mlp, still\",0.5\n2,\"a\"\"b\",0.4\n");
        let read = rows(&text, 1);
        assert_eq!((read.len(), &read[0].cells), (1, &written[1]));
    }
}
