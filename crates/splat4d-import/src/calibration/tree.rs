//! Texts in YAML, XML, JSON or TOML as one kind of tree, so that a dialect is read alike in any of them.

use splat4d::{Error, Result};

/// A value with others in it.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Tree {
    /// A number; NaN and infinities as written.
    Number(f64),
    /// Anything else that is one.
    Word(String),
    /// Values in a row.
    List(Vec<Tree>),
    /// Values with keys, in the file's order.
    Map(Vec<(String, Tree)>),
    /// An XML element: its tag, attributes and children.
    Element(String, Vec<(String, String)>, Vec<Tree>),
}

/// Deepest nesting, also checked before parsing, because some parsers recurse as deep as the text.
const MAX_DEPTH: usize = 64;
const DEEPEST: usize = 256;

/// About how deep a text is nested, and no less: brackets, tags, or what lines of YAML begin with.
fn depth(text: &str) -> usize {
    let (mut open, mut most) = (0usize, 0usize);
    if text.starts_with('<') {
        for piece in text.split('<').skip(1) {
            match piece.as_bytes().first() {
                Some(b'/') => open = open.saturating_sub(1),
                Some(b'?' | b'!') => {}
                _ if piece.split('>').next().is_some_and(|tag| tag.ends_with('/')) => {}
                _ => open += 1,
            }
            most = most.max(open);
        }
        return most;
    }
    for line in text.lines() {
        let begins = line.find(|c| !" -?:".contains(c)).unwrap_or(line.len());
        for c in line.chars() {
            match c {
                '[' | '{' => open += 1,
                ']' | '}' => open = open.saturating_sub(1),
                _ => {}
            }
            most = most.max(open + begins);
        }
    }
    most
}

impl Tree {
    /// Reads a text; its beginning determines the syntax.
    pub(super) fn parse(text: &str) -> Result<Self> {
        let text = text.trim_start_matches('\u{feff}');
        let start = text.trim_start();
        if start.is_empty() {
            return Err(Error::input("the file is empty").remedy("Export the calibration again."));
        }
        if depth(start) > DEEPEST {
            return Err(Error::input("it is nested too deeply").remedy("Export the calibration again."));
        }
        if start.starts_with('<') {
            return xml(text);
        }
        if start.starts_with('{') {
            let value: serde_json::Value = serde_json::from_str(text).map_err(|e| {
                let remedy = "Correct the file there; JSON has no NaN and no Infinity.";
                Error::input(format!("it is not valid JSON: {e}")).remedy(remedy)
            })?;
            return Ok(json(&value));
        }
        let table = if start.starts_with("%YAML") { None } else { Some(text.parse::<toml::Table>()) };
        if let Some(Ok(table)) = table {
            return Ok(Self::Map(table.into_iter().map(|(k, v)| (k, toml(v))).collect()));
        }
        let other = yaml(text);
        match (table, other) {
            (_, Ok(tree @ Self::Map(_))) => Ok(tree),
            // A mistake in TOML makes one long word to YAML.
            (Some(Err(why)), _) if text.lines().any(|l| l.trim_start().starts_with('[')) => {
                Err(Error::input(format!("it is not valid TOML: {}", why.to_string().trim()))
                    .remedy("Correct it there."))
            }
            (_, other) => other,
        }
    }

    /// The value of a key.
    pub(super) fn get(&self, key: &str) -> Option<&Tree> {
        match self {
            Self::Map(entries) => entries.iter().find(|(k, _)| k == key).map(|(_, v)| v),
            _ => None,
        }
    }

    /// The entries of a map; none of anything else.
    pub(super) fn entries(&self) -> &[(String, Tree)] {
        match self {
            Self::Map(entries) => entries,
            _ => &[],
        }
    }

    /// The values of a list.
    pub(super) fn list(&self) -> Option<&[Tree]> {
        match self {
            Self::List(values) => Some(values),
            _ => None,
        }
    }

    /// A word or a number, as written.
    pub(super) fn text(&self) -> Option<String> {
        match self {
            Self::Word(word) => Some(word.clone()),
            Self::Number(n) => Some(n.to_string()),
            _ => None,
        }
    }

