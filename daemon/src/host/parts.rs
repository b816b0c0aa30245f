//! A host's part of a federation over several hosts: leases, blobs, prepare, commit.

use std::collections::BTreeSet;
use std::io::Read;
use std::time::Duration;

use ictus_deploy::Engine;
use ictus_deploy::placement::Security;
use tokio::time::sleep;

use crate::agent::{MemberId, RTI};
use crate::api::part::{
    CommitRequest, Lease, LeaseRequest, LeaseView, Part, PrepareRequest, Prepared,
};
use crate::api::{ApiError, ErrorCode, State};
use crate::blobs::{BlobError, Blobs};
use crate::federation::container::Images;
use crate::federation::launch::Run;
use crate::federation::{Federation, Handle, container};
use crate::files;
use crate::leases::{LeaseError, Leases};
use crate::ports::{self, Assigned};
use crate::secrets;
use crate::stamp;
use crate::store::{self, Leave, StoreError};

use super::{Host, error, error_of, recorded, store_error, validate, with_sources};

/// How long a prepared part waits for somebody to take its lease when an earlier daemon did not keep for how long it was
/// given.
const ABANDONED_AFTER: Duration = Duration::from_secs(30);

impl Host {
    /// Takes over what an earlier daemon kept of leases.
    pub(crate) fn restore_leases(&self) {
        let stored = std::fs::read(self.paths().leases());
        let stored = stored
            .ok()
            .and_then(|bytes| serde_json::from_slice(&bytes).ok());
        *self.leases() = Leases::restored(stored.unwrap_or_default(), self.since());
    }

    /// Gives a lease.
    pub(crate) fn take_lease(&self, name: &str, request: &LeaseRequest) -> Result<Lease, ApiError> {
        if !store::is_name(name) {
            let message = format!("`{name}` cannot be a federation's name");
            return Err(error(ErrorCode::BadRequest, message));
        }
        let now = (self.since(), stamp::now_ns());
        self.change_leases(|leases| leases.take(now, name, request))
    }

    /// Lets a lease last.
    pub(crate) fn renew_lease(&self, name: &str, fence: u64) -> Result<Lease, ApiError> {
        let since = self.since();
        self.leases()
            .renew(since, name, fence)
            .map_err(|e| held(&e))
    }

    /// Takes a lease back.
    pub(crate) fn release_lease(&self, name: &str, fence: u64) -> Result<(), ApiError> {
        let since = self.since();
        self.change_leases(|leases| leases.release(since, name, fence))
    }

    /// Takes a lease from whoever holds it, and writes down who did.
    pub(crate) fn break_lease(&self, name: &str, by: &str) -> Result<Option<LeaseView>, ApiError> {
        let since = self.since();
        let broken = self.change_leases(|leases| Ok(leases.break_off(since, name)))?;
        if let Some(lease) = &broken {
            tracing::warn!(federation = name, by, of = lease.who, "a lease was broken");
        }
        Ok(broken)
    }

    /// Leases that are held.
    pub(crate) fn lease_views(&self) -> Vec<LeaseView> {
        self.leases().views(self.since())
    }

    /// Refuses a change by anybody but the holder of the lease.
    pub(crate) fn check_fence(&self, name: &str, fence: Option<u64>) -> Result<(), ApiError> {
        let since = self.since();
        self.leases()
            .check(since, name, fence)
            .map_err(|e| held(&e))
    }

    /// Blobs that are not there.
    pub(crate) fn missing_blobs(&self, digests: &[String]) -> Result<Vec<String>, ApiError> {
        let missing = self.blobs().missing(digests);
        missing.map_err(|error| blob_error(&error))
    }

    /// Takes a blob.
    pub(crate) fn write_blob(&self, digest: &str, from: impl Read) -> Result<(), ApiError> {
        let written = self.blobs().write(digest, from);
        written.map_err(|error| blob_error(&error))
    }

