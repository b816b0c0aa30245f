//! The API's types, version 1: JSON over HTTP on the daemon's Unix socket.
//!
//! | call | answer |
//! |---|---|
//! | `GET /v1/info` | [`Info`] |
//! | `GET /v1/federations`, `GET /v1/federations/NAME` | [`FederationView`], a list of them |
//! | `POST /v1/federations/NAME` with a [`secret::StartCall`] | a stream of [`Happening`], one a line, until the federation ends; closing it before `healthy` undoes the start |
//! | `POST /v1/federations/NAME/stop?kill=BOOL` | the same stream until the end |
//! | `DELETE /v1/federations/NAME?purge=BOOL&keep_history=BOOL` | [`Removed`], when nothing runs any more |
//! | `GET /v1/federations/NAME/measures` | [`FederationMeasures`], until it is taken down |
//! | `GET /v1/federations/NAME/logs?follow=BOOL&federate=A,B&tail=N` | a stream of [`LogLine`] |
//! | `GET /v1/events?follow=BOOL&federation=NAME` | a stream of [`Happening`] |
//! | `GET /metrics` | all federations as Prometheus reads it; with `metrics.listen` also over TCP, with `GET /healthz` |
//! | `POST /v1/end` | ends the daemon if it owns nothing |
//! | `POST /v1/give-way` | ends the daemon whatever it owns: federations go on, and the next daemon takes them over |
//!
//! Whoever may only look has a socket of its own, `viewer.sock`: `GET` alone, and neither logs nor generations' requests.
//!
//! Errors are [`ApiError`] with a status of 400 and up.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;

use ictus_coord::plan::Plan;
use ictus_coord::report::exit;
pub use ictus_coord::report::{FederateMeasures, FederationMeasures};
use ictus_deploy::{FederateRun, Settings, TimingSpec};
use serde::{Deserialize, Serialize};

use crate::supervisor::exit::Ending;

pub mod part;
pub mod reach;
pub mod recorded;
pub mod secret;

use part::Part;
use recorded::Kept;

/// The version in every path.
pub const VERSION: &str = "v1";

/// Who answers.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Info {
    /// [`VERSION`].
    pub api: String,
    /// The daemon's crate version.
    pub version: String,
    /// Its process id.
    pub pid: u32,
    /// Where it keeps records and logs.
    pub state_dir: PathBuf,
}

/// What to run: the checked manifest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StartRequest {
    /// The manifest it came from; for messages only.
    pub manifest: PathBuf,
    /// The working directory of every federate; of a part, its own.
    pub cwd: PathBuf,
    /// The resolved plan.
    pub plan: Plan,
    /// How each federate of the plan is run, in its order.
    pub federates: Vec<FederateRun>,
    /// Bounds and the RTI's port.
    pub settings: Settings,
    /// What `ictus timing` will print.
    pub timing: TimingSpec,
    /// Whether federates write their logical traces.
    pub trace: bool,
    /// Which part of it is this host's; absent: all of it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub part: Option<Part>,
}

/// A federation as it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FederationView {
    /// Its name.
    pub name: String,
    /// Where it stands in its life.
    pub state: State,
    /// The random id of this run, which RTI and federates share.
    pub id: String,
    /// When this run was started, nanoseconds since the Unix epoch.
    pub since_ns: i64,
    /// The manifest.
    pub manifest: PathBuf,
    /// Where records, logs, traces and timing files are.
    pub directory: PathBuf,
    /// The RTI's port once it listens.
    pub rti_port: Option<u16>,
    /// Where metrics are served over TCP, if they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub metrics: Option<SocketAddr>,
    /// The start tag once it is agreed.
    pub start_ns: Option<i64>,
    /// The RTI.
    pub rti: MemberView,
    /// The federates, in the plan's order.
    pub federates: Vec<MemberView>,
    /// How it ended.
    pub outcome: Option<Outcome>,
    /// Which part of the federation this is; absent: all of it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub part: Option<Part>,
    /// A digest of what it was prepared from, by which a later `up` knows whether anything has changed.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub digest: String,
    /// The digest of each thing that matters, by what it is.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub facets: BTreeMap<String, String>,
    /// The number that was proposed for this run in the federation's history.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub generation: Option<u64>,
}

/// Where a federation stands in its life.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// A part that waits for its commit; nothing runs.
    Prepared,
    /// Not every federate has completed its first tag.
    Starting,
    /// Every federate has.
    Running,
    /// A stop was asked for, or something failed.
    Stopping,
    /// Nothing runs any more; see the outcome.
    Ended,
    /// Nothing runs: its secrets went with the host's memory when that was started again; the next `up` starts it.
    WaitingForSecrets,
}

