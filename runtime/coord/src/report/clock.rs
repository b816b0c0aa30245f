//! How well a federate knows physical time.

use serde::{Deserialize, Serialize};
use std::fmt;

/// The state of a federate's clock.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ClockStatus {
    /// Who vouches for the clock.
    pub source: ClockSource,
    /// What is added to the host's clock, in nanoseconds; for an external source what that says it is off by.
    pub offset_ns: i64,
    /// How much faster than its reference the host's clock runs, in parts per 10^9.
    pub drift_ppb: i64,
    /// E: how far the corrected clock may be from its reference, in nanoseconds; absent when nothing is known.
    pub bound_ns: Option<i64>,
    /// Whether the source says that it is synchronized.
    pub synchronized: bool,
    /// Probe exchanges that were used.
    pub probes_kept: u64,
    /// Probe exchanges that were dropped because their spacing did not survive or an answer was missing.
    pub probes_dropped: u64,
    /// Datagrams that no probe of the RTI's can have been.
    pub strangers: u64,
    /// Steps noticed, of either side's clock.
    pub steps: u64,
}

/// Who vouches for a federate's clock.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum ClockSource {
    /// Nobody: the host's clock as it is.
    #[default]
    None,
    /// Probes between the federate and the RTI.
    Builtin,
    /// chronyd.
    Chrony,
    /// ptp4l.
    Ptp4l,
    /// systemd-timesyncd.
    Timesyncd,
    /// The kernel's own account (`adjtimex`).
    Kernel,
}

impl ClockSource {
    /// All of them.
    pub const ALL: [Self; 6] = [
        Self::None,
        Self::Builtin,
        Self::Chrony,
        Self::Ptp4l,
        Self::Timesyncd,
        Self::Kernel,
    ];

    /// Its name, as in status lines and metrics.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Builtin => "builtin",
            Self::Chrony => "chrony",
            Self::Ptp4l => "ptp4l",
            Self::Timesyncd => "timesyncd",
            Self::Kernel => "kernel",
        }
    }
}

impl fmt::Display for ClockSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
