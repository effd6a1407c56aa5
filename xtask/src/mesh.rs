//! Triangle meshes and the few solids the scene is built of.

use crate::vector::{Affine, V3, sin_cos, v3};

/// One triangle.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Triangle {
    /// Vertex indices.
    pub vertices: [u32; 3],
    /// Index into the scene's materials.
    pub material: u16,
    /// Index of the object it belongs to, for masks and flow; 0 is the static set.
    pub object: u8,
}

/// Vertices (position, normal, uv) and triangles.
#[derive(Clone, Debug, Default)]
pub(crate) struct Mesh {
    /// World positions.
    pub positions: Vec<V3>,
    /// Unit normals.
    pub normals: Vec<V3>,
    /// Texture coordinates.
    pub uvs: Vec<[f64; 2]>,
    /// Triangles, either orientation.
    pub triangles: Vec<Triangle>,
}

impl Mesh {
    /// Appends a vertex.
    pub(crate) fn push_vertex(&mut self, position: V3, normal: V3, uv: [f64; 2]) {
        self.positions.push(position);
        self.normals.push(normal);
        self.uvs.push(uv);
    }

    /// Appends a triangle.
    pub(crate) fn push_triangle(&mut self, vertices: [u32; 3], material: u16, object: u8) {
        self.triangles.push(Triangle { vertices, material, object });
    }

    /// Appends another mesh.
    pub(crate) fn append(&mut self, other: &Mesh) {
        let first = self.positions.len() as u32;
        self.positions.extend_from_slice(&other.positions);
        self.normals.extend_from_slice(&other.normals);
        self.uvs.extend_from_slice(&other.uvs);
        let shifted = other.triangles.iter().map(|t| Triangle { vertices: t.vertices.map(|v| v + first), ..*t });
        self.triangles.extend(shifted);
    }

    /// A parallelogram from `corner` along `u` and `v`; uv runs in scene units from `uv0`.
    pub(crate) fn quad(&mut self, corner: V3, u: V3, v: V3, uv0: [f64; 2], material: u16, object: u8) {
        let first = self.positions.len() as u32;
        let normal = u.cross(v).unit();
        let (lu, lv) = (u.length(), v.length());
        for (a, b) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
            self.push_vertex(corner + u * a + v * b, normal, [uv0[0] + a * lu, uv0[1] + b * lv]);
        }
        self.push_triangle([first, first + 1, first + 2], material, object);
        self.push_triangle([first, first + 2, first + 3], material, object);
    }

    /// A box standing on the origin of `place`; each face has uv in `[0,1]`².
    pub(crate) fn crate_box(&mut self, place: &Affine, size: V3, material: u16, object: u8) {
        let (hx, hz) = (0.5 * size.x, 0.5 * size.z);
        let corner = |x: f64, y: f64, z: f64| v3(x * hx, y * size.y, z * hz);
        let faces = [
            [corner(-1.0, 0.0, 1.0), corner(1.0, 0.0, 1.0), corner(-1.0, 1.0, 1.0)],
            [corner(1.0, 0.0, -1.0), corner(-1.0, 0.0, -1.0), corner(1.0, 1.0, -1.0)],
            [corner(1.0, 0.0, 1.0), corner(1.0, 0.0, -1.0), corner(1.0, 1.0, 1.0)],
            [corner(-1.0, 0.0, -1.0), corner(-1.0, 0.0, 1.0), corner(-1.0, 1.0, -1.0)],
            [corner(-1.0, 1.0, 1.0), corner(1.0, 1.0, 1.0), corner(-1.0, 1.0, -1.0)],
        ];
        for [origin, right, up] in faces {
            let (u, v) = (right - origin, up - origin);
            let first = self.positions.len() as u32;
            let normal = place.turn(u.cross(v)).unit();
            for (a, b) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
                self.push_vertex(place.point(origin + u * a + v * b), normal, [a, b]);
            }
            self.push_triangle([first, first + 1, first + 2], material, object);
            self.push_triangle([first, first + 2, first + 3], material, object);
        }
    }

    /// A solid of revolution about the y axis of `place`: `profile` holds (radius, height), uv = (turn, height).
    pub(crate) fn lathe(&mut self, place: &Affine, profile: &[(f64, f64)], sides: u32, material: u16, object: u8) {
        for pair in profile.windows(2) {
            let [(r0, h0), (r1, h1)] = [pair[0], pair[1]];
            let first = self.positions.len() as u32;
            for i in 0..=sides {
                let turn = f64::from(i) / f64::from(sides);
                let (sin, cos) = sin_cos(turn * std::f64::consts::TAU);
                let normal = place.turn(v3(cos * (h1 - h0), r0 - r1, sin * (h1 - h0))).unit();
                for (r, h) in [(r0, h0), (r1, h1)] {
                    self.push_vertex(place.point(v3(r * cos, h, r * sin)), normal, [turn, h]);
                }
            }
            for i in 0..sides {
                let a = first + 2 * i;
                self.push_triangle([a, a + 1, a + 3], material, object);
                self.push_triangle([a, a + 3, a + 2], material, object);
            }
        }
    }

    /// A ball about the origin of `place` with smooth normals; uv = (turn, polar angle / π).
    pub(crate) fn ball(&mut self, place: &Affine, radius: f64, sides: u32, material: u16, object: u8) {
        let first = self.positions.len() as u32;
        let rings = sides / 2;
        for ring in 0..=rings {
            let polar = f64::from(ring) / f64::from(rings);
            let (sp, cp) = sin_cos(polar * std::f64::consts::PI);
            for i in 0..=sides {
                let turn = f64::from(i) / f64::from(sides);
                let (s, c) = sin_cos(turn * std::f64::consts::TAU);
                let direction = place.turn(v3(sp * c, cp, sp * s));
                self.push_vertex(place.origin + direction * radius, direction.unit(), [turn, polar]);
            }
        }
        for ring in 0..rings {
            for i in 0..sides {
                let a = first + ring * (sides + 1) + i;
                let b = a + sides + 1;
                self.push_triangle([a, b, b + 1], material, object);
                self.push_triangle([a, b + 1, a + 1], material, object);
            }
        }
    }
}
