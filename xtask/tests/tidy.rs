//! Tidy: checks that the compiler does not make. Imports (`tidy/imports.rs`), file sizes, `unsafe`, printing, and that
//! the documents are right about paths and flags. Reads files only: no network, a second or two.

#[path = "tidy/imports.rs"]
mod imports;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

#[path = "tidy/surface.rs"]
mod surface;

#[path = "tidy/words.rs"]
mod words;

#[path = "tidy/writers.rs"]
mod writers;

/// Files longer than `MAX_LINES`, each with its reason; none at present.
const LONG_FILES: [(&str, &str); 0] = [];
const MAX_LINES: usize = 800;

/// Files that may use `unsafe`, in order, and why. ARCHITECTURE.md contains the same sentence.
const UNSAFE_FILES: [(&str, &str); 3] = [
    ("crates/splat4d/src/nn/matmul.rs", "matrix products take pointers"),
    ("crates/splat4d/src/simd.rs", "dispatch to SIMD instructions"),
    ("crates/splat4d-train/tests/steady_step.rs", "a test that counts allocations"),
];

/// Words that only the shells (the command and the chores) may use: libraries neither print nor exit nor read the
/// environment.
const SHELL_WORDS: [&str; 9] =
    ["println!", "eprintln!", "print!", "eprint!", "dbg!", "process::exit", "env::args", "env::var", "stdin()"];
const SHELLS: [&str; 4] = ["crates/splat4d-cli/", "crates/splat4d-fuzz/", "studies/", "xtask/"];

/// Words that `splat4d` may not use: it reads bytes, not paths.
const PATH_WORDS: [&str; 3] = ["std::fs", "std::path", "File::open"];

/// Documents of the root whose paths, flags and words are checked, with all pages of docs/.
const ROOT_DOCS: [&str; 6] =
    ["README.md", "ARCHITECTURE.md", "CONVENTIONS.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"];

/// Longest pages, in lines: a longer one covers two subjects.
const PAGE_LINES: usize = 250;
const README_LINES: usize = 150;

/// Folders of the repository that a path in a document begins with.
const ROOTS: [&str; 7] = ["clients/", "crates/", "docs/", "examples/", "studies/", "xtask/", ".ci/"];

/// Named in a document, and made by hand at release. Drop a line once its file is there.
const PENDING: [&str; 0] = [];

/// Flags of other programs that documents show.
const FOREIGN_FLAGS: [&str; 18] = [
    "--release",
    "--workspace",
    "--all",
    "--check",
    "--all-targets",
    "--no-deps",
    "--example",
    "--test",
    "--locked",
    "--bench",
    "--strict",
    "--no-build-isolation",
    "--open",
    "--format",
    "--profile",
    "--remap-path-prefix",
    "--target-dir",
    "--prefix",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the repository").to_owned()
}

/// Every file below `folder` with this ending, relative to the repository, in order.
fn files(folder: &str, ending: &str) -> Vec<String> {
    let (root, mut todo, mut found) = (root(), vec![root().join(folder)], Vec::new());
    while let Some(dir) = todo.pop() {
        let Ok(entries) = std::fs::read_dir(&dir) else { continue };
        for path in entries.map(|e| e.expect("a folder of the repository can be listed").path()) {
            if path.is_dir() && path.file_name().is_some_and(|n| n != "target") {
                todo.push(path);
            } else if path.extension().is_some_and(|e| e == ending) {
                let name = path.strip_prefix(&root).expect("it lies below").to_string_lossy().replace('\\', "/");
                found.push(name);
            }
        }
    }
    found.sort();
    found
}

fn sources() -> Vec<String> {
    [files("crates", "rs"), files("studies", "rs"), files("xtask", "rs")].concat()
}

fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path} cannot be read: {e}"))
}

/// Whether the whole file is a test, an example or a benchmark.
fn is_test(path: &str) -> bool {
    ["/tests/", "/examples/", "/benches/"].iter().any(|p| path.contains(p))
        || path.ends_with("/tests.rs")
        || path.ends_with("_tests.rs")
}

