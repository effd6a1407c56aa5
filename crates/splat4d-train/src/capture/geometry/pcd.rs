//! Point Cloud Data of PCL: text, binary, and binary compressed. Source: the format's page of PCL 1.14; LZF as in liblzf.

use super::surface::{Sink, Surface};
use splat4d::{Error, Result};

/// Longest header that is accepted: eleven lines are usual.
const MAX_HEADER: usize = 1 << 14;
/// Bytes that a byte of LZF expands to, at most: three bytes give a run of 264.
const MAX_EXPANSION: usize = 100;

/// A column of the table.
#[derive(Clone, Copy, Debug)]
struct Field {
    kind: u8,
    size: usize,
    count: usize,
    /// First byte in a row.
    at: usize,
}

struct Header<'a> {
    names: Vec<&'a str>,
    fields: Vec<Field>,
    points: usize,
    data: &'a str,
    /// First byte of the table.
    body: usize,
}

fn damaged(what: impl Into<String>) -> Error {
    Error::input(what).remedy("Save the cloud again, for example with `pcl_convert_pcd_ascii_binary in.pcd out.pcd 1`")
}

/// Reads positions and colours (`rgb`, `rgba`, or `r g b`). The sensor's `VIEWPOINT` is not applied.
///
/// Errors: no x, y, z; fewer bytes or rows than the header claims; text that is not numbers.
pub(super) fn read(bytes: &[u8]) -> Result<Surface> {
    let header = Header::read(bytes)?;
    let find = |name: &str| header.names.iter().position(|n| n.eq_ignore_ascii_case(name));
    let all = |names: [&str; 3]| {
        let [a, b, c] = names.map(find);
        Some([a?, b?, c?])
    };
    let Some(xyz) = all(["x", "y", "z"]) else {
        return Err(damaged(format!("the cloud has no x, y and z, only {:.80}", header.names.join(" "))));
    };
    let (packed, apart) = (find("rgb").or(find("rgba")), all(["r", "g", "b"]));
    let stride: usize = header.fields.iter().map(|f| f.size * f.count).sum();
    let mut sink = Sink::new(header.points as u64, packed.is_some() || apart.is_some());
    let color = |value: &dyn Fn(usize) -> f64, bits: &dyn Fn(usize) -> u32| match (packed, apart) {
        (Some(f), _) => [16, 8, 0].map(|shift| (bits(f) >> shift & 255) as f32 / 255.0),
        (None, Some(f)) => f.map(|f| (value(f) / if header.fields[f].kind == b'F' { 1.0 } else { 255.0 }) as f32),
        (None, None) => [0.5; 3],
    };
    let body = &bytes[header.body..];
    if header.data == "ascii" {
        let text = std::str::from_utf8(body).map_err(|_| damaged("the points of a text file are not text"))?;
        let columns: usize = header.fields.iter().map(|f| f.count).sum();
        let firsts: Vec<usize> = header
            .fields
            .iter()
            .scan(0, |next, f| {
                *next += f.count;
                Some(*next - f.count)
            })
            .collect();
        let mut rows = text.lines().filter(|l| !l.trim().is_empty());
        let mut row = Vec::with_capacity(columns.min(MAX_HEADER));
        for i in 0..header.points {
            let Some(line) = rows.next() else {
                return Err(damaged(format!("the header claims {} points, the file has {i}", header.points)));
            };
            row.clear();
            row.extend(line.split_ascii_whitespace());
            if row.len() != columns {
                return Err(damaged(format!("expected {columns} values, found {}", row.len())).at(format!("point {i}")));
            }
            let mut wrong = None;
            let parsed = xyz.map(|f| {
                row[firsts[f]].parse::<f64>().unwrap_or_else(|_| {
                    wrong = Some(row[firsts[f]]);
                    0.0
                })
            });
            if let Some(word) = wrong {
                return Err(damaged(format!("`{word:.40}` is not a number")).at(format!("point {i}")));
            }
            let value = |f: usize| row[firsts[f]].parse::<f64>().unwrap_or(0.5);
            let bits = |f: usize| match header.fields[f].kind {
                b'F' => row[firsts[f]].parse::<f32>().unwrap_or(0.0).to_bits(),
                _ => row[firsts[f]].parse::<i64>().unwrap_or(0) as u32,
            };
            sink.push(parsed, color(&value, &bits));
        }
        return Ok(sink.finish());
    }
    let Some(needed) = header.points.checked_mul(stride) else {
        return Err(damaged(format!("the header claims {} points of {stride} bytes", header.points)));
    };
    let (unpacked, by_column);
    let table = match header.data {
        "binary" => {
            by_column = false;
            body
        }
        "binary_compressed" => {
            by_column = true;
            let size = |at: usize| Some(u32::from_le_bytes(*body.get(at..)?.first_chunk()?) as usize);
            let (Some(from), Some(to)) = (size(0), size(4)) else {
                return Err(damaged("the file ends before its compressed points"));
            };
            let packed = body.get(8..).and_then(|b| b.get(..from));
            let Some(packed) = packed.filter(|p| to <= p.len().saturating_mul(MAX_EXPANSION) && to >= needed) else {
                return Err(damaged(format!(
                    "{from} compressed bytes for {to} cannot hold {} points of {stride} bytes, or are cut short",
                    header.points
                )));
            };
            unpacked = lzf(packed, to).ok_or_else(|| damaged("the compressed points are damaged"))?;
            &unpacked[..]
        }
        other => return Err(damaged(format!("the encoding `{other:.30}` is not known"))),
    };
    if table.len() < needed {
        return Err(damaged(format!(
            "the header claims {} points of {stride} bytes, and {} bytes follow",
            header.points,
            table.len()
        )));
    }
    for i in 0..header.points {
        let at = |f: usize| {
            let field = &header.fields[f];
            match by_column {
                true => header.points * field.at + i * field.size * field.count,
                false => i * stride + field.at,
            }
        };
        let value = |f: usize| number(&table[at(f)..], header.fields[f]);
        let bits = |f: usize| match header.fields[f].size {
            4 => u32::from_le_bytes(*table[at(f)..].first_chunk().expect("the table holds all rows")),
            _ => value(f) as i64 as u32,
        };
        sink.push(xyz.map(value), color(&value, &bits));
    }
    Ok(sink.finish())
}

