//! The server over real sockets on the loopback interface.

#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "a test")]

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{IpAddr, Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::os::fd::AsRawFd;
use std::thread::JoinHandle;
use std::time::Duration;

use ictus_coord::auth::Proof;
use ictus_coord::wire::{
    NO_CLOCK_SYNC, NeighborStructure, RejectReason, TaggedMessage, ToFederate, ToRti,
};
use ictus_core::{Delay, PhysicalTime, Tag};
use ictus_rti::{BindError, Options, Server, Status};

/// No read of a test waits longer than this.
const PATIENCE: Duration = Duration::from_secs(20);

/// A server on a thread.
struct Running {
    address: SocketAddr,
    thread: JoinHandle<u8>,
}

fn serve(options: Options) -> Running {
    let server = Server::bind(&options, Status::default()).unwrap();
    let address = SocketAddr::new(options.bind, server.port());
    Running {
        address,
        thread: std::thread::spawn(move || server.run().unwrap()),
    }
}

#[test]
fn only_hosts_of_the_federation_are_let_in() {
    let mut options = Options::new("test", 1);
    options.allow = vec![Ipv4Addr::new(10, 9, 8, 7)];
    let refusing = serve(options.clone());
    let mut refused = refusing.connect();
    assert_eq!(
        refused.stream.read(&mut [0]).unwrap_or(0),
        0,
        "it is told nothing"
    );
    options.allow.push(Ipv4Addr::LOCALHOST);
    let admitting = serve(options);
    let mut peer = admitting.join(0, &[], &[]);
    peer.start();
}

impl Running {
    fn ended(self) -> u8 {
        self.thread.join().unwrap()
    }

    fn connect(&self) -> Peer {
        self.connect_to(self.address.ip())
    }

    fn connect_to(&self, address: impl Into<IpAddr>) -> Peer {
        let address = SocketAddr::new(address.into(), self.address.port());
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.set_write_timeout(Some(PATIENCE)).unwrap();
        stream.set_nodelay(true).unwrap();
        Peer {
            stream,
            unread: Vec::new(),
        }
    }

    /// Sends everything up to TIMESTAMP at once.
    fn join(&self, federate: u16, upstream: &[u16], downstream: &[u16]) -> Peer {
        let mut peer = self.connect();
        peer.introduce(federate, upstream, downstream);
        peer
    }
}

struct Peer {
    stream: TcpStream,
    unread: Vec<u8>,
}

impl Peer {
    /// Sends everything up to TIMESTAMP at once.
    fn introduce(&mut self, federate: u16, upstream: &[u16], downstream: &[u16]) {
        self.send(&[
            ToRti::FederateIds {
                federate,
                federation: b"test",
            },
            ToRti::NeighborStructure(NeighborStructure {
                upstream: upstream.iter().map(|&id| (id, Delay::None)).collect(),
                downstream: downstream.to_vec(),
            }),
            ToRti::UdpPort(NO_CLOCK_SYNC),
            ToRti::Capabilities(0),
            ToRti::Timestamp(PhysicalTime::from_nanos(1_000_000_000)),
        ]);
    }

    fn send(&mut self, messages: &[ToRti<'_>]) {
        let mut bytes = Vec::new();
        for message in messages {
            message.encode(&mut bytes);
        }
        self.stream.write_all(&bytes).unwrap();
    }

    /// The next message, told as text; `None` at the end.
    fn next(&mut self) -> Option<String> {
        loop {
            if let Some((message, length)) = ToFederate::decode(&self.unread).unwrap() {
                let told = tell(&message);
                self.unread.drain(..length);
                return Some(told);
            }
            let mut buffer = vec![0; 256 << 10];
            let read = self.stream.read(&mut buffer).unwrap();
            if read == 0 {
                assert!(
                    self.unread.is_empty(),
                    "the stream ends with a whole message"
                );
                return None;
            }
            self.unread.extend_from_slice(&buffer[..read]);
        }
    }

    /// Reads until a message that starts so.
    fn wait_for(&mut self, start: &str) -> String {
        loop {
            let message = self
                .next()
                .unwrap_or_else(|| panic!("no {start} before the end"));
            if message.starts_with(start) {
                return message;
            }
        }
    }

    fn start(&mut self) -> i64 {
        assert_eq!(self.next().unwrap(), "Ack");
        let told = self.wait_for("Timestamp(");
        told.trim_start_matches("Timestamp(")
            .trim_end_matches(')')
            .parse()
            .unwrap()
    }

    fn resign(mut self) {
        self.send(&[ToRti::NextEventTag(Tag::FOREVER), ToRti::Resign]);
        self.stream.shutdown(Shutdown::Write).unwrap();
        while self.next().is_some() {}
    }
}

fn tell(message: &ToFederate<'_>) -> String {
    if let ToFederate::TaggedMessage(message) = message {
        format!(
            "TaggedMessage({})",
            String::from_utf8_lossy(message.payload)
        )
    } else {
        format!("{message:?}")
    }
}

/// Authenticates with `key` as federate `id`; returns the RTI's nonce.
fn authenticate(peer: &mut Peer, id: u16, key: &[u8]) -> [u8; 8] {
    let nonce = [7; 8];
    peer.send(&[ToRti::FederateNonce {
        federate: id,
        nonce,
    }]);
    let mut bytes = [0; 41];
    peer.stream.read_exact(&mut bytes).unwrap();
    let Ok(Some((
        ToFederate::RtiResponse {
            nonce: theirs,
            hmac,
        },
        41,
    ))) = ToFederate::decode(&bytes)
    else {
        panic!("{bytes:?} is no RTI_RESPONSE");
    };
    let proof = Proof::Rti {
        federate: id,
        nonce,
    };
    assert!(proof.verify(b"test", &hmac), "the RTI knows the key");
    let hmac = Proof::Federate { nonce: theirs }.sign(key);
    peer.send(&[ToRti::FederateResponse { hmac }]);
    theirs
}

fn message(federate: u16, tag: Tag, payload: &[u8]) -> ToRti<'_> {
    ToRti::TaggedMessage(TaggedMessage {
        port: 0,
        federate,
        tag,
        payload,
    })
}

#[test]
fn only_those_who_know_the_federation_id_join() {
    let mut options = Options::new("test", 1);
    options.config.authentication = true;
    let rti = serve(options);
    let refused = format!("{:?}", ToFederate::Reject(RejectReason::HmacWrong));
    let mut plain = rti.join(0, &[], &[]);
    assert_eq!(plain.next().unwrap(), refused);
    assert_eq!(plain.next(), None);
    let mut wrong = rti.connect();
    let first = authenticate(&mut wrong, 0, b"tests");
    assert_eq!(wrong.next().unwrap(), refused);
    assert_eq!(wrong.next(), None);
    let mut right = rti.connect();
    let second = authenticate(&mut right, 0, b"test");
    assert_ne!(first, second, "a nonce is used once");
    right.introduce(0, &[], &[]);
    right.start();
    right.resign();
    assert_eq!(rti.ended(), 0);
}

/// An address of this host that is not a loopback one, if it has one.
fn own_address() -> Ipv4Addr {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).unwrap();
    // Nothing is sent: this asks which interface would be used.
    match socket.connect((Ipv4Addr::new(198, 51, 100, 1), 9)) {
        Ok(()) => match socket.local_addr().unwrap().ip() {
            IpAddr::V4(address) => address,
            IpAddr::V6(_) => Ipv4Addr::LOCALHOST,
        },
        Err(_) => Ipv4Addr::LOCALHOST,
    }
}

