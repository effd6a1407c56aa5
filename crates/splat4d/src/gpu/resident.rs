//! Tables that stay on the GPU: rows become splats, splats a picture, and its loss steps of Adam, without a number of them
//! passing through the CPU. Densification, files and whatever else looks at a scene fetch the tables, and hand them back.

#[cfg(test)]
mod tests;
mod ties;
mod uniforms;

use super::buffers::{Buffers, Grown, UNIFORM_STRIDE};
use super::clock::{Recorder, Stage};
use super::device::Gpu;
use super::frame::{THREADS, count, slot};
use super::kernels::{Kernel, ResidentKernels};
use super::upload::Upload;
use super::{GpuRenderer, MOST_GROUPS};
use crate::render::{
    KEPT, KeptLayer, KeptNumbers, KeptStep, KeptStepped, KeptTable, Moves, Resident, RowWeights, Shot,
};
use crate::scene::{BLOCK, LifeKind, Splats};
use crate::{Error, ErrorKind, Result};
use std::borrow::Cow;
use std::ops::Range;
use ties::Tied;
use uniforms::{Ask, MOST_COLUMNS, Rule};

/// Number of the SH table; those before it lie side by side in one buffer.
const SH: usize = KEPT - 1;
/// Columns of the geometry that splats are made of (mean, covariance, opacity) and of a row's statistics.
const GEOMETRY_WIDTH: usize = 10;
const STATS_WIDTH: usize = 3;
/// Pieces in which Adam takes the widest table: three blocks of SH of degree 3.
const PIECES: usize = 3;
/// Structures a layer in the buffer of uniforms: what is asked, a rule a piece of a table, losses on rows, noise, ties.
mod at {
    pub(super) const ASK: usize = 0;
    pub(super) const RULES: usize = 1;
    pub(super) const ROWS: usize = RULES + super::KEPT * super::PIECES;
    pub(super) const NOISE: usize = ROWS + 1;
    pub(super) const TIES: usize = ROWS + 2;
    pub(super) const ALL: usize = ROWS + 3;
}

/// The tables of one layer.
#[derive(Debug)]
struct Kept {
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

impl Kept {
    fn new(layer: &KeptLayer<'_>) -> Self {
        Self {
            rows: layer.rows,
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

    /// First columns of the pieces in which Adam takes a table.
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
    layers: Vec<Kept>,
    /// Geometry and SH of the layers, as they are drawn.
    upload: Upload,
    kernels: ResidentKernels,
    uniforms: Grown,
    corrections: Grown,
    counted: usize,
    staging: Grown,
}

impl Tables {
    fn new(gpu: &Gpu) -> Self {
        Self {
            layers: Vec::new(),
            upload: Upload::default(),
            kernels: ResidentKernels::new(gpu),
            uniforms: Grown::new("uniforms", wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST),
            corrections: Grown::storage("corrections of Adam"),
            counted: 0,
            staging: Grown::new("tables", wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST),
        }
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> u64 {
        let own = [&self.uniforms, &self.corrections, &self.staging].map(Grown::bytes);
        self.upload.bytes() + own.iter().sum::<u64>() + self.layers.iter().map(Kept::bytes).sum::<u64>()
    }

    /// What steps leave in their status.
    fn status(&self) -> Status {
        let groups = |f: &dyn Fn(&Kept) -> usize| -> Vec<usize> { self.layers.iter().map(f).collect() };
        let rows = groups(&|l| l.groups() as usize);
        let ties = groups(&|l| l.ties.as_ref().map_or(0, |t| t.groups() as usize));
        let mut next = self.layers.len() * (KEPT + 1);
        let mut place = |groups: usize| {
            let first = next;
            next += groups;
            first
        };
        let sums = rows.iter().zip(&ties).map(|(rows, ties)| [place(*rows), place(*ties)]).collect();
        Status { bad: 0, alive: self.layers.len() * KEPT, sums, words: next }
    }

    fn rows(&self) -> usize {
        self.layers.iter().map(|l| l.rows).sum()
    }
}

/// The words that a step leaves behind the loss's sums, from 0 on.
#[derive(Debug)]
struct Status {
    /// One a table: one more than the last row whose number is not finite.
    bad: usize,
    /// Rows alive, by layer.
    alive: usize,
    /// By layer the first sums of losses on rows and of ties, one a workgroup.
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

/// The moments of a table of so many rows: zeros where it has not learnt.
fn history<'a>(table: &KeptTable<'a>, rows: usize) -> Cow<'a, [f32]> {
    let numbers = rows * moments_width(table.width);
    if table.moments.is_empty() { Cow::Owned(vec![0.0; numbers]) } else { Cow::Borrowed(table.moments) }
}

/// The other way round: some columns of tables that lie side by side.
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
pub(super) struct KeptPass<'a> {
    tables: &'a Tables,
    step: &'a KeptStep<'a>,
    view: usize,
}

impl KeptPass<'_> {
    fn is_last(&self) -> bool {
        self.view + 1 == self.step.views.len()
    }

