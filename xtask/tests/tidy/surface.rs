//! Surface: how many items the libraries show, and how many files an addition touches. Both only shrink.

use super::{code, files, is_test, is_word, read, report};

/// Public items of a crate at most: lines of its sources, tests aside, that begin a `pub` function, method, type, trait
/// or constant. `unreachable_pub` ensures that such a line can be reached. A lower count lowers the limit; the goals
/// are 600 for `splat4d` and 250 for `splat4d-train`. Raised once, when captures that are still filmed and networks' poses
/// came: the command and Python call them.
const PUBLIC: [(&str, usize); 3] =
    [("crates/splat4d/src", 846), ("crates/splat4d-train/src", 475), ("crates/splat4d-import/src", 98)];
/// A count this far below its limit is a limit to be lowered.
const SLACK: usize = 10;

/// What begins a public item, behind `pub `.
const ITEMS: [&str; 7] = ["fn", "struct", "enum", "trait", "const", "static", "type"];
const QUALIFIERS: [&str; 2] = ["const", "async"];

fn is_public_item(line: &str) -> bool {
    let Some(rest) = line.trim_start().strip_prefix("pub ") else { return false };
    let mut words = rest.split(|c| !is_word(c)).filter(|w| !w.is_empty());
    let Some(first) = words.next() else { return false };
    ITEMS.contains(&first) || QUALIFIERS.contains(&first) && words.next().is_some_and(|w| ITEMS.contains(&w))
}

fn public_items(folder: &str) -> usize {
    let of = |file: &String| code(&read(file)).iter().filter(|(_, line)| is_public_item(line)).count();
    files(folder, "rs").iter().filter(|file| !is_test(file)).map(of).sum()
}

#[test]
fn public_items_are_counted() {
    let public = ["pub fn a() {", "    pub const fn b() {", "pub struct C;", "    pub const D: u8 = 1;"];
    assert!(public.iter().all(|line| is_public_item(line)));
    let others =
        ["pub(crate) fn a() {", "    pub field: u8,", "pub use a::b;", "pub mod c;", "fn pub_d() {", "pub typed: u8,"];
    assert!(!others.iter().any(|line| is_public_item(line)));
}

#[test]
fn libraries_show_no_more_than_they_did() {
    let mut troubles = Vec::new();
    for (folder, most) in PUBLIC {
        let found = public_items(folder);
        if found > most {
            troubles.push(format!(
                "{folder} has {found} public items, {most} at most: write pub(crate) where no other crate needs it"
            ));
        } else if found + SLACK < most {
            troubles.push(format!("{folder} has {found} public items: lower its limit of {most} in PUBLIC"));
        }
    }
    report(troubles, "The limits only shrink.");
}

/// An addition of each kind that is in the code, by words that it alone brought, and the files that it may touch.
/// Tests, documents and the list of the fuzzer aside.
const ADDITIONS: [(&str, &[&str], &[&str]); 4] = [
    (
        "motion model",
        &["HexplaneSpec", "HexplaneMethod", "HexplaneSettings"],
        &[
            "crates/splat4d-train/src/methods/hexplane.rs",
            "crates/splat4d-train/src/methods/mod.rs",
            // Networks of 4DGaussians become this model: a reader, which an addition does not need.
            "crates/splat4d/src/format/research/hexplane.rs",
            "crates/splat4d/src/motion/hexplane.rs",
            "crates/splat4d/src/motion/mod.rs",
        ],
    ),
    (
        "maintenance operation",
        &["MergeSettings"],
        &["crates/splat4d-train/src/maintenance/merge.rs", "crates/splat4d-train/src/maintenance/mod.rs"],
    ),
    (
        "reader of captures",
        &["panoptic", "Panoptic"],
        &["crates/splat4d-train/src/capture/mod.rs", "crates/splat4d-train/src/capture/panoptic.rs"],
    ),
    (
        "step of edits",
        &["Recolor", "recolor"],
        &["crates/splat4d/src/edit/act.rs", "crates/splat4d/src/edit/mod.rs", "crates/splat4d-serve/player/edit.js"],
    ),
];

#[test]
fn an_addition_touches_few_files() {
    let player = files("crates/splat4d-serve/player", "js");
    let sources: Vec<String> =
        files("crates", "rs").into_iter().filter(|f| f.contains("/src/") && !is_test(f)).chain(player).collect();
    let names = |file: &str, words: &[&str]| {
        code(&read(file)).iter().any(|(_, line)| line.split(|c| !is_word(c)).any(|w| words.contains(&w)))
    };
    for (kind, words, wanted) in ADDITIONS {
        let found: Vec<&String> = sources.iter().filter(|f| !f.contains("splat4d-fuzz/") && names(f, words)).collect();
        assert_eq!(found, wanted, "files of a {kind}");
    }
}
