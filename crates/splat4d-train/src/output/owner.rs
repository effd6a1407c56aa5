//! Owner of a folder: a lock of the operating system, and a record of the owner with a heartbeat.
//!
//! On one machine the lock decides: the system releases it when its process ends, however that happens, so that neither
//! a reused process number nor a clock that was set plays a part. A lock that is free although the record names another
//! machine may only mean that the file system does not share locks; then the heartbeat decides. Its age is measured by
//! the folder's own clock, and where that states "long ago" or "in the future" the record is watched for some beats
//! before it is taken over: a clock that jumps makes no owner dead.

use super::date::rfc3339;
use super::{STATE, cannot_write, check_plain, temporary};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::fs::{File, TryLockError};
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

/// File that is locked; it is empty, and stays.
const LOCK: &str = "lock";
/// File with the owner of the lock.
const RECORD: &str = "owner.json";
/// Time between two heartbeats.
const BEAT: Duration = Duration::from_secs(5);
/// An owner on another machine whose heart has not beaten for so long is taken for dead: a dozen beats, so that a busy
/// file server is not.
const DEAD: Duration = Duration::from_secs(60);
/// So long a record is watched before it is taken over: three beats.
const WATCH: Duration = Duration::from_secs(15);
/// Interval between reads of a record that is watched, or at a lock that is waited for.
const POLL: Duration = Duration::from_millis(100);
/// A lock that is held for less time belongs to a process that looked whether there is an owner; and the interval
/// between attempts meanwhile. Looking takes two calls of the system.
const GLANCE: Duration = Duration::from_millis(100);
const AGAIN: Duration = Duration::from_millis(5);

/// The owner of a folder, as its record states it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OwnerRecord {
    /// The command, for instance `train`.
    pub command: String,
    /// Process number.
    pub process: u32,
    /// Name of the machine.
    pub host: String,
    /// UTC.
    pub since: String,
    /// An identifier of the machine as long as it runs; empty where the system does not report it.
    machine: String,
    /// Number of heartbeats, always with as many digits, so that the record never changes its length.
    beat: String,
}

impl OwnerRecord {
    fn new(command: &str) -> Self {
        Self {
            command: command.into(),
            process: std::process::id(),
            host: host(),
            since: rfc3339(SystemTime::now()),
            machine: machine(),
            beat: beat(0),
        }
    }

    /// Whether it is this process.
    fn is_own(&self) -> bool {
        self.process == std::process::id() && self.machine == machine()
    }

    fn read(path: &Path) -> Option<Self> {
        serde_json::from_slice(&crate::files::read(path).ok()?).ok()
    }

    fn bytes(&self) -> Vec<u8> {
        serde_json::to_vec(self).expect("a record is plain data")
    }
}

impl std::fmt::Display for OwnerRecord {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "`splat4d {}`, process {} on {}, since {}", self.command, self.process, self.host, self.since)
    }
}

/// The right to write into a folder, until it is dropped or the process ends.
#[derive(Debug)]
pub struct Owner {
    record: PathBuf,
    entry: OwnerRecord,
    /// Held, not read.
    lock: Option<File>,
    done: Arc<(Mutex<bool>, Condvar)>,
    heart: Option<JoinHandle<()>>,
}

/// Time for which a dead owner's record is accepted, and watched.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patience {
    pub(super) dead: Duration,
    pub(super) watch: Duration,
}

impl Owner {
    /// Makes the folder's state and takes the folder; the inner error is its owner; `None`: its record cannot be read.
    ///
    /// Errors: the folder cannot be written.
    pub(crate) fn take(folder: &Path, command: &str) -> Result<Result<Self, Option<OwnerRecord>>> {
        Self::with_patience(folder, command, Patience { dead: DEAD, watch: WATCH })
    }

