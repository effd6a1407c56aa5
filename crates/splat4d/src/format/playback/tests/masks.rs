//! Masks in the file: round trip, rendered, and damaged.

use super::hostile::{reseal, survive, with_entry};
use super::*;
use crate::play::Player;
use crate::scene::KeyMasks;
use std::sync::Arc;

/// A synthetic file all of whose pages but the second have random masks.
fn masked(n: usize, keys: usize, seed: u64) -> Pages {
    let mut pages = read_pages(&bytes_of(&made_up(n, 1, seed), &WriteConfig::default()).0).unwrap();
    for (i, layer) in pages.layers.iter_mut().enumerate().filter(|(i, _)| *i != 1) {
        let rng = Rng::new(seed, "masks", i as u64);
        let times = (0..keys).map(|k| 0.1 + 0.8 * k as f64 / keys as f64).collect();
        let mut masks = KeyMasks::new(times, layer.params.len());
        for row in 0..masks.rows() {
            // Long runs of time, as true masks have them.
            let from = rng.below(2 * row as u64, keys);
            (from..keys.min(from + 1 + rng.below(2 * row as u64 + 1, 3))).for_each(|key| masks.set(key, row));
        }
        layer.masks = Some(Arc::new(masks));
    }
    pages
}

fn file(pages: &Pages, level: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    let config = WriteConfig { deflate_level: level, ..WriteConfig::default() };
    write_pages(&pages.draft(Some(b"poster")), &config, &mut bytes).unwrap();
    bytes
}

#[test]
fn masks_round_trip_with_any_number_of_rows_and_keys() {
    for (n, keys) in [(4, 1), (60, 2), (64, 5), (130, 3), (1030, 9)] {
        let pages = masked(n, keys, n as u64);
        let bytes = file(&pages, 6);
        let index = Index::parse(&bytes, None).unwrap();
        assert_eq!(index.version, [1, 1]);
        let kinds: Vec<Kind> = index.sections.iter().map(|e| e.kind).collect();
        let want = [Kind::Poster, Kind::Page, Kind::Masks, Kind::Page, Kind::Palette, Kind::Page, Kind::Masks];
        assert_eq!(kinds, want, "masks stand right behind their page");
        let e = &index.sections[2];
        assert!(!e.required && e.page == Some(1) && e.count == index.sections[1].count);
        let back = read(&bytes).unwrap();
        assert_eq!(back.layers.len(), 3);
        for (a, b) in pages.layers.iter().zip(&back.layers) {
            assert_eq!(a.masks, b.masks);
        }
        let again = read_pages(&file(&read_pages(&bytes).unwrap(), 0)).unwrap();
        assert!(again.layers.iter().zip(&pages.layers).all(|(a, b)| a.masks == b.masks));
    }
    // A file without masks is one of version 1.0, bit for bit.
    let (plain, _) = bytes_of(&made_up(60, 1, 3), &WriteConfig::default());
    assert_eq!(Index::parse(&plain, None).unwrap().version, [1, 0]);
}

#[test]
fn a_player_renders_the_gaussians_that_masks_admit() {
    let pages = masked(3000, 6, 50);
    let bytes = file(&pages, 6);
    let scene = read(&bytes).unwrap();
    let mut memory = Player::of_scene(&scene);
    let copy: &'static [u8] = bytes.clone().leak();
    let mut streamed = Player::open(Box::new(copy), copy.len() as u64, 1 << 30).unwrap();
    let mut instant = Evaluation::default();
    let (mut drawn, mut alive) = (0, 0);
    for step in 0..=40 {
        let t = Time(f64::from(step) / 40.0);
        scene.at(t, &mut instant);
        let truth: Vec<Vec<f32>> = numbers(&scene.splats(&instant));
        assert_eq!(numbers(&memory.at(t).unwrap()), truth, "in memory at {}", t.0);
        assert_eq!(numbers(&streamed.at(t).unwrap()), truth, "from the file at {}", t.0);
        drawn += truth.len();
        for layer in &scene.layers {
            let spans = layer.spans();
            let here = (0..spans.len()).filter(|&i| spans[i][0] <= t.0 && t.0 <= spans[i][1]);
            alive += here.clone().count();
            if let Some(masks) = layer.masks.as_ref().filter(|_| layer.spans_over(t)) {
                let mut ids = Vec::new();
                layer.active(t, &mut ids);
                let want: Vec<u32> = here.filter(|&i| masks.allows(t.0, i)).map(|i| i as u32).collect();
                assert_eq!(ids, want);
            }
        }
    }
    assert!(0 < drawn && 10 * drawn < 8 * alive, "masks leave {drawn} of {alive}");
    // Without the sections all are rendered: as in an older reader.
    let mut old = Index::parse(&bytes, None).unwrap();
    let bodies: Vec<Vec<u8>> = old.sections.iter().map(|e| stored(&bytes, e).to_vec()).collect();
    old.sections.iter_mut().filter(|e| e.kind == Kind::Masks).for_each(|e| {
        e.kind = Kind::Other(*b"WAVE");
        e.page = None;
    });
    let mut unmasked = old.bytes("a test");
    bodies.iter().for_each(|b| unmasked.extend_from_slice(b));
    assert!(read(&unmasked).unwrap().layers.iter().all(|l| l.masks.is_none()));
}

