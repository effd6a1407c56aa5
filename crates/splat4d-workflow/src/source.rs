//! Anything that holds a scene: a run folder, a scene file (`.safetensors`, checkpoints too), a playback file
//! (`.s4d`), a file or folder of another program's Gaussians, or a sequence of such files.

pub mod bundle;

use crate::files::{self, either};
use crate::paths::{Stage, View};
use crate::run_folder::{Run, check_written};
use crate::sequence;
use crate::sound;
use splat4d::format::playback::{self, Index, Kind, Provenance, Sound};
use splat4d::format::ply::PlyInfo;
use splat4d::format::{Dialect, Warnings, dialect, foreign, sog};
use splat4d::layers::{FAR_SHELL, Layer, Scene};
use splat4d::scene::time::DEFAULT_FPS;
use splat4d::scene::{Camera, GEOMETRY};
use splat4d::{Error, ErrorKind, Result, format};
use splat4d_train::output::{Input, check_file, check_free};
use std::path::Path;

/// Share of a cloud, outermost first, that does not count for its size: a few far Gaussians must not shrink the rest.
const OUTLIERS: f64 = 0.1;
/// Share of a cloud's means beyond each side of the box that a first view shows: thin parts stay in it, strays do not.
const BEYOND: f64 = 0.01;
/// Margin around that box.
const ROOM: f64 = 1.1;

/// Remedy that lists the files that can be opened, for errors.
fn remedy() -> String {
    let others = either(&dialect::extensions(|_| true));
    format!("Give a run folder, a scene.safetensors, a checkpoint, a .s4d, or a {others} file.")
}

/// A scene and its origin.
pub struct Source {
    pub scene: Scene<f32>,
    /// The run, where it is one.
    pub run: Option<Run>,
    /// Information that the .ply gave, where it is one.
    pub ply: Option<PlyInfo>,
    /// The start of the playback file, where it is one.
    pub playback: Option<Index>,
    /// Provenance of the playback file, if stated; copied into playback files made of it.
    pub provenance: Option<Provenance>,
    /// What is heard, copied likewise.
    pub sound: Option<Sound>,
    /// Name of a foreign format.
    pub dialect: Option<Dialect>,
    /// Warnings about parts that could not be read, or had to be assumed.
    pub warnings: Warnings,
}

/// Refuses an output that would replace what is read (the scene, a file of its run's capture, or one of `others`) or
/// what any run needs, and one in a folder that another process owns.
pub fn keep(path: &Path, run: Option<&Run>, output: &Path, others: &[&Path]) -> Result<()> {
    // A new file replaces nothing: the capture need not be opened.
    let origin = run.filter(|_| output.is_file()).map(Run::origin).unwrap_or_default();
    let mut inputs = vec![Input { may_hold: run.is_some(), ..Input::new(path, "what is read,") }];
    inputs.extend(origin.inputs());
    inputs.extend(others.iter().map(|file| Input::new(file, "what is read,")));
    check_file(output, &inputs)?;
    check_free(output)?;
    if Run::needs(output) {
        return Err(Error::input("the output would replace a file that its run needs")
            .at(output.display())
            .remedy("Choose another name."));
    }
    Ok(())
}

/// [`keep`] of all files that a command writes, which also must not replace each other.
pub fn keep_all(path: &Path, run: Option<&Run>, outputs: &[&Path], others: &[&Path]) -> Result<()> {
    let place = |file: &Path| {
        let folder = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        (folder.canonicalize().or_else(|_| std::path::absolute(folder)).ok(), file.file_name().map(ToOwned::to_owned))
    };
    for (i, output) in outputs.iter().enumerate() {
        keep(path, run, output, others)?;
        if !files::is_stream(output) && outputs[..i].iter().any(|before| place(before) == place(output)) {
            return Err(Error::input("two outputs have the same name")
                .at(output.display())
                .remedy("Give each a name of its own."));
        }
    }
    Ok(())
}

impl Source {
    /// Whether the run trained it with antialiasing; a file without a run was not.
    pub fn antialias(&self) -> bool {
        self.run.as_ref().and_then(|r| r.recipe().ok()).is_some_and(|r| r.appearance.antialias)
    }

    /// Opens a run, a file or a sequence.
    pub fn open(path: &Path) -> Result<Self> {
        Self::open_at(path, DEFAULT_FPS)
    }

    /// The same; a sequence of files has `fps` a second.
    pub fn open_at(path: &Path, fps: f64) -> Result<Self> {
        Self::open_with(path, fps, None)
    }

    /// The same; models of other programs, whose clock has no seconds, get this clip: that of the capture they were trained on.
    pub fn open_on(path: &Path, clip: [f64; 2]) -> Result<Self> {
        Self::open_with(path, DEFAULT_FPS, Some(clip))
    }

