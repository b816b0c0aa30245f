//! From what is asked for and what is there to steps.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::desired::{Desired, DesiredHost, digest};
use super::diff::{changes, short};
use super::observed::{Observed, Reached, Run, RunState};
use super::refusal::{Reason, Refusal};
use super::step::{Operation, Step, StepId};
use crate::placement::Engine;

/// The format of a plan in a file.
const FORMAT: u32 = 1;

/// The RTI among a part's members.
const RTI: &str = "rti";

/// How long a call may take that only writes a record.
const CALL_LIMIT_MS: u64 = 20_000;

/// How long preparing may take: images are made and loaded, containers created.
const PREPARE_LIMIT_MS: u64 = 180_000;

/// Bytes a second of the slowest link that is waited for.
const SLOWEST_LINK: u64 = 64 << 10;

/// What is done on every host, in which order and why.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// The version of this format.
    pub format: u32,
    /// A digest of what it leads to and of the runs that it was made for.
    pub id: String,
    /// The federation.
    pub federation: String,
    /// [`Desired::digest`] of what it leads to; absent when it takes the federation down.
    pub digest: Option<String>,
    /// The run that was on each host when it was planned.
    pub runs: BTreeMap<String, Option<String>>,
    /// What is to run on each host.
    pub parts: BTreeMap<String, Part>,
    /// Why, in words.
    pub causes: Vec<String>,
    /// How long an ordered stop may take, in milliseconds.
    pub stop_limit_ms: u64,
    /// In an order in which they may be done; empty when there is nothing to do.
    pub steps: Vec<Step>,
}

/// What is to run on a host.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Part {
    /// What runs its members.
    pub engine: Engine,
    /// Whether the RTI runs there.
    pub rti: bool,
    /// Its federates.
    pub federates: Vec<String>,
}

/// Why a plan that was made earlier is not carried out.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Stale {
    /// Another run is there by now.
    #[error(
        "host `{host}` has moved on: the plan was made for {planned}, and {found} is there; plan again",
        planned = run_words(planned.as_deref()), found = run_words(found.as_deref())
    )]
    Moved {
        /// The host.
        host: String,
        /// The run at the time of the plan.
        planned: Option<String>,
        /// The run that is there.
        found: Option<String>,
    },
    /// What is there is not known.
    #[error("whether host `{host}` has moved on is not known: {why}")]
    Unknown {
        /// The host.
        host: String,
        /// Why.
        why: String,
    },
    /// The plan leads elsewhere.
    #[error("the plan was made for another state of the manifest or its programs; plan again")]
    Manifest,
    /// It was written by another version.
    #[error("the plan has format {found}, and this ictus knows {FORMAT}; plan again")]
    Format {
        /// Its format.
        found: u32,
    },
}

impl Plan {
    /// Whether there is nothing to do: every host runs exactly this and is healthy.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.steps.is_empty()
    }

    /// Bytes that are sent.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        let mut sum = 0;
        for step in &self.steps {
            if let Operation::SendBlob { bytes, .. } | Operation::SendImage { bytes, .. } =
                &step.operation
            {
                sum += bytes;
            }
        }
        sum
    }

    /// Whether it leads to what is asked for now.
    ///
    /// # Errors
    /// When the manifest or a program has changed, or the format is another.
    pub fn is_for(&self, desired: &Desired) -> Result<(), Stale> {
        if self.format != FORMAT {
            return Err(Stale::Format { found: self.format });
        }
        match self.digest.as_deref() == Some(&desired.digest)
            && self.federation == desired.federation
        {
            true => Ok(()),
            false => Err(Stale::Manifest),
        }
    }

    /// Whether every host still has the run that the plan was made for.
    ///
    /// # Errors
    /// The first host, by name, that has another, or of which it is not known.
    pub fn still_valid(&self, observed: &BTreeMap<String, Observed>) -> Result<(), Stale> {
        if self.format != FORMAT {
            return Err(Stale::Format { found: self.format });
        }
        for (host, planned) in &self.runs {
            let unknown = |why: &str| {
                let (host, why) = (host.clone(), why.to_owned());
                Err(Stale::Unknown { host, why })
            };
            let found = match observed.get(host) {
                None => return unknown("it was not asked"),
                Some(Observed::Unreachable { why }) => return unknown(why),
                Some(Observed::Reached(reached)) => match &reached.run {
                    Err(newer) => return unknown(&newer.what),
                    Ok(run) => run.as_ref().map(|run| run.id.clone()),
                },
            };
            if found != *planned {
                let (host, planned) = (host.clone(), planned.clone());
                return Err(Stale::Moved {
                    host,
                    planned,
                    found,
                });
            }
        }
        Ok(())
    }
}

