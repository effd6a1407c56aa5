//! `capture --world NAME [--truth] FOLDER`: a world whose physics is known, filmed by eight cameras, with the true
//! paths of its nodes, what was done to it, and masks of the body at each pixel.

use crate::camera::Camera;
use crate::files::{png, write_file};
use crate::material::{BALL, PAINTED_CRATE};
use crate::mesh::Mesh;
use crate::picture::shade;
use crate::raster::{Visibility, rasterize};
use crate::scene::{Frame, Stage};
use crate::truth;
use crate::vector::{Affine, V3, sin_cos, v3};
use anyhow::{Result, anyhow};
use image::ExtendedColorType;
use rayon::prelude::*;
use serde_json::json;
use splat4d_dynamics::worlds::{Body, CLOTH, FPS, FRAMES, Shape, World};
use std::path::Path;

const WIDTH: usize = 200;
const HEIGHT: usize = 150;
/// Pixels; gives 58° across.
const FOCAL: f64 = 180.0;
/// Cameras are on an arc of this many degrees, alternately at two heights; one in the middle is held out.
const CAMERAS: usize = 8;
const HELD_OUT: usize = 3;
const ARC_DEGREES: f64 = 150.0;
const ARC_RADIUS: f64 = 5.0;
const ARC_HEIGHTS: [f64; 2] = [1.5, 3.0];
const ARC_TARGET: V3 = v3(0.0, 1.0, 0.3);
/// Sides of a ball's mesh.
const SIDES: u32 = 32;

/// `--world NAME FOLDER`; `maps`: with depth, flow and labels of every image.
pub(crate) fn command(name: &str, folder: &Path, maps: bool) -> Result<()> {
    let world = World::new(name).map_err(|e| anyhow!("{e}"))?;
    let stage = Stage::load(&crate::capture::bundled_folder().join("characters"))?;
    let cameras = rig();
    for t in 0..FRAMES {
        let frame = scene(&stage, &world, t);
        let seen: Vec<Visibility> = cameras.par_iter().map(|c| rasterize(&frame.mesh, c)).collect();
        let pictures: Vec<Vec<u8>> = (cameras.par_iter().zip(&seen))
            .map(|(camera, seen)| shade(stage.textures(), &frame, camera, seen).rgb)
            .collect();
        if maps {
            let next = (t + 1 < FRAMES).then(|| scene(&stage, &world, t + 1));
            (cameras.par_iter().zip(&seen))
                .try_for_each(|(c, seen)| truth::write_maps(folder, c, seen, t, &frame, next.as_ref()))?;
        }
        for (camera, rgb) in cameras.iter().zip(&pictures) {
            let file = png(rgb, WIDTH, HEIGHT, ExtendedColorType::Rgb8)?;
            write_file(&folder.join(format!("images/{}/{t:04}.png", camera.name)), &file)?;
        }
        for (camera, seen) in cameras.iter().zip(&seen).filter(|_| !maps) {
            let labels = truth::labels(camera, seen, &frame);
            let file = png(&labels, WIDTH, HEIGHT, ExtendedColorType::L8)?;
            write_file(&folder.join(format!("labels/{}/{t:04}.png", camera.name)), &file)?;
        }
        if t == 0 {
            let training = (0..CAMERAS).filter(|c| *c != HELD_OUT);
            let training: Vec<_> = training.map(|c| (&cameras[c], &seen[c], pictures[c].as_slice())).collect();
            write_file(&folder.join("points.ply"), &truth::ply(&truth::sparse_cloud(&frame, &training, truth::CLOUD)))?;
        }
    }
    write_truth(folder, &world)?;
    let entry = |camera: &Camera| {
        let mut entry = json!({
            "name": camera.name, "width": WIDTH, "height": HEIGHT,
            "fx": camera.focal, "fy": camera.focal, "cx": 0.5 * WIDTH as f64, "cy": 0.5 * HEIGHT as f64,
            "world_to_camera": camera.matrix(), "images": format!("images/{}/%04d.png", camera.name),
            "labels": format!("labels/{}/%04d.png", camera.name),
            "start": 0, "frames": FRAMES,
        });
        if maps {
            truth::list_maps(&mut entry, camera);
        }
        entry
    };
    let body = |(i, body): (usize, &Body)| {
        let shape = match body.shape {
            Shape::Ball(_) => "ball",
            Shape::Box(_) => "box",
            Shape::Cloth => "cloth",
        };
        format!("{shape} {}", i + 1)
    };
    let labels: Vec<String> =
        std::iter::once("hall".to_owned()).chain(world.bodies.iter().enumerate().map(body)).collect();
    let capture = json!({
        "labels": labels,
        "version": 1, "name": name, "fps": FPS, "up": [0, 1, 0], "points": "points.ply",
        "hold_out": {"cameras": [cameras[HELD_OUT].name]}, "cameras": cameras.iter().map(entry).collect::<Vec<_>>(),
    });
    write_file(&folder.join("capture.json"), (serde_json::to_string_pretty(&capture)? + "\n").as_bytes())
}

