//! Stopping: consensus on a stop tag, the loss of a peer, the loss of the RTI.

use super::join::Phase;
use super::{Federate, FederateEvent, Outcome, Poll};
use crate::mutants::Mutant;
use crate::wire::ToRti;
use ictus_core::{InputId, PhysicalTime, Tag, Timeline};
use std::collections::BTreeSet;

/// What a stop in progress allows.
#[derive(Debug, Default)]
pub(super) struct Stop {
    consensus: Consensus,
    /// The last tag at which a lost federate's silence is no false absence.
    limit: Option<Tag>,
    lost: Option<u16>,
    all_lost: BTreeSet<u16>,
    violated: bool,
    abandoned: Option<Outcome>,
}

#[derive(Debug, Default, PartialEq)]
enum Consensus {
    #[default]
    None,
    /// We asked, or answered, with this tag: it and later ones are barred.
    Barred(Tag),
    Granted,
}

impl Stop {
    /// Whether a tag may be entered, or must wait for the stop tag.
    #[inline]
    pub(super) fn allows(&self, next: Tag) -> bool {
        if self.abandoned.is_some() {
            return true;
        }
        match self.consensus {
            Consensus::None => self.limit.is_none_or(|limit| next <= limit),
            Consensus::Barred(bar) => next < bar && self.limit.is_none_or(|limit| next <= limit),
            Consensus::Granted => true,
        }
    }

    /// Whether nothing but shutdown may run any more.
    #[inline]
    pub(super) fn only_shutdown(&self, next: Tag) -> bool {
        self.abandoned.is_some() || (self.consensus == Consensus::Granted && self.past_limit(next))
    }

    /// The first tag at which only shutdown may run, unless no grant will come any more.
    pub(super) fn gate(&self) -> Option<Tag> {
        if self.abandoned.is_some() {
            return None;
        }
        self.limit.map(Tag::successor)
    }

    /// The last tag at which a lost federate's silence is no false absence; FOREVER when none is lost.
    pub(super) fn limit(&self) -> Tag {
        self.limit.unwrap_or(Tag::FOREVER)
    }

    fn past_limit(&self, tag: Tag) -> bool {
        self.limit.is_some_and(|limit| tag > limit)
    }

    /// Whether reactions that wait for inputs at `at` wait in vain: what they wait for is lost.
    pub(super) fn gives_up(&self, at: Tag) -> bool {
        self.abandoned.is_some() || (self.consensus == Consensus::Granted && self.past_limit(at))
    }

    /// Whether the RTI has said that `federate` is lost.
    pub(super) fn has_lost(&self, federate: u16) -> bool {
        self.all_lost.contains(&federate)
    }

    /// The stop that is asked for next is because of STP violations.
    pub(super) fn too_many_violations(&mut self) {
        self.violated = true;
    }

    /// Whether messages have come too late to matter: nothing but shutdown runs, or has run, at `at`.
    pub(super) fn over(&self, at: Tag) -> bool {
        self.only_shutdown(at)
    }
}

impl Federate {
    fn has_mutant(&self, mutant: Mutant) -> bool {
        self.link
            .as_ref()
            .is_some_and(|link| link.config.mutants.has(mutant))
    }

    /// Asks for an ordered stop from outside (a signal): at the clock's time, or as soon as all can.
    pub fn request_stop(&mut self, now: PhysicalTime) {
        if !matches!(self.phase, Phase::Running) {
            return;
        }
        let floor = after(&self.timeline);
        let wanted = Tag::new(now.as_logical(), 0);
        self.ask_for_stop(if self.config.fast {
            floor
        } else {
            floor.max(wanted)
        });
    }

    /// Asks for a stop on behalf of a reaction: one microstep after the current tag.
    pub(super) fn request_stop_at_current(&mut self) {
        self.ask_for_stop(after(&self.timeline));
    }

    fn ask_for_stop(&mut self, tag: Tag) {
        if self.stop.consensus != Consensus::None {
            return;
        }
        self.events.push_back(FederateEvent::StopRequested);
        if let Some(link) = &mut self.link {
            self.stop.consensus = Consensus::Barred(tag);
            link.say(&ToRti::StopRequest(tag));
        } else {
            self.stop.consensus = Consensus::Granted;
            self.timeline.stop_at(tag);
            self.events
                .push_back(FederateEvent::StopGranted(self.timeline.stop_tag()));
        }
    }

