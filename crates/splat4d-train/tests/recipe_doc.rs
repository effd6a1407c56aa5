//! This test writes `docs/recipe*.md` from the recipe itself, so the reference cannot lag behind the code.

use splat4d_train::recipe::Recipe;
use splat4d_train::settings::{Range, Setting, When};
use std::path::Path;

/// A page of the reference: its file in docs/, its title, and the tables that it holds; an empty list: all others.
struct Page {
    file: &'static str,
    head: &'static str,
    tables: &'static [&'static str],
}

/// Pages stay below 250 lines. Tables that no page names are on the first one.
const PAGES: [Page; 3] = [
    Page { file: "recipe.md", head: HEAD, tables: &[] },
    Page {
        file: "recipe-models.md",
        head: "# Settings of motion models\n\nSettings of single motion models, of the temporal filter and of the transport \
               losses. How to set them, and all other settings: [recipe.md](recipe.md). Which model to choose: \
               [models.md](models.md).\n\nThis file is generated: `UPDATE_GOLDEN=1 cargo test -p splat4d-train --test \
               recipe_doc`.\n",
        tables: &[
            "spacetime",
            "deform",
            "hexplane",
            "tracked",
            "native4d",
            "control",
            "nodes",
            "ssm",
            "filter",
            "transport",
        ],
    },
    Page {
        file: "recipe-density.md",
        head: "# Settings of density control\n\nHow Gaussians are added, moved and removed during training. How to set them, \
               and all other settings: [recipe.md](recipe.md).\n\nThis file is generated: `UPDATE_GOLDEN=1 cargo test -p \
               splat4d-train --test recipe_doc`.\n",
        tables: &[
            "densify",
            "adc",
            "opacity_reset",
            "mcmc",
            "relocate",
            "guided",
            "floaters",
            "prune",
            "merge",
            "split",
        ],
    },
];

const HEAD: &str = "\
# Settings

All settings of a run, with default and meaning. The size of the scene and its file follows mainly from `densify.max_cap`
([how to limit it](file-size.md)), the time from `run.iterations` and `capture.downscale`. `densify.max_cap = 0` derives the number of
Gaussians from the capture: one for 350 pixels of distinct views, at most 45 per step, at most what fits into memory, and at least 30,000.
`train` prints the number and the reason. The search of the documentation site finds every setting by its name.

| page | tables |
|---|---|
| this page | run, capture, initial Gaussians, appearance, rates, refinement of cameras, lifespan, losses, chunks |
| [motion models](recipe-models.md) | motion models, temporal filter, transport losses |
| [density control](recipe-density.md) | densification, pruning, merging, floaters, static layer |

## Change a setting

On the command line, `--set TABLE.NAME=VALUE` (repeatable). Or in a TOML file for `--recipe FILE`:

```toml
[run]
iterations = 3000

[densify]
max_cap = 60000
```

- `splat4d train --help-knobs [TOPIC]` prints these tables, `splat4d recipe` a file with all settings.
- `splat4d recipe --schema > recipe.schema.json` writes a JSON Schema. Editors with Taplo (Even Better TOML) complete and check a
  recipe next to it whose first line is `#:schema ./recipe.schema.json`.
- The effective settings are stored with every run as `recipe.toml`. Training again from that file repeats the run.
- Older names without a table, in the last column, also work (`--set max_cap=60000`, or `max_cap = 60000` at the top of the file).
- A setting without effect (`mcmc.growth` if `densify.strategy` is adc) is refused by `--set` and reported as a warning
  for a file. A value that switches off something that is off already is also a warning.
- Settings that count iterations and are 0 follow from `run.iterations`. Rates of positions are in units of the scene's extent (1.1 times the
  largest distance of a training camera from the cameras' centroid), and times in units of the clip length. A recipe therefore carries over
  between scenes of different scale and duration.

## Choose quality or minutes

`--quality` changes some settings at once. Settings on the command line have priority, and the recipe records what was in effect.

