//! Bytes to and from the RTI, and the one place where a federate waits.

use ictus_clock::{ask_often, give_up, other_host};
use ictus_coord::silence::Silent;
use ictus_core::Duration;
use ictus_stream::{Credentials, Member, Stream};
use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use rustix::io::Errno;
use std::io::{self, ErrorKind, Read};
use std::net::{IpAddr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// One read takes at most this much, so that a federate that lags sees a batch and not one message.
const READ_BYTES: usize = 256 << 10;

/// A non-blocking connection with a buffer of bytes that are not yet whole messages.
#[derive(Debug)]
pub(crate) struct Connection {
    stream: Stream<TcpStream>,
    buffer: Vec<u8>,
    filled: usize,
    taken: usize,
    closed: bool,
    /// Whether it ended otherwise than the other end says; in the clear nobody can tell.
    cut: bool,
    /// Why it failed, when the other end is not who it should be.
    failure: Option<String>,
    finishing: Finishing,
    peer: SocketAddr,
    /// The peer's host, when it is another one.
    host: Option<IpAddr>,
    /// That host answers no more, and for how long.
    lost: Option<Silent>,
}

/// How far it is said that nothing more will be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Finishing {
    No,
    /// As soon as everything else is written.
    Wanted,
    Done,
}

impl Connection {
    /// Connects once, with Nagle off: what is written is already a batch. With credentials `to` must prove who it is.
    pub(crate) fn open(
        address: SocketAddr,
        timeout: Duration,
        to: Option<(&Credentials, Member)>,
    ) -> io::Result<Self> {
        let stream = prepare(TcpStream::connect_timeout(&address, timeout.to_std())?)?;
        let stream = match to {
            Some((credentials, to)) => credentials.connect(stream, to)?,
            None => Stream::plain(stream),
        };
        Ok(Self::of(stream, address))
    }

    /// A connection that was accepted. With credentials the other end must prove that it is a federate.
    pub(crate) fn accepted(
        stream: TcpStream,
        peer: SocketAddr,
        credentials: Option<&Credentials>,
    ) -> io::Result<Self> {
        let stream = prepare(stream)?;
        let stream = match credentials {
            Some(credentials) => credentials.accept(stream)?,
            None => Stream::plain(stream),
        };
        Ok(Self::of(stream, peer))
    }

    fn of(stream: Stream<TcpStream>, peer: SocketAddr) -> Self {
        Self {
            peer,
            host: other_host(stream.tcp().local_addr(), peer),
            lost: None,
            stream,
            buffer: vec![0; READ_BYTES],
            filled: 0,
            taken: 0,
            closed: false,
            cut: false,
            failure: None,
            finishing: Finishing::No,
        }
    }

