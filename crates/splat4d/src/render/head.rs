//! The feature head, pixel by pixel: nine blended channels and the pixel's ray become colour.
//!
//! With the blended base colour b (over the background), the blended view features f and time features g, the camera's
//! centre o and the pixel's direction r (unit, world axes), colour = σ(logit b + W₂ relu(W₁ [f, g, o/(1 + ‖o‖), r])),
//! W₁ 6x12, W₂ 3x6, no biases. Where W₂ is zero, which is the start, colours are those of a scene without a head.
//!
//! Source: Li et al. 2024 (Spacetime Gaussians) §4.1. Ours: theirs blends logits, ours blends colours and takes the
//! logit of the output, so that the head starts as the identity, transparency mixes colours as everywhere else, and the
//! background needs no logit; and origins are squashed, so that the unit of length matters little.

use super::simd::{Kernel, Simd, dispatch, select};
use super::{Image, RenderGrads, Renderer, Shot};
use crate::math::{Real, se3};
use crate::scene::head::{BASE, FEATURES, FURTHER, HIDDEN, INPUTS};
use crate::scene::{BLOCK, Camera, Color, HeadGrads, HeadWeights, Planes, Splats, Table};
use crate::simd::each;
use rayon::prelude::*;

/// Logits are straight lines beyond this distance from 0 and 1: one step of 8 bits. An image can then be white, and
/// has a
/// gradient even there.
pub(super) const NEAREST: f64 = 1.0 / 255.0;
/// Rows of pixels that are one task; sums over tasks are made in their order.
const TASK_ROWS: usize = 8;
/// First input of the ray's origin, and of its direction.
const ORIGIN: usize = FURTHER;
const DIRECTION: usize = FURTHER + 3;
/// Sums over pixels: W₁ without the origin's columns, what reaches the hidden layer, W₂, the turn of the rays.
const SUMS: usize = HIDDEN * (FURTHER + 3) + HIDDEN + 3 * HIDDEN + 3;

type Lane<F> = [F; BLOCK];

/// Record of an image with a head for its backward pass; all memory is reused.
#[derive(Debug, Default)]
pub(super) struct Headed<F> {
    /// Further channels of every splat, the head's and then the caller's, [splats, 6 + C].
    pub table: Table<F>,
    /// Blended base colours, [3, h, w].
    base: Planes<F>,
    /// Blended further channels of the head, [6, h, w].
    further: Planes<F>,
    d_base: Planes<F>,
    /// To [`Self::table`].
    d_table: Option<Table<F>>,
    /// To the blended further channels, the caller's included, [6 + C, h, w].
    d_further: Planes<F>,
}

impl<F: Real> Headed<F> {
    /// Fills [`Self::table`].
    pub(crate) fn gather(&mut self, splats: &Splats<'_, F>, extra: Option<&Table<F>>) {
        let width = FURTHER + extra.map_or(0, Table::width);
        if self.table.width() != width {
            self.table = Table::new(&[("further", FURTHER), ("extra", width - FURTHER)], 0);
        }
        self.table.resize(splats.len());
        let mut first = 0;
        for part in &splats.parts {
            let own = features_of(&part.color);
            for j in 0..part.out.rows() {
                self.table.write(first + j, 0, own.map_or([F::ZERO; FURTHER], |t| t.read(j, BASE)));
            }
            first += part.out.rows();
        }
        for c in 0..width - FURTHER {
            let extra = extra.expect("only it makes the table wider");
            (0..extra.rows()).for_each(|j| self.table.set(j, FURTHER + c, extra.get(j, c)));
        }
    }

    /// Turns blended channels into colour: `image.extra` gives up the head's further channels.
    pub(super) fn forward(&mut self, head: HeadWeights<'_, F>, camera: &Camera, simd: Simd, image: &mut Image<F>) {
        let (h, w) = (image.color.height, image.color.width);
        self.base.clone_from(&image.color);
        let further = &mut self.further;
        (further.channels, further.height, further.width) = (FURTHER, h, w);
        further.data.clear();
        further.data.extend(image.extra.data.drain(..FURTHER * h * w));
        image.extra.channels -= FURTHER;
        let net = Net::new(head, camera);
        let chunk = TASK_ROWS * w.max(1);
        by_task(&mut image.color, chunk).into_par_iter().enumerate().for_each(|(task, color)| {
            let further = each(|c| part(self.further.plane(c), task, chunk));
            let [r, g, b] = color.try_into().unwrap_or_else(|_| unreachable!("an image has three channels"));
            dispatch(simd, Forward { net: &net, width: w, row: task * TASK_ROWS, further, color: [r, g, b] });
        });
    }

