//! `ictus logs`: what federates have written, merged by time.

use clap::Args;
use ictusd::api::LogLine;

use crate::error::CliError;
use crate::session::Session;
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
}

impl Logs {
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
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
