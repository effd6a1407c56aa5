//! Frames of plain Gaussians, one file each, as one moving scene: every Gaussian is alive during its own frame.

use crate::layers::{Layer, Scene};
use crate::math::sh;
use crate::motion::Still;
use crate::scene::{GEOMETRY, LIFE, LifeKind, Params, SH};
use crate::{Error, Result};
use std::sync::Arc;

/// Length of the soft ends of a frame's life, as a share of the frame: so short that no time shows two frames, and long
/// enough for f32 seconds.
const SOFT: f64 = 1e-3;

/// Joins frames into a scene of `fps` frames per second that begins at 0 s. Frame i is seen from half a frame before
/// i/fps to half a frame behind it.
///
/// Errors: no frames; more than 2^32 Gaussians. Panics: `fps` is not positive.
pub fn join(frames: &[Params], fps: f64, up: [f64; 3]) -> Result<Scene<f32>> {
    join_at(frames, &(0..frames.len() as u64).collect::<Vec<_>>(), fps, up)
}

/// The same for frames with numbers that rise, not always by one: frame i is seen at numbers\[i]/fps, and between
/// frames whose numbers leave a gap nothing is.
///
/// Errors, panics: as [`join`]. Panics: there are more or fewer numbers than frames.
pub fn join_at(frames: &[Params], numbers: &[u64], fps: f64, up: [f64; 3]) -> Result<Scene<f32>> {
    assert_eq!(frames.len(), numbers.len(), "every frame has a number");
    assert!(fps > 0.0 && fps.is_finite(), "a sequence needs a positive number of frames per second, not {fps}");
    if frames.is_empty() {
        return Err(Error::input("a sequence needs at least one frame").remedy("Give a folder with numbered files."));
    }
    let total: usize = frames.iter().map(Params::len).sum();
    if u32::try_from(total).is_err() {
        return Err(Error::input(format!("the frames hold {total} Gaussians together, more than 2^32"))
            .remedy("Convert parts of the sequence."));
    }
    let coefficients = frames.iter().map(|f| f[SH].width() / 3).max().unwrap_or(1).min(sh::MAX_COEFFS);
    let kind = LifeKind::Interval;
    let mut params = Params::new(total, coefficients, kind.columns());
    let [geometry, colors, life] = params.get_mut([GEOMETRY, SH, LIFE]);
    let (half, soft) = ((0.5 / fps).ln() as f32, (SOFT / fps).ln() as f32);
    let mut row = 0;
    for (&number, frame) in numbers.iter().zip(frames) {
        let own = &frame[SH];
        for from in 0..frame.len() {
            geometry.write(row, 0, frame[GEOMETRY].read::<11>(from, 0));
            (0..own.width().min(3 * coefficients)).for_each(|k| colors.set(row, k, own.get(from, k)));
            life.write(row, 0, [(number as f64 / fps) as f32, half, soft]);
            row += 1;
        }
    }
    let layer = Layer::new("frames", params, Arc::new(Still), kind);
    let clip = [0.0, numbers[numbers.len() - 1] as f64 / fps];
    Ok(Scene { layers: vec![layer], clip, fps, up, ..Scene::default() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::samples::gaussians;
    use crate::layers::Evaluation;
    use crate::scene::Time;
    use crate::scene::params::OPACITY;

    #[test]
    fn each_frame_is_visible_alone_at_its_time() {
        let mut frames = [gaussians(30, 1), gaussians(20, 4), gaussians(0, 1), gaussians(10, 9)];
        for f in &mut frames {
            (0..f.len()).for_each(|row| f[GEOMETRY].set(row, OPACITY, 3.0));
        }
        let scene = join(&frames, 25.0, [0.0, -1.0, 0.0]).unwrap();
        assert_eq!((scene.clip, scene.layers[0].params[SH].width()), ([0.0, 3.0 / 25.0], 27));
        let mut instant = Evaluation::default();
        for (i, frame) in frames.iter().enumerate() {
            for off in [-0.49, 0.0, 0.3, 0.49] {
                scene.at(Time((i as f64 + off) / 25.0), &mut instant);
                let out = instant.tape(0).out();
                assert_eq!(out.rows(), frame.len(), "frame {i} {off:+}");
                if !frame.is_empty() {
                    assert_eq!(out.read::<3>(0, 0), frame[GEOMETRY].read::<3>(0, 0));
                }
            }
        }
        assert!(join(&[], 25.0, [0.0; 3]).is_err());
        // Without frame 2 the others keep their times.
        let some = [0, 1, 3].map(|i: usize| frames[i].clone());
        let gap = join_at(&some, &[0, 1, 3], 25.0, [0.0, -1.0, 0.0]).unwrap();
        assert_eq!(gap.clip, scene.clip);
        for (number, rows) in [(1.0, 20), (2.0, 0), (3.0, 10)] {
            gap.at(Time(number / 25.0), &mut instant);
            assert_eq!(instant.tape(0).out().rows(), rows, "frame {number}");
        }
    }
}
