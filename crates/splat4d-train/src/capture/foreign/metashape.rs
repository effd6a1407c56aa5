//! Agisoft Metashape's `cameras.xml` (File, Export, Export Cameras, Agisoft XML).
//!
//! A camera's `transform` takes its axes (x right, y down, z forward) to the chunk's; that of the chunk or component
//! takes those to the world, with a scale. Calibrations: f in pixels; cx, cy from the image's middle; Brown's terms
//! with p1 and p2 in the opposite order to OpenCV; b1 added to f across. Source: Metashape Professional user manual,
//! "Camera models", and Agisoft's description of the format.

use super::{Convention, Export, Images, Said, Shot, only_points, take, without_pose};
use crate::capture::{CaptureKind, CaptureOptions, RawCapture, json, panorama, pose, rig};
use crate::text;
use roxmltree::{Document, Node};
use splat4d::math::{Se3, Sim3};
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub(super) const EXPORT: Export = Export { find, is, read };

/// The usual name; other names are examined.
const NAME: &str = "cameras.xml";
/// Skew that is not reported, pixels.
const MAX_SKEW: f64 = 0.5;
/// Bytes at the beginning of a file in which it names its elements.
const HEAD: usize = 4096;

fn find(root: &Path) -> Option<PathBuf> {
    let mut named: Vec<String> =
        rig::file_names(root).into_iter().filter(|n| n.to_lowercase().ends_with(".xml")).collect();
    named.sort_by_key(|n| n != NAME);
    named.into_iter().map(|n| root.join(n)).find(|p| is(p))
}

fn is(path: &Path) -> bool {
    use std::io::Read;
    let mut head = Vec::new();
    let read = crate::files::open(path).is_ok_and(|f| f.take(HEAD as u64).read_to_end(&mut head).is_ok());
    let text = text::decode(&head).unwrap_or_else(|_| String::from_utf8_lossy(&head));
    read && text.contains("<document") && text.contains("<chunk") && text.contains("<sensor")
}

/// A sensor's lens; its size.
struct Optics {
    intrinsics: Intrinsics,
    lens: Lens,
    size: [usize; 2],
}

fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    let bytes = json::read_bytes(marker)?;
    let text = text::decode(&bytes).unwrap_or_else(|_| String::from_utf8_lossy(&bytes));
    let text = text.trim_start_matches('\u{feff}');
    let place = |e: Error| e.at(marker.display());
    let document = Document::parse(text)
        .map_err(|e| place(Error::input(format!("is not valid XML: {e}")).remedy("Export the cameras again.")))?;
    let images = Images::below(root);
    let (mut warnings, mut notes) = (Vec::new(), Vec::new());
    let shots = shots(&document, &images, &mut warnings).map_err(place)?;
    let points = only_points(root, &mut notes)?;
    let said = Said {
        kind: CaptureKind::Metashape,
        convention: Convention::NERFIES,
        fps: None,
        points,
        up: None,
        warnings,
        notes,
    };
    take(root, shots, said, options)
}

/// The cameras of a chunk. Keyframes of animations are cameras too, without a sensor.
fn cameras<'a, 'i>(chunk: Node<'a, 'i>) -> impl Iterator<Item = Node<'a, 'i>> {
    chunk.descendants().filter(|n| n.has_tag_name("camera") && n.attribute("sensor_id").is_some())
}

fn is_enabled(camera: &Node<'_, '_>) -> bool {
    camera.attribute("enabled").is_none_or(|v| v != "0" && v != "false")
}

fn pose_of<'a, 'i>(camera: Node<'a, 'i>) -> Option<Node<'a, 'i>> {
    elements(camera, "transform").next()
}

/// Number of cameras of a chunk that can be read.
fn readable(chunk: Node<'_, '_>) -> usize {
    cameras(chunk).filter(|c| is_enabled(c) && pose_of(*c).is_some()).count()
}

