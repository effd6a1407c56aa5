//! The context of nodes, and how the network's output becomes a motion of the world.

use super::{CONTEXT, Equivariance};
use crate::math::Real;
use crate::nn::frames::{local_frames, mean, offsets};
use crate::nn::ssm::{LANES, Lane};
use crate::scene::{BLOCK, Params, Table};

/// Neighbours whose offsets are inputs of a node.
const SEEN: usize = 4;
/// Vectors that vector neurons get: from the centroid and to the neighbours.
pub(crate) const VECTORS: usize = SEEN + 1;
/// Numbers of a frame.
const FRAME: usize = 9;

/// Columns of the table of contexts: a position; a frame and offsets in it; vectors.
pub(crate) fn width(e: Equivariance) -> usize {
    match e {
        Equivariance::None => 3,
        Equivariance::Frames => FRAME + 3 * SEEN,
        Equivariance::Vector => 3 * VECTORS,
    }
}

/// Takes the nodes' surroundings again, from where they are at rest. Call it after moving nodes by other means than
/// training calls it.
///
/// Shapes: `node_context` [nodes, 3 | 21 | 15]. Lengths are in units of the cloud's radius or of the neighbours'
/// distance, so that a scaled scene is the same scene.
pub fn refresh<F: Real>(e: Equivariance, p: &mut Params<F>) {
    let nodes = p.find("nodes").expect("a skin has a table of nodes");
    let context = p.find(CONTEXT).expect("the model has made its table");
    let points: Vec<[f64; 3]> = (0..p[nodes].rows()).map(|r| p[nodes].read::<3>(r, 0).map(F::f64)).collect();
    let center = mean(&points);
    let from_center: Vec<[f64; 3]> = points.iter().map(|x| [0, 1, 2].map(|k| x[k] - center[k])).collect();
    let radius = length(&from_center);
    let away = offsets(&points, SEEN);
    let near = length(&away);
    let table = &mut p[context];
    let frames = if e == Equivariance::Frames { local_frames(&points) } else { Vec::new() };
    for (row, from_center) in from_center.iter().enumerate() {
        let scaled = from_center.map(|x| F::of(x / radius));
        let away = &away[row * SEEN..(row + 1) * SEEN];
        match e {
            Equivariance::None => table.write(row, 0, scaled),
            Equivariance::Frames => {
                let frame = &frames[row];
                (0..FRAME).for_each(|k| table.set(row, k, F::of(frame[k / 3][k % 3])));
                for (j, o) in away.iter().enumerate() {
                    let local = [0, 1, 2].map(|a| F::of((0..3).map(|i| frame[i][a] * o[i]).sum::<f64>() / near));
                    table.write(row, FRAME + 3 * j, local);
                }
            }
            Equivariance::Vector => {
                table.write(row, 0, scaled);
                for (j, o) in away.iter().enumerate() {
                    table.write(row, 3 + 3 * j, o.map(|x| F::of(x / near)));
                }
            }
        }
    }
}

/// Root of the mean square; 1 where there is nothing to measure.
fn length(v: &[[f64; 3]]) -> f64 {
    let square = v.iter().flatten().map(|x| x * x).sum::<f64>() / v.len().max(1) as f64;
    if square > 0.0 && square.is_finite() { square.sqrt() } else { 1.0 }
}

/// The context of sixteen nodes.
#[derive(Clone, Debug)]
pub(crate) struct Around<F> {
    /// Scalar inputs of the network next to the embedding: a position, or offsets in the frame.
    pub scalars: Vec<Lane<F>>,
    /// Vectors [`VECTORS`], 3 that vector neurons see.
    pub vectors: Vec<Lane<F>>,
    frame: Vec<Lane<F>>,
}

/// Of the nodes 16·`block` on.
pub(crate) fn of_block<F: Real>(e: Equivariance, table: &Table<F>, block: usize) -> Around<F> {
    let all = table.block(block).as_chunks::<BLOCK>().0;
    let part = |from: usize, to: usize| all[from..to].to_vec();
    match e {
        Equivariance::None => Around { scalars: part(0, 3), vectors: Vec::new(), frame: Vec::new() },
        Equivariance::Frames => Around { scalars: part(FRAME, all.len()), vectors: Vec::new(), frame: part(0, FRAME) },
        Equivariance::Vector => Around { scalars: Vec::new(), vectors: part(0, all.len()), frame: Vec::new() },
    }
}

/// Shift and rotation vector \[6, ticks\] from the network's to the world's axes and units, in place.
pub(crate) fn to_world<F: Real>(e: Equivariance, around: &Around<F>, extent: f64, x: &mut [Lane<F>]) {
    if e == Equivariance::Frames {
        turn(x, |i, a| &around.frame[3 * i + a]);
    }
    scale(extent, x);
}

/// VJP of [`to_world`], in place.
pub(crate) fn to_world_backward<F: Real>(e: Equivariance, around: &Around<F>, extent: f64, d: &mut [Lane<F>]) {
    scale(extent, d);
    if e == Equivariance::Frames {
        turn(d, |i, a| &around.frame[3 * a + i]);
    }
}

fn scale<F: Real>(extent: f64, x: &mut [Lane<F>]) {
    let shifts = x.len() / 2;
    x[..shifts].as_flattened_mut().iter_mut().for_each(|x| *x *= F::of(extent));
}

/// Both vectors of every tick times a matrix.
fn turn<'a, F: Real>(x: &mut [Lane<F>], matrix: impl Fn(usize, usize) -> &'a Lane<F>) {
    let ticks = x.len() / 6;
    for first in [0, 3] {
        for t in 0..ticks {
            let v = [0, 1, 2].map(|a| x[(first + a) * ticks + t]);
            for i in 0..3 {
                let m = [0, 1, 2].map(|a| matrix(i, a));
                let to = &mut x[(first + i) * ticks + t];
                for l in 0..LANES {
                    to[l] = m[0][l] * v[0][l] + m[1][l] * v[1][l] + m[2][l] * v[2][l];
                }
            }
        }
    }
}