#[test]
fn a_federate_from_elsewhere_is_not_told_a_loopback_address() {
    let mut options = Options::new("test", 2);
    options.bind = Ipv4Addr::UNSPECIFIED.into();
    let rti = serve(options);
    let mut near = rti.connect_to(Ipv4Addr::LOCALHOST);
    near.send(&[
        ToRti::FederateIds {
            federate: 0,
            federation: b"test",
        },
        ToRti::AddressAdvertisement { port: 7000 },
        ToRti::AddressQuery {
            federate: 0,
            transient: None,
        },
    ]);
    assert_eq!(near.next().unwrap(), "Ack");
    // The answer to itself says that it has been heard.
    let told = |address: Ipv4Addr| {
        let address = address.octets();
        let reply = ToFederate::AddressQueryReply {
            port: 7000,
            address,
        };
        Some(format!("{reply:?}"))
    };
    assert_eq!(near.next(), told(Ipv4Addr::LOCALHOST));
    let here = own_address();
    let mut far = rti.connect_to(here);
    far.send(&[
        ToRti::FederateIds {
            federate: 1,
            federation: b"test",
        },
        ToRti::AddressQuery {
            federate: 0,
            transient: None,
        },
    ]);
    assert_eq!(far.next().unwrap(), "Ack");
    assert_eq!(far.next(), told(here));
    drop(far);
    near.wait_for("Failed");
    drop(near);
    assert_eq!(rti.ended(), 1);
}

