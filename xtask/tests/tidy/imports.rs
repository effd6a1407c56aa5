//! Imports: the order of each crate's modules, and that no files of a crate import each other in a circle.

use super::{files, is_test, read, report, root};
use std::collections::{BTreeMap, BTreeSet};

/// The allowed order of a crate's top modules: a module may import those before it. The
/// code map of the crate (`lib.rs`) lists them in the same order.
const ORDER: [(&str, &[&str]); 9] = [
    (
        "crates/splat4d",
        &[
            "error", "text", "wgsl", "simd", "math", "scene", "nn", "motion", "layers", "render", "backward", "gpu",
            "device", "flow", "channels", "format", "bake", "play", "edit",
        ],
    ),
    (
        "crates/splat4d-train",
        // Every part is built from its own settings and facts of the capture; `recipe` composes the settings and builds
        // the parts, so that only what runs a whole training imports it.
        &[
            "settings",
            "event",
            "path_text",
            "text",
            "files",
            "encode",
            "keypoints",
            "capture",
            "vision",
            "sampler",
            "optim",
            "loss",
            "train_state",
            "maintenance",
            "methods",
            "init",
            "step",
            "recipe",
            "output",
            "blended",
            "run",
            "labels",
            "features",
            "eval",
            "training",
            "compress",
        ],
    ),
    (
        "crates/splat4d-dynamics",
        &[
            "actions",
            "paths",
            "worlds",
            "matrix",
            "smooth",
            "optimise",
            "ballistic",
            "koopman",
            "learnt",
            "causal",
            "graph",
            "inverse",
            "models",
            "score",
            "nodes",
            "future",
            "assimilate",
        ],
    ),
    (
        "crates/splat4d-import",
        &[
            "board",
            "calibration",
            "video",
            "sync",
            "sfm",
            "clicks",
            "corrections",
            "write",
            "shipped",
            "generated",
            "predicted",
            "recording",
            "doctor",
        ],
    ),
    (
        "crates/splat4d-serve",
        &[
            "photos",
            "given",
            "write_timeout",
            "body",
            "range",
            "reply",
            "guard",
            "scene",
            "edit",
            "assets",
            "page",
            "events",
            "answer",
            "server",
            "no_server",
        ],
    ),
    (
        "crates/splat4d-workflow",
        &[
            "events",
            "parts",
            "files",
            "deadline",
            "camera_file",
            "paths",
            "run_folder",
            "status",
            "sequence",
            "sound",
            "source",
            "channels",
            "device",
            "draw",
            "video",
            "raw_values",
            "rendering",
            "capture_page",
            "point_queries",
            "measure",
            "activity",
            "folding",
            "baking",
            "playable",
            "growing",
            "programs",
            "converting",
            "exporting",
            "meshing",
            "localising",
            "ground_truth",
            "comparing",
            "report",
            "comparison",
            "evaluating",
            "adopting",
            "foreign",
            "still_baseline",
            "labelling",
            "chunked",
            "compressing",
            "training",
            "following",
            "models",
            "importing",
            "inspecting",
            "storage",
            "predicting",
            "editing",
            "picking",
            "editor",
            "aligning",
            "priors",
            "recipe_schema",
            "texts",
        ],
    ),
    (
        "crates/splat4d-cli",
        &["interrupt", "bar", "console", "device", "measuring", "serving", "storage", "verbs", "main", "bin"],
    ),
    (
        "crates/splat4d-py",
        &[
            "errors",
            "workflows",
            "arrays",
            "plain",
            "settings",
            "camera",
            "scene_arrays",
            "gaussians",
            "from_arrays",
            "metrics",
            "loss",
            "motion",
            "rendering",
            "scene",
            "run",
            "capture",
            "recording",
            "train",
        ],
    ),
    (
        "studies",
        &[
            "cells",
            "study",
            "tables",
            "deformation",
            "lifting",
            "made",
            "e00",
            "e01",
            "e02",
            "e03",
            "models",
            "replay",
            "suite",
            "best",
            "bench",
            "main",
        ],
    ),
];

/// Modules that a module must not import although they are before it: the design's first invariant.
const NEVER: [(&str, &str, &[&str]); 1] = [
    // The renderer does not depend on time: it gets splats, not the models and layers that make them.
    ("crates/splat4d", "render", &["motion", "layers"]),
];

