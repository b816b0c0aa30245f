//! What a host says about itself and about the federation.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::gives::Gives;

/// A host that was asked.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Observed {
    /// It could not be asked: what is there is not known.
    Unreachable {
        /// Why, in words.
        why: String,
    },
    /// It answered.
    Reached(Box<Reached>),
}

/// What a host answered.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reached {
    /// The daemon's version.
    pub version: String,
    /// The machine, as Rust names it.
    pub arch: String,
    /// Whether Docker can be used, or why not, with the fix.
    pub docker: Result<(), String>,
    /// What federates may need and it gives.
    pub gives: Gives,
    /// Secrets whose value there is another one than asked for, or none, by federate.
    pub secrets_changed: BTreeMap<String, BTreeSet<String>>,
    /// Free bytes where blobs are kept.
    pub disk_free: u64,
    /// Where that is on the host; empty when it does not say.
    #[serde(default)]
    pub state: PathBuf,
    /// Digests of the blobs that are there; those that nobody asked for may be missing.
    pub blobs: BTreeSet<String>,
    /// What each image that was asked for and is there is for, as Rust names it.
    #[serde(default)]
    pub images: BTreeMap<String, String>,
    /// The federation's last run there; absent only when the host says that there is none.
    pub run: Result<Option<Run>, NewerRecord>,
    /// Who holds the federation's lease there; absent when nobody does, or whoever asks.
    pub lease: Option<Held>,
}

/// A record that a newer version wrote.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NewerRecord {
    /// Its version and the newest that the daemon knows, in the daemon's words.
    pub what: String,
}

/// A lease that somebody else holds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Held {
    /// Who, in its own words.
    pub who: String,
    /// Milliseconds until it is free unless it is renewed.
    pub left_ms: u64,
}

/// A run's part on a host.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Run {
    /// The run's id, the same on all its hosts.
    pub id: String,
    /// [`super::Desired::digest`] of what it was made from; empty when that is not known (a damaged record).
    pub digest: String,
    /// [`super::Desired::facets`] of it; empty when they were not kept.
    #[serde(default)]
    pub facets: BTreeMap<String, String>,
    /// Where it stands.
    pub state: RunState,
    /// `rti` and the federates of this host.
    pub members: BTreeMap<String, MemberState>,
    /// Every host of the run; empty when that is not known.
    pub hosts: BTreeSet<String>,
}

/// Where a part stands in its life.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RunState {
    /// It waits for its commit; nothing runs.
    Prepared,
    /// Not every federate has completed its first tag.
    Starting,
    /// It is healthy.
    Running,
    /// A stop was asked for.
    Stopping,
    /// Nothing runs any more.
    Ended {
        /// How it ended, in words.
        how: String,
    },
}

/// Where a member stands.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MemberState {
    /// It has not ended.
    Lives,
    /// It ended at the end of its program.
    Completed,
    /// It ended otherwise, or what runs in its place is not ours.
    Failed {
        /// How, in words.
        how: String,
    },
}

impl Observed {
    /// The answer, if there is one.
    #[must_use]
    pub fn reached(&self) -> Option<&Reached> {
        match self {
            Self::Unreachable { .. } => None,
            Self::Reached(reached) => Some(reached),
        }
    }

    /// The run that the host says is there.
    #[must_use]
    pub fn run(&self) -> Option<&Run> {
        self.reached()?.run.as_ref().ok()?.as_ref()
    }
}
