//! Which tag a federate may advance to: pure functions of what the RTI knows.
//!
//! Source: reactor-c `rti_common.c`; section 6.3 of the wire document. Differences: a query changes nothing (there, a
//! federate that never announced a tag has the start tag *stored* as announced), and the strict EIMT leaves out only
//! members of the same zero-delay cycle (there, of any): what another cycle may still send is waited for. When nothing can
//! arrive any more, TAG(FOREVER) goes also to a federate that waits for nothing: there, an idle cycle hangs. What a PTAG
//! demands of the other members of its cycle is sent as soon as it is safe, not only along with that PTAG.

use ictus_core::{Delay, Tag};

use crate::mutants::{Mutant, Mutants};
use crate::topology::{FederateId, Topology};

/// What the RTI may tell a federate about its inputs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Grant {
    /// TAG: every input is known up to and including this tag.
    Full(Tag),
    /// PTAG: every input is known before this tag, and those from outside the zero-delay cycle at it.
    Provisional(Tag),
}

/// Whether a federate takes part in the running federation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Presence {
    /// It is connected.
    Present,
    /// It has left in order: nothing more comes from it.
    Resigned,
    /// It went without a word; its last promise stands.
    Lost,
}

/// What the RTI knows of one federate's progress. All tags are NEVER at first.
#[derive(Clone, Copy, Debug)]
pub struct Standing {
    /// Whether it takes part.
    pub presence: Presence,
    /// Its last LTC.
    pub completed: Tag,
    /// Its last NET, lowered by messages on their way to it; FOREVER once it has resigned.
    pub next_event: Tag,
    /// The last TAG sent to it.
    pub granted: Tag,
    /// The last PTAG sent to it.
    pub provisional: Tag,
    /// Whether it begins a tag before all its inputs are known at it (capability RUNS_AHEAD).
    pub runs_ahead: bool,
}

impl Standing {
    /// A federate that has just been told the start time.
    pub const NEW: Self = Self {
        presence: Presence::Present,
        completed: Tag::NEVER,
        next_event: Tag::NEVER,
        granted: Tag::NEVER,
        provisional: Tag::NEVER,
        runs_ahead: false,
    };

    /// Whether a grant tells the federate anything that earlier ones have not.
    ///
    /// A TAG at the tag of the last PTAG does: it makes the provisional tag a definite one.
    #[must_use]
    pub fn admits(&self, grant: Grant) -> bool {
        self.presence == Presence::Present
            && match grant {
                Grant::Full(tag) => tag > self.granted && tag >= self.provisional,
                Grant::Provisional(tag) => tag > self.granted && tag > self.provisional,
            }
    }
}

/// Whether the promises of lost federates still limit the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LostRule {
    /// They do: what the lost one could have sent would be missing.
    Limits,
    /// They do not: the stop tag is agreed, and the receiver runs nothing but its shutdown past the promise.
    Gone,
}

/// Everything a grant depends on.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// Who is connected to whom.
    pub topology: &'a Topology,
    /// The federation's first tag.
    pub start: Tag,
    /// By federate id.
    pub standings: &'a [Standing],
    /// How lost federates count.
    pub lost: LostRule,
    /// Rules that are wrong; none but in tests.
    pub mutants: Mutants,
}

