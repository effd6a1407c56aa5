//! Blocks against single rows, and footprints against their definition.

use super::*;
use crate::math::{Rng, Se3, sym3};
use crate::scene::splats::{Part, SPLAT_COLUMNS};
use crate::scene::{Color, Intrinsics, Lens};

/// Terms of the form up to here cancel to within the margin of τ.
const EXACT: f64 = 1e3;

fn view(width: usize, height: usize, antialias: Antialias) -> View<f32> {
    let intrinsics = Intrinsics { fx: 300.0, fy: 310.0, cx: 0.5 * width as f64, cy: 0.4 * height as f64 };
    let cam_from_world = Se3::look_at([0.5, -0.4, -4.0], [0.0; 3], [0.1, -1.0, 0.0]);
    let camera = Camera { cam_from_world, intrinsics, lens: Lens::Pinhole, width, height, near: Camera::NEAR };
    View::new(&camera, &RenderConfig { antialias, ..RenderConfig::default() })
}

/// Needles, discs and balls of all sizes, some of them culled for every reason there is.
fn cloud(n: usize) -> Table<f32> {
    let (rng, mut out) = (Rng::new(8, "projection", 0), Table::new(&SPLAT_COLUMNS, n));
    for j in 0..n {
        let r = rng.fork(j as u64);
        let scales = std::array::from_fn(|k| -3.5 + 1.5 * r.normal(k as u64) as f32);
        let quat = std::array::from_fn(|k| r.normal(10 + k as u64) as f32);
        out.write::<3>(j, 0, std::array::from_fn(|k| 1.5 * r.normal(20 + k as u64) as f32));
        out.write(j, COV, sym3::from_quat_log_scales(quat, scales));
        out.set(j, SPLAT_OPACITY, r.uniform(4) as f32);
        let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -1.0, 0.0, 1e30];
        if j % 7 == 0 {
            out.set(j, j / 7 % 10, bad[j / 70 % bad.len()]);
        }
    }
    out
}

#[test]
fn blocks_are_projected_as_single_rows_are() {
    let out = cloud(1500);
    let table = Table::new(&[("rgb", 3)], 1500);
    let splats = Splats { parts: vec![Part::new(&out, Color::Direct { table: &table })], head: None };
    for antialias in [Antialias::Off, Antialias::On] {
        let view = view(500, 333, antialias);
        for simd in [Simd::Scalar, Simd::Avx2, Simd::Avx512] {
            let mut rows = vec![Projected { radius: 9.0, ..Projected::default() }; 1500];
            let (mut feet, mut radii) = (vec![Footprint::default(); 1500], vec![9.0; 1500]);
            forward(&splats, &view, simd, &mut rows, &mut feet, &mut radii);
            let mut drawn = 0;
            for j in 0..1500 {
                let (mean, cov) = (out.read::<3>(j, 0), out.read::<6>(j, COV));
                let row = project(&view, mean, cov, out.get(j, SPLAT_OPACITY));
                let foot = row.map_or(Footprint::default(), |row| Footprint::new(&row, &view));
                let row = row.filter(|_| !foot.is_empty()).unwrap_or_default();
                assert!((rows[j], feet[j], radii[j]) == (row, foot, row.radius), "{simd:?}, row {j}");
                drawn += usize::from(row.radius > 0.0);
            }
            assert!(drawn > 500, "{drawn} rows are drawn");
        }
    }
}

#[test]
fn footprints_are_the_bins_that_ellipses_intersect() {
    let (out, view) = (cloud(700), view(500, 333, Antialias::Off));
    let (mut slanted, mut large) = (0, 0);
    for j in 0..700 {
        let (mean, cov) = (out.read::<3>(j, 0), out.read::<6>(j, COV));
        let Some(p) = project(&view, mean, cov, out.get(j, SPLAT_OPACITY)) else { continue };
        let foot = Footprint::new(&p, &view);
        if foot.large().is_some() {
            large += 1;
            continue;
        }
        let [x, y] = p.mean2d.map(f64::from);
        let [a, b, c] = p.conic.map(f64::from);
        let (across, down) = (view.width.div_ceil(BIN), view.height.div_ceil(BIN));
        let numbers = foot.numbers(across, down);
        // Bins of a single row or column are not tested one by one.
        let single = |number: fn(usize, usize) -> usize| {
            numbers.iter().all(|&n| number(n, across) == number(numbers[0], across))
        };
        let tested = !single(|n, across| n / across) && !single(|n, across| n % across);
        for by in 0..down {
            for bx in 0..across {
                // The least of the form over the box of pixel centres, by steps of a quarter of a pixel in x and the
                // clamped root of the derivative in y.
                let ends = |k: usize, size: usize| [k * BIN, ((k + 1) * BIN).min(size) - 1].map(|v| v as f64 + 0.5);
                let ([x0, x1], [y0, y1]) = (ends(bx, view.width), ends(by, view.height));
                let steps = (4.0 * (x1 - x0)) as usize;
                let least = (0..=steps).map(|i| {
                    let dx = x0 + 0.25 * i as f64 - x;
                    let dy = (-b / c * dx).clamp(y0 - y, y1 - y);
                    a * dx * dx + 2.0 * b * dx * dy + c * dy * dy
                });
                let least = least.fold(f64::MAX, f64::min);
                let hit = numbers.contains(&(by * across + bx));
                // Far from the centre of a needle f32 makes anything of terms that cancel.
                let far = [(x0 - x).abs().max((x1 - x).abs()), (y0 - y).abs().max((y1 - y).abs())];
                if a * far[0] * far[0] + c * far[1] * far[1] > EXACT {
                    continue;
                }
                let tau = f64::from(p.tau);
                assert!(hit || least > tau - TAU_MARGIN, "row {j} meets bin {bx}, {by}: {least} of {tau}");
                // A step of ⅛ pixel from the best point, along the steepest form that the low-pass lets be.
                let slack = 0.125 * (tau / 0.3).sqrt() * 2.0 + 0.1;
                assert!(
                    !hit || !tested || least < tau + slack,
                    "row {j} does not meet bin {bx}, {by}: {least} of {tau}"
                );
            }
        }
        slanted += usize::from(tested);
    }
    assert!(slanted > 50 && large > 0, "{slanted} masks, {large} large rectangles");
}
