//! Layers that are pages: round trips, at any depth, and the coder against the file.

use super::*;
use crate::layers::Layer;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, LIFE, SH};

/// A synthetic file in memory.
fn pages(n: usize, degree: usize, seed: u64) -> Pages {
    let config = WriteConfig { kmeans_rounds: 1, ..WriteConfig::default() };
    read_pages(&bytes_of(&made_up(n, degree, seed), &config).0).unwrap()
}

/// Pages that have been trained for a while: every number of every table has moved a little, quaternions are no longer
/// unit, and some Gaussians with infinite lifespans get finite ones.
fn trained(n: usize, degree: usize, seed: u64) -> Pages {
    let mut pages = pages(n, degree, seed);
    for (l, layer) in pages.layers.iter_mut().enumerate() {
        for key in layer.params.keys().collect::<Vec<_>>() {
            let rng = Rng::new(seed, "trained", l as u64).fork(u64::from(key.0));
            let table = &mut layer.params[key];
            for row in 0..table.rows() {
                for col in 0..table.width().min(16) {
                    let (r, x) = (rng.fork(row as u64), table.get(row, col));
                    let dies = key == LIFE && col == 1 && x > 20.0 && r.below(40, 3) == 0;
                    table.set(row, col, if dies { -2.0 } else { x + (0.02 * r.normal(col as u64)) as f32 });
                }
            }
        }
    }
    pages
}

fn coarse() -> Depths {
    Depths { position: 12, center: 10, scale: 6, opacity: 5, rotation: 8, shift: 7, turn: 6, color: 6, life: 5 }
}

fn written(pages: &Pages, depths: Depths) -> Vec<u8> {
    let mut bytes = Vec::new();
    let config = WriteConfig { depths, ..WriteConfig::default() };
    write_pages(&pages.draft(Some(b"poster")), &config, &mut bytes).unwrap();
    bytes
}

/// All bits of a layer's tables; numbers behind the last row are left out.
fn bits(layer: &Layer<f32>) -> Vec<u32> {
    let numbers = |k| layer.params[k].column_to_rows(0, layer.params[k].width());
    layer.params.keys().flat_map(numbers).map(f32::to_bits).collect()
}

#[test]
fn the_coder_equals_a_reader_bit_for_bit() {
    let least =
        Depths { position: 2, center: 2, scale: 2, opacity: 2, rotation: 2, shift: 2, turn: 2, color: 2, life: 2 };
    for (degree, depths) in [(0, Depths::default()), (1, coarse()), (3, Depths::default()), (2, least)] {
        let mut pages = trained(2300, degree, 20 + degree as u64);
        // Numbers at the edge of the range.
        let p = &mut pages.layers[0].params;
        p[GEOMETRY].write(0, QUAT, [0.0; 4]);
        p[GEOMETRY].write(1, LOG_SCALE, [-300.0, 60.0, 0.0]);
        p[GEOMETRY].set(2, OPACITY, 80.0);
        p[LIFE].write(3, 0, [0.3, -80.0, -90.0]);
        p[LIFE].write(4, 0, [1e6, 70.0, 70.0]);
        let file = written(&pages, depths);
        let back = read(&file).unwrap();
        assert_eq!(back.layers.len(), pages.layers.len());
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let shown = |(layer, labels): (&Layer<f32>, &Vec<u16>)| {
                    let mut shown = layer.clone();
                    Coder { depths }.show(layer, labels, pages.palette.as_ref(), &|_| true, &mut shown);
                    shown
                };
                pages.layers.iter().zip(&pages.labels).map(shown).collect::<Vec<_>>()
            })
        };
        for shown in [run(1), run(3)] {
            for (a, b) in shown.iter().zip(&back.layers) {
                assert!(bits(a) == bits(b), "degree {degree}, {depths:?}");
            }
        }
        let again = read_pages(&file).unwrap();
        assert_eq!((&again.labels, &again.tiers, &again.palette), (&pages.labels, &pages.tiers, &pages.palette));
        assert!(again.layers.iter().zip(&pages.layers).all(|(a, b)| a.span == b.span));
        assert!(again.meta.sh_degree == degree && again.meta.cameras == pages.meta.cameras);
    }
}

