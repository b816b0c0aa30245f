//! The loop: wait, read everything that is ready, decide once, write, say what happened.

use std::io::{self, Read};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::fd::BorrowedFd;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ictus_clock::{HostClock, Lookout, ask_often, give_up};
use ictus_coord::auth::Nonce;
use ictus_coord::rti::{ConnectionId, Disconnect, Newcomer, Rti, RtiEvent};
use ictus_core::PhysicalTime;
use ictus_stream::{Credentials, CredentialsError, Member, Stream};
use mio::net::{TcpListener, UnixStream};
use mio::{Events, Interest, Poll, Token};
use rustix::io::Errno;
use signal_hook::consts::{SIGINT, SIGTERM};

use crate::options::Options;
use crate::probing::Probing;
use crate::socket::{Flushed, READ, Received, Socket};
use crate::status::Status;

const LISTENER: Token = Token(usize::MAX);
const SIGNALS: Token = Token(usize::MAX - 1);
const PROBES: Token = Token(usize::MAX - 2);
/// Connections that have not said who they are, beyond those of the federates.
const STRANGERS: usize = 256;
/// Told of a connection from elsewhere; it itself is told nothing.
const NOT_ALLOWED: &str = "it comes from no host of the federation";
/// The most connections accepted in one round: all are read, four times at least, before the oldest must make room.
const ACCEPT: usize = STRANGERS / 4;
/// How many newcomers the system keeps for us, as far as it allows: a whole large federation comes at once.
const BACKLOG: i32 = 4096;
/// When accepting fails (no descriptor is left), or a reader of what the RTI says of itself is behind, it is tried again
/// after this long.
const TRY_AGAIN: Duration = Duration::from_millis(100);

/// An RTI with its sockets.
#[derive(Debug)]
pub struct Server {
    poll: Poll,
    listener: Option<TcpListener>,
    accepting: Accepting,
    signals: Option<UnixStream>,
    stop_requested: bool,
    sockets: Vec<Option<Socket>>,
    most_sockets: usize,
    rti: Rti,
    clock: HostClock,
    probing: Option<Probing>,
    status: Status,
    /// From where connections are taken; empty: from everywhere.
    allow: Vec<Ipv4Addr>,
    /// Whether other hosts still answer.
    lookout: Lookout<usize>,
    failure_timeout: ictus_core::Duration,
    /// What it shows; absent: connections are in the clear.
    credentials: Option<Credentials>,
    buffer: Vec<u8>,
    port: u16,
    /// How long federates may take to join; absent: for ever.
    join_timeout: Option<Duration>,
    /// Until when they may, while they have not all joined.
    join_until: Option<Instant>,
    /// Nobody chose the address: only this host's federates can join.
    bind_is_default: bool,
}

/// Whether connections may be waiting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Accepting {
    /// None; an event will tell.
    Idle,
    /// Some may be.
    Ready,
    /// There is no room for one, or accepting has failed.
    Stuck,
}

/// Why a server cannot run. Fatal.
#[derive(Debug, thiserror::Error)]
pub enum BindError {
    /// Another program listens there.
    #[error("port {port} on {} is already in use; choose another with `-p`, or 0 for any", address.ip())]
    InUse {
        /// The address.
        address: SocketAddr,
        /// The port.
        port: u16,
    },
    /// The address cannot be listened on.
    #[error("cannot listen on {address}: {source}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Why.
        source: io::Error,
    },
    /// The UDP address for probes cannot be used.
    #[error("cannot compare clocks at UDP {address}: {source}")]
    Probes {
        /// The address.
        address: SocketAddr,
        /// Why.
        source: io::Error,
    },
    /// The files of `--tls` are not the RTI's certificate and key.
    #[error("`--tls {}`: {source}", directory.display())]
    Credentials {
        /// Where they should be.
        directory: PathBuf,
        /// Why.
        source: CredentialsError,
    },
    /// The system refuses to wait for sockets or signals.
    #[error("cannot wait for events: {0}")]
    Poll(#[from] io::Error),
}

