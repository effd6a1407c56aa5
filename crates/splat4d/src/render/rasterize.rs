//! Rasterises sorted splats, a few channels at a time, and the backward pass.
//!
//! A bin of 32² pixels is one task: its splats are gathered once into records (`gather.rs`), which pass through
//! its tiles front to back (`blend.rs`). Any number of channels is any number of passes over the same projection.

use super::RenderConfig;
use super::bin::{BIN, Bins, Footprint, PAIR_BUDGET, id};
pub use super::blend::PixelGrads;
use super::blend::{Backward, Blend, Limits, Pair, Tile};
pub use super::gather::CHANNELS;
use super::gather::{Gather, Record, SIDE, TILE, TILES};
use super::parallel::{Even, Ragged, for_each_group};
use super::project::{Projected, ProjectedGrads};
use super::simd::{Simd, dispatch};
use crate::math::Real;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering};

/// Splats in a reduction task.
pub(super) const CHUNK: usize = 2048;

/// Treatment of the gradient to centre, conic and opacity by a pass backward.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Geometry {
    /// The first pass.
    Overwrite,
    /// A further pass over the same projection.
    Add,
}

/// One pass over the pixels: what is blended, and over which projection. One row a splat.
#[derive(Clone, Copy, Debug)]
pub struct Pass<'a, F = f32> {
    /// As they were prepared.
    pub projected: &'a [Projected<F>],
    /// As they were prepared.
    pub footprints: &'a [Footprint],
    /// Blended.
    pub channels: &'a [[F; CHANNELS]],
    /// Behind all splats; [`Raster::blend`] does not read it.
    pub background: [F; CHANNELS],
    /// Limits of the blend.
    pub config: &'a RenderConfig,
}

/// Gradients to a pass, one row a splat.
#[derive(Debug)]
pub struct PassGrads<'a, F = f32> {
    /// Whether `projected` is overwritten or added to.
    pub geometry: Geometry,
    /// To centre, conic and opacity.
    pub projected: &'a mut [ProjectedGrads<F>],
    /// To the channels; overwritten.
    pub channels: &'a mut [[F; CHANNELS]],
}

/// The rasteriser with all its memory.
#[derive(Debug, Default)]
pub struct Raster<F = f32> {
    /// Sorted lists.
    pub bins: Bins,
    /// Instead of [`PAIR_BUDGET`].
    pub(super) budget: Option<usize>,
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) simd: Option<Simd>,
    pub(super) records: Vec<Record<F>>,
    pub(super) tiles: Vec<Tile<F>>,
    pair_grads: Vec<Pair<F>>,
    /// Scores of pairs of bin and splat.
    pub(super) pair_scores: Vec<F>,
    pub(super) place: Vec<AtomicU32>,
    backgrounds: Vec<[f64; CHANNELS]>,
}

impl<F: Real> Raster<F> {
    /// Bins, sorts and gathers the splats of an image of `width` x `height`.
    pub fn prepare(
        &mut self,
        projected: &[Projected<F>],
        footprints: &[Footprint],
        width: usize,
        height: usize,
        simd: Simd,
    ) {
        (self.width, self.height, self.simd) = (width, height, Some(simd));
        self.bins.prepare(footprints, width, height, self.budget.unwrap_or(PAIR_BUDGET));
        self.tiles.resize(self.bins.bins() * TILES, Tile::default());
        self.gather(projected);
    }

    /// Ensures that lists and records are those of run `run`.
    pub(super) fn hold(&mut self, projected: &[Projected<F>], footprints: &[Footprint], run: usize) {
        if self.bins.current != run {
            self.bins.fill(footprints, run);
            self.gather(projected);
        }
    }

    /// Makes the records of the current run's lists.
    fn gather(&mut self, projected: &[Projected<F>]) {
        let (width, height, simd) = (self.width, self.height, self.simd.unwrap_or(Simd::Scalar));
        self.records.resize(self.bins.keys.len(), Record::default());
        let bins = &self.bins;
        for_each_group(&bins.starts, Ragged(&mut self.records), &|bin, records| {
            let (x0, y0) = (bin % bins.across * BIN, bin / bins.across * BIN);
            let keys = &bins.keys[bins.starts[bin] as usize..bins.starts[bin + 1] as usize];
            dispatch(simd, Gather { keys, projected, records: records.0, x0, y0, width, height });
        });
    }

