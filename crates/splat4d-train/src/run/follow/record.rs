//! The file of a followed frame: what it changed. All files of a run in order give its state again, bit for bit, so
//! that a run continues after any interruption.

use crate::output::write_atomically;
use crate::{Error, Result};
use serde_json::{Value, json};
use splat4d::format::safetensors::{self, SafeTensors, Tensor};
use splat4d::scene::{GEOMETRY, Params, SH};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Numbers of a row of [`GEOMETRY`].
pub(super) const ROW: usize = 11;
/// A record's origin of a Gaussian that has no predecessor.
pub(super) const NEW: u32 = u32::MAX;
/// The metadata's key.
const KEY: &str = "splat4d-follow";
/// Version of the files.
const VERSION: u64 = 1;
/// Ending of the files.
const ENDING: &str = "safetensors";

/// Changes of a frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Record {
    /// Its number.
    pub frame: usize,
    /// Rows that are replaced, rising.
    pub active: Vec<u32>,
    /// The rows in their place.
    pub params: Params<f32>,
    /// For each of these the place in `active` of the row that it was, or `NEW`.
    pub origin: Vec<u32>,
    /// Errors of tiles that later frames are compared with, view by view.
    pub errors: Vec<f32>,
    /// Exposures, twelve numbers per camera; empty: none was learnt, or they are those of the first frame.
    pub exposure: Vec<f32>,
    /// Other facts.
    pub facts: Value,
}

/// The file of a frame.
fn path(folder: &Path, frame: usize) -> PathBuf {
    folder.join(format!("{frame:06}.{ENDING}"))
}

/// Numbers of the frames whose files are in a folder, rising.
pub(super) fn list(folder: &Path) -> Vec<usize> {
    let number = |name: String| name.strip_suffix(ENDING)?.strip_suffix('.')?.parse().ok();
    let names = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut all: Vec<usize> = names.filter_map(|e| number(e.file_name().into_string().ok()?)).collect();
    all.sort_unstable();
    all
}

impl Record {
    /// Writes its file.
    pub(super) fn write(&self, folder: &Path) -> Result<()> {
        write_atomically(&path(folder, self.frame), &self.bytes()?)
    }

    /// The bytes of its file.
    pub(super) fn bytes(&self) -> Result<Vec<u8>> {
        let (n, k) = (self.params.len(), self.params[SH].width());
        let geometry = self.params[GEOMETRY].column_to_rows(0, ROW);
        let sh = self.params[SH].column_to_rows(0, k);
        let tensors = [
            Tensor::u32("active", &[self.active.len()], &self.active),
            Tensor::u32("origin", &[self.origin.len()], &self.origin),
            Tensor::f32("geometry", &[n, ROW], &geometry),
            Tensor::f32("sh", &[n, k], &sh),
            Tensor::f32("errors", &[self.errors.len()], &self.errors),
            Tensor::f32("exposure", &[self.exposure.len()], &self.exposure),
        ];
        let facts = json!({"version": VERSION, "frame": self.frame, "facts": self.facts});
        let mut bytes = Vec::new();
        safetensors::write(&tensors, &BTreeMap::from([(KEY.to_owned(), facts.to_string())]), &mut bytes)?;
        Ok(bytes)
    }

    /// Reads the file of a frame. Errors: it is damaged or of another version.
    pub(super) fn read(folder: &Path, frame: usize) -> Result<Self> {
        let path = path(folder, frame);
        let remedy = "Delete this file and later ones of the folder: the frames are trained again";
        let bytes = crate::files::read_with(&path, remedy)?;
        Self::parse(&bytes, frame).map_err(|e| e.at(path.display()).remedy(remedy))
    }

    pub(super) fn parse(bytes: &[u8], frame: usize) -> Result<Self> {
        let broken = |what: &str| Error::input(format!("the file of a followed frame is damaged: {what}"));
        let file = SafeTensors::read(bytes)?;
        let text = file.metadata().get(KEY).ok_or_else(|| broken("it has no metadata"))?;
        let facts: Value = serde_json::from_str(text).map_err(|_| broken("its metadata are not JSON"))?;
        if facts["version"] != json!(VERSION) || facts["frame"] != json!(frame) {
            return Err(broken("it is of another frame or version"));
        }
        let [active, origin] = ["active", "origin"].map(|name| file.tensor(name)?.as_u32());
        let [geometry, sh, errors, exposure] =
            ["geometry", "sh", "errors", "exposure"].map(|name| file.tensor(name)?.as_f32());
        let (active, origin, geometry, sh) = (active?, origin?, geometry?, sh?);
        let (errors, exposure) = (errors?, exposure?);
        let rows = origin.len();
        let width = sh.len().checked_div(rows).unwrap_or(3);
        let fits = geometry.len() == ROW * rows && sh.len() == width * rows && width % 3 == 0 && width > 0;
        let rising = active.windows(2).all(|w| w[0] < w[1]);
        if !fits || !rising || origin.iter().any(|&o| o != NEW && o as usize >= active.len()) {
            return Err(broken("its arrays do not fit each other"));
        }
        let mut params = Params::new(rows, width / 3, &[]);
        params[GEOMETRY].column_from_rows(0, ROW, &geometry);
        params[SH].column_from_rows(0, width, &sh);
        Ok(Self { frame, active, params, origin, errors, exposure, facts: facts["facts"].clone() })
    }
}
