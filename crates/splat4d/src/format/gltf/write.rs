//! Writing: one mesh of points, one node.

use super::container::File;
use super::{ELLIPSE, EXTENSION, SPZ, SRGB, TYPES, coefficient, component};
use crate::format::bytes::{SH_C0, scale_of_log, sound_rows};
use crate::format::dialect::Y_DOWN;
use crate::format::{Warnings, spz};
use crate::math::quat;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH};
use crate::{Error, Result};
use serde_json::{Map, Value, json};
use std::borrow::Cow;

/// Points (glTF 2.0, 3.7.2.1): what programs without the extension render.
const POINTS: u32 = 0;
/// Target of buffer views of attributes (glTF 2.0, 5.11.5).
const ARRAY_BUFFER: u32 = 34962;
/// Version of .spz that the compression extension names.
const SPZ_VERSION: u32 = 2;
const GENERATOR: &str = concat!("splat4d ", env!("CARGO_PKG_VERSION"));

/// Attributes, accessors, buffer views and their bytes as they grow.
#[derive(Default)]
struct Mesh {
    count: usize,
    attributes: Map<String, Value>,
    accessors: Vec<Value>,
    views: Vec<Value>,
    bytes: Vec<u8>,
}

impl Mesh {
    /// Adds an attribute of `width` f32 per Gaussian.
    fn floats<const N: usize>(&mut self, name: &str, values: impl Iterator<Item = [f32; N]>) {
        let begin = self.bytes.len();
        values.for_each(|v| v.iter().for_each(|x| self.bytes.extend(x.to_le_bytes())));
        self.add(name, begin, N, component::FLOAT);
    }

    fn add(&mut self, name: &str, begin: usize, width: usize, stored: u64) {
        let view = json!({"buffer": 0, "byteOffset": begin, "byteLength": self.bytes.len() - begin,
            "target": ARRAY_BUFFER});
        self.accessor(name, width, stored)["bufferView"] = json!(self.views.len());
        self.views.push(view);
    }

    /// An accessor without bytes.
    fn accessor(&mut self, name: &str, width: usize, stored: u64) -> &mut Value {
        self.attributes.insert(name.into(), json!(self.accessors.len()));
        self.accessors.push(json!({"componentType": stored, "count": self.count, "type": TYPES[width]}));
        self.accessors.last_mut().expect("it was pushed")
    }

    /// States the bounds of the positions, which glTF demands.
    fn bound(&mut self, means: impl Iterator<Item = [f32; 3]>) {
        let (mut min, mut max) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for mean in means {
            (0..3).for_each(|k| (min[k], max[k]) = (min[k].min(mean[k]), max[k].max(mean[k])));
        }
        let at = self.attributes["POSITION"].as_u64().expect("positions were added") as usize;
        (self.accessors[at]["min"], self.accessors[at]["max"]) = (json!(min), json!(max));
    }

    fn file(self, extension: Value, required: &[&str]) -> File<'static> {
        let mut used = vec![EXTENSION];
        used.extend(required.iter().filter(|r| **r != EXTENSION));
        let primitive = json!({"mode": POINTS, "attributes": self.attributes, "extensions": {EXTENSION: extension}});
        let mut json = json!({
            "asset": {"version": "2.0", "generator": GENERATOR},
            "extensionsUsed": used, "scene": 0, "scenes": [{"nodes": [0]}],
            "nodes": [{"name": "gaussians", "mesh": 0}],
            "meshes": [{"name": "gaussians", "primitives": [primitive]}],
            "accessors": self.accessors, "bufferViews": self.views,
        });
        if !required.is_empty() {
            json["extensionsRequired"] = json!(required);
        }
        File { json, size: self.bytes.len(), buffers: vec![Cow::Owned(self.bytes)] }
    }
}

fn rows(params: &Params, warnings: &mut Warnings) -> Result<Vec<usize>> {
    let rows = sound_rows(params, warnings);
    if rows.is_empty() {
        return Err(Error::input("there are no Gaussians, and a glTF accessor cannot be empty")
            .remedy("Choose another time, or write .ply files, which can be."));
    }
    Ok(rows)
}

