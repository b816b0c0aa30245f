//! The daemons of a federation's hosts: whom to ask, and how each is reached.

use std::collections::BTreeMap;

use ictus_deploy::placement::{Placement, Way};
use ictusd::api::FederationView;
use ictusd::api::part::HostRef;
use ictusd::client::Client;

use crate::error::CliError;
use crate::session::Session;

pub(crate) mod clocks;
pub(crate) mod copied;
mod dial;
pub(crate) mod known;
pub(crate) mod merge;
pub(crate) mod outcome;

pub(crate) use dial::{options, target, unreachable_host};

/// Where `ictus host add` puts the program, from the user's home.
pub(crate) const INSTALLED: &str = ".local/share/ictus/bin/ictusd";

/// Daemons by the name of their host.
pub(crate) type Clients = BTreeMap<String, Client>;

/// The ways to the hosts of a manifest.
pub(crate) fn ways(placement: &Placement) -> BTreeMap<String, Way> {
    let hosts = placement.hosts.iter();
    hosts
        .map(|host| (host.name.clone(), host.way.clone()))
        .collect()
}

/// Connects to all at once: each that answers, and why the others do not.
pub(crate) async fn connect_all(
    session: &Session,
    ways: &BTreeMap<String, Way>,
) -> BTreeMap<String, Result<Client, CliError>> {
    let connect = |(name, way): (&String, &Way)| {
        let name = name.clone();
        let way = way.clone();
        async move {
            let client = connect(session, &name, &way).await;
            (name, client)
        }
    };
    let connected = futures_util::future::join_all(ways.iter().map(connect)).await;
    connected.into_iter().collect()
}

/// Connects to one host's daemon and hears that it answers.
pub(crate) async fn connect(session: &Session, name: &str, way: &Way) -> Result<Client, CliError> {
    match way {
        Way::Local => session.daemon().await,
        Way::Ssh {
            target,
            client,
            identity,
        } => dial::connect(name, target, *client, identity.as_deref()).await,
    }
}

/// The hosts of the last run that was taken down, as those that were asked remember it.
pub(crate) async fn left(clients: &[Client], name: &str) -> BTreeMap<String, Way> {
    for client in clients {
        let runs = client.history(name).await.unwrap_or_default();
        let Some(last) = runs.into_iter().find(|run| run.kept) else {
            continue;
        };
        let run = client.generation(name, &last.id).await.ok();
        let part = run.and_then(|run| run.request?.part);
        if let Some(part) = part {
            let hosts = part.hosts.into_iter();
            return hosts.map(|(host, it)| (host, it.way)).collect();
        }
    }
    BTreeMap::new()
}

/// What says on any of these hosts that it is of the federation, and is not: a line each.
pub(crate) async fn foreign(clients: &Clients, federation: &str) -> Vec<String> {
    let mut lines = Vec::new();
    for (host, client) in clients {
        // An older daemon does not tell.
        for found in client.foreign(federation).await.unwrap_or_default() {
            let (container, federation) = (&found.container, &found.federation);
            lines.push(format!(
                "{host}: container `{container}` is foreign: it says that it is of federation `{federation}`, but no \
                 record there has it; it is left alone (`docker rm -f {container}` there removes it)"
            ));
        }
    }
    lines
}

/// The other hosts of a run, as the record on one of them tells.
pub(crate) fn others(views: &[FederationView], name: &str) -> BTreeMap<String, Way> {
    let parts = views.iter().filter(|view| view.name == name);
    let hosts = parts.filter_map(|view| view.part.as_ref());
    hosts
        .flat_map(|part| &part.hosts)
        .map(|(name, HostRef { way, .. })| (name.clone(), way.clone()))
        .collect()
}
