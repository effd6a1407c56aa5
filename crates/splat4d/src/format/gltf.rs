//! glTF 2.0 (`.glb`) with the extension KHR_gaussian_splatting, read: a mesh of points whose attributes are Gaussians.
//!
//! `KHR_gaussian_splatting:ROTATION` is a quaternion x y z w, `:SCALE` and `:OPACITY` are **activated** (lengths, alpha),
//! `:SH_DEGREE_l_COEF_n` are the coefficients of red, green and blue. World axes: **y up**. Nodes place meshes.
//! Source: KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting.

use super::dialect::{Dialect, Opened, Writer, Y_UP, still};
use super::mend::{Linear, from_linear};
use super::warnings::Warnings;
use crate::layers::{Layer, Scene};
use crate::math::{Sim3, quat};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH};
use crate::{Error, ErrorKind, Result};
use serde_json::Value;

/// glTF with Gaussians.
pub const DIALECT: Dialect = Dialect {
    name: "glTF (KHR_gaussian_splatting)",
    ending: ".glb",
    up: Y_UP,
    moves: false,
    mark: Some(|bytes| bytes.starts_with(b"glTF")),
    read,
    writer: Writer::None("Write .ply; splat-transform makes .glb of it."),
    world: false,
};

/// The extension's name, of attributes too.
const EXTENSION: &str = "KHR_gaussian_splatting";
/// Chunk types of a .glb.
const JSON: u32 = 0x4E4F_534A;
const BIN: u32 = 0x004E_4942;
/// Deepest nesting of nodes that is followed.
const DEEPEST: usize = 64;
/// Relative difference of the scales of a node's axes that count as one.
const UNIFORM: f64 = 1e-4;

fn damaged(what: impl std::fmt::Display) -> Error {
    Error::input(format!("this .glb file is damaged: {what}")).remedy("Copy or export it again.")
}

fn unsupported(what: impl std::fmt::Display) -> Error {
    Error::new(ErrorKind::Unsupported, what.to_string())
        .remedy("Export it with KHR_gaussian_splatting and without compression, or as .ply.")
}

/// A file's JSON and its binary chunk.
struct Glb<'a> {
    json: Value,
    bin: &'a [u8],
}

fn read(bytes: &[u8]) -> Result<Opened> {
    let file = Glb::open(bytes)?;
    let mut layers = Vec::new();
    let mut warnings = Warnings::default();
    for (mesh, frame) in file.placed()? {
        for primitive in file.json["meshes"][mesh]["primitives"].as_array().into_iter().flatten() {
            if primitive["extensions"][EXTENSION].is_null() {
                continue;
            }
            let further: Vec<&String> = primitive["extensions"][EXTENSION]["extensions"]
                .as_object()
                .into_iter()
                .flat_map(|o| o.keys())
                .collect();
            if let Some(name) = further.first() {
                return Err(unsupported(format!("its Gaussians are stored by {name}, which is not read")));
            }
            let mut layer = still(file.gaussians(&primitive["attributes"])?).layers.remove(0);
            warnings.append(from_linear(&mut layer, Linear::Scales));
            warnings.append(from_linear(&mut layer, Linear::Opacities));
            layer.frame = frame;
            layer.absorb_frame();
            layers.push(layer);
        }
    }
    if layers.is_empty() {
        return Err(unsupported(format!("this .glb file holds no Gaussians ({EXTENSION})")));
    }
    if layers.len() > 1 {
        layers.iter_mut().enumerate().for_each(|(i, l): (usize, &mut Layer<f32>)| l.name = format!("gaussians {i}"));
    }
    let scene = Scene { layers, ..still(Params::new(0, 1, &[])) };
    Ok(Opened::from((scene, warnings)))
}

impl<'a> Glb<'a> {
    fn open(bytes: &'a [u8]) -> Result<Self> {
        let word = |at: usize| {
            let b = bytes.get(at..at + 4).ok_or_else(|| damaged("it is cut short"))?;
            Ok::<u32, Error>(u32::from_le_bytes(*b.first_chunk().expect("four bytes were taken")))
        };
        if word(4)? != 2 {
            return Err(unsupported(format!("the file has version {} of glTF, not 2", word(4)?)));
        }
        let (mut at, mut json, mut bin) = (12, None, &[][..]);
        while at + 8 <= bytes.len() {
            let (length, kind) = (word(at)? as usize, word(at + 4)?);
            let chunk = bytes.get(at + 8..(at + 8).saturating_add(length)).ok_or_else(|| damaged("it is cut short"))?;
            match kind {
                JSON if json.is_none() => {
                    json = Some(serde_json::from_slice(chunk).map_err(|e| damaged(format!("its JSON: {e}")))?);
                }
                BIN if bin.is_empty() => bin = chunk,
                _ => {}
            }
            at += 8 + length.next_multiple_of(4);
        }
        Ok(Self { json: json.ok_or_else(|| damaged("it has no JSON"))?, bin })
    }

