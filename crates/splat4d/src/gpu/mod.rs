//! The renderer on a GPU (feature `gpu`): the same stages as [`crate::render`] in WGSL, through `wgpu`.
//!
//! Stages: project and colour every splat; gather the visible ones; sort them by depth (ties by index, the order that
//! `render::bin` defines); count, sum and write pairs of tile and splat in that order; sort the pairs stably by tile;
//! blend 16² tiles. Backward pass (`back.rs`): a record of sums per pair, the records of each splat added in a fixed
//! order, the projection's VJP; the CPU backpropagates colours. With L1 and D-SSIM, the image is compared with its
//! truth in between (`compare.rs`) and stays on the GPU. Every stage is checked against its CPU twin. The shaders stay
//! inside WebGPU's default limits. Only integers are added atomically, so the bits are reproducible.
//!
//! Memory is one arena that only grows: a steady scene allocates nothing. The number of pairs is known only after
//! counting, so a frame uses the buffer sizes of the previous one without waiting. If there are more pairs, the rest of
//! the frame consists of empty dispatches, and its lists are made again in larger buffers. An image whose pairs or
//! pixels do not fit into a binding is rendered in bands of tile rows, which change no bit.

mod back;
mod buffers;
mod clock;
mod compare;
mod device;
mod frame;
mod kernels;
mod limits;
mod pictures;
mod resident;
mod roofline;
#[cfg(test)]
mod tests;
mod tuning;
mod upload;

pub use clock::{GpuTimings, StageClock};
pub use device::{Adapters, Gpu};
pub use roofline::GpuRoofline;
pub use tuning::Tuning;

use crate::render::backend::refusal;
use crate::render::{
    Abilities, Antialias, Backend, Comparison, Image, ImageGrads, RenderConfig, RenderGrads, Resident, Shot, Tables,
    Target,
};
use crate::scene::{Planes, Table};
use crate::{Error, ErrorKind, Result};
use back::Returned;
use buffers::{Buffers, Grown, UNIFORM_STRIDE, largest_binding};
use clock::{Queries, Recorder, TIMES_BYTES};
use frame::{Band, DIGITS, Frame, Groups, RANGE_BYTES, TILE, arguments, count, slot};
use kernels::{BackKernels, Kernels};
use limits::THREADS;
use pictures::Pictures;
use rayon::prelude::*;
use resident::{AHEAD, Flights, Tables as KeptTables};
use std::time::Instant;
use upload::Upload;

/// Planes of an image: red, green, blue, alpha, depth.
const PLANES: usize = 5;
/// An owner's bits from here on are its quadrants (tiles.wgsl).
const OWNER_SHIFT: u32 = 28;
/// Bit of the view's flags in project.wgsl.
const FLAG_ANTIALIAS: u32 = 1;
/// Pairs of tile and splat that are held at once (a quarter GiB); bands are made so that no more are needed.
const MOST_PAIRS: usize = 1 << 24;
/// Initial capacity for pairs, per splat and at least.
const FIRST_PAIRS: (usize, usize) = (4, 1 << 16);
/// Workgroups of one dispatch in one direction (WebGPU's default limit).
const MOST_GROUPS: usize = 65_535;

/// Counts of the last render.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GpuStats {
    /// Splats given.
    pub splats: usize,
    /// Splats whose box touches the image.
    pub visible: usize,
    /// Pairs of 16² tile and splat.
    pub pairs: usize,
    /// Bands in which the image was rendered.
    pub bands: usize,
}

/// Renders splats on a GPU. All memory is reused from call to call.
#[derive(Debug)]
pub struct GpuRenderer {
    /// Options; `simd` means nothing here.
    pub config: RenderConfig,
    /// Whether tables are sent for every image.
    pub tables: Tables,
    /// Source of the stages' times.
    pub clock: StageClock,
    gpu: Gpu,
    kernels: Kernels,
    buffers: Buffers,
    upload: Upload,
    groups: Option<Groups>,
    queries: Queries,
    uniforms: Vec<u8>,
    /// Instead of [`MOST_PAIRS`].
    most_pairs: usize,
    timings: GpuTimings,
    stats: GpuStats,
    /// Compiled when they are first needed.
    back_kernels: Option<BackKernels>,
    /// Bands of the last render with their pairs; empty where there is nothing to take back.
    drawn: Vec<(Band, usize)>,
    returned: Returned,
    pictures: Pictures,
    /// Colour matrix of the camera, where no tables stay.
    response: Grown,
    resident: Option<Box<KeptTables>>,
    flights: Flights,
    /// Steps that may be in flight, rows of tiles of a band in them, and rows of a page of their tables, where tests
    /// request it.
    ahead: usize,
    band_rows: usize,
    page_rows: Option<usize>,
}

