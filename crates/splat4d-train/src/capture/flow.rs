//! Known optical flow on disk: 16-bit RGB images as in KITTI 2012 (Geiger et al.): red is 64 u + 32768, green is
//! 64 v + 32768, u right and v down in pixels, and blue is not zero where they are known; `.flo` (Baker et al. 2007,
//! Middlebury) and `.npy`, as networks write them.
//!
//! A frame's file contains the displacement of its pixels to the next frame of its camera. In memory all keep KITTI's
//! code, for the pinhole view.

use super::json;
use super::lens::Distortion;
use super::picture::{self, Samples};
use super::{Capture, Frame};
use splat4d::format::npy::Npy;
use splat4d::scene::{Camera, Planes};
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

/// Codes a pixel.
const PER_PIXEL: f64 = 64.0;
/// The code of no motion.
const ZERO: f64 = 32768.0;
/// First four bytes of a .flo file, a float in little-endian order.
const FLO_MARK: f32 = 202_021.25;
/// Vectors from here on are not known (Middlebury's own code).
const FLO_UNKNOWN: f32 = 1e9;
/// u and v in code, and whether they are known.
type Code = [u16; 3];

/// The flow of a frame: its file, and where it leads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FlowFile {
    /// The image.
    pub path: PathBuf,
    /// The number, in `Capture::frames`, of the frame at which the pixels arrive: the next one of the same camera.
    pub to: usize,
    /// Whether it is flow of the view, from this program, and not of the stored image.
    pub of_view: bool,
}

/// A frame's flow in code, [3, height, width] of its view. Errors: the file is none, or of another size than the image.
pub(super) fn read(file: &FlowFile, frame: &Frame, capture: &Capture) -> Result<Vec<u16>> {
    let (source, k) = (&frame.source, capture.downscale);
    if file.of_view {
        let codes = decode(&file.path, &frame.view)?;
        return Ok((0..3).flat_map(|c| codes.iter().map(move |code| code[c])).collect());
    }
    let codes = decode(&file.path, source)?;
    let codes = straighten(codes, source, &capture.frames[file.to].source);
    let (width, height) = (source.width / k, source.height / k);
    let mut out = vec![0; 3 * width * height];
    for p in 0..width * height {
        let first = (p / width * k) * source.width + p % width * k;
        let box_ = (0..k * k).map(|i| codes[first + i / k * source.width + i % k]);
        // The means of k×k boxes, as images are reduced, in pixels that are k times as large.
        let mean = |c: usize| box_.clone().map(|code| f64::from(code[c]) - ZERO).sum::<f64>() / (k * k * k) as f64;
        if box_.clone().all(|code| code[2] != 0) {
            (0..2).for_each(|c| out[c * width * height + p] = (mean(c) + ZERO).round() as u16);
            out[2 * width * height + p] = 1;
        }
    }
    Ok(out)
}

/// The flow of a frame alone, [3, height, width] of its view: u, v and 1 where they are known; `None`: it has none.
///
/// Errors: the file is none, or of another size than the image.
pub(crate) fn vectors(frame: &Frame, capture: &Capture) -> Result<Option<Planes<f32>>> {
    let Some(file) = &frame.flow else { return Ok(None) };
    let camera = &capture.cameras[frame.camera].name;
    let codes = read(file, frame, capture).map_err(|e| e.at(format!("camera {camera}, frame {}", frame.index)))?;
    let mut out = Planes::default();
    decode_into(&codes, frame.view.width, frame.view.height, &mut out);
    Ok(Some(out))
}

/// Pixels from code: [3, height, width] of u, v and 1 where they are known.
pub(super) fn decode_into(codes: &[u16], width: usize, height: usize, out: &mut Planes<f32>) {
    (out.channels, out.height, out.width) = (3, height, width);
    out.data.clear();
    let (vectors, known) = codes.split_at(2 * width * height);
    let vector =
        |(&code, &known): (&u16, &u16)| if known == 0 { 0.0 } else { ((f64::from(code) - ZERO) / PER_PIXEL) as f32 };
    out.data.extend(vectors.iter().zip(known.iter().cycle()).map(vector));
    out.data.extend(known.iter().map(|&k| f32::from(k)));
}

fn decode(path: &Path, camera: &Camera) -> Result<Vec<Code>> {
    match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
        Some("flo") => decode_flo(path, camera),
        Some("npy") => decode_npy(path, camera),
        _ => decode_picture(path, camera),
    }
}

/// Vectors as code. What is too far for code is not known. Errors: vectors that are not finite.
fn encode(path: &Path, width: usize, vectors: impl Iterator<Item = [f32; 3]>) -> Result<Vec<Code>> {
    let code = |(p, [u, v, known]): (usize, [f32; 3])| {
        if u.is_nan() || v.is_nan() {
            let what = format!("the flow at pixel ({}, {}) is not a number", p % width, p / width);
            return Err(Error::input(what)
                .at(path.display())
                .remedy("Write 1e10 (.flo), or 0 into a third channel (.npy), where flow is not known"));
        }
        let codes = [u, v].map(|x| (f64::from(x) * PER_PIXEL + ZERO).round());
        let fits = codes.iter().all(|c| (0.0..=f64::from(u16::MAX)).contains(c));
        let known = known != 0.0 && u.abs().max(v.abs()) < FLO_UNKNOWN && fits;
        Ok(if known { [codes[0] as u16, codes[1] as u16, 1] } else { Code::default() })
    };
    vectors.enumerate().map(code).collect()
}

