//! One command on a host as a pair of byte streams.

use std::fmt;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use super::error::SshError;
use super::pipe::{End, Pipe};
use super::system::Process;
use super::worker::Link;

/// A command's standard input and output as one stream.
///
/// `shutdown` is the half-close: the command sees the end of its input and may go on writing. Reading to the end gives every byte it wrote;
/// a lost connection is an [`io::Error`] whose source is an [`SshError`]. Dropping it closes the channel without waiting.
pub struct Channel(Inner);

enum Inner {
    Native(Native),
    System(Box<Process>),
}

/// A channel of a session, and what keeps the session alive.
struct Native {
    pipe: Arc<Pipe>,
    _handle: Arc<Handle>,
}

/// Lets the session's thread go when the last user of it has gone.
#[derive(Debug)]
pub(super) struct Handle(pub(super) Arc<Link>);

impl Drop for Handle {
    fn drop(&mut self) {
        self.0.leave();
    }
}

impl Drop for Native {
    fn drop(&mut self) {
        self.pipe.abandon();
    }
}

impl Channel {
    pub(super) fn native(pipe: Arc<Pipe>, handle: Arc<Handle>) -> Self {
        Self(Inner::Native(Native {
            pipe,
            _handle: handle,
        }))
    }

    pub(super) fn system(process: Process) -> Self {
        Self(Inner::System(Box::new(process)))
    }

    /// What the command wrote to its standard error, once its output has ended; the caller bounds the wait. Empty when
    /// the connection is lost.
    pub async fn complaint(&mut self) -> String {
        let end = self.end().await;
        let stderr = end.map_or_else(|_| Vec::new(), |end| end.stderr);
        String::from_utf8_lossy(&stderr).trim().to_owned()
    }

    /// Waits for the command's end, after its output was read. The caller bounds it.
    pub(super) async fn end(&mut self) -> Result<End, SshError> {
        match &mut self.0 {
            Inner::Native(native) => std::future::poll_fn(|cx| native.pipe.poll_end(cx)).await,
            Inner::System(process) => process.end().await,
        }
    }
}

impl AsyncRead for Channel {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        match &mut self.0 {
            Inner::Native(native) => native.pipe.poll_read(cx, buf),
            Inner::System(process) => Pin::new(&mut process.stdout).poll_read(cx, buf),
        }
    }
}

impl AsyncWrite for Channel {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        match &mut self.0 {
            Inner::Native(native) => native.pipe.poll_write(cx, bytes),
            Inner::System(process) => match &mut process.stdin {
                Some(stdin) => Pin::new(stdin).poll_write(cx, bytes),
                None => Poll::Ready(Err(io::ErrorKind::BrokenPipe.into())),
            },
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.0 {
            Inner::Native(native) => native.pipe.poll_flush(cx),
            Inner::System(process) => match &mut process.stdin {
                Some(stdin) => Pin::new(stdin).poll_flush(cx),
                None => Poll::Ready(Ok(())),
            },
        }
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.0 {
            Inner::Native(native) => {
                let _ = cx;
                native.pipe.shut();
            }
            // A pipe is closed by dropping it.
            Inner::System(process) => process.stdin = None,
        }
        Poll::Ready(Ok(()))
    }
}

impl fmt::Debug for Channel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.0 {
            Inner::Native(_) => "Channel(ssh2)",
            Inner::System(_) => "Channel(system)",
        })
    }
}