impl GpuRenderer {
    /// Compiles the kernels. Errors: the driver refuses one.
    pub fn new(gpu: Gpu, config: RenderConfig) -> Result<Self> {
        let kernels = Kernels::new(&gpu);
        gpu.check()?;
        let queries = Queries::new(&gpu);
        let clock = if gpu.has_timestamps() { StageClock::Gpu } else { StageClock::Off };
        Ok(Self {
            config,
            tables: Tables::Changing,
            clock,
            gpu,
            kernels,
            buffers: Buffers::new(),
            upload: Upload::default(),
            groups: None,
            queries,
            uniforms: Vec::new(),
            most_pairs: MOST_PAIRS,
            timings: GpuTimings::default(),
            stats: GpuStats::default(),
            back_kernels: None,
            drawn: Vec::new(),
            returned: Returned::default(),
            pictures: Pictures::new(),
            response: Grown::storage("a camera's response"),
            resident: None,
            flights: Flights::default(),
            ahead: AHEAD,
            band_rows: usize::MAX,
            page_rows: None,
        })
    }

    /// The GPU.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Milliseconds of the last render.
    pub fn timings(&self) -> GpuTimings {
        self.timings
    }

    /// Counts of the last render.
    pub fn stats(&self) -> GpuStats {
        self.stats
    }

    /// Bytes of GPU memory held, tables included.
    pub fn memory_bytes(&self) -> u64 {
        let tables = self.resident.as_ref().map_or(0, |t| t.bytes());
        self.buffers.bytes() + self.upload.bytes() + self.pictures.bytes() + tables
    }

    /// Forgets every table that was sent, and frees its memory.
    pub(crate) fn forget_scene(&mut self) {
        self.upload = Upload::default();
        self.drawn.clear();
    }

    /// Refuses what the shaders cannot do, without opening a GPU.
    pub(crate) fn refuses(abilities: &Abilities) -> Result<()> {
        let lacks = [(abilities.head, "render scenes with a pixel head"), (abilities.extra, "blend further channels")];
        lacks.iter().find(|(abilities, _)| *abilities).map_or(Ok(()), |(_, what)| Err(refusal("the GPU", what)))
    }

    /// Renders all bands of an image that has pixels.
    fn draw_bands(&mut self, shot: &Shot<'_, f32>, out: &mut Out<'_>) -> Result<()> {
        let start = Instant::now();
        let (n, w, h) = (self.stats.splats, shot.camera.width, shot.camera.height);
        let (across, down) = (w.div_ceil(TILE), h.div_ceil(TILE));
        // What is read back holds the planes and, behind them, a few numbers.
        let room = largest_binding(&self.gpu) - 4 * UNIFORM_STRIDE;
        let band_rows = (room / (4 * PLANES * TILE * w) as u64).min(MOST_GROUPS as u64) as usize;
        if across > MOST_GROUPS || band_rows == 0 {
            return Err(Error::new(
                ErrorKind::Unsupported,
                format!("an image {w} pixels wide is too large for the GPU"),
            )
            .remedy("Render on the CPU."));
        }
        if n > MOST_GROUPS * THREADS {
            return Err(Error::new(
                ErrorKind::Unsupported,
                format!("{n} Gaussians at one time are too many for the GPU"),
            )
            .remedy("Render on the CPU."));
        }
        self.upload.send(&self.gpu, shot.splats, self.tables)?;
        let mut fresh = self.make_room_for_splats(n)?;
        self.timings.upload = start.elapsed().as_secs_f64() * 1e3;
        // Bands from the top: the last of the list comes first.
        let mut bands: Vec<Band> =
            (0..down).step_by(band_rows).map(|first| Band { first, rows: band_rows.min(down - first) }).rev().collect();
        let mut projected = false;
        while let Some(band) = bands.pop() {
            fresh |= self.make_room_for_band(band, across, w)?;
            let read = counts_at(plane_bytes(band, w)) + UNIFORM_STRIDE + TIMES_BYTES;
            self.buffers.staging.ensure(&self.gpu, read)?;
            if fresh || self.groups.is_none() {
                self.groups = Some(Groups::new(&self.gpu, &self.kernels, &self.buffers));
                fresh = false;
            }
            self.write_uniforms(shot, band, across, Way::default())?;
            let pairs = self.draw(band, [w, h], !projected, out)?;
            projected = true;
            if pairs <= self.pair_capacity() {
                self.stats.pairs += pairs;
                self.stats.bands += 1;
                self.drawn.push((band, pairs));
                continue;
            }
            // Too many pairs for the buffers: larger ones, or two halves.
            if pairs <= self.most_pairs {
                fresh |= self.make_room_for_pairs(pairs)?;
                bands.push(band);
            } else if band.rows > 1 {
                let half = band.rows / 2;
                bands.push(Band { first: band.first + half, rows: band.rows - half });
                bands.push(Band { first: band.first, rows: half });
                if self.pair_capacity() < self.most_pairs {
                    fresh |= self.make_room_for_pairs(self.most_pairs)?;
                }
            } else {
                let text = format!("{pairs} pairs of Gaussian and tile in one row of tiles are too many for the GPU");
                return Err(Error::new(ErrorKind::Unsupported, text).remedy("Render on the CPU."));
            }
        }
        self.timings.total = start.elapsed().as_secs_f64() * 1e3;
        Ok(())
    }

