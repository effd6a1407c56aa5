//! The numbers behind images as files: NumPy arrays, Middlebury flow, OpenEXR.

use crate::draw::Channel;
use exr::prelude::{
    AnyChannel, AnyChannels, Blocks, Compression, Encoding, FlatSamples, Image, Layer, LayerAttributes, LineOrder,
    Text, WritableImage,
};
use splat4d::scene::Planes;
use splat4d::{Error, Result, format};
use std::io::Cursor;

/// A format of arrays of numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RawFormat {
    /// NumPy float32, `[h,w,C]`, or `[h,w]` for one value
    Npy,
    /// Middlebury .flo, for flow only; unknown pixels are 1e10
    Flo,
    /// OpenEXR, 32-bit floats: R G B, A, Z, U V, X Y Z, F00 F01 ..., or the channel's name
    Exr,
}

/// First number of a .flo file, as text "PIEH" (Baker et al. 2011).
const FLO_MAGIC: f32 = 202_021.25;
/// Marker of unknown flow: readers take anything above 1e9 for it.
const FLO_UNKNOWN: f32 = 1e10;

impl RawFormat {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Npy, Self::Flo, Self::Exr];

    /// Its content.
    pub fn about(self) -> &'static str {
        match self {
            Self::Npy => "NumPy float32, [h,w,C], or [h,w] for one value",
            Self::Flo => "Middlebury .flo, for flow only; unknown pixels are 1e10",
            Self::Exr => "OpenEXR, 32-bit floats: R G B, A, Z, U V, X Y Z, F00 F01 ..., or the channel's name",
        }
    }

    /// The files' ending, which is its name.
    pub fn ending(self) -> &'static str {
        match self {
            Self::Npy => "npy",
            Self::Flo => "flo",
            Self::Exr => "exr",
        }
    }

    /// Errors: .flo of anything but flow.
    pub fn suits(self, channel: Channel) -> Result<()> {
        if self == Self::Flo && channel != Channel::Flow {
            return Err(Error::input(format!(".flo stores flow, not {}", channel.name()))
                .remedy("Add option `channel` flow, or use option `raw_format` npy or exr."));
        }
        Ok(())
    }

    /// The bytes of a file. Errors: as [`suits`](Self::suits).
    pub fn bytes(self, channel: Channel, raw: &Planes<f32>) -> Result<Vec<u8>> {
        self.suits(channel)?;
        let mut out = Vec::new();
        match self {
            Self::Npy => {
                let shape = [raw.height, raw.width, raw.channels];
                let shape = if raw.channels == 1 { &shape[..2] } else { &shape[..] };
                format::npy::write_f32(shape, &raw.interleaved(), &mut out)?;
            }
            Self::Flo => {
                out.extend_from_slice(&FLO_MAGIC.to_le_bytes());
                for side in [raw.width, raw.height] {
                    out.extend_from_slice(&(side as u32).to_le_bytes());
                }
                let known = |x: f32| if x.is_finite() { x } else { FLO_UNKNOWN };
                raw.interleaved().iter().for_each(|x| out.extend_from_slice(&known(*x).to_le_bytes()));
            }
            Self::Exr => out = open_exr(channel, raw)?,
        }
        Ok(out)
    }
}

/// A single-part OpenEXR file of one channel's planes.
fn open_exr(channel: Channel, raw: &Planes<f32>) -> Result<Vec<u8>> {
    let planes: Vec<(String, &[f32])> = (0..raw.channels).map(|c| (channel.plane(c), raw.plane(c))).collect();
    open_exr_of(&planes, [raw.width, raw.height], Encoding::UNCOMPRESSED, "")
        .map_err(|e| e.remedy("Use option `raw_format` npy."))
}

/// A single-part OpenEXR file of named planes, compressed without loss; `comments`: text for people.
pub fn open_exr_layers(planes: &[(String, &[f32])], size: [usize; 2], comments: &str) -> Result<Vec<u8>> {
    let zip =
        Encoding { compression: Compression::ZIP16, blocks: Blocks::ScanLines, line_order: LineOrder::Increasing };
    open_exr_of(planes, size, zip, comments)
}

/// A single-part OpenEXR file of scan lines, which every reader takes.
fn open_exr_of(planes: &[(String, &[f32])], [w, h]: [usize; 2], encoding: Encoding, comments: &str) -> Result<Vec<u8>> {
    let one = |(name, plane): &(String, &[f32])| AnyChannel::new(name.as_str(), FlatSamples::F32(plane.to_vec()));
    let channels = AnyChannels::sort(planes.iter().map(one).collect());
    let comments = Text::new_or_none(comments).filter(|_| !comments.is_empty());
    let attributes = LayerAttributes { comments, ..LayerAttributes::default() };
    let layer = Layer::new((w, h), attributes, encoding, channels);
    let mut out = Cursor::new(Vec::new());
    let written = Image::from_layer(layer).write().non_parallel().to_buffered(&mut out);
    written.map_err(|e| Error::input(format!("an image cannot be written as OpenEXR ({e})")))?;
    Ok(out.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::format::npy::Npy;

    fn flow() -> Planes<f32> {
        Planes {
            channels: 2,
            height: 2,
            width: 3,
            data: vec![1.0, 2.0, 3.0, 4.0, 5.0, f32::NAN, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
        }
    }

    #[test]
    fn raw_values_round_trip() {
        let npy = Npy::read(&RawFormat::Npy.bytes(Channel::Flow, &flow()).unwrap()).unwrap();
        assert_eq!((npy.shape.as_slice(), &npy.to_f32()[..4]), (&[2, 3, 2][..], &[1.0, 0.1, 2.0, 0.2][..]));
        let flo = RawFormat::Flo.bytes(Channel::Flow, &flow()).unwrap();
        assert_eq!((&flo[..4], flo.len()), (&b"PIEH"[..], 12 + 8 * 6));
        assert_eq!(u32::from_le_bytes([flo[4], flo[5], flo[6], flo[7]]), 3);
        let last = f32::from_le_bytes(std::array::from_fn(|i| flo[12 + 40 + i]));
        assert!(last > 1e9, "what is not known is said so: {last}");
        assert!(RawFormat::Flo.bytes(Channel::Depth, &flow()).unwrap_err().to_string().contains("depth"));
        // The last line of the file, behind the place that the table states: all of U, then all of V.
        let exr = RawFormat::Exr.bytes(Channel::Flow, &flow()).unwrap();
        let number = |at: usize| f32::from_le_bytes(std::array::from_fn(|i| exr[at + i]));
        let line = exr.len() - 24;
        assert_eq!([number(line), number(line + 4), number(line + 12), number(line + 20)], [4.0, 5.0, 0.4, 0.6]);
        let table = exr.len() - 2 * (8 + 24) - 2 * 8;
        let place = u64::from_le_bytes(std::array::from_fn(|i| exr[table + 8 + i]));
        assert_eq!(place as usize, line - 8);
        assert_eq!((&exr[..5], exr[line - 8]), (&[0x76, 0x2f, 0x31, 0x01, 2][..], 1));
    }
}
