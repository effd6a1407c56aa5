//! Images of 8 or 16 bits as PNG and JPEG files in memory, and in another size.

use jpeg_encoder::{ColorType as Order, Encoder, SamplingFactor};
use png::{BitDepth, ColorType, Compression, Filter};
use splat4d::{Error, Result};

/// Samples of an image, pixel by pixel.
#[derive(Clone, Copy, Debug)]
pub enum Pixels<'a> {
    /// 8 bits each.
    Eight(&'a [u8]),
    /// 16 bits each.
    Sixteen(&'a [u16]),
}

/// A PNG of 1 (grey), 2 (grey and alpha), 3 (RGB) or 4 channels (RGB and alpha), compressed fast.
///
/// Panics: there are not width·height·channels samples, or none.
pub fn png(pixels: Pixels<'_>, [width, height]: [usize; 2], channels: usize) -> Vec<u8> {
    let color = match channels {
        1 => ColorType::Grayscale,
        2 => ColorType::GrayscaleAlpha,
        3 => ColorType::Rgb,
        _ => ColorType::Rgba,
    };
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width as u32, height as u32);
    encoder.set_color(color);
    encoder.set_compression(Compression::Fast);
    encoder.set_filter(Filter::Adaptive);
    encoder.set_depth(if matches!(pixels, Pixels::Eight(_)) { BitDepth::Eight } else { BitDepth::Sixteen });
    let write = |encoder: png::Encoder<'_, _>| match pixels {
        Pixels::Eight(samples) => encoder.write_header()?.write_image_data(samples),
        Pixels::Sixteen(samples) => {
            let samples: Vec<u8> = samples.iter().flat_map(|s| s.to_be_bytes()).collect();
            encoder.write_header()?.write_image_data(&samples)
        }
    };
    write(encoder).expect("an image in memory with all of its samples can be encoded");
    bytes
}

/// A JPEG of RGB samples, colours in full resolution; `quality` from 1 to 100.
///
/// Errors: a side of 0 or more than 65,535 pixels, which JPEG cannot have.
pub fn jpeg(rgb: &[u8], [width, height]: [usize; 2], quality: u8) -> Result<Vec<u8>> {
    let fail = || {
        Error::input(format!("an image of {width}x{height} cannot be a JPEG"))
            .remedy("Its sides must have 1 to 65535 pixels.")
    };
    let [Ok(across), Ok(down)] = [width, height].map(u16::try_from) else { return Err(fail()) };
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, quality);
    encoder.set_sampling_factor(SamplingFactor::F_1_1);
    encoder.encode(rgb, across, down, Order::Rgb).map_err(|_| fail())?;
    Ok(bytes)
}

/// Weights of the samples of one side that a sample of the other size is made of, from the first one on.
fn weights(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let scale = from as f32 / to as f32;
    // Smaller images average as many samples as they leave out.
    let widen = scale.max(1.0);
    (0..to)
        .map(|k| {
            let centre = (k as f32 + 0.5) * scale;
            let first = (centre - REACH * widen).max(0.0) as usize;
            let last = ((centre + REACH * widen).ceil() as usize).min(from);
            let mut w: Vec<f32> = (first..last).map(|i| catmull_rom((i as f32 + 0.5 - centre) / widen)).collect();
            let sum: f32 = w.iter().sum();
            w.iter_mut().for_each(|w| *w /= sum);
            (first, w)
        })
        .collect()
}

/// Samples on each side of a sample that [`catmull_rom`] reaches.
const REACH: f32 = 2.0;

/// The cubic of Catmull and Rom: Keys' with a = −1/2 (Keys 1981, eq. 4).
fn catmull_rom(x: f32) -> f32 {
    let x = x.abs();
    match x {
        _ if x < 1.0 => (1.5 * x - 2.5) * x * x + 1.0,
        _ if x < 2.0 => ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0,
        _ => 0.0,
    }
}

/// An image of `channels` channels in another size, by Catmull and Rom's cubic along rows and columns, widened where
/// the image becomes smaller.
///
/// Panics: there are not width·height·channels samples, or none.
pub fn resample(samples: &[u8], channels: usize, from: [usize; 2], to: [usize; 2]) -> Vec<u8> {
    assert_eq!(samples.len(), from[0] * from[1] * channels, "an image has width·height·channels samples");
    let (columns, rows) = (weights(from[0], to[0]), weights(from[1], to[1]));
    let stride = from[0] * channels;
    let mut row = vec![0f32; stride];
    let mut out = Vec::with_capacity(to[0] * to[1] * channels);
    for (first, w) in &rows {
        row.fill(0.0);
        for (k, w) in w.iter().enumerate() {
            let source = &samples[(first + k) * stride..][..stride];
            row.iter_mut().zip(source).for_each(|(sum, s)| *sum += w * f32::from(*s));
        }
        for (first, w) in &columns {
            for c in 0..channels {
                let at = |k: usize| row[(first + k) * channels + c];
                let sum: f32 = w.iter().enumerate().map(|(k, w)| w * at(k)).sum();
                out.push(sum.round().clamp(0.0, 255.0) as u8);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(width: usize, height: usize, channels: usize) -> Vec<u8> {
        let value = |i: usize| (i / channels % width * 5 + i / channels / width * 3 + 40 * (i % channels)) as u8;
        (0..width * height * channels).map(value).collect()
    }

    #[test]
    fn stored_pngs_are_read_with_their_very_samples() {
        for channels in 1..=4 {
            let samples = ramp(9, 7, channels);
            let read = image::load_from_memory(&png(Pixels::Eight(&samples), [9, 7], channels)).unwrap();
            assert_eq!((read.color().channel_count() as usize, read.as_bytes()), (channels, &samples[..]));
            let deep: Vec<u16> = samples.iter().map(|&s| 257 * u16::from(s) + 3).collect();
            let read = image::load_from_memory(&png(Pixels::Sixteen(&deep), [9, 7], channels)).unwrap();
            assert_eq!(read.as_flat_samples_u16().unwrap().as_slice(), deep);
        }
    }

    #[test]
    fn stored_jpegs_keep_colours_and_impossible_sizes_are_refused() {
        let rgb: Vec<u8> = (0..32 * 24).flat_map(|p| if p % 2 == 0 { [200, 30, 40] } else { [30, 40, 200] }).collect();
        let read = image::load_from_memory(&jpeg(&rgb, [32, 24], 95).unwrap()).unwrap().to_rgb8();
        assert_eq!((read.width(), read.height()), (32, 24));
        let worst = read.as_raw().iter().zip(&rgb).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        assert!(worst < 40, "{worst}: alternating colours survive only in full resolution");
        assert!(jpeg(&[], [0, 4], 95).unwrap_err().to_string().contains("0x4"));
        assert!(jpeg(&[], [70_000, 4], 95).is_err());
    }

    #[test]
    fn other_sizes_are_close_to_those_of_the_image_crate() {
        use image::imageops::{FilterType, resize};
        let picture = image::RgbImage::from_raw(40, 30, ramp(40, 30, 3)).unwrap();
        for [width, height] in [[20, 15], [13, 29], [80, 45], [1, 1]] {
            let theirs = resize(&picture, width, height, FilterType::CatmullRom).into_raw();
            let ours = resample(picture.as_raw(), 3, [40, 30], [width as usize, height as usize]);
            let worst = ours.iter().zip(&theirs).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
            assert!(worst <= 1, "{width}x{height}: {worst}");
        }
        assert_eq!(resample(&[7; 12], 1, [4, 3], [2, 2]), [7; 4]);
    }
}
