//! A plan for people: what changes on each host, and why.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use super::diff::short;
use super::plan::{Part, Plan};
use super::step::{Operation, Step};
use crate::placement::Engine;

/// Columns of the mark and the verb.
const VERB: usize = 8;
/// Columns of what it is about, at least.
const SUBJECT_MIN: usize = 24;

impl fmt::Display for Plan {
    /// The headline with its causes, a block for each host, and the sums. No newline at the end.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.headline())?;
        if self.is_empty() {
            return write!(f, "nothing to do");
        }
        for cause in self.causes.iter().filter(|_| self.digest.is_some()) {
            writeln!(f, "  {cause}")?;
        }
        let hosts: BTreeSet<&String> = self.runs.keys().chain(self.parts.keys()).collect();
        for host in &hosts {
            let steps = self.steps.iter().filter(|step| step.host == **host);
            let rows: Vec<_> = steps.filter_map(|step| self.row(step)).collect();
            writeln!(f, "\n{host}{}", about(self.parts.get(*host)))?;
            let width = rows.iter().map(|row| row.1.chars().count()).max();
            let width = width.unwrap_or(0).max(SUBJECT_MIN);
            for (verb, subject, why) in rows {
                let line = format!("  {verb:VERB$}  {subject:width$}  {why}");
                writeln!(f, "{}", line.trim_end())?;
            }
        }
        let (steps, bytes) = (self.steps.len(), size(self.bytes()));
        let hosts = counted(hosts.len(), "host");
        write!(
            f,
            "\nplan {}: {steps} steps on {hosts}, {bytes} to send",
            short(&self.id)
        )
    }
}

impl Plan {
    /// What happens to the federation as a whole.
    fn headline(&self) -> String {
        let federates = self.parts.values().map(|part| part.federates.len()).sum();
        let federates = counted(federates, "federate");
        let hosts = counted(self.parts.len(), "host");
        let name = &self.federation;
        let stops = |step: &Step| matches!(step.operation, Operation::StopOld { .. });
        match (&self.digest, self.is_empty()) {
            (None, true) => format!("{name}: nothing of it is there"),
            (None, false) => format!("{name}: it is taken down"),
            (Some(_), true) => format!("{name}: {federates} on {hosts} run as the manifest says"),
            (Some(_), false) if self.steps.iter().any(stops) => {
                let verb = if federates.starts_with("1 ") {
                    "restarts"
                } else {
                    "restart together"
                };
                format!("{name}: {federates} {verb} at a planned stop")
            }
            (Some(_), false) => {
                let verb = if federates.starts_with("1 ") {
                    "starts"
                } else {
                    "start"
                };
                format!("{name}: {federates} {verb} on {hosts}")
            }
        }
    }

    /// The verb, what it is about, and why; absent for what is a matter of course.
    fn row(&self, step: &Step) -> Option<(&'static str, String, String)> {
        let members = || match self.parts.get(&step.host) {
            Some(part) => members(part),
            None => String::new(),
        };
        Some(match &step.operation {
            Operation::SendBlob { digest, bytes } => (
                "+ send",
                format!("{} {}", short(digest), size(*bytes)),
                step.cause.clone(),
            ),
            Operation::SendImage { image, bytes } => (
                "+ send",
                format!(
                    "image {}, up to {}",
                    short(image.trim_start_matches("sha256:")),
                    size(*bytes)
                ),
                step.cause.clone(),
            ),
            // Why is said at the head.
            Operation::StopOld { run } => ("- stop", run_words(run), String::new()),
            Operation::RemoveOld { run: Some(run), .. } => {
                ("- remove", run_words(run), step.cause.clone())
            }
            Operation::RemoveOld { run: None, .. } => {
                ("- remove", "what is left".to_owned(), step.cause.clone())
            }
            Operation::Prepare { .. } => ("+ start", members(), step.cause.clone()),
            Operation::Lease
            | Operation::CommitRti
            | Operation::Commit
            | Operation::AwaitHealthy
            | Operation::RemovePart { .. }
            | Operation::StopPart { .. }
            | Operation::Release => return None,
        })
    }
}

/// A run as people see it; a damaged record has no id.
fn run_words(run: &str) -> String {
    match run.is_empty() {
        true => "a damaged record".to_owned(),
        false => format!("run {}", short(run)),
    }
}

/// The engine of a host that takes part.
fn about(part: Option<&Part>) -> &'static str {
    match part.map(|part| part.engine) {
        None => "",
        Some(Engine::Process) => " (process)",
        Some(Engine::Docker) => " (docker)",
    }
}

fn members(part: &Part) -> String {
    let rti = part.rti.then_some("rti");
    let names = rti
        .into_iter()
        .chain(part.federates.iter().map(String::as_str));
    names.collect::<Vec<_>>().join(", ")
}

fn counted(number: usize, noun: &str) -> String {
    match number {
        1 => format!("1 {noun}"),
        _ => format!("{number} {noun}s"),
    }
}

/// Bytes as people say them.
fn size(bytes: u64) -> String {
    let units: BTreeMap<u64, &str> = [(1 << 10, "KiB"), (1 << 20, "MiB"), (1 << 30, "GiB")].into();
    match units.range(..=bytes).next_back() {
        None => format!("{bytes} B"),
        Some((unit, name)) => {
            let tenths = (u128::from(bytes) * 10 + u128::from(*unit) / 2) / u128::from(*unit);
            format!("{}.{} {name}", tenths / 10, tenths % 10)
        }
    }
}
