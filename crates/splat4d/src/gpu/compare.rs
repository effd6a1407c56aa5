//! A picture that never leaves the GPU: drawn, compared with its truth and taken back in one submission.

use super::back::{Came, End};
use super::buffers::UNIFORM_STRIDE;
use super::clock::Recorder;
use super::frame::{Back, Band, Frame, Groups, RECORD_BYTES, THREADS, TILE, count, slot};
use super::pictures::Held;
use super::resident::{KeptPass, words_of};
use super::{GpuRenderer, GpuStats, GpuTimings, MOST_GROUPS, PLANES, largest_binding, plane_bytes};
use crate::Result;
use crate::render::{Comparison, RenderGrads, Shot, Target};
use crate::scene::Table;
use std::time::Instant;

/// Numbers that a tile adds to the loss (loss.wgsl).
pub(super) const PARTIALS: usize = 16;
/// First of those of the camera's colour matrix.
const RESPONSE: usize = 4;
/// Colours of a pixel.
const CHANNELS: usize = 3;
/// Planes of derivatives a colour.
const MAPS: usize = 3;
/// Bit of `Loss::flags`.
const FLAG_RESPONSE: u32 = 4;
/// Taps of the window, and its standard deviation in pixels (Wang 2004; 3DGS `loss_utils`).
const TAPS: usize = 11;
const SIGMA: f64 = 1.5;

/// `struct Loss` of loss.wgsl.
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Loss {
    width: u32,
    height: u32,
    flags: u32,
    d_l1: f32,
    d_ssim: f32,
    unused: [f32; 3],
    taps: [f32; 12],
    response: [[f32; 4]; 3],
}

