//! The roofline of this machine, measured: upper bounds of throughput for the lower bounds of stage times.
//!
//! [`blend`] runs the arithmetic of the blend loop alone (exponent from row to row, 2^x, cut-off, α, stop test,
//! transmittance, three colours), pixels in registers: no list is walked, no row is skipped, no tile changes.
//! [`bandwidth`] is a triad over buffers far larger than any cache. Both are the best of several short runs, because
//! everything that disturbs a measurement makes it slower.

use super::simd::{Kernel, Simd, dispatch, least, select};
use crate::math::Real;
use rayon::prelude::*;
use std::hint::black_box;
use std::time::Instant;

/// Splats that pass the pixels in one run: about a millisecond.
const SPLATS: usize = 20_000;
/// Runs of each variant.
const RUNS: usize = 12;
/// Runs of the triad; the first one waits for the pages.
const SWEEPS: usize = 6;
/// Numbers in each of the triad's three buffers: 128 MiB, four times the largest cache of common servers' core groups.
const NUMBERS: usize = 1 << 25;
/// Numbers in a task of the triad: 256 KiB.
const TASK: usize = 1 << 16;
/// Bytes that STREAM counts for one number of the triad: two read, one written.
const TRIAD_BYTES: usize = 3 * size_of::<f32>();

/// Pixel pairs (a pixel and a splat) a second that one thread blends when nothing but arithmetic is in its way.
///
/// How many rows of eight or sixteen lanes in flight serve best depends on the machine's registers and on the code that
/// the compiler makes of them, so all are tried and the fastest is taken. On the Zen 4 core that this was written on
/// (2.85 GHz, AVX2) a row of eight pixels is 25 operations, which its four pipes would issue in 6.3 cycles; it takes
/// 11.8, whatever the order: a row's operations form one chain of some 50 cycles, and the core's schedulers hold 128
/// operations, about five rows. Fewer operations, or a shorter chain, would raise the ceiling itself.
pub fn blend(simd: Simd) -> f64 {
    let variants = [
        speed::<8, 1>(simd),
        speed::<8, 2>(simd),
        speed::<8, 3>(simd),
        speed::<8, 4>(simd),
        speed::<16, 1>(simd),
        speed::<16, 2>(simd),
        speed::<16, 4>(simd),
    ];
    variants.into_iter().fold(0.0, f64::max)
}

/// Bytes per second between memory and the threads of the current rayon pool: a = b + s·c, counted as STREAM does
/// (McCalpin 1995), without the reads that a cache makes before it writes.
pub fn bandwidth() -> f64 {
    let (mut a, mut b, mut c) = (vec![0.0f32; NUMBERS], vec![0.0f32; NUMBERS], vec![0.0f32; NUMBERS]);
    // Each page is first touched by a write, or the system would lend one page of zeros for all of them.
    for (buffer, value) in [(&mut b, 1.0), (&mut c, 2.0)] {
        buffer.par_chunks_mut(TASK).for_each(|part| part.fill(value));
    }
    let scale = black_box(0.5f32);
    let mut best = f64::MAX;
    for _ in 0..SWEEPS {
        let clock = Instant::now();
        a.par_chunks_mut(TASK).zip(b.par_chunks(TASK).zip(c.par_chunks(TASK))).for_each(|(a, (b, c))| {
            for ((a, b), c) in a.iter_mut().zip(b).zip(c) {
                *a = b + scale * c;
            }
        });
        best = best.min(clock.elapsed().as_secs_f64());
        black_box(&a);
    }
    (NUMBERS * TRIAD_BYTES) as f64 / best
}

fn speed<const LANES: usize, const ROWS: usize>(simd: Simd) -> f64 {
    let (splat, mut best) = (Splat::default(), f64::MAX);
    for _ in 0..RUNS {
        let clock = Instant::now();
        black_box(dispatch(simd, Pixels::<LANES, ROWS>(&splat)));
        best = best.min(clock.elapsed().as_secs_f64());
    }
    (SPLATS * LANES * ROWS) as f64 / best
}

