//! Further channels of the splats of a view, for losses: normals, the displacement to another time, a column of the
//! Gaussians. Each has its forward and its VJP here.

use crate::loss::image::{Channel, View};
use rayon::prelude::*;
use splat4d::layers::{Evaluation, Scene};
use splat4d::math::Real;
use splat4d::scene::splats::COV;
use splat4d::scene::{Camera, Grads, Key, Params, Rows, Space, Table};

/// The least gap between the two smallest variances, as a share of the largest, at which the shortest axis is one.
const LEAST_GAP: f64 = 1e-3;
/// Splats in a task.
const CHUNK: usize = 512;

/// The source of channels.
#[derive(Clone, Copy)]
pub(super) struct Source<'a, F: Real> {
    pub(super) scene: &'a Scene<F>,
    pub(super) view: &'a View<'a, F>,
    /// By layer: the query whose results are the view's splats.
    pub(super) asked: &'a [usize],
}

/// The results in which a layer's splats are at another time.
struct Later {
    query: usize,
    /// A row per splat of the view; `None`: it was not requested.
    rows: Vec<Option<usize>>,
}

/// Further channels of the splats of one view.
pub(super) struct Channels<F> {
    /// [all splats, C]
    pub(super) table: Table<F>,
    /// The rendered channels, each with its first column.
    pub(super) places: Vec<(Channel, usize)>,
    /// By channel with a displacement, by layer, its target.
    later: Vec<(Channel, Vec<Later>)>,
}

impl<F: Real> Channels<F> {
    /// Of the splats that `evaluation` has of a view. `None`: there is nothing to render.
    pub(super) fn new(wanted: &[Channel], source: Source<'_, F>, evaluation: &Evaluation<F>) -> Option<Self> {
        let drawn = wanted.iter().filter(|c| match c {
            Channel::Sigmoid(column) => source.scene.layers.iter().any(|l| logit_of(&l.params, column).is_some()),
            Channel::Normals | Channel::Flow | Channel::Tracks => true,
        });
        let mut width = 0;
        let place = |channel: &Channel| {
            width += channel.width();
            (channel.clone(), width - channel.width())
        };
        let places: Vec<(Channel, usize)> = drawn.map(place).collect();
        if places.is_empty() {
            return None;
        }
        let count = source.asked.iter().map(|&i| evaluation.tape(i).out().rows()).sum();
        let mut out = Self { table: Table::new(&[("extra", width)], count), places, later: Vec::new() };
        for (channel, column) in out.places.clone() {
            match &channel {
                Channel::Normals => out.normals(column, source, evaluation),
                Channel::Flow | Channel::Tracks => out.flow(column, &channel, source, evaluation),
                Channel::Sigmoid(name) => out.sigmoid(column, name, source, evaluation),
            }
        }
        Some(out)
    }

    /// From the gradient of the table to those of the results, and of the layers' columns.
    pub(super) fn backward(
        &self,
        d_table: &Table<F>,
        source: Source<'_, F>,
        evaluation: &mut Evaluation<F>,
        d: &mut [Grads<F>],
    ) {
        for (channel, column) in &self.places {
            match channel {
                Channel::Normals => normals_backward((d_table, *column), source, evaluation),
                Channel::Flow | Channel::Tracks => self.flow_backward((d_table, *column), channel, source, evaluation),
                Channel::Sigmoid(name) => self.sigmoid_backward((d_table, *column), name, source, evaluation, d),
            }
        }
    }

    fn normals(&mut self, column: usize, source: Source<'_, F>, evaluation: &Evaluation<F>) {
        let mut first = 0;
        for &i in source.asked {
            let out = evaluation.tape(i).out();
            let normals = each(out.rows(), |r| normal(source.view.camera, out.read(r, 0), out.read(r, COV)));
            normals.iter().enumerate().for_each(|(r, n)| self.table.write(first + r, column, *n));
            first += out.rows();
        }
    }

    fn flow(&mut self, column: usize, channel: &Channel, source: Source<'_, F>, evaluation: &Evaluation<F>) {
        let truth = channel.way(source.view).expect("only views with flow request it");
        let (mut first, mut all) = (0, Vec::new());
        for (layer, &i) in source.asked.iter().enumerate() {
            let now = evaluation.tape(i);
            let query = evaluation.find(layer, Space::Gaussians, truth.to).expect("a flow's time was queried");
            let then = evaluation.tape(query);
            let row = |id: usize| match then.rows() {
                Rows::All => Some(id),
                Rows::Some(ids) => ids.binary_search(&(id as u32)).ok(),
            };
            let rows: Vec<Option<usize>> = (0..now.out().rows()).map(|j| row(now.rows().id(j))).collect();
            let way = |r: usize| {
                let [from, to] =
                    [now.out().read::<3>(r, 0), then.out().read(rows[r]?, 0)].map(|x: [F; 3]| x.map(F::f64));
                let (p, q) = (source.view.camera.project(from)?.0, truth.camera.project(to)?.0);
                Some([F::of(q[0] - p[0]), F::of(q[1] - p[1]), F::ONE])
            };
            let ways = each(rows.len(), way);
            let values = ways.iter().map(|w| w.unwrap_or([F::ZERO; 3]));
            values.enumerate().for_each(|(r, w)| self.table.write(first + r, column, w));
            first += rows.len();
            all.push(Later { query, rows });
        }
        self.later.push((channel.clone(), all));
    }

