//! The conformance set of docs/format.md: small files, one per feature, with the numbers that a reader has to get from
//! them, and files that it has to refuse. `UPDATE_GOLDEN=1` writes the set; otherwise it is read, so that later
//! versions still read it.

use super::hostile::{reseal, with_entry};
use super::*;
use crate::math::sh;
use crate::scene::KeyMasks;
use serde_json::{Value, json};
use std::io::Cursor;
use std::path::PathBuf;
use std::sync::Arc;

/// Gaussians per time that a file's numbers list.
const LISTED: usize = 6;
/// Colours are those seen from here.
const EYE: [f64; 3] = [0.5, -1.0, -4.0];
/// Least relative distance of an opacity from the threshold below which nothing is rendered: readers may compute in
/// f32.
const CLEAR: f64 = 1e-4;
/// Digits of the numbers.
const DIGITS: i32 = 7;
/// What a reader may be off: this much times 1 + |number|.
const TOLERANCE: f64 = 1e-5;

fn folder() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../clients/conformance"))
}

/// A synthetic scene without a poster.
fn scene(n: usize, degree: usize, seed: u64) -> Draft {
    let mut draft = made_up(n, degree, seed);
    draft.meta.cameras.clear();
    draft.meta.title = format!("conformance {seed}");
    draft.poster = None;
    draft
}

fn still(mut draft: Draft) -> Draft {
    for p in draft.nodes.iter_mut().flat_map(|n| &mut n.primitives) {
        (p.half_width, p.velocity, p.turn) = (f64::INFINITY, [0.0; 3], [0.0; 3]);
    }
    draft.nodes.truncate(1);
    draft
}

/// Numbers at the ends of what a page holds.
fn edges() -> Draft {
    let mut draft = still(scene(24, 0, 12));
    let all = &mut draft.nodes[0].primitives;
    for (i, p) in all.iter_mut().enumerate() {
        p.opacity = [1.0, 0.0, 1.0 / 255.0, 2.0 / 255.0, 0.5, 0.9][i % 6];
        // Each component of the rotation the largest once, and two alike.
        p.quat = std::array::from_fn(|k| if k == i % 4 { [1.0, -1.0][i / 4 % 2] } else { 0.3 * (i % 3) as f32 });
        p.scales = [0.1, 1e-4, 3.0].map(|s| s * if i % 5 == 0 { 1e-3 } else { 1.0 });
        // Centres outside of the clip, no half-width, sharp ends, and turns by more than half a turn.
        (p.center, p.half_width, p.softness) =
            ([-0.2, 0.5, 1.3][i % 3], [0.0, 0.2, 1.0][i / 3 % 3], [0.3, 1e-3][i % 2]);
        p.velocity = [50.0, 0.0, -1e-3];
        p.turn = [0.0, 9.0, if i % 2 == 0 { 0.0 } else { -4.0 }];
        p.base_color = [-0.5, 0.0, 3.0 + 0.1 * i as f32];
    }
    draft
}

fn masked() -> Vec<u8> {
    let mut pages = read_pages(&bytes_of(&scene(60, 1, 13), &WriteConfig::default()).0).unwrap();
    for (i, layer) in pages.layers.iter_mut().enumerate().filter(|(i, _)| *i != 1) {
        let times = [0.125, 0.25, 0.5, 0.75].to_vec();
        let (rng, mut masks) = (Rng::new(13, "masks", i as u64), KeyMasks::new(times, layer.params.len()));
        for row in 0..masks.rows() {
            let from = rng.below(2 * row as u64, 4);
            (from..4.min(from + 1 + rng.below(2 * row as u64 + 1, 2))).for_each(|key| masks.set(key, row));
        }
        layer.masks = Some(Arc::new(masks));
    }
    let mut bytes = Vec::new();
    write_pages(&pages.draft(None), &WriteConfig::default(), &mut bytes).unwrap();
    bytes
}

fn named() -> Draft {
    let mut draft = scene(40, 0, 14);
    draft.meta.labels = ["floor", "Größe", "person"].map(str::to_owned).to_vec();
    draft.meta.features = vec![[-1.0, 2.0], [0.5, 0.5]];
    for (i, p) in draft.nodes[0].primitives.iter_mut().enumerate() {
        p.label = [Some(0), None, Some(2), Some(1)][i % 4];
        p.features = if i % 5 == 3 { Vec::new() } else { vec![0.1 * i as f32 - 1.0, 0.5] };
    }
    draft
}

