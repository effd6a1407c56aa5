//! `import`: videos become a capture: frames, a common clock, poses and points.

use crate::console::Console;
use crate::interrupt;
use serde_json::json;
use splat4d::{Error, ErrorKind};
use splat4d_import::board::Board;
use splat4d_import::calibration;
use splat4d_import::corrections;
use splat4d_import::doctor::{Grade, Report as Looked};
use splat4d_import::recording::{self, CameraReport, Report, Request, Rig};
use splat4d_import::video::{Crop, Cropping, Selection};
use splat4d_import::write::Format;
use splat4d_train::event::Progress;
use splat4d_train::output::{Input, OutputFolder, check_apart, written};
use splat4d_train::recipe::Recipe;
use splat4d_train::run::open_capture;
use splat4d_workflow::report::doctor;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

/// The file by which a capture is recognised.
const CAPTURE: &str = "capture.json";
/// What an import writes into its folder, in addition to its corrections.
const WRITTEN: [&str; 5] = [CAPTURE, "points.ply", "images", "masks", "import"];

const EXAMPLES: &str = "\
Examples:
  splat4d import videos/ -o my-take                  all videos of a folder: fixed cameras
  splat4d import a.mp4 b.mp4 c.mp4 -o my-take --from 3.2 --to 9.8 --size 720
  splat4d import walk.mp4 -o walk --every 5          one moving camera, a static scene
  splat4d import videos/ -o my-take --apart left,right=2.4    lengths in metres
  splat4d import videos/ -o my-take --board 36h11:0.16:floor    an AprilTag of 16 cm on the floor
  splat4d import videos/ -o my-take --calibration Calib.toml    known poses; offsets and points are found

my-take/import.toml contains the result of every camera: correct an offset or a lens, or leave a camera out, and run \
the same command again. Then: splat4d train my-take. How to record: docs/filming.md.";

/// Pixels of the shorter side that images get: training on a CPU sees no more.
const SIZE: usize = 1080;
/// Findings of the doctor that are printed; its page has all.
const MOST: usize = 6;
/// Frames per second of folders of images.
const FPS: f64 = 30.0;

/// Make a capture from videos: frames, synchronization, poses, lenses and points
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Videos, folders of videos, or folders of images (one per camera)
    #[arg(value_name = "VIDEOS", required = true)]
    videos: Vec<PathBuf>,
    /// The capture's folder; interrupted work continues
    #[arg(short, long, value_name = "TAKE")]
    output: PathBuf,
    /// Fixed or moving cameras; auto: one video is a moving camera, several are fixed ones
    #[arg(long, value_name = "auto|fixed|moving", default_value = "auto", value_parser = ["auto", "fixed", "moving"])]
    rig: String,
    /// Do not use the videos' sound
    #[arg(long)]
    no_audio: bool,
    /// Use the files' timestamps: one trigger drives all cameras
    #[arg(long)]
    synchronous: bool,
    /// Keep every Nth frame
    #[arg(long, value_name = "N", default_value_t = 1)]
    every: usize,
    /// Start at this second of the first camera's video
    #[arg(long, value_name = "SECONDS")]
    from: Option<f64>,
    /// End before this second
    #[arg(long, value_name = "SECONDS")]
    to: Option<f64>,
    /// Largest number of pixels of the images' shorter side
    #[arg(long, value_name = "PIXELS", default_value_t = SIZE)]
    size: usize,
    /// Cut off black bars (auto), or keep this part of every image, in pixels of the videos; given poses and masks are for
    /// whole images
    #[arg(long, value_name = "auto|W:H:X:Y", value_parser = crop, conflicts_with_all = ["calibration", "masks"])]
    crop: Option<Cropping>,
    /// Frames per second of folders of images
    #[arg(long, value_name = "N", default_value_t = FPS)]
    fps: f64,
    /// Two cameras and their distance in metres
    #[arg(long, value_name = "A,B=METRES", value_parser = apart)]
    apart: Option<([String; 2], f64)>,
    /// Tags: family (36h11; 4x4, 5x5, 6x6 of ArUco and ChArUco), edge of a dark square in metres, and floor or wall if
    /// they define the up direction
    #[arg(long, value_name = "FAMILY:METRES[:floor|:wall]", conflicts_with_all = ["apart", "camera_height"])]
    board: Option<Board>,
    /// A camera and its height above the floor in metres
    #[arg(long, value_name = "NAME=METRES", value_parser = height, conflicts_with = "apart")]
    camera_height: Option<(String, f64)>,
    /// Lenses and poses from a file or folder of another program
    #[arg(long, value_name = "FILE|FOLDER")]
    calibration: Option<PathBuf>,
    /// Find lenses and poses by the COLMAP program, if it is installed
    #[arg(long, conflicts_with = "calibration")]
    colmap: bool,
    /// Masks, white where images count: NAME.png per camera, or a folder NAME with one per frame
    #[arg(long, value_name = "FOLDER")]
    masks: Option<PathBuf>,
    /// Accept interlaced videos and deinterlace them
    #[arg(long)]
    deinterlace: bool,
    /// Store images as PNG: lossless, four times as large
    #[arg(long)]
    png: bool,
    /// Skip the check of the finished capture (doctor)
    #[arg(long)]
    no_doctor: bool,
}

