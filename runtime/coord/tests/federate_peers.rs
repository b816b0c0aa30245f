//! What a federate makes of what other federates send: hellos, messages in time and tardy, and anything else.
#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use ictus_coord::federate::{Federate, FederateConfig, FederateEvent, LinkConfig, Outcome};
use ictus_coord::federate::{PeerStream, Poll};
use ictus_coord::plan::{Plan, Wire};
use ictus_coord::wire::{
    FromPeer, PeerMessage, PortAbsent, RejectReason, TaggedMessage, ToFederate, ToPeer, ToRti,
};
use ictus_coord::{FederateExecutor, PayloadError};
use ictus_core::{
    ActionId, Duration, Effects, Executor, InputId, LogicalTime, NodeId, OutputId, PhysicalTime,
    PortKind, ProgramBuilder, SlotId, Tag, ValueId,
};
use proptest::collection::vec;
use proptest::prelude::*;
use std::sync::Arc;

/// Executes a program without reactions and remembers tardy messages.
#[derive(Default)]
struct Notes {
    tardy: Vec<(Tag, Tag)>,
}

impl Executor for Notes {
    fn begin(&mut self, _: Tag) {}
    fn arrive(&mut self, _: ActionId, _: Option<SlotId>, _: ValueId) {}
    fn run(&mut self, _: NodeId, _: Tag, _: &mut Effects) {}
}

impl FederateExecutor for Notes {
    fn encode(&mut self, _: OutputId, _: &mut Vec<u8>) {}
    fn decode(&mut self, _: InputId, _: &[u8]) -> Result<ValueId, PayloadError> {
        Ok(ValueId::NONE)
    }
    fn note_tardy(&mut self, _: InputId, intended: Tag, actual: Tag) {
        self.tardy.push((intended, actual));
    }
}

/// The start time, in nanoseconds.
const START: i64 = 1_000_000_000;

fn plan(on_failure: &str, max_violations: &str) -> Plan {
    let plan = format!(
        r#"{{"ictus": "v1", "federation": "f", "coordination": "decentralized", "extensions": true, "keepalive": true,
            "federates": [{{"name": "me", "class": "A", "program": "p", "stp_offset_ns": 5000000 {max_violations}}},
                {{"name": "sender", "class": "A", "program": "p", "on_failure": "{on_failure}"}},
                {{"name": "other", "class": "A", "program": "p"}}],
            "connections": [
                {{"from": {{"federate": 1, "port": "out"}}, "to": {{"federate": 0, "port": "a"}}, "serializer": "native", "port_id": 0}},
                {{"from": {{"federate": 2, "port": "out"}}, "to": {{"federate": 0, "port": "b"}}, "serializer": "native", "port_id": 1,
                  "physical": true}}]}}"#
    );
    serde_json::from_str(&plan).unwrap()
}

/// Federate 0 of the plan, whose inputs `a` and `b` come from federates 1 and 2, `b` over a physical connection.
struct World {
    federate: Federate,
    notes: Notes,
    now: PhysicalTime,
}

impl World {
    fn new(plan: &Plan) -> Self {
        Self::with(plan, &|_| {}, true)
    }

    /// One that ends when nothing can come any more.
    fn ending(plan: &Plan) -> Self {
        Self::with(plan, &|_| {}, false)
    }

    fn with(plan: &Plan, change: &dyn Fn(&mut LinkConfig), keepalive: bool) -> Self {
        let mut builder = ProgramBuilder::new();
        let me = builder.reactor("me");
        let a = builder.port(me, "a", PortKind::Input);
        let b = builder.port(me, "b", PortKind::Input);
        builder.network_input(a, false);
        builder.network_input_physical(b, Duration::ZERO);
        let program = Arc::new(builder.build().unwrap());
        let mut link = LinkConfig::from_plan(plan, 0, &[0, 1], &[]);
        link.federation = "test".to_owned();
        change(&mut link);
        let config = FederateConfig {
            keepalive,
            ..FederateConfig::default()
        };
        let mut world = Self {
            federate: Federate::federated(program, config, link),
            notes: Notes::default(),
            now: PhysicalTime::from_nanos(START),
        };
        world.federate.listening(7);
        world.federate.connect();
        world.rti(&ToFederate::Ack);
        world
    }

    fn rti(&mut self, message: &ToFederate<'_>) {
        let mut bytes = Vec::new();
        message.encode(&mut bytes);
        self.federate.receive(self.now, &bytes, &mut self.notes);
        self.poll();
    }

