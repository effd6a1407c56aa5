//! `.ksplat` of GaussianSplats3D, read: a header of 4,096 bytes, one of 1,024 for each section, then the sections' Gaussians.
//!
//! A Gaussian is position, **linear** scale, quaternion wxyz, colour rgba u8 and spherical harmonics up to degree 2, red first
//! within each degree. Level 0 is f32; level 1 has f16 and positions of 16 bits within a bucket of 256 Gaussians; level 2 is level 1
//! with spherical harmonics in bytes over a range that the header states. World axes as in .ply.
//! Source: mkkellogg/GaussianSplats3D (MIT), src/loaders/SplatBuffer.js, version 0.1, read for facts.

use super::bytes::{dc_of_byte, f32_at, logit_of_byte};
use super::dialect::{Dialect, Opened, Writer, Y_DOWN};
use super::half::f16_to_f32;
use super::warnings::Warnings;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH};
use crate::{Error, ErrorKind, Result};

/// GaussianSplats3D's .ksplat.
pub(crate) const DIALECT: Dialect = Dialect {
    name: ".ksplat",
    ending: ".ksplat",
    up: Y_DOWN,
    moves: false,
    mark: Some(is_ksplat),
    read: |bytes| read(bytes).map(Opened::from),
    writer: Writer::None("Write .ply, .spz 2 or .splat, which GaussianSplats3D opens as well."),
    world: false,
    fixed_axes: false,
    states_up: false,
};

/// Bytes of the header and of a section's.
const HEADER: usize = 4096;
const SECTION: usize = 1024;
/// First bytes: version 0.1 and two that are not used.
const VERSION: [u8; 4] = [0, 1, 0, 0];
/// Half the range of spherical harmonics in bytes, and half a bucket in steps, where the file states none.
const SH_HALF: f32 = 1.5;
const STEPS: u32 = 32_767;
/// Spherical-harmonic numbers beyond the base colour, by degree.
const FURTHER: [usize; 3] = [0, 9, 24];
/// A linear scale of zero or below is read as this.
const SMALLEST_SCALE: f32 = 1e-30;
/// Bytes of a bucket's centre.
const CENTER: usize = 12;

/// Whether bytes begin as version 0.1 does, with counts that fit. The format has no magic number.
fn is_ksplat(bytes: &[u8]) -> bool {
    bytes.starts_with(&VERSION) && Header::read(bytes).is_ok_and(|h| h.rows > 0 && h.rows <= bytes.len() / 24)
}

/// Header fields that apply to all sections.
struct Header {
    sections: usize,
    rows: usize,
    level: u16,
    /// Ends of the range of spherical harmonics in bytes.
    range: [f32; 2],
}

fn u32_at(bytes: &[u8], i: usize) -> u32 {
    u32::from_le_bytes(*bytes[4 * i..].first_chunk().expect("the header holds this number"))
}

fn u16_at(bytes: &[u8], i: usize) -> u16 {
    u16::from_le_bytes(*bytes[2 * i..].first_chunk().expect("the bytes hold this number"))
}

fn damaged(what: impl std::fmt::Display) -> Error {
    Error::input(format!("this .ksplat is damaged: {what}")).remedy("Copy or export it again.")
}

impl Header {
    fn read(bytes: &[u8]) -> Result<Self> {
        let header = bytes.get(..HEADER).ok_or_else(|| damaged("it ends within its header"))?;
        let or = |x: f32, default: f32| if x == 0.0 || !x.is_finite() { default } else { x };
        let (sections, level) = (u32_at(header, 1) as usize, u16_at(header, 10));
        if level > 2 {
            return Err(Error::new(ErrorKind::Unsupported, format!("compression level {level} of .ksplat"))
                .remedy("Levels 0, 1 and 2 are read. Convert the file to .ply."));
        }
        if sections == 0 || sections > (bytes.len() - HEADER) / SECTION {
            return Err(damaged(format!("{sections} sections do not fit")));
        }
        let range = [or(f32_at(header, 9), -SH_HALF), or(f32_at(header, 10), SH_HALF)];
        Ok(Self { sections, rows: u32_at(header, 3) as usize, level, range })
    }

    /// Bytes of a Gaussian: position, scale, rotation, colour, and of a number of spherical harmonics.
    fn widths(&self) -> ([usize; 4], usize) {
        match self.level {
            0 => ([12, 12, 16, 4], 4),
            1 => ([6, 6, 8, 4], 2),
            _ => ([6, 6, 8, 4], 1),
        }
    }
}

