//! Measures the time of stages: by GPU timestamps, or by wall time with a wait after each stage.

use super::device::Gpu;
use crate::Result;
use std::time::Instant;

/// The stages of a frame, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    Project,
    Compact,
    SortSplats,
    Tiles,
    SortPairs,
    Rasterize,
    RasterizeBack,
    Gather,
    SplatsBack,
    // Last, because the stages of one submission follow each other in this list, and a backward pass need not compare.
    Loss,
    // Those of tables that stay on the GPU.
    Answer,
    AnswerBack,
    Adam,
}

/// Number of stages.
pub(super) const STAGES: usize = 13;

/// Source of the stages' times.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StageClock {
    /// Nothing: only whole frames are timed.
    Off,
    /// The GPU's timestamps: costs nothing. Without them (`Gpu::has_timestamps`) nothing is timed.
    Gpu,
    /// The wall: every stage is submitted and waited for alone, which slows a frame down.
    Wall,
}

/// Milliseconds that the last frame took.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GpuTimings {
    /// Handing the scene's tables to the driver (on the CPU).
    pub upload: f64,
    /// Projection and colours.
    pub project: f64,
    /// Gathering the visible splats.
    pub compact: f64,
    /// Sorting them by depth.
    pub sort_splats: f64,
    /// Pairs of tile and splat: counted, summed, written.
    pub tiles: f64,
    /// Sorting the pairs by tile, and where each tile's begin.
    pub sort_pairs: f64,
    /// Blending.
    pub rasterize: f64,
    /// Blending, backward.
    pub rasterize_back: f64,
    /// Sums of the records of each splat.
    pub gather: f64,
    /// Projection, backward.
    pub splats_back: f64,
    /// Comparing the image with its truth, and the gradient to it.
    pub loss: f64,
    /// Rows to splats, of tables that stay on the GPU.
    pub answer: f64,
    /// The same, backward, colours included.
    pub answer_back: f64,
    /// Adam.
    pub adam: f64,
    /// From the last submission to the image in the CPU's memory, the GPU's work included.
    pub wait: f64,
    /// The whole call.
    pub total: f64,
    /// The same of the backward pass, which adds to the stages above; 0 where there was none.
    pub back_wait: f64,
    /// The whole call of the backward pass.
    pub back_total: f64,
}

impl GpuTimings {
    /// The GPU's stages together; 0 where they were not timed.
    pub fn gpu(&self) -> f64 {
        let forward = self.project + self.compact + self.sort_splats + self.tiles + self.sort_pairs + self.rasterize;
        forward
            + self.loss
            + self.rasterize_back
            + self.gather
            + self.splats_back
            + self.answer
            + self.answer_back
            + self.adam
    }

    /// The GPU's stages by name, in the order in which they run.
    pub(crate) fn stages(&self) -> [(&'static str, f64); STAGES] {
        [
            ("answer", self.answer),
            ("project", self.project),
            ("compact", self.compact),
            ("sort splats", self.sort_splats),
            ("tiles", self.tiles),
            ("sort pairs", self.sort_pairs),
            ("rasterize", self.rasterize),
            ("loss", self.loss),
            ("rasterize backward", self.rasterize_back),
            ("gather", self.gather),
            ("splats backward", self.splats_back),
            ("answer backward", self.answer_back),
            ("adam", self.adam),
        ]
    }

    /// Adds the stages' milliseconds.
    pub(super) fn add(&mut self, stages: [f64; STAGES]) {
        let own = [
            &mut self.project,
            &mut self.compact,
            &mut self.sort_splats,
            &mut self.tiles,
            &mut self.sort_pairs,
            &mut self.rasterize,
            &mut self.rasterize_back,
            &mut self.gather,
            &mut self.splats_back,
            &mut self.loss,
            &mut self.answer,
            &mut self.answer_back,
            &mut self.adam,
        ];
        for (sum, ms) in own.into_iter().zip(stages) {
            *sum += ms;
        }
    }
}

/// Bytes of all timestamps: two a stage.
pub(super) const TIMES_BYTES: u64 = 16 * STAGES as u64;

/// A clock that is kept from frame to frame.
#[derive(Debug)]
pub(super) struct Queries(Option<wgpu::QuerySet>);

impl Queries {
    /// Made once.
    pub(super) fn new(gpu: &Gpu) -> Self {
        let make = || {
            gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("stages"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * STAGES as u32,
            })
        };
        Self(gpu.has_timestamps().then(make))
    }
}