    fn poll(&mut self) -> Poll {
        self.federate.looked(self.now);
        self.federate.poll(self.now, &mut self.notes)
    }

    /// At `ms` after the start.
    fn at(&mut self, ms: i64) -> Poll {
        self.now = PhysicalTime::from_nanos(START + ms * 1_000_000);
        self.poll()
    }

    fn start(&mut self) {
        self.rti(&ToFederate::Timestamp(PhysicalTime::from_nanos(START)));
    }

    fn meets(&mut self, federate: u16) -> PeerStream {
        let stream = self.federate.peer_accepted();
        self.says(stream, &hello(federate, b"test"));
        assert_eq!(self.answer(stream), Some(FromPeer::Ack));
        stream
    }

    fn says(&mut self, stream: PeerStream, message: &ToPeer<'_>) -> usize {
        let mut bytes = Vec::new();
        message.encode(Wire::V0_12, &mut bytes);
        self.federate
            .receive_from_peer(self.now, stream, &bytes, &mut self.notes)
    }

    fn answer(&mut self, stream: PeerStream) -> Option<FromPeer> {
        let bytes = std::mem::take(self.federate.peer_output(stream));
        FromPeer::decode(&bytes).unwrap().map(|(answer, _)| answer)
    }

    fn outcome(self) -> Outcome {
        self.federate.into_outcome().unwrap()
    }
}

fn hello(federate: u16, federation: &[u8]) -> ToPeer<'_> {
    ToPeer::Hello {
        federate,
        federation,
        transient: false,
    }
}

fn tag(ms: i64) -> Tag {
    Tag::new(LogicalTime::from_nanos(START + ms * 1_000_000), 0)
}

fn message(port: u16, federate: u16, ms: i64) -> ToPeer<'static> {
    ToPeer::TaggedMessage(TaggedMessage {
        port,
        federate,
        tag: tag(ms),
        payload: &[1],
    })
}

