//! The whole server on loopback: valid and invalid requests, and the responses.

use crate::{Config, Content, EditResponse, Editing, News, Photo, Photos, Running, Server};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// A test that waits longer than this has found a hang. Generous: machines that test are busy.
const PATIENCE: Duration = Duration::from_secs(60);

struct Reply {
    status: u16,
    head: String,
    body: Vec<u8>,
}

impl Reply {
    fn header(&self, name: &str) -> Option<&str> {
        let mut lines = self.head.lines().filter_map(|l| l.split_once(':'));
        lines.find(|(n, _)| n.eq_ignore_ascii_case(name)).map(|(_, v)| v.trim())
    }
}

fn start(config: Config) -> Running {
    Server::start(Config { port: Some(0), ..config }).unwrap()
}

fn of_bytes(bytes: &[u8]) -> Running {
    start(Config { content: Content::Bytes(bytes.into()), ..Config::default() })
}

fn connect(server: &Running) -> TcpStream {
    let stream = TcpStream::connect(server.address()).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream
}

/// Sends bytes, perhaps states that these were all, and reads to the end of the connection.
fn raw(server: &Running, bytes: &[u8], all: bool) -> Vec<u8> {
    let mut stream = connect(server);
    // A server that refuses early may close while this still writes.
    let _ = stream.write_all(bytes);
    if all {
        let _ = stream.shutdown(Shutdown::Write);
    }
    let mut reply = Vec::new();
    let _ = stream.read_to_end(&mut reply);
    reply
}

fn ask(server: &Running, method: &str, target: &str, headers: &[(&str, &str)]) -> Reply {
    let mut request = format!("{method} {target} HTTP/1.1\r\nconnection: close\r\n");
    if !headers.iter().any(|(name, _)| *name == "host") {
        request += "host: localhost\r\n";
    }
    for (name, value) in headers {
        request += &format!("{name}: {value}\r\n");
    }
    let reply = raw(server, (request + "\r\n").as_bytes(), false);
    let end = reply.windows(4).position(|w| w == b"\r\n\r\n").expect("an answer has a head");
    let head = String::from_utf8(reply[..end].to_vec()).unwrap();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    Reply { status, head, body: reply[end + 4..].to_vec() }
}

fn get(server: &Running, target: &str) -> Reply {
    ask(server, "GET", target, &[])
}

fn bytes(length: usize) -> Vec<u8> {
    (0..length).map(|i| (i * 31 + i / 251) as u8).collect()
}

#[test]
fn ranges_of_files_and_of_memory_are_the_same() {
    let all = bytes(300_000);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.s4d");
    std::fs::write(&path, &all).unwrap();
    for server in [of_bytes(&all), start(Config { content: Content::File(path), ..Config::default() })] {
        let whole = get(&server, "/scene.s4d");
        assert_eq!(whole.header("content-type"), Some("application/vnd.s4d"));
        assert_eq!((whole.status, whole.header("accept-ranges")), (200, Some("bytes")));
        assert!(whole.body == all);
        for (range, part) in [
            ("bytes=0-0", 0..1),
            ("bytes=131071-131073", 131_071..131_074),
            ("bytes=100-299999", 100..300_000),
            ("bytes=100-999999999", 100..300_000),
            ("bytes=299990-", 299_990..300_000),
            ("bytes=-5", 299_995..300_000),
        ] {
            let reply = ask(&server, "GET", "/scene.s4d", &[("range", range)]);
            assert_eq!(reply.status, 206, "{range}");
            assert!(reply.body == all[part.clone()], "{range}");
            let told = format!("bytes {}-{}/300000", part.start, part.end - 1);
            assert_eq!(reply.header("content-range"), Some(told.as_str()));
            assert_eq!(reply.header("content-length"), Some(part.len().to_string().as_str()));
        }
        for range in ["bytes=300000-", "bytes=-0"] {
            let reply = ask(&server, "GET", "/scene.s4d", &[("range", range)]);
            assert_eq!((reply.status, reply.header("content-range")), (416, Some("bytes */300000")), "{range}");
        }
        for range in ["bytes=0-1,5-6", "bytes=6-5", "bytes=x-", "cats=1-2"] {
            let reply = ask(&server, "GET", "/scene.s4d", &[("range", range)]);
            assert!(reply.status == 200 && reply.body == all, "{range}");
        }
        server.stop();
    }
}