    /// Removes blobs that no run of this host needs; those of a change that is under way are needed.
    pub(crate) fn collect_blobs(&self) {
        if !self.lease_views().is_empty() {
            return;
        }
        if let Err(error) = self.blobs().keep_only(&self.needed_blobs()) {
            tracing::warn!(%error, "blobs were not removed");
        }
    }

    /// Writes down a part that may be committed; nothing of it runs. What is left of an earlier run makes way.
    pub(crate) fn prepare(
        &self,
        name: &str,
        fence: u64,
        prepare: &PrepareRequest,
    ) -> Result<Prepared, ApiError> {
        self.check_fence(name, Some(fence))?;
        let request = &prepare.request;
        validate(name, request)?;
        let bad = |what: &str| error(ErrorCode::BadRequest, what.to_owned());
        let part = request
            .part
            .as_ref()
            .ok_or_else(|| bad("there is no part"))?;
        if !store::is_name(&prepare.id) {
            return Err(bad("the run's id is none"));
        }
        validate_part(part, request.federates.len()).map_err(|what| bad(&what))?;
        validate_papers(part, prepare).map_err(|what| bad(&what))?;
        self.check_previous(name, prepare)?;
        self.check_driven(name)?;
        let programs: Vec<_> = part.programs.values().cloned().collect();
        if let Some(missing) = self.missing_blobs(&programs)?.first() {
            let what = format!("program {missing} was not sent");
            return Err(error(ErrorCode::Failed, what));
        }
        self.check_needs(request)?;
        let ports = ports::assign(part, request, &self.promised_ports(name));
        let ports = ports.map_err(|error| error_of(error.to_string()))?;
        self.settle(name);
        let laid_down = self.lay_down(name, prepare, ports);
        laid_down.inspect_err(|_| {
            self.remove_secrets(name).ok();
        })
    }

    /// Writes what a part needs; on an error its secrets may be there.
    fn lay_down(
        &self,
        name: &str,
        prepare: &PrepareRequest,
        ports: Assigned,
    ) -> Result<Prepared, ApiError> {
        let request = &prepare.request;
        let secrets = self.hand_over(name, request, &prepare.secrets)?;
        let prepared = Federation::prepare(self.paths(), name, request, prepare.id.clone());
        let (directory, mut record) = prepared.map_err(|error| store_error(&error))?;
        record.secrets = secrets;
        for (member, papers) in &prepare.papers {
            let path = directory.papers(member);
            let written = papers.write(&path);
            written.map_err(|source| store_error(&StoreError::Io { path, source }))?;
        }
        self.admit_users(&directory, request)?;
        record.view.rti_port = ports.rti;
        record.ports = ports.federates;
        record.view.digest.clone_from(&prepare.digest);
        record.view.facets.clone_from(&prepare.facets);
        record.view.generation = prepare.generation;
        let written = directory.write_record(&record);
        written.map_err(|error| store_error(&error))?;
        self.await_commit(name, &record.view.id);
        Ok(Prepared {
            id: record.view.id,
            rti_port: record.view.rti_port,
        })
    }

    /// Removes a prepared part that nobody can commit any more: whoever held its lease is gone, and nobody has taken it for
    /// as long again. Until then whoever comes next finds what was planned on.
    pub(crate) fn await_commit(&self, name: &str, id: &str) {
        let (host, name, id) = (self.clone(), name.to_owned(), id.to_owned());
        tokio::spawn(async move { host.abandon(&name, &id).await });
    }

    async fn abandon(&self, name: &str, id: &str) {
        let (mut patience, mut alone) = (ABANDONED_AFTER, false);
        while self.prepared(name).as_deref() == Some(id) {
            let left = self.leases().left(self.since(), name);
            match left {
                Some((left, whole)) => {
                    (patience, alone) = (whole, false);
                    sleep(left).await;
                }
                None if !alone => {
                    alone = true;
                    sleep(patience).await;
                }
                None => {
                    tracing::warn!(name, run = id, "nobody has committed it; it is removed");
                    let Err(error) = self.remove(name, (Leave::Logs, None)).await else {
                        return;
                    };
                    if error.code != ErrorCode::Held {
                        tracing::error!(name, error = error.message, "not removed");
                        return;
                    }
                    alone = false;
                }
            }
        }
    }

