//! NET and LTC, and the grants and DNETs that follow from them, decided once a round.

use ictus_core::Tag;

use super::dnet::downstream_next_event;
use super::grant::{Grant, LostRule, fan_out_grant, tag_advance_grant};
use super::stop::Stop;
use super::{Phase, Rti};
use crate::mutants::Mutant;
use crate::topology::FederateId;
use crate::wire::{ToFederate, capability};

/// Whose promises have changed since the last drain.
#[derive(Debug, Default)]
pub(super) struct Touched {
    /// NET changed: those downstream may be granted more, those upstream may be told a DNET.
    next_event: IdSet,
    /// LTC changed: those downstream may be granted more.
    completed: IdSet,
    /// Scratch: whom to decide about.
    affected: IdSet,
}

/// A set of federates with constant-time insertion, in order of insertion.
#[derive(Debug, Default)]
struct IdSet {
    list: Vec<FederateId>,
    member: Vec<bool>,
}

impl IdSet {
    fn new(federates: usize) -> Self {
        Self {
            list: Vec::with_capacity(federates),
            member: vec![false; federates],
        }
    }

    #[inline]
    fn insert(&mut self, federate: FederateId) {
        let member = &mut self.member[federate.index()];
        if !*member {
            *member = true;
            self.list.push(federate);
        }
    }

    fn clear(&mut self) {
        for federate in self.list.drain(..) {
            self.member[federate.index()] = false;
        }
    }
}

impl Touched {
    pub(super) fn new(federates: usize) -> Self {
        Self {
            next_event: IdSet::new(federates),
            completed: IdSet::new(federates),
            affected: IdSet::new(federates),
        }
    }

    #[inline]
    pub(super) fn next_event(&mut self, federate: FederateId) {
        self.next_event.insert(federate);
    }

    pub(super) fn completed(&mut self, federate: FederateId) {
        self.completed.insert(federate);
    }

    const fn is_empty(&self) -> bool {
        self.next_event.list.is_empty() && self.completed.list.is_empty()
    }
}

impl Rti {
    pub(super) fn record_next_event(&mut self, federate: FederateId, tag: Tag) {
        let in_transit = self.members[federate.index()].in_transit.front();
        let tag = in_transit.map_or(tag, |&first| tag.min(first));
        let ours = self.members[federate.index()].capabilities.is_some();
        let standing = &mut self.standings[federate.index()];
        // A provisional tag will be executed: a NET that crossed its PTAG does not know of it.
        let under_way = ours && standing.provisional > standing.completed;
        let tag = if under_way {
            tag.min(standing.provisional)
        } else {
            tag
        };
        standing.next_event = tag;
        if self.topology.upstream(federate).is_empty() {
            standing.granted = tag;
        }
        self.touched.next_event(federate);
    }

    pub(super) fn record_completed(&mut self, federate: FederateId, tag: Tag) {
        let standing = &mut self.standings[federate.index()];
        standing.completed = standing.completed.max(tag);
        let in_transit = &mut self.members[federate.index()].in_transit;
        while in_transit.front().is_some_and(|&first| first <= tag) {
            in_transit.pop_front();
        }
        self.touched.completed(federate);
    }

    /// Grants, DNETs and confirmations that follow from what was touched.
    pub(super) fn grant_touched(&mut self) {
        let Phase::Running { start } = self.phase else {
            return;
        };
        if self.touched.is_empty() {
            return;
        }
        let mut touched = std::mem::take(&mut self.touched);
        for &federate in &touched.next_event.list {
            touched.affected.insert(federate);
        }
        for &federate in touched
            .next_event
            .list
            .iter()
            .chain(&touched.completed.list)
        {
            for &(sink, _) in self.topology.sinks(federate) {
                touched.affected.insert(sink);
            }
        }
        for &federate in &touched.affected.list {
            self.decide(federate, start);
        }
        self.confirm_downstream();
        touched.affected.clear();
        if self.config.dnet {
            for &federate in &touched.next_event.list {
                // Its own too: a message may have lowered its NET below what it has been told is needless.
                touched.affected.insert(federate);
                for &(source, _) in self.topology.sources(federate) {
                    touched.affected.insert(source);
                }
            }
            for &federate in &touched.affected.list {
                self.tell_downstream_next_event(federate, start);
            }
        }
        touched.affected.clear();
        touched.next_event.clear();
        touched.completed.clear();
        self.touched = touched;
    }

    fn decide(&mut self, federate: FederateId, start: Tag) {
        let view = self.view(self.lost_rule(federate), start);
        if let Some(grant) = tag_advance_grant(&view, federate) {
            self.apply(federate, grant, start);
        }
    }

    /// Sends a grant, and to the other members of a zero-delay cycle what a PTAG demands of them.
    fn apply(&mut self, federate: FederateId, grant: Grant, start: Tag) {
        let mut provisional = Vec::new();
        self.send_grant(federate, grant, &mut provisional);
        while let Some((federate, tag)) = provisional.pop() {
            for at in 0..self.topology.upstream(federate).len() {
                let (upstream, _) = self.topology.upstream(federate)[at];
                if !self.topology.share_zero_delay_cycle(upstream, federate) {
                    continue;
                }
                let view = self.view(self.lost_rule(upstream), start);
                if let Some(grant) = fan_out_grant(&view, upstream, tag) {
                    self.send_grant(upstream, grant, &mut provisional);
                }
            }
        }
    }

    fn send_grant(
        &mut self,
        federate: FederateId,
        grant: Grant,
        provisional: &mut Vec<(FederateId, Tag)>,
    ) {
        let standing = &mut self.standings[federate.index()];
        match grant {
            Grant::Full(tag) => {
                standing.granted = tag;
                self.send(federate, &ToFederate::TagAdvanceGrant(tag));
            }
            Grant::Provisional(tag) => {
                standing.provisional = tag;
                if self.members[federate.index()].capabilities.is_some() {
                    standing.next_event = standing.next_event.min(tag);
                }
                provisional.push((federate, tag));
                self.send(federate, &ToFederate::ProvisionalTagAdvanceGrant(tag));
            }
        }
    }

    /// Once the stop tag is agreed, a federate that knows what was lost may be granted past its limit: it runs only its
    /// shutdown there.
    pub(super) fn lost_rule(&self, federate: FederateId) -> LostRule {
        let agreed = matches!(self.stop, Stop::Agreed { .. });
        if self.config.mutants.has(Mutant::LostAsResigned)
            || (agreed && self.has_capability(federate, capability::FEDERATE_LOST))
        {
            LostRule::Gone
        } else {
            LostRule::Limits
        }
    }

    fn tell_downstream_next_event(&mut self, federate: FederateId, start: Tag) {
        if !self.is_present(federate) || self.topology.sinks(federate).is_empty() {
            return;
        }
        let tag = downstream_next_event(&self.view(LostRule::Gone, start), federate);
        let announced = self.standings[federate.index()].next_event;
        let member = &mut self.members[federate.index()];
        if announced <= tag && (tag != member.sent_dnet || tag > member.known_dnet) {
            member.sent_dnet = tag;
            member.known_dnet = tag;
            self.send(federate, &ToFederate::DownstreamNextEventTag(tag));
        }
    }
}