/// All keys of the JSON, a poster, and far coordinates and times.
fn described() -> Vec<u8> {
    let mut draft = scene(16, 1, 15);
    let (position, target, up, fov_y) = ([0.5, -1.0, -4.0], [0.0, 0.1, 0.2], [0.0, -1.0, 0.0], 42.5);
    for n in &mut draft.nodes {
        (n.from, n.to) = (n.from + 100.0, n.to + 100.0);
        n.primitives.iter_mut().for_each(|p| p.center += 100.0);
    }
    let camera = Camera::with_fov_y(Se3::look_at(position, target, up), 0.7, 320, 200);
    draft.meta = Meta {
        clip: [100.0, 101.0],
        unit: Some(0.25),
        offset: [448_262.5, 5_411_932.75, 120.0],
        predicted: Some(100.75),
        title: "Größe \"1\" \u{1F431}".into(),
        bounds: Some([[-3.0; 3], [3.0; 3]]),
        view: Some(Viewpoint { position, target, up, fov_y }),
        cameras: vec![NamedCamera { near: 0.25, ..NamedCamera::new("left", &camera) }],
        path: [None, Some(100.5)]
            .map(|time| PathKey { at: time.map_or(0.0, |_| 2.0), position, target, up, fov_y, time })
            .to_vec(),
        ..draft.meta
    };
    // The least PNG there is: one black pixel.
    let png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x01\0\0\0\x01\x08\0\0\0\0:~\x9bU\0\0\0\nIDATx\x9cc`\0\0\0\x02\0\x01H\xaf\xa4q\0\0\0\0IEND\xaeB`\x82";
    draft.poster = Some(png.to_vec());
    let from = Provenance {
        made_with: "splat4d conformance".into(),
        when: Some("2026-11-27T10:00:00Z".into()),
        words: Some("synthetic".into()),
        ..Provenance::default()
    };
    with_provenance(&bytes_of(&draft, &WriteConfig::default()).0, Some(&from)).unwrap()
}

/// An unfinished capture: two parts with palettes of their own, the index behind them.
fn growing() -> Vec<u8> {
    let part = |seed: u64, from: f64| {
        let mut draft = scene(24, 1, seed);
        let primitives = draft.nodes.swap_remove(0).primitives;
        draft.nodes = vec![Node { from, to: from + 0.5, primitives }];
        bytes_of(&draft, &WriteConfig::default()).0
    };
    let meta = |last: f64, parts: &[&str]| Meta {
        clip: [0.0, last],
        parts: parts.iter().map(|p| (*p).to_owned()).collect(),
        missing: vec![[0.75, 1.0]],
        ..scene(4, 1, 16).meta
    };
    let mut growing = Growing::begin(Cursor::new(Vec::new()), meta(0.0, &[])).unwrap();
    growing.append(&part(16, 0.0), meta(0.5, &["0"]), &mut |_| Ok(())).unwrap();
    growing.append(&part(17, 0.5), meta(1.0, &["0", "1"]), &mut |_| Ok(())).unwrap();
    growing.file().get_ref().clone()
}

/// What later versions may add: a minor version, a key of the JSON, an optional section; and a page without its
/// palette.
fn newer() -> Vec<u8> {
    let mut draft = scene(24, 2, 18);
    draft.poster = Some(b"whatever it is".to_vec());
    let (plain, _) = bytes_of(&draft, &WriteConfig { deflate_level: 0, ..WriteConfig::default() });
    let mut bytes = with_entry(&plain, 0, 0, b"WAVE");
    bytes = with_entry(&bytes, 0, 28, &9u16.to_le_bytes());
    let page = Index::parse(&bytes, None).unwrap().sections.iter().rposition(|e| e.kind == Kind::Page).unwrap();
    bytes = with_entry(&bytes, page, 56, &u32::MAX.to_le_bytes());
    let at = bytes.windows(7).position(|w| w == b"\"title\"").unwrap();
    bytes[at + 1..at + 6].copy_from_slice(b"later");
    bytes[10] = 9;
    reseal(&mut bytes);
    bytes
}

