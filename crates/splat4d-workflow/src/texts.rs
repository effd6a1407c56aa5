//! Readers of texts that users give to commands: for the fuzz targets.

use crate::compressing::CompressJob;
use crate::editor::Editor;
use crate::source::Source;
use crate::{camera_file, paths, point_queries};
use splat4d::layers::Scene;
use splat4d::scene::Camera;
use splat4d::{Error, Result};
use std::path::Path;

/// Reads a camera, as `--camera` does.
pub fn camera(text: &str) -> Result<()> {
    camera_file::parse(text).map(drop)
}

/// Reads key frames, as `--path` does.
pub fn path(text: &str) -> Result<()> {
    paths::check_keys(text)
}

/// Reads points that are requested, as `--points` does; of a scene of one second with one camera, `cam1`.
pub fn points(text: &str) -> Result<()> {
    let camera = Camera::with_fov_y(splat4d::math::Se3::IDENTITY, 0.8, 8, 6);
    let view = paths::View { camera, name: "cam1".into(), time: 0.0, held: false };
    point_queries::read(text, &[view], [0.0, 1.0]).map(drop)
}

/// Reads the settings of an unfinished compression, as `compress --resume` does.
pub fn compress_order(text: &str) -> Result<()> {
    CompressJob::read(text).map(drop)
}

/// Reads a description of a network, as `priors` does.
pub fn model(text: &str) -> Result<()> {
    crate::models::Description::parse(text).map(drop)
}

/// The server side of `view --edit`.
pub struct Page(Editor);

impl Page {
    /// For this scene; `list`: the file that the page's edits are saved in.
    pub fn new(scene: Scene<f32>, list: &Path) -> Result<Self> {
        Editor::new(Source::own(scene), "fuzz".into(), list).map(Self)
    }

    /// Does what a page requests.
    pub fn ask(&self, text: &str) -> Result<()> {
        let asked = serde_json::from_str(text).map_err(|e| Error::input(format!("invalid JSON: {e}")))?;
        self.0.answer(asked).map(drop)
    }
}