    /// Meshes and where the default scene's nodes place them; all meshes as they are where there are no nodes.
    fn placed(&self) -> Result<Vec<(usize, Sim3)>> {
        let index = |v: &Value| v.as_u64().and_then(|i| usize::try_from(i).ok());
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

    /// The Gaussians of a primitive; scales and opacities are as they are stored.
    fn gaussians(&self, attributes: &Value) -> Result<Params> {
        let of = |name: &str| &attributes[format!("{EXTENSION}:{name}")];
        let means = self.numbers(&attributes["POSITION"], 3, "POSITION", usize::MAX)?;
        let count = means.len() / 3;
        let own = |name: &str, width: usize| self.numbers(of(name), width, name, count);
        let (quats, scales, alphas) = (own("ROTATION", 4)?, own("SCALE", 3)?, own("OPACITY", 1)?);
        let degree = (0..=3).take_while(|l| !of(&format!("SH_DEGREE_{l}_COEF_{}", 2 * l)).is_null()).last();
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
                let values = own(&format!("SH_DEGREE_{l}_COEF_{n}"), 3)?;
                (0..count).for_each(|row| (0..3).for_each(|c| sh.set(row, first + c, values[3 * row + c])));
                first += 3;
            }
        }
        Ok(params)
    }

    /// All numbers of an accessor of `width` components; `count`: how many there must be, [`usize::MAX`]: any.
    fn numbers(&self, accessor: &Value, width: usize, name: &str, count: usize) -> Result<Vec<f32>> {
        let number = |v: &Value| v.as_u64().and_then(|n| usize::try_from(n).ok());
        let index = number(accessor).ok_or_else(|| damaged(format!("its Gaussians have no {name}")))?;
        let accessor = &self.json["accessors"][index];
        let own = number(&accessor["count"]).ok_or_else(|| damaged(format!("{name} has no count")))?;
        let kind = ["", "SCALAR", "VEC2", "VEC3", "VEC4"][width];
        if accessor["type"] != kind || count != usize::MAX && own != count || !accessor["sparse"].is_null() {
            return Err(damaged(format!("{name} is not {kind}, sparse, or not of one value for each Gaussian")));
        }
        // Bytes of a component, and what divides a normalised integer.
        let (size, most) = match number(&accessor["componentType"]) {
            Some(5120) => (1, 127.0),
            Some(5121) => (1, 255.0),
            Some(5122) => (2, 32767.0),
            Some(5123) => (2, 65535.0),
            Some(5126) => (4, 1.0),
            other => return Err(unsupported(format!("{name} has components of type {other:?}"))),
        };
        let signed = matches!(number(&accessor["componentType"]), Some(5120 | 5122));
        let view = number(&accessor["bufferView"]).map(|v| &self.json["bufferViews"][v]);
        let view = view
            .filter(|v| number(&v["buffer"]) == Some(0))
            .ok_or_else(|| unsupported(format!("{name} does not lie in the file itself")))?;
        let begin = number(&view["byteOffset"]).unwrap_or(0).checked_add(number(&accessor["byteOffset"]).unwrap_or(0));
        let stride = number(&view["byteStride"]).unwrap_or(width * size);
        let end = own.checked_sub(1).map_or(Some(0), |rows| rows.checked_mul(stride)?.checked_add(width * size));
        let bytes = begin.zip(end).and_then(|(begin, end)| self.bin.get(begin..begin.checked_add(end)?));
        let bytes =
            bytes.filter(|_| stride >= width * size).ok_or_else(|| damaged(format!("{name} lies outside the file")))?;
        let mut out = Vec::with_capacity(own * width);
        for row in 0..own {
            for k in 0..width {
                let b = &bytes[row * stride + k * size..][..size];
                out.push(match (size, signed) {
                    (1, true) => (f32::from(b[0] as i8) / most).max(-1.0),
                    (1, false) => f32::from(b[0]) / most,
                    (2, true) => (f32::from(i16::from_le_bytes([b[0], b[1]])) / most).max(-1.0),
                    (2, false) => f32::from(u16::from_le_bytes([b[0], b[1]])) / most,
                    _ => f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
                });
            }
        }
        Ok(out)
    }
}

