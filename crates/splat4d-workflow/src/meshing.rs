//! A scene as triangle meshes, one per time: depth, normals and colours that cameras see are fused into signed distances
//! on a grid, whose surface is extracted.

mod depth;
mod fusion;
mod mesh;
mod solid;
mod surface;

use crate::draw::antialias;
use crate::events::Listener;
use crate::exporting::Frames;
use crate::files::{self, either, grouped};
use crate::run_folder::Run;
use crate::sequence::{self, Pattern};
use crate::source::{Source, Surroundings, not_empty};
use depth::{columns, in_grid, in_world, inverses, map, views};
use fusion::Shell;
pub use mesh::Mesh;
use rayon::prelude::*;
use serde_json::json;
use splat4d::device;
use splat4d::layers::rotation_between;
use splat4d::math::se3::{self, mat_vec};
use splat4d::play::Player;
use splat4d::render::{Image, RenderConfig, Shot};
use splat4d::scene::splats::SPLAT_OPACITY;
use splat4d::scene::{Camera, Splats, Time};
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Side of a voxel by default, scene units.
pub const VOXEL: f64 = 0.02;
/// Share of the Gaussians' centres beyond each side of the box that a mesh covers, and its margin.
const BEYOND: f64 = 0.005;
const MARGIN: f64 = 0.1;
/// Gaussians below this opacity do not count for the box.
const LEAST_OPACITY: f32 = 0.1;
/// Voxels that fit into the box at least.
const LEAST_VOXELS: f64 = 8.0;
/// Names of a sequence in a folder.
const NAME: &str = "frame_%05d.glb";
/// Up in the grid and in glTF files.
const GRID_UP: [f64; 3] = [0.0, 0.0, 1.0];
const GLTF_UP: [f64; 3] = [0.0, 1.0, 0.0];

/// Format of a mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeshFormat {
    /// glTF 2.0, y up.
    Glb,
    /// Wavefront, in the scene's axes.
    Obj,
    /// Binary .ply with faces, in the scene's axes.
    Ply,
}

impl MeshFormat {
    const ALL: [Self; 3] = [Self::Glb, Self::Obj, Self::Ply];

    /// Its ending.
    pub fn ending(self) -> &'static str {
        match self {
            Self::Glb => "glb",
            Self::Obj => "obj",
            Self::Ply => "ply",
        }
    }

    fn of(path: &Path) -> Result<Self> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
        Self::ALL.into_iter().find(|f| f.ending() == ending).ok_or_else(|| {
            Error::input(format!("expected the ending {}, found .{ending}", either(&Self::ALL.map(Self::ending))))
                .at(path.display())
                .remedy("Use option `mesh` NAME.glb for one time, or NAME.%05d.glb or a folder for a sequence.")
        })
    }
}

/// Options of [`write()`] and [`Mesher`].
#[derive(Clone, Copy, Debug)]
pub struct MeshOptions {
    /// Side of a voxel, scene units.
    pub voxel: f64,
    /// Close the surface.
    pub watertight: bool,
    /// Close the surface, fill the floor, and leave colours and normals out.
    pub collision: bool,
    /// The time of one mesh, seconds; none: the clip's start.
    pub time: Option<f64>,
    /// Times of a sequence.
    pub frames: Frames,
    /// Replace a mesh, or a sequence that splat4d wrote to the folder.
    pub force: bool,
}

impl Default for MeshOptions {
    fn default() -> Self {
        Self { voxel: VOXEL, watertight: false, collision: false, time: None, frames: Frames::default(), force: false }
    }
}

/// Makes meshes of a scene.
pub struct Mesher<'a> {
    player: Player<'a>,
    cameras: Vec<Camera>,
    /// Depth is that of centres, as the depth loss measures it.
    centers: bool,
    options: MeshOptions,
    config: RenderConfig,
    grid_from_world: [[f64; 3]; 3],
    /// Where surfaces can be; none: everywhere.
    near: Option<Surroundings>,
}

impl<'a> Mesher<'a> {
    /// Errors: a voxel size that is not a positive number; cameras that cannot be read.
    pub fn new(source: &'a Source, options: &MeshOptions) -> Result<Self> {
        if !(options.voxel.is_finite() && options.voxel > 0.0) {
            return Err(Error::input(format!("invalid option `voxel`: {}", options.voxel))
                .remedy(format!("Give the side of a voxel in scene units, such as {VOXEL}.")));
        }
        let views = source.views()?;
        let mut cameras: Vec<Camera> = Vec::new();
        let trained = views.iter().any(|v| !v.held);
        for view in views.into_iter().filter(|v| !(trained && v.held)) {
            if !cameras.iter().any(|c| c.cam_from_world == view.camera.cam_from_world) {
                cameras.push(view.camera);
            }
        }
        let grid_from_world = rotation_between(source.scene.up, GRID_UP).unwrap_or(IDENTITY);
        let player = Player::of_scene(&source.scene);
        let centers = source.run.as_ref().is_some_and(trained_with_depth);
        let config = RenderConfig { antialias: antialias(source.antialias()), ..RenderConfig::default() };
        let near = Surroundings::of_source(source);
        Ok(Self { player, cameras, centers, options: *options, config, grid_from_world, near })
    }

