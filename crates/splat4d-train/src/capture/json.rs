//! JSON with named places: every error states which key of which file is wrong and, for a misspelt key, what was meant.

use super::account::first_names;
use super::convention::Poses;
use crate::files;
use crate::text;
use serde_json::Value;
use splat4d::{Error, Result};
use std::path::Path;

/// Longest metadata file that is read, bytes: a long capture of a large rig stays far below it.
const MAX_BYTES: u64 = 512 << 20;

/// Reads a text or binary file of at most [`MAX_BYTES`].
pub(super) fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    let length = std::fs::metadata(path).map_or(0, |m| m.len());
    if length > MAX_BYTES {
        return Err(Error::input(format!("is {length} bytes long, more than the {MAX_BYTES} that are accepted"))
            .at(path.display())
            .remedy("Check that this is the right file, or split the take."));
    }
    files::read(path)
}

/// Reads and parses a JSON file.
pub(super) fn read(path: &Path) -> Result<Value> {
    let bytes = read_bytes(path)?;
    let text = text::decode(&bytes).map_err(|e| e.at(path.display()))?;
    serde_json::from_str(&text).map_err(|e| {
        let remedy = if ["NaN", "Infinity"].iter().any(|word| text.contains(word)) {
            "It holds NaN or Infinity, which JSON does not allow: calibrate that camera again or leave it out."
        } else if text.lines().any(|line| ["//", "/*", "#"].iter().any(|mark| line.trim_start().starts_with(mark))) {
            "JSON has no comments: remove them (lines that begin with //, /* or #)."
        } else if e.is_eof() {
            "The file looks truncated: copy or export it again."
        } else {
            "Correct the file there, or export it again."
        };
        Error::input(format!("is not valid JSON: {e}")).at(path.display()).remedy(remedy)
    })
}

/// A value and the path that leads to it (`cameras[3].fx`).
#[derive(Clone, Debug)]
pub(super) struct Node<'a> {
    /// The value itself.
    pub value: &'a Value,
    path: String,
}

impl<'a> Node<'a> {
    /// The top of a document.
    pub(crate) fn root(value: &'a Value) -> Self {
        Self { value, path: String::new() }
    }

    /// An error at this place: `what` is a clause without a final full stop.
    pub(crate) fn error(&self, what: impl Into<String>) -> Error {
        self.at(Error::input(what))
    }

    /// Puts this place in front of an error from elsewhere.
    pub(crate) fn at(&self, error: Error) -> Error {
        if self.path.is_empty() { error } else { error.at(&self.path) }
    }

    fn wrong(&self, expected: &str) -> Error {
        let mut found = self.value.to_string();
        if found.chars().count() > 40 {
            found = found.chars().take(37).collect::<String>() + "...";
        }
        self.error(format!("expected {expected}, found {found}"))
            .remedy("Correct that value; docs/capture-format.md lists the accepted layouts.")
    }

