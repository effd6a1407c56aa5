//! Time samples of a layer, the input of the fit.
//!
//! Rows come in runs that are small enough for all frames of a run to be in memory at once, however long the clip is.

use super::shape::Shape;
use super::tree::{Span, Tree};
use crate::layers::{Evaluation, Layer, sweep};
use crate::math::se3::mat_vec;
use crate::math::sh::{MAX_COEFFS, rgb_to_dc};
use crate::math::sh_rotation::{rotate_coefficients, sh_rotation};
use crate::math::{Sim3, quat};
use crate::scene::{Color, Rows, SH, Space, Time};

/// Numbers of a sample before its colour: mean 3, covariance 6, opacity 1 (life applied).
pub(super) const GEOMETRY: usize = 10;
/// Numbers that the samples of one run may hold: 64 MiB.
const BUDGET: usize = 16 << 20;

/// One Gaussian of a run.
#[derive(Clone, Copy, Debug)]
pub(super) struct Row {
    /// Its row in the layer.
    pub id: usize,
    /// The seconds in which it can be seen, within the clip.
    pub seen: [f64; 2],
    /// First and last frame that was examined.
    pub frames: Span,
    /// Offset of its samples.
    offset: usize,
}

/// A layer's frame, applied to learnt shapes and colours.
pub(super) struct Framed {
    frame: Sim3,
    colors: Option<[[f64; MAX_COEFFS]; MAX_COEFFS]>,
}

impl Framed {
    pub(super) fn of(layer: &Layer<f32>) -> Self {
        let frame = layer.frame;
        Self { frame, colors: (!frame.is_identity()).then(|| sh_rotation(&frame.rotation)) }
    }

    /// A shape in the world.
    pub(super) fn shape(&self, own: &Shape) -> Shape {
        if self.frame.is_identity() {
            return *own;
        }
        let quat = quat::product(quat::from_rotation(&self.frame.rotation), own.quat);
        Shape { quat, scales: own.scales.map(|s| s * self.frame.scale), turn: mat_vec(&self.frame.rotation, own.turn) }
    }

    /// SH coefficients in the world's axes.
    pub(super) fn colors<const N: usize>(&self, mut own: [f32; N]) -> [f32; N] {
        self.rotate(&mut own);
        own
    }

    fn rotate(&self, coefficients: &mut [f32]) {
        if let Some(m) = &self.colors {
            rotate_coefficients(m, coefficients);
        }
    }
}

/// All samples of one run of rows.
#[derive(Clone, Debug)]
pub(super) struct Samples {
    /// The rows, ids rising.
    pub rows: Vec<Row>,
    /// Numbers per sample.
    width: usize,
    data: Vec<f32>,
}

impl Samples {
    /// The sample of row `row` at frame k.
    pub(super) fn at(&self, row: &Row, k: usize) -> &[f32] {
        let start = row.offset + (k - row.frames[0]) * self.width;
        &self.data[start..start + self.width]
    }
}

/// How many SH coefficients (all channels) a sample must hold: 0 where the layer's own SH is the colour at all times.
pub(super) fn color_width(layer: &Layer<f32>, time: f64) -> usize {
    let seen = Evaluation::of_layer(layer, Space::Gaussians, Rows::Some(&[0]), Time(time));
    match layer.part(seen.tape(0)).color {
        Color::Sh { weights: None, base: true, .. } => 0,
        Color::Sh { table, weights, .. } => table.width() / weights.map_or(1, |w| w.width().max(1)),
        Color::Direct { .. } => 3,
    }
    .min(3 * MAX_COEFFS)
}

/// How many of the rows (id, seconds in which it can be seen) fit into the next run; at least one.
pub(super) fn run_length(rows: &[(usize, [f64; 2])], tree: &Tree, colors: usize) -> usize {
    let mut numbers = 0;
    let fits = rows.iter().take_while(|(_, seen)| {
        let [first, last] = tree.around(*seen);
        numbers += (last + 1 - first) * (GEOMETRY + colors);
        numbers <= BUDGET
    });
    fits.count().clamp(1, rows.len().max(1))
}

/// Samples the rows at every frame at which they are visible, and at one frame before and after.
pub(super) fn sample_rows(
    layer: &Layer<f32>,
    frame: &Framed,
    rows: &[(usize, [f64; 2])],
    tree: &Tree,
    colors: usize,
) -> Samples {
    let width = GEOMETRY + colors;
    let mut offset = 0;
    let place = |&(id, seen): &(usize, [f64; 2])| {
        let frames = tree.around(seen);
        let row = Row { id, seen, frames, offset };
        offset += (frames[1] + 1 - frames[0]) * width;
        row
    };
    let rows: Vec<Row> = rows.iter().map(place).collect();
    let mut data = vec![0.0; offset];
    let first = rows.iter().map(|r| r.frames[0]).min().unwrap_or(0);
    let last = rows.iter().map(|r| r.frames[1]).max().unwrap_or(0);
    let alive = |k: usize| rows.iter().filter(move |r| (r.frames[0]..=r.frames[1]).contains(&k));
    let ids: Vec<Vec<u32>> = (first..=last).map(|k| alive(k).map(|r| r.id as u32).collect()).collect();
    let asked: Vec<(Rows<'_>, Time)> =
        ids.iter().enumerate().map(|(i, ids)| (Rows::Some(ids), Time(tree.time(first + i)))).collect();
    sweep(layer, &asked, |i, tape| {
        let (k, part) = (first + i, layer.part(tape));
        for (j, row) in alive(k).enumerate() {
            let start = row.offset + (k - row.frames[0]) * width;
            let out = &mut data[start..start + width];
            out[..GEOMETRY].copy_from_slice(&part.out.read::<GEOMETRY>(j, 0));
            coefficients(&part.color, j, &mut out[GEOMETRY..]);
            frame.rotate(&mut out[GEOMETRY..]);
        }
    });
    Samples { rows, width, data }
}

/// The layer's own SH coefficients of row `id`, coefficient-major; those that it lacks are 0.
pub(super) fn own_colors(layer: &Layer<f32>, id: usize) -> [f32; 3 * MAX_COEFFS] {
    let table = &layer.params[SH];
    std::array::from_fn(|k| if k < table.width() { table.get(id, k) } else { 0.0 })
}

/// The SH coefficients of splat j, as many as `out` takes. A colour without a direction is one coefficient a channel.
fn coefficients(color: &Color<'_>, j: usize, out: &mut [f32]) {
    match color {
        Color::Sh { table, rows, weights, .. } => {
            let id = rows.id(j);
            let blocks = weights.map_or(1, |w| w.width().max(1));
            let block = table.width() / blocks;
            let weight = |b: usize| weights.map_or(1.0, |w| w.get(j, b));
            for (k, out) in out.iter_mut().enumerate().take(block) {
                *out = (0..blocks).map(|b| weight(b) * table.get(id, b * block + k)).sum();
            }
        }
        Color::Direct { table } => {
            for (k, out) in out.iter_mut().enumerate().take(table.width().min(3)) {
                *out = rgb_to_dc(table.get(j, k));
            }
        }
    }
}