/// Lines of code with their numbers: comments are blanked, an inline `mod tests {` ends the file.
fn code(text: &str) -> Vec<(usize, String)> {
    let mut out = Vec::new();
    let lines: Vec<&str> = text.lines().collect();
    for (i, line) in lines.iter().enumerate() {
        let next = lines.get(i + 1).map_or("", |l| l.trim_start());
        if line.starts_with("#[cfg(test)]") && next.contains("mod ") && next.ends_with('{') {
            break;
        }
        let bare = line.split("//").next().unwrap_or("");
        out.push((i + 1, bare.to_owned()));
    }
    out
}

fn report(troubles: Vec<String>, remedy: &str) {
    assert!(troubles.is_empty(), "\n{}\n{remedy}", troubles.join("\n"));
}

fn is_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

#[test]
fn files_are_short() {
    let mut troubles = Vec::new();
    for path in sources() {
        let lines = read(&path).lines().count();
        let listed = LONG_FILES.iter().any(|(p, _)| *p == path);
        if lines > MAX_LINES && !listed {
            troubles.push(format!("{path}: {lines} lines"));
        }
    }
    for (path, reason) in LONG_FILES {
        let needed = root().join(path).is_file() && read(path).lines().count() > MAX_LINES;
        assert!(needed && !reason.is_empty(), "LONG_FILES names {path}, which needs no exemption");
    }
    report(troubles, "Split the file by nouns, or list it in LONG_FILES with a reason.");
}

#[test]
fn unsafe_stays_where_it_is() {
    let says = |path: &str| {
        // A hyphen belongs to the word: `unsafe-inline` is what web servers show about styles.
        let word = |l: &str| l.split(|c| !is_word(c) && c != '-').any(|w| w == "unsafe");
        code(&read(path)).iter().any(|(_, l)| word(l))
    };
    let found: Vec<String> = sources().into_iter().filter(|p| !p.ends_with("xtask/tests/tidy.rs") && says(p)).collect();
    let mut listed = UNSAFE_FILES.map(|(path, _)| path.to_owned()).to_vec();
    listed.sort();
    assert_eq!(found, listed, "files that say `unsafe` (left) are those in UNSAFE_FILES (right)");
    let words = UNSAFE_FILES.map(|(path, why)| format!("`{path}` ({why})"));
    let [rest @ .., last] = &words[..] else { unreachable!("the list is not empty") };
    let sentence = format!("no `unsafe` except in {} and {last}.", rest.join(", "));
    let text = read("ARCHITECTURE.md").split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(text.contains(&sentence), "ARCHITECTURE.md should say: {sentence}");
}

#[test]
fn libraries_do_not_print_and_splat4d_opens_no_file() {
    let mut troubles = Vec::new();
    for path in sources().into_iter().filter(|p| !is_test(p) && !SHELLS.iter().any(|s| p.starts_with(s))) {
        for (number, line) in code(&read(&path)) {
            for word in SHELL_WORDS {
                let found =
                    line.match_indices(word).any(|(at, _)| !line[..at].chars().next_back().is_some_and(is_word));
                if found {
                    troubles.push(format!("{path}:{number}: a library says `{word}`"));
                }
            }
            if path.starts_with("crates/splat4d/") && PATH_WORDS.iter().any(|w| line.contains(w)) {
                troubles.push(format!("{path}:{number}: splat4d reads bytes, not paths"));
            }
        }
    }
    report(troubles, "Emit an Event, return an Error, or take bytes from the caller.");
}

/// Every document that is checked, in order.
fn documents() -> Vec<String> {
    ROOT_DOCS.map(str::to_owned).into_iter().chain(files("docs", "md")).collect()
}

/// The anchor of a heading on GitHub and the site (`site/.vitepress/markdown.mjs`).
fn slug(heading: &str) -> String {
    let words = heading.trim_start_matches('#').trim().to_lowercase();
    words.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c)).collect::<String>().replace(' ', "-")
}

