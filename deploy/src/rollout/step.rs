//! One thing that one host is asked to do.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Index of a step in its plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct StepId(pub usize);

/// One thing that one host is asked to do.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Step {
    /// Its index.
    pub id: StepId,
    /// Which host.
    pub host: String,
    /// What it is asked.
    #[serde(flatten)]
    pub operation: Operation,
    /// Why, in words.
    pub cause: String,
    /// What has to be done before it begins; all have lower ids.
    pub needs: Vec<StepId>,
    /// How long it may take, in milliseconds.
    pub limit_ms: u64,
}

/// What a host can be asked to do. All but the lease repeat the lease's number.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "operation", rename_all = "snake_case")]
pub enum Operation {
    /// Takes the federation's lease, and then asks which run is there.
    Lease,
    /// Sends a file.
    SendBlob {
        /// Its SHA-256.
        digest: String,
        /// Its size.
        bytes: u64,
    },
    /// Sends an image, but for the layers that are there.
    SendImage {
        /// Its id where it is sent from.
        image: String,
        /// Its size.
        bytes: u64,
    },
    /// Stops the run that is there in order; one that was not begun never will be; one that has ended stays as it is.
    StopOld {
        /// Its id.
        run: String,
    },
    /// Removes the run that is there, which does not run any more; when none is there, nothing happens.
    RemoveOld {
        /// Its id; absent: whatever is left of the federation.
        run: Option<String>,
        /// Also logs, earlier generations and its blobs.
        purge: bool,
    },
    /// Prepares the new run's part.
    Prepare {
        /// The ended run that it takes the place of; another one is a conflict.
        previous: Option<String>,
    },
    /// Begins the part that has the RTI; done when the RTI listens.
    CommitRti,
    /// Begins a part that has no RTI; done when the host has taken it.
    Commit,
    /// Waits until the part is healthy.
    AwaitHealthy,
    /// Undoes a part of the new run that was not begun: when another run is there, or none, nothing happens. A record
    /// that is damaged is the new run's: the one that was there before does not run any more.
    RemovePart {
        /// The new run's id.
        run: String,
    },
    /// Ends a part of the new run in order, and undoes one that was not begun; when another run is there, or none,
    /// nothing happens.
    StopPart {
        /// The new run's id.
        run: String,
    },
    /// Gives the lease back; its number is worth nothing afterwards.
    Release,
}

impl Operation {
    /// Its name, as in JSON.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Lease => "lease",
            Self::SendBlob { .. } => "send_blob",
            Self::SendImage { .. } => "send_image",
            Self::StopOld { .. } => "stop_old",
            Self::RemoveOld { .. } => "remove_old",
            Self::Prepare { .. } => "prepare",
            Self::CommitRti => "commit_rti",
            Self::Commit => "commit",
            Self::AwaitHealthy => "await_healthy",
            Self::RemovePart { .. } => "remove_part",
            Self::StopPart { .. } => "stop_part",
            Self::Release => "release",
        }
    }
}

impl fmt::Display for Operation {
    /// What is done, in words.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Lease => "taking the lease",
            Self::SendBlob { .. } => "sending a program",
            Self::SendImage { .. } => "sending an image",
            Self::StopOld { .. } => "stopping the run that was there",
            Self::RemoveOld { .. } => "removing the run that was there",
            Self::Prepare { .. } => "preparing",
            Self::CommitRti => "starting the RTI",
            Self::Commit => "starting",
            Self::AwaitHealthy => "waiting until it is healthy",
            Self::RemovePart { .. } => "undoing",
            Self::StopPart { .. } => "stopping",
            Self::Release => "giving the lease back",
        })
    }
}