fn apart(text: &str) -> Result<([String; 2], f64), String> {
    let wrong = || format!("invalid distance of two cameras \"{text}\": write left,right=2.4");
    let (pair, metres) = text.rsplit_once('=').ok_or_else(wrong)?;
    let (a, b) = pair.split_once(',').ok_or_else(wrong)?;
    let metres: f64 = metres.trim().parse().map_err(|_| wrong())?;
    if !metres.is_finite() || metres <= 0.0 {
        return Err(format!("invalid distance {metres} m: expected more than 0"));
    }
    Ok(([a, b].map(|n| n.trim().to_owned()), metres))
}

fn crop(text: &str) -> Result<Cropping, String> {
    if text == "auto" {
        return Ok(Cropping::Auto);
    }
    let wrong = || format!("invalid part of an image \"{text}\": write auto, or W:H:X:Y such as 1920:800:0:140");
    let numbers: Option<Vec<usize>> = text.split(':').map(|n| n.trim().parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[width, height, x, y]) if width > 0 && height > 0 => Ok(Cropping::At(Crop { width, height, x, y })),
        _ => Err(wrong()),
    }
}

fn height(text: &str) -> Result<(String, f64), String> {
    let wrong = || format!("invalid height of a camera \"{text}\": write left=1.6");
    let (name, metres) = text.rsplit_once('=').ok_or_else(wrong)?;
    let metres: f64 = metres.trim().parse().map_err(|_| wrong())?;
    if !metres.is_finite() || metres <= 0.0 {
        return Err(format!("invalid height {metres} m"));
    }
    Ok((name.trim().to_owned(), metres))
}

/// Refuses a folder that holds what an import writes, but no import: images, masks or points of other origin are never replaced.
fn check_ours(folder: &Path) -> splat4d::Result<()> {
    if folder.join(corrections::FILE).is_file() {
        return Ok(());
    }
    let listed = written(folder);
    let foreign = |name: &&&str| folder.join(name).exists() && !listed.iter().any(|file| file.starts_with(name));
    let Some(name) = WRITTEN.iter().find(foreign) else { return Ok(()) };
    let what = match *name {
        CAPTURE => "the folder contains a capture of another program".to_owned(),
        name => format!("holds {name}, and there is no record that splat4d wrote it"),
    };
    Err(Error::input(what).at(folder.display()).remedy("Give another folder with -o."))
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let folder = &args.output;
    check_ours(folder)?;
    let read = args.videos.iter().chain(&args.masks).map(|v| Input::new(v, "what is imported,"));
    // A capture may lie next to the videos, in the folder of their calibration.
    let calibration = args.calibration.iter().map(|c| Input { may_hold: true, ..Input::new(c, "the calibration") });
    check_apart(folder, &read.chain(calibration).collect::<Vec<_>>())?;
    // Before videos are read, which takes a while.
    args.calibration.iter().try_for_each(|c| calibration::read(c).map(drop))?;
    let _owned = OutputFolder::amend(folder, "import")?;
    let request = Request {
        inputs: args.videos.clone(),
        folder: folder.clone(),
        selection: Selection {
            every: args.every,
            from: args.from,
            to: args.to,
            size: Some(args.size),
            deinterlace: args.deinterlace,
            crop: None,
        },
        crop: args.crop,
        fps: args.fps,
        rig: match args.rig.as_str() {
            "fixed" => Rig::Fixed,
            "moving" => Rig::Moving,
            _ => Rig::Auto,
        },
        sound: !args.no_audio,
        format: if args.png { Format::Png } else { Format::default() },
        apart: args.apart.clone(),
        board: args.board,
        camera_height: args.camera_height.clone(),
        calibration: args.calibration.clone(),
        colmap: args.colmap,
        masks: args.masks.clone(),
        synchronous: args.synchronous,
    };
    let stop = interrupt::flag("stopping: stored results are kept");
    interrupt::stop_not_polled("stored results are kept, and the same command continues from there");
    let mut tell = |event: &splat4d_train::event::Event| console.event(event);
    let made = recording::import(&request, &mut Progress(&mut tell), &|| stop.load(Ordering::SeqCst));
    console.clear();
    let report = made.map_err(|e| match e.kind() {
        ErrorKind::Interrupted => e,
        _ => e.at("import"),
    })?;
    let looked = if args.no_doctor {
        None
    } else {
        let capture = open_capture(folder, &Recipe::default())?;
        Some(doctor::made(&capture, &folder.join("import"), console)?)
    };
    told(&report, looked.as_ref(), console);
    if report.cameras.len() > 1 && args.rig != "moving" {
        console.say("all cameras train; to measure new views, hold one out: --hold-out camera=NAME");
    }
    console.next("train", folder);
    Ok(())
}