    /// Words behind the loss's numbers in its buffer.
    pub(super) fn words(&self) -> usize {
        self.tables.status().words
    }

    /// Whether losses look at rows.
    fn has_row_losses(&self) -> bool {
        self.step.rows != RowWeights::default()
    }

    /// Writes what is asked and by which rules is learnt, for so many pairs.
    pub(super) fn write_uniforms(&self, gpu: &Gpu, capacity: usize) {
        let Self { tables, step, view } = *self;
        let status = tables.status();
        let mut out = vec![0u8; tables.layers.len() * at::ALL * UNIFORM_STRIDE as usize];
        let mut put =
            |at: usize, bytes: &[u8]| out[at * UNIFORM_STRIDE as usize..][..bytes.len()].copy_from_slice(bytes);
        let mut first_splat = 0;
        for (i, layer) in tables.layers.iter().enumerate() {
            let slot = |at: usize| i * at::ALL + at;
            let ask = Ask::new(layer, step, view, first_splat, capacity);
            put(slot(at::ASK), bytemuck::bytes_of(&ask));
            first_splat += layer.rows;
            for (table, rule) in step.rules[i].iter().enumerate() {
                let Some(rule) = rule else { continue };
                for (piece, from) in layer.pieces(table).enumerate() {
                    let [counted, word] = [tables.counted, status.bad + i * KEPT + table];
                    let rule = Rule::new(layer, table, from, rule, [counted, word, capacity]);
                    put(slot(at::RULES + table * PIECES + piece), bytemuck::bytes_of(&rule));
                }
            }
            let [row_sums, tie_sums] = status.sums[i];
            put(slot(at::ROWS), bytemuck::bytes_of(&uniforms::RowRule::new(&step.rows, [status.alive + i, row_sums])));
            if let Some(noise) = &step.noise[i] {
                put(slot(at::NOISE), bytemuck::bytes_of(&uniforms::Noise::new(noise)));
            }
            if let Some(ties) = &layer.ties {
                put(slot(at::TIES), bytemuck::bytes_of(&ties.rule(tie_sums)));
            }
        }
        gpu.queue.write_buffer(tables.uniforms.get(), 0, &out);
    }

    fn uniform(&self, at: usize, size: usize) -> wgpu::BindingResource<'_> {
        wgpu::BindingResource::Buffer(wgpu::BufferBinding {
            buffer: self.tables.uniforms.get(),
            offset: at as u64 * UNIFORM_STRIDE,
            size: std::num::NonZeroU64::new(size as u64),
        })
    }

