//! `ictus supervise`: what the daemon starts for every process.

use std::path::PathBuf;

use clap::Args;

use crate::error::CliError;

/// Run one process of a spec and records its end
#[derive(Debug, Args)]
pub(crate) struct Supervise {
    /// The spec, as the daemon writes it
    spec: PathBuf,
}

impl Supervise {
    pub(crate) fn run(&self) -> Result<(), CliError> {
        ictusd::supervisor::run(&self.spec).map_err(CliError::failed)
    }
}
