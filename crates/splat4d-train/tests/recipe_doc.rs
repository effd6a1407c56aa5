//! `docs/recipe.md` is written by this test from the recipe itself, so that the document cannot lag behind the code.

use splat4d_train::recipe::{Knob, Recipe};
use std::path::Path;

const HEAD: &str = "\
# The recipe

Every knob of a run, its default and its meaning. Set one with `--set KEY=VALUE` (may be repeated), or write lines such
as `iterations = 3000` into a TOML file for `--recipe FILE`. The effective recipe is saved with every run as
`recipe.toml`; training again from that file repeats the run.

Knobs that count iterations and are 0 follow from `iterations`. Rates of positions are in units of the scene's extent
(1.1 times the largest distance of a training camera from the cameras' centroid), everything with time in it is per clip
length: a recipe carries over from a scene of centimetres and seconds to one of metres and minutes.

This file is generated: `UPDATE_GOLDEN=1 cargo test --release -p splat4d-train --test recipe_doc`.

";

fn page() -> String {
    let row = |k: &Knob| {
        let default = if k.default == "\"\"" { "(empty)".to_owned() } else { format!("`{}`", k.default) };
        format!("| `{}` | {default} | {} |\n", k.name, k.doc.replace('|', "\\|"))
    };
    let rows: String = Recipe::knobs().iter().map(row).collect();
    format!("{HEAD}| knob | default | meaning |\n|---|---|---|\n{rows}")
}

#[test]
fn the_document_says_what_the_recipe_does() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/recipe.md");
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        std::fs::write(&path, page()).expect("docs/recipe.md can be written");
    }
    let found = std::fs::read_to_string(&path).unwrap_or_default();
    let differs = page().lines().zip(found.lines()).find(|(new, old)| new != old).map(|(new, _)| new.to_owned());
    assert!(
        found == page(),
        "docs/recipe.md is out of date (first difference: {}). Write it again with\n    \
         UPDATE_GOLDEN=1 cargo test --release -p splat4d-train --test recipe_doc",
        differs.unwrap_or_else(|| "its length".into())
    );
}