/// Words of a source without comments, literals and items that only tests have; `::` is one word, other signs are one
/// each.
fn words(text: &str) -> Vec<String> {
    let chars: Vec<char> = text.chars().collect();
    let at = |i: usize| chars.get(i).copied().unwrap_or('\0');
    let (mut out, mut i) = (Vec::new(), 0);
    while i < chars.len() {
        let c = at(i);
        let hashes = |from: usize| (from..).take_while(|&k| at(k) == '#').count();
        let raw = match c {
            'r' => Some(i + 1),
            'b' if at(i + 1) == 'r' => Some(i + 2),
            _ => None,
        };
        let raw = raw.map(|k| (k, hashes(k))).filter(|&(k, n)| at(k + n) == '"');
        if c == '/' && at(i + 1) == '/' {
            i += (i..).take_while(|&k| k < chars.len() && at(k) != '\n').count();
        } else if let Some((k, n)) = raw {
            let closes = |k: &usize| *k >= chars.len() || at(*k) == '"' && hashes(k + 1) >= n;
            i = (k + n + 1..).find(closes).expect("the range has no end") + n + 1;
        } else if c == '"' {
            i += 1;
            while i < chars.len() && at(i) != '"' {
                i += if at(i) == '\\' { 2 } else { 1 };
            }
            i += 1;
        } else if c == '\'' && at(i + 1) == '\\' {
            i += 3;
            i += (i..).take_while(|&k| k < chars.len() && at(k) != '\'').count() + 1;
        } else if c == '\'' && at(i + 2) == '\'' {
            i += 3;
        } else if c.is_alphanumeric() || c == '_' {
            let word: String = chars[i..].iter().take_while(|c| c.is_alphanumeric() || **c == '_').collect();
            i += word.chars().count();
            out.push(word);
        } else if c == ':' && at(i + 1) == ':' {
            out.push("::".into());
            i += 2;
        } else {
            if !c.is_whitespace() {
                out.push(c.into());
            }
            i += 1;
        }
    }
    without_tests(&out)
}

/// The words without items behind `#[cfg(test)]`.
fn without_tests(words: &[String]) -> Vec<String> {
    let (mut out, mut i) = (Vec::new(), 0);
    while i < words.len() {
        let is = |pattern: &[&str]| words[i..].iter().take(pattern.len()).eq(pattern);
        if !is(&["#", "[", "cfg", "(", "test"]) && !is(&["#", "[", "cfg", "(", "all", "(", "test"]) {
            out.push(words[i].clone());
            i += 1;
            continue;
        }
        // The attribute, then the item to its end.
        let mut depth = 0;
        while i < words.len() {
            match words[i].as_str() {
                "(" | "[" | "{" => depth += 1,
                ")" | "]" | "}" => depth -= 1,
                _ => {}
            }
            let ends = depth < 0 || depth == 0 && matches!(words[i].as_str(), ";" | "," | "}");
            i += usize::from(depth >= 0);
            if ends {
                break;
            }
        }
    }
    out
}

/// A path that is named, and its name in the file.
type Named = (Vec<String>, String);

/// Paths of a tree of imports, from its words on: `a::{b, c as d}` gives a::b and a::c. Returns the words that it
/// takes.
fn tree(words: &[String], prefix: &[String], out: &mut Vec<Named>) -> usize {
    let (mut path, mut i) = (prefix.to_vec(), 0);
    let mut alias = None;
    while let Some(word) = words.get(i) {
        match word.as_str() {
            "," | "}" | ";" => break,
            "{" => {
                i += 1;
                while words.get(i).is_some_and(|w| w != "}" && w != ";") {
                    i += tree(&words[i..], &path, out);
                    i += usize::from(words.get(i).is_some_and(|w| w == ","));
                }
                return i + 1;
            }
            "as" => {
                alias = words.get(i + 1).cloned();
                i += 1;
            }
            "::" => {}
            // `a::{self}` is `a`.
            "self" if !path.is_empty() => {}
            word => path.push(word.to_owned()),
        }
        i += 1;
    }
    let name = alias.or_else(|| path.last().cloned()).unwrap_or_default();
    out.push((path, name));
    i
}

/// Paths that a file imports or names in its code.
fn named(words: &[String]) -> (Vec<Named>, Vec<Vec<String>>) {
    let (mut imports, mut inline, mut i) = (Vec::new(), Vec::new(), 0);
    while i < words.len() {
        // `use<'a>` is a bound.
        if words[i] == "use" && words.get(i + 1).is_some_and(|w| w != "<") {
            i += 1 + tree(&words[i + 1..], &[], &mut imports);
            continue;
        }
        let starts = |i: usize| words[i].chars().all(|c| c.is_alphanumeric() || c == '_');
        if i > 0 && words[i - 1] == "::" || !starts(i) || words.get(i + 1).is_none_or(|w| w != "::") {
            i += 1;
            continue;
        }
        let mut path = vec![words[i].clone()];
        i += 1;
        while words.get(i).is_some_and(|w| w == "::") && i + 1 < words.len() && starts(i + 1) {
            path.push(words[i + 1].clone());
            i += 2;
        }
        inline.push(path);
    }
    (imports, inline)
}

