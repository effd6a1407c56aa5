//! `studies suite`: the recipe on captures of every kind, before and after a change.

mod list;
mod page;
mod rule;

use anyhow::Context;
use list::{Entry, List, Tier};
use rule::{Fall, MORE, Probe, broken, largest_fall};
use serde::{Deserialize, Serialize};
use serde_json::json;
use splat4d::{Error, ErrorKind, Result};
use splat4d_cli::console::Console;
use splat4d_cli::interrupt;
use splat4d_train::capture::{Capture, ImageStore};
use splat4d_train::eval::run::{EvalOptions, Scores, assess};
use splat4d_train::event::Event;
use splat4d_train::output::OutputFolder;
use splat4d_train::recipe::Recipe;
use splat4d_train::run::{self, TrainOptions, checkpoint, open_capture, with_found};
use splat4d_workflow::evaluating;
use splat4d_workflow::files::{self, human_seconds};
use splat4d_workflow::run_folder::Run;
use splat4d_workflow::source::read_scene;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// The form of the file; another is refused.
const VERSION: u32 = 1;
/// Training views are examined so often in a run.
const PROBES: usize = 20;
/// Training views that are examined, the same every time.
const PROBE_VIEWS: usize = 6;

const EXAMPLES: &str = "\
Examples:
  studies suite --data sets                      every capture of the list that is there
  studies suite --data sets --only mutant,knight
  studies suite --data sets -o runs/after --baseline runs/suite/results.json
  studies suite --data sets --rule               do four times the steps cost anything?
  studies suite --data sets -o runs/mcmc --set strategy=mcmc

Steps are fixed (studies/suite.toml), so that results of machines with more or less to do compare. What was found is in
DIR/results.json (after every capture: the same command continues) and DIR/suite.md, runs are in
DIR/runs. A cell is measured again when the program, its recipe or its capture's place has changed.";

/// Train the recipe on a list of captures, each in this many steps, and compare
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Folder with data sets in folders; may be repeated
    #[arg(long, value_name = "FOLDER")]
    data: Vec<PathBuf>,
    /// Folder for what is found
    #[arg(short, long, value_name = "DIR", default_value = "runs/suite")]
    output: PathBuf,
    /// Size of images and number of steps
    #[arg(long, value_enum, default_value = "quick")]
    tier: Tier,
    /// Only these captures [default: all of the list]
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    only: Vec<String>,
    /// A list of captures [default: studies/suite.toml as it was when the program was built]
    #[arg(long, value_name = "FILE")]
    list: Option<PathBuf>,
    /// Set a setting of every recipe; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Train each for four times the steps too, and report where that costs quality
    #[arg(long)]
    rule: bool,
    /// Bake playback files and compare them with their models, as the full tier does
    #[arg(long)]
    playback: bool,
    /// Results of an earlier suite to compare with
    #[arg(long, value_name = "FILE")]
    baseline: Option<PathBuf>,
}

/// Result of one capture after this many steps. Values are dB unless named otherwise.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
struct FolderContent {
    capture: String,
    steps: usize,
    /// Of the program, the recipe and the capture's place.
    print: String,
    /// Why there are not finite.
    refused: Option<String>,
    motion: String,
    /// Held-out views: whole images, dynamic regions, and (from these two and the dynamic share) static ones.
    psnr: Option<f64>,
    /// Whole images after each camera's colour matrix.
    psnr_cc: Option<f64>,
    psnr_dynamic: Option<f64>,
    psnr_still: Option<f64>,
    ssim: Option<f64>,
    flicker: Option<f64>,
    psnr_train: Option<f64>,
    /// Training views during the run.
    probes: Vec<Probe>,
    fall: Option<Fall>,
    gaussians: usize,
    /// Of training, without the evaluations during the run.
    seconds: f64,
    /// The playback file against its model.
    playback_psnr: Option<f64>,
}

/// All cells.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Results {
    version: u32,
    cells: Vec<FolderContent>,
}

impl Results {
    /// Errors: a file that is none of ours, or of another version.
    fn read(path: &Path) -> Result<Self> {
        let refuse = |what: String| Error::input(what).at(path.display()).remedy("Move it away, or name another file.");
        let results: Self = serde_json::from_str(&files::read_text(path)?)
            .map_err(|e| refuse(format!("it holds no results of a suite: {e}")))?;
        if results.version != VERSION {
            return Err(refuse(format!("its version is {}, not {VERSION}", results.version)));
        }
        Ok(results)
    }

