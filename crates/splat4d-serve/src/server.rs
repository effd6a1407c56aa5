//! Starting, running and stopping: one thread with its own runtime, and bounds on the memory that clients can make it
//! use.

use crate::answer::{Shared, answer};
use crate::given::{Config, DEFAULT_PORT, News};
use crate::guard::Guard;
use crate::scene::Scene;
use crate::write_timeout::{Clock, Either, WriteTimeout, either};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use serde_json::Value;
use splat4d::{Error, Result};
use std::convert::Infallible;
use std::future::{Future, poll_fn};
use std::io;
use std::net::{SocketAddr, ToSocketAddrs};
use std::pin::pin;
use std::sync::Arc;
use std::task::Poll;
use std::thread::JoinHandle;
use std::time::Duration;
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio::runtime::Runtime;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

/// Ports tried behind the default one where it is taken.
const NEXT_PORTS: u16 = 20;
/// Connections served at a time. Those beyond wait in the system's queue, where they cost the program nothing: a
/// program may usually hold 1,024 files, and a run that trains needs some of them.
const MAX_CONNECTIONS: usize = 256;
/// Connections that the system lets wait; beyond these it refuses.
const BACKLOG: u32 = 1024;
/// A request's head must be complete in this time; an idle connection is closed after it.
const HEAD_TIME: Duration = Duration::from_secs(5);
/// Most bytes of a request's head; browsers send one or two thousand.
const MAX_HEAD: usize = 16 << 10;
/// Most header lines of a request.
const MAX_HEADERS: usize = 64;
/// Threads that read files.
const READERS: usize = 2;
/// Time for responses in flight to finish when the server stops.
const GRACE: Duration = Duration::from_millis(500);
/// Pause after the system could not open a connection.
const NO_ROOM: Duration = Duration::from_millis(100);
/// How much the server's thread steps back for training (19 is most): a page still loads at once, training never waits.
#[cfg(target_os = "linux")]
const NICE: i32 = 10;

/// Makes [`Running`] servers.
#[derive(Debug)]
pub struct Server;

/// A server at work; dropping it stops it.
#[derive(Debug)]
pub struct Running {
    shared: Arc<Shared>,
    address: SocketAddr,
    url: String,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Starts serving on a thread of its own.
    ///
    /// Errors: the scene cannot be opened, the foreign address is none, the host is not one of this machine's, the port
    /// is taken or needs rights, the system has no thread left.
    pub fn start(config: Config) -> Result<Running> {
        let scene = Scene::new(config.content)?;
        let foreign = config.foreign.map(|url| origin(&url).map(|origin| (url, origin))).transpose()?;
        let runtime = runtime(config.background).map_err(|e| Error::environment("the server cannot be started", e))?;
        let listener = {
            let _inside = runtime.enter();
            listen(&config.host, config.port)?
        };
        let address = listener.local_addr().map_err(|e| Error::environment("the server has no address", e))?;
        let guard = Guard::new(&config.host, !address.ip().is_loopback());
        let mut shared = Shared::new(scene, guard, config.about, config.live, foreign);
        shared.player_folder = config.player_folder;
        (shared.editing, shared.control) = (config.editing, config.control);
        (shared.assist, shared.photos) = (config.assist, config.photos);
        let shared = Arc::new(shared);
        let (stop, stopped) = watch::channel(false);
        let at_work = shared.clone();
        let thread = std::thread::Builder::new()
            .name("splat4d-serve".into())
            .spawn(move || {
                step_back(config.background);
                runtime.block_on(accept(listener, at_work, stopped));
                runtime.shutdown_timeout(GRACE);
            })
            .map_err(|e| Error::environment("the server's thread cannot be started", e))?;
        let url = url(&config.host, address);
        Ok(Running { shared, address, url, stop, thread: Some(thread) })
    }
}

impl Running {
    /// The page's address, as a browser on this machine opens it.
    pub fn url(&self) -> &str {
        &self.url
    }

    /// Listening address.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Sends news to all pages. Never waits, never fails: pages that connect later receive it then.
    pub fn publish(&self, news: &News) {
        self.shared.hub.publish(news);
    }

    /// Replaces the scene and notifies all pages, with the fields of `about` (such as `{"iteration": 500}`). Returns
    /// the version's number. Pages that still read the version before it can finish.
    pub fn set_scene(&self, bytes: Arc<[u8]>, about: &Value) -> u64 {
        let version = self.shared.scene.set(bytes);
        self.shared.hub.snapshot(version, about);
        version
    }

    /// Stops: responses in flight get half a second to finish.
    pub fn stop(mut self) {
        self.end();
    }

