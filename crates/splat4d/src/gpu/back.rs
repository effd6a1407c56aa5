//! The backward pass of an image: records, sums and the projection's VJP on the GPU, colours on the CPU.

use super::buffers::{SPARE, UNIFORM_STRIDE};
use super::clock::{Recorder, STAGES, TIMES_BYTES};
use super::frame::{Back, Band, Frame, RECORD_BYTES, TILE, count};
use super::kernels::BackKernels;
use super::{GpuRenderer, Way, pixel_rows};
use crate::render::project::{CAMERA, Projection};
use crate::render::rasterize::CHANNELS;
use crate::render::shade::{self, ShadeGrads};
use crate::render::{ImageGrads, PartGrads, Projected, RenderGrads, Shot, View, project};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::{BLOCK, Planes, Table};
use crate::{Error, ErrorKind, Result};
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Numbers returned per splat: five vec4 (splats_back.wgsl).
const NUMBERS: usize = 20;
/// Bits of `Blend::flags` in rasterize_back.wgsl.
const FLAG_ALPHA: u32 = 1;
const FLAG_DEPTH: u32 = 2;
pub(super) const FLAG_ABS: u32 = 4;
/// Splats in a task: whole blocks of a table.
const CHUNK: usize = 1024;

/// The returned gradients, splat by splat; memory is reused from call to call.
#[derive(Debug, Default)]
pub(super) struct Returned {
    /// 0: not rendered.
    pub radii: Vec<f32>,
    /// The CPU's half of the backward pass reads only the radius.
    projected: Vec<Projected<f32>>,
    channels: Vec<[f32; CHANNELS]>,
    d_channels: Vec<[f32; CHANNELS]>,
    partial: Vec<[f64; 3]>,
}

/// Offsets in the memory that the CPU reads.
#[derive(Clone, Copy, Debug)]
pub(super) struct Layout {
    cameras: u64,
    sums: u64,
    times: u64,
    counts: u64,
    partials: u64,
    all: u64,
}

/// Results of a submission of the backward pass for the CPU.
pub(super) struct Came {
    /// Gradient to the background, by tile.
    pub sums: Vec<f32>,
    /// Of every splat `NUMBERS`.
    pub rows: Vec<f32>,
    /// Gradient to pose and focal lengths.
    pub camera: [f64; CAMERA],
    /// Splats, visible ones, pairs.
    pub counts: Vec<u32>,
    /// Contributions of the tiles to the loss.
    pub partials: Vec<f32>,
    /// Milliseconds of the wait, and of the stages.
    pub wait: f64,
    pub stages: [f64; STAGES],
}

/// End of a backward pass.
#[derive(Clone, Copy)]
pub(super) enum End {
    /// At sums of records, to which another band adds.
    Band,
    /// At the splats, whose gradients the CPU reads.
    Splats,
}

impl GpuRenderer {
    /// Compiles the kernels of the backward pass, and renders once to size its records. Errors: the driver refuses one.
    pub fn for_training(&mut self) -> Result<()> {
        // Lists may grow by a share more than they need; behind the records are a few sums.
        let room = super::largest_binding(&self.gpu) / (RECORD_BYTES + 1) * SPARE / (SPARE + 1);
        self.most_pairs = self.most_pairs.min(usize::try_from(room).unwrap_or(usize::MAX));
        if self.gpu.lanes() > 0 {
            // Half of a binding for states, half for planes.
            let states = super::largest_binding(&self.gpu) / 2 / super::STATE_BYTES * self.gpu.lanes() as u64;
            self.most_pairs = self.most_pairs.min((states * SPARE / (SPARE + 1)) as usize);
        }
        self.compile_back()
    }

    fn compile_back(&mut self) -> Result<()> {
        if self.back_kernels.is_none() {
            self.back_kernels = Some(BackKernels::new(&self.gpu));
        }
        self.gpu.check()
    }

