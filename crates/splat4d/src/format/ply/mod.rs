//! Gaussian `.ply` files, read and written: the plain 3DGS layout, PlayCanvas' compressed one
//! and the moving one of Spacetime Gaussians.
//!
//! A plain file has a row per Gaussian: x y z, nx ny nz (unused), f_dc_0..2, f_rest_*, opacity, scale_0..2, rot_0..3,
//! all f32. Scales are logarithms, opacity is a logit, the quaternion is (w, x, y, z) and not normalised, and f_rest is
//! **channel-major** (all coefficients of red first), while our tables are coefficient-major.
//! Source: the files of Kerbl et al. 2023.

mod columns;
mod compressed;
mod filter;
mod ftgs;
mod header;
mod numbered;
mod pack;
mod rows;
mod stg;

use crate::format::bytes::SH_C0;
pub use crate::format::dialect::PlyInfo;
use crate::format::dialect::{Dialect, Opened, Writer, Y_DOWN};
use crate::format::linear;
use crate::format::mend::{FLAT, Mended};
use crate::format::warnings::Warnings;
use crate::scene::offset::offset_of;
use crate::scene::params::{GEOMETRY, GEOMETRY_COLUMNS, LOG_SCALE, Params, SH};
use crate::scene::table::{BLOCK, Table};
use crate::{Error, Result};
use columns::{Columns, Thickness};
use header::{Element, Header, broken};
use rayon::prelude::*;
use rows::Rows;
use std::io::Write;

pub use compressed::COMPRESSED;
pub(crate) use ftgs::FTGS;
pub(in crate::format) use numbered::numbered;
pub(crate) use pack::write_compressed;
pub use stg::{STG, write_stg};

/// Plain 3DGS .ply, and any .ply that no other dialect recognizes.
pub const DIALECT: Dialect = Dialect {
    name: "3DGS .ply",
    ending: ".ply",
    up: Y_DOWN,
    moves: false,
    mark: Some(header::is_ply),
    read: open,
    writer: Writer::Moment(|params, options, mut out| {
        let offset = (options.offset, options.world);
        write_placed(params, offset, None, &mut out).map(|()| Warnings::default())
    }),
    world: true,
    fixed_axes: false,
    states_up: false,
};

/// f_rest properties of SH degree 0, 1, 2 and 3: three channels of the coefficients above the first.
const F_REST_COUNTS: [usize; 4] = [0, 9, 24, 45];
/// The columns of [`GEOMETRY`] as a plain file calls them.
const GEOMETRY_NAMES: [&str; 11] =
    ["x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2", "opacity"];
/// The base colour, coefficient 0 of red, green and blue.
const DC_NAMES: [&str; 3] = ["f_dc_0", "f_dc_1", "f_dc_2"];
/// Properties of velocities, scene units per second.
const VELOCITY_NAMES: [&str; 3] = ["vx", "vy", "vz"];
/// Written as zeros by all programs and read by none.
const NORMAL_NAMES: [&str; 3] = ["nx", "ny", "nz"];
/// Colours of point clouds.
const RGB_NAMES: [&str; 3] = ["red", "green", "blue"];
/// The same, as some tools shorten them.
const SHORT_RGB_NAMES: [&str; 3] = ["r", "g", "b"];
/// Comment of files whose positions are relative to an offset: `comment splat4d offset X Y Z`.
const OFFSET: &str = "splat4d offset";
/// Blocks of rows that one task converts.
const BLOCKS_PER_TASK: usize = 64;
/// Rows that the writer formats at a time.
const ROWS_PER_WRITE: usize = 4096;
const _: () = assert!(GEOMETRY_COLUMNS.len() == 4, "GEOMETRY_NAMES names these columns");

/// Coloured points without Gaussians.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlyPoints {
    /// Positions, in the file's units.
    pub positions: Vec<[f64; 3]>,
    /// Red, green, blue of each point, from 0 to 1 in files that keep to their format (in sRGB, as cameras give it);
    /// empty where the file has no colours.
    pub colors: Vec<[f32; 3]>,
    /// Seconds at which each point was seen (`time` or `t`); empty where the file does not state them.
    pub times: Vec<f64>,
    /// Triangles between the points, by their numbers; faces with more corners are fans. Empty in a cloud.
    pub triangles: Vec<[u32; 3]>,
}

