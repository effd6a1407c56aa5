//! Buckets of S3 and of storages with its interface: requests are signed by `rusty-s3` and sent by `ureq`.

use super::{Condition, Content, Object, Store};
use crate::files::cannot_read;
use rusty_s3::actions::{ListObjectsV2, S3Action};
use rusty_s3::{Credentials, UrlStyle};
use splat4d::{Error, Result};
use splat4d_train::output::write_atomically_with;
use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;
use std::time::Duration;
use ureq::http::header::{DATE, ETAG, IF_MATCH, IF_NONE_MATCH, LAST_MODIFIED};
use ureq::http::{Response, StatusCode};
use ureq::tls::{Certificate, PemItem, RootCerts, TlsConfig};
use ureq::{Agent, Body};

/// Attempts of a request that the storage does not answer, or answers with an error of its own.
const ATTEMPTS: u32 = 6;
/// Pause after the first attempt; each further one is twice as long: 16 s in total.
const PAUSE: Duration = Duration::from_millis(500);
/// Time for a connection, and without any byte.
const CONNECT: Duration = Duration::from_secs(10);
const SILENCE: Duration = Duration::from_secs(60);
/// Life of a signature; clocks may differ by as much.
const SIGNED: Duration = Duration::from_secs(900);
/// Most bytes of a listing page, an error or a small object.
const SMALL: u64 = 16 << 20;
/// Most bytes of one upload (S3).
const UPLOAD: u64 = 5 << 30;
/// Region where none is given.
const REGION: &str = "us-east-1";

/// Access to a storage, as programs of AWS read it from the environment. It holds secrets and is not printed.
#[derive(Clone, Default)]
pub struct Access {
    /// `AWS_ACCESS_KEY_ID`.
    pub key: Option<String>,
    /// `AWS_SECRET_ACCESS_KEY`.
    pub secret: Option<String>,
    /// `AWS_SESSION_TOKEN`.
    pub token: Option<String>,
    /// `AWS_REGION` or `AWS_DEFAULT_REGION`.
    pub region: Option<String>,
    /// `AWS_ENDPOINT_URL_S3` or `AWS_ENDPOINT_URL`; none: Amazon S3.
    pub endpoint: Option<String>,
    /// `AWS_CA_BUNDLE`: certificates in place of the well-known ones.
    pub certificates: Option<std::path::PathBuf>,
}

/// A bucket.
pub(super) struct Bucket {
    bucket: rusty_s3::Bucket,
    credentials: Credentials,
    agent: Agent,
}

impl Bucket {
    /// Errors: there are no credentials; the endpoint is not an address.
    pub(super) fn new(name: &str, access: &Access) -> Result<Self> {
        let (Some(key), Some(secret)) = (&access.key, &access.secret) else {
            return Err(Error::input("there are no credentials for object storage")
                .at(format!("s3://{name}"))
                .remedy("Set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY (`aws configure export-credentials --format env` prints them)"));
        };
        let credentials = match &access.token {
            Some(token) => Credentials::new_with_token(key.as_str(), secret.as_str(), token.as_str()),
            None => Credentials::new(key.as_str(), secret.as_str()),
        };
        let region = access.region.clone().unwrap_or_else(|| REGION.into());
        let endpoint = access.endpoint.clone().unwrap_or_else(|| format!("https://s3.{region}.amazonaws.com"));
        let bad = |what: String| {
            Error::input(format!("invalid endpoint of the object storage: {what}"))
                .at(&endpoint)
                .remedy("Set AWS_ENDPOINT_URL to an address such as https://storage.example.org:9000, or remove it for Amazon S3")
        };
        // Certificates of Amazon are valid for one more label, and other storages rarely resolve a bucket's name.
        let amazon = access.endpoint.is_none() && !name.contains('.');
        let style = if amazon { UrlStyle::VirtualHost } else { UrlStyle::Path };
        let url = endpoint.parse().map_err(|e| bad(format!("{e}")))?;
        let bucket = rusty_s3::Bucket::new(url, style, name.to_owned(), region).map_err(|e| bad(e.to_string()))?;
        let tls = match &access.certificates {
            None => TlsConfig::default(),
            Some(path) => TlsConfig::builder().root_certs(certificates(path)?).build(),
        };
        let config = Agent::config_builder()
            .http_status_as_error(false)
            .max_redirects(0)
            .max_redirects_will_error(false)
            .timeout_connect(Some(CONNECT))
            .timeout_recv_response(Some(SILENCE))
            .timeout_per_read(Some(SILENCE))
            .timeout_per_write(Some(SILENCE))
            .user_agent(concat!("splat4d/", env!("CARGO_PKG_VERSION")))
            .tls_config(tls)
            .build();
        Ok(Self { bucket, credentials, agent: config.new_agent() })
    }