    /// The VJP of [`forward`](Self::forward): fills the gradients to base colours and further channels (`d_extra` is
    /// the caller's part of them) and returns those of the weights and, to a left perturbation, of the pose.
    pub(crate) fn backward(
        &mut self,
        head: HeadWeights<'_, F>,
        camera: &Camera,
        simd: Simd,
        d_color: &Planes<F>,
        d_extra: Option<&Planes<F>>,
    ) -> (HeadGrads<F>, [f64; 6]) {
        let (h, w) = (d_color.height, d_color.width);
        self.d_base.reset(BASE, h, w);
        self.d_further.reset(self.table.width(), h, w);
        if let Some(d) = d_extra {
            self.d_further.data[FURTHER * h * w..].copy_from_slice(&d.data);
        }
        let net = Net::new(head, camera);
        let chunk = TASK_ROWS * w.max(1);
        let tasks = by_task(&mut self.d_base, chunk).into_iter().zip(by_task(&mut self.d_further, chunk));
        let (base, further) = (&self.base, &self.further);
        let parts: Vec<[f64; SUMS]> = tasks
            .collect::<Vec<_>>()
            .into_par_iter()
            .enumerate()
            .map(|(task, (d_base, d_further))| {
                let work = Backward {
                    net: &net,
                    width: w,
                    row: task * TASK_ROWS,
                    base: each(|c| part(base.plane(c), task, chunk)),
                    further: each(|c| part(further.plane(c), task, chunk)),
                    d_color: each(|c| part(d_color.plane(c), task, chunk)),
                    d_base,
                    d_further,
                };
                dispatch(simd, work)
            })
            .collect();
        let mut sums = [0.0; SUMS];
        for part in &parts {
            sums.iter_mut().zip(part).for_each(|(sum, x)| *sum += x);
        }
        net.collect(camera, &sums)
    }
}

impl<F: Real> Renderer<F> {
    /// The backward pass of an image that a head made; see [`Renderer::backward`].
    pub(super) fn backward_headed(
        &mut self,
        head: HeadWeights<'_, F>,
        shot: &Shot<'_, F>,
        grads: &super::ImageGrads<'_, F>,
        d_sh: &mut [Option<&mut Table<F>>],
        d: &mut RenderGrads<F>,
    ) {
        let mut clock = super::Clock::start();
        let mut headed = std::mem::take(&mut self.headed);
        let (d_head, pose) = headed.backward(head, shot.camera, self.config.simd, grads.color, grads.extra);
        let seconds = clock.lap();
        let inner = super::ImageGrads { color: &headed.d_base, extra: Some(&headed.d_further), ..*grads };
        d.extra = headed.d_table.take();
        self.backward_blended(&Shot { extra: Some(&headed.table), ..*shot }, &inner, d_sh, d);
        self.seconds.blend_backward += seconds;
        d.camera.iter_mut().zip(pose).for_each(|(d, pose)| *d += pose);
        d.head = Some(d_head);
        let table = d.extra.take().expect("further channels were drawn");
        let mut first = 0;
        for (part, grads) in shot.splats.parts.iter().zip(&mut d.parts) {
            if let (Some(_), Some(color)) = (features_of(&part.color), &mut grads.color) {
                (0..part.out.rows()).for_each(|j| color.write(j, BASE, table.read::<FURTHER>(first + j, 0)));
            }
            first += part.out.rows();
        }
        d.extra = shot.extra.map(|like| {
            let mut own = Table::with_columns(like.columns().to_vec(), like.rows());
            for c in 0..like.width() {
                (0..like.rows()).for_each(|j| own.set(j, c, table.get(j, FURTHER + c)));
            }
            own
        });
        headed.d_table = Some(table);
        self.headed = headed;
    }
}

/// The table of a part that has features.
pub(super) fn features_of<'a, F: Real>(color: &Color<'a, F>) -> Option<&'a Table<F>> {
    match color {
        Color::Direct { table } if table.width() == FEATURES => Some(table),
        _ => None,
    }
}