#[test]
fn head_and_tags() {
    let server = of_bytes(&bytes(1000));
    let head = ask(&server, "HEAD", "/scene.s4d", &[("range", "bytes=0-9")]);
    assert_eq!((head.status, head.header("content-length"), head.body.len()), (200, Some("1000"), 0));
    let tag = head.header("etag").unwrap().to_owned();
    let ranged = |headers: &[(&str, &str)]| {
        let all: Vec<(&str, &str)> = headers.iter().copied().chain([("range", "bytes=0-9")]).collect();
        ask(&server, "GET", "/scene.s4d", &all).status
    };
    assert_eq!(ranged(&[("if-range", &tag)]), 206);
    assert_eq!(ranged(&[("if-range", "\"another\"")]), 200);
    assert_eq!(ranged(&[("if-range", &format!("W/{tag}"))]), 200, "a weak tag matches no range");
    assert_eq!(ranged(&[("if-range", "Wed, 21 Oct 2015 07:28:00 GMT")]), 200);
    assert_eq!(ranged(&[("if-none-match", &tag)]), 304);
    for target in ["/", "/config.json", "/metrics.json", "/none"] {
        let (head, get) = (ask(&server, "HEAD", target, &[]), get(&server, target));
        assert_eq!((head.status, head.body.len()), (get.status, 0), "{target}");
        assert_eq!(head.header("content-length"), get.header("content-length"), "{target}");
    }
    let page = get(&server, "/").header("etag").unwrap().to_owned();
    assert_eq!(ask(&server, "GET", "/", &[("if-none-match", &page)]).status, 304);
    let events = ask(&server, "HEAD", "/events", &[]);
    assert_eq!((events.status, events.header("content-type")), (200, Some("text/event-stream")));
}

#[test]
fn an_empty_scene_and_none() {
    let empty = of_bytes(&[]);
    assert_eq!(get(&empty, "/scene.s4d").status, 200);
    assert_eq!(ask(&empty, "GET", "/scene.s4d", &[("range", "bytes=0-")]).status, 416);
    let none = start(Config { live: true, ..Config::default() });
    assert_eq!(get(&none, "/scene.s4d").status, 404);
    let config: Value = serde_json::from_slice(&get(&none, "/config.json").body).unwrap();
    assert_eq!(config, json!({"live": true, "scene": null, "version": null}));
}

#[test]
fn the_player_is_compressed_for_clients_that_accept_it() {
    let server = of_bytes(b"x");
    for asset in crate::assets() {
        let target = format!("/player/{}", asset.name);
        let plain = get(&server, &target);
        assert_eq!((plain.status, plain.header("content-encoding")), (200, None));
        assert_eq!(plain.body, asset.text.as_bytes());
        assert_eq!(plain.header("content-type"), Some(asset.mime()));
        assert_eq!(get(&server, &format!("/{}", asset.name)).body, plain.body, "relative to the page");
        let small = ask(&server, "GET", &target, &[("accept-encoding", "br, gzip")]);
        assert_eq!((small.header("content-encoding"), &small.body), (Some("gzip"), &asset.gzip));
    }
    assert_eq!(get(&server, "/").body, crate::asset("index.html").unwrap().text.as_bytes());
}

#[test]
fn the_player_folder_is_read_at_every_request_and_no_other_file() {
    let folder = tempfile::tempdir().unwrap();
    let player = folder.path().join("player");
    std::fs::create_dir(&player).unwrap();
    std::fs::write(folder.path().join("secret.js"), "secret").unwrap();
    let server = start(Config { player_folder: Some(player.clone()), ..Config::default() });
    for text in ["one", "two"] {
        std::fs::write(player.join("a.js"), text).unwrap();
        assert_eq!(get(&server, "/player/a.js").body, text.as_bytes());
    }
    for target in ["/player/../secret.js", "/player/..%2fsecret.js", "/secret.js", "/player/./a.js"] {
        assert_eq!(get(&server, target).status, 404, "{target}");
    }
}

