//! Materials of the yard: colours, gloss, and the relief of its drum, all generated.

use crate::texture::srgb;
use crate::vector::{V3, hash01, sin_cos, smooth_step, v3};
use std::f64::consts::{PI, TAU};

/// Materials of this set; those of the hall are below.
pub(crate) const BRICK: u16 = 10;
/// Paving; uv = world (x, z).
pub(crate) const COBBLES: u16 = 11;
/// Rough plaster; uv = (along, height).
pub(crate) const PLASTER: u16 = 12;
/// The drum's iron; uv = (turn, height).
pub(crate) const IRON: u16 = 13;
/// The glazed jar; uv = (turn, height).
pub(crate) const GLAZE: u16 = 14;
/// Painted rails and bars.
pub(crate) const RAIL: u16 = 15;
/// Far land; uv = world (x, z).
pub(crate) const LAND: u16 = 16;
/// The sky, which emits; uv = (turn, polar angle / π).
pub(crate) const SKY: u16 = 17;

/// Where the drum is, its radius and height, scene units.
pub(crate) const DRUM: V3 = v3(-2.0, 0.0, 2.1);
pub(crate) const DRUM_RADIUS: f64 = 0.5;
pub(crate) const DRUM_HEIGHT: f64 = 1.15;
/// Rivets in a ring, and the rings' heights in shares of the drum's.
const RIVETS: f64 = 28.0;
const RINGS: [f64; 4] = [0.06, 0.30, 0.70, 0.94];
/// Rivets' radius and height; depth of the ornament between the rings, scene units.
const RIVET: [f64; 2] = [0.022, 0.016];
const ORNAMENT: f64 = 0.014;
/// Distance of the farthest land, scene units.
pub(crate) const LAND_TO: f64 = 260.0;

/// Height of the drum's surface: hoops with rivets at [`RINGS`], waves of scales between them; `h` in [0, 1].
pub(crate) fn relief(turn: f64, h: f64) -> f64 {
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

/// Smoothly interpolated random numbers of a lattice, `octaves` of them, each of half the size and weight; about 0 to 1.
pub(crate) fn noise([x, y]: [f64; 2], octaves: u32, purpose: i64) -> f64 {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_between_0_and_1_and_continuous() {
        let values: Vec<f64> = (0..2000).map(|i| noise([0.013 * f64::from(i) - 9.0, 0.7], 4, 5)).collect();
        assert!(values.iter().all(|v| (0.0..=1.0).contains(v)));
        assert!(values.windows(2).all(|p| (p[0] - p[1]).abs() < 0.15));
    }
}
