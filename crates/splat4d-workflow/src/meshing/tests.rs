use super::*;
use crate::events::ignore;
use splat4d::format::dialect;
use splat4d::layers::Scene;
use splat4d::math::quat;
use splat4d::math::se3::{add, norm, normalize, scale, sub};
use splat4d::scene::params::{LOG_SCALE, OPACITY, QUAT};
use splat4d::scene::{GEOMETRY, Params, SH};

/// Radius of the ball.
const RADIUS: f64 = 0.5;
/// Splats on it.
const COUNT: usize = 1500;
/// Its place.
const CENTER: [f64; 3] = [0.3, -0.2, 0.1];

/// A ball of flat, opaque splats, red on its upper half and blue below, and a speck far above it.
fn ball(up: [f64; 3]) -> Scene<f32> {
    let turn = rotation_between(GRID_UP, up).unwrap();
    let mut params = Params::new(COUNT + 1, 1, &[]);
    for row in 0..=COUNT {
        let z = 1.0 - (2.0 * row as f64 + 1.0) / COUNT as f64;
        let (flat, angle) = ((1.0 - z * z).max(0.0).sqrt(), 2.399_963 * row as f64);
        let n = mat_vec(&turn, [flat * angle.cos(), flat * angle.sin(), z]);
        let speck = row == COUNT;
        let place = if speck { add(CENTER, scale(up, 0.9)) } else { add(CENTER, scale(n, RADIUS)) };
        let q = quat::from_rotation(&rotation_between(GRID_UP, n).unwrap());
        params[GEOMETRY].write(row, 0, place.map(|x| x as f32));
        params[GEOMETRY].write(row, QUAT, q.map(|x| x as f32));
        let wide = if speck { -4.6f32 } else { -3.4 };
        params[GEOMETRY].write(row, LOG_SCALE, [wide, wide, if speck { wide } else { -7.0 }]);
        params[GEOMETRY].set(row, OPACITY, 5.0);
        let color = if z > 0.0 { [1.7f32, -1.7, -1.7] } else { [-1.7, -1.7, 1.7] };
        params[SH].write(row, 0, color);
    }
    Scene { up, ..dialect::still(params) }
}

fn meshed(scene: Scene<f32>, options: MeshOptions) -> Mesh {
    let source = Source::own(scene);
    Mesher::new(&source, &options).unwrap().at(0.0).unwrap()
}

/// Mean distance of vertices from the ball, the largest one, and the mean angle between normals, degrees.
fn errors(mesh: &Mesh) -> [f64; 3] {
    let (mut sum, mut most, mut angle) = (0.0, 0.0f64, 0.0);
    for (p, n) in mesh.positions.iter().zip(&mesh.normals) {
        let from = sub(p.map(f64::from), CENTER);
        let off = (norm(from) - RADIUS).abs();
        let along: f64 = normalize(from).iter().zip(n).map(|(a, b)| a * f64::from(*b)).sum();
        (sum, most, angle) = (sum + off, most.max(off), angle + along.clamp(-1.0, 1.0).acos().to_degrees());
    }
    let count = mesh.positions.len() as f64;
    [sum / count, most, angle / count]
}

/// Largest distance of points of the ball from the nearest vertex: what the mesh does not cover.
fn uncovered(mesh: &Mesh) -> f64 {
    let gap = |i: usize| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / 200.0;
        let (flat, angle) = ((1.0 - z * z).sqrt(), 2.399_963 * i as f64);
        let p = add(CENTER, scale([flat * angle.cos(), flat * angle.sin(), z], RADIUS));
        mesh.positions.iter().map(|v| norm(sub(v.map(f64::from), p))).fold(f64::INFINITY, f64::min)
    };
    (0..200).map(gap).fold(0.0, f64::max)
}

/// Edges that do not have one triangle on each side.
fn open_edges(mesh: &Mesh) -> usize {
    let mut edges = std::collections::BTreeMap::new();
    for [a, b, c] in &mesh.triangles {
        for (from, to) in [(a, b), (b, c), (c, a)] {
            *edges.entry((*from.min(to), *from.max(to))).or_insert(0) += if from < to { 1 } else { -1 };
        }
    }
    edges.values().filter(|n| **n != 0).count()
}

