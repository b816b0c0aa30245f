//! Random bytes, half messages and sudden ends at the RTI: it never panics, and a good federation is not touched.

#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use std::collections::BTreeSet;

use ictus_coord::auth::Proof;
use ictus_coord::plan::Wire;
use ictus_coord::rti::{Closing, ConnectionId, Disconnect, Newcomer, Rti, RtiConfig};
use ictus_coord::wire::{
    NO_CLOCK_SYNC, NeighborStructure, RejectReason, TaggedMessage, ToFederate, ToRti,
};
use ictus_core::{Delay, Duration, LogicalTime, PhysicalTime, Tag};
use proptest::collection::vec;
use proptest::prelude::*;

/// What a stranger, or a federate gone mad, does.
#[derive(Clone, Debug)]
enum Act {
    Connect,
    /// Bytes on one of the connections.
    Bytes(usize, Vec<u8>),
    End(usize),
    /// Milliseconds.
    Wait(i64),
    Stop,
    Drain,
}

fn tag() -> impl Strategy<Value = Tag> {
    prop_oneof![
        Just(Tag::NEVER),
        Just(Tag::FOREVER),
        (any::<i64>(), any::<u32>()).prop_map(|(t, m)| Tag::new(LogicalTime::from_nanos(t), m)),
        (0i64..2_000_000_000).prop_map(Tag::at),
    ]
}

/// Messages that are well formed, in no sensible order.
fn message() -> impl Strategy<Value = Vec<u8>> {
    let federate = prop_oneof![4 => 0u16..3, 1 => any::<u16>()];
    let delay = (-1i64..5).prop_map(|nanos| Delay::after(Duration::from_nanos(nanos)));
    let neighbors = (vec((0u16..4, delay), 0..3), vec(0u16..4, 0..3));
    (0..19u8, federate, tag(), neighbors, any::<i64>()).prop_map(
        |(kind, federate, tag, (upstream, downstream), number)| {
            let mut bytes = Vec::new();
            let message = match kind {
                0 | 1 => ToRti::FederateIds {
                    federate,
                    federation: b"good",
                },
                2 => ToRti::NeighborStructure(NeighborStructure {
                    upstream,
                    downstream,
                }),
                3 => ToRti::UdpPort(federate.wrapping_sub(1)),
                4 => ToRti::Timestamp(PhysicalTime::from_nanos(number)),
                5 => ToRti::NextEventTag(tag),
                6 => ToRti::LatestTagConfirmed(tag),
                7 => ToRti::TaggedMessage(TaggedMessage {
                    port: 1,
                    federate,
                    tag,
                    payload: b"abc",
                }),
                8 => ToRti::StopRequest(tag),
                9 => ToRti::StopRequestReply(tag),
                10 => ToRti::Resign,
                11 => ToRti::ClockSyncT3 { federate },
                12 => ToRti::Capabilities(3),
                13 => ToRti::AddressAdvertisement {
                    port: i32::from(federate) - 1,
                },
                14 => ToRti::DataAddress {
                    port: 7000,
                    address: [127, 0, 0, 1],
                },
                15 => ToRti::FederateNonce {
                    federate,
                    nonce: [1; 8],
                },
                16 => ToRti::FederateResponse {
                    hmac: Proof::Federate { nonce: [2; 8] }.sign(b"good"),
                },
                17 => ToRti::Reject(RejectReason::HmacWrong),
                _ => ToRti::AddressQuery {
                    federate,
                    transient: None,
                },
            };
            message.encode(&mut bytes);
            bytes
        },
    )
}

fn act() -> impl Strategy<Value = Act> {
    prop_oneof![
        2 => Just(Act::Connect),
        8 => (any::<prop::sample::Index>(), vec(message(), 1..4))
            .prop_map(|(at, messages)| Act::Bytes(at.index(100), messages.concat())),
        2 => (any::<prop::sample::Index>(), vec(any::<u8>(), 0..40))
            .prop_map(|(at, bytes)| Act::Bytes(at.index(100), bytes)),
        2 => any::<prop::sample::Index>().prop_map(|at| Act::End(at.index(100))),
        1 => (0i64..40_000).prop_map(Act::Wait),
        1 => Just(Act::Stop),
        6 => Just(Act::Drain),
    ]
}

fn wire() -> impl Strategy<Value = Wire> {
    prop_oneof![Just(Wire::V0_12), Just(Wire::V0_13)]
}

/// A driver without sockets.
struct Driver {
    rti: Rti,
    now: PhysicalTime,
    open: Vec<(ConnectionId, Vec<u8>)>,
}

