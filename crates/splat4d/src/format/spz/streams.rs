//! The six streams: what a Gaussian's numbers are in bytes.

use super::Header;
use crate::Result;
use crate::format::bytes::{byte_of_logit, logit_of_byte, to_byte};
use crate::format::mend::{VISIBLE, median_size};
use crate::format::warnings::Warnings;
use crate::math::{quat, sh};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH};
use std::borrow::Cow;

/// Positions, opacities, base colours, log scales, rotations, spherical harmonics.
pub(super) const STREAMS: usize = 6;
/// The streams in the order of the file.
pub(super) type Streams<'a> = [Cow<'a, [u8]>; STREAMS];
/// Highest SH degree of the format.
pub(super) const MAX_DEGREE: usize = 4;
/// Bits of a coordinate.
pub(super) const POSITION_BITS: u8 = 24;
/// Largest coordinate, in steps.
const MOST: f64 = 8_388_607.0;
/// Bits behind the point that the reference writer always uses: a quarter of a millimetre, if units are metres.
const USUAL_FRACTION_BITS: u8 = 12;
/// Most bits behind the point that we use; more would compress badly and buy nothing that can be seen.
const MOST_FRACTION_BITS: u8 = 18;
/// Colour byte: 255·(½ + 0.15·f_dc), wider than 0..1.
const COLOR_SCALE: f32 = 0.15;
/// Log scale byte: 16·(s + 10).
const SCALE_STEPS: f32 = 16.0;
const SCALE_OFFSET: f32 = 10.0;
/// Bits kept of an SH byte at degree 1 and above it; the reference writer's defaults.
const SH1_BITS: u32 = 5;
const SH_REST_BITS: u32 = 4;
/// Largest magnitude of a smallest-three part: 9 bits.
const PART_MAX: f32 = 511.0;

/// The streams' lengths.
pub(super) fn lengths(header: &Header) -> [usize; STREAMS] {
    let rotation = if header.version == 2 { 3 } else { 4 };
    [9, 1, 3, 3, rotation, 3 * (coefficients(header.degree) - 1)].map(|bytes| bytes * header.count)
}

