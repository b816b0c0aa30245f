//! Declared bounds beside measured ones, from histograms filled by hand.
#![allow(clippy::unwrap_used, missing_docs, reason = "tests may fail loudly")]

use ictus_coord::measure::{Downstream, Histogram, Upstream};
use ictus_coord::plan::{Bounds, ConnectionPlan, Coordination, Endpoint, FederatePlan, Plan};
use ictus_coord::report::{ClockStatus, FederateMeasures, FederationMeasures};
use ictus_core::Duration;
use ictus_deploy::timing::{Measure, bounds_report, suggest};

const US: i64 = 1_000;
const MS: i64 = 1_000_000;

/// lidar -> planner -> brake, solved: 0, 0.9, 6.4 ms; and a physical connection that plays no part.
fn plan() -> Plan {
    let federate = |name: &str, stp_offset_ns| FederatePlan {
        name: name.to_owned(),
        stp_offset_ns,
        ..FederatePlan::default()
    };
    let end = |federate| Endpoint {
        federate,
        port: "p".to_owned(),
        channel: 0,
    };
    let wire = |from, to, [l, n, e]: [i64; 3]| ConnectionPlan {
        from: end(from),
        to: end(to),
        bounds: Some(Bounds {
            launch_lag_ns: l * US,
            latency_ns: n * US,
            clock_error_ns: e * US,
        }),
        ..ConnectionPlan::default()
    };
    let physical = ConnectionPlan {
        physical: true,
        ..wire(2, 0, [1, 1, 1])
    };
    Plan {
        coordination: Coordination::Decentralized,
        federates: vec![
            federate("lidar", 0),
            federate("planner", 900 * US),
            federate("brake", 6_400 * US),
        ],
        connections: vec![
            wire(0, 1, [200, 600, 100]),
            wire(1, 2, [2_000, 3_000, 500]),
            physical,
        ],
        ..Plan::default()
    }
}

/// So many durations of so many microseconds each.
fn histogram(all: &[(usize, i64)]) -> Histogram {
    let mut histogram = Histogram::default();
    for (count, micros) in all {
        for _ in 0..*count {
            histogram.record(Duration::from_nanos(micros * US));
        }
    }
    histogram
}

fn clock(bound_us: i64) -> Option<ClockStatus> {
    Some(ClockStatus {
        bound_ns: Some(bound_us * US),
        ..ClockStatus::default()
    })
}

/// The lidar keeps its bounds; of the planner's thousand messages three come 100 us too late.
fn measures() -> FederationMeasures {
    let sent = |lag: Histogram| Downstream {
        messages: 1_000,
        launch_lag: lag,
        ..Downstream::default()
    };
    let received = |slack: Histogram, lateness: Histogram, arrival: Histogram| Upstream {
        messages: 1_000,
        stp_violations: lateness.count(),
        slack,
        lateness,
        arrival,
        ..Upstream::default()
    };
    let mut lidar = FederateMeasures::of("lidar");
    lidar.clock = clock(20);
    lidar.downstreams.insert(
        "planner".to_owned(),
        sent(histogram(&[(990, 50), (10, 150)])),
    );
    let mut planner = FederateMeasures::of("planner");
    planner.clock = clock(25);
    planner
        .downstreams
        .insert("brake".to_owned(), sent(histogram(&[(1_000, 1_000)])));
    planner.upstreams.insert(
        "lidar".to_owned(),
        received(
            histogram(&[(999, 768), (1, 512)]),
            Histogram::default(),
            histogram(&[(999, 132), (1, 388)]),
        ),
    );
    let mut brake = FederateMeasures::of("brake");
    brake.upstreams.insert(
        "planner".to_owned(),
        received(
            histogram(&[(997, 4_096)]),
            histogram(&[(3, 100)]),
            histogram(&[(997, 1_404)]),
        ),
    );
    FederationMeasures {
        federation: "f".to_owned(),
        federates: vec![lidar, planner, brake],
    }
}

