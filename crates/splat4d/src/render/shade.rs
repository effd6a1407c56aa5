//! The colour of every visible splat: spherical harmonics along the viewing direction, or a colour given directly.
//!
//! Works on the splats of one block of the SH table at once, so that coefficients are read as whole vectors: sixteen
//! where all rows are rendered, those that are alive elsewhere. The block's columns are in as many cache lines as one
//! row does, so that nothing is read for the others' sake.

use super::gather::CHANNELS;
use super::project::{CHUNK_ROWS, Lanes, Projected, Projection};
use super::simd::{Kernel, dispatch, select};
use super::{PartGrads, project};
use crate::math::{Real, sh};
use crate::scene::splats::Part;
use crate::scene::{BLOCK, Color, Rows, Table};
use rayon::prelude::*;
use std::ops::Range;

/// Columns of a part's table that its colour's gradient has.
fn color_width<'a, F: Real>(part: &Part<'a, F>) -> Option<&'a Table<F>> {
    match part.color {
        Color::Sh { base: true, .. } => None,
        Color::Sh { table, .. } | Color::Direct { table } => Some(table),
    }
}

/// SH columns of a part: blocks of `block` columns each, of which `used` coefficients a channel are rendered.
#[derive(Clone, Copy, Debug)]
struct Layout {
    blocks: usize,
    block: usize,
    used: usize,
}

impl Layout {
    fn new(width: usize, blocks: usize, degree: usize) -> Self {
        let block = width.checked_div(blocks).unwrap_or(0);
        assert!(
            block * blocks == width && block.is_multiple_of(3),
            "an SH table has 3·K·blocks columns, not {width}/{blocks}"
        );
        let used = sh::degree_of(block / 3).map_or(0, |d| sh::coeffs(d.min(degree)));
        Self { blocks, block, used }
    }
}

/// Calls a function of a constant number of coefficients with `$used` of them, which a degree has.
macro_rules! with_coeffs {
    ($used:expr, $function:ident, $($argument:expr),*) => {
        match $used {
            0 => $function::<F, FMA, 0>($($argument),*),
            1 => $function::<F, FMA, 1>($($argument),*),
            4 => $function::<F, FMA, 4>($($argument),*),
            9 => $function::<F, FMA, 9>($($argument),*),
            _ => $function::<F, FMA, { sh::MAX_COEFFS }>($($argument),*),
        }
    };
}

/// Splats that have their parameters in one block of a table.
#[derive(Clone, Copy)]
struct Group {
    block: usize,
    /// The first of them, and how many.
    first: usize,
    len: usize,
    /// The row of the block that each of them has.
    lanes: [u8; BLOCK],
}

impl Group {
    /// The groups of splats `range`, in order.
    #[inline(always)]
    fn all(rows: Rows<'_>, range: Range<usize>) -> impl Iterator<Item = Group> {
        let mut at = range.start;
        std::iter::from_fn(move || {
            let first = at;
            let block = (first < range.end).then(|| rows.id(first) / BLOCK)?;
            let mut lanes = [0; BLOCK];
            while at < range.end && rows.id(at) / BLOCK == block {
                lanes[at - first] = (rows.id(at) % BLOCK) as u8;
                at += 1;
            }
            Some(Group { block, first, len: at - first, lanes })
        })
    }

    /// Splats and their lanes.
    #[inline(always)]
    fn each(&self) -> impl Iterator<Item = (usize, usize)> {
        (0..self.len).map(|k| (self.first + k, usize::from(self.lanes[k]) % BLOCK))
    }

    /// `N` numbers of each splat from column `col` of a table that has a row a splat; 0 in lanes without one.
    #[inline(always)]
    fn read<F: Real, const N: usize>(&self, table: &Table<F>, col: usize) -> [Lanes<F>; N] {
        let mut out = [[F::ZERO; BLOCK]; N];
        if self.len == BLOCK && self.first.is_multiple_of(BLOCK) {
            out.copy_from_slice(&table.block(self.first / BLOCK).as_chunks().0[col..col + N]);
            return out;
        }
        for (j, l) in self.each() {
            let values = table.read::<N>(j, col);
            for k in 0..N {
                out[k][l] = values[k];
            }
        }
        out
    }