    fn open_with(path: &Path, fps: f64, clip: Option<[f64; 2]>) -> Result<Self> {
        if !path.exists() && sequence::Pattern::of(path).is_some() {
            return open_sequence(path, fps);
        }
        if path.is_dir() && !Run::is(path) {
            check_written(path)?;
            if path.join(sog::META).is_file() {
                return bundle::open_sog(path);
            }
            return bundle::open(path, fps, clip)?.map_or_else(|| open_sequence(path, fps), Ok);
        }
        if path.is_dir() {
            let run = Run::open(path)?;
            let scene = read_scene(&run.scene_file()?)?;
            let sound = sound::of_run(&run);
            return Ok(Self { run: Some(run), ..Self::own(scene) }.with_sound(sound));
        }
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        if path.file_name().is_some_and(|n| n == sog::META) {
            return bundle::open_sog(folder);
        }
        if path.file_name().is_some_and(|n| n == sog::levels::LEVELS) {
            return bundle::open(folder, fps, clip).map(|s| s.expect("the folder has the file"));
        }
        let bytes = files::read(path)?;
        if bytes.starts_with(&playback::MAGIC) {
            let index = Index::parse(&bytes, Some(bytes.len() as u64)).map_err(|e| e.at(path.display()))?;
            let scene = playback::read(&bytes).map_err(|e| e.at(path.display()))?;
            let provenance = playback::provenance(&bytes).map_err(|e| e.at(path.display()))?;
            let mut source = Self { provenance, ..Self::own(scene) };
            // Everything else was read, and its checksums compared.
            if index.sections.iter().any(|e| e.kind == Kind::Poster && !e.is_intact(&bytes)) {
                source.warnings.add("the poster is damaged (its checksum is wrong), the scene is not: bake it again");
            }
            return Ok(Self { playback: Some(index), ..source }.with_sound(playback::sound(&bytes)));
        }
        if let Some(source) = bundle::open_archive(path, &bytes)? {
            return Ok(source);
        }
        let name = path.file_name().map(|n| n.to_string_lossy()).unwrap_or_default();
        let kind = dialect_of(path, &bytes);
        let trained = match kind.and_then(|kind| bundle::trained(kind, path, &bytes, clip)) {
            Some(Ok(opened)) => {
                return Ok(Self {
                    dialect: Some(bundle::with_network()),
                    warnings: opened.warnings,
                    ..Self::own(opened.scene)
                });
            }
            Some(Err(error)) if error.kind() != ErrorKind::Unsupported => return Err(error),
            Some(Err(error)) => Some(error),
            None => None,
        };
        let opened = match kind {
            Some(kind) => bundle::open_file(kind, path, &bytes, clip).map(|o| Self {
                ply: o.ply,
                dialect: Some(kind),
                warnings: o.warnings,
                ..Self::own(o.scene)
            }),
            None if is_own_format(&bytes) => format::scene::read(&bytes).map(Self::own).map_err(|e| e.remedy(remedy())),
            None => Err(foreign::unread(&name, &bytes).unwrap_or_else(|| {
                Error::input("unknown format: its first bytes match none that splat4d reads").remedy(remedy())
            })),
        };
        let mut source = opened.map_err(|e| e.at(path.display()))?;
        if let Some(network) = bundle::network_of(path).filter(|_| source.ply.is_some()) {
            let why = trained.map_or(String::new(), |e| format!(" ({})", e.cause()));
            source.warnings.add(format!(
                "{} belongs to these Gaussians: a network that splat4d does not read{why} moves or generates them, so this is not \
                 the scene as trained. Export it as a sequence of .ply files",
                network.display()
            ));
        }
        Ok(source)
    }

    /// Leaves out Gaussians whose numbers are not finite: files of other programs have such, and no writer accepts
    /// them. Reports what else of a .ply is lost: times and velocities of a moving scene, for instance.
    pub fn finite(mut self) -> Self {
        let unread = self.ply.as_ref().map_or(&[][..], |ply| &ply.extra_properties);
        if !unread.is_empty() {
            self.warnings.add(format!("properties of the .ply that are not read: {}", unread.join(", ")));
        }
        let all = self.scene.len();
        let dropped = self.scene.drop_non_finite();
        self.warnings.counted(dropped, all, "contain NaN or infinity and were left out");
        self
    }

    /// A scene of our own, without a run.
    pub fn own(scene: Scene<f32>) -> Self {
        let warnings = Warnings::default();
        Self { scene, run: None, ply: None, playback: None, provenance: None, sound: None, dialect: None, warnings }
    }

    /// The same with its sound. One that cannot be read is a warning: the scene is complete without it.
    fn with_sound(mut self, sound: Result<Option<Sound>>) -> Self {
        match sound {
            Ok(sound) => self.sound = sound,
            Err(e) => self.warnings.add(format!("the sound is left out: {e}")),
        }
        self
    }

