//! Bundle adjustment: poses, lenses, clocks and points together, so that points are seen where they were found.
//!
//! Levenberg-Marquardt with a robust loss; points are eliminated (Schur complement), so that the reduced system has a
//! few rows for each camera (Triggs et al. 2000, "Bundle adjustment – a modern synthesis").
//!
//! A camera whose clock is late by τ saw at its frame what the others saw τ later. A feature that moves by v pixels a
//! second therefore belongs at x + v·τ, and the residual of point X is e = π(X) − (x + v·τ): clocks are found by the
//! same least squares as poses, and what moves helps poses.

use super::algebra::{orthonormal, rotation};
use super::lens::Lens;
use rayon::prelude::*;
use splat4d::math::Se3;
use splat4d::math::cholesky::Cholesky;
use splat4d::math::mat3;
use splat4d::math::se3::{cross, mat_mul, mat_vec};

/// A camera among others.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct View {
    /// Takes world points into the camera's axes.
    pub pose: Se3,
    /// Which of [`Bundle::lenses`]; several views may share one.
    pub lens: usize,
    /// How far its clock is ahead, seconds: to be taken from its times.
    pub tau: f64,
}

/// A point that a camera sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Sighting {
    /// Which of [`Bundle::views`].
    pub view: usize,
    /// Which of [`Bundle::points`].
    pub point: usize,
    /// Where, pixels.
    pub pixel: [f64; 2],
    /// How it moves, pixels a second; zero: it is static.
    pub velocity: [f64; 2],
}

/// Cameras, points, and the sightings.
#[derive(Clone, Debug, Default)]
pub(crate) struct Bundle {
    /// The cameras.
    pub views: Vec<View>,
    /// Their lenses.
    pub lenses: Vec<Lens>,
    /// Places in the world.
    pub points: Vec<[f64; 3]>,
    /// In the order of their points.
    pub sightings: Vec<Sighting>,
}

/// Parameters in addition to points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Free {
    /// Poses.
    pub pose: bool,
    /// Focal lengths.
    pub focal: bool,
    /// Radial distortion.
    pub k1: bool,
    /// Principal points.
    pub center: bool,
    /// Clocks.
    pub tau: bool,
}

/// Standard deviations of what is known beforehand; infinite: nothing is.
#[derive(Clone, Debug)]
pub(crate) struct Priors {
    /// Prior of each lens.
    pub lenses: Vec<Lens>,
    /// Of log f.
    pub focal: f64,
    /// Of k1.
    pub k1: f64,
    /// Of cx and cy, pixels.
    pub center: f64,
    /// Of log f about the mean of all lenses, which is free: lenses of one model are alike.
    pub family: f64,
    /// Of τ about zero, seconds.
    pub tau: f64,
}

impl Priors {
    /// Nothing is known.
    #[cfg(test)]
    pub(crate) fn none(lenses: &[Lens]) -> Self {
        let free = f64::INFINITY;
        Self { lenses: lenses.to_vec(), focal: free, k1: free, center: free, family: free, tau: free }
    }
}

/// How it is adjusted.
#[derive(Clone, Debug)]
pub(crate) struct Settings {
    /// Distance beyond which a sighting hardly counts (Cauchy's loss), pixels; infinite: plain squares.
    pub scale: f64,
    /// The parameters.
    pub free: Free,
    /// Lenses that are known exactly and stay, whatever is free; none where it is empty.
    pub exact: Vec<bool>,
    /// The priors.
    pub priors: Priors,
    /// Evaluations, at most.
    pub steps: usize,
    /// It ends where a step gains less than this share.
    pub gain: f64,
}

/// The result.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Report {
    /// The loss before: Σ of half the robust squares, with priors.
    pub before: f64,
    /// And after.
    pub after: f64,
    /// Evaluations.
    pub steps: usize,
}

/// Numbers of a view: a rotation from the left, a translation, τ.
const POSE: usize = 7;
/// Numbers of a lens: log f, k1, cx, cy.
const LENS: usize = 4;
/// Numbers that a sighting depends on, without the point's.
const BOTH: usize = POSE + LENS;
/// Squared distance of a sighting whose point is behind its camera, pixels²: as if it were seen far outside.
const BEHIND: f64 = 1e8;
/// Parts in which points are summed up; fixed, so that the order of sums never depends on the machine.
const PARTS: usize = 4;

