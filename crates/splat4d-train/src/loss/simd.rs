//! The instruction sets of losses and metrics, chosen at run time, and the dispatch of the loss kernel.
//!
//! A kernel is written once and compiled twice: for the baseline CPU, and with AVX2 and FMA switched on. [`Simd`] can
//! only hold a level that this CPU has, which is what makes the calls below sound.
#![allow(unsafe_code)]

use super::kernel::{self, Scratch, Strip};
use splat4d::math::Real;

/// An instruction set that this CPU is known to have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Simd {
    fused: bool,
}

impl Simd {
    /// The best level of this CPU.
    pub fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        let fused = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        // NEON, with fused multiply-add, is part of every 64-bit Arm.
        #[cfg(not(target_arch = "x86_64"))]
        let fused = cfg!(target_arch = "aarch64");
        Self { fused }
    }

    /// What every CPU of the target has, without fused multiply-add.
    pub fn baseline() -> Self {
        Self { fused: false }
    }

    /// Whether products and sums are fused (one rounding less).
    pub fn fused(self) -> bool {
        self.fused
    }
}

/// Runs the loss kernel over one strip at this level; see [`kernel::strip`].
pub(super) fn strip<F: Real>(level: Simd, job: &Strip<'_, F>, scratch: &mut Scratch<F>, d: &mut [F]) -> [f64; 2] {
    if !level.fused {
        return kernel::strip::<F, false>(job, scratch, d);
    }
    #[cfg(target_arch = "x86_64")]
    {
        // SAFETY: `Simd::detect` is the only way to a fused level, and it has seen AVX2 and FMA on this CPU.
        unsafe { strip_avx2(job, scratch, d) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        kernel::strip::<F, true>(job, scratch, d)
    }
}

// The kernel's slices are this function's own arguments, since only then does LLVM know that they do not overlap:
// handed over inside a struct, the loops stay scalar (measured: five times slower).
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn strip_avx2<F: Real>(job: &Strip<'_, F>, scratch: &mut Scratch<F>, d: &mut [F]) -> [f64; 2] {
    kernel::strip::<F, true>(job, scratch, d)
}
