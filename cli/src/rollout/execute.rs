//! Carries out one plan: [`Apply`] decides, this calls the hosts' daemons and waits.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::time::{Duration, Instant};

use ictus_deploy::rollout::{Apply, Moment, Operation, Outcome, Phase, Step, StepId};
use ictusd::api::part::{CommitRequest, LeaseRequest, PrepareRequest};
use ictusd::api::recorded::Kept;
use ictusd::api::{self, ErrorCode, Event, Happening, Removed, State};
use ictusd::client::{Client, ClientError, Stream};
use ictusd::{identity, stamp};
use tokio::task::JoinSet;

use super::observe::{is_unknown, view};
use super::{Rollout, certificates, listed};
use crate::commands::events::describe;
use crate::error::{CliError, Kind};
use crate::hosts::Clients;
use crate::hosts::merge::Merged;
use crate::interrupts::Interrupts;
use crate::ui::Ui;

mod begin;
mod resend;
mod stages;

use resend::Stock;
use stages::Stages;

/// How long a lease lasts without renewal: who is gone for so long has gone.
const LEASE_TTL: Duration = Duration::from_secs(20);
/// How often leases are renewed.
const RENEWAL: Duration = Duration::from_secs(8);

/// What is to be prepared, for plans that start something.
#[derive(Debug, Default)]
struct Work {
    requests: BTreeMap<String, PrepareRequest>,
    stock: Stock,
    rti: Option<(String, Ipv4Addr)>,
}

/// One plan on its way.
#[derive(Debug)]
pub(crate) struct Executor {
    apply: Apply,
    federation: String,
    clients: Clients,
    work: Work,
    who: String,
    fences: BTreeMap<String, u64>,
    /// Where the RTI listens.
    rti: Option<SocketAddrV4>,
    parts: Merged<Happening>,
    /// Steps that wait for an event, by host.
    listening: Option<(String, StepId)>,
    healthy: BTreeMap<String, StepId>,
    /// Hosts whose part was healthy before anybody waited for it.
    heard_healthy: BTreeSet<String>,
    stages: Stages,
    origin: Instant,
    /// When the commit began, and when all were healthy.
    committed: Option<Instant>,
    /// Bytes that went over the wire.
    sent: u64,
    /// Whether what is stopped is killed.
    kill: bool,
    /// What removals have left, with its host.
    kept: Vec<(String, Kept)>,
    /// The time that it had, once that is over.
    late: Option<Duration>,
}

/// How it came out.
#[derive(Debug)]
pub(crate) struct Verdict {
    /// Bytes sent, compressed.
    pub(crate) sent: u64,
    /// From the first commit to health.
    pub(crate) commit: Option<Duration>,
    /// What removals have left, with its host.
    pub(crate) kept: Vec<(String, Kept)>,
}

/// What a step's call gave.
struct Answer {
    step: Step,
    outcome: Outcome,
    effect: Effect,
}

enum Effect {
    Nothing,
    Fence(u64),
    Sent(u64),
    Left(Vec<Kept>),
    /// Bytes, and how many layers they were of how many.
    SentLayers((u64, usize, usize)),
    Began(Box<Stream<Happening>>),
    Renewed,
}

impl Executor {
    /// Carries out what starts a federation.
    pub(crate) fn up(mut rollout: Rollout<'_>) -> Result<Self, CliError> {
        let run = identity::random_id().map_err(CliError::failed)?;
        let secrets = std::mem::take(&mut rollout.secrets).complete()?;
        let mut requests = BTreeMap::new();
        for (host, wanted) in &rollout.desired.hosts {
            let Some(request) = rollout.part_request(host) else {
                continue;
            };
            let prepare = PrepareRequest {
                previous: None,
                id: run.clone(),
                digest: rollout.desired.digest.clone(),
                facets: rollout.desired.facets.clone(),
                generation: Some(rollout.generation),
                request,
                secrets: secrets.only(&wanted.federates),
                papers: BTreeMap::new(),
            };
            requests.insert(host.clone(), prepare);
        }
        certificates::hand_out(&run, requests.values_mut())?;
        let rti_host = rollout.placement.hosts.get(rollout.placement.rti);
        let rti = rti_host
            .map(|host| host.name.clone())
            .zip(rollout.rti_address());
        let work = Work {
            requests,
            stock: Stock {
                files: rollout.files,
                images: rollout.images,
            },
            rti,
        };
        let federates = rollout.checked.federates.len();
        let apply = Apply::new(rollout.plan, run);
        Ok(Self::new("up", apply, rollout.clients, (work, federates)))
    }