    /// The value of `key`; `None` where it is missing or null. An error unless this is an object.
    pub(crate) fn opt(&self, key: &str) -> Result<Option<Node<'a>>> {
        let object = self.value.as_object().ok_or_else(|| self.wrong("an object { ... }"))?;
        let path = if self.path.is_empty() { key.to_string() } else { format!("{}.{key}", self.path) };
        Ok(object.get(key).filter(|v| !v.is_null()).map(|value| Node { value, path }))
    }

    /// The value of `key`, which must be there.
    pub(crate) fn get(&self, key: &str) -> Result<Node<'a>> {
        self.opt(key)?.ok_or_else(|| self.error(format!("the key \"{key}\" is missing")).remedy("Add it."))
    }

    /// [`get`](Self::get), whose error lists the keys that are there.
    pub(crate) fn needed(&self, key: &str) -> Result<Node<'a>> {
        self.opt(key)?.ok_or_else(|| {
            let keys: Vec<&str> = self.value.as_object().into_iter().flatten().map(|(k, _)| k.as_str()).collect();
            let keys = first_names(&keys);
            self.error(format!("the key \"{key}\" is missing")).remedy(format!("Add it; keys there are {keys:.200}."))
        })
    }

    /// The elements of an array.
    pub(crate) fn list(&self) -> Result<Vec<Node<'a>>> {
        let array = self.value.as_array().ok_or_else(|| self.wrong("a list [ ... ]"))?;
        Ok(array.iter().enumerate().map(|(i, value)| Node { value, path: format!("{}[{i}]", self.path) }).collect())
    }

    /// A finite number.
    pub(crate) fn number(&self) -> Result<f64> {
        self.value.as_f64().filter(|x| x.is_finite()).ok_or_else(|| self.wrong("a finite number"))
    }

    /// A whole number ≥ 0 (some tools write 640.0).
    pub(crate) fn count(&self) -> Result<usize> {
        let x = self.number()?;
        if x < 0.0 || x.fract() != 0.0 || x > 9e15 {
            return Err(self.wrong("a whole number that is not negative"));
        }
        Ok(x as usize)
    }

    /// A string.
    pub(crate) fn text(&self) -> Result<&'a str> {
        self.value.as_str().ok_or_else(|| self.wrong("a text \"...\""))
    }

    /// Exactly N numbers.
    pub(crate) fn numbers<const N: usize>(&self) -> Result<[f64; N]> {
        let list = self.value.as_array().filter(|l| l.len() == N);
        let list = list.ok_or_else(|| self.wrong(&format!("a list of {N} numbers")))?;
        let mut out = [0.0; N];
        for (slot, value) in out.iter_mut().zip(list) {
            *slot = value.as_f64().filter(|x| x.is_finite()).ok_or_else(|| self.wrong("finite numbers"))?;
        }
        Ok(out)
    }

    /// A row-major matrix of `N` columns and at least `rows` rows (a fourth row is dropped by the caller).
    fn rows<const N: usize>(&self, rows: std::ops::RangeInclusive<usize>) -> Result<Vec<[f64; N]>> {
        let list = self.value.as_array().filter(|l| rows.contains(&l.len()));
        let shape = format!("a {}x{N} matrix as a list of rows", rows.end());
        let list = list.ok_or_else(|| self.wrong(&shape))?;
        let mut out = Vec::with_capacity(list.len());
        for row in list {
            let row = row.as_array().filter(|r| r.len() == N).ok_or_else(|| self.wrong(&shape))?;
            let mut values = [0.0; N];
            for (slot, value) in values.iter_mut().zip(row) {
                *slot = value.as_f64().filter(|x| x.is_finite()).ok_or_else(|| {
                    self.error("the matrix contains a value that is not finite")
                        .remedy("Calibrate that camera again or leave it out.")
                })?;
            }
            out.push(values);
        }
        Ok(out)
    }

    /// A 3x3 matrix.
    pub(crate) fn matrix3(&self) -> Result<[[f64; 3]; 3]> {
        let rows = self.rows::<3>(3..=3)?;
        Ok([rows[0], rows[1], rows[2]])
    }

    /// A 4x4 matrix, or the upper 3x4 of one.
    pub(crate) fn matrix4(&self) -> Result<[[f64; 4]; 4]> {
        self.pose4(Poses::STATED)
    }

    /// The matrix of a pose. One that is written column by column has its translation in the last row: it is moved to
    /// the last column where `poses` specify it, which leaves the rotation transposed.
    pub(crate) fn pose4(&self, poses: Poses) -> Result<[[f64; 4]; 4]> {
        const LAST: [f64; 4] = [0.0, 0.0, 0.0, 1.0];
        let mut rows = self.rows::<4>(3..=4)?;
        if rows.get(3).is_some_and(|last| *last != LAST) {
            let by_columns = (0..4).all(|i| rows[i][3] == LAST[i]);
            if !(by_columns && poses.transposed) {
                let error = self.error("the last row of the pose is not 0 0 0 1");
                return Err(error.remedy(match by_columns {
                    true => {
                        "It is written column by column, with its translation in the last row: use --poses transposed."
                    }
                    false => "Write poses row by row: a transposed matrix has its translation there.",
                }));
            }
            (0..3).for_each(|i| rows[i][3] = rows[3][i]);
        }
        Ok([rows[0], rows[1], rows[2], LAST])
    }

    /// An error for every key that is not in `known`, with the nearest known one.
    pub(crate) fn only(&self, known: &[&str]) -> Result<()> {
        let object = self.value.as_object().ok_or_else(|| self.wrong("an object { ... }"))?;
        match object.keys().find(|key| !known.contains(&key.as_str())) {
            None => Ok(()),
            Some(key) => Err(unknown(self, key, known)),
        }
    }
}

fn unknown(node: &Node<'_>, key: &str, known: &[&str]) -> Error {
    let remedy = match nearest(key, known) {
        Some(near) => format!("Did you mean \"{near}\"?"),
        None => format!("Known keys here: {}.", known.join(", ")),
    };
    node.error(format!("unknown key \"{key}\"")).remedy(remedy)
}

/// The candidate with the smallest edit distance to `word`, if that is at most a third of its length (and ≥ 2 edits).
pub(super) fn nearest<'a>(word: &str, candidates: &[&'a str]) -> Option<&'a str> {
    // A hostile key may be megabytes long; nothing that long is a slip of the finger.
    let word: Vec<char> = word.chars().take(64).flat_map(char::to_lowercase).collect();
    let best = candidates.iter().map(|c| (edits(&word, c), *c)).min()?;
    (best.0 <= (word.len() / 3).max(2)).then_some(best.1)
}

/// Levenshtein distance.
fn edits(a: &[char], b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.iter().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let substituted = diagonal + usize::from(x != y);
            diagonal = row[j + 1];
            row[j + 1] = substituted.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn errors_name_the_place_and_the_nearest_key() {
        let value = json!({"cameras": [{"fx": 1.0}, {"fx": "wide", "widht": 3}]});
        let cameras = Node::root(&value).get("cameras").unwrap().list().unwrap();
        let message = cameras[1].get("fx").unwrap().number().unwrap_err().to_string();
        assert!(message.contains("cameras[1].fx") && message.contains("\"wide\""), "{message}");
        let message = cameras[1].only(&["fx", "width", "height"]).unwrap_err().to_string();
        assert!(message.contains("widht") && message.contains("Did you mean \"width\"?"), "{message}");
        assert!(nearest("zzzzzz", &["width"]).is_none());
        assert!(cameras[0].get("fy").unwrap_err().to_string().contains("\"fy\" is missing"));
    }
}
