//! What a federate does while it joins, seen from the RTI's side of the wire.
#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use ictus_coord::auth::{Nonce, Proof};
use ictus_coord::federate::{Federate, FederateConfig, LinkConfig, Outcome, Poll};
use ictus_coord::plan::Plan;
use ictus_coord::rti::{ConnectionId, Newcomer, Rti, RtiConfig, RtiEvent};
use ictus_coord::topology::FederateId;
use ictus_coord::wire::{RejectReason, ToFederate, ToRti};
use ictus_coord::{FederateExecutor, PayloadError};
use ictus_core::{
    ActionId, Duration, Effects, Executor, InputId, NodeId, OutputId, PhysicalTime, ProgramBuilder,
    SlotId, Tag, ValueId,
};
use std::sync::Arc;

/// Executes a program in which nothing is.
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

fn joining(clock_sync: &str) -> Federate {
    joining_with(clock_sync, None)
}

fn joining_with(clock_sync: &str, authentication: Option<Nonce>) -> Federate {
    let plan = format!(
        r#"{{"ictus": "v1", "federation": "f", "coordination": "centralized", "clock": {{"sync": "{clock_sync}"}},
            "federates": [{{"name": "a", "class": "A", "program": "p"}}], "connections": []}}"#
    );
    let plan: Plan = serde_json::from_str(&plan).unwrap();
    let program = Arc::new(ProgramBuilder::new().build().unwrap());
    let mut link = LinkConfig::from_plan(&plan, 0, &[], &[]);
    link.federation = "test".to_owned();
    link.authentication = authentication;
    let mut federate = Federate::federated(program, FederateConfig::default(), link);
    federate.connect();
    federate
}

fn at(seconds: i64) -> PhysicalTime {
    PhysicalTime::from_nanos(0) + Duration::from_secs(seconds)
}

fn hear(federate: &mut Federate, now: PhysicalTime, message: &ToFederate<'_>) {
    let mut bytes = Vec::new();
    message.encode(&mut bytes);
    federate.receive(now, &bytes, &mut Nothing);
}

#[test]
fn an_rti_that_does_not_answer_is_given_up() {
    let mut federate = joining("off");
    assert_eq!(federate.poll(at(1), &mut Nothing), Poll::Wait(Some(at(61))));
    assert_eq!(
        federate.poll(at(60), &mut Nothing),
        Poll::Wait(Some(at(61)))
    );
    assert_eq!(federate.poll(at(61), &mut Nothing), Poll::Ended);
    let outcome = federate.into_outcome().unwrap();
    assert!(matches!(outcome, Outcome::NotJoined { .. }), "{outcome}");
    assert!(
        outcome.to_string().contains("is an RTI listening there?"),
        "{outcome}"
    );
}

#[test]
fn every_answer_renews_the_patience() {
    let mut federate = joining("init");
    assert_eq!(federate.poll(at(0), &mut Nothing), Poll::Wait(Some(at(60))));
    hear(&mut federate, at(50), &ToFederate::Ack);
    assert_eq!(
        federate.poll(at(50), &mut Nothing),
        Poll::Wait(Some(at(110)))
    );
    hear(&mut federate, at(100), &ToFederate::ClockSyncT1(at(100)));
    assert_eq!(
        federate.poll(at(100), &mut Nothing),
        Poll::Wait(Some(at(160)))
    );
    assert_eq!(federate.poll(at(160), &mut Nothing), Poll::Ended);
    let outcome = federate.into_outcome().unwrap();
    assert!(outcome.to_string().contains("`-c off`"), "{outcome}");
}

#[test]
fn the_others_may_join_as_late_as_they_like() {
    let mut federate = joining("off");
    hear(&mut federate, at(0), &ToFederate::Ack);
    assert_eq!(federate.poll(at(1_000_000), &mut Nothing), Poll::Wait(None));
}

const OWN: Nonce = [5; 8];
const THEIRS: Nonce = [6; 8];

/// What the federate has said since, told and taken.
fn said(federate: &mut Federate) -> Vec<String> {
    let mut told = Vec::new();
    let bytes = std::mem::take(federate.output().unwrap());
    let mut at = 0;
    while let Some((message, length)) = ToRti::decode(&bytes[at..]).unwrap() {
        let hello = matches!(message, ToRti::FederateIds { .. });
        told.push(if hello {
            "FED_IDS".to_owned()
        } else {
            format!("{message:?}")
        });
        at += length;
    }
    assert_eq!(at, bytes.len());
    told
}

