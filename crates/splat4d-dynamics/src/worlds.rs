//! Worlds with known physics, with ground-truth nodes and actions at every frame, for tests of forecasts.

use crate::actions::Actions;
use crate::paths::exp;
use crate::{Error, Result};
use splat4d::math::quat;
use splat4d::math::se3::{add, dot, mat_vec, norm, scale, sub};
use splat4d::math::{Rng, se3};

/// Frames a second.
pub const FPS: f64 = 30.0;
/// Frames of a world.
pub const FRAMES: usize = 150;
/// Names of all worlds.
pub const NAMES: [&str; 8] =
    ["pendulum", "circle", "pushed-block", "bounce", "rolling", "collision", "cloth", "driven-pendulum"];
/// Scene units per second squared.
const GRAVITY: f64 = 9.81;
/// Steps of integration a frame.
const SUBSTEPS: usize = 40;
/// Nodes along each side of the cloth.
pub const CLOTH: usize = 9;

/// Shape and colour of a body, about its own origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// A ball of this radius.
    Ball(f64),
    /// A box of these sides, about its centre.
    Box([f64; 3]),
    /// A grid of [`CLOTH`]² nodes; its points are in the world.
    Cloth,
}

/// A body and the nodes on it.
#[derive(Clone, Debug)]
pub struct Body {
    /// Its appearance.
    pub shape: Shape,
    /// Nodes, in the body's own axes; of cloth none.
    pub points: Vec<[f64; 3]>,
}

/// A centre and a rotation (rows).
pub type Pose = ([f64; 3], [[f64; 3]; 3]);

/// A world over all its frames.
#[derive(Clone, Debug)]
pub struct World {
    /// Its name.
    pub name: String,
    /// Moving bodies.
    pub bodies: Vec<Body>,
    /// \[frames]\[bodies].
    pub poses: Vec<Vec<Pose>>,
    /// \[frames]: nodes of the cloth, row by row; empty without one.
    pub cloth: Vec<Vec<[f64; 3]>>,
    /// Actions on it.
    pub actions: Option<Actions>,
}

impl World {
    /// The world of a name. Errors: there is none.
    pub fn new(name: &str) -> Result<Self> {
        let (bodies, poses) = match name {
            "pendulum" => pendulum(),
            "circle" => circle(),
            "pushed-block" | "driven-pendulum" => {
                let (bodies, poses, actions) = if name == "pushed-block" { pushed_block() } else { driven_pendulum() };
                return Ok(Self { name: name.into(), bodies, poses, cloth: Vec::new(), actions: Some(actions) });
            }
            "bounce" => bounce(),
            "rolling" => rolling(),
            "collision" => collision(),
            "cloth" => {
                let bodies = vec![Body { shape: Shape::Cloth, points: Vec::new() }];
                let poses = vec![vec![([0.0; 3], IDENTITY)]; FRAMES];
                return Ok(Self { name: name.into(), bodies, poses, cloth: cloth(), actions: None });
            }
            _ => {
                return Err(Error::input(format!("there is no world called {name}"))
                    .remedy(format!("Choose one of {}", NAMES.join(", "))));
            }
        };
        Ok(Self { name: name.into(), bodies, poses, cloth: Vec::new(), actions: None })
    }

    /// True positions of all nodes at a frame.
    pub fn nodes(&self, frame: usize) -> Vec<[f64; 3]> {
        let of =
            |(body, (x, r)): (&Body, &Pose)| body.points.iter().map(|p| add(*x, mat_vec(r, *p))).collect::<Vec<_>>();
        let mut out: Vec<[f64; 3]> = self.bodies.iter().zip(&self.poses[frame]).flat_map(of).collect();
        out.extend(self.cloth.get(frame).into_iter().flatten());
        out
    }
}

type Poses = Vec<Vec<Pose>>;

const IDENTITY: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

fn turned(w: [f64; 3]) -> [[f64; 3]; 3] {
    quat::to_rotation(exp(w))
}

fn ball(radius: f64) -> Body {
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    Body {
        shape: Shape::Ball(radius),
        points: axes.iter().flat_map(|a| [scale(*a, radius), scale(*a, -radius)]).collect(),
    }
}

