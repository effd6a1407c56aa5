use super::*;
use splat4d::math::Rng;

fn image(channels: usize, height: usize, width: usize, seed: u64) -> Planes<f32> {
    let rng = Rng::new(seed, "picture", 0);
    let mut p = Planes::new(channels, height, width);
    for (i, v) in p.data.iter_mut().enumerate() {
        let wave = 0.5 + 0.35 * ((i % width) as f32 * 0.11).sin() * ((i / width) as f32 * 0.07).cos();
        *v = wave + 0.1 * (rng.uniform(i as u64) as f32 - 0.5);
    }
    p
}

fn constant(value: f32) -> Planes<f32> {
    Planes { channels: 3, height: 4, width: 5, data: vec![value; 60] }
}

#[test]
fn psnr_of_known_errors() {
    let value = psnr(&constant(0.6), &constant(0.5)).expect("there are pixels");
    assert!((value - 20.0).abs() < 1e-5, "an error of 0.1 is 20 dB, not {value}");
    let clamped = psnr(&constant(7.0), &constant(0.9)).expect("there are pixels");
    assert!((clamped - 20.0).abs() < 1e-5, "values are clamped: {clamped}");
    assert_eq!(psnr(&constant(0.3), &constant(0.3)), Some(f64::INFINITY));
    assert_eq!(psnr(&Planes::new(3, 0, 0), &Planes::new(3, 0, 0)), None);
    // Finer than 8 bits: rounding would hide this error.
    assert!(psnr(&constant(0.5), &constant(0.5001)).is_some_and(|v| (v - 80.0).abs() < 0.1));
}

#[test]
fn psnr_of_a_region_ignores_pixels_outside() {
    let (mut a, b) = (constant(0.5), constant(0.5));
    let region: Vec<bool> = (0..20).map(|p| p < 7).collect();
    (0..3).for_each(|c| a.plane_mut(c)[7..].fill(0.0));
    assert_eq!(psnr_region(&a, &b, &region), Some(f64::INFINITY));
    (0..3).for_each(|c| a.plane_mut(c)[..7].fill(0.51));
    assert!(psnr_region(&a, &b, &region).is_some_and(|v| (v - 40.0).abs() < 1e-3));
    assert_eq!(psnr_region(&a, &b, &[false; 20]), None);
}

#[test]
fn ssim_and_ms_ssim_order_images_by_quality() {
    let truth = image(3, 180, 200, 1);
    let noisy = |k: f32| {
        let mut p = truth.clone();
        let rng = Rng::new(2, "noise", 0);
        p.data.iter_mut().enumerate().for_each(|(i, v)| *v += k * (rng.uniform(i as u64) as f32 - 0.5));
        p
    };
    for metric in [ssim, ms_ssim] {
        let [a, b, c] = [0.0, 0.1, 0.5].map(|k| metric(&noisy(k), &truth).expect("big enough"));
        assert!((a - 1.0).abs() < 1e-6 && a > b && b > c && c > 0.0, "{a} {b} {c}");
    }
    assert_eq!(d_ssim(0.5), 0.25);
    assert!(ms_ssim(&image(3, 176, 176, 1), &image(3, 176, 176, 2)).is_some());
    assert_eq!(ms_ssim(&image(3, 175, 400, 1), &image(3, 175, 400, 2)), None);
    assert_eq!(ssim(&Planes::new(3, 0, 0), &Planes::new(3, 0, 0)), None);
}

/// On constant images every window is alike, so both numbers follow by hand from the luminance term.
#[test]
fn ms_ssim_of_constant_images() {
    let flat = |v: f32| Planes { channels: 1, height: 200, width: 180, data: vec![v; 36_000] };
    let (a, b) = (0.25, 0.75);
    let luminance: f64 = (2.0 * a * b + 1e-4) / (a * a + b * b + 1e-4);
    let got = ms_ssim(&flat(a as f32), &flat(b as f32)).expect("big enough");
    assert!((got - luminance.powf(0.1333)).abs() < 1e-9, "{got} {luminance}");
}

