//! `completions`: what shells need to complete the command line.

use crate::console::Console;
use clap::builder::PossibleValuesParser;
use clap_complete::Shell;
use splat4d_train::recipe::Recipe;

const EXAMPLES: &str = "\
Examples:
  splat4d completions bash > ~/.local/share/bash-completion/completions/splat4d
  splat4d completions zsh > ~/.zfunc/_splat4d
  splat4d completions fish > ~/.config/fish/completions/splat4d.fish";

/// Print shell completions
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Args {
    /// The shell
    shell: Shell,
}

pub(crate) fn run(args: &Args, console: &Console) -> anyhow::Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut completed(), "splat4d", &mut script);
    console.result(String::from_utf8_lossy(&script).trim_end());
    Ok(())
}

/// The command with the words that its options take. The command that runs checks them itself, with better messages.
fn completed() -> clap::Command {
    let settings = Recipe::settings();
    let models = settings.iter().find(|k| k.key() == "run.motion").map(|k| k.choices.clone()).unwrap_or_default();
    // Settings have a long name and most of them a short one. Words of a command need a static lifetime.
    let long = settings.iter().map(|k| format!("{}=", k.key()));
    let short = settings.iter().filter_map(|k| Recipe::flat_name(&k.key()).map(|name| format!("{name}=")));
    let settings: Vec<&'static str> = long.chain(short).map(|word| &*word.leak()).collect();
    let with_settings =
        |verb: clap::Command| verb.mut_arg("set", |a| a.value_parser(PossibleValuesParser::new(settings.clone())));
    crate::command()
        .mut_subcommand("train", |v| {
            with_settings(v).mut_arg("motion", |a| a.value_parser(PossibleValuesParser::new(models)))
        })
        .mut_subcommand("info", with_settings)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shells_complete_models_settings_and_devices() {
        for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut completed(), "splat4d", &mut script);
            let script = String::from_utf8(script).unwrap();
            for word in ["deform-mlp", "run.iterations=", "densify.max_cap=", "lambda_dssim=", "auto"] {
                assert!(script.contains(word), "{shell}: {word}");
            }
        }
    }
}
