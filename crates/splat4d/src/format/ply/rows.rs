//! The rows of one element, however they are written.

use super::header::{Element, Encoding, Header, Kind, Scalar, broken};
use crate::Result;

/// The rows of an element; every row is known to exist.
pub(super) struct Rows<'a> {
    count: usize,
    body: Body<'a>,
    /// The rest of the file.
    after: &'a [u8],
}

enum Body<'a> {
    /// Binary rows of one size, read in place: for every property its type and its offset in the row.
    Binary { bytes: &'a [u8], stride: usize, big: bool, fields: Vec<(Scalar, usize)> },
    /// Text, and rows with lists: all numbers widened, a list being one meaningless number.
    Wide { values: Vec<f64>, width: usize },
}

impl<'a> Rows<'a> {
    /// All bytes behind the rows.
    pub(super) fn after(&self) -> &'a [u8] {
        self.after
    }

    /// Number of rows.
    pub(super) fn len(&self) -> usize {
        self.count
    }

    /// The numbers of property `property` in rows `first..`, rounded to f32.
    #[inline]
    pub(super) fn read(&self, property: usize, first: usize, out: &mut [f32]) {
        assert!(first + out.len() <= self.count, "rows past the end of an element were requested");
        match &self.body {
            Body::Binary { bytes, stride, big, fields } => {
                let (scalar, offset) = fields[property];
                // A row has bytes, or there would be no property to read.
                let rows = bytes[first * stride..].chunks_exact(*stride);
                let rows = rows.map(|row| &row[offset..]).zip(out);
                match (scalar, big) {
                    (Scalar::F32, false) => rows.for_each(|(b, x)| *x = f32::from_le_bytes(take(b))),
                    (scalar, big) => rows.for_each(|(b, x)| *x = widen(scalar, *big, b) as f32),
                }
            }
            Body::Wide { values, width } => {
                let rows = values[first * width..].chunks_exact(*width);
                rows.zip(out).for_each(|(row, x)| *x = row[property] as f32);
            }
        }
    }

    /// One number, exact.
    pub(super) fn get(&self, row: usize, property: usize) -> f64 {
        match &self.body {
            Body::Binary { bytes, stride, big, fields } => {
                let (scalar, offset) = fields[property];
                widen(scalar, *big, &bytes[row * stride + offset..])
            }
            Body::Wide { values, width } => values[row * width + property],
        }
    }
}

/// Walks through the body and returns the rows of the `wanted` elements (in that order; `None` where the file has no
/// such element). Stops after the last requested one: what follows is ignored.
pub(super) fn find<'a, const N: usize>(
    header: &Header,
    bytes: &'a [u8],
    wanted: [&str; N],
) -> Result<[Option<Rows<'a>>; N]> {
    let mut out = [const { None }; N];
    let last = header.elements.iter().rposition(|e| wanted.contains(&e.name.as_str()));
    let mut rest = &bytes[header.body..];
    for element in header.elements.iter().take(last.map_or(0, |i| i + 1)) {
        let keep = wanted.iter().position(|w| *w == element.name);
        let rows = element_rows(element, header.encoding, &mut rest, keep.is_some());
        let rows = rows.map_err(|e| e.at(format_args!("element `{}`", element.name)))?;
        if let Some(i) = keep {
            out[i] = Some(rows);
        }
    }
    Ok(out)
}

/// Names of the element of faces, and of its list of corners.
const FACE: &str = "face";
const CORNERS: [&str; 2] = ["vertex_indices", "vertex_index"];

/// The triangles of a mesh of `vertices` points; none in a file without faces.
///
/// Errors: truncated; a corner that is not one of the points.
pub(super) fn triangles(header: &Header, bytes: &[u8], vertices: usize) -> Result<Vec<[u32; 3]>> {
    let is_list = |k: &Kind| matches!(k, Kind::List(..));
    let has_corners = |e: &Element| e.properties.iter().any(|p| CORNERS.contains(&p.name.as_str()) && is_list(&p.kind));
    let Some(at) = header.elements.iter().position(|e| e.name == FACE && has_corners(e)) else {
        return Ok(Vec::new());
    };
    let mut rest = &bytes[header.body..];
    for element in &header.elements[..at] {
        element_rows(element, header.encoding, &mut rest, false)
            .map_err(|e| e.at(format_args!("element `{}`", element.name)))?;
    }
    let (face, big) = (&header.elements[at], header.encoding == Encoding::Big);
    let mut out = Vec::new();
    let mut corners: Vec<u32> = Vec::new();
    for row in 0..face.count {
        let place = |e: crate::Error| e.at(format_args!("element `{FACE}`: row {row}"));
        let mut next = |scalar| match header.encoding {
            Encoding::Ascii => word(&mut rest),
            _ => number(scalar, big, &mut rest),
        };
        for property in &face.properties {
            let Kind::List(length, item) = property.kind else {
                let Kind::Scalar(scalar) = property.kind else { unreachable!("a property is a number or a list") };
                next(scalar).map_err(place)?;
                continue;
            };
            let length = next(length).map_err(place)?;
            if !(length >= 0.0 && length.fract() == 0.0) {
                return Err(place(broken(format!("a list has the length {length}"))));
            }
            let wanted = CORNERS.contains(&property.name.as_str());
            corners.clear();
            // Every item takes bytes or ends the file, so that a false length cannot keep us here.
            for _ in 0..length as u64 {
                let corner = next(item).map_err(place)?;
                if !wanted {
                    continue;
                }
                if !(corner >= 0.0 && corner < vertices as f64) {
                    let what = format!("a face has the corner {corner}, and there are {vertices} points");
                    return Err(place(broken(what)));
                }
                corners.push(corner as u32);
            }
            out.extend(corners.windows(2).skip(1).map(|w| [corners[0], w[0], w[1]]));
        }
    }
    Ok(out)
}