    fn end(&mut self) {
        self.shared.hub.close();
        self.stop.send_replace(true);
        if let Some(thread) = self.thread.take() {
            // A panic there is our bug and must not end the caller's work.
            let _ = thread.join();
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.end();
    }
}

fn runtime(background: bool) -> io::Result<Runtime> {
    tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .enable_time()
        .max_blocking_threads(READERS)
        .thread_name("splat4d-serve-read")
        .on_thread_start(move || step_back(background))
        .build()
}

/// Lowers this thread's priority. If that fails the priority is unchanged.
fn step_back(background: bool) {
    #[cfg(target_os = "linux")]
    if background {
        // On Linux the priority of "this process" is this thread's.
        let _ = rustix::process::setpriority_process(None, NICE);
    }
    #[cfg(not(target_os = "linux"))]
    let _ = background;
}

fn listen(host: &str, port: Option<u16>) -> Result<TcpListener> {
    let first = port.unwrap_or(DEFAULT_PORT);
    let place = |port: u16| format!("{host}:{port}");
    let bare = host.trim_matches(['[', ']']);
    let address = (bare, first).to_socket_addrs().ok().and_then(|mut all| all.next());
    let Some(mut address) = address else {
        return Err(Error::input("not a name or address of this machine")
            .at(host)
            .remedy("Use --host with an address of this machine, or leave it out to serve this machine only."));
    };
    let ports = match port {
        Some(port) => vec![port],
        None => (first..=first + NEXT_PORTS).chain([0]).collect(),
    };
    let mut failed = None;
    for port in ports {
        address.set_port(port);
        match bind(address) {
            Ok(listener) => return Ok(listener),
            Err(error) => {
                let taken = error.kind() == io::ErrorKind::AddrInUse;
                failed = Some((port, error));
                if !taken {
                    break;
                }
            }
        }
    }
    let (port, error) = failed.expect("at least one port was tried");
    Err(Error::environment("cannot listen", error)
        .at(place(port))
        .remedy("Choose another --port (0: any free one), and a --host that is an address of this machine."))
}

fn bind(address: SocketAddr) -> io::Result<TcpListener> {
    let socket = if address.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() }?;
    // So that a server just stopped can be started again at the same port; elsewhere the option means something else.
    #[cfg(unix)]
    socket.set_reuseaddr(true)?;
    socket.bind(address)?;
    socket.listen(BACKLOG)
}

/// The address to open. One that represents all of the machine's is opened at loopback.
fn url(host: &str, address: SocketAddr) -> String {
    let port = address.port();
    let bare = host.trim_matches(['[', ']']);
    match (address.ip().is_unspecified(), bare.contains(':')) {
        (true, _) => format!("http://localhost:{port}/"),
        (false, true) => format!("http://[{bare}]:{port}/"),
        (false, false) => format!("http://{bare}:{port}/"),
    }
}

/// The origin of an http(s) address, in plain characters: it becomes a part of a header.
fn origin(url: &str) -> Result<String> {
    let (scheme, rest) = url.split_once("://").unwrap_or_default();
    let authority = rest.split(['/', '?', '#']).next().unwrap_or_default();
    let plain = authority.bytes().all(|b| b.is_ascii_alphanumeric() || b"-.:[]".contains(&b));
    let clean = url.bytes().all(|b| b.is_ascii_graphic());
    if ["http", "https"].contains(&scheme) && !authority.is_empty() && plain && clean {
        return Ok(format!("{scheme}://{authority}"));
    }
    Err(Error::input("invalid address of a web server").at(url).remedy("Write for instance https://example.org/a.s4d."))
}

async fn accept(listener: TcpListener, shared: Arc<Shared>, mut stopped: watch::Receiver<bool>) {
    let slots = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let next = async {
            let slot = slots.clone().acquire_owned().await.expect("the slots are never closed");
            (slot, listener.accept().await)
        };
        match either(stopped.changed(), next).await {
            Either::First(_) => break,
            Either::Second((slot, Ok((stream, _)))) => {
                tokio::spawn(serve(stream, shared.clone(), slot, stopped.clone()));
            }
            Either::Second((_, Err(_))) => tokio::time::sleep(NO_ROOM).await,
        }
    }
    drop(listener);
    let all = u32::try_from(MAX_CONNECTIONS).expect("a small number");
    let _ = tokio::time::timeout(GRACE, slots.acquire_many(all)).await;
}

/// Serves one connection until it ends, stalls, or the server stops.
async fn serve(stream: TcpStream, shared: Arc<Shared>, slot: OwnedSemaphorePermit, mut stopped: watch::Receiver<bool>) {
    // Small responses are sent at once; where that cannot be set, a little later.
    let _ = stream.set_nodelay(true);
    let service = service_fn(move |request: hyper::Request<_>| {
        let shared = shared.clone();
        let (request, body): (_, hyper::body::Incoming) = request.into_parts();
        async move { Ok::<_, Infallible>(answer(&shared, &request, body).await) }
    });
    let mut connection = pin!(
        http1::Builder::new()
            .timer(Clock)
            .header_read_timeout(HEAD_TIME)
            .max_buf_size(MAX_HEAD)
            .max_headers(MAX_HEADERS)
            .serve_connection(WriteTimeout::new(stream), service)
    );
    let mut stop = pin!(stopped.changed());
    let mut stopping = false;
    // Its errors are the client's: broken requests or disconnections.
    let _ = poll_fn(|cx| {
        if !stopping && stop.as_mut().poll(cx).is_ready() {
            stopping = true;
            connection.as_mut().graceful_shutdown();
        }
        match connection.as_mut().poll(cx) {
            Poll::Ready(done) => Poll::Ready(done),
            Poll::Pending => Poll::Pending,
        }
    })
    .await;
    drop(slot);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn origins_are_plain() {
        assert_eq!(origin("https://example.org/a/b.s4d?x=1").unwrap(), "https://example.org");
        assert_eq!(origin("http://[::1]:81").unwrap(), "http://[::1]:81");
        for bad in ["", "ftp://a/b", "https://", "//a", "https://a;script-src *", "https://a b/", "https://u@a/", "x"] {
            assert!(origin(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn addresses_can_be_opened() {
        let url = |host: &str, ip: &str| url(host, format!("{ip}:81").parse().unwrap());
        assert_eq!(url("127.0.0.1", "127.0.0.1"), "http://127.0.0.1:81/");
        assert_eq!(url("0.0.0.0", "0.0.0.0"), "http://localhost:81/");
        assert_eq!(url("box", "10.0.0.7"), "http://box:81/");
        assert_eq!(url("::1", "[::1]"), "http://[::1]:81/");
    }
}
