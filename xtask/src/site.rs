//! The static site: documents as pages, the Python API's page, the Rust API's by rustdoc, and a gallery that plays the example scenes. Any host of
//! files serves the folder.

use crate::files::write_file;
use anyhow::{Context, Result, bail, ensure};
use pulldown_cmark::{Event, Options, Parser, Tag, TagEnd, html};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Folders all of whose documents become pages.
const PAGES: [&str; 2] = ["docs", "studies/records"];
/// Documents of the root that become pages; the first is the front page.
const ROOT: [&str; 6] =
    ["README.md", "ARCHITECTURE.md", "CONVENTIONS.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"];
/// The menu: page and name.
const MENU: [(&str, &str); 8] = [
    ("index.html", "splat4d"),
    ("gallery/index.html", "Play"),
    ("docs/README.html", "Documentation"),
    ("docs/verbs.html", "Commands"),
    ("docs/recipe.html", "Settings"),
    ("docs/python.html", "Python"),
    ("docs/player.html", "Player"),
    ("api/index.html", "API"),
];
/// Crates with pages of their own, and what each is for.
const CRATES: [(&str, &str); 5] = [
    ("splat4d", "scenes, motion models, the renderer, formats"),
    ("splat4d-train", "captures, training, evaluation"),
    ("splat4d-dynamics", "forecasts"),
    ("splat4d-import", "captures of videos"),
    ("splat4d-serve", "the player and its server"),
];
const REPOSITORY: &str = "https://github.com/splat4d/splat4d/blob/main/";

const STYLE: &str = "\
:root{color-scheme:light dark;--ink:#1b1f24;--soft:#5a636e;--line:#d9dee4;--page:#fff;--code:#f4f6f8;--link:#0a776b}
@media(prefers-color-scheme:dark){:root{--ink:#e6e9ed;--soft:#9aa4af;--line:#2c333b;--page:#111418;--code:#1a1f25;--link:#58d0be}}
body{margin:0;background:var(--page);color:var(--ink);font:16px/1.6 system-ui,sans-serif}
nav{display:flex;flex-wrap:wrap;gap:.25rem 1.25rem;padding:.75rem 1.25rem;border-bottom:1px solid var(--line)}
nav a{color:var(--soft);text-decoration:none}nav a:first-child{font-weight:700;color:var(--ink)}nav a:hover{color:var(--link)}
main{max-width:56rem;margin:0 auto;padding:1rem 1.25rem 4rem}
main.wide{max-width:80rem}
h1,h2,h3{line-height:1.25}a{color:var(--link)}img{max-width:100%;height:auto;border-radius:6px}
pre,code{font:.875em/1.5 ui-monospace,monospace;background:var(--code);border-radius:4px}
pre{padding:.75rem 1rem;overflow-x:auto}code{padding:.1em .3em}pre code{padding:0;background:none;font-size:1em}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:.9em}
th,td{border-bottom:1px solid var(--line);padding:.4rem .75rem .4rem 0;text-align:left;vertical-align:top}
splat-4d{display:block;width:100%;height:min(70vh,46rem)}
";

/// `site OUT [--no-api]`
pub(crate) fn command(arguments: &[String]) -> Result<()> {
    let (out, api) = match arguments {
        [out] => (out, true),
        [out, flag] if flag == "--no-api" => (out, false),
        _ => bail!("{}", crate::USAGE),
    };
    let (root, out) = (repository(), Path::new(out));
    ensure!(!out.exists() || out.join(MARK).is_file(), "{} holds something else than a site", out.display());
    if out.exists() {
        std::fs::remove_dir_all(out).with_context(|| out.display().to_string())?;
    }
    write_file(&out.join(MARK), b"A site that xtask made; it replaces this folder as a whole.\n")?;
    let mut documents: Vec<PathBuf> = ROOT.iter().map(PathBuf::from).collect();
    for folder in PAGES {
        documents.extend(list(&root.join(folder), "md")?.into_iter().map(|name| Path::new(folder).join(name)));
    }
    for document in &documents {
        let text = std::fs::read_to_string(root.join(document)).with_context(|| document.display().to_string())?;
        write_file(&out.join(page_of(document)), page(&text, document, &documents).as_bytes())?;
    }
    copy(&root.join("docs/images"), &out.join("docs/images"))?;
    for name in ["LICENSE-MIT", "LICENSE-APACHE", "CITATION.cff"] {
        copy(&root.join(name), &out.join(name))?;
    }
    gallery(&root, &out.join("gallery"))?;
    let mut apis = String::from("# The API\n\n- [Python](python.md): the package `splat4d`\n");
    if api {
        let packages = CRATES.iter().flat_map(|(name, _)| ["-p", name]);
        let made = Command::new(env!("CARGO")).args(["doc", "--no-deps"]).args(packages).current_dir(&root).status()?;
        ensure!(made.success(), "cargo doc failed");
        let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root.join("target"), PathBuf::from);
        copy(&target.join("doc"), &out.join("api"))?;
        fill(&out.join("api"))?;
        for (name, what) in CRATES {
            apis += &format!("- Rust, [{name}](./{}/index.html): {what}\n", name.replace('-', "_"));
        }
    }
    apis += "- JavaScript: [the element and the object of three.js](../docs/player.md)\n";
    documents.extend(["api/index.md", "api/python.md"].map(PathBuf::from));
    let texts = [apis, crate::python_api::document(&root)?];
    for (document, text) in documents[documents.len() - 2..].iter().zip(texts) {
        write_file(&out.join(page_of(document)), page(&text, document, &documents).as_bytes())?;
    }
    println!("{}: {} pages; look at it with `python3 -m http.server -d {0}`", out.display(), documents.len() + 1);
    Ok(())
}

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the repository").to_owned()
}

