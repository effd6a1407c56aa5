//! Camera matrix, distortion, rotation and translation as in OpenCV, under the names that programs give them: OpenCV's
//! and ROS' file for each camera, OpenPose's XML, the tables of anipose, Pose2Sim, FreeMoCap and Caliscope, JSON with a
//! key per camera.

use super::tree::{Matrix, Tree};
use super::{Dialect, Part, Said, Text};
use splat4d::math::Se3;
use splat4d::math::se3::norm;
use splat4d::scene::{Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};

pub(super) const DIALECT: Dialect =
    Dialect { name: "OpenCV's camera matrix (YAML, XML, JSON; TOML of Pose2Sim, anipose, Caliscope)", reads, read };

/// OpenCV's pixel positions are 0 at the first pixel's centre, ours 0.5.
pub(super) const CENTER: f64 = 0.5;
/// Share of the focal length that skew may be: pixels are rectangles, and more is a mistake in the file.
const MAX_SKEW: f64 = 1e-3;
/// How far the last row of a camera matrix may be from 0 0 1.
const LAST_ROW: f64 = 1e-6;

/// Keys without underscores in small letters.
const MATRIX: [&str; 7] = ["matrix", "cameramatrix", "k", "intrinsics", "intrinsic", "intrinsicmatrix", "mtx"];
const DISTORTION: [&str; 9] = [
    "distortions",
    "distortion",
    "distortioncoefficients",
    "distcoeffs",
    "distcoef",
    "dist",
    "distortioncoeffs",
    "d",
    "distcoefficients",
];
const ROTATION: [&str; 6] = ["rotation", "r", "rvec", "rotationmatrix", "rot", "rotationvector"];
const TRANSLATION: [&str; 5] = ["translation", "t", "tvec", "translationvector", "trans"];
const EXTRINSICS: [&str; 3] = ["cameramatrix", "cameraextrinsics", "extrinsics"];
const SIZE: [&str; 3] = ["size", "imagesize", "resolution"];
const MODEL: [&str; 3] = ["distortionmodel", "cameramodel", "model"];

fn plain(key: &str) -> String {
    key.chars().filter(|c| *c != '_' && *c != '-').flat_map(char::to_lowercase).collect()
}

/// The value of the first of some keys that has one.
fn find<'a>(tree: &'a Tree, keys: &[&str]) -> Option<(&'a str, &'a Tree)> {
    let of = |key: &&str| tree.entries().iter().find(|(k, v)| plain(k) == **key && !is_empty(v));
    keys.iter().find_map(of).map(|(k, v)| (k.as_str(), v))
}

/// Uncalibrated cameras are missing, null or an empty list.
fn is_empty(tree: &Tree) -> bool {
    match tree {
        Tree::Word(word) => word.is_empty() || word == "null" || word == "~",
        Tree::List(list) => list.is_empty(),
        _ => false,
    }
}

/// Whether a table is a camera's.
fn is_camera(tree: &Tree) -> bool {
    let shaped = |keys: &[&str]| find(tree, keys).is_some_and(|(_, v)| v.matrix().is_some() || v.list().is_some());
    shaped(&MATRIX) || shaped(&EXTRINSICS) || shaped(&ROTATION) && shaped(&TRANSLATION)
}

/// The cameras of a file: itself, its tables, or the tables in `cameras`; with the keys they are under.
fn cameras(tree: &Tree) -> Vec<(Option<String>, &Tree)> {
    if is_camera(tree) {
        return vec![(None, tree)];
    }
    let tables = tree.get("cameras").unwrap_or(tree);
    match tables {
        Tree::List(list) => {
            let keyed = list.iter().enumerate().map(|(k, t)| (Some(k.to_string()), t));
            keyed.filter(|(_, t)| is_camera(t)).collect()
        }
        _ => tables.entries().iter().filter(|(_, t)| is_camera(t)).map(|(k, t)| (Some(k.clone()), t)).collect(),
    }
}

fn reads(text: &Text) -> bool {
    !cameras(&text.tree).is_empty()
}

fn read(text: &Text) -> Result<Said> {
    let mut said = Said::default();
    for (key, tree) in cameras(&text.tree) {
        let own =
            ["name", "camera_name"].iter().find_map(|k| tree.get(k)).and_then(Tree::text).filter(|n| !n.is_empty());
        let mut names: Vec<String> = own.into_iter().collect();
        // A file's own name identifies its camera as well as the name in it.
        names.push(key.unwrap_or_else(|| text.stem()));
        // Caliscope's number of a camera, after which it calls videos.
        let ports = ["port", "cam_id"].iter().filter_map(|k| tree.get(k)).filter_map(Tree::text);
        let ports: Vec<String> = ports.flat_map(|p| [format!("port_{p}"), format!("cam_{p}")]).collect();
        names.extend(ports);
        names.dedup();
        let place = |e: Error| e.at(format!("camera {:.80}", names[0]));
        let part = camera(tree).map_err(place)?;
        said.parts.push(Part { names, ..part });
    }
    Ok(said)
}

