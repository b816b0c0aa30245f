//! How a command fails: what kind, why, and what to do about it.

use std::error::Error;
use std::fmt;

use ictus_deploy::Problems;
use ictusd::api::ErrorCode;
use ictusd::client::ClientError;
use ictusd::paths::PathsError;

/// The exit code of a wrong command line.
pub(crate) const USAGE: u8 = 64;

/// Why a command failed, for people.
#[derive(Debug)]
pub(crate) struct CliError {
    pub(crate) kind: Kind,
    source: Box<dyn Error + Send + Sync>,
    pub(crate) hints: Vec<String>,
}

/// What kind of failure; decides the exit code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Something did not work.
    Failed,
    /// The manifest has mistakes.
    Manifest,
    /// A host cannot be reached, or does not let us in.
    Unreachable,
    /// Somebody else changes the federation.
    Held,
    /// Done on some hosts only.
    Partial,
    /// There is something to do (`plan`); nothing is wrong.
    Changes,
    /// A saved plan was made for another state of a host or of the manifest.
    Stale,
    /// It did not become healthy, or did not end, in time.
    Timeout,
    /// The daemon went away; what runs goes on.
    DaemonGone,
    /// Who reads standard output went away.
    BrokenPipe,
}

impl CliError {
    pub(crate) fn new(kind: Kind, source: impl Into<Box<dyn Error + Send + Sync>>) -> Self {
        Self {
            kind,
            source: source.into(),
            hints: Vec::new(),
        }
    }

    pub(crate) fn failed(source: impl Into<Box<dyn Error + Send + Sync>>) -> Self {
        Self::new(Kind::Failed, source)
    }

    /// Adds a line on what to do.
    pub(crate) fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hints.push(hint.into());
        self
    }

    /// Whether only the daemon is missing.
    pub(crate) fn daemon_gone(&self) -> bool {
        self.kind == Kind::DaemonGone
    }

    /// The process's exit code: table D6 of the deployment notes.
    pub(crate) fn code(&self) -> u8 {
        match self.kind {
            Kind::Failed | Kind::DaemonGone => 1,
            Kind::Changes => 2,
            Kind::Manifest => 3,
            Kind::Unreachable => 4,
            Kind::Held => 5,
            Kind::Partial => 8,
            Kind::Stale => 9,
            Kind::Timeout => 6,
            Kind::BrokenPipe => 0,
        }
    }
}

impl fmt::Display for CliError {
    /// The message with its sources, on one line unless a source has several.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.source)?;
        let mut source = self.source.source();
        while let Some(error) = source {
            write!(f, ": {error}")?;
            source = error.source();
        }
        Ok(())
    }
}

impl From<Problems> for CliError {
    fn from(problems: Problems) -> Self {
        Self::new(Kind::Manifest, problems)
    }
}

impl From<PathsError> for CliError {
    fn from(error: PathsError) -> Self {
        let hint = match &error {
            PathsError::TooLong { .. } => {
                Some("set XDG_RUNTIME_DIR (or ICTUS_STATE_DIR) to a shorter directory")
            }
            PathsError::NoHome => Some("set HOME"),
            PathsError::Relative { .. }
            | PathsError::NotOurs { .. }
            | PathsError::Unusable { .. } => None,
        };
        let failed = Self::failed(error);
        match hint {
            Some(hint) => failed.hint(hint),
            None => failed,
        }
    }
}

impl From<ClientError> for CliError {
    fn from(error: ClientError) -> Self {
        if let ClientError::Paths(error) = error {
            return error.into();
        }
        if matches!(
            error,
            ClientError::Broken(_) | ClientError::Unreachable { .. }
        ) {
            return Self::new(Kind::DaemonGone, "the daemon went away")
                .hint("federations go on without it; the same command finds the next one");
        }
        let known = error
            .refusal()
            .map(|refusal| refusal.known.join(", "))
            .unwrap_or_default();
        let log = if let ClientError::NotStarted { log, .. } = &error {
            Some(log.clone())
        } else {
            None
        };
        let far = matches!(error, ClientError::Far(_));
        let held = error.refusal().is_some_and(|it| it.code == ErrorCode::Held);
        let kind = match (held, far) {
            (true, _) => Kind::Held,
            (_, true) => Kind::Unreachable,
            _ => Kind::Failed,
        };
        let mut failed = Self::new(kind, error);
        if !known.is_empty() {
            failed = failed.hint(format!("known: {known}"));
        }
        if let Some(log) = log {
            failed = failed.hint(format!("its log is {}", log.display()));
        }
        failed
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    /// A host that is lost after it was reached is one that cannot be reached.
    #[test]
    fn a_host_that_is_lost_later_is_unreachable_too() {
        let lost = io::Error::other("host `pi`: the connection is closed");
        let error = CliError::from(ClientError::Far(lost));
        assert_eq!(error.code(), 4);
        assert_eq!(error.to_string(), "host `pi`: the connection is closed");
    }
}