fn told(report: &Report, looked: Option<&(Looked, PathBuf)>, console: &Console) {
    for camera in &report.cameras {
        for warning in &camera.warnings {
            console.warn(&format!("camera {}: {warning}", camera.name));
        }
        if let Some(trouble) = &camera.trouble {
            console.warn(&format!("camera {} is left out: {trouble}", camera.name));
        }
    }
    for line in &report.refused {
        console.warn(line);
    }
    let guess = |c: &&CameraReport| c.by == ["motion"];
    let guessed: Vec<&str> = report.cameras.iter().filter(guess).map(|c| c.name.as_str()).collect();
    if !guessed.is_empty() {
        console.warn(&format!(
            "the time offsets of these cameras are guessed from the amount of motion and not confirmed: {} (correct them in {})",
            guessed.join(", "),
            corrections::FILE
        ));
    }
    let silent: Vec<&str> = report.cameras.iter().filter(|c| c.offset.is_none()).map(|c| c.name.as_str()).collect();
    if report.cameras.len() > 1 && !silent.is_empty() && !report.still {
        console.warn(&format!(
            "the time offsets of these cameras are unknown, those of their files are used: {} (correct them in {})",
            silent.join(", "),
            corrections::FILE
        ));
    }
    if console.json() {
        console.emit(&json!({"type": "imported", "report": report, "doctor": looked.map(|l| &l.0)}));
        return;
    }
    let mut text =
        String::from("camera              frames  offset ms     ±  by                     points   error px  focal px");
    let given = report.cameras.iter().any(|c| c.calibration.is_some());
    text += if given { "  calibration px\n" } else { "\n" };
    for camera in &report.cameras {
        let off = camera.calibration.map_or_else(|| "-".to_owned(), |v| format!("{v:.2}"));
        let _ = writeln!(text, "{}{}", row(camera), if given { format!("{off:>16}") } else { String::new() });
    }
    if !report.gaps.is_empty() {
        let each = report.gaps.iter().map(|g| format!("{}-{} {:.0}", g.cameras[0], g.cameras[1], g.degrees));
        let _ = writeln!(text, "degrees between neighbours: {}", each.collect::<Vec<_>>().join(", "));
    }
    for guess in &report.guesses {
        let _ = writeln!(text, "{guess}");
    }
    let _ = write!(text, "{} points; wrote {}", report.points, report.capture.display());
    if let Some((findings, page)) = looked {
        let _ = write!(text, "\ndoctor: {}; wrote {}", doctor::summary(findings), page.display());
        for f in findings.findings.iter().filter(|f| f.grade > Grade::Note).take(MOST) {
            let _ = write!(text, "\n! {}", doctor::sentence(f));
        }
        if !findings.leave_out.is_empty() {
            let _ = write!(text, "\nleave out: {}", findings.leave_out.join(", "));
        }
    }
    console.result(&text);
}

fn row(camera: &CameraReport) -> String {
    let number = |v: Option<f64>, scale: f64, digits: usize| {
        v.map_or_else(|| "-".to_owned(), |v| format!("{:.digits$}", v * scale))
    };
    format!(
        "{:<20}{:>6}{:>11}{:>6}  {:<22}{:>7}{:>11}{:>10}",
        camera.name,
        camera.frames,
        number(camera.offset, 1e3, 1),
        number(camera.sigma, 1e3, 1),
        if camera.by.is_empty() { "its file".to_owned() } else { camera.by.join(", ") },
        camera.sightings,
        number(camera.error, 1.0, 2),
        number(camera.focal, 1.0, 0),
    )
}
