//! `studies e00`: what a deformation network learns, on points whose true motion is known.

use crate::deformation::{Findings, LAMBDAS, MANY_POINTS, Scene, Settings, run as study};
use serde_json::{Value, json};
use splat4d_cli::console::Console;
use splat4d_workflow::files;
use splat4d_workflow::report::chart::{self, Series};
use std::fmt::Write;
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  studies e00                     fifty points, three kinds of motion, a network of 4,546 numbers
  studies e00 --seeds 3 -o e00

Tables are printed and written to DIR/e00.md, curves to DIR/e00-*.svg, all numbers to DIR/e00.json.";

/// Learn synthetic motion with a small network, and see where that fails
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Folder for what is found
    #[arg(short, long, value_name = "DIR", default_value = "runs/e00")]
    output: PathBuf,
    /// Steps of Adam
    #[arg(long, value_name = "STEPS", default_value_t = Settings::default().steps)]
    steps: usize,
    /// Standard deviation of the noise on observed positions
    #[arg(long, value_name = "LENGTH", default_value_t = Settings::default().noise)]
    noise: f64,
    /// This many runs with different seeds
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let base = Settings { steps: args.steps, noise: args.noise, ..Settings::default() };
    let total = args.seeds as usize * (1 + LAMBDAS.len()) + 2;
    let mut done = 0;
    let mut go = |scene: Scene, s: &Settings| {
        console.phase("learning", done, total);
        done += 1;
        study(scene, s)
    };
    let seeds: Vec<Findings> =
        (0..args.seeds).map(|seed| go(Scene::Mixed, &Settings { seed, ..base.clone() })).collect();
    let sweep: Vec<(f64, Vec<Findings>)> = LAMBDAS
        .iter()
        .map(|&lambda_velocity| {
            let of = |seed| Settings { lambda_velocity, seed, ..base.clone() };
            (lambda_velocity, (0..args.seeds).map(|seed| go(Scene::Mixed, &of(seed))).collect())
        })
        .collect();
    let dense = Settings { points: MANY_POINTS, ..base.clone() };
    let limits = [Scene::Edge, Scene::Jump].map(|scene| (scene, go(scene, &dense)));
    console.clear();

    let page = markdown(&base, &seeds, &sweep, &limits);
    files::make_folder(&args.output)?;
    for (name, svg) in plots(&base, &seeds[0], &sweep) {
        files::write(&args.output.join(format!("e00-{name}.svg")), svg.as_bytes())?;
    }
    let numbers = json!({
        "seeds": seeds.iter().map(to_json).collect::<Vec<_>>(),
        "sweep": sweep.iter().map(|(l, f)| json!({"lambda": l, "jerk": over(f, |f| f.jerk), "mse": over(f, |f| f.mse)})).collect::<Vec<_>>(),
        "limits": limits.iter().map(|(s, f)| json!({"scene": format!("{s:?}"), "mse": f.parts})).collect::<Vec<_>>(),
    });
    files::write(&args.output.join("e00.json"), format!("{numbers:#}\n").as_bytes())?;
    let file = args.output.join("e00.md");
    files::write(&file, page.as_bytes())?;
    console.print_line(page.trim_end());
    console.written(&file);
    console.emit(&json!({"type": "done", "study": args.output.join("e00.json")}));
    Ok(())
}

fn to_json(f: &Findings) -> Value {
    json!({
        "parameters": f.parameters, "mse": f.mse, "jerk": f.jerk, "still_mse": f.still_mse,
        "moving_mse": f.moving_mse, "worst_improvement": f.worst(),
    })
}

