//! `studies e03`: how much may be removed from a trained scene, by which score, and what the temporal filter costs.

use crate::cells::{Cell, Grid};
use crate::study::{FolderContent, Judged, Place, Study, fill};
use crate::tables;
use serde_json::json;
use splat4d::layers::Scene;
use splat4d::{Error, ErrorKind, Result};
use splat4d_cli::console::Console;
use splat4d_cli::interrupt;
use splat4d_train::capture::{Capture, ImageStore};
use splat4d_train::compress::{Job, compress};
use splat4d_train::eval::run::{EvalOptions, assess};
use splat4d_train::event::Event;
use splat4d_train::recipe::Recipe;
use splat4d_train::run::TrainOptions;
use splat4d_workflow::draw::antialias;
use splat4d_workflow::files::{self, human_seconds};
use splat4d_workflow::measure::{MeasuredView, SIZE, Side, Subject, What, in_turns, measured_views};
use splat4d_workflow::paths::parse_size;
use splat4d_workflow::run_folder::Run;
use splat4d_workflow::source::{not_empty, read_scene};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Share of the source's own training steps that fine-tuning takes by default: 4DGS-1K takes 5,000 after 30,000.
const STEPS_SHARE: f64 = 1.0 / 6.0;
/// The same with `--quick`.
const QUICK_SHARE: f64 = 1.0 / 30.0;
/// Width and height of the images that speed is measured on with `--quick`.
const QUICK_SIZE: [usize; 2] = [200, 200];

const EXAMPLES: &str = "Examples:
  studies e03 runs/knight                       all of it: about 45 cells, each a \
                        fine-tuning
  studies e03 runs/knight --quick               a glance: fewer points, shorter \
                        fine-tuning
  studies e03 runs/a runs/b -o studies/pruning  two scenes; every run has its own \
                        tables and images

Every cell prunes a share of the run's Gaussians and measures what is left \
                        on the held-out views, on the CPU and in
32-bit floats: shares from 0 to 95 %, the temporal \
                        filter, fine-tuning, the scores of 4DGS-1K, frames between key times,
rounds. What was found \
                        is in DIR/e03.json (after every cell: the same command continues), \
                        DIR/e03.md and
DIR/e03-*.svg. With --json every cell is a line.";

/// Measure pruning and the temporal filter of 4DGS-1K on trained runs
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Trained runs; their captures are opened again
    #[arg(value_name = "RUN", required = true)]
    runs: Vec<PathBuf>,
    /// Folder for what is found
    #[arg(short, long, value_name = "DIR", default_value = "runs/e03")]
    output: PathBuf,
    /// Fewer points, fine-tuned for a thirtieth of the run's steps
    #[arg(long)]
    quick: bool,
    /// Steps of fine-tuning [default: a sixth of the run's]
    #[arg(long, value_name = "STEPS")]
    fine_tune: Option<usize>,
    /// Image size at which playback is timed [default: 800x800, with --quick 200x200]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    size: Option<[usize; 2]>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    // Impossible settings are reported before any work.
    let trials = args.runs.iter().map(|path| Trial::open(path, args)).collect::<anyhow::Result<Vec<_>>>()?;
    check_names(&trials)?;
    let file = args.output.join("e03.json");
    let mut study = Study::open(&file)?;
    files::make_folder(&args.output)?;
    let stop = interrupt::flag("stopping: finished cells are kept");
    for trial in &trials {
        let grid = &trial.grid;
        let cells = grid.cells();
        // A retrained run must not continue from another scene's files.
        let work = args.output.join("work").join(format!("{}-{}", trial.name, trial.print));
        let others: Vec<_> = study.runs.iter().filter(|f| f.run != trial.path).cloned().collect();
        let progress = |cell: &Cell, Place { number, of, left }: Place| {
            console.clear();
            let left = left.map_or_else(String::new, |s| format!(", about {} left", human_seconds(s)));
            console.note(&format!("{} {number}/{of}: {}{left}", trial.name, cell.words()));
        };
        let keep = |findings: &crate::study::Findings, found: &FolderContent| {
            let whole = Study::of(others.iter().cloned().chain([findings.clone()]).collect());
            console.emit(&json!({"type": "cell", "run": trial.path, "cell": found}));
            whole.save(&file)
        };
        let mut make = |cell: &Cell| trial.judge(cell, &work, &stop, console);
        let findings = study.on(&trial.path, &trial.name, &trial.print);
        let all = fill(findings, &cells, &mut make, progress, keep)?;
        console.clear();
        if !all {
            return Err(Error::new(ErrorKind::Interrupted, "the study is unfinished; finished cells are kept")
                .at(args.output.display())
                .remedy("Run the same command again to continue.")
                .into());
        }
        let _ = std::fs::remove_dir_all(&work);
    }
    let _ = std::fs::remove_dir(args.output.join("work"));
    report_findings(&study, &trials, &args.output, console)
}

/// Tables and images of the runs that were requested.
fn report_findings(study: &Study, trials: &[Trial], folder: &Path, console: &Console) -> anyhow::Result<()> {
    let mut page = String::from("# Pruning and the temporal filter\n");
    for trial in trials {
        let Some(findings) = study.runs.iter().find(|f| f.run == trial.path) else { continue };
        page += &format!("\n{}", tables::markdown(findings, &trial.grid));
        for (plot, svg) in tables::plots(findings, &trial.grid) {
            let name = match trials.len() {
                1 => format!("e03-{plot}.svg"),
                _ => format!("e03-{plot}-{}.svg", trial.name),
            };
            page += &format!("\n![{plot}]({name})\n");
            files::write(&folder.join(name), svg.as_bytes())?;
        }
    }
    let file = folder.join("e03.md");
    files::write(&file, page.as_bytes())?;
    console.print_line(page.trim_end());
    console.written(&file);
    console.emit(&json!({"type": "done", "study": folder.join("e03.json")}));
    Ok(())
}