    /// The weights of SH block `b`, 1 where there are none.
    #[inline(always)]
    fn weights<F: Real>(&self, weights: Option<&Table<F>>, b: usize) -> Lanes<F> {
        weights.map_or([F::ONE; BLOCK], |table| self.read::<F, 1>(table, b)[0])
    }
}

/// Unit directions [3][16] from the camera, in the axes of the part's SH (rows; none: the world's), and 1/length.
#[inline(always)]
fn directions<F: Real>(means: &[Lanes<F>; 3], center: [F; 3], axes: &Option<[[F; 3]; 3]>) -> ([Lanes<F>; 3], Lanes<F>) {
    let mut d = [[F::ZERO; BLOCK]; 3];
    let mut inverse = [F::ZERO; BLOCK];
    for l in 0..BLOCK {
        let v = [means[0][l] - center[0], means[1][l] - center[1], means[2][l] - center[2]];
        let i = F::ONE / (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        (d[0][l], d[1][l], d[2][l], inverse[l]) = (v[0] * i, v[1] * i, v[2] * i, i);
    }
    if let Some(axes) = axes {
        rotate(axes, &mut d);
    }
    (d, inverse)
}

/// Rotates sixteen vectors.
#[inline(always)]
fn rotate<F: Real>(r: &[[F; 3]; 3], v: &mut [Lanes<F>; 3]) {
    for l in 0..BLOCK {
        let [x, y, z] = [v[0][l], v[1][l], v[2][l]];
        for i in 0..3 {
            v[i][l] = r[i][0] * x + r[i][1] * y + r[i][2] * z;
        }
    }
}

/// Adds w·Σ_k Y_k(d) f_k to the colour. One loop over lanes, so that the basis stays in registers.
#[inline(always)]
fn add_colors<F: Real, const FMA: bool, const K: usize>(
    columns: &[Lanes<F>],
    d: &[Lanes<F>; 3],
    w: &Lanes<F>,
    rgb: &mut [Lanes<F>; 3],
) {
    let columns = &columns[..3 * K];
    for l in 0..BLOCK {
        let y = sh::basis([d[0][l], d[1][l], d[2][l]]);
        let mut sum = [F::ZERO; 3];
        for k in 0..K {
            for c in 0..3 {
                sum[c] = y[k].fma::<FMA>(columns[3 * k + c][l], sum[c]);
            }
        }
        for c in 0..3 {
            rgb[c][l] += w[l] * sum[c];
        }
    }
}

/// One task's share of [`forward`]: rows `first ..` of a part.
struct Forward<'a, F> {
    part: &'a Part<'a, F>,
    first: usize,
    center: [F; 3],
    degree: usize,
    projected: &'a [Projected<F>],
    channels: &'a mut [[F; CHANNELS]],
}

impl<F: Real> Kernel for Forward<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        match self.part.color {
            Color::Direct { table } => {
                for (i, (row, out)) in self.projected.iter().zip(&mut *self.channels).enumerate() {
                    *out = [F::ZERO; CHANNELS];
                    if row.radius > F::ZERO {
                        for c in 0..table.width().min(3) {
                            out[c] = table.get(self.first + i, c);
                        }
                    }
                }
            }
            Color::Sh { table, rows, weights, .. } => {
                let layout = Layout::new(table.width(), weights.map_or(1, Table::width), self.degree);
                for group in Group::all(rows, self.first..self.first + self.projected.len()) {
                    let run = group.first - self.first..group.first - self.first + group.len;
                    let (projected, channels) = (&self.projected[run.clone()], &mut self.channels[run]);
                    if projected.iter().all(|row| row.radius <= F::ZERO) {
                        channels.fill([F::ZERO; CHANNELS]);
                        continue;
                    }
                    let (d, _) =
                        directions(&group.read::<F, 3>(self.part.out, 0), self.center, &self.part.layer_from_world);
                    let columns = table.block(group.block).as_chunks().0;
                    let mut rgb = [[F::ZERO; BLOCK]; 3];
                    for b in 0..layout.blocks {
                        let (columns, w) = (&columns[b * layout.block..], group.weights(weights, b));
                        with_coeffs!(layout.used, add_colors, columns, &d, &w, &mut rgb);
                    }
                    for c in 0..3 {
                        for l in 0..BLOCK {
                            rgb[c][l] = (rgb[c][l] + F::of(sh::COLOR_OFFSET)).max(F::ZERO);
                        }
                    }
                    for ((row, out), (_, l)) in projected.iter().zip(channels).zip(group.each()) {
                        let visible = row.radius > F::ZERO;
                        *out = if visible { [rgb[0][l], rgb[1][l], rgb[2][l]] } else { [F::ZERO; CHANNELS] };
                    }
                }
            }
        }
    }
}

