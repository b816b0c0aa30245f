//! The driver of one federation: moves what supervisors say into the [`Agent`] and carries out its actions.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::net::{SocketAddr, SocketAddrV4};
use std::time::Duration;

use ictus_deploy::Engine;
use tokio::sync::{broadcast, mpsc, oneshot, watch};
use tokio::time::{Instant, sleep_until};

use crate::agent::{Action, Agent, MemberId, Now, RTI};
use crate::api::{
    Event, FederationMeasures, FederationView, Happening, MemberView, Outcome, StartRequest, State,
};
use crate::docker::ContainerSpec;
use crate::identity::random_id;
use crate::paths::Paths;
use crate::secrets::{self, KeptSecrets};
use crate::stamp;
use crate::store::{Directory, Record, StoreError, Supervised};
use crate::supervisor::log_path;
use crate::supervisor::protocol::StopSignal;
use crate::supervisor::spec::PROTOCOL;

pub(crate) mod container;
pub(crate) mod launch;
mod link;
mod order;

use container::{Contained, Images};
use launch::Run;
use link::{Heard, Link, Origin};
use order::Order;

/// Commands and supervisors' words waiting for the driver.
const QUEUE_MAX: usize = 256;
/// Signals waiting for a supervisor's link: at most one SIGTERM and one SIGKILL per rung of the ladder.
const SIGNALS_MAX: usize = 16;
/// How long the supervisors of an earlier daemon may take to answer before the view does without them.
const PROBE_MAX: Duration = Duration::from_secs(2);

/// What a client may ask of a federation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Command {
    /// Stop in order.
    Stop,
    /// End at once.
    Kill,
    /// Who asked for the start is gone.
    StarterGone,
}

/// The way to a federation that lives.
#[derive(Clone, Debug)]
pub(crate) struct Handle {
    pub(crate) request: StartRequest,
    pub(crate) commands: mpsc::Sender<Command>,
    pub(crate) view: watch::Receiver<FederationView>,
    /// Whether the view is this daemon's own and not an earlier one's.
    pub(crate) probed: watch::Receiver<bool>,
    asks: mpsc::Sender<oneshot::Sender<FederationMeasures>>,
}

impl Handle {
    /// What is measured; absent when the federation has ended meanwhile.
    pub(crate) async fn measures(&self) -> Option<FederationMeasures> {
        let (answer, answered) = oneshot::channel();
        self.asks.send(answer).await.ok()?;
        answered.await.ok()
    }
}

/// Why a federation could not be begun.
#[derive(Debug, thiserror::Error)]
pub(crate) enum BeginError {
    /// The disk does not take its records.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// No random numbers.
    #[error("cannot make a random id")]
    Random(#[source] io::Error),
}

/// The driver's state; one task owns it.
#[derive(Debug)]
pub(crate) struct Federation {
    paths: Paths,
    directory: Directory,
    request: StartRequest,
    agent: Agent,
    record: Record,
    links: BTreeMap<MemberId, mpsc::Sender<StopSignal>>,
    heard: mpsc::Receiver<Heard>,
    hear: mpsc::Sender<Heard>,
    commands: mpsc::Receiver<Command>,
    asks: mpsc::Receiver<oneshot::Sender<FederationMeasures>>,
    view: watch::Sender<FederationView>,
    probed: watch::Sender<bool>,
    told: broadcast::Sender<Happening>,
    /// Members of an earlier daemon that have not said everything that happened before.
    adopting: BTreeSet<MemberId>,
    order: Order,
    /// Events up to here were told by an earlier daemon.
    told_until_ns: i64,
    /// When the last event was told.
    told_last_ns: i64,
    /// When what is being handled happened.
    at_ns: i64,
    origin: Instant,
}

impl Federation {
    /// Clears the disk for a new run and begins it.
    pub(crate) fn start(
        paths: &Paths,
        name: &str,
        (request, metrics, secrets): (StartRequest, Option<SocketAddr>, Option<KeptSecrets>),
        told: broadcast::Sender<Happening>,
    ) -> Result<(Self, Handle), BeginError> {
        let id = random_id().map_err(BeginError::Random)?;
        let (directory, mut record) = Self::prepare(paths, name, &request, id)?;
        record.view.metrics = metrics;
        record.secrets = secrets;
        Ok(Self::begin(paths, directory, (request, record, None), told))
    }

