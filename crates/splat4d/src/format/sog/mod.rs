//! SOG version 2 (PlayCanvas): Gaussians as lossless WebP images, in a zip file or in a folder.
//!
//! `meta.json` has `version` 2, `count` and for each group the image's `files` and a range or a codebook. Pixel i of a
//! image belongs to Gaussian i. means_l, means_u: low and high bytes of 16 bits between mins and maxs of
//! sign(x)·ln(1 + |x|). quats: three parts (b/255·2 − 1)/√2, the fourth byte 252 + index of the largest of (w, x, y,
//! z). scales: three codes of a codebook of 256 log scales. sh0: three codes of a codebook of f_dc, and opacity. shN:
//! labels of 16 bits; label l has its coefficients at row l/64, columns (l mod 64)·K on of the centroids, codes of a
//! codebook. World axes as in .ply: y down. Source: playcanvas/splat-transform (MIT), its reader.

pub mod levels;
mod pictures;
#[cfg(test)]
pub(super) mod tests;
mod write;

use super::bytes::logit_of_byte;
use super::dialect::{Dialect, Opened, Writer, Y_DOWN};
use super::foreign;
use super::warnings::Warnings;
use super::zip;
use crate::scene::params::{LOG_SCALE, OPACITY, QUAT};
use crate::scene::{GEOMETRY, Params, SH};
use crate::{Error, ErrorKind, Result};
use pictures::{Needs, Picture};
use serde_json::Value;

pub use super::zip::{Files, MAGIC as ZIP_MAGIC};

/// SOG version 2, zipped.
pub const DIALECT: Dialect = Dialect {
    name: "SOG",
    ending: ".sog",
    up: Y_DOWN,
    moves: false,
    mark: Some(|bytes| bytes.starts_with(&ZIP_MAGIC)),
    read: |bytes| read(&unzip(bytes)?).map(Opened::from),
    writer: Writer::Moment(|params, _, out| write::write(params, out)),
    world: false,
    fixed_axes: false,
    states_up: false,
};

/// The version this library reads.
pub(crate) const VERSION: u64 = 2;
/// The file that describes the others.
pub const META: &str = "meta.json";
/// Most Gaussians that are accepted, a byte of the files: real ones take eight bytes and more each.
const PER_BYTE: usize = 1;
/// Gaussians that are accepted in any case, so that tiny files of equal Gaussians can be read.
const ALWAYS: usize = 4096;
/// Longest `meta.json` that is read, bytes: its four codebooks take some 20 kB.
const MOST_META: usize = 4 << 20;
/// Codes of a codebook.
const CODES: usize = 256;
/// Fourth byte of a quaternion whose largest part is w.
const LARGEST_W: u8 = 252;
/// Centroids in a row of their image.
const ROW_OF_CENTROIDS: usize = 64;

/// The files of the scene in a `.sog` file, which is a zip: `meta.json`, then what it names, and nothing else.
///
/// Errors: damaged, encrypted, an archive of another program, or files longer than such a scene needs.
pub fn unzip(bytes: &[u8]) -> Result<Files<'_>> {
    let archive = zip::Archive::open(bytes)?;
    let names = archive.names();
    // Some zip a whole folder: names lose what is before `meta.json`.
    let folders = names.iter().filter_map(|n| n.strip_suffix(META).filter(|f| f.is_empty() || f.ends_with('/')));
    let Some(folder) = folders.min_by_key(|f| f.len()) else {
        return Err(foreign::archive(&names).unwrap_or_else(|| damaged("it has no meta.json")));
    };
    let take = |name: &str, most: usize| archive.file(&format!("{folder}{name}"), most);
    let meta = take(META, MOST_META).expect("it is one of the names")?;
    let wanted = files_of(&meta)?;
    // Images are compressed before they are zipped.
    let packed = wanted.iter().filter_map(|n| archive.packed(&format!("{folder}{n}"))).sum();
    let most = pictures::most_bytes(count_of(&parse(&meta)?, packed)?);
    let mut files = Files::from([(META.to_owned(), meta)]);
    for name in wanted {
        if let (false, Some(file)) = (files.contains_key(&name), take(&name, most)) {
            files.insert(name, file?);
        }
    }
    Ok(files)
}

