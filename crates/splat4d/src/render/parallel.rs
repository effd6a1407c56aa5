//! Splits buffers among tasks without allocating: groups of uneven or even size, halved recursively by `rayon::join`.
//! Which thread runs a group never matters: a group's work depends on nothing but its number and its own slice.

/// Something that can be cut in two: before item `items`, which is also before group `groups`.
pub(super) trait Split: Sized + Send {
    /// The two halves.
    fn split(self, items: usize, groups: usize) -> (Self, Self);
}

/// As many items per group as the starts specify.
pub(super) struct Ragged<'a, T>(pub &'a mut [T]);

/// The same number of items for every group.
pub(super) struct Even<'a, T>(pub &'a mut [T], pub usize);

impl<T: Send> Split for Ragged<'_, T> {
    fn split(self, items: usize, _: usize) -> (Self, Self) {
        let (a, b) = self.0.split_at_mut(items);
        (Ragged(a), Ragged(b))
    }
}

impl<T: Send> Split for Even<'_, T> {
    fn split(self, _: usize, groups: usize) -> (Self, Self) {
        let n = (groups * self.1).min(self.0.len());
        let (a, b) = self.0.split_at_mut(n);
        (Even(a, self.1), Even(b, self.1))
    }
}

impl<A: Split, B: Split> Split for (A, B) {
    fn split(self, items: usize, groups: usize) -> (Self, Self) {
        let (a0, a1) = self.0.split(items, groups);
        let (b0, b1) = self.1.split(items, groups);
        ((a0, b0), (a1, b1))
    }
}

/// Calls `f(group, slice)` for every group g with items `starts[g]..starts[g+1]`, in parallel.
pub(super) fn for_each_group<S: Split>(starts: &[u32], data: S, f: &(impl Fn(usize, S) + Sync)) {
    if starts.len() >= 2 {
        halve(starts, 0, starts.len() - 1, data, f);
    }
}

fn halve<S: Split>(starts: &[u32], lo: usize, hi: usize, data: S, f: &(impl Fn(usize, S) + Sync)) {
    if hi - lo == 1 {
        return f(lo, data);
    }
    let mid = lo.midpoint(hi);
    let (a, b) = data.split((starts[mid] - starts[lo]) as usize, mid - lo);
    rayon::join(|| halve(starts, lo, mid, a, f), || halve(starts, mid, hi, b, f));
}
