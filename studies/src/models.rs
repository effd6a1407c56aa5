//! `studies models`: every motion model on the same captures, for the same minutes.

use anyhow::Context;
use serde::{Deserialize, Serialize};
use serde_json::json;
use splat4d::motion::MODELS;
use splat4d::{Error, ErrorKind};
use splat4d_cli::console::Console;
use splat4d_cli::interrupt;
use splat4d_workflow::draw::antialias;
use splat4d_workflow::files::{self, grouped, human_bytes, human_seconds};
use splat4d_workflow::measure::{SIZE, Side, Subject, What, in_turns, measured_views};
use splat4d_workflow::playable;
use splat4d_workflow::run_folder::Run;
use splat4d_workflow::source::read_scene;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Minutes of training a cell.
const MINUTES: f64 = 3.0;
/// How often a cell that trains is examined.
const GLANCE: Duration = Duration::from_millis(100);
/// Cost of a cell in addition to its minutes (probes, evaluation, baking, playing), minutes; for the time that is left.
const OVERHEAD: f64 = 0.6;

const EXAMPLES: &str = "Examples:
  studies models examples/knight                         every model for three \
                        minutes each
  studies models a-take b-take --only control,hexplane   some models on two \
                        captures
  studies models examples/knight --minutes 1 -o quick

Every cell is a run of its \
                        own (DIR/CAPTURE-MODEL), trained by `splat4d train` on images of half size, measured on \
                        the
held-out views and played on the CPU at 800x800. A run that is there is not trained \
                        again: the same command continues where
it was stopped. The table is printed and written to \
                        DIR/models.md, the numbers to DIR/models.json.";

/// Train every motion model on the same captures, and compare them
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Captures
    #[arg(value_name = "CAPTURE", required = true)]
    captures: Vec<PathBuf>,
    /// Folder for runs and tables
    #[arg(short, long, value_name = "DIR", default_value = "runs/models")]
    output: PathBuf,
    /// Only these models [default: all]
    #[arg(long, value_name = "MODEL,...", value_delimiter = ',')]
    only: Vec<String>,
    /// Minutes of training a cell
    #[arg(long, value_name = "M", default_value_t = MINUTES)]
    minutes: f64,
    /// Reduce images by k
    #[arg(long, value_name = "K", default_value_t = 2)]
    downscale: usize,
    /// Also replace what is between `<!-- models -->` and `<!-- /models -->` in this page
    #[arg(long, value_name = "FILE")]
    into: Option<PathBuf>,
    /// Set a setting of every cell's recipe; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// A model on a capture.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
struct Cell {
    capture: String,
    model: String,
    /// Why there are not finite.
    refused: Option<String>,
    side: Side,
    /// Size of the file that a player gets, bytes.
    playback_bytes: Option<u64>,
    /// Images a second of that file.
    file_fps: Option<f64>,
    steps: usize,
    ms_per_step: f64,
    peak_memory: Option<u64>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let models = models(&args.only)?;
    // A page that cannot take the table is found out before an hour of training.
    let page = args.into.as_ref().map(|p| files::read_text(p)).transpose()?;
    page.as_deref().map(parted).transpose()?;
    if !(args.minutes > 0.0 && args.minutes.is_finite()) {
        let what = format!("--minutes cannot be {}", args.minutes);
        return Err(Error::input(what).remedy("Give a positive number, for instance 3").into());
    }
    files::make_folder(&args.output)?;
    let stop = interrupt::flag("stopping: finished cells are kept");
    let jobs: Vec<(&PathBuf, &str)> = args.captures.iter().flat_map(|c| models.iter().map(move |m| (c, *m))).collect();
    let mut cells = Vec::new();
    for (i, (capture, model)) in jobs.iter().enumerate() {
        let name = capture.canonicalize().unwrap_or_else(|_| (*capture).clone());
        let name = name.file_name().map_or_else(|| "capture".into(), |n| n.to_string_lossy().into_owned());
        let left = human_seconds(60.0 * (args.minutes + OVERHEAD) * (jobs.len() - i) as f64);
        console.note(&format!("{name} by {model}, {}/{}: at most about {left} left", i + 1, jobs.len()));
        let folder = args.output.join(format!("{name}-{model}"));
        let refused = if Run::is_finished(&folder) { None } else { train(capture, model, &folder, args, &stop)? };
        if stop.load(Ordering::SeqCst) {
            return Err(Error::new(ErrorKind::Interrupted, "the comparison is unfinished; finished cells are kept")
                .at(args.output.display())
                .remedy("Run the same command again to continue.")
                .into());
        }
        let cell = match refused {
            Some(why) => Cell { capture: name, model: (*model).into(), refused: Some(why), ..Cell::default() },
            None => judge(&folder, &name, model, console)?,
        };
        console.emit(&json!({"type": "cell", "cell": cell}));
        cells.push(cell);
    }
    let numbers = serde_json::to_string_pretty(&cells).context("cells are plain numbers")?;
    files::write(&args.output.join("models.json"), format!("{numbers}\n").as_bytes())?;
    let file = args.output.join("models.md");
    let table = markdown(&cells, args);
    files::write(&file, table.as_bytes())?;
    if let (Some(path), Some(page)) = (&args.into, page) {
        let [before, after] = parted(&page)?;
        files::write(path, format!("{before}\n\n{}\n\n{after}", table.trim_end()).as_bytes())?;
        console.written(path);
    }
    console.print_line(table.trim_end());
    console.written(&file);
    console.emit(&json!({"type": "done", "study": args.output.join("models.json")}));
    Ok(())
}

