//! Point clouds from .ply files: vertices with x y z and, where present, red green blue and time.

use super::json::read_bytes;
use super::points::PointCloud;
use splat4d::{Error, Result};
use std::path::Path;

/// Longest header that is read, bytes; the largest known (splats with 45 SH columns) is 2 KiB.
const MAX_HEADER: usize = 64 << 10;
/// Colour of points that have none.
const GREY: f32 = 0.5;

#[derive(Clone, Copy, PartialEq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The value at the start of `b` (little endian), which holds at least `bytes()` bytes.
    fn read(self, b: &[u8]) -> f64 {
        match self {
            Self::I8 => f64::from(b[0] as i8),
            Self::U8 => f64::from(b[0]),
            Self::I16 => f64::from(i16::from_le_bytes([b[0], b[1]])),
            Self::U16 => f64::from(u16::from_le_bytes([b[0], b[1]])),
            Self::I32 => f64::from(i32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Self::U32 => f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Self::F32 => f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
            Self::F64 => f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]),
        }
    }

    /// What full colour is: 1 for floats, the type's range for integers.
    fn white(self) -> f64 {
        match self {
            Self::F32 | Self::F64 => 1.0,
            Self::U16 | Self::I16 => 65535.0,
            _ => 255.0,
        }
    }
}

struct Layout {
    binary: bool,
    count: usize,
    properties: Vec<(String, Scalar)>,
    body: usize,
}

/// Reads the vertices of a .ply file (ascii or binary little endian; properties in any order and of any type). Points
/// that are not finite are left out.
pub(super) fn read(path: &Path) -> Result<PointCloud> {
    let bytes = read_bytes(path)?;
    parse(&bytes).map_err(|e| e.at(path.display()).remedy("Export the point cloud again as a plain .ply."))
}

fn parse(bytes: &[u8]) -> Result<PointCloud> {
    let layout = header(bytes)?;
    let column = |names: &[&str]| layout.properties.iter().position(|(n, _)| names.contains(&n.as_str()));
    let need =
        |name: &str| column(&[name]).ok_or_else(|| Error::input(format!("the .ply has no vertex property \"{name}\"")));
    let xyz = [need("x")?, need("y")?, need("z")?];
    let rgb = [column(&["red", "r"]), column(&["green", "g"]), column(&["blue", "b"])];
    let time = column(&["time", "t"]);
    let white = |c: usize| layout.properties[c].1.white();
    let mut cloud = PointCloud::default();
    each_vertex(bytes, &layout, |row| {
        let point = xyz.map(|c| row[c]);
        let seen = time.map(|c| row[c]);
        if point.iter().chain(&seen).all(|v| v.is_finite()) {
            cloud.points.push(point);
            cloud.colors.push(rgb.map(|c| c.map_or(GREY, |c| (row[c] / white(c)).clamp(0.0, 1.0) as f32)));
            cloud.times.push(seen);
        }
    })?;
    // `clamp` keeps NaN; such a colour is replaced so that it cannot spread.
    cloud.colors.iter_mut().flatten().filter(|v| v.is_nan()).for_each(|v| *v = GREY);
    Ok(cloud)
}

fn each_vertex(bytes: &[u8], layout: &Layout, mut row: impl FnMut(&[f64])) -> Result<()> {
    let body = &bytes[layout.body..];
    let absurd = |holds: usize| {
        Error::input(format!("the header claims {} points, but the file holds {holds}: it is truncated", layout.count))
    };
    let mut values = vec![0.0; layout.properties.len()];
    if layout.binary {
        let stride: usize = layout.properties.iter().map(|(_, t)| t.bytes()).sum();
        if body.len() / stride < layout.count {
            return Err(absurd(body.len() / stride));
        }
        for record in body.chunks_exact(stride).take(layout.count) {
            let mut at = 0;
            for (value, (_, kind)) in values.iter_mut().zip(&layout.properties) {
                *value = kind.read(&record[at..]);
                at += kind.bytes();
            }
            row(&values);
        }
        return Ok(());
    }
    let text = std::str::from_utf8(body).map_err(|e| Error::input(format!("the ascii .ply is no text: {e}")))?;
    let mut words = text.split_ascii_whitespace();
    for i in 0..layout.count {
        for value in &mut values {
            let word = words.next().ok_or_else(|| absurd(i))?;
            *value = word.parse().map_err(|_| Error::input(format!("point {i} holds \"{word:.20}\", no number")))?;
        }
        row(&values);
    }
    Ok(())
}

