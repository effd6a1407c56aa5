//! A layer's frame: splats taken from the layer's own axes and unit of length to the world's, and their gradient back.
//!
//! With A = s R: μ' = A μ + t, Σ' = A Σ Aᵀ; opacity stays. Colours turn because the renderer takes the direction of
//! view to the layer's axes ([`Part::layer_from_world`](crate::scene::Part)). Where a model's tables can take the frame
//! in ([`Layer::apply_transform`]), no numbers are lost by a decomposition.

use super::Layer;
use crate::math::sh_rotation::{rotate_coefficients, sh_rotation};
use crate::math::{Real, Sim3, quat};
use crate::motion::lanes::{Batch, Lane, Work, fill};
use crate::scene::params::{LOG_SCALE, QUAT};
use crate::scene::splats::{COV, SPLAT_OPACITY};
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, GEOMETRY, Params, Rows, SH, Table};
use std::borrow::Cow;

/// Numbers of a splat.
const WIDTH: usize = SPLAT_OPACITY + 1;

/// Makes `world` the splats of `layer` as the frame shows them. Shapes: [splats, 10] both.
pub(super) fn forward<F: Real>(frame: &Sim3, layer: &Table<F>, world: &mut Table<F>) {
    shape_like(layer, world);
    let work = Forward { linear: frame.linear(), translation: frame.translation.map(F::of), layer };
    fill(&work, [world], Rows::All);
}

struct Forward<'a, F> {
    linear: [[F; 3]; 3],
    translation: [F; 3],
    layer: &'a Table<F>,
}

impl<F: Real> Work<F, 1> for Forward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let mut rows: [Lane<F>; WIDTH] = batch.at.read(self.layer, 0);
        for l in 0..BLOCK {
            let mean = apply(&self.linear, [rows[0][l], rows[1][l], rows[2][l]]);
            let cov = congruence(&self.linear, symmetric(std::array::from_fn(|k| rows[COV + k][l])));
            let packed = [cov[0][0], cov[0][1], cov[0][2], cov[1][1], cov[1][2], cov[2][2]];
            (0..3).for_each(|k| rows[k][l] = mean[k] + self.translation[k]);
            (0..6).for_each(|k| rows[COV + k][l] = packed[k]);
        }
        batch.write(out, 0, &rows);
        0.0
    }
}

/// The VJP of [`forward`]: makes `d_layer` the gradient to the layer's splats of the one to the world's.
pub(super) fn backward<F: Real>(frame: &Sim3, d_world: &Table<F>, d_layer: &mut Table<F>) {
    shape_like(d_world, d_layer);
    let a = frame.linear();
    let transposed = std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]));
    fill(&Backward { transposed, d_world }, [d_layer], Rows::All);
}

struct Backward<'a, F> {
    transposed: [[F; 3]; 3],
    d_world: &'a Table<F>,
}

impl<F: Real> Work<F, 1> for Backward<'_, F> {
    #[inline(always)]
    fn run(&self, batch: &Batch, [out]: &mut [TableMut<'_, F>; 1]) -> f64 {
        let mut rows: [Lane<F>; WIDTH] = batch.at.read(self.d_world, 0);
        for l in 0..BLOCK {
            let mean = apply(&self.transposed, [rows[0][l], rows[1][l], rows[2][l]]);
            // An off-diagonal's gradient represents both of its positions: halves of it in the full matrix G, and Aᵀ G
            // A.
            let [xx, xy, xz, yy, yz, zz]: [F; 6] = std::array::from_fn(|k| rows[COV + k][l]);
            let h = F::HALF;
            let g = congruence(&self.transposed, symmetric([xx, h * xy, h * xz, yy, h * yz, zz]));
            let packed = [g[0][0], F::TWO * g[0][1], F::TWO * g[0][2], g[1][1], F::TWO * g[1][2], g[2][2]];
            (0..3).for_each(|k| rows[k][l] = mean[k]);
            (0..6).for_each(|k| rows[COV + k][l] = packed[k]);
        }
        batch.write(out, 0, &rows);
        0.0
    }
}

fn shape_like<F: Real>(like: &Table<F>, out: &mut Table<F>) {
    if out.width() == like.width() {
        out.resize(like.rows());
    } else {
        *out = like.zeros_like();
    }
}

#[inline(always)]
fn apply<F: Real>(a: &[[F; 3]; 3], v: [F; 3]) -> [F; 3] {
    std::array::from_fn(|i| a[i][0] * v[0] + a[i][1] * v[1] + a[i][2] * v[2])
}

#[inline(always)]
fn symmetric<F: Real>([xx, xy, xz, yy, yz, zz]: [F; 6]) -> [[F; 3]; 3] {
    [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
}

/// A M Aᵀ
#[inline(always)]
fn congruence<F: Real>(a: &[[F; 3]; 3], m: [[F; 3]; 3]) -> [[F; 3]; 3] {
    let half: [[F; 3]; 3] = std::array::from_fn(|i| apply(&m, a[i]));
    std::array::from_fn(|i| apply(a, half[i]))
}

impl Layer<f32> {
    /// The layer with its frame in its tables, as far as [`apply_transform`](Self::apply_transform) supports it; itself
    /// where it has none.
    pub(crate) fn with_frame_absorbed(&self) -> Cow<'_, Self> {
        if self.frame.is_identity() {
            return Cow::Borrowed(self);
        }
        let mut own = self.clone();
        own.apply_transform();
        Cow::Owned(own)
    }

    /// Writes the frame into the tables, after which it is the identity, where the motion model's can take it in
    /// ([`Motion::apply_transform`](crate::motion::Motion::apply_transform)). Other layers (planes, grids, networks)
    /// keep theirs.
    pub fn apply_transform(&mut self) {
        if self.frame.is_identity() {
            return;
        }
        let frame = self.frame;
        if !self.motion.apply_transform(&mut self.params, &frame) {
            return;
        }
        absorb_geometry(&mut self.params, &frame);
        absorb_colors(&mut self.params[SH], self.motion.capabilities().color_blocks, &frame.rotation);
        self.frame = Sim3::IDENTITY;
    }
}

fn absorb_geometry(params: &mut Params, frame: &Sim3) {
    let (table, q) = (&mut params[GEOMETRY], quat::from_rotation(&frame.rotation));
    for row in 0..table.rows() {
        table.write(row, 0, frame.apply(table.read::<3>(row, 0).map(f64::from)).map(|x| x as f32));
        table.write(row, QUAT, quat::rotated(q, table.read(row, QUAT)));
        if frame.scale != 1.0 {
            table.add(row, LOG_SCALE, [frame.scale.ln() as f32; 3]);
        }
    }
}

/// `blocks`: how many blocks of coefficients are side by side.
fn absorb_colors(table: &mut Table, blocks: usize, r: &[[f64; 3]; 3]) {
    let m = sh_rotation(r);
    let block = table.width() / blocks;
    let mut row = vec![0.0; table.width()];
    for id in 0..table.rows() {
        row.iter_mut().enumerate().for_each(|(col, x)| *x = table.get(id, col));
        row.chunks_exact_mut(block.max(1)).for_each(|block| rotate_coefficients(&m, block));
        row.iter().enumerate().for_each(|(col, x)| table.set(id, col, *x));
    }
}
