//! A page as a layer of a scene, so that everything that renders scenes renders playback files; and such a layer as a
//! page.

use super::block::{Columns, NO_WIDTH, SHARPEST, Words, encode_page};
use super::index::broken;
use super::page::{self, Header, at, half_width, lives_through, reach};
use super::page::{FOR_EVER as FULL_LIFE, FULL8, FULL10, HALF10, LEVELS8, LEVELS16, MAX_LOG, THINNEST, WIDTH_LEVELS};
use super::{BLOCK_GAUSSIANS, Depths, Entry, Kind, MAX_PAGE_GAUSSIANS, Node, PAGE_WORDS, Page, Palette};
use crate::Result;
use crate::format::quant;
use crate::layers::Layer;
use crate::math::{self, Real, quat, sh};
use crate::motion::{Polynomial, Spacetime, SpacetimeSpec};
use crate::scene::life::{CENTER, LOG_SOFTNESS, LOG_WIDTH};
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::table::TableMut;
use crate::scene::{BLOCK, GEOMETRY, Key, LIFE, LifeKind, Params, SH, Table};
use crate::simd::{Kernel, Simd, dispatch, each, greatest};
use std::f64::consts::FRAC_1_SQRT_2;
use std::ops::Range;
use std::sync::{Arc, LazyLock};

/// Half-width of Gaussians that have infinite lifespans, seconds: thirty years, in whose middle f32 is exact.
const FOR_EVER: f64 = 1e9;
/// Half-width zero as a logarithm can express it, seconds: far less than a frame.
const INSTANT: f64 = 1e-9;
/// A half-width in a layer counts as one of those two within this factor: an f32 logarithm is not exact.
const ABOUT: f64 = 1.001;
/// Opacities 0 and 255 are this far from 0 and 1, where logits are infinite: invisible, and above the renderer's
/// ceiling.
const OPACITY_MARGIN: f64 = 1e-4;
/// Largest velocity and rate that a layer holds: far beyond any scene, and finite in f32 when times are multiplied.
const FASTEST: f64 = 1e15;

/// Constants common to all Gaussians of a page's layer.
struct Constants {
    /// By code of the opacity: its logit.
    logits: [f32; 1 << FULL8],
    /// Logarithms of the half-widths zero and infinity.
    instant: f64,
    for_ever: f64,
    /// Logarithms of what the encoder compares with.
    no_width: f64,
    sharpest: f64,
    thinnest: f64,
    about: f64,
}

#[inline(always)]
fn constants() -> &'static Constants {
    static CONSTANTS: LazyLock<Constants> = LazyLock::new(|| {
        let logit = |code: usize| math::logit(code as f64 / f64::from(LEVELS8), OPACITY_MARGIN) as f32;
        Constants {
            logits: std::array::from_fn(logit),
            instant: INSTANT.ln(),
            for_ever: FOR_EVER.ln(),
            no_width: NO_WIDTH.ln(),
            sharpest: SHARPEST.ln(),
            thinnest: THINNEST.ln(),
            about: ABOUT.ln(),
        }
    });
    &CONSTANTS
}

/// Tables of a page's layer, in the order in which [`keys`] names them.
pub(super) const TABLES: usize = 5;

/// Geometry, colours, lifespans, velocities, rotation rates. Panics: the layer is none that a page gives.
pub(super) fn keys(layer: &Layer<f32>) -> [Key; TABLES] {
    let found = page_keys(layer);
    found.unwrap_or_else(|| panic!("only a layer that moves and lives as those of a page can be one: {layer:?}"))
}

/// Whether a page could hold the layer exactly: its Gaussians are already primitives.
pub(crate) fn is_page(layer: &Layer<f32>) -> bool {
    page_keys(layer).is_some() && layer.span.iter().all(|t| t.is_finite())
}

fn page_keys(layer: &Layer<f32>) -> Option<[Key; TABLES]> {
    match layer.motion.polynomial() {
        Some(Polynomial { order: 1, velocities: Some(v), rotation_rates: Some(w), .. })
            if layer.life == LifeKind::Interval && layer.frame.is_identity() =>
        {
            Some([GEOMETRY, SH, LIFE, v, w])
        }
        _ => None,
    }
}