/// Comments that mark the table's place in a page.
const MARKS: [&str; 2] = ["<!-- models -->", "<!-- /models -->"];

/// A page up to and with the first mark, and from the second on. Errors: it lacks one.
fn parted(page: &str) -> splat4d::Result<[&str; 2]> {
    let place = page.find(MARKS[0]).map(|i| i + MARKS[0].len());
    let parts = place.and_then(|from| Some([&page[..from], &page[from + page[from..].find(MARKS[1])?..]]));
    parts.ok_or_else(|| {
        Error::input(format!("the page has no `{}` and `{}`", MARKS[0], MARKS[1]))
            .remedy("Put both marks where the table belongs")
    })
}

/// The models that are requested, in the library's order.
fn models(only: &[String]) -> splat4d::Result<Vec<&'static str>> {
    let all = MODELS.iter().copied();
    if let Some(unknown) = only.iter().find(|m| !all.clone().any(|a| a == m.as_str())) {
        return Err(Error::input(format!("there is no motion model `{unknown}` that trains by itself"))
            .remedy(format!("Use some of: {}", all.collect::<Vec<_>>().join(", "))));
    }
    Ok(all.filter(|m| only.is_empty() || only.iter().any(|o| o == m)).collect())
}

/// Trains one cell in a process of its own, so that its peak of memory is its own; states why where it refuses.
fn train(capture: &Path, model: &str, folder: &Path, args: &Args, stop: &AtomicBool) -> anyhow::Result<Option<String>> {
    let own = std::env::current_exe().context("this program does not know where it lies")?;
    let log = args.output.join(format!("{}.log", folder.file_name().unwrap_or_default().to_string_lossy()));
    let output = std::fs::File::create(&log).map_err(|e| files::cannot_write(&log, e))?;
    let mut command = Command::new(own);
    command.arg("train").arg(capture).args(["--motion", model, "--minutes", &args.minutes.to_string()]);
    command.args(["--downscale", &args.downscale.to_string(), "--force", "-o"]).arg(folder);
    for setting in &args.set {
        command.args(["--set", setting]);
    }
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(output).spawn()?;
    let begun = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        // Ctrl-C reaches the child by itself: it saves a checkpoint and ends.
        if stop.load(Ordering::SeqCst) {
            child.wait()?;
            return Ok(None);
        }
        std::thread::sleep(GLANCE.min(begun.elapsed()));
    };
    if status.success() {
        return Ok(None);
    }
    let text = std::fs::read_to_string(&log).unwrap_or_default();
    let error = text.lines().find_map(|l| l.strip_prefix("error: ")).unwrap_or("it ended without a message");
    Ok(Some(error.to_owned()))
}

