//! All federations of this host: which live, which are only on disk.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::{broadcast, watch};
use tokio::time::Instant;

use crate::agent::RTI;
use crate::api::{
    ApiError, ErrorCode, Failure, FailureKind, FederateMeasures, FederationMeasures,
    FederationView, Happening, MemberView, Outcome, Removed, StartRequest, State,
    secret::{SecretValues, StartCall},
};
use crate::federation::container::Images;
use crate::federation::{BeginError, Command, Federation, Handle};
use crate::leases::Leases;
use crate::metrics::{self, Snapshot};
use crate::paths::Paths;
use crate::scrape::Listeners;
use crate::store::{self, Directory, Leave, Record, StoreError};
use crate::{rescue, secrets, stamp};

mod foreign;
mod images;
mod needs;
mod parts;
mod recorded;

pub(crate) use needs::{account, unnamed};

/// Events that a slow follower may miss before it is disconnected.
const EVENTS_MAX: usize = 4096;

/// The registry of federations; clones share it.
#[derive(Clone, Debug)]
pub(crate) struct Host(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    paths: Paths,
    living: Mutex<BTreeMap<String, Handle>>,
    /// Where metrics are served over TCP.
    listeners: Mutex<Listeners>,
    leases: Mutex<Leases>,
    /// The origin of the leases' time.
    origin: Instant,
    told: broadcast::Sender<Happening>,
    /// When something was last asked or owned.
    active: watch::Sender<Instant>,
    end: watch::Sender<bool>,
}

impl Host {
    pub(crate) fn new(paths: Paths) -> Self {
        Self(Arc::new(Inner {
            paths,
            living: Mutex::default(),
            listeners: Mutex::default(),
            leases: Mutex::default(),
            origin: Instant::now(),
            told: broadcast::channel(EVENTS_MAX).0,
            active: watch::channel(Instant::now()).0,
            end: watch::channel(false).0,
        }))
    }

    pub(crate) fn paths(&self) -> &Paths {
        &self.0.paths
    }

    /// Takes over every run that an earlier daemon left; returns when the members of each were looked at.
    pub(crate) async fn adopt_all(&self) {
        self.restore_leases();
        let mut adopted = Vec::new();
        for name in store::names(&self.0.paths.federations()) {
            let directory = self.directory(&name);
            match recorded(&name, &directory) {
                Ok(Some(record)) if record.view.state == State::Prepared => {
                    tracing::info!(%name, run = record.view.id, "prepared, and not committed");
                    self.await_commit(&name, &record.view.id);
                }
                Ok(Some(record)) if record.view.state == State::WaitingForSecrets => {}
                Ok(Some(record)) if lost_secrets(&record, &directory) => {
                    self.wait_for_secrets(&directory, record);
                }
                Ok(Some(mut record)) if record.view.outcome.is_none() => {
                    record.view.metrics = self.listen_again(&name, &directory);
                    let told = self.0.told.clone();
                    match Federation::adopt(&self.0.paths, directory, record, told) {
                        Ok((federation, handle)) => {
                            adopted.push(handle.probed.clone());
                            self.spawn(name, federation, handle);
                        }
                        Err(error) => tracing::error!(%name, %error, "not adopted"),
                    }
                }
                Ok(Some(_)) => {
                    // A daemon that was killed at the end may have left them.
                    self.remove_secrets(&name).ok();
                }
                Ok(None) => {}
                Err(error) => tracing::error!(%name, %error, "not adopted"),
            }
        }
        for mut probed in adopted {
            // Fails when it has ended, which is told, too.
            probed.wait_for(|probed| *probed).await.ok();
        }
    }

    /// Nothing of the run lives, and it is not started again without its secrets.
    fn wait_for_secrets(&self, directory: &Directory, mut record: Record) {
        let name = record.view.name.clone();
        tracing::info!(%name, "its secrets are gone with the host's memory; it waits for `ictus up`");
        record.view.state = State::WaitingForSecrets;
        // Killed, their supervisors could not remove their sockets; containers' go with them.
        let members = record.members.values();
        for member in members.filter(|member| member.container.is_none()) {
            crate::files::remove(&member.socket).ok();
        }
        for member in record
            .view
            .federates
            .iter_mut()
            .chain([&mut record.view.rti])
        {
            (member.state, member.pid) = ("waiting".to_owned(), None);
        }
        if let Err(error) = directory.write_record(&record) {
            tracing::error!(%name, %error, "the record was not written");
        }
    }

