//! Poses at keys in time: uniform cubic B-splines, straight lines, great arcs.
//!
//! A cubic curve of M keys has M − 3 equal segments; in one, with u in [0, 1], the pose is Σ b_j(u) key_j with
//! b = ((1−u)³, 3u³−6u²+4, −3u³+3u²+3u+1, u³)/6. Shifts and quaternion residuals are blended alike, and the rotation is
//! normalised where it is used: adequate while neighbouring keys turn less than 60° from each other.

use super::super::skin::{POSE, Skin, Trajectory};
use super::{Curve, MAX_KEYS, check_size, refuse};
use crate::Result;
use crate::math::{Real, quat};
use crate::motion::Slot;
use crate::scene::{Grads, Key, Params, Space, Table, Time};

/// Keys that one pose depends on, at most.
const REACH: usize = 4;
/// Below this 1 − cos θ, θ/sin θ is taken from its series, whose next term is then below 1e-12.
const SMALL_TURN: f64 = 1e-6;

/// Times of keys.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Timeline {
    curve: Curve,
    keys: usize,
    clip: [f64; 2],
}

/// A time between keys: the first key it depends on, the share of the segment that has passed, and its slope in t (1/s;
/// zero outside the clip).
#[derive(Clone, Copy, Debug, PartialEq)]
struct Place {
    first: usize,
    u: f64,
    slope: f64,
}

impl Timeline {
    /// `keys` keys over `clip` (seconds). Errors: too few or too many keys, a clip that is none.
    pub(crate) fn new(curve: Curve, keys: usize, clip: [f64; 2]) -> Result<Self> {
        let least = if curve == Curve::Cubic { REACH } else { 2 };
        if !(least..=MAX_KEYS).contains(&keys) {
            return Err(refuse(format!("invalid curve of {keys} keys: expected {least} to {MAX_KEYS}")));
        }
        if !(clip[0].is_finite() && clip[1].is_finite() && clip[0] <= clip[1]) {
            return Err(refuse(format!("invalid clip from {} to {} seconds", clip[0], clip[1])));
        }
        Ok(Self { curve, keys, clip })
    }

    /// Keys in all.
    pub(crate) fn keys(&self) -> usize {
        self.keys
    }

    fn place(&self, t: Time) -> Place {
        let segments = if self.curve == Curve::Cubic { self.keys - 3 } else { self.keys - 1 };
        // A clip of one time has no rate of time.
        let length = self.clip[1] - self.clip[0];
        let rate = if length > 0.0 { segments as f64 / length } else { 0.0 };
        let along = (t.0 - self.clip[0]) * rate;
        // NaN stays, so that the trainer's guard finds it.
        let inside = along > 0.0 && along < segments as f64;
        let along = along.clamp(0.0, segments as f64);
        let first = (along as usize).min(segments - 1);
        Place { first, u: along - first as f64, slope: if inside { rate } else { 0.0 } }
    }

    /// First key, weights of it and the following, and their slopes in t.
    pub(super) fn weights(&self, t: Time) -> (usize, [f64; REACH], [f64; REACH]) {
        let Place { first, u, slope } = self.place(t);
        let (w, d) = match self.curve {
            Curve::Cubic => (cubic(u), cubic_slope(u)),
            _ => ([1.0 - u, u, 0.0, 0.0], [-1.0, 1.0, 0.0, 0.0]),
        };
        (first, w, d.map(|x| x * slope))
    }

    /// Keys that a pose depends on.
    pub(super) fn reach(&self) -> usize {
        if self.curve == Curve::Cubic { REACH } else { 2 }
    }
}

/// The uniform cubic B-spline's basis.
fn cubic(u: f64) -> [f64; REACH] {
    let (v, u2, u3) = (1.0 - u, u * u, u * u * u);
    [v * v * v, 3.0 * u3 - 6.0 * u2 + 4.0, -3.0 * u3 + 3.0 * u2 + 3.0 * u + 1.0, u3].map(|x| x / 6.0)
}

/// Its derivative in u.
fn cubic_slope(u: f64) -> [f64; REACH] {
    let (v, u2) = (1.0 - u, u * u);
    [-v * v, 3.0 * u2 - 4.0 * u, -3.0 * u2 + 2.0 * u + 1.0, u2].map(|x| 0.5 * x)
}

/// A trajectory of keys: table `node_keys` with `node_shifts` [nodes, 3·keys] and `node_turns` [nodes, 4·keys], key
/// after key.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Keys {
    line: Timeline,
    keys: Key,
}

impl Keys {
    /// Makes (all at rest) or claims the table. Errors: it would be too large, a loaded array of the wrong shape.
    pub(crate) fn new<F: Real>(line: Timeline, skin: &Skin, p: &mut Params<F>) -> Result<Self> {
        let (rows, width) = (skin.count(p), POSE * line.keys);
        check_size("node_keys", rows, width)?;
        let columns = [("node_shifts", 3 * line.keys), ("node_turns", 4 * line.keys)];
        let keys = p.entry("node_keys", Space::Nodes, &columns, rows, |_| {})?;
        Ok(Self { line, keys })
    }

    /// The pose at a key.
    #[inline(always)]
    fn key<F: Real>(&self, p: &Params<F>, node: usize, key: usize) -> [F; POSE] {
        let ([x, y, z], [a, b, c, d]) = (p[self.keys].read(node, 3 * key), p[self.keys].read(node, self.turn(key)));
        [x, y, z, a, b, c, d]
    }