fn judge(folder: &Path, capture: &str, model: &str, console: &Console) -> anyhow::Result<Cell> {
    let run = Run::open(folder)?;
    let scene = read_scene(&run.scene_file()?)?;
    let antialias = antialias(run.recipe()?.appearance.antialias);
    let file = std::fs::read(playable::of_run(folder)).ok();
    let baked = file.map(|bytes| Subject { what: What::File(bytes.into()), antialias });
    let subjects: Vec<Subject<'_>> =
        std::iter::once(Subject { what: What::Scene(&scene), antialias }).chain(baked).collect();
    let measured_views = measured_views(&run.views()?, scene.clip, SIZE);
    let sides = in_turns(&subjects, &measured_views, &mut |done, total| console.phase("playing", done, total))?;
    let mut sides = sides.into_iter();
    let side = sides.next().expect("a side for every subject");
    let file_fps = sides.next().map(|file| file.fps);
    let steps = run.iteration().unwrap_or(0);
    Ok(Cell {
        capture: capture.into(),
        model: model.into(),
        refused: None,
        side: side.scored_by(&run),
        file_fps,
        playback_bytes: run.number("playback_bytes").map(|b| b as u64),
        steps,
        ms_per_step: run.number("seconds").unwrap_or(0.0) * 1e3 / steps.max(1) as f64,
        peak_memory: run.number("peak_memory").filter(|b| *b > 0.0).map(|b| b as u64),
    })
}

fn markdown(cells: &[Cell], args: &Args) -> String {
    let mut out = format!(
        "Trained for {} minutes a cell on images reduced by {}, on this machine's CPU. PSNR, SSIM and flicker (mean \
         difference between the change from frame to frame and the truth's, in 1/255) are means over the held-out \
         views, `moving` is PSNR of dynamic regions. `scene` is the learnt state in 32-bit floats, `file` the \
         playback file. Frames a second: the learnt state and the playback file, image by image alternately, end to end, 800x800.\n",
        args.minutes, args.downscale
    );
    let mut captures: Vec<&str> = Vec::new();
    for cell in cells.iter().filter(|c| !c.capture.is_empty()) {
        if !captures.contains(&cell.capture.as_str()) {
            captures.push(&cell.capture);
        }
    }
    for capture in captures {
        let _ = write!(
            out,
            "\n### {capture}\n\n| model | PSNR | SSIM | moving | flicker | Gaussians | scene | file | steps | ms/step | \
             frames/s | file, frames/s | memory |\n|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n"
        );
        for cell in cells.iter().filter(|c| c.capture == capture) {
            let _ = writeln!(out, "{}", line(cell));
        }
    }
    out
}

fn line(cell: &Cell) -> String {
    if let Some(why) = &cell.refused {
        return format!("| `{}` | {why} |{}", cell.model, " |".repeat(11));
    }
    let s = &cell.side;
    let number = |v: Option<f64>, digits: usize| v.map_or_else(String::new, |v| format!("{v:.digits$}"));
    let bytes = |b: Option<u64>| b.map_or_else(String::new, human_bytes);
    format!(
        "| `{}` | {} | {} | {} | {} | {} | {} | {} | {} | {:.1} | {:.1} | {} | {} |",
        cell.model,
        number(s.psnr, 2),
        number(s.ssim, 4),
        number(s.psnr_dynamic, 2),
        number(s.flicker, 2),
        grouped(s.gaussians),
        human_bytes(s.float_bytes),
        bytes(cell.playback_bytes),
        grouped(cell.steps),
        cell.ms_per_step,
        s.fps,
        number(cell.file_fps, 1),
        bytes(cell.peak_memory)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_model_is_selectable_and_unknown_ones_are_errors() {
        assert_eq!(models(&[]).unwrap(), MODELS);
        assert_eq!(models(&["still".into()]).unwrap(), ["still"]);
        assert!(models(&["stil".into()]).unwrap_err().to_string().contains("spacetime"));
    }

    #[test]
    fn a_table_replaces_the_text_between_its_marks() {
        let [before, after] = parted("a <!-- models -->old<!-- /models --> b").unwrap();
        assert_eq!((before, after), ("a <!-- models -->", "<!-- /models --> b"));
        assert!(parted("<!-- models --> only").is_err());
    }

    #[test]
    fn every_line_has_as_many_cells_as_the_head() {
        let args = Args {
            captures: vec!["a".into()],
            output: "o".into(),
            only: Vec::new(),
            minutes: 3.0,
            downscale: 2,
            into: None,
            set: Vec::new(),
        };
        let cell = Cell { capture: "a".into(), model: "still".into(), steps: 10, ..Cell::default() };
        let refused = Cell { refused: Some("one camera".into()), ..cell.clone() };
        let page = markdown(&[cell, refused], &args);
        let counts: Vec<usize> = page.lines().filter(|l| l.starts_with('|')).map(|l| l.matches('|').count()).collect();
        assert!(counts.len() == 4 && counts.windows(2).all(|w| w[0] == w[1]), "{page}");
    }
}