/// Colours of all splats: red, green, blue; culled splats get zeros.
///
/// Shapes: `channels` [all splats]. SH of `degree` at most, clamped at 0 from below; direct colours are taken as they
/// are, columns beyond the third are not rendered. The direction of view is taken to the axes of each part's SH.
pub fn forward<F: Real>(projection: &Projection<'_, F>, degree: usize, channels: &mut [[F; CHANNELS]]) {
    let Projection { splats, view, simd, projected } = *projection;
    let (mut first, mut rest) = (0, channels);
    for part in &splats.parts {
        let n = part.out.rows();
        let (head, tail) = std::mem::take(&mut rest).split_at_mut(n);
        rest = tail;
        let rows = projected[first..first + n].par_chunks(CHUNK_ROWS);
        rows.zip(head.par_chunks_mut(CHUNK_ROWS)).enumerate().for_each(|(chunk, (projected, channels))| {
            let first = chunk * CHUNK_ROWS;
            dispatch(simd, Forward { part, first, center: view.center, degree, projected, channels });
        });
        first += n;
    }
}

impl Group {
    /// Gradient to the three colour sums: zero where culled or clamped.
    #[inline(always)]
    fn color_grads<F: Real>(
        &self,
        projected: &[Projected<F>],
        channels: &[[F; CHANNELS]],
        d: &[[F; CHANNELS]],
    ) -> [Lanes<F>; 3] {
        let mut v = [[F::ZERO; BLOCK]; 3];
        for (j, l) in self.each() {
            let drawn = projected[j].radius > F::ZERO;
            for c in 0..3 {
                v[c][l] = select(drawn & (channels[j][c] > F::ZERO), d[j][c], F::ZERO);
            }
        }
        v
    }
}

/// Adds w·Y_k(d) v to the gradient of the coefficients.
#[inline(always)]
fn add_coeff_grads<F: Real, const FMA: bool, const K: usize>(
    d: &[Lanes<F>; 3],
    w: &Lanes<F>,
    v: &[Lanes<F>; 3],
    columns: &mut [Lanes<F>],
) {
    let columns = &mut columns[..3 * K];
    for l in 0..BLOCK {
        let y = sh::basis([d[0][l], d[1][l], d[2][l]]);
        for c in 0..3 {
            let v = w[l] * v[c][l];
            for k in 0..K {
                columns[3 * k + c][l] += y[k] * v;
            }
        }
    }
}

/// One task's share of the SH gradient: a run of whole blocks of the gradient's table.
struct ShGrads<'a, F> {
    part: &'a Part<'a, F>,
    rows: Rows<'a>,
    weights: Option<&'a Table<F>>,
    layout: Layout,
    center: [F; 3],
    projected: &'a [Projected<F>],
    channels: &'a [[F; CHANNELS]],
    d: &'a [[F; CHANNELS]],
    /// First row of the run, and its blocks.
    first: usize,
    data: &'a mut [F],
}

impl<F: Real> Kernel for ShGrads<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        let width = self.layout.block * self.layout.blocks;
        let total = self.projected.len();
        let end = self.first + self.data.len() / width;
        // Splats of which the run holds the parameters.
        let splats = match self.rows {
            Rows::All => self.first.min(total)..end.min(total),
            Rows::Some(ids) => {
                ids.partition_point(|&i| (i as usize) < self.first)..ids.partition_point(|&i| (i as usize) < end)
            }
        };
        let (columns, _) = self.data.as_chunks_mut::<BLOCK>();
        for group in Group::all(self.rows, splats) {
            let v = group.color_grads(self.projected, self.channels, self.d);
            if v.iter().flatten().all(|&x| x == F::ZERO) {
                continue;
            }
            let (mut d, _) =
                directions(&group.read::<F, 3>(self.part.out, 0), self.center, &self.part.layer_from_world);
            let at = (group.block - self.first / BLOCK) * width;
            for b in 0..self.layout.blocks {
                let mut w = group.weights(self.weights, b);
                for l in 0..BLOCK {
                    // A culled row may hold NaN; its gradient is 0 all the same.
                    let live = (v[0][l] != F::ZERO) | (v[1][l] != F::ZERO) | (v[2][l] != F::ZERO);
                    w[l] = select(live, w[l], F::ZERO);
                    for k in 0..3 {
                        d[k][l] = select(live, d[k][l], F::ZERO);
                    }
                }
                let columns = &mut columns[at + b * self.layout.block..];
                with_coeffs!(self.layout.used, add_coeff_grads, &d, &w, &v, columns);
            }
        }
    }
}

