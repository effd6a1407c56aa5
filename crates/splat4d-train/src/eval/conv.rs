//! The layers that the LPIPS networks need: convolution, ReLU and max pooling of channels-first images.

use rayon::prelude::*;
use splat4d::math::Real;
use splat4d::scene::Planes;
use splat4d::simd::{Pass, Simd, dispatch_pass};

/// Output channels worked on together: one load of the input serves all of them.
const OUT_BLOCK: usize = 4;
/// Rows are whole AVX2 registers long, so that no loop has a scalar rest.
const COLUMNS: usize = 8;

/// A square convolution with bias.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Conv {
    /// Output channels.
    pub outputs: usize,
    /// Input channels.
    pub inputs: usize,
    /// Side of the kernel.
    pub side: usize,
    /// Step between output pixels.
    pub stride: usize,
    /// Zeros on every border.
    pub pad: usize,
    /// [outputs, inputs, side, side]
    pub weight: Vec<f32>,
    /// [outputs]
    pub bias: Vec<f32>,
}

impl Conv {
    /// max(0, conv(input) + bias), [outputs, H', W']; `None` where the image is smaller than the kernel.
    pub(crate) fn relu(&self, simd: Simd, input: &Planes<f32>) -> Option<Planes<f32>> {
        assert_eq!(input.channels, self.inputs, "an image with other channels than the convolution's");
        let (ph, pw) = (input.height + 2 * self.pad, input.width + 2 * self.pad);
        let size = |n: usize| Some(n.checked_sub(self.side)? / self.stride + 1);
        let (oh, ow) = (size(ph)?, size(pw)?);
        let padded = self.padded(input, oh, ow);
        let row = padded.row;
        let mut out = Planes::new(self.outputs, oh, ow);
        let blocks: Vec<Vec<f32>> = (0..self.outputs.div_ceil(OUT_BLOCK)).map(|b| self.block(b)).collect();
        out.data.par_chunks_mut(OUT_BLOCK * oh * ow).zip(&blocks).enumerate().for_each(|(b, (out, weights))| {
            let mut band = vec![0.0; OUT_BLOCK * row];
            let count = out.len() / (oh * ow);
            for y in 0..oh {
                let bias = std::array::from_fn(|o| self.bias.get(b * OUT_BLOCK + o).copied().unwrap_or(0.0));
                let job = Row { image: &padded, weights, side: self.side, bias, y };
                dispatch_pass(simd, &job, &mut (), band.as_mut_slice());
                for o in 0..count {
                    out[(o * oh + y) * ow..][..ow].copy_from_slice(&band[o * row..][..ow]);
                }
            }
        });
        Some(out)
    }

    /// The input with its border, its columns sorted by their remainder modulo the stride, so that the inner loop of
    /// any stride runs over neighbours.
    fn padded(&self, input: &Planes<f32>, oh: usize, ow: usize) -> Padded {
        let row = ow.next_multiple_of(COLUMNS);
        let phase = row + self.side.div_ceil(self.stride);
        let height = (oh - 1) * self.stride + self.side;
        let mut data = vec![0.0; input.channels * height * self.stride * phase];
        data.par_chunks_mut(height * self.stride * phase).enumerate().for_each(|(c, out)| {
            for y in self.pad..height.min(input.height + self.pad) {
                for x in 0..input.width {
                    let px = x + self.pad;
                    let (at, shift) = (px / self.stride, px % self.stride);
                    if at < phase {
                        out[(y * self.stride + shift) * phase + at] = input.get(c, y - self.pad, x);
                    }
                }
            }
        });
        Padded { data, channels: input.channels, height, stride: self.stride, phase, row }
    }

    /// Weights of one block of outputs, [inputs, side, side, OUT_BLOCK]; outputs that do not exist weigh nothing.
    fn block(&self, b: usize) -> Vec<f32> {
        let taps = self.inputs * self.side * self.side;
        let weight = |o: usize, t: usize| self.weight.get((b * OUT_BLOCK + o) * taps + t).copied().unwrap_or(0.0);
        (0..taps).flat_map(|t| (0..OUT_BLOCK).map(move |o| (o, t))).map(|(o, t)| weight(o, t)).collect()
    }
}

/// An image ready to be convolved: [channels, height, stride, phase].
struct Padded {
    data: Vec<f32>,
    channels: usize,
    height: usize,
    stride: usize,
    /// Numbers in a row of one remainder.
    phase: usize,
    /// Output columns, in whole chunks.
    row: usize,
}