    fn place(&self, key: &str) -> String {
        format!("s3://{}/{key}", self.bucket.name())
    }

    /// Sends a request until the storage answers it. Errors: it does not; it refuses.
    fn ask<T>(&self, key: &str, send: &mut dyn FnMut() -> Attempt<T>) -> Result<T> {
        let mut pause = PAUSE;
        for attempt in 1.. {
            let what = match send() {
                Attempt::Done(value) => return Ok(value),
                Attempt::Refused(error) => return Err(error.at(self.place(key))),
                Attempt::Failed(what) => what,
            };
            if attempt >= ATTEMPTS {
                return Err(Error::environment(
                    format!("the object storage does not answer, after {ATTEMPTS} attempts"),
                    std::io::Error::other(what),
                )
                .at(self.place(key))
                .remedy(
                    "Check the network and AWS_ENDPOINT_URL, then run the same command again: what is finished is kept",
                ));
            }
            std::thread::sleep(pause);
            pause *= 2;
        }
        unreachable!("the last attempt returns")
    }

    /// The answer of the storage to a request.
    fn answer(&self, sent: std::result::Result<Response<Body>, ureq::Error>) -> Attempt<Response<Body>> {
        let mut response = match sent {
            Ok(response) => response,
            Err(error) => return Attempt::Failed(error.to_string()),
        };
        let status = response.status();
        if status.is_success() || matches!(status, StatusCode::PRECONDITION_FAILED | StatusCode::CONFLICT) {
            return Attempt::Done(response);
        }
        let text = response.body_mut().with_config().limit(SMALL).read_to_string().unwrap_or_default();
        let code = between(&text, "<Code>", "</Code>");
        if status == StatusCode::NOT_FOUND && code != "NoSuchBucket" {
            return Attempt::Done(response);
        }
        let again = [StatusCode::REQUEST_TIMEOUT, StatusCode::TOO_MANY_REQUESTS].contains(&status)
            || status.is_server_error() && status != StatusCode::NOT_IMPLEMENTED;
        let said = if code.is_empty() { status.to_string() } else { code.to_owned() };
        if again {
            return Attempt::Failed(said);
        }
        let stated = response.headers().get("x-amz-bucket-region").and_then(|v| v.to_str().ok());
        let region = stated.unwrap_or(match between(&text, "<Region>", "</Region>") {
            "" => "...",
            region => region,
        });
        let (what, remedy) = match (code, status) {
            ("NoSuchBucket", _) => ("there is no such bucket".into(), "Create it, or correct the address".into()),
            ("InvalidAccessKeyId" | "SignatureDoesNotMatch" | "ExpiredToken" | "InvalidToken", _) => (
                format!("the object storage refuses the credentials ({said})"),
                "Check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_SESSION_TOKEN, which may have expired, and run the same command again".into(),
            ),
            ("RequestTimeTooSkewed", _) => {
                ("the clock of this machine is wrong, so that signatures are refused".into(), "Set the clock".into())
            }
            (_, StatusCode::FORBIDDEN | StatusCode::UNAUTHORIZED) => (
                format!("access is denied ({said})"),
                "The credentials need the rights to list, read and write below this address; to delete as well".into(),
            ),
            (code, s)
                if s.is_redirection()
                    || ["AuthorizationHeaderMalformed", "AuthorizationQueryParametersError"].contains(&code) =>
            {
                ("the bucket is in another region".into(), format!("Set AWS_REGION={region}"))
            }
            _ => (format!("the object storage refuses a request ({said})"), "Check the address and AWS_ENDPOINT_URL".into()),
        };
        Attempt::Refused(Error::input(what).remedy(remedy))
    }
}

/// The outcome of an attempt.
enum Attempt<T> {
    Done(T),
    /// Another attempt would have the same answer.
    Refused(Error),
    Failed(String),
}

impl<T> Attempt<T> {
    fn then<U>(self, next: impl FnOnce(T) -> Attempt<U>) -> Attempt<U> {
        match self {
            Attempt::Done(value) => next(value),
            Attempt::Refused(error) => Attempt::Refused(error),
            Attempt::Failed(what) => Attempt::Failed(what),
        }
    }
}