    /// One that has not begun; `work` is empty where nothing is started.
    fn new(verb: &str, apply: Apply, clients: Clients, (work, federates): (Work, usize)) -> Self {
        Self {
            federation: apply.plan().federation.clone(),
            apply,
            clients,
            work,
            who: who(verb),
            fences: BTreeMap::new(),
            rti: None,
            parts: Merged::new(),
            listening: None,
            healthy: BTreeMap::new(),
            heard_healthy: BTreeSet::new(),
            stages: Stages::new(federates),
            origin: Instant::now(),
            committed: None,
            sent: 0,
            kill: false,
            kept: Vec::new(),
            late: None,
        }
    }

    /// Carries the plan out to its end.
    pub(crate) async fn run(
        mut self,
        ui: &mut Ui,
        interrupts: &mut Interrupts,
        limit: Duration,
    ) -> Result<Verdict, CliError> {
        let deadline = tokio::time::sleep(limit);
        tokio::pin!(deadline);
        let mut calls: JoinSet<Answer> = JoinSet::new();
        let mut renewal = tokio::time::interval(RENEWAL);
        while !self.apply.phase().is_over() {
            while let Some(step) = self.apply.poll_step(self.now()) {
                self.begin(ui, &mut calls, step);
            }
            if self.apply.phase().is_over() {
                break;
            }
            let due = self.apply.poll_timeout();
            let due = due.map(|due| tokio::time::Instant::from_std(self.origin + due));
            let listens = self.parts.has_open();
            tokio::select! {
                Some(answer) = calls.join_next() => {
                    let Ok(answer) = answer else { continue };
                    self.take(ui, answer);
                }
                heard = self.parts.next(), if listens => self.hear(ui, heard),
                () = interrupts.recv() => {
                    ui.message("undoing; again does not wait");
                    self.apply.handle_interrupt(self.now());
                }
                () = &mut deadline, if self.late.is_none() => {
                    self.late = Some(limit);
                    self.apply.handle_interrupt(self.now());
                }
                _ = renewal.tick() => self.renew(&mut calls),
                () = at(due), if due.is_some() => self.apply.handle_timeout(self.now()),
            }
        }
        self.conclude()
    }

    fn now(&self) -> Moment {
        Moment {
            elapsed: self.origin.elapsed(),
            wall_ns: stamp::now_ns(),
        }
    }

    fn begin(&mut self, ui: &mut Ui, calls: &mut JoinSet<Answer>, step: Step) {
        let Some(client) = self.clients.get(&step.host).cloned() else {
            let outcome = failed("there is no way to it");
            return self.apply.handle_done(self.now(), step.id, outcome);
        };
        match &step.operation {
            Operation::AwaitHealthy => {
                if self.heard_healthy.contains(&step.host) {
                    return self.apply.handle_done(self.now(), step.id, Outcome::Done);
                }
                self.healthy.insert(step.host.clone(), step.id);
                return;
            }
            Operation::CommitRti => {
                self.committed.get_or_insert_with(Instant::now);
                self.listening = Some((step.host.clone(), step.id));
            }
            Operation::SendBlob { bytes, .. } | Operation::SendImage { bytes, .. } => {
                ui.progress("sending", &format!("{}: {}", step.host, size(*bytes)));
            }
            Operation::Lease
            | Operation::StopOld { .. }
            | Operation::RemoveOld { .. }
            | Operation::Prepare { .. }
            | Operation::Commit
            | Operation::RemovePart { .. }
            | Operation::StopPart { .. }
            | Operation::Release => {}
        }
        let call = Call {
            client,
            federation: self.federation.clone(),
            fence: self.fences.get(&step.host).copied().unwrap_or(0),
            who: self.who.clone(),
            run: self.apply.run().to_owned(),
            rti: self.rti,
            request: self.request(&step),
            file: self.file(&step),
            kill: self.kill,
            stock: self.stock(&step),
        };
        calls.spawn(call.make(step));
    }