#[test]
fn bad_bytes_hurt_nobody_else() {
    let rti = serve(Options::new("test", 2));
    // A stream of bytes that a fixed linear congruential generator makes.
    let mut state = 7u32;
    let mut strangers = Vec::new();
    for length in 0..100usize {
        let mut peer = rti.connect();
        let bytes: Vec<u8> = (0..length)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                state.to_le_bytes()[3]
            })
            .collect();
        peer.stream.write_all(&bytes).unwrap();
        strangers.push(peer);
    }
    let mut source = rti.join(0, &[], &[1]);
    let mut half = rti.connect();
    half.stream.write_all(&[1, 1, 0, 4, b't']).unwrap();
    let mut wrong = rti.join(0, &[], &[]);
    assert_eq!(
        wrong.next().unwrap(),
        format!("{:?}", ToFederate::Reject(RejectReason::FederateIdInUse))
    );
    assert_eq!(wrong.next(), None);
    let mut sink = rti.join(1, &[0], &[]);
    let start = source.start();
    assert_eq!(sink.start(), start);
    sink.send(&[ToRti::NextEventTag(Tag::at(start))]);
    source.send(&[
        message(1, Tag::at(start), b"hello"),
        ToRti::NextEventTag(Tag::FOREVER),
    ]);
    assert_eq!(sink.wait_for("TaggedMessage"), "TaggedMessage(hello)");
    sink.wait_for("TagAdvanceGrant(FOREVER)");
    source.resign();
    sink.resign();
    drop(strangers);
    drop(half);
    assert_eq!(rti.ended(), 0);
}

#[test]
fn silent_strangers_keep_nobody_out() {
    let rti = serve(Options::new("test", 2));
    let mut first = rti.join(0, &[], &[]);
    assert_eq!(first.next().unwrap(), "Ack");
    // More than there is room for.
    let mut silent: Vec<_> = (0..270).map(|_| rti.connect()).collect();
    let mut second = rti.join(1, &[], &[]);
    second.start();
    first.wait_for("Timestamp(");
    assert_eq!(silent[0].next(), None, "the oldest made room");
    first.resign();
    second.resign();
    assert_eq!(rti.ended(), 0);
}

#[test]
fn a_late_connection_is_refused_at_once() {
    let rti = serve(Options::new("test", 1));
    let mut only = rti.join(0, &[], &[]);
    only.start();
    let mut late = rti.connect();
    assert_eq!(late.next().unwrap(), "Reject(FederationId)");
    assert_eq!(late.next(), None);
    only.resign();
    assert_eq!(rti.ended(), 0);
}