/// Of one block of coefficients: writes Σ_k Y_k(d) Σ_c f_kc v_c, the gradient to its weight, and adds the gradient to
/// the direction, w·Σ_k ∇Y_k(d) Σ_c f_kc v_c.
#[inline(always)]
fn add_direction_grads<F: Real, const FMA: bool, const K: usize>(
    columns: &[Lanes<F>],
    d: &[Lanes<F>; 3],
    w: &Lanes<F>,
    v: &[Lanes<F>; 3],
    d_weight: &mut Lanes<F>,
    d_direction: &mut [Lanes<F>; 3],
) {
    let columns = &columns[..3 * K];
    for l in 0..BLOCK {
        let unit = [d[0][l], d[1][l], d[2][l]];
        let (y, gradient) = (sh::basis(unit), sh::basis_gradient(unit));
        let (mut shown, mut d_dir) = (F::ZERO, [F::ZERO; 3]);
        for k in 0..K {
            let mut along = F::ZERO;
            for c in 0..3 {
                along = v[c][l].fma::<FMA>(columns[3 * k + c][l], along);
            }
            shown = y[k].fma::<FMA>(along, shown);
            for i in 0..3 {
                if sh::GRADIENT_TERMS[k][i] {
                    d_dir[i] = gradient[k][i].fma::<FMA>(along, d_dir[i]);
                }
            }
        }
        d_weight[l] = shown;
        for i in 0..3 {
            d_direction[i][l] += w[l] * d_dir[i];
        }
    }
}

/// One task's share of the gradients that pass through direction and weights.
struct DirectionGrads<'a, F> {
    part: &'a Part<'a, F>,
    table: &'a Table<F>,
    rows: Rows<'a>,
    weights: Option<&'a Table<F>>,
    layout: Layout,
    center: [F; 3],
    /// The task's splats; the others' numbers are available as well.
    splats: Range<usize>,
    projected: &'a [Projected<F>],
    channels: &'a [[F; CHANNELS]],
    d: &'a [[F; CHANNELS]],
    /// Blocks of the gradient to `out`, of `out_width` columns; added to.
    out: &'a mut [F],
    out_width: usize,
    /// Blocks of the gradient to the weights; overwritten.
    d_weights: &'a mut [F],
}

impl<F: Real> Kernel for DirectionGrads<'_, F> {
    type Out = [f64; 3];
    #[inline(always)]
    fn run<const FMA: bool>(self) -> [f64; 3] {
        let mut total = [0.0; 3];
        let first = self.splats.start;
        for group in Group::all(self.rows, self.splats.clone()) {
            let v = group.color_grads(self.projected, self.channels, self.d);
            if v.iter().flatten().all(|&x| x == F::ZERO) {
                continue;
            }
            let (d, inverse) =
                directions(&group.read::<F, 3>(self.part.out, 0), self.center, &self.part.layer_from_world);
            let columns = self.table.block(group.block).as_chunks().0;
            let mut d_direction = [[F::ZERO; BLOCK]; 3];
            for b in 0..self.layout.blocks {
                let (columns, w) = (&columns[b * self.layout.block..], group.weights(self.weights, b));
                let mut d_weight = [F::ZERO; BLOCK];
                let d_direction = &mut d_direction;
                with_coeffs!(self.layout.used, add_direction_grads, columns, &d, &w, &v, &mut d_weight, d_direction);
                if self.weights.is_some() {
                    for (j, l) in group.each().filter(|&(j, _)| self.projected[j].radius > F::ZERO) {
                        let row = j - first;
                        self.d_weights[(row / BLOCK * self.layout.blocks + b) * BLOCK + row % BLOCK] = d_weight[l];
                    }
                }
            }
            if self.layout.used <= 1 {
                continue;
            }
            let mut d_mean = [[F::ZERO; BLOCK]; 3];
            for l in 0..BLOCK {
                let unit = [d[0][l], d[1][l], d[2][l]];
                let d_dir = [d_direction[0][l], d_direction[1][l], d_direction[2][l]];
                let back = sh::direction_backward(unit, inverse[l], d_dir);
                (d_mean[0][l], d_mean[1][l], d_mean[2][l]) = (back[0], back[1], back[2]);
            }
            if let Some(axes) = &self.part.layer_from_world {
                let world_from_layer = std::array::from_fn(|i| std::array::from_fn(|j| axes[j][i]));
                rotate(&world_from_layer, &mut d_mean);
            }
            for (j, l) in group.each().filter(|&(j, _)| self.projected[j].radius > F::ZERO) {
                let row = j - first;
                for i in 0..3 {
                    self.out[(row / BLOCK * self.out_width + i) * BLOCK + row % BLOCK] += d_mean[i][l];
                    total[i] += d_mean[i][l].f64();
                }
            }
        }
        total
    }
}