impl Server {
    /// Opens the listener; [`Server::run`] says so, when all else is in place.
    ///
    /// # Errors
    ///
    /// When the address cannot be listened on.
    pub fn bind(options: &Options, mut status: Status) -> Result<Self, BindError> {
        let address = SocketAddr::new(options.bind, options.port);
        let credentials = options.tls.as_deref().map(credentials).transpose()?;
        let mut listener = TcpListener::bind(address).map_err(|source| {
            if source.kind() == io::ErrorKind::AddrInUse {
                BindError::InUse {
                    address,
                    port: options.port,
                }
            } else {
                BindError::Listen { address, source }
            }
        })?;
        rustix::net::listen(&listener, BACKLOG).map_err(io::Error::from)?;
        let poll = Poll::new()?;
        poll.registry()
            .register(&mut listener, LISTENER, Interest::READABLE)?;
        let port = listener.local_addr()?.port();
        let probing = match options.config.clock_period {
            Some(_) => Some(open_probes(&poll, options)?),
            None => None,
        };
        for warning in &options.warnings {
            status.say(warning);
        }
        Ok(Self {
            poll,
            listener: Some(listener),
            accepting: Accepting::Ready,
            signals: None,
            stop_requested: false,
            sockets: Vec::new(),
            most_sockets: usize::from(options.config.federates) + STRANGERS,
            rti: Rti::new(options.config.clone()),
            clock: reference(options),
            probing,
            status,
            buffer: vec![0; 2 * READ],
            port,
            allow: options.allow.clone(),
            lookout: Lookout::new(options.failure_timeout),
            failure_timeout: options.failure_timeout,
            credentials,
            join_timeout: options.join_timeout,
            join_until: None,
            bind_is_default: options.bind_is_default,
        })
    }

    /// Lets SIGTERM and SIGINT stop the federation: the first in order, the second by failing it.
    ///
    /// # Errors
    ///
    /// When the system refuses signal handlers.
    pub fn with_signals(mut self) -> Result<Self, BindError> {
        let (receiver, sender) = std::os::unix::net::UnixStream::pair()?;
        receiver.set_nonblocking(true)?;
        let mut receiver = UnixStream::from_std(receiver);
        self.poll
            .registry()
            .register(&mut receiver, SIGNALS, Interest::READABLE)?;
        for signal in [SIGTERM, SIGINT] {
            signal_hook::low_level::pipe::register(signal, sender.try_clone()?)?;
        }
        self.signals = Some(receiver);
        Ok(self)
    }

    /// The port that is listened on.
    #[must_use]
    pub const fn port(&self) -> u16 {
        self.port
    }

    /// Serves until the federation has ended and returns the exit code.
    ///
    /// # Errors
    ///
    /// When the system refuses to wait for events.
    pub fn run(mut self) -> Result<u8, BindError> {
        self.status.listening(self.port, self.bind_is_default);
        self.join_until = self.join_timeout.map(|limit| Instant::now() + limit);
        let mut events = Events::with_capacity(1024);
        loop {
            match self.poll.poll(&mut events, self.patience()) {
                Ok(()) => {}
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => return Err(error.into()),
            }
            let now = self.clock.now();
            let woken = self.note(&events, now);
            if self.accepting != Accepting::Idle {
                self.accept(now);
            }
            self.read_round();
            let now = self.clock.now();
            self.look_out(now);
            if self
                .rti
                .poll_timeout()
                .is_some_and(|deadline| deadline <= now)
            {
                self.rti.handle_timeout(now);
            }
            self.expect_all(now);
            self.rti.drain(now);
            self.write_round(&woken);
            self.probe();
            self.report();
            if let Some(code) = self.rti.finished() {
                self.status.finish();
                return Ok(code);
            }
        }
    }

    /// How long nothing needs to be done; `None`: until an event.
    fn patience(&self) -> Option<Duration> {
        let readable = self.sockets.iter().flatten().any(|socket| socket.readable);
        let probed = self.probing.as_ref().is_some_and(|p| p.readable);
        if readable || probed || self.accepting == Accepting::Ready {
            return Some(Duration::ZERO);
        }
        let until = self.join_until;
        let until = until.map(|until| until.saturating_duration_since(Instant::now()));
        let stuck = self.accepting == Accepting::Stuck;
        let again = (stuck || self.status.is_behind()).then_some(TRY_AGAIN);
        let deadline = self
            .rti
            .poll_timeout()
            .map(|deadline| deadline.since(self.clock.now()).to_std() + Duration::from_millis(1));
        let lookout = self.watched().next().map(|_| self.lookout.patience());
        let lookout = lookout.map(|it| it.to_std() + Duration::from_millis(1));
        [until, again, deadline, lookout]
            .into_iter()
            .flatten()
            .min()
    }

    /// The connections with other hosts.
    fn watched(&self) -> impl Iterator<Item = (usize, IpAddr, BorrowedFd<'_>)> {
        watched(&self.sockets)
    }

    /// From time to time: whether other hosts still answer, whatever their programs do.
    fn look_out(&mut self, now: PhysicalTime) {
        for silent in self.lookout.look(watched(&self.sockets)) {
            let lost: Vec<usize> = self
                .watched()
                .filter(|(_, host, _)| *host == silent.host)
                .map(|(index, ..)| index)
                .collect();
            let (host, lasting) = (silent.host, silent.lasting);
            for index in lost {
                if let Some(socket) = &self.sockets[index] {
                    // A socket that cannot be told takes longer to go.
                    let _told = socket.watched().map(|(_, socket)| give_up(&socket));
                }
                let why = Disconnect::Silent { host, lasting };
                self.remove(ConnectionId::from_index(index), now, &why);
            }
        }
    }

