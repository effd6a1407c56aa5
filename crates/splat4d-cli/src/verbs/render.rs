//! `render`: images and films of a run, a scene file or a plain 3DGS .ply.

use crate::console::Console;
use crate::device::{self, Device};
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use splat4d::scene::Planes;
use splat4d::{Error, format};
use splat4d_train::output::OutputFolder;
use splat4d_workflow::draw::{Channel, Painter};
use splat4d_workflow::paths::{self, Clock, Route, parse_size, shots};
use splat4d_workflow::raw_values::RawFormat;
use splat4d_workflow::sequence::{self, Pattern};
use splat4d_workflow::source::{Source, not_empty};
use splat4d_workflow::video::{self, Film};
use splat4d_workflow::{camera_file, files};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Frames a second of films unless told.
const FPS: f64 = 30.0;
/// Shots that are looked at to find the range of a channel.
const PROBES: usize = 8;
/// Range of a film in which nothing is to be seen, or of a channel that needs none.
const NO_RANGE: [f32; 2] = [1.0, 2.0];

const EXAMPLES: &str = "\
Examples:
  splat4d render runs/knight                               an orbit, into runs/knight/renders/orbit.mp4
  splat4d render runs/knight -o frozen.mp4 --freeze 0.4    bullet time: time stops at 0.4 s
  splat4d render runs/knight --path camera=cam03 --slow-motion 4 -o slow.mp4
  splat4d render runs/knight --path keys.json --size 1280x720 -o flight.mp4
  splat4d render runs/knight --path test -o views/         held-out views as numbered PNGs
  splat4d render runs/knight --channel depth --from 0.2 --to 0.8 -o depth.mp4
  splat4d render runs/knight --channel flow --path camera=cam03 -o flow/ --raw flow/ --raw-format flo
  splat4d render runs/knight --channel uncertainty -o unsure.mp4
  splat4d render scene.ply --camera cam.json -o view.png --raw view
  splat4d render runs/knight --device gpu -v               on the GPU; prints frames/s

The output's extension selects the format: .mp4 (needs ffmpeg), .png (animated if it has several frames), none: a folder \
of PNGs. A key frame file is
  {\"fps\": 30, \"keys\": [{\"time\": 0, \"position\": [0, 1, 4], \"look_at\": [0, 1, 0], \"fov_y\": 45, \"scene_time\": 0},
                       {\"time\": 3, \"world_to_camera\": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}]}
and a camera file
  {\"fx\": 500, \"fy\": 500, \"cx\": 320, \"cy\": 240, \"w\": 640, \"h\": 480, \"background\": [0, 0, 0],
   \"world_to_camera\": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}
with a row-major pose in OpenCV axes (x right, y down, z forward) and pixel centres at +0.5.";

/// Render images and films of a run, a scene.safetensors or a 3DGS .ply
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run, scene file or .ply
    #[arg(value_name = "RUN|FILE", required_unless_present = "model")]
    source: Option<PathBuf>,
    /// Output: NAME.mp4, NAME.png, or a folder
    #[arg(short, long, value_name = "OUT")]
    output: Option<PathBuf>,
    /// Camera path: orbit, test, train, camera=NAME or a key frame file [default: orbit]
    #[arg(long, value_name = "PATH", help_heading = "Camera")]
    path: Option<Route>,
    /// One image from this camera (JSON)
    #[arg(long, value_name = "FILE", conflicts_with_all = ["path", "from", "to", "slow_motion", "seconds", "fps", "size"],
        help_heading = "Camera")]
    camera: Option<PathBuf>,
    /// Image size [default: the training cameras']
    #[arg(long, value_name = "WxH", value_parser = parse_size, help_heading = "Camera")]
    size: Option<[usize; 2]>,
    /// First second of the scene
    #[arg(long, value_name = "S", value_parser = second, help_heading = "Time", allow_negative_numbers = true)]
    from: Option<f64>,
    /// Last second of the scene
    #[arg(long, value_name = "S", value_parser = second, help_heading = "Time", allow_negative_numbers = true)]
    to: Option<f64>,
    /// Render everything at this second of the scene
    #[arg(long, value_name = "S", value_parser = second, visible_alias = "time", conflicts_with_all = ["from", "to"],
        help_heading = "Time", allow_negative_numbers = true)]
    freeze: Option<f64>,
    /// Slow-motion factor
    #[arg(long, value_name = "F", value_parser = factor, help_heading = "Time")]
    slow_motion: Option<f64>,
    /// Length of the film: the time range is stretched to it
    #[arg(long, value_name = "S", value_parser = length, conflicts_with = "slow_motion", help_heading = "Time")]
    seconds: Option<f64>,
    /// Frames per second of the film [default: 30, or the key frame file's]
    #[arg(long, value_name = "N", value_parser = fps, help_heading = "Time")]
    fps: Option<f64>,
    /// Channel to render
    #[arg(long, value_parser = channels(), default_value = "color", help_heading = "Image")]
    channel: Channel,
    /// Colour behind the scene, 0 to 1 [default: the scene's, or the camera file's]
    #[arg(long, value_name = "R,G,B", value_parser = color, help_heading = "Image")]
    background: Option<Color>,
    /// Also write the raw values. With --camera: P.npy [h,w,3], P.alpha.npy [h,w] and P.depth.npy [h,w] (Σ zαT), not
    /// clamped, and those of another --channel as P.CHANNEL.npy. Of a film: the channel's as numbered files in P
    #[arg(long, value_name = "P", help_heading = "Image")]
    raw: Option<PathBuf>,
    /// Replace numbered files that splat4d wrote to the folder, even if there are more
    #[arg(long, conflicts_with = "camera")]
    force: bool,
    /// Format of the raw values
    #[arg(long, value_parser = raw_formats(), default_value = "npy", requires = "raw", help_heading = "Image")]
    raw_format: RawFormat,

    /// Device that renders
    #[arg(long, value_enum, default_value = "auto")]
    device: Device,

    #[arg(short = 'm', long = "model-path", alias = "model_path", hide = true, conflicts_with = "source")]
    model: Option<PathBuf>,
}