#[test]
fn declared_measured_and_margin_stand_side_by_side() {
    let report = bounds_report(&plan(), &measures()).unwrap();
    assert_eq!(
        report.to_string(),
        "\
bounds, in ms                        declared       p50       p99       max    margin        n
lidar: S 0, required 0; E 0.020; violations 0
  L to planner                          0.200     0.054     0.054     0.150     0.050     1000
planner: S 0.9, required 0.9; E 0.025; violations 0
  L to brake                            2.000     1.000     1.000     1.000     1.000     1000
  S for lidar                           0.900     0.148     0.148     0.388     0.512     1000
  slack of lidar (p50, p1, least)           -     0.720     0.720     0.512         -     1000
  L+N from lidar (+-0.045)              0.800     0.148     0.148     0.388     0.412     1000
  N from lidar, estimate                0.600     0.095     0.095     0.335         -     1000
  E with lidar                          0.100     0.045     0.045     0.045     0.055
brake: S 6.4, required 6.4; E unknown; violations 3
  S for planner                         6.400     2.304     2.304     6.500    -0.100     1000
  slack of planner (p50, p1, least)         -     4.096     4.096     4.096         -      997
  too late from planner                     -     0.100     0.100     0.100         -        3
  L+N after S of planner                5.000     1.404     1.404     1.404     3.596      997
  N from planner, estimate              3.000     0.404     0.404     0.404         -      997
  E with planner                        0.500         -         -         -         -"
    );
}

#[test]
fn figures_are_those_of_the_histograms() {
    let report = bounds_report(&plan(), &measures()).unwrap();
    let [lidar, planner, brake] = report.federates.as_slice() else {
        panic!("{report:?}")
    };
    assert_eq!(
        (lidar.required_ns, planner.required_ns),
        (Some(0), Some(900 * US))
    );
    assert_eq!((brake.offset_ns, brake.violations), (6_400 * US, 3));
    let row = |what| brake.rows.iter().find(|row| row.what == what).unwrap();
    let offset = row(Measure::Offset);
    assert_eq!(offset.measured.unwrap().count, 1_000);
    assert_eq!(offset.measured.unwrap().max_ns, 6_500 * US);
    assert_eq!(
        offset.margin_ns,
        Some(-100 * US),
        "a broken bound has a negative margin"
    );
    assert_eq!(row(Measure::Lateness).measured.unwrap().max_ns, 100 * US);
    assert_eq!(row(Measure::Arrival).declared_ns, Some(5 * MS));
    assert_eq!(
        row(Measure::Arrival).band_ns,
        None,
        "the brake's clock is unknown"
    );
    let sums = planner.rows.iter().find(|row| row.what == Measure::Arrival);
    assert_eq!(sums.unwrap().band_ns, Some(45 * US));
}

/// A message that comes after the wait, at a tag that nobody had decided, has a slack of 0: its arrival tells how late it was.
#[test]
fn harmless_late_messages_count_for_the_offset() {
    let mut measures = measures();
    let peer = measures.federates[1].upstreams.get_mut("lidar").unwrap();
    peer.slack = histogram(&[(900, 768), (100, 0)]);
    peer.arrival = histogram(&[(900, 132), (100, 2_048)]);
    let report = bounds_report(&plan(), &measures).unwrap();
    let offset = report.federates[1]
        .rows
        .iter()
        .find(|row| row.what == Measure::Offset);
    let measured = offset.unwrap().measured.unwrap();
    assert!(measured.p50_ns < 200 * US, "{measured:?}");
    assert_eq!(measured.max_ns, 2_048 * US);
    assert_eq!(offset.unwrap().margin_ns, Some((900 - 2_048) * US));
}

/// Nothing measured, nothing declared: rows without figures.
#[test]
fn nothing_measured_is_no_error() {
    let mut plan = plan();
    for wire in &mut plan.connections {
        wire.bounds = None;
    }
    let report = bounds_report(&plan, &FederationMeasures::default()).unwrap();
    assert!(
        report
            .federates
            .iter()
            .flat_map(|one| &one.rows)
            .all(|row| row.measured.is_none())
    );
    assert!(suggest(&plan, &FederationMeasures::default(), 20).is_empty());
    plan.coordination = Coordination::Centralized;
    assert_eq!(bounds_report(&plan, &FederationMeasures::default()), None);
}

