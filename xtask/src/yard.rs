//! A second, richer set: a yard of brick, cobbles and plaster, with a riveted iron drum, a glazed jar, a railing, and a
//! window onto far hills under a sky. Fine texture, relief, thin parts, gloss and distance, all generated.
//!
//! `capture --photos VIEWS FOLDER [--size WxH]`: the drum as someone photographs it who walks around it once.
//! `capture --long ... --scene yard` films the characters here.

use crate::camera::Camera;
use crate::capture::jpeg;
use crate::files::write_file;
use crate::long;
use crate::mesh::Mesh;
use crate::picture::shade;
use crate::raster::rasterize;
use crate::scene::{BACK, FPS, FRONT, SIDE, Stage};
use crate::texture::srgb;
use crate::truth::{self, Cloud};
use crate::vector::{Affine, V3, hash01, sin_cos, smooth_step, v3};
use anyhow::{Context, Result, bail, ensure};
use rayon::prelude::*;
use serde_json::json;
use std::f64::consts::{PI, TAU};
use std::path::Path;

/// Materials of this set; those of the hall are below.
pub(crate) const BRICK: u16 = 10;
/// Paving; uv = world (x, z).
const COBBLES: u16 = 11;
/// Rough plaster; uv = (along, height).
const PLASTER: u16 = 12;
/// The drum's iron; uv = (turn, height).
const IRON: u16 = 13;
/// The glazed jar; uv = (turn, height).
const GLAZE: u16 = 14;
/// Painted rails and bars.
const RAIL: u16 = 15;
/// Far land; uv = world (x, z).
const LAND: u16 = 16;
/// The sky, which emits; uv = (turn, polar angle / π).
const SKY: u16 = 17;

/// Height of brick and plaster walls, scene units; the sky is above them.
const WALL_HEIGHT: f64 = 3.4;
/// The window in the back wall: left, right, lower and upper edge, scene units.
const WINDOW: [f64; 4] = [-1.3, 1.3, 1.1, 2.6];
/// Where the drum stands, its radius and height, scene units.
const DRUM: V3 = v3(-2.0, 0.0, 2.1);
const DRUM_RADIUS: f64 = 0.5;
const DRUM_HEIGHT: f64 = 1.15;
/// Vertices of the drum's relief around and up: 4 mm of a drum of 70 cm.
const RELIEF: [u32; 2] = [480, 220];
/// Rivets in a ring, and the rings' heights in shares of the drum's.
const RIVETS: f64 = 28.0;
const RINGS: [f64; 4] = [0.06, 0.30, 0.70, 0.94];
/// Rivets' radius and height; depth of the ornament between the rings, scene units.
const RIVET: [f64; 2] = [0.022, 0.016];
const ORNAMENT: f64 = 0.014;
/// Distance of the nearest (under the yard, below its paving) and of the farthest land, and of the sky, scene units.
const LAND_FROM: f64 = 4.0;
const LAND_TO: f64 = 260.0;
const SKY_AT: f64 = 600.0;

/// Walls, paving, land and sky.
pub(crate) fn ground() -> Mesh {
    let mut mesh = Mesh::default();
    let (depth, width) = (FRONT - BACK, 2.0 * SIDE);
    mesh.quad(v3(-SIDE, 0.0, FRONT), v3(width, 0.0, 0.0), v3(0.0, 0.0, -depth), [0.0; 2], COBBLES, 0);
    for vertex in 0..4 {
        mesh.uvs[vertex] = [mesh.positions[vertex].x, mesh.positions[vertex].z];
    }
    let mut wall = |from: V3, along: V3, [low, high]: [f64; 2], start: f64, material: u16| {
        let up = v3(0.0, high - low, 0.0);
        mesh.quad(from + v3(0.0, low, 0.0), along, up, [start, low], material, 0);
    };
    let [left, right, sill, lintel] = WINDOW;
    let back = |x: f64| v3(x, 0.0, BACK);
    wall(back(-SIDE), v3(left + SIDE, 0.0, 0.0), [0.0, WALL_HEIGHT], 0.0, BRICK);
    wall(back(right), v3(SIDE - right, 0.0, 0.0), [0.0, WALL_HEIGHT], right + SIDE, BRICK);
    wall(back(left), v3(right - left, 0.0, 0.0), [0.0, sill], left + SIDE, BRICK);
    wall(back(left), v3(right - left, 0.0, 0.0), [lintel, WALL_HEIGHT], left + SIDE, BRICK);
    wall(v3(SIDE, 0.0, BACK), v3(0.0, 0.0, depth), [0.0, WALL_HEIGHT], 15.0, PLASTER);
    wall(v3(-SIDE, 0.0, FRONT), v3(0.0, 0.0, -depth), [0.0, WALL_HEIGHT], 42.0, PLASTER);
    wall(v3(SIDE, 0.0, FRONT), v3(-width, 0.0, 0.0), [0.0, WALL_HEIGHT], 27.0, BRICK);
    land(&mut mesh);
    mesh.ball(&Affine::IDENTITY, SKY_AT, 48, SKY, 0);
    mesh
}

