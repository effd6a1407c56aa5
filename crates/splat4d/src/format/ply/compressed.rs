//! PlayCanvas' compressed `.ply`: chunks of 256 Gaussians, four 32-bit words a Gaussian, quantised between the chunk's
//! smallest and largest values.
//!
//! Words, highest bits first: position and log scale 11-10-11 (x, y, z); rotation 2-10-10-10 (index of the largest part
//! of (w, x, y, z), then the other three times 1/√2 plus ½); colour 8-8-8 and opacity 8. An optional element `sh`
//! holds f_rest in bytes over [-4, 4]. Source: layout of PlayCanvas' splat-transform (MIT).

use super::columns::f_rest_columns;
use super::header::{Element, Header, broken};
use super::pack::{BOUNDS, CHUNK, COLOR_BOUNDS, SH_RANGE, WORDS};
use super::{PlyInfo, degree, is_compressed, non_finite, open, rows, surplus, write_compressed};
use crate::format::bytes::{SH_C0, logit_of_byte};
use crate::format::dialect::{Dialect, Writer, Y_DOWN};
use crate::format::mend::Mended;
use crate::scene::params::{GEOMETRY, LOG_SCALE, OPACITY, Params, QUAT, SH};
use crate::scene::table::Table;
use crate::{Error, ErrorKind, Result};

/// PlayCanvas' compressed .ply.
pub const COMPRESSED: Dialect = Dialect {
    name: "3DGS .ply, compressed (PlayCanvas)",
    ending: ".compressed.ply",
    up: Y_DOWN,
    moves: false,
    mark: Some(is_compressed),
    read: open,
    writer: Writer::Moment(|params, _, mut out| write_compressed(params, &mut out)),
    world: false,
    fixed_axes: false,
    states_up: false,
};

/// Whether the element holds packed Gaussians.
pub(super) fn is_packed(vertex: &Element) -> bool {
    vertex.find(WORDS[0]).is_some()
}

