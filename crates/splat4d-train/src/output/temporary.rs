//! Temporary names of files that are being written, and removal of those that dead processes left.

use super::list;
use std::collections::BTreeSet;
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Ending of temporary names.
pub(super) const ENDING: &str = ".splat4d-tmp";
/// Most bytes of a file's own name in its temporary one: names have 255 on all common systems.
const NAME_BYTES: usize = 180;
/// A temporary file of another machine is left over when it was not written for so long.
const LEFT_OVER: Duration = Duration::from_secs(3600);
/// Numbers of this process's temporary files.
static NUMBER: AtomicU64 = AtomicU64::new(0);
/// Folders in which this process has searched for leftovers.
static LOOKED: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// `.NAME.MACHINE-PROCESS-NUMBER.splat4d-tmp`, of a long name only the beginning.
pub(super) fn temporary_name(name: &OsStr) -> OsString {
    let own = format!("{}-{}-{}", machine(), std::process::id(), NUMBER.fetch_add(1, Ordering::Relaxed));
    let mut out = OsString::from(".");
    if name.len() <= NAME_BYTES {
        out.push(name);
    } else {
        out.push(name.to_string_lossy().chars().take(NAME_BYTES / 4).collect::<String>());
    }
    out.push(format!(".{own}{ENDING}"));
    out
}

/// Whether this is the temporary name of a file that is no longer being written.
fn is_left_over(path: &Path) -> bool {
    let Some(name) = path.file_name().map(OsStr::to_string_lossy) else { return false };
    let Some(name) = name.strip_prefix('.').and_then(|n| n.strip_suffix(ENDING)) else { return false };
    let mut parts = name.rsplit('.').next().unwrap_or_default().split('-');
    let (Some(of), Some(Ok(process))) = (parts.next(), parts.next().map(str::parse::<u32>)) else { return false };
    // Of a process of this machine, as long as that runs, it is known; of others the time decides.
    let procs = Path::new("/proc/self").exists();
    if of == machine() && procs {
        return process != std::process::id() && !Path::new(&format!("/proc/{process}")).exists();
    }
    let written = std::fs::symlink_metadata(path).and_then(|m| m.modified());
    written.is_ok_and(|at| at.elapsed().is_ok_and(|age| age > LEFT_OVER))
}

/// Removes what dead processes left half-written in a folder and in those that its list names.
pub(super) fn remove_leftovers(folder: &Path) {
    for folder in list::folders(folder) {
        for path in std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()) {
            if is_left_over(&path) {
                remove(&path);
            }
        }
    }
}

/// The same for the folder of a file whose folder is not owned: once for each process.
pub(super) fn remove_leftovers_once(file: &Path) {
    let folder = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if LOOKED.lock().unwrap_or_else(|e| e.into_inner()).insert(folder.to_owned()) {
        remove_leftovers(folder);
    }
}

/// Removes a temporary file, or a folder of them.
pub(super) fn remove(path: &Path) {
    if !std::fs::symlink_metadata(path).is_ok_and(|m| m.is_dir()) {
        let _ = std::fs::remove_file(path);
        return;
    }
    // A program that outlives its command may be about to create a file in the folder, and then the folder stays. Under
    // another name it is not found; a file that was created at the same moment goes in the second attempt.
    let aside = path.with_file_name(temporary_name(OsStr::new("gone")));
    let gone = if std::fs::rename(path, &aside).is_ok() { &aside } else { path };
    let _ = std::fs::remove_dir_all(gone).or_else(|_| std::fs::remove_dir_all(gone));
}

/// Whether this is a name that [`Staged`] makes up.
pub(super) fn is_temporary(name: &OsStr) -> bool {
    name.as_encoded_bytes().ends_with(ENDING.as_bytes())
}

/// Distinguishes processes of this machine, as long as it runs, from those of others: Linux' boot id and space of process numbers.
pub(super) fn machine() -> String {
    const OFFSET: u64 = 0xcbf2_9ce4_8422_2325;
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    let space = std::fs::read_link("/proc/self/ns/pid").unwrap_or_default();
    let text = format!("{boot}{}", space.display());
    let print = text.bytes().fold(OFFSET, |h, b| (h ^ u64::from(b)).wrapping_mul(PRIME));
    format!("{:08x}", print >> 32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_goes_while_another_program_writes_into_it() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join(temporary_name(OsStr::new("film")));
        std::fs::create_dir(&folder).unwrap();
        let (begun, writes) = std::sync::mpsc::channel();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let create = |n: usize| std::fs::File::create(folder.join(n.to_string())).is_ok();
                (0..).take_while(|n| create(*n)).all(|n| begun.send(n).is_ok())
            });
            // Its first files are there.
            assert_eq!(writes.recv(), Ok(0));
            remove(&folder);
        });
        assert_eq!(std::fs::read_dir(place.path()).unwrap().count(), 0);
    }
}
