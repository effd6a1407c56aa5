//! Reading: meshes of Gaussians where the nodes of the scene place them.

use super::container::{self, File};
use super::{ELLIPSE, EXTENSION, SPZ, SRGB, TYPES, coefficient, component, damaged, unsupported};
use crate::Result;
use crate::format::dialect::{Opened, still};
use crate::format::linear::{Linear, from_linear};
use crate::format::{Warnings, spz};
use crate::layers::{Layer, Scene};
use crate::math::{Sim3, quat};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH};
use serde_json::Value;
use std::collections::BTreeMap;

/// Deepest nesting of nodes that is followed.
const DEEPEST: usize = 64;
/// Relative difference of the scales of a node's axes that count as one.
const UNIFORM: f64 = 1e-4;
/// Gaussians that nodes may place in any case; more only with a byte of the file for each. A file may show one mesh
/// often, but 1 MB must not become 100 GB.
const ALWAYS: usize = 1 << 16;

/// Reads a .gltf with its files.
pub(super) fn text(text: &[u8], files: &BTreeMap<String, Vec<u8>>) -> Result<Opened> {
    read(&File::text(text, files)?)
}

/// Names of the files next to a .gltf without which it cannot be read. Errors: it is not JSON.
pub fn buffers_of(text: &[u8]) -> Result<Vec<String>> {
    container::buffers(text)
}

pub(super) fn read(file: &File<'_>) -> Result<Opened> {
    let mut layers: Vec<Layer<f32>> = Vec::new();
    let (mut warnings, mut placed) = (Warnings::default(), 0);
    for (mesh, frame) in file.placed()? {
        for primitive in file.json["meshes"][mesh]["primitives"].as_array().into_iter().flatten() {
            let Some(params) = file.primitive(primitive, &mut warnings)? else { continue };
            placed += params.len();
            if !layers.is_empty() && placed > ALWAYS.max(file.size) {
                return Err(damaged(format!("its nodes place {placed} Gaussians, more than it has bytes")));
            }
            let mut layer = still(params).layers.remove(0);
            layer.frame = frame;
            layer.apply_transform();
            layers.push(layer);
        }
    }
    if layers.is_empty() {
        return Err(unsupported(format!("this glTF file holds no Gaussians ({EXTENSION})")));
    }
    if layers.len() > 1 {
        layers.iter_mut().enumerate().for_each(|(i, l)| l.name = format!("gaussians {i}"));
    }
    let scene = Scene { layers, ..still(Params::new(0, 1, &[])) };
    Ok(Opened::from((scene, warnings)))
}

/// A number of the JSON that counts or points.
fn index(v: &Value) -> Option<usize> {
    v.as_u64().and_then(|n| usize::try_from(n).ok())
}

