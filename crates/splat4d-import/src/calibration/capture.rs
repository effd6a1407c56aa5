//! Our own `capture.json`: the poses of an earlier take of the same rig.

use super::opencv::whole_size;
use super::tree::Tree;
use super::{Dialect, Part, Said, Text};
use splat4d::math::Se3;
use splat4d::scene::{Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};

pub(super) const DIALECT: Dialect = Dialect { name: "capture.json of another capture", reads, read };

const POSES: [&str; 2] = ["world_to_camera", "camera_to_world"];

fn list(text: &Text) -> &[Tree] {
    text.tree.get("cameras").and_then(Tree::list).unwrap_or_default()
}

fn reads(text: &Text) -> bool {
    list(text).first().is_some_and(|c| POSES.iter().any(|k| c.get(k).is_some()))
}

fn read(text: &Text) -> Result<Said> {
    let opengl = match text.tree.get("axes").and_then(Tree::text).as_deref() {
        None | Some("opencv") => false,
        Some("opengl") => true,
        Some(other) => return Err(Error::input(format!("axes is {other:.40}")).remedy("Write opencv or opengl.")),
    };
    let mut said = Said::default();
    for (k, tree) in list(text).iter().enumerate() {
        let name = tree.get("name").and_then(Tree::text).unwrap_or_else(|| k.to_string());
        let part = camera(tree, opengl).map_err(|e| e.at(format!("camera {name:.80}")))?;
        said.parts.push(Part { names: vec![name], ..part });
    }
    Ok(said)
}

fn number(tree: &Tree, key: &str) -> Result<f64> {
    let value = tree.get(key).and_then(Tree::number).filter(|v| v.is_finite());
    value.ok_or_else(|| Error::input(format!("{key} is missing or not a number")).remedy("See docs/capture-format.md."))
}

/// Numbers of a list in the lens; none where it is left out.
fn terms<const N: usize>(tree: Option<&Tree>, key: &str) -> Result<[f64; N]> {
    let Some(values) = tree.and_then(|t| t.get(key)) else { return Ok([0.0; N]) };
    let found = super::opencv::numbers(key, values)?.data;
    if found.len() > N {
        return Err(Error::input(format!("{key} has {} numbers, not {N} at most", found.len())));
    }
    Ok(std::array::from_fn(|i| found.get(i).copied().unwrap_or(0.0)))
}

fn camera(tree: &Tree, opengl: bool) -> Result<Part> {
    let intrinsics = Intrinsics {
        fx: number(tree, "fx")?,
        fy: number(tree, "fy")?,
        cx: number(tree, "cx")?,
        cy: number(tree, "cy")?,
    };
    let distortion = tree.get("distortion");
    let model = distortion.and_then(|d| d.get("model")).and_then(Tree::text);
    let lens = match model.as_deref() {
        None | Some("pinhole") => Lens::Pinhole,
        Some("opencv") => {
            let (k, p, s) = (terms(distortion, "k")?, terms(distortion, "p")?, terms(distortion, "s")?);
            if k == [0.0; 6] && p == [0.0; 2] && s == [0.0; 4] { Lens::Pinhole } else { Lens::Brown { k, p, s } }
        }
        Some(other) => {
            let (k, p, s) = (terms::<6>(distortion, "k")?, terms::<2>(distortion, "p")?, terms::<4>(distortion, "s")?);
            Lens::of_terms(other, [&k, &p, &s]).ok_or_else(|| {
                let names = Lens::MODELS.map(|(name, _)| name).join(", ");
                Error::new(ErrorKind::Unsupported, format!("the distortion model {other:.40} is not known"))
                    .remedy(format!("Write one of {names}."))
            })?
        }
    };
    let (key, value) = POSES
        .iter()
        .find_map(|k| tree.get(k).map(|v| (*k, v)))
        .ok_or_else(|| Error::input("its pose is missing").remedy("Give world_to_camera or camera_to_world."))?;
    if value.list().and_then(|l| l.first()).and_then(Tree::list).is_some_and(|l| l.iter().any(|v| v.list().is_some())) {
        return Err(Error::input("the camera moves: it has a pose for each frame")
            .remedy("A calibration is for fixed cameras."));
    }
    let m = super::opencv::numbers(key, value)?;
    if m.columns != 4 || m.rows < 3 {
        return Err(Error::input(format!("{key} is {}x{}", m.rows, m.columns)).remedy("It must be 4x4 or 3x4."));
    }
    let mut pose = Se3 {
        rotation: std::array::from_fn(|i| std::array::from_fn(|k| m.data[4 * i + k])),
        translation: std::array::from_fn(|i| m.data[4 * i + 3]),
    };
    let to_world = key == "camera_to_world";
    if opengl {
        // y and z of the camera are negated: columns of camera to world, rows of world to camera.
        for axis in 1..3 {
            if to_world {
                (0..3).for_each(|i| pose.rotation[i][axis] *= -1.0);
            } else {
                pose.rotation[axis] = pose.rotation[axis].map(|v| -v);
                pose.translation[axis] *= -1.0;
            }
        }
    }
    if to_world {
        pose = splat4d_train::capture::rigid(pose)?.inverse();
    }
    let size = whole_size(&[number(tree, "width")?, number(tree, "height")?])?;
    Ok(Part { names: Vec::new(), size: Some(size), optics: Some((intrinsics, lens)), pose: Some(pose) })
}