fn camera(tree: &Tree) -> Result<Part> {
    let matrix = MATRIX
        .iter()
        .filter_map(|key| find(tree, &[key]))
        // OpenPose calls its 3x4 extrinsics the camera matrix.
        .find(|(_, v)| v.matrix().is_none_or(|m| m.columns != 4))
        .map(|(key, v)| numbers(key, v))
        .transpose()?;
    let distortion = find(tree, &DISTORTION).map(|(key, v)| numbers(key, v)).transpose()?;
    let optics = match matrix {
        Some(matrix) => {
            let terms = distortion.map_or_else(Vec::new, |d| d.data);
            Some((intrinsics(&matrix)?, lens(&terms, fisheye(tree)?)?))
        }
        None => None,
    };
    let stacked = EXTRINSICS
        .iter()
        .filter_map(|key| find(tree, &[key]))
        .find(|(_, v)| v.matrix().is_some_and(|m| m.columns == 4))
        .map(|(key, v)| numbers(key, v))
        .transpose()?;
    let apart = match (find(tree, &ROTATION), find(tree, &TRANSLATION)) {
        (Some((r, rotation)), Some((t, translation))) => Some(pose(&numbers(r, rotation)?, &numbers(t, translation)?)?),
        (Some((key, _)), None) | (None, Some((key, _))) => {
            return Err(
                Error::input(format!("there is {key}, but not both rotation and translation")).remedy("Add the other.")
            );
        }
        (None, None) => None,
    };
    let pose = match stacked {
        Some(m) => Some(rows34(&m)?),
        None => apart,
    };
    Ok(Part { names: Vec::new(), size: size(tree)?, optics, pose })
}

/// Finite numbers of a matrix.
pub(super) fn numbers(key: &str, tree: &Tree) -> Result<Matrix> {
    let matrix = tree.matrix().ok_or_else(|| {
        Error::input(format!("invalid {key}: expected a matrix with the stated number of values"))
            .remedy("Write it row by row.")
    })?;
    if let Some(bad) = matrix.data.iter().find(|v| !v.is_finite()) {
        return Err(Error::input(format!("{key} holds {bad}")).remedy("Calibrate that camera again."));
    }
    Ok(matrix)
}

/// Focal lengths and principal point of a 3x3 camera matrix, or of fx fy cx cy.
pub(super) fn intrinsics(m: &Matrix) -> Result<Intrinsics> {
    let wrong = |what: String| Err(Error::input(what).remedy("It must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."));
    let k: [f64; 9] = match <[f64; 9]>::try_from(m.data.as_slice()) {
        Ok(k) => k,
        Err(_) => return wrong(format!("the camera matrix is {}x{}, not 3x3", m.rows, m.columns)),
    };
    if k[6].abs() > LAST_ROW || k[7].abs() > LAST_ROW || (k[8] - 1.0).abs() > LAST_ROW {
        return wrong(format!("the last row of the camera matrix is {} {} {}", k[6], k[7], k[8]));
    }
    if k[1].abs() > MAX_SKEW * k[0].abs() || k[3].abs() > MAX_SKEW * k[0].abs() {
        let what = format!("the camera matrix has a skew of {}", if k[1] == 0.0 { k[3] } else { k[1] });
        return Err(Error::new(ErrorKind::Unsupported, what).remedy("Calibrate without skew: no camera has any."));
    }
    Ok(Intrinsics { fx: k[0], fy: k[4], cx: k[2] + CENTER, cy: k[5] + CENTER })
}

/// Whether it is a fisheye lens. Errors: a model that captures do not have.
fn fisheye(tree: &Tree) -> Result<bool> {
    if let Some((_, value)) = find(tree, &["fisheye", "fisheyemodel", "isfisheye"]) {
        return Ok(match value {
            Tree::Number(n) => *n != 0.0,
            other => other.text().is_some_and(|t| t.eq_ignore_ascii_case("true")),
        });
    }
    let Some(model) = find(tree, &MODEL).and_then(|(_, v)| v.text()) else { return Ok(false) };
    match plain(&model).as_str() {
        "plumbbob" | "rationalpolynomial" | "opencv" | "pinhole" | "perspective" | "brown" | "radtan" | "standard" => {
            Ok(false)
        }
        "equidistant" | "fisheye" | "kannalabrandt" | "opencvfisheye" => Ok(true),
        _ => Err(Error::new(ErrorKind::Unsupported, format!("the distortion model {model:.60} is not known"))
            .remedy("OpenCV's (plumb_bob, rational_polynomial) and its fisheye (equidistant) are.")),
    }
}

