//! Which failure is the cause, and which only its consequence.

use ictus_coord::report::exit;

use super::{Agent, Member, MemberId, Now, Phase, Ranked, Why};
use crate::api::{Failure, FailureKind, Outcome};
use crate::supervisor::exit::Ending;
use crate::supervisor::protocol::StopSignal;

impl Agent {
    /// Notes a failure and begins to end the rest.
    ///
    /// While it runs, the federation outlives those whose `on_failure` says so.
    pub(super) fn fail(&mut self, now: Now, rank: u8, failure: Failure) {
        let outlived = self
            .federates
            .iter()
            .any(|member| member.outlived && failure.member.as_ref() == Some(&member.name));
        let failure = Failure { rank, ..failure };
        self.failures.push(Ranked { rank, failure });
        match self.phase {
            Phase::Starting { .. } => self.undo(now, Why::Failure),
            Phase::Running if outlived => {}
            Phase::Running => self.expect_stop(now, Why::Failure),
            Phase::Stopping { .. } | Phase::Ended(_) => {}
        }
    }

    pub(super) fn failure(&self, now: Now, id: MemberId, what: String) -> Failure {
        Failure {
            kind: FailureKind::Process,
            member: Some(self.member(id).name.clone()),
            rank: 0,
            what,
            reason: None,
            lines: Vec::new(),
            log: None,
            at_ns: now.wall_ns,
        }
    }

    /// Whether an end is a failure, and how likely only a consequence of another; absent when it is none.
    pub(super) fn rank(&self, id: MemberId, ending: &Ending, premature: bool) -> Option<u8> {
        let signalled = self.member(id).signalled;
        match ending {
            Ending::Exited { code: 0 } => (premature && signalled.is_none()).then_some(1),
            Ending::Exited { code } => match u8::try_from(*code) {
                Ok(exit::RTI_LOST | exit::PEER_FAILED) => self.unless_ladder(3),
                Ok(exit::NOT_JOINED) => self.unless_ladder(2),
                // It says that a federate failed.
                _ if id == MemberId::Rti && !premature => self.unless_ladder(3),
                _ => Some(0),
            },
            Ending::Killed { signal: 15 } if signalled.is_some() => None,
            Ending::Killed { signal: 9 } if signalled == Some(StopSignal::Kill) => None,
            Ending::Killed { .. }
            | Ending::OutOfMemory
            | Ending::NotStarted { .. }
            | Ending::Unknown => Some(0),
        }
    }

    /// Once we signal federates ourselves, what others say about lost peers is our doing.
    pub(super) fn unless_ladder(&self, rank: u8) -> Option<u8> {
        let ladder = self
            .federates
            .iter()
            .any(|member| member.signalled.is_some());
        (!ladder).then_some(rank)
    }

    pub(super) fn conclude(&mut self, now: Now) -> Outcome {
        let first = self
            .failures
            .drain(..)
            .min_by_key(|it| (it.rank, it.failure.at_ns));
        match (first, &mut self.phase) {
            (
                _,
                Phase::Stopping {
                    why: Why::Aborted, ..
                },
            ) => Outcome::Aborted,
            (Some(Ranked { failure, .. }), _) => Outcome::Failed {
                failure,
                was_healthy: self.was_healthy,
            },
            (None, phase) => {
                let (requested, terminated) = match phase {
                    Phase::Stopping { why, missed, .. } => {
                        (*why == Why::Requested, std::mem::take(missed))
                    }
                    Phase::Starting { .. } | Phase::Running | Phase::Ended(_) => {
                        (false, Vec::new())
                    }
                };
                match self.missed_by_force(&terminated) {
                    Some(what) => Outcome::Failed {
                        failure: Failure {
                            kind: FailureKind::Timeout,
                            member: None,
                            rank: 0,
                            what,
                            reason: None,
                            lines: Vec::new(),
                            log: None,
                            at_ns: now.wall_ns,
                        },
                        was_healthy: self.was_healthy,
                    },
                    None if requested => Outcome::Stopped { missed: terminated },
                    None => Outcome::Completed,
                }
            }
        }
    }

    /// Who did not reach the stop tag, in words; absent when nobody had to be killed.
    fn missed_by_force(&self, terminated: &[String]) -> Option<String> {
        if self.killed.is_empty() {
            return None;
        }
        let missed =
            |id: &MemberId| self.killed.contains(id) || terminated.contains(&self.member(*id).name);
        let late: Vec<_> = self.federate_ids().filter(missed).collect();
        // Without federates it is the RTI that hung.
        let late = if late.is_empty() {
            vec![MemberId::Rti]
        } else {
            late
        };
        let names: Vec<_> = late
            .iter()
            .map(|id| self.member(*id).name.as_str())
            .collect();
        Some(format!(
            "did not reach the stop tag in time: {}",
            names.join(", ")
        ))
    }

    /// Why the start takes too long.
    pub(super) fn late(&self) -> String {
        let names = |late: &dyn Fn(&Member) -> bool| {
            let late = self.federates.iter().filter(|member| late(member));
            late.map(|member| member.name.as_str())
                .collect::<Vec<_>>()
                .join(", ")
        };
        // Of a part, the RTI's host knows of all, the others of their own.
        let known = |member: &Member| member.here || self.rti.here;
        let missing = names(&|member| known(member) && !member.joined);
        if self.rti_port.is_none() {
            "the RTI does not listen".to_owned()
        } else if !missing.is_empty() {
            format!("not joined in time: {missing}")
        } else if self.start_ns.is_none() {
            "no start tag was agreed in time".to_owned()
        } else {
            let waiting = names(&|member| member.here && member.ours && !member.running);
            format!("the first tag was not completed in time by: {waiting}")
        }
    }
}