    /// [`Backend::vjp`](crate::render::Backend::vjp).
    pub(super) fn backward_band(
        &mut self,
        shot: &Shot<'_, f32>,
        grads: &ImageGrads<'_, f32>,
        d_sh: &mut [Option<&mut Table<f32>>],
        d: &mut RenderGrads<f32>,
    ) -> Result<()> {
        let start = Instant::now();
        let (n, size) = (shot.splats.len(), [shot.camera.width, shot.camera.height]);
        assert_eq!(self.stats.splats, n, "backward must follow the render of the same splats");
        let shaped = |planes: Option<&Planes<f32>>, channels: usize| {
            if let Some(p) = planes {
                let shape = [p.channels, p.height, p.width];
                assert_eq!(shape, [channels, size[1], size[0]], "an image's gradient has the image's shape");
            }
        };
        shaped(Some(grads.color), 3);
        shaped(grads.alpha, 1);
        shaped(grads.depth, usize::from(shot.depth));
        d.background = [0.0; 3];
        (d.camera, d.focal) = ([0.0; 6], 0.0);
        (d.extra, d.head) = (None, None);
        if n == 0 || self.drawn.is_empty() {
            let rows = vec![0.0; n * NUMBERS];
            d.background = d_background_of_nothing(grads.color, self.drawn.is_empty());
            self.spread(shot, &rows, d_sh, d)?;
            return Ok(());
        }
        self.compile_back()?;
        let across = size[0].div_ceil(TILE);
        let layout = self.make_room_to_return(n, across, size, 0)?;
        let bands = self.drawn.clone();
        let mut all: Option<Came> = None;
        for (i, &(band, pairs)) in bands.iter().enumerate() {
            let last = i + 1 == bands.len();
            let sums_at = (RECORD_BYTES / 4) as u32 * pairs as u32;
            let flag = |on: bool, flag: u32| if on { flag } else { 0 };
            let flags = flag(grads.alpha.is_some(), FLAG_ALPHA)
                | flag(shot.depth && grads.depth.is_some(), FLAG_DEPTH)
                | flag(self.config.abs_grads, FLAG_ABS);
            let way = Way { flags, sums_at, further: i > 0, ..Way::default() };
            self.write_uniforms(shot, band, across, way)?;
            self.send_gradient(shot, grads, band);
            let mut came = self.return_band((band, pairs), across, bands.len() > 1, last, &layout)?;
            self.timings.back_wait += came.wait;
            self.timings.add(came.stages);
            if let Some(before) = all.take() {
                came.sums.splice(..0, before.sums);
            }
            all = Some(came);
        }
        self.deliver(shot, &all.expect("something was drawn"), d_sh, d)?;
        self.timings.back_total = start.elapsed().as_secs_f64() * 1e3;
        Ok(())
    }

    /// Returns the gradients of all bands.
    pub(super) fn deliver(
        &mut self,
        shot: &Shot<'_, f32>,
        came: &Came,
        d_sh: &mut [Option<&mut Table<f32>>],
        d: &mut RenderGrads<f32>,
    ) -> Result<()> {
        let mut d_background = [0.0; 3];
        for tile in came.sums.chunks_exact(3) {
            (0..3).for_each(|c| d_background[c] += f64::from(tile[c]));
        }
        d.background = d_background.map(|v| v as f32);
        d.camera.copy_from_slice(&came.camera[..6]);
        d.focal = came.camera[6];
        (d.extra, d.head) = (None, None);
        self.spread(shot, &came.rows, d_sh, d)
    }

    /// `partials`: numbers of a loss to return as well.
    pub(super) fn make_room_to_return(
        &mut self,
        n: usize,
        across: usize,
        size: [usize; 2],
        partials: usize,
    ) -> Result<Layout> {
        let most = |f: &dyn Fn(&(Band, usize)) -> u64| self.drawn.iter().map(f).max().unwrap_or(0);
        let pixels = most(&|(band, _)| (size[0] * pixel_rows(*band, size[1])) as u64);
        let tiles = most(&|(band, _)| (across * band.rows) as u64);
        let records = most(&|(band, pairs)| RECORD_BYTES * *pairs as u64 + 12 * (across * band.rows) as u64);
        let groups: usize = self.upload.draws.iter().map(|draw| draw.groups()).sum();
        self.make_room_for_gradients(n, pixels, records)?;
        let (gpu, b) = (&self.gpu, &mut self.buffers);
        let cameras = ((4 * NUMBERS * n) as u64).next_multiple_of(UNIFORM_STRIDE);
        let sums = (cameras + (4 * CAMERA * groups) as u64).next_multiple_of(UNIFORM_STRIDE);
        let times = (sums + 12 * tiles).next_multiple_of(UNIFORM_STRIDE);
        let counts = times + TIMES_BYTES.next_multiple_of(UNIFORM_STRIDE);
        let partials_at = counts + UNIFORM_STRIDE;
        let all = partials_at + 4 * partials as u64;
        let layout = Layout { cameras, sums, times, counts, partials: partials_at, all };
        b.back_staging.ensure(gpu, layout.all)?;
        Ok(layout)
    }

    /// Buffers of the gradients to `n` splats and to this many pixels, and of this many bytes of records.
    pub(super) fn make_room_for_gradients(&mut self, n: usize, pixels: u64, records: u64) -> Result<()> {
        let (gpu, b) = (&self.gpu, &mut self.buffers);
        let groups: usize = self.upload.draws.iter().map(|draw| draw.groups()).sum();
        b.d_planes.ensure(gpu, 20 * pixels)?;
        b.records.ensure(gpu, records)?;
        b.sums.ensure(gpu, 48 * n as u64)?;
        b.back.ensure(gpu, (4 * NUMBERS * n) as u64)?;
        b.cameras.ensure(gpu, (4 * CAMERA * groups) as u64)?;
        Ok(())
    }