/// A module as its path in the crate; the crate's own is empty.
type Module = Vec<String>;

/// The files of a crate: what each imports, by the module where a name is defined.
struct Crate {
    paths: BTreeMap<Module, String>,
    imports: BTreeMap<Module, Vec<Named>>,
    inline: BTreeMap<Module, Vec<Vec<String>>>,
}

impl Crate {
    fn read(src: &str) -> Self {
        let sources = files(src, "rs").into_iter().filter(|p| !is_test(p));
        Self::of(sources.map(|path| (path.strip_prefix(src).expect("it lies below").to_owned(), read(&path))))
    }

    /// Of files by their names below `src/`.
    fn of(files: impl Iterator<Item = (String, String)>) -> Self {
        let mut out = Self { paths: BTreeMap::new(), imports: BTreeMap::new(), inline: BTreeMap::new() };
        for (path, text) in files {
            let mut module: Module = path.trim_end_matches(".rs").split('/').map(str::to_owned).collect();
            if module.last().is_some_and(|m| m == "mod") || module.len() == 1 && ["lib", "main"].contains(&&*module[0])
            {
                module.pop();
            }
            let (imports, inline) = named(&words(&text));
            out.paths.insert(module.clone(), path);
            out.imports.entry(module.clone()).or_default().extend(imports);
            out.inline.entry(module).or_default().extend(inline);
        }
        out
    }

    /// The module in which what a path means is defined; re-exports are followed. `None`: outside the crate.
    fn defined(&self, module: &Module, path: &[String], seen: &mut BTreeSet<(Module, String)>) -> Option<Module> {
        let mut rest = path;
        let mut at = match rest.first()?.as_str() {
            "crate" => Module::new(),
            "super" | "self" => module.clone(),
            child if self.paths.contains_key(&[&module[..], &[child.to_owned()]].concat()) => module.clone(),
            _ => return None,
        };
        while let Some(first) = rest.first().filter(|w| ["crate", "super", "self"].contains(&w.as_str())) {
            if first == "super" {
                at.pop();
            }
            rest = &rest[1..];
        }
        while let Some(child) = rest.first().map(|name| [&at[..], std::slice::from_ref(name)].concat()) {
            if !self.paths.contains_key(&child) {
                break;
            }
            (at, rest) = (child, &rest[1..]);
        }
        if let Some(name) = rest.first()
            && seen.insert((at.clone(), name.clone()))
            && let Some((path, _)) = self.imports.get(&at)?.iter().find(|(_, n)| n == name)
        {
            let whole = [path, &rest[1..]].concat();
            if let Some(found) = self.defined(&at, &whole, seen) {
                return Some(found);
            }
        }
        self.paths.contains_key(&at).then_some(at)
    }

    /// Which files each file imports. A module may use what the modules around it hold: those are not counted, nor is
    /// the crate's own file.
    fn edges(&self) -> BTreeMap<Module, BTreeSet<Module>> {
        let mut out = BTreeMap::new();
        for (module, imports) in &self.imports {
            let known = |path: &Vec<String>| match imports.iter().find(|(_, name)| *name == path[0]) {
                Some((whole, _)) => [whole, &path[1..]].concat(),
                None => path.clone(),
            };
            let inline = self.inline[module].iter().map(known);
            let all = imports.iter().map(|(path, _)| path.clone()).chain(inline);
            let defined = all.filter_map(|path| self.defined(module, &path, &mut BTreeSet::new()));
            out.insert(module.clone(), defined.filter(|to| !module.starts_with(to)).collect());
        }
        out
    }

    /// Imports that are on or between circles, as text.
    fn circles(&self) -> Vec<String> {
        let mut edges = self.edges();
        // What nothing imports, and what imports nothing, is on no circle.
        loop {
            let used: BTreeSet<Module> = edges.values().flatten().cloned().collect();
            let before = edges.len();
            edges.retain(|module, to| !to.is_empty() && used.contains(module));
            let left: BTreeSet<Module> = edges.keys().cloned().collect();
            edges.values_mut().for_each(|to| to.retain(|m| left.contains(m)));
            if edges.len() == before {
                break;
            }
        }
        let one = |(from, to): (&Module, &BTreeSet<Module>)| {
            let to: Vec<&str> = to.iter().map(|m| &*self.paths[m]).collect();
            format!("{} imports {}", self.paths[from], to.join(", "))
        };
        edges.iter().map(one).collect()
    }
}

