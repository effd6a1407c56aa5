//! Writing: Gaussians in Morton order, 16 bits a coordinate, codebooks and a palette of k-means.

use super::{CODES, LARGEST_W, META, ROW_OF_CENTROIDS, VERSION};
use crate::format::bytes::{byte_of_logit, sound_rows};
use crate::format::playback::cluster::{Clusters, cluster};
use crate::format::quant::{self, MORTON_BITS, morton};
use crate::format::{Warnings, zip};
use crate::math::Rng;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH};
use crate::{Error, Result};
use image_webp::{ColorType, WebPEncoder};
use serde_json::{Value, json};
use std::io::Write;
use std::ops::Range;

/// Sides of images are multiples of this, as PlayCanvas' own are.
const SIDE: usize = 4;
/// Most entries of a palette: labels have 16 bits.
const MOST_ENTRIES: usize = 1 << 16;
/// A palette has this many entries at least, if there are this many Gaussians ...
const LEAST_ENTRIES: usize = 1024;
/// ... and an entry for this many of them: what our own format found to lose next to nothing.
const GAUSSIANS_PER_ENTRY: usize = 8;
/// Rounds of k-means: of the palette, and of a codebook, whose numbers are sorted and cheap.
const ROUNDS: usize = 8;
const BOOK_ROUNDS: usize = 40;
/// Half of the codes of a part of a quaternion.
const HALF: f32 = 127.5;

/// Writes a zipped scene. Returns what was left out. Errors: no Gaussians; the sink's.
pub(super) fn write(params: &Params, out: &mut dyn Write) -> Result<Warnings> {
    let mut warnings = Warnings::default();
    let mut rows = sound_rows(params, &mut warnings);
    if rows.is_empty() {
        return Err(Error::input("there are no Gaussians, and a SOG scene cannot be empty")
            .remedy("Choose another time, or write .ply files, which can be."));
    }
    let geometry = &params[GEOMETRY];
    let bounds = Bounds::of(rows.iter().map(|r| geometry.read::<3>(*r, 0).map(log)));
    rows.sort_by_cached_key(|r| bounds.cell(geometry.read::<3>(*r, 0).map(log)));
    let (mut meta, mut files) = (json!({"version": VERSION, "count": rows.len()}), Vec::new());
    let each = |pixel: &dyn Fn(usize) -> [u8; 4]| rows.iter().map(|r| pixel(*r)).collect::<Vec<_>>();
    let code = |row: usize| std::array::from_fn::<u16, 3, _>(|k| bounds.code(k, log(geometry.get(row, k))));
    files.push(("means_l.webp", image(&each(&|r| pixel(code(r).map(|c| c as u8))))?));
    files.push(("means_u.webp", image(&each(&|r| pixel(code(r).map(|c| (c >> 8) as u8))))?));
    meta["means"] = json!({"mins": bounds.min, "maxs": bounds.max, "files": ["means_l.webp", "means_u.webp"]});
    files.push(("quats.webp", image(&each(&|r| rotation(geometry.read::<4>(r, QUAT))))?));
    meta["quats"] = json!({"files": ["quats.webp"]});
    let book = Book::of(rows.iter().flat_map(|r| geometry.read::<3>(*r, LOG_SCALE)));
    files.push(("scales.webp", image(&each(&|r| pixel(geometry.read::<3>(r, LOG_SCALE).map(|s| book.code(s)))))?));
    meta["scales"] = json!({"codebook": book.values, "files": ["scales.webp"]});
    let sh = &params[SH];
    let book = Book::of(rows.iter().flat_map(|r| sh.read::<3>(*r, 0)));
    let base = |r: usize| {
        let [red, green, blue] = sh.read::<3>(r, 0).map(|c| book.code(c));
        [red, green, blue, byte_of_logit(geometry.get(r, OPACITY))]
    };
    files.push(("sh0.webp", image(&each(&base))?));
    meta["sh0"] = json!({"codebook": book.values, "files": ["sh0.webp"]});
    if sh.width() > 3 {
        let (rest, images) = palette(params, &rows)?;
        meta["shN"] = rest;
        files.extend(images);
    }
    let text = meta.to_string().into_bytes();
    let all: Vec<(&str, &[u8])> =
        std::iter::once((META, &text[..])).chain(files.iter().map(|(name, bytes)| (*name, &bytes[..]))).collect();
    zip::write(&all, 1, out)?;
    Ok(warnings)
}

