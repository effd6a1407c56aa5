//! Light: one key light with a soft shadow map, a fill light, sky and bounce light, and a glowing orb.

use crate::mesh::Mesh;
use crate::vector::{V3, smooth_step, v3};

/// Towards the key light (not normalised).
const KEY_DIRECTION: V3 = v3(-0.42, 1.0, 0.55);
const KEY_COLOR: V3 = v3(0.96, 0.88, 0.75);
const FILL_DIRECTION: V3 = v3(0.8, 0.35, 0.5);
const FILL_COLOR: V3 = v3(0.14, 0.16, 0.20);
const SKY_COLOR: V3 = v3(0.42, 0.45, 0.50);
const GROUND_COLOR: V3 = v3(0.30, 0.26, 0.21);
const GLOW_COLOR: V3 = v3(0.10, 0.55, 0.60);
/// The orb's light falls off as 1 / (1 + (distance / this)²)².
const GLOW_REACH: f64 = 0.9;
/// What glossy surfaces mirror above and below the horizon, and how much brighter than its light the key light's source is.
const MIRRORED_SKY: V3 = v3(0.62, 0.72, 0.86);
const MIRRORED_GROUND: V3 = v3(0.16, 0.14, 0.12);
const HIGHLIGHT: f64 = 12.0;
/// Texels of the shadow map in each direction.
const SHADOW_SIZE: usize = 640;
/// Half the side of the square the shadow map covers, scene units.
const SHADOW_REACH: f64 = 5.0;
/// Half the width of the shadow filter, texels: the penumbra is about 0.1 units wide.
const SHADOW_SOFTNESS: i64 = 3;
/// Shift along the normal that keeps surfaces from shadowing themselves, scene units.
const SHADOW_OFFSET: f64 = 0.035;

/// The light of one time.
pub(crate) struct Light {
    key: V3,
    fill: V3,
    right: V3,
    up: V3,
    /// Height towards the light of the topmost surface per texel.
    heights: Vec<f32>,
    glow: Option<V3>,
}

impl Light {
    /// Renders the shadow map of `casters`; `glow` is the orb's centre while it exists.
    pub(crate) fn new(casters: &Mesh, glow: Option<V3>) -> Light {
        let key = KEY_DIRECTION.unit();
        let right = v3(0.0, 1.0, 0.0).cross(key).unit();
        let up = key.cross(right);
        let mut light = Light {
            key,
            fill: FILL_DIRECTION.unit(),
            right,
            up,
            heights: vec![f32::NEG_INFINITY; SHADOW_SIZE * SHADOW_SIZE],
            glow,
        };
        let points: Vec<V3> = casters.positions.iter().map(|p| light.map_point(*p)).collect();
        for triangle in &casters.triangles {
            light.draw(triangle.vertices.map(|v| points[v as usize]));
        }
        light
    }

    /// Map column, row (texels) and height of a world point.
    fn map_point(&self, p: V3) -> V3 {
        let scale = SHADOW_SIZE as f64 / (2.0 * SHADOW_REACH);
        v3((p.dot(self.right) + SHADOW_REACH) * scale, (p.dot(self.up) + SHADOW_REACH) * scale, p.dot(self.key))
    }

    fn draw(&mut self, [a, b, c]: [V3; 3]) {
        let area = (b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y);
        if area == 0.0 {
            return;
        }
        let limit = SHADOW_SIZE as f64;
        let low = |x: f64, y: f64, z: f64| (x.min(y).min(z) - 0.5).clamp(0.0, limit) as usize;
        let high = |x: f64, y: f64, z: f64| (x.max(y).max(z) + 0.5).clamp(0.0, limit) as usize;
        for row in low(a.y, b.y, c.y)..high(a.y, b.y, c.y) {
            for column in low(a.x, b.x, c.x)..high(a.x, b.x, c.x) {
                let (x, y) = (column as f64 + 0.5, row as f64 + 0.5);
                let wb = ((x - a.x) * (c.y - a.y) - (c.x - a.x) * (y - a.y)) / area;
                let wc = ((b.x - a.x) * (y - a.y) - (x - a.x) * (b.y - a.y)) / area;
                if wb >= 0.0 && wc >= 0.0 && wb + wc <= 1.0 {
                    let height = (a.z + (b.z - a.z) * wb + (c.z - a.z) * wc) as f32;
                    let texel = &mut self.heights[row * SHADOW_SIZE + column];
                    *texel = texel.max(height);
                }
            }
        }
    }