fn cuboid(sides: [f64; 3]) -> Body {
    let corner = |i: usize| std::array::from_fn(|c| if i >> c & 1 == 0 { -0.5 } else { 0.5 } * sides[c]);
    Body { shape: Shape::Box(sides), points: (0..8).map(corner).collect() }
}

/// A rod of a pendulum, its pivot, and g/ℓ, 1/s²: 45 frames a swing.
const PIVOT: [f64; 3] = [0.0, 2.35, 0.3];
const LENGTH: f64 = 1.6;
const RATE: f64 = 20.0;

/// Rod and bob at an angle.
fn hanging(angle: f64) -> Vec<Pose> {
    let down = [angle.sin(), -angle.cos(), 0.0];
    let r = turned([0.0, 0.0, angle]);
    vec![(add(PIVOT, scale(down, 0.5 * LENGTH)), r), (add(PIVOT, scale(down, LENGTH)), r)]
}

fn rod_and_bob() -> Vec<Body> {
    vec![cuboid([0.12, LENGTH, 0.12]), ball(0.34)]
}

/// A rod with a bob, turning about a pivot: θ'' = −(g/ℓ) sin θ.
fn pendulum() -> (Vec<Body>, Poses) {
    const RELEASED: f64 = 0.95;
    let (mut angle, mut speed) = (RELEASED, 0.0);
    let dt = 1.0 / (FPS * SUBSTEPS as f64);
    let mut poses = Vec::new();
    for _ in 0..FRAMES {
        poses.push(hanging(angle));
        for _ in 0..SUBSTEPS {
            // Leapfrog.
            speed -= 0.5 * dt * RATE * f64::sin(angle);
            angle += dt * speed;
            speed -= 0.5 * dt * RATE * f64::sin(angle);
        }
    }
    (rod_and_bob(), poses)
}

/// The same with drag and a motor at the pivot, whose torque changes every few frames: θ'' = −(g/ℓ) sin θ − c θ' + u.
fn driven_pendulum() -> (Vec<Body>, Poses, Actions) {
    const DRAG: f64 = 0.8; // 1/s
    const TORQUE: f64 = 14.0; // 1/s²
    let rng = Rng::new(11, "torques", 0);
    let (mut angle, mut speed, mut torque, mut until) = (0.3, 0.0f64, 0.0, 0);
    let dt = 1.0 / (FPS * SUBSTEPS as f64);
    let (mut poses, mut rows) = (Vec::new(), Vec::new());
    for t in 0..FRAMES {
        if t == until {
            let k = 3 * t as u64;
            until = t + 5 + rng.below(k, 9);
            torque = TORQUE * (2.0 * rng.uniform(k + 1) - 1.0);
        }
        poses.push(hanging(angle));
        rows.push(vec![torque]);
        for _ in 0..SUBSTEPS {
            speed += dt * (torque - RATE * f64::sin(angle) - DRAG * speed);
            angle += dt * speed;
        }
    }
    (rod_and_bob(), poses, Actions { names: vec!["torque".into()], rows })
}

/// A box that drives round and round.
fn circle() -> (Vec<Body>, Poses) {
    const RADIUS: f64 = 1.1;
    const PERIOD: f64 = 50.0; // frames
    let pose = |t: usize| {
        let a = std::f64::consts::TAU * t as f64 / PERIOD;
        vec![([RADIUS * a.cos(), 0.35, RADIUS * a.sin() + 0.4], turned([0.0, -a, 0.0]))]
    };
    (vec![cuboid([0.5, 0.7, 0.8])], (0..FRAMES).map(pose).collect())
}

