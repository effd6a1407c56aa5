//! The `splat4d` command: trains, measures, renders, compresses and plays dynamic 3D scenes.
//!
//! Each command is a file in `verbs`: it parses, calls `splat4d-workflow` and prints. Exit codes: 0 done, 1 failed, 2
//! bad input. This is a library only because the studies and the Python package share its console; its interface is not
//! public.
//!
//! # Code map
//!
//! A module imports only modules above it; `xtask/tests/tidy.rs` checks the order.
//!
//! | module | content |
//! |---|---|
//! | `interrupt.rs`, `bar.rs`, `console.rs` | Ctrl-C; a progress bar; output |
//! | `device.rs`, `measuring.rs`, `serving.rs`, `storage.rs` | options of several commands: device, evaluation, the player's server, object storage |
//! | `verbs/`, `verbs/info/` | one file per command |
//! | `bin/` | `s4d`, the command's second name: a launcher |

#![allow(missing_docs)] // internal to the workspace

mod bar;
pub mod console;
mod device;
pub mod interrupt;
mod measuring;
mod serving;
mod storage;
pub mod verbs;

use clap::{Parser, Subcommand};
use console::{Console, Loudness};
use splat4d::Error;
#[cfg(not(all(feature = "dynamics", feature = "import")))]
use splat4d_workflow::parts::left_out;

use std::ffi::OsString;
use std::process::ExitCode;

/// Exit code of work that was done.
const DONE: u8 = 0;
/// Exit code of work that failed.
const FAILED: u8 = 1;
/// Exit code of bad input: the user's files or options.
const BAD_INPUT: u8 = 2;

const EXAMPLES: &str = "\
Examples:
  splat4d import videos/ -o my-take        videos of one scene become a capture
  splat4d priors my-take --depth d.onnx    depth maps by a network that you bring
  splat4d train examples/knight            train, measure, report and film the bundled capture
  splat4d train my-take --minutes 10       finish within ten minutes
  splat4d train --resume runs/my-take      continue a run exactly
  splat4d status runs/my-take              steps, workers and time left of a run
  splat4d eval runs/knight --baseline      compare with a static scene
  splat4d render runs/knight -o turn.mp4   film an orbit through space and time
  splat4d localise runs/knight photo.jpg   pose and time of an image
  splat4d bake runs/knight -o knight.s4d   one small, seekable file for the player
  splat4d compress runs/knight             a smaller file, measured before and after
  splat4d view runs/knight                 play it in the browser
  splat4d export runs/knight -o now.ply --time 0.5
  splat4d export runs/knight --html -o knight.html
  splat4d convert scene.sog scene.spz      between formats of other programs
  splat4d edit runs/knight edits.toml -o clean.safetensors
  splat4d label runs/take                  labels of Gaussians, from masks
  splat4d info my-take                     contents and findings of a capture, run or file

Exit codes: 0 done, 1 failed or interrupted, 2 bad input.";

/// Output of `--version`: another program has a command of this name.
const VERSION: &str = concat!(
    env!("CARGO_PKG_VERSION"),
    "\nwrites .s4d, also installed as s4d: https://github.com/splat4d/splat4d\n\
     (the Python package splats4d is another program, whose command has the same name)"
);

/// 4D Gaussian splatting on any CPU or GPU: train, measure, compress and play dynamic 3D scenes.
#[derive(Debug, Parser)]
#[command(name = "splat4d", version, long_version = VERSION, after_help = EXAMPLES, max_term_width = 110)]
struct Cli {
    #[command(flatten)]
    globals: Globals,
    #[command(subcommand)]
    verb: Verb,
}

/// Options of every verb.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Global options")]
pub struct Globals {
    /// Print one JSON object per line (docs/events.md)
    #[arg(long, global = true)]
    json: bool,
    /// Print more
    #[arg(short, long, global = true, conflicts_with = "quiet")]
    verbose: bool,
    /// Print only warnings and errors
    #[arg(short, long, global = true)]
    quiet: bool,
    /// Begin every line of progress, warnings and errors with the time (UTC); with --json every object has `time`
    #[arg(long, global = true)]
    log_time: bool,
    /// Number of threads [default: all cores]; the result does not depend on it
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub threads: Option<u16>,
}