#[test]
fn an_output_queue_beyond_its_limit_ends_the_federation() {
    let mut options = Options::new("test", 2);
    options.config.max_output = 1 << 20;
    let rti = serve(options);
    let mut flood = rti.join(0, &[], &[1]);
    let mut deaf = rti.join(1, &[0], &[]);
    let start = flood.start();
    assert_eq!(deaf.start(), start);
    let payload = vec![42; 32 << 10];
    let mut bytes = Vec::new();
    message(1, Tag::at(start), &payload).encode(&mut bytes);
    // Until the RTI has had enough and closes.
    while flood.stream.write_all(&bytes).is_ok() {}
    assert_eq!(rti.ended(), 1);
}

#[test]
fn a_slow_reader_blocks_nobody() {
    const MESSAGES: usize = 800;
    let rti = serve(Options::new("test", 4));
    let mut flood = rti.join(0, &[], &[1]);
    let mut slow = rti.join(1, &[0], &[]);
    let mut source = rti.join(2, &[], &[3]);
    let mut sink = rti.join(3, &[2], &[]);
    let start = flood.start();
    for peer in [&mut slow, &mut source, &mut sink] {
        assert_eq!(peer.start(), start);
    }
    // More than the kernel keeps for a reader that does not read: 26 MB.
    let payload = vec![42; 32 << 10];
    for number in 0..MESSAGES {
        let tag = Tag::at(start + i64::try_from(number).unwrap());
        flood.send(&[message(1, tag, &payload)]);
    }
    sink.send(&[ToRti::NextEventTag(Tag::at(start))]);
    for number in 0..100 {
        let tag = Tag::at(start + number);
        source.send(&[message(3, tag, b"quick"), ToRti::LatestTagConfirmed(tag)]);
        sink.wait_for("TagAdvanceGrant");
        sink.send(&[
            ToRti::LatestTagConfirmed(tag),
            ToRti::NextEventTag(Tag::at(start + number + 1)),
        ]);
    }
    source.resign();
    sink.resign();
    flood.resign();
    let mut received = 0;
    slow.send(&[ToRti::NextEventTag(Tag::at(start))]);
    while received < MESSAGES {
        slow.wait_for("TaggedMessage");
        received += 1;
    }
    slow.resign();
    assert_eq!(rti.ended(), 0);
}

#[test]
fn what_was_sent_before_a_reset_counts() {
    const MESSAGES: i64 = 1_000;
    let rti = serve(Options::new("test", 2));
    let mut source = rti.join(0, &[], &[1]);
    let mut sink = rti.join(1, &[0], &[]);
    let start = source.start();
    sink.start();
    source.send(&[ToRti::NextEventTag(Tag::at(start))]);
    sink.send(&[ToRti::NextEventTag(Tag::at(start))]);
    // A DNET lies unread in the source's buffer: closing the socket resets the connection.
    source.stream.peek(&mut [0]).unwrap();
    let mut last: Vec<_> = (0..MESSAGES)
        .map(|number| message(1, Tag::at(start + number), b"x"))
        .collect();
    last.extend([ToRti::NextEventTag(Tag::FOREVER), ToRti::Resign]);
    source.send(&last);
    drop(source);
    for _ in 0..MESSAGES {
        sink.wait_for("TaggedMessage");
    }
    sink.wait_for("TagAdvanceGrant(FOREVER)");
    sink.resign();
    assert_eq!(rti.ended(), 0);
}

#[test]
fn control_messages_come_whole() {
    let rti = serve(Options::new("test", 2));
    let mut source = rti.join(0, &[], &[1]);
    let mut sink = rti.join(1, &[0], &[]);
    let start = source.start();
    sink.start();
    assert!(sink.unread.is_empty());
    sink.send(&[ToRti::NextEventTag(Tag::at(start))]);
    for number in 1..1000 {
        source.send(&[ToRti::NextEventTag(Tag::at(start + number))]);
        // A reader that takes what is there gets whole messages: 13 bytes each, never a part of one.
        let mut buffer = [0; 64 << 10];
        let read = sink.stream.read(&mut buffer).unwrap();
        assert!(read > 0 && read.is_multiple_of(13), "{read}");
    }
    source.resign();
    sink.resign();
    assert_eq!(rti.ended(), 0);
}