/// The RTI or a federate as it is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MemberView {
    /// `rti`, or the federate's name.
    pub name: String,
    /// One of [`MemberView::STATES`].
    pub state: String,
    /// Its process id once it was started.
    pub pid: Option<u32>,
    /// How far it is: nanoseconds after the start tag.
    pub elapsed_ns: Option<i64>,
    /// Tags completed.
    pub tags: Option<u64>,
    /// Reactions run.
    pub reactions: Option<u64>,
    /// Deadlines missed.
    pub deadlines_missed: Option<u64>,
    /// How it ended, in words.
    pub ending: Option<String>,
    /// How it ended, for programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exit: Option<ExitReason>,
}

impl MemberView {
    /// Every state, in the order in which a member comes to it.
    pub const STATES: [&str; 7] = [
        "waiting",
        "launching",
        "up",
        "joined",
        "running",
        "ended",
        "foreign",
    ];

    /// Whether its process runs.
    #[must_use]
    pub fn lives(&self) -> bool {
        ["up", "joined", "running"].contains(&self.state.as_str())
    }
}

/// How a process ended, in a few words.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ExitReason {
    /// At its end.
    Completed,
    /// With an error of its own.
    Failed,
    /// It lost the RTI.
    RtiLost,
    /// Another federate failed.
    PeerFailed,
    /// It could not join.
    NotJoined,
    /// Its clock's error bound was greater than the plan allows.
    Clock,
    /// It had as many STP violations as the plan allows.
    StpViolations,
    /// A signal killed it.
    Killed,
    /// It was never started.
    NotStarted,
    /// It vanished together with its supervisor.
    Unknown,
}

impl ExitReason {
    /// What an ending amounts to.
    #[must_use]
    pub fn of(ending: &Ending) -> Self {
        match ending {
            Ending::Exited { code } => match u8::try_from(*code) {
                Ok(exit::OK) => Self::Completed,
                Ok(exit::RTI_LOST) => Self::RtiLost,
                Ok(exit::PEER_FAILED) => Self::PeerFailed,
                Ok(exit::NOT_JOINED) => Self::NotJoined,
                Ok(exit::CLOCK) => Self::Clock,
                Ok(exit::STP_VIOLATIONS) => Self::StpViolations,
                Ok(_) | Err(_) => Self::Failed,
            },
            Ending::Killed { .. } | Ending::OutOfMemory => Self::Killed,
            Ending::NotStarted { .. } => Self::NotStarted,
            Ending::Unknown => Self::Unknown,
        }
    }

    /// Its name, as in JSON and in metrics.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Completed => "completed",
            Self::Failed => "failed",
            Self::RtiLost => "rti_lost",
            Self::PeerFailed => "peer_failed",
            Self::NotJoined => "not_joined",
            Self::Clock => "clock",
            Self::StpViolations => "stp_violations",
            Self::Killed => "killed",
            Self::NotStarted => "not_started",
            Self::Unknown => "unknown",
        }
    }
}

/// How a run ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "outcome", rename_all = "snake_case")]
pub enum Outcome {
    /// Every federate reached the end of its program.
    Completed,
    /// It was stopped by request.
    Stopped {
        /// Federates that did not reach the stop tag in time and ended on SIGTERM. When one had to be killed
        /// it is [`Outcome::Failed`].
        missed: Vec<String>,
    },
    /// It failed; what was running was stopped.
    Failed {
        /// The first cause.
        failure: Failure,
        /// Whether it had been healthy before.
        was_healthy: bool,
    },
    /// Who started it went away before it was healthy, and everything was undone.
    Aborted,
}

/// What went wrong first.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    /// What kind of thing.
    pub kind: FailureKind,
    /// `rti` or the federate; absent when it is the federation as a whole.
    pub member: Option<String>,
    /// How likely it is a consequence of another one: 0 is a cause. Of several parts' failures the lowest and earliest
    /// is the one to tell.
    #[serde(default)]
    pub rank: u8,
    /// What happened, in words.
    pub what: String,
    /// Why, in the member's own words, if it has said so.
    #[serde(default)]
    pub reason: Option<String>,
    /// The first lines that the member wrote.
    pub lines: Vec<String>,
    /// Its log file.
    pub log: Option<PathBuf>,
    /// When, nanoseconds since the Unix epoch.
    pub at_ns: i64,
}

impl Failure {
    /// What happened, and why.
    #[must_use]
    pub fn words(&self) -> String {
        match &self.reason {
            Some(reason) => format!("{}: {reason}", self.what),
            None => self.what.clone(),
        }
    }
}

/// The kinds of failure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FailureKind {
    /// A process ended that should not have.
    Process,
    /// Not everybody was there in time.
    Timeout,
    /// A record names a process that is not ours; it was not touched.
    Foreign,
    /// A newer version wrote the record.
    NewerRecord,
}

