//! The sockets between this federate and others: a listener while others are missing, and a connection each.

use crate::transport::{Awaited, Connection};
use ictus_coord::FederateExecutor;
use ictus_coord::federate::{Federate, PeerStream};
use ictus_coord::silence::Silent;
use ictus_core::{Duration, PhysicalTime, Tag};
use ictus_stream::{Credentials, Member};
use std::collections::BTreeSet;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};
use std::os::fd::BorrowedFd;

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
    /// From where others connect; empty: from everywhere.
    allow: Vec<Ipv4Addr>,
    /// How long another host may be silent.
    failure_timeout: Duration,
    /// What is shown to others; absent: connections are in the clear.
    credentials: Option<Credentials>,
}

#[derive(Debug)]
struct Peer {
    stream: PeerStream,
    connection: Connection,
    accepted: bool,
    /// The receiver that was to be reached.
    receiver: Option<u16>,
    /// Whether the federate was told that the other end has closed.
    told: bool,
    /// Whether nothing more will be written.
    finished: bool,
    /// Since when what waits has not become less.
    stuck_since: Option<PhysicalTime>,
}

impl Peer {
    const fn new(stream: PeerStream, connection: Connection, receiver: Option<u16>) -> Self {
        Self {
            stream,
            connection,
            accepted: receiver.is_none(),
            receiver,
            told: false,
            finished: false,
            stuck_since: None,
        }
    }
}

impl Peers {
    /// None yet, and strangers from other addresses (none are named: from everywhere), or without a certificate where
    /// there are `credentials`, never. Other hosts may be silent for so long.
    pub(crate) fn allowing(
        allow: Vec<Ipv4Addr>,
        credentials: Option<Credentials>,
        failure_timeout: Duration,
    ) -> Self {
        Self {
            allow,
            failure_timeout,
            credentials,
            ..Self::default()
        }
    }

