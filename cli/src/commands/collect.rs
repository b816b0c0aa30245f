//! `ictus collect`: the service of a compose file that gathers what federates measure.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::Args;
use ictusd::collector::{self, Options};

use crate::error::CliError;

/// Gather what federates say on a socket in a shared directory, and serve it as `/metrics`
#[derive(Debug, Args)]
pub(crate) struct Collect {
    /// The environment variable that has the plan
    #[arg(long, value_name = "VARIABLE")]
    plan_env: String,
    /// The shared directory
    #[arg(long, value_name = "DIR")]
    directory: PathBuf,
    /// Where `/metrics` is served
    #[arg(long, value_name = "ADDRESS:PORT")]
    listen: SocketAddr,
}

impl Collect {
    pub(crate) fn run(&self) -> Result<(), CliError> {
        let name = &self.plan_env;
        let missing = |_| CliError::failed(format!("the variable {name} has no plan"));
        let text = std::env::var(name).map_err(missing)?;
        let plan = serde_json::from_str(&text).map_err(CliError::failed)?;
        let options = Options {
            plan,
            directory: self.directory.clone(),
            listen: self.listen,
        };
        collector::run(options).map_err(CliError::failed)
    }
}
