//! [`Exposure`]: learnt colour matrices of the cameras, constant or changing over time.

use crate::capture::Capture;
use crate::optim::Moments;
use rayon::prelude::*;
use splat4d::math::Real;
use splat4d::scene::{Grads, Key, Params, Planes, Space, Time};
use splat4d::simd::{Kernel, Simd, dispatch, each};
use std::collections::BTreeSet;

/// Columns of a camera: its matrix without the identity, row by row, then an offset a channel.
pub(crate) const COLUMNS: usize = 12;
/// The first offset.
const OFFSET: usize = 9;
/// Pixels of a piece of parallel work: sums are per piece and in order, so that they do not depend on the threads.
const PIECE: usize = 8192;
/// Pixels that are computed together: a register of AVX-512.
const LANES: usize = 16;
/// Groups of [`LANES`] pixels after which a lane's sums in f32 are added to those in f64.
const RUN: usize = 32;

/// A colour matrix I + M and an offset c a camera: the colour x that is rendered is shown as (I + M)x + c. The mean
/// over the cameras is held at the identity, so that the scene keeps the rig's mean colours and held-out cameras are
/// rendered with them.
/// Source: FreeTimeGS++ 2026 (an affine colour correction a camera); the fixed mean is ours.
#[derive(Debug)]
pub struct Exposure {
    /// One table [cameras · times, 12], the times of a camera one after the other.
    pub(crate) params: Params<f32>,
    /// Its moments.
    pub(crate) moments: Moments<f32>,
    key: Key,
    pub(crate) grads: Grads<f32>,
    /// Rows that learn.
    trained: Vec<usize>,
    knots: Knots,
}

/// The times at which a camera's exposure is learnt; between two of them it changes linearly.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Knots {
    count: usize,
    /// Seconds of the first one and between two.
    first: f64,
    step: f64,
}

impl Knots {
    /// The same exposure at all times.
    const CONSTANT: Self = Self { count: 1, first: 0.0, step: 1.0 };

    /// The rows of a camera at a time, and their shares.
    fn at(&self, rig: usize, t: Time) -> [(usize, f32); 2] {
        let last = self.count - 1;
        let place = ((t.0 - self.first) / self.step).clamp(0.0, last as f64);
        let before = (place as usize).min(last.saturating_sub(1));
        let share = (place - before as f64) as f32;
        let row = rig * self.count + before;
        [(row, 1.0 - share), (rig * self.count + (before + 1).min(last), share)]
    }
}

/// (I + M)x + c.
fn shown<F: Real>(row: &[F; COLUMNS], x: [F; 3]) -> [F; 3] {
    std::array::from_fn(|c| x[c] + row[3 * c] * x[0] + row[3 * c + 1] * x[1] + row[3 * c + 2] * x[2] + row[OFFSET + c])
}

/// The VJP of [`shown`]: the gradients to x and to the row, of that to what is shown.
fn shown_backward<F: Real>(row: &[F; COLUMNS], x: [F; 3], d: [F; 3]) -> ([F; 3], [F; COLUMNS]) {
    let d_x = std::array::from_fn(|k| d[k] + row[k] * d[0] + row[3 + k] * d[1] + row[6 + k] * d[2]);
    let d_row = std::array::from_fn(|i| if i < OFFSET { d[i / 3] * x[i % 3] } else { d[i - OFFSET] });
    (d_x, d_row)
}

/// The three channels of an image, by pieces of their pixels.
fn pieces(picture: &mut Planes<f32>) -> impl IndexedParallelIterator<Item = [&mut [f32]; 3]> {
    assert_eq!(picture.channels, 3, "cameras show three colours");
    let pixels = picture.pixels();
    let (red, rest) = picture.data.split_at_mut(pixels);
    let (green, blue) = rest.split_at_mut(pixels);
    let cut = |plane| <[f32]>::par_chunks_mut(plane, PIECE);
    cut(red).zip(cut(green)).zip(cut(blue)).map(|((r, g), b)| [r, g, b])
}

