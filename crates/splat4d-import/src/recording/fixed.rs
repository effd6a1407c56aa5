//! Whether a camera did not move while it recorded: such a recording contains no depth.

use crate::sync::grey::Grey;
use crate::video::{EXAMINED, Frame, Selection, Source};
use crate::{Error, ErrorKind, Result};
use splat4d::math::median_by;
use splat4d_train::event::Progress;

/// Shorter side of the examined images, pixels: codecs' noise is averaged out, and an edge is a few pixels wide.
const SIDE: usize = 240;
/// Examined frames, at least: two are alike by chance, or because a second one follows at once.
const LEAST_FRAMES: usize = 3;
/// Change of brightness from pixel to pixel, of 1, from which a pixel has texture: ten levels of 8 bits, several times
/// codecs' noise.
const TEXTURE: f32 = 0.04;
/// Pixels with texture, at least: fewer prove nothing.
const LEAST_PIXELS: usize = 200;
/// Displacement below which a pixel stays in place, pixels of [`SIDE`]: about one pixel of a 1080p recording.
const IN_PLACE: f32 = 0.25;
/// Part of the textured pixels that stay in place in every frame of a fixed camera: the rest is what moves in front of
/// it.
const BACKGROUND: f64 = 0.6;

/// Whether one fixed camera recorded the selected part: most of its textured pixels stay in place in all examined
/// frames. False where that cannot be decided. Errors: those of reading; `Interrupted`.
pub(crate) fn is_fixed(
    source: &dyn Source,
    selection: &Selection,
    progress: &mut Progress<'_>,
    stop: &dyn Fn() -> bool,
) -> Result<bool> {
    let selection = Selection { size: Some(SIDE), crop: None, ..selection.clone() };
    let (mut frame, mut images) = (Frame::default(), Vec::new());
    let mut reader = source.frames(&selection.spread(source.info()))?;
    while images.len() < EXAMINED && reader.next(&mut frame)? {
        images.push(Grey::of(&frame.picture));
        progress.phase("checking that the camera moves", images.len(), EXAMINED);
        if stop() {
            return Err(Error::new(ErrorKind::Interrupted, "stopped").remedy("Run the same command again to continue."));
        }
    }
    Ok(stays(&images))
}

/// The same of grey images of one size.
///
/// A displacement d changes the brightness of a pixel by its gradient times d. The gradient is that of the median
/// image, which shows the background where something passes in front of it.
fn stays(images: &[Grey]) -> bool {
    let Some(first) = images.first().filter(|_| images.len() >= LEAST_FRAMES) else { return false };
    let (width, height) = (first.width, first.height);
    let mut values = vec![0.0; images.len()];
    let median: Vec<f32> = (0..width * height)
        .map(|i| {
            values.iter_mut().zip(images).for_each(|(v, image)| *v = image.data[i]);
            median_by(&mut values, f32::total_cmp).unwrap_or(0.0)
        })
        .collect();
    let inner = (1..height.saturating_sub(1)).flat_map(|y| (1..width.saturating_sub(1)).map(move |x| y * width + x));
    let textured: Vec<(usize, f32)> = inner
        .map(|i| (i, 0.5 * (median[i + 1] - median[i - 1]).hypot(median[i + width] - median[i - width])))
        .filter(|(_, gradient)| *gradient >= TEXTURE)
        .collect();
    textured.len() >= LEAST_PIXELS
        && images.iter().all(|image| {
            // Exposure and flicker change all pixels alike.
            let mut changes: Vec<f32> = image.data.iter().zip(&median).map(|(v, m)| v - m).collect();
            let common = median_by(&mut changes, f32::total_cmp).unwrap_or(0.0);
            let in_place =
                |&&(i, gradient): &&(usize, f32)| (image.data[i] - median[i] - common).abs() < IN_PLACE * gradient;
            textured.iter().filter(in_place).count() as f64 >= BACKGROUND * textured.len() as f64
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    const WIDTH: usize = 160;
    const HEIGHT: usize = 120;

    /// A wall of waves, displaced by `shift` pixels and brightened by `light`; a bright square at `square` hides part
    /// of it.
    fn seen(k: usize, shift: f32, light: f32, square: Option<usize>) -> Grey {
        let rng = Rng::new(5, "wall", k as u64);
        let pixel = |i: usize| {
            let (x, y) = ((i % WIDTH) as f32 + shift, (i / WIDTH) as f32);
            let wall = 0.5 + 0.2 * (0.7 * x).sin() + 0.2 * (0.5 * y + 0.3 * x).sin();
            let hidden =
                square.is_some_and(|at| (at..at + 40).contains(&(i % WIDTH)) && (40..90).contains(&(i / WIDTH)));
            (if hidden { 0.95 } else { wall }) + light + 0.006 * rng.normal(i as u64) as f32
        };
        Grey { width: WIDTH, height: HEIGHT, data: (0..WIDTH * HEIGHT).map(pixel).collect() }
    }

    fn all(n: usize, image: impl Fn(usize) -> Grey) -> bool {
        stays(&(0..n).map(image).collect::<Vec<_>>())
    }

    #[test]
    fn a_background_in_place_is_a_fixed_camera_and_any_motion_of_it_is_not() {
        assert!(all(8, |k| seen(k, 0.0, 0.0, None)));
        assert!(all(8, |k| seen(k, 0.0, 0.0, Some(12 * k))), "something moves in front of it");
        assert!(all(8, |k| seen(k, 0.0, 0.01 * k as f32, Some(60))), "the exposure changes");
        assert!(!all(8, |k| seen(k, 0.25 * k as f32, 0.0, None)), "the camera moves slowly");
        assert!(!all(8, |k| seen(k, if k == 4 { 2.0 } else { 0.0 }, 0.0, None)), "and comes back");
        assert!(!all(2, |k| seen(k, 0.0, 0.0, None)), "two frames prove nothing");
        let flat = Grey { width: WIDTH, height: HEIGHT, data: vec![0.5; WIDTH * HEIGHT] };
        assert!(!all(8, |_| flat.clone()), "nor do walls without texture");
    }
}
