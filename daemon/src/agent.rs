//! One federation's life as a state machine without I/O: what processes say goes in, what to do comes out.
//!
//! After every `handle_*`, drain [`Agent::poll_action`] to `None`, then wait until [`Agent::poll_timeout`].
//! A start is all or nothing: whatever fails before every federate has completed its first tag ends the
//! others. Every wait has a bound; the ladder is stop consensus, SIGTERM, SIGKILL, giving up.

use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

use ictus_coord::plan::OnFailure;
use ictus_deploy::{FederateKind, Settings};

use crate::api::{
    Event, ExitReason, Failure, FailureKind, FederateMeasures, MemberView, Outcome, StartRequest,
    State,
};
use crate::supervisor::exit::{Ending, ExitRecord};
use crate::supervisor::protocol::StopSignal;

mod failure;
mod member;
mod status;
mod stop;

use member::{Member, Process};

/// The RTI's name among the members.
pub const RTI: &str = ictus_deploy::COORDINATOR;
/// How long after the last join the start may take: start consensus and the first tag.
const FIRST_TAG_MAX: Duration = Duration::from_secs(60);
/// Refused connections that are told: who floods the RTI's port must not flood who watches.
const REJECTED_MAX: u32 = 20;
/// Events of a federate's own making that are told, for the same reason.
const REMARKS_MAX: u32 = 100;
/// How long after SIGTERM SIGKILL follows, and after SIGKILL the end is declared.
const KILL_GRACE: Duration = Duration::from_secs(2);

/// Two readings of the clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Now {
    /// Monotonic, from any origin: waits are measured on it.
    pub since: Duration,
    /// Nanoseconds since the Unix epoch: what people read.
    pub wall_ns: i64,
}

/// A process of the federation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum MemberId {
    /// The RTI.
    Rti,
    /// A federate: index into the plan.
    Federate(u16),
}

/// What a member's supervisor says.
#[derive(Clone, Debug, PartialEq)]
pub enum MemberEvent {
    /// The process was started.
    Started {
        /// Its id.
        pid: u32,
    },
    /// A status line.
    Reported {
        /// The line.
        line: serde_json::Value,
    },
    /// The process ended.
    Ended {
        /// Its record.
        record: Box<ExitRecord>,
    },
    /// The supervisor could not be used; there is no process.
    NotSupervised {
        /// Why.
        why: String,
    },
    /// What answers in the member's place is not ours.
    Foreign {
        /// How it was told.
        why: String,
    },
    /// The supervisor is gone. Nothing follows. Without an end before, it was killed.
    Closed,
}

/// What the driver must do.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// Start a member; a federate gets the RTI's port.
    Launch {
        /// Who.
        member: MemberId,
        /// The RTI's port; absent for the RTI itself.
        rti_port: Option<u16>,
    },
    /// Have its supervisor send a signal.
    Signal {
        /// To whom.
        member: MemberId,
        /// Which.
        signal: StopSignal,
    },
    /// Tell everybody.
    Tell(Event),
}

/// The state machine of one federation.
#[derive(Debug)]
pub struct Agent {
    rti: Member,
    federates: Vec<Member>,
    settings: Settings,
    phase: Phase,
    rti_port: Option<u16>,
    start_ns: Option<i64>,
    was_healthy: bool,
    /// The RTI has lost a federate, so its own exit code is only a consequence.
    lost_one: bool,
    /// Connections that the RTI refused.
    rejected: u32,
    /// Who was sent SIGKILL before it ended in order.
    killed: BTreeSet<MemberId>,
    failures: Vec<Ranked>,
    actions: VecDeque<Action>,
}

#[derive(Debug)]
enum Phase {
    Starting {
        until: Duration,
    },
    Running,
    Stopping {
        why: Why,
        step: Step,
        until: Duration,
        missed: Vec<String>,
    },
    Ended(Outcome),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Why {
    /// Nothing is left to do, or a federate asked: the program's own end.
    Program,
    Requested,
    Failure,
    Aborted,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    /// Stop consensus is under way, or should be.
    Consensus,
    Terminated,
    Killed,
}

/// A failure and how likely it is a consequence of another: 0 is a cause.
#[derive(Debug)]
struct Ranked {
    rank: u8,
    failure: Failure,
}

impl Agent {
    /// Begins a start: the first action launches the RTI, or when it runs on another host, listening on `rti_port`,
    /// this host's federates.
    #[must_use]
    pub fn start(now: Now, request: &StartRequest, rti_port: Option<u16>) -> Self {
        let until = now.since + request.settings.join_timeout;
        let mut agent = Self::new(request, Phase::Starting { until });
        if agent.rti.here {
            agent.launch(MemberId::Rti);
        } else {
            agent.rti_port = rti_port;
            for id in agent.federate_ids() {
                agent.launch(id);
            }
            agent.advance(now);
        }
        agent
    }

