//! A second, richer set: a yard of brick, cobbles and plaster, with a riveted iron drum, a glazed jar, a railing, and a
//! window onto far hills under a sky. Fine texture, relief, thin parts, gloss and distance, all generated.

use crate::mesh::Mesh;
use crate::vector::{Affine, V3, sin_cos, smooth_step, v3};
use crate::yard_materials::{
    BRICK, COBBLES, DRUM, DRUM_HEIGHT, DRUM_RADIUS, GLAZE, IRON, LAND, LAND_TO, PLASTER, RAIL, SKY, noise, relief,
};
use std::f64::consts::TAU;

/// Height of brick and plaster walls, scene units; the sky is above them.
const WALL_HEIGHT: f64 = 3.4;
/// The window in the back wall: left, right, lower and upper edge, scene units.
const WINDOW: [f64; 4] = [-1.3, 1.3, 1.1, 2.6];
/// Vertices of the drum's relief around and up: 4 mm of a drum of 70 cm.
const RELIEF: [u32; 2] = [480, 220];
/// Distance of the nearest land (under the yard, below its paving) and of the sky, scene units.
const LAND_FROM: f64 = 4.0;
const SKY_AT: f64 = 600.0;

/// Walls at x = ±side and at z = back and front, paving, land and sky.
pub(crate) fn ground([side, back_at, front]: [f64; 3]) -> Mesh {
    let mut mesh = Mesh::default();
    let (depth, width) = (front - back_at, 2.0 * side);
    mesh.quad(v3(-side, 0.0, front), v3(width, 0.0, 0.0), v3(0.0, 0.0, -depth), [0.0; 2], COBBLES, 0);
    for vertex in 0..4 {
        mesh.uvs[vertex] = [mesh.positions[vertex].x, mesh.positions[vertex].z];
    }
    let mut wall = |from: V3, along: V3, [low, high]: [f64; 2], start: f64, material: u16| {
        let up = v3(0.0, high - low, 0.0);
        mesh.quad(from + v3(0.0, low, 0.0), along, up, [start, low], material, 0);
    };
    let [left, right, sill, lintel] = WINDOW;
    let back = |x: f64| v3(x, 0.0, back_at);
    wall(back(-side), v3(left + side, 0.0, 0.0), [0.0, WALL_HEIGHT], 0.0, BRICK);
    wall(back(right), v3(side - right, 0.0, 0.0), [0.0, WALL_HEIGHT], right + side, BRICK);
    wall(back(left), v3(right - left, 0.0, 0.0), [0.0, sill], left + side, BRICK);
    wall(back(left), v3(right - left, 0.0, 0.0), [lintel, WALL_HEIGHT], left + side, BRICK);
    wall(v3(side, 0.0, back_at), v3(0.0, 0.0, depth), [0.0, WALL_HEIGHT], 15.0, PLASTER);
    wall(v3(-side, 0.0, front), v3(0.0, 0.0, -depth), [0.0, WALL_HEIGHT], 42.0, PLASTER);
    wall(v3(side, 0.0, front), v3(-width, 0.0, 0.0), [0.0, WALL_HEIGHT], 27.0, BRICK);
    land(&mut mesh, side);
    mesh.ball(&Affine::IDENTITY, SKY_AT, 48, SKY, 0);
    mesh
}

/// What casts shadows: drum, jar, railing, bars of the window in the wall at z = `back_at`.
pub(crate) fn props(back_at: f64) -> Mesh {
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
        bar(left + (right - left) * f64::from(i) / 8.0, sill, back_at, v3(0.02, lintel - sill, 0.02));
    }
    for i in 1..4 {
        bar(0.5 * (left + right), sill + (lintel - sill) * f64::from(i) / 4.0, back_at, v3(right - left, 0.02, 0.02));
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
    push_grid(mesh, first, RELIEF, IRON);
    let rim = DRUM_RADIUS + 0.01;
    mesh.lathe(place, &[(rim, DRUM_HEIGHT - 0.005), (0.1, DRUM_HEIGHT + 0.04), (0.0, DRUM_HEIGHT + 0.05)], 64, RAIL, 0);
}

/// Triangles of a closed grid whose vertices, one more per row than cells, begin at `first`.
fn push_grid(mesh: &mut Mesh, first: u32, [around, up]: [u32; 2], material: u16) {
    for j in 0..up {
        for i in 0..around {
            let a = first + j * (around + 1) + i;
            let b = a + around + 1;
            mesh.push_triangle([a, a + 1, b + 1], material, 0);
            mesh.push_triangle([a, b + 1, b], material, 0);
        }
    }
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

/// Rings of land around a yard with walls at ±`side`, which rise to hills.
fn land(mesh: &mut Mesh, side: f64) {
    const AROUND: u32 = 160;
    const RINGS: u32 = 40;
    let first = mesh.positions.len() as u32;
    let height = |x: f64, z: f64| {
        let r = (x * x + z * z).sqrt();
        let (outside, far) = (smooth_step(side, 2.0 * side, r), smooth_step(side, LAND_TO, r));
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
    push_grid(mesh, first, [AROUND, RINGS], LAND);
}