/// A residual and its derivatives.
pub(crate) struct Residual {
    pub error: [f64; 2],
    /// By the view's and the lens' numbers.
    pub by_camera: [[f64; BOTH]; 2],
    pub by_point: [[f64; 3]; 2],
}

/// e = π(X) − (x + v·τ) with derivatives; nothing behind the camera.
pub(crate) fn residual(view: &View, lens: &Lens, x: [f64; 3], s: &Sighting) -> Option<Residual> {
    let turned = mat_vec(&view.pose.rotation, x);
    let seen = lens.project_by(std::array::from_fn(|k| turned[k] + view.pose.translation[k]))?;
    let error = std::array::from_fn(|a| seen.pixel[a] - s.pixel[a] - s.velocity[a] * view.tau);
    let by_camera = std::array::from_fn(|a| {
        let d = seen.by_place[a];
        let turn = cross(turned, d);
        let center = [f64::from(u8::from(a == 0)), f64::from(u8::from(a == 1))];
        let [zoom, bend] = seen.by_lens[a];
        [turn[0], turn[1], turn[2], d[0], d[1], d[2], -s.velocity[a], zoom, bend, center[0], center[1]]
    });
    let r = &view.pose.rotation;
    let by_point = std::array::from_fn(|a| {
        let d = seen.by_place[a];
        std::array::from_fn(|k| d[0] * r[0][k] + d[1] * r[1][k] + d[2] * r[2][k])
    });
    Some(Residual { error, by_camera, by_point })
}

impl Bundle {
    /// Distance in pixels of a sighting from where its point is seen; infinite behind the camera.
    pub(crate) fn distance(&self, s: &Sighting) -> f64 {
        let view = &self.views[s.view];
        let place = view.pose.apply(self.points[s.point]);
        let off = |p: [f64; 2]| {
            (p[0] - s.pixel[0] - s.velocity[0] * view.tau).hypot(p[1] - s.pixel[1] - s.velocity[1] * view.tau)
        };
        self.lenses[view.lens].project(place).map_or(f64::INFINITY, off)
    }

    /// The mean of log f.
    fn mean_focal(&self) -> f64 {
        self.lenses.iter().map(|l| l.focal.ln()).sum::<f64>() / self.lenses.len().max(1) as f64
    }

    /// Half the sum of the robust squares.
    fn cost(&self, settings: &Settings) -> f64 {
        let of = |s: &Sighting| robust(self.distance(s).powi(2).min(BEHIND), settings.scale).0;
        let sums: Vec<f64> = self.sightings.par_chunks(1 << 12).map(|part| part.iter().map(of).sum()).collect();
        let mut sum: f64 = sums.iter().sum();
        for (lens, prior) in self.lenses.iter().zip(&settings.priors.lenses) {
            sum += 0.5 * known(lens, prior, settings).iter().map(|(off, weight)| weight * off * off).sum::<f64>();
        }
        let mean = self.mean_focal();
        let apart = |l: &Lens| ((l.focal.ln() - mean) / settings.priors.family).powi(2);
        sum += 0.5 * self.lenses.iter().map(apart).sum::<f64>();
        if settings.free.tau {
            sum += 0.5 * self.views.iter().map(|v| (v.tau / settings.priors.tau).powi(2)).sum::<f64>();
        }
        sum
    }
}

/// Deviation of a lens from its known values, and its weights.
fn known(lens: &Lens, prior: &Lens, settings: &Settings) -> [(f64, f64); LENS] {
    let p = &settings.priors;
    let weight = |deviation: f64| deviation.powi(-2);
    [
        ((lens.focal / prior.focal).ln(), weight(p.focal)),
        (lens.k1 - prior.k1, weight(p.k1)),
        (lens.center[0] - prior.center[0], weight(p.center)),
        (lens.center[1] - prior.center[1], weight(p.center)),
    ]
}