    pub(super) fn with_patience(
        folder: &Path,
        command: &str,
        patience: Patience,
    ) -> Result<Result<Self, Option<OwnerRecord>>> {
        let state = folder.join(STATE);
        let fail = |e| cannot_write(folder, e);
        let record = state.join(RECORD);
        let began = Instant::now();
        let lock = loop {
            std::fs::create_dir_all(&state).map_err(fail)?;
            check_plain(&state.join(LOCK))?;
            check_plain(&record)?;
            let opened = File::options().read(true).write(true).create(true).truncate(false).open(state.join(LOCK));
            let lock = match opened {
                // Its owner has just removed the state of a folder in which nothing was begun.
                Err(e) if e.kind() == std::io::ErrorKind::NotFound && folder.exists() => continue,
                opened => opened.map_err(fail)?,
            };
            match lock.try_lock() {
                // A file system without locks: the heartbeat alone decides.
                Ok(()) | Err(TryLockError::Error(_)) => {}
                // Perhaps only a process that looks whether there is an owner.
                Err(TryLockError::WouldBlock) if began.elapsed() < GLANCE => {
                    std::thread::sleep(AGAIN);
                    continue;
                }
                Err(TryLockError::WouldBlock) => return Ok(Err(OwnerRecord::read(&record))),
            }
            if is_at(&lock, &state.join(LOCK)) {
                break lock;
            }
        };
        let before = OwnerRecord::read(&record);
        if let Some(before) = before.filter(|b| b.machine != machine() && is_alive(&state, &record, b, patience)) {
            return Ok(Err(Some(before)));
        }
        // What a dead owner left half-written. Workers on parts of a folder have folders and locks of their own.
        temporary::remove_leftovers(folder);
        let entry = OwnerRecord::new(command);
        let opened = File::options().write(true).create(true).truncate(true).open(&record);
        let written = opened.and_then(|mut file| file.write_all(&entry.bytes()).map(|()| file));
        let mut file = written.map_err(|e| {
            // A full disk: nothing stays of what was made for nothing.
            let _ = std::fs::remove_file(&record);
            discard(&state);
            fail(e)
        })?;
        let done = Arc::new((Mutex::new(false), Condvar::new()));
        let heart = std::thread::spawn({
            let (entry, done) = (entry.clone(), done.clone());
            move || pulse(&mut file, entry, &done)
        });
        Ok(Ok(Self { record, entry, lock: Some(lock), done, heart: Some(heart) }))
    }

    /// The same; another owner is an error that names it.
    pub fn of(folder: &Path, command: &str) -> Result<Self> {
        Self::take(folder, command)?.map_err(|who| in_use(folder, who.as_ref()))
    }

    /// Waits for the folder while `go_on` returns true for its owner. Errors: the folder cannot be written; it is in
    /// use.
    pub fn wait(folder: &Path, command: &str, go_on: &mut dyn FnMut(Option<&OwnerRecord>) -> bool) -> Result<Self> {
        loop {
            match Self::take(folder, command)? {
                Ok(owner) => return Ok(owner),
                Err(who) if go_on(who.as_ref()) => std::thread::sleep(POLL),
                Err(who) => return Err(in_use(folder, who.as_ref())),
            }
        }
    }

    /// Releases the folder and removes all traces of ownership while the lock is held, so that no other process has it.
    pub(super) fn remove(mut self, folder: &Path) {
        self.rest();
        discard(&folder.join(STATE));
    }

    /// Ends the heartbeat and the record.
    fn rest(&mut self) {
        *self.done.0.lock().unwrap_or_else(|e| e.into_inner()) = true;
        self.done.1.notify_all();
        let Some(heart) = self.heart.take() else { return };
        let _ = heart.join();
        let own = |s: OwnerRecord| s.process == self.entry.process && s.machine == self.entry.machine;
        if OwnerRecord::read(&self.record).is_some_and(own) {
            let _ = std::fs::remove_file(&self.record);
        }
    }

    /// Present owner of the folder, read without changing it; the inner `None`: an owner whose record cannot be read.
    pub fn holder(folder: &Path) -> Option<Option<OwnerRecord>> {
        let (record, lock) = (folder.join(STATE).join(RECORD), folder.join(STATE).join(LOCK));
        check_plain(&lock).ok()?;
        let lock = File::open(lock).ok()?;
        if let Err(TryLockError::WouldBlock) = lock.try_lock_shared() {
            return Some(OwnerRecord::read(&record));
        }
        let _ = lock.unlock();
        let other = OwnerRecord::read(&record).filter(|s| s.machine != machine())?;
        age(&record, SystemTime::now()).is_some_and(|age| age <= DEAD).then_some(Some(other))
    }

    /// The same, if it is not this process.
    pub fn other(folder: &Path) -> Option<Option<OwnerRecord>> {
        Self::holder(folder).filter(|who| !who.as_ref().is_some_and(OwnerRecord::is_own))
    }
}

impl Drop for Owner {
    fn drop(&mut self) {
        self.rest();
        // Not by closing it: a program that another thread starts at this moment has a copy of the open file.
        if let Some(lock) = self.lock.take() {
            let _ = lock.unlock();
        }
    }
}

/// Removes the lock, which is held, and the state where nothing else is in it.
fn discard(state: &Path) {
    let _ = std::fs::remove_file(state.join(LOCK));
    let _ = std::fs::remove_dir(state);
}