    /// Blends the channels of a pass.
    pub fn blend(&mut self, pass: &Pass<'_, F>) {
        for run in 0..self.bins.runs.len() {
            self.hold(pass.projected, pass.footprints, run);
            self.blend_run(pass);
        }
    }

    /// [`Raster::blend`] of the bins of the current run.
    fn blend_run(&mut self, pass: &Pass<'_, F>) {
        let (simd, bins, limits) = (self.simd.unwrap_or(Simd::Scalar), &self.bins, Limits::new(pass.config));
        let channels = pass.channels;
        let (width, height) = (self.width, self.height);
        let data = (Ragged(&mut self.records), Even(&mut self.tiles, TILES));
        let run = &bins.runs[bins.current];
        for_each_group(&bins.starts, data, &|bin, (records, tiles)| {
            if !run.contains(&bin) {
                return;
            }
            let keys = &bins.keys[bins.starts[bin] as usize..bins.starts[bin + 1] as usize];
            for (r, key) in records.0.iter_mut().zip(keys) {
                r.channels = channels[id(*key)];
            }
            let inside = [width - bin % bins.across * BIN, height - bin / bins.across * BIN];
            dispatch(simd, Blend { records: &*records.0, tiles: tiles.0, inside, limits });
        });
    }

    /// Colours over `background`, Σ c α T + T_end·background, and alpha, 1 − T_end: planes [height, width].
    ///
    /// All at once, since reading the tiles takes longer than writing the planes.
    pub(crate) fn picture(&self, background: [F; CHANNELS], color: [&mut [F]; CHANNELS], alpha: &mut [F]) {
        let band = BIN * self.width.max(1);
        let [red, green, blue] = color.map(|plane| plane.par_chunks_mut(band));
        red.zip(green).zip(blue).zip(alpha.par_chunks_mut(band)).enumerate().for_each(
            |(band, (((red, green), blue), alpha))| {
                self.each_row(band, red.len(), |tile, row, pixels| {
                    for (c, plane) in [&mut *red, &mut *green, &mut *blue].into_iter().enumerate() {
                        let (sums, t) = (&tile.color[c][row.clone()], &tile.t[row.clone()]);
                        for (out, (sum, t)) in plane[pixels.clone()].iter_mut().zip(sums.iter().zip(t)) {
                            *out = *sum + t.abs() * background[c];
                        }
                    }
                    for (out, t) in alpha[pixels].iter_mut().zip(&tile.t[row]) {
                        *out = F::ONE - t.abs();
                    }
                });
            },
        );
    }

    /// Channel `c`, Σ c α T, [height, width].
    pub(crate) fn channel(&self, c: usize, plane: &mut [F]) {
        plane.par_chunks_mut(BIN * self.width.max(1)).enumerate().for_each(|(band, plane)| {
            self.each_row(band, plane.len(), |tile, row, pixels| {
                plane[pixels.clone()].copy_from_slice(&tile.color[c][row][..pixels.len()]);
            });
        });
    }

    /// Calls `f(tile, row of the tile, its pixels)` for all that is in one band of bins, which has `count` pixels; a
    /// row that the image's edge cuts has fewer pixels than the tile's.
    #[inline(always)]
    fn each_row(&self, band: usize, count: usize, mut f: impl FnMut(&Tile<F>, Range<usize>, Range<usize>)) {
        let (w, across) = (self.width, self.bins.across);
        for y in 0..count / w.max(1) {
            for x in (0..w).step_by(TILE) {
                let tile = (band * across + x / BIN) * TILES + y / TILE * SIDE + x / TILE % SIDE;
                let row = y % TILE * TILE;
                f(&self.tiles[tile], row..row + TILE, y * w + x..y * w + w.min(x + TILE));
            }
        }
    }

    /// VJP of the last [`Raster::blend`], which must have been of the same pass. Returns the gradient to the
    /// background.
    pub fn backward(
        &mut self,
        pass: &Pass<'_, F>,
        grads: &PixelGrads<'_, F>,
        d: &mut PassGrads<'_, F>,
    ) -> [f64; CHANNELS] {
        if d.geometry == Geometry::Overwrite {
            d.projected.par_chunks_mut(CHUNK).for_each(|d| d.fill(ProjectedGrads::default()));
        }
        d.channels.fill([F::ZERO; CHANNELS]);
        self.backgrounds.clear();
        self.backgrounds.resize(self.bins.bins(), [0.0; CHANNELS]);
        for run in 0..self.bins.runs.len() {
            self.hold(pass.projected, pass.footprints, run);
            self.backward_run(pass, grads);
            self.collect(pass, d);
        }
        let mut total = [0.0; CHANNELS];
        for bin in &self.backgrounds {
            for c in 0..CHANNELS {
                total[c] += bin[c];
            }
        }
        total
    }

