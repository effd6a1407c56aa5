//! The reference of the Python package as a document: names and types of its stub, words of its source's comments.

use anyhow::{Context, Result};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

/// Where the package is.
const PACKAGE: &str = "crates/splat4d-py";
/// Methods that users call by another name, and how they write them.
const SPOKEN: [(&str, &str); 3] = [("__new__", ""), ("__len__", "len(…)"), ("__getitem__", "…[i]")];

/// The document, as Markdown. Errors: the package's files cannot be read.
pub(crate) fn document(root: &Path) -> Result<String> {
    let read = |path: &Path| std::fs::read_to_string(path).with_context(|| path.display().to_string());
    let stub = read(&root.join(PACKAGE).join("python/splat4d/_native.pyi"))?;
    let mut words = BTreeMap::new();
    for name in crate::site::list(&root.join(PACKAGE).join("src"), "rs")? {
        comments(&read(&root.join(PACKAGE).join("src").join(name))?, &mut words);
    }
    Ok(written(&stub, &words))
}

/// Documentation comments of Rust code by the name that Python has: `open`, `Scene`, `Scene.at`.
fn comments(code: &str, words: &mut BTreeMap<String, String>) {
    let (mut comment, mut owner) = (String::new(), String::new());
    for line in code.lines() {
        let bare = line.trim();
        if let Some(text) = bare.strip_prefix("///") {
            // An empty line begins a paragraph.
            comment += if text.is_empty() { "\n\n" } else { text };
            continue;
        }
        let outside = !line.starts_with(' ');
        if outside && bare == "}" {
            owner.clear();
        }
        let item = bare.trim_start_matches("pub(crate) ");
        let named = |prefix: &str| {
            let name = item.strip_prefix(prefix)?;
            Some(name.split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap_or_default().to_owned())
        };
        let mut name = None;
        if let Some(of) = named("struct ").filter(|_| outside) {
            name = Some(of.clone());
            owner = of;
        } else if let Some(of) = named("impl ").filter(|_| outside) {
            owner = of;
        } else if let Some(function) = named("fn ") {
            let function = if function == "new" { "__new__".into() } else { function };
            name = Some(if outside { function } else { member(&owner, &function) });
        } else if let Some((field, _)) = item.split_once(": ").filter(|(f, _)| !outside && !f.contains(' ')) {
            name = Some(member(&owner, field));
        }
        if let Some(name) = name
            && !comment.is_empty()
        {
            words.entry(name).or_insert_with(|| comment.trim().to_owned());
        }
        // Attributes stand between a comment and its item.
        if !bare.starts_with("#[") && !bare.starts_with("hold_out=") {
            comment.clear();
        }
    }
}

fn member(owner: &str, name: &str) -> String {
    if owner.is_empty() { name.to_owned() } else { format!("{owner}.{name}") }
}

/// The document of a stub.
fn written(stub: &str, words: &BTreeMap<String, String>) -> String {
    let mut out = String::from(
        "# The Python API\n\nThe package `splat4d`: every class and function with its types. How they are used, and the shapes and \
         units of arrays: [Python](../docs/python.md). Arrays are NumPy's, paths strings or `os.PathLike`.\n",
    );
    let (mut functions, mut classes) = (String::new(), String::new());
    let (mut owner, mut decorators, mut signature) = (String::new(), Vec::new(), String::new());
    for line in stub.lines() {
        let (bare, outside) = (line.trim(), !line.starts_with(' '));
        if !signature.is_empty() {
            // The rest of a definition over several lines.
            signature += bare;
            signature += if bare.ends_with(',') { " " } else { "" };
        } else if let Some(class) = bare.strip_prefix("class ") {
            owner = class.split(['(', ':']).next().unwrap_or_default().to_owned();
            let _ = write!(classes, "\n## {owner}\n\n{}\n", words.get(&owner).map_or("", String::as_str));
            decorators.clear();
        } else if let Some(decorator) = bare.strip_prefix('@') {
            decorators.push(decorator.to_owned());
        } else if bare.starts_with("def ") {
            if outside {
                owner.clear();
            }
            signature = bare.to_owned();
        } else if let Some(text) = bare.strip_prefix("\"\"\"") {
            let _ = write!(classes, "\n{}\n", text.trim_end_matches("\"\"\""));
        } else if let Some((field, kind)) = bare.split_once(": ").filter(|_| !outside && !owner.is_empty()) {
            entry(&mut classes, &owner, field, &format!("{field}: {kind}"), words);
        }
        if signature.ends_with(": ...") || signature.ends_with(": pass") {
            let text =
                signature.trim_start_matches("def ").trim_end_matches(": ...").replace("( ", "(").replace(", )", ")");
            let name = text.split('(').next().unwrap_or_default().to_owned();
            let spoken = SPOKEN.iter().find(|(n, _)| *n == name);
            let plain = without_self(&text);
            let shown = match (spoken, decorators.iter().any(|d| d == "property")) {
                (Some((_, "")), _) => format!("{owner}{}", plain.trim_start_matches("__new__")),
                (Some((_, call)), _) => (*call).to_owned(),
                (None, true) => format!("{name}: {}", plain.rsplit(" -> ").next().unwrap_or_default()),
                (None, false) => plain,
            };
            // What begins with an underscore and is no operator is nobody's; `main` is the command's own entry.
            if spoken.is_some() || !(name.starts_with('_') || name == "main") {
                let part = if owner.is_empty() { &mut functions } else { &mut classes };
                entry(part, &owner, &name, &shown, words);
            }
            signature.clear();
            decorators.clear();
        }
    }
    let _ = write!(out, "\n## Functions\n{functions}{classes}");
    out
}