/// Refuses to write a file into a folder that another process owns. Errors: who that is.
pub fn check_free(file: &Path) -> Result<()> {
    let folder = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    Owner::other(folder).map_or(Ok(()), |who| Err(in_use(folder, who.as_ref())))
}

pub(super) fn in_use(folder: &Path, who: Option<&OwnerRecord>) -> Error {
    let who = who.map_or_else(|| "another process".to_owned(), ToString::to_string);
    Error::new(crate::ErrorKind::Io, format!("is in use by {who}"))
        .at(folder.display())
        .remedy("Wait for it, stop it, or choose another folder")
}

/// Whether an open file is still the one of that name.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let same = |a: std::fs::Metadata, b: std::fs::Metadata| (a.dev(), a.ino()) == (b.dev(), b.ino());
    file.metadata().ok().zip(std::fs::metadata(path).ok()).is_some_and(|(a, b)| same(a, b))
}

#[cfg(not(unix))]
fn is_at(_: &File, path: &Path) -> bool {
    path.exists()
}

fn beat(count: u64) -> String {
    format!("{count:010}")
}

/// Beats until the owner is dropped. Written through the open file: if another process replaced the record, nothing of
/// its own is touched. The time of the file is then that of the machine whose folder it is.
fn pulse(file: &mut File, mut entry: OwnerRecord, (done, changed): &(Mutex<bool>, Condvar)) {
    let mut over = done.lock().unwrap_or_else(|e| e.into_inner());
    for count in 1u64.. {
        over = changed.wait_timeout_while(over, BEAT, |over| !*over).unwrap_or_else(|e| e.into_inner()).0;
        if *over {
            return;
        }
        entry.beat = beat(count);
        // A beat that fails, on a full or read-only disk, is followed by others.
        let _ = file.seek(SeekFrom::Start(0)).and_then(|_| file.write_all(&entry.bytes()));
    }
}

/// Whether the owner on another machine, or on one that was restarted since, is running.
fn is_alive(state: &Path, record: &Path, before: &OwnerRecord, patience: Patience) -> bool {
    let fresh = |age: Option<Duration>| age.is_some_and(|age| age <= patience.dead);
    if fresh(age(record, now(state))) {
        return true;
    }
    let began = Instant::now();
    while began.elapsed() < patience.watch {
        match OwnerRecord::read(record) {
            Some(now) if now.beat == before.beat && now.since == before.since => std::thread::sleep(POLL),
            // It ended in peace meanwhile.
            None if !record.exists() => return false,
            _ => return true,
        }
    }
    false
}

/// Time since a file was last written, or until then if it is in the future; `None`: unknown.
fn age(path: &Path, now: SystemTime) -> Option<Duration> {
    let written = std::fs::metadata(path).and_then(|m| m.modified()).ok()?;
    Some(now.duration_since(written).unwrap_or_else(|future| future.duration()))
}

/// Now, by the clock of the folder's machine: clocks of machines differ.
fn now(state: &Path) -> SystemTime {
    let probe = state.join(format!("now-{}-{:?}", std::process::id(), std::thread::current().id()));
    let stamp = std::fs::write(&probe, b"").and_then(|()| std::fs::metadata(&probe)).and_then(|m| m.modified());
    let _ = std::fs::remove_file(&probe);
    stamp.unwrap_or_else(|_| SystemTime::now())
}

/// Name of this machine, for people.
fn host() -> String {
    let name = ["/proc/sys/kernel/hostname", "/etc/hostname"].iter().find_map(|f| std::fs::read_to_string(f).ok());
    name.map_or_else(|| "this machine".into(), |n| n.trim().to_owned())
}

/// An identifier of this machine, as long as it runs: Linux' boot id, which containers share with their host as they
/// share its locks.
fn machine() -> String {
    let id = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    id.trim().to_owned()
}