    /// Clears the disk for a new run and writes what it needs; nothing of it runs.
    pub(crate) fn prepare(
        paths: &Paths,
        name: &str,
        request: &StartRequest,
        id: String,
    ) -> Result<(Directory, Record), StoreError> {
        let directory = Directory::of(&paths.federations(), name);
        directory.prepare(request)?;
        let view = FederationView {
            name: name.to_owned(),
            state: State::Prepared,
            id,
            since_ns: stamp::now_ns(),
            manifest: request.manifest.clone(),
            directory: directory.path().to_path_buf(),
            rti_port: None,
            metrics: None,
            start_ns: None,
            rti: MemberView::default(),
            federates: Vec::new(),
            outcome: None,
            part: request.part.clone(),
            digest: String::new(),
            facets: BTreeMap::new(),
            generation: None,
        };
        let record = Record {
            protocol: PROTOCOL,
            members: BTreeMap::new(),
            rti: None,
            ports: BTreeMap::new(),
            secrets: None,
            view,
        };
        Ok((directory, record))
    }

    /// Begins a run that is prepared; `rti` is where its RTI listens, when that is another host.
    pub(crate) fn begin(
        paths: &Paths,
        directory: Directory,
        (request, mut record, rti): (StartRequest, Record, Option<SocketAddrV4>),
        told: broadcast::Sender<Happening>,
    ) -> (Self, Handle) {
        record.view.state = State::Starting;
        record.rti = rti;
        if let Some(rti) = rti {
            record.view.rti_port = Some(rti.port());
        }
        let origin = Instant::now();
        let agent = Agent::start(now(origin), &request, rti.map(|rti| rti.port()));
        let state = (agent, record, origin);
        Self::new(paths.clone(), directory, request, state, told)
    }

    /// Takes over a run that another daemon began.
    pub(crate) fn adopt(
        paths: &Paths,
        directory: Directory,
        record: Record,
        told: broadcast::Sender<Happening>,
    ) -> Result<(Self, Handle), StoreError> {
        let request = directory.read_request()?;
        let origin = Instant::now();
        let launched = |id| record.members.contains_key(member_name(&request, id));
        let known = (record.view.state, record.view.rti_port);
        let agent = Agent::adopt(now(origin), &request, known, launched);
        let state = (agent, record, origin);
        let (mut federation, handle) = Self::new(paths.clone(), directory, request, state, told);
        let kept = federation.directory.events_kept();
        federation.told_until_ns = kept
            .iter()
            .map(|happening| happening.at_ns)
            .max()
            .unwrap_or(0);
        for id in federation.ids() {
            let name = member_name(&federation.request, id).to_owned();
            if let Some(supervised) = federation.record.members.get(&name).cloned() {
                federation.adopting.insert(id);
                let origin = Origin::Adopt(supervised.supervisor);
                federation.link(id, &name, &supervised, origin);
            }
        }
        Ok((federation, handle))
    }

    fn new(
        paths: Paths,
        directory: Directory,
        request: StartRequest,
        (agent, record, origin): (Agent, Record, Instant),
        told: broadcast::Sender<Happening>,
    ) -> (Self, Handle) {
        let (hear, heard) = mpsc::channel(QUEUE_MAX);
        let (command, commands) = mpsc::channel(QUEUE_MAX);
        let (ask, asks) = mpsc::channel(QUEUE_MAX);
        let (view, seen) = watch::channel(record.view.clone());
        let (probed, first_probe) = watch::channel(false);
        let handle = Handle {
            request: request.clone(),
            commands: command,
            view: seen,
            probed: first_probe,
            asks: ask,
        };
        let federation = Self {
            paths,
            directory,
            request,
            agent,
            record,
            links: BTreeMap::new(),
            heard,
            hear,
            commands,
            asks,
            view,
            probed,
            told,
            adopting: BTreeSet::new(),
            order: Order::default(),
            told_until_ns: 0,
            told_last_ns: 0,
            at_ns: stamp::now_ns(),
            origin,
        };
        (federation, handle)
    }

    /// Drives the federation to its end.
    pub(crate) async fn run(mut self) {
        loop {
            self.drain();
            if let Some(outcome) = self.agent.outcome() {
                let undone = matches!(
                    outcome,
                    Outcome::Aborted
                        | Outcome::Failed {
                            was_healthy: false,
                            ..
                        }
                );
                if undone {
                    self.undo().await;
                }
                self.remove_secrets();
                return;
            }
            let timeout = self.agent.poll_timeout().map(|until| self.origin + until);
            tokio::select! {
                Some(heard) = self.heard.recv() => {
                    self.order.push(heard);
                    self.handle_all();
                }
                Some(command) = self.commands.recv() => self.obey(command),
                Some(answer) = self.asks.recv() => {
                    // Who asked may be gone.
                    answer.send(self.measures()).ok();
                }
                () = sleep_until(timeout.unwrap_or(self.origin)), if timeout.is_some() => {
                    self.at_ns = stamp::now_ns();
                    self.agent.handle_timeout(now(self.origin));
                }
                () = sleep_until(self.origin + PROBE_MAX), if !self.adopting.is_empty() => {
                    tracing::warn!(members = ?self.adopting, "supervisors that do not answer");
                    self.adopting.clear();
                    self.order.expect_nobody();
                    self.handle_all();
                }
            }
        }
    }

