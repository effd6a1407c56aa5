//! Images and films of a run, a scene file or a plain 3DGS .ply.

mod photo;

pub use photo::{Focus, MAX_SAMPLES, Photo, Projection, Stereo};

use crate::device;
use crate::draw::{Channel, Painter};
use crate::events::Listener;
use crate::paths::{self, Clock, Route, shots};
use crate::raw_values::RawFormat;
use crate::sequence::{self, Pattern};
use crate::source::{Source, not_empty};
use crate::video::{self, Film};
use crate::{camera_file, files};
use photo::{Studio, Written};
use splat4d::device::Device;
use splat4d::format::playback::Sound;
use splat4d::layers::Scene;
use splat4d::scene::Planes;
use splat4d::{Error, Result, format};
use splat4d_train::output::OutputFolder;
use std::cell::Cell;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Frames a second of films by default.
const FPS: f64 = 30.0;
/// Shots that are examined to find the range of a channel.
const PROBES: usize = 8;
/// Range of a film in which nothing is to be seen, or of a channel that needs none.
const NO_RANGE: [f32; 2] = [1.0, 2.0];

/// Difference of two times that is rounding, seconds.
const ROUNDING: f64 = 1e-6;

/// Background of a scene: red, green, blue.
pub type Color = [f32; 3];

/// Options of [`film`] and [`image()`].
#[derive(Clone, Debug)]
pub struct RenderOptions {
    /// The file, or a folder of PNGs. `None`: by the scene and the path.
    pub output: Option<PathBuf>,
    /// Camera path. `None`: an orbit.
    pub path: Option<Route>,
    /// Image size (width, height). `None`: that of the training cameras.
    pub size: Option<[usize; 2]>,
    /// First second of the scene.
    pub from: Option<f64>,
    /// Last second of the scene.
    pub to: Option<f64>,
    /// Render everything at this second of the scene.
    pub freeze: Option<f64>,
    /// Slow-motion factor.
    pub slow_motion: Option<f64>,
    /// Length of the film, seconds: the time range is stretched to it.
    pub seconds: Option<f64>,
    /// Frames per second. `None`: 30, or those of the key-frame file.
    pub fps: Option<f64>,
    /// Channel to render.
    pub channel: Channel,
    /// Colour behind the scene. `None`: the scene's, or the camera file's.
    pub background: Option<Color>,
    /// Folder (of a film) or prefix (of an image) of raw values.
    pub raw: Option<PathBuf>,
    /// Format of the raw values.
    pub raw_format: RawFormat,
    /// Shutter, lens, projection, eyes and transparency.
    pub photo: Photo,
    /// Replace numbered files that splat4d wrote to the folder.
    pub force: bool,
    /// Device that renders.
    pub device: Device,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self {
            output: None,
            path: None,
            size: None,
            from: None,
            to: None,
            freeze: None,
            slow_motion: None,
            seconds: None,
            fps: None,
            channel: Channel::Color,
            background: None,
            raw: None,
            raw_format: RawFormat::Npy,
            photo: Photo::default(),
            force: false,
            device: Device::Auto,
        }
    }
}

