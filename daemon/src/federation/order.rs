//! A member's start is told before what the RTI says of it, though their supervisors speak independently.

use std::collections::{BTreeSet, VecDeque};

use ictus_coord::report::RtiStatus;

use super::link::Heard;
use crate::agent::{MemberEvent, MemberId};

/// Puts what supervisors say in order: from the first word of the RTI about a member that has not said
/// anything itself, the RTI waits for that member.
#[derive(Debug, Default)]
pub(crate) struct Order {
    /// Members whose supervisors are asked for and have not said anything.
    silent: BTreeSet<MemberId>,
    /// What the RTI said and nobody has taken.
    rti: VecDeque<Heard>,
    /// What others said and nobody has taken; it goes first.
    others: VecDeque<Heard>,
    /// The RTI has ended: nothing of it waits any more.
    rti_ended: bool,
}

impl Order {
    /// This member's supervisor is asked for.
    pub(crate) fn expect(&mut self, member: MemberId) {
        self.silent.insert(member);
    }

    /// Whoever has not said anything is not waited for.
    pub(crate) fn expect_nobody(&mut self) {
        self.silent.clear();
    }

    /// Takes what was heard.
    pub(crate) fn push(&mut self, heard: Heard) {
        let (Heard::Identified { member, .. }
        | Heard::CaughtUp { member }
        | Heard::Event { member, .. }) = &heard;
        if *member != MemberId::Rti {
            if !matches!(heard, Heard::Identified { .. }) {
                self.silent.remove(member);
            }
            self.others.push_back(heard);
            return;
        }
        if let Heard::Event { event, .. } = &heard
            && !matches!(
                event,
                MemberEvent::Started { .. } | MemberEvent::Reported { .. }
            )
        {
            self.rti_ended = true;
        }
        self.rti.push_back(heard);
    }

    /// What is to be handled next; absent when nothing is, or it waits for a member.
    pub(crate) fn next(&mut self) -> Option<Heard> {
        let waits = |heard: &Heard| joined(heard).is_some_and(|it| self.silent.contains(&it));
        if let Some(heard) = self.others.pop_front() {
            return Some(heard);
        }
        if !self.rti_ended && self.rti.front().is_some_and(waits) {
            return None;
        }
        self.rti.pop_front()
    }
}

/// Whom the RTI says to have joined.
fn joined(heard: &Heard) -> Option<MemberId> {
    let Heard::Event {
        event: MemberEvent::Reported { line },
        ..
    } = heard
    else {
        return None;
    };
    match serde_json::from_value(line.clone()) {
        Ok(RtiStatus::Joined { federate }) => Some(MemberId::Federate(federate)),
        Ok(_) | Err(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::{Heard, MemberEvent, MemberId, Order};

    const A: MemberId = MemberId::Federate(0);

    fn heard(member: MemberId, event: MemberEvent) -> Heard {
        let at_ns = 0;
        Heard::Event {
            member,
            at_ns,
            event,
        }
    }

    fn rti(line: serde_json::Value) -> Heard {
        heard(MemberId::Rti, MemberEvent::Reported { line })
    }

    fn all(order: &mut Order) -> Vec<String> {
        let heard = std::iter::from_fn(|| order.next());
        let word = |heard| {
            let Heard::Event { event, .. } = heard else {
                panic!("{heard:?}")
            };
            if let MemberEvent::Reported { line } = event {
                line["event"].as_str().unwrap().to_owned()
            } else if matches!(event, MemberEvent::Started { .. }) {
                "started".to_owned()
            } else {
                "ended".to_owned()
            }
        };
        heard.map(word).collect()
    }

    #[test]
    fn who_joins_has_started_before() {
        let mut order = Order::default();
        order.expect(A);
        order.push(rti(json!({"event": "listening", "port": 1})));
        assert_eq!(all(&mut order), ["listening"]);
        order.push(rti(json!({"event": "joined", "federate": 0})));
        order.push(rti(json!({"event": "start", "start_ns": 5})));
        assert!(all(&mut order).is_empty());
        order.push(heard(A, MemberEvent::Started { pid: 7 }));
        assert_eq!(all(&mut order), ["started", "joined", "start"]);
    }

    #[test]
    fn a_member_that_never_speaks_does_not_hold_the_end_of_the_rti() {
        let mut order = Order::default();
        order.expect(A);
        order.push(rti(json!({"event": "joined", "federate": 0})));
        assert!(all(&mut order).is_empty());
        order.push(heard(MemberId::Rti, MemberEvent::Closed));
        assert_eq!(all(&mut order), ["joined", "ended"]);
    }
}
