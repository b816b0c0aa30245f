//! Leaving, being lost, and deadlines: nobody is ever left hanging.

use ictus_core::{Duration, PhysicalTime, Tag};

use super::grant::{LostRule, Presence, promise_over};
use super::stop::Stop;
use super::{Closing, ConnectionId, Link, Phase, Rti, RtiEvent, Stage};
use crate::clock::Prober;
use crate::mutants::Mutant;
use crate::report::exit;
use crate::topology::FederateId;
use crate::wire::{ToFederate, capability};

impl Rti {
    /// Tells all federates that the federation has failed, and ends.
    pub fn abort(&mut self, now: PhysicalTime) {
        self.advance_to(now);
        self.abort_all();
    }

    /// Acts on the deadlines that have passed; [`Rti::drain`] comes next.
    pub fn handle_timeout(&mut self, now: PhysicalTime) {
        self.advance_to(now);
        if let Some(prober) = &mut self.prober {
            prober.handle_timeout(now);
        }
        for index in 0..self.connections.len() {
            self.check_connection(ConnectionId(index));
        }
        if self
            .stop_deadline()
            .is_some_and(|deadline| deadline <= self.now)
        {
            self.name_unanswered();
        }
        if self
            .grace_deadline()
            .is_some_and(|deadline| deadline <= self.now)
        {
            for federate in self.federates() {
                if self.is_present(federate) {
                    let reason = "it did not end in time after another federate was lost";
                    self.events.push_back(RtiEvent::Lost {
                        federate,
                        reason: reason.to_owned(),
                    });
                }
            }
            self.abort_all();
        }
    }

