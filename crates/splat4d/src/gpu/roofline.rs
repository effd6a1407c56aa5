//! Measured upper bounds of a GPU's throughput, for the lower bounds of stage times.

use super::buffers::Grown;
use super::kernels::{Kernel, Kind};
use super::{GpuRenderer, MOST_GROUPS, OWNER_SHIFT, THREADS, largest_binding};
use crate::{Result, wgsl};
use std::time::Instant;
use wgpu::BufferUsages as Usage;

/// Splats that pass a thread's pixel (roofline.wgsl).
const SPLATS: usize = 1024;
/// A measurement is made longer until it takes this many seconds: then a submission costs next to nothing.
const LONG: f64 = 0.03;
/// Runs of which the best counts.
const RUNS: usize = 4;
/// Bytes of a copy: several times what the largest caches hold (60 MB on an H200).
const COPY: u64 = 1 << 28;
/// Bytes that a workgroup of copy.wgsl copies: 256 threads, four vectors of sixteen bytes each.
const COPY_GROUP: u64 = 256 * 4 * 16;
/// Bytes that are sent and read: an image of 1080p.
const BUS: u64 = 1 << 25;
/// Copies in one submission at most.
const MOST_COPIES: usize = 1 << 12;
/// Pixels of a quadrant of a tile.
const QUADRANT_PIXELS: u64 = 64;

/// Peak throughput of a GPU.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GpuRoofline {
    /// Pairs of pixel and Gaussian a second.
    pub pairs: f64,
    /// Bytes per second, read and written.
    pub bytes: f64,
    /// Bytes per second from the CPU's memory, and to it.
    pub bus: [f64; 2],
}

impl GpuRenderer {
    /// Measures the blend's arithmetic alone, and copies in the GPU's memory. Errors: no memory for it, or a driver
    /// that failed.
    pub fn roofline(&self) -> Result<GpuRoofline> {
        Ok(GpuRoofline { pairs: self.pairs_a_second()?, bytes: self.bytes_a_second()?, bus: self.bus()? })
    }

    /// Pairs of pixel and Gaussian in the lists of the last render: those of every pixel of a quadrant that a Gaussian
    /// may touch, at most; of the last band alone, where there are several. Errors: a driver that failed.
    pub fn evaluations(&self) -> Result<u64> {
        let owners: Vec<u32> = self.read_back(&self.buffers.owners, self.drawn.last().map_or(0, |d| d.1))?;
        Ok(owners.iter().map(|owner| QUADRANT_PIXELS * u64::from((owner >> OWNER_SHIFT).count_ones())).sum())
    }

    /// The first `n` numbers of a buffer.
    pub(super) fn read_back(&self, buffer: &Grown, n: usize) -> Result<Vec<u32>> {
        if n == 0 {
            return Ok(Vec::new());
        }
        let bytes = (4 * n) as u64;
        let mut staging = Grown::new("numbers", Usage::MAP_READ | Usage::COPY_DST);
        staging.ensure(&self.gpu, bytes)?;
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(buffer.get(), 0, staging.get(), 0, bytes);
        self.gpu.queue.submit([encoder.finish()]);
        staging.get().map_async(wgpu::MapMode::Read, ..bytes, |_| ());
        self.gpu.wait()?;
        let view = staging.get().get_mapped_range(..bytes);
        Ok(view.map_or_else(|_| Vec::new(), |view| bytemuck::pod_collect_to_vec(&view)))
    }

    /// Units of work a second; `record` receives how often to do one.
    fn best(&self, most: usize, mut record: impl FnMut(&mut wgpu::CommandEncoder, usize)) -> Result<f64> {
        let (mut times, mut best, mut runs) = (1, 0.0f64, 0);
        while runs < RUNS {
            let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
            record(&mut encoder, times);
            let clock = Instant::now();
            self.gpu.queue.submit([encoder.finish()]);
            self.gpu.wait()?;
            let seconds = clock.elapsed().as_secs_f64();
            if seconds < LONG && times < most {
                times = (2 * times).min(most);
                continue;
            }
            best = best.max(times as f64 / seconds);
            runs += 1;
        }
        Ok(best)
    }

    fn pairs_a_second(&self) -> Result<f64> {
        let kernel = Kernel::new(&self.gpu, "roofline", &[wgsl::ROOFLINE], &[Kind::Write], &["roofline"]);
        let mut out = Grown::storage("the roofline's numbers");
        out.ensure(&self.gpu, (4 * MOST_GROUPS * THREADS) as u64)?;
        let group = kernel.bind(&self.gpu, &[out.all()]);
        let groups = self.best(MOST_GROUPS, |encoder, groups| {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_bind_group(0, &group, &[]);
            pass.set_pipeline(&kernel.pipelines[0]);
            pass.dispatch_workgroups(groups as u32, 1, 1);
        })?;
        Ok(groups * (THREADS * SPLATS) as f64)
    }

    /// Bytes per second of uploads and downloads: tables are sent and images are read.
    fn bus(&self) -> Result<[f64; 2]> {
        let data = vec![1u8; BUS as usize];
        let mut on_gpu = Grown::storage("a copy's target");
        on_gpu.ensure(&self.gpu, BUS)?;
        let mut best = [0.0f64; 2];
        for _ in 0..RUNS {
            let clock = Instant::now();
            self.gpu.queue.write_buffer(on_gpu.get(), 0, &data);
            self.gpu.queue.submit([]);
            self.gpu.wait()?;
            best[0] = best[0].max(BUS as f64 / clock.elapsed().as_secs_f64());
            let clock = Instant::now();
            let numbers = self.read_back(&on_gpu, data.len() / 4)?;
            best[1] = best[1].max(4.0 * numbers.len() as f64 / clock.elapsed().as_secs_f64());
        }
        Ok(best)
    }

    /// By the driver's own copies or by a kernel's, whichever is faster: on an H200 Adam alone
    /// moved three times what the driver's copies did.
    fn bytes_a_second(&self) -> Result<f64> {
        let bytes = COPY.min(largest_binding(&self.gpu)) / COPY_GROUP * COPY_GROUP;
        let (mut from, mut to) = (Grown::storage("a copy's source"), Grown::storage("a copy's target"));
        from.ensure(&self.gpu, bytes)?;
        to.ensure(&self.gpu, bytes)?;
        let of_driver = self.best(MOST_COPIES, |encoder, copies| {
            for _ in 0..copies {
                encoder.copy_buffer_to_buffer(from.get(), 0, to.get(), 0, bytes);
            }
        })?;
        let kernel = Kernel::new(&self.gpu, "copy", &[wgsl::COPY], &[Kind::Read, Kind::Write], &["copy"]);
        let group = kernel.bind(&self.gpu, &[from.all(), to.all()]);
        let of_kernel = self.best(MOST_COPIES, |encoder, copies| {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_bind_group(0, &group, &[]);
            pass.set_pipeline(&kernel.pipelines[0]);
            for _ in 0..copies {
                pass.dispatch_workgroups((bytes / COPY_GROUP) as u32, 1, 1);
            }
        })?;
        // Each is read and written.
        Ok(2.0 * of_driver.max(of_kernel) * bytes as f64)
    }
}
