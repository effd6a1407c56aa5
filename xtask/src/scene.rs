//! The scene: the hall, its props, and thirty frames of a knight who storms at a mage's orb.
//!
//! Scene units are about 0.7 m: the knight is 2.4 units tall. World +y is up.

use crate::glb::Glb;
use crate::light::Light;
use crate::material::{BALL, BARREL, COLUMN, CRATE, FLOOR, KNIGHT, MAGE, ORB, PAINTED_CRATE, WALL};
use crate::mesh::Mesh;
use crate::skin::Character;
use crate::texture::Texture;
use crate::vector::{Affine, V3, heading, smooth_step, v3};
use crate::yard;
use anyhow::{Context, Result};
use std::ops::Range;
use std::path::Path;

/// Frames of the capture.
pub(crate) const FRAMES: usize = 30;
/// Frames per second.
pub(crate) const FPS: f64 = 30.0;
/// First frame in which the orb exists.
pub(crate) const ORB_APPEARS: usize = 9;
/// First frame without the painted crate.
pub(crate) const CRATE_LEAVES: usize = 18;
/// Names of the objects by their number.
pub(crate) const NAMES: [&str; 6] = ["hall", "knight", "mage", "ball", "crate", "orb"];
/// Number of objects, the static set (0) included.
pub(crate) const OBJECTS: usize = NAMES.len();

/// The hall: back wall, side walls and the wall behind the cameras, all seen from inside.
pub(crate) const BACK: f64 = -4.2;
/// See [`BACK`].
pub(crate) const FRONT: f64 = 7.8;
/// Side walls at ±this.
pub(crate) const SIDE: f64 = 7.5;
const HEIGHT: f64 = 7.2;

const ORB_RADIUS: f64 = 0.32;
/// Start of the blow's clip, seconds, and its speed: at full speed the sword moves 80 px per frame.
const BLOW_START: f64 = 0.30;
const BLOW_RATE: f64 = 0.53;
const BALL_RADIUS: f64 = 0.34;
/// 9.81 m/s² in scene units of 0.7 m.
const GRAVITY: f64 = 14.0;

/// Everything that does not depend on time.
pub(crate) struct Stage {
    pub(crate) knight: Character,
    pub(crate) mage: Character,
    fixed: Mesh,
    props: Mesh,
}

/// One time of the scene.
pub(crate) struct Frame {
    /// All triangles, the static set first.
    pub mesh: Mesh,
    /// First vertex of each object, `None` while it does not exist.
    pub first_vertex: [Option<u32>; OBJECTS],
    /// Skinned vertices of knight and mage.
    pub skinned: [Range<usize>; 2],
    /// The light with its shadow map.
    pub light: Light,
    /// Floor position of each moving object, for contact shade.
    pub feet: Vec<V3>,
}

impl Stage {
    /// Loads both characters from `folder`.
    pub(crate) fn load(folder: &Path) -> Result<Stage> {
        Self::with_set(folder, hall(), props())
    }

    /// Both characters in the yard instead of the hall.
    pub(crate) fn yard(folder: &Path) -> Result<Stage> {
        Self::with_set(folder, yard::ground([SIDE, BACK, FRONT]), yard::props(BACK))
    }

    fn with_set(folder: &Path, mut fixed: Mesh, props: Mesh) -> Result<Stage> {
        let character = |name: &str| -> Result<Character> {
            let path = folder.join(name);
            let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
            Glb::parse(&bytes).and_then(|glb| Character::load(&glb)).with_context(|| path.display().to_string())
        };
        fixed.append(&props);
        Ok(Stage { knight: character("Knight.glb")?, mage: character("Mage.glb")?, fixed, props })
    }

    /// The characters' textures, knight first.
    pub(crate) fn textures(&self) -> [&Texture; 2] {
        [&self.knight.texture, &self.mage.texture]
    }

    /// The hall with something else that moves; `feet`: where it is on the floor.
    pub(crate) fn with(&self, moving: &Mesh, feet: Vec<V3>) -> Frame {
        let mut casters = self.props.clone();
        casters.append(moving);
        let mut mesh = self.fixed.clone();
        mesh.append(moving);
        Frame { mesh, first_vertex: [None; OBJECTS], skinned: [0..0, 0..0], light: Light::new(&casters, None), feet }
    }

