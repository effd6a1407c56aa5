//! Access control. A page of any origin in the user's browser can send requests to loopback, and a foreign name can be
//! made to resolve to this machine (DNS rebinding), after which the browser treats that page as ours. So `Host` must be
//! a name that only this machine's user has, and `Origin`, where it is sent, must be the same as `Host`.

use hyper::http::request::Parts;
use hyper::http::uri::Authority;
use hyper::{Method, StatusCode, Version, header};
use std::net::IpAddr;

/// Host names that the server accepts.
#[derive(Clone, Debug)]
pub(crate) struct Guard {
    /// The host that the user gave, as typed.
    served: String,
    /// Bound to more than loopback: an address in numbers is no name, so that no resolver could have been tricked.
    open: bool,
}

/// Why a request is refused.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Refusal {
    pub status: StatusCode,
    pub why: &'static str,
}

const fn refusal(status: StatusCode, why: &'static str) -> Refusal {
    Refusal { status, why }
}

impl Guard {
    pub(crate) fn new(served: &str, open: bool) -> Self {
        Self { served: served.trim_matches(['[', ']']).to_ascii_lowercase(), open }
    }

    /// Whether a request is allowed. `posts`: whether this path accepts a body, which has rules of its own in addition.
    pub(crate) fn check(&self, request: &Parts, posts: bool) -> Result<(), Refusal> {
        let known = request.method == Method::GET || request.method == Method::HEAD;
        let posts = posts && request.method == Method::POST;
        if !known && !posts {
            return Err(refusal(StatusCode::METHOD_NOT_ALLOWED, "only GET and HEAD are supported"));
        }
        if request.version < Version::HTTP_11 {
            return Err(refusal(StatusCode::HTTP_VERSION_NOT_SUPPORTED, "HTTP/1.1 is required"));
        }
        // A full address in the request line is for proxies, which this server is not.
        if request.uri.authority().is_some() {
            return Err(refusal(StatusCode::BAD_REQUEST, "not a proxy"));
        }
        let mut hosts = request.headers.get_all(header::HOST).iter();
        let host = hosts.next().filter(|_| hosts.next().is_none());
        let Some(host) = host.and_then(|h| h.to_str().ok()?.parse::<Authority>().ok()) else {
            return Err(refusal(StatusCode::BAD_REQUEST, "expected one Host header"));
        };
        if host.as_str().contains('@') || !self.allows(host.host()) {
            return Err(refusal(
                StatusCode::FORBIDDEN,
                "this host name is not served: open the address that splat4d printed, or start it with --host NAME",
            ));
        }
        for origin in request.headers.get_all(header::ORIGIN) {
            let same = origin.to_str().is_ok_and(|o| {
                o.split_once("://").is_some_and(|(scheme, rest)| {
                    ["http", "https"].contains(&scheme) && rest.eq_ignore_ascii_case(host.as_str())
                })
            });
            if !same {
                return Err(refusal(StatusCode::FORBIDDEN, "pages of other origins may not read from here"));
            }
        }
        // Where the browser states so itself: a foreign page that embeds something of ours without CORS. Following a
        // link to the page is fine.
        let fetch = |name: &str| request.headers.get(name).and_then(|v| v.to_str().ok());
        if fetch("sec-fetch-site") == Some("cross-site") && fetch("sec-fetch-mode") != Some("navigate") {
            return Err(refusal(StatusCode::FORBIDDEN, "pages of other origins may not read from here"));
        }
        Ok(())
    }

    fn allows(&self, host: &str) -> bool {
        let host = host.trim_matches(['[', ']']).to_ascii_lowercase();
        let address = host.parse::<IpAddr>();
        // Any port: a tunnel (ssh -L) may have another one at its end.
        host == "localhost" || host == self.served || address.is_ok_and(|a| a.is_loopback() || self.open)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hyper::Request;

    fn ask(guard: &Guard, host: &str, origin: Option<&str>) -> Result<(), u16> {
        let mut request = Request::get("/").header("host", host);
        if let Some(origin) = origin {
            request = request.header("origin", origin);
        }
        guard.check(&request.body(()).unwrap().into_parts().0, false).map_err(|r| r.status.as_u16())
    }

    #[test]
    fn foreign_names_are_refused() {
        let local = Guard::new("127.0.0.1", false);
        for host in ["localhost", "localhost:81", "LocalHost:4400", "127.0.0.1:4400", "127.1.2.3", "[::1]:4400"] {
            assert_eq!(ask(&local, host, None), Ok(()), "{host}");
        }
        for host in ["evil.example", "localhost.evil.example:4400", "192.168.1.7:4400", "127.0.0.1.nip.io", "[::2]"] {
            assert_eq!(ask(&local, host, None), Err(403), "{host}");
        }
        for host in ["", "a b", "user@localhost:4400/", "localhost:4400:1"] {
            assert!(ask(&local, host, None).is_err(), "{host}");
        }
        assert_eq!(ask(&local, "user@localhost", None), Err(403));
    }

    #[test]
    fn a_given_host_is_accepted_and_addresses_are_not_names() {
        let open = Guard::new("Workstation", true);
        for host in ["workstation:4400", "192.168.1.7:4400", "[fe80::1]:4400", "localhost"] {
            assert_eq!(ask(&open, host, None), Ok(()), "{host}");
        }
        assert_eq!(ask(&open, "evil.example", None), Err(403));
    }

    #[test]
    fn foreign_origins_are_refused() {
        let local = Guard::new("127.0.0.1", false);
        assert_eq!(ask(&local, "localhost:81", Some("http://localhost:81")), Ok(()));
        for origin in
            ["http://evil.example", "null", "http://localhost:82", "http://localhost", "file://localhost:81", ""]
        {
            assert_eq!(ask(&local, "localhost:81", Some(origin)), Err(403), "{origin}");
        }
    }

    #[test]
    fn embedding_from_elsewhere_is_refused_and_a_link_is_not() {
        let local = Guard::new("127.0.0.1", false);
        let ask = |mode: &str| {
            let request = Request::get("/").header("host", "localhost");
            let request = request.header("sec-fetch-site", "cross-site").header("sec-fetch-mode", mode);
            local.check(&request.body(()).unwrap().into_parts().0, false).is_ok()
        };
        assert!(!ask("no-cors") && !ask("cors") && ask("navigate"));
    }
}
