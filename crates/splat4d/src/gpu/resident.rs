//! Tables that stay on the GPU: motion, rendering, loss and Adam run there without a transfer to the CPU.
//! Densification, files and other readers of a scene download the tables and upload their changes.
//!
//! Tables of more rows than a binding holds are in pages of whole blocks, each with buffers and dispatches of its own;
//! every row has a thread to itself, so that pages change no bit of the tables.

mod cameras;
mod film;
mod flight;
#[cfg(test)]
mod tests;
mod ties;
mod uniforms;

use super::buffers::{Buffers, Grown, UNIFORM_STRIDE, largest_binding};
use super::clock::{Recorder, Stage};
use super::device::Gpu;
use super::frame::{count, slot};
use super::kernels::{Kernel, ResidentKernels};
use super::limits::{GEOMETRY_WIDTH, THREADS};
use super::upload::Upload;
use super::{GpuRenderer, MOST_GROUPS};
use crate::render::{
    KEPT, Moves, Resident, ResidentCameras, ResidentLayer, ResidentNumbers, ResidentStep, ResidentStepped,
    ResidentTable, RowWeights,
};
use crate::scene::{BLOCK, LifeKind};
use crate::{Error, ErrorKind, Result};
use cameras::Cameras;
use flight::Begun;
pub(super) use flight::{AHEAD, Flights};
use std::borrow::Cow;
use std::ops::Range;
use ties::Tied;
use uniforms::{MOST_COLUMNS, Query, RecordRule, Rule};

/// Number of the SH table; those before it are contiguous in one buffer.
const SH: usize = KEPT - 1;
/// Columns of a row's statistics.
const STATS_WIDTH: usize = 3;
/// Pieces in which Adam processes the widest table: three blocks of SH of degree 3.
const PIECES: usize = 3;
/// Structures per page in the buffer of uniforms: the query, a rule per piece of a table, losses on rows, noise, ties.
mod at {
    pub(super) const QUERY: usize = 0;
    pub(super) const RULES: usize = 1;
    pub(super) const ROWS: usize = RULES + super::KEPT * super::PIECES;
    pub(super) const NOISE: usize = ROWS + 1;
    pub(super) const TIES: usize = ROWS + 2;
    pub(super) const ALL: usize = ROWS + 3;
}

/// Words of a step's status that are its own, and those of each of its views (record.wgsl).
const STEP_WORDS: usize = 8;
const VIEW_WORDS: usize = 8;

/// The tables of one layer, or of a page of its rows.
#[derive(Debug)]
struct ResidentBuffers {
    /// Number of the layer, and of its first row here.
    layer: usize,
    first_row: usize,
    rows: usize,
    moves: Moves,
    life: LifeKind,
    widths: [usize; KEPT],
    /// All tables but the SH.
    params: Grown,
    d_params: Grown,
    moments: Grown,
    d_sh: Grown,
    sh_moments: Grown,
    stats: Grown,
    alive: Grown,
    ties: Option<Tied>,
}

impl ResidentBuffers {
    fn new(index: usize, layer: &ResidentLayer<'_>, page: &Range<usize>) -> Self {
        Self {
            layer: index,
            first_row: page.start,
            rows: page.len(),
            moves: layer.moves,
            life: layer.life,
            widths: layer.tables.each_ref().map(|t| t.width),
            params: Grown::storage("a layer's tables"),
            d_params: Grown::storage("a layer's gradients"),
            moments: Grown::storage("a layer's moments"),
            d_sh: Grown::storage("gradients of a layer's colours"),
            sh_moments: Grown::storage("moments of a layer's colours"),
            stats: Grown::storage("a layer's statistics"),
            alive: Grown::storage("a layer's living rows"),
            ties: None,
        }
    }

    fn bytes(&self) -> u64 {
        let all = [&self.params, &self.d_params, &self.moments, &self.d_sh, &self.sh_moments, &self.stats, &self.alive];
        all.iter().map(|b| b.bytes()).sum::<u64>() + self.ties.as_ref().map_or(0, Tied::bytes)
    }

    /// First column of a table but the SH, and of its moments.
    fn first(&self, table: usize) -> [usize; 2] {
        let before = &self.widths[..table];
        [before.iter().sum(), before.iter().map(|w| moments_width(*w)).sum()]
    }

