//! Few motions that all nodes share: pose_k(t) = Σ_b c_kb f_b(t), with f_b a cubic curve and c_kb seven numbers per
//! node.
//!
//! Source: Kratimenos et al. 2024 ("DynMF"), there with a network for f and a coefficient a Gaussian; nodes carry them
//! here, so that Gaussians still follow rigidly.

use super::super::skin::{POSE, Skin, Trajectory};
use super::{MAX_BASES, Timeline, check_size, refuse};
use crate::Result;
use crate::math::Real;
use crate::motion::Slot;
use crate::scene::{Grads, Key, Params, Space, Table, Time};
use std::f64::consts::PI;

/// A trajectory of shared motions: `bases` [bases·keys, 1] (global); a table with `shift_coefficients` [nodes, 3·bases]
/// and `turn_coefficients` [nodes, 4·bases].
#[derive(Clone, Copy, Debug)]
pub(crate) struct LowRank {
    line: Timeline,
    count: usize,
    bases: Key,
    coefficients: Key,
}

impl LowRank {
    /// Makes or claims the tables: the motions start as cosines of rising frequency, all coefficients as zero.
    ///
    /// Errors: too many bases, tables that would be too large, loaded arrays of the wrong shape.
    pub(crate) fn new<F: Real>(line: Timeline, count: usize, skin: &Skin, p: &mut Params<F>) -> Result<Self> {
        if !(1..=MAX_BASES).contains(&count) {
            return Err(refuse(format!("invalid number of shared motions {count}: expected 1 to {MAX_BASES}")));
        }
        let (rows, width, keys) = (skin.count(p), POSE * count, line.keys());
        check_size("node_coefficients", rows, width)?;
        check_size("bases", count, keys)?;
        let fill = |t: &mut Table<F>| {
            for i in 0..count * keys {
                let (b, key) = (i / keys, i % keys);
                t.set(i, 0, F::of((PI * (b + 1) as f64 * (key as f64 + 0.5) / keys as f64).cos()));
            }
        };
        let bases = p.entry("bases", Space::Fixed, &[("bases", 1)], count * keys, fill)?;
        let columns = [("shift_coefficients", 3 * count), ("turn_coefficients", 4 * count)];
        let coefficients = p.entry("node_coefficients", Space::Nodes, &columns, rows, |_| {})?;
        Ok(Self { line, count, bases, coefficients })
    }

    /// A node's seven coefficients of a motion.
    #[inline(always)]
    fn coefficients<F: Real>(&self, p: &Params<F>, node: usize, b: usize) -> [F; POSE] {
        let table = &p[self.coefficients];
        let ([x, y, z], [c, d, e, f]) = (table.read(node, 3 * b), table.read(node, 3 * self.count + 4 * b));
        [x, y, z, c, d, e, f]
    }

    /// Value of every motion at t and its slope in t.
    fn values<F: Real>(&self, p: &Params<F>, t: Time) -> Vec<[F; 2]> {
        let (first, w, slopes) = self.line.weights(t);
        let keys = self.line.keys();
        let value = |b: usize, w: &[f64]| {
            (0..self.line.reach()).map(|j| F::of(w[j]) * p[self.bases].get(b * keys + first + j, 0)).sum()
        };
        (0..self.count).map(|b| [value(b, &w), value(b, &slopes)]).collect()
    }
}

impl<F: Real> Trajectory<F> for LowRank {
    fn scratch_bytes(&self, _p: &Params<F>) -> u64 {
        0
    }

    fn poses(&self, p: &Params<F>, t: Time, _cache: &Slot, out: &mut Table<F>) {
        let values = self.values(p, t);
        for node in 0..out.rows() {
            let mut pose = [F::ZERO; POSE];
            for (b, [f, _]) in values.iter().enumerate() {
                let c = self.coefficients(p, node, b);
                (0..POSE).for_each(|i| pose[i] += *f * c[i]);
            }
            out.write(node, 0, pose);
        }
    }

    fn poses_backward(
        &self,
        p: &Params<F>,
        t: Time,
        _cache: &Slot,
        d_out: &Table<F>,
        _d_cache: &mut Slot,
        d: &mut Grads<F>,
    ) -> f64 {
        let values = self.values(p, t);
        let (first, w, _) = self.line.weights(t);
        let [d_bases, d_coefficients] = d.of([self.bases, self.coefficients]);
        let mut d_values = vec![F::ZERO; self.count];
        for node in 0..d_out.rows() {
            let g = d_out.read::<POSE>(node, 0);
            for (b, ([f, _], d_value)) in values.iter().zip(&mut d_values).enumerate() {
                let c = self.coefficients(p, node, b);
                let d_c = g.map(|x| x * *f);
                d_coefficients.add(node, 3 * b, [d_c[0], d_c[1], d_c[2]]);
                d_coefficients.add(node, 3 * self.count + 4 * b, [d_c[3], d_c[4], d_c[5], d_c[6]]);
                *d_value += (0..POSE).map(|i| g[i] * c[i]).sum();
            }
        }
        let mut d_time = 0.0;
        for (b, (d_value, [_, slope])) in d_values.into_iter().zip(values).enumerate() {
            d_time += (d_value * slope).f64();
            for (j, w) in w[..self.line.reach()].iter().enumerate() {
                d_bases.add(b * self.line.keys() + first + j, 0, [d_value * F::of(*w)]);
            }
        }
        d_time
    }
}
