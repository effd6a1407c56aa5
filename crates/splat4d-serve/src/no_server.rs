//! In place of the server in a build without the feature `server`: it never starts.

use crate::given::{Config, News};
use serde_json::Value;
use splat4d::{Error, ErrorKind, Result};
use std::net::SocketAddr;
use std::sync::Arc;

/// Makes [`Running`] servers; in this build none.
#[derive(Debug)]
pub struct Server;

/// A server at work; this build has none.
#[derive(Debug)]
pub enum Running {}

impl Server {
    /// Error: always; the server is left out of this build.
    pub fn start(_config: Config) -> Result<Running> {
        Err(Error::new(ErrorKind::Unsupported, "the player's server is left out of this build")
            .remedy("Build splat4d with its feature `serve`, or write a page with `splat4d export --html`."))
    }
}

impl Running {
    /// The page's address.
    pub fn url(&self) -> &str {
        match *self {}
    }

    /// Listening address.
    pub fn address(&self) -> SocketAddr {
        match *self {}
    }

    /// Sends news to all pages.
    pub fn publish(&self, _news: &News) {
        match *self {}
    }

    /// Replaces the scene.
    pub fn set_scene(&self, _bytes: Arc<[u8]>, _about: &Value) -> u64 {
        match *self {}
    }

    /// Stops.
    pub fn stop(self) {
        match self {}
    }
}