    fn flow_backward(
        &self,
        (d_table, column): (&Table<F>, usize),
        channel: &Channel,
        source: Source<'_, F>,
        evaluation: &mut Evaluation<F>,
    ) {
        let truth = channel.way(source.view).expect("only views with flow request it");
        let (_, all) = self.later.iter().find(|(c, _)| c == channel).expect("what is backpropagated was rendered");
        let mut first = 0;
        for (&i, later) in source.asked.iter().zip(all) {
            // Where the flow has no duration, it has no effect on the splats.
            if later.query != i {
                let (now, then) = (evaluation.tape(i).out(), evaluation.tape(later.query).out());
                let back = |r: usize| {
                    let (to, d): (usize, [F; 2]) = (later.rows[r]?, d_table.read(first + r, column));
                    if self.table.get(first + r, column + 2) == F::ZERO || d == [F::ZERO; 2] {
                        return None;
                    }
                    let d = d.map(F::f64);
                    let d_now = project_backward(source.view.camera, now.read::<3>(r, 0).map(F::f64), d);
                    let d_then = project_backward(truth.camera, then.read::<3>(to, 0).map(F::f64), d);
                    Some((d_now.map(|x| F::of(-x)), d_then.map(F::of)))
                };
                let ways = each(later.rows.len(), back);
                let ends = || ways.iter().enumerate().filter_map(|(r, ends)| Some((r, ends.as_ref()?)));
                let d_now = evaluation.d_out(i);
                ends().for_each(|(r, (d, _))| d_now.add(r, 0, *d));
                let d_then = evaluation.d_out(later.query);
                ends().for_each(|(r, (_, d))| d_then.add(later.rows[r].expect("it has an end"), 0, *d));
            }
            first += later.rows.len();
        }
    }

    fn sigmoid(&mut self, column: usize, name: &str, source: Source<'_, F>, evaluation: &Evaluation<F>) {
        let mut first = 0;
        for (layer, &i) in source.scene.layers.iter().zip(source.asked) {
            let tape = evaluation.tape(i);
            if let Some((key, from)) = logit_of(&layer.params, name) {
                for j in 0..tape.out().rows() {
                    let logit = layer.params[key].get(tape.rows().id(j), from);
                    self.table.set(first + j, column, logit.sigmoid());
                }
            }
            first += tape.out().rows();
        }
    }

    fn sigmoid_backward(
        &self,
        (d_table, column): (&Table<F>, usize),
        name: &str,
        source: Source<'_, F>,
        evaluation: &Evaluation<F>,
        d: &mut [Grads<F>],
    ) {
        let mut first = 0;
        for ((layer, &i), d) in source.scene.layers.iter().zip(source.asked).zip(d) {
            let tape = evaluation.tape(i);
            if let Some((key, to)) = logit_of(&layer.params, name) {
                let [d] = d.of([key]);
                for j in 0..tape.out().rows() {
                    let s = self.table.get(first + j, column);
                    *d.get_mut(tape.rows().id(j), to) += d_table.get(first + j, column) * s * (F::ONE - s);
                }
            }
            first += tape.out().rows();
        }
    }
}

fn normals_backward<F: Real>(
    (d_table, column): (&Table<F>, usize),
    source: Source<'_, F>,
    evaluation: &mut Evaluation<F>,
) {
    let mut first = 0;
    for &i in source.asked {
        let out = evaluation.tape(i).out();
        let back = |r: usize| {
            let d: [F; 3] = d_table.read(first + r, column);
            (d != [F::ZERO; 3]).then(|| normal_backward(source.view.camera, out.read(r, 0), out.read(r, COV), d))
        };
        let grads = each(out.rows(), back);
        first += grads.len();
        let d_out = evaluation.d_out(i);
        for (r, d) in grads.into_iter().enumerate() {
            if let Some(d) = d {
                d_out.add(r, COV, d);
            }
        }
    }
}

/// The table and column of a layer's logit of that name.
fn logit_of<F: Real>(params: &Params<F>, column: &str) -> Option<(Key, usize)> {
    params.keys().find_map(|k| params[k].column(column).map(|(first, _)| (k, first)))
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
    // An off-diagonal represents both of its positions.
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
