//! Ground truth: depth and optical flow of a few views, vertex tracks with visibility, and a sparse cloud.

use crate::camera::Camera;
use crate::files::{png, write_file};
use crate::mesh::Mesh;
use crate::picture::{EdgeCache, point_at, surface};
use crate::raster::{NOTHING, SUPERSAMPLING, Visibility, sample_ray};
use crate::scene::Frame;
use crate::vector::{V3, hash01};
use anyhow::Result;
use image::ExtendedColorType;
use serde_json::json;
use std::path::Path;

/// Depth codes per scene unit in the 16-bit images; code 0 means "nothing".
pub(crate) const DEPTH_SCALE: f64 = 2048.0;
/// Flow codes per pixel; code 32768 is no motion (the KITTI 2012 convention).
pub(crate) const FLOW_SCALE: f64 = 64.0;
/// Vertex tracks.
pub(crate) const TRACKS: usize = 200;
/// A vertex counts as seen when it is at most this far behind what its pixel shows, scene units.
const SEEN_TOLERANCE: f64 = 0.03;
/// The sparse cloud of a rig: what structure from motion finds of a few views that are far apart.
pub(crate) const CLOUD: Cloud = Cloud { count: 3000, noise: 0.005 };
/// Cameras that must see a point of the cloud or of a track in the first frame.
const CLOUD_VIEWS: usize = 3;

/// Writes `depth/CAM/FRAME.png`, `labels/CAM/FRAME.png` and, where there is a next frame, `flow/CAM/FRAME.png`.
pub(crate) fn write_maps(
    folder: &Path,
    camera: &Camera,
    seen: &Visibility,
    t: usize,
    frame: &Frame,
    next: Option<&Frame>,
) -> Result<()> {
    let bytes = |codes: Vec<u16>| -> Vec<u8> { codes.iter().flat_map(|c| c.to_ne_bytes()).collect() };
    let save = |kind: &str, data: &[u8], color: ExtendedColorType| {
        let file = png(data, camera.width, camera.height, color)?;
        write_file(&folder.join(format!("{kind}/{}/{t:04}.png", camera.name)), &file)
    };
    save("depth", &bytes(depth(camera, seen, frame)), ExtendedColorType::L16)?;
    save("labels", &labels(camera, seen, frame), ExtendedColorType::L8)?;
    match next {
        Some(next) => save("flow", &bytes(flow(camera, seen, frame, next)), ExtendedColorType::Rgb16),
        None => Ok(()),
    }
}

/// Adds what [`write_maps`] wrote to a camera's entry of `capture.json`. The names of the labels belong at its top.
pub(crate) fn list_maps(entry: &mut serde_json::Value, camera: &Camera) {
    entry["depth"] = json!(format!("depth/{}/%04d.png", camera.name));
    entry["depth_scale"] = json!(1.0 / DEPTH_SCALE);
    entry["flow"] = json!(format!("flow/{}/%04d.png", camera.name));
    entry["labels"] = json!(format!("labels/{}/%04d.png", camera.name));
}

/// Depth (z in camera axes) at pixel centres, one code per pixel.
pub(crate) fn depth(camera: &Camera, seen: &Visibility, frame: &Frame) -> Vec<u16> {
    pixels(camera)
        .map(|(x, y)| surface(frame, camera, seen, x, y).map_or(0, |(_, _, z)| (z * DEPTH_SCALE).round() as u16))
        .collect()
}

/// Flow to the next frame at pixel centres: (u, v, valid) codes per pixel. Not valid: what no longer exists.
pub(crate) fn flow(camera: &Camera, seen: &Visibility, frame: &Frame, next: &Frame) -> Vec<u16> {
    let mut out = Vec::with_capacity(3 * camera.width * camera.height);
    for (x, y) in pixels(camera) {
        let moved = surface(frame, camera, seen, x, y).and_then(|(index, weights, _)| {
            let triangle = frame.mesh.triangles[index as usize];
            let object = triangle.object as usize;
            let (from, to) = (frame.first_vertex[object]?, next.first_vertex[object]?);
            let point = point_at(&next.mesh, triangle.vertices.map(|v| v - from + to), weights);
            let ([u, v], _) = camera.project(point);
            Some([u - (x as f64 + 0.5), v - (y as f64 + 0.5)])
        });
        let code = |d: f64| (d * FLOW_SCALE + 32768.0).round() as u16;
        out.extend(moved.map_or([0; 3], |[u, v]| [code(u), code(v), 1]));
    }
    out
}