/// What has to be done so that the hosts run what is asked for. `observed` has every host of the manifest, and every
/// other host of the runs that are there.
///
/// # Errors
/// Every reason of every host for which nothing can be done now. Nothing is planned for some hosts only.
pub fn plan(desired: &Desired, observed: &BTreeMap<String, Observed>) -> Result<Plan, Refusal> {
    let mut reasons = obstacles(desired.hosts.keys(), observed, &desired.version);
    for (host, wanted) in &desired.hosts {
        if let Some(reached) = observed.get(host).and_then(Observed::reached) {
            reasons.extend(unsuited(host, wanted, reached));
        }
    }
    refuse(reasons)?;
    let causes = changes(desired, observed);
    let runs = planned_for(observed);
    let target = Some(desired.digest.clone());
    let mut plan = Plan::new(&desired.federation, target, runs);
    plan.parts = desired.hosts.iter().map(part).collect();
    plan.stop_limit_ms = desired.stop_limit_ms;
    if !causes.is_empty() {
        plan.causes = causes;
        plan.steps = Graph::new(observed, desired.stop_limit_ms).rollout(desired, &plan.causes);
    }
    Ok(plan)
}

/// What has to be done so that nothing of a federation runs on the hosts that were asked; `purge` leaves nothing else
/// either.
///
/// # Errors
/// As for [`plan`]; also when a run has a part on a host that was not asked.
pub fn plan_down(
    federation: &str,
    observed: &BTreeMap<String, Observed>,
    purge: bool,
    stop_limit_ms: u64,
) -> Result<Plan, Refusal> {
    let mut plan = plan_nothing(federation, observed, stop_limit_ms)?;
    if purge || plan.runs.values().any(Option::is_some) {
        plan.causes = vec!["it is taken down".to_owned()];
        plan.steps = Graph::new(observed, stop_limit_ms).down(purge);
    }
    Ok(plan)
}

/// What has to be done so that nothing of a federation runs on the hosts that were asked; everything else stays as it is.
///
/// # Errors
/// As for [`plan_down`].
pub fn plan_stop(
    federation: &str,
    observed: &BTreeMap<String, Observed>,
    stop_limit_ms: u64,
) -> Result<Plan, Refusal> {
    let mut plan = plan_nothing(federation, observed, stop_limit_ms)?;
    let steps = Graph::new(observed, stop_limit_ms).halt();
    let stops = |step: &Step| matches!(step.operation, Operation::StopOld { .. });
    if steps.iter().any(stops) {
        plan.causes = vec!["it is stopped".to_owned()];
        plan.steps = steps;
    }
    Ok(plan)
}

/// A plan after which the federation is as it is, where it could be changed.
fn plan_nothing(
    federation: &str,
    observed: &BTreeMap<String, Observed>,
    stop_limit_ms: u64,
) -> Result<Plan, Refusal> {
    refuse(obstacles(
        observed.keys(),
        observed,
        env!("CARGO_PKG_VERSION"),
    ))?;
    Ok(Plan {
        stop_limit_ms,
        ..Plan::new(federation, None, planned_for(observed))
    })
}

impl Plan {
    fn new(
        federation: &str,
        target: Option<String>,
        runs: BTreeMap<String, Option<String>>,
    ) -> Self {
        let whole = json!({ "federation": federation, "digest": target, "runs": runs });
        Self {
            format: FORMAT,
            id: digest(&whole),
            federation: federation.to_owned(),
            digest: target,
            runs,
            parts: BTreeMap::new(),
            causes: Vec::new(),
            stop_limit_ms: CALL_LIMIT_MS,
            steps: Vec::new(),
        }
    }
}

fn part((name, host): (&String, &DesiredHost)) -> (String, Part) {
    let part = Part {
        engine: host.engine,
        rti: host.rti,
        federates: host.federates.clone(),
    };
    (name.clone(), part)
}

fn planned_for(observed: &BTreeMap<String, Observed>) -> BTreeMap<String, Option<String>> {
    let run = |observed: &Observed| observed.run().map(|run| run.id.clone());
    let runs = observed.iter();
    runs.map(|(host, observed)| (host.clone(), run(observed)))
        .collect()
}

fn refuse(mut reasons: Vec<Reason>) -> Result<(), Refusal> {
    reasons.sort_by(|one, other| one.host().cmp(other.host()));
    match reasons.is_empty() {
        true => Ok(()),
        false => Err(Refusal { reasons }),
    }
}

