//! glTF 2.0 with the extension KHR_gaussian_splatting (ratified 2026): a mesh of points whose attributes are Gaussians.
//!
//! `KHR_gaussian_splatting:ROTATION` is a unit quaternion x y z w, `:SCALE` and `:OPACITY` are **activated** (lengths,
//! alpha), `:SH_DEGREE_l_COEF_n` are the coefficients of red, green and blue with the signs of 3DGS. World axes: **y up**;
//! unit: metre. Nodes place meshes. A `.glb` holds JSON and numbers, a `.gltf` is the JSON, whose numbers are in a data
//! URI or in files next to it. KHR_gaussian_splatting_compression_spz_2 (a draft) puts an .spz of version 2 in their place.
//! Source: KhronosGroup/glTF, specification 2.0 and extensions/2.0/Khronos/KHR_gaussian_splatting; pull request 2531.

mod container;
mod read;
#[cfg(test)]
pub(super) mod tests;
mod write;

use super::dialect::{Dialect, Opened, Writer, Y_UP};
use crate::{Error, ErrorKind, Result};
pub use read::buffers_of;
use std::collections::BTreeMap;

/// glTF with Gaussians, one file.
pub const DIALECT: Dialect = Dialect {
    name: "glTF (KHR_gaussian_splatting)",
    ending: ".glb",
    up: Y_UP,
    moves: false,
    mark: Some(|bytes| bytes.starts_with(&MAGIC)),
    read: |bytes| read::read(&container::File::binary(bytes)?),
    writer: Writer::Moment(|params, _, mut out| {
        write::plain(params).and_then(|(file, warnings)| file.write_binary(&mut out).map(|()| warnings))
    }),
    world: false,
    fixed_axes: true,
    states_up: true,
};

/// The same as JSON.
pub const TEXT: Dialect = Dialect {
    name: "glTF as JSON (KHR_gaussian_splatting)",
    ending: ".gltf",
    mark: Some(container::is_text),
    read: |bytes| read::text(bytes, &Default::default()),
    writer: Writer::Moment(|params, _, mut out| {
        write::plain(params).and_then(|(file, warnings)| file.write_text(&mut out).map(|()| warnings))
    }),
    ..DIALECT
};

/// glTF whose Gaussians are an .spz of version 2: ten times smaller.
pub const COMPRESSED: Dialect = Dialect {
    name: "glTF (KHR_gaussian_splatting_compression_spz_2)",
    ending: ".spz.glb",
    mark: Some(|bytes| bytes.starts_with(&MAGIC) && container::names(bytes, SPZ[0])),
    writer: Writer::Moment(|params, _, mut out| {
        write::compressed(params).and_then(|(file, warnings)| file.write_binary(&mut out).map(|()| warnings))
    }),
    ..DIALECT
};

/// Reads a .gltf with the files that [`buffers_of`] names. Errors: damaged, a file is missing, no Gaussians.
pub fn read_text(text: &[u8], files: &BTreeMap<String, Vec<u8>>) -> Result<Opened> {
    read::text(text, files).map(|opened| TEXT.finish(opened))
}

/// First bytes of a .glb.
const MAGIC: [u8; 4] = *b"glTF";
/// The extension's name, of attributes too.
const EXTENSION: &str = "KHR_gaussian_splatting";
/// Extensions that put an .spz in place of attributes, inside [`EXTENSION`] or (the last) in its place.
const SPZ: [&str; 3] = [
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
];
/// Colours as trainings leave them: sRGB values, display-referred.
const SRGB: &str = "srgb_rec709_display";
/// Kernel of 3DGS.
const ELLIPSE: &str = "ellipse";

/// Types of components (glTF 2.0, 3.6.2.2).
mod component {
    pub(super) const BYTE: u64 = 5120;
    pub(super) const UNSIGNED_BYTE: u64 = 5121;
    pub(super) const SHORT: u64 = 5122;
    pub(super) const UNSIGNED_SHORT: u64 = 5123;
    pub(super) const FLOAT: u64 = 5126;
}

/// Types of accessors by their number of components.
const TYPES: [&str; 5] = ["", "SCALAR", "VEC2", "VEC3", "VEC4"];

/// The attribute of a coefficient of spherical harmonics.
fn coefficient(degree: usize, n: usize) -> String {
    format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}")
}

fn damaged(what: impl std::fmt::Display) -> Error {
    Error::input(format!("this glTF file is damaged: {what}")).remedy("Copy or export it again.")
}

fn unsupported(what: impl std::fmt::Display) -> Error {
    Error::new(ErrorKind::Unsupported, what.to_string())
        .remedy("Export it with KHR_gaussian_splatting and without compression, or as .ply.")
}
