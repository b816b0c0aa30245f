//! How a federation over several hosts stands, from what each host says of its part.

use std::collections::{BTreeMap, BTreeSet};

use ictus_deploy::rollout::{Cause, Ended, Merged, PartOutcome, merge_outcomes};
use ictusd::api::{FederationView, Outcome};

use super::Clients;
use crate::error::CliError;
use crate::ui::one_line;

/// Asks every host how its part stands.
pub(crate) async fn of_all(clients: &Clients, federation: &str) -> Result<Merged, CliError> {
    let mut parts = BTreeMap::new();
    for (host, client) in clients {
        let views = client.federations().await?;
        let view = views.iter().find(|view| view.name == federation);
        if let Some(view) = view {
            parts.insert(host.clone(), of_part(host, view));
        }
    }
    Ok(merge_outcomes(&parts))
}

/// A part's outcome as it is merged.
fn of_part(host: &str, view: &FederationView) -> PartOutcome {
    let outcome = view.outcome.as_ref();
    outcome.map_or(PartOutcome::Runs, |outcome| {
        PartOutcome::Ended(ended(host, outcome))
    })
}

/// How a part ended, with its host.
pub(crate) fn ended(host: &str, outcome: &Outcome) -> Ended {
    match outcome {
        Outcome::Completed => Ended::Completed,
        Outcome::Aborted => Ended::Aborted,
        Outcome::Stopped { missed } => Ended::Stopped {
            missed: BTreeSet::from_iter(missed.iter().cloned()),
        },
        Outcome::Failed {
            failure,
            was_healthy,
        } => {
            let who = failure.member.as_deref();
            let who = who.map_or_else(String::new, |who| format!("`{who}`: "));
            let cause = Cause {
                host: host.to_owned(),
                step: String::new(),
                what: format!("{who}{}", failure.words()),
                rank: failure.rank,
                at_ns: failure.at_ns,
            };
            Ended::Failed {
                cause,
                was_healthy: *was_healthy,
            }
        }
    }
}

/// How it ended, in words.
pub(crate) fn describe(ended: &Ended) -> String {
    match ended {
        Ended::Completed => "completed".to_owned(),
        Ended::Stopped { missed } if missed.is_empty() => "stopped at the stop tag".to_owned(),
        Ended::Stopped { missed } => {
            let missed: Vec<_> = missed.iter().cloned().collect();
            let missed = missed.join(", ");
            format!("stopped; did not reach the stop tag in time: {missed}")
        }
        Ended::Failed { cause, .. } => format!("failed: {cause}"),
        Ended::Aborted => "undone before it was healthy".to_owned(),
    }
}

/// The end as a command's result; one that is not known is none.
pub(crate) fn succeed(name: &str, merged: &Merged) -> Result<(), CliError> {
    match &merged.ended {
        Some(Ended::Completed | Ended::Stopped { .. }) => Ok(()),
        Some(ended) => Err(CliError::failed(format!(
            "federation `{name}` {}",
            describe(ended)
        ))),
        None => Err(CliError::failed(format!(
            "federation `{name}` has not ended everywhere"
        ))),
    }
}

/// Of what the parts of one federation say went wrong, the cause: the rest are consequences. It names the host on which the
/// member ran, whichever host says so.
pub(crate) fn headline(views: &[&FederationView]) -> Option<String> {
    let parts = views
        .iter()
        .filter_map(|view| Some((view, view.part.as_ref()?)));
    let failures = parts.filter_map(|(view, part)| match &view.outcome {
        Some(Outcome::Failed { failure, .. }) => Some((view, part, failure)),
        Some(Outcome::Completed | Outcome::Stopped { .. } | Outcome::Aborted) | None => None,
    });
    let (view, part, failure) =
        failures.min_by_key(|(_, part, failure)| (failure.rank, failure.at_ns, &part.host))?;
    let ran = |view: &&&FederationView| {
        let mut members = view.federates.iter().map(|member| &member.name);
        members.any(|name| failure.member.as_ref() == Some(name))
    };
    let there = views.iter().find(ran).and_then(|view| view.part.as_ref());
    let host = &there.unwrap_or(part).host;
    let who = failure.member.as_deref().unwrap_or("federation");
    let what = one_line(&failure.words());
    let name = &view.name;
    Some(format!(
        "federation `{name}` failed: host `{host}`: {who}: {what}"
    ))
}
