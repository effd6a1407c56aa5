//! `studies replay`: a finished capture is recorded again, frame by frame, while `train --follow` trains it; the result
//! is compared with a training of the whole capture.

use splat4d::{Error, ErrorKind, Result};
use splat4d_cli::console::Console;
use splat4d_cli::interrupt;
use splat4d_train::recipe::{MotionName, Recipe};
use splat4d_train::run::open_capture;
use splat4d_workflow::evaluating::{Measure, evaluate};
use splat4d_workflow::files;
use splat4d_workflow::run_folder::Run;
use splat4d_workflow::training::{Finish, TrainingOptions, train};
use splat4d_workflow::{following, playable};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// The file that ends a capture (docs/follow.md).
const END_MARKER: &str = "capture.end";
/// Time between two looks whether the study was stopped.
const GLANCE: Duration = Duration::from_millis(50);

const EXAMPLES: &str = "Examples:
  studies replay examples/knight --downscale 2              as fast as frames are trained
  studies replay examples/knight --downscale 2 --every 5    a frame every five seconds
  studies replay examples/knight --set follow.frame_steps=400 -o runs/replay-400 --offline runs/replay/offline

DIR/capture is the capture as it is recorded again, DIR/online and DIR/offline are the runs. The table is printed and
written to DIR/replay.md.";

/// Record a capture again while it is trained, and compare with a training of the whole
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// A capture with capture.json and fixed cameras
    #[arg(value_name = "CAPTURE")]
    capture: PathBuf,
    /// Folder for the copy, the runs and the table; it must be new
    #[arg(short, long, value_name = "DIR", default_value = "runs/replay")]
    output: PathBuf,
    /// Seconds between two frames; 0: all at once
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0)]
    every: f64,
    /// Frames to record [default: all]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Reduce images by k
    #[arg(long, value_name = "K", default_value_t = 1)]
    downscale: usize,
    /// Change a setting, repeatable
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Compare with this run and train none
    #[arg(long, value_name = "RUN")]
    offline: Option<PathBuf>,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let stop = interrupt::flag("stopping: what is trained is kept");
    let mut recipe = Recipe::default().with(|r| {
        r.run.motion = MotionName::AUTO;
        r.capture.downscale = args.downscale;
        r.capture.max_frames = args.frames.unwrap_or(0);
    });
    args.set.iter().try_for_each(|set| recipe.set(set))?;
    let [folder, online, offline] = ["capture", "online", "offline"].map(|name| args.output.join(name));
    let recording = Recording::begin(&args.capture, &recipe, &folder)?;
    let ended = AtomicBool::new(false);
    let stopped = || ended.load(Ordering::Relaxed) || stop.load(Ordering::Relaxed);
    let followed = std::thread::scope(|scope| {
        let recorder = scope.spawn(|| recording.play(args.every, &stopped));
        let followed = following::follow(&folder, &recipe, &options(&online), &stop, console);
        ended.store(true, Ordering::Relaxed);
        recorder.join().expect("the recorder does not panic").and(followed)
    })?;
    if followed.interrupted {
        return Err(Error::new(ErrorKind::Interrupted, "the study was stopped").into());
    }
    let measure = Measure::default();
    evaluate(&online, &measure, &stop, console)?;
    let offline = match &args.offline {
        Some(run) => run.clone(),
        None => {
            train(&args.capture, &recipe, &options(&offline), &stop, console)?;
            evaluate(&offline, &measure, &stop, console)?;
            offline
        }
    };
    let text = table(&online, &offline)?;
    files::write(&args.output.join("replay.md"), text.as_bytes())?;
    console.result(&text);
    Ok(())
}

fn options(run: &Path) -> TrainingOptions {
    TrainingOptions {
        output: Some(run.to_owned()),
        finish: Finish::Scene,
        command: "replay",
        ..TrainingOptions::default()
    }
}

/// A capture that is recorded again.
struct Recording {
    /// By frame, from and to.
    frames: BTreeMap<usize, Vec<(PathBuf, PathBuf)>>,
    to: PathBuf,
}

impl Recording {
    /// Copies all but the frames' files.
    fn begin(from: &Path, recipe: &Recipe, to: &Path) -> Result<Self> {
        if to.exists() {
            return Err(Error::input("the copy of the capture exists")
                .at(to.display())
                .remedy("Give a new folder with -o"));
        }
        let capture = open_capture(from, recipe)?;
        let copied = |path: &Path| path.strip_prefix(&capture.root).map(|inside| to.join(inside)).ok();
        let mut frames: BTreeMap<usize, Vec<(PathBuf, PathBuf)>> = BTreeMap::new();
        for &i in capture.train.iter().chain(&capture.held) {
            let frame = &capture.frames[i];
            let files = [Some(&frame.image), frame.mask.as_ref(), frame.depth.as_ref().map(|d| &d.path)];
            for path in files.into_iter().flatten() {
                let place = copied(path).ok_or_else(|| {
                    Error::input("the file is outside the capture's folder").at(path.display()).remedy("Copy it there")
                })?;
                frames.entry(frame.index).or_default().push((path.clone(), place));
            }
        }
        let names = std::fs::read_dir(&capture.root).map_err(|e| files::cannot_read(&capture.root, e))?;
        for path in names.flatten().map(|entry| entry.path()).filter(|path| path.is_file()) {
            copy(&path, &copied(&path).expect("it is in the folder"))?;
        }
        Ok(Self { frames, to: to.to_owned() })
    }

