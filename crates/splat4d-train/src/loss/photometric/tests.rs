use super::*;
use splat4d::math::Rng;

/// A smooth random image with noise, or its perturbed copy.
fn image<F: Real>(channels: usize, height: usize, width: usize, seed: u64) -> Planes<F> {
    let rng = Rng::new(seed, "image", 0);
    let mut p = Planes::new(channels, height, width);
    for (i, v) in p.data.iter_mut().enumerate() {
        let wave = 0.5 + 0.3 * ((i % width) as f64 * 0.3 + seed as f64).sin() * ((i / width) as f64 * 0.2).cos();
        *v = F::of(wave + 0.2 * (rng.uniform(i as u64) - 0.5));
    }
    p
}

fn mask<F: Real>(height: usize, width: usize) -> Planes<F> {
    let rng = Rng::new(9, "mask", 0);
    let mut m = Planes::new(1, height, width);
    for (i, v) in m.data.iter_mut().enumerate() {
        let u = rng.uniform(i as u64);
        *v = F::of(if u < 0.3 { 0.0 } else { u });
    }
    m
}

/// The definition: 121 taps a pixel, in f64, pixels of weight 0 as outside.
fn naive(render: &Planes<f64>, truth: &Planes<f64>, weight: Option<&Planes<f64>>) -> (f64, f64, f64) {
    let (h, w) = (render.height as isize, render.width as isize);
    let bell = |i: isize| (-(i * i) as f64 / (2.0 * 1.5 * 1.5)).exp();
    let norm: f64 = (-5..=5).map(bell).sum();
    let weight_at = |y: isize, x: isize| weight.map_or(1.0, |m| m.get(0, y as usize, x as usize));
    let (mut l1, mut ssim, mut mse, mut total) = (0.0, 0.0, 0.0, 0.0);
    for c in 0..render.channels {
        for y in 0..h {
            for x in 0..w {
                let mut m = [0.0; 5];
                for j in -5..=5 {
                    for i in -5..=5 {
                        let (yy, xx) = (y + j, x + i);
                        if yy < 0 || xx < 0 || yy >= h || xx >= w || weight_at(yy, xx) == 0.0 {
                            continue;
                        }
                        let g = bell(j) * bell(i) / (norm * norm);
                        let a = render.get(c, yy as usize, xx as usize);
                        let b = truth.get(c, yy as usize, xx as usize);
                        for (m, v) in m.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                            *m += g * v;
                        }
                    }
                }
                let [ma, mb, aa, bb, ab] = m;
                let (va, vb, cov) = (aa - ma * ma, bb - mb * mb, ab - ma * mb);
                let s = (2.0 * ma * mb + 1e-4) * (2.0 * cov + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4));
                let k = weight_at(y, x);
                let (a, b) = (render.get(c, y as usize, x as usize), truth.get(c, y as usize, x as usize));
                ssim += k * s;
                l1 += k * (a - b).abs();
                mse += k * (a.clamp(0.0, 1.0) - b).powi(2);
                total += k;
            }
        }
    }
    (l1 / total, ssim / total, mse / total)
}

fn cast<F: Real>(p: &Planes<f64>) -> Planes<F> {
    Planes { channels: p.channels, height: p.height, width: p.width, data: p.data.iter().map(|&x| F::of(x)).collect() }
}

const SIZES: [(usize, usize, usize); 5] = [(1, 1, 1), (3, 7, 3), (3, 33, 65), (1, 130, 20), (2, 20, 1100)];

#[test]
fn value_equals_the_definition_with_and_without_weights() {
    for (c, h, w) in SIZES {
        let (mut a, b, m) = (image::<f64>(c, h, w, 1), image::<f64>(c, h, w, 2), mask::<f64>(h, w));
        // Renders may leave [0, 1].
        a.data.iter_mut().step_by(5).for_each(|x| *x = 3.0 * *x - 1.0);
        for weight in [None, Some(&m)] {
            let Some(true) = weight.map(|m| m.data.iter().any(|x| *x > 0.0)).or(Some(true)) else { continue };
            let (l1, ssim, mse) = naive(&a, &b, weight);
            let mut d = Planes::default();
            let v = Photometric::<f64>::new(0.2).loss_and_grad(&a, &b, weight, &mut d);
            assert!((v.l1 - l1).abs() < 1e-12 && (v.ssim - ssim).abs() < 1e-11, "{c}x{h}x{w} {v:?} {l1} {ssim}");
            assert!((v.mse - mse).abs() < 1e-12, "{c}x{h}x{w} {v:?} {mse}");
            assert!((v.total - (0.8 * l1 + 0.2 * (1.0 - ssim))).abs() < 1e-8, "λ is an f32");
            let m32 = weight.map(cast::<f32>);
            for simd in [Simd::detect(), Simd::Scalar] {
                let mut d32 = Planes::default();
                let mut loss = Photometric::<f32>::with_simd(0.2, simd);
                let v = loss.loss_and_grad(&cast(&a), &cast(&b), m32.as_ref(), &mut d32);
                assert!((v.mse - mse).abs() < 1e-6, "{c}x{h}x{w} {v:?} {mse}");
                assert!((v.l1 - l1).abs() < 1e-6 && (v.ssim - ssim).abs() < 1e-5, "{c}x{h}x{w} {v:?} {l1} {ssim}");
                let scale = d.data.iter().fold(0.0f64, |m, x| m.max(x.abs()));
                for (x, y) in d.data.iter().zip(&d32.data) {
                    assert!((x - f64::from(*y)).abs() < 2e-4 * scale, "{x} {y} of {scale}");
                }
            }
        }
    }
}