    /// Fraction of the key light that reaches a point: a box of binary tests, weighted bilinearly at its rim.
    fn lit(&self, point: V3, normal: V3) -> f64 {
        let p = self.map_point(point + normal * SHADOW_OFFSET);
        let (x, y) = (p.x - 0.5, p.y - 0.5);
        let (x0, y0) = (x.floor() as i64, y.floor() as i64);
        let n = SHADOW_SOFTNESS;
        let size = SHADOW_SIZE as i64;
        if x0 - n < 0 || y0 - n < 0 || x0 + n + 1 >= size || y0 + n + 1 >= size {
            return 1.0;
        }
        let (fx, fy) = (x - x0 as f64, y - y0 as f64);
        let rim = |i: i64, f: f64| {
            if i == -n {
                1.0 - f
            } else if i == n + 1 {
                f
            } else {
                1.0
            }
        };
        let height = p.z as f32;
        let mut sum = 0.0;
        for j in -n..=n + 1 {
            let row = &self.heights[((y0 + j) * size + x0 - n) as usize..];
            let line: f64 = (0..2 * n + 2).filter(|i| row[*i as usize] <= height).map(|i| rim(i - n, fx)).sum();
            sum += line * rim(j, fy);
        }
        sum / ((2 * n + 1) * (2 * n + 1)) as f64
    }

    /// What a glossy surface adds: the mirrored sky and ground, and the key light's highlight. `view`: unit, towards the
    /// camera; `gloss`: the share mirrored head-on (Schlick 1994).
    pub(crate) fn mirrored(&self, point: V3, normal: V3, view: V3, gloss: f64) -> V3 {
        let facing = normal.dot(view).max(0.0);
        let away = 1.0 - facing;
        let share = gloss + (1.0 - gloss) * away * away * away * away * away;
        let mirrored = normal * (2.0 * normal.dot(view)) - view;
        let sky = MIRRORED_GROUND.lerp(MIRRORED_SKY, smooth_step(-0.15, 0.15, mirrored.y));
        // cos³² of the angle to the light's mirror image.
        let mut highlight = mirrored.dot(self.key).max(0.0);
        (0..5).for_each(|_| highlight *= highlight);
        let lit = if highlight > 1e-4 && normal.dot(self.key) > 0.0 { self.lit(point, normal) } else { 0.0 };
        sky * share + KEY_COLOR * (HIGHLIGHT * share * highlight * lit)
    }

    /// Light that arrives at a matt surface with unit `normal`; `open` in `[0,1]` is how much of the sky it sees.
    pub(crate) fn arriving(&self, point: V3, normal: V3, open: f64) -> V3 {
        let sky = SKY_COLOR * (0.5 + 0.5 * normal.y) + GROUND_COLOR * (0.5 - 0.5 * normal.y);
        let mut sum = sky * open + FILL_COLOR * normal.dot(self.fill).max(0.0);
        let facing = normal.dot(self.key);
        if facing > 0.0 {
            sum = sum + KEY_COLOR * (facing * self.lit(point, normal));
        }
        if let Some(orb) = self.glow {
            let to = orb - point;
            let distance = to.length();
            let fall = 1.0 / (1.0 + (distance / GLOW_REACH) * (distance / GLOW_REACH));
            let wrap = (0.3 + 0.7 * normal.dot(to) / distance).max(0.0);
            sum = sum + GLOW_COLOR * (fall * fall * wrap);
        }
        sum
    }
}