/// Commands of one submission.
pub(super) struct Recorder<'a> {
    gpu: &'a Gpu,
    encoder: wgpu::CommandEncoder,
    queries: Option<&'a wgpu::QuerySet>,
    wall: bool,
    /// First and one past the last stage that was recorded.
    recorded: [usize; 2],
    /// Milliseconds by the wall.
    pub by_wall: [f64; STAGES],
}

impl<'a> Recorder<'a> {
    /// Begins.
    pub(super) fn new(gpu: &'a Gpu, queries: &'a Queries, clock: StageClock) -> Self {
        Self {
            gpu,
            encoder: encoder(gpu),
            queries: if clock == StageClock::Gpu { queries.0.as_ref() } else { None },
            wall: clock == StageClock::Wall,
            recorded: [STAGES, 0],
            by_wall: [0.0; STAGES],
        }
    }

    /// Records a stage, which must not be one that was recorded before.
    pub(super) fn stage(&mut self, stage: Stage, f: impl FnOnce(&mut wgpu::ComputePass<'_>)) -> Result<()> {
        let i = stage as usize;
        if self.wall {
            self.flush()?;
        }
        let start = Instant::now();
        let timestamp_writes = self.queries.map(|query_set| wgpu::ComputePassTimestampWrites {
            query_set,
            beginning_of_pass_write_index: Some(2 * i as u32),
            end_of_pass_write_index: Some(2 * i as u32 + 1),
        });
        self.recorded = [self.recorded[0].min(i), self.recorded[1].max(i + 1)];
        {
            let label = Some("stage");
            let mut pass = self.encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label, timestamp_writes });
            f(&mut pass);
        }
        if self.wall {
            self.flush()?;
            self.by_wall[i] = start.elapsed().as_secs_f64() * 1e3;
        }
        Ok(())
    }

    /// Fills the first `bytes` of a buffer with 0.
    pub(crate) fn clear(&mut self, buffer: &wgpu::Buffer, bytes: u64) {
        self.encoder.clear_buffer(buffer, 0, Some(bytes));
    }

    /// Copies `bytes` from the start of one buffer to a position in another.
    pub(crate) fn copy(&mut self, from: &wgpu::Buffer, to: &wgpu::Buffer, at: u64, bytes: u64) {
        self.copy_from(from, 0, to, at, bytes);
    }

    /// Copies `bytes` from a position in one buffer to a position in another.
    pub(crate) fn copy_from(&mut self, from: &wgpu::Buffer, first: u64, to: &wgpu::Buffer, at: u64, bytes: u64) {
        self.encoder.copy_buffer_to_buffer(from, first, to, at, bytes);
    }

    /// Writes the stages' timestamps into `times`: whether there are any.
    pub(crate) fn resolve(&mut self, times: &wgpu::Buffer) -> bool {
        let [first, end] = self.recorded;
        let Some(queries) = self.queries.filter(|_| first < end) else { return false };
        // An entry that was never written may not be read.
        self.encoder.resolve_query_set(queries, 2 * first as u32..2 * end as u32, times, 0);
        true
    }

    /// Milliseconds of the stages from the timestamps of [`Recorder::resolve`].
    pub(crate) fn stages(&self, stamps: &[u64]) -> [f64; STAGES] {
        stages(self.gpu, self.recorded, stamps)
    }

    /// First and one past the last stage that was recorded.
    pub(crate) fn recorded(&self) -> [usize; 2] {
        self.recorded
    }

    /// Submits the recorded commands.
    pub(crate) fn submit(&mut self) -> wgpu::SubmissionIndex {
        let done = std::mem::replace(&mut self.encoder, encoder(self.gpu));
        self.gpu.queue.submit([done.finish()])
    }

    fn flush(&mut self) -> Result<()> {
        self.submit();
        self.gpu.wait()
    }
}

/// Milliseconds of the stages that were recorded, from their timestamps.
pub(super) fn stages(gpu: &Gpu, recorded: [usize; 2], stamps: &[u64]) -> [f64; STAGES] {
    let period = f64::from(gpu.queue.get_timestamp_period()) * 1e-6;
    let mut out = [0.0; STAGES];
    for (i, pair) in (recorded[0]..recorded[1]).zip(stamps.chunks_exact(2)) {
        out[i] = pair[1].saturating_sub(pair[0]) as f64 * period;
    }
    out
}

fn encoder(gpu: &Gpu) -> wgpu::CommandEncoder {
    gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("frame") })
}
