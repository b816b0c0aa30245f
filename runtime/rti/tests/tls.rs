//! The server under TLS: who joins, and who does not.

#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "a test")]

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::thread::JoinHandle;
use std::time::Duration;

use ictus_coord::wire::{NO_CLOCK_SYNC, NeighborStructure, TaggedMessage, ToFederate, ToRti};
use ictus_core::{Delay, PhysicalTime, Tag};
use ictus_rti::{BindError, Options, Server, Status};
use ictus_stream::{Authority, Credentials, Member, Papers, Stream, TlsError};

/// A read waits as long as this; a test reads at most so often in vain.
const LOOK: Duration = Duration::from_millis(5);
const LOOKS: u32 = 4000;

/// A server on a thread, and who makes certificates for it.
struct Running {
    authority: Authority,
    address: SocketAddr,
    thread: JoinHandle<u8>,
}

impl Running {
    fn new(federates: u16) -> Self {
        let authority = Authority::new("run").unwrap();
        let directory = tempfile::tempdir().unwrap();
        let papers = authority.certify(Member::Rti).unwrap();
        papers.write(directory.path()).unwrap();
        let mut options = Options::new("test", federates);
        options.tls = Some(directory.path().to_owned());
        let server = Server::bind(&options, Status::default()).unwrap();
        Self {
            authority,
            address: SocketAddr::new(options.bind, server.port()),
            thread: std::thread::spawn(move || server.run().unwrap()),
        }
    }

    fn tcp(&self) -> TcpStream {
        let tcp = TcpStream::connect(self.address).unwrap();
        tcp.set_nodelay(true).unwrap();
        tcp.set_read_timeout(Some(LOOK)).unwrap();
        tcp.set_write_timeout(Some(LOOK)).unwrap();
        tcp
    }

    fn connect(&self, papers: &Papers) -> Peer {
        let credentials = Credentials::of(papers).unwrap();
        Peer {
            stream: credentials.connect(self.tcp(), Member::Rti).unwrap(),
            unread: Vec::new(),
        }
    }

    /// Connects with the certificate of a federate, and says that it is this one.
    fn join(&self, certificate: u16, federate: u16) -> Peer {
        let papers = self.authority.certify(Member::Federate(certificate));
        let mut peer = self.connect(&papers.unwrap());
        peer.introduce(federate);
        peer
    }
}

struct Peer {
    stream: Stream<TcpStream>,
    unread: Vec<u8>,
}