    /// Takes over a run that another daemon started. The driver then hands in what each supervisor says,
    /// from the beginning. `launched` tells which members have a record; the others were never started.
    #[must_use]
    pub fn adopt(
        now: Now,
        request: &StartRequest,
        (state, rti_port): (State, Option<u16>),
        launched: impl Fn(MemberId) -> bool,
    ) -> Self {
        let mut agent = Self::new(request, Phase::Running);
        if !agent.rti.here {
            agent.rti_port = rti_port;
        }
        for id in agent.ids() {
            if launched(id) {
                agent.member_mut(id).process = Process::Launching;
            }
        }
        match state {
            State::Running => agent.was_healthy = true,
            State::Prepared | State::Starting => agent.undo(now, Why::Aborted),
            State::Stopping | State::Ended | State::WaitingForSecrets => {
                agent.was_healthy = true;
                agent.begin_stop(now, Why::Requested);
            }
        }
        agent
    }

    fn new(request: &StartRequest, phase: Phase) -> Self {
        let federates = request.federates.iter();
        let part = request.part.as_ref();
        Self {
            rti: Member {
                here: part.is_none_or(|part| part.rti),
                ..Member::new(RTI, true)
            },
            federates: federates
                .map(|run| {
                    let plan = request.plan.federates.get(usize::from(run.id));
                    Member {
                        outlived: plan.is_some_and(|it| it.on_failure == OnFailure::Continue),
                        here: part.is_none_or(|part| part.federates.contains(&run.id)),
                        ..Member::new(&run.name, run.kind == FederateKind::Ours)
                    }
                })
                .collect(),
            settings: request.settings.clone(),
            phase,
            rti_port: None,
            start_ns: None,
            was_healthy: false,
            lost_one: false,
            rejected: 0,
            killed: BTreeSet::new(),
            failures: Vec::new(),
            actions: VecDeque::new(),
        }
    }

    /// Takes what a member's supervisor said.
    pub fn handle_member(&mut self, now: Now, id: MemberId, event: MemberEvent) {
        match event {
            MemberEvent::Started { pid } => self.handle_started(id, pid),
            MemberEvent::Reported { line } => self.handle_status(now, id, &line),
            MemberEvent::Ended { record } => self.handle_end(now, id, &record),
            MemberEvent::NotSupervised { why } => {
                self.member_mut(id).process = Process::Gone;
                let failure = self.failure(now, id, why);
                self.fail(now, 0, failure);
            }
            MemberEvent::Foreign { why } => {
                let member = self.member_mut(id);
                member.process = Process::Foreign;
                let name = member.name.clone();
                self.tell(Event::Foreign {
                    member: name,
                    why: why.clone(),
                });
                let failure = self.failure(now, id, why);
                self.fail(
                    now,
                    0,
                    Failure {
                        kind: FailureKind::Foreign,
                        ..failure
                    },
                );
            }
            MemberEvent::Closed => self.handle_closed(now, id),
        }
        self.advance(now);
    }

    /// Takes a request to stop in order; during a start it undoes the start.
    pub fn handle_stop(&mut self, now: Now) {
        match self.phase {
            Phase::Starting { .. } => self.undo(now, Why::Aborted),
            Phase::Running => {
                self.tell(Event::StopRequested {
                    by: "user".to_owned(),
                });
                self.begin_stop(now, Why::Requested);
            }
            Phase::Stopping { .. } | Phase::Ended(_) => {}
        }
        self.advance(now);
    }

    /// Takes a request to end everything at once.
    pub fn handle_kill(&mut self, now: Now) {
        if matches!(self.phase, Phase::Starting { .. }) {
            self.undo(now, Why::Aborted);
        }
        if matches!(self.phase, Phase::Running) {
            self.begin_stop(now, Why::Requested);
        }
        self.kill(now);
        self.advance(now);
    }

    /// Takes that who asked for the start is gone: before `healthy` that undoes it.
    pub fn handle_starter_gone(&mut self, now: Now) {
        if matches!(self.phase, Phase::Starting { .. }) {
            self.undo(now, Why::Aborted);
            self.advance(now);
        }
    }