/// The slice of every plane that a task has, by task.
fn by_task<F: Real>(planes: &mut Planes<F>, chunk: usize) -> Vec<Vec<&mut [F]>> {
    let pixels = planes.pixels();
    let mut out: Vec<Vec<&mut [F]>> = (0..pixels.div_ceil(chunk)).map(|_| Vec::new()).collect();
    for plane in planes.data.chunks_exact_mut(pixels.max(1)) {
        out.iter_mut().zip(plane.chunks_mut(chunk)).for_each(|(task, slice)| task.push(slice));
    }
    out
}

fn part<F>(plane: &[F], task: usize, chunk: usize) -> &[F] {
    &plane[task * chunk..plane.len().min((task + 1) * chunk)]
}

/// The network with what is the same for all pixels of an image.
struct Net<F> {
    first: [[F; INPUTS]; HIDDEN],
    second: [[F; HIDDEN]; 3],
    /// W₁'s columns of the origin times the origin.
    bias: [F; HIDDEN],
    /// Direction of the first pixel, and its change from a pixel to the next one and from a row to the next, depth 1.
    corner: [F; 3],
    across: [F; 3],
    down: [F; 3],
    /// The squashed origin.
    origin: [f64; 3],
}

impl<F: Real> Net<F> {
    fn new(head: HeadWeights<'_, F>, camera: &Camera) -> Self {
        let (o, k) = (camera.center(), &camera.intrinsics);
        let r = &camera.cam_from_world.rotation;
        let (across, down) = (r[0].map(|x| x / k.fx), r[1].map(|x| x / k.fy));
        let corner = each(|c| r[2][c] + (0.5 - k.cx) * across[c] + (0.5 - k.cy) * down[c]);
        let origin = o.map(|x| x / (1.0 + se3::norm(o)));
        let first: [[F; INPUTS]; HIDDEN] = each(|h| each(|i| head.first[h * INPUTS + i]));
        let bias = each(|h| F::of((0..3).map(|c| first[h][ORIGIN + c].f64() * origin[c]).sum()));
        Self {
            first,
            second: each(|c| each(|h| head.second[c * HIDDEN + h])),
            bias,
            corner: corner.map(F::of),
            across: across.map(F::of),
            down: down.map(F::of),
            origin,
        }
    }

    /// Unit directions of sixteen pixels of a row.
    #[inline(always)]
    fn directions(&self, x: usize, y: usize) -> [Lane<F>; 3] {
        let (x, y) = (F::of(x as f64), F::of(y as f64));
        let mut d = [[F::ZERO; BLOCK]; 3];
        for c in 0..3 {
            let start = self.corner[c] + y * self.down[c];
            for l in 0..BLOCK {
                d[c][l] = start + (x + F::of(l as f64)) * self.across[c];
            }
        }
        for l in 0..BLOCK {
            let inverse = F::ONE / (d[0][l] * d[0][l] + d[1][l] * d[1][l] + d[2][l] * d[2][l]).sqrt();
            for c in 0..3 {
                d[c][l] *= inverse;
            }
        }
        d
    }

    /// The hidden layer and what is added to logits.
    #[inline(always)]
    fn run(&self, further: &[Lane<F>; FURTHER], direction: &[Lane<F>; 3]) -> ([Lane<F>; HIDDEN], [Lane<F>; 3]) {
        let mut hidden = [[F::ZERO; BLOCK]; HIDDEN];
        for (h, row) in hidden.iter_mut().enumerate() {
            *row = [self.bias[h]; BLOCK];
            for i in 0..FURTHER {
                for l in 0..BLOCK {
                    row[l] += self.first[h][i] * further[i][l];
                }
            }
            for i in 0..3 {
                for l in 0..BLOCK {
                    row[l] += self.first[h][DIRECTION + i] * direction[i][l];
                }
            }
            for x in row {
                *x = select(*x > F::ZERO, *x, F::ZERO);
            }
        }
        let mut z = [[F::ZERO; BLOCK]; 3];
        for c in 0..3 {
            for h in 0..HIDDEN {
                for l in 0..BLOCK {
                    z[c][l] += self.second[c][h] * hidden[h][l];
                }
            }
        }
        (hidden, z)
    }

