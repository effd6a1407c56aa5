//! Masks of visible Gaussians for each key time: the temporal filter of 4DGS-1K (Yuan et al. 2025, §4.2).

use super::{RowEdit, Space};

/// Rows of a word.
pub(crate) const WORD: usize = u32::BITS as usize;

/// A bit per Gaussian and key time. Between two key times a Gaussian is rendered only if its bit is set at one of them;
/// before the first and after the last, if it is set there.
///
/// Masks select Gaussians by importance, lifespans by time: a layer renders those that both admit.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct KeyMasks {
    times: Vec<f64>,
    rows: usize,
    /// [keys, words a key]: row i is bit i % 32 of word i / 32; bits beyond the last row are zero.
    words: Vec<u32>,
}

impl KeyMasks {
    /// All bits zero. Panics: no time, or times that do not rise strictly.
    pub fn new(times: Vec<f64>, rows: usize) -> Self {
        assert!(!times.is_empty(), "masks need a key time");
        assert!(times.windows(2).all(|w| w[0] < w[1]) && times.iter().all(|t| t.is_finite()), "key times rise");
        let words = vec![0; times.len() * rows.div_ceil(WORD)];
        Self { times, rows, words }
    }

    /// From words as [`words`](Self::words) gives them; `None` if their number is wrong or a bit beyond the last row is
    /// set. Panics as [`new`](Self::new).
    pub(crate) fn from_words(times: Vec<f64>, rows: usize, words: Vec<u32>) -> Option<Self> {
        let wanted = Self::new(times, rows);
        let stride = wanted.stride();
        let spare = if rows.is_multiple_of(WORD) { 0 } else { !0 << (rows % WORD) };
        let sound = words.len() == wanted.words.len()
            && words.chunks_exact(stride.max(1)).all(|key| key.last().is_none_or(|w| w & spare == 0));
        sound.then_some(Self { words, ..wanted })
    }

    /// Seconds of the key times, rising.
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// Gaussians.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// [keys, ⌈rows/32⌉]: row i is bit i % 32 of word i / 32.
    pub(crate) fn words(&self) -> &[u32] {
        &self.words
    }

    fn stride(&self) -> usize {
        self.rows.div_ceil(WORD)
    }

    /// Whether a row is seen at a key time. Panics: there is none.
    pub fn get(&self, key: usize, row: usize) -> bool {
        assert!(row < self.rows, "row {row} of {}", self.rows);
        self.words[key * self.stride() + row / WORD] >> (row % WORD) & 1 == 1
    }

    /// Notes that a row is seen at a key time. Panics: there is none.
    pub fn set(&mut self, key: usize, row: usize) {
        assert!(row < self.rows, "row {row} of {}", self.rows);
        let place = key * self.stride() + row / WORD;
        self.words[place] |= 1 << (row % WORD);
    }

    /// The key times on both sides of t: the same one twice on a key and outside the range.
    pub fn keys_at(&self, t: f64) -> [usize; 2] {
        let last = self.times.len() - 1;
        let after = self.times.partition_point(|k| *k < t);
        if after > last {
            return [last; 2];
        }
        [if self.times[after] == t { after } else { after.saturating_sub(1) }, after]
    }

    /// Whether a row may be rendered at time t.
    pub fn allows(&self, t: f64, row: usize) -> bool {
        let [l, r] = self.keys_at(t);
        self.get(l, row) || self.get(r, row)
    }

    /// The words of the two keys around t: a row may be rendered where either has its bit.
    pub(crate) fn words_at(&self, t: f64) -> [&[u32]; 2] {
        self.keys_at(t).map(|k| &self.words[k * self.stride()..][..self.stride()])
    }

    /// Keeps those of `ids` (rows, in any order) that may be rendered at time t.
    pub(crate) fn retain(&self, t: f64, ids: &mut Vec<u32>) {
        let [l, r] = self.words_at(t);
        ids.retain(|&i| (l[i as usize / WORD] | r[i as usize / WORD]) >> (i as usize % WORD) & 1 == 1);
    }

    /// Follows a row edit: a new row has its parent's bits.
    pub(crate) fn edited(&self, edit: &RowEdit) -> Self {
        if edit.space != Space::Gaussians {
            return self.clone();
        }
        let mut out = Self::new(self.times.clone(), edit.parent.len());
        for key in 0..self.times.len() {
            let seen = edit.parent.iter().enumerate().filter(|(_, p)| self.get(key, **p as usize));
            seen.for_each(|(row, _)| out.set(key, row));
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    fn random(keys: usize, rows: usize) -> KeyMasks {
        let mut m = KeyMasks::new((0..keys).map(|k| 0.5 * k as f64).collect(), rows);
        let rng = Rng::new(3, "masks", 0);
        for key in 0..keys {
            (0..rows).filter(|r| rng.uniform((key * rows + r) as u64) < 0.3).for_each(|r| m.set(key, r));
        }
        m
    }

    #[test]
    fn a_row_is_admitted_by_either_key_around_a_time() {
        let m = random(4, 77);
        for (t, keys) in [(-1.0, [0, 0]), (0.0, [0, 0]), (0.2, [0, 1]), (0.5, [1, 1]), (1.4, [2, 3]), (9.0, [3, 3])] {
            assert_eq!(m.keys_at(t), keys, "t = {t}");
            let mut ids: Vec<u32> = (0..77).step_by(2).collect();
            let expected: Vec<u32> =
                ids.iter().copied().filter(|&i| keys.iter().any(|&k| m.get(k, i as usize))).collect();
            m.retain(t, &mut ids);
            assert_eq!(ids, expected);
            // The union holds what each key holds.
            assert!((0..77).all(|i| !m.get(keys[0], i) || m.allows(t, i)));
        }
    }

    #[test]
    fn mask_words_round_trip_and_damage_is_detected() {
        let m = random(3, 70);
        let again = |words: Vec<u32>| KeyMasks::from_words(m.times().to_vec(), 70, words);
        assert_eq!(again(m.words().to_vec()), Some(m.clone()));
        assert_eq!(again(m.words()[1..].to_vec()), None);
        let mut beyond = m.words().to_vec();
        beyond[2] |= 1 << 31;
        assert_eq!(again(beyond), None);
    }

    #[test]
    fn edits_carry_bits_along() {
        let m = random(2, 40);
        let edit = RowEdit::prune(Space::Gaussians, (0..40).map(|i| i % 3 != 0));
        let e = m.edited(&edit);
        assert!(edit.parent.iter().enumerate().all(|(j, &p)| (0..2).all(|k| e.get(k, j) == m.get(k, p as usize))));
    }
}