    /// Sends the gradient to a band's planes.
    fn send_gradient(&self, shot: &Shot<'_, f32>, grads: &ImageGrads<'_, f32>, band: Band) {
        let width = shot.camera.width;
        let rows = pixel_rows(band, shot.camera.height);
        let (first, count) = (band.first * TILE * width, rows * width);
        let colors = (0..3).map(|c| (c, Some(grads.color.plane(c))));
        let others =
            [(3, grads.alpha.map(|p| p.plane(0))), (4, grads.depth.filter(|_| shot.depth).map(|p| p.plane(0)))];
        for (at, plane) in colors.chain(others) {
            if let Some(plane) = plane {
                let bytes = bytemuck::cast_slice(&plane[first..first + count]);
                self.gpu.queue.write_buffer(self.buffers.d_planes.get(), (4 * at * count) as u64, bytes);
            }
        }
    }

    /// Runs the backward pass of one band; `again`: it must be listed and rendered again; `last`: also returns the
    /// splats' gradients.
    fn return_band(
        &self,
        (band, pairs): (Band, usize),
        across: usize,
        again: bool,
        last: bool,
        layout: &Layout,
    ) -> Result<Came> {
        let groups = self.groups.as_ref().expect("a frame was drawn");
        let frame = Frame { gpu: &self.gpu, kernels: &self.kernels, buffers: &self.buffers, groups };
        let mut recorder = Recorder::new(&self.gpu, &self.queries, self.clock);
        if again {
            // The lists and planes of another band are there.
            frame.band(&mut recorder, band, across, None)?;
        }
        let end = if last { End::Splats } else { End::Band };
        self.come_back(recorder, (band, pairs), across, end, layout)
    }

    /// The backward pass of a band whose lists, planes and gradient are available after what `recorder` holds, and the
    /// reading of the copy of its results. `pairs`: their largest number.
    pub(super) fn come_back(
        &self,
        mut recorder: Recorder<'_>,
        (band, pairs): (Band, usize),
        across: usize,
        end: End,
        layout: &Layout,
    ) -> Result<Came> {
        let last = matches!(end, End::Splats);
        let (gpu, b) = (&self.gpu, &self.buffers);
        let groups = self.groups.as_ref().expect("a frame was drawn");
        let frame = Frame { gpu, kernels: &self.kernels, buffers: b, groups };
        let back = Back { frame, kernels: self.back_kernels.as_ref().expect("they were compiled"), pairs };
        back.band(&mut recorder, band, across)?;
        let (tiles, n) = (across * band.rows, if last { self.stats.splats } else { 0 });
        let groups: usize = if last { self.upload.draws.iter().map(|draw| draw.groups()).sum() } else { 0 };
        let staging = b.back_staging.get();
        if last {
            back.splats(&mut recorder, &self.upload)?;
            recorder.copy(b.back.get(), staging, 0, (4 * NUMBERS * n) as u64);
            recorder.copy(b.cameras.get(), staging, layout.cameras, (4 * CAMERA * groups) as u64);
        }
        recorder.copy_from(b.records.get(), RECORD_BYTES * pairs as u64, staging, layout.sums, 12 * tiles as u64);
        recorder.copy(b.counts.get(), staging, layout.counts, 4 * count::ALL as u64);
        if layout.all > layout.partials {
            recorder.copy(b.partials.get(), staging, layout.partials, layout.all - layout.partials);
        }
        let timed = recorder.resolve(b.times.get());
        if timed {
            recorder.copy(b.times.get(), staging, layout.times, TIMES_BYTES);
        }
        let start = Instant::now();
        recorder.submit();
        staging.map_async(wgpu::MapMode::Read, ..layout.all, |_| ());
        gpu.wait()?;
        let lost = |e: wgpu::MapRangeError| {
            Error::new(ErrorKind::Unsupported, format!("the gradients cannot be read from the GPU ({e})"))
                .at(gpu.name())
                .remedy("Train on the CPU.")
        };
        let view = staging.get_mapped_range(..layout.all).map_err(lost)?;
        let at = |first: u64, bytes: usize| &view[first as usize..][..bytes];
        let stamps: Vec<u64> = bytemuck::pod_collect_to_vec(at(layout.times, TIMES_BYTES as usize));
        let cameras: Vec<f32> = bytemuck::pod_collect_to_vec(at(layout.cameras, 4 * CAMERA * groups));
        let mut camera = [0.0; CAMERA];
        for one in cameras.chunks_exact(CAMERA) {
            (0..CAMERA).for_each(|k| camera[k] += f64::from(one[k]));
        }
        let mut came = Came {
            sums: bytemuck::pod_collect_to_vec(at(layout.sums, 12 * tiles)),
            rows: bytemuck::pod_collect_to_vec(at(0, 4 * NUMBERS * n)),
            camera,
            counts: bytemuck::pod_collect_to_vec(at(layout.counts, 4 * count::ALL)),
            partials: bytemuck::pod_collect_to_vec(&view[layout.partials as usize..]),
            wait: 0.0,
            stages: if timed { recorder.stages(&stamps) } else { recorder.by_wall },
        };
        drop(view);
        staging.unmap();
        came.wait = start.elapsed().as_secs_f64() * 1e3;
        Ok(came)
    }