    /// Where the surfaces are seen from, in words.
    fn seen_from(&self) -> String {
        match self.cameras.len() {
            0 => "the file has no cameras: surfaces are those that views around the scene see".into(),
            n if self.centers => {
                format!("surfaces as {n} camera poses see them, with the depth that depth maps trained")
            }
            n => format!("surfaces as {n} camera poses see them"),
        }
    }

    /// The mesh at a time, in the scene's axes; empty where no surface is seen.
    ///
    /// Errors: voxels that are too small or too large for the scene.
    pub fn at(&mut self, time: f64) -> Result<Mesh> {
        let (options, turn) = (self.options, self.grid_from_world);
        let splats = self.player.at(Time(time))?;
        let Some(bounds) = bounds(&splats, &turn, self.near) else { return Ok(Mesh::default()) };
        let side = (0..3).map(|k| bounds[1][k] - bounds[0][k]).fold(0.0, f64::max);
        if options.voxel * LEAST_VOXELS > side {
            return Err(Error::input(format!(
                "option `voxel` {} is too large: the scene's longest side has {side:.3} units",
                options.voxel
            ))
            .remedy(format!("Use {:.3} or less.", side / LEAST_VOXELS)));
        }
        let in_grid: Vec<Camera> = self.cameras.iter().map(|c| in_grid(c, &turn)).collect();
        let (mut backend, mut image) = (device::cpu(self.config), Image::default());
        let inverses = inverses(&splats);
        let (mut shell, mut maps) = (Shell::new(options.voxel, bounds)?, Vec::new());
        for camera in views(&in_grid, bounds, options.voxel) {
            let world = in_world(&camera, &turn);
            let planes = columns(&inverses, &world, self.centers);
            backend.render(&Shot { extra: Some(&planes), ..Shot::new(&splats, &world, [0.0; 3]) }, &mut image)?;
            maps.push(map(&image, camera, fusion::BAND * options.voxel));
            shell.add(&maps[maps.len() - 1])?;
        }
        let mut grid = shell.fuse(&maps);
        drop(maps);
        if options.watertight || options.collision {
            solid::close(&mut grid, options.collision)?;
        }
        let mut mesh = surface::extract(&grid);
        mesh.clean(options.voxel as f32);
        if options.collision {
            mesh.colors.clear();
        } else {
            mesh.find_normals();
        }
        mesh.rotate(&se3::transpose(&turn));
        Ok(mesh)
    }
}

/// Whether a run was trained with depth maps: its splats are where the mean depth of their centres is right.
fn trained_with_depth(run: &Run) -> bool {
    run.open_capture().is_ok_and(|(capture, recipe)| {
        capture.geometry.is_some()
            || recipe.loss.depth > 0.0 && capture.train.iter().any(|&i| capture.frames[i].depth.is_some())
    })
}

const IDENTITY: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

/// The box of all centres but the outermost and those of a far shell, in the axes of the grid; `None` where there is none.
fn bounds(splats: &Splats<'_>, grid_from_world: &[[f64; 3]; 3], near: Option<Surroundings>) -> Option<[[f64; 3]; 2]> {
    let rows = splats.parts.iter().flat_map(|part| (0..part.out.rows()).map(move |row| (part.out, row)));
    let shown = rows.filter(|(out, row)| out.get(*row, SPLAT_OPACITY) >= LEAST_OPACITY);
    let means = shown.map(|(out, row)| out.read::<3>(row, 0).map(f64::from));
    let means = means.filter(|m| m.iter().all(|x| x.is_finite()) && near.is_none_or(|near| near.holds(*m)));
    let means: Vec<[f64; 3]> = means.map(|m| mat_vec(grid_from_world, m)).collect();
    if means.is_empty() {
        return None;
    }
    let sides: [[f64; 2]; 3] = std::array::from_fn(|k| {
        let mut values: Vec<f64> = means.par_iter().map(|m| m[k]).collect();
        values.par_sort_unstable_by(f64::total_cmp);
        let out = (values.len() as f64 * BEYOND) as usize;
        [values[out], values[values.len() - 1 - out]]
    });
    let margin = MARGIN * sides.iter().map(|[low, high]| high - low).fold(0.0, f64::max);
    Some([sides.map(|[low, _]| low - margin), sides.map(|[_, high]| high + margin)])
}

