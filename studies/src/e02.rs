//! `studies e02`: what the temporal filter and the transport regularisers change, part by part.

mod cells;
mod flow;
mod page;

use cells::{Variant, variants};
use flow::{FlowError, Truth, truths};
use serde::{Deserialize, Serialize};
use serde_json::json;
use splat4d::{Error, ErrorKind, Result};
use splat4d_cli::console::Console;
use splat4d_cli::interrupt;
use splat4d_train::capture::{Capture, ImageStore};
use splat4d_train::eval::run::{EvalOptions, assess};
use splat4d_train::event::Event;
use splat4d_train::output::OutputFolder;
use splat4d_train::recipe::Recipe;
use splat4d_train::run::open_capture;
use splat4d_train::run::{self, TrainOptions, checkpoint};
use splat4d_workflow::draw::antialias;
use splat4d_workflow::files::{self, human_seconds};
use splat4d_workflow::run_folder::Run;
use splat4d_workflow::source::read_scene;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Steps of a run by default: on two cores the bundled capture takes about two minutes at half resolution.
const STEPS: usize = 1500;
/// The same with `--quick`.
const QUICK_STEPS: usize = 300;
/// Runs of every variant, from seed 1 on.
const SEEDS: usize = 3;
/// Factor by which images are reduced by default.
const DOWNSCALE: usize = 2;
/// The form of the file; another is refused.
const VERSION: u32 = 1;

const EXAMPLES: &str = "\
Examples:
  studies e02 examples/knight                        ten variants, three seeds each
  studies e02 examples/knight --quick                a glance: five variants, one seed, few steps
  studies e02 my-take --motion spacetime -o studies/filter --set transport_second=30

Every variant is trained from the same recipe and measured on the held-out views: the filter on and off, predicting in
Euclidean or in Wasserstein geometry, with and without log and exp, Kalman's own formulas, the linear and the W2 regulariser,
and both. Flow is measured where the capture has truth/flow. What was found is in DIR/e02.json (after every run: the same
command continues), DIR/e02.md and DIR/e02.svg. With --json every run is a line.";

/// Measure the temporal filter and the transport regularisers
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The capture: a folder, or its marker file
    #[arg(value_name = "CAPTURE")]
    capture: PathBuf,
    /// Folder for what is found
    #[arg(short, long, value_name = "DIR", default_value = "runs/e02")]
    output: PathBuf,
    /// The motion that is filtered
    #[arg(long, value_name = "MODEL", default_value = "hexplane")]
    motion: String,
    /// Steps of every run [default: 1500; 300 with --quick]
    #[arg(long, value_name = "STEPS")]
    iterations: Option<usize>,
    /// Runs of every variant, each with its own seed [default: 3; 1 with --quick]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100))]
    seeds: Option<u32>,
    /// Reduce images by k
    #[arg(long, value_name = "K", default_value_t = DOWNSCALE)]
    downscale: usize,
    /// Set a setting of the recipe; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Fewer variants, steps and seeds
    #[arg(long)]
    quick: bool,
}

/// All that was found.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Study {
    version: u32,
    steps: usize,
    seeds: usize,
    cells: Vec<FolderContent>,
}

/// One measured run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct FolderContent {
    key: String,
    seed: u64,
    /// Its recipe and capture, hexadecimal: runs of another recipe do not count.
    print: String,
    psnr: Option<f64>,
    psnr_dynamic: Option<f64>,
    ssim: Option<f64>,
    flicker: Option<f64>,
    flow: Option<FlowError>,
    gaussians: usize,
    minutes: f64,
}

impl Study {
    fn open(path: &Path) -> Result<Self> {
        if !path.is_file() {
            return Ok(Self { version: VERSION, ..Self::default() });
        }
        let refuse = |what: String| {
            Error::input(what).at(path.display()).remedy("Move it away, or choose another folder with -o.")
        };
        let study: Self = serde_json::from_str(&files::read_text(path)?)
            .map_err(|e| refuse(format!("it is no study as splat4d writes it: {e}")))?;
        if study.version != VERSION {
            return Err(refuse(format!("it is a study of version {}, not {VERSION}", study.version)));
        }
        Ok(study)
    }

    fn save(&self, path: &Path) -> Result<()> {
        files::write(path, serde_json::to_string_pretty(self).expect("a study is plain data").as_bytes())
    }

    fn of(&self, variant: &Variant) -> Vec<&FolderContent> {
        self.cells.iter().filter(|f| f.key == variant.key).collect()
    }
}