impl<'a> Header<'a> {
    fn read(bytes: &'a [u8]) -> Result<Self> {
        let head = &bytes[..bytes.len().min(MAX_HEADER)];
        let (mut names, mut fields, mut points) = (Vec::new(), Vec::<Field>::new(), None);
        let (mut sizes, mut kinds, mut counts): (Vec<usize>, Vec<u8>, Vec<usize>) = Default::default();
        let [mut width, mut height] = [None, Some(1)];
        let mut at = 0;
        loop {
            let rest = &head[at..];
            let Some(end) = rest.iter().position(|b| *b == b'\n') else {
                return Err(damaged("the header has no DATA line"));
            };
            let line = std::str::from_utf8(&rest[..end]).map_err(|_| damaged("the header is not text"))?.trim();
            at += end + 1;
            let mut words = line.split_ascii_whitespace();
            let key = words.next().unwrap_or_default();
            let numbers = |words: std::str::SplitAsciiWhitespace<'_>| -> Result<Vec<usize>> {
                let number = |w: &str| w.parse().map_err(|_| damaged(format!("`{w:.40}` is not a number")).at(key));
                words.map(number).collect()
            };
            match key {
                "FIELDS" | "COLUMNS" => names = words.collect(),
                "SIZE" => sizes = numbers(words)?,
                "TYPE" => kinds = words.map(|w| w.as_bytes()[0].to_ascii_uppercase()).collect(),
                "COUNT" => counts = numbers(words)?,
                "WIDTH" => width = numbers(words)?.first().copied(),
                "HEIGHT" => height = numbers(words)?.first().copied(),
                "POINTS" => points = numbers(words)?.first().copied(),
                "DATA" => {
                    let data = words.next().unwrap_or_default();
                    counts.resize(names.len(), 1);
                    if sizes.len() != names.len() || kinds.len() != names.len() {
                        return Err(damaged(format!(
                            "{} fields have {} sizes and {} types",
                            names.len(),
                            sizes.len(),
                            kinds.len()
                        )));
                    }
                    let mut next = 0usize;
                    for ((&size, &kind), &count) in sizes.iter().zip(&kinds).zip(&counts) {
                        let known = matches!((kind, size), (b'F', 4 | 8) | (b'I' | b'U', 1 | 2 | 4 | 8));
                        if !known || count > MAX_HEADER {
                            return Err(damaged(format!("a field of {count} times {size} bytes is not known")));
                        }
                        fields.push(Field { kind, size, count, at: next });
                        next += size * count;
                    }
                    let points = points.or_else(|| width.and_then(|w| w.checked_mul(height.unwrap_or(1))));
                    let points = points.ok_or_else(|| damaged("the header states no number of points"))?;
                    if points > bytes.len() && data != "binary_compressed" || points / MAX_EXPANSION > bytes.len() {
                        return Err(damaged(format!("the header claims {points} points in {} bytes", bytes.len())));
                    }
                    return Ok(Self { names, fields, points, data, body: at });
                }
                _ => {}
            }
        }
    }
}

fn number(bytes: &[u8], field: Field) -> f64 {
    let n = bytes[..field.size].iter().rev().fold(0u64, |n, b| n << 8 | u64::from(*b));
    let unused = 64 - 8 * field.size as u32;
    match field.kind {
        b'F' if field.size == 4 => f64::from(f32::from_bits(n as u32)),
        b'F' => f64::from_bits(n),
        b'I' => ((n << unused) as i64 >> unused) as f64,
        _ => n as f64,
    }
}

