//! Which NETs a federate need not send for others' sake (DNET).
//!
//! Source: reactor-c `rti_common.c`; section 6.5 of the wire document. Difference: a federate with any member of a
//! zero-delay cycle downstream gets none (there, it depends on who sent the last NET).

use ictus_core::{Duration, LogicalTime, Tag};

use super::grant::{Presence, View};
use crate::mutants::Mutant;
use crate::topology::FederateId;

/// Returns the largest tag x such that a message sent at x over `path` arrives no later than `next_event`.
///
/// NEVER when there is none, FOREVER when every tag will do. Law `the_latest_departure_is_the_largest`.
#[must_use]
pub(super) fn latest_departure(next_event: Tag, path: Tag) -> Tag {
    if next_event == Tag::FOREVER {
        return Tag::FOREVER;
    }
    if next_event == Tag::NEVER || next_event < path || path == Tag::FOREVER {
        return Tag::NEVER;
    }
    let time = next_event
        .time
        .saturating_add(-(path.time.since(LogicalTime::from_nanos(0))));
    match next_event.microstep.checked_sub(path.microstep) {
        Some(_) if path.time > Tag::ZERO.time => Tag::new(time, u32::MAX),
        Some(microstep) => Tag::new(time, microstep),
        None => Tag::new(time.saturating_add(-Duration::NANOSECOND), u32::MAX),
    }
}

/// Returns the tag up to which NETs of `federate` change nothing downstream.
///
/// NEVER: all are needed; FOREVER: none is. O(transitive downstreams).
#[must_use]
pub(super) fn downstream_next_event(view: &View<'_>, federate: FederateId) -> Tag {
    if view.topology.in_zero_delay_cycle(federate) {
        return Tag::NEVER;
    }
    let least = view
        .topology
        .sinks(federate)
        .iter()
        .filter(|&&(sink, _)| sink != federate)
        .map(|&(sink, path)| {
            if view.topology.in_zero_delay_cycle(sink) {
                return Tag::NEVER;
            }
            let next = needed_by(view, sink);
            if view.mutants.has(Mutant::DownstreamNextTooLate) {
                return next.delayed(ictus_core::Delay::Microstep);
            }
            latest_departure(next, path)
        })
        .min()
        .unwrap_or(Tag::FOREVER);
    if least < view.start {
        Tag::NEVER
    } else {
        least
    }
}

/// The tag that `sink` waits to reach; nothing once it is gone.
fn needed_by(view: &View<'_>, sink: FederateId) -> Tag {
    let standing = &view.standings[sink.index()];
    match standing.presence {
        Presence::Present => standing.next_event,
        Presence::Resigned | Presence::Lost => Tag::FOREVER,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn successor(tag: Tag) -> Tag {
        if tag.microstep == u32::MAX {
            Tag::new(tag.time.saturating_add(Duration::NANOSECOND), 0)
        } else {
            Tag::new(tag.time, tag.microstep + 1)
        }
    }

    proptest! {
        #[test]
        fn the_latest_departure_is_the_largest(
            time in 100i64..120, microstep in 0u32..4, delay in 0i64..6, steps in 0u32..4,
        ) {
            let next = Tag::new(LogicalTime::from_nanos(time), microstep);
            let path = Tag::new(LogicalTime::from_nanos(delay), steps);
            let latest = latest_departure(next, path);
            prop_assert!(latest.plus_path(path) <= next || latest.microstep == u32::MAX);
            let sane = Tag::new(latest.time, latest.microstep.min(1000));
            prop_assert!(sane.plus_path(path) <= next);
            prop_assert!(successor(latest).plus_path(path) > next);
        }
    }

    #[test]
    fn the_ends_of_time() {
        let path = Tag::at(5);
        assert_eq!(latest_departure(Tag::FOREVER, path), Tag::FOREVER);
        assert_eq!(latest_departure(Tag::NEVER, path), Tag::NEVER);
        assert_eq!(latest_departure(Tag::at(3), path), Tag::NEVER);
        assert_eq!(latest_departure(Tag::at(10), Tag::FOREVER), Tag::NEVER);
        assert_eq!(
            latest_departure(Tag::at(5), path),
            Tag::new(LogicalTime::from_nanos(0), u32::MAX)
        );
    }
}