    /// Gives up when federates have not joined in time.
    fn expect_all(&mut self, now: PhysicalTime) {
        if self.join_until.is_some_and(|until| until <= Instant::now()) {
            self.join_until = None;
            let limit = self.join_timeout.unwrap_or_default().as_secs_f64();
            let words = format!("not all federates have joined within {limit} s: giving up");
            self.status.say(&words);
            self.rti.abort(now);
        }
    }

    /// Notes what the events say; returns the connections that can take bytes again.
    fn note(&mut self, events: &Events, now: PhysicalTime) -> Vec<ConnectionId> {
        let mut writable = Vec::new();
        for event in events {
            match event.token() {
                LISTENER => self.accepting = Accepting::Ready,
                SIGNALS => self.take_signals(now),
                PROBES => {
                    if let Some(probing) = &mut self.probing {
                        probing.readable = true;
                    }
                }
                Token(index) => {
                    let Some(Some(socket)) = self.sockets.get_mut(index) else {
                        continue;
                    };
                    socket.readable |= event.is_readable() || event.is_error();
                    socket.read_to_end |= event.is_read_closed() || event.is_error();
                    if event.is_writable() {
                        writable.push(ConnectionId::from_index(index));
                    }
                }
            }
        }
        writable
    }

    fn take_signals(&mut self, now: PhysicalTime) {
        let mut bytes = [0; 16];
        let Some(signals) = &mut self.signals else {
            return;
        };
        while let Ok(number @ 1..) = signals.read(&mut bytes) {
            for _ in 0..number {
                if self.stop_requested {
                    self.status.say("a second signal: failing the federation");
                    self.rti.abort(now);
                } else {
                    self.stop_requested = true;
                    self.rti.request_stop(now);
                }
            }
        }
    }

