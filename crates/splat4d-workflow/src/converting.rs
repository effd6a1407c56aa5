//! From any scene to the formats of other programs, with axes, order and fade of each.

use crate::baking::{self, Baking};
use crate::deadline::Deadline;
use crate::events::Listener;
use crate::files::{self, either, grouped, human_bytes};
use crate::folding::fold;
use crate::programs::Program;
use crate::run_folder::Run;
use crate::sequence::{self, Pattern};
use crate::sound;
use crate::source::{Source, not_empty};
use serde_json::json;
use splat4d::bake::Likeness;
use splat4d::format::dialect::{self, WriteOptions};
use splat4d::format::linear::from_linear;
use splat4d::format::{self, DIALECTS, Dialect, Linear, Warnings, playback};
use splat4d::layers::{self, Constant, Scene, rotation_between};
use splat4d::math::Se3;
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::scene::{Camera, Params, Time};
use splat4d::{Error, ErrorKind, Result};
use std::path::{Path, PathBuf};

/// Rotations by less than this (cosine to the identity's trace) are rounding, and are not made.
const NO_ROTATION: f64 = 1e-12;
/// No rotation.
const IDENTITY: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
/// Warnings of a sequence are those of its first frame; the rest would be the same with other numbers.
const FIRST: &str = "first frame";

/// Endings of the dialects that can be written and for which `which` holds.
pub fn written(which: impl Fn(&Dialect) -> bool) -> Vec<&'static str> {
    DIALECTS.iter().filter(|d| d.is_written() && which(d)).map(|d| d.ending).collect()
}

/// A conversion: what to read, what to write, and how.
#[derive(Clone, Debug)]
pub struct Conversion {
    /// A run, a scene file, a folder of a SOG scene or of numbered files.
    pub input: PathBuf,
    /// The file; its extension selects the format. With `frames` a folder or a pattern.
    pub output: PathBuf,
    /// One time, seconds of the scene.
    pub time: Option<f64>,
    /// One file per frame.
    pub frames: bool,
    /// The same Gaussians in the same order in every file of `frames`, with opacity 0 outside their lifespans.
    pub constant: bool,
    /// Replace a sequence that splat4d wrote to the folder.
    pub force: bool,
    /// Frames per second of a sequence that is read, of `frames` or of USD.
    pub fps: Option<f64>,
    /// First second of `frames`.
    pub from: Option<f64>,
    /// Last second of `frames`.
    pub to: Option<f64>,
    /// Which way is up.
    pub up: Up,
    /// Highest degree of spherical harmonics to keep.
    pub sh: Option<u8>,
    /// Leave out the provenance of a playback file.
    pub no_provenance: bool,
    /// Refuse a format that cannot store lifespans exactly, instead of fitting them.
    pub exact: bool,
    /// Positions in the capture's world, in double precision.
    pub world: bool,
    /// Values of the input to read unconverted, not as logarithms, logits or coefficients.
    pub linear: Vec<Linear>,
    /// Version of .spz to write.
    pub spz_version: u32,
    /// Axes, unit and file names of this program; `frames` are `constant` then.
    pub program: Option<Program>,
}

/// Which way is up in the file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Up {
    /// As in the format.
    Format,
    /// As in the scene.
    Keep,
    /// This direction.
    Axis([f64; 3]),
}

/// Format of the file that is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Target {
    Dialect(Dialect),
    /// scene.safetensors: everything, exactly.
    Scene,
    /// .s4d, baked as `bake` does without options.
    Playback,
}

