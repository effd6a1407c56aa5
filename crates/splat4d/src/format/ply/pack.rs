//! Writes PlayCanvas' compressed `.ply`; the layout is documented in the reader, `compressed.rs`.

use crate::format::bytes::{SH_C0, sound_rows};
use crate::format::warnings::Warnings;
use crate::math::quat;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH};
use crate::{Error, Result};
use std::io::Write;

/// Gaussians that share their bounds.
pub(super) const CHUNK: usize = 256;
/// The four words of a Gaussian.
pub(super) const WORDS: [&str; 4] = ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
/// Bounds that every chunk has, in the order in which `Bounds` uses them.
pub(super) const BOUNDS: [&str; 12] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
];
/// Bounds of the colours; files of the first version lack them and mean 0 and 1.
pub(super) const COLOR_BOUNDS: [&str; 6] = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"];
/// SH bytes span [-SH_RANGE/2, SH_RANGE/2].
pub(super) const SH_RANGE: f32 = 8.0;

/// Log scales are kept within ± this: some trainings leave infinitely thin ones. Source: splat-transform's writer.
const MOST_LOG_SCALE: f32 = 20.0;
/// Bits an axis of the Morton code by which rows are sorted, so that a chunk is a small box.
const MORTON_BITS: u32 = 10;

/// Writes Gaussians in PlayCanvas' compressed layout: 16 bytes each, their bounds in chunks of 256, SH in bytes. Rows
/// are sorted along a Morton curve.
///
/// Errors: the sink's.
pub(crate) fn write_compressed(params: &Params, out: &mut impl Write) -> Result<Warnings> {
    let mut warnings = Warnings::default();
    let mut rows = sound_rows(params, &mut warnings);
    sort_by_place(params, &mut rows);
    let rest = params[SH].width() - 3;
    let mut text = String::from("ply\nformat binary_little_endian 1.0\ncomment splat4d\n");
    text.push_str(&format!("element chunk {}\n", rows.len().div_ceil(CHUNK)));
    BOUNDS.iter().chain(&COLOR_BOUNDS).for_each(|n| text.push_str(&format!("property float {n}\n")));
    text.push_str(&format!("element vertex {}\n", rows.len()));
    WORDS.iter().for_each(|n| text.push_str(&format!("property uint {n}\n")));
    if rest > 0 {
        text.push_str(&format!("element sh {}\n", rows.len()));
        (0..rest).for_each(|i| text.push_str(&format!("property uchar f_rest_{i}\n")));
    }
    text.push_str("end_header\n");
    let (mut bounds, mut words, mut sh) = (Vec::new(), Vec::with_capacity(16 * rows.len()), Vec::new());
    for chunk in rows.chunks(CHUNK) {
        pack_chunk(params, chunk, &mut bounds, &mut words);
    }
    let mut clipped = 0;
    for &row in &rows {
        // Channel-major, as f_rest always is.
        let coefficients = rest / 3;
        let mut outside = false;
        for c in 0..3 {
            for k in 1..=coefficients {
                let u = (params[SH].get(row, 3 * k + c) / SH_RANGE + 0.5) * 256.0;
                outside |= !(0.0..=256.0).contains(&u);
                sh.push(u as u8);
            }
        }
        clipped += usize::from(outside);
    }
    warnings.counted(clipped, rows.len(), "had spherical harmonics above degree 0 outside -4 to 4, which were clipped");
    for bytes in [text.as_bytes(), &bounds, &words, &sh] {
        out.write_all(bytes).map_err(|e| Error::io("the Gaussians could not be written", e))?;
    }
    Ok(warnings)
}

/// Sorts rows along a Morton curve through their box; equal codes by row.
fn sort_by_place(params: &Params, rows: &mut Vec<usize>) {
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    let mean = |row: usize| params[GEOMETRY].read::<3>(row, 0);
    for &row in rows.iter() {
        let m = mean(row);
        (0..3).for_each(|k| (low[k], high[k]) = (low[k].min(m[k]), high[k].max(m[k])));
    }
    let most = f64::from((1 << MORTON_BITS) - 1);
    let code = |row: usize| {
        let m = mean(row);
        let cells: [u32; 3] = std::array::from_fn(|k| {
            let wide = f64::from(high[k]) - f64::from(low[k]);
            ((f64::from(m[k]) - f64::from(low[k])) / wide.max(f64::MIN_POSITIVE) * most) as u32
        });
        (0..MORTON_BITS)
            .fold(0u32, |code, bit| (0..3).fold(code, |code, k| code | (cells[k] >> bit & 1) << (3 * bit + k as u32)))
    };
    let mut keyed: Vec<(u32, usize)> = rows.iter().map(|&row| (code(row), row)).collect();
    keyed.sort_unstable();
    *rows = keyed.into_iter().map(|(_, row)| row).collect();
}

