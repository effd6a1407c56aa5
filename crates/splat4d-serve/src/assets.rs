//! The player's files, embedded, and compressed once.

use flate2::write::GzEncoder;
use flate2::{Compression, Crc};
use std::borrow::Cow;
use std::io::Write;
use std::path::Path;
use std::sync::OnceLock;

/// Lists files of `player/`; a test compares it with the folder.
macro_rules! player {
    ($($name:literal,)*) => {
        &[$(($name, include_str!(concat!("../player/", $name))),)*]
    };
}

/// Every file of `player/` that a browser fetches: the shaders' own files are in `shaders.js` already.
const FILES: &[(&str, &str)] = player![
    "assets.js",
    "assist.html",
    "assist.js",
    "assist-view.js",
    "camera.js",
    "constants.js",
    "controls.js",
    "decode.worker.js",
    "dom.js",
    "edit.js",
    "edit-steps.js",
    "edit-tools.js",
    "element.js",
    "errors.js",
    "fovea.js",
    "gl.js",
    "glsl.js",
    "icons.js",
    "index.html",
    "labels.js",
    "ladder.js",
    "live.js",
    "measure.js",
    "order.js",
    "pace.js",
    "page.js",
    "panels.js",
    "player.js",
    "ranges.js",
    "rig.js",
    "scene-file.js",
    "schedule.js",
    "shaders.js",
    "sound.js",
    "sort.worker.js",
    "stream.js",
    "style.js",
    "texels.js",
    "track.js",
    "ui.js",
    "webgl2.js",
    "webgpu.js",
    "xr.js",
];

/// The page.
pub(crate) const INDEX: &str = "index.html";
/// The page of manual alignment.
pub(crate) const ASSIST: &str = "assist.html";

/// A file of the player.
#[derive(Clone, Debug)]
pub struct Asset {
    /// Its name; there are no folders.
    pub name: Cow<'static, str>,
    /// Content, UTF-8.
    pub text: Cow<'static, str>,
    /// The same, as gzip.
    pub gzip: Vec<u8>,
    /// Its entity tag, with quotes.
    pub etag: String,
}

impl Asset {
    fn new(name: impl Into<Cow<'static, str>>, text: impl Into<Cow<'static, str>>) -> Self {
        let (name, text) = (name.into(), text.into());
        let mut gzip = GzEncoder::new(Vec::new(), Compression::best());
        gzip.write_all(text.as_bytes()).expect("memory takes all bytes");
        let mut crc = Crc::new();
        crc.update(text.as_bytes());
        let etag = format!("\"p{:x}-{:x}\"", crc.sum(), text.len());
        Self { gzip: gzip.finish().expect("memory takes all bytes"), etag, name, text }
    }

    /// Its media type.
    pub fn mime(&self) -> &'static str {
        mime(&self.name).expect("names were chosen by their endings")
    }
}

/// All files that the player transfers.
pub fn assets() -> &'static [Asset] {
    static ASSETS: OnceLock<Vec<Asset>> = OnceLock::new();
    ASSETS.get_or_init(|| FILES.iter().map(|(name, text)| Asset::new(*name, lean(text))).collect())
}

/// A module without the lines that are comments and nothing else: a quarter of what would be transferred. Line breaks
/// stay, so that places in error messages are right. Our modules begin no line of a text with `//` or `/**` (a test
/// holds that every removed line was one of a comment).
fn lean(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut inside = false;
    for line in text.lines() {
        let bare = line.trim();
        let starts = bare.starts_with("/**");
        let comment = inside || starts || bare.starts_with("//");
        if inside || starts {
            inside = !bare.ends_with("*/");
        }
        if !comment {
            out.push_str(line);
        }
        out.push('\n');
    }
    out
}

/// A file by name.
pub fn asset(name: &str) -> Option<&'static Asset> {
    assets().iter().find(|a| a.name == name)
}

/// A file from a folder, for development of the player; reads the disk. None where there is no such file.
pub(crate) fn from_folder(folder: &Path, name: &str) -> Option<Asset> {
    if !is_name(name) {
        return None;
    }
    mime(name)?;
    Some(Asset::new(name.to_owned(), std::fs::read_to_string(folder.join(name)).ok()?))
}

/// Whether this is a plain file name, one that cannot lead out of a folder on any system.
fn is_name(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b"-.".contains(&b))
        && !name.contains("..")
}