type Color = [f32; 3];

/// Reads the name of a format of raw values.
fn raw_formats() -> impl TypedValueParser<Value = RawFormat> {
    let values = RawFormat::ALL.map(|format| PossibleValue::new(format.ending()).help(format.about()));
    let named = |name: String| RawFormat::ALL.into_iter().find(|format| format.ending() == name);
    PossibleValuesParser::new(values).map(move |name| named(name).expect("it is one of the names"))
}

/// Reads the name of a channel.
fn channels() -> impl TypedValueParser<Value = Channel> {
    let values = Channel::ALL.map(|channel| PossibleValue::new(channel.name()).help(channel.about()));
    PossibleValuesParser::new(values).map(|name| Channel::named(&name).expect("it is one of the names"))
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let path = args.source.as_ref().or(args.model.as_ref()).expect("clap asks for a source");
    match &args.camera {
        Some(camera) => one(args, path, camera, console),
        None => film(args, path, console),
    }
}

/// One image from a camera file.
fn one(args: &Args, path: &Path, camera: &Path, console: &Console) -> anyhow::Result<()> {
    let (camera, background) = camera_file::read(camera)?;
    let Some(output) = args.output.as_ref().or(args.raw.as_ref()) else {
        return Err(Error::input("no output was given").remedy("Add -o NAME.png, --raw NAME or both.").into());
    };
    if args.output.as_ref().is_some_and(|o| o.extension().is_none_or(|e| !e.eq_ignore_ascii_case("png"))) {
        return Err(Error::input("one image is written as .png")
            .at(output.display())
            .remedy("Use -o NAME.png.")
            .into());
    }
    args.raw_format.suits(args.channel)?;
    let source = Source::open(path)?;
    let raw = args.raw.as_deref().map(|prefix| raw_files(prefix, args)).unwrap_or_default();
    for file in args.output.iter().chain(&raw) {
        source.keep(path, file, &[])?;
    }
    let depth = args.channel == Channel::Depth || args.raw.is_some();
    let background = args.background.or(background).unwrap_or(source.scene.background);
    let painter = Painter::new(&source.scene, background, antialias(&source), depth);
    let mut painter = channel(painter, args, &source, console)?;
    painter.draw(&camera, args.freeze.unwrap_or(source.scene.clip[0]));
    if let Some(out) = &args.output {
        let range = painter.range().unwrap_or(NO_RANGE);
        files::write(out, &painter.rgb(args.channel, range).png())?;
        console.written(out);
    }
    match &raw[..] {
        [] => {}
        [color, alpha, depth] => {
            let (image, size) = (&painter.image, [camera.height, camera.width]);
            raw_array(color, &[size[0], size[1], 3], &image.color.interleaved(), console)?;
            raw_array(alpha, &size, plane(&image.alpha), console)?;
            raw_array(depth, &size, plane(&image.depth), console)?;
        }
        files => {
            files::write(&files[0], &args.raw_format.bytes(args.channel, &painter.raw())?)?;
            console.written(&files[0]);
        }
    }
    Ok(())
}

/// The files of `--raw PREFIX` for one camera: those of colour, opacity and depth, or one of the channel.
fn raw_files(prefix: &Path, args: &Args) -> Vec<PathBuf> {
    let named = |ending: &str| {
        let mut name = stem(prefix);
        name.push(ending);
        PathBuf::from(name)
    };
    if args.channel.is_field() || args.raw_format != RawFormat::Npy {
        return vec![named(&format!(".{}.{}", args.channel.name(), args.raw_format.ending()))];
    }
    [".npy", ".alpha.npy", ".depth.npy"].map(named).into()
}

