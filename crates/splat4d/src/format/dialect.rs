//! A dialect: its name, its customs, how a file of it is recognized, read and written. Each declares itself in its own
//! file, and [`DIALECTS`] lists them.

use super::DIALECTS;
use super::mend::{self, Mended};
use super::warnings::Warnings;
use crate::layers::{Layer, Scene, mirror, moment};
use crate::motion::Still;
use crate::scene::params::LOG_SCALE;
use crate::scene::time::DEFAULT_FPS;
use crate::scene::{Camera, GEOMETRY, LifeKind, Params, Time};
use crate::{Error, ErrorKind, Result};
use std::fmt;
use std::io::Write;
use std::sync::Arc;

/// Up in worlds whose y points down, as those of .ply.
pub const Y_DOWN: [f64; 3] = [0.0, -1.0, 0.0];
/// Upwards in files whose y axis points up (glTF).
pub(crate) const Y_UP: [f64; 3] = [0.0, 1.0, 0.0];

/// Version of .spz that is written by default: the one that most programs open.
pub(crate) const SPZ_VERSION: u32 = 3;

/// Files of Gaussians that other programs share. docs/formats.md lists what each holds and assumes.
#[derive(Clone, Copy)]
#[non_exhaustive]
pub struct Dialect {
    /// Its common name.
    pub name: &'static str,
    /// How names of its files end, in lower case, dot included. It may end with another one's: the longer one counts.
    pub ending: &'static str,
    /// The conventional up direction where the file does not state it.
    pub up: [f64; 3],
    /// Whether it holds a moving scene.
    pub moves: bool,
    /// Whether bytes are such a file; `None`: they have no mark, and only the ending decides.
    pub mark: Option<fn(&[u8]) -> bool>,
    /// Reads a file; [`Dialect::open`] states which way is up.
    pub read: fn(&[u8]) -> Result<Opened>,
    /// Writer.
    pub writer: Writer,
    /// Whether it can be written with positions of the world, in double precision ([`WriteOptions::world`]).
    pub world: bool,
    /// Whether the specification states which way is up.
    pub fixed_axes: bool,
    /// Whether files or the specification state it: programs rotate them, and mirror them where they are left-handed.
    pub(crate) states_up: bool,
}

/// How a dialect is written. Writers report what was left out.
#[derive(Clone, Copy)]
pub enum Writer {
    /// One time.
    Moment(fn(&Params, &WriteOptions, &mut dyn Write) -> Result<Warnings>),
    /// A moving scene.
    Moving(fn(&Scene<f32>, &WriteOptions, &mut dyn Write) -> Result<Warnings>),
    /// Not at all: what to do in its place.
    None(&'static str),
}

/// Options of some of the writers; the others pass over them.
#[derive(Clone, Debug)]
pub struct WriteOptions {
    /// Version of .spz, one of 2, 3 or 4.
    pub spz_version: u32,
    /// Views that a player may offer, in the axes of the scene.
    pub cameras: Vec<Camera>,
    /// Refuse Gaussians whose fade in time the dialect cannot express exactly, instead of fitting one.
    pub exact: bool,
    /// Which way is up, for dialects whose files specify it; `Dialect::write` takes it from the scene.
    pub up: [f64; 3],
    /// The scene's offset; `Dialect::write` sets it.
    pub offset: [f64; 3],
    /// Write positions of the world: the offset is added, in double precision. Only .ply can.
    pub world: bool,
    /// Units of the file in one of the scene, where files do not state which way is up.
    pub units: f64,
    /// Axis along which such files are mirrored, for left-handed programs.
    pub mirrored: Option<usize>,
}

impl Default for WriteOptions {
    fn default() -> Self {
        Self {
            spz_version: SPZ_VERSION,
            cameras: Vec::new(),
            exact: false,
            up: Y_DOWN,
            offset: [0.0; 3],
            world: false,
            units: 1.0,
            mirrored: None,
        }
    }
}

/// Metadata of a .ply, in addition to its numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlyInfo {
    /// Rows.
    pub gaussians: usize,
    /// Degree of the spherical harmonics, 0-3.
    pub sh_degree: usize,
    /// Rows that hold a NaN or an infinity without a meaning; they are kept.
    pub non_finite_rows: usize,
    /// Infinities that mean something, now finite.
    pub mended: Mended,
    /// Whether base colours are RGB (`red green blue`), not coefficients.
    pub rgb: bool,
    /// The offset subtracted from positions in double precision that are far from the origin, or stated by the file
    /// was.
    pub offset: [f64; 3],
    /// Whether the numbers were quantised (PlayCanvas' compressed layout).
    pub compressed: bool,
    /// Assumptions and unread content, in sentences without a full stop.
    pub assumed: Vec<String>,
    /// The header's comments.
    pub comments: Vec<String>,
    /// Properties of a Gaussian that were ignored; normals are not listed.
    pub extra_properties: Vec<String>,
}

