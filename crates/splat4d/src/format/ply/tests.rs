use super::*;
use crate::format::dialect::WriteOptions;
use crate::format::mutate::mutants;
use crate::format::samples::gaussians;
use crate::math::Rng;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use std::time::Instant;

fn random(rows: usize, coefficients: usize) -> Params {
    let mut p = Params::new(rows, coefficients, &[]);
    for (key, stream) in [(GEOMETRY, 0), (SH, 1)] {
        let rng = Rng::new(4, "ply", stream);
        let width = p[key].width();
        for row in 0..rows {
            for col in 0..width {
                p[key].set(row, col, rng.normal((row * width + col) as u64) as f32);
            }
        }
    }
    p
}

fn written(p: &Params) -> Vec<u8> {
    let mut out = Vec::new();
    write(p, &mut out).unwrap();
    out
}

/// A file from header lines and a body.
fn file(lines: &[&str], body: &[u8]) -> Vec<u8> {
    let mut out = lines.join("\n").into_bytes();
    out.push(b'\n');
    out.extend(body);
    out
}

const ONE_GAUSSIAN: &str = "property float x\nproperty float y\nproperty float z\nproperty float f_dc_0\n\
    property float f_dc_1\nproperty float f_dc_2\nproperty float opacity\nproperty float scale_0\n\
    property float scale_1\nproperty float scale_2\nproperty float rot_0\nproperty float rot_1\n\
    property float rot_2\nproperty float rot_3";

#[test]
fn every_degree_round_trips_bit_for_bit() {
    for (degree, coefficients) in [1, 4, 9, 16].into_iter().enumerate() {
        for rows in [0, 1, 16, 1000, 4097] {
            let p = random(rows, coefficients);
            let (back, info) = read(&written(&p)).unwrap();
            assert!(back == p, "{rows} rows of degree {degree}");
            let expected = PlyInfo { gaussians: rows, sh_degree: degree, ..PlyInfo::default() };
            assert_eq!(info, expected);
        }
    }
}