/// Half of Cauchy's loss of a squared distance, and the weight of its least squares.
fn robust(square: f64, scale: f64) -> (f64, f64) {
    if scale.is_finite() {
        let c = scale * scale;
        (0.5 * c * (square / c).ln_1p(), 1.0 / (1.0 + square / c))
    } else {
        (0.5 * square, 1.0)
    }
}

/// The normal equations: cameras' rows dense, points' blocks on the diagonal.
struct Normal {
    /// Rows of cameras: `POSE` for each view, then `LENS` for each lens.
    n: usize,
    /// Cameras' part, lower triangle, row-major.
    cameras: Vec<f64>,
    /// −gradient by cameras.
    right: Vec<f64>,
    /// For each point its block and −gradient.
    points: Vec<([[f64; 3]; 3], [f64; 3])>,
    /// For each sighting that counts its cross block.
    crossed: Vec<Option<Crossed>>,
    /// First sighting of each point, and the end.
    starts: Vec<usize>,
}

struct Crossed {
    rows: [usize; BOTH],
    block: [[f64; 3]; BOTH],
}

/// Rows of a view and of its lens.
fn rows(bundle: &Bundle, view: usize) -> [usize; BOTH] {
    let lens = POSE * bundle.views.len() + LENS * bundle.views[view].lens;
    std::array::from_fn(|k| if k < POSE { POSE * view + k } else { lens + k - POSE })
}

fn normal(bundle: &Bundle, settings: &Settings, gauge: &Gauge) -> Normal {
    let n = POSE * bundle.views.len() + LENS * bundle.lenses.len();
    let mut starts = vec![0; bundle.points.len() + 1];
    bundle.sightings.iter().for_each(|s| starts[s.point + 1] += 1);
    (0..bundle.points.len()).for_each(|p| starts[p + 1] += starts[p]);
    let mut out = Normal {
        n,
        cameras: vec![0.0; n * n],
        right: vec![0.0; n],
        points: vec![([[0.0; 3]; 3], [0.0; 3]); bundle.points.len()],
        crossed: Vec::new(),
        starts,
    };
    let of = |s: &Sighting| {
        let view = &bundle.views[s.view];
        let mut r = residual(view, &bundle.lenses[view.lens], bundle.points[s.point], s)?;
        let rows = rows(bundle, s.view);
        for a in 0..2 {
            (0..BOTH).filter(|&k| gauge.held[rows[k]]).for_each(|k| r.by_camera[a][k] = 0.0);
        }
        let square = r.error[0] * r.error[0] + r.error[1] * r.error[1];
        Some((rows, robust(square, settings.scale).1, r))
    };
    for s in &bundle.sightings {
        let Some((rows, weight, r)) = of(s) else {
            out.crossed.push(None);
            continue;
        };
        let mut block = [[0.0; 3]; BOTH];
        let (v, g) = &mut out.points[s.point];
        for a in 0..2 {
            let (j, d, e) = (&r.by_camera[a], &r.by_point[a], r.error[a]);
            for i in 0..BOTH {
                let by = weight * j[i];
                out.right[rows[i]] -= by * e;
                (0..=i).for_each(|k| out.cameras[rows[i] * n + rows[k]] += by * j[k]);
                (0..3).for_each(|k| block[i][k] += by * d[k]);
            }
            for i in 0..3 {
                (0..3).for_each(|k| v[i][k] += weight * d[i] * d[k]);
                g[i] -= weight * d[i] * e;
            }
        }
        out.crossed.push(Some(Crossed { rows, block }));
    }
    let first = POSE * bundle.views.len();
    for (l, (lens, prior)) in bundle.lenses.iter().zip(&settings.priors.lenses).enumerate() {
        for (k, (off, weight)) in known(lens, prior, settings).into_iter().enumerate() {
            let row = first + LENS * l + k;
            if !gauge.held[row] {
                out.cameras[row * n + row] += weight;
                out.right[row] -= weight * off;
            }
        }
    }
    if settings.free.focal && settings.priors.family.is_finite() {
        let (weight, mean, count) = (settings.priors.family.powi(-2), bundle.mean_focal(), bundle.lenses.len());
        for (l, lens) in bundle.lenses.iter().enumerate() {
            let row = first + LENS * l;
            out.right[row] -= weight * (lens.focal.ln() - mean);
            for other in 0..=l {
                let own = f64::from(u8::from(other == l));
                out.cameras[row * n + first + LENS * other] += weight * (own - 1.0 / count as f64);
            }
        }
    }
    if settings.free.tau {
        let weight = settings.priors.tau.powi(-2);
        for (k, view) in bundle.views.iter().enumerate() {
            let row = POSE * k + POSE - 1;
            if !gauge.held[row] {
                out.cameras[row * n + row] += weight;
                out.right[row] -= weight * view.tau;
            }
        }
    }
    out
}

