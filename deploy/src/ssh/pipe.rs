//! The bounded buffers between a channel's user and the thread that owns the session.

use std::collections::VecDeque;
use std::fmt;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};

use rustix::event::{EventfdFlags, eventfd};
use tokio::io::ReadBuf;

use super::error::SshError;

/// Bytes that wait in each direction of one channel.
const BUFFER_MAX: usize = 256 << 10;
/// Bytes kept of what a command writes to standard error: the last ones.
pub(super) const STDERR_MAX: usize = 64 << 10;

/// Wakes the thread that owns a session.
#[derive(Debug)]
pub(super) struct Bell(OwnedFd);

impl Bell {
    pub(super) fn new() -> io::Result<Self> {
        Ok(Self(eventfd(
            0,
            EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK,
        )?))
    }

    pub(super) fn ring(&self) {
        // It fails only when the counter is full, and then it is ringing.
        let _ringing = rustix::io::write(&self.0, &1_u64.to_ne_bytes());
    }

    pub(super) fn hush(&self) {
        let _silent = rustix::io::read(&self.0, &mut [0_u8; 8]);
    }
}

impl AsFd for Bell {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

/// How a command ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct End {
    /// Its exit code; none when a signal ended it.
    pub(super) code: Option<i32>,
    pub(super) signal: Option<String>,
    pub(super) stderr: Vec<u8>,
}

/// One channel's two directions.
pub(super) struct Pipe {
    state: Mutex<State>,
    bell: Arc<Bell>,
}

#[derive(Default)]
struct State {
    /// From the host to the reader.
    inbound: Way,
    /// From the writer to the host.
    outbound: Way,
    /// The writer has closed its side.
    shut: bool,
    stderr: VecDeque<u8>,
    end: Option<Result<End, SshError>>,
    waiter: Option<Waker>,
    abandoned: bool,
}

/// One direction.
#[derive(Default)]
struct Way {
    bytes: VecDeque<u8>,
    /// The host gives or takes no more.
    over: bool,
    /// The user that waits for bytes or for room.
    waker: Option<Waker>,
}

impl Pipe {
    pub(super) fn new(bell: Arc<Bell>) -> Self {
        Self {
            state: Mutex::default(),
            bell,
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    // The user's side.

    pub(super) fn poll_read(
        &self,
        cx: &Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let mut state = self.state();
        let was_full = state.inbound.bytes.len() >= BUFFER_MAX / 2;
        let mut taken = 0;
        for part in [
            state.inbound.bytes.as_slices().0,
            state.inbound.bytes.as_slices().1,
        ] {
            let part = &part[..part.len().min(buf.remaining())];
            buf.put_slice(part);
            taken += part.len();
        }
        state.inbound.bytes.drain(..taken);
        if taken > 0 || buf.remaining() == 0 {
            if was_full {
                self.bell.ring();
            }
            return Poll::Ready(Ok(()));
        }
        if let Some(Err(error)) = &state.end {
            return Poll::Ready(Err(io::Error::new(
                io::ErrorKind::ConnectionReset,
                error.clone(),
            )));
        }
        if state.inbound.over {
            return Poll::Ready(Ok(()));
        }
        state.inbound.waker = Some(cx.waker().clone());
        Poll::Pending
    }

    pub(super) fn poll_write(&self, cx: &Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let mut state = self.state();
        if let Some(error) = state.broken() {
            return Poll::Ready(Err(error));
        }
        let room = BUFFER_MAX.saturating_sub(state.outbound.bytes.len());
        if room == 0 && !bytes.is_empty() {
            state.outbound.waker = Some(cx.waker().clone());
            return Poll::Pending;
        }
        let taken = room.min(bytes.len());
        state.outbound.bytes.extend(&bytes[..taken]);
        drop(state);
        self.bell.ring();
        Poll::Ready(Ok(taken))
    }

    /// Ready when the thread has taken everything.
    pub(super) fn poll_flush(&self, cx: &Context<'_>) -> Poll<io::Result<()>> {
        let mut state = self.state();
        if state.outbound.bytes.is_empty() {
            return Poll::Ready(Ok(()));
        }
        if let Some(error) = state.broken() {
            return Poll::Ready(Err(error));
        }
        state.outbound.waker = Some(cx.waker().clone());
        Poll::Pending
    }

    /// No more will be written: the host sees the end of its standard input after what was written.
    pub(super) fn shut(&self) {
        self.state().shut = true;
        self.bell.ring();
    }

    pub(super) fn abandon(&self) {
        let mut state = self.state();
        state.abandoned = true;
        state.inbound.bytes.clear();
        state.outbound.bytes.clear();
        drop(state);
        self.bell.ring();
    }

    pub(super) fn poll_end(&self, cx: &Context<'_>) -> Poll<Result<End, SshError>> {
        let mut state = self.state();
        if let Some(end) = state.end.clone() {
            return Poll::Ready(end);
        }
        state.waiter = Some(cx.waker().clone());
        Poll::Pending
    }

    // The thread's side.

    pub(super) fn is_abandoned(&self) -> bool {
        self.state().abandoned
    }

    /// How much may be put in.
    pub(super) fn room(&self) -> usize {
        BUFFER_MAX.saturating_sub(self.state().inbound.bytes.len())
    }

    pub(super) fn put(&self, bytes: &[u8]) {
        let mut state = self.state();
        if !state.abandoned {
            state.inbound.bytes.extend(bytes);
        }
        wake(&mut state.inbound.waker);
    }

    pub(super) fn put_stderr(&self, bytes: &[u8]) {
        let mut state = self.state();
        state.stderr.extend(bytes);
        let over = state.stderr.len().saturating_sub(STDERR_MAX);
        state.stderr.drain(..over);
    }

    /// Moves up to `max` bytes into `chunk`; whether the end of what will be written is reached.
    pub(super) fn take(&self, chunk: &mut Vec<u8>, max: usize) -> bool {
        let mut state = self.state();
        let count = state.outbound.bytes.len().min(max);
        chunk.extend(state.outbound.bytes.drain(..count));
        if count > 0 {
            wake(&mut state.outbound.waker);
        }
        state.shut && state.outbound.bytes.is_empty()
    }

    /// The host has sent everything.
    pub(super) fn end_inbound(&self) {
        let mut state = self.state();
        state.inbound.over = true;
        wake(&mut state.inbound.waker);
    }

    /// The command has ended, or the connection has.
    pub(super) fn end(&self, end: Result<(Option<i32>, Option<String>), SshError>) {
        let mut state = self.state();
        state.outbound.over = true;
        state.outbound.bytes.clear();
        if state.end.is_none() {
            let stderr = state.stderr.iter().copied().collect();
            state.end = Some(end.map(|(code, signal)| End {
                code,
                signal,
                stderr,
            }));
        }
        state.inbound.over = true;
        wake(&mut state.inbound.waker);
        wake(&mut state.outbound.waker);
        wake(&mut state.waiter);
    }
}

impl State {
    fn broken(&self) -> Option<io::Error> {
        if let Some(Err(error)) = &self.end {
            return Some(io::Error::new(
                io::ErrorKind::ConnectionReset,
                error.clone(),
            ));
        }
        let closed = self.outbound.over || self.shut;
        closed.then(|| io::Error::new(io::ErrorKind::BrokenPipe, "the command takes no more input"))
    }
}

impl fmt::Debug for Pipe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Pipe").finish_non_exhaustive()
    }
}

fn wake(waker: &mut Option<Waker>) {
    if let Some(waker) = waker.take() {
        waker.wake();
    }
}
