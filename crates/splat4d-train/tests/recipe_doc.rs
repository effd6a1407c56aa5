//! `docs/recipe.md` is written by this test from the recipe itself, so that the document cannot lag behind the code.

use splat4d_train::recipe::Recipe;
use splat4d_train::settings::{Knob, Range, When};
use std::path::Path;

const HEAD: &str = "\
# The recipe

Every knob of a run, its default and its meaning. Set one with `--set TABLE.NAME=VALUE` (may be repeated), or write a TOML
file for `--recipe FILE`:

```toml
[run]
iterations = 3000

[densify]
max_cap = 60000
```

Recipes had no tables once: the names of then, in the last column, still work alone (`--set max_cap=60000`, or
`max_cap = 60000` at the top of the file). The effective recipe is saved with every run as `recipe.toml`; training again
from that file repeats the run.

A knob without effect in the recipe that it is set in (`mcmc.growth` where `densify.strategy` is adc) is refused by `--set`
and warned about where it comes from a file; a value that switches off what is off anyhow is warned about too.

`--quality` sets a few knobs at once; those that are typed win over it, and the recipe records what was in effect:

| | `run.iterations` | `densify.count_scale` | `capture.downscale` |
|---|---|---|---|
| `draft` | 2,500 | 0.5 | twice the recipe's |
| `standard` (the default) | 7,000 | 1 | the recipe's |
| `best` | 20,000 | 2 | the recipe's |

`--minutes M` wins over the steps of either. It covers the command from its start to the report: reading, initial points, a
few timed steps (about 6 % of the time, more where a step takes a second), training, and measuring, filming and baking as far
as they can be foretold.
`run.iterations` are the steps that fit by the timed ones. They are the run's *schedule*: rates, densification, degrees of
SH, pictures at half size and stages are stated in its steps. When the machine turns out to be slower or faster, the run is
planned anew: `run.replans` gets a row [step, steps in all], and from that step on what is left of the schedule is spread
evenly over the steps that are left. Where a step passes over several steps of the schedule, what was due at any of them is
done once; where several steps share one, it is not repeated. So rates go on from where they were, down to the same end, and
nothing that is past changes its meaning. A row is in the run's recipe.toml before it is used: a resumed run, and one that
is trained from that recipe, have the same bits. A resumed run keeps to what was left of its minutes. No step ever stands
for more than eight of the schedule, so that on a machine that stalls the time is missed and not the scene.

Knobs that count iterations and are 0 follow from `run.iterations`. Rates of positions are in units of the scene's extent
(1.1 times the largest distance of a training camera from the cameras' centroid), everything with time in it is per clip
length: a recipe carries over from a scene of centimetres and seconds to one of metres and minutes.

This file is generated: `UPDATE_GOLDEN=1 cargo test -p splat4d-train --test recipe_doc`.
";

fn page() -> String {
    let mut text = HEAD.to_owned();
    let mut table = "";
    for knob in Recipe::knobs() {
        if knob.table != table {
            table = knob.table;
            let needs = Recipe::needs(table).map_or_else(String::new, |n| format!(" In effect with {n}."));
            text += &format!(
                "\n## `[{table}]`\n\n{}{needs}\n\n| knob | default | range, unit | meaning | alone |\n|---|---|---|---|---|\n",
                Recipe::about(table)
            );
        }
        text += &row(&knob);
    }
    text
}

fn row(k: &Knob) -> String {
    let default = if k.default == "\"\"" { "(empty)".to_owned() } else { format!("`{}`", k.default) };
    // What nearly every number is need not be said of each.
    let range = if k.rule.range == Range::NotNegative { String::new() } else { k.rule.range.to_string() };
    let kind: Vec<&str> = [range.as_str(), k.rule.unit].into_iter().filter(|s| !s.is_empty()).collect();
    let alone = Recipe::flat_name(&k.key()).map_or_else(String::new, |name| format!("`{name}`"));
    let needs = if k.rule.when == When::Always { String::new() } else { format!(" In effect with {}.", k.rule.when) };
    let doc = (k.doc.clone() + &needs).replace('|', "\\|");
    format!("| `{}` | {default} | {} | {doc} | {alone} |\n", k.field, kind.join("; "))
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
         UPDATE_GOLDEN=1 cargo test -p splat4d-train --test recipe_doc",
        differs.unwrap_or_else(|| "its length".into())
    );
}