    /// Reads what is there and says whether that was all; after the end of the stream [`Connection::closed`] is true.
    pub(crate) fn read(&mut self) -> bool {
        if self.taken == self.filled {
            (self.taken, self.filled) = (0, 0);
        } else if self.taken > 0 && self.buffer.len() - self.filled < READ_BYTES / 2 {
            self.buffer.copy_within(self.taken..self.filled, 0);
            (self.taken, self.filled) = (0, self.filled - self.taken);
        }
        if self.filled == self.buffer.len() {
            self.buffer.resize(self.buffer.len() * 2, 0);
        }
        match self.stream.read(&mut self.buffer[self.filled..]) {
            Ok(0) => self.closed = true,
            Ok(count) => {
                self.filled += count;
                return self.filled < self.buffer.len() && !self.stream.has_more();
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(error) if error.kind() == ErrorKind::Interrupted => return false,
            // A reset ends the stream like a close, after what was received is processed.
            Err(error) => {
                self.closed = true;
                self.failure = self.stream.failure().map(|_| error.to_string());
                self.cut = error.kind() == ErrorKind::UnexpectedEof || self.failure.is_some();
            }
        }
        true
    }

    /// The bytes received and not taken.
    pub(crate) fn bytes(&self) -> &[u8] {
        &self.buffer[self.taken..self.filled]
    }

    /// Marks bytes as processed.
    pub(crate) fn take(&mut self, count: usize) {
        self.taken += count;
    }

    /// Whether the peer has closed.
    pub(crate) fn closed(&self) -> bool {
        self.closed
    }

    /// Whether it has ended, and perhaps not by the will of the other end.
    pub(crate) fn cut(&self) -> bool {
        self.cut
    }

    /// Why the other end is not who it should be, in words, when that ended it.
    pub(crate) fn failure(&self) -> Option<&str> {
        self.failure.as_deref()
    }

    /// The federate whose certificate the other end has shown.
    pub(crate) fn certified(&self) -> Option<u16> {
        match self.stream.peer()? {
            Member::Federate(id) => Some(id),
            Member::Rti => None,
        }
    }

    /// Bytes that were taken from an output and have perhaps not left.
    pub(crate) fn owed(&self) -> usize {
        match self.finishing {
            Finishing::Done => 0,
            Finishing::No | Finishing::Wanted => self.stream.owed(),
        }
    }

    /// Writes from the front of `out` what the socket takes. A broken connection drops the rest: reading will tell.
    pub(crate) fn write(&mut self, out: &mut Vec<u8>) {
        if self.lost.is_some() {
            return out.clear();
        }
        let mut written = 0;
        while written < out.len() {
            match self.stream.write(&out[written..]) {
                Ok(count) => written += count,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(_) => written = out.len(),
            }
        }
        out.drain(..written);
        self.settle();
    }

    /// Writes what was taken before, and says the last word when it is wanted.
    fn settle(&mut self) {
        if self.finishing != Finishing::Wanted {
            // What cannot be written now is tried again; what is broken, reading tells.
            let _later = self.stream.flush();
            return;
        }
        match self.stream.finish() {
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Ok(()) | Err(_) => {
                // A peer that is gone already is as finished as can be.
                drop(self.stream.tcp().shutdown(Shutdown::Write));
                self.finishing = Finishing::Done;
            }
        }
    }

    /// Whether room to write is worth waking up for, when something waits (`has_output`) for this connection.
    fn wants_write(&self, has_output: bool) -> bool {
        self.owed() > 0 || (has_output && self.stream.is_open())
    }

    /// Has the peer's host asked often whether it is there; how long it may be silent is the `Lookout`'s to say.
    pub(crate) fn watch(&self, failure_timeout: Duration) -> io::Result<()> {
        ask_often(self.stream.tcp(), failure_timeout)
    }

    /// What is watched: the peer's host, when it is another one and not lost, and the socket.
    pub(crate) fn watched(&self) -> Option<(IpAddr, BorrowedFd<'_>)> {
        let here = !self.closed;
        self.host
            .filter(|_| here)
            .map(|host| (host, self.stream.tcp().as_fd()))
    }

    /// The peer's host is lost: as if it had closed; what is under way is forgotten.
    pub(crate) fn lose(&mut self, silent: Silent) {
        self.closed = true;
        self.lost = Some(silent);
        self.finishing = Finishing::Done;
        // A socket that cannot be told takes longer to go.
        let _told = give_up(self.stream.tcp());
    }

    /// For how long the peer's host had been silent when it was lost.
    pub(crate) fn lost(&self) -> Option<Silent> {
        self.lost
    }

    /// The address at this end.
    pub(crate) fn local(&self) -> io::Result<SocketAddr> {
        self.stream.tcp().local_addr()
    }

    /// The peer's address.
    pub(crate) fn peer(&self) -> SocketAddr {
        self.peer
    }

    /// Says that nothing more will be written, and whether that is done; if not, [`Connection::write`] goes on with it.
    pub(crate) fn finish(&mut self) -> bool {
        if self.finishing == Finishing::No {
            self.finishing = Finishing::Wanted;
            self.settle();
        }
        self.finishing == Finishing::Done
    }
}

fn prepare(stream: TcpStream) -> io::Result<TcpStream> {
    stream.set_nodelay(true)?;
    stream.set_nonblocking(true)?;
    Ok(stream)
}

/// Wakes a waiting federate from another thread.
#[derive(Clone, Debug)]
pub(crate) struct Waker(Arc<OwnedFd>);

impl Waker {
    pub(crate) fn new() -> io::Result<Self> {
        Ok(Self(Arc::new(eventfd(
            0,
            EventfdFlags::NONBLOCK | EventfdFlags::CLOEXEC,
        )?)))
    }

    pub(crate) fn wake(&self) {
        // A full counter is a wake-up that is already pending.
        let _ = rustix::io::write(&*self.0, &1_u64.to_ne_bytes());
    }