/// Reads packed Gaussians.
pub(super) fn read(header: &Header, bytes: &[u8]) -> Result<(Params, PlyInfo)> {
    let [chunks, vertices, sh] = rows::find(header, bytes, ["chunk", "vertex", "sh"])?;
    let of = |name: &str| header.elements.iter().find(|e| e.name == name);
    let (Some(chunks), Some(chunk), Some(vertices), Some(vertex)) = (chunks, of("chunk"), vertices, of("vertex"))
    else {
        return Err(broken("the file has packed Gaussians, but no element `chunk` with their bounds"));
    };
    let words = columns(vertex, WORDS)?;
    let bounds = columns(chunk, BOUNDS)?;
    let colors = if chunk.find(COLOR_BOUNDS[0]).is_some() { Some(columns(chunk, COLOR_BOUNDS)?) } else { None };
    let count = vertices.len();
    if chunks.len() < count.div_ceil(CHUNK) {
        return Err(broken(format!(
            "{count} Gaussians need a chunk for every {CHUNK}, but there are {}",
            chunks.len()
        )));
    }
    let f_rest = of("sh").map_or(Ok(Vec::new()), f_rest_columns)?;
    if sh.as_ref().is_some_and(|sh| sh.len() != count) {
        return Err(broken("the elements `vertex` and `sh` have different numbers of rows"));
    }
    let mut params = Params::new(count, 1 + f_rest.len() / 3, &[]);
    let [geometry, table] = params.get_mut([GEOMETRY, SH]);
    let mut non_finite_rows = 0;
    for row in 0..count {
        let bound = |i: usize| chunks.get(row / CHUNK, bounds[i]) as f32;
        let color = |i: usize| match &colors {
            Some(c) => chunks.get(row / CHUNK, c[i]) as f32,
            None => (i / 3) as f32,
        };
        // A word of another type (a text file, a double) saturates here: wrong numbers, but no harm.
        let [position, rotation, scale, rgba] = words.map(|w| vertices.get(row, w) as u32);
        let between = |min: f32, max: f32, u: f32| min + (max - min) * u;
        let (p, s) = (unpack_11_10_11(position), unpack_11_10_11(scale));
        let means: [f32; 3] = std::array::from_fn(|k| between(bound(k), bound(3 + k), p[k]));
        let log_scales: [f32; 3] = std::array::from_fn(|k| between(bound(6 + k), bound(9 + k), s[k]));
        let byte = |k: usize| (rgba >> (24 - 8 * k) & 0xFF) as f32;
        let dc: [f32; 3] = std::array::from_fn(|k| (between(color(k), color(3 + k), byte(k) / 255.0) - 0.5) / SH_C0);
        geometry.write(row, 0, means);
        geometry.write(row, QUAT, unpack_rotation(rotation));
        geometry.write(row, LOG_SCALE, log_scales);
        geometry.set(row, OPACITY, logit_of_byte(rgba as u8));
        table.write(row, 0, dc);
        let is_bad = |numbers: &[f32]| non_finite(numbers) != 0;
        non_finite_rows += usize::from(is_bad(&means) || is_bad(&log_scales) || is_bad(&dc));
    }
    let last = sh.as_ref().filter(|_| header.elements.last().is_some_and(|e| e.name == "sh"));
    let assumed = surplus(header, last.unwrap_or(&vertices));
    if let Some(sh) = sh {
        unpack_sh(table, &f_rest, &sh);
    }
    let extra = vertex.properties.iter().map(|p| &p.name).filter(|n| !WORDS.contains(&n.as_str()));
    let info = PlyInfo {
        gaussians: count,
        sh_degree: degree(1 + f_rest.len() / 3),
        non_finite_rows,
        compressed: true,
        mended: Mended::default(),
        rgb: false,
        assumed: assumed.into_iter().collect(),
        offset: [0.0; 3],
        comments: header.comments.clone(),
        extra_properties: extra.cloned().collect(),
    };
    Ok((params, info))
}

fn columns<const N: usize>(element: &Element, names: [&str; N]) -> Result<[usize; N]> {
    let found = names.map(|n| element.find(n));
    if let Some(i) = found.iter().position(Option::is_none) {
        return Err(Error::new(
            ErrorKind::Unsupported,
            format!("the element `{}` of a compressed file lacks `{}`", element.name, names[i]),
        )
        .remedy("Export the file again as a plain .ply"));
    }
    Ok(found.map(|i| i.expect("checked above")))
}

/// Three numbers in [0, 1].
fn unpack_11_10_11(word: u32) -> [f32; 3] {
    [(word >> 21) as f32 / 2047.0, (word >> 11 & 0x3FF) as f32 / 1023.0, (word & 0x7FF) as f32 / 2047.0]
}

/// A unit quaternion (w, x, y, z).
fn unpack_rotation(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let part = |shift: u32| ((word >> shift & 0x3FF) as f32 / 1023.0 - 0.5) * std::f32::consts::SQRT_2;
    let small = [part(20), part(10), part(0)];
    let rest = (1.0 - small.iter().map(|x| x * x).sum::<f32>()).max(0.0).sqrt();
    let mut others = small.into_iter();
    std::array::from_fn(|i| if i == largest { rest } else { others.next().expect("three of four are small") })
}

/// The writer floors, so that a byte represents the middle of its interval; the ends represent themselves.
fn unpack_sh(table: &mut Table, f_rest: &[usize], sh: &rows::Rows<'_>) {
    for row in 0..sh.len() {
        for (k, &property) in f_rest.iter().enumerate() {
            let byte = sh.get(row, property) as f32;
            let u = match byte {
                0.0 => 0.0,
                255.0 => 1.0,
                b => (b + 0.5) / 256.0,
            };
            table.set(row, 3 + k, (u - 0.5) * SH_RANGE);
        }
    }
}
