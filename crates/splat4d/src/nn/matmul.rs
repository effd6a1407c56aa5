//! Matrix products on one thread: the only interface to `gemm`'s kernels, with every bound checked.
//!
//! `gemm-f32` is the part of `gemm` that is used: the crate of that name also builds its kernels for complex numbers and
//! half floats, which is a third of a clean build of everything that is not ours. Networks are in f64 only in tests,
//! where plain sums are fast enough.
#![allow(unsafe_code)] // the kernels take pointers; every matrix that reaches it was checked to be inside its slice

use crate::math::Real;
use gemm_common::Parallelism;
use std::any::TypeId;

/// A matrix in a slice: element (i, j) is `data[i·row + j·column]`.
#[derive(Clone, Copy, Debug)]
pub struct Matrix<'a, F> {
    data: &'a [F],
    rows: usize,
    columns: usize,
    row: usize,
    column: usize,
}

impl<'a, F> Matrix<'a, F> {
    /// Row-major, rows `stride` numbers apart. Panics: it does not fit into the slice.
    pub fn new(data: &'a [F], rows: usize, columns: usize, stride: usize) -> Self {
        fits(data.len(), rows, columns, stride);
        Self { data, rows, columns, row: stride, column: 1 }
    }

    /// The transpose, of the same numbers.
    #[must_use]
    pub fn t(self) -> Self {
        Self { rows: self.columns, columns: self.rows, row: self.column, column: self.row, ..self }
    }
}

fn fits(len: usize, rows: usize, columns: usize, stride: usize) {
    assert!(columns <= stride || rows <= 1, "rows of {columns} numbers overlap at a stride of {stride}");
    let last = rows.saturating_sub(1).checked_mul(stride).and_then(|n| n.checked_add(columns));
    assert!(rows == 0 || last.is_some_and(|n| n <= len), "[{rows}, {columns}] by {stride} does not fit into {len}");
}

/// out = a·b, or out += a·b if `add`; `out` is row-major with rows `stride` numbers apart, [a's rows, b's columns].
///
/// Panics: the inner sizes differ, or `out` is too small.
pub fn product<F: Real>(a: Matrix<'_, F>, b: Matrix<'_, F>, out: &mut [F], stride: usize, add: bool) {
    assert_eq!(a.columns, b.rows, "[{}, {}] times [{}, {}]", a.rows, a.columns, b.rows, b.columns);
    fits(out.len(), a.rows, b.columns, stride);
    if a.rows == 0 || b.columns == 0 {
        return;
    }
    // The kernels are fastest where columns of `out` are contiguous: out = a·b is then made as outᵀ = bᵀ·aᵀ.
    let (a, b, [row, column]) = if stride > 1 { (b.t(), a.t(), [1, stride]) } else { (a, b, [stride, 1]) };
    let distance = |n: usize| isize::try_from(n).expect("a slice is at most isize::MAX long");
    if TypeId::of::<F>() != TypeId::of::<f32>() {
        return sums(a, b, out, [row, column], add);
    }
    // SAFETY: `fits` has found all three matrices inside their slices; `out` is borrowed alone, so nothing overlaps; F is
    // f32, the type that the pointers are cast to.
    unsafe {
        gemm_f32::gemm::f32::get_gemm_fn()(
            a.rows,
            b.columns,
            a.columns,
            out.as_mut_ptr().cast(),
            distance(column),
            distance(row),
            add,
            a.data.as_ptr().cast(),
            distance(a.column),
            distance(a.row),
            b.data.as_ptr().cast(),
            distance(b.column),
            distance(b.row),
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

/// The product as its definition states it; element (i, j) is `out[i·row + j·column]`.
fn sums<F: Real>(a: Matrix<'_, F>, b: Matrix<'_, F>, out: &mut [F], [row, column]: [usize; 2], add: bool) {
    for i in 0..a.rows {
        for j in 0..b.columns {
            let terms = (0..a.columns).map(|l| a.data[i * a.row + l * a.column] * b.data[l * b.row + j * b.column]);
            let (sum, to) = (terms.sum::<F>(), &mut out[i * row + j * column]);
            *to = if add { *to + sum } else { sum };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    fn check<F: Real>(tolerance: f64) {
        let rng = Rng::new(1, "matmul", 0);
        for (m, k, n) in [(1, 1, 1), (1, 300, 7), (5, 0, 3), (33, 17, 40), (130, 64, 9), (64, 500, 65)] {
            let (sa, sb, so) = (k + 2, k + 1, n + 3);
            let fill = |len: usize, s: u64| (0..len as u64).map(|i| F::of(rng.fork(s).normal(i))).collect::<Vec<F>>();
            let (a, b, out) = (fill(m * sa, 1), fill(n * sb, 2), fill(m * so, 3));
            for add in [false, true] {
                let mut got = out.clone();
                product(Matrix::new(&a, m, k, sa), Matrix::new(&b, n, k, sb).t(), &mut got, so, add);
                for i in 0..m {
                    for j in 0..so {
                        let sum: f64 = (0..k).map(|l| a[i * sa + l].f64() * b[j.min(n - 1) * sb + l].f64()).sum();
                        let old = out[i * so + j].f64();
                        let expected = if j >= n { old } else { sum + if add { old } else { 0.0 } };
                        let error = (got[i * so + j].f64() - expected).abs();
                        assert!(error < tolerance * (1.0 + k as f64).sqrt(), "[{m}, {k}, {n}] at {i}, {j}: {error}");
                    }
                }
            }
        }
    }

    #[test]
    fn equals_the_sum_of_products() {
        check::<f32>(1e-5);
        check::<f64>(1e-13);
    }

    #[test]
    #[should_panic(expected = "does not fit")]
    fn a_matrix_outside_its_slice_is_refused() {
        let _ = Matrix::new(&[0.0f32; 5], 2, 3, 3);
    }
}