/// The chunk with the most cameras that can be read, the first of equals. Errors: none has any.
fn chunk<'a, 'i>(document: &'a Document<'i>, warnings: &mut Vec<String>) -> Result<Node<'a, 'i>> {
    let chunks: Vec<Node<'_, '_>> = elements(document.root_element(), "chunk").collect();
    let Some(&chunk) = chunks.iter().rev().max_by_key(|c| readable(**c)) else {
        return Err(Error::input("it has no chunk").remedy("Export the cameras as Agisoft XML."));
    };
    if readable(chunk) == 0 {
        let all: Vec<Node<'_, '_>> = chunks.iter().flat_map(|c| cameras(*c)).collect();
        let enabled = all.iter().filter(|c| is_enabled(c)).count();
        let (what, remedy) = match (all.len(), enabled) {
            (0, _) => ("it has no cameras".to_owned(), "Export the cameras of a chunk with aligned photos."),
            (n, 0) => (format!("all of its {n} cameras are disabled"), "Enable them, and export the cameras again."),
            (_, n) => (
                format!("none of its {n} enabled cameras has a pose"),
                "Align the photos, and export the cameras again.",
            ),
        };
        return Err(Error::input(what).remedy(remedy));
    }
    let label = |c: &Node<'_, '_>| {
        format!("{:.80} ({} cameras with poses)", c.attribute("label").unwrap_or("unnamed"), readable(*c))
    };
    let others: Vec<String> = chunks.iter().filter(|c| **c != chunk && readable(**c) > 0).map(label).collect();
    if !others.is_empty() {
        warnings.push(format!(
            "The file has several chunks, each with a world of its own: {} is read, and {} not. To read another, export it alone.",
            label(&chunk),
            others.join(", ")
        ));
    }
    Ok(chunk)
}

fn shots(document: &Document<'_>, images: &Images, warnings: &mut Vec<String>) -> Result<Vec<Shot>> {
    let chunk = chunk(document, warnings)?;
    let mut sensors: BTreeMap<&str, Node<'_, '_>> = BTreeMap::new();
    sensors
        .extend(chunk.descendants().filter(|n| n.has_tag_name("sensor")).filter_map(|n| Some((n.attribute("id")?, n))));
    let whole = elements(chunk, "transform").next().map(similarity).transpose()?.unwrap_or_default();
    let mut components: BTreeMap<&str, Sim3> = BTreeMap::new();
    for component in chunk.descendants().filter(|n| n.has_tag_name("component")) {
        if let (Some(id), Some(t)) = (component.attribute("id"), elements(component, "transform").next()) {
            components.insert(id, similarity(t)?);
        }
    }
    let cameras: Vec<Node<'_, '_>> = cameras(chunk).collect();
    let (mut out, mut bare) = (Vec::new(), 0);
    for camera in cameras.iter().filter(|c| is_enabled(c)) {
        let label = camera.attribute("label").unwrap_or_default();
        let Some(transform) = pose_of(*camera) else {
            bare += 1;
            continue;
        };
        let world = camera.attribute("component_id").and_then(|id| components.get(id)).unwrap_or(&whole);
        let shot = sensors
            .get(camera.attribute("sensor_id").unwrap_or_default())
            .ok_or_else(|| Error::input("its sensor is not in the file").remedy("Export the cameras again."))
            .and_then(|sensor| shot(label, transform, *sensor, world, images));
        out.push(shot.map_err(|e| e.at(format!("camera {label:.200}")))?);
    }
    without_pose(bare, cameras.len(), warnings);
    Ok(out)
}

fn shot(label: &str, transform: Node<'_, '_>, sensor: Node<'_, '_>, world: &Sim3, images: &Images) -> Result<Shot> {
    let m: [f64; 16] = numbers(transform)?;
    let rows: [[f64; 4]; 4] = std::array::from_fn(|i| std::array::from_fn(|j| m[4 * i + j]));
    let chunk_from_cam = pose::checked(Se3::from_rows(&rows))?;
    let world_from_cam = Se3 {
        rotation: splat4d::math::se3::mat_mul(&world.rotation, &chunk_from_cam.rotation),
        translation: world.apply(chunk_from_cam.translation),
    };
    let Optics { intrinsics, lens, size } = optics(sensor)?;
    let image = images.named(label)?;
    let source = Camera {
        cam_from_world: world_from_cam.inverse(),
        intrinsics,
        lens,
        width: size[0],
        height: size[1],
        near: Camera::NEAR,
    };
    Ok(Shot { name: label.to_owned(), image, source, time: None, depth: None })
}

