//! Measures on their way from a federate to whoever asks the daemon.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{ClockStatus, FederateStatus};
use crate::measure::{Downstream, Histogram, Measures, Own, Upstream};

/// What a status line may be long, its newline counted: a pipe takes so much whole or not at all.
pub const LINE_BYTES_MAX: usize = 4096;

/// What the federates of a federation measured, last as far as they said.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FederationMeasures {
    /// The federation's name.
    pub federation: String,
    /// Every federate, in the plan's order.
    pub federates: Vec<FederateMeasures>,
}

/// What one federate measured, as far as it said.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FederateMeasures {
    /// The federate's name.
    pub federate: String,
    /// Its clock; absent while it has not said.
    pub clock: Option<ClockStatus>,
    /// Whether it is falling behind at the moment.
    pub behind: bool,
    /// What it measured of itself.
    pub own: Own,
    /// What it measured of messages to it, by the sender's name.
    pub upstreams: BTreeMap<String, Upstream>,
    /// What it measured of messages from it, by the receiver's name.
    pub downstreams: BTreeMap<String, Downstream>,
}

impl FederateMeasures {
    /// Nothing known yet of this federate.
    #[must_use]
    pub fn of(federate: &str) -> Self {
        Self {
            federate: federate.to_owned(),
            ..Self::default()
        }
    }

    /// Takes what a status line of this federate says. `name` gives the name of a federate id of the plan; a peer that has
    /// none is left out.
    ///
    /// Laws: counters and histograms' counts never go back; taking a line twice is taking it once.
    pub fn take<'a>(&mut self, status: FederateStatus, name: impl Fn(u16) -> Option<&'a str>) {
        match status {
            FederateStatus::Progress {
                tags,
                reactions,
                deadlines_missed,
                ..
            } => self.own.update(Own {
                tags_completed: tags,
                reactions,
                deadline_misses: deadlines_missed,
                ..Own::default()
            }),
            FederateStatus::Measures { own, .. } => self.own.update(own),
            FederateStatus::Upstream {
                upstream, measures, ..
            } => {
                if let Some(name) = name(upstream) {
                    let known = self.upstreams.entry(name.to_owned()).or_default();
                    known.update(measures);
                }
            }
            FederateStatus::Downstream {
                downstream,
                measures,
                ..
            } => {
                if let Some(name) = name(downstream) {
                    let known = self.downstreams.entry(name.to_owned()).or_default();
                    known.update(measures);
                }
            }
            FederateStatus::Clock { clock, .. } => self.clock = Some(clock),
            FederateStatus::FallingBehind { .. } => self.behind = true,
            FederateStatus::CaughtUp { .. } => self.behind = false,
            FederateStatus::Joined { .. }
            | FederateStatus::Start { .. }
            | FederateStatus::Running { .. }
            | FederateStatus::StpViolation { .. }
            | FederateStatus::ClockStep { .. }
            | FederateStatus::Ended { .. } => {}
        }
    }
}

/// The status lines that tell `measures`, newlines included: one for the federate itself and one for each peer; what would be
/// longer than [`LINE_BYTES_MAX`] is told in parts, one for each histogram.
#[must_use]
pub fn lines(federate: &str, measures: &Measures) -> Vec<Vec<u8>> {
    let mut lines = Vec::new();
    let own = measures.own();
    tell(&mut lines, own, Own::HISTOGRAMS, |own, part| {
        let federate = federate.to_owned();
        FederateStatus::Measures {
            federate,
            part,
            own,
        }
    });
    for (upstream, peer) in measures.upstreams() {
        tell(&mut lines, peer, Upstream::HISTOGRAMS, |measures, part| {
            let federate = federate.to_owned();
            FederateStatus::Upstream {
                federate,
                upstream,
                part,
                measures,
            }
        });
    }
    for (downstream, peer) in measures.downstreams() {
        tell(
            &mut lines,
            peer,
            Downstream::HISTOGRAMS,
            |measures, part| {
                let federate = federate.to_owned();
                FederateStatus::Downstream {
                    federate,
                    downstream,
                    part,
                    measures,
                }
            },
        );
    }
    lines
}

/// Picks one histogram of a report.
pub(crate) type Pick<T> = fn(&mut T) -> &mut Histogram;

fn tell<T: Clone>(
    lines: &mut Vec<Vec<u8>>,
    report: &T,
    histograms: &[Pick<T>],
    status: impl Fn(T, u8) -> FederateStatus,
) {
    let line = |report: T, part: u8| {
        let mut line = serde_json::to_vec(&status(report, part)).unwrap_or_default();
        line.push(b'\n');
        line
    };
    let whole = line(report.clone(), 0);
    if whole.len() <= LINE_BYTES_MAX {
        lines.push(whole);
        return;
    }
    for (kept, part) in histograms.iter().zip(0..) {
        let mut report = report.clone();
        let histogram = std::mem::take(kept(&mut report));
        for each in histograms {
            *each(&mut report) = Histogram::default();
        }
        *kept(&mut report) = histogram;
        lines.push(line(report, part));
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde hands a reference")]
pub(super) const fn is_whole(part: &u8) -> bool {
    *part == 0
}
