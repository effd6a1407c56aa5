//! Comparing on the GPU: value and gradient against the definition in f64, then the whole against the CPU.

use super::*;
use crate::render::{Comparison, PartGrads, Target};

/// Largest difference of a gradient to an image from that in f64, of the root of the mean square of all.
const PICTURE: f64 = 1e-4;
/// Largest relative difference of a mean over the image.
const VALUE: f64 = 1e-5;
/// Largest relative difference of gradients to Gaussians, as vectors: the same lists on both ways.
const VECTOR: f64 = 1e-4;
/// A camera's matrix without the identity, row by row, and its offsets.
const RESPONSE: [f32; 12] = [0.2, 0.03, -0.02, 0.01, -0.1, 0.04, -0.03, 0.02, 0.05, 0.02, 0.0, -0.03];
const DSSIM: f64 = 0.2;
/// The background: nothing of 8 bits, of which an image may be made, because where both are equal L1 has no gradient.
const BEHIND: [f32; 3] = [0.21, 0.507, 0.903];

/// The truth, and the weights of its pixels: numbers of 8 bits, or any.
fn truth(seed: u64, camera: &Camera, eight: bool) -> (Planes<f32>, Planes<f32>) {
    let (mut color, mut weight) =
        (Planes::new(3, camera.height, camera.width), Planes::new(1, camera.height, camera.width));
    let rng = Rng::new(seed, "truth", 0);
    let number = |x: f64| if eight { (255.0 * x).round() as f32 / 255.0 } else { x as f32 };
    for (i, v) in color.data.iter_mut().enumerate() {
        let smooth = 0.5 + 0.3 * (0.1 * i as f64).sin();
        *v = number((smooth + 0.2 * (rng.uniform(i as u64) - 0.5)).clamp(0.0, 1.0));
    }
    for (i, v) in weight.data.iter_mut().enumerate() {
        let x = rng.fork(1).uniform(i as u64);
        *v = if x < 0.3 { 0.0 } else { number(x) };
    }
    (color, weight)
}

/// The definition: value and gradient to the rendered image and to the response, every window summed up where it is
/// needed.
fn defined(drawn: &Planes<f32>, target: &Target<'_>) -> (Comparison, Vec<f64>) {
    let (h, w) = (drawn.height as i64, drawn.width as i64);
    let pixels = (h * w) as usize;
    let bell = |i: i64| (-(i * i) as f64 / 4.5).exp();
    let sum: f64 = (-5..=5).map(bell).sum();
    let row = target.response.unwrap_or_default().map(f64::from);
    let color = |c: usize, p: usize| f64::from(drawn.plane(c)[p]);
    let weight: Vec<f64> = (0..pixels).map(|p| target.weight.map_or(1.0, |w| f64::from(w.data[p]))).collect();
    let shown: Vec<Vec<f64>> = (0..3)
        .map(|c| {
            (0..pixels)
                .map(|p| color(c, p) + (0..3).map(|k| row[3 * c + k] * color(k, p)).sum::<f64>() + row[9 + c])
                .collect()
        })
        .collect();
    let total: f64 = 3.0 * weight.iter().sum::<f64>();
    let (mut out, mut d_shown) = (Comparison::default(), vec![vec![0.0; pixels]; 3]);
    for c in 0..3 {
        let mask = |p: usize, v: f64| if weight[p] > 0.0 { v } else { 0.0 };
        let x: Vec<f64> = (0..pixels).map(|p| mask(p, shown[c][p])).collect();
        let y: Vec<f64> = (0..pixels).map(|p| mask(p, target.truth.plane(c)[p].into())).collect();
        for p in 0..pixels {
            let (py, px) = (p as i64 / w, p as i64 % w);
            let near = || {
                (-5..=5i64).flat_map(move |i| (-5..=5i64).map(move |j| (i, j))).filter_map(move |(i, j)| {
                    let (qy, qx) = (py + i, px + j);
                    let inside = (0..h).contains(&qy) && (0..w).contains(&qx);
                    inside.then(|| ((qy * w + qx) as usize, bell(i) * bell(j) / (sum * sum)))
                })
            };
            let mut m = [0.0; 4];
            for (q, k) in near() {
                let v = [x[q], y[q], x[q] * x[q] + y[q] * y[q], x[q] * y[q]];
                (0..4).for_each(|i| m[i] += k * v[i]);
            }
            let [mx, my, sq, xy] = m;
            let (a1, a2) = (2.0 * mx * my + 1e-4, 2.0 * (xy - mx * my) + 9e-4);
            let (b1, b2) = (mx * mx + my * my + 1e-4, (sq - mx * mx - my * my).max(0.0) + 9e-4);
            let s = a1 * a2 / (b1 * b2);
            let scale = -target.dssim / total * weight[p];
            let d_mx = scale * 2.0 * (my * (a2 - a1) + mx * s * (b1 - b2)) / (b1 * b2);
            let (d_sq, d_xy) = (-scale * s / b2, scale * 2.0 * a1 / (b1 * b2));
            for (q, k) in near().filter(|(q, _)| weight[*q] > 0.0) {
                d_shown[c][q] += k * (d_mx + 2.0 * x[q] * d_sq + y[q] * d_xy);
            }
            d_shown[c][p] += (1.0 - target.dssim) / total * weight[p] * (x[p] - y[p]).signum();
            out.l1 += weight[p] * (x[p] - y[p]).abs() / total;
            out.ssim += weight[p] * s / total;
            out.mse += weight[p] * (x[p].clamp(0.0, 1.0) - y[p]).powi(2) / total;
        }
    }
    let mut d_response = [0.0; 12];
    let mut d = vec![0.0; 3 * pixels];
    for p in 0..pixels {
        for c in 0..3 {
            d_response[9 + c] += d_shown[c][p];
            d[c * pixels + p] += d_shown[c][p];
            for k in 0..3 {
                d_response[3 * c + k] += d_shown[c][p] * color(k, p);
                d[k * pixels + p] += row[3 * c + k] * d_shown[c][p];
            }
        }
    }
    out.d_response = target.response.map(|_| d_response);
    (out, d)
}