/// A box on the floor that is pushed about: v ← 0.9 v + push each frame.
fn pushed_block() -> (Vec<Body>, Poses, Actions) {
    const SLOWED: f64 = 0.9;
    const PUSH: f64 = 0.012; // scene units a frame²
    const REACH: f64 = 1.1;
    let rng = Rng::new(7, "pushes", 0);
    let (mut x, mut v, mut push) = ([0.0f64, 0.35, 0.3], [0.0f64; 3], [0.0f64; 3]);
    let (mut poses, mut rows, mut until) = (Vec::new(), Vec::new(), 0);
    for t in 0..FRAMES {
        if t == until {
            let k = 4 * t as u64;
            until = t + 5 + rng.below(k, 9);
            let angle = std::f64::consts::TAU * rng.uniform(k + 1);
            let size = PUSH * (0.4 + 0.6 * rng.uniform(k + 2));
            push = [size * angle.cos(), 0.0, size * angle.sin()];
            // Back to the middle where it would leave.
            for (c, middle) in [(0, 0.0f64), (2, 0.3)] {
                if (x[c] - middle).abs() > 0.5 * REACH && (x[c] - middle) * push[c] > 0.0 {
                    push[c] = -push[c];
                }
            }
        }
        poses.push(vec![(x, turned([0.0, 0.4, 0.0]))]);
        rows.push(push.to_vec());
        v = add(scale(v, SLOWED), push);
        x = add(x, v);
    }
    let names = ["push.x", "push.y", "push.z"].map(String::from).to_vec();
    (vec![cuboid([0.8, 0.7, 0.6])], poses, Actions { names, rows })
}

/// A ball that loses a fifth of its speed at every bounce.
fn bounce() -> (Vec<Body>, Poses) {
    const RADIUS: f64 = 0.35;
    const KEPT: f64 = 0.8;
    let (mut x, mut v) = ([-1.2, 2.2, 0.3], [0.5, 0.0, 0.0]);
    let dt = 1.0 / (FPS * SUBSTEPS as f64);
    let mut poses = Vec::new();
    for t in 0..FRAMES {
        poses.push(vec![(x, turned([0.0, 0.0, -1.5 * t as f64 / FPS]))]);
        for _ in 0..SUBSTEPS {
            v[1] -= dt * GRAVITY;
            x = add(x, scale(v, dt));
            if x[1] < RADIUS && v[1] < 0.0 {
                v[1] *= -KEPT;
            }
        }
    }
    (vec![ball(RADIUS)], poses)
}

/// A ball that rolls without slipping and slows down.
fn rolling() -> (Vec<Body>, Poses) {
    const RADIUS: f64 = 0.4;
    const SPEED: f64 = 1.1;
    const SLOWS: f64 = 0.18; // scene units per second squared
    let pose = |t: usize| {
        let s = (t as f64 / FPS).min(SPEED / SLOWS);
        let way = SPEED * s - 0.5 * SLOWS * s * s;
        vec![([-1.6 + way, RADIUS, 0.4], turned([0.0, 0.0, -way / RADIUS]))]
    };
    (vec![ball(RADIUS)], (0..FRAMES).map(pose).collect())
}

/// Two balls on a table without friction that meet, elastically, and are pulled together again by a spring.
fn collision() -> (Vec<Body>, Poses) {
    const RADIUS: f64 = 0.35;
    const PULL: f64 = 6.0; // 1/s²
    let mut x = [[-1.2, RADIUS, 0.2], [1.2, RADIUS, 0.35]];
    let mut v = [[0.4, 0.0, 0.0], [-0.2, 0.0, 0.0]];
    let dt = 1.0 / (FPS * SUBSTEPS as f64);
    let mut poses = Vec::new();
    for _ in 0..FRAMES {
        poses.push(x.iter().map(|x| (*x, IDENTITY)).collect());
        for _ in 0..SUBSTEPS {
            for i in 0..2 {
                v[i] = add(v[i], scale(sub([0.0, RADIUS, 0.3], x[i]), PULL * dt));
                x[i] = add(x[i], scale(v[i], dt));
            }
            let apart = sub(x[1], x[0]);
            let n = scale(apart, 1.0 / norm(apart));
            let closing = dot(sub(v[1], v[0]), n);
            if norm(apart) < 2.0 * RADIUS && closing < 0.0 {
                // Equal masses exchange what they have along the line between them.
                v[0] = add(v[0], scale(n, closing));
                v[1] = sub(v[1], scale(n, closing));
            }
        }
    }
    (vec![ball(RADIUS), ball(RADIUS)], poses)
}

