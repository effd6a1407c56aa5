//! Feature channels in the file: round trip, skipped by readers without support, and damaged.

use super::hostile::survive;
use super::*;
use crate::layers::Layer;
use crate::math::sh::dc_to_rgb;
use crate::scene::SH;
use crate::scene::features::{key, row};

/// A synthetic file whose Gaussians of the first node have three channels or, every fourth, none.
fn featured(n: usize) -> Draft {
    let mut draft = made_up(n, 1, 7);
    draft.meta.features = vec![[-1.0, 2.0], [0.5, 0.5], [0.0, 10.0]];
    for (i, p) in draft.nodes[0].primitives.iter_mut().enumerate() {
        // What identifies a Gaussian in the file: its first colour.
        p.features = if i % 4 == 3 { Vec::new() } else { vec![3.0 * p.base_color[0] - 1.0, 0.5, i as f32 % 10.0] };
    }
    draft
}

/// The features of all rows of a scene that have some, with their first colour.
fn of(scene: &Scene<f32>) -> Vec<(f32, Vec<f32>)> {
    let rows = |l: &Layer<f32>| {
        let key = key(&l.params)?;
        let one = |r: usize| (dc_to_rgb(l.params[SH].get(r, 0)), row(&l.params, key, r));
        Some((0..l.params.len()).map(one).filter(|(_, f)| f.iter().any(|x| *x != 0.0)).collect::<Vec<_>>())
    };
    scene.layers.iter().filter_map(rows).flatten().collect()
}

#[test]
fn features_round_trip_through_drafts_and_pages() {
    let draft = featured(400);
    let (bytes, _) = bytes_of(&draft, &WriteConfig::default());
    let index = Index::parse(&bytes, None).unwrap();
    assert_eq!((index.version, &index.meta.features), ([1, 2], &draft.meta.features));
    let sections: Vec<&Entry> = index.sections.iter().filter(|e| e.kind == Kind::Features).collect();
    assert!(sections.len() == 1 && !sections[0].required, "the other pages have none");
    let scene = read(&bytes).unwrap();
    let back = of(&scene);
    let first = draft.nodes[0].primitives.len();
    assert_eq!(back.len(), first - first / 4);
    for (color, features) in &back {
        let step = 3.0 / 254.0;
        // The colour is quantised itself.
        assert!((features[0] - (3.0 * color - 1.0).clamp(-1.0, 2.0)).abs() < step + 0.05, "{color} {features:?}");
        assert!((features[1] - 0.5).abs() < 1e-6 && (features[2] - features[2].round()).abs() < 0.03, "{features:?}");
    }
    let pages = read_pages(&bytes).unwrap();
    let mut again = Vec::new();
    write_pages(&pages.draft(None), &WriteConfig::default(), &mut again).unwrap();
    let numbers = |all: &[(f32, Vec<f32>)]| all.iter().map(|(_, f)| f.clone()).collect::<Vec<_>>();
    assert_eq!(numbers(&of(&read(&again).unwrap())), numbers(&back), "what was in steps stays in them");
    // Without them the file is one of version 1.0.
    let plain = Draft { meta: Meta { features: Vec::new(), ..draft.meta.clone() }, ..draft };
    assert_eq!(Index::parse(&bytes_of(&plain, &WriteConfig::default()).0, None).unwrap().version, [1, 0]);
}

#[test]
fn features_that_do_not_fit_are_refused() {
    let mut draft = featured(60);
    draft.nodes[0].primitives[5].features = vec![1.0, f32::NAN, 0.0];
    let mut out = Vec::new();
    let error = write(&draft, &WriteConfig::default(), &mut out).unwrap_err().to_string();
    assert!(error.contains("Gaussian 5") && error.contains("3 numbers"), "{error}");
    draft.nodes[0].primitives[5].features = vec![1.0];
    assert!(write(&draft, &WriteConfig::default(), &mut out).is_err());
    assert!(survive(&bytes_of(&featured(60), &WriteConfig::default()).0));
    draft.meta.features = vec![[1.0, -1.0]];
    assert!(write(&draft, &WriteConfig::default(), &mut out).unwrap_err().to_string().contains("ranges"));
}