/// The places of one section.
struct Section<'a> {
    rows: usize,
    degree: usize,
    stride: usize,
    data: &'a [u8],
    centers: &'a [u8],
    /// Bytes of a bucket, its Gaussians, how many of them are full, and the Gaussians of the others.
    center: usize,
    bucket: usize,
    full: usize,
    partial: Vec<usize>,
    /// Steps in half a bucket and units of a step.
    steps: f32,
    step: f32,
}

impl<'a> Section<'a> {
    /// The section whose header is `head` and whose bytes are in front of `rest`, which is moved behind them.
    fn read(header: &Header, head: &[u8], rest: &mut &'a [u8]) -> Result<Self> {
        let count = |i: usize| u32_at(head, i) as usize;
        let (rows, buckets, partly) = (count(1), count(3), count(9));
        let (degree, center) = (usize::from(u16_at(head, 20)), usize::from(u16_at(head, 10)));
        if degree > 2 {
            return Err(damaged(format!("spherical harmonics of degree {degree}")));
        }
        if header.level > 0 && (center < CENTER || buckets == 0 && rows > 0) {
            return Err(damaged("positions without buckets"));
        }
        let (widths, of_sh) = header.widths();
        let stride = widths.iter().sum::<usize>() + of_sh * FURTHER[degree];
        let mut take = |number: usize, bytes: usize| {
            let length = number.checked_mul(bytes).filter(|n| *n <= rest.len());
            let length = length.ok_or_else(|| damaged("a section lies outside the file"))?;
            let (head, tail) = rest.split_at(length);
            *rest = tail;
            Ok::<_, Error>(head)
        };
        let lengths = take(partly, 4)?;
        let centers = take(buckets, center)?;
        let data = take(rows, stride)?;
        let steps = if count(6) == 0 { STEPS } else { u32_at(head, 6) };
        let step = 0.5 * f32_at(head, 4) / steps as f32;
        let partial = (0..partly).map(|i| u32_at(lengths, i) as usize).collect();
        let (bucket, full) = (count(2), count(8));
        Ok(Self { rows, degree, stride, data, centers, center, bucket, full, partial, steps: steps as f32, step })
    }

    /// The bucket of every Gaussian.
    fn buckets(&self) -> Result<Vec<usize>> {
        let mut out: Vec<usize> = Vec::with_capacity(self.rows);
        let sizes = std::iter::repeat_n(self.bucket, self.full.min(self.rows)).chain(self.partial.iter().copied());
        for (bucket, size) in sizes.enumerate() {
            let size = size.min(self.rows - out.len());
            out.extend(std::iter::repeat_n(bucket, size));
            if out.len() == self.rows {
                break;
            }
        }
        let known = self.centers.len() / self.center.max(1);
        if out.len() < self.rows || out.last().is_some_and(|b| *b >= known) {
            return Err(damaged("its buckets do not hold all Gaussians"));
        }
        Ok(out)
    }
}

/// Reads Gaussians. Errors: another version or compression level, damage.
fn read(bytes: &[u8]) -> Result<(Params, Warnings)> {
    let header = Header::read(bytes)?;
    if !bytes.starts_with(&VERSION) {
        return Err(Error::new(ErrorKind::Unsupported, "another version of .ksplat than 0.1")
            .remedy("Convert it to .ply, for instance with splat-transform."));
    }
    let mut rest = &bytes[HEADER + SECTION * header.sections..];
    let heads = bytes[HEADER..].chunks_exact(SECTION).take(header.sections);
    let sections = heads.map(|head| Section::read(&header, head, &mut rest)).collect::<Result<Vec<_>>>()?;
    let total: usize = sections.iter().map(|s| s.rows).sum();
    if total == 0 {
        return Err(damaged("it holds no Gaussians"));
    }
    let degree = sections.iter().map(|s| s.degree).max().unwrap_or(0);
    let mut params = Params::new(total, 1 + FURTHER[degree] / 3, &[]);
    let (mut first, mut flat) = (0, 0);
    for section in &sections {
        flat += fill(&header, section, first, &mut params)?;
        first += section.rows;
    }
    let mut warnings = Warnings::default();
    warnings.counted(flat, total, "have a scale of zero or below: they are read as infinitely thin");
    Ok((params, warnings))
}

