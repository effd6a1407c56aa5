//! Image files: headers without pixels, and upright pixels in planes. JPEG, PNG and WebP; EXIF orientation honoured.

use super::raster::{Opened, Orientation};
pub(super) use super::raster::{Raster, Samples};
use super::{json, pose};
use crate::files;
use splat4d::scene::Camera;
use splat4d::{Error, Result};
use std::io::{BufRead, BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::Path;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;
use zune_jpeg::JpegDecoder;

/// Contents of an image's header.
pub(super) struct Header {
    /// Pixels across and down, as stored.
    pub stored: (usize, usize),
    /// Whether there is an alpha channel.
    pub alpha: bool,
    /// Orientation of the pixels from EXIF.
    orientation: Orientation,
}

impl Header {
    /// The size after its EXIF orientation is applied.
    pub(super) fn upright(&self) -> (usize, usize) {
        self.orientation.size(self.stored)
    }

    /// Whether EXIF states that pixels are to be turned or mirrored.
    pub(super) fn is_turned(&self) -> bool {
        self.orientation != Orientation::default()
    }
}

fn is_jpeg(bytes: &[u8]) -> bool {
    bytes.starts_with(&[0xFF, 0xD8])
}

/// Bytes at the start of a file that identify its format.
const HEAD: usize = 64;

/// Remedy for images of other formats.
const CONVERT: &str = "Convert the images to JPEG or PNG under the same names (for instance with ffmpeg or ImageMagick): \
                       another ending is found.";

/// Kind of an unreadable file by its first bytes, and a remedy. `None`: that is not known.
fn foreign(head: &[u8]) -> Option<(&'static str, &'static str)> {
    let format = match head {
        [] => return Some(("the file is empty (0 bytes)", "Copy or extract it again, or delete it.")),
        _ if head.starts_with(b"version https://git-lfs") => {
            return Some(("the file is a pointer of Git LFS, not the image", "Fetch the images with `git lfs pull`."));
        }
        _ if head.trim_ascii_start().starts_with(b"<") => {
            return Some(("the file is a web page or XML, not an image", "Download the image again."));
        }
        _ if head.get(4..8) == Some(b"ftyp") => match head.get(8..12).unwrap_or_default() {
            b"avif" | b"avis" => "AVIF",
            b"heic" | b"heix" | b"heim" | b"heis" | b"hevc" | b"mif1" | b"msf1" => "HEIC",
            b"crx " => "a raw photo (CR3)",
            _ => "a video",
        },
        _ if head.starts_with(b"II*\0") || head.starts_with(b"MM\0*") => "TIFF or a raw photo",
        _ if head.starts_with(b"BM") => "BMP",
        _ if head.starts_with(b"GIF8") => "GIF",
        _ if head.get(4..8) == Some(b"jP  ") => "JPEG 2000",
        _ if head.starts_with(&[0xFF, 0x0A]) || head.get(4..8) == Some(b"JXL ") => "JPEG XL",
        _ if head.starts_with(&[0x76, 0x2F, 0x31, 0x01]) => "OpenEXR",
        _ if head.starts_with(b"8BPS") => "PSD",
        [b'P', b'1'..=b'7', b' ' | b'\n' | b'\r' | b'\t', ..] => "PNM (PPM, PGM)",
        _ => return None,
    };
    Some((format, CONVERT))
}

/// Formats that begin with no mark of their own, by the ending of their files.
const BY_ENDING: [(&str, &str); 5] =
    [("tga", "TGA"), ("pcx", "PCX"), ("hdr", "Radiance HDR"), ("heic", "HEIC"), ("jxl", "JPEG XL")];

/// The format that a file's ending names.
fn by_ending(path: &Path) -> Option<&'static str> {
    let ending = path.extension()?;
    BY_ENDING.iter().find(|(e, _)| ending.eq_ignore_ascii_case(e)).map(|(_, format)| *format)
}

/// The first bytes of a file.
fn head(path: &Path) -> Vec<u8> {
    let mut head = Vec::with_capacity(HEAD);
    // A file that cannot be read has an error of its own.
    let _ = files::open(path).map(|file| file.take(HEAD as u64).read_to_end(&mut head));
    head
}

