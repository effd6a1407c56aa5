//! `xtask count`: lines of code a crate, without tests, comments and blank lines; players, shaders and studies counted.

use anyhow::{Context, Result};
use std::collections::BTreeMap;
use std::path::Path;

/// Folders whose files are counted, and the endings of code.
const ROOTS: [&str; 3] = ["crates", "studies", "xtask"];
const ENDINGS: [&str; 6] = ["rs", "wgsl", "js", "mjs", "html", "css"];
/// Folders that hold tests, benches, examples or what a build makes.
const LEFT_OUT: [&str; 5] = ["tests", "benches", "examples", "target", "node_modules"];

pub(crate) fn command(arguments: &[String]) -> Result<()> {
    anyhow::ensure!(arguments.len() <= 1, "count takes one folder at most: the repository");
    let root = Path::new(arguments.first().map_or(".", String::as_str));
    let mut sums = BTreeMap::new();
    for folder in ROOTS.map(|r| root.join(r)).iter().filter(|f| f.is_dir()) {
        walk(root, folder, &mut sums)?;
    }
    anyhow::ensure!(!sums.is_empty(), "{} holds none of {}", root.display(), ROOTS.join(", "));
    for (name, lines) in &sums {
        println!("{lines:>8}  {name}");
    }
    println!("{:>8}  in all", sums.values().sum::<usize>());
    Ok(())
}

fn walk(root: &Path, folder: &Path, sums: &mut BTreeMap<String, usize>) -> Result<()> {
    for entry in std::fs::read_dir(folder).with_context(|| format!("{} cannot be read", folder.display()))? {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if path.is_dir() {
            if !LEFT_OUT.contains(&name.as_str()) {
                walk(root, &path, sums)?;
            }
            continue;
        }
        let ending = path.extension().unwrap_or_default().to_string_lossy().into_owned();
        let test = name == "tests.rs" || name.ends_with("_tests.rs");
        if ENDINGS.contains(&ending.as_str()) && !test {
            let text = std::fs::read_to_string(&path).with_context(|| format!("{} cannot be read", path.display()))?;
            let parts: Vec<_> = path.strip_prefix(root)?.iter().map(|p| p.to_string_lossy()).collect();
            let of = parts[..parts.len().min(2)].join("/");
            *sums.entry(of.replace("/src", "")).or_default() += lines(&text, ending == "rs");
        }
    }
    Ok(())
}

/// Lines of a file that are neither blank nor comment; of Rust, none from a test module or a test-only item on.
fn lines(text: &str, rust: bool) -> usize {
    let (mut count, mut block) = (0, false);
    let mut skip: Option<usize> = None;
    for line in text.lines() {
        let code = line.trim();
        let indent = line.len() - line.trim_start().len();
        if let Some(of) = skip {
            // A test-only item ends where a line of its own indent closes it.
            if indent == of && !code.is_empty() && (code.ends_with('}') || code.ends_with(';')) {
                skip = None;
            }
            continue;
        }
        if rust && code.starts_with("#[cfg(test)]") {
            skip = Some(indent);
            continue;
        }
        if block {
            block = !ends_comment(code);
            continue;
        }
        if code.starts_with("/*") || code.starts_with("<!--") {
            block = !ends_comment(code);
            continue;
        }
        count += usize::from(!code.is_empty() && !code.starts_with("//"));
    }
    count
}

fn ends_comment(code: &str) -> bool {
    code.contains("*/") || code.contains("-->")
}

#[cfg(test)]
mod tests {
    use super::lines;

    #[test]
    fn comments_blank_lines_and_tests_do_not_count() {
        let rust = "//! Doc.\n\nfn a() {\n    b(); // why\n}\n\n#[cfg(test)]\nuse x::y;\n\n/* long\n   comment */\nconst C: u8 = 1;\n\
            #[cfg(test)]\nmod tests {\n    fn t() {\n    }\n}\nfn last() {}\n";
        assert_eq!(lines(rust, true), 5);
        assert_eq!(lines("// c\nlet a = 1;\n\n/* c */\nf();\n", false), 2);
    }
}
