//! `ictus ps`: federations and federates.

use std::collections::BTreeMap;
use std::time::Duration;

use clap::Args;
use ictusd::api::{FederationView, MemberView, Outcome, State};
use ictusd::stamp;
use serde::Serialize;

use crate::error::{CliError, Kind};
use crate::hosts::outcome::headline;
use crate::hosts::{Clients, connect_all, foreign};
use crate::session::{Abroad, Session, Whereabouts, ago};
use crate::stack::Stack;
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
        let stack = self.at.stack(&session, given);
        let listed = given.is_none() && (self.watch || ui.json());
        if let Some(stack) = stack.filter(|_| !listed) {
            if self.watch {
                let message = "`--watch` is not for a federation that docker-compose runs";
                return Err(CliError::failed(message).hint("leave it out"));
            }
            return session.block_on(stack.show(ui, &["ps"]));
        }
        if let Some(abroad) = self.at.abroad(&session, given)? {
            return session.block_on(self.everywhere(ui, &session, &abroad));
        }
        let only = given.map(|given| session.name(Some(given))).transpose()?;
        // By its name one is shown above.
        let stacks = || match given {
            None => Stack::all(&session),
            Some(_) => Vec::new(),
        };
        if !self.watch && session.known().is_empty() {
            return show(ui, &[], &stacks());
        }
        session.block_on(async {
            let client = session.daemon().await?;
            loop {
                let mut views = client.federations().await?;
                views.retain(|view| only.as_ref().is_none_or(|only| *only == view.name));
                if self.watch && ui.can_redraw() {
                    ui.clear()?;
                }
                show(ui, &views, &stacks())?;
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
        let mut hosts = Hosts::new(abroad);
        loop {
            hosts.look(session).await;
            if self.watch && ui.can_redraw() {
                ui.clear()?;
            }
            hosts.show(ui)?;
            for warning in foreign(&hosts.clients, &abroad.name).await {
                ui.warning(&warning);
            }
            if !self.watch {
                return hosts.result();
            }
            tokio::time::sleep(PERIOD).await;
        }
    }
}

/// What is known of each host; what cannot be asked is unknown, and nothing else.
struct Hosts<'a> {
    abroad: &'a Abroad,
    clients: Clients,
    seen: BTreeMap<String, Seen>,
}

/// What a host said last.
#[derive(Default)]
struct Seen {
    view: Option<FederationView>,
    /// When, nanoseconds since the Unix epoch; absent when it never did.
    heard_ns: Option<i64>,
    /// Why it cannot be asked now.
    silent: Option<String>,
}

/// A host that cannot be asked, for programs.
#[derive(Serialize)]
struct Unknown<'a> {
    name: &'a str,
    host: &'a str,
    state: &'static str,
    /// When it was last heard of, nanoseconds since the Unix epoch; null when not since this command began.
    since_ns: Option<i64>,
    why: &'a str,
}

impl<'a> Hosts<'a> {
    fn new(abroad: &'a Abroad) -> Self {
        Self {
            abroad,
            clients: Clients::new(),
            seen: BTreeMap::new(),
        }
    }

    /// Asks all; those that are not connected are tried again.
    async fn look(&mut self, session: &Session) {
        let ways = self.abroad.ways.iter();
        let lost = ways.filter(|(host, _)| !self.clients.contains_key(*host));
        let lost = lost
            .map(|(host, way)| (host.clone(), way.clone()))
            .collect();
        for (host, client) in connect_all(session, &lost).await {
            match client {
                Ok(client) => {
                    self.clients.insert(host, client);
                }
                Err(error) => {
                    self.seen.entry(host).or_default().silent = Some(error.to_string());
                }
            }
        }
        let asked = self.clients.iter().map(|(host, client)| async move {
            let views = client.federations().await;
            (
                host.clone(),
                views.map_err(|it| CliError::from(it).to_string()),
            )
        });
        for (host, views) in futures_util::future::join_all(asked).await {
            let seen = self.seen.entry(host.clone()).or_default();
            match views {
                Ok(views) => {
                    let mut views = views.into_iter();
                    *seen = Seen {
                        view: views.find(|view| view.name == self.abroad.name),
                        heard_ns: Some(stamp::now_ns()),
                        silent: None,
                    };
                }
                Err(why) => {
                    seen.silent = Some(why);
                    self.clients.remove(&host);
                }
            }
        }
    }