/// The set: names, contents and bytes.
fn set() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let plain = |draft: &Draft| bytes_of(draft, &WriteConfig::default()).0;
    let coarse =
        Depths { position: 12, scale: 5, rotation: 7, shift: 6, turn: 5, color: 6, life: 4, ..Depths::default() };
    let blocks = Draft { nodes: scene(1200, 0, 11).nodes[..1].to_vec(), ..scene(4, 0, 11) };
    vec![
        ("still", "one page of Gaussians that neither move nor end", plain(&still(scene(24, 0, 1)))),
        ("motion", "spans, lifespans, velocities and turns", plain(&scene(200, 0, 2))),
        ("sh1", "a palette of degree 1", plain(&scene(32, 1, 3))),
        ("sh2", "a palette of degree 2", plain(&scene(24, 2, 4))),
        ("sh3", "a palette of degree 3", plain(&still(scene(24, 3, 5)))),
        (
            "tiers",
            "pages of the same span",
            bytes_of(&scene(48, 0, 6), &WriteConfig { tier: 8, ..WriteConfig::default() }).0,
        ),
        (
            "raw",
            "sections that are not deflated",
            bytes_of(&scene(16, 1, 7), &WriteConfig { deflate_level: 0, ..WriteConfig::default() }).0,
        ),
        (
            "blocks",
            "a page of three blocks, codes of fewer bits",
            bytes_of(&blocks, &WriteConfig { depths: coarse, ..WriteConfig::default() }).0,
        ),
        ("edges", "least and greatest values of fields", plain(&edges())),
        ("masks", "version 1.1: masks at four key times", masked()),
        ("names", "version 1.2: labels and features", plain(&named())),
        ("described", "all keys of the JSON, poster, provenance, a clip that begins at 100 s", described()),
        ("growing", "version 2.0: an unfinished file, two palettes", growing()),
        ("newer", "minor version 9, an unknown section and key, a page without its palette", newer()),
        ("empty", "no page", plain(&Draft { nodes: Vec::new(), ..scene(4, 0, 19) })),
    ]
}

