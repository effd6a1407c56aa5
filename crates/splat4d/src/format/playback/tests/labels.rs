//! Labels in the file: round trip, skipped by readers without support, and damaged.

use super::hostile::{reseal, survive};
use super::*;
use crate::scene::labels;

/// A synthetic file whose Gaussians of the first two nodes have one of three labels or none.
fn labelled(n: usize) -> Draft {
    let mut draft = made_up(n, 1, 7);
    draft.meta.labels = vec!["floor".into(), "hand".into(), "ball".into()];
    for node in &mut draft.nodes[..2] {
        for (i, p) in node.primitives.iter_mut().enumerate() {
            p.label = [Some(0), Some(1), Some(2), None][i % 4];
        }
    }
    draft
}

/// How many Gaussians of a scene have each label, and none.
fn counts(scene: &Scene<f32>) -> [usize; 4] {
    let mut counts = [0; 4];
    scene.layers.iter().flat_map(|l| labels::of(&l.params)).for_each(|l| counts[l.unwrap_or(3)] += 1);
    counts
}

#[test]
fn labels_round_trip_through_drafts_and_pages() {
    let draft = labelled(400);
    let (bytes, _) = bytes_of(&draft, &WriteConfig::default());
    let index = Index::parse(&bytes, None).unwrap();
    assert_eq!((index.version, &index.meta.labels), ([1, 2], &draft.meta.labels));
    let sections: Vec<&Entry> = index.sections.iter().filter(|e| e.kind == Kind::Labels).collect();
    assert!(sections.len() == 2 && sections.iter().all(|e| !e.required), "the third page has none");
    let scene = read(&bytes).unwrap();
    assert_eq!(scene.labels, draft.meta.labels);
    assert_eq!(counts(&scene), [75, 75, 75, 175]);
    // Each Gaussian has its own: they are distinguished by their colours.
    let own = |color: [f32; 3]| draft.nodes[0].primitives.iter().find(|p| p.base_color == color).map(|p| p.label);
    assert!(draft.nodes[0].primitives.iter().all(|p| own(p.base_color) == Some(p.label)));
    let pages = read_pages(&bytes).unwrap();
    let mut again = Vec::new();
    write_pages(&pages.draft(None), &WriteConfig::default(), &mut again).unwrap();
    let back = read(&again).unwrap();
    assert_eq!((back.labels.clone(), counts(&back)), (scene.labels.clone(), counts(&scene)));
    for (a, b) in pages.layers.iter().zip(&back.layers) {
        assert_eq!(labels::of(&a.params), labels::of(&b.params));
    }
    // Without them the file is one of version 1.0.
    let plain = Draft { meta: Meta { labels: Vec::new(), ..draft.meta.clone() }, ..draft };
    assert_eq!(Index::parse(&bytes_of(&plain, &WriteConfig::default()).0, None).unwrap().version, [1, 0]);
}

#[test]
fn labels_that_do_not_fit_are_refused() {
    let mut draft = labelled(60);
    draft.nodes[0].primitives[5].label = Some(3);
    let mut out = Vec::new();
    let error = write(&draft, &WriteConfig::default(), &mut out).unwrap_err().to_string();
    assert!(error.contains("label 3 of 3") && error.contains("Gaussian 5"), "{error}");
    let (bytes, _) = bytes_of(&labelled(60), &WriteConfig { deflate_level: 0, ..WriteConfig::default() });
    let index = Index::parse(&bytes, None).unwrap();
    let at = index.sections.iter().position(|e| e.kind == Kind::Labels).unwrap();
    let e = &index.sections[at];
    assert_eq!(e.codec, Codec::Raw);
    let mut wrong = bytes.clone();
    wrong[e.offset as usize] = 77;
    reseal(&mut wrong);
    let error = read(&wrong).unwrap_err().to_string();
    assert!(error.contains("label 77 of 3") && error.contains(&format!("section {at}")), "{error}");
    assert!(survive(&bytes) && !survive(&wrong));
}
