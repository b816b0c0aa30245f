//! Runs over the manifest's hosts, under names of their own beside whatever else runs there.

use ictus_coord::plan::Plan;
use ictus_deploy::rollout::Ended;
use ictus_deploy::{Checked, Placement};
use ictusd::api::Event;
use ictusd::api::recorded::{FileKind, Recorded};
use ictusd::store::Directory;

use super::{Files, Runs};
use crate::error::CliError;
use crate::hosts::copied::Copied;
use crate::hosts::{Clients, outcome, ways};
use crate::interrupts::Interrupts;
use crate::rollout::{self, Executor, Rollout};
use crate::session::{Abroad, Session};
use crate::ui::Ui;

impl Runs<'_> {
    /// Starts a plan on the hosts, waits for its end, and copies what it wrote.
    pub(super) async fn over_hosts(
        &mut self,
        name: &str,
        (plan, placement): (&Plan, &Placement),
        trace: bool,
    ) -> Result<Files, CliError> {
        let checked = Checked {
            plan: Plan {
                federation: name.to_owned(),
                ..plan.clone()
            },
            ..self.checked.clone()
        };
        let session = self.session;
        let rollout = Rollout::new(session, &checked, placement, trace).await?;
        let clients = rollout.clients.clone();
        self.abroad.push(Abroad {
            name: name.to_owned(),
            ways: ways(placement),
        });
        let executor = Executor::up(rollout)?;
        let mut quiet = Ui::silent();
        let started = executor
            .run(&mut quiet, &mut self.interrupts, self.limit)
            .await;
        let ended = match started {
            Ok(_) => self.bounded(completed(&clients, name)).await,
            Err(error) => Err(error),
        };
        if ended.is_err() {
            self.failed = Some(name.to_owned());
        }
        ended?;
        copy(&clients, name).await
    }

    /// What the last run of the manifest's federation has left: over its hosts, or on this machine.
    pub(crate) async fn last(&mut self) -> Result<(Plan, Files), CliError> {
        let name = self.checked.plan.federation.clone();
        let Some(placement) = &self.checked.placement else {
            let directory = Directory::of(&self.session.paths.federations(), &name);
            let (plan, _) = directory.read_plan().map_err(|error| {
                let what = format!("federation `{name}` has left no run here: {error}");
                CliError::failed(what)
            })?;
            let client = self.session.daemon().await?;
            let clients = Clients::from([("this machine".to_owned(), client)]);
            self.bounded(completed(&clients, &name)).await?;
            return Ok((plan, Files::of(self.session, &name)));
        };
        let abroad = Abroad {
            name: name.clone(),
            ways: ways(placement),
        };
        let clients = abroad.clients(self.session).await?;
        self.bounded(completed(&clients, &name)).await?;
        let mut plan = None;
        for client in clients.values() {
            let recorded: Recorded = client.recorded(&name).await?;
            plan = Some(recorded.plan);
        }
        let plan = plan.ok_or_else(|| CliError::failed("the manifest has no hosts"))?;
        Ok((plan, copy(&clients, &name).await?))
    }
}

/// Takes such a run down; says nothing.
pub(super) async fn take_down(
    session: &Session,
    abroad: &Abroad,
    purge: bool,
) -> Result<(), CliError> {
    let mut interrupts = Interrupts::new()?;
    let limit = super::SLACK;
    let how = (purge, limit);
    let (clients, plan) = rollout::down(session, &abroad.name, &abroad.ways, how).await?;
    if !plan.is_empty() {
        let executor = Executor::down(clients, plan)?;
        executor
            .run(&mut Ui::silent(), &mut interrupts, limit)
            .await?;
    }
    Ok(())
}

/// Waits until every part has ended at the end of its program.
async fn completed(clients: &Clients, name: &str) -> Result<(), CliError> {
    for client in clients.values() {
        let mut events = client.events(Some(name), true).await?;
        loop {
            let Some(happening) = events.next().await? else {
                return Err(CliError::failed("a daemon went away"));
            };
            if matches!(happening.event, Event::Ended { .. }) {
                break;
            }
        }
    }
    let merged = outcome::of_all(clients, name).await?;
    match &merged.ended {
        Some(Ended::Completed) => Ok(()),
        Some(ended) => {
            let how = outcome::describe(ended);
            Err(CliError::failed(format!("run `{name}`: {how}")))
        }
        None => Err(CliError::failed(format!(
            "run `{name}` has not ended everywhere"
        ))),
    }
}

async fn copy(clients: &Clients, name: &str) -> Result<Files, CliError> {
    let mut copied = Copied::new(clients, name).await?;
    for kind in [FileKind::Trace, FileKind::Timing] {
        copied.update(clients, kind).await?;
    }
    Ok(Files::copied(copied))
}