/// Files to refuse, with the reason.
fn refused() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let mut draft = tiny();
    draft.poster = Some(b"poster".to_vec());
    draft.meta.cameras.clear();
    let (sample, _) = bytes_of(&draft, &WriteConfig { deflate_level: 0, ..WriteConfig::default() });
    let index = Index::parse(&sample, None).unwrap();
    let (page, palette) = (1, 3);
    let entry = |i: usize, at: usize, value: &[u8]| with_entry(&sample, i, at, value);
    let raw = |at: usize, value: &[u8], seal: bool| {
        let mut m = sample.clone();
        m[at..at + value.len()].copy_from_slice(value);
        if seal {
            reseal(&mut m);
        }
        m
    };
    let body = index.sections[page].offset as usize;
    let label = body + 96 + 28; // the lowest byte of word 7 of the page's only Gaussian
    // Forty times the same Gaussian: a page that deflate makes smaller.
    let mut flat = Draft { poster: None, ..draft.clone() };
    flat.meta.sh_degree = 0;
    flat.nodes.truncate(1);
    flat.nodes[0].primitives = vec![flat.nodes[0].primitives[0].clone(); 40];
    let (deflated, _) = bytes_of(&flat, &WriteConfig::default());
    let small = Index::parse(&deflated, None).unwrap().sections[0].clone();
    assert_eq!((small.kind, small.codec), (Kind::Page, Codec::Deflate));
    let mut torn = deflated.clone();
    torn[small.offset as usize..(small.offset + 8) as usize].fill(0xFF);
    reseal(&mut torn);
    let more = (96 + 32 * (small.count + 1)).to_le_bytes();
    let longer = with_entry(&with_entry(&deflated, 0, 20, &more), 0, 32, &(small.count + 1).to_le_bytes());
    let json = u32::from_le_bytes(sample[64..68].try_into().unwrap()) as usize;
    let mut mask = masked();
    let at = Index::parse(&mask, None).unwrap().sections.iter().rposition(|e| e.kind == Kind::Masks).unwrap();
    mask = with_entry(&mask, at, 56, &1u32.to_le_bytes());
    vec![
        ("magic", "another magic number", raw(1, b"T", true)),
        ("major", "major version 3", raw(8, &[3], true)),
        ("header-checksum", "the header's checksum is wrong", raw(30, &[1], false)),
        ("index-checksum", "the index's checksum is wrong", raw(70, b"?", false)),
        ("section-checksum", "a page's checksum is wrong", raw(body + 100, &[0xAA], false)),
        ("json", "the JSON is damaged", raw(68, b"[", true)),
        ("json-length", "the JSON is longer than the index", raw(64, &(json as u32 + 4096).to_le_bytes(), true)),
        ("required", "an unknown section that is required", with_entry(&entry(0, 0, b"WAVE"), 0, 4, &[1])),
        ("overlap", "a section overlaps another", entry(page, 8, &index.sections[0].offset.to_le_bytes())),
        ("beyond", "a section ends beyond the file", entry(page, 8, &u64::MAX.to_le_bytes())),
        ("bytes", "a page has another size than its count gives", entry(page, 32, &2u32.to_le_bytes())),
        ("words", "9 words a Gaussian", entry(page, 36, &[9])),
        ("codec", "an unknown codec of a page", entry(page, 28, &[7])),
        ("stream", "a page that is no deflate stream", torn),
        ("length", "a page inflates to fewer bytes than stated", longer),
        ("span", "a page's span ends before it begins", entry(page, 48, &(-1.0f64).to_le_bytes())),
        ("palette", "a page's palette is another section", entry(page, 56, &[0; 4])),
        ("entry", "a palette entry that the palette does not have", raw(label, &[200], true)),
        ("nan", "a number of a block header is NaN", raw(body + 12, &f32::NAN.to_le_bytes(), true)),
        ("logarithm", "a logarithm of a block header is 50", raw(body + 40, &50f32.to_le_bytes(), true)),
        ("degree", "a palette of degree 4", entry(palette, 30, &[4])),
        ("mask", "masks of a section that is not a page", mask),
        ("cut", "the file is shorter than its header states", sample[..sample.len() - 1].to_vec()),
    ]
}

fn rounded(x: f64) -> Value {
    if x == 0.0 || !x.is_finite() {
        return json!(0);
    }
    let unit = 10f64.powi(DIGITS - 1 - x.abs().log10().floor() as i32);
    json!((x * unit).round() / unit)
}

/// The numbers of a Gaussian at t; none where it is not rendered.
fn numbers(r: &Record, palette: Option<&Palette>, t: f64) -> Option<Vec<f64>> {
    let delta = t - r.center;
    let tail = (delta.abs() - r.half_width).max(0.0) / r.softness;
    let opacity = r.opacity * if r.half_width.is_infinite() { 1.0 } else { (-0.5 * tail * tail).exp() };
    let share = opacity * 255.0;
    // Codes 0 and 1 of a Gaussian that does not fade are exact.
    assert!(
        share == 0.0 || (share - 1.0).abs() > CLEAR || (share - 1.0).abs() < 1e-12,
        "a conformance file on the threshold: {share}"
    );
    if opacity < 1.0 / 255.0 {
        return None;
    }
    let mean: [f64; 3] = std::array::from_fn(|k| r.mean[k] + delta * r.velocity[k]);
    let rate = page::rate(r.quat, r.turn);
    let q = quat::normalize::<f64>(std::array::from_fn(|k| r.quat[k] + delta * rate[k])).0;
    let away: [f64; 3] = std::array::from_fn(|k| mean[k] - EYE[k]);
    let length = away.iter().map(|x| x * x).sum::<f64>().sqrt();
    let basis = sh::basis(away.map(|x| x / length));
    let color = |c: usize| {
        let rest = palette.map_or(0.0, |p| {
            let entry = usize::from(r.label);
            (0..p.width() / 3).map(|k| basis[k + 1] * f64::from(p.value(entry, 3 * k + c))).sum()
        });
        (r.base_color[c] + rest).max(0.0)
    };
    Some([&mean[..], &q, &r.scales, &[opacity], &[color(0), color(1), color(2)]].concat())
}

