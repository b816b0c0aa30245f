//! Tests: what federates say of themselves reaches the measures and the events, and nothing they say breaks the agent.

use ictus_coord::report::FederateStatus;
use proptest::prelude::*;
use serde_json::{Value, json};

use super::{A, Action, B, Event, KILLED, MemberEvent, OK, World};
use crate::agent::{MemberId, REMARKS_MAX};
use crate::api::ExitReason;

impl World {
    fn reports(&mut self, id: MemberId, line: Value) {
        self.on(id, MemberEvent::Reported { line });
    }

    fn told(&mut self) -> Vec<Event> {
        let told = |action| match action {
            Action::Tell(event) => Some(event),
            Action::Launch { .. } | Action::Signal { .. } => None,
        };
        self.actions().into_iter().filter_map(told).collect()
    }
}

fn upstream(id: u16, messages: u64) -> Value {
    json!({
        "event": "upstream", "federate": "a", "upstream": id,
        "measures": {
            "messages": messages, "bytes": 8 * messages, "stp_violations": 1,
            "lateness": {"sum": 5, "max": 5, "buckets": [5, 1]},
        },
    })
}

#[test]
fn measures_are_kept_by_the_names_of_the_plan() {
    let mut world = World::healthy();
    world.reports(A, upstream(1, 3));
    world.reports(A, upstream(77, 3));
    world.reports(
        A,
        json!({"event": "measures", "federate": "a", "own": {"tags_completed": 4}}),
    );
    world.reports(
        A,
        json!({"event": "clock", "federate": "a", "clock": {"source": "chrony"}}),
    );
    world.reports(
        B,
        json!({"event": "progress", "federate": "b", "elapsed_ns": 1, "microstep": 0,
        "tags": 7, "reactions": 8, "sent": 0, "received": 0, "deadlines_missed": 2}),
    );
    let measures = world.agent.measures();
    let peers: Vec<_> = measures[0].upstreams.iter().collect();
    assert_eq!(peers.len(), 1, "77 is nobody");
    assert_eq!((peers[0].0.as_str(), peers[0].1.messages), ("b", 3));
    assert_eq!(measures[0].own.tags_completed, 4);
    assert_eq!(measures[0].clock.as_ref().unwrap().source.name(), "chrony");
    let own = &measures[1].own;
    assert_eq!(
        (own.tags_completed, own.reactions, own.deadline_misses),
        (7, 8, 2)
    );
    assert_eq!(world.told(), []);
}

#[test]
fn an_exit_record_tells_what_nobody_heard() {
    let mut world = World::healthy();
    let mut record = World::record(world.now, OK);
    record.reports = vec![json!("odd"), upstream(1, 9)];
    let record = Box::new(record);
    world.on(A, MemberEvent::Ended { record });
    assert_eq!(world.agent.measures()[0].upstreams["b"].messages, 9);
    assert_eq!(
        world.agent.federate_views()[0].exit,
        Some(ExitReason::Completed)
    );
    world.ends(B, KILLED);
    assert_eq!(
        world.agent.federate_views()[1].exit,
        Some(ExitReason::Killed)
    );
}

#[test]
fn what_a_federate_notices_is_told_but_not_without_end() {
    let mut world = World::healthy();
    let federate = || "a".to_owned();
    let lines = [
        FederateStatus::StpViolation {
            federate: federate(),
            upstream: 1,
            lateness_ns: 5,
            count: 10,
        },
        FederateStatus::FallingBehind {
            federate: federate(),
            lag_ns: 6,
        },
        FederateStatus::CaughtUp {
            federate: federate(),
            lag_ns: 7,
        },
        FederateStatus::ClockStep {
            federate: federate(),
            by_ns: -8,
        },
    ];
    for line in &lines {
        world.reports(A, serde_json::to_value(line).unwrap());
    }
    let expected = [
        Event::StpViolation {
            federate: federate(),
            upstream: "b".to_owned(),
            lateness_ns: 5,
            count: 10,
        },
        Event::FallingBehind {
            federate: federate(),
            lag_ns: 6,
        },
        Event::CaughtUp {
            federate: federate(),
            lag_ns: 7,
        },
        Event::ClockStep {
            federate: federate(),
            by_ns: -8,
        },
    ];
    assert_eq!(world.told(), expected);
    for _ in 0..2 * REMARKS_MAX {
        world.reports(A, serde_json::to_value(&lines[0]).unwrap());
    }
    let more = u32::try_from(world.told().len()).unwrap();
    assert_eq!(more, REMARKS_MAX - 4);
    // Another one's words are told nevertheless.
    world.reports(B, serde_json::to_value(&lines[3]).unwrap());
    assert_eq!(world.told().len(), 1);
}