    /// Columns of the buffer of parameters, and of the moments'.
    fn strides(&self) -> [usize; 2] {
        self.first(SH)
    }

    fn groups(&self) -> u32 {
        self.rows.div_ceil(THREADS) as u32
    }

    /// The same of the kernels whose workgroups may have another size.
    fn row_groups(&self, gpu: &Gpu) -> u32 {
        self.rows.div_ceil(gpu.tuning.row_threads) as u32
    }

    /// The kernels of its motion.
    fn kernels<'a>(&self, k: &'a ResidentKernels) -> [&'a Kernel; 2] {
        match self.moves {
            Moves::Sliced { .. } => [&k.slice_answer, &k.slice_back],
            _ => [&k.answer, &k.answer_back],
        }
    }

    /// First columns of the pieces in which Adam processes a table.
    fn pieces(&self, table: usize) -> impl Iterator<Item = usize> {
        (0..self.widths[table]).step_by(MOST_COLUMNS)
    }
}

/// Columns of the moments of a table; one without columns has none.
fn moments_width(width: usize) -> usize {
    if width == 0 { 0 } else { 2 * width + 1 }
}

/// Everything that stays.
#[derive(Debug)]
pub(super) struct Tables {
    layers: usize,
    /// Page after page of layer after layer.
    pages: Vec<ResidentBuffers>,
    /// Geometry and SH of the pages, for rendering.
    upload: Upload,
    kernels: ResidentKernels,
    uniforms: Grown,
    corrections: Grown,
    counted: usize,
    cameras: Cameras,
    status: Grown,
    staging: Grown,
}

impl Tables {
    fn new(gpu: &Gpu) -> Self {
        Self {
            layers: 0,
            pages: Vec::new(),
            upload: Upload::default(),
            kernels: ResidentKernels::new(gpu),
            uniforms: Grown::new("uniforms", wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST),
            corrections: Grown::storage("corrections of Adam"),
            counted: 0,
            cameras: Cameras::new(),
            status: Grown::storage("a step's status"),
            staging: Grown::new("tables", wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST),
        }
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> u64 {
        let own = [&self.uniforms, &self.corrections, &self.staging, &self.status, self.cameras.buffer()];
        let own: u64 = own.iter().map(|b| b.bytes()).sum();
        self.upload.bytes() + own + self.pages.iter().map(ResidentBuffers::bytes).sum::<u64>()
    }

    /// Status record of a step of this many views.
    fn status(&self, views: usize) -> Status {
        let bad = STEP_WORDS + VIEW_WORDS * views;
        let alive = bad + self.layers * KEPT;
        let mut next = alive + self.layers;
        let mut place = |groups: usize| {
            let first = next;
            next += groups;
            first
        };
        let groups = |l: &ResidentBuffers| [l.groups() as usize, l.ties.as_ref().map_or(0, |t| t.groups() as usize)];
        let sums = self.pages.iter().map(groups).map(|groups| groups.map(&mut place)).collect();
        Status { bad, alive, sums, words: next }
    }

    fn rows(&self) -> usize {
        self.pages.iter().map(|l| l.rows).sum()
    }

    fn uniform(&self, at: usize, size: usize) -> wgpu::BindingResource<'_> {
        wgpu::BindingResource::Buffer(wgpu::BufferBinding {
            buffer: self.uniforms.get(),
            offset: at as u64 * UNIFORM_STRIDE,
            size: std::num::NonZeroU64::new(size as u64),
        })
    }

    /// The query to a page.
    fn query(&self, page: usize) -> wgpu::BindingResource<'_> {
        self.uniform(page * at::ALL + at::QUERY, size_of::<Query>())
    }

    /// Rows to splats.
    fn answer(&self, gpu: &Gpu, b: &Buffers, upload: &Upload, recorder: &mut Recorder<'_>) -> Result<()> {
        let bind = |(i, page): (usize, &ResidentBuffers)| {
            let part = &upload.parts[i];
            let mut group = vec![self.query(i), page.params.all(), part.geometry.all(), page.alive.all()];
            if matches!(page.moves, Moves::Sliced { .. }) {
                group.push(part.weights.all());
            }
            group.push(b.counts.all());
            let [kernel, _] = page.kernels(&self.kernels);
            Run::new(gpu, kernel, 0, &group, page.row_groups(gpu))
        };
        let runs: Vec<_> = self.pages.iter().enumerate().map(bind).collect();
        recorder.stage(Stage::Answer, |pass| runs.iter().for_each(|run| run.record(pass)))
    }
}

