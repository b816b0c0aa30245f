//! Commands as root on a host: by root's own login, or by a `sudo` that asks nothing.

use ictus_deploy::ssh::Connection;

use super::run;
use crate::error::CliError;
use crate::hosts::unreachable_host;

/// How root's commands are run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum By {
    Login,
    Sudo,
}

impl By {
    /// Finds out; absent where whoever logs in has no such rights.
    pub(super) async fn of(host: &str, connection: &Connection) -> Result<Option<Self>, CliError> {
        if run(host, connection, &["id", "-u"]).await?.trim_ascii() == b"0" {
            return Ok(Some(Self::Login));
        }
        let sudo = holds(host, connection, &["sudo", "-n", "true"]).await?;
        Ok(sudo.then_some(Self::Sudo))
    }

    pub(super) fn command<'w>(self, command: &[&'w str]) -> Vec<&'w str> {
        let by: &[&str] = match self {
            Self::Login => &[],
            Self::Sudo => &["sudo", "-n"],
        };
        [by, command].concat()
    }
}

/// Whether a command succeeds there.
pub(super) async fn holds(
    host: &str,
    connection: &Connection,
    command: &[&str],
) -> Result<bool, CliError> {
    let output = connection.run(command, &[]).await;
    let output = output.map_err(|error| unreachable_host(host, &error))?;
    Ok(output.code == 0)
}

/// Who would be root, and is not.
pub(super) fn powerless(host: &str, connection: &Connection) -> String {
    let user = &connection.peer().user;
    format!("host `{host}`: user `{user}` is not root and may not use `sudo` without a password")
}
