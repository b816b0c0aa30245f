//! Runs the federation of `federation.yaml` once: the RTI and four federates, each a process.

use crate::order::Tally;
use crate::part::{Part, PartError};
use ictus_coord::plan::{Coordination, Plan};
use ictus_coord::report::{FederateStatus, RtiStatus};
use ictus_deploy::{CheckOptions, Problems, check};
use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;
use thiserror::Error;

/// The first argument that makes this program an RTI.
pub(crate) const RTI: &str = "rti";

const MANIFEST: &str = include_str!("../federation.yaml");
/// The federation id of every run.
const FEDERATION: &str = "inconsistency";
/// The federate that counts.
const PLANNER: &str = "planner";
/// How long a process may take to start.
const START: Duration = Duration::from_secs(20);
/// How much longer than its logical time a run may take.
const SLACK: Duration = Duration::from_secs(120);
/// From the last message to the timeout.
const REST: Duration = Duration::from_millis(500);

/// Why there is no result.
#[derive(Debug, Error)]
pub(crate) enum RunError {
    /// A file cannot be written or read.
    #[error("{path}: {source}", path = path.display())]
    File { path: PathBuf, source: io::Error },
    /// The manifest is refused with these values.
    #[error(transparent)]
    Manifest(#[from] Problems),
    /// A process failed.
    #[error(transparent)]
    Part(#[from] PartError),
    /// A wrong order came about without a counted STP violation, which is a bug of Ictus.
    #[error("in {0} runs a wrong order was no counted STP violation")]
    Law(usize),
}

/// Who brings the messages from the nodes to the planner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum System {
    /// The RTI grants tags.
    Centralized,
    /// The planner waits for its STP offset.
    Decentralized(Offset),
    /// A broker, without tags.
    Mqtt {
        /// Quality of service: 0 or 1.
        qos: u8,
    },
}

/// The planner's STP offset.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Offset {
    /// This long.
    Declared(Duration),
    /// What the bounds of the manifest ask for.
    Solved,
}

/// One run.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Setup {
    /// Who brings the messages.
    pub(crate) system: System,
    /// Between two messages of a sequence.
    pub(crate) period: Duration,
    /// Between two sequences.
    pub(crate) pause: Duration,
    /// The most that a node works on a message.
    pub(crate) work: Duration,
    /// How many sequences are sent.
    pub(crate) sequences: u32,
}

impl Setup {
    /// The time that a sequence takes, pause included.
    pub(crate) fn cycle(&self) -> Duration {
        self.period.saturating_mul(3).saturating_add(self.pause)
    }

    /// The time that sending takes.
    pub(crate) fn length(&self) -> Duration {
        self.cycle().saturating_mul(self.sequences)
    }

    /// How long a run may take before it is given up.
    pub(crate) fn limit(&self) -> Duration {
        self.length().saturating_mul(4).saturating_add(SLACK)
    }
}

/// What came of a run.
#[derive(Clone, Debug, Default)]
pub(crate) struct Ran {
    /// What the planner counted.
    pub(crate) tally: Tally,
    /// The planner's STP offset, where it has one.
    pub(crate) offset: Option<Duration>,
    /// STP violations that the runtime counted at the planner.
    pub(crate) counted: u64,
}

impl Ran {
    /// Reads a line of the planner's output; `counted` holds the violations of each upstream. Done at the last line.
    fn hear(&mut self, line: &str, counted: &mut BTreeMap<u16, u64>) -> Option<()> {
        if let Ok(tally) = serde_json::from_str(line) {
            self.tally = tally;
            return None;
        }
        let status: FederateStatus = serde_json::from_str(line).ok()?;
        if let FederateStatus::Upstream {
            upstream, measures, ..
        } = &status
        {
            counted.insert(*upstream, measures.stp_violations);
        }
        self.counted = counted.values().sum();
        matches!(status, FederateStatus::Ended { .. }).then_some(())
    }
}

/// Where a run leaves its files, and who it is made of.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Place<'a> {
    /// A directory of its own.
    pub(crate) directory: &'a Path,
    /// This program.
    pub(crate) program: &'a Path,
}

