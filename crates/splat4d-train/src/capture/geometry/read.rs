//! Files of measured surfaces, distinguished by their first bytes.

use super::surface::{Sink, Surface};
use super::{e57, las, pcd};
use crate::capture::points;
use splat4d::{Error, ErrorKind, Result};
use std::path::Path;

/// Reads a mesh (.ply, .obj) or a cloud (.ply, .npy, .npz, .las, .pcd, .e57).
///
/// Errors: another kind of file; damage; no points.
pub(super) fn read(bytes: &[u8], path: &Path) -> Result<Surface> {
    let is = |ending: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(ending));
    let read = match bytes {
        [b'L', b'A', b'S', b'F', ..] => las::read(bytes),
        [b'A', b'S', b'T', b'M', b'-', b'E', b'5', b'7', ..] => e57::read(bytes),
        _ if bytes.starts_with(b"# .PCD") || bytes.starts_with(b"VERSION .") || is("pcd") => pcd::read(bytes),
        _ if bytes.starts_with(b"glTF") || is("gltf") || is("fbx") || is("stl") => {
            Err(Error::new(ErrorKind::Unsupported, "meshes of this kind are not read")
                .remedy("Save the mesh as .ply or .obj, for example with Blender or MeshLab"))
        }
        _ if is("obj") => obj(bytes),
        _ => {
            let (cloud, triangles) = points::surface(bytes, path)?;
            let colors = if cloud.colors.windows(2).all(|c| c[0] == c[1]) { Vec::new() } else { cloud.colors };
            let (points, left_out) = (cloud.points, cloud.left_out);
            if !triangles.is_empty() && left_out > 0 {
                Err(Error::input(format!("{left_out} points of the mesh are not finite, or too far away"))
                    .remedy("Remove them with the faces that they belong to, or save the points without faces"))
            } else if triangles.is_empty() {
                let mut sink = Sink::new(points.len() as u64, !colors.is_empty());
                let color = |i: usize| colors.get(i).copied().unwrap_or([0.5; 3]);
                points.iter().enumerate().for_each(|(i, p)| sink.push(*p, color(i)));
                let cloud = sink.finish();
                Ok(Surface { left_out: left_out + cloud.left_out, ..cloud })
            } else {
                Ok(Surface { points, colors, triangles, left_out })
            }
        }
    };
    let surface = read?;
    if surface.points.is_empty() {
        return Err(Error::input("the file holds no points").remedy("Export the scan again, or name another file"));
    }
    Ok(surface)
}

/// Positions with optional colours, and the faces of a Wavefront .obj; everything else is skipped.
fn obj(bytes: &[u8]) -> Result<Surface> {
    let text = String::from_utf8_lossy(bytes);
    let mut out = Surface::default();
    let mut colored = true;
    let mut corners: Vec<u32> = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let wrong = |what: String| {
            let error = Error::input(what).at(format!("line {}", number + 1));
            error.remedy("Correct that line, or export the mesh again")
        };
        let mut words = line.split_ascii_whitespace();
        match words.next() {
            Some("v") => {
                let values: Vec<f64> = words.map_while(|w| w.parse().ok()).collect();
                let near = |v: &f64| v.abs() <= crate::capture::pose::FARTHEST;
                if values.len() < 3 || !values[..3].iter().all(near) {
                    return Err(wrong(format!("expected three finite coordinates, found `{line:.60}`")));
                }
                out.points.push([values[0], values[1], values[2]]);
                colored &= values.len() >= 6;
                if colored {
                    out.colors.push([3, 4, 5].map(|k| (values[k] as f32).clamp(0.0, 1.0)));
                }
            }
            Some("f") => {
                corners.clear();
                for word in words {
                    let index = word.split('/').next().and_then(|w| w.parse::<i64>().ok()).unwrap_or(0);
                    // Negative numbers count back from the last point.
                    let count = out.points.len() as i64;
                    let corner = if index < 0 { count + index } else { index - 1 };
                    if !(0..count).contains(&corner) {
                        return Err(wrong(format!(
                            "a face has the corner `{word:.30}`, and {count} points are before it"
                        )));
                    }
                    corners.push(corner as u32);
                }
                out.triangles.extend(corners.windows(2).skip(1).map(|w| [corners[0], w[0], w[1]]));
            }
            _ => {}
        }
    }
    if !colored {
        out.colors.clear();
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(name: &str, bytes: &[u8]) -> std::result::Result<Surface, String> {
        read(bytes, Path::new(name)).map_err(|e| e.to_string())
    }

    const SQUARE: [[f64; 3]; 4] = [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]];

    #[test]
    fn meshes_of_two_formats_are_the_same_triangles() {
        let obj = "mtllib x\nv 0 0 1 1 0 0\nv 1 0 1 0 1 0\nv 1 1 1 0 0 1\nv 0 1 1 1 1 1\nvn 0 0 1\nf 1//1 2/5/1 3\nf -4 3 -1\n";
        let obj = of("a.obj", obj.as_bytes()).unwrap();
        assert_eq!((&obj.points[..], &obj.triangles[..]), (&SQUARE[..], &[[0, 1, 2], [0, 2, 3]][..]));
        assert_eq!(obj.colors[2], [0.0, 0.0, 1.0]);
        let header = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n\
                      property list uchar int vertex_indices\nproperty uchar flags\nend_header\n";
        let text = format!("ply\nformat ascii 1.0\n{header}0 0 1\n1 0 1\n1 1 1\n0 1 1\n4 0 1 2 3 9\n");
        let ply = of("a.ply", text.as_bytes()).unwrap();
        assert_eq!((&ply.points, &ply.triangles, ply.colors.len()), (&obj.points, &obj.triangles, 0));
        let mut binary = format!("ply\nformat binary_little_endian 1.0\n{header}").into_bytes();
        SQUARE.iter().flatten().for_each(|v| binary.extend((*v as f32).to_le_bytes()));
        binary.push(4);
        [0i32, 1, 2, 3].iter().for_each(|i| binary.extend(i.to_le_bytes()));
        binary.push(9);
        assert_eq!(of("a.ply", &binary).unwrap(), ply);
        assert!(of("a.ply", &binary[..binary.len() - 1]).unwrap_err().contains("face"));
        let beyond = text.replace("4 0 1 2 3", "4 0 1 2 4");
        assert!(of("a.ply", beyond.as_bytes()).unwrap_err().contains("corner 4"));
    }

    #[test]
    fn the_first_bytes_decide_and_other_meshes_are_refused() {
        let points = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]];
        for file in [las::write(&points, &[], [0.0; 3]), e57::write(&points)] {
            assert_eq!(of("scan.bin", &file).unwrap().points, points);
        }
        assert!(of("a.glb", b"glTF\x02").unwrap_err().contains(".obj"));
        assert!(of("a.obj", b"v 0 0\n").unwrap_err().contains("line 1"));
        assert!(of("a.obj", b"v 0 0 0\nf 1 2 3\n").unwrap_err().contains("corner `2`"));
        assert!(of("a.obj", b"# nothing\n").unwrap_err().contains("no points"));
        assert!(of("a.xyz", b"1 2 3\n").unwrap_err().contains("numpy.save"));
    }
}