    fn save(&self, path: &Path) -> Result<()> {
        files::write(path, serde_json::to_string_pretty(self).expect("results are plain data").as_bytes())
    }
}

/// A cell that is to be measured.
struct Order<'a> {
    entry: &'a Entry,
    folder: PathBuf,
    recipe: Recipe,
    print: String,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    // Impossible settings are reported before any work.
    let list = List::open(args.list.as_deref())?;
    let entries = list.only(&args.only)?;
    let baseline = args.baseline.as_deref().map(Results::read).transpose()?;
    let file = args.output.join("results.json");
    let mut results =
        if file.is_file() { Results::read(&file)? } else { Results { version: VERSION, cells: Vec::new() } };
    files::make_folder(&args.output)?;
    let orders = orders(args, &list, &entries, console)?;
    let stop = interrupt::flag("stopping: finished cells are kept");
    let started = Instant::now();
    let mut cells = Vec::new();
    for (i, order) in orders.iter().enumerate() {
        let (name, steps) = (order.entry.name.as_str(), order.recipe.run.iterations);
        let known = results.cells.iter().find(|f| f.print == order.print && f.capture == name && f.steps == steps);
        let found = match known {
            Some(found) => found.clone(),
            None => {
                console.note(&format!("{name}, {steps} steps, {}/{}", i + 1, orders.len()));
                let found = measure(order, args, &stop, console)?;
                console.clear();
                results.cells.retain(|f| f.capture != name || f.steps != steps);
                results.cells.push(found.clone());
                results.save(&file)?;
                found
            }
        };
        console.emit(&json!({"type": "cell", "cell": found}));
        cells.push(found);
    }
    console.note(&format!("measured in {}", human_seconds(started.elapsed().as_secs_f64())));
    let mut text = page::table(&cells);
    if args.rule {
        text += &judged(&cells);
    }
    if let Some(baseline) = baseline {
        text += &format!("\n{}", page::differences(&cells, &baseline.cells));
    }
    let page = args.output.join("suite.md");
    files::write(&page, text.as_bytes())?;
    console.print_line(text.trim_end());
    console.written(&page);
    console.emit(&json!({"type": "done", "study": file}));
    Ok(())
}

/// Violations of the rule.
fn judged(cells: &[FolderContent]) -> String {
    let longer = |s: &FolderContent| cells.iter().find(|l| l.capture == s.capture && l.steps == s.steps * MORE);
    let broken: Vec<String> = cells.iter().filter_map(|s| longer(s).map(|l| broken(s, l))).flatten().collect();
    match broken[..] {
        [] => "\nThe rule holds everywhere.\n".into(),
        _ => format!("\nThe rule is broken:\n\n- {}\n", broken.join("\n- ")),
    }
}

/// Every cell of the captures that are there; of others it is reported that they are not.
fn orders<'a>(args: &Args, list: &List, entries: &[&'a Entry], console: &Console) -> anyhow::Result<Vec<Order<'a>>> {
    let own = std::env::current_exe().context("this program does not know where it lies")?;
    let program = files::fingerprint(std::fs::read(&own).map_err(|e| files::cannot_read(&own, e))?);
    let work = args.output.join("captures");
    let mut orders = Vec::new();
    for &entry in entries {
        let recipe = recipe(entry, list.steps(args.tier), args)?;
        let Some(folder) = entry.folder(&args.data, &work)? else {
            console.note(&format!("{}: not there, skipped", entry.name));
            continue;
        };
        for more in if args.rule { vec![1, MORE] } else { vec![1] } {
            let mut recipe = recipe.clone();
            recipe.run.iterations *= more;
            if recipe.run.checkpoint_interval == 0 {
                // Training views are evaluated at every checkpoint.
                recipe.run.checkpoint_interval = (recipe.run.iterations / PROBES).max(1);
            }
            let content = [program.as_str(), &folder.display().to_string(), &recipe.flat_toml()].join("\n");
            orders.push(Order { entry, folder: folder.clone(), recipe, print: files::fingerprint(content) });
        }
    }
    Ok(orders)
}