    /// Writes the gradients of all splats where they belong, and takes colours back.
    fn spread(
        &mut self,
        shot: &Shot<'_, f32>,
        rows: &[f32],
        d_sh: &mut [Option<&mut Table<f32>>],
        d: &mut RenderGrads<f32>,
    ) -> Result<()> {
        let (splats, n) = (shot.splats, shot.splats.len());
        let Returned { radii, projected, channels, d_channels, partial } = &mut self.returned;
        radii.resize(n, 0.0);
        projected.resize(n, Projected::default());
        channels.resize(n, [0.0; CHANNELS]);
        d_channels.resize(n, [0.0; CHANNELS]);
        d.mean2d.resize(n, 0.0);
        d.mean2d_abs.resize(n, 0.0);
        d.parts.resize_with(splats.parts.len(), PartGrads::default);
        let finite = AtomicBool::new(true);
        let (rows, _) = rows.as_chunks::<NUMBERS>();
        let mut first = 0;
        for (part, out) in splats.parts.iter().zip(&mut d.parts) {
            project::reshape(&mut out.out, part.out);
            let all = first..first + part.out.rows();
            first = all.end;
            let tables = out.out.data_mut().par_chunks_mut(CHUNK * (SPLAT_OPACITY + 1));
            let sources = rows[all.clone()].par_chunks(CHUNK);
            let drawn = radii[all.clone()].par_chunks_mut(CHUNK).zip(projected[all.clone()].par_chunks_mut(CHUNK));
            let colors = channels[all.clone()].par_chunks_mut(CHUNK).zip(d_channels[all.clone()].par_chunks_mut(CHUNK));
            let norms = d.mean2d[all.clone()].par_chunks_mut(CHUNK).zip(d.mean2d_abs[all].par_chunks_mut(CHUNK));
            tables.zip(sources).zip(drawn).zip(colors).zip(norms).for_each(
                |((((table, rows), (radii, projected)), (channels, d_channels)), (mean2d, mean2d_abs))| {
                    let mut sum = 0.0;
                    for (i, row) in rows.iter().enumerate() {
                        let mut put = |column: usize, v: f32| {
                            table[(i / BLOCK * (SPLAT_OPACITY + 1) + column) * BLOCK + i % BLOCK] = v;
                        };
                        (0..3).for_each(|k| put(k, row[k]));
                        put(SPLAT_OPACITY, row[3]);
                        (0..6).for_each(|k| put(COV + k, row[4 + k]));
                        radii[i] = row[10];
                        projected[i] = Projected { radius: row[10], ..Projected::default() };
                        d_channels[i] = [row[12], row[13], row[14]];
                        mean2d[i] = row[15];
                        channels[i] = [row[16], row[17], row[18]];
                        mean2d_abs[i] = row[19];
                        // 0 times a number is 0, of others NaN.
                        sum += row.iter().map(|v| 0.0 * v).sum::<f32>();
                    }
                    if sum != 0.0 {
                        finite.store(false, Ordering::Relaxed);
                    }
                },
            );
        }
        if !finite.into_inner() {
            return Err(Error::new(ErrorKind::Unsupported, "a gradient from the GPU is not a finite number")
                .at(self.gpu.name())
                .remedy("Train on the CPU."));
        }
        let view = View::new(shot.camera, &self.config);
        let projection = Projection { splats, view: &view, simd: self.config.simd, projected };
        let mut targets = ShadeGrads { sh: d_sh, parts: &mut d.parts, pose: &mut d.camera, partial };
        shade::backward(&projection, shot.sh_degree, channels, d_channels, &mut targets);
        Ok(())
    }
}

/// The background's gradient of an image without splats, or without pixels.
fn d_background_of_nothing(color: &Planes<f32>, no_pixels: bool) -> [f32; 3] {
    if no_pixels { [0.0; 3] } else { std::array::from_fn(|c| color.plane(c).iter().sum()) }
}