/// 150 us and 20 % are 180; of 388 and 20 %, 470 in steps of 10, 180 are L; the late ones took 6400 + 100 - 900 in all.
#[test]
fn suggestions_are_a_section_of_the_manifest() {
    let found = suggest(&plan(), &measures(), 20);
    assert_eq!(
        found.to_string(),
        "\
# The largest measured values and 20 % more.
bounds:
  launch_lag: 1.2 ms
  latency: 5.52 ms
  clock_error: 0.05 ms
  links:
    lidar -> planner: { launch_lag: 0.18 ms, latency: 0.29 ms, clock_error: 0.05 ms } # 1000 messages
    planner -> brake: { launch_lag: 1.2 ms, latency: 5.52 ms } # 1000 messages"
    );
    // What was measured fits into what is suggested.
    let link = &found.links[1];
    assert!(link.launch_lag_ns.unwrap() + link.latency_ns.unwrap() >= 5_600 * US);
}

/// Slack in a wide bucket: 180 ms of a wait of 200 lie in one from 168 to 184 ms. Nothing may look better than it is.
#[test]
fn slack_and_need_are_never_better_than_they_were() {
    let mut plan = plan();
    plan.federates[1].stp_offset_ns = 200 * MS;
    let mut measures = measures();
    let peer = measures.federates[1].upstreams.get_mut("lidar").unwrap();
    peer.slack = histogram(&[(10, 175_000), (990, 180_000)]);
    for arrivals in [vec![], vec![(990, 20_000), (10, 25_000)]] {
        let peer = measures.federates[1].upstreams.get_mut("lidar").unwrap();
        peer.arrival = histogram(&arrivals);
        let report = bounds_report(&plan, &measures).unwrap();
        let rows = &report.federates[1].rows;
        let row = |what| rows.iter().find(|row| row.what == what).unwrap();
        let slack = row(Measure::Slack).measured.unwrap();
        assert_eq!(slack.max_ns, 175 * MS);
        assert!(
            slack.p50_ns <= 180 * MS && slack.p99_ns <= 180 * MS,
            "{slack:?}"
        );
        let offset = row(Measure::Offset);
        let needed = offset.measured.unwrap();
        assert_eq!((needed.max_ns, offset.margin_ns), (25 * MS, Some(175 * MS)));
        assert!(
            needed.p50_ns >= 20 * MS && needed.p99_ns >= 20 * MS,
            "{needed:?}"
        );
        if let Some(arrived) = row(Measure::Arrival).measured {
            assert_eq!(
                (needed.p50_ns, needed.p99_ns),
                (arrived.p50_ns, arrived.p99_ns)
            );
        }
    }
}

/// However wide the figures are, a space stands between them.
#[test]
fn columns_never_run_together() {
    let mut plan = plan();
    plan.federates[1].stp_offset_ns = 4_000_000 * MS;
    let mut measures = measures();
    let peer = measures.federates[1].upstreams.get_mut("lidar").unwrap();
    peer.lateness = histogram(&[(1, 9_000_000_000)]);
    let text = bounds_report(&plan, &measures).unwrap().to_string();
    let row = text
        .lines()
        .find(|line| line.contains("S for lidar"))
        .unwrap();
    assert_eq!(row.split_whitespace().count(), 9, "{row}");
}

/// Without a bound of the clocks what was declared stands there, else nothing: the section is complete in any case.
#[test]
fn what_was_not_measured_is_as_declared() {
    let (mut plan, mut measures) = (plan(), measures());
    for federate in &mut measures.federates {
        federate.clock = None;
    }
    let said = |plan: &Plan| suggest(plan, &measures, 20).to_string();
    let line = "\n  clock_error: 0.5 ms   # declared, not measured\n";
    assert!(said(&plan).contains(line), "{}", said(&plan));
    for wire in &mut plan.connections {
        wire.bounds = None;
    }
    let line = "\n  clock_error: 0 s   # not measured\n";
    assert!(said(&plan).contains(line), "{}", said(&plan));
}