#[derive(Debug, Subcommand)]
enum Verb {
    #[cfg(feature = "import")]
    Import(verbs::import::Args),
    #[cfg(not(feature = "import"))]
    Import(verbs::left_out::Args),
    Priors(verbs::priors::Args),
    Train(Box<verbs::train::Args>),
    Join(verbs::join::Args),
    Status(verbs::status::Args),
    Eval(verbs::eval::Args),
    Compare(verbs::compare::Args),
    #[cfg(feature = "dynamics")]
    Predict(verbs::predict::Args),
    #[cfg(not(feature = "dynamics"))]
    Predict(verbs::left_out::Args),
    Render(verbs::render::Args),
    Localise(verbs::localise::Args),
    Bake(verbs::bake::Args),
    Compress(verbs::compress::Args),
    Export(verbs::export::Args),
    View(verbs::view::Args),
    Convert(verbs::convert::Args),
    Edit(verbs::edit::Args),
    Label(verbs::label::Args),
    Info(verbs::info::Args),
    Recipe(verbs::recipe::Args),
    Completions(verbs::completions::Args),
}

impl Verb {
    fn run(&self, console: &Console) -> anyhow::Result<()> {
        match self {
            #[cfg(feature = "import")]
            Verb::Import(args) => verbs::import::run(args, console),
            #[cfg(not(feature = "import"))]
            Verb::Import(_) => Err(left_out("`import`", "import").into()),
            Verb::Priors(args) => verbs::priors::run(args, console),
            Verb::Train(args) => verbs::train::run(args, console),
            Verb::Join(args) => verbs::join::run(args, console),
            Verb::Status(args) => verbs::status::run(args, console),
            Verb::Eval(args) => verbs::eval::run(args, console),
            Verb::Compare(args) => verbs::compare::run(args, console),
            #[cfg(feature = "dynamics")]
            Verb::Predict(args) => verbs::predict::run(args, console),
            #[cfg(not(feature = "dynamics"))]
            Verb::Predict(_) => Err(left_out("`predict`", "dynamics").into()),
            Verb::Render(args) => verbs::render::run(args, console),
            Verb::Localise(args) => verbs::localise::run(args, console),
            Verb::Bake(args) => verbs::bake::run(args, console),
            Verb::Compress(args) => verbs::compress::run(args, console),
            Verb::Export(args) => verbs::export::run(args, console),
            Verb::View(args) => verbs::view::run(args, console),
            Verb::Convert(args) => verbs::convert::run(args, console),
            Verb::Edit(args) => verbs::edit::run(args, console),
            Verb::Label(args) => verbs::label::run(args, console),
            Verb::Info(args) => verbs::info::run(args, console),
            Verb::Recipe(args) => verbs::recipe::run(args, console),
            Verb::Completions(args) => verbs::completions::run(args, console),
        }
    }
}

/// The command: parses the program's arguments, runs the verb and reports the result.
pub fn main() -> ExitCode {
    main_from(std::env::args_os()).into()
}

/// The command with these words, of which the first is its name; the exit code.
pub fn main_from(words: impl IntoIterator<Item = OsString>) -> u8 {
    parsed_from(words, |cli: Cli| (cli.globals, move |console: &Console| cli.verb.run(console)))
}

/// One verb with its options, for another program: prints nothing but warnings, and returns the objects that `--json`
/// would print, or the error.
pub fn call(words: &[OsString]) -> anyhow::Result<Vec<serde_json::Value>> {
    let name = OsString::from("splat4d");
    let cli = Cli::try_parse_from(std::iter::once(&name).chain(words)).map_err(|e| Error::input(without_usage(&e)))?;
    interrupt::embedded();
    let console = Console::keeping_objects();
    cli.verb.run(&console)?;
    Ok(console.into_objects())
}

/// What is wrong with the words, without the usage of the command line, which other programs do not show.
fn without_usage(error: &clap::Error) -> String {
    let text = error.to_string();
    if !error.use_stderr() {
        // It is the help that was asked for.
        return text.trim_end().to_owned();
    }
    let lines =
        text.lines().map(str::trim).take_while(|l| !l.starts_with("Usage:") && !l.starts_with("For more information"));
    let lines: Vec<&str> = lines.filter(|l| !l.is_empty()).collect();
    lines.join("; ").trim_start_matches("error: ").to_owned()
}

