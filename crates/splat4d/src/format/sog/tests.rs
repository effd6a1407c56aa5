use super::*;
use crate::format::mutate::mutants;
use image_webp::{ColorType, WebPEncoder};
use std::borrow::Cow;

fn webp(width: u32, height: u32, pixels: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut rgba = pixels.to_vec();
    rgba.resize((4 * width * height) as usize, 0);
    WebPEncoder::new(&mut out).encode(&rgba, width, height, ColorType::Rgba8).unwrap();
    out
}

fn book(first: f64, step: f64) -> Vec<f64> {
    (0..256).map(|i| first + step * f64::from(i)).collect()
}

/// Two Gaussians of degree 1, by the description of the format.
fn files() -> Files<'static> {
    let meta = serde_json::json!({
        "version": 2, "count": 2,
        "means": {"mins": [-1.0, -2.0, 0.0], "maxs": [1.0, 2.0, 0.0], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": book(-12.0, 0.0625), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": book(-2.0, 0.015625), "files": ["sh0.webp"]},
        "shN": {"count": 65, "bands": 1, "codebook": book(-1.0, 0.0078125), "files": ["shN_c.webp", "shN_l.webp"]},
    });
    let mut centroids = vec![0; 4 * 192 * 2];
    // Label 64: second row, first column.
    for (k, code) in [10, 20, 30].into_iter().enumerate() {
        centroids[4 * (192 + k)..][..4].copy_from_slice(&[code, code + 1, code + 2, 255]);
    }
    let pictures = [
        ("means_l.webp", webp(4, 4, &[0, 255, 7, 255, 0xFF, 0, 7, 255])),
        ("means_u.webp", webp(4, 4, &[0, 255, 7, 255, 0x7F, 0, 7, 255])),
        ("scales.webp", webp(4, 4, &[0, 64, 255, 255, 1, 2, 3, 255])),
        ("quats.webp", webp(4, 4, &[255, 0, 128, 253, 128, 128, 128, 7])),
        ("sh0.webp", webp(4, 4, &[128, 0, 255, 51, 129, 130, 131, 255])),
        ("shN_c.webp", webp(192, 2, &centroids)),
        ("shN_l.webp", webp(4, 4, &[64, 0, 0, 255, 65, 0, 0, 255])),
    ];
    let mut files = Files::from([(META.to_owned(), Cow::Owned(meta.to_string().into_bytes()))]);
    files.extend(pictures.map(|(n, b)| (n.to_owned(), Cow::Owned(b))));
    files
}

#[test]
fn images_made_by_hand_are_read() {
    let (p, warnings) = read(&files()).unwrap();
    let (g, sh) = (&p[GEOMETRY], &p[SH]);
    let [x, y, z] = g.read::<3>(0, 0);
    // The ends of the ranges, through e^|x| − 1; a range without width is its value.
    assert!((x + 1f32.exp() - 1.0).abs() < 1e-5 && (y - 2f32.exp() + 1.0).abs() < 1e-5 && z == 0.0);
    // 0x7FFF is a hair below the middle.
    assert!(g.get(1, 0).abs() < 2e-5 && g.get(1, 0) < 0.0);
    assert_eq!(g.read::<3>(0, LOG_SCALE), [-12.0, -8.0, -12.0 + 255.0 / 16.0]);
    let q = g.read::<4>(0, QUAT);
    // The largest is x; w = √½, y = −√½, z nearly 0: x is what is left, nothing.
    assert!((q[0] - 0.5f32.sqrt()).abs() < 1e-6 && (q[2] + 0.5f32.sqrt()).abs() < 1e-6 && q[1].abs() < 0.01, "{q:?}");
    assert_eq!(g.read::<4>(1, QUAT), [1.0, 0.0, 0.0, 0.0]);
    assert_eq!(sh.read::<3>(0, 0), [0.0, -2.0, -2.0 + 255.0 / 64.0]);
    assert!((1.0 / (1.0 + (-g.get(0, OPACITY)).exp()) - 0.2).abs() < 1e-6);
    let code = |c: f32| -1.0 + c / 128.0;
    let expected = [10.0, 11.0, 12.0, 20.0, 21.0, 22.0, 30.0, 31.0, 32.0].map(code);
    assert_eq!(sh.read::<9>(0, 3), expected);
    assert_eq!(sh.read::<9>(1, 3), [0.0; 9], "label 65 is not in a palette of 65");
    let said = warnings.lines().join("\n");
    assert!(said.contains("1 of 2 Gaussians have a rotation") && said.contains("palette"), "{said}");
}