/// The recipe of a capture: the default one, with settings of the list and the user.
fn recipe(entry: &Entry, steps: usize, args: &Args) -> Result<Recipe> {
    let mut recipe = Recipe::default();
    recipe.set("run.motion=auto")?;
    recipe.run.iterations = steps;
    recipe.capture.downscale = entry.downscale.at(args.tier);
    recipe.capture.hold_out = entry.hold_out.as_deref().map(str::parse).transpose()?;
    for assignment in &entry.set {
        recipe.set(assignment).map_err(|e| e.at(format!("capture {}", entry.name)))?;
    }
    for assignment in &args.set {
        recipe.set(assignment).map_err(|e| e.at("--set"))?;
    }
    recipe.check()?;
    Ok(recipe)
}

/// Trains and measures; a capture that refuses is a finding too. Errors: stopped; files that cannot be written.
fn measure(order: &Order<'_>, args: &Args, stop: &AtomicBool, console: &Console) -> anyhow::Result<FolderContent> {
    let steps = order.recipe.run.iterations;
    let blank = FolderContent {
        capture: order.entry.name.clone(),
        steps,
        print: order.print.clone(),
        ..FolderContent::default()
    };
    let run = args.output.join("runs").join(format!("{}-{steps}", order.entry.name));
    files::make_folder(&run)?;
    let folder = OutputFolder::amend(&run, "suite")?;
    folder.clear_inner("")?;
    let found = trained(order, &run, blank.clone(), stop, console);
    let interrupted = |e: &Error| e.kind() == ErrorKind::Interrupted;
    let mut found = match found {
        Err(error) if !interrupted(&error) => return Ok(FolderContent { refused: Some(error.to_string()), ..blank }),
        found => found.map_err(|e| e.at(args.output.display()).remedy("Run the same command again to continue."))?,
    };
    if args.playback || args.tier == Tier::Full {
        evaluating::playback(&run, console)?;
        found.playback_psnr = Run::open(&run)?.number("playback_psnr");
    }
    // The scene is kept for inspection; checkpoints are three times its size.
    checkpoint::list(&run).iter().try_for_each(std::fs::remove_file).map_err(|e| files::cannot_write(&run, e))?;
    Ok(found)
}

fn trained(
    order: &Order<'_>,
    run: &Path,
    blank: FolderContent,
    stop: &AtomicBool,
    console: &Console,
) -> Result<FolderContent> {
    let capture = Arc::new(open_capture(&order.folder, &order.recipe)?);
    if capture.held.is_empty() {
        return Err(Error::input("it holds out no view, so that nothing can be measured")
            .remedy("Give it a hold_out in the list."));
    }
    let change = (order.recipe.run.half_size_until * order.recipe.run.iterations as f64) as usize;
    let (mut judges, mut probes, mut looking, mut trouble) = (None, Vec::new(), 0.0, None);
    let mut listen = |event: &Event| match event {
        Event::Checkpoint { iteration, path } if trouble.is_none() => {
            let clock = Instant::now();
            let look = |judges: &mut Option<Judges>| {
                let judges = Judges::of(judges, order, run)?;
                if *iteration <= change { &judges.coarse } else { &judges.whole }.training(path, *iteration)
            };
            match look(&mut judges) {
                Ok(psnr) => probes.extend(psnr.map(|psnr| Probe { step: *iteration, psnr })),
                Err(error) => trouble = Some(error),
            }
            looking += clock.elapsed().as_secs_f64();
        }
        Event::Phase { .. } | Event::Progress { .. } => console.event(event),
        _ => {}
    };
    let options = TrainOptions::default();
    let outcome = run::train(capture.clone(), order.recipe.clone(), run, &options, stop, &mut listen)?;
    if let Some(error) = trouble {
        return Err(error);
    }
    if outcome.interrupted {
        return Err(Error::new(ErrorKind::Interrupted, "the suite is unfinished; finished cells are kept"));
    }
    let effective = Run::open(run)?.recipe()?;
    let judge = &Judges::of(&mut judges, order, run)?.whole;
    let scores = judge.scores(&run.join("scene.safetensors"), outcome.iteration, console)?;
    let [psnr, psnr_cc, psnr_dynamic, ssim, flicker] =
        ["PSNR", "PSNR-cc", "PSNR-dynamic", "SSIM", "flicker"].map(|name| scores.held(name));
    Ok(FolderContent {
        motion: effective.run.motion.as_str().into(),
        psnr,
        psnr_cc,
        psnr_dynamic,
        psnr_still: elsewhere(psnr, psnr_dynamic, scores.dynamic_share),
        ssim,
        flicker,
        psnr_train: scores.train("PSNR"),
        fall: largest_fall(&probes, change),
        probes,
        gaussians: outcome.gaussians,
        seconds: outcome.seconds - looking,
        ..blank
    })
}