fn plane(planes: &Planes<f32>) -> &[f32] {
    &planes.data
}

fn raw_array(path: &Path, shape: &[usize], data: &[f32], console: &Console) -> anyhow::Result<()> {
    let mut bytes = Vec::new();
    format::npy::write_f32(shape, data, &mut bytes)?;
    files::write(path, &bytes)?;
    console.written(path);
    Ok(())
}

/// `--raw view` and `--raw view.npy` mean the same.
fn stem(prefix: &Path) -> OsString {
    let ending = RawFormat::ALL.iter().any(|f| prefix.extension().is_some_and(|e| e == f.ending()));
    if ending { prefix.with_extension("").into_os_string() } else { prefix.as_os_str().to_owned() }
}

/// A painter of the channel that is asked for, on the device that is.
fn channel<'a>(
    painter: Painter<'a>,
    args: &Args,
    source: &Source,
    console: &'a Console,
) -> anyhow::Result<Painter<'a>> {
    let views = if args.channel == Channel::Uncertainty { source.views()? } else { Vec::new() };
    let mut phase = |done, of| console.phase("evaluating the training images", done, of);
    let painter = painter
        .of_channel(args.channel, &views, &mut phase)?
        .on(|config, wanted| device::open(args.device, config, wanted, console).backend, console);
    console.clear();
    Ok(painter)
}

/// Many images along a path.
fn film(args: &Args, path: &Path, console: &Console) -> anyhow::Result<()> {
    if let Some(out) = &args.output {
        video::check(out)?;
    }
    args.raw_format.suits(args.channel)?;
    let source = Source::open(path)?;
    let scene = &source.scene;
    not_empty(scene, path)?;
    let route = args.path.clone().unwrap_or(Route::Orbit);
    let views = source.views()?;
    let told = match &route {
        Route::Keys(file) => paths::fps_of(file)?,
        _ => None,
    };
    let clock = Clock {
        from: args.from.unwrap_or(scene.clip[0]),
        to: args.to.unwrap_or(scene.clip[1]),
        freeze: args.freeze,
        slow_motion: args.slow_motion,
        seconds: args.seconds,
        fps: args.fps.or(told).unwrap_or(FPS),
    };
    if clock.to < clock.from {
        return Err(Error::input(format!(
            "invalid time range: its end ({} s) is before its start ({} s)",
            clock.to, clock.from
        ))
        .remedy(format!("The scene lasts from {} to {} s.", scene.clip[0], scene.clip[1]))
        .into());
    }
    let stage = source.stage(&views);
    let shots = shots(&route, &clock, &views, &stage, args.size)?;
    let output = args.output.clone().unwrap_or_else(|| default_output(path, &route, source.run.is_some()));
    source.keep(path, &output, &[])?;
    let size = [shots[0].camera.width, shots[0].camera.height];
    if let Some(other) = shots.iter().find(|s| [s.camera.width, s.camera.height] != size)
        && output.extension().is_some()
    {
        return Err(Error::input(format!(
            "the views have several sizes ({}x{} and {}x{}), a film needs one",
            size[0], size[1], other.camera.width, other.camera.height
        ))
        .remedy("Add --size, or write a folder of images (-o FOLDER).")
        .into());
    }
    let background = args.background.unwrap_or(scene.background);
    let depth = args.channel == Channel::Depth;
    let mut painter = channel(Painter::new(scene, background, antialias(&source), depth), args, &source, console)?;
    let plain = matches!(args.channel, Channel::Color | Channel::Alpha | Channel::Normal | Channel::Label);
    let range = if plain { NO_RANGE } else { range(&mut painter, &shots) };
    if args.output.is_none()
        && let Some(folder) = output.parent().filter(|p| !p.as_os_str().is_empty())
    {
        files::make_folder(folder)?;
    }
    let owned = folders(args, &output, shots.len(), &sequence::Read { path, run: source.run.as_ref() })?;
    let mut film = Film::create(&output, size, clock.fps, shots.len())?;
    let mut drawing = Duration::ZERO;
    for (i, shot) in shots.iter().enumerate() {
        let start = Instant::now();
        let picture = painter.picture(&shot.camera, shot.time, args.channel, range);
        drawing += start.elapsed();
        film.frame(&picture)?;
        if let Some(raw) = &args.raw {
            if args.channel == Channel::Color {
                // What takes over 8 bits alone leaves no numbers behind.
                painter.draw(&shot.camera, shot.time);
            }
            let bytes = args.raw_format.bytes(args.channel, &painter.raw())?;
            files::write(&raw.join(format!("{i:05}.{}", args.raw_format.ending())), &bytes)?;
        }
        console.phase("rendering", i + 1, shots.len());
    }
    film.finish()?;
    owned.into_iter().for_each(OutputFolder::finished);
    console.clear();
    if let Some([low, high]) = (!plain && range != NO_RANGE).then_some(range) {
        console.detail(&format!("colours of {} from {low:.4} to {high:.4}", args.channel.name()));
    }
    if let Some(raw) = &args.raw {
        console.written(raw);
    }
    console.detail(&format!(
        "{} frames of {}x{}, rendered on {} at {:.1} frames/s, encoding excluded",
        shots.len(),
        size[0],
        size[1],
        painter.device(),
        shots.len() as f64 / drawing.as_secs_f64().max(f64::MIN_POSITIVE)
    ));
    console.written(&output);
    Ok(())
}

