//! Two layers with different models, both densified under one cap over all layers.

use super::*;
use crate::maintenance::{Adc, AdcSettings, Every, Mcmc, McmcSettings, MortonOrder};
use crate::optim::Noise;

/// A function that adds a strategy to a stage.
pub(super) type Strategy = fn(&mut Stage, Every);

/// Both strategies, eager enough for thirty steps.
pub(super) const STRATEGIES: [(&str, Strategy); 2] = [("adc", adc), ("mcmc", mcmc)];

fn adc(stage: &mut Stage, steps: Every) {
    let settings =
        AdcSettings { grad_threshold: 1e-6, percent_dense: 0.04, retime_clones: false, ..AdcSettings::default() };
    stage.keep(Adc { settings, steps });
    stage.keep(MortonOrder { densification: steps });
}

fn mcmc(stage: &mut Stage, steps: Every) {
    stage.keep(Mcmc { settings: McmcSettings { growth: 1.1, ..McmcSettings::default() }, gradient_share: 0.5, steps });
    stage.keep(MortonOrder { densification: steps });
    stage.noise = Some(Noise { strength: 1.0, until: steps.last });
}

fn two_layers<F: Real>(rows: usize) -> Scene<F> {
    let still = build_as(&Spec::Still, &mut Params::<F>::new(0, 1, &[])).unwrap();
    let mut scene = one_layer(cloud(rows, LifeKind::Infinite, 31), still, LifeKind::Infinite);
    scene.layers.extend(scan::scan_scene::<F>(rows).layers);
    let (lobes, _) = lobes::lobes_scene(rows);
    scene.layers.extend(lobes.layers);
    scene
}

#[test]
fn gradients_through_layers_of_different_models() {
    let shots = shots(&[(0, 0.05), (1, 0.15)]);
    let reached = check_gradients(&two_layers(5), &shots, &Vec::new());
    assert_reached(&reached[0], &["geometry", "sh"]);
    assert_reached(&reached[1], &["geometry", "sh", "life", "controls", "decay"]);
    assert_reached(&reached[2], &["geometry", "sh", "factor", "lobe"]);
}

#[test]
fn every_layer_is_densified_under_one_cap() {
    const CAP: usize = 170;
    let columns: Vec<(usize, &str, f64)> = (0..3)
        .flat_map(|layer| ORDINARY.iter().map(move |&(c, rate)| (layer, c, rate)))
        .chain([(1, "controls", 0.01), (1, "decay", 0.01), (2, "factor", 0.02), (2, "lobe", 0.01)])
        .collect();
    for (name, densify) in STRATEGIES {
        let groups =
            columns.iter().map(|&(layer, c, rate)| Group { layer, ..Group::new(c, Rate::constant(rate)) }).collect();
        let mut stage = Stage { batch: 12, groups, ..Stage::new("layers", 30) };
        densify(&mut stage, Every { first: 4, last: 24, interval: 4 });
        let mut t = trainer(two_layers(40), vec![stage], CAP);
        let (mut losses, mut largest) = (Vec::new(), [40; 3]);
        while !t.is_done() {
            losses.push(t.step().unwrap().expect("no fault").report.loss);
            assert!(t.scene().len() <= CAP, "{name}: {} Gaussians", t.scene().len());
            for (layer, most) in t.scene().layers.iter().zip(&mut largest) {
                *most = layer.params.len().max(*most);
            }
            for (layer, moments) in t.scene().layers.iter().zip(t.train_state.moments()) {
                let n = layer.params.len();
                let ok = layer.params.keys().all(|k| layer.params[k].rows() == n && moments.table(k).rows() == n);
                assert!(ok, "{name}: tables of a layer have one length");
            }
        }
        assert_falls(&losses, 0.85, name);
        assert!(largest.iter().all(|&n| n > 40), "{name}: every layer grows, {largest:?}");
        assert_eq!(t.scene().len(), CAP, "{name}: the cap is reached");
    }
}