impl Store for Bucket {
    fn list(&self, prefix: &str) -> Result<Vec<Object>> {
        let (mut out, mut token) = (Vec::new(), None::<String>);
        loop {
            let page = self.ask(prefix, &mut || {
                let mut action = ListObjectsV2::new(&self.bucket, Some(&self.credentials));
                action.with_prefix(prefix);
                if let Some(token) = &token {
                    action.with_continuation_token(token.as_str());
                }
                self.answer(self.agent.get(action.sign(SIGNED).as_str()).call()).then(|mut response| {
                    let text = match response.body_mut().with_config().limit(SMALL).read_to_string() {
                        Ok(text) => text,
                        Err(error) => return Attempt::Failed(error.to_string()),
                    };
                    match ListObjectsV2::parse_response(&text) {
                        Ok(page) => Attempt::Done(page),
                        Err(error) => Attempt::Refused(
                            Error::input(format!("the listing is not that of an object storage: {error}"))
                                .remedy("Check AWS_ENDPOINT_URL"),
                        ),
                    }
                })
            })?;
            let objects = page.contents.into_iter();
            out.extend(objects.map(|o| Object {
                key: o.key,
                size: o.size.unwrap_or(0),
                etag: o.etag.unwrap_or_default(),
            }));
            token = page.next_continuation_token;
            if token.is_none() {
                out.sort_by(|a, b| a.key.cmp(&b.key));
                return Ok(out);
            }
        }
    }

    fn read(&self, key: &str) -> Result<Option<Content>> {
        self.ask(key, &mut || {
            let url = self.bucket.get_object(Some(&self.credentials), key).sign(SIGNED);
            self.answer(self.agent.get(url.as_str()).call()).then(|mut response| {
                if !response.status().is_success() {
                    return Attempt::Done(None);
                }
                let time = |name| {
                    let text = response.headers().get(name)?.to_str().ok()?;
                    seconds(text)
                };
                let age = time(DATE)
                    .zip(time(LAST_MODIFIED))
                    .map(|(now, then)| Duration::from_secs(now.saturating_sub(then)));
                let etag = etag(&response);
                match response.body_mut().with_config().limit(SMALL).read_to_vec() {
                    Ok(bytes) => Attempt::Done(Some(Content { bytes, etag, age })),
                    Err(error) => Attempt::Failed(error.to_string()),
                }
            })
        })
    }

    fn write(&self, key: &str, bytes: &[u8], condition: Condition<'_>) -> Result<Option<String>> {
        self.ask(key, &mut || {
            let url = self.bucket.put_object(Some(&self.credentials), key).sign(SIGNED);
            let request = self.agent.put(url.as_str());
            let request = match condition {
                Condition::Absent => request.header(IF_NONE_MATCH, "*"),
                Condition::Is(etag) => request.header(IF_MATCH, etag),
            };
            self.answer(request.send(bytes))
                .then(|response| Attempt::Done(response.status().is_success().then(|| etag(&response))))
        })
    }

    fn download(&self, key: &str, to: &Path) -> Result<Option<String>> {
        self.ask(key, &mut || {
            let url = self.bucket.get_object(Some(&self.credentials), key).sign(SIGNED);
            self.answer(self.agent.get(url.as_str()).call()).then(|mut response| {
                if !response.status().is_success() {
                    return Attempt::Done(None);
                }
                let (etag, length) = (etag(&response), response.body().content_length());
                let mut lost = None;
                let written = write_atomically_with(to, &mut |out| copy(response.body_mut(), length, out, &mut lost));
                match (written, lost) {
                    (Ok(()), _) => Attempt::Done(Some(etag)),
                    (Err(_), Some(what)) => Attempt::Failed(what),
                    (Err(error), None) => Attempt::Refused(error),
                }
            })
        })
    }

    fn upload(&self, key: &str, from: &Path) -> Result<String> {
        let size = std::fs::metadata(from).map_err(|e| cannot_read(from, e))?.len();
        if size > UPLOAD {
            return Err(Error::input("the file is larger than 5 GiB, the limit of one upload")
                .at(from.display())
                .remedy("Train shorter chunks (--chunk-frames) or fewer Gaussians (--set max_cap=N)"));
        }
        self.ask(key, &mut || {
            let file = match File::open(from) {
                Ok(file) => file,
                Err(error) => return Attempt::Refused(cannot_read(from, error)),
            };
            let url = self.bucket.put_object(Some(&self.credentials), key).sign(SIGNED);
            self.answer(self.agent.put(url.as_str()).send(&file)).then(|response| {
                match response.status().is_success() {
                    true => Attempt::Done(etag(&response)),
                    false => Attempt::Failed(response.status().to_string()),
                }
            })
        })
    }

    fn remove(&self, key: &str) -> Result<()> {
        self.ask(key, &mut || {
            let url = self.bucket.delete_object(Some(&self.credentials), key).sign(SIGNED);
            self.answer(self.agent.delete(url.as_str()).call()).then(|_| Attempt::Done(()))
        })
    }
}

