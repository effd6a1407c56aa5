//! One frame as dispatches: which kernel runs over which buffers, in which order.

use super::MOST_GROUPS;
use super::buffers::{Buffers, Grown, UNIFORM_STRIDE};
use super::clock::{Recorder, Stage};
use super::device::Gpu;
use super::kernels::{BACK_WAYS, BackKernels, Kernel, Kernels};
use super::limits::THREADS;
use super::upload::{Draw, Upload};
use wgpu::{BindGroup, BindingResource, ComputePass};

/// Pixels across and down a tile (tiles.wgsl, rasterize.wgsl).
pub(super) const TILE: usize = 16;
/// Digits of a sort's pass; each has a workgroup in its scan.
pub(super) const DIGITS: usize = 256;
/// Passes that sort 32 bits.
const DEPTH_PASSES: usize = 4;
/// Passes that sort a tile's number: there are fewer than 2^24 tiles in a band.
const TILE_PASSES: usize = 3;
/// Bytes of a tile's list (ranges.wgsl).
pub(super) const RANGE_BYTES: u64 = 12;
/// Bytes of a pair's record (rasterize_back.wgsl).
pub(super) const RECORD_BYTES: u64 = 48;

/// Places of the structures in the buffer of uniforms.
pub(super) mod slot {
    pub(crate) const VIEW: usize = 0;
    pub(crate) const SCAN_VISIBLE: usize = 1;
    pub(crate) const SCAN_PAIRS: usize = 2;
    pub(crate) const SORT_DEPTH: usize = 3;
    pub(crate) const SORT_TILE: usize = 7;
    pub(crate) const BAND: usize = 10;
    pub(crate) const BLEND: usize = 11;
    pub(crate) const LOSS: usize = 12;
    pub(crate) const PIECES: usize = 13;
}

/// Places in the buffer of counts.
pub(super) mod count {
    pub(crate) const SPLATS: usize = 0;
    pub(crate) const VISIBLE: usize = 1;
    pub(crate) const PAIRS: usize = 2;
    /// Position at which resident steps stopped (scan.wgsl, record.wgsl), and the pairs that were needed.
    pub(crate) const STOP: usize = 3;
    pub(crate) const ALL: usize = 5;
}

/// The two buffers of arguments, and what is in each: triples of u32, first for one thread per item, then for one
/// workgroup per block of items.
pub(super) mod arguments {
    pub(crate) const VISIBLE: usize = 0;
    pub(crate) const PAIRS: usize = 1;
    pub(crate) const THREADS: u64 = 0;
    pub(crate) const BLOCKS: u64 = 12;
    pub(crate) const BYTES: u64 = 24;
}

/// Rows of tiles that are rendered at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Band {
    /// First row of tiles.
    pub first: usize,
    /// Rows of tiles.
    pub rows: usize,
}

/// `size` bytes of the uniform in a slot.
pub(super) fn uniform(buffers: &Buffers, slot: usize, size: u64) -> BindingResource<'_> {
    BindingResource::Buffer(wgpu::BufferBinding {
        buffer: buffers.uniforms.get(),
        offset: slot as u64 * UNIFORM_STRIDE,
        size: std::num::NonZeroU64::new(size),
    })
}

/// Bytes of the structures in WGSL.
pub(super) const VIEW_BYTES: u64 = 128;
const PIECE_BYTES: u64 = 80;
const SCAN_BYTES: u64 = 32;
const SORT_BYTES: u64 = 8;
const BAND_BYTES: u64 = 16;
const BLEND_BYTES: u64 = 48;
const LOSS_BYTES: u64 = 80;

/// Everything that is bound, made again when a buffer is.
#[derive(Debug)]
pub(super) struct Groups {
    scan_visible: BindGroup,
    scan_pairs: BindGroup,
    compact: BindGroup,
    sort_depth: Vec<BindGroup>,
    sort_tile: Vec<BindGroup>,
    tiles: BindGroup,
    /// For lists that are in the first and in the second buffer.
    ranges: [BindGroup; 2],
    rasterize: [BindGroup; 2],
}

