//! One outcome of a federation from those of its parts.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use serde::{Deserialize, Serialize};

/// Why something did not work.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cause {
    /// On which host.
    pub host: String,
    /// What was being done there; empty for what happened by itself.
    pub step: String,
    /// What happened, in words.
    pub what: String,
    /// How likely it is a consequence of another one: 0 is a cause.
    pub rank: u8,
    /// When, nanoseconds since the Unix epoch.
    pub at_ns: i64,
}

impl Cause {
    /// The one to tell: the lowest rank, then the earliest, then the first host by name.
    #[must_use]
    pub fn first(causes: impl IntoIterator<Item = Self>) -> Option<Self> {
        let key = |cause: &Self| {
            let Self {
                host, step, what, ..
            } = cause.clone();
            (cause.rank, cause.at_ns, host, step, what)
        };
        causes.into_iter().min_by_key(key)
    }
}

impl fmt::Display for Cause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.step.is_empty() {
            true => write!(f, "host `{}`: {}", self.host, self.what),
            false => write!(f, "host `{}`, {}: {}", self.host, self.step, self.what),
        }
    }
}

/// How a federation or a part of one ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "ended", rename_all = "snake_case")]
pub enum Ended {
    /// Every federate reached the end of its program.
    Completed,
    /// It was stopped by request.
    Stopped {
        /// Federates that did not reach the stop tag in time.
        missed: BTreeSet<String>,
    },
    /// It failed.
    Failed {
        /// The first cause.
        cause: Cause,
        /// Whether it had been healthy before.
        was_healthy: bool,
    },
    /// Who started it went away before it was healthy.
    Aborted,
}

/// What is known of a part.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PartOutcome {
    /// It has ended.
    Ended(Ended),
    /// It has not.
    Runs,
    /// Its host cannot be reached: it may run or have ended, and has not failed.
    Unknown {
        /// When it was last heard of, nanoseconds since the Unix epoch.
        since_ns: i64,
    },
}

/// What is known of a federation.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Merged {
    /// How it ended; absent when it has not, or that is not known. A failure is known from one part alone.
    pub ended: Option<Ended>,
    /// The hosts on which it runs.
    pub runs: BTreeSet<String>,
    /// The hosts that cannot be reached, with when they were last heard of.
    pub unknown: BTreeMap<String, i64>,
}

/// What is known of a federation from what is known of its parts, by host.
///
/// Of several failures the lowest rank and then the earliest is told. A part of which nothing is known is never a
/// failure, and no end but a failure is told while there is one.
#[must_use]
pub fn merge_outcomes(parts: &BTreeMap<String, PartOutcome>) -> Merged {
    let mut merged = Merged::default();
    let (mut causes, mut healthy) = (Vec::new(), false);
    let (mut aborted, mut stopped, mut missing) = (false, false, BTreeSet::new());
    for (host, part) in parts {
        match part {
            PartOutcome::Runs => {
                merged.runs.insert(host.clone());
            }
            PartOutcome::Unknown { since_ns } => {
                merged.unknown.insert(host.clone(), *since_ns);
            }
            PartOutcome::Ended(Ended::Completed) => {}
            PartOutcome::Ended(Ended::Aborted) => aborted = true,
            PartOutcome::Ended(Ended::Stopped { missed }) => {
                stopped = true;
                missing.extend(missed.iter().cloned());
            }
            PartOutcome::Ended(Ended::Failed { cause, was_healthy }) => {
                causes.push(cause.clone());
                healthy |= was_healthy;
            }
        }
    }
    let all_known = merged.runs.is_empty() && merged.unknown.is_empty();
    merged.ended = match Cause::first(causes) {
        Some(cause) => Some(Ended::Failed {
            cause,
            was_healthy: healthy,
        }),
        None if !all_known || parts.is_empty() => None,
        None if aborted => Some(Ended::Aborted),
        None if stopped => Some(Ended::Stopped { missed: missing }),
        None => Some(Ended::Completed),
    };
    merged
}