    /// Buffers with a row per splat; whether any is new.
    fn make_room_for_splats(&mut self, n: usize) -> Result<bool> {
        let (gpu, b) = (&self.gpu, &mut self.buffers);
        let n = n as u64;
        let mut fresh = false;
        fresh |= b.uniforms.ensure(gpu, (slot::PIECES + self.upload.draws.len()) as u64 * UNIFORM_STRIDE)?;
        fresh |= b.counts.ensure(gpu, 4 * count::ALL as u64)?;
        for buffer in &mut b.arguments {
            fresh |= buffer.ensure(gpu, arguments::BYTES)?;
        }
        fresh |= b.shapes.ensure(gpu, 32 * n)?;
        fresh |= b.colors.ensure(gpu, 16 * n)?;
        let blocks = n.div_ceil(gpu.tuning.block() as u64);
        for buffer in [&mut b.marks, &mut b.places, &mut b.tile_counts, &mut b.first_pairs] {
            fresh |= buffer.ensure(gpu, 4 * n)?;
        }
        for buffer in b.depth_keys.iter_mut().chain(&mut b.depth_values) {
            fresh |= buffer.ensure(gpu, 4 * n)?;
        }
        fresh |= b.scan_sums.ensure(gpu, 4 * blocks)?;
        fresh |= b.sort_counts.ensure(gpu, sort_bytes(gpu, b.depth_keys[0].bytes() / 4))?;
        fresh |= b.times.ensure(gpu, TIMES_BYTES)?;
        if b.pair_keys[0].bytes() == 0 {
            let (each, least) = FIRST_PAIRS;
            self.make_room_for_pairs((each * n as usize).clamp(least, MOST_PAIRS).min(self.most_pairs))?;
            fresh = true;
        }
        self.gpu.queue.write_buffer(self.buffers.counts.get(), 0, bytemuck::cast_slice(&[n as u32, 0, 0]));
        Ok(fresh)
    }

    fn make_room_for_pairs(&mut self, pairs: usize) -> Result<bool> {
        let (gpu, b) = (&self.gpu, &mut self.buffers);
        let mut fresh = false;
        for buffer in b.pair_keys.iter_mut().chain(&mut b.pair_values).chain([&mut b.owners]) {
            fresh |= buffer.ensure(gpu, 4 * pairs as u64)?;
        }
        fresh |= b.sort_counts.ensure(gpu, sort_bytes(gpu, b.pair_keys[0].bytes() / 4))?;
        Ok(fresh)
    }

    fn make_room_for_band(&mut self, band: Band, across: usize, width: usize) -> Result<bool> {
        let (gpu, b) = (&self.gpu, &mut self.buffers);
        let (planes, tiles) = (plane_bytes(band, width), band.rows * across);
        let pairs = (b.pair_keys[0].bytes() / 4) as usize;
        b.bytes.ensure(gpu, planes / PLANES as u64)?;
        let mut fresh = b.ranges.ensure(gpu, RANGE_BYTES * tiles as u64)?;
        fresh |= b.planes.ensure(gpu, planes + state_bytes(gpu, pairs, tiles))?;
        Ok(fresh)
    }

    /// Capacity for pairs.
    fn pair_capacity(&self) -> usize {
        (self.buffers.pair_keys[0].bytes() / 4) as usize
    }