    fn show(&self, ui: &mut Ui) -> Result<(), CliError> {
        let silent = self.unknown();
        let heard = self.seen.values().filter(|seen| seen.silent.is_none());
        let views: Vec<_> = heard.filter_map(|seen| seen.view.as_ref()).collect();
        if views.is_empty() && silent.is_empty() && !ui.json() {
            ui.message("no federation; `ictus up MANIFEST` starts one");
            return Ok(());
        }
        let all: Result<Vec<_>, _> = views
            .iter()
            .map(serde_json::to_value)
            .chain(silent.iter().map(serde_json::to_value))
            .collect();
        ui.result(&all.map_err(CliError::failed)?, || {
            let mut table = head();
            for view in &views {
                rows(&mut table, view);
            }
            for Unknown {
                name,
                host,
                since_ns,
                ..
            } in &silent
            {
                table.row([
                    format!("{name} on {host}"),
                    "-".to_owned(),
                    since(*since_ns),
                ]);
            }
            let mut text = table.text();
            if let Some(headline) = headline(&views) {
                text.push('\n');
                text.push_str(&headline);
            }
            text
        })?;
        for Unknown { host, why, .. } in silent {
            ui.warning(&format!("{host}: unknown: {why}"));
        }
        Ok(())
    }

    fn unknown(&self) -> Vec<Unknown<'_>> {
        let silent = self.seen.iter().filter_map(|(host, seen)| {
            Some(Unknown {
                name: &self.abroad.name,
                host,
                state: "unknown",
                since_ns: seen.heard_ns,
                why: seen.silent.as_deref()?,
            })
        });
        silent.collect()
    }

    fn result(&self) -> Result<(), CliError> {
        let first = self.unknown().into_iter().next();
        first.map_or(Ok(()), |unknown| {
            Err(CliError::new(Kind::Unreachable, unknown.why.to_owned()))
        })
    }
}

/// Since when nothing is known of a host.
fn since(heard_ns: Option<i64>) -> String {
    heard_ns.map_or_else(
        || "unknown: it has not answered".to_owned(),
        |ns| format!("unknown since {}", stamp::text(ns)),
    )
}

/// A federation that docker-compose runs, for programs: only its name is known without asking Compose.
#[derive(Serialize)]
struct Composed<'a> {
    name: &'a str,
    state: &'static str,
}

/// What one list holds.
#[derive(Serialize)]
#[serde(untagged)]
enum Listed<'a> {
    Ours(&'a FederationView),
    Composed(Composed<'a>),
}

fn show(ui: &mut Ui, views: &[FederationView], stacks: &[Stack]) -> Result<(), CliError> {
    if views.is_empty() && stacks.is_empty() && !ui.json() {
        ui.message("no federation; `ictus up MANIFEST` starts one");
        return Ok(());
    }
    let composed = stacks.iter().map(|stack| Composed {
        name: &stack.name,
        state: "compose",
    });
    let all = views.iter().map(Listed::Ours);
    let all: Vec<_> = all.chain(composed.map(Listed::Composed)).collect();
    ui.result(&all, || {
        let mut table = head();
        for view in views {
            rows(&mut table, view);
        }
        for Stack { name, .. } in stacks {
            let state = format!("docker-compose runs it: `ictus ps {name}`");
            table.row([name.clone(), "-".to_owned(), state]);
        }
        table.text()
    })
}

fn head() -> Table {
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
    Table::new(&head)
}

/// A federation, or a host's part of one, and its members.
fn rows(table: &mut Table, view: &FederationView) {
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
            format!("failed: {who}: {}", one_line(&failure.words()))
        }
        (None, State::Prepared) => "prepared".to_owned(),
        (None, State::WaitingForSecrets) => "waiting for secrets".to_owned(),
        (None, State::Starting) => "starting".to_owned(),
        (None, State::Running) => "running".to_owned(),
        (None, State::Stopping) => "stopping".to_owned(),
        (None, State::Ended) => "ended".to_owned(),
    };
    format!("{state}, since {}", ago(view))
}
