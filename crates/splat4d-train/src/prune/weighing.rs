//! How much of the views at one time every Gaussian of a scene is.

use splat4d::layers::{Instant, Scene};
use splat4d::render::{Antialias, RenderConfig, Renderer};
use splat4d::scene::{Camera, Time};

/// Σ α T by layer and row over the views at one time, all memory reused.
pub(super) struct Weighing {
    renderer: Renderer<f32>,
    instant: Instant<f32>,
    shares: Vec<f32>,
    layers: Vec<Vec<f64>>,
}

impl Weighing {
    pub(super) fn new(antialias: Antialias) -> Self {
        let renderer = Renderer::new(RenderConfig { antialias, ..RenderConfig::default() });
        Self { renderer, instant: Instant::default(), shares: Vec::new(), layers: Vec::new() }
    }

    /// On to another time; nothing has been seen at it.
    pub(super) fn at(&mut self, scene: &Scene<f32>, t: Time) {
        scene.at(t, &mut self.instant);
        self.layers.resize_with(scene.layers.len(), Vec::new);
        for (layer, sums) in scene.layers.iter().zip(&mut self.layers) {
            sums.clear();
            sums.resize(layer.params.len(), 0.0);
        }
    }

    /// Adds one view at that time.
    pub(super) fn add(&mut self, scene: &Scene<f32>, camera: &Camera) {
        self.renderer.weigh(&scene.splats(&self.instant), camera, &mut self.shares);
        let mut first = 0;
        for (tape, sums) in self.instant.tapes.iter().zip(&mut self.layers) {
            let (rows, count) = (tape.rows(), tape.out().rows());
            for (j, &share) in self.shares[first..first + count].iter().enumerate() {
                sums[rows.id(j)] += f64::from(share);
            }
            first += count;
        }
    }

    /// Σ α T of every row of a layer, in pixels; 0: it was not seen.
    pub(super) fn layer(&self, layer: usize) -> &[f64] {
        &self.layers[layer]
    }
}
