//! Decoded samples, PNG and WebP files, and orientations of EXIF.

use image_webp::WebPDecoder;
use std::fmt::Display;
use std::io::{BufRead, Seek};

/// Decoded samples.
#[derive(Debug, PartialEq)]
pub(super) enum Samples {
    /// 8 bits per sample.
    Eight(Vec<u8>),
    /// 16 bits per sample.
    Sixteen(Vec<u16>),
}

/// A decoded image.
#[derive(Debug, PartialEq)]
pub(super) struct Raster {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// 1 grey, 2 grey and alpha, 3 RGB, 4 RGB and alpha.
    pub channels: usize,
    /// width·height·channels samples.
    pub samples: Samples,
}

impl Raster {
    /// One sample from 0 to 1.
    pub(crate) fn get(&self, pixel: usize, channel: usize) -> f32 {
        let i = pixel * self.channels + channel;
        match &self.samples {
            Samples::Eight(s) => f32::from(s[i]) / 255.0,
            Samples::Sixteen(s) => f32::from(s[i]) / 65535.0,
        }
    }

    /// The channel that holds alpha.
    pub(crate) fn alpha(&self) -> Option<usize> {
        self.channels.is_multiple_of(2).then(|| self.channels - 1)
    }

    /// The image turned and mirrored as its EXIF orientation requires.
    pub(super) fn turned(self, by: Orientation) -> Self {
        if by == Orientation::default() {
            return self;
        }
        let Self { width, height, channels, samples } = self;
        let samples = match samples {
            Samples::Eight(s) => Samples::Eight(by.apply(&s, [width, height], channels)),
            Samples::Sixteen(s) => Samples::Sixteen(by.apply(&s, [width, height], channels)),
        };
        let (width, height) = by.size((width, height));
        Self { width, height, channels, samples }
    }
}

/// How stored pixels become upright: columns and rows are exchanged, then stored columns and rows are read from their
/// ends.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Orientation {
    exchanged: bool,
    from_right: bool,
    from_bottom: bool,
}

/// Tag of the orientation, and the type of its value, 16 bits (CIPA DC-008, "Exif 2.3", 4.6.4).
const ORIENTATION_TAG: u16 = 0x0112;
const SHORT: u16 = 3;
/// Bytes of an entry: tag, type, count and value.
const ENTRY: usize = 12;

impl Orientation {
    /// The orientation in EXIF data, from the byte order on. `None`: it has none, or is damaged.
    pub(super) fn of_exif(exif: &[u8]) -> Option<Self> {
        let little = match exif.get(..4)? {
            b"II*\0" => true,
            b"MM\0*" => false,
            _ => return None,
        };
        let two = |at: usize| {
            let bytes = exif.get(at..at.checked_add(2)?)?.try_into().ok()?;
            Some(if little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) })
        };
        let four = |at: usize| {
            let [a, b] = [u32::from(two(at)?), u32::from(two(at + 2)?)];
            Some(if little { a | b << 16 } else { a << 16 | b })
        };
        let start = four(4)? as usize;
        let entries = (0..usize::from(two(start)?)).map(|k| start.saturating_add(2 + k * ENTRY));
        let mut found = entries.take_while(|&at| at.saturating_add(ENTRY) <= exif.len());
        let at = found.find(|&at| two(at) == Some(ORIENTATION_TAG))?;
        (two(at + 2)? == SHORT && four(at + 4)? == 1).then_some(())?;
        let [exchanged, from_right, from_bottom] = match two(at + 8)? {
            1 => [false, false, false],
            2 => [false, true, false],
            3 => [false, true, true],
            4 => [false, false, true],
            5 => [true, false, false],
            6 => [true, false, true],
            7 => [true, true, true],
            8 => [true, true, false],
            _ => return None,
        };
        Some(Self { exchanged, from_right, from_bottom })
    }

    /// The upright size of an image of this stored size.
    pub(super) fn size(self, (width, height): (usize, usize)) -> (usize, usize) {
        if self.exchanged { (height, width) } else { (width, height) }
    }

    fn apply<T: Copy>(self, stored: &[T], [width, height]: [usize; 2], channels: usize) -> Vec<T> {
        let (across, down) = self.size((width, height));
        let mut out = Vec::with_capacity(stored.len());
        for y in 0..down {
            for x in 0..across {
                let [column, row] = if self.exchanged { [y, x] } else { [x, y] };
                let column = if self.from_right { width - 1 - column } else { column };
                let row = if self.from_bottom { height - 1 - row } else { row };
                let at = (row * width + column) * channels;
                out.extend_from_slice(&stored[at..at + channels]);
            }
        }
        out
    }
}