/// Something that happened to a federation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Happening {
    /// When, nanoseconds since the Unix epoch.
    pub at_ns: i64,
    /// To which federation.
    pub federation: String,
    /// What.
    #[serde(flatten)]
    pub event: Event,
}

/// What can happen to a federation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// A process was started.
    Started {
        /// `rti` or the federate.
        member: String,
        /// Its process id.
        pid: u32,
        /// Processes started so far, the RTI not counted.
        started: usize,
        /// Federates in all.
        of: usize,
    },
    /// The RTI listens.
    Listening {
        /// Its TCP port on the loopback interface.
        port: u16,
    },
    /// A federate joined.
    Joined {
        /// Which.
        federate: String,
        /// Federates joined so far.
        joined: usize,
        /// Federates in all.
        of: usize,
    },
    /// The start tag is agreed.
    StartTag {
        /// Nanoseconds since the Unix epoch.
        start_ns: i64,
    },
    /// A federate completed its first tag.
    Running {
        /// Which.
        federate: String,
        /// Federates running so far; foreign ones do not say and are not counted.
        running: usize,
        /// Federates that say.
        of: usize,
    },
    /// Everything runs.
    Healthy,
    /// The RTI refused a connection.
    Rejected {
        /// The peer's address.
        peer: String,
        /// Why.
        reason: String,
    },
    /// A stop was asked for.
    StopRequested {
        /// By whom: a federate, `rti`, or `user`.
        by: String,
    },
    /// The stop tag is agreed.
    StopTag {
        /// Nanoseconds after the start tag.
        elapsed_ns: i64,
        /// Its microstep.
        microstep: u32,
    },
    /// A federate left the federation by protocol.
    Resigned {
        /// Which.
        federate: String,
    },
    /// The RTI lost a federate.
    Lost {
        /// Which.
        federate: String,
        /// The connection's end, in words.
        reason: String,
    },
    /// A process ended.
    Exited {
        /// `rti` or the federate.
        member: String,
        /// How, in words.
        how: String,
        /// Its own last words, if it said why.
        reason: Option<String>,
    },
    /// Messages from a federate come after their input has been decided: told of the first, and then of every tenfold.
    StpViolation {
        /// The receiver.
        federate: String,
        /// The sender.
        upstream: String,
        /// By how much this one was late, in nanoseconds.
        lateness_ns: i64,
        /// How many from this sender so far.
        count: u64,
    },
    /// A federate's lag keeps growing.
    FallingBehind {
        /// Which.
        federate: String,
        /// The lag in nanoseconds.
        lag_ns: i64,
    },
    /// A federate's lag is small again.
    CaughtUp {
        /// Which.
        federate: String,
        /// The lag in nanoseconds.
        lag_ns: i64,
    },
    /// A clock was stepped: that of the federate's host, or the RTI's.
    ClockStep {
        /// The federate that noticed.
        federate: String,
        /// How far, in nanoseconds; positive when forward.
        by_ns: i64,
    },
    /// These did not end in time and were sent a signal.
    Signalled {
        /// `SIGTERM` or `SIGKILL`.
        signal: String,
        /// Who.
        members: Vec<String>,
    },
    /// A recorded process is not ours and is left alone.
    Foreign {
        /// `rti` or the federate.
        member: String,
        /// How it was told.
        why: String,
    },
    /// Nothing runs any more. The last event of a run.
    Ended {
        /// How it ended.
        #[serde(flatten)]
        outcome: Outcome,
    },
}

/// What a removal left and took away.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Removed {
    /// How the run ended, if one was stopped for it or had ended before.
    pub outcome: Option<Outcome>,
    /// What is left on disk.
    pub kept: Vec<Kept>,
}

/// A line of a log.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct LogLine {
    /// When the supervisor read it, as [`crate::stamp::text`] writes it.
    pub time: String,
    /// `rti` or the federate.
    pub member: String,
    /// `out`, `err`, `out+`, `err+`, `ictus`: see [`crate::supervisor`].
    pub stream: String,
    /// The text.
    pub text: String,
}

/// Why a request was refused.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ApiError {
    /// The reason, for programs.
    pub code: ErrorCode,
    /// The reason, for people: lower-case, without full stop.
    pub message: String,
    /// Names that would have been right.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub known: Vec<String>,
}

/// The reasons for refusing a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ErrorCode {
    /// The request is malformed.
    BadRequest,
    /// Who asks may only look.
    Forbidden,
    /// There is no such federation.
    Unknown,
    /// A federation of this name runs, from the same plan.
    AlreadyRunning,
    /// A federation of this name runs, from another plan.
    Conflict,
    /// Somebody else holds the lease, or held it since: the number is not the last that was given.
    Held,
    /// The daemon could not do its part: the disk, a process.
    Failed,
}