    /// Gradients to the weights and to the pose, from sums over all pixels.
    fn collect(&self, camera: &Camera, sums: &[f64; SUMS]) -> (HeadGrads<F>, [f64; 6]) {
        let (first, rest) = sums.split_at(HIDDEN * (FURTHER + 3));
        let (hidden, rest) = rest.split_at(HIDDEN);
        let (second, turn) = rest.split_at(3 * HIDDEN);
        let mut d =
            HeadGrads { first: vec![F::ZERO; HIDDEN * INPUTS], second: second.iter().map(|&x| F::of(x)).collect() };
        for h in 0..HIDDEN {
            let own = &first[h * (FURTHER + 3)..(h + 1) * (FURTHER + 3)];
            for i in 0..INPUTS {
                d.first[h * INPUTS + i] = F::of(match i {
                    0..ORIGIN => own[i],
                    ORIGIN..DIRECTION => hidden[h] * self.origin[i - ORIGIN],
                    _ => own[i - 3],
                });
            }
        }
        // s = o/(1 + n): ds = do/(1 + n) − o (o·do)/(n (1 + n)²). The centre moves by −Rᵀρ and does not turn.
        let (o, r) = (camera.center(), &camera.cam_from_world.rotation);
        let n = se3::norm(o);
        let d_s: [f64; 3] = each(|c| (0..HIDDEN).map(|h| hidden[h] * self.first[h][ORIGIN + c].f64()).sum());
        let along = if n > 0.0 { se3::dot(o, d_s) / (n * (1.0 + n) * (1.0 + n)) } else { 0.0 };
        let d_o: [f64; 3] = each(|c| d_s[c] / (1.0 + n) - o[c] * along);
        let apply = |v: [f64; 3]| -> [f64; 3] { each(|row| se3::dot(r[row], v)) };
        let (move_, turn) = (apply(d_o), apply([turn[0], turn[1], turn[2]]));
        (d, [-move_[0], -move_[1], -move_[2], turn[0], turn[1], turn[2]])
    }
}

/// σ(logit c + z), and 1/(c̄(1 − c̄)), the slope of the logit; c̄ is c kept within [`NEAREST`] of 0 and 1, beyond which
/// the logit continues as a straight line.
#[inline(always)]
fn shade<F: Real>(c: F, z: F) -> (F, F) {
    let (low, high) = (F::of(NEAREST), F::of(1.0 - NEAREST));
    let inner = select(c > low, c, low);
    let inner = select(inner < high, inner, high);
    let slope = F::ONE / (inner * (F::ONE - inner));
    let a = z + (c - inner) * slope;
    let e = (-a.abs()).exp();
    let (own, other) = (select(a > F::ZERO, F::ONE, e), select(a > F::ZERO, e, F::ONE));
    let (yes, no) = (inner * own, (F::ONE - inner) * other);
    (yes / (yes + no), slope)
}

/// Sixteen neighbouring numbers; zeros past the end.
#[inline(always)]
fn load<F: Real>(from: &[F], at: usize, count: usize) -> Lane<F> {
    if count == BLOCK {
        let mut out = [F::ZERO; BLOCK];
        out.copy_from_slice(&from[at..at + BLOCK]);
        return out;
    }
    let mut out = [F::ZERO; BLOCK];
    out[..count].copy_from_slice(&from[at..at + count]);
    out
}

struct Forward<'a, F> {
    net: &'a Net<F>,
    width: usize,
    row: usize,
    further: [&'a [F]; FURTHER],
    color: [&'a mut [F]; 3],
}

impl<F: Real> Kernel for Forward<'_, F> {
    type Out = ();
    #[inline(always)]
    fn run<const FMA: bool>(self) {
        for y in 0..self.color[0].len() / self.width.max(1) {
            for x in (0..self.width).step_by(BLOCK) {
                let (at, count) = (y * self.width + x, (self.width - x).min(BLOCK));
                let further: [Lane<F>; FURTHER] = each_lane(|i| load(self.further[i], at, count));
                let (_, z) = self.net.run(&further, &self.net.directions(x, self.row + y));
                for c in 0..3 {
                    let base = load(&*self.color[c], at, count);
                    let mut out = [F::ZERO; BLOCK];
                    for l in 0..BLOCK {
                        out[l] = shade(base[l], z[c][l]).0;
                    }
                    self.color[c][at..at + count].copy_from_slice(&out[..count]);
                }
            }
        }
    }
}

