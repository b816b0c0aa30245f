//! What a supervisor is told to run: a JSON file, written by the daemon.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::limits::Limits;

/// The version of the spec, of the control protocol and of the exit record.
pub const PROTOCOL: u32 = 1;

/// One process to run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spec {
    /// Always [`PROTOCOL`]; a newer one is refused.
    pub protocol: u32,
    /// The random id that the supervisor answers with.
    pub instance: String,
    /// The federate's name, or `rti`.
    pub name: String,
    /// The executable, an absolute path. There is no shell.
    pub program: PathBuf,
    /// Its arguments, without the program.
    pub args: Vec<String>,
    /// Its whole environment.
    pub env: BTreeMap<String, String>,
    /// Its working directory.
    pub cwd: PathBuf,
    /// What it is bound to.
    #[serde(default, skip_serializing_if = "Limits::is_empty")]
    pub limits: Limits,
    /// Whether to give it a status pipe and add `--status-fd N` to its arguments.
    pub status: bool,
    /// The log file; older ones get `.1`, `.2`, ... appended.
    pub log: PathBuf,
    /// Bytes of one log file before it is rotated.
    pub log_size_max: u64,
    /// Log files kept, the current one included; at least 1.
    pub log_files_max: u32,
    /// Where the supervisor listens.
    pub socket: PathBuf,
    /// Where the exit record is written.
    pub exit_record: PathBuf,
    /// How long, in milliseconds, the supervisor waits for somebody to read the exit record from it.
    pub linger_ms: u32,
}

/// Why there is no spec.
#[derive(Debug, thiserror::Error)]
pub enum SpecError {
    /// The file cannot be read.
    #[error("cannot read {path}", path = path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The file is no spec of this version.
    #[error("{path} is not a spec", path = path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Why.
        source: serde_json::Error,
    },
    /// The spec is of another version. Use the `ictus` that wrote it.
    #[error("{path} is of protocol {found}; this is {PROTOCOL}", path = path.display())]
    Protocol {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: u32,
    },
}

impl Spec {
    /// Reads a spec file.
    ///
    /// # Errors
    /// See [`SpecError`].
    pub fn read(path: &Path) -> Result<Self, SpecError> {
        let at = || path.to_path_buf();
        let text = fs::read(path).map_err(|source| SpecError::Unreadable { path: at(), source })?;
        let spec: Self = serde_json::from_slice(&text)
            .map_err(|source| SpecError::Malformed { path: at(), source })?;
        if spec.protocol != PROTOCOL {
            return Err(SpecError::Protocol {
                path: at(),
                found: spec.protocol,
            });
        }
        Ok(spec)
    }
}
