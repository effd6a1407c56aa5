//! `fuzz`: starts the runner of `splat4d-fuzz`, which links everything that reads; this program stays small.

use anyhow::{Context, Result, ensure};
use std::process::Command;

pub(crate) fn command(words: &[String]) -> Result<()> {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let status = Command::new(cargo)
        .args(["run", "--release", "-q", "-p", "splat4d-fuzz", "--"])
        .args(words)
        .status()
        .context("cargo cannot be started")?;
    ensure!(status.success(), "a reader failed; see the table");
    Ok(())
}
