//! `best`: a page of the best figure of every capture and motion model, next to published ones, from `studies/best.toml`.

use anyhow::{Context, Result};
use serde::Deserialize;
use splat4d_cli::console::Console;
use splat4d_workflow::files;
use std::fmt::Write;
use std::path::PathBuf;

const FIGURES: &str = include_str!("../best.toml");

const EXAMPLES: &str = "\
Examples:
  studies best                     print the page
  studies best -o docs/best.md     write it, after a change of studies/best.toml";

const HEAD: &str = "\
# Best figures

The best measurement of every capture and motion model, with its command and machine, next to published figures. This page is written by
`studies best` from [studies/best.toml](../studies/best.toml); each figure is in the record that its date links to. How a version compares with the
last one on all captures, at equal steps: [the suite](suite.md).

*Moving*: PSNR of dynamic regions; empty where held-out cameras move or nothing does ([metrics](metrics.md)).
";

/// Write the page of best figures
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Markdown file [default: the terminal]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Figures {
    capture: Vec<Capture>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Capture {
    name: String,
    what: String,
    #[serde(default)]
    published: Vec<Published>,
    /// None: it was never measured.
    #[serde(default)]
    result: Vec<Measured>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Published {
    /// One, or a range.
    psnr: String,
    method: String,
    source: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Measured {
    model: String,
    psnr: f64,
    moving: Option<f64>,
    ssim: Option<f64>,
    command: String,
    time: Option<String>,
    date: String,
    machine: String,
    /// A file of studies/records.
    record: String,
}

pub(crate) fn run(args: &Args, console: &Console) -> Result<()> {
    let figures: Figures = toml::from_str(FIGURES).context("studies/best.toml")?;
    let page = page(&figures);
    match &args.output {
        Some(file) => files::write(file, page.as_bytes())?,
        None => console.result(page.trim_end()),
    }
    Ok(())
}

fn page(figures: &Figures) -> String {
    let mut out = HEAD.to_owned();
    let (measured, not): (Vec<_>, Vec<_>) = figures.capture.iter().partition(|c| !c.result.is_empty());
    for capture in measured {
        let _ = write!(out, "\n## {}\n\n{}.\n\n", capture.name, sentence(&capture.what));
        out += "| model | PSNR | moving | SSIM | command | time | date | machine |\n|---|---:|---:|---:|---|---|---|---|\n";
        let mut rows: Vec<&Measured> = capture.result.iter().collect();
        rows.sort_by(|a, b| b.psnr.total_cmp(&a.psnr));
        for r in rows {
            let number = |x: Option<f64>, digits| x.map_or(String::new(), |x| format!("{x:.digits$}"));
            let _ = writeln!(
                out,
                "| `{}` | {:.2} | {} | {} | {} | {} | [{}](../studies/records/{}) | {} |",
                r.model,
                r.psnr,
                number(r.moving, 2),
                number(r.ssim, 4),
                command(&r.command),
                r.time.as_deref().unwrap_or_default(),
                r.date,
                r.record,
                r.machine,
            );
        }
        published(&mut out, &capture.published);
    }
    out += "\n## Never measured\n";
    for capture in not {
        let _ = write!(out, "\n**{}**: {}.\n", capture.name, capture.what);
        published(&mut out, &capture.published);
    }
    out
}

/// Published figures, if there are any.
fn published(out: &mut String, published: &[Published]) {
    if !published.is_empty() {
        *out += "\nPublished:\n\n";
    }
    for p in published {
        let _ = writeln!(out, "- {} dB: {} ({})", p.psnr, p.method, p.source);
    }
}

/// What is typed, as code; words that follow it, not.
fn command(text: &str) -> String {
    let end = text.find([',', ':']).unwrap_or(text.len());
    format!("`{}`{}", &text[..end], &text[end..])
}

fn sentence(text: &str) -> String {
    let mut chars = text.chars();
    chars.next().map_or(String::new(), |first| first.to_uppercase().chain(chars).collect())
}