    /// Ports that other federations of this host have, or will have when they are committed.
    fn promised_ports(&self, name: &str) -> BTreeSet<u16> {
        let others = self.names().into_iter().filter(|other| other != name);
        let records = others.filter_map(|other| self.directory(&other).read_record().ok()?);
        let alive = records.filter(|record| record.view.outcome.is_none());
        alive
            .flat_map(|record| {
                let part = record.view.part.as_ref();
                let rti = record.view.rti_port;
                let rti = rti.filter(|_| part.is_none_or(|part| part.rti));
                record.ports.into_values().chain(rti)
            })
            .collect()
    }

    /// Makes the images of a prepared part whose engine is Docker.
    pub(crate) async fn prepare_images(&self, name: &str) -> Result<(), ApiError> {
        let directory = self.directory(name);
        let failed = |error: &dyn std::error::Error| error_of(with_sources(error));
        let request = directory.read_request().map_err(|e| failed(&e))?;
        let Some(part) = request
            .part
            .as_ref()
            .filter(|part| part.engine == Engine::Docker)
        else {
            return Ok(());
        };
        let Some(record) = directory.read_record().map_err(|e| failed(&e))? else {
            return Ok(());
        };
        let run = Run {
            paths: self.paths(),
            directory: &directory,
            request: &request,
            record: &record,
        };
        let federates = part.federates.iter().map(|id| MemberId::Federate(*id));
        let members: Vec<_> = part
            .rti
            .then_some(MemberId::Rti)
            .into_iter()
            .chain(federates)
            .collect();
        container::prepare(&run, &members).await.map_err(|error| {
            let host = &part.host;
            error_of(format!("host `{host}`: {}", with_sources(&error)))
        })
    }

    /// Removes the containers that a run left, and its images unless they are kept. One that lives keeps its own.
    pub(crate) async fn remove_containers(
        &self,
        name: &str,
        images: Images,
    ) -> Result<(), ApiError> {
        if self.handle(name).is_some() {
            return Ok(());
        }
        let directory = self.directory(name);
        let part = directory
            .read_request()
            .ok()
            .and_then(|request| request.part);
        let record = recorded(name, &directory).map_err(|error| store_error(&error))?;
        // A start that was undone has left no request.
        let part = part.or_else(|| record.as_ref().and_then(|record| record.view.part.clone()));
        if part.is_none_or(|part| part.engine != Engine::Docker) {
            return Ok(());
        }
        container::sweep(name, record.as_ref(), images)
            .await
            .map_err(|error| error_of(format!("federation `{name}` leaves containers: {error}")))
    }

    /// Begins what was prepared.
    pub(crate) fn commit(&self, name: &str, commit: &CommitRequest) -> Result<Handle, ApiError> {
        self.check_fence(name, Some(commit.fence))?;
        let directory = self.known_directory(name)?;
        let record = recorded(name, &directory).map_err(|error| store_error(&error))?;
        let prepared = record.filter(|record| {
            record.view.state == State::Prepared
                && record.view.id == commit.id
                && self.handle(name).is_none()
        });
        let Some(mut record) = prepared else {
            let what = format!("run {} of federation `{name}` is not prepared", commit.id);
            return Err(error(ErrorCode::Conflict, what));
        };
        let request = directory
            .read_request()
            .map_err(|error| store_error(&error))?;
        if let Some(kept) = record
            .secrets
            .as_ref()
            .filter(|kept| !secrets::are_there(kept))
        {
            let what = format!(
                "federation `{name}` waits for secrets: {} is empty since the host was started again; `ictus up` sends them",
                kept.directory.display()
            );
            return Err(error(ErrorCode::Failed, what));
        }
        if let Some(part) = &request.part {
            // Somebody may have taken them since.
            let assigned = Assigned {
                rti: record.view.rti_port,
                federates: record.ports.clone(),
            };
            ports::check(part, &assigned).map_err(|error| error_of(error.to_string()))?;
        }
        record.view.metrics = self.listen(name, request.settings.metrics_listen)?;
        let entered = self.enter(name, &record, &request);
        entered.inspect_err(|_| self.listeners().release(name))?;
        let told = self.0.told.clone();
        let state = (request, record, commit.rti);
        let (federation, handle) = Federation::begin(self.paths(), directory, state, told);
        self.spawn(name.to_owned(), federation, handle.clone());
        Ok(handle)
    }

