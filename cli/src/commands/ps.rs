//! `ictus ps`: federations and federates.

use std::time::Duration;

use clap::Args;
use ictusd::api::{FederationView, MemberView, Outcome, State};

use crate::error::{CliError, Kind};
use crate::hosts::connect_all;
use crate::session::{Abroad, Session, Whereabouts, ago};
use crate::ui::{Table, Ui, nanoseconds, one_line};

/// How often `--watch` looks.
const PERIOD: Duration = Duration::from_secs(1);

/// Show federations and their federates
#[derive(Debug, Args)]
pub(crate) struct Ps {
    /// Show it again every second, until Ctrl-C
    #[arg(short, long)]
    watch: bool,
    /// Only this federation: its manifest, or with `--host` its name
    name: Option<String>,
    #[command(flatten)]
    at: Whereabouts,
}

impl Ps {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        let given = self.name.as_deref();
        if let Some(abroad) = session.block_on(self.at.find(&session, given))? {
            return session.block_on(self.everywhere(ui, &session, &abroad));
        }
        let only = given.map(|given| session.name(Some(given))).transpose()?;
        if !self.watch && session.known().is_empty() {
            return show(ui, &[]);
        }
        session.block_on(async {
            let client = session.daemon().await?;
            loop {
                let mut views = client.federations().await?;
                views.retain(|view| only.as_ref().is_none_or(|only| *only == view.name));
                if self.watch && ui.can_redraw() {
                    ui.clear()?;
                }
                show(ui, &views)?;
                if !self.watch {
                    return Ok(());
                }
                tokio::time::sleep(PERIOD).await;
            }
        })
    }

    /// The parts of a federation on its hosts.
    async fn everywhere(
        &self,
        ui: &mut Ui,
        session: &Session,
        abroad: &Abroad,
    ) -> Result<(), CliError> {
        let connected = connect_all(session, &abroad.ways).await;
        loop {
            let (mut views, mut silent) = (Vec::new(), Vec::new());
            for (host, client) in &connected {
                match client {
                    Ok(client) => match client.federations().await {
                        Ok(found) => {
                            views.extend(found.into_iter().filter(|it| it.name == abroad.name));
                        }
                        Err(error) => silent.push((host, CliError::from(error).to_string())),
                    },
                    Err(error) => silent.push((host, error.to_string())),
                }
            }
            if self.watch && ui.can_redraw() {
                ui.clear()?;
            }
            show(ui, &views)?;
            // What cannot be asked is unknown, and nothing else.
            for (host, why) in &silent {
                ui.warning(&format!("{host}: unknown: {why}"));
            }
            if !self.watch {
                let error = silent.into_iter().next();
                return error.map_or(Ok(()), |(_, why)| {
                    Err(CliError::new(Kind::Unreachable, why))
                });
            }
            tokio::time::sleep(PERIOD).await;
        }
    }
}

fn show(ui: &mut Ui, views: &[FederationView]) -> Result<(), CliError> {
    if views.is_empty() && !ui.json() {
        ui.message("no federation; `ictus up MANIFEST` starts one");
        return Ok(());
    }
    ui.result(&views, || {
        let head = [
            "FEDERATION",
            "MEMBER",
            "STATE",
            "PID",
            "AT",
            "TAGS",
            "REACTIONS",
            "MISSED",
        ];
        let mut table = Table::new(&head);
        for view in views {
            let part = view.part.as_ref();
            let name = part.map_or_else(
                || view.name.clone(),
                |part| format!("{} on {}", view.name, part.host),
            );
            table.row([name, "-".to_owned(), state(view)]);
            let rti = part.is_none_or(|part| part.rti).then_some(&view.rti);
            for member in rti.into_iter().chain(&view.federates) {
                table.row(row(member));
            }
        }
        table.text()
    })
}

fn row(member: &MemberView) -> [String; 8] {
    let number = |number: Option<u64>| number.map_or_else(|| "-".to_owned(), |it| it.to_string());
    let state = match &member.ending {
        Some(ending) => format!("{} ({})", member.state, one_line(ending)),
        None => member.state.clone(),
    };
    [
        String::new(),
        member.name.clone(),
        state,
        number(member.pid.map(u64::from)),
        member
            .elapsed_ns
            .map_or_else(|| "-".to_owned(), nanoseconds),
        number(member.tags),
        number(member.reactions),
        number(member.deadlines_missed),
    ]
}

fn state(view: &FederationView) -> String {
    let state = match (&view.outcome, view.state) {
        (Some(Outcome::Completed), _) => "completed".to_owned(),
        (Some(Outcome::Stopped { .. }), _) => "stopped".to_owned(),
        (Some(Outcome::Aborted), _) => "not started".to_owned(),
        (Some(Outcome::Failed { failure, .. }), _) => {
            let who = failure.member.as_deref().unwrap_or("federation");
            format!("failed: {who}: {}", one_line(&failure.what))
        }
        (None, State::Prepared) => "prepared".to_owned(),
        (None, State::Starting) => "starting".to_owned(),
        (None, State::Running) => "running".to_owned(),
        (None, State::Stopping) => "stopping".to_owned(),
        (None, State::Ended) => "ended".to_owned(),
    };
    format!("{state}, since {}", ago(view))
}