/// The splat that passes the pixels again and again, each time a little lower; one number per lane.
#[repr(C, align(64))]
struct Splat<const LANES: usize> {
    /// Exponent at a pixel: ax + q·dy.
    ax: [f32; LANES],
    /// Changes of q and dy from row to row.
    step: [[f32; LANES]; 2],
    /// log₂ of α's ceiling, which the opacity gives.
    top: [f32; LANES],
    log_min: [f32; LANES],
    t_min: [f32; LANES],
    color: [[f32; LANES]; 3],
}

impl<const LANES: usize> Default for Splat<LANES> {
    /// Faint and wide: T falls slowly and no exponent leaves its range. Times do not depend on the values.
    fn default() -> Self {
        Self {
            ax: std::array::from_fn(|l| -6.0 - 0.01 * l as f32),
            step: [[1e-6; LANES], [1e-5; LANES]],
            top: [-0.5; LANES],
            log_min: [-8.0; LANES],
            t_min: [1e-4; LANES],
            color: [0.2, 0.5, 0.7].map(|c| [c; LANES]),
        }
    }
}

/// Rows of pixels under a splat.
struct Pixels<'a, const LANES: usize, const ROWS: usize>(&'a Splat<LANES>);

/// One row of pixels.
#[derive(Clone, Copy)]
struct Row<const LANES: usize> {
    q: [f32; LANES],
    dy: [f32; LANES],
    t: [f32; LANES],
    color: [[f32; LANES]; 3],
}

impl<const LANES: usize, const ROWS: usize> Kernel for Pixels<'_, LANES, ROWS> {
    type Out = f32;
    #[inline(always)]
    fn run<const FMA: bool>(self) -> f32 {
        let (q, t, color) = ([-0.1; LANES], [1.0; LANES], [[0.0; LANES]; 3]);
        let row = |r| Row { q, dy: [0.1 * r as f32; LANES], t, color };
        let mut rows: [Row<LANES>; ROWS] = std::array::from_fn(row);
        for _ in 0..SPLATS {
            // The splat's numbers are read from the cache each time, as operands of the arithmetic: held in registers
            // they would push the pixels out.
            let splat = black_box(self.0);
            for row in &mut rows {
                pass::<LANES, FMA>(splat, row);
            }
        }
        // Everything that was computed is used. By value: rows that something points to would live in memory.
        black_box(rows).iter().flat_map(|r| r.color.iter().flatten().chain(&r.t)).sum()
    }
}

#[inline(always)]
fn pass<const LANES: usize, const FMA: bool>(s: &Splat<LANES>, row: &mut Row<LANES>) {
    let Row { mut q, mut dy, mut t, mut color } = *row;
    let mut weight = [0.0; LANES];
    for l in 0..LANES {
        let power = least(q[l].fma::<FMA>(dy[l], s.ax[l]), s.top[l]);
        let alpha = select(power >= s.log_min[l], power.blend_exp2::<FMA>(), 0.0);
        let full = alpha * t[l];
        let kept = t[l] - full;
        let open = kept >= s.t_min[l];
        weight[l] = select(open, full, 0.0);
        t[l] = select(open, kept, -t[l].abs());
        q[l] -= s.step[0][l];
        dy[l] -= s.step[1][l];
    }
    for c in 0..3 {
        for l in 0..LANES {
            color[c][l] = weight[l].fma::<FMA>(s.color[c][l], color[c][l]);
        }
    }
    *row = Row { q, dy, t, color };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loop_blends() {
        // Every pixel stopped with T just above t_min: light 1 − T left it, and its T is then negative.
        let splat = Splat { color: [[1.0; 8], [0.0; 8], [0.0; 8]], ..Splat::default() };
        let sum = dispatch(Simd::Scalar, Pixels::<8, 2>(&splat));
        let expected = 16.0 * (1.0 - 2.0 * splat.t_min[0]);
        assert!((sum - expected).abs() < 3e-4 * expected, "{sum} instead of {expected}");
    }
}