#[test]
fn contrast_term_equals_the_definition() {
    let (a, b) = (image(1, 17, 15, 3), image(1, 17, 15, 4));
    let wide = |p: &Planes<f32>| p.data.iter().map(|x| f64::from(*x)).collect::<Vec<_>>();
    let (x, y) = (wide(&a), wide(&b));
    let bell = |i: i32| (-f64::from(i * i) / 4.5).exp();
    let norm: f64 = (-5..=5).map(bell).sum();
    let (mut full, mut contrast, mut n) = (0.0, 0.0, 0.0);
    for r in 5..12 {
        for c in 5..10 {
            let mut m = [0.0; 5];
            for j in -5i32..=5 {
                for i in -5i32..=5 {
                    let p = ((r + j) * 15 + c + i) as usize;
                    let g = bell(i) * bell(j) / (norm * norm);
                    for (m, v) in m.iter_mut().zip([x[p], y[p], x[p] * x[p], y[p] * y[p], x[p] * y[p]]) {
                        *m += g * v;
                    }
                }
            }
            let cs = (2.0 * (m[4] - m[0] * m[1]) + 9e-4) / (m[2] + m[3] - m[0] * m[0] - m[1] * m[1] + 9e-4);
            contrast += cs;
            full += cs * (2.0 * m[0] * m[1] + 1e-4) / (m[0] * m[0] + m[1] * m[1] + 1e-4);
            n += 1.0;
        }
    }
    let got = valid_ssim(&x, &y, 17, 15);
    assert!((got.0 - full / n).abs() < 1e-12 && (got.1 - contrast / n).abs() < 1e-12);
}

#[test]
fn changing_pixels_are_the_dynamic_region() {
    let mut mean = TemporalMean::default();
    assert!(mean.mean().is_none());
    let frames: Vec<Planes<f32>> = (0..4)
        .map(|t| {
            let mut p = constant(0.4);
            p.plane_mut(1)[t] = 0.9;
            p.plane_mut(2)[19] = 0.4 + 0.01 * t as f32;
            p
        })
        .collect();
    frames.iter().for_each(|f| mean.push(f));
    let m = mean.mean().expect("four frames");
    assert!((m.get(1, 0, 0) - 0.525).abs() < 1e-6 && mean.frames() == 4);
    let region = dynamic_region(&frames[2], &m);
    // In every frame the pixels that another frame lights up are darker than their mean.
    assert_eq!(region.iter().positions(), [0, 1, 2, 3]);
}

trait Positions {
    fn positions(self) -> Vec<usize>;
}
impl<'a, I: Iterator<Item = &'a bool>> Positions for I {
    fn positions(self) -> Vec<usize> {
        self.enumerate().filter(|(_, r)| **r).map(|(p, _)| p).collect()
    }
}

#[test]
fn flicker_is_the_change_of_the_error() {
    let mut steady = Flicker::default();
    let mut trembling = Flicker::default();
    for t in 0..5 {
        // The truth moves; a constant error is no flicker.
        let truth = constant(0.2 + 0.1 * t as f32);
        steady.push(&constant(0.25 + 0.1 * t as f32), &truth);
        trembling.push(&constant(0.2 + 0.1 * t as f32 + if t % 2 == 0 { 0.0 } else { 2.0 / 255.0 }), &truth);
        assert_eq!(steady.value().is_some(), t > 0);
    }
    assert!(steady.value().is_some_and(|v| v < 1e-4));
    assert!(trembling.value().is_some_and(|v| (v - 2.0).abs() < 1e-4), "{:?}", trembling.value());
    assert!(Flicker::over([&steady, &trembling]).is_some_and(|v| (v - 1.0).abs() < 1e-4));
    assert_eq!(Flicker::over([]), None);
}

#[test]
fn error_colours_grow_lighter() {
    let light = |e: f32| {
        let p = error_map(&constant(e), &constant(0.0), 0.5);
        assert_eq!((p.channels, p.height, p.width), (3, 4, 5));
        0.2126 * p.get(0, 1, 1) + 0.7152 * p.get(1, 1, 1) + 0.0722 * p.get(2, 1, 1)
    };
    let steps: Vec<f32> = (0..=50).map(|i| light(i as f32 * 0.01)).collect();
    assert!(steps.windows(2).all(|s| s[1] > s[0]), "{steps:?}");
    assert_eq!(light(0.5), light(0.9), "beyond the range stays the last colour");
}
