//! The only request with a body that a page may send: requests on a list of edits, if the program was started to edit.
//!
//! A page of any origin in the user's browser can send a form to loopback. This requires more than a form can send: a
//! token that only the address which the program printed holds, JSON (which needs a preflight request, and gets none),
//! and our own origin. The program decides what to do with it; it may return another scene.

use crate::body::Body;
use crate::given::{EditResponse, Editing};
use crate::reply::{text, whole};
use crate::scene::Scene;
use crate::write_timeout::{Either, either};
use hyper::body::{Bytes, Incoming};
use hyper::header;
use hyper::http::request::Parts;
use hyper::{Response, StatusCode};
use serde_json::{Value, json};
use splat4d::{Error, Result};
use std::future::poll_fn;
use std::pin::Pin;
use std::time::Duration;
use tokio::sync::oneshot;

/// Route of edits.
pub(crate) const ROUTE: &str = "/edit";
/// Route that pauses and stops a live run.
pub(crate) const CONTROL_ROUTE: &str = "/control";
/// Route of points that were clicked for an import.
pub(crate) const ASSIST_ROUTE: &str = "/assist";
/// The header that holds the token.
const TOKEN: &str = "x-splat4d-token";
/// Most bytes that a page may send: ten thousand steps of a hundred bytes.
const MAX_BODY: usize = 1 << 20;
/// A body must be complete in this time.
const BODY_TIME: Duration = Duration::from_secs(10);
impl Editing {
    /// Why a request may not edit. Host and origins that were sent are checked already.
    fn refuses(&self, request: &Parts) -> Option<(StatusCode, &'static str)> {
        let mut tokens = request.headers.get_all(TOKEN).iter();
        let token = tokens.next().filter(|_| tokens.next().is_none());
        if !token.is_some_and(|t| same(t.as_bytes(), self.token.as_bytes())) {
            return Some((
                StatusCode::FORBIDDEN,
                "the token is missing or wrong: open the address that splat4d printed",
            ));
        }
        let one = |name: &str| request.headers.get(name).and_then(|v| v.to_str().ok());
        if request.headers.get_all(header::ORIGIN).iter().count() != 1 {
            return Some((StatusCode::FORBIDDEN, "duplicate Origin header"));
        }
        if one("sec-fetch-site").is_some_and(|site| site != "same-origin") {
            return Some((StatusCode::FORBIDDEN, "only the player's own page may edit"));
        }
        let json =
            one("content-type").is_some_and(|t| t.split(';').next().is_some_and(|t| t.trim() == "application/json"));
        if !json {
            return Some((StatusCode::UNSUPPORTED_MEDIA_TYPE, "expected edits as application/json"));
        }
        let length = one("content-length").and_then(|l| l.parse::<usize>().ok());
        if length.is_some_and(|l| l > MAX_BODY) {
            return Some(TOO_LARGE);
        }
        None
    }
}

const TOO_LARGE: (StatusCode, &str) = (StatusCode::PAYLOAD_TOO_LARGE, "a list of edits has at most 1 MB");

/// Compares in a time that does not reveal where two texts differ.
fn same(a: &[u8], b: &[u8]) -> bool {
    a.len() == b.len() && a.iter().zip(b).fold(0, |sum, (a, b)| sum | (a ^ b)) == 0
}

/// Handles a page's request. Must be called on the server's runtime.
pub(crate) async fn answer(scene: &Scene, editing: &Editing, request: &Parts, body: Incoming) -> Response<Body> {
    if let Some((status, why)) = editing.refuses(request) {
        return text(status, why);
    }
    let asked = match either(tokio::time::sleep(BODY_TIME), read(body)).await {
        Either::First(()) => return text(StatusCode::REQUEST_TIMEOUT, "the edits did not arrive"),
        Either::Second(Err((status, why))) => return text(status, why),
        Either::Second(Ok(bytes)) => bytes,
    };
    let Ok(asked) = serde_json::from_slice::<Value>(&asked) else {
        return text(StatusCode::BAD_REQUEST, "invalid JSON");
    };
    let place = editing.places.clone().acquire_owned().await.expect("a bracket or string is not closed");
    let (sender, result) = oneshot::channel();
    let work = editing.answer.clone();
    let spawned = std::thread::Builder::new().name("splat4d-edit".into()).spawn(move || {
        let _place = place;
        // A disconnected page gets no response.
        let _ = sender.send(work(asked));
    });
    // A panic of the work ends its thread, and with it the channel.
    let done = if spawned.is_ok() { result.await.ok() } else { None };
    match done {
        None => text(StatusCode::INTERNAL_SERVER_ERROR, "the edit failed; the terminal of splat4d shows the reason"),
        Some(Err(error)) => refused(&error),
        Some(Ok(EditResponse { mut result, scene: fresh })) => {
            if let Some(bytes) = fresh {
                result["version"] = json!(scene.set(bytes));
            }
            whole(result.to_string().into(), "application/json")
        }
    }
}

/// The error as JSON.
fn refused(error: &Error) -> Response<Body> {
    let mut response = whole(json!({ "error": error.to_string() }).to_string().into(), "application/json");
    *response.status_mut() = StatusCode::UNPROCESSABLE_ENTITY;
    response
}

/// The whole body, within its bound.
async fn read(mut body: Incoming) -> Result<Bytes, (StatusCode, &'static str)> {
    let mut all = Vec::new();
    while let Some(frame) = poll_fn(|cx| http_body::Body::poll_frame(Pin::new(&mut body), cx)).await {
        let frame = frame.map_err(|_| (StatusCode::BAD_REQUEST, "the edits are truncated"))?;
        if let Ok(data) = frame.into_data() {
            if all.len() + data.len() > MAX_BODY {
                return Err(TOO_LARGE);
            }
            all.extend_from_slice(&data);
        }
    }
    Ok(all.into())
}