    fn request(&self, step: &Step) -> Option<PrepareRequest> {
        let Operation::Prepare { previous } = &step.operation else {
            return None;
        };
        let request = self.work.requests.get(&step.host)?;
        Some(PrepareRequest {
            previous: previous.clone(),
            ..request.clone()
        })
    }

    /// What this step may send.
    fn stock(&self, step: &Step) -> Stock {
        let sends = matches!(
            step.operation,
            Operation::SendImage { .. } | Operation::Prepare { .. }
        );
        if sends {
            self.work.stock.clone()
        } else {
            Stock::default()
        }
    }

    fn file(&self, step: &Step) -> Option<PathBuf> {
        let Operation::SendBlob { digest, .. } = &step.operation else {
            return None;
        };
        self.work.stock.files.get(digest).cloned()
    }

    fn take(&mut self, ui: &mut Ui, answer: Answer) {
        let Answer {
            step,
            outcome,
            effect,
        } = answer;
        match effect {
            Effect::Nothing => {}
            Effect::Fence(fence) => {
                self.fences.insert(step.host.clone(), fence);
                let steps = &self.apply.plan().steps;
                let leases = steps.iter().filter(|it| it.operation == Operation::Lease);
                if self.fences.len() == leases.count() {
                    let hosts = self.fences.keys().cloned().collect();
                    ui.stage("leased", &listed(&hosts));
                }
            }
            Effect::Sent(bytes) => {
                self.sent += bytes;
                let detail = format!("{}: {} for {}", step.host, size(bytes), step.cause);
                ui.stage("sent", &detail);
            }
            Effect::Left(kept) => {
                let host = step.host.clone();
                self.kept
                    .extend(kept.into_iter().map(|it| (host.clone(), it)));
            }
            Effect::SentLayers((bytes, layers, of)) => {
                self.sent += bytes;
                let size = size(bytes);
                let detail = format!(
                    "{}: {size} ({layers} of {of} layers) for {}",
                    step.host, step.cause
                );
                ui.stage("sent", &detail);
            }
            Effect::Began(stream) => {
                self.parts.add(step.host.clone(), *stream);
                if step.operation == Operation::CommitRti {
                    // Done when it listens.
                    return;
                }
            }
            Effect::Renewed => {
                if let Outcome::Held { what } = outcome {
                    self.apply.handle_fenced(step.host, what);
                }
                return;
            }
        }
        if outcome == Outcome::Done {
            self.say(ui, &step);
        }
        if step.operation == Operation::Release {
            self.fences.remove(&step.host);
        }
        if step.operation == Operation::CommitRti {
            self.listening = None;
        }
        self.apply.handle_done(self.now(), step.id, outcome);
    }

    fn say(&self, ui: &mut Ui, step: &Step) {
        let stage = match step.operation {
            Operation::StopOld { .. } => "stopped",
            Operation::RemoveOld { .. } => "removed",
            Operation::Prepare { .. } => "prepared",
            Operation::RemovePart { .. } | Operation::StopPart { .. } => "undone",
            Operation::Lease
            | Operation::SendBlob { .. }
            | Operation::SendImage { .. }
            | Operation::CommitRti
            | Operation::Commit
            | Operation::AwaitHealthy
            | Operation::Release => return,
        };
        ui.stage(stage, &step.host);
    }

