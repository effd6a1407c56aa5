//! Nearest neighbours, cached from step to step: they change slowly, and the search is expensive.

use splat4d::math::Real;
use splat4d::math::knn::knn;
use splat4d::scene::Table;
use std::sync::{Mutex, MutexGuard};

/// Neighbours a Gaussian is compared with; Luiten et al. 2024 take 20, SC-GS 10 and fewer: cost is in proportion.
pub(crate) const NEIGHBOURS: usize = 8;
/// Steps between two searches.
const SEARCH_INTERVAL: usize = 200;

/// The epoch of the last search of a layer, and its result.
type SearchResult = (usize, Vec<u32>);

/// The nearest neighbours of the rows of every layer, by raw means, searched again every 200 steps and after every
/// edit of
/// rows.
#[derive(Debug, Default)]
pub(crate) struct Near(Mutex<Vec<SearchResult>>);

impl Near {
    fn lock(&self) -> MutexGuard<'_, Vec<SearchResult>> {
        self.0.lock().expect("no thread panics while it holds the neighbours")
    }

    /// Calls `f` with the neighbours of all rows of a layer, [rows, 8], whose `means` are the first columns of a table.
    pub(crate) fn with<F: Real, R>(
        &self,
        layer: usize,
        means: &Table<F>,
        iteration: usize,
        f: impl FnOnce(&[u32]) -> R,
    ) -> R {
        let (mut found, epoch) = (self.lock(), iteration / SEARCH_INTERVAL);
        if found.len() <= layer {
            found.resize(layer + 1, (usize::MAX, Vec::new()));
        }
        let (searched, near) = &mut found[layer];
        if *searched != epoch || near.len() != means.rows() * NEIGHBOURS {
            let point = |r: usize| means.read::<3>(r, 0).map(|x| x.f64() as f32);
            *near = knn(&(0..means.rows()).map(point).collect::<Vec<[f32; 3]>>(), NEIGHBOURS);
            *searched = epoch;
        }
        f(near)
    }

    /// Rows were edited.
    pub(crate) fn forget(&self) {
        self.lock().clear();
    }

    /// Per layer: the epoch of the search, the number of indices, the indices.
    pub(crate) fn state(&self) -> Vec<u32> {
        let layer = |(epoch, near): &SearchResult| {
            [&[u32::try_from(*epoch).unwrap_or(u32::MAX), near.len() as u32], near.as_slice()].concat()
        };
        self.lock().iter().flat_map(layer).collect()
    }

    /// Restores the result of [`state`](Self::state); invalid neighbours are searched again.
    pub(crate) fn restore(&self, state: &[u32]) {
        let mut found = self.lock();
        found.clear();
        let mut rest = state;
        while let [epoch, count, tail @ ..] = rest {
            let (near, tail) = tail.split_at((*count as usize).min(tail.len()));
            let sound = near.len() == *count as usize && near.iter().all(|&j| (j as usize) < near.len() / NEIGHBOURS);
            let epoch = if *epoch == u32::MAX || !sound { usize::MAX } else { *epoch as usize };
            found.push((epoch, if sound { near.to_vec() } else { Vec::new() }));
            rest = tail;
        }
    }
}
