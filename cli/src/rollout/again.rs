//! A generation that is brought back: what the hosts have kept of it, as what is asked for.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;

use ictus_deploy::placement::Way;
use ictus_deploy::rollout::{Desired, DesiredHost, Plan, plan};
use ictus_deploy::{FederateRun, Needs};
use ictusd::api::part::{Part, PrepareRequest};
use ictusd::api::recorded::Generation;

use super::observe::Wanted;
use super::{ObservedHosts, next_generation, observe, refused};
use crate::error::CliError;
use crate::hosts::{Clients, connect_all};
use crate::secrets::Secrets;
use crate::session::Session;

/// A plan that brings a generation back, and what its hosts are asked to prepare.
#[derive(Debug)]
pub(crate) struct Again {
    pub(crate) plan: Plan,
    pub(super) clients: Clients,
    /// Without the new run's id.
    pub(super) requests: BTreeMap<String, PrepareRequest>,
    pub(super) rti: Option<(String, Ipv4Addr)>,
    pub(super) federates: usize,
}

impl Again {
    /// Fetches run `id` from the hosts that have it, looks at all, and plans.
    pub(crate) async fn new(
        session: &Session,
        federation: &str,
        (id, mut ways): (&str, BTreeMap<String, Way>),
    ) -> Result<Self, CliError> {
        let mut generations = BTreeMap::new();
        // Hosts of then that the manifest of now does not name are found in what the others kept.
        let mut asked = BTreeMap::new();
        loop {
            let new: BTreeMap<_, _> = ways
                .iter()
                .filter(|(host, _)| !asked.contains_key(*host))
                .map(|(host, way)| (host.clone(), way.clone()))
                .collect();
            if new.is_empty() {
                break;
            }
            for (host, client) in connect_all(session, &new).await {
                let client = client?;
                let known = client.history(federation).await.unwrap_or_default();
                if known.iter().any(|it| it.id == id) {
                    generations.insert(host.clone(), client.generation(federation, id).await?);
                }
                asked.insert(host, client);
            }
            ways.extend(generations.values().flat_map(ways_of));
        }
        let desired = desired(federation, &generations)?;
        for (host, generation) in &generations {
            if let (Some(client), Some(part)) = (asked.get(host), part_of(generation)) {
                let digests: Vec<_> = part.programs.values().cloned().collect();
                if let Some(missing) = client.missing_blobs(&digests).await?.first() {
                    let what = format!("host `{host}` has not kept program {missing}");
                    return Err(CliError::failed(what).hint("`ictus up` sends it again"));
                }
            }
        }
        let connected = asked.into_iter().map(|(host, client)| (host, Ok(client)));
        let found = observe::all(connected.collect(), federation, &|_| Wanted::default()).await;
        let (clients, observed): (Clients, ObservedHosts) = found;
        let plan = plan(&desired, &observed).map_err(refused)?;
        let number = next_generation(&clients, federation).await;
        let rti = generations.iter().find_map(|(host, generation)| {
            let part = part_of(generation).filter(|part| part.rti)?;
            Some((host.clone(), part.address))
        });
        let requests = generations
            .into_iter()
            .map(|(host, it)| Ok(prepare(it, number)?.map(|it| (host, it))));
        let requests = requests.collect::<Result<Vec<_>, CliError>>()?;
        Ok(Self {
            plan,
            clients,
            requests: requests.into_iter().flatten().collect(),
            rti,
            federates: desired.federates(),
        })
    }
}

fn part_of(generation: &Generation) -> Option<&Part> {
    generation.request.as_ref()?.part.as_ref()
}

/// The ways to all hosts of a generation.
fn ways_of(generation: &Generation) -> Vec<(String, Way)> {
    let hosts = part_of(generation).map(|part| part.hosts.iter());
    let hosts = hosts.into_iter().flatten();
    hosts
        .map(|(name, host)| (name.clone(), host.way.clone()))
        .collect()
}

fn prepare(generation: Generation, number: u64) -> Result<Option<PrepareRequest>, CliError> {
    // Values are not kept with a generation: they are those of now, from where they came then.
    let request = generation.request.as_ref();
    let part = request.and_then(|request| request.part.as_ref());
    let here = |run: &&FederateRun| part.is_some_and(|part| part.federates.contains(&run.id));
    let runs = request.into_iter().flat_map(|request| &request.federates);
    let secrets = Secrets::read(runs.filter(here)).complete()?;
    let request = generation.request;
    Ok(request.map(|request| PrepareRequest {
        previous: None,
        id: String::new(),
        digest: generation.view.digest,
        facets: generation.facets,
        generation: Some(number),
        request,
        secrets,
        // Of the new run.
        papers: BTreeMap::new(),
    }))
}

/// What was asked for when the generation was made, by what its hosts have kept.
fn desired(
    federation: &str,
    generations: &BTreeMap<String, Generation>,
) -> Result<Desired, CliError> {
    let gone = || CliError::failed("no host has kept what that generation was run from");
    let any = generations.values().next().ok_or_else(gone)?;
    let settings = any.request.as_ref().map(|request| &request.settings);
    let (start_limit_ms, stop_limit_ms) = settings.map(Desired::limits).ok_or_else(gone)?;
    let mut hosts = BTreeMap::new();
    for (host, generation) in generations {
        let (Some(request), Some(part)) = (&generation.request, part_of(generation)) else {
            return Err(CliError::failed(format!(
                "host `{host}` has not kept what that generation was run from"
            )));
        };
        let runs = request.federates.iter();
        let runs: Vec<_> = runs
            .filter(|run| part.federates.contains(&run.id))
            .collect();
        let unkept = runs
            .iter()
            .find(|run| run.needs.image.is_none() && !part.programs.contains_key(&run.name));
        if let Some(run) = unkept {
            let what = format!(
                "host `{host}` is this machine: the program of federate `{}` of then is not kept",
                run.name
            );
            return Err(CliError::failed(what).hint("`ictus up` with the manifest of then"));
        }
        let needs = runs.iter().filter(|run| run.needs != Needs::default());
        let wanted = DesiredHost {
            engine: part.engine,
            rti: part.rti,
            needs: needs
                .map(|run| (run.name.clone(), run.needs.clone()))
                .collect(),
            federates: runs.iter().map(|run| run.name.clone()).collect(),
            // They are there: that was asked.
            blobs: Vec::new(),
            images: Vec::new(),
        };
        hosts.insert(host.clone(), wanted);
    }
    let all = generations.values().flat_map(ways_of);
    let missing = all.map(|(host, _)| host).find(|it| !hosts.contains_key(it));
    if let Some(host) = missing {
        let what = format!("host `{host}` does not have that generation any more");
        return Err(CliError::failed(what));
    }
    Ok(Desired {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        federation: federation.to_owned(),
        digest: any.view.digest.clone(),
        facets: any.facets.clone(),
        hosts,
        start_limit_ms,
        stop_limit_ms,
    })
}
