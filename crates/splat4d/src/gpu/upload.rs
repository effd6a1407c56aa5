//! A scene's tables on the GPU, in their memory layout: `[row / 16][column][16]`.
//!
//! Tables of colours may be larger than a binding: they are cut by rows, and each cut is projected and coloured by a
//! dispatch of its own.

use super::buffers::{Grown, largest_binding};
use super::device::Gpu;
use super::limits::{THREADS, geometry_bytes};
use super::{MOST_GROUPS, Tables};
use crate::scene::splats::{Part, SPLAT_OPACITY};
use crate::scene::{BLOCK, Color, Rows, Splats, Table};
use crate::{Error, ErrorKind, Result};

/// Bits of [`Piece::flags`], as in splats.wgsl.
const DIRECT: u32 = 1;
const IDS: u32 = 2;
const WEIGHTS: u32 = 4;

/// The uniform of splats.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct Piece {
    first_row: u32,
    /// Rows of this dispatch.
    pub rows: u32,
    first_splat: u32,
    width: u32,
    blocks: u32,
    flags: u32,
    first_id: u32,
    /// Number of its first workgroup's sums in splats_back.wgsl.
    first_group: u32,
    /// Columns of the rotation of directions to the axes of the SH, each padded to a vec4.
    layer_from_world: [[f32; 4]; 3],
}