fn optics(sensor: Node<'_, '_>) -> Result<Optics> {
    let resolution = elements(sensor, "resolution").next();
    let side = |name: &str| resolution.and_then(|r| r.attribute(name)).and_then(|v| v.parse().ok());
    let (Some(width), Some(height)) = (side("width"), side("height")) else {
        return Err(Error::input("its sensor has no resolution").remedy("Export the cameras again."));
    };
    let size: [usize; 2] = [width, height];
    let kind = sensor.attribute("type").unwrap_or("frame");
    if kind == "spherical" {
        let (intrinsics, lens) = panorama::whole(size);
        return Ok(Optics { intrinsics, lens, size });
    }
    let all: Vec<Node<'_, '_>> = elements(sensor, "calibration").collect();
    let adjusted = all.iter().find(|c| c.attribute("class") == Some("adjusted")).or(all.first());
    let Some(calibration) = adjusted else {
        return Err(
            Error::input("its sensor has no calibration").remedy("Align the photos, and export the cameras again.")
        );
    };
    let term = |name: &'static str| -> Result<f64> {
        let Some(node) = elements(*calibration, name).next() else { return Ok(0.0) };
        Ok(numbers::<1>(node)?[0])
    };
    if elements(*calibration, "f").next().is_none() {
        return Err(Error::input("its sensor's calibration has no focal length (f)")
            .remedy("Align the photos, and export the cameras again."));
    }
    let f = term("f")?;
    if term("b2")?.abs() > MAX_SKEW {
        return Err(Error::new(ErrorKind::Unsupported, format!("its pixels are skewed (b2 = {})", term("b2")?))
            .remedy("Optimize the cameras without b2, and export them again."));
    }
    let (k, p) = ([term("k1")?, term("k2")?, term("k3")?, term("k4")?], [term("p2")?, term("p1")?]);
    let lens = match kind {
        "frame" if k == [0.0; 4] && p == [0.0; 2] => Lens::Pinhole,
        "frame" if k[3] == 0.0 => Lens::Brown { k: [k[0], k[1], k[2], 0.0, 0.0, 0.0], p, s: [0.0; 4] },
        "frame" => {
            return Err(Error::new(ErrorKind::Unsupported, "its lens has a term k4, which is not read")
                .remedy("Optimize the cameras without k4, or export undistorted photos with their cameras."));
        }
        // Equidistant, with the same terms in the plane of angles.
        "fisheye" | "equidistant_fisheye" => Lens::ThinPrismFisheye { k, p, s: [0.0; 2] },
        other => {
            return Err(Error::new(ErrorKind::Unsupported, format!("cameras of the type {other:.40} are not read"))
                .remedy("Export undistorted photos with their cameras, or poses as COLMAP."));
        }
    };
    let intrinsics = Intrinsics {
        fx: f + term("b1")?,
        fy: f,
        cx: 0.5 * width as f64 + term("cx")?,
        cy: 0.5 * height as f64 + term("cy")?,
    };
    pose::check_intrinsics(&intrinsics, width, height)?;
    Ok(Optics { intrinsics, lens, size })
}

/// Rotation, translation and scale of a chunk or component; those left out are the identity.
fn similarity(node: Node<'_, '_>) -> Result<Sim3> {
    let mut out = Sim3::default();
    if let Some(node) = elements(node, "rotation").next() {
        let m: [f64; 9] = numbers(node)?;
        out.rotation = std::array::from_fn(|i| std::array::from_fn(|j| m[3 * i + j]));
    }
    if let Some(node) = elements(node, "translation").next() {
        out.translation = numbers(node)?;
    }
    if let Some(node) = elements(node, "scale").next() {
        out.scale = numbers::<1>(node)?[0];
    }
    pose::checked(Se3 { rotation: out.rotation, translation: out.translation })?;
    if out.scale.is_nan() || out.scale <= 0.0 {
        return Err(
            Error::input(format!("invalid scale {} of the chunk", out.scale)).remedy("Export the cameras again.")
        );
    }
    Ok(out)
}

fn elements<'a, 'i>(node: Node<'a, 'i>, name: &'static str) -> impl Iterator<Item = Node<'a, 'i>> {
    node.children().filter(move |n| n.has_tag_name(name))
}

/// Exactly N numbers in an element.
fn numbers<const N: usize>(node: Node<'_, '_>) -> Result<[f64; N]> {
    let words: Vec<f64> = node.text().unwrap_or_default().split_whitespace().map_while(|w| w.parse().ok()).collect();
    <[f64; N]>::try_from(words).ok().filter(|v| v.iter().all(|x| x.is_finite())).ok_or_else(|| {
        let name = node.tag_name().name();
        Error::input(format!("<{name}> does not hold {N} finite numbers")).remedy("Export the cameras again.")
    })
}