    /// The run that is there must be the one that was seen when this was planned, and must not run.
    fn check_previous(&self, name: &str, prepare: &PrepareRequest) -> Result<(), ApiError> {
        if self.handle(name).is_some() {
            let what = format!("federation `{name}` runs here; it is stopped first");
            return Err(error(ErrorCode::Conflict, what));
        }
        let there = self.view(name).ok().map(|view| view.id);
        if there == prepare.previous || there.as_ref() == Some(&prepare.id) {
            return Ok(());
        }
        let word = |id: &Option<String>| id.clone().unwrap_or_else(|| "nothing".to_owned());
        let what = format!(
            "federation `{name}` has changed here since it was looked at: planned on {}, found {}",
            word(&prepare.previous),
            word(&there)
        );
        Err(error(ErrorCode::Conflict, what))
    }

    fn blobs(&self) -> Blobs {
        Blobs::new(self.paths().blobs())
    }

    /// Changes leases and keeps what a later daemon needs of them.
    fn change_leases<T>(
        &self,
        change: impl FnOnce(&mut Leases) -> Result<T, LeaseError>,
    ) -> Result<T, ApiError> {
        let mut leases = self.leases();
        let mut changed = leases.clone();
        let result = change(&mut changed).map_err(|error| held(&error))?;
        let path = self.paths().leases();
        let written = match changed.stored() {
            Some(stored) => serde_json::to_vec(&stored)
                .map_err(Into::into)
                .and_then(|bytes| files::write_durably(&path, &bytes)),
            None => files::remove(&path),
        };
        written.map_err(|source| store_error(&StoreError::Io { path, source }))?;
        *leases = changed;
        Ok(result)
    }
}

fn validate_part(part: &Part, federates: usize) -> Result<(), String> {
    if let Some(id) = part
        .federates
        .iter()
        .find(|id| usize::from(**id) >= federates)
    {
        return Err(format!("there is no federate {id}"));
    }
    let named = part.hosts.get(&part.host);
    if named.is_none_or(|host| host.address != part.address) {
        return Err(format!("host `{}` is not among the hosts", part.host));
    }
    Ok(())
}

/// Every member of this host must have a certificate, or none.
fn validate_papers(part: &Part, prepare: &PrepareRequest) -> Result<(), String> {
    let federates = &prepare.request.federates;
    let names = part.federates.iter();
    let names = names.filter_map(|id| federates.get(usize::from(*id)));
    let names = names.map(|run| run.name.as_str());
    let mut members: BTreeSet<&str> = names.chain(part.rti.then_some(RTI)).collect();
    if part.security == Security::TrustedNetwork {
        members.clear();
    }
    let given: BTreeSet<&str> = prepare.papers.keys().map(String::as_str).collect();
    match given.symmetric_difference(&members).next() {
        Some(name) if given.contains(name) => {
            Err(format!("a certificate for `{name}` is of no use here"))
        }
        Some(name) => Err(format!("there is no certificate for `{name}`")),
        None => Ok(()),
    }
}

fn held(lease: &LeaseError) -> ApiError {
    error(ErrorCode::Held, lease.to_string())
}

fn blob_error(blob: &BlobError) -> ApiError {
    let code = match blob {
        BlobError::Name(_) | BlobError::Different { .. } => ErrorCode::BadRequest,
        BlobError::Io { .. } => ErrorCode::Failed,
    };
    error(code, with_sources(blob))
}
