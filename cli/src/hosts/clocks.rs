//! How far times of different hosts may be off against each other.

use std::collections::BTreeMap;
use std::fmt;

use ictusd::api::FederationMeasures;
use serde::Serialize;

use crate::ui::nanoseconds;

/// The bounds of the hosts' clocks, where there are several.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct ClockBounds {
    /// How far the clock of any federate of the host may be from its reference, in nanoseconds; null when nothing is known.
    hosts: BTreeMap<String, Option<i64>>,
    /// How far two times of different hosts may be off against each other, in nanoseconds; null when that is not known.
    between_ns: Option<i64>,
}

impl ClockBounds {
    /// What federates say of their clocks, by host; absent when all are on one host, whose clock they share.
    pub(crate) fn of(measures: &BTreeMap<String, FederationMeasures>) -> Option<Self> {
        let with_federates = measures.iter().filter(|(_, it)| !it.federates.is_empty());
        let hosts: BTreeMap<String, Option<i64>> = with_federates
            .map(|(host, measures)| (host.clone(), bound(measures)))
            .collect();
        if hosts.len() < 2 {
            return None;
        }
        let mut bounds: Vec<i64> = hosts.values().flatten().copied().collect();
        bounds.sort_unstable_by_key(|bound| std::cmp::Reverse(*bound));
        let all_known = bounds.len() == hosts.len();
        let worst = bounds
            .iter()
            .take(2)
            .fold(0, |sum: i64, it| sum.saturating_add(*it));
        Some(Self {
            between_ns: all_known.then_some(worst),
            hosts,
        })
    }
}

/// The worst of a host's federates; one that says nothing counts as unknown.
fn bound(measures: &FederationMeasures) -> Option<i64> {
    let bounds = measures.federates.iter();
    bounds
        .map(|federate| federate.clock.as_ref()?.bound_ns)
        .try_fold(0, |worst: i64, bound| Some(worst.max(bound?)))
}

impl fmt::Display for ClockBounds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let each = self.hosts.iter().map(|(host, bound)| {
            let bound = bound.map_or_else(|| "unknown".to_owned(), nanoseconds);
            format!("{host} {bound}")
        });
        let each = each.collect::<Vec<_>>().join(", ");
        match self.between_ns {
            Some(between) => write!(
                f,
                "times of different hosts are off by at most {} against each other ({each})",
                nanoseconds(between)
            ),
            None => write!(
                f,
                "how far times of different hosts are off against each other is not known ({each}); \
                 `clock: {{ sync: on }}` compares them"
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use ictus_coord::report::{ClockStatus, FederateMeasures};

    use super::*;

    fn measures(hosts: &[(&str, &[Option<i64>])]) -> BTreeMap<String, FederationMeasures> {
        let federate = |bound_ns: &Option<i64>| FederateMeasures {
            clock: Some(ClockStatus {
                bound_ns: *bound_ns,
                ..ClockStatus::default()
            }),
            ..FederateMeasures::of("f")
        };
        let host = |(name, bounds): &(&str, &[Option<i64>])| {
            let measures = FederationMeasures {
                federation: "x".to_owned(),
                federates: bounds.iter().map(federate).collect(),
            };
            ((*name).to_owned(), measures)
        };
        hosts.iter().map(host).collect()
    }

    #[test]
    fn the_error_between_hosts_is_the_sum_of_the_two_worst() {
        let of = |hosts: &[(&str, &[Option<i64>])]| ClockBounds::of(&measures(hosts));
        assert_eq!(of(&[("a", &[Some(5)])]), None, "one host, one clock");
        assert_eq!(of(&[("a", &[Some(5)]), ("b", &[])]), None);
        let three = of(&[
            ("a", &[Some(3), Some(5)]),
            ("b", &[Some(1)]),
            ("c", &[Some(4)]),
        ]);
        assert_eq!(three.clone().unwrap().between_ns, Some(9));
        let said = three.unwrap().to_string();
        assert!(
            said.contains("at most 9 ns") && said.contains("b 1 ns"),
            "{said}"
        );
        let unknown = of(&[("a", &[Some(3), None]), ("b", &[Some(1)])]).unwrap();
        assert_eq!(unknown.between_ns, None);
        assert!(unknown.to_string().contains("a unknown, b 1 ns"));
    }
}
