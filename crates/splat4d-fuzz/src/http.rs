//! Requests to the local server of `view`.

use crate::Reader;
use splat4d_serve::{Config, Content, Running, Server};
use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::OnceLock;
use std::time::Duration;

pub(crate) const READERS: &[Reader] = &[Reader { name: "http", seeds, read: ask }];

/// The longest that a response to a few bytes takes.
const PATIENCE: Duration = Duration::from_secs(10);

fn seeds() -> Vec<Vec<u8>> {
    [
        "GET / HTTP/1.1\r\nhost: localhost\r\naccept-encoding: gzip\r\n\r\n",
        "GET /scene.s4d?v=1 HTTP/1.1\r\nhost: localhost\r\nrange: bytes=10-20\r\nif-range: \"a\"\r\n\r\n",
        "HEAD /player/ui.js HTTP/1.1\r\nhost: 127.0.0.1\r\nif-none-match: \"a\", *\r\n\r\n",
        "POST /edit HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: 2\r\n\r\n{}",
        "GET /config.json HTTP/1.0\r\n\r\n",
    ]
    .map(|text| text.as_bytes().to_vec())
    .into()
}

fn server() -> &'static Running {
    static SERVER: OnceLock<Running> = OnceLock::new();
    SERVER.get_or_init(|| {
        let content = Content::Bytes(vec![7; 1000].into());
        Server::start(Config { port: Some(0), content, ..Config::default() }).expect("a port is free")
    })
}

/// Sends bytes and reads the response until the server closes, which it does once nothing more can come.
fn ask(bytes: &[u8]) {
    let address = server().url().trim_start_matches("http://").trim_end_matches('/').to_owned();
    let mut stream = TcpStream::connect(address).expect("the server is there");
    stream.set_read_timeout(Some(PATIENCE)).expect("a time is a timeout");
    // It may close before it has read everything.
    let _ = stream.write_all(bytes).and_then(|()| stream.shutdown(Shutdown::Write));
    let mut answer = Vec::new();
    let read = stream.take(1 << 20).read_to_end(&mut answer);
    let waited = read.is_err_and(|e| matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut));
    assert!(!waited, "the server neither answers nor closes");
}
