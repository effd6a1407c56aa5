//! Known optical flow on disk: 16-bit RGB pictures as in KITTI 2012 (Geiger et al.): red is 64 u + 32768, green is
//! 64 v + 32768, u right and v down in pixels, and blue is not zero where they are known.
//!
//! A frame's file says where each of its pixels goes by the next frame of its camera. In memory it keeps this code, for
//! the pinhole view.

use super::lens::Distortion;
use super::picture::{self, Samples};
use super::{Capture, Frame};
use splat4d::scene::{Camera, Planes};
use splat4d::{Error, Result};
use std::path::{Path, PathBuf};

/// Codes a pixel.
const PER_PIXEL: f64 = 64.0;
/// The code of no motion.
const ZERO: f64 = 32768.0;
/// u and v in code, and whether they are known.
type Code = [u16; 3];

/// The flow of a frame: its file, and where it leads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FlowFile {
    /// The picture.
    pub path: PathBuf,
    /// The number, in `Capture::frames`, of the frame at which the pixels arrive: the next one of the same camera.
    pub to: usize,
}

/// A frame's flow in code, [3, height, width] of its view. Errors: the file is none, or of another size than the picture.
pub(super) fn read(file: &FlowFile, frame: &Frame, capture: &Capture) -> Result<Vec<u16>> {
    let (source, k) = (&frame.source, capture.downscale);
    let codes = decode(&file.path, source)?;
    let codes = straighten(codes, source, &capture.frames[file.to].source);
    let (width, height) = (source.width / k, source.height / k);
    let mut out = vec![0; 3 * width * height];
    for p in 0..width * height {
        let first = (p / width * k) * source.width + p % width * k;
        let box_ = (0..k * k).map(|i| codes[first + i / k * source.width + i % k]);
        // The means of k×k boxes, as pictures are reduced, in pixels that are k times as large.
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
/// Errors: the file is none, or of another size than the picture.
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
    let raster = picture::decode(path, Some(camera))?;
    let bad = |what: &str| {
        Err(Error::input(format!("the flow picture has {what}"))
            .at(path.display())
            .remedy("Write 16-bit RGB as in KITTI: 64 u + 32768, 64 v + 32768, and 1 where they are known"))
    };
    match raster.samples {
        Samples::Eight(_) => bad("8 bits a channel, not 16"),
        Samples::Sixteen(_) if raster.channels != 3 => bad(&format!("{} channels, not 3", raster.channels)),
        Samples::Sixteen(samples) => Ok(samples.as_chunks::<3>().0.to_vec()),
    }
}

/// From the distorted pictures of both frames to their pinhole views. The vector is that of the nearest pixel: means of
/// vectors across an edge are nobody's.
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
