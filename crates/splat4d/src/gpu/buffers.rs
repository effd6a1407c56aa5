//! GPU memory: one arena that grows and is reused from frame to frame.

use super::device::Gpu;
use crate::{Error, ErrorKind, Result};
use wgpu::BufferUsages as Usage;

/// Bytes that the smallest buffer has: no binding may be empty.
const LEAST: u64 = 256;
/// A buffer that grows gets this share more than it needs, so that a scene that grows slowly does not make it again
/// every frame.
pub(super) const SPARE: u64 = 4;

/// One buffer, made again when it must hold more.
#[derive(Debug)]
pub(super) struct Grown {
    what: &'static str,
    usage: Usage,
    buffer: Option<wgpu::Buffer>,
}

impl Grown {
    /// Nothing yet. `what` names the content in errors.
    pub(super) fn new(what: &'static str, usage: Usage) -> Self {
        Self { what, usage, buffer: None }
    }

    /// A buffer that was made already.
    pub(super) fn of(what: &'static str, buffer: wgpu::Buffer) -> Self {
        Self { what, usage: buffer.usage(), buffer: Some(buffer) }
    }

    /// Storage that copies may read and write.
    pub(super) fn storage(what: &'static str) -> Self {
        Self::new(what, Usage::STORAGE | Usage::COPY_SRC | Usage::COPY_DST)
    }

    /// Ensures a size of `bytes`. Returns whether the buffer is new, with undefined content.
    ///
    /// Errors: more than one binding may hold, or no memory.
    pub(super) fn ensure(&mut self, gpu: &Gpu, bytes: u64) -> Result<bool> {
        if self.buffer.as_ref().is_some_and(|b| b.size() >= bytes.max(LEAST)) {
            return Ok(false);
        }
        let most = largest_binding(gpu).max(bytes);
        self.make(gpu, (bytes + bytes / SPARE).clamp(LEAST, most).next_multiple_of(LEAST))?;
        Ok(true)
    }

    /// Makes the buffer again with `size` bytes.
    fn make(&mut self, gpu: &Gpu, size: u64) -> Result<()> {
        let most = largest_binding(gpu);
        if size > most.next_multiple_of(LEAST) {
            let mib = |b: u64| b.div_ceil(1 << 20);
            let text = format!("{} need {} MiB in one GPU buffer, {} MiB are allowed", self.what, mib(size), mib(most));
            return Err(Error::new(ErrorKind::Unsupported, text).remedy("Render on the CPU."));
        }
        if gpu.refused == Some(self.what) {
            return Err(gpu.error(ErrorKind::Memory, format!("{size} bytes of {}", self.what)));
        }
        // The old one is freed first: both together may not fit.
        self.buffer = None;
        self.buffer = Some(gpu.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(self.what),
            size,
            usage: self.usage,
            mapped_at_creation: false,
        }));
        gpu.check()
    }

    /// Ensures a size of `bytes` without spare capacity, for buffers that never grow.
    ///
    /// Errors: as of [`ensure`](Self::ensure).
    pub(super) fn fit(&mut self, gpu: &Gpu, bytes: u64) -> Result<()> {
        if self.bytes() < bytes.max(LEAST) {
            self.make(gpu, bytes.max(LEAST).next_multiple_of(LEAST))?;
        }
        Ok(())
    }

    /// The buffer. Panics before the first [`Grown::ensure`].
    pub(crate) fn get(&self) -> &wgpu::Buffer {
        self.buffer.as_ref().expect("a buffer is made before it is used")
    }

    /// All of it.
    pub(crate) fn all(&self) -> wgpu::BindingResource<'_> {
        self.get().as_entire_binding()
    }

    /// Bytes held.
    pub(crate) fn bytes(&self) -> u64 {
        self.buffer.as_ref().map_or(0, wgpu::Buffer::size)
    }
}

/// Bytes that one binding may hold.
pub(super) fn largest_binding(gpu: &Gpu) -> u64 {
    let limits = gpu.device.limits();
    limits.max_storage_buffer_binding_size.min(limits.max_buffer_size)
}

/// Bytes between two uniforms in one buffer (WebGPU's default alignment).
pub(super) const UNIFORM_STRIDE: u64 = 256;