    /// Takes that the time of [`Agent::poll_timeout`] has come.
    pub fn handle_timeout(&mut self, now: Now) {
        if self.poll_timeout().is_none_or(|until| now.since < until) {
            return;
        }
        match &self.phase {
            Phase::Starting { .. } => {
                let failure = self.failure(now, MemberId::Rti, self.late());
                let kind = FailureKind::Timeout;
                self.fail(
                    now,
                    0,
                    Failure {
                        kind,
                        member: None,
                        ..failure
                    },
                );
            }
            Phase::Stopping {
                step: Step::Consensus,
                ..
            } => self.terminate(now),
            Phase::Stopping {
                step: Step::Terminated,
                ..
            } => self.kill(now),
            Phase::Stopping {
                step: Step::Killed, ..
            } => self.give_up(),
            Phase::Running | Phase::Ended(_) => {}
        }
        self.advance(now);
    }

    /// When [`Agent::handle_timeout`] must be called, on the monotonic clock.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        match &self.phase {
            Phase::Starting { until } | Phase::Stopping { until, .. } => Some(*until),
            Phase::Running | Phase::Ended(_) => None,
        }
    }

    /// What the driver must do next.
    #[must_use]
    pub fn poll_action(&mut self) -> Option<Action> {
        self.actions.pop_front()
    }

    /// How it ended, once nothing runs any more.
    #[must_use]
    pub fn outcome(&self) -> Option<&Outcome> {
        match &self.phase {
            Phase::Ended(outcome) => Some(outcome),
            Phase::Starting { .. } | Phase::Running | Phase::Stopping { .. } => None,
        }
    }

    /// Where the federation stands.
    #[must_use]
    pub fn state(&self) -> State {
        match self.phase {
            Phase::Starting { .. } => State::Starting,
            Phase::Running => State::Running,
            Phase::Stopping { .. } => State::Stopping,
            Phase::Ended(_) => State::Ended,
        }
    }

    /// The RTI's port once it listens.
    #[must_use]
    pub fn rti_port(&self) -> Option<u16> {
        self.rti_port
    }

    /// The start tag's time once it is agreed.
    #[must_use]
    pub fn start_ns(&self) -> Option<i64> {
        self.start_ns
    }

    /// How the RTI is.
    #[must_use]
    pub fn rti_view(&self) -> MemberView {
        self.rti.view()
    }

    /// What the federates measured.
    #[must_use]
    pub fn measures(&self) -> Vec<FederateMeasures> {
        let federates = self.federates.iter().filter(|member| member.here);
        federates.map(|member| member.measures.clone()).collect()
    }

    /// How the federates of this host are.
    #[must_use]
    pub fn federate_views(&self) -> Vec<MemberView> {
        let federates = self.federates.iter().filter(|member| member.here);
        federates.map(Member::view).collect()
    }

    fn handle_started(&mut self, id: MemberId, pid: u32) {
        let member = self.member_mut(id);
        member.process = Process::Up;
        member.pid = Some(pid);
        let name = member.name.clone();
        let started = self
            .federates
            .iter()
            .filter(|member| member.pid.is_some())
            .count();
        self.tell(Event::Started {
            member: name,
            pid,
            started,
            of: self.federates.iter().filter(|it| it.here).count(),
        });
    }

    fn handle_end(&mut self, now: Now, id: MemberId, record: &ExitRecord) {
        let starting = matches!(self.phase, Phase::Starting { .. });
        let start_agreed = self.start_ns.is_some();
        let (others_live, lost_one) = (self.others_live(id), self.lost_one);
        // One that lost the RTI to SIGKILL before its own arrived says so with its exit code.
        if self.member(id).signalled == Some(StopSignal::Kill) && !record.ending.success() {
            self.killed.insert(id);
        }
        if let MemberId::Federate(index) = id {
            // Told before, unless nobody was there to hear it.
            for line in &record.reports {
                if let Ok(status) = serde_json::from_value(line.clone()) {
                    self.measure(index, &status);
                }
            }
        }
        let member = self.member_mut(id);
        member.process = Process::Ended;
        member.view.exit = Some(ExitReason::of(&record.ending));
        member.pid = record.pid;
        let how = record.ending.describe();
        member.view.ending = Some(how.clone());
        let ran = if member.ours {
            member.running
        } else {
            start_agreed
        };
        let premature = match id {
            // It returns 0 only when every federate has resigned, and may do so before they have ended.
            MemberId::Rti if record.ending.success() => others_live && !start_agreed,
            MemberId::Rti => others_live && !lost_one,
            MemberId::Federate(_) => starting && !ran,
        };
        let (name, reason) = (member.name.clone(), member.reason.clone());
        self.tell(Event::Exited {
            member: name,
            how: how.clone(),
            reason: reason.clone(),
        });
        if let Some(rank) = self.rank(id, &record.ending, premature) {
            let what = match premature && record.ending.success() && reason.is_none() {
                false => how,
                true if starting => format!("{how} before the start"),
                true => format!("{how} before its federates"),
            };
            let at = Now {
                wall_ns: record.ended_ns,
                ..now
            };
            let failure = self.failure(at, id, what);
            self.fail(
                now,
                rank,
                Failure {
                    reason,
                    lines: record.first_lines.clone(),
                    ..failure
                },
            );
        }
        if matches!(self.phase, Phase::Running) && (id == MemberId::Rti || self.nothing_left()) {
            self.expect_stop(now, Why::Program);
        }
    }

    fn handle_closed(&mut self, now: Now, id: MemberId) {
        let member = self.member_mut(id);
        match member.process {
            Process::Launching | Process::Up => {
                member.process = Process::Gone;
                member.view.exit = Some(ExitReason::Unknown);
                let how = Ending::Unknown.describe();
                member.view.ending = Some(how.clone());
                let name = member.name.clone();
                self.tell(Event::Exited {
                    member: name,
                    how: how.clone(),
                    reason: None,
                });
                let failure = self.failure(now, id, how);
                self.fail(now, 0, failure);
            }
            Process::Ended => member.process = Process::Gone,
            Process::Waiting | Process::Gone | Process::Foreign => {}
        }
    }

    /// Moves to the next phase when its condition holds.
    fn advance(&mut self, now: Now) {
        if matches!(self.phase, Phase::Starting { .. }) && self.is_healthy() {
            self.was_healthy = true;
            self.phase = Phase::Running;
            self.tell(Event::Healthy);
            if self.nothing_left() {
                self.expect_stop(now, Why::Program);
            }
        }
        let gone = |member: &Member| {
            matches!(
                member.process,
                Process::Waiting | Process::Gone | Process::Foreign
            )
        };
        if self.outcome().is_none() && gone(&self.rti) && self.federates.iter().all(gone) {
            let outcome = self.conclude(now);
            self.tell(Event::Ended {
                outcome: outcome.clone(),
            });
            self.phase = Phase::Ended(outcome);
        }
    }

    /// Whether everybody of this host runs. That all have joined is in the start tag; a foreign federate says nothing
    /// itself, and only an RTI of the same host speaks for it.
    fn is_healthy(&self) -> bool {
        let heard = |member: &Member| {
            if member.ours {
                member.joined && member.running
            } else {
                member.joined || (!self.rti.here && member.process == Process::Up)
            }
        };
        let mut here = self.federates.iter().filter(|member| member.here);
        let silent = !self.rti.here && here.clone().all(|member| !member.ours);
        (self.start_ns.is_some() || silent) && here.all(heard)
    }

    /// Whether no federate is left for which this host's members would stay.
    fn nothing_left(&self) -> bool {
        let some_elsewhere = self.federates.iter().any(|member| !member.here);
        !(self.federates.iter().any(Member::lives) || self.rti.lives() && some_elsewhere)
    }

    fn launch(&mut self, member: MemberId) {
        let rti_port = self.rti_port;
        let state = self.member_mut(member);
        if state.here && state.process == Process::Waiting {
            state.process = Process::Launching;
            self.actions.push_back(Action::Launch { member, rti_port });
        }
    }

    fn tell(&mut self, event: Event) {
        self.actions.push_back(Action::Tell(event));
    }

    fn others_live(&self, id: MemberId) -> bool {
        self.federate_ids()
            .any(|other| other != id && self.member(other).lives())
    }

    fn ids(&self) -> Vec<MemberId> {
        std::iter::once(MemberId::Rti)
            .chain(self.federate_ids())
            .collect()
    }

    fn federate_ids(&self) -> impl Iterator<Item = MemberId> + use<> {
        (0..u16::try_from(self.federates.len()).unwrap_or(u16::MAX)).map(MemberId::Federate)
    }

    fn name(&self, federate: u16) -> String {
        let member = self.federates.get(usize::from(federate));
        member.map_or_else(
            || format!("federate {federate}"),
            |member| member.name.clone(),
        )
    }

    fn member(&self, id: MemberId) -> &Member {
        match id {
            MemberId::Rti => &self.rti,
            MemberId::Federate(index) => &self.federates[usize::from(index)],
        }
    }

    fn member_mut(&mut self, id: MemberId) -> &mut Member {
        match id {
            MemberId::Rti => &mut self.rti,
            MemberId::Federate(index) => &mut self.federates[usize::from(index)],
        }
    }
}

#[cfg(test)]
mod tests;
