//! A folder and its copy on the storage: downloads what differs there, uploads what differs here.

use super::{Address, Store, check_name};
use crate::files::{cannot_read, cannot_write};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use splat4d::{Error, ErrorKind, Result};
use splat4d_train::output::{STATE, write_atomically};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};

/// Files that are downloaded at the same time.
const AT_ONCE: usize = 8;
/// Time between two reports of progress.
const REPORT: Duration = Duration::from_millis(100);
/// Ending of files that are being written.
const TEMPORARY: &str = ".splat4d-tmp";
/// File of a run with paths of its machine.
const INFO: &str = "run.json";
/// Keys in it whose values are paths.
const PATHS: [&str; 2] = ["capture", "capture_elsewhere"];

/// A file that is the same here and there.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Same {
    etag: String,
    size: u64,
    modified: SystemTime,
}

/// An object of the folder.
#[derive(Clone, Debug)]
pub(super) struct Remote {
    /// Its name in the folder.
    pub(super) name: String,
    etag: String,
}

/// A folder and its copy.
pub(super) struct Mirror<'a> {
    pub(super) store: &'a dyn Store,
    pub(super) address: &'a Address,
    folder: PathBuf,
    same: Mutex<BTreeMap<String, Same>>,
    /// Folders of this machine and their addresses.
    places: Vec<(PathBuf, String)>,
}

impl<'a> Mirror<'a> {
    pub(super) fn new(store: &'a dyn Store, address: &'a Address, folder: &Path) -> Self {
        let places = vec![(folder.to_owned(), address.to_string())];
        Self { store, address, folder: folder.to_owned(), same: Mutex::default(), places }
    }

    /// The same, with another folder whose paths are in its files.
    pub(super) fn with(mut self, folder: &Path, address: &Address) -> Self {
        self.places.push((folder.to_owned(), address.to_string()));
        self
    }