impl File<'_> {
    /// The Gaussians of a primitive; none where it has none.
    fn primitive(&self, primitive: &Value, warnings: &mut Warnings) -> Result<Option<Params>> {
        let extensions = &primitive["extensions"];
        let own = &extensions[EXTENSION];
        let compressed = SPZ.iter().map(|name| (&own["extensions"][name], &extensions[name]));
        let compressed = compressed.map(|(in_own, alone)| if in_own.is_null() { alone } else { in_own });
        if let Some(spz) = compressed.into_iter().find(|v| !v.is_null()) {
            return self.spz(spz, warnings).map(Some);
        }
        if own.is_null() {
            return Ok(None);
        }
        if let Some(name) = own["extensions"].as_object().and_then(|o| o.keys().next()) {
            return Err(unsupported(format!("its Gaussians are stored by {name}, which is not read")));
        }
        for (key, known, meaning) in [
            ("kernel", ELLIPSE, "Gaussians are read with the kernel of 3DGS"),
            ("colorSpace", SRGB, "colours are read as sRGB values and may look wrong"),
        ] {
            let other = own[key].as_str().filter(|value| *value != known);
            warnings_once(warnings, other.map(|value| format!("its {key} is {value}: {meaning}")));
        }
        let params = self.gaussians(&primitive["attributes"])?;
        let mut layer = still(params).layers.remove(0);
        // Drafts of the extension had logarithms here.
        let scales = &layer.params[GEOMETRY];
        let negative = (0..scales.rows()).any(|row| scales.read::<3>(row, LOG_SCALE).iter().any(|s| *s < 0.0));
        if negative {
            let what = "scales below 0 are read as logarithms, as drafts of the extension had them";
            warnings_once(warnings, Some(what.to_owned()));
        } else {
            warnings.append(from_linear(&mut layer, Linear::Scales));
        }
        warnings.append(from_linear(&mut layer, Linear::Opacities));
        Ok(Some(layer.params))
    }

    /// The Gaussians of an .spz in a buffer. Its numbers are in the axes of the file.
    fn spz(&self, extension: &Value, warnings: &mut Warnings) -> Result<Params> {
        let view = index(&extension["bufferView"]).ok_or_else(|| damaged("its .spz names no bufferView"))?;
        let (params, _, mut said) = spz::read(self.view(view, "its .spz")?.0)?;
        // An .spz alone is taken for a .ply; this one has the axes of glTF.
        said.drop(spz::AXES_ASSUMED);
        warnings.append(said);
        Ok(params)
    }

    /// Bytes of a buffer view from its beginning to its end, and its stride.
    fn view(&self, view: usize, name: &str) -> Result<(&[u8], Option<usize>)> {
        let view = &self.json["bufferViews"][view];
        let outside = || damaged(format!("{name} lies outside the file"));
        let buffer = index(&view["buffer"]).and_then(|b| self.buffers.get(b)).ok_or_else(outside)?;
        let begin = index(&view["byteOffset"]).unwrap_or(0);
        let end = index(&view["byteLength"]).and_then(|length| begin.checked_add(length)).ok_or_else(outside)?;
        Ok((buffer.get(begin..end).ok_or_else(outside)?, index(&view["byteStride"])))
    }

    /// Meshes and where the default scene's nodes place them; all meshes unplaced where there are no nodes.
    fn placed(&self) -> Result<Vec<(usize, Sim3)>> {
        let nodes = self.json["nodes"].as_array().map_or(&[][..], Vec::as_slice);
        let scene = &self.json["scenes"][index(&self.json["scene"]).unwrap_or(0)]["nodes"];
        let roots = scene.as_array().into_iter().flatten().filter_map(index);
        let mut open: Vec<(usize, Sim3, usize)> = roots.map(|i| (i, Sim3::IDENTITY, 0)).collect();
        let (mut out, mut steps) = (Vec::new(), 0);
        while let Some((i, above, depth)) = open.pop() {
            let node = nodes.get(i).ok_or_else(|| damaged(format!("there is no node {i}")))?;
            steps += 1;
            if depth > DEEPEST || steps > nodes.len() {
                return Err(damaged("its nodes contain each other"));
            }
            let frame = above.after(&placement(node).map_err(|e| e.at(format!("node {i}")))?);
            out.extend(index(&node["mesh"]).map(|mesh| (mesh, frame)));
            open.extend(
                node["children"].as_array().into_iter().flatten().filter_map(index).map(|c| (c, frame, depth + 1)),
            );
        }
        if out.is_empty() {
            let meshes = self.json["meshes"].as_array().map_or(0, Vec::len);
            out = (0..meshes).map(|mesh| (mesh, Sim3::IDENTITY)).collect();
        }
        Ok(out)
    }

    /// The Gaussians of a primitive; scales and opacities as stored.
    fn gaussians(&self, attributes: &Value) -> Result<Params> {
        let of = |name: &str| &attributes[format!("{EXTENSION}:{name}")];
        let means = self.numbers(&attributes["POSITION"], 3, "POSITION", usize::MAX)?;
        let count = means.len() / 3;
        let own = |name: &str, width: usize| self.numbers(of(name), width, name, count);
        let (quats, scales, alphas) = (own("ROTATION", 4)?, own("SCALE", 3)?, own("OPACITY", 1)?);
        let degree = (0..=3).take_while(|l| !attributes[coefficient(*l, 2 * l)].is_null()).last();
        let degree = degree.ok_or_else(|| damaged("its Gaussians have no colour (SH_DEGREE_0_COEF_0)"))?;
        let mut params = Params::new(count, (degree + 1) * (degree + 1), &[]);
        let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
        for row in 0..count {
            let part = |v: &[f32], k: usize, width: usize| v[width * row + k];
            geometry.write(row, 0, std::array::from_fn::<f32, 3, _>(|k| part(&means, k, 3)));
            geometry.write(row, QUAT, [3, 0, 1, 2].map(|k| part(&quats, k, 4)));
            geometry.write(row, LOG_SCALE, std::array::from_fn::<f32, 3, _>(|k| part(&scales, k, 3)));
            geometry.set(row, OPACITY, alphas[row]);
        }
        let mut first = 0;
        for l in 0..=degree {
            for n in 0..=2 * l {
                let name = coefficient(l, n);
                let values = self.numbers(&attributes[&name], 3, &name, count)?;
                (0..count).for_each(|row| (0..3).for_each(|c| sh.set(row, first + c, values[3 * row + c])));
                first += 3;
            }
        }
        Ok(params)
    }

    /// All numbers of an accessor of `width` components; `count`: how many there must be, [`usize::MAX`]: any.
    fn numbers(&self, accessor: &Value, width: usize, name: &str, count: usize) -> Result<Vec<f32>> {
        let accessor = index(accessor).ok_or_else(|| damaged(format!("its Gaussians have no {name}")))?;
        let accessor = &self.json["accessors"][accessor];
        let own = index(&accessor["count"]).ok_or_else(|| damaged(format!("{name} has no count")))?;
        let kind = TYPES[width];
        if accessor["type"] != kind || count != usize::MAX && own != count || !accessor["sparse"].is_null() {
            return Err(damaged(format!("{name} is not {kind}, sparse, or not of one value for each Gaussian")));
        }
        let stored = accessor["componentType"].as_u64();
        // Bytes of a component, and what divides a normalised integer.
        let (size, most) = match stored {
            Some(component::BYTE) => (1, 127.0),
            Some(component::UNSIGNED_BYTE) => (1, 255.0),
            Some(component::SHORT) => (2, 32767.0),
            Some(component::UNSIGNED_SHORT) => (2, 65535.0),
            Some(component::FLOAT) => (4, 1.0),
            other => return Err(unsupported(format!("{name} has components of type {other:?}"))),
        };
        // Only scales and positions may be whole numbers that mean themselves.
        let whole = accessor["normalized"] != true && ["POSITION", "SCALE"].contains(&name);
        let most = if whole { 1.0 } else { most };
        let signed = matches!(stored, Some(component::BYTE | component::SHORT));
        let view = index(&accessor["bufferView"])
            .ok_or_else(|| unsupported(format!("{name} does not lie in the file itself")))?;
        let (view, stride) = self.view(view, name)?;
        let begin = index(&accessor["byteOffset"]).unwrap_or(0);
        let stride = stride.unwrap_or(width * size);
        let end = own.checked_sub(1).map_or(Some(0), |rows| rows.checked_mul(stride)?.checked_add(width * size));
        let bytes = end.and_then(|end| view.get(begin..begin.checked_add(end)?));
        let bytes =
            bytes.filter(|_| stride >= width * size).ok_or_else(|| damaged(format!("{name} lies outside the file")))?;
        let mut out = Vec::with_capacity(own * width);
        for row in 0..own {
            for k in 0..width {
                let b = &bytes[row * stride + k * size..][..size];
                out.push(match (size, signed) {
                    (1, true) => f32::from(b[0] as i8) / most,
                    (1, false) => f32::from(b[0]) / most,
                    (2, true) => f32::from(i16::from_le_bytes([b[0], b[1]])) / most,
                    (2, false) => f32::from(u16::from_le_bytes([b[0], b[1]])) / most,
                    _ => f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
                });
            }
        }
        Ok(out)
    }
}

