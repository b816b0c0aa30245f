//! What the RTI says of itself: status lines for supervisors, words for people.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;

use ictus_coord::report::RtiStatus;
use ictus_coord::rti::RtiEvent;
use ictus_core::PhysicalTime;
use rustix::fs::OFlags;

/// Past this many unwritten bytes, lines about refused connections are left out.
const BACKLOG: usize = 1 << 20;

/// Where status lines and words go. Writing never blocks.
#[derive(Debug, Default)]
pub struct Status {
    lines: Option<File>,
    unwritten: Vec<u8>,
    words: bool,
    start: Option<PhysicalTime>,
}

/// The descriptor of `--status-fd` cannot be written to.
#[derive(Debug, thiserror::Error)]
#[error("cannot write status lines to descriptor {descriptor}: {source}")]
pub struct StatusError {
    /// The descriptor's number.
    pub descriptor: u32,
    /// Why not.
    pub source: io::Error,
}

impl Status {
    /// Status lines to an inherited descriptor, words to standard error.
    ///
    /// # Errors
    ///
    /// When the descriptor is not open for writing.
    pub fn open(descriptor: Option<u32>) -> Result<Self, StatusError> {
        let lines = descriptor.map(open_descriptor).transpose()?;
        Ok(Self {
            lines,
            words: true,
            ..Self::default()
        })
    }

    /// No words, and status lines to a file; for tests and benches.
    #[must_use]
    pub fn to_file(lines: Option<File>) -> Self {
        Self {
            lines,
            ..Self::default()
        }
    }

    /// Says that the listener is open.
    pub(crate) fn listening(&mut self, port: u16) {
        self.say(&format!("listening on port {port}"));
        self.line(&RtiStatus::Listening { port });
    }

    /// Says what happened.
    pub(crate) fn tell(&mut self, event: RtiEvent) {
        self.say(&words(&event));
        if let RtiEvent::Started { start } = event {
            self.start = Some(start);
        }
        match status_of(event) {
            Some(RtiStatus::Rejected { .. }) if self.unwritten.len() > BACKLOG => {}
            Some(status) => self.line(&status),
            None => {}
        }
    }

    /// Says something to people.
    pub(crate) fn say(&self, words: &str) {
        if self.words {
            // Nobody is left to tell when standard error is gone.
            let _unwritten = writeln!(io::stderr(), "ictus rti: {words}");
        }
    }

    fn line(&mut self, status: &RtiStatus) {
        if self.lines.is_none() {
            return;
        }
        match serde_json::to_string(status) {
            Ok(line) => {
                self.unwritten.extend_from_slice(line.as_bytes());
                self.unwritten.push(b'\n');
            }
            Err(error) => self.say(&format!("a status line cannot be written: {error}")),
        }
        self.flush();
    }

    /// Writes what the descriptor takes now; a reader that is gone is forgotten.
    pub(crate) fn flush(&mut self) {
        let Some(file) = &mut self.lines else { return };
        while !self.unwritten.is_empty() {
            match file.write(&self.unwritten) {
                Ok(written) => drop(self.unwritten.drain(..written)),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                Err(_) => {
                    self.lines = None;
                    self.unwritten.clear();
                    return;
                }
            }
        }
    }
}

/// Opens the descriptor anew, so that non-blocking mode stays ours alone.
fn open_descriptor(descriptor: u32) -> Result<File, StatusError> {
    let flags = i32::try_from(OFlags::NONBLOCK.bits()).unwrap_or(0);
    OpenOptions::new()
        .write(true)
        .custom_flags(flags)
        .open(format!("/dev/fd/{descriptor}"))
        .map_err(|source| StatusError { descriptor, source })
}

fn words(event: &RtiEvent) -> String {
    match event {
        RtiEvent::Joined { federate } => format!("federate {federate} joined"),
        RtiEvent::Started { start } => format!("all joined; start time {start:?}"),
        RtiEvent::StopRequested {
            federate: Some(federate),
        } => {
            format!("federate {federate} asks to stop")
        }
        RtiEvent::StopRequested { federate: None } => "asking all federates to stop".to_owned(),
        RtiEvent::StopUnanswered { federates } => {
            format!("no answer to the stop request from {federates:?}")
        }
        RtiEvent::StopAgreed { elapsed, microstep } => {
            format!("stop tag agreed: {elapsed} after the start, microstep {microstep}")
        }
        RtiEvent::Resigned { federate } => format!("federate {federate} resigned"),
        RtiEvent::Lost { federate, reason } => format!("federate {federate} is lost: {reason}"),
        RtiEvent::Rejected { peer, reason } => format!("refused {peer}: {reason}"),
        RtiEvent::Ended { code } => format!("all federates are gone; exit code {code}"),
    }
}

fn status_of(event: RtiEvent) -> Option<RtiStatus> {
    Some(match event {
        RtiEvent::Joined { federate } => RtiStatus::Joined {
            federate: federate.get(),
        },
        RtiEvent::Started { start } => RtiStatus::Start {
            start_ns: start.as_nanos(),
        },
        RtiEvent::StopRequested { federate } => RtiStatus::StopRequested {
            federate: federate.map(|federate| federate.get()),
        },
        RtiEvent::StopUnanswered { .. } => return None,
        RtiEvent::StopAgreed { elapsed, microstep } => RtiStatus::Stop {
            elapsed_ns: elapsed.as_nanos(),
            microstep,
        },
        RtiEvent::Resigned { federate } => RtiStatus::Resigned {
            federate: federate.get(),
        },
        RtiEvent::Lost { federate, reason } => RtiStatus::Failed {
            federate: federate.get(),
            reason,
        },
        RtiEvent::Rejected { peer, reason } => RtiStatus::Rejected { peer, reason },
        RtiEvent::Ended { code } => RtiStatus::Ended { code },
    })
}
