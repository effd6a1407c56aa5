//! Contributions of all Gaussians of a scene to the views at one time.

use super::temporal::Spatial;
use splat4d::layers::{Evaluation, Scene};
use splat4d::render::{Antialias, Importance, RenderConfig, Sensitivity, Shot};
use splat4d::scene::splats::SPLAT_OPACITY;
use splat4d::scene::{Camera, Time};

/// Pivots of a Fisher block, over its own diagonal, are not distinguished from 0 below this: sums are made in f32.
const LEAST_PIVOT: f64 = 1e-6;

/// A number by layer and row, summed over the views at one time; all memory is reused.
pub(super) struct Weighing {
    spatial: Spatial,
    importance: Importance,
    instant: Evaluation<f32>,
    shares: Vec<f32>,
    changes: Vec<f32>,
    layers: Vec<Vec<f64>>,
    pixels: Vec<Vec<f64>>,
    sensitivities: Vec<Sensitivity>,
    /// Fisher blocks by layer and row, over all times.
    blocks: Vec<Vec<[f64; 21]>>,
}

impl Weighing {
    pub(super) fn new(spatial: Spatial, antialias: Antialias) -> Self {
        let importance = Importance::new(RenderConfig { antialias, ..RenderConfig::default() });
        Self {
            spatial,
            importance,
            instant: Evaluation::default(),
            shares: Vec::new(),
            changes: Vec::new(),
            layers: Vec::new(),
            pixels: Vec::new(),
            sensitivities: Vec::new(),
            blocks: Vec::new(),
        }
    }

    /// On to another time; nothing has been seen at it.
    pub(super) fn at(&mut self, scene: &Scene<f32>, t: Time) {
        scene.at(t, &mut self.instant);
        if self.spatial == Spatial::Pup && self.blocks.is_empty() {
            self.blocks = scene.layers.iter().map(|l| vec![[0.0; 21]; l.params.len()]).collect();
        }
        for tables in [&mut self.layers, &mut self.pixels] {
            tables.resize_with(scene.layers.len(), Vec::new);
            for (layer, sums) in scene.layers.iter().zip(tables) {
                sums.clear();
                sums.resize(layer.params.len(), 0.0);
            }
        }
    }

    /// Adds one view at that time.
    pub(super) fn add(&mut self, scene: &Scene<f32>, camera: &Camera) {
        let splats = scene.splats(&self.instant);
        let shot = Shot::new(&splats, camera, scene.background);
        match self.spatial {
            Spatial::Share | Spatial::LightGaussian | Spatial::Opacity => {
                self.importance.contributions(&splats, camera, &mut self.shares);
            }
            Spatial::Pup | Spatial::Speedy => {
                self.importance.sensitivities(&shot, &mut self.sensitivities);
                self.shares.clear();
                self.shares.extend(self.sensitivities.iter().map(|s| s.squared as f32));
            }
            Spatial::Change => self.importance.removals(&shot, &mut self.shares),
            Spatial::Both => {
                self.importance.removals(&shot, &mut self.changes);
                self.importance.last_contributions(&mut self.shares);
                for (share, change) in self.shares.iter_mut().zip(&self.changes) {
                    *share = (*share * *change).sqrt();
                }
            }
        }
        let size = [camera.width, camera.height];
        let mut first = 0;
        let tapes = self.instant.tapes().zip(&mut self.layers).zip(&mut self.pixels);
        for (layer, ((tape, sums), pixels)) in tapes.enumerate() {
            let (rows, count) = (tape.rows(), tape.out().rows());
            let projected = &self.importance.projected()[first..first + count];
            let seen =
                self.shares[first..first + count].iter().zip(projected).enumerate().filter(|(_, (s, _))| **s > 0.0);
            for (j, (&share, projected)) in seen {
                match self.spatial {
                    // How opaque it is does not depend on the number of views.
                    Spatial::Opacity => sums[rows.id(j)] = f64::from(tape.out().get(j, SPLAT_OPACITY)),
                    _ => sums[rows.id(j)] += f64::from(share),
                }
                if let Some(blocks) = self.blocks.get_mut(layer) {
                    let fisher = &self.sensitivities[first + j].fisher;
                    blocks[rows.id(j)].iter_mut().zip(fisher).for_each(|(sum, x)| *sum += x);
                }
                pixels[rows.id(j)] += projected.pixels(size);
            }
            first += count;
        }
    }

    /// If the score is one of all views together: the importance of every row of a layer.
    pub(super) fn whole(&self, layer: usize) -> Option<Vec<f64>> {
        Some(self.blocks.get(layer)?.iter().map(root_of_determinant).collect())
    }

    /// Pixels that every row of a layer touches, in the views that show it.
    pub(super) fn pixels(&self, layer: usize) -> &[f64] {
        &self.pixels[layer]
    }

    /// The sum of every row of a layer; 0: it was not seen.
    pub(super) fn layer(&self, layer: usize) -> &[f64] {
        &self.layers[layer]
    }
}

/// det^(1/6) of a symmetric 6x6 block (upper triangle, row by row); 0 where it is not of full rank.
pub(super) fn root_of_determinant(upper: &[f64; 21]) -> f64 {
    let mut m = [[0.0; 6]; 6];
    let mut at = 0;
    for i in 0..6 {
        for j in i..6 {
            (m[i][j], m[j][i]) = (upper[at], upper[at]);
            at += 1;
        }
    }
    let diagonal: [f64; 6] = std::array::from_fn(|i| m[i][i]);
    if !diagonal.iter().all(|d| *d > 0.0 && d.is_finite()) {
        return 0.0;
    }
    // Divided by its own diagonal the block is unitless, and its pivots are between 0 and 1.
    for (i, row) in m.iter_mut().enumerate() {
        for (j, x) in row.iter_mut().enumerate() {
            *x /= diagonal[i].sqrt() * diagonal[j].sqrt();
        }
    }
    let mut log = diagonal.iter().map(|d| d.ln()).sum::<f64>();
    for k in 0..6 {
        let pivot = m[k][k];
        if pivot.is_nan() || pivot <= LEAST_PIVOT {
            return 0.0;
        }
        log += pivot.ln();
        for i in k + 1..6 {
            for j in k + 1..6 {
                m[i][j] -= m[i][k] * m[k][j] / pivot;
            }
        }
    }
    (log / 6.0).exp()
}
