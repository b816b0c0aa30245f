//! Signals that ask a command to end.

use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::error::CliError;

/// Ctrl-C, SIGTERM, and the terminal's end. One for a whole command: what comes between two waits counts, too.
#[derive(Debug)]
pub(crate) struct Interrupts {
    signals: [Signal; 3],
}

impl Interrupts {
    /// Takes the signals from now on.
    pub(crate) fn new() -> Result<Self, CliError> {
        let take = |kind| signal(kind).map_err(CliError::failed);
        Ok(Self {
            signals: [
                take(SignalKind::interrupt())?,
                take(SignalKind::terminate())?,
                take(SignalKind::hangup())?,
            ],
        })
    }

    /// Waits for the next one.
    pub(crate) async fn recv(&mut self) {
        let [interrupt, terminate, hangup] = &mut self.signals;
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
            _ = hangup.recv() => {}
        }
    }
}
