//! The player and a scene as one static page, which works from any server and straight from a disk.
//!
//! A page opened from a disk may not import modules from files next to it. So the page makes a blob of every module: in
//! the order of their imports, each with the `'./name.js'` strings in it replaced by the blobs before it.

use crate::assets::{INDEX, assets, literal};
use serde_json::json;
use splat4d::{Error, ErrorKind, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

/// Largest scene inside a page, bytes. As text it is a third larger, and browsers hold at most half a gigabyte of it.
const MOST_INSIDE: usize = 256 << 20;
/// Modules whose names begin so need a server that takes input.
const SERVED: [&str; 2] = ["edit", "assist"];
/// Bytes of the scene a text line: base64 lines of a length that decodes quickly, a multiple of 3.
const LINE: usize = 3 << 14;

/// A page to be written.
#[derive(Clone, Debug)]
pub struct Page<'a> {
    /// Its title.
    pub title: &'a str,
    /// Its scene.
    pub scene: SceneIn<'a>,
}

/// Source of a page's scene.
#[derive(Clone, Debug)]
pub enum SceneIn<'a> {
    /// In the page: the bytes of a `.s4d`.
    Inside(&'a [u8]),
    /// At an address, relative to the page or whole. Such a page needs a web server: browsers refuse pages from a disk
    /// to read other files.
    Linked(&'a str),
}

impl Page<'_> {
    /// The page, UTF-8. It loads nothing but a linked scene. Errors: the scene is too large to be in a page.
    pub fn html(&self) -> Result<String> {
        let modules: BTreeMap<&str, &str> = assets()
            .iter()
            .filter(|a| a.name.ends_with(".js") && !SERVED.iter().any(|s| a.name.starts_with(s)))
            .map(|a| (&*a.name, &*a.text))
            .collect();
        let index = &crate::asset(INDEX).expect("the page is embedded").text;
        self.assemble(index, &modules)
    }

    fn assemble(&self, index: &str, modules: &BTreeMap<&str, &str>) -> Result<String> {
        let (index, entries) = without_scripts(index);
        let order =
            order(modules).unwrap_or_else(|circle| panic!("modules of the player import in a circle: {circle}"));
        let mut out = String::new();
        let connect = match self.scene {
            SceneIn::Inside(_) => "",
            SceneIn::Linked(_) => " 'self' https: http:",
        };
        let policy = format!(
            "default-src 'none'; script-src 'unsafe-inline' blob: data:; worker-src blob: data:; style-src 'unsafe-inline'; \
             img-src data: blob:; media-src blob:; connect-src data: blob:{connect}"
        );
        let title = format!(
            "<meta http-equiv=\"Content-Security-Policy\" content=\"{policy}\">\n<title>{}</title>",
            escape(self.title)
        );
        let index = replace_title(&index, &title);
        let end = index.rfind("</body>").unwrap_or(index.len());
        out += &index[..end];
        match self.scene {
            SceneIn::Linked(_) => {}
            SceneIn::Inside(bytes) => {
                if bytes.len() > MOST_INSIDE {
                    return Err(Error::new(
                        ErrorKind::Unsupported,
                        format!("a scene of {} MB does not fit into one page", bytes.len() >> 20),
                    )
                    .remedy("Keep it as a separate file with --link FILE."));
                }
                out.reserve(bytes.len() / 3 * 4 + bytes.len() / LINE + (1 << 20));
                out += "<script type=\"text/plain\" id=\"splat4d-scene\">\n";
                for line in bytes.chunks(LINE) {
                    base64(line, &mut out);
                    out.push('\n');
                }
                out += "</script>\n";
            }
        }
        // As JSON in a script of a foreign type, with every `<` escaped: nothing in a module can end it.
        let sources: Vec<String> =
            order.iter().map(|name| format!("[{},{}]", literal(name), literal(modules[name]))).collect();
        let linked = match self.scene {
            SceneIn::Linked(address) => Some(address),
            SceneIn::Inside(_) => None,
        };
        // As in <title>: what reorders text or controls a terminal is spelt out.
        let title = splat4d::text::in_line(self.title);
        let about = json!({ "title": title, "scene": linked, "start": entries }).to_string().replace('<', "\\u003c");
        write!(
            out,
            "<script type=\"application/json\" id=\"splat4d-modules\">\n[{}]\n</script>\n\
             <script type=\"application/json\" id=\"splat4d-page\">{about}</script>\n<script>\n{BOOT}</script>\n",
            sources.join(",\n"),
        )
        .expect("a string takes all text");
        out += &index[end..];
        Ok(out)
    }
}

