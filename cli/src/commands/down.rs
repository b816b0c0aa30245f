//! `ictus down`: nothing runs any more, and only the logs are left.

use std::time::Duration;

use clap::Args;

use super::events::describe_outcome;
use crate::args::duration;
use crate::error::CliError;
use crate::session::{Session, within};
use crate::ui::Ui;

/// Stop a federation and remove all but its logs, which it names
#[derive(Debug, Args)]
pub(crate) struct Down {
    /// The federation: its name or manifest; may be left out when there is one
    name: Option<String>,
    /// Remove the logs, too
    #[arg(long)]
    purge: bool,
    /// How long it may take
    #[arg(long, value_name = "TIME", default_value = "1m", value_parser = duration)]
    timeout: Duration,
}

impl Down {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        let name = session.name(self.name.as_deref())?;
        session.block_on(async {
            let client = session.daemon().await?;
            let removed = async { Ok(client.remove(&name, self.purge).await?) };
            let removed = within(self.timeout, "taking it down", removed).await?;
            let how = removed.outcome.as_ref().map(describe_outcome);
            ui.stage(
                "down",
                &how.map_or_else(|| name.clone(), |how| format!("{name}: {how}")),
            );
            for kept in &removed.kept {
                ui.stage("kept", &kept.display().to_string());
            }
            if !removed.kept.is_empty() {
                ui.message(&format!("`ictus down {name} --purge` removes them"));
            }
            ui.result(&removed, String::new)?;
            // So that nothing is left when this was the last one.
            client.end().await?;
            Ok(())
        })
    }
}
