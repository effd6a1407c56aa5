//! The served scene: a file on disk, or bytes in memory that may be replaced.

use crate::body::Body;
use crate::given::Content;
use hyper::body::Bytes;
use splat4d::{Error, Result};
use std::fs::{File, Metadata};
use std::io;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::UNIX_EPOCH;

/// Bytes read and sent at a time: large enough that a disk and a socket run at full speed, and a thousand clients with
/// two chunks each stay a bounded matter.
const CHUNK: u64 = 128 << 10;
/// Live versions kept: the newest, and the one that a page may still be reading.
const VERSIONS: usize = 2;

/// One state of the scene. Cheap to clone.
#[derive(Clone, Debug)]
pub(crate) struct Version {
    /// 1, 2, 3 … as they were set.
    pub number: u64,
    pub length: u64,
    /// With quotes; strong.
    pub etag: String,
    source: Source,
}

#[derive(Clone, Debug)]
enum Source {
    File(Arc<File>),
    Bytes(Bytes),
}

/// The newest versions.
#[derive(Debug, Default)]
pub(crate) struct Scene {
    versions: Mutex<(u64, Vec<Version>)>,
}

/// Searched, not found.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Missing {
    /// There is no scene yet, or no such version was ever there.
    Never,
    /// It was replaced.
    Gone,
}

impl Scene {
    /// Errors: the file cannot be opened, or is no file.
    pub(crate) fn new(content: Content) -> Result<Self> {
        let scene = Self::default();
        match content {
            Content::Nothing => {}
            Content::Bytes(bytes) => {
                scene.set(bytes);
            }
            Content::File(path) => {
                let fail = |e| {
                    Error::io("cannot be read", e)
                        .at(path.display())
                        .remedy("Check that the file exists and may be read by you.")
                };
                // Before it is opened: that alone waits, where a pipe has no writer.
                if !std::fs::metadata(&path).map_err(fail)?.is_file() {
                    return Err(Error::input("is not a file").at(path.display()).remedy("Give a .s4d file."));
                }
                let file = File::open(&path).map_err(fail)?;
                let meta = file.metadata().map_err(fail)?;
                let etag = file_etag(&meta);
                scene.push(Source::File(Arc::new(file)), meta.len(), etag);
            }
        }
        Ok(scene)
    }

    /// Replaces the bytes; returns the new version's number.
    pub(crate) fn set(&self, bytes: Arc<[u8]>) -> u64 {
        // The process and the time are in the tag: a server started again counts from 1 again.
        let now = UNIX_EPOCH.elapsed().unwrap_or_default().as_nanos();
        let length = bytes.len() as u64;
        let etag = format!("\"m{now:x}-{length:x}\"");
        self.push(Source::Bytes(Bytes::from_owner(bytes)), length, etag)
    }

    fn push(&self, source: Source, length: u64, etag: String) -> u64 {
        let mut guard = self.versions.lock().unwrap_or_else(PoisonError::into_inner);
        let (count, versions) = &mut *guard;
        *count += 1;
        versions.push(Version { number: *count, length, etag, source });
        if versions.len() > VERSIONS {
            versions.remove(0);
        }
        *count
    }

    /// The newest version, or the one of that number.
    pub(crate) fn version(&self, number: Option<u64>) -> Result<Version, Missing> {
        let guard = self.versions.lock().unwrap_or_else(PoisonError::into_inner);
        let (count, versions) = &*guard;
        match number {
            None => versions.last().map(Version::grown).ok_or(Missing::Never),
            Some(n) => versions.iter().find(|v| v.number == n).cloned().ok_or(if n < *count {
                Missing::Gone
            } else {
                Missing::Never
            }),
        }
    }
}

/// A file's tag: another one after every write.
fn file_etag(meta: &Metadata) -> String {
    let changed = meta.modified().ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok()).unwrap_or_default();
    format!("\"f{:x}-{:x}\"", changed.as_nanos(), meta.len())
}

impl Version {
    /// The same, as long as its file has become: one of an unfinished take is appended to while it is played, and what
    /// was there stays as it was.
    fn grown(&self) -> Self {
        let Source::File(file) = &self.source else { return self.clone() };
        match file.metadata() {
            Ok(meta) if meta.len() > self.length => Self { length: meta.len(), etag: file_etag(&meta), ..self.clone() },
            _ => self.clone(),
        }
    }

