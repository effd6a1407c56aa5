//! Captures and runs on object storage (`s3://BUCKET/FOLDER`), for workers without a shared folder.
//!
//! A worker has a folder of its own. It downloads what a part of the work needs, works on it as on any folder, and
//! uploads what is finished, in an order in which a file that others wait for comes last. The objects of a run have the
//! names of its files. A part is claimed by an object that is created only if it is absent (`claim.rs`).

mod claim;
mod mirror;
mod needed;
#[cfg(feature = "storage")]
mod s3;
#[cfg(test)]
mod tests;
mod work;

#[cfg(feature = "storage")]
pub use s3::Access;
pub use work::{info, join, status, train};

use crate::files::fingerprint;
use splat4d::{Error, Result};
use splat4d_train::output::Owner;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Beginning of addresses.
const SCHEME: &str = "s3://";
/// Most bytes of a key (S3).
const KEY_BYTES: usize = 1024;
/// Workers on one machine that have a folder of their own each.
const SLOTS: usize = 64;
/// Name of this work in a folder's owner record.
const COMMAND: &str = "train --chunk";

/// A folder of a bucket.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Address {
    bucket: String,
    /// Without a slash at its ends.
    folder: String,
}

impl Address {
    /// Whether a path is an address.
    pub fn is(path: &Path) -> bool {
        path.to_str().is_some_and(|text| text.starts_with(SCHEME))
    }

    /// The address that a path is; `None`: it is a path. Errors: it names no folder of a bucket.
    pub fn of(path: &Path) -> Result<Option<Self>> {
        let Some(rest) = path.to_str().and_then(|text| text.strip_prefix(SCHEME)) else { return Ok(None) };
        let bad = |what: &str| {
            Error::input(format!("invalid address: {what}"))
                .at(path.display())
                .remedy("Write s3://BUCKET/FOLDER, for instance s3://my-bucket/concert")
        };
        let (bucket, folder) = rest.split_once('/').unwrap_or((rest, ""));
        let folder = folder.trim_end_matches('/');
        if bucket.is_empty() || !bucket.chars().all(|c| c.is_ascii_alphanumeric() || "-._".contains(c)) {
            return Err(bad("expected the name of a bucket after s3://"));
        }
        if folder.is_empty() {
            return Err(bad("expected a folder of the bucket"));
        }
        check_name(folder).map_err(|what| bad(&what))?;
        Ok(Some(Self { bucket: bucket.into(), folder: folder.into() }))
    }

    /// The key of a file of the folder.
    fn key(&self, name: &str) -> String {
        format!("{}/{name}", self.folder)
    }

    /// Whether one folder is the other or in it.
    fn overlaps(&self, other: &Self) -> bool {
        let (a, b) = (self.key(""), other.key(""));
        self.bucket == other.bucket && (a.starts_with(&b) || b.starts_with(&a))
    }

    /// The folder's own name.
    fn name(&self) -> &str {
        self.folder.rsplit('/').next().expect("a split has a part")
    }
}

impl std::fmt::Display for Address {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{SCHEME}{}/{}", self.bucket, self.folder)
    }
}

/// Errors: a name that, joined to a folder, is not a file below it on every system.
fn check_name(name: &str) -> std::result::Result<(), String> {
    let odd = |part: &str| part.is_empty() || part == "." || part == "..";
    let acts = |c: char| c.is_control() || c == '\\' || (cfg!(windows) && c == ':');
    if name.len() > KEY_BYTES || name.split('/').any(odd) || name.contains(acts) {
        return Err(format!("\"{name:.200}\" is not the name of a file in a folder"));
    }
    Ok(())
}

/// An object of a listing.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Object {
    key: String,
    size: u64,
    etag: String,
}

/// A small object that was read.
#[derive(Clone, Debug)]
struct Content {
    bytes: Vec<u8>,
    etag: String,
    /// Since it was written, by the clock of the storage; `None`: the storage does not report it.
    age: Option<Duration>,
}

/// Condition of a write.
#[derive(Clone, Copy, Debug)]
enum Condition<'a> {
    /// There is no such object.
    Absent,
    /// The object has this etag.
    Is(&'a str),
}

/// Objects of one bucket. Errors of all: no access; the storage does not answer after several attempts.
trait Store: Send + Sync {
    /// All objects whose keys begin so, sorted.
    fn list(&self, prefix: &str) -> Result<Vec<Object>>;
    /// A small object; `None`: it is absent.
    fn read(&self, key: &str) -> Result<Option<Content>>;
    /// Writes a small object, and returns its etag; `None`: the condition is not met.
    fn write(&self, key: &str, bytes: &[u8], condition: Condition<'_>) -> Result<Option<String>>;
    /// Downloads an object into a file, and returns its etag; `None`: it is absent.
    fn download(&self, key: &str, to: &Path) -> Result<Option<String>>;
    /// Uploads a file, and returns the object's etag.
    fn upload(&self, key: &str, from: &Path) -> Result<String>;
    /// Removes an object, if it is there.
    fn remove(&self, key: &str) -> Result<()>;
}

/// Makes the store of a bucket.
type Connect = Box<dyn Fn(&str) -> Result<Box<dyn Store>>>;

/// Object storage, and the folder for local copies.
pub struct Storage {
    local: PathBuf,
    /// Distinguishes storages in the local folder.
    name: String,
    connect: Connect,
}

impl Storage {
    /// S3 or a storage with its interface. `local`: the folder for local copies.
    #[cfg(feature = "storage")]
    pub fn s3(local: PathBuf, access: Access) -> Self {
        let name = access.endpoint.clone().unwrap_or_default();
        Self { local, name, connect: Box::new(move |bucket| Ok(Box::new(s3::Bucket::new(bucket, &access)?))) }
    }

    fn store(&self, address: &Address) -> Result<Box<dyn Store>> {
        (self.connect)(&address.bucket)
    }

    /// Takes a folder for the files of an address, until it is dropped. Errors: it cannot be written.
    fn place(&self, address: &Address) -> Result<Place> {
        let of = fingerprint(format!("{} {address}", self.name));
        for slot in 0..SLOTS {
            let folder = self.local.join(format!("{of}-{slot}"));
            crate::files::make_folder(&folder)?;
            let owner = match Owner::of(&folder, COMMAND) {
                Ok(owner) => owner,
                // Another worker on this machine.
                Err(_) if Owner::holder(&folder).is_some() => continue,
                Err(error) => return Err(error),
            };
            // As paths in the files of a run are written.
            let folder = std::fs::canonicalize(&folder).unwrap_or(folder);
            return Ok(Place { files: folder.join(address.name()), folder, owner });
        }
        Err(Error::input(format!("{SLOTS} workers use it"))
            .at(self.local.display())
            .remedy("Give another folder with --local"))
    }
}

/// A folder for the files of an address.
struct Place {
    folder: PathBuf,
    /// The files, in a folder of the address' name.
    files: PathBuf,
    owner: Owner,
}

impl Place {
    /// Removes the files: the storage has them.
    fn clear(&self) -> Result<()> {
        match std::fs::remove_dir_all(&self.files) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(crate::files::cannot_write(&self.files, e)),
            _ => Ok(()),
        }
    }

    /// This process, as its owner record has it.
    fn who(&self) -> String {
        let _ = &self.owner;
        let record = Owner::holder(&self.folder).flatten();
        record.map_or_else(|| format!("process {}", std::process::id()), |who| who.to_string())
    }
}