    /// A number; NaN of what is none.
    pub(super) fn number(&self) -> Option<f64> {
        match self {
            Self::Number(n) => Some(*n),
            _ => None,
        }
    }

    /// A matrix: rows and columns, and its numbers row by row. A plain list is a column. None: it is not a matrix.
    pub(super) fn matrix(&self) -> Option<Matrix> {
        if let (Some(rows), Some(columns), Some(data)) = (self.get("rows"), self.get("cols"), self.get("data")) {
            let data = data.list()?.iter().map(Tree::number).collect::<Option<Vec<f64>>>()?;
            let shape = [rows.number()?, columns.number()?];
            let fits = shape[0] * shape[1] == data.len() as f64;
            return fits.then(|| Matrix { rows: shape[0] as usize, columns: shape[1] as usize, data });
        }
        let list = self.list()?;
        if list.iter().all(|v| v.number().is_some()) {
            let data: Vec<f64> = list.iter().filter_map(Tree::number).collect();
            return Some(Matrix { rows: data.len(), columns: 1, data });
        }
        let rows: Vec<Vec<f64>> = list
            .iter()
            .map(|row| row.list()?.iter().map(Tree::number).collect::<Option<Vec<f64>>>())
            .collect::<Option<_>>()?;
        let columns = rows.first()?.len();
        let fits = rows.iter().all(|r| r.len() == columns);
        fits.then(|| Matrix { rows: rows.len(), columns, data: rows.concat() })
    }
}

/// Numbers in rows and columns.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Matrix {
    pub rows: usize,
    pub columns: usize,
    /// Row by row.
    pub data: Vec<f64>,
}

/// A word as a number where it is one, as OpenCV and YAML write them.
fn scalar(word: &str) -> Tree {
    let word = word.trim();
    let special = match word.to_ascii_lowercase().as_str() {
        ".nan" | "nan" | "-nan" => Some(f64::NAN),
        ".inf" | "inf" | "+.inf" => Some(f64::INFINITY),
        "-.inf" | "-inf" => Some(f64::NEG_INFINITY),
        _ => None,
    };
    let digits = word.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c));
    special.or_else(|| word.parse().ok().filter(|_| digits)).map_or_else(|| Tree::Word(word.to_owned()), Tree::Number)
}

fn json(value: &serde_json::Value) -> Tree {
    use serde_json::Value;
    match value {
        Value::Number(n) => n.as_f64().map_or_else(|| Tree::Word(n.to_string()), Tree::Number),
        Value::String(s) => Tree::Word(s.clone()),
        Value::Bool(b) => Tree::Word(b.to_string()),
        Value::Null => Tree::Word(String::new()),
        Value::Array(list) => Tree::List(list.iter().map(json).collect()),
        Value::Object(map) => Tree::Map(map.iter().map(|(k, v)| (k.clone(), json(v))).collect()),
    }
}

fn toml(value: toml::Value) -> Tree {
    use toml::Value;
    match value {
        Value::Integer(n) => Tree::Number(n as f64),
        Value::Float(n) => Tree::Number(n),
        Value::String(s) => Tree::Word(s),
        Value::Boolean(b) => Tree::Word(b.to_string()),
        Value::Datetime(d) => Tree::Word(d.to_string()),
        Value::Array(list) => Tree::List(list.into_iter().map(toml).collect()),
        Value::Table(table) => Tree::Map(table.into_iter().map(|(k, v)| (k, toml(v))).collect()),
    }
}

fn yaml(text: &str) -> Result<Tree> {
    // OpenCV's first line, "%YAML:1.0", is no directive of YAML.
    let body: String = text
        .lines()
        .map(|line| if line.trim_start().starts_with("%YAML") { "" } else { line })
        .flat_map(|line| [line, "\n"])
        .collect();
    let wrong = |why: String| {
        Error::input(format!("it is neither YAML, TOML, JSON nor XML: {why}")).remedy("Export the calibration again.")
    };
    // Few anchors of anchors make gigabytes, and no calibration has any.
    let begins = |at: usize| body[..at].chars().next_back().is_none_or(|before| !before.is_alphanumeric());
    if body.match_indices('&').any(|(at, _)| begins(at)) {
        return Err(wrong("it has anchors (&), which calibrations have not".into()));
    }
    let documents = yaml_rust2::YamlLoader::load_from_str(&body).map_err(|e| wrong(e.to_string()))?;
    let first = documents.first().ok_or_else(|| wrong("there is nothing in it".into()))?;
    yaml_tree(first, 0)
}