#[test]
fn every_response_excludes_other_origins() {
    let server = of_bytes(b"x");
    for reply in [get(&server, "/"), get(&server, "/scene.s4d"), get(&server, "/none"), {
        ask(&server, "GET", "/", &[("host", "evil.example")])
    }] {
        assert_eq!(reply.header("x-content-type-options"), Some("nosniff"));
        assert_eq!(reply.header("cross-origin-resource-policy"), Some("same-origin"));
        assert!(reply.header("content-security-policy").unwrap().starts_with("default-src 'none'"));
        assert_eq!(reply.header("access-control-allow-origin"), None);
    }
}

#[test]
fn foreign_hosts_and_origins_get_nothing() {
    let server = of_bytes(b"secret");
    for headers in [
        &[("host", "evil.example")][..],
        &[("host", "localhost.evil.example")],
        &[("origin", "https://evil.example")],
        &[("origin", "null")],
        &[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "no-cors")],
    ] {
        for target in ["/", "/scene.s4d", "/events", "/config.json"] {
            let reply = ask(&server, "GET", target, headers);
            assert_eq!(reply.status, 403, "{headers:?}");
            assert!(!reply.body.windows(6).any(|w| w == b"secret"));
        }
    }
    for method in ["POST", "PUT", "DELETE", "OPTIONS", "PATCH", "BREW"] {
        let reply = ask(&server, method, "/scene.s4d", &[]);
        assert_eq!((reply.status, reply.header("allow")), (405, Some("GET, HEAD")), "{method}");
    }
}

#[test]
fn a_scene_elsewhere_is_named_and_its_origin_allowed() {
    let foreign = Some("https://example.org/a.s4d?x=1".to_owned());
    let server = start(Config { foreign, about: json!({"title": "far"}), ..Config::default() });
    let page = get(&server, "/");
    let policy = page.header("content-security-policy").unwrap();
    assert!(policy.contains("connect-src 'self' blob: data: https://example.org;"), "{policy}");
    let config: Value = serde_json::from_slice(&get(&server, "/config.json").body).unwrap();
    assert_eq!((&config["scene"], &config["title"]), (&json!("https://example.org/a.s4d?x=1"), &json!("far")));
    let bad = Config { foreign: Some("https://a;script-src".into()), ..Config::default() };
    assert!(Server::start(bad).is_err());
}

#[test]
fn paths_outside_the_folder_are_refused() {
    let server = of_bytes(b"x");
    for target in [
        "/..",
        "/../../../../etc/passwd",
        "/player/../../../etc/passwd",
        "/player/%2e%2e/%2e%2e/etc/passwd",
        "/player/..%2f..%2fetc%2fpasswd",
        "/player/..%5c..%5cwindows%5cwin.ini",
        "/player//etc/passwd",
        "/player/",
        "/player/player/index.html",
        "//etc/passwd",
        "/scene.s4d/",
        "/SCENE.s4d",
        "/scene.s4d%00",
        "/Cargo.toml",
        "/.git/config",
        "/scene.s4d?v=-1",
        "/scene.s4d?v=99999999999999999999999",
        "/scene.s4d?v=2",
    ] {
        assert_eq!(get(&server, target).status, 404, "{target}");
    }
    assert_eq!(ask(&server, "GET", "http://localhost/", &[]).status, 400, "not a proxy");
}

