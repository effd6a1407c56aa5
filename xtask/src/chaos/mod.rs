//! Chaos: every command that writes is killed, runs out of disk space, meets a second process, jumping clocks and
//! read-only folders; its result is compared with that of an undisturbed run.
//!
//! A trial passes if the same command, called again after the disturbance, ends with the undisturbed files; if every
//! call before did so too or reported why not (exit code 1 or 2, one error, no panic); if inputs and the user's own
//! file in the folder are unchanged; and if no temporary file remains.

mod disturb;
mod process;
mod sample;
mod verbs;

use crate::files::tree;
use anyhow::{Context, Result, bail, ensure};
use disturb::Disturbance;
use process::{Ending, Program};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;
use verbs::{Setup, VERBS, Verb};

/// Trials by default.
const TRIALS: usize = 20;
/// Seed by default.
const SEED: u64 = 44;
/// Files with times and paths of a run in them, which are not compared but must be there.
const VOLATILE: [&str; 10] = [
    "report.json",
    "run.json",
    "metrics.csv",
    "report.html",
    "compress.json",
    "compress.toml",
    "predict.json",
    "doctor.json",
    "doctor.html",
    "checkpoints",
];
/// The user's own file in every output folder, and its content.
const MINE: (&str, &str) = ("mine.txt", "not of splat4d");
/// Folder of a command's own state.
const STATE: &str = ".splat4d";

pub(crate) fn command(arguments: &[String]) -> Result<()> {
    let (mut trials, mut seed, mut program, mut only) = (TRIALS, SEED, None, None);
    let mut rest = arguments.iter();
    while let Some(flag) = rest.next() {
        let value = rest.next().with_context(|| format!("{flag} needs a value"))?;
        match flag.as_str() {
            "--trials" => trials = value.parse().context("--trials is a number")?,
            "--seed" => seed = value.parse().context("--seed is a number")?,
            "--program" => program = Some(PathBuf::from(value)),
            "--verb" => only = Some(value.clone()),
            _ => bail!("unknown option {flag}: --trials N, --seed N, --program FILE, --verb NAME"),
        }
    }
    let program = program.unwrap_or_else(|| {
        let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| PathBuf::from("target"), PathBuf::from);
        target.join("release").join(format!("splat4d{}", std::env::consts::EXE_SUFFIX))
    });
    let program = program
        .canonicalize()
        .with_context(|| format!("{}: build it first with cargo build --release -p splat4d", program.display()))?;
    let work = process::Scratch::new()?;
    let setup = Setup::new(Program(program), work.path())?;
    let mut bench = Bench { setup: &setup, work: work.path(), undisturbed: BTreeMap::new() };
    let verbs: Vec<&Verb> = VERBS.iter().filter(|v| only.as_ref().is_none_or(|o| v.name == o)).collect();
    ensure!(!verbs.is_empty(), "no verb of that name");
    let (began, mut failed, mut tally) = (Instant::now(), Vec::new(), BTreeMap::<String, usize>::new());
    for trial in 0..trials {
        let verb = verbs[trial % verbs.len()];
        let kind = Disturbance::ALL[(trial + trial / verbs.len()) % Disturbance::ALL.len()];
        let mut random = Random(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(trial as u64));
        match bench.trial(verb, kind, trial, &mut random) {
            Ok(how) => {
                *tally.entry(format!("{kind:?}: {how}")).or_default() += 1;
                println!("{trial:>4}  {:<16} {kind:?}: {how}", verb.name);
            }
            Err(error) => {
                println!("{trial:>4}  {:<16} {kind:?}: FAILED: {error:#}", verb.name);
                failed.push(trial);
            }
        }
    }
    for (how, count) in tally {
        println!("{count:>4} x {how}");
    }
    println!(
        "{} of {trials} trials passed in {:.0} s (seed {seed})",
        trials - failed.len(),
        began.elapsed().as_secs_f64()
    );
    ensure!(failed.is_empty(), "these trials failed: {failed:?}");
    Ok(())
}

/// A small generator (splitmix64): the same trials for the same seed.
pub(super) struct Random(u64);

