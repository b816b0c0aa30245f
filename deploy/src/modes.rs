//! One manifest's plan under the other coordination, for runs that are compared.

use std::fmt;

use ictus_coord::plan::{Bounds, Coordination, Plan};
use ictus_coord::stp::{self, Link};

use crate::check::Checked;
use crate::offsets::tenths;

/// What each connection adds to the offsets when nothing else is said, in nanoseconds: long for one machine, and a cycle
/// of connections with `after` delays below it takes the next one.
const SPANS: [i64; 8] = [
    200_000_000,
    100_000_000,
    50_000_000,
    20_000_000,
    10_000_000,
    5_000_000,
    2_000_000,
    1_000_000,
];

/// Where the offsets of a decentralized run come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OffsetOrigin {
    /// From the manifest: declared, or solved from its bounds.
    Manifest,
    /// Solved from this much for every connection, in nanoseconds.
    PerConnection(i64),
    /// The same for every federate, in nanoseconds: a cycle without delay has no solution.
    Uniform(i64),
}

impl Checked {
    /// The plan under centralized coordination.
    #[must_use]
    pub fn centralized(&self) -> Plan {
        Plan {
            coordination: Coordination::Centralized,
            ..self.plan.clone()
        }
    }

    /// The plan under decentralized coordination, and where its offsets come from. With `span_ns` every connection adds
    /// so much, whatever the manifest says; else the manifest's offsets are used, and a long span when it has none.
    #[must_use]
    pub fn decentralized(&self, span_ns: Option<i64>) -> (Plan, OffsetOrigin) {
        let mut plan = Plan {
            coordination: Coordination::Decentralized,
            ..self.plan.clone()
        };
        if span_ns.is_none() {
            if self.plan.coordination == Coordination::Decentralized {
                return (plan, OffsetOrigin::Manifest);
            }
            if let Some(offsets) = &self.offsets {
                offsets.apply(&mut plan);
                return (plan, OffsetOrigin::Manifest);
            }
        }
        let spans = span_ns.as_ref().map_or(&SPANS[..], std::slice::from_ref);
        let found = spans.iter().find(|span| widen(&mut plan, **span));
        let origin = found.map_or_else(
            || {
                let span = spans.first().copied().unwrap_or(0);
                for federate in &mut plan.federates {
                    federate.stp_offset_ns = span;
                }
                for wire in &mut plan.connections {
                    wire.stp_offset_ns = None;
                }
                OffsetOrigin::Uniform(span)
            },
            |span| OffsetOrigin::PerConnection(*span),
        );
        (plan, origin)
    }
}

/// Solves the offsets with this much for every connection; false, and nothing changed but bounds, when that has no solution.
fn widen(plan: &mut Plan, span: i64) -> bool {
    let bounds = Bounds {
        latency_ns: span,
        ..Bounds::default()
    };
    for wire in &mut plan.connections {
        let tagged = Link::of(wire).is_some();
        wire.bounds = tagged.then_some(bounds);
        wire.stp_offset_ns = None;
    }
    let links: Vec<Link> = plan.connections.iter().filter_map(Link::of).collect();
    let Ok(solution) = stp::solve(&links, &vec![None; plan.federates.len()]) else {
        return false;
    };
    for (federate, offset) in plan.federates.iter_mut().zip(&solution.federates) {
        federate.stp_offset_ns = offset.used_ns;
    }
    let tagged = plan.connections.iter_mut();
    let tagged = tagged.filter(|wire| Link::of(wire).is_some());
    for (wire, offset) in tagged.zip(&solution.links) {
        wire.stp_offset_ns = Some(offset.used_ns);
    }
    true
}

impl fmt::Display for OffsetOrigin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Manifest => write!(f, "offsets of the manifest"),
            Self::PerConnection(span) => {
                write!(f, "offsets solved from {} ms per connection", tenths(*span))
            }
            Self::Uniform(span) => write!(f, "an offset of {} ms everywhere", tenths(*span)),
        }
    }
}
