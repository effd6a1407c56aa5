use super::*;
use splat4d::math::Rng;
use std::collections::BTreeMap;

type Tensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// Seeded weights of the right shapes, small enough that features neither die nor explode.
fn weights(net: Net) -> Tensors {
    let mut out = Tensors::new();
    let mut add = |name: String, shape: Vec<usize>, f: &dyn Fn(Rng, u64) -> f64| {
        let rng = Rng::new(3, &name, 0);
        let n: usize = shape.iter().product();
        out.insert(name, (shape, (0..n as u64).map(|i| f(rng, i) as f32).collect()));
    };
    let (mut taps, mut channels) = (0, 3);
    for layer in net.layers() {
        match *layer {
            Layer::Conv(i, _, [inputs, outputs, side, ..]) => {
                let spread = (24.0 / (inputs * side * side) as f64).sqrt();
                add(format!("features.{i}.weight"), vec![outputs, inputs, side, side], &|r, k| {
                    (r.uniform(k) - 0.5) * spread
                });
                add(format!("features.{i}.bias"), vec![outputs], &|r, k| 0.1 * r.normal(k));
                channels = outputs;
            }
            Layer::Fire(i, _, [inputs, squeezed, each]) => {
                for (part, shape) in [
                    ("squeeze", [squeezed, inputs, 1, 1]),
                    ("expand1x1", [each, squeezed, 1, 1]),
                    ("expand3x3", [each, squeezed, 3, 3]),
                ] {
                    let spread = (24.0 / (shape[1] * shape[2] * shape[3]) as f64).sqrt();
                    add(format!("features.{i}.{part}.weight"), shape.to_vec(), &|r, k| (r.uniform(k) - 0.5) * spread);
                    add(format!("features.{i}.{part}.bias"), vec![shape[0]], &|r, k| 0.1 * r.normal(k));
                }
                channels = 2 * each;
            }
            Layer::Pool(..) => {}
            Layer::Tap => {
                add(format!("lin{taps}.model.1.weight"), vec![1, channels, 1, 1], &|r, k| r.uniform(k));
                taps += 1;
            }
        }
    }
    out
}

fn load(t: &Tensors) -> Result<Lpips> {
    Lpips::load(|name| t.get(name).cloned())
}

fn image(height: usize, width: usize, seed: u64) -> Planes<f32> {
    let rng = Rng::new(seed, "lpips", 0);
    let data = (0..3 * height * width).map(|i| rng.uniform(i as u64) as f32).collect();
    Planes { channels: 3, height, width, data }
}

/// The definition in f64, seven nested loops.
fn naive_conv(conv: &Conv, input: &Planes<f64>) -> Planes<f64> {
    let out_size = |n: usize| (n + 2 * conv.pad - conv.side) / conv.stride + 1;
    let mut out = Planes::new(conv.outputs, out_size(input.height), out_size(input.width));
    for o in 0..conv.outputs {
        for y in 0..out.height {
            for x in 0..out.width {
                let mut sum = f64::from(conv.bias[o]);
                for c in 0..conv.inputs {
                    for j in 0..conv.side {
                        for i in 0..conv.side {
                            let (yy, xx) = (y * conv.stride + j, x * conv.stride + i);
                            let inside = |p: usize, n: usize| p >= conv.pad && p < n + conv.pad;
                            if inside(yy, input.height) && inside(xx, input.width) {
                                let w = conv.weight[((o * conv.inputs + c) * conv.side + j) * conv.side + i];
                                sum += f64::from(w) * input.get(c, yy - conv.pad, xx - conv.pad);
                            }
                        }
                    }
                }
                let (w, h) = (out.width, out.height);
                out.data[(o * h + y) * w + x] = sum.max(0.0);
            }
        }
    }
    out
}