/// Almost a status line: the right words in the wrong places.
fn odd_line() -> impl Strategy<Value = Value> {
    let value = prop_oneof![
        any::<i64>().prop_map(Value::from),
        any::<u64>().prop_map(Value::from),
        any::<f64>().prop_map(Value::from),
        (0_u16..3).prop_map(Value::from),
        Just(Value::Null),
        "(?s).{0,4}".prop_map(Value::from),
        prop::collection::vec(any::<u64>(), 0..5).prop_map(Value::from),
        Just(json!({"source": "builtin", "bound_ns": -1, "offset_ns": i64::MIN})),
        Just(
            json!({"messages": u64::MAX, "bytes": u64::MAX, "slack": {"sum": 1, "max": 1, "buckets": [1, 1]}})
        ),
        Just(
            json!({"tags_completed": 1, "tag_lag": {"sum": u64::MAX, "max": 1, "buckets": [1, u64::MAX]}})
        ),
        Just(
            json!({"tags_completed": 1, "tag_lag": {"sum": 1, "max": 1, "buckets": [u64::MAX, 0, 1]}})
        ),
    ];
    let event = prop_oneof![
        Just("progress"),
        Just("measures"),
        Just("upstream"),
        Just("downstream"),
        Just("clock"),
        Just("stp_violation"),
        Just("falling_behind"),
        Just("caught_up"),
        Just("clock_step"),
        Just("running"),
        Just("ended"),
        Just("odd"),
    ];
    let name = prop_oneof![
        Just("federate"),
        Just("upstream"),
        Just("downstream"),
        Just("measures"),
        Just("own"),
        Just("clock"),
        Just("part"),
        Just("count"),
        Just("lateness_ns"),
        Just("lag_ns"),
        Just("by_ns"),
        Just("tags"),
        Just("elapsed_ns"),
    ];
    (event, prop::collection::vec((name, value), 0..6)).prop_map(|(event, fields)| {
        let mut line = json!({
            "event": event, "federate": "a", "upstream": 1, "downstream": 0, "measures": {}, "own": {},
            "clock": {}, "count": 1, "lateness_ns": 1, "lag_ns": 1, "by_ns": 1,
        });
        for (name, value) in fields {
            line[name] = value;
        }
        line
    })
}

proptest! {
    #[test]
    fn odd_lines_never_break_the_agent_or_the_page(lines in prop::collection::vec((0_u16..2, odd_line()), 0..40)) {
        let mut world = World::healthy();
        for (id, line) in lines {
            world.reports(MemberId::Federate(id), line);
        }
        let measures = ictus_coord::report::FederationMeasures {
            federation: "pair".to_owned(),
            federates: world.agent.measures(),
        };
        let text = serde_json::to_string(&measures).unwrap();
        let read: ictus_coord::report::FederationMeasures = serde_json::from_str(&text).unwrap();
        prop_assert_eq!(&read, &measures);
        let page = crate::metrics::measures_page(&measures);
        let read = ictus_metrics::Page::parse(&page);
        prop_assert!(read.is_ok(), "{:?}\n{}", read, page);
        // It still works.
        world.ends(A, OK);
        world.ends(B, OK);
        world.ends(MemberId::Rti, OK);
        prop_assert!(world.agent.outcome().is_some());
    }
}
