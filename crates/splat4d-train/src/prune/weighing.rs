//! How much of the views at one time every Gaussian of a scene is.

use super::temporal::Spatial;
use splat4d::layers::{Instant, Scene};
use splat4d::render::{Antialias, RenderConfig, Renderer};
use splat4d::scene::{Camera, Time};

/// A number by layer and row, summed over the views at one time; all memory is reused.
pub(super) struct Weighing {
    spatial: Spatial,
    renderer: Renderer<f32>,
    instant: Instant<f32>,
    shares: Vec<f32>,
    changes: Vec<f32>,
    layers: Vec<Vec<f64>>,
    pixels: Vec<Vec<f64>>,
}

impl Weighing {
    pub(super) fn new(spatial: Spatial, antialias: Antialias) -> Self {
        let renderer = Renderer::new(RenderConfig { antialias, ..RenderConfig::default() });
        Self {
            spatial,
            renderer,
            instant: Instant::default(),
            shares: Vec::new(),
            changes: Vec::new(),
            layers: Vec::new(),
            pixels: Vec::new(),
        }
    }

    /// On to another time; nothing has been seen at it.
    pub(super) fn at(&mut self, scene: &Scene<f32>, t: Time) {
        scene.at(t, &mut self.instant);
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
        match self.spatial {
            Spatial::Share => self.renderer.weigh(&splats, camera, &mut self.shares),
            Spatial::Change => self.renderer.removals(&splats, camera, scene.background, &mut self.shares),
            Spatial::Both => {
                self.renderer.removals(&splats, camera, scene.background, &mut self.changes);
                self.renderer.contributions(&mut self.shares);
                for (share, change) in self.shares.iter_mut().zip(&self.changes) {
                    *share = (*share * *change).sqrt();
                }
            }
        }
        let size = [camera.width, camera.height];
        let mut first = 0;
        for ((tape, sums), pixels) in self.instant.tapes.iter().zip(&mut self.layers).zip(&mut self.pixels) {
            let (rows, count) = (tape.rows(), tape.out().rows());
            let projected = &self.renderer.projected()[first..first + count];
            let seen =
                self.shares[first..first + count].iter().zip(projected).enumerate().filter(|(_, (s, _))| **s > 0.0);
            for (j, (&share, projected)) in seen {
                sums[rows.id(j)] += f64::from(share);
                pixels[rows.id(j)] += projected.pixels(size);
            }
            first += count;
        }
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