/// Applies the exposure to a piece in place.
fn respond(row: &[f32; COLUMNS], [r, g, b]: [&mut [f32]; 3]) {
    for ((r, g), b) in r.iter_mut().zip(g).zip(b) {
        [*r, *g, *b] = shown(row, [*r, *g, *b]);
    }
}

/// The VJP of [`respond`] in a piece, in place. Returns the sum of the gradients to the row.
struct RespondBackward<'a> {
    row: &'a [f32; COLUMNS],
    drawn: [&'a [f32]; 3],
    d: [&'a mut [f32]; 3],
}

impl Kernel for RespondBackward<'_> {
    type Out = [f64; COLUMNS];

    #[inline(always)]
    fn run<const FMA: bool>(self) -> [f64; COLUMNS] {
        let Self { row, drawn, d } = self;
        let mut sums = [0.0; COLUMNS];
        let [(xr, xr_rest), (xg, xg_rest), (xb, xb_rest)] = drawn.map(<[f32]>::as_chunks::<LANES>);
        let [(r, r_rest), (g, g_rest), (b, b_rest)] = d.map(<[f32]>::as_chunks_mut::<LANES>);
        let x = xr.chunks(RUN).zip(xg.chunks(RUN)).zip(xb.chunks(RUN));
        let d = r.chunks_mut(RUN).zip(g.chunks_mut(RUN)).zip(b.chunks_mut(RUN));
        for (((r, g), b), ((xr, xg), xb)) in d.zip(x) {
            let mut lanes = [[0.0f32; LANES]; COLUMNS];
            for (((r, g), b), ((xr, xg), xb)) in r.iter_mut().zip(g).zip(b).zip(xr.iter().zip(xg).zip(xb)) {
                let (x, d) = ([*xr, *xg, *xb], [*r, *g, *b]);
                let to_drawn = |k: usize| -> [f32; LANES] {
                    let m = [row[k], row[3 + k], row[6 + k]];
                    each(|l| d[k][l] + m[0] * d[0][l] + m[1] * d[1][l] + m[2] * d[2][l])
                };
                [*r, *g, *b] = [to_drawn(0), to_drawn(1), to_drawn(2)];
                for i in 0..OFFSET {
                    lanes[i] = each(|l| lanes[i][l] + d[i / 3][l] * x[i % 3][l]);
                }
                for c in 0..3 {
                    lanes[OFFSET + c] = each(|l| lanes[OFFSET + c][l] + d[c][l]);
                }
            }
            (0..COLUMNS).for_each(|k| sums[k] += lanes[k].iter().map(|x| f64::from(*x)).sum::<f64>());
        }
        let x = xr_rest.iter().zip(xg_rest).zip(xb_rest);
        for (((r, g), b), ((xr, xg), xb)) in r_rest.iter_mut().zip(g_rest).zip(b_rest).zip(x) {
            let (d_x, d_row) = shown_backward(row, [*xr, *xg, *xb], [*r, *g, *b]);
            [*r, *g, *b] = d_x;
            (0..COLUMNS).for_each(|k| sums[k] += f64::from(d_row[k]));
        }
        sums
    }
}

/// Turns the colours that were rendered into those that a camera with this row shows.
pub(crate) fn expose(row: &[f32; COLUMNS], color: &mut Planes<f32>) {
    pieces(color).for_each(|colors| respond(row, colors));
}

impl Exposure {
    /// The identity for every camera; only the `trained` ones ever change.
    pub(crate) fn new(cameras: usize, trained: Vec<usize>) -> Self {
        let mut params = Params::new(0, 0, &[]);
        let key = params
            .entry("exposure", Space::Fixed, &[("exposure", COLUMNS)], cameras, |_| {})
            .expect("a new table fits itself");
        let (moments, grads) = (Moments::new(&params).rarely_used(), Grads::new(&params));
        Self { moments, grads, params, key, trained, knots: Knots::CONSTANT }
    }

