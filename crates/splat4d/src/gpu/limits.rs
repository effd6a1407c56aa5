//! Sizes that several parts of the GPU renderer share.

use crate::scene::BLOCK;

/// Threads of every workgroup.
pub(super) const THREADS: usize = 256;
/// Columns of the geometry that splats are made of: mean, covariance, opacity.
pub(super) const GEOMETRY_WIDTH: usize = 10;

/// Bytes of a layer's geometry for rendering.
pub(super) fn geometry_bytes(rows: usize) -> u64 {
    (4 * GEOMETRY_WIDTH * rows.next_multiple_of(BLOCK)) as u64
}
