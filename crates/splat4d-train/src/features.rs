//! Feature channels of a trained scene, learnt from images of features with all else fixed.
//!
//! A Gaussian has D numbers f_i. A pixel shows F = Σ w_i f_i / Σ w_i, w_i = α_i T_i, and the loss is ½ Σ_pixels |F −
//! F*|² over the pixels that are known and show something, plus ½ ε Σ |f_i|². With shapes fixed F is linear in f, so
//! that the loss has one minimum, which conjugate gradients approach in few rounds without a learning rate (Hestenes
//! and Stiefel 1952), each channel alone: a round renders every image once, forward and backward. Few rounds also keep
//! Gaussians that hardly contribute to pixels from growing.
//!
//! Features of Gaussians as blended channels: Feature 3DGS (Zhou et al. 2024), which learns them by steps next to
//! colours.

use crate::blended::{Blended, SEEN};
use crate::capture::Capture;
use crate::capture::features::{Features, read};
use crate::{Error, Result};
use splat4d::channels::feature_columns;
use splat4d::flow::divided;
use splat4d::layers::Scene;
use splat4d::scene::features::{self, FEATURES};
use splat4d::scene::{Planes, Table};

/// Rounds by default.
pub const ROUNDS: usize = 8;
/// Most images of a round, evenly chosen: more add no information.
pub const MOST_PICTURES: usize = 240;
/// ε, weight in pixels of features that are 0: Gaussians that no image shows have none.
const PRIOR: f64 = 1e-3;

/// Quality of learnt features.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FeatureScores {
    /// Images that were measured.
    pub pictures: usize,
    /// Share of the variance of the known pixels' features that is explained.
    pub explained: f64,
    /// Mean cosine between a pixel's features and the true ones.
    pub cosine: f64,
}

/// Frames of a list that have features, at most this many, evenly chosen.
fn featured(capture: &Capture, frames: &[usize]) -> Vec<usize> {
    let all: Vec<usize> = frames.iter().copied().filter(|&i| capture.frames[i].features.is_some()).collect();
    let step = all.len().div_ceil(MOST_PICTURES).max(1);
    all.into_iter().step_by(step).collect()
}

/// A frame's features, of `channels` as the first frame has. Errors: as [`read`], another number of channels.
fn truth(capture: &Capture, frame: usize, channels: Option<usize>) -> Result<Features> {
    let of = &capture.frames[frame];
    let found = read(of, capture)?.expect("only frames with features were chosen");
    match channels {
        Some(n) if n != found.channels => {
            let (camera, path) = (&capture.cameras[of.camera].name, of.features.as_ref());
            Err(Error::input(format!("the image of features has {} channels, others {n}", found.channels))
                .at(path.map_or_else(String::new, |p| p.display().to_string()))
                .at(format!("camera {camera}, frame {}", of.index))
                .remedy("Write the same channels for all images"))
        }
        _ => Ok(found),
    }
}

/// ½ Σ |F − s F*|² over the pixels that are known and show something, and its gradient to the blended sums Σ w f into
/// `d_extra` (whose last plane, that of Σ w, stays 0: shapes do not learn); returns the loss and how many pixels it is
/// of.
fn compare(
    values: &Planes<f32>,
    weight: &Planes<f32>,
    truth: &Features,
    s: f32,
    d_extra: &mut Planes<f32>,
) -> (f64, usize) {
    let pixels = weight.pixels();
    let (mut loss, mut seen) = (0.0, 0);
    for p in 0..pixels {
        let true_ = |c: usize| truth.values[c * pixels + p];
        if weight.data[p] < SEEN || (0..truth.channels).all(|c| true_(c) == 0.0) {
            continue;
        }
        seen += 1;
        for c in 0..truth.channels {
            let off = values.plane(c)[p] - s * true_(c);
            loss += 0.5 * f64::from(off).powi(2);
            d_extra.plane_mut(c)[p] = off / weight.data[p];
        }
    }
    (loss, seen)
}