impl Normal {
    /// The step of cameras and of points at this damping; `None`: the system is not positive.
    fn step(&self, damping: f64, held: &[bool]) -> Option<(Vec<f64>, Vec<[f64; 3]>)> {
        let n = self.n;
        let damped = |p: usize| {
            let mut v = self.points[p].0;
            (0..3).for_each(|k| v[k][k] += damping * v[k][k]);
            v
        };
        // V⁻¹ of every point; points that no camera sees stay.
        let inverse: Vec<Option<[[f64; 3]; 3]>> =
            (0..self.points.len()).into_par_iter().map(|p| invert(&damped(p))).collect();
        let count = self.points.len();
        let part = |k: usize| {
            let (mut s, mut b) = (vec![0.0; n * n], vec![0.0; n]);
            for p in k * count / PARTS..(k + 1) * count / PARTS {
                let Some(inverse) = &inverse[p] else { continue };
                let g = mat_vec(inverse, self.points[p].1);
                let seen = &self.crossed[self.starts[p]..self.starts[p + 1]];
                for (i, one) in seen.iter().enumerate() {
                    let Some(one) = one else { continue };
                    // W V⁻¹, whose products with Wᵀ of this and of earlier sightings are what the point takes away.
                    let left = one.block.map(|w| mat_vec(inverse, w));
                    for a in 0..BOTH {
                        b[one.rows[a]] += (0..3).map(|k| one.block[a][k] * g[k]).sum::<f64>();
                    }
                    for (j, other) in seen[..=i].iter().enumerate() {
                        let Some(other) = other else { continue };
                        for a in 0..BOTH {
                            for c in 0..BOTH {
                                let (row, column) = (one.rows[a], other.rows[c]);
                                let v = left[a][0] * other.block[c][0]
                                    + left[a][1] * other.block[c][1]
                                    + left[a][2] * other.block[c][2];
                                if j == i {
                                    if column <= row {
                                        s[row * n + column] += v;
                                    }
                                } else if column < row {
                                    s[row * n + column] += v;
                                } else if column > row {
                                    s[column * n + row] += v;
                                } else {
                                    // A shared lens: both orders of the two sightings meet on the diagonal.
                                    s[row * n + row] += 2.0 * v;
                                }
                            }
                        }
                    }
                }
            }
            (s, b)
        };
        let parts: Vec<(Vec<f64>, Vec<f64>)> = (0..PARTS).into_par_iter().map(part).collect();
        let (mut a, mut right) = (self.cameras.clone(), self.right.clone());
        for k in 0..n {
            a[k * n + k] += damping * self.cameras[k * n + k];
        }
        for (s, b) in &parts {
            a.iter_mut().zip(s).for_each(|(x, y)| *x -= y);
            right.iter_mut().zip(b).for_each(|(x, y)| *x -= y);
        }
        for k in 0..n {
            // Fixed points, and those that no camera sees.
            if held[k] || self.cameras[k * n + k] == 0.0 {
                (0..k).for_each(|j| a[k * n + j] = 0.0);
                (k + 1..n).for_each(|i| a[i * n + k] = 0.0);
                a[k * n + k] = 1.0;
                right[k] = 0.0;
            }
        }
        let cameras = Cholesky::new(n, a)?.solve(right);
        let point = |p: usize| {
            let Some(inverse) = &inverse[p] else { return [0.0; 3] };
            let mut g = self.points[p].1;
            for c in self.crossed[self.starts[p]..self.starts[p + 1]].iter().flatten() {
                for a in 0..BOTH {
                    (0..3).for_each(|k| g[k] -= c.block[a][k] * cameras[c.rows[a]]);
                }
            }
            mat_vec(inverse, g)
        };
        let points = (0..count).into_par_iter().map(point).collect();
        Some((cameras, points))
    }
}