    /// The same with `count` exposures of every camera, spread evenly over a time span.
    pub(crate) fn over_time(cameras: usize, trained: &[usize], count: usize, span: (f64, f64)) -> Self {
        let step = (span.1 - span.0) / count.saturating_sub(1).max(1) as f64;
        if count < 2 || step <= 0.0 {
            return Self::new(cameras, trained.to_vec());
        }
        let rows = trained.iter().flat_map(|rig| rig * count..(rig + 1) * count).collect();
        Self { knots: Knots { count, first: span.0, step }, ..Self::new(cameras * count, rows) }
    }

    /// Whether exposures change over time.
    pub(crate) fn changes(&self) -> bool {
        self.knots.count > 1
    }

    /// Those that a run has learnt, by the capture's frames. The training cameras go on.
    pub(crate) fn learnt(capture: &Capture, rows: &[[f32; COLUMNS]]) -> Self {
        let cameras = |frames: &[usize]| frames.iter().map(|&f| capture.frames[f].camera).collect::<BTreeSet<_>>();
        let mut out = Self::new(capture.cameras.len(), cameras(&capture.train).into_iter().collect());
        for &frame in &capture.train {
            out.params[out.key].write(capture.frames[frame].camera, 0, rows[frame]);
        }
        out
    }

    /// The table's key.
    pub(crate) fn key(&self) -> Key {
        self.key
    }

    /// The rows whose mean is held at the identity: a camera's number, if exposures do not change over time.
    pub(crate) fn trained(&self) -> &[usize] {
        &self.trained
    }

    /// Takes over the table and its moments from a device.
    pub(crate) fn take_over(&mut self, [params, moments]: &[Vec<f32>; 2]) {
        self.params[self.key].data_mut().copy_from_slice(params);
        self.moments.table_mut(self.key).data_mut().copy_from_slice(moments);
    }

    /// Forgets what the last views gave.
    pub(crate) fn rest(&mut self) {
        self.grads.clear(&self.params);
    }

    /// The exposure of a camera at a time: its matrix without the identity, row by row, then its offsets.
    pub(crate) fn response(&self, rig: usize, t: Time) -> [f32; COLUMNS] {
        let table = &self.params[self.key];
        match self.knots.at(rig, t) {
            [(row, _), (_, 0.0)] => table.read::<COLUMNS>(row, 0),
            both => {
                let [a, b] = both.map(|(row, share)| table.read::<COLUMNS>(row, 0).map(|x| share * x));
                std::array::from_fn(|k| a[k] + b[k])
            }
        }
    }

    /// Adds to the gradient of a camera's rows at a time.
    pub(crate) fn add_gradient(&mut self, rig: usize, t: Time, d: &[f64; COLUMNS]) {
        for (row, share) in self.knots.at(rig, t).into_iter().filter(|(_, share)| *share > 0.0) {
            self.grads.of([self.key])[0].add(row, 0, d.map(|x| share * x as f32));
        }
    }

    /// Turns the colours `color` into those that camera `rig` shows at time `t`.
    pub(crate) fn respond(&self, rig: usize, t: Time, color: &mut Planes<f32>) {
        expose(&self.response(rig, t), color);
    }

    /// Writes the colours that camera `rig` shows at time `t` of what was rendered.
    pub(crate) fn show(&self, rig: usize, t: Time, drawn: &Planes<f32>, out: &mut Planes<f32>) {
        let row = self.response(rig, t);
        if (out.channels, out.height, out.width) != (drawn.channels, drawn.height, drawn.width) {
            out.reset(drawn.channels, drawn.height, drawn.width);
        }
        pieces(out).enumerate().for_each(|(piece, mut colors)| {
            for (c, out) in colors.iter_mut().enumerate() {
                let first = piece * PIECE;
                out.copy_from_slice(&drawn.plane(c)[first..first + out.len()]);
            }
            respond(&row, colors);
        });
    }

