//! `up` and `down` over several hosts: looks at all, plans, and carries exactly that plan out.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use ictus_deploy::image::elf::Machine;
use ictus_deploy::placement::{Placement, Way};
use ictus_deploy::rollout::{
    Desired, Observed, Plan, ProgramFile, Reason, Refusal, plan, plan_down, plan_stop,
};
use ictus_deploy::{Checked, FederateRun};
use ictusd::api::StartRequest;
use ictusd::api::part::{HostRef, Part};
use ictusd::blobs;

use crate::error::{CliError, Kind};
use crate::hosts::{Clients, connect_all, ways};
use crate::secrets::Secrets;
use crate::session::{Session, request};

mod again;
mod certificates;
mod execute;
mod images;
mod observe;
pub(crate) mod patience;
mod reach;
mod saved;

pub(crate) use again::Again;
pub(crate) use execute::{Executor, size, who};
use images::Images;
use observe::Wanted;
pub(crate) use saved::SavedPlan;

/// How long an ordered stop of a federation may take at least, of which no manifest says more.
const STOP_LIMIT_MIN: Duration = Duration::from_secs(60);

/// A checked manifest with hosts, and what they said.
#[derive(Debug)]
pub(crate) struct Rollout<'a> {
    checked: &'a Checked,
    pub(crate) placement: &'a Placement,
    trace: bool,
    desired: Desired,
    /// Program files by digest.
    files: BTreeMap<String, PathBuf>,
    images: Images,
    pub(crate) clients: Clients,
    pub(crate) plan: Plan,
    observed: ObservedHosts,
    /// The number that this run will have in the history.
    generation: u64,
    /// The values of secrets, as far as they are known here.
    pub(crate) secrets: Secrets,
}

impl<'a> Rollout<'a> {
    /// Looks at every host and plans.
    pub(crate) async fn new(
        session: &Session,
        checked: &'a Checked,
        placement: &'a Placement,
        trace: bool,
    ) -> Result<Self, CliError> {
        let mut files = BTreeMap::new();
        let desired = Desired::of(checked, trace, &mut |path| {
            let file = program_file(path)?;
            files.insert(file.digest.clone(), path.to_path_buf());
            Ok(file)
        });
        let images = Images::find(checked).await?;
        let desired = desired.map_err(CliError::failed)?;
        let desired = desired.with_images(&images.files);
        let connected = connect_all(session, &ways(placement)).await;
        let blobs = |host: &str| -> Vec<String> {
            let host = desired.hosts.get(host);
            let blobs = host.map(|host| host.blobs.iter().map(|it| it.digest.clone()));
            blobs.into_iter().flatten().collect()
        };
        let secrets = Secrets::read(&checked.federates);
        let images_of = |host: &str| -> Vec<String> {
            let host = desired.hosts.get(host);
            let images = host.map(|host| host.images.iter().map(|it| it.asked_for().to_owned()));
            images.into_iter().flatten().collect()
        };
        let asked = |host: &str| (blobs(host), images_of(host));
        let (clients, mut observed) = observe::all(connected, &desired.federation, &asked).await;
        let wanted = (&desired, &secrets.values);
        observe::compare_secrets(&clients, &mut observed, wanted).await;
        let plan = plan(&desired, &observed).map_err(refused)?;
        let generation = next_generation(&clients, &desired.federation).await;
        Ok(Self {
            checked,
            placement,
            trace,
            desired,
            files,
            images,
            clients,
            plan,
            observed,
            generation,
            secrets,
        })
    }

    /// The plan with what it was made from, for a file.
    pub(crate) fn saved(&self, set: &[(String, String)]) -> SavedPlan {
        SavedPlan {
            manifest: self.checked.manifest.clone(),
            set: set.to_vec(),
            trace: self.trace,
            facets: self.desired.facets.clone(),
            plan: self.plan.clone(),
        }
    }

    /// Takes exactly the saved plan, unless a host or the manifest has moved on since it was made.
    pub(crate) fn follow(&mut self, saved: SavedPlan) -> Result<(), CliError> {
        let stale = saved.plan.is_for(&self.desired);
        let stale = stale.and_then(|()| saved.plan.still_valid(&self.observed));
        stale.map_err(|stale| saved.refused(&stale, &self.desired.facets, &self.plan.causes))?;
        self.plan = saved.plan;
        Ok(())
    }

    /// Whether everything runs as the manifest says.
    pub(crate) fn is_done(&self) -> bool {
        self.plan.is_empty()
    }