/// Why hosts cannot be asked to do anything.
fn obstacles<'a>(
    wanted: impl Iterator<Item = &'a String>,
    observed: &BTreeMap<String, Observed>,
    ours: &str,
) -> Vec<Reason> {
    let mut reasons = Vec::new();
    let mut missing: BTreeMap<&String, Option<&Run>> = wanted.map(|host| (host, None)).collect();
    for run in observed.values().filter_map(Observed::run) {
        // An ended run's hosts count too: its record there may say otherwise.
        missing.extend(run.hosts.iter().map(|host| (host, Some(run))));
    }
    for (host, run) in missing {
        let (host, asked) = (host.clone(), observed.contains_key(host));
        match run {
            _ if asked => {}
            Some(run) => reasons.push(Reason::NotAsked {
                host,
                run: short(&run.id).to_owned(),
            }),
            None => reasons.push(Reason::Unreachable {
                host,
                why: "it was not asked".to_owned(),
            }),
        }
    }
    for (host, observed) in observed {
        let host = host.clone();
        match observed {
            Observed::Unreachable { why } => reasons.push(Reason::Unreachable {
                host,
                why: why.clone(),
            }),
            Observed::Reached(reached) => reasons.extend(unready(&host, reached, ours)),
        }
    }
    reasons
}

/// Why a host that answered cannot be asked to do anything.
fn unready(host: &str, reached: &Reached, ours: &str) -> Vec<Reason> {
    let mut reasons = Vec::new();
    let (host, theirs) = (host.to_owned(), reached.version.clone());
    match (release(&theirs), release(ours)) {
        (theirs_is, ours_is) if theirs_is > ours_is => reasons.push(Reason::DaemonNewer {
            host: host.clone(),
            theirs,
            ours: ours.to_owned(),
        }),
        // The daemon before this one is understood.
        ((major, minor), ours_is) if (major, minor + 1) < ours_is => {
            reasons.push(Reason::DaemonOlder {
                host: host.clone(),
                theirs,
                ours: ours.to_owned(),
            });
        }
        _ => {}
    }
    if let Err(newer) = &reached.run {
        reasons.push(Reason::RecordNewer {
            host: host.clone(),
            what: newer.what.clone(),
        });
    }
    if let Some(held) = &reached.lease {
        reasons.push(Reason::Held {
            host,
            who: held.who.clone(),
            left_ms: held.left_ms,
        });
    }
    reasons
}

/// Major and minor number of a version; what is no number is 0.
fn release(version: &str) -> (u64, u64) {
    let mut numbers = version.split('.').map(|part| part.parse().unwrap_or(0));
    (numbers.next().unwrap_or(0), numbers.next().unwrap_or(0))
}

/// Why a host cannot run what it is to run.
fn unsuited(host: &str, wanted: &DesiredHost, reached: &Reached) -> Vec<Reason> {
    let mut reasons = Vec::new();
    let wrong = wanted.blobs.iter().filter(|blob| blob.arch != reached.arch);
    reasons.extend(wrong.map(|blob| Reason::Architecture {
        host: host.to_owned(),
        arch: reached.arch.clone(),
        program: blob.arch.clone(),
        federates: blob.federates.clone(),
    }));
    for image in &wanted.images {
        let there = reached.images.get(image.asked_for());
        let arch = image.arch.as_ref().or(there);
        if let Some(arch) = arch.filter(|arch| **arch != reached.arch) {
            reasons.push(Reason::ImageArchitecture {
                host: host.to_owned(),
                arch: reached.arch.clone(),
                image: image.name.clone(),
                found: arch.clone(),
                federates: image.federates.clone(),
            });
        }
    }
    match (wanted.engine, &reached.docker) {
        (Engine::Docker, Err(why)) => reasons.push(Reason::Engine {
            host: host.to_owned(),
            why: why.clone(),
        }),
        (Engine::Process | Engine::Docker, _) => {}
    }
    for (federate, needs) in &wanted.needs {
        let lacks = reached.gives.lacks(wanted.engine, needs);
        reasons.extend(lacks.into_iter().map(|lack| Reason::Lacks {
            host: host.to_owned(),
            federate: federate.clone(),
            what: lack.what,
            fix: lack.fix,
        }));
    }
    let missing = wanted.blobs.iter();
    let missing = missing.filter(|blob| !reached.blobs.contains(&blob.digest));
    let needed: u64 = missing.map(|blob| blob.bytes).sum();
    if needed > reached.disk_free {
        reasons.push(Reason::Disk {
            host: host.to_owned(),
            path: reached.state.clone(),
            free: reached.disk_free,
            needed,
        });
    }
    reasons
}

