//! What a running federate says of itself, about once a second and at its end.

use std::io::{self, Write};

use ictus_coord::report::FederateStatus;
use ictus_core::{PhysicalTime, Tag};

use super::{PROGRESS_EVERY, Runner};

impl Runner<'_> {
    /// Reports when it is time again.
    pub(super) fn report_progress(&mut self, now: PhysicalTime) {
        if !self.status.enabled() || now.since(self.reported_at) < PROGRESS_EVERY {
            return;
        }
        self.reported_at = now;
        self.bodies.flush_observed();
        self.report();
    }

    /// Says how far the federate is and what it measured, as far as there is room for it.
    pub(super) fn report(&mut self) {
        if self.start == Tag::NEVER {
            return;
        }
        let (counters, bodies) = (self.federate.counters(), self.bodies.counters());
        let at = self.federate.timeline().at();
        self.status.say(&FederateStatus::Progress {
            federate: self.name.to_owned(),
            elapsed_ns: self.elapsed_ns(at),
            microstep: at.microstep,
            tags: counters.tags,
            reactions: bodies.reactions,
            sent: counters.sent,
            received: counters.received,
            deadlines_missed: bodies.deadlines_missed,
        });
        let measures = self.federate.measures_mut();
        let lateness = self.bodies.deadline_lateness();
        measures.executed(bodies.reactions, bodies.watchdogs_fired, lateness);
        self.status.say_measures(self.name, measures);
        self.report_clock();
    }

    fn report_clock(&mut self) {
        let federate = self.name.to_owned();
        if let Some(by) = self.sync.take_step() {
            let by_ns = by.as_nanos();
            drop(writeln!(
                io::stderr(),
                "ictus: federate {federate}: a clock was stepped by {by}"
            ));
            self.status
                .say(&FederateStatus::ClockStep { federate, by_ns });
        }
        let federate = self.name.to_owned();
        let clock = self.sync.status();
        self.status.say(&FederateStatus::Clock { federate, clock });
    }
}