impl Place<'_> {
    /// Writes a file of the run.
    ///
    /// # Errors
    ///
    /// When it cannot be written.
    pub(crate) fn write(&self, name: &str, text: &str) -> Result<PathBuf, RunError> {
        let path = self.directory.join(name);
        match std::fs::write(&path, text) {
            Ok(()) => Ok(path),
            Err(source) => Err(RunError::File { path, source }),
        }
    }

    /// The plan of a run: the manifest's, with this program as the executable.
    ///
    /// # Errors
    ///
    /// When the manifest cannot be written, or is refused.
    pub(crate) fn plan(&self, setup: &Setup) -> Result<Plan, RunError> {
        let program = format!("binary: \"{}\"", self.program.display());
        let manifest = MANIFEST.replace("package: .", &program);
        let manifest = self.write("federation.yaml", &manifest)?;
        let span = |span: Duration| format!("{} ns", span.as_nanos());
        let run = setup.length() + setup.pause + REST;
        let coordination = match setup.system {
            System::Decentralized(_) => "decentralized",
            System::Centralized | System::Mqtt { .. } => "centralized",
        };
        let values = [
            ("coordination", coordination.to_owned()),
            ("run", span(run)),
            ("period", span(setup.period)),
            ("pause", span(setup.pause)),
            ("work", span(setup.work)),
            ("sequences", setup.sequences.to_string()),
        ];
        let options = CheckOptions {
            overrides: values.map(|(name, value)| (name.to_owned(), value)).into(),
            ..CheckOptions::default()
        };
        let mut plan = check(&manifest, &options, &mut |_| {})?.plan;
        if let System::Decentralized(Offset::Declared(offset)) = setup.system {
            declare(&mut plan, offset);
        }
        Ok(plan)
    }

    /// Runs the federation.
    ///
    /// # Errors
    ///
    /// When a process cannot be started, fails, or is not done in time.
    pub(crate) fn federated(&self, setup: &Setup) -> Result<Ran, RunError> {
        let plan = self.plan(setup)?;
        let text = serde_json::to_string(&plan).map_err(io::Error::from);
        let text = text.map_err(|source| RunError::File {
            path: "plan.json".into(),
            source,
        })?;
        let file = self.write("plan.json", &text)?;
        let (mut rti, port) = self.rti(plan.federates.len())?;
        let mut federates = BTreeMap::new();
        for federate in &plan.federates {
            let name = federate.name.as_str();
            let mut command = Command::new(self.program);
            command.arg("--plan").arg(&file);
            command.args(["--federate", name, "-i", FEDERATION]);
            command.args(["--rti", &format!("127.0.0.1:{port}")]);
            command.args(["--status-fd", "1"]);
            let part = Part::start(name, &mut command, self.directory)?;
            federates.insert(name, part);
        }
        let mut ran = Ran {
            offset: offset(&plan),
            ..Ran::default()
        };
        if let Some(planner) = federates.get_mut(PLANNER) {
            let mut counted = BTreeMap::new();
            planner.line(setup.limit(), |line| ran.hear(line, &mut counted))?;
        }
        for part in federates.values_mut() {
            part.end(START)?;
        }
        rti.end(START)?;
        Ok(ran)
    }

    fn rti(&self, federates: usize) -> Result<(Part, u16), PartError> {
        let mut command = Command::new(self.program);
        let count = federates.to_string();
        command.args([RTI, "-i", FEDERATION, "-n", &count, "-p", "0"]);
        command.args(["--status-fd", "1"]);
        let mut rti = Part::start(RTI, &mut command, self.directory)?;
        let port = rti.line(START, |line| match serde_json::from_str(line) {
            Ok(RtiStatus::Listening { port }) => Some(port),
            _ => None,
        })?;
        Ok((rti, port))
    }
}

/// Gives the planner this offset instead of what the manifest says.
fn declare(plan: &mut Plan, offset: Duration) {
    for connection in &mut plan.connections {
        connection.stp_offset_ns = None;
    }
    for federate in plan.federates.iter_mut().filter(|it| it.name == PLANNER) {
        federate.stp_offset_ns = i64::try_from(offset.as_nanos()).unwrap_or(i64::MAX);
    }
}

fn offset(plan: &Plan) -> Option<Duration> {
    if plan.coordination == Coordination::Centralized {
        return None;
    }
    let planner = plan.federates.iter().find(|it| it.name == PLANNER)?;
    u64::try_from(planner.stp_offset_ns)
        .ok()
        .map(Duration::from_nanos)
}
