//! The control protocol: one JSON object a line, both ways, on the supervisor's socket.
//!
//! Every request but `subscribe` has exactly one reply. `subscribe` is answered with everything that
//! happened so far and then, as it happens, with everything else.

use serde::{Deserialize, Serialize};

use super::exit::ExitRecord;
use crate::identity::ProcessIdentity;

/// What a client may ask.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "op", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// Who are you?
    Identify,
    /// How far is the process?
    Status,
    /// Tell everything, from the beginning.
    Subscribe,
    /// Send the process a signal, through its pidfd.
    Signal {
        /// Which.
        signal: StopSignal,
    },
    /// The exit record has been read; the supervisor may end.
    Release,
}

/// The signals a supervisor sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StopSignal {
    /// SIGTERM: asks for an ordered stop.
    Term,
    /// SIGKILL.
    Kill,
}

/// What a supervisor says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "reply", rename_all = "snake_case")]
pub enum Reply {
    /// To [`Request::Identify`].
    Identity {
        /// The protocol version.
        protocol: u32,
        /// The random id of the spec.
        instance: String,
        /// The supervisor itself.
        supervisor: ProcessIdentity,
    },
    /// To [`Request::Status`].
    Status {
        /// The process id while it runs.
        pid: Option<u32>,
        /// The last status line.
        last: Option<serde_json::Value>,
    },
    /// To [`Request::Signal`] and [`Request::Release`].
    Done,
    /// The request could not be carried out.
    Refused {
        /// Why.
        why: String,
    },
    /// To a subscriber: the process was started.
    Started {
        /// Its id.
        pid: u32,
        /// When, nanoseconds since the Unix epoch.
        at_ns: i64,
    },
    /// To a subscriber: a line from the status pipe.
    Reported {
        /// When it was read.
        at_ns: i64,
        /// The line.
        line: serde_json::Value,
    },
    /// To a subscriber: the process has ended, and the record is on disk. Nothing follows.
    Ended {
        /// How.
        record: Box<ExitRecord>,
    },
}
