//! Qualisys' .qca.txt and calibration XML. Focal lengths and principal points are in 64ths of a pixel, positions in
//! millimetres; the camera's axes are x right, y up, z backward, as columns of R. Distortion is OpenCV's.

use super::tree::Tree;
use super::{Dialect, Part, Said, Text, Unit};
use splat4d::math::Se3;
use splat4d::math::se3::mat_vec;
use splat4d::scene::Intrinsics;
use splat4d::{Error, Result};

pub(super) const DIALECT: Dialect = Dialect { name: "Qualisys (.qca.txt, XML)", reads, read };

/// Parts of a pixel in which the sensor is measured.
const SUBPIXELS: f64 = 64.0;
/// Millimetres of a metre.
const MILLIMETRES: f64 = 1000.0;

type Attributes = Vec<(String, String)>;

fn inside<'a>(children: &'a [Tree], tag: &str) -> impl Iterator<Item = (&'a Attributes, &'a [Tree])> {
    children.iter().filter_map(move |t| match t {
        Tree::Element(name, attributes, children) if name == tag => Some((attributes, children.as_slice())),
        _ => None,
    })
}

fn cameras(tree: &Tree) -> Option<&[Tree]> {
    match tree {
        Tree::Element(name, _, children) if name == "calibration" => inside(children, "cameras").next().map(|c| c.1),
        _ => None,
    }
}

fn reads(text: &Text) -> bool {
    cameras(&text.tree).is_some_and(|c| inside(c, "camera").next().is_some())
}

fn word<'a>(attributes: &'a Attributes, key: &str) -> Option<&'a str> {
    attributes.iter().find(|(k, _)| k == key).map(|(_, v)| v.as_str())
}

fn number(attributes: &Attributes, key: &str) -> Result<f64> {
    let text = word(attributes, key)
        .ok_or_else(|| Error::input(format!("{key} is missing")).remedy("Export the calibration again."))?;
    let value = text.trim().parse::<f64>().ok().filter(|v| v.is_finite());
    value.ok_or_else(|| Error::input(format!("{key} is {text:.40}")).remedy("Calibrate that camera again."))
}

fn read(text: &Text) -> Result<Said> {
    let mut said = Said { unit: Unit::Metre, ..Said::default() };
    for (attributes, children) in inside(cameras(&text.tree).unwrap_or_default(), "camera") {
        let name = word(attributes, "serial").unwrap_or_default().to_owned();
        let place = |e: Error| e.at(format!("camera {name:.80}"));
        if name.is_empty() {
            return Err(Error::input("a camera has no serial").remedy("Export the calibration again."));
        }
        let off = |key: &str, value: &str| word(attributes, key).is_some_and(|v| v.eq_ignore_ascii_case(value));
        if off("active", "0") || off("calibrated", "false") {
            said.notes.push(format!("Camera {name} is not calibrated and is left out."));
            continue;
        }
        let own = |tag: &str| {
            let found = inside(children, tag).next().map(|c| c.0);
            found.ok_or_else(|| {
                place(Error::input(format!("<{tag}> is missing")).remedy("Export the calibration again."))
            })
        };
        let part = camera(own("transform")?, own("intrinsic")?, inside(children, "fov_video").next().map(|c| c.0));
        said.parts.push(Part { names: vec![name.clone()], ..part.map_err(place)? });
    }
    Ok(said)
}

fn camera(transform: &Attributes, intrinsic: &Attributes, view: Option<&Attributes>) -> Result<Part> {
    let r = |i: usize, k: usize| number(transform, &format!("r{i}{k}"));
    let mut rotation = [[0.0; 3]; 3];
    for (i, row) in rotation.iter_mut().enumerate() {
        for (k, v) in row.iter_mut().enumerate() {
            // y down and z forward.
            *v = if i == 0 { 1.0 } else { -1.0 } * r(i + 1, k + 1)?;
        }
    }
    let center = [number(transform, "x")?, number(transform, "y")?, number(transform, "z")?].map(|v| v / MILLIMETRES);
    let translation = mat_vec(&rotation, center).map(|v| -v);
    let sub = |key: &str| number(intrinsic, key).map(|v| v / SUBPIXELS);
    let corner = |key: &str| view.map_or(Ok(0.0), |v| number(v, key));
    let intrinsics = Intrinsics {
        fx: sub("focalLengthU")?,
        fy: sub("focalLengthV")?,
        cx: sub("centerPointU")? - corner("left")?,
        cy: sub("centerPointV")? - corner("top")?,
    };
    let sides = match view {
        Some(v) => [number(v, "right")? - number(v, "left")? + 1.0, number(v, "bottom")? - number(v, "top")? + 1.0],
        None => {
            // The last 64th.
            let side = |axis: &str| {
                Ok::<f64, Error>(
                    ((sub(&format!("sensorMax{axis}"))? - sub(&format!("sensorMin{axis}"))?) + 1.0 / SUBPIXELS).round(),
                )
            };
            [side("U")?, side("V")?]
        }
    };
    let terms = [
        number(intrinsic, "radialDistortion1")?,
        number(intrinsic, "radialDistortion2")?,
        number(intrinsic, "tangentalDistortion1")?,
        number(intrinsic, "tangentalDistortion2")?,
        number(intrinsic, "radialDistortion3")?,
    ];
    Ok(Part {
        names: Vec::new(),
        size: Some(super::opencv::whole_size(&sides)?),
        optics: Some((intrinsics, super::opencv::lens(&terms, false)?)),
        pose: Some(Se3 { rotation, translation }),
    })
}