/// Takes the folders of frames: of images, where the output is no single file, and of numbers.
fn folders(args: &Args, output: &Path, count: usize, read: &sequence::Read<'_>) -> splat4d::Result<Vec<OutputFolder>> {
    let pictures = output.extension().is_none().then(|| Pattern::plain(output, "png"));
    let numbers = args.raw.as_deref().map(|raw| Pattern::plain(raw, args.raw_format.ending()));
    let place = |p: &Pattern| p.folder().canonicalize().or_else(|_| std::path::absolute(p.folder())).ok();
    let all: Vec<&Pattern> = pictures.iter().chain(&numbers).collect();
    let groups = match all[..] {
        [a, b] if place(a) != place(b) => vec![vec![a], vec![b]],
        [] => Vec::new(),
        _ => vec![all],
    };
    groups.iter().map(|group| sequence::take(group, count, read, "render", args.force)).collect()
}

/// One range for the whole film, so that its colours do not flicker.
fn range(painter: &mut Painter<'_>, shots: &[paths::Shot]) -> [f32; 2] {
    let step = shots.len().div_ceil(PROBES).max(1);
    let mut range: Option<[f32; 2]> = None;
    for shot in shots.iter().step_by(step) {
        painter.draw(&shot.camera, shot.time);
        if let Some([near, far]) = painter.range() {
            range = Some(range.map_or([near, far], |[n, f]| [n.min(near), f.max(far)]));
        }
    }
    range.unwrap_or(NO_RANGE)
}

fn antialias(source: &Source) -> bool {
    source.run.as_ref().and_then(|r| r.recipe().ok()).is_some_and(|r| r.appearance.antialias)
}

fn default_output(path: &Path, route: &Route, run: bool) -> PathBuf {
    let name = match route {
        Route::Orbit => "orbit".to_owned(),
        Route::Test => "test".to_owned(),
        Route::Train => "train".to_owned(),
        Route::Camera(name) => {
            name.chars().map(|c| if c.is_alphanumeric() || "-_".contains(c) { c } else { '-' }).collect()
        }
        Route::Keys(file) => file.file_stem().map_or("keys".into(), |s| s.to_string_lossy().into_owned()),
    };
    let stills = matches!(route, Route::Test | Route::Train);
    let ending = match (stills, video::have_ffmpeg()) {
        (true, _) => "",
        (false, true) => ".mp4",
        (false, false) => ".png",
    };
    if run {
        return path.join("renders").join(format!("{name}{ending}"));
    }
    let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    path.with_file_name(format!("{stem}-{name}{ending}"))
}

fn number(text: &str) -> Result<f64, String> {
    text.trim().parse::<f64>().ok().filter(|x| x.is_finite()).ok_or_else(|| "expected a number".to_owned())
}

fn second(text: &str) -> Result<f64, String> {
    number(text).map_err(|_| "expected seconds of the scene, for instance 0.5".into())
}

fn factor(text: &str) -> Result<f64, String> {
    match number(text) {
        Ok(f) if (0.001..=1000.0).contains(&f) => Ok(f),
        _ => Err("expected a factor from 0.001 to 1000; 4 is four times slower than real time".into()),
    }
}

fn length(text: &str) -> Result<f64, String> {
    match number(text) {
        Ok(s) if (0.01..=36_000.0).contains(&s) => Ok(s),
        _ => Err("expected the film's length in seconds, 0.01 to 36000".into()),
    }
}

fn fps(text: &str) -> Result<f64, String> {
    match number(text) {
        Ok(f) if (0.1..=1000.0).contains(&f) => Ok(f),
        _ => Err("expected frames per second, 0.1 to 1000".into()),
    }
}

fn color(text: &str) -> Result<Color, String> {
    let parts: Result<Vec<f64>, String> = text.split(',').map(number).collect();
    match parts.as_deref() {
        Ok([r, g, b]) => Ok([*r as f32, *g as f32, *b as f32]),
        Ok([v]) => Ok([*v as f32; 3]),
        _ => Err("expected red, green and blue, 0 to 1, for instance 1,1,1".into()),
    }
}
