//! `ictus down`: nothing runs any more, and only the logs are left.

use std::time::Duration;

use clap::Args;
use ictus_deploy::placement::Way;
use ictusd::api::recorded::Kept;

use super::events::describe_outcome;
use crate::args::duration;
use crate::error::{CliError, Kind};
use crate::hosts::foreign;
use crate::interrupts::Interrupts;
use crate::rollout::{self, Executor, patience, size};
use crate::session::{Abroad, Session, Whereabouts, within};
use crate::stack::Stack;
use crate::ui::Ui;

/// Stop a federation and remove all but its logs and generations, which it names
#[derive(Debug, Args)]
pub(crate) struct Down {
    /// The federation: its name or manifest; may be left out when there is one
    name: Option<String>,
    /// Remove the logs and the generations, too
    #[arg(long)]
    purge: bool,
    #[command(flatten)]
    at: Whereabouts,
    /// How long it may take
    #[arg(long, value_name = "TIME", default_value = "1m", value_parser = duration)]
    timeout: Duration,
}

impl Down {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        let given = self.name.as_deref();
        if let Some(stack) = self.at.stack_or_left(&session, given) {
            return session.block_on(self.stack(ui, &stack));
        }
        if let Some(abroad) = self.at.abroad(&session, given)? {
            return session.block_on(self.everywhere(ui, &session, &abroad));
        }
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
            for Kept { path, bytes } in &removed.kept {
                ui.stage("kept", &format!("{}, {}", path.display(), size(*bytes)));
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

    /// The same of one that docker-compose runs, or ran.
    async fn stack(&self, ui: &mut Ui, stack: &Stack) -> Result<(), CliError> {
        stack.down(self.timeout).await?;
        if self.purge {
            stack.purge().await?;
        }
        ui.stage("down", &stack.name);
        if !self.purge {
            let name = &stack.name;
            ui.message(&format!(
                "`ictus down {name} --purge` removes its images and traces"
            ));
        }
        Ok(())
    }

    /// The same on every host on which it has a part.
    async fn everywhere(
        &self,
        ui: &mut Ui,
        session: &Session,
        abroad: &Abroad,
    ) -> Result<(), CliError> {
        let mut interrupts = Interrupts::new()?;
        let at = (abroad.name.as_str(), &abroad.ways);
        let how = (self.purge, self.timeout);
        let planned = match rollout::down(session, at.0, at.1, how).await {
            Err(refusal) if refusal.kind == Kind::Held => {
                patience::outlive(ui, session, at, &mut interrupts, refusal).await?;
                rollout::down(session, at.0, at.1, how).await
            }
            planned => planned,
        };
        let (clients, plan) = planned?;
        let asked = clients.clone();
        let local = abroad.ways.values().any(|way| *way == Way::Local);
        if plan.steps.is_empty() {
            ui.message(&plan.to_string());
        } else {
            let executor = Executor::down(clients, plan)?;
            let verdict = executor.run(ui, &mut interrupts, self.timeout).await?;
            ui.stage("down", &abroad.name);
            for (host, Kept { path, bytes }) in &verdict.kept {
                let what = format!("{host}: {}, {}", path.display(), size(*bytes));
                ui.stage("kept", &what);
            }
            if !verdict.kept.is_empty() {
                ui.message("the same with `--purge` removes them");
            }
        }
        for warning in foreign(&asked, &abroad.name).await {
            ui.warning(&warning);
        }
        if local {
            session.daemon().await?.end().await?;
        }
        Ok(())
    }
}
