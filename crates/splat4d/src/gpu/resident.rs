//! Tables that stay on the GPU: rows become splats, splats a picture, and its loss steps of Adam, without a number of them
//! passing through the CPU. Densification, files and whatever else looks at a scene fetch the tables, and hand them back.

use super::buffers::{Buffers, Grown, UNIFORM_STRIDE};
use super::clock::{Recorder, Stage};
use super::device::Gpu;
use super::frame::{THREADS, count, slot};
use super::kernels::ResidentKernels;
use super::upload::Upload;
use super::{GpuRenderer, MOST_GROUPS};
use crate::render::{KEPT, KeptLayer, KeptNumbers, KeptRule, KeptStep, KeptStepped, KeptTable, Moves, Resident, Shot};
use crate::scene::{BLOCK, LifeKind, Splats};
use crate::{Error, ErrorKind, Result};
use std::ops::Range;

/// Number of the SH table; those before it lie side by side in one buffer.
const SH: usize = KEPT - 1;
/// Columns of the geometry that splats are made of (mean, covariance, opacity) and of a row's statistics.
const GEOMETRY_WIDTH: usize = 10;
const STATS_WIDTH: usize = 3;
/// Most columns of a table (adam.wgsl).
const MOST_COLUMNS: usize = 48;
/// Bits of `Ask::flags` (learnt.wgsl).
const FLAG_ROTATION: u32 = 1;
const FLAG_DETACH: u32 = 2;
const FLAG_FIRST: u32 = 4;
/// Structures a layer in the buffer of uniforms: what is asked, and a rule a table.
const SLOTS: usize = 1 + KEPT;

/// `struct Ask` of learnt.wgsl.
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Ask {
    rows: u32,
    width: u32,
    order: u32,
    flags: u32,
    life: u32,
    life_at: u32,
    velocities_at: u32,
    rates_at: u32,
    t: f32,
    delta: f32,
    alpha_min: f32,
    widest: f32,
    first_splat: u32,
    capacity: u32,
    sh_width: u32,
    unused: u32,
}