/// Where a node stands in the one above. Errors: axes of different scale, mirrors.
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

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::format::samples::{gaussians, worst};
    use serde_json::json;

    /// Gaussians as a .glb whose only node is moved by `translation`.
    pub(crate) fn sample(params: &Params, translation: [f64; 3]) -> Vec<u8> {
        let (g, sh, n) = (&params[GEOMETRY], &params[SH], params.len());
        let (mut bin, mut views, mut accessors, mut attributes) = (Vec::new(), Vec::new(), Vec::new(), json!({}));
        let mut add = |name: String, width: usize, value: &dyn Fn(usize, usize) -> f32| {
            views.push(json!({"buffer": 0, "byteOffset": bin.len(), "byteLength": 4 * width * n}));
            (0..n).for_each(|r| (0..width).for_each(|k| bin.extend(value(r, k).to_le_bytes())));
            let kind = ["", "SCALAR", "VEC2", "VEC3", "VEC4"][width];
            attributes[name] = json!(accessors.len());
            accessors.push(json!({"bufferView": accessors.len(), "componentType": 5126, "count": n, "type": kind}));
        };
        add("POSITION".into(), 3, &|r, k| g.get(r, k));
        add(format!("{EXTENSION}:ROTATION"), 4, &|r, k| g.get(r, QUAT + [1, 2, 3, 0][k]));
        add(format!("{EXTENSION}:SCALE"), 3, &|r, k| g.get(r, LOG_SCALE + k).exp());
        add(format!("{EXTENSION}:OPACITY"), 1, &|r, _| 1.0 / (1.0 + (-g.get(r, OPACITY)).exp()));
        let mut first = 0;
        for l in 0..(sh.width() / 3).isqrt() {
            for c in 0..=2 * l {
                add(format!("{EXTENSION}:SH_DEGREE_{l}_COEF_{c}"), 3, &|r, k| sh.get(r, first + k));
                first += 3;
            }
        }
        let primitive = json!({"attributes": attributes, "mode": 0, "extensions": {EXTENSION: {"kernel": "ellipse"}}});
        let json = json!({"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
            "nodes": [{"children": [1]}, {"mesh": 0, "translation": translation}],
            "meshes": [{"primitives": [primitive]}], "buffers": [{"byteLength": bin.len()}],
            "bufferViews": views, "accessors": accessors});
        let mut json = json.to_string().into_bytes();
        json.resize(json.len().next_multiple_of(4), b' ');
        let total = 12 + 8 + json.len() + 8 + bin.len();
        let mut out = b"glTF".to_vec();
        for (word, body) in [(JSON, &json), (BIN, &bin)] {
            if out.len() == 4 {
                out.extend(2u32.to_le_bytes());
                out.extend((total as u32).to_le_bytes());
            }
            out.extend((body.len() as u32).to_le_bytes());
            out.extend(word.to_le_bytes());
            out.extend(body);
        }
        out
    }

    #[test]
    fn gaussians_come_back_and_nodes_place_them() {
        let p = gaussians(60, 9);
        let opened = DIALECT.open(&sample(&p, [0.0; 3])).unwrap();
        let w = worst(&p, &opened.scene.layers[0].params);
        assert!(w.mean == 0.0 && w.turn < 1e-3 && w.log_scale < 1e-5 && w.opacity < 1e-6 && w.sh == 0.0, "{w:?}");
        assert!(opened.warnings.lines().is_empty(), "{:?}", opened.warnings);
        let moved = DIALECT.open(&sample(&p, [1.0, -2.0, 3.0])).unwrap();
        let (a, b) = (p[GEOMETRY].read::<3>(7, 0), moved.scene.layers[0].params[GEOMETRY].read::<3>(7, 0));
        assert!((b[0] - a[0] - 1.0).abs() < 1e-5 && (b[1] - a[1] + 2.0).abs() < 1e-5, "{a:?} {b:?}");
    }

    #[test]
    fn lies_and_foreign_files_are_refused() {
        let bytes = sample(&gaussians(5, 1), [0.0; 3]);
        let with = |from: &str, to: &str| {
            assert_eq!(from.len(), to.len());
            let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
            let mut b = bytes.clone();
            b[at..at + to.len()].copy_from_slice(to.as_bytes());
            read(&b).unwrap_err().to_string()
        };
        assert!(with("\"count\":5", "\"count\":9").contains("one value for each"));
        assert!(with("\"children\":[1]", "\"children\":[0]").contains("contain each other"));
        assert!(with("\"extensions\":{\"KHR_g", "\"extensions\":{\"KHR_h").contains("no Gaussians"));
        assert!(with("\"componentType\":5126", "\"componentType\":5125").contains("components"));
        for cut in (0..bytes.len()).step_by(7) {
            let _ = read(&bytes[..cut]);
        }
    }
}