/// Copies a body into a file. Errors: of the file; `lost`: the connection ended early.
fn copy(body: &mut Body, length: Option<u64>, out: &mut dyn Write, lost: &mut Option<String>) -> Result<()> {
    let mut reader = body.with_config().limit(u64::MAX).reader();
    let (mut buffer, mut total) = (vec![0; 1 << 16], 0);
    let mut ended = |what: String| {
        *lost = Some(what);
        Error::input("the connection ended")
    };
    loop {
        let n = match reader.read(&mut buffer) {
            Ok(0) => break,
            Ok(n) => n,
            Err(error) => return Err(ended(error.to_string())),
        };
        total += n as u64;
        out.write_all(&buffer[..n])
            .map_err(|e| Error::environment("the file cannot be written", e).remedy(crate::files::WRITE_REMEDY))?;
    }
    match length {
        Some(length) if length != total => Err(ended(format!("{total} of {length} bytes arrived"))),
        _ => Ok(()),
    }
}

fn etag(response: &Response<Body>) -> String {
    response.headers().get(ETAG).and_then(|v| v.to_str().ok()).unwrap_or_default().to_owned()
}

fn between<'a>(text: &'a str, from: &str, to: &str) -> &'a str {
    text.split_once(from).and_then(|(_, rest)| rest.split_once(to)).map_or("", |(code, _)| code)
}

fn certificates(path: &Path) -> Result<RootCerts> {
    let bytes = crate::files::read(path)?;
    let found: Vec<Certificate<'static>> = ureq::tls::parse_pem(&bytes)
        .filter_map(|item| match item {
            Ok(PemItem::Certificate(certificate)) => Some(certificate),
            _ => None,
        })
        .collect();
    if found.is_empty() {
        return Err(Error::input("contains no certificates in PEM format")
            .at(path.display())
            .remedy("Correct AWS_CA_BUNDLE, or remove it for the well-known certificates"));
    }
    Ok(RootCerts::new_with_certs(&found))
}

/// Seconds since 1970 of a date of HTTP (RFC 9110): `Sun, 06 Nov 1994 08:49:37 GMT`.
fn seconds(date: &str) -> Option<u64> {
    const MONTHS: [&str; 12] = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];
    let words: Vec<&str> = date.split_ascii_whitespace().collect();
    let [_, day, month, year, clock, "GMT"] = words.as_slice() else { return None };
    let month = MONTHS.iter().position(|m| m == month)? as u64;
    let (day, year): (u64, u64) = (day.parse().ok()?, year.parse().ok()?);
    if !(1970..=9999).contains(&year) || !(1..=31).contains(&day) {
        return None;
    }
    // Hinnant's `days_from_civil`, years from March.
    let (year, month) = if month < 2 { (year - 1, month + 10) } else { (year, month - 2) };
    let days = 365 * year + year / 4 - year / 100 + year / 400 + (153 * month + 2) / 5 + day - 1 - 719_468;
    let clock: Vec<u64> = clock.split(':').map(|n| n.parse().ok()).collect::<Option<_>>()?;
    let [hours, minutes, seconds] = clock.as_slice() else { return None };
    Some(86_400 * days + 3600 * hours + 60 * minutes + seconds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_of_http_are_seconds() {
        for (text, expected) in [
            ("Sun, 06 Nov 1994 08:49:37 GMT", Some(784_111_777)),
            ("Thu, 01 Jan 1970 00:00:00 GMT", Some(0)),
            ("Tue, 29 Feb 2000 23:59:59 GMT", Some(951_868_799)),
            ("Sun, 06 Nov 1994 08:49:37 CET", None),
            ("yesterday", None),
        ] {
            assert_eq!(seconds(text), expected, "{text}");
        }
    }

    #[test]
    fn credentials_and_endpoints_are_checked() {
        let access = Access { key: Some("k".into()), secret: Some("s".into()), ..Access::default() };
        let refused = |access: &Access| Bucket::new("takes", access).err().unwrap().to_string();
        assert!(refused(&Access::default()).contains("AWS_ACCESS_KEY_ID"));
        assert!(refused(&Access { endpoint: Some("nowhere".into()), ..access.clone() }).contains("AWS_ENDPOINT_URL"));
        assert!(
            Bucket::new("takes", &access).unwrap().bucket.object_url("a/b").as_str().starts_with("https://takes.s3.")
        );
    }

    #[test]
    fn a_storage_that_does_not_answer_is_an_error_of_the_environment() {
        let gone = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let access = Access {
            key: Some("k".into()),
            secret: Some("s".into()),
            endpoint: Some(format!("http://{gone}")),
            ..Access::default()
        };
        let began = std::time::Instant::now();
        let error = Bucket::new("takes", &access).unwrap().list("a/").unwrap_err();
        assert!(error.to_string().contains("does not answer, after 6 attempts"), "{error}");
        assert!(!error.is_users() && began.elapsed() > Duration::from_secs(10));
    }
}