/// Targets of the gradients of colours.
#[derive(Debug)]
pub(crate) struct ShadeGrads<'a, 't, F = f32> {
    /// Base SH by part, added to in rows `rows.id(j)`; `None` skips it.
    pub sh: &'a mut [Option<&'t mut Table<F>>],
    /// `out` is added to (means, through the direction), `color` and `weights` are overwritten.
    pub parts: &'a mut [PartGrads<F>],
    /// Added to.
    pub pose: &'a mut [f64; 6],
    /// Scratch.
    pub partial: &'a mut Vec<[f64; 3]>,
}

/// VJP of [`forward`], which made `channels`; `d` is the gradient to them.
pub(crate) fn backward<F: Real>(
    projection: &Projection<'_, F>,
    degree: usize,
    channels: &[[F; CHANNELS]],
    d: &[[F; CHANNELS]],
    out: &mut ShadeGrads<'_, '_, F>,
) {
    let Projection { splats, view, .. } = *projection;
    assert!(out.sh.len() == splats.parts.len(), "one SH gradient (or None) a part");
    let mut first = 0;
    for (p, part) in splats.parts.iter().enumerate() {
        let all = first..first + part.out.rows();
        first = all.end;
        let grads = &mut out.parts[p];
        reset_colors(part, grads);
        let shaded = Shaded {
            projection,
            part,
            projected: &projection.projected[all.clone()],
            channels: &channels[all.clone()],
            d: &d[all],
        };
        let (table, rows, weights, base) = match part.color {
            Color::Direct { .. } => {
                shaded.direct_backward(grads.color.as_mut().expect("a direct colour's gradient was made above"));
                continue;
            }
            Color::Sh { table, rows, weights, base } => (table, rows, weights, base),
        };
        let layout = Layout::new(table.width(), weights.map_or(1, Table::width), degree);
        if part.out.rows() == 0 || layout.used == 0 {
            continue;
        }
        // Coefficients: the layer's own rows are added to, foreign ones are compact.
        let (target, rows_out) =
            if base { (out.sh[p].as_deref_mut(), rows) } else { (grads.color.as_mut(), Rows::All) };
        if let Some(target) = target {
            assert_eq!(target.width(), table.width(), "the SH gradient has the SH table's columns");
            shaded.coefficients_backward(layout, rows_out, weights, target);
        }
        if layout.used <= 1 && weights.is_none() {
            continue;
        }
        shaded.directions_backward(layout, (table, rows, weights), grads, out.partial);
        // The camera's centre moves by −Rᵀρ, so that a direction moves like its mean: dL/dρ = R Σ d_mean.
        let mut sum = [0.0; 3];
        for v in out.partial.iter() {
            for i in 0..3 {
                sum[i] += v[i];
            }
        }
        for k in 0..3 {
            let r = view.rotation[k];
            out.pose[k] += r[0].f64() * sum[0] + r[1].f64() * sum[1] + r[2].f64() * sum[2];
        }
    }
}

