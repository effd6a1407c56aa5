//! `render`: images and films of a run, a scene file or a plain 3DGS .ply.

use crate::console::Console;
use crate::device::Device;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use splat4d_workflow::draw::{Channel, Transfer};
use splat4d_workflow::paths::{Route, parse_size};
use splat4d_workflow::raw_values::RawFormat;
use splat4d_workflow::rendering::{Focus, Photo, Projection, RenderOptions, Stereo, film, image};
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  splat4d render runs/knight                               an orbit, into renders/orbit.mp4
  splat4d render runs/knight -o frozen.mp4 --freeze 0.4    bullet time: time stops at 0.4 s
  splat4d render runs/knight --path camera=cam03 --slow-motion 4 -o slow.mp4
  splat4d render runs/knight --path keys.json --size 1280x720 -o flight.mp4
  splat4d render runs/knight --path test -o views/         held-out views as numbered PNGs
  splat4d render runs/knight --channel depth --from 0.2 --to 0.8 -o depth.mp4
  splat4d render runs/knight --channel flow --path camera=cam03 -o uv/ --raw uv/ --raw-format flo
  splat4d render runs/knight --channel uncertainty -o unsure.mp4
  splat4d render scene.ply --camera cam.json -o view.png --raw view
  splat4d render runs/knight --shutter 180 --aperture 0.1 -o blurred.mp4
  splat4d render runs/knight --projection equirectangular --size 4096x2048 -o sphere.mp4
  splat4d render runs/knight --path camera=cam03 --shutter 180 -o comp/shot.%04d.exr
  splat4d render runs/knight --device gpu -v               on the GPU; prints frames/s

The output's extension selects the format: .mp4 (needs ffmpeg), .png (animated if it has several frames), .exr, none: a \
folder of PNGs. NAME.%04d.png and NAME.%04d.exr are numbered files. A key frame file is
  {\"fps\": 30, \"keys\": [
    {\"time\": 0, \"position\": [0, 1, 4], \"look_at\": [0, 1, 0], \"fov_y\": 45,
     \"scene_time\": 0},
    {\"time\": 3,
     \"world_to_camera\": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}]}
and a camera file
  {\"fx\": 500, \"fy\": 500, \"cx\": 320, \"cy\": 240, \"w\": 640, \"h\": 480,
   \"background\": [0, 0, 0],
   \"world_to_camera\": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}
with a row-major pose in OpenCV axes (x right, y down, z forward) and pixel centres at +0.5.";

/// Render images and films of a run, a scene.safetensors or a 3DGS .ply
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The run, scene file or .ply
    #[arg(value_name = "RUN|FILE", required_unless_present = "model")]
    source: Option<PathBuf>,
    /// Output: NAME.mp4, NAME.png, NAME.exr, NAME.%04d.png, NAME.%04d.exr, or a folder
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
    /// Shutter angle, degrees up to 360: motion blur of the scene and the camera around the frame's time
    #[arg(long, value_name = "DEGREES", value_parser = number, help_heading = "Photography")]
    shutter: Option<f64>,
    /// Diameter of the lens in scene units: depth of field
    #[arg(long, value_name = "D", value_parser = number, help_heading = "Photography")]
    aperture: Option<f64>,
    /// What is sharp: a distance in scene units, or a pixel X,Y [default: the middle of the image]
    #[arg(long, value_name = "Z|X,Y", value_parser = focus, help_heading = "Photography", allow_negative_numbers = true)]
    focus: Option<Focus>,
    /// Images of which a blurred one is the mean [default: 8, with a lens 16]
    #[arg(long, value_name = "N", help_heading = "Photography")]
    samples: Option<usize>,
    /// How directions become pixels
    #[arg(long, value_parser = projections(), default_value = "perspective", help_heading = "Photography")]
    projection: Projection,
    /// Images of two eyes, each of the image's size
    #[arg(long, value_parser = stereos(), requires = "eye_distance", help_heading = "Photography")]
    stereo: Option<Stereo>,
    /// Distance of the eyes in scene units; 0.065 where a unit is one metre
    #[arg(long, value_name = "D", value_parser = number, requires = "stereo", help_heading = "Photography")]
    eye_distance: Option<f64>,
    /// PNG files with alpha in place of the background
    #[arg(long, conflicts_with = "background", help_heading = "Image")]
    transparent: bool,
    /// Colours of .exr files [default: linear]
    #[arg(long, value_parser = transfers(), help_heading = "Image")]
    transfer: Option<Transfer>,
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

/// Reads the name of a projection.
fn projections() -> impl TypedValueParser<Value = Projection> {
    let values = Projection::ALL.map(|one| PossibleValue::new(one.name()).help(one.about()));
    let named = |name: String| Projection::ALL.into_iter().find(|one| one.name() == name);
    PossibleValuesParser::new(values).map(move |name| named(name).expect("it is one of the names"))
}

/// Reads the name of a stereo layout.
fn stereos() -> impl TypedValueParser<Value = Stereo> {
    let values = Stereo::ALL.map(|one| PossibleValue::new(one.name()).help(one.about()));
    let named = |name: String| Stereo::ALL.into_iter().find(|one| one.name() == name);
    PossibleValuesParser::new(values).map(move |name| named(name).expect("it is one of the names"))
}

/// Reads the name of a transfer function.
fn transfers() -> impl TypedValueParser<Value = Transfer> {
    let values = Transfer::ALL.map(|one| PossibleValue::new(one.name()).help(one.about()));
    let named = |name: String| Transfer::ALL.into_iter().find(|one| one.name() == name);
    PossibleValuesParser::new(values).map(move |name| named(name).expect("it is one of the names"))
}

/// Reads the name of a channel.
fn channels() -> impl TypedValueParser<Value = Channel> {
    let values = Channel::ALL.map(|channel| PossibleValue::new(channel.name()).help(channel.about()));
    PossibleValuesParser::new(values).map(|name| Channel::named(&name).expect("it is one of the names"))
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let path = args.source.as_ref().or(args.model.as_ref()).expect("clap requires a source");
    let options = RenderOptions {
        output: args.output.clone(),
        path: args.path.clone(),
        size: args.size,
        from: args.from,
        to: args.to,
        freeze: args.freeze,
        slow_motion: args.slow_motion,
        seconds: args.seconds,
        fps: args.fps,
        channel: args.channel,
        background: args.background,
        raw: args.raw.clone(),
        raw_format: args.raw_format,
        photo: Photo {
            shutter: args.shutter,
            aperture: args.aperture,
            focus: args.focus,
            samples: args.samples,
            projection: args.projection,
            stereo: args.stereo,
            eye_distance: args.eye_distance,
            transparent: args.transparent,
            transfer: args.transfer,
        },
        force: args.force,
        device: args.device.into(),
    };
    match &args.camera {
        Some(camera) => image(path, camera, &options, console)?,
        None => drop(film(path, &options, console)?),
    };
    Ok(())
}

fn number(text: &str) -> Result<f64, String> {
    text.trim().parse::<f64>().ok().filter(|x| x.is_finite()).ok_or_else(|| "expected a number".to_owned())
}

fn focus(text: &str) -> Result<Focus, String> {
    let parts: Result<Vec<f64>, String> = text.split(',').map(number).collect();
    match parts.as_deref() {
        Ok([z]) => Ok(Focus::Distance(*z)),
        Ok([x, y]) => Ok(Focus::Pixel([*x, *y])),
        _ => Err("expected a distance in scene units, or a pixel X,Y".into()),
    }
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
