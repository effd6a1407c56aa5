//! The body of a response: bytes in memory, or a bounded channel that a task fills.

use http_body::{Frame, SizeHint};
use hyper::body::Bytes;
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};
use tokio::sync::mpsc;

/// Chunks that wait for a client: one on its way and one behind it.
const WAITING: usize = 1;

/// Body of a response.
#[derive(Debug)]
pub(crate) enum Body {
    /// Bytes that are there.
    Bytes(Bytes),
    /// Chunks of `left` bytes in all, or of unknown length.
    Stream { chunks: mpsc::Receiver<io::Result<Bytes>>, left: Option<u64> },
}

impl Body {
    pub(crate) fn empty() -> Self {
        Self::Bytes(Bytes::new())
    }

    /// A body that a task fills; dropping it ends the task at its next chunk.
    pub(crate) fn stream(length: Option<u64>) -> (mpsc::Sender<io::Result<Bytes>>, Self) {
        let (sender, chunks) = mpsc::channel(WAITING);
        (sender, Self::Stream { chunks, left: length })
    }
}

impl From<Bytes> for Body {
    fn from(bytes: Bytes) -> Self {
        Self::Bytes(bytes)
    }
}

impl http_body::Body for Body {
    type Data = Bytes;
    type Error = io::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<io::Result<Frame<Bytes>>>> {
        match &mut *self {
            Self::Bytes(bytes) if bytes.is_empty() => Poll::Ready(None),
            Self::Bytes(bytes) => Poll::Ready(Some(Ok(Frame::data(std::mem::take(bytes))))),
            Self::Stream { chunks, left } => match chunks.poll_recv(cx) {
                Poll::Pending => Poll::Pending,
                Poll::Ready(None) => Poll::Ready(None),
                Poll::Ready(Some(chunk)) => {
                    if let (Ok(bytes), Some(left)) = (&chunk, left) {
                        *left = left.saturating_sub(bytes.len() as u64);
                    }
                    Poll::Ready(Some(chunk.map(Frame::data)))
                }
            },
        }
    }

    fn is_end_stream(&self) -> bool {
        matches!(self, Self::Bytes(bytes) if bytes.is_empty()) || matches!(self, Self::Stream { left: Some(0), .. })
    }

    fn size_hint(&self) -> SizeHint {
        match self {
            Self::Bytes(bytes) => SizeHint::with_exact(bytes.len() as u64),
            Self::Stream { left: Some(left), .. } => SizeHint::with_exact(*left),
            Self::Stream { left: None, .. } => SizeHint::default(),
        }
    }
}