/// Reads Gaussians: any order and type of properties, binary of either byte order or text, any other elements.
///
/// Errors: not a PLY file; truncated, or fewer bytes than the header claims; no Gaussians in it (the message names what
/// is missing); spherical harmonics above degree 3.
pub fn read(bytes: &[u8]) -> Result<(Params, PlyInfo)> {
    let header = Header::read(bytes)?;
    let Some(vertex) = header.elements.iter().find(|e| e.name == "vertex") else {
        return Err(broken("the file has no element `vertex`"));
    };
    if compressed::is_packed(vertex) {
        return compressed::read(&header, bytes);
    }
    let Columns { geometry, sh, rgb, thickness, filter } = columns::of(vertex)?;
    let [rows] = rows::find(&header, bytes, ["vertex"])?;
    let rows = rows.expect("the element was found above");
    let mut params = Params::new(rows.len(), sh.len() / 3, &[]);
    let mut bad = vec![0; rows.len().div_ceil(BLOCK)];
    fill(&mut params[GEOMETRY], &geometry, &rows, &mut bad);
    fill(&mut params[SH], &sh, &rows, &mut bad);
    let offset = subtract_offset(&mut params[GEOMETRY], &geometry, vertex, &rows).or_else(|| stated_offset(&header));
    if rgb {
        let white: Vec<f32> = sh[..3].iter().map(|&c| vertex.white(c) as f32).collect();
        let table = &mut params[SH];
        (0..rows.len())
            .for_each(|row| (0..3).for_each(|c| table.set(row, c, (table.get(row, c) / white[c] - 0.5) / SH_C0)));
    }
    if thickness == Thickness::None {
        (0..rows.len()).for_each(|row| params[GEOMETRY].set(row, LOG_SCALE + 2, FLAT));
    }
    let mended = Mended::of(&mut params);
    if let Some(column) = filter {
        filter::apply(&mut params[GEOMETRY], |row| rows.get(row, column));
    }
    if mended != Mended::default() {
        count_bad(&params, &mut bad);
    }
    let is_used = |i: &usize| geometry.contains(i) || sh.contains(i) || filter == Some(*i);
    let extra = vertex.properties.iter().enumerate().filter(|(i, _)| !is_used(i)).map(|(_, p)| p.name.clone());
    let extra: Vec<String> = extra.filter(|name| !NORMAL_NAMES.contains(&name.as_str())).collect();
    let assumed =
        columns::assumptions(rgb, thickness, filter.is_some(), &extra).into_iter().chain(surplus(&header, &rows));
    let info = PlyInfo {
        gaussians: rows.len(),
        sh_degree: degree(sh.len() / 3),
        non_finite_rows: bad.iter().map(|mask| mask.count_ones() as usize).sum(),
        mended,
        rgb,
        offset: offset.unwrap_or_default(),
        compressed: false,
        assumed: assumed.collect(),
        extra_properties: extra,
        comments: header.comments,
    };
    Ok((params, info))
}

/// Opens a plain or compressed file.
fn open(bytes: &[u8]) -> Result<Opened> {
    let (params, info) = read(bytes)?;
    let mut warnings = Warnings::default();
    info.assumed.iter().for_each(|sentence| warnings.add(sentence));
    for (what, evidence) in linear::doubts(&params) {
        warnings.add(format!("{evidence}. If so, convert the file with --linear {}", what.name()));
    }
    let offset = info.offset;
    let mut opened = Opened { ply: Some(info), ..Opened::from((params, warnings)) };
    opened.scene.offset = offset;
    Ok(opened)
}

/// Data after the rows of the last element, if it is not only space: rows that the header does not count, or bytes that
/// a copy in text mode added. `rows` are those of the last element.
fn surplus(header: &Header, rows: &Rows<'_>) -> Option<String> {
    let element = header.elements.last().filter(|e| e.name == "vertex" || e.name == "sh")?;
    let after = rows.after();
    (!after.trim_ascii().is_empty()).then(|| {
        format!(
            "{} bytes follow the {} rows of the header's last element `{}` and are not read: the file holds more rows than its \
             header states, or its line ends were changed on the way. Copy or export it again",
            after.len(),
            rows.len(),
            element.name
        )
    })
}

/// Whether a .ply file has PlayCanvas' compressed layout. False for anything unreadable.
pub(crate) fn is_compressed(bytes: &[u8]) -> bool {
    let packed = |e: &Element| e.name == "vertex" && compressed::is_packed(e);
    Header::read(bytes).is_ok_and(|h| h.elements.iter().any(packed))
}

