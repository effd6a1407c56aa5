//! Responds to requests: fixed routes, with headers that restrict what a browser may do with the responses.

use crate::assets::{self, ASSIST, Asset, INDEX};
use crate::body::Body;
use crate::edit;
use crate::events::Hub;
use crate::given::Editing;
use crate::guard::Guard;
use crate::photos::{self, Photos};
use crate::range::{self, Requested};
use crate::reply::{text, value, whole, with};
use crate::scene::{Missing, Scene};
use hyper::body::{Bytes, Incoming};
use hyper::header::{self, HeaderMap, HeaderName, HeaderValue};
use hyper::http::request::Parts;
use hyper::{Method, Response, StatusCode};
use serde_json::{Value, json};
use std::path::PathBuf;
use std::sync::Arc;
use tokio::sync::Semaphore;

/// Concurrent listeners of live events; each keeps a connection for itself.
const MAX_LISTENERS: usize = 64;
/// Name of the route of the scene.
const SCENE: &str = "scene.s4d";
/// Headers of every response. Another origin can neither embed nor read anything; a type is what it is declared to be.
const HEADERS: [(HeaderName, &str); 5] = [
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
    (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    (HeaderName::from_static("cross-origin-embedder-policy"), "require-corp"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
];

/// State that all connections share.
#[derive(Debug)]
pub(crate) struct Shared {
    pub scene: Scene,
    pub hub: Arc<Hub>,
    pub guard: Guard,
    /// Further entries of `/config.json`.
    pub about: Value,
    pub live: bool,
    /// A scene elsewhere, and its origin.
    pub foreign: Option<(String, String)>,
    pub player_folder: Option<PathBuf>,
    /// Permission to edit.
    pub editing: Option<Editing>,
    /// Permission to pause and stop a run.
    pub control: Option<Editing>,
    /// Permission to send clicked points.
    pub assist: Option<Editing>,
    pub photos: Option<Photos>,
    listeners: Arc<Semaphore>,
    policy: HeaderValue,
}

impl Shared {
    pub(crate) fn new(scene: Scene, guard: Guard, about: Value, live: bool, foreign: Option<(String, String)>) -> Self {
        let policy = policy(foreign.as_ref().map_or("", |f| &f.1));
        Self {
            scene,
            hub: Arc::new(Hub::new()),
            guard,
            about,
            live,
            foreign,
            player_folder: None,
            editing: None,
            control: None,
            assist: None,
            photos: None,
            listeners: Arc::new(Semaphore::new(MAX_LISTENERS)),
            policy: policy.parse().expect("an origin was checked"),
        }
    }
}

/// Content security policy of the page: it may run the player's modules and workers, fetch from here, and from the
/// one origin that was named.
/// Styles may be inline because an element of the player carries its own.
fn policy(origin: &str) -> String {
    format!(
        "default-src 'none'; script-src 'self' blob:; worker-src 'self' blob:; style-src 'self' 'unsafe-inline'; \
         img-src 'self' data: blob:; media-src blob:; connect-src 'self' blob: data: {origin}; base-uri 'none'; \
         form-action 'none'; frame-ancestors 'self'"
    )
}

/// Handles one request.
pub(crate) async fn answer(shared: &Arc<Shared>, request: &Parts, body: Incoming) -> Response<Body> {
    let editing = match request.uri.path() {
        edit::ROUTE => shared.editing.as_ref(),
        edit::CONTROL_ROUTE => shared.control.as_ref(),
        edit::ASSIST_ROUTE => shared.assist.as_ref(),
        _ => None,
    };
    let mut response = match (shared.guard.check(request, editing.is_some()), editing) {
        (Err(refusal), _) => text(refusal.status, refusal.why),
        (Ok(()), Some(editing)) if request.method == Method::POST => {
            edit::answer(&shared.scene, editing, request, body).await
        }
        // A body that a client sends is never read.
        (Ok(()), _) => route(shared, request).await,
    };
    let headers = response.headers_mut();
    for (name, value) in HEADERS {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.insert(header::CONTENT_SECURITY_POLICY, shared.policy.clone());
    if response.status() == StatusCode::METHOD_NOT_ALLOWED {
        response.headers_mut().insert(header::ALLOW, HeaderValue::from_static("GET, HEAD"));
    }
    if request.method == Method::HEAD {
        // The length stays that of the body it would be.
        if let Some(length) = http_body::Body::size_hint(response.body()).exact() {
            response.headers_mut().entry(header::CONTENT_LENGTH).or_insert(length.into());
        }
        *response.body_mut() = Body::empty();
    }
    response
}

async fn route(shared: &Arc<Shared>, request: &Parts) -> Response<Body> {
    // The path is compared undecoded and never joined to a folder.
    let path = request.uri.path().strip_prefix('/').unwrap_or_default();
    match path {
        SCENE => scene(shared, request),
        "config.json" => whole(config(shared).to_string().into(), "application/json"),
        "metrics.json" => whole(shared.hub.json(), "application/json"),
        "events" => events(shared, request),
        photos::ROUTE => photo(shared, request).await,
        "" => player(shared, if shared.assist.is_some() { ASSIST } else { INDEX }, &request.headers).await,
        name => player(shared, name.strip_prefix("player/").unwrap_or(name), &request.headers).await,
    }
}

/// Configuration of the page: the scene that it is to show.
fn config(shared: &Shared) -> Value {
    let mut config = if shared.about.is_object() { shared.about.clone() } else { json!({}) };
    let version = shared.scene.version(None).map(|v| v.number).ok();
    config["live"] = json!(shared.live);
    if shared.editing.is_some() {
        config["edit"] = json!(true);
    }
    if shared.control.is_some() {
        config["control"] = json!(true);
    }
    if shared.photos.is_some() {
        config["photos"] = json!(true);
    }
    config["version"] = json!(version);
    config["scene"] = match &shared.foreign {
        Some((url, _)) => json!(url),
        None => json!(version.map(|_| SCENE)),
    };
    config
}

async fn player(shared: &Arc<Shared>, name: &str, headers: &HeaderMap) -> Response<Body> {
    let Some(folder) = &shared.player_folder else {
        return assets::asset(name).map_or_else(missing, |asset| file(asset, headers));
    };
    let (folder, name) = (folder.clone(), name.to_owned());
    let read = tokio::task::spawn_blocking(move || assets::from_folder(&folder, &name)).await;
    read.ok().flatten().map_or_else(missing, |asset| file(&asset, headers))
}

fn file(asset: &Asset, headers: &HeaderMap) -> Response<Body> {
    if headers.get(header::IF_NONE_MATCH).is_some_and(|tags| matches(tags, &asset.etag)) {
        return with(Body::empty(), StatusCode::NOT_MODIFIED, &[(header::ETAG, &asset.etag)]);
    }
    let accepted = headers.get(header::ACCEPT_ENCODING).and_then(|v| v.to_str().ok()).unwrap_or_default();
    let gzip = accepts_gzip(accepted);
    let bytes = if gzip { asset.gzip.clone().into() } else { Bytes::from(asset.text.clone().into_owned()) };
    let mut response = whole(bytes, asset.mime());
    let headers = response.headers_mut();
    headers.insert(header::ETAG, value(&asset.etag));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    headers.insert(header::VARY, HeaderValue::from_static("accept-encoding"));
    if gzip {
        headers.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
    }
    response
}

/// Whether gzip is named, and not with the weight 0.
fn accepts_gzip(header: &str) -> bool {
    header.split(',').any(|one| {
        let (name, weight) = one.split_once(';').unwrap_or((one, ""));
        let refused = weight.trim().strip_prefix("q=").is_some_and(|q| q.trim().parse() == Ok(0.0f32));
        ["gzip", "*"].contains(&name.trim()) && !refused
    })
}

fn scene(shared: &Shared, request: &Parts) -> Response<Body> {
    let mut wanted = request.uri.query().unwrap_or_default().split('&').filter_map(|pair| pair.strip_prefix("v="));
    let number = match wanted.next().map(str::parse) {
        None => None,
        Some(Ok(number)) => Some(number),
        Some(Err(_)) => return missing(),
    };
    let version = match shared.scene.version(number) {
        Ok(version) => version,
        Err(Missing::Gone) => return text(StatusCode::GONE, "this version was replaced by a newer one"),
        Err(Missing::Never) => return text(StatusCode::NOT_FOUND, "there is no scene yet"),
    };
    let headers = &request.headers;
    let common = [
        (header::ETAG, version.etag.as_str()),
        (header::ACCEPT_RANGES, "bytes"),
        (header::CONTENT_TYPE, splat4d::format::playback::MEDIA_TYPE),
        // The player keeps what it needs; a second copy of a large file in the browser's cache is useless.
        (header::CACHE_CONTROL, "no-store"),
    ];
    if headers.get(header::IF_NONE_MATCH).is_some_and(|tags| matches(tags, &version.etag)) {
        return with(Body::empty(), StatusCode::NOT_MODIFIED, &common);
    }
    // A range counts for GET only (RFC 9110), and only of the version that the client states, if any. No date is ever
    // given out, so that a date matches nothing.
    let fresh = headers.get(header::IF_RANGE).is_none_or(|tag| tag.as_bytes() == version.etag.as_bytes());
    let range = headers.get(header::RANGE).filter(|_| fresh && request.method == Method::GET);
    match range.and_then(|r| r.to_str().ok()).map_or(Requested::Whole, |r| range::parse(r, version.length)) {
        Requested::Whole if request.method == Method::HEAD => {
            let mut response = with(Body::empty(), StatusCode::OK, &common);
            response.headers_mut().insert(header::CONTENT_LENGTH, version.length.into());
            response
        }
        Requested::Whole => with(version.body(0, version.length), StatusCode::OK, &common),
        Requested::Part { start, end } => {
            let mut response = with(version.body(start, end), StatusCode::PARTIAL_CONTENT, &common);
            let part = format!("bytes {start}-{}/{}", end - 1, version.length);
            response.headers_mut().insert(header::CONTENT_RANGE, value(&part));
            response
        }
        Requested::Nothing => {
            let mut response = text(StatusCode::RANGE_NOT_SATISFIABLE, "the range starts after the end");
            response.headers_mut().insert(header::CONTENT_RANGE, value(&format!("bytes */{}", version.length)));
            response
        }
    }
}

fn events(shared: &Shared, request: &Parts) -> Response<Body> {
    if request.method == Method::HEAD {
        return whole(Bytes::new(), "text/event-stream");
    }
    let Ok(place) = shared.listeners.clone().try_acquire_owned() else {
        let mut response = text(StatusCode::SERVICE_UNAVAILABLE, "too many pages are connected");
        response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from_static("5"));
        return response;
    };
    let last = request.headers.get("last-event-id").and_then(|v| v.to_str().ok());
    let headers = [(header::CONTENT_TYPE, "text/event-stream"), (header::CACHE_CONTROL, "no-store")];
    with(shared.hub.stream(last, place), StatusCode::OK, &headers)
}

/// The image of a camera nearest to a time.
async fn photo(shared: &Arc<Shared>, request: &Parts) -> Response<Body> {
    let wanted = photos::PhotoQuery::parse(request.uri.query().unwrap_or_default());
    let (Some(photos), Some(wanted)) = (shared.photos.clone(), wanted) else { return missing() };
    let found = tokio::task::spawn_blocking(move || photos.find(&wanted)).await;
    let Some(photo) = found.ok().flatten() else { return missing() };
    let mut response = whole(photo.jpeg.into(), "image/jpeg");
    response.headers_mut().insert(photos::TIME, value(&photo.time.to_string()));
    // The images of a capture do not change while it is served.
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("private, max-age=600"));
    response
}

/// Whether a list of entity tags holds ours. Weak comparison, as for `If-None-Match`.
fn matches(list: &HeaderValue, etag: &str) -> bool {
    let list = list.to_str().unwrap_or_default();
    list.split(',').map(str::trim).any(|tag| tag == "*" || tag.trim_start_matches("W/") == etag)
}

fn missing() -> Response<Body> {
    text(StatusCode::NOT_FOUND, "not found")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gzip_is_sent_to_clients_that_accept_it() {
        for yes in ["gzip", "br, gzip", "deflate, gzip;q=0.5", "*"] {
            assert!(accepts_gzip(yes), "{yes}");
        }
        for no in ["", "br", "gzip;q=0", "gzip;q=0.0", "xgzip"] {
            assert!(!accepts_gzip(no), "{no}");
        }
    }

    #[test]
    fn a_list_of_tags_is_compared() {
        let is = |list: &str| matches(&value(list), "\"a\"");
        assert!(is("\"a\"") && is("W/\"a\"") && is("\"b\", \"a\"") && is("*"));
        assert!(!is("\"b\"") && !is("a") && !is(""));
    }
}
