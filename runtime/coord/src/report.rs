//! What a running federate or RTI says of itself, one JSON object a line on the inherited descriptor given by
//! `--status-fd`, and the exit codes both use. Writing never blocks: a full pipe drops `progress` lines only.

use crate::measure::{Downstream, Own, Upstream};
use serde::{Deserialize, Serialize};

mod clock;
mod measures;

pub use clock::{ClockSource, ClockStatus};
pub(crate) use measures::Pick;
pub use measures::{FederateMeasures, FederationMeasures, LINE_BYTES_MAX, lines};

/// Exit codes of federate programs and of the RTI.
pub mod exit {
    /// Ended at its stop tag.
    pub const OK: u8 = 0;
    /// A reaction panicked, a value could not be encoded, or another error of this program.
    pub const FAILED: u8 = 1;
    /// The RTI was lost.
    pub const RTI_LOST: u8 = 10;
    /// The federation was stopped because another federate failed.
    pub const PEER_FAILED: u8 = 11;
    /// The RTI refused the join, or could not be reached in time.
    pub const NOT_JOINED: u8 = 12;
    /// Stopped the federation after as many STP violations as the plan allows.
    pub const STP_VIOLATIONS: u8 = 14;
    /// The clock's error bound was greater than the plan allows.
    pub const CLOCK: u8 = 13;
    /// Wrong command line.
    pub const USAGE: u8 = 64;
}

/// One line of a federate's status.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum FederateStatus {
    /// The RTI accepted the join.
    Joined {
        /// The federate's name.
        federate: String,
    },
    /// The start tag is agreed.
    Start {
        /// The federate's name.
        federate: String,
        /// Nanoseconds since the Unix epoch.
        start_ns: i64,
    },
    /// The first tag is completed.
    Running {
        /// The federate's name.
        federate: String,
    },
    /// How far the federate is; about once a second while it runs.
    Progress {
        /// The federate's name.
        federate: String,
        /// The last completed tag: nanoseconds after the start tag.
        elapsed_ns: i64,
        /// The last completed tag's microstep.
        microstep: u32,
        /// Tags completed.
        tags: u64,
        /// Reactions run.
        reactions: u64,
        /// Messages sent to other federates.
        sent: u64,
        /// Messages received from other federates.
        received: u64,
        /// Deadlines missed.
        deadlines_missed: u64,
    },
    /// What the federate measured of itself; with `Progress`.
    Measures {
        /// The federate's name.
        federate: String,
        /// Which part this is when a report is told in several lines.
        #[serde(default, skip_serializing_if = "measures::is_whole")]
        part: u8,
        /// Cumulative; a histogram that is left out stays as it was.
        own: Own,
    },
    /// What the federate measured of messages from one upstream peer; with `Progress`.
    Upstream {
        /// The federate's name.
        federate: String,
        /// The peer's federate id.
        upstream: u16,
        /// As in `Measures`.
        #[serde(default, skip_serializing_if = "measures::is_whole")]
        part: u8,
        /// As in `Measures`.
        measures: Upstream,
    },
    /// What the federate measured of messages to one downstream peer; with `Progress`.
    Downstream {
        /// The federate's name.
        federate: String,
        /// The peer's federate id.
        downstream: u16,
        /// As in `Measures`.
        #[serde(default, skip_serializing_if = "measures::is_whole")]
        part: u8,
        /// As in `Measures`.
        measures: Downstream,
    },
    /// How well the federate knows physical time; with `Progress`.
    Clock {
        /// The federate's name.
        federate: String,
        /// The latest state.
        clock: ClockStatus,
    },
    /// A message came after its input had been decided; told of an upstream's first, and then at every power of ten.
    StpViolation {
        /// The federate's name.
        federate: String,
        /// The sender's federate id.
        upstream: u16,
        /// By how much this one was late, in nanoseconds.
        lateness_ns: i64,
        /// How many from this upstream so far.
        count: u64,
    },
    /// The federate's lag keeps growing.
    FallingBehind {
        /// The federate's name.
        federate: String,
        /// The lag in nanoseconds.
        lag_ns: i64,
    },
    /// The federate's lag is small again.
    CaughtUp {
        /// The federate's name.
        federate: String,
        /// The lag in nanoseconds.
        lag_ns: i64,
    },
    /// A clock was stepped: the federate's host's, or the RTI's.
    ClockStep {
        /// The federate's name.
        federate: String,
        /// How far, in nanoseconds; positive when forward.
        by_ns: i64,
    },
    /// The federate's last word; the process exits next.
    Ended {
        /// The federate's name.
        federate: String,
        /// The last completed tag: nanoseconds after the start tag.
        elapsed_ns: i64,
        /// The last completed tag's microstep.
        microstep: u32,
        /// The exit code ([`exit`]).
        code: u8,
        /// Why, in words.
        reason: String,
    },
}

/// One line of the RTI's status.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum RtiStatus {
    /// The listener is open.
    Listening {
        /// The bound TCP port.
        port: u16,
    },
    /// A federate joined.
    Joined {
        /// Its id.
        federate: u16,
    },
    /// The start tag is agreed.
    Start {
        /// Nanoseconds since the Unix epoch.
        start_ns: i64,
    },
    /// A stop was requested; by whom.
    StopRequested {
        /// The federate that asked; absent when the RTI itself did (a signal, or a failure).
        federate: Option<u16>,
    },
    /// The stop tag is agreed.
    Stop {
        /// Nanoseconds after the start tag.
        elapsed_ns: i64,
        /// Its microstep.
        microstep: u32,
    },
    /// A federate resigned.
    Resigned {
        /// Its id.
        federate: u16,
    },
    /// A federate was lost without resigning, or failed.
    Failed {
        /// Its id.
        federate: u16,
        /// The connection's end in words.
        reason: String,
    },
    /// A connection was refused.
    Rejected {
        /// The peer's address.
        peer: String,
        /// Why.
        reason: String,
    },
    /// All federates are gone; the process exits next.
    Ended {
        /// The exit code ([`exit`]).
        code: u8,
    },
}
