//! The dispatch of the convolution kernel to the instruction sets of [`crate::loss::simd`].
#![allow(unsafe_code)]

use super::conv;
use crate::loss::simd::Simd;

/// Runs the convolution kernel at this level; see [`conv::row`].
pub(super) fn convolve(level: Simd, job: &conv::Row<'_>, out: &mut [f32]) {
    if !level.fused() {
        return conv::row::<false>(job, out);
    }
    #[cfg(target_arch = "x86_64")]
    {
        // SAFETY: `Simd::detect` is the only way to a fused level, and it has seen AVX2 and FMA on this CPU.
        unsafe { convolve_avx2(job, out) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        conv::row::<true>(job, out)
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn convolve_avx2(job: &conv::Row<'_>, out: &mut [f32]) {
    conv::row::<true>(job, out)
}