impl Page {
    /// The page as a layer that is visible during its span; coefficients come from its palette, where it has one.
    ///
    /// Errors: a Gaussian's label is not in the palette. Panics: the page has a palette and none is given.
    pub(crate) fn layer(&self, palette: Option<&Palette>) -> Result<Layer<f32>> {
        let palette = palette.filter(|_| self.palette.is_some());
        assert!(palette.is_some() || self.palette.is_none(), "a page with a palette needs it");
        let labels = self.labels();
        let wrong = |p: &Palette| labels.iter().position(|l| usize::from(*l) >= p.entries);
        if let Some((i, p)) = palette.and_then(|p| Some((wrong(p)?, p))) {
            return Err(broken(format!("Gaussian {i} has entry {} of a palette of {}", labels[i], p.entries)));
        }
        let life = LifeKind::Interval;
        let mut params = Params::new(self.len(), palette.map_or(1, |p| sh::coeffs(p.degree)), life.columns());
        let spec = SpacetimeSpec {
            order: 1,
            rotation: true,
            detach: false,
            origin: 0.5 * (self.span[0] + self.span[1]),
            features: None,
        };
        let motion = Spacetime::new(spec, &mut params)?;
        let keys = [GEOMETRY, SH, LIFE, motion.velocities(), motion.rates()];
        let mut tables = params.get_mut(keys).map(Table::view_mut);
        for (k, (header, words)) in self.headers.iter().zip(self.words.chunks(BLOCK_GAUSSIANS)).enumerate() {
            let first = k * BLOCK_GAUSSIANS;
            let labels = &labels[first..first + words.len()];
            let mut columns = [[0; BLOCK_GAUSSIANS]; PAGE_WORDS];
            for (i, row) in words.iter().enumerate() {
                (0..PAGE_WORDS).for_each(|k| columns[k][i] = row[k]);
            }
            let rows = first..first + words.len();
            let decode = Decode { header, words: &columns, span: self.span, rows, tables: &mut tables };
            dispatch(Simd::detect(), decode);
            paint(labels, palette, first, &mut tables[1]);
        }
        Ok(Layer { span: self.span, ..Layer::new("page", params, Arc::new(motion), life) })
    }

    /// Entries of the palette, a Gaussian each.
    pub(super) fn labels(&self) -> Vec<u16> {
        self.words.iter().map(|w| w[7] as u16).collect()
    }
}

/// Decodes a block into rows of the tables of its layer; all but what the palette gives.
struct Decode<'a, 'b> {
    header: &'a Header,
    words: &'a Words,
    span: [f64; 2],
    rows: Range<usize>,
    tables: &'a mut [TableMut<'b, f32>; TABLES],
}

impl Kernel for Decode<'_, '_> {
    type Out = ();

    #[inline(always)]
    fn run<const FMA: bool>(self) {
        decode(self.header, self.words, self.span, self.rows, self.tables);
    }
}

/// A number of sixteen rows.
type Lane = [f64; BLOCK];

/// Writes sixteen numbers of a column, or as many as there are rows. `row` is the first of a block of the table.
#[inline(always)]
fn store(view: &mut TableMut<'_, f32>, row: usize, col: usize, count: usize, values: Lane) {
    let first = ((row - view.first) / BLOCK * view.width + col) * BLOCK;
    let values: [f32; BLOCK] = each(|l| values[l] as f32);
    if count >= BLOCK {
        view.data[first..first + BLOCK].copy_from_slice(&values);
    } else {
        view.data[first..first + count].copy_from_slice(&values[..count]);
    }
}

