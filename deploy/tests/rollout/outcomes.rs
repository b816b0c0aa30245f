//! One outcome of several parts.

use std::collections::{BTreeMap, BTreeSet};

use ictus_deploy::rollout::{Cause, Ended, Merged, PartOutcome, merge_outcomes};
use proptest::prelude::*;

fn cause(host: &str, rank: u8, at_ns: i64) -> Cause {
    Cause {
        host: host.to_owned(),
        step: String::new(),
        what: format!("failed at {at_ns}"),
        rank,
        at_ns,
    }
}

fn failed(host: &str, rank: u8, at_ns: i64) -> PartOutcome {
    PartOutcome::Ended(Ended::Failed {
        cause: cause(host, rank, at_ns),
        was_healthy: at_ns > 5,
    })
}

fn merged(parts: &[(&str, PartOutcome)]) -> Merged {
    let parts = parts.iter();
    merge_outcomes(
        &parts
            .map(|(host, part)| ((*host).to_owned(), part.clone()))
            .collect(),
    )
}

#[test]
fn the_lowest_rank_and_then_the_earliest_failure_is_told() {
    // `a` noticed first that the RTI was lost, but `c` had panicked.
    let all = merged(&[
        ("a", failed("a", 3, 1)),
        ("b", failed("b", 0, 9)),
        ("c", failed("c", 0, 7)),
    ]);
    let Some(Ended::Failed { cause, was_healthy }) = all.ended else {
        panic!("{all:?}");
    };
    assert_eq!((cause.host.as_str(), was_healthy), ("c", true));
    assert_eq!(cause.to_string(), "host `c`: failed at 7");
}

#[test]
fn a_host_that_cannot_be_reached_has_not_failed() {
    let unknown = PartOutcome::Unknown { since_ns: 42 };
    let completed = PartOutcome::Ended(Ended::Completed);
    let it = merged(&[("a", completed.clone()), ("b", unknown.clone())]);
    assert_eq!(it.ended, None);
    assert_eq!(it.unknown, BTreeMap::from([("b".to_owned(), 42)]));
    // A failure is known from one part alone.
    let it = merged(&[("a", failed("a", 0, 1)), ("b", unknown)]);
    assert!(matches!(it.ended, Some(Ended::Failed { .. })));
    let it = merged(&[("a", completed.clone()), ("b", PartOutcome::Runs)]);
    assert_eq!((it.ended, it.runs.len()), (None, 1));
    let stopped = |name: &str| {
        let missed = BTreeSet::from([name.to_owned()]);
        PartOutcome::Ended(Ended::Stopped { missed })
    };
    let it = merged(&[("a", stopped("x")), ("b", completed), ("c", stopped("y"))]);
    let missed = BTreeSet::from(["x".to_owned(), "y".to_owned()]);
    assert_eq!(it.ended, Some(Ended::Stopped { missed }));
    assert_eq!(merged(&[]), Merged::default());
}

fn part() -> impl Strategy<Value = PartOutcome> {
    prop_oneof![
        Just(PartOutcome::Runs),
        (0_i64..9).prop_map(|since_ns| PartOutcome::Unknown { since_ns }),
        Just(PartOutcome::Ended(Ended::Completed)),
        Just(PartOutcome::Ended(Ended::Aborted)),
        Just(PartOutcome::Ended(Ended::Stopped {
            missed: BTreeSet::new()
        })),
        (0_u8..4, 0_i64..9).prop_map(|(rank, at_ns)| failed("h", rank, at_ns)),
    ]
}

proptest! {
    /// The hosts' names play no part in how it ended, only in where.
    #[test]
    fn the_order_of_hosts_does_not_matter(parts in prop::collection::vec(part(), 0..5)) {
        let named = |reverse: bool| -> BTreeMap<String, PartOutcome> {
            let count = parts.len();
            let name = |index: usize| if reverse { count - index } else { index };
            parts.iter().enumerate().map(|(index, part)| (name(index).to_string(), part.clone())).collect()
        };
        prop_assert_eq!(merge_outcomes(&named(false)).ended, merge_outcomes(&named(true)).ended);
    }

    /// An end that is no failure is told only when everybody has ended; what is not known never makes a failure.
    #[test]
    fn nothing_is_inferred_from_silence(parts in prop::collection::vec(part(), 0..5)) {
        let named: BTreeMap<_, _> = parts.iter().enumerate().map(|(i, it)| (i.to_string(), it.clone())).collect();
        let failures = parts.iter().filter(|it| matches!(it, PartOutcome::Ended(Ended::Failed { .. }))).count();
        let open = parts.iter().any(|it| !matches!(it, PartOutcome::Ended(_)));
        match merge_outcomes(&named).ended {
            None => prop_assert!(failures == 0 && (open || parts.is_empty())),
            Some(Ended::Failed { .. }) => prop_assert!(failures > 0),
            Some(_) => prop_assert!(failures == 0 && !open),
        }
    }
}
