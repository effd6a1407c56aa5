//! Bitrate ladders: nested rungs within their rates, all Gaussians in the file, the most important ones first.

use super::super::ladder::Windows;
use super::*;

/// Seconds of the clip.
const SECONDS: usize = 4;

/// A clip of some seconds: a root, halves, seconds and frames of the third second. `n` Gaussians in each of the first.
fn long(n: usize) -> Draft {
    let rng = Rng::new(5, "ladder", 0);
    let end = SECONDS as f64;
    let mut spans = vec![[0.0, end], [0.0, 0.5 * end], [0.5 * end, end]];
    spans.extend((0..SECONDS).map(|i| [i as f64, i as f64 + 1.0]));
    spans.extend((0..25).map(|i| [2.0 + 0.04 * f64::from(i), 2.0 + 0.04 * f64::from(i + 1)]));
    let node = |(k, &[from, to]): (usize, &[f64; 2])| {
        let count = if k < 7 { n } else { n / 16 };
        let one = |i: usize| {
            let p = primitive(rng.fork((k * n + i) as u64));
            Primitive { center: 0.5 * (from + to), half_width: f64::INFINITY, turn: [0.0; 3], ..p }
        };
        Node { from, to, primitives: (0..count).map(one).collect() }
    };
    let draft = made_up(4, 1, 0);
    let meta = Meta { clip: [0.0, end - 0.04], ..draft.meta.clone() };
    Draft { meta, nodes: spans.iter().enumerate().map(node).collect(), ..draft }
}

fn laddered(draft: &Draft, megabits: &[f64]) -> (Vec<u8>, Index) {
    let ladder = megabits.iter().map(|rate| 1e6 * rate).collect();
    let config = WriteConfig { kmeans_rounds: 1, deflate_level: 1, ladder, ..WriteConfig::default() };
    let (bytes, _) = bytes_of(draft, &config);
    let index = Index::parse(&bytes, Some(bytes.len() as u64)).unwrap();
    (bytes, index)
}

fn most(index: &Index, tiers: u16) -> f64 {
    index.bits_per_second(tiers).into_iter().fold(0.0, f64::max)
}

#[test]
fn every_rung_stays_within_its_rate_in_every_second_and_uses_it() {
    let draft = long(3000);
    let (bytes, index) = laddered(&draft, &[0.5, 1.0, 1.5]);
    assert!(strict(&bytes).unwrap().iter().all(|d| !d.contains("rung")));
    let total: usize = draft.nodes.iter().map(|n| n.primitives.len()).sum();
    assert_eq!(read(&bytes).unwrap().len(), total, "nothing is lost");
    let ladder = &index.meta.ladder;
    assert_eq!(ladder.iter().take(3).map(|r| r.rate).collect::<Vec<_>>(), [0.5e6, 1e6, 1.5e6]);
    assert_eq!(ladder.len(), 4, "what exceeds the highest rate is a rung of its own: {ladder:?}");
    for (k, rung) in ladder.iter().enumerate() {
        let share = most(&index, rung.tiers) / rung.rate;
        assert!((if k < 3 { 0.7 } else { 0.999 }..=1.0).contains(&share), "rung {k}: {share} of its rate");
    }
    assert!(index.pages().all(|(_, e)| e.tier < ladder[3].tiers), "the last rung has all pages");
    // Coarse first: a prefix of the file has whole rungs.
    let rung = |e: &Entry| ladder.iter().position(|r| e.tier < r.tiers);
    assert!(index.pages().map(|(_, e)| rung(e)).is_sorted());
}

#[test]
fn a_rung_has_the_most_important_gaussians_of_every_span() {
    let mut draft = long(3000);
    // Opacity repeats the importance, so that the file shows it.
    draft.nodes.iter_mut().flat_map(|n| &mut n.primitives).for_each(|p| p.opacity = 0.1 + 0.9 * p.importance);
    let (bytes, index) = laddered(&draft, &[0.3, 2.0]);
    let opacities = |of: &dyn Fn(&Entry) -> bool| -> Vec<f64> {
        let pages = index.pages().filter(|(_, e)| e.span == [0.0, SECONDS as f64] && of(e));
        let decoded = pages.map(|(_, e)| decode_page(e, stored(&bytes, e)).unwrap());
        decoded.flat_map(|p| (0..p.len()).map(|i| p.record(i).opacity).collect::<Vec<_>>()).collect()
    };
    let tiers = index.meta.ladder[0].tiers;
    let (low, rest) = (opacities(&|e| e.tier < tiers), opacities(&|e| e.tier >= tiers));
    let least = low.iter().copied().fold(f64::INFINITY, f64::min);
    let greatest = rest.iter().copied().fold(0.0, f64::max);
    assert!(!low.is_empty() && !rest.is_empty() && least >= greatest - 1.0 / 255.0, "{least} {greatest}");
}