/// What casts shadows: drum, jar, railing, window bars.
pub(crate) fn props() -> Mesh {
    let mut mesh = Mesh::default();
    drum(&mut mesh, &Affine::standing(DRUM, 0.3));
    let jar = [(0.16, 0.0), (0.3, 0.12), (0.4, 0.36), (0.38, 0.6), (0.22, 0.84), (0.15, 0.93), (0.2, 1.0), (0.0, 0.98)];
    smooth_lathe(&mut mesh, &Affine::standing(v3(3.0, 0.0, 0.7), 0.0), &jar, GLAZE);
    let mut bar = |x: f64, y: f64, z: f64, size: V3| {
        mesh.crate_box(&Affine { origin: v3(x, y, z), ..Affine::IDENTITY }, size, RAIL, 0);
    };
    for i in 0..=42 {
        bar(-4.2 + 0.2 * f64::from(i), 0.0, -3.1, v3(0.024, 1.05, 0.024));
    }
    for y in [0.18, 1.0] {
        bar(0.0, y, -3.1, v3(8.5, 0.045, 0.045));
    }
    let [left, right, sill, lintel] = WINDOW;
    for i in 1..8 {
        bar(left + (right - left) * f64::from(i) / 8.0, sill, BACK, v3(0.02, lintel - sill, 0.02));
    }
    for i in 1..4 {
        bar(0.5 * (left + right), sill + (lintel - sill) * f64::from(i) / 4.0, BACK, v3(right - left, 0.02, 0.02));
    }
    mesh
}

/// A cylinder whose surface is lifted by [`relief`], with its lid.
fn drum(mesh: &mut Mesh, place: &Affine) {
    let [around, up] = RELIEF;
    let first = mesh.positions.len() as u32;
    let radius = |turn: f64, h: f64| DRUM_RADIUS + relief(turn, h);
    // Slopes over half a step of the mesh give the normals.
    let (dt, dh) = (0.5 / f64::from(around), 0.5 / f64::from(up));
    for j in 0..=up {
        let h = f64::from(j) / f64::from(up);
        for i in 0..=around {
            let turn = f64::from(i) / f64::from(around);
            let (sin, cos) = sin_cos(turn * TAU);
            let r = radius(turn, h);
            let along = (radius(turn + dt, h) - radius(turn - dt, h)) / (2.0 * dt * TAU * r);
            let rise = (radius(turn, h + dh) - radius(turn, h - dh)) / (2.0 * dh * DRUM_HEIGHT);
            let normal = v3(cos + along * sin, -rise, sin - along * cos);
            mesh.push_vertex(place.point(v3(r * cos, h * DRUM_HEIGHT, r * sin)), place.turn(normal).unit(), [turn, h]);
        }
    }
    for j in 0..up {
        for i in 0..around {
            let a = first + j * (around + 1) + i;
            let b = a + around + 1;
            mesh.push_triangle([a, a + 1, b + 1], IRON, 0);
            mesh.push_triangle([a, b + 1, b], IRON, 0);
        }
    }
    let rim = DRUM_RADIUS + 0.01;
    mesh.lathe(place, &[(rim, DRUM_HEIGHT - 0.005), (0.1, DRUM_HEIGHT + 0.04), (0.0, DRUM_HEIGHT + 0.05)], 64, RAIL, 0);
}