| | `run.iterations` | `densify.count_scale` | `capture.downscale` |
|---|---|---|---|
| `draft` | 2,500 | 0.5 | twice the recipe's |
| `standard` (the default) | 7,000 | 1 | the recipe's |
| `best` | 20,000 | 2 | the recipe's |

`--minutes M` replaces the number of steps. M covers the whole command: reading, initial points, a few timed steps (about 6 % of the time,
more if a step takes a second), training, evaluation, film, baking and report.

- `run.iterations` becomes the number of steps that fit, estimated from the timed steps. Rates, densification, SH degrees, half-size images and stages follow
  this *schedule*.
- If the machine becomes slower or faster, the run is planned again: `run.replans` gets a row [step, total steps], and the rest of the
  schedule is spread evenly over the remaining steps. Operations that are due are done once, never repeated. One step never covers more
  than eight steps of the schedule; a stalled machine then exceeds the time.
- Each row is written to the run's recipe.toml before it is used. A resumed run, and a run trained from that recipe, have the same bits. A
  resumed run keeps the remaining minutes.

This file is generated: `UPDATE_GOLDEN=1 cargo test -p splat4d-train --test recipe_doc`.
";

fn text(page: &Page) -> String {
    let elsewhere = |table: &str| PAGES.iter().any(|p| p.tables.contains(&table));
    let mut text = page.head.to_owned();
    let mut table = "";
    for setting in Recipe::settings() {
        let here =
            if page.tables.is_empty() { !elsewhere(setting.table) } else { page.tables.contains(&setting.table) };
        if !here {
            continue;
        }
        if setting.table != table {
            table = setting.table;
            let needs = Recipe::needs(table).map_or_else(String::new, |n| format!(" In effect with {n}."));
            text += &format!(
                "\n## `[{table}]`\n\n{}{needs}\n\n| setting | default | range, unit | meaning | older name |\n|---|---|---|---|---|\n",
                Recipe::about(table)
            );
        }
        text += &row(&setting);
    }
    text
}

fn row(k: &Setting) -> String {
    let default = if k.default == "\"\"" { "(empty)".to_owned() } else { format!("`{}`", k.default) };
    // The range of nearly every number is not repeated.
    let range = if k.rule.range == Range::NotNegative { String::new() } else { k.rule.range.to_string() };
    let kind: Vec<&str> = [range.as_str(), k.rule.unit].into_iter().filter(|s| !s.is_empty()).collect();
    let alone = Recipe::flat_name(&k.key()).map_or_else(String::new, |name| format!("`{name}`"));
    let needs = if k.rule.when == When::Always { String::new() } else { format!(" In effect with {}.", k.rule.when) };
    let doc = (k.doc.clone() + &needs).replace('|', "\\|");
    format!("| `{}` | {default} | {} | {doc} | {alone} |\n", k.field, kind.join("; "))
}

#[test]
fn the_reference_equals_the_recipe() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs");
    for page in &PAGES {
        let (path, text) = (folder.join(page.file), text(page));
        if std::env::var_os("UPDATE_GOLDEN").is_some() {
            std::fs::write(&path, &text).expect("docs/ can be written");
        }
        let found = std::fs::read_to_string(&path).unwrap_or_default();
        let differs = text.lines().zip(found.lines()).find(|(new, old)| new != old).map(|(new, _)| new.to_owned());
        assert!(
            found == text,
            "docs/{} is out of date (first difference: {}). Write it again with\n    \
             UPDATE_GOLDEN=1 cargo test -p splat4d-train --test recipe_doc",
            page.file,
            differs.unwrap_or_else(|| "its length".into())
        );
    }
}

#[test]
fn every_table_is_on_one_page() {
    for page in &PAGES {
        for table in page.tables {
            assert!(
                Recipe::settings().iter().any(|k| k.table == *table),
                "{} names {table}, which does not exist",
                page.file
            );
        }
    }
}