#[test]
fn strangers_are_refused_with_the_reason_that_lf_gives() {
    let mut world = World::new(&plan("stop-federation", ""));
    let _sender = world.meets(1);
    let cases: [(&[u8], ToPeer<'_>, RejectReason); 4] = [
        (
            b"wrong federation",
            hello(2, b"tess"),
            RejectReason::FederationId,
        ),
        (
            b"a longer id",
            hello(2, b"test2"),
            RejectReason::FederationId,
        ),
        (
            b"nobody's sender",
            hello(9, b"test"),
            RejectReason::FederateIdOutOfRange,
        ),
        (b"twice", hello(1, b"test"), RejectReason::FederateIdInUse),
    ];
    for (name, hello, reason) in cases {
        let stream = world.federate.peer_accepted();
        world.says(stream, &hello);
        let name = String::from_utf8_lossy(name);
        assert_eq!(
            world.answer(stream),
            Some(FromPeer::Reject(reason)),
            "{name}"
        );
        assert!(world.federate.peer_over(stream), "{name}");
    }
    let stream = world.federate.peer_accepted();
    world.says(stream, &message(0, 0, 1));
    let wrong = Some(FromPeer::Reject(RejectReason::WrongServer));
    assert_eq!(world.answer(stream), wrong, "a message is no hello");
    assert_eq!(world.federate.counters().refused, 5);
    let mut said = 0;
    while let Some(event) = world.federate.poll_event() {
        said += u32::from(matches!(event, FederateEvent::PeerRefused(_)));
    }
    assert_eq!(said, 5, "each is told once");
    assert!(
        world.federate.outcome().is_none(),
        "and nothing else happens"
    );
}

#[test]
fn a_federate_is_whom_its_certificate_names() {
    let mut world = World::new(&plan("stop-federation", ""));
    let stream = world.federate.peer_accepted();
    world.federate.peer_certified(stream, 2);
    world.says(stream, &hello(1, b"test"));
    let refused = FromPeer::Reject(RejectReason::HmacWrong);
    assert_eq!(world.answer(stream), Some(refused));
    world.federate.peer_unfit("no certificate".to_owned());
    assert_eq!(world.federate.counters().refused, 2);
    let stream = world.federate.peer_accepted();
    world.federate.peer_certified(stream, 1);
    world.says(stream, &hello(1, b"test"));
    assert_eq!(world.answer(stream), Some(FromPeer::Ack));
    let mut words = Vec::new();
    while let Some(event) = world.federate.poll_event() {
        if let FederateEvent::PeerRefused(what) = event {
            words.push(what);
        }
    }
    let expected = [
        "federate 2, by its certificate, says that it is federate 1",
        "no certificate",
    ];
    assert_eq!(words, expected);
}

#[test]
fn messages_wait_until_the_start_tag_is_known() {
    let mut world = World::new(&plan("stop-federation", ""));
    let sender = world.meets(1);
    assert_eq!(
        world.says(sender, &message(0, 0, 3)),
        0,
        "offered again later"
    );
    world.start();
    assert!(world.says(sender, &message(0, 0, 3)) > 0);
    assert_eq!(world.federate.counters().received, 1);
}

#[test]
fn the_start_tag_obeys_the_offset_and_a_message_in_time_ends_the_wait() {
    let mut world = World::new(&plan("stop-federation", ""));
    let sender = world.meets(1);
    world.start();
    let until = PhysicalTime::from_nanos(START + 5_000_000);
    assert_eq!(world.at(1), Poll::Wait(Some(until)));
    assert!(world.federate.timeline().current().is_none());
    let absent = ToPeer::PortAbsent(PortAbsent {
        port: 0,
        federate: 0,
        tag: tag(0).latest_earlier(),
    });
    world.says(sender, &absent);
    // What comes before the start tag is known: it is begun, but its input may still come.
    assert_eq!(world.at(2), Poll::Wait(Some(until)));
    assert_eq!(world.federate.timeline().current(), Some(tag(0)));
    world.says(sender, &message(0, 0, 0));
    world.at(3);
    assert_eq!(world.federate.timeline().current(), None);
    assert_eq!(world.federate.measures().stp_violations(), 0);
}

#[test]
fn a_message_after_its_time_is_tardy_and_counted_with_its_lateness() {
    let mut world = World::new(&plan("stop-federation", ""));
    let sender = world.meets(1);
    world.start();
    world.at(6);
    world.says(sender, &message(0, 0, 0));
    let notes = vec![(tag(0), tag(0).successor())];
    assert_eq!(world.notes.tardy, notes);
    assert_eq!(world.federate.measures().stp_violations(), 1);
    let (_, upstream) = world.federate.measures().upstreams().next().unwrap();
    assert_eq!(upstream.lateness.max(), Duration::from_millis(1));
    assert_eq!(
        upstream.arrival.max(),
        Duration::from_millis(6),
        "it was on its way all the same"
    );
    world.says(sender, &message(0, 0, 8));
    let (_, upstream) = world.federate.measures().upstreams().next().unwrap();
    assert_eq!(upstream.slack.max(), Duration::from_millis(7));
    assert_eq!(world.federate.measures().stp_violations(), 1);
}

#[test]
fn a_tag_before_the_start_is_a_counted_violation() {
    let mut world = World::new(&plan("stop-federation", ""));
    let sender = world.meets(1);
    world.start();
    world.says(sender, &message(0, 0, -10));
    assert_eq!(world.federate.measures().stp_violations(), 1);
    assert!(world.federate.outcome().is_none());
}

#[test]
fn the_violation_that_is_one_too_many_stops_the_federation() {
    let mut world = World::new(&plan("stop-federation", r#", "max_stp_violations": 2"#));
    let sender = world.meets(1);
    world.start();
    world.at(20);
    world.says(sender, &message(0, 0, -2));
    assert!(world.federate.poll_event().is_some());
    world.says(sender, &message(0, 0, -1));
    world.rti(&ToFederate::StopGranted(tag(30)));
    world.at(40);
    assert!(matches!(world.outcome(), Outcome::TooManyViolations(2)));
}

#[test]
fn what_the_plan_does_not_allow_ends_the_federate_and_names_the_sender() {
    let physical = ToPeer::Message(PeerMessage {
        port: 0,
        federate: 0,
        payload: &[1],
    });
    let cases = [
        (
            message(7, 0, 1),
            "federate 1 broke the protocol: message for unknown port 7",
        ),
        (
            message(0, 2, 1),
            "federate 1 broke the protocol: message for federate 2",
        ),
        (
            message(1, 0, 1),
            "port 1, which the plan does not let federate 1 write",
        ),
        (
            physical,
            "port 0, which the plan does not let federate 1 write",
        ),
        (hello(1, b"test"), "unexpected a second hello"),
    ];
    for (message, words) in cases {
        let mut world = World::new(&plan("stop-federation", ""));
        let sender = world.meets(1);
        world.start();
        world.says(sender, &message);
        let outcome = world.outcome();
        assert!(outcome.to_string().contains(words), "{outcome}");
    }
}

/// A message that is as late as can be, with the last microstep of the tag reached.
#[test]
fn tag_arithmetic_that_overflows_ends_the_federate() {
    let mut world = World::new(&plan("stop-federation", ""));
    let sender = world.meets(1);
    world.start();
    let last = Tag::new(LogicalTime::from_nanos(i64::MAX - 1), u32::MAX);
    for _ in 0..2 {
        let message = ToPeer::TaggedMessage(TaggedMessage {
            port: 0,
            federate: 0,
            tag: last,
            payload: &[1],
        });
        world.says(sender, &message);
    }
    world.at(10);
    let outcome = world.outcome();
    assert!(matches!(outcome, Outcome::Overflow(_)), "{outcome}");
}

#[test]
fn a_burst_of_tardy_messages_is_taken_at_once() {
    let mut world = World::new(&plan("stop-federation", ""));
    let sender = world.meets(1);
    world.start();
    world.at(20);
    let mut bytes = Vec::new();
    for _ in 0..30_000 {
        message(0, 0, -1).encode(Wire::V0_12, &mut bytes);
    }
    let (now, federate) = (world.now, &mut world.federate);
    let used = federate.receive_from_peer(now, sender, &bytes, &mut world.notes);
    assert_eq!(used, bytes.len());
    assert_eq!(world.federate.measures().stp_violations(), 30_000);
    // Each at a microstep of its own, in order.
    let actual = world.notes.tardy.iter().map(|(_, actual)| *actual);
    assert!(actual.is_sorted_by(|a, b| a < b));
    world.at(21);
    assert!(world.federate.timeline().at().microstep >= 30_000);
}

#[test]
fn a_sender_that_is_cut_amid_a_message_is_lost_whoever_it_is() {
    for (federate, port) in [(1, 0), (2, 1)] {
        let mut plan = plan("stop-federation", "");
        plan.federates[usize::from(federate)].class = None;
        let mut world = World::new(&plan);
        let sender = world.meets(federate);
        world.start();
        let mut bytes = Vec::new();
        let half = PeerMessage {
            port,
            federate: 0,
            payload: &[1; 40],
        };
        ToPeer::Message(half).encode(Wire::V0_12, &mut bytes);
        world
            .federate
            .receive_from_peer(world.now, sender, &bytes[..20], &mut world.notes);
        world.federate.peer_closed(world.now, sender, true);
        assert_eq!(world.at(5_000), Poll::Ended);
        assert!(matches!(world.outcome(), Outcome::PeerCut(_)));
    }
}

#[test]
fn a_loss_that_the_rti_has_told_is_no_cut() {
    let mut world = World::new(&plan("stop-federation", ""));
    let sender = world.meets(1);
    world.start();
    world.rti(&ToFederate::FederateLost {
        federate: 1,
        promise: Tag::NEVER,
    });
    world.federate.peer_closed(world.now, sender, false);
    world.at(60_000);
    assert!(world.federate.outcome().is_none());
}

#[test]
fn a_physical_connection_takes_its_tag_from_the_receivers_clock() {
    let mut world = World::new(&plan("stop-federation", ""));
    let sender = world.meets(2);
    world.start();
    world.at(20);
    let message = ToPeer::Message(PeerMessage {
        port: 1,
        federate: 0,
        payload: &[1],
    });
    world.says(sender, &message);
    assert_eq!(world.federate.timeline().next_tag(), tag(20));
    let from_2 = world.federate.measures().upstreams().find(|u| u.0 == 2);
    assert_eq!(from_2.unwrap().1.messages, 1, "counted like any other");
}

#[test]
fn a_program_fed_by_a_physical_connection_starves_once_its_senders_are_gone() {
    let mut world = World::ending(&plan("continue", ""));
    let (logical, physical) = (world.meets(1), world.meets(2));
    world.start();
    world.at(20);
    world.federate.peer_closed(world.now, logical, false);
    assert!(matches!(world.at(30), Poll::Wait(_)));
    assert!(!world.federate.resigned(), "a message may still come");
    world.federate.peer_closed(world.now, physical, false);
    world.at(40);
    assert!(world.federate.resigned());
}

#[test]
fn a_cut_that_nobody_explains_ends_the_federate() {
    // The RTI may find out later that the sender's host is gone.
    for later in [0, 20_000] {
        let found_later = |link: &mut LinkConfig| link.found_later = Duration::from_millis(later);
        let mut world = World::with(&plan("stop-federation", ""), &found_later, true);
        let sender = world.meets(1);
        world.start();
        world.federate.peer_closed(world.now, sender, false);
        assert!(matches!(world.at(later + 4_999), Poll::Wait(Some(_))));
        assert_eq!(world.at(later + 5_000), Poll::Ended);
        assert!(matches!(world.outcome(), Outcome::PeerCut(1)));
    }
}

#[test]
fn a_receiver_that_takes_nothing_is_left_behind_or_ends_the_sender() {
    for on_failure in ["continue", "stop-federation"] {
        let text = format!(
            r#"{{"ictus": "v1", "federation": "f", "coordination": "decentralized", "extensions": true,
                "federates": [{{"name": "me", "class": "A", "program": "p"}},
                    {{"name": "deaf", "class": "A", "program": "p", "on_failure": "{on_failure}"}}],
                "connections": [{{"from": {{"federate": 0, "port": "out"}}, "to": {{"federate": 1, "port": "in"}},
                    "serializer": "native", "port_id": 0}}]}}"#
        );
        let plan: Plan = serde_json::from_str(&text).unwrap();
        let mut builder = ProgramBuilder::new();
        let me = builder.reactor("me");
        let out = builder.port(me, "out", PortKind::Output);
        builder.network_output(out);
        let mut link = LinkConfig::from_plan(&plan, 0, &[], &[0]);
        link.federation = "test".to_owned();
        let program = Arc::new(builder.build().unwrap());
        let mut world = World {
            federate: Federate::federated(program, FederateConfig::default(), link),
            notes: Notes::default(),
            now: PhysicalTime::from_nanos(START),
        };
        world.federate.connect();
        world.rti(&ToFederate::Ack);
        let address = [127, 0, 0, 1];
        world.rti(&ToFederate::AddressQueryReply { port: 9, address });
        let stream = world.federate.peer_connected(1);
        let mut ack = Vec::new();
        FromPeer::Ack.encode(&mut ack);
        let (now, federate) = (world.now, &mut world.federate);
        federate.receive_from_peer(now, stream, &ack, &mut world.notes);
        federate.peer_stuck(stream);
        match (on_failure, world.federate.outcome()) {
            ("continue", None) | (_, Some(Outcome::PeerStuck(1))) => {}
            (_, outcome) => panic!("{on_failure}: {outcome:?}"),
        }
    }
}

#[test]
fn a_goodbye_and_a_sender_that_may_be_outlived_explain_themselves() {
    for on_failure in ["stop-federation", "continue"] {
        let mut world = World::new(&plan(on_failure, ""));
        let sender = world.meets(1);
        world.start();
        if on_failure == "stop-federation" {
            let goodbye = ToPeer::PortAbsent(PortAbsent {
                port: 0,
                federate: 0,
                tag: Tag::FOREVER,
            });
            world.says(sender, &goodbye);
        }
        world.federate.peer_closed(world.now, sender, false);
        world.at(60_000);
        assert!(world.federate.outcome().is_none(), "{on_failure}");
        assert_eq!(world.federate.timeline().at(), tag(0));
    }
}

#[test]
fn a_data_address_of_its_own_is_told_to_our_rti_only() {
    for (extensions, told) in [
        (true, "DataAddress { port: 7, address: [10, 1, 2, 3] }"),
        (false, "AddressAdvertisement { port: 7 }"),
    ] {
        let mut plan = plan("stop-federation", "");
        plan.extensions = extensions;
        let mut world = World::with(&plan, &|link| link.data_address = Some([10, 1, 2, 3]), true);
        let bytes = std::mem::take(world.federate.output().unwrap());
        let (mut said, mut rest) = (Vec::new(), &bytes[..]);
        while let Some((message, length)) = ToRti::decode(rest).unwrap() {
            said.push(format!("{message:?}"));
            rest = &rest[length..];
        }
        assert!(said.iter().any(|message| message == told), "{said:?}");
    }
}

proptest! {
    /// Whatever comes from whoever connects, before the start or after it: no panic, no hang.
    #[test]
    fn any_bytes_are_survived(
        bytes in vec(any::<u8>(), 0..200),
        known in any::<bool>(),
        started in any::<bool>(),
        cut in any::<prop::sample::Index>(),
    ) {
        let mut world = World::new(&plan("stop-federation", ""));
        let stream = if known { world.meets(1) } else { world.federate.peer_accepted() };
        if started {
            world.start();
        }
        let cut = cut.index(bytes.len() + 1);
        for part in [&bytes[..cut], &bytes[cut..]] {
            let used = world.federate.receive_from_peer(world.now, stream, part, &mut world.notes);
            prop_assert!(used <= part.len());
        }
        world.at(50);
    }
}
