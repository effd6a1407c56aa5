//! `completions`: what shells need to complete the command line.

use crate::console::Console;
use clap_complete::Shell;

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
    clap_complete::generate(args.shell, &mut crate::command(), "splat4d", &mut script);
    console.result(String::from_utf8_lossy(&script).trim_end());
    Ok(())
}
