//! The compute pipelines, compiled once. Bindings are written out, so that all entry points of a file share one layout.

use super::device::{Gpu, SUBGROUPS};
use super::tuning::with_constant;
use crate::wgsl;

/// Kind of a binding.
#[derive(Clone, Copy, Debug)]
pub(super) enum Kind {
    Uniform,
    Read,
    Write,
}
use Kind::{Read, Uniform, Write};

/// The entry points of one file.
#[derive(Debug)]
pub(super) struct Kernel {
    layout: wgpu::BindGroupLayout,
    /// In the order in which the entry points were named.
    pub pipelines: Vec<wgpu::ComputePipeline>,
}

impl Kernel {
    pub(super) fn new(gpu: &Gpu, label: &str, sources: &[&str], bindings: &[Kind], entries: &[&str]) -> Self {
        let device = &gpu.device;
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(label),
            source: wgpu::ShaderSource::Wgsl(gpu.tuning.text(&sources.join("\n")).into()),
        });
        let entry = |(i, kind): (usize, &Kind)| wgpu::BindGroupLayoutEntry {
            binding: i as u32,
            visibility: wgpu::ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty: match kind {
                    Uniform => wgpu::BufferBindingType::Uniform,
                    Read => wgpu::BufferBindingType::Storage { read_only: true },
                    Write => wgpu::BufferBindingType::Storage { read_only: false },
                },
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        };
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some(label),
            entries: &bindings.iter().enumerate().map(entry).collect::<Vec<_>>(),
        });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(label),
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let pipelines = entries
            .iter()
            .map(|name| {
                device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                    label: Some(name),
                    layout: Some(&pipeline_layout),
                    module: &module,
                    entry_point: Some(name),
                    // Every kernel writes its workgroup's memory before it reads it: clearing would be wasted.
                    compilation_options: wgpu::PipelineCompilationOptions {
                        zero_initialize_workgroup_memory: false,
                        ..Default::default()
                    },
                    cache: None,
                })
            })
            .collect();
        Self { layout, pipelines }
    }

    /// Binds `resources` in the order of the bindings.
    pub(super) fn bind(&self, gpu: &Gpu, resources: &[wgpu::BindingResource<'_>]) -> wgpu::BindGroup {
        let entries: Vec<_> = resources
            .iter()
            .enumerate()
            .map(|(i, r)| wgpu::BindGroupEntry { binding: i as u32, resource: r.clone() })
            .collect();
        gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &self.layout,
            entries: &entries,
        })
    }
}

/// All kernels.
#[derive(Debug)]
pub(super) struct Kernels {
    /// splats
    pub splats: Kernel,
    /// block_sums, total, offsets
    pub scan: Kernel,
    /// compact
    pub compact: Kernel,
    /// histogram, scan, scatter
    pub sort: Kernel,
    /// count, emit
    pub tiles: Kernel,
    /// ranges_of
    pub ranges: Kernel,
    /// rasterize
    pub rasterize: Kernel,
    /// bytes_of
    pub bytes: Kernel,
}

impl Kernels {
    /// The sort, whose last dispatch has a form with subgroups.
    pub(super) fn sort(gpu: &Gpu, subgroups: bool) -> Kernel {
        let last = if subgroups { "scatter_subgroup" } else { "scatter" };
        let files: &[&str] = if subgroups { &[wgsl::SORT, wgsl::SORT_SUBGROUP] } else { &[wgsl::SORT] };
        Self::sort_of(gpu, files, last)
    }

    /// The same from these texts, with the name of its last dispatch.
    pub(super) fn sort_of(gpu: &Gpu, files: &[&str], last: &str) -> Kernel {
        let bindings = [Uniform, Read, Read, Read, Write, Write, Write];
        Kernel::new(gpu, "sort", files, &bindings, &["histogram", "scan", last])
    }

