//! Stored results, for runs with small changes: a value is identified by its inputs.

use crate::Result;
use crate::video::fnv1a;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use splat4d_train::run::checkpoint::write_atomically;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Changes whenever what is found of the same changes.
const VERSION: u32 = 1;
/// Values of one kind that are kept, the last ones that were used.
const KEPT: usize = 4;

/// The folder of values.
pub(super) struct Cache {
    folder: PathBuf,
}

#[derive(Serialize, Deserialize)]
struct Entry<T> {
    /// In full, so that two keys of one hash are distinguished.
    made_of: String,
    value: T,
}

impl Cache {
    pub(super) fn of(capture: &Path) -> Self {
        Self { folder: capture.join("import/cache") }
    }

    /// The value of this kind that was made of the same, else what `make` makes, which is kept.
    ///
    /// Errors: those of `make`. Unreadable values are computed again, and those that cannot be written are computed
    /// again the next time.
    pub(super) fn or<T: Serialize + DeserializeOwned>(
        &self,
        kind: &str,
        made_of: &str,
        make: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        let path = self.path(kind, made_of);
        let known = splat4d_train::files::read(&path).ok().and_then(|b| serde_json::from_slice::<Entry<T>>(&b).ok());
        if let Some(entry) = known.filter(|e| e.made_of == made_of) {
            return Ok(entry.value);
        }
        let entry = Entry { made_of: made_of.to_owned(), value: make()? };
        if let Ok(bytes) = serde_json::to_vec(&entry) {
            drop(write_atomically(&path, &bytes));
            self.forget(kind, &path);
        }
        Ok(entry.value)
    }

    /// Values of pairs: those that are known, and what `make` makes of the pairs that are not. A pair is known by the
    /// names of what it is made of, whichever others there are.
    pub(super) fn pairs<T: Clone + Serialize + DeserializeOwned>(
        &self,
        kind: &str,
        pairs: &[[usize; 2]],
        names: &[String],
        make: impl FnOnce(&[[usize; 2]]) -> Result<Vec<T>>,
    ) -> Result<Vec<T>> {
        let path = self.path(kind, "pairs");
        let read = splat4d_train::files::read(&path).ok().and_then(|b| serde_json::from_slice(&b).ok());
        let mut known: BTreeMap<String, T> = read.unwrap_or_default();
        let key = |&[a, b]: &[usize; 2]| format!("{} {}", names[a], names[b]);
        let missing: Vec<[usize; 2]> = pairs.iter().copied().filter(|p| !known.contains_key(&key(p))).collect();
        if !missing.is_empty() {
            let made = make(&missing)?;
            assert_eq!(made.len(), missing.len(), "every pair has a value");
            known.extend(missing.iter().map(key).zip(made));
            if let Ok(bytes) = serde_json::to_vec(&known) {
                drop(write_atomically(&path, &bytes));
            }
        }
        Ok(pairs.iter().map(|p| known[&key(p)].clone()).collect())
    }

    fn path(&self, kind: &str, made_of: &str) -> PathBuf {
        self.folder.join(format!("{kind}-{:016x}.json", fnv1a(format!("{VERSION} {made_of}").as_bytes())))
    }

    /// Removes the oldest values of a kind beyond those that are kept.
    fn forget(&self, kind: &str, new: &Path) {
        let Ok(all) = std::fs::read_dir(&self.folder) else { return };
        let own = |p: &PathBuf| p.file_name().is_some_and(|n| n.to_string_lossy().starts_with(&format!("{kind}-")));
        let when = |p: &PathBuf| p.metadata().and_then(|m| m.modified()).ok();
        let mut old: Vec<PathBuf> =
            all.filter_map(|e| e.ok().map(|e| e.path())).filter(|p| own(p) && p != new).collect();
        old.sort_by_key(|p| std::cmp::Reverse(when(p)));
        old.iter().skip(KEPT - 1).for_each(|p| drop(std::fs::remove_file(p)));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Error;
    use std::cell::Cell;

    #[test]
    fn equal_inputs_are_computed_once() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::of(dir.path());
        let made = Cell::new(0);
        let get = |of: &str| {
            let make = || {
                made.set(made.get() + 1);
                Ok(vec![0.1 + 0.2, of.len() as f64])
            };
            cache.or("solved", of, make).unwrap()
        };
        assert_eq!((get("a"), get("a"), made.get()), (vec![0.1 + 0.2, 1.0], vec![0.1 + 0.2, 1.0], 1));
        get("bb");
        assert_eq!((get("a"), made.get()), (vec![0.1 + 0.2, 1.0], 2));
        // A file that was damaged is as good as none.
        std::fs::write(cache.path("solved", "a"), "{").unwrap();
        get("a");
        assert_eq!(made.get(), 3);
        (0..20).for_each(|k| drop(get(&k.to_string())));
        assert_eq!(std::fs::read_dir(&cache.folder).unwrap().count(), KEPT);
        let failed = cache.or::<u32>("solved", "c", || Err(Error::input("no")));
        assert!(failed.is_err() && !cache.path("solved", "c").exists());
    }

    #[test]
    fn a_cached_pair_is_reused_with_other_cameras_present() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::of(dir.path());
        let asked = Cell::new(0);
        let get = |names: &[&str], pairs: &[[usize; 2]]| {
            let names: Vec<String> = names.iter().map(|n| n.to_string()).collect();
            let make = |missing: &[[usize; 2]]| {
                asked.set(missing.len());
                Ok(missing.iter().map(|&[a, b]| Some(format!("{}{}", names[a], names[b]))).collect())
            };
            cache.pairs("sound", pairs, &names, make).unwrap()
        };
        assert_eq!(get(&["a", "b", "c"], &[[0, 1], [0, 2], [1, 2]])[2], Some("bc".into()));
        assert_eq!(asked.replace(0), 3);
        assert_eq!(get(&["a", "c"], &[[0, 1]]), [Some("ac".to_owned())]);
        assert_eq!(asked.get(), 0);
        assert_eq!(get(&["a", "c", "d"], &[[0, 2], [0, 1]]), [Some("ad".to_owned()), Some("ac".to_owned())]);
        assert_eq!(asked.get(), 1);
    }
}
