//! Laws of what is measured.
#![allow(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    missing_docs,
    reason = "tests"
)]

use ictus_coord::measure::{Histogram, LagNews, LagWatch, Measures, Upstream};
use ictus_coord::report::{ClockStatus, FederateMeasures, FederateStatus, LINE_BYTES_MAX, lines};
use ictus_core::{Duration, LogicalTime, PhysicalTime, Tag};
use proptest::prelude::*;

/// Durations of every magnitude, negative ones too.
fn span() -> impl Strategy<Value = i64> {
    (0_u32..63, any::<i64>()).prop_map(|(shift, nanos)| nanos >> shift)
}

fn spans() -> impl Strategy<Value = Vec<i64>> {
    prop::collection::vec(span(), 0..200)
}

fn histogram(spans: &[i64]) -> Histogram {
    let mut histogram = Histogram::default();
    for nanos in spans {
        histogram.record(Duration::from_nanos(*nanos));
    }
    histogram
}

proptest! {
    #[test]
    fn a_quantile_is_at_most_an_eighth_above_the_exact_one(mut spans in spans(), q in 0.0_f64..=1.0) {
        let histogram = histogram(&spans);
        spans.iter_mut().for_each(|nanos| *nanos = (*nanos).max(0));
        spans.sort_unstable();
        let rank = (q * spans.len() as f64).ceil() as usize;
        let exact = spans.get(rank.saturating_sub(1)).copied().unwrap_or(0);
        let said = histogram.quantile(q).as_nanos();
        prop_assert!(said >= exact, "{said} < {exact}");
        prop_assert!(said - exact <= exact / 8, "{said} >> {exact}");
    }

    #[test]
    fn a_floor_is_at_most_an_eighth_below_the_exact_one(mut spans in spans(), q in 0.0_f64..=1.0) {
        let histogram = histogram(&spans);
        spans.iter_mut().for_each(|nanos| *nanos = (*nanos).max(0));
        spans.sort_unstable();
        let rank = (q * spans.len() as f64).ceil() as usize;
        let exact = spans.get(rank.saturating_sub(1)).copied().unwrap_or(0);
        let said = histogram.quantile_floor(q).as_nanos();
        prop_assert!(said <= exact, "{said} > {exact}");
        prop_assert!(exact - said <= exact / 8, "{said} << {exact}");
    }

    #[test]
    fn count_sum_min_and_max_are_exact(spans in prop::collection::vec(-5_i64..1 << 40, 0..200)) {
        let histogram = histogram(&spans);
        let positive = || spans.iter().map(|nanos| (*nanos).max(0));
        prop_assert_eq!(histogram.count(), spans.len() as u64);
        prop_assert_eq!(histogram.sum_ns(), positive().sum::<i64>() as u64);
        prop_assert_eq!(histogram.max().as_nanos(), positive().max().unwrap_or(0));
        prop_assert_eq!(histogram.min().as_nanos(), positive().min().unwrap_or(0));
        prop_assert_eq!(histogram.quantile_floor(0.0), histogram.min());
        prop_assert_eq!(histogram.buckets().map(|(_, n)| n).sum::<u64>(), histogram.count());
    }

    #[test]
    fn merge_equals_recording_both_sequences(one in spans(), other in spans()) {
        let mut merged = histogram(&one);
        merged.merge(&histogram(&other));
        prop_assert_eq!(merged, histogram(&[one, other].concat()));
    }

    #[test]
    fn the_serialized_form_reads_back_as_the_same_histogram(spans in spans()) {
        let histogram = histogram(&spans);
        let text = serde_json::to_string(&histogram).unwrap();
        prop_assert_eq!(serde_json::from_str::<Histogram>(&text).unwrap(), histogram);
    }

    #[test]
    fn what_reads_is_consistent(
        sum in any::<u64>(),
        max in any::<u64>(),
        buckets in prop::collection::vec(prop_oneof![0_u64..40, any::<u64>()], 0..8),
    ) {
        let line = serde_json::json!({ "sum": sum, "max": max, "buckets": buckets });
        if let Ok(histogram) = serde_json::from_value::<Histogram>(line) {
            let counted: u64 = histogram.buckets().map(|(_, n)| n).sum();
            prop_assert_eq!(counted, histogram.count());
            let last = histogram.buckets().last().map_or(Duration::ZERO, |(edge, _)| edge);
            prop_assert!(last >= histogram.max());
        }
    }

    #[test]
    fn events_about_violations_are_few(violations in 1_u64..3_000) {
        let mut measures = Measures::new(&[1], &[]);
        let told = (0..violations).filter_map(|_| measures.violation(1, Duration::NANOSECOND));
        let told: Vec<u64> = told.collect();
        let expected: Vec<u64> = [1, 10, 100, 1_000].into_iter().filter(|n| *n <= violations).collect();
        prop_assert_eq!(told, expected);
        prop_assert_eq!(measures.stp_violations(), violations);
    }
}

