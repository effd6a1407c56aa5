//! [`Rows`]: a selection of rows of a table.

/// Which rows of a table are meant. Output is compact: output row j belongs to row `ids[j]`.
#[derive(Clone, Copy, Debug)]
pub enum Rows<'a> {
    /// Every row.
    All,
    /// These, strictly increasing.
    Some(&'a [u32]),
}

impl Rows<'_> {
    /// How many rows, of a table that has `total`.
    pub(crate) fn len(&self, total: usize) -> usize {
        match self {
            Rows::All => total,
            Rows::Some(ids) => ids.len(),
        }
    }

    /// The row behind output row j.
    #[inline(always)]
    pub fn id(&self, j: usize) -> usize {
        match self {
            Rows::All => j,
            Rows::Some(ids) => ids[j] as usize,
        }
    }
}