/// One row of one block of output channels.
struct Row<'a> {
    image: &'a Padded,
    weights: &'a [f32],
    side: usize,
    bias: [f32; OUT_BLOCK],
    y: usize,
}

impl Pass for Row<'_> {
    type Scratch = ();
    type Into = [f32];
    type Out = ();

    /// Convolves one row of four output channels and clamps at zero; `out` is `[4, row]`.
    #[inline(always)]
    fn run<const FMA: bool>(&self, (): &mut (), out: &mut [f32]) {
        row::<FMA>(self, out);
    }
}

#[inline(always)]
fn row<const FMA: bool>(job: &Row<'_>, out: &mut [f32]) {
    let image = job.image;
    let top = job.y * image.stride;
    for (out, bias) in out.chunks_exact_mut(image.row).zip(job.bias) {
        out.fill(bias);
    }
    for c in 0..image.channels {
        for ky in 0..job.side {
            let line = (c * image.height + top + ky) * image.stride;
            let weights = &job.weights[(c * job.side + ky) * job.side * OUT_BLOCK..][..job.side * OUT_BLOCK];
            let weight = |kx: usize| -> [f32; OUT_BLOCK] { std::array::from_fn(|o| weights[kx * OUT_BLOCK + o]) };
            // Taps a stride apart read neighbours of one remainder: three of them go together.
            for shift in 0..image.stride.min(job.side) {
                let input = &image.data[(line + shift) * image.phase..][..image.phase];
                let mut kx = shift;
                while kx + 2 * image.stride < job.side {
                    let w = [weight(kx), weight(kx + image.stride), weight(kx + 2 * image.stride)];
                    add_taps::<FMA, 3>(&input[kx / image.stride..], &w, image.row, out);
                    kx += 3 * image.stride;
                }
                while kx < job.side {
                    add_taps::<FMA, 1>(&input[kx / image.stride..], &[weight(kx)], image.row, out);
                    kx += image.stride;
                }
            }
        }
    }
    out.iter_mut().for_each(|x| *x = Real::max(*x, 0.0));
}

/// Adds `K` neighbouring taps to four rows of outputs.
#[inline(always)]
fn add_taps<const FMA: bool, const K: usize>(input: &[f32], w: &[[f32; OUT_BLOCK]; K], row: usize, out: &mut [f32]) {
    let input = &input[..row + K - 1];
    let (o0, rest) = out.split_at_mut(row);
    let (o1, rest) = rest.split_at_mut(row);
    let (o2, rest) = rest.split_at_mut(row);
    let o3 = &mut rest[..row];
    for x in 0..row {
        let mut acc = [o0[x], o1[x], o2[x], o3[x]];
        for k in 0..K {
            for o in 0..OUT_BLOCK {
                acc[o] = input[x + k].fma::<FMA>(w[k][o], acc[o]);
            }
        }
        (o0[x], o1[x], o2[x], o3[x]) = (acc[0], acc[1], acc[2], acc[3]);
    }
}

/// Windows of a pooling at the right and lower edge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Edge {
    /// Whole windows only (PyTorch's default).
    Whole,
    /// Also windows that begin in the image and end outside (PyTorch's `ceil_mode`).
    Cut,
}

/// Largest value of every `side`² window, `stride` apart, without padding; `None` where no window fits.
pub(super) fn max_pool(input: &Planes<f32>, side: usize, stride: usize, edge: Edge) -> Option<Planes<f32>> {
    let size = |n: usize| {
        let steps = n.checked_sub(side)?;
        Some(1 + if edge == Edge::Cut { steps.div_ceil(stride) } else { steps / stride })
    };
    let (oh, ow) = (size(input.height)?, size(input.width)?);
    let mut out = Planes::new(input.channels, oh, ow);
    out.data.par_chunks_mut(oh * ow).enumerate().for_each(|(c, out)| {
        for y in 0..oh {
            for x in 0..ow {
                let mut most = f32::NEG_INFINITY;
                for j in 0..side.min(input.height - y * stride) {
                    for i in 0..side.min(input.width - x * stride) {
                        most = most.max(input.get(c, y * stride + j, x * stride + i));
                    }
                }
                out[y * ow + x] = most;
            }
        }
    });
    Some(out)
}
