//! The ladder of a stop: consensus, SIGTERM, SIGKILL, giving up. Every rung has a bound.

use std::time::Duration;

use super::{Action, Agent, KILL_GRACE, MemberId, Now, Phase, Process, RTI, Step, Why};
use crate::api::Event;
use crate::supervisor::protocol::StopSignal;

impl Agent {
    /// Asks the RTI for stop consensus; when it runs on another host, somebody asks it there.
    pub(super) fn begin_stop(&mut self, now: Now, why: Why) {
        self.expect_stop(now, why);
        self.signal(MemberId::Rti, StopSignal::Term);
    }

    /// The RTI or the federates are ending by themselves; bounds how long.
    pub(super) fn expect_stop(&mut self, now: Now, why: Why) {
        let until = now.since + self.settings.stop_grace;
        self.phase = Phase::Stopping {
            why,
            step: Step::Consensus,
            until,
            missed: Vec::new(),
        };
    }

    /// The stop tag may lie in the future of physical time: the grace counts from it.
    pub(super) fn wait_for_stop_tag(&mut self, now: Now, elapsed_ns: i64) {
        let grace = self.settings.stop_grace;
        let stop_ns = self
            .start_ns
            .and_then(|start| start.checked_add(elapsed_ns));
        let ahead_ns = stop_ns.map_or(0, |stop| stop.saturating_sub(now.wall_ns));
        let ahead = Duration::from_nanos(u64::try_from(ahead_ns).unwrap_or(0));
        if let Phase::Stopping {
            step: Step::Consensus,
            until,
            ..
        } = &mut self.phase
        {
            *until = now.since.saturating_add(ahead).saturating_add(grace);
        }
    }

    /// Ends everything without consensus: nothing has run yet that could be finished.
    pub(super) fn undo(&mut self, now: Now, why: Why) {
        let until = now.since + KILL_GRACE;
        self.phase = Phase::Stopping {
            why,
            step: Step::Terminated,
            until,
            missed: Vec::new(),
        };
        for id in self.ids() {
            self.signal(id, StopSignal::Term);
        }
    }

    pub(super) fn terminate(&mut self, now: Now) {
        let late: Vec<_> = self
            .federate_ids()
            .filter(|id| self.member(*id).lives())
            .collect();
        let names: Vec<_> = late
            .iter()
            .map(|id| self.member(*id).name.clone())
            .collect();
        if let Phase::Stopping {
            step,
            until,
            missed,
            ..
        } = &mut self.phase
        {
            *step = Step::Terminated;
            *until = now.since + KILL_GRACE;
            missed.clone_from(&names);
        }
        // Without federates it is the RTI that hangs.
        let targets = if late.is_empty() {
            vec![MemberId::Rti]
        } else {
            late
        };
        let names = if names.is_empty() {
            vec![RTI.to_owned()]
        } else {
            names
        };
        self.tell(Event::Signalled {
            signal: "SIGTERM".to_owned(),
            members: names,
        });
        for id in targets {
            self.signal(id, StopSignal::Term);
        }
    }

    pub(super) fn kill(&mut self, now: Now) {
        let Phase::Stopping { step, until, .. } = &mut self.phase else {
            return;
        };
        *step = Step::Killed;
        *until = now.since + KILL_GRACE;
        let late: Vec<_> = self
            .ids()
            .into_iter()
            .filter(|id| self.member(*id).lives())
            .collect();
        if late.is_empty() {
            return;
        }
        let members = late
            .iter()
            .map(|id| self.member(*id).name.clone())
            .collect();
        self.tell(Event::Signalled {
            signal: "SIGKILL".to_owned(),
            members,
        });
        for id in late {
            self.signal(id, StopSignal::Kill);
        }
    }

    /// Not even SIGKILL helped: a process in uninterruptible sleep, or a supervisor that hangs.
    pub(super) fn give_up(&mut self) {
        for id in self.ids() {
            let member = self.member_mut(id);
            if member.process != Process::Waiting && member.process != Process::Foreign {
                member
                    .view
                    .ending
                    .get_or_insert_with(|| "did not end after SIGKILL".to_owned());
                if std::mem::replace(&mut member.process, Process::Gone) != Process::Gone {
                    self.killed.insert(id);
                }
            }
        }
    }

    pub(super) fn signal(&mut self, member: MemberId, signal: StopSignal) {
        let state = self.member_mut(member);
        if state.lives() {
            state.signalled = state.signalled.max(Some(signal));
            self.actions.push_back(Action::Signal { member, signal });
        }
    }
}