    /// Compiles everything.
    pub(super) fn new(gpu: &Gpu) -> Self {
        Self {
            splats: Kernel::new(
                gpu,
                "splats",
                &[wgsl::PROJECT, wgsl::SHADE, wgsl::SPLATS],
                &[Uniform, Uniform, Read, Read, Read, Read, Write, Write, Write],
                &["splats"],
            ),
            scan: Kernel::new(
                gpu,
                "scan",
                &[wgsl::SCAN],
                &[Uniform, Write, Read, Write, Write, Write],
                &["block_sums", "total", "offsets"],
            ),
            compact: Kernel::new(
                gpu,
                "compact",
                &[wgsl::COMPACT],
                &[Read, Read, Read, Read, Write, Write],
                &["compact"],
            ),
            sort: Self::sort(gpu, gpu.has_subgroups() && gpu.tuning.sort_subgroups),
            tiles: Kernel::new(
                gpu,
                "tiles",
                &[wgsl::PROJECT, wgsl::TILES],
                &[Uniform, Uniform, Read, Read, Read, Write, Read, Write, Write, Write],
                &["count", "emit"],
            ),
            ranges: Kernel::new(gpu, "ranges", &[wgsl::RANGES], &[Read, Read, Write], &["ranges_of"]),
            rasterize: Kernel::new(
                gpu,
                "rasterize",
                &[wgsl::PROJECT, &rasterize(gpu.lanes())],
                &[Uniform, Uniform, Write, Read, Read, Read, Read, Write],
                &["rasterize"],
            ),
            bytes: Kernel::new(
                gpu,
                "bytes",
                &[wgsl::PROJECT, wgsl::BYTES],
                &[Uniform, Uniform, Read, Write],
                &["bytes_of"],
            ),
        }
    }
}

/// The kernels of tables that stay.
#[derive(Debug)]
pub(super) struct ResidentKernels {
    /// answer
    pub answer: Kernel,
    /// colors_back
    pub colors_back: Kernel,
    /// answer_back
    pub answer_back: Kernel,
    /// answer of Gaussians of space and time
    pub slice_answer: Kernel,
    /// answer_back of the same
    pub slice_back: Kernel,
    /// count_rows, row_losses
    pub row_losses: Kernel,
    /// turns_of, hold
    pub ties: Kernel,
    /// adam
    pub adam: Kernel,
    /// shake
    pub shake: Kernel,
    /// view_sums, cameras, record
    pub record: Kernel,
}

impl ResidentKernels {
    /// Compiles everything.
    pub(super) fn new(gpu: &Gpu) -> Self {
        Self {
            answer: Kernel::new(
                gpu,
                "answer",
                &[wgsl::LEARNT, wgsl::ANSWER],
                &[Uniform, Read, Write, Write, Read],
                &["answer"],
            ),
            colors_back: Kernel::new(
                gpu,
                "colours, backward",
                &[wgsl::PROJECT, wgsl::SHADE, wgsl::LEARNT, wgsl::COLORS_BACK],
                &[Uniform, Uniform, Read, Read, Read, Write, Write, Write, Write],
                &["colors_back"],
            ),
            answer_back: Kernel::new(
                gpu,
                "answer, backward",
                &[wgsl::LEARNT, wgsl::PUT, wgsl::ANSWER_BACK],
                &[Uniform, Read, Read, Read, Write],
                &["answer_back"],
            ),
            slice_answer: Kernel::new(
                gpu,
                "slice",
                &[wgsl::LEARNT, wgsl::NUMBERS, wgsl::SLICE, wgsl::SLICE_ANSWER],
                &[Uniform, Read, Write, Write, Write, Read],
                &["answer"],
            ),
            slice_back: Kernel::new(
                gpu,
                "slice, backward",
                &[wgsl::LEARNT, wgsl::PUT, wgsl::NUMBERS, wgsl::SLICE, wgsl::SLICE_BACK],
                &[Uniform, Read, Read, Read, Read, Write],
                &["answer_back"],
            ),
            row_losses: Kernel::new(
                gpu,
                "losses on rows",
                &[wgsl::LEARNT, wgsl::NUMBERS, wgsl::ROW_LOSSES],
                &[Uniform, Uniform, Read, Read, Read, Write, Write],
                &["count_rows", "row_losses"],
            ),
            ties: Kernel::new(
                gpu,
                "ties",
                &[wgsl::LEARNT, wgsl::TIES],
                &[Uniform, Uniform, Read, Read, Read, Read, Write, Write, Write, Read],
                &["turns_of", "hold"],
            ),
            adam: Kernel::new(
                gpu,
                "adam",
                &[wgsl::ADAM],
                &[Uniform, Read, Write, Read, Write, Read, Read, Write],
                &["adam"],
            ),
            shake: Kernel::new(
                gpu,
                "shake",
                &[wgsl::LEARNT, wgsl::NUMBERS, wgsl::SHAKE],
                &[Uniform, Uniform, Read, Read, Write],
                &["shake"],
            ),
            record: Kernel::new(
                gpu,
                "record",
                &[wgsl::RECORD],
                &[Uniform, Write, Read, Write, Write, Read],
                &["view_sums", "cameras", "record"],
            ),
        }
    }
}

