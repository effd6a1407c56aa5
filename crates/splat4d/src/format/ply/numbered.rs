//! Properties with numbers in their names, which other programs add to Gaussians.

use super::header::{Header, broken};
use super::rows;
use crate::Result;

/// The numbers of `{prefix}0`, `{prefix}1` and so on, as many as there are: row-major, and how many a row has.
///
/// Errors: not a PLY file, truncated.
pub(in crate::format) fn numbered(bytes: &[u8], prefix: &str) -> Result<(Vec<f32>, usize)> {
    let header = Header::read(bytes)?;
    let vertex = header.elements.iter().find(|e| e.name == "vertex");
    let vertex = vertex.ok_or_else(|| broken("the file has no element `vertex`"))?;
    let columns: Vec<usize> = (0..).map_while(|i| vertex.find(&format!("{prefix}{i}"))).collect();
    let [rows] = rows::find(&header, bytes, ["vertex"])?;
    let rows = rows.expect("the element was found above");
    let numbers = (0..rows.len()).flat_map(|row| columns.iter().map(move |c| (row, *c)));
    Ok((numbers.map(|(row, c)| rows.get(row, c) as f32).collect(), columns.len()))
}