fn broken(path: &Path, detail: impl std::fmt::Display) -> Error {
    if let Some((what, remedy)) = foreign(&head(path)).or_else(|| Some((by_ending(path)?, CONVERT))) {
        let what =
            if what.starts_with("the file") { what.into() } else { format!("the image is {what}, which is not read") };
        return Error::input(what).at(path.display()).remedy(remedy);
    }
    // Some decoders' messages hold line breaks.
    let detail = detail.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
    Error::input(format!("the image is damaged, truncated or of another format than JPEG, PNG and WebP ({detail})"))
        .at(path.display())
        .remedy("Copy or extract it again, or delete it: an image that is missing is skipped.")
}

/// Reads size and channels; of the file no more than it takes.
pub(super) fn header(path: &Path) -> Result<Header> {
    let fail = |e| {
        Error::io("cannot be read", e).at(path.display()).remedy("Check that the file exists and may be read by you.")
    };
    let mut file = BufReader::new(files::open(path)?);
    let jpeg = is_jpeg(file.fill_buf().map_err(fail)?);
    let (stored, alpha, orientation) = if jpeg {
        let mut decoder = JpegDecoder::new(file);
        decoder.decode_headers().map_err(|e| broken(path, e))?;
        let info = decoder.info().ok_or_else(|| broken(path, "no header"))?;
        let orientation = decoder.exif().and_then(|e| Orientation::of_exif(e)).unwrap_or_default();
        ((usize::from(info.width), usize::from(info.height)), false, orientation)
    } else {
        let mut opened = Opened::read(file).map_err(|e| broken(path, e))?;
        (opened.size(), opened.has_alpha(), opened.orientation())
    };
    Ok(Header { stored, alpha, orientation })
}

/// Bytes at the end of a file in which its end mark is, unless something else follows.
const TAIL: u64 = 4096;

/// An error if an image's file is cut short, by its end mark; decodes an image that has none near its end.
pub(super) fn check_end(path: &Path) -> Result<()> {
    let fail = |e| Error::io("cannot be read", e).at(path.display()).remedy("Check that you may read the file.");
    let mut file = files::open(path)?;
    let length = file.metadata().map_err(fail)?.len();
    let mut head = Vec::with_capacity(HEAD);
    (&mut file).take(HEAD as u64).read_to_end(&mut head).map_err(fail)?;
    file.seek(SeekFrom::Start(length.saturating_sub(TAIL))).map_err(fail)?;
    let mut tail = Vec::new();
    file.take(TAIL).read_to_end(&mut tail).map_err(fail)?;
    let whole = match &head[..] {
        _ if is_jpeg(&head) => tail.windows(2).any(|w| w == [0xFF, 0xD9]),
        _ if head.get(1..4) == Some(b"PNG") => tail.windows(4).any(|w| w == b"IEND"),
        [b'R', b'I', b'F', b'F', a, b, c, d, ..] => u64::from(u32::from_le_bytes([*a, *b, *c, *d])) + 8 <= length,
        _ => true,
    };
    if whole {
        return Ok(());
    }
    decode(path, None).map(drop)
}

/// How far the shape of a resized image may be from the one that its intrinsics are for; more was cropped or padded.
const MAX_ASPECT_CHANGE: f64 = 0.01;

/// By how much reduced copies of images are reduced at most (`images_8`), with room.
const MAX_REDUCTION: usize = 16;

/// Whether an image of `size` is one of the camera's size that was made smaller or larger: of the same shape, but for
/// the rounding of its shorter side; or reduced by a whole number.
pub(super) fn is_resized(size: (usize, usize), camera: &Camera) -> bool {
    let whole = |side: usize, of: usize, k: usize| side == of / k || side == of.div_ceil(k);
    let reduced = |k: usize| whole(size.0, camera.width, k) && whole(size.1, camera.height, k);
    if (2..=MAX_REDUCTION).any(reduced) {
        return true;
    }
    let (width, height) = (size.0 as f64 / camera.width as f64, size.1 as f64 / camera.height as f64);
    let rounding = 1.0 / size.0.min(size.1).max(1) as f64;
    (width / height - 1.0).abs() <= rounding.min(MAX_ASPECT_CHANGE)
}