#[test]
fn small_values_have_buckets_of_their_own() {
    let histogram = histogram(&[0, 1, 7, 8, 15, 16, 17, 18]);
    let edges: Vec<i64> = histogram
        .buckets()
        .map(|(edge, _)| edge.as_nanos())
        .collect();
    assert_eq!(edges, [0, 1, 7, 8, 15, 17, 19]);
    assert_eq!(histogram.quantile(f64::NAN), Duration::from_nanos(18));
}

/// What was written before there was a minimum has its first bucket's lower edge.
#[test]
fn a_record_without_a_minimum_reads() {
    let line = r#"{"sum":36,"max":19,"buckets":[16,1,0,1]}"#;
    let old: Histogram = serde_json::from_str(line).unwrap();
    assert_eq!((old.min(), old.count()), (Duration::from_nanos(16), 2));
}

#[test]
fn damaged_histograms_are_refused() {
    for (line, why) in [
        (
            r#"{"sum":1,"max":1,"buckets":[1]}"#,
            "a gap without its count",
        ),
        (
            r#"{"sum":1,"max":1,"buckets":[488,1]}"#,
            "a bucket that does not exist",
        ),
        (
            r#"{"sum":1,"max":1,"buckets":[18446744073709551615,1]}"#,
            "a bucket that does not exist",
        ),
        (
            r#"{"sum":1,"max":1,"buckets":[1,0]}"#,
            "a count out of range",
        ),
        (
            r#"{"sum":1,"max":1,"buckets":[0,18446744073709551615,0,1]}"#,
            "a count out of range",
        ),
        (
            r#"{"sum":1,"max":5,"buckets":[1,1]}"#,
            "a maximum outside the last bucket",
        ),
        (
            r#"{"sum":1,"max":5,"buckets":[]}"#,
            "a maximum outside the last bucket",
        ),
        (
            r#"{"sum":1,"min":0,"max":1,"buckets":[1,1]}"#,
            "a minimum outside the first bucket",
        ),
        (
            r#"{"sum":2,"min":17,"max":16,"buckets":[16,1]}"#,
            "a minimum outside the first bucket",
        ),
    ] {
        let error = serde_json::from_str::<Histogram>(line)
            .unwrap_err()
            .to_string();
        assert!(error.contains(why), "{line}: {error}");
    }
}

#[test]
fn a_report_keeps_the_histograms_it_leaves_out() {
    let mut known = Upstream {
        messages: 3,
        slack: histogram(&[1, 2, 3]),
        ..Upstream::default()
    };
    known.update(Upstream {
        messages: 5,
        lateness: histogram(&[9]),
        ..Upstream::default()
    });
    assert_eq!(known.messages, 5);
    assert_eq!(known.slack, histogram(&[1, 2, 3]));
    assert_eq!(known.lateness, histogram(&[9]));
}

#[test]
fn measures_count_by_peer() {
    let mut measures = Measures::new(&[3, 1], &[2]);
    measures.arrived(1, 4);
    measures.arrived(3, 8);
    measures.arrived(1, 4);
    measures.slack(1, Duration::from_micros(5));
    measures.sent(2, 16);
    // A peer that was not announced counts as well.
    measures.sent(9, 1);
    let tag = Tag {
        time: LogicalTime::from_nanos(10),
        microstep: 0,
    };
    assert_eq!(measures.tag_begun(PhysicalTime::from_nanos(25), tag), None);
    let received: Vec<_> = measures
        .upstreams()
        .map(|(id, p)| (id, p.messages, p.bytes))
        .collect();
    assert_eq!(received, [(1, 2, 8), (3, 1, 8)]);
    let sent: Vec<_> = measures
        .downstreams()
        .map(|(id, p)| (id, p.messages, p.bytes))
        .collect();
    assert_eq!(sent, [(2, 1, 16), (9, 1, 1)]);
    assert_eq!(measures.own().tag_lag.max(), Duration::from_nanos(15));
}