#[test]
fn a_vanished_federate_ends_the_federation() {
    let rti = serve(Options::new("test", 2));
    let mut source = rti.join(0, &[], &[1]);
    let mut sink = rti.join(1, &[0], &[]);
    let start = source.start();
    sink.start();
    sink.send(&[ToRti::NextEventTag(Tag::at(start))]);
    source.send(&[
        message(1, Tag::at(start), b"last words"),
        ToRti::NextEventTag(Tag::at(start + 10)),
    ]);
    drop(source);
    sink.wait_for("TaggedMessage");
    sink.wait_for("StopRequest");
    let stop = Tag::at(start + 1);
    sink.send(&[
        ToRti::LatestTagConfirmed(Tag::at(start)),
        ToRti::StopRequestReply(stop),
    ]);
    sink.wait_for("StopGranted");
    sink.resign();
    assert_eq!(rti.ended(), 1);
}

#[test]
fn a_peer_that_has_failed_is_not_read_for_long() {
    const BLOCK: usize = 1 << 20;
    let rti = serve(Options::new("test", 1));
    let mut flood = rti.join(0, &[], &[]);
    flood.start();
    flood.stream.write_all(&[99]).unwrap();
    assert_eq!(flood.next().unwrap(), "Failed");
    let block = vec![0; BLOCK];
    let mut taken = 0;
    while flood.stream.write_all(&block).is_ok() {
        taken += BLOCK;
    }
    // The sockets hold some as well.
    assert!(taken < 64 << 20, "{taken} bytes were taken");
    assert_eq!(rti.ended(), 1);
}

#[test]
fn a_port_in_use_is_named() {
    let other = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = other.local_addr().unwrap().port();
    let options = Options {
        port,
        ..Options::new("test", 1)
    };
    let Err(error @ BindError::InUse { .. }) = Server::bind(&options, Status::default()) else {
        panic!("the port is in use");
    };
    let expected = format!(
        "port {port} on 127.0.0.1 is already in use; choose another with `-p`, or 0 for any"
    );
    assert_eq!(error.to_string(), expected);
}

#[test]
fn status_lines_tell_the_story() {
    let (reader, writer) = std::io::pipe().unwrap();
    let descriptor = u32::try_from(writer.as_raw_fd()).unwrap();
    let status = Status::open(Some(descriptor)).unwrap();
    drop(writer);
    let options = Options::new("test", 1);
    let server = Server::bind(&options, status).unwrap();
    let address = SocketAddr::new(options.bind, server.port());
    let rti = Running {
        address,
        thread: std::thread::spawn(move || server.run().unwrap()),
    };
    let mut only = rti.join(0, &[], &[]);
    only.start();
    only.resign();
    assert_eq!(rti.ended(), 0);
    let events: Vec<String> = BufReader::new(reader)
        .lines()
        .map(|line| {
            let line: serde_json::Value = serde_json::from_str(&line.unwrap()).unwrap();
            line["event"].as_str().unwrap().to_owned()
        })
        .collect();
    assert_eq!(
        events,
        ["listening", "joined", "start", "resigned", "ended"]
    );
}

/// A federate as LF writes them: three exchanges over TCP, then T3 of three bytes to whatever T1 comes.
struct Probed {
    peer: Peer,
    socket: UdpSocket,
}

