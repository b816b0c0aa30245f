//! `ictus metrics`: what Prometheus would read.

use clap::Args;

use crate::error::CliError;
use crate::session::Session;
use crate::ui::Ui;

/// Print this host's metrics as Prometheus reads them
#[derive(Debug, Args)]
pub(crate) struct Metrics {}

impl Metrics {
    #[expect(clippy::unused_self, reason = "every command is run in the same way")]
    pub(crate) fn run(&self, ui: &mut Ui) -> Result<(), CliError> {
        let session = Session::new()?;
        if session.known().is_empty() {
            return Ok(());
        }
        session.block_on(async {
            let page = session.daemon().await?.metrics().await?;
            // The format is one for programs already.
            ui.print(page.trim_end())
        })
    }
}