    /// The VJP of [`respond`](Self::respond) at what was rendered: turns the gradient to the shown colours into that to
    /// the rendered ones, and adds to the camera's.
    pub(crate) fn respond_backward(&mut self, rig: usize, t: Time, drawn: &Planes<f32>, d_color: &mut Planes<f32>) {
        let (row, simd) = (self.response(rig, t), Simd::detect());
        let sums: Vec<[f64; COLUMNS]> = pieces(d_color)
            .enumerate()
            .map(|(piece, d)| {
                let of_piece = piece * PIECE..piece * PIECE + d[0].len();
                let drawn = [0, 1, 2].map(|c| &drawn.plane(c)[of_piece.clone()]);
                dispatch(simd, RespondBackward { row: &row, drawn, d })
            })
            .collect();
        let sum = |k: usize| sums.iter().map(|s| s[k]).sum::<f64>();
        self.add_gradient(rig, t, &std::array::from_fn(sum));
    }

    /// One Adam step with what the last views gave. Returns whether all was finite.
    pub(crate) fn step(&mut self, rate: f64) -> bool {
        let mut rates = vec![None; self.key.0 as usize];
        rates.push(Some(vec![rate; COLUMNS]));
        let finite = self.moments.step(&mut self.params, &mut self.grads, &rates, &[]).is_empty();
        self.grads.clear(&self.params);
        let table = &mut self.params[self.key];
        for col in 0..COLUMNS {
            let sum: f64 = self.trained.iter().map(|&c| f64::from(table.get(c, col))).sum();
            let mean = (sum / self.trained.len().max(1) as f64) as f32;
            self.trained.iter().for_each(|&c| *table.get_mut(c, col) -= mean);
        }
        finite
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    fn random<const N: usize>(purpose: &str) -> [f64; N] {
        let rng = Rng::new(4, purpose, 0);
        std::array::from_fn(|i| rng.uniform(i as u64) - 0.4)
    }

    #[test]
    fn colours_have_the_gradient_of_the_shown_image() {
        let (row, x, d) = (random::<COLUMNS>("row"), random::<3>("x"), random::<3>("d"));
        let value = |row: &[f64; COLUMNS], x: [f64; 3]| -> f64 {
            shown(row, x).iter().zip(d).map(|(shown, d)| shown * d).sum()
        };
        let (d_x, d_row) = shown_backward(&row, x, d);
        let h = 1e-5;
        let check = |name: &str, got: f64, at: &dyn Fn(f64) -> f64| {
            let fd = (at(h) - at(-h)) / (2.0 * h);
            assert!((fd - got).abs() < 1e-9, "{name}: {fd} {got}");
        };
        for k in 0..3 {
            check("colour", d_x[k], &|by| value(&row, std::array::from_fn(|i| x[i] + if i == k { by } else { 0.0 })));
        }
        for k in 0..COLUMNS {
            let moved = |by: f64| std::array::from_fn(|i| row[i] + if i == k { by } else { 0.0 });
            check("camera", d_row[k], &|by| value(&moved(by), x));
        }
        assert_eq!(shown(&[0.0; COLUMNS], x), x, "no row is the identity");
    }

    #[test]
    fn exposures_that_change_are_lines_between_their_times() {
        let mut exposure = Exposure::over_time(3, &[0, 2], 4, (1.0, 2.5));
        assert_eq!((exposure.trained(), exposure.changes()), (&[0, 1, 2, 3, 8, 9, 10, 11][..], true));
        let key = exposure.key();
        (0..4).for_each(|k| exposure.params[key].write(8 + k, 0, [(k * k) as f32; COLUMNS]));
        // Before the first time and after the last one it is theirs.
        for (t, value) in [(0.0, 0.0), (1.0, 0.0), (1.25, 0.5), (1.5, 1.0), (2.25, 6.5), (2.5, 9.0), (7.0, 9.0)] {
            assert_eq!(exposure.response(2, Time(t)), [value; COLUMNS], "{t} s");
        }
        exposure.add_gradient(2, Time(2.125), &[8.0; COLUMNS]);
        let rows: Vec<f32> = (0..12).map(|row| exposure.grads.table(key).get(row, 3)).collect();
        assert_eq!(rows, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 6.0, 2.0]);
        assert!(!Exposure::over_time(3, &[0, 2], 4, (1.0, 1.0)).changes(), "there is one time");
    }