fn apart(a: &[f64], b: &[f64]) -> f64 {
    let length = b.iter().map(|v| v * v).sum::<f64>().sqrt();
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt() / length
}

fn wide(v: &[f32]) -> Vec<f64> {
    v.iter().map(|x| f64::from(*x)).collect()
}

/// Compares; gradients to Gaussians and their colours.
fn compared(r: &mut GpuRenderer, shot: &Shot<'_>, target: &Target<'_>) -> (Comparison, RenderGrads<f32>, Table<f32>) {
    let (mut d, mut d_sh) = (RenderGrads::default(), Table::new(&[("sh", 48)], shot.splats.len()));
    let comparison = r.compare(shot, target, &mut [Some(&mut d_sh)], &mut d).expect("it compares");
    (comparison.expect("it is drawn in one piece"), d, d_sh)
}

#[test]
fn value_and_gradient_equal_the_definition_and_the_cpu() {
    let Some(mut r) = renderer() else { return };
    let scene = Scenery::new(80, 400, 1.2, 0.08);
    let cameras = [camera([0.0, 0.5, -4.0], 67, 45), skewed(16, 33), camera([0.2, 0.1, -0.8], 5, 3)];
    for (i, camera) in cameras.iter().enumerate() {
        for (weighted, response, eight, more) in [
            (false, None, true, 1.0),
            (true, None, true, 1.0),
            // Colours of 8 bits with weights that are not.
            (true, None, true, 1.7),
            (false, Some(RESPONSE), false, 1.0),
            (true, Some(RESPONSE), false, 1.0),
        ] {
            let (splats, (truth, mut weight)) = (scene.splats(), truth(81 + i as u64, camera, eight));
            weight.data.iter_mut().for_each(|w| *w *= more);
            let shot = Shot::new(&splats, camera, BEHIND);
            let weight = weighted.then_some(&weight);
            let picture = 20 * i + 4 * usize::from(weighted) + usize::from(eight) + if more > 1.0 { 10 } else { 0 };
            let target = Target { truth: &truth, weight, picture, dssim: DSSIM, response };
            let what = format!("camera {i}, {weighted}, {response:?}, {eight}");
            let (got, d, d_sh) = compared(&mut r, &shot, &target);
            let d_picture: Vec<f32> = read(&r.gpu, &r.buffers.d_planes, 3 * truth.pixels());
            // The same through the CPU: the image is downloaded, its gradient uploaded.
            let mut image = Image::default();
            r.render(&shot, &mut image).expect("it is drawn");
            let (expected, d_expected) = defined(&image.color, &target);
            let off = |a: f64, b: f64| (a - b).abs() / b.abs().max(1e-2);
            for (name, a, b) in
                [("L1", got.l1, expected.l1), ("SSIM", got.ssim, expected.ssim), ("MSE", got.mse, expected.mse)]
            {
                assert!(off(a, b) < VALUE, "{what}: {name} is {a}, not {b}");
            }
            let far = apart(&wide(&d_picture), &d_expected);
            assert!(far < PICTURE, "{what}: the gradient to the picture is off by {far:.1e}");
            match (got.d_response, expected.d_response) {
                (Some(a), Some(b)) => assert!(apart(&a, &b) < PICTURE, "{what}: {a:?} {b:?}"),
                (a, b) => assert!(a.is_none() && b.is_none()),
            }
            let mut color = truth.clone();
            color.data.copy_from_slice(&d_picture);
            let grads = ImageGrads { color: &color, alpha: None, depth: None, extra: None };
            let (mut other, mut other_sh) = (RenderGrads::default(), d_sh.zeros_like());
            r.vjp(&shot, &grads, &mut [Some(&mut other_sh)], &mut other).expect("it goes back");
            let out = |d: &RenderGrads<f32>| d.parts.iter().flat_map(|p: &PartGrads<f32>| wide(p.out.data())).collect();
            let (a, b): (Vec<f64>, Vec<f64>) = (out(&d), out(&other));
            assert!(apart(&a, &b) < VECTOR && apart(&wide(d_sh.data()), &wide(other_sh.data())) < VECTOR, "{what}");
            assert!(apart(&wide(&d.mean2d), &wide(&other.mean2d)) < VECTOR && d.background == other.background);
            assert!(apart(&d.camera, &other.camera) < VECTOR, "{what}");
        }
    }
}