/// See [`Decode`]. The numbers are those of [`Page::record`], sixteen Gaussians at a time, with logarithms where the
/// layer has logarithms.
#[inline(always)]
pub(super) fn decode(
    header: &Header,
    words: &Words,
    span: [f64; 2],
    rows: Range<usize>,
    [geometry, colors, lives, velocities, rates]: &mut [TableMut<'_, f32>; TABLES],
) {
    let constants = constants();
    let range = |at: usize, step: usize| (f64::from(header[at]), f64::from(header[at + step]));
    let most = |at: usize| f64::from(header[at]);
    for row in rows.clone().step_by(BLOCK) {
        let (at, count) = (row - rows.start, rows.end - row);
        let word: [[u32; BLOCK]; PAGE_WORDS] = each(|k| each(|l| words[k][at + l]));
        let eight = |word: &[u32; BLOCK], first: u32, (low, high): (f64, f64)| -> Lane {
            each(|l| quant::linear(word[l] >> first & LEVELS8, low, high, LEVELS8))
        };
        let sixteen = |word: &[u32; BLOCK], first: u32, (low, high): (f64, f64)| -> Lane {
            each(|l| quant::linear(word[l] >> first & LEVELS16, low, high, LEVELS16))
        };
        let ten = |word: &[u32; BLOCK], first: u32, most: f64| -> Lane {
            each(|l| quant::signed(word[l] >> first & TEN, most, HALF10))
        };
        store(geometry, row, 0, count, sixteen(&word[0], 0, range(at::BOX, 3)));
        store(geometry, row, 1, count, sixteen(&word[0], 16, range(at::BOX + 1, 3)));
        store(geometry, row, 2, count, sixteen(&word[1], 0, range(at::BOX + 2, 3)));
        for k in 0..3 {
            store(geometry, row, LOG_SCALE + k, count, eight(&word[2], 8 * k as u32, range(at::SCALE, 1)));
            let color = eight(&word[6], 8 * k as u32, range(at::COLOR + k, 3));
            store(colors, row, k, count, each(|l| sh::rgb_to_dc(color[l])));
        }
        let logits = each(|l| f64::from(constants.logits[(word[2][l] >> 24) as usize]));
        store(geometry, row, OPACITY, count, logits);

        // The lifespan, and the reach that follows from it.
        store(lives, row, CENTER, count, sixteen(&word[1], 16, range(at::CENTER, 1)));
        let log_softness = eight(&word[7], 16, range(at::SOFTNESS, 1));
        store(lives, row, LOG_SOFTNESS, count, log_softness);
        let (narrow, wide) = range(at::WIDTH, 1);
        let (mut log_width, mut along) = ([0.0; BLOCK], [0.0; BLOCK]);
        for l in 0..BLOCK.min(count) {
            let code = word[6][l] >> 24;
            let life = match code {
                FULL_LIFE => None,
                _ => Some([half_width(code, narrow, wide), log_softness[l].exp()]),
            };
            along[l] = reach(life, span);
            log_width[l] = match code {
                0 => constants.instant,
                FULL_LIFE => constants.for_ever,
                _ => {
                    let log = quant::linear(code - 1, narrow, wide, WIDTH_LEVELS);
                    log.clamp(constants.instant, constants.for_ever)
                }
            };
        }
        store(lives, row, LOG_WIDTH, count, log_width);

        let component = |first: u32| ten(&word[3], first, FRAC_1_SQRT_2);
        let (a, b, c) = (component(20), component(10), component(0));
        let motion = |word: &[u32; BLOCK], first: u32, at: usize| -> Lane {
            let distance = ten(word, first, most(at));
            each(|l| slow(distance[l] / along[l]))
        };
        let turn: [Lane; 3] = each(|k| motion(&word[5], 10 * k as u32, at::TURN));
        let (mut quat, mut rate) = ([[0.0; BLOCK]; 4], [[0.0; BLOCK]; 4]);
        for l in 0..BLOCK {
            let q = quant::quat_of(word[3][l] >> 30, a[l], b[l], c[l]);
            let r = page::rate(q, [turn[0][l], turn[1][l], turn[2][l]]);
            for k in 0..4 {
                (quat[k][l], rate[k][l]) = (q[k], r[k]);
            }
        }
        for k in 0..3 {
            store(velocities, row, k, count, motion(&word[4], 10 * k as u32, at::SHIFT));
        }
        for k in 0..4 {
            store(geometry, row, QUAT + k, count, quat[k]);
            store(rates, row, k, count, rate[k]);
        }
    }
}

/// Ten bits.
const TEN: u32 = (1 << FULL10) - 1;

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
    let tables = [geometry, colors, lives, velocities, rates];
    for at in (0..rows).step_by(BLOCK) {
        // Numbers behind the last row are read as well, and not examined again.
        let [geometry, colors, lives, velocities, rates]: [&[f32]; TABLES] =
            [0, 1, 2, 3, 4].map(|k| tables[k].block((first + at) / BLOCK));
        let lane = |block: &[f32], col: usize| -> Lane {
            let values = &block[col * BLOCK..(col + 1) * BLOCK];
            each(|l| f64::from(values[l]))
        };
        let raw: [Lane; 4] = each(|k| lane(geometry, QUAT + k));
        let rate: [Lane; 4] = each(|k| lane(rates, k));
        let scales: [Lane; 3] = each(|k| lane(geometry, LOG_SCALE + k));
        for l in 0..BLOCK {
            let (q, norm) = quat::normalize([raw[0][l], raw[1][l], raw[2][l], raw[3][l]]);
            // The layer turns a quaternion of any length, the file one of length 1.
            let inverse = if norm > 0.0 { 1.0 / norm } else { 0.0 };
            let turn = angular(q, [rate[0][l], rate[1][l], rate[2][l], rate[3][l]]);
            let thin = greatest(scales[0][l], greatest(scales[1][l], scales[2][l])) + constants.thinnest;
            for k in 0..4 {
                c.quat[k][at + l] = q[k];
            }
            for k in 0..3 {
                c.turn[k][at + l] = turn[k] * inverse;
                c.log_scales[k][at + l] = greatest(scales[k][l], thin).clamp(-MAX_LOG, MAX_LOG);
            }
        }
        for k in 0..3 {
            c.mean[k][at..at + BLOCK].copy_from_slice(&lane(geometry, k));
            c.velocity[k][at..at + BLOCK].copy_from_slice(&lane(velocities, k));
            let dc = lane(colors, k);
            let color: Lane = each(|l| sh::dc_to_rgb(dc[l]));
            c.color[k][at..at + BLOCK].copy_from_slice(&color);
        }
        let (centers, widths, softness) = (lane(lives, CENTER), lane(lives, LOG_WIDTH), lane(lives, LOG_SOFTNESS));
        let logits = lane(geometry, OPACITY);
        for l in 0..BLOCK.min(rows - at) {
            c.opacity[at + l] = logits[l].sigmoid();
            let softness = greatest(softness[l], constants.sharpest).clamp(-MAX_LOG, MAX_LOG);
            c.center[at + l] = centers[l];
            c.log_softness[at + l] = softness;
            let width = widths[l];
            let always =
                width >= constants.for_ever - constants.about || lives_through(centers[l], width.exp(), layer.span);
            c.log_width[at + l] = if always {
                f64::INFINITY
            } else if width < softness + constants.no_width || width <= constants.instant + constants.about {
                f64::NEG_INFINITY
            } else {
                width.clamp(-MAX_LOG, MAX_LOG)
            };
        }
    }
    c.label[..labels.len()].copy_from_slice(labels);
    c
}

