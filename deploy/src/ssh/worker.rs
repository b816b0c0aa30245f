//! The thread that owns a session: it moves bytes between the channels' pipes and libssh2, and never waits for one channel alone.
//!
//! What libssh2 wants of whoever drives it without blocking:
//! - A packet that was sent in part is finished only by the same call with the same bytes, and until then nothing else is sent. So what a call
//!   has begun is called again until it is through, even when its user has gone.
//! - The packet of an end of file lies on libssh2's stack: it must go out whole, so it is sent only when the socket has room.
//! - Standard error shares the window of standard output: it is always read.
//! - A full pipe is not read, but the transport is, or the other channels and the host's keep-alive would starve.

use std::collections::VecDeque;
use std::os::fd::{AsFd as _, OwnedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use ssh2::Session;
use tokio::sync::{OwnedSemaphorePermit, oneshot};

use super::error::SshError;
use super::pipe::{Bell, Pipe};
use super::slot::{Slot, Turn, fatal, would_block};

/// What a host may send on one channel before we read it.
const WINDOW: u32 = 1 << 20;
const PACKET: u32 = 32 << 10;
/// How long the thread sleeps at most.
const PAUSE: Duration = Duration::from_secs(5);
/// The same without a channel. A host that asks whether we live (ClientAliveInterval) is not heard then, so it is told.
const IDLE_PAUSE: Duration = Duration::from_secs(1);
/// Rounds over all channels before the thread looks at new requests.
const ROUNDS_MAX: usize = 64;

/// What a channel is for.
#[derive(Clone, Debug)]
pub(super) enum Purpose {
    /// A command line that was validated.
    Exec(String),
    /// A connection from the host to another.
    Forward(String, u16),
}

/// A wish for a channel.
#[derive(Debug)]
pub(super) struct Request {
    pub(super) purpose: Purpose,
    pub(super) permit: OwnedSemaphorePermit,
    pub(super) reply: oneshot::Sender<Result<Arc<Pipe>, Refusal>>,
}

/// Why there is no channel.
#[derive(Debug)]
pub(super) enum Refusal {
    /// The host has no room for another one beside those that are open.
    Full(OwnedSemaphorePermit),
    /// It will not get better.
    Failed(SshError),
}

/// What the thread and the users of its session share.
#[derive(Debug)]
pub(super) struct Link {
    pub(super) bell: Arc<Bell>,
    host: String,
    requests: Mutex<VecDeque<Request>>,
    leaving: AtomicBool,
    lost: Mutex<Option<SshError>>,
}

impl Link {
    pub(super) fn new(host: &str) -> std::io::Result<Self> {
        Ok(Self {
            bell: Arc::new(Bell::new()?),
            host: host.to_owned(),
            requests: Mutex::default(),
            leaving: AtomicBool::new(false),
            lost: Mutex::default(),
        })
    }

    /// Asks for a channel; the reply comes from the thread, or from here when the session is over.
    pub(super) fn ask(&self, request: Request) {
        let lost = lock(&self.lost);
        if let Some(error) = lost.clone() {
            drop(request.reply.send(Err(Refusal::Failed(error))));
        } else {
            lock(&self.requests).push_back(request);
            self.bell.ring();
        }
    }

    /// Nobody will ask again.
    pub(super) fn leave(&self) {
        self.leaving.store(true, Ordering::Release);
        self.bell.ring();
    }
}

/// A session and its channels.
pub(super) struct Worker {
    session: Session,
    /// A second handle of the session's socket, to wait on.
    socket: OwnedFd,
    link: Arc<Link>,
    slots: Vec<Slot>,
    waiting: VecDeque<Request>,
    scratch: Vec<u8>,
}

impl Worker {
    /// A worker for a session that is authenticated.
    pub(super) fn new(session: Session, socket: OwnedFd, link: Arc<Link>) -> Self {
        session.set_blocking(false);
        session.set_keepalive(false, 1);
        Self {
            session,
            socket,
            link,
            slots: Vec::new(),
            waiting: VecDeque::new(),
            scratch: vec![0; 32 << 10],
        }
    }

    /// Serves the session until it is lost or nobody needs it.
    pub(super) fn run(mut self) {
        let lost = loop {
            self.link.bell.hush();
            self.waiting.append(&mut lock(&self.link.requests));
            let idle = self.slots.is_empty() && self.waiting.is_empty();
            if idle && self.link.leaving.load(Ordering::Acquire) {
                break "it was closed".to_owned();
            }
            let send = match self.serve() {
                Ok(send) => send,
                Err(cause) => break cause,
            };
            if let Err(cause) = self.wait(send) {
                break cause;
            }
        };
        self.end(lost);
    }

    /// Moves what can be moved; whether something waits for room in the socket.
    fn serve(&mut self) -> Result<bool, String> {
        for _ in 0..ROUNDS_MAX {
            let mut turn = self.open()?;
            let mut at = 0;
            while let Some(slot) = self.slots.get_mut(at) {
                let writable = writable(&self.socket);
                let one = slot.advance(&mut self.scratch, writable)?;
                turn = turn.and(one);
                if slot.is_over() {
                    // The permit goes back, so that who waits may ask.
                    drop(self.slots.swap_remove(at));
                } else {
                    at += 1;
                }
            }
            if !turn.moved {
                return Ok(turn.send);
            }
        }
        // Still moving: come back at once, after a look at new requests.
        self.link.bell.ring();
        Ok(false)
    }

    /// Opens the channel that is asked for first; libssh2 opens one at a time.
    fn open(&mut self) -> Result<Turn, String> {
        let Some(request) = self.waiting.front() else {
            return Ok(Turn::default());
        };
        let opened = match &request.purpose {
            Purpose::Exec(_) => self.session.channel_open("session", WINDOW, PACKET, None),
            Purpose::Forward(host, port) => self.session.channel_direct_tcpip(host, *port, None),
        };
        if let Err(error) = &opened {
            if would_block(error) {
                // What was begun is finished even if nobody waits for it any more.
                return Ok(Turn::sending(!writable(&self.socket)));
            }
            if fatal(error) {
                return Err(error.message().to_owned());
            }
        }
        let Some(request) = self.waiting.pop_front() else {
            return Ok(Turn::default());
        };
        match opened {
            Ok(channel) => {
                let pipe = Arc::new(Pipe::new(Arc::clone(&self.link.bell)));
                self.slots
                    .push(Slot::new(channel, pipe, request, &self.link.host));
            }
            Err(_) if !self.slots.is_empty() => {
                drop(request.reply.send(Err(Refusal::Full(request.permit))));
            }
            Err(error) => {
                let refused = SshError::Refused {
                    host: self.link.host.clone(),
                    what: match request.purpose {
                        Purpose::Exec(_) => "a channel".to_owned(),
                        Purpose::Forward(host, port) => format!("a connection on to {host}:{port}"),
                    },
                    cause: format!(
                        "{}; see the host's sshd_config (MaxSessions, AllowTcpForwarding)",
                        error.message()
                    ),
                };
                drop(request.reply.send(Err(Refusal::Failed(refused))));
            }
        }
        Ok(Turn::moving())
    }

    /// Waits for the socket or the bell.
    fn wait(&self, send: bool) -> Result<(), String> {
        let busy = !self.slots.is_empty() || !self.waiting.is_empty();
        let mut flags = PollFlags::RDHUP;
        // Without a channel libssh2 has no call that reads: what waits in the socket is for later.
        flags.set(PollFlags::IN, busy);
        flags.set(PollFlags::OUT, send);
        let mut fds = [
            PollFd::new(&self.socket, flags),
            PollFd::new(&*self.link.bell, PollFlags::IN),
        ];
        if !busy && writable(&self.socket) {
            // That it is lost is seen below.
            self.session.keepalive_send().ok();
        }
        let pause = if busy { PAUSE } else { IDLE_PAUSE };
        let pause = Timespec::try_from(pause).map_err(|error| error.to_string())?;
        match poll(&mut fds, Some(&pause)) {
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(error) => return Err(error.to_string()),
        }
        let gone = PollFlags::RDHUP | PollFlags::HUP | PollFlags::ERR;
        if !busy && fds[0].revents().intersects(gone) {
            return Err("the host closed it".to_owned());
        }
        Ok(())
    }

    /// Tells everyone, then frees the session.
    fn end(self, cause: String) {
        let error = SshError::Closed {
            host: self.link.host.clone(),
            cause,
        };
        let mut lost = lock(&self.link.lost);
        *lost = Some(error.clone());
        let late = std::mem::take(&mut *lock(&self.link.requests));
        drop(lost);
        for request in self.waiting.into_iter().chain(late) {
            drop(request.reply.send(Err(Refusal::Failed(error.clone()))));
        }
        if writable(&self.socket) {
            drop(self.session.disconnect(None, "done", None));
        }
        // What is freed must not talk to the host any more.
        let _gone = rustix::net::shutdown(&self.socket, rustix::net::Shutdown::Both);
        for slot in self.slots {
            slot.fail(&error);
        }
    }
}

/// Whether the socket takes a small packet now.
fn writable(socket: &OwnedFd) -> bool {
    let mut fds = [PollFd::from_borrowed_fd(socket.as_fd(), PollFlags::OUT)];
    let ready = poll(&mut fds, Some(&Timespec::default())).is_ok();
    ready && fds[0].revents().intersects(PollFlags::OUT | PollFlags::ERR)
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The end of waiting for what never comes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patience(Instant);

impl Patience {
    pub(super) fn new(bound: Duration) -> Self {
        Self(Instant::now() + bound)
    }

    pub(super) fn is_over(self) -> bool {
        Instant::now() >= self.0
    }
}