/// Writes the mesh of one time (`NAME.glb`, `.obj` or `.ply`) or of every frame (a folder, or a name with `%05d`);
/// returns how many.
///
/// Errors: an ending that names no format; times outside the clip; a file that exists, unless forced; no surface; a voxel
/// size that does not fit the scene.
///
/// ```no_run
/// use splat4d_workflow::events::ignore;
/// use splat4d_workflow::exporting;
/// use splat4d_workflow::meshing::{self, MeshOptions};
///
/// # fn main() -> splat4d_workflow::Result<()> {
/// let run = "runs/knight".as_ref();
/// let options = MeshOptions { collision: true, ..MeshOptions::default() };
/// meshing::write(run, &exporting::open(run, None)?, "knight.glb".as_ref(), &options, &ignore)?;
/// # Ok(())
/// # }
/// ```
pub fn write(
    path: &Path,
    source: &Source,
    out: &Path,
    options: &MeshOptions,
    listener: &dyn Listener,
) -> Result<usize> {
    not_empty(&source.scene, path)?;
    let pattern = match Pattern::of(out) {
        Some(pattern) => Some(pattern),
        None if out.extension().is_none() || out.is_dir() => Some(Pattern::in_folder_as(out, NAME)),
        None => None,
    };
    let format = MeshFormat::of(&pattern.as_ref().map_or_else(|| out.to_owned(), |p| p.file(0)))?;
    let mut mesher = Mesher::new(source, options)?;
    let scene = &source.scene;
    let check = |time: f64| {
        let frame = 1.0 / scene.fps.max(f64::MIN_POSITIVE);
        if scene.is_moving() && !(scene.clip[0] - frame..=scene.clip[1] + frame).contains(&time) {
            return Err(Error::input(format!("invalid time {time} s: it is outside of the scene's clip"))
                .remedy(format!("The scene lasts from {:.3} to {:.3} s.", scene.clip[0], scene.clip[1])));
        }
        Ok(())
    };
    if scene.offset != [0.0; 3] {
        let [x, y, z] = scene.offset;
        listener.warn(&format!("positions of the mesh are relative to the scene's offset ({x} {y} {z})."));
    }
    let Some(pattern) = pattern else {
        let Frames { fps, from, to } = options.frames;
        if fps.or(from).or(to).is_some() {
            return Err(Error::input("one mesh has one time")
                .at(out.display())
                .remedy("Choose it with option `time`, or write a sequence: option `mesh` FOLDER or NAME.%05d.glb."));
        }
        source.keep(path, out, &[])?;
        if out.is_file() && !options.force {
            return Err(Error::input("the file exists")
                .at(out.display())
                .remedy("Choose another name, or add option `force` to replace it."));
        }
        let time = options.time.unwrap_or(scene.clip[0]);
        check(time)?;
        listener.detail(&mesher.seen_from());
        listener.phase("meshing", 0, 1);
        let start = Instant::now();
        let mesh = mesher.at(time)?;
        listener.clear();
        if mesh.triangles.is_empty() {
            return Err(Error::input(format!("no surface is seen at {time} s")).at(path.display()).remedy(format!(
                "Choose option `time` from {} to {} s, or a smaller option `voxel`.",
                scene.clip[0], scene.clip[1]
            )));
        }
        save(mesh, scene.up, format, out.to_owned(), listener)?;
        listener.detail(&format!("meshed in {:.1} s", start.elapsed().as_secs_f64()));
        listener.written(out);
        return Ok(1);
    };
    if options.time.is_some() {
        return Err(Error::input("option `time` selects one mesh, but the output is a sequence")
            .at(out.display())
            .remedy("Use option `mesh` NAME.glb, or option `from`, option `to` and option `fps`."));
    }
    let (fps, times) = sequence::timestamps(scene, options.frames.fps, [options.frames.from, options.frames.to])?;
    check(times[0])?;
    check(times[times.len() - 1])?;
    let read = sequence::Read { path, run: source.run.as_ref() };
    let owned = sequence::take(&[&pattern], times.len(), &read, "export", options.force)?;
    listener.stop_not_polled("meshes that are written stay; the same command writes them again");
    listener.detail(&mesher.seen_from());
    let (mut empty, start) = (0, Instant::now());
    for (i, &time) in times.iter().enumerate() {
        let mesh = mesher.at(time)?;
        empty += usize::from(mesh.triangles.is_empty());
        save(mesh, scene.up, format, pattern.file(i), listener)?;
        listener.phase("meshing", i + 1, times.len());
    }
    owned.finished();
    listener.clear();
    if empty > 0 {
        listener.warn(&format!("no surface is seen at {empty} of {} times: these meshes are empty", times.len()));
    }
    let each = start.elapsed().as_secs_f64() / times.len() as f64;
    listener.result(&format!(
        "{} meshes, {fps} per second, from {} to {} s; {each:.1} s each",
        times.len(),
        times[0],
        times[times.len() - 1]
    ));
    listener.written(pattern.folder());
    Ok(times.len())
}

/// Writes one mesh and reports it.
fn save(mut mesh: Mesh, up: [f64; 3], format: MeshFormat, out: PathBuf, listener: &dyn Listener) -> Result<()> {
    if format == MeshFormat::Glb {
        mesh.rotate(&rotation_between(up, GLTF_UP).unwrap_or(IDENTITY));
    }
    let bytes = mesh.bytes(format);
    files::write(&out, &bytes)?;
    let (vertices, triangles) = (mesh.positions.len(), mesh.triangles.len());
    listener.detail(&format!("{}: {} vertices, {} triangles", out.display(), grouped(vertices), grouped(triangles)));
    listener.emit(&json!({"type": "exported", "vertices": vertices, "triangles": triangles}));
    Ok(())
}

#[cfg(test)]
mod tests;
