//! `ictus stop`: an ordered end at an agreed tag.

use std::time::Duration;

use clap::Args;
use ictusd::api::{Event, Happening, Outcome};
use ictusd::client::Stream;

use super::events::{describe, describe_outcome};
use crate::args::duration;
use crate::error::CliError;
use crate::hosts;
use crate::interrupts::Interrupts;
use crate::rollout::{self, Executor};
use crate::session::{Abroad, Session, Whereabouts, succeed, within};
use crate::ui::Ui;

/// Stop a federation at an agreed tag; `ps` and `logs` still know it
#[derive(Debug, Args)]
pub(crate) struct Stop {
    /// The federation: its name or manifest; may be left out when there is one
    name: Option<String>,
    #[command(flatten)]
    at: Whereabouts,
    /// End every process at once
    #[arg(long)]
    kill: bool,
    /// How long it may take
    #[arg(long, value_name = "TIME", default_value = "1m", value_parser = duration)]
    timeout: Duration,
}

impl Stop {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        let given = self.name.as_deref();
        if let Some(abroad) = self.at.abroad(&session, given)? {
            return session.block_on(self.everywhere(ui, &session, &abroad));
        }
        let name = session.name(self.name.as_deref())?;
        session.block_on(async {
            let client = session.daemon().await?;
            let stream = client.stop(&name, self.kill).await?;
            let outcome = within(self.timeout, "stopping", outcome(ui, stream)).await?;
            ui.stage("ended", &format!("{name}: {}", describe_outcome(&outcome)));
            ui.result(&outcome, String::new)?;
            succeed(&name, &outcome)
        })
    }

    /// The same of every part, at a tag on which all agree.
    async fn everywhere(
        &self,
        ui: &mut Ui,
        session: &Session,
        abroad: &Abroad,
    ) -> Result<(), CliError> {
        let mut interrupts = Interrupts::new()?;
        let name = &abroad.name;
        let (clients, plan) = rollout::stop(session, name, &abroad.ways, self.timeout).await?;
        if plan.is_empty() {
            ui.message(&format!("{name}: nothing of it runs"));
        } else {
            let executor = Executor::stop(clients.clone(), plan, self.kill)?;
            executor.run(ui, &mut interrupts, self.timeout).await?;
        }
        let merged = hosts::outcome::of_all(&clients, name).await?;
        let Some(ended) = &merged.ended else {
            return hosts::outcome::succeed(name, &merged);
        };
        let how = hosts::outcome::describe(ended);
        ui.stage("ended", &format!("{name}: {how}"));
        ui.result(ended, String::new)?;
        hosts::outcome::succeed(name, &merged)
    }
}

/// Reports events until the end.
async fn outcome(ui: &mut Ui, mut stream: Stream<Happening>) -> Result<Outcome, CliError> {
    while let Some(Happening { event, .. }) = stream.next().await? {
        if let Event::Ended { outcome } = event {
            return Ok(outcome);
        }
        ui.progress("stopping", &describe(&event));
    }
    Err(CliError::failed(
        "the daemon went away; the federation goes on",
    ))
}
