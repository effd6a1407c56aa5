//! `recipe`: all settings as a file to start from, and their JSON Schema for editors.

use crate::console::Console;
use splat4d_train::recipe::{MotionName, Recipe};
use splat4d_workflow::recipe_schema::schema;

const EXAMPLES: &str = "\
Examples:
  splat4d recipe > my.toml                        all settings at their defaults
  splat4d train my-take --recipe my.toml
  splat4d recipe --schema > recipe.schema.json    for editors

Editors with Taplo complete and check a recipe that begins with the line `#:schema ./recipe.schema.json`.";

/// Print a recipe with all settings, or their JSON Schema
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// Print the JSON Schema of recipes, for editors
    #[arg(long)]
    schema: bool,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let text = if args.schema {
        serde_json::to_string_pretty(&schema())?
    } else {
        // As `train` begins: the capture chooses the motion model.
        Recipe::default().with(|r| r.run.motion = MotionName::AUTO).to_toml()
    };
    console.result(text.trim_end());
    Ok(())
}