impl Groups {
    /// Binds all buffers.
    pub(super) fn new(gpu: &Gpu, k: &Kernels, b: &Buffers) -> Self {
        let scan = |slot, input: &Grown, output: &Grown, sizes: usize| {
            let group = [
                uniform(b, slot, SCAN_BYTES),
                b.counts.all(),
                input.all(),
                output.all(),
                b.scan_sums.all(),
                b.arguments[sizes].all(),
            ];
            k.scan.bind(gpu, &group)
        };
        let sort = |slot, from: usize, keys: &[Grown; 2], values: &[Grown; 2]| {
            let (source, target) = (from % 2, 1 - from % 2);
            let group = [
                uniform(b, slot, SORT_BYTES),
                b.counts.all(),
                keys[source].all(),
                values[source].all(),
                keys[target].all(),
                values[target].all(),
                b.sort_counts.all(),
            ];
            k.sort.bind(gpu, &group)
        };
        let view = || uniform(b, slot::VIEW, VIEW_BYTES);
        let tiles = [
            view(),
            uniform(b, slot::BAND, BAND_BYTES),
            b.counts.all(),
            b.depth_values[0].all(),
            b.shapes.all(),
            b.tile_counts.all(),
            b.first_pairs.all(),
            b.pair_keys[0].all(),
            b.pair_values[0].all(),
            b.owners.all(),
        ];
        let rasterize = |at: usize| {
            let group = [
                view(),
                uniform(b, slot::BLEND, BLEND_BYTES),
                b.ranges.all(),
                b.pair_values[at].all(),
                b.owners.all(),
                b.shapes.all(),
                b.colors.all(),
                b.planes.all(),
            ];
            k.rasterize.bind(gpu, &group)
        };
        let ranges = |at: usize| k.ranges.bind(gpu, &[b.counts.all(), b.pair_keys[at].all(), b.ranges.all()]);
        let compact = [
            b.counts.all(),
            b.marks.all(),
            b.places.all(),
            b.colors.all(),
            b.depth_keys[0].all(),
            b.depth_values[0].all(),
        ];
        Self {
            scan_visible: scan(slot::SCAN_VISIBLE, &b.marks, &b.places, arguments::VISIBLE),
            scan_pairs: scan(slot::SCAN_PAIRS, &b.tile_counts, &b.first_pairs, arguments::PAIRS),
            compact: k.compact.bind(gpu, &compact),
            sort_depth: (0..DEPTH_PASSES)
                .map(|p| sort(slot::SORT_DEPTH + p, p, &b.depth_keys, &b.depth_values))
                .collect(),
            sort_tile: (0..TILE_PASSES).map(|p| sort(slot::SORT_TILE + p, p, &b.pair_keys, &b.pair_values)).collect(),
            tiles: k.tiles.bind(gpu, &tiles),
            ranges: [ranges(0), ranges(1)],
            rasterize: [rasterize(0), rasterize(1)],
        }
    }
}

/// Number of workgroups of a dispatch: known here, or written by an earlier kernel, in this buffer of sizes and at this
/// position.
#[derive(Clone, Copy)]
enum Size {
    Known(usize),
    Written(usize, u64),
}

fn dispatch(pass: &mut ComputePass<'_>, kernel: &Kernel, entry: usize, buffers: &Buffers, groups: Size) {
    pass.set_pipeline(&kernel.pipelines[entry]);
    match groups {
        Size::Known(n) => pass.dispatch_workgroups(n as u32, 1, 1),
        Size::Written(of, at) => pass.dispatch_workgroups_indirect(buffers.arguments[of].get(), at),
    }
}

/// Items that a frame runs over.
#[derive(Clone, Copy)]
pub(super) struct Frame<'a> {
    /// The open GPU.
    pub gpu: &'a Gpu,
    /// Pipelines.
    pub kernels: &'a Kernels,
    /// Memory.
    pub buffers: &'a Buffers,
    /// Bound resources.
    pub groups: &'a Groups,
}