fn mime(name: &str) -> Option<&'static str> {
    match name.rsplit_once('.')?.1 {
        "html" => Some("text/html; charset=utf-8"),
        "js" => Some("text/javascript; charset=utf-8"),
        "css" => Some("text/css; charset=utf-8"),
        "svg" => Some("image/svg+xml"),
        _ => None,
    }
}

/// A string as JavaScript and JSON write it; `<` is escaped so that no tag can hide in it.
pub(crate) fn literal(text: &str) -> String {
    let json = serde_json::Value::String(text.to_owned()).to_string();
    json.replace('<', "\\u003c").replace('\u{2028}', "\\u2028").replace('\u{2029}', "\\u2029")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    /// Bounds on what a browser transfers for the player with all that it may import later, and for the editor in
    /// addition.
    const MOST: usize = 103_000;
    const MOST_EDITOR: usize = 20_000;
    const MOST_ASSIST: usize = 12_000;

    fn folder() -> std::path::PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("player")
    }

    #[test]
    fn every_file_of_the_folder_is_embedded() {
        let there: BTreeSet<String> =
            std::fs::read_dir(folder()).unwrap().map(|f| f.unwrap().file_name().into_string().unwrap()).collect();
        let there: BTreeSet<String> = there.into_iter().filter(|name| !name.ends_with(".wgsl")).collect();
        let listed: BTreeSet<String> = FILES.iter().map(|(name, _)| (*name).to_owned()).collect();
        assert_eq!(there, listed, "list the folder's files in FILES");
        for name in &listed {
            assert!(is_name(name) && mime(name).is_some(), "{name}");
        }
        assert_eq!(listed.len(), FILES.len(), "none twice");
    }

    /// The assets that a page fetches from `first` on, at once or later, without those that `leave` imports.
    fn reached(first: &str, leave: &str) -> BTreeSet<&'static str> {
        let (mut found, mut next) = (BTreeSet::new(), vec![asset(first).unwrap()]);
        while let Some(asset) = next.pop() {
            if asset.name != leave && found.insert(&*asset.name) {
                let named =
                    |a: &&Asset| ['\'', '"'].iter().any(|q| asset.text.contains(&format!("{q}./{}{q}", a.name)));
                next.extend(assets().iter().filter(named));
            }
        }
        found
    }

    #[test]
    fn the_player_is_small() {
        // A page imports the editor with `view --edit` only, so that there are two sizes.
        let player = reached(INDEX, "edit.js");
        let editor: BTreeSet<_> = reached("edit.js", INDEX).difference(&player).copied().collect();
        let assist: BTreeSet<_> = reached(ASSIST, INDEX).difference(&player).copied().collect();
        let all: BTreeSet<&str> = assets().iter().map(|a| &*a.name).collect();
        let every = player.iter().chain(&editor).chain(&assist).copied().collect::<BTreeSet<_>>();
        assert_eq!(every, all, "a page reaches every file");
        let size = |names: &BTreeSet<&str>| names.iter().map(|n| asset(n).unwrap().gzip.len()).sum::<usize>();
        let sizes = [size(&player), size(&editor), size(&assist)];
        assert!(
            sizes[0] <= MOST && sizes[1] <= MOST_EDITOR && sizes[2] <= MOST_ASSIST,
            "player, editor and alignment {sizes:?} bytes: {player:?} {editor:?} {assist:?}"
        );
    }

    #[test]
    fn comments_are_not_transferred_and_lines_keep_their_numbers() {
        let text =
            "// why\nconst a = 1; // kept\n/** One line. */\nlet b = 'http://x';\n  /**\n   * More.\n   */\n  b();\n";
        assert_eq!(lean(text), "\nconst a = 1; // kept\n\nlet b = 'http://x';\n\n\n\n  b();\n");
        for (name, text) in FILES {
            assert_eq!(lean(text).lines().count(), text.lines().count(), "{name}");
        }
    }

    #[test]
    fn gzip_round_trips() {
        for asset in assets() {
            let mut text = String::new();
            std::io::Read::read_to_string(&mut flate2::read::GzDecoder::new(&asset.gzip[..]), &mut text).unwrap();
            assert_eq!(text, asset.text, "{}", asset.name);
        }
    }

    #[test]
    fn a_folder_gives_plain_names_only() {
        let folder = folder();
        assert!(from_folder(&folder, INDEX).is_some());
        for name in
            ["../Cargo.toml", "..", ".", "", "src/lib.rs", "/etc/passwd", "..\\x.js", "c:x.js", "nul\0.js", "A.js"]
        {
            assert!(from_folder(&folder, name).is_none(), "{name}");
        }
    }
}