/// A run, opened for all of its cells.
struct Trial {
    path: PathBuf,
    name: String,
    /// Of the scene file.
    print: String,
    scene: Scene<f32>,
    capture: Arc<Capture>,
    recipe: Recipe,
    store: Arc<ImageStore>,
    measured_views: Vec<MeasuredView>,
    grid: Grid,
}

impl Trial {
    fn open(path: &Path, args: &Args) -> anyhow::Result<Self> {
        let run = Run::open(path)?;
        let file = run.scene_file()?;
        let bytes = std::fs::read(&file).map_err(|e| files::cannot_read(&file, e))?;
        let print = files::fingerprint(&bytes);
        drop(bytes);
        let scene = read_scene(&file)?;
        not_empty(&scene, path)?;
        let (capture, recipe) = run.open_capture()?;
        if capture.held.is_empty() {
            return Err(Error::input("holds out no view, so that nothing can be measured")
                .at(path.display())
                .remedy("Train with --hold-out.")
                .into());
        }
        let capture = Arc::new(capture);
        let store =
            Arc::new(ImageStore::new(capture.clone(), usize::try_from(recipe.run.image_memory).unwrap_or(usize::MAX)));
        let share = if args.quick { QUICK_SHARE } else { STEPS_SHARE };
        let own = run.iteration().unwrap_or(recipe.resolve().run.iterations);
        let steps = args.fine_tune.unwrap_or(((own as f64 * share) as usize).max(1));
        let size = args.size.unwrap_or(if args.quick { QUICK_SIZE } else { SIZE });
        let measured_views = measured_views(&run.views()?, scene.clip, size);
        let grid = if args.quick { Grid::quick(steps) } else { Grid::full(steps) };
        let folder = path.file_name().map_or_else(|| run.name(), |n| n.to_string_lossy().into_owned());
        Ok(Self {
            path: path.to_owned(),
            name: plain(&folder),
            print,
            scene,
            capture,
            recipe,
            store,
            measured_views,
            grid,
        })
    }

    /// Makes a cell's scene and measures it; None where it was stopped.
    fn judge(&self, cell: &Cell, work: &Path, stop: &AtomicBool, console: &Console) -> anyhow::Result<Option<Judged>> {
        let folder = work.join(cell.key());
        let made = if cell.is_source() { None } else { Some(self.make(cell, &folder, stop, console)?) };
        if stop.load(Ordering::SeqCst) {
            return Ok(None);
        }
        let scene = made.as_ref().unwrap_or(&self.scene);
        let options =
            EvalOptions { antialias: self.recipe.appearance.antialias, pictures: false, ..EvalOptions::default() };
        let mut listen = |event: &Event| console.event(event);
        let scores = assess(scene, &self.capture, &self.store, cell.steps, &options, stop, &mut listen)?;
        let antialias = antialias(self.recipe.appearance.antialias);
        let subjects = [&self.scene, scene].map(|s| Subject { what: What::Scene(s), antialias });
        let sides =
            in_turns(&subjects, &self.measured_views, &mut |done, total| console.phase("playing", done, total))?;
        // A remaining folder costs only disk space.
        let _ = std::fs::remove_dir_all(&folder);
        let [source, side] = <[Side; 2]>::try_from(sides).expect("two subjects give two sides");
        let [speed, raster_speed] = [side.fps / source.fps, side.raster_fps / source.raster_fps];
        Ok(Some(Judged { side: side.scored(&scores), speed, raster_speed }))
    }

    /// Compresses in floats; what a stopped cell has reached stays in its folder.
    fn make(&self, cell: &Cell, folder: &Path, stop: &AtomicBool, console: &Console) -> anyhow::Result<Scene<f32>> {
        files::make_folder(folder)?;
        let settings = cell.settings();
        let job = Job {
            source: &self.scene,
            capture: self.capture.clone(),
            recipe: &self.recipe,
            settings: &settings,
            run: None,
        };
        // The cell has been announced: that a run begins and ends is no news.
        let mut listen = |event: &Event| {
            if !matches!(event, Event::Started { .. } | Event::Finished { .. }) {
                console.event(event);
            }
        };
        let made = compress(&job, folder, &TrainOptions::default(), stop, &mut listen)?;
        if made.outcome.interrupted {
            stop.store(true, Ordering::SeqCst);
            return Ok(Scene::default());
        }
        let scene = read_scene(&folder.join("scene.safetensors"))?;
        let filtered = scene.layers.iter().any(|l| l.masks.is_some());
        assert!(filtered == (cell.interval > 0), "a cell with a filter has masks, another has none: {}", cell.key());
        Ok(scene)
    }
}

/// A name that every file system takes.
fn plain(name: &str) -> String {
    name.chars().map(|c| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '-' }).collect()
}

/// Refuses two runs whose results would have one name.
fn check_names(trials: &[Trial]) -> Result<()> {
    let mut seen = BTreeSet::new();
    match trials.iter().find(|b| !seen.insert(b.name.as_str())) {
        None => Ok(()),
        Some(twin) => Err(Error::input("has the name of another run here")
            .at(twin.path.display())
            .remedy("Study them one by one, each with a folder of its own (-o).")),
    }
}
