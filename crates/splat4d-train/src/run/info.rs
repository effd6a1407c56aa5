//! `run.json` of a run.

use crate::{Error, Result};
use std::path::Path;

/// Reads it. Errors: it is missing or not JSON.
pub(super) fn read_info(run: &Path) -> Result<serde_json::Value> {
    let path = run.join("run.json");
    serde_json::from_str(&read_text(&path)?)
        .map_err(|e| Error::input(format!("it is not JSON: {e}")).at(path.display()))
}

/// Reads a text file of a run.
pub(super) fn read_text(path: &Path) -> Result<String> {
    crate::files::read_text_with(path, "Give the folder of a run")
}