/// A cloth that hangs from two corners: springs along the grid and its diagonals, a little drag.
fn cloth() -> Vec<Vec<[f64; 3]>> {
    const SIDE: f64 = 1.6;
    const STIFF: f64 = 900.0; // 1/s² a unit of strain and length
    const DRAG: f64 = 0.12; // 1/s
    const SPRING_DRAG: f64 = 4.0; // 1/s
    let gap = SIDE / (CLOTH - 1) as f64;
    let id = |r: usize, c: usize| r * CLOTH + c;
    let mut x: Vec<[f64; 3]> = (0..CLOTH * CLOTH)
        .map(|i| [gap * (i % CLOTH) as f64 - 0.5 * SIDE, 2.3, 0.3 + gap * (i / CLOTH) as f64])
        .collect();
    let mut v = vec![[0.0; 3]; x.len()];
    let mut springs = Vec::new();
    for r in 0..CLOTH {
        for c in 0..CLOTH {
            for (a, b) in [(0, 1), (1, 0), (1, 1)] {
                if r + a < CLOTH && c + b < CLOTH {
                    springs.push((id(r, c), id(r + a, c + b), gap * ((a * a + b * b) as f64).sqrt()));
                }
            }
            if r + 1 < CLOTH && c > 0 {
                springs.push((id(r, c), id(r + 1, c - 1), gap * 2f64.sqrt()));
            }
        }
    }
    let held = [id(0, 0), id(0, CLOTH - 1)];
    let dt = 1.0 / (FPS * SUBSTEPS as f64);
    let mut out = Vec::new();
    for _ in 0..FRAMES {
        out.push(x.clone());
        for _ in 0..SUBSTEPS {
            let mut a: Vec<[f64; 3]> = v.iter().map(|v| add([0.0, -0.35 * GRAVITY, 0.0], scale(*v, -DRAG))).collect();
            for &(i, j, rest) in &springs {
                let (d, w) = (sub(x[j], x[i]), sub(v[j], v[i]));
                let n = se3::normalize(d);
                let pull = STIFF * (norm(d) - rest) + SPRING_DRAG * dot(w, n);
                a[i] = add(a[i], scale(n, pull));
                a[j] = sub(a[j], scale(n, pull));
            }
            for i in (0..x.len()).filter(|i| !held.contains(i)) {
                v[i] = add(v[i], scale(a[i], dt));
                x[i] = add(x[i], scale(v[i], dt));
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn worlds_obey_their_laws() {
        for name in NAMES {
            let world = World::new(name).unwrap();
            let all: Vec<Vec<[f64; 3]>> = (0..FRAMES).map(|t| world.nodes(t)).collect();
            let far = all.iter().flatten().map(|x| norm(*x)).fold(0.0, f64::max);
            let low = all.iter().flatten().map(|x| x[1]).fold(f64::INFINITY, f64::min);
            let moved = norm(sub(all[60][0], all[0][0])).max(norm(sub(all[75][0], all[0][0])));
            assert!(far < 4.5 && low > -0.05, "{name}: as far as {far}, as low as {low}");
            assert!(name == "cloth" || moved > 0.1, "{name} moves: {moved}");
        }
        // The pendulum returns to its start: no energy is lost.
        let world = World::new("pendulum").unwrap();
        let height = |t: usize| world.poses[t][1].0[1];
        let top = (100..FRAMES).map(height).fold(0.0, f64::max);
        assert!((top - height(0)).abs() < 5e-3, "{top} {}", height(0));
        // Equal balls: what one loses the other gains. The block's next step follows from the action.
        let block = World::new("pushed-block").unwrap();
        let at = |t: usize| block.poses[t][0].0;
        let push = &block.actions.as_ref().unwrap().rows[70];
        let next = add(at(70), add(scale(sub(at(70), at(69)), 0.9), [push[0], push[1], push[2]]));
        assert!(norm(sub(next, at(71))) < 1e-12);
        assert!(World::new("nowhere").unwrap_err().to_string().contains("pendulum"));
    }
}
