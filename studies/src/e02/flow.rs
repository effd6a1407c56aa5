//! End-point error of a scene's flow against a capture's ground truth, `truth/flow/CAMERA_FFFF.png` as KITTI stores it:
//! 16-bit RGB, u = (R − 32768)/64 px, v = (G − 32768)/64 px to the next frame, valid where B is 1.

use serde::{Deserialize, Serialize};
use splat4d::flow::{Shot, render_flow};
use splat4d::layers::Scene;
use splat4d::render::{Antialias, RenderConfig, Renderer};
use splat4d::scene::{Lens, Time};
use splat4d::{Error, Result};
use splat4d_train::capture::Capture;
use std::path::{Path, PathBuf};

/// Code of no displacement, and codes a pixel (Geiger et al. 2012, KITTI).
const ZERO: f64 = 32_768.0;
const STEPS: f64 = 64.0;
/// Flow of fewer pixels is that of static objects.
const MOVING: f64 = 1.0;
/// An image that is less opaque has no flow to compare.
const OPAQUE: f32 = 0.5;

/// Mean end-point errors, pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct FlowError {
    /// Over all pixels that have a truth.
    pub all: f64,
    /// Pixels with true flow of at least a pixel.
    pub moving: Option<f64>,
}

/// A frame of the capture and the file with its flow.
pub(crate) type Truth = (usize, PathBuf);

/// The frames whose flow is known: a frame an image, whatever split it belongs to.
pub(crate) fn truths(capture: &Capture) -> Vec<Truth> {
    let folder = capture.root.join("truth").join("flow");
    if !folder.is_dir() {
        return Vec::new();
    }
    let path = |i: usize| {
        let frame = &capture.frames[i];
        let name = &capture.cameras[frame.camera].name;
        // A name from a file must not lead out of the folder.
        let plain = !name.contains(['/', '\\']) && frame.source.lens == Lens::Pinhole;
        let path = folder.join(format!("{name}_{:04}.png", frame.index));
        (plain && path.is_file()).then_some((i, path))
    };
    (0..capture.frames.len()).filter_map(path).collect()
}

/// The scene's error over all of them; `None` where there is no truth.
///
/// Errors: a file that is no such image, or of another size than its camera's.
pub(crate) fn error(
    scene: &Scene<f32>,
    capture: &Capture,
    truths: &[Truth],
    antialias: Antialias,
) -> Result<Option<FlowError>> {
    let mut renderer = Renderer::new(RenderConfig { antialias, ..RenderConfig::default() });
    let mut sums = [[0.0f64; 2]; 2];
    for (i, path) in truths {
        let frame = &capture.frames[*i];
        let truth = read(path)?;
        let camera = &frame.source;
        if [truth.width, truth.height] != [camera.width, camera.height] {
            return Err(Error::input(format!(
                "the flow has {}x{} pixels, its image {}x{}",
                truth.width, truth.height, camera.width, camera.height
            ))
            .at(path.display())
            .remedy("Draw the truth again, or move the folder truth/flow away."));
        }
        let next = Time(frame.time.0 + 1.0 / capture.fps);
        let found = render_flow(scene, Shot { t: frame.time, camera }, Shot { t: next, camera }, &mut renderer);
        let [u, v] = [0, 1].map(|c| found.vectors.plane(c));
        for (p, truth) in truth.vectors.iter().enumerate() {
            let Some([x, y]) = truth.filter(|_| found.weight.data[p] >= OPAQUE) else { continue };
            let off = (f64::from(u[p]) - x).hypot(f64::from(v[p]) - y);
            let kinds = if x.hypot(y) >= MOVING { 2 } else { 1 };
            for sum in sums.iter_mut().take(kinds) {
                sum[0] += off;
                sum[1] += 1.0;
            }
        }
    }
    let mean = |[sum, count]: [f64; 2]| (count > 0.0).then(|| sum / count);
    Ok(mean(sums[0]).map(|all| FlowError { all, moving: mean(sums[1]) }))
}

struct FlowTruth {
    width: usize,
    height: usize,
    /// Row by row; `None` where nothing is known.
    vectors: Vec<Option<[f64; 2]>>,
}

fn read(path: &Path) -> Result<FlowTruth> {
    let bad = |what: String| {
        Error::input(format!("it is no flow as KITTI stores it: {what}"))
            .at(path.display())
            .remedy("Draw the truth again, or move the folder truth/flow away.")
    };
    let picture = image::open(path).map_err(|e| bad(e.to_string()))?;
    let image::DynamicImage::ImageRgb16(picture) = picture else { return Err(bad("16-bit RGB is needed".into())) };
    let vector = |p: &image::Rgb<u16>| {
        let [r, g, b] = p.0;
        (b == 1).then(|| [r, g].map(|code| (f64::from(code) - ZERO) / STEPS))
    };
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    Ok(FlowTruth { width, height, vectors: picture.pixels().map(vector).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_become_pixels_and_other_images_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cam00_0003.png");
        let codes = |u: f64, v: f64, b: u16| image::Rgb([(ZERO + STEPS * u) as u16, (ZERO + STEPS * v) as u16, b]);
        let mut picture = image::ImageBuffer::from_pixel(3, 1, codes(0.0, 0.0, 0));
        picture.put_pixel(0, 0, codes(3.5, -2.25, 1));
        picture.put_pixel(2, 0, codes(-400.0, 0.0, 1));
        picture.save(&path).unwrap();
        let found = read(&path).unwrap();
        assert_eq!((found.width, found.height), (3, 1));
        assert_eq!(found.vectors, [Some([3.5, -2.25]), None, Some([-400.0, 0.0])]);
        image::GrayImage::new(3, 1).save(&path).unwrap();
        assert!(read(&path).err().unwrap().to_string().contains("16-bit"));
        std::fs::write(&path, "no image").unwrap();
        assert!(read(&path).is_err());
    }
}