fn entry(out: &mut String, owner: &str, name: &str, shown: &str, words: &BTreeMap<String, String>) {
    let said = words.get(&member(owner, name)).map_or("", String::as_str);
    let title = if SPOKEN.iter().any(|(n, _)| *n == name) { shown.split('(').next().unwrap_or(shown) } else { name };
    let title = if owner.is_empty() || title == owner { title.to_owned() } else { format!("{owner}.{title}") };
    let _ = write!(out, "\n### {title}\n\n```python\n{}\n```\n\n{said}\n", broken(shown));
}

/// A signature as callers see it: without `self` and `cls`, and with the types' own names.
fn without_self(text: &str) -> String {
    let text = ["self, ", "cls, "].iter().fold(text.to_owned(), |t, own| t.replacen(&format!("({own}"), "(", 1));
    let text =
        text.replacen("(self)", "()", 1).replace("_Path", "path").replace("_Device", "\"cpu\" | \"gpu\" | \"auto\"");
    text.replace("_F32", "float32 array")
        .replace("_F64", "float64 array")
        .replace("_Progress", "callable")
        .replace("_Loss", "callable")
}

/// A long signature with an argument a line.
fn broken(shown: &str) -> String {
    /// Columns that a page shows without scrolling.
    const COLUMNS: usize = 96;
    let (Some(open), Some(close)) = (shown.find('('), shown.rfind(')')) else { return shown.to_owned() };
    if shown.len() <= COLUMNS {
        return shown.to_owned();
    }
    let (mut out, mut depth) = (String::new(), 0);
    for c in shown[open + 1..close].chars() {
        depth += i32::from(c == '[' || c == '(') - i32::from(c == ']' || c == ')');
        out.push(c);
        if c == ',' && depth == 0 {
            out += "\n   ";
        }
    }
    format!("{}(\n    {}\n{}", &shown[..open], out.trim_end(), &shown[close..])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_public_name_of_the_package_is_on_the_page_with_words() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the repository");
        let text = document(root).expect("the package's files can be read");
        let init = std::fs::read_to_string(root.join(PACKAGE).join("python/splat4d/__init__.py")).expect("it is there");
        let all = init.split_once("__all__").expect("it names what is public").1;
        let names: Vec<&str> = all.split('"').skip(1).step_by(2).filter(|n| !n.starts_with('_')).collect();
        assert!(names.len() > 10, "{names:?}");
        for name in names {
            let class = text.split_once(&format!("\n## {name}\n")).map(|(_, rest)| rest);
            let function = text.split_once(&format!("\n### {name}\n\n```python\n{name}(")).map(|(_, rest)| rest);
            let rest = match (class, function) {
                (Some(rest), _) => rest,
                (_, Some(rest)) => rest.split_once("```\n").expect("the signature ends").1,
                _ => panic!("{name} is not on the page"),
            };
            let said = rest.trim_start().lines().next().unwrap_or_default();
            assert!(said.len() > 10 && !said.starts_with('#'), "{name} says nothing: {said:?}");
        }
        assert!(!text.contains("_F32") && !text.contains("(self"));
    }

    #[test]
    fn stubs_become_calls() {
        let mut words = BTreeMap::new();
        comments(
            "/// Says a.\n#[pyclass]\npub(crate) struct A {\n    /// Wide.\n    w: usize,\n}\nimpl A {\n    /// Made.\n    fn new() {}\n}\n",
            &mut words,
        );
        assert_eq!(words["A"], "Says a.");
        assert_eq!((words["A.w"].as_str(), words["A.__new__"].as_str()), ("Wide.", "Made."));
        let stub = "class A:\n    w: int\n    def __new__(\n        cls,\n        x: int,\n    ) -> A: ...\n    @property\n    def p(self) -> _F32: ...\ndef f(a: _Path) -> A: ...\n";
        let text = written(stub, &words);
        for there in
            ["## A\n\nSays a.", "w: int\n", "A(x: int) -> A", "p: float32 array", "### f\n\n```python\nf(a: path) -> A"]
        {
            assert!(text.contains(there), "{there} in {text}");
        }
    }
}