#[test]
fn rates_that_add_nothing_are_left_out_and_impossible_ones_are_errors() {
    let draft = long(300);
    let (bytes, index) = laddered(&draft, &[40.0, 80.0]);
    let [rung] = index.meta.ladder[..] else { panic!("{:?}", index.meta.ladder) };
    assert_eq!(rung.rate, 40e6);
    assert!(most(&index, u16::MAX) <= 40e6 && read(&bytes).is_ok());
    for (rates, what) in [(vec![1e3], "invalid ladder"), (vec![2e6, 1e6], "rising rates"), (vec![f64::NAN], "rising")] {
        let config = WriteConfig { kmeans_rounds: 1, ladder: rates, ..WriteConfig::default() };
        let error = write(&draft, &config, &mut Vec::new()).unwrap_err().to_string();
        assert!(error.contains(what), "{error}");
    }
    // Sound that is added later counts.
    let config = |later| WriteConfig { kmeans_rounds: 1, ladder: vec![1e6], later, ..WriteConfig::default() };
    let first = |later| {
        let (bytes, _) = bytes_of(&long(3000), &config(later));
        let index = Index::parse(&bytes, Some(bytes.len() as u64)).unwrap();
        most(&index, index.meta.ladder[0].tiers)
    };
    assert!(first(200_000) < first(0) - 3e5, "{} {}", first(200_000), first(0));
}

#[test]
fn windows_last_a_second_or_more_and_lose_no_byte() {
    for (end, count, seconds) in
        [(0.04, 1, 1.0), (0.9999999, 1, 1.0), (1.9, 1, 1.9), (2.0, 2, 1.0), (7.5, 7, 7.5 / 7.0)]
    {
        let windows = Windows::of([[0.0, end], [0.0, 0.5 * end]].into_iter());
        let found = format!("{windows:?}");
        assert!(found.contains(&format!("count: {count}")), "{end}: {found}");
        let draft = Draft {
            nodes: vec![Node { from: 0.0, to: end, primitives: long(40).nodes[0].primitives.clone() }],
            ..long(40)
        };
        let meta = Meta { clip: [0.0, end - 0.01], ..draft.meta.clone() };
        let (bytes, _) = bytes_of(&Draft { meta, ..draft }, &WriteConfig::default());
        let index = Index::parse(&bytes, None).unwrap();
        let loads = index.bits_per_second(u16::MAX);
        assert_eq!(loads.len(), count);
        let sum: f64 = loads.iter().map(|l| l * seconds / 8.0).sum();
        assert!((sum - bytes.len() as f64).abs() < 1e-3 * sum, "{sum} of {}", bytes.len());
    }
}

#[test]
fn damaged_ladders_are_refused_and_changed_pages_state_none() {
    let (bytes, index) = laddered(&long(3000), &[1.0, 2.0]);
    for ladder in [
        vec![Rung { rate: 2e6, tiers: 1, ..Rung::default() }, Rung { rate: 1e6, tiers: 2, ..Rung::default() }],
        vec![Rung { rate: 1e6, tiers: 2, ..Rung::default() }, Rung { rate: 2e6, tiers: 2, ..Rung::default() }],
        vec![Rung { rate: 0.0, tiers: 1, ..Rung::default() }],
        vec![Rung { rate: f64::NAN, tiers: 1, ..Rung::default() }],
        (1..20).map(|k| Rung { rate: f64::from(k), tiers: k, ..Rung::default() }).collect(),
    ] {
        assert!(Meta { ladder, ..index.meta.clone() }.check().is_err());
    }
    // A rate that is not kept is a deviation.
    let mut low = index.clone();
    low.meta.ladder[0].rate = 0.5e6;
    let head = low.bytes("test");
    let bodies: Vec<u8> = index.sections.iter().flat_map(|e| stored(&bytes, e).to_vec()).collect();
    let found = strict(&[head, bodies].concat()).unwrap();
    assert!(found.iter().any(|d| d.contains("rung 1 of the ladder needs")), "{found:?}");
    let pages = read_pages(&bytes).unwrap();
    let mut again = Vec::new();
    write_pages(&pages.draft(None), &WriteConfig::default(), &mut again).unwrap();
    assert!(Index::parse(&again, None).unwrap().meta.ladder.is_empty());
}