/// Targets of a document's links, outside of fenced blocks.
fn links(text: &str) -> Vec<String> {
    // Odd parts are inside fences.
    let outside: String = text.split("\n```").step_by(2).collect();
    outside.split("](").skip(1).filter_map(|rest| rest.split_once(')')).map(|(target, _)| target.to_owned()).collect()
}

#[test]
fn links_lead_to_pages_and_headings() {
    assert_eq!(slug("## `capture.json`, version 1"), "capturejson-version-1");
    let mut troubles = Vec::new();
    for doc in documents().into_iter().chain(files("studies/records", "md")) {
        let folder = root().join(&doc).parent().expect("a file has a folder").to_owned();
        for target in links(&read(&doc)).into_iter().filter(|t| !t.contains("://")) {
            let (path, heading) = target.split_once('#').unwrap_or((&target, ""));
            let file = if path.is_empty() { root().join(&doc) } else { folder.join(path) };
            let headings = || {
                let text = std::fs::read_to_string(&file).unwrap_or_default();
                text.lines().filter(|l| l.starts_with('#')).map(slug).collect::<BTreeSet<String>>()
            };
            if !file.exists() || !heading.is_empty() && !headings().contains(heading) {
                troubles.push(format!("{doc}: the link {target} leads nowhere"));
            }
        }
    }
    report(troubles, "Write the path and the heading as they are now.");
}

#[test]
fn pages_are_short() {
    let mut troubles = Vec::new();
    for doc in documents().into_iter().chain(files("studies/records", "md")) {
        let (lines, most) = (read(&doc).lines().count(), if doc == "README.md" { README_LINES } else { PAGE_LINES });
        if lines > most {
            troubles.push(format!("{doc}: {lines} lines, at most {most}"));
        }
    }
    report(troubles, "Make two pages of it, or move what was measured to studies/records/.");
}

/// Pieces of a document that may be paths: between spaces, quotes, brackets and backticks.
fn tokens(text: &str) -> impl Iterator<Item = &str> {
    text.split(|c: char| c.is_whitespace() || "`'\"()<>|,;".contains(c))
        .map(|t| t.trim_start_matches('[').trim_end_matches(['.', ':', ']', '*']))
}

#[test]
fn paths_in_documents_exist() {
    let mut troubles = Vec::new();
    for doc in documents() {
        let text = read(&doc);
        for token in tokens(&text) {
            let pattern = token.contains(['*', '{', '%', '$', '…']);
            if ROOTS.iter().any(|r| token.starts_with(r)) && !pattern && !PENDING.contains(&token) {
                // `docs/x.md#part` is a place in a file, `motion/x.rs::f` a name in one.
                let path = token.split(['#', ':']).next().expect("a split has a first part");
                if !root().join(path).exists() {
                    troubles.push(format!("{doc}: there is no {path}"));
                }
            }
        }
    }
    report(troubles, "Write the path as it is now, or take it out.");
}

/// Versions of a package in `Cargo.lock`.
fn locked(lock: &str, name: &str) -> Vec<String> {
    let head = format!("name = \"{name}\"\nversion = \"");
    let versions = lock.split(head.as_str()).skip(1).filter_map(|rest| rest.split_once('"'));
    versions.map(|(version, _)| version.to_owned()).collect()
}

