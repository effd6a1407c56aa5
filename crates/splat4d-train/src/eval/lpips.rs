//! LPIPS: the distance between two images in the features of a trained network.
//!
//! This crate contains no weights; a user names a file that holds, in 32-bit floats,
//!
//! | name | shape |
//! |---|---|
//! | `features.{i}.weight`, `features.{i}.bias` | as torchvision's AlexNet, VGG16 or SqueezeNet 1.1 (i: see below) |
//! | `features.{i}.squeeze.weight`, `.expand1x1.`, `.expand3x3.`, each with `bias` | SqueezeNet's fire modules |
//! | `lin{l}.model.1.weight`, l = 0..4, SqueezeNet 0..6 | `[1, channels, 1, 1]`, as the PyPI package `lpips` stores them |
//!
//! AlexNet has convolutions at i = 0, 3, 6, 8, 10, VGG16 at 0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28, SqueezeNet one at 0 and
//! fire modules at 3, 4, 6, 7, 9, 10, 11, 12. The names of the `lpips` package's own state (`net.slice1.0.weight` …) are understood
//! too. Which network it is shows in the shape of the first convolution and in the fire modules. Papers differ in network and in
//! input scaling: always state both. `clients/lpips/convert.py` writes such files.
//! Source: Zhang 2018, `lpips` version 0.1.

use super::conv::{Conv, Edge, max_pool};
use splat4d::math::Real;
use splat4d::scene::Planes;
use splat4d::simd::Simd;
use splat4d::{Error, Result};

/// Mean and spread of ImageNet colours for inputs in `[−1,1]` (`lpips` `ScalingLayer`).
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Keeps the norm of a feature that is all zero from dividing by zero (`lpips` `normalize_tensor`).
const NORM_FLOOR: f32 = 1e-10;
/// The remedy for a weight file that does not fit.
const REMEDY: &str = "Give a safetensors file with torchvision's `features.*` tensors of AlexNet, VGG16 or \
                      SqueezeNet 1.1 and the `lin*.model.1.weight` tensors of the `lpips` package \
                      (clients/lpips/convert.py writes one)";

/// The feature network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Net {
    /// AlexNet; results are labelled `LPIPS-alex`.
    Alex,
    /// VGG16; results are labelled `LPIPS-vgg`.
    Vgg,
    /// SqueezeNet 1.1; results are labelled `LPIPS-squeeze`.
    Squeeze,
}

/// Scaling of values in `[0,1]` for the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InputScaling {
    /// Mapped to `[−1,1]` first, as the `lpips` package requires.
    Signed,
    /// Unchanged, as the Inria 3DGS evaluation script does.
    Unit,
}

/// A layer: index in torchvision's `features`, slice of the `lpips` package, and its operation.
#[derive(Clone, Copy)]
enum Layer {
    /// Index, slice, inputs, outputs, side, stride, pad; a ReLU follows.
    Conv(usize, usize, [usize; 5]),
    /// Index, slice, inputs, squeezed channels, outputs of each of its two parts; ReLUs follow all three convolutions.
    Fire(usize, usize, [usize; 3]),
    /// Side and stride.
    Pool(usize, usize, Edge),
    /// A feature is taken here.
    Tap,
}

const fn same(index: usize, slice: usize, inputs: usize, outputs: usize) -> Layer {
    Layer::Conv(index, slice, [inputs, outputs, 3, 1, 1])
}

/// torchvision `alexnet`.
const ALEX: [Layer; 12] = [
    Layer::Conv(0, 1, [3, 64, 11, 4, 2]),
    Layer::Tap,
    Layer::Pool(3, 2, Edge::Whole),
    Layer::Conv(3, 2, [64, 192, 5, 1, 2]),
    Layer::Tap,
    Layer::Pool(3, 2, Edge::Whole),
    same(6, 3, 192, 384),
    Layer::Tap,
    same(8, 4, 384, 256),
    Layer::Tap,
    same(10, 5, 256, 256),
    Layer::Tap,
];

/// torchvision `vgg16`.
const VGG: [Layer; 22] = [
    same(0, 1, 3, 64),
    same(2, 1, 64, 64),
    Layer::Tap,
    Layer::Pool(2, 2, Edge::Whole),
    same(5, 2, 64, 128),
    same(7, 2, 128, 128),
    Layer::Tap,
    Layer::Pool(2, 2, Edge::Whole),
    same(10, 3, 128, 256),
    same(12, 3, 256, 256),
    same(14, 3, 256, 256),
    Layer::Tap,
    Layer::Pool(2, 2, Edge::Whole),
    same(17, 4, 256, 512),
    same(19, 4, 512, 512),
    same(21, 4, 512, 512),
    Layer::Tap,
    Layer::Pool(2, 2, Edge::Whole),
    same(24, 5, 512, 512),
    same(26, 5, 512, 512),
    same(28, 5, 512, 512),
    Layer::Tap,
];

