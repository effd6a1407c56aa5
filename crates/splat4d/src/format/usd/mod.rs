//! USD with the schema ParticleField3DGaussianSplat (OpenUSD 26.03 and later), as text (`.usda`) and as an archive with
//! such a layer (`.usdz`).
//!
//! `positions`, `orientations` (w first in text), `scales` (lengths) and `opacities` (alpha) are **activated**;
//! `radiance:sphericalHarmonicsCoefficients` are (degree + 1)² colours a Gaussian, Gaussian after Gaussian, with the
//! signs of 3DGS. Every array may have time samples, between which programs interpolate: one row is one Gaussian at all
//! times, with opacity 0 while it is not alive. Transforms of parents place the field. `upAxis` is Y or Z.
//! Sources: openusd.org, "usda" grammar of the User Guides, usdVol schemas, usdz specification 1.3.

mod lexer;
mod scene;
mod stage;
#[cfg(test)]
mod tests;
mod transform;
mod write;

use super::dialect::{Dialect, Opened, WriteOptions, Writer, Y_UP};
use super::warnings::Warnings;
use super::zip;
use crate::layers::Scene;
use crate::{Error, ErrorKind, Result};
use std::io::Write;

/// A layer as text.
pub(crate) const TEXT: Dialect = Dialect {
    name: "USD (ParticleField3DGaussianSplat)",
    ending: ".usda",
    up: Y_UP,
    moves: true,
    mark: Some(|bytes| bytes.starts_with(MAGIC)),
    read: |bytes| scene::opened(&stage::Stage::read(bytes)?),
    writer: Writer::Moving(write::write),
    world: false,
    fixed_axes: false,
    states_up: true,
};

/// An archive with one such layer.
pub(crate) const ARCHIVE: Dialect = Dialect {
    name: "USD archive (ParticleField3DGaussianSplat)",
    ending: ".usdz",
    mark: Some(is_archive),
    read: read_archive,
    writer: Writer::Moving(write_archive),
    ..TEXT
};

/// First bytes of a layer as text.
const MAGIC: &[u8] = b"#usda ";
/// First bytes of a binary layer.
const BINARY: &[u8] = b"PXR-USDC";
/// The layer of an archive that we write.
const LAYER: &str = "scene.usda";
/// Endings of layers: the first file of an archive is one.
const LAYERS: [&str; 3] = [".usda", ".usdc", ".usd"];
/// Files of an archive begin at multiples of this (usdz specification, "Layout").
const ALIGN: usize = 64;

/// The schema of Gaussians.
const FIELD: &str = "ParticleField3DGaussianSplat";
const POSITIONS: &str = "positions";
const ORIENTATIONS: &str = "orientations";
const SCALES: &str = "scales";
const OPACITIES: &str = "opacities";
const DEGREE: &str = "radiance:sphericalHarmonicsDegree";
const COEFFICIENTS: &str = "radiance:sphericalHarmonicsCoefficients";
/// Length of a local header of a zip without its name, and where its lengths are (APPNOTE 4.3.7).
const ZIP_HEADER: usize = 30;
const ZIP_NAME: usize = 26;

/// Whether bytes are a zip whose first file is a layer.
fn is_archive(bytes: &[u8]) -> bool {
    let length = bytes.get(ZIP_NAME..ZIP_NAME + 2).map(|b| usize::from(u16::from_le_bytes([b[0], b[1]])));
    let name = length.and_then(|length| bytes.get(ZIP_HEADER..ZIP_HEADER + length)).unwrap_or_default();
    bytes.starts_with(&zip::MAGIC) && LAYERS.iter().any(|end| name.to_ascii_lowercase().ends_with(end.as_bytes()))
}

fn read_archive(bytes: &[u8]) -> Result<Opened> {
    let archive = zip::Archive::open(bytes)?;
    let name = archive.first().ok_or_else(|| damaged("the archive is empty"))?.to_owned();
    // An archive of USD stores its files uncompressed.
    let most = archive.packed(&name).unwrap_or(0);
    let layer = archive.file(&name, most).expect("it is one of the names")?;
    if layer.starts_with(BINARY) {
        return Err(binary().at(&name));
    }
    stage::Stage::read(&layer).and_then(|stage| scene::opened(&stage)).map_err(|e| e.at(&name))
}

fn write_archive(scene: &Scene<f32>, options: &WriteOptions, out: &mut dyn Write) -> Result<Warnings> {
    let mut layer = Vec::new();
    let warnings = write::write(scene, options, &mut layer)?;
    zip::write(&[(LAYER, &layer)], ALIGN, out)?;
    Ok(warnings)
}

/// Error for a layer that is not text.
fn binary() -> Error {
    Error::new(ErrorKind::Unsupported, "the layer is binary (.usdc), which is not read").remedy(
        "Convert it to text with `usdcat IN.usdc -o OUT.usda`, or in Python: Usd.Stage.Open('IN.usdc').Export('OUT.usda').",
    )
}

fn damaged(what: impl std::fmt::Display) -> Error {
    Error::input(format!("this USD file is damaged: {what}")).remedy("Copy or export it again.")
}

fn unsupported(what: impl std::fmt::Display) -> Error {
    Error::new(ErrorKind::Unsupported, what.to_string())
        .remedy("Flatten the stage into one layer (Usd.Stage.Open(IN).Flatten().Export(OUT.usda)), or export .ply.")
}
