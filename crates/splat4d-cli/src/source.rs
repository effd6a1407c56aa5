//! Anything that holds a scene: a run folder, a scene file (`.safetensors`, checkpoints too), a playback file
//! (`.splat4d`) or a 3DGS `.ply`.

use crate::files::cannot_read;
use crate::paths::{Stage, View};
use crate::run_folder::Run;
use splat4d::format::playback::{self, Index};
use splat4d::format::ply::PlyInfo;
use splat4d::layers::{ALWAYS, Layer, Scene};
use splat4d::motion::Still;
use splat4d::scene::{Camera, GEOMETRY, LifeKind};
use splat4d::{Error, Result, format};
use std::path::Path;
use std::sync::Arc;

/// Upwards in plain 3DGS files: COLMAP's worlds have y down.
const PLY_UP: [f64; 3] = [0.0, -1.0, 0.0];
/// Share of a cloud, outermost first, that does not count for its size: a few far Gaussians must not shrink the rest.
const OUTLIERS: f64 = 0.1;

/// A scene and where it came from.
pub(crate) struct Source {
    pub scene: Scene<f32>,
    /// The run, where it is one.
    pub run: Option<Run>,
    /// What the .ply said, where it is one.
    pub ply: Option<PlyInfo>,
    /// The start of the playback file, where it is one.
    pub playback: Option<Index>,
}

impl Source {
    /// Opens a run or a file.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        if path.is_dir() {
            let run = Run::open(path)?;
            let scene = read_scene(&run.scene_file()?)?;
            return Ok(Self { scene, run: Some(run), ply: None, playback: None });
        }
        let bytes = std::fs::read(path).map_err(|e| cannot_read(path, e))?;
        if bytes.starts_with(&playback::MAGIC) {
            let index = Index::parse(&bytes, Some(bytes.len() as u64)).map_err(|e| e.at(path.display()))?;
            let scene = playback::read(&bytes).map_err(|e| e.at(path.display()))?;
            return Ok(Self { scene, run: None, ply: None, playback: Some(index) });
        }
        if !bytes.starts_with(b"ply") {
            let scene = format::scene::read(&bytes).map_err(|e| {
                e.at(path.display())
                    .remedy("Give a run folder, a scene.safetensors, a checkpoint, a .splat4d or a 3DGS .ply.")
            })?;
            return Ok(Self { scene, run: None, ply: None, playback: None });
        }
        let (params, info) = format::ply::read(&bytes).map_err(|e| e.at(path.display()))?;
        let layer =
            Layer { name: "ply".into(), params, motion: Arc::new(Still), life: LifeKind::Infinite, span: ALWAYS };
        let scene =
            Scene { layers: vec![layer], up: PLY_UP, fps: splat4d::scene::time::DEFAULT_FPS, ..Scene::default() };
        Ok(Self { scene, run: None, ply: Some(info), playback: None })
    }

    /// The data set's cameras; those that a playback file brings along; empty for other bare files.
    pub(crate) fn views(&self) -> Result<Vec<View>> {
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
    pub(crate) fn stage(&self, views: &[View]) -> Stage {
        if !views.is_empty() {
            return Stage::of_views(views, self.scene.up);
        }
        let (center, extent) = cloud(&self.scene);
        Stage::of_cloud(center, extent, self.scene.up)
    }
}

/// Reads a scene file.
pub(crate) fn read_scene(path: &Path) -> Result<Scene<f32>> {
    let bytes = std::fs::read(path).map_err(|e| cannot_read(path, e))?;
    format::scene::read(&bytes).map_err(|e| e.at(path.display()))
}

/// Refuses a scene without Gaussians.
pub(crate) fn not_empty(scene: &Scene<f32>, path: &Path) -> Result<()> {
    if scene.is_empty() {
        return Err(Error::input("holds no Gaussians")
            .at(path.display())
            .remedy("Train it again, or give another file."));
    }
    Ok(())
}

/// Middle (medians) and radius of the inner part of all means.
pub(crate) fn cloud(scene: &Scene<f32>) -> ([f64; 3], f64) {
    let means: Vec<[f64; 3]> = scene
        .layers
        .iter()
        .flat_map(|l| {
            let table = &l.params[GEOMETRY];
            (0..table.rows()).map(move |i| table.read::<3>(i, 0).map(f64::from))
        })
        .filter(|m| m.iter().all(|x| x.is_finite()))
        .collect();
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