    /// Accepts what is waiting. Where there is no room a stranger makes some, else newcomers stay in the backlog.
    fn accept(&mut self, now: PhysicalTime) {
        self.accepting = Accepting::Ready;
        for _ in 0..ACCEPT {
            let Some(listener) = &self.listener else {
                self.accepting = Accepting::Idle;
                return;
            };
            let full = self.sockets.iter().flatten().count() >= self.most_sockets;
            let evicted = if full { self.rti.least_needed() } else { None };
            if full && evicted.is_none() {
                self.accepting = Accepting::Stuck;
                return;
            }
            match listener.accept() {
                Ok((_, peer)) if !self.is_allowed(peer) => {
                    let (peer, reason) = (peer.to_string(), NOT_ALLOWED.to_owned());
                    self.status.tell(RtiEvent::Rejected { peer, reason });
                }
                Ok((stream, peer)) => {
                    if let Some(id) = evicted {
                        self.remove(id, now, &Disconnect::Evicted);
                    }
                    self.add(stream, peer, now);
                }
                Err(error) if passes(&error) => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    self.accepting = Accepting::Idle;
                    return;
                }
                Err(error) => {
                    self.make_room_after(&error, now);
                    return;
                }
            }
        }
    }

    fn is_allowed(&self, peer: SocketAddr) -> bool {
        let address = match peer.ip() {
            IpAddr::V4(address) => Some(address),
            IpAddr::V6(address) => address.to_ipv4_mapped(),
        };
        self.allow.is_empty() || address.is_some_and(|address| self.allow.contains(&address))
    }

    /// Where no descriptor is left one stranger a round makes room: the others of the round are read first.
    fn make_room_after(&mut self, error: &io::Error, now: PhysicalTime) {
        match self.rti.least_needed() {
            Some(id) if lacks_descriptors(error) => self.remove(id, now, &Disconnect::Evicted),
            Some(_) | None => {
                let words = format!("cannot accept a connection: {error}");
                self.status.say(&words);
                self.accepting = Accepting::Stuck;
            }
        }
    }

    fn add(&mut self, mut stream: mio::net::TcpStream, peer: SocketAddr, now: PhysicalTime) {
        let nonce = self.rti.authenticates().then(nonce).transpose();
        let newcomer = Newcomer {
            peer: peer.to_string(),
            local: stream.local_addr().ok().map(|address| address.ip()),
            nonce: nonce.as_ref().ok().copied().flatten(),
        };
        let id = self.rti.connect(now, newcomer);
        let interest = Interest::READABLE | Interest::WRITABLE;
        let ready = nonce.and_then(|_| stream.set_nodelay(true)).and_then(|()| {
            ask_often(&stream, self.failure_timeout)?;
            self.poll
                .registry()
                .register(&mut stream, Token(id.index()), interest)
        });
        let ready = ready.and_then(|()| match &self.credentials {
            Some(credentials) => credentials.accept(stream),
            None => Ok(Stream::plain(stream)),
        });
        let stream = match ready {
            Ok(stream) => stream,
            Err(error) => {
                let why = Disconnect::Error(error.to_string());
                return self.rti.disconnect(now, id, &why);
            }
        };
        if self.sockets.len() <= id.index() {
            self.sockets.resize_with(id.index() + 1, || None);
        }
        self.sockets[id.index()] = Some(Socket::new(stream, peer));
    }

    /// One read from every socket that may have something.
    fn read_round(&mut self) {
        for index in 0..self.sockets.len() {
            let Some(socket) = &mut self.sockets[index] else {
                continue;
            };
            if !socket.readable {
                continue;
            }
            let id = ConnectionId::from_index(index);
            if let Received::Ended(why) =
                socket.receive(&mut self.rti, &self.clock, id, &mut self.buffer)
            {
                // A refusal may be waiting for a peer that has closed only its own half.
                socket.flush(self.rti.output(id));
                let now = self.clock.now();
                self.remove(id, now, &why);
            }
        }
    }

    fn write_round(&mut self, woken: &[ConnectionId]) {
        for &id in woken {
            self.flush(id);
        }
        while let Some(id) = self.rti.poll_output() {
            self.flush(id);
        }
    }

    fn flush(&mut self, id: ConnectionId) {
        let Some(Some(socket)) = self.sockets.get_mut(id.index()) else {
            return;
        };
        if socket.flush(self.rti.output(id)) == Flushed::Close {
            let now = self.clock.now();
            self.remove(id, now, &Disconnect::Eof);
        }
    }

    fn remove(&mut self, id: ConnectionId, now: PhysicalTime, why: &Disconnect) {
        if let Some(mut socket) = self.sockets[id.index()].take() {
            // Closing the socket deregisters it as well.
            let _already = self.poll.registry().deregister(socket.stream_mut());
        }
        self.rti.disconnect(now, id, why);
    }

    /// A socket that fails takes the comparison of clocks with it, not the federation: bounds grow, and tell.
    fn probe(&mut self) {
        let Some(probing) = &mut self.probing else {
            return;
        };
        if let Err(error) = probing.round(&mut self.rti, &self.clock) {
            let words = format!("clocks are compared no more: {error}");
            self.status.say(&words);
            self.probing = None;
        }
    }

    fn report(&mut self) {
        while let Some(event) = self.rti.poll_event() {
            if matches!(event, RtiEvent::Started { .. }) {
                self.join_until = None;
            }
            if matches!(event, RtiEvent::Ended { .. }) {
                self.listener = None;
                self.accepting = Accepting::Idle;
            }
            self.status.tell(event);
        }
        self.status.flush();
    }
}

/// The connections with other hosts among these.
fn watched(sockets: &[Option<Socket>]) -> impl Iterator<Item = (usize, IpAddr, BorrowedFd<'_>)> {
    let sockets = sockets.iter().enumerate();
    sockets.filter_map(|(index, socket)| {
        let (host, socket) = socket.as_ref()?.watched()?;
        Some((index, host, socket))
    })
}

/// The federation's clock: the host's as it is; while others follow it, one that nobody steps.
fn reference(options: &Options) -> HostClock {
    if options.config.clock_exchanges == 0 {
        HostClock::system()
    } else {
        HostClock::steady()
    }
}

fn credentials(directory: &Path) -> Result<Credentials, BindError> {
    Credentials::load(directory, Member::Rti).map_err(|source| BindError::Credentials {
        directory: directory.to_path_buf(),
        source,
    })
}

fn open_probes(poll: &Poll, options: &Options) -> Result<Probing, BindError> {
    let (bind, port) = (options.bind, options.clock_port);
    Probing::open(poll, PROBES, bind, port, options.stamps).map_err(|source| BindError::Probes {
        address: SocketAddr::new(bind, port),
        source,
    })
}

/// Whether an error concerns one connection, or none.
fn passes(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        io::ErrorKind::Interrupted | io::ErrorKind::ConnectionAborted
    )
}

/// Whether the process, or the host, has as many descriptors open as it may.
fn lacks_descriptors(error: &io::Error) -> bool {
    let most = [Errno::MFILE, Errno::NFILE].map(Errno::raw_os_error);
    error
        .raw_os_error()
        .is_some_and(|code| most.contains(&code))
}

/// Random bytes from the system.
fn nonce() -> io::Result<Nonce> {
    let mut nonce = Nonce::default();
    getrandom::fill(&mut nonce)?;
    Ok(nonce)
}
