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

/// A row of metrics.csv: what is known of a step when it was begun, and the whole once it was measured.
struct Row {
    iteration: usize,
    begun: Option<[String; 2]>,
    text: String,
}

/// metrics.csv: kept in memory, written whole at every checkpoint, so that it never runs ahead of one.
pub(super) struct Metrics {
    rows: Vec<Row>,
    every: usize,
}

impl Metrics {
    const HEADER: &'static str = "iteration,stage,loss,l1,ssim,psnr,gaussians,seconds,motion_ms,render_ms,loss_ms,\
        render_backward_ms,motion_backward_ms,adam_ms,load_ms,other_ms";

    pub(super) fn open(run: &Path, iteration: usize, iterations: usize) -> Self {
        let text = crate::files::read_text(&run.join("metrics.csv")).unwrap_or_default();
        let row = |line: &str| {
            Some(Row { iteration: line.split(',').next()?.parse().ok()?, begun: None, text: line.to_owned() })
        };
        let rows = text.lines().skip(1).filter_map(row).filter(|row| row.iteration <= iteration).collect();
        Self { rows, every: (iterations / METRIC_ROWS).max(1) }
    }

    /// After a step; whatever it measured may come later.
    pub(super) fn push(&mut self, trainer: &Trainer<'_>, s: &Stepped, state: &RunState) {
        let i = trainer.progress.iteration;
        if !i.is_multiple_of(self.every) && !trainer.is_done() {
            return;
        }
        let ms: Vec<String> = Totals::of(s).iter().map(|t| format!("{:.3}", t * 1e3)).collect();
        let after = format!("{},{:.2},{}", trainer.scene().len(), state.seconds, ms.join(","));
        let begun = [format!("{i},{}", trainer.stage_name()), after];
        self.rows.push(Row { iteration: i, begun: Some(begun), text: String::new() });
    }

    /// What a step measured.
    pub(super) fn measured(&mut self, m: &Measured) {
        if let Some(row) = self.rows.iter_mut().rev().find(|row| row.iteration == m.iteration)
            && let Some([before, after]) = row.begun.take()
        {
            row.text = format!("{before},{:.6},{:.6},{:.6},{:.4},{after}", m.loss, m.l1, m.ssim, psnr(m.mse));
        }
    }

    /// Forgets the rows after an iteration.
    pub(super) fn rewind(&mut self, iteration: usize) {
        self.rows.retain(|row| row.iteration <= iteration);
    }

    pub(super) fn write(&self, run: &Path) -> Result<()> {
        let mut text = Self::HEADER.to_owned() + "\n";
        for row in &self.rows {
            text += &row.text;
            text.push('\n');
        }
        write_atomically(&run.join("metrics.csv"), text.as_bytes())
    }
}

pub(super) fn psnr(mse: f64) -> f64 {
    -10.0 * mse.max(1e-10).log10()
}
