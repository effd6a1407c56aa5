//! From a scene to records: one chunk, bins whose steps are twice the largest error.

use super::streams;
use super::{
    ALWAYS, CENTER, CHUNK, CHUNK_INDEX, CLIP, COLOR, FLAGS, FOOTER, FPS, HEADER, LARGEST, MAGIC, MODEL, MOTION,
    OPACITY, POSITION, QUANTIZATION, ROTATION, SCALE, SCHEME, SH_BAND, SH_REACH, SIGMA, WINDOW, WINDOWS, center_step,
    half_life, motion_step,
};
use crate::format::bytes::SH_C0;
use crate::format::dialect::WriteOptions;
use crate::format::kinematic::{Clock, FOREVER, Moving, rows as moving_rows};
use crate::format::quant::morton;
use crate::format::warnings::Warnings;
use crate::layers::Scene;
use crate::scene::SH;
use crate::scene::time::DEFAULT_FPS;
use crate::{Error, ErrorKind, Result};
use std::f64::consts::SQRT_2;
use std::io::Write;

/// What libraries of the format suggest as the least share of the opacity that is visible.
const CUTOFF: f64 = 0.05;
/// Largest errors: position in shares of the longest side of the box, log scale, rotation, colour, opacity, centre in seconds,
/// logarithm of the standard deviation.
const POSITION_SHARE: f64 = 1.0 / (1 << 21) as f64;
const LOG_SCALE: f64 = 0.002;
const ROTATION_ERROR: f64 = 0.0005;
const COLOR_ERROR: f64 = 1.0 / 1020.0;
const TIME: f64 = 0.0005;
const LOG_SIGMA: f64 = 0.002;
/// Curvature (units) and rotation (radians) over a lifespan from which it counts as lost.
const VISIBLE: f64 = 1e-4;
/// Cells of the curve along which Gaussians are sorted, for short differences.
const CELLS: f64 = 1_048_575.0;

/// Steps in the order of the record.
struct Steps {
    position: f64,
    motion: f64,
}

/// Writes a moving scene.
///
/// Errors: it moves in a way that the format cannot hold and may not be fitted; numbers beyond its range; the sink's.
pub(super) fn write(scene: &Scene<f32>, options: &WriteOptions, out: &mut dyn Write) -> Result<Warnings> {
    let mut warnings = Warnings::default();
    let fps = if scene.fps > 0.0 { scene.fps } else { DEFAULT_FPS };
    let span = if scene.clip[1] > scene.clip[0] { scene.clip[1] - scene.clip[0] } else { 1.0 / fps };
    let clock = Clock { clip: scene.clip, fps, duration: span };
    let mut rows = moving_rows(scene, clock, "4dgs", options.exact, &mut warnings)?;
    // This format has spherical harmonics.
    warnings.drop("view dependence");
    check_shapes(&rows, options.exact, &mut warnings)?;
    let (low, side) = sides(&rows);
    let cell = |m: &Moving| std::array::from_fn::<u32, 3, _>(|k| ((m.mean[k] - low[k]) / side * CELLS) as u32);
    rows.sort_by_key(|m| morton(cell(m)));
    let steps = Steps { position: 2.0 * side * POSITION_SHARE, motion: 4.0 * side * POSITION_SHARE };
    // The clip's last frame is visible for a frame; files are played up to, not including, their duration.
    let seconds = span + 1.0 / fps;
    let absorbed: Vec<_> = scene.layers.iter().map(|layer| layer.with_frame_absorbed()).collect();
    let width = absorbed.iter().map(|l| l.params[SH].width()).max().unwrap_or(3);
    let degree = (width / 3).isqrt() - 1;
    let mut file = MAGIC.to_vec();
    record(&mut file, HEADER, &header(scene, &rows, [seconds, fps], degree));
    record(&mut file, QUANTIZATION, &quantization(low, &steps));
    let mut windows = 1u32.to_le_bytes().to_vec();
    [0.0, seconds].iter().for_each(|t: &f64| windows.extend(t.to_le_bytes()));
    record(&mut file, WINDOWS, &windows);
    let chunk_at = file.len();
    let block = block_of(&rows, low, &steps, [span, seconds])?;
    let mut chunk = Vec::new();
    [0.0, seconds].iter().for_each(|t: &f64| chunk.extend(t.to_le_bytes()));
    chunk.extend(0u32.to_le_bytes());
    chunk.extend((rows.len() as u32).to_le_bytes());
    text(&mut chunk, "");
    [block.len(); 2].iter().for_each(|n| chunk.extend((*n as u64).to_le_bytes()));
    chunk.extend(block);
    record(&mut file, CHUNK, &chunk);
    let mut places = vec![(0, chunk_at, file.len() - chunk_at)];
    let mut clipped = 0;
    for band in 1..=degree {
        let (at, each) = (file.len(), 2 * band + 1);
        let mut bins = Vec::with_capacity(rows.len() * 3 * each);
        for m in &rows {
            let sh = &absorbed[m.source[0]].params[SH];
            for (c, k) in (0..3).flat_map(|c| (0..each).map(move |k| (c, k))) {
                let column = 3 * (band * band + k) + c;
                let x = if column < sh.width() { f64::from(sh.get(m.source[1], column)) } else { 0.0 };
                clipped += usize::from(x.abs() > SH_REACH);
                bins.push(((x.clamp(-SH_REACH, SH_REACH) + SH_REACH) * 255.0 / (2.0 * SH_REACH)).round() as i64);
            }
        }
        let mut content = vec![band as u8];
        streams::write(SH_BAND, 3 * each, &bins, &mut content)?;
        record(&mut file, SH_BAND, &content);
        places.push((band as u8, at, file.len() - at));
    }
    if clipped > 0 {
        warnings.add(format!("{clipped} coefficients of colour were beyond ±4 and were clipped"));
    }
    let summary = file.len();
    record(&mut file, CHUNK_INDEX, &index(&places, rows.len(), seconds));
    let mut crc = flate2::Crc::new();
    crc.update(&file[summary..]);
    let mut footer = (summary as u64).to_le_bytes().to_vec();
    footer.extend(0u64.to_le_bytes());
    footer.extend(crc.sum().to_le_bytes());
    record(&mut file, FOOTER, &footer);
    file.extend(MAGIC);
    out.write_all(&file).map_err(|e| Error::io("the Gaussians could not be written", e))?;
    Ok(warnings)
}

