//! What status lines mean for the federation.

use ictus_coord::report::{FederateStatus, RtiStatus};

use super::{
    Agent, FIRST_TAG_MAX, Member, MemberId, Now, Phase, REJECTED_MAX, REMARKS_MAX, RTI, Why,
};
use crate::api::Event;

impl Agent {
    pub(super) fn handle_status(&mut self, now: Now, id: MemberId, line: &serde_json::Value) {
        // A line of another version, or a foreign program's, tells nothing.
        match id {
            MemberId::Rti => {
                if let Ok(status) = serde_json::from_value(line.clone()) {
                    self.handle_rti_status(now, status);
                }
            }
            MemberId::Federate(index) => {
                if let Ok(status) = serde_json::from_value(line.clone()) {
                    self.measure(index, &status);
                    self.handle_federate_status(now, usize::from(index), status);
                }
            }
        }
    }

    pub(super) fn handle_rti_status(&mut self, now: Now, status: RtiStatus) {
        match status {
            RtiStatus::Listening { port } => self.handle_listening(port),
            RtiStatus::Joined { federate } => {
                if let Some(member) = self.federates.get_mut(usize::from(federate)) {
                    member.joined = true;
                }
                let joined = self.federates.iter().filter(|member| member.joined).count();
                let of = self.federates.len();
                self.expect_first_tag(now);
                self.tell(Event::Joined {
                    federate: self.name(federate),
                    joined,
                    of,
                });
            }
            RtiStatus::Start { start_ns } => {
                self.start_ns = Some(start_ns);
                self.tell(Event::StartTag { start_ns });
            }
            RtiStatus::StopRequested { federate } => {
                let by = federate.map_or_else(|| RTI.to_owned(), |id| self.name(id));
                self.tell(Event::StopRequested { by });
                if matches!(self.phase, Phase::Running) {
                    self.expect_stop(now, Why::Program);
                }
            }
            RtiStatus::Stop {
                elapsed_ns,
                microstep,
            } => {
                self.wait_for_stop_tag(now, elapsed_ns);
                self.tell(Event::StopTag {
                    elapsed_ns,
                    microstep,
                });
            }
            RtiStatus::Resigned { federate } => {
                self.tell(Event::Resigned {
                    federate: self.name(federate),
                });
            }
            RtiStatus::Failed { federate, reason } => {
                self.lost_one = true;
                self.tell(Event::Lost {
                    federate: self.name(federate),
                    reason: reason.clone(),
                });
                let lost = self.federates.get(usize::from(federate));
                if lost.is_some_and(|member| member.signalled.is_none()) {
                    // The exit record says more, and ranks before this.
                    let what = format!("was lost: {reason}");
                    let failure = self.failure(now, MemberId::Federate(federate), what);
                    self.fail(now, 1, failure);
                }
            }
            RtiStatus::Rejected { peer, reason } => {
                self.rejected += 1;
                if self.rejected <= REJECTED_MAX {
                    self.tell(Event::Rejected { peer, reason });
                }
            }
            RtiStatus::Ended { .. } => {}
        }
    }

    /// Once everybody of whom this host knows has joined, the first tag is not far.
    fn expect_first_tag(&mut self, now: Now) {
        let awaited = |member: &&Member| self.rti.here || (member.here && member.ours);
        let all_joined = self.federates.iter().filter(awaited).all(|it| it.joined);
        if let Phase::Starting { until } = &mut self.phase
            && all_joined
        {
            *until = now.since + FIRST_TAG_MAX;
        }
    }

    pub(super) fn handle_listening(&mut self, port: u16) {
        self.rti_port = Some(port);
        self.tell(Event::Listening { port });
        if matches!(self.phase, Phase::Starting { .. }) {
            for id in self.ids() {
                self.launch(id);
            }
        }
    }

    /// Takes what a line says of a federate's measures; lines of another shape say nothing.
    pub(super) fn measure(&mut self, index: u16, status: &FederateStatus) {
        let index = usize::from(index);
        let Some(member) = self.federates.get_mut(index) else {
            return;
        };
        let mut measures = std::mem::take(&mut member.measures);
        let name = |id: u16| {
            let member = self.federates.get(usize::from(id));
            member.map(|member| member.name.as_str())
        };
        measures.take(status.clone(), name);
        if let Some(member) = self.federates.get_mut(index) {
            member.measures = measures;
        }
    }

    /// Tells what a federate says of itself, but not without end.
    fn remark(&mut self, index: usize, event: impl FnOnce(&Self, String) -> Event) {
        let Some(member) = self.federates.get_mut(index) else {
            return;
        };
        member.remarks += 1;
        if member.remarks <= REMARKS_MAX {
            let name = member.name.clone();
            let event = event(self, name);
            self.tell(event);
        }
    }

    pub(super) fn handle_federate_status(
        &mut self,
        now: Now,
        index: usize,
        status: FederateStatus,
    ) {
        let Some(member) = self.federates.get_mut(index) else {
            return;
        };
        match status {
            // An RTI on this host says these, for foreign federates as well.
            FederateStatus::Joined { .. } | FederateStatus::Start { .. } if self.rti.here => {}
            FederateStatus::Joined { .. } => {
                member.joined = true;
                self.expect_first_tag(now);
            }
            FederateStatus::Start { start_ns, .. } => self.start_ns = Some(start_ns),
            // Measured, not told.
            FederateStatus::Measures { .. }
            | FederateStatus::Upstream { .. }
            | FederateStatus::Downstream { .. }
            | FederateStatus::Clock { .. } => {}
            FederateStatus::StpViolation {
                upstream,
                lateness_ns,
                count,
                ..
            } => self.remark(index, |agent, federate| Event::StpViolation {
                federate,
                upstream: agent.name(upstream),
                lateness_ns,
                count,
            }),
            FederateStatus::FallingBehind { lag_ns, .. } => {
                self.remark(index, |_, federate| Event::FallingBehind {
                    federate,
                    lag_ns,
                });
            }
            FederateStatus::CaughtUp { lag_ns, .. } => {
                self.remark(index, |_, federate| Event::CaughtUp { federate, lag_ns });
            }
            FederateStatus::ClockStep { by_ns, .. } => {
                self.remark(index, |_, federate| Event::ClockStep { federate, by_ns });
            }
            FederateStatus::Running { .. } => {
                member.running = true;
                let federate = member.name.clone();
                let ours = || self.federates.iter().filter(|it| it.here && it.ours);
                let running = ours().filter(|member| member.running).count();
                let of = ours().count();
                self.tell(Event::Running {
                    federate,
                    running,
                    of,
                });
            }
            FederateStatus::Progress {
                elapsed_ns,
                tags,
                reactions,
                deadlines_missed,
                ..
            } => {
                member.view.elapsed_ns = Some(elapsed_ns);
                member.view.tags = Some(tags);
                member.view.reactions = Some(reactions);
                member.view.deadlines_missed = Some(deadlines_missed);
            }
            FederateStatus::Ended {
                elapsed_ns, reason, ..
            } => {
                member.view.elapsed_ns = Some(elapsed_ns);
                member.reason = Some(reason);
            }
        }
    }
}
