//! Who works on a chunk: a lock file with its owner and a heartbeat, on any folder that workers share.
//!
//! A lock whose heart has not beaten for long belongs to somebody who died, and is taken over; so is one whose owner ran on
//! this machine and does not any more. Should two workers nevertheless do one chunk, they write the same bytes, each file under
//! a temporary name first: the lock saves work, and is not what makes the result right.

use crate::{Error, Result};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime};

/// Name of a lock file.
const LOCK: &str = "lock";
/// Name of the file that whoever removes a dead owner's lock holds meanwhile.
const TAKEOVER: &str = "lock.takeover";
/// Time between two heartbeats.
const BEAT: Duration = Duration::from_secs(5);
/// An owner whose heart has not beaten for so long is dead: a dozen beats, so that a busy file server is not taken for death.
const DEAD: Duration = Duration::from_secs(60);

/// A chunk that is this worker's until it is dropped.
pub(super) struct Claim {
    path: PathBuf,
    token: String,
    done: Arc<(Mutex<bool>, Condvar)>,
    heart: Option<JoinHandle<()>>,
}

impl Claim {
    /// Takes the folder of a chunk; inner error: who has it. Errors: the folder cannot be written.
    pub(super) fn new(folder: &Path) -> Result<Result<Self, String>> {
        Self::with_patience(folder, DEAD)
    }

    pub(super) fn with_patience(folder: &Path, dead: Duration) -> Result<Result<Self, String>> {
        let place = |e| {
            Error::io("the chunk cannot be claimed", e)
                .at(folder.display())
                .remedy("Check that the folder is writable and has space")
        };
        std::fs::create_dir_all(folder).map_err(place)?;
        let (path, token) = (folder.join(LOCK), token());
        if let Ok(owner) = std::fs::read_to_string(&path) {
            let aside = folder.join(TAKEOVER);
            if !is_dead(folder, &path, &owner, dead) || !bury(&path, &aside, &owner, folder, dead) {
                return Ok(Err(owner));
            }
        }
        match create(&path, &token) {
            Ok(()) => {}
            Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {
                return Ok(Err(std::fs::read_to_string(&path).unwrap_or_default()));
            }
            Err(e) => return Err(place(e)),
        }
        let done = Arc::new((Mutex::new(false), Condvar::new()));
        let heart = std::thread::spawn({
            let (path, token, done) = (path.clone(), token.clone(), done.clone());
            move || beat(&path, &token, &done)
        });
        Ok(Ok(Self { path, token, done, heart: Some(heart) }))
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        *self.done.0.lock().unwrap_or_else(|e| e.into_inner()) = true;
        self.done.1.notify_all();
        if let Some(heart) = self.heart.take() {
            let _ = heart.join();
        }
        if std::fs::read_to_string(&self.path).is_ok_and(|owner| owner == self.token) {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

/// Makes a file that nobody has made before.
fn create(path: &Path, text: &str) -> std::io::Result<()> {
    std::fs::OpenOptions::new().write(true).create_new(true).open(path)?.write_all(text.as_bytes())
}

/// Removes the lock of a dead owner. Of all who find it dead one at a time may, and looks again first: it never removes the
/// lock of whoever came after.
fn bury(path: &Path, turn: &Path, owner: &str, folder: &Path, dead: Duration) -> bool {
    if create(turn, "").is_err() {
        // Somebody is at it, or died of it.
        if is_old(folder, turn, dead) {
            let _ = std::fs::remove_file(turn);
        }
        return false;
    }
    let same = std::fs::read_to_string(path).is_ok_and(|now| now == owner);
    let buried = same && std::fs::remove_file(path).is_ok();
    let _ = std::fs::remove_file(turn);
    buried
}

/// Beats until the claim is dropped or another worker has it.
fn beat(path: &Path, token: &str, (done, changed): &(Mutex<bool>, Condvar)) {
    let mut over = done.lock().unwrap_or_else(|e| e.into_inner());
    while !*over {
        over = changed.wait_timeout(over, BEAT).unwrap_or_else(|e| e.into_inner()).0;
        let own = std::fs::read_to_string(path).is_ok_and(|owner| owner == token);
        if own && !*over {
            // Written and not touched: the time is then that of the machine whose folder it is.
            let _ = std::fs::File::options().write(true).open(path).and_then(|mut f| f.write_all(token.as_bytes()));
        }
    }
}

/// Who this worker is: host, process and a number that no other worker has.
fn token() -> String {
    let nanos = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).map_or(0, |d| d.as_nanos());
    format!("{} {} {nanos}", host(), std::process::id())
}

fn host() -> String {
    let name = ["/proc/sys/kernel/hostname", "/etc/hostname"].iter().find_map(|f| std::fs::read_to_string(f).ok());
    name.map_or_else(|| "unknown".into(), |n| n.trim().to_owned())
}

/// Whether the owner of a lock has died.
fn is_dead(folder: &Path, path: &Path, owner: &str, dead: Duration) -> bool {
    let mut words = owner.split(' ');
    if let (Some(host), Some(Ok(process))) = (words.next(), words.next().map(str::parse::<u32>))
        && host == self::host()
        && Path::new("/proc/self").exists()
        && process != std::process::id()
        && !Path::new(&format!("/proc/{process}")).exists()
    {
        return true;
    }
    is_old(folder, path, dead)
}

/// Whether a file was last written longer ago than that, by the clock of the folder's machine: clocks of workers differ.
fn is_old(folder: &Path, path: &Path, dead: Duration) -> bool {
    let modified = |p: &Path| std::fs::metadata(p).and_then(|m| m.modified()).ok();
    let probe = folder.join(format!(".now.{}.{:?}", std::process::id(), std::thread::current().id()));
    let now = std::fs::write(&probe, b"").ok().and_then(|()| modified(&probe)).unwrap_or_else(SystemTime::now);
    let _ = std::fs::remove_file(&probe);
    modified(path).is_some_and(|last| now.duration_since(last).is_ok_and(|age| age > dead))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_worker_has_a_chunk_until_it_is_done_or_dead() {
        let folder = tempfile::tempdir().unwrap();
        let Ok(Ok(claim)) = Claim::new(folder.path()) else { panic!("nobody has it") };
        let Ok(Err(owner)) = Claim::new(folder.path()) else { panic!("it is taken") };
        assert!(owner.contains(&std::process::id().to_string()), "{owner}");
        drop(claim);
        assert!(Claim::new(folder.path()).unwrap().is_ok(), "it is free again");
        let lock = folder.path().join(LOCK);
        // Somebody elsewhere, whose heart stopped; and one here, whose process is gone.
        std::fs::write(&lock, "elsewhere 1 2").unwrap();
        assert!(Claim::with_patience(folder.path(), DEAD).unwrap().is_err(), "it may live");
        std::thread::sleep(Duration::from_millis(30));
        assert!(Claim::with_patience(folder.path(), Duration::from_millis(1)).unwrap().is_ok());
        std::fs::write(&lock, format!("{} {} 7", host(), u32::MAX)).unwrap();
        assert!(Claim::new(folder.path()).unwrap().is_ok());
    }

    #[test]
    fn of_many_who_find_a_dead_owner_one_takes_over() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(LOCK), format!("{} {} 7", host(), u32::MAX)).unwrap();
        let claims: Vec<_> = std::thread::scope(|s| {
            let workers: Vec<_> = (0..8).map(|_| s.spawn(|| Claim::new(folder.path()).unwrap())).collect();
            workers.into_iter().map(|w| w.join().unwrap()).collect()
        });
        assert_eq!(claims.iter().filter(|c| c.is_ok()).count(), 1);
    }
}
