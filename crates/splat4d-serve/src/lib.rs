//! The local web server of splat4d, and the browser's player that it carries.
//!
//! It serves one named thing, a `.s4d` file or bytes in memory, to a page of its own: fixed routes, no folder, so
//! that nothing else can be reached. It binds loopback unless told, and because every page in the user's browser can
//! reach loopback too, it also checks `Host` (a foreign name that resolves to this machine) and `Origin` (a foreign
//! page). While a run trains it costs one quiet thread with bounds on everything a client can make it hold.
//!
//! | route | what |
//! |---|---|
//! | `/` | the page |
//! | `/player/NAME` (also `/NAME`) | modules, shaders |
//! | `/scene.s4d` | the scene, by range; `?v=N` names a live version: another one is 410, never a mixture |
//! | `/config.json` | what the page shows: `{title, scene, live, …}` of [`Config::about`] |
//! | `/events` | news of a live run as server-sent events; see [`News`] |
//! | `/metrics.json` | the same news so far, in one piece |
//! | `POST /edit` | only with [`Config::editing`]: what a page with the token wants of a list of edits |
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

mod answer;
mod assets;
mod body;
mod edit;
mod events;
mod guard;
mod page;
mod range;
mod reply;
mod scene;
mod server;
mod write_timeout;

pub use assets::{Asset, asset, assets};
pub use edit::{EditAnswer, Editing};
pub use events::News;
pub use page::{Page, SceneIn};
pub use scene::Content;
pub use server::{Config, DEFAULT_PORT, Running, Server};

#[cfg(test)]
mod tests;