impl Frame<'_> {
    /// Exclusive sums.
    fn scan(&self, pass: &mut ComputePass<'_>, group: &BindGroup, blocks: Size) {
        let kernel = &self.kernels.scan;
        pass.set_bind_group(0, group, &[]);
        dispatch(pass, kernel, 0, self.buffers, blocks);
        dispatch(pass, kernel, 1, self.buffers, Size::Known(1));
        dispatch(pass, kernel, 2, self.buffers, blocks);
    }

    /// One pass of a sort a group; `of` states in which buffer the number of blocks is.
    fn sort(&self, pass: &mut ComputePass<'_>, groups: &[BindGroup], of: usize) {
        let kernel = &self.kernels.sort;
        for group in groups {
            pass.set_bind_group(0, group, &[]);
            dispatch(pass, kernel, 0, self.buffers, Size::Written(of, arguments::BLOCKS));
            dispatch(pass, kernel, 1, self.buffers, Size::Known(DIGITS));
            dispatch(pass, kernel, 2, self.buffers, Size::Written(of, arguments::BLOCKS));
        }
    }

    /// Projects and colours all splats and puts the visible ones in order, nearest first.
    pub(super) fn splats(&self, recorder: &mut Recorder<'_>, upload: &Upload, splats: usize) -> crate::Result<()> {
        let (k, b) = (self.kernels, self.buffers);
        let bind = |(i, draw): (usize, &Draw)| {
            let part = &upload.parts[draw.part];
            let group = [
                uniform(b, slot::VIEW, VIEW_BYTES),
                uniform(b, slot::PIECES + i, PIECE_BYTES),
                part.geometry.all(),
                part.tables[draw.cut].all(),
                part.ids.all(),
                part.weights.all(),
                b.shapes.all(),
                b.colors.all(),
                b.marks.all(),
            ];
            (k.splats.bind(self.gpu, &group), draw.groups())
        };
        let draws: Vec<_> = upload.draws.iter().enumerate().map(bind).collect();
        recorder.stage(Stage::Project, |pass| {
            for (group, groups) in &draws {
                pass.set_bind_group(0, group, &[]);
                dispatch(pass, &k.splats, 0, b, Size::Known(*groups));
            }
        })?;
        recorder.stage(Stage::Compact, |pass| {
            self.scan(pass, &self.groups.scan_visible, Size::Known(splats.div_ceil(self.gpu.tuning.block())));
            pass.set_bind_group(0, &self.groups.compact, &[]);
            dispatch(pass, &k.compact, 0, b, Size::Known(splats.div_ceil(THREADS)));
        })?;
        recorder.stage(Stage::SortSplats, |pass| {
            self.sort(pass, &self.groups.sort_depth, arguments::VISIBLE);
        })
    }

    /// Lists and blends one band; `bytes`: this many pixels of it in 8 bits too. Returns in which of the two buffers
    /// the sorted pairs are.
    pub(super) fn band(
        &self,
        recorder: &mut Recorder<'_>,
        band: Band,
        across: usize,
        bytes: Option<usize>,
    ) -> crate::Result<usize> {
        let (k, b) = (self.kernels, self.buffers);
        let tiles = band.rows * across;
        recorder.stage(Stage::Tiles, |pass| {
            pass.set_bind_group(0, &self.groups.tiles, &[]);
            dispatch(pass, &k.tiles, 0, b, Size::Written(arguments::VISIBLE, arguments::THREADS));
            self.scan(pass, &self.groups.scan_pairs, Size::Written(arguments::VISIBLE, arguments::BLOCKS));
            pass.set_bind_group(0, &self.groups.tiles, &[]);
            dispatch(pass, &k.tiles, 1, b, Size::Written(arguments::VISIBLE, arguments::THREADS));
        })?;
        let passes = tile_passes(tiles);
        recorder.clear(b.ranges.get(), RANGE_BYTES * tiles as u64);
        recorder.stage(Stage::SortPairs, |pass| {
            self.sort(pass, &self.groups.sort_tile[..passes], arguments::PAIRS);
            pass.set_bind_group(0, &self.groups.ranges[passes % 2], &[]);
            dispatch(pass, &k.ranges, 0, b, Size::Written(arguments::PAIRS, arguments::BLOCKS));
        })?;
        let packed = bytes.map(|pixels| {
            let view = uniform(b, slot::VIEW, VIEW_BYTES);
            let group = [view, uniform(b, slot::BLEND, BLEND_BYTES), b.planes.all(), b.bytes.all()];
            (k.bytes.bind(self.gpu, &group), pixels.div_ceil(THREADS).min(MOST_GROUPS))
        });
        recorder.stage(Stage::Rasterize, |pass| {
            pass.set_bind_group(0, &self.groups.rasterize[passes % 2], &[]);
            pass.set_pipeline(&k.rasterize.pipelines[0]);
            pass.dispatch_workgroups(across as u32, band.rows as u32, 1);
            if let Some((group, groups)) = &packed {
                pass.set_bind_group(0, group, &[]);
                dispatch(pass, &k.bytes, 0, b, Size::Known(*groups));
            }
        })?;
        Ok(passes % 2)
    }
}

/// Range of a frame's backward pass.
#[derive(Clone, Copy)]
pub(super) struct Back<'a> {
    /// The frame before.
    pub frame: Frame<'a>,
    /// Pipelines.
    pub kernels: &'a BackKernels,
    /// Pairs of the band.
    pub pairs: usize,
}

