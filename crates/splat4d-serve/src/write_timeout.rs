//! A connection that is closed if the client stops reading. The HTTP library limits the time of a request's head, but
//! not of a client that requests much and then reads nothing.

use hyper::rt::{Read, ReadBufCursor, Write};
use std::future::{Future, poll_fn};
use std::io;
use std::pin::{Pin, pin};
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::time::{Instant, Sleep};

/// A client must take [`LEAST`] bytes in this time, or it is cut off.
const WINDOW: Duration = Duration::from_secs(20);
/// 3 kB a second: a tenth of the slowest line on which a scene is watchable.
const LEAST: usize = 64 << 10;
/// Bytes that are read at once. Requests are heads of at most 16 KiB and small lists of edits.
const BLOCK: usize = 8 << 10;

/// A stream that fails where its reader stalls.
#[derive(Debug)]
pub(crate) struct WriteTimeout {
    stream: TcpStream,
    window: Duration,
    /// Runs while bytes wait; none where the client has taken everything.
    clock: Option<Pin<Box<Sleep>>>,
    taken: usize,
}

impl WriteTimeout {
    pub(crate) fn new(stream: TcpStream) -> Self {
        Self::with_window(stream, WINDOW)
    }

    fn with_window(stream: TcpStream, window: Duration) -> Self {
        Self { stream, window, clock: None, taken: 0 }
    }

    /// Returns the result of a write, and keeps the time.
    fn judge(&mut self, cx: &mut Context<'_>, written: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        match written {
            Poll::Ready(Ok(n)) => {
                self.taken += n;
                if self.taken >= LEAST {
                    self.clock = None;
                }
                Poll::Ready(Ok(n))
            }
            Poll::Ready(Err(e)) => Poll::Ready(Err(e)),
            Poll::Pending => {
                let window = self.window;
                let clock = self.clock.get_or_insert_with(|| {
                    self.taken = 0;
                    Box::pin(tokio::time::sleep_until(Instant::now() + window))
                });
                match clock.as_mut().poll(cx) {
                    Poll::Ready(()) => Poll::Ready(Err(io::ErrorKind::TimedOut.into())),
                    Poll::Pending => Poll::Pending,
                }
            }
        }
    }
}

/// Which of two came first.
#[derive(Debug)]
pub(crate) enum Either<A, B> {
    First(A),
    Second(B),
}

/// Waits for whichever of two is ready first; the other is dropped.
pub(crate) async fn either<A: Future, B: Future>(a: A, b: B) -> Either<A::Output, B::Output> {
    let (mut a, mut b) = (pin!(a), pin!(b));
    poll_fn(|cx| match a.as_mut().poll(cx) {
        Poll::Ready(value) => Poll::Ready(Either::First(value)),
        Poll::Pending => b.as_mut().poll(cx).map(Either::Second),
    })
    .await
}

impl Read for WriteTimeout {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, mut out: ReadBufCursor<'_>) -> Poll<io::Result<()>> {
        let mut block = [0; BLOCK];
        let room = out.remaining().min(BLOCK);
        let mut bytes = ReadBuf::new(&mut block[..room]);
        Pin::new(&mut self.stream).poll_read(cx, &mut bytes).map_ok(|()| out.put_slice(bytes.filled()))
    }
}

impl Write for WriteTimeout {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(cx, buf);
        self.judge(cx, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(cx, bufs);
        self.judge(cx, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

/// The clock by which the HTTP library limits the time of a request's head.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Clock;

struct Wait(Pin<Box<Sleep>>);

impl hyper::rt::Timer for Clock {
    fn sleep(&self, duration: Duration) -> Pin<Box<dyn hyper::rt::Sleep>> {
        Box::pin(Wait(Box::pin(tokio::time::sleep(duration))))
    }

    fn sleep_until(&self, deadline: std::time::Instant) -> Pin<Box<dyn hyper::rt::Sleep>> {
        Box::pin(Wait(Box::pin(tokio::time::sleep_until(deadline.into()))))
    }
}

impl Future for Wait {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        self.0.as_mut().poll(cx)
    }
}

impl hyper::rt::Sleep for Wait {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_client_that_reads_nothing_is_disconnected() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
            let mut client = std::net::TcpStream::connect(listener.local_addr().unwrap()).unwrap();
            let (stream, _) = listener.accept().await.unwrap();
            let mut timed = WriteTimeout::with_window(stream, Duration::from_millis(50));
            let bytes = vec![7u8; 1 << 20];
            let mut sent = 0;
            let error = loop {
                match poll_fn(|cx| Pin::new(&mut timed).poll_write(cx, &bytes)).await {
                    Ok(n) => sent += n,
                    Err(error) => break error,
                }
                assert!(sent < 1 << 30, "a socket's buffer ends somewhere");
            };
            assert_eq!(error.kind(), io::ErrorKind::TimedOut);
            drop(timed);
            let mut got = Vec::new();
            io::Read::read_to_end(&mut client, &mut got).unwrap();
            assert_eq!(got.len(), sent);
        });
    }
}
