//! `ictus history` and `ictus rollback`: the runs of a federation, and going back to one.

use std::time::Duration;

use clap::Args;
use ictusd::stamp;

use crate::args::duration;
use crate::error::{CliError, Kind};
use crate::history::{Entry, ask, choose};
use crate::interrupts::Interrupts;
use crate::rollout::{Again, Executor};
use crate::session::{Abroad, Session, Whereabouts};
use crate::ui::{Table, Ui};

/// Show the runs of a federation over hosts: when, who, what, and how each ended
#[derive(Debug, Args)]
pub(crate) struct History {
    /// The federation: its manifest, or with `--host` its name
    name: Option<String>,
    #[command(flatten)]
    at: Whereabouts,
}

/// Bring an earlier run of a federation over hosts back, programs and parameters alike
///
/// Hosts keep the last three generations with all that they were run from. Shows the plan and carries it out.
#[derive(Debug, Args)]
pub(crate) struct Rollback {
    /// The federation: its manifest, or with `--host` its name
    name: Option<String>,
    /// The generation, as `ictus history` numbers them [default: the last one before what is there]
    #[arg(long, value_name = "N")]
    to: Option<u64>,
    /// Only show the plan; exit code 2 when there is something to do
    #[arg(long)]
    dry_run: bool,
    #[command(flatten)]
    at: Whereabouts,
    /// How long it may take to become healthy
    #[arg(long, value_name = "TIME", default_value = "5m", value_parser = duration)]
    timeout: Duration,
}

impl History {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        let abroad = found(&self.at, &session, self.name.as_deref())?;
        session.block_on(async {
            let clients = abroad.clients(&session).await?;
            let entries = ask(&clients, &abroad.name).await?;
            if entries.is_empty() {
                ui.message(&format!("{} has not run", abroad.name));
            }
            ui.result(&entries, || text(&entries))
        })
    }
}

impl Rollback {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        let abroad = found(&self.at, &session, self.name.as_deref())?;
        session.block_on(self.roll_back(ui, &session, &abroad))
    }

    async fn roll_back(
        &self,
        ui: &mut Ui,
        session: &Session,
        abroad: &Abroad,
    ) -> Result<(), CliError> {
        let mut interrupts = Interrupts::new()?;
        let name = &abroad.name;
        let clients = abroad.clients(session).await?;
        let entries = ask(&clients, name).await?;
        let mut there = None;
        for client in clients.values() {
            let views = client.federations().await?;
            let view = views.into_iter().find(|view| view.name == *name);
            there = there.or(view.map(|view| view.id));
        }
        let entry = choose(&entries, there.as_deref(), self.to)?;
        ui.stage("back to", &line(entry));
        let again = Again::new(session, name, (&entry.id, abroad.ways.clone())).await?;
        ui.result(&again.plan, || again.plan.to_string())?;
        if again.plan.is_empty() {
            ui.message(&format!("{name} already runs so"));
            return Ok(());
        }
        if self.dry_run {
            return Err(CliError::new(Kind::Changes, "there are changes"));
        }
        let verdict = Executor::again(again)?
            .run(ui, &mut interrupts, self.timeout)
            .await?;
        let commit = verdict.commit.unwrap_or_default().as_secs_f64();
        ui.stage("healthy", &format!("{commit:.1} s from commit"));
        Ok(())
    }
}

/// The hosts that are meant: only there generations are kept.
fn found(at: &Whereabouts, session: &Session, given: Option<&str>) -> Result<Abroad, CliError> {
    at.abroad(session, given)?.ok_or_else(|| {
        let error = CliError::failed("generations are kept of federations over hosts");
        error.hint("give a manifest with `hosts`, or `--host`")
    })
}

fn line(entry: &Entry) -> String {
    let when = stamp::text(entry.at_ns);
    format!("generation {} of {when} by {}", entry.number, entry.who)
}

fn text(entries: &[Entry]) -> String {
    if entries.is_empty() {
        return String::new();
    }
    let head = ["GENERATION", "WHEN", "WHO", "DIGEST", "KEPT", "OUTCOME"];
    let mut table = Table::new(&head);
    for (index, entry) in entries.iter().enumerate() {
        let unended = if index == 0 { "runs" } else { "not known" };
        let short: String = entry.digest.chars().take(8).collect();
        table.row([
            entry.number.to_string(),
            stamp::text(entry.at_ns).chars().take(19).collect(),
            entry.who.clone(),
            short,
            if entry.kept { "yes" } else { "no" }.to_owned(),
            entry.outcome.clone().unwrap_or_else(|| unended.to_owned()),
        ]);
    }
    table.text()
}
