//! Which instructions the kernels may use, chosen once at run time.
//!
//! A kernel is one `#[inline(always)]` body over fixed-size lane arrays. It is compiled three times, inside functions
//! that enable nothing, AVX2 with FMA, and AVX-512; LLVM turns the lane loops into that level's vectors. Levels differ
//! in rounding: the scalar level has no fused multiply-adds, and the blend under AVX-512 steps differently from row to
//! row. On ARM the baseline has NEON and fused multiply-add already. All SIMD code is dispatched here, which needs
//! `unsafe`.
#![allow(unsafe_code)] // calling a function that enables a target feature, after that feature was found present

use std::sync::atomic::{AtomicU8, Ordering};

/// An instruction level; a level that the machine lacks is lowered to the best that it has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Simd {
    /// The instructions that the compiler may use on every machine of the target.
    Scalar,
    /// x86-64 with AVX2 and FMA.
    Avx2,
    /// x86-64 with AVX-512 F, BW, DQ and VL.
    Avx512,
}

/// The highest level that [`Simd::detect`] returns.
static LIMIT: AtomicU8 = AtomicU8::new(Simd::Avx512 as u8);

impl Simd {
    /// Lowers the result of [`detect`](Self::detect) from now on, in the whole process, for tests and measurements of
    /// lesser machines compute. Matrix products (`nn::matmul`) choose their instructions themselves.
    pub fn limit(level: Self) {
        LIMIT.store(level as u8, Ordering::Relaxed);
    }

    /// The best level of this machine, at most [`limit`](Self::limit).
    pub fn detect() -> Self {
        match LIMIT.load(Ordering::Relaxed) {
            0 => Simd::Scalar,
            1 => Self::of_machine().min(Simd::Avx2),
            _ => Self::of_machine(),
        }
    }

    /// Its name in files and reports. Every 64-bit ARM machine has NEON.
    pub fn name(self) -> &'static str {
        match self {
            Simd::Scalar if cfg!(target_arch = "aarch64") => "neon",
            Simd::Scalar => "scalar",
            Simd::Avx2 => "avx2",
            Simd::Avx512 => "avx512",
        }
    }

    fn of_machine() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            let avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
            let avx512 = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl");
            if avx2 && avx512 {
                return Simd::Avx512;
            }
            if avx2 {
                return Simd::Avx2;
            }
        }
        Simd::Scalar
    }
}

/// Work that is compiled once for each level. `run` must be `#[inline(always)]`, or it would be compiled once only.
pub trait Kernel {
    /// Its result.
    type Out;
    /// Does the work; `FMA` states whether fused multiply-add is an instruction here.
    fn run<const FMA: bool>(self) -> Self::Out;
    /// The same where a register holds sixteen numbers and there are 32 of them; `#[inline(always)]` too.
    #[inline(always)]
    fn run_wide<const FMA: bool>(self) -> Self::Out
    where
        Self: Sized,
    {
        self.run::<FMA>()
    }
}

/// Work that writes to two buffers of the caller. They are arguments of the compiled function itself, since only then
/// can LLVM assume that they do not overlap with the inputs: plain loops over slices inside a [`Kernel`] stay scalar
/// (measured on the loss: five times slower). `run` must be `#[inline(always)]`.
pub trait Pass {
    /// Working memory.
    type Scratch: ?Sized;
    /// Destination of results.
    type Into: ?Sized;
    /// Its result.
    type Out;
    /// Does the work; `FMA` states whether fused multiply-add is an instruction here.
    fn run<const FMA: bool>(&self, scratch: &mut Self::Scratch, into: &mut Self::Into) -> Self::Out;
}

/// Runs `kernel` at `level`, or at the best level below it that this machine has.
pub fn dispatch<K: Kernel>(level: Simd, kernel: K) -> K::Out {
    #[cfg(target_arch = "x86_64")]
    match level.min(Simd::detect()) {
        // SAFETY: detect() has just found every feature that avx512 enables.
        Simd::Avx512 => return unsafe { avx512(kernel) },
        // SAFETY: detect() has just found every feature that avx2 enables.
        Simd::Avx2 => return unsafe { avx2(kernel) },
        Simd::Scalar => {}
    }
    let _ = level;
    kernel.run::<BASELINE_FMA>()
}

/// Runs `pass` at `level`, or at the best level below it that this machine has.
pub fn dispatch_pass<P: Pass>(level: Simd, pass: &P, scratch: &mut P::Scratch, into: &mut P::Into) -> P::Out {
    #[cfg(target_arch = "x86_64")]
    match level.min(Simd::detect()) {
        // SAFETY: detect() has just found every feature that pass_avx512 enables.
        Simd::Avx512 => return unsafe { pass_avx512(pass, scratch, into) },
        // SAFETY: detect() has just found every feature that pass_avx2 enables.
        Simd::Avx2 => return unsafe { pass_avx2(pass, scratch, into) },
        Simd::Scalar => {}
    }
    let _ = level;
    pass.run::<BASELINE_FMA>(scratch, into)
}

/// [f(0), f(1), …]: `std::array::from_fn` for kernels, since that one is not always inlined into them, and then it is
/// compiled for the baseline alone (seen with 10 elements and more).
#[inline(always)]
pub fn each<T: Copy + Default, const N: usize>(f: impl Fn(usize) -> T) -> [T; N] {
    let mut out = [T::default(); N];
    for i in 0..N {
        out[i] = f(i);
    }
    out
}

/// The sum of sixteen numbers, as a tree: the same for every level and thread. Its steps are written out, since a loop
/// over them stays one under AVX-512.
#[inline(always)]
pub(crate) fn total<T: Copy + Default + std::ops::Add<Output = T>>(x: [T; 16]) -> T {
    let eight: [T; 8] = each(|i| x[i] + x[i + 8]);
    let [a, b, c, d]: [T; 4] = each(|i| eight[i] + eight[i + 4]);
    (a + c) + (b + d)
}

/// The smaller; unlike `f32::min` one instruction.
#[inline(always)]
pub(crate) fn least<T: PartialOrd>(a: T, b: T) -> T {
    if a < b { a } else { b }
}

/// The larger, in one instruction.
#[inline(always)]
pub(crate) fn greatest<T: PartialOrd>(a: T, b: T) -> T {
    if a > b { a } else { b }
}

/// One of two values that are both available. Without the hint LLVM makes a branch of it, and of the branch a masked
/// store, which costs tens of cycles.
#[inline(always)]
pub(crate) fn select<T>(condition: bool, yes: T, no: T) -> T {
    std::hint::select_unpredictable(condition, yes, no)
}

/// Every 64-bit ARM has fused multiply-add, no x86-64 need have.
const BASELINE_FMA: bool = cfg!(target_arch = "aarch64");

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2<K: Kernel>(kernel: K) -> K::Out {
    kernel.run::<true>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512bw,avx512dq,avx512vl")]
fn avx512<K: Kernel>(kernel: K) -> K::Out {
    kernel.run_wide::<true>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn pass_avx2<P: Pass>(pass: &P, scratch: &mut P::Scratch, into: &mut P::Into) -> P::Out {
    pass.run::<true>(scratch, into)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,avx512f,avx512bw,avx512dq,avx512vl")]
fn pass_avx512<P: Pass>(pass: &P, scratch: &mut P::Scratch, into: &mut P::Into) -> P::Out {
    pass.run::<true>(scratch, into)
}