    /// Begins a federation; every later event of it reaches `subscribe`d receivers.
    pub(crate) fn start(&self, name: &str, call: StartCall) -> Result<Handle, ApiError> {
        let StartCall { request, secrets } = call;
        validate(name, &request)?;
        self.check_fence(name, None)?;
        if let Some(living) = self.handle(name) {
            return Err(self.already_running(name, living.request == request, &secrets)?);
        }
        self.check_driven(name)?;
        self.check_needs(&request)?;
        let metrics = self.listen(name, request.settings.metrics_listen)?;
        let begun = self.begin(name, (request, metrics), &secrets);
        let (federation, handle) = begun.inspect_err(|_| {
            self.remove_secrets(name).ok();
            self.listeners().release(name);
        })?;
        self.spawn(name.to_owned(), federation, handle.clone());
        Ok(handle)
    }

    /// Lays down what a run needs; on an error its secrets may be there.
    fn begin(
        &self,
        name: &str,
        (request, metrics): (StartRequest, Option<SocketAddr>),
        secrets: &SecretValues,
    ) -> Result<(Federation, Handle), ApiError> {
        let secrets = self.hand_over(name, &request, secrets)?;
        let told = self.0.told.clone();
        let begun = Federation::start(&self.0.paths, name, (request, metrics, secrets), told);
        let (federation, handle) = begun.map_err(|error| begin_error(&error))?;
        self.admit_users(&self.directory(name), &handle.request)?;
        Ok((federation, handle))
    }

    /// What a start is told when the federation runs; `same` when its request is the same.
    fn already_running(
        &self,
        name: &str,
        same: bool,
        secrets: &SecretValues,
    ) -> Result<ApiError, ApiError> {
        let changed = self.changed_secrets(name, secrets)?;
        let changed = changed
            .iter()
            .find_map(|(federate, names)| Some((federate, names.first()?)));
        let (code, message) = match changed {
            Some((federate, secret)) => (
                ErrorCode::Conflict,
                format!(
                    "federation `{name}` is already running, with another value of secret `{secret}` of federate `{federate}`"
                ),
            ),
            None if same => (
                ErrorCode::AlreadyRunning,
                format!("federation `{name}` is already running"),
            ),
            None => (
                ErrorCode::Conflict,
                format!("federation `{name}` is already running"),
            ),
        };
        Ok(error(code, message))
    }

    /// The federation of this name, if it lives.
    pub(crate) fn handle(&self, name: &str) -> Option<Handle> {
        self.living().get(name).cloned()
    }

    /// Every event from now on.
    pub(crate) fn subscribe(&self) -> broadcast::Receiver<Happening> {
        self.0.told.subscribe()
    }

    /// A federation as it is, or as it ended.
    pub(crate) fn view(&self, name: &str) -> Result<FederationView, ApiError> {
        if let Some(handle) = self.handle(name) {
            return Ok(handle.view.borrow().clone());
        }
        self.check_known(name)?;
        let directory = self.directory(name);
        match recorded(name, &directory) {
            Ok(Some(record)) => Ok(record.view),
            Ok(None) => Err(self.unknown(name)),
            Err(error) => Ok(unreadable_view(name, &directory, &error)),
        }
    }

    /// What was measured in a federation that lives or has ended and was not taken down.
    pub(crate) async fn measures(&self, name: &str) -> Result<FederationMeasures, ApiError> {
        if let Some(handle) = self.handle(name)
            && let Some(measures) = handle.measures().await
        {
            return Ok(measures);
        }
        let view = self.view(name)?;
        let kept = self.directory(name).read_measures();
        if !kept.federates.is_empty() {
            return Ok(kept);
        }
        let federates = view.federates.iter();
        Ok(FederationMeasures {
            federation: view.name,
            federates: federates.map(|it| FederateMeasures::of(&it.name)).collect(),
        })
    }

