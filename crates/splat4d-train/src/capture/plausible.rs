//! Whether intrinsics and lenses can be those of the images: principal point, field of view, distortion. Cheap: opens
//! no image.

use super::account::Aspect;
use super::account::Severity;
use super::lens::Distortion;
use super::{RawCapture, RawFrame};
use splat4d::scene::{Camera, Lens};
use std::collections::BTreeSet;

/// Of the side: a principal point that is farther from the middle is that of another size, or of a cropped image.
const OFF_CENTRE: f64 = 0.2;
/// Fields of view along the longer side that photos with straight lines have, degrees: super telephoto to the widest
/// lenses (10 mm in front of 36 mm film: 122°).
const FIELDS: [f64; 2] = [2.0, 130.0];
/// By how much a lens of straight lines moves the middle of an image's side at most, as a ratio: action cameras stay
/// below 1.5.
const MOST_BEND: f64 = 2.5;

/// Something that a camera cannot be: what is wrong, and what is probably the cause.
type Doubt = fn(&Camera) -> Option<String>;

const DOUBTS: [(Doubt, &str); 3] = [
    (
        off_centre,
        "They are probably of another image size, or the images were cropped: state the size (w, h) that they are for",
    ),
    (odd_field, "Focal lengths are given in pixels of these images"),
    (odd_bend, "Check the order, the signs and the model of the terms"),
];

/// Warns of intrinsics that are hardly those of the images.
pub(super) fn check(take: &mut RawCapture) {
    for (doubt, cause) in DOUBTS {
        let odd: Vec<(&RawFrame, String)> = take.frames.iter().filter_map(|f| Some((f, doubt(&f.source)?))).collect();
        let Some((first, what)) = odd.first() else { continue };
        let cameras: BTreeSet<usize> = odd.iter().map(|(f, _)| f.camera).collect();
        let what = format!(
            "The intrinsics of {} of {} images ({} cameras) look wrong: {what} (camera {}). {cause}.",
            odd.len(),
            take.frames.len(),
            cameras.len(),
            take.cameras[first.camera]
        );
        take.account.add(Aspect::Assumed, Severity::Warning, what);
    }
}

fn off_centre(camera: &Camera) -> Option<String> {
    let (k, w, h) = (&camera.intrinsics, camera.width as f64, camera.height as f64);
    let far = (k.cx / w - 0.5).abs().max((k.cy / h - 0.5).abs());
    (far > OFF_CENTRE && !is_whole_sphere(camera)).then(|| {
        format!("the principal point ({:.1}, {:.1}) is far from the centre of an image of {w:.0}x{h:.0}", k.cx, k.cy)
    })
}

fn odd_field(camera: &Camera) -> Option<String> {
    let (k, w, h) = (&camera.intrinsics, camera.width as f64, camera.height as f64);
    let straight = matches!(camera.lens, Lens::Pinhole | Lens::Brown { .. });
    let field = 2.0 * (0.5 * (w / k.fx).max(h / k.fy)).atan().to_degrees();
    (straight && !(FIELDS[0]..=FIELDS[1]).contains(&field))
        .then(|| format!("the focal length {:.1} px makes a field of view of {field:.1}°", k.fx))
}

fn odd_bend(camera: &Camera) -> Option<String> {
    let Lens::Brown { .. } = camera.lens else { return None };
    let (k, lens) = (&camera.intrinsics, Distortion::new(camera.lens));
    let (w, h) = (camera.width as f64, camera.height as f64);
    let sides = [[0.0, 0.5 * h], [w, 0.5 * h], [0.5 * w, 0.0], [0.5 * w, h]];
    let bend = |[u, v]: [f64; 2]| {
        let at = [(u - k.cx) / k.fx, (v - k.cy) / k.fy];
        let ray = lens.undistort(at)?;
        let ratio = at[0].hypot(at[1]) / ray[0].hypot(ray[1]).max(f64::MIN_POSITIVE);
        Some(ratio.max(1.0 / ratio))
    };
    let bends: Option<Vec<f64>> = sides.into_iter().map(bend).collect();
    let Some(bends) = bends else {
        return Some("no ray reaches the middle of a side: the lens folds before it".into());
    };
    let most = bends.into_iter().fold(1.0, f64::max);
    (most > MOST_BEND).then(|| format!("the lens moves the middle of a side by a factor of {most:.1} from the centre"))
}

/// Whether a camera represents a whole panorama.
fn is_whole_sphere(camera: &Camera) -> bool {
    matches!(camera.lens, Lens::Equirectangular { .. })
}
