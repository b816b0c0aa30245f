//! Stop consensus: everybody says where it can stop, the largest tag wins.

use ictus_core::{PhysicalTime, Tag};

use super::grant::LostRule;
use super::start::elapsed;
use super::{Phase, Rti, RtiEvent};
use crate::mutants::Mutant;
use crate::topology::FederateId;
use crate::wire::ToFederate;

/// How far the consensus is.
#[derive(Debug)]
pub(super) enum Stop {
    /// Nobody wants to stop.
    None,
    /// Somebody does.
    Requested {
        /// The largest tag named so far.
        tag: Tag,
        /// By federate: whether it has asked or answered.
        answered: Vec<bool>,
        /// Whether the others have been asked.
        forwarded: bool,
        /// When those that have not answered are named.
        deadline: Option<PhysicalTime>,
    },
    /// All stop here.
    Agreed {
        /// The stop tag.
        tag: Tag,
        /// When it was agreed.
        since: PhysicalTime,
    },
}

impl Rti {
    /// Asks all federates to stop as soon as they can, as on a signal. Before the start there is nothing to stop in order:
    /// then it is [`Rti::abort`].
    pub fn request_stop(&mut self, now: PhysicalTime) {
        self.advance_to(now);
        match self.phase {
            Phase::Joining => self.abort_all(),
            Phase::Running { .. } => self.begin_stop(),
            Phase::Ended { .. } => {}
        }
    }

    /// Begins a stop on the RTI's own account: at the start tag, so that each federate answers with the tag it needs.
    pub(super) fn begin_stop(&mut self) {
        if let (Stop::None, Phase::Running { start }) = (&self.stop, self.phase) {
            self.events
                .push_back(RtiEvent::StopRequested { federate: None });
            self.stop = self.requested(start);
        }
    }

    fn requested(&self, tag: Tag) -> Stop {
        let answered = vec![false; self.members.len()];
        Stop::Requested {
            tag,
            answered,
            forwarded: false,
            deadline: None,
        }
    }

    pub(super) fn record_stop_request(&mut self, federate: FederateId, tag: Tag) {
        if let (Stop::None, Phase::Running { start }) = (&self.stop, self.phase) {
            self.events.push_back(RtiEvent::StopRequested {
                federate: Some(federate),
            });
            self.stop = self.requested(start.max(tag));
        }
        self.record_stop_reply(federate, tag);
    }

    pub(super) fn record_stop_reply(&mut self, federate: FederateId, tag: Tag) {
        let smallest = self.config.mutants.has(Mutant::StopMaximumIgnored);
        match &mut self.stop {
            Stop::Requested {
                tag: largest,
                answered,
                ..
            } if !answered[federate.index()] => {
                answered[federate.index()] = true;
                if !smallest {
                    *largest = tag.max(*largest);
                }
            }
            Stop::None | Stop::Requested { .. } | Stop::Agreed { .. } => {}
        }
    }

    /// The present federates that have not said where they can stop.
    pub(super) fn unanswered(&self) -> Vec<FederateId> {
        match &self.stop {
            Stop::Requested { answered, .. } => self
                .federates()
                .filter(|&f| self.is_present(f) && !answered[f.index()])
                .collect(),
            Stop::None | Stop::Agreed { .. } => Vec::new(),
        }
    }

    /// Asks those that have not been asked; agrees when all have answered.
    pub(super) fn advance_stop(&mut self) {
        let asked = self.unanswered();
        let timeout = self.config.stop_reply_timeout;
        let Stop::Requested {
            tag,
            forwarded,
            deadline,
            ..
        } = &mut self.stop
        else {
            return;
        };
        let tag = *tag;
        if asked.is_empty() {
            self.agree(tag);
        } else if !*forwarded {
            *forwarded = true;
            *deadline = Some(self.now + timeout);
            for federate in asked {
                self.send(federate, &ToFederate::StopRequest(tag));
            }
        }
    }

    fn agree(&mut self, tag: Tag) {
        let Phase::Running { start } = self.phase else {
            return;
        };
        self.stop = Stop::Agreed {
            tag,
            since: self.now,
        };
        self.events.push_back(RtiEvent::StopAgreed {
            elapsed: elapsed(start, tag.time),
            microstep: tag.microstep,
        });
        for federate in self
            .federates()
            .filter(|&f| self.is_present(f))
            .collect::<Vec<_>>()
        {
            self.send(federate, &ToFederate::StopGranted(tag));
            let ours = self.members[federate.index()].capabilities.is_some();
            let standing = &mut self.standings[federate.index()];
            standing.next_event = tag.min(standing.next_event);
            if ours {
                // It waits for the stop tag to be granted anew: others run their shutdown there, unannounced.
                standing.granted = standing.granted.min(tag.latest_earlier());
                standing.provisional = standing.provisional.min(tag.latest_earlier());
            }
            self.touched.next_event(federate);
        }
    }

    /// Fails the federates that cannot reach the stop tag: they do not understand FEDERATE_LOST, so a grant past the last
    /// promise of a lost federate would make them run tags from which messages may be missing.
    pub(super) fn fail_unreachable(&mut self) {
        let (Stop::Agreed { tag: stop, .. }, Phase::Running { start }, true) =
            (&self.stop, self.phase, self.lost)
        else {
            return;
        };
        let stop = *stop;
        while let Some((federate, limit)) = self.federates().find_map(|f| {
            let view = self.view(LostRule::Limits, start);
            let stuck = self.is_present(f) && self.lost_rule(f) == LostRule::Limits;
            let limit = view.limit_by_lost(f);
            (stuck && limit < stop && limit < view.next_event(f)).then_some((f, limit))
        }) {
            let limit = elapsed(start, limit.time);
            self.fail(
                federate,
                format!("it cannot stop in order: a lost federate's promise ends {limit} after the start"),
            );
        }
    }
}