    /// Takes what a part says.
    fn hear(&mut self, ui: &mut Ui, heard: Option<(String, Result<Happening, ClientError>)>) {
        let Some((host, happening)) = heard else {
            return;
        };
        let event = match happening {
            Ok(happening) => happening.event,
            Err(error) => {
                let what = format!("the connection was lost: {error}");
                return self.part_failed(&host, failed(&what));
            }
        };
        if let Event::Listening { port } = &event {
            self.handle_listening(&host, *port);
        } else if event == Event::Healthy {
            self.heard_healthy.insert(host.clone());
            if let Some(step) = self.healthy.remove(&host) {
                self.apply.handle_done(self.now(), step, Outcome::Done);
            }
        } else if let Event::Ended { outcome } = &event {
            self.part_failed(&host, ended(outcome));
        }
        let rti = self.rti;
        self.stages.report(ui, &host, &event, rti);
    }

    fn handle_listening(&mut self, host: &str, port: u16) {
        let address = self.work.rti.as_ref();
        self.rti = address.map(|(_, address)| SocketAddrV4::new(*address, port));
        if let Some((_, step)) = self.listening.take_if(|(at, _)| at == host) {
            self.apply.handle_done(self.now(), step, Outcome::Done);
        }
    }

    /// A part has ended before all were healthy, or nobody knows how it is.
    fn part_failed(&mut self, host: &str, outcome: Outcome) {
        let listening = self.listening.take_if(|(at, _)| at == host);
        let step = listening.map(|(_, step)| step);
        if let Some(step) = step.or_else(|| self.healthy.remove(host)) {
            self.apply.handle_done(self.now(), step, outcome);
        } else if outcome == Outcome::Done {
            // It has come to its end already: nothing is to be waited for.
            self.heard_healthy.insert(host.to_owned());
        } else {
            self.apply.handle_lost(self.now(), host, outcome);
        }
    }

    fn renew(&self, calls: &mut JoinSet<Answer>) {
        for (host, fence) in &self.fences {
            let Some(client) = self.clients.get(host).cloned() else {
                continue;
            };
            let (federation, fence, host) = (self.federation.clone(), *fence, host.clone());
            calls.spawn(async move {
                let renewed = client.renew(&federation, fence).await;
                let outcome = match renewed {
                    // Given back meanwhile, or unreachable for now: steps find out.
                    Ok(_) => Outcome::Done,
                    Err(error) => match of_error(&error) {
                        held @ Outcome::Held { .. } => held,
                        Outcome::Done | Outcome::Leased { .. } | Outcome::Failed { .. } => {
                            Outcome::Done
                        }
                    },
                };
                let step = Step {
                    id: StepId(usize::MAX),
                    host,
                    operation: Operation::Lease,
                    cause: String::new(),
                    needs: Vec::new(),
                    limit_ms: 0,
                };
                Answer {
                    step,
                    outcome,
                    effect: Effect::Renewed,
                }
            });
        }
    }

