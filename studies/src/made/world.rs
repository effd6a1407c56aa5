//! A synthetic world that is rendered by casting rays: boxes and balls with textures in space, cameras at exact poses.
//!
//! Everything is built from + − × ÷ √ and integer hashes, which give the same bits on every machine.

use splat4d::math::se3::{cross, dot, mat_vec, normalize, sub, transpose};
use splat4d::math::{Rng, Se3};

/// A position, a direction or a colour.
pub(crate) type V3 = [f64; 3];
/// A position in an image, pixels.
pub(crate) type V2 = [f64; 2];

/// Rays a pixel in each direction: their mean is the pixel.
const SAMPLES: usize = 2;
/// Sizes of a texture's octaves, of its grain, and what each weighs.
const OCTAVES: [[f64; 2]; 3] = [[1.0, 1.0], [0.5, 0.6], [0.25, 0.4]];
/// Noise is turned from dark to light between these values, so that textures have edges.
const EDGES: [f64; 2] = [0.42, 0.58];
/// Share of each channel's own noise in the colour.
const TINT: f64 = 0.16;
/// Towards the light, and what it adds to the light from everywhere. It casts no shadows.
const LIGHT: V3 = [-0.4, 0.8, 0.45];
const LIGHT_SHARE: f64 = 0.3;

pub(crate) fn add(a: V3, b: V3) -> V3 {
    std::array::from_fn(|k| a[k] + b[k])
}

pub(crate) fn times(a: V3, s: f64) -> V3 {
    a.map(|x| x * s)
}

/// Sine and cosine by their series; |a| is at most π.
pub(crate) fn sin_cos(a: f64) -> (f64, f64) {
    let (mut sin, mut cos, mut term) = (0.0, 0.0, 1.0);
    // Terms aⁿ/n!, the signs in pairs: + + − −. The first that is left out is below 1e-16 for |a| ≤ π.
    for n in 0..30 {
        let signed = if n % 4 < 2 { term } else { -term };
        if n % 2 == 0 {
            cos += signed;
        } else {
            sin += signed;
        }
        term *= a / f64::from(n + 1);
    }
    (sin, cos)
}

/// Colours in space: noise of a grain between two colours, a pure function of the seed and the position.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Texture {
    pub seed: u64,
    /// Size of the coarsest blobs, scene units.
    pub grain: f64,
    pub dark: V3,
    pub light: V3,
}

impl Texture {
    /// The colour at a position, sRGB values from 0 to 1.
    pub(crate) fn at(&self, p: V3) -> V3 {
        let mut sum = [0.0; 4];
        let mut weights = 0.0;
        for (octave, [size, weight]) in OCTAVES.into_iter().enumerate() {
            let rng = Rng::new(self.seed, "texture", octave as u64);
            let noise = lattice(rng, times(p, 1.0 / (self.grain * size)));
            sum = std::array::from_fn(|k| sum[k] + weight * noise[k]);
            weights += weight;
        }
        let [share, tint @ ..] = sum.map(|s| s / weights);
        let share = smooth((share - EDGES[0]) / (EDGES[1] - EDGES[0]));
        std::array::from_fn(|k| {
            let plain = self.dark[k] + (self.light[k] - self.dark[k]) * share;
            plain * (1.0 - TINT) + tint[k] * TINT
        })
    }
}

/// 3s² − 2s³ between 0 and 1.
fn smooth(s: f64) -> f64 {
    let s = s.clamp(0.0, 1.0);
    s * s * (3.0 - 2.0 * s)
}

/// Four smooth random fields from 0 to 1 with one value a lattice point (value noise).
fn lattice(rng: Rng, p: V3) -> [f64; 4] {
    let low = p.map(f64::floor);
    let part: V3 = std::array::from_fn(|k| smooth(p[k] - low[k]));
    let mut out = [0.0; 4];
    for corner in 0..8usize {
        let (mut weight, mut point) = (1.0, rng);
        for k in 0..3 {
            let far = corner >> k & 1;
            weight *= if far == 1 { part[k] } else { 1.0 - part[k] };
            point = point.fork((low[k] as i64 + far as i64) as u64);
        }
        for (channel, sum) in out.iter_mut().enumerate() {
            *sum += weight * point.uniform(channel as u64);
        }
    }
    out
}