/// Mean over the seeds.
fn over(found: &[Findings], of: impl Fn(&Findings) -> f64) -> f64 {
    found.iter().map(of).sum::<f64>() / found.len().max(1) as f64
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

fn markdown(s: &Settings, seeds: &[Findings], sweep: &[(f64, Vec<Findings>)], limits: &[(Scene, Findings)]) -> String {
    let mut out = format!(
        "# E00: a deformation network against standing still\n\n{} points (a third each: sinusoids, straight lines, \
         circles) at {} times, observed with noise of {}; a perceptron of {} numbers learns their displacement in {} steps \
         of Adam. Errors are against the truth without noise; standing still is every point's mean position.\n\n\
         | seed | standing still, MSE | network, MSE | better by | at the worst time | distance, better by | worst |\n\
         |---|---:|---:|---:|---:|---:|---:|\n",
        s.points, s.frames, s.noise, seeds[0].parameters, s.steps
    );
    for (seed, f) in seeds.iter().enumerate() {
        let nearer: Vec<f64> = f.distances[1].iter().zip(&f.distances[0]).map(|(a, b)| 1.0 - a / b).collect();
        let worst = nearer.iter().copied().fold(f64::INFINITY, f64::min);
        let _ = writeln!(
            out,
            "| {seed} | {:.5} | {:.5} | {:.0} % | {:.0} % | {:.0} % | {:.0} % |",
            mean(&f.still_mse),
            f.mse,
            100.0 * mean(&f.improvements()),
            100.0 * f.worst(),
            100.0 * mean(&nearer),
            100.0 * worst
        );
    }
    out += "\n## A penalty on speed\n\n| λ | jerk | MSE |\n|---:|---:|---:|\n";
    for (lambda, f) in sweep {
        let _ = writeln!(out, "| {lambda} | {:.5} | {:.5} |", over(f, |f| f.jerk), over(f, |f| f.mse));
    }
    out += "\nMeans over the seeds. A penalty on speed calms the network, and as long as it is small that may even help against noise; \
            a large one takes the motion for noise.\n\n\
            ## Where it fails\n\n| scene | MSE there | MSE elsewhere | times worse |\n|---|---:|---:|---:|\n";
    for (scene, f) in limits {
        let name = match scene {
            Scene::Edge => "edge of an occluder: neighbours move differently",
            Scene::Jump => "topology: points are elsewhere from t = ½ on",
            Scene::Mixed => "",
        };
        let [there, elsewhere] = f.parts.unwrap_or_default();
        let _ = writeln!(out, "| {name} | {there:.5} | {elsewhere:.5} | {:.1} |", there / elsewhere);
    }
    out += "\nA perceptron is a smooth function of place and time: where motion is not, it blurs. Lives (birth and death), \
            control nodes with coordinates of their own, or native 4D Gaussians are the remedies.\n";
    out
}

fn plots(s: &Settings, first: &Findings, sweep: &[(f64, Vec<Findings>)]) -> Vec<(&'static str, String)> {
    let over_time = |name: &str, values: &[f64]| Series {
        name: name.into(),
        points: values.iter().enumerate().map(|(n, v)| (n as f64 / (s.frames - 1) as f64, *v)).collect(),
    };
    let by_time = [over_time("standing still", &first.distances[0]), over_time("network", &first.distances[1])];
    // Zero has no logarithm: it is a decade left of the smallest.
    let place = |l: f64| if l > 0.0 { l.log10() } else { LAMBDAS[1].log10() - 1.0 };
    let curve = |name: &str, of: &dyn Fn(&Findings) -> f64| Series {
        name: name.into(),
        points: sweep.iter().map(|(l, f)| (place(*l), over(f, of))).collect(),
    };
    let tradeoff = [curve("jerk", &|f| f.jerk), curve("root of MSE", &|f| f.mse.sqrt())];
    let all = [
        ("time", chart::file(&by_time, "time", "mean distance")),
        ("penalty", chart::file(&tradeoff, "log10 λ (left: 0)", "length")),
    ];
    let mut out: Vec<_> = all.into_iter().filter_map(|(name, svg)| Some((name, svg?))).collect();
    out.push(("clouds", clouds(&first.paths)));
    out
}

/// Both clouds in one image: true paths as lines that end in circles, the network's as dots at every time.
fn clouds([truth, found]: &[Vec<Vec<[f64; 2]>>; 2]) -> String {
    const SIDE: f64 = 640.0;
    let far = truth.iter().chain(found).flatten().flatten().fold(0.0f64, |far, x| far.max(x.abs()));
    let place = |x: [f64; 2]| [0.5 * SIDE * (1.0 + 0.96 * x[0] / far), 0.5 * SIDE * (1.0 - 0.96 * x[1] / far)];
    let mut svg = format!(
        r#"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIDE} {SIDE}" width="{SIDE}" height="{SIDE}"><rect width="{SIDE}" height="{SIDE}" fill="white"/>"#
    );
    for path in truth {
        let points: Vec<String> = path.iter().map(|x| place(*x)).map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
        let _ = write!(svg, r##"<polyline points="{}" fill="none" stroke="#8a8a8a"/>"##, points.join(" "));
        if let Some([x, y]) = path.last().map(|x| place(*x)) {
            let _ = write!(svg, r##"<circle cx="{x:.1}" cy="{y:.1}" r="4" fill="none" stroke="#333333"/>"##);
        }
    }
    for [x, y] in found.iter().flatten().map(|x| place(*x)) {
        let _ = write!(svg, r##"<circle cx="{x:.1}" cy="{y:.1}" r="1.6" fill="#c0392b"/>"##);
    }
    svg + "<title>grey: true paths, circles at their ends; red: the network at every time</title></svg>\n"
}