    /// Refuses an output that would replace what was read.
    pub fn keep(&self, path: &Path, output: &Path, others: &[&Path]) -> Result<()> {
        self.keep_all(path, &[output], others)
    }

    /// The same of several outputs, which also must not replace each other.
    pub fn keep_all(&self, path: &Path, outputs: &[&Path], others: &[&Path]) -> Result<()> {
        keep_all(path, self.run.as_ref(), outputs, others)
    }

    /// The data set's cameras; those that a playback file brings along; empty for other bare files.
    pub fn views(&self) -> Result<Vec<View>> {
        if let Some(index) = &self.playback {
            let time = index.meta.clip[0];
            let fits = |c: &Camera| c.width.max(c.height) <= crate::camera_file::MAX_SIDE;
            let views = index.meta.cameras.iter().filter_map(|c| {
                let camera = c.camera().filter(fits)?;
                Some(View { camera, name: c.name.clone(), time, held: false })
            });
            return Ok(views.collect());
        }
        self.run.as_ref().map_or_else(|| Ok(Vec::new()), Run::views)
    }

    /// The place for orbits.
    pub fn stage(&self, views: &[View]) -> Stage {
        if !views.is_empty() {
            return Stage::of_views(views, self.scene.up);
        }
        let (center, extent) = inner_box(&self.scene);
        Stage::of_cloud(center, extent, self.scene.up)
    }
}

/// Whether a file may be safetensors: eight bytes of length, then JSON.
fn is_own_format(bytes: &[u8]) -> bool {
    bytes.get(8) == Some(&b'{')
}

/// By content; by its ending only if the content does not identify it.
fn dialect_of(path: &Path, bytes: &[u8]) -> Option<Dialect> {
    let name = path.file_name().map(|n| n.to_string_lossy()).unwrap_or_default();
    Dialect::of_file(&name, bytes)
}

/// Files of one frame each.
fn open_sequence(path: &Path, fps: f64) -> Result<Source> {
    let found = sequence::frames(path)?;
    let (mut frames, mut kind, mut warnings) = (Vec::with_capacity(found.files.len()), None, Warnings::default());
    let mut up = None;
    // Frames far from the origin may each have an offset: that of the first is the scene's.
    let mut offset = None;
    if let Some(newest) = &found.snapshots {
        warnings.add(format!(
            "the numbers of these files are steps of a training rather than frames: if so, give the newest, {}",
            newest.display()
        ));
    }
    if let Some(missing) = &found.missing {
        warnings.add(format!("frames are missing: {missing}. The scene is empty at their times"));
    }
    for file in &found.files {
        let bytes = files::read(file)?;
        let own = dialect_of(file, &bytes).filter(|d| !d.moves);
        let Some(own) = own.filter(|d| kind.is_none_or(|k: Dialect| k.up == d.up)) else {
            return Err(Error::input("invalid frame of a sequence: it differs from the others")
                .at(file.display())
                .remedy(format!("Frames are {} files of one kind.", either(&sequence::endings()))));
        };
        kind = Some(own);
        let mut opened = own.open(&bytes).map_err(|e| e.at(file.display()))?;
        warnings.append(opened.warnings);
        if *up.get_or_insert(opened.scene.up) != opened.scene.up {
            return Err(Error::input("the frame's axes differ from those of the previous frames")
                .at(file.display())
                .remedy("Convert all frames with the same option `up`."));
        }
        let mut params = std::mem::take(&mut opened.scene.layers[0].params);
        let first = *offset.get_or_insert(opened.scene.offset);
        let off = std::array::from_fn::<f64, 3, _>(|k| opened.scene.offset[k] - first[k]);
        if off != [0.0; 3] {
            let table = &mut params[GEOMETRY];
            (0..table.rows()).for_each(|row| table.add(row, 0, off.map(|x| x as f32)));
        }
        frames.push(params);
    }
    let up = up.unwrap_or(dialect::Y_DOWN);
    let joined = format::sequence::join_at(&frames, &found.numbers, fps, up).map_err(|e| e.at(path.display()))?;
    let scene = Scene { offset: offset.unwrap_or_default(), ..joined };
    Ok(Source { dialect: kind, warnings, ..Source::own(scene) })
}

/// Reads a scene file.
pub fn read_scene(path: &Path) -> Result<Scene<f32>> {
    let bytes = files::read(path)?;
    format::scene::read(&bytes).map_err(|e| e.at(path.display()))
}

/// Refuses a scene without Gaussians.
pub fn not_empty(scene: &Scene<f32>, path: &Path) -> Result<()> {
    if scene.is_empty() {
        return Err(Error::input("contains no Gaussians")
            .at(path.display())
            .remedy("Train it again, or give another file."));
    }
    Ok(())
}

