//! The local web server of splat4d, and the browser's player that it carries.
//!
//! It serves one scene, a `.s4d` file or bytes in memory, to its own page: fixed routes, no folder, so nothing else can
//! be reached. It binds loopback by default. Every page in the user's browser can reach loopback too, so it also checks
//! `Host` (a foreign name that resolves to this machine) and `Origin` (a foreign page). During training it costs one
//! thread with bounds on everything that a client can make it hold.
//!
//! | route | what |
//! |---|---|
//! | `/` | the page |
//! | `/player/NAME` (also `/NAME`) | modules, shaders |
//! | `/scene.s4d` | the scene, by range; `?v=N` names a live version: another one is 410, never a mixture |
//! | `/config.json` | what the page shows: `{title, scene, live, …}` of [`Config::about`] |
//! | `/events` | events of a live run as server-sent events; see [`News`] |
//! | `/metrics.json` | the events up to now, as one document |
//! | `/photo` | an image of the capture, by camera and time, only with [`Config::photos`] |
//! | `POST /control` | only with [`Config::control`]: pauses and stops a live run, by the rules of `/edit` |
//! | `POST /assist` | only with [`Config::assist`]: points clicked for an import, by the same rules; `/` is then the page of manual alignment |
//! | `POST /edit` | only with [`Config::editing`]: requests of a page with the token for a list of edits |
//!
//! ```no_run
//! # fn main() -> splat4d::Result<()> {
//! use splat4d_serve::{Config, Content, Server};
//! let config = Config { content: Content::File("scene.s4d".into()), ..Config::default() };
//! let running = Server::start(config)?;
//! assert!(running.url().starts_with("http://127.0.0.1:"));
//! running.stop();
//! # Ok(())
//! # }
//! ```
//!
//! # Code map
//!
//! A module imports only modules above it; `xtask/tests/tidy.rs` checks the order.
//!
//! | module | content |
//! |---|---|
//! | `photos.rs`, `given.rs` | images of the capture's cameras; what a program gives: scene, news, permissions, settings |
//! | `write_timeout.rs`, `body.rs`, `range.rs`, `reply.rs` | timeouts, request bodies, byte ranges, responses |
//! | `guard.rs` | who may send requests |
//! | `scene.rs` | the served scene: a file by range, or bytes that a live run replaces |
//! | `edit.rs` | the one guarded request that accepts input: edits, with a token |
//! | `assets.rs`, `page.rs` | the player's files; player and scene as one static page |
//! | `events.rs` | events of a live run: one bounded log |
//! | `answer.rs`, `server.rs` | routes and headers; start, stop, accept: one thread, bounded memory |
//! | `no_server.rs` | in place of the server without the feature `server` |
//! | `../player/` | the browser player: plain ES modules. A frame is rendered at the time of its order and active set: `schedule.js` requests them from `sort.worker.js` ahead of the clock by the measured latency and drops those of a clock that jumped; WebGPU culls and sorts within the frame. `stream.js` states which times are complete, of the rung of a bitrate ladder that `ladder.js` chooses; the others hold the last frame. In a headset, `fovea.js` states what the edges of the view leave out |

#![cfg_attr(docsrs, feature(doc_cfg))] // docs.rs marks what needs a feature
#![cfg_attr(not(feature = "server"), allow(dead_code))] // without the server nothing asks for the page's files

#[cfg(feature = "server")]
mod answer;
mod assets;
#[cfg(feature = "server")]
mod body;
#[cfg(feature = "server")]
mod edit;
#[cfg(feature = "server")]
mod events;
mod given;
#[cfg(feature = "server")]
mod guard;
#[cfg(not(feature = "server"))]
mod no_server;
mod page;
mod photos;
#[cfg(feature = "server")]
mod range;
#[cfg(feature = "server")]
mod reply;
#[cfg(feature = "server")]
mod scene;
#[cfg(feature = "server")]
mod server;
#[cfg(feature = "server")]
mod write_timeout;

pub use assets::{Asset, asset, assets};
pub use given::{Config, Content, DEFAULT_PORT, EditResponse, Editing, News};
#[cfg(not(feature = "server"))]
pub use no_server::{Running, Server};
pub use page::{Page, SceneIn};
pub use photos::{Photo, PhotoQuery, Photos};
#[cfg(feature = "server")]
pub use server::{Running, Server};

#[cfg(all(test, feature = "server"))]
mod tests;