#[test]
fn the_written_layout_is_the_plain_one() {
    let mut p = Params::new(1, 16, &[]);
    for col in 0..11 {
        p[GEOMETRY].set(0, col, col as f32);
    }
    for col in 0..48 {
        p[SH].set(0, col, 100.0 + col as f32);
    }
    let bytes = written(&p);
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
    let row: Vec<f32> = bytes[end..].chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    // 62 numbers per row at degree 3, as every viewer expects.
    assert_eq!((names.len(), row.len()), (62, 62));
    let value = |name: &str| row[names.iter().position(|n| *n == name).unwrap()];
    assert_eq!(names[..7], ["x", "y", "z", "nx", "ny", "nz", "f_dc_0"]);
    assert_eq!(
        names[53..],
        ["f_rest_44", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    );
    assert_eq!(
        [value("x"), value("nz"), value("rot_0"), value("scale_2"), value("opacity")],
        [0.0, 0.0, 3.0, 9.0, 10.0]
    );
    // Coefficient 1 of red, green, blue: columns 3, 4, 5 here, 15 apart there.
    assert_eq!([value("f_rest_0"), value("f_rest_15"), value("f_rest_30")], [103.0, 104.0, 105.0]);
    assert_eq!(value("f_rest_44"), 147.0);
}

/// Text, CR LF, shuffled properties of several types, lists and other elements around.
#[test]
fn a_foreign_text_file_is_read() {
    let text = "ply\r\nformat ascii 1.0\r\ncomment made by hand\r\nelement camera 1\r\nproperty list uchar int ids\r\n\
        property float f\r\nelement vertex 2\r\nproperty double rot_3\r\nproperty float rot_2\r\n\
        property float rot_1\r\n\
        property float rot_0\r\nproperty float z\r\nproperty float y\r\nproperty int x\r\nproperty uchar label\r\n\
        property float opacity\r\nproperty float scale_0\r\nproperty float scale_1\r\nproperty float scale_2\r\n\
        property float f_dc_2\r\nproperty float f_dc_1\r\nproperty float f_dc_0\r\nelement face 1\r\n\
        property list uchar int vertex_indices\r\nend_header\r\n3 7 8 9 0.5\r\n\
        0.4 0.3 0.2 0.1 3 2 -1 9 -0.5 -4 -5 -6 .3 .2 .1\r\n4 3 2 1 30 20 10 9 nan 4 5 6 1e1 2e1 3e1\r\n3 0 1 1\r\n";
    let (p, info) = read(text.as_bytes()).unwrap();
    assert_eq!(p[GEOMETRY].read::<11>(0, 0), [-1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.4, -4.0, -5.0, -6.0, -0.5]);
    assert_eq!(p[GEOMETRY].read::<3>(1, 0), [10.0, 20.0, 30.0]);
    assert_eq!(p[SH].read::<3>(1, 0), [30.0, 20.0, 10.0]);
    assert_eq!((info.gaussians, info.sh_degree, info.non_finite_rows), (2, 0, 1));
    assert_eq!((info.comments, info.extra_properties), (vec!["made by hand".to_owned()], vec!["label".to_owned()]));
}

/// Big-endian with a list in front of and inside the rows.
#[test]
fn a_foreign_big_endian_file_is_read() {
    let names = ["x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
    let mut lines = vec!["ply", "format binary_big_endian 1.0", "element face 2", "property list ushort short i"];
    lines.extend(["element vertex 2", "property list uchar uchar history", "property short f_dc_0"]);
    lines.extend(["property uchar f_dc_1", "property double f_dc_2"]);
    let floats: Vec<String> = names.iter().map(|n| format!("property float {n}")).collect();
    lines.extend(floats.iter().map(String::as_str));
    lines.push("end_header");
    let mut body = vec![0, 2, 0, 1, 0, 2, 0, 0];
    for row in 0..2u8 {
        body.extend([row, 77][..1 + usize::from(row)].iter());
        body.extend((-300i16).to_be_bytes());
        body.push(200);
        body.extend(0.125f64.to_be_bytes());
        (0..11).for_each(|i| body.extend((f32::from(row) * 100.0 + i as f32).to_be_bytes()));
    }
    let (p, info) = read(&file(&lines, &body)).unwrap();
    assert_eq!(info.extra_properties, ["history"]);
    assert_eq!(p[SH].read::<3>(1, 0), [-300.0, 200.0, 0.125]);
    assert_eq!(p[GEOMETRY].read::<3>(1, 0), [100.0, 101.0, 102.0]);
    assert_eq!((p[GEOMETRY].get(1, OPACITY), p[GEOMETRY].get(1, LOG_SCALE)), (103.0, 104.0));
    assert_eq!(p[GEOMETRY].read::<4>(0, QUAT), [7.0, 8.0, 9.0, 10.0]);
}

/// A text file of one Gaussian a row: `types` and names of its properties, rows of numbers.
fn text(properties: &[(&str, &str)], rows: &[&str]) -> Vec<u8> {
    let lines: Vec<String> = properties.iter().map(|(kind, name)| format!("property {kind} {name}\n")).collect();
    let (count, rows) = (rows.len(), rows.join("\n"));
    format!("ply\nformat ascii 1.0\nelement vertex {count}\n{}end_header\n{rows}\n", lines.concat()).into_bytes()
}

const SHAPE: [(&str, &str); 8] = [
    ("float", "opacity"),
    ("float", "scale_0"),
    ("float", "scale_1"),
    ("float", "scale_2"),
    ("float", "rot_0"),
    ("float", "rot_1"),
    ("float", "rot_2"),
    ("float", "rot_3"),
];

#[test]
fn rgb_colours_are_base_colours() {
    for (kind, row) in [("uchar", "255 0 51"), ("float", "1 0 0.2")] {
        let rgb = ["red", "green", "blue"].map(|n| (kind, n));
        let properties = [&["x", "y", "z"].map(|n| ("float", n))[..], &rgb, &SHAPE].concat();
        let opened = DIALECT.open(&text(&properties, &[&format!("1 2 3 {row} 0.5 -4 -5 -6 1 0 0 0")])).unwrap();
        let colour = opened.scene.layers[0].params[SH].read::<3>(0, 0).map(|dc| 0.5 + SH_C0 * dc);
        assert!((0..3).all(|k| (colour[k] - [1.0, 0.0, 0.2][k]).abs() < 1e-6), "{colour:?}");
        let info = opened.ply.unwrap();
        assert!(info.rgb && info.extra_properties.is_empty() && opened.warnings.lines()[0].contains("RGB"));
    }
    // Coefficients have priority, and a point cloud stays one.
    let colors = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "red", "green", "blue"].map(|n| ("float", n));
    let both = [&colors[..], &SHAPE];
    let (p, info) = read(&text(&both.concat(), &["1 2 3 0.1 0.2 0.3 9 9 9 0.5 -4 -5 -6 1 0 0 0"])).unwrap();
    assert_eq!((p[SH].read::<3>(0, 0), info.rgb), ([0.1, 0.2, 0.3], false));
    let cloud = ["x", "y", "z", "red", "green", "blue"].map(|n| ("float", n));
    assert!(read(&text(&cloud, &["1 2 3 0 0 0"])).unwrap_err().to_string().contains("point cloud"));
}

/// A text file of the properties of 3D Gaussians that `keep` leaves, and `more` of them; every row has these numbers.
fn variant(keep: impl Fn(&str) -> bool, more: &[(&str, f32)], rows: usize) -> Vec<u8> {
    let base = [("x", 1.0), ("y", 2.0), ("z", 3.0), ("f_dc_0", 0.1), ("f_dc_1", 0.2), ("f_dc_2", -0.3)];
    let shape = SHAPE.map(|(_, n)| n).into_iter().zip([0.5, -4.0, -5.0, -6.0, 1.0, 0.0, 0.0, 0.0]);
    let all: Vec<(&str, f32)> =
        base.into_iter().chain(shape).filter(|(n, _)| keep(n)).chain(more.iter().copied()).collect();
    let row = all.iter().map(|(_, x)| x.to_string()).collect::<Vec<_>>().join(" ");
    text(&all.iter().map(|(n, _)| ("float", *n)).collect::<Vec<_>>(), &vec![row.as_str(); rows])
}

#[test]
fn files_of_other_methods_are_read_or_named() {
    let scales = |bytes: &[u8]| {
        let opened = DIALECT.open(bytes).unwrap();
        let g = &opened.scene.layers[0].params[GEOMETRY];
        (g.read::<3>(0, LOG_SCALE), g.get(0, OPACITY), opened.warnings.lines().join(" | "))
    };
    let (plain, opacity, said) = scales(&variant(|_| true, &[], 1));
    assert_eq!((plain, opacity, said.as_str()), ([-4.0, -5.0, -6.0], 0.5, ""));
    let (flat, _, said) = scales(&variant(|n| n != "scale_2", &[], 1));
    assert!(flat == [-4.0, -5.0, FLAT] && said.contains("2D Gaussian Splatting"), "{flat:?} {said}");
    let (sphere, _, said) = scales(&variant(|n| !["scale_1", "scale_2"].contains(&n), &[], 1));
    assert!(sphere == [-4.0; 3] && said.contains("spheres"), "{sphere:?} {said}");
    // A filter of e^-4 doubles the variance of the first direction.
    let filter = (-4.0f32).exp();
    let (wide, faint, said) = scales(&variant(|_| true, &[("filter_3D", filter)], 1));
    let sizes = [-4.0f64, -5.0, -6.0].map(|s: f64| ((2.0 * s).exp() + (-8.0f64).exp()).sqrt());
    let share = (-15.0f64).exp() / sizes.iter().product::<f64>();
    let alpha = share / (1.0 + (-0.5f64).exp());
    assert!((0..3).all(|k| (f64::from(wide[k]) - sizes[k].ln()).abs() < 1e-5), "{wide:?} {sizes:?}");
    assert!((f64::from(faint) - (alpha / (1.0 - alpha)).ln()).abs() < 1e-5 && said.contains("Mip-Splatting"), "{said}");
    assert_eq!(scales(&variant(|_| true, &[("filter_3D", 0.0)], 1)).0, plain);
    let (_, _, said) = scales(&variant(|_| true, &[("beta", 0.1)], 1));
    assert!(said.contains("`beta` of Deformable Beta Splatting is not read"), "{said}");
    let anchors = variant(|n| !n.starts_with("f_dc"), &[("f_anchor_feat_0", 0.1), ("f_offset_0", 0.1)], 1);
    let refused = DIALECT.open(&anchors).unwrap_err().to_string();
    assert!(refused.contains("anchors of Scaffold-GS"), "{refused}");
}

#[test]
fn a_byte_order_mark_and_comments_of_any_encoding_are_no_damage() {
    let plain = written(&random(3, 1));
    let mark = b"element vertex";
    let at = plain.windows(mark.len()).position(|w| w == mark).unwrap();
    let comment = b"comment D:\\B\xfcro \xc2\xb7\xbe\xb6\r\n";
    for prefix in [&b""[..], b"\xef\xbb\xbf"] {
        let bytes = [prefix, &plain[..at], comment, &plain[at..]].concat();
        assert_eq!(Dialect::of(&bytes), Some(DIALECT));
        let (params, info) = read(&bytes).unwrap();
        assert_eq!((params, info.comments.len()), (random(3, 1), 1));
    }
}

#[test]
fn rows_that_the_header_does_not_count_are_reported() {
    let said = |bytes: &[u8]| DIALECT.open(bytes).unwrap().warnings.lines().join(" | ");
    let mut binary = written(&gaussians(5, 1));
    assert_eq!(said(&binary), "");
    binary.extend([0; 68]);
    assert!(said(&binary).contains("68 bytes follow the 5 rows"), "{}", said(&binary));
    let rows = String::from_utf8(variant(|_| true, &[], 3)).unwrap();
    assert_eq!(said(format!("{rows}\n \n").as_bytes()), "", "space is nothing");
    let more = said(rows.replace("vertex 3", "vertex 2").as_bytes());
    assert!(more.contains("bytes follow the 2 rows") && more.contains("more rows than its header states"), "{more}");
    let (_, mut packed) = packed_sample();
    assert_eq!(said(&packed), "");
    packed.extend([1; 16]);
    assert!(said(&packed).contains("16 bytes follow"), "{}", said(&packed));
}

#[test]
fn meaningful_infinities_are_accepted() {
    // No writer of ours writes infinities: they take the place of numbers that occur once.
    let marks =
        [(1, OPACITY, 1234.5, f32::INFINITY), (2, LOG_SCALE, 2345.5, f32::NEG_INFINITY), (3, 0, 3456.5, f32::INFINITY)];
    let mut p = gaussians(4, 1);
    marks.iter().for_each(|&(row, column, mark, _)| p[GEOMETRY].set(row, column, mark));
    let mut bytes = written(&p);
    for (.., mark, value) in marks {
        let at = bytes.windows(4).position(|w| w == f32::to_le_bytes(mark)).unwrap();
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
    }
    let (back, info) = read(&bytes).unwrap();
    assert_eq!((info.mended.opaque, info.mended.flat, info.non_finite_rows), (1, 1, 1));
    assert!(back[GEOMETRY].get(1, OPACITY) > 10.0 && back[GEOMETRY].get(2, LOG_SCALE) < -10.0);
    let said = DIALECT.open(&bytes).unwrap().warnings;
    assert!(said.lines()[0].contains("1 of 4 Gaussians have opacity +infinity"), "{said:?}");
    // Nothing that can be rendered: no file.
    let mut lost = gaussians(2, 1);
    (0..2).for_each(|row| lost[GEOMETRY].set(row, 0, f32::NAN));
    let (scene, mut out) = (crate::format::dialect::still(lost), Vec::new());
    for dialect in crate::format::DIALECTS.iter().filter(|d| d.is_written() && !d.moves) {
        let error = dialect.write(&scene, &WriteOptions::default(), &mut out).unwrap_err().to_string();
        assert!(error.contains("NaN or infinite"), "{dialect:?}: {error}");
    }
}

#[test]
fn positions_of_a_map_keep_their_digits() {
    let center = [431_234.5, 5_412_345.6, 310.2];
    let mut scene = crate::format::dialect::still(gaussians(40, 1));
    scene.offset = center;
    let write = |world: bool| {
        let mut bytes = Vec::new();
        let options = WriteOptions { world, ..WriteOptions::default() };
        DIALECT.write(&scene, &options, &mut bytes).unwrap();
        bytes
    };
    let relative = DIALECT.open(&write(false)).unwrap().scene;
    assert_eq!((relative.offset, &relative.layers[0].params), (center, &scene.layers[0].params));
    let world = write(true);
    assert!(String::from_utf8_lossy(&world[..200]).contains("property double x"));
    assert!((read_points(&world).unwrap().positions[0][1] - center[1]).abs() < 20.0);
    let far = DIALECT.open(&world).unwrap();
    let place = |s: &crate::layers::Scene<f32>, row: usize| -> [f64; 3] {
        let own = s.layers[0].params[GEOMETRY].read::<3>(row, 0);
        std::array::from_fn(|k| f64::from(own[k]) + s.offset[k])
    };
    let apart = (0..40).flat_map(|row| (0..3).map(move |k| (row, k)));
    let apart = apart.map(|(row, k)| (place(&far.scene, row)[k] - place(&scene, row)[k]).abs()).fold(0.0, f64::max);
    assert!(apart < 1e-6 && far.scene.offset != [0.0; 3], "{apart}");
    assert!(far.warnings.lines().is_empty(), "{:?}", far.warnings);
    // Other formats cannot store such numbers.
    let options = WriteOptions { world: true, ..WriteOptions::default() };
    let refused = crate::format::splat::DIALECT.write(&scene, &options, &mut Vec::new()).unwrap_err();
    assert!(refused.to_string().contains("double precision"), "{refused}");
}

#[test]
fn inconsistent_headers_are_errors_with_a_reason() {
    let little = "format binary_little_endian 1.0";
    let counted =
        |count: &str| file(&["ply", little, &format!("element vertex {count}"), ONE_GAUSSIAN, "end_header"], &[0; 56]);
    let headed = |lines: &[&str]| file(&[&["ply"], lines, &["end_header"]].concat(), &[0; 400]);
    let degree_4 = (0..72).map(|i| format!("property float f_rest_{i}")).collect::<Vec<_>>().join("\n");
    let gap = (1..10).map(|i| format!("property float f_rest_{i}")).collect::<Vec<_>>().join("\n");
    let ascii_row =
        |row: &str| file(&["ply", "format ascii 1.0", "element vertex 1", ONE_GAUSSIAN, "end_header"], row.as_bytes());
    assert!(read(&counted("1")).is_ok());
    assert!(read(&ascii_row("0 0 0 0 0 0 0 0 0 0 1 0 0 0")).is_ok(), "a last row needs no line end");
    let cases = [
        (b"glTF".to_vec(), "not a PLY file"),
        (Vec::new(), "not a PLY file"),
        (file(&["ply", little, "element vertex 1"], &[]), "no `end_header`"),
        (file(&["ply", little, "comment \u{7}"], &[0xFF, 0xFE, b'\n']), "not text"),
        (headed(&["element vertex 1", ONE_GAUSSIAN]), "no `format`"),
        (headed(&["format binary_middle_endian 1.0"]), "binary_middle_endian"),
        (counted("2"), "claims 2 rows"),
        (counted("1152921504606846976"), "claims 1152921504606846976 rows"),
        (counted("18446744073709551615"), "claims 18446744073709551615 rows"),
        (counted("18446744073709551616"), "not a number of rows"),
        (counted("-1"), "not a number of rows"),
        (counted("1e3"), "not a number of rows"),
        (headed(&[little, "property float x"]), "precedes the first element"),
        (headed(&[little, "element vertex 1", "property float x", "property float x"]), "two properties called `x`"),
        (headed(&[little, "element vertex 1", "element vertex 1"]), "two elements called `vertex`"),
        (headed(&[little, "element vertex 1", "property quad x"]), "`quad`"),
        (headed(&[little, "element vertex 1", "property float"]), "should be"),
        (headed(&[little, "elephant vertex 1"]), "`elephant`"),
        (headed(&[little, "element face 1", "property float x"]), "no element `vertex`"),
        (headed(&[little, "element vertex 18446744073709551615"]), "lacks the properties x"),
        (headed(&[little, "element vertex 1", ONE_GAUSSIAN, &degree_4]), "72 f_rest"),
        (headed(&[little, "element vertex 1", ONE_GAUSSIAN, &gap]), "no `f_rest_0`"),
        (headed(&[little, "element vertex 1", &ONE_GAUSSIAN.replace("rot_2", "r")]), "lacks the properties rot_2"),
        (
            headed(&[little, "element a 1", "property list uint uchar l", "element vertex 1", ONE_GAUSSIAN])
                .into_iter()
                .map(|b| if b == 0 { 0xFF } else { b })
                .collect(),
            "row 0, property `l`: the file ends",
        ),
        (ascii_row("0 0 0 0 0 0 0 0 0 0 1 0 zero 0"), "property `rot_2`: `zero` is not a number"),
        (ascii_row("0 0 0 0 0 0 0 0 0 0 1 0                "), "property `rot_2`: the file ends"),
    ];
    for (bytes, needle) in cases {
        let error = read(&bytes).unwrap_err().to_string();
        assert!(error.contains(needle), "`{error}` should say `{needle}`");
    }
}

#[test]
fn a_point_cloud_is_named_as_one_and_read_as_points() {
    let header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
        property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n1 2 3 255 0 51\n4 5 6 0 0 0\n";
    let error = read(header.as_bytes()).unwrap_err().to_string();
    assert!(error.contains("point cloud without Gaussians") && error.contains("x, y, z, red, green, blue"), "{error}");
    let points = read_points(header.as_bytes()).unwrap();
    assert_eq!(points.positions, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
    assert_eq!(points.colors, [[1.0, 0.0, 51.0 / 255.0], [0.0; 3]]);
    let p = random(3, 4);
    let points = read_points(&written(&p)).unwrap();
    assert_eq!(points.positions[2], p[GEOMETRY].read::<3>(2, 0).map(f64::from));
    assert!((points.colors[2][1] - (0.5 + 0.282_094_79 * p[SH].get(2, 1))).abs() < 1e-6);
}

/// Packs a number of [0, 1] as PlayCanvas' writer does.
fn pack(x: f32, bits: u32) -> u32 {
    let top = ((1 << bits) - 1) as f32;
    (x * top + 0.5).floor().clamp(0.0, top) as u32
}

/// 300 packed Gaussians (two chunks) with f_rest of degree 1, and what they were packed from.
fn packed_sample() -> (Params, Vec<u8>) {
    const ROWS: usize = 300;
    let mut p = random(ROWS, 4);
    for row in 0..ROWS {
        let q: [f32; 4] = p[GEOMETRY].read(row, QUAT);
        p[GEOMETRY].write(row, QUAT, crate::math::quat::normalize(q).0);
        // The format's SH range is [-4, 4] and its colours' here [0, 1].
        for col in 0..3 {
            *p[SH].get_mut(row, col) = p[SH].get(row, col).clamp(-1.5, 1.5);
        }
    }
    let mut header = String::from("ply\nformat binary_little_endian 1.0\nelement chunk 2\n");
    // No colour bounds, as in the format's first version; positions and scales span [-8, 8].
    for name in ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"] {
        header += &format!("property float {name}\n");
    }
    for name in ["min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z"] {
        header += &format!("property float {name}\n");
    }
    header += &format!("element vertex {ROWS}\n");
    for name in ["packed_position", "packed_rotation", "packed_scale", "packed_color"] {
        header += &format!("property uint {name}\n");
    }
    header += &format!("element sh {ROWS}\n");
    (0..9).for_each(|i| header += &format!("property uchar f_rest_{i}\n"));
    let mut bytes = (header + "end_header\n").into_bytes();
    for _ in 0..2 {
        for bound in [-8.0f32, 8.0, -8.0, 8.0] {
            (0..3).for_each(|_| bytes.extend(bound.to_le_bytes()));
        }
    }
    let unit = |x: f32| (x + 8.0) / 16.0;
    let vector = |v: [f32; 3]| pack(unit(v[0]), 11) << 21 | pack(unit(v[1]), 10) << 11 | pack(unit(v[2]), 11);
    for row in 0..ROWS {
        let g: [f32; 11] = p[GEOMETRY].read(row, 0);
        let q = &g[QUAT..QUAT + 4];
        let largest = (0..4).max_by(|&a, &b| q[a].abs().total_cmp(&q[b].abs())).unwrap();
        let mut rotation = largest as u32;
        for i in (0..4).filter(|&i| i != largest) {
            rotation = rotation << 10 | pack(q[i] * q[largest].signum() / 2.0f32.sqrt() + 0.5, 10);
        }
        let rgb = p[SH].read::<3>(row, 0).map(|x| pack(0.5 + SH_C0_EXACT as f32 * x, 8));
        let alpha = pack(1.0 / (1.0 + (-g[OPACITY]).exp()), 8);
        bytes.extend(vector([g[0], g[1], g[2]]).to_le_bytes());
        bytes.extend(rotation.to_le_bytes());
        bytes.extend(vector([g[7], g[8], g[9]]).to_le_bytes());
        bytes.extend((rgb[0] << 24 | rgb[1] << 16 | rgb[2] << 8 | alpha).to_le_bytes());
    }
    for row in 0..ROWS {
        for c in 0..3 {
            for k in 1..4 {
                let x = p[SH].get(row, 3 * k + c);
                bytes.push(((x / 8.0 + 0.5) * 256.0).floor().clamp(0.0, 255.0) as u8);
            }
        }
    }
    (p, bytes)
}

/// 1/(2√π).
const SH_C0_EXACT: f64 = 0.5 * std::f64::consts::FRAC_2_SQRT_PI / 2.0;

#[test]
fn compressed_gaussians_are_within_their_quantisation_steps() {
    let (p, bytes) = packed_sample();
    let (q, info) = read(&bytes).unwrap();
    assert_eq!((info.gaussians, info.sh_degree, info.compressed, info.non_finite_rows), (300, 1, true, 0));
    for row in 0..p.len() {
        let (a, b): ([f32; 11], [f32; 11]) = (p[GEOMETRY].read(row, 0), q[GEOMETRY].read(row, 0));
        for k in [0, 1, 2, 7, 8, 9] {
            // Half a step of 10 bits over 16 units.
            assert!((a[k] - b[k]).abs() <= 8.0 / 1023.0 + 1e-5, "row {row} column {k}: {} {}", a[k], b[k]);
        }
        let dot: f32 = (QUAT..QUAT + 4).map(|k| a[k] * b[k]).sum();
        assert!(dot.abs() > 1.0 - 1e-5, "row {row}: {a:?} {b:?}");
        let alpha = |logit: f32| 1.0 / (1.0 + (-logit).exp());
        assert!((alpha(a[OPACITY]) - alpha(b[OPACITY])).abs() <= 0.5 / 255.0 + 1e-5);
        for col in 0..3 {
            let step = 0.5 / 255.0 / 0.282_094_79;
            assert!((p[SH].get(row, col) - q[SH].get(row, col)).abs() <= step + 1e-4, "row {row} column {col}");
        }
        for col in 3..12 {
            let clamped = p[SH].get(row, col).clamp(-4.0, 4.0);
            assert!((clamped - q[SH].get(row, col)).abs() <= 8.0 / 256.0, "row {row} column {col}");
        }
    }
    let mut short = bytes.clone();
    let at = short.windows(15).position(|w| w == b"element chunk 2").unwrap();
    short[at + 14] = b'1';
    short.extend([0; 48]);
    assert!(read(&short).unwrap_err().to_string().contains("chunk for every 256"));
}

#[test]
fn a_header_of_a_megabyte_is_parsed_in_linear_time() {
    let start = Instant::now();
    let elements: Vec<String> = (0..60_000).map(|i| format!("element e{i} 0")).collect();
    let properties: Vec<String> = (0..40_000).map(|i| format!("property float p{i}")).collect();
    for (mut lines, needle) in [(elements, "no element `vertex`"), (properties, "lacks the properties x")] {
        lines.splice(0..0, ["ply", "format ascii 1.0", "element vertex 0"].map(String::from));
        if needle.starts_with("no") {
            lines.remove(2);
        }
        lines.push("end_header\n".into());
        let error = read(lines.join("\n").as_bytes()).unwrap_err().to_string();
        assert!(error.contains(needle), "{error}");
    }
    assert!(start.elapsed().as_secs_f64() < 2.0, "two headers took {:?}", start.elapsed());
}

#[test]
fn mutants_are_read_or_refused() {
    let plain = written(&random(20, 4));
    let text = "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int i\nelement vertex 2\n".to_owned()
        + ONE_GAUSSIAN
        + "\nend_header\n3 0 1 2\n1 2 3 4 5 6 7 8 9 10 11 12 13 14\n0.1 2 3 4 5 6 7 8 9 10 11 12 13 1e3\n";
    let (_, packed) = packed_sample();
    let start = Instant::now();
    for (name, sample, count) in [("plain", &plain[..], 600), ("text", text.as_bytes(), 600), ("packed", &packed, 300)]
    {
        assert!(read(sample).is_ok(), "{name}");
        let read = mutants(sample, count, name).filter(|m| {
            let _ = read_points(m);
            read(m).is_ok_and(|(p, info)| {
                assert!(info.non_finite_rows <= p.len() && p.len() * 4 <= m.len());
                true
            })
        });
        let read = read.count() as u64;
        assert!(0 < read && read < count, "{name}: {read} of {count} mutants were readable");
    }
    assert!(start.elapsed().as_secs() < 10, "damaged files take {:?} to refuse", start.elapsed());
}
