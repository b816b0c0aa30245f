//! `ictus ps`: federations and federates.

use std::time::Duration;

use clap::Args;
use ictusd::api::{FederationView, MemberView, Outcome, State};

use crate::error::CliError;
use crate::session::{Session, ago};
use crate::ui::{Table, Ui, nanoseconds, one_line};

/// How often `--watch` looks.
const PERIOD: Duration = Duration::from_secs(1);

/// Show federations and their federates
#[derive(Debug, Args)]
pub(crate) struct Ps {
    /// Show it again every second, until Ctrl-C
    #[arg(short, long)]
    watch: bool,
}

impl Ps {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        if !self.watch && session.known().is_empty() {
            return show(ui, &[]);
        }
        session.block_on(async {
            let client = session.daemon().await?;
            loop {
                let views = client.federations().await?;
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
            table.row([view.name.clone(), "-".to_owned(), state(view)]);
            for member in [&view.rti].into_iter().chain(&view.federates) {
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
