//! Runs every reader on mutated seeds, on a stable toolchain: `cargo run --release -p xtask -- fuzz`.
//!
//! Each reader runs in its own process with limited memory, so an abort, an allocation beyond the limit or a hang ends
//! only that process. Input number i of a reader is a function of seed, reader and i, so failures are reproducible.

use anyhow::{Context, Result, bail, ensure};
use splat4d_fuzz::{Reader, mutate, readers};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use std::time::{Duration, Instant};

const USAGE: &str = "\
usage: fuzz [--minutes N | --seconds N] [--executions N] [--seed S] [--reader NAME]
  --minutes N      time for all readers together (default 2)
  --executions N   at most this many inputs per reader
  --seed S         other inputs (default 1)
  --reader NAME    this reader alone";

/// Address space of a process, kB: 1 GiB for the reader, and 128 MiB for the program, its seeds and its threads (16 to
/// 20 MiB measured).
const MEMORY: u64 = (1 << 20) + (128 << 10);
/// A reader that takes longer for one input hangs.
const SLOWEST: Duration = Duration::from_secs(10);
/// Ticks a second of the times in `/proc` (`USER_HZ`).
const TICKS: f64 = 100.0;
/// Inputs between two readings of the clock.
const BATCH: u64 = 64;

#[derive(Clone, Debug)]
struct Options {
    time: Duration,
    executions: u64,
    seed: u64,
    reader: Option<String>,
    /// In a child: the first input, and the file that receives each input before it is read.
    child: bool,
    from: u64,
    keep: Option<PathBuf>,
}