/// One run that is to be made.
struct Order {
    variant: Variant,
    recipe: Recipe,
    print: String,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let variants = variants(args.quick);
    let orders = orders(args, &variants)?;
    let capture = Arc::new(open_capture(&args.capture, &orders[0].recipe)?);
    if capture.held.is_empty() {
        return Err(Error::input("holds out no view, so that nothing can be measured")
            .at(args.capture.display())
            .remedy("Add --set hold_out=camera=0.")
            .into());
    }
    let truths = truths(&capture);
    let file = args.output.join("e02.json");
    let mut study = Study::open(&file)?;
    files::make_folder(&args.output)?;
    let wanted = |f: &FolderContent| orders.iter().any(|o| o.variant.key == f.key && o.print == f.print);
    study.cells.retain(wanted);
    (study.steps, study.seeds) = (orders[0].recipe.run.iterations, orders.len() / variants.len());
    let stop = interrupt::flag("stopping: finished runs are kept, this one continues next time");
    let missing: Vec<&Order> =
        orders.iter().filter(|o| !study.cells.iter().any(|f| f.print == o.print && f.key == o.variant.key)).collect();
    let started = Instant::now();
    for (i, order) in missing.iter().enumerate() {
        let left = match i {
            0 => String::new(),
            _ => {
                let each = started.elapsed().as_secs_f64() / i as f64;
                format!(", about {} left", human_seconds(each * (missing.len() - i) as f64))
            }
        };
        let number = orders.len() - missing.len() + i + 1;
        let (name, seed) = (order.variant.name, order.recipe.run.seed);
        console.clear();
        console.note(&format!("{number}/{}: {name}, seed {seed}{left}", orders.len()));
        let folder = args.output.join("work").join(format!("{}-{seed}-{}", order.variant.key, order.print));
        let Some(found) = judge(order, &capture, &truths, &folder, &stop, console)? else {
            return Err(Error::new(ErrorKind::Interrupted, "the study is unfinished; finished runs are kept")
                .at(args.output.display())
                .remedy("Run the same command again to continue.")
                .into());
        };
        console.emit(&json!({"type": "cell", "cell": found}));
        study.cells.push(found);
        study.save(&file)?;
        // A remaining folder costs only disk space.
        let _ = std::fs::remove_dir_all(&folder);
    }
    console.clear();
    let _ = std::fs::remove_dir(args.output.join("work"));
    study.save(&file)?;
    report_findings(&study, &variants, args, console)
}

/// Every run of the study: variants one after the other within a seed, so that a stopped study has compared something.
fn orders(args: &Args, variants: &[Variant]) -> Result<Vec<Order>> {
    let mut base = Recipe::default().with(|r| r.capture.downscale = args.downscale);
    base.set(&format!("motion={}", toml::Value::String(args.motion.clone())))?;
    base.run.iterations = args.iterations.unwrap_or(if args.quick { QUICK_STEPS } else { STEPS });
    for assignment in &args.set {
        base.set(assignment).map_err(|e| e.at("--set"))?;
    }
    base.check()?;
    let seeds = args.seeds.unwrap_or(if args.quick { 1 } else { SEEDS as u32 });
    let mut all = Vec::new();
    for seed in 1..=u64::from(seeds) {
        for variant in variants {
            let recipe = variant.recipe(&base, seed)?;
            let print = files::fingerprint(format!("{}\n{}", args.capture.display(), recipe.flat_toml()));
            all.push(Order { variant: *variant, recipe, print });
        }
    }
    Ok(all)
}

/// Trains and measures; None where it was stopped.
fn judge(
    order: &Order,
    capture: &Arc<Capture>,
    truths: &[Truth],
    folder: &Path,
    stop: &AtomicBool,
    console: &Console,
) -> anyhow::Result<Option<FolderContent>> {
    files::make_folder(folder)?;
    let owned = OutputFolder::amend(folder, "e02")?;
    // The run has been announced: that it begins and ends is no news.
    let mut listen = |event: &Event| {
        if !matches!(event, Event::Started { .. } | Event::Finished { .. }) {
            console.event(event);
        }
    };
    let outcome = if checkpoint::list(folder).is_empty() {
        owned.clear_inner("")?;
        let recipe = order.recipe.clone();
        run::train(capture.clone(), recipe, folder, &TrainOptions::default(), stop, &mut listen)?
    } else {
        run::resume_with(folder, &TrainOptions::default(), stop, &mut listen)?
    };
    if outcome.interrupted || stop.load(Ordering::SeqCst) {
        return Ok(None);
    }
    let scene = read_scene(&Run::open(folder)?.scene_file()?)?;
    let recipe = &order.recipe;
    let store =
        Arc::new(ImageStore::new(capture.clone(), usize::try_from(recipe.run.image_memory).unwrap_or(usize::MAX)));
    let options = EvalOptions {
        antialias: recipe.appearance.antialias,
        pictures: false,
        train_views: 0,
        ..EvalOptions::default()
    };
    let scores = assess(&scene, capture, &store, outcome.iteration, &options, stop, &mut listen)?;
    let flow = flow::error(&scene, capture, truths, antialias(recipe.appearance.antialias))?;
    let [psnr, psnr_dynamic, ssim, flicker] = ["PSNR", "PSNR-dynamic", "SSIM", "flicker"].map(|name| scores.held(name));
    Ok(Some(FolderContent {
        key: order.variant.key.into(),
        seed: recipe.run.seed,
        print: order.print.clone(),
        psnr,
        psnr_dynamic,
        ssim,
        flicker,
        flow,
        gaussians: outcome.gaussians,
        minutes: outcome.seconds / 60.0,
    }))
}

/// The table and the curve.
fn report_findings(study: &Study, variants: &[Variant], args: &Args, console: &Console) -> anyhow::Result<()> {
    let mut text = page::markdown(study, variants, &args.motion);
    if let Some(svg) = page::plot(study, variants) {
        files::write(&args.output.join("e02.svg"), svg.as_bytes())?;
        text += "\n![against the motion alone](e02.svg)\n";
    }
    let file = args.output.join("e02.md");
    files::write(&file, text.as_bytes())?;
    console.print_line(text.trim_end());
    console.written(&file);
    console.emit(&json!({"type": "done", "study": args.output.join("e02.json")}));
    Ok(())
}
