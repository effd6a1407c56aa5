//! Ground-truth images, cached on the GPU within a byte budget.

use super::buffers::{Grown, largest_binding};
use super::device::Gpu;
use crate::render::Target;
use crate::scene::Planes;
use crate::{ErrorKind, Result};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Bytes of images that are kept where the GPU shares the CPU's memory: two hundred of 1080p.
const SHARED_BYTES: u64 = 2 << 30;
/// Share of a card's free memory, in hundredths, and the least: the rest is for pairs, which grow with the scene.
const FREE_SHARE: u64 = 60;
const FREE_LEAST: u64 = 1 << 30;
/// Bytes of the blocks in which free memory is measured, and at most measured: images of 20 cameras of the Neural 3D
/// Video captures take 33 GiB.
const FREE_BLOCK: u64 = 1 << 30;
const FREE_MOST: u64 = 64 << 30;
/// What the blocks are called in errors.
const FREE: &str = "free memory";
/// Bits of `Loss::flags` in loss.wgsl.
pub(super) const FLAG_PACKED: u32 = 1;
pub(super) const FLAG_WEIGHTED: u32 = 2;
/// Weights of pixels in a plane of their own.
pub(super) const FLAG_PLANE: u32 = 8;
/// Colours of a pixel.
const COLORS: usize = 3;
/// The largest 8-bit sample, and how far a number may be from one that is sent as such: roundings of a division.
const LARGEST: f32 = 255.0;
const SAME: f32 = 1e-7;

/// An image on the GPU; another handle to the same memory when it is cloned.
#[derive(Clone, Debug)]
pub(super) struct Held {
    /// Its samples, as loss.wgsl reads them.
    pub buffer: wgpu::Buffer,
    /// Bits of its flags.
    pub flags: u32,
    /// Sum of its pixels' weights.
    pub weight: f64,
    /// Width and height.
    pub size: [usize; 2],
    /// Whether it stays until another is sent in its place.
    stays: bool,
}

impl Held {
    fn is(&self, size: [usize; 2], weighted: bool) -> bool {
        self.size == size && (self.flags & FLAG_WEIGHTED != 0) == weighted
    }
}

/// Images by their number. What fits into the budget stays; later images are sent every time.
#[derive(Debug)]
pub(super) struct Pictures {
    kept: BTreeMap<usize, Held>,
    bytes: u64,
    /// Most bytes kept; lowered where there is too little memory. None: not known before the first image.
    pub budget: Option<u64>,
    /// Memory of images that are not kept and not in use.
    spare: Vec<Grown>,
    /// Bytes of these and of those in use.
    passing: u64,
    words: Vec<u32>,
    /// Number of images sent.
    pub sent: usize,
}

impl Pictures {
    /// None yet.
    pub(super) fn new() -> Self {
        let (kept, spare, words) = (BTreeMap::new(), Vec::new(), Vec::new());
        Self { kept, bytes: 0, budget: None, spare, passing: 0, words, sent: 0 }
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes + self.passing
    }

    /// An image on the GPU, which is to be [given back](Self::give_back). `most`: bytes of images that are kept; 0: a
    /// share of the free memory. Errors: even this one does not fit.
    pub(super) fn hold(&mut self, gpu: &Gpu, target: &Target<'_, f32>, most: u64) -> Result<Held> {
        let (size, weighted) = ([target.truth.width, target.truth.height], target.weight.is_some());
        match self.kept.get(&target.picture) {
            Some(held) if held.is(size, weighted) => return Ok(held.clone()),
            // Images are of another size from here on.
            Some(_) => self.forget(),
            None => {}
        }
        let flags = pack(target, &mut self.words);
        self.sent += 1;
        let pixels = target.truth.pixels() as f64;
        let weight = target.weight.map_or(pixels, |w| w.data.iter().map(|x| f64::from(*x)).sum());
        let bytes = size_of_val(&self.words[..]) as u64;
        let budget = match self.budget {
            Some(budget) => budget,
            None => *self.budget.insert(if most > 0 { most } else { default_budget(gpu)? }),
        };
        if self.bytes + bytes <= budget {
            let mut fresh = Grown::storage("an image's truth");
            match fresh.fit(gpu, bytes) {
                Ok(()) => {
                    gpu.queue.write_buffer(fresh.get(), 0, bytemuck::cast_slice(&self.words));
                    let held = Held { buffer: fresh.get().clone(), flags, weight, size, stays: true };
                    self.bytes += fresh.bytes();
                    self.kept.insert(target.picture, held.clone());
                    return Ok(held);
                }
                Err(e) if e.kind() == ErrorKind::Memory => self.shrink(),
                Err(e) => return Err(e),
            }
        }
        let fits = self.spare.iter().position(|buffer| buffer.bytes() >= bytes);
        let mut buffer = fits.map_or_else(|| Grown::storage("an image's truth"), |at| self.spare.swap_remove(at));
        if fits.is_none() {
            buffer.fit(gpu, bytes)?;
            self.passing += buffer.bytes();
        }
        gpu.queue.write_buffer(buffer.get(), 0, bytemuck::cast_slice(&self.words));
        gpu.check()?;
        Ok(Held { buffer: buffer.get().clone(), flags, weight, size, stays: false })
    }