impl Peer {
    /// Sends everything up to TIMESTAMP at once; federate 0 sends to federate 1.
    fn introduce(&mut self, federate: u16) {
        let neighbors = match federate {
            0 => (Vec::new(), vec![1]),
            _ => (vec![(0, Delay::None)], Vec::new()),
        };
        self.send(&[
            ToRti::FederateIds {
                federate,
                federation: b"test",
            },
            ToRti::NeighborStructure(NeighborStructure {
                upstream: neighbors.0,
                downstream: neighbors.1,
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
        let mut written = 0;
        for _ in 0..LOOKS {
            // The handshake goes on with what is read.
            self.read();
            if written == bytes.len() {
                match self.stream.flush() {
                    Ok(()) => return,
                    Err(error) => assert_eq!(error.kind(), ErrorKind::WouldBlock),
                }
                continue;
            }
            match self.stream.write(&bytes[written..]) {
                Ok(count) => written += count,
                Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                // Reading tells.
                Err(_) => return,
            }
        }
        panic!("{written} of {} bytes written", bytes.len());
    }

    /// Reads what is there; whether the end has come.
    fn read(&mut self) -> bool {
        let mut buffer = vec![0; 64 << 10];
        match self.stream.read(&mut buffer) {
            Ok(0) => return true,
            Ok(count) => self.unread.extend(&buffer[..count]),
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(_) => return true,
        }
        false
    }

    /// The next message by its name, and its payload's length; nothing at the end.
    fn next(&mut self) -> Option<(String, usize)> {
        for _ in 0..LOOKS {
            if let Some((message, length)) = ToFederate::decode(&self.unread).unwrap() {
                let payload = if let ToFederate::TaggedMessage(message) = &message {
                    message.payload.len()
                } else {
                    0
                };
                let text = format!("{message:?}");
                let name = text.split(['(', ' ']).next().unwrap().to_owned();
                let name = if name == "Reject" { text } else { name };
                self.unread.drain(..length);
                return Some((name, payload));
            }
            if self.read() {
                return None;
            }
        }
        panic!("neither a message nor the end");
    }

    fn wait_for(&mut self, name: &str) -> usize {
        loop {
            let (next, payload) = self.next().unwrap_or_else(|| panic!("no {name}"));
            if next == name {
                return payload;
            }
        }
    }
}

#[test]
fn federates_with_certificates_join_and_send_each_other() {
    let rti = Running::new(2);
    let (mut sender, mut receiver) = (rti.join(0, 0), rti.join(1, 1));
    for peer in [&mut sender, &mut receiver] {
        peer.wait_for("Timestamp");
    }
    let payload = vec![7; 8 << 20];
    let reader = std::thread::spawn(move || (receiver.wait_for("TaggedMessage"), receiver));
    let tag = Tag::new(PhysicalTime::from_nanos(3_000_000_000).as_logical(), 0);
    let message = TaggedMessage {
        port: 0,
        federate: 1,
        tag,
        payload: &payload,
    };
    sender.send(&[ToRti::TaggedMessage(message)]);
    let (came, mut receiver) = reader.join().unwrap();
    assert_eq!(came, payload.len());
    for peer in [&mut sender, &mut receiver] {
        peer.send(&[ToRti::Resign]);
        while peer.next().is_some() {}
        // The end was said.
        assert_eq!(peer.stream.read(&mut [0]).unwrap(), 0);
    }
    drop((sender, receiver));
    assert_eq!(rti.thread.join().unwrap(), 0);
}

#[test]
fn whoever_has_no_certificate_of_this_run_does_not_join() {
    let rti = Running::new(2);
    // In the clear: closed, without a word that LF has.
    let mut plain = rti.tcp();
    let mut bytes = Vec::new();
    let hello = ToRti::FederateIds {
        federate: 0,
        federation: b"test",
    };
    hello.encode(&mut bytes);
    plain.write_all(&bytes).unwrap();
    let mut said = Vec::new();
    plain.set_read_timeout(Some(LOOK * LOOKS)).unwrap();
    let _reset = plain.read_to_end(&mut said);
    assert!(said.is_empty() || said[0] == 21, "an alert: {said:?}");
    // Of another run with the same name.
    let other = Authority::new("run").unwrap();
    let shown = other.certify(Member::Federate(0)).unwrap();
    let trusted = rti
        .authority
        .certify(Member::Federate(0))
        .unwrap()
        .authority;
    let mut stranger = rti.connect(&shown);
    stranger.introduce(0);
    assert_eq!(stranger.next(), None);
    assert_eq!(stranger.stream.failure(), Some(&TlsError::NotOfThisRun));
    let mut stranger = rti.connect(&Papers {
        authority: trusted,
        ..shown
    });
    stranger.introduce(0);
    assert_eq!(stranger.next(), None);
    let refused = stranger.stream.failure();
    assert!(matches!(refused, Some(TlsError::Refused(_))), "{refused:?}");
    // Of another federate.
    let mut other = rti.join(1, 0);
    assert_eq!(other.next().unwrap().0, "Reject(HmacWrong)");
    assert_eq!(other.next(), None);
    // None of them stands in the way.
    let (mut a, mut b) = (rti.join(0, 0), rti.join(1, 1));
    for peer in [&mut a, &mut b] {
        peer.wait_for("Timestamp");
    }
    for mut peer in [a, b] {
        peer.send(&[ToRti::Resign]);
        while peer.next().is_some() {}
    }
    drop((plain, stranger, other));
    assert_eq!(rti.thread.join().unwrap(), 0);
}

#[test]
fn an_rti_without_its_own_certificate_does_not_start() {
    let directory = tempfile::tempdir().unwrap();
    let mut options = Options::new("test", 1);
    options.tls = Some(directory.path().to_owned());
    let bind = || Server::bind(&options, Status::default()).unwrap_err();
    let error = bind();
    assert!(matches!(error, BindError::Credentials { .. }));
    assert!(error.to_string().contains("authority.pem"), "{error}");
    let authority = Authority::new("run").unwrap();
    let papers = authority.certify(Member::Federate(0)).unwrap();
    papers.write(directory.path()).unwrap();
    let error = bind().to_string();
    assert!(
        error.ends_with("the certificate is federate 0's, and this is the RTI"),
        "{error}"
    );
}