/// torchvision `squeezenet1_1` (Iandola et al. 2016).
const SQUEEZE: [Layer; 19] = [
    Layer::Conv(0, 1, [3, 64, 3, 2, 0]),
    Layer::Tap,
    Layer::Pool(3, 2, Edge::Cut),
    Layer::Fire(3, 2, [64, 16, 64]),
    Layer::Fire(4, 2, [128, 16, 64]),
    Layer::Tap,
    Layer::Pool(3, 2, Edge::Cut),
    Layer::Fire(6, 3, [128, 32, 128]),
    Layer::Fire(7, 3, [256, 32, 128]),
    Layer::Tap,
    Layer::Pool(3, 2, Edge::Cut),
    Layer::Fire(9, 4, [256, 48, 192]),
    Layer::Tap,
    Layer::Fire(10, 5, [384, 48, 192]),
    Layer::Tap,
    Layer::Fire(11, 6, [384, 64, 256]),
    Layer::Tap,
    Layer::Fire(12, 7, [512, 64, 256]),
    Layer::Tap,
];

impl Net {
    /// The usual name of the result.
    pub(crate) fn label(self) -> &'static str {
        match self {
            Net::Alex => "LPIPS-alex",
            Net::Vgg => "LPIPS-vgg",
            Net::Squeeze => "LPIPS-squeeze",
        }
    }

    fn layers(self) -> &'static [Layer] {
        match self {
            Net::Alex => &ALEX,
            Net::Vgg => &VGG,
            Net::Squeeze => &SQUEEZE,
        }
    }
}

/// A step of the loaded network.
#[derive(Clone, Debug)]
enum Step {
    Conv(Conv),
    /// Squeeze, then two convolutions of its result, whose channels are concatenated.
    Fire([Conv; 3]),
    Pool {
        side: usize,
        stride: usize,
        edge: Edge,
    },
    /// Weights of the channels' squared differences.
    Tap(Vec<f32>),
}

/// A loaded network.
#[derive(Clone, Debug)]
pub struct Lpips {
    net: Net,
    steps: Vec<Step>,
    simd: Simd,
}

impl Lpips {
    /// Builds the network from named tensors: `tensor(name)` gives shape and row-major values, `None` where there is no
    /// such tensor.
    ///
    /// Errors: no known first convolution, a missing tensor, a wrong shape, a value that is not finite; each names the
    /// tensor and what was expected.
    pub fn load(tensor: impl Fn(&str) -> Option<(Vec<usize>, Vec<f32>)>) -> Result<Self> {
        let names = |i: usize, slice: usize, kind: &str| {
            [format!("features.{i}.{kind}"), format!("net.slice{slice}.{i}.{kind}")]
        };
        let first = names(0, 1, "weight");
        let Some((shape, _)) = first.iter().find_map(|n| tensor(n)) else {
            return Err(Error::input(format!("the LPIPS weights hold no tensor `{}`", first[0])).remedy(REMEDY));
        };
        let net = match shape[..] {
            [64, 3, 11, 11] => Net::Alex,
            [64, 3, 3, 3] if names(3, 2, "squeeze.weight").iter().any(|n| tensor(n).is_some()) => Net::Squeeze,
            [64, 3, 3, 3] => Net::Vgg,
            _ => {
                let what = format!(
                    "`{}` has shape {shape:?}: neither AlexNet [64, 3, 11, 11] nor VGG16 or SqueezeNet [64, 3, 3, 3]",
                    first[0]
                );
                return Err(Error::input(what).remedy(REMEDY));
            }
        };
        let claim = |names: &[String], want: &[usize]| -> Result<Vec<f32>> {
            let Some((name, (shape, data))) = names.iter().find_map(|n| Some((n, tensor(n)?))) else {
                return Err(
                    Error::input(format!("the LPIPS weights ({net:?}) hold no tensor `{}`", names[0])).remedy(REMEDY)
                );
            };
            if shape != want || data.len() != want.iter().product::<usize>() {
                let what = format!("`{name}` has shape {shape:?} and {} values, {net:?} needs {want:?}", data.len());
                return Err(Error::input(what).at("LPIPS weights").remedy(REMEDY));
            }
            if !data.iter().all(|x| x.is_finite()) {
                return Err(Error::input(format!("`{name}` holds NaN or infinity")).at("LPIPS weights").remedy(REMEDY));
            }
            Ok(data)
        };
        let conv = |i: usize, slice: usize, part: &str, [inputs, outputs, side, stride, pad]: [usize; 5]| {
            let weight = claim(&names(i, slice, &format!("{part}weight")), &[outputs, inputs, side, side])?;
            let bias = claim(&names(i, slice, &format!("{part}bias")), &[outputs])?;
            Ok::<_, Error>(Conv { outputs, inputs, side, stride, pad, weight, bias })
        };
        let (mut steps, mut channels, mut taps) = (Vec::new(), 3, 0);
        for layer in net.layers() {
            steps.push(match *layer {
                Layer::Conv(i, slice, shape) => {
                    channels = shape[1];
                    Step::Conv(conv(i, slice, "", shape)?)
                }
                Layer::Fire(i, slice, [inputs, squeezed, each]) => {
                    channels = 2 * each;
                    Step::Fire([
                        conv(i, slice, "squeeze.", [inputs, squeezed, 1, 1, 0])?,
                        conv(i, slice, "expand1x1.", [squeezed, each, 1, 1, 0])?,
                        conv(i, slice, "expand3x3.", [squeezed, each, 3, 1, 1])?,
                    ])
                }
                Layer::Pool(side, stride, edge) => Step::Pool { side, stride, edge },
                Layer::Tap => {
                    taps += 1;
                    Step::Tap(claim(&[format!("lin{}.model.1.weight", taps - 1)], &[1, channels, 1, 1])?)
                }
            });
        }
        Ok(Self { net, steps, simd: Simd::detect() })
    }