/// Requests as broken clients and curious strangers send them.
fn broken_requests() -> Vec<Vec<u8>> {
    let mut all: Vec<Vec<u8>> = [
        &b""[..],
        b"\r\n\r\n\r\n",
        b"\0\0\0\0",
        b"GET",
        b"GET /",
        b"GET / HTTP/1.1\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/9.9\r\nhost: localhost\r\n\r\n",
        b"GET / HTTP/1.0\r\n\r\n",
        b"GET / HTTP/0.9\r\n\r\n",
        b"GET  /  HTTP/1.1\r\nhost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\nhost: localhost\n\n",
        b"GET / HTTP/1.1\r\nhost: localhost\r\nhost: evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\nhost localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nhost: \xff\xfe\r\n\r\n",
        b"GET / HTTP/1.1\r\nhost: localhost\r\nx: a\0b\r\n\r\n",
        b"GET / HTTP/1.1\r\nhost: localhost\r\n folded: x\r\n\r\n",
        b"GET /\xc3\x28 HTTP/1.1\r\nhost: localhost\r\n\r\n",
        b"GET * HTTP/1.1\r\nhost: localhost\r\n\r\n",
        b"OPTIONS * HTTP/1.1\r\nhost: localhost\r\n\r\n",
        b"CONNECT localhost:22 HTTP/1.1\r\nhost: localhost\r\n\r\n",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"POST / HTTP/1.1\r\nhost: localhost\r\ncontent-length: 99999999999999\r\n\r\nx",
        b"POST / HTTP/1.1\r\nhost: localhost\r\ncontent-length: -1\r\n\r\n",
        b"POST / HTTP/1.1\r\nhost: localhost\r\ncontent-length: 1\r\ncontent-length: 2\r\n\r\nxx",
        b"POST / HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: chunked\r\n\r\nffffffffffffffffff\r\n",
        b"GET / HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: chunked\r\ncontent-length: 4\r\n\r\n0\r\n\r\n",
        b"GET / HTTP/1.1\r\nhost: localhost\r\nexpect: 100-continue\r\ncontent-length: 10\r\n\r\n",
        b"GET / HTTP/1.1\r\nhost: localhost\r\nupgrade: websocket\r\nconnection: upgrade\r\n\r\n",
    ]
    .map(<[u8]>::to_vec)
    .into();
    let head = b"GET / HTTP/1.1\r\nhost: localhost\r\n".to_vec();
    let bomb = |piece: &str, times: usize| [&head[..], piece.repeat(times).as_bytes()].concat();
    // Many headers, one endless header, an endless path, no end at all.
    all.push([bomb("x: y\r\n", 10_000), b"\r\n".to_vec()].concat());
    all.push([bomb("x: ", 1), vec![b'a'; 1 << 20], b"\r\n\r\n".to_vec()].concat());
    all.push([b"GET /".to_vec(), vec![b'a'; 1 << 20], b" HTTP/1.1\r\nhost: localhost\r\n\r\n".to_vec()].concat());
    all.push(vec![b'A'; 1 << 20]);
    // Many requests at once, on one connection.
    all.push(b"GET /none HTTP/1.1\r\nhost: localhost\r\n\r\n".repeat(200));
    // Each of these also in every shortened form.
    let base = b"GET /scene.s4d HTTP/1.1\r\nhost: localhost\r\nrange: bytes=0-1\r\n\r\n".to_vec();
    all.extend((0..base.len()).step_by(7).map(|n| base[..n].to_vec()));
    all.extend((0..base.len()).step_by(5).map(|n| {
        let mut mutant = base.clone();
        mutant[n] ^= 0x80 >> (n % 8);
        mutant
    }));
    all
}

#[test]
fn malformed_requests_are_refused_and_the_server_continues() {
    let server = of_bytes(b"scene");
    for request in broken_requests() {
        let reply = raw(&server, &request, true);
        let shown = String::from_utf8_lossy(&request[..request.len().min(80)]).into_owned();
        if !reply.is_empty() {
            assert!(reply.starts_with(b"HTTP/1."), "{shown:?} got {:?}", String::from_utf8_lossy(&reply));
        }
        assert_eq!(get(&server, "/scene.s4d").body, b"scene", "after {shown:?}");
    }
    let bomb = [b"GET / HTTP/1.1\r\nhost: localhost\r\n".to_vec(), b"x: y\r\n".repeat(1000), b"\r\n".to_vec()].concat();
    let reply = raw(&server, &bomb, false);
    assert!(reply.starts_with(b"HTTP/1.1 431") || reply.is_empty(), "{}", String::from_utf8_lossy(&reply));
}

/// Reads events until `enough` states so: pairs of id and data.
fn listen(server: &Running, last: Option<&str>, enough: impl Fn(&[(String, Value)]) -> bool) -> Vec<(String, Value)> {
    let mut stream = connect(server);
    let last = last.map(|l| format!("last-event-id: {l}\r\n")).unwrap_or_default();
    write!(stream, "GET /events HTTP/1.1\r\nhost: localhost\r\n{last}\r\n").unwrap();
    let (mut events, mut id) = (Vec::new(), String::new());
    let mut lines = BufReader::new(stream).lines();
    let deadline = Instant::now() + PATIENCE;
    while !enough(&events) {
        assert!(Instant::now() < deadline, "the news never came: {events:?}");
        let line = lines.next().expect("the stream goes on").unwrap();
        if let Some(told) = line.strip_prefix("id: ") {
            id = told.to_owned();
        } else if let Some(data) = line.strip_prefix("data: ") {
            events.push((id.clone(), serde_json::from_str(data).unwrap()));
        }
    }
    events
}

