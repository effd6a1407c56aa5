//! A page as a layer of a scene, so that everything that draws scenes draws playback files; and such a layer as a page.

use super::block::{Columns, Header, NO_WIDTH, SHARPEST};
use super::index::broken;
use super::page::{Coded, FULL8, LEVELS8, MAX_LOG, THINNEST, lives_through, rate};
use super::{BLOCK_GAUSSIANS, PAGE_WORDS, Page, Palette, Primitive};
use crate::Result;
use crate::layers::Layer;
use crate::math::{Real, quat, sh};
use crate::motion::spacetime::{ROTATION_RATES, VELOCITIES};
use crate::motion::{Spacetime, SpacetimeSpec, Spec};
use crate::scene::life::{CENTER, LOG_SOFTNESS, LOG_WIDTH};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::table::TableMut;
use crate::scene::{GEOMETRY, Key, LIFE, LifeKind, Params, SH, Table};
use crate::simd::{Kernel, Simd, dispatch, greatest};
use std::sync::{Arc, LazyLock};

/// Half-width of Gaussians that live for ever, seconds: thirty years, in whose middle f32 is exact.
const FOR_EVER: f64 = 1e9;
/// Half-width zero as a logarithm can say it, seconds: less than any frame notices.
const INSTANT: f64 = 1e-9;
/// A half-width in a layer counts as one of those two within this factor: an f32 logarithm is not exact.
const ABOUT: f64 = 1.001;
/// Opacities 0 and 255 are this far from 0 and 1, where logits are infinite: invisible, and above the renderer's ceiling.
const OPACITY_MARGIN: f64 = 1e-4;
/// Largest velocity and rate that a layer holds: far beyond any scene, and finite in f32 when times are multiplied.
const FASTEST: f64 = 1e15;

/// What every Gaussian of a page's layer shares.
struct Constants {
    /// By code of the opacity: its logit.
    logits: [f32; 1 << FULL8],
    /// Logarithms of the half-widths zero and for ever.
    instant: f64,
    for_ever: f64,
    /// Logarithms of what the encoder compares with.
    no_width: f64,
    sharpest: f64,
    thinnest: f64,
}

#[inline(always)]
fn constants() -> &'static Constants {
    static CONSTANTS: LazyLock<Constants> = LazyLock::new(|| {
        let logit = |code: usize| {
            let o = (code as f64 / f64::from(LEVELS8)).clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
            (o / (1.0 - o)).ln() as f32
        };
        Constants {
            logits: std::array::from_fn(logit),
            instant: INSTANT.ln(),
            for_ever: FOR_EVER.ln(),
            no_width: NO_WIDTH.ln(),
            sharpest: SHARPEST.ln(),
            thinnest: THINNEST.ln(),
        }
    });
    &CONSTANTS
}

/// Tables of a page's layer, in the order in which [`keys`] names them.
pub(super) const TABLES: usize = 5;

/// Geometry, colours, lives, velocities, rotation rates. Panics: the layer is none that a page gives.
pub(super) fn keys(layer: &Layer<f32>) -> [Key; TABLES] {
    let find = |name| layer.params.find(name);
    let moves = matches!(layer.motion.spec(), Spec::Spacetime(SpacetimeSpec { order: 1, rotation: true, .. }));
    match (find(VELOCITIES), find(ROTATION_RATES)) {
        (Some(v), Some(w)) if moves && layer.life == LifeKind::Interval => [GEOMETRY, SH, LIFE, v, w],
        _ => panic!("only a layer that moves and lives as those of a page can be one: {layer:?}"),
    }
}

impl Page {
    /// The page as a layer that is seen during its span; coefficients come from its palette, where it has one.
    ///
    /// Errors: a Gaussian's label is not in the palette. Panics: the page has a palette and none is given.
    pub fn layer(&self, palette: Option<&Palette>) -> Result<Layer<f32>> {
        let palette = palette.filter(|_| self.palette.is_some());
        assert!(palette.is_some() || self.palette.is_none(), "a page with a palette needs it");
        let labels = self.labels();
        let wrong = |p: &Palette| labels.iter().position(|l| usize::from(*l) >= p.entries);
        if let Some((i, p)) = palette.and_then(|p| Some((wrong(p)?, p))) {
            return Err(broken(format!("Gaussian {i} has entry {} of a palette of {}", labels[i], p.entries)));
        }
        let life = LifeKind::Interval;
        let mut params = Params::new(self.len(), palette.map_or(1, |p| sh::coeffs(p.degree)), life.columns());
        let spec =
            SpacetimeSpec { order: 1, rotation: true, detach: false, origin: 0.5 * (self.span[0] + self.span[1]) };
        let motion = Spacetime::new(spec, &mut params)?;
        let keys = [GEOMETRY, SH, LIFE, motion.velocities(), motion.rates()];
        let mut tables = params.get_mut(keys).map(Table::view_mut);
        for (k, (header, words)) in self.headers.iter().zip(self.words.chunks(BLOCK_GAUSSIANS)).enumerate() {
            let first = k * BLOCK_GAUSSIANS;
            let labels = &labels[first..first + words.len()];
            dispatch(Simd::detect(), Decode { header, words, span: self.span, first, tables: &mut tables });
            paint(labels, palette, first, &mut tables[1]);
        }
        Ok(Layer { name: "page".into(), params, motion: Arc::new(motion), life, span: self.span, masks: None })
    }