    /// Removes what a start that failed has made.
    async fn undo(&self) {
        if self.in_containers() {
            let swept =
                container::sweep(&self.record.view.name, Some(&self.record), Images::Remove).await;
            if let Err(error) = swept {
                tracing::warn!(%error, "perhaps containers or images were left");
            }
        }
        if let Err(error) = self.directory.undo() {
            tracing::warn!(%error, "not everything was undone");
        }
    }

    /// Nothing runs that could read them.
    fn remove_secrets(&self) {
        let (name, kept) = (&self.record.view.name, self.record.secrets.as_ref());
        if kept.is_some()
            && let Err(error) = secrets::remove(&self.paths, name, kept)
        {
            tracing::warn!(%error, "secrets were not removed");
        }
    }

    fn in_containers(&self) -> bool {
        let part = self.request.part.as_ref();
        part.is_some_and(|part| part.engine == Engine::Docker)
    }

    fn handle_all(&mut self) {
        while let Some(heard) = self.order.next() {
            self.handle(heard);
            // What follows from it is told with its time.
            self.drain();
        }
    }

    fn handle(&mut self, heard: Heard) {
        match heard {
            Heard::Identified { member, supervisor } => {
                let name = member_name(&self.request, member);
                if let Some(supervised) = self.record.members.get_mut(name) {
                    supervised.supervisor = Some(supervisor);
                    self.save();
                }
            }
            Heard::CaughtUp { member } => {
                self.adopting.remove(&member);
            }
            Heard::Event {
                member,
                at_ns,
                event,
            } => {
                self.at_ns = at_ns;
                self.agent.handle_member(now(self.origin), member, event);
            }
        }
    }

    fn obey(&mut self, command: Command) {
        self.at_ns = stamp::now_ns();
        let now = now(self.origin);
        match command {
            Command::Stop => self.agent.handle_stop(now),
            Command::Kill => self.agent.handle_kill(now),
            Command::StarterGone => self.agent.handle_starter_gone(now),
        }
    }

    /// Carries out every action; launches last, because their records must be on disk before.
    fn drain(&mut self) {
        let mut launches = Vec::new();
        while let Some(action) = self.agent.poll_action() {
            match action {
                Action::Launch { member, rti_port } => launches.push((member, rti_port)),
                Action::Signal { member, signal } => self.signal(member, signal),
                Action::Tell(event) => self.tell(event),
            }
        }
        let mut ready = Vec::new();
        for (member, rti_port) in launches {
            match random_id() {
                Ok(instance) => {
                    let name = member_name(&self.request, member).to_owned();
                    let supervised = self.supervised(&name, instance);
                    self.record.members.insert(name.clone(), supervised.clone());
                    ready.push((member, name, rti_port, supervised));
                }
                Err(error) => tracing::error!(%error, "no random id"),
            }
        }
        self.update(!ready.is_empty());
        for (member, name, rti_port, supervised) in ready {
            let run = Run {
                paths: &self.paths,
                directory: &self.directory,
                request: &self.request,
                record: &self.record,
            };
            let origin = match launch::spec(&run, (member, rti_port), &supervised) {
                Ok(spec) => Origin::Launch(Box::new(spec)),
                Err(error) => Origin::Refused(error.message),
            };
            self.link(member, &name, &supervised, origin);
        }
    }

    /// What is recorded of a supervisor before it is started.
    fn supervised(&self, member: &str, instance: String) -> Supervised {
        let docker = self.in_containers();
        let container =
            docker.then(|| ContainerSpec::name_of(&self.record.view.name, member, &instance));
        let socket = if docker {
            self.paths.contained_socket(&instance)
        } else {
            self.paths.supervisor_socket(&instance)
        };
        Supervised {
            instance,
            socket,
            container,
            supervisor: None,
        }
    }