/// Numbers of all Gaussians, by layer: [rows, channels].
type Vector = Vec<Table<f64>>;

/// By channel the scalar product of two.
fn dot(a: &Vector, b: &Vector, channels: usize) -> Vec<f64> {
    let mut out = vec![0.0; channels];
    for (a, b) in a.iter().zip(b) {
        for row in 0..a.rows() {
            (0..channels).for_each(|c| out[c] += a.get(row, c) * b.get(row, c));
        }
    }
    out
}

/// to ← scale·to + factor·x, channel by channel.
fn mix(to: &mut Vector, scale: &[f64], factor: &[f64], x: &Vector) {
    for (to, x) in to.iter_mut().zip(x) {
        for row in 0..to.rows() {
            for (c, (scale, factor)) in scale.iter().zip(factor).enumerate() {
                to.set(row, c, scale * to.get(row, c) + factor * x.get(row, c));
            }
        }
    }
}

/// Writes features into the scene, whose tables are there.
fn show(scene: &mut Scene<f32>, f: &Vector) {
    for (layer, f) in scene.layers.iter_mut().zip(f) {
        let key = features::key(&layer.params).expect("every layer has features now");
        for row in 0..f.rows() {
            (0..f.width()).for_each(|c| layer.params[key].set(row, c, f.get(row, c) as f32));
        }
    }
}

/// A pass over the images: Σ of the gradients of [`compare`] to the features of the scene, the loss and its pixels.
fn pass(
    scene: &Scene<f32>,
    capture: &Capture,
    frames: &[usize],
    s: f32,
    progress: &mut dyn FnMut(usize) -> Result<()>,
) -> Result<(Vector, f64, usize)> {
    let channels = scene.feature_channels();
    let mut sum: Vector = scene.layers.iter().map(|l| Table::new(&[(FEATURES, channels)], l.params.len())).collect();
    let (mut loss, mut pixels, mut work) = (0.0, 0, Blended::default());
    for (i, &frame) in frames.iter().enumerate() {
        progress(i)?;
        let truth = truth(capture, frame, Some(channels))?;
        work.draw(scene, capture, frame, |instant| feature_columns(scene, instant).expect("the scene has features"));
        let (values, weight) = divided(&work.image.extra);
        let mut d_extra = Planes::new(channels + 1, weight.height, weight.width);
        let (own, seen) = compare(&values, &weight, &truth, s, &mut d_extra);
        (loss, pixels) = (loss + own, pixels + seen);
        work.back(scene, capture, frame, &d_extra, |[layer, row], j, d, _| {
            (0..channels).for_each(|c| *sum[layer].get_mut(row, c) += f64::from(d.get(j, c)));
        });
    }
    Ok((sum, loss, pixels))
}