#[test]
fn comparison_repeats_bit_for_bit_at_any_budget_and_images_are_uploaded_once() {
    let Some(mut r) = own_renderer() else { return };
    let (scene, camera) = (Scenery::new(82, 3000, 1.2, 0.08), camera([0.0, 0.5, -4.0], 100, 70));
    let (splats, (color, weight)) = (scene.splats(), truth(83, &camera, true));
    let shot = Shot::new(&splats, &camera, BEHIND);
    let target =
        |picture| Target { truth: &color, weight: Some(&weight), picture, dssim: DSSIM, response: Some(RESPONSE) };
    let bits = |(c, d, sh): (Comparison, RenderGrads<f32>, Table<f32>)| {
        let parts: Vec<_> = d.parts.iter().map(|p| p.out.data().to_vec()).collect();
        (format!("{c:?} {:?} {:?}", d.camera, d.background), parts, d.mean2d, sh.data().to_vec())
    };
    let first = bits(compared(&mut r, &shot, &target(0)));
    assert!(first == bits(compared(&mut r, &shot, &target(0))) && r.pictures.sent == 1, "the same, sent once");
    // Small buffers at first, which must overflow.
    (r.buffers, r.groups) = (Buffers::new(), None);
    r.make_room_for_pairs(1000).expect("a little room");
    assert!(first == bits(compared(&mut r, &shot, &target(0))), "room changes no bit");
    // A budget that holds two images: the third is sent whenever it is needed.
    let one = r.pictures.bytes();
    r.pictures.budget = Some(2 * one);
    for picture in [1, 2, 0, 1, 2] {
        assert!(first == bits(compared(&mut r, &shot, &target(picture))));
    }
    assert_eq!((r.pictures.sent, r.pictures.bytes()), (4, 3 * one));
    // Images of another size end the time of the old ones.
    let small = super::camera([0.0, 0.5, -4.0], 50, 35);
    let (other, _) = truth(84, &small, false);
    let half = Target { truth: &other, weight: None, picture: 1, dssim: DSSIM, response: None };
    compared(&mut r, &Shot::new(&splats, &small, BEHIND), &half);
    assert!(r.pictures.bytes() < 3 * one);
    // More pairs than may be at once: bands, which are not compared here.
    r.most_pairs = r.stats().pairs / 3;
    (r.buffers, r.groups) = (Buffers::new(), None);
    r.make_room_for_pairs(r.most_pairs).expect("a little room");
    let (mut d, mut d_sh) = (RenderGrads::default(), Table::new(&[("sh", 48)], 3000));
    let compared = r.compare(&shot, &target(0), &mut [Some(&mut d_sh)], &mut d).expect("no error");
    assert!(compared.is_none() && d_sh.data().iter().all(|v| *v == 0.0), "nothing was done");
    // Nothing counts: the CPU's matter.
    let none = Planes::new(1, 70, 100);
    let empty = Target { weight: Some(&none), ..target(9) };
    assert!(r.compare(&shot, &empty, &mut [None], &mut d).expect("no error").is_none());
}

#[test]
fn a_lost_device_does_not_compare() {
    let Some(mut r) = own_renderer() else { return };
    let (scene, camera) = (Scenery::new(85, 50, 1.0, 0.1), camera([0.0, 0.5, -4.0], 20, 20));
    let (splats, (truth, _)) = (scene.splats(), truth(86, &camera, true));
    let shot = Shot::new(&splats, &camera, BEHIND);
    let target = Target { truth: &truth, weight: None, picture: 0, dssim: DSSIM, response: None };
    compared(&mut r, &shot, &target);
    r.gpu.device.destroy();
    assert!(r.compare(&shot, &target, &mut [None], &mut RenderGrads::default()).is_err());
}