/// PSNR where nothing moves, by the means of whole images and of dynamic regions.
fn elsewhere(whole: Option<f64>, moving: Option<f64>, share: Option<f64>) -> Option<f64> {
    let error = |psnr: f64| 10f64.powf(-0.1 * psnr);
    let (whole, moving, share) = (error(whole?), error(moving?), share?);
    let rest = (whole - share * moving) / (1.0 - share);
    (rest > 0.0 && rest.is_finite()).then(|| -10.0 * rest.log10())
}

/// The views that a run is measured on, opened after its start: points found in its images set the near plane of its
/// cameras see.
struct Judges {
    whole: Judge,
    /// The same at half the size. While images of half the size are trained on, they are the training views: at full
    /// size a scene that has never seen one gets worse and better at random.
    coarse: Judge,
}

impl Judges {
    fn of<'a>(judges: &'a mut Option<Self>, order: &Order<'_>, run: &Path) -> Result<&'a Self> {
        if judges.is_none() {
            let open = |recipe: Recipe| -> Result<Judge> {
                let capture = with_found(open_capture(&order.folder, &recipe)?, &recipe, run)?;
                Ok(Judge::new(&Arc::new(capture), &recipe))
            };
            let whole = open(order.recipe.clone())?;
            let coarse = open(order.recipe.clone().with(|r| r.capture.downscale *= 2))?;
            *judges = Some(Self { whole, coarse });
        }
        Ok(judges.as_ref().expect("they were just made"))
    }
}

/// A capture that scenes are measured on.
struct Judge {
    capture: Arc<Capture>,
    /// The same without held-out views.
    training: Capture,
    store: Arc<ImageStore>,
    antialias: bool,
}

impl Judge {
    fn new(capture: &Arc<Capture>, recipe: &Recipe) -> Self {
        let training = Capture { held: Vec::new(), ..(**capture).clone() };
        let memory = usize::try_from(recipe.run.image_memory).unwrap_or(usize::MAX);
        let store = Arc::new(ImageStore::new(capture.clone(), memory));
        Self { capture: capture.clone(), training, store, antialias: recipe.appearance.antialias }
    }

    fn options(&self) -> EvalOptions {
        EvalOptions { antialias: self.antialias, pictures: false, ..EvalOptions::default() }
    }

    /// PSNR of the same few training views every time.
    fn training(&self, scene: &Path, step: usize) -> Result<Option<f64>> {
        let (options, stop) = (EvalOptions { train_views: PROBE_VIEWS, ..self.options() }, AtomicBool::new(false));
        let scores = assess(&read_scene(scene)?, &self.training, &self.store, step, &options, &stop, &mut |_| {})?;
        Ok(scores.train("PSNR"))
    }

    fn scores(&self, scene: &Path, step: usize, console: &Console) -> Result<Scores> {
        let (stop, mut listen) = (AtomicBool::new(false), |event: &Event| console.event(event));
        assess(&read_scene(scene)?, &self.capture, &self.store, step, &self.options(), &stop, &mut listen)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn static_pixels_are_the_rest_of_the_dynamic_ones() {
        // Half the pixels are wrong by 0.1, the others by 0.01.
        let psnr = |mse: f64| -10.0 * mse.log10();
        let still = elsewhere(Some(psnr(0.5 * (0.01 + 0.0001))), Some(psnr(0.01)), Some(0.5)).unwrap();
        assert!((still - 40.0).abs() < 1e-9);
        assert_eq!(elsewhere(Some(30.0), None, Some(0.5)), None);
        assert_eq!(elsewhere(Some(30.0), Some(10.0), Some(0.5)), None, "means of dB need not add up");
    }

    #[test]
    fn results_are_read_back_and_foreign_files_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("results.json");
        let cell = FolderContent {
            capture: "a".into(),
            probes: vec![Probe { step: 5, psnr: 20.0 }],
            ..FolderContent::default()
        };
        Results { version: VERSION, cells: vec![cell.clone()] }.save(&file).unwrap();
        assert_eq!(Results::read(&file).unwrap().cells, [cell]);
        for text in ["", "{}", "{\"version\": 9, \"cells\": []}"] {
            std::fs::write(&file, text).unwrap();
            assert!(Results::read(&file).unwrap_err().to_string().contains("results.json"));
        }
    }
}
