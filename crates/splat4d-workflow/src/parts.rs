//! Parts that a small build leaves out, by its cargo features.

use crate::{Error, ErrorKind};

/// The error of a request for a part that this build leaves out.
pub fn left_out(part: &str, feature: &str) -> Error {
    Error::new(ErrorKind::Unsupported, format!("{part} is left out of this build of splat4d")).remedy(format!(
        "Install splat4d with all its parts (`cargo install splat4d`), or build it with the feature `{feature}`."
    ))
}