    fn clear(&self) {
        let _ = rustix::io::read(&*self.0, &mut [0_u8; 8]);
    }
}

/// SIGTERM and SIGINT as bytes on a socket.
#[derive(Debug)]
pub(crate) struct Signals {
    stream: UnixStream,
    pending: Arc<AtomicBool>,
}

impl Signals {
    pub(crate) fn new() -> io::Result<Self> {
        let (stream, writer) = UnixStream::pair()?;
        stream.set_nonblocking(true)?;
        writer.set_nonblocking(true)?;
        let pending = Arc::new(AtomicBool::new(false));
        for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGINT] {
            signal_hook::low_level::pipe::register(signal, writer.try_clone()?)?;
            signal_hook::flag::register(signal, Arc::clone(&pending))?;
        }
        Ok(Self { stream, pending })
    }

    /// Whether a signal has come since the last call of [`Signals::take`]; costs next to nothing.
    pub(crate) fn pending(&self) -> bool {
        self.pending.load(Ordering::Relaxed)
    }

    /// How many signals have come since the last call.
    pub(crate) fn take(&mut self) -> usize {
        self.pending.store(false, Ordering::Relaxed);
        let mut bytes = [0; 16];
        self.stream.read(&mut bytes).unwrap_or(0)
    }
}

/// What a wait is for, besides events from outside and signals.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Awaited<'a> {
    /// Bytes of a peer, and room to write when something waits for that.
    Connection(&'a Connection, bool),
    /// Somebody who connects.
    Listener(&'a TcpListener),
}

impl<'a> Awaited<'a> {
    /// Whether there is something to read that the kernel does not know of.
    fn is_ready(&self) -> bool {
        match self {
            Self::Connection(connection, _) => !connection.closed && connection.stream.has_more(),
            Self::Listener(_) => false,
        }
    }

    /// What to ask the kernel for; `None` when nothing can come.
    fn poll_fd(self) -> Option<PollFd<'a>> {
        match self {
            // A peer that has only said its last word may still read.
            Self::Connection(connection, has_output) => {
                let wanted = match (connection.closed, connection.wants_write(has_output)) {
                    (true, false) => return None,
                    (false, false) => PollFlags::IN,
                    (false, true) => PollFlags::IN | PollFlags::OUT,
                    (true, true) => PollFlags::OUT,
                };
                let socket = connection.stream.tcp().as_fd();
                Some(PollFd::from_borrowed_fd(socket, wanted))
            }
            Self::Listener(listener) => {
                Some(PollFd::from_borrowed_fd(listener.as_fd(), PollFlags::IN))
            }
        }
    }
}

const NO_TIME: Timespec = Timespec {
    tv_sec: 0,
    tv_nsec: 0,
};

/// Waits for bytes, room to write, a wake-up, a signal, or until `timeout` is over (`None`: for ever); says whether a signal
/// came.
///
/// The time-out has nanosecond resolution; [`precise_waits`] makes the kernel honour it.
pub(crate) fn wait<'a>(
    awaited: impl Iterator<Item = Awaited<'a>>,
    waker: &'a Waker,
    signals: &'a Signals,
    timeout: Option<Duration>,
) -> io::Result<bool> {
    let timeout = timeout.map(|t| {
        let nanos = t.as_nanos().max(0);
        Timespec {
            tv_sec: nanos / 1_000_000_000,
            tv_nsec: nanos % 1_000_000_000,
        }
    });
    let mut ready = false;
    let mut fds = Vec::with_capacity(4);
    fds.push(PollFd::from_borrowed_fd(waker.0.as_fd(), PollFlags::IN));
    fds.push(PollFd::from_borrowed_fd(
        signals.stream.as_fd(),
        PollFlags::IN,
    ));
    let awaited = awaited.inspect(|it| ready |= it.is_ready());
    fds.extend(awaited.filter_map(Awaited::poll_fd));
    let timeout = if ready { Some(NO_TIME) } else { timeout };
    let signal = match poll(&mut fds, timeout.as_ref()) {
        Ok(_) => !fds[1].revents().is_empty(),
        Err(Errno::INTR) => true,
        Err(errno) => return Err(errno.into()),
    };
    waker.clear();
    Ok(signal)
}

/// Makes this thread's waits end at their time: timer slack of 1 ns instead of 50 us.
pub(crate) fn precise_waits() {
    // Without it waits are only less precise.
    let _ = rustix::thread::set_current_timer_slack(std::num::NonZeroU64::new(1));
}

#[cfg(test)]
mod tests;
