//! `.spz`: Gaussians in some 20 bytes each, before compression. Versions 2, 3 and 4 are read and written.
//!
//! Six streams, one value after the other through all Gaussians: positions (24-bit fixed point), opacities (u8), base
//! colours (u8, ½ + 0.15·f_dc), log scales (u8, b/16 − 10), rotations, spherical harmonics (u8, (b − 128)/128,
//! coefficient-major as our tables). Versions 2 and 3 are one gzip stream: header of 16 bytes, then the streams;
//! version 4 has a plain header of 32 bytes, extensions, a table of contents and a zstd frame a stream. Version 2
//! stores the quaternion's x, y, z; later ones its smallest three parts. World axes: what an extension names, else as
//! in .ply (`axes.rs`).
//!
//! Source: github.com/nianticlabs/spz (MIT), README and extensions/README.

mod axes;
mod container;
mod streams;
#[cfg(test)]
mod tests;

use super::bytes::sound_rows;
use super::dialect::{Dialect, Opened, Writer, Y_DOWN};
use super::warnings::Warnings;
use crate::math::sh::degree_of;
use crate::scene::{Params, SH};
use crate::{Error, ErrorKind, Result};
pub(super) use axes::ASSUMED as AXES_ASSUMED;
use std::io::Write;

/// .spz, versions 2 to 4.
pub(crate) const DIALECT: Dialect = Dialect {
    name: ".spz",
    ending: ".spz",
    up: Y_DOWN,
    moves: false,
    mark: Some(|bytes| bytes.starts_with(&GZIP_MAGIC) || bytes.starts_with(&MAGIC)),
    read: |bytes| read(bytes).map(|(params, up, warnings)| Opened { up: Some(up), ..Opened::from((params, warnings)) }),
    writer: Writer::Moment(|params, options, mut out| write(params, options.spz_version, options.up, &mut out)),
    world: false,
    fixed_axes: false,
    states_up: true,
};

/// The versions this library reads and writes.
pub(crate) const VERSIONS: std::ops::RangeInclusive<u32> = 2..=4;
/// First version that names its axes when it is written: readers of version 2 (spz-js 1.2) refuse bytes behind the
/// streams.
const NAMES_AXES: u32 = 3;
/// First bytes of a version 4 file, and of the header inside older ones.
pub(crate) const MAGIC: [u8; 4] = *b"NGSP";
/// First bytes of a gzip stream (RFC 1952).
pub(crate) const GZIP_MAGIC: [u8; 2] = [0x1F, 0x8B];
/// Flag: trained with the anti-aliasing filter of Mip-Splatting.
const ANTIALIASED: u8 = 1;
/// Flag: vendors' extensions are present.
const EXTENDED: u8 = 2;

/// The header's numbers, the same in all versions.
#[derive(Clone, Copy, Debug)]
struct Header {
    version: u32,
    count: usize,
    degree: usize,
    fraction_bits: u8,
    flags: u8,
}

impl Header {
    /// Checks what every version demands.
    fn checked(self) -> Result<Self> {
        if self.version == 1 {
            return Err(Error::new(ErrorKind::Unsupported, "the file has version 1 of .spz, which was never released")
                .remedy("Export it again with a current program."));
        }
        if !VERSIONS.contains(&self.version) {
            let what = format!("the file has version {} of .spz, this splat4d reads 2 to 4", self.version);
            return Err(Error::new(ErrorKind::Unsupported, what)
                .remedy("Install a newer splat4d, or export the file as version 4."));
        }
        if self.degree > streams::MAX_DEGREE {
            return Err(damaged(format!("its spherical harmonics have degree {}, but 4 is the highest", self.degree)));
        }
        if self.fraction_bits > streams::POSITION_BITS {
            return Err(damaged(format!(
                "its coordinates of 24 bits have {} bits behind the point",
                self.fraction_bits
            )));
        }
        Ok(self)
    }
}

/// Reads a file of version 2 to 4: Gaussians and which way is up, as the file states, else as in .ply. Spherical harmonics
/// of degree 4 are left out. Errors: not .spz, another version, truncated, streams of the wrong length.
pub(crate) fn read(bytes: &[u8]) -> Result<(Params, [f64; 3], Warnings)> {
    let mut warnings = Warnings::default();
    let container::Opened { header, streams, axes } = container::open(bytes, &mut warnings)?;
    let mut params = streams::unpack(&header, &streams)?;
    let up = axes::settle(axes, &mut params, &mut warnings);
    if header.degree > crate::math::sh::MAX_DEGREE {
        warnings.add("spherical harmonics of degree 4 are left out: degree 3 is the highest here");
    }
    if header.flags & ANTIALIASED != 0 {
        warnings.add("the file was trained with an anti-aliasing filter: render it with one");
    }
    Ok((params, up, warnings))
}

/// Writes a file of the given version that names its axes, where `up` is along one. Returns what was clipped or left
/// out.
///
/// Errors: the sink's; no Gaussians (readers refuse such files). Panics: the version is not one of 2 to 4.
pub(crate) fn write(params: &Params, version: u32, up: [f64; 3], out: &mut impl Write) -> Result<Warnings> {
    assert!(VERSIONS.contains(&version), "versions 2 to 4 of .spz can be written, not {version}");
    let mut warnings = Warnings::default();
    let rows = sound_rows(params, &mut warnings);
    let count = u32::try_from(rows.len()).map_err(|_| Error::input("there are more than 2^32 Gaussians"))?;
    if rows.is_empty() {
        return Err(Error::input("there are no Gaussians, and an .spz file cannot be empty")
            .remedy("Choose another time, or write .ply files, which can be."));
    }
    let degree = degree_of(params[SH].width() / 3).expect("a layer has at least the base colour");
    let fraction_bits = streams::fraction_bits(params, &rows);
    let axes = axes::Axes::of_up(up).filter(|_| version >= NAMES_AXES);
    if axes.is_none() && up != Y_DOWN {
        let what = "the file does not name its axes (version 2, or up lies along none of them)";
        warnings.add(format!("{what}: other programs will read y as down, as in .ply"));
    }
    let flags = if axes.is_some() { EXTENDED } else { 0 };
    let header = Header { version, count: count as usize, degree, fraction_bits, flags };
    let streams = streams::pack(params, &rows, &header, &mut warnings);
    let file = container::close(&header, &streams, &axes.map(axes::Axes::record).unwrap_or_default());
    out.write_all(&file).map_err(|e| Error::io("the Gaussians could not be written", e))?;
    Ok(warnings)
}

fn damaged(what: impl std::fmt::Display) -> Error {
    Error::input(format!("this .spz file is damaged: {what}")).remedy("Copy or export it again.")
}