    /// Gradients to the pairs of the current run.
    fn backward_run(&mut self, pass: &Pass<'_, F>, grads: &PixelGrads<'_, F>) {
        let (simd, bins, limits) = (self.simd.unwrap_or(Simd::Scalar), &self.bins, Limits::new(pass.config));
        let (footprints, channels, background, abs) =
            (pass.footprints, pass.channels, pass.background, pass.config.abs_grads);
        let (width, height, tiles) = (self.width, self.height, &self.tiles);
        let pairs = bins.keys.len();
        self.pair_grads.resize(pairs, Pair::default());
        self.place.resize_with(pairs, AtomicU32::default);
        let (place, run) = (&self.place, &bins.runs[bins.current]);
        let data = (Ragged(&mut self.records), (Ragged(&mut self.pair_grads), Even(&mut self.backgrounds, 1)));
        for_each_group(&bins.starts, data, &|bin, (records, (out, background_out))| {
            if !run.contains(&bin) {
                return;
            }
            let start = bins.starts[bin] as usize;
            let keys = &bins.keys[start..bins.starts[bin + 1] as usize];
            let (bx, by) = (bin % bins.across, bin / bins.across);
            for (i, (r, key)) in records.0.iter_mut().zip(keys).enumerate() {
                let splat = id(*key);
                r.channels = channels[splat];
                // Every slot is written by exactly one task, so that the order of writes cannot matter.
                let slot = bins.first[splat].wrapping_add(footprints[splat].rank(bx, by) as u32);
                place[slot as usize].store((start + i) as u32, Ordering::Relaxed);
            }
            out.0.fill(Pair::default());
            let kernel = Backward {
                records: &*records.0,
                tiles: &tiles[bin * TILES..(bin + 1) * TILES],
                grads,
                background,
                corner: [bx * BIN, by * BIN],
                size: [width, height],
                limits,
                abs,
                out: out.0,
            };
            background_out.0[0] = dispatch(simd, kernel);
        });
    }

    /// Adds each splat's pairs of the current run, in the order of its bins.
    fn collect(&self, pass: &Pass<'_, F>, d: &mut PassGrads<'_, F>) {
        let (place, bins, pair_grads) = (&self.place, &self.bins, &self.pair_grads);
        let (projected, footprints) = (pass.projected, pass.footprints);
        let rows = d.projected.par_chunks_mut(CHUNK).zip(d.channels.par_chunks_mut(CHUNK));
        rows.enumerate().for_each(|(chunk, (d, d_ch))| {
            for (i, (d, d_ch)) in d.iter_mut().zip(d_ch).enumerate() {
                let splat = chunk * CHUNK + i;
                let mut sum = Pair::default();
                for slot in &place[bins.slots(splat, &footprints[splat])] {
                    sum.add(&pair_grads[slot.load(Ordering::Relaxed) as usize]);
                }
                let p = &projected[splat];
                if p.radius > F::ZERO {
                    let (center, center_abs, conic) = (sum.center(p.conic), sum.center_abs(), sum.conic());
                    for k in 0..2 {
                        d.mean2d[k] += center[k];
                        d.mean2d_abs[k] += center_abs[k];
                    }
                    for k in 0..3 {
                        d.conic[k] += conic[k];
                    }
                    d.opacity += sum.log_alpha() / p.opacity;
                    for (d, sum) in d_ch.iter_mut().zip(sum.channels()) {
                        *d += sum;
                    }
                }
            }
        });
    }

    /// Pairs of bin and splat.
    pub(crate) fn pairs(&self) -> usize {
        self.bins.total as usize
    }

    /// Bytes held.
    pub(crate) fn memory_bytes(&self) -> usize {
        self.bins.memory_bytes()
            + self.records.capacity() * size_of::<Record<F>>()
            + 4 * self.place.capacity()
            + self.tiles.capacity() * size_of::<Tile<F>>()
            + self.pair_grads.capacity() * size_of::<Pair<F>>()
            + self.pair_scores.capacity() * size_of::<F>()
            + self.backgrounds.capacity() * size_of::<[f64; CHANNELS]>()
    }
}