    /// Files that are known to be the same, from an earlier process. A damaged list is no list.
    pub(super) fn known(self, list: &Path) -> Self {
        if let Some(same) = std::fs::read(list).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok()) {
            *self.lock() = same;
        }
        self
    }

    /// Keeps that list.
    pub(super) fn keep(&self, list: &Path) -> Result<()> {
        write_atomically(list, &serde_json::to_vec(&*self.lock()).expect("a list is plain data"))
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, BTreeMap<String, Same>> {
        self.same.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Objects of the folder, without its state.
    ///
    /// Errors: those of the storage; a name that would lead out of the folder.
    pub(super) fn list(&self) -> Result<Vec<Remote>> {
        let mut out = Vec::new();
        for object in self.store.list(&self.address.key(""))? {
            let Some(name) = object.key.strip_prefix(&self.address.key("")) else { continue };
            // Consoles of storages mark empty folders so.
            if name.is_empty() || name.ends_with('/') && object.size == 0 {
                continue;
            }
            check_name(name).map_err(|what| {
                Error::input(format!("invalid object: {what}"))
                    .at(self.address)
                    .remedy("Remove or rename it: nothing of the folder was downloaded")
            })?;
            if !name.split('/').any(|part| part == STATE) {
                out.push(Remote { name: name.to_owned(), etag: object.etag });
            }
        }
        Ok(out)
    }

    /// Downloads those of some objects that differ. `report`: done, of all.
    ///
    /// Errors: those of the storage; a file cannot be written; `stop` is set.
    pub(super) fn fetch(
        &self,
        objects: &[Remote],
        wanted: &dyn Fn(&str) -> bool,
        stop: &AtomicBool,
        report: &mut dyn FnMut(usize, usize),
    ) -> Result<()> {
        let todo: Vec<&Remote> = objects.iter().filter(|o| wanted(&o.name) && !self.is_same(o)).collect();
        let (next, done, failed) = (AtomicUsize::new(0), AtomicUsize::new(0), Mutex::new(None));
        let work = || {
            while let Some(object) = todo.get(next.fetch_add(1, Ordering::Relaxed)) {
                let over = stop.load(Ordering::Relaxed)
                    || failed.lock().is_ok_and(|f: std::sync::MutexGuard<'_, Option<Error>>| f.is_some());
                if over {
                    return;
                }
                if let Err(error) = self.download(object) {
                    failed.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
                    return;
                }
                done.fetch_add(1, Ordering::Relaxed);
            }
        };
        report(0, todo.len());
        std::thread::scope(|scope| {
            let threads: Vec<_> = (0..AT_ONCE.min(todo.len())).map(|_| scope.spawn(work)).collect();
            while threads.iter().any(|t| !t.is_finished()) {
                report(done.load(Ordering::Relaxed), todo.len());
                std::thread::sleep(REPORT);
            }
        });
        if let Some(error) = failed.into_inner().unwrap_or_else(PoisonError::into_inner) {
            return Err(error);
        }
        if stop.load(Ordering::Relaxed) {
            return Err(Error::new(ErrorKind::Interrupted, "stopped during a download")
                .at(self.address)
                .remedy("Run the same command again to continue"));
        }
        Ok(())
    }

    /// Removes files here that were downloaded and are not there any more. Errors: they cannot be removed.
    pub(super) fn drop_others(&self, objects: &[Remote]) -> Result<()> {
        let there: BTreeSet<&str> = objects.iter().map(|o| o.name.as_str()).collect();
        let gone: Vec<String> = self.lock().keys().filter(|name| !there.contains(name.as_str())).cloned().collect();
        for name in gone {
            let path = self.folder.join(&name);
            match std::fs::remove_file(&path) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(cannot_write(&path, e)),
                _ => self.lock().remove(&name),
            };
        }
        Ok(())
    }

    fn download(&self, object: &Remote) -> Result<()> {
        let (path, key) = (self.folder.join(&object.name), self.address.key(&object.name));
        let etag = if is_info(&object.name) {
            let found = self.store.read(&key)?;
            found
                .map(|found| write_atomically(&path, &self.localised(&found.bytes)).map(|()| found.etag))
                .transpose()?
        } else {
            self.store.download(&key, &path)?
        };
        let etag = etag.ok_or_else(|| {
            Error::input(format!("{} was removed during the download", object.name))
                .at(self.address)
                .remedy("Run the same command again")
        })?;
        self.note(&object.name, etag)
    }

    /// Uploads files that differ, those that others wait for last, and removes checkpoints that were replaced.
    ///
    /// Errors: those of the storage; a file cannot be read.
    pub(super) fn push(&self, wanted: &dyn Fn(&str) -> bool) -> Result<()> {
        let mut names = Vec::new();
        files_of(&self.folder, "", &mut names)?;
        names.retain(|name| wanted(name));
        names.sort_by_key(|name| (rank(name), name.clone()));
        for name in &names {
            let path = self.folder.join(name);
            let before = self.lock().get(name).cloned();
            let Some((size, modified)) = stamp(&path) else { continue };
            if before.is_some_and(|same| (same.size, same.modified) == (size, modified)) {
                continue;
            }
            let etag =
                if is_info(name) { self.upload_info(name)? } else { self.store.upload(&self.address.key(name), &path) };
            match etag {
                Ok(etag) => {
                    self.lock().insert(name.clone(), Same { etag, size, modified });
                }
                // A checkpoint that was just replaced.
                Err(_) if !path.exists() => {}
                Err(error) => return Err(error),
            }
        }
        let gone = |name: &&String| name.contains("checkpoints/") && wanted(name) && !self.folder.join(name).exists();
        let gone: Vec<String> = self.lock().keys().filter(gone).cloned().collect();
        for name in gone {
            self.store.remove(&self.address.key(&name))?;
            self.lock().remove(&name);
        }
        Ok(())
    }

    /// Uploads `run.json` with addresses in place of paths.
    fn upload_info(&self, name: &str) -> Result<Result<String>> {
        let path = self.folder.join(name);
        let bytes = std::fs::read(&path).map_err(|e| cannot_read(&path, e))?;
        let published = self.folder.with_extension("publish");
        write_atomically(&published, &self.published(&bytes))?;
        let etag = self.store.upload(&self.address.key(name), &published);
        let _ = std::fs::remove_file(published);
        Ok(etag)
    }

    fn note(&self, name: &str, etag: String) -> Result<()> {
        let path = self.folder.join(name);
        let (size, modified) = stamp(&path).ok_or_else(|| cannot_write(&path, std::io::ErrorKind::NotFound.into()))?;
        self.lock().insert(name.to_owned(), Same { etag, size, modified });
        Ok(())
    }

    /// Whether the file here is the object.
    fn is_same(&self, object: &Remote) -> bool {
        let same = self.lock().get(&object.name).cloned();
        same.is_some_and(|s| {
            s.etag == object.etag && stamp(&self.folder.join(&object.name)) == Some((s.size, s.modified))
        })
    }

    /// A `run.json` with paths of this machine.
    fn localised(&self, bytes: &[u8]) -> Vec<u8> {
        self.with_paths(bytes, &|text| {
            self.places.iter().find_map(|(path, address)| moved(text, address, path.to_str()?))
        })
    }

    /// A `run.json` with addresses.
    fn published(&self, bytes: &[u8]) -> Vec<u8> {
        self.with_paths(bytes, &|text| {
            self.places.iter().find_map(|(path, address)| moved(text, path.to_str()?, address))
        })
    }

    fn with_paths(&self, bytes: &[u8], change: &dyn Fn(&str) -> Option<String>) -> Vec<u8> {
        let Ok(mut info) = serde_json::from_slice::<Value>(bytes) else { return bytes.to_vec() };
        for key in PATHS {
            let values = match info.get_mut(key) {
                Some(Value::Array(list)) => list.iter_mut().collect(),
                Some(value) => vec![value],
                None => continue,
            };
            for value in values {
                if let Some(text) = value.as_str().and_then(change) {
                    *value = text.into();
                }
            }
        }
        serde_json::to_string_pretty(&info).expect("plain data is JSON").into_bytes()
    }
}

/// A path below `from` as one below `to`.
fn moved(text: &str, from: &str, to: &str) -> Option<String> {
    let rest = text.strip_prefix(from)?;
    (rest.is_empty() || rest.starts_with('/')).then(|| format!("{to}{rest}"))
}

fn is_info(name: &str) -> bool {
    name == INFO || name.ends_with("/run.json")
}

/// Order of uploads: files that state that others are complete come last.
fn rank(name: &str) -> usize {
    match name.rsplit('/').next().unwrap_or_default() {
        "scene.safetensors" | "still.safetensors" | "plan.json" => 3,
        "capture.json" => 2,
        _ if name.contains("checkpoints/") => 1,
        _ => 0,
    }
}

/// Length of a file, and when it was written.
fn stamp(path: &Path) -> Option<(u64, SystemTime)> {
    let meta = std::fs::symlink_metadata(path).ok().filter(std::fs::Metadata::is_file)?;
    Some((meta.len(), meta.modified().ok()?))
}

/// Files below a folder, without links, states and files that are being written.
fn files_of(folder: &Path, below: &str, out: &mut Vec<String>) -> Result<()> {
    let entries = match std::fs::read_dir(folder.join(below)) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        entries => entries.map_err(|e| cannot_read(&folder.join(below), e))?,
    };
    for entry in entries {
        let entry = entry.map_err(|e| cannot_read(&folder.join(below), e))?;
        let Ok(name) = entry.file_name().into_string() else { continue };
        let whole = if below.is_empty() { name.clone() } else { format!("{below}/{name}") };
        match entry.file_type() {
            Ok(kind) if kind.is_dir() && name != STATE => files_of(folder, &whole, out)?,
            Ok(kind) if kind.is_file() && !name.ends_with(TEMPORARY) => out.push(whole),
            _ => {}
        }
    }
    Ok(())
}