#[cfg(test)]
#[allow(clippy::result_large_err)] // the error of the crate, in closures of tests
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicBool, Ordering};

    const QUICK: Patience = Patience { dead: Duration::from_millis(200), watch: Duration::from_millis(1000) };

    fn elsewhere(folder: &Path, beat: &str) -> OwnerRecord {
        let state = folder.join(STATE);
        std::fs::create_dir_all(&state).unwrap();
        let other = OwnerRecord { host: "elsewhere".into(), machine: "other".into(), ..OwnerRecord::new("train") };
        let other = OwnerRecord { beat: beat.into(), ..other };
        // Whole at any time, as a real owner's: one that is read empty is that of a killed process.
        std::fs::write(state.join("elsewhere.tmp"), other.bytes()).unwrap();
        std::fs::rename(state.join("elsewhere.tmp"), state.join(RECORD)).unwrap();
        other
    }

    fn set_time(folder: &Path, at: SystemTime) {
        let file = File::options().write(true).open(folder.join(STATE).join(RECORD)).unwrap();
        file.set_modified(at).unwrap();
    }

    #[test]
    fn a_folder_has_one_owner_who_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let owner = Owner::of(folder.path(), "train").unwrap();
        assert_eq!(Owner::holder(folder.path()).unwrap().unwrap().command, "train");
        let error = Owner::of(folder.path(), "eval").unwrap_err();
        let text = error.to_string();
        assert_eq!(error.kind(), crate::ErrorKind::Io, "the user's input is not at fault");
        let process = format!("`splat4d train`, process {} on {}, since 20", std::process::id(), host());
        assert!(text.contains("in use by") && text.contains(&process), "{text}");
        drop(owner);
        assert!(Owner::holder(folder.path()).is_none() && !folder.path().join(STATE).join(RECORD).exists());
        drop(Owner::of(folder.path(), "eval").unwrap());
    }

    /// A record of a process that was killed: the next process takes over at once, also if its process id was reused.
    #[test]
    fn neither_a_look_nor_a_copy_of_the_open_file_keeps_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        let owner = Owner::of(folder.path(), "train").unwrap();
        // As a program has one between its start and its own first instruction.
        let copy = owner.lock.as_ref().unwrap().try_clone().unwrap();
        drop(owner);
        drop(Owner::of(folder.path(), "eval").unwrap());
        drop(copy);
        let look = File::open(folder.path().join(STATE).join(LOCK)).unwrap();
        look.lock_shared().unwrap();
        let looked = std::thread::spawn(move || {
            std::thread::sleep(GLANCE / 4);
            drop(look);
        });
        drop(Owner::of(folder.path(), "train").unwrap());
        looked.join().unwrap();
    }

    #[test]
    fn a_dead_owner_of_this_machine_is_replaced_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let state = folder.path().join(STATE);
        std::fs::create_dir_all(&state).unwrap();
        for process in [u32::MAX, 1] {
            let dead = OwnerRecord { process, ..OwnerRecord::new("train") };
            std::fs::write(state.join(RECORD), dead.bytes()).unwrap();
            let began = Instant::now();
            drop(Owner::of(folder.path(), "train").unwrap());
            assert!(began.elapsed() < WATCH, "nothing is watched");
        }
        // Half a record, as a kill may leave it.
        std::fs::write(state.join(RECORD), &OwnerRecord::new("train").bytes()[..20]).unwrap();
        drop(Owner::of(folder.path(), "train").unwrap());
    }

    #[test]
    fn a_remote_owner_is_alive_while_its_heartbeat_changes() {
        let folder = tempfile::tempdir().unwrap();
        let hour = Duration::from_secs(3600);
        let take = || Owner::with_patience(folder.path(), "train", QUICK).unwrap();
        elsewhere(folder.path(), "1");
        assert_eq!(take().unwrap_err().unwrap().host, "elsewhere", "it beat just now");
        // Clocks that jumped an hour forth or back: the record is watched, and beats.
        for at in [SystemTime::now() - hour, SystemTime::now() + hour] {
            elsewhere(folder.path(), "1");
            set_time(folder.path(), at);
            let ended = AtomicBool::new(false);
            std::thread::scope(|s| {
                s.spawn(|| {
                    for beat in 2.. {
                        if ended.load(Ordering::Relaxed) {
                            break;
                        }
                        elsewhere(folder.path(), &beat.to_string());
                        set_time(folder.path(), at);
                        std::thread::sleep(QUICK.watch / 50);
                    }
                });
                let took = take();
                ended.store(true, Ordering::Relaxed);
                assert!(took.is_err(), "it lives");
            });
            // And does not any more.
            assert!(take().is_ok(), "it is dead");
        }
    }

    #[test]
    fn one_of_many_processes_takes_over_from_a_dead_owner() {
        let folder = tempfile::tempdir().unwrap();
        elsewhere(folder.path(), "1");
        set_time(folder.path(), SystemTime::now() - Duration::from_secs(3600));
        let took: Vec<_> = std::thread::scope(|s| {
            let one = || Owner::with_patience(folder.path(), "train", QUICK).unwrap();
            let all: Vec<_> = (0..8).map(|_| s.spawn(one)).collect();
            all.into_iter().map(|w| w.join().unwrap()).collect()
        });
        assert_eq!(took.iter().filter(|c| c.is_ok()).count(), 1);
    }
}
