//! This test writes `docs/python-api*.md`: names and types of the package's stub, words of its source's comments.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Where the package is.
const PACKAGE: &str = "crates/splat4d-py";
/// Methods that users call by another name, and how they write them.
const SPOKEN: [(&str, &str); 3] = [("__new__", ""), ("__len__", "len(…)"), ("__getitem__", "…[i]")];

const AGAIN: &str = "UPDATE_GOLDEN=1 cargo test -p xtask --test python_doc";

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the repository").to_owned()
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{} cannot be read: {e}", path.display()))
}

/// The document, as Markdown.
fn document() -> String {
    let package = root().join(PACKAGE);
    let stub = read(&package.join("python/splat4d/_native.pyi"));
    let mut words = BTreeMap::new();
    let entries = std::fs::read_dir(package.join("src")).expect("the package has sources");
    let mut sources: Vec<PathBuf> = entries.map(|e| e.expect("they can be listed").path()).collect();
    sources.sort();
    for path in sources.iter().filter(|p| p.extension().is_some_and(|e| e == "rs")) {
        comments(&read(path), &mut words);
    }
    written(&stub, &words)
}

/// Documentation comments of Rust code by the name that Python has: `open`, `Scene`, `Scene.at`.
fn comments(code: &str, words: &mut BTreeMap<String, String>) {
    let (mut comment, mut owner, mut renamed, mut attribute) = (String::new(), String::new(), None, false);
    for line in code.lines() {
        let bare = line.trim();
        if let Some(text) = bare.strip_prefix("///") {
            // An empty line begins a paragraph.
            comment += if text.is_empty() { "\n\n" } else { text };
            continue;
        }
        if let Some(other) = bare.strip_prefix("#[getter(") {
            renamed = Some(other.trim_end_matches(")]").to_owned());
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
        if attribute {
            // Its arguments resemble fields.
        } else if let Some(of) = named("struct ").filter(|_| outside) {
            name = Some(of.clone());
            owner = of;
        } else if let Some(of) = named("impl ").filter(|_| outside) {
            owner = of;
        } else if let Some(function) = named("fn ") {
            let function = if function == "new" { "__new__".into() } else { renamed.take().unwrap_or(function) };
            name = Some(if outside { function } else { member(&owner, &function) });
        } else if let Some((field, _)) = item.split_once(": ").filter(|(f, _)| !outside && !f.contains(' ')) {
            name = Some(member(&owner, field));
        }
        if let Some(name) = name
            && !comment.is_empty()
        {
            words.entry(name).or_insert_with(|| comment.trim().to_owned());
        }
        // Attributes, which may have several lines, are between a comment and its item.
        attribute |= bare.starts_with("#[");
        if !attribute {
            comment.clear();
        }
        attribute &= !bare.ends_with(']');
    }
}

fn member(owner: &str, name: &str) -> String {
    if owner.is_empty() { name.to_owned() } else { format!("{owner}.{name}") }
}

/// The document of a stub.
fn written(stub: &str, words: &BTreeMap<String, String>) -> String {
    let mut out = String::from(
        "# Python API\n\nEvery class and function of the package `splat4d`, with types. Tasks, shapes and units: [Python](python.md). \
         Arrays are NumPy's, paths strings or `os.PathLike`.\n",
    );
    let _ = write!(out, "\nThis file is generated: `{AGAIN}`.\n");
    let (mut functions, mut classes) = (String::new(), Vec::<Class>::new());
    let (mut owner, mut decorators, mut signature) = (String::new(), Vec::new(), String::new());
    for line in stub.lines() {
        let (bare, outside) = (line.trim(), !line.starts_with(' '));
        if !signature.is_empty() {
            // The rest of a definition over several lines.
            signature += bare;
            signature += if bare.ends_with(',') { " " } else { "" };
        } else if let Some(class) = bare.strip_prefix("class ") {
            owner = class.split(['(', ':']).next().unwrap_or_default().to_owned();
            let about = words.get(&owner).map_or("", String::as_str);
            classes.push(Class { head: format!("\n## {owner}\n\n{about}\n"), rows: String::new() });
            decorators.clear();
        } else if let Some(decorator) = bare.strip_prefix('@') {
            decorators.push(decorator.to_owned());
        } else if bare.starts_with("def ") {
            if outside {
                owner.clear();
            }
            signature = bare.to_owned();
        } else if let Some(text) = bare.strip_prefix("\"\"\"") {
            let class = classes.last_mut().expect("a class has begun");
            let _ = write!(class.head, "\n{}\n", text.trim_end_matches("\"\"\""));
        } else if let Some((field, kind)) = bare.split_once(": ").filter(|_| !outside && !owner.is_empty()) {
            member_of(&mut classes, &owner, field, &format!("{field}: {kind}"), words);
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
            // Names with an underscore that are not operators are private; `main` is the command's own entry.
            if spoken.is_some() || !(name.starts_with('_') || name == "main") {
                if owner.is_empty() {
                    let _ = write!(functions, "\n### {name}\n{}", block(&shown, words.get(&name)));
                } else {
                    member_of(&mut classes, &owner, &name, &shown, words);
                }
            }
            signature.clear();
            decorators.clear();
        }
    }
    let _ = write!(out, "\n## Functions\n{functions}");
    for class in classes {
        out += &class.head;
        if !class.rows.is_empty() {
            let _ = write!(out, "\n| member | meaning |\n|---|---|\n{}", class.rows);
        }
    }
    out
}

/// A class: its words and long signatures, then a row per other member.
struct Class {
    head: String,
    rows: String,
}

/// Columns that a page shows without scrolling.
const COLUMNS: usize = 96;

/// Adds a member to the newest class: a row, or a block of its own if its signature is long.
fn member_of(classes: &mut [Class], owner: &str, name: &str, shown: &str, words: &BTreeMap<String, String>) {
    let class = classes.last_mut().expect("a class has begun");
    let said = words.get(&member(owner, name));
    if shown.len() > COLUMNS {
        let owned = if name == "__new__" { shown.to_owned() } else { format!("{owner}.{shown}") };
        class.head += &block(&owned, said);
    } else {
        let said = said.map_or_else(String::new, |s| s.split_whitespace().collect::<Vec<_>>().join(" "));
        let _ = writeln!(class.rows, "| `{}` | {} |", shown.replace('|', "\\|"), said.replace('|', "\\|"));
    }
}

/// A signature and its words.
fn block(shown: &str, said: Option<&String>) -> String {
    let said = said.map_or("", String::as_str).replace("\n\n ", "\n\n");
    format!("\n```python\n{}\n```\n\n{said}\n", broken(shown))
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

/// A long signature in lines that fit.
fn broken(shown: &str) -> String {
    let (Some(open), Some(close)) = (shown.find('('), shown.rfind(')')) else { return shown.to_owned() };
    if shown.len() <= COLUMNS {
        return shown.to_owned();
    }
    let (mut arguments, mut depth) = (vec![String::new()], 0);
    for c in shown[open + 1..close].chars() {
        depth += i32::from(c == '[' || c == '(') - i32::from(c == ']' || c == ')');
        if c == ',' && depth == 0 {
            arguments.push(String::new());
        } else {
            arguments.last_mut().expect("there is one").push(c);
        }
    }
    let mut lines = vec![String::new()];
    for argument in arguments.iter().map(|a| a.trim()) {
        let line = lines.last_mut().expect("there is one");
        if !line.is_empty() && line.len() + argument.len() + 6 > COLUMNS {
            lines.push(format!("{argument}, "));
        } else {
            *line += &format!("{argument}, ");
        }
    }
    let inside = lines.join("\n    ").replace(" \n", "\n");
    format!("{}(\n    {}\n{}", &shown[..open], inside.trim_end_matches(", "), &shown[close..])
}

/// The page of scenes and captures, which follow each other in the stub, and the first of them and the first after
/// them.
const SCENES: (&str, &str, &str) = ("docs/python-api-scenes.md", "\n## Gaussians\n", "\n## View\n");

/// The class that is written in Python: its words and how it is made.
fn motion() -> String {
    let code = read(&root().join(PACKAGE).join("python/splat4d/motion.py"));
    let words = code.split_once("class Motion:\n    \"\"\"").expect("there is the class").1;
    let words = words.split_once("\"\"\"").expect("its words end").0.replace("\n    ", "\n");
    let made = code.split_once("def __init__(\n        self,\n").expect("it is made").1;
    let made = made.split_once("    ) -> None").expect("its arguments end").0.replace("\n        ", "\n    ");
    format!("\n## Motion\n\n{}\n\n```python\nMotion(\n    {}\n)\n```\n", words.trim(), made.trim())
}

/// The pages: file and text.
fn pages() -> [(&'static str, String); 2] {
    let text = document();
    let (file, first, after) = SCENES;
    let (start, rest) = text.split_once(first).expect("the stub has Gaussians");
    let (scenes, end) = rest.split_once(after).expect("the stub has views");
    let head = format!(
        "# Python API: scenes and captures\n\nGaussians, scenes and captures of the package `splat4d`. Functions, cameras and runs: \
         [Python API](python-api.md).\n\nThis file is generated: `{AGAIN}`.\n"
    );
    let start = start.replacen(
        "\n## ",
        "\nGaussians, scenes and captures: [scenes and captures](python-api-scenes.md).\n\n## ",
        1,
    );
    [
        ("docs/python-api.md", format!("{start}{}{after}{end}", motion())),
        (file, format!("{head}{first}{}\n", scenes.trim_end())),
    ]
}

#[test]
fn every_public_name_of_the_package_is_on_the_page_with_words() {
    let pages = pages();
    for (file, text) in &pages {
        let path = root().join(file);
        if std::env::var_os("UPDATE_GOLDEN").is_some() {
            std::fs::write(&path, text).expect("docs/ can be written");
        }
        let found = std::fs::read_to_string(&path).unwrap_or_default();
        assert!(found == *text, "{file} is out of date. Write it again with\n    {AGAIN}");
    }
    let text = pages.map(|(_, text)| text).concat();
    let init = read(&root().join(PACKAGE).join("python/splat4d/__init__.py"));
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
        "/// Says a.\n#[pyclass]\npub(crate) struct A {\n    /// Wide.\n    w: usize,\n}\nimpl A {\n    /// Made.\n    fn new() {}\n    /// Kept.\n    #[getter(K)]\n    fn k() {}\n}\n",
        &mut words,
    );
    assert_eq!(words["A"], "Says a.");
    assert_eq!(["A.w", "A.__new__", "A.K"].map(|name| words[name].as_str()), ["Wide.", "Made.", "Kept."]);
    let stub = "class A:\n    w: int\n    def __new__(\n        cls,\n        x: int,\n    ) -> A: ...\n    @property\n    def p(self) -> _F32: ...\ndef f(a: _Path) -> A: ...\n";
    let text = written(stub, &words);
    for there in [
        "## A\n\nSays a.",
        "| `w: int` | Wide. |",
        "| `A(x: int) -> A` |",
        "`p: float32 array`",
        "### f\n\n```python\nf(a: path) -> A",
    ] {
        assert!(text.contains(there), "{there} in {text}");
    }
}