/// The inverse of a symmetric matrix; nothing where it is singular.
fn invert(m: &[[f64; 3]; 3]) -> Option<[[f64; 3]; 3]> {
    let column = |k: usize| mat3::solve(*m, std::array::from_fn(|i| f64::from(u8::from(i == k))));
    Some([column(0)?, column(1)?, column(2)?])
}

/// Fixed numbers: those that are not free, and the gauge (position, orientation and scale of the world).
struct Gauge {
    held: Vec<bool>,
}

impl Gauge {
    /// The first view stays, and of the view that is farthest from it the translation along the line between them.
    fn new(bundle: &Bundle, free: Free, exact: &[bool]) -> Self {
        let views = bundle.views.len();
        let mut held = vec![false; POSE * views + LENS * bundle.lenses.len()];
        if views > 0 {
            held[..POSE - 1].fill(true);
            let first = bundle.views[0].pose.inverse().translation;
            // The first camera's position relative to the others: scaling moves them along this.
            let apart = |v: usize| bundle.views[v].pose.apply(first);
            let size = |v: usize| apart(v).iter().map(|x| x * x).sum::<f64>();
            let far = (1..views).fold(0, |best, v| if size(v) > size(best) { v } else { best });
            let along = apart(far);
            let axis = (1..3).fold(0, |best, k| if along[k].abs() > along[best].abs() { k } else { best });
            held[POSE * far + 3 + axis] = true;
        }
        for v in 0..views {
            if !free.pose {
                held[POSE * v..POSE * (v + 1) - 1].fill(true);
            }
            held[POSE * v + POSE - 1] |= !free.tau;
        }
        for l in 0..bundle.lenses.len() {
            let row = POSE * views + LENS * l;
            let stays = exact.get(l) == Some(&true);
            held[row] = stays || !free.focal;
            held[row + 1] = stays || !free.k1;
            held[row + 2] = stays || !free.center;
            held[row + 3] = stays || !free.center;
        }
        Self { held }
    }
}

fn moved(bundle: &Bundle, cameras: &[f64], points: &[[f64; 3]], held: &[bool]) -> Bundle {
    let mut out = bundle.clone();
    for (view, s) in out.views.iter_mut().zip(cameras.chunks(POSE)) {
        if s[..3] != [0.0; 3] {
            view.pose.rotation = orthonormal(&mat_mul(&rotation([s[0], s[1], s[2]]), &view.pose.rotation));
        }
        (0..3).for_each(|k| view.pose.translation[k] += s[3 + k]);
        view.tau += s[6];
    }
    let first = POSE * bundle.views.len();
    for (l, (lens, s)) in out.lenses.iter_mut().zip(cameras[first..].chunks(LENS)).enumerate() {
        if !held[first + LENS * l] {
            lens.focal *= s[0].clamp(-1.0, 1.0).exp();
        }
        lens.k1 += s[1];
        lens.center[0] += s[2];
        lens.center[1] += s[3];
    }
    out.points.iter_mut().zip(points).for_each(|(x, s)| (0..3).for_each(|k| x[k] += s[k]));
    out
}