/// Height of the drum's surface: hoops with rivets at [`RINGS`], waves of scales between them; `h` in [0, 1].
fn relief(turn: f64, h: f64) -> f64 {
    let turn = turn - turn.floor();
    let mut height = 0.0f64;
    let mut hooped = 0.0f64;
    for (k, ring) in RINGS.iter().enumerate() {
        let across = (h - ring) * DRUM_HEIGHT;
        let hoop = 1.0 - smooth_step(0.035, 0.045, across.abs());
        hooped = hooped.max(hoop);
        height = height.max(0.008 * hoop);
        // The rivet that is nearest along the hoop; rings are shifted against each other.
        let at = turn * RIVETS + 0.5 * (k % 2) as f64;
        let along = (at - at.round()) * TAU * DRUM_RADIUS / RIVETS;
        let d = (across * across + along * along).sqrt() / RIVET[0];
        if d < 1.0 {
            height = height.max(0.008 + RIVET[1] * (1.0 - d * d).sqrt());
        }
    }
    // Scales: rows of arches, every other row shifted by half of one.
    let (rows, columns) = (16.0, 30.0);
    let row = (h * rows).floor();
    let u = turn * columns + 0.5 * (row - 2.0 * (0.5 * row).floor());
    let (x, y) = (2.0 * (u - u.floor()) - 1.0, h * rows - row);
    let arch = y - 0.55 * x * x;
    let scale = smooth_step(0.0, 0.14, arch) * (1.0 - 0.7 * arch.clamp(0.0, 1.0));
    height.max(ORNAMENT * scale * (1.0 - hooped))
}

/// A solid of revolution whose profile is a Catmull-Rom spline through (radius, height).
fn smooth_lathe(mesh: &mut Mesh, place: &Affine, profile: &[(f64, f64)], material: u16) {
    const STEPS: usize = 8;
    let at = |i: i64| profile[i.clamp(0, profile.len() as i64 - 1) as usize];
    let mut fine = Vec::new();
    for i in 0..profile.len() as i64 - 1 {
        let [p, a, b, n] = [at(i - 1), at(i), at(i + 1), at(i + 2)];
        for k in 0..STEPS {
            let s = k as f64 / STEPS as f64;
            let spline = |p: f64, a: f64, b: f64, n: f64| {
                a + 0.5 * s * (b - p + s * (2.0 * p - 5.0 * a + 4.0 * b - n + s * (3.0 * (a - b) + n - p)))
            };
            fine.push((spline(p.0, a.0, b.0, n.0).max(0.0), spline(p.1, a.1, b.1, n.1)));
        }
    }
    fine.extend(profile.last());
    mesh.lathe(place, &fine, 96, material, 0);
}

/// Rings of land around the yard, which rise to hills.
fn land(mesh: &mut Mesh) {
    const AROUND: u32 = 160;
    const RINGS: u32 = 40;
    let first = mesh.positions.len() as u32;
    let height = |x: f64, z: f64| {
        let r = (x * x + z * z).sqrt();
        let (outside, far) = (smooth_step(SIDE, 2.0 * SIDE, r), smooth_step(SIDE, LAND_TO, r));
        -1.5 + 30.0 * far * noise([x / 60.0, z / 60.0], 3, 21) + 2.0 * outside * noise([x / 9.0, z / 9.0], 2, 22)
    };
    for j in 0..=RINGS {
        let share = f64::from(j) / f64::from(RINGS);
        let r = LAND_FROM + (LAND_TO - LAND_FROM) * share * share;
        for i in 0..=AROUND {
            let (sin, cos) = sin_cos(f64::from(i) / f64::from(AROUND) * TAU);
            let (x, z) = (r * cos, r * sin);
            let slope = |dx: f64, dz: f64| height(x + dx, z + dz) - height(x - dx, z - dz);
            let normal = v3(-slope(0.5, 0.0), 1.0, -slope(0.0, 0.5)).unit();
            mesh.push_vertex(v3(x, height(x, z), z), normal, [x, z]);
        }
    }
    for j in 0..RINGS {
        for i in 0..AROUND {
            let a = first + j * (AROUND + 1) + i;
            let b = a + AROUND + 1;
            mesh.push_triangle([a, a + 1, b + 1], LAND, 0);
            mesh.push_triangle([a, b + 1, b], LAND, 0);
        }
    }
}