/// Learns the features of the capture's training images into the scene, in place of those it had. Returns the mean loss
/// of a known pixel before each round and after the last. `progress` receives how many images of how many are done, and
/// may end the work.
///
/// Errors: those of `progress`; no training image has features; one that cannot be read, or of other channels than the
/// first.
pub fn learn(
    scene: &mut Scene<f32>,
    capture: &Capture,
    rounds: usize,
    progress: &mut dyn FnMut(usize, usize) -> Result<()>,
) -> Result<Vec<f64>> {
    let frames = featured(capture, &capture.train);
    let Some(&first) = frames.first() else {
        return Err(Error::input("no training image of the capture has features")
            .at(capture.root.display())
            .remedy("Give cameras of capture.json `features` (images of features): docs/labels.md"));
    };
    let channels = truth(capture, first, None)?.channels;
    for layer in &mut scene.layers {
        features::reset(&mut layer.params, channels)?;
    }
    let total = (rounds + 1) * frames.len();
    let (mut residual, start, pixels) = pass(scene, capture, &frames, 1.0, &mut |i| progress(i, total))?;
    let (ones, minus) = (vec![1.0; channels], vec![-1.0; channels]);
    // The gradient of features that are 0 is minus what they should be rendered to.
    let zero = residual.clone();
    mix(&mut residual, &minus, &vec![0.0; channels], &zero);
    let (wanted, mut way) = (residual.clone(), residual.clone());
    let mut found: Vector = residual.iter().map(Table::zeros_like).collect();
    let mut square = dot(&residual, &residual, channels);
    let each = pixels.max(1) as f64;
    let mut losses = vec![start / each];
    let ratio = |a: &[f64], b: &[f64]| -> Vec<f64> {
        a.iter().zip(b).map(|(a, b)| if *b > 0.0 { a / b } else { 0.0 }).collect()
    };
    for round in 0..rounds {
        show(scene, &way);
        let done = (round + 1) * frames.len();
        let (mut curved, ..) = pass(scene, capture, &frames, 0.0, &mut |i| progress(done + i, total))?;
        mix(&mut curved, &ones, &vec![PRIOR; channels], &way);
        let step = ratio(&square, &dot(&way, &curved, channels));
        mix(&mut found, &ones, &step, &way);
        let back: Vec<f64> = step.iter().map(|s| -s).collect();
        mix(&mut residual, &ones, &back, &curved);
        let next = dot(&residual, &residual, channels);
        mix(&mut way, &ratio(&next, &square), &ones, &residual);
        square = next;
        // ½ f·Nf − f·b + ½ y·y, and the residual is b − Nf.
        let [fb, fr] = [&wanted, &residual].map(|x| dot(&found, x, channels).iter().sum::<f64>());
        losses.push((start - 0.5 * (fb + fr)) / each);
    }
    show(scene, &found);
    progress(total, total)?;
    Ok(losses)
}

