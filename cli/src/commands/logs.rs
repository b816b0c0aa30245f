//! `ictus logs`: what federates have written, merged by time.

use clap::Args;
use ictusd::api::{ErrorCode, LogLine};
use ictusd::client::Client;

use crate::error::CliError;
use crate::hosts::connect_all;
use crate::hosts::merge::Merged;
use crate::session::{Abroad, Session, Whereabouts};
use crate::ui::Ui;

/// Show what federates have written, merged by time
#[derive(Debug, Args)]
pub(crate) struct Logs {
    /// Go on until the federation ends
    #[arg(short, long)]
    follow: bool,
    /// Begin with the last lines of what is there
    #[arg(short = 'n', long, value_name = "LINES")]
    tail: Option<usize>,
    /// The federation (its name or manifest; may be left out when there is one), then federates
    #[arg(value_name = "NAME] [FEDERATE")]
    names: Vec<String>,
    #[command(flatten)]
    at: Whereabouts,
}

impl Logs {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        let first = self.names.first().map(String::as_str);
        if let Some(stack) = self.at.stack(&session, first) {
            return session.block_on(stack.show(ui, &self.of_stack()));
        }
        if let Some(abroad) = self.at.abroad(&session, first)? {
            return session.block_on(self.everywhere(ui, &session, &abroad));
        }
        let (name, federates) = self.split(&session)?;
        session.block_on(async {
            let client = session.daemon().await?;
            let lines = client
                .logs(&name, federates, self.follow, self.tail)
                .await?;
            let (mut lines, mut printer) = (lines, Printer::default());
            while let Some(line) = lines.next().await? {
                printer.print(ui, &line)?;
            }
            Ok(())
        })
    }

    /// What docker-compose is asked for; a name that is left out is that of the only federation.
    fn of_stack(&self) -> Vec<String> {
        let mut words = vec!["logs".to_owned(), "--no-color".to_owned()];
        words.extend(self.follow.then(|| "--follow".to_owned()));
        words.extend(self.tail.map(|lines| format!("--tail={lines}")));
        words.push("--".to_owned());
        words.extend(self.names.iter().skip(1).cloned());
        words
    }

    /// Those of all hosts: what is there by time, what comes as it comes.
    async fn everywhere(
        &self,
        ui: &mut Ui,
        session: &Session,
        abroad: &Abroad,
    ) -> Result<(), CliError> {
        let wanted = self.names.get(1..).unwrap_or_default();
        let (mut merged, mut kept) = (Merged::new(), Vec::new());
        for (host, client) in connect_all(session, &abroad.ways).await {
            let client = client?;
            let wanted_here = here(&client, &abroad.name, wanted).await?;
            if !wanted.is_empty() && wanted_here.is_empty() {
                continue;
            }
            let lines = client.logs(&abroad.name, &wanted_here, self.follow, self.tail);
            merged.add(host, lines.await?);
        }
        let mut printer = Printer::default();
        while let Some((_, line)) = merged.next().await {
            if self.follow {
                printer.print(ui, &line?)?;
            } else {
                kept.push(line?);
            }
        }
        kept.sort();
        for line in kept {
            printer.print(ui, &line)?;
        }
        Ok(())
    }

    /// The first name is a federation's, unless there is only one and it is not called so.
    fn split(&self, session: &Session) -> Result<(String, &[String]), CliError> {
        let known = session.known();
        match (self.names.as_slice(), known.as_slice()) {
            ([], _) => Ok((session.name(None)?, &[])),
            ([first, ..], [only]) if first != only && !first.contains(['/', '.']) => {
                Ok((only.clone(), &self.names))
            }
            ([first, rest @ ..], _) => Ok((session.name(Some(first))?, rest)),
        }
    }
}

/// Those of the members that are, or were, on a host.
async fn here(client: &Client, name: &str, wanted: &[String]) -> Result<Vec<String>, CliError> {
    let view = match client.federation(name).await {
        Ok(view) => view,
        Err(error)
            if error
                .refusal()
                .is_some_and(|it| it.code == ErrorCode::Unknown) =>
        {
            // It was taken down, and its logs tell whose they are.
            let mut here = Vec::new();
            for member in wanted {
                let one = std::slice::from_ref(member);
                if client.logs(name, one, false, Some(0)).await.is_ok() {
                    here.push(member.clone());
                }
            }
            return Ok(here);
        }
        Err(error) => return Err(error.into()),
    };
    let members = [&view.rti].into_iter().chain(&view.federates);
    let members: Vec<_> = members.map(|it| &it.name).collect();
    let wanted = wanted.iter().filter(|it| members.contains(it));
    Ok(wanted.cloned().collect())
}

/// Prints lines in columns.
#[derive(Debug, Default)]
pub(crate) struct Printer {
    /// Grows with the longest name seen, so that the columns do not jump about.
    width: usize,
}

impl Printer {
    pub(crate) fn print(&mut self, ui: &mut Ui, line: &LogLine) -> Result<(), CliError> {
        self.width = self.width.max(line.member.chars().count());
        let width = self.width;
        ui.result(line, || {
            let LogLine {
                time,
                member,
                stream,
                text,
            } = line;
            let clock = time.get(11..26).unwrap_or(time);
            let mark = if stream.starts_with("err") { "!" } else { "|" };
            format!("{clock} {member:<width$} {mark} {text}")
        })
    }
}