/// Adjusts a bundle in place.
///
/// The first view's pose stays, and one number of another's translation: they fix position, direction and size of the
/// world.
pub(crate) fn adjust(bundle: &mut Bundle, settings: &Settings) -> Report {
    assert!(bundle.sightings.is_sorted_by_key(|s| s.point), "sightings are ordered by their points");
    assert_eq!(settings.priors.lenses.len(), bundle.lenses.len(), "every lens has its prior");
    /// Marquardt's λ: where it starts, how it grows and shrinks, and where nothing helps any more.
    const START: f64 = 1e-4;
    const GROW: f64 = 10.0;
    const SHRINK: f64 = 0.2;
    const LEAST: f64 = 1e-14;
    const LARGEST: f64 = 1e8;
    let gauge = Gauge::new(bundle, settings.free, &settings.exact);
    let before = bundle.cost(settings);
    let mut cost = before;
    let mut damping = START;
    let mut steps = 0;
    'outer: while steps < settings.steps {
        let normal = normal(bundle, settings, &gauge);
        loop {
            steps += 1;
            let next = normal.step(damping, &gauge.held).map(|(c, p)| moved(bundle, &c, &p, &gauge.held));
            let now = next.as_ref().map_or(f64::INFINITY, |b| b.cost(settings));
            if now < cost {
                let gained = (cost - now) / cost;
                *bundle = next.expect("what has a cost is there");
                cost = now;
                damping = (damping * SHRINK).max(LEAST);
                if gained < settings.gain {
                    break 'outer;
                }
                break;
            }
            damping *= GROW;
            if damping > LARGEST || steps >= settings.steps {
                break 'outer;
            }
        }
    }
    Report { before, after: cost, steps }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::align::{similarity, turn_between};
    use splat4d::math::se3::{norm, sub};
    use splat4d::math::{Rng, Sim3};

    const ALL: Free = Free { pose: true, focal: true, k1: true, center: true, tau: true };

    /// Cameras around points, some of which move; everything seen exactly.
    fn ring(views: usize, shared: bool) -> Bundle {
        let rng = Rng::new(9, "ring", 0);
        let mut bundle = Bundle::default();
        for v in 0..views {
            let angle = 0.35 * v as f64;
            let eye = [4.0 * angle.sin(), 0.5 * rng.normal(v as u64), -4.0 * angle.cos()];
            let pose = Se3::look_at(eye, [0.0; 3], [0.0, -1.0, 0.0]);
            let lens = if shared { 0 } else { v };
            if lens == bundle.lenses.len() {
                let off = |k: u64| 3.0 * rng.normal(50 + 3 * v as u64 + k);
                let focal = 400.0 * (0.1 * rng.normal(20 + v as u64)).exp();
                bundle.lenses.push(Lens { focal, k1: 0.01 * off(2), center: [320.0 + off(0), 180.0 + off(1)] });
            }
            bundle.views.push(View { pose, lens, tau: 0.02 * rng.normal(40 + v as u64) });
        }
        for p in 0..60 {
            let x: [f64; 3] = std::array::from_fn(|k| 0.8 * rng.normal((200 + 3 * p + k) as u64));
            let moving = p % 3 > 0;
            let speed: [f64; 3] =
                std::array::from_fn(|k| if moving { rng.normal((500 + 3 * p + k) as u64) } else { 0.0 });
            bundle.points.push(x);
            for (v, view) in bundle.views.iter().enumerate() {
                let lens = &bundle.lenses[view.lens];
                let at = |t: f64| lens.project(view.pose.apply(std::array::from_fn(|k| x[k] + t * speed[k]))).unwrap();
                let h = 1e-5;
                let (here, after, ago) = (at(0.0), at(h), at(-h));
                let velocity: [f64; 2] = std::array::from_fn(|k| (after[k] - ago[k]) / (2.0 * h));
                // Seen τ ago, moving evenly in the image.
                let pixel = std::array::from_fn(|k| here[k] - velocity[k] * view.tau);
                bundle.sightings.push(Sighting { view: v, point: p, pixel, velocity });
            }
        }
        bundle
    }

    fn disturbed(truth: &Bundle, by: f64) -> Bundle {
        let rng = Rng::new(10, "disturbed", 0);
        let mut out = truth.clone();
        for (v, view) in out.views.iter_mut().enumerate() {
            let draw = |k: usize| by * rng.normal((10 * v + k) as u64);
            let turn = rotation([draw(0), draw(1), draw(2)]);
            view.pose.rotation = mat_mul(&turn, &view.pose.rotation);
            (0..3).for_each(|k| view.pose.translation[k] += 4.0 * draw(3 + k));
            view.tau = 0.0;
        }
        for (l, lens) in out.lenses.iter_mut().enumerate() {
            lens.focal *= (2.0 * by * rng.normal(1000 + l as u64)).exp();
            lens.k1 = 0.0;
            lens.center = [320.0, 180.0];
        }
        for (p, x) in out.points.iter_mut().enumerate() {
            (0..3).for_each(|k| x[k] += 4.0 * by * rng.normal((2000 + 3 * p + k) as u64));
        }
        out
    }

    fn settings(lenses: &[Lens], free: Free) -> Settings {
        Settings { scale: f64::INFINITY, free, exact: Vec::new(), priors: Priors::none(lenses), steps: 100, gain: 0.0 }
    }

    /// Largest differences of rotations (radians) and of centres after the best similarity, of focal lengths (relative)
    /// and of clocks from each other (seconds).
    fn apart(a: &Bundle, b: &Bundle) -> [f64; 4] {
        let poses = |b: &Bundle| b.views.iter().map(|v| v.pose).collect::<Vec<_>>();
        let (from, to) = (poses(a), poses(b));
        let centers = |p: &[Se3]| p.iter().map(|q| q.inverse().translation).collect::<Vec<_>>();
        let s: Sim3 = similarity(&centers(&from), &centers(&to)).unwrap();
        let largest = |it: &mut dyn Iterator<Item = f64>| it.fold(0.0, f64::max);
        let turned = |p: &Se3| mat_mul(&p.rotation, &splat4d::math::se3::transpose(&s.rotation));
        let clock = |b: &Bundle, v: usize| b.views[v].tau - b.views[0].tau;
        [
            largest(&mut from.iter().zip(&to).map(|(p, q)| turn_between(&turned(p), &q.rotation))),
            largest(&mut centers(&from).iter().zip(&centers(&to)).map(|(p, q)| norm(sub(s.apply(*p), *q)))),
            largest(&mut a.lenses.iter().zip(&b.lenses).map(|(p, q)| (p.focal / q.focal - 1.0).abs())),
            largest(&mut (0..a.views.len()).map(|v| (clock(a, v) - clock(b, v)).abs())),
        ]
    }

    #[test]
    fn derivatives_equal_finite_differences() {
        let bundle = disturbed(&ring(3, false), 0.01);
        let h = 1e-6;
        for s in bundle.sightings.iter().step_by(7) {
            let (view, x) = (bundle.views[s.view], bundle.points[s.point]);
            let lens = bundle.lenses[view.lens];
            let here = residual(&view, &lens, x, s).unwrap();
            let at = |k: usize, by: f64| {
                let (mut view, mut lens, mut x) = (view, lens, x);
                match k {
                    0..3 => {
                        let mut w = [0.0; 3];
                        w[k] = by;
                        view.pose.rotation = mat_mul(&rotation(w), &view.pose.rotation);
                    }
                    3..6 => view.pose.translation[k - 3] += by,
                    6 => view.tau += by,
                    7 => lens.focal *= by.exp(),
                    8 => lens.k1 += by,
                    9..11 => lens.center[k - 9] += by,
                    _ => x[k - 11] += by,
                }
                residual(&view, &lens, x, s).unwrap().error
            };
            for k in 0..BOTH + 3 {
                for a in 0..2 {
                    let slope = (at(k, h)[a] - at(k, -h)[a]) / (2.0 * h);
                    let told = if k < BOTH { here.by_camera[a][k] } else { here.by_point[a][k - BOTH] };
                    assert!((slope - told).abs() < 1e-5 * (1.0 + told.abs()), "number {k}: {slope} {told}");
                }
            }
        }
    }

    #[test]
    fn exact_sightings_are_solved_to_nine_digits() {
        for shared in [false, true] {
            let truth = ring(6, shared);
            let mut bundle = disturbed(&truth, 0.01);
            // One clock is known; the others follow.
            let report = adjust(&mut bundle, &settings(&truth.lenses, ALL));
            assert!(report.after < 1e-16 * report.before, "{report:?}");
            let [turn, center, focal, clock] = apart(&bundle, &truth);
            assert!(turn < 1e-9 && center < 1e-8 && focal < 1e-9, "{turn:e} {center:e} {focal:e}");
            assert!(clock < 1e-8, "{clock:e}");
        }
    }

    #[test]
    fn the_result_does_not_depend_on_the_world_frame() {
        let truth = ring(5, false);
        let free = Free { tau: false, ..ALL };
        let mut noisy = truth.clone();
        let rng = Rng::new(11, "noise", 0);
        for (k, s) in noisy.sightings.iter_mut().enumerate() {
            s.velocity = [0.0; 2];
            let view = &truth.views[s.view];
            let exact = truth.lenses[view.lens].project(view.pose.apply(truth.points[s.point])).unwrap();
            s.pixel = std::array::from_fn(|a| exact[a] + 0.5 * rng.normal((2 * k + a) as u64));
        }
        let noisy = disturbed(&noisy, 0.005);
        let how = Settings {
            scale: 1.0,
            priors: Priors { focal: 0.3, k1: 0.03, center: 6.0, ..Priors::none(&truth.lenses) },
            gain: 1e-14,
            ..settings(&truth.lenses, free)
        };
        let mut one = noisy.clone();
        let first = adjust(&mut one, &how);
        // Turned, moved and a thousand times larger.
        let turn = rotation([0.3, -1.2, 0.7]);
        let mut other = noisy.clone();
        let place = |x: [f64; 3]| {
            let r = mat_vec(&turn, x);
            [1e3 * r[0] + 50.0, 1e3 * r[1] - 9.0, 1e3 * r[2] + 700.0]
        };
        other.points.iter_mut().for_each(|x| *x = place(*x));
        for view in &mut other.views {
            let center = place(view.pose.inverse().translation);
            let rotation = mat_mul(&view.pose.rotation, &splat4d::math::se3::transpose(&turn));
            let translation = mat_vec(&rotation, center).map(|v| -v);
            view.pose = Se3 { rotation, translation };
        }
        let second = adjust(&mut other, &how);
        assert!((first.after / second.after - 1.0).abs() < 1e-9, "{first:?} {second:?}");
        let [turn, center, focal, _] = apart(&other, &one);
        assert!(turn < 1e-6 && center < 1e-5 && focal < 1e-6, "{turn:e} {center:e} {focal:e}");
    }

    #[test]
    fn lenses_of_one_model_are_alike_and_their_mean_is_free() {
        let mut truth = ring(6, false);
        truth.lenses.iter_mut().for_each(|l| l.focal = 410.0);
        let rng = Rng::new(12, "noise", 0);
        for (k, s) in truth.sightings.iter_mut().enumerate() {
            let view = &truth.views[s.view];
            let exact = truth.lenses[view.lens].project(view.pose.apply(truth.points[s.point])).unwrap();
            s.velocity = [0.0; 2];
            s.pixel = std::array::from_fn(|a| exact[a] + 0.5 * rng.normal((2 * k + a) as u64));
        }
        let mut bundle = disturbed(&truth, 0.005);
        bundle.lenses.iter_mut().for_each(|l| l.focal *= 0.9);
        let priors = Priors { family: 1e-5, k1: 0.03, center: 2.0, ..Priors::none(&truth.lenses) };
        adjust(&mut bundle, &Settings { priors, ..settings(&truth.lenses, Free { tau: false, ..ALL }) });
        let first = bundle.lenses[0].focal;
        assert!(bundle.lenses.iter().all(|l| (l.focal / first - 1.0).abs() < 1e-3), "{:?}", bundle.lenses);
        assert!((first / 410.0 - 1.0).abs() < 0.02, "{first}");
    }

    #[test]
    fn wrong_sightings_hardly_count() {
        let truth = ring(6, true);
        let mut bundle = disturbed(&truth, 0.003);
        for s in bundle.sightings.iter_mut().step_by(9) {
            s.pixel[0] += 60.0;
        }
        let how = Settings { scale: 1.0, ..settings(&truth.lenses, ALL) };
        adjust(&mut bundle, &how);
        let [turn, center, focal, clock] = apart(&bundle, &truth);
        assert!(
            turn < 1e-3 && center < 1e-2 && focal < 2e-3 && clock < 2e-3,
            "{turn:e} {center:e} {focal:e} {clock:e}"
        );
    }
}