/// The rows of the element at the front of `rest`, which is moved behind them; a `Wide` body is empty unless `keep`.
fn element_rows<'a>(element: &Element, encoding: Encoding, rest: &mut &'a [u8], keep: bool) -> Result<Rows<'a>> {
    let count = element.count;
    if element.properties.is_empty() {
        // Rows of nothing have no bytes, in whatever number.
        return Ok(Rows { count, body: Body::Wide { values: Vec::new(), width: 0 }, after: rest });
    }
    let mut fields = Vec::with_capacity(element.properties.len());
    let mut stride = 0;
    for property in &element.properties {
        let (Kind::Scalar(scalar) | Kind::List(scalar, _)) = property.kind;
        fields.push((scalar, stride));
        stride += scalar.size();
    }
    // The fewest bytes a row can have: a list at least has its length, and a word of text its separator.
    let least = if encoding == Encoding::Ascii { 2 * element.properties.len() } else { stride };
    // The last word of a text file needs no separator.
    let have = if encoding == Encoding::Ascii { rest.len() + 1 } else { rest.len() };
    if count.checked_mul(least).is_none_or(|bytes| bytes > have) {
        return Err(broken(format!(
            "the header claims {count} rows of at least {least} bytes, but only {} bytes follow",
            rest.len()
        )));
    }
    let has_lists = element.properties.iter().any(|p| matches!(p.kind, Kind::List(..)));
    let big = encoding == Encoding::Big;
    if encoding != Encoding::Ascii && !has_lists {
        let (bytes, tail) = rest.split_at(count * stride);
        *rest = tail;
        return Ok(Rows { count, body: Body::Binary { bytes, stride, big, fields }, after: tail });
    }
    let width = element.properties.len();
    let mut values = Vec::with_capacity(if keep { count * width } else { 0 });
    for row in 0..count {
        for property in &element.properties {
            let mut next = |scalar| {
                let value = if encoding == Encoding::Ascii { word(rest) } else { number(scalar, big, rest) };
                value.map_err(|e| e.at(format_args!("row {row}, property `{}`", property.name)))
            };
            let value = match property.kind {
                Kind::Scalar(scalar) => next(scalar)?,
                Kind::List(length, item) => {
                    let length = next(length)?;
                    if !(length >= 0.0 && length.fract() == 0.0) {
                        return Err(broken(format!("a list has the length {length}")).at(format_args!("row {row}")));
                    }
                    // Every item takes bytes or ends the file, so that a false length cannot keep us here.
                    for _ in 0..length as u64 {
                        next(item)?;
                    }
                    length
                }
            };
            if keep {
                values.push(value);
            }
        }
    }
    Ok(Rows { count, body: Body::Wide { values, width }, after: rest })
}

/// The next number of a text body.
fn word(rest: &mut &[u8]) -> Result<f64> {
    let text = rest.trim_ascii_start();
    let end = text.iter().position(u8::is_ascii_whitespace).unwrap_or(text.len());
    let (word, tail) = text.split_at(end);
    *rest = tail;
    if word.is_empty() {
        return Err(broken("the file ends in the middle"));
    }
    // A number of more characters than any real one is not quoted back at full length.
    let quoted = &word[..word.len().min(40)];
    std::str::from_utf8(word)
        .ok()
        .and_then(|w| w.parse().ok())
        .ok_or_else(|| broken(format!("`{}` is not a number", String::from_utf8_lossy(quoted))))
}

/// The next number of a binary body.
fn number(scalar: Scalar, big: bool, rest: &mut &[u8]) -> Result<f64> {
    let Some((number, tail)) = rest.split_at_checked(scalar.size()) else {
        return Err(broken("the file ends in the middle"));
    };
    *rest = tail;
    Ok(widen(scalar, big, number))
}

/// The first N bytes. Panics: there are fewer, which `element_rows` has excluded.
#[inline(always)]
fn take<const N: usize>(b: &[u8]) -> [u8; N] {
    *b.first_chunk().expect("a row holds all its fields")
}

#[inline(always)]
fn widen(scalar: Scalar, big: bool, b: &[u8]) -> f64 {
    macro_rules! of {
        ($t:ty) => {
            f64::from(if big { <$t>::from_be_bytes(take(b)) } else { <$t>::from_le_bytes(take(b)) })
        };
    }
    match scalar {
        Scalar::I8 => of!(i8),
        Scalar::U8 => of!(u8),
        Scalar::I16 => of!(i16),
        Scalar::U16 => of!(u16),
        Scalar::I32 => of!(i32),
        Scalar::U32 => of!(u32),
        Scalar::F32 => of!(f32),
        Scalar::F64 => of!(f64),
    }
}