#[test]
fn events_reach_early_late_and_reconnecting_clients() {
    let server = start(Config { live: true, ..Config::default() });
    let step = |i: u32| server.publish(&News::Step(json!({"iteration": i, "loss": 0.5})));
    (0..3).for_each(step);
    server.set_scene(vec![1; 10].into(), &json!({"iteration": 2}));
    let early = listen(&server, None, |e| e.len() == 4);
    assert_eq!(early[0].1, json!({"kind": "step", "iteration": 0, "loss": 0.5}));
    assert_eq!(early[3].1, json!({"kind": "snapshot", "version": 1, "iteration": 2}));
    // Away for a while.
    (3..5).for_each(step);
    server.set_scene(vec![2; 20].into(), &json!({"iteration": 4}));
    server.set_scene(vec![3; 30].into(), &json!({"iteration": 5}));
    server.publish(&News::Done(json!({"seconds": 1.5})));
    let done = |e: &[(String, Value)]| e.last().is_some_and(|(_, v)| v["kind"] == "done");
    let again = listen(&server, Some(&early[3].0), done);
    let kinds: Vec<&str> = again.iter().map(|(_, v)| v["kind"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["step", "step", "snapshot", "done"], "what was missed, and the newest scene only");
    let late = listen(&server, None, done);
    assert_eq!(late.len(), 7);
    let all: Value = serde_json::from_slice(&get(&server, "/metrics.json").body).unwrap();
    assert_eq!(all["news"].as_array().unwrap().len(), 7);
    assert_eq!(get(&server, "/scene.s4d").body, [3; 30]);
    assert_eq!(get(&server, "/scene.s4d?v=2").body, [2; 20], "a page that is reading it may finish");
    assert_eq!(get(&server, "/scene.s4d?v=1").status, 410);
    server.stop();
}

#[test]
fn events_arrive_while_a_client_listens() {
    let server = start(Config { live: true, ..Config::default() });
    std::thread::scope(|scope| {
        let heard = scope.spawn(|| listen(&server, None, |e| e.len() == 30));
        for i in 0..30 {
            server.publish(&News::Step(json!({ "iteration": i })));
            std::thread::sleep(Duration::from_millis(5));
        }
        let heard = heard.join().unwrap();
        let order: Vec<u64> = heard.iter().map(|(_, v)| v["iteration"].as_u64().unwrap()).collect();
        assert_eq!(order, (0..30).collect::<Vec<_>>());
    });
}

#[test]
fn a_thousand_connections_do_not_slow_the_publisher() {
    const CONNECTIONS: usize = 1000;
    const NEWS: usize = 2000;
    let server = start(Config { live: true, background: true, ..Config::default() });
    server.set_scene(bytes(4 << 20).into(), &json!({}));
    // A quarter each: idle, half a request, listening without reading, requesting much without reading.
    let requests: [&[u8]; 4] = [
        b"",
        b"GET / HTTP/1.1\r\nhost: loc",
        b"GET /events HTTP/1.1\r\nhost: localhost\r\n\r\n",
        b"GET /scene.s4d HTTP/1.1\r\nhost: localhost\r\n\r\n",
    ];
    let mut held = Vec::new();
    for i in 0..CONNECTIONS {
        // The test's own process holds both ends: where the system allows fewer files, fewer must do.
        let Ok(mut stream) = TcpStream::connect(server.address()) else { break };
        let _ = stream.write_all(requests[i % 4]);
        held.push(stream);
    }
    assert!(held.len() > 300, "only {} connections could be made", held.len());
    let started = Instant::now();
    let mut longest = Duration::ZERO;
    for i in 0..NEWS {
        let one = Instant::now();
        server.publish(&News::Step(json!({"iteration": i, "loss": 0.1})));
        if i % 100 == 0 {
            server.set_scene(bytes(1000).into(), &json!({ "iteration": i }));
        }
        longest = longest.max(one.elapsed());
    }
    let all = started.elapsed();
    // Measured: some 10 ms in all. A thousand times that would be a queue that blocks.
    assert!(all < Duration::from_secs(10), "{NEWS} news took {all:?}, the longest {longest:?}");
    drop(held);
    assert_eq!(get(&server, "/config.json").status, 200, "it serves on");
    let begun = Instant::now();
    server.stop();
    assert!(begun.elapsed() < Duration::from_secs(10), "it stops in time");
}

#[test]
fn an_idle_connection_is_closed_and_makes_room() {
    let server = of_bytes(b"x");
    let mut idle = connect(&server);
    idle.write_all(b"GET /config.json HTTP/1.1\r\nhost: localhost\r\n\r\n").unwrap();
    let mut reply = Vec::new();
    // Ends only because the server closes it.
    idle.read_to_end(&mut reply).unwrap();
    assert!(reply.starts_with(b"HTTP/1.1 200"));
}

#[test]
fn a_live_scene_is_replaced_whole() {
    let server = start(Config { live: true, ..Config::default() });
    server.set_scene(vec![0; 500_000].into(), &json!({}));
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut n = 1u8;
            while !stop.load(Ordering::Relaxed) {
                server.set_scene(Arc::from(vec![n; 500_000]), &json!({}));
                n = n.wrapping_add(1);
            }
        });
        for _ in 0..50 {
            let body = get(&server, "/scene.s4d").body;
            assert!(body.len() == 500_000 && body.iter().all(|b| *b == body[0]), "two versions were mixed");
        }
        stop.store(true, Ordering::Relaxed);
    });
}

