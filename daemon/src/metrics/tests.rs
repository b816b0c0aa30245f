use std::collections::BTreeMap;
use std::path::PathBuf;

use ictus_coord::measure::{Downstream, Measures, Own, Upstream};
use ictus_coord::plan::{
    Bounds, ClockPlan, ConnectionPlan, Coordination, Endpoint, FederatePlan, Plan,
};
use ictus_coord::report::{ClockSource, ClockStatus, FederateMeasures, FederationMeasures};
use ictus_metrics::catalogue::ALL;
use ictus_metrics::{Kind, Page};
use proptest::prelude::*;

use super::{Snapshot, page};
use crate::api::{ExitReason, FederationView, MemberView, State};

/// A federate `b` that measured everything, once.
fn measured() -> FederateMeasures {
    let mut measures = Measures::new(&[0], &[2]);
    let span = span_of(3_000_000);
    measures.arrived(0, 8);
    measures.slack(0, span);
    measures.arrival(0, span);
    measures.violation(0, span);
    measures.sent(2, 16);
    measures.launch_lag(2, span);
    measures.grant_wait(span);
    let lateness = measures.own().grant_wait.clone();
    measures.executed(10, 11, &lateness);
    let upstream: BTreeMap<String, Upstream> = measures
        .upstreams()
        .map(|(_, it)| ("a".to_owned(), it.clone()))
        .collect();
    let downstream: BTreeMap<String, Downstream> = measures
        .downstreams()
        .map(|(_, it)| ("c".to_owned(), it.clone()))
        .collect();
    let mut tag_lag = measures.own().grant_wait.clone();
    tag_lag.merge(&measures.own().grant_wait);
    FederateMeasures {
        federate: "b".to_owned(),
        clock: Some(ClockStatus {
            source: ClockSource::Builtin,
            offset_ns: -1_500_000,
            drift_ppb: 20_000,
            bound_ns: Some(40_000),
            synchronized: true,
            probes_kept: 5,
            probes_dropped: 6,
            strangers: 7,
            steps: 8,
        }),
        behind: true,
        own: Own {
            tags_completed: 9,
            fell_behind: 12,
            tag_lag,
            ..measures.own().clone()
        },
        upstreams: upstream,
        downstreams: downstream,
    }
}

fn span_of(nanos: i64) -> ictus_core::Duration {
    ictus_core::Duration::from_nanos(nanos)
}

fn snapshot(federation: &str) -> Snapshot {
    let member = |name: &str, state: &str, exit| MemberView {
        name: name.to_owned(),
        state: state.to_owned(),
        exit,
        ..MemberView::default()
    };
    let declared = |(name, stp_offset_ns): (&str, i64)| FederatePlan {
        name: name.to_owned(),
        stp_offset_ns,
        ..FederatePlan::default()
    };
    let end = |federate| Endpoint {
        federate,
        ..Endpoint::default()
    };
    Snapshot {
        view: FederationView {
            name: federation.to_owned(),
            state: State::Running,
            id: String::new(),
            since_ns: 0,
            manifest: PathBuf::new(),
            directory: PathBuf::new(),
            rti_port: None,
            metrics: None,
            start_ns: None,
            rti: member("rti", "running", None),
            federates: vec![
                member("a", "ended", Some(ExitReason::Killed)),
                member("b", "running", None),
            ],
            outcome: None,
            part: None,
            digest: String::new(),
            facets: BTreeMap::new(),
            generation: None,
        },
        measures: FederationMeasures {
            federation: federation.to_owned(),
            federates: vec![FederateMeasures::of("a"), measured()],
        },
        plan: Some(Plan {
            coordination: Coordination::Decentralized,
            clock: ClockPlan {
                max_error_ns: Some(250_000),
                ..ClockPlan::default()
            },
            federates: [("a", 0), ("b", 6_400_000)].map(declared).to_vec(),
            connections: vec![ConnectionPlan {
                from: end(0),
                to: end(1),
                after_ns: Some(1_000_000),
                bounds: Some(Bounds {
                    launch_lag_ns: 2_000_000,
                    latency_ns: 5_000_000,
                    clock_error_ns: 1_000_000,
                }),
                ..ConnectionPlan::default()
            }],
            ..Plan::default()
        }),
    }
}