/// `struct Rule` of adam.wgsl.
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Rule {
    rows: u32,
    width: u32,
    stride: u32,
    first: u32,
    moments_stride: u32,
    moments_first: u32,
    counted: u32,
    floor_column: u32,
    floor_least: f32,
    capacity: u32,
    word: u32,
    unused: u32,
    rates: [f32; MOST_COLUMNS],
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
        }
    }

    fn bytes(&self) -> u64 {
        let all = [&self.params, &self.d_params, &self.moments, &self.d_sh, &self.sh_moments, &self.stats, &self.alive];
        all.iter().map(|b| b.bytes()).sum()
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

    /// Words that tell of numbers that are not finite.
    fn words(&self) -> usize {
        self.layers.len() * KEPT
    }

    fn rows(&self) -> usize {
        self.layers.iter().map(|l| l.rows).sum()
    }
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

/// The other way round: some columns of tables that lie side by side.
fn apart(all: &[f32], stride: usize, columns: Range<usize>) -> Vec<f32> {
    all.chunks_exact(stride.max(1) * BLOCK)
        .flat_map(|block| &block[columns.start * BLOCK..columns.end * BLOCK])
        .copied()
        .collect()
}

fn send(gpu: &Gpu, buffer: &mut Grown, data: &[f32]) -> Result<()> {
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

    /// Numbers behind the loss's in its buffer: the words of Adam.
    pub(super) fn words(&self) -> usize {
        self.tables.words()
    }

    /// Writes what is asked and by which rules is learnt, for so many pairs.
    pub(super) fn write_uniforms(&self, gpu: &Gpu, capacity: usize) {
        let mut out = vec![0u8; self.tables.layers.len() * SLOTS * UNIFORM_STRIDE as usize];
        let mut put =
            |at: usize, bytes: &[u8]| out[at * UNIFORM_STRIDE as usize..][..bytes.len()].copy_from_slice(bytes);
        let mut first_splat = 0;
        for (i, layer) in self.tables.layers.iter().enumerate() {
            let ask = self.ask(layer, first_splat, capacity);
            put(i * SLOTS, bytemuck::bytes_of(&ask));
            first_splat += layer.rows;
            for (table, rule) in self.step.rules[i].iter().enumerate() {
                if let Some(rule) = rule {
                    let rule = self.rule(layer, table, i * KEPT + table, rule, capacity);
                    put(i * SLOTS + 1 + table, bytemuck::bytes_of(&rule));
                }
            }
        }
        gpu.queue.write_buffer(self.tables.uniforms.get(), 0, &out);
    }

    fn ask(&self, layer: &Kept, first_splat: usize, capacity: usize) -> Ask {
        let flag = |on: bool, flag: u32| if on { flag } else { 0 };
        let (moves, t) = (layer.moves, self.step.views[self.view].t.0);
        let life = match layer.life {
            LifeKind::Infinite => 0,
            LifeKind::GaussHalf => 1,
            LifeKind::GaussOne => 2,
            LifeKind::Interval => 3,
        };
        let [_, life_at, velocities_at, rates_at, _] = std::array::from_fn(|table| layer.first(table)[0] as u32);
        Ask {
            rows: layer.rows as u32,
            width: layer.strides()[0] as u32,
            order: moves.order as u32,
            flags: flag(moves.rotation, FLAG_ROTATION)
                | flag(moves.detach, FLAG_DETACH)
                | flag(self.view == 0, FLAG_FIRST),
            life,
            life_at,
            velocities_at,
            rates_at,
            t: t as f32,
            delta: (t - moves.origin) as f32,
            alpha_min: self.step.alpha_min as f32,
            widest: (2.0 * -self.step.alpha_min.ln()).sqrt() as f32,
            first_splat: first_splat as u32,
            capacity: capacity as u32,
            sh_width: layer.widths[SH] as u32,
            unused: 0,
        }
    }

    fn rule(&self, layer: &Kept, table: usize, word: usize, rule: &KeptRule, capacity: usize) -> Rule {
        let width = layer.widths[table];
        let ([first, moments_first], [stride, moments_stride]) =
            if table == SH { ([0; 2], [width, moments_width(width)]) } else { (layer.first(table), layer.strides()) };
        let (floor_column, floor_least) = rule.floor.unwrap_or((width, 0.0));
        Rule {
            rows: layer.rows as u32,
            width: width as u32,
            stride: stride as u32,
            first: first as u32,
            moments_stride: moments_stride as u32,
            moments_first: moments_first as u32,
            counted: self.tables.counted as u32,
            floor_column: floor_column as u32,
            floor_least: floor_least as f32,
            capacity: capacity as u32,
            word: word as u32,
            unused: 0,
            rates: std::array::from_fn(|c| rule.rates.get(c).map_or(0.0, |r| *r as f32)),
        }
    }

    fn uniform(&self, at: usize, size: usize) -> wgpu::BindingResource<'_> {
        wgpu::BindingResource::Buffer(wgpu::BufferBinding {
            buffer: self.tables.uniforms.get(),
            offset: at as u64 * UNIFORM_STRIDE,
            size: std::num::NonZeroU64::new(size as u64),
        })
    }

    /// Rows to splats.
    pub(super) fn answer(&self, gpu: &Gpu, upload: &Upload, recorder: &mut Recorder<'_>) -> Result<()> {
        let kernel = &self.tables.kernels.answer;
        let bind = |(i, layer): (usize, &Kept)| {
            let group = [
                self.uniform(i * SLOTS, size_of::<Ask>()),
                layer.params.all(),
                upload.parts[i].geometry.all(),
                layer.alive.all(),
            ];
            (kernel.bind(gpu, &group), layer.groups())
        };
        let groups: Vec<_> = self.tables.layers.iter().enumerate().map(bind).collect();
        recorder.stage(Stage::Answer, |pass| {
            pass.set_pipeline(&kernel.pipelines[0]);
            for (group, groups) in &groups {
                pass.set_bind_group(0, group, &[]);
                pass.dispatch_workgroups(*groups, 1, 1);
            }
        })
    }

    /// The gradients of splats to those of rows, and, after the step's last view, Adam. `status`: the loss's buffer, and where in
    /// it the words are.
    pub(super) fn learn(
        &self,
        gpu: &Gpu,
        b: &Buffers,
        upload: &Upload,
        status_at: u64,
        recorder: &mut Recorder<'_>,
    ) -> Result<()> {
        let Tables { layers, kernels: k, corrections, .. } = self.tables;
        let ask = |i: usize| self.uniform(i * SLOTS, size_of::<Ask>());
        let colors = |(i, layer): (usize, &Kept)| {
            let part = &upload.parts[i];
            let view = super::frame::uniform(b, slot::VIEW, super::frame::VIEW_BYTES);
            let group = [
                view,
                ask(i),
                b.counts.all(),
                part.geometry.all(),
                part.tables[0].all(),
                b.back.all(),
                layer.d_sh.all(),
                layer.stats.all(),
            ];
            (k.colors_back.bind(gpu, &group), layer.groups())
        };
        let rows = |(i, layer): (usize, &Kept)| {
            let group = [ask(i), b.counts.all(), layer.params.all(), b.back.all(), layer.d_params.all()];
            (k.answer_back.bind(gpu, &group), layer.groups())
        };
        let colors: Vec<_> = layers.iter().enumerate().map(colors).collect();
        let rows: Vec<_> = layers.iter().enumerate().map(rows).collect();
        recorder.stage(Stage::AnswerBack, |pass| {
            for (kernel, groups) in [(&k.colors_back, &colors), (&k.answer_back, &rows)] {
                pass.set_pipeline(&kernel.pipelines[0]);
                for (group, groups) in groups {
                    pass.set_bind_group(0, group, &[]);
                    pass.dispatch_workgroups(*groups, 1, 1);
                }
            }
        })?;
        if !self.is_last() {
            return Ok(());
        }
        let words = wgpu::BindingResource::Buffer(wgpu::BufferBinding {
            buffer: b.partials.get(),
            offset: status_at,
            size: std::num::NonZeroU64::new((4 * self.words()) as u64),
        });
        let mut steps = Vec::new();
        for (i, layer) in layers.iter().enumerate() {
            for table in (0..KEPT).filter(|&t| self.step.rules[i][t].is_some()) {
                let (params, d, moments) = if table == SH {
                    (&upload.parts[i].tables[0], &layer.d_sh, &layer.sh_moments)
                } else {
                    (&layer.params, &layer.d_params, &layer.moments)
                };
                let group = [
                    self.uniform(i * SLOTS + 1 + table, size_of::<Rule>()),
                    b.counts.all(),
                    params.all(),
                    d.all(),
                    moments.all(),
                    layer.alive.all(),
                    corrections.all(),
                    words.clone(),
                ];
                steps.push((k.adam.bind(gpu, &group), layer.groups()));
            }
        }
        recorder.stage(Stage::Adam, |pass| {
            pass.set_pipeline(&k.adam.pipelines[0]);
            for (group, groups) in &steps {
                pass.set_bind_group(0, group, &[]);
                pass.dispatch_workgroups(*groups, 1, 1);
            }
        })
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
        let bad = words.iter().position(|w| *w != 0).map(|at| [at / KEPT, at % KEPT, words[at] as usize - 1]);
        Ok(Some(KeptStepped { comparisons, bad }))
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
        let most = layers.iter().map(|l| l.rows.div_ceil(THREADS)).max().unwrap_or(0);
        let wide = layers.iter().flat_map(|l| &l.tables).any(|t| t.width > MOST_COLUMNS);
        if most > MOST_GROUPS || wide {
            return Err(Error::new(ErrorKind::Unsupported, "the scene's tables are too large for the GPU"));
        }
        send(gpu, &mut tables.corrections, corrections.as_flattened())?;
        tables.counted = corrections.len();
        tables.uniforms.ensure(gpu, (layers.len() * SLOTS) as u64 * UNIFORM_STRIDE)?;
        let sizes: Vec<_> = layers.iter().map(|l| (l.rows, l.tables[SH].width)).collect();
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
            let moments: Vec<_> = small.iter().map(|t| t.moments).zip(all(&|t| moments_width(t.width))).collect();
            let params = side_by_side(&params);
            send(gpu, &mut kept.params, &params)?;
            kept.d_params.ensure(gpu, size_of_val(&params[..]) as u64)?;
            send(gpu, &mut kept.moments, &side_by_side(&moments))?;
            send(gpu, &mut tables.upload.parts[i].tables[0], layer.tables[SH].params)?;
            kept.d_sh.ensure(gpu, size_of_val(layer.tables[SH].params) as u64)?;
            send(gpu, &mut kept.sh_moments, layer.tables[SH].moments)?;
            send(gpu, &mut kept.stats, layer.stats)?;
            kept.alive.ensure(gpu, 4 * layer.rows as u64)?;
        }
        gpu.check()
    }

    fn step(&mut self, step: &KeptStep<'_>) -> Result<Option<KeptStepped>> {
        self.with_tables(|renderer, tables| renderer.step_kept(tables, step))
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

/// The words of Adam among what came back.
pub(super) fn words_of(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|x| x.to_bits()).collect()
}

const _: () = assert!(count::PAIRS == 2, "the shaders read the pairs there");
