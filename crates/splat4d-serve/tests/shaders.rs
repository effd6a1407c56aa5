//! The player's copy of the shaders equals the .wgsl files. `UPDATE_GOLDEN=1` writes it again.

use std::fs;
use std::path::Path;

/// Export in `shaders.js`, and the file it holds, from the crate's folder.
const SHADERS: [(&str, &str); 6] = [
    ("RESIDENT", "../splat4d/src/format/playback/resident.wgsl"),
    ("PROJECT", "../splat4d/src/render/project.wgsl"),
    ("SHADE", "../splat4d/src/render/shade.wgsl"),
    ("SORT", "../splat4d/src/gpu/sort.wgsl"),
    ("CULL", "player/cull.wgsl"),
    ("DRAW", "player/draw.wgsl"),
];

/// The module's text: every shader without comments and indentation, which need not be transferred.
fn module(folder: &Path) -> String {
    let mut out = String::from(
        "// Made from the .wgsl files, whose comments say what they do, by\n\
         // `UPDATE_GOLDEN=1 cargo test -p splat4d-serve --test shaders`. A test fails when it is out of date.\n",
    );
    for (name, path) in SHADERS {
        let text = fs::read_to_string(folder.join(path)).unwrap_or_else(|e| panic!("{path}: {e}"));
        out += &format!("\nexport const {name} = `\n");
        for line in text.lines() {
            let code = line.split("//").next().unwrap_or_default().trim();
            assert!(!code.contains(['`', '\\', '$']), "{path} holds a character that a JS template would read");
            if !code.is_empty() {
                out += code;
                out.push('\n');
            }
        }
        out += "`;\n";
    }
    out
}

#[test]
fn shaders_js_is_up_to_date() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (path, fresh) = (folder.join("player/shaders.js"), module(folder));
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        fs::write(&path, &fresh).expect("shaders.js can be written");
    }
    let there = fs::read_to_string(&path).unwrap_or_default();
    assert!(there == fresh, "player/shaders.js is out of date: run this test with UPDATE_GOLDEN=1");
}