/// The number of Gaussians. Errors: none is stated, or more than `bytes` of images can hold.
fn count_of(meta: &Value, bytes: usize) -> Result<usize> {
    let count = meta["count"].as_u64().and_then(|n| usize::try_from(n).ok());
    let count = count.ok_or_else(|| damaged("its meta.json has no `count`"))?;
    if count > ALWAYS + PER_BYTE * bytes {
        return Err(damaged(format!("it claims {count} Gaussians in {bytes} bytes")));
    }
    Ok(count)
}

/// Names of the images that a `meta.json` names, which a folder's reader must fetch.
///
/// Errors: not JSON, or another version.
pub fn files_of(meta: &[u8]) -> Result<Vec<String>> {
    let meta = parse(meta)?;
    let groups = ["means", "scales", "quats", "sh0", "shN"];
    let names = groups.iter().filter_map(|g| meta[*g]["files"].as_array()).flatten();
    Ok(names.filter_map(|n| n.as_str().map(str::to_owned)).collect())
}

/// Reads a scene from its files.
///
/// Errors: no `meta.json`, another version, a missing or too small image, numbers that are none.
pub fn read(files: &Files<'_>) -> Result<(Params, Warnings)> {
    let Some(meta) = files.get(META) else {
        return Err(damaged("it has no meta.json"));
    };
    let meta = parse(meta)?;
    let total: usize = files.values().map(|f| f.len()).sum();
    let count = count_of(&meta, total)?;
    let per_gaussian = |group: &str, i: usize| picture(files, &meta, group, i, Needs::Pixels(count));
    let mut warnings = Warnings::default();
    let rest = match meta.get("shN") {
        Some(Value::Null) | None => None,
        Some(_) => Some(Rest::open(&meta, picture(files, &meta, "shN", 0, Needs::Palette)?, per_gaussian("shN", 1)?)?),
    };
    let coefficients = rest.as_ref().map_or(0, |r| r.coefficients);
    let mut params = Params::new(count, 1 + coefficients, &[]);
    let [geometry, sh] = params.get_mut([GEOMETRY, SH]);
    let bound = |key: &str| numbers::<3>(&meta["means"][key], &format!("means.{key}"));
    let (mins, maxs) = (bound("mins")?, bound("maxs")?);
    let (low, high) = (per_gaussian("means", 0)?, per_gaussian("means", 1)?);
    for row in 0..count {
        let (l, h) = (low.pixel(row), high.pixel(row));
        geometry.write(
            row,
            0,
            std::array::from_fn::<f32, 3, _>(|k| {
                let u = f64::from(u16::from_le_bytes([l[k], h[k]])) / f64::from(u16::MAX);
                let x = mins[k] + (maxs[k] - mins[k]) * u;
                (x.signum() * x.abs().exp_m1()) as f32
            }),
        );
    }
    drop((low, high));
    let quats = per_gaussian("quats", 0)?;
    let mut untagged = 0;
    for row in 0..count {
        let q = quaternion(quats.pixel(row));
        untagged += usize::from(q.is_none());
        geometry.write(row, QUAT, q.unwrap_or([1.0, 0.0, 0.0, 0.0]));
    }
    drop(quats);
    warnings.counted(untagged, count, "have a rotation that names no largest part, and are not turned");
    let (scales, book) = (per_gaussian("scales", 0)?, codebook(&meta, "scales")?);
    for row in 0..count {
        let code = scales.pixel(row);
        geometry.write(row, LOG_SCALE, std::array::from_fn::<f32, 3, _>(|k| book[usize::from(code[k])]));
    }
    drop(scales);
    let (sh0, book) = (per_gaussian("sh0", 0)?, codebook(&meta, "sh0")?);
    for row in 0..count {
        let code = sh0.pixel(row);
        sh.write(row, 0, std::array::from_fn::<f32, 3, _>(|k| book[usize::from(code[k])]));
        geometry.set(row, OPACITY, logit_of_byte(code[3]));
    }
    drop(sh0);
    let Some(rest) = rest else { return Ok((params, warnings)) };
    let mut strange = 0;
    for row in 0..count {
        strange += usize::from(!rest.write(row, |k, c, x| sh.set(row, 3 * (1 + k) + c, x)));
    }
    warnings.counted(strange, count, "name colours that are not in the palette, and have none above degree 0");
    Ok((params, warnings))
}

/// Spherical harmonics above degree 0.
struct Rest {
    centroids: Picture,
    labels: Picture,
    book: [f32; CODES],
    /// 3, 8 or 15.
    coefficients: usize,
    palette: usize,
}