/// The steps so far, each layer waiting for the one before.
struct Graph<'a> {
    observed: &'a BTreeMap<String, Observed>,
    stop_limit_ms: u64,
    steps: Vec<Step>,
}

impl<'a> Graph<'a> {
    fn new(observed: &'a BTreeMap<String, Observed>, stop_limit_ms: u64) -> Self {
        Self {
            observed,
            stop_limit_ms,
            steps: Vec::new(),
        }
    }

    fn add(&mut self, host: &str, operation: Operation, cause: &str, needs: &[StepId]) -> StepId {
        let id = StepId(self.steps.len());
        let limit_ms = match &operation {
            Operation::SendBlob { bytes, .. } => CALL_LIMIT_MS + bytes / SLOWEST_LINK * 1000,
            // Taken out of one engine, loaded into another, and once more when layers are not there after all.
            Operation::SendImage { bytes, .. } => {
                PREPARE_LIMIT_MS + bytes / SLOWEST_LINK * 1000 * 2
            }
            Operation::StopOld { .. } => self.stop_limit_ms,
            Operation::Prepare { .. } => PREPARE_LIMIT_MS,
            Operation::Lease
            | Operation::RemoveOld { .. }
            | Operation::CommitRti
            | Operation::Commit
            | Operation::AwaitHealthy
            | Operation::RemovePart { .. }
            | Operation::StopPart { .. }
            | Operation::Release => CALL_LIMIT_MS,
        };
        self.steps.push(Step {
            id,
            host: host.to_owned(),
            operation,
            cause: cause.to_owned(),
            needs: needs.to_vec(),
            limit_ms,
        });
        id
    }

    /// All leases, one after the other in the hosts' order, so that of two who want them one gets all.
    fn lease(&mut self) -> Vec<StepId> {
        let mut last = Vec::new();
        for host in self.observed.keys() {
            let cause = "one at a time changes a federation";
            last = vec![self.add(host, Operation::Lease, cause, &last)];
        }
        last
    }

    /// What is missing, one file after the other on each host.
    fn send(&mut self, desired: &Desired, after: &[StepId]) -> Vec<StepId> {
        let mut ends = Vec::new();
        for (host, wanted) in &desired.hosts {
            let there = self.observed.get(host).and_then(Observed::reached);
            let mut needs = after.to_vec();
            for blob in &wanted.blobs {
                if there.is_some_and(|there| there.blobs.contains(&blob.digest)) {
                    continue;
                }
                let operation = Operation::SendBlob {
                    digest: blob.digest.clone(),
                    bytes: blob.bytes,
                };
                let cause = format!(
                    "not there: the program of {}",
                    listed("federate", &blob.federates)
                );
                needs = vec![self.add(host, operation, &cause, &needs)];
            }
            for image in &wanted.images {
                let there = there.is_some_and(|it| it.images.contains_key(image.asked_for()));
                // One that is nowhere is pulled by the host.
                let (Some(id), false) = (&image.id, there) else {
                    continue;
                };
                let operation = Operation::SendImage {
                    image: id.clone(),
                    bytes: image.bytes,
                };
                let federates = listed("federate", &image.federates);
                let cause = format!("not there: image {} of {federates}", image.name);
                needs = vec![self.add(host, operation, &cause, &needs)];
            }
            if needs != after {
                ends.extend(needs);
            }
        }
        joined(ends, after)
    }

    /// Ends what runs, on all hosts at once.
    fn stop(&mut self, cause: &str, after: &[StepId]) -> Vec<StepId> {
        let mut ends = Vec::new();
        for (host, run) in self.runs() {
            let stops = match run.state {
                // One that is prepared may be started yet, by whoever has not noticed that its lease has ended.
                RunState::Prepared
                | RunState::Starting
                | RunState::Running
                | RunState::Stopping => true,
                RunState::Ended { .. } => false,
            };
            if stops {
                let run = run.id.clone();
                ends.push(self.add(&host, Operation::StopOld { run }, cause, after));
            }
        }
        joined(ends, after)
    }

    fn runs(&self) -> Vec<(String, Run)> {
        let runs = self.observed.iter();
        runs.filter_map(|(host, observed)| Some((host.clone(), observed.run()?.clone())))
            .collect()
    }

    fn release(&mut self, after: &[StepId]) {
        for host in self.observed.keys() {
            self.add(host, Operation::Release, "done", after);
        }
    }