/// Coordinates are stored as sign(x)·ln(1 + |x|).
fn log(x: f32) -> f64 {
    let x = f64::from(x);
    x.signum() * x.abs().ln_1p()
}

/// The box of the coordinates' logarithms.
struct Bounds {
    min: [f64; 3],
    max: [f64; 3],
}

impl Bounds {
    fn of(points: impl Iterator<Item = [f64; 3]>) -> Self {
        let mut own = Self { min: [f64::INFINITY; 3], max: [f64::NEG_INFINITY; 3] };
        for p in points {
            (0..3).for_each(|k| (own.min[k], own.max[k]) = (own.min[k].min(p[k]), own.max[k].max(p[k])));
        }
        own
    }

    fn code(&self, k: usize, x: f64) -> u16 {
        quant::coarse_code(x, self.min[k], self.max[k], u16::MAX.into(), 1) as u16
    }

    /// Place in Morton order.
    fn cell(&self, p: [f64; 3]) -> u64 {
        let levels = (1 << MORTON_BITS) - 1;
        morton(std::array::from_fn(|k| quant::coarse_code(p[k], self.min[k], self.max[k], levels, 1)))
    }
}

fn pixel([red, green, blue]: [u8; 3]) -> [u8; 4] {
    [red, green, blue, u8::MAX]
}