fn numbers(splats: &crate::scene::Splats<'_>) -> Vec<Vec<f32>> {
    let row = |p: &crate::scene::Part<'_>, j| p.out.read::<10>(j, 0).to_vec();
    splats.parts.iter().flat_map(|p| (0..p.out.rows()).map(move |j| row(p, j))).collect()
}

#[test]
fn damaged_masks_are_refused_by_name() {
    let pages = masked(64, 5, 51);
    let sample = file(&pages, 0);
    let index = Index::parse(&sample, None).unwrap();
    let (page, masks) = (1, 2);
    let e = &index.sections[masks];
    assert_eq!((e.codec, e.kind), (Codec::Raw, Kind::Masks));
    let told = |at: usize, bytes: &[u8]| read(&with_entry(&sample, masks, at, bytes)).unwrap_err().to_string();
    assert!(told(32, &0u32.to_le_bytes()).contains("masks of 0"));
    assert!(told(32, &65_537u32.to_le_bytes()).contains("masks of 65537"));
    assert!(told(32, &(e.count - 1).to_le_bytes()).contains("its page, section 1"));
    assert!(told(20, &(e.bytes - 1).to_le_bytes()).contains("masks of 32"));
    assert!(told(20, &u32::MAX.to_le_bytes()).contains("cannot be stored"));
    assert!(told(40, &f64::NAN.to_le_bytes()).contains("NaN"));
    assert!(told(48, &(-1.0f64).to_le_bytes()).contains("-1 s"));
    assert!(told(40, &0.05f64.to_le_bytes()).contains("the first"));
    assert!(told(56, &0u32.to_le_bytes()).contains("section 0"));
    assert!(told(56, &99u32.to_le_bytes()).contains("section 99"));
    assert!(told(56, &u32::MAX.to_le_bytes()).contains("section 4294967295"));
    // Masks of a page that has some: both pages have as many Gaussians.
    let other = index.sections.iter().rposition(|e| e.kind == Kind::Masks).unwrap();
    let mut pages = pages;
    let [first, third] = [0, 2].map(|i| pages.layers[i].params.len().min(16));
    for (i, n) in [(0, first), (2, third)] {
        let keep = (0..pages.layers[i].params.len()).map(|r| r < n);
        let edit = crate::scene::RowEdit::prune(crate::scene::Space::Gaussians, keep);
        pages.layers[i].edit(&edit, &Rng::new(0, "", 0));
        pages.labels[i].truncate(n);
    }
    let even = file(&pages, 0);
    assert!(read(&even).is_ok());
    let twice = with_entry(&even, other, 56, &(page as u32).to_le_bytes());
    assert!(read(&twice).unwrap_err().to_string().contains("has masks already"));
    // Inside: the number of keys, times that fall, a time that is none.
    let body = e.offset as usize;
    let inside = |at: usize, bytes: &[u8]| {
        let mut m = sample.clone();
        m[body + at..body + at + bytes.len()].copy_from_slice(bytes);
        reseal(&mut m);
        read(&m).unwrap_err().to_string()
    };
    assert!(inside(0, &6u32.to_le_bytes()).contains("claim 6 key times"));
    assert!(inside(0, &0u32.to_le_bytes()).contains("claim 0 key times"));
    assert!(inside(16, &0.1f64.to_le_bytes()).contains("do not rise"));
    assert!(inside(24, &f64::INFINITY.to_le_bytes()).contains("do not rise"));
    // Bits beyond the last Gaussian mean nothing.
    let small = file(&masked(20, 2, 52), 0);
    let index = Index::parse(&small, None).unwrap();
    let e = &index.sections[2];
    assert_eq!(e.count % 8, 2);
    let mut spare = small.clone();
    let last = (e.offset + u64::from(e.stored)) as usize - 1;
    spare[last] ^= 0xF0;
    reseal(&mut spare);
    assert_eq!(read(&spare).unwrap().layers[0].masks, read(&small).unwrap().layers[0].masks);
}

#[test]
fn masks_that_cannot_be_written_are_named() {
    let mut pages = masked(64, 5, 53);
    pages.layers[0].masks = Some(Arc::new(KeyMasks::new(vec![0.0], 5)));
    let error = write_pages(&pages.draft(None), &WriteConfig::default(), &mut Vec::new()).unwrap_err().to_string();
    assert!(error.contains("masks of 5 Gaussians"), "{error}");
    let rows = pages.layers[0].params.len();
    pages.layers[0].masks = Some(Arc::new(KeyMasks::new((0..65_536).map(f64::from).collect(), rows)));
    let error = write_pages(&pages.draft(None), &WriteConfig::default(), &mut Vec::new()).unwrap_err().to_string();
    assert!(error.contains("65536 key times"), "{error}");
}

#[test]
fn mutants_with_masks_are_read_or_refused() {
    let sample = file(&masked(200, 4, 54), 6);
    let survivors = crate::format::mutate::mutants(&sample, 600, "masks").filter(|m| {
        let mut m = m.clone();
        reseal(&mut m);
        survive(&m)
    });
    let survivors = survivors.count();
    assert!(0 < survivors && survivors < 600, "{survivors} of 600");
    // Every byte of the table's entries of masks.
    let masks = Index::parse(&sample, None).unwrap().sections.iter().position(|e| e.kind == Kind::Masks).unwrap();
    for at in 0..64 {
        for value in [0x00, 0x01, 0x7F, 0x80, 0xFF] {
            survive(&with_entry(&sample, masks, at, &[value]));
        }
    }
}