/// Threads of a workgroup of the blend's backward pass with subgroups, and splats that it reads at a time where
/// subgroups have 8 threads (subgroup_sums.wgsl).
const BACK_THREADS: usize = 64;
const BACK_SPLATS: usize = 16;

/// Workgroups of a tile in the backward pass with a lane per splat (rasterize_back_lanes.wgsl).
pub(super) const BACK_WAYS: u32 = 8;

/// The blend, which writes states for a backward pass with this many lanes (0: none).
fn rasterize(lanes: usize) -> String {
    with_constant(wgsl::RASTERIZE, "BUCKET", lanes)
}

/// The blend's backward pass for this device and its tuning.
fn rasterize_back(gpu: &Gpu) -> String {
    if gpu.lanes() > 0 {
        return with_constant(wgsl::RASTERIZE_BACK_LANES, "LANES", gpu.lanes());
    }
    match (gpu.has_subgroups(), gpu.tuning.back_vectors) {
        (false, _) => wgsl::RASTERIZE_BACK.into(),
        (true, false) => [wgsl::SUBGROUP_SUMS, wgsl::RASTERIZE_BACK_SUBGROUP].join("\n"),
        (true, true) => {
            // The fewer subgroups there are, the more splats fit into the same workgroup memory. No bit depends on it.
            let smallest = gpu.smallest_subgroup();
            let splats = (BACK_SPLATS * smallest / SUBGROUPS[0] as usize).min(BACK_THREADS);
            let sums = with_constant(wgsl::SUBGROUP_SUMS, "SPLATS", splats);
            let sums = with_constant(&sums, "MOST_SUBGROUPS", BACK_THREADS / smallest);
            [sums.as_str(), wgsl::RASTERIZE_BACK_VECTOR].join("\n")
        }
    }
}

/// The kernels of the loss and of the backward pass.
#[derive(Debug)]
pub(super) struct BackKernels {
    /// moments, gradient
    pub loss: Kernel,
    /// rasterize_back
    pub rasterize: Kernel,
    /// gather
    pub gather: Kernel,
    /// splats_back
    pub splats: Kernel,
}

impl BackKernels {
    /// Compiles everything.
    pub(super) fn new(gpu: &Gpu) -> Self {
        Self {
            loss: Kernel::new(
                gpu,
                "loss",
                &[wgsl::LOSS],
                &[Uniform, Read, Read, Write, Write, Write, Read],
                &["moments", "gradient"],
            ),
            rasterize: Kernel::new(
                gpu,
                "rasterize, backward",
                &[wgsl::PROJECT, wgsl::BLEND_BACK, &rasterize_back(gpu)],
                &[Uniform, Uniform, Read, Read, Read, Read, Read, Read, Read, Write],
                &["rasterize_back"],
            ),
            gather: Kernel::new(
                gpu,
                "gather",
                &[wgsl::GATHER],
                &[Uniform, Read, Read, Read, Read, Read, Write, Write],
                &["gather"],
            ),
            splats: Kernel::new(
                gpu,
                "splats, backward",
                &[wgsl::PROJECT, wgsl::PROJECT_BACK, wgsl::SPLATS_BACK],
                &[Uniform, Uniform, Read, Read, Read, Read, Read, Write, Write],
                &["splats_back"],
            ),
        }
    }
}