/// Columns of a rotation (rows), as in a uniform's mat3x3.
fn columns(r: Option<[[f32; 3]; 3]>) -> [[f32; 4]; 3] {
    let r = r.unwrap_or([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    std::array::from_fn(|c| [r[0][c], r[1][c], r[2][c], 0.0])
}

/// One dispatch: its uniform, and which buffers it reads.
#[derive(Clone, Copy, Debug)]
pub(super) struct Draw {
    /// The uniform.
    pub piece: Piece,
    /// Number of the part.
    pub part: usize,
    /// Number of the cut of its table of colours.
    pub cut: usize,
}

impl Draw {
    /// Workgroups of its dispatch.
    pub(super) fn groups(&self) -> usize {
        (self.piece.rows as usize).div_ceil(THREADS)
    }
}

/// The buffers of one part.
#[derive(Debug)]
pub(super) struct PartBuffers {
    /// Mean, covariance, opacity.
    pub geometry: Grown,
    /// Cuts of the table of colours.
    pub tables: Vec<Grown>,
    /// Rows of that table.
    pub ids: Grown,
    /// Weights of its blocks.
    pub weights: Grown,
    /// Address and length of the table that was sent last.
    sent: Option<(usize, usize)>,
}

impl PartBuffers {
    fn new() -> Self {
        Self {
            geometry: Grown::storage("a layer's Gaussians"),
            tables: Vec::new(),
            ids: Grown::storage("a layer's active rows"),
            weights: Grown::storage("a layer's weights of colours"),
            sent: None,
        }
    }
}

/// The tables of all parts.
#[derive(Debug, Default)]
pub(super) struct Upload {
    /// One per part of the largest previous scene.
    pub parts: Vec<PartBuffers>,
    /// Dispatches of the last scene.
    pub draws: Vec<Draw>,
}

/// Writes `data` into `buffer`, which grows if it must.
fn send<T: bytemuck::NoUninit>(gpu: &Gpu, buffer: &mut Grown, data: &[T]) -> Result<()> {
    buffer.ensure(gpu, size_of_val(data) as u64)?;
    if !data.is_empty() {
        gpu.queue.write_buffer(buffer.get(), 0, bytemuck::cast_slice(data));
    }
    Ok(())
}

impl Upload {
    /// Sends what changed, and lists the dispatches.
    pub(super) fn send(&mut self, gpu: &Gpu, splats: &Splats<'_, f32>, tables: Tables) -> Result<()> {
        self.draws.clear();
        if u32::try_from(splats.len()).is_err() {
            return Err(Error::new(ErrorKind::Unsupported, "the GPU counts Gaussians in 32 bits"));
        }
        while self.parts.len() < splats.parts.len() {
            self.parts.push(PartBuffers::new());
        }
        let mut first_splat = 0;
        for (i, part) in splats.parts.iter().enumerate() {
            let n = part.out.rows();
            if n > 0 {
                assert_eq!(part.out.width(), SPLAT_OPACITY + 1, "a part has mean, covariance and opacity");
                self.send_part(gpu, i, part, first_splat, tables)?;
            }
            first_splat += n;
        }
        Ok(())
    }

    /// Allocates layers of this many rows, columns and blocks of SH, which kernels fill, and lists the dispatches. What
    /// buffers held may be lost. Errors: no memory, or a table that is larger than a binding.
    pub(super) fn keep(&mut self, gpu: &Gpu, layers: &[(usize, usize, usize)]) -> Result<()> {
        self.draws.clear();
        self.parts.resize_with(layers.len(), PartBuffers::new);
        let mut first_splat = 0;
        for (i, &(rows, width, blocks)) in layers.iter().enumerate() {
            let part = &mut self.parts[i];
            if part.tables.is_empty() {
                part.tables.push(Grown::storage("a layer's colours"));
            }
            part.geometry.ensure(gpu, geometry_bytes(rows))?;
            part.tables[0].ensure(gpu, (width * rows.next_multiple_of(BLOCK) * size_of::<f32>()) as u64)?;
            part.ids.ensure(gpu, 0)?;
            // Blocks of which there are several are weighed.
            let weighed = if blocks > 1 { blocks } else { 0 };
            part.weights.ensure(gpu, (weighed * rows.next_multiple_of(BLOCK) * size_of::<f32>()) as u64)?;
            let piece = Piece {
                first_row: 0,
                rows: rows as u32,
                first_splat: first_splat as u32,
                width: width as u32,
                blocks: blocks as u32,
                flags: if blocks > 1 { WEIGHTS } else { 0 },
                first_id: 0,
                first_group: self.draws.iter().map(|d| d.groups() as u32).sum(),
                layer_from_world: columns(None),
            };
            if rows > 0 {
                self.draws.push(Draw { piece, part: i, cut: 0 });
            }
            first_splat += rows;
        }
        Ok(())
    }

    fn send_part(
        &mut self,
        gpu: &Gpu,
        i: usize,
        part: &Part<'_, f32>,
        first_splat: usize,
        tables: Tables,
    ) -> Result<()> {
        let n = part.out.rows();
        let own = &mut self.parts[i];
        send(gpu, &mut own.geometry, part.out.data())?;
        let (table, rows, weights, mut flags, base) = match &part.color {
            Color::Direct { table } => (*table, Rows::All, None, DIRECT, false),
            Color::Sh { table, rows, weights, base } => (*table, *rows, *weights, 0, *base),
        };
        let blocks = weights.map_or(1, Table::width).max(1);
        assert!(
            flags == DIRECT || table.width().is_multiple_of(3 * blocks),
            "an SH table has 3·K·blocks columns, not {}/{blocks}",
            table.width()
        );
        own.ids.ensure(gpu, 0)?;
        if let Rows::Some(ids) = rows {
            send(gpu, &mut own.ids, ids)?;
            flags |= IDS;
        }
        own.weights.ensure(gpu, 0)?;
        if let Some(weights) = weights {
            send(gpu, &mut own.weights, weights.data())?;
            flags |= WEIGHTS;
        }
        // Whole blocks of as many rows as one binding holds.
        let block_bytes = (table.width().max(1) * BLOCK * size_of::<f32>()) as u64;
        let blocks_a_cut = (largest_binding(gpu) / block_bytes) as usize;
        if blocks_a_cut == 0 {
            return Err(Error::new(
                ErrorKind::Unsupported,
                format!("{} columns of colours are too many", table.width()),
            )
            .remedy("Render on the CPU."));
        }
        let cut_rows = (blocks_a_cut * BLOCK).min(MOST_GROUPS * THREADS);
        let cuts = table.rows().div_ceil(cut_rows).max(1);
        let name = (table.data().as_ptr() as usize, table.data().len());
        let known = base && tables == Tables::Constant && own.sent == Some(name);
        own.sent = None;
        let mut from = 0;
        for cut in 0..cuts {
            if own.tables.len() <= cut {
                own.tables.push(Grown::storage("a layer's colours"));
            }
            if !known {
                let numbers = cut_rows * table.width();
                let data = table.data().chunks(numbers.max(1)).nth(cut).unwrap_or_default();
                send(gpu, &mut own.tables[cut], data)?;
            }
            let first_id = cut * cut_rows;
            let to = match rows {
                Rows::All => n.min(first_id + cut_rows),
                Rows::Some(ids) => ids.partition_point(|&id| (id as usize) < first_id + cut_rows),
            };
            if to > from {
                let piece = Piece {
                    first_row: from as u32,
                    rows: (to - from) as u32,
                    first_splat: (first_splat + from) as u32,
                    width: table.width() as u32,
                    blocks: blocks as u32,
                    flags,
                    first_id: first_id as u32,
                    first_group: self.draws.iter().map(|d| d.groups() as u32).sum(),
                    layer_from_world: columns(part.layer_from_world),
                };
                self.draws.push(Draw { piece, part: i, cut });
            }
            from = to.max(from);
        }
        assert_eq!(from, n, "every splat has a row of colours");
        own.sent = Some(name);
        Ok(())
    }

    /// Bytes held.
    pub(crate) fn bytes(&self) -> u64 {
        let part = |p: &PartBuffers| {
            p.geometry.bytes() + p.ids.bytes() + p.weights.bytes() + p.tables.iter().map(Grown::bytes).sum::<u64>()
        };
        self.parts.iter().map(part).sum()
    }
}