/// The object that each pixel's centre shows, 0 the static set; 255 where there is none.
pub(crate) fn labels(camera: &Camera, seen: &Visibility, frame: &Frame) -> Vec<u8> {
    let object = |(index, ..): (u32, _, _)| frame.mesh.triangles[index as usize].object;
    pixels(camera).map(|(x, y)| surface(frame, camera, seen, x, y).map_or(u8::MAX, object)).collect()
}

fn pixels(camera: &Camera) -> impl Iterator<Item = (usize, usize)> + '_ {
    (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)))
}

/// The tracked vertices: evenly strided over those skinned vertices that at least [`CLOUD_VIEWS`] of the views see in
/// `frame` (most others are inside helmets and sleeves), half of them on each character.
pub(crate) fn tracked_vertices(frame: &Frame, views: &[(&Camera, &Visibility)]) -> Vec<usize> {
    let seen = |vertex: &usize| {
        let point = frame.mesh.positions[*vertex];
        views.iter().filter(|(camera, seen)| is_seen(camera, seen, point)).count() >= CLOUD_VIEWS
    };
    let half = TRACKS / 2;
    let mut out = Vec::with_capacity(TRACKS);
    for range in &frame.skinned {
        let candidates: Vec<usize> = range.clone().filter(seen).collect();
        assert!(candidates.len() >= half, "a character shows {} vertices, {half} are needed", candidates.len());
        out.extend((0..half).map(|i| candidates[i * candidates.len() / half]));
    }
    out
}

/// 1 for each of `points` that the camera sees.
pub(crate) fn seen_points(camera: &Camera, seen: &Visibility, points: &[V3]) -> Vec<u8> {
    points.iter().map(|p| u8::from(is_seen(camera, seen, *p))).collect()
}

fn is_seen(camera: &Camera, seen: &Visibility, point: V3) -> bool {
    if camera.to_camera_axes(point).z <= 0.0 {
        return false;
    }
    let ([x, y], depth) = camera.project(point);
    let (column, row) = ((x * SUPERSAMPLING as f64).floor(), (y * SUPERSAMPLING as f64).floor());
    if column < 0.0 || row < 0.0 || column >= seen.width as f64 || row >= seen.height as f64 {
        return false;
    }
    let inverse = f64::from(seen.inverse_depths[row as usize * seen.width + column as usize]);
    inverse * (depth - SEEN_TOLERANCE) <= 1.0
}

/// What a sparse cloud is like.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cloud {
    pub count: usize,
    /// Standard deviation of the noise per axis, scene units.
    pub noise: f64,
}

/// A point of the sparse cloud: position and sRGB colour.
pub(crate) type CloudPoint = ([f32; 3], [u8; 3]);

/// Replaces structure from motion: random pixels of the first frame, kept when enough cameras see the point, with
/// noise. `views` are the training cameras with what they see and their images.
pub(crate) fn sparse_cloud(
    frame: &Frame,
    views: &[(&Camera, &Visibility, &[u8])],
    Cloud { count, noise }: Cloud,
) -> Vec<CloudPoint> {
    let mut cloud = Vec::with_capacity(count);
    let mut caches: Vec<EdgeCache> = views.iter().map(|_| EdgeCache::default()).collect();
    let mut draw = 0;
    while cloud.len() < count {
        let random = |k: i64| hash01(draw, k);
        let view = (random(0) * views.len() as f64) as usize;
        let (camera, seen, rgb) = views[view];
        let (x, y) = ((random(1) * camera.width as f64) as usize, (random(2) * camera.height as f64) as usize);
        let (column, row) = (x * SUPERSAMPLING + SUPERSAMPLING / 2, y * SUPERSAMPLING + SUPERSAMPLING / 2);
        let index = seen.triangles[row * seen.width + column];
        if index != NOTHING {
            let edges = caches[view].get(&frame.mesh, camera, index);
            let (weights, _) = edges.weights(sample_ray(camera, column, row));
            let point = point_at(&frame.mesh, frame.mesh.triangles[index as usize].vertices, weights);
            if views.iter().filter(|(camera, seen, _)| is_seen(camera, seen, point)).count() >= CLOUD_VIEWS {
                // Twelve uniform numbers minus six have variance 1 and nearly a normal distribution.
                let noise = |axis: i64| ((0..12).map(|i| random(10 + 12 * axis + i)).sum::<f64>() - 6.0) * noise;
                let p = point.array();
                let at = 3 * (y * camera.width + x);
                let position = std::array::from_fn(|i| (p[i] + noise(i as i64)) as f32);
                cloud.push((position, [rgb[at], rgb[at + 1], rgb[at + 2]]));
            }
        }
        draw += 1;
    }
    cloud
}

