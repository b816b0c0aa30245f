//! Why a program cannot run.

use crate::assembly::AssemblyError;
use crate::clock_sync::ClockRefusal;
use ictus_coord::report::exit;
use ictus_stream::CredentialsError;
use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use thiserror::Error;

/// Why a program cannot run, or had to end at once. All are fatal for the process.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunError {
    /// The plan cannot be read.
    #[error("cannot read the plan {}: {source}", .path.display())]
    ReadPlan {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The variable of `--plan-env` is not set, or no text.
    #[error("the environment variable {name} has no plan")]
    NoPlan {
        /// Its name.
        name: String,
    },
    /// The plan is not a plan.
    #[error("{} is not a plan: {source}", .path.display())]
    ParsePlan {
        /// The file.
        path: PathBuf,
        /// Where and why.
        source: serde_json::Error,
    },
    /// `--federate` names something that is not in the plan.
    #[error("no federate {name:?} in the plan; it has {}", .known.join(", "))]
    UnknownFederate {
        /// The name given.
        name: String,
        /// The names that exist.
        known: Vec<String>,
    },
    /// A part of a plan cannot run alone.
    #[error(
        "some federates of the plan are not named: give --rti HOST:PORT, or name none to run all here"
    )]
    NeedsRti,
    /// The RTI's address has another form than `host:port`, or no IPv4 address.
    #[error("{address:?} has no IPv4 address; give --rti HOST:PORT")]
    BadAddress {
        /// As given.
        address: String,
    },
    /// The RTI did not answer in time.
    #[error("cannot connect to the RTI at {address}: {source}")]
    Connect {
        /// Where.
        address: SocketAddr,
        /// Why.
        source: io::Error,
    },
    /// The address for other federates cannot be listened on.
    #[error("cannot listen for other federates at {address}: {source}")]
    Listen {
        /// Where.
        address: SocketAddr,
        /// Why.
        source: io::Error,
    },
    /// The files of `--tls` are not this federate's certificate and key.
    #[error("--tls {}: {source}", .directory.display())]
    Credentials {
        /// Where they should be.
        directory: PathBuf,
        /// Why.
        source: CredentialsError,
    },
    /// The plan and the program do not fit.
    #[error(transparent)]
    Assembly(#[from] AssemblyError),
    /// A trace or timing file cannot be written.
    #[error("cannot write the trace: {0}")]
    Observe(io::Error),
    /// The descriptor of `--status-fd` cannot be written.
    #[error("cannot write status lines: {0}")]
    Status(io::Error),
    /// The system does not let the memory be locked (`realtime: { lock_memory: true }`). Raise the limit `memlock`.
    #[error("cannot lock memory: {0}; raise the limit `memlock`")]
    LockMemory(io::Error),
    /// The system refused to wait or to make a descriptor.
    #[error("system error: {0}")]
    Io(io::Error),
    /// The clock is too uncertain to start.
    #[error(transparent)]
    Clock(#[from] ClockRefusal),
    /// A second signal, or one before the start.
    #[error("interrupted")]
    Interrupted,
}

impl RunError {
    /// The process's exit code.
    #[must_use]
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::UnknownFederate { .. } | Self::NeedsRti | Self::BadAddress { .. } => exit::USAGE,
            Self::Connect { .. } | Self::Credentials { .. } => exit::NOT_JOINED,
            Self::Clock(_) => exit::CLOCK,
            Self::ReadPlan { .. }
            | Self::NoPlan { .. }
            | Self::ParsePlan { .. }
            | Self::Assembly(_)
            | Self::Observe(_)
            | Self::Status(_)
            | Self::LockMemory(_)
            | Self::Listen { .. }
            | Self::Io(_)
            | Self::Interrupted => exit::FAILED,
        }
    }
}
