//! Files with false claims: never a panic, never an allocation that the bytes do not bear out, and a reason in words.

use super::*;
use crate::format::mutate::mutants;
use crate::format::playback::index::seal;

/// Place of the table's first entry.
fn table(bytes: &[u8]) -> usize {
    let json = u32::from_le_bytes(bytes[64..68].try_into().unwrap()) as usize;
    64 + 4 + json + 4
}

/// Makes all checksums right again, as far as the damage lets find what they are of, so that the checks behind them are
/// reached.
pub(super) fn reseal(bytes: &mut [u8]) {
    let u32_at = |b: &[u8], at: usize| b.get(at..at + 4).map(|x| u32::from_le_bytes(x.try_into().unwrap()) as usize);
    let Some(index_bytes) = u32_at(bytes, 12) else { return };
    if 64usize.checked_add(index_bytes).is_none_or(|end| end > bytes.len()) {
        return;
    }
    if let Some(json) = u32_at(bytes, 64) {
        let first = 64 + 4 + json + 4;
        for at in (first..(64 + index_bytes).saturating_sub(63)).step_by(64) {
            let (offset, size) = (u32_at(bytes, at + 8).unwrap(), u32_at(bytes, at + 16).unwrap());
            if let Some(body) = bytes.get(offset..offset.saturating_add(size)) {
                let sum = crc(body).to_le_bytes();
                bytes[at + 24..at + 28].copy_from_slice(&sum);
            }
        }
    }
    seal(bytes);
}

/// Reads all that there is, in parts and as a whole; true if it was accepted.
pub(super) fn survive(bytes: &[u8]) -> bool {
    if let Ok(needed) = Index::needed(&bytes[..bytes.len().min(64)]) {
        assert!(needed <= (64 << 20) + 64);
    }
    let Ok(index) = Index::parse(bytes, None) else {
        assert!(read(bytes).is_err());
        return false;
    };
    for e in &index.sections {
        let Some(body) = bytes.get(e.offset as usize..(e.offset + u64::from(e.stored)) as usize) else { continue };
        match e.kind {
            Kind::Page => drop(decode_page(e, body)),
            Kind::Palette => drop(decode_palette(e, body)),
            Kind::Masks => drop(decode_masks(e, body)),
            Kind::Labels => {
                drop(super::super::labels::decode(e, body, 3, &mut crate::scene::Params::new(e.count as usize, 1, &[])))
            }
            Kind::Features => {
                let mut params = crate::scene::Params::new(e.count as usize, 1, &[]);
                drop(super::super::features::decode(e, body, &[[0.0, 1.0]; 3], &mut params));
            }
            Kind::Provenance => drop(provenance(bytes)),
            Kind::Sound => drop(sound(bytes)),
            Kind::Poster | Kind::Other(_) => {}
        }
    }
    let Ok(scene) = read(bytes) else { return false };
    assert!(picture(&scene, 0.3).iter().all(|x| x.is_finite()), "what is accepted can be drawn");
    true
}

#[test]
fn mutants_are_read_or_refused() {
    let draft = made_up(400, 1, 10);
    for (name, level) in [("deflated", 6), ("raw", 0)] {
        let (sample, _) = bytes_of(&draft, &WriteConfig { deflate_level: level, ..WriteConfig::default() });
        let plain = mutants(&sample, 1500, name).filter(|m| survive(m)).count();
        assert!(plain < 300, "the checksums find almost every damage, but {plain} of 1500 {name} files went through");
        let purpose = format!("{name} sealed");
        let sealed = mutants(&sample, 1500, &purpose).filter(|m| {
            let mut m = m.clone();
            reseal(&mut m);
            survive(&m)
        });
        let sealed = sealed.count();
        assert!(plain < sealed && sealed < 1500, "{sealed} of 1500 {name} files with mended checksums were readable");
    }
}

#[test]
fn bytes_of_headers_and_tables_are_each_tried() {
    // A small file whose every byte before the bodies takes nasty values, checksums corrected.
    let (sample, _) = bytes_of(&tiny(), &WriteConfig::default());
    let end = Index::needed(&sample).unwrap();
    for at in 8..end {
        for value in [0x00, 0x01, 0x7F, 0x80, 0xFF] {
            let mut m = sample.clone();
            if m[at] != value {
                m[at] = value;
                reseal(&mut m);
                survive(&m);
            }
        }
    }
    for cut in 0..sample.len() {
        assert!(!survive(&sample[..cut]), "a file cut at {cut} is not a whole one");
    }
}

/// The sample with some bytes of entry `i` replaced, checksums corrected.
pub(super) fn with_entry(sample: &[u8], i: usize, at: usize, bytes: &[u8]) -> Vec<u8> {
    let mut m = sample.to_vec();
    let first = table(sample) + 64 * i + at;
    m[first..first + bytes.len()].copy_from_slice(bytes);
    reseal(&mut m);
    m
}

#[test]
fn unknown_sections_are_skipped_unless_required() {
    let (sample, _) = bytes_of(&tiny(), &WriteConfig::default());
    let poster = 0;
    let new = with_entry(&sample, poster, 0, b"WAVE");
    let index = Index::parse(&new, None).unwrap();
    assert_eq!(index.sections[poster].kind, Kind::Other(*b"WAVE"));
    assert_eq!(read(&new).unwrap().len(), 2, "a kind that may be skipped is");
    let required = with_entry(&new, poster, 4, &1u32.to_le_bytes());
    let error = read(&required).unwrap_err();
    assert_eq!(error.kind(), crate::ErrorKind::Unsupported);
    assert!(error.to_string().contains("WAVE"), "{error}");
}