/// Curved paths and rotations: counted, or refused.
fn check_shapes(rows: &[Moving], exact: bool, warnings: &mut Warnings) -> Result<()> {
    let lives = |m: &Moving| (m.width / SQRT_2).min(1.0);
    let length = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let curved = |m: &&Moving| length(m.path[1]) * lives(m).powi(2) + length(m.path[2]) * lives(m).powi(3) > VISIBLE;
    let turning = |m: &&Moving| 2.0 * m.turn.iter().map(|x| x * x).sum::<f64>().sqrt() * lives(m) > VISIBLE;
    let [curved, turning] = [rows.iter().filter(curved).count(), rows.iter().filter(turning).count()];
    if exact && curved + turning > 0 {
        let what = format!(".4dgs stores linear paths and one rotation: {curved} paths curve, {turning} rotate");
        return Err(Error::new(ErrorKind::Unsupported, what).remedy("Leave --exact out to fit them, or write .s4d."));
    }
    warnings.counted(curved, rows.len(), "have curved paths: the tangents at the middle of their lifespans are stored");
    warnings.counted(turning, rows.len(), "rotate: the rotation at the middle of their lifespans is stored");
    Ok(())
}

/// Lower corner and longest side of the box of all positions.
fn sides(rows: &[Moving]) -> ([f64; 3], f64) {
    let mut sides = [[f64::INFINITY, f64::NEG_INFINITY]; 3];
    for m in rows {
        (0..3).for_each(|k| sides[k] = [sides[k][0].min(m.mean[k]), sides[k][1].max(m.mean[k])]);
    }
    let longest = sides.iter().map(|[a, b]| b - a).fold(0.0, f64::max);
    (sides.map(|[a, _]| if a.is_finite() { a } else { 0.0 }), if longest > 0.0 { longest } else { 1.0 })
}

/// Seconds of a standard deviation; none where it does not fade within the clip.
fn sigma_of(m: &Moving, span: f64) -> Option<f64> {
    (m.width < FOREVER).then_some(m.width / SQRT_2 * span)
}

/// The streams of all attributes. `span`: seconds of a clip and of the file.
fn block_of(rows: &[Moving], low: [f64; 3], steps: &Steps, [span, seconds]: [f64; 2]) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    let bin = |x: f64, step: f64| (x / step).round() as i64;
    // Centres and velocities have steps by the standard deviation as it is read.
    let sigma = |m: &Moving| sigma_of(m, span).map(|s| bin(s.ln(), 2.0 * LOG_SIGMA));
    let read = |m: &Moving| sigma(m).map(|b| (b as f64 * 2.0 * LOG_SIGMA).exp());
    let mut put = |attribute: u8, channels: usize, f: &dyn Fn(&Moving, &mut Vec<i64>)| {
        let mut bins = Vec::with_capacity(rows.len() * channels);
        rows.iter().for_each(|m| f(m, &mut bins));
        streams::write(attribute, channels, &bins, &mut out)
    };
    put(POSITION, 3, &|m, bins| bins.extend((0..3).map(|k| bin(m.mean[k] - low[k], steps.position))))?;
    put(SCALE, 3, &|m, bins| bins.extend(m.log_scale.map(|s| bin(f64::from(s), 2.0 * LOG_SCALE))))?;
    put(LARGEST, 1, &|m, bins| bins.push(smallest_three(m.quat).0 as i64))?;
    put(ROTATION, 3, &|m, bins| bins.extend(smallest_three(m.quat).1.map(|x| bin(x, 2.0 * ROTATION_ERROR))))?;
    put(COLOR, 3, &|m, bins| {
        let rgb = m.dc.map(|dc| (0.5 + f64::from(SH_C0) * f64::from(dc)).clamp(0.0, 1.0));
        let [r, g, b] = rgb.map(|x| bin(x, 2.0 * COLOR_ERROR));
        bins.extend([g, r - g, b - g]);
    })?;
    put(OPACITY, 1, &|m, bins| bins.push(bin(1.0 / (1.0 + (-f64::from(m.opacity_logit)).exp()), 2.0 * COLOR_ERROR)))?;
    put(MOTION, 3, &|m, bins| {
        let step = motion_step(steps.motion, half_life(CUTOFF, read(m), seconds));
        bins.extend(m.path[0].map(|v| bin(v / span, step)));
    })?;
    put(CENTER, 1, &|m, bins| bins.push(bin(m.center * span, center_step(2.0 * TIME, read(m)))))?;
    put(SIGMA, 1, &|m, bins| bins.push(sigma(m).unwrap_or(0)))?;
    put(FLAGS, 1, &|m, bins| bins.push(if sigma(m).is_none() { ALWAYS.into() } else { 0 }))?;
    put(WINDOW, 1, &|_, bins| bins.push(0))?;
    Ok(out)
}

