//! `import`: makes a capture from videos: frames, synchronisation, poses and points.

use crate::console::Console;
use crate::interrupt;
use crate::serving::{self, Place};
use serde_json::json;
use splat4d::{Error, ErrorKind};
use splat4d_import::board::Board;
use splat4d_import::recording::{FPS, Request, Rig, SIZE};
use splat4d_import::video::{Crop, Cropping, Selection};
use splat4d_import::write::Format;
use splat4d_workflow::aligning::Aligning;
use splat4d_workflow::importing::{import, import_predicted, keypoints, matcher};
use splat4d_workflow::parts::left_out;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

const EXAMPLES: &str = "\
Examples:
  splat4d import videos/ -o my-take                  all videos of a folder: fixed cameras
  splat4d import a.mp4 b.mp4 c.mp4 -o my-take --from 3.2 --to 9.8 --size 720
  splat4d import walk.mp4 -o walk --every 5          one moving camera, a static scene
  splat4d import videos/ -o my-take --apart left,right=2.4    lengths in metres
  splat4d import videos/ -o my-take --board 36h11:0.16:floor    an AprilTag of 16 cm on the floor
  splat4d import videos/ -o my-take --calibration Calib.toml    known poses; offsets are found
  splat4d import videos/ -o my-take --assist    cameras at right angles: click points in a page

my-take/import.toml contains the result of every camera: correct an offset or a lens, or leave a camera out, and run \
the same command again. Then: splat4d train my-take. How to record: docs/filming.md.";

/// Make a capture from videos: frames, synchronisation, poses, lenses and points
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Videos, folders of videos, or folders of images (one per camera); or one .npz with poses and depth from VGGT or
    /// Depth Anything 3
    #[arg(value_name = "VIDEOS", required = true)]
    videos: Vec<PathBuf>,
    /// The capture's folder; interrupted work continues
    #[arg(short, long, value_name = "TAKE")]
    output: PathBuf,
    /// Fixed or moving cameras; auto: one video is a moving camera, several are fixed ones
    #[arg(long, value_name = "auto|fixed|moving", default_value = "auto", value_parser = ["auto", "fixed", "moving"])]
    rig: String,
    /// Do not use the videos' sound, and keep none
    #[arg(long)]
    no_audio: bool,
    /// Sound that the capture keeps: a camera, a file that is aligned with the cameras' sound, or none [default: of the
    /// tracks that cover the clip, the loudest without clipping]
    #[arg(long, value_name = "CAMERA|FILE|none")]
    sound: Option<String>,
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
    /// Click the same points in all cameras in a local page, for cameras that share too few features
    #[arg(long, conflicts_with = "colmap")]
    assist: bool,
    /// Use the clicked points of this file, without a page; with --assist, start the page from it
    #[arg(long, value_name = "FILE", conflicts_with = "colmap")]
    points: Option<PathBuf>,
    /// Calibrate the cameras by keypoints of people: a folder with NAME/ or NAME.json of each camera, or a network (.onnx) that
    /// finds them in the images
    #[arg(long, value_name = "FOLDER|ONNX", group = "network", conflicts_with_all = ["colmap", "points", "assist"])]
    keypoints: Option<PathBuf>,
    /// A network (.onnx) that matches two images, for cameras whose features do not match
    #[arg(long, value_name = "ONNX", group = "network", conflicts_with_all = ["colmap", "points", "assist", "keypoints"])]
    matcher: Option<PathBuf>,
    /// Ready-made description of the network, in place of the file next to it
    #[arg(long, value_name = "NAME", requires = "network")]
    described: Option<String>,
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
    /// Port of the page of --assist; 0: any free one [default: 4440, or a free one after it]
    #[arg(long, value_name = "N", requires = "assist")]
    port: Option<u16>,
    /// Print the address of the page and open no browser
    #[arg(long, requires = "assist")]
    no_open: bool,
    /// Read the page from this folder, for its development
    #[arg(long, value_name = "DIR", hide = true)]
    player_folder: Option<PathBuf>,
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

/// Serves the page until its user finishes; the file of the points.
fn clicked(request: &Request, place: &Place, stop: &AtomicBool, console: &Console) -> anyhow::Result<PathBuf> {
    /// How often a finished page is noticed.
    const POLL: Duration = Duration::from_millis(50);
    /// Time for the last response to reach the page.
    const FAREWELL: Duration = Duration::from_millis(250);
    let (aligning, config) = Aligning::begin(request, stop, console)?;
    let running = serving::start_for(config, place, Some(aligning.token()), console)?;
    let file = aligning.file().to_owned();
    console.print_line("click points in the page and press Finish; Ctrl-C stops, and clicked points are kept");
    while !aligning.is_finished() {
        if stop.load(Ordering::SeqCst) {
            return Err(Error::new(ErrorKind::Interrupted, "stopped")
                .remedy("Run the same command again: the page shows the points again.")
                .into());
        }
        std::thread::sleep(POLL);
    }
    std::thread::sleep(FAREWELL);
    running.stop();
    console.print_line(&format!("points: {} (again without the page: --points)", file.display()));
    Ok(file)
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    if args.assist && !cfg!(feature = "serve") {
        return Err(left_out("--assist", "serve").into());
    }
    if let [file] = &args.videos[..]
        && file.extension().is_some_and(|e| e.eq_ignore_ascii_case("npz"))
    {
        let words = import_predicted(file, &args.output, console)?;
        console.print_line(&words);
        console.emit(&json!({ "type": "imported", "report": { "words": words } }));
        console.next("train", &args.output);
        return Ok(());
    }
    let described = args.described.as_deref();
    let mut request = Request {
        inputs: args.videos.clone(),
        folder: args.output.clone(),
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
        track: args.sound.clone(),
        format: if args.png { Format::Png } else { Format::default() },
        apart: args.apart.clone(),
        board: args.board,
        camera_height: args.camera_height.clone(),
        calibration: args.calibration.clone(),
        colmap: args.colmap,
        masks: args.masks.clone(),
        synchronous: args.synchronous,
        points: args.points.clone(),
        keypoints: args.keypoints.as_ref().map(|path| keypoints(path, described)).transpose()?,
        matcher: args.matcher.as_ref().map(|network| matcher(network, described)).transpose()?,
    };
    let stop = interrupt::flag("stopping: stored results are kept");
    if args.assist {
        let (port, player_folder) = (args.port, args.player_folder.clone());
        let place = Place { port, host: None, no_open: args.no_open, player_folder };
        request.points = Some(clicked(&request, &place, &stop, console)?);
    }
    let imported = import(&request, !args.no_doctor, &stop, console)?;
    if console.json() {
        console.emit(&imported.json());
    } else {
        console.result(&imported.in_words());
    }
    if imported.report.cameras.len() > 1 && args.rig != "moving" {
        console.print_line("all cameras train; to measure new views, hold one out: --hold-out camera=NAME");
    }
    console.next("train", &args.output);
    Ok(())
}