/// An opened file.
#[derive(Debug)]
pub struct Opened {
    /// The scene, in the file's own axes; `up` states their orientation.
    pub scene: Scene<f32>,
    /// Which way is up, where the file itself states so.
    pub up: Option<[f64; 3]>,
    /// Metadata of a .ply.
    pub ply: Option<PlyInfo>,
    /// Warnings: values that could not be read or had to be assumed.
    pub warnings: Warnings,
}

impl From<(Scene<f32>, Warnings)> for Opened {
    fn from((scene, warnings): (Scene<f32>, Warnings)) -> Self {
        Self { scene, up: None, ply: None, warnings }
    }
}

impl From<(Params, Warnings)> for Opened {
    fn from((params, warnings): (Params, Warnings)) -> Self {
        Self { scene: still(params), up: None, ply: None, warnings }
    }
}

/// A scene of one layer that is static; its `up` is not set.
pub fn still(params: Params) -> Scene<f32> {
    let layer = Layer::new("gaussians", params, Arc::new(Still), LifeKind::Infinite);
    Scene { layers: vec![layer], fps: DEFAULT_FPS, ..Scene::default() }
}

impl Dialect {
    /// The kind of a file by its content. `None`: none of these, or of one without a mark.
    pub(crate) fn of(bytes: &[u8]) -> Option<Self> {
        DIALECTS.iter().rev().find(|d| d.mark.is_some_and(|mark| mark(bytes))).copied()
    }

    /// The kind of a file by its content; by the ending of its name where the content does not decide.
    pub fn of_file(name: &str, bytes: &[u8]) -> Option<Self> {
        Self::of(bytes).or_else(|| Self::by_ending(name).filter(|d| d.mark.is_none()))
    }

    /// The kind of a file by its name.
    pub fn by_ending(name: &str) -> Option<Self> {
        let name = name.to_ascii_lowercase();
        DIALECTS.iter().filter(|d| name.ends_with(d.ending)).max_by_key(|d| d.ending.len()).copied()
    }

    /// The last part of its ending: `.ply` of `.compressed.ply`.
    pub(crate) fn extension(&self) -> &'static str {
        &self.ending[self.ending.rfind('.').unwrap_or(0)..]
    }

    /// Opens a file. Errors: its reader's.
    pub fn open(&self, bytes: &[u8]) -> Result<Opened> {
        (self.read)(bytes).map(|opened| self.finish(opened))
    }

    /// What [`open`](Self::open) does after reading: sets the up direction and repairs values at the edge. For files that are
    /// read with others next to them.
    pub(crate) fn finish(&self, mut opened: Opened) -> Opened {
        opened.scene.up = opened.up.unwrap_or(self.up);
        let (of, mut mended) = (opened.scene.len(), opened.ply.as_ref().map(|p| p.mended).unwrap_or_default());
        for layer in &mut opened.scene.layers {
            mended += Mended::of(&mut layer.params);
            mend::warn_coarse(&layer.params, &mut opened.warnings);
        }
        mended.report(of, &mut opened.warnings);
        opened
    }

    /// Whether it can be written.
    pub fn is_written(&self) -> bool {
        !matches!(self.writer, Writer::None(_))
    }

    /// Errors where it cannot be written.
    fn check_written(&self) -> Result<()> {
        let Writer::None(remedy) = self.writer else { return Ok(()) };
        Err(Error::new(ErrorKind::Unsupported, format!("{} is read, but not written", self.name)).remedy(remedy))
    }

    /// Writes a scene, whose axes are not changed; a dialect without motion gets the clip's first time. Returns what
    /// was left out.
    ///
    /// Errors: it is only read; it cannot hold the scene, or what it should of it; a number is NaN or infinite; the
    /// sink's.
    pub fn write(&self, scene: &Scene<f32>, options: &WriteOptions, out: &mut dyn Write) -> Result<Warnings> {
        scene.check_finite()?;
        let options = WriteOptions { up: scene.up, offset: scene.offset, ..options.clone() };
        if options.world && !self.world {
            let what = format!("{} has no place for positions in double precision", self.name);
            return Err(Error::new(ErrorKind::Unsupported, what)
                .remedy("Leave the offset out (no --world), or write .ply, scene.safetensors or .s4d."));
        }
        match self.writer {
            Writer::Moment(write) => {
                let mut params = moment(scene, Time(scene.clip[0]))?;
                params.check_finite()?;
                if !self.states_up {
                    fit(&mut params, &options);
                }
                write(&params, &options, out)
            }
            Writer::Moving(_) if !self.states_up && (options.units != 1.0 || options.mirrored.is_some()) => {
                let what = format!("{} can be written neither mirrored nor in another unit", self.name);
                Err(Error::new(ErrorKind::Unsupported, what).remedy("Write .usdz, or numbered files (--frames)."))
            }
            Writer::Moving(write) => write(scene, &options, out),
            Writer::None(_) => self.check_written().map(|()| Warnings::default()),
        }
    }
}