/// World positions of the tracked vertices.
pub(crate) fn track_points(mesh: &Mesh, vertices: &[usize]) -> Vec<V3> {
    vertices.iter().map(|v| mesh.positions[*v]).collect()
}

/// A C-ordered .npy file, version 1.0. `kind` is NumPy's name of the element ("<f4", "|u1").
pub(crate) fn npy(kind: &str, shape: &[usize], data: &[u8]) -> Vec<u8> {
    let shape: String = shape.iter().map(|n| format!("{n}, ")).collect();
    let mut header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({}), }}", shape.trim_end());
    // Magic, version and length take ten bytes; the whole header is a multiple of 64 and ends with a newline.
    let padded = (10 + header.len() + 1).next_multiple_of(64) - 10;
    header.push_str(&" ".repeat(padded - header.len() - 1));
    header.push('\n');
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((padded as u16).to_le_bytes());
    out.extend(header.into_bytes());
    out.extend_from_slice(data);
    out
}

/// A binary little-endian .ply file of the cloud.
pub(crate) fn ply(cloud: &[CloudPoint]) -> Vec<u8> {
    let mut out = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", cloud.len());
    for axis in ["x", "y", "z"] {
        out.push_str(&format!("property float {axis}\n"));
    }
    for channel in ["red", "green", "blue"] {
        out.push_str(&format!("property uchar {channel}\n"));
    }
    out.push_str("end_header\n");
    let mut out = out.into_bytes();
    for (position, color) in cloud {
        position.iter().for_each(|v| out.extend(v.to_le_bytes()));
        out.extend(color);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::rasterize;
    use crate::scene::Stage;
    use crate::vector::v3;

    #[test]
    fn flow_and_depth_agree_with_the_tracks() {
        let stage = Stage::load(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/knight/characters")));
        let stage = stage.expect("characters load");
        let camera = Camera::look_at("c".into(), v3(0.8, 1.9, 5.0), v3(0.0, 1.0, 0.0), 300.0, 400, 300);
        let (frame, next) = (stage.frame(5).expect("frame"), stage.frame(6).expect("frame"));
        let seen = rasterize(&frame.mesh, &camera);
        let (depth, flow) = (depth(&camera, &seen, &frame), flow(&camera, &seen, &frame, &next));
        let view = (&camera, &seen);
        let vertices = tracked_vertices(&frame, &[view, view, view]);
        assert_eq!(vertices.len(), TRACKS);
        let (from, to) = (track_points(&frame.mesh, &vertices), track_points(&next.mesh, &vertices));
        let visible = seen_points(&camera, &seen, &from);
        let (mut flow_errors, mut moved, mut covered) = (Vec::new(), 0.0f64, 0);
        for i in (0..TRACKS).filter(|i| visible[*i] == 1) {
            let (([x, y], z), ([x1, y1], _)) = (camera.project(from[i]), camera.project(to[i]));
            let at = y as usize * camera.width + x as usize;
            let shown = f64::from(depth[at]) / DEPTH_SCALE;
            covered += usize::from(shown < z - 0.1);
            let [u, v] = [0, 1].map(|c| (f64::from(flow[3 * at + c]) - 32768.0) / FLOW_SCALE);
            flow_errors.push((u - (x1 - x)).abs().max((v - (y1 - y)).abs()));
            moved = moved.max((x1 - x).abs());
        }
        // At a silhouette the pixel's centre may show something nearer than the vertex next to it.
        assert!(10 * covered < flow_errors.len(), "{covered} of {} visible vertices lie behind", flow_errors.len());
        flow_errors.sort_by(f64::total_cmp);
        assert!(flow_errors.len() > 50 && moved > 4.0, "{} visible, moved {moved}", flow_errors.len());
        // The pixel's centre is up to 0.7 px from the vertex, at silhouettes on another part: hence the median.
        let median = flow_errors[flow_errors.len() / 2];
        assert!(median < 0.2, "median difference {median} px");
    }

    #[test]
    fn npy_headers_are_aligned() {
        let bytes = npy("<f4", &[2, 3], &[7; 24]);
        assert_eq!((bytes.len() - 24) % 64, 0);
        assert!(bytes.starts_with(b"\x93NUMPY\x01\x00") && bytes[bytes.len() - 25] == b'\n');
    }
}