fn naive_distance(net: &Lpips, a: &Planes<f32>, b: &Planes<f32>) -> f64 {
    let wide = |p: &Planes<f32>| {
        let data = p.data.iter().enumerate().map(|(i, x)| {
            let c = i / p.pixels();
            (2.0 * f64::from(*x) - 1.0 - [-0.030, -0.088, -0.188][c]) / [0.458, 0.448, 0.450][c]
        });
        Planes { channels: 3, height: p.height, width: p.width, data: data.collect() }
    };
    let pool = |p: &Planes<f64>, side: usize, stride: usize, edge: Edge| {
        let more = if edge == Edge::Cut { stride - 1 } else { 0 };
        let size = |n: usize| (n - side + more) / stride + 1;
        let mut out = Planes::new(p.channels, size(p.height), size(p.width));
        for i in 0..out.data.len() {
            let (c, y, x) = (i / out.pixels(), i % out.pixels() / out.width, i % out.width);
            out.data[i] = (0..side * side)
                .map(|k| (y * stride + k / side, x * stride + k % side))
                .filter(|(y, x)| *y < p.height && *x < p.width)
                .map(|(y, x)| p.get(c, y, x))
                .fold(f64::NEG_INFINITY, f64::max);
        }
        out
    };
    let fire = |[squeeze, narrow, wide]: &[Conv; 3], p: &Planes<f64>| {
        let squeezed = naive_conv(squeeze, p);
        let (mut out, rest) = (naive_conv(narrow, &squeezed), naive_conv(wide, &squeezed));
        out.channels += rest.channels;
        out.data.extend(rest.data);
        out
    };
    let (mut a, mut b) = (wide(a), wide(b));
    let mut total = 0.0;
    for step in &net.steps {
        match step {
            Step::Conv(conv) => (a, b) = (naive_conv(conv, &a), naive_conv(conv, &b)),
            Step::Fire(convs) => (a, b) = (fire(convs, &a), fire(convs, &b)),
            Step::Pool { side, stride, edge } => {
                (a, b) = (pool(&a, *side, *stride, *edge), pool(&b, *side, *stride, *edge));
            }
            Step::Tap(w) => {
                for y in 0..a.height {
                    for x in 0..a.width {
                        let norm = |p: &Planes<f64>| (0..w.len()).map(|c| p.get(c, y, x).powi(2)).sum::<f64>().sqrt();
                        let (na, nb) = (norm(&a) + 1e-10, norm(&b) + 1e-10);
                        let sum: f64 = (0..w.len())
                            .map(|c| f64::from(w[c]) * (a.get(c, y, x) / na - b.get(c, y, x) / nb).powi(2))
                            .sum();
                        total += sum / a.pixels() as f64;
                    }
                }
            }
        }
    }
    total
}

#[test]
fn all_networks_equal_the_definition_and_are_distances() {
    // The last size has windows of SqueezeNet's poolings that end outside of the image.
    for (net, height, width) in [(Net::Alex, 45, 61), (Net::Vgg, 17, 19), (Net::Squeeze, 33, 29)] {
        let lpips = load(&weights(net)).expect("the names and shapes are right");
        assert_eq!(lpips.net(), net);
        let (a, b) = (image(height, width, 1), image(height, width, 2));
        let d = lpips.distance(&a, &b, InputScaling::Signed).expect("big enough");
        let want = naive_distance(&lpips, &a, &b);
        assert!(d > 0.0 && (d / want - 1.0).abs() < 1e-4, "{net:?}: {d} {want}");
        assert_eq!(lpips.distance(&b, &a, InputScaling::Signed), Some(d), "a distance is symmetric");
        assert_eq!(lpips.distance(&a, &a, InputScaling::Signed), Some(0.0));
        let unit = lpips.distance(&a, &b, InputScaling::Unit).expect("big enough");
        assert!((unit - d).abs() > 1e-6, "the two input scalings give different numbers");
        assert_eq!(lpips.distance(&image(5, 5, 1), &image(5, 5, 2), InputScaling::Signed), None);
    }
}