/// Measures a scene's features on frames of its capture; `None`: none of them has features, or the scene has none.
///
/// Errors: an image of features that cannot be read, or of other channels than the scene.
pub fn measure(scene: &Scene<f32>, capture: &Capture, frames: &[usize]) -> Result<Option<FeatureScores>> {
    let (frames, channels) = (featured(capture, frames), scene.feature_channels());
    if frames.is_empty() || channels == 0 {
        return Ok(None);
    }
    let mut work = Blended::default();
    let (mut sums, mut squares, mut errors, mut cosines) = (vec![0.0; channels], 0.0, 0.0, 0.0);
    let mut seen = 0usize;
    for &frame in &frames {
        let truth = truth(capture, frame, Some(channels))?;
        work.draw(scene, capture, frame, |instant| feature_columns(scene, instant).expect("the scene has features"));
        let (values, weight) = divided(&work.image.extra);
        let pixels = weight.pixels();
        for p in (0..pixels).filter(|&p| weight.data[p] >= SEEN) {
            let true_: Vec<f32> = (0..channels).map(|c| truth.values[c * pixels + p]).collect();
            if true_.iter().all(|v| *v == 0.0) {
                continue;
            }
            let drawn: Vec<f32> = (0..channels).map(|c| values.plane(c)[p]).collect();
            seen += 1;
            cosines += features::likeness(&drawn, &true_);
            for ((sum, drawn), y) in sums.iter_mut().zip(&drawn).zip(true_.iter().map(|y| f64::from(*y))) {
                *sum += y;
                squares += y * y;
                errors += (f64::from(*drawn) - y).powi(2);
            }
        }
    }
    let n = seen.max(1) as f64;
    let variance = squares - sums.iter().map(|s| s * s / n).sum::<f64>();
    let explained = if variance > 0.0 { 1.0 - errors / variance } else { 0.0 };
    Ok(Some(FeatureScores { pictures: frames.len(), explained, cosine: cosines / n }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::CaptureOptions;
    use splat4d::format::npy;
    use splat4d::layers::Layer;
    use splat4d::math::Rng;
    use splat4d::motion::{Spec, build};
    use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
    use splat4d::scene::{GEOMETRY, LifeKind, Params};
    use std::path::Path;

    const SIDE: usize = 32;

    /// The features of a point on the wall: one grows to the right, one is a step downwards, one the same everywhere.
    fn asked(x: f64, y: f64) -> [f32; 3] {
        [x as f32, if y > 0.0 { 0.8 } else { -0.3 }, 0.5]
    }

    /// Two cameras look at a wall at z = 0 from z = 4, one a little to the side; the first row of pixels is unknown.
    fn capture(folder: &Path) -> Capture {
        let mut cameras = Vec::new();
        for (c, shift) in [0.0, 0.4].into_iter().enumerate() {
            let picture = image::RgbImage::from_pixel(SIDE as u32, SIDE as u32, image::Rgb([90, 90, 90]));
            picture.save(folder.join(format!("{c}.png"))).unwrap();
            let pixel = |p: usize| {
                let at = |i: usize| ((i as f64 + 0.5) - 16.0) / 40.0 * 4.0;
                if p < SIDE { [0.0; 3] } else { asked(at(p % SIDE) + shift, at(p / SIDE)) }
            };
            let values: Vec<f32> = (0..SIDE * SIDE).flat_map(pixel).collect();
            let mut file = Vec::new();
            npy::write_f32(&[SIDE, SIDE, 3], &values, &mut file).unwrap();
            std::fs::write(folder.join(format!("f{c}.npy")), file).unwrap();
            cameras.push(format!(
                r#"{{"name": "c{c}", "width": {SIDE}, "height": {SIDE}, "fx": 40, "fy": 40, "cx": 16, "cy": 16,
                "images": ["{c}.png"], "features": ["f{c}.npy"],
                "world_to_camera": [[1, 0, 0, {}], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}}"#,
                -shift
            ));
        }
        let text = format!(r#"{{"version": 1, "hold_out": "none", "cameras": [{}]}}"#, cameras.join(", "));
        std::fs::write(folder.join("capture.json"), text).unwrap();
        Capture::open(folder, &CaptureOptions::default()).unwrap()
    }

    fn wall() -> Scene<f32> {
        let mut p = Params::new(401, 1, &[]);
        let motion = build(&Spec::Still, &mut p).unwrap();
        for r in 0..400 {
            let at = |k: usize| (k as f32 / 19.0 - 0.5) * 4.0;
            p[GEOMETRY].write(r, 0, [at(r % 20), at(r / 20), 0.0]);
        }
        // No view ever sees the last one.
        p[GEOMETRY].write(400, 0, [0.0, 0.0, -9.0]);
        for r in 0..401 {
            p[GEOMETRY].write(r, QUAT, [1.0, 0.0, 0.0, 0.0]);
            p[GEOMETRY].write(r, LOG_SCALE, [-1.9; 3]);
            p[GEOMETRY].set(r, OPACITY, 4.0);
        }
        let layers = vec![Layer::new("wall", p, motion, LifeKind::Infinite)];
        Scene { layers, clip: [0.0, 0.0], fps: 10.0, ..Scene::default() }
    }

    #[test]
    fn the_gradient_is_that_of_differences() {
        let folder = tempfile::tempdir().unwrap();
        let (capture, mut scene) = (capture(folder.path()), wall());
        let key = features::claim(&mut scene.layers[0].params, 3).unwrap();
        let rng = Rng::new(1, "features", 0);
        for row in 0..401 {
            let draw = |k: usize| 0.3 * rng.fork(row as u64).normal(k as u64) as f32;
            scene.layers[0].params[key].write(row, 0, [0, 1, 2].map(draw));
        }
        let (d, loss, pixels) = pass(&scene, &capture, &capture.train, 1.0, &mut |_| Ok(())).unwrap();
        assert!(loss > 1.0 && pixels > 1500 && pixels <= 2 * SIDE * (SIDE - 1), "{loss} {pixels}");
        for (row, k) in [(0, 0), (210, 0), (211, 1), (189, 2), (400, 1)] {
            // The loss is quadratic: differences over any step are exact but for rounding.
            let at = |h: f32| {
                let mut moved = scene.clone();
                *moved.layers[0].params[key].get_mut(row, k) += h;
                pass(&moved, &capture, &capture.train, 1.0, &mut |_| Ok(())).unwrap().1
            };
            let fd = (at(0.5) - at(-0.5)) / 1.0;
            let got = d[0].get(row, k);
            assert!((fd - got).abs() < 2e-3 * (1.0 + fd.abs()), "row {row}, channel {k}: {fd} {got}");
            assert!(row != 400 || got == 0.0, "nobody sees it");
        }
    }

    #[test]
    fn gaussians_get_features_and_rounds_never_increase_the_error() {
        let folder = tempfile::tempdir().unwrap();
        let (capture, mut scene) = (capture(folder.path()), wall());
        let before = scene.layers[0].params[GEOMETRY].clone();
        let losses = learn(&mut scene, &capture, 6, &mut |_, _| Ok(())).unwrap();
        assert!(losses.windows(2).all(|w| w[1] <= w[0] + 1e-9) && losses[6] < 0.03 * losses[0], "{losses:?}");
        assert_eq!(scene.layers[0].params[GEOMETRY], before, "shapes stay as they are");
        let key = features::key(&scene.layers[0].params).unwrap();
        for row in 0..400 {
            let [x, y] = before.read::<2>(row, 0).map(f64::from);
            if x.abs() < 0.9 && (0.4..0.9).contains(&y.abs()) {
                let (got, wanted) = (features::row(&scene.layers[0].params, key, row), asked(x, y));
                let off = (0..3).map(|k| (got[k] - wanted[k]).abs()).fold(0.0, f32::max);
                assert!(off < 0.2, "{row}: {got:?} {wanted:?}");
            }
        }
        assert_eq!(features::row(&scene.layers[0].params, key, 400), [0.0; 3], "what nobody sees has none");
        let scores = measure(&scene, &capture, &capture.train).unwrap().unwrap();
        assert!(scores.explained > 0.93 && scores.cosine > 0.97 && scores.pictures == 2, "{scores:?}");
        // Learning again begins again.
        let again = learn(&mut scene, &capture, 1, &mut |_, _| Ok(())).unwrap();
        assert!((again[0] - losses[0]).abs() < 1e-9);
    }

    #[test]
    fn invalid_features_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let mut capture = capture(folder.path());
        let say = |shape: &[usize], values: &[f32], capture: &Capture| {
            let mut file = Vec::new();
            npy::write_f32(shape, values, &mut file).unwrap();
            std::fs::write(folder.path().join("f1.npy"), file).unwrap();
            learn(&mut wall(), capture, 1, &mut |_, _| Ok(())).unwrap_err().to_string()
        };
        let n = SIDE * SIDE;
        let sound = vec![0.25; 3 * n];
        let mut broken = sound.clone();
        broken[3 * (5 * SIDE + 7) + 1] = f32::NAN;
        let cases: [(&[usize], &[f32], &str); 4] = [
            (&[SIDE, SIDE, 3], &broken, "channel 1 at pixel (7, 5) is NaN"),
            (&[SIDE, SIDE, 2], &sound[..2 * n], "has 2 channels, others 3"),
            (&[SIDE, 20, 3], &sound[..60 * SIDE], "20x32, its image 32x32"),
            (&[SIDE, SIDE], &sound[..n], "is [height, width, channels]"),
        ];
        for (shape, values, words) in cases {
            let said = say(shape, values, &capture);
            for word in [words, "camera c1, frame 0", "f1.npy"] {
                assert!(said.contains(word), "`{said}` does not say `{word}`");
            }
        }
        capture.frames.iter_mut().for_each(|f| f.features = None);
        let said = learn(&mut wall(), &capture, 1, &mut |_, _| Ok(())).unwrap_err().to_string();
        assert!(said.contains("no training image") && said.contains("docs/labels.md"), "{said}");
    }
}