/// The normalised window, and a number that fills its last vector.
fn window() -> [f32; 12] {
    let bell = |i: usize| (-(i as f64 - (TAPS / 2) as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp();
    let sum: f64 = (0..TAPS).map(bell).sum();
    std::array::from_fn(|i| if i < TAPS { (bell(i) / sum) as f32 } else { 0.0 })
}

impl Loss {
    fn new(target: &Target<'_, f32>, held: &Held) -> Self {
        let total = held.weight * CHANNELS as f64;
        let row = |c: usize| target.response.map_or([0.0; 4], |r| [r[3 * c], r[3 * c + 1], r[3 * c + 2], r[9 + c]]);
        Self {
            width: target.truth.width as u32,
            height: target.truth.height as u32,
            flags: held.flags | if target.response.is_some() { FLAG_RESPONSE } else { 0 },
            d_l1: ((1.0 - target.dssim) / total) as f32,
            d_ssim: (-target.dssim / total) as f32,
            unused: [0.0; 3],
            taps: window(),
            response: std::array::from_fn(row),
        }
    }
}

impl GpuRenderer {
    /// Whether a picture of so many splats can be compared at all: it is drawn in one piece.
    fn can_compare(&self, splats: usize, [w, h]: [usize; 2]) -> bool {
        let room = largest_binding(&self.gpu) - 4 * UNIFORM_STRIDE;
        let whole = Band { first: 0, rows: h.div_ceil(TILE) };
        let bytes = plane_bytes(whole, w).max((4 * CHANNELS * MAPS * w * h) as u64);
        let groups = splats.div_ceil(THREADS).max(w.div_ceil(TILE)).max(whole.rows);
        splats > 0 && w > 0 && h > 0 && bytes <= room && groups <= MOST_GROUPS
    }

    /// [`Backend::compare`](crate::render::Backend::compare).
    pub(super) fn compare_here(
        &mut self,
        shot: &Shot<'_, f32>,
        target: &Target<'_, f32>,
        d_sh: &mut [Option<&mut Table<f32>>],
        d: &mut RenderGrads<f32>,
    ) -> Result<Option<Comparison>> {
        let start = Instant::now();
        if self.can_compare(shot.splats.len(), [shot.camera.width, shot.camera.height]) {
            self.upload.send(&self.gpu, shot.splats, self.tables)?;
        }
        let upload = start.elapsed();
        let Some((came, comparison)) = self.compare_with(shot, target, shot.splats.len(), None)? else {
            return Ok(None);
        };
        self.deliver(shot, &came, d_sh, d)?;
        self.timings.upload += upload.as_secs_f64() * 1e3;
        self.timings.total = start.elapsed().as_secs_f64() * 1e3;
        Ok(Some(comparison))
    }

    /// Draws the `n` splats whose tables are on the GPU, compares and goes back; with `kept` they are made of tables that stay,
    /// which learn of it. `None` if that cannot be: no number that stays was changed but statistics.
    pub(super) fn compare_with(
        &mut self,
        shot: &Shot<'_, f32>,
        target: &Target<'_, f32>,
        n: usize,
        kept: Option<&KeptPass<'_>>,
    ) -> Result<Option<(Came, Comparison)>> {
        let size = [shot.camera.width, shot.camera.height];
        let shape = [target.truth.channels, target.truth.width, target.truth.height];
        assert_eq!(shape, [CHANNELS, size[0], size[1]], "a picture and its truth have one shape");
        if !self.can_compare(n, size) {
            return Ok(None);
        }
        self.timings = GpuTimings::default();
        self.stats = GpuStats { splats: n, bands: 1, ..GpuStats::default() };
        self.for_training()?;
        self.pictures.hold(&self.gpu, target)?;
        let held = self.pictures.get(target.picture);
        if held.weight <= 0.0 {
            return Ok(None);
        }
        let (loss, total) = (Loss::new(target, held), held.weight * CHANNELS as f64);
        let band = Band { first: 0, rows: size[1].div_ceil(TILE) };
        let across = size[0].div_ceil(TILE);
        // The words of Adam lie behind what the tiles give.
        let partials = PARTIALS * across * band.rows;
        let words = kept.map_or(0, |k| k.words());
        let words_at = partials.next_multiple_of(UNIFORM_STRIDE as usize / 4);
        let mut fresh = self.make_room_for_splats(n)?;
        fresh |= self.make_room_for_band(band, across, size[0])?;
        fresh |= self.make_room_for_loss(size, words_at + words)?;
        let came = loop {
            let room = self.pair_capacity();
            if fresh || self.groups.is_none() {
                self.groups = Some(Groups::new(&self.gpu, &self.kernels, &self.buffers));
            }
            self.drawn = vec![(band, room)];
            let sums_at = (RECORD_BYTES / 4) as u32 * room as u32;
            let flags = if self.config.abs_grads { super::back::FLAG_ABS } else { 0 };
            self.write_uniforms(shot, band, across, [flags, sums_at, 0])?;
            let at = slot::LOSS as u64 * UNIFORM_STRIDE;
            self.gpu.queue.write_buffer(self.buffers.uniforms.get(), at, bytemuck::bytes_of(&loss));
            if let Some(kept) = kept {
                kept.write_uniforms(&self.gpu, room);
                let zeros = vec![0u8; 4 * words];
                self.gpu.queue.write_buffer(self.buffers.partials.get(), 4 * words_at as u64, &zeros);
            }
            let came = self.there_and_back(target, (band, room), across, size, (words_at, words), kept)?;
            let pairs = came.counts[count::PAIRS] as usize;
            (self.stats.visible, self.stats.pairs) = (came.counts[count::VISIBLE] as usize, pairs);
            if pairs <= room {
                break came;
            }
            if pairs > self.most_pairs {
                // It must be drawn in bands.
                return Ok(None);
            }
            fresh = self.make_room_for_pairs(pairs)?;
        };
        let mut sums = [0.0; PARTIALS];
        for tile in came.partials[..partials].chunks_exact(PARTIALS) {
            sums.iter_mut().zip(tile).for_each(|(sum, x)| *sum += f64::from(*x));
        }
        let [l1, ssim, mse] = [0, 1, 2].map(|k| sums[k] / total);
        let d_response = target.response.map(|_| std::array::from_fn(|k| sums[RESPONSE + k]));
        Ok(Some((came, Comparison { l1, ssim, mse, d_response })))
    }

    fn make_room_for_loss(&mut self, [w, h]: [usize; 2], partials: usize) -> Result<bool> {
        let (gpu, b) = (&self.gpu, &mut self.buffers);
        b.maps.ensure(gpu, (4 * CHANNELS * MAPS * w * h) as u64)?;
        b.partials.ensure(gpu, 4 * partials as u64)?;
        b.d_planes.ensure(gpu, (4 * PLANES * w * h) as u64)
    }

    /// One submission: draws, compares, goes back. What came means nothing if there are more pairs than there is room for.
    fn there_and_back(
        &mut self,
        target: &Target<'_, f32>,
        (band, room): (Band, usize),
        across: usize,
        size: [usize; 2],
        (words_at, words): (usize, usize),
        kept: Option<&KeptPass<'_>>,
    ) -> Result<Came> {
        let layout = self.make_room_to_return(self.stats.splats, across, size, words_at + words)?;
        let held = self.pictures.get(target.picture);
        let groups = self.groups.as_ref().expect("groups are made before a frame");
        let frame = Frame { gpu: &self.gpu, kernels: &self.kernels, buffers: &self.buffers, groups };
        let kernels = self.back_kernels.as_ref().expect("they were compiled");
        let back = Back { frame, kernels, pairs: room };
        let mut recorder = Recorder::new(&self.gpu, &self.queries, self.clock);
        if let Some(kept) = kept {
            kept.answer(&self.gpu, &self.upload, &mut recorder)?;
        }
        frame.splats(&mut recorder, &self.upload, self.stats.splats)?;
        frame.band(&mut recorder, band, across, None)?;
        back.loss(&mut recorder, &held.buffer, [across, band.rows])?;
        let end = kept.map_or(End::Splats, |kept| End::Kept(kept, 4 * words_at as u64));
        let mut came = self.come_back(recorder, (band, room), across, end, &layout)?;
        came.words = words_of(&came.partials[words_at..]);
        self.timings.wait = came.wait;
        self.timings.add(came.stages);
        Ok(came)
    }
}