/// Adds a remark that several meshes may share.
fn warnings_once(warnings: &mut Warnings, text: Option<String>) {
    let mut one = Warnings::default();
    text.into_iter().for_each(|text| one.add(text));
    warnings.append(one);
}

/// Placement of a node in its parent. Errors: axes of different scale, mirrors.
fn placement(node: &Value) -> Result<Sim3> {
    let numbers = |key: &str, count: usize| -> Option<Vec<f64>> {
        let list = node[key].as_array().filter(|l| l.len() == count)?;
        list.iter().map(|v| v.as_f64().filter(|x| x.is_finite())).collect()
    };
    let sim = if let Some(m) = numbers("matrix", 16) {
        // Column-major.
        let lengths: Vec<f64> = (0..3).map(|c| (0..3).map(|r| m[4 * c + r].powi(2)).sum::<f64>().sqrt()).collect();
        if lengths.iter().any(|l| (l - lengths[0]).abs() > UNIFORM * lengths[0]) {
            return Err(unsupported("it scales axes differently"));
        }
        let rotation = std::array::from_fn(|r| std::array::from_fn(|c| m[4 * c + r] / lengths[0]));
        Sim3 { scale: lengths[0], rotation, translation: [m[12], m[13], m[14]] }
    } else {
        let scale = numbers("scale", 3).unwrap_or(vec![1.0; 3]);
        if scale.iter().any(|s| (s - scale[0]).abs() > UNIFORM * scale[0].abs()) {
            return Err(unsupported("it scales axes differently"));
        }
        let q = numbers("rotation", 4).map_or([1.0, 0.0, 0.0, 0.0], |q| [q[3], q[0], q[1], q[2]]);
        let t = numbers("translation", 3).unwrap_or(vec![0.0; 3]);
        Sim3 { scale: scale[0], rotation: quat::to_rotation(quat::normalize(q).0), translation: [t[0], t[1], t[2]] }
    };
    if sim.is_sound() { Ok(sim) } else { Err(unsupported("its placement is not a rotation with a scale above zero")) }
}