/// Makes blobs of modules and scene, and starts the page's modules. `SPLAT4D_ASSETS` gives workers their addresses: on
/// a page from a disk they are `data:` ones, because Chromium starts no module worker from a blob there.
/// `SPLAT4D_CONFIG` represents the server's `/config.json`; its scene is a Blob, or an address.
const BOOT: &str = r#"(() => {
  const read = (id) => document.getElementById(id).textContent;
  const texts = new Map(JSON.parse(read('splat4d-modules')));
  const link = (text, urls) => text.replace(/(['"])\.\/([\w.-]+)\1/g, (all, q, to) => urls(to) ? q + urls(to) + q : all);
  const blobs = {};
  for (const [name, text] of texts) {
    blobs[name] = URL.createObjectURL(new Blob([link(text, (to) => blobs[to])], { type: 'text/javascript' }));
  }
  const data = (name) => texts.has(name)
    && 'data:text/javascript;charset=utf-8,' + 
    encodeURIComponent(link(texts.get(name), data)).replaceAll("'", '%27');
  globalThis.SPLAT4D_ASSETS = Object.fromEntries([...texts.keys()].filter((name) => name.endsWith('.worker.js'))
    .map((name) => [name, location.protocol === 'file:' ? data(name) : blobs[name]]));
  let { title, scene, start } = JSON.parse(read('splat4d-page'));
  if (!scene) {
    const node = document.getElementById('splat4d-scene');
    const lines = node.textContent.split('\n').filter(Boolean);
    node.remove();
    scene = new Blob(lines.map((line) => Uint8Array.from(atob(line), (c) => c.charCodeAt(0))));
  }
  globalThis.SPLAT4D_CONFIG = { title, scene, live: false };
  for (const name of start) import(blobs[name]);
})();
"#;

/// The page without its module scripts (`<script type="module" src=…>`) and preloads, and the modules' names.
fn without_scripts(index: &str) -> (String, Vec<String>) {
    let (mut out, mut entries, mut rest) = (String::new(), Vec::new(), index);
    while let Some(at) = rest.find("<script").into_iter().chain(rest.find("<link")).min() {
        let script = rest[at..].starts_with("<script");
        let end = if script { "</script>" } else { ">" };
        let Some(length) = rest[at..].find(end).map(|n| n + end.len()) else { break };
        let tag = &rest[at..at + length];
        let attribute = if script { "src" } else { "href" };
        let name = attribute_of(tag, attribute).map(|v| v.rsplit('/').next().unwrap_or(v).to_owned());
        let ours = if script { tag.contains("module") } else { tag.contains("modulepreload") };
        out += &rest[..at];
        match name {
            Some(name) if ours => entries.extend(script.then_some(name)),
            _ => out += tag,
        }
        rest = &rest[at + length..];
    }
    (out + rest, entries)
}

/// The value of a tag's quoted attribute.
fn attribute_of<'a>(tag: &'a str, name: &str) -> Option<&'a str> {
    let after = &tag[tag.find(&format!(" {name}=\""))? + name.len() + 3..];
    after.split('"').next()
}

fn replace_title(index: &str, title: &str) -> String {
    match (index.find("<title>"), index.find("</title>")) {
        (Some(a), Some(b)) if a < b => format!("{}{title}{}", &index[..a], &index[b + "</title>".len()..]),
        _ => index.replacen("<head>", &format!("<head>\n{title}"), 1),
    }
}

/// Modules, each behind those that it names as `'./name'`. Errors: the names of a circle.
fn order<'a>(modules: &BTreeMap<&'a str, &'a str>) -> Result<Vec<&'a str>, String> {
    let mut order: Vec<&str> = Vec::new();
    let mut left: BTreeMap<&str, BTreeSet<&str>> =
        modules.iter().map(|(name, text)| (*name, imports(text, modules))).collect();
    while !left.is_empty() {
        let ready: Vec<&str> =
            left.iter().filter(|(_, needs)| needs.iter().all(|n| order.contains(n))).map(|(name, _)| *name).collect();
        if ready.is_empty() {
            return Err(left.into_keys().collect::<Vec<_>>().join(", "));
        }
        for name in ready {
            left.remove(name);
            order.push(name);
        }
    }
    Ok(order)
}

/// The modules whose names are in a text as `'./name'` or `"./name"`.
fn imports<'a>(text: &str, modules: &BTreeMap<&'a str, &'a str>) -> BTreeSet<&'a str> {
    let named = |name: &str| ['\'', '"'].iter().any(|q| text.contains(&format!("{q}./{name}{q}")));
    modules.keys().copied().filter(|name| named(name)).collect()
}