    /// Answers STOP_REQUEST with the earliest tag at which this federate can stop, unless it asked itself.
    pub(super) fn answer_stop_request(&mut self, tag: Tag) {
        if self.stop.consensus != Consensus::None {
            return;
        }
        let tag = if self.has_mutant(Mutant::StopReplyTooEarly) {
            tag
        } else {
            tag.max(after(&self.timeline))
        };
        self.stop.consensus = Consensus::Barred(tag);
        self.events.push_back(FederateEvent::StopRequested);
        if let Some(link) = &mut self.link {
            link.say(&ToRti::StopRequestReply(tag));
        }
    }

    /// Takes STOP_GRANTED. At the stop tag others run their shutdown, which they had not announced when it was granted:
    /// it must be granted anew.
    pub(super) fn take_stop_tag(&mut self, tag: Tag) {
        let earlier = tag < self.timeline.stop_tag();
        self.timeline.stop_at(tag);
        let stop = self.timeline.stop_tag();
        if let Some(link) = self.link.as_mut().filter(|_| earlier) {
            link.revoke_from(stop, &mut self.timeline);
        }
        self.stop.consensus = Consensus::Granted;
        self.events.push_back(FederateEvent::StopGranted(stop));
    }

    /// Takes FEDERATE_LOST: after `limit`, an absence could be a lie.
    pub(super) fn peer_lost(&mut self, federate: u16, limit: Tag) {
        self.unexplained = self.unexplained.filter(|(peer, _)| *peer != federate);
        self.stop.all_lost.insert(federate);
        let limit = if self.has_mutant(Mutant::PromiseIgnored) {
            Tag::FOREVER
        } else if self.is_decentralized() {
            self.last_safe(federate)
        } else {
            limit
        };
        self.stop.limit = Some(self.stop.limit.map_or(limit, |earlier| earlier.min(limit)));
        // What it sent to this federate itself may still be on its way: time decides.
        if let Some(link) = self.link.as_mut().filter(|link| !link.config.decentralized) {
            link.settle_lost(federate, limit, &mut self.timeline);
        }
        if self.stop.lost.is_none() {
            self.stop.lost = Some(federate);
            self.events.push_back(FederateEvent::PeerLost(federate));
        }
    }

    /// Under decentralized coordination: the last tag at which the silence of lost `federate` is no false absence. What has come
    /// from it over other federates cannot be told apart, so then it is the tag reached.
    fn last_safe(&self, federate: u16) -> Tag {
        let at = self.timeline.at();
        let Some(link) = &self.link else { return at };
        if link.config.indirect_upstream.contains(&federate) {
            return at;
        }
        let inputs = link.config.inputs.iter().enumerate();
        let of_it = inputs.filter(|(_, input)| input.federate == federate && !input.physical);
        let known = of_it.map(|(index, _)| self.timeline.known(InputId::new(index)));
        known.min().map_or(Tag::FOREVER, |known| known.max(at))
    }

    /// No grant will come any more: the current tag is finished as far as its inputs are known, then shutdown.
    pub(super) fn abandon(&mut self, outcome: Outcome) {
        if self.stop.abandoned.is_none() {
            self.stop.abandoned = Some(outcome);
            let next = after(&self.timeline);
            self.timeline.stop_at(next);
        }
    }

    /// The stop tag is completed: the last words, and the outcome.
    pub(super) fn leave(&mut self) -> Poll {
        let abandoned = self.stop.abandoned.take();
        let lost = self.stop.lost;
        let stays = abandoned.is_none();
        let reached = match lost {
            Some(lost) => Outcome::PeerLost(lost),
            None if self.stop.violated => {
                Outcome::TooManyViolations(self.measures.stp_violations())
            }
            None => Outcome::Stopped,
        };
        self.outcome = Some(abandoned.unwrap_or(reached));
        match &mut self.link {
            Some(link) if stays => {
                link.resign();
                let since = self.now;
                self.phase = Phase::Draining {
                    rti_closed: false,
                    since,
                };
                Poll::Wait(Some(since.saturating_add(super::LAST_WORDS_MAX)))
            }
            Some(_) | None => {
                self.phase = Phase::Ended;
                Poll::Ended
            }
        }
    }

    /// Whether nothing but shutdown can run any more, or has run: messages are of no use.
    #[must_use]
    pub fn only_shutdown_left(&self) -> bool {
        self.stop.over(self.timeline.at())
    }

    /// Whether everything is said: the driver half-closes and reads to the end.
    #[must_use]
    pub fn resigned(&self) -> bool {
        matches!(self.phase, Phase::Draining { .. })
    }
}

fn after(timeline: &Timeline) -> Tag {
    timeline.at().successor()
}
