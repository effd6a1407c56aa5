//! Numbers of images for networks, and maps in other sizes.

use super::describe::{Channels, Description, InputLayout};
use super::network::Tensor;
use splat4d_train::capture::Rgb8;
use splat4d_train::encode;
use std::borrow::Cow;

/// Values of a map: [channels, height, width].
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// Channels.
    pub channels: usize,
    /// Pixels down.
    pub height: usize,
    /// Pixels across.
    pub width: usize,
    /// Its numbers.
    pub values: Vec<f32>,
}

impl Map {
    /// One channel.
    pub fn plane(&self, channel: usize) -> &[f32] {
        let n = self.width * self.height;
        &self.values[channel * n..(channel + 1) * n]
    }

    /// In another size: linear between the centres of pixels. Where a neighbour is not finite, the nearest pixel.
    pub(crate) fn resized(&self, width: usize, height: usize) -> Map {
        if (self.width, self.height) == (width, height) {
            return self.clone();
        }
        let place = |to: usize, side: usize, of: usize| {
            let at = ((to as f64 + 0.5) * of as f64 / side as f64 - 0.5).clamp(0.0, (of - 1) as f64);
            let low = (at as usize).min(of.saturating_sub(2));
            (low, (low + 1).min(of - 1), (at - low as f64) as f32)
        };
        let columns: Vec<(usize, usize, f32)> = (0..width).map(|x| place(x, width, self.width)).collect();
        let mut values = Vec::with_capacity(self.channels * width * height);
        for c in 0..self.channels {
            let plane = self.plane(c);
            for y in 0..height {
                let (top, bottom, down) = place(y, height, self.height);
                for &(left, right, across) in &columns {
                    let [a, b] = [top, bottom].map(|row| {
                        let [l, r] = [left, right].map(|column| plane[row * self.width + column]);
                        l + (r - l) * across
                    });
                    let value = a + (b - a) * down;
                    let nearest = || {
                        let [row, column] =
                            [if down < 0.5 { top } else { bottom }, if across < 0.5 { left } else { right }];
                        plane[row * self.width + column]
                    };
                    values.push(if value.is_finite() { value } else { nearest() });
                }
            }
        }
        Map { channels: self.channels, height, width, values }
    }
}

/// An image in another size.
pub(super) fn scaled(image: &Rgb8, [width, height]: [usize; 2]) -> Cow<'_, Rgb8> {
    if (image.width, image.height) == (width, height) {
        return Cow::Borrowed(image);
    }
    let data = encode::resample(&image.data, 3, [image.width, image.height], [width, height]);
    Cow::Owned(Rgb8 { width, height, data })
}

/// A window of images as the input of a network, [n, c, h, w] or [n, h, w, c]. Pixels outside an image are its nearest.
pub(super) fn tensor(images: &[(&Rgb8, [usize; 2])], [width, height]: [usize; 2], description: &Description) -> Tensor {
    let (input, channels) = (&description.input, description.depth());
    let order: &[usize] = match input.channels {
        Channels::Rgb => &[0, 1, 2],
        Channels::Bgr => &[2, 1, 0],
        Channels::Grey => &[0],
    };
    let pixels = width * height;
    let mut data = vec![0.0; images.len() * channels * pixels];
    for ((image, [x0, y0]), out) in images.iter().zip(data.chunks_exact_mut(channels * pixels)) {
        for p in 0..pixels {
            let [x, y] = [(x0 + p % width).min(image.width - 1), (y0 + p / width).min(image.height - 1)];
            let at = 3 * (y * image.width + x);
            let rgb = &image.data[at..at + 3];
            for (c, &k) in order.iter().enumerate() {
                let value = match input.channels {
                    Channels::Grey => 0.299 * f32::from(rgb[0]) + 0.587 * f32::from(rgb[1]) + 0.114 * f32::from(rgb[2]),
                    _ => f32::from(rgb[k]),
                };
                let value = (value / 255.0 * input.range - input.mean[c]) / input.std[c];
                let slot = if input.layout == InputLayout::Nchw { c * pixels + p } else { p * channels + c };
                out[slot] = value;
            }
        }
    }
    let n = images.len();
    let shape = match input.layout {
        InputLayout::Nchw => vec![n, channels, height, width],
        InputLayout::Nhwc => vec![n, height, width, channels],
    };
    Tensor { shape, data }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_are_resized_about_their_centres() {
        let map = Map { channels: 1, height: 1, width: 4, values: vec![0.0, 1.0, 2.0, 3.0] };
        assert_eq!(map.resized(2, 1).values, [0.5, 2.5]);
        assert_eq!(map.resized(8, 1).values[1..7], [0.25, 0.75, 1.25, 1.75, 2.25, 2.75]);
        let broken = Map { values: vec![0.0, f32::NAN, 2.0, 3.0], ..map };
        assert_eq!(broken.resized(8, 1).values.iter().filter(|v| v.is_nan()).count(), 2);
    }
}