fn join_probed(rti: &Running) -> Probed {
    let mut peer = rti.connect();
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    let federation = b"test";
    let structure = NeighborStructure {
        upstream: Vec::new(),
        downstream: Vec::new(),
    };
    peer.send(&[
        ToRti::FederateIds {
            federate: 0,
            federation,
        },
        ToRti::NeighborStructure(structure),
        ToRti::UdpPort(socket.local_addr().unwrap().port()),
    ]);
    assert_eq!(peer.next().unwrap(), "Ack");
    for _ in 0..3 {
        peer.wait_for("ClockSyncT1");
        peer.send(&[ToRti::ClockSyncT3 { federate: 0 }]);
        peer.wait_for("ClockSyncT4");
    }
    peer.send(&[ToRti::Timestamp(PhysicalTime::from_nanos(1_000_000_000))]);
    Probed { peer, socket }
}

fn probing() -> Options {
    let mut options = Options::new("test", 1);
    options.config.clock_exchanges = 3;
    options.config.clock_period = Some(ictus_core::Duration::from_millis(1));
    options
}

/// The next datagram: its type, its reading, who sent it.
fn probe(socket: &UdpSocket) -> (u8, i64, SocketAddr) {
    let mut bytes = [0; 64];
    let (length, from) = socket.recv_from(&mut bytes).unwrap();
    assert_eq!(length, 9, "LF's datagrams have nine bytes");
    (
        bytes[0],
        i64::from_le_bytes(bytes[1..9].try_into().unwrap()),
        from,
    )
}

#[test]
fn clocks_are_compared_for_ever_as_lf_does() {
    let rti = serve(probing());
    let Probed { mut peer, socket } = join_probed(&rti);
    peer.wait_for("Timestamp(");
    for _ in 0..20 {
        let (kind, t1, from) = probe(&socket);
        assert_eq!(kind, 19);
        socket.send_to(&[20, 0, 0], from).unwrap();
        let (kind, t4, _) = probe(&socket);
        assert!(kind == 21 && t4 >= t1);
        let (kind, t5, _) = probe(&socket);
        assert!(kind == 22 && t5 >= t4);
    }
    peer.resign();
    assert_eq!(rti.ended(), 0);
}

#[test]
fn a_stranger_answers_no_probe() {
    let rti = serve(probing());
    let Probed { mut peer, socket } = join_probed(&rti);
    peer.wait_for("Timestamp(");
    let (_, _, from) = probe(&socket);
    let stranger = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    for bytes in [&[20, 0, 0][..], &[20, 9, 0], &[19; 9], &[0; 60_000], &[]] {
        stranger.send_to(bytes, from).unwrap();
    }
    for bytes in [
        &[20, 1, 0][..],
        &[20, 0],
        &[7; 500],
        &[20, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1],
    ] {
        socket.send_to(bytes, from).unwrap();
    }
    socket.send_to(&[20, 0, 0], from).unwrap();
    assert_eq!(probe(&socket).0, 21, "the answer is taken all the same");
    peer.resign();
    assert_eq!(rti.ended(), 0);
}

#[test]
fn a_federate_that_answers_no_probe_keeps_nobody_waiting() {
    let mut options = probing();
    options.config.federates = 2;
    let rti = serve(options);
    let mut probed = join_probed(&rti);
    let mut other = rti.join(1, &[], &[]);
    other.start();
    probed.peer.wait_for("Timestamp(");
    assert_eq!(probe(&probed.socket).0, 19);
    other.resign();
    probed.peer.resign();
    assert_eq!(rti.ended(), 0);
}

/// Who does not join in time is not waited for; whoever has joined is told.
#[test]
fn federates_that_do_not_join_in_time_end_the_rti() {
    let options = Options {
        join_timeout: Some(Duration::from_secs(1)),
        ..Options::new("test", 2)
    };
    let rti = serve(options);
    let mut peer = rti.join(0, &[], &[]);
    assert_eq!(peer.next().unwrap(), "Ack");
    while peer.next().is_some() {}
    assert_eq!(rti.ended(), 1);
}