impl View<'_> {
    /// Returns the earliest tag with which `federate` may still send, as far as it has said: its NET, the start tag
    /// when it never sent one, FOREVER when it is gone.
    #[must_use]
    pub fn next_event(&self, federate: FederateId) -> Tag {
        let standing = &self.standings[federate.index()];
        if standing.presence == Presence::Lost && self.lost == LostRule::Gone {
            Tag::FOREVER
        } else if standing.next_event == Tag::NEVER {
            self.start
        } else {
            standing.next_event
        }
    }

    /// Returns the earliest tag at which a message may still reach `federate` (EIMT).
    ///
    /// FOREVER when nothing is upstream. Law `earliest_incoming_is_the_least_over_all_paths`. O(transitive upstreams).
    #[must_use]
    pub fn earliest_incoming(&self, federate: FederateId) -> Tag {
        self.topology
            .sources(federate)
            .iter()
            .map(|&(source, path)| self.next_event(source).plus_path(path))
            .min()
            .unwrap_or(Tag::FOREVER)
    }

    /// Returns the earliest tag at which a message may still reach `federate` from outside its zero-delay cycle.
    ///
    /// FOREVER when nothing else is upstream. O(immediate upstreams x their transitive upstreams).
    #[must_use]
    pub fn earliest_incoming_strict(&self, federate: FederateId) -> Tag {
        if self.mutants.has(Mutant::StrictEimtDropped) {
            return Tag::FOREVER;
        }
        self.topology
            .upstream(federate)
            .iter()
            .filter(|&&(upstream, _)| !self.topology.share_zero_delay_cycle(upstream, federate))
            .map(|&(upstream, delay)| {
                self.earliest_incoming(upstream)
                    .min(self.next_event(upstream))
                    .delayed(delay)
            })
            .min()
            .unwrap_or(Tag::FOREVER)
    }

    /// Returns the tag up to which the LTCs of its immediate upstreams settle the inputs of `federate`.
    ///
    /// FOREVER when none is left. This alone serves sources that announce progress only by LTC.
    #[must_use]
    pub fn settled_by_confirmations(&self, federate: FederateId) -> Tag {
        self.topology
            .upstream(federate)
            .iter()
            .filter_map(|&(upstream, delay)| {
                let standing = &self.standings[upstream.index()];
                let counts = match standing.presence {
                    Presence::Present => true,
                    Presence::Resigned => false,
                    Presence::Lost => self.lost == LostRule::Limits,
                };
                counts.then(|| self.settled_over(standing.completed, delay))
            })
            .min()
            .unwrap_or(Tag::FOREVER)
    }

    fn settled_over(&self, completed: Tag, delay: Delay) -> Tag {
        if self.mutants.has(Mutant::LtcDelayNotStrict) {
            completed.delayed(delay)
        } else {
            completed.delayed_strict(delay)
        }
    }

    /// Returns the last tag at which nothing of the lost federates can be missing at `federate`.
    ///
    /// FOREVER when no lost federate has a path to it.
    #[must_use]
    pub fn limit_by_lost(&self, federate: FederateId) -> Tag {
        self.topology
            .sources(federate)
            .iter()
            .filter(|(source, _)| self.standings[source.index()].presence == Presence::Lost)
            .map(|&(source, path)| promise_over(self.standings[source.index()].next_event, path))
            .min()
            .unwrap_or(Tag::FOREVER)
    }

    /// Returns the tag before which `federate` will never again have anything to do.
    ///
    /// FOREVER when it is gone. It never falls while federates keep their promises.
    #[must_use]
    pub fn earliest_activity(&self, federate: FederateId) -> Tag {
        match self.standings[federate.index()].presence {
            Presence::Present => self
                .next_event(federate)
                .min(self.earliest_incoming(federate)),
            Presence::Resigned | Presence::Lost => Tag::FOREVER,
        }
    }
}

/// Returns the last tag that is settled at the end of `path` when `next_event` is the first that may still be sent.
#[must_use]
pub fn promise_over(next_event: Tag, path: Tag) -> Tag {
    next_event.plus_path(path).latest_earlier()
}

/// Decides what `federate` may be told now: the largest safe TAG, else a PTAG if only that is possible.
///
/// `None` when there is nothing to tell, and for federates without upstreams, which need no grant.
/// Laws: `grants_are_safe`, `raising_a_promise_never_lowers_a_grant`.
#[must_use]
pub fn tag_advance_grant(view: &View<'_>, federate: FederateId) -> Option<Grant> {
    if view.topology.upstream(federate).is_empty() {
        return None;
    }
    let standing = &view.standings[federate.index()];
    full_grant(view, federate)
        .map(Grant::Full)
        .filter(|&grant| standing.admits(grant))
        .or_else(|| provisional_grant(view, federate).filter(|&grant| standing.admits(grant)))
        .or_else(|| demanded_grant(view, federate))
        .or_else(|| grant_ahead(view, federate).filter(|&grant| standing.admits(grant)))
}