/// `truth/tracks.npy` [frames, nodes, 3] and, where something is done to the world, `actions.csv`.
fn write_truth(folder: &Path, world: &World) -> Result<()> {
    let nodes: Vec<Vec<[f64; 3]>> = (0..FRAMES).map(|t| world.nodes(t)).collect();
    let bytes: Vec<u8> = nodes.iter().flatten().flatten().flat_map(|v| (*v as f32).to_le_bytes()).collect();
    write_file(&folder.join("truth/tracks.npy"), &truth::npy("<f4", &[FRAMES, nodes[0].len(), 3], &bytes))?;
    match &world.actions {
        Some(actions) => write_file(&folder.join("actions.csv"), actions.to_csv().as_bytes()),
        None => Ok(()),
    }
}

fn rig() -> Vec<Camera> {
    let camera = |i: usize| {
        let degrees = ARC_DEGREES * (i as f64 / (CAMERAS - 1) as f64 - 0.5);
        let (sin, cos) = sin_cos(degrees * std::f64::consts::PI / 180.0);
        let position = v3(ARC_RADIUS * sin, ARC_HEIGHTS[i % 2], ARC_RADIUS * cos);
        Camera::look_at(format!("cam{i}"), position, ARC_TARGET, FOCAL, WIDTH, HEIGHT)
    };
    (0..CAMERAS).map(camera).collect()
}

/// The hall with motion in it.
fn scene(stage: &Stage, world: &World, t: usize) -> Frame {
    let mut moving = Mesh::default();
    let mut feet = Vec::new();
    for (index, (body, (x, r))) in world.bodies.iter().zip(&world.poses[t]).enumerate() {
        let column = |c: usize| v3(r[0][c], r[1][c], r[2][c]);
        let mut place = Affine { x: column(0), y: column(1), z: column(2), origin: v3(x[0], x[1], x[2]) };
        let object = index as u8 + 1;
        match body.shape {
            Shape::Ball(radius) => moving.ball(&place, radius, SIDES, BALL, object),
            Shape::Box([a, b, c]) => {
                place.origin = place.point(v3(0.0, -0.5 * b, 0.0));
                moving.crate_box(&place, v3(a, b, c), PAINTED_CRATE, object);
            }
            Shape::Cloth => cloth(&mut moving, &world.cloth[t], object),
        }
        let low = match body.shape {
            Shape::Ball(radius) => x[1] - radius,
            Shape::Box(sides) => x[1] - 0.5 * sides[1],
            Shape::Cloth => f64::INFINITY,
        };
        if low < 0.05 {
            feet.push(v3(x[0], 0.0, x[2]));
        }
    }
    stage.with(&moving, feet)
}

/// A grid of nodes as a surface with smooth normals.
fn cloth(mesh: &mut Mesh, nodes: &[[f64; 3]], object: u8) {
    let first = mesh.positions.len() as u32;
    let at = |r: usize, c: usize| {
        let p = nodes[r.min(CLOTH - 1) * CLOTH + c.min(CLOTH - 1)];
        v3(p[0], p[1], p[2])
    };
    for r in 0..CLOTH {
        for c in 0..CLOTH {
            let along = at(r, c + 1) - at(r, c.saturating_sub(1));
            let down = at(r + 1, c) - at(r.saturating_sub(1), c);
            let share = |i: usize| i as f64 / (CLOTH - 1) as f64;
            mesh.push_vertex(at(r, c), down.cross(along).unit(), [share(c), share(r)]);
        }
    }
    for r in 0..CLOTH as u32 - 1 {
        for c in 0..CLOTH as u32 - 1 {
            let a = first + r * CLOTH as u32 + c;
            let b = a + CLOTH as u32;
            mesh.push_triangle([a, b, b + 1], PAINTED_CRATE, object);
            mesh.push_triangle([a, b + 1, a + 1], PAINTED_CRATE, object);
        }
    }
}