    /// What a host is asked to run.
    fn part_request(&self, host: &str) -> Option<StartRequest> {
        let index = self.placement.hosts.iter().position(|it| it.name == host)?;
        let spec = &self.placement.hosts[index];
        let runs = self.checked.federates.iter().zip(&self.placement.federates);
        let here: Vec<_> = runs
            .filter(|(_, at)| **at == index)
            .map(|(run, _)| run)
            .collect();
        let sent = |digest: &String| {
            let wanted = self.desired.hosts.get(host);
            wanted.is_some_and(|host| host.blobs.iter().any(|blob| blob.digest == *digest))
        };
        let program = |run: &&FederateRun| {
            let found = self
                .files
                .iter()
                .find(|(digest, file)| **file == run.executable && sent(digest))?;
            Some((run.name.clone(), found.0.clone()))
        };
        let part = Part {
            host: host.to_owned(),
            hosts: self.host_refs(),
            rti: self.placement.rti == index,
            federates: here.iter().map(|run| run.id).collect(),
            address: self.address(spec.address),
            engine: spec.engine,
            ports: spec.ports,
            programs: here.iter().filter_map(program).collect(),
            security: self.placement.security,
        };
        let mut request = request(self.checked, self.trace);
        for run in &mut request.federates {
            // What is built here is an image there.
            run.needs.build = None;
            run.needs.image = self.images.of(&run.name);
        }
        Some(StartRequest {
            part: Some(part),
            ..request
        })
    }

    fn host_refs(&self) -> BTreeMap<String, HostRef> {
        let hosts = self.placement.hosts.iter();
        let reference = |way: &Way, address| HostRef {
            way: way.clone(),
            address: self.address(address),
        };
        hosts
            .map(|host| (host.name.clone(), reference(&host.way, host.address)))
            .collect()
    }

    /// Where all share a host, nobody else can reach them.
    fn address(&self, address: Ipv4Addr) -> Ipv4Addr {
        if self.placement.hosts.len() == 1 {
            Ipv4Addr::LOCALHOST
        } else {
            address
        }
    }

    fn rti_address(&self) -> Option<Ipv4Addr> {
        let host = self.placement.hosts.get(self.placement.rti)?;
        Some(self.address(host.address))
    }
}

/// The number of the next run: one more than any host remembers.
async fn next_generation(clients: &Clients, federation: &str) -> u64 {
    let asked = clients.values().map(|client| client.history(federation));
    let answers = futures_util::future::join_all(asked).await;
    // A host that does not know the federation remembers none.
    let all = answers.into_iter().flatten().flatten();
    all.map(|run| run.number).max().unwrap_or(0) + 1
}

fn stop_limit_ms(limit: Duration) -> u64 {
    u64::try_from(limit.max(STOP_LIMIT_MIN).as_millis()).unwrap_or(u64::MAX)
}

/// What is planned to stop a federation, and on whom it is carried out.
pub(crate) async fn stop(
    session: &Session,
    name: &str,
    ways: &BTreeMap<String, Way>,
    limit: Duration,
) -> Result<(Clients, Plan), CliError> {
    let connected = connect_all(session, ways).await;
    let (clients, observed) = observe::all(connected, name, &|_| Wanted::default()).await;
    let plan = plan_stop(name, &observed, stop_limit_ms(limit)).map_err(refused)?;
    Ok((clients, plan))
}

/// What is planned to take a federation down, and on whom it is carried out.
pub(crate) async fn down(
    session: &Session,
    name: &str,
    ways: &BTreeMap<String, Way>,
    (purge, limit): (bool, Duration),
) -> Result<(Clients, Plan), CliError> {
    let connected = connect_all(session, ways).await;
    let (clients, observed) = observe::all(connected, name, &|_| Wanted::default()).await;
    let plan = plan_down(name, &observed, purge, stop_limit_ms(limit)).map_err(refused)?;
    Ok((clients, plan))
}

/// What a program file is; its architecture stands in its header.
fn program_file(path: &Path) -> io::Result<ProgramFile> {
    let bytes = std::fs::metadata(path)?.len();
    let digest = blobs::digest(std::fs::File::open(path)?)?;
    let machine = Machine::of(path).map_err(io::Error::other)?;
    Ok(ProgramFile {
        digest,
        bytes,
        arch: machine.architecture.rust_name().to_owned(),
    })
}

fn refused(refusal: Refusal) -> CliError {
    let is = |wanted: fn(&Reason) -> bool| refusal.reasons.iter().any(wanted);
    let kind = if is(|it| matches!(it, Reason::Unreachable { .. })) {
        Kind::Unreachable
    } else if is(|it| matches!(it, Reason::Held { .. })) {
        Kind::Held
    } else {
        Kind::Failed
    };
    CliError::new(kind, refusal.to_string())
}

/// Hosts that were observed, for those that need only this.
pub(crate) type ObservedHosts = BTreeMap<String, Observed>;

/// The names of hosts, for messages.
pub(crate) fn listed(hosts: &BTreeSet<String>) -> String {
    hosts.iter().cloned().collect::<Vec<_>>().join(", ")
}
