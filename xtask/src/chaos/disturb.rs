//! The disturbances.

use super::process::Program;
use super::{Random, STATE, Undisturbed, check_said};
use anyhow::{Result, ensure};
use std::ffi::OsString;
use std::fs::{File, Permissions};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// Most kills of one command.
const KILLS: usize = 3;
/// How far clocks jump.
const JUMP: Duration = Duration::from_secs(86_400);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Disturbance {
    /// `kill -9` at random times, up to three in a row.
    Kill,
    /// No space, from a random size on.
    Full,
    /// The same command a second time at once.
    TwoOwners,
    /// A kill, and clocks that jump a day forth or back; or that jump while a process runs.
    Clock,
    /// The folder becomes read-only at a random time.
    ReadOnly,
}

impl Disturbance {
    pub(super) const ALL: [Self; 5] = [Self::Kill, Self::Full, Self::TwoOwners, Self::Clock, Self::ReadOnly];
}

/// Disturbs a command, and states how that ended.
pub(super) fn disturb(
    kind: Disturbance,
    program: &Program,
    words: &[OsString],
    place: &Path,
    undisturbed: &Undisturbed,
    random: &mut Random,
) -> Result<String> {
    let time = |random: &mut Random| Duration::from_secs_f64(undisturbed.seconds * random.share());
    Ok(match kind {
        Disturbance::Kill => {
            let (mut kills, most) = (0, 1 + (random.share() * KILLS as f64) as usize);
            for _ in 0..most {
                let mut call = program.start(words, place, None)?;
                if !call.wait(time(random))? {
                    check_said(&call.end()?)?;
                    break;
                }
                call.kill()?;
                kills += 1;
            }
            format!("killed {kills} times")
        }
        Disturbance::Full => {
            // From nothing at all up to what it needs.
            let kilobytes = (undisturbed.bytes as f64 / 1024.0 * random.share().powi(3)) as u64;
            let ended = program.run(words, place, Some(kilobytes))?;
            check_said(&ended)?;
            ensure!(ended.code != Some(2), "a full disk is not the user's fault: {}", ended.said);
            if ended.code == Some(0) { "it fitted".into() } else { "refused for lack of space".into() }
        }
        Disturbance::TwoOwners => {
            let mut first = program.start(words, place, None)?;
            first.wait(time(random))?;
            let second = program.run(words, place, None)?;
            check_said(&second)?;
            let first = first.end()?;
            check_said(&first)?;
            ensure!(
                [&first, &second].iter().any(|e| e.code == Some(0)),
                "none of two does it: {} {}",
                first.said,
                second.said
            );
            if second.code == Some(0) { "both did it".into() } else { "the second was refused".into() }
        }
        Disturbance::Clock => {
            let at = if random.share() < 0.5 { SystemTime::now() - JUMP } else { SystemTime::now() + JUMP };
            let mut call = program.start(words, place, None)?;
            let lives = call.wait(time(random))?;
            set_times(place, at);
            if lives && random.share() < 0.5 {
                let second = program.run(words, place, None)?;
                check_said(&second)?;
                check_said(&call.end()?)?;
                "clocks jumped under a second process".into()
            } else {
                call.kill()?;
                "killed, then clocks jumped".into()
            }
        }
        Disturbance::ReadOnly => {
            let out = place.join("out");
            let target = if out.is_dir() { out } else { place.to_owned() };
            let mut call = program.start(words, place, None)?;
            call.wait(time(random))?;
            let guard = ReadOnly::new(&target)?;
            let ended = call.end()?;
            check_said(&ended)?;
            drop(guard);
            ensure!(ended.code != Some(2), "a read-only folder is not the user's fault: {}", ended.said);
            if ended.code == Some(0) { "it was done before".into() } else { "refused for lack of rights".into() }
        }
    })
}

fn folders(root: &Path) -> Vec<PathBuf> {
    let (mut found, mut next) = (vec![root.to_owned()], 0);
    while next < found.len() {
        let entries = std::fs::read_dir(&found[next]).into_iter().flatten().flatten();
        found.extend(entries.filter(|e| e.file_type().is_ok_and(|t| t.is_dir())).map(|e| e.path()));
        next += 1;
    }
    found
}

/// Sets the times of the state of all owned folders.
fn set_times(place: &Path, at: SystemTime) {
    for folder in folders(place).into_iter().filter(|f| f.file_name().is_some_and(|n| n == STATE)) {
        for file in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            let _ = File::options().write(true).open(file.path()).and_then(|f| f.set_modified(at));
        }
    }
}

/// A folder that is read-only for so long. Of root, who may write anywhere, the folders become immutable where the file
/// system handles that; else it is not disturbed.
struct ReadOnly(Vec<(PathBuf, Permissions)>, bool);

impl ReadOnly {
    fn new(root: &Path) -> Result<Self> {
        let mut before = Vec::new();
        for folder in folders(root) {
            let Ok(old) = std::fs::metadata(&folder).map(|m| m.permissions()) else { continue };
            let mut new = old.clone();
            new.set_readonly(true);
            if std::fs::set_permissions(&folder, new).is_ok() {
                before.push((folder, old));
            }
        }
        let immutable = before.iter().all(|(folder, _)| chattr("+i", folder));
        Ok(Self(before, immutable))
    }
}

impl Drop for ReadOnly {
    fn drop(&mut self) {
        for (folder, permissions) in &self.0 {
            if self.1 {
                chattr("-i", folder);
            }
            let _ = std::fs::set_permissions(folder, permissions.clone());
        }
    }
}

fn chattr(flag: &str, folder: &Path) -> bool {
    let mut command = std::process::Command::new("chattr");
    command.arg(flag).arg(folder).stdout(std::process::Stdio::null()).stderr(std::process::Stdio::null());
    command.status().is_ok_and(|s| s.success())
}
