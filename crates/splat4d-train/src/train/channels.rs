//! What is drawn beside colours so that losses can look at it: normals of splats and their way to another instant.

use crate::capture::frames::FlowTruth;
use rayon::prelude::*;
use splat4d::math::Real;
use splat4d::scene::splats::COV;
use splat4d::scene::{Camera, Table};

/// What a loss wants of a view beside colour and alpha.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// Σ z α T.
    pub depth: bool,
    /// Σ α T n, n the shortest axis of a splat towards the camera, camera axes.
    pub normals: bool,
    /// Where the view knows its flow: Σ α T f, f the way of a splat's centre on the screen, pixels, and Σ α T.
    pub flow: bool,
}

/// The least gap between the two smallest variances, as a share of the largest, at which the shortest axis is one.
const LEAST_GAP: f64 = 1e-3;
/// Splats in a task.
const CHUNK: usize = 512;

/// A splat's later place, if it was asked for: a table [rows, 10] and a row of it a splat; `u32::MAX`: none.
pub(super) struct Later<'a, F> {
    pub(super) out: &'a Table<F>,
    pub(super) rows: &'a [u32],
}

/// Further channels of the splats of one view.
pub(super) struct Channels<F> {
    /// [all splats, C]
    pub(super) table: Table<F>,
    normals: bool,
    flow: bool,
    /// Whether the last column is a share that was given.
    share: bool,
}

impl<F: Real> Channels<F> {
    /// Of the splats `parts` (a [rows, 10] table a layer). `share`: a number a splat that is blended as it is. `None`:
    /// nothing is wanted.
    pub(super) fn new(
        wanted: Wanted,
        camera: &Camera,
        parts: &[&Table<F>],
        flow: Option<(&FlowTruth<'_, F>, &[Later<'_, F>])>,
        share: Option<&[F]>,
    ) -> Option<Self> {
        let flow = flow.filter(|_| wanted.flow);
        let mut columns: Vec<(&'static str, usize)> = Vec::new();
        columns.extend(wanted.normals.then_some(("normal", 3)));
        columns.extend(flow.is_some().then_some(("flow", 3)));
        columns.extend(share.is_some().then_some(("share", 1)));
        if columns.is_empty() {
            return None;
        }
        let count = parts.iter().map(|p| p.rows()).sum();
        let mut table = Table::new(&columns, count);
        if let Some(share) = share {
            let column = table.width() - 1;
            share.iter().enumerate().for_each(|(j, s)| table.set(j, column, *s));
        }
        let mut first = 0;
        for (layer, part) in parts.iter().enumerate() {
            if wanted.normals {
                let normals = each(part.rows(), |r| normal(camera, part.read(r, 0), part.read(r, COV)));
                normals.iter().enumerate().for_each(|(r, n)| table.write(first + r, 0, *n));
            }
            if let Some((truth, later)) = flow {
                let column = if wanted.normals { 3 } else { 0 };
                let way = |r: usize| {
                    let then = later[layer].rows[r];
                    let ends =
                        (then != u32::MAX).then(|| [part.read::<3>(r, 0), later[layer].out.read(then as usize, 0)]);
                    let [from, to] = ends?.map(|x| x.map(F::f64));
                    let (p, q) = (camera.project(from)?.0, truth.camera.project(to)?.0);
                    Some([F::of(q[0] - p[0]), F::of(q[1] - p[1]), F::ONE])
                };
                let ways = each(part.rows(), way);
                ways.iter().enumerate().for_each(|(r, w)| table.write(first + r, column, w.unwrap_or([F::ZERO; 3])));
            }
            first += part.rows();
        }
        Some(Self { table, normals: wanted.normals, flow: flow.is_some(), share: share.is_some() })
    }

    /// First channel of the normals.
    pub(super) fn normals(&self) -> Option<usize> {
        self.normals.then_some(0)
    }

    /// First channel of the flow.
    pub(super) fn flow(&self) -> Option<usize> {
        self.flow.then_some(if self.normals { 3 } else { 0 })
    }

    /// The channel of the share.
    pub(super) fn share(&self) -> Option<usize> {
        self.share.then(|| self.table.width() - 1)
    }

    /// From the gradient of the table to those of the splats of layer `layer`, whose first row is `first`: added to `d_out`,
    /// and for the flow to `d_later`, a row of the later place's table each.
    pub(super) fn backward(
        &self,
        camera: &Camera,
        out: &Table<F>,
        first: usize,
        d_table: &Table<F>,
        d_out: &mut Table<F>,
        flow: Option<(&FlowTruth<'_, F>, &Later<'_, F>, &mut Table<F>)>,
    ) {
        if self.normals {
            let back = |r: usize| {
                let d: [F; 3] = d_table.read(first + r, 0);
                (d != [F::ZERO; 3]).then(|| normal_backward(camera, out.read(r, 0), out.read(r, COV), d))
            };
            for (r, d) in each(out.rows(), back).into_iter().enumerate() {
                if let Some(d) = d {
                    d_out.add(r, COV, d);
                }
            }
        }
        let (Some(column), Some((truth, later, d_later))) = (self.flow(), flow) else { return };
        for (r, &then) in later.rows.iter().enumerate() {
            let d: [F; 2] = d_table.read(first + r, column);
            if then == u32::MAX || self.table.get(first + r, column + 2) == F::ZERO || d == [F::ZERO; 2] {
                continue;
            }
            let d = d.map(F::f64);
            let from = project_backward(camera, out.read::<3>(r, 0).map(F::f64), d);
            let to = project_backward(truth.camera, later.out.read::<3>(then as usize, 0).map(F::f64), d);
            d_out.add(r, 0, from.map(|x| F::of(-x)));
            d_later.add(then as usize, 0, to.map(F::of));
        }
    }
}