#[test]
fn a_ball_is_meshed_where_it_is() {
    let voxel = 0.04;
    for up in [GRID_UP, [0.0, -1.0, 0.0]] {
        let mesh = meshed(ball(up), MeshOptions { voxel, ..MeshOptions::default() });
        let [mean, most, angle] = errors(&mesh);
        assert!(mean < 0.1 * voxel && most < 0.5 * voxel && angle < 5.0, "{mean} {most} {angle}");
        assert!(uncovered(&mesh) < voxel, "{}", uncovered(&mesh));
        for (p, color) in mesh.positions.iter().zip(&mesh.colors) {
            let height: f64 = (0..3).map(|k| (f64::from(p[k]) - CENTER[k]) * up[k]).sum();
            assert!(height < RADIUS + 0.1, "the speck is left out");
            let expected = if height > 0.0 { [250, 5, 5] } else { [5, 5, 250] };
            let same = color.iter().zip(expected).all(|(a, b)| a.abs_diff(b) < 25);
            assert!(height.abs() < 0.1 || same, "{height} {color:?}");
        }
    }
}

#[test]
fn closed_meshes_have_no_open_edge() {
    for collision in [false, true] {
        let options = MeshOptions { voxel: 0.04, watertight: true, collision, ..MeshOptions::default() };
        let mesh = meshed(ball(GRID_UP), options);
        assert!(open_edges(&mesh) == 0 && mesh.colors.is_empty() == collision && mesh.normals.is_empty() == collision);
    }
}

#[test]
fn times_and_names_decide_what_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let source = Source::own(ball(GRID_UP));
    let scene = at("scene.safetensors");
    let options = MeshOptions { voxel: 0.08, ..MeshOptions::default() };
    let run = |name: &str, options: MeshOptions| write(&scene, &source, &at(name), &options, &ignore);
    for name in ["a.glb", "a.OBJ", "a.ply"] {
        assert_eq!(run(name, options).unwrap(), 1);
        assert!(std::fs::metadata(at(name)).unwrap().len() > 10_000, "{name}");
    }
    let frames = Frames { fps: Some(2.0), from: Some(0.0), to: Some(1.0) };
    let three = MeshOptions { frames, ..options };
    assert_eq!(run("frames", three).unwrap(), 3);
    assert!(at("frames/frame_00002.glb").is_file());
    assert_eq!(run("more/m.%03d.obj", three).unwrap(), 3);
    assert!(at("more/m.002.obj").is_file());
    let fails = |name: &str, options: MeshOptions, word: &str| {
        let error = run(name, options).unwrap_err().to_string();
        assert!(error.contains(word), "{name}: {error}");
    };
    fails("a.glb", options, "exists");
    run("a.glb", MeshOptions { force: true, ..options }).unwrap();
    fails("a.stl", options, "expected the ending glb, obj or ply, found .stl");
    fails("b.glb", three, "one mesh has one time");
    fails("folder", MeshOptions { time: Some(0.0), ..options }, "one mesh");
    for voxel in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        fails("b.glb", MeshOptions { voxel, ..options }, "invalid option `voxel`");
    }
    fails("b.glb", MeshOptions { voxel: 50.0, ..options }, "too large");
    for voxel in [1e-12, 5e-4] {
        fails("b.glb", MeshOptions { voxel, ..options }, "more than 150000 blocks");
    }
    let empty = Source::own(Scene { up: GRID_UP, ..dialect::still(Params::new(0, 1, &[])) });
    let error = write(&scene, &empty, &at("e.glb"), &options, &ignore).unwrap_err().to_string();
    assert!(error.contains("no Gaussians"), "{error}");
    let mut hidden = ball(GRID_UP);
    (0..=COUNT).for_each(|row| hidden.layers[0].params[GEOMETRY].set(row, OPACITY, -9.0));
    let error = write(&scene, &Source::own(hidden), &at("e.glb"), &options, &ignore).unwrap_err().to_string();
    assert!(error.contains("no surface is seen at 0 s") && !at("e.glb").exists(), "{error}");
}
