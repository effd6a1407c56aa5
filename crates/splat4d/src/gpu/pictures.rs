//! Ground-truth images, cached on the GPU within a byte budget.

use super::buffers::Grown;
use super::device::Gpu;
use crate::render::Target;
use crate::scene::Planes;
use crate::{ErrorKind, Result};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Bytes of images that are kept by default: two hundred of 1080p, which cards with 4 GiB have
/// next to a
/// million Gaussians.
pub(super) const PICTURE_BYTES: u64 = 2 << 30;
/// Bits of `Loss::flags` in loss.wgsl.
pub(super) const FLAG_PACKED: u32 = 1;
pub(super) const FLAG_WEIGHTED: u32 = 2;
/// Weights of pixels in a plane of their own.
pub(super) const FLAG_PLANE: u32 = 8;
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

/// Images by their number. What fits into the budget stays; later images are sent every time.
#[derive(Debug)]
pub(super) struct Pictures {
    kept: BTreeMap<usize, Held>,
    bytes: u64,
    /// Most bytes kept; lowered where there is too little memory.
    pub budget: u64,
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
        Self { kept, bytes: 0, budget: PICTURE_BYTES, spare, passing: 0, words, sent: 0 }
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes + self.passing
    }

    /// An image on the GPU, which is to be [given back](Self::give_back). Errors: even this one does not fit.
    pub(super) fn hold(&mut self, gpu: &Gpu, target: &Target<'_, f32>) -> Result<Held> {
        let (size, weighted) = ([target.truth.width, target.truth.height], target.weight.is_some());
        match self.kept.get(&target.picture) {
            Some(held) if held.size == size && (held.flags & FLAG_WEIGHTED != 0) == weighted => {
                return Ok(held.clone());
            }
            // Images are of another size from here on.
            Some(_) => self.forget(),
            None => {}
        }
        let flags = pack(target, &mut self.words);
        self.sent += 1;
        let pixels = target.truth.pixels() as f64;
        let weight = target.weight.map_or(pixels, |w| w.data.iter().map(|x| f64::from(*x)).sum());
        let bytes = size_of_val(&self.words[..]) as u64;
        if self.bytes + bytes <= self.budget {
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

    /// Releases an image that is no longer compared with.
    pub(super) fn give_back(&mut self, held: Held) {
        if !held.stays {
            self.spare.push(Grown::of("an image's truth", held.buffer));
        }
    }

    /// Keeps half of what is kept now, for lack of memory.
    pub(super) fn shrink(&mut self) {
        self.budget = self.bytes / 2;
        self.forget();
    }

    fn forget(&mut self) {
        self.kept.clear();
        self.bytes = 0;
        self.passing -= self.spare.drain(..).map(|buffer| buffer.bytes()).sum::<u64>();
    }
}

/// The 8-bit sample that a number is.
fn sample(x: f32) -> Option<u32> {
    let k = (x * LARGEST).round();
    ((0.0..=LARGEST).contains(&k) && (k / LARGEST - x).abs() <= SAME).then_some(k as u32)
}

/// An image as loss.wgsl reads it: in 8 bits if its samples have 8 bits, and so its weights. Returns its flags.
fn pack(target: &Target<'_, f32>, words: &mut Vec<u32>) -> u32 {
    let (truth, pixels) = (target.truth, target.truth.pixels());
    let packed = |words: &mut Vec<u32>, weight: Option<&Planes<f32>>| {
        words.clear();
        words.resize(pixels, 0);
        let word = |i: usize| {
            let at = |plane: &Planes<f32>, c: usize| sample(plane.plane(c)[i]);
            let weight = weight.map_or(Some(0), |w| at(w, 0))?;
            Some(at(truth, 0)? | at(truth, 1)? << 8 | at(truth, 2)? << 16 | weight << 24)
        };
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