/// An error unless an image of `size` is what its camera describes.
pub(super) fn check_size(path: &Path, size: (usize, usize), camera: &Camera) -> Result<()> {
    if size == (camera.width, camera.height) {
        return Ok(());
    }
    let what = format!(
        "the image is {}x{}, but its camera's intrinsics are for {}x{}",
        size.0, size.1, camera.width, camera.height
    );
    Err(Error::input(what).at(path.display()).remedy(
        "Give the intrinsics of these images, or resize them. Where they have an EXIF orientation, --set \
         capture.exif=stored or upright selects the pixels that the intrinsics describe.",
    ))
}

/// An error unless what is next to an image, `what` in words, is of that image's size.
pub(super) fn check_companion(path: &Path, what: &str, size: (usize, usize), camera: &Camera) -> Result<()> {
    if size == (camera.width, camera.height) {
        return Ok(());
    }
    Err(Error::input(format!("the {what} is {}x{}, its image {}x{}", size.0, size.1, camera.width, camera.height))
        .at(path.display())
        .remedy("Write it in the size of the stored image"))
}

/// How many times as long as its image's the sides of a map may be; a larger one is a mistake, or a trap for memory.
const MOST_TIMES: usize = 8;

/// An error where what is next to an image, `what` in words, is far larger than that image.
pub(super) fn check_not_larger(what: &str, size: (usize, usize), camera: &Camera) -> Result<()> {
    if size.0 <= MOST_TIMES * camera.width && size.1 <= MOST_TIMES * camera.height {
        return Ok(());
    }
    let what = format!("the {what} is {}x{}, its image {}x{}", size.0, size.1, camera.width, camera.height);
    Err(Error::input(what).remedy(format!("Write it in the size of the image; at most {MOST_TIMES} times its sides.")))
}

/// Decodes what is next to an image, `what` in words. Errors before its pixels are read where its size is not that
/// of the
/// stored image.
pub(super) fn decode_companion(path: &Path, what: &str, camera: &Camera) -> Result<Raster> {
    let header = header(path)?;
    check_companion(path, what, header.upright(), camera)?;
    decode(path, None)
}

/// Decodes an image, upright. Fails before any large allocation if its size is impossible or, where given, not
/// `expected`.
pub(super) fn decode(path: &Path, expected: Option<&Camera>) -> Result<Raster> {
    decode_as(path, expected, true)
}

/// [`decode`] of pixels as stored, unless `upright`.
pub(super) fn decode_as(path: &Path, expected: Option<&Camera>, upright: bool) -> Result<Raster> {
    decode_either(&json::read_bytes(path)?, path, expected, upright)
}

/// [`decode`] of a file's bytes; errors name `path`.
pub(super) fn decode_bytes(bytes: &[u8], path: &Path, expected: Option<&Camera>) -> Result<Raster> {
    decode_either(bytes, path, expected, true)
}

fn decode_either(bytes: &[u8], path: &Path, expected: Option<&Camera>, upright: bool) -> Result<Raster> {
    let kept = |orientation: Orientation| if upright { orientation } else { Orientation::default() };
    if is_jpeg(bytes) { decode_jpeg(bytes, path, expected, kept) } else { decode_other(bytes, path, expected, kept) }
}

fn admit(path: &Path, size: (usize, usize), expected: Option<&Camera>) -> Result<()> {
    match expected {
        Some(camera) => check_size(path, size, camera),
        None => pose::check_size(size.0, size.1).map_err(|e| e.at(path.display())),
    }
}