/// Writes the Gaussians of a section from row `first` on; returns how many of them have no thickness.
fn fill(header: &Header, section: &Section<'_>, first: usize, params: &mut Params) -> Result<usize> {
    let ([of_mean, of_scale, of_quat, of_color], of_sh) = header.widths();
    let buckets = if header.level > 0 { section.buckets()? } else { Vec::new() };
    let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
    let mut flat = 0;
    let [low, high] = header.range;
    let number = |b: &[u8], i: usize| if header.level == 0 { f32_at(b, i) } else { f16_to_f32(u16_at(b, i)) };
    for (j, b) in section.data.chunks_exact(section.stride).enumerate() {
        let (mean, b) = b.split_at(of_mean);
        let (scale, b) = b.split_at(of_scale);
        let (quat, b) = b.split_at(of_quat);
        let (color, further) = b.split_at(of_color);
        let row = first + j;
        geometry.write(
            row,
            0,
            std::array::from_fn::<f32, 3, _>(|k| match buckets.get(j) {
                None => f32_at(mean, k),
                Some(bucket) => {
                    let center = f32_at(&section.centers[bucket * section.center..], k);
                    center + (f32::from(u16_at(mean, k)) - section.steps) * section.step
                }
            }),
        );
        let scale: [f32; 3] = std::array::from_fn(|k| number(scale, k));
        flat += usize::from(scale.iter().any(|s| *s < SMALLEST_SCALE));
        geometry.write(row, LOG_SCALE, scale.map(|s| if s < SMALLEST_SCALE { SMALLEST_SCALE.ln() } else { s.ln() }));
        geometry.write(row, QUAT, std::array::from_fn::<f32, 4, _>(|k| number(quat, k)));
        geometry.set(row, OPACITY, logit_of_byte(color[3]));
        sh.write(row, 0, std::array::from_fn::<f32, 3, _>(|k| dc_of_byte(color[k])));
        for i in 0..FURTHER[section.degree] {
            let value =
                if of_sh == 1 { f32::from(further[i]) / 255.0 * (high - low) + low } else { number(further, i) };
            // Red, green and blue of degree 1, then those of degree 2.
            let (start, each) = if i < FURTHER[1] { (0, 3) } else { (FURTHER[1], 5) };
            let (channel, k) = ((i - start) / each, start / 3 + (i - start) % each);
            sh.set(row, 3 * (1 + k) + channel, value);
        }
    }
    Ok(flat)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::format::half::f32_to_f16;
    use crate::format::mutate::mutants;
    use crate::format::samples::{gaussians, worst};
    use crate::math::quat;

    /// A file of two sections, of which the first has a full bucket and a partly filled one.
    pub(in crate::format) fn sample(p: &Params, level: u16, degree: usize) -> Vec<u8> {
        const BUCKET: usize = 6;
        let parts = [(0, p.len() - 2), (p.len() - 2, p.len())];
        let mut out = vec![0; HEADER + SECTION * parts.len()];
        let put = |out: &mut Vec<u8>, at: usize, b: &[u8]| out[at..at + b.len()].copy_from_slice(b);
        put(&mut out, 0, &VERSION);
        let rows = p.len() as u32;
        for (i, n) in [(1, 2u32), (2, 2), (3, rows), (4, rows), (5, level.into())] {
            put(&mut out, 4 * i, &n.to_le_bytes());
        }
        for (i, x) in [(9, -2.0f32), (10, 2.0)] {
            put(&mut out, 4 * i, &x.to_le_bytes());
        }
        for (s, (from, to)) in parts.into_iter().enumerate() {
            let (n, at) = (to - from, HEADER + SECTION * s);
            let (full, left) = if level > 0 { (n / BUCKET, n % BUCKET) } else { (0, 0) };
            let partly = usize::from(left > 0);
            let counts = [n, n, BUCKET, full + partly].map(|x| x as u32);
            counts.iter().enumerate().for_each(|(i, x)| put(&mut out, at + 4 * i, &x.to_le_bytes()));
            put(&mut out, at + 16, &40.0f32.to_le_bytes());
            put(&mut out, at + 20, &12u16.to_le_bytes());
            put(&mut out, at + 32, &(full as u32).to_le_bytes());
            put(&mut out, at + 36, &(partly as u32).to_le_bytes());
            put(&mut out, at + 40, &(degree as u16).to_le_bytes());
            (0..partly).for_each(|_| out.extend((left as u32).to_le_bytes()));
            let center = |bucket: usize| [0.5 * bucket as f32, -0.25, 0.125];
            (0..full + partly)
                .filter(|_| level > 0)
                .for_each(|b| center(b).iter().for_each(|x| out.extend(x.to_le_bytes())));
            if level == 0 {
                // Level 0 states no buckets.
                put(&mut out, at + 8, &[0; 8]);
                put(&mut out, at + 36, &[0; 4]);
            }
            for row in from..to {
                let g = p[GEOMETRY].read::<11>(row, 0);
                let number = |out: &mut Vec<u8>, x: f32| match level {
                    0 => out.extend(x.to_le_bytes()),
                    _ => out.extend(f32_to_f16(x).to_le_bytes()),
                };
                for k in 0..3 {
                    let c = center((row - from) / BUCKET)[k];
                    match level {
                        0 => out.extend(g[k].to_le_bytes()),
                        _ => out.extend((((g[k] - c) * 32767.0 / 20.0).round() + 32767.0).to_le_bytes_u16()),
                    }
                }
                (0..3).for_each(|k| number(&mut out, g[LOG_SCALE + k].exp()));
                quat::normalize([g[QUAT], g[QUAT + 1], g[QUAT + 2], g[QUAT + 3]])
                    .0
                    .iter()
                    .for_each(|x| number(&mut out, *x));
                let mut clipped = false;
                out.extend((0..3).map(|c| crate::format::bytes::byte_of_dc(p[SH].get(row, c), &mut clipped)));
                out.push(crate::format::bytes::byte_of_logit(g[OPACITY]));
                for (start, each) in [(1, 3), (4, 5)].into_iter().take(degree) {
                    for (c, k) in (0..3).flat_map(|c| (0..each).map(move |k| (c, k))) {
                        let x = p[SH].get(row, 3 * (start + k) + c);
                        match level {
                            2 => out.push(((x + 2.0) / 4.0 * 255.0).floor().clamp(0.0, 255.0) as u8),
                            _ => number(&mut out, x),
                        }
                    }
                }
            }
        }
        out
    }

    trait Steps {
        fn to_le_bytes_u16(self) -> [u8; 2];
    }

    impl Steps for f32 {
        fn to_le_bytes_u16(self) -> [u8; 2] {
            (self as u16).to_le_bytes()
        }
    }

    #[test]
    fn every_level_and_degree_is_read() {
        for (level, degree) in [(0, 0), (0, 2), (1, 1), (1, 2), (2, 1), (2, 2)] {
            let p = gaussians(17, [1, 4, 9][degree]);
            let file = sample(&p, level, degree);
            assert_eq!(Dialect::of(&file), Some(DIALECT));
            let opened = DIALECT.open(&file).unwrap();
            let back = &opened.scene.layers[0].params;
            let (w, fine) = (worst(&p, back), level == 0);
            assert!(w.mean < if fine { 1e-9 } else { 4e-4 } && w.turn < 2e-3 && w.log_scale < 1e-3, "{level}: {w:?}");
            assert!(w.opacity < 3e-3 && w.dc_inside < 8e-3, "{w:?}");
            assert!(w.sh < [1e-9, 1e-3, 0.017][usize::from(level)], "{level} {degree}: {w:?}");
            assert_eq!(back[SH].width(), 3 * [1, 4, 9][degree]);
        }
    }

    #[test]
    fn damaged_files_are_refused() {
        let file = sample(&gaussians(17, 4), 1, 1);
        for cut in [0, 10, HEADER, HEADER + SECTION, file.len() - 1] {
            assert!(read(&file[..cut]).is_err(), "{cut}");
        }
        // Compression level, sections, degree, buckets.
        for (at, value) in
            [(20, 9u8), (7, 255), (HEADER + 40, 7), (HEADER + 20, 1), (HEADER + 32, 0), (HEADER + 7, 255)]
        {
            let mut bad = file.clone();
            bad[at] = value;
            assert!(read(&bad).is_err(), "byte {at}");
        }
        for mutant in mutants(&file, 3000, "ksplat") {
            let _ = read(&mutant);
        }
    }
}
