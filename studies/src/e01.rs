//! `studies e01`: scene flow lifted from optical flow: what it gains, how it drifts, and what helps.

use crate::lifting::{Findings, Settings, run as study};
use serde_json::{Value, json};
use splat4d_cli::console::Console;
use splat4d_workflow::files;
use splat4d_workflow::report::chart::{self, Series};
use std::fmt::Write;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  studies e01                     a sphere, a cube and a wall over 20 frames
  studies e01 -o e01 --noise 1

Tables are printed and written to DIR/e01.md, the drift to DIR/e01-drift.svg, all numbers to DIR/e01.json.";

/// Speeds of the sphere (units per frame) and of the cube (degrees a frame) that are compared; the first is the main
/// one.
const MOTIONS: [(f64, f64); 4] = [(0.08, 4.0), (0.1, 5.0), (0.05, 4.0), (0.1, 3.0)];

/// Follow lifted optical flow, and see how it drifts
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Folder for what is found
    #[arg(short, long, value_name = "DIR", default_value = "runs/e01")]
    output: PathBuf,
    /// Frames
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u64).range(3..=1000))]
    frames: u64,
    /// Standard deviation of the noise on flow, where there is noise, pixels
    #[arg(long, value_name = "PIXELS", default_value_t = 0.5)]
    noise: f64,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let of = |(speed, degrees): (f64, f64), noise: f64| {
        study(&Settings { frames: args.frames as usize, speed, degrees, noise, seed: 0 })
    };
    let clean = MOTIONS.map(|m| of(m, 0.0));
    let noisy = of(MOTIONS[0], args.noise);
    let page = markdown(args, &clean, &noisy);
    files::make_folder(&args.output)?;
    if let Some(svg) = plot(&clean[0], &noisy) {
        files::write(&args.output.join("e01-drift.svg"), svg.as_bytes())?;
    }
    let numbers = json!({"clean": clean.iter().map(to_json).collect::<Vec<_>>(), "noisy": to_json(&noisy)});
    files::write(&args.output.join("e01.json"), format!("{numbers:#}\n").as_bytes())?;
    let file = args.output.join("e01.md");
    files::write(&file, page.as_bytes())?;
    console.print_line(page.trim_end());
    console.written(&file);
    console.emit(&json!({"type": "done", "study": args.output.join("e01.json")}));
    Ok(())
}

fn to_json(f: &Findings) -> Value {
    json!({
        "still_mse": f.still_mse, "lifted_mse": f.lifted_mse, "ratio": f.ratio(), "both_depths_mse": f.both_depths_mse,
        "flow_lengths": f.flow_lengths, "fitted_mse": f.fitted_mse, "growth": f.growth, "drift": f.drift, "both_depths_drift": f.both_depths_drift,
        "fitted_drift": f.fitted_drift,
        "smoothing": f.smoothing.iter().map(|s| json!({
            "passes": s.passes, "step_rmse": s.step_rmse, "first_rmse": s.first_rmse, "last_mse": s.last_mse,
        })).collect::<Vec<_>>(),
    })
}

fn markdown(args: &Args, clean: &[Findings], noisy: &Findings) -> String {
    let last = args.frames - 1;
    let mut out = format!(
        "# E01: scene flow lifted from optical flow\n\nA sphere moves along x, a cube turns about y, a wall is static; \
         {} frames of exact flow. Lifted with the depth of one frame, motion along the viewing direction is missing; \
         positions are the sum of lifted flow. Errors are at frame {last}.\n\n\
         | sphere, units/frame | cube, °/frame | repeating frame 0, MSE | following flow, MSE | times better | \
         with both depths, MSE | slope of the drift |\n|---:|---:|---:|---:|---:|---:|---:|\n",
        args.frames
    );
    for ((speed, degrees), f) in MOTIONS.iter().zip(clean) {
        let _ = writeln!(
            out,
            "| {speed} | {degrees} | {:.4} | {:.5} | {:.1} | {:.1e} | {} |",
            f.still_mse,
            f.lifted_mse,
            f.ratio(),
            f.both_depths_mse,
            f.growth.map_or_else(String::new, |g| format!("{g:.2}"))
        );
    }
    let main = &clean[0];
    out += "\nA slope of 1 is a bias that adds up, ½ a random walk.\n\n## Drift\n\n| frame | exact flow, RMSE | \
            with noise | both depths, with noise | a curve a point, with noise |\n|---:|---:|---:|---:|---:|\n";
    for n in [1, 5, 10, 19].into_iter().filter(|n| *n <= last as usize) {
        let _ = writeln!(
            out,
            "| {n} | {:.4} | {:.4} | {:.4} | {:.4} |",
            main.drift[n], noisy.drift[n], noisy.both_depths_drift[n], noisy.fitted_drift[n]
        );
    }
    let [true_length, lifted] = clean[0].flow_lengths;
    let _ = writeln!(
        out,
        "\nTrue scene flow is {true_length:.4} units a frame long in the mean, lifted flow {lifted:.4}: what is missing is the \
         way along the viewing direction."
    );
    let _ = write!(
        out,
        "\nNoise of {} px a flow vector: following it is {:.1} times better than frame 0; with both depths what \
         remains is a random walk, {:.0} times better. A cubic curve a point, fitted to what every frame shows by \
         itself (as motion models are fitted to images), has no walk: {:.0} times better.\n\n## Smoothing\n\n| \
         passes of a moving average over 3 frames | error of one step's flow, RMSE | position after step 1, RMSE | \
         position at the end, MSE |\n|---:|---:|---:|---:|\n",
        args.noise,
        noisy.ratio(),
        noisy.still_mse / noisy.both_depths_mse,
        noisy.still_mse / noisy.fitted_mse
    );
    for s in &noisy.smoothing {
        let _ = writeln!(out, "| {} | {:.5} | {:.5} | {:.5} |", s.passes, s.step_rmse, s.first_rmse, s.last_mse);
    }
    out += "\nSmoothing calms single steps and leaves the end where it was: a sum does not care in which order its parts are \
            shared out. It is no remedy for drift.\n";
    out
}

fn plot(clean: &Findings, noisy: &Findings) -> Option<String> {
    let series = |name: &str, values: &[f64]| Series {
        name: name.into(),
        points: values.iter().enumerate().map(|(n, v)| (n as f64, *v)).collect(),
    };
    let all = [
        series("exact flow", &clean.drift),
        series("with noise", &noisy.drift),
        series("both depths", &noisy.both_depths_drift),
        series("fitted", &noisy.fitted_drift),
    ];
    chart::file(&all, "frame", "RMSE, units")
}
