//! A calibration that was given: whose camera is whose, and what it says of stored pictures.

use super::{Camera, Request};
use crate::calibration::{self, Calibrated, Calibration, Video};
use crate::corrections::Corrections;
use crate::sfm::known::Known;
use crate::write::Pictures;
use crate::{Error, Result};
use splat4d_train::capture::PointCloud;

/// What was given of all cameras, in their order.
pub(super) struct Given {
    cameras: Vec<Calibrated>,
    /// Pixels across and down of the videos.
    sizes: Vec<[usize; 2]>,
    /// Sentences for the report.
    pub notes: Vec<String>,
    /// Whether places are given and not only lenses.
    pub posed: bool,
    /// Points that came with it.
    pub points: Option<PointCloud>,
}

impl Given {
    /// The calibration that a request names.
    ///
    /// Errors: it cannot be read, names do not match, videos are of another shape, places of cameras that move.
    pub(super) fn read(request: &Request, cameras: &[Camera], moving: bool) -> Result<Option<Self>> {
        let Some(path) = &request.calibration else { return Ok(None) };
        let place = |e: Error| e.at(path.display());
        let found = calibration::read(path)?;
        if moving && found.posed() {
            return Err(place(
                Error::input("it says where cameras stand, but these move")
                    .remedy("Leave --calibration out, give one of lenses alone, or --rig fixed if they stand still."),
            ));
        }
        let from = path.display().to_string();
        let videos: Vec<Video<'_>> =
            cameras.iter().map(|c| Video { name: &c.name, size: c.source.info().size }).collect();
        let mut given = Self::of(&found, &videos, &from).map_err(place)?;
        if found.posed() && request.apart.is_none() {
            given.notes.push(found.about_lengths());
        }
        Ok(Some(given))
    }

    /// A calibration for these videos, whose source is called so.
    pub(super) fn of(found: &Calibration, videos: &[Video<'_>], from: &str) -> Result<Self> {
        let (which, mut notes) = calibration::assign(found, videos)?;
        let own: Vec<Calibrated> = which.iter().map(|&k| found.cameras[k].clone()).collect();
        for (camera, video) in own.iter().zip(videos) {
            calibration::fitted(camera, video.size, video.size).map_err(|e| e.at(format!("camera {}", video.name)))?;
        }
        let what = if found.posed() { "Lenses and places of cameras are" } else { "Lenses of cameras are" };
        let mut all = vec![format!("{what} from {from} ({}).", found.dialects.join(", "))];
        all.extend(found.notes.iter().cloned());
        all.append(&mut notes);
        Ok(Self {
            cameras: own,
            sizes: videos.iter().map(|v| v.size).collect(),
            notes: all,
            posed: found.posed(),
            points: found.points.clone(),
        })
    }
}

/// What is known of every camera's stored pictures: by calibration, and by the user's own lens, which goes first.
pub(super) fn known(
    given: Option<&Given>,
    corrections: &Corrections,
    pictures: &[Pictures],
) -> Result<Vec<Option<Known>>> {
    let of = |(k, p): (usize, &Pictures)| {
        let calibrated = given.map(|g| calibration::fitted(&g.cameras[k], g.sizes[k], p.size)).transpose()?;
        let own = corrections.cameras.iter().find(|c| c.name == p.name).and_then(|c| c.given_lens());
        let pose = calibrated.as_ref().and_then(|c| c.pose);
        let optics = own.or(calibrated.map(|c| (c.intrinsics, c.lens)));
        Ok(optics.map(|(intrinsics, lens)| Known { intrinsics, lens, pose }))
    };
    pictures.iter().enumerate().map(of).collect()
}
