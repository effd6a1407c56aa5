//! [`Params`]: all learnable state of one layer; [`Grads`]: the same shape; [`RowEdit`]: the one way rows change.

use super::table::{Column, Table};
use crate::math::Real;
use crate::{Error, Result};

/// Meaning of a table's rows; row edits of a space reach every table of that space.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Space {
    /// Not edited by row: network weights, grids, global state.
    Fixed,
    /// A row per Gaussian.
    Gaussians,
    /// A row per control node.
    Nodes,
}

/// Origin of a new row. All but `Kept` start with zero moments and statistics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Born {
    /// The row itself.
    Kept,
    /// A copy next to its parent.
    Clone,
    /// One of the parts of its parent.
    Split,
    /// A row moved onto another.
    Moved,
}

/// New row j starts as a copy of old row `parent[j]`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RowEdit {
    /// Which tables change.
    pub space: Space,
    /// For every new row, the old row it copies.
    pub parent: Vec<u32>,
    /// The origin of every new row.
    pub born: Vec<Born>,
}

impl RowEdit {
    /// Every row stays where it is.
    pub fn identity(space: Space, rows: usize) -> Self {
        Self { space, parent: (0..rows as u32).collect(), born: vec![Born::Kept; rows] }
    }

    /// Only the rows for which `keep` holds.
    pub fn prune(space: Space, keep: impl Iterator<Item = bool>) -> Self {
        let parent: Vec<u32> = keep.enumerate().filter(|(_, k)| *k).map(|(i, _)| i as u32).collect();
        let born = vec![Born::Kept; parent.len()];
        Self { space, parent, born }
    }

    /// Appends a row.
    pub fn push(&mut self, parent: u32, born: Born) {
        self.parent.push(parent);
        self.born.push(born);
    }

    /// Rows after the edit.
    pub fn len(&self) -> usize {
        self.parent.len()
    }

    /// Whether no row is left.
    pub fn is_empty(&self) -> bool {
        self.parent.is_empty()
    }
}

/// Names a table of a [`Params`]; gradients and moments share it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Key(pub u32);

/// `means` 3, `quats` 4 (wxyz, raw), `log_scales` 3, `opacity_logits` 1.
pub const GEOMETRY: Key = Key(0);
/// `sh` 3·K, coefficient-major: coefficient k of channel c is column 3k + c.
pub const SH: Key = Key(1);
/// The lifespan envelope's columns, none for a layer whose Gaussians have infinite lifespans.
pub const LIFE: Key = Key(2);

/// Columns of [`GEOMETRY`].
pub(crate) const GEOMETRY_COLUMNS: [(&str, usize); 4] =
    [("means", 3), ("quats", 4), ("log_scales", 3), ("opacity_logits", 1)];
/// First column of the quaternion in [`GEOMETRY`].
pub const QUAT: usize = 3;
/// First column of the log scales in [`GEOMETRY`].
pub const LOG_SCALE: usize = 7;
/// Column of the opacity logit in [`GEOMETRY`].
pub const OPACITY: usize = 10;

/// Description of a table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParamInfo {
    /// Unique in its layer; the columns' names are what files show.
    pub name: String,
    /// Meaning of its rows.
    pub space: Space,
    /// A frame number where the table belongs to one frame; a page follows row edits too.
    pub page: Option<u32>,
    /// Whether an optimiser may change it.
    pub trainable: bool,
}

/// An array from a file, to be claimed by [`Params::entry`].
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedArray {
    /// Column group's name.
    pub name: String,
    /// Rows.
    pub rows: usize,
    /// Numbers per row.
    pub width: usize,
    /// Row-major.
    pub data: Vec<f32>,
}

/// Name of the page of frame `frame` of a table or column group called `name`.
pub fn page_name(name: &str, frame: u32) -> String {
    format!("{name}@{frame}")
}