fn decode_flo(path: &Path, camera: &Camera) -> Result<Vec<Code>> {
    let bytes = json::read_bytes(path)?;
    let word = |k: usize| bytes.get(4 * k..4 * k + 4).map(|b| [b[0], b[1], b[2], b[3]]);
    let bad = |what: String| Error::input(what).at(path.display()).remedy("Write it again, or leave it out");
    let (Some(mark), Some(width), Some(height)) = (word(0), word(1), word(2)) else {
        return Err(bad("the .flo file is cut short".into()));
    };
    if f32::from_le_bytes(mark) != FLO_MARK {
        return Err(bad("not a .flo file: it does not start with 202021.25".into()));
    }
    let [width, height] = [width, height].map(|side| i32::from_le_bytes(side).max(0) as usize);
    picture::check_companion(path, "flow", (width, height), camera)?;
    let body = &bytes[12..];
    if body.len() < 8 * width * height {
        return Err(bad(format!("the .flo file is cut short: {} bytes for {width}x{height} vectors", body.len())));
    }
    let numbers = body.as_chunks::<8>().0.iter().take(width * height);
    let vectors = numbers
        .map(|b| [f32::from_le_bytes([b[0], b[1], b[2], b[3]]), f32::from_le_bytes([b[4], b[5], b[6], b[7]]), 1.0]);
    encode(path, width, vectors)
}

/// [h, w, 2] or [2, h, w], with a third channel where it states what is known.
fn decode_npy(path: &Path, camera: &Camera) -> Result<Vec<Code>> {
    let array = Npy::read(&json::read_bytes(path)?).map_err(|e| e.at(path.display()))?;
    let (height, width, channels, first) = match array.shape[..] {
        [h, w, c @ (2 | 3)] => (h, w, c, false),
        [c @ (2 | 3), h, w] | [1, c @ (2 | 3), h, w] => (h, w, c, true),
        _ => {
            return Err(Error::input(format!(
                "flow is [height, width, 2] or [2, height, width], not {:?}",
                array.shape
            ))
            .at(path.display())
            .remedy("Save u (right) and v (down) in pixels: numpy.save(path, flow.astype('f4'))"));
        }
    };
    picture::check_companion(path, "flow", (width, height), camera)?;
    let (values, n) = (array.to_f32(), width * height);
    let at = |p: usize, c: usize| if first { values[c * n + p] } else { values[p * channels + c] };
    encode(path, width, (0..n).map(|p| [at(p, 0), at(p, 1), if channels == 3 { at(p, 2) } else { 1.0 }]))
}

/// The samples of a 16-bit RGB image in KITTI's code: of flow and where it is known, [3, height, width].
pub(crate) fn to_picture(flow: &Planes<f32>) -> Vec<u16> {
    let n = flow.pixels();
    let code = |p: usize| {
        let codes = [0, 1].map(|c| (f64::from(flow.data[c * n + p]) * PER_PIXEL + ZERO).round());
        let fits = codes.iter().all(|c| (0.0..=f64::from(u16::MAX)).contains(c));
        if flow.data[2 * n + p] > 0.0 && fits { [codes[0] as u16, codes[1] as u16, 1] } else { [0; 3] }
    };
    (0..n).flat_map(code).collect()
}

fn decode_picture(path: &Path, camera: &Camera) -> Result<Vec<Code>> {
    let raster = picture::decode_companion(path, "flow", camera)?;
    let bad = |what: &str| {
        Err(Error::input(format!("the flow image has {what}"))
            .at(path.display())
            .remedy("Write 16-bit RGB as in KITTI: 64 u + 32768, 64 v + 32768, and 1 where they are known"))
    };
    match raster.samples {
        Samples::Eight(_) => bad("8 bits a channel, not 16"),
        Samples::Sixteen(_) if raster.channels != 3 => bad(&format!("{} channels, not 3", raster.channels)),
        Samples::Sixteen(samples) => Ok(samples.as_chunks::<3>().0.to_vec()),
    }
}

/// From the distorted images of both frames to their pinhole views. The vector is that of the nearest pixel: means of
/// vectors across an edge belong to neither side.
fn straighten(codes: Vec<Code>, from: &Camera, to: &Camera) -> Vec<Code> {
    let lenses = [from, to].map(|c| Distortion::new(c.lens));
    if lenses.iter().all(Distortion::is_pinhole) {
        return codes;
    }
    let (a, b) = (&from.intrinsics, &to.intrinsics);
    let pixel = |p: usize| {
        let (x, y) = ((p % from.width) as f64 + 0.5, (p / from.width) as f64 + 0.5);
        let [u, v] = lenses[0].distort([(x - a.cx) / a.fx, (y - a.cy) / a.fy])?;
        let seen = [a.fx * u + a.cx, a.fy * v + a.cy];
        let inside = (0.0..from.width as f64).contains(&seen[0]) && (0.0..from.height as f64).contains(&seen[1]);
        let code = inside.then(|| codes[seen[1] as usize * from.width + seen[0] as usize])?;
        let way = [0, 1].map(|c| (f64::from(code[c]) - ZERO) / PER_PIXEL);
        let arrives = [(seen[0] + way[0] - b.cx) / b.fx, (seen[1] + way[1] - b.cy) / b.fy];
        let [u, v] = lenses[1].undistort(arrives)?;
        let way = [b.fx * u + b.cx - x, b.fy * v + b.cy - y].map(|w| (w * PER_PIXEL + ZERO).round());
        let fits = way.iter().all(|w| (0.0..=f64::from(u16::MAX)).contains(w));
        (code[2] != 0 && fits).then_some([way[0] as u16, way[1] as u16, 1])
    };
    (0..codes.len()).map(|p| pixel(p).unwrap_or_default()).collect()
}