    /// Writes every uniform of a submission.
    fn write_uniforms(&mut self, shot: &Shot<'_, f32>, band: Band, across: usize, way: Way) -> Result<()> {
        let draws = &self.upload.draws;
        self.uniforms.clear();
        self.uniforms.resize((slot::PIECES + draws.len()) * UNIFORM_STRIDE as usize, 0);
        let capacity = self.pair_capacity() as u32;
        let out = &mut self.uniforms;
        put(out, slot::VIEW, &view(shot, &self.config, self.stats.splats));
        put(out, slot::SCAN_VISIBLE, &[count::SPLATS as u32, count::VISIBLE as u32, 0, u32::MAX, way.view]);
        put(out, slot::SCAN_PAIRS, &[count::VISIBLE as u32, count::PAIRS as u32, 0, capacity, way.view]);
        for (pass, slot) in (slot::SORT_DEPTH..slot::SORT_TILE).enumerate() {
            put(out, slot, &[8 * pass as u32, count::VISIBLE as u32]);
        }
        for (pass, slot) in (slot::SORT_TILE..slot::BAND).enumerate() {
            put(out, slot, &[8 * pass as u32, count::PAIRS as u32]);
        }
        let [first, rows, across] = [band.first, band.rows, across].map(|v| v as u32);
        put(out, slot::BAND, &[first, rows, across, u32::from(way.further)]);
        let c = &self.config;
        let pixel_rows = pixel_rows(band, shot.camera.height) as u32;
        let limits = [c.alpha_limits()[1] as f32, c.transmittance_min.max(0.0) as f32].map(f32::to_bits);
        let [r, g, b] = shot.background.map(f32::to_bits);
        let [skipped, plane_rows] =
            if way.whole { [band.first * TILE, shot.camera.height].map(|rows| rows as u32) } else { [0, pixel_rows] };
        let whole = Band { first: 0, rows: (plane_rows as usize).div_ceil(TILE) };
        let states_at = (plane_bytes(whole, shot.camera.width) / 4) as u32;
        let blend =
            [r, g, b, limits[0], limits[1], first, pixel_rows, way.flags, way.sums_at, skipped, plane_rows, states_at];
        put(out, slot::BLEND, &blend);
        for (i, draw) in draws.iter().enumerate() {
            put(out, slot::PIECES + i, std::slice::from_ref(&draw.piece));
        }
        self.gpu.queue.write_buffer(self.buffers.uniforms.get(), 0, &self.uniforms);
        self.gpu.check()
    }

    /// Runs a submission and reads its image, unless there were too many pairs. Returns how many there were.
    fn draw(&mut self, band: Band, [width, height]: [usize; 2], project: bool, out: &mut Out<'_>) -> Result<usize> {
        let (gpu, b) = (&self.gpu, &self.buffers);
        let groups = self.groups.as_ref().expect("groups are made before a frame");
        let frame = Frame { gpu, kernels: &self.kernels, buffers: b, groups };
        let mut recorder = Recorder::new(gpu, &self.queries, self.clock);
        if project {
            frame.splats(&mut recorder, &self.upload, self.stats.splats)?;
        }
        let rows = pixel_rows(band, height);
        let (source, each, bytes) = match out {
            Out::Planes(_) => (&b.planes, 4 * PLANES, None),
            Out::Bytes(_) => (&b.bytes, 4, Some(width * rows)),
        };
        frame.band(&mut recorder, band, width.div_ceil(TILE), bytes)?;
        let planes = (each * width * rows) as u64;
        let counts_at = counts_at(planes);
        let times_at = counts_at + UNIFORM_STRIDE;
        recorder.copy(source.get(), b.staging.get(), 0, planes);
        recorder.copy(b.counts.get(), b.staging.get(), counts_at, 4 * count::ALL as u64);
        let timed = recorder.resolve(b.times.get());
        if timed {
            recorder.copy(b.times.get(), b.staging.get(), times_at, TIMES_BYTES);
        }
        let start = Instant::now();
        recorder.submit();
        let staging = b.staging.get();
        // A failed map shows in the view below, or as the device's own error.
        staging.map_async(wgpu::MapMode::Read, .., |_| ());
        gpu.wait()?;
        let lost = |e: wgpu::MapRangeError| {
            Error::new(ErrorKind::Unsupported, format!("the image cannot be read from the GPU ({e})"))
                .at(gpu.name())
                .remedy("Render on the CPU.")
        };
        let view = staging.get_mapped_range(..).map_err(lost)?;
        let counts: Vec<u32> = bytemuck::pod_collect_to_vec(&view[counts_at as usize..][..4 * count::ALL]);
        let pairs = counts[count::PAIRS] as usize;
        self.stats.visible = counts[count::VISIBLE] as usize;
        let stamps: Vec<u64> = bytemuck::pod_collect_to_vec(&view[times_at as usize..][..TIMES_BYTES as usize]);
        if pairs <= (b.pair_keys[0].bytes() / 4) as usize {
            let (view, first) = (&view[..planes as usize], band.first * TILE);
            match out {
                Out::Planes(image) => read_planes(view, first, rows, image),
                Out::Bytes(pixels) => {
                    let target = &mut pixels[first * width..(first + rows) * width];
                    target.as_flattened_mut().copy_from_slice(view);
                }
            }
        }
        drop(view);
        staging.unmap();
        self.timings.wait += start.elapsed().as_secs_f64() * 1e3;
        self.timings.add(if timed { recorder.stages(&stamps) } else { recorder.by_wall });
        Ok(pairs)
    }
}

