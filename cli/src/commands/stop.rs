//! `ictus stop`: an ordered end at an agreed tag.

use std::time::Duration;

use clap::Args;
use ictusd::api::{Event, Happening, Outcome};
use ictusd::client::Stream;

use super::events::{describe, describe_outcome};
use crate::args::duration;
use crate::error::CliError;
use crate::session::{Session, succeed, within};
use crate::ui::Ui;

/// Stop a federation at an agreed tag; `ps` and `logs` still know it
#[derive(Debug, Args)]
pub(crate) struct Stop {
    /// The federation: its name or manifest; may be left out when there is one
    name: Option<String>,
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
