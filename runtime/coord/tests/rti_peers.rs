//! Federates that set up their peers in any order: each hears nothing but what it asked for until it has the start time.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::wildcard_enum_match_arm,
    missing_docs,
    reason = "a test"
)]

use ictus_coord::rti::{ConnectionId, Rti, RtiConfig};
use ictus_coord::wire::{NO_CLOCK_SYNC, NeighborStructure, ToFederate, ToRti};
use ictus_core::PhysicalTime;
use proptest::prelude::*;

const FEDERATES: u16 = 4;
const NOW: PhysicalTime = PhysicalTime::from_nanos(1_000_000);

/// A federate as LF writes it: it advertises, asks for one peer after the other until each is known, then proposes a time.
struct Peer {
    id: u16,
    connection: ConnectionId,
    /// What it says before it asks for peers, last first.
    script: Vec<ToRti<'static>>,
    /// The peers that it has not found.
    wanted: Vec<u16>,
    /// Whether a question has no answer yet.
    asking: bool,
    proposed: bool,
    started: bool,
    /// Bytes on their way to the RTI.
    outbox: Vec<u8>,
}

impl Peer {
    /// It advertises before NEIGHBOR_STRUCTURE, before UDP_PORT or after it.
    fn new(id: u16, connection: ConnectionId, advertises: usize, wanted: Vec<u16>) -> Self {
        let mut script = vec![
            ToRti::UdpPort(NO_CLOCK_SYNC),
            ToRti::NeighborStructure(NeighborStructure::default()),
            ToRti::FederateIds {
                federate: id,
                federation: b"peers",
            },
        ];
        let port = 7000 + i32::from(id);
        script.insert(advertises, ToRti::AddressAdvertisement { port });
        Self {
            id,
            connection,
            script,
            wanted,
            asking: false,
            proposed: false,
            started: false,
            outbox: Vec::new(),
        }
    }

    /// The next thing that it does of itself; it waits for the answer to a question.
    fn act(&mut self) {
        if let Some(message) = self.script.pop() {
            message.encode(&mut self.outbox);
        } else if self.asking || self.proposed {
        } else if let Some(&federate) = self.wanted.first() {
            self.asking = true;
            let query = ToRti::AddressQuery {
                federate,
                transient: None,
            };
            query.encode(&mut self.outbox);
        } else {
            self.proposed = true;
            ToRti::Timestamp(NOW).encode(&mut self.outbox);
        }
    }

    /// What the RTI says: ACK, an answer for each question, the start time.
    fn hear(&mut self, message: &ToFederate<'_>) {
        match message {
            ToFederate::Ack => {}
            ToFederate::AddressQueryReply { port, .. } => {
                assert!(self.asking, "federate {} has not asked", self.id);
                self.asking = false;
                if *port != -1 {
                    let found = self.wanted.remove(0);
                    assert_eq!(*port, 7000 + i32::from(found));
                }
            }
            ToFederate::Timestamp(_) => {
                assert!(self.proposed && !self.started, "federate {}", self.id);
                self.started = true;
            }
            other => panic!("federate {} hears {other:?}", self.id),
        }
    }
}

fn deliver(rti: &mut Rti, peers: &mut [Peer]) {
    rti.drain(NOW);
    while let Some(id) = rti.poll_output() {
        let peer = peers.iter_mut().find(|peer| peer.connection == id).unwrap();
        let bytes = rti.output(id).chunk().to_vec();
        rti.output(id).advance(bytes.len());
        let mut at = 0;
        while let Some((message, length)) = ToFederate::decode(&bytes[at..]).unwrap() {
            peer.hear(&message);
            at += length;
        }
        assert_eq!(at, bytes.len());
    }
}

proptest! {
    #[test]
    fn peers_hear_only_answers_until_the_start(
        advertises in prop::array::uniform4(0usize..3),
        edges in prop::collection::vec((0..FEDERATES, 0..FEDERATES), 0..10),
        turns in prop::collection::vec((0usize..4, 1usize..40, any::<bool>()), 0..300),
    ) {
        let mut rti = Rti::new(RtiConfig::new("peers", FEDERATES));
        let mut peers: Vec<Peer> = (0..FEDERATES)
            .map(|id| {
                let connection = rti.connect(NOW, format!("192.0.2.{id}:4000"));
                let of_it = edges.iter().filter(|edge| edge.0 == id);
                let wanted = of_it.map(|edge| edge.1).collect();
                Peer::new(id, connection, advertises[usize::from(id)], wanted)
            })
            .collect();
        // At random first, in pieces of any size; then in turns until all have started.
        let rest = (0..400).map(|turn| (turn % 4, 1000, true));
        for (at, piece, drains) in turns.into_iter().chain(rest) {
            let peer = &mut peers[at];
            if peer.outbox.is_empty() {
                peer.act();
            }
            let bytes = &peer.outbox[..piece.min(peer.outbox.len())];
            let taken = rti.receive(NOW, peer.connection, bytes);
            peer.outbox.drain(..taken);
            if taken == 0 && !peer.outbox.is_empty() {
                // The rest has come, too.
                let taken = rti.receive(NOW, peer.connection, &peer.outbox);
                peer.outbox.drain(..taken);
            }
            if drains {
                deliver(&mut rti, &mut peers);
            }
        }
        prop_assert!(peers.iter().all(|peer| peer.started));
    }
}
