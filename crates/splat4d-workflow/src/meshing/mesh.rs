//! Triangles with vertex colours: small components, normals, and files.

use super::MeshFormat;
use serde_json::json;
use splat4d::math::se3::mat_vec;
use std::fmt::Write;

/// Components whose box has a diagonal of fewer voxels are floaters.
const FLOATER_VOXELS: f32 = 12.0;
/// And those below this share of the whole mesh's diagonal.
const FLOATER_SHARE: f32 = 0.01;

/// A mesh.
#[derive(Clone, Debug, Default)]
pub struct Mesh {
    /// Scene units.
    pub positions: Vec<[f32; 3]>,
    /// Unit vectors, or none at all.
    pub normals: Vec<[f32; 3]>,
    /// sRGB, or none at all.
    pub colors: Vec<[u8; 3]>,
    /// Counterclockwise from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Low and high corner of all vertices; `None` without any.
    pub fn bounds(&self) -> Option<[[f32; 3]; 2]> {
        let first = *self.positions.first()?;
        Some(self.positions.iter().fold([first; 2], |[low, high], p| {
            [std::array::from_fn(|k| low[k].min(p[k])), std::array::from_fn(|k| high[k].max(p[k]))]
        }))
    }

    /// Leaves out components with a box whose diagonal is below 12 voxels or 1 % of the mesh's, and vertices that no
    /// triangle uses; returns how many components were left out.
    pub(super) fn clean(&mut self, voxel: f32) -> usize {
        let mut root: Vec<u32> = (0..self.positions.len() as u32).collect();
        for [a, b, c] in &self.triangles {
            for other in [b, c] {
                let (a, b) = (find(&mut root, *a), find(&mut root, *other));
                let (low, high) = (a.min(b), a.max(b));
                root[high as usize] = low;
            }
        }
        let mut boxes = vec![[[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]]; root.len()];
        let mut whole = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
        let grow = |bounds: &mut [[f32; 3]; 2], p: [f32; 3]| {
            for k in 0..3 {
                (bounds[0][k], bounds[1][k]) = (bounds[0][k].min(p[k]), bounds[1][k].max(p[k]));
            }
        };
        for v in self.triangles.iter().flatten() {
            let (root, p) = (find(&mut root, *v) as usize, self.positions[*v as usize]);
            grow(&mut boxes[root], p);
            grow(&mut whole, p);
        }
        let diagonal = |[low, high]: [[f32; 3]; 2]| (0..3).map(|k| (high[k] - low[k]).powi(2)).sum::<f32>().sqrt();
        let least = (FLOATER_VOXELS * voxel).max(FLOATER_SHARE * diagonal(whole));
        let is_small = |bounds: &[[f32; 3]; 2]| bounds[0][0] <= bounds[1][0] && diagonal(*bounds) < least;
        let floaters = boxes.iter().filter(|b| is_small(b)).count();
        self.triangles.retain(|[a, ..]| !is_small(&boxes[find(&mut root, *a) as usize]));
        let mut number = vec![u32::MAX; self.positions.len()];
        self.triangles.iter().flatten().for_each(|v| number[*v as usize] = 0);
        let mut count = 0;
        for n in number.iter_mut().filter(|n| **n == 0) {
            (*n, count) = (count, count + 1);
        }
        let mut kept = number.iter().map(|n| *n != u32::MAX);
        self.positions.retain(|_| kept.next() == Some(true));
        let mut kept = number.iter().map(|n| *n != u32::MAX);
        self.colors.retain(|_| kept.next() == Some(true));
        self.triangles.iter_mut().flatten().for_each(|v| *v = number[*v as usize]);
        floaters
    }