fn response(key: &[u8], federate: u16) -> ToFederate<'static> {
    let proof = Proof::Rti {
        federate,
        nonce: OWN,
    };
    ToFederate::RtiResponse {
        nonce: THEIRS,
        hmac: proof.sign(key),
    }
}

#[test]
fn federate_and_rti_prove_themselves_before_the_join() {
    let mut federate = joining_with("off", Some(OWN));
    let nonce = ToRti::FederateNonce {
        federate: 0,
        nonce: OWN,
    };
    assert_eq!(said(&mut federate), [format!("{nonce:?}")]);
    let mut bytes = Vec::new();
    response(b"test", 0).encode(&mut bytes);
    for end in 0..bytes.len() {
        assert_eq!(federate.receive(at(1), &bytes[..end], &mut Nothing), 0);
    }
    assert_eq!(federate.receive(at(1), &bytes, &mut Nothing), bytes.len());
    let proof = Proof::Federate { nonce: THEIRS };
    let hmac = proof.sign(b"test");
    let proof = format!("{:?}", ToRti::FederateResponse { hmac });
    assert_eq!(said(&mut federate), [proof, "FED_IDS".to_owned()]);
    hear(&mut federate, at(2), &ToFederate::Ack);
    assert!(said(&mut federate)[0].starts_with("NeighborStructure"));
}

#[test]
fn an_rti_that_does_not_know_the_key_is_refused() {
    for answer in [response(b"tess", 0), response(b"test", 1)] {
        let mut federate = joining_with("off", Some(OWN));
        said(&mut federate);
        hear(&mut federate, at(1), &answer);
        let reject = ToRti::Reject(RejectReason::HmacWrong);
        assert_eq!(said(&mut federate), [format!("{reject:?}")]);
        assert_eq!(federate.poll(at(1), &mut Nothing), Poll::Ended);
        let outcome = federate.into_outcome().unwrap();
        assert!(matches!(outcome, Outcome::RtiUnproven), "{outcome}");
    }
}

#[test]
fn an_rti_without_authentication_is_not_joined() {
    let reject = ToFederate::Reject(RejectReason::NotAuthenticating);
    for (answer, expected) in [
        (reject, "the RTI runs without authentication"),
        (ToFederate::Ack, "unexpected ACK"),
        (ToFederate::Failed, "the RTI reported"),
    ] {
        let mut federate = joining_with("off", Some(OWN));
        hear(&mut federate, at(1), &answer);
        assert!(!said(&mut federate).contains(&"FED_IDS".to_owned()));
        let outcome = federate.into_outcome().unwrap().to_string();
        assert!(outcome.contains(expected), "{outcome}");
    }
    let mut silent = joining_with("off", Some(OWN));
    assert_eq!(silent.poll(at(0), &mut Nothing), Poll::Wait(Some(at(60))));
    assert_eq!(silent.poll(at(60), &mut Nothing), Poll::Ended);
}

#[test]
fn an_answer_that_was_not_asked_for_ends_the_join() {
    let mut federate = joining("off");
    hear(&mut federate, at(1), &response(b"test", 0));
    let outcome = federate.into_outcome().unwrap().to_string();
    assert!(outcome.contains("unexpected RTI_RESPONSE"), "{outcome}");
}

/// Carries bytes between a federate and an RTI until both are silent.
fn talk(federate: &mut Federate, rti: &mut Rti, connection: ConnectionId) {
    for _ in 0..20 {
        let said = std::mem::take(federate.output().unwrap());
        assert_eq!(rti.receive(at(1), connection, &said), said.len());
        rti.drain(at(1));
        while let Some(id) = rti.poll_output() {
            let heard = rti.output(id).chunk().to_vec();
            rti.output(id).advance(heard.len());
            federate.receive(at(1), &heard, &mut Nothing);
        }
    }
}

#[test]
fn our_federate_and_our_rti_authenticate() {
    for (key, joins) in [("test", true), ("prod", false)] {
        let mut config = RtiConfig::new(key, 1);
        config.authentication = true;
        let mut rti = Rti::new(config);
        let newcomer = Newcomer {
            peer: "192.0.2.1:4000".to_owned(),
            local: None,
            nonce: Some(THEIRS),
        };
        let connection = rti.connect(at(1), newcomer);
        let mut federate = joining_with("off", Some(OWN));
        talk(&mut federate, &mut rti, connection);
        let events = std::iter::from_fn(|| rti.poll_event()).collect::<Vec<_>>();
        let joined = RtiEvent::Joined {
            federate: FederateId::new(0),
        };
        assert_eq!(events.contains(&joined), joins, "{events:?}");
        let refused = matches!(federate.outcome(), Some(Outcome::RtiUnproven));
        assert_eq!(refused, !joins);
    }
}