    fn link(&mut self, member: MemberId, name: &str, supervised: &Supervised, origin: Origin) {
        self.order.expect(member);
        let (signal, signals) = mpsc::channel(SIGNALS_MAX);
        self.links.insert(member, signal);
        let run = Run {
            paths: &self.paths,
            directory: &self.directory,
            request: &self.request,
            record: &self.record,
        };
        let link = Link {
            contained: Contained::of(&run, member, supervised),
            handle: None,
            supervisor: None,
            child: None,
            member,
            socket: supervised.socket.clone(),
            spec: self.directory.spec(name),
            exit_record: self.directory.exit_record(name),
            instance: supervised.instance.clone(),
            hear: self.hear.clone(),
            signals,
        };
        tokio::spawn(link.run(origin));
    }

    fn signal(&self, member: MemberId, signal: StopSignal) {
        if let Some(link) = self.links.get(&member)
            && let Err(error) = link.try_send(signal)
        {
            tracing::warn!(?member, ?signal, %error, "a signal was not passed on");
        }
    }

    fn tell(&mut self, event: Event) {
        let event = if let Event::Ended { outcome } = event {
            Event::Ended {
                outcome: outcome_with_log(outcome, &self.directory),
            }
        } else {
            event
        };
        let ended = matches!(event, Event::Ended { .. });
        if self.at_ns <= self.told_until_ns && !ended {
            return;
        }
        // Supervisors read at their own pace; what is told stays in order.
        self.told_last_ns = self.told_last_ns.max(self.at_ns);
        let federation = self.record.view.name.clone();
        let happening = Happening {
            at_ns: self.told_last_ns,
            federation,
            event,
        };
        if let Err(error) = self.directory.append_event(&happening) {
            tracing::warn!(%error, "an event was not kept");
        }
        // Nobody may be listening.
        self.told.send(happening).ok();
    }

    /// Publishes the view, and writes the record when something other than progress changed.
    fn update(&mut self, launching: bool) {
        if !self.adopting.is_empty() && self.agent.outcome().is_none() {
            // Until everything is known, what the earlier daemon knew is nearer to the truth.
            return;
        }
        let view = FederationView {
            state: self.agent.state(),
            // Of an RTI that does not answer, what the earlier daemon knew still holds.
            rti_port: self.agent.rti_port().or(self.record.view.rti_port),
            start_ns: self.agent.start_ns().or(self.record.view.start_ns),
            rti: self.agent.rti_view(),
            federates: self.agent.federate_views(),
            outcome: self
                .agent
                .outcome()
                .cloned()
                .map(|it| outcome_with_log(it, &self.directory)),
            ..self.record.view.clone()
        };
        let coarse = |view: &FederationView| {
            let states = view.federates.iter().chain([&view.rti]);
            let states: Vec<_> = states.map(|it| (it.state.clone(), it.pid)).collect();
            (view.state, view.outcome.clone(), states)
        };
        if view.outcome.is_some() && self.record.view.outcome.is_none() {
            // Before the record, which says that there is nothing to adopt any more.
            self.save_measures();
        }
        let changed = launching || coarse(&view) != coarse(&self.record.view);
        self.record.view = view.clone();
        if changed {
            self.save();
        }
        self.view.send_replace(view);
        self.probed.send_replace(true);
    }

    fn measures(&self) -> FederationMeasures {
        FederationMeasures {
            federation: self.record.view.name.clone(),
            federates: self.agent.measures(),
        }
    }

    fn save_measures(&self) {
        if let Err(error) = self.directory.write_measures(&self.measures()) {
            tracing::warn!(%error, "the measures were not kept");
        }
    }

    fn save(&self) {
        if let Err(error) = self.directory.write_record(&self.record) {
            tracing::error!(%error, "the record was not written");
        }
    }

    fn ids(&self) -> Vec<MemberId> {
        let federates = self
            .request
            .federates
            .iter()
            .map(|run| MemberId::Federate(run.id));
        std::iter::once(MemberId::Rti).chain(federates).collect()
    }
}

fn now(origin: Instant) -> Now {
    Now {
        since: origin.elapsed(),
        wall_ns: stamp::now_ns(),
    }
}

fn member_name(request: &StartRequest, id: MemberId) -> &str {
    match id {
        MemberId::Rti => RTI,
        MemberId::Federate(index) => &request.federates[usize::from(index)].name,
    }
}

fn outcome_with_log(mut outcome: Outcome, directory: &Directory) -> Outcome {
    if let Outcome::Failed { failure, .. } = &mut outcome {
        let member = failure.member.as_deref();
        failure.log = member.map(|member| log_path(&directory.logs(), member));
    }
    outcome
}