/// Zeros in the shapes of a part's colours and weights, where they have gradients of their own.
fn reset_colors<F: Real>(part: &Part<'_, F>, grads: &mut PartGrads<F>) {
    match color_width(part) {
        None => grads.color = None,
        Some(like) => {
            let like_rows = if matches!(part.color, Color::Sh { .. }) { part.out.rows() } else { like.rows() };
            let table = grads.color.get_or_insert_with(|| Table::with_columns(like.columns().to_vec(), 0));
            if table.width() != like.width() {
                *table = Table::with_columns(like.columns().to_vec(), 0);
            }
            table.resize(like_rows);
            table.fill(F::ZERO);
        }
    }
    match part.color {
        Color::Sh { weights: Some(like), .. } => {
            let table = grads.weights.get_or_insert_with(|| Table::with_columns(like.columns().to_vec(), 0));
            project::reshape(table, like);
            table.fill(F::ZERO);
        }
        _ => grads.weights = None,
    }
}

/// One part after [`forward`], and the gradient to its colours.
struct Shaded<'a, F> {
    projection: &'a Projection<'a, F>,
    part: &'a Part<'a, F>,
    projected: &'a [Projected<F>],
    channels: &'a [[F; CHANNELS]],
    d: &'a [[F; CHANNELS]],
}

impl<F: Real> Shaded<'_, F> {
    /// To colours that are given directly.
    fn direct_backward(&self, table: &mut Table<F>) {
        let (n, width) = (self.projected.len(), table.width());
        if width == 0 {
            return;
        }
        table.data_mut().par_chunks_mut(CHUNK_ROWS * width).enumerate().for_each(|(chunk, data)| {
            let j0 = chunk * CHUNK_ROWS;
            for j in j0..(j0 + CHUNK_ROWS).min(n) {
                let at = (j - j0) / BLOCK * width * BLOCK + j % BLOCK;
                for c in 0..width.min(3) {
                    data[at + c * BLOCK] = if self.projected[j].radius > F::ZERO { self.d[j][c] } else { F::ZERO };
                }
            }
        });
    }

    /// To SH coefficients, added to rows `rows` of `target`.
    fn coefficients_backward(&self, layout: Layout, rows: Rows<'_>, weights: Option<&Table<F>>, target: &mut Table<F>) {
        let width = target.width();
        target.data_mut().par_chunks_mut(CHUNK_ROWS * width).enumerate().for_each(|(chunk, data)| {
            let kernel = ShGrads {
                part: self.part,
                rows,
                weights,
                layout,
                center: self.projection.view.center,
                projected: self.projected,
                channels: self.channels,
                d: self.d,
                first: chunk * CHUNK_ROWS,
                data,
            };
            dispatch(self.projection.simd, kernel);
        });
    }

    /// To means, through the direction, and to the weights of SH blocks. `partial`: the sums of the means' gradients, a
    /// task each.
    fn directions_backward(
        &self,
        layout: Layout,
        (table, rows, weights): (&Table<F>, Rows<'_>, Option<&Table<F>>),
        grads: &mut PartGrads<F>,
        partial: &mut Vec<[f64; 3]>,
    ) {
        let n = self.projected.len();
        let out_width = grads.out.width();
        let mut none = Vec::new();
        let weight_data = grads.weights.as_mut().map_or(none.as_mut_slice(), |w| w.data_mut());
        let per_chunk = CHUNK_ROWS * layout.blocks;
        let chunks = grads.out.data_mut().par_chunks_mut(CHUNK_ROWS * out_width);
        let task = |chunk: usize, out: &mut [F], d_weights: &mut [F]| {
            let first = chunk * CHUNK_ROWS;
            let kernel = DirectionGrads {
                part: self.part,
                table,
                rows,
                weights,
                layout,
                center: self.projection.view.center,
                splats: first..(first + CHUNK_ROWS).min(n),
                projected: self.projected,
                channels: self.channels,
                d: self.d,
                out,
                out_width,
                d_weights,
            };
            dispatch(self.projection.simd, kernel)
        };
        if weights.is_some() {
            chunks
                .zip(weight_data.par_chunks_mut(per_chunk))
                .enumerate()
                .map(|(chunk, (out, d_weights))| task(chunk, out, d_weights))
                .collect_into_vec(partial);
        } else {
            chunks.enumerate().map(|(chunk, out)| task(chunk, out, &mut [])).collect_into_vec(partial);
        }
    }
}