impl Target {
    fn of(path: &Path) -> Result<Self> {
        let name = path.file_name().map(|n| n.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
        if let Some(dialect) = Dialect::by_ending(&name) {
            if let dialect::Writer::None(remedy) = dialect.writer {
                let what = format!("{} is read, but not written", dialect.name);
                return Err(Error::new(ErrorKind::Unsupported, what).at(path.display()).remedy(remedy));
            }
            return Ok(Self::Dialect(dialect));
        }
        let (what, remedy) = match name.rsplit_once('.').map(|n| n.1) {
            Some("safetensors") => return Ok(Self::Scene),
            Some(playback::EXTENSION | playback::OLD_EXTENSION) => return Ok(Self::Playback),
            Some("usdc" | "usd") => ("this format is not written", "Write .ply or .spz.".into()),
            _ => {
                ("has no ending that names a format", format!("Use {} .safetensors .s4d.", written(|_| true).join(" ")))
            }
        };
        Err(Error::new(ErrorKind::Unsupported, what).at(path.display()).remedy(remedy))
    }

    fn moves(self) -> bool {
        match self {
            Self::Dialect(d) => d.moves,
            Self::Scene | Self::Playback => true,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Dialect(d) => d.name,
            Self::Scene => "scene.safetensors",
            Self::Playback => "playback file",
        }
    }
}

impl Conversion {
    /// A whole scene as one file, nothing else requested.
    pub fn new(input: impl Into<PathBuf>, output: impl Into<PathBuf>) -> Self {
        Self {
            input: input.into(),
            output: output.into(),
            time: None,
            frames: false,
            constant: false,
            force: false,
            fps: None,
            from: None,
            to: None,
            up: Up::Format,
            sh: None,
            no_provenance: false,
            exact: false,
            world: false,
            linear: Vec::new(),
            spz_version: WriteOptions::default().spz_version,
            program: None,
        }
    }
}

impl Conversion {
    /// Which way is up in a file: as the option states, else as the program expects it where the format leaves it open.
    fn up_in(&self, target: Target) -> Up {
        match (self.up, self.program, target) {
            (Up::Format, Some(program), Target::Dialect(d)) if !d.fixed_axes => Up::Axis(program.up),
            (up, ..) => up,
        }
    }
}

/// Refuses a file whose ending names no format that is written.
pub fn check_output(output: &Path) -> Result<()> {
    Target::of(output).map(|_| ())
}

/// Reads and writes. Errors: options that do not fit together; a file that cannot be read or written.
pub fn run(args: &Conversion, console: &dyn Listener) -> Result<()> {
    asked(args)?;
    let mut source = Source::open_at(&args.input, args.fps.unwrap_or(DEFAULT_FPS))?.finite();
    not_empty(&source.scene, &args.input)?;
    if !args.frames {
        source.keep(&args.input, &args.output, &[])?;
    }
    read_linear(&mut source, &args.linear);
    source.warnings.lines().iter().for_each(|w| console.warn(&format!("{w}.")));
    let target = asked(args)?.1;
    if target != Target::Scene {
        fold(&mut source, target.name(), &Deadline::default(), console)?;
    }
    write(args, source, console)
}

/// Reads values unconverted where the options specify it.
fn read_linear(source: &mut Source, linear: &[Linear]) {
    for &what in linear {
        // The reader's own doubt about them is settled.
        source.warnings.drop(&format!("--linear {}", what.name()));
        for layer in &mut source.scene.layers {
            source.warnings.append(from_linear(layer, what));
        }
    }
}

/// With --frames the pattern; and the format. Errors: options that do not fit together.
fn asked(args: &Conversion) -> Result<(Option<(Pattern, PathBuf)>, Target)> {
    let pattern = frames_pattern(args)?;
    let target = Target::of(pattern.as_ref().map_or(&args.output, |p| p.1.as_path()))?;
    if args.time.is_some_and(|t| !t.is_finite()) || args.fps.is_some_and(|f| !(0.01..=1000.0).contains(&f)) {
        return Err(Error::input("invalid option `time` or option `fps`")
            .remedy("Give a finite time in seconds, and 0.01 to 1000 frames per second."));
    }
    if args.world && !matches!(target, Target::Dialect(_)) {
        return Err(Error::input(format!("a {} stores the offset separately from its positions", target.name()))
            .at(args.output.display())
            .remedy("Leave option `world` out, or write .ply."));
    }
    if target == Target::Playback && (args.time.is_some() || args.frames) {
        return Err(Error::input("a playback file contains the whole clip")
            .at(args.output.display())
            .remedy("Leave option `time` or option `frames` out."));
    }
    Ok((pattern, target))
}

/// Writes an opened scene by the options.
pub fn write(args: &Conversion, mut source: Source, console: &dyn Listener) -> Result<()> {
    let (pattern, target) = asked(args)?;
    if args.no_provenance {
        source.provenance = None;
    }
    if target != Target::Playback {
        sound::dropped(source.sound.as_ref(), target.name(), console);
    }
    if let Some(degree) = args.sh {
        let had = source.scene.limit_sh(degree.into());
        if had > usize::from(degree) {
            console.result(&format!("spherical harmonics lowered from degree {had} to {degree}"));
        }
    }
    let cameras = first_camera(&source);
    let compared = if target.moves() { baking::compared(&source)? } else { Vec::new() };
    let rotation = rotate(&mut source.scene, args.up_in(target), target, console);
    let turned = |cameras: Vec<Camera>| cameras.into_iter().map(|c| rotated(c, &rotation)).collect::<Vec<_>>();
    let cameras = turned(cameras.into_iter().collect());
    let compared: Vec<(f64, Camera)> = compared.into_iter().map(|(t, c)| (t, rotated(c, &rotation))).collect();
    if target == Target::Playback {
        return bake(source, args, rotation != IDENTITY, console);
    }
    if let (Some(fps), Target::Dialect(_), false) = (args.fps, target, args.frames) {
        source.scene.fps = fps;
    }
    let scene = &source.scene;
    let options = WriteOptions {
        spz_version: args.spz_version,
        cameras,
        exact: args.exact,
        world: args.world,
        units: args.program.map_or(1.0, |p| p.units),
        mirrored: args.program.and_then(|p| p.mirrored),
        ..WriteOptions::default()
    };
    let writer = Writer { target, options };
    if matches!(target, Target::Dialect(_)) && !args.world && scene.offset != [0.0; 3] {
        let [x, y, z] = scene.offset;
        console.warn(&format!(
            "positions are relative to the scene's offset ({x} {y} {z}); .ply can store world positions: option `world`."
        ));
    }
    if let Some((pattern, _)) = pattern {
        return write_frames(args, scene, source.run.as_ref(), &pattern, &writer, console);
    }
    let moment = match args.time {
        Some(time) => Some(time),
        None if target.moves() || !scene.is_moving() => None,
        None => {
            let start = scene.clip[0];
            console.warn(&format!(
                "{} stores one time: {start} s, the start of the clip. Choose another with option `time`, or use {}.",
                target.name(),
                either(&[&["option `frames`"], &written(|d| d.moves)[..]].concat())
            ));
            Some(start)
        }
    };
    let still;
    let whole = match moment {
        Some(time) => {
            still = one_time(scene, time)?;
            console.result(&format!("{} of {} Gaussians at {time} s", grouped(still.len()), grouped(scene.len())));
            &still
        }
        None => scene,
    };
    if whole.is_empty() {
        return Err(Error::input("no Gaussian is active at that time: the file would be empty")
            .at(args.input.display())
            .remedy(format!("Choose option `time` from {} to {} s.", scene.clip[0], scene.clip[1])));
    }
    let (bytes, warnings) = writer.bytes(whole).map_err(|e| e.at(args.input.display()))?;
    warnings.lines().iter().for_each(|w| console.warn(&format!("{w}.")));
    let likeness = match target {
        Target::Dialect(dialect) if dialect.moves => like(&source, dialect, &bytes, &compared, console)?,
        _ => None,
    };
    files::write(&args.output, &bytes)?;
    if let Some(l) = &likeness {
        console.result(&format!(
            "the file against the scene: {:.2} dB over {} renders, {:.2} dB in the worst ({:.2} s)",
            l.psnr, l.pictures, l.worst_psnr, l.worst_time
        ));
    }
    let each = bytes.len() as f64 / whole.len().max(1) as f64;
    console.result(&format!(
        "{}: {} Gaussians, {} ({each:.1} bytes each)",
        target.name(),
        grouped(whole.len()),
        human_bytes(bytes.len() as u64)
    ));
    console.emit(&json!({"type": "converted", "format": target.name(), "gaussians": whole.len(),
        "bytes": bytes.len(), "time": moment, "likeness": likeness, "warnings": warnings.lines()}));
    console.written(&args.output);
    Ok(())
}

/// Similarity of a file to its scene.
fn like(
    source: &Source,
    dialect: Dialect,
    bytes: &[u8],
    shots: &[(f64, Camera)],
    console: &dyn Listener,
) -> Result<Option<Likeness>> {
    let file = dialect.open(bytes)?.scene;
    let likeness = baking::likeness(&source.scene, &file, shots, source.antialias(), &mut |done, total| {
        console.phase("comparing with the scene", done, total);
        true
    })?;
    console.clear();
    Ok(likeness)
}

/// A playback file. The capture's cameras belong to the old axes: a rotated scene is written without them.
fn bake(mut source: Source, args: &Conversion, rotated: bool, console: &dyn Listener) -> Result<()> {
    let title = baking::title(&source, &args.input);
    if rotated {
        (source.run, source.playback) = (None, None);
    }
    baking::bake_into(&source, &title, &args.output, &Baking::default(), console)?;
    Ok(())
}

/// With --frames: the pattern, and a name by which the format is known.
fn frames_pattern(args: &Conversion) -> Result<Option<(Pattern, PathBuf)>> {
    if !args.frames {
        return match Pattern::of(&args.output) {
            Some(_) => Err(Error::input("is a pattern for many files")
                .at(args.output.display())
                .remedy("Add option `frames`, or give the name of one file.")),
            None => Ok(None),
        };
    }
    let pattern = match Pattern::of(&args.output) {
        Some(pattern) => pattern,
        None if Target::of(&args.output).is_ok() => {
            return Err(Error::input("is one file, but option `frames` writes many")
                .at(args.output.display())
                .remedy("Give a folder, or a pattern such as frames/f_%04d.spz."));
        }
        None => match args.program {
            Some(program) => Pattern::in_folder_as(&args.output, program.frame),
            None => Pattern::in_folder(&args.output),
        },
    };
    let example = pattern.file(0);
    Ok(Some((pattern, example)))
}

fn write_frames(
    args: &Conversion,
    scene: &Scene<f32>,
    run: Option<&Run>,
    pattern: &Pattern,
    writer: &Writer,
    console: &dyn Listener,
) -> Result<()> {
    let (fps, times) = sequence::timestamps(scene, args.fps, [args.from, args.to])?;
    let constant = args.constant || args.program.is_some();
    let mut constant = constant.then(|| Constant::new(scene, times.clone())).transpose()?;
    let read = sequence::Read { path: &args.input, run };
    let owned = sequence::take(&[pattern], times.len(), &read, "convert", args.force)?;
    let mut total = 0;
    for (i, &time) in times.iter().enumerate() {
        let params = match &mut constant {
            Some(frames) => frames.frame(i).clone(),
            None => layers::moment(scene, Time(time))?,
        };
        let place = |e: Error| e.at(format_args!("the frame at {time} s"));
        let (bytes, warnings) = writer.bytes(&standing(scene, params)).map_err(place)?;
        if i == 0 {
            warnings.lines().iter().for_each(|w| console.warn(&format!("{FIRST}: {w}.")));
        }
        files::write(&pattern.file(i), &bytes)?;
        total += bytes.len();
        console.phase("converting", i + 1, times.len());
    }
    owned.finished();
    console.clear();
    console.result(&format!(
        "{} files{}, {fps} frames per second, from {:.3} to {:.3} s, {} in total",
        times.len(),
        constant.as_ref().map(|c| format!(" of {} Gaussians each", grouped(c.len()))).unwrap_or_default(),
        times[0],
        times[times.len() - 1],
        human_bytes(total as u64)
    ));
    console.emit(&json!({"type": "converted", "format": writer.target.name(), "files": times.len(), "fps": fps,
        "bytes": total}));
    console.written(&pattern.file(0));
    Ok(())
}

/// Rotates the scene so that the requested axis is up, and returns the rotation that was made.
fn rotate(scene: &mut Scene<f32>, up: Up, target: Target, console: &dyn Listener) -> [[f64; 3]; 3] {
    let custom = match target {
        Target::Dialect(d) => Some(d.up),
        Target::Scene | Target::Playback => None,
    };
    let wanted = match up {
        Up::Format => custom,
        Up::Keep => None,
        Up::Axis(axis) => Some(axis),
    };
    let Some(wanted) = wanted else { return IDENTITY };
    let Some(r) = rotation_between(scene.up, wanted) else {
        console.warn("the scene has no up direction: its axes are not changed.");
        return IDENTITY;
    };
    if 3.0 - (r[0][0] + r[1][1] + r[2][2]) <= NO_ROTATION {
        return IDENTITY;
    }
    let axis = |v: [f64; 3]| format!("({:.3} {:.3} {:.3})", v[0], v[1], v[2]);
    let old = axis(scene.up);
    scene.rotate(&r);
    console.result(&format!(
        "axes rotated: up was {old}, is now {}; option `up` keep leaves them unchanged",
        axis(wanted)
    ));
    r
}

/// The first camera of the data set, if it is available: a sensible viewpoint.
fn first_camera(source: &Source) -> Option<Camera> {
    Some(source.views().ok()?.into_iter().next()?.camera)
}

fn rotated(camera: Camera, r: &[[f64; 3]; 3]) -> Camera {
    let old = camera.cam_from_world.rotation;
    let rotation = std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| old[i][k] * r[j][k]).sum::<f64>()));
    Camera { cam_from_world: Se3 { rotation, ..camera.cam_from_world }, ..camera }
}

