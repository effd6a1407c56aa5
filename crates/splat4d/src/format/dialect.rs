//! The dialects by name: what a file is, told by its bytes, and how it is opened.

use super::warnings::Warnings;
use super::{ply, sog, splat, splatv, spz};
use crate::Result;
use crate::layers::{Layer, Scene};
use crate::motion::Still;
use crate::scene::{LifeKind, Params, time::DEFAULT_FPS};
use std::sync::Arc;

/// Files of Gaussians that other programs share. docs/formats.md tells what each holds and assumes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Dialect {
    /// Plain 3DGS .ply.
    Ply,
    /// PlayCanvas' compressed .ply.
    CompressedPly,
    /// Moving .ply of Spacetime Gaussians.
    StgPly,
    /// .spz, versions 2 to 4.
    Spz,
    /// antimatter's .splat.
    Splat,
    /// splaTV's moving .splatv.
    Splatv,
    /// SOG version 2, zipped.
    Sog,
}

impl Dialect {
    /// What a file is by its content. `None`: none of these, or a .splat, which has no mark.
    pub fn of(bytes: &[u8]) -> Option<Self> {
        if bytes.starts_with(b"ply") {
            return Some(match () {
                () if ply::is_stg(bytes) => Self::StgPly,
                () if ply::is_compressed(bytes) => Self::CompressedPly,
                () => Self::Ply,
            });
        }
        if bytes.starts_with(&spz::GZIP_MAGIC) || bytes.starts_with(&spz::MAGIC) {
            return Some(Self::Spz);
        }
        if bytes.starts_with(&splatv::MAGIC) {
            return Some(Self::Splatv);
        }
        bytes.starts_with(&sog::ZIP_MAGIC).then_some(Self::Sog)
    }

    /// What people call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ply => "3DGS .ply",
            Self::CompressedPly => "3DGS .ply, compressed (PlayCanvas)",
            Self::StgPly => "Spacetime Gaussians .ply",
            Self::Spz => ".spz",
            Self::Splat => ".splat",
            Self::Splatv => ".splatv",
            Self::Sog => "SOG",
        }
    }

    /// The direction that its world calls up, by custom: no file says it.
    pub fn up(self) -> [f64; 3] {
        match self {
            Self::Spz => [0.0, 1.0, 0.0],
            _ => [0.0, -1.0, 0.0],
        }
    }

    /// Whether it holds a moving scene.
    pub fn moves(self) -> bool {
        matches!(self, Self::StgPly | Self::Splatv)
    }
}

/// An opened file.
#[derive(Debug)]
pub struct Opened {
    /// The scene, in the file's own axes; `up` says which way they lie.
    pub scene: Scene<f32>,
    /// What a .ply said.
    pub ply: Option<ply::PlyInfo>,
    /// What could not be read or had to be assumed.
    pub warnings: Warnings,
}

/// Opens a file of the given kind. Errors: its reader's.
pub fn open(dialect: Dialect, bytes: &[u8]) -> Result<Opened> {
    let mut ply = None;
    let (params, warnings) = match dialect {
        Dialect::StgPly => return ply::read_stg(bytes).map(moving),
        Dialect::Splatv => return splatv::read(bytes).map(moving),
        Dialect::Ply | Dialect::CompressedPly => {
            let (params, info) = ply::read(bytes)?;
            ply = Some(info);
            (params, Warnings::default())
        }
        Dialect::Spz => spz::read(bytes).map(|(params, _, warnings)| (params, warnings))?,
        Dialect::Splat => splat::read(bytes)?,
        Dialect::Sog => sog::read(&sog::unzip(bytes)?)?,
    };
    Ok(Opened { scene: still(params, dialect), ply, warnings })
}

fn moving((scene, warnings): (Scene<f32>, Warnings)) -> Opened {
    Opened { scene, ply: None, warnings }
}

/// A scene of one layer that stands still, in the axes of a dialect.
pub fn still(params: Params, dialect: Dialect) -> Scene<f32> {
    let layer = Layer::new("gaussians", params, Arc::new(Still), LifeKind::Infinite);
    Scene { layers: vec![layer], up: dialect.up(), fps: DEFAULT_FPS, ..Scene::default() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::kinematic::tests::moving as moving_scene;
    use crate::format::samples::gaussians;

    #[test]
    fn every_dialect_is_known_by_its_bytes() {
        let (p, scene) = (gaussians(20, 4), moving_scene(20, LifeKind::GaussOne, 3, true));
        let mut files: Vec<(Option<Dialect>, Vec<u8>)> = Vec::new();
        let mut add = |dialect, write: &dyn Fn(&mut Vec<u8>)| {
            let mut bytes = Vec::new();
            write(&mut bytes);
            files.push((dialect, bytes));
        };
        add(Some(Dialect::Ply), &|b| ply::write(&p, b).unwrap());
        add(Some(Dialect::CompressedPly), &|b| drop(ply::write_compressed(&p, b).unwrap()));
        add(Some(Dialect::StgPly), &|b| drop(ply::write_stg(&scene, b).unwrap()));
        add(Some(Dialect::Splatv), &|b| drop(splatv::write(&scene, &[], b).unwrap()));
        for version in spz::VERSIONS {
            add(Some(Dialect::Spz), &|b| drop(spz::write(&p, version, b).unwrap()));
        }
        add(None, &|b| drop(splat::write(&p, b).unwrap()));
        for (dialect, bytes) in files {
            assert_eq!(Dialect::of(&bytes), dialect);
            let opened = open(dialect.unwrap_or(Dialect::Splat), &bytes).unwrap();
            assert_eq!(opened.scene.len(), 20);
            assert_eq!(opened.scene.up, dialect.unwrap_or(Dialect::Splat).up());
        }
        assert_eq!(Dialect::of(b""), None);
    }
}
