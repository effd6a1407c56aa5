//! Images of features on disk: `.npy` [height, width, channels], numbers that a network (or anything else) assigns to a
//! image's pixels, at the image's size or coarser.
//!
//! A pixel whose channels are all 0 is unknown.

use super::json;
use super::{Capture, Frame, picture};
use splat4d::format::npy::Npy;
use splat4d::scene::features::MOST_CHANNELS;
use splat4d::{Error, Result};

/// A frame's features, [channels][height][width] of its view.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Features {
    /// Channels.
    pub channels: usize,
    /// Channel after channel; all of them are 0 where nothing is known.
    pub values: Vec<f32>,
}

/// A frame's features; `None`: the frame has none.
///
/// Errors: no such array, of another shape than the image, too many channels, numbers that are none.
pub(crate) fn read(frame: &Frame, capture: &Capture) -> Result<Option<Features>> {
    let Some(path) = &frame.features else { return Ok(None) };
    let place = |e: Error| {
        let camera = &capture.cameras[frame.camera].name;
        e.at(path.display()).at(format!("camera {camera}, frame {}", frame.index))
    };
    let array = Npy::read(&json::read_bytes(path)?).map_err(place)?;
    let [height, width, channels] = array.shape[..] else {
        let what = format!("an image of features is [height, width, channels], this array is {:?}", array.shape);
        return Err(place(Error::input(what).remedy("Save it so: numpy.save(path, features.astype('f4'))")));
    };
    if !(1..=MOST_CHANNELS).contains(&channels) {
        let what = format!("the image of features has {channels} channels, 1 to {MOST_CHANNELS} are possible");
        return Err(place(
            Error::input(what).remedy("Reduce them first, all images alike: their main components are enough"),
        ));
    }
    let source = &frame.source;
    if (width, height) != (source.width, source.height) && !picture::is_resized((width, height), source) {
        let what = format!("the image of features is {width}x{height}, its image {}x{}", source.width, source.height);
        return Err(place(
            Error::input(what).remedy("Write it in the image's shape (it may be smaller or larger as a whole)"),
        ));
    }
    let values = array.to_f32();
    if let Some(i) = values.iter().position(|v| !v.is_finite()) {
        let (pixel, channel) = (i / channels, i % channels);
        let what = format!("channel {channel} at pixel ({}, {}) is {}", pixel % width, pixel / width, values[i]);
        return Err(place(Error::input(what).remedy("Write 0 in all channels where nothing is known")));
    }
    // Each pixel of the view takes the nearest one of the array: means across an edge belong to no surface.
    let (lens, k, down) = (frame.distortion(), &source.intrinsics, capture.downscale);
    let (to_width, to_height) = (source.width / down, source.height / down);
    let scale = [width as f64 / source.width as f64, height as f64 / source.height as f64];
    let mut out = vec![0.0; channels * to_width * to_height];
    for p in 0..to_width * to_height {
        let middle = |i: usize| down as f64 * (i as f64 + 0.5);
        let (x, y) = (middle(p % to_width), middle(p / to_width));
        let Some([u, v]) = lens.distort([(x - k.cx) / k.fx, (y - k.cy) / k.fy]) else { continue };
        let seen = [(k.fx * u + k.cx) * scale[0], (k.fy * v + k.cy) * scale[1]];
        if (0.0..width as f64).contains(&seen[0]) && (0.0..height as f64).contains(&seen[1]) {
            let from = (seen[1] as usize * width + seen[0] as usize) * channels;
            (0..channels).for_each(|c| out[c * to_width * to_height + p] = values[from + c]);
        }
    }
    Ok(Some(Features { channels, values: out }))
}