/// All learnable state of one layer.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Params<F = f32> {
    infos: Vec<ParamInfo>,
    tables: Vec<Table<F>>,
    loaded: Vec<LoadedArray>,
}

impl<F: Real> Params<F> {
    /// `rows` Gaussians with `sh_coefficients` (K) spherical-harmonic coefficients and the given life columns, all
    /// zero.
    pub fn new(rows: usize, sh_coefficients: usize, life: &[(&'static str, usize)]) -> Self {
        Self::build(Vec::new(), rows, sh_coefficients, life).expect("without loaded arrays nothing can mismatch")
    }

    /// As [`new`](Self::new), filled from loaded arrays where the names match; the rest waits for
    /// [`entry`](Self::entry).
    pub fn build(
        loaded: Vec<LoadedArray>,
        rows: usize,
        sh_coefficients: usize,
        life: &[(&'static str, usize)],
    ) -> Result<Self> {
        let mut p = Self { infos: Vec::new(), tables: Vec::new(), loaded };
        p.entry("geometry", Space::Gaussians, &GEOMETRY_COLUMNS, rows, |_| {})?;
        p.entry("sh", Space::Gaussians, &[("sh", 3 * sh_coefficients)], rows, |_| {})?;
        p.entry("life", Space::Gaussians, life, rows, |_| {})?;
        Ok(p)
    }

    /// The table of that name: the loaded arrays with its columns' names if there are any, else a new table that `init`
    /// fills (from zeros). One constructor serves start and load.
    ///
    /// Errors: only some of the columns were loaded, or with another shape.
    pub fn entry(
        &mut self,
        name: &str,
        space: Space,
        columns: &[(&'static str, usize)],
        rows: usize,
        init: impl FnOnce(&mut Table<F>),
    ) -> Result<Key> {
        let columns = columns.iter().map(|&(column, width)| Column { name: column.into(), width }).collect();
        self.claim(name.to_owned(), space, columns, rows, init)
    }

    /// One frame's table of a model that has parameters per frame: as [`entry`](Self::entry), but the table is called
    /// `name@frame` and its column groups likewise, so that learnable groups and files can name every page.
    pub fn page(
        &mut self,
        name: &str,
        frame: u32,
        space: Space,
        columns: &[(&str, usize)],
        rows: usize,
        init: impl FnOnce(&mut Table<F>),
    ) -> Result<Key> {
        let columns =
            columns.iter().map(|(c, width)| Column { name: page_name(c, frame).into(), width: *width }).collect();
        let key = self.claim(page_name(name, frame), space, columns, rows, init)?;
        self.info_mut(key).page = Some(frame);
        Ok(key)
    }

    /// A `Fixed` table of one column of `numbers` rows, which are stored contiguously: a weight, a grid. The table and
    /// its column group share the name.
    ///
    /// Errors: the loaded array has another shape.
    pub fn array(&mut self, name: &str, numbers: usize, init: impl FnOnce(&mut [F])) -> Result<Key> {
        let column = vec![Column { name: name.to_owned().into(), width: 1 }];
        self.claim(name.to_owned(), Space::Fixed, column, numbers, |table| init(&mut table.data_mut()[..numbers]))
    }

    fn claim(
        &mut self,
        name: String,
        space: Space,
        columns: Vec<Column>,
        rows: usize,
        init: impl FnOnce(&mut Table<F>),
    ) -> Result<Key> {
        assert!(self.find(&name).is_none(), "a layer has one table called {name}");
        let mut table = Table::with_columns(columns, rows);
        let mut found = 0;
        let mut first = 0;
        for Column { name: column, width } in table.columns().to_vec() {
            if let Some(i) = self.loaded.iter().position(|a| a.name == column) {
                let a = self.loaded.swap_remove(i);
                if a.rows != rows || a.width != width {
                    return Err(Error::input(format!(
                        "array `{column}` has shape [{}, {}], but [{rows}, {width}] is needed",
                        a.rows, a.width
                    ))
                    .remedy("The file does not fit its own metadata; export it again"));
                }
                let values: Vec<F> = a.data.iter().map(|&x| F::of(f64::from(x))).collect();
                table.column_from_rows(first, width, &values);
                found += 1;
            }
            first += width;
        }
        if found == 0 {
            init(&mut table);
        } else if found < table.columns().len() {
            return Err(Error::input(format!("table `{name}` is incomplete: some of its arrays are missing"))
                .remedy("The file is damaged or was written by another program; export it again"));
        }
        self.infos.push(ParamInfo { name, space, page: None, trainable: true });
        self.tables.push(table);
        Ok(Key(self.tables.len() as u32 - 1))
    }

    /// Arrays from a file that no table has claimed.
    pub(crate) fn unclaimed(&self) -> &[LoadedArray] {
        &self.loaded
    }

    /// The key of the table called `name`.
    pub fn find(&self, name: &str) -> Option<Key> {
        self.infos.iter().position(|i| i.name == name).map(|i| Key(i as u32))
    }

    /// All keys, in order.
    pub fn keys(&self) -> impl Iterator<Item = Key> + use<F> {
        (0..self.tables.len() as u32).map(Key)
    }

    /// Description of the table.
    pub fn info(&self, key: Key) -> &ParamInfo {
        &self.infos[key.0 as usize]
    }

    /// Description of the table, mutable.
    pub fn info_mut(&mut self, key: Key) -> &mut ParamInfo {
        &mut self.infos[key.0 as usize]
    }

    /// Several tables to write at once. Panics: a key occurs twice.
    pub fn get_mut<const N: usize>(&mut self, keys: [Key; N]) -> [&mut Table<F>; N] {
        self.tables.get_disjoint_mut(keys.map(|k| k.0 as usize)).expect("keys of one layer must be distinct")
    }

    /// Gaussians in the layer.
    pub fn len(&self) -> usize {
        self.tables[0].rows()
    }

    /// Whether there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Rows of a space: Gaussians, nodes, or 1 for `Fixed`.
    pub fn rows_of(&self, space: Space) -> usize {
        match space {
            Space::Fixed => 1,
            _ => self.infos.iter().position(|i| i.space == space).map_or(0, |i| self.tables[i].rows()),
        }
    }

    /// Puts another table of as many rows in one's place. Panics: it has another number of rows.
    pub(crate) fn replace(&mut self, key: Key, table: Table<F>) {
        let own = &mut self.tables[key.0 as usize];
        assert_eq!(own.rows(), table.rows(), "a table of a layer has a row for each of its space");
        *own = table;
    }

    /// A copy without the tables of these names. Keys of tables behind them change.
    pub(crate) fn without(&self, names: &[&str]) -> Self {
        let kept = || self.infos.iter().zip(&self.tables).filter(|(info, _)| !names.contains(&info.name.as_str()));
        Self {
            infos: kept().map(|(info, _)| info.clone()).collect(),
            tables: kept().map(|(_, table)| table.clone()).collect(),
            loaded: self.loaded.clone(),
        }
    }

    /// Gathers every table of the edit's space. Models correct what copying alone cannot in `Motion::on_edit`.
    pub fn apply(&mut self, edit: &RowEdit) {
        for (info, table) in self.infos.iter().zip(&mut self.tables) {
            if info.space == edit.space {
                *table = table.gather(&edit.parent);
            }
        }
    }

    /// The same state in another precision.
    pub fn cast<G: Real>(&self) -> Params<G> {
        Params {
            infos: self.infos.clone(),
            tables: self.tables.iter().map(Table::cast).collect(),
            loaded: self.loaded.clone(),
        }
    }

    /// Table, row and column of the first number that is not finite.
    pub fn first_non_finite(&self) -> Option<(Key, usize, usize)> {
        self.keys().find_map(|k| self[k].first_non_finite().map(|(r, c)| (k, r, c)))
    }

    /// The name of the column group that holds column `col` of a table.
    pub fn column_name(&self, key: Key, col: usize) -> &str {
        let mut first = 0;
        for Column { name, width } in self[key].columns() {
            if col < first + width {
                return name;
            }
            first += width;
        }
        &self.info(key).name
    }
}

impl<F> std::ops::Index<Key> for Params<F> {
    type Output = Table<F>;
    fn index(&self, key: Key) -> &Table<F> {
        &self.tables[key.0 as usize]
    }
}

impl<F> std::ops::IndexMut<Key> for Params<F> {
    fn index_mut(&mut self, key: Key) -> &mut Table<F> {
        &mut self.tables[key.0 as usize]
    }
}

/// Gradients to a [`Params`]. Only touched tables and active rows are ever cleared or stepped.
///
/// Pages of frames that nothing reaches cost nothing: their tables have no rows until something is added to them, so
/// that memory does not grow with the frames that were tracked before.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Grads<F = f32> {
    tables: Vec<Table<F>>,
    /// Rows of every table, those included that have none yet.
    rows: Vec<usize>,
    touched: Vec<bool>,
    gaussians: Vec<bool>,
    nodes: Vec<bool>,
}

impl<F: Real> Grads<F> {
    /// Zeros in the shape of `p`, nothing touched.
    pub fn new(p: &Params<F>) -> Self {
        let table = |(table, info): (&Table<F>, &ParamInfo)| match info.page {
            Some(_) => Table::with_columns(table.columns().to_vec(), 0),
            None => table.zeros_like(),
        };
        Self {
            tables: p.tables.iter().zip(&p.infos).map(table).collect(),
            rows: p.tables.iter().map(Table::rows).collect(),
            touched: vec![false; p.tables.len()],
            gaussians: vec![false; p.rows_of(Space::Gaussians)],
            nodes: vec![false; p.rows_of(Space::Nodes)],
        }
    }

    /// Several tables to add to at once; marks them touched. Panics: a key occurs twice.
    pub fn of<const N: usize>(&mut self, keys: [Key; N]) -> [&mut Table<F>; N] {
        for k in keys.map(|k| k.0 as usize) {
            self.touched[k] = true;
            if self.tables[k].rows() < self.rows[k] {
                self.tables[k].resize(self.rows[k]);
            }
        }
        self.tables.get_disjoint_mut(keys.map(|k| k.0 as usize)).expect("keys of one layer must be distinct")
    }

    /// As [`of`](Self::of) for a number of keys that depends on the model's sizes. Panics: a key occurs twice.
    pub fn many(&mut self, keys: &[Key]) -> Vec<&mut Table<F>> {
        let mut found: Vec<Option<&mut Table<F>>> = keys.iter().map(|_| None).collect();
        for (i, table) in self.tables.iter_mut().enumerate() {
            if let Some(k) = keys.iter().position(|k| k.0 as usize == i) {
                self.touched[i] = true;
                found[k] = Some(table);
            }
        }
        found.into_iter().map(|table| table.expect("keys of one layer must be distinct")).collect()
    }

    /// One table, to read; a page that nothing was ever added to has no rows.
    pub fn table(&self, key: Key) -> &Table<F> {
        &self.tables[key.0 as usize]
    }

    /// Bytes of all tables.
    pub fn bytes(&self) -> usize {
        self.tables.iter().map(|t| size_of_val(t.data())).sum()
    }

    /// Whether anything was added to the table in this step.
    pub fn touched(&self, key: Key) -> bool {
        self.touched[key.0 as usize]
    }

    /// A touched table of `space` and the rows that are active in it, for a reader that leaves its active blocks zero:
    /// it then counts as untouched. `None`: nothing was added to it.
    pub fn drain(&mut self, key: Key, space: Space) -> Option<(&mut Table<F>, &[bool])> {
        if !std::mem::take(&mut self.touched[key.0 as usize]) {
            return None;
        }
        let active = match space {
            Space::Fixed => &[][..],
            Space::Gaussians => &self.gaussians,
            Space::Nodes => &self.nodes,
        };
        Some((&mut self.tables[key.0 as usize], active))
    }

    /// Marks rows of a space as taking part in this step.
    pub fn activate(&mut self, space: Space, rows: super::rows::Rows<'_>) {
        let flags = match space {
            Space::Fixed => return,
            Space::Gaussians => &mut self.gaussians,
            Space::Nodes => &mut self.nodes,
        };
        match rows {
            super::rows::Rows::All => flags.fill(true),
            super::rows::Rows::Some(ids) => ids.iter().for_each(|&i| flags[i as usize] = true),
        }
    }

    /// Which rows of a space take part in this step; empty for `Fixed`.
    pub fn active(&self, space: Space) -> &[bool] {
        match space {
            Space::Fixed => &[],
            Space::Gaussians => &self.gaussians,
            Space::Nodes => &self.nodes,
        }
    }

    /// Back to zero, touching only what was touched.
    pub fn clear(&mut self, p: &Params<F>) {
        for (i, table) in self.tables.iter_mut().enumerate() {
            if !std::mem::take(&mut self.touched[i]) {
                continue;
            }
            let flags = match p.infos[i].space {
                Space::Fixed => {
                    table.fill(F::ZERO);
                    continue;
                }
                Space::Gaussians => &self.gaussians,
                Space::Nodes => &self.nodes,
            };
            let width = table.width();
            let blocks = table.data_mut().chunks_exact_mut((width * super::BLOCK).max(1));
            for (block, flags) in blocks.zip(flags.chunks(super::BLOCK)) {
                if flags.iter().any(|&f| f) {
                    block.fill(F::ZERO);
                }
            }
        }
        self.gaussians.fill(false);
        self.nodes.fill(false);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entry_claims_loaded_arrays_and_names_the_error() {
        let array =
            |name: &str, rows, width| LoadedArray { name: name.into(), rows, width, data: vec![1.0; rows * width] };
        let mut p = Params::<f32>::build(vec![array("v", 2, 3)], 2, 1, &[]).unwrap();
        let key = p.entry("motion", Space::Gaussians, &[("v", 3)], 2, |_| panic!("loaded, not made")).unwrap();
        assert_eq!(p[key].read::<3>(1, 0), [1.0; 3]);
        assert!(p.unclaimed().is_empty());
        let bad = Params::<f32>::build(vec![array("means", 3, 3)], 2, 1, &[]).unwrap_err();
        assert!(bad.to_string().contains("means"), "{bad}");
    }

    #[test]
    fn an_edit_moves_every_table_of_its_space_alike() {
        let mut p = Params::<f32>::new(3, 1, &[]);
        let fixed = p.entry("w", Space::Fixed, &[("w", 1)], 5, |_| {}).unwrap();
        for i in 0..3 {
            p[GEOMETRY].set(i, 0, i as f32);
            p[SH].set(i, 0, 10.0 * i as f32);
        }
        let mut edit = RowEdit::prune(Space::Gaussians, [true, false, true].into_iter());
        edit.push(2, Born::Clone);
        p.apply(&edit);
        assert_eq!(p.len(), 3);
        assert_eq!([0, 1, 2].map(|i| (p[GEOMETRY].get(i, 0), p[SH].get(i, 0))), [(0.0, 0.0), (2.0, 20.0), (2.0, 20.0)]);
        assert_eq!(p[fixed].rows(), 5);
    }

    #[test]
    fn clear_resets_changed_entries() {
        let p = Params::<f32>::new(20, 1, &[]);
        let mut g = Grads::new(&p);
        g.activate(Space::Gaussians, crate::scene::Rows::Some(&[3, 17]));
        let [t] = g.of([GEOMETRY]);
        t.set(3, 0, 1.0);
        t.set(17, 5, 2.0);
        g.clear(&p);
        assert_eq!(g, Grads::new(&p));
    }
}