    /// All federations as Prometheus reads it.
    pub(crate) async fn metrics(&self) -> String {
        let mut snapshots = Vec::new();
        for name in self.names() {
            // Taken down, maybe meanwhile.
            let (Ok(measures), Ok(view)) = (self.measures(&name).await, self.view(&name)) else {
                continue;
            };
            let request = self.handle(&name).map(|handle| handle.request);
            let request = request.or_else(|| self.directory(&name).read_request().ok());
            let plan = request.map(|request| request.plan);
            snapshots.push(Snapshot {
                view,
                measures,
                plan,
            });
        }
        metrics::page(&snapshots)
    }

    /// Listens where a new run wants its metrics to be served, and no longer where the last one did.
    fn listen(
        &self,
        name: &str,
        wanted: Option<SocketAddr>,
    ) -> Result<Option<SocketAddr>, ApiError> {
        let Some(wanted) = wanted else {
            self.listeners().release(name);
            return Ok(None);
        };
        let claimed = self.listeners().claim(self, name, wanted);
        claimed.map(Some).map_err(|error| ApiError {
            code: ErrorCode::Failed,
            message: format!("cannot serve metrics at {wanted}: {error}"),
            known: Vec::new(),
        })
    }

    /// The same for a run that is taken over: it goes on without, if need be.
    fn listen_again(&self, name: &str, directory: &Directory) -> Option<SocketAddr> {
        let wanted = directory.read_request().ok()?.settings.metrics_listen;
        self.listen(name, wanted).unwrap_or_else(|error| {
            tracing::warn!(%name, error = error.message, "no metrics over TCP");
            None
        })
    }

    /// Every federation that lives or has ended and was not taken down.
    pub(crate) fn views(&self) -> Vec<FederationView> {
        self.names()
            .iter()
            .filter_map(|name| self.view(name).ok())
            .collect()
    }

    /// The directory of a federation that lives, has ended, or was taken down with its logs kept.
    pub(crate) fn known_directory(&self, name: &str) -> Result<Directory, ApiError> {
        self.check_known(name)?;
        Ok(self.directory(name))
    }

    /// Stops a federation if it lives, waits for its end, and removes what it left.
    pub(crate) async fn remove(
        &self,
        name: &str,
        (leave, fence): (Leave, Option<u64>),
    ) -> Result<Removed, ApiError> {
        self.check_fence(name, fence)?;
        self.check_known(name)?;
        let mut outcome = self.view(name).ok().and_then(|view| view.outcome);
        if let Some(mut handle) = self.handle(name) {
            handle.commands.send(Command::Stop).await.ok();
            // Fails when the driver is gone, which is what is waited for.
            while handle.view.changed().await.is_ok() {}
            outcome = handle.view.borrow().outcome.clone();
        }
        self.check_driven(name)?;
        self.listeners().release(name);
        let seen = self.view(name).ok().map(|view| view.id);
        self.check_fence(name, fence)?;
        self.remove_containers(name, Images::Remove).await?;
        // Whoever has taken over meanwhile may have begun another run.
        self.check_fence(name, fence)?;
        if self.handle(name).is_some() || self.view(name).ok().map(|view| view.id) != seen {
            let what = format!("federation `{name}` was begun again by somebody else meanwhile");
            return Err(error(ErrorCode::Conflict, what));
        }
        self.settle(name);
        self.remove_secrets(name)?;
        let kept = self
            .directory(name)
            .remove(leave)
            .map_err(|error| store_error(&error))?;
        if leave != Leave::Logs {
            // Only when it was the last one.
            std::fs::remove_dir(self.0.paths.federations()).ok();
        }
        if !self.0.paths.federations().exists() {
            // With the last record its MACs are gone.
            crate::files::remove(&self.0.paths.secrets_key()).ok();
        }
        self.collect_blobs();
        Ok(Removed { outcome, kept })
    }

    /// Notes that somebody asked for something.
    pub(crate) fn touch(&self) {
        self.0.active.send_replace(Instant::now());
    }

    /// When something was last asked for or owned.
    pub(crate) fn last_active(&self) -> Instant {
        if self.owns_something() {
            self.touch();
        }
        *self.0.active.borrow()
    }

    /// Ends the daemon if it owns nothing; tells whether it does.
    pub(crate) fn end_if_idle(&self) -> bool {
        let idle = !self.owns_something();
        if idle {
            self.0.end.send_replace(true);
        }
        idle
    }

