//! End-point errors of rendered flow against the flow files of a capture (`flow` in capture.json), in pixels.

use crate::Result;
use crate::capture::Capture;
use crate::capture::flow::vectors;
use splat4d::flow::{Shot, render_flow};
use splat4d::layers::Scene;
use splat4d::render::{RenderConfig, Renderer};

/// A pixel that shows less than this has no flow.
const SEEN: f32 = 0.5;
/// Known flow is that of a whole pixel: of a mean of pixels all must be known.
const KNOWN: f32 = 0.999;
/// A pixel whose flow is longer moves, pixels.
const MOVES: f32 = 0.5;
/// End-point errors within which a pixel counts as right, pixels.
pub(crate) const WITHIN: [f64; 3] = [1.0, 3.0, 5.0];

/// Agreement of rendered with known flow.
#[derive(Clone, Debug, PartialEq)]
pub struct FlowError {
    /// Images that were measured.
    pub pictures: usize,
    /// Whether they were held out; else no held-out image has flow, and training images are used.
    pub held: bool,
    /// Mean end-point error, pixels.
    pub mean: f64,
    /// Median end-point error, pixels.
    pub median: f64,
    /// Mean end-point error of pixels that move by more than half a pixel; `None`: none does.
    pub moving: Option<f64>,
    /// Mean length of their known flow: the error of predicting no motion.
    pub length: Option<f64>,
    /// Share of all pixels within 1, 3 and 5 pixels.
    pub within: [f64; 3],
    /// Share of the pixels of known flow that show something.
    pub drawn: f64,
}

/// Measures a scene on the held-out views with known flow, or else on those of training. `None`: none has flow.
///
/// Errors: a file of flow that cannot be read.
pub fn flow_error(scene: &Scene<f32>, capture: &Capture) -> Result<Option<FlowError>> {
    let knows = |frames: &[usize]| -> Vec<usize> {
        frames.iter().copied().filter(|&i| capture.frames[i].flow.is_some()).collect()
    };
    let held = knows(&capture.held);
    let (frames, is_held) = if held.is_empty() { (knows(&capture.train), false) } else { (held, true) };
    let mut renderer = Renderer::new(RenderConfig::default());
    let (mut errors, mut moving, mut length, mut known) = (Vec::new(), Vec::new(), 0.0, 0usize);
    for &i in &frames {
        let frame = &capture.frames[i];
        let (Some(truth), Some(file)) = (vectors(frame, capture)?, &frame.flow) else { continue };
        let to = &capture.frames[file.to];
        let from = Shot { t: frame.time, camera: &frame.view };
        let drawn = render_flow(scene, from, Shot { t: to.time, camera: &to.view }, &mut renderer);
        for p in (0..truth.pixels()).filter(|&p| truth.plane(2)[p] >= KNOWN) {
            known += 1;
            if drawn.weight.data[p] < SEEN {
                continue;
            }
            let [u, v] = [0, 1].map(|k| truth.plane(k)[p]);
            let [du, dv] = [0, 1].map(|k| f64::from(drawn.vectors.plane(k)[p] - truth.plane(k)[p]));
            let error = du.hypot(dv);
            errors.push(error);
            if u.hypot(v) > MOVES {
                moving.push(error);
                length += f64::from(u.hypot(v));
            }
        }
    }
    if errors.is_empty() {
        return Ok(None);
    }
    let n = errors.len() as f64;
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let drawn = n / known as f64;
    let within = WITHIN.map(|w| errors.iter().filter(|e| **e <= w).count() as f64 / n);
    let (moving, length) = match moving.len() {
        0 => (None, None),
        count => (Some(mean(&moving)), Some(length / count as f64)),
    };
    let mean = mean(&errors);
    let middle = errors.len() / 2;
    let median = *errors.select_nth_unstable_by(middle, f64::total_cmp).1;
    Ok(Some(FlowError { pictures: frames.len(), held: is_held, mean, median, moving, length, within, drawn }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::{Capture, CaptureOptions};
    use splat4d::layers::Layer;
    use splat4d::motion::{SpacetimeSpec, Spec, build};
    use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
    use splat4d::scene::{GEOMETRY, LifeKind, Params};

    const SIDE: usize = 24;

    /// A camera at z = 4 looks at a wall at z = 0 that fills its image; its flow is 2 pixels a frame to the right.
    fn capture(folder: &std::path::Path) -> Capture {
        let plain = image::RgbImage::from_pixel(SIDE as u32, SIDE as u32, image::Rgb([90, 90, 90]));
        let code = |v: f64| (v * 64.0 + 32768.0).round() as u16;
        for i in 0..3 {
            plain.save(folder.join(format!("{i}.png"))).unwrap();
            let flow = image::ImageBuffer::from_fn(SIDE as u32, SIDE as u32, |x, _| {
                if x < 4 { image::Rgb([0u16; 3]) } else { image::Rgb([code(2.0), code(0.0), 1]) }
            });
            flow.save(folder.join(format!("f{i}.png"))).unwrap();
        }
        let text = format!(
            r#"{{"version": 1, "fps": 10, "hold_out": "none", "cameras": [{{"name": "a", "width": {SIDE}, "height": {SIDE},
            "fx": 40, "fy": 40, "cx": 12, "cy": 12, "images": "%d.png", "flow": "f%d.png",
            "world_to_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]}}]}}"#
        );
        std::fs::write(folder.join("capture.json"), text).unwrap();
        Capture::open(folder, &CaptureOptions::default()).unwrap()
    }

    /// The wall, which moves by this many pixels a frame.
    fn wall(pixels: f64) -> Scene<f32> {
        let mut p = Params::new(400, 1, &[]);
        let motion = build(&Spec::Spacetime(SpacetimeSpec { order: 1, ..SpacetimeSpec::default() }), &mut p).unwrap();
        let key = p.find("velocities").unwrap();
        for r in 0..400 {
            let at = |k: usize| (k as f32 / 19.0 - 0.5) * 4.0;
            p[GEOMETRY].write(r, 0, [at(r % 20), at(r / 20), 0.0]);
            p[GEOMETRY].write(r, QUAT, [1.0, 0.0, 0.0, 0.0]);
            p[GEOMETRY].write(r, LOG_SCALE, [-1.8; 3]);
            p[GEOMETRY].set(r, OPACITY, 4.0);
            p[key].set(r, 0, (pixels * 4.0 / 40.0 * 10.0) as f32);
        }
        let layers = vec![Layer::new("wall", p, motion, LifeKind::Infinite)];
        Scene { layers, clip: [0.0, 0.2], fps: 10.0, ..Scene::default() }
    }

    #[test]
    fn errors_are_those_of_known_pixels() {
        let folder = tempfile::tempdir().unwrap();
        let capture = capture(folder.path());
        let right = flow_error(&wall(2.0), &capture).unwrap().unwrap();
        assert!(right.mean < 0.02 && right.pictures == 2 && !right.held, "{right:?}");
        assert!((right.length.unwrap() - 2.0).abs() < 0.01 && right.drawn > 0.99 && right.within == [1.0; 3]);
        let slow = flow_error(&wall(0.5), &capture).unwrap().unwrap();
        assert!((slow.mean - 1.5).abs() < 0.02 && (slow.median - 1.5).abs() < 0.02, "{slow:?}");
        assert!((slow.moving.unwrap() - 1.5).abs() < 0.02 && slow.within == [0.0, 1.0, 1.0]);
    }
}