/// The shape of an object, about its own origin.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Shape {
    /// Of this radius; seen from inside it is a dome.
    Ball(f64),
    /// Of these half sides, along the axes.
    Crate(V3),
}

/// Something to see.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Thing {
    pub shape: Shape,
    pub texture: Texture,
    /// Its origin at a share of the capture, from 0 to 1.
    pub place: fn(f64) -> V3,
    pub moves: bool,
}

impl Thing {
    /// Distance along a ray to its surface and the surface's normal.
    fn hit(&self, eye: V3, ray: V3, at: f64) -> Option<(f64, V3)> {
        let eye = sub(eye, (self.place)(at));
        match self.shape {
            Shape::Ball(radius) => {
                let (b, c) = (dot(eye, ray), dot(eye, eye) - radius * radius);
                let root = b * b - c;
                if root < 0.0 {
                    return None;
                }
                let root = root.sqrt();
                let far = if -b - root > 0.0 { -b - root } else { -b + root };
                (far > 0.0).then(|| (far, times(add(eye, times(ray, far)), 1.0 / radius)))
            }
            Shape::Crate(half) => {
                let (mut enter, mut leave, mut side) = (0.0f64, f64::INFINITY, None);
                for k in 0..3 {
                    if ray[k] == 0.0 {
                        if eye[k].abs() > half[k] {
                            return None;
                        }
                        continue;
                    }
                    let [a, b] = [-half[k], half[k]].map(|s| (s - eye[k]) / ray[k]);
                    if a.min(b) > enter {
                        (enter, side) = (a.min(b), Some(k));
                    }
                    leave = leave.min(a.max(b));
                }
                let side = side.filter(|_| enter <= leave)?;
                let mut normal = [0.0; 3];
                normal[side] = if ray[side] > 0.0 { -1.0 } else { 1.0 };
                Some((enter, normal))
            }
        }
    }
}

/// First hit of a ray.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    pub point: V3,
    pub color: V3,
    /// The object's number.
    pub thing: usize,
}

impl World {
    /// The position of an object's point, seen at a share of the capture, at another one.
    pub(crate) fn later(&self, seen: &Seen, at: f64, then: f64) -> V3 {
        let place = self.things[seen.thing].place;
        add(sub(seen.point, place(at)), place(then))
    }
}

/// Everything that is there.
#[derive(Clone, Debug)]
pub(crate) struct World {
    pub things: Vec<Thing>,
}

impl World {
    /// First hit of a ray (of length 1) from `eye` at a share of the capture.
    pub(crate) fn cast(&self, eye: V3, ray: V3, at: f64) -> Option<Seen> {
        let mut first: Option<(f64, V3, usize)> = None;
        for (i, thing) in self.things.iter().enumerate() {
            if let Some((far, normal)) = thing.hit(eye, ray, at).filter(|hit| first.is_none_or(|f| hit.0 < f.0)) {
                first = Some((far, normal, i));
            }
        }
        let (far, normal, thing) = first?;
        let point = add(eye, times(ray, far));
        let own = &self.things[thing];
        let facing = dot(normal, normalize(LIGHT)).max(0.0);
        let light = 1.0 - LIGHT_SHARE + LIGHT_SHARE * facing;
        // A texture moves with its thing.
        let color = own.texture.at(sub(point, (own.place)(at)));
        Some(Seen { point, color: times(color, light), thing })
    }
}

/// A pinhole camera that is held somewhere.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pinhole {
    pub cam_from_world: Se3,
    /// Focal length, pixels.
    pub focal: f64,
    pub size: [usize; 2],
}