/// A scene that is static as `scene` is at `time`.
fn one_time(scene: &Scene<f32>, time: f64) -> Result<Scene<f32>> {
    layers::moment(scene, Time(time)).map(|params| standing(scene, params))
}

/// Static Gaussians in the world of `scene`.
fn standing(scene: &Scene<f32>, params: Params) -> Scene<f32> {
    Scene { up: scene.up, offset: scene.offset, background: scene.background, ..dialect::still(params) }
}

/// Writes one file of a kind.
struct Writer {
    target: Target,
    options: WriteOptions,
}

impl Writer {
    /// A scene as a file; where the format holds one time, the scene is static.
    fn bytes(&self, scene: &Scene<f32>) -> Result<(Vec<u8>, Warnings)> {
        let mut out = Vec::new();
        let warnings = match self.target {
            Target::Dialect(dialect) => {
                let mut warnings = dialect.write(scene, &self.options, &mut out)?;
                if !scene.labels.is_empty() {
                    warnings
                        .add(format!("{} labels are left out: the format does not support them", scene.labels.len()));
                }
                warnings
            }
            Target::Scene | Target::Playback => format::scene::write(scene, &mut out).map(|()| Warnings::default())?,
        };
        Ok((out, warnings))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::format::{gltf, ply, splat, splatv};

    #[test]
    fn formats_are_known_by_their_endings() {
        let of = |name: &str| Target::of(Path::new(name));
        assert_eq!(of("a.PLY").unwrap(), Target::Dialect(ply::DIALECT));
        assert_eq!(of("a.compressed.ply").unwrap(), Target::Dialect(ply::COMPRESSED));
        assert_eq!(of("a.stg.ply").unwrap(), Target::Dialect(ply::STG));
        assert_eq!(of("x/a.splatv").unwrap(), Target::Dialect(splatv::DIALECT));
        assert_eq!(of("a.splat").unwrap(), Target::Dialect(splat::DIALECT));
        assert_eq!(of("a.glb").unwrap(), Target::Dialect(gltf::DIALECT));
        assert_eq!(of("a.spz.glb").unwrap(), Target::Dialect(gltf::COMPRESSED));
        assert_eq!(of("scene.safetensors").unwrap(), Target::Scene);
        assert_eq!([of("a.s4d").unwrap(), of("a.SPLAT4D").unwrap()], [Target::Playback; 2]);
        for (name, word) in [("a.pt", "not written"), ("a.ksplat", ".ply"), ("a", "ending")] {
            assert!(of(name).unwrap_err().to_string().contains(word), "{name}");
        }
    }

    #[test]
    fn a_rotated_camera_sees_the_rotated_point_where_it_was() {
        let camera = Camera::with_fov_y(Se3::look_at([1.0, 2.0, 5.0], [0.0; 3], [0.0, 1.0, 0.0]), 0.8, 40, 30);
        let r = rotation_between([0.0, 1.0, 0.0], [0.3, -0.2, 0.9]).unwrap();
        let x = [0.3, -0.2, 0.4];
        let there = std::array::from_fn(|k| (0..3).map(|l| r[k][l] * x[l]).sum());
        let (a, b) = (camera.project(x).unwrap(), rotated(camera, &r).project(there).unwrap());
        assert!((a.0[0] - b.0[0]).abs() < 1e-9 && (a.0[1] - b.0[1]).abs() < 1e-9 && (a.1 - b.1).abs() < 1e-9);
    }
}