/// Every dependency of a manifest in the workspace is a row of ARCHITECTURE.md, with a version that `Cargo.lock` has.
#[test]
fn dependencies_have_a_row_with_their_version() {
    let (lock, page) = (read("Cargo.lock"), read("ARCHITECTURE.md"));
    let (mut troubles, mut rows) = (Vec::new(), BTreeSet::new());
    let section = page.split("\n## Dependencies\n").nth(1).expect("ARCHITECTURE.md has the section \"Dependencies\"");
    for row in section.lines().filter(|l| l.starts_with("| `")) {
        let mut cells = row.split(" | ");
        let (names, stated) = (cells.next().unwrap_or(""), cells.next().unwrap_or(""));
        // `0.30, MIT/Apache`, or a version for each name: `1.12, 0.1, 1.1, MIT`.
        let stated: Vec<&str> =
            stated.split(", ").take_while(|part| part.starts_with(|c: char| c.is_ascii_digit())).collect();
        for (i, name) in names.split('`').skip(1).step_by(2).enumerate() {
            let Some(version) = stated.get(i).or(stated.first()) else { continue };
            rows.insert(name.to_owned());
            let found = locked(&lock, name);
            if !found.iter().any(|f| f == version || f.starts_with(&format!("{version}."))) {
                troubles.push(format!("ARCHITECTURE.md: `{name}` {version}, and Cargo.lock has {found:?}"));
            }
        }
    }
    let others = ["studies/Cargo.toml", "xtask/Cargo.toml"].map(str::to_owned);
    let manifests = files("crates", "toml").into_iter().chain(others);
    for path in manifests.filter(|p| p.ends_with("/Cargo.toml") && !p.contains("/fuzz/")) {
        let text = read(&path);
        let mut inside = false;
        for line in text.lines() {
            if line.starts_with('[') {
                inside = line.trim_end().ends_with("dependencies]");
            } else if inside && line.starts_with(|c: char| c.is_ascii_lowercase()) {
                let name = line.split(['.', ' ', '=']).next().unwrap_or("");
                if !name.starts_with("splat4d") && !rows.contains(name) {
                    troubles.push(format!("{path}: ARCHITECTURE.md has no row of `{name}`"));
                }
            }
        }
    }
    report(troubles, "State the version of Cargo.lock, and the reason of a new dependency.");
}

#[test]
fn tests_of_promises_exist() {
    let all: String = sources().iter().map(|path| read(path)).collect();
    let (mut troubles, mut names) = (Vec::new(), 0);
    let promises = read("SECURITY.md");
    for row in promises.lines().filter(|l| l.starts_with("| ")) {
        let held_by = row.trim_end_matches([' ', '|']).rsplit('|').next().expect("a split has a last part");
        for name in held_by.split('`').skip(1).step_by(2).filter(|n| n.chars().all(|c| is_word(c) || c == ':')) {
            names += 1;
            let last = name.rsplit("::").next().expect("a split has a last part");
            let is_there = match last {
                // A module's tests, all of them.
                "tests" => name.split("::").all(|part| part == "tests" || all.contains(&format!("mod {part};"))),
                test => all.contains(&format!("fn {test}()")),
            };
            if !is_there {
                troubles.push(format!("SECURITY.md: there is no test {name}"));
            }
        }
    }
    assert!(names > 0, "SECURITY.md names the tests that hold its promises");
    report(troubles, "Name the test that holds the promise.");
}

#[test]
fn the_code_maps_are_complete() {
    let mut troubles = Vec::new();
    let manifests = [files("crates", "toml"), files("studies", "toml")].concat();
    for manifest in manifests.into_iter().filter(|p| p.ends_with("/Cargo.toml")) {
        let src = manifest.replace("Cargo.toml", "src/");
        let of_crate: Vec<String> = files(&src, "rs").into_iter().filter(|p| !is_test(p)).collect();
        let Some(top) = ["lib.rs", "main.rs"].map(|f| format!("{src}{f}")).into_iter().find(|p| of_crate.contains(p))
        else {
            continue;
        };
        let map: String = read(&top).lines().filter(|l| l.starts_with("//!")).collect();
        for path in &of_crate {
            let inside = path.strip_prefix(&src).expect("it lies below");
            let Some((folder, _)) = inside.rsplit_once('/') else { continue };
            if !map.contains(&format!("`{folder}/`")) {
                troubles.push(format!("{top} does not name `{folder}/`"));
            }
        }
    }
    troubles.dedup();
    report(troubles, "Give it a line in the crate's module documentation.");
}

