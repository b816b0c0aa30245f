//! `ictus daemon`, also by the name `ictusd`.

use ictusd::daemon;
use ictusd::paths::Paths;

use crate::error::CliError;

pub(crate) fn run() -> Result<(), CliError> {
    daemon::log_to_stderr();
    let paths = Paths::from_env()?;
    daemon::run(&paths).map(|_| ()).map_err(CliError::failed)
}