/// Everything but the scene's tables.
#[derive(Debug)]
pub(super) struct Buffers {
    /// One structure every [`UNIFORM_STRIDE`] bytes.
    pub uniforms: Grown,
    /// Splats, visible ones, pairs.
    pub counts: Grown,
    /// Sizes of dispatches over the visible splats, and over the pairs: apart, because no buffer may be written while
    /// it gives the size of a dispatch.
    pub arguments: [Grown; 2],
    /// Two vec4 a splat.
    pub shapes: Grown,
    /// A vec4 a splat.
    pub colors: Grown,
    /// 1 a visible splat.
    pub marks: Grown,
    /// Exclusive sums of the marks.
    pub places: Grown,
    /// Depths of visible splats, to and fro.
    pub depth_keys: [Grown; 2],
    /// Their numbers.
    pub depth_values: [Grown; 2],
    /// Counts of the sort.
    pub sort_counts: Grown,
    /// Sums of blocks of the scan.
    pub scan_sums: Grown,
    /// Tiles a visible splat, nearest first.
    pub tile_counts: Grown,
    /// Exclusive sums of them.
    pub first_pairs: Grown,
    /// Tiles of pairs, to and fro.
    pub pair_keys: [Grown; 2],
    /// Their numbers.
    pub pair_values: [Grown; 2],
    /// Splat and quadrants of a pair, by its number.
    pub owners: Grown,
    /// Three numbers per tile.
    pub ranges: Grown,
    /// Five planes.
    pub planes: Grown,
    /// A pixel in 8 bits per channel.
    pub bytes: Grown,
    /// Gradient to the planes.
    pub d_planes: Grown,
    /// Nine planes of the loss.
    pub maps: Grown,
    /// Sixteen numbers per tile of the loss.
    pub partials: Grown,
    /// Twelve sums a pair, then three per tile.
    pub records: Grown,
    /// Twelve a splat.
    pub sums: Grown,
    /// Twenty numbers per splat for the CPU.
    pub back: Grown,
    /// Six a workgroup.
    pub cameras: Grown,
    /// Timestamps.
    pub times: Grown,
    /// Memory that the CPU reads.
    pub staging: Grown,
    /// The same, of the backward pass.
    pub back_staging: Grown,
}

impl Buffers {
    /// Without memory yet.
    pub(crate) fn new() -> Self {
        let storage = Grown::storage;
        let sizes = || Grown::new("sizes", Usage::STORAGE | Usage::INDIRECT | Usage::COPY_SRC | Usage::COPY_DST);
        Self {
            uniforms: Grown::new("uniforms", Usage::UNIFORM | Usage::COPY_DST),
            counts: storage("counts"),
            arguments: [sizes(), sizes()],
            shapes: storage("the splats' shapes"),
            colors: storage("the splats' colours"),
            marks: storage("marks"),
            places: storage("places"),
            depth_keys: [storage("depths"), storage("depths")],
            depth_values: [storage("the splats' numbers"), storage("the splats' numbers")],
            sort_counts: storage("counts of the sort"),
            scan_sums: storage("sums"),
            tile_counts: storage("counts of tiles"),
            first_pairs: storage("numbers of pairs"),
            pair_keys: [storage("pairs of tile and splat"), storage("pairs of tile and splat")],
            pair_values: [storage("pairs of tile and splat"), storage("pairs of tile and splat")],
            owners: storage("pairs of tile and splat"),
            ranges: storage("the tiles' lists"),
            planes: storage("the image's planes"),
            bytes: storage("the image's bytes"),
            d_planes: storage("the gradient to the image"),
            maps: storage("the loss's planes"),
            partials: storage("the loss's sums"),
            records: storage("gradients of pairs of tile and splat"),
            sums: storage("gradients of the splats"),
            back: storage("gradients of the Gaussians"),
            cameras: storage("gradients of the camera"),
            times: Grown::new("timestamps", Usage::QUERY_RESOLVE | Usage::COPY_SRC),
            staging: Grown::new("the image", Usage::MAP_READ | Usage::COPY_DST),
            back_staging: Grown::new("the gradients", Usage::MAP_READ | Usage::COPY_DST),
        }
    }

    /// Bytes held.
    pub(crate) fn bytes(&self) -> u64 {
        let one = [
            &self.uniforms,
            &self.counts,
            &self.shapes,
            &self.colors,
            &self.marks,
            &self.places,
            &self.sort_counts,
            &self.scan_sums,
            &self.tile_counts,
            &self.first_pairs,
            &self.owners,
            &self.ranges,
            &self.planes,
            &self.bytes,
            &self.d_planes,
            &self.maps,
            &self.partials,
            &self.records,
            &self.sums,
            &self.back,
            &self.cameras,
            &self.times,
            &self.staging,
            &self.back_staging,
        ];
        let two = [&self.arguments, &self.depth_keys, &self.depth_values, &self.pair_keys, &self.pair_values];
        one.iter().map(|b| b.bytes()).sum::<u64>() + two.iter().flat_map(|b| b.iter()).map(Grown::bytes).sum::<u64>()
    }
}