/// Long flags that the command declares: `long`, `long = "x"` and aliases in `#[arg(...)]`, with the field's name.
fn declared_flags() -> BTreeSet<String> {
    let mut flags: BTreeSet<String> = ["--help", "--version"].map(str::to_owned).into();
    for path in [files("crates/splat4d-cli/src", "rs"), files("studies/src", "rs")].concat() {
        let text = read(&path);
        for (at, _) in text.match_indices("#[arg(") {
            let end = at + text[at..].find(")]").expect("an attribute ends");
            // The attribute may end at an earlier `)]` inside it; the field then follows the last one before it.
            let field = text[end..].split(&[':', '{'][..]).next().unwrap_or("");
            let field = field.split(|c| !is_word(c)).rfind(|w| !w.is_empty()).unwrap_or("");
            let attribute = &text[at + 6..end];
            for piece in attribute.split(',').map(str::trim) {
                if piece == "long" {
                    flags.insert(format!("--{}", field.trim_start_matches('_').replace('_', "-")));
                }
                let name = ["long = ", "alias = ", "visible_alias = "].iter().find_map(|k| piece.strip_prefix(k));
                if let Some(name) = name {
                    flags.insert(format!("--{}", name.trim_matches('"')));
                }
            }
        }
    }
    flags
}

/// Words of a text that are probably long flags.
fn flags_in(text: &str) -> BTreeSet<String> {
    let mut out = BTreeSet::new();
    for (at, _) in text.match_indices("--") {
        let before = text[..at].chars().next_back();
        let name: String =
            text[at + 2..].chars().take_while(|c| c.is_ascii_alphanumeric() || "-_".contains(*c)).collect();
        if before.is_none_or(|c| c.is_whitespace() || "`\"([|/".contains(c))
            && name.starts_with(|c: char| c.is_ascii_lowercase())
        {
            out.insert(format!("--{}", name.trim_end_matches('-')));
        }
    }
    out
}

#[test]
fn flags_in_documents_exist() {
    let mut known = declared_flags();
    assert!(known.contains("--motion") && known.contains("--slow-motion"), "the command's flags are read: {known:?}");
    known.extend(FOREIGN_FLAGS.map(str::to_owned));
    // The chores and the scripts have flags of their own.
    let scripts = files("examples", "py").into_iter().chain(files("clients/blender", "py"));
    for path in files("xtask/src", "rs").into_iter().chain(scripts) {
        known.extend(flags_in(&read(&path)));
    }
    let mut troubles = Vec::new();
    for doc in documents() {
        for flag in flags_in(&read(&doc)).difference(&known) {
            troubles.push(format!("{doc}: there is no flag {flag}"));
        }
    }
    report(troubles, "Write the flag as `splat4d VERB --help` shows it.");
}

/// Columns of the command's help: clap breaks longer lines.
const HELP_COLUMNS: usize = 100;

#[test]
fn examples_of_help_fit_their_line() {
    let mut troubles = Vec::new();
    for path in files("crates/splat4d-cli/src", "rs") {
        for (at, line) in read(&path).lines().enumerate().filter(|(_, l)| l.starts_with("  splat4d ")) {
            let columns = line.trim_end_matches("\";").chars().count();
            if columns > HELP_COLUMNS {
                troubles.push(format!("{path}:{}: {columns} columns, at most {HELP_COLUMNS}", at + 1));
            }
        }
    }
    report(troubles, "Shorten the explanation of the example.");
}

/// Where a motion model may be matched by its name or its spec: the list and the models' own files, and how each is
/// learnt.
const MODEL_ROOMS: [&str; 2] = ["crates/splat4d/src/motion/", "crates/splat4d-train/src/methods/"];
/// In addition to these, each with its reason.
const MODEL_NAMES: [(&str, &str); 1] = [("crates/splat4d/src/layers/convert.rs", "turns one model into another")];