/// Expands LZF to exactly `size` bytes; `None`: damage.
fn lzf(mut packed: &[u8], size: usize) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(size);
    while let Some((&control, rest)) = packed.split_first() {
        packed = rest;
        if control < 32 {
            let literal = packed.get(..usize::from(control) + 1)?;
            out.extend_from_slice(literal);
            packed = &packed[literal.len()..];
        } else {
            let mut length = usize::from(control >> 5);
            if length == 7 {
                length += usize::from(*packed.first()?);
                packed = &packed[1..];
            }
            let back = (usize::from(control & 31) << 8 | usize::from(*packed.first()?)) + 1;
            packed = &packed[1..];
            let from = out.len().checked_sub(back)?;
            // It may repeat what it has just written.
            for i in from..from + length + 2 {
                out.push(out[i]);
            }
        }
        if out.len() > size {
            return None;
        }
    }
    (out.len() == size).then_some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(fields: &str, points: usize, data: &str) -> String {
        format!(
            "# .PCD v0.7 - Point Cloud Data\nVERSION 0.7\n{fields}WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
        )
    }

    const XYZRGB: &str = "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n";

    #[test]
    fn text_binary_and_compressed_files_hold_the_same_points() {
        let rows = [([1.5f32, -2.0, 3.0], 0x00ff_0033u32), ([0.25, 0.0, -1.0], 0x0000_ff00)];
        let expected = Surface {
            points: vec![[1.5, -2.0, 3.0], [0.25, 0.0, -1.0]],
            colors: vec![[1.0, 0.0, 0.2], [0.0, 1.0, 0.0]],
            ..Surface::default()
        };
        let mut binary = header(XYZRGB, 2, "binary").into_bytes();
        for (p, c) in rows {
            p.iter().for_each(|v| binary.extend(v.to_le_bytes()));
            binary.extend(c.to_le_bytes());
        }
        assert_eq!(read(&binary).unwrap(), expected);
        // Column by column, as one literal and a run: the last two zero bytes repeat what is before.
        let columns: Vec<u8> = (0..4)
            .flat_map(|k| rows.map(|(p, c)| if k < 3 { p[k].to_bits() } else { c }))
            .flat_map(u32::to_le_bytes)
            .collect();
        let mut packed = Vec::new();
        columns.chunks(32).for_each(|c| {
            packed.push(c.len() as u8 - 1);
            packed.extend(c);
        });
        let mut compressed = header(XYZRGB, 2, "binary_compressed").into_bytes();
        compressed.extend((packed.len() as u32).to_le_bytes());
        compressed.extend((columns.len() as u32).to_le_bytes());
        compressed.extend(&packed);
        assert_eq!(read(&compressed).unwrap(), expected);
        let text = header("FIELDS x y z r g b\nSIZE 8 4 4 1 1 1\nTYPE F F F U U U\n", 2, "ascii")
            + "1.5 -2 3 255 0 51\n0.25 0 -1 0 255 0\n";
        assert_eq!(read(text.as_bytes()).unwrap(), expected);
        let nan = text.replace("0.25", "nan");
        let read = read(nan.as_bytes()).unwrap();
        assert_eq!((read.points.len(), read.left_out), (1, 1), "organised clouds have holes");
    }

    #[test]
    fn lzf_repeats_what_it_has_written() {
        // "abc", then nine bytes from three back.
        assert_eq!(lzf(&[2, b'a', b'b', b'c', 7 << 5, 0, 2], 12).unwrap(), b"abcabcabcabc");
        assert_eq!(lzf(&[2, b'a', b'b', b'c', 7 << 5, 0, 3], 12), None, "before the start");
        assert_eq!(lzf(&[2, b'a'], 3), None);
        assert_eq!(lzf(&[0, b'a'], 2), None);
    }

    #[test]
    fn damaged_headers_and_tables_are_errors() {
        let error = |bytes: &[u8]| read(bytes).unwrap_err().to_string();
        let two = header(XYZRGB, 2, "binary");
        assert!(error(two.as_bytes()).contains("claims 2 points of 16 bytes"));
        assert!(error(header(XYZRGB, usize::MAX, "binary").as_bytes()).contains("points in"));
        assert!(error(header("FIELDS x y\nSIZE 4 4\nTYPE F F\n", 0, "ascii").as_bytes()).contains("no x, y and z"));
        assert!(error((header(XYZRGB, 2, "ascii") + "1 2 3 4\n").as_bytes()).contains("the file has 1"));
        assert!(error((header(XYZRGB, 1, "ascii") + "1 2 a 4\n").as_bytes()).contains("`a` is not a number"));
        assert!(error((header(XYZRGB, 1, "ascii") + "1 2 4\n").as_bytes()).contains("expected 4 values"));
        assert!(error(header(XYZRGB, 1, "zip").as_bytes()).contains("`zip`"));
        assert!(error(b"# .PCD v0.7\n").contains("no DATA"));
        assert!(error(header("FIELDS x y z\nSIZE 4 4\nTYPE F F F\n", 1, "binary").as_bytes()).contains("2 sizes"));
    }
}