/// Three parts of a quaternion wxyz, and which is the largest.
fn rotation(q: [f32; 4]) -> [u8; 4] {
    let q = crate::math::quat::normalize(q.map(f64::from)).0;
    let largest = (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let part = |x: f64| ((x * sign * std::f64::consts::SQRT_2) as f32 * HALF + HALF).round().clamp(0.0, 255.0) as u8;
    let mut others = (0..4).filter(|i| *i != largest).map(|i| part(q[i]));
    let mut next = || others.next().expect("three of four are small");
    [next(), next(), next(), LARGEST_W + largest as u8]
}

/// A codebook of sorted numbers.
struct Book {
    values: Vec<f32>,
}

impl Book {
    /// 256 numbers with a small sum of squared distances to `all`: [`cells`], then Lloyd's algorithm on sorted numbers.
    fn of(all: impl Iterator<Item = f32>) -> Self {
        let mut sorted: Vec<f32> = all.collect();
        sorted.sort_by(f32::total_cmp);
        let n = sorted.len();
        let mut sums = Vec::with_capacity(n + 1);
        sums.push(0.0f64);
        sorted.iter().for_each(|x| sums.push(sums[sums.len() - 1] + f64::from(*x)));
        let mut values = cells(&sorted);
        for _ in 0..BOOK_ROUNDS {
            let mut first = 0;
            for i in 0..CODES {
                let middle = values.get(i + 1).map_or(f32::INFINITY, |next| values[i] + 0.5 * (next - values[i]));
                let end = first + sorted[first..].partition_point(|x| *x <= middle);
                if end > first {
                    values[i] = ((sums[end] - sums[first]) / (end - first) as f64) as f32;
                }
                first = end;
            }
        }
        values.sort_by(f32::total_cmp);
        Self { values }
    }

    /// The nearest number's position.
    fn code(&self, x: f32) -> u8 {
        let after = self.values.partition_point(|v| *v < x).min(CODES - 1);
        let before = after.saturating_sub(1);
        let nearer = (x - self.values[before]).abs() <= (self.values[after] - x).abs();
        (if nearer { before } else { after }) as u8
    }
}

/// 256 rising numbers: the cell with the largest sum of squares is cut at its mean, until there are this many. Lone
/// numbers far from the others get a cell of their own, which Lloyd's algorithm would not give them.
fn cells(sorted: &[f32]) -> Vec<f32> {
    let mut sums = vec![[0.0f64; 2]];
    for x in sorted {
        let (x, [sum, squares]) = (f64::from(*x), sums[sums.len() - 1]);
        sums.push([sum + x, squares + x * x]);
    }
    let mean = |cell: &Range<usize>| (sums[cell.end][0] - sums[cell.start][0]) / cell.len() as f64;
    let spread = |cell: &Range<usize>| {
        let sum = sums[cell.end][0] - sums[cell.start][0];
        sums[cell.end][1] - sums[cell.start][1] - sum * sum / cell.len() as f64
    };
    let (mut all, mut whole) = (vec![(spread(&(0..sorted.len())), 0..sorted.len())], Vec::new());
    while all.len() + whole.len() < CODES {
        let Some(widest) = (0..all.len()).max_by(|a, b| all[*a].0.total_cmp(&all[*b].0)) else { break };
        let (_, cell) = all.swap_remove(widest);
        let middle = mean(&cell) as f32;
        let cut = cell.start + sorted[cell.clone()].partition_point(|x| *x <= middle);
        // Nor is a cell cut whose mean, rounded, is below all of its numbers: an empty cell has no mean.
        match cut == cell.start || cut == cell.end {
            true => whole.push(cell),
            false => all.extend([cell.start..cut, cut..cell.end].map(|part| (spread(&part), part))),
        }
    }
    let mut values: Vec<f32> = all.iter().map(|(_, cell)| cell).chain(&whole).map(|cell| mean(cell) as f32).collect();
    values.sort_by(f32::total_cmp);
    values.resize(CODES, *values.last().expect("there are numbers"));
    values
}

/// A file of the archive: name and bytes.
type NamedFile = (&'static str, Vec<u8>);

/// The colours above degree 0: an image of entries, one of labels, and what `meta.json` states of them.
fn palette(params: &Params, rows: &[usize]) -> Result<(Value, [NamedFile; 2])> {
    let sh = &params[SH];
    let (width, coefficients) = (sh.width() - 3, sh.width() / 3 - 1);
    let mut points = Vec::with_capacity(rows.len() * width);
    rows.iter().for_each(|r| points.extend((0..width).map(|k| sh.get(*r, 3 + k))));
    let most = (rows.len() / GAUSSIANS_PER_ENTRY).clamp(LEAST_ENTRIES, MOST_ENTRIES);
    let found = if rows.len() <= most {
        Clusters { centroids: points, labels: (0..rows.len() as u32).collect() }
    } else {
        let weighted = points.chunks_exact(width).map(|p| (p, 1.0));
        cluster(weighted, width, most, ROUNDS, Rng::new(0, "sog palette", 0))
    };
    let book = Book::of(found.centroids.iter().copied());
    let entries = found.centroids.len() / width;
    let mut pixels = vec![[0, 0, 0, u8::MAX]; entries.next_multiple_of(ROW_OF_CENTROIDS) * coefficients];
    for (entry, values) in found.centroids.chunks_exact(width).enumerate() {
        let first = (entry / ROW_OF_CENTROIDS * ROW_OF_CENTROIDS + entry % ROW_OF_CENTROIDS) * coefficients;
        for (k, rgb) in values.chunks_exact(3).enumerate() {
            pixels[first + k] = pixel([rgb[0], rgb[1], rgb[2]].map(|x| book.code(x)));
        }
    }
    let labels: Vec<[u8; 4]> = found.labels.iter().map(|l| [*l as u8, (*l >> 8) as u8, 0, u8::MAX]).collect();
    let row = ROW_OF_CENTROIDS * coefficients;
    let names = ["shN_centroids.webp", "shN_labels.webp"];
    let meta =
        json!({"count": entries, "bands": (coefficients + 1).isqrt() - 1, "codebook": book.values, "files": names});
    Ok((meta, [(names[0], webp(&pixels, row, pixels.len() / row)?), (names[1], image(&labels)?)]))
}

/// A nearly square image with a pixel a Gaussian.
fn image(pixels: &[[u8; 4]]) -> Result<Vec<u8>> {
    let width = pixels.len().isqrt().next_multiple_of(SIDE).max(SIDE);
    let height = pixels.len().div_ceil(width).next_multiple_of(SIDE);
    webp(pixels, width, height)
}

/// A lossless image; pixels that are missing are black. Those without transparency get no alpha channel.
fn webp(pixels: &[[u8; 4]], width: usize, height: usize) -> Result<Vec<u8>> {
    let opaque = pixels.iter().all(|p| p[3] == u8::MAX);
    let channels = if opaque { 3 } else { 4 };
    let mut bytes: Vec<u8> = pixels.iter().flat_map(|p| &p[..channels]).copied().collect();
    bytes.resize(width * height * channels, 0);
    let mut out = Vec::new();
    let color = if opaque { ColorType::Rgb8 } else { ColorType::Rgba8 };
    WebPEncoder::new(&mut out).encode(&bytes, width as u32, height as u32, color).map_err(|e| {
        Error::input(format!("{} Gaussians do not fit into a WebP image ({e})", pixels.len()))
            .remedy("Write .compressed.ply or .spz, or fewer Gaussians.")
    })?;
    Ok(out)
}
