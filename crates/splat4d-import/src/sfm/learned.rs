//! What matches images whose features do not match: a network that the user brings.

use super::CameraFrame;
use crate::Result;
use splat4d_train::capture::Rgb8;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

/// Positions in the first and the second of two images that show one point, pixels (the first pixel's centre is 0.5).
pub type Matches = Vec<[[f64; 2]; 2]>;

/// Matches two images.
pub trait Matcher: Send + Sync {
    /// Distinguishes it from others.
    fn identity(&self) -> &str;

    /// What they share. Errors: the matcher cannot process them.
    fn matches(&self, images: [&Rgb8; 2]) -> Result<Matches>;
}

impl std::fmt::Debug for dyn Matcher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Matcher").field(&self.identity()).finish()
    }
}

/// A matcher, and what it found.
pub struct Learned {
    matcher: Arc<dyn Matcher>,
    found: Mutex<BTreeMap<[CameraFrame; 2], Matches>>,
}

impl Learned {
    pub(crate) fn new(matcher: Arc<dyn Matcher>) -> Self {
        Self { matcher, found: Mutex::default() }
    }

    /// Distinguishes the matcher from others.
    pub(crate) fn identity(&self) -> &str {
        self.matcher.identity()
    }

    /// The matches of two views, computed once. Errors: as of [`Matcher::matches`].
    pub(super) fn of(&self, views: [CameraFrame; 2], images: [&Rgb8; 2]) -> Result<Matches> {
        let found = || self.found.lock().expect("nothing panics while it is held");
        if let Some(matches) = found().get(&views) {
            return Ok(matches.clone());
        }
        let matches = self.matcher.matches(images)?;
        found().insert(views, matches.clone());
        Ok(matches)
    }
}