    /// Whether an image of this size, with or without weights, is kept under a number.
    pub(super) fn holds(&self, picture: usize, size: [usize; 2], weighted: bool) -> bool {
        self.kept.get(&picture).is_some_and(|held| held.is(size, weighted))
    }

    /// Releases an image that is no longer compared with.
    pub(super) fn give_back(&mut self, held: Held) {
        if !held.stays {
            self.spare.push(Grown::of("an image's truth", held.buffer));
        }
    }

    /// Keeps half of what is kept now, for lack of memory.
    pub(super) fn shrink(&mut self) {
        self.budget = Some(self.bytes / 2);
        self.forget();
    }

    fn forget(&mut self) {
        self.kept.clear();
        self.bytes = 0;
        self.passing -= self.spare.drain(..).map(|buffer| buffer.bytes()).sum::<u64>();
    }
}

/// Bytes of images that a GPU keeps if no setting states them. Errors: the device failed.
fn default_budget(gpu: &Gpu) -> Result<u64> {
    match gpu.has_own_memory() {
        true => Ok((free_bytes(gpu, FREE_BLOCK, FREE_MOST)? / 100 * FREE_SHARE).max(FREE_LEAST)),
        false => Ok(SHARED_BYTES),
    }
}

/// Bytes that the device grants in blocks, up to `most`. Allocations are the only portable way to learn it: neither
/// WebGPU nor wgpu reports free memory. Errors: the device failed.
fn free_bytes(gpu: &Gpu, block: u64, most: u64) -> Result<u64> {
    let block = block.min(largest_binding(gpu));
    let mut granted: Vec<Grown> = Vec::new();
    let mut free = 0;
    while free + block <= most {
        let mut next = Grown::storage(FREE);
        match next.fit(gpu, block) {
            Ok(()) => granted.push(next),
            Err(e) if e.kind() == ErrorKind::Memory => break,
            Err(e) => return Err(e),
        }
        free += block;
    }
    granted.iter().for_each(|block| block.get().destroy());
    // Memory returns to the driver when the device is polled.
    gpu.wait()?;
    Ok(free)
}

/// The 8-bit sample that a number is.
fn sample(x: f32) -> Option<u32> {
    let k = (x * LARGEST).round();
    ((0.0..=LARGEST).contains(&k) && (k / LARGEST - x).abs() <= SAME).then_some(k as u32)
}

/// An image as loss.wgsl reads it: in 8 bits if its samples have 8 bits, and so its weights. Returns its flags.
fn pack(target: &Target<'_, f32>, words: &mut Vec<u32>) -> u32 {
    let (truth, pixels) = (target.truth, target.truth.pixels());
    // Bytes of pixel after pixel: three colours, then its weight where weights have 8 bits too.
    let packed = |words: &mut Vec<u32>, weight: Option<&Planes<f32>>| {
        let each = if weight.is_some() { COLORS + 1 } else { COLORS };
        words.clear();
        words.resize((each * pixels).div_ceil(4), 0);
        let byte = |at: usize| match (at / each, at % each) {
            (pixel, _) if pixel >= pixels => Some(0),
            (pixel, COLORS) => weight.map_or(Some(0), |w| sample(w.data[pixel])),
            (pixel, channel) => sample(truth.plane(channel)[pixel]),
        };
        let word = |i: usize| (0..4).try_fold(0, |word, k| Some(word | byte(4 * i + k)? << (8 * k)));
        words.par_iter_mut().enumerate().with_min_len(1 << 14).all(|(i, to)| {
            let word = word(i);
            *to = word.unwrap_or(0);
            word.is_some()
        })
    };
    let weighted = if target.weight.is_some() { FLAG_WEIGHTED } else { 0 };
    if packed(words, target.weight) {
        return FLAG_PACKED | weighted;
    }
    let plane = if target.weight.is_some() { FLAG_PLANE } else { 0 };
    let mut flags = weighted | plane;
    if target.weight.is_some() && packed(words, None) {
        flags |= FLAG_PACKED;
    } else {
        words.clear();
        words.extend(truth.data.iter().map(|x| x.to_bits()));
    }
    words.extend(target.weight.iter().flat_map(|w| &w.data).map(|x| x.to_bits()));
    flags
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::tests::gpu;

    #[test]
    fn free_memory_is_what_the_device_grants() {
        let Some(mut gpu) = gpu() else { return };
        let mib = 1 << 20;
        assert_eq!(free_bytes(&gpu, mib, 5 * mib + 1).expect("it is there"), 5 * mib);
        gpu.refused = Some(FREE);
        assert_eq!(free_bytes(&gpu, mib, 5 * mib).expect("to have none is no failure"), 0);
        assert_eq!(
            default_budget(&gpu).expect("it is known"),
            if gpu.has_own_memory() { FREE_LEAST } else { SHARED_BYTES }
        );
    }
}
