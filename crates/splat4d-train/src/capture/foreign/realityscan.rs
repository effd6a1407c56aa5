//! Camera parameters of RealityScan (RealityCapture) as CSV: "Internal/External camera parameters".
//!
//! A line per image: name, position, heading, pitch and roll in degrees, the focal length and the principal point's
//! distance from the middle for a film 36 mm wide, Brown's terms. The world has z up. Source: the columns and
//! conventions as Nerfstudio's documentation of its RealityCapture import describes them.

use super::{Convention, Export, Images, Said, Shot, only_points, take};
use crate::capture::{CaptureKind, CaptureOptions, RawCapture, json, picture, pose, rig};
use crate::text;
use splat4d::math::se3::mat_mul;
use splat4d::scene::{Camera, Intrinsics, Lens};
use splat4d::{Error, ErrorKind, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub(super) const EXPORT: Export = Export { find, is, read };

/// Columns that such a file has.
const COLUMNS: [&str; 10] = ["name", "x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py"];
/// How many of them a file has at least, in one of this many first lines, to be taken for such a file.
const MEANT: usize = 7;
const HEADER_LINES: usize = 5;
/// Other names of columns.
const ALIASES: [(&str, &str); 3] = [("z", "alt"), ("altitude", "alt"), ("f35", "f")];
/// Files of an ending that are looked into.
const MOST_FILES: usize = 100;
/// Endings of such files.
const ENDINGS: [&str; 2] = ["csv", "txt"];
/// Width of the film that lengths refer to, millimetres.
const FILM: f64 = 36.0;
/// Bytes at the beginning of a file in which its columns are named.
const HEAD: usize = 1024;
const Z_UP: [f64; 3] = [0.0, 0.0, 1.0];

fn find(root: &Path) -> Option<PathBuf> {
    let names = rig::file_names(root);
    let of = |ending: &'static str| {
        let ends = move |p: &PathBuf| p.extension().is_some_and(|e| e.eq_ignore_ascii_case(ending));
        names.iter().map(|n| root.join(n)).filter(ends).take(MOST_FILES)
    };
    ENDINGS.into_iter().flat_map(of).find(|p| is(p))
}

fn is(path: &Path) -> bool {
    use std::io::Read;
    if path.extension().is_none_or(|e| !ENDINGS.iter().any(|v| e.eq_ignore_ascii_case(v))) {
        return false;
    }
    let mut head = Vec::new();
    let read = crate::files::open(path).is_ok_and(|f| f.take(HEAD as u64).read_to_end(&mut head).is_ok());
    let text = text::decode(&head).unwrap_or_else(|_| String::from_utf8_lossy(&head));
    read && header(&text).is_some()
}

/// The line that names the columns, and its number from 0: some versions write a line with the number of cameras before it.
fn header(text: &str) -> Option<(usize, &str)> {
    let known = |line: &str| {
        let columns = columns(line);
        COLUMNS.iter().filter(|c| columns.contains_key(**c)).count()
    };
    let lines = text.lines().enumerate().take(HEADER_LINES);
    lines.map(|(number, line)| (number, line.trim())).find(|(_, line)| known(line) >= MEANT)
}

/// Separators of cells: spreadsheets of countries with decimal commas write semicolons or tabs.
fn separator(header: &str) -> char {
    [';', '\t'].into_iter().find(|c| header.contains(*c)).unwrap_or(',')
}

/// Names of columns and their places.
fn columns(line: &str) -> BTreeMap<String, usize> {
    let line = line.trim_start_matches('\u{feff}').trim_start_matches('#');
    let plain = |name: &str| {
        let name = name.trim().trim_matches('"').to_lowercase();
        ALIASES.iter().find(|(alias, _)| *alias == name).map_or(name, |(_, known)| (*known).to_owned())
    };
    line.split(separator(line)).enumerate().map(|(i, name)| (plain(name), i)).collect()
}

