//! Errors as exceptions: one class, the same text, and the class of error as `kind`.

use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;
use splat4d::ErrorKind;

create_exception!(
    splat4d,
    Error,
    PyException,
    "What went wrong, where, and what to do. `kind`: bad_input, io, unsupported, memory, diverged, interrupted or failed."
);

/// Results of the libraries converted for Python.
pub(crate) trait OrRaise<T> {
    fn or_raise(self) -> PyResult<T>;
}

impl<T> OrRaise<T> for splat4d::Result<T> {
    fn or_raise(self) -> PyResult<T> {
        self.map_err(|e| exception(&e.to_string(), Some(e.kind())))
    }
}

impl<T> OrRaise<T> for anyhow::Result<T> {
    fn or_raise(self) -> PyResult<T> {
        self.map_err(|e| {
            let kind = e.downcast_ref::<splat4d::Error>().map(splat4d::Error::kind);
            exception(&splat4d_cli::error_text(&e), kind)
        })
    }
}

/// An exception for an invalid argument: what is wrong, and what to do.
pub(crate) fn bad_input(what: impl Into<String>, remedy: &str) -> PyErr {
    let error = splat4d::Error::input(what).remedy(remedy);
    exception(&error.to_string(), Some(error.kind()))
}

fn exception(text: &str, kind: Option<ErrorKind>) -> PyErr {
    let kind = match kind {
        Some(ErrorKind::BadInput) => "bad_input",
        Some(ErrorKind::Io) => "io",
        Some(ErrorKind::Unsupported) => "unsupported",
        Some(ErrorKind::Memory) => "memory",
        Some(ErrorKind::Diverged) => "diverged",
        Some(ErrorKind::Interrupted) => "interrupted",
        _ => "failed",
    };
    Python::attach(|py| {
        let error = Error::new_err(splat4d::text::shown(text).into_owned());
        // An exception of our own class takes attributes.
        let _ = error.value(py).setattr("kind", kind);
        error
    })
}

/// Emits these as Python warnings.
pub(crate) fn warn(py: Python<'_>, messages: &[String]) -> PyResult<()> {
    let category = py.get_type::<pyo3::exceptions::PyUserWarning>();
    messages.iter().try_for_each(|message| {
        let text = std::ffi::CString::new(&*splat4d::text::in_line(message)).expect("zeros are spelt out");
        PyErr::warn(py, &category, &text, 1)
    })
}

/// Words of the command in remedies, and their equivalents in Python.
const WORDS: [(&str, &str); 5] = [
    ("`train --resume`", "splat4d.resume"),
    (RESUME, "splat4d.resume"),
    ("--force", "force=True"),
    ("with -o", "as `out`"),
    ("--motion ", "motion="),
];

/// The error of training as an exception in terms of Python's arguments.
pub(crate) fn in_python(error: &splat4d::Error) -> PyErr {
    exception(&python_words(&error.to_string()), Some(error.kind()))
}

/// The option that continues a run.
const RESUME: &str = "--resume";

fn python_words(text: &str) -> String {
    WORDS.iter().fold(resume_calls(text), |text, (word, other)| text.replace(word, other))
}

/// `--resume RUN` and `splat4d train --resume RUN` as calls: `splat4d.resume("RUN")`.
fn resume_calls(text: &str) -> String {
    let Some((before, after)) = text.split_once(&format!("{RESUME} ")) else { return text.to_owned() };
    let (run, rest) = match after.strip_prefix('\'') {
        // As a shell needs it: in quotes.
        Some(quoted) => quoted.split_once('\'').unwrap_or((quoted, "")),
        None => {
            let word = after.find(char::is_whitespace).map_or(after, |end| &after[..end]);
            let run = word.trim_end_matches(['.', ',', ';', ':', '`']);
            (run, &after[run.len()..])
        }
    };
    let before = before.trim_end_matches("train ").trim_end_matches("splat4d ");
    if run.is_empty() {
        return text.to_owned();
    }
    format!("{before}splat4d.resume({run:?}){}", resume_calls(rest))
}
