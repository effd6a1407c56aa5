//! `predict/report.html`: every model next to its baselines, by horizon, and films of truth and prediction.

use super::chart::{Series, escape, lines};
use super::{STYLE, panels, pictures};
use crate::files::{self, human_seconds};
use serde::Serialize;
use splat4d::Result;
use splat4d_dynamics::score::Calibration;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// The content of `predict.json`.
#[derive(Debug, Serialize)]
pub struct Summary {
    #[serde(serialize_with = "splat4d_train::path_text::lossy")]
    pub run: PathBuf,
    /// The last observed second.
    pub until: f64,
    pub fps: f64,
    pub observed_frames: usize,
    pub horizon: usize,
    /// Frames of the horizon that there are images of.
    pub pictured: usize,
    pub views: usize,
    pub nodes: usize,
    pub moving_gaussians: usize,
    /// The scene's size, scene units.
    pub size: f64,
    pub actions: Vec<String>,
    pub seeds: u64,
    pub models: Vec<ModelScores>,
    pub oracle: Option<ModelScores>,
    pub assimilated: Option<ModelScores>,
    /// The model whose scene was written.
    pub scene: &'static str,
}

/// The model that every other is compared with: the last observed frame stays.
const BASELINE: &str = "freeze";

/// Scores of a model's forecast; numbers by horizon begin with the first predicted frame.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ModelScores {
    pub name: String,
    /// dB, mean over all views.
    pub psnr: Option<f64>,
    /// dB where pixels differ from the last observed image; fixed cameras.
    pub psnr_dynamic: Option<f64>,
    pub psnr_by_horizon: Vec<Option<f64>>,
    pub psnr_dynamic_by_horizon: Vec<Option<f64>>,
    /// 1 − mean squared error over that of the baseline, dynamic regions (everywhere, for cameras that move).
    pub skill_over_freeze: Option<f64>,
    pub skill_over_velocity: Option<f64>,
    /// Share of the views that are nearer to the truth than the baseline's.
    pub win_over_freeze: Option<f64>,
    pub win_over_velocity: Option<f64>,
    /// Mean distance of nodes from those of the oracle, scene units, by horizon.
    pub node_error: Option<Vec<f64>>,
    /// Mean distance of known points from where they truly were, scene units, by horizon.
    pub track_error: Option<Vec<f64>>,
    /// Mean node error of forecasts of a fifth of the observed part, from three times of it, scene units.
    pub backtest: Option<f64>,
    /// The first frame at which it left the scene.
    pub diverged: Option<usize>,
    pub calibration: Option<Calibration>,
    pub seconds_fit: f64,
    pub seconds_rollout: f64,
}

/// Writes the page and returns its path. `films`: camera and file.
pub fn write(folder: &Path, run: &str, summary: &Summary, films: &[(String, PathBuf)]) -> Result<PathBuf> {
    let path = folder.join("report.html");
    files::write(&path, page(run, summary, films).as_bytes())?;
    Ok(path)
}

fn page(run: &str, summary: &Summary, films: &[(String, PathBuf)]) -> String {
    let mut body = String::new();
    let words = format!(
        "{} frames observed, {} predicted, {} of them with images · {} nodes on {} moving Gaussians · the exported \
         scene uses {}",
        summary.observed_frames,
        summary.horizon,
        summary.pictured,
        summary.nodes,
        files::grouped(summary.moving_gaussians),
        summary.scene
    );
    let _ = writeln!(body, "<header><h1>{}, predicted</h1><p>{}</p></header>", escape(run), escape(&words));
    if summary.pictured < summary.horizon {
        let beyond = summary.horizon - summary.pictured;
        let _ = writeln!(body, "<p class=\"note\">{beyond} predicted frames have no image to compare with.</p>");
    }
    let all: Vec<&ModelScores> = summary.models.iter().chain(&summary.assimilated).chain(&summary.oracle).collect();
    table(&mut body, &all, summary.models.len());
    let seconds = |i: usize| (i + 1) as f64 / summary.fps;
    let series = |of: &dyn Fn(&ModelScores) -> Vec<Option<f64>>| -> Vec<Series> {
        let one = |m: &&ModelScores| Series {
            name: m.name.clone(),
            points: of(m).into_iter().enumerate().filter_map(|(i, y)| Some((seconds(i), y?))).collect(),
        };
        all.iter().map(one).collect()
    };
    let curve = |of: &dyn Fn(&ModelScores) -> Vec<Option<f64>>, unit| lines(&series(of), "seconds ahead", unit);
    let errors = |e: &Option<Vec<f64>>| e.iter().flatten().map(|x| Some(*x)).collect::<Vec<_>>();
    panels(
        &mut body,
        "By forecast horizon",
        [
            ("PSNR of dynamic regions, dB", curve(&|m| m.psnr_dynamic_by_horizon.clone(), "dB")),
            ("PSNR, dB", curve(&|m| m.psnr_by_horizon.clone(), "dB")),
            ("Error of tracked points, scene units", curve(&|m| errors(&m.track_error), "units")),
            ("Distance of nodes to the oracle's, scene units", curve(&|m| errors(&m.node_error), "units")),
        ],
    );
    if !films.is_empty() {
        body.push_str("<h2>Truth (left) and prediction</h2>\n<div class=\"grid2\">\n");
        for (camera, path) in films {
            if let Some(film) = pictures::film_file(path, "Truth (left) and prediction") {
                let _ = writeln!(body, "<figure>{film}<figcaption>camera {}</figcaption></figure>", escape(camera));
            }
        }
        body.push_str("</div>\n");
    }
    body.push_str(
        "<p class=\"note\">Dynamic regions: pixels that differ from the last observed image of the camera. Skill: 1 \
         minus the ratio of the mean squared error there to the baseline's; 0 means equal, below 0 means worse. \
         Wins: share of views nearer to the truth than the baseline's. Back-test: node error of forecasts from three \
         times of the observed part. It selects the model of the exported scene; later frames are not used.</p>\n",
    );
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\"><title>{} · splat4d</title>\n<style>\n{STYLE}</style></head>\
         \n<body><main>\n{body}</main></body></html>\n",
        escape(run)
    )
}

