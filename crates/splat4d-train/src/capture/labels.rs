//! Label masks on disk: grey images of 8 or 16 bits whose values number the capture's labels.
//!
//! The largest value of the depth (255 or 65535) represents what is not labelled.

use super::lens::Distortion;
use super::picture::{self, Samples};
use super::{Capture, Frame};
use splat4d::scene::Camera;
use splat4d::scene::labels::MOST_LABELS;
use splat4d::{Error, Result};
use std::path::Path;

/// The label of a pixel that has none.
pub(crate) const UNKNOWN: u8 = u8::MAX;
const _: () = assert!(MOST_LABELS <= UNKNOWN as usize);

/// A frame's labels, [height, width] of its view, [`UNKNOWN`] where there is none; `None`: the frame has no mask of
/// labels.
///
/// Errors: the mask is no image, of another size than the frame's image, in colour, or has a value without a name.
pub(crate) fn read(frame: &Frame, capture: &Capture) -> Result<Option<Vec<u8>>> {
    let Some(path) = &frame.labels else { return Ok(None) };
    let place = |e: Error| {
        let camera = &capture.cameras[frame.camera].name;
        e.at(format!("camera {camera}, frame {}", frame.index))
    };
    let (source, k) = (&frame.source, capture.downscale);
    let full = straighten(decode(path, source, capture.labels.len()).map_err(place)?, source, &frame.distortion());
    let (width, height) = (source.width / k, source.height / k);
    let pixel = |p: usize| {
        let first = (p / width * k) * source.width + p % width * k;
        let label = full[first];
        // A pixel that is half the one and half the other is neither.
        let whole = (0..k * k).all(|i| full[first + i / k * source.width + i % k] == label);
        if whole { label } else { UNKNOWN }
    };
    Ok(Some((0..width * height).map(pixel).collect()))
}

fn decode(path: &Path, camera: &Camera, count: usize) -> Result<Vec<u8>> {
    let raster = picture::decode_companion(path, "mask of labels", camera)?;
    let remedy = "Write grey PNGs of 8 or 16 bits: 0 for the first label of `labels`, 1 for the second, and the \
                  largest value (255, 65535) where the label is unknown";
    let n = raster.width * raster.height;
    let grey = |at: &dyn Fn(usize, usize) -> u16| {
        raster.channels < 3 || (0..n).all(|p| at(p, 0) == at(p, 1) && at(p, 0) == at(p, 2))
    };
    let (values, unknown): (Vec<u16>, u16) = match &raster.samples {
        Samples::Eight(s) => {
            let at = |p: usize, c: usize| u16::from(s[p * raster.channels + c]);
            if !grey(&at) {
                return Err(Error::input("the mask of labels is in colour").at(path.display()).remedy(remedy));
            }
            ((0..n).map(|p| at(p, 0)).collect(), u16::from(u8::MAX))
        }
        Samples::Sixteen(s) => {
            let at = |p: usize, c: usize| s[p * raster.channels + c];
            if !grey(&at) {
                return Err(Error::input("the mask of labels is in colour").at(path.display()).remedy(remedy));
            }
            ((0..n).map(|p| at(p, 0)).collect(), u16::MAX)
        }
    };
    if let Some(p) = values.iter().position(|&v| v != unknown && usize::from(v) >= count) {
        let [x, y] = [p % raster.width, p / raster.width];
        let what = format!("pixel ({x}, {y}) has label {}, and the capture names {count}", values[p]);
        return Err(Error::input(what).at(path.display()).remedy(remedy));
    }
    Ok(values.into_iter().map(|v| if v == unknown { UNKNOWN } else { v as u8 }).collect())
}

/// From the distorted image to the pinhole view: the label of the nearest pixel.
fn straighten(labels: Vec<u8>, camera: &Camera, lens: &Distortion) -> Vec<u8> {
    if lens.is_pinhole() {
        return labels;
    }
    let k = &camera.intrinsics;
    let pixel = |p: usize| {
        let (x, y) = ((p % camera.width) as f64 + 0.5, (p / camera.width) as f64 + 0.5);
        let [u, v] = lens.distort([(x - k.cx) / k.fx, (y - k.cy) / k.fy])?;
        let seen = [k.fx * u + k.cx, k.fy * v + k.cy];
        let inside = (0.0..camera.width as f64).contains(&seen[0]) && (0.0..camera.height as f64).contains(&seen[1]);
        inside.then(|| labels[seen[1] as usize * camera.width + seen[0] as usize])
    };
    (0..labels.len()).map(|p| pixel(p).unwrap_or(UNKNOWN)).collect()
}