impl Backend<f32> for GpuRenderer {
    fn can(&self, abilities: &Abilities) -> Result<()> {
        Self::refuses(abilities)
    }

    /// Errors in addition to those of every backend: the scene or the image is too large for WebGPU's limits.
    fn render(&mut self, shot: &Shot<'_, f32>, out: &mut Image<f32>) -> Result<()> {
        self.can(&shot.abilities())?;
        let (n, w, h) = (shot.splats.len(), shot.camera.width, shot.camera.height);
        self.timings = GpuTimings::default();
        self.stats = GpuStats { splats: n, ..GpuStats::default() };
        self.drawn.clear();
        reshape(&mut out.color, 3, h, w);
        reshape(&mut out.alpha, 1, h, w);
        reshape(&mut out.depth, usize::from(shot.depth), h, w);
        reshape(&mut out.extra, 0, h, w);
        if w == 0 || h == 0 { Ok(()) } else { self.draw_bands(shot, &mut Out::Planes(out)) }
    }

    fn render_bytes(&mut self, shot: &Shot<'_, f32>, out: &mut Vec<[u8; 4]>) -> Result<bool> {
        self.can(&shot.abilities())?;
        let (n, w, h) = (shot.splats.len(), shot.camera.width, shot.camera.height);
        self.timings = GpuTimings::default();
        self.stats = GpuStats { splats: n, ..GpuStats::default() };
        self.drawn.clear();
        out.resize(w * h, [0; 4]);
        if w > 0 && h > 0 {
            self.draw_bands(shot, &mut Out::Bytes(out))?;
        }
        Ok(true)
    }

    /// Errors in addition: a gradient that is not finite.
    fn vjp(
        &mut self,
        shot: &Shot<'_, f32>,
        grads: &ImageGrads<'_, f32>,
        d_sh: &mut [Option<&mut Table<f32>>],
        d: &mut RenderGrads<f32>,
    ) -> Result<()> {
        self.can(&Abilities { backward: true, ..shot.abilities() })?;
        self.backward_band(shot, grads, d_sh, d)
    }

    /// Errors in addition: a gradient that is not finite. `None` in addition: the image must be rendered in bands, or
    /// none of its pixels counts.
    fn compare(
        &mut self,
        shot: &Shot<'_, f32>,
        target: &Target<'_, f32>,
        d_sh: &mut [Option<&mut Table<f32>>],
        d: &mut RenderGrads<f32>,
    ) -> Result<Option<Comparison>> {
        self.can(&Abilities { backward: true, ..shot.abilities() })?;
        if shot.depth { Ok(None) } else { self.compare_here(shot, target, d_sh, d) }
    }

    fn resident(&mut self) -> Option<&mut dyn Resident> {
        Some(self)
    }

    fn radii(&self) -> &[f32] {
        &self.returned.radii
    }

    fn config(&self) -> &RenderConfig {
        &self.config
    }

    fn name(&self) -> &str {
        self.gpu.name()
    }
}

/// Work of a submission in addition to rendering a band.
#[derive(Clone, Copy, Debug, Default)]
struct Way {
    /// Of the backward pass, flags and position of the sums in `Blend`.
    flags: u32,
    sums_at: u32,
    /// Whether records are added to those of earlier bands.
    further: bool,
    /// Whether the planes are those of the whole image, and not of the band.
    whole: bool,
    /// 1 + the view of a step on tables that stay (scan.wgsl); 0: of none.
    view: u32,
}