/// The words of a step behind those of record.wgsl.
#[derive(Debug)]
struct Status {
    /// One per table: one more than the last row whose number is not finite.
    bad: usize,
    /// Rows alive, by layer.
    alive: usize,
    /// By page the first sums of losses on rows and of ties, one a workgroup.
    sums: Vec<[usize; 2]>,
    /// All of them.
    words: usize,
}

/// Tables side by side: block by block, the columns of one after those of the other.
fn side_by_side(tables: &[(&[f32], usize)]) -> Vec<f32> {
    let stride: usize = tables.iter().map(|t| t.1).sum();
    let blocks = tables.iter().find(|t| t.1 > 0).map_or(0, |(data, width)| data.len() / (width * BLOCK));
    let mut out = Vec::with_capacity(blocks * stride * BLOCK);
    for b in 0..blocks {
        for (data, width) in tables {
            out.extend_from_slice(&data[b * width * BLOCK..(b + 1) * width * BLOCK]);
        }
    }
    out
}

/// The rows of a page, of whole blocks, of a table with this many columns.
fn cut<'a>(data: &'a [f32], width: usize, page: &Range<usize>) -> &'a [f32] {
    &data[page.start * width..page.end * width]
}

/// The moments of a page of a table: zeros where it has not learnt.
fn history<'a>(table: &ResidentTable<'a>, page: &Range<usize>) -> Cow<'a, [f32]> {
    let width = moments_width(table.width);
    match table.moments.is_empty() {
        true => Cow::Owned(vec![0.0; page.len() * width]),
        false => Cow::Borrowed(cut(table.moments, width, page)),
    }
}

/// The inverse: some columns of contiguous tables.
fn apart(all: &[f32], stride: usize, columns: Range<usize>) -> Vec<f32> {
    all.chunks_exact(stride.max(1) * BLOCK)
        .flat_map(|block| &block[columns.start * BLOCK..columns.end * BLOCK])
        .copied()
        .collect()
}

fn send<T: bytemuck::NoUninit>(gpu: &Gpu, buffer: &mut Grown, data: &[T]) -> Result<()> {
    buffer.ensure(gpu, size_of_val(data) as u64)?;
    if !data.is_empty() {
        gpu.queue.write_buffer(buffer.get(), 0, bytemuck::cast_slice(data));
    }
    Ok(())
}

/// One view of a step.
struct ResidentPass<'a> {
    tables: &'a Tables,
    step: &'a Begun,
    view: usize,
}