impl Random {
    /// Evenly from 0 to 1.
    pub(super) fn share(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// An undisturbed run of a verb.
pub(super) struct Undisturbed {
    files: BTreeMap<PathBuf, Option<Vec<u8>>>,
    /// Seconds it took.
    pub(super) seconds: f64,
    /// Bytes it wrote.
    pub(super) bytes: u64,
}

struct Bench<'a> {
    setup: &'a Setup,
    work: &'a Path,
    undisturbed: BTreeMap<&'static str, Undisturbed>,
}

impl Bench<'_> {
    /// The folder of a trial, ready for the verb.
    fn place(&self, verb: &Verb, name: &str) -> Result<PathBuf> {
        let place = self.work.join(name);
        let _ = std::fs::remove_dir_all(&place);
        std::fs::create_dir_all(&place)?;
        (verb.prepare)(self.setup, &place).context("the place cannot be prepared")?;
        if verb.users_file {
            std::fs::create_dir_all(place.join("out"))?;
            std::fs::write(place.join("out").join(MINE.0), MINE.1)?;
        }
        Ok(place)
    }

    fn trial(&mut self, verb: &'static Verb, kind: Disturbance, trial: usize, random: &mut Random) -> Result<String> {
        if !self.undisturbed.contains_key(verb.name) {
            let place = self.place(verb, "undisturbed")?;
            let began = Instant::now();
            let ended = self.setup.program.run(&(verb.words)(self.setup, &place), &place, None)?;
            ensure!(ended.code == Some(0), "undisturbed it fails: {}", ended.said);
            let seconds = began.elapsed().as_secs_f64();
            let files = result(&place)?;
            let bytes = tree(&place)?.values().map(|b| b.len() as u64).sum();
            self.undisturbed.insert(verb.name, Undisturbed { files, seconds, bytes });
        }
        let before = self.setup.inputs()?;
        let place = self.place(verb, &format!("trial-{trial}"))?;
        let undisturbed = &self.undisturbed[verb.name];
        let words = (verb.words)(self.setup, &place);
        let how = disturb::disturb(kind, &self.setup.program, &words, &place, undisturbed, random)?;
        // After any disturbance the same command ends like an undisturbed one, or has already ended so.
        let last = self.setup.program.run(&words, &place, None)?;
        check_said(&last)?;
        let found = result(&place)?;
        if last.code != Some(0) {
            let done = found == undisturbed.files;
            ensure!(done, "in the end it is refused although its result is not there: {}", last.said);
        }
        same(&undisturbed.files, &found)?;
        ensure!(self.setup.inputs()? == before, "what it reads has changed");
        if verb.users_file {
            let mine = std::fs::read_to_string(place.join("out").join(MINE.0)).context("the user's file is gone")?;
            ensure!(mine == MINE.1, "the user's file has changed");
        }
        let left: Vec<_> = tree(&place)?.into_keys().filter(|p| p.to_string_lossy().ends_with("tmp")).collect();
        ensure!(left.is_empty(), "temporary files stay: {left:?}");
        std::fs::remove_dir_all(&place)?;
        Ok(how)
    }
}

/// Refusals state the reason, and nothing panics, hangs or is ended by the system.
pub(super) fn check_said(ended: &Ending) -> Result<()> {
    ensure!(!ended.said.contains("panicked"), "it panics: {}", ended.said);
    match ended.code {
        Some(0) => Ok(()),
        Some(1 | 2) if ended.said.lines().filter(|l| l.starts_with("error: ")).count() == 1 => Ok(()),
        code => bail!("exit code {code:?}: {}", ended.said),
    }
}

/// Compared output of a trial: the files of the output, volatile ones by name alone.
fn result(place: &Path) -> Result<BTreeMap<PathBuf, Option<Vec<u8>>>> {
    let all = tree(place)?.into_iter().filter(|(path, _)| {
        let out = path.starts_with("out") || path.file_stem().is_some_and(|s| s == "out");
        out && !path.iter().any(|part| part == STATE)
    });
    let volatile = |path: &Path| path.iter().any(|part| VOLATILE.iter().any(|v| part == *v));
    Ok(all
        .map(|(path, bytes)| {
            let keep = !volatile(&path);
            (path, keep.then_some(bytes))
        })
        .collect())
}

fn same(wanted: &BTreeMap<PathBuf, Option<Vec<u8>>>, found: &BTreeMap<PathBuf, Option<Vec<u8>>>) -> Result<()> {
    for (path, bytes) in wanted {
        let own = found.get(path).with_context(|| format!("{} is missing", path.display()))?;
        ensure!(own == bytes, "{} differs from the undisturbed one", path.display());
    }
    let more: Vec<_> = found.keys().filter(|p| !wanted.contains_key(*p)).collect();
    ensure!(more.is_empty(), "there are more files than undisturbed: {more:?}");
    Ok(())
}