/// Destination of an image.
enum Out<'a> {
    Planes(&'a mut Image<f32>),
    /// Red, green, blue, alpha of every pixel.
    Bytes(&'a mut [[u8; 4]]),
}

/// Copies the planes of a band into the image, from pixel row `first` on; the depth only where it is rendered.
fn read_planes(bytes: &[u8], first: usize, rows: usize, out: &mut Image<f32>) {
    let width = out.alpha.width;
    let Image { color, alpha, depth, .. } = out;
    let pixels = color.height * width;
    let targets = color.data.chunks_mut(pixels).chain([&mut alpha.data[..]]).chain(depth.data.chunks_mut(pixels));
    let sources = bytes.chunks(4 * width * rows);
    let pairs: Vec<_> = targets.zip(sources).collect();
    pairs.into_par_iter().for_each(|(target, source)| {
        let target = &mut target[first * width..(first + rows) * width];
        bytemuck::cast_slice_mut::<f32, u8>(target).copy_from_slice(source);
    });
}

/// Rows of pixels of a band in an image of `height`.
fn pixel_rows(band: Band, height: usize) -> usize {
    (band.rows * TILE).min(height - band.first * TILE)
}

/// Bytes of the state of a tile's pixels before a bucket of splats (rasterize.wgsl): five numbers a pixel.
const STATE_BYTES: u64 = 4 * 5 * (TILE * TILE) as u64;

/// Bytes of the states of a band: of every bucket of `pairs` pairs, and of one more per tile, whose last one need not be
/// full. None without lanes.
fn state_bytes(gpu: &Gpu, pairs: usize, tiles: usize) -> u64 {
    match gpu.lanes() {
        0 => 0,
        lanes => STATE_BYTES * (pairs / lanes + tiles + 1) as u64,
    }
}

/// Bytes of a band's planes, rows beyond the image included.
fn plane_bytes(band: Band, width: usize) -> u64 {
    (4 * PLANES * width * band.rows * TILE) as u64
}

/// First byte of the counts in the memory that the CPU reads.
fn counts_at(planes: u64) -> u64 {
    planes.next_multiple_of(UNIFORM_STRIDE)
}

/// Bytes of the sort's counts for this many pairs.
fn sort_bytes(gpu: &Gpu, pairs: u64) -> u64 {
    4 * DIGITS as u64 * (pairs.div_ceil(gpu.tuning.block() as u64) + 1)
}

/// Writes a structure into its slot.
fn put<T: bytemuck::NoUninit>(out: &mut [u8], slot: usize, data: &[T]) {
    let bytes = bytemuck::cast_slice(data);
    out[slot * UNIFORM_STRIDE as usize..][..bytes.len()].copy_from_slice(bytes);
}

/// `struct View` of project.wgsl, as the bits of its 32 numbers.
fn view(shot: &Shot<'_, f32>, config: &RenderConfig, splats: usize) -> [u32; 32] {
    let camera = shot.camera;
    let pose = &camera.cam_from_world;
    let (r, t, k, center) = (&pose.rotation, &pose.translation, &camera.intrinsics, camera.center());
    let mut out = [0; 32];
    for column in 0..3 {
        for row in 0..3 {
            out[4 * column + row] = (r[row][column] as f32).to_bits();
        }
        out[12 + column] = (t[column] as f32).to_bits();
        out[24 + column] = (center[column] as f32).to_bits();
    }
    out[15] = 1f32.to_bits();
    let numbers = [k.fx, k.fy, k.cx, k.cy, camera.width as f64, camera.height as f64, camera.near, config.low_pass];
    for (to, v) in out[16..24].iter_mut().zip(numbers) {
        *to = (v as f32).to_bits();
    }
    out[27] = (config.alpha_limits()[0] as f32).to_bits();
    out[28] = shot.sh_degree.min(crate::math::sh::MAX_DEGREE) as u32;
    out[29] = splats as u32;
    out[31] = if config.antialias == Antialias::On { FLAG_ANTIALIAS } else { 0 };
    out
}

/// Sizes planes that are about to be overwritten.
fn reshape(planes: &mut Planes<f32>, channels: usize, height: usize, width: usize) {
    (planes.channels, planes.height, planes.width) = (channels, height, width);
    planes.data.resize(channels * height * width, 0.0);
}