#[test]
fn gradient_equals_finite_differences() {
    for (c, h, w) in [(1, 1, 1), (3, 7, 3), (1, 33, 65), (1, 70, 14)] {
        let (a, b, m) = (image::<f64>(c, h, w, 3), image::<f64>(c, h, w, 4), mask::<f64>(h, w));
        for weight in [None, Some(&m)] {
            let mut loss = Photometric::<f64>::new(0.4);
            let (mut d, mut unused) = (Planes::default(), Planes::default());
            loss.loss_and_grad(&a, &b, weight, &mut d);
            let scale = d.data.iter().fold(0.0f64, |m, x| m.max(x.abs()));
            let step = (d.data.len() / 40).max(1);
            for i in (0..d.data.len()).step_by(step) {
                let mut at = |delta: f64| {
                    let mut p = a.clone();
                    p.data[i] += delta;
                    loss.loss_and_grad(&p, &b, weight, &mut unused).total
                };
                let h = 1e-6;
                let fd = (at(h) - at(-h)) / (2.0 * h);
                assert!((fd - d.data[i]).abs() < 1e-6 * scale + 1e-9, "{i}: {fd} {} of {scale}", d.data[i]);
            }
        }
    }
}

#[test]
fn equal_images_have_ssim_one_and_no_gradient() {
    let a = image::<f32>(3, 50, 40, 5);
    let mut d = Planes::default();
    let v = Photometric::<f32>::new(0.2).loss_and_grad(&a, &a, None, &mut d);
    assert!((v.ssim - 1.0).abs() < 1e-6 && v.l1 == 0.0 && v.total.abs() < 1e-6, "{v:?}");
    assert!(d.data.iter().all(|x| x.abs() < 1e-7), "at its optimum the loss must be flat");
}

#[test]
fn excluded_pixels_change_neither_value_nor_gradient() {
    let (a, b, m) = (image::<f32>(3, 40, 31, 6), image::<f32>(3, 40, 31, 7), mask::<f32>(40, 31));
    let mut other = a.clone();
    for c in 0..3 {
        for (v, w) in other.plane_mut(c).iter_mut().zip(&m.data) {
            if *w == 0.0 {
                *v = 17.0;
            }
        }
    }
    let (mut d, mut e) = (Planes::default(), Planes::default());
    let mut loss = Photometric::<f32>::new(0.2);
    assert_eq!(loss.loss_and_grad(&a, &b, Some(&m), &mut d), loss.loss_and_grad(&other, &b, Some(&m), &mut e));
    assert_eq!(d, e);
    assert!(m.data.iter().enumerate().all(|(i, w)| *w > 0.0 || d.data[i] == 0.0));
    let none = Planes::new(1, 40, 31);
    assert_eq!(loss.loss_and_grad(&a, &b, Some(&none), &mut d).total, 0.0);
    assert!(d.data.iter().all(|x| *x == 0.0));
}

#[test]
fn bits_do_not_depend_on_threads_or_on_earlier_calls() {
    let (a, b) = (image::<f32>(3, 200, 77, 8), image::<f32>(3, 200, 77, 9));
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a small pool");
        pool.install(|| {
            let (mut loss, mut d) = (Photometric::<f32>::new(0.2), Planes::default());
            let big = image::<f32>(1, 90, 700, 1);
            loss.loss_and_grad(&big, &big, None, &mut d);
            (loss.loss_and_grad(&a, &b, None, &mut d), d)
        })
    };
    let mut d = Planes::default();
    let fresh = Photometric::<f32>::new(0.2).loss_and_grad(&a, &b, None, &mut d);
    for threads in [1, 2, 5] {
        assert_eq!(run(threads), (fresh, d.clone()));
    }
}
