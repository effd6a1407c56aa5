//! `.splat`: 32 bytes per Gaussian and nothing else, not even a magic number.
//!
//! position 3×f32, **linear** scale 3×f32, colour rgb u8 (½ + C0·f_dc, no view dependence), opacity u8, quaternion wxyz
//! 4×u8 with (b − 128)/128. World axes as in .ply: y down. Source: antimatter15/splat (MIT).

use super::bytes::{byte_of_dc, byte_of_logit, dc_of_byte, f32_at, logit_of_byte, scale_of_log, sound_rows};
use super::dialect::{Dialect, Opened, Writer, Y_DOWN};
use super::warnings::Warnings;
use crate::math::quat;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH};
use crate::{Error, Result};
use std::io::Write;

/// antimatter's .splat.
pub const DIALECT: Dialect = Dialect {
    name: ".splat",
    ending: ".splat",
    up: Y_DOWN,
    moves: false,
    mark: None,
    read: |bytes| read(bytes).map(Opened::from),
    writer: Writer::Moment(|params, _, mut out| write(params, &mut out)),
    world: false,
    fixed_axes: false,
    states_up: false,
};

/// Bytes per Gaussian.
pub(crate) const ROW: usize = 32;
/// A linear scale of zero or below is read as this: no logarithm, and nothing to see either.
const SMALLEST_SCALE: f32 = 1e-30;

/// Reads Gaussians. Errors: the length is not a multiple of 32, or there is nothing.
pub fn read(bytes: &[u8]) -> Result<(Params, Warnings)> {
    if bytes.is_empty() || !bytes.len().is_multiple_of(ROW) {
        return Err(Error::input(format!(
            "a .splat file has 32 bytes per Gaussian, this one has {} bytes",
            bytes.len()
        ))
        .remedy("It is truncated, or not a .splat file; copy or export it again."));
    }
    let mut params = Params::new(bytes.len() / ROW, 1, &[]);
    let mut warnings = Warnings::default();
    let (mut flat, mut damaged) = (0, 0);
    let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
    for (row, b) in bytes.chunks_exact(ROW).enumerate() {
        let scale: [f32; 3] = std::array::from_fn(|k| f32_at(b, 3 + k));
        let mean: [f32; 3] = std::array::from_fn(|k| f32_at(b, k));
        geometry.write(row, 0, mean);
        geometry.write(row, QUAT, std::array::from_fn::<f32, 4, _>(|k| (f32::from(b[28 + k]) - 128.0) / 128.0));
        geometry.write(row, LOG_SCALE, scale.map(|s| if s < SMALLEST_SCALE { SMALLEST_SCALE.ln() } else { s.ln() }));
        geometry.set(row, OPACITY, logit_of_byte(b[27]));
        sh.write(row, 0, std::array::from_fn::<f32, 3, _>(|k| dc_of_byte(b[24 + k])));
        flat += usize::from(scale.iter().any(|s| *s < SMALLEST_SCALE));
        damaged += usize::from(mean.iter().chain(&scale).any(|x| !x.is_finite()));
    }
    warnings.counted(flat, bytes.len() / ROW, "have a scale of zero or below: they are read as infinitely thin");
    warnings.counted(damaged, bytes.len() / ROW, "hold NaN or infinity");
    Ok((params, warnings))
}

