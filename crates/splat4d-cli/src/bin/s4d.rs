//! `s4d`: the command under a second name, for systems where another package installs a command `splat4d`.
//!
//! It starts the `splat4d` in its own folder: a second copy of the program would double the archives and the time to
//! link.

use std::process::{Command, ExitCode};

/// Exit code of work that failed, as of the command itself.
const FAILED: u8 = 1;

fn main() -> ExitCode {
    let beside = std::env::current_exe().map(|own| {
        // Installers may link to the folder that holds both.
        let own = own.canonicalize().unwrap_or(own);
        own.with_file_name(format!("splat4d{}", std::env::consts::EXE_SUFFIX))
    });
    let program = match beside {
        Ok(program) => program,
        Err(error) => return failed(&format!("cannot find the folder of s4d: {error}")),
    };
    let mut command = Command::new(&program);
    command.args(std::env::args_os().skip(1));
    let error = run(&mut command);
    match error {
        Ok(code) => code,
        Err(error) => failed(&format!("{}: cannot be started: {error}. Install splat4d again", program.display())),
    }
}

/// Becomes the command: signals, input and exit code are its own.
#[cfg(unix)]
fn run(command: &mut Command) -> std::io::Result<ExitCode> {
    Err(std::os::unix::process::CommandExt::exec(command))
}

/// Waits for the command, which alone handles Ctrl-C.
#[cfg(not(unix))]
fn run(command: &mut Command) -> std::io::Result<ExitCode> {
    let _ = ctrlc::set_handler(|| {});
    let status = command.status()?;
    Ok(ExitCode::from(status.code().and_then(|code| u8::try_from(code).ok()).unwrap_or(FAILED)))
}

fn failed(what: &str) -> ExitCode {
    eprintln!("error: {what}.");
    ExitCode::from(FAILED)
}
