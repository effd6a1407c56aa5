//! Surface colours: the characters' textures and procedural patterns with soft edges, without noise.
//!
//! Edges are at least 0.02 units wide, about a pixel at the cameras' distance, so that 3x3 samples suffice. There are
//! few edges on purpose: they are what costs file size, and what a quick training spends its Gaussians on.

use crate::texture::{Texture, srgb};
use crate::vector::{V3, smooth_step};
use crate::yard_materials;

/// The knight's texture.
pub(crate) const KNIGHT: u16 = 0;
/// The mage's texture.
pub(crate) const MAGE: u16 = 1;
/// Tiles and a round carpet; uv = world (x, z).
pub(crate) const FLOOR: u16 = 2;
/// Stone base, plaster and banners; uv = (along, height).
pub(crate) const WALL: u16 = 3;
/// Stone drums; uv = (turn, height).
pub(crate) const COLUMN: u16 = 4;
/// Wooden crate; uv in `[0,1]`² per face.
pub(crate) const CRATE: u16 = 5;
/// Painted crate, as above.
pub(crate) const PAINTED_CRATE: u16 = 6;
/// Barrel; uv = (turn, height).
pub(crate) const BARREL: u16 = 7;
/// The glowing orb; uv = (turn, polar).
pub(crate) const ORB: u16 = 8;
/// Striped ball; uv = (turn, polar).
pub(crate) const BALL: u16 = 9;

/// Side of a floor tile, scene units.
const TILE: f64 = 2.2;
/// Distance between banners, scene units.
pub(crate) const BAY: f64 = 4.0;
/// Height of the stone base of the walls, scene units.
const BASE: f64 = 0.85;

/// Linear colour of `material` at `uv`.
pub(crate) fn albedo(material: u16, uv: [f64; 2], textures: [&Texture; 2]) -> V3 {
    match material {
        KNIGHT | MAGE => textures[material as usize].sample(uv),
        FLOOR => floor(uv[0], uv[1]),
        WALL => wall(uv[0], uv[1]),
        COLUMN => column(uv[1]),
        CRATE => crate_face(uv, srgb(176, 126, 80), srgb(142, 98, 60)),
        PAINTED_CRATE => crate_face(uv, srgb(206, 74, 58), srgb(238, 196, 96)),
        BARREL => barrel(uv[1]),
        BALL => ball(uv[0], uv[1]),
        ORB => orb(uv[1]),
        _ => yard_materials::albedo(material, uv),
    }
}

/// Emitted light of a material.
pub(crate) fn glow(material: u16, uv: [f64; 2]) -> V3 {
    if material == ORB { srgb(70, 190, 200) } else { yard_materials::glow(material, uv) }
}

/// 1 inside [from, to], with soft ends.
fn band(x: f64, from: f64, to: f64) -> f64 {
    smooth_step(from - 0.01, from + 0.01, x) * (1.0 - smooth_step(to - 0.01, to + 0.01, x))
}

fn floor(x: f64, z: f64) -> V3 {
    // The product of two square waves with soft flanks is a chequerboard.
    let wave = |x: f64| {
        let phase = x / (2.0 * TILE) - (x / (2.0 * TILE)).floor();
        let from_flank = (0.25 - (phase - 0.5).abs()) * 2.0 * TILE;
        2.0 * smooth_step(-0.015, 0.015, from_flank) - 1.0
    };
    let tiles = srgb(196, 176, 148).lerp(srgb(216, 200, 172), 0.5 + 0.5 * wave(x) * wave(z));
    let r = (x * x + z * z).sqrt();
    let carpet = srgb(62, 110, 128).lerp(srgb(92, 146, 156), 1.0 - smooth_step(0.0, 2.0, r));
    let carpet = carpet.lerp(srgb(226, 190, 112), band(r, 1.98, 2.16));
    tiles.lerp(carpet, 1.0 - smooth_step(2.28, 2.31, r))
}

fn wall(u: f64, h: f64) -> V3 {
    let plaster = srgb(166, 180, 180).lerp(srgb(196, 204, 198), smooth_step(BASE, 5.0, h));
    let color = srgb(146, 138, 132).lerp(plaster, smooth_step(BASE - 0.015, BASE + 0.015, h));
    // One banner in the middle of each bay, with a pointed end and an emblem.
    let bay = (u / BAY).floor();
    let across = u - (bay + 0.5) * BAY;
    let lower = 1.9 + 0.5 * (1.0 - across.abs() / 0.7);
    let cloth = match (bay as i64).rem_euclid(3) {
        0 => srgb(172, 58, 54),
        1 => srgb(54, 84, 150),
        _ => srgb(66, 126, 84),
    };
    let disc = (across * across + (h - 2.95) * (h - 2.95)).sqrt();
    let banner = cloth.lerp(srgb(228, 192, 112), 1.0 - smooth_step(0.29, 0.32, disc));
    color.lerp(banner, band(across, -0.7, 0.7) * band(h, 4.0 - lower, 4.0))
}

fn column(h: f64) -> V3 {
    srgb(176, 168, 158).lerp(srgb(204, 198, 188), smooth_step(0.3, 4.0, h))
}

fn crate_face(uv: [f64; 2], plank: V3, frame: V3) -> V3 {
    let [u, v] = uv;
    let edge = u.min(1.0 - u).min(v).min(1.0 - v);
    plank.lerp(frame, 1.0 - smooth_step(0.15, 0.18, edge))
}

fn barrel(h: f64) -> V3 {
    srgb(172, 118, 74).lerp(srgb(92, 92, 98), band(h, 0.18, 0.32).max(band(h, 0.68, 0.82)))
}

fn ball(turn: f64, polar: f64) -> V3 {
    let sector = (turn * 6.0).floor() as i64;
    let cloth = [srgb(240, 236, 224), srgb(226, 92, 60), srgb(250, 204, 84)][sector.rem_euclid(3) as usize];
    let cap = 1.0 - smooth_step(0.11, 0.13, polar.min(1.0 - polar));
    cloth.lerp(srgb(60, 96, 168), cap)
}

fn orb(polar: f64) -> V3 {
    srgb(60, 150, 180).lerp(srgb(180, 240, 235), band(polar, 0.42, 0.58))
}
