//! The colour of every visible splat: spherical harmonics along the viewing direction, or a colour given directly.
//!
//! Works on 16 splats at once, a block of the table, so that coefficients are read as whole vectors.

use super::project::{CHUNK_ROWS, Projected, View};
use super::rasterize::CHANNELS;
use super::simd::{Kernel, Simd, dispatch};
use super::{PartGrads, project};
use crate::math::{Real, sh};
use crate::scene::splats::{Part, Rows};
use crate::scene::{BLOCK, Color, Splats, Table};
use rayon::prelude::*;

/// Numbers of 16 splats.
type Lanes<F> = [F; BLOCK];

/// Columns of a part's table that its colour's gradient has.
fn color_width<'a, F: Real>(part: &Part<'a, F>) -> Option<&'a Table<F>> {
    match part.color {
        Color::Sh { base: true, .. } => None,
        Color::Sh { table, .. } | Color::Direct { table } => Some(table),
    }
}

/// SH columns of a part: blocks of `block` columns each, of which `used` coefficients a channel are drawn.
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

/// Sixteen rows of an SH table: one block where the rows are consecutive, else gathered.
#[derive(Clone, Copy)]
enum Source<'a, F> {
    Block(&'a [F]),
    Gather(&'a Table<F>, [u32; BLOCK]),
}

impl<'a, F: Real> Source<'a, F> {
    #[inline(always)]
    fn new(table: &'a Table<F>, rows: &Rows<'_>, j0: usize, n: usize) -> Self {
        let first = rows.id(j0);
        if first.is_multiple_of(BLOCK) && rows.id(j0 + n - 1) == first + n - 1 {
            return Source::Block(table.block(first / BLOCK));
        }
        Source::Gather(table, std::array::from_fn(|l| rows.id(j0 + l.min(n - 1)) as u32))
    }

    #[inline(always)]
    fn column(&self, col: usize) -> Lanes<F> {
        match self {
            Source::Block(data) => {
                let run = &data[col * BLOCK..(col + 1) * BLOCK];
                std::array::from_fn(|l| run[l])
            }
            Source::Gather(table, ids) => std::array::from_fn(|l| table.get(ids[l] as usize, col)),
        }
    }
}

/// Unit directions [3][16] from the camera, and 1/length.
#[inline(always)]
fn directions<F: Real>(out: &Table<F>, group: usize, center: [F; 3]) -> ([Lanes<F>; 3], Lanes<F>) {
    let means = out.block(group);
    let mut d = [[F::ZERO; BLOCK]; 3];
    let mut inverse = [F::ZERO; BLOCK];
    for l in 0..BLOCK {
        let v: [F; 3] = std::array::from_fn(|k| means[k * BLOCK + l] - center[k]);
        inverse[l] = F::ONE / (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        for k in 0..3 {
            d[k][l] = v[k] * inverse[l];
        }
    }
    (d, inverse)
}

#[inline(always)]
fn basis_lanes<F: Real>(d: &[Lanes<F>; 3]) -> [Lanes<F>; sh::MAX_COEFFS] {
    let mut out = [[F::ZERO; BLOCK]; sh::MAX_COEFFS];
    for l in 0..BLOCK {
        let y = sh::basis([d[0][l], d[1][l], d[2][l]]);
        for k in 0..sh::MAX_COEFFS {
            out[k][l] = y[k];
        }
    }
    out
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
        let groups = self.projected.chunks(BLOCK).zip(self.channels.chunks_mut(BLOCK));
        for (g, (rows, out)) in groups.enumerate() {
            let j0 = self.first + g * BLOCK;
            if rows.iter().all(|r| r.radius <= F::ZERO) {
                out.fill([F::ZERO; CHANNELS]);
                continue;
            }
            let rgb = match self.part.color {
                Color::Direct { table } => {
                    let data = table.block(j0 / BLOCK);
                    let column = |c: usize| std::array::from_fn(|l| data[c * BLOCK + l]);
                    std::array::from_fn(|c| if c < table.width() { column(c) } else { [F::ZERO; BLOCK] })
                }
                Color::Sh { table, ref rows, weights, .. } => {
                    let layout = Layout::new(table.width(), weights.map_or(1, Table::width), self.degree);
                    let (d, _) = directions(self.part.out, j0 / BLOCK, self.center);
                    let y = basis_lanes(&d);
                    let source = Source::new(table, rows, j0, out.len());
                    let mut rgb = [[F::ZERO; BLOCK]; 3];
                    for b in 0..layout.blocks {
                        let mut sum = [[F::ZERO; BLOCK]; 3];
                        for k in 0..layout.used {
                            for c in 0..3 {
                                let f = source.column(b * layout.block + 3 * k + c);
                                for l in 0..BLOCK {
                                    sum[c][l] = y[k][l].fma::<FMA>(f[l], sum[c][l]);
                                }
                            }
                        }
                        for c in 0..3 {
                            for l in 0..BLOCK {
                                let w = weights.map_or(F::ONE, |w| w.block(j0 / BLOCK)[b * BLOCK + l]);
                                rgb[c][l] += w * sum[c][l];
                            }
                        }
                    }
                    for c in 0..3 {
                        for l in 0..BLOCK {
                            rgb[c][l] = (rgb[c][l] + F::of(sh::COLOR_OFFSET)).max(F::ZERO);
                        }
                    }
                    rgb
                }
            };
            for (l, (row, out)) in rows.iter().zip(out).enumerate() {
                let visible = row.radius > F::ZERO;
                *out = if visible { [rgb[0][l], rgb[1][l], rgb[2][l]] } else { [F::ZERO; CHANNELS] };
            }
        }
    }
}

/// Colours of all splats: red, green, blue; culled splats get zeros.
///
/// Shapes: `projected`, `channels` [all splats]. SH of `degree` at most, clamped at 0 from below; direct colours are
/// taken as they are, columns beyond the third are not drawn.
pub fn forward<F: Real>(
    splats: &Splats<'_, F>,
    view: &View<F>,
    degree: usize,
    simd: Simd,
    projected: &[Projected<F>],
    channels: &mut [[F; CHANNELS]],
) {
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

/// Gradient to the three colour sums of 16 splats: zero where culled or clamped.
#[inline(always)]
fn color_grads<F: Real>(
    projected: &[Projected<F>],
    channels: &[[F; CHANNELS]],
    d: &[[F; CHANNELS]],
    clamp: bool,
) -> [Lanes<F>; 3] {
    let mut v = [[F::ZERO; BLOCK]; 3];
    for l in 0..projected.len().min(BLOCK) {
        for c in 0..3 {
            let passes = projected[l].radius > F::ZERO && (!clamp || channels[l][c] > F::ZERO);
            v[c][l] = if passes { d[l][c] } else { F::ZERO };
        }
    }
    v
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
    /// First row of the run, its rows, and its blocks.
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
        // Output rows of which the run holds the parameters.
        let (from, to) = match self.rows {
            Rows::All => (self.first.min(total), end.min(total)),
            Rows::Some(ids) => {
                (ids.partition_point(|&i| (i as usize) < self.first), ids.partition_point(|&i| (i as usize) < end))
            }
        };
        if from == to {
            return;
        }
        for group in from / BLOCK..to.div_ceil(BLOCK) {
            let j0 = group * BLOCK;
            let n = (total - j0).min(BLOCK);
            let v = color_grads(&self.projected[j0..j0 + n], &self.channels[j0..j0 + n], &self.d[j0..j0 + n], true);
            if v.iter().flatten().all(|&x| x == F::ZERO) {
                continue;
            }
            let y = basis_lanes(&directions(self.part.out, group, self.center).0);
            let id0 = self.rows.id(j0);
            let whole = j0 >= from && j0 + n <= to;
            let straight = whole && id0.is_multiple_of(BLOCK) && self.rows.id(j0 + n - 1) == id0 + n - 1;
            for b in 0..self.layout.blocks {
                let mut w = [F::ONE; BLOCK];
                if let Some(weights) = self.weights {
                    w.copy_from_slice(&weights.block(group)[b * BLOCK..(b + 1) * BLOCK]);
                }
                for k in 0..self.layout.used {
                    for c in 0..3 {
                        let col = b * self.layout.block + 3 * k + c;
                        let mut add = [F::ZERO; BLOCK];
                        for l in 0..BLOCK {
                            // A culled row may hold NaN; its gradient is 0 all the same.
                            add[l] = if v[c][l] == F::ZERO { F::ZERO } else { w[l] * y[k][l] * v[c][l] };
                        }
                        if straight {
                            let at = ((id0 - self.first) / BLOCK * width + col) * BLOCK;
                            for (out, add) in self.data[at..at + BLOCK].iter_mut().zip(add) {
                                *out += add;
                            }
                        } else {
                            for j in from.max(j0)..to.min(j0 + n) {
                                let row = self.rows.id(j) - self.first;
                                self.data[(row / BLOCK * width + col) * BLOCK + row % BLOCK] += add[j - j0];
                            }
                        }
                    }
                }
            }
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
    first: usize,
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
        for g in 0..self.projected.len().div_ceil(BLOCK) {
            let run = g * BLOCK..((g + 1) * BLOCK).min(self.projected.len());
            let n = run.len();
            let v = color_grads(&self.projected[run.clone()], &self.channels[run.clone()], &self.d[run], true);
            if v.iter().flatten().all(|&x| x == F::ZERO) {
                continue;
            }
            let j0 = self.first + g * BLOCK;
            let (d, inverse) = directions(self.part.out, j0 / BLOCK, self.center);
            let source = Source::new(self.table, &self.rows, j0, n);
            let y = basis_lanes(&d);
            // Σ_c v_c f_kc of every coefficient, blocks weighted.
            let mut along = [[F::ZERO; BLOCK]; sh::MAX_COEFFS];
            for b in 0..self.layout.blocks {
                let mut shown = [F::ZERO; BLOCK];
                for k in 0..self.layout.used {
                    let mut sum = [F::ZERO; BLOCK];
                    for c in 0..3 {
                        let f = source.column(b * self.layout.block + 3 * k + c);
                        for l in 0..BLOCK {
                            sum[l] = v[c][l].fma::<FMA>(f[l], sum[l]);
                        }
                    }
                    for l in 0..BLOCK {
                        let w = self.weights.map_or(F::ONE, |w| w.block(j0 / BLOCK)[b * BLOCK + l]);
                        along[k][l] = w.fma::<FMA>(sum[l], along[k][l]);
                        shown[l] = y[k][l].fma::<FMA>(sum[l], shown[l]);
                    }
                }
                if self.weights.is_some() {
                    let at = (g * self.layout.blocks + b) * BLOCK;
                    for l in 0..n {
                        if self.projected[g * BLOCK + l].radius > F::ZERO {
                            self.d_weights[at + l] = shown[l];
                        }
                    }
                }
            }
            if self.layout.used <= 1 {
                continue;
            }
            let mut d_mean = [[F::ZERO; BLOCK]; 3];
            for l in 0..BLOCK {
                let unit = [d[0][l], d[1][l], d[2][l]];
                let gradient = sh::basis_gradient(unit);
                let mut d_dir = [F::ZERO; 3];
                for k in 1..sh::MAX_COEFFS {
                    for i in 0..3 {
                        d_dir[i] = gradient[k][i].fma::<FMA>(along[k][l], d_dir[i]);
                    }
                }
                let back = sh::direction_backward(unit, inverse[l], d_dir);
                for i in 0..3 {
                    d_mean[i][l] = back[i];
                }
            }
            for l in 0..n {
                if self.projected[g * BLOCK + l].radius > F::ZERO {
                    for i in 0..3 {
                        self.out[(g * self.out_width + i) * BLOCK + l] += d_mean[i][l];
                        total[i] += d_mean[i][l].f64();
                    }
                }
            }
        }
        total
    }
}

/// VJP of [`forward`].
///
/// Adds to `parts[..].out` (means, through the direction), to `d_sh` (base SH, rows `rows.id(j)`) and to the pose
/// gradient; overwrites `parts[..].color` and `.weights`. `partial` is scratch.
pub fn backward<F: Real>(
    splats: &Splats<'_, F>,
    view: &View<F>,
    degree: usize,
    simd: Simd,
    projected: &[Projected<F>],
    channels: &[[F; CHANNELS]],
    d: &[[F; CHANNELS]],
    d_sh: &mut [Option<&mut Table<F>>],
    parts: &mut [PartGrads<F>],
    pose: &mut [f64; 6],
    partial: &mut Vec<[f64; 3]>,
) {
    assert!(d_sh.len() == splats.parts.len(), "one SH gradient (or None) a part");
    let mut first = 0;
    for (p, part) in splats.parts.iter().enumerate() {
        let n = part.out.rows();
        let (projected, channels) = (&projected[first..first + n], &channels[first..first + n]);
        let d = &d[first..first + n];
        first += n;
        let grads = &mut parts[p];
        match color_width(part) {
            None => grads.color = None,
            Some(like) => {
                let like_rows = if matches!(part.color, Color::Sh { .. }) { n } else { like.rows() };
                let table = grads.color.get_or_insert_with(|| Table::with_columns(like.columns().to_vec(), 0));
                if table.width() != like.width() {
                    *table = Table::with_columns(like.columns().to_vec(), 0);
                }
                table.resize(like_rows);
                table.fill(F::ZERO);
            }
        }
        let (table, rows, weights, base) = match part.color {
            Color::Direct { .. } => {
                grads.weights = None;
                let table = grads.color.as_mut().expect("a direct colour's gradient was made above");
                let width = table.width();
                if width > 0 {
                    table.data_mut().par_chunks_mut(CHUNK_ROWS * width).enumerate().for_each(|(chunk, data)| {
                        let j0 = chunk * CHUNK_ROWS;
                        for j in j0..(j0 + CHUNK_ROWS).min(n) {
                            let at = (j - j0) / BLOCK * width * BLOCK + j % BLOCK;
                            for c in 0..width.min(3) {
                                data[at + c * BLOCK] = if projected[j].radius > F::ZERO { d[j][c] } else { F::ZERO };
                            }
                        }
                    });
                }
                continue;
            }
            Color::Sh { table, rows, weights, base } => (table, rows, weights, base),
        };
        let layout = Layout::new(table.width(), weights.map_or(1, Table::width), degree);
        match weights {
            None => grads.weights = None,
            Some(like) => {
                let table = grads.weights.get_or_insert_with(|| Table::with_columns(like.columns().to_vec(), 0));
                project::reshape(table, like);
                table.fill(F::ZERO);
            }
        }
        if n == 0 || layout.used == 0 {
            continue;
        }
        // Coefficients: the layer's own rows are added to, foreign ones are compact.
        let (target, rows_out) = if base { (d_sh[p].as_deref_mut(), rows) } else { (grads.color.as_mut(), Rows::All) };
        if let Some(target) = target {
            let width = target.width();
            assert_eq!(width, table.width(), "the SH gradient has the SH table's columns");
            target.data_mut().par_chunks_mut(CHUNK_ROWS * width).enumerate().for_each(|(chunk, data)| {
                let kernel = ShGrads {
                    part,
                    rows: rows_out,
                    weights,
                    layout,
                    center: view.center,
                    projected,
                    channels,
                    d,
                    first: chunk * CHUNK_ROWS,
                    data,
                };
                dispatch(simd, kernel);
            });
        }
        if layout.used <= 1 && weights.is_none() {
            continue;
        }
        // Direction and weights.
        let out_width = grads.out.width();
        let mut none = Vec::new();
        let weight_data = grads.weights.as_mut().map_or(none.as_mut_slice(), |w| w.data_mut());
        let per_chunk = CHUNK_ROWS * layout.blocks;
        let chunks = grads.out.data_mut().par_chunks_mut(CHUNK_ROWS * out_width);
        let task = |chunk: usize, out: &mut [F], d_weights: &mut [F]| {
            let first = chunk * CHUNK_ROWS;
            let run = first..(first + CHUNK_ROWS).min(n);
            let kernel = DirectionGrads {
                part,
                table,
                rows,
                weights,
                layout,
                center: view.center,
                first,
                projected: &projected[run.clone()],
                channels: &channels[run.clone()],
                d: &d[run],
                out,
                out_width,
                d_weights,
            };
            dispatch(simd, kernel)
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
        // The camera's centre moves by −Rᵀρ, so that a direction moves like its mean: dL/dρ = R Σ d_mean.
        let mut sum = [0.0; 3];
        for v in partial.iter() {
            for i in 0..3 {
                sum[i] += v[i];
            }
        }
        for k in 0..3 {
            let r = view.rotation[k];
            pose[k] += r[0].f64() * sum[0] + r[1].f64() * sum[1] + r[2].f64() * sum[2];
        }
    }
}