    fn rollout(mut self, desired: &Desired, causes: &[String]) -> Vec<Step> {
        let why = causes.join("; ");
        let leased = self.lease();
        let sent = self.send(desired, &leased);
        let stopped = self.stop(&why, &sent);
        let mut removed = Vec::new();
        let mut gone = BTreeSet::new();
        for (host, run) in self.runs() {
            let cause = match (desired.hosts.contains_key(&host), &run.state) {
                (false, _) => "not among the manifest's hosts any more",
                (true, RunState::Prepared) => "left by a start that was not finished",
                // Preparing takes its place.
                (true, _) => continue,
            };
            let operation = Operation::RemoveOld {
                run: Some(run.id),
                purge: false,
            };
            removed.push(self.add(&host, operation, cause, &stopped));
            gone.insert(host);
        }
        let cleared = joined(removed, &stopped);
        let previous: BTreeMap<String, Run> = self.runs().into_iter().collect();
        let mut prepared = Vec::new();
        for host in desired.hosts.keys() {
            let previous = previous.get(host).filter(|_| !gone.contains(host));
            let previous = previous.map(|run| run.id.clone());
            let cause = match previous {
                Some(_) => "its part of the restart",
                None => "not there",
            };
            prepared.push(self.add(host, Operation::Prepare { previous }, cause, &cleared));
        }
        let healthy = self.commit(desired, &prepared);
        self.release(&healthy);
        self.steps
    }

    /// The RTI's host first, then the others at once; then all are waited for.
    fn commit(&mut self, desired: &Desired, prepared: &[StepId]) -> Vec<StepId> {
        let rti = desired.hosts.iter().find(|(_, host)| host.rti);
        let mut begun = prepared.to_vec();
        if let Some((host, _)) = rti {
            let cause = "every host is prepared";
            begun = vec![self.add(host, Operation::CommitRti, cause, prepared)];
        }
        let others = desired.hosts.iter().filter(|(_, host)| !host.rti);
        let mut all = Vec::new();
        for (host, _) in others {
            all.push(self.add(host, Operation::Commit, "the RTI listens", &begun));
        }
        let all = joined(all, &begun);
        let mut healthy = Vec::new();
        for host in desired.hosts.keys() {
            let id = self.add(host, Operation::AwaitHealthy, "every part is started", &all);
            self.steps[id.0].limit_ms = desired.start_limit_ms;
            healthy.push(id);
        }
        healthy
    }

    fn halt(mut self) -> Vec<Step> {
        let leased = self.lease();
        let stopped = self.stop("it is stopped", &leased);
        self.release(&stopped);
        self.steps
    }

    fn down(mut self, purge: bool) -> Vec<Step> {
        let cause = "it is taken down";
        let leased = self.lease();
        let stopped = self.stop(cause, &leased);
        let runs: BTreeMap<String, Run> = self.runs().into_iter().collect();
        // The RTI's host last: while parts are left somewhere, it tells whoever goes on with this where.
        let has_rti = |host: &&String| {
            runs.get(*host)
                .is_some_and(|run| run.members.contains_key(RTI))
        };
        let (last, first): (Vec<&String>, Vec<&String>) = self.observed.keys().partition(has_rti);
        let mut removed = stopped;
        for hosts in [first, last] {
            let mut layer = Vec::new();
            for host in hosts {
                let run = runs.get(host).map(|run| run.id.clone());
                if run.is_some() || purge {
                    let operation = Operation::RemoveOld { run, purge };
                    layer.push(self.add(host, operation, cause, &removed));
                }
            }
            removed = joined(layer, &removed);
        }
        self.release(&removed);
        self.steps
    }
}

/// What the next layer waits for: this one, or the one before when this one is empty.
fn joined(layer: Vec<StepId>, before: &[StepId]) -> Vec<StepId> {
    match layer.is_empty() {
        true => before.to_vec(),
        false => layer,
    }
}

/// "federate `a`", "federates `a`, `b` and `c`".
pub(super) fn listed(noun: &str, names: &[String]) -> String {
    let quoted: Vec<String> = names.iter().map(|name| format!("`{name}`")).collect();
    match quoted.split_last() {
        None => format!("no {noun}"),
        Some((last, [])) => format!("{noun} {last}"),
        Some((last, rest)) => format!("{noun}s {} and {last}", rest.join(", ")),
    }
}

fn run_words(run: Option<&str>) -> String {
    match run {
        Some(run) => format!("run {run}"),
        None => "no run".to_owned(),
    }
}