fn escape(text: &str) -> String {
    splat4d::text::in_line(text).replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Standard base64 (RFC 4648) with padding.
fn base64(bytes: &[u8], out: &mut String) {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    for chunk in bytes.chunks(3) {
        let word = chunk.iter().enumerate().fold(0u32, |w, (i, &b)| w | u32::from(b) << (16 - 8 * i));
        for i in 0..4 {
            let digit = ALPHABET[(word >> (18 - 6 * i) & 63) as usize];
            out.push(if i <= chunk.len() { digit as char } else { '=' });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> BTreeMap<&'static str, &'static str> {
        BTreeMap::from([
            ("a.js", "import { b } from './b.js'; import './c.worker.js'; // </script><!--"),
            ("b.js", "export const b = worker('c.worker.js') + \"./nowhere.js\";"),
            ("c.worker.js", "import \"./d.js\";"),
            ("d.js", "export {}"),
        ])
    }

    const SAMPLE: &str = "<!doctype html><html><head><title>x</title><link rel=\"modulepreload\" href=\"./b.js\">\
        <link rel=\"icon\" href=\"data:,\"></head><body><splat-4d></splat-4d>\
        <script type=\"module\" src=\"player/a.js\"></script></body></html>";

    fn text_of<'a>(html: &'a str, id: &str) -> &'a str {
        let from = html.find(&format!("id=\"{id}\">")).unwrap() + id.len() + "id=\"\">".len();
        let length = html[from..].find("</script>").unwrap();
        &html[from..from + length]
    }

    #[test]
    fn modules_come_in_the_order_of_their_imports() {
        let modules = sample();
        let order = order(&modules).unwrap();
        for (i, name) in order.iter().enumerate() {
            let needs = imports(modules[name], &modules);
            assert!(needs.iter().all(|n| order[..i].contains(n)), "{name} comes before {needs:?}");
        }
        assert_eq!(order.len(), 4);
        let circle = BTreeMap::from([("a.js", "import './b.js'"), ("b.js", "import './a.js'"), ("c.js", "")]);
        assert_eq!(super::order(&circle).unwrap_err(), "a.js, b.js");
    }

    #[test]
    fn embedded_data_cannot_close_its_script_and_round_trips() {
        let scene: Vec<u8> = (0..2 * LINE + 5).map(|i| (i * 7) as u8).collect();
        let page = Page { title: "a </title><script>\"'& \u{202e}\u{9b}TITLE", scene: SceneIn::Inside(&scene) };
        let html = page.assemble(SAMPLE, &sample()).unwrap();
        assert_eq!(html.matches("<script").count(), 4, "scene, modules, page, start; the page's own is gone");
        assert_eq!(html.matches("</script>").count(), 4);
        assert!(!html.contains("modulepreload") && html.contains("href=\"data:,\"") && html.contains("[\"a.js\"]"));
        let about: serde_json::Value = serde_json::from_str(text_of(&html, "splat4d-page")).unwrap();
        assert_eq!((&about["title"], &about["scene"]), (&json!(splat4d::text::in_line(page.title)), &json!(null)));
        assert!(!html.contains(['\u{202e}', '\u{9b}']), "the title is spelt out wherever it stands");
        let modules: Vec<(String, String)> = serde_json::from_str(text_of(&html, "splat4d-modules")).unwrap();
        let back: BTreeMap<&str, &str> = modules.iter().map(|(n, t)| (&**n, &**t)).collect();
        assert_eq!(back, sample());
        let lines: Vec<&str> = text_of(&html, "splat4d-scene").split_whitespace().collect();
        assert_eq!(lines.len(), 3);
        let length: usize = lines.iter().map(|l| l.len() / 4 * 3 - l.matches('=').count()).sum();
        assert_eq!(length, scene.len());
        assert!(html.contains("<title>a &lt;/title&gt;&lt;script&gt;&quot;'&amp; \\u{202e}\\u{9b}TITLE</title>"));
        assert!(!html.contains("http://") && !html.contains("https://"));
    }

    #[test]
    fn a_linked_scene_is_stored_as_its_address_alone() {
        let html = Page { title: "t", scene: SceneIn::Linked("a%20b.s4d") }.assemble(SAMPLE, &sample()).unwrap();
        assert!(html.contains("\"scene\":\"a%20b.s4d\"") && !html.contains("splat4d-scene\">"));
    }

    #[test]
    fn the_written_player_page_loads_no_other_file() {
        let html = Page { title: "t", scene: SceneIn::Inside(b"x") }.html().unwrap();
        for tag in [" src=\"", " href=\"http", " href=\"/", " href=\"./"] {
            assert!(!html.contains(tag), "{tag}");
        }
        assert!(html.contains("\neA==\n"));
    }

    #[test]
    fn base64_as_in_rfc_4648() {
        for (plain, coded) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")] {
            let mut out = String::new();
            base64(plain.as_bytes(), &mut out);
            assert_eq!(out, coded);
        }
    }
}