/// Parses the arguments of a program with the command's manners, does what `work` makes of them, and prints errors.
pub fn parsed<C, W>(work: impl FnOnce(C) -> (Globals, W)) -> ExitCode
where
    C: Parser,
    W: FnOnce(&Console) -> anyhow::Result<()>,
{
    parsed_from(std::env::args_os(), work).into()
}

fn parsed_from<C, W>(words: impl IntoIterator<Item = OsString>, work: impl FnOnce(C) -> (Globals, W)) -> u8
where
    C: Parser,
    W: FnOnce(&Console) -> anyhow::Result<()>,
{
    let (globals, work) = match C::try_parse_from(words) {
        Ok(cli) => work(cli),
        Err(error) => {
            // clap prints arguments unescaped: a file's name may contain an escape sequence.
            let text = error.to_string();
            if text.contains(|c| splat4d::text::acts(c) && c != '\n') {
                console::eprint_line(text.trim_end());
            } else {
                let _ = error.print();
            }
            return if error.use_stderr() { BAD_INPUT } else { DONE };
        }
    };
    let loudness = match (globals.quiet, globals.verbose) {
        (true, _) => Loudness::Quiet,
        (_, true) => Loudness::Verbose,
        _ => Loudness::Normal,
    };
    if globals.log_time {
        console::log_time();
    }
    let console = Console::new(loudness, globals.json);
    match threads(globals.threads).and_then(|()| work(&console)) {
        Ok(()) => DONE,
        Err(error) => {
            let code = exit_code(&error);
            console.error(&error_text(&error), code);
            code
        }
    }
}

fn threads(count: Option<u16>) -> anyhow::Result<()> {
    if let Some(count) = count {
        rayon::ThreadPoolBuilder::new()
            .num_threads(count.into())
            .build_global()
            .map_err(|e| anyhow::anyhow!("{count} threads could not be started ({e}). Request fewer."))?;
    }
    Ok(())
}

/// The error and its causes, but no cause whose text was printed already.
pub fn error_text(error: &anyhow::Error) -> String {
    error.chain().map(ToString::to_string).fold(String::new(), |mut said, cause| {
        if said.is_empty() {
            said = cause;
        } else if !said.contains(&cause) {
            said += &format!(": {cause}");
        }
        said
    })
}

/// 2 where the user's data, files or options are at fault, 1 for everything else: also for what the machine cannot,
/// such as write to a full disk.
fn exit_code(error: &anyhow::Error) -> u8 {
    if error.downcast_ref::<Error>().is_some_and(Error::is_users) { BAD_INPUT } else { FAILED }
}

/// The whole command, for completions, help and the reference in docs/.
pub fn command() -> clap::Command {
    <Cli as clap::CommandFactory>::command()
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::ErrorKind;

    #[test]
    fn the_command_line_is_consistent() {
        command().debug_assert();
    }

    #[test]
    fn causes_are_printed_once() {
        let io = std::io::Error::other("disk on fire");
        let error = anyhow::Error::from(Error::io("cannot be read", io)).context("the report");
        let text = error_text(&error);
        assert!(text.starts_with("the report: ") && text.matches("disk on fire").count() == 1, "{text}");
    }

    #[test]
    fn other_programs_get_errors_without_usage() {
        let output = |words: &[&str]| {
            let words: Vec<OsString> = words.iter().map(OsString::from).collect();
            call(&words).unwrap_err().to_string()
        };
        for (words, what) in [
            (&["train", "x", "--iteratons", "5"][..], "--iteratons"),
            (&["train", "x", "--minutes", "soon"], "soon"),
            (&["fly"], "fly"),
            (&["bake", "x"], "required"),
        ] {
            let text = output(words);
            let plain = !text.contains("Usage") && !text.contains("--help") && !text.contains('\n');
            assert!(text.contains(what) && plain && !text.starts_with("error"), "{text}");
        }
        assert!(output(&["bake", "--help"]).contains("Usage"));
    }

    #[test]
    fn user_errors_exit_with_2_and_failures_with_1() {
        assert_eq!(exit_code(&Error::input("x").into()), 2);
        assert_eq!(exit_code(&Error::new(ErrorKind::Unsupported, "x").into()), 2);
        assert_eq!(exit_code(&Error::new(ErrorKind::Diverged, "x").into()), 1);
        assert_eq!(exit_code(&anyhow::anyhow!("ffmpeg died")), 1);
    }
}