/// Smoothly interpolated random numbers of a lattice, `octaves` of them, each of half the size and weight; about 0 to 1.
fn noise([x, y]: [f64; 2], octaves: u32, purpose: i64) -> f64 {
    let (mut sum, mut weight, mut all) = (0.0, 1.0, 0.0);
    let (mut x, mut y) = (x, y);
    for octave in 0..octaves {
        let (i, j) = (x.floor(), y.floor());
        let (u, v) = (smooth_step(0.0, 1.0, x - i), smooth_step(0.0, 1.0, y - j));
        let corner = |a: i64, b: i64| hash01(i as i64 + a, 4096 * (j as i64 + b) + 64 * purpose + i64::from(octave));
        let low = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * u;
        let high = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * u;
        sum += weight * (low + (high - low) * v);
        all += weight;
        weight *= 0.5;
        (x, y) = (2.0 * x, 2.0 * y);
    }
    sum / all
}

/// Linear colour of a material of this set.
pub(crate) fn albedo(material: u16, uv: [f64; 2]) -> V3 {
    let [u, v] = uv;
    match material {
        BRICK => brick(u, v),
        COBBLES => cobbles(u, v),
        PLASTER => {
            let rough = noise([9.0 * u, 9.0 * v], 4, 1);
            srgb(176, 160, 132).lerp(srgb(222, 210, 184), rough) * (0.8 + 0.2 * smooth_step(0.0, 0.9, v))
        }
        IRON => {
            let (along, up) = (u * TAU * DRUM_RADIUS, v * DRUM_HEIGHT);
            let rust = smooth_step(0.42, 0.62, noise([7.0 * along, 7.0 * up], 4, 2));
            let grain = 0.75 + 0.5 * noise([60.0 * along, 60.0 * up], 2, 3);
            // Dirt is in what lies low.
            let clean = 0.45 + 0.55 * smooth_step(0.0, ORNAMENT, relief(u, v));
            srgb(96, 100, 106).lerp(srgb(150, 84, 48), rust) * (grain * clean)
        }
        GLAZE => {
            let wave = v + 0.05 * sin_cos(6.0 * PI * (u - 0.5)).0;
            let stripe = smooth_step(-0.02, 0.02, 0.08 - (wave - 0.5).abs());
            srgb(28, 92, 104).lerp(srgb(226, 214, 180), stripe)
        }
        RAIL => srgb(34, 44, 40),
        LAND => {
            let field = noise([u / 14.0, v / 14.0], 1, 4);
            let grass = srgb(72, 98, 52).lerp(srgb(166, 150, 88), smooth_step(0.45, 0.6, field));
            let far = smooth_step(20.0, LAND_TO, (u * u + v * v).sqrt());
            (grass * (0.7 + 0.6 * noise([1.3 * u, 1.3 * v], 3, 5))).lerp(srgb(146, 164, 184), 0.75 * far)
        }
        _ => V3::default(),
    }
}

fn brick(u: f64, v: f64) -> V3 {
    let (wide, high) = (0.42, 0.14);
    let row = (v / high).floor();
    let shifted = u / wide + 0.5 * (row - 2.0 * (0.5 * row).floor());
    let (x, y) = ((shifted - shifted.floor()) * wide, v - row * high);
    let edge = x.min(wide - x).min(y).min(high - y);
    let own = hash01(shifted.floor() as i64, row as i64);
    let grain = 0.8 + 0.4 * noise([22.0 * u, 22.0 * v], 3, 6);
    let clay = srgb(134, 66, 48).lerp(srgb(186, 112, 76), own) * grain;
    let mortar = srgb(170, 162, 150) * (0.85 + 0.3 * noise([40.0 * u, 40.0 * v], 2, 7));
    mortar.lerp(clay, smooth_step(0.008, 0.022, edge))
}