/// All means that are numbers, but for those of the far shell.
fn means(scene: &Scene<f32>) -> Vec<[f64; 3]> {
    let near = scene.layers.iter().filter(|l| l.name != FAR_SHELL);
    near.flat_map(Layer::means).filter(|m| m.iter().all(|x| x.is_finite())).collect()
}

/// Least and greatest coordinate of all means but the outermost.
fn sides(means: &[[f64; 3]]) -> [[f64; 2]; 3] {
    std::array::from_fn(|k| {
        let mut values: Vec<f64> = means.iter().map(|m| m[k]).collect();
        values.sort_by(f64::total_cmp);
        let out = (values.len() as f64 * BEYOND) as usize;
        [values[out], values[values.len() - 1 - out]]
    })
}

/// Where a scene's Gaussians are, without a far shell: a box and as much around it as it is long.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Surroundings([[f64; 2]; 3]);

impl Surroundings {
    /// Of a scene in memory; `None`: it has no far shell.
    pub(crate) fn of(scene: &Scene<f32>) -> Option<Self> {
        let means = means(scene);
        let shell = scene.layers.iter().any(|l| l.name == FAR_SHELL);
        (shell && !means.is_empty()).then(|| Self::around(sides(&means)))
    }

    /// The same of a file: a playback file states the box of what is near.
    pub(crate) fn of_source(source: &Source) -> Option<Self> {
        let stated = source.playback.as_ref().and_then(|index| index.meta.bounds);
        let stated = stated.map(|[low, high]| Self::around([0, 1, 2].map(|k| [low[k], high[k]])));
        Self::of(&source.scene).or(stated)
    }

    fn around(sides: [[f64; 2]; 3]) -> Self {
        let longest = sides.iter().map(|[low, high]| high - low).fold(0.0, f64::max);
        Self(sides.map(|[low, high]| [low - longest, high + longest]))
    }

    /// Whether a position is in it.
    pub(crate) fn holds(&self, x: [f64; 3]) -> bool {
        (0..3).all(|k| (self.0[k][0]..=self.0[k][1]).contains(&x[k]))
    }
}

/// Middle and half the diagonal of the box of all means but the outermost.
fn inner_box(scene: &Scene<f32>) -> ([f64; 3], f64) {
    let means = means(scene);
    if means.is_empty() {
        return ([0.0; 3], 1.0);
    }
    let sides = sides(&means);
    let half = sides.map(|[low, high]| 0.5 * (high - low));
    (sides.map(|[low, high]| 0.5 * (low + high)), ROOM * splat4d::math::se3::norm(half).max(1e-6))
}

/// Middle (medians) and radius of the inner part of all means.
pub fn cloud(scene: &Scene<f32>) -> ([f64; 3], f64) {
    let means = means(scene);
    if means.is_empty() {
        return ([0.0; 3], 1.0);
    }
    let median = |k: usize| {
        let mut values: Vec<f64> = means.iter().map(|m| m[k]).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let center = [median(0), median(1), median(2)];
    let mut far: Vec<f64> =
        means.iter().map(|m| splat4d::math::se3::norm(splat4d::math::se3::sub(*m, center))).collect();
    far.sort_by(f64::total_cmp);
    let index = ((far.len() as f64 * (1.0 - OUTLIERS)) as usize).min(far.len() - 1);
    (center, far[index].max(1e-6))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_names_no_file_outside_its_folder() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["../x.webp", "/etc/hostname", "a/../../x.webp"] {
            let meta = format!(r#"{{"version": 2, "count": 1, "means": {{"files": ["{name}"]}}}}"#);
            std::fs::write(folder.path().join(sog::META), meta).unwrap();
            let error = Source::open(folder.path()).err().map(|e| e.to_string()).unwrap_or_default();
            assert!(error.contains("outside its folder"), "{name}: {error}");
        }
    }

    #[test]
    fn unread_times_of_other_programs_plys_are_reported() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("4d.ply");
        let names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 t scale_t";
        let header: String = names.split(' ').map(|name| format!("property float {name}\n")).collect();
        let row = "0 0 4 0 0 0 1 -3 -3 -3 1 0 0 0 0.5 -1\n";
        std::fs::write(&file, format!("ply\nformat ascii 1.0\nelement vertex 1\n{header}end_header\n{row}")).unwrap();
        let said = Source::open(&file).unwrap().finite().warnings.lines().join("\n");
        assert!(said.contains("not read: t, scale_t"), "{said}");
    }

    #[test]
    fn levels_of_detail_are_named_by_folder_and_by_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(sog::levels::LEVELS);
        std::fs::write(&file, "{}").unwrap();
        for path in [folder.path(), &file] {
            let error = Source::open(path).err().map(|e| e.to_string()).unwrap_or_default();
            assert!(error.contains(sog::levels::LEVELS), "{error}");
        }
    }
}
