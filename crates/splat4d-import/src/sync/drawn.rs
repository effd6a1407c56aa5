//! A synthetic rig for tests: lights that move before textured walls, as fixed cameras with clocks of their own see
//! them.

use super::grey::Grey;
use super::tracks::Track;
use splat4d::math::Rng;
use splat4d::math::Se3;
use splat4d::scene::{Camera, Intrinsics};
use splat4d_train::capture::Rgb8;

/// Frames per second.
pub(super) const FPS: f64 = 30.0;
const WIDTH: usize = 240;
const HEIGHT: usize = 180;

/// How the lights move.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Dance {
    /// Never the same.
    Free,
    /// The same every 0.4 s.
    Loop,
    /// Not at all.
    Still,
}

pub(super) struct Rig {
    pub(super) cameras: Vec<Camera>,
    /// Seconds between camera and scene: an event at t is at t − offset on the camera's clock.
    pub(super) offsets: Vec<f64>,
    dance: Dance,
    lights: usize,
    seed: u64,
}

impl Rig {
    pub(super) fn new(offsets: &[f64], lights: usize, dance: Dance) -> Self {
        let camera = |c: usize| {
            let angle = 0.45 * c as f64;
            let eye = [5.0 * angle.sin(), -0.6 - 0.25 * (c % 3) as f64, -5.0 * angle.cos()];
            Camera {
                cam_from_world: Se3::look_at(eye, [0.0; 3], [0.0, -1.0, 0.0]),
                intrinsics: Intrinsics { fx: 230.0, fy: 230.0, cx: 120.0, cy: 90.0 },
                ..Camera::with_fov_y(Se3::look_at(eye, [0.0; 3], [0.0, -1.0, 0.0]), 0.7, WIDTH, HEIGHT)
            }
        };
        Self { cameras: (0..offsets.len()).map(camera).collect(), offsets: offsets.to_vec(), dance, lights, seed: 5 }
    }

    /// The same rig in another recording.
    pub(super) fn other_take(mut self) -> Self {
        self.seed += 1;
        self
    }

    fn light(&self, k: usize, t: f64) -> [f64; 3] {
        let rng = Rng::new(self.seed, "lights of a drawn rig", k as u64);
        let turn = std::f64::consts::TAU;
        let place = |i: u64| 2.2 * (rng.uniform(i) - 0.5);
        let wave = |i: u64| match self.dance {
            Dance::Still => 0.0,
            Dance::Loop => 0.25 * (turn * (t / 0.4 + rng.uniform(i))).sin(),
            Dance::Free => {
                // All people move to the same music, faster and slower, each in their own way.
                let music = |j: u64| Rng::new(self.seed, "music", 0).uniform(j);
                let beat = |s: f64, j: u64| (s * t + turn * music(j)).sin();
                let time = t + 0.28 * beat(1.9, 0) + 0.13 * beat(4.3, 1) + 0.05 * beat(9.7, 2) + 0.02 * beat(17.0, 3);
                let one = |s: f64, j: u64| (s * time + turn * rng.uniform(i + j)).sin();
                0.35 * one(1.3 + rng.uniform(i + 1), 2) + 0.2 * one(2.9 + 2.0 * rng.uniform(i + 3), 4)
            }
        };
        [place(0) + wave(10), place(1) + wave(20), place(2) + wave(30)]
    }

    /// A camera's image at a second of its own clock.
    pub(super) fn picture(&self, camera: usize, time: f64) -> Rgb8 {
        let t = time + self.offsets[camera];
        let mut data = vec![0.0; WIDTH * HEIGHT];
        for (i, v) in data.iter_mut().enumerate() {
            let (x, y) = ((i % WIDTH) as f64, (i / WIDTH) as f64 + 31.0 * camera as f64);
            *v = 0.25 + 0.05 * ((0.21 * x).sin() * (0.17 * y).cos() + (0.05 * x + 0.07 * y).sin());
        }
        for k in 0..self.lights {
            /// Size of a light, pixels.
            const SIZE: f64 = 2.2;
            let Some(([u, v], _)) = self.cameras[camera].project(self.light(k, t)) else { continue };
            let range = |c: f64, most: usize| {
                let low = (c - 4.0 * SIZE).max(0.0) as usize;
                low..((c + 4.0 * SIZE).max(0.0) as usize + 1).min(most)
            };
            for y in range(v, HEIGHT) {
                for x in range(u, WIDTH) {
                    let square = (x as f64 + 0.5 - u).powi(2) + (y as f64 + 0.5 - v).powi(2);
                    data[y * WIDTH + x] += 0.5 * (-0.5 * square / (SIZE * SIZE)).exp();
                }
            }
        }
        let byte = |v: f64| (255.0 * v).round().clamp(0.0, 255.0) as u8;
        Rgb8 { width: WIDTH, height: HEIGHT, data: data.iter().flat_map(|&v| [byte(v); 3]).collect() }
    }

    /// The median of some of a camera's images.
    pub(super) fn still(&self, camera: usize, frames: usize) -> Grey {
        let all: Vec<Grey> = (0..7).map(|k| Grey::of(&self.picture(camera, (k * frames / 7) as f64 / FPS))).collect();
        let mut out = all[0].clone();
        for (i, v) in out.data.iter_mut().enumerate() {
            let mut values: Vec<f32> = all.iter().map(|g| g.data[i]).collect();
            *v = *values.select_nth_unstable_by(3, f32::total_cmp).1;
        }
        out
    }

    /// Perfect tracks of the lights with noise of this many pixels.
    pub(super) fn tracks(&self, camera: usize, frames: usize, noise: f64) -> Vec<Track> {
        let track = |k: usize| {
            let rng = Rng::new(9, "noise of drawn tracks", (camera * 1000 + k) as u64);
            let sample = |n: usize| {
                let time = n as f64 / FPS;
                let ([u, v], _) = self.cameras[camera].project(self.light(k, time + self.offsets[camera])).unwrap();
                let off = |i: usize| noise * rng.normal((2 * n + i) as u64);
                (time, [u + off(0), v + off(1)])
            };
            Track { samples: (0..frames).map(sample).collect() }
        };
        (0..self.lights).map(track).collect()
    }

    /// F with `x_bᵀ F x_a = 0`.
    pub(super) fn fundamental(&self, a: usize, b: usize) -> [[f64; 3]; 3] {
        use splat4d::math::se3::{mat_mul, transpose};
        let (a, b) = (&self.cameras[a], &self.cameras[b]);
        let (from_a, to_b) = (a.cam_from_world.inverse(), b.cam_from_world);
        let rotation = mat_mul(&to_b.rotation, &from_a.rotation);
        let t = to_b.apply(from_a.translation);
        let cross = [[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]];
        let inverse =
            |k: &Intrinsics| [[1.0 / k.fx, 0.0, -k.cx / k.fx], [0.0, 1.0 / k.fy, -k.cy / k.fy], [0.0, 0.0, 1.0]];
        let essential = mat_mul(&cross, &rotation);
        mat_mul(&transpose(&inverse(&b.intrinsics)), &mat_mul(&essential, &inverse(&a.intrinsics)))
    }
}
