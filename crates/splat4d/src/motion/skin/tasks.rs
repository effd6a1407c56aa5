//! Tasks of skinning: rows of each, and the sum of their results.

use crate::math::Real;
use crate::scene::BLOCK;

/// Rows a task takes at least.
const TASK_ROWS: usize = 1024;
/// A task's rows per node at least: then adding up all tasks' gradients to nodes is a small part of the work.
const TASK_ROWS_A_NODE: usize = 4;

/// Rows of one task: a function of sizes alone.
pub(super) fn task_rows(nodes: usize) -> usize {
    (nodes * TASK_ROWS_A_NODE).max(TASK_ROWS).next_multiple_of(BLOCK)
}

/// Adds up the tasks' results in order.
pub(super) fn sum_parts<F: Real>(parts: Vec<Vec<[F; 16]>>, len: usize) -> Vec<[F; 16]> {
    let mut parts = parts.into_iter();
    let mut sum = parts.next().unwrap_or_else(|| vec![[F::ZERO; 16]; len]);
    for part in parts {
        sum.as_flattened_mut().iter_mut().zip(part.as_flattened()).for_each(|(s, x)| *s += *x);
    }
    sum
}
