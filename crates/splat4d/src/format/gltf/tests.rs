use super::*;
use crate::Result;
use crate::format::dialect::{Opened, WriteOptions, still};
use crate::format::samples::{gaussians, worst};
use crate::format::spz;
use crate::layers::Scene;
use crate::scene::params::LOG_SCALE;
use crate::scene::{GEOMETRY, Params};
use serde_json::{Value, json};
use std::collections::BTreeMap;

fn written(dialect: Dialect, params: &Params) -> Vec<u8> {
    let mut bytes = Vec::new();
    let scene = Scene { up: Y_UP, ..still(params.clone()) };
    dialect.write(&scene, &WriteOptions::default(), &mut bytes).unwrap();
    bytes
}

/// The JSON of a .glb and its chunk.
fn parts(glb: &[u8]) -> (Value, Vec<u8>) {
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    (serde_json::from_slice(&glb[20..20 + length]).unwrap(), glb[28 + length..].to_vec())
}

/// A .glb of this JSON and chunk.
fn joined(json: &Value, bin: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let file = container::File { json: json.clone(), buffers: vec![bin.into()], size: 0 };
    file.write_binary(&mut out).unwrap();
    out
}

/// Gaussians of `params` after a change of the JSON.
fn changed(params: &Params, change: impl Fn(&mut Value)) -> Result<Opened> {
    let (mut json, bin) = parts(&written(DIALECT, params));
    change(&mut json);
    DIALECT.open(&joined(&json, &bin))
}

#[test]
fn gaussians_round_trip_in_both_containers() {
    let p = gaussians(60, 16);
    for dialect in [DIALECT, TEXT] {
        let opened = dialect.open(&written(dialect, &p)).unwrap();
        let w = worst(&p, &opened.scene.layers[0].params);
        assert!(w.mean == 0.0 && w.turn < 1e-6 && w.log_scale < 1e-5 && w.opacity < 1e-6, "{dialect:?}: {w:?}");
        assert!(w.sh == 0.0 && w.dc == 0.0, "{w:?}");
        assert!(opened.warnings.lines().is_empty(), "{:?}", opened.warnings);
    }
}

