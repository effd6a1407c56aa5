//! Claims of parts: an object per part that names its worker, who writes it again every few seconds.
//!
//! The rules are those of the lock files of a shared folder: a worker without a heartbeat for 60 s is considered dead, and
//! the next one takes over. Every write has a condition (absent, or unchanged since it was read), so that of two
//! workers one gets the claim. Ages are by the clock of the storage.

use super::{Condition, Store};
use serde::{Deserialize, Serialize};
use splat4d::{Error, Result};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// Time between two heartbeats.
pub(super) const BEAT: Duration = Duration::from_secs(5);
/// A worker without a heartbeat for so long is considered dead.
pub(super) const DEAD: Duration = Duration::from_secs(60);
/// Attempts while workers begin and end at the same time.
const ATTEMPTS: usize = 4;

/// Content of a claim.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Record {
    /// Distinguishes workers.
    id: String,
    /// The worker, for people.
    pub(super) worker: String,
    beat: u64,
}

impl Record {
    pub(super) fn new(worker: String) -> Self {
        let mut bytes = [0u8; 16];
        // Without randomness of the system: the process and the time.
        if getrandom::fill(&mut bytes).is_err() {
            let now = std::time::SystemTime::UNIX_EPOCH.elapsed().map_or(0, |t| t.as_nanos());
            bytes = (now ^ u128::from(std::process::id()) << 96).to_le_bytes();
        }
        Self { id: bytes.iter().map(|b| format!("{b:02x}")).collect(), worker, beat: 0 }
    }

    fn bytes(&self) -> Vec<u8> {
        serde_json::to_vec(self).expect("a record is plain data")
    }

    /// A claim that cannot be read is that of an unknown worker.
    pub(super) fn read(bytes: &[u8]) -> Self {
        let unknown = Self { id: String::new(), worker: "an unknown worker".into(), beat: 0 };
        serde_json::from_slice(bytes).unwrap_or(unknown)
    }
}

/// The right to work on a part, while its heart beats.
pub(super) struct Claim<'a> {
    store: &'a dyn Store,
    key: String,
    /// What was written last, and its etag.
    state: Mutex<(Record, String)>,
}

impl<'a> Claim<'a> {
    /// Claims a part; the inner error is the worker who has it.
    ///
    /// Errors: those of the storage; it ignores conditions.
    pub(super) fn take(store: &'a dyn Store, key: &str, record: &Record) -> Result<std::result::Result<Self, Record>> {
        let bytes = record.bytes();
        let mut other: Option<(Record, String)> = None;
        for _ in 0..ATTEMPTS {
            let written = match other.as_ref() {
                None => store.write(key, &bytes, Condition::Absent)?,
                Some((_, etag)) => store.write(key, &bytes, Condition::Is(etag))?,
            };
            if let Some(etag) = written {
                let claim = Self { store, key: key.into(), state: Mutex::new((record.clone(), etag)) };
                claim.check_conditions(&bytes)?;
                return Ok(Ok(claim));
            }
            let Some(found) = store.read(key)? else {
                other = None;
                continue;
            };
            let there = Record::read(&found.bytes);
            if there.id == record.id {
                // The answer to an earlier attempt was lost on the way.
                return Ok(Ok(Self { store, key: key.into(), state: Mutex::new((there, found.etag)) }));
            }
            if found.age.is_none_or(|age| age <= DEAD) {
                return Ok(Err(there));
            }
            other = Some((there, found.etag));
        }
        Ok(Err(other.map_or_else(|| Record::read(b""), |(there, _)| there)))
    }

    /// Errors: the storage accepts writes whose condition is not met: claims would have several owners.
    fn check_conditions(&self, bytes: &[u8]) -> Result<()> {
        let ignored = self.store.write(&self.key, bytes, Condition::Absent)?.is_some()
            || self.store.write(&self.key, bytes, Condition::Is("\"0\""))?.is_some();
        if !ignored {
            return Ok(());
        }
        let _ = self.store.remove(&self.key);
        Err(Error::input("the storage ignores the conditions If-None-Match and If-Match of a write")
            .at(&self.key)
            .remedy(
                "Use a storage with conditional writes (Amazon S3, MinIO, Cloudflare R2, Ceph 19), or a shared folder",
            ))
    }

    /// Renews the claim; `false`: another worker has taken it over. Errors: the storage does not answer.
    pub(super) fn beat(&self) -> Result<bool> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let next = Record { beat: state.0.beat + 1, ..state.0.clone() };
        if let Some(etag) = self.store.write(&self.key, &next.bytes(), Condition::Is(&state.1))? {
            *state = (next, etag);
            return Ok(true);
        }
        // The answer to an earlier attempt may have been lost on the way.
        let found = self.store.read(&self.key)?;
        let own = found.map(|f| (Record::read(&f.bytes), f.etag)).filter(|(there, _)| there.id == next.id);
        Ok(own.map(|own| *state = own).is_some())
    }

    /// Gives it back, if it is still this worker's.
    pub(super) fn release(self) {
        if self.beat().unwrap_or(false) {
            let _ = self.store.remove(&self.key);
        }
    }

    /// The workers of claims that are alive, by the last part of their keys.
    pub(super) fn all(store: &dyn Store, folder: &str) -> Result<Vec<(String, String)>> {
        let mut out = Vec::new();
        for object in store.list(folder)? {
            let Some(found) = store.read(&object.key)? else { continue };
            if found.age.is_none_or(|age| age <= DEAD) {
                let part = object.key.rsplit('/').next().unwrap_or_default().to_owned();
                out.push((part, Record::read(&found.bytes).worker));
            }
        }
        Ok(out)
    }
}