/// Feeds one window per lag, two samples each of which the second is a burst, and returns the news by window.
fn watch(lags_ms: &[i64]) -> Vec<(usize, LagNews)> {
    let mut watch = LagWatch::default();
    let mut news = Vec::new();
    for (index, lag) in lags_ms.iter().chain(&[0]).enumerate() {
        let second = Duration::from_secs(i64::try_from(index).unwrap());
        let now = PhysicalTime::from_nanos(0) + second;
        news.extend(
            watch
                .sample(now, Duration::from_millis(*lag))
                .map(|n| (index, n)),
        );
        let burst = watch.sample(now + Duration::from_millis(500), Duration::from_secs(100));
        assert_eq!(burst, None);
    }
    news
}

#[test]
fn falling_behind_is_a_lag_that_grew_five_times_beyond_100_ms() {
    let behind = |ms| LagNews::FallingBehind {
        lag: Duration::from_millis(ms),
    };
    let caught_up = |ms| LagNews::CaughtUp {
        lag: Duration::from_millis(ms),
    };
    // Told when the window is over, that is by the next one's first sample.
    assert_eq!(watch(&[10, 30, 50, 70, 90, 110]), [(6, behind(110))]);
    assert_eq!(watch(&[0, 110, 120, 130, 140]), []);
    assert_eq!(watch(&[10, 30, 50, 70, 90, 100]), []);
    assert_eq!(watch(&[10, 30, 50, 70, 70, 110, 120, 130, 140]), []);
    assert_eq!(watch(&[10, 20, 30, 40, 50, 60, 120]), [(7, behind(120))]);
    assert_eq!(
        watch(&[100, 200, 300, 400, 500, 600, 700, 650, 101, 100, 90]),
        [(6, behind(600)), (10, caught_up(100))]
    );
}

#[test]
fn windows_without_a_sample_are_passed_over() {
    let mut watch = LagWatch::default();
    let mut at = PhysicalTime::from_nanos(0);
    let mut behind_at = None;
    for round in 0..7_i64 {
        let lag = Duration::from_millis(100 * round);
        if watch.sample(at, lag).is_some() {
            behind_at = Some(round);
        }
        at = at + Duration::from_secs(10);
    }
    assert_eq!(behind_at, Some(6));
    assert!(watch.behind());
}

/// Something to measure.
#[derive(Clone, Debug)]
enum Act {
    Arrived(u16, i64),
    Slack(u16, i64),
    Late(u16, i64),
    Sent(u16, i64),
    Own(i64),
}

fn act() -> impl Strategy<Value = Act> {
    (0..5, 0_u16..3, span()).prop_map(|(kind, peer, nanos)| match kind {
        0 => Act::Arrived(peer, nanos),
        1 => Act::Slack(peer, nanos),
        2 => Act::Late(peer, nanos),
        3 => Act::Sent(peer, nanos),
        _ => Act::Own(nanos),
    })
}

fn apply(measures: &mut Measures, act: &Act) {
    let span = Duration::from_nanos;
    match *act {
        Act::Arrived(peer, nanos) => {
            measures.arrived(peer, 7);
            measures.arrival(peer, span(nanos));
        }
        Act::Slack(peer, nanos) => measures.slack(peer, span(nanos)),
        Act::Late(peer, nanos) => drop(measures.violation(peer, span(nanos))),
        Act::Sent(peer, nanos) => {
            measures.sent(peer, 9);
            measures.launch_lag(peer, span(nanos));
        }
        Act::Own(nanos) => {
            let tag = Tag {
                time: LogicalTime::from_nanos(0),
                microstep: 0,
            };
            measures.tag_begun(PhysicalTime::from_nanos(nanos), tag);
            measures.grant_wait(span(nanos));
            measures.tag_completed();
            let mut lateness = measures.own().deadline_lateness.clone();
            lateness.record(span(nanos));
            let own = measures.own();
            measures.executed(own.reactions + 2, own.watchdogs_fired + 1, &lateness);
        }
    }
}

const NAMES: [&str; 3] = ["a", "b", "c"];

fn take(known: &mut FederateMeasures, line: &[u8]) {
    let status: FederateStatus = serde_json::from_slice(line).unwrap();
    known.take(status, |id| NAMES.get(usize::from(id)).copied());
}