impl ResidentPass<'_> {
    fn is_last(&self) -> bool {
        self.view + 1 == self.step.views.len()
    }

    /// Whether there are losses on rows.
    fn has_row_losses(&self) -> bool {
        self.step.rows != RowWeights::default()
    }

    /// Writes queries and rules of learning, for an image of this many tiles.
    fn write_uniforms(&self, gpu: &Gpu, tiles: usize) {
        let Self { tables, step, view } = *self;
        let status = tables.status(step.views.len());
        let mut out = vec![0u8; (tables.pages.len() * at::ALL + 1) * UNIFORM_STRIDE as usize];
        let mut put =
            |at: usize, bytes: &[u8]| out[at * UNIFORM_STRIDE as usize..][..bytes.len()].copy_from_slice(bytes);
        let mut first_splat = 0;
        for (i, page) in tables.pages.iter().enumerate() {
            let slot = |at: usize| i * at::ALL + at;
            let query = Query::new(page, step.views[view].t, view == 0, step.alpha_min, first_splat);
            put(slot(at::QUERY), bytemuck::bytes_of(&query));
            first_splat += page.rows;
            for (table, rule) in step.rules[page.layer].iter().enumerate() {
                let Some(rule) = rule else { continue };
                for (piece, from) in page.pieces(table).enumerate() {
                    let word = status.bad + page.layer * KEPT + table;
                    let rule = Rule::new(page, table, from, rule, [tables.counted, word]);
                    put(slot(at::RULES + table * PIECES + piece), bytemuck::bytes_of(&rule));
                }
            }
            let [row_sums, tie_sums] = status.sums[i];
            let rows = uniforms::RowRule::new(&step.rows, [status.alive + page.layer, row_sums]);
            put(slot(at::ROWS), bytemuck::bytes_of(&rows));
            if let Some(noise) = &step.noise[page.layer] {
                put(slot(at::NOISE), bytemuck::bytes_of(&uniforms::Noise::new(noise)));
            }
            if let Some(ties) = &page.ties {
                put(slot(at::TIES), bytemuck::bytes_of(&ties.rule(tie_sums)));
            }
        }
        let record = RecordRule {
            tiles: tiles as u32,
            view: view as u32,
            camera: step.views[view].rig as u32,
            cameras: tables.cameras.count() as u32,
            bad_at: status.bad as u32,
            bad_words: (status.alive - status.bad) as u32,
            counted: tables.counted as u32,
            rate: step.cameras as f32,
        };
        put(tables.pages.len() * at::ALL, bytemuck::bytes_of(&record));
        gpu.queue.write_buffer(tables.uniforms.get(), 0, &out);
        if self.is_last() {
            let zeros = vec![0u8; 4 * (status.words - status.bad)];
            gpu.queue.write_buffer(tables.status.get(), 4 * status.bad as u64, &zeros);
        }
    }

    fn uniform(&self, at: usize, size: usize) -> wgpu::BindingResource<'_> {
        self.tables.uniform(at, size)
    }

    /// The query to a page.
    fn query(&self, page: usize) -> wgpu::BindingResource<'_> {
        self.tables.query(page)
    }

    /// The sums of the view, the gradients of splats to those of rows, and, after the step's last view, Adam and the
    /// record.
    fn learn(&self, gpu: &Gpu, b: &Buffers, upload: &Upload, recorder: &mut Recorder<'_>) -> Result<()> {
        let Tables { pages, kernels: k, status, corrections, cameras, .. } = self.tables;
        let words = status.all();
        let record = |entry: usize| {
            let rule = self.uniform(pages.len() * at::ALL, size_of::<RecordRule>());
            let (counts, partials) = (b.counts.all(), b.partials.all());
            let group = [rule, counts, partials, status.all(), cameras.buffer().all(), corrections.all()];
            Run::new(gpu, &k.record, entry, &group, 1)
        };
        let mut runs = vec![record(0)];
        for (i, layer) in pages.iter().enumerate() {
            let part = &upload.parts[i];
            let view = super::frame::uniform(b, slot::VIEW, super::frame::VIEW_BYTES);
            let colors = [
                view,
                self.query(i),
                b.counts.all(),
                part.geometry.all(),
                part.tables[0].all(),
                b.back.all(),
                layer.d_sh.all(),
                layer.stats.all(),
                part.weights.all(),
            ];
            runs.push(Run::new(gpu, &k.colors_back, 0, &colors, layer.row_groups(gpu)));
            let mut rows = vec![self.query(i), b.counts.all(), layer.params.all(), b.back.all()];
            if matches!(layer.moves, Moves::Sliced { .. }) {
                rows.push(part.weights.all());
            }
            rows.push(layer.d_params.all());
            runs.push(Run::new(gpu, layer.kernels(k)[1], 0, &rows, layer.row_groups(gpu)));
        }
        if self.is_last() {
            self.losses(gpu, b, &words, &mut runs);
        }
        recorder.stage(Stage::AnswerBack, |pass| runs.iter().for_each(|run| run.record(pass)))?;
        if !self.is_last() {
            return Ok(());
        }
        let mut runs = Vec::new();
        for (i, layer) in pages.iter().enumerate() {
            self.adam(gpu, b, upload, (i, layer), &words, &mut runs);
            if self.step.noise[layer.layer].is_some() {
                let noise = self.uniform(i * at::ALL + at::NOISE, size_of::<uniforms::Noise>());
                let group = [self.query(i), noise, b.counts.all(), layer.alive.all(), layer.params.all()];
                runs.push(Run::new(gpu, &k.shake, 0, &group, layer.row_groups(gpu)));
            }
        }
        if cameras.count() > 0 {
            runs.push(record(1));
        }
        runs.push(record(2));
        recorder.stage(Stage::Adam, |pass| runs.iter().for_each(|run| run.record(pass)))
    }

    /// Losses on rows, which add to their gradients.
    fn losses(&self, gpu: &Gpu, b: &Buffers, words: &wgpu::BindingResource<'_>, runs: &mut Vec<Run>) {
        let (k, pages) = (&self.tables.kernels, &self.tables.pages);
        if self.has_row_losses() {
            // All pages of a layer are counted before any takes its share.
            for entry in [0, 1] {
                for (i, layer) in pages.iter().enumerate() {
                    let rule = self.uniform(i * at::ALL + at::ROWS, size_of::<uniforms::RowRule>());
                    let (params, alive, d) = (layer.params.all(), layer.alive.all(), layer.d_params.all());
                    let group = [self.query(i), rule, b.counts.all(), params, alive, d, words.clone()];
                    runs.push(Run::new(gpu, &k.row_losses, entry, &group, layer.groups()));
                }
            }
        }
        for (i, layer) in pages.iter().enumerate() {
            let Some(ties) = &layer.ties else { continue };
            let rule = self.uniform(i * at::ALL + at::TIES, size_of::<uniforms::TieRule>());
            let [before, edges, links, turns] = ties.buffers();
            let (params, d) = (layer.params.all(), layer.d_params.all());
            let group = [self.query(i), rule, params, before, edges, links, turns, d, words.clone(), b.counts.all()];
            runs.extend([0, 1].map(|entry| Run::new(gpu, &k.ties, entry, &group, ties.groups())));
        }
    }

    fn adam(
        &self,
        gpu: &Gpu,
        b: &Buffers,
        upload: &Upload,
        (i, layer): (usize, &ResidentBuffers),
        words: &wgpu::BindingResource<'_>,
        runs: &mut Vec<Run>,
    ) {
        let Tables { kernels: k, corrections, .. } = self.tables;
        for table in (0..KEPT).filter(|&t| self.step.rules[layer.layer][t].is_some()) {
            let (params, d, moments) = if table == SH {
                (&upload.parts[i].tables[0], &layer.d_sh, &layer.sh_moments)
            } else {
                (&layer.params, &layer.d_params, &layer.moments)
            };
            for piece in 0..layer.pieces(table).count() {
                let rule = i * at::ALL + at::RULES + table * PIECES + piece;
                let group = [
                    self.uniform(rule, size_of::<Rule>()),
                    b.counts.all(),
                    params.all(),
                    d.all(),
                    moments.all(),
                    layer.alive.all(),
                    corrections.all(),
                    words.clone(),
                ];
                runs.push(Run::new(gpu, &k.adam, 0, &group, layer.row_groups(gpu)));
            }
        }
    }
}