/// Names and variants of the list of motion models: lines like `Still = "still" => ...`.
fn models() -> Vec<(String, String)> {
    let list = read("crates/splat4d/src/motion/mod.rs");
    let entry = |line: &str| {
        let (head, rest) = line.trim().split_once(" = \"")?;
        let (name, _) = rest.split_once("\" => ")?;
        let variant = head.split('(').next()?;
        Some((variant.to_owned(), name.to_owned()))
    };
    list.lines().filter_map(entry).collect()
}

/// Whether a line matches on one of the models: a pattern or a comparison, not the making of one.
fn asks_which_model(line: &str, variant: &str, name: &str) -> bool {
    let name = format!("\"{name}\"");
    let compared = ["== ", "!= "].iter().any(|op| line.contains(&format!("{op}{name}")));
    let behind = line.split(&name).skip(1).any(|rest| rest.trim_start().starts_with(['|', '=']));
    let spec = format!("Spec::{variant}");
    let told = line.split(&spec).skip(1).any(|rest| !rest.starts_with(is_word));
    compared || behind || told
}

/// A new motion model is its own files and its entries: no other code may depend on which one it is. Capabilities state
/// what others need.
#[test]
fn motion_models_are_named_only_in_their_modules() {
    let models = models();
    assert!(models.len() >= 9, "the list of models is not read: {models:?}");
    assert!(asks_which_model("if r.motion == \"still\" {", "Still", "still"));
    assert!(asks_which_model("\"still\" | \"x\" => 1,", "Still", "still"));
    assert!(asks_which_model("Spec::Still => 1,", "Still", "still"));
    assert!(!asks_which_model("Recipe { motion: \"still\".into() }", "Still", "still"));
    let mut troubles = Vec::new();
    let mut used = BTreeSet::new();
    let products = sources().into_iter().filter(|p| p.contains("/src/") && !is_test(p));
    for path in products.filter(|p| !MODEL_ROOMS.iter().any(|room| p.starts_with(room))) {
        for (number, line) in code(&read(&path)) {
            let which = models.iter().find(|(variant, name)| asks_which_model(&line, variant, name));
            let Some((_, name)) = which else { continue };
            match MODEL_NAMES.iter().find(|(file, _)| *file == path) {
                Some((file, _)) => drop(used.insert(*file)),
                None => troubles.push(format!("{path}:{number}: asks whether a model is `{name}`")),
            }
        }
    }
    troubles.extend(
        MODEL_NAMES.iter().filter(|(file, _)| !used.contains(file)).map(|(f, _)| format!("{f}: no exemption needed")),
    );
    report(troubles, "Ask for a capability (`Motion::capabilities`, `Program`) and not for a name.");
}

/// The list of file dialects, in whose folder each declares itself.
const DIALECT_LIST: &str = "crates/splat4d/src/format/mod.rs";
/// Files elsewhere that may name one of them, each with its reason.
const DIALECT_NAMES: [(&str, &str); 1] =
    [("crates/splat4d-workflow/src/source/bundle.rs", "a SOG scene may lie in a folder")];

/// A new dialect is its own file and its entry in the list: no other code may name one. Its properties state what
/// others need.
#[test]
fn dialects_are_named_only_in_their_modules() {
    let list = read(DIALECT_LIST);
    let (_, list) = list.split_once("pub const DIALECTS").expect("the list has this name");
    // `: &[Dialect] = &[ply::DIALECT, ...];`
    let list = list.split(['[', ']']).nth(3).expect("the list stands in the second brackets");
    let dialects: Vec<&str> = list.split(',').map(str::trim).filter(|d| !d.is_empty()).collect();
    assert!(dialects.len() >= 7 && dialects.iter().all(|d| d.contains("::")), "the list is not read: {dialects:?}");
    let says = |path: &str| code(&read(path)).iter().any(|(_, line)| dialects.iter().any(|d| line.contains(d)));
    let products = sources().into_iter().filter(|p| p.contains("/src/") && !is_test(p) && p != DIALECT_LIST);
    let found: Vec<String> = products.filter(|p| says(p)).collect();
    assert_eq!(found, DIALECT_NAMES.map(|(path, _)| path), "files that name a dialect (left) are those listed (right)");
}