#[test]
fn a_port_in_use_is_an_error_or_the_next_port_is_used() {
    let first = Server::start(Config::default()).unwrap();
    let second = Server::start(Config::default()).unwrap();
    assert_ne!(first.address().port(), second.address().port());
    let port = first.address().port();
    let error = Server::start(Config { port: Some(port), ..Config::default() }).unwrap_err().to_string();
    assert!(error.contains(&port.to_string()) && error.contains("--port"), "{error}");
    assert!(Server::start(Config { host: "no such host".into(), ..Config::default() }).is_err());
    first.stop();
    Server::start(Config { port: Some(port), ..Config::default() }).expect("a port is free again at once").stop();
}

/// What a page with leave to edit sends; it may be changed by more headers, of which the last of a name counts.
fn post(server: &Running, target: &str, headers: &[(&str, &str)], body: &[u8]) -> Reply {
    let length = body.len().to_string();
    let usual = [
        ("host", "localhost"),
        ("origin", "http://localhost"),
        ("x-splat4d-token", TOKEN),
        ("content-type", "application/json"),
        ("content-length", length.as_str()),
    ];
    let given = |name: &str| headers.iter().any(|(n, _)| *n == name);
    let mut request = format!("POST {target} HTTP/1.1\r\nconnection: close\r\n");
    for (name, value) in usual.iter().filter(|(n, _)| !given(n)).chain(headers).filter(|(_, v)| !v.is_empty()) {
        request += &format!("{name}: {value}\r\n");
    }
    // A page that announced more than it sent is disconnected.
    let reply = raw(server, &[(request + "\r\n").as_bytes(), body].concat(), given("content-length"));
    let end = reply.windows(4).position(|w| w == b"\r\n\r\n").expect("an answer has a head");
    let head = String::from_utf8(reply[..end].to_vec()).unwrap();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    Reply { status, head, body: reply[end + 4..].to_vec() }
}

const TOKEN: &str = "0123456789abcdef0123456789abcdef";

fn editor(asked: &Arc<std::sync::Mutex<Vec<Value>>>) -> Running {
    let asked = asked.clone();
    let editing = Editing::new(TOKEN.into(), move |value| {
        asked.lock().unwrap().push(value.clone());
        assert!(value["do"] != "panic", "as it was asked to");
        if value["do"] == "fail" {
            return Err(splat4d::Error::input("there is nothing to do").remedy("Give a step"));
        }
        let scene = (value["do"] == "bake").then(|| vec![7; 10].into());
        Ok(EditResponse { result: json!({"heard": value}), scene })
    });
    start(Config { content: Content::Bytes(bytes(1000).into()), editing: Some(editing), ..Config::default() })
}