    /// Ends the daemon, and nothing else.
    pub(crate) fn end(&self) {
        self.0.end.send_replace(true);
    }

    /// Waits until [`Host::end_if_idle`] has succeeded.
    pub(crate) async fn ended(&self) {
        let mut end = self.0.end.subscribe();
        end.wait_for(|end| *end).await.ok();
    }

    fn spawn(&self, name: String, federation: Federation, handle: Handle) {
        self.living().insert(name.clone(), handle);
        let host = self.clone();
        tokio::spawn(async move {
            federation.run().await;
            // No await in between: who saw the end can start the same name again.
            host.living().remove(&name);
            host.settle(&name);
            host.touch();
        });
    }

    fn directory(&self, name: &str) -> Directory {
        Directory::of(&self.0.paths.federations(), name)
    }

    /// Names of federations that live or have anything on disk, sorted.
    pub(crate) fn names(&self) -> Vec<String> {
        let mut names = store::names(&self.0.paths.federations());
        // Somebody may have removed the directory of one that lives.
        names.extend(self.living().keys().cloned());
        names.sort();
        names.dedup();
        names
    }

    /// The run that is prepared, and not committed.
    fn prepared(&self, name: &str) -> Option<String> {
        let record = recorded(name, &self.directory(name)).ok().flatten();
        let prepared = record.filter(|record| record.view.state == State::Prepared);
        prepared.map(|record| record.view.id)
    }

    /// Whether anything runs that would have nobody to stop it without a daemon.
    fn owns_something(&self) -> bool {
        // A prepared part is given up by a daemon that is there.
        let undriven =
            |name: &String| self.prepared(name).is_some() || self.check_driven(name).is_err();
        !self.living().is_empty()
            || !self.lease_views().is_empty()
            || self.names().iter().any(undriven)
    }

    /// Refuses when processes of a run live that this daemon cannot drive.
    fn check_driven(&self, name: &str) -> Result<(), ApiError> {
        let directory = self.directory(name);
        let why = match recorded(name, &directory) {
            Ok(Some(record))
                if record.view.outcome.is_some()
                    || [State::Prepared, State::WaitingForSecrets].contains(&record.view.state) =>
            {
                return Ok(());
            }
            Ok(Some(_)) => directory.read_request().map(|_| ()),
            Ok(None) => Ok(()),
            Err(error) => Err(error),
        };
        let why = why.map_or_else(
            |error| with_sources(&error),
            |()| format!("{} is incomplete", directory.path().display()),
        );
        let living = rescue::living(&directory);
        if living.is_empty() {
            return Ok(());
        }
        let pid = |pid: &Option<i32>| pid.map_or_else(|| "unknown".to_owned(), |it| it.to_string());
        let living: Vec<_> = living
            .iter()
            .map(|(member, id)| format!("{member} (supervisor {})", pid(id)))
            .collect();
        Err(ApiError {
            code: ErrorCode::Failed,
            message: format!(
                "federation `{name}` runs, but cannot be driven: {why}; use the version that wrote it, or \
                 end its supervisors with `kill`: {}",
                living.join(", ")
            ),
            known: Vec::new(),
        })
    }

    fn check_known(&self, name: &str) -> Result<(), ApiError> {
        let known = store::is_name(name)
            && (self.directory(name).path().is_dir() || self.living().contains_key(name));
        if known {
            Ok(())
        } else {
            Err(self.unknown(name))
        }
    }

    fn unknown(&self, name: &str) -> ApiError {
        ApiError {
            code: ErrorCode::Unknown,
            message: format!("there is no federation `{name}`"),
            known: self.names(),
        }
    }

    fn leases(&self) -> MutexGuard<'_, Leases> {
        let leases = self.0.leases.lock();
        leases.unwrap_or_else(PoisonError::into_inner)
    }

    /// The leases' time.
    fn since(&self) -> std::time::Duration {
        self.0.origin.elapsed()
    }

    fn listeners(&self) -> MutexGuard<'_, Listeners> {
        let listeners = self.0.listeners.lock();
        listeners.unwrap_or_else(PoisonError::into_inner)
    }

    fn living(&self) -> MutexGuard<'_, BTreeMap<String, Handle>> {
        // The map is consistent after every operation on it.
        self.0.living.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The record, made again when it is damaged; absent when the run was taken down.