    /// Normals of the vertices: those of their triangles, weighted by area.
    pub(super) fn find_normals(&mut self) {
        let mut normals = vec![[0.0f32; 3]; self.positions.len()];
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(|v| self.positions[v as usize]);
            let [u, v]: [[f32; 3]; 2] = [b, c].map(|p| std::array::from_fn(|k| p[k] - a[k]));
            let n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
            triangle.iter().for_each(|v| (0..3).for_each(|k| normals[*v as usize][k] += n[k]));
        }
        for n in &mut normals {
            let length = n.iter().map(|x| x * x).sum::<f32>().sqrt();
            *n = if length > 0.0 { n.map(|x| x / length) } else { [0.0, 0.0, 1.0] };
        }
        self.normals = normals;
    }

    /// Rotates positions and normals by `r` (rows).
    pub(super) fn rotate(&mut self, r: &[[f64; 3]; 3]) {
        let turn = |v: &mut [f32; 3]| *v = mat_vec(r, v.map(f64::from)).map(|x| x as f32);
        self.positions.iter_mut().chain(&mut self.normals).for_each(turn);
    }

    /// The bytes of a file. glTF has y up: the mesh must be rotated already.
    pub fn bytes(&self, format: MeshFormat) -> Vec<u8> {
        match format {
            MeshFormat::Glb => self.glb(),
            MeshFormat::Obj => self.obj().into_bytes(),
            MeshFormat::Ply => self.ply(),
        }
    }

    /// Binary .ply as mesh programs read it: positions, normals and colours of vertices; faces.
    fn ply(&self) -> Vec<u8> {
        let mut names = "property float x\nproperty float y\nproperty float z\n".to_owned();
        if !self.normals.is_empty() {
            names += "property float nx\nproperty float ny\nproperty float nz\n";
        }
        if !self.colors.is_empty() {
            names += "property uchar red\nproperty uchar green\nproperty uchar blue\n";
        }
        let mut out = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {}\n{names}element face {}\nproperty list uchar int vertex_indices\n\
             end_header\n",
            self.positions.len(),
            self.triangles.len()
        )
        .into_bytes();
        let floats = |out: &mut Vec<u8>, values: [f32; 3]| values.iter().for_each(|x| out.extend(x.to_le_bytes()));
        for (i, p) in self.positions.iter().enumerate() {
            floats(&mut out, *p);
            self.normals.get(i).into_iter().for_each(|n| floats(&mut out, *n));
            self.colors.get(i).into_iter().for_each(|c| out.extend(c));
        }
        for triangle in &self.triangles {
            out.push(3);
            triangle.iter().for_each(|v| out.extend(v.to_le_bytes()));
        }
        out
    }

    /// Wavefront .obj; colours follow positions, as most programs read them.
    fn obj(&self) -> String {
        let mut out = String::new();
        for (i, [x, y, z]) in self.positions.iter().enumerate() {
            write!(out, "v {x} {y} {z}").expect("a text takes everything");
            if let Some(color) = self.colors.get(i) {
                let [r, g, b] = color.map(|c| f32::from(c) / 255.0);
                write!(out, " {r:.4} {g:.4} {b:.4}").expect("a text takes everything");
            }
            out.push('\n');
        }
        self.normals.iter().for_each(|[x, y, z]| {
            writeln!(out, "vn {x:.4} {y:.4} {z:.4}").expect("a text takes everything");
        });
        for triangle in &self.triangles {
            out.push('f');
            for v in triangle.map(|v| v + 1) {
                let normal = if self.normals.is_empty() { String::new() } else { format!("//{v}") };
                write!(out, " {v}{normal}").expect("a text takes everything");
            }
            out.push('\n');
        }
        out
    }

    /// glTF 2.0 in one file. Colours of vertices are linear there; what was trained contains its light, so the material
    /// is unlit where programs know KHR_materials_unlit.
    fn glb(&self) -> Vec<u8> {
        const FLOAT: u32 = 5126;
        const UNSIGNED_SHORT: u32 = 5123;
        const UNSIGNED_INT: u32 = 5125;
        const VERTICES: u32 = 34962;
        const INDICES: u32 = 34963;
        let (mut data, mut views, mut accessors) = (Vec::<u8>::new(), Vec::new(), Vec::new());
        let mut add = |bytes: Vec<u8>, target: u32, accessor: serde_json::Value| {
            views.push(json!({"buffer": 0, "byteOffset": data.len(), "byteLength": bytes.len(), "target": target}));
            data.extend(bytes);
            let mut accessor = accessor;
            accessor["bufferView"] = json!(views.len() - 1);
            accessors.push(accessor);
            accessors.len() - 1
        };
        let floats = |values: &[[f32; 3]]| values.iter().flatten().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        let mut json = json!({"asset": {"version": "2.0", "generator": "splat4d"}, "scene": 0, "scenes": [{}]});
        if let Some([low, high]) = self.bounds().filter(|_| !self.triangles.is_empty()) {
            let count = self.positions.len();
            let position = json!({"componentType": FLOAT, "count": count, "type": "VEC3", "min": low, "max": high});
            let mut attributes = json!({"POSITION": add(floats(&self.positions), VERTICES, position)});
            if !self.normals.is_empty() {
                let normal = json!({"componentType": FLOAT, "count": count, "type": "VEC3"});
                attributes["NORMAL"] = json!(add(floats(&self.normals), VERTICES, normal));
            }
            if !self.colors.is_empty() {
                let value = |c: u8| ((f64::from(linear(c)) * 65535.0).round() as u16).to_le_bytes();
                // A fourth component keeps vertices at multiples of four bytes.
                let color = |c: &[u8; 3]| c.map(value).into_iter().flatten().chain(u16::MAX.to_le_bytes());
                let bytes = self.colors.iter().flat_map(color).collect();
                let accessor =
                    json!({"componentType": UNSIGNED_SHORT, "normalized": true, "count": count, "type": "VEC4"});
                attributes["COLOR_0"] = json!(add(bytes, VERTICES, accessor));
            }
            let indices = self.triangles.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
            let accessor = json!({"componentType": UNSIGNED_INT, "count": 3 * self.triangles.len(), "type": "SCALAR"});
            let indices = add(indices, INDICES, accessor);
            json["meshes"] = json!([{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}]);
            json["materials"] = json!([{"doubleSided": true, "extensions": {"KHR_materials_unlit": {}},
                "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}}]);
            json["extensionsUsed"] = json!(["KHR_materials_unlit"]);
            json["nodes"] = json!([{"mesh": 0}]);
            json["scenes"] = json!([{"nodes": [0]}]);
            json["buffers"] = json!([{"byteLength": data.len()}]);
            json["bufferViews"] = json!(views);
            json["accessors"] = json!(accessors);
        }
        let mut text = json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let chunks = [(*b"JSON", &text), (*b"BIN\0", &data)];
        let chunks = chunks.iter().filter(|(_, bytes)| !bytes.is_empty());
        let length: usize = 12 + chunks.clone().map(|(_, bytes)| 8 + bytes.len()).sum::<usize>();
        let mut out = b"glTF".to_vec();
        [2, length as u32].iter().for_each(|n| out.extend(n.to_le_bytes()));
        for (kind, bytes) in chunks {
            out.extend((bytes.len() as u32).to_le_bytes());
            out.extend(kind);
            out.extend(bytes.iter());
        }
        out
    }
}

/// The smallest vertex of the component of one, with shorter ways for the next time.
fn find(root: &mut [u32], mut v: u32) -> u32 {
    while root[v as usize] != v {
        let next = root[root[v as usize] as usize];
        root[v as usize] = next;
        v = next;
    }
    v
}

/// Linear light from sRGB (IEC 61966-2-1).
fn linear(value: u8) -> f32 {
    let v = f32::from(value) / 255.0;
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> Mesh {
        let mut mesh = Mesh {
            positions: vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [9.0, 9.0, 9.0]],
            colors: vec![[255, 0, 0], [0, 255, 0], [0, 0, 255], [188, 188, 188], [1, 2, 3]],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Mesh::default()
        };
        assert_eq!(mesh.clean(0.01), 0);
        mesh.find_normals();
        mesh
    }

    #[test]
    fn files_have_positions_normals_colours_and_faces() {
        let mesh = square();
        assert_eq!((mesh.positions.len(), mesh.normals[0]), (4, [0.0, 0.0, 1.0]));
        let obj = String::from_utf8(mesh.bytes(MeshFormat::Obj)).unwrap();
        assert!(obj.starts_with("v 0 0 0 1.0000 0.0000 0.0000\n"), "{obj}");
        assert!(obj.contains("vn 0.0000 0.0000 1.0000\n") && obj.ends_with("f 1//1 3//3 4//4\n"), "{obj}");
        let ply = mesh.bytes(MeshFormat::Ply);
        let header = ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        assert_eq!(ply.len() - header, 4 * (24 + 3) + 2 * 13);
        let glb = mesh.bytes(MeshFormat::Glb);
        let word = |at: usize| u32::from_le_bytes(glb[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!((&glb[..4], word(4), word(8)), (&b"glTF"[..], 2, glb.len()));
        let json: serde_json::Value = serde_json::from_slice(&glb[20..20 + word(12)]).unwrap();
        assert_eq!(json["accessors"][0]["max"], json!([1.0, 1.0, 0.0]));
        assert_eq!(json["accessors"].as_array().unwrap().len(), 4);
        let bin = 20 + word(12);
        assert_eq!(word(bin), 4 * (12 + 12 + 8) + 24);
        // The grey of 188 is half of the light.
        let grey = bin + 8 + 4 * 24 + 3 * 8;
        assert!((f32::from(u16::from_le_bytes([glb[grey], glb[grey + 1]])) / 65535.0 - 0.5).abs() < 0.01);
    }

    #[test]
    fn an_empty_mesh_is_a_valid_file() {
        let glb = Mesh::default().bytes(MeshFormat::Glb);
        let json: serde_json::Value = serde_json::from_slice(&glb[20..]).unwrap();
        assert_eq!(json["scenes"], json!([{}]));
        assert!(Mesh::default().bytes(MeshFormat::Obj).is_empty());
    }

    #[test]
    fn small_components_are_left_out() {
        let mut mesh = square();
        mesh.normals.clear();
        let far = |x: f32, y: f32| [5.0 + x, y, 0.0];
        mesh.positions.extend([far(0.0, 0.0), far(0.1, 0.0), far(0.0, 0.1)]);
        mesh.colors.extend([[0; 3]; 3]);
        mesh.triangles.push([4, 5, 6]);
        assert_eq!(mesh.clone().clean(0.005), 0, "0.14 units are more than 12 voxels");
        assert_eq!((mesh.clean(0.02), mesh.positions.len(), mesh.triangles.len()), (1, 4, 2));
    }
}