fn read(root: &Path, marker: &Path, options: &CaptureOptions) -> Result<RawCapture> {
    let bytes = json::read_bytes(marker)?;
    let text = text::decode(&bytes).unwrap_or_else(|_| String::from_utf8_lossy(&bytes));
    let place = |e: Error| e.at(marker.display());
    let (first, header) = header(&text).unwrap_or_default();
    let lines = text.lines().enumerate().skip(first + 1).map(|(i, l)| (i + 1, l.trim()));
    let lines = lines.filter(|(_, l)| !l.is_empty());
    let (columns, separator) = (columns(header), separator(header));
    let missing: Vec<&str> = COLUMNS.into_iter().filter(|c| !columns.contains_key(*c)).collect();
    if !missing.is_empty() {
        return Err(place(Error::input(format!("it lacks the columns {}", missing.join(", "))))
            .remedy("Export the registration as \"Internal/External camera parameters\"."));
    }
    let images = Images::below(root);
    let rows: Vec<(usize, Row<'_>)> =
        lines.map(|(number, line)| (number, Row { columns: &columns, words: words(line, separator) })).collect();
    let cells = header.split(separator).count();
    let filled = |row: &Row<'_>| row.words.iter().rposition(|w| !w.is_empty()).map_or(0, |last| last + 1);
    if let Some((number, row)) = rows.iter().find(|(_, row)| filled(row) > cells) {
        let what = format!("expected {cells} cells, as there are columns, found {}", filled(row));
        return Err(place(Error::input(what).at(format!("line {number}")))
            .remedy("Where numbers have decimal commas, export the file with semicolons between cells."));
    }
    let found =
        rows.iter().map(|(number, row)| images.named(row.name()).map_err(|e| place(e.at(format!("line {number}")))));
    let found = found.collect::<Result<Vec<PathBuf>>>()?;
    // The size of an image that is there is that of missing ones, which are counted later.
    let there = found.iter().find(|image| image.is_file());
    let size = there.map(|image| picture::header(image)).transpose()?.map_or((1, 1), |header| header.upright());
    let mut shots = Vec::new();
    for ((number, row), image) in rows.iter().zip(found) {
        shots.push(row.shot(image, size).map_err(|e| place(e.at(format!("line {number}"))))?);
    }
    let (warnings, mut notes) = (Vec::new(), Vec::new());
    let points = only_points(root, &mut notes)?;
    let said = Said {
        kind: CaptureKind::RealityScan,
        convention: Convention::NERF,
        fps: None,
        points,
        up: Some(Z_UP),
        warnings,
        notes,
    };
    take(root, shots, said, options)
}

/// A line's cells.
fn words(line: &str, separator: char) -> Vec<&str> {
    line.split(separator).map(|w| w.trim().trim_matches('"')).collect()
}

struct Row<'a> {
    columns: &'a BTreeMap<String, usize>,
    words: Vec<&'a str>,
}

impl Row<'_> {
    /// A number; 0 where there is no such column.
    fn number(&self, name: &str) -> Result<f64> {
        let Some(&column) = self.columns.get(name) else { return Ok(0.0) };
        let word = self.words.get(column).copied().unwrap_or_default();
        word.replace(',', ".").parse().ok().filter(|x: &f64| x.is_finite()).ok_or_else(|| {
            Error::input(format!("{name} is \"{word:.40}\", not a number")).remedy("Export the cameras again.")
        })
    }

    fn name(&self) -> &str {
        self.words.get(self.columns["name"]).copied().unwrap_or_default()
    }

    /// `size`: that of an image which is missing.
    fn shot(&self, image: PathBuf, size: (usize, usize)) -> Result<Shot> {
        let size = if image.is_file() { picture::header(&image)?.upright() } else { size };
        let (width, height) = (size.0 as f64, size.1 as f64);
        let angle = |name: &str| Ok::<_, Error>(self.number(name)?.to_radians().sin_cos());
        let ((sh, ch), (sp, cp), (sr, cr)) = (angle("heading")?, angle("pitch")?, angle("roll")?);
        // Heading is clockwise from above.
        let heading = [[ch, sh, 0.0], [-sh, ch, 0.0], [0.0, 0.0, 1.0]];
        let pitch = [[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]];
        let roll = [[cr, 0.0, sr], [0.0, 1.0, 0.0], [-sr, 0.0, cr]];
        let r = mat_mul(&heading, &mat_mul(&pitch, &roll));
        let t = [self.number("x")?, self.number("y")?, self.number("alt")?];
        let row = |i: usize| [r[i][0], r[i][1], r[i][2], t[i]];
        let cam_from_world = super::opengl_pose(&[row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]])?;
        let pixels = width.max(height) / FILM;
        let f = self.number("f")? * pixels;
        let intrinsics = Intrinsics {
            fx: f,
            fy: f,
            cx: 0.5 * width + self.number("px")? * pixels,
            cy: 0.5 * height + self.number("py")? * pixels,
        };
        pose::check_intrinsics(&intrinsics, size.0, size.1)?;
        let k = [self.number("k1")?, self.number("k2")?, self.number("k3")?, 0.0, 0.0, 0.0];
        let p = [self.number("t1")?, self.number("t2")?];
        if self.number("k4")? != 0.0 {
            return Err(Error::new(ErrorKind::Unsupported, "its lens has a term k4, which is not read")
                .remedy("Align with the distortion model Brown 3, or export undistorted images."));
        }
        let lens = if k == [0.0; 6] && p == [0.0; 2] { Lens::Pinhole } else { Lens::Brown { k, p, s: [0.0; 4] } };
        let (width, height) = size;
        let source = Camera { cam_from_world, intrinsics, lens, width, height, near: Camera::NEAR };
        Ok(Shot { name: self.name().to_owned(), image, source, time: None, depth: None })
    }
}