fn assert_equal(known: &FederateMeasures, measures: &Measures) {
    assert_eq!(known.own, *measures.own());
    let name = |id: u16| NAMES[usize::from(id)].to_owned();
    let upstreams: Vec<_> = measures
        .upstreams()
        .map(|(id, it)| (name(id), it.clone()))
        .collect();
    assert_eq!(
        known.upstreams.clone().into_iter().collect::<Vec<_>>(),
        upstreams
    );
    let downstreams: Vec<_> = measures
        .downstreams()
        .map(|(id, it)| (name(id), it.clone()))
        .collect();
    assert_eq!(
        known.downstreams.clone().into_iter().collect::<Vec<_>>(),
        downstreams
    );
}

proptest! {
    #[test]
    fn lines_tell_all_and_taking_one_twice_is_taking_it_once(
        first in prop::collection::vec(act(), 0..400),
        then in prop::collection::vec(act(), 0..400),
    ) {
        let mut measures = Measures::new(&[0], &[2]);
        first.iter().for_each(|act| apply(&mut measures, act));
        let early = lines("x", &measures);
        let mut known = FederateMeasures::of("x");
        early.iter().for_each(|line| take(&mut known, line));
        assert_equal(&known, &measures);
        then.iter().for_each(|act| apply(&mut measures, act));
        let late = lines("x", &measures);
        late.iter().chain(&late).for_each(|line| take(&mut known, line));
        assert_equal(&known, &measures);
        // An earlier line that comes again changes nothing.
        early.iter().for_each(|line| take(&mut known, line));
        assert_equal(&known, &measures);
        for line in early.iter().chain(&late) {
            prop_assert!(line.len() <= LINE_BYTES_MAX, "{}", line.len());
            prop_assert!(line.ends_with(b"\n") && !line[..line.len() - 1].contains(&b'\n'));
        }
    }

    #[test]
    fn counters_never_go_back(
        lines in prop::collection::vec((0_u64..9, 0_u64..9, 0_u16..5), 0..20)
    ) {
        let mut known = FederateMeasures::of("x");
        let mut most = 0;
        for (tags, messages, upstream) in lines {
            let own = serde_json::json!({
                "event": "measures", "federate": "x", "own": { "tags_completed": tags }
            });
            let peer = serde_json::json!({
                "event": "upstream", "federate": "x", "upstream": upstream,
                "measures": { "messages": messages, "later": true }
            });
            take(&mut known, own.to_string().as_bytes());
            take(&mut known, peer.to_string().as_bytes());
            most = most.max(tags);
            prop_assert_eq!(known.own.tags_completed, most);
            prop_assert!(known.upstreams.len() <= NAMES.len(), "peers are the plan's");
        }
    }
}

#[test]
fn a_report_that_is_too_long_for_a_line_is_told_in_parts() {
    let mut measures = Measures::new(&[0], &[]);
    for shift in 4..50 {
        for sub in 8..16 {
            for _ in 0..11 {
                let span = Duration::from_nanos(sub << shift);
                measures.slack(0, span);
                measures.arrival(0, span);
                measures.violation(0, span);
            }
        }
    }
    let lines = lines("x", &measures);
    let parts: Vec<u64> = lines
        .iter()
        .map(|line| serde_json::from_slice::<serde_json::Value>(line).unwrap())
        .filter(|line| line["event"] == "upstream")
        .map(|line| line["part"].as_u64().unwrap_or(0))
        .collect();
    assert_eq!(parts, [0, 1, 2]);
    let mut known = FederateMeasures::of("x");
    lines.iter().for_each(|line| take(&mut known, line));
    assert_equal(&known, &measures);
}

#[test]
fn the_clock_and_falling_behind_are_taken_too() {
    let mut known = FederateMeasures::of("x");
    let clock = ClockStatus {
        bound_ns: Some(7),
        ..ClockStatus::default()
    };
    let federate = "x".to_owned();
    known.take(
        FederateStatus::Clock {
            federate: federate.clone(),
            clock: clock.clone(),
        },
        |_| None,
    );
    assert_eq!(known.clock, Some(clock));
    known.take(
        FederateStatus::FallingBehind {
            federate: federate.clone(),
            lag_ns: 1,
        },
        |_| None,
    );
    assert!(known.behind);
    known.take(
        FederateStatus::CaughtUp {
            federate,
            lag_ns: 1,
        },
        |_| None,
    );
    assert!(!known.behind);
    // A clock of another version is one as far as it is known.
    take(
        &mut known,
        br#"{"event":"clock","federate":"x","clock":{"offset_ns":5,"new":1}}"#,
    );
    assert_eq!(known.clock.unwrap().offset_ns, 5);
}
