//! One row edit moves Gaussians, a model's per-Gaussian parameters, pages, moments and statistics alike: random edits
//! on tables in which every number encodes its row and column.

use super::*;
use crate::optim::Moments;
use crate::train_state::{Stats, TrainState};
use splat4d::scene::{Born, RowEdit};

/// A number that names its row and column exactly in f32.
fn tag(row: u32, col: usize) -> f32 {
    (row * 64 + col as u32) as f32
}

fn fill(table: &mut Table<f32>) {
    for r in 0..table.rows() {
        (0..table.width()).for_each(|c| table.set(r, c, tag(r as u32, c)));
    }
}

/// A scene of two layers in which one has nodes and pages; every table tagged.
fn tagged(rows: usize) -> (Scene<f32>, Vec<Moments<f32>>, Stats) {
    let mut p = cloud::<f32>(rows, LifeKind::GaussHalf, 1);
    let spec = Spec::Spacetime(SpacetimeSpec { order: 2, rotation: true, ..SpacetimeSpec::default() });
    let motion = build_as(&spec, &mut p).unwrap();
    p.entry("weights", Space::Fixed, &[("weights", 1)], 21, |_| {}).unwrap();
    p.entry("nodes", Space::Nodes, &[("node_centers", 3)], 19, |_| {}).unwrap();
    for frame in 0..3 {
        p.page("offsets", frame, Space::Gaussians, &[("offsets", 3)], rows, |_| {}).unwrap();
        p.page("poses", frame, Space::Nodes, &[("shift", 3), ("turn", 4)], 19, |_| {}).unwrap();
    }
    let mut scene = one_layer(p, motion, LifeKind::GaussHalf);
    scene.layers.extend(scene.layers.clone());
    let mut moments: Vec<_> = scene.layers.iter().map(|l| Moments::new(&l.params)).collect();
    for (layer, moments) in scene.layers.iter_mut().zip(&mut moments) {
        for key in layer.params.keys().collect::<Vec<_>>() {
            fill(&mut layer.params[key]);
            fill(moments.table_mut(key));
        }
    }
    let mut stats = Stats::new(&scene);
    stats.tables.iter_mut().for_each(fill);
    (scene, moments, stats)
}

/// A random edit of `rows` rows: one of clone, split, merge, relocate, prune, sort, or all of them at once.
fn random_edit(space: Space, rows: usize, rng: Rng) -> RowEdit {
    let mut edit = RowEdit::identity(space, rows);
    let any = |i: u64| rng.fork(1).below(i, rows) as u32;
    let kind = rng.below(0, 7);
    if kind == 0 || kind == 6 {
        (0..5).for_each(|i| edit.push(any(i), Born::Clone));
    }
    if kind == 1 || kind == 6 {
        for i in 5..9 {
            let parent = any(i);
            edit.born[parent as usize] = Born::Split;
            edit.push(parent, Born::Split);
        }
    }
    if kind == 2 || kind == 6 {
        for i in 10..14 {
            edit.parent[any(i) as usize] = any(i + 20);
            edit.born[any(i) as usize] = Born::Moved;
        }
        // Wherever a row does not continue itself it has moved.
        for j in 0..rows {
            if edit.parent[j] != j as u32 {
                edit.born[j] = Born::Moved;
            }
        }
    }
    let mut order: Vec<u32> = (0..edit.len() as u32).collect();
    if kind == 3 || kind == 6 {
        // A merge keeps a copy of one parent and drops both: two rows fewer, one moved row more.
        for i in 0..3 {
            let (a, b) = (order.swap_remove(rng.fork(2).below(2 * i, order.len())), rng.fork(2).below(2 * i + 1, 9));
            edit.born[a as usize] = Born::Moved;
            order.remove(b);
            order.push(a);
        }
    }
    if kind == 4 || kind == 6 {
        order.retain(|&j| rng.fork(3).uniform(u64::from(j)) > 0.3);
    }
    if kind == 5 || kind == 6 {
        let by = rng.fork(4).permutation(order.len());
        order = by.into_iter().map(|i| order[i as usize]).collect();
    }
    RowEdit {
        space,
        parent: order.iter().map(|&j| edit.parent[j as usize]).collect(),
        born: order.iter().map(|&j| edit.born[j as usize]).collect(),
    }
}

/// Whether row `row` of the table holds the tags of old row `from` (`None`: zeros).
fn holds(table: &Table<f32>, row: usize, from: Option<u32>) -> bool {
    (0..table.width()).all(|c| table.get(row, c) == from.map_or(0.0, |f| tag(f, c)))
}

#[test]
fn one_edit_moves_every_table_alike() {
    for round in 0..60 {
        let rng = Rng::new(17, "edits", round);
        let rows = 20 + rng.below(50, 40);
        let (scene, moments, stats) = tagged(rows);
        let mut train_state = TrainState::resumed(scene, moments, stats);
        // Several edits in a row, Gaussians and nodes in turn: where every row came from, and whether it is as old.
        let mut origin: Vec<Vec<(u32, bool)>> = [rows, 19].map(|n| (0..n as u32).map(|r| (r, true)).collect()).to_vec();
        for turn in 0..4 {
            let which = turn % 2;
            let space = [Space::Gaussians, Space::Nodes][which];
            let edit = random_edit(space, origin[which].len(), rng.fork(turn as u64));
            if edit.len() < 14 {
                continue;
            }
            train_state.apply(0, &edit, &rng);
            origin[which] = edit
                .parent
                .iter()
                .zip(&edit.born)
                .map(|(&p, &b)| (origin[which][p as usize].0, b == Born::Kept && origin[which][p as usize].1))
                .collect();
        }
        let (scene, moments, stats) = (train_state.scene(), train_state.moments(), train_state.stats());
        let layer = &scene.layers[0];
        for key in layer.params.keys() {
            let info = layer.params.info(key);
            let (table, moment) = (&layer.params[key], moments[0].table(key));
            let Some(which) = [Space::Gaussians, Space::Nodes].iter().position(|s| *s == info.space) else {
                assert!((0..21).all(|r| holds(table, r, Some(r as u32)) && holds(moment, r, Some(r as u32))));
                continue;
            };
            let origin = &origin[which];
            assert_eq!((table.rows(), moment.rows()), (origin.len(), origin.len()), "{}", info.name);
            for (row, &(from, kept)) in origin.iter().enumerate() {
                assert!(holds(table, row, Some(from)), "round {round}: `{}` row {row} is not {from}", info.name);
                assert!(holds(moment, row, kept.then_some(from)), "round {round}: moments of `{}` {row}", info.name);
            }
        }
        assert_eq!(stats.tables[0].rows(), origin[0].len());
        let counted = |(row, &(from, kept)): (usize, &(u32, bool))| holds(&stats.tables[0], row, kept.then_some(from));
        assert!(origin[0].iter().enumerate().all(counted), "round {round}: statistics");
        let (fresh, fresh_moments, fresh_stats) = tagged(rows);
        assert_eq!(scene.layers[1].params, fresh.layers[1].params, "the other layer rests");
        assert_eq!((&moments[1], &stats.tables[1]), (&fresh_moments[1], &fresh_stats.tables[1]));
    }
}
