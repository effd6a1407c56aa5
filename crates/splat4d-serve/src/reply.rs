//! Responses in one piece.

use crate::body::Body;
use hyper::body::Bytes;
use hyper::header::{self, HeaderName, HeaderValue};
use hyper::{Response, StatusCode};

pub(crate) fn text(status: StatusCode, what: &'static str) -> Response<Body> {
    let mut response = whole(Bytes::from_static(what.as_bytes()), "text/plain; charset=utf-8");
    *response.status_mut() = status;
    response
}

/// Bytes that are not to be kept.
pub(crate) fn whole(bytes: Bytes, mime: &str) -> Response<Body> {
    let headers = [(header::CONTENT_TYPE, mime), (header::CACHE_CONTROL, "no-store")];
    with(bytes.into(), StatusCode::OK, &headers)
}

pub(crate) fn with(body: Body, status: StatusCode, headers: &[(HeaderName, &str)]) -> Response<Body> {
    let mut response = Response::new(body);
    *response.status_mut() = status;
    for (name, text) in headers {
        response.headers_mut().insert(name, value(text));
    }
    response
}

pub(crate) fn value(text: &str) -> HeaderValue {
    HeaderValue::from_str(text).expect("headers are written here, in ASCII")
}
