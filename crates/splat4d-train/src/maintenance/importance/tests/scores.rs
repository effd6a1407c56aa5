//! Every spatial score, whatever it is made of.

use super::super::weighing::root_of_determinant;
use super::*;
use splat4d::render::{Sensitivity, Shot};

fn of(spatial: Spatial) -> ScoreConfig {
    ScoreConfig { spatial, temporal: Temporal::None, volume: false, ..ScoreConfig::default() }
}

#[test]
fn every_score_is_a_setting_of_the_recipe() {
    let names: Vec<&str> = Spatial::ALL.iter().map(|s| s.name()).collect();
    assert_eq!(names, <Spatial as crate::settings::Value>::choices());
}

#[test]
fn every_score_is_finite_ranks_visible_first_and_ignores_threads() {
    let (mut s, made) = (scene(120), made());
    // One behind every camera's back and one that is transparent.
    s.layers[1].params[GEOMETRY].write(0, 0, [1e4, 0.0, 0.0]);
    s.layers[1].params[GEOMETRY].set(1, OPACITY, -20.0);
    let pool = |threads: usize| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let mut orders = Vec::new();
    for &spatial in Spatial::ALL {
        let config = ScoreConfig { every: 3, ..of(spatial) };
        let one = pool(1).install(|| scored(&s, &made, &config));
        assert_eq!(one, pool(3).install(|| scored(&s, &made, &config)), "{spatial}");
        assert!(one.layers.iter().flatten().all(|x| x.is_finite() && *x >= 0.0), "{spatial}");
        assert!(one.layers[1][0] == 0.0 && one.layers[1][1] == 0.0, "{spatial}");
        assert!(one.layers[1].iter().filter(|x| **x > 0.0).count() > 20, "{spatial}");
        assert_eq!(spatial.name().parse::<Spatial>().unwrap(), spatial);
        let mut order: Vec<usize> = (0..one.layers[1].len()).collect();
        order.sort_by(|&a, &b| one.layers[1][a].total_cmp(&one.layers[1][b]));
        orders.push(order);
    }
    for a in 0..orders.len() {
        for b in 0..a {
            assert_ne!(orders[a], orders[b], "{} {}", Spatial::ALL[a], Spatial::ALL[b]);
        }
    }
}

/// The determinant by cofactors.
fn determinant(m: &[Vec<f64>]) -> f64 {
    if m.is_empty() {
        return 1.0;
    }
    let minor = |k: usize| -> Vec<Vec<f64>> {
        m[1..].iter().map(|row| row.iter().enumerate().filter(|(j, _)| *j != k).map(|(_, x)| *x).collect()).collect()
    };
    (0..m.len()).map(|k| if k % 2 == 0 { m[0][k] } else { -m[0][k] } * determinant(&minor(k))).sum()
}

#[test]
fn pup_is_the_determinant_of_the_blocks_of_all_views_and_speedy_their_sum() {
    let (mut s, made) = (scene(20), made());
    // Infinite lives: all times look at the same Gaussians.
    s.layers.remove(0);
    let (pup, speedy) = (scored(&s, &made, &of(Spatial::Pup)), scored(&s, &made, &of(Spatial::Speedy)));
    let rows = s.layers[0].params.len();
    let (mut blocks, mut sums) = (vec![[0.0; 21]; rows], vec![0.0; rows]);
    let (mut instant, mut found) = (Evaluation::default(), Vec::<Sensitivity>::new());
    let mut renderer = Renderer::new(RenderConfig::default());
    for i in 0..made.len() {
        s.at(made.time(i), &mut instant);
        let splats = s.splats(&instant);
        renderer.sensitivities(&Shot::new(&splats, made.camera(i), s.background), &mut found);
        for (row, x) in found.iter().enumerate() {
            (0..21).for_each(|k| blocks[row][k] += x.fisher[k]);
            sums[row] += x.squared;
        }
    }
    let mut full = 0;
    for row in 0..rows {
        assert!((speedy.layers[0][row] - sums[row]).abs() <= 1e-5 * sums[row], "{row}");
        let mut m = vec![vec![0.0; 6]; 6];
        let mut at = 0;
        for i in 0..6 {
            for j in i..6 {
                (m[i][j], m[j][i]) = (blocks[row][at], blocks[row][at]);
                at += 1;
            }
        }
        let (expected, got) = (determinant(&m), pup.layers[0][row]);
        if got > 0.0 {
            assert!((got.powi(6) / expected - 1.0).abs() < 1e-3, "{row}: {} {expected}", got.powi(6));
            full += 1;
        }
    }
    assert!(full > rows / 2, "{full} of {rows} blocks are of full rank");
}

#[test]
fn a_block_without_full_rank_has_zero_importance() {
    let mut identity = [0.0; 21];
    [0, 6, 11, 15, 18, 20].iter().for_each(|&k| identity[k] = 4.0);
    assert!((root_of_determinant(&identity) - 4.0).abs() < 1e-12);
    // Two rows that say the same.
    let mut flat = identity;
    flat[1] = 4.0;
    assert_eq!(root_of_determinant(&flat), 0.0);
    assert_eq!(root_of_determinant(&[0.0; 21]), 0.0);
    assert_eq!(root_of_determinant(&[f64::NAN; 21]), 0.0);
}