/// The index of the largest component in x y z w, and the others with its sign made positive.
fn smallest_three([w, x, y, z]: [f64; 4]) -> (usize, [f64; 3]) {
    let q = [x, y, z, w];
    let largest = (0..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut others = (0..4).filter(|i| *i != largest).map(|i| sign * q[i]);
    (largest, std::array::from_fn(|_| others.next().expect("three others")))
}

fn record(out: &mut Vec<u8>, code: u8, content: &[u8]) {
    out.push(code);
    out.extend((content.len() as u64).to_le_bytes());
    out.extend_from_slice(content);
}

fn text(out: &mut Vec<u8>, text: &str) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}

fn map(out: &mut Vec<u8>, entries: &[(&str, String)]) {
    let mut block = Vec::new();
    for (key, value) in entries {
        text(&mut block, key);
        text(&mut block, value);
    }
    out.extend((block.len() as u32).to_le_bytes());
    out.extend(block);
}

fn header(scene: &Scene<f32>, rows: &[Moving], [seconds, fps]: [f64; 2], degree: usize) -> Vec<u8> {
    let mut out = Vec::new();
    text(&mut out, "");
    text(&mut out, concat!("splat4d ", env!("CARGO_PKG_VERSION")));
    out.extend(seconds.to_le_bytes());
    out.extend((rows.len() as u64).to_le_bytes());
    out.extend(CUTOFF.to_le_bytes());
    text(&mut out, MODEL);
    for ends in [f64::min as fn(f64, f64) -> f64, f64::max] {
        for k in 0..3 {
            out.extend(rows.iter().map(|m| m.mean[k]).reduce(ends).unwrap_or(0.0).to_le_bytes());
        }
    }
    out.extend([degree as u8, 0]);
    let [from, to] = scene.clip;
    // In the order of their bytes, as maps are written.
    map(&mut out, &[(CLIP, format!("{from} {to}")), (FPS, fps.to_string())]);
    out
}

fn quantization(low: [f64; 3], steps: &Steps) -> Vec<u8> {
    let mut out = Vec::new();
    text(&mut out, SCHEME);
    let errors = [LOG_SCALE, ROTATION_ERROR, COLOR_ERROR, COLOR_ERROR].map(|x| 2.0 * x);
    let numbers = low.into_iter().chain([steps.position]).chain(errors);
    let numbers = numbers.chain([steps.motion, 2.0 * TIME, 2.0 * LOG_SIGMA]);
    numbers.for_each(|x| out.extend(x.to_le_bytes()));
    out.push(1);
    let bounds = [
        ("alpha", COLOR_ERROR),
        ("motion", 0.5 * steps.motion),
        ("pos", 0.5 * steps.position),
        ("rgb", COLOR_ERROR),
        ("rot", ROTATION_ERROR),
        ("scale_rel", LOG_SCALE),
        ("sh", 0.0),
        ("sigma_rel", LOG_SIGMA),
        ("time", TIME),
    ];
    map(&mut out, &bounds.map(|(name, bound)| (name, bound.to_string())));
    out
}

/// `places`: band (0: the chunk), first byte and length of the records.
fn index(places: &[(u8, usize, usize)], rows: usize, seconds: f64) -> Vec<u8> {
    let mut out = Vec::new();
    [0.0, seconds].iter().for_each(|t: &f64| out.extend(t.to_le_bytes()));
    let put = |out: &mut Vec<u8>, n: usize| out.extend((n as u64).to_le_bytes());
    put(&mut out, places[0].1);
    put(&mut out, places[0].2);
    out.extend((rows as u32).to_le_bytes());
    out.extend((places.len() as u32 - 1).to_le_bytes());
    for (band, at, length) in &places[1..] {
        out.push(*band);
        put(&mut out, *at);
        put(&mut out, *length);
    }
    out
}