/// [`each`] for lanes.
#[inline(always)]
fn each_lane<F: Real, const N: usize>(f: impl Fn(usize) -> Lane<F>) -> [Lane<F>; N] {
    let mut out = [[F::ZERO; BLOCK]; N];
    for (i, out) in out.iter_mut().enumerate() {
        *out = f(i);
    }
    out
}

struct Backward<'a, F> {
    net: &'a Net<F>,
    width: usize,
    row: usize,
    base: [&'a [F]; 3],
    further: [&'a [F]; FURTHER],
    d_color: [&'a [F]; 3],
    d_base: Vec<&'a mut [F]>,
    d_further: Vec<&'a mut [F]>,
}

impl<F: Real> Kernel for Backward<'_, F> {
    type Out = [f64; SUMS];
    #[inline(always)]
    fn run<const FMA: bool>(mut self) -> [f64; SUMS] {
        let net = self.net;
        let mut first = [[[F::ZERO; BLOCK]; FURTHER + 3]; HIDDEN];
        let mut reach = [[F::ZERO; BLOCK]; HIDDEN];
        let mut second = [[[F::ZERO; BLOCK]; HIDDEN]; 3];
        let mut turn = [[F::ZERO; BLOCK]; 3];
        for y in 0..self.base[0].len() / self.width.max(1) {
            for x in (0..self.width).step_by(BLOCK) {
                let (at, count) = (y * self.width + x, (self.width - x).min(BLOCK));
                let further: [Lane<F>; FURTHER] = each_lane(|i| load(self.further[i], at, count));
                let direction = net.directions(x, self.row + y);
                let (hidden, z) = net.run(&further, &direction);
                let mut d_z = [[F::ZERO; BLOCK]; 3];
                for c in 0..3 {
                    let (base, d) = (load(self.base[c], at, count), load(self.d_color[c], at, count));
                    let mut d_base = [F::ZERO; BLOCK];
                    for l in 0..BLOCK {
                        let (color, slope) = shade(base[l], z[c][l]);
                        d_z[c][l] = d[l] * color * (F::ONE - color);
                        d_base[l] = d_z[c][l] * slope;
                    }
                    self.d_base[c][at..at + count].copy_from_slice(&d_base[..count]);
                }
                let mut d_further = [[F::ZERO; BLOCK]; FURTHER];
                let mut d_direction = [[F::ZERO; BLOCK]; 3];
                for h in 0..HIDDEN {
                    let mut d = [F::ZERO; BLOCK];
                    for c in 0..3 {
                        for l in 0..BLOCK {
                            second[c][h][l] += d_z[c][l] * hidden[h][l];
                            d[l] += d_z[c][l] * net.second[c][h];
                        }
                    }
                    for l in 0..BLOCK {
                        d[l] = select(hidden[h][l] > F::ZERO, d[l], F::ZERO);
                        reach[h][l] += d[l];
                    }
                    for i in 0..FURTHER {
                        for l in 0..BLOCK {
                            first[h][i][l] += d[l] * further[i][l];
                            d_further[i][l] += d[l] * net.first[h][i];
                        }
                    }
                    for i in 0..3 {
                        for l in 0..BLOCK {
                            first[h][FURTHER + i][l] += d[l] * direction[i][l];
                            d_direction[i][l] += d[l] * net.first[h][DIRECTION + i];
                        }
                    }
                }
                for i in 0..3 {
                    let (j, k) = ((i + 1) % 3, (i + 2) % 3);
                    for l in 0..BLOCK {
                        turn[i][l] += d_direction[j][l] * direction[k][l] - d_direction[k][l] * direction[j][l];
                    }
                }
                for i in 0..FURTHER {
                    self.d_further[i][at..at + count].copy_from_slice(&d_further[i][..count]);
                }
            }
        }
        let all = first.as_flattened().iter().chain(&reach).chain(second.as_flattened()).chain(&turn);
        let mut sums = [0.0; SUMS];
        for (sum, lane) in sums.iter_mut().zip(all) {
            *sum = lane.iter().map(|x| x.f64()).sum();
        }
        sums
    }
}
