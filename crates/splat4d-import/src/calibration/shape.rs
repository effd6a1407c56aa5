//! A calibrated camera for images of another size: halved, padded by a codec, or with black bars.

use super::Calibrated;
use splat4d::scene::{Intrinsics, Planes};
use splat4d::{Error, Result};

/// Pixels that a side may differ from the calibrated shape: sides are whole.
const ROUNDING: f64 = 1.0;
/// Pixels to whose multiples codecs pad the sides of images, right and below (H.264's macroblocks); programs cut
/// that off or
/// leave it.
const BLOCK: usize = 16;
/// Of a side, the most that bars take: a wide film in a square image.
const MOST_BARS: f64 = 0.45;
/// Pixels of the stored images that bars may be wider or narrower than they should.
const BAR_ROUNDING: f64 = 3.0;

/// Relation of a video of another size to the calibrated images.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// Scaled as a whole.
    Scaled,
    /// The same size; a codec's padding is removed or kept.
    Padded,
    /// Perhaps scaled to fit, with this many pixels of the video in bars at the sides, and above and below.
    Boxed([f64; 2]),
}

/// Possible relations of a video to the calibrated images.
///
/// Errors: it is of another shape.
pub(crate) fn shape(camera: &Calibrated, video: [usize; 2]) -> Result<Shape> {
    let size = camera.size.unwrap_or(video);
    let [w, h] = size.map(|v| v as f64);
    let [vw, vh] = video.map(|v| v as f64);
    // Either side, had the other decided about the scale.
    let off = (vw - w * vh / h).abs().min((vh - h * vw / w).abs());
    if off <= ROUNDING {
        return Ok(Shape::Scaled);
    }
    let turned = (vh - w * vw / h).abs() <= ROUNDING;
    let scale = (vw / w).min(vh / h);
    let bars = [vw - scale * w, vh - scale * h];
    if !turned && bars[0] <= MOST_BARS * vw && bars[1] <= MOST_BARS * vh {
        return Ok(Shape::Boxed(bars));
    }
    let advice = if turned {
        "The video is turned against the calibration: turn it as it was when the camera was calibrated."
    } else {
        ADVICE
    };
    Err(Error::input(sizes(size, video)).remedy(advice))
}

const ADVICE: &str = "Images of another shape were cut or padded, which changes the principal point: give the video \
                      as it was when the camera was calibrated, or correct size and principal point in the \
                      calibration.";

fn sizes(size: [usize; 2], video: [usize; 2]) -> String {
    format!("the video has {}x{} pixels, the calibration is for {}x{}", video[0], video[1], size[0], size[1])
}

/// The camera for images of a video's size that are stored in another one, where this many pixels of the stored images
/// are black bars: at the left, above, at the right, below. And what that means, a sentence, where it is not plain.
///
/// Errors: the video is of another shape than the images it was calibrated with, and neither bars nor padding explain
/// why; the principal point is outside.
pub(crate) fn fitted(
    camera: &Calibrated,
    video: [usize; 2],
    stored: [usize; 2],
    bars: [f64; 4],
) -> Result<(Calibrated, Option<String>)> {
    let size = camera.size.unwrap_or(video);
    let [w, h] = size.map(|v| v as f64);
    let to_stored = [stored[0] as f64 / video[0] as f64, stored[1] as f64 / video[1] as f64];
    // What a calibrated pixel becomes in the stored images.
    let (mut scale, mut shift) = ([stored[0] as f64 / w, stored[1] as f64 / h], [0.0; 2]);
    let mut note = None;
    if let Shape::Boxed(expected) = shape(camera, video)? {
        let expected: [f64; 2] = std::array::from_fn(|k| expected[k] * to_stored[k]);
        let found = [bars[0] + bars[2], bars[1] + bars[3]];
        let boxed = (0..2).all(|k| (found[k] - expected[k]).abs() <= BAR_ROUNDING) && found[0].max(found[1]) > 0.0;
        let blocks = |sides: [usize; 2]| sides.map(|v| v.div_ceil(BLOCK));
        if boxed {
            scale = std::array::from_fn(|k| (stored[k] as f64 - expected[k]) / [w, h][k]);
            shift = std::array::from_fn(|k| if found[k] > 0.0 { expected[k] * bars[k] / found[k] } else { 0.0 });
            note = Some(format!(
                "images are smaller and have black bars ({:.0} px at the sides, {:.0} above and below); the \
                 calibration was corrected accordingly",
                found[0], found[1]
            ));
        } else if blocks(size) == blocks(video) {
            scale = to_stored;
            note = Some(format!(
                "{}: sides are padded to multiples of {BLOCK} by codecs, and the difference is taken to lie right and below",
                sizes(size, video)
            ));
        } else {
            return Err(Error::input(format!("{}, and no black bars explain it", sizes(size, video))).remedy(ADVICE));
        }
    }
    let k = &camera.intrinsics;
    if !(0.0..=w).contains(&k.cx) || !(0.0..=h).contains(&k.cy) {
        return Err(Error::input(format!(
            "its principal point ({:.0}, {:.0}) lies outside of images of {}x{}",
            k.cx, k.cy, size[0], size[1]
        ))
        .remedy("It was calibrated with larger images: write their size into the calibration (size, image_width)."));
    }
    let [sx, sy] = scale;
    let intrinsics = Intrinsics { fx: k.fx * sx, fy: k.fy * sy, cx: k.cx * sx + shift[0], cy: k.cy * sy + shift[1] };
    Ok((Calibrated { intrinsics, size: Some(stored), ..camera.clone() }, note))
}

/// Pixels of black bars at the left, above, at the right and below, that all these grey images of one size have.
pub(crate) fn bars(pictures: &[Planes<f32>]) -> [f64; 4] {
    /// In [0, 1]: what is brighter in the mean of a line, or anywhere in it, is not a bar. Codecs make black noisy.
    const MEAN: f32 = 0.1;
    const ANY: f32 = 0.25;
    let Some(first) = pictures.first() else { return [0.0; 4] };
    let (w, h) = (first.width, first.height);
    let line = |of: &dyn Fn(usize) -> usize, count: usize| {
        pictures.iter().all(|p| {
            let values = (0..count).map(|k| p.data[of(k)]);
            let (sum, most) = values.fold((0.0f32, 0.0f32), |(s, m), v| (s + v, m.max(v)));
            sum < MEAN * count as f32 && most < ANY
        })
    };
    let row = |y: usize| line(&|x| y * w + x, w);
    let column = |x: usize| line(&|y| y * w + x, h);
    let width = |n: usize, black: &dyn Fn(usize) -> bool| (0..n).take_while(|&k| black(k)).count() as f64;
    [width(w, &column), width(h, &row), width(w, &|x| column(w - 1 - x)), width(h, &|y| row(h - 1 - y))]
}
