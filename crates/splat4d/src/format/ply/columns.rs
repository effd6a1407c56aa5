//! Which property of a .ply holds what, in the dialects of 3DGS and of the methods built on it.

use super::header::{Element, broken};
use super::{DC_NAMES, F_REST_COUNTS, GEOMETRY_NAMES, RGB_NAMES, SHORT_RGB_NAMES};
use crate::{Error, ErrorKind, Result};

/// The size of Gaussians in their third direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Thickness {
    /// Stated: three scales.
    Stated,
    /// Two scales: flat Gaussians (Huang et al. 2024, 2D Gaussian Splatting).
    None,
    /// One scale: spheres.
    Sphere,
}

/// Properties of Gaussians, by their positions in the element.
pub(super) struct Columns {
    /// One for each column of the geometry; those of scales that are not there repeat the first.
    pub(super) geometry: Vec<usize>,
    /// One for each column of the spherical harmonics.
    pub(super) sh: Vec<usize>,
    /// Whether the base colour is RGB.
    pub(super) rgb: bool,
    pub(super) thickness: Thickness,
    /// The size of the 3D filter of Mip-Splatting.
    pub(super) filter: Option<usize>,
}

/// The 3D filter of Mip-Splatting, and of Gaussian Opacity Fields, which took it over.
const FILTER: &str = "filter_3D";
/// Properties that change the appearance of a Gaussian, and which method writes them. Sources: the methods' `save_ply`.
const KERNELS: [(&str, &str); 2] =
    [("beta", "Deformable Beta Splatting"), ("shape", "Generalized Exponential Splatting")];
/// How properties begin from which a network makes the Gaussians, and which methods write them.
const NETWORKS: [(&str, &str); 2] =
    [("f_anchor_feat", "anchors of Scaffold-GS or a method built on it"), ("f_offset", "anchors of Scaffold-GS")];

/// The properties of Gaussians. Errors: some are missing (the message names what the file holds in their place);
/// spherical harmonics above degree 3.
pub(super) fn of(vertex: &Element) -> Result<Columns> {
    let all = |names: [&str; 3]| names.iter().all(|n| vertex.find(n).is_some());
    let rgb = [RGB_NAMES, SHORT_RGB_NAMES].into_iter().find(|names| !all(DC_NAMES) && all(*names));
    let colors = rgb.unwrap_or(DC_NAMES);
    let thickness = match ["scale_0", "scale_1", "scale_2"].map(|n| vertex.find(n).is_some()) {
        [true, true, false] => Thickness::None,
        [true, false, false] => Thickness::Sphere,
        _ => Thickness::Stated,
    };
    let stated = |name: &str| match (name, thickness) {
        ("scale_2", Thickness::None) | ("scale_1" | "scale_2", Thickness::Sphere) => "scale_0".to_owned(),
        _ => name.to_owned(),
    };
    let wanted: Vec<String> = GEOMETRY_NAMES.into_iter().map(stated).chain(colors.map(str::to_owned)).collect();
    let missing: Vec<&str> = wanted.iter().map(String::as_str).filter(|n| vertex.find(n).is_none()).collect();
    if !missing.is_empty() {
        return Err(lacking(vertex, &missing, rgb.is_some()));
    }
    let mut columns: Vec<usize> = wanted.iter().map(|name| vertex.find(name).expect("checked above")).collect();
    let mut sh = columns.split_off(GEOMETRY_NAMES.len());
    sh.extend(f_rest_columns(vertex)?);
    Ok(Columns { geometry: columns, sh, rgb: rgb.is_some(), thickness, filter: vertex.find(FILTER) })
}

/// Assumptions about the columns, and effects of `extra` properties that are not read.
pub(super) fn assumptions(rgb: bool, thickness: Thickness, filtered: bool, extra: &[String]) -> Vec<String> {
    let mut out = Vec::new();
    let mut say = |when: bool, what: &str| out.extend(when.then(|| what.to_owned()));
    say(rgb, "base colours are read from RGB (red, green, blue), as there are no f_dc_0..2");
    say(thickness == Thickness::None, "there is no scale_2: Gaussians are flat, as 2D Gaussian Splatting writes them");
    say(thickness == Thickness::Sphere, "there is one scale: Gaussians are spheres");
    say(filtered, "the 3D filter of Mip-Splatting (filter_3D) is applied to scales and opacities");
    for (name, method) in KERNELS {
        let what =
            format!("`{name}` of {method} is not read: its kernels are rendered as Gaussians, which looks different");
        say(extra.iter().any(|n| n == name), &what);
    }
    out
}

/// The error about an element that lacks properties of Gaussians.
fn lacking(vertex: &Element, missing: &[&str], rgb: bool) -> Error {
    let names = || vertex.properties.iter().map(|p| p.name.as_str());
    if let Some((_, what)) = NETWORKS.iter().find(|(begin, _)| names().any(|n| n.starts_with(begin))) {
        let what = format!("this file holds {what}: a network makes the Gaussians of them for each view");
        return Error::new(ErrorKind::Unsupported, what).remedy(
            "Such a scene cannot be rendered without its network. Export the Gaussians of one view, or train with 3DGS",
        );
    }
    let is_position = |n: &&str| ["x", "y", "z"].contains(n);
    let without = GEOMETRY_NAMES.len() - 3 + if rgb { 0 } else { DC_NAMES.len() };
    if missing.len() == without && !missing.iter().any(is_position) {
        let names: Vec<&str> = names().take(8).collect();
        return Error::input(format!(
            "this is a point cloud without Gaussians: its points have {} only, no scale, rotation or opacity",
            names.join(", ")
        ))
        .remedy("A point cloud can start a training, but it cannot be rendered; give a trained .ply");
    }
    Error::input(format!("the element `vertex` lacks the properties {}", missing.join(", ")))
        .remedy("A file of 3D Gaussians has x y z, f_dc_0..2 (or red green blue), opacity, scale_0..2 and rot_0..3")
}

/// The f_rest properties of an element, in coefficient-major order.
pub(super) fn f_rest_columns(element: &Element) -> Result<Vec<usize>> {
    let count = element.properties.iter().filter(|p| p.name.starts_with("f_rest_")).count();
    if !F_REST_COUNTS.contains(&count) {
        let what = format!("there are {count} f_rest properties; degree 0-3 has 0, 9, 24 or 45");
        return Err(Error::new(ErrorKind::Unsupported, what)
            .remedy("Export the file again with spherical harmonics of degree 3 or less"));
    }
    let rest = count / 3;
    let mut out = Vec::with_capacity(count);
    for k in 0..rest {
        for c in 0..3 {
            let name = format!("f_rest_{}", c * rest + k);
            let Some(i) = element.find(&name) else {
                return Err(broken(format!("there are {count} f_rest properties, but no `{name}` among them")));
            };
            out.push(i);
        }
    }
    Ok(out)
}
