//! The sockets between this federate and others: a listener while others are missing, and a connection each.

use crate::bodies::Bodies;
use crate::transport::{Awaited, Connection};
use ictus_coord::federate::{Federate, PeerStream};
use ictus_core::{Duration, PhysicalTime, Tag};
use std::collections::BTreeSet;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};

/// How long one attempt to connect may take.
const CONNECT_MAX: Duration = Duration::from_secs(2);
/// How long a receiver may take nothing while the federate cannot go on for what waits for it.
const STUCK_MAX: Duration = Duration::from_secs(10);
/// Bytes that are read of one sender before the start tag is known.
const UNSTARTED_MAX: usize = 4 << 20;
/// Connections that may be open without having said hello.
const STRANGERS_MAX: usize = 32;

/// All connections with other federates.
#[derive(Debug, Default)]
pub(crate) struct Peers {
    listener: Option<TcpListener>,
    connections: Vec<Peer>,
    /// Receivers that could not be reached at first.
    unreachable: BTreeSet<u16>,
}

#[derive(Debug)]
struct Peer {
    stream: PeerStream,
    connection: Connection,
    accepted: bool,
    /// Whether the federate was told that the other end has closed.
    told: bool,
    /// Whether nothing more will be written.
    finished: bool,
    /// Since when what waits has not become less.
    stuck_since: Option<PhysicalTime>,
}

impl Peer {
    const fn new(stream: PeerStream, connection: Connection, accepted: bool) -> Self {
        Self {
            stream,
            connection,
            accepted,
            told: false,
            finished: false,
            stuck_since: None,
        }
    }
}

impl Peers {
    /// Listens at `address`, when others will connect, and tells the federate where.
    pub(crate) fn listen(&mut self, address: IpAddr, federate: &mut Federate) -> io::Result<()> {
        if federate.expects_peers() {
            let listener = TcpListener::bind((address, 0))?;
            listener.set_nonblocking(true)?;
            federate.listening(listener.local_addr()?.port());
            self.listener = Some(listener);
        }
        Ok(())
    }

    /// Whether there is nothing to look at.
    #[inline]
    pub(crate) fn is_empty(&self) -> bool {
        self.connections.is_empty() && self.listener.is_none()
    }

    /// Connects to another federate, or says that it cannot be reached now; in words when it is the first time.
    pub(crate) fn connect(
        &mut self,
        federate: &mut Federate,
        now: PhysicalTime,
        receiver: u16,
        address: ([u8; 4], u16),
    ) -> Option<String> {
        let address = SocketAddr::from((Ipv4Addr::from(address.0), address.1));
        match Connection::open(address, CONNECT_MAX) {
            Ok(connection) => {
                let stream = federate.peer_connected(receiver);
                self.connections.push(Peer::new(stream, connection, false));
                None
            }
            Err(error) => {
                federate.peer_unreachable(now, receiver);
                self.unreachable.insert(receiver).then(|| {
                    format!(
                        "cannot connect to federate {receiver} at {address}: {error}; trying on"
                    )
                })
            }
        }
    }

    /// Takes everything that has come; says whether that was all there is.
    pub(crate) fn read(
        &mut self,
        now: PhysicalTime,
        federate: &mut Federate,
        bodies: &mut Bodies,
    ) -> bool {
        self.accept(federate);
        let started = federate.timeline().start_tag() != Tag::NEVER;
        let mut drained = true;
        for peer in &mut self.connections {
            let connection = &mut peer.connection;
            // What comes before the start waits, but not in our memory.
            let full = !started && connection.bytes().len() > UNSTARTED_MAX;
            if !connection.closed() && !full {
                drained &= connection.read();
            }
            let used = federate.receive_from_peer(now, peer.stream, connection.bytes(), bodies);
            connection.take(used);
            // What came before the start tag is known waits in the buffer.
            let offered = connection.bytes().is_empty() || started;
            if connection.closed() && offered && !peer.told {
                peer.told = true;
                let cut = !connection.bytes().is_empty();
                federate.peer_closed(now, peer.stream, cut);
            }
        }
        drained
    }

    fn accept(&mut self, federate: &mut Federate) {
        let Some(listener) = &self.listener else {
            return;
        };
        while let Ok((stream, address)) = listener.accept() {
            let Ok(connection) = Connection::of(stream, address) else {
                continue;
            };
            let stream = federate.peer_accepted();
            self.connections.push(Peer::new(stream, connection, true));
        }
        let silent = |peer: &Peer| peer.accepted && federate.peer_is_stranger(peer.stream);
        let mut strangers = self.connections.iter().filter(|peer| silent(peer)).count();
        while strangers > STRANGERS_MAX
            && let Some(oldest) = self.connections.iter().position(silent)
        {
            self.connections.remove(oldest);
            strangers -= 1;
        }
    }

    /// Writes what the federate has for others, and closes what is over.
    pub(crate) fn write(&mut self, now: PhysicalTime, federate: &mut Federate) {
        for peer in &mut self.connections {
            let out = federate.peer_output(peer.stream);
            let before = out.len();
            if before > 0 {
                peer.connection.write(out);
            }
            let empty = out.is_empty();
            if empty || out.len() < before {
                peer.stuck_since = None;
            } else {
                peer.stuck_since.get_or_insert(now);
            }
            if empty && !peer.finished && federate.peer_over(peer.stream) {
                peer.connection.finish();
                peer.finished = true;
            }
        }
    }

    /// Stops listening once all others are there, and drops what is finished at both ends.
    pub(crate) fn tidy(&mut self, federate: &Federate) {
        if self.listener.is_some() && !federate.peers_missing() {
            self.listener = None;
            self.connections
                .retain(|peer| !federate.peer_is_stranger(peer.stream));
        }
        // Who was refused is not read; others close first, so that nothing is reset that they have not taken.
        let over = |peer: &Peer| peer.accepted && federate.peer_over(peer.stream);
        self.connections
            .retain(|peer| !(peer.finished && (peer.connection.closed() || over(peer))));
    }

    /// Tells the federate who has taken nothing for too long.
    pub(crate) fn give_up(&mut self, now: PhysicalTime, federate: &mut Federate) {
        for peer in &mut self.connections {
            if peer
                .stuck_since
                .is_some_and(|since| now.since(since) > STUCK_MAX)
            {
                peer.stuck_since = None;
                federate.peer_stuck(peer.stream);
            }
        }
    }

    /// Bytes that wait to be written, of the fullest connection.
    pub(crate) fn backlog(&self, federate: &mut Federate) -> usize {
        let lengths = self
            .connections
            .iter()
            .map(|p| federate.peer_output(p.stream).len());
        lengths.max().unwrap_or(0)
    }

    /// What the federate waits for here.
    pub(crate) fn awaited<'a>(&'a self, federate: &mut Federate) -> Vec<Awaited<'a>> {
        let started = federate.timeline().start_tag() != Tag::NEVER;
        let full = move |peer: &&Peer| !started && peer.connection.bytes().len() > UNSTARTED_MAX;
        let connection = |peer: &'a Peer| {
            let wants_write = !federate.peer_output(peer.stream).is_empty();
            Awaited::Connection(&peer.connection, wants_write)
        };
        let read = self.connections.iter().filter(move |peer| !full(peer));
        let connections = read.map(connection);
        connections
            .chain(self.listener.as_ref().map(Awaited::Listener))
            .collect()
    }
}