fn each<T: Send>(rows: usize, f: impl Fn(usize) -> T + Send + Sync) -> Vec<T> {
    (0..rows).into_par_iter().with_min_len(CHUNK).map(f).collect()
}

/// The VJP of a pinhole's projection.
fn project_backward(camera: &Camera, x: [f64; 3], d: [f64; 2]) -> [f64; 3] {
    let (p, k) = (camera.cam_from_world.apply(x), &camera.intrinsics);
    let (u, v) = (d[0] * k.fx / p[2], d[1] * k.fy / p[2]);
    let in_camera = [u, v, -(u * p[0] + v * p[1]) / p[2]];
    let r = &camera.cam_from_world.rotation;
    std::array::from_fn(|c| (0..3).map(|row| r[row][c] * in_camera[row]).sum())
}

/// The unit eigenvector of the smallest of three eigenvalues, and that value; `None` where it is not one alone.
///
/// In closed form: Smith 1961 for the value; the vector is the longest cross product of two rows of Σ − λI.
fn shortest_axis(m: [f64; 6]) -> Option<([f64; 3], f64)> {
    let [xx, xy, xz, yy, yz, zz] = m;
    let mean = (xx + yy + zz) / 3.0;
    let (a, b, c) = (xx - mean, yy - mean, zz - mean);
    let p = ((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0).sqrt();
    if p.is_nan() || p <= LEAST_GAP * mean.abs() * 0.5 {
        return None;
    }
    let det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz);
    let angle = (0.5 * det / (p * p * p)).clamp(-1.0, 1.0).acos() / 3.0;
    let largest = mean + 2.0 * p * angle.cos();
    let smallest = mean + 2.0 * p * (angle + std::f64::consts::TAU / 3.0).cos();
    let middle = 3.0 * mean - largest - smallest;
    if middle - smallest <= LEAST_GAP * largest {
        return None;
    }
    let rows = [[xx - smallest, xy, xz], [xy, yy - smallest, yz], [xz, yz, zz - smallest]];
    use splat4d::math::se3::{cross, dot, normalize};
    let crosses = [cross(rows[0], rows[1]), cross(rows[1], rows[2]), cross(rows[2], rows[0])];
    let best = crosses.into_iter().max_by(|a, b| dot(*a, *a).total_cmp(&dot(*b, *b)))?;
    Some((normalize(best), smallest))
}

/// +1 or −1: which way the axis points towards the camera.
fn facing(camera: &Camera, mean: [f64; 3], axis: [f64; 3]) -> f64 {
    let center = camera.center();
    let towards: f64 = (0..3).map(|k| axis[k] * (center[k] - mean[k])).sum();
    if towards < 0.0 { -1.0 } else { 1.0 }
}

fn normal<F: Real>(camera: &Camera, mean: [F; 3], cov: [F; 6]) -> [F; 3] {
    let Some((axis, _)) = shortest_axis(cov.map(F::f64)) else { return [F::ZERO; 3] };
    let sign = facing(camera, mean.map(F::f64), axis);
    let r = &camera.cam_from_world.rotation;
    std::array::from_fn(|row| F::of(sign * (0..3).map(|c| r[row][c] * axis[c]).sum::<f64>()))
}