fn main() -> ExitCode {
    let done = options(std::env::args().skip(1)).and_then(|o| if o.child { child(&o) } else { parent(&o) });
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn options(mut words: impl Iterator<Item = String>) -> Result<Options> {
    let mut out = Options {
        time: Duration::from_secs(120),
        executions: u64::MAX,
        seed: 1,
        reader: None,
        child: false,
        from: 0,
        keep: None,
    };
    while let Some(word) = words.next() {
        let mut value = || words.next().with_context(|| format!("{word} needs a value\n{USAGE}"));
        match word.as_str() {
            "--minutes" => out.time = Duration::from_secs_f64(60.0 * value()?.parse::<f64>()?),
            "--seconds" => out.time = Duration::from_secs_f64(value()?.parse()?),
            "--executions" => out.executions = value()?.parse()?,
            "--seed" => out.seed = value()?.parse()?,
            "--reader" => out.reader = Some(value()?),
            "--child" => out.child = true,
            "--from" => out.from = value()?.parse()?,
            "--keep" => out.keep = Some(value()?.into()),
            _ => bail!("unknown option {word}\n{USAGE}"),
        }
    }
    Ok(out)
}

/// Reads inputs and prints how many; a failure ends the process.
fn child(options: &Options) -> Result<()> {
    let name = options.reader.as_deref().context("a child runs one reader")?;
    let reader = readers().find(|r| r.name == name).with_context(|| format!("there is no reader {name}"))?;
    let seeds = (reader.seeds)();
    let started = Instant::now();
    let (mut i, end) = (options.from, options.from.saturating_add(options.executions));
    while i < end && started.elapsed() < options.time {
        for _ in 0..BATCH.min(end - i) {
            let input = mutate::mutant(&seeds, options.seed, name, i);
            if let Some(file) = &options.keep {
                std::fs::write(file, &input)?;
            }
            let begun = Instant::now();
            (reader.read)(&input);
            // A process that had to wait for a processor is not slow: slow inputs are read again by the processor's
            // clock.
            if begun.elapsed() >= SLOWEST {
                let (begun, before) = (Instant::now(), processor_time());
                (reader.read)(&input);
                let used = before.zip(processor_time()).map(|(before, after)| after.saturating_sub(before));
                let again = used.unwrap_or_else(|| begun.elapsed());
                ensure!(again < SLOWEST, "input {i} takes {:.0} s", again.as_secs_f64());
            }
            i += 1;
        }
        // The parent process reads the progress here, even if the next batch kills this one.
        println!("{i}");
    }
    Ok(())
}

/// Processor time of this process; `None`: the system does not report it.
fn processor_time() -> Option<Duration> {
    let text = std::fs::read_to_string("/proc/self/stat").ok()?;
    // Behind the name, which may hold spaces, the twelfth and thirteenth field: user and system (man 5 proc).
    let fields: Vec<&str> = text.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks: u64 = fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?;
    Some(Duration::from_secs_f64(ticks as f64 / TICKS))
}

/// Runs the readers one after the other and prints a table.
fn parent(options: &Options) -> Result<()> {
    let chosen: Vec<&Reader> = readers().filter(|r| options.reader.as_deref().is_none_or(|n| n == r.name)).collect();
    ensure!(!chosen.is_empty(), "there is no such reader; there are: {}", names());
    let share = options.time / chosen.len() as u32;
    let (mut failed, mut all) = (Vec::new(), 0);
    println!("| reader | executions | a second | result |\n|---|---|---|---|");
    for reader in chosen {
        let started = Instant::now();
        let (count, sound, words) = run(reader, options, share, 0, None)?;
        let rate = count as f64 / started.elapsed().as_secs_f64().max(1e-3);
        all += count;
        let result = if sound {
            "none failed".to_owned()
        } else {
            format!("FAILED: {}", again(reader, options, count, &words)?)
        };
        println!("| {} | {count} | {rate:.0} | {result} |", reader.name);
        if !sound {
            failed.push(reader.name);
        }
    }
    println!("\n{all} executions, seed {}", options.seed);
    ensure!(failed.is_empty(), "failed: {}", failed.join(", "));
    Ok(())
}

fn names() -> String {
    readers().map(|r| r.name).collect::<Vec<_>>().join(", ")
}

/// Runs a child: how many inputs it read, whether it succeeded, and its output.
fn run(
    reader: &Reader,
    options: &Options,
    time: Duration,
    from: u64,
    keep: Option<&Path>,
) -> Result<(u64, bool, String)> {
    let own = std::env::current_exe()?;
    let (executions, seconds) = (options.executions.to_string(), time.as_secs_f64().to_string());
    let (seed, from) = (options.seed.to_string(), from.to_string());
    let mut words = vec!["--child", "--reader", reader.name, "--executions", &executions, "--seconds", &seconds];
    words.extend(["--seed", &seed, "--from", &from]);
    let kept = keep.map(|k| k.display().to_string());
    words.extend(kept.iter().flat_map(|k| ["--keep", k.as_str()]));
    let mut command = if cfg!(unix) {
        let mut shell = Command::new("sh");
        shell.args(["-c", &format!("ulimit -v {MEMORY} 2>/dev/null; exec \"$0\" \"$@\"")]).arg(own);
        shell
    } else {
        Command::new(own)
    };
    // Every thread has a stack and an arena.
    command.args(words).env("RAYON_NUM_THREADS", "1").env("MALLOC_ARENA_MAX", "1");
    let out = command.stdin(Stdio::null()).output()?;
    let count = String::from_utf8_lossy(&out.stdout).lines().last().and_then(|l| l.parse().ok()).unwrap_or(0);
    Ok((count, out.status.success(), String::from_utf8_lossy(&out.stderr).into_owned()))
}

/// Finds the input that failed, keeps it and states where it is and what happened.
fn again(reader: &Reader, options: &Options, from: u64, words: &str) -> Result<String> {
    let folder = std::env::current_exe()?.parent().context("a program lies in a folder")?.join("fuzz");
    std::fs::create_dir_all(&folder)?;
    let file = folder.join(format!("{}.bin", reader.name));
    let few = Options { executions: BATCH, ..options.clone() };
    let (_, sound, second) = run(reader, &few, 2 * SLOWEST, from, Some(&file))?;
    let said = if second.is_empty() { words } else { &second };
    let line: String = said.lines().find(|l| !l.trim().is_empty()).unwrap_or("no message").chars().take(200).collect();
    Ok(if sound { format!("not again; {line}") } else { format!("{}: {line}", file.display()) })
}