impl Back<'_> {
    /// Compares the planes, a whole image, with a truth, as a camera shows them that responds like one of
    /// `responses`, and writes
    /// the gradient to them.
    pub(super) fn loss(
        &self,
        recorder: &mut Recorder<'_>,
        truth: &wgpu::Buffer,
        responses: &Grown,
        [across, down]: [usize; 2],
    ) -> crate::Result<()> {
        let (k, b) = (&self.kernels.loss, self.frame.buffers);
        let group = [
            uniform(b, slot::LOSS, LOSS_BYTES),
            b.planes.all(),
            truth.as_entire_binding(),
            b.maps.all(),
            b.d_planes.all(),
            b.partials.all(),
            responses.all(),
        ];
        let group = k.bind(self.frame.gpu, &group);
        recorder.stage(Stage::Loss, |pass| {
            pass.set_bind_group(0, &group, &[]);
            for pipeline in &k.pipelines {
                pass.set_pipeline(pipeline);
                pass.dispatch_workgroups(across as u32, down as u32, 1);
            }
        })
    }

    /// Of one band, whose lists and planes are those of the last [`Frame::band`]: records, and their sums a splat.
    pub(super) fn band(&self, recorder: &mut Recorder<'_>, band: Band, across: usize) -> crate::Result<()> {
        let (k, b, gpu) = (self.kernels, self.frame.buffers, self.frame.gpu);
        let tiles = band.rows * across;
        let at = tile_passes(tiles) % 2;
        let rasterize = [
            uniform(b, slot::VIEW, VIEW_BYTES),
            uniform(b, slot::BLEND, BLEND_BYTES),
            b.ranges.all(),
            b.pair_values[at].all(),
            b.owners.all(),
            b.shapes.all(),
            b.colors.all(),
            b.planes.all(),
            b.d_planes.all(),
            b.records.all(),
        ];
        let gather = [
            uniform(b, slot::BAND, BAND_BYTES),
            b.counts.all(),
            b.depth_values[0].all(),
            b.tile_counts.all(),
            b.first_pairs.all(),
            b.records.all(),
            b.sums.all(),
            b.marks.all(),
        ];
        let (rasterize, gather) = (k.rasterize.bind(gpu, &rasterize), k.gather.bind(gpu, &gather));
        // Pairs that no pixel used are not written.
        if self.pairs > 0 {
            recorder.clear(b.records.get(), RECORD_BYTES * self.pairs as u64);
        }
        recorder.stage(Stage::RasterizeBack, |pass| {
            pass.set_bind_group(0, &rasterize, &[]);
            pass.set_pipeline(&k.rasterize.pipelines[0]);
            let ways = if gpu.lanes() > 0 { BACK_WAYS } else { 1 };
            pass.dispatch_workgroups(across as u32, band.rows as u32, ways);
        })?;
        recorder.stage(Stage::Gather, |pass| {
            pass.set_bind_group(0, &gather, &[]);
            dispatch(pass, &k.gather, 0, b, Size::Written(arguments::VISIBLE, arguments::THREADS));
        })
    }

    /// From the sums of all bands to the gradients of all splats, and of the pose.
    pub(super) fn splats(&self, recorder: &mut Recorder<'_>, upload: &Upload) -> crate::Result<()> {
        let (k, b) = (self.kernels, self.frame.buffers);
        let bind = |(i, draw): (usize, &Draw)| {
            let group = [
                uniform(b, slot::VIEW, VIEW_BYTES),
                uniform(b, slot::PIECES + i, PIECE_BYTES),
                upload.parts[draw.part].geometry.all(),
                b.shapes.all(),
                b.colors.all(),
                b.marks.all(),
                b.sums.all(),
                b.back.all(),
                b.cameras.all(),
            ];
            (k.splats.bind(self.frame.gpu, &group), draw.groups())
        };
        let draws: Vec<_> = upload.draws.iter().enumerate().map(bind).collect();
        recorder.stage(Stage::SplatsBack, |pass| {
            for (group, groups) in &draws {
                pass.set_bind_group(0, group, &[]);
                dispatch(pass, &k.splats, 0, b, Size::Known(*groups));
            }
        })
    }
}

/// Passes of eight bits that separate `tiles` tiles, and splats without a tile.
pub(super) fn tile_passes(tiles: usize) -> usize {
    let bits = usize::BITS - tiles.leading_zeros();
    (bits as usize).div_ceil(8).clamp(1, TILE_PASSES)
}
