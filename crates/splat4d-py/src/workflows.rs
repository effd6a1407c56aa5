//! Workflows called from Python: their warnings become Python's, and Ctrl-C raises their stop flag.

use crate::errors::{OrRaise, warn};
use pyo3::prelude::*;
use serde_json::Value;
use splat4d::Result;
use splat4d_workflow::events::{Event, Listener};
use std::cell::RefCell;
use std::sync::atomic::{AtomicBool, Ordering};

/// Runs a workflow without the interpreter lock; its result and the records that it reported.
pub(crate) fn run<T: Send>(
    py: Python<'_>,
    work: impl FnOnce(&dyn Listener, &AtomicBool) -> Result<T> + Send,
) -> PyResult<(T, Vec<Value>)> {
    let (done, warnings, records, raised) = py.detach(|| {
        let stop = AtomicBool::new(false);
        let (warnings, records, raised) = (RefCell::new(Vec::new()), RefCell::new(Vec::new()), RefCell::new(None));
        let listen = |event: &Event<'_>| {
            match event {
                Event::Warning(text) => warnings.borrow_mut().push((*text).to_owned()),
                Event::Record(value) => records.borrow_mut().push((*value).clone()),
                _ => {}
            }
            if let Err(error) = Python::attach(|py| py.check_signals()) {
                stop.store(true, Ordering::SeqCst);
                raised.borrow_mut().get_or_insert(error);
            }
        };
        let done = work(&listen, &stop);
        (done, warnings.into_inner(), records.into_inner(), raised.into_inner())
    });
    warn(py, &warnings)?;
    match raised {
        Some(error) => Err(error),
        None => Ok((done.or_raise()?, records)),
    }
}