#[test]
fn only_selected_blocks_change() {
    let pages = trained(2300, 1, 30);
    let (layer, labels) = (&pages.layers[0], &pages.labels[0]);
    let rows = layer.params.len();
    assert!(rows > 1024 && !rows.is_multiple_of(BLOCK_GAUSSIANS));
    let mut shown = layer.clone();
    let mut whole = layer.clone();
    let coder = Coder { depths: coarse() };
    coder.show(layer, labels, pages.palette.as_ref(), &|b| b % 2 == 1, &mut shown);
    coder.show(layer, labels, pages.palette.as_ref(), &|_| true, &mut whole);
    for row in 0..rows {
        let like = if row / BLOCK_GAUSSIANS % 2 == 1 { &whole } else { layer };
        for key in layer.params.keys() {
            let width = layer.params[key].width();
            assert!((0..width).all(|c| shown.params[key].get(row, c) == like.params[key].get(row, c)), "row {row}");
        }
    }
    assert!(bits(&whole) != bits(layer));
    // Without a palette, coefficients above degree 0 are the caller's.
    let mut bare = layer.clone();
    coder.show(layer, &[], None, &|_| true, &mut bare);
    let rest = |l: &Layer<f32>| l.params[SH].column_to_rows(3, 9);
    assert!(rest(&bare) == rest(layer) && rest(&whole) != rest(layer));
}

#[test]
fn unchanged_pages_round_trip_almost_exactly() {
    let pages = pages(3000, 2, 31);
    let again = read_pages(&written(&pages, Depths::default())).unwrap();
    for (a, b) in pages.layers.iter().zip(&again.layers) {
        let [mut moved, mut total] = [0, 0];
        for key in a.params.keys() {
            let (x, y) = (&a.params[key], &b.params[key]);
            for (x, y) in x.column_to_rows(0, x.width()).iter().zip(y.column_to_rows(0, y.width())) {
                (moved, total) = (moved + usize::from((x - y).abs() > 1e-5 * (1.0 + x.abs())), total + 1);
            }
        }
        // A lifespan that as decoded spans all of its page becomes infinite, and moves its centre.
        assert!(1000 * moved < total, "{moved} of {total} numbers moved");
    }
}

#[test]
fn layers_round_trip_through_primitives() {
    let pages = trained(1200, 1, 32);
    for (layer, labels) in pages.layers.iter().zip(&pages.labels) {
        let p = primitives(layer);
        assert!(p.iter().any(|p| p.half_width.is_infinite()) && p.iter().any(|p| p.half_width.is_finite()));
        let rows: Vec<_> = p.iter().zip(labels.iter().copied()).collect();
        let mut page = through(&rows, layer.span);
        page.palette = Some(0);
        let back = page.layer(pages.palette.as_ref()).unwrap();
        let mut shown = layer.clone();
        Coder::default().show(layer, labels, pages.palette.as_ref(), &|_| true, &mut shown);
        // Primitives are f32 and no logarithms: a code may fall to the other side, one step away.
        let [mut moved, mut total] = [0, 0];
        for key in layer.params.keys() {
            let (x, y) = (&shown.params[key], &back.params[key]);
            for (x, y) in x.column_to_rows(0, x.width()).iter().zip(y.column_to_rows(0, y.width())) {
                assert!((x - y).abs() < 0.02 * (1.0 + x.abs()), "{x} and {y} in table {key:?}");
                (moved, total) = (moved + usize::from((x - y).abs() > 1e-5 * (1.0 + x.abs())), total + 1);
            }
        }
        assert!(100 * moved < total, "{moved} of {total} numbers moved");
    }
}

#[test]
fn coarse_codes_leave_their_low_bits_alone() {
    let pages = trained(2300, 1, 33);
    let file = written(&pages, coarse());
    let index = Index::parse(&file, None).unwrap();
    let fields = [
        (0, 0, 16, 12, 0),
        (0, 16, 16, 12, 0),
        (1, 0, 16, 12, 0),
        (1, 16, 16, 10, 0),
        (2, 0, 8, 6, 0),
        (3, 0, 10, 8, 511),
        (3, 20, 10, 8, 511),
        (4, 10, 10, 7, 511),
        (5, 20, 10, 6, 511),
        (6, 8, 8, 6, 0),
        (7, 16, 8, 5, 0),
    ];
    for (_, e) in index.pages() {
        let page = decode_page(e, stored(&file, e)).unwrap();
        for (word, first, full, bits, middle) in fields {
            let step = 1i64 << (full - bits);
            let codes: Vec<i64> = page.words.iter().map(|w| i64::from(w[word] >> first & ((1 << full) - 1))).collect();
            assert!(codes.iter().all(|c| (c - middle) % step == 0), "word {word} from bit {first}");
            let mut different = codes.clone();
            different.sort_unstable();
            different.dedup();
            assert!(
                different.len() > (1 << bits).min(page.len()) / 4,
                "and the others are used: {} codes",
                different.len()
            );
        }
        // Full opacity stays full, and half-widths keep their two special codes.
        assert!(page.words.iter().all(|w| [0, 255].contains(&(w[2] >> 24)) || (w[2] >> 24) % 8 == 0));
        assert!(page.words.iter().all(|w| [0, 255].contains(&(w[6] >> 24)) || (w[6] >> 24) % 8 == 1));
        assert!(page.words.iter().any(|w| w[6] >> 24 == 255));
    }
    // Synthetic numbers are noise: the saving is the cost of the low bits.
    let stored = |file: &[u8]| -> u32 { Index::parse(file, None).unwrap().pages().map(|(_, e)| e.stored).sum() };
    let (few, all) = (stored(&file), stored(&written(&pages, Depths::default())));
    assert!(100 * few < 80 * all, "{few} bytes instead of {all}");
}

