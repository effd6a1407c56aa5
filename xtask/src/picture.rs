//! From visibility to pixels: shading in linear light, the box filter over 3x3 samples, sRGB codes and masks.

use crate::camera::Camera;
use crate::material;
use crate::mesh::Mesh;
use crate::raster::{Edges, NOTHING, SUPERSAMPLING, Visibility, corners, sample_ray};
use crate::scene::{BACK, FRONT, Frame, SIDE};
use crate::texture::{Texture, srgb_from_linear};
use crate::vector::{V3, smooth_step, v3};
use crate::yard_materials;
use std::ops::Range;

/// A rendered image.
pub(crate) struct Picture {
    /// sRGB codes, rows from the top, three per pixel.
    pub rgb: Vec<u8>,
    /// 255 where moving objects cover at least half a pixel, else 0.
    pub mask: Vec<u8>,
}

/// Weights (of 27) of the seven samples about a pixel's centre in one direction: a pixel-wide box convolved with itself
/// twice, the quadratic B-spline. Like a lens it is a little wider than the pixel; it keeps edges free of stairs and
/// makes files a third smaller than a box does.
const LENS: [f64; 7] = [1.0, 3.0, 6.0, 7.0, 6.0, 3.0, 1.0];
const LENS_SUM: f64 = 27.0;
const REACH: usize = LENS.len() / 2;
// The weights are written for three samples per pixel.
const _: () = assert!(SUPERSAMPLING == 3);

/// The image, black where nothing is seen. `textures`: the characters', knight first.
pub(crate) fn shade(textures: [&Texture; 2], frame: &Frame, camera: &Camera, seen: &Visibility) -> Picture {
    let pixels = camera.width * camera.height;
    let mut out = Picture { rgb: Vec::with_capacity(3 * pixels), mask: Vec::with_capacity(pixels) };
    each_pixel(textures, frame, camera, seen, 0..camera.height, |color, moving| {
        out.rgb.extend(color.array().map(srgb_from_linear));
        out.mask.push(if moving > 0.5 { 255 } else { 0 });
    });
    out
}

/// The image of moving objects alone: sRGB codes of their own colour (not dimmed by their coverage) and coverage, four
/// per pixel.
pub(crate) fn cut_out(textures: [&Texture; 2], frame: &Frame, camera: &Camera, seen: &Visibility) -> Vec<u8> {
    let mut out = Vec::with_capacity(4 * camera.width * camera.height);
    each_pixel(textures, frame, camera, seen, 0..camera.height, |color, covered| {
        let own = if covered > 0.0 { color * (1.0 / covered) } else { V3::default() };
        out.extend(own.array().map(srgb_from_linear));
        out.push((255.0 * covered).round() as u8);
    });
    out
}

/// Linear colour of the pixels of some rows, black where nothing is seen.
pub(crate) fn light(
    textures: [&Texture; 2],
    frame: &Frame,
    camera: &Camera,
    seen: &Visibility,
    lines: Range<usize>,
) -> Vec<V3> {
    let mut out = Vec::with_capacity(camera.width * lines.len());
    each_pixel(textures, frame, camera, seen, lines, |color, _| out.push(color));
    out
}

/// Shades every sample of some rows, filters the samples to pixels and returns each pixel's linear colour (nothing is black) and the
/// share that moving objects cover, rows from the top.
fn each_pixel(
    textures: [&Texture; 2],
    frame: &Frame,
    camera: &Camera,
    seen: &Visibility,
    lines: Range<usize>,
    mut emit: impl FnMut(V3, f64),
) {
    // Rows of samples already filtered across; only those about the current pixel row are kept.
    let mut rows: Vec<Vec<(V3, f64)>> = vec![Vec::new(); LENS.len()];
    let mut samples = SampleShader { frame, camera, seen, textures, edges: EdgeCache::default() };
    let mut next = (lines.start * SUPERSAMPLING + SUPERSAMPLING / 2).saturating_sub(REACH);
    for y in lines {
        let middle = y * SUPERSAMPLING + SUPERSAMPLING / 2;
        while next < (middle + REACH + 1).min(seen.height) {
            rows[next % LENS.len()] = samples.filtered_row(next);
            next += 1;
        }
        for x in 0..camera.width {
            let (mut color, mut moving) = (V3::default(), 0.0);
            for (k, weight) in LENS.iter().enumerate() {
                let row = (middle + k).saturating_sub(REACH).min(seen.height - 1);
                let (c, m) = rows[row % LENS.len()][x];
                color = color + c * (weight / LENS_SUM);
                moving += m * weight / LENS_SUM;
            }
            emit(color, moving);
        }
    }
}

/// Shades samples of one image.
struct SampleShader<'a> {
    frame: &'a Frame,
    camera: &'a Camera,
    seen: &'a Visibility,
    textures: [&'a Texture; 2],
    edges: EdgeCache,
}

