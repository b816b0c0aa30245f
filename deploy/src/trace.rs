//! Logical traces read back: sets of `FEDERATE.trace` files, compared and hashed.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;

/// The traces of one run, by federate; records are sorted, so the order of execution does not show.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TraceSet {
    /// One per federate: records go by the first element of their path, whatever file they stood in.
    pub federates: BTreeMap<String, FederateTrace>,
}

/// What one federate did.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FederateTrace {
    /// What was executed, sorted.
    pub records: Vec<Record>,
    /// Physical events, which no other run repeats.
    pub physical: Vec<(TraceTag, String)>,
    /// The tag of a stop by request.
    pub stop: Option<TraceTag>,
    /// Where and why the trace ended; absent when the federate was cut off.
    pub end: Option<(TraceTag, String)>,
}

/// A tag of a trace.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct TraceTag {
    /// Nanoseconds after the start tag.
    pub time_ns: i64,
    /// The microstep.
    pub microstep: u32,
}

/// One executed reaction.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct Record {
    /// When, logically.
    pub tag: TraceTag,
    /// The reactor, such as `planner.filter[2]`.
    pub path: String,
    /// The reaction's position in its reactor.
    pub index: u32,
    /// `body` or `deadline`.
    pub kind: String,
    /// Outputs written and actions scheduled with the digests of their values.
    pub effects: String,
}

/// The answer to "did both runs do the same?"
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "verdict", rename_all = "snake_case")]
pub enum Verdict {
    /// Every record is equal.
    Equal {
        /// How many records each federate has.
        records_per_federate: BTreeMap<String, usize>,
    },
    /// The runs differ.
    Different {
        /// The federate whose traces differ at the lowest tag.
        federate: String,
        /// Its first differing record in the first set; absent when that trace has no such record.
        left: Option<Record>,
        /// The record at the same place in the second set.
        right: Option<Record>,
    },
    /// Equality can be neither claimed nor denied.
    NotComparable {
        /// Why.
        why: String,
    },
}

/// Why traces cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum TraceError {
    /// The directory or a file in it cannot be read.
    #[error("cannot read {path}", path = path.display())]
    Unreadable {
        /// The directory or file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The directory has no `.trace` file.
    #[error("no trace in {path}", path = path.display())]
    Empty {
        /// The directory.
        path: PathBuf,
    },
    /// A line is not a trace record.
    #[error("{path}:{line}: not a trace record: {what}", path = path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        what: &'static str,
    },
}

impl TraceSet {
    /// Reads every `.trace` file of a directory.
    ///
    /// # Errors
    /// When a file cannot be read or a line is no record.
    pub fn read(dir: &Path) -> Result<Self, TraceError> {
        Err(TraceError::Empty {
            path: dir.to_path_buf(),
        })
    }

    /// The hash of all records: equal sets have equal hashes. 16 hexadecimal digits.
    #[must_use]
    pub fn hash(&self) -> String {
        String::new()
    }
}

/// Compares two runs; see [`Verdict`].
#[must_use]
pub fn compare(a: &TraceSet, b: &TraceSet) -> Verdict {
    let _ = (a, b);
    Verdict::NotComparable { why: String::new() }
}