#[test]
fn coarse_codes_are_half_a_step_off_at_most() {
    let pages = trained(2300, 0, 34);
    let depths = coarse();
    for layer in &pages.layers {
        let mut shown = layer.clone();
        Coder { depths }.show(layer, &[], None, &|_| true, &mut shown);
        for first in (0..layer.params.len()).step_by(BLOCK_GAUSSIANS) {
            let rows = first..layer.params.len().min(first + BLOCK_GAUSSIANS);
            for col in [LOG_SCALE, LOG_SCALE + 1, LOG_SCALE + 2] {
                let all = || rows.clone().flat_map(|r| layer.params[GEOMETRY].read::<3>(r, LOG_SCALE));
                let (low, high) = all().fold((f32::MAX, f32::MIN), |(l, h), x| (l.min(x), h.max(x)));
                // 2^6 codes, whose ends are the ends of the range.
                let step = (high - low) / 63.0;
                for r in rows.clone() {
                    let error = shown.params[GEOMETRY].get(r, col) - layer.params[GEOMETRY].get(r, col);
                    assert!(error.abs() < 0.5001 * step + 1e-5, "{error} of a step of {step}");
                }
            }
        }
    }
}

#[test]
fn uncodable_layers_are_named() {
    let refused = |change: fn(&mut Pages, &mut Depths)| {
        let (mut pages, mut depths) = (pages(400, 1, 35), Depths::default());
        change(&mut pages, &mut depths);
        let config = WriteConfig { depths, ..WriteConfig::default() };
        write_pages(&pages.draft(None), &config, &mut Vec::new()).unwrap_err().to_string()
    };
    assert!(refused(|_, d| d.scale = 9).contains("9 bits for `scale`"));
    assert!(refused(|_, d| d.turn = 1).contains("1 bits for `turn`"));
    assert!(refused(|p, _| p.layers[1].params[GEOMETRY].set(7, 1, f32::NAN)).contains("Gaussian 7"));
    assert!(refused(|p, _| p.layers[0].params[SH].set(3, 2, f32::INFINITY)).contains("Gaussian 3"));
    assert!(refused(|p, _| p.labels[2][5] = 60_000).contains("entry 60000"));
    assert!(refused(|p, _| p.labels[2].truncate(5)).contains("5 labels"));
    assert!(refused(|p, _| p.layers[1].span = [0.5, 0.5]).contains("0.5"));
    let mut draft = made_up(40, 1, 36);
    draft.nodes.truncate(1);
    let config = WriteConfig { depths: Depths { life: 0, ..Depths::default() }, ..WriteConfig::default() };
    assert!(write(&draft, &config, &mut Vec::new()).unwrap_err().to_string().contains("`life`"));
    // A page of which nothing is left is left out.
    let mut some = pages(400, 1, 37);
    let layer = &mut some.layers[0];
    layer.edit(
        &crate::scene::RowEdit::prune(crate::scene::Space::Gaussians, (0..200).map(|_| false)),
        &Rng::new(0, "", 0),
    );
    some.labels[0].clear();
    assert_eq!(read(&written(&some, Depths::default())).unwrap().layers.len(), 2);
}

#[test]
fn files_with_several_palettes_are_refused() {
    let (file, _) = bytes_of(&made_up(400, 1, 38), &WriteConfig::default());
    assert_eq!(read_pages(&file).unwrap().scene().len(), 400);
    let mut index = Index::parse(&file, None).unwrap();
    let bodies: Vec<&[u8]> = index.sections.iter().map(|e| stored(&file, e)).collect();
    let at = index.sections.iter().position(|e| e.kind == Kind::Palette).unwrap();
    index.sections.push(index.sections[at].clone());
    let mut twice = index.bytes("a test");
    bodies.iter().for_each(|b| twice.extend_from_slice(b));
    twice.extend_from_slice(bodies[at]);
    assert_eq!(read(&twice).unwrap().len(), 400);
    assert!(read_pages(&twice).unwrap_err().to_string().contains("several palettes"));
}