/// OpenCV's distortion: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [τx τy]]]], or k1 to k4 of a fisheye.
pub(super) fn lens(terms: &[f64], fisheye: bool) -> Result<Lens> {
    let term = |i: usize| terms.get(i).copied().unwrap_or(0.0);
    let unknown = |what: String, remedy: &str| Err(Error::new(ErrorKind::Unsupported, what).remedy(remedy));
    if fisheye {
        if terms.len() > 4 && terms[4..].iter().any(|v| *v != 0.0) {
            return unknown(format!("a fisheye with {} distortion terms", terms.len()), "It has k1 to k4.");
        }
        return Ok(Lens::Fisheye { k: std::array::from_fn(term) });
    }
    if ![0, 1, 2, 4, 5, 8, 12, 14].contains(&terms.len()) {
        return unknown(
            format!("{} distortion terms are not known", terms.len()),
            "OpenCV's are 4, 5, 8, 12 or 14: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty.",
        );
    }
    if term(12) != 0.0 || term(13) != 0.0 {
        return unknown("the sensor is tilted (tx, ty)".into(), "Calibrate without the tilted model.");
    }
    if terms.iter().all(|v| *v == 0.0) {
        return Ok(Lens::Pinhole);
    }
    Ok(Lens::Brown {
        k: [term(0), term(1), term(4), term(5), term(6), term(7)],
        p: [term(2), term(3)],
        s: std::array::from_fn(|i| term(8 + i)),
    })
}

/// World to camera of a rotation (matrix, or axis times angle) and a translation.
pub(super) fn pose(rotation: &Matrix, translation: &Matrix) -> Result<Se3> {
    let wrong = |what: &str, m: &Matrix, is: &str| {
        Error::input(format!("the {what} is {}x{}", m.rows, m.columns)).remedy(format!("It must be {is}."))
    };
    let translation = <[f64; 3]>::try_from(translation.data.as_slice())
        .map_err(|_| wrong("translation", translation, "three numbers"))?;
    let rotation = if let Ok(axis) = <[f64; 3]>::try_from(rotation.data.as_slice()) {
        rodrigues(axis)
    } else {
        let m = <[f64; 9]>::try_from(rotation.data.as_slice())
            .map_err(|_| wrong("rotation", rotation, "3x3, or three numbers (axis times angle)"))?;
        std::array::from_fn(|i| std::array::from_fn(|k| m[3 * i + k]))
    };
    Ok(Se3 { rotation, translation })
}

/// World to camera of [R | t].
fn rows34(m: &Matrix) -> Result<Se3> {
    if m.data.len() < 12 || m.columns != 4 {
        return Err(
            Error::input(format!("the extrinsics are {}x{}", m.rows, m.columns)).remedy("They must be 3x4: [R | t].")
        );
    }
    let row = |i: usize| &m.data[4 * i..4 * i + 4];
    Ok(Se3 {
        rotation: std::array::from_fn(|i| std::array::from_fn(|k| row(i)[k])),
        translation: std::array::from_fn(|i| row(i)[3]),
    })
}

/// The rotation about an axis by its length, radians (Rodrigues).
pub(super) fn rodrigues(v: [f64; 3]) -> [[f64; 3]; 3] {
    let angle = norm(v);
    // sin θ/θ and (1 − cos θ)/θ², whose series are needed near 0.
    let (a, b) = if angle < 1e-6 {
        (1.0 - angle * angle / 6.0, 0.5 - angle * angle / 24.0)
    } else {
        (angle.sin() / angle, 2.0 * (0.5 * angle).sin().powi(2) / (angle * angle))
    };
    let skew = [[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]];
    std::array::from_fn(|i| {
        std::array::from_fn(|k| {
            let square: f64 = (0..3).map(|j| skew[i][j] * skew[j][k]).sum();
            f64::from(u8::from(i == k)) + a * skew[i][k] + b * square
        })
    })
}

fn size(tree: &Tree) -> Result<Option<[usize; 2]>> {
    let sides = match find(tree, &SIZE) {
        Some((key, v)) => Some(numbers(key, v)?.data),
        None => match (find(tree, &["imagewidth", "width", "w"]), find(tree, &["imageheight", "height", "h"])) {
            (Some((_, w)), Some((_, h))) => w.number().zip(h.number()).map(|(w, h)| vec![w, h]),
            _ => None,
        },
    };
    let Some(sides) = sides else { return Ok(None) };
    whole_size(&sides).map(Some)
}

/// Pixels across and down.
pub(super) fn whole_size(sides: &[f64]) -> Result<[usize; 2]> {
    /// Pixels of a side that no camera has.
    const MOST: f64 = 32_768.0;
    match sides {
        [w, h] if [w, h].iter().all(|s| **s >= 1.0 && **s <= MOST) => Ok([w.round() as usize, h.round() as usize]),
        _ => Err(Error::input(format!("the image size is {sides:?}")).remedy("Give pixels across and down.")),
    }
}
