//! The structures of uniforms that the kernels of tables read, filled.

use super::{ResidentBuffers, SH, moments_width};
use crate::render::{Moves, ResidentNoise, ResidentRule, RowWeights};
use crate::scene::{LifeKind, Time};

/// Most columns that Adam takes at once (adam.wgsl).
pub(super) const MOST_COLUMNS: usize = 48;
/// Bits of `Query::flags` (learnt.wgsl).
const FLAG_ROTATION: u32 = 1;
const FLAG_DETACH: u32 = 2;
const FLAG_FIRST: u32 = 4;

/// `struct Query` of learnt.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct Query {
    rows: u32,
    width: u32,
    order: u32,
    flags: u32,
    life: u32,
    life_at: u32,
    velocities_at: u32,
    rates_at: u32,
    t: f32,
    delta: f32,
    alpha_min: f32,
    widest: f32,
    first_splat: u32,
    first_row: u32,
    sh_width: u32,
    blocks: u32,
    poses_at: u32,
    own_at: u32,
    speed: f32,
    floor: f32,
    ceiling: f32,
    pace: f32,
    unused: [u32; 2],
}

impl Query {
    /// At a time; `first`: of a step's first view.
    pub(super) fn new(layer: &ResidentBuffers, at: Time, first: bool, alpha_min: f64, first_splat: usize) -> Self {
        let flag = |on: bool, flag: u32| if on { flag } else { 0 };
        let t = at.0;
        let life = match layer.life {
            LifeKind::Infinite => 0,
            LifeKind::GaussHalf => 1,
            LifeKind::GaussOne => 2,
            LifeKind::Interval => 3,
        };
        let [_, life_at, one, two, _] = std::array::from_fn(|table| layer.first(table)[0] as u32);
        let still = Self {
            rows: layer.rows as u32,
            width: layer.strides()[0] as u32,
            flags: flag(first, FLAG_FIRST),
            life,
            life_at,
            t: t as f32,
            alpha_min: alpha_min as f32,
            widest: (2.0 * -alpha_min.ln()).sqrt() as f32,
            first_splat: first_splat as u32,
            first_row: layer.first_row as u32,
            sh_width: layer.widths[SH] as u32,
            blocks: layer.moves.blocks() as u32,
            ..Self::default()
        };
        match layer.moves {
            Moves::Along { order, rotation, detach, origin } => Self {
                order: order as u32,
                flags: still.flags | flag(rotation, FLAG_ROTATION) | flag(detach, FLAG_DETACH),
                velocities_at: one,
                rates_at: two,
                delta: (t - origin) as f32,
                ..still
            },
            Moves::Posed => Self { poses_at: one, ..still },
            Moves::Sliced { speed, floor, ceiling, harmonics: _, period } => Self {
                own_at: one,
                speed: speed as f32,
                floor: floor as f32,
                ceiling: ceiling as f32,
                pace: (1.0 / period) as f32,
                ..still
            },
        }
    }
}

/// `struct Rule` of adam.wgsl.
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct Rule {
    rows: u32,
    width: u32,
    stride: u32,
    first: u32,
    moments_stride: u32,
    moments_first: u32,
    counted: u32,
    floor_column: u32,
    floor_least: f32,
    first_row: u32,
    word: u32,
    from: u32,
    columns: u32,
    unused: [u32; 3],
    rates: [f32; MOST_COLUMNS],
}

impl Rule {
    /// Of the piece of a table that begins with column `from`.
    pub(super) fn new(
        layer: &ResidentBuffers,
        table: usize,
        from: usize,
        rule: &ResidentRule,
        [counted, word]: [usize; 2],
    ) -> Self {
        let width = layer.widths[table];
        let ([first, moments_first], [stride, moments_stride]) =
            if table == SH { ([0; 2], [width, moments_width(width)]) } else { (layer.first(table), layer.strides()) };
        let (floor_column, floor_least) = rule.floor.unwrap_or((width, 0.0));
        Self {
            rows: layer.rows as u32,
            width: width as u32,
            stride: stride as u32,
            first: first as u32,
            moments_stride: moments_stride as u32,
            moments_first: moments_first as u32,
            counted: counted as u32,
            floor_column: floor_column as u32,
            floor_least: floor_least as f32,
            first_row: layer.first_row as u32,
            word: word as u32,
            from: from as u32,
            columns: (width - from).min(MOST_COLUMNS) as u32,
            unused: [0; 3],
            rates: std::array::from_fn(|c| rule.rates.get(from + c).map_or(0.0, |r| *r as f32)),
        }
    }
}

/// `struct RowRule` of row_losses.wgsl.
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct RowRule {
    weights: [f32; 3],
    count_at: u32,
    sums_at: u32,
    unused: [u32; 3],
}

impl RowRule {
    pub(super) fn new(weights: &RowWeights, [count_at, sums_at]: [usize; 2]) -> Self {
        let weights = [weights.opacity, weights.entropy, weights.scale].map(|w| w as f32);
        Self { weights, count_at: count_at as u32, sums_at: sums_at as u32, unused: [0; 3] }
    }
}

/// `struct Noise` of shake.wgsl.
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct Noise {
    strength: f32,
    dead: f32,
    slope: f32,
    limit: f32,
    key: [u32; 2],
    unused: [u32; 2],
}

impl Noise {
    pub(super) fn new(noise: &ResidentNoise) -> Self {
        let key = noise.rng.key();
        Self {
            strength: noise.strength as f32,
            dead: noise.dead as f32,
            slope: noise.slope as f32,
            limit: noise.limit,
            key: [key as u32, (key >> 32) as u32],
            unused: [0; 2],
        }
    }
}

/// `struct TieRule` of ties.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct TieRule {
    pub points: u32,
    pub background: u32,
    pub neighbours: u32,
    pub back_at: u32,
    pub rows_at: u32,
    pub sums_at: u32,
    pub rigid: f32,
    pub rot: f32,
    pub iso: f32,
    pub floor: f32,
    pub stays: [f32; 2],
    pub up: [f32; 3],
    pub height: f32,
}

/// `struct Rule` of record.wgsl.
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct RecordRule {
    pub tiles: u32,
    pub view: u32,
    pub camera: u32,
    pub cameras: u32,
    pub bad_at: u32,
    pub bad_words: u32,
    pub counted: u32,
    pub rate: f32,
}
