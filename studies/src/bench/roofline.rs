//! The machine's roofline, and the work that a stage cannot do without.
//!
//! A stage's floor is the time in which its compulsory work is done at the roofline: pairs of pixel and Gaussian at the
//! speed of the blend's arithmetic alone, bytes at the speed of memory. Bytes are those that a stage must read and
//! write once if it starts and ends in memory; small scenes stay in the caches, and may beat it.

use splat4d::layers::{Layer, Scene};
use splat4d::render::roofline;
use splat4d::render::{Simd, bin::Footprint};
use splat4d::scene::Splats;

/// Peak throughput of a number of threads.
#[derive(Clone, Copy, Debug)]
pub(super) struct Roofline {
    /// Pairs of pixel and Gaussian a second, all threads together.
    pub pairs: f64,
    /// Bytes per second.
    pub bytes: f64,
}

impl Roofline {
    /// Measured on every thread of the pool at once, as the stages run.
    pub(super) fn measure(pool: &rayon::ThreadPool, simd: Simd) -> Self {
        Self { pairs: pool.broadcast(|_| roofline::blend(simd)).iter().sum(), bytes: pool.install(roofline::bandwidth) }
    }
}

/// Compulsory bytes.
pub(super) mod bytes {
    use super::{Footprint, Layer, Scene, Splats};
    use splat4d::render::rasterize::CHANNELS;
    use splat4d::render::{Projected, ProjectedGrads};
    use splat4d::scene::{Color, SH, Space};

    const NUMBER: usize = size_of::<f32>();
    /// Mean, covariance, opacity.
    const SPLAT: usize = 10 * NUMBER;
    /// Red, green, blue.
    const COLOR: usize = CHANNELS * NUMBER;
    /// A key and a record of the blend loop.
    const PAIR: usize = 8 + 64;

    /// Columns of a layer's tables by Gaussian, without its colours.
    fn columns(layer: &Layer) -> usize {
        let by_row = |k: &splat4d::scene::Key| *k != SH && layer.params.info(*k).space == Space::Gaussians;
        layer.params.keys().filter(by_row).map(|k| layer.params[k].width()).sum()
    }

    /// All columns of a layer's tables by Gaussian.
    fn all_columns(layer: &Layer) -> usize {
        columns(layer) + layer.params[SH].width()
    }

    fn sh_width(splats: &Splats<'_, f32>) -> usize {
        let width = |c: &Color<'_, f32>| match c {
            Color::Sh { table, .. } | Color::Direct { table } => table.width(),
        };
        splats.parts.iter().map(|p| width(&p.color)).max().unwrap_or(0)
    }

    /// Parameters in, splats out.
    pub(crate) fn motion(scene: &Scene<f32>, splats: usize) -> usize {
        let widest = scene.layers.iter().map(columns).max().unwrap_or(0);
        splats * (widest * NUMBER + SPLAT)
    }

    /// Splats in, ellipses and footprints out.
    pub(crate) fn project(splats: usize) -> usize {
        splats * (SPLAT + size_of::<Projected>() + size_of::<Footprint>())
    }

    /// Coefficients of what is visible in, colours out.
    pub(crate) fn shade(splats: &Splats<'_, f32>, visible: usize) -> usize {
        visible * (sh_width(splats) * NUMBER + COLOR)
    }

    /// A key and a record out for every pair of bin and splat.
    pub(crate) fn bin(pairs: usize) -> usize {
        pairs * PAIR
    }

    /// Ellipses and their gradients in, splats' gradients out; coefficients in, and added to their gradients.
    pub(crate) fn splats_backward(splats: &Splats<'_, f32>, visible: usize) -> usize {
        let each = size_of::<Projected>() + size_of::<ProjectedGrads>() + COLOR + 2 * SPLAT;
        splats.len() * each + visible * 3 * sh_width(splats) * NUMBER
    }

    /// Image and truth in, gradient out.
    pub(crate) fn loss(pixels: usize) -> usize {
        pixels * 9 * NUMBER
    }

    /// Splats' gradients and parameters in, parameters' gradients added.
    pub(crate) fn motion_backward(scene: &Scene<f32>, splats: usize) -> usize {
        let widest = scene.layers.iter().map(columns).max().unwrap_or(0);
        splats * (SPLAT + 3 * widest * NUMBER)
    }

    /// Gradients in, and zeros out for the next step; parameters and two moments in and out.
    pub(crate) fn adam(scene: &Scene<f32>, splats: usize) -> usize {
        let widest = scene.layers.iter().map(all_columns).max().unwrap_or(0);
        splats * 8 * widest * NUMBER
    }
}