/// To the packed covariance: dn = (λI − Σ)⁺ dΣ n, ⁺ within the plane across n.
fn normal_backward<F: Real>(camera: &Camera, mean: [F; 3], cov: [F; 6], d: [F; 3]) -> [F; 6] {
    use splat4d::math::se3::{cross, dot, normalize};
    let m = cov.map(F::f64);
    let Some((n, least)) = shortest_axis(m) else { return [F::ZERO; 6] };
    let sign = facing(camera, mean.map(F::f64), n);
    let r = &camera.cam_from_world.rotation;
    let d_n: [f64; 3] = std::array::from_fn(|c| sign * (0..3).map(|row| r[row][c] * d[row].f64()).sum::<f64>());
    // Two directions across n; the axis that n has least of is never along it.
    let k = (0..3).fold(0, |k, i| if n[i].abs() < n[k].abs() { i } else { k });
    let u = normalize(cross(n, std::array::from_fn(|i| f64::from(u8::from(i == k)))));
    let v = cross(n, u);
    let apply = |x: [f64; 3]| {
        [
            m[0] * x[0] + m[1] * x[1] + m[2] * x[2],
            m[1] * x[0] + m[3] * x[1] + m[4] * x[2],
            m[2] * x[0] + m[4] * x[1] + m[5] * x[2],
        ]
    };
    let (a, b, c) = (least - dot(u, apply(u)), -dot(u, apply(v)), least - dot(v, apply(v)));
    let det = a * c - b * b;
    let (gu, gv) = (dot(u, d_n), dot(v, d_n));
    let (yu, yv) = ((c * gu - b * gv) / det, (a * gv - b * gu) / det);
    let y: [f64; 3] = std::array::from_fn(|i| yu * u[i] + yv * v[i]);
    // An off-diagonal stands for both of its places.
    let pair = |i: usize, j: usize| if i == j { y[i] * n[i] } else { y[i] * n[j] + y[j] * n[i] };
    [pair(0, 0), pair(0, 1), pair(0, 2), pair(1, 1), pair(1, 2), pair(2, 2)].map(F::of)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::sym3::{eigen, from_quat_log_scales};
    use splat4d::math::{Rng, Se3};

    fn shape(i: u64) -> [f64; 6] {
        let rng = Rng::new(3, "channels", i);
        let x: [f64; 7] = std::array::from_fn(|k| rng.normal(k as u64));
        from_quat_log_scales([x[0], x[1], x[2], x[3]], [x[4], x[5], x[6]])
    }

    fn camera() -> Camera {
        Camera::with_fov_y(Se3::look_at([1.0, 2.0, 5.0], [0.0; 3], [0.0, 1.0, 0.0]), 0.8, 40, 30)
    }

    #[test]
    fn the_shortest_axis_is_the_eigenvector_and_a_ball_has_none() {
        for i in 0..200 {
            let (values, vectors) = eigen(shape(i));
            let Some((axis, value)) = shortest_axis(shape(i)) else {
                assert!(values[1] - values[2] <= 1.01 * LEAST_GAP * values[0], "{values:?}");
                continue;
            };
            let along: f64 = (0..3).map(|k| axis[k] * vectors[k][2]).sum();
            assert!((along.abs() - 1.0).abs() < 1e-6 && (value - values[2]).abs() < 1e-9 * values[0], "{values:?}");
        }
        assert!(shortest_axis([2.0, 0.0, 0.0, 2.0, 0.0, 2.0]).is_none() && shortest_axis([0.0; 6]).is_none());
        assert!(shortest_axis([5.0, 0.0, 0.0, 2.0, 0.0, 2.0]).is_none(), "a needle has no shortest axis");
        assert!(shortest_axis([f64::NAN; 6]).is_none());
    }

    #[test]
    fn gradients_of_normals_and_projections_equal_finite_differences() {
        let (camera, d) = (camera(), [0.3, -0.7, 0.4]);
        for i in 0..40 {
            let cov = shape(i);
            let values = eigen(cov).0;
            if values[1] - values[2] < 0.02 * values[0] {
                continue;
            }
            let value = |c: [f64; 6]| (0..3).map(|k| d[k] * normal(&camera, [0.0; 3], c)[k]).sum::<f64>();
            let got = normal_backward(&camera, [0.0; 3], cov, d);
            for k in 0..6 {
                let h = 1e-6 * values[2].max(1e-3);
                let (mut up, mut down) = (cov, cov);
                up[k] += h;
                down[k] -= h;
                let fd = (value(up) - value(down)) / (2.0 * h);
                assert!((fd - got[k]).abs() < 1e-4 * (1.0 + fd.abs()), "{i} {k}: {fd} {}", got[k]);
            }
        }
        let x = [0.3, -0.2, 0.5];
        let got = project_backward(&camera, x, [0.7, -0.4]);
        for k in 0..3 {
            let at = |h: f64| {
                let mut x = x;
                x[k] += h;
                let p = camera.project(x).unwrap().0;
                0.7 * p[0] - 0.4 * p[1]
            };
            assert!(((at(1e-6) - at(-1e-6)) / 2e-6 - got[k]).abs() < 1e-6);
        }
    }
}
