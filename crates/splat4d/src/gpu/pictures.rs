//! The pictures that are compared with, kept on the GPU within a budget of bytes.

use super::buffers::Grown;
use super::device::Gpu;
use crate::render::Target;
use crate::scene::Planes;
use crate::{ErrorKind, Result};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Bytes of pictures that are kept unless somebody says otherwise: two hundred of 1080p, which cards with 4 GiB have beside a
/// million Gaussians.
pub(super) const PICTURE_BYTES: u64 = 2 << 30;
/// Bits of `Loss::flags` in loss.wgsl.
pub(super) const FLAG_PACKED: u32 = 1;
pub(super) const FLAG_WEIGHTED: u32 = 2;
/// The largest 8-bit sample, and how far a number may be from one that is sent as such: roundings of a division.
const LARGEST: f32 = 255.0;
const SAME: f32 = 1e-7;

/// A picture on the GPU.
#[derive(Debug)]
pub(super) struct Held {
    /// Its samples, as loss.wgsl reads them.
    pub buffer: Grown,
    /// Bits of its flags.
    pub flags: u32,
    /// Sum of its pixels' weights.
    pub weight: f64,
    size: [usize; 2],
}

impl Held {
    fn new() -> Self {
        Self { buffer: Grown::storage("a picture's truth"), flags: 0, weight: 0.0, size: [0; 2] }
    }

    /// Sends a picture. Errors: too little memory.
    fn send(&mut self, gpu: &Gpu, words: &[u32], flags: u32, target: &Target<'_, f32>) -> Result<()> {
        self.buffer.fit(gpu, size_of_val(words) as u64)?;
        gpu.queue.write_buffer(self.buffer.get(), 0, bytemuck::cast_slice(words));
        let pixels = target.truth.pixels() as f64;
        self.weight = target.weight.map_or(pixels, |w| w.data.iter().map(|x| f64::from(*x)).sum());
        (self.flags, self.size) = (flags, size(target));
        gpu.check()
    }
}

fn size(target: &Target<'_, f32>) -> [usize; 2] {
    [target.truth.width, target.truth.height]
}

/// Pictures by their number. What fits into the budget stays; what comes later is sent every time.
#[derive(Debug)]
pub(super) struct Pictures {
    kept: BTreeMap<usize, Held>,
    bytes: u64,
    /// Most bytes kept; lowered where there is too little memory.
    pub budget: u64,
    /// The last picture that was not kept.
    once: Held,
    words: Vec<u32>,
    /// Pictures sent so far.
    pub sent: usize,
}

impl Pictures {
    /// None yet.
    pub(super) fn new() -> Self {
        let (kept, words) = (BTreeMap::new(), Vec::new());
        Self { kept, bytes: 0, budget: PICTURE_BYTES, once: Held::new(), words, sent: 0 }
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes + self.once.buffer.bytes()
    }

    /// Sees to it that a picture is there. Errors: not even this one has room.
    pub(super) fn hold(&mut self, gpu: &Gpu, target: &Target<'_, f32>) -> Result<()> {
        let weighted = |held: &Held| (held.flags & FLAG_WEIGHTED != 0) == target.weight.is_some();
        match self.kept.get(&target.picture).map(|held| held.size == size(target) && weighted(held)) {
            Some(true) => return Ok(()),
            // Pictures are of another size from here on.
            Some(false) => self.forget(),
            None => {}
        }
        let flags = pack(target, &mut self.words);
        self.sent += 1;
        if self.bytes + size_of_val(&self.words[..]) as u64 <= self.budget {
            let mut held = Held::new();
            match held.send(gpu, &self.words, flags, target) {
                Ok(()) => {
                    self.bytes += held.buffer.bytes();
                    self.kept.insert(target.picture, held);
                    return Ok(());
                }
                Err(e) if e.kind() == ErrorKind::Memory => {
                    self.budget = self.bytes / 2;
                    self.forget();
                }
                Err(e) => return Err(e),
            }
        }
        self.once.send(gpu, &self.words, flags, target)
    }

    /// A picture that was seen to last.
    pub(super) fn get(&self, picture: usize) -> &Held {
        self.kept.get(&picture).unwrap_or(&self.once)
    }

    fn forget(&mut self) {
        self.kept.clear();
        self.bytes = 0;
    }
}

/// The 8-bit sample that a number is.
fn sample(x: f32) -> Option<u32> {
    let k = (x * LARGEST).round();
    ((0.0..=LARGEST).contains(&k) && (k / LARGEST - x).abs() <= SAME).then_some(k as u32)
}

/// A picture as loss.wgsl reads it: in 8 bits where that is what its samples are. Returns its flags.
fn pack(target: &Target<'_, f32>, words: &mut Vec<u32>) -> u32 {
    let (truth, pixels) = (target.truth, target.truth.pixels());
    let weighted = if target.weight.is_some() { FLAG_WEIGHTED } else { 0 };
    words.resize(pixels, 0);
    let word = |i: usize| {
        let at = |plane: &Planes<f32>, c: usize| sample(plane.plane(c)[i]);
        let weight = target.weight.map_or(Some(0), |w| at(w, 0))?;
        Some(at(truth, 0)? | at(truth, 1)? << 8 | at(truth, 2)? << 16 | weight << 24)
    };
    let packed = words.par_iter_mut().enumerate().with_min_len(1 << 14).all(|(i, to)| {
        let word = word(i);
        *to = word.unwrap_or(0);
        word.is_some()
    });
    if packed {
        return FLAG_PACKED | weighted;
    }
    words.clear();
    words.extend(truth.data.iter().chain(target.weight.iter().flat_map(|w| &w.data)).map(|x| x.to_bits()));
    weighted
}
