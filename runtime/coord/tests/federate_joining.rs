//! What a federate does while it joins, seen from the RTI's side of the wire.
#![allow(clippy::unwrap_used, missing_docs, reason = "a test")]

use ictus_coord::federate::{Federate, FederateConfig, LinkConfig, Outcome, Poll};
use ictus_coord::plan::Plan;
use ictus_coord::wire::ToFederate;
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
    let plan = format!(
        r#"{{"ictus": "v1", "federation": "f", "coordination": "centralized", "clock": {{"sync": "{clock_sync}"}},
            "federates": [{{"name": "a", "class": "A", "program": "p"}}], "connections": []}}"#
    );
    let plan: Plan = serde_json::from_str(&plan).unwrap();
    let program = Arc::new(ProgramBuilder::new().build().unwrap());
    let link = LinkConfig::from_plan(&plan, 0, &[], &[]);
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