fn pack_chunk(params: &Params, rows: &[usize], bounds: &mut Vec<u8>, words: &mut Vec<u8>) {
    let (geometry, sh) = (&params[GEOMETRY], &params[SH]);
    // Position, log scale, colour: nine numbers that are quantised between the chunk's bounds.
    let nine = |row: usize| -> [f32; 9] {
        let (m, s) = (geometry.read::<3>(row, 0), geometry.read::<3>(row, LOG_SCALE));
        let c = sh.read::<3>(row, 0);
        std::array::from_fn(|i| match i {
            0..3 => m[i],
            3..6 => s[i - 3].clamp(-MOST_LOG_SCALE, MOST_LOG_SCALE),
            _ => 0.5 + SH_C0 * c[i - 6],
        })
    };
    let (mut low, mut high) = ([f32::INFINITY; 9], [f32::NEG_INFINITY; 9]);
    for &row in rows {
        let x = nine(row);
        (0..9).for_each(|k| (low[k], high[k]) = (low[k].min(x[k]), high[k].max(x[k])));
    }
    for group in 0..3 {
        low[3 * group..][..3].iter().chain(&high[3 * group..][..3]).for_each(|x| bounds.extend(x.to_le_bytes()));
    }
    for &row in rows {
        let x = nine(row);
        let code = |k: usize, bits: u32| {
            let (wide, most) = (f64::from(high[k]) - f64::from(low[k]), f64::from((1 << bits) - 1));
            let u = if wide > 0.0 { (f64::from(x[k]) - f64::from(low[k])) / wide } else { 0.0 };
            (u * most).round().min(most) as u32
        };
        let opacity = 1.0 / (1.0 + (-geometry.get(row, OPACITY)).exp());
        let (q, _) = quat::normalize(geometry.read::<4>(row, QUAT));
        for word in [
            code(0, 11) << 21 | code(1, 10) << 11 | code(2, 11),
            rotation(q),
            code(3, 11) << 21 | code(4, 10) << 11 | code(5, 11),
            code(6, 8) << 24 | code(7, 8) << 16 | code(8, 8) << 8 | (opacity * 255.0).round() as u32,
        ] {
            words.extend(word.to_le_bytes());
        }
    }
}

/// Index of the largest part of (w, x, y, z), then the others times √½ plus ½ in ten bits each.
fn rotation(q: [f32; 4]) -> u32 {
    let largest = (0..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    q.iter().enumerate().filter(|(i, _)| *i != largest).fold(largest as u32, |word, (_, part)| {
        let u = sign * part * std::f32::consts::FRAC_1_SQRT_2 + 0.5;
        word << 10 | (u * 1023.0).round().clamp(0.0, 1023.0) as u32
    })
}

#[cfg(test)]
mod tests {
    use super::super::read;
    use super::*;
    use crate::format::samples::{gaussians, worst};

    /// The written file's rows, in the order in which the writer sorts.
    fn sorted(p: &Params) -> Params {
        let mut rows: Vec<usize> = (0..p.len()).collect();
        sort_by_place(p, &mut rows);
        let mut out = p.clone();
        let parent: Vec<u32> = rows.iter().map(|&r| r as u32).collect();
        for key in [GEOMETRY, SH] {
            out[key] = p[key].gather(&parent);
        }
        out
    }

    #[test]
    fn every_degree_round_trips_within_its_steps() {
        for coefficients in [1, 4, 9, 16] {
            for rows in [0, 1, 256, 1000] {
                let p = gaussians(rows, coefficients);
                let mut file = Vec::new();
                write_compressed(&p, &mut file).unwrap();
                let (back, info) = read(&file).unwrap();
                assert!(info.compressed && info.gaussians == rows && info.sh_degree == coefficients.isqrt() - 1);
                let w = worst(&sorted(&p), &back);
                // The cloud is less than 24 units wide: half of 1/1023 of that, and of 8 in log scale.
                assert!(w.mean < 0.5 * 24.0 / 1023.0 && w.log_scale < 0.5 * 8.0 / 1023.0, "{w:?}");
                assert!(w.turn < 0.005 && w.opacity < 0.0021 && w.sh <= 4.0 / 256.0 + 1e-6, "{w:?}");
                assert!(w.dc < 0.5 * 8.0 / 255.0, "{w:?}");
            }
        }
    }

    #[test]
    fn damage_does_not_spoil_its_neighbours() {
        let mut p = gaussians(300, 4);
        p[GEOMETRY].set(17, 1, f32::INFINITY);
        p[SH].set(20, 7, 5.0);
        let mut file = Vec::new();
        let said = write_compressed(&p, &mut file).unwrap();
        assert!(said.lines()[0].starts_with("1 of 300 Gaussians held NaN"), "{said:?}");
        assert!(said.lines()[1].starts_with("1 of 299 Gaussians had spherical harmonics"), "{said:?}");
        assert_eq!(read(&file).unwrap().1.non_finite_rows, 0);
    }

    #[test]
    fn rotation_words_are_those_of_the_layout() {
        // The identity: w is largest (0), the others ½ of 1023, rounded.
        assert_eq!(rotation([1.0, 0.0, 0.0, 0.0]), 512 << 20 | 512 << 10 | 512);
        // Half a turn about -y, written as its positive twin.
        assert_eq!(rotation([0.0, 0.0, -1.0, 0.0]), 2 << 30 | 512 << 20 | 512 << 10 | 512);
    }
}