/// One image from a camera file.
///
/// Errors: no output; a scene or camera that cannot be read; raw values that do not fit the channel.
pub fn image(path: &Path, camera: &Path, args: &RenderOptions, console: &dyn Listener) -> Result<()> {
    let camera_file = camera;
    let (camera, background) = camera_file::read(camera_file)?;
    let Some(output) = args.output.as_ref().or(args.raw.as_ref()) else {
        return Err(
            Error::input("no output was given").remedy("Add option `output` NAME.png, option `raw` NAME or both.")
        );
    };
    let exr = args.output.as_deref().is_some_and(photo::is_exr);
    if !exr && args.output.as_ref().is_some_and(|o| o.extension().is_none_or(|e| !e.eq_ignore_ascii_case("png"))) {
        return Err(Error::input("one image is written as .png or .exr")
            .at(output.display())
            .remedy("Use option `output` NAME.png or NAME.exr."));
    }
    args.raw_format.suits(args.channel)?;
    let size = [camera.width, camera.height];
    args.photo.check(&RenderOptions { size: Some(size), ..args.clone() })?;
    let source = Source::open(path)?;
    let raw = args.raw.as_deref().map(|prefix| raw_files(prefix, args)).unwrap_or_default();
    let outputs: Vec<&Path> = args.output.iter().chain(&raw).map(PathBuf::as_path).collect();
    source.keep_all(path, &outputs, &[camera_file])?;
    args.photo.check_output(output, args, &source.scene)?;
    let depth = args.channel == Channel::Depth || args.raw.is_some();
    let background = args.background.or(background).unwrap_or(source.scene.background);
    let painter = Painter::new(&source.scene, background, source.antialias(), depth);
    let mut painter = channel(painter, args, console)?;
    painter = painter.around(args.photo.panorama(size));
    let shot = paths::Shot { camera, time: args.freeze.unwrap_or(source.scene.clip[0]) };
    painter.draw(&shot.camera, shot.time);
    if let Some(out) = &args.output {
        let range = painter.range().unwrap_or(NO_RANGE);
        let plain = args.photo == Photo::default();
        let bytes = match (exr && args.channel != Channel::Color, exr || !plain) {
            (true, _) => RawFormat::Exr.bytes(args.channel, &painter.raw())?,
            (_, false) => painter.rgb(args.channel, range).png(),
            (_, true) => {
                let shots = [shot.clone()];
                let studio = studio(args, &source.scene, &shots, true, source.scene.fps, range);
                let written = studio.write(&mut painter, 0)?;
                // Raw values are those of the plain image.
                painter.draw(&shot.camera, shot.time);
                match written {
                    Written::Rgb(rgb) => rgb.png(),
                    Written::File(bytes) => bytes,
                }
            }
        };
        files::write(out, &bytes)?;
        console.written(out);
    }
    let camera = &shot.camera;
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
fn raw_files(prefix: &Path, args: &RenderOptions) -> Vec<PathBuf> {
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

fn raw_array(path: &Path, shape: &[usize], data: &[f32], console: &dyn Listener) -> Result<()> {
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

/// A painter of the channel that is requested, on the device that is.
fn channel<'a>(painter: Painter<'a>, args: &RenderOptions, console: &'a dyn Listener) -> Result<Painter<'a>> {
    let painter = painter.of_channel(args.channel)?;
    Ok(painter.on(|config, wanted| device::open(args.device, config, wanted, console).backend, console))
}

/// Many images along a path.
///
/// Errors: a scene, path or time range that does not fit; views of several sizes in a film; an output that cannot be
/// written.
///
/// ```no_run
/// use splat4d_workflow::draw::Channel;
/// use splat4d_workflow::events::ignore;
/// use splat4d_workflow::rendering::{RenderOptions, film};
///
/// # fn main() -> splat4d_workflow::Result<()> {
/// let options = RenderOptions {
///     output: Some("depth.mp4".into()),
///     channel: Channel::Depth,
///     freeze: Some(0.4),
///     ..RenderOptions::default()
/// };
/// let written = film("runs/knight".as_ref(), &options, &ignore)?;
/// # Ok(())
/// # }
/// ```
pub fn film(path: &Path, args: &RenderOptions, console: &dyn Listener) -> Result<PathBuf> {
    if let Some(out) = &args.output {
        video::check(out)?;
    }
    args.raw_format.suits(args.channel)?;
    args.photo.check(args)?;
    let source = Source::open(path)?;
    let scene = &source.scene;
    not_empty(scene, path)?;
    let route = args.path.clone().unwrap_or(Route::Orbit);
    let views = source.views()?;
    let of_route = match &route {
        Route::Keys(file) => paths::fps_of(file)?,
        _ => None,
    };
    let clock = Clock {
        from: args.from.unwrap_or(scene.clip[0]),
        to: args.to.unwrap_or(scene.clip[1]),
        freeze: args.freeze,
        slow_motion: args.slow_motion,
        seconds: args.seconds,
        fps: args.fps.or(of_route).unwrap_or(FPS),
    };
    if clock.to < clock.from {
        return Err(Error::input(format!(
            "invalid time range: its end ({} s) is before its start ({} s)",
            clock.to, clock.from
        ))
        .remedy(format!("The scene lasts from {} to {} s.", scene.clip[0], scene.clip[1])));
    }
    let stage = source.stage(&views);
    let around = args.photo.projection == Projection::Equirectangular;
    let mut shots = shots(&route, &clock, &views, &stage, args.photo.size(args.size))?;
    if around {
        shots.iter_mut().for_each(|shot| shot.camera = photo::level(&shot.camera, scene.up));
    }
    let output = args.output.clone().unwrap_or_else(|| default_output(path, &route, source.run.is_some()));
    let keys = if let Route::Keys(file) = &route { vec![file.as_path()] } else { Vec::new() };
    source.keep(path, &output, &keys)?;
    args.photo.check_output(&output, args, scene)?;
    let size = [shots[0].camera.width, shots[0].camera.height];
    if let Some(other) = shots.iter().find(|s| [s.camera.width, s.camera.height] != size)
        && output.extension().is_some()
    {
        return Err(Error::input(format!(
            "the views have several sizes ({}x{} and {}x{}), a film needs one",
            size[0], size[1], other.camera.width, other.camera.height
        ))
        .remedy("Add option `size`, or write a folder of images (option `output` FOLDER)."));
    }
    let background = args.background.unwrap_or(scene.background);
    let depth = args.channel == Channel::Depth;
    let painter = channel(Painter::new(scene, background, source.antialias(), depth), args, console)?;
    let mut painter = painter.around(args.photo.panorama(size));
    let plain = matches!(args.channel, Channel::Color | Channel::Alpha | Channel::Normal | Channel::Label);
    let range = if plain { NO_RANGE } else { range(&mut painter, &shots) };
    if args.output.is_none()
        && let Some(folder) = output.parent().filter(|p| !p.as_os_str().is_empty())
    {
        files::make_folder(folder)?;
    }
    let written = photo::files_of(&output, args.photo.transparent, shots.len())?;
    let owned = folders(args, &output, shots.len(), &sequence::Read { path, run: source.run.as_ref() })?;
    let sound = sound_of(&source, &shots, clock.fps, &output, console);
    let mut film = match written {
        Some(files) => Film::files(files)?,
        None => Film::create(&output, args.photo.written_size(size), clock.fps, shots.len(), sound)?,
    };
    let exr = photo::is_exr(&output);
    let views = matches!(route, Route::Test | Route::Train);
    let studio = studio(args, scene, &shots, views, if views { scene.fps } else { clock.fps }, range);
    let mut drawing = Duration::ZERO;
    for (i, shot) in shots.iter().enumerate() {
        let start = Instant::now();
        let frame = if exr && args.channel != Channel::Color {
            painter.draw(&shot.camera, shot.time);
            Written::File(RawFormat::Exr.bytes(args.channel, &painter.raw())?)
        } else {
            studio.write(&mut painter, i)?
        };
        drawing += start.elapsed();
        match frame {
            Written::Rgb(rgb) => film.frame(&rgb)?,
            Written::File(bytes) => film.file(&bytes)?,
        }
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
    Ok(output)
}

/// What shots are rendered with. `views`: they are not frames of one camera's film.
fn studio<'s>(
    args: &'s RenderOptions,
    scene: &Scene<f32>,
    shots: &'s [paths::Shot],
    views: bool,
    fps: f64,
    range: [f32; 2],
) -> Studio<'s> {
    let exr = args.channel == Channel::Color && args.output.as_deref().is_some_and(photo::is_exr);
    let frame = 1.0 / if fps > 0.0 { fps } else { FPS };
    let (photo, channel, clip) = (&args.photo, args.channel, scene.clip);
    Studio { photo, channel, shots, views, clip, frame, range, exr, focus: Cell::new(None) }
}

/// The scene's sound, and the second at which the film begins; none where the film has none, which a line reports.
fn sound_of<'a>(
    source: &'a Source,
    shots: &[paths::Shot],
    fps: f64,
    output: &Path,
    console: &dyn Listener,
) -> Option<(&'a Sound, f64)> {
    let sound = source.sound.as_ref()?;
    let (first, last) = (shots[0].time, shots[0].time + shots.len() as f64 / fps);
    // An orbit's last frame shows the clip's end, so that it is off by one frame there.
    let runs = |(i, shot): (usize, &paths::Shot)| (shot.time - first - i as f64 / fps).abs() <= 1.0 / fps + ROUNDING;
    let why = if !output.extension().is_some_and(|e| ["mp4", "mkv", "mov"].iter().any(|v| e.eq_ignore_ascii_case(v))) {
        "this output holds images alone"
    } else if !shots.iter().enumerate().all(runs) || shots.len() == 1 {
        "time does not run at the scene's speed"
    } else if sound.span[0] >= last || sound.span[1] <= first {
        "there is none at these times"
    } else {
        return Some((sound, first));
    };
    console.result(&format!("the sound is left out: {why}"));
    None
}

/// Takes the folders of frames: of images, where the output is not a single file, and of numbers.
fn folders(args: &RenderOptions, output: &Path, count: usize, read: &sequence::Read<'_>) -> Result<Vec<OutputFolder>> {
    let pictures = Pattern::of(output).or_else(|| output.extension().is_none().then(|| Pattern::plain(output, "png")));
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