fn header(bytes: &[u8]) -> Result<Layout> {
    let bad = |what: &str| Error::input(format!("the .ply header is damaged: {what}"));
    let mut layout = Layout { binary: false, count: 0, properties: Vec::new(), body: 0 };
    // Some(true) inside the vertex element, Some(false) inside a later one.
    let mut in_vertex = None;
    let mut format_seen = false;
    let head = &bytes[..bytes.len().min(MAX_HEADER)];
    for (number, line) in head.split_inclusive(|&b| b == b'\n').enumerate() {
        layout.body += line.len();
        let line = std::str::from_utf8(line).map_err(|_| bad("it is no text"))?;
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match (number, words.as_slice()) {
            (0, ["ply"]) => {}
            (0, _) => return Err(bad("the file does not start with \"ply\"")),
            (_, ["format", "ascii", _]) => format_seen = true,
            (_, ["format", "binary_little_endian", _]) => (format_seen, layout.binary) = (true, true),
            (_, ["format", other, ..]) => return Err(bad(&format!("the format {other:.30} is not read"))),
            (_, ["element", "vertex", count]) => {
                if in_vertex.is_some() {
                    return Err(bad("the vertices do not come first"));
                }
                in_vertex = Some(true);
                layout.count = count.parse().map_err(|_| bad(&format!("{count:.30} is no count of points")))?;
            }
            (_, ["element", ..]) => {
                if in_vertex.is_none() {
                    return Err(bad("the vertices do not come first"));
                }
                in_vertex = Some(false);
            }
            (_, ["property", "list", ..]) if in_vertex == Some(true) => return Err(bad("vertices hold a list")),
            (_, ["property", kind, name]) if in_vertex == Some(true) => {
                let kind = Scalar::parse(kind).ok_or_else(|| bad(&format!("the type {kind:.30} is not known")))?;
                layout.properties.push((name.to_string(), kind));
            }
            (_, ["end_header"]) => {
                return if format_seen && !layout.properties.is_empty() {
                    Ok(layout)
                } else {
                    Err(bad("it has no format or no vertex properties"))
                };
            }
            _ => {}
        }
    }
    Err(bad("it has no end"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ascii_and_binary_agree_whatever_the_order() {
        let ascii = "ply\nformat ascii 1.0\ncomment made up\nelement vertex 2\nproperty uchar red\n\
                     property uchar green\n\
                     property uchar blue\nproperty double x\nproperty float y\nproperty int z\nproperty float time\n\
                     end_header\n255 0 51 1.5 -2 3 0.5\n0 255 0 nan 0 0 0\n";
        let cloud = parse(ascii.as_bytes()).unwrap();
        assert_eq!((cloud.points.as_slice(), cloud.times[0]), (&[[1.5, -2.0, 3.0]][..], Some(0.5)));
        assert_eq!(cloud.colors, [[1.0, 0.0, 0.2]]);
        let mut binary = ascii[..ascii.find("255 0").unwrap()].replace("ascii", "binary_little_endian").into_bytes();
        for x in [1.5, f64::NAN] {
            binary.extend([255, 0, 51]);
            binary.extend(f64::to_le_bytes(x));
            binary.extend(f32::to_le_bytes(-2.0));
            binary.extend(i32::to_le_bytes(3));
            binary.extend(f32::to_le_bytes(0.5));
        }
        assert_eq!(parse(&binary).unwrap(), cloud);
        let message = parse(&binary[..binary.len() - 1]).unwrap_err().to_string();
        assert!(message.contains("claims 2 points") && message.contains("holds 1"), "{message}");
    }

    #[test]
    fn absurd_counts_are_refused_without_reserving() {
        for format in ["ascii", "binary_little_endian"] {
            let text = format!(
                "ply\nformat {format} 1.0\nelement vertex 18446744073709551615\nproperty float x\nproperty float y\n\
                 property float z\nend_header\n"
            );
            assert!(parse(text.as_bytes()).unwrap_err().to_string().contains("truncated"));
        }
        assert!(parse(b"ply\nformat ascii 1.0\n").is_err());
        assert!(parse(b"").is_err());
    }
}
