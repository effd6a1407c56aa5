//! The learnable palette: entries in floats, their moments, and their codes.

use crate::optim::Moments;
use rayon::prelude::*;
use splat4d::format::playback::Palette;
use splat4d::math::sh;
use splat4d::scene::{Grads, Key, Params, Rows, SH, Space, Table};

/// Name of the table of entries.
const ENTRIES: &str = "palette";
/// Its key: it is the only one.
const KEY: Key = Key(0);

/// Spherical harmonics above degree 0 that many rows share.
#[derive(Debug)]
pub(super) struct Shared {
    degree: usize,
    /// One table [entries, 3(K − 1)].
    params: Params<f32>,
    moments: Moments<f32>,
    grads: Grads<f32>,
    /// The entries' codes; none: they have changed.
    packed: Option<Palette>,
    /// Scratch, [3(K − 1)][entries].
    sums: Vec<Vec<f32>>,
}

impl Shared {
    /// Starts with the decoded file.
    pub(super) fn new(palette: &Palette) -> Self {
        let mut new = Self::empty(palette.degree, palette.entries);
        let table = &mut new.params[KEY];
        for entry in 0..palette.entries {
            (0..palette.width()).for_each(|plane| table.set(entry, plane, palette.value(entry, plane)));
        }
        new
    }

    /// All zero.
    pub(super) fn empty(degree: usize, entries: usize) -> Self {
        let width = 3 * (sh::coeffs(degree) - 1);
        let mut params = Params::default();
        let made = params.entry(ENTRIES, Space::Gaussians, &[(ENTRIES, width)], entries, |_| {});
        assert_eq!(made.expect("a new table fits itself"), KEY, "the palette has one table");
        let (moments, grads) = (Moments::new(&params), Grads::new(&params));
        Self { degree, params, moments, grads, packed: None, sums: vec![Vec::new(); width] }
    }

    pub(super) fn degree(&self) -> usize {
        self.degree
    }

    pub(super) fn entries(&self) -> usize {
        self.params[KEY].rows()
    }

    /// Entries [entries, W] and moments [entries, 2W + 1], for a checkpoint.
    pub(super) fn tables(&self) -> [&Table<f32>; 2] {
        [&self.params[KEY], self.moments.table(KEY)]
    }

    /// The same, to fill.
    pub(super) fn tables_mut(&mut self) -> [&mut Table<f32>; 2] {
        self.packed = None;
        let [entries] = self.params.get_mut([KEY]);
        [entries, self.moments.table_mut(KEY)]
    }

    /// The palette of the file.
    pub(super) fn packed(&mut self) -> &Palette {
        let table = &self.params[KEY];
        let pack = || Palette::new(self.degree, &table.column_to_rows(0, table.width()));
        self.packed.get_or_insert_with(pack)
    }

    /// One step of Adam on the entries of active rows. Returns whether all is finite.
    pub(super) fn learn(&mut self, d: &[Grads<f32>], labels: &[Vec<u16>], rate: f64) -> bool {
        if !self.gather(d, labels) {
            return true;
        }
        let rates = [Some(vec![rate; self.sums.len()])];
        let finite = self.moments.step(&mut self.params, &mut self.grads, &rates, &[]).is_empty();
        self.grads.clear(&self.params);
        self.packed = None;
        finite
    }

    /// Sums the rows' gradients entry by entry: rows in order, one task a coefficient, so that the number of threads
    /// does not matter. Returns whether there are any.
    pub(super) fn gather(&mut self, d: &[Grads<f32>], labels: &[Vec<u16>]) -> bool {
        let (entries, width) = (self.entries(), self.sums.len());
        let layers: Vec<_> = d.iter().zip(labels).filter(|(d, _)| d.touched(SH)).collect();
        let mut touched = vec![false; entries];
        for (d, labels) in &layers {
            let active = d.active(Space::Gaussians).iter().zip(*labels).filter(|(active, _)| **active);
            active.for_each(|(_, label)| touched[usize::from(*label)] = true);
        }
        let ids: Vec<u32> = (0..entries as u32).filter(|&e| touched[e as usize]).collect();
        self.sums.par_iter_mut().enumerate().for_each(|(plane, sums)| {
            sums.clear();
            sums.resize(entries, 0.0);
            for (d, labels) in &layers {
                let table = d.table(SH);
                for (row, _) in d.active(Space::Gaussians).iter().enumerate().filter(|(_, active)| **active) {
                    sums[usize::from(labels[row])] += table.get(row, 3 + plane);
                }
            }
        });
        self.grads.activate(Space::Gaussians, Rows::Some(&ids));
        let [table] = self.grads.of([KEY]);
        for &id in &ids {
            (0..width).for_each(|plane| table.set(id as usize, plane, self.sums[plane][id as usize]));
        }
        !ids.is_empty()
    }

    /// The gradient that [`gather`](Self::gather) left.
    #[cfg(test)]
    pub(super) fn gradient(&self) -> &Table<f32> {
        self.grads.table(KEY)
    }
}
