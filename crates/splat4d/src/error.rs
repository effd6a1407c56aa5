//! One error type: what happened, where, and what to do about it.

use std::fmt;

/// Result with this crate's [`Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Class of an [`Error`]; shells map it to an exit code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorKind {
    /// The user's data or options are wrong (exit code 2).
    BadInput,
    /// A file could not be read (exit code 2 where it is not there or not what it should be, else 1), or written (exit
    /// code 1).
    Io,
    /// A valid file that this version cannot handle (exit code 2).
    Unsupported,
    /// The work would need, or needed, more memory than allowed (exit code 1).
    Memory,
    /// Training diverged and could not be rolled back (exit code 1).
    Diverged,
    /// The user requested a stop; finished work is saved (exit code 1).
    Interrupted,
}

/// An error: its cause, its place (file, frame, camera, byte) and the remedy.
#[derive(Debug)]
pub struct Error {
    kind: ErrorKind,
    what: String,
    place: String,
    remedy: String,
    source: Option<Box<dyn std::error::Error + Send + Sync>>,
    /// Whether the machine is at fault, whatever the user gave.
    environment: bool,
}

impl Error {
    /// An error of `kind`; `what` is a clause without a final full stop.
    pub fn new(kind: ErrorKind, what: impl Into<String>) -> Self {
        Self { kind, what: what.into(), place: String::new(), remedy: String::new(), source: None, environment: false }
    }

    /// Bad user data.
    pub fn input(what: impl Into<String>) -> Self {
        Self::new(ErrorKind::BadInput, what)
    }

    /// A failed read of what the user named.
    pub fn io(what: impl Into<String>, source: std::io::Error) -> Self {
        Self { source: Some(Box::new(source)), ..Self::new(ErrorKind::Io, what) }
    }

    /// A failed write, or a program that cannot be started: no space, no rights, a folder that is not there.
    pub fn environment(what: impl Into<String>, source: std::io::Error) -> Self {
        Self { environment: true, ..Self::io(what, source) }
    }

    /// Names the place. Called again further out, the outer place is put in front.
    #[must_use]
    pub fn at(mut self, place: impl fmt::Display) -> Self {
        self.place = if self.place.is_empty() { place.to_string() } else { format!("{place}: {}", self.place) };
        self
    }

    /// Adds a remedy; the first (innermost) one is kept.
    #[must_use]
    pub fn remedy(mut self, remedy: impl Into<String>) -> Self {
        if self.remedy.is_empty() {
            self.remedy = remedy.into();
        }
        self
    }

    /// The class of the error.
    pub fn kind(&self) -> ErrorKind {
        self.kind
    }

    /// Whether the user's data, files or options are at fault (exit code 2), and not the machine (exit code 1).
    pub fn is_users(&self) -> bool {
        use std::io::ErrorKind::{InvalidData, InvalidFilename, InvalidInput, IsADirectory, NotADirectory, NotFound};
        match self.kind {
            ErrorKind::BadInput | ErrorKind::Unsupported => true,
            ErrorKind::Io if !self.environment => {
                let source = self.source.as_ref().and_then(|s| s.downcast_ref::<std::io::Error>());
                let named = [NotFound, NotADirectory, IsADirectory, InvalidData, InvalidInput, InvalidFilename];
                source.is_some_and(|s| named.contains(&s.kind()))
            }
            _ => false,
        }
    }

    /// Place and cause without the remedy, for messages that state what was done about it.
    pub fn cause(&self) -> String {
        let place = if self.place.is_empty() { String::new() } else { format!("{}: ", self.place) };
        let source = self.source.as_ref().map_or_else(String::new, |source| format!(" ({source})"));
        format!("{place}{}{source}", self.what)
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.cause())?;
        if !self.remedy.is_empty() {
            write!(f, ". {}", self.remedy)?;
        }
        Ok(())
    }
}

impl std::error::Error for Error {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.source.as_ref().map(|s| s.as_ref() as _)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io;

    #[test]
    fn user_errors_and_machine_failures_are_distinguished() {
        let io = |kind: io::ErrorKind| Error::io("cannot be read", kind.into()).is_users();
        assert!(io(io::ErrorKind::NotFound) && io(io::ErrorKind::IsADirectory));
        assert!(!io(io::ErrorKind::PermissionDenied) && !io(io::ErrorKind::StorageFull) && !io(io::ErrorKind::Other));
        assert!(!Error::environment("cannot be written", io::ErrorKind::NotFound.into()).is_users());
        assert!(Error::input("x").is_users() && !Error::new(ErrorKind::Io, "is in use").is_users());
    }
}