/// A PNG or WebP file whose header was read.
pub(super) enum Opened<R: BufRead + Seek> {
    Png(Box<png::Reader<R>>),
    WebP(WebPDecoder<R>),
}

impl<R: BufRead + Seek> Opened<R> {
    /// Reads the header. Errors: the decoder's reason.
    pub(super) fn read(mut source: R) -> Result<Self, String> {
        const PNG: &[u8] = b"\x89PNG";
        let begin = source.fill_buf().map_err(text)?;
        if !begin.starts_with(PNG) && !begin.starts_with(b"RIFF") {
            return Err("its first bytes are those of no image".to_owned());
        }
        if begin.starts_with(PNG) {
            let mut decoder = png::Decoder::new(source);
            // Palettes, fewer than 8 bits and transparent colours become plain samples.
            decoder.set_transformations(png::Transformations::EXPAND);
            return Ok(Self::Png(Box::new(decoder.read_info().map_err(text)?)));
        }
        Ok(Self::WebP(WebPDecoder::new(source).map_err(text)?))
    }

    /// Pixels across and down, as stored.
    pub(super) fn size(&self) -> (usize, usize) {
        let (width, height) = match self {
            Self::Png(reader) => reader.info().size(),
            Self::WebP(decoder) => decoder.dimensions(),
        };
        (width as usize, height as usize)
    }

    fn channels(&self) -> usize {
        match self {
            Self::Png(reader) => reader.output_color_type().0.samples(),
            Self::WebP(decoder) => 3 + usize::from(decoder.has_alpha()),
        }
    }

    pub(super) fn has_alpha(&self) -> bool {
        self.channels().is_multiple_of(2)
    }

    /// Its EXIF orientation; none where it is damaged.
    pub(super) fn orientation(&mut self) -> Orientation {
        let of = |exif: &[u8]| Orientation::of_exif(exif).unwrap_or_default();
        match self {
            Self::Png(reader) => reader.info().exif_metadata.as_deref().map_or_else(Orientation::default, of),
            Self::WebP(decoder) => decoder.exif_metadata().ok().flatten().map_or_else(Orientation::default, |e| of(&e)),
        }
    }