/// Gaussians as plain attributes. Errors: there are none.
pub(super) fn plain(params: &Params) -> Result<(File<'static>, Warnings)> {
    let mut warnings = Warnings::default();
    let rows = rows(params, &mut warnings)?;
    let (geometry, sh) = (&params[GEOMETRY], &params[SH]);
    let mut mesh = Mesh { count: rows.len(), ..Mesh::default() };
    let of = || rows.iter().copied();
    let alpha = |row: usize| 1.0 / (1.0 + (-geometry.get(row, OPACITY)).exp());
    mesh.floats("POSITION", of().map(|row| geometry.read::<3>(row, 0)));
    mesh.bound(of().map(|row| geometry.read::<3>(row, 0)));
    // Linear colours of points, for programs without the extension.
    let begin = mesh.bytes.len();
    for row in of() {
        let color = sh.read::<3>(row, 0).map(|dc| byte(linear(0.5 + SH_C0 * dc)));
        mesh.bytes.extend([color[0], color[1], color[2], byte(alpha(row))]);
    }
    mesh.add("COLOR_0", begin, 4, component::UNSIGNED_BYTE);
    mesh.accessors.last_mut().expect("it was added")["normalized"] = json!(true);
    mesh.floats(&format!("{EXTENSION}:ROTATION"), of().map(|row| rotation(params, row)));
    mesh.floats(&format!("{EXTENSION}:SCALE"), of().map(|row| geometry.read::<3>(row, LOG_SCALE).map(scale_of_log)));
    mesh.floats(&format!("{EXTENSION}:OPACITY"), of().map(|row| [alpha(row)]));
    let mut first = 0;
    for degree in 0..(sh.width() / 3).isqrt() {
        for n in 0..=2 * degree {
            mesh.floats(&coefficient(degree, n), of().map(|row| sh.read::<3>(row, first)));
            first += 3;
        }
    }
    Ok((mesh.file(json!({"kernel": ELLIPSE, "colorSpace": SRGB}), &[]), warnings))
}

/// Gaussians as an .spz of version 2. The draft gives its numbers the axes of the file, and maps them to attributes
/// that have accessors without bytes. Errors: there are none.
pub(super) fn compressed(params: &Params) -> Result<(File<'static>, Warnings)> {
    let mut bytes = Vec::new();
    // Version 2 names no axes: those of .ply cause no remark.
    let warnings = spz::write(params, SPZ_VERSION, Y_DOWN, &mut bytes)?;
    let (decoded, ..) = spz::read(&bytes)?;
    let mut mesh = Mesh { count: decoded.len(), ..Mesh::default() };
    mesh.accessor("POSITION", 3, component::FLOAT);
    mesh.bound((0..decoded.len()).map(|row| decoded[GEOMETRY].read::<3>(row, 0)));
    mesh.accessor("COLOR_0", 4, component::UNSIGNED_BYTE)["normalized"] = json!(true);
    mesh.accessor(&format!("{EXTENSION}:SCALE"), 3, component::FLOAT);
    mesh.accessor(&format!("{EXTENSION}:ROTATION"), 4, component::FLOAT);
    for degree in 1..(decoded[SH].width() / 3).isqrt() {
        for n in 0..=2 * degree {
            mesh.accessor(&coefficient(degree, n), 3, component::FLOAT);
        }
    }
    mesh.views.push(json!({"buffer": 0, "byteOffset": 0, "byteLength": bytes.len()}));
    mesh.bytes = bytes;
    let inner = json!({SPZ[0]: {"bufferView": 0}});
    let extension = json!({"kernel": ELLIPSE, "colorSpace": SRGB, "extensions": inner});
    Ok((mesh.file(extension, &[EXTENSION, SPZ[0]]), warnings))
}

/// x y z w, unit.
fn rotation(params: &Params, row: usize) -> [f32; 4] {
    let (q, _) = quat::normalize(params[GEOMETRY].read::<4>(row, QUAT).map(f64::from));
    [1, 2, 3, 0].map(|k| q[k] as f32)
}

/// A share of 0 to 1 as a byte.
fn byte(x: f32) -> u8 {
    (255.0 * x.clamp(0.0, 1.0)).round() as u8
}

/// An sRGB value of 0 to 1 as a linear one (IEC 61966-2-1).
fn linear(x: f32) -> f32 {
    let x = x.clamp(0.0, 1.0);
    if x <= 0.04045 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) }
}