impl Driver {
    fn new(federates: u16, authentication: bool, wire: Wire) -> Self {
        let config = RtiConfig {
            clock_exchanges: 1,
            authentication,
            wire,
            continue_without: BTreeSet::from([1]),
            ..RtiConfig::new("good", federates)
        };
        Self {
            rti: Rti::new(config),
            now: PhysicalTime::from_nanos(1),
            open: Vec::new(),
        }
    }

    fn connect(&mut self) -> ConnectionId {
        let newcomer = Newcomer {
            peer: "192.0.2.1:4000".to_owned(),
            local: None,
            nonce: Some([2; 8]),
        };
        let id = self.rti.connect(self.now, newcomer);
        self.open.push((id, Vec::new()));
        id
    }

    fn act(&mut self, act: &Act) {
        match act {
            Act::Connect => drop(self.connect()),
            Act::Bytes(at, bytes) if !self.open.is_empty() => {
                let at = at % self.open.len();
                let (id, unread) = &mut self.open[at];
                unread.extend_from_slice(bytes);
                let taken = self.rti.receive(self.now, *id, unread);
                unread.drain(..taken);
            }
            Act::End(at) if !self.open.is_empty() => {
                let (id, _) = self.open.swap_remove(at % self.open.len());
                self.rti.disconnect(self.now, id, &Disconnect::Reset);
            }
            Act::Bytes(..) | Act::End(_) => {}
            Act::Wait(ms) => {
                self.now = self.now + Duration::from_millis(*ms);
                self.rti.handle_timeout(self.now);
            }
            Act::Stop => self.rti.request_stop(self.now),
            Act::Drain => {
                self.round();
            }
        }
    }

    /// Everything that is written, in order; what is to close is closed.
    fn round(&mut self) -> Vec<(ConnectionId, String)> {
        self.rti.drain(self.now);
        let mut said = Vec::new();
        while let Some(id) = self.rti.poll_output() {
            let output = self.rti.output(id);
            while !output.chunk().is_empty() {
                let bytes = output.chunk().to_vec();
                output.advance(bytes.len());
                let mut at = 0;
                while let Some((message, length)) = ToFederate::decode(&bytes[at..]).unwrap() {
                    said.push((id, format!("{message:?}")));
                    at += length;
                }
                assert_eq!(at, bytes.len(), "a chunk ends with a whole message");
            }
            if output.closing() != Closing::Open {
                self.open.retain(|&(open, _)| open != id);
                self.rti.disconnect(self.now, id, &Disconnect::Eof);
            }
        }
        while self.rti.poll_event().is_some() {}
        said
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn nothing_makes_it_panic(acts in vec(act(), 0..60), authentication: bool, wire in wire()) {
        let mut driver = Driver::new(2, authentication, wire);
        for act in &acts {
            driver.act(act);
        }
        // Whatever has happened, it ends: within the handshake, stop and closing time-outs.
        driver.rti.abort(driver.now);
        driver.round();
        driver.round();
        prop_assert_eq!(driver.rti.finished().is_some(), driver.open.is_empty());
    }

    #[test]
    fn strangers_do_not_touch_a_good_federation(
        noise in vec((any::<bool>(), vec(any::<u8>(), 0..60)), 0..12),
    ) {
        let mut driver = Driver::new(1, false, Wire::V0_12);
        let mut hello = Vec::new();
        ToRti::FederateIds { federate: 0, federation: b"good" }.encode(&mut hello);
        ToRti::NeighborStructure(NeighborStructure::default()).encode(&mut hello);
        ToRti::UdpPort(NO_CLOCK_SYNC).encode(&mut hello);
        ToRti::Timestamp(PhysicalTime::from_nanos(5)).encode(&mut hello);
        let good = driver.rti.connect(driver.now, "good".to_owned());
        let mut said = Vec::new();
        for (ends, bytes) in &noise {
            let id = driver.connect();
            driver.act(&Act::Bytes(driver.open.len() - 1, bytes.clone()));
            if *ends {
                driver.open.retain(|&(open, _)| open != id);
                driver.rti.disconnect(driver.now, id, &Disconnect::Eof);
            }
            said.extend(driver.round());
        }
        prop_assert_eq!(driver.rti.receive(driver.now, good, &hello), hello.len());
        said.extend(driver.round());
        let good_said: Vec<_> =
            said.into_iter().filter(|&(id, _)| id == good).map(|(_, told)| told).collect();
        prop_assert_eq!(good_said, ["Ack", "Timestamp(1000000005)"]);
    }
}