    /// Copies a frame every `every` seconds, then states the end.
    fn play(&self, every: f64, stopped: &dyn Fn() -> bool) -> Result<()> {
        for files in self.frames.values() {
            files.iter().try_for_each(|(from, to)| copy(from, to))?;
            let glances = (every / GLANCE.as_secs_f64()) as usize;
            for _ in 0..glances {
                if stopped() {
                    return Ok(());
                }
                std::thread::sleep(GLANCE);
            }
        }
        files::write(&self.to.join(END_MARKER), b"\n")
    }
}

/// Copies a file as a recorder writes one: slowly enough to be seen half written.
fn copy(from: &Path, to: &Path) -> Result<()> {
    files::make_folder(to.parent().expect("a file is in a folder"))?;
    std::fs::copy(from, to).map(drop).map_err(|e| files::cannot_write(to, e))
}

/// Scores of held-out views by their time.
fn by_time(run: &Run) -> BTreeMap<u64, Vec<f64>> {
    let mut out: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
    for view in &run.views {
        if let (Some(time), Some(psnr)) = (view.time, view.psnr) {
            out.entry((1e6 * time).round() as u64).or_default().push(psnr);
        }
    }
    out
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// Frame by frame and in all: seconds, bytes, and PSNR of both runs on held-out views.
fn table(online: &Path, offline: &Path) -> Result<String> {
    let (ours, theirs) = (by_time(&Run::open(online)?), by_time(&Run::open(offline)?));
    let lines = files::read_text(&online.join(following::TABLE))?;
    let mut out = String::from(
        "| frame | seconds | Gaussians changed | bytes | online, dB | offline, dB | difference, dB |\n\
         |---:|---:|---:|---:|---:|---:|---:|\n",
    );
    let (mut seconds, mut bytes, mut both) = (Vec::new(), Vec::new(), Vec::new());
    for line in lines.lines().skip(1) {
        let cells: Vec<&str> = line.split(',').collect();
        let number = |i: usize| cells.get(i).and_then(|c| c.parse::<f64>().ok());
        let time = number(1).map_or(0, |t| (1e6 * t).round() as u64);
        let [a, b] = [&ours, &theirs].map(|all| all.get(&time).map(|v| mean(v)));
        if number(0).is_some_and(|n| n > 0.0) {
            seconds.extend(number(2));
        }
        bytes.extend(number(6));
        both.extend(a.zip(b));
        let db = |x: Option<f64>| x.map_or_else(String::new, |x| format!("{x:.2}"));
        let difference = a.zip(b).map(|(a, b)| a - b);
        let cell = |i: usize| cells.get(i).copied().unwrap_or_default();
        let _ = writeln!(
            out,
            "| {} | {} | {} | {} | {} | {} | {} |",
            cell(0),
            cell(2),
            cell(3),
            cell(6),
            db(a),
            db(b),
            db(difference)
        );
    }
    let (ours, theirs): (Vec<f64>, Vec<f64>) = both.into_iter().unzip();
    let size = std::fs::metadata(playable::of_run(online)).map_or(0, |m| m.len());
    let _ = write!(
        out,
        "\nAfter the first frame {:.2} s per frame (at most {:.2} s), {:.0} bytes per frame in the growing file, {} in the \
         finished one. Online {:.2} dB, offline {:.2} dB, difference {:.2} dB.\n",
        mean(&seconds),
        seconds.iter().copied().fold(0.0, f64::max),
        mean(&bytes),
        files::human_bytes(size),
        mean(&ours),
        mean(&theirs),
        mean(&ours) - mean(&theirs)
    );
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_repeats_the_files_of_a_capture() {
        let out = tempfile::tempdir().unwrap();
        let to = out.path().join("copy");
        let mut recipe = Recipe::default();
        recipe.set("max_frames=2").unwrap();
        let recording = Recording::begin("../examples/knight".as_ref(), &recipe, &to).unwrap();
        assert_eq!(recording.frames.keys().copied().collect::<Vec<_>>(), [0, 1]);
        assert!(to.join("capture.json").is_file() && to.join("points.ply").is_file());
        assert!(!to.join("images").exists());
        recording.play(0.0, &|| false).unwrap();
        assert!(to.join("images/cam00/0001.jpg").is_file() && to.join(END_MARKER).is_file());
        assert!(!to.join("images/cam00/0002.jpg").exists());
        assert!(Recording::begin("../examples/knight".as_ref(), &recipe, &to).is_err());
    }
}
