//! What runs have left on a host: traces and timing files of the last one, and the generations before it.
//!
//! | call | answer |
//! |---|---|
//! | `GET /v1/federations/NAME/recorded` | [`Recorded`], also after it was taken down |
//! | `GET /v1/federations/NAME/recorded/KIND/MEMBER?from=BYTES` | a file's bytes from there on: KIND is `trace` or `timing` |
//! | `GET /v1/federations/NAME/history` | a list of [`GenerationView`], the newest first |
//! | `GET /v1/federations/NAME/history/RUN` | [`Generation`], by the run's id |
//! | `GET /v1/names` | every federation of which anything is left |

use std::collections::BTreeMap;
use std::path::PathBuf;

use ictus_coord::plan::Plan;
use ictus_deploy::TimingSpec;
use serde::{Deserialize, Serialize};

use super::{Outcome, StartRequest};

/// What the last run of a federation has written here so far.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Recorded {
    /// What it was run from.
    pub plan: Plan,
    /// What `ictus timing` is to print.
    pub timing: TimingSpec,
    /// Bytes of each logical trace, by federate.
    pub traces: BTreeMap<String, u64>,
    /// Bytes of each timing file, by federate.
    pub timings: BTreeMap<String, u64>,
}

/// The files that a federate writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FileKind {
    /// Its logical trace.
    Trace,
    /// When its reactions ran.
    Timing,
}

impl FileKind {
    /// Its name, in paths and as the files' extension.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Trace => "trace",
            Self::Timing => "timing",
        }
    }
}

/// A run that was committed on this host.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GenerationView {
    /// Counts up with every run of the federation, over all its hosts.
    pub number: u64,
    /// The run's id, the same on all its hosts.
    pub id: String,
    /// When it was committed, nanoseconds since the Unix epoch.
    pub at_ns: i64,
    /// Who did it, in the words of the lease.
    pub who: String,
    /// The digest of all that was deployed.
    pub digest: String,
    /// How it ended; absent while it runs, and when nobody was there to see it.
    pub outcome: Option<Outcome>,
    /// Whether it can be brought back: what it was run from is still here.
    pub kept: bool,
}

/// A run that was committed here, with what it was run from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Generation {
    /// What is told of it.
    #[serde(flatten)]
    pub view: GenerationView,
    /// The digest of each thing that matters, by what it is.
    pub facets: BTreeMap<String, String>,
    /// What it was run from; absent when only its line in the history is left.
    pub request: Option<StartRequest>,
}

/// Something that a removal has left.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Kept {
    /// The directory.
    pub path: PathBuf,
    /// Bytes of the files in it.
    pub bytes: u64,
}