/// What a reader has to get from a file.
fn expected(name: &str, about: &str, bytes: &[u8]) -> Value {
    let index = Index::parse(bytes, Some(bytes.len() as u64)).unwrap();
    let section = |i: usize| stored(bytes, &index.sections[i]);
    let scene = read(bytes).unwrap();
    let pages: Vec<(usize, Page)> = index.pages().map(|(i, e)| (i, decode_page(e, section(i)).unwrap())).collect();
    let palettes: Vec<(u32, Palette)> = (0..index.sections.len())
        .filter(|&i| index.sections[i].kind == Kind::Palette)
        .map(|i| (i as u32, decode_palette(&index.sections[i], section(i)).unwrap()))
        .collect();
    let masks: Vec<(u32, KeyMasks)> =
        index.masks().iter().map(|&(page, i)| (page, decode_masks(&index.sections[i], section(i)).unwrap())).collect();
    let [first, last] = index.meta.clip;
    let times = [-1.0, 0.0, 0.21, 0.5, 0.875, 1.0].map(|share| first + share * (last - first).max(0.5));
    let at = times.map(|t| {
        let inside = t.clamp(first, last);
        let mut all = Vec::new();
        for (i, page) in pages.iter().filter(|(_, p)| p.span[0] <= inside && inside < p.span[1]) {
            let palette = page.palette.map(|p| &palettes.iter().find(|(at, _)| *at == p).unwrap().1);
            let mask = masks.iter().find(|(p, _)| *p as usize == *i).map(|(_, m)| m);
            for row in (0..page.len()).filter(|&row| mask.is_none_or(|m| m.allows(inside, row))) {
                if let Some(numbers) = numbers(&page.record(row), palette, inside) {
                    all.push((*i, row, numbers));
                }
            }
        }
        let step = all.len().div_ceil(LISTED).max(1);
        let row = |(page, row, numbers): &(usize, usize, Vec<f64>)| {
            [vec![json!(page), json!(row)], numbers.iter().map(|&x| rounded(x)).collect()].concat()
        };
        json!({"time": rounded(t), "rendered": all.len(), "gaussians": all.iter().step_by(step).map(row).collect::<Vec<_>>()})
    });
    let mut out = json!({
        "file": format!("{name}.s4d"), "about": about, "version": index.version, "clip": index.meta.clip,
        "records": index.meta.gaussians, "sections": index.sections.iter().map(|e| e.kind.name()).collect::<Vec<_>>(),
        "eye": EYE, "at": at,
    });
    for ((i, _), layer) in pages.iter().zip(&scene.layers) {
        let labels = labels_of(&layer.params);
        if labels.iter().any(Option::is_some) {
            out["labels"][i.to_string()] = json!(labels);
        }
        let features = features_of(&layer.params);
        if features.iter().any(|f| !f.is_empty()) {
            let rows = features.iter().map(|f| f.iter().map(|&x| rounded(f64::from(x))).collect::<Vec<_>>());
            out["features"][i.to_string()] = json!(rows.collect::<Vec<_>>());
        }
    }
    out
}

/// Whether two trees of numbers agree within the tolerance.
fn agree(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Number(a), Value::Number(b)) => {
            let [a, b] = [a, b].map(|x| x.as_f64().unwrap());
            (a - b).abs() <= TOLERANCE * (1.0 + b.abs())
        }
        (Value::Array(a), Value::Array(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| agree(a, b)),
        (Value::Object(a), Value::Object(b)) => {
            a.len() == b.len() && a.iter().all(|(k, v)| b.get(k).is_some_and(|w| agree(v, w)))
        }
        _ => a == b,
    }
}

/// Text of a file's numbers: a line per Gaussian.
fn text(value: &Value) -> String {
    value.to_string().replace("[[", "[\n[").replace("],[", "],\n[").replace("{\"gaussians\"", "\n{\"gaussians\"") + "\n"
}