#[test]
fn newer_versions() {
    let (sample, _) = bytes_of(&tiny(), &WriteConfig::default());
    let with = |at: usize| {
        let mut m = sample.clone();
        // Major version 2 is that of files that grow.
        m[at] += 2;
        seal(&mut m);
        read(&m)
    };
    assert_eq!(with(10).unwrap().len(), 2, "a newer minor version is read on");
    let error = with(8).unwrap_err();
    assert_eq!(error.kind(), crate::ErrorKind::Unsupported);
    assert!(error.to_string().contains("version 3.0") && error.to_string().contains("newer splat4d"), "{error}");
}

#[test]
fn inconsistent_sizes_are_refused_by_name() {
    let (sample, _) = bytes_of(&tiny(), &WriteConfig::default());
    let (page, palette) = (1, 3);
    let told = |i: usize, at: usize, bytes: &[u8]| read(&with_entry(&sample, i, at, bytes)).unwrap_err().to_string();
    assert!(told(page, 32, &65_536u32.to_le_bytes()).contains("65536 Gaussians"));
    assert!(told(page, 32, &0u32.to_le_bytes()).contains("0 Gaussians"));
    assert!(told(page, 20, &u32::MAX.to_le_bytes()).contains("cannot be stored"));
    assert!(told(page, 36, &9u32.to_le_bytes()).contains("9 words"));
    assert!(told(page, 28, &7u16.to_le_bytes()).contains("codec 7"));
    assert!(told(page, 40, &f64::NAN.to_le_bytes()).contains("NaN"));
    assert!(told(page, 48, &(-1.0f64).to_le_bytes()).contains("-1 s"));
    assert!(told(page, 56, &0u32.to_le_bytes()).contains("palette"));
    assert!(told(page, 56, &900u32.to_le_bytes()).contains("palette"));
    assert!(told(page, 8, &u64::MAX.to_le_bytes()).contains("beyond the file"));
    assert!(told(page, 8, &64u64.to_le_bytes()).contains("overlaps"));
    assert!(told(palette, 30, &4u16.to_le_bytes()).contains("degree 4"));
    assert!(told(palette, 32, &70_000u32.to_le_bytes()).contains("70000 entries"));
    // One entry less than the pages' labels request, all sizes consistent: found when the page is expanded.
    let raw = bytes_of(&tiny(), &WriteConfig { deflate_level: 0, ..WriteConfig::default() }).0;
    let less = with_entry(&raw, palette, 32, &1u32.to_le_bytes());
    let less = with_entry(&less, palette, 20, &(12 + 9u32).to_le_bytes());
    let less = with_entry(&less, palette, 16, &(12 + 9u32).to_le_bytes());
    let error = read(&less).unwrap_err().to_string();
    assert!(error.contains("entry 1 of a palette of 1"), "{error}");
    // An index of 64 MiB in a file of 100 bytes, and a table that claims more than there is.
    let mut long = sample.clone();
    long[12..16].copy_from_slice(&(60u32 << 20).to_le_bytes());
    let header = crc(&long[..60]).to_le_bytes();
    long[60..64].copy_from_slice(&header);
    assert!(read(&long).unwrap_err().to_string().contains("claims an index"));
    let count = table(&sample) - 4;
    let mut many = sample.clone();
    many[count..count + 4].copy_from_slice(&999_999u32.to_le_bytes());
    seal(&mut many);
    assert!(read(&many).unwrap_err().to_string().contains("999999 sections"));
}

#[test]
fn non_finite_numbers_are_refused() {
    let (sample, _) = bytes_of(&tiny(), &WriteConfig { deflate_level: 0, ..WriteConfig::default() });
    let index = Index::parse(&sample, None).unwrap();
    let first = index.sections[1].offset as usize;
    for (number, value) in [(3, f32::NAN), (12, f32::INFINITY), (10, 50.0), (16, -41.0)] {
        let mut m = sample.clone();
        m[first + 4 * number..first + 4 * number + 4].copy_from_slice(&value.to_le_bytes());
        reseal(&mut m);
        let error = read(&m).unwrap_err().to_string();
        assert!(error.contains(&format!("number {number}")), "{error}");
    }
}

#[test]
fn a_bomb_of_zeros_is_not_unpacked() {
    // Pages of zeros that deflate a thousandfold: each is sound by itself, all together are a trap.
    let zeros = Primitive {
        mean: [0.0; 3],
        center: 0.0,
        half_width: f64::INFINITY,
        softness: 1.0,
        quat: [1.0, 0.0, 0.0, 0.0],
        scales: [1.0; 3],
        opacity: 0.0,
        velocity: [0.0; 3],
        turn: [0.0; 3],
        base_color: [0.0; 3],
        sh_rest: [0.0; 45],
        importance: 0.0,
        label: None,
        features: Vec::new(),
    };
    let mut draft = tiny();
    draft.meta.sh_degree = 0;
    draft.nodes = vec![Node { from: 0.0, to: 2.0, primitives: vec![zeros; 3 * 65_536] }];
    let (sample, summary) = bytes_of(&draft, &WriteConfig { tier: 65_536, ..WriteConfig::default() });
    assert_eq!(summary.pages, 3);
    assert_eq!(read(&sample).unwrap().len(), 3 * 65_536, "a harmless one is read");
    let index = Index::parse(&sample, None).unwrap();
    // The same page forty times over.
    let page = stored(&sample, &index.sections[index.sections.len() - 1]).to_vec();
    let entry = index.sections[index.sections.len() - 1].clone();
    let mut bomb = Index { sections: vec![entry; 40], ..index };
    bomb.meta.gaussians = 40 * 65_536;
    let mut bytes = bomb.bytes("a test");
    (0..40).for_each(|_| bytes.extend_from_slice(&page));
    let error = read(&bytes).unwrap_err().to_string();
    assert!(error.contains("unpack"), "{error}");
}