    /// Every pixel of every piece, with the same bits whatever the threads, and nothing learnt of the cameras' mean.
    #[test]
    fn cameras_differ_from_their_mean_alone() {
        let (width, height) = (101, 2 * PIECE / 101 + 3);
        let picture = |purpose: &str| {
            let rng = Rng::new(5, purpose, 0);
            let mut out = Planes::<f32>::new(3, height, width);
            out.data.iter_mut().enumerate().for_each(|(i, x)| *x = rng.uniform(i as u64) as f32);
            out
        };
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let mut exposure = Exposure::new(4, vec![0, 2, 3]);
                for step in 0..6 {
                    let rig = [0, 2, 3][step % 3];
                    let mut d = picture(&format!("gradient {step}"));
                    d.data.iter_mut().for_each(|x| *x -= 0.45);
                    exposure.respond_backward(rig, Time(0.0), &picture("drawn"), &mut d);
                    assert!(exposure.step(0.01));
                }
                let mut shown = picture("drawn");
                exposure.respond(2, Time(0.0), &mut shown);
                let table = &exposure.params[exposure.key()];
                let rows: Vec<[f32; COLUMNS]> = (0..4).map(|rig| table.read(rig, 0)).collect();
                (rows, shown)
            })
        };
        let (rows, color) = run(1);
        assert_eq!((rows.clone(), color.clone()), run(3));
        assert!(rows[1] == [0.0; COLUMNS], "a camera that is not trained");
        for k in 0..COLUMNS {
            assert!(rows[0][k] != 0.0 && rows.iter().map(|r| r[k]).sum::<f32>().abs() < 1e-6, "column {k}");
        }
        let drawn = picture("drawn");
        let at = |picture: &Planes<f32>, p: usize| [0, 1, 2].map(|c| picture.plane(c)[p]);
        for p in [0, PIECE - 1, PIECE, drawn.pixels() - 1] {
            assert_eq!(at(&color, p), shown(&rows[2], at(&drawn, p)), "pixel {p}");
        }
        // Out of place, and the gradient, pixel by pixel and as a sum in f64.
        let mut exposure = Exposure::new(4, vec![0, 2, 3]);
        let key = exposure.key();
        exposure.params[key].write(2, 0, rows[2]);
        let (mut out, mut d) = (Planes::default(), picture("gradient 0"));
        exposure.show(2, Time(0.0), &drawn, &mut out);
        assert_eq!(out, color);
        let before = d.clone();
        exposure.respond_backward(2, Time(0.0), &drawn, &mut d);
        let mut sums = [0.0; COLUMNS];
        for p in 0..drawn.pixels() {
            let (d_x, d_row) = shown_backward(&rows[2], at(&drawn, p), at(&before, p));
            assert_eq!(at(&d, p), d_x, "pixel {p}");
            (0..COLUMNS).for_each(|k| sums[k] += f64::from(d_row[k]));
        }
        let got = exposure.grads.table(key).read::<COLUMNS>(2, 0);
        for (k, sum) in sums.iter().enumerate() {
            assert!((f64::from(got[k]) / sum - 1.0).abs() < 1e-5, "column {k}: {} {sum}", got[k]);
        }
    }
}
