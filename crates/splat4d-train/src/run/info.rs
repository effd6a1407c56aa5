//! `run.json` of a run.

use crate::capture::Capture;
use crate::path_text::{of_text, to_text};
use crate::{Error, Result};
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Key of the folders and files that a run reads outside of its capture's folder.
pub(super) const ELSEWHERE: &str = "capture_elsewhere";

/// Files that a capture reads outside its folder, for `run.json`.
pub(super) fn elsewhere(capture: &Capture) -> Vec<String> {
    capture.elsewhere.iter().map(|path| to_text(path)).collect()
}

/// The record of `elsewhere` in `run.json`: known even if the capture can no longer be opened.
pub fn recorded_elsewhere(info: &Value) -> BTreeSet<PathBuf> {
    info[ELSEWHERE].as_array().into_iter().flatten().filter_map(Value::as_str).map(of_text).collect()
}

/// Reads it. Errors: it is missing or not JSON.
pub(super) fn read_info(run: &Path) -> Result<Value> {
    let path = run.join("run.json");
    serde_json::from_str(&read_text(&path)?)
        .map_err(|e| Error::input(format!("it is not JSON: {e}")).at(path.display()))
}

/// Reads a text file of a run.
pub(super) fn read_text(path: &Path) -> Result<String> {
    crate::files::read_text_with(path, "Give the folder of a run")
}
