//! Ties of the poses of a tracked frame, in buffers.

use super::uniforms::TieRule;
use crate::Result;
use crate::gpu::buffers::Grown;
use crate::gpu::device::Gpu;
use crate::gpu::limits::THREADS;
use crate::render::ResidentTies;

/// The ties of a layer.
#[derive(Debug)]
pub(super) struct Tied {
    rule: TieRule,
    before: Grown,
    edges: Grown,
    links: Grown,
    turns: Grown,
}

impl Tied {
    /// Sends them. Errors: no memory.
    pub(super) fn new(gpu: &Gpu, ties: &ResidentTies) -> Result<Self> {
        let before: Vec<[f32; 8]> = ties.before.iter().map(|[x, y, z, q @ ..]| pose([*x, *y, *z], *q)).collect();
        let edges: Vec<[u32; 4]> =
            ties.edges.iter().map(|(to, long, weight)| [*to, long.to_bits(), weight.to_bits(), 0]).collect();
        let links = [&ties.first[..], &ties.back, &ties.points, &ties.background].concat();
        let mut out = Self {
            rule: TieRule {
                points: ties.points.len() as u32,
                background: ties.background.len() as u32,
                neighbours: ties.neighbours as u32,
                back_at: ties.first.len() as u32,
                rows_at: (ties.first.len() + ties.back.len()) as u32,
                sums_at: 0,
                rigid: ties.rigid as f32,
                rot: ties.rot as f32,
                iso: ties.iso as f32,
                floor: ties.floor as f32,
                stays: ties.stays.map(|w| w as f32),
                up: ties.up.map(|x| x as f32),
                height: ties.height as f32,
            },
            before: Grown::storage("poses of the frame before"),
            edges: Grown::storage("ties of neighbours"),
            links: Grown::storage("ties of neighbours"),
            turns: Grown::storage("turns since the frame before"),
        };
        super::send(gpu, &mut out.before, before.as_flattened())?;
        super::send(gpu, &mut out.edges, edges.as_flattened())?;
        super::send(gpu, &mut out.links, &links)?;
        out.turns.ensure(gpu, 16 * ties.points.len() as u64)?;
        Ok(out)
    }

    /// `struct TieRule`, with the first of the sums.
    pub(super) fn rule(&self, sums_at: usize) -> TieRule {
        TieRule { sums_at: sums_at as u32, ..self.rule }
    }

    /// Workgroups over all points and the background.
    pub(super) fn groups(&self) -> u32 {
        (self.rule.points + self.rule.background).div_ceil(THREADS as u32)
    }

    /// Poses before, edges, links, turns.
    pub(super) fn buffers(&self) -> [wgpu::BindingResource<'_>; 4] {
        [self.before.all(), self.edges.all(), self.links.all(), self.turns.all()]
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> u64 {
        [&self.before, &self.edges, &self.links, &self.turns].iter().map(|b| b.bytes()).sum()
    }
}

/// Position and quaternion as two vec4.
fn pose([x, y, z]: [f32; 3], [w, i, j, k]: [f32; 4]) -> [f32; 8] {
    [x, y, z, 0.0, w, i, j, k]
}