    /// What is asked of a layer.
    fn ask(&self, layer: usize) -> wgpu::BindingResource<'_> {
        self.uniform(layer * at::ALL + at::ASK, size_of::<Ask>())
    }

    /// Rows to splats.
    pub(super) fn answer(&self, gpu: &Gpu, upload: &Upload, recorder: &mut Recorder<'_>) -> Result<()> {
        let bind = |(i, layer): (usize, &Kept)| {
            let part = &upload.parts[i];
            let mut group = vec![self.ask(i), layer.params.all(), part.geometry.all(), layer.alive.all()];
            if matches!(layer.moves, Moves::Sliced { .. }) {
                group.push(part.weights.all());
            }
            let [kernel, _] = layer.kernels(&self.tables.kernels);
            Run::new(gpu, kernel, 0, &group, layer.row_groups(gpu))
        };
        let runs: Vec<_> = self.tables.layers.iter().enumerate().map(bind).collect();
        recorder.stage(Stage::Answer, |pass| runs.iter().for_each(|run| run.record(pass)))
    }

    /// The gradients of splats to those of rows, and, after the step's last view, Adam. `status_at`: where in the loss's buffer the
    /// words are.
    pub(super) fn learn(
        &self,
        gpu: &Gpu,
        b: &Buffers,
        upload: &Upload,
        status_at: u64,
        recorder: &mut Recorder<'_>,
    ) -> Result<()> {
        let Tables { layers, kernels: k, .. } = self.tables;
        let mut runs = Vec::new();
        for (i, layer) in layers.iter().enumerate() {
            let part = &upload.parts[i];
            let view = super::frame::uniform(b, slot::VIEW, super::frame::VIEW_BYTES);
            let colors = [
                view,
                self.ask(i),
                b.counts.all(),
                part.geometry.all(),
                part.tables[0].all(),
                b.back.all(),
                layer.d_sh.all(),
                layer.stats.all(),
                part.weights.all(),
            ];
            runs.push(Run::new(gpu, &k.colors_back, 0, &colors, layer.row_groups(gpu)));
            let mut rows = vec![self.ask(i), b.counts.all(), layer.params.all(), b.back.all()];
            if matches!(layer.moves, Moves::Sliced { .. }) {
                rows.push(part.weights.all());
            }
            rows.push(layer.d_params.all());
            runs.push(Run::new(gpu, layer.kernels(k)[1], 0, &rows, layer.row_groups(gpu)));
        }
        let words = wgpu::BindingResource::Buffer(wgpu::BufferBinding {
            buffer: b.partials.get(),
            offset: status_at,
            size: std::num::NonZeroU64::new((4 * self.words()) as u64),
        });
        if self.is_last() {
            layers.iter().enumerate().for_each(|(i, layer)| self.losses(gpu, b, (i, layer), &words, &mut runs));
        }
        recorder.stage(Stage::AnswerBack, |pass| runs.iter().for_each(|run| run.record(pass)))?;
        if !self.is_last() {
            return Ok(());
        }
        let mut runs = Vec::new();
        for (i, layer) in layers.iter().enumerate() {
            self.adam(gpu, b, upload, (i, layer), &words, &mut runs);
            if self.step.noise[i].is_some() {
                let noise = self.uniform(i * at::ALL + at::NOISE, size_of::<uniforms::Noise>());
                let group = [self.ask(i), noise, b.counts.all(), layer.alive.all(), layer.params.all()];
                runs.push(Run::new(gpu, &k.shake, 0, &group, layer.row_groups(gpu)));
            }
        }
        recorder.stage(Stage::Adam, |pass| runs.iter().for_each(|run| run.record(pass)))
    }

    /// Losses that look at rows, which add to their gradients.
    fn losses(
        &self,
        gpu: &Gpu,
        b: &Buffers,
        (i, layer): (usize, &Kept),
        words: &wgpu::BindingResource<'_>,
        runs: &mut Vec<Run>,
    ) {
        let k = &self.tables.kernels;
        if self.has_row_losses() {
            let rule = self.uniform(i * at::ALL + at::ROWS, size_of::<uniforms::RowRule>());
            let (params, alive, d) = (layer.params.all(), layer.alive.all(), layer.d_params.all());
            let group = [self.ask(i), rule, b.counts.all(), params, alive, d, words.clone()];
            runs.extend([0, 1].map(|entry| Run::new(gpu, &k.row_losses, entry, &group, layer.groups())));
        }
        if let Some(ties) = &layer.ties {
            let rule = self.uniform(i * at::ALL + at::TIES, size_of::<uniforms::TieRule>());
            let [before, edges, links, turns] = ties.buffers();
            let (params, d) = (layer.params.all(), layer.d_params.all());
            let group = [self.ask(i), rule, params, before, edges, links, turns, d, words.clone(), b.counts.all()];
            runs.extend([0, 1].map(|entry| Run::new(gpu, &k.ties, entry, &group, ties.groups())));
        }
    }

    fn adam(
        &self,
        gpu: &Gpu,
        b: &Buffers,
        upload: &Upload,
        (i, layer): (usize, &Kept),
        words: &wgpu::BindingResource<'_>,
        runs: &mut Vec<Run>,
    ) {
        let Tables { kernels: k, corrections, .. } = self.tables;
        for table in (0..KEPT).filter(|&t| self.step.rules[i][t].is_some()) {
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
    /// Does something with the tables that stay, whose drawn parts take the place of the last scene's meanwhile.
    fn with_tables<T>(&mut self, f: impl FnOnce(&mut Self, &Tables) -> T) -> T {
        let mut tables = self.resident.take().expect("tables are kept before steps are taken");
        std::mem::swap(&mut self.upload, &mut tables.upload);
        let out = f(self, &tables);
        std::mem::swap(&mut self.upload, &mut tables.upload);
        self.resident = Some(tables);
        out
    }

    fn step_kept(&mut self, tables: &Tables, step: &KeptStep<'_>) -> Result<Option<KeptStepped>> {
        let mut comparisons = Vec::new();
        let mut words = Vec::new();
        let nothing = Splats::default();
        for (i, view) in step.views.iter().enumerate() {
            let shot = Shot { sh_degree: step.sh_degree, ..Shot::new(&nothing, view.camera, view.background) };
            let pass = KeptPass { tables, step, view: i };
            let Some((came, comparison)) = self.compare_with(&shot, &view.target, tables.rows(), Some(&pass))? else {
                return Ok(None);
            };
            comparisons.push(comparison);
            words = came.words;
        }
        let status = tables.status();
        let bad = words[..status.alive].iter().position(|w| *w != 0);
        let bad = bad.map(|at| [at / KEPT, at % KEPT, words[at] as usize - 1]);
        let first = status.sums.first().map_or(status.words, |sums| sums[0]);
        let loss = words[first..].iter().map(|bits| f64::from(f32::from_bits(*bits))).sum();
        Ok(Some(KeptStepped { comparisons, loss, bad }))
    }

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
    fn keep(&mut self, layers: &[KeptLayer<'_>], corrections: &[[f32; 2]]) -> Result<()> {
        self.for_training()?;
        if self.resident.is_none() {
            self.resident = Some(Box::new(Tables::new(&self.gpu)));
        }
        let (gpu, tables) = (&self.gpu, self.resident.as_deref_mut().expect("it was made"));
        gpu.check()?;
        let most = layers.iter().map(|l| l.rows.div_ceil(gpu.tuning.row_threads.min(THREADS))).max().unwrap_or(0);
        let wide = layers.iter().flat_map(|l| &l.tables).any(|t| t.width > MOST_COLUMNS * PIECES);
        if most > MOST_GROUPS || wide {
            return Err(Error::new(ErrorKind::Unsupported, "the scene's tables are too large for the GPU"));
        }
        send(gpu, &mut tables.corrections, corrections.as_flattened())?;
        tables.counted = corrections.len();
        tables.uniforms.ensure(gpu, (layers.len() * at::ALL) as u64 * UNIFORM_STRIDE)?;
        let sizes: Vec<_> = layers.iter().map(|l| (l.rows, l.tables[SH].width, l.moves.blocks())).collect();
        tables.upload.keep(gpu, &sizes)?;
        // The old ones' memory is used again where layers stayed.
        tables.layers.truncate(layers.len());
        for (i, layer) in layers.iter().enumerate() {
            let fresh = Kept::new(layer);
            if i == tables.layers.len() {
                tables.layers.push(fresh);
            } else {
                let Kept { rows, moves, life, widths, .. } = fresh;
                let old = &mut tables.layers[i];
                (old.rows, old.moves, old.life, old.widths) = (rows, moves, life, widths);
            }
            let kept = &mut tables.layers[i];
            let small = &layer.tables[..SH];
            let all = |f: &dyn Fn(&KeptTable<'_>) -> usize| small.iter().map(f).collect::<Vec<_>>();
            let params: Vec<_> = small.iter().map(|t| t.params).zip(all(&|t| t.width)).collect();
            let padded = layer.rows.next_multiple_of(BLOCK);
            let histories: Vec<_> = small.iter().map(|t| history(t, padded)).collect();
            let moments: Vec<_> = histories.iter().map(|m| &m[..]).zip(all(&|t| moments_width(t.width))).collect();
            let params = side_by_side(&params);
            send(gpu, &mut kept.params, &params)?;
            kept.d_params.ensure(gpu, size_of_val(&params[..]) as u64)?;
            send(gpu, &mut kept.moments, &side_by_side(&moments))?;
            send(gpu, &mut tables.upload.parts[i].tables[0], layer.tables[SH].params)?;
            kept.d_sh.ensure(gpu, size_of_val(layer.tables[SH].params) as u64)?;
            send(gpu, &mut kept.sh_moments, &history(&layer.tables[SH], padded))?;
            send(gpu, &mut kept.stats, layer.stats)?;
            kept.alive.ensure(gpu, 4 * layer.rows as u64)?;
            kept.ties = layer.ties.map(|ties| Tied::new(gpu, ties)).transpose()?;
        }
        gpu.check()
    }

    fn step(&mut self, step: &KeptStep<'_>) -> Result<Option<KeptStepped>> {
        self.with_tables(|renderer, tables| renderer.step_kept(tables, step))
    }

    fn stages(&self) -> Vec<(&'static str, f64)> {
        self.timings.stages().to_vec()
    }

    fn fetch(&mut self, layer: usize) -> Result<KeptNumbers> {
        let mut tables = self.resident.take().expect("tables are kept before they are fetched");
        let out = self.fetch_layer(&mut tables, layer);
        self.resident = Some(tables);
        out
    }
}

impl GpuRenderer {
    fn fetch_layer(&self, tables: &mut Tables, layer: usize) -> Result<KeptNumbers> {
        let Tables { layers, upload, staging, .. } = tables;
        let kept = &layers[layer];
        let padded = kept.rows.next_multiple_of(BLOCK);
        let [stride, moments_stride] = kept.strides();
        let params = self.fetch_buffer(staging, &kept.params, stride * padded)?;
        let moments = self.fetch_buffer(staging, &kept.moments, moments_stride * padded)?;
        let width = kept.widths[SH];
        let mut out = KeptNumbers {
            params: std::array::from_fn(|t| {
                let first = if t == SH { 0 } else { kept.first(t)[0] };
                if t == SH { Vec::new() } else { apart(&params, stride, first..first + kept.widths[t]) }
            }),
            moments: std::array::from_fn(|t| {
                let first = if t == SH { 0 } else { kept.first(t)[1] };
                let width = moments_width(kept.widths[t]);
                if t == SH { Vec::new() } else { apart(&moments, moments_stride, first..first + width) }
            }),
            stats: self.fetch_buffer(staging, &kept.stats, STATS_WIDTH * padded)?,
        };
        out.params[SH] = self.fetch_buffer(staging, &upload.parts[layer].tables[0], width * padded)?;
        out.moments[SH] = self.fetch_buffer(staging, &kept.sh_moments, moments_width(width) * padded)?;
        Ok(out)
    }
}

/// Bytes of a layer's geometry as it is drawn.
pub(super) fn geometry_bytes(rows: usize) -> u64 {
    (4 * GEOMETRY_WIDTH * rows.next_multiple_of(BLOCK)) as u64
}

/// The words of a step among what came back.
pub(super) fn words_of(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|x| x.to_bits()).collect()
}

const _: () = assert!(count::PAIRS == 2, "the shaders read the pairs there");