fn yaml_tree(value: &yaml_rust2::Yaml, depth: usize) -> Result<Tree> {
    use yaml_rust2::Yaml;
    if depth > MAX_DEPTH {
        return Err(Error::input("it is nested too deeply").remedy("Export the calibration again."));
    }
    Ok(match value {
        Yaml::Integer(n) => Tree::Number(*n as f64),
        Yaml::Real(word) => scalar(word),
        Yaml::String(word) => {
            // OpenCV writes ".Nan", which is a word to YAML.
            match scalar(word) {
                Tree::Number(n) if !n.is_finite() => Tree::Number(n),
                _ => Tree::Word(word.clone()),
            }
        }
        Yaml::Boolean(b) => Tree::Word(b.to_string()),
        Yaml::Array(list) => Tree::List(list.iter().map(|v| yaml_tree(v, depth + 1)).collect::<Result<_>>()?),
        Yaml::Hash(map) => {
            let mut entries: Vec<(String, Tree)> = Vec::new();
            for (key, value) in map {
                let key = yaml_tree(key, depth + 1)?.text().unwrap_or_default();
                entries.push((key, yaml_tree(value, depth + 1)?));
            }
            Tree::Map(entries)
        }
        Yaml::Null | Yaml::Alias(_) | Yaml::BadValue => Tree::Word(String::new()),
    })
}

/// The root of OpenCV's files.
const STORAGE: &str = "opencv_storage";

fn xml(text: &str) -> Result<Tree> {
    let wrong =
        |why: String| Error::input(format!("it is not valid XML: {why}")).remedy("Export the calibration again.");
    let document = roxmltree::Document::parse(text).map_err(|e| wrong(e.to_string()))?;
    let root = document.root_element();
    if root.descendants().any(|n| n.ancestors().nth(MAX_DEPTH).is_some()) {
        return Err(wrong("it is nested too deeply".into()));
    }
    Ok(if root.has_tag_name(STORAGE) { storage(root) } else { element(root) })
}

fn element(node: roxmltree::Node<'_, '_>) -> Tree {
    let attributes = node.attributes().map(|a| (a.name().to_owned(), a.value().to_owned())).collect();
    let mut inside: Vec<Tree> = node.children().filter(roxmltree::Node::is_element).map(element).collect();
    if let Some(text) = node.text().map(str::trim).filter(|t| !t.is_empty()) {
        inside.push(Tree::Word(text.to_owned()));
    }
    Tree::Element(node.tag_name().name().to_owned(), attributes, inside)
}

/// An element of OpenCV's XML: a map of its children, or the words in it.
fn storage(node: roxmltree::Node<'_, '_>) -> Tree {
    let children: Vec<_> = node.children().filter(roxmltree::Node::is_element).collect();
    if children.is_empty() {
        let text = node.text().unwrap_or_default();
        let words: Vec<Tree> = text.split_ascii_whitespace().map(scalar).collect();
        // Only data is a list even of one.
        return match <[Tree; 1]>::try_from(words) {
            Ok([one]) if !node.has_tag_name("data") => one,
            Ok(one) => Tree::List(one.into()),
            Err(words) if words.iter().all(|w| matches!(w, Tree::Number(_))) => Tree::List(words),
            Err(_) => Tree::Word(text.trim().to_owned()),
        };
    }
    if children.iter().all(|c| c.has_tag_name("_")) {
        return Tree::List(children.into_iter().map(storage).collect());
    }
    Tree::Map(children.into_iter().map(|c| (c.tag_name().name().to_owned(), storage(c))).collect())
}