/// Gives static Gaussians the unit and handedness of a program.
fn fit(params: &mut Params, options: &WriteOptions) {
    let (units, log) = (options.units as f32, options.units.ln() as f32);
    let table = &mut params[GEOMETRY];
    for row in (0..table.rows()).filter(|_| options.units != 1.0) {
        let mean = table.read::<3>(row, 0);
        table.write(row, 0, mean.map(|x| x * units));
        table.add(row, LOG_SCALE, [log; 3]);
    }
    if let Some(axis) = options.mirrored {
        mirror(params, axis);
    }
}

impl PartialEq for Dialect {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
    }
}

impl Eq for Dialect {}

impl fmt::Debug for Dialect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Dialect").field(&self.name).finish()
    }
}

/// The last parts of endings, each once, of the dialects for which `which` holds: for messages that list them.
pub fn extensions(which: impl Fn(&Dialect) -> bool) -> Vec<&'static str> {
    let mut out = Vec::new();
    for extension in DIALECTS.iter().filter(|d| which(d)).map(Dialect::extension) {
        if !out.contains(&extension) {
            out.push(extension);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::kinematic::tests::moving as moving_scene;
    use crate::format::samples::gaussians;
    use crate::format::{checkpoint, dynamic3d, ksplat, ply, splat, splats4d, splatv, spz, usd};
    use crate::scene::SH;

    /// A scene that every dialect can hold.
    fn sample(moves: bool) -> Scene<f32> {
        if moves { moving_scene(20, LifeKind::GaussOne, 3, true) } else { still(gaussians(20, 4)) }
    }

    #[test]
    fn every_dialect_is_written_recognised_and_opened() {
        // What is not written needs a file made by hand.
        let by_hand = [
            (dynamic3d::DIALECT, dynamic3d::tests::sample(), 2),
            (checkpoint::DIALECT, checkpoint::tests::sample(&gaussians(20, 4)), 20),
            (splats4d::DIALECT, splats4d::tests::sample(), 21),
            (ksplat::DIALECT, ksplat::tests::sample(&gaussians(20, 4), 1, 1), 20),
        ];
        for dialect in DIALECTS {
            let (scene, mut bytes, mut count) = (sample(dialect.moves), Vec::new(), 20);
            let written = dialect.write(&scene, &WriteOptions::default(), &mut bytes);
            assert_eq!(written.is_ok(), dialect.is_written(), "{dialect:?}: {written:?}");
            if let Some((_, file, rows)) = by_hand.iter().find(|(d, ..)| d == dialect) {
                (bytes, count) = (file.clone(), *rows);
            }
            let name = format!("SOME{}", dialect.ending.to_ascii_uppercase());
            assert_eq!(Dialect::of(&bytes), dialect.mark.map(|_| *dialect));
            assert_eq!(Dialect::of_file(&name, &bytes), Some(*dialect));
            let opened = dialect.open(&bytes).unwrap();
            // Animated USD has a row for every Gaussian and frame.
            let rows = if [usd::TEXT, usd::ARCHIVE].contains(dialect) {
                opened.scene.len().min(count)
            } else {
                opened.scene.len()
            };
            assert_eq!((rows, opened.scene.up), (count, dialect.up), "{dialect:?}");
            assert_eq!(opened.scene.is_moving(), dialect.moves, "{dialect:?}");
            assert_eq!(
                matches!(dialect.writer, Writer::Moving(_)),
                dialect.moves && dialect.is_written(),
                "{dialect:?}"
            );
            assert!(opened.ply.is_some() || ![ply::DIALECT, ply::COMPRESSED].contains(dialect), "{dialect:?}");
            for cut in (0..bytes.len()).step_by(1 + bytes.len() / 50) {
                let _ = dialect.open(&bytes[..cut]);
            }
        }
        assert_eq!(Dialect::of(b""), None);
    }

    #[test]
    fn no_dialect_writes_numbers_that_are_not_finite() {
        for dialect in DIALECTS.iter().filter(|d| d.is_written()) {
            for bad in [f32::NAN, f32::INFINITY] {
                let (mut scene, mut bytes) = (sample(dialect.moves), Vec::new());
                scene.layers[0].params[GEOMETRY].set(7, 1, bad);
                let message = dialect.write(&scene, &WriteOptions::default(), &mut bytes).unwrap_err().to_string();
                assert!(
                    message.contains("finite") && message.contains("Gaussian 7") && bytes.is_empty(),
                    "{dialect:?}: {message}"
                );
            }
        }
    }

    #[test]
    fn finite_numbers_stay_finite_however_large() {
        for dialect in DIALECTS.iter().filter(|d| d.is_written()) {
            let (mut scene, mut bytes) = (sample(dialect.moves), Vec::new());
            // Finite as a logarithm, infinite as a length; and colours whose sums swallow all others.
            let params = &mut scene.layers[0].params;
            params[GEOMETRY].set(7, LOG_SCALE, 1000.0);
            (0..2).for_each(|k| params[SH].set(3 + k, 0, [3e38, -3e38][k]));
            if dialect.write(&scene, &WriteOptions::default(), &mut bytes).is_err() {
                continue;
            }
            let opened = dialect.open(&bytes).unwrap_or_else(|e| panic!("{dialect:?}: {e}"));
            opened.scene.check_finite().unwrap_or_else(|e| panic!("{dialect:?}: {e}"));
        }
    }

    #[test]
    fn names_and_extensions_are_distinguished() {
        for (i, a) in DIALECTS.iter().enumerate() {
            assert!(a.ending.starts_with('.') && a.ending == a.ending.to_ascii_lowercase(), "{a:?}");
            assert_eq!(Dialect::by_ending(&format!("x{}", a.ending)), Some(*a));
            for b in &DIALECTS[..i] {
                assert!(a.name != b.name && a.ending != b.ending, "{a:?} and {b:?}");
            }
        }
        assert_eq!(Dialect::by_ending("a.COMPRESSED.ply"), Some(ply::COMPRESSED));
        assert_eq!(Dialect::by_ending("a.b.ply"), Some(ply::DIALECT));
        assert_eq!(Dialect::by_ending("ply"), None);
        // An ending counts only where nothing else decides.
        assert_eq!(Dialect::of_file("a.splat", b"GIF89a"), Some(splat::DIALECT));
        assert_eq!(Dialect::of_file("a.splat", &splatv::MAGIC), Some(splatv::DIALECT));
        assert_eq!(Dialect::of_file("a.ply", b"GIF89a"), None);
        assert_eq!((ply::COMPRESSED.extension(), extensions(|d| d.extension() == ".ply")), (".ply", vec![".ply"]));
    }

    #[test]
    fn every_version_of_spz_is_recognised_by_its_bytes() {
        for spz_version in spz::VERSIONS {
            let mut bytes = Vec::new();
            let options = WriteOptions { spz_version, ..WriteOptions::default() };
            spz::DIALECT.write(&sample(false), &options, &mut bytes).unwrap();
            assert_eq!(Dialect::of(&bytes), Some(spz::DIALECT));
            assert!(spz::read(&bytes).is_ok(), "version {spz_version}");
        }
    }
}