    /// When [`Rti::handle_timeout`] is due. Connections that do nothing are looked at: O(connections).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<PhysicalTime> {
        self.connections
            .iter()
            .filter_map(|connection| match connection.link {
                Link::Unknown { deadline, .. } => Some(deadline),
                Link::Closing { deadline, .. } if connection.output.closing() != Closing::Now => {
                    Some(deadline)
                }
                Link::Member(federate) => self.joining_deadline(federate),
                Link::Closing { .. } | Link::Free => None,
            })
            .chain(self.stop_deadline())
            .chain(self.grace_deadline())
            .chain(self.prober.as_ref().and_then(Prober::poll_timeout))
            .min()
    }

    /// The connection to close when there is no room for another: the oldest that has not said who it is, else the oldest
    /// that was refused and has not gone. O(connections).
    #[must_use]
    pub fn least_needed(&self) -> Option<ConnectionId> {
        let rank = |link: Link| match link {
            Link::Unknown { deadline, .. } => Some((false, deadline)),
            Link::Closing {
                deadline,
                stranger: true,
            } => Some((true, deadline)),
            Link::Closing { .. } | Link::Member(_) | Link::Free => None,
        };
        self.connections
            .iter()
            .enumerate()
            .filter_map(|(index, connection)| Some((rank(connection.link)?, ConnectionId(index))))
            .min()
            .map(|(_, id)| id)
    }

    fn check_connection(&mut self, id: ConnectionId) {
        let connection = &self.connections[id.0];
        match connection.link {
            Link::Unknown { deadline, .. } if deadline <= self.now => {
                let peer = connection.peer.clone();
                let reason = format!("it said nothing for {}", self.config.handshake_timeout);
                self.events.push_back(RtiEvent::Rejected { peer, reason });
                self.close(id, Closing::Now);
            }
            Link::Closing { deadline, .. } if deadline <= self.now => {
                self.connections[id.0].output.close(Closing::Now);
                self.queue_output(id);
            }
            Link::Member(federate) => self.check_joining(federate),
            Link::Unknown { .. } | Link::Closing { .. } | Link::Free => {}
        }
    }

    fn check_joining(&mut self, federate: FederateId) {
        let late = self.joining_deadline(federate);
        if late.is_none_or(|deadline| deadline > self.now) {
            return;
        }
        let silent = self.joining_patience(federate).unwrap_or_default();
        self.fail(
            federate,
            format!("it said nothing for {silent} while joining"),
        );
    }

    /// When a federate that is joining must have said its next word.
    fn joining_deadline(&self, federate: FederateId) -> Option<PhysicalTime> {
        let patience = self.joining_patience(federate)?;
        Some(self.members[federate.index()].last_word + patience)
    }

    /// How long a federate may be silent as far as its join is. One that has proposed a start time waits for others, not
    /// they for it.
    fn joining_patience(&self, federate: FederateId) -> Option<Duration> {
        match self.members[federate.index()].stage {
            Stage::Identified | Stage::Structured | Stage::Exchanging { .. } => {
                Some(self.config.handshake_timeout)
            }
            Stage::Synchronized { .. } => Some(self.config.setup_timeout),
            Stage::Absent | Stage::Proposed { .. } | Stage::Running | Stage::Gone => None,
        }
    }

    fn stop_deadline(&self) -> Option<PhysicalTime> {
        match self.stop {
            Stop::Requested { deadline, .. } => deadline,
            Stop::None | Stop::Agreed { .. } => None,
        }
    }

    /// After a loss: when silence, or any delay, past the agreed stop has lasted too long.
    fn grace_deadline(&self) -> Option<PhysicalTime> {
        match (&self.stop, self.phase) {
            (Stop::Agreed { since, .. }, Phase::Running { .. }) if self.lost => {
                let limit = *since + self.config.stop_limit;
                if self.ungranted {
                    // Nobody says anything between the agreement and its end, on time or not.
                    return Some(limit);
                }
                let silent = self.last_word.max(*since) + self.config.stop_grace;
                Some(silent.min(limit))
            }
            _ => None,
        }
    }

    fn name_unanswered(&mut self) {
        let federates = self.unanswered();
        if let Stop::Requested { deadline, .. } = &mut self.stop {
            *deadline = None;
        }
        if self.lost {
            for &federate in &federates {
                self.fail(federate, "it did not answer the stop request".to_owned());
            }
        }
        self.events
            .push_back(RtiEvent::StopUnanswered { federates });
    }

    /// RESIGN: nothing more comes from the federate; its connection is drained and closed.
    pub(super) fn resign(&mut self, federate: FederateId) {
        self.events.push_back(RtiEvent::Resigned { federate });
        self.detach(federate, Presence::Resigned);
        if !self.config.mutants.has(Mutant::ResignedKeepsNext) {
            self.standings[federate.index()].next_event = Tag::FOREVER;
        }
        self.touched.next_event(federate);
        self.touched.completed(federate);
    }

    /// FAILED from a federate: it goes by itself.
    pub(super) fn lose_in_order(&mut self, federate: FederateId) {
        self.close_member(federate, Closing::AfterFlush);
        self.lose(federate, "it reported a failure".to_owned());
    }

    /// Tells a federate that it has failed, and counts it as lost.
    pub(super) fn fail(&mut self, federate: FederateId, reason: String) {
        self.send(federate, &ToFederate::Failed);
        self.close_member(federate, Closing::AfterFlush);
        self.lose(federate, reason);
    }

    /// A federate is gone without resigning; its connection has been dealt with.
    ///
    /// What it promised last stands, as far as nothing could come from upstream. Others stop as soon as they can.
    pub(super) fn lose(&mut self, federate: FederateId, reason: String) {
        if self.members[federate.index()].stage == Stage::Gone {
            return;
        }
        self.events.push_back(RtiEvent::Lost { federate, reason });
        self.failed = true;
        let Phase::Running { start } = self.phase else {
            self.members[federate.index()].stage = Stage::Gone;
            self.abort_all();
            return;
        };
        if self.config.continue_without.contains(&federate.get()) {
            self.go_on_without(federate);
            return;
        }
        self.lost = true;
        // What was still to reach it would have made it send, whatever it had announced.
        let view = self.view(LostRule::Limits, start);
        let next_event = view
            .next_event(federate)
            .min(view.earliest_incoming(federate));
        let standing = &mut self.standings[federate.index()];
        let confirmed = standing.completed.next_microstep().unwrap_or(Tag::NEVER);
        standing.next_event = next_event.max(confirmed);
        self.detach(federate, Presence::Lost);
        self.cut_off(federate);
        self.tell_lost(federate);
        self.begin_stop();
        self.renew_stop_deadline();
    }

    /// The others take its silence for absence, as if it had resigned.
    fn go_on_without(&mut self, federate: FederateId) {
        self.detach(federate, Presence::Resigned);
        self.standings[federate.index()].next_event = Tag::FOREVER;
        self.cut_off(federate);
    }

    /// Nothing passes through a lost federate any more: a cycle over it would wait for itself.
    fn cut_off(&mut self, federate: FederateId) {
        self.members[federate.index()].neighbors.upstream.clear();
        self.topology = self.told_topology();
        self.touched.next_event(federate);
        self.touched.completed(federate);
    }

    fn tell_lost(&mut self, lost: FederateId) {
        let next_event = self.standings[lost.index()].next_event;
        for federate in self.federates() {
            if self.is_present(federate) && self.has_capability(federate, capability::FEDERATE_LOST)
            {
                let path = self.topology.path(lost, federate);
                let promise = if self.has_capability(federate, capability::DECENTRALIZED) {
                    Tag::NEVER
                } else {
                    path.map_or(Tag::FOREVER, |path| promise_over(next_event, path))
                };
                self.send(
                    federate,
                    &ToFederate::FederateLost {
                        federate: lost.get(),
                        promise,
                    },
                );
            }
        }
    }

    /// From now on those that do not answer are failed: they get the whole time for it.
    fn renew_stop_deadline(&mut self) {
        let renewed = self.now + self.config.stop_reply_timeout;
        if let Stop::Requested {
            deadline,
            forwarded: true,
            ..
        } = &mut self.stop
        {
            *deadline = Some(renewed);
        }
    }

    fn detach(&mut self, federate: FederateId, presence: Presence) {
        if let Some(prober) = &mut self.prober {
            prober.end(federate);
        }
        self.close_member(federate, Closing::AfterFlush);
        self.standings[federate.index()].presence = presence;
        let member = &mut self.members[federate.index()];
        member.stage = Stage::Gone;
        member.in_transit.clear();
    }

    fn close_member(&mut self, federate: FederateId, closing: Closing) {
        if let Some(id) = self.members[federate.index()].connection.take() {
            self.close(id, closing);
        }
    }

    /// A queue that has grown past its limit ends the federation: dropping what is in it would be a wrong answer.
    pub(super) fn check_outputs(&mut self) {
        let limit = self.config.max_output;
        let full = self.federates().find(|f| {
            self.members[f.index()]
                .connection
                .is_some_and(|id| self.connections[id.0].output.pending() > limit)
        });
        if let Some(federate) = full {
            let reason =
                format!("more than {limit} bytes wait in its output queue: it reads too slowly");
            self.events.push_back(RtiEvent::Lost { federate, reason });
            self.close_member(federate, Closing::Now);
            self.abort_all();
        }
    }

    /// FAILED to everybody that is there; the federation is over.
    pub(super) fn abort_all(&mut self) {
        if matches!(self.phase, Phase::Ended { .. }) {
            return;
        }
        self.failed = true;
        for federate in self.federates() {
            self.send(federate, &ToFederate::Failed);
            if self.members[federate.index()].stage != Stage::Gone {
                self.detach(federate, Presence::Lost);
            }
        }
    }

    /// The federation ends with its last federate.
    pub(super) fn end_if_alone(&mut self) {
        let ended = matches!(self.phase, Phase::Ended { .. });
        if ended
            || self
                .members
                .iter()
                .any(|member| member.stage != Stage::Gone)
        {
            return;
        }
        let code = if self.failed { exit::FAILED } else { exit::OK };
        self.phase = Phase::Ended { code };
        self.events.push_back(RtiEvent::Ended { code });
        for index in 0..self.connections.len() {
            let link = self.connections[index].link;
            if matches!(
                link,
                Link::Unknown { .. } | Link::Closing { stranger: true, .. }
            ) {
                self.close(ConnectionId(index), Closing::Now);
            }
        }
    }
}
