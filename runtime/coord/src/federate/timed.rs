//! Decentralized coordination: time decides when nothing can come any more (PTIDES).
//!
//! Laws, checked by the simulator: a message is counted as tardy iff its input had been decided at its tag when it was
//! ingested; a message that comes by its tag's time plus its connection's offset, by this federate's clock, is never tardy.
//!
//! Source: DESIGN section 4; section 7 of the wire document (STA, STAA).

use super::link::Link;
use super::{Federate, FederateEvent, Incoming, Outcome, Poll};
use crate::mutants::Mutant;
use crate::payload::FederateExecutor;
use ictus_core::{Admission, Duration, InputId, PhysicalTime, Tag, Timeline};

impl Link {
    /// When `next` may be begun by this federate's clock: at its time, or once what may still come before it would have come.
    fn entry_time(&self, next: Tag, timeline: &Timeline) -> PhysicalTime {
        let (time, before) = (next.time.as_physical(), next.latest_earlier());
        let mut due = time;
        if self.config.mutants.has(Mutant::EntersEarly) {
            return due;
        }
        for (index, input) in self.config.inputs.iter().enumerate() {
            if !input.physical && timeline.known(InputId::new(index)) < before {
                due = due.max(time.saturating_add(input.stp_offset));
            }
        }
        due
    }

    /// When an input's silence at `tag`, which has been begun, means absence.
    fn decision_time(&self, input: InputId, tag: Tag) -> PhysicalTime {
        let link = &self.config.inputs[input.index()];
        let time = tag.time.as_physical();
        if self.config.mutants.has(Mutant::DecidesEarly) {
            return time;
        }
        time.saturating_add(link.stp_offset)
            .saturating_add(link.absent_after)
    }

    /// Whether every input that has a status has ended.
    pub(super) fn all_ended(&self, timeline: &Timeline) -> bool {
        let mut inputs = self.config.inputs.iter().enumerate();
        inputs.all(|(index, input)| {
            input.physical || timeline.known(InputId::new(index)) == Tag::FOREVER
        })
    }
}

impl Federate {
    /// Whether time and STP offsets decide here.
    pub(super) fn is_decentralized(&self) -> bool {
        self.link
            .as_ref()
            .is_some_and(|link| link.config.decentralized)
    }

    /// The clock by which absence is decided: what had come by then has been ingested.
    fn decisive(&self, now: PhysicalTime) -> PhysicalTime {
        let skips_look = |link: &Link| link.config.mutants.has(Mutant::DecidesUnlooked);
        if self.link.as_ref().is_some_and(skips_look) {
            return now;
        }
        now.min(self.looked_at)
    }

    /// Whether `next` may be begun; when nothing is left and nothing can come, the program starves.
    pub(super) fn permit_by_time(&mut self, now: PhysicalTime, next: Tag) -> Result<Tag, Poll> {
        let Some(link) = &self.link else {
            return Ok(next);
        };
        if next == Tag::FOREVER {
            if link.all_ended(&self.timeline) {
                return self.starve().ok_or(Poll::Wait(None));
            }
            return Err(Poll::Wait(None));
        }
        let due = link.entry_time(next, &self.timeline);
        let waits = due > next.time.as_physical();
        let clock = if waits { self.decisive(now) } else { now };
        if clock < due {
            return Err(Poll::Wait(Some(due)));
        }
        Ok(next)
    }

    /// Decides at the current tag what time has decided; returns when the next unknown input will be.
    pub(super) fn decide_absent(&mut self, now: PhysicalTime) -> Option<PhysicalTime> {
        let (at, clock) = (self.timeline.current()?, self.decisive(now));
        let mut next: Option<PhysicalTime> = None;
        let Some(link) = &self.link else {
            return None;
        };
        for index in 0..link.config.inputs.len() {
            let input = InputId::new(index);
            if link.config.inputs[index].physical || self.timeline.known(input) >= at {
                continue;
            }
            let due = link.decision_time(input, at);
            if clock >= due {
                self.timeline.settle(input, at);
            } else {
                next = Some(next.map_or(due, |next| next.min(due)));
            }
        }
        next
    }

    /// Takes a tagged message from its sender: in time, or tardy.
    pub(super) fn admit_by_time(
        &mut self,
        now: PhysicalTime,
        message: &Incoming<'_>,
        executor: &mut impl FederateExecutor,
    ) -> Result<(), Outcome> {
        let Some(link) = &self.link else {
            return Ok(());
        };
        let input = link.config.inputs[message.input.index()];
        let known_by_order = !link.config.mutants.has(Mutant::OrderIgnored);
        self.counters.received += 1;
        self.measures.arrived(input.federate, message.payload.len());
        if self.stop.over(self.timeline.at()) {
            return Ok(());
        }
        let time = message.tag.time.as_physical();
        let by = time.saturating_add(input.stp_offset);
        if self.timeline.finished() {
            if self.timeline.due(message.input, message.tag) <= self.timeline.at() {
                self.count_violation(message.input, now.since(by));
                let after = self.timeline.at().successor();
                executor.note_tardy(message.input, message.tag, after);
            }
            return Ok(());
        }
        let value = executor.decode(message.input, message.payload)?;
        let origin = time.saturating_add(-input.delay.span());
        let arrival = now.since(origin.saturating_add(input.sender_offset));
        self.measures.arrival(input.federate, arrival);
        match self.timeline.admit(message.input, message.tag, value) {
            Admission::Queued { tag } => {
                if known_by_order {
                    self.timeline.settle(message.input, tag);
                }
            }
            Admission::IntoCurrentTag => {
                let program = self.timeline.program();
                let action = program.network_inputs()[message.input.index()].action;
                executor.arrive(action, program.action_slot(action), value);
            }
            Admission::Tardy { intended, actual } => {
                self.count_violation(message.input, now.since(by));
                executor.note_tardy(message.input, intended, actual);
                return Ok(());
            }
        }
        self.measures.slack(input.federate, by.since(now));
        Ok(())
    }

    fn count_violation(&mut self, input: InputId, lateness: Duration) {
        let Some(link) = &self.link else { return };
        if link.config.mutants.has(Mutant::TardyUncounted) {
            return;
        }
        let upstream = link.config.inputs[input.index()].federate;
        let limit = link.config.max_stp_violations;
        if let Some(count) = self.measures.violation(upstream, lateness) {
            self.events.push_back(FederateEvent::StpViolation {
                upstream,
                lateness,
                count,
            });
        }
        if limit == Some(self.measures.stp_violations()) {
            self.stop.too_many_violations();
            self.request_stop_at_current();
        }
    }
}
