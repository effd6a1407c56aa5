//! What a program gives to the server: the scene, news, images, permissions, settings. None of it needs a network, so
//! that callers build without the feature `server` too.

use crate::photos::Photos;
use serde_json::Value;
use splat4d::Result;
use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

/// The default port.
pub const DEFAULT_PORT: u16 = 4440;
/// Queries that are worked on at a time: a slow one, and one that only reads.
#[cfg(feature = "server")]
const AT_ONCE: usize = 2;
/// Least length of a token: shorter ones could be guessed.
const LEAST_TOKEN: usize = 16;

/// Scene that the server shows.
#[derive(Clone, Debug, Default)]
#[non_exhaustive]
pub enum Content {
    /// No scene yet: a live run before its first snapshot, or a page that shows a scene from elsewhere.
    #[default]
    Nothing,
    /// A `.s4d` file, read by range and never as a whole. It is opened once: a file that takes its place later is
    /// not mixed into it.
    File(PathBuf),
    /// The bytes of one.
    Bytes(Arc<[u8]>),
}

/// An event. On the wire: the object's fields and `kind`.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum News {
    /// `kind: "step"`: training continued: `iteration`, `iterations`, `loss`, `psnr`, `gaussians`, `seconds`,
    /// `seconds_left`, `stage`.
    Step(Value),
    /// `kind: "note"`: an event to be sent: `message`.
    Note(Value),
    /// `kind: "control"`: the run was paused, continued or stopped: `state`.
    Control(Value),
    /// `kind: "done"`: the run is over; the server continues serving.
    Done(Value),
}

/// A program's response to a page that edits.
#[derive(Clone, Debug, Default)]
pub struct EditResponse {
    /// Sent to the page.
    pub result: Value,
    /// The scene from now on, a `.s4d`; `result` gets its number as `version`.
    pub scene: Option<Arc<[u8]>>,
}

/// Does what a page requests.
type Handler = dyn Fn(Value) -> Result<EditResponse> + Send + Sync;

/// Permission for pages with a token to request edits from a program.
#[derive(Clone)]
pub struct Editing {
    pub(crate) token: String,
    pub(crate) answer: Arc<Handler>,
    #[cfg(feature = "server")]
    pub(crate) places: Arc<tokio::sync::Semaphore>,
}

impl fmt::Debug for Editing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Editing")
    }
}

impl Editing {
    /// `answer` is called on a thread of its own, on two at a time. Panics: a token that could be guessed.
    pub fn new(token: String, answer: impl Fn(Value) -> Result<EditResponse> + Send + Sync + 'static) -> Self {
        assert!(token.len() >= LEAST_TOKEN && token.bytes().all(|b| b.is_ascii_alphanumeric()), "a token is random");
        Self {
            token,
            answer: Arc::new(answer),
            #[cfg(feature = "server")]
            places: Arc::new(tokio::sync::Semaphore::new(AT_ONCE)),
        }
    }
}

/// Settings of the server: what to serve, and where.
#[derive(Clone, Debug)]
pub struct Config {
    /// A name or address of this machine to listen on. Anything but loopback lets others in.
    pub host: String,
    /// The port; 0 means any free one; None means [`DEFAULT_PORT`] or, where it is taken, a free one after it.
    pub port: Option<u16>,
    /// The scene.
    pub content: Content,
    /// Instead of `content`: the page shows the scene at this http(s) address, whose server must allow it (CORS).
    pub foreign: Option<String>,
    /// An object that `/config.json` passes on to the page, such as `{"title": "knight"}`.
    pub about: Value,
    /// Whether news will be published: the page then listens.
    pub live: bool,
    /// Permission for pages to edit; none: nothing can be sent.
    pub editing: Option<Editing>,
    /// Permission for pages to pause and stop a live run, by the same rules.
    pub control: Option<Editing>,
    /// Permission for the page of manual alignment to send points, by the same rules; `/` is then that page.
    pub assist: Option<Editing>,
    /// Images of the capture's cameras.
    pub photos: Option<Photos>,
    /// Whether to step back for other work of this machine (Linux only).
    pub background: bool,
    /// Reads the player from this folder, at every request, instead of the embedded one, for its development.
    pub player_folder: Option<PathBuf>,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            host: "127.0.0.1".into(),
            port: None,
            content: Content::Nothing,
            foreign: None,
            about: Value::Null,
            live: false,
            editing: None,
            control: None,
            assist: None,
            photos: None,
            background: false,
            player_folder: None,
        }
    }
}
