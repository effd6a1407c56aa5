//! A calibration that was given: whose camera is whose, and what it states of stored images.

use super::{Camera, Request};
use crate::calibration::{self, Calibrated, Calibration, Shape, Unit, Video};
use crate::corrections::Corrections;
use crate::sfm::lens::{Known, Lens};
use crate::write::Pictures;
use crate::{Error, Result};
use splat4d::math::Se3;
use splat4d::scene::Planes;
use splat4d_train::capture::{PointCloud, Rgb8};
use std::path::Path;

/// Given values of all cameras, in their order.
pub(super) struct Given {
    cameras: Vec<Calibrated>,
    /// Pixels across and down of the videos.
    sizes: Vec<[usize; 2]>,
    /// Sentences for the report.
    pub notes: Vec<String>,
    /// Whether places are given and not only lenses.
    pub posed: bool,
    /// Whether its lengths are metres.
    pub metres: bool,
    /// Its points.
    pub points: Option<PointCloud>,
}

impl Given {
    /// The calibration that a request names.
    ///
    /// Errors: it cannot be read, names do not match, videos are of another shape, positions of cameras that move.
    pub(super) fn read(request: &Request, cameras: &[Camera], moving: bool) -> Result<Option<Self>> {
        let Some(path) = &request.calibration else { return Ok(None) };
        let place = |e: Error| e.at(path.display());
        let found = calibration::read(path)?;
        if moving && found.posed() {
            return Err(place(Error::input("it has fixed camera positions, but these cameras move").remedy(
                "Leave --calibration out, give one of lenses alone, or --rig fixed if the cameras are fixed.",
            )));
        }
        let from = path.display().to_string();
        let videos: Vec<Video<'_>> =
            cameras.iter().map(|c| Video { name: &c.name, size: c.source.info().size }).collect();
        let mut given = Self::of(&found, &videos, &from).map_err(place)?;
        let told = request.apart.is_some() || request.board.is_some() || request.camera_height.is_some();
        if found.posed() && !told {
            given.notes.push(found.about_lengths());
        }
        Ok(Some(given))
    }

    /// A calibration for these videos, whose source is called so.
    pub(super) fn of(found: &Calibration, videos: &[Video<'_>], from: &str) -> Result<Self> {
        let (which, mut notes) = calibration::assign(found, videos)?;
        let own: Vec<Calibrated> = which.iter().map(|&k| found.cameras[k].clone()).collect();
        for (camera, video) in own.iter().zip(videos) {
            calibration::shape(camera, video.size).map_err(|e| e.at(format!("camera {}", video.name)))?;
        }
        let what = if found.posed() { "Lenses and positions of cameras are" } else { "Lenses of cameras are" };
        let mut all = vec![format!("{what} from {from} ({}).", found.dialects.join(", "))];
        all.extend(found.notes.iter().cloned());
        all.append(&mut notes);
        Ok(Self {
            cameras: own,
            sizes: videos.iter().map(|v| v.size).collect(),
            notes: all,
            posed: found.posed(),
            metres: found.unit == Unit::Metre,
            points: found.points.clone(),
        })
    }
}

/// Images of a camera in which bars are searched for.
const SAMPLED: usize = 3;
/// Widths and heights of images whose quotients differ by more are parts of different images.
const SHAPE: f64 = 0.01;

/// Refuses a calibration with poses where something else, which an option gives, determines them too.
pub(super) fn without_poses(known: &[Option<Known>], other: &str, option: &str) -> Result<()> {
    if known.iter().flatten().all(|k| k.pose.is_none()) {
        return Ok(());
    }
    Err(Error::input(format!("poses are given in two ways: by a calibration and by {other}"))
        .remedy(format!("Leave {option} or --calibration out, or give a calibration of lenses alone.")))
}

/// Pixels of stored images for one of the images (of this size) in which something was found.
///
/// Errors: images of another shape, with this remedy.
pub(super) fn factors(found: &str, size: [usize; 2], p: &Pictures, remedy: &str) -> Result<[f64; 2]> {
    let by: [f64; 2] = std::array::from_fn(|a| p.size[a] as f64 / size[a].max(1) as f64);
    if (by[0] / by[1] - 1.0).abs() <= SHAPE {
        return Ok(by);
    }
    Err(Error::input(format!(
        "{found} in images of {}x{} pixels, which have another shape than the stored ones of {}x{}",
        size[0], size[1], p.size[0], p.size[1]
    ))
    .at(format!("camera {}", p.name))
    .remedy(remedy))
}

/// Puts the pose of a camera among the known ones; the lens only where none is known.
pub(super) fn place(own: &mut Option<Known>, pose: Se3, lens: Lens, [width, height]: [usize; 2]) {
    let camera = lens.camera(pose, width, height);
    let (intrinsics, lens) = own.map_or((camera.intrinsics, camera.lens), |k| (k.intrinsics, k.lens));
    *own = Some(Known { intrinsics, lens, pose: Some(pose) });
}

/// Known lenses of every camera's stored images: from the calibration, and from the user, which has priority. Sentences
/// about calibrations that had to be corrected for them join the images' warnings.
pub(super) fn known(
    given: Option<&Given>,
    corrections: &Corrections,
    folder: &Path,
    pictures: &mut [Pictures],
) -> Result<Vec<Option<Known>>> {
    let mut out = Vec::with_capacity(pictures.len());
    for (k, p) in pictures.iter_mut().enumerate() {
        let calibrated = match given {
            None => None,
            Some(g) => {
                let camera = &g.cameras[k];
                let bars = match calibration::shape(camera, g.sizes[k])? {
                    Shape::Boxed(_) => calibration::bars(&some(folder, p)?),
                    _ => [0.0; 4],
                };
                let (camera, note) = calibration::fitted(camera, g.sizes[k], p.size, bars)
                    .map_err(|e| e.at(format!("camera {}", p.name)))?;
                p.warnings.extend(note);
                Some(camera)
            }
        };
        let own = corrections.cameras.iter().find(|c| c.name == p.name).and_then(|c| c.given_lens());
        let pose = calibrated.as_ref().and_then(|c| c.pose);
        let optics = own.or(calibrated.map(|c| (c.intrinsics, c.lens)));
        out.push(optics.map(|(intrinsics, lens)| Known { intrinsics, lens, pose }));
    }
    Ok(out)
}

/// Some grey images of a camera, spread over the recording.
fn some(folder: &Path, pictures: &Pictures) -> Result<Vec<Planes<f32>>> {
    let count = pictures.shots.len();
    let look = |k: usize| {
        let rgb = Rgb8::read(&folder.join(pictures.file((2 * k + 1) * count / (2 * SAMPLED))))?;
        let mut grey = Planes::new(1, rgb.height, rgb.width);
        let mean = |p: &[u8]| p.iter().map(|v| f32::from(*v)).sum::<f32>() / (3.0 * 255.0);
        grey.data.iter_mut().zip(rgb.data.chunks_exact(3)).for_each(|(v, p)| *v = mean(p));
        Ok(grey)
    };
    (0..SAMPLED).map(look).collect()
}