/// A number with that many decimals; zero has no sign.
pub fn rounded(x: f64, digits: usize) -> String {
    let text = format!("{x:.digits$}");
    match text.strip_prefix('-') {
        Some(plain) if plain.bytes().all(|b| matches!(b, b'0' | b'.')) => plain.to_owned(),
        _ => text,
    }
}

/// Columns without a value are left out; of the first `compared` rows the best is marked, and the baseline named.
fn table(out: &mut String, models: &[&ModelScores], compared: usize) {
    let heads = [
        "model",
        "PSNR, dB",
        "dynamic regions, dB",
        "skill over freeze",
        "skill over velocity",
        "wins over freeze",
        "wins over velocity",
        "back-test, units",
        "error of points, last frame, units",
        "error / predicted σ",
        "fitting time",
        "diverged",
    ];
    let score = |m: &ModelScores| m.psnr_dynamic.or(m.psnr);
    let scored = models.iter().take(compared).enumerate().filter_map(|(i, m)| Some((i, score(m)?)));
    let best = scored.max_by(|a, b| a.1.total_cmp(&b.1)).map(|b| b.0);
    let number = |x: Option<f64>, digits: usize| x.map_or_else(String::new, |x| rounded(x, digits));
    let percent = |x: Option<f64>| x.map_or_else(String::new, |x| format!("{:.0} %", 100.0 * x));
    let cells = |(i, m): (usize, &&ModelScores)| {
        let role = if Some(i) == best { " · best" } else { "" };
        let baseline = if m.name == BASELINE { " · baseline" } else { "" };
        [
            format!("{}{baseline}{role}", m.name),
            number(m.psnr, 2),
            number(m.psnr_dynamic, 2),
            number(m.skill_over_freeze, 3),
            number(m.skill_over_velocity, 3),
            percent(m.win_over_freeze),
            percent(m.win_over_velocity),
            number(m.backtest, 4),
            number(m.track_error.as_ref().and_then(|e| e.last().copied()), 4),
            number(m.calibration.map(|c| c.ratio), 2),
            human_seconds(m.seconds_fit),
            m.diverged.map_or_else(String::new, |h| format!("at frame {h}")),
        ]
    };
    let rows: Vec<[String; 12]> = models.iter().enumerate().map(cells).collect();
    let filled: Vec<usize> = (0..heads.len()).filter(|&k| rows.iter().any(|r| !r[k].is_empty())).collect();
    let head: String = filled.iter().map(|&k| format!("<th>{}</th>", heads[k])).collect();
    let line = |(i, row): (usize, &[String; 12])| {
        let class = if Some(i) == best { " class=\"best\"" } else { "" };
        let cells: String = filled.iter().map(|&k| format!("<td>{}</td>", escape(&row[k]))).collect();
        format!("<tr{class}>{cells}</tr>")
    };
    let rows: String = rows.iter().enumerate().map(line).collect();
    let _ = writeln!(out, "<div class=\"panel\"><table class=\"numbers\"><tr>{head}</tr>{rows}</table></div>");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_round_to_zero_have_no_sign() {
        assert_eq!([rounded(-4e-4, 3), rounded(-6e-4, 3), rounded(0.0031, 3)], ["0.000", "-0.001", "0.003"]);
    }
}