/// Marks a folder that may be replaced.
const MARK: &str = "site.txt";

/// Where a document's page is.
fn page_of(document: &Path) -> PathBuf {
    if document == Path::new(ROOT[0]) { "index.html".into() } else { document.with_extension("html") }
}

/// A whole page around a body, `depth` folders below the site's root.
fn frame(title: &str, body: &str, depth: usize, class: &str) -> String {
    let up = "../".repeat(depth);
    let menu: String = MENU.iter().map(|(page, name)| format!("<a href=\"{up}{page}\">{name}</a>")).collect();
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width,initial-scale=1\"><link rel=\"icon\" href=\"data:,\"><title>{title}</title>\
         <style>{STYLE}</style></head>\n<body><nav>{menu}</nav><main class=\"{class}\">\n{body}</main></body></html>\n"
    )
}

/// A document as a page. Links to documents lead to their pages, to other files of the repository to the repository.
fn page(text: &str, document: &Path, documents: &[PathBuf]) -> String {
    let folder = document.parent().unwrap_or(Path::new(""));
    let link = |target: &str| -> String {
        let (path, place) = target.split_once('#').map_or((target, String::new()), |(p, h)| (p, format!("#{h}")));
        if path.is_empty() || path.contains("://") || path.starts_with("mailto:") {
            return target.to_owned();
        }
        let full = clean(&folder.join(path));
        let up = "../".repeat(folder.components().count());
        if documents.contains(&full) {
            return format!("{up}{}{place}", page_of(&full).display());
        }
        // Pages that rustdoc makes lie beside ours.
        let here = full.starts_with("docs/images") || full.starts_with("api") || full.components().count() == 1;
        match here {
            true => target.to_owned(),
            false => format!("{REPOSITORY}{}{place}", full.display()),
        }
    };
    let events = Parser::new_ext(text, Options::ENABLE_TABLES).flat_map(|event| match event {
        Event::Start(Tag::Link { link_type, dest_url, title, id }) => {
            vec![Event::Start(Tag::Link { link_type, dest_url: link(&dest_url).into(), title, id })]
        }
        // Wide tables scroll by themselves.
        Event::Start(Tag::Table(columns)) => {
            vec![Event::Html("<div class=\"scroll\">".into()), Event::Start(Tag::Table(columns))]
        }
        Event::End(end @ TagEnd::Table) => vec![Event::End(end), Event::Html("</div>\n".into())],
        other => vec![other],
    });
    let mut events: Vec<Event<'_>> = events.collect();
    // Headings can be linked to, and the first one is the page's title.
    let mut title = None;
    for i in 0..events.len() {
        let words = words_of(&events[i..]);
        if let Event::Start(Tag::Heading { id, .. }) = &mut events[i] {
            *id = Some(slug(&words).into());
            title.get_or_insert(words);
        }
    }
    let title = title.unwrap_or_else(|| "splat4d".into());
    let mut body = String::new();
    html::push_html(&mut body, events.into_iter());
    frame(&title, &body, folder.components().count(), "")
}

