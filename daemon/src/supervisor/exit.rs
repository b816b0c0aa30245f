//! The exit record: how a supervised process ended, as a file that survives its supervisor.

use std::fs;
use std::io;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::ExitStatus;

use serde::{Deserialize, Serialize};

use crate::files;

/// How a supervised process ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ExitRecord {
    /// The spec's protocol version.
    pub protocol: u32,
    /// The supervisor's instance id.
    pub instance: String,
    /// The federate's name, or `rti`.
    pub name: String,
    /// The process id; absent when it never started.
    pub pid: Option<u32>,
    /// When it was started, nanoseconds since the Unix epoch.
    pub started_ns: i64,
    /// When its end was seen.
    pub ended_ns: i64,
    /// How it ended.
    #[serde(flatten)]
    pub ending: Ending,
    /// The last line it wrote to its status pipe.
    pub last_status: Option<serde_json::Value>,
    /// The last line of each kind that a later one replaces: progress, measures, the clock.
    #[serde(default)]
    pub reports: Vec<serde_json::Value>,
    /// The first lines it wrote to standard error, or to standard output when there were none.
    pub first_lines: Vec<String>,
    /// Log lines that could not be written to disk.
    pub log_lines_lost: u64,
}

/// How a process ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "ending", rename_all = "snake_case")]
pub enum Ending {
    /// It returned.
    Exited {
        /// The exit code.
        code: i32,
    },
    /// A signal killed it.
    Killed {
        /// The signal's number.
        signal: i32,
    },
    /// The kernel killed it because the memory of its container was used up. Only who owns the container knows.
    OutOfMemory,
    /// It was never started.
    NotStarted {
        /// Why.
        why: String,
    },
    /// Its supervisor vanished, and the kernel killed it with it; how it ended is not known.
    Unknown,
}

impl Ending {
    /// Tells how a waited-for process ended.
    #[must_use]
    pub fn of(status: ExitStatus) -> Self {
        match (status.code(), status.signal()) {
            (Some(code), _) => Self::Exited { code },
            (None, Some(signal)) => Self::Killed { signal },
            (None, None) => Self::Unknown,
        }
    }

    /// Says it in words: `exit code 3`, `killed by SIGKILL`.
    #[must_use]
    pub fn describe(&self) -> String {
        match self {
            Self::Exited { code } => format!("exit code {code}"),
            Self::Killed { signal } => format!("killed by {}", signal_name(*signal)),
            Self::OutOfMemory => {
                "killed by the kernel: its memory limit (`memory:`) was used up".to_owned()
            }
            Self::NotStarted { why } => format!("could not be started: {why}"),
            Self::Unknown => "vanished together with its supervisor".to_owned(),
        }
    }

    /// Whether it returned 0.
    #[must_use]
    pub fn success(&self) -> bool {
        *self == Self::Exited { code: 0 }
    }
}

impl ExitRecord {
    /// Writes the record so that after a crash it is there whole or not at all.
    ///
    /// # Errors
    /// When the file or its directory cannot be written.
    pub fn write(&self, path: &Path) -> io::Result<()> {
        files::write_durably(path, &serde_json::to_vec_pretty(self)?)
    }

    /// Reads the record of this instance; absent when there is none, or it is another's.
    #[must_use]
    pub fn read(path: &Path, instance: &str) -> Option<Self> {
        let record: Self = serde_json::from_slice(&fs::read(path).ok()?).ok()?;
        (record.instance == instance).then_some(record)
    }
}

fn signal_name(signal: i32) -> String {
    signal_hook::low_level::signal_name(signal)
        .map_or_else(|| format!("signal {signal}"), str::to_owned)
}

#[cfg(test)]
mod tests {
    use super::Ending;

    #[test]
    fn endings_are_said_in_words() {
        assert_eq!(Ending::Killed { signal: 9 }.describe(), "killed by SIGKILL");
        assert_eq!(Ending::Exited { code: 3 }.describe(), "exit code 3");
        assert!(Ending::Exited { code: 0 }.success());
    }
}