/// A zip, written by hand: local headers, directory, end record; every second file deflated.
fn zipped(files: &Files<'_>, folder: &str) -> Vec<u8> {
    use std::io::Write;
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (i, (name, plain)) in files.iter().enumerate() {
        let mut packed = plain.to_vec();
        if i % 2 == 0 {
            let mut deflate = flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::fast());
            deflate.write_all(plain).unwrap();
            packed = deflate.finish().unwrap();
        }
        let name = format!("{folder}{name}");
        let offset = out.len() as u32;
        // From the flags to the lengths both headers agree: version 20, method, no time, no checksum.
        let mut shared = vec![20, 0, 0, 0, if i % 2 == 0 { 8 } else { 0 }, 0];
        shared.extend([0; 8]);
        shared.extend((packed.len() as u32).to_le_bytes());
        shared.extend((plain.len() as u32).to_le_bytes());
        shared.extend((name.len() as u16).to_le_bytes());
        shared.extend([0, 0]);
        out.extend(b"PK\x03\x04");
        out.extend(&shared);
        out.extend(name.as_bytes());
        out.extend(packed);
        directory.extend(b"PK\x01\x02\x14\0");
        directory.extend(&shared);
        directory.extend([0; 10]);
        directory.extend(offset.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let at = out.len() as u32;
    out.extend(&directory);
    out.extend(b"PK\x05\x06\0\0\0\0");
    out.extend([(files.len() as u16).to_le_bytes(); 2].concat());
    out.extend((directory.len() as u32).to_le_bytes());
    out.extend(at.to_le_bytes());
    out.extend(b"\x05\0hello");
    out
}

#[test]
fn a_zip_is_the_same_as_a_folder() {
    let expected = read(&files()).unwrap();
    for folder in ["", "scene/"] {
        let zip = zipped(&files(), folder);
        assert!(zip.starts_with(&ZIP_MAGIC));
        assert_eq!(read(&unzip(&zip).unwrap()).unwrap(), expected);
    }
}

/// Where the entries of a zip's directory begin.
fn entries(zip: &[u8]) -> Vec<usize> {
    (0..zip.len() - 4).filter(|&at| zip[at..].starts_with(b"PK\x01\x02")).collect()
}

#[test]
fn archives_are_inflated_no_further_than_a_scene_needs() {
    let error = |zip: &[u8]| unzip(zip).unwrap_err().to_string();
    let zip = zipped(&files(), "");
    let at = entries(&zip);
    // Two names for one body.
    let mut shared = zip.clone();
    shared.copy_within(at[0] + 42..at[0] + 46, at[1] + 42);
    assert!(error(&shared).contains("overlap"), "{}", error(&shared));
    // A body that reaches into the directory.
    let mut long = zip.clone();
    let last = *at.last().unwrap();
    let packed = u32::from_le_bytes(long[last + 20..last + 24].try_into().unwrap());
    long[last + 20..last + 24].copy_from_slice(&(packed + 1).to_le_bytes());
    assert!(error(&long).contains("overlap"), "{}", error(&long));
    let mut huge = zip.clone();
    huge[at[0] + 24..at[0] + 28].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(error(&huge).contains("zip64"), "{}", error(&huge));
    // meta.json is the first: no reader inflates 100 MiB of it.
    let mut meta = zip.clone();
    meta[at[0] + 24..at[0] + 28].copy_from_slice(&(100u32 << 20).to_le_bytes());
    assert!(error(&meta).contains("longer than"), "{}", error(&meta));
    // Files that the scene does not name stay packed: this one could not be unpacked.
    let mut more = files();
    more.insert("zz.bin".into(), Cow::Borrowed(b"something else"));
    let mut more = zipped(&more, "");
    let last = *entries(&more).last().unwrap();
    more[last + 10] = 99;
    assert_eq!(read(&unzip(&more).unwrap()).unwrap(), read(&files()).unwrap());
    let twice = zipped(&Files::from([("a.npy".to_owned(), Cow::Borrowed(&b"x"[..]))]), "");
    assert!(error(&twice).contains(".npz"), "{}", error(&twice));
}

#[test]
fn inconsistent_headers_are_errors_with_a_reason() {
    let with = |change: &dyn Fn(&mut Value)| {
        let mut files = files();
        let mut meta: Value = serde_json::from_slice(&files[META]).unwrap();
        change(&mut meta);
        files.insert(META.into(), Cow::Owned(meta.to_string().into_bytes()));
        read(&files).unwrap_err().to_string()
    };
    assert!(with(&|m| m["version"] = 3.into()).contains("version 3"));
    assert!(with(&|m| m["version"] = Value::Null).contains("version 1"));
    assert!(with(&|m| m["count"] = 17.into()).contains("4x4 pixels"));
    assert!(with(&|m| m["count"] = 4_000_000_000u64.into()).contains("4000000000"));
    assert!(with(&|m| m["sh0"]["codebook"] = Value::from(vec![1.0])).contains("sh0.codebook"));
    assert!(with(&|m| m["quats"]["files"] = Value::from(vec!["no.webp"])).contains("no.webp"));
    assert!(with(&|m| m["shN"]["files"] = Value::from(vec!["quats.webp", "shN_l.webp"])).contains("pixels wide"));
    let zip = zipped(&files(), "");
    // Without its five bytes of comment a zip is still whole.
    for cut in (0..zip.len() - 5).step_by(7) {
        assert!(unzip(&zip[..cut]).is_err(), "cut to {cut}");
    }
}

#[test]
fn damaged_files_never_panic() {
    let zip = zipped(&files(), "");
    for mutant in mutants(&zip, 300, "sog zip") {
        let _ = unzip(&mutant).and_then(|f| read(&f));
    }
    let whole = files();
    for name in whole.keys() {
        for mutant in mutants(&whole[name], 150, "sog file") {
            let mut files = whole.clone();
            files.insert(name.clone(), Cow::Owned(mutant));
            let _ = read(&files);
        }
    }
}

#[test]
fn written_scenes_are_read_within_their_steps() {
    use crate::format::samples::{gaussians, worst};
    for coefficients in [1, 4, 16] {
        let p = gaussians(700, coefficients);
        let mut bytes = Vec::new();
        let warnings = write::write(&p, &mut bytes).unwrap();
        assert!(warnings.lines().is_empty(), "{warnings:?}");
        let (mut back, said) = read(&unzip(&bytes).unwrap()).unwrap();
        assert!(said.lines().is_empty(), "{said:?}");
        // Rows are in Morton order: each belongs to the nearest of the others.
        let nearest = |row: usize| {
            let x = p[GEOMETRY].read::<3>(row, 0);
            let apart = |r: &usize| (0..3).map(|k| (back[GEOMETRY].get(*r, k) - x[k]).powi(2)).sum::<f32>();
            (0..700).min_by(|a, b| apart(a).total_cmp(&apart(b))).unwrap()
        };
        let order: Vec<usize> = (0..700).map(nearest).collect();
        let mut sorted = Params::new(700, coefficients, &[]);
        for (to, from) in order.into_iter().enumerate() {
            sorted[GEOMETRY].write(to, 0, back[GEOMETRY].read::<11>(from, 0));
            (0..3 * coefficients).for_each(|k| sorted[SH].set(to, k, back[SH].get(from, k)));
        }
        back = sorted;
        let w = worst(&p, &back);
        // 16 bits of logarithms up to 2.5, of quaternions 8 bits, codebooks of 256 numbers for 2,100.
        assert!(w.mean < 1e-3 && w.turn < 0.02 && w.opacity < 0.003, "{coefficients}: {w:?}");
        assert!(w.log_scale < 0.15 && w.dc < 0.15 && w.sh < 0.1, "{coefficients}: {w:?}");
    }
    let none = write::write(&Params::new(0, 1, &[]), &mut Vec::new());
    assert!(none.unwrap_err().to_string().contains("no Gaussians"));
}