#[test]
fn the_conformance_set_gives_its_numbers() {
    let folder = folder();
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        for (name, about, bytes) in set() {
            std::fs::write(folder.join(format!("{name}.json")), text(&expected(name, about, &bytes))).unwrap();
            std::fs::write(folder.join(format!("{name}.s4d")), bytes).unwrap();
        }
        let list: serde_json::Map<String, Value> =
            refused().into_iter().map(|(name, why, _)| (format!("{name}.s4d"), json!(why))).collect();
        let list = serde_json::to_string_pretty(&list).unwrap() + "\n";
        std::fs::write(folder.join("refused/refused.json"), list).unwrap();
        refused().iter().for_each(|(n, _, b)| std::fs::write(folder.join(format!("refused/{n}.s4d")), b).unwrap());
    }
    for (name, about, now) in set() {
        let bytes = std::fs::read(folder.join(format!("{name}.s4d"))).unwrap();
        let want = std::fs::read_to_string(folder.join(format!("{name}.json"))).unwrap();
        let want: Value = serde_json::from_str(&want).unwrap();
        assert!(agree(&expected(name, about, &bytes), &want), "{name}: the file in the set");
        assert!(agree(&expected(name, about, &now), &want), "{name}: written again");
        assert_eq!(strict(&bytes).unwrap(), deviations(name), "{name}");
    }
}

/// Files of the set that a writer of this version would not write, and in what they deviate.
fn deviations(name: &str) -> Vec<String> {
    match name {
        "newer" => {
            vec!["the minor version is 9, this splat4d supports 2".into(), "section 0: `WAVE` is not known".into()]
        }
        _ => Vec::new(),
    }
}

#[test]
fn the_conformance_set_names_files_to_refuse() {
    let list = std::fs::read_to_string(folder().join("refused/refused.json")).unwrap();
    let list: serde_json::Map<String, Value> = serde_json::from_str(&list).unwrap();
    assert_eq!(list.len(), refused().len());
    for (name, why, now) in refused() {
        let bytes = std::fs::read(folder().join(format!("refused/{name}.s4d"))).unwrap();
        assert_eq!(list[&format!("{name}.s4d")], why);
        assert!(read(&bytes).is_err() && strict(&bytes).is_err(), "{name}: {why}");
        assert!(read(&now).is_err(), "{name}: {why}, written again");
    }
}

#[test]
fn strict_names_deviations_that_readers_tolerate() {
    let (sample, _) = bytes_of(&scene(300, 1, 20), &WriteConfig { deflate_level: 0, ..WriteConfig::default() });
    assert!(strict(&sample).unwrap().is_empty());
    let index = Index::parse(&sample, None).unwrap();
    let page = index.pages().next().unwrap().0;
    let body = index.sections[page].offset as usize;
    let n = index.sections[page].count as usize;
    let told = |bytes: Vec<u8>, what: &str| {
        assert!(read(&bytes).is_ok(), "{what}: readers tolerate it");
        let all = strict(&bytes).unwrap();
        assert!(all.len() == 1 && all[0].contains(what), "{what}: {all:?}");
    };
    let changed = |at: usize, value: &[u8]| {
        let mut m = sample.clone();
        m[at..at + value.len()].copy_from_slice(value);
        reseal(&mut m);
        m
    };
    told(changed(40, &[1]), "bytes 28 to 59");
    told(with_entry(&sample, page, 60, &[1]), "section 0: bytes 60 to 63");
    told(with_entry(&sample, page, 4, &[3]), "section 0: unknown flags");
    told(with_entry(&sample, page, 4, &[0]), "section 0: `PAGE` is not marked as required");
    told([&sample[..], b"more"].concat(), "4 bytes after the end");
    // The lifespan of a block that ends when it begins, and spare bits of word 7.
    told(changed(body + 36, &sample[body + 32..body + 36]), "block 0: visible");
    let planes = body + 96 * n.div_ceil(256);
    told(changed(planes + 31 * n, &[1]), "spare bits");
    // A range that is the wrong way round.
    let max = f32::from_le_bytes(sample[body + 12..body + 16].try_into().unwrap());
    told(changed(body, &(max + 1.0).to_le_bytes()), "block 0: the range of x");
    let mut unfit = index.clone();
    unfit.version = [1, 1];
    let bodies: Vec<u8> = unfit.sections.iter().flat_map(|e| stored(&sample, e).to_vec()).collect();
    told([unfit.bytes("a test"), bodies].concat(), "version is 1.1, and nothing in the file needs more than 1.0");
}