/// Reads the positions of any PLY file, the times of its points, their colours (`red green blue`, `r g b`, or the base
/// colour of Gaussians), and the faces of a mesh.
///
/// Errors: not a PLY file, truncated, without positions, or with a face between points that are not there.
pub fn read_points(bytes: &[u8]) -> Result<PlyPoints> {
    let header = Header::read(bytes)?;
    let Some(vertex) = header.elements.iter().find(|e| e.name == "vertex") else {
        return Err(broken("the file has no element `vertex`"));
    };
    let all = |names: [&str; 3]| -> Option<[usize; 3]> {
        let [a, b, c] = names.map(|n| vertex.find(n));
        Some([a?, b?, c?])
    };
    let Some(xyz) = all(["x", "y", "z"]) else {
        return Err(broken("the file has no positions: its points lack x, y or z"));
    };
    let [rows] = rows::find(&header, bytes, ["vertex"])?;
    let rows = rows.expect("the element was found above");
    let join = |columns: [usize; 3]| (0..rows.len()).map(move |row| columns.map(|c| (row, c)));
    let positions = join(xyz).map(|row| row.map(|(row, c)| rows.get(row, c))).collect();
    let colors = if let Some(rgb) = all(RGB_NAMES).or(all(SHORT_RGB_NAMES)) {
        let color = |(row, c): (usize, usize)| (rows.get(row, c) / vertex.white(c)) as f32;
        join(rgb).map(|row| row.map(color)).collect()
    } else if let Some(dc) = all(DC_NAMES) {
        join(dc).map(|row| row.map(|(row, c)| 0.5 + SH_C0 * rows.get(row, c) as f32)).collect()
    } else {
        Vec::new()
    };
    let time = vertex.find("time").or(vertex.find("t"));
    let times = time.map_or(Vec::new(), |c| (0..rows.len()).map(|row| rows.get(row, c)).collect());
    let triangles = rows::triangles(&header, bytes, rows.len())?;
    Ok(PlyPoints { positions, colors, times, triangles })
}

/// Writes Gaussians in the plain layout, little-endian; normals are zero and other tables are left out.
///
/// Errors: a number is NaN or infinite; the sink's. Panics: the layer's SH coefficients are not 1, 4, 9 or 16 (degree
/// 0-3).
pub fn write(params: &Params, out: &mut impl Write) -> Result<()> {
    write_placed(params, ([0.0; 3], false), None, out)
}

