//! What hosts say of themselves and of a federation, all asked at once.

use std::collections::{BTreeMap, BTreeSet};

use ictus_deploy::rollout::{
    Desired, Held, MemberState, NewerRecord, Observed, Reached, Run, RunState,
};
use ictusd::api::secret::SecretValues;
use ictusd::api::{ErrorCode, ExitReason, FailureKind, FederationView, MemberView, Outcome, State};
use ictusd::client::{Client, ClientError};

use super::ObservedHosts;
use crate::commands::events::describe_outcome;
use crate::error::CliError;
use crate::hosts::Clients;

/// Digests of blobs, and names or ids of images, that a host is asked for.
pub(super) type Wanted = (Vec<String>, Vec<String>);

/// Asks all; those that do not answer are told as such.
pub(super) async fn all(
    connected: BTreeMap<String, Result<Client, CliError>>,
    federation: &str,
    wanted: &dyn Fn(&str) -> Wanted,
) -> (Clients, ObservedHosts) {
    let asked = connected.into_iter().map(|(host, client)| async move {
        let client = match client {
            Ok(client) => client,
            Err(error) => {
                let why = error.to_string();
                return (host, None, Observed::Unreachable { why });
            }
        };
        let observed = match one(&client, federation, wanted(&host)).await {
            Ok(reached) => Observed::Reached(Box::new(reached)),
            Err(error) => Observed::Unreachable {
                why: CliError::from(error).to_string(),
            },
        };
        (host, Some(client), observed)
    });
    let (mut clients, mut observed) = (Clients::new(), ObservedHosts::new());
    for (host, client, found) in futures_util::future::join_all(asked).await {
        clients.extend(client.map(|client| (host.clone(), client)));
        observed.insert(host, found);
    }
    (clients, observed)
}

/// Asks each host with a run which values of its federates' secrets are others than the run's.
pub(super) async fn compare_secrets(
    clients: &Clients,
    observed: &mut ObservedHosts,
    (desired, values): (&Desired, &SecretValues),
) {
    let asked = observed.iter_mut().map(|(host, observed)| async move {
        let has_run = observed.run().is_some();
        let (Observed::Reached(reached), Some(wanted)) = (&mut *observed, desired.hosts.get(host))
        else {
            return;
        };
        let values = values.only(&wanted.federates);
        let Some(client) = clients.get(host).filter(|_| has_run && !values.is_empty()) else {
            return;
        };
        match client.changed_secrets(&desired.federation, &values).await {
            Ok(changed) => reached.secrets_changed = changed,
            Err(error) => {
                let why = CliError::from(error).to_string();
                *observed = Observed::Unreachable { why };
            }
        }
    });
    futures_util::future::join_all(asked).await;
}

async fn one(
    client: &Client,
    federation: &str,
    (blobs, images): Wanted,
) -> Result<Reached, ClientError> {
    let facts = client.host().await?;
    let leases = client.leases().await?;
    let lease = leases.into_iter().find(|it| it.federation == federation);
    let missing: BTreeSet<String> = client.missing_blobs(&blobs).await?.into_iter().collect();
    let images = match images.as_slice() {
        [] => BTreeMap::new(),
        images => client.images(federation, images).await?,
    };
    Ok(Reached {
        version: facts.version,
        arch: facts.arch,
        docker: facts.docker.map(drop),
        gives: facts.gives,
        secrets_changed: BTreeMap::new(),
        disk_free: facts.disk_free,
        state: facts.state,
        images: images
            .into_iter()
            .map(|(image, it)| (image, it.arch))
            .collect(),
        blobs: blobs
            .into_iter()
            .filter(|it| !missing.contains(it))
            .collect(),
        run: view(client, federation)
            .await?
            .map_or(Ok(None), |view| run(&view).map(Some)),
        lease: lease.map(|lease| Held {
            who: lease.who,
            left_ms: lease.left_ms,
        }),
    })
}

/// The federation as a host sees it; absent when there is none of that name.
pub(super) async fn view(
    client: &Client,
    federation: &str,
) -> Result<Option<FederationView>, ClientError> {
    match client.federation(federation).await {
        Ok(view) => Ok(Some(view)),
        Err(error) if is_unknown(&error) => Ok(None),
        Err(error) => Err(error),
    }
}

/// Whether a host says that there is no such federation.
pub(super) fn is_unknown(error: &ClientError) -> bool {
    let refusal = error.refusal();
    refusal.is_some_and(|refusal| refusal.code == ErrorCode::Unknown)
}

fn run(view: &FederationView) -> Result<Run, NewerRecord> {
    if let Some(Outcome::Failed { failure, .. }) = &view.outcome
        && failure.kind == FailureKind::NewerRecord
    {
        return Err(NewerRecord {
            what: failure.what.clone(),
        });
    }
    let part = view.part.as_ref();
    let rti = [&view.rti]
        .into_iter()
        .filter(|_| part.is_none_or(|part| part.rti));
    let members = rti.chain(&view.federates).filter(|it| !it.name.is_empty());
    Ok(Run {
        id: view.id.clone(),
        digest: view.digest.clone(),
        facets: view.facets.clone(),
        state: state(view),
        members: members.map(|it| (it.name.clone(), member(it))).collect(),
        hosts: part
            .map(|part| part.hosts.keys().cloned().collect())
            .unwrap_or_default(),
    })
}

fn state(view: &FederationView) -> RunState {
    match (view.state, &view.outcome) {
        (_, Some(outcome)) => RunState::Ended {
            how: describe_outcome(outcome),
        },
        (State::Prepared, None) => RunState::Prepared,
        (State::Starting, None) => RunState::Starting,
        (State::Running, None) => RunState::Running,
        (State::Stopping, None) => RunState::Stopping,
        (State::WaitingForSecrets, None) => RunState::Ended {
            how: "the host was started again, and it waits for secrets".to_owned(),
        },
        (State::Ended, None) => RunState::Ended {
            how: "ended".to_owned(),
        },
    }
}

fn member(member: &MemberView) -> MemberState {
    match (&member.exit, &member.ending) {
        (Some(ExitReason::Completed), _) => MemberState::Completed,
        (Some(_), how) => MemberState::Failed {
            how: how.clone().unwrap_or_default(),
        },
        (None, _) if member.state == "foreign" => MemberState::Failed {
            how: "foreign".to_owned(),
        },
        (None, _) => MemberState::Lives,
    }
}
