//! Why nothing can be planned.

use std::fmt;
use std::path::PathBuf;

use super::plan::listed;

/// Why there is no plan: every reason of every host.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub struct Refusal {
    /// In the order of the hosts; not empty.
    pub reasons: Vec<Reason>,
}

/// Why a host stands in the way.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Reason {
    /// It could not be asked.
    #[error("host `{host}` cannot be reached: {why}")]
    Unreachable {
        /// The host.
        host: String,
        /// Why.
        why: String,
    },
    /// A run has a part there, but nobody asked it.
    #[error("host `{host}` was not asked, and run {run} has a part there")]
    NotAsked {
        /// The host.
        host: String,
        /// The run.
        run: String,
    },
    /// Programs are for another machine.
    #[error(
        "host `{host}` is {arch}, but the program of {federates} is for {program}",
        federates = listed("federate", federates)
    )]
    Architecture {
        /// The host.
        host: String,
        /// Its machine.
        arch: String,
        /// The program's.
        program: String,
        /// Who executes it.
        federates: Vec<String>,
    },
    /// An image is for another machine.
    #[error(
        "host `{host}` is {arch}, but image {image} of {federates} is for {found}",
        federates = listed("federate", federates)
    )]
    ImageArchitecture {
        /// The host.
        host: String,
        /// Its machine.
        arch: String,
        /// The image.
        image: String,
        /// The image's.
        found: String,
        /// Who runs in it.
        federates: Vec<String>,
    },
    /// It cannot run containers.
    #[error("host `{host}` has no Docker that can be used: {why}")]
    Engine {
        /// The host.
        host: String,
        /// Why, with the fix.
        why: String,
    },
    /// Its daemon is too old.
    #[error("host `{host}` has ictusd {theirs}, which is too old for ictus {ours}")]
    DaemonOlder {
        /// The host.
        host: String,
        /// Its version.
        theirs: String,
        /// Ours.
        ours: String,
    },
    /// Its daemon is newer.
    #[error("host `{host}` has ictusd {theirs}, which is newer than ictus {ours}")]
    DaemonNewer {
        /// The host.
        host: String,
        /// Its version.
        theirs: String,
        /// Ours.
        ours: String,
    },
    /// Its record is newer than its daemon.
    #[error(
        "the record on host `{host}` was written by a newer ictusd than the one that is there: {what}"
    )]
    RecordNewer {
        /// The host.
        host: String,
        /// The two versions.
        what: String,
    },
    /// Somebody else is at it.
    #[error(
        "{who} holds the lease on host `{host}`, for another {seconds} s unless it is renewed",
        seconds = left_ms.div_ceil(1000)
    )]
    Held {
        /// The host.
        host: String,
        /// Who.
        who: String,
        /// Milliseconds until it is free.
        left_ms: u64,
    },
    /// It does not give a federate what it needs.
    #[error("host `{host}` cannot give federate `{federate}` {what}")]
    Lacks {
        /// The host.
        host: String,
        /// Who needs it.
        federate: String,
        /// What, and why not.
        what: String,
        /// What to do about it.
        fix: String,
    },
    /// What is sent does not fit.
    #[error(
        "host `{host}` has {free} bytes free at {path}, but {needed} bytes are to be sent",
        path = path.display()
    )]
    Disk {
        /// The host.
        host: String,
        /// Where it would be kept.
        path: PathBuf,
        /// Free bytes.
        free: u64,
        /// Bytes to send.
        needed: u64,
    },
}

impl Reason {
    /// The host.
    #[must_use]
    pub fn host(&self) -> &str {
        match self {
            Self::Unreachable { host, .. }
            | Self::NotAsked { host, .. }
            | Self::Architecture { host, .. }
            | Self::ImageArchitecture { host, .. }
            | Self::Engine { host, .. }
            | Self::DaemonOlder { host, .. }
            | Self::DaemonNewer { host, .. }
            | Self::RecordNewer { host, .. }
            | Self::Held { host, .. }
            | Self::Lacks { host, .. }
            | Self::Disk { host, .. } => host,
        }
    }

    /// What to do about it.
    #[must_use]
    pub fn fix(&self) -> String {
        match self {
            Self::Unreachable { host, .. } => format!(
                "see that `ssh` reaches it; what runs on `{host}` is unknown, so nothing is changed anywhere"
            ),
            Self::NotAsked { host, .. } => {
                format!("name it with `--host {host}`, or among the manifest's hosts")
            }
            Self::Architecture { arch, .. } => {
                format!("build the program for {arch}, or place the federate on another host")
            }
            Self::ImageArchitecture { arch, .. } => {
                format!("make or pull the image for {arch}, or place the federate on another host")
            }
            Self::Engine { .. } => {
                "make Docker usable there, or use `engine: process` for that host".to_owned()
            }
            Self::DaemonOlder { host, .. } | Self::RecordNewer { host, .. } => {
                format!("`ictus host upgrade {host}` installs this version there")
            }
            Self::DaemonNewer { theirs, .. } => format!("use ictus {theirs} here"),
            Self::Held { .. } => {
                "wait for it; if whoever held it is gone, `ictus lock break` frees it".to_owned()
            }
            Self::Lacks { fix, .. } => fix.clone(),
            Self::Disk { host, path, .. } => format!(
                "free space on `{host}` (`df {path}` there), or place federates on another host",
                path = path.display()
            ),
        }
    }
}

impl fmt::Display for Refusal {
    /// A line for each reason, each with its fix.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, reason) in self.reasons.iter().enumerate() {
            let newline = if index == 0 { "" } else { "\n" };
            write!(f, "{newline}{reason}; {}", reason.fix())?;
        }
        Ok(())
    }
}