    /// Entries of the palette, a Gaussian each.
    pub(super) fn labels(&self) -> Vec<u16> {
        self.words.iter().map(|w| w[7] as u16).collect()
    }
}

/// Decodes a block into the tables of its layer, from row `first` on; all but what the palette gives.
struct Decode<'a, 'b> {
    header: &'a Header,
    words: &'a [[u32; PAGE_WORDS]],
    span: [f64; 2],
    first: usize,
    tables: &'a mut [TableMut<'b, f32>; TABLES],
}

impl Kernel for Decode<'_, '_> {
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        decode(self.header, self.words, self.span, self.first, self.tables);
    }
}

/// See [`Decode`].
#[inline(always)]
pub(super) fn decode(
    header: &Header,
    words: &[[u32; PAGE_WORDS]],
    span: [f64; 2],
    first: usize,
    [geometry, colors, lives, velocities, rates]: &mut [TableMut<'_, f32>; TABLES],
) {
    let constants = constants();
    for (i, w) in words.iter().enumerate() {
        let (row, c) = (first + i, Coded::new(header, w, span));
        let [x, y, z] = c.mean;
        geometry.write(row, 0, [x as f32, y as f32, z as f32]);
        let [qw, qx, qy, qz] = c.quat;
        geometry.write(row, QUAT, [qw as f32, qx as f32, qy as f32, qz as f32]);
        let [sx, sy, sz] = c.log_scales;
        geometry.write(row, LOG_SCALE, [sx as f32, sy as f32, sz as f32]);
        geometry.write(row, OPACITY, [constants.logits[c.opacity as usize & 255]]);
        let [r, g, b] = c.base_color;
        colors.write(row, 0, [sh::rgb_to_dc(r) as f32, sh::rgb_to_dc(g) as f32, sh::rgb_to_dc(b) as f32]);
        let width = if c.half_width == 0.0 {
            constants.instant
        } else if c.half_width == f64::INFINITY {
            constants.for_ever
        } else {
            c.log_width.clamp(constants.instant, constants.for_ever)
        };
        lives.write(row, 0, [c.center as f32, width as f32, c.log_softness as f32]);
        let [vx, vy, vz] = c.velocity;
        velocities.write(row, 0, [slow(vx) as f32, slow(vy) as f32, slow(vz) as f32]);
        let [tx, ty, tz] = c.turn;
        let [rw, rx, ry, rz] = rate(c.quat, [slow(tx), slow(ty), slow(tz)]);
        rates.write(row, 0, [rw as f32, rx as f32, ry as f32, rz as f32]);
    }
}

#[inline(always)]
fn slow(x: f64) -> f64 {
    x.clamp(-FASTEST, FASTEST)
}

/// Writes the coefficients above degree 0 of a block's Gaussians, plane by plane: a plane of the palette fits a first
/// cache, the whole palette does not. Panics: a label is not in the palette.
pub(super) fn paint(labels: &[u16], palette: Option<&Palette>, first: usize, colors: &mut TableMut<'_, f32>) {
    let Some(palette) = palette else { return };
    for plane in 0..palette.width() {
        palette.values(plane, labels, |i, value| colors.write(first + i, 3 + plane, [value]));
    }
}

/// Rows `first` to `first + rows` of a page's layer as a block to encode. `labels` are theirs.
#[inline(always)]
pub(super) fn columns(
    layer: &Layer<f32>,
    [_, _, _, velocities, rates]: [Key; TABLES],
    labels: &[u16],
    first: usize,
    rows: usize,
) -> Columns {
    let constants = constants();
    let mut c = Columns::new(rows);
    let (geometry, colors, lives) = (&layer.params[GEOMETRY], &layer.params[SH], &layer.params[LIFE]);
    let (velocities, rates) = (&layer.params[velocities], &layer.params[rates]);
    let about = ABOUT.ln();
    for i in 0..rows {
        let row = first + i;
        let [x, y, z] = geometry.read::<3>(row, 0);
        let [qw, qx, qy, qz] = geometry.read::<4>(row, QUAT);
        let [w0, w1, w2, w3] = rates.read::<4>(row, 0);
        let q = [f64::from(qw), f64::from(qx), f64::from(qy), f64::from(qz)];
        let (q, norm) = quat::normalize(q);
        // The layer turns a quaternion of any length, the file one of length 1.
        let inverse = if norm > 0.0 { 1.0 / norm } else { 0.0 };
        let turn = angular(q, [f64::from(w0), f64::from(w1), f64::from(w2), f64::from(w3)]);
        for k in 0..4 {
            c.quat[k][i] = q[k];
        }
        let (mean, v) = ([x, y, z], velocities.read::<3>(row, 0));
        let [sx, sy, sz] = geometry.read::<3>(row, LOG_SCALE);
        let scales = [f64::from(sx), f64::from(sy), f64::from(sz)];
        let thin = greatest(scales[0], greatest(scales[1], scales[2])) + constants.thinnest;
        let dc = colors.read::<3>(row, 0);
        for k in 0..3 {
            c.mean[k][i] = f64::from(mean[k]);
            c.velocity[k][i] = f64::from(v[k]);
            c.turn[k][i] = turn[k] * inverse;
            c.log_scales[k][i] = greatest(scales[k], thin).clamp(-MAX_LOG, MAX_LOG);
            c.color[k][i] = sh::dc_to_rgb(f64::from(dc[k]));
        }
        c.opacity[i] = f64::from(geometry.get(row, OPACITY)).sigmoid();
        let life = lives.read::<3>(row, 0);
        let (center, log_width) = (f64::from(life[CENTER]), f64::from(life[LOG_WIDTH]));
        let softness = greatest(f64::from(life[LOG_SOFTNESS]), constants.sharpest).clamp(-MAX_LOG, MAX_LOG);
        c.center[i] = center;
        c.log_softness[i] = softness;
        let always = log_width >= constants.for_ever - about || lives_through(center, log_width.exp(), layer.span);
        c.log_width[i] = if always {
            f64::INFINITY
        } else if log_width < softness + constants.no_width || log_width <= constants.instant + about {
            f64::NEG_INFINITY
        } else {
            log_width.clamp(-MAX_LOG, MAX_LOG)
        };
    }
    c.label[..labels.len()].copy_from_slice(labels);
    c
}

/// The angular velocity about the world's axes of a unit quaternion that changes at `rate`: twice the vector part of
/// rate⊗q*. What lies along q changes no rotation.
#[inline(always)]
fn angular([w, x, y, z]: [f64; 4], [a, b, c, d]: [f64; 4]) -> [f64; 3] {
    [
        2.0 * (b * w - a * x - c * z + d * y),
        2.0 * (c * w - a * y + b * z - d * x),
        2.0 * (d * w - a * z - b * y + c * x),
    ]
}

/// The Gaussians of a page's layer as primitives: the inverse of [`Page::layer`], in the layer's order. Importance is 1.
///
/// Panics: the layer moves or lives otherwise than those of a page.
pub fn primitives(layer: &Layer<f32>) -> Vec<Primitive> {
    let [.., velocities, rates] = keys(layer);
    let p = &layer.params;
    let coefficients = p[SH].width();
    let one = |row: usize| {
        let [center, width, softness] = p[LIFE].read::<3>(row, 0).map(f64::from);
        let half_width = match width.exp() {
            w if w >= FOR_EVER / ABOUT => f64::INFINITY,
            w if w <= INSTANT * ABOUT => 0.0,
            w => w,
        };
        let (q, norm) = quat::normalize(p[GEOMETRY].read::<4>(row, QUAT).map(f64::from));
        let turn = angular(q, p[rates].read::<4>(row, 0).map(f64::from));
        let mut sh_rest = [0.0; 45];
        (3..coefficients).for_each(|k| sh_rest[k - 3] = p[SH].get(row, k));
        Primitive {
            mean: p[GEOMETRY].read::<3>(row, 0).map(f64::from),
            center,
            half_width,
            softness: softness.exp(),
            quat: q.map(|x| x as f32),
            scales: p[GEOMETRY].read::<3>(row, LOG_SCALE).map(|s| f64::from(s).exp() as f32),
            opacity: f64::from(p[GEOMETRY].get(row, OPACITY)).sigmoid() as f32,
            velocity: p[velocities].read::<3>(row, 0),
            turn: turn.map(|w| if norm > 0.0 { (w / norm) as f32 } else { 0.0 }),
            base_color: p[SH].read::<3>(row, 0).map(sh::dc_to_rgb),
            sh_rest,
            importance: 1.0,
        }
    };
    (0..p.len()).map(one).collect()
}
