//! A scene that another program trained as a run: with the capture that it shows, it can be tuned further.

use crate::events::Listener;
use crate::source::{Source, not_empty};
use crate::{files, run_folder};
use serde::{Deserialize, Serialize};
use serde_json::json;
use splat4d::Result;
use splat4d::format;
use splat4d::layers::Scene;
use splat4d::math::sh::degree_of;
use splat4d::scene::SH;
use splat4d_train::path_text::to_text;
use splat4d_train::recipe::Recipe;
use splat4d_train::run::open_capture;
use std::path::{Path, PathBuf};

/// Models whose parameters a run tunes by their own rates. Of all others the Gaussians are tuned, and their motion stays.
const TUNED: [&str; 2] = ["spacetime", "native4d"];

/// The capture that a scene of another program shows.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OnCapture {
    /// Its folder.
    #[serde(with = "splat4d_train::path_text")]
    pub capture: PathBuf,
    /// Views that are held out, as `train` takes them. `None`: the capture's convention.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hold_out: Option<String>,
    /// Divides the images' size. `None`: as they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub downscale: Option<usize>,
}

impl OnCapture {
    /// A recipe that opens it so.
    ///
    /// Errors: values out of range.
    pub(crate) fn recipe(&self) -> Result<Recipe> {
        let mut recipe = Recipe::default();
        let wanted = [
            ("hold_out", self.hold_out.as_ref().map(|v| format!("{v:?}"))),
            ("downscale", self.downscale.map(|k| k.to_string())),
        ];
        for (name, value) in wanted {
            value.map_or(Ok(()), |value| recipe.set(&format!("{name}={value}")))?;
        }
        Ok(recipe)
    }
}

/// Writes the scene at `path` into the folder `run` as a finished run on a capture.
///
/// Errors: the capture or the scene cannot be read; the scene is empty; the folder cannot be written.
pub(crate) fn adopt(path: &Path, on: &OnCapture, run: &Path, console: &dyn Listener) -> Result<()> {
    let mut recipe = on.recipe()?;
    let capture = open_capture(&on.capture, &recipe)?;
    let (first, last) = capture.time_range();
    let source = Source::open_on(path, [first, last])?.finite();
    not_empty(&source.scene, path)?;
    source.warnings.lines().iter().for_each(|w| console.warn(&format!("{w}.")));
    let scene = &source.scene;
    recipe.set(&format!("motion={}", motion(scene)))?;
    recipe.appearance.sh_degree = sh_degree(scene);
    recipe.densify.max_cap = scene.len();

    files::make_folder(run)?;
    files::write(&run.join("recipe.toml"), recipe.to_toml().as_bytes())?;
    run_folder::write_cameras(run, &capture)?;
    let root = std::fs::canonicalize(&on.capture).unwrap_or_else(|_| on.capture.clone());
    let info = json!({
        "version": env!("CARGO_PKG_VERSION"), "made_by": "another program", "capture": to_text(&root),
        "capture_name": capture.name, "motion": recipe.run.motion.as_str(), "gaussians": scene.len(), "finished": true,
        "warnings": capture.warnings,
    });
    files::write(&run.join("run.json"), format!("{info:#}\n").as_bytes())?;
    let mut bytes = Vec::new();
    format::scene::write(scene, &mut bytes)?;
    // Last: a run with a scene is a finished one.
    files::write(&run.join("scene.safetensors"), &bytes)
}

/// The model by whose rates the scene is tuned.
fn motion(scene: &Scene<f32>) -> &'static str {
    let of = |name: &str| scene.layers.iter().any(|layer| layer.motion.spec().name() == name);
    TUNED.into_iter().find(|name| of(name)).unwrap_or("still")
}

/// The highest degree of spherical harmonics of its layers.
fn sh_degree(scene: &Scene<f32>) -> usize {
    let width = scene.layers.iter().map(|layer| layer.params[SH].width()).max().unwrap_or(0);
    degree_of(width / 3).unwrap_or(0)
}