/// Writes Gaussians in their order; view dependence is left out. Errors: the sink's.
pub(crate) fn write(params: &Params, out: &mut impl Write) -> Result<Warnings> {
    let mut warnings = Warnings::default();
    let (geometry, sh) = (&params[GEOMETRY], &params[SH]);
    if sh.width() > 3 {
        warnings.add("view dependence (spherical harmonics above degree 0) is left out: .splat holds one colour");
    }
    let mut clipped = 0;
    let mut bytes = Vec::with_capacity(params.len() * ROW);
    let rows = sound_rows(params, &mut warnings);
    for &row in &rows {
        let scale = geometry.read::<3>(row, LOG_SCALE).map(scale_of_log);
        for x in geometry.read::<3>(row, 0).into_iter().chain(scale) {
            bytes.extend_from_slice(&x.to_le_bytes());
        }
        let mut outside = false;
        bytes.extend(sh.read::<3>(row, 0).map(|dc| byte_of_dc(dc, &mut outside)));
        clipped += usize::from(outside);
        bytes.push(byte_of_logit(geometry.get(row, OPACITY)));
        let (q, _) = quat::normalize(geometry.read::<4>(row, QUAT));
        bytes.extend(q.map(|x| (x * 128.0 + 128.0).round().clamp(0.0, 255.0) as u8));
    }
    warnings.counted(clipped, rows.len(), "had a base colour outside 0 to 1, which was clipped");
    out.write_all(&bytes).map_err(|e| Error::io("the Gaussians could not be written", e))?;
    Ok(warnings)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::samples::{gaussians, worst};

    #[test]
    fn bytes_of_the_specification_are_read() {
        let mut bytes = Vec::new();
        for x in [1.0f32, -2.0, 3.5, 0.5, 1.0, 2.0] {
            bytes.extend(x.to_le_bytes());
        }
        // Colour 0, ½ (nearly) and 1; opacity 51/255 = 0.2; a quarter turn about y.
        bytes.extend([0, 128, 255, 51, 219, 128, 219, 128]);
        let (p, warnings) = read(&bytes).unwrap();
        let g = &p[GEOMETRY];
        assert_eq!(g.read::<3>(0, 0), [1.0, -2.0, 3.5]);
        assert_eq!(g.read::<3>(0, LOG_SCALE), [0.5f32.ln(), 0.0, 2.0f32.ln()]);
        assert_eq!(g.read::<4>(0, QUAT), [91.0 / 128.0, 0.0, 91.0 / 128.0, 0.0]);
        assert!((1.0 / (1.0 + (-g.get(0, OPACITY)).exp()) - 0.2).abs() < 1e-6);
        let [r, _, b] = p[SH].read::<3>(0, 0);
        assert!((0.5 + SH_C0 * r).abs() < 1e-6 && (0.5 + SH_C0 * b - 1.0).abs() < 1e-6);
        assert!(warnings.lines().is_empty());
    }
    use crate::format::bytes::SH_C0;

    #[test]
    fn a_round_trip_stays_within_the_steps() {
        let p = gaussians(500, 9);
        let mut bytes = Vec::new();
        let said = write(&p, &mut bytes).unwrap();
        assert!(said.lines()[0].contains("view dependence"));
        let (back, _) = read(&bytes).unwrap();
        let w = worst(&p, &back);
        assert_eq!(w.mean, 0.0);
        assert!(w.log_scale < 1e-6 && w.turn < 0.016 && w.opacity < 0.0021, "{w:?}");
        // Half a byte of colour, where it was not clipped.
        assert!(w.dc_inside < 0.5 / 255.0 / SH_C0 + 1e-4, "{w:?}");
    }

    #[test]
    fn clipped_and_damaged_values_are_counted() {
        let mut p = gaussians(3, 1);
        p[SH].write(0, 0, [9.0, 0.0, 0.0]);
        p[SH].write(1, 0, [0.0; 3]);
        p[GEOMETRY].set(2, 1, f32::NAN);
        let mut bytes = Vec::new();
        let said = write(&p, &mut bytes).unwrap();
        assert_eq!(bytes.len(), 64);
        assert!(said.lines()[0].starts_with("1 of 3 Gaussians held NaN"), "{said:?}");
        assert!(said.lines()[1].starts_with("1 of 2 Gaussians had a base colour"), "{said:?}");
        assert!(read(&bytes[..33]).unwrap_err().to_string().contains("33 bytes"));
        assert!(read(&[]).is_err());
    }
}