#[test]
fn circles_are_found_through_re_exports() {
    let of =
        |files: &[(&str, &str)]| Crate::of(files.iter().map(|(p, t)| ((*p).to_owned(), (*t).to_owned()))).circles();
    let lib = ("lib.rs", "mod a; mod b; pub use a::A;");
    let a = ("a.rs", "use crate::b::{self, B as Other}; pub struct A; // use crate::c::C;\n");
    let b = |text: &'static str| ("b.rs", text);
    assert_eq!(of(&[lib, a, b("use crate::{A};")]), ["a.rs imports b.rs", "b.rs imports a.rs"]);
    assert_eq!(of(&[lib, a, b("fn f(a: &crate::a::A) {}")]).len(), 2, "paths in code count");
    assert!(
        of(&[lib, a, b("const TEXT: &str = \"use crate::A;\"; #[cfg(test)] mod tests { use crate::A; }")]).is_empty()
    );
    let bound = "use crate::A; fn f<'a>() -> impl Sized + use<'a> { g(); }";
    assert_eq!(of(&[lib, a, b(bound)]).len(), 2);
    let parent = [lib, ("a/mod.rs", "mod c; pub struct P; use c::C;"), ("a/c.rs", "use super::P; pub struct C;")];
    assert!(of(&parent).is_empty(), "a child may use what its parent holds");
    let siblings = [
        lib,
        ("a/mod.rs", "mod c; mod d; pub use d::D;"),
        ("a/c.rs", "use super::D; pub struct C;"),
        ("a/d.rs", "use super::c; fn f() { c::f() } pub struct D;"),
    ];
    assert_eq!(of(&siblings).len(), 2);
}

#[test]
fn files_import_in_no_circle() {
    let mut troubles = Vec::new();
    let manifests = [files("crates", "toml"), files("studies", "toml"), files("xtask", "toml")].concat();
    for manifest in manifests.into_iter().filter(|p| p.ends_with("Cargo.toml")) {
        let src = manifest.replace("Cargo.toml", "src/");
        troubles.extend(Crate::read(&src).circles().into_iter().map(|line| format!("{src}{line}")));
    }
    report(troubles, "Move what both need into a file below them; see ARCHITECTURE.md, \"Crates\".");
}

#[test]
fn modules_import_downwards() {
    let mut troubles = Vec::new();
    for (place, order) in ORDER {
        let src = format!("{place}/src/");
        let rank = |name: &str| order.iter().position(|n| *n == name);
        let files = Crate::read(&src);
        for (from, to) in files.edges().iter().filter(|(from, _)| !from.is_empty()) {
            let (path, Some(own)) = (&files.paths[from], rank(&from[0])) else {
                troubles.push(format!("{src}{}: module `{}` has no place in ORDER", files.paths[from], from[0]));
                continue;
            };
            for name in to.iter().map(|to| &to[0]).filter(|name| **name != from[0]).collect::<BTreeSet<_>>() {
                if rank(name).is_some_and(|r| r > own) {
                    troubles.push(format!("{src}{path}: `{}` imports `{name}`, which stands above it", from[0]));
                }
                if NEVER.iter().any(|(c, m, n)| *c == place && *m == from[0] && n.contains(&name.as_str())) {
                    troubles.push(format!("{src}{path}: `{}` must not know `{name}`", from[0]));
                }
            }
        }
        troubles.extend(map_of_another_order(place, order));
    }
    report(troubles, "Move what both need into the lower module; see ARCHITECTURE.md and ORDER in this test.");
}

/// Rows of the crate's code map whose modules stand in another order than in `order`.
fn map_of_another_order(place: &str, order: &[&str]) -> Vec<String> {
    let top = ["lib.rs", "main.rs"].map(|f| format!("{place}/src/{f}")).into_iter().find(|p| root().join(p).is_file());
    let text = read(&top.expect("a crate has a root file"));
    let rows = text.lines().filter_map(|l| l.strip_prefix("//! | `")?.split('|').next());
    let names = rows.flat_map(|row| row.split('`').step_by(2)).filter_map(|name| name.split(['/', '.']).next());
    let ranks: Vec<(&str, usize)> = names.filter_map(|n| Some((n, order.iter().position(|o| o == &n)?))).collect();
    let swapped = ranks.windows(2).filter(|w| w[0].1 > w[1].1);
    swapped.map(|w| format!("{place}: the code map has `{}` before `{}`", w[0].0, w[1].0)).collect()
}