/// An entry point over a layer's rows.
struct Run {
    pipeline: wgpu::ComputePipeline,
    group: wgpu::BindGroup,
    groups: u32,
}

impl Run {
    fn new(gpu: &Gpu, kernel: &Kernel, entry: usize, group: &[wgpu::BindingResource<'_>], groups: u32) -> Self {
        Self { pipeline: kernel.pipelines[entry].clone(), group: kernel.bind(gpu, group), groups }
    }

    fn record(&self, pass: &mut wgpu::ComputePass<'_>) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &self.group, &[]);
        pass.dispatch_workgroups(self.groups, 1, 1);
    }
}

impl GpuRenderer {
    /// Copies of the numbers in a buffer.
    fn fetch_buffer(&self, staging: &mut Grown, buffer: &Grown, numbers: usize) -> Result<Vec<f32>> {
        if numbers == 0 {
            return Ok(Vec::new());
        }
        let bytes = 4 * numbers as u64;
        staging.ensure(&self.gpu, bytes)?;
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(buffer.get(), 0, staging.get(), 0, bytes);
        self.gpu.queue.submit([encoder.finish()]);
        staging.get().map_async(wgpu::MapMode::Read, ..bytes, |_| ());
        self.gpu.wait()?;
        let lost = |e: wgpu::MapRangeError| {
            Error::new(ErrorKind::Unsupported, format!("tables cannot be read from the GPU ({e})"))
                .at(self.gpu.name())
                .remedy("Train on the CPU.")
        };
        let view = staging.get().get_mapped_range(..bytes).map_err(lost)?;
        let out = bytemuck::pod_collect_to_vec(&view);
        drop(view);
        staging.get().unmap();
        Ok(out)
    }
}

impl Resident for GpuRenderer {
    fn keep(
        &mut self,
        layers: &[ResidentLayer<'_>],
        cameras: Option<&ResidentCameras<'_>>,
        corrections: &[[f32; 2]],
    ) -> Result<()> {
        self.for_training()?;
        self.forget_flights()?;
        if self.resident.is_none() {
            self.resident = Some(Box::new(Tables::new(&self.gpu)));
        }
        self.buffers.counts.ensure(&self.gpu, 4 * count::ALL as u64)?;
        self.go_on();
        let (gpu, tables) = (&self.gpu, self.resident.as_deref_mut().expect("it was made"));
        gpu.check()?;
        if layers.iter().flat_map(|l| &l.tables).any(|t| t.width > MOST_COLUMNS * PIECES) {
            return Err(Error::new(ErrorKind::Unsupported, "the scene's tables have too many columns for the GPU"));
        }
        send(gpu, &mut tables.corrections, corrections.as_flattened())?;
        tables.counted = corrections.len();
        tables.cameras.keep(gpu, cameras)?;
        tables.layers = layers.len();
        let mut pages = Vec::new();
        for (i, layer) in layers.iter().enumerate() {
            let rows = self.page_rows.unwrap_or_else(|| page_rows(gpu, layer));
            if rows < layer.rows && layer.ties.is_some() {
                return Err(Error::new(
                    ErrorKind::Unsupported,
                    "the tied poses are too many for one buffer of the GPU",
                ));
            }
            let first = (0..layer.rows.max(1)).step_by(rows);
            pages.extend(first.map(|first| (i, first..layer.rows.min(first + rows))));
        }
        let groups = |page: &Range<usize>| page.len().div_ceil(gpu.tuning.row_threads.min(THREADS));
        if pages.iter().any(|(_, page)| groups(page) > MOST_GROUPS) {
            return Err(Error::new(ErrorKind::Unsupported, "the scene's tables have too many rows for the GPU"));
        }
        tables.uniforms.ensure(gpu, (pages.len() * at::ALL + 1) as u64 * UNIFORM_STRIDE)?;
        let size = |(i, page): &(usize, Range<usize>)| {
            let layer = &layers[*i];
            (page.len(), layer.tables[SH].width, layer.moves.blocks())
        };
        tables.upload.keep(gpu, &pages.iter().map(size).collect::<Vec<_>>())?;
        // The old ones' memory is used again where pages stayed.
        tables.pages.truncate(pages.len());
        for (at, (i, page)) in pages.into_iter().enumerate() {
            let layer = &layers[i];
            let fresh = ResidentBuffers::new(i, layer, &page);
            if at == tables.pages.len() {
                tables.pages.push(fresh);
            } else {
                let ResidentBuffers { layer, first_row, rows, moves, life, widths, .. } = fresh;
                let old = &mut tables.pages[at];
                (old.layer, old.first_row, old.rows) = (layer, first_row, rows);
                (old.moves, old.life, old.widths) = (moves, life, widths);
            }
            let kept = &mut tables.pages[at];
            let page = page.start..page.end.next_multiple_of(BLOCK);
            let small = &layer.tables[..SH];
            let params: Vec<_> = small.iter().map(|t| (cut(t.params, t.width, &page), t.width)).collect();
            let histories: Vec<_> = small.iter().map(|t| (history(t, &page), moments_width(t.width))).collect();
            let moments: Vec<_> = histories.iter().map(|(data, width)| (&data[..], *width)).collect();
            let params = side_by_side(&params);
            send(gpu, &mut kept.params, &params)?;
            kept.d_params.ensure(gpu, size_of_val(&params[..]) as u64)?;
            send(gpu, &mut kept.moments, &side_by_side(&moments))?;
            let sh = &layer.tables[SH];
            let colors = cut(sh.params, sh.width, &page);
            send(gpu, &mut tables.upload.parts[at].tables[0], colors)?;
            kept.d_sh.ensure(gpu, size_of_val(colors) as u64)?;
            send(gpu, &mut kept.sh_moments, &history(sh, &page))?;
            send(gpu, &mut kept.stats, cut(layer.stats, STATS_WIDTH, &page))?;
            kept.alive.ensure(gpu, 4 * kept.rows as u64)?;
            kept.ties = layer.ties.map(|ties| Tied::new(gpu, ties)).transpose()?;
        }
        gpu.check()
    }

    fn holds(&mut self, picture: usize, size: [usize; 2], weighted: bool) -> bool {
        self.pictures.holds(picture, size, weighted)
    }

    fn step(&mut self, step: &ResidentStep<'_>) -> Result<Option<Vec<ResidentStepped>>> {
        self.begin(step)
    }

    fn finish(&mut self) -> Result<Vec<ResidentStepped>> {
        self.land_all()
    }

    fn stages(&self) -> Vec<(&'static str, f64)> {
        self.timings.stages().to_vec()
    }

    fn fetch(&mut self, layer: usize) -> Result<ResidentNumbers> {
        let mut tables = self.resident.take().expect("tables are kept before they are fetched");
        let out = self.fetch_layer(&mut tables, layer);
        self.resident = Some(tables);
        out
    }

    fn fetch_cameras(&mut self) -> Result<[Vec<f32>; 2]> {
        let mut tables = self.resident.take().expect("tables are kept before they are fetched");
        let Tables { cameras, staging, .. } = &mut *tables;
        let numbers = self.fetch_buffer(staging, cameras.buffer(), cameras.numbers());
        let out = numbers.map(|numbers| cameras.apart(&numbers));
        self.resident = Some(tables);
        out
    }
}

impl GpuRenderer {
    fn fetch_layer(&self, tables: &mut Tables, layer: usize) -> Result<ResidentNumbers> {
        let Tables { pages, upload, staging, .. } = tables;
        let mut out = ResidentNumbers::default();
        for (at, kept) in pages.iter().enumerate().filter(|(_, page)| page.layer == layer) {
            let padded = kept.rows.next_multiple_of(BLOCK);
            let [stride, moments_stride] = kept.strides();
            let params = self.fetch_buffer(staging, &kept.params, stride * padded)?;
            let moments = self.fetch_buffer(staging, &kept.moments, moments_stride * padded)?;
            for t in 0..SH {
                let [first, first_moment] = kept.first(t);
                out.params[t].extend(apart(&params, stride, first..first + kept.widths[t]));
                let columns = first_moment..first_moment + moments_width(kept.widths[t]);
                out.moments[t].extend(apart(&moments, moments_stride, columns));
            }
            let width = kept.widths[SH];
            out.stats.extend(self.fetch_buffer(staging, &kept.stats, STATS_WIDTH * padded)?);
            out.params[SH].extend(self.fetch_buffer(staging, &upload.parts[at].tables[0], width * padded)?);
            out.moments[SH].extend(self.fetch_buffer(staging, &kept.sh_moments, moments_width(width) * padded)?);
        }
        Ok(out)
    }
}

/// Rows of a page of a layer: whole blocks, as many as fit into each of its buffers.
fn page_rows(gpu: &Gpu, layer: &ResidentLayer<'_>) -> usize {
    let small = layer.tables[..SH].iter();
    let [params, moments] = small.fold([0, 0], |[p, m], t| [p + t.width, m + moments_width(t.width)]);
    let widest = [params, moments, layer.tables[SH].width, moments_width(layer.tables[SH].width), GEOMETRY_WIDTH];
    let bytes = 4 * widest.into_iter().max().expect("there are some") as u64;
    let rows = usize::try_from(largest_binding(gpu) / bytes).unwrap_or(usize::MAX);
    (rows / BLOCK).max(1) * BLOCK
}

const _: () = assert!(count::PAIRS == 2 && count::STOP == 3, "the shaders read them there");
