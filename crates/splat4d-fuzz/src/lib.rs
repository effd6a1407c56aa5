//! Every reader of files, and of texts from outside, as a function of bytes. Readers return an error for any input: no
//! panic, no hang, and no allocation far beyond the input's size.
//!
//! [`READERS`] is the one list: `cargo run --release -p xtask -- fuzz` mutates seeds of each on a stable toolchain, and
//! `fuzz/` holds a `cargo fuzz` target of each.

#![allow(missing_docs)] // internal to the workspace

mod captures;
mod formats;
mod http;
pub mod mutate;
mod networks;
mod runs;
#[cfg(test)]
mod sources;
mod texts;
mod trained;
mod zip;

/// A reader.
pub struct Reader {
    pub name: &'static str,
    /// Sound inputs, which mutations start from.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Reads bytes; whether they were sound does not matter.
    pub read: fn(&[u8]),
}

/// All of them.
pub const READERS: &[&[Reader]] = &[
    formats::READERS,
    networks::READERS,
    captures::READERS,
    texts::READERS,
    runs::READERS,
    trained::READERS,
    http::READERS,
];

/// All of them, one by one.
pub fn readers() -> impl Iterator<Item = &'static Reader> {
    READERS.iter().copied().flatten()
}

/// Entry point of a fuzz target. Panics: no reader has this name.
pub fn read(name: &str, bytes: &[u8]) {
    let reader = readers().find(|r| r.name == name).unwrap_or_else(|| panic!("there is no reader {name}"));
    (reader.read)(bytes);
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    /// Inputs a reader in the ordinary tests; the chore makes more.
    const FEW: u64 = 60;

    #[test]
    fn every_reader_has_sound_seeds_and_survives_a_few_mutations() {
        for reader in readers() {
            let seeds = (reader.seeds)();
            assert!(!seeds.is_empty() && seeds.iter().all(|s| !s.is_empty()), "{}", reader.name);
            (0..FEW).for_each(|i| (reader.read)(&mutate::mutant(&seeds, 1, reader.name, i)));
        }
    }

    #[test]
    fn every_reader_has_a_target_of_cargo_fuzz() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz");
        let manifest = std::fs::read_to_string(folder.join("Cargo.toml")).unwrap();
        let mut names: Vec<&str> = readers().map(|r| r.name).collect();
        for name in &names {
            assert!(manifest.contains(&format!("name = \"{name}\"\n")), "fuzz/Cargo.toml has no target {name}");
            let text = std::fs::read_to_string(folder.join(format!("fuzz_targets/{name}.rs"))).unwrap();
            assert!(text.contains(&format!("splat4d_fuzz::read(\"{name}\", bytes)")), "{name}: {text}");
        }
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), readers().count(), "two readers have one name");
        assert_eq!(std::fs::read_dir(folder.join("fuzz_targets")).unwrap().count(), names.len());
    }
}