#[test]
fn convolution_equals_the_definition_at_any_stride_and_size() {
    for (inputs, outputs, side, stride, pad, h, w) in [
        (3, 6, 11, 4, 2, 40, 33),
        (2, 5, 5, 1, 2, 7, 3),
        (1, 1, 3, 1, 1, 1, 1),
        (2, 4, 3, 2, 0, 9, 40),
        (3, 9, 3, 1, 1, 5, 35),
    ] {
        let rng = Rng::new(8, "conv", side as u64);
        let weight = (0..outputs * inputs * side * side).map(|i| rng.normal(i as u64) as f32).collect();
        let bias = (0..outputs).map(|i| rng.normal(i as u64 + 9999) as f32).collect();
        let conv = Conv { outputs, inputs, side, stride, pad, weight, bias };
        let data: Vec<f32> = (0..inputs * h * w).map(|i| rng.uniform(i as u64) as f32).collect();
        let wide = Planes { channels: inputs, height: h, width: w, data: data.iter().map(|x| f64::from(*x)).collect() };
        let input = Planes { channels: inputs, height: h, width: w, data };
        let want = naive_conv(&conv, &wide);
        for simd in [Simd::detect(), Simd::Scalar] {
            let got = conv.relu(simd, &input).expect("the kernel fits");
            assert_eq!((got.height, got.width), (want.height, want.width));
            for (g, w) in got.data.iter().zip(&want.data) {
                assert!((f64::from(*g) - w).abs() < 1e-4 * (1.0 + w.abs()), "{g} {w}");
            }
        }
    }
}

#[test]
fn unfit_weights_are_named() {
    let good = weights(Net::Alex);
    let message = |t: &Tensors| load(t).expect_err("must be refused").to_string();
    assert!(message(&Tensors::new()).contains("features.0.weight"));
    let mut t = good.clone();
    t.remove("lin3.model.1.weight");
    assert!(message(&t).contains("lin3.model.1.weight"));
    let mut t = good.clone();
    t.get_mut("features.6.weight").expect("it is there").0 = vec![384, 192, 5, 5];
    assert!(message(&t).contains("features.6.weight") && message(&t).contains("[384, 192, 3, 3]"));
    let mut t = good.clone();
    t.get_mut("features.3.bias").expect("it is there").1[7] = f32::NAN;
    assert!(message(&t).contains("features.3.bias"));
    let mut t = good.clone();
    t.get_mut("features.0.weight").expect("it is there").0 = vec![64, 3, 7, 7];
    assert!(message(&t).contains("[64, 3, 7, 7]"));
    // The `lpips` package's own names.
    let renamed: Tensors = good
        .iter()
        .map(|(name, v)| {
            let slice = |i: &str| match i {
                "0" => 1,
                "3" => 2,
                "6" => 3,
                "8" => 4,
                _ => 5,
            };
            let parts: Vec<&str> = name.split('.').collect();
            let name = if parts[0] == "features" {
                format!("net.slice{}.{}.{}", slice(parts[1]), parts[1], parts[2])
            } else {
                name.clone()
            };
            (name, v.clone())
        })
        .collect();
    assert!(load(&renamed).is_ok());
}

/// With the published weights, which are not in the repository: `SPLAT4D_LPIPS` names a folder with squeeze.safetensors and
/// the example images of the `lpips` repository. Expected: computed in f64 by another program.
#[test]
fn squeezenet_equals_another_program_where_weights_are_given() {
    use crate::capture::Rgb8;
    use splat4d::format::safetensors::SafeTensors;
    let Some(folder) = std::env::var_os("SPLAT4D_LPIPS").map(std::path::PathBuf::from) else {
        return println!("skipped: SPLAT4D_LPIPS names no folder");
    };
    let bytes = std::fs::read(folder.join("squeeze.safetensors")).unwrap();
    let file = SafeTensors::read(&bytes).unwrap();
    let tensor = |name: &str| file.tensor(name).ok().map(|t| (t.shape().to_vec(), t.as_f32().unwrap().to_vec()));
    let lpips = Lpips::load(tensor).unwrap();
    assert_eq!(lpips.net(), Net::Squeeze);
    let planes = |name: &str| {
        let rgb = Rgb8::read(&folder.join(name)).unwrap();
        let n = rgb.width * rgb.height;
        let data = (0..3 * n).map(|i| f32::from(rgb.data[i % n * 3 + i / n]) / 255.0).collect();
        Planes { channels: 3, height: rgb.height, width: rgb.width, data }
    };
    let truth = planes("ex_ref.png");
    for (name, expected) in [("ex_p0.png", 0.711_047_6), ("ex_p1.png", 0.147_901_6)] {
        let found = lpips.distance(&planes(name), &truth, InputScaling::Signed).unwrap();
        println!("{name}: {found:.7}, expected {expected}");
        assert!((found - expected).abs() < 1e-5, "{name}: {found}");
    }
}