/// The words up to the end of the heading that begins here; nothing where none begins.
fn words_of(events: &[Event<'_>]) -> String {
    if !matches!(events[0], Event::Start(Tag::Heading { .. })) {
        return String::new();
    }
    let inside = events.iter().take_while(|e| !matches!(e, Event::End(TagEnd::Heading(_))));
    let words = inside.filter_map(|e| match e {
        Event::Text(words) | Event::Code(words) => Some(words.as_ref()),
        _ => None,
    });
    words.collect()
}

/// A heading's anchor, as GitHub makes it.
fn slug(words: &str) -> String {
    let kept = words.to_lowercase().chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c)).collect::<String>();
    kept.replace(' ', "-")
}

/// A path without `.` and `..`.
fn clean(path: &Path) -> PathBuf {
    path.components().fold(PathBuf::new(), |mut out, part| {
        match part {
            std::path::Component::ParentDir => drop(out.pop()),
            std::path::Component::CurDir => {}
            other => out.push(other),
        }
        out
    })
}

/// A page a scene: the player, its scene, and what else there is.
fn gallery(root: &Path, out: &Path) -> Result<()> {
    let scenes = list(&root.join("examples"), "s4d")?;
    ensure!(!scenes.is_empty(), "there are no scenes to play in examples/");
    copy(&root.join("crates/splat4d-serve/player"), &out.join("player"))?;
    let mut body = String::from("<script type=\"module\" src=\"player/element.js\"></script>\n<h1>Play</h1>\n");
    for name in &scenes {
        copy(&root.join("examples").join(name), &out.join(name))?;
        let stem = name.trim_end_matches(".s4d");
        body += &format!(
            "<h2>{stem}</h2>\n<splat-4d src=\"{name}\" autoplay speed=\"0.5\" heading=\"{stem}\"></splat-4d>\n"
        );
    }
    body += "<p>Drag turns, the wheel goes nearer, Space plays. A file of your own: <code>splat4d view</code>, or drop it on \
             the player of <code>splat4d export --html</code>.</p>\n";
    write_file(&out.join("index.html"), frame("splat4d: play", &body, 1, "wide").as_bytes())
}

/// Writes the scripts that rustdoc's pages of traits ask for and rustdoc leaves out where nobody implements the trait: an empty
/// one instead of a 404.
fn fill(folder: &Path) -> Result<()> {
    for entry in std::fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let path = entry?.path();
        if path.is_dir() {
            fill(&path)?;
        } else if path.file_name().is_some_and(|n| n.to_string_lossy().starts_with("trait.")) {
            let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
            for script in text.split("src=\"").skip(1).filter_map(|rest| rest.split('"').next()) {
                let file = clean(&folder.join(script));
                if script.contains("trait.impl/") && !file.exists() {
                    write_file(&file, b"")?;
                }
            }
        }
    }
    Ok(())
}

/// Names of the files in a folder with this ending, in order.
pub(crate) fn list(folder: &Path, ending: &str) -> Result<Vec<String>> {
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let path = entry?.path();
        if path.is_file() && path.extension().is_some_and(|e| e == ending) {
            names.extend(path.file_name().map(|n| n.to_string_lossy().into_owned()));
        }
    }
    names.sort();
    Ok(names)
}

/// A file, or a folder with all that is in it.
fn copy(from: &Path, to: &Path) -> Result<()> {
    if from.is_dir() {
        for entry in std::fs::read_dir(from).with_context(|| from.display().to_string())? {
            let entry = entry?;
            copy(&entry.path(), &to.join(entry.file_name()))?;
        }
        return Ok(());
    }
    let folder = to.parent().context("a file lies in a folder")?;
    std::fs::create_dir_all(folder)?;
    std::fs::copy(from, to).with_context(|| from.display().to_string())?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_lead_to_pages_and_everything_else_to_the_repository() {
        let documents = ["README.md", "docs/a.md", "docs/b.md"].map(PathBuf::from);
        let text = "# A *b*\n\n## `C` & d\n\n[1](b.md#x) [2](../README.md) [3](../crates/x.rs) [4](https://x.y/z.md) [5](#here)\n\n|a|\n|-|\n|1|\n";
        let html = page(text, Path::new("docs/a.md"), &documents);
        for there in [
            "href=\"../docs/b.html#x\"",
            "href=\"../index.html\"",
            &format!("href=\"{REPOSITORY}crates/x.rs\""),
            "href=\"https://x.y/z.md\"",
            "href=\"#here\"",
            "<title>A b</title>",
            "<h2 id=\"c--d\">",
            "<div class=\"scroll\"><table>",
        ] {
            assert!(html.contains(there), "{there} in {html}");
        }
        assert!(
            page("![x](docs/images/k.png)", Path::new("README.md"), &documents).contains("src=\"docs/images/k.png\"")
        );
    }
}