#[test]
fn a_page_with_the_token_edits() {
    let asked = Arc::default();
    let server = editor(&asked);
    let told = |body: &str| {
        let reply = post(&server, "/edit", &[("sec-fetch-site", "same-origin")], body.as_bytes());
        (reply.status, serde_json::from_slice::<Value>(&reply.body).unwrap_or_default())
    };
    assert_eq!(told(r#"{"do": "x"}"#), (200, json!({"heard": {"do": "x"}})));
    assert_eq!(told(r#"{"do": "bake"}"#).1["version"], 2, "the scene that pages see is the new one");
    assert_eq!(get(&server, "/scene.s4d?v=2").body, [7; 10]);
    let (status, error) = told(r#"{"do": "fail"}"#);
    assert_eq!((status, error["error"].as_str()), (422, Some("there is nothing to do. Give a step")));
    assert_eq!(told(r#"{"do": "panic"}"#).0, 500);
    assert_eq!(told(r#"{"do": "x"}"#).0, 200, "it goes on");
    let config: Value = serde_json::from_slice(&get(&server, "/config.json").body).unwrap();
    assert_eq!(config["edit"], true);
    assert!(!config.to_string().contains(TOKEN), "whoever may look may not edit");
}

#[test]
fn edits_need_token_and_origin() {
    let asked = Arc::default();
    let server = editor(&asked);
    let good = br#"{"do": "x"}"#;
    let mut tried = 0;
    let mut refused = |status: u16, target: &str, headers: &[(&str, &str)], body: &[u8]| {
        let reply = post(&server, target, headers, body);
        assert_eq!(reply.status, status, "{target} {headers:?}: {}", String::from_utf8_lossy(&reply.body));
        assert!(!String::from_utf8_lossy(&reply.body).contains(TOKEN));
        assert!(reply.header("access-control-allow-origin").is_none());
        tried += 1;
    };
    let wrong = "0123456789abcdef0123456789abcdeF";
    for token in ["", wrong, "x", &TOKEN[1..], &format!("{TOKEN}0")] {
        refused(403, "/edit", &[("x-splat4d-token", token)], good);
    }
    refused(403, "/edit", &[("x-splat4d-token", TOKEN), ("X-Splat4d-Token", wrong)], good);
    refused(403, &format!("/edit?token={TOKEN}"), &[("x-splat4d-token", "")], good);
    for origin in ["", "null", "http://evil.example", "http://localhost:81", "https://localhost.evil.example"] {
        refused(403, "/edit", &[("origin", origin)], good);
    }
    refused(403, "/edit", &[("host", "evil.example"), ("origin", "http://evil.example")], good);
    for site in ["cross-site", "same-site", "none"] {
        refused(403, "/edit", &[("sec-fetch-site", site)], good);
    }
    for kind in ["", "text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=x"] {
        refused(415, "/edit", &[("content-type", kind)], good);
    }
    refused(413, "/edit", &[("content-length", "1048577")], good);
    refused(413, "/edit", &[("content-length", "99999999999999")], good);
    let chunk = [format!("{:x}\r\n", (1 << 20) + 1).into_bytes(), vec![b' '; (1 << 20) + 1], b"\r\n0\r\n\r\n".to_vec()]
        .concat();
    refused(413, "/edit", &[("transfer-encoding", "chunked"), ("content-length", "")], &chunk);
    for body in [&b"not JSON"[..], b"", b"{\"do\": \"x\"", b"\xff\xfe{}", b"[edit]\ndo = 1"] {
        refused(400, "/edit", &[], body);
    }
    refused(400, "/edit", &[("content-length", "400")], good);
    for target in
        ["/edit/", "//edit", "/Edit", "/%65dit", "/./edit", "/edit/../edit", "/player/edit", "/scene.s4d", "/"]
    {
        refused(405, target, &[], good);
    }
    assert!(tried > 30 && asked.lock().unwrap().is_empty(), "none of it reached the program");
    for method in ["PUT", "DELETE", "PATCH", "OPTIONS"] {
        let headers =
            [("origin", "http://localhost"), ("x-splat4d-token", TOKEN), ("content-type", "application/json")];
        assert_eq!(ask(&server, method, "/edit", &headers).status, 405, "{method}");
    }
    assert_eq!(get(&server, "/edit").status, 404);
    assert_eq!(get(&server, "/scene.s4d").body, bytes(1000), "the scene is what it was");
}

#[test]
fn posts_are_refused_unless_editing_is_enabled() {
    let server = of_bytes(&bytes(10));
    assert_eq!(post(&server, "/edit", &[], br#"{"do": "x"}"#).status, 405);
    let config: Value = serde_json::from_slice(&get(&server, "/config.json").body).unwrap();
    assert_eq!(config["edit"], Value::Null);
}

#[test]
fn points_are_sent_by_the_rules_of_edits_from_a_page_of_their_own() {
    let assist = Editing::new(TOKEN.into(), |value| Ok(EditResponse { result: json!({"got": value}), scene: None }));
    let server = start(Config { assist: Some(assist), ..Config::default() });
    let page = get(&server, "/");
    assert!(String::from_utf8_lossy(&page.body).contains("assist.js") || page.header("content-encoding").is_some());
    for headers in [&[("x-splat4d-token", "0123")][..], &[("origin", "http://evil.example")]] {
        assert_eq!(post(&server, "/assist", headers, b"{}").status, 403, "{headers:?}");
    }
    assert_eq!(post(&server, "/assist", &[], b"{}").body, br#"{"got":{}}"#);
    assert_eq!(post(&server, "/edit", &[], b"{}").status, 405);
    let player = start(Config::default());
    assert_eq!(post(&player, "/assist", &[], b"{}").status, 405);
    assert!(!String::from_utf8_lossy(&get(&player, "/").body).contains("assist.js"));
}

#[test]
fn a_run_is_controlled_by_the_rules_of_edits() {
    let asked: Arc<std::sync::Mutex<Vec<Value>>> = Arc::default();
    let heard = asked.clone();
    let control = Editing::new(TOKEN.into(), move |value| {
        heard.lock().unwrap().push(value);
        Ok(EditResponse { result: json!({"state": "paused"}), scene: None })
    });
    let server = start(Config { live: true, control: Some(control), ..Config::default() });
    let pause = br#"{"do": "pause"}"#;
    for headers in [[("x-splat4d-token", "")], [("origin", "http://evil.example")], [("sec-fetch-site", "cross-site")]]
    {
        assert_eq!(post(&server, "/control", &headers, pause).status, 403, "{headers:?}");
    }
    assert_eq!(post(&server, "/edit", &[], pause).status, 405, "permission to control is none to edit");
    assert!(asked.lock().unwrap().is_empty(), "none of it reached the program");
    assert_eq!(post(&server, "/control", &[], pause).body, br#"{"state":"paused"}"#);
    assert_eq!(*asked.lock().unwrap(), [json!({"do": "pause"})]);
    let config: Value = serde_json::from_slice(&get(&server, "/config.json").body).unwrap();
    assert_eq!((&config["control"], &config["edit"]), (&json!(true), &Value::Null));
}

#[test]
fn photos_are_served_by_camera_and_time_and_no_other_file() {
    let photos = Photos::new(|wanted| {
        (wanted.view < 2).then(|| Photo { jpeg: vec![wanted.view as u8, wanted.side as u8], time: wanted.time + 0.25 })
    });
    let server = start(Config { photos: Some(photos), ..Config::default() });
    let reply = get(&server, "/photo?view=1&t=0.5&side=64");
    assert_eq!((reply.status, &reply.body[..]), (200, &[1, 64][..]));
    assert_eq!((reply.header("content-type"), reply.header("x-splat4d-time")), (Some("image/jpeg"), Some("0.75")));
    for bad in ["/photo?view=2", "/photo?view=../x", "/photo?file=/etc/passwd", "/photo/1"] {
        assert_eq!(get(&server, bad).status, 404, "{bad}");
    }
    assert_eq!(get(&of_bytes(&bytes(10)), "/photo?view=0").status, 404, "only where there are photos");
}
