//! The one entry: a manifest's path in, a checked federation or every mistake out.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use ictus_coord::plan::{ClockSync, Plan};
use serde::{Deserialize, Serialize};

use crate::problem::{Problem, Problems};
use crate::timing::TimingSpec;

/// How much [`check`] may do.
#[derive(Clone, Debug)]
pub struct CheckOptions {
    /// Build and describe the programs. False (`--no-build`): no code of the manifest runs, neither a
    /// build script nor a program, and ports, types and loops are not checked.
    pub build: bool,
    /// Build with `--release`; else the `dev` profile.
    pub release: bool,
    /// How long one `PROGRAM --describe` may take.
    pub describe_timeout: Duration,
    /// Cargo's target directory; absent: `CARGO_TARGET_DIR` of the environment or cargo's own choice.
    pub target_dir: Option<PathBuf>,
    /// Values for names of the manifest's `let`, as written there (`--set half="0 ms"`).
    pub overrides: BTreeMap<String, String>,
}

impl Default for CheckOptions {
    /// Builds in release, ten seconds for a describe, no overrides.
    fn default() -> Self {
        Self {
            build: true,
            release: true,
            describe_timeout: Duration::from_secs(10),
            target_dir: None,
            overrides: BTreeMap::new(),
        }
    }
}

/// What [`check`] is doing; for a progress line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Progress {
    /// Cargo is about to build a program.
    Building {
        /// The manifest's name of the program.
        program: String,
    },
    /// Cargo finished one package of a build.
    Compiled {
        /// The manifest's name of the program.
        program: String,
        /// The package that cargo finished.
        package: String,
    },
    /// The program's executable is there.
    Built {
        /// The manifest's name of the program.
        program: String,
        /// Its executable.
        executable: PathBuf,
    },
    /// The program has said what its federates look like.
    Described {
        /// The manifest's name of the program.
        program: String,
        /// How many federates it described.
        federates: usize,
    },
}

/// A federation without a mistake, ready to run.
#[derive(Clone, Debug, PartialEq)]
pub struct Checked {
    /// The manifest, as an absolute path.
    pub manifest: PathBuf,
    /// The resolved plan. After a check without build it is provisional: widths, default serializers and
    /// types are not known, so nothing may be run from it.
    pub plan: Plan,
    /// One per federate of the plan, in its order. Empty after a check without build.
    pub federates: Vec<FederateRun>,
    /// What the manifest says about the run itself.
    pub settings: Settings,
    /// What `ictus timing` prints, resolved to reactor paths and reaction indices. Empty after a check
    /// without build.
    pub timing: TimingSpec,
    /// The executable that has every class, for the run in one process; absent when federates come from
    /// several programs or one is foreign.
    pub one_program: Option<PathBuf>,
    /// What is legal but probably not meant.
    pub warnings: Vec<Problem>,
}

/// How one federate is run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FederateRun {
    /// Index into the plan's federates and id on the wire.
    pub id: u16,
    /// The federate's name.
    pub name: String,
    /// The program to execute, an absolute path.
    pub executable: PathBuf,
    /// Who wrote it.
    pub kind: FederateKind,
    /// Environment variables to add.
    pub env: BTreeMap<String, String>,
}

/// Whose command line a federate's program understands.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FederateKind {
    /// Ours: `--plan`, `--federate`, `--rti`, `--status-fd`, ...
    Ours,
    /// A prebuilt Lingua Franca federate: only what LF's launch script gives (`-i ID`), then these.
    Foreign {
        /// Further arguments, from the manifest.
        args: Vec<String>,
    },
}

/// What the manifest says about the run itself.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Settings {
    /// The RTI's TCP port; absent: any free one.
    pub rti_port: Option<u16>,
    /// How long federates may take to join.
    pub join_timeout: Duration,
    /// How long an ordered stop may take before processes are killed.
    pub stop_grace: Duration,
    /// Bytes of one log file before it is rotated.
    pub log_max_size: u64,
    /// Log files kept per federate.
    pub log_max_files: u32,
    /// Whether clocks are compared with the RTI's before the start.
    pub clock: ClockSync,
}

impl Default for Settings {
    /// Any port, 30 s to join, 5 s to stop, three logs of 10 MiB, no clock exchanges.
    fn default() -> Self {
        Self {
            rti_port: None,
            join_timeout: Duration::from_secs(30),
            stop_grace: Duration::from_secs(5),
            log_max_size: 10 << 20,
            log_max_files: 3,
            clock: ClockSync::Off,
        }
    }
}

/// Reads a manifest, builds and describes its programs, and checks everything that can be known before a
/// run.
///
/// # Errors
/// Every mistake found, in the order of the manifest's lines.
pub fn check(
    manifest: &Path,
    options: &CheckOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<Checked, Problems> {
    let _ = (manifest, options, progress);
    Err(Problems::default())
}

/// The JSON Schema of the manifest.
#[must_use]
pub fn schema() -> serde_json::Value {
    serde_json::Value::Null
}