impl Pinhole {
    pub(crate) fn center(&self) -> V3 {
        self.cam_from_world.inverse().translation
    }

    /// The direction (of length 1) of an image position.
    pub(crate) fn ray(&self, [x, y]: [f64; 2]) -> V3 {
        let [width, height] = self.size.map(|s| s as f64);
        let own = [(x - 0.5 * width) / self.focal, (y - 0.5 * height) / self.focal, 1.0];
        normalize(mat_vec(&transpose(&self.cam_from_world.rotation), own))
    }

    /// Image position of a point; `None`: outside the image.
    pub(crate) fn project(&self, point: V3) -> Option<[f64; 2]> {
        let p = self.cam_from_world.apply(point);
        let [width, height] = self.size.map(|s| s as f64);
        let at = [self.focal * p[0] / p[2] + 0.5 * width, self.focal * p[1] / p[2] + 0.5 * height];
        let inside = at[0] >= 0.0 && at[1] >= 0.0 && at[0] < width && at[1] < height;
        (p[2] > 0.0 && inside).then_some(at)
    }

    /// The image at a share of the capture, sRGB in 8 bits; `gain` multiplies every value.
    pub(crate) fn picture(&self, world: &World, at: f64, gain: f64) -> Vec<u8> {
        let eye = self.center();
        let mut out = Vec::with_capacity(3 * self.size[0] * self.size[1]);
        for y in 0..self.size[1] {
            for x in 0..self.size[0] {
                let mut sum = [0.0; 3];
                for sample in 0..SAMPLES * SAMPLES {
                    let within = |i: usize| (i as f64 + 0.5) / SAMPLES as f64;
                    let place = [x as f64 + within(sample % SAMPLES), y as f64 + within(sample / SAMPLES)];
                    let color = world.cast(eye, self.ray(place), at).map_or([0.0; 3], |s| s.color);
                    sum = add(sum, color);
                }
                let mean = times(sum, gain / (SAMPLES * SAMPLES) as f64);
                out.extend(mean.map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8));
            }
        }
        out
    }

    /// Depth along the camera's axis at the pixels' centres, world units; 0 where nothing is.
    pub(crate) fn depth(&self, world: &World, at: f64) -> Vec<f64> {
        let eye = self.center();
        let seen = |ray: V3| world.cast(eye, ray, at).map_or(0.0, |s| self.cam_from_world.apply(s.point)[2]);
        self.pixels().map(|place| seen(self.ray(place))).collect()
    }

    /// Displacement of the points at pixel centres to another time and camera, pixels; `None`: behind that.
    pub(crate) fn flow(&self, world: &World, [at, then]: [f64; 2], to: &Self) -> Vec<Option<[f64; 2]>> {
        let eye = self.center();
        let way = |place: V2| {
            let seen = world.cast(eye, self.ray(place), at)?;
            let p = to.cam_from_world.apply(world.later(&seen, at, then));
            let arrives = |k: usize| to.focal * p[k] / p[2] + 0.5 * to.size[k] as f64;
            (p[2] > 0.0).then(|| [arrives(0) - place[0], arrives(1) - place[1]])
        };
        self.pixels().map(way).collect()
    }

    /// Centres of the pixels, row by row.
    fn pixels(&self) -> impl Iterator<Item = V2> + '_ {
        let [width, height] = self.size;
        (0..width * height).map(move |p| [(p % width) as f64 + 0.5, (p / width) as f64 + 0.5])
    }

    /// This camera, turned about its own vertical by an angle: what a wrong calibration writes.
    pub(crate) fn turned(&self, angle: f64) -> Self {
        let (sin, cos) = sin_cos(angle);
        let [right, down, forward] = self.cam_from_world.rotation;
        let right = add(times(right, cos), times(forward, -sin));
        let rotation = [right, down, cross(right, down)];
        let turned = mat_vec(&rotation, self.center());
        let cam_from_world = Se3 { rotation, translation: times(turned, -1.0) };
        Self { cam_from_world, ..*self }
    }
}