fn recorded(name: &str, directory: &Directory) -> Result<Option<Record>, StoreError> {
    match directory.read_record() {
        Ok(None) => Ok(rescue::record(name, directory)),
        Err(error @ (StoreError::Damaged { .. } | StoreError::Io { .. })) => {
            rescue::record(name, directory).map(Some).ok_or(error)
        }
        read => read,
    }
}

/// What can be said of a run whose record cannot be used.
fn unreadable_view(name: &str, directory: &Directory, error: &StoreError) -> FederationView {
    let living = !rescue::living(directory).is_empty();
    FederationView {
        name: name.to_owned(),
        state: if living { State::Running } else { State::Ended },
        id: String::new(),
        since_ns: stamp::now_ns(),
        manifest: PathBuf::new(),
        directory: directory.path().to_path_buf(),
        rti_port: None,
        metrics: None,
        start_ns: None,
        rti: MemberView::default(),
        federates: Vec::new(),
        outcome: Some(Outcome::Failed {
            failure: Failure {
                kind: match error {
                    StoreError::Newer { .. } => FailureKind::NewerRecord,
                    StoreError::Io { .. }
                    | StoreError::Others { .. }
                    | StoreError::Damaged { .. } => FailureKind::Process,
                },
                member: None,
                rank: 0,
                what: format!("unreadable: {}", with_sources(error)),
                reason: None,
                lines: Vec::new(),
                log: None,
                at_ns: stamp::now_ns(),
            },
            was_healthy: true,
        }),
        part: None,
        digest: String::new(),
        facets: BTreeMap::new(),
        generation: None,
    }
}

fn validate(name: &str, request: &StartRequest) -> Result<(), ApiError> {
    let bad = |message: String| ApiError {
        code: ErrorCode::BadRequest,
        message,
        known: Vec::new(),
    };
    if !store::is_name(name) {
        return Err(bad(format!("`{name}` cannot be a federation's name")));
    }
    let names = request
        .plan
        .federates
        .iter()
        .map(|federate| federate.name.as_str());
    if !names.eq(request.federates.iter().map(|run| run.name.as_str())) {
        return Err(bad("plan and federates do not match".to_owned()));
    }
    for (run, id) in request.federates.iter().zip(0_u16..) {
        if run.id != id || !store::is_name(&run.name) || run.name == RTI {
            return Err(bad(format!("`{}` cannot be a federate's name", run.name)));
        }
    }
    Ok(())
}

/// Whether a run that has not ended lost its secrets with the host's memory: then nothing of it lives either.
fn lost_secrets(record: &Record, directory: &Directory) -> bool {
    let lost = |kept| !secrets::are_there(kept);
    record.view.outcome.is_none()
        && record.view.state != State::Prepared
        && record.secrets.as_ref().is_some_and(lost)
        && rescue::living(directory).is_empty()
}

fn begin_error(error: &BeginError) -> ApiError {
    ApiError {
        code: ErrorCode::Failed,
        message: with_sources(error),
        known: Vec::new(),
    }
}

fn store_error(error: &StoreError) -> ApiError {
    ApiError {
        code: ErrorCode::Failed,
        message: with_sources(error),
        known: Vec::new(),
    }
}

/// An error and its sources on one line.
pub(crate) fn with_sources(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        text.push_str(&format!(": {error}"));
        if is_full(error) {
            text.push_str("; free space there (`df` says where it went)");
        }
        source = error.source();
    }
    text
}

fn error_of(message: String) -> ApiError {
    error(ErrorCode::Failed, message)
}

fn error(code: ErrorCode, message: String) -> ApiError {
    ApiError {
        code,
        message,
        known: Vec::new(),
    }
}

/// Whether a disk did not take what was written.
fn is_full(error: &(dyn std::error::Error + 'static)) -> bool {
    let io = error.downcast_ref::<std::io::Error>();
    let full = [
        std::io::ErrorKind::StorageFull,
        std::io::ErrorKind::QuotaExceeded,
    ];
    io.is_some_and(|error| full.contains(&error.kind()))
}
