//! File formats: every reader takes bytes and every writer fills an [`std::io::Write`]; paths are unknown here.
//!
//! **Readers never panic, hang or allocate more than a small multiple of their input**: counts and lengths are compared
//! with the bytes present before anything is allocated.

pub(crate) mod arrays;
mod base64;
mod bytes;
pub mod checkpoint;
pub mod dialect;
pub mod dynamic3d;
mod fade;
pub mod foreign;
mod fourdgs;
mod freetime;
pub mod gltf;
mod half;
mod inflate;
mod kinematic;
mod ksplat;
pub mod linear;
pub mod mend;
#[cfg(test)]
mod mutate;
pub mod npy;
pub mod playback;
pub mod ply;
pub mod quant;
pub mod research;
mod rotors;
pub mod safetensors;
#[cfg(test)]
mod samples;
pub mod scene;
pub mod sequence;
pub mod sog;
pub mod splat;
mod splats4d;
pub mod splatv;
pub mod spz;
mod torch;
pub mod usd;
pub(crate) mod warnings;
pub mod zip;

pub(crate) use arrays::{params_to_arrays, tensors_to_loaded};
pub use dialect::Dialect;
pub use linear::Linear;
pub use mend::Mended;
pub use warnings::Warnings;

use crate::layers::Scene;
use crate::{Error, Result};

/// The files of Gaussians that other programs share. A dialect's properties are in its own file; nothing else lists
/// them. Where two recognise a file by its bytes, the later one counts: a layout inside another one is listed after it.
pub const DIALECTS: &[Dialect] = &[
    ksplat::DIALECT,
    ply::DIALECT,
    ply::COMPRESSED,
    ply::STG,
    ply::FTGS,
    spz::DIALECT,
    splat::DIALECT,
    splatv::DIALECT,
    sog::DIALECT,
    gltf::DIALECT,
    gltf::TEXT,
    gltf::COMPRESSED,
    usd::TEXT,
    usd::ARCHIVE,
    fourdgs::DIALECT,
    splats4d::DIALECT,
    dynamic3d::DIALECT,
    checkpoint::DIALECT,
];

/// The scene in a file of any kind that its first bytes identify: `.s4d`, .ply (3DGS, compressed, Spacetime Gaussians),
/// .spz, .splatv, zipped SOG, `scene.safetensors` and checkpoints. A .splat has no mark: [`splat::read`] it.
///
/// Assumptions are not returned; [`Dialect::open`] returns them. Errors: no such kind; the reader's.
pub fn open(bytes: &[u8]) -> Result<Scene<f32>> {
    if bytes.starts_with(&playback::MAGIC) {
        return playback::read(bytes);
    }
    if let Some(kind) = Dialect::of(bytes) {
        return kind.open(bytes).map(|opened| opened.scene);
    }
    if let Some(error) = foreign::unread("", bytes) {
        return Err(error);
    }
    // A safetensors file begins with the length of its JSON header.
    if bytes.get(8) != Some(&b'{') {
        return Err(Error::input("unknown format: its first bytes match none that splat4d reads").remedy(format!(
            "Give a .s4d, {} or scene.safetensors",
            dialect::extensions(|d| d.mark.is_some()).join(", ")
        )));
    }
    scene::read(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_opened_by_their_first_bytes() {
        let moving = kinematic::tests::moving(20, crate::scene::LifeKind::GaussOne, 1, false);
        let (mut own, mut foreign) = (Vec::new(), Vec::new());
        scene::write(&moving, &mut own).unwrap();
        splatv::write(&moving, &dialect::WriteOptions::default(), &mut foreign).unwrap();
        for bytes in [&own, &foreign] {
            assert_eq!(open(bytes).unwrap().len(), 20);
        }
        for bytes in [&b""[..], b"GIF89a and more bytes", &own[..40]] {
            assert!(open(bytes).is_err());
        }
    }
}