impl Rest {
    fn open(meta: &Value, centroids: Picture, labels: Picture) -> Result<Self> {
        let coefficients = centroids.width / ROW_OF_CENTROIDS;
        if ![3, 8, 15].contains(&coefficients) || !centroids.width.is_multiple_of(ROW_OF_CENTROIDS) {
            return Err(damaged(format!("its shN centroids are {} pixels wide, not 192, 512 or 960", centroids.width)));
        }
        let rows = centroids.height * ROW_OF_CENTROIDS;
        let stated = meta["shN"]["count"].as_u64().and_then(|n| usize::try_from(n).ok());
        let palette = stated.unwrap_or(rows).min(rows);
        Ok(Self { centroids, labels, book: codebook(meta, "shN")?, coefficients, palette })
    }

    /// Hands over (coefficient, channel, value); false where the label names none.
    fn write(&self, row: usize, mut put: impl FnMut(usize, usize, f32)) -> bool {
        let [low, high, ..] = self.labels.pixel(row);
        let label = usize::from(u16::from_le_bytes([low, high]));
        if label >= self.palette {
            return false;
        }
        let first = label / ROW_OF_CENTROIDS * self.centroids.width + label % ROW_OF_CENTROIDS * self.coefficients;
        for k in 0..self.coefficients {
            let codes = self.centroids.pixel(first + k);
            (0..3).for_each(|c| put(k, c, self.book[usize::from(codes[c])]));
        }
        true
    }
}

/// wxyz, the largest part positive.
fn quaternion([a, b, c, tag]: [u8; 4]) -> Option<[f32; 4]> {
    let largest = usize::from(tag.checked_sub(LARGEST_W)?);
    let part = |b: u8| (f32::from(b) / 255.0 * 2.0 - 1.0) * std::f32::consts::FRAC_1_SQRT_2;
    let small = [a, b, c].map(part);
    let rest = (1.0 - small.iter().map(|x| x * x).sum::<f32>()).max(0.0).sqrt();
    let mut others = small.into_iter();
    Some(std::array::from_fn(|i| if i == largest { rest } else { others.next().expect("three of four are small") }))
}

fn parse(meta: &[u8]) -> Result<Value> {
    let meta: Value = serde_json::from_slice(meta).map_err(|e| damaged(format!("its meta.json is not JSON: {e}")))?;
    match meta["version"].as_u64() {
        Some(VERSION) => Ok(meta),
        Some(other) => Err(Error::new(
            ErrorKind::Unsupported,
            format!("the scene has version {other} of SOG, this splat4d reads version {VERSION}"),
        )
        .remedy("Install a newer splat4d, or convert the file to .ply with splat-transform.")),
        None if meta["means"].is_object() => {
            Err(Error::new(ErrorKind::Unsupported, "the scene has version 1 of SOG, which is not read")
                .remedy("Convert it first: splat-transform old/meta.json new.sog."))
        }
        None => Err(damaged("its meta.json is not that of a SOG scene: it has no version")),
    }
}

fn picture(files: &Files<'_>, meta: &Value, group: &str, i: usize, needs: Needs) -> Result<Picture> {
    let name = meta[group]["files"][i].as_str();
    let name = name.ok_or_else(|| damaged(format!("its meta.json names no file {i} of `{group}`")))?;
    let bytes = files.get(name).ok_or_else(|| damaged(format!("the image {name} is missing")))?;
    Picture::open(bytes, needs).map_err(|e| e.at(name))
}

fn numbers<const N: usize>(v: &Value, name: &str) -> Result<[f64; N]> {
    let list = v.as_array().filter(|l| l.len() == N);
    let read = |i: usize| list.and_then(|l| l[i].as_f64()).filter(|x| x.is_finite());
    let all: Option<Vec<f64>> = (0..N).map(read).collect();
    let all = all.ok_or_else(|| damaged(format!("`{name}` in its meta.json is not {N} numbers")))?;
    Ok(std::array::from_fn(|i| all[i]))
}

fn codebook(meta: &Value, group: &str) -> Result<[f32; CODES]> {
    numbers::<CODES>(&meta[group]["codebook"], &format!("{group}.codebook")).map(|b| b.map(|x| x as f32))
}

fn damaged(what: impl std::fmt::Display) -> Error {
    Error::input(format!("this SOG scene is damaged: {what}")).remedy("Copy or export it again.")
}