    /// The scene at frame `t`.
    pub(crate) fn frame(&self, t: usize) -> Result<Frame> {
        self.frame_at(t as f64)
    }

    /// The scene at a time in frames, between two of them where it is not whole.
    pub(crate) fn frame_at(&self, t: f64) -> Result<Frame> {
        let seconds = t / FPS;
        let mut moving = Mesh::default();
        let fixed = self.fixed.positions.len();
        let mut first_vertex = [None; OBJECTS];
        first_vertex[0] = Some(0);
        let mut mark = |object: usize, mesh: &Mesh| first_vertex[object] = Some((fixed + mesh.positions.len()) as u32);

        let (knight_at, knight_angle) = knight_path(t);
        mark(1, &moving);
        let pose = self.knight_pose(t)?;
        let knight = self.knight.draw(&pose, &Affine::standing(knight_at, knight_angle), KNIGHT, 1, &mut moving);
        let mage_start = moving.positions.len();
        mark(2, &moving);
        let mage_at = v3(1.15, 0.0, -0.35).lerp(v3(1.65, 0.0, -1.15), t / FRAMES as f64);
        let mage_angle = heading(-1.0, 0.45);
        let legs = self.mage.sample("Walking_Backwards", 0.9 * seconds)?;
        let arms = self.mage.sample("Spellcast_Long", 0.55 + 1.25 * seconds)?;
        let pose = self.mage.combine(&legs, &arms, "spine")?;
        let mage = self.mage.draw(&pose, &Affine::standing(mage_at, mage_angle), MAGE, 2, &mut moving);
        mark(3, &moving);
        let (ball, roll) = ball_path(seconds);
        moving.ball(&Affine { origin: ball, ..Affine::standing(ball, roll) }, BALL_RADIUS, 24, BALL, 3);
        let mut feet = vec![knight_at, mage_at, v3(ball.x, 0.0, ball.z)];
        if t < CRATE_LEAVES as f64 {
            mark(4, &moving);
            let place = Affine::standing(v3(-0.55, 0.0, 1.75), 0.5);
            moving.crate_box(&place, v3(0.8, 0.8, 0.8), PAINTED_CRATE, 4);
            feet.push(place.origin);
        }
        let orb = (t >= ORB_APPEARS as f64).then(|| orb_path(t));
        let light_casters = {
            let mut casters = self.props.clone();
            casters.append(&moving);
            casters
        };
        if let Some(orb) = orb {
            mark(5, &moving);
            moving.ball(&Affine { origin: orb, ..Affine::IDENTITY }, ORB_RADIUS, 24, ORB, 5);
        }
        let mut mesh = self.fixed.clone();
        mesh.append(&moving);
        let skinned = [fixed..fixed + knight, fixed + mage_start..fixed + mage_start + mage];
        Ok(Frame { mesh, first_vertex, skinned, light: Light::new(&light_casters, orb), feet })
    }

    /// Running, then a blow; the clips cross-fade over four frames.
    fn knight_pose(&self, t: f64) -> Result<crate::skin::Pose> {
        let run = self.knight.sample("Running_A", t / FPS)?;
        let blow = self.knight.sample("1H_Melee_Attack_Chop", BLOW_START + BLOW_RATE * (t - 11.0).max(0.0) / FPS)?;
        Ok(Character::blend(&run, &blow, smooth_step(10.0, 15.0, t)))
    }
}

/// Position and heading of the knight: a curved run that slows into the blow.
fn knight_path(t: f64) -> (V3, f64) {
    // Steady until frame 11, then braking evenly until frame 25; 18 steps of steady length in all.
    let braking = (t - 11.0).clamp(0.0, 14.0);
    let u = (t.min(25.0) - braking * braking / 28.0) / 18.0;
    let (p0, p1, p2) = (v3(-1.65, 0.0, -1.1), v3(-1.0, 0.0, 0.45), v3(0.4, 0.0, 0.4));
    let tangent = (p1 - p0).lerp(p2 - p1, u);
    (p0.lerp(p1, u).lerp(p1.lerp(p2, u), u), heading(tangent.x, tangent.z))
}