    /// First column of a key's turn.
    fn turn(&self, key: usize) -> usize {
        3 * self.line.keys + 4 * key
    }

    fn arc<F: Real>(&self, p: &Params<F>, node: usize, first: usize, u: f64) -> Arc<F> {
        Arc::new([first, first + 1].map(|key| p[self.keys].read(node, self.turn(key))), u)
    }

    /// Key of the table.
    #[cfg(test)]
    pub(crate) fn table(&self) -> Key {
        self.keys
    }
}

impl<F: Real> Trajectory<F> for Keys {
    fn scratch_bytes(&self, _p: &Params<F>) -> u64 {
        0
    }

    fn poses(&self, p: &Params<F>, t: Time, _cache: &Slot, out: &mut Table<F>) {
        let (first, w, _) = self.line.weights(t);
        for node in 0..out.rows() {
            let mut pose = [F::ZERO; POSE];
            for (j, w) in w[..self.line.reach()].iter().enumerate() {
                let key = self.key(p, node, first + j);
                (0..POSE).for_each(|c| pose[c] += F::of(*w) * key[c]);
            }
            if self.line.curve == Curve::Slerp {
                let arc = self.arc(p, node, first, w[1]);
                pose[3..].copy_from_slice(&arc.residual());
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
        let (first, w, slopes) = self.line.weights(t);
        let [d_keys] = d.of([self.keys]);
        let mut d_time = 0.0;
        for node in 0..d_out.rows() {
            let mut g = d_out.read::<POSE>(node, 0);
            if self.line.curve == Curve::Slerp {
                let arc = self.arc(p, node, first, w[1]);
                let (d_from, d_to, d_u) = arc.backward([g[3], g[4], g[5], g[6]]);
                d_keys.add(node, self.turn(first), d_from);
                d_keys.add(node, self.turn(first + 1), d_to);
                d_time += d_u.f64() * slopes[1];
                g[3..].fill(F::ZERO);
            }
            for j in 0..self.line.reach() {
                let key = self.key(p, node, first + j);
                d_time += slopes[j] * (0..POSE).map(|c| (g[c] * key[c]).f64()).sum::<f64>();
                let g = g.map(|x| F::of(w[j]) * x);
                d_keys.add(node, 3 * (first + j), [g[0], g[1], g[2]]);
                d_keys.add(node, self.turn(first + j), [g[3], g[4], g[5], g[6]]);
            }
        }
        d_time
    }
}

/// A great arc between the rotations of two keys: q(u) = f(1−u) a + f(u) s b, f(u) = sin(uθ)/sin θ, cos θ = |a·b|
/// (Shoemake 1985).
struct Arc<F> {
    /// Unit quaternions and the norms of what they were made from.
    from: ([F; 4], F),
    to: ([F; 4], F),
    sign: F,
    /// f(1−u) and f(u), their slopes in cos θ and in their argument.
    near: [F; 3],
    far: [F; 3],
}

impl<F: Real> Arc<F> {
    /// Between two quaternion residuals.
    fn new(residuals: [[F; 4]; 2], u: f64) -> Self {
        let [from, to] = residuals.map(|r| quat::normalize([F::ONE + r[0], r[1], r[2], r[3]]));
        let along: F = (0..4).map(|i| from.0[i] * to.0[i]).sum();
        let sign = if along < F::ZERO { -F::ONE } else { F::ONE };
        let cos = (along * sign).f64().min(1.0);
        Self { from, to, sign, near: fraction(1.0 - u, cos).map(F::of), far: fraction(u, cos).map(F::of) }
    }

    /// The rotation less the identity.
    fn residual(&self) -> [F; 4] {
        let mut q: [F; 4] =
            std::array::from_fn(|i| self.near[0] * self.from.0[i] + self.far[0] * self.sign * self.to.0[i]);
        q[0] -= F::ONE;
        q
    }

    /// dL/d residuals of both keys, and dL/du.
    fn backward(&self, g: [F; 4]) -> ([F; 4], [F; 4], F) {
        let (a, b) = (self.from.0, self.to.0.map(|x| self.sign * x));
        let dot = |x: [F; 4]| (0..4).map(|i| g[i] * x[i]).sum::<F>();
        let (by_near, by_far) = (dot(a), dot(b));
        let d_cos = by_near * self.near[1] + by_far * self.far[1];
        let d_u = by_far * self.far[2] - by_near * self.near[2];
        let d_a = std::array::from_fn(|i| self.near[0] * g[i] + d_cos * b[i]);
        let d_b: [F; 4] = std::array::from_fn(|i| self.sign * (self.far[0] * g[i] + d_cos * a[i]));
        let from = quat::normalize_backward(self.from.0, self.from.1, d_a);
        (from, quat::normalize_backward(self.to.0, self.to.1, d_b), d_u)
    }
}

/// f(u) = sin(uθ)/sin θ and its slopes in cos θ and in u.
fn fraction(u: f64, cos: f64) -> [f64; 3] {
    let short = 1.0 - cos;
    if short < SMALL_TURN {
        // θ² ≈ 2 (1 − cos θ).
        return [
            u + u * (1.0 - u * u) * short / 3.0,
            -u * (1.0 - u * u) / 3.0,
            1.0 + (1.0 - 3.0 * u * u) * short / 3.0,
        ];
    }
    let angle = cos.acos();
    let sin = angle.sin();
    let (s, c) = (u * angle).sin_cos();
    let d_angle = (u * c * sin - s * cos) / (sin * sin);
    [s / sin, -d_angle / sin, angle * c / sin]
}