fn decode_jpeg(
    bytes: &[u8],
    path: &Path,
    expected: Option<&Camera>,
    kept: impl Fn(Orientation) -> Orientation,
) -> Result<Raster> {
    if !jpeg_ends(bytes) {
        return Err(broken(path, "the end-of-image mark is missing"));
    }
    let options = DecoderOptions::default()
        .set_max_width(pose::MAX_SIDE)
        .set_max_height(pose::MAX_SIDE)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(Cursor::new(bytes), options);
    decoder.decode_headers().map_err(|e| broken(path, e))?;
    let info = decoder.info().ok_or_else(|| broken(path, "no header"))?;
    let orientation = kept(decoder.exif().and_then(|e| Orientation::of_exif(e)).unwrap_or_default());
    let (width, height) = (usize::from(info.width), usize::from(info.height));
    admit(path, orientation.size((width, height)), expected)?;
    let pixels = decoder.decode().map_err(|e| broken(path, e))?;
    if pixels.len() != 3 * width * height {
        return Err(broken(path, "fewer pixels than its header states"));
    }
    Ok(Raster { width, height, channels: 3, samples: Samples::Eight(pixels) }.turned(orientation))
}

/// Whether a JPEG's data is followed by its end mark. The decoder fills what is missing with grey, so that a truncated
/// file would pass unnoticed. Inside the data FF is always followed by 00 or a restart mark, so FF D9 is the end.
fn jpeg_ends(bytes: &[u8]) -> bool {
    const START_OF_SCAN: u8 = 0xDA;
    let mut at = 2;
    while at + 4 <= bytes.len() {
        if bytes[at] != 0xFF {
            // Not a marker: leave the verdict to the decoder, and search for the end from here.
            break;
        }
        let marker = bytes[at + 1];
        if marker == 0xFF {
            at += 1;
            continue;
        }
        if marker == START_OF_SCAN {
            break;
        }
        at += 2 + usize::from(u16::from_be_bytes([bytes[at + 2], bytes[at + 3]]));
    }
    bytes.get(at..).is_some_and(|rest| rest.windows(2).any(|w| w == [0xFF, 0xD9]))
}

fn decode_other(
    bytes: &[u8],
    path: &Path,
    expected: Option<&Camera>,
    kept: impl Fn(Orientation) -> Orientation,
) -> Result<Raster> {
    let mut opened = Opened::read(Cursor::new(bytes)).map_err(|e| broken(path, e))?;
    let orientation = kept(opened.orientation());
    admit(path, orientation.size(opened.size()), expected)?;
    Ok(opened.decode().map_err(|e| broken(path, e))?.turned(orientation))
}

/// The largest number that is a label, not a brightness.
const LABELS: u16 = 16;

/// A mask's values from 0 to 1, one per pixel, from the alpha channel if `use_alpha`, else from the first channel.
///
/// Some tools write masks of zeros and ones, or of the numbers of labels: where no value is above 16, all but 0 count
/// as white. Others write the mask into the alpha of an image of one colour.
pub(super) fn mask_values(raster: &Raster, use_alpha: bool) -> Vec<f32> {
    let n = raster.width * raster.height;
    let of = |channel: usize, p: usize| match &raster.samples {
        Samples::Eight(s) => u16::from(s[p * raster.channels + channel]),
        Samples::Sixteen(s) => s[p * raster.channels + channel],
    };
    let even = |channel: usize| (1..n).all(|p| of(channel, p) == of(channel, 0));
    let in_alpha = raster.alpha().filter(|&alpha| use_alpha || even(0) && !even(alpha));
    let channel = in_alpha.unwrap_or(0);
    if !use_alpha && (0..n).all(|p| of(channel, p) <= LABELS) {
        return (0..n).map(|p| f32::from(u8::from(of(channel, p) > 0))).collect();
    }
    (0..n).map(|p| raster.get(p, channel)).collect()
}

/// Whether a mask (or, with `use_alpha`, an image's alpha channel) shows anything. Images without alpha do.
pub(super) fn any_foreground(path: &Path, use_alpha: bool) -> Result<bool> {
    let raster = decode(path, None)?;
    if use_alpha && raster.alpha().is_none() {
        return Ok(true);
    }
    Ok(mask_values(&raster, use_alpha).iter().any(|&v| v > 0.0))
}