/// The same of a scene with an offset: added in double precision where `world`, else a comment from which it is read
/// back. `velocities`, [N, 3] in scene units per second, become the properties `vx`, `vy`, `vz`.
pub fn write_placed(
    params: &Params,
    (offset, world): ([f64; 3], bool),
    velocities: Option<&Table>,
    out: &mut impl Write,
) -> Result<()> {
    if let Some(moving) = velocities {
        assert_eq!(moving.rows(), params.len(), "a velocity a Gaussian is needed");
        if let Some((row, _)) = moving.first_non_finite() {
            return Err(Error::input(format!("the velocity of Gaussian {row} is not finite"))
                .remedy("Leave velocities out, or train the scene again"));
        }
    }
    params.check_finite()?;
    let world = world && offset != [0.0; 3];
    let width = params[SH].width();
    let Some(f_rest) = F_REST_COUNTS.into_iter().find(|n| n + 3 == width) else {
        panic!("a layer has 3 times 1, 4, 9 or 16 SH columns, not {width}");
    };
    let coefficients = width / 3;
    let rest: Vec<String> = (0..f_rest).map(|i| format!("f_rest_{i}")).collect();
    let names = ["x", "y", "z"].into_iter().chain(NORMAL_NAMES).chain(DC_NAMES).chain(rest.iter().map(String::as_str));
    let names = names.chain(["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]);
    let names = names.chain(VELOCITY_NAMES.into_iter().filter(|_| velocities.is_some()));
    let mut text = "ply\nformat binary_little_endian 1.0\n".to_owned();
    if !world && offset != [0.0; 3] {
        text.push_str(&format!("comment {OFFSET} {} {} {}\n", offset[0], offset[1], offset[2]));
    }
    text.push_str(&format!("element vertex {}\n", params.len()));
    for (i, name) in names.enumerate() {
        let kind = if world && i < 3 { "double" } else { "float" };
        text.push_str(&format!("property {kind} {name}\n"));
    }
    text.push_str("end_header\n");
    let mut write = |bytes: &[u8]| out.write_all(bytes).map_err(|e| Error::io("the Gaussians could not be written", e));
    write(text.as_bytes())?;
    let (geometry, sh) = (&params[GEOMETRY], &params[SH]);
    let mut buffer: Vec<u8> = Vec::new();
    for first in (0..params.len()).step_by(ROWS_PER_WRITE) {
        buffer.clear();
        for row in first..params.len().min(first + ROWS_PER_WRITE) {
            let g: [f32; 11] = geometry.read(row, 0);
            if world {
                (0..3).for_each(|k| buffer.extend_from_slice(&(f64::from(g[k]) + offset[k]).to_le_bytes()));
            }
            let mut put = |x: f32| buffer.extend_from_slice(&x.to_le_bytes());
            g[..3].iter().filter(|_| !world).for_each(|&x| put(x));
            NORMAL_NAMES.iter().for_each(|_| put(0.0));
            (0..3).for_each(|c| put(sh.get(row, c)));
            for c in 0..3 {
                (1..coefficients).for_each(|k| put(sh.get(row, 3 * k + c)));
            }
            put(g[10]);
            g[7..10].iter().chain(&g[3..7]).for_each(|&x| put(x));
            velocities.iter().flat_map(|v| v.read::<3>(row, 0)).for_each(put);
        }
        write(&buffer)?;
    }
    Ok(())
}

/// SH degree of 1, 4, 9 or 16 coefficients.
fn degree(coefficients: usize) -> usize {
    coefficients.isqrt() - 1
}

/// Fills a table from the properties `columns`; sets bit r % 16 of `bad[r / 16]` where row r has a number that is not
/// finite.
fn fill(table: &mut Table, columns: &[usize], rows: &Rows<'_>, bad: &mut [u16]) {
    let tasks: Vec<_> = table.chunks_mut(BLOCKS_PER_TASK).zip(bad.chunks_mut(BLOCKS_PER_TASK)).collect();
    tasks.into_par_iter().for_each(|(chunk, bad)| {
        for (b, (block, bad)) in chunk.data.chunks_exact_mut(columns.len() * BLOCK).zip(bad).enumerate() {
            let first = chunk.first + b * BLOCK;
            let count = BLOCK.min(rows.len() - first);
            for (&property, column) in columns.iter().zip(block.chunks_exact_mut(BLOCK)) {
                rows.read(property, first, &mut column[..count]);
                *bad |= non_finite(&column[..count]);
            }
        }
    });
}

/// Counts again which rows hold numbers that are not finite.
fn count_bad(params: &Params, bad: &mut [u16]) {
    bad.fill(0);
    for table in [&params[GEOMETRY], &params[SH]] {
        for row in 0..table.rows() {
            let finite = (0..table.width()).all(|c| table.get(row, c).is_finite());
            bad[row / BLOCK] |= u16::from(!finite) << (row % BLOCK);
        }
    }
}

/// Makes positions that are far from the origin relative to an offset, where the file has them in double precision.
fn subtract_offset(table: &mut Table, columns: &[usize], vertex: &Element, rows: &Rows<'_>) -> Option<[f64; 3]> {
    let double = |&c: &usize| vertex.properties[c].kind == header::Kind::Scalar(header::Scalar::F64);
    if !columns[..3].iter().all(double) {
        return None;
    }
    let position = |row: usize| -> [f64; 3] { std::array::from_fn(|k| rows.get(row, columns[k])) };
    let all: Vec<[f64; 3]> = (0..rows.len()).map(position).collect();
    let offset = offset_of(&[], &all);
    if offset == [0.0; 3] {
        return None;
    }
    for (row, p) in all.iter().enumerate() {
        table.write(row, 0, std::array::from_fn::<f32, 3, _>(|k| (p[k] - offset[k]) as f32));
    }
    Some(offset)
}

/// The offset that a comment of ours states.
fn stated_offset(header: &Header) -> Option<[f64; 3]> {
    let numbers = header.comments.iter().find_map(|c| c.strip_prefix(OFFSET))?;
    let numbers: Vec<f64> = numbers.split_whitespace().map_while(|w| w.parse().ok()).collect();
    <[f64; 3]>::try_from(numbers).ok().filter(|o| o.iter().all(|x| x.is_finite()))
}

/// A bit for each number (at most 16) that is NaN or infinite.
fn non_finite(numbers: &[f32]) -> u16 {
    numbers.iter().enumerate().fold(0, |mask, (r, x)| mask | u16::from(!x.is_finite()) << r)
}

#[cfg(test)]
mod tests;