/// The angular velocity about the world's axes of a unit quaternion that changes at `rate`: twice the vector part of
/// rate⊗q*. What is along q changes no rotation.
#[inline(always)]
fn angular([w, x, y, z]: [f64; 4], [a, b, c, d]: [f64; 4]) -> [f64; 3] {
    [
        2.0 * (b * w - a * x - c * z + d * y),
        2.0 * (c * w - a * y + b * z - d * x),
        2.0 * (d * w - a * z - b * y + c * x),
    ]
}

/// The Gaussians of a page's layer as primitives: the inverse of [`Page::layer`], in the layer's order. Importance is
/// 1.
///
/// Panics: the layer's motion or lifespan is not that of a page.
pub(crate) fn primitives(layer: &Layer<f32>) -> Vec<super::Primitive> {
    let [.., velocities, rates] = keys(layer);
    let p = &layer.params;
    let coefficients = p[SH].width();
    let (labels, features) = (super::labels_of(p), super::features_of(p));
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
        super::Primitive {
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
            label: labels[row],
            features: features[row].clone(),
        }
    };
    (0..p.len()).map(one).collect()
}

/// Nodes as layers in their base colours, as the default depths hold them, and of each layer its node and the position
/// of its first row in that.
pub(crate) fn as_layers(nodes: &[Node]) -> (Vec<Layer<f32>>, Vec<(usize, usize)>) {
    let (mut layers, mut places) = (Vec::new(), Vec::new());
    for (i, node) in nodes.iter().enumerate() {
        let span = [node.from, node.to];
        for (k, part) in node.primitives.chunks(MAX_PAGE_GAUSSIANS).enumerate() {
            let rows: Vec<_> = part.iter().map(|p| (p, 0)).collect();
            let body = encode_page(&rows, span, &Depths::default());
            let entry = Entry { count: part.len() as u32, span, ..Entry::plain(Kind::Page, &[]) };
            let page = page::parse_page(&body, &entry).expect("a page that was just encoded");
            layers.push(page.layer(None).expect("a page without a palette"));
            places.push((i, k * MAX_PAGE_GAUSSIANS));
        }
    }
    (layers, places)
}