/// Cells about the nearest of jittered centres, dark where two centres are equally far.
fn cobbles(x: f64, z: f64) -> V3 {
    const STONE: f64 = 0.28;
    let (u, v) = (x / STONE, z / STONE);
    let (mut nearest, mut second, mut own) = (f64::INFINITY, f64::INFINITY, 0.0);
    for j in -1..=1 {
        for i in -1..=1 {
            let (a, b) = (u.floor() as i64 + i, v.floor() as i64 + j);
            let jitter = |k: i64| 0.2 + 0.6 * hash01(a, 8 * b + k);
            let (dx, dy) = (a as f64 + jitter(0) - u, b as f64 + jitter(1) - v);
            let d = (dx * dx + dy * dy).sqrt();
            if d < nearest {
                (second, nearest, own) = (nearest, d, hash01(a, 8 * b + 2));
            } else if d < second {
                second = d;
            }
        }
    }
    let joint = smooth_step(0.04, 0.16, second - nearest);
    let grain = 0.8 + 0.4 * noise([16.0 * x, 16.0 * z], 3, 8);
    srgb(58, 54, 48).lerp(srgb(120, 116, 112).lerp(srgb(164, 156, 142), own), joint) * grain
}

/// Light that a material emits: the sky's, brighter at the horizon, with clouds.
pub(crate) fn glow(material: u16, [turn, polar]: [f64; 2]) -> V3 {
    if material != SKY {
        return V3::default();
    }
    let above = (0.5 - polar).max(0.0);
    let clear = srgb(208, 222, 234).lerp(srgb(96, 146, 208), smooth_step(0.0, 0.32, above));
    // Clouds are in a plane high above, so that they are small near the horizon; the seam in `turn` lies behind.
    let (sin, cos) = sin_cos(TAU * turn);
    let out = 1.0 / (above + 0.06);
    let cloud = noise([0.9 * out * cos, 0.9 * out * sin], 5, 9);
    clear.lerp(srgb(244, 244, 242), smooth_step(0.5, 0.7, cloud) * smooth_step(0.02, 0.1, above))
}

/// Share of the mirrored surroundings that a material shows when seen head-on (Schlick's F₀); 0: matt.
pub(crate) fn gloss(material: u16) -> f64 {
    match material {
        GLAZE => 0.06,
        IRON => 0.03,
        RAIL => 0.04,
        _ => 0.0,
    }
}

/// `--photos VIEWS FOLDER [--size WxH]`.
pub(crate) fn command(views: &str, folder: &Path, options: &[String]) -> Result<()> {
    /// Every how many photos one is held out.
    const HOLD_EVERY: usize = 8;
    /// Points per photo and their noise, scene units, as structure from motion has them of many near photos: 12,602 of 119
    /// photos of an object, below a pixel.
    const POINTS: usize = 100;
    const NOISE: f64 = 0.001;
    let views: usize = views.parse().with_context(|| format!("invalid number of photos `{views}`"))?;
    ensure!((8..=9999).contains(&views), "give 8 to 9999 photos");
    let [width, height] = match options {
        [] => [912, 912],
        [flag, size] if flag == "--size" => long::size(size)?,
        _ => bail!("--photos takes a number, a folder and --size WxH"),
    };
    let stage = Stage::yard(&crate::capture::bundled_folder().join("characters"))?;
    let frame = stage.with(&Mesh::default(), vec![DRUM]);
    let cameras = walk(views, [width, height]);
    let draw = |(i, camera): (usize, &Camera)| -> Result<_> {
        let seen = rasterize(&frame.mesh, camera);
        let rgb = shade(stage.textures(), &frame, camera, &seen).rgb;
        write_file(&folder.join(photo(i)), &jpeg(&rgb, width, height)?)?;
        // Visibility is large; of the photos that points are taken from, every eighth is enough.
        Ok((i % HOLD_EVERY == 1).then_some((seen, rgb)))
    };
    let seen = cameras.par_iter().enumerate().map(draw).collect::<Result<Vec<_>>>()?;
    let training = cameras.iter().zip(&seen).filter_map(|(camera, s)| s.as_ref().map(|(v, rgb)| (camera, v, &rgb[..])));
    let cloud = Cloud { count: POINTS * views, noise: NOISE };
    let cloud = truth::sparse_cloud(&frame, &training.collect::<Vec<_>>(), cloud);
    write_file(&folder.join("points.ply"), &truth::ply(&cloud))?;
    let entry = |(i, camera): (usize, &Camera)| {
        json!({
            "name": camera.name, "width": width, "height": height, "fx": camera.focal, "fy": camera.focal,
            "cx": 0.5 * width as f64, "cy": 0.5 * height as f64,
            "world_to_camera": camera.matrix(), "images": [photo(i)],
        })
    };
    let capture = json!({
        "version": 1, "name": "drum", "fps": FPS, "up": [0, 1, 0], "points": "points.ply",
        "hold_out": {"every": HOLD_EVERY},
        "cameras": cameras.iter().enumerate().map(entry).collect::<Vec<_>>(),
    });
    write_file(&folder.join("capture.json"), (serde_json::to_string_pretty(&capture)? + "\n").as_bytes())
}