    /// Which network was loaded.
    pub(crate) fn net(&self) -> Net {
        self.net
    }

    /// The distance, ≥ 0 for the published weights, 0 for equal images; values are clamped to `[0,1]` first.
    ///
    /// Shapes: `[3,H,W]` both. `None` where the image is too small for the network's pooling.
    /// Panics: shapes differ, or there are not three channels.
    pub fn distance(&self, render: &Planes<f32>, truth: &Planes<f32>, scaling: InputScaling) -> Option<f64> {
        assert_eq!(
            (render.channels, render.height, render.width),
            (3, truth.height, truth.width),
            "LPIPS compares two colour images of one size"
        );
        assert_eq!(truth.channels, 3, "LPIPS compares two colour images of one size");
        let (mut a, mut b) = (scaled(render, scaling), scaled(truth, scaling));
        let mut sum = 0.0;
        for step in &self.steps {
            match step {
                Step::Conv(conv) => (a, b) = (conv.relu(self.simd, &a)?, conv.relu(self.simd, &b)?),
                Step::Fire(convs) => (a, b) = (fire(self.simd, convs, &a)?, fire(self.simd, convs, &b)?),
                Step::Pool { side, stride, edge } => {
                    (a, b) = (max_pool(&a, *side, *stride, *edge)?, max_pool(&b, *side, *stride, *edge)?);
                }
                Step::Tap(weights) => sum += feature_distance(&a, &b, weights)?,
            }
        }
        Some(sum)
    }
}

/// The result of a fire module.
fn fire(simd: Simd, [squeeze, narrow, wide]: &[Conv; 3], image: &Planes<f32>) -> Option<Planes<f32>> {
    let squeezed = squeeze.relu(simd, image)?;
    let (mut out, rest) = (narrow.relu(simd, &squeezed)?, wide.relu(simd, &squeezed)?);
    out.channels += rest.channels;
    out.data.extend(rest.data);
    Some(out)
}

fn scaled(image: &Planes<f32>, scaling: InputScaling) -> Planes<f32> {
    let mut out = image.clone();
    for c in 0..3 {
        for v in out.plane_mut(c) {
            let unit = v.clamp(0.0, 1.0);
            let signed = match scaling {
                InputScaling::Signed => 2.0 * unit - 1.0,
                InputScaling::Unit => unit,
            };
            *v = (signed - SHIFT[c]) / SCALE[c];
        }
    }
    out
}

/// Mean over pixels of Σ_c w_c (â_c − b̂_c)², where â is a pixel's feature divided by its norm.
fn feature_distance(a: &Planes<f32>, b: &Planes<f32>, weights: &[f32]) -> Option<f64> {
    let n = a.pixels();
    if n == 0 {
        return None;
    }
    let inverse_norm = |p: &Planes<f32>| -> Vec<f32> {
        let mut sum = vec![0.0f32; n];
        for c in 0..p.channels {
            sum.iter_mut().zip(p.plane(c)).for_each(|(s, x)| *s += x * x);
        }
        sum.iter().map(|s| 1.0 / (Real::sqrt(*s) + NORM_FLOOR)).collect()
    };
    let (na, nb) = (inverse_norm(a), inverse_norm(b));
    let mut total = 0.0;
    for (c, w) in weights.iter().enumerate() {
        let (pa, pb) = (a.plane(c), b.plane(c));
        let sum: f64 = (0..n).map(|p| f64::from(pa[p] * na[p] - pb[p] * nb[p]).powi(2)).sum();
        total += f64::from(*w) * sum;
    }
    Some(total / n as f64)
}

#[cfg(test)]
mod tests;