    /// Listens at `address`, when others will connect, and tells the federate where; port 0: any.
    pub(crate) fn listen(
        &mut self,
        address: SocketAddr,
        federate: &mut Federate,
    ) -> io::Result<()> {
        if federate.expects_peers() {
            let listener = TcpListener::bind(address)?;
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
        let to = self.credentials.as_ref();
        let to = to.map(|credentials| (credentials, Member::Federate(receiver)));
        let opened = Connection::open(address, CONNECT_MAX, to);
        match opened.and_then(|it| it.watch(self.failure_timeout).map(|()| it)) {
            Ok(connection) => {
                let stream = federate.peer_connected(receiver);
                let peer = Peer::new(stream, connection, Some(receiver));
                self.connections.push(peer);
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
        executor: &mut impl FederateExecutor,
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
            if federate.peer_is_stranger(peer.stream)
                && let Some(id) = connection.certified()
            {
                federate.peer_certified(peer.stream, id);
            }
            let used = federate.receive_from_peer(now, peer.stream, connection.bytes(), executor);
            connection.take(used);
            // What came before the start tag is known waits in the buffer.
            let offered = connection.bytes().is_empty() || started;
            if connection.closed() && offered && !peer.told {
                peer.told = true;
                let lost = connection.cut() || connection.lost().is_some();
                let cut = !connection.bytes().is_empty() || lost;
                if let Some(why) = connection.failure() {
                    let words = match peer.receiver {
                        None => format!(
                            "somebody who has connected from {}: {why}",
                            connection.peer()
                        ),
                        Some(id) => format!("federate {id} at {}: {why}", connection.peer()),
                    };
                    federate.peer_unfit(words);
                }
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
            let known = |ip: IpAddr| self.allow.iter().any(|it| ip == IpAddr::V4(*it));
            if !self.allow.is_empty() && !known(address.ip()) {
                // Not a host of the federation: it is told nothing.
                continue;
            }
            let credentials = self.credentials.as_ref();
            let connection = Connection::accepted(stream, address, credentials);
            let watched = connection.and_then(|it| it.watch(self.failure_timeout).map(|()| it));
            let Ok(connection) = watched else {
                continue;
            };
            let stream = federate.peer_accepted();
            self.connections.push(Peer::new(stream, connection, None));
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

    /// The sockets to and from other hosts, by number.
    pub(crate) fn watched(&self) -> impl Iterator<Item = (usize, IpAddr, BorrowedFd<'_>)> {
        let connections = self.connections.iter();
        connections.filter_map(|peer| {
            let (host, socket) = peer.connection.watched()?;
            Some((peer.stream.index(), host, socket))
        })
    }

    /// Nobody on this host answers any more.
    pub(crate) fn lose(&mut self, silent: Silent) {
        for peer in &mut self.connections {
            let host = peer.connection.watched().map(|(host, _)| host);
            if host == Some(silent.host) {
                peer.connection.lose(silent);
            }
        }
    }

    /// Writes what the federate has for others, and closes what is over.
    pub(crate) fn write(&mut self, now: PhysicalTime, federate: &mut Federate) {
        for peer in &mut self.connections {
            let out = federate.peer_output(peer.stream);
            let before = out.len();
            if before > 0 || peer.connection.owed() > 0 {
                peer.connection.write(out);
            }
            let empty = out.is_empty();
            if empty || out.len() < before {
                peer.stuck_since = None;
            } else {
                peer.stuck_since.get_or_insert(now);
            }
            if empty && !peer.finished && federate.peer_over(peer.stream) {
                peer.finished = peer.connection.finish();
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
            .map(|p| federate.peer_output(p.stream).len() + p.connection.owed());
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

#[cfg(test)]
mod tests {
    use super::*;
    use ictus_coord::PayloadError;
    use ictus_coord::federate::{FederateConfig, FederateEvent, LinkConfig, Outcome};
    use ictus_coord::plan::{Plan, Wire};
    use ictus_coord::wire::{FromPeer, RejectReason, ToFederate, ToPeer, ToRti};
    use ictus_core::{
        ActionId, Effects, Executor, InputId, NodeId, OutputId, PortKind, ProgramBuilder, SlotId,
        ValueId,
    };
    use ictus_stream::Authority;
    use std::io::{Read, Write};
    use std::net::TcpStream;
    use std::sync::Arc;

    struct Nothing;

    impl Executor for Nothing {
        fn begin(&mut self, _: Tag) {}
        fn arrive(&mut self, _: ActionId, _: Option<SlotId>, _: ValueId) {}
        fn run(&mut self, _: NodeId, _: Tag, _: &mut Effects) {}
    }

    impl FederateExecutor for Nothing {
        fn encode(&mut self, _: OutputId, _: &mut Vec<u8>) {}
        fn decode(&mut self, _: InputId, _: &[u8]) -> Result<ValueId, PayloadError> {
            Ok(ValueId::NONE)
        }
    }

    const NOW: PhysicalTime = PhysicalTime::from_nanos(1_000_000_000);

    /// Federate 0 of two, which receives from the other (`receives`) or sends to it, and has been accepted by the RTI.
    fn federate(receives: bool) -> Federate {
        let (from, to) = if receives { (1, 0) } else { (0, 1) };
        let plan = format!(
            r#"{{"ictus": "v1", "federation": "f", "coordination": "decentralized", "extensions": true,
                "federates": [{{"name": "me", "class": "A", "program": "p"}}, {{"name": "b", "class": "A", "program": "p"}}],
                "connections": [{{"from": {{"federate": {from}, "port": "o"}}, "to": {{"federate": {to}, "port": "i"}},
                    "serializer": "native", "port_id": 0}}]}}"#
        );
        let plan: Plan = serde_json::from_str(&plan).unwrap();
        let mut builder = ProgramBuilder::new();
        let me = builder.reactor("me");
        let (inputs, outputs): (&[usize], &[usize]) = if receives {
            let port = builder.port(me, "i", PortKind::Input);
            builder.network_input(port, false);
            (&[0], &[])
        } else {
            let port = builder.port(me, "o", PortKind::Output);
            builder.network_output(port);
            (&[], &[0])
        };
        let mut link = LinkConfig::from_plan(&plan, 0, inputs, outputs);
        link.federation = "test".to_owned();
        let program = Arc::new(builder.build().unwrap());
        let mut federate = Federate::federated(program, FederateConfig::default(), link);
        federate.connect();
        hear(&mut federate, &ToFederate::Ack);
        federate
    }

    fn hear(federate: &mut Federate, message: &ToFederate<'_>) {
        let mut bytes = Vec::new();
        message.encode(&mut bytes);
        federate.receive(NOW, &bytes, &mut Nothing);
        // What is to be done follows when it is polled.
        let _ = federate.poll(NOW, &mut Nothing);
    }

    fn has_proposed(federate: &mut Federate) -> bool {
        let _ = federate.poll(NOW, &mut Nothing);
        let mut rest = &federate.output().unwrap()[..];
        while let Some((message, length)) = ToRti::decode(rest).unwrap() {
            if matches!(message, ToRti::Timestamp(_)) {
                return true;
            }
            rest = &rest[length..];
        }
        false
    }

    fn here() -> SocketAddr {
        SocketAddr::from((Ipv4Addr::LOCALHOST, 0))
    }

    fn look(peers: &mut Peers, federate: &mut Federate) {
        peers.read(NOW, federate, &mut Nothing);
        peers.write(NOW, federate);
        peers.tidy(federate);
    }

    #[test]
    fn only_hosts_of_the_federation_connect() {
        for (allowed, taken) in [([10, 9, 8, 7], 0), ([127, 0, 0, 1], 1)] {
            let mut federate = federate(true);
            let allowed = vec![Ipv4Addr::from(allowed)];
            let mut peers = Peers::allowing(allowed.clone(), None, Duration::from_secs(10));
            peers.listen(here(), &mut federate).unwrap();
            let address = peers.listener.as_ref().unwrap().local_addr().unwrap();
            let stranger = TcpStream::connect(address).unwrap();
            look(&mut peers, &mut federate);
            assert_eq!(peers.connections.len(), taken, "{allowed:?}");
            drop(stranger);
        }
    }

    #[test]
    fn strangers_are_few_and_the_refused_are_dropped() {
        let (mut peers, mut federate) = (Peers::default(), federate(true));
        peers.listen(here(), &mut federate).unwrap();
        let address = peers.listener.as_ref().unwrap().local_addr().unwrap();
        let silent: Vec<_> = (0..3 * STRANGERS_MAX)
            .map(|_| TcpStream::connect(address).unwrap())
            .collect();
        look(&mut peers, &mut federate);
        assert_eq!(peers.connections.len(), STRANGERS_MAX);
        drop(silent);
        for _ in 0..100 {
            let mut rude = TcpStream::connect(address).unwrap();
            rude.write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
            let refused = federate.counters().refused;
            while federate.counters().refused == refused {
                look(&mut peers, &mut federate);
            }
        }
        assert!(peers.connections.len() <= STRANGERS_MAX);
        // Who is awaited is let in all the same, and then nobody else.
        let mut sender = TcpStream::connect(address).unwrap();
        let (mut bytes, mut answer) = (Vec::new(), [0]);
        let hello = ToPeer::Hello {
            federate: 1,
            federation: b"test",
            transient: false,
        };
        hello.encode(Wire::V0_12, &mut bytes);
        sender.write_all(&bytes).unwrap();
        while federate.peers_missing() {
            look(&mut peers, &mut federate);
        }
        look(&mut peers, &mut federate);
        sender.read_exact(&mut answer).unwrap();
        assert_eq!(FromPeer::decode(&answer), Ok(Some((FromPeer::Ack, 1))));
        assert!(peers.listener.is_none());
        assert_eq!(peers.connections.len(), 1);
    }

    /// The sender is let in by its certificate; nobody is by that of another, or without.
    #[test]
    fn federates_meet_by_their_certificates() {
        let authority = Authority::new("run").unwrap();
        let credentials = |id| {
            let papers = authority.certify(Member::Federate(id)).unwrap();
            Credentials::of(&papers).unwrap()
        };
        let mut federate = federate(true);
        let mut peers = Peers::allowing(Vec::new(), Some(credentials(0)), Duration::from_secs(10));
        peers.listen(here(), &mut federate).unwrap();
        let address = peers.listener.as_ref().unwrap().local_addr().unwrap();
        let mut bytes = Vec::new();
        let hello = ToPeer::Hello {
            federate: 1,
            federation: b"test",
            transient: false,
        };
        hello.encode(Wire::V0_12, &mut bytes);
        let mut plain = TcpStream::connect(address).unwrap();
        plain.write_all(&bytes).unwrap();
        while federate.counters().refused < 1 {
            look(&mut peers, &mut federate);
        }
        let patience = Duration::from_secs(5);
        let mut meet = |id: u16, peers: &mut Peers| {
            let own = credentials(id);
            let to = Some((&own, Member::Federate(0)));
            let mut connection = Connection::open(address, patience, to).unwrap();
            let mut out = bytes.clone();
            while connection.bytes().is_empty() {
                connection.read();
                connection.write(&mut out);
                look(peers, &mut federate);
            }
            let (answer, _) = FromPeer::decode(connection.bytes()).unwrap().unwrap();
            (connection, answer)
        };
        let (_other, answer) = meet(2, &mut peers);
        assert_eq!(answer, FromPeer::Reject(RejectReason::HmacWrong));
        let (_sender, answer) = meet(1, &mut peers);
        assert_eq!(answer, FromPeer::Ack);
        assert_eq!(federate.counters().refused, 2);
        let words: Vec<_> = std::iter::from_fn(|| federate.poll_event())
            .filter_map(|event| {
                let FederateEvent::PeerRefused(words) = event else {
                    return None;
                };
                Some(words)
            })
            .collect();
        assert!(words[0].contains("it does not speak TLS"), "{words:?}");
        assert!(
            words[1].contains("federate 2, by its certificate"),
            "{words:?}"
        );
        assert!(!federate.peers_missing());
    }

    #[test]
    fn a_receiver_that_takes_nothing_is_given_up_and_one_that_is_slow_is_not() {
        let (mut peers, mut federate) = (Peers::default(), federate(false));
        let listener = TcpListener::bind(here()).unwrap();
        let port = listener.local_addr().unwrap().port();
        hear(
            &mut federate,
            &ToFederate::AddressQueryReply {
                port: i32::from(port),
                address: [127, 0, 0, 1],
            },
        );
        let events = std::iter::from_fn(|| federate.poll_event());
        let asked = events.last().unwrap();
        let FederateEvent::Connect { address, port, .. } = asked else {
            panic!("{asked:?}");
        };
        assert_eq!(peers.connect(&mut federate, NOW, 1, (address, port)), None);
        let (mut receiver, _) = listener.accept().unwrap();
        let mut ack = Vec::new();
        FromPeer::Ack.encode(&mut ack);
        receiver.write_all(&ack).unwrap();
        let stream = peers.connections[0].stream;
        // It has met everybody when it proposes a start time.
        while !has_proposed(&mut federate) {
            look(&mut peers, &mut federate);
        }
        federate.peer_output(stream).resize(64 << 20, 0);
        let later = |seconds| NOW + Duration::from_secs(seconds);
        peers.write(later(0), &mut federate);
        peers.write(later(1), &mut federate);
        // Something is taken: the time begins anew.
        let waiting = peers.backlog(&mut federate);
        let mut taken = vec![0; 8 << 20];
        while peers.backlog(&mut federate) == waiting {
            receiver.read_exact(&mut taken[..64 << 10]).unwrap();
            peers.write(later(9), &mut federate);
        }
        // The kernel may still have been making room.
        let mut before = usize::MAX;
        while peers.backlog(&mut federate) < before {
            before = peers.backlog(&mut federate);
            peers.write(later(9), &mut federate);
        }
        peers.give_up(later(15), &mut federate);
        assert!(federate.outcome().is_none());
        peers.give_up(later(20), &mut federate);
        let outcome = federate.outcome();
        assert!(
            matches!(outcome, Some(Outcome::PeerStuck(1))),
            "{outcome:?}"
        );
    }
}