/// Numbers of the specification, read here without our reader.
#[test]
fn the_bytes_are_those_of_the_specification() {
    let p = gaussians(7, 4);
    let glb = written(DIALECT, &p);
    assert_eq!(u32::from_le_bytes(glb[8..12].try_into().unwrap()) as usize, glb.len());
    assert_eq!((&glb[..4], &glb[4..8], &glb[16..20]), (&b"glTF"[..], &[2, 0, 0, 0][..], &b"JSON"[..]));
    let (json, bin) = parts(&glb);
    let primitive = &json["meshes"][0]["primitives"][0];
    assert_eq!(primitive["extensions"][EXTENSION], json!({"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}));
    assert_eq!((&json["extensionsUsed"], &primitive["mode"]), (&json!([EXTENSION]), &json!(0)));
    assert_eq!(json["buffers"][0]["byteLength"], bin.len());
    let numbers = |name: &str| -> Vec<f32> {
        let accessor = &json["accessors"][primitive["attributes"][name].as_u64().unwrap() as usize];
        let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
        let (at, length) =
            (view["byteOffset"].as_u64().unwrap() as usize, view["byteLength"].as_u64().unwrap() as usize);
        assert!(at.is_multiple_of(4) && accessor["count"] == 7, "{name}");
        bin[at..at + length].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
    };
    let (q, raw) = (numbers("KHR_gaussian_splatting:ROTATION"), p[GEOMETRY].read::<4>(2, 3));
    let norm = raw.iter().map(|x| x * x).sum::<f32>().sqrt();
    // x y z w.
    (0..4).for_each(|k| assert!((q[8 + k] - raw[(k + 1) % 4] / norm).abs() < 1e-6));
    assert!((numbers("KHR_gaussian_splatting:SCALE")[7] - p[GEOMETRY].get(2, LOG_SCALE + 1).exp()).abs() < 1e-6);
    assert_eq!(numbers("KHR_gaussian_splatting:SH_DEGREE_1_COEF_2")[3..6], p[crate::scene::SH].read::<3>(1, 9));
    let (means, position) = (numbers("POSITION"), &json["accessors"][0]);
    for k in 0..3 {
        let least = means[k..].iter().step_by(3).copied().fold(f32::INFINITY, f32::min);
        assert_eq!(position["min"][k].as_f64().unwrap() as f32, least);
    }
}

#[test]
fn nodes_place_meshes() {
    let p = gaussians(9, 9);
    let moved = changed(&p, |json| {
        json["nodes"] = json!([{"children": [1]}, {"mesh": 0, "translation": [1.0, -2.0, 3.0]}]);
    });
    let (a, b) = (p[GEOMETRY].read::<3>(7, 0), moved.unwrap().scene.layers[0].params[GEOMETRY].read::<3>(7, 0));
    assert!((b[0] - a[0] - 1.0).abs() < 1e-5 && (b[1] - a[1] + 2.0).abs() < 1e-5, "{a:?} {b:?}");
    let twice = changed(&p, |json| {
        json["nodes"] = json!([{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "scale": [2, 2, 2]}]);
    });
    assert_eq!(twice.unwrap().scene.len(), 18);
}

#[test]
fn an_spz_inside_is_written_and_read() {
    let p = gaussians(60, 16);
    let (bytes, mut alone) = (written(COMPRESSED, &p), Vec::new());
    assert_eq!(Dialect::of(&bytes), Some(COMPRESSED));
    let opened = COMPRESSED.open(&bytes).unwrap();
    spz::write(&p, 2, Y_UP, &mut alone).unwrap();
    let (expected, ..) = spz::read(&alone).unwrap();
    let w = worst(&expected, &opened.scene.layers[0].params);
    assert!(w.mean == 0.0 && w.sh == 0.0 && w.log_scale == 0.0, "{w:?}");
    assert!(opened.scene.up == Y_UP && opened.warnings.lines().is_empty(), "{:?}", opened.warnings);
    let (json, bin) = parts(&bytes);
    assert!(bin.starts_with(&[0x1F, 0x8B]) && json["extensionsRequired"][1] == SPZ[0]);
    let attributes = json["meshes"][0]["primitives"][0]["attributes"].as_object().unwrap();
    assert_eq!(attributes.len(), 4 + 15, "{attributes:?}");
    // The name of a former draft, next to the base extension.
    let mut old = json.clone();
    old["meshes"][0]["primitives"][0]["extensions"] = json!({SPZ[2]: {"bufferView": 0}});
    assert_eq!(DIALECT.open(&joined(&old, &bin)).unwrap().scene.len(), 60);
    old["meshes"][0]["primitives"][0]["extensions"] = json!({SPZ[2]: {"bufferView": 9}});
    assert!(DIALECT.open(&joined(&old, &bin)).unwrap_err().to_string().contains("outside the file"));
}

#[test]
fn quantised_numbers_and_drafts_are_read() {
    let p = gaussians(4, 1);
    // Scales as whole bytes that mean themselves, and the same normalised.
    for (normalized, expected) in [(false, 3.0f32), (true, 3.0 / 255.0)] {
        let (mut json, mut bin) = parts(&written(DIALECT, &p));
        json["bufferViews"][3] = json!({"buffer": 0, "byteOffset": bin.len(), "byteLength": 16, "byteStride": 4});
        bin.extend([[3u8, 1, 2, 0]; 4].concat());
        let accessor = &mut json["accessors"][3];
        (accessor["componentType"], accessor["normalized"]) = (json!(5121), json!(normalized));
        let opened = DIALECT.open(&joined(&json, &bin)).unwrap();
        let scale = opened.scene.layers[0].params[GEOMETRY].get(1, LOG_SCALE);
        assert!((scale - expected.ln()).abs() < 1e-5, "{scale} {expected}");
    }
    // Logarithms of a draft.
    let (json, mut bin) = parts(&written(DIALECT, &p));
    let at = json["bufferViews"][3]["byteOffset"].as_u64().unwrap() as usize;
    for row in 0..4 {
        let logs = p[GEOMETRY].read::<3>(row, LOG_SCALE);
        (0..3).for_each(|k| bin[at + 12 * row + 4 * k..][..4].copy_from_slice(&logs[k].to_le_bytes()));
    }
    let opened = DIALECT.open(&joined(&json, &bin)).unwrap();
    assert_eq!(worst(&p, &opened.scene.layers[0].params).log_scale, 0.0);
    assert!(opened.warnings.lines()[0].contains("logarithms"), "{:?}", opened.warnings);
}

#[test]
fn a_gltf_with_an_external_buffer_is_read() {
    let p = gaussians(5, 1);
    let (mut json, bin) = parts(&written(DIALECT, &p));
    json["buffers"][0]["uri"] = json!("scene%20a.bin");
    let text = json.to_string();
    assert_eq!(buffers_of(text.as_bytes()).unwrap(), ["scene%20a.bin"]);
    let alone = TEXT.open(text.as_bytes()).unwrap_err().to_string();
    assert!(alone.contains("scene%20a.bin"), "{alone}");
    let files = BTreeMap::from([("scene%20a.bin".to_owned(), bin)]);
    assert_eq!(read_text(text.as_bytes(), &files).unwrap().scene.len(), 5);
}

#[test]
fn inconsistent_and_foreign_files_are_refused() {
    let p = gaussians(5, 1);
    let says = |change: &dyn Fn(&mut Value)| changed(&p, change).unwrap_err().to_string();
    assert!(says(&|j| j["accessors"][2]["count"] = json!(9)).contains("one value for each"));
    assert!(says(&|j| j["nodes"] = json!([{"children": [0]}])).contains("contain each other"));
    assert!(says(&|j| j["meshes"][0]["primitives"][0]["extensions"] = json!({})).contains("no Gaussians"));
    assert!(says(&|j| j["accessors"][0]["componentType"] = json!(5125)).contains("components"));
    assert!(says(&|j| j["bufferViews"][0]["byteLength"] = json!(4)).contains("outside the file"));
    assert!(says(&|j| j["nodes"][0]["scale"] = json!([1, 2, 1])).contains("differently"));
    let own = "KHR_x_compression";
    let other =
        |j: &mut Value| j["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["extensions"] = json!({own: {}});
    assert!(says(&other).contains(own));
    // One mesh placed very often.
    let many = |j: &mut Value| {
        let mut nodes = vec![json!({"children": (1..30_000).collect::<Vec<_>>()})];
        nodes.resize(30_000, json!({"mesh": 0}));
        j["nodes"] = Value::from(nodes);
        j["meshes"][0]["primitives"] = Value::from(vec![j["meshes"][0]["primitives"][0].clone(); 200]);
    };
    assert!(says(&many).contains("more than it has bytes"));
    let bytes = written(DIALECT, &p);
    for cut in (0..bytes.len()).step_by(7) {
        let _ = DIALECT.open(&bytes[..cut]);
    }
    assert!(TEXT.open(br#"{"asset": {"version": "1.0"}}"#).unwrap_err().to_string().contains("version `1.0`"));
    assert!(!container::is_text(br#"{"version": 2}"#));
}