fn coefficients(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// Gaussians from streams of the right lengths. Degree 4 is left out.
pub(super) fn unpack(header: &Header, streams: &Streams<'_>) -> Result<Params> {
    let [positions, alphas, colors, scales, rotations, rest] = streams;
    let kept = coefficients(header.degree.min(sh::MAX_DEGREE));
    let stride = 3 * (coefficients(header.degree) - 1);
    let mut params = Params::new(header.count, kept, &[]);
    let [geometry, table] = params.get_mut([GEOMETRY, SH]);
    let step = 1.0 / f64::from(1u32 << header.fraction_bits);
    for row in 0..header.count {
        let coordinate = |k: usize| {
            let b = &positions[9 * row + 3 * k..];
            // The upper bytes of an i32, shifted down again: that extends the sign.
            (f64::from(i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) * step) as f32
        };
        geometry.write(row, 0, [coordinate(0), coordinate(1), coordinate(2)]);
        let q = match header.version {
            2 => first_three(&rotations[3 * row..]),
            _ => smallest_three(u32::from_le_bytes(*rotations[4 * row..].first_chunk().expect("lengths were checked"))),
        };
        geometry.write(row, QUAT, q);
        for k in 0..3 {
            geometry.set(row, LOG_SCALE + k, f32::from(scales[3 * row + k]) / SCALE_STEPS - SCALE_OFFSET);
            table.set(row, k, (f32::from(colors[3 * row + k]) / 255.0 - 0.5) / COLOR_SCALE);
        }
        geometry.set(row, OPACITY, logit_of_byte(alphas[row]));
        for k in 0..3 * (kept - 1) {
            table.set(row, 3 + k, (f32::from(rest[stride * row + k]) - 128.0) / 128.0);
        }
    }
    Ok(params)
}

/// wxyz from x, y, z in 127.5·(part + 1); w is positive.
fn first_three(b: &[u8]) -> [f32; 4] {
    let [x, y, z] = std::array::from_fn(|k| f32::from(b[k]) / 127.5 - 1.0);
    [(1.0 - x * x - y * y - z * z).max(0.0).sqrt(), x, y, z]
}

/// wxyz from 2 bits: which part (x, y, z, w) is largest, and sign and nine bits of the others times √2.
fn smallest_three(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut xyzw = [0.0; 4];
    let others = (0..4).filter(|i| *i != largest);
    for (i, shift) in others.zip([20, 10, 0]) {
        let bits = word >> shift & 0x3FF;
        let magnitude = (bits & 0x1FF) as f32 / PART_MAX * std::f32::consts::FRAC_1_SQRT_2;
        xyzw[i] = if bits & 0x200 == 0 { magnitude } else { -magnitude };
    }
    xyzw[largest] = (1.0 - xyzw.iter().map(|x| x * x).sum::<f32>()).max(0.0).sqrt();
    [xyzw[3], xyzw[0], xyzw[1], xyzw[2]]
}

/// Bits behind the point: the usual 12, more where Gaussians are so small that a step would show, fewer where the scene
/// is larger than 2048 units.
pub(super) fn fraction_bits(params: &Params, rows: &[usize]) -> u8 {
    let geometry = &params[GEOMETRY];
    let far = rows.iter().flat_map(|&r| geometry.read::<3>(r, 0)).fold(0.0f32, |m, x| m.max(x.abs()));
    let wanted = VISIBLE * median_size(params).unwrap_or(1.0);
    let mut bits = USUAL_FRACTION_BITS;
    while bits < MOST_FRACTION_BITS && f64::from(1u32 << bits) * wanted < 1.0 {
        bits += 1;
    }
    while bits > 0 && f64::from(far) * f64::from(1u32 << bits) > MOST {
        bits -= 1;
    }
    bits
}

/// Streams of the given rows.
pub(super) fn pack(params: &Params, rows: &[usize], header: &Header, warnings: &mut Warnings) -> Streams<'static> {
    let (geometry, table) = (&params[GEOMETRY], &params[SH]);
    let mut streams: [Vec<u8>; STREAMS] = lengths(header).map(Vec::with_capacity);
    let [positions, alphas, colors, scales, rotations, rest] = &mut streams;
    let per_unit = f64::from(1u32 << header.fraction_bits);
    let [mut far, mut sized, mut colored, mut shaded] = [0; 4];
    let (mut reach, mut moved) = (0.0f64, 0.0f64);
    for &row in rows {
        let mut outside = [false; 4];
        for x in geometry.read::<3>(row, 0) {
            let steps = (f64::from(x) * per_unit).round();
            outside[0] |= steps.abs() > MOST;
            reach = reach.max(f64::from(x).abs());
            moved = moved.max((steps.clamp(-MOST, MOST) / per_unit - f64::from(x)).abs());
            positions.extend_from_slice(&(steps.clamp(-MOST, MOST) as i32).to_le_bytes()[..3]);
        }
        alphas.push(byte_of_logit(geometry.get(row, OPACITY)));
        for k in 0..3 {
            colors.push(to_byte(255.0 * (0.5 + COLOR_SCALE * table.get(row, k)), &mut outside[2]));
            scales.push(to_byte(SCALE_STEPS * (geometry.get(row, LOG_SCALE + k) + SCALE_OFFSET), &mut outside[1]));
        }
        let (q, _) = quat::normalize(geometry.read::<4>(row, QUAT));
        match header.version {
            2 => rotations.extend(pack_first_three(q)),
            _ => rotations.extend(pack_smallest_three(q).to_le_bytes()),
        }
        for k in 3..table.width() {
            let bits = if k < 3 * coefficients(1) { SH1_BITS } else { SH_REST_BITS };
            rest.push(sh_byte(table.get(row, k), bits, &mut outside[3]));
        }
        for (count, outside) in [&mut far, &mut sized, &mut colored, &mut shaded].into_iter().zip(outside) {
            *count += usize::from(outside);
        }
    }
    let of = rows.len();
    warnings.counted(far, of, "were outside of the range of .spz, and were moved to its edge");
    if let Some(size) = median_size(params).filter(|size| moved > VISIBLE * size) {
        warnings.add(format!(
            "positions reach {reach}: the 24 bits of .spz leave steps of {}, and moved them by up to {moved:.3}, {:.2} of the \
             size of the median Gaussian. Move the scene to the origin first, or write .ply",
            1.0 / per_unit,
            moved / size
        ));
    }
    warnings.counted(sized, of, "had a scale outside e^-10 to e^5.94, which was clipped");
    warnings.counted(colored, of, "had a base colour coefficient outside -3.33 to 3.33, which was clipped");
    warnings.counted(shaded, of, "had spherical harmonics above degree 0 outside -1 to 1, which were clipped");
    streams.map(Cow::Owned)
}

/// Rounds to the middle of a bucket, so that gzip finds repetition; 0 is such a middle.
fn sh_byte(x: f32, bits: u32, clipped: &mut bool) -> u8 {
    *clipped |= x.abs() > 1.0;
    let bucket = 1 << (8 - bits);
    let q = (x * 128.0).round() as i32 + 128;
    ((q + bucket / 2).div_euclid(bucket) * bucket).clamp(0, 255) as u8
}

fn pack_first_three(q: [f32; 4]) -> [u8; 3] {
    let sign = if q[0] < 0.0 { -127.5 } else { 127.5 };
    std::array::from_fn(|k| (q[1 + k] * sign + 127.5).round() as u8)
}

fn pack_smallest_three([w, x, y, z]: [f32; 4]) -> u32 {
    let xyzw = [x, y, z, w];
    let largest = (0..4).fold(0, |best, i| if xyzw[i].abs() > xyzw[best].abs() { i } else { best });
    let flip = xyzw[largest] < 0.0;
    let others = xyzw.iter().enumerate().filter(|(i, _)| *i != largest);
    others.fold(largest as u32, |word, (_, part)| {
        let sign = u32::from((*part < 0.0) ^ flip);
        let magnitude = (PART_MAX * part.abs() * std::f32::consts::SQRT_2).round().min(PART_MAX) as u32;
        word << 10 | sign << 9 | magnitude
    })
}