/// The orb rises out of the mage's reach and drifts towards the knight.
fn orb_path(t: f64) -> V3 {
    let s = (t - ORB_APPEARS as f64) / (FRAMES - ORB_APPEARS) as f64;
    v3(0.75, 1.25, 0.75).lerp(v3(0.3, 2.9, 1.0), s).lerp(v3(0.3, 2.9, 1.0).lerp(v3(-1.3, 2.1, 0.3), s), s)
}

/// Centre and spin of the bouncing ball.
fn ball_path(seconds: f64) -> (V3, f64) {
    let ground = v3(2.1, 0.0, 1.25).lerp(v3(0.15, 0.0, 2.35), seconds);
    // Bounces last 0.62 s; the first one is entered at its top.
    let bounce = 0.62;
    let phase = (seconds + 0.5 * bounce) / bounce;
    let local = (phase - phase.floor()) * bounce;
    (ground + v3(0.0, BALL_RADIUS + 0.5 * GRAVITY * local * (bounce - local), 0.0), -3.0 * seconds)
}

fn hall() -> Mesh {
    let mut mesh = Mesh::default();
    let (depth, width) = (FRONT - BACK, 2.0 * SIDE);
    let up = v3(0.0, HEIGHT, 0.0);
    mesh.quad(v3(-SIDE, 0.0, FRONT), v3(width, 0.0, 0.0), v3(0.0, 0.0, -depth), [0.0; 2], FLOOR, 0);
    // The floor pattern is laid out in world coordinates, z up the image being −z.
    for vertex in 0..4 {
        mesh.uvs[vertex] = [mesh.positions[vertex].x, mesh.positions[vertex].z];
    }
    mesh.quad(v3(-SIDE, 0.0, BACK), v3(width, 0.0, 0.0), up, [0.0; 2], WALL, 0);
    mesh.quad(v3(SIDE, 0.0, BACK), v3(0.0, 0.0, depth), up, [15.0; 2], WALL, 0);
    mesh.quad(v3(SIDE, 0.0, FRONT), v3(-width, 0.0, 0.0), up, [27.0; 2], WALL, 0);
    mesh.quad(v3(-SIDE, 0.0, FRONT), v3(0.0, 0.0, -depth), up, [42.0; 2], WALL, 0);
    for vertex in 8..mesh.uvs.len() {
        mesh.uvs[vertex][1] = mesh.positions[vertex].y;
    }
    let lid = mesh.positions.len();
    mesh.quad(v3(-SIDE, HEIGHT, BACK), v3(width, 0.0, 0.0), v3(0.0, 0.0, depth), [0.0; 2], COLUMN, 0);
    for vertex in lid..lid + 4 {
        mesh.uvs[vertex] = [0.0, 0.5];
    }
    mesh
}

fn props() -> Mesh {
    let mut mesh = Mesh::default();
    let at = |x: f64, z: f64, angle: f64| Affine::standing(v3(x, 0.0, z), angle);
    let shaft = [(0.56, 0.0), (0.56, 0.3), (0.42, 0.36), (0.38, HEIGHT)];
    for x in [-3.7, 3.7] {
        mesh.lathe(&at(x, -3.0, 0.0), &shaft, 32, COLUMN, 0);
    }
    let stump = [(0.40, 0.0), (0.34, 1.10), (0.0, 1.10)];
    mesh.lathe(&at(-2.0, 2.1, 0.0), &stump, 32, COLUMN, 0);
    mesh.crate_box(&at(3.0, -2.0, 0.35), v3(1.0, 1.0, 1.0), CRATE, 0);
    mesh.crate_box(&at(-3.1, 0.7, -0.25), v3(0.85, 0.85, 0.85), CRATE, 0);
    let barrel = [(0.36, 0.0), (0.42, 0.2), (0.45, 0.5), (0.42, 0.8), (0.36, 1.0), (0.0, 1.0)];
    mesh.lathe(&at(3.1, 0.9, 0.4), &barrel, 32, BARREL, 0);
    mesh.lathe(&at(-2.9, -2.0, 1.1), &barrel, 32, BARREL, 0);
    mesh
}