    fn conclude(self) -> Result<Verdict, CliError> {
        let commit = self.committed.map(|began| began.elapsed());
        if let (Some(limit), false) = (self.late, *self.apply.phase() == Phase::Done) {
            let (name, seconds) = (&self.federation, limit.as_secs_f64());
            let message = format!("federation `{name}` was not done within {seconds} s");
            return Err(CliError::new(Kind::Timeout, message)
                .hint("what was begun was undone; `--timeout` gives it more time"));
        }
        match self.apply.phase() {
            Phase::Done => Ok(Verdict {
                sent: self.sent,
                commit,
                kept: self.kept,
            }),
            Phase::Undone {
                cause,
                old_stopped,
                held,
            } => {
                let left = if *old_stopped {
                    "; the run that was there has been stopped"
                } else {
                    "; everything was undone"
                };
                let what = cause
                    .as_ref()
                    .map_or_else(|| "interrupted".to_owned(), ToString::to_string);
                if *held {
                    return Err(CliError::new(Kind::Held, what));
                }
                Err(CliError::failed(format!("{what}{left}")))
            }
            Phase::Failed { cause, left } => {
                let what = cause
                    .as_ref()
                    .map_or_else(|| "interrupted".to_owned(), ToString::to_string);
                if left.is_empty() {
                    return Err(CliError::failed(format!("{what}; everything was stopped")));
                }
                let message = format!("{what}; something may be left on {}", listed(left));
                let hint = format!("`ictus down {}` once they can be reached", self.federation);
                Err(CliError::new(Kind::Partial, message).hint(hint))
            }
            Phase::TakenOver { host, what } => {
                let message = format!("host `{host}`: {what}; nothing more was changed");
                Err(CliError::new(Kind::Held, message))
            }
            Phase::Leasing
            | Phase::Preparing
            | Phase::Committing
            | Phase::Undoing
            | Phase::Stopping => Err(CliError::failed("the plan was not carried out to its end")),
        }
    }
}

/// All that one call needs.
struct Call {
    client: Client,
    federation: String,
    fence: u64,
    who: String,
    run: String,
    rti: Option<SocketAddrV4>,
    request: Option<PrepareRequest>,
    file: Option<PathBuf>,
    kill: bool,
    stock: Stock,
}

impl Call {
    async fn make(self, step: Step) -> Answer {
        let made = self.carry_out(&step.operation).await;
        let (outcome, effect) = made.unwrap_or_else(|error| (of_error(&error), Effect::Nothing));
        Answer {
            step,
            outcome,
            effect,
        }
    }

    async fn carry_out(&self, operation: &Operation) -> Result<(Outcome, Effect), ClientError> {
        let (name, client) = (self.federation.as_str(), &self.client);
        let key = (name, self.fence);
        let done = Ok((Outcome::Done, Effect::Nothing));
        match operation {
            Operation::Lease => {
                let request = LeaseRequest {
                    who: self.who.clone(),
                    ttl_ms: u64::try_from(LEASE_TTL.as_millis()).unwrap_or(u64::MAX),
                };
                let lease = client.lease(name, &request).await?;
                let run = view(client, name).await?.map(|view| view.id);
                Ok((Outcome::Leased { run }, Effect::Fence(lease.fence)))
            }
            Operation::SendBlob { digest, .. } => {
                let Some(file) = &self.file else {
                    return Ok((failed("the program's file is not known"), Effect::Nothing));
                };
                let counter = Arc::new(AtomicU64::new(0));
                let sent = client.send_blob(key, digest, file, counter).await?;
                Ok((Outcome::Done, Effect::Sent(sent)))
            }
            Operation::SendImage { image, .. } => self.send_image(image).await,
            Operation::StopPart { run } if self.is_prepared(run).await? => {
                // Nothing of it was begun: nothing of it is to stay.
                left(client.undo_part(key).await)?;
                done
            }
            Operation::StopOld { run } | Operation::StopPart { run } => {
                if self.is_there(run).await? {
                    let mut stream = client.stop_part(key, self.kill).await?;
                    while stream.next().await?.is_some() {}
                }
                done
            }
            Operation::RemoveOld { run, purge } => {
                let there = match run {
                    Some(run) => self.is_there(run).await?,
                    None => true,
                };
                if there {
                    let removed = client.remove_part(key, *purge).await;
                    return Ok((Outcome::Done, Effect::Left(left(removed)?)));
                }
                done
            }
            Operation::RemovePart { run } => {
                if self.is_there(run).await? {
                    left(client.undo_part(key).await)?;
                }
                done
            }
            Operation::Prepare { .. } => self.prepare().await,
            Operation::CommitRti | Operation::Commit => {
                let rti = self.rti.filter(|_| *operation == Operation::Commit);
                let request = CommitRequest {
                    fence: self.fence,
                    id: self.run.clone(),
                    rti,
                };
                let stream = client.commit(name, &request).await?;
                Ok((Outcome::Done, Effect::Began(Box::new(stream))))
            }
            Operation::Release => {
                client.release(name, self.fence).await?;
                done
            }
            Operation::AwaitHealthy => done,
        }
    }