impl SampleShader<'_> {
    /// Linear colour of each pixel column along one row of samples, and the share of moving objects.
    fn filtered_row(&mut self, row: usize) -> Vec<(V3, f64)> {
        let line: Vec<(V3, f64)> = (0..self.seen.width).map(|column| self.sample(column, row)).collect();
        let pixel = |x: usize| {
            let (mut color, mut moving) = (V3::default(), 0.0);
            for (k, weight) in LENS.iter().enumerate() {
                let column = (x * SUPERSAMPLING + SUPERSAMPLING / 2 + k).saturating_sub(REACH).min(line.len() - 1);
                color = color + line[column].0 * (weight / LENS_SUM);
                moving += line[column].1 * weight / LENS_SUM;
            }
            (color, moving)
        };
        (0..self.camera.width).map(pixel).collect()
    }

    fn sample(&mut self, column: usize, row: usize) -> (V3, f64) {
        let index = self.seen.triangles[row * self.seen.width + column];
        if index == NOTHING {
            return (V3::default(), 0.0);
        }
        let (frame, camera) = (self.frame, self.camera);
        let (weights, _) = self.edges.get(&frame.mesh, camera, index).weights(sample_ray(camera, column, row));
        let triangle = &frame.mesh.triangles[index as usize];
        let [a, b, c] = triangle.vertices.map(|v| v as usize);
        let blend = |list: &[V3]| list[a] * weights[0] + list[b] * weights[1] + list[c] * weights[2];
        let uvs = &frame.mesh.uvs;
        let uv = std::array::from_fn(|i| uvs[a][i] * weights[0] + uvs[b][i] * weights[1] + uvs[c][i] * weights[2]);
        let point = blend(&frame.mesh.positions);
        let mut normal = blend(&frame.mesh.normals).unit();
        if normal.dot(camera.position - point) < 0.0 {
            normal = -normal;
        }
        let color = material::albedo(triangle.material, uv, self.textures);
        let light = frame.light.arriving(point, normal, openness(frame, point, normal, triangle.object));
        let moving = f64::from(u8::from(triangle.object != 0));
        let mut color = color.scaled_by(light) + material::glow(triangle.material, uv);
        let gloss = yard_materials::gloss(triangle.material);
        if gloss > 0.0 {
            color = color + frame.light.mirrored(point, normal, (camera.position - point).unit(), gloss);
        }
        (color, moving)
    }
}

/// How much of the sky a point sees: darker in the hall's corners, under objects on the floor, and on the lower side of
/// objects.
fn openness(frame: &Frame, point: V3, normal: V3, object: u8) -> f64 {
    let wall = (SIDE - point.x.abs()).min(point.z - BACK).min(FRONT - point.z);
    let edge = if point.y < 0.01 { wall } else { point.y };
    let mut open = if object == 0 { 0.75 + 0.25 * smooth_step(-0.3, 1.6, edge) } else { 1.0 };
    if object == 0 && normal.y > 0.9 && point.y < 0.01 {
        for foot in &frame.feet {
            let d = point - *foot;
            let q = 1.0 / (1.0 + (d.x * d.x + d.z * d.z) / 0.12);
            open *= 1.0 - 0.45 * q * q;
        }
    } else if object != 0 {
        open *= 0.78 + 0.22 * smooth_step(0.0, 0.9, point.y);
    }
    open
}

/// The last few triangles' edge functions: neighbouring samples mostly see the same triangle.
#[derive(Default)]
pub(crate) struct EdgeCache {
    slots: [Option<(u32, Edges)>; 4],
    next: usize,
}

impl EdgeCache {
    /// The edge functions of triangle `index`, which must be visible (so not edge-on).
    pub(crate) fn get(&mut self, mesh: &Mesh, camera: &Camera, index: u32) -> Edges {
        if let Some((_, edges)) = self.slots.iter().flatten().find(|(i, _)| *i == index) {
            return *edges;
        }
        let edges = Edges::new(corners(mesh, camera, index as usize)).expect("a visible triangle is not edge-on");
        self.slots[self.next] = Some((index, edges));
        self.next = (self.next + 1) % self.slots.len();
        edges
    }
}

/// World position seen by the middle sample of pixel (x, y), with its triangle, weights and depth.
pub(crate) fn surface(
    frame: &Frame,
    camera: &Camera,
    seen: &Visibility,
    x: usize,
    y: usize,
) -> Option<(u32, [f64; 3], f64)> {
    let (column, row) = (x * SUPERSAMPLING + SUPERSAMPLING / 2, y * SUPERSAMPLING + SUPERSAMPLING / 2);
    let index = seen.triangles[row * seen.width + column];
    if index == NOTHING {
        return None;
    }
    let edges = Edges::new(corners(&frame.mesh, camera, index as usize))?;
    let (weights, depth) = edges.weights(sample_ray(camera, column, row));
    Some((index, weights, depth))
}

/// The point of triangle `index` of `mesh` at `weights`.
pub(crate) fn point_at(mesh: &Mesh, vertices: [u32; 3], weights: [f64; 3]) -> V3 {
    let mut point = v3(0.0, 0.0, 0.0);
    for (vertex, weight) in vertices.iter().zip(weights) {
        point = point + mesh.positions[*vertex as usize] * weight;
    }
    point
}
