//! The `splat4d` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    splat4d_cli::main()
}