    async fn is_prepared(&self, run: &str) -> Result<bool, ClientError> {
        let view = view(&self.client, &self.federation).await?;
        Ok(view.is_some_and(|view| view.id == run && view.state == State::Prepared))
    }

    async fn is_there(&self, run: &str) -> Result<bool, ClientError> {
        let view = view(&self.client, &self.federation).await?;
        // One whose record is damaged has no id, and may be this one.
        Ok(view.is_some_and(|view| view.id == run || view.id.is_empty()))
    }
}

/// What a removal has left; that there was nothing to remove is no error.
fn left(removed: Result<Removed, ClientError>) -> Result<Vec<Kept>, ClientError> {
    match removed {
        Err(error) if is_unknown(&error) => Ok(Vec::new()),
        other => other.map(|removed| removed.kept),
    }
}

fn of_error(error: &ClientError) -> Outcome {
    let held = error.refusal().filter(|it| it.code == ErrorCode::Held);
    if let Some(refusal) = held {
        return Outcome::Held {
            what: refusal.message.clone(),
        };
    }
    let mut what = error.to_string();
    let mut source = std::error::Error::source(error);
    while let Some(error) = source {
        what.push_str(&format!(": {error}"));
        source = error.source();
    }
    failed(&what)
}

fn failed(what: &str) -> Outcome {
    Outcome::Failed {
        what: what.to_owned(),
        rank: 0,
        at_ns: None,
    }
}

/// What the end of a part means for who waits for its health.
fn ended(outcome: &api::Outcome) -> Outcome {
    match outcome {
        api::Outcome::Completed | api::Outcome::Stopped { .. } => Outcome::Done,
        api::Outcome::Aborted => Outcome::Failed {
            what: "it was undone".to_owned(),
            rank: 3,
            at_ns: None,
        },
        api::Outcome::Failed { failure, .. } => {
            let who = failure.member.as_deref();
            let who = who.map_or_else(String::new, |who| format!("`{who}`: "));
            let mut what = format!("{who}{}", failure.words());
            for line in &failure.lines {
                what.push_str(&format!("\n  | {line}"));
            }
            Outcome::Failed {
                what,
                rank: failure.rank,
                at_ns: Some(failure.at_ns),
            }
        }
    }
}

async fn at(due: Option<tokio::time::Instant>) {
    if let Some(due) = due {
        tokio::time::sleep_until(due).await;
    }
}

/// Who takes leases, in words: a hint for others.
pub(crate) fn who(verb: &str) -> String {
    let user = std::env::var("USER").unwrap_or_else(|_| "somebody".to_owned());
    let host = rustix::system::uname();
    let host = host.nodename().to_string_lossy().into_owned();
    format!("{user}@{host} (ictus {verb}, pid {})", std::process::id())
}

/// Bytes as people read them.
pub(crate) fn size(bytes: u64) -> String {
    const UNITS: [(&str, u64); 3] = [("GB", 1_000_000_000), ("MB", 1_000_000), ("kB", 1_000)];
    for (unit, factor) in UNITS {
        if bytes >= factor {
            let tenths = bytes / (factor / 10);
            return format!("{}.{} {unit}", tenths / 10, tenths % 10);
        }
    }
    format!("{bytes} B")
}

/// An event with its host, for what is told as it comes.
fn told(host: &str, event: &Event) -> String {
    format!("{host}: {}", describe(event))
}
