//! An image that never leaves the GPU: rendered, compared with its truth and backpropagated in one submission.

use super::back::{Came, End};
use super::buffers::UNIFORM_STRIDE;
use super::clock::Recorder;
use super::frame::{Back, Band, Frame, Groups, RECORD_BYTES, TILE, count, slot};
use super::limits::THREADS;
use super::pictures::Held;
use super::{GpuRenderer, GpuStats, GpuTimings, MOST_GROUPS, PLANES, Way, largest_binding, plane_bytes};
use crate::Result;
use crate::render::{Comparison, RenderGrads, Shot, Target};
use crate::scene::Table;
use std::time::Instant;

/// Numbers that a tile adds to the loss (loss.wgsl).
pub(super) const PARTIALS: usize = 16;
/// First of those of the camera's colour matrix.
const RESPONSE: usize = 4;
/// Numbers of a camera's response.
pub(super) const RESPONSES: usize = 12;
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
#[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct Loss {
    width: u32,
    height: u32,
    flags: u32,
    d_l1: f32,
    d_ssim: f32,
    response: u32,
    unused: [u32; 2],
    taps: [f32; 12],
}

/// The normalised window, and a number that fills its last vector.
fn window() -> [f32; 12] {
    let bell = |i: usize| (-(i as f64 - (TAPS / 2) as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp();
    let sum: f64 = (0..TAPS).map(bell).sum();
    std::array::from_fn(|i| if i < TAPS { (bell(i) / sum) as f32 } else { 0.0 })
}

impl Loss {
    /// `dssim`: λ. `response`: number of the camera's row, where it does not show what is rendered.
    pub(super) fn new(dssim: f64, held: &Held, response: Option<usize>) -> Self {
        let total = held.weight * CHANNELS as f64;
        Self {
            width: held.size[0] as u32,
            height: held.size[1] as u32,
            flags: held.flags | if response.is_some() { FLAG_RESPONSE } else { 0 },
            d_l1: ((1.0 - dssim) / total) as f32,
            d_ssim: (-dssim / total) as f32,
            response: (RESPONSES * response.unwrap_or(0)) as u32,
            unused: [0; 2],
            taps: window(),
        }
    }
}

/// A comparison from its sums over the tiles.
pub(super) fn means(held: &Held, [l1, ssim, mse]: [f64; 3], d_response: Option<[f64; RESPONSES]>) -> Comparison {
    let total = held.weight * CHANNELS as f64;
    Comparison { l1: l1 / total, ssim: ssim / total, mse: mse / total, d_response }
}

impl GpuRenderer {
    /// Whether an image of this many splats can be compared at all: its planes are one buffer.
    pub(super) fn can_compare(&self, splats: usize, [w, h]: [usize; 2]) -> bool {
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
        let (n, size) = (shot.splats.len(), [shot.camera.width, shot.camera.height]);
        let shape = [target.truth.channels, target.truth.width, target.truth.height];
        assert_eq!(shape, [CHANNELS, size[0], size[1]], "an image and its truth have one shape");
        if !self.can_compare(n, size) {
            return Ok(None);
        }
        self.timings = GpuTimings::default();
        self.upload.send(&self.gpu, shot.splats, self.tables)?;
        self.timings.upload = start.elapsed().as_secs_f64() * 1e3;
        self.stats = GpuStats { splats: n, bands: 1, ..GpuStats::default() };
        self.for_training()?;
        let held = self.pictures.hold(&self.gpu, target, self.config.device_images)?;
        let came = if held.weight > 0.0 { self.compare_held(shot, target, &held) } else { Ok(None) };
        self.pictures.give_back(held);
        let Some((came, comparison)) = came? else { return Ok(None) };
        self.deliver(shot, &came, d_sh, d)?;
        self.timings.total = start.elapsed().as_secs_f64() * 1e3;
        Ok(Some(comparison))
    }

    /// Renders, compares and runs the backward pass. `None`: it must be rendered in bands.
    fn compare_held(
        &mut self,
        shot: &Shot<'_, f32>,
        target: &Target<'_, f32>,
        held: &Held,
    ) -> Result<Option<(Came, Comparison)>> {
        let (n, size) = (shot.splats.len(), held.size);
        let loss = Loss::new(target.dssim, held, target.response.map(|_| 0));
        self.response.ensure(&self.gpu, (4 * RESPONSES) as u64)?;
        if let Some(response) = &target.response {
            self.gpu.queue.write_buffer(self.response.get(), 0, bytemuck::cast_slice(response));
        }
        let band = Band { first: 0, rows: size[1].div_ceil(TILE) };
        let across = size[0].div_ceil(TILE);
        let partials = PARTIALS * across * band.rows;
        let mut fresh = self.make_room_for_splats(n)?;
        fresh |= self.make_room_for_band(band, across, size[0])?;
        fresh |= self.make_room_for_loss(size, partials)?;
        let came = loop {
            let room = self.pair_capacity();
            if fresh || self.groups.is_none() {
                self.groups = Some(Groups::new(&self.gpu, &self.kernels, &self.buffers));
            }
            self.drawn = vec![(band, room)];
            let flags = if self.config.abs_grads { super::back::FLAG_ABS } else { 0 };
            let way = Way { flags, sums_at: sums_at(room), ..Way::default() };
            self.write_uniforms(shot, band, across, way)?;
            self.write_loss(&loss);
            let came = self.there_and_back(held, (band, room), across, partials)?;
            let pairs = came.counts[count::PAIRS] as usize;
            (self.stats.visible, self.stats.pairs) = (came.counts[count::VISIBLE] as usize, pairs);
            if pairs <= room {
                break came;
            }
            if pairs > self.most_pairs {
                return Ok(None);
            }
            fresh = self.make_room_for_pairs(pairs)? | self.make_room_for_band(band, across, size[0])?;
        };
        let mut sums = [0.0; PARTIALS];
        for tile in came.partials[..partials].chunks_exact(PARTIALS) {
            sums.iter_mut().zip(tile).for_each(|(sum, x)| *sum += f64::from(*x));
        }
        let d_response = target.response.map(|_| std::array::from_fn(|k| sums[RESPONSE + k]));
        Ok(Some((came, means(held, [sums[0], sums[1], sums[2]], d_response))))
    }

    /// Writes the uniform of the loss, after all others.
    pub(super) fn write_loss(&self, loss: &Loss) {
        let at = slot::LOSS as u64 * UNIFORM_STRIDE;
        self.gpu.queue.write_buffer(self.buffers.uniforms.get(), at, bytemuck::bytes_of(loss));
    }

    /// Buffers of the loss of an image, which returns this many numbers.
    pub(super) fn make_room_for_loss(&mut self, [w, h]: [usize; 2], partials: usize) -> Result<bool> {
        let (gpu, b) = (&self.gpu, &mut self.buffers);
        b.maps.ensure(gpu, (4 * CHANNELS * MAPS * w * h) as u64)?;
        b.partials.ensure(gpu, 4 * partials as u64)?;
        b.d_planes.ensure(gpu, (4 * PLANES * w * h) as u64)
    }

    /// One submission: rendering, comparison, backward pass. The results are invalid if there are more pairs than fit.
    fn there_and_back(
        &mut self,
        held: &Held,
        (band, room): (Band, usize),
        across: usize,
        partials: usize,
    ) -> Result<Came> {
        let layout = self.make_room_to_return(self.stats.splats, across, held.size, partials)?;
        let groups = self.groups.as_ref().expect("groups are made before a frame");
        let frame = Frame { gpu: &self.gpu, kernels: &self.kernels, buffers: &self.buffers, groups };
        let kernels = self.back_kernels.as_ref().expect("they were compiled");
        let back = Back { frame, kernels, pairs: room };
        let mut recorder = Recorder::new(&self.gpu, &self.queries, self.clock);
        frame.splats(&mut recorder, &self.upload, self.stats.splats)?;
        frame.band(&mut recorder, band, across, None)?;
        back.loss(&mut recorder, &held.buffer, &self.response, [across, band.rows])?;
        let came = self.come_back(recorder, (band, room), across, End::Splats, &layout)?;
        self.timings.wait = came.wait;
        self.timings.add(came.stages);
        Ok(came)
    }
}

/// Number of the first sum behind records of this many pairs.
pub(super) fn sums_at(room: usize) -> u32 {
    (RECORD_BYTES / 4) as u32 * room as u32
}