    /// Decodes the pixels, as stored. Errors: the decoder's reason.
    pub(super) fn decode(self) -> Result<Raster, String> {
        let ((width, height), channels) = (self.size(), self.channels());
        let too_large = || "its pixels do not fit into memory".to_owned();
        let samples = match self {
            Self::Png(mut reader) => {
                let mut bytes = vec![0; reader.output_buffer_size().ok_or_else(too_large)?];
                let deep = reader.output_color_type().1 == png::BitDepth::Sixteen;
                reader.next_frame(&mut bytes).map_err(text)?;
                if deep {
                    Samples::Sixteen(bytes.chunks_exact(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect())
                } else {
                    Samples::Eight(bytes)
                }
            }
            Self::WebP(mut decoder) => {
                let mut bytes = vec![0; decoder.output_buffer_size().ok_or_else(too_large)?];
                decoder.read_image(&mut bytes).map_err(text)?;
                Samples::Eight(bytes)
            }
        };
        Ok(Raster { width, height, channels, samples })
    }
}

fn text(error: impl Display) -> String {
    error.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// EXIF data with an orientation, after an entry of another tag.
    fn exif(little: bool, number: u16) -> Vec<u8> {
        let two = |v: u16| if little { v.to_le_bytes() } else { v.to_be_bytes() };
        let four = |v: u32| if little { v.to_le_bytes() } else { v.to_be_bytes() };
        let mut out = if little { b"II*\0".to_vec() } else { b"MM\0*".to_vec() };
        out.extend(four(8));
        out.extend(two(2));
        for (tag, value) in [(0x0103, 9), (ORIENTATION_TAG, number)] {
            [two(tag), two(SHORT)].iter().for_each(|b| out.extend(b));
            out.extend(four(1));
            [two(value), two(0)].iter().for_each(|b| out.extend(b));
        }
        out
    }

    #[test]
    fn all_orientations_turn_pixels_as_the_image_crate_does() {
        let (width, height) = (3, 2);
        let stored: Vec<u8> = (0..width * height * 3).collect();
        for number in 1..=8 {
            let picture = image::RgbImage::from_raw(u32::from(width), u32::from(height), stored.clone()).unwrap();
            let mut theirs = image::DynamicImage::ImageRgb8(picture);
            theirs.apply_orientation(image::metadata::Orientation::from_exif(number).unwrap());
            for little in [false, true] {
                let by = Orientation::of_exif(&exif(little, number.into())).unwrap();
                let raster =
                    Raster { width: 3, height: 2, channels: 3, samples: Samples::Eight(stored.clone()) }.turned(by);
                assert_eq!([raster.width as u32, raster.height as u32], [theirs.width(), theirs.height()], "{number}");
                assert_eq!(raster.samples, Samples::Eight(theirs.to_rgb8().into_raw()), "{number}");
            }
        }
    }

    #[test]
    fn damaged_orientations_are_none() {
        let whole = exif(true, 6);
        assert!((0..whole.len()).all(|n| Orientation::of_exif(&whole[..n]).is_none()));
        assert_eq!(Orientation::of_exif(&exif(true, 9)), None);
        let mut far = whole;
        far[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
        assert_eq!(Orientation::of_exif(&far), None);
    }

    #[test]
    fn samples_are_those_that_the_image_crate_reads() {
        use image::{DynamicImage, ImageFormat};
        let shade = |x: u32, y: u32| (20 * x + 7 * y) as u8;
        let rgba = image::RgbaImage::from_fn(7, 5, |x, y| image::Rgba([shade(x, y), 9, 200, 30 * x as u8]));
        let all = DynamicImage::ImageRgba8(rgba);
        let kinds = [
            DynamicImage::ImageLuma8(all.to_luma8()),
            DynamicImage::ImageLumaA8(all.to_luma_alpha8()),
            DynamicImage::ImageRgb8(all.to_rgb8()),
            all.clone(),
            DynamicImage::ImageLuma16(all.to_luma16()),
            DynamicImage::ImageRgb16(all.to_rgb16()),
            DynamicImage::ImageRgba16(all.to_rgba16()),
        ];
        for (k, picture) in kinds.iter().enumerate() {
            for format in [ImageFormat::Png, ImageFormat::WebP] {
                // WebP has RGB and RGBA of 8 bits.
                if format == ImageFormat::WebP && !matches!(k, 2 | 3) {
                    continue;
                }
                let mut bytes = std::io::Cursor::new(Vec::new());
                picture.write_to(&mut bytes, format).unwrap();
                let bytes = bytes.into_inner();
                let opened = Opened::read(std::io::Cursor::new(&bytes)).unwrap();
                assert_eq!((opened.size(), opened.has_alpha()), ((7, 5), picture.color().has_alpha()));
                let raster = opened.decode().unwrap();
                let samples = match picture.as_flat_samples_u16() {
                    Some(flat) => Samples::Sixteen(flat.as_slice().to_vec()),
                    None => Samples::Eight(picture.as_bytes().to_vec()),
                };
                assert_eq!((raster.channels, raster.samples), (usize::from(picture.color().channel_count()), samples));
                let cut = Opened::read(std::io::Cursor::new(&bytes[..bytes.len() / 2])).and_then(Opened::decode);
                assert!(cut.is_err(), "{k} {format:?}");
            }
        }
    }

    #[test]
    fn palettes_and_few_bits_become_plain_samples() {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, 4, 1);
        encoder.set_color(png::ColorType::Indexed);
        encoder.set_depth(png::BitDepth::Two);
        encoder.set_palette(&[10, 20, 30, 40, 50, 60, 70, 80, 90, 1, 2, 3][..]);
        encoder.set_trns(&[255, 0][..]);
        encoder.write_header().unwrap().write_image_data(&[0b00_01_10_11]).unwrap();
        let raster = Opened::read(std::io::Cursor::new(bytes)).unwrap().decode().unwrap();
        let expected = [10, 20, 30, 255, 40, 50, 60, 0, 70, 80, 90, 255, 1, 2, 3, 255];
        assert_eq!((raster.channels, raster.samples), (4, Samples::Eight(expected.to_vec())));
    }
}