    /// Bytes `start..end`. Must be called on the server's runtime.
    pub(crate) fn body(&self, start: u64, end: u64) -> Body {
        match &self.source {
            Source::Bytes(bytes) => {
                let [start, end] = [start, end].map(|i| usize::try_from(i).expect("it is in memory"));
                Body::Bytes(bytes.slice(start..end))
            }
            Source::File(file) => {
                let (sender, body) = Body::stream(Some(end - start));
                let file = file.clone();
                tokio::spawn(async move {
                    let mut at = start;
                    while at < end {
                        let (file, length) = (file.clone(), CHUNK.min(end - at) as usize);
                        let read = tokio::task::spawn_blocking(move || read_at(&file, at, length)).await;
                        let chunk = read.unwrap_or_else(|e| Err(io::Error::other(e)));
                        let failed = chunk.is_err();
                        // Waits while the client is slow; fails after it disconnects.
                        if sender.send(chunk).await.is_err() || failed {
                            return;
                        }
                        at += length as u64;
                    }
                });
                body
            }
        }
    }
}

/// Reads `length` bytes at a place, without a cursor that requests would share. Errors: the file was cut short.
fn read_at(file: &File, at: u64, length: usize) -> io::Result<Bytes> {
    let mut bytes = vec![0; length];
    let mut done = 0;
    while done < length {
        match read_some(file, at + done as u64, &mut bytes[done..]) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(n) => done += n,
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(bytes.into())
}

#[cfg(unix)]
fn read_some(file: &File, at: u64, bytes: &mut [u8]) -> io::Result<usize> {
    std::os::unix::fs::FileExt::read_at(file, bytes, at)
}

#[cfg(windows)]
fn read_some(file: &File, at: u64, bytes: &mut [u8]) -> io::Result<usize> {
    std::os::windows::fs::FileExt::seek_read(file, bytes, at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_two_versions_are_kept() {
        let scene = Scene::new(Content::Nothing).unwrap();
        assert_eq!(scene.version(None).unwrap_err(), Missing::Never);
        for n in 1..=3u64 {
            assert_eq!(scene.set(vec![n as u8; n as usize].into()), n);
        }
        assert_eq!(scene.version(None).unwrap().length, 3);
        assert_eq!(scene.version(Some(2)).unwrap().length, 2);
        assert_eq!(scene.version(Some(1)).unwrap_err(), Missing::Gone);
        assert_eq!(scene.version(Some(4)).unwrap_err(), Missing::Never);
        let tags = [2, 3].map(|n| scene.version(Some(n)).unwrap().etag);
        assert_ne!(tags[0], tags[1]);
    }

    #[test]
    fn a_missing_file_is_named_in_the_error() {
        let folder = tempfile::tempdir().unwrap();
        for path in [folder.path().to_owned(), folder.path().join("none.s4d")] {
            let error = Scene::new(Content::File(path.clone())).unwrap_err().to_string();
            assert!(error.contains(&path.display().to_string()), "{error}");
        }
    }

    #[test]
    fn the_length_of_a_growing_file_is_its_current_length() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("growing");
        std::fs::write(&path, [1, 2, 3]).unwrap();
        let scene = Scene::new(Content::File(path.clone())).unwrap();
        let before = scene.version(None).unwrap();
        io::Write::write_all(&mut File::options().append(true).open(&path).unwrap(), &[4, 5]).unwrap();
        let after = scene.version(None).unwrap();
        assert_eq!((before.length, after.length, after.number), (3, 5, before.number));
        assert_ne!(before.etag, after.etag);
    }

    #[test]
    fn a_file_that_was_cut_short_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("short");
        std::fs::write(&path, [1, 2, 3]).unwrap();
        let file = File::open(&path).unwrap();
        assert_eq!(&read_at(&file, 1, 2).unwrap()[..], [2, 3]);
        assert_eq!(read_at(&file, 1, 3).unwrap_err().kind(), io::ErrorKind::UnexpectedEof);
    }
}