#[test]
fn every_metric_of_the_catalogue_is_served_and_right() {
    let text = page(&[snapshot("f"), snapshot("g")]);
    let page = Page::parse(&text).unwrap();
    for metric in ALL {
        let name = match metric.kind {
            Kind::Counter | Kind::Gauge => metric.name.to_owned(),
            Kind::Histogram => format!("{}_count", metric.name),
        };
        assert!(page.value(&name, &[]).is_some(), "{name} is not served");
    }
    let b = [("federation", "g"), ("federate", "b")];
    for (name, value) in [
        ("ictus_clock_offset_seconds", -0.0015),
        ("ictus_clock_error_bound_seconds", 0.00004),
        ("ictus_clock_frequency_error_ratio", 0.00002),
        ("ictus_clock_synchronized", 1.0),
        ("ictus_clock_steps_total", 8.0),
        ("ictus_stp_offset_seconds", 0.0064),
        ("ictus_stp_offset_required_seconds", 0.007),
        ("ictus_stp_violations_total", 1.0),
        ("ictus_stp_violation_lateness_seconds_sum", 0.003),
        ("ictus_stp_slack_seconds_count", 1.0),
        ("ictus_message_latency_seconds_count", 1.0),
        ("ictus_message_launch_lag_seconds_count", 1.0),
        ("ictus_messages_received_total", 1.0),
        ("ictus_messages_sent_total", 1.0),
        ("ictus_deadline_misses_total", 1.0),
        ("ictus_deadline_lateness_seconds_count", 1.0),
        ("ictus_rti_grant_wait_seconds_count", 1.0),
        ("ictus_tag_lag_seconds_count", 2.0),
        ("ictus_tags_completed_total", 9.0),
        ("ictus_reactions_executed_total", 10.0),
        ("ictus_watchdogs_fired_total", 11.0),
        ("ictus_federate_fell_behind_total", 12.0),
        ("ictus_federate_falling_behind", 1.0),
        ("ictus_federate_up", 1.0),
    ] {
        assert_eq!(page.value(name, &b), Some(value), "{name}");
    }
    let with = |name: &str, label: (&str, &str)| page.value(name, &[b[0], b[1], label]);
    assert_eq!(
        with("ictus_message_bytes_total", ("direction", "received")),
        Some(8.0)
    );
    assert_eq!(
        with("ictus_message_bytes_total", ("direction", "sent")),
        Some(16.0)
    );
    assert_eq!(
        with("ictus_clock_probes_total", ("result", "stranger")),
        Some(7.0)
    );
    assert_eq!(
        with("ictus_federate_state", ("state", "running")),
        Some(1.0)
    );
    assert_eq!(with("ictus_federate_state", ("state", "joined")), Some(0.0));
    let a = [("federation", "f"), ("federate", "a"), ("reason", "killed")];
    assert_eq!(page.value("ictus_federate_exits_total", &a), Some(1.0));
    assert_eq!(page.value("ictus_federate_up", &a[..2]), Some(0.0));
    let federation = ("federation", "f");
    assert_eq!(
        page.value("ictus_clock_error_limit_seconds", &[federation]),
        Some(0.00025)
    );
    let ended = [federation, ("state", "ended")];
    assert_eq!(page.value("ictus_rti_federates", &ended), Some(1.0));
}

#[test]
fn an_empty_host_serves_its_version() {
    let page = Page::parse(&page(&[])).unwrap();
    let names: Vec<_> = page
        .samples()
        .iter()
        .map(|sample| sample.name.as_str())
        .collect();
    assert_eq!(names, ["ictus_daemon_build_info"]);
}

proptest! {
    #[test]
    fn odd_names_never_break_the_page(names in prop::collection::vec("(?s).{0,5}", 0..6)) {
        let mut one = snapshot("f");
        for name in &names {
            one.measures.federates.push(FederateMeasures::of(name));
            one.view.federates.push(MemberView { name: name.clone(), state: name.clone(), ..MemberView::default() });
        }
        let text = page(&[one.clone(), one]);
        let page = Page::parse(&text);
        prop_assert!(page.is_ok(), "{page:?}\n{text}");
    }
}