fn photo(i: usize) -> String {
    format!("images/{i:04}.jpg")
}

/// Cameras on a way around the drum, three times with other heights and distances, by hand: neither exactly level nor
/// aimed at its middle.
fn walk(views: usize, [width, height]: [usize; 2]) -> Vec<Camera> {
    let camera = |i: usize| {
        let share = i as f64 / views as f64;
        let lap = (3.0 * share).floor();
        let (sin, cos) = sin_cos(TAU * (3.0 * share - lap));
        let random = |k: i64| hash01(i as i64, 100 + k) - 0.5;
        let distance = [1.9, 1.5, 2.3][lap as usize] + 0.2 * random(0);
        let up = [1.5, 0.7, 2.2][lap as usize] + 0.15 * random(1);
        let target = DRUM + v3(0.15 * random(2), 0.55 + 0.15 * random(3), 0.15 * random(4));
        let position = v3(DRUM.x + distance * sin, up, DRUM.z + distance * cos);
        Camera::look_at(format!("photo{i:04}"), position, target, 1.1 * width.max(height) as f64, width, height)
    };
    (0..views).map(camera).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::bundled_folder;

    #[test]
    fn photos_show_relief_sky_and_gloss() {
        let stage = Stage::yard(&bundled_folder().join("characters")).unwrap();
        let frame = stage.with(&Mesh::default(), vec![DRUM]);
        let cameras = walk(24, [48, 48]);
        let draw = |camera: &Camera| shade(stage.textures(), &frame, camera, &rasterize(&frame.mesh, camera)).rgb;
        let rgb = draw(&cameras[0]);
        let middle: Vec<u8> =
            (16..32).flat_map(|y| (16..32).map(move |x| (y, x))).map(|(y, x)| rgb[3 * (48 * y + x)]).collect();
        let (low, high) = (middle.iter().min().unwrap(), middle.iter().max().unwrap());
        assert!(high - low > 60, "the drum has relief: {low} to {high}");
        assert!((0..6).all(|i| draw(&cameras[4 * i]).iter().any(|c| *c > 40)), "no photo is dark");
        // The jar's mirror image moves with the camera; a matt surface would not change.
        let jar = v3(3.0, 0.5, 0.7);
        let at = |x: f64| {
            let camera = Camera::look_at("a".into(), v3(x, 1.2, 3.6), jar, 60.0, 9, 9);
            let seen = rasterize(&frame.mesh, &camera);
            let (index, weights, _) = crate::picture::surface(&frame, &camera, &seen, 4, 4).unwrap();
            (frame.mesh.triangles[index as usize].material, weights)
        };
        assert_eq!((at(2.0).0, at(4.0).0), (GLAZE, GLAZE));
        let view = |towards: V3| frame.light.mirrored(jar, v3(0.0, 0.0, 1.0), towards.unit(), 0.06);
        assert_ne!(view(v3(0.0, 0.2, 1.0)), view(v3(0.9, 0.2, 0.3)));
    }

    #[test]
    fn noise_is_between_0_and_1_and_continuous() {
        let values: Vec<f64> = (0..2000).map(|i| noise([0.013 * f64::from(i) - 9.0, 0.7], 4, 5)).collect();
        assert!(values.iter().all(|v| (0.0..=1.0).contains(v)));
        assert!(values.windows(2).all(|p| (p[0] - p[1]).abs() < 0.15));
    }
}