/// What the PTAGs under way demand of `federate` and was not possible when they were sent.
fn demanded_grant(view: &View<'_>, federate: FederateId) -> Option<Grant> {
    let downstream = view.topology.downstream(federate);
    downstream.iter().find_map(|&(member, _)| {
        let standing = &view.standings[member.index()];
        let tag = standing.provisional;
        let under_way = tag > standing.granted && tag > standing.completed;
        let demanded = under_way && view.topology.share_zero_delay_cycle(member, federate);
        demanded
            .then(|| fan_out_grant(view, federate, tag))
            .flatten()
    })
}

/// The tag before a federate's NET, when messages may still come at the NET itself: what has its inputs can run then.
///
/// An extension; LF's RTI leaves such a federate without a grant until all that is upstream has passed the tag.
fn grant_ahead(view: &View<'_>, federate: FederateId) -> Option<Grant> {
    let standing = &view.standings[federate.index()];
    let next = standing.next_event;
    let due = standing.runs_ahead && next > Tag::NEVER && view.earliest_incoming(federate) == next;
    due.then(|| Grant::Full(before(view, next)))
}

/// The larger of what LTCs and what NETs allow, provided that it reaches the federate's own NET.
fn full_grant(view: &View<'_>, federate: FederateId) -> Option<Tag> {
    let next = view.standings[federate.index()].next_event;
    let settled = view.settled_by_confirmations(federate);
    let by_confirmation =
        (settled >= next && !view.mutants.has(Mutant::LtcRuleDropped)).then_some(settled);
    let earliest = view.earliest_incoming(federate);
    let not_strict = view.mutants.has(Mutant::EimtNotStrict) && earliest == next;
    let by_announcement = if next > Tag::NEVER && not_strict {
        Some(next)
    } else if next > Tag::NEVER && (earliest > next || earliest == Tag::FOREVER) {
        Some(before(view, earliest))
    } else {
        None
    };
    by_confirmation.max(by_announcement)
}

fn before(view: &View<'_>, earliest: Tag) -> Tag {
    if view.mutants.has(Mutant::GrantOneTooFar) {
        earliest
    } else {
        earliest.latest_earlier()
    }
}

fn provisional_grant(view: &View<'_>, federate: FederateId) -> Option<Grant> {
    let next = view.standings[federate.index()].next_event;
    let due = next > Tag::NEVER
        && view.topology.in_zero_delay_cycle(federate)
        && view.earliest_incoming(federate) == next
        && view.earliest_incoming_strict(federate) > next;
    due.then(|| provisional(view, next))
}

/// Decides what `upstream` must be told when one of its downstreams gets PTAG(`tag`), so that every member of the
/// zero-delay cycle executes `tag` and reports its absent outputs.
#[must_use]
pub fn fan_out_grant(view: &View<'_>, upstream: FederateId, tag: Tag) -> Option<Grant> {
    let needs_none = view.topology.upstream(upstream).is_empty();
    if needs_none || view.mutants.has(Mutant::ProvisionalFanOutDropped) {
        return None;
    }
    let earliest = view.earliest_incoming(upstream);
    let grant = if earliest > tag {
        Grant::Full(tag)
    } else if earliest == tag && view.earliest_incoming_strict(upstream) > tag {
        provisional(view, tag)
    } else {
        return None;
    };
    view.standings[upstream.index()]
        .admits(grant)
        .then_some(grant)
}

fn provisional(view: &View<'_>, tag: Tag) -> Grant {
    if view.mutants.has(Mutant::FullInsteadOfProvisional) {
        Grant::Full(tag)
    } else {
        Grant::Provisional(tag)
    }
}

#[cfg(test)]
mod tests;
